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

    async def receives_test_packet(self, packet_size: int, wait: float) -> bool:
        """Return True if a packet of this size comes in time; drop other packets."""
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
        sock: socket that receives the packets, closed with the stream.
        assembler: assembler of pictures.
        on_pictures: function that is called with new pictures, also with none if frames were lost.
        request_resend: function that requests packets from the camera.
    """

    def __init__(
        self,
        sock: StreamSocket,
        assembler: Assembler,
        on_pictures: Callable[[list[WholePicture]], None],
        request_resend: Callable[[Resend], None],
    ) -> None:
        self._socket, self.assembler = sock, assembler
        self._on_pictures, self._request_resend = on_pictures, request_resend
        self._buffer = bytearray(65536)
        self._view = memoryview(self._buffer)
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = 0.0
        self._closed = False
        self.foreign = 0
        """Number of datagrams from other hosts."""
        self._loop.add_reader(sock.socket, self._read_packets)

    def close(self) -> None:
        """Stop reading. Idempotent."""
        if not self._closed:
            self._closed = True
            self._loop.remove_reader(self._socket.socket)
            self._socket.close()
            if self._timer is not None:
                self._timer.cancel()

    def _read_packets(self) -> None:
        now, arrived = self._loop.time(), time.monotonic()
        receive, feed = self._socket.socket.recvfrom_into, self.assembler.feed
        camera, view = self._socket.camera, self._view
        for _ in range(MAX_PACKETS_PER_TURN):
            try:
                size, sender = receive(view)
            except BlockingIOError:
                break
            except OSError:  # from a datagram sent earlier; reading goes on
                continue
            if sender[0] == camera:
                feed(view, size, now, arrived)
            else:
                self.foreign += 1
        self._pass_pictures()

    def _pass_pictures(self) -> None:
        pictures = self.assembler.pictures()
        if pictures or self.assembler.fault is not None or self.assembler.uncounted_lost:
            self._on_pictures(pictures)
        if not self._closed:
            self._set_timer()

    def _set_timer(self) -> None:
        deadline = self.assembler.next_deadline()
        if deadline is None or (self._timer is not None and self._timer_at <= deadline):
            return
        if self._timer is not None:
            self._timer.cancel()
        self._timer_at = deadline  # stored: uvloop's timers do not tell whether they are cancelled
        self._timer = self._loop.call_at(deadline, self._on_timer)

    def _on_timer(self) -> None:
        self._timer = None
        for packets in self.assembler.handle_timeout(self._loop.time()):
            self._request_resend(packets)
        self._pass_pictures()
