"""The server of OPC UA against node-opcua's client, another implementation of the standard."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
from pathlib import Path

import pytest

pytest.importorskip("asyncua")

from tests.outlets.opcuakit import plc
from tests.outlets.test_opcua import ready

NODE = shutil.which("node")
FOLDER = Path(os.environ.get("SMARTCAM_NODE_OPCUA", "/usr/local/lib/node_modules"))
"""Folder of npm's packages."""

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.long,
    pytest.mark.skipif(
        NODE is None or not (FOLDER / "node-opcua-client").is_dir(),
        reason="needs npm's node-opcua-client: npm install --global node-opcua-client, or in "
        "another folder, its node_modules in SMARTCAM_NODE_OPCUA",
    ),
]


async def test_node_opcua_starts_a_job_hears_of_it_and_reads_its_structures(tmp_path: Path) -> None:
    judge = Path(__file__).parent / "opcua_judge.mjs"
    async with ready(tmp_path, recipes={"housing": 1}) as (there, _), plc(there.url):
        process = await asyncio.create_subprocess_exec(
            *(str(NODE), str(judge), there.url, str(FOLDER), "line1/cam1"),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        try:
            async with asyncio.timeout(300):
                out, err = await process.communicate()
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
    assert process.returncode == 0, err.decode()
    (text,) = [one for one in out.splitlines() if one.startswith(b"{")]  # beside remarks
    said = json.loads(text)
    job, error = said["started"]
    event = said["event"]
    assert error == 0
    assert event["JobId"]["id"] == job["id"] != ""
    assert (event["MeasId"]["id"], said["meas"]["id"]) == ("node", "node")
    assert (event["ResultState"], event["IsPartial"], event["IsSimulated"]) == (1, False, True)
    recipes = event["ExternalRecipeId"]["id"], event["InternalRecipeId"]["id"]
    assert recipes == ("housing", "1")
    (record,) = said["content"]
    assert (record["passed"], record["count"], record["code"]) == (True, 1, "AB")
    assert record["x"] == pytest.approx(0.0125)
