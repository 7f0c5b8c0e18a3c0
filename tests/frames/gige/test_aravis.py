"""The driver against a camera of other people's: aravis' fake one, in a network namespace."""

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
"""The fake camera's ids begin at 65400 or so: they go round, which is at 65535."""


@pytest.fixture(scope="module")
def namespace() -> list[str]:
    """Return the command that runs another one in a namespace of its own."""
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
    said: dict[str, Any] = json.loads(done.stdout)
    return said


def test_thousands_of_frames_are_whole(namespace: list[str]) -> None:
    said = read(namespace, FRAMES, "format=Mono8&size=320x64&fps=500&packet_size=1400")
    assert said["found"] == ["gige://127.0.0.1 Aravis Fake (FAKE01)"]
    assert said["format"] == "Mono8 320x64 at 500/s"
    assert "Fake FAKE01 is controlled by another application" in said["second"]
    assert said["wrong"] == []
    assert said["offered"] + said["lost"] >= FRAMES
    assert said["delivered"] > FRAMES // 20


def test_with_packets_lost_frames_are_whole_or_counted(namespace: list[str]) -> None:
    """The fake camera drops packets, and sends none again."""
    said = read(namespace, 600, "format=Mono8&size=320x64&fps=200&packet_size=1400", "-r", "10")
    assert said["wrong"] == []
    assert said["lost"] > 20
    assert said["delivered"] > 100
    assert said["offered"] + said["lost"] == pytest.approx(said["span"], abs=5)


def test_triggers_have_each_their_own_picture(namespace: list[str]) -> None:
    """The fake camera takes a software trigger 25 times a second, and counts its pictures on."""
    said = read(namespace, 0, "format=Mono8&size=320x64&packet_size=1400&trigger=Software")
    assert said["wrong"] == []
    first, *others = said["sequences"]
    assert others == list(range(first + 1, first + 20))
    assert said["started"] == 1
