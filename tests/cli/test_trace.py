"""``--trace``: every frame as a line of JSON."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from tests.cli.commandline import (
    ACTIVE_21,
    BUSY,
    CONNECT,
    CONNECTED,
    DISCONNECT,
    INSPECTING,
    QUERY,
    SESSION,
    START,
    STOPPED,
    SWITCH_5,
    SWITCHED_5,
    TRIGGER,
    WAITING,
    Peer,
    run,
    run_as_far_as,
)

RESULT_5 = bytes.fromhex("50535642 05000000 20000000 05000000 2a")

CAMERA = {
    CONNECT: CONNECTED + STOPPED,
    QUERY: ACTIVE_21,
    SWITCH_5: BUSY + STOPPED + SWITCHED_5,
    START: WAITING,
    TRIGGER: INSPECTING + RESULT_5,
}

CONVERSATION: list[tuple[str, str, dict[str, Any], bytes]] = [
    (">", "Disconnect", {}, DISCONNECT),
    (">", "Connect", {}, CONNECT),
    ("<", "ConnectAnswer", {"version": 1}, CONNECTED),
    ("<", "StatusReport", {"status": [], "endian": 0}, STOPPED),
    (">", "Query", {}, QUERY),
    ("<", "QueryAnswer", {"application": 21}, ACTIVE_21),
    (">", "Query", {}, QUERY),
    ("<", "QueryAnswer", {"application": 21}, ACTIVE_21),
    (">", "SwitchApplication", {"application": 5}, SWITCH_5),
    ("<", "StatusReport", {"status": ["BUSY"], "endian": 0}, BUSY),
    ("<", "StatusReport", {"status": [], "endian": 0}, STOPPED),
    ("<", "SwitchAnswer", {"code": 0, "application": 5}, SWITCHED_5),
    (">", "Start", {}, START),
    ("<", "StatusReport", {"status": ["RUNNING", "WAITING_FOR_TRIGGER"], "endian": 0}, WAITING),
    (">", "Query", {}, QUERY),  # exactly one inspection has to begin between the two answers
    (">", "Trigger", {}, TRIGGER),
    (">", "Query", {}, QUERY),
    ("<", "QueryAnswer", {"application": 21}, ACTIVE_21),
    ("<", "StatusReport", {"status": ["RUNNING"], "endian": 0}, INSPECTING),
    ("<", "ResultContainer", {"application": 5, "data": "2a"}, RESULT_5),
    ("<", "QueryAnswer", {"application": 21}, ACTIVE_21),
    (">", "Disconnect", {}, DISCONNECT),
]


def entries(path: Path) -> list[dict[str, Any]]:
    """Return the lines of a trace file."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def test_trace_trigger_has_every_frame_with_golden_bytes(tmp_path: Path) -> None:
    path = tmp_path / "trace.jsonl"
    with Peer(CAMERA) as peer:
        run("trigger", peer.url, "--application", "5", "--trace", str(path)).done()
        name = peer.host_and_port
    trace = entries(path)
    assert [
        (e["direction"], e["message"], e["fields"], bytes.fromhex(e["hex"])) for e in trace
    ] == CONVERSATION
    assert [e["message_id"] for e in trace] == [frame[8] for *_, frame in CONVERSATION]
    assert {e["camera"] for e in trace} == {name}
    times = [datetime.fromisoformat(e["at"]) for e in trace]
    assert times == sorted(times)


def test_trace_broken_bytes_are_marked(tmp_path: Path) -> None:
    path = tmp_path / "trace.jsonl"
    with Peer({**SESSION, TRIGGER: b"garbage"}) as peer:
        run("trigger", peer.url, "--trace", str(path)).failed(3, "wrong magic number")
    (broken,) = [entry for entry in entries(path) if entry["direction"] == "!"]
    assert broken["hex"].startswith(b"garbage".hex())  # the next answer is in it
    assert (broken["message_id"], broken["fields"]) == (None, None)
    assert "wrong magic number" in broken["message"]


def test_trace_short_body_is_shown_with_its_error(tmp_path: Path) -> None:
    path = tmp_path / "trace.jsonl"
    short = bytes.fromhex("50535642 04000000 12000000 80020000")
    with Peer({**SESSION, TRIGGER: short}) as peer:
        run("trigger", peer.url, "--trace", str(path)).failed(3, "StatusReport")
    frame, error = entries(path)[-2:]
    assert (frame["direction"], frame["fields"], frame["hex"]) == ("<", None, short.hex())
    assert (error["direction"], error["hex"]) == ("!", "80020000")


@pytest.mark.long
def test_trace_probe_has_the_frames_of_every_try(tmp_path: Path) -> None:
    path = tmp_path / "trace.jsonl"
    with Peer() as peer:
        thesis = "thesis over TCP: waiting for the answer to Connect"
        run_as_far_as(thesis, "probe", peer.host_and_port, "--trace", str(path)).failed(3)
    connects = [e["hex"] for e in entries(path) if e["message"] == "Connect"]
    assert connects.count(CONNECT.hex()) >= 1
    assert connects.count("425653500400000001000000") >= 1


class FullDisk:
    """A file of a disk that is full; ``method`` is where it is seen."""

    def __init__(self, method: str) -> None:
        self._method = method

    def write(self, _: str) -> None:
        self._refuse("write")

    def close(self) -> None:
        self._refuse("close")

    def _refuse(self, method: str) -> None:
        if method == self._method:
            raise OSError(28, "No space left on device")


@pytest.mark.parametrize("method", ["write", "close"])
def test_trace_disk_full_exits_2_after_the_work(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, method: str
) -> None:
    monkeypatch.setattr(Path, "open", lambda *_, **__: FullDisk(method))
    path = tmp_path / "trace.jsonl"
    with Peer(CAMERA) as peer:
        outcome = run("trigger", peer.url, "--application", "5", "--trace", str(path))
        peer.wait_last(DISCONNECT)
    outcome.failed(2, f"--trace {path}: No space left on device")
    assert "result 1 of application 5" in outcome.out
