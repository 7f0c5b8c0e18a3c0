"""Pictures on a disk that fills up and is cleared, in a mount namespace of its own.

Run as ``unshare -rm python -m tests.recording.full_disk_pictures FOLDER``; prints what came of it.
"""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import smartcam.frames
from smartcam.recording import RotatingRecorder
from tests.recording.folderkit import until
from tests.recording.full_disk import fill

DISK = 24 << 20


async def main(folder: Path) -> dict[str, Any]:
    """Fill the disk, clear it, and say which pictures were recorded."""
    told: list[str] = []
    ballast = folder / "ballast"
    recorder = RotatingRecorder(folder, size=2e6, on_trouble=lambda one: told.append(str(one)))
    with recorder:
        async with smartcam.frames.open("synthetic://?fps=20") as source:
            recording = asyncio.create_task(recorder.record(source, camera="left"))
            await until(lambda: "left" in recorder.counts and recorder.counts["left"].written)
            fill(ballast)
            await until(lambda: told and recorder.counts["left"].lost > 20)
            ballast.unlink()
            await until(lambda: len(told) == 2)
            before = recorder.counts["left"].written
            await until(lambda: recorder.counts["left"].written > before + 5)
            recording.cancel()
            await asyncio.wait([recording])
    async with smartcam.frames.open(f"{folder}#pace=none") as again:
        seen = [(frame.sequence, frame.lost) async for frame in again]
    return {"told": told, "counts": recorder.counts["left"]._asdict(), "seen": seen}


if __name__ == "__main__":
    place = Path(sys.argv[1])
    mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(place)]
    subprocess.run(mount, check=True)  # noqa: S603 - in our own namespace
    sys.stdout.write(json.dumps(asyncio.run(main(place))))
