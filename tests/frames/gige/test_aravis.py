"""Test the driver with another project's camera: aravis' fake one, in a network namespace."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.frames.gige.in_namespace import PROGRAM
from tests.processes import network_namespace

pytestmark = pytest.mark.long

FRAMES = 3000
"""The fake camera's ids begin near 65400, and restart after 65535."""


@pytest.fixture(scope="module")
def namespace() -> list[str]:
    """Return the command that runs another command in its own namespace."""
    return network_namespace(PROGRAM, "aravis-tools")


def read(namespace: list[str], frames: int, query: str, *arguments: str) -> dict[str, Any]:
    done = subprocess.run(  # noqa: S603
        [*namespace, sys.executable, "-m", "tests.frames.gige.in_namespace", str(frames), query,
         *arguments],
        capture_output=True,
        check=False,
        timeout=120,
        cwd=Path(__file__).parents[3],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr.decode()
    output: dict[str, Any] = json.loads(done.stdout)
    return output


def test_thousands_of_frames_are_whole(namespace: list[str]) -> None:
    output = read(namespace, FRAMES, "format=Mono8&size=320x64&fps=500&packet_size=1400")
    assert output["found"] == ["gige://127.0.0.1 Aravis Fake (FAKE01)"]
    assert output["format"] == "Mono8 320x64 at 500/s"
    assert "Fake FAKE01 is controlled by another application" in output["second"]
    assert output["wrong"] == []
    assert output["offered"] + output["lost"] >= FRAMES
    assert output["delivered"] > FRAMES // 20


def test_with_packets_lost_frames_are_whole_or_counted(namespace: list[str]) -> None:
    """The fake camera drops packets, and resends none."""
    output = read(namespace, 600, "format=Mono8&size=320x64&fps=200&packet_size=1400", "-r", "10")
    assert output["wrong"] == []
    assert output["lost"] > 20
    assert output["delivered"] > 100
    assert output["offered"] + output["lost"] == pytest.approx(output["span"], abs=5)


def test_each_trigger_has_its_own_picture(namespace: list[str]) -> None:
    """The fake camera accepts 25 software triggers a second, and numbers its pictures on."""
    output = read(namespace, 0, "format=Mono8&size=320x64&packet_size=1400&trigger=Software")
    assert output["wrong"] == []
    first, *others = output["sequences"]
    assert others == list(range(first + 1, first + 20))
    assert output["started"] == 1
