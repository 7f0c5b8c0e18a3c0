"""``frames features``, ``frames grab --trigger`` and ``frames force-address`` at a GigE camera."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path

import pytest

from tests.cli.commandline import run
from tests.frames.gige import camera as cameras
from tests.frames.gige.camera import Camera, camera

pytestmark = pytest.mark.real_time


async def command(*args: str) -> tuple[int, str, str]:
    """Run a command beside this loop, in which the camera lives."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "smartcam", *args,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    out, err = await process.communicate()
    assert process.returncode is not None
    return process.returncode, out.decode(), err.decode()


def url(there: Camera, query: str = "") -> str:
    return f"gige://127.0.0.1:{there.port}?packet_size=576{query}"


async def test_features_are_listed_set_and_saved() -> None:
    async with camera(heartbeat=30) as there:
        code, out, err = await command("frames", "features", url(there))
        assert (code, err) == (0, "")
        assert "Width = 64 (8 to 4096 in steps of 8)" in out.splitlines()
        set_both = ("black_level=1.23", "TriggerSource=Line1", "Width")
        code, out, err = await command(
            "frames", "features", url(there), *set_both, "--save", "UserSet1", "--json"
        )
        assert (code, err) == (0, "")
        said = [json.loads(line) for line in out.splitlines()]
        assert [(one["name"], one["value"]) for one in said] == [
            ("BlackLevel", 1.2), ("TriggerSource", "Line1"), ("Width", 64),
        ]  # fmt: skip
        assert there.kept[1][cameras.BLACK] == 12
        for wrong, text in (
            ("Widht=64", "did you mean 'Width'"),
            ("Width=100", "expected 8 to 4096 in steps of 8, got 100"),
        ):
            code, out, err = await command("frames", "features", url(there), wrong)
            assert (code, out) == (5, "")
            assert text in err


async def test_a_triggered_picture_is_written(tmp_path: Path) -> None:
    async with camera(heartbeat=30) as there:
        file = tmp_path / "part.npy"
        code, out, err = await command(
            *("frames", "grab", url(there, "&trigger=software"), "--trigger"),
            *("-o", str(file), "--count", "2", "--json"),
        )
        assert (code, err) == (0, "")
        said = [json.loads(line) for line in out.splitlines()]
        assert [one["sequence"] for one in said] == [there.exposed[1], there.exposed[2]]
        assert "names its block" in said[0]["evidence"][0]
        code, _, err = await command(
            "frames", "grab", url(there, "&trigger=off"), "--trigger", "-o", str(file)
        )
        assert code == 5
        assert "TriggerMode is Off" in err
        code, _, err = await command(
            *("frames", "grab", url(there, "&trigger=Line1"), "-o", str(file), "--timeout", "0.5")
        )
        assert code == 4
        assert "TriggerSource Line1, and nothing triggered it" in err


def test_an_address_is_not_forced_without_consent() -> None:
    outcome = run("frames", "force-address", "02:00:00:00:00:01", "10.0.0.5/24")
    assert outcome.code == 2
    assert "confirm with --yes" in outcome.err
    outcome = run("frames", "force-address", "02:00:00:00:00", "10.0.0.5/24", "--yes")
    assert outcome.code == 2
    assert "mac: expected a hardware address" in outcome.err
