"""Write the table of the fast tests again, in the machine with video devices::

OUT=tests/frames/v4l2 python -m tests.frames.vivid.machine run tests/frames/vivid/record.py
"""

from __future__ import annotations

import asyncio
from pathlib import Path

import smartcam.frames
from tests.frames.inside import discovery, system
from tests.frames.v4l2.conversations import WRAPPED, Recorder
from tests.frames.v4l2.scenarios import FEW, SCENARIOS


async def record() -> str:
    await smartcam.frames.discover("v4l2")  # its imports are files of the other computer
    recorder = Recorder()
    setattr(discovery, "FORMATS", FEW)  # noqa: B010 - it is constant to others
    for name in WRAPPED:
        setattr(system, name, getattr(recorder, name))
    for name, scenario in SCENARIOS.items():
        recorder.begin(name)
        await scenario()
    return recorder.table()


Path("/run/out/vivid.json").write_text(asyncio.run(record()))
