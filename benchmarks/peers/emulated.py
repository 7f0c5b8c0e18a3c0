"""Emulated cameras in one process, each on a port of its own; all run one triggered application.

``python -m benchmarks.peers.emulated CAMERAS PROCESSING_TIME SOURCE``: the time in seconds; SOURCE
is ``constant``, or ``generator``, a function that gives the same values.
"""

from __future__ import annotations

import asyncio
import sys
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any

from benchmarks.peers import wire
from benchmarks.peers.canned import CONTAINER, SPARE_FILES
from benchmarks.peers.control import allow_files, resident, serve_control
from smartcam.emulator import Application, EmulatedCamera

if TYPE_CHECKING:
    from collections.abc import Mapping

LAYOUT = (
    "(feature_id: string[50], quality: real32, photo_index: int32, "
    "x: real32, y: real32, theta: real32)*"
)
NAMES = ("quality", "photo_index", "x", "y", "theta")
FOUND = [
    {"feature_id": name.rstrip(b"\0").decode(), **dict(zip(NAMES, values, strict=True))}
    for name, *values in wire.RECORD.iter_unpack(CONTAINER)
]
SOURCES: Mapping[str, Mapping[str, Any]] = {
    "constant": {"constant": FOUND},
    "generator": {"generator": lambda run: FOUND},
}


async def main() -> None:
    """Serve, print the control port."""
    cameras, processing_time, source = int(sys.argv[1]), float(sys.argv[2]), sys.argv[3]
    allow_files(2 * cameras + SPARE_FILES)
    program = Application(
        id=wire.APPLICATION, layout=LAYOUT, processing_time=processing_time, **SOURCES[source]
    )
    async with AsyncExitStack() as stack:
        # what the first one brings with it is not counted as its memory
        async with EmulatedCamera([program], builtins=False, running=True):
            before = resident()
        ports: list[int] = []
        for _ in range(cameras):
            camera = EmulatedCamera([program], builtins=False, running=True)
            await stack.enter_async_context(camera)
            ports.append(camera.port)
        await serve_control(ports, before)


if __name__ == "__main__":
    asyncio.run(main())
