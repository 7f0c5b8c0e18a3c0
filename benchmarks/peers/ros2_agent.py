"""A fleet's agent whose cameras may be nodes of ROS 2, too.

``python -m benchmarks.peers.ros2_agent CAMERAS PORT HOW``: so many at one port on 127.0.0.1; HOW is
``ros`` or ``plain``. CPU time as :mod:`benchmarks.peers.control` tells it; where programs find the
agent is the only port that is served.
"""

from __future__ import annotations

import asyncio
import sys
from typing import Any

import smartcam.fleet
from benchmarks.peers.control import resident, serve_control
from benchmarks.peers.ros2_end import DOMAIN
from smartcam.fleet import FleetFile

__all__ = ["camera_name"]


def camera_name(number: int) -> str:
    """Return the name of one, which is the node's, too."""
    return f"cam{number}"


async def main() -> None:
    """Share the cameras."""
    before = resident()
    count, port, how = int(sys.argv[1]), sys.argv[2], sys.argv[3]
    camera = {
        "url": f"bvs://127.0.0.1:{port}?dialect=handbook",
        "interpret_as": "localizations",
    }
    file: dict[str, Any] = {
        "listen": "tcp/127.0.0.1:0",
        "cameras": {camera_name(number): camera for number in range(count)},
    }
    if how == "ros":
        file["ros2"] = {"domain": DOMAIN}
    async with smartcam.fleet.serve(FleetFile.model_validate(file)) as server:
        await server.wait_first_attempts()
        await serve_control([server.address.port], before)


if __name__ == "__main__":
    asyncio.run(main())
