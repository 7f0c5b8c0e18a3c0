"""A canned camera with large result containers, sent in segments of a given size.

The body of a Trigger frame says how large, in what segments and how many, three numbers of four
bytes (the peer's own word). They come one at a time, as inspections give them. Blocking sockets, a
thread for each client.
"""

from __future__ import annotations

import functools
import socket
import struct
import threading
import time

from benchmarks.peers import wire

PAUSE = 0.0005
"""Seconds before each container."""


@functools.cache
def segments(size: int, segment: int) -> list[bytes]:
    """Return a container of ``size`` bytes, cut."""
    frame = wire.result(bytes(range(256)) * (size // 256) + bytes(size % 256))
    return [frame[start : start + segment] for start in range(0, len(frame), segment)]


def serve(client: socket.socket) -> None:
    """Answer one client until it goes."""
    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    buffer = b""
    while data := client.recv(4096):
        buffer += data
        while len(buffer) >= wire.HEADER.size:
            _, length, message_id = wire.HEADER.unpack_from(buffer)
            end = wire.HEADER.size + length
            if len(buffer) < end:
                break
            body, buffer = buffer[wire.HEADER.size : end], buffer[end:]
            if message_id == wire.CONNECT:
                client.sendall(wire.CONNECT_ANSWER + wire.status(waiting=False))
            elif message_id == wire.QUERY:
                client.sendall(wire.query_answer())
            elif message_id == wire.TRIGGER:
                size, segment, count = struct.unpack("<III", body)
                for _ in range(count):
                    time.sleep(PAUSE)
                    for piece in segments(size, segment):
                        client.sendall(piece)
    client.close()


def main() -> None:
    """Print the port and serve."""
    server = socket.create_server(("127.0.0.1", 0), backlog=64)
    print(server.getsockname()[1], flush=True)
    while True:
        client, _ = server.accept()
        threading.Thread(target=serve, args=(client,), daemon=True).start()


if __name__ == "__main__":
    main()
