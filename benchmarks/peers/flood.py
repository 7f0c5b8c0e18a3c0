"""A canned camera that floods: the same burst again and again, as fast as the link takes it.

``FLOOD`` is the peer's own word: its body says of what, one of ``BURSTS``; without one it ends.
``ASIDE`` is the same, but nobody gets it: a thread of this process takes it from another socket.
Whatever else is asked for is answered between two bursts: behind an answer nothing comes of what
was sent before. It gives way to other processes, so that what it costs them is not its own work.
"""

from __future__ import annotations

import contextlib
import os
import queue
import socket
import threading

from benchmarks.peers import wire
from benchmarks.peers.serving import frames, listen

__all__ = ["ASIDE", "FLOOD"]

FLOOD = 0x7003
ASIDE = 0x7004

SEND_BUFFER = 256 * 1024
"""Bytes that the system keeps: those under way when the flood ends have to be read, too."""

BURSTS = {
    "statuses": (wire.status(waiting=False) + wire.status(waiting=True)) * 400,
    "results of 40 bytes": wire.result(bytes(40)) * 200,
    "results with 5 localizations": 30
    * wire.result(b"".join(wire.localization(number) for number in range(5))),
}
"""What one write has."""

ANSWERS = {
    wire.CONNECT: wire.CONNECT_ANSWER + wire.status(waiting=True),
    wire.QUERY: wire.query_answer(),
}

Asked = queue.SimpleQueue[tuple[int, bytes]]


def speak(client: socket.socket, asked: Asked) -> None:
    """Answer what is asked, and flood in between, until the client goes."""
    burst, taker = b"", client
    aside, drain = socket.socketpair()
    threading.Thread(target=swallow, args=(drain,), daemon=True).start()
    with contextlib.suppress(OSError), aside:
        while True:
            if burst and asked.empty():
                taker.sendall(burst)
                continue
            message_id, body = asked.get()
            if message_id in (FLOOD, ASIDE):
                burst = BURSTS[body.decode()] if body else b""
                taker = client if message_id == FLOOD else aside
            client.sendall(ANSWERS.get(message_id, b""))


def swallow(drain: socket.socket) -> None:
    """Take a flood as a client would, 32 KiB at a time."""
    with drain:
        while drain.recv(32 * 1024):
            pass


def serve(client: socket.socket) -> None:
    """Hear one client until it goes."""
    client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
    asked: Asked = queue.SimpleQueue()
    threading.Thread(target=speak, args=(client, asked), daemon=True).start()
    with contextlib.suppress(OSError):
        for frame in frames(client):
            asked.put(frame)


if __name__ == "__main__":
    os.nice(19)
    listen(serve)
