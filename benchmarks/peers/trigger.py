"""A canned camera that answers triggers: status without Waiting, result, status with Waiting.

With ``together`` all that one read asks for is one write: a Query in front of the trigger is
answered in it, too. With ``apart`` it is answered with the first status; the result and the second
status come one by one, as a real camera's do: each after a moment, a delivery of its own. With
``udp`` each is a datagram of its own, one right behind the other.
"""

from __future__ import annotations

import itertools
import sys
import time
from typing import TYPE_CHECKING

from benchmarks.peers import wire
from benchmarks.peers.serving import listen, listen_to_datagrams, reads

if TYPE_CHECKING:
    import socket

PAUSE = 0.0004
"""Seconds between two messages that come apart; a real camera takes longer."""

FOUND = wire.result(b"".join(wire.localization(number) for number in range(5)))
ANSWERS = {
    wire.CONNECT: [wire.CONNECT_ANSWER, wire.status(waiting=True)],
    wire.QUERY: [wire.query_answer()],
    wire.TRIGGER: [wire.status(waiting=False), FOUND, wire.status(waiting=True)],
}


def main() -> None:
    """Answer triggers."""
    answers = ANSWERS
    if sys.argv[1:] == ["udp"]:
        listen_to_datagrams(answers)
    if sys.argv[1:] == ["together"]:
        answers = {message_id: [b"".join(parts)] for message_id, parts in ANSWERS.items()}

    def serve(client: socket.socket) -> None:
        for asked in reads(client):
            parts = [answers.get(message_id, []) for message_id, _ in asked]
            for number, said in enumerate(itertools.zip_longest(*parts, fillvalue=b"")):
                if number:
                    time.sleep(PAUSE)
                client.sendall(b"".join(said))

    listen(serve)


if __name__ == "__main__":
    main()
