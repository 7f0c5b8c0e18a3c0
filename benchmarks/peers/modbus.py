"""A canned Modbus TCP server: every read of holding registers gets the same registers."""

from __future__ import annotations

import socket
import struct
import threading

HEADER = struct.Struct(">HHHB")  # transaction, protocol, length of what follows, unit


def serve(client: socket.socket) -> None:
    """Answer one client until it goes."""
    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
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


def main() -> None:
    """Print the port and serve."""
    server = socket.create_server(("127.0.0.1", 0), backlog=64)
    print(server.getsockname()[1], flush=True)
    while True:
        client, _ = server.accept()
        threading.Thread(target=serve, args=(client,), daemon=True).start()


if __name__ == "__main__":
    main()
