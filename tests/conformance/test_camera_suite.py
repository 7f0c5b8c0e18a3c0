"""The camera suite under pytest: on the command line, as a subclass, broken off."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from smartcam._loop_thread import LoopThread
from smartcam.protocols import messages as m
from tests import ROOT
from tests.conformance import camera_sins
from tests.conformance.camera_world import emulated, loop_thread
from tests.conformance.pace import at_any_pace, slowed

pytestmark = pytest.mark.long

pytest_plugins = ["pytester"]

PLUGINS = ("-p", "no:cacheprovider", "-p", "no:asyncio")

PAGE = ROOT / "docs" / "judging-cameras.md"

PATIENCE = 300.0
"""Seconds; only what has gone wrong takes as long."""

FLAGS = re.DOTALL | re.MULTILINE

MAIN = """
import signal, sys, pytest

# a job in a script's background is started with Ctrl-C ignored, and so are its children
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.exit(pytest.main())
"""


def short() -> tuple[str, ...]:
    """Return short times, as options."""
    return ("--camera-silence", f"{slowed(0.05)}", "--camera-timeout", f"{slowed(2)}")


@pytest.fixture(scope="module")
def thread() -> Iterator[LoopThread]:
    with loop_thread() as thread:
        yield thread


@pytest.fixture
def folder(pytester: pytest.Pytester) -> pytest.Pytester:
    """Return a folder as a user has one, without settings of ours."""
    pytester.syspathinsert()
    return pytester


def start(folder: pytest.Pytester, *arguments: str) -> subprocess.Popen[str]:
    """Start pytest as a user does."""
    return subprocess.Popen(  # noqa: S603 - our own interpreter
        [sys.executable, "-c", MAIN, *PLUGINS, *arguments],
        cwd=folder.path,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        encoding="utf-8",
        env={**os.environ, "PYTHONPATH": str(folder.path), "COLUMNS": "200"},
    )


def run(folder: pytest.Pytester, *arguments: str) -> tuple[str, int]:
    """Run pytest in this process."""
    result = folder.runpytest_inprocess(*PLUGINS, "-rs", *arguments)
    return str(result.stdout), int(result.ret)


def in_package(folder: pytest.Pytester, *arguments: str) -> tuple[str, int]:
    return run(folder, "--pyargs", "smartcam.conformance.camera", *arguments)


def test_suite_without_a_camera_skips_and_says_what_to_type(folder: pytest.Pytester) -> None:
    printed, code = in_package(folder)
    assert code == 0
    assert "[65] " in printed
    assert (
        "no camera was named: pytest --pyargs smartcam.conformance.camera "
        "--camera-url bvs://HOST" in printed
    )
    assert "is it a BVS camera?" not in printed


@at_any_pace
def test_suite_reports_as_the_page_shows(folder: pytest.Pytester, thread: LoopThread) -> None:
    camera: dict[str, Any] = {
        "applications": [],
        "active": 21,
        "running": True,
        "quirks": {"overtriggered_time": 0.25, "switch_while_running": "ignore"},
    }
    report = folder.path / "ours.json"
    with emulated(thread, _complains_of_ids, **camera) as emulator:
        process = start(
            folder,
            *("--pyargs", "smartcam.conformance.camera", "--camera-url", emulator.url),
            *("--camera-report", str(report), *short()),
        )
        printed, _ = process.communicate(timeout=PATIENCE)
        assert (emulator.device.active_application, emulator.device.running) == (21, True)
    assert process.returncode == 1
    shown = re.search(r"^```text\n\$ pytest.*?\n(.*?)^```", PAGE.read_text(), FLAGS)
    assert shown is not None
    assert missing(shown[1].splitlines(), printed) is None, printed
    written = json.loads(report.read_text())
    assert written["quirks"]["switch_while_running"] == "ignore"
    assert [one["name"] for one in written["checks"] if one["outcome"] == "differs"] == [
        "unknown-id-is-ignored",
        "only-documented-messages-came",
    ]
    assert written["before"] == {"application": 21, "running": True}


def _complains_of_ids(emulator: Any) -> None:
    """Answer unknown ids, and nothing else that is wrong."""

    def change(emulator: Any, link: Any, message: m.Message) -> bool:
        if isinstance(message, m.UnknownMessage) and emulator.serves(link):
            answer = m.UnknownMessage(message_id=message.message_id, payload=b"\x13\0")
            camera_sins.write(emulator, link, answer)
        return False

    camera_sins.hears(change)(emulator)


def missing(shown: list[str], printed: str) -> str | None:
    """Return the first line shown that was not printed, numbers and addresses aside."""
    lines = iter([shape(one) for one in printed.splitlines()])
    for one in shown:
        if one.strip() and one != "..." and shape(one) not in lines:
            return one
    return None


def shape(line: str) -> str:
    line = re.sub(r"=+", "=", re.sub(r"bvs://[\d.:]+|[\w/.-]+\.json", "#", line))
    return re.sub(r"\b\d+\.\d+", "#", " ".join(line.split()))


@at_any_pace
def test_subclass_takes_its_address_from_class_or_fixture(
    folder: pytest.Pytester, thread: LoopThread
) -> None:
    with emulated(thread) as one, emulated(thread, dialect="b16", transport="udp") as other:
        folder.makepyfile(
            test_ours=f"""
import pytest
from smartcam.conformance.camera import CameraConformance

class TestByClass(CameraConformance):
    camera_url = {one.url!r}
    camera_options = {{"silence": {slowed(0.05)}}}

class TestByFixture(CameraConformance):
    camera_options = {{"silence": {slowed(0.05)}}}

    @pytest.fixture
    def camera_address(self):
        return {other.url!r}
"""
        )
        printed, code = run(folder, "test_ours.py", "-k", "query or newcomer", "-v")
    assert code == 0
    assert printed.count("smartcam: is it a BVS camera?") == 2
    assert f"camera: {one.url}" in printed
    assert f"camera: {other.url}" in printed
    assert "TestByClass::test_camera[newcomer-wins] SKIPPED (only" in printed
    assert "TestByFixture::test_camera[newcomer-wins] PASSED" in printed


def test_suite_in_a_worker_of_xdist_is_skipped_with_the_reason(folder: pytest.Pytester) -> None:
    folder.makeconftest("def pytest_configure(config):\n    config.workerinput = {}")
    url = ("--camera-url", "bvs://127.0.0.1:9")
    printed, code = in_package(folder, *url, "-k", "query", "-p", "no:xdist")
    assert code == 0
    assert "a camera serves one client, and pytest-xdist would start several: give -n0" in printed


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--camera-allow", "clocks"], "--camera-allow: 'clocks' is unknown; known are nothing,"),
        (["--camera-timeout", "x"], "--camera-timeout: could not convert string to float: 'x'"),
    ],
)
def test_suite_with_a_wrong_option_ends_with_one_line(
    folder: pytest.Pytester, arguments: list[str], text: str
) -> None:
    printed, code = in_package(folder, "--camera-url", "bvs://127.0.0.1:9", "-x", *arguments)
    assert code == pytest.ExitCode.USAGE_ERROR
    assert text in printed
    assert "Traceback" not in printed


@pytest.mark.skipif(sys.platform == "win32", reason="a POSIX signal")
def test_suite_that_is_broken_off_leaves_the_camera_as_it_was(
    folder: pytest.Pytester, thread: LoopThread
) -> None:
    with emulated(thread, running=True) as emulator:
        process = start(
            folder,
            *("--pyargs", "smartcam.conformance.camera", "--camera-url", emulator.url),
            *("--camera-silence", "60", "-k", "second-stop"),
        )
        thread.run_coroutine(
            lambda: emulator.wait_received(m.Stop, count=2, timeout=PATIENCE), timeout=2 * PATIENCE
        )
        assert not thread.call_function(lambda: emulator.device.running)
        process.send_signal(signal.SIGINT)
        printed, _ = process.communicate(timeout=PATIENCE)
        assert process.returncode == pytest.ExitCode.INTERRUPTED
        assert "at first: application 5, in run mode; restored" in printed
        assert thread.call_function(lambda: emulator.device.running)
        thread.run_coroutine(
            lambda: emulator.wait_received(m.Disconnect, count=3, timeout=PATIENCE),
            timeout=2 * PATIENCE,
        )
