"""A canned camera that runs free: as many results as asked for, as fast as the link takes them.

How many is the body of a Trigger frame (the peer's own word: a camera's Trigger has no body). With
the argument ``statuses`` each is between two: one without Waiting for Trigger, one with it, as of a
camera whose triggers come from a sensor.
"""

from __future__ import annotations

import functools
import sys
from typing import TYPE_CHECKING

from benchmarks.peers import wire
from benchmarks.peers.serving import frames, listen

if TYPE_CHECKING:
    import socket

RESULT = wire.result(bytes(range(70)))
RUN = wire.status(waiting=False) + RESULT + wire.status(waiting=True)
BURST = 512
"""Results in one write."""


def stream(client: socket.socket, one: bytes, count: int) -> None:
    """Send ``count`` results."""
    burst = one * BURST
    while count > 0:
        client.sendall(burst if count >= BURST else one * count)
        count -= BURST


def serve(one: bytes, client: socket.socket) -> None:
    """Answer one client until it goes; ``one`` result is these bytes."""
    for message_id, body in frames(client):
        match message_id:
            case wire.CONNECT:
                client.sendall(wire.CONNECT_ANSWER + wire.status(waiting=False))
            case wire.QUERY:
                client.sendall(wire.query_answer())
            case wire.TRIGGER:
                stream(client, one, int.from_bytes(body, "little"))


if __name__ == "__main__":
    listen(functools.partial(serve, RUN if sys.argv[1:] == ["statuses"] else RESULT))
