"""A link between sender and receiver on the loopback, with faults that a test chooses."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import socket
from typing import TYPE_CHECKING, Any

from tests.frames.inside import RtpPacket, is_rtcp

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

HOST = "127.0.0.1"


def two_ports() -> int:
    """Return a port that is free, and the next one, too.

    They are below the system's range of automatic ports: other tests get none of them.
    """
    while True:
        port = 10_000 + 2 * secrets.randbelow(10_000)
        with (
            socket.socket(type=socket.SOCK_DGRAM) as one,
            socket.socket(type=socket.SOCK_DGRAM) as two,
            contextlib.suppress(OSError),
        ):
            one.bind((HOST, port))
            two.bind((HOST, port + 1))
            return port


class Way:
    """Carries RTP and RTCP to a receiver, and RTCP back.

    Attributes:
        port: port for a sender.
        passes: returns whether a packet of RTP arrives.
        back: whether packets of the receiver arrive.
        carried: packets of RTP that arrived.
    """

    def __init__(self, to: int) -> None:
        self.port = two_ports()
        self.passes: Callable[[RtpPacket], bool] = lambda _: True
        self.back = True
        self.carried: list[RtpPacket] = []
        self._to = to
        self._sender: list[Any] = [None, None]
        self._loop = asyncio.get_running_loop()
        self._sockets: list[socket.socket] = []
        for number in range(2):
            one = socket.socket(type=socket.SOCK_DGRAM)
            one.setblocking(False)
            one.bind((HOST, self.port + number))
            self._loop.add_reader(one, self._readable, one, number)
            self._sockets.append(one)

    def close(self) -> None:
        for one in self._sockets:
            self._loop.remove_reader(one)
            one.close()

    def _readable(self, one: socket.socket, number: int) -> None:
        while True:
            try:
                data, who = one.recvfrom(65536)
            except OSError:
                return
            with contextlib.suppress(OSError):
                if who[1] == self._to + number:
                    if self.back and self._sender[number] is not None:
                        one.sendto(data, self._sender[number])
                    continue
                self._sender[number] = who
                if not is_rtcp(data):
                    packet = RtpPacket.parse(data)
                    if not self.passes(packet):
                        continue
                    self.carried.append(packet)
                one.sendto(data, (HOST, self._to + number))


@contextlib.asynccontextmanager
async def way(to: int) -> AsyncIterator[Way]:
    made = Way(to)
    try:
        yield made
    finally:
        made.close()
