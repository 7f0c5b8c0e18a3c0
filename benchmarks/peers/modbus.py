"""A canned Modbus TCP server: every read of holding registers gets the same registers."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from benchmarks.peers.serving import listen

if TYPE_CHECKING:
    import socket

HEADER = struct.Struct(">HHHB")  # transaction, protocol, length of what follows, unit


def serve(client: socket.socket) -> None:
    """Answer one client until it goes."""
    buffer = b""
    while data := client.recv(4096):
        buffer += data
        while len(buffer) >= HEADER.size:
            transaction, _, length, unit = HEADER.unpack_from(buffer)
            request, buffer = buffer[: 6 + length], buffer[6 + length :]
            function, _, count = struct.unpack(">BHH", request[7:12])
            words = struct.pack(f">BB{count}H", function, 2 * count, *range(count))
            client.sendall(HEADER.pack(transaction, 0, len(words) + 1, unit) + words)
    client.close()


if __name__ == "__main__":
    listen(serve)
