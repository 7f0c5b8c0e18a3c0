"""A canned camera that runs free: as many results as asked for, as fast as the link takes them.

How many is the body of a Trigger frame (the peer's own word: a camera's Trigger has no body).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from benchmarks.peers import wire
from benchmarks.peers.serving import frames, listen

if TYPE_CHECKING:
    import socket

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
    for message_id, body in frames(client):
        match message_id:
            case wire.CONNECT:
                client.sendall(wire.CONNECT_ANSWER + wire.status(waiting=False))
            case wire.QUERY:
                client.sendall(wire.query_answer())
            case wire.TRIGGER:
                stream(client, int.from_bytes(body, "little"))


if __name__ == "__main__":
    listen(serve)
