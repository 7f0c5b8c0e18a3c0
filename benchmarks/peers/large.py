"""A canned camera with large result containers, sent in segments of a given size.

The body of a Trigger frame says how large, in what segments and how many, three numbers of four
bytes (the peer's own word). They come one at a time, as inspections give them; with the argument
``flat`` one right behind the other.
"""

from __future__ import annotations

import functools
import struct
import sys
import time
from typing import TYPE_CHECKING

from benchmarks.peers import wire
from benchmarks.peers.serving import frames, listen

if TYPE_CHECKING:
    import socket

PAUSE = 0.0005
"""Seconds before each container."""


@functools.cache
def segments(size: int, segment: int) -> list[bytes]:
    """Return a container of ``size`` bytes, cut."""
    frame = wire.result(bytes(range(256)) * (size // 256) + bytes(size % 256))
    return [frame[start : start + segment] for start in range(0, len(frame), segment)]


def serve(pause: float, client: socket.socket) -> None:
    """Answer one client until it goes."""
    for message_id, body in frames(client):
        match message_id:
            case wire.CONNECT:
                client.sendall(wire.CONNECT_ANSWER + wire.status(waiting=False))
            case wire.QUERY:
                client.sendall(wire.query_answer())
            case wire.TRIGGER:
                size, segment, count = struct.unpack("<III", body)
                for _ in range(count):
                    if pause:
                        time.sleep(pause)
                    for piece in segments(size, segment):
                        client.sendall(piece)


if __name__ == "__main__":
    listen(functools.partial(serve, 0.0 if sys.argv[1:] == ["flat"] else PAUSE))
