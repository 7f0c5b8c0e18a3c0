"""Pass packets from the stream's socket to the assembler, and pictures to their receiver.

Measured CPU time per packet of 1400 bytes: 29 us with asyncio's datagram transport, which makes an
object and a call for each; 4 us with a bare socket that is read until it is empty.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import sys
import time
from typing import TYPE_CHECKING, Final

from smartcam.frames._gige.gvsp import IP_UDP_BYTES

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.frames._gige.assembler import Assembler, Resend
    from smartcam.frames._gige.block import WholePicture

MAX_PACKETS_PER_TURN: Final = 64
"""Largest number of packets read before the event loop continues: 0.3 ms."""

RECEIVE_BUFFER_BYTES: Final = 8 << 20
"""Requested size of the receive buffer. Linux gives at most net.core.rmem_max, by default 208 KiB,
which a frame of 512x512 fills; further packets are lost while the loop is busy."""

SO_RCVBUFFORCE: Final = 33 if sys.platform == "linux" else socket.SO_RCVBUF
"""Socket option from asm-generic/socket.h that exceeds rmem_max, for processes that may administer
the network."""


class StreamSocket:
    """The socket to which a camera sends its stream.

    Args:
        local: address of this machine.
        camera: address of the camera; packets from others are dropped.

    Raises:
        OSError: this machine has no such address.
    """

    def __init__(self, local: str, camera: str) -> None:
        self.camera = camera
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self.socket.setblocking(False)
            for option in (socket.SO_RCVBUF, SO_RCVBUFFORCE):
                with contextlib.suppress(OSError):  # the second option is for privileged processes
                    self.socket.setsockopt(socket.SOL_SOCKET, option, RECEIVE_BUFFER_BYTES)
            self.socket.bind((local, 0))
        except BaseException:
            self.socket.close()
            raise

    @property
    def port(self) -> int:
        """Port of the socket."""
        return int(self.socket.getsockname()[1])

    async def test_packet(self, packet_size: int, wait: float) -> bool:
        """Return True if a packet of the given size comes in time; drop all others."""
        loop = asyncio.get_running_loop()
        buffer = bytearray(65536)
        try:
            async with asyncio.timeout(wait):
                while True:
                    size, sender = await loop.sock_recvfrom_into(self.socket, buffer)
                    if size == packet_size - IP_UDP_BYTES and sender[0] == self.camera:
                        return True
        except TimeoutError:
            return False

    def close(self) -> None:
        """Close the socket. Idempotent."""
        self.socket.close()


class Stream:
    """A running stream, until :meth:`close`.

    Args:
        where: socket that receives the packets, closed with the stream.
        assembler: assembler of pictures.
        done: function that is called with new pictures.
        resend: function that requests packets from the camera.
    """

    def __init__(
        self,
        where: StreamSocket,
        assembler: Assembler,
        done: Callable[[list[WholePicture]], None],
        resend: Callable[[Resend], None],
    ) -> None:
        self._where, self.assembler = where, assembler
        self._done, self._resend = done, resend
        self._buffer = bytearray(65536)
        self._view = memoryview(self._buffer)
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = 0.0
        self._closed = False
        self.foreign = 0
        """Number of datagrams from other hosts."""
        self._loop.add_reader(where.socket, self._readable)

    def close(self) -> None:
        """Stop reading. Idempotent."""
        if not self._closed:
            self._closed = True
            self._loop.remove_reader(self._where.socket)
            self._where.close()
            if self._timer is not None:
                self._timer.cancel()

    def _readable(self) -> None:
        now, arrived = self._loop.time(), time.monotonic()
        receive, feed = self._where.socket.recvfrom_into, self.assembler.feed
        camera, view = self._where.camera, self._view
        for _ in range(MAX_PACKETS_PER_TURN):
            try:
                size, sender = receive(view)
            except BlockingIOError:
                break
            except OSError:  # an error of an earlier sent datagram; reading goes on
                continue
            if sender[0] == camera:
                feed(view, size, now, arrived)
            else:
                self.foreign += 1
        self._report()

    def _report(self) -> None:
        pictures = self.assembler.pictures()
        if pictures or self.assembler.fault is not None or self.assembler.untold:
            self._done(pictures)
        if not self._closed:
            self._wake()

    def _wake(self) -> None:
        deadline = self.assembler.next_deadline()
        if deadline is None or (self._timer is not None and self._timer_at <= deadline):
            return
        if self._timer is not None:
            self._timer.cancel()
        self._timer_at = deadline  # uvloop's timers do not report cancellation
        self._timer = self._loop.call_at(deadline, self._due)

    def _due(self) -> None:
        self._timer = None
        for wanted in self.assembler.handle_timeout(self._loop.time()):
            self._resend(wanted)
        self._report()
