"""A canned camera that answers triggers: status without Waiting, result, status with Waiting.

With ``apart`` they come one by one, as a real camera's do: the next after a moment, each a delivery
of its own. With ``together`` they are one write. Blocking sockets, a thread for each client.
"""

from __future__ import annotations

import socket
import sys
import threading
import time

from benchmarks.peers import wire

PAUSE = 0.0004
"""Seconds between two messages that come apart; a real camera takes longer."""

FOUND = wire.result(b"".join(wire.localization(number) for number in range(5)))
ANSWERS = {
    wire.CONNECT: [wire.CONNECT_ANSWER + wire.status(waiting=True)],
    wire.QUERY: [wire.query_answer()],
    wire.TRIGGER: [wire.status(waiting=False), FOUND, wire.status(waiting=True)],
}


def serve(client: socket.socket, answers: dict[int, list[bytes]]) -> None:
    """Answer one client until it goes."""
    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    buffer = b""
    while data := client.recv(4096):
        buffer += data
        while len(buffer) >= wire.HEADER.size:
            _, length, message_id = wire.HEADER.unpack_from(buffer)
            buffer = buffer[wire.HEADER.size + length :]
            for number, answer in enumerate(answers.get(message_id, ())):
                if number:
                    time.sleep(PAUSE)
                client.sendall(answer)
    client.close()


def main() -> None:
    """Print the port and serve."""
    answers = ANSWERS
    if sys.argv[1:] == ["together"]:
        answers = {message_id: [b"".join(parts)] for message_id, parts in ANSWERS.items()}
    server = socket.create_server(("127.0.0.1", 0), backlog=64)
    print(server.getsockname()[1], flush=True)
    while True:
        client, _ = server.accept()
        threading.Thread(target=serve, args=(client, answers), daemon=True).start()


if __name__ == "__main__":
    main()
