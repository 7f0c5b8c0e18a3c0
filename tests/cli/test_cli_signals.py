"""Ctrl-C, SIGTERM, and a reader of stdout that goes away."""

from __future__ import annotations

import os
import signal
import subprocess
from typing import TYPE_CHECKING

import pytest
from commandline import (
    ACTIVE_21,
    CONNECT,
    DISCONNECT,
    HELLO_WORLD,
    INSPECTING,
    QUERY,
    SESSION,
    TRIGGER,
    WAITING,
    Peer,
)
from processes import PATIENCE, Process, script

if TYPE_CHECKING:
    from pathlib import Path

WORKING = {**SESSION, QUERY: ACTIVE_21 + HELLO_WORLD, TRIGGER: INSPECTING + HELLO_WORLD + WAITING}
"""A camera that sends a result by itself, and one for every trigger."""


@pytest.mark.parametrize(
    ("command", "number", "code"),
    [
        ("watch", signal.SIGINT, 0),
        ("watch", signal.SIGTERM, 143),
        ("trigger", signal.SIGINT, 130),
        ("trigger", signal.SIGTERM, 143),
    ],
)
def test_command_signal_says_disconnect(command: str, number: int, code: int) -> None:
    with (
        Peer(WORKING) as peer,
        Process("smartcam", command, peer.url, "--count", "1000000") as process,
    ):
        process.read_until(b"\n")
        process.send_signal(number)
        outcome = process.wait()
        peer.wait_last(DISCONNECT)
    assert (outcome.code, outcome.err) == (code, "")


def test_trigger_interrupted_while_it_waits_says_disconnect() -> None:
    with Peer(SESSION) as peer, Process("smartcam", "trigger", peer.url) as process:
        peer.wait_received(TRIGGER)
        process.send_signal(signal.SIGINT)
        outcome = process.wait()
        peer.wait_last(DISCONNECT)
    assert outcome == (130, "", "")


def test_status_interrupted_during_connect_says_disconnect() -> None:
    with Peer() as peer, Process("smartcam", "status", peer.url) as process:
        peer.wait_received(CONNECT)
        process.send_signal(signal.SIGINT)
        outcome = process.wait()
        peer.wait_last(DISCONNECT)
    assert outcome == (130, "", "")


def test_command_interrupted_during_import_exits_130(tmp_path: Path) -> None:
    (tmp_path / "click.py").write_text("raise KeyboardInterrupt\n", encoding="utf-8")
    env = {"PYTHONPATH": str(tmp_path)}
    with Process("smartcam", "protocols", env=env, fresh=True) as process:
        assert process.wait() == (130, "", "")


@pytest.mark.parametrize("command", ["trigger", "probe"])
def test_command_stdout_closed_ends_quietly_and_says_disconnect(command: str) -> None:
    more = ["--count", "1000000"] if command == "trigger" else []
    with Peer(WORKING) as peer, Process("smartcam", command, peer.url, *more) as process:
        process.close_stdout()
        outcome = process.wait()
        peer.wait_last(DISCONNECT)
    assert (outcome.code, outcome.err) == (0, "")


def test_trigger_into_head_ends_quietly() -> None:
    with Peer(WORKING) as peer:
        outcome = subprocess.run(  # noqa: S602 - a shell's pipe is what is tested
            '"$SMARTCAM" trigger "$URL" --count 1000000 --json | head -n 1',  # noqa: S607
            shell=True,
            env={**os.environ, "SMARTCAM": script("smartcam"), "URL": peer.url},
            capture_output=True,
            timeout=PATIENCE,
            check=True,
        )
        peer.wait_last(DISCONNECT)
    assert outcome.stdout.count(b"\n") == 1
    assert outcome.stderr == b""


def test_trigger_narrow_encoding_escapes_what_it_lacks() -> None:
    text = "Größe→".encode().ljust(20, b"\0")
    answers = {**WORKING, TRIGGER: INSPECTING + HELLO_WORLD[:-20] + text + WAITING}
    with (
        Peer(answers) as peer,
        Process(
            "smartcam", "trigger", peer.url, "--interpret-as", "t: string[20]",
            env={"PYTHONIOENCODING": "latin-1", "PYTHONUTF8": "0"}, fresh=True,
        ) as process,
    ):  # fmt: skip
        process.read_until(b"t = Gr\xf6\xdfe\\u2192\n")
