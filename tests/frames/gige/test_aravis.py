"""The driver against a camera of other people's: aravis' fake one, in a network namespace."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.frames.gige.in_namespace import PROGRAM

pytestmark = pytest.mark.long

FRAMES = 3000
"""The fake camera's ids begin at 65400 or so: they go round, which is at 65535."""


@pytest.fixture(scope="module")
def namespace() -> list[str]:
    """Return the command that runs another one in a namespace of its own."""
    for program, package in (
        (PROGRAM, "aravis-tools"),
        ("ip", "iproute2"),
        ("unshare", "util-linux"),
    ):
        if shutil.which(program) is None:
            pytest.skip(f"needs {program}: apt-get install {package}")
    for command in (["unshare", "-n"], ["unshare", "-r", "-n"]):
        if subprocess.run([*command, "true"], capture_output=True, check=False).returncode == 0:  # noqa: S603
            return command
    pytest.skip("needs network namespaces: unshare -n is not allowed here")


def read(
    namespace: list[str], frames: int, query: str, *arguments: str, binding: str = ""
) -> dict[str, Any]:
    done = subprocess.run(  # noqa: S603
        [*namespace, sys.executable, "-m", "tests.frames.gige.in_namespace", str(frames), query,
         *arguments],
        capture_output=True,
        check=False,
        timeout=120,
        cwd=Path(__file__).parents[3],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([*sys.path, binding])},
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


@pytest.fixture(scope="module")
def binding() -> str:
    """Return where aravis' binding is, for the Python that runs the tests."""
    for place in ("", "/usr/lib/python3/dist-packages"):
        found = subprocess.run(
            [sys.executable, "-c", "import gi; gi.require_version('Aravis', '0.8')"],
            capture_output=True,
            check=False,
            env=os.environ | {"PYTHONPATH": place},
        )
        if found.returncode == 0:
            return place
    pytest.skip(
        "needs aravis' binding for this Python: apt-get install gir1.2-aravis-0.8 python3-gi"
    )


def test_through_aravis_frames_are_whole(namespace: list[str], binding: str) -> None:
    query = "format=Mono8&size=320x64&fps=200&packet_size=1400&through=aravis"
    said = read(namespace, 600, query, binding=binding)
    assert said["format"] == "Mono8 320x64 at 200/s"
    assert "Fake FAKE01 is controlled by another application" in said["second"]
    assert said["wrong"] == []
    assert said["delivered"] > 300
    assert said["offered"] + said["lost"] == pytest.approx(said["span"], abs=5)


def test_with_packets_lost_frames_are_whole_or_counted(namespace: list[str]) -> None:
    """The fake camera drops packets, and sends none again."""
    said = read(namespace, 600, "format=Mono8&size=320x64&fps=200&packet_size=1400", "-r", "10")
    assert said["wrong"] == []
    assert said["lost"] > 20
    assert said["delivered"] > 100
    assert said["offered"] + said["lost"] == pytest.approx(said["span"], abs=5)
