"""A recorder on a disk that fills up and is cleared, in a mount namespace of its own.

Run as ``unshare -rm python -m tests.recording.full_disk FOLDER``; prints what came of it as JSON.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from smartcam.recording import FleetRecorder, load_recording
from tests.fleet.fleetkit import NumberedCamera
from tests.recording.folderkit import NAME, files, runs, section, server, until

GAP = "RecordingGap"


DISK = 12 << 20


def fill(ballast: Path) -> None:
    """Write to the disk's last byte."""
    descriptor = os.open(ballast, os.O_WRONLY | os.O_CREAT)
    try:
        for size in (1 << 16, 1 << 8):
            with contextlib.suppress(OSError):
                while True:
                    os.write(descriptor, bytes(size))
    finally:
        os.close(descriptor)


async def main(folder: Path) -> dict[str, Any]:
    """Fill the disk, clear it, and say what was recorded."""
    lines: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: lines.append(record.getMessage())  # type: ignore[method-assign]
    logging.getLogger("smartcam.recording").addHandler(handler)
    async with NumberedCamera(rate=300) as box:
        agent = server(folder, box.url)
        recorder = FleetRecorder(agent, section(size=1e6))
        async with recorder, agent:
            await until(lambda: NAME in recorder.counts and recorder.counts[NAME].written > 500)
            received = agent.shared_cameras[NAME].results.next_number
            ballast = folder / "rec" / "ballast"
            fill(ballast)
            await until(lambda: recorder.trouble is not None)
            told = str(recorder.trouble)
            await until(lambda: agent.shared_cameras[NAME].results.next_number > received + 600)
            at_full = [load_recording(path).counts.results for path in files(folder)]
            ballast.unlink()
            await until(lambda: recorder.trouble is None)
            healed = recorder.counts[NAME].written
            await until(lambda: recorder.counts[NAME].written > healed + 500)
            counts = recorder.counts[NAME]
        counts = recorder.counts[NAME]
        whole = load_recording(folder / "rec")
        return {
            "told": told,
            "lines": lines,
            "recorder_counts": counts._asdict(),
            "runs": runs(whole),
            "gaps": [one.records for one in whole.errors() if one.error == GAP],
            "counts": sum(whole.counts),
            "results while full": at_full,
        }


if __name__ == "__main__":
    place = Path(sys.argv[1])
    (place / "rec").mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(place / "rec")]
    subprocess.run(mount, check=True)  # noqa: S603 - in our own namespace
    sys.stdout.write(json.dumps(asyncio.run(main(place))))
