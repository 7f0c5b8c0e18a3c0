"""Many canned cameras in one process: each sends results at the rate asked for, spread over time.

Two frames are the peer's own words. ``GO``, from any connection, has every camera in a session
send a number of results at a rate; which sends when is spread evenly, to the millisecond of epoll.
``STALL`` is about the connection it comes from: its camera ends in the middle of the next result
and is silent, until it is told to go on with the rest of that result. In each result stands the
time at which it was sent.
"""

from __future__ import annotations

import contextlib
import resource
import selectors
import socket
import struct
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from benchmarks.peers import wire

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["GO", "GO_BODY", "RECORD", "STALL", "allow_sockets"]

GO, STALL = 0x7001, 0x7002
GO_BODY = struct.Struct("<Id")  # results of each camera; rate, results a second of each
RECORD = struct.Struct("<Q42sfifff")  # 70 bytes: time.monotonic_ns(), then as a localization
HALF = 40
"""Bytes of a result that come before a stall."""


def allow_sockets() -> None:
    """Raise the limit of open files as far as it goes."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


@dataclass(slots=True, eq=False)
class Camera:
    """One connection; ``kept`` is the rest of a result that stalls, once it does."""

    sock: socket.socket
    buffer: bytes = b""
    in_session: bool = False
    stalls: bool = False
    kept: bytes = field(default=b"")


class Fleet:
    """All connections of the process."""

    def __init__(self) -> None:
        # at every address of the loopback, since a fleet has a camera under one name only
        self.server = socket.create_server(("0.0.0.0", 0), backlog=4096)  # noqa: S104
        self.selector = selectors.DefaultSelector()
        self.selector.register(self.server, selectors.EVENT_READ)
        self.cameras: list[Camera] = []
        self.plan: Iterator[tuple[float, Camera]] = iter(())
        self.next: tuple[float, Camera] | None = None

    def serve(self) -> None:
        """Answer and send until killed."""
        while True:
            patience = None if self.next is None else max(0.0, self.next[0] - time.monotonic())
            for key, _ in self.selector.select(patience):
                if key.data is None:
                    self.accept()
                else:
                    self.read(key.data)
            now = time.monotonic()
            while self.next is not None and self.next[0] <= now:
                self.send_result(self.next[1])
                self.next = next(self.plan, None)

    def accept(self) -> None:
        """Take one more."""
        sock, (host, _) = self.server.accept()
        if not host.startswith("127."):
            sock.close()  # from outside this machine
            return
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        camera = Camera(sock)
        self.cameras.append(camera)
        self.selector.register(sock, selectors.EVENT_READ, camera)

    def read(self, camera: Camera) -> None:
        """Answer what has come."""
        try:
            data = camera.sock.recv(4096)
        except OSError:
            data = b""
        if not data:
            self.selector.unregister(camera.sock)
            self.cameras.remove(camera)
            camera.sock.close()
            return
        buffer = camera.buffer + data
        while len(buffer) >= wire.HEADER.size:
            _, length, message_id = wire.HEADER.unpack_from(buffer)
            end = wire.HEADER.size + length
            if len(buffer) < end:
                break
            body, buffer = buffer[wire.HEADER.size : end], buffer[end:]
            if message_id == wire.CONNECT:
                camera.in_session = True
                camera.sock.sendall(wire.CONNECT_ANSWER + wire.status(waiting=False))
            elif message_id == wire.QUERY and not camera.stalls:
                camera.sock.sendall(wire.query_answer())
            elif message_id == GO:
                self.go(*GO_BODY.unpack(body))
            elif message_id == STALL:
                camera.stalls = not camera.stalls
                camera.sock.sendall(camera.kept)
                camera.kept = b""
        camera.buffer = buffer

    def go(self, count: int, rate: float) -> None:
        """Begin to send."""
        cameras = [camera for camera in self.cameras if camera.in_session]
        step = 1.0 / (rate * len(cameras))
        begin = time.monotonic() + 0.01
        self.plan = (
            (begin + (turn * len(cameras) + place) * step, camera)
            for turn in range(count)
            for place, camera in enumerate(cameras)
        )
        self.next = next(self.plan, None)

    def send_result(self, camera: Camera) -> None:
        """Send a result, or half of it, or nothing more."""
        if camera.kept:
            return
        data = wire.result(RECORD.pack(time.monotonic_ns(), b"part", 0.97, 7, 0.1, 0.2, 0.5))
        if camera.stalls:
            data, camera.kept = data[:HALF], data[HALF:]
        with contextlib.suppress(OSError):
            camera.sock.sendall(data)


def main() -> None:
    """Print the port and serve."""
    allow_sockets()
    fleet = Fleet()
    print(fleet.server.getsockname()[1], flush=True)
    fleet.serve()


if __name__ == "__main__":
    main()
