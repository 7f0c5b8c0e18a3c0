"""A fleet's agent in a process of its own: ``python -m benchmarks.peers.agent NAME=PORT ...``.

Each is a camera's name, and its port on 127.0.0.1. CPU time as :mod:`benchmarks.peers.control`
tells it; where programs find the agent is the only port that is served.
"""

from __future__ import annotations

import asyncio
import sys

import smartcam.fleet
from benchmarks.peers.control import resident, serve_control
from smartcam.fleet import FleetFile

__all__ = ["fleet_file"]


HISTORY = 250_000
"""Results that the agent keeps: a whole round, so that none is lost on a machine that is busy."""


def fleet_file(cameras: dict[str, int]) -> FleetFile:
    """Return a fleet of cameras, by their ports."""
    urls = {name: f"bvs://127.0.0.1:{port}?dialect=handbook" for name, port in cameras.items()}
    return FleetFile.model_validate(
        {
            "listen": "tcp/127.0.0.1:0",
            "history": {"results": HISTORY, "bytes": 100 * HISTORY},
            "cameras": {name: {"url": url} for name, url in urls.items()},
        }
    )


async def main() -> None:
    """Share the cameras."""
    before = resident()
    cameras = [one.split("=") for one in sys.argv[1:]]
    file = fleet_file({name: int(port) for name, port in cameras})
    async with smartcam.fleet.serve(file) as server:
        await server.wait_first_attempts()
        await serve_control([server.address.port], before)


if __name__ == "__main__":
    asyncio.run(main())
