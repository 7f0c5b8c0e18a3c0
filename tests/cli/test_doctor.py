"""``smartcam doctor``: what it prints, for people and as JSON; its exit codes; its end."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.cli.commandline import (
    BUSY,
    CONNECT,
    CONNECTED,
    DISCONNECT,
    HELLO_WORLD,
    INSPECTING,
    SESSION,
    STOPPED,
    TRIGGER,
    WAITING,
    Peer,
    closed_port,
    emulators,
    run,
    run_as_far_as,
)
from tests.doctor.doctorkit import be_patient
from tests.processes import Outcome, Process

GET_CLOCK = bytes.fromhex("50535642 00000000 32000000")
NOON = bytes.fromhex(
    "50535642 18000000 32000000 d0070000 01000000 02000000 0c000000 00000000 00000000"
)
"""2000-01-02 12:00:00."""

HEALTHY = {**SESSION, GET_CLOCK: NOON, TRIGGER: INSPECTING + HELLO_WORLD + WAITING}
"""A camera in application 21 that answers triggers."""


def with_status(status: bytes) -> dict[bytes, bytes]:
    return {**HEALTHY, CONNECT: CONNECTED + status}


RUNNING = bytes.fromhex("50535642 08000000 12000000 80000000 00000000")


@pytest.fixture(autouse=True)
def _slow_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ask as often on a slow machine, without a remark on it."""
    be_patient(monkeypatch)


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with emulators(tmp_path_factory.mktemp("doctor"), ()) as (one,):
        yield one


def doctor(url: str, *more: str) -> Outcome:
    return run("doctor", url, "--seconds", "0.05", "--timeout", "60", *more)


def checks(outcome: Outcome) -> list[tuple[str, str]]:
    """Return severity and check of each finding, from the lines for people."""
    heads = [line.partition(":")[0].split(maxsplit=1) for line in outcome.out.splitlines()]
    return [(h[0], h[1]) for h in heads if h and h[0] in {"ok", "hint", "warning", "error"}]


# ---------------------------------------------------------------------- for people


def test_doctor_healthy_camera_prints_each_check() -> None:
    with Peer(HEALTHY) as peer:
        outcome = doctor(peer.url, "--trigger", "--interpret-as", "text: string[20]")
    assert (outcome.code, outcome.err) == (0, "")
    assert checks(outcome) == [
        ("ok", "notice"), ("ok", "session"), ("ok", "status"), ("ok", "application"),
        ("ok", "round trip"), ("ok", "run state"), ("ok", "trigger"), ("ok", "layout"),
        ("warning", "clock"),
    ]  # fmt: skip
    first, last = outcome.out.splitlines()[0], outcome.out.splitlines()[-1]
    assert first.startswith("ok       notice: the camera serves one client: another one that is")
    assert last == "1 warning."


def test_doctor_cure_stands_below_its_finding() -> None:
    with Peer(with_status(STOPPED)) as peer:
        url = peer.url
        outcome = doctor(url)
    lines = outcome.out.splitlines()
    found = lines.index("error    run state: application 21 is stopped, so no result comes")
    assert lines[found + 1].startswith(f"         -> Start it: smartcam start '{url}'")
    assert lines[-1] == "1 error, 1 warning."
    assert outcome.code == 5


def test_doctor_layout_that_differs_shows_the_bytes_beside_the_fields() -> None:
    with Peer(HEALTHY) as peer:
        outcome = doctor(peer.url, "--trigger", "--interpret-as", "n: int16, text: string[19]")
    assert outcome.code == 6
    assert "The layout has 21 bytes, 20 came" in outcome.out
    lines = [line.split() for line in outcome.out.splitlines()]
    head = lines.index(["offset", "field", "bytes", "value"])
    assert lines[head + 1][:5] == ["0", "n:", "int16", "48", "65"]
    assert lines[head + 2][-6:] == ["1", "of", "19", "bytes", "are", "missing"]


def test_doctor_garbage_is_shown_as_bytes_and_text() -> None:
    with Peer(greeting=b"SSH-2.0-OpenSSH_9.6\r\n") as peer:
        outcome = run_as_far_as("SSH-2.0", "doctor", peer.url)
    assert outcome.code == 3
    assert "5353482d322e302d" in outcome.out
    assert "'SSH-2.0-OpenSSH_9.6'" in outcome.out


def test_doctor_texts_of_the_camera_stay_in_their_cells() -> None:
    text = b"a\nb\x1b[m".ljust(20, b"\0")
    with Peer({**HEALTHY, TRIGGER: INSPECTING + HELLO_WORLD[:-20] + text + WAITING}) as peer:
        outcome = doctor(peer.url, "--trigger", "--interpret-as", "text: string[20], n: int32")
    assert "\x1b" not in outcome.out
    assert r"a\nb\x1b[m" in outcome.out


# ---------------------------------------------------------------------- JSON


def test_doctor_json_has_an_object_for_each_finding_and_the_sum() -> None:
    with Peer(HEALTHY) as peer:
        outcome = doctor(peer.url, "--json", "--trigger", "--count", "2")
    *findings, end = outcome.lines
    keys = ["check", "severity", "text", "cure", "details", "exit_code"]
    assert all(list(one) == keys for one in [*findings, end])
    by_check = {one["check"]: one for one in findings}
    assert by_check["status"]["details"]["status"] == ["RUNNING", "WAITING_FOR_TRIGGER"]
    assert by_check["trigger"]["details"]["trigger_time"]["samples"] == 2
    assert by_check["clock"]["details"]["clock"] == "2000-01-02T12:00:00"
    assert (end["check"], end["severity"], end["exit_code"]) == ("summary", "warning", 0)
    assert end["details"] == {"ok": 8, "hint": 0, "warning": 1, "error": 0}


def test_doctor_json_of_a_failure_has_every_try_and_frame() -> None:
    with Peer() as peer:
        outcome = run_as_far_as(CONNECT.hex(), "doctor", peer.url, "--json")
    session, end = outcome.lines[-2:]
    assert session["exit_code"] == end["exit_code"] == outcome.code == 3
    assert len(session["details"]["attempts"]) == len(session["details"]["frames"])
    sent = [entry["hex"] for entry in session["details"]["frames"][0]]
    assert CONNECT.hex() in sent


def test_doctor_json_of_a_layout_that_differs_has_the_dump() -> None:
    with Peer(HEALTHY) as peer:
        outcome = doctor(peer.url, "--trigger", "--interpret-as", "n: int16", "--json")
    (found,) = [one for one in outcome.lines if one["check"] == "layout"]
    assert (found["details"]["expected"], found["details"]["received"]) == ("2 bytes", 20)
    assert found["details"]["dump"][0] == {
        "offset": 0, "field": "n: int16", "hex": "48 65", "value": 0x6548,
    }  # fmt: skip
    assert found["details"]["raw"] == HELLO_WORLD[-20:].hex()


# ---------------------------------------------------------------------- exit codes


@pytest.mark.parametrize(
    ("answers", "more", "code", "check"),
    [
        ({}, [], 3, "session"),
        ({**HEALTHY, TRIGGER: b"garbage."}, ["--trigger"], 3, "lost"),
        (with_status(BUSY), [], 4, "run state"),
        (with_status(RUNNING), [], 4, "run state"),
        ({**HEALTHY, TRIGGER: b""}, ["--trigger"], 4, "trigger"),
        (with_status(STOPPED), [], 5, "run state"),
        (HEALTHY, ["--application", "0"], 5, "application"),
        (HEALTHY, ["--trigger", "--interpret-as", "n: int16"], 6, "layout"),
    ],
)
def test_doctor_exit_code_is_that_of_the_worst_finding(
    answers: dict[bytes, bytes], more: list[str], code: int, check: str
) -> None:
    with Peer(answers) as peer:
        outcome = run_as_far_as(
            f"error    {check}: ", "doctor", peer.url, "--seconds", "0.05", *more
        )
    assert (outcome.code, outcome.err) == (code, "")
    assert [name for severity, name in checks(outcome) if severity == "error"] == [check]


@pytest.mark.parametrize("more", [[], ["--application", "77"]])
def test_doctor_hints_and_warnings_exit_0(more: list[str]) -> None:
    with Peer(HEALTHY) as peer:
        outcome = doctor(peer.url, *more)
    assert outcome.code == 0
    assert ("warning", "clock") in checks(outcome)


def test_doctor_nothing_listens_exits_3() -> None:
    with closed_port() as address:
        outcome = doctor(f"bvs://{address}")
    assert (outcome.code, outcome.err) == (3, "")
    assert f"error    session: nothing listens at {address} (TCP)" in outcome.out


def test_doctor_bare_host_is_one_that_speaks_bvs() -> None:
    with closed_port() as address:
        assert f"nothing listens at {address}" in doctor(address).out


@pytest.mark.parametrize(
    ("more", "text"),
    [
        (["--interpret-as", "n: int33"], "did you mean 'int32'?"),
        (["--interpret-as", "nonsense"], "'nonsense' is unknown"),
    ],
)
def test_doctor_wrong_layout_exits_2(more: list[str], text: str) -> None:
    run("doctor", "bvs://127.0.0.1:1", *more).failed(2, text)


def test_doctor_wrong_url_exits_2() -> None:
    run("doctor", "ftp://127.0.0.1").failed(2, "known are")


@pytest.mark.parametrize(
    ("option", "value"),
    [("--count", "0"), ("--count", "1000000"), ("--seconds", "nan"), ("--timeout", "0")],
)
def test_doctor_bad_option_exits_2(option: str, value: str) -> None:
    outcome = run("doctor", "bvs://127.0.0.1:1", option, value)
    assert (outcome.code, outcome.out) == (2, "")
    assert option in outcome.err


# ---------------------------------------------------------------------- what it does to a camera


def test_doctor_changes_nothing_on_a_camera(url: str) -> None:
    run("trigger", url, "--application", "2").done()
    before = run("status", url, "--json").done().lines
    assert doctor(url, "--application", "21").code == 0
    assert run("status", url, "--json").done().lines == before


def test_doctor_with_trigger_and_application_goes_back(url: str) -> None:
    run("switch", url, "2").done()
    run("stop", url).done()
    before = run("status", url, "--json").done().lines
    outcome = doctor(url, "--application", "21", "--trigger", "--count", "2")
    assert outcome.code == 0
    assert ("ok", "trigger") in checks(outcome)
    assert run("status", url, "--json").done().lines == before


def test_doctor_help_says_what_it_takes_and_changes() -> None:
    text = " ".join(run("doctor", "--help").out.split())
    assert "Changes nothing on the camera and triggers nothing, unless --trigger is given" in text
    assert "Connecting takes the camera from another client" in text


def test_doctor_trace_has_every_frame(tmp_path: Path) -> None:
    path = tmp_path / "trace.jsonl"
    with Peer(HEALTHY) as peer:
        assert doctor(peer.url, "--trace", str(path)).code == 0
    frames: list[dict[str, Any]] = [json.loads(line) for line in path.read_text().splitlines()]
    assert [one["message"] for one in frames if one["direction"] == ">"].count(
        "Query"
    ) == 5 + 1 + 30
    assert (frames[-1]["direction"], frames[-1]["message"]) == (">", "Disconnect")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_doctor_interrupted_says_disconnect(number: int, code: int) -> None:
    with Peer(HEALTHY) as peer, Process("smartcam", "doctor", peer.url, "--seconds", "60") as one:
        one.read_until(b"round trip: ")
        one.send_signal(number)
        outcome = one.wait()
        peer.wait_last(DISCONNECT)
    assert (outcome.code, outcome.err) == (code, "")


def test_doctor_stdout_closed_ends_quietly_and_says_disconnect() -> None:
    with Peer(HEALTHY) as peer, Process("smartcam", "doctor", peer.url) as one:
        one.read_until(b"session: ")
        one.close_stdout()
        outcome = one.wait()
        peer.wait_last(DISCONNECT)
    assert (outcome.code, outcome.err) == (0, "")


def test_doctor_emulator_killed_in_the_middle_exits_3() -> None:
    with Process("smartcam-emulator") as emulator:
        address = emulator.read_until(b"\n").strip()
        run("start", address).done()
        with Process("smartcam", "doctor", address, "--seconds", "60") as one:
            one.read_until(b"round trip: ")
            emulator.send_signal(signal.SIGKILL)
            outcome = one.wait()
    assert (outcome.code, outcome.err) == (3, "")
    assert "error    lost: the session broke after" in outcome.out
