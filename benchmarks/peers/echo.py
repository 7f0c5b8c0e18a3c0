"""What answers at once: ``python -m benchmarks.peers.echo zenoh``, or ``tcp``.

What begins with a number, of eight bytes, little endian, asks for so many batches; 0 for an answer.
CPU time as :mod:`benchmarks.peers.control` tells it; where it listens is the only port served.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import threading
from typing import Any, cast

from benchmarks.peers import wire
from benchmarks.peers.control import resident, serve_control
from benchmarks.yardsticks import BUFFER, Bare
from smartcam._zenoh import RUNTIME, with_ports

__all__ = ["BATCH", "REPLY", "RESULTS", "Zenoh", "asking", "zenoh_session"]

LENGTH = 200
REPLY = wire.result(bytes(600))
"""Questions and answers have about the bytes of a trigger's call, and of its reply."""

RESULTS = 256
BATCH = wire.result(bytes(range(70))) * RESULTS
"""Results that go out together."""

ASK, ANSWER = "bench/ask", "bench/answer"


def asking(batches: int) -> bytes:
    """Return what asks for batches, or with 0 for an answer."""
    return batches.to_bytes(8, "little") + bytes(LENGTH - 8)


def zenoh_session(listen: str = "", connect: str = "") -> Any:
    """Return a session with the fleet's engine settings.

    Args:
        listen: endpoint to listen on.
        connect: endpoint to connect to instead.
    """
    os.environ.setdefault("ZENOH_RUNTIME", RUNTIME)
    import zenoh

    config = zenoh.Config()
    for path, value in {
        "mode": "router" if listen else "client",
        "listen/endpoints": [listen] if listen else [],
        "connect/endpoints": [connect] if connect else [],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


class Zenoh:
    """A bare session, with the fleet's engine settings: what comes is told in the engine's thread.

    Args:
        listen: endpoint to listen on.
        connect: endpoint to connect to instead.
    """

    def __init__(self, listen: str = "", connect: str = "") -> None:
        self._session = zenoh_session(listen, connect)
        import zenoh

        self._zenoh = zenoh
        own, other = (ANSWER, ASK) if listen else (ASK, ANSWER)
        self._publisher: Any = self._declare(own, express=True)
        self._batches: Any = self._declare(own, express=False)
        hear = zenoh.handlers.Callback(self._hear, indirect=False)
        self._subscriber: Any = self._session.declare_subscriber(other, cast("Any", hear))
        self._come = threading.Event()
        self._missing = 0

    def _declare(self, key: str, *, express: bool) -> Any:
        control = self._zenoh.CongestionControl.BLOCK
        return self._session.declare_publisher(key, express=express, congestion_control=control)

    def _hear(self, sample: Any) -> None:
        payload = sample.payload.to_bytes()
        if self._missing:
            self._missing -= 1
            if not self._missing:
                self._come.set()
        else:
            batches = int.from_bytes(payload[:8], "little")
            if batches:  # a thread of its own, as it may wait
                threading.Thread(target=self._stream, args=(batches,)).start()
            else:
                self._publisher.put(REPLY)

    def _stream(self, batches: int) -> None:
        for _ in range(batches):
            self._batches.put(BATCH)

    def ask(self, batches: int = 0) -> None:
        """Ask, and wait for what comes."""
        self._come.clear()
        self._missing = batches or 1
        self._publisher.put(asking(batches))
        if not self._come.wait(30.0):
            raise TimeoutError(f"{self._missing} messages did not come within 30 s")

    def close(self) -> None:
        """End the session."""
        cast("Any", self._session).close()


class Echo(Bare):
    """The same over TCP."""

    def __init__(self) -> None:
        super().__init__()
        self._left, self._paused = 0, False

    def buffer_updated(self, size: int) -> None:
        """asyncio: bytes."""
        batches = int.from_bytes(BUFFER[:8], "little")
        if batches:
            self._left += batches
            self.resume_writing()
        else:
            self.transport.write(REPLY)

    def pause_writing(self) -> None:
        """asyncio: the transport has enough."""
        self._paused = True

    def resume_writing(self) -> None:
        """asyncio: it takes more."""
        self._paused = False
        while self._left and not self._paused:
            self._left -= 1
            self.transport.write(BATCH)


async def main() -> None:
    """Answer."""
    before = resident()
    if sys.argv[1] == "zenoh":
        (endpoint,) = with_ports(["tcp/127.0.0.1:0"])
        session = Zenoh(listen=endpoint)
        await serve_control([int(endpoint.rpartition(":")[2])], before)
        session.close()
    else:
        server = await asyncio.get_running_loop().create_server(Echo, "127.0.0.1", 0)
        await serve_control([server.sockets[0].getsockname()[1]], before)


if __name__ == "__main__":
    asyncio.run(main())
