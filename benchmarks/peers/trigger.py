"""A canned camera that answers triggers: status without Waiting, result, status with Waiting.

With ``apart`` they come one by one, as a real camera's do: the next after a moment, each a delivery
of its own. With ``together`` they are one write.
"""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING

from benchmarks.peers import wire
from benchmarks.peers.serving import frames, listen

if TYPE_CHECKING:
    import socket

PAUSE = 0.0004
"""Seconds between two messages that come apart; a real camera takes longer."""

FOUND = wire.result(b"".join(wire.localization(number) for number in range(5)))
ANSWERS = {
    wire.CONNECT: [wire.CONNECT_ANSWER + wire.status(waiting=True)],
    wire.QUERY: [wire.query_answer()],
    wire.TRIGGER: [wire.status(waiting=False), FOUND, wire.status(waiting=True)],
}


def main() -> None:
    """Answer triggers."""
    answers = ANSWERS
    if sys.argv[1:] == ["together"]:
        answers = {message_id: [b"".join(parts)] for message_id, parts in ANSWERS.items()}

    def serve(client: socket.socket) -> None:
        for message_id, _ in frames(client):
            for number, answer in enumerate(answers.get(message_id, ())):
                if number:
                    time.sleep(PAUSE)
                client.sendall(answer)

    listen(serve)


if __name__ == "__main__":
    main()
