"""Latched endpoints that come and go while there are subscribers: nothing hangs."""

from __future__ import annotations

import asyncio
import sys
import textwrap
from pathlib import Path

import pytest

from tests.processes import free_place
from tests.ros2.roskit import PATIENCE

pytestmark = [pytest.mark.real_time, pytest.mark.long]

# In a process of its own: the engine's binding once held the interpreter while it waited for a
# thread that waited for the interpreter, and then nothing in the process runs any more.
PROGRAM = """
import asyncio, sys
from smartcam.ros2 import Node, QoS

LATCHED = QoS(latched=True, depth=1)
STRING = "std_msgs/msg/String"

async def main():
    place = sys.argv[1]
    async with (
        Node("here", listen=place) as here,
        Node("there", connect=place) as there,
        Node("same", context=here.context) as same,
    ):
        for n in range(100):
            says = [
                node.publisher(f"/s{i}", STRING, qos=LATCHED)
                for i in range(5)
                for node in (there, same)
            ]
            for one in says:
                one.publish(data="x")
                one.publish(data="y")
            hears = [here.subscribe(f"/s{i}", STRING, qos=LATCHED) for i in range(5)]
            if n % 2:
                await asyncio.sleep(0.001 * (n % 40))
            for one in (*says, *hears):
                one.close()
    print("done")

asyncio.run(main())
"""


async def test_latched_ends_come_and_go_without_end(tmp_path: Path) -> None:
    script = tmp_path / "churn.py"
    script.write_text(textwrap.dedent(PROGRAM))
    process = await asyncio.create_subprocess_exec(
        sys.executable, str(script), free_place(), stdout=asyncio.subprocess.PIPE
    )
    try:
        async with asyncio.timeout(10 * PATIENCE):
            out, _ = await process.communicate()
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    assert out.split() == [b"done"]
