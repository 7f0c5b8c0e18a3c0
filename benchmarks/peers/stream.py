"""A canned camera that runs free: as many results as asked for, as fast as the link takes them.

How many is the body of a Trigger frame (the peer's own word: a camera's Trigger has no body).
Blocking sockets, a thread for each client.
"""

from __future__ import annotations

import socket
import threading

from benchmarks.peers import wire

RESULT = wire.result(bytes(range(70)))
BURST = 512
"""Results in one write."""


def stream(client: socket.socket, count: int) -> None:
    """Send ``count`` results."""
    burst = RESULT * BURST
    while count > 0:
        client.sendall(burst if count >= BURST else RESULT * count)
        count -= BURST


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
                stream(client, int.from_bytes(body, "little"))
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
