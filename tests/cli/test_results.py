"""Commands that do their work: probe, status, switch, start, stop, trigger, watch."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from typing import Any

import pytest

from smartcam import Result
from smartcam.models import Localization
from tests.cli.commandline import (
    ACTIVE_21,
    CONNECT,
    CONNECTED,
    DISCONNECT,
    HELLO_WORLD,
    QUERY,
    SESSION,
    START,
    STOPPED,
    SWITCH_5,
    SWITCHED_5,
    WAITING,
    Peer,
    closed_port,
    each,
    emulators,
    run,
    run_as_far_as,
)

PARTS = [
    *("big_triangle_1", "big_triangle_2", "medium_triangle", "small_triangle_1"),
    *("small_triangle_2", "square", "parallelogram"),
]
DIALECTS = ("handbook", "thesis", "b16", "bid")
WAYS = [(transport, dialect) for transport in ("tcp", "udp") for dialect in DIALECTS]
TRIED = {
    "tcp": (("b16", "bid"), ("handbook",), ("thesis",)),
    "udp": (("handbook",), ("b16", "bid"), ("thesis",)),
}
"""Dialects tried one after the other where none is pinned; some begin a session alike."""


@pytest.fixture(scope="module")
def urls(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[tuple[str, str], str]]:
    options = [("--transport", transport, "--dialect", dialect) for transport, dialect in WAYS]
    with emulators(tmp_path_factory.mktemp("results"), *options) as found:
        yield dict(zip(WAYS, found, strict=True))


@pytest.fixture
def stoppable(urls: dict[tuple[str, str], str]) -> list[str]:
    """Return the addresses of all that can be stopped: a BVS ID always runs."""
    return [url for (_, dialect), url in urls.items() if dialect != "bid"]


@pytest.fixture
def url(urls: dict[tuple[str, str], str]) -> str:
    return urls["tcp", "handbook"]


def state(url: str) -> dict[str, Any]:
    """Return the output of ``smartcam status``."""
    (line,) = run("status", url, "--json").done().lines
    assert isinstance(line, dict)
    return line


# ---------------------------------------------------------------------- trigger


def check_parts(result: dict[str, Any]) -> None:
    """See that a result is the tangram table's, complete."""
    assert tuple(result) == Result._fields
    assert result["application"] == 7
    assert result["number"] == 1
    assert result["latency"] > 0
    assert result["triggered_at"] < result["received_at"]
    assert len(bytes.fromhex(result["raw"])) == 7 * 70
    assert [part["feature_id"] for part in result["value"]] == PARTS
    for part in result["value"]:
        assert tuple(part) == Localization._fields
        assert 0 < part["quality"] <= 1
        assert part["photo_index"] == 0
        assert part["pose"]["header"] == {
            "seq": 1,
            "stamp": result["received_at"],
            "frame_id": result["camera"],
        }
        assert set(part["pose"]["position"]) == {"x", "y", "z"}
        orientation = part["pose"]["orientation"]
        assert sum(value**2 for value in orientation.values()) == pytest.approx(1)


def test_trigger_json_localizations_prints_one_object(urls: dict[tuple[str, str], str]) -> None:
    seven = ("--application", "7", "--interpret-as", "localizations", "--json")
    for url in urls.values():
        with each(url):
            (result,) = run("trigger", url, *seven).done().lines
            check_parts(result)


@pytest.mark.long
def test_trigger_dialect_not_pinned_is_found_out(urls: dict[tuple[str, str], str]) -> None:
    seven = ("--application", "7", "--interpret-as", "Localizations", "--json")
    for url in urls.values():
        with each(url):
            (result,) = run("trigger", url.partition("?")[0], *seven).done().lines
            check_parts(result)


def test_trigger_y_down_turns_the_poses(url: str) -> None:
    seven = ("trigger", url, "--application", "7", "--interpret-as", "localizations", "--json")
    (up,) = run(*seven).done().lines
    (down,) = run(*seven, "--y-down").done().lines
    for one, other in zip(up["value"], down["value"], strict=True):
        expected = -one["pose"]["position"]["y"]
        assert other["pose"]["position"]["y"] == pytest.approx(expected, abs=0.001)


def test_trigger_count_prints_as_many_results(url: str) -> None:
    outcome = run(
        "trigger", url, "--application", "2", "--interpret-as", "n: int32 @sequence",
        "--count", "5", "--json",
    )  # fmt: skip
    results = outcome.done().lines
    assert [result["number"] for result in results] == [1, 2, 3, 4, 5]
    first = results[0]["sequence"]
    steps = [(first - result["sequence"]) % (1 << 31) for result in results]
    assert steps == [i * 1000 for i in range(5)]


@pytest.mark.parametrize(("command", "application"), [("trigger", "2"), ("watch", "5")])
def test_command_seconds_ends_after_them(url: str, command: str, application: str) -> None:
    for seconds in (0.1, 3, 60):  # a slow machine needs longer for two results
        begun = time.monotonic()
        outcome = run(
            command, url, "--application", application, "--seconds", f"{seconds}", "--json"
        )
        assert time.monotonic() - begun >= seconds
        if len(outcome.done().lines) > 1:
            break
    assert len(outcome.lines) > 1


@pytest.mark.parametrize(
    ("application", "spec", "value"),
    [
        (21, "text: string[20]", {"text": "Hello World"}),
        (21, "record: text: string[20]", {"text": "Hello World"}),
        (21, "raw", b"Hello World".ljust(20, b"\0").hex()),
        (11, "strings50", ["one", ""]),
        (
            8,
            "table: (name: string[8], x: real32 mm)*",
            [{"name": "bolt", "x": 0.112}, {"name": "nut", "x": 0.187}],
        ),
        (
            8,
            "(name: string[8], x: real32)[2]",
            [{"name": "bolt", "x": 112.0}, {"name": "nut", "x": 187.0}],
        ),
    ],
)
def test_trigger_interpret_as_gives_the_value(
    url: str, application: int, spec: str, value: object
) -> None:
    outcome = run(
        "trigger", url, "--application", str(application), "--interpret-as", spec, "--json"
    )
    (result,) = outcome.done().lines
    # a real32 has about seven digits
    assert (
        json.loads(json.dumps(result["value"]), parse_float=lambda f: round(float(f), 6)) == value
    )


def test_trigger_input_reaches_its_inspection(url: str) -> None:
    outcome = run(
        "trigger", url, "--application", "13", "--interpret-as", "order: int32",
        "--input", "2a 00 00 00", "--json",
    )  # fmt: skip
    (result,) = outcome.done().lines
    assert result["value"] == {"order": 42}


@pytest.mark.parametrize(
    ("application", "spec", "texts"),
    [
        (7, "localizations", ["result 1 of application 7", "x [m]", "parallelogram"]),
        (8, "(name: string[8], x: real32 mm)*", ["name", "bolt  0.112\n", "nut   0.187\n"]),
        (2, "n: int32 @sequence", ["sequence ", "n = "]),
        (11, "strings50", ["  one\n"]),
        (21, "raw", ["48 65 6c 6c 6f"]),
        (8, "localizations: (feature_id: string[8], x: real32, y: int32)*", []),
    ],
)
def test_trigger_for_people_is_readable(
    url: str, application: int, spec: str, texts: list[str]
) -> None:
    outcome = run("trigger", url, "--application", str(application), "--interpret-as", spec)
    if not texts:
        outcome.failed(6, "expected")
        return
    for text in texts:
        assert text in outcome.done().out


def test_trigger_control_characters_stay_in_their_cell(url: str) -> None:
    outcome = run("trigger", url, "--application", "4", "--interpret-as", "text: string[8]")
    assert outcome.done().out.splitlines()[1:] == [r"  text = a\nb\x1b[m"]


# ---------------------------------------------------------------------- watch


def test_watch_count_prints_as_many_results(url: str) -> None:
    for more in ([], ["--seconds", "60"], ["--timeout", "60"]):
        with each(*more):
            told = ("watch", url, "--application", "5", "--count", "3", "--json")
            outcome = run(*told, *more).done()
            assert [result["application"] for result in outcome.lines] == [5, 5, 5]
            assert {result["triggered_at"] for result in outcome.lines} == {None}


def test_watch_seconds_without_result_ends_well(url: str) -> None:
    run("switch", url, "2").done()
    seen = run("watch", url, "--seconds", "0.1")
    assert (seen.code, seen.out) == (0, "")
    assert seen.err.startswith("note: no result came in 0.1 s; status: ")
    assert run("watch", url, "--seconds", "0.1", "--json").done().err == ""


# ---------------------------------------------------------------------- status, switch, start, stop


def test_status_json_has_the_fields(stoppable: list[str]) -> None:
    for url in stoppable:
        with each(url):
            run("switch", url, "2").done()
            run("stop", url).done()
            assert state(url) == {
                "camera": url.partition("//")[2].partition("?")[0],
                "url": url,
                "status": [],
                "active_application": 2,
                "protocol_version": 1,
            }


def test_status_bare_host_is_taken_for_bvs_over_tcp(url: str) -> None:
    address = url.partition("//")[2].partition("?")[0]
    assert state(address)["url"] == url


def test_status_changes_nothing(url: str) -> None:
    run("trigger", url, "--application", "2").done()
    before = state(url)
    assert before["status"] == ["RUNNING", "WAITING_FOR_TRIGGER"]
    out = run("status", url).done().out
    assert "application 2, running" in out
    assert "RUNNING + WAITING_FOR_TRIGGER" in out
    assert state(url) == before


@pytest.mark.parametrize(("first", "running"), [("start", True), ("stop", False)])
def test_switch_keeps_the_run_state(stoppable: list[str], first: str, running: bool) -> None:
    for url in stoppable:
        with each(url):
            run(first, url).done()
            (line,) = run("switch", url, "21", "--json").done().lines
            assert line["active_application"] == 21
            assert ("RUNNING" in line["status"]) is running
            assert "application 2, " in run("switch", url, "2").done().out
            assert state(url)["active_application"] == 2
            assert ("RUNNING" in state(url)["status"]) is running


@pytest.mark.parametrize("command", ["start", "stop"])
def test_start_stop_twice_is_the_same_as_once(url: str, command: str) -> None:
    (once,) = run(command, url, "--json").done().lines
    assert ("RUNNING" in once["status"]) is (command == "start")
    (twice,) = run(command, url, "--json").done().lines
    assert twice == once
    assert ("running" if command == "start" else "stopped") in run(command, url).done().out


# ---------------------------------------------------------------------- probe


def probed(outcome: str) -> list[tuple[str, str]]:
    """Return the ways that were tried, from the lines for people."""
    heads = [line.partition(":")[0].partition(" ") for line in outcome.splitlines()]
    return [(transport, names) for transport, _, names in heads if transport in TRIED]


def tries(way: tuple[str, str]) -> list[tuple[str, str]]:
    """Return the tries up to the first one that a camera answers."""
    groups = [(transport, group) for transport in TRIED for group in TRIED[transport]]
    last = next(
        i for i, (where, group) in enumerate(groups) if way == (where, way[1]) and way[1] in group
    )
    return [(where, " or ".join(group)) for where, group in groups[:last]] + [way]


BEGINS = {"handbook": "50535642", "thesis": "42565350", "b16": "0100", "bid": "0100"}


def test_probe_host_and_port_finds_transport_and_dialect(urls: dict[tuple[str, str], str]) -> None:
    for way, url in urls.items():
        with each(way):
            address = url.partition("//")[2].partition("?")[0]
            outcome = run_as_far_as("use: ", "probe", address).done()
            assert probed(outcome.out) == tries(way)
            assert outcome.out.splitlines()[-1] == f"use: {url}"
            begin = BEGINS[way[1]]
            assert f"  > Connect()  {begin}" in outcome.out
            answer = "code=0, version=1" if way[1] == "bid" else "version=1"
            assert f"  < ConnectAnswer({answer})  {begin}" in outcome.out


def test_probe_url_begins_with_what_it_says(urls: dict[tuple[str, str], str]) -> None:
    for way, url in urls.items():
        with each(way):
            outcome = run("probe", url, "--timeout", "60").done()
            assert probed(outcome.out) == [way]
            assert outcome.out.splitlines()[0].endswith(": a camera answers")


def test_watch_application_named_results_of_the_one_before_are_not_shown() -> None:
    answers = {
        CONNECT: CONNECTED + STOPPED,
        QUERY: ACTIVE_21 + HELLO_WORLD,
        SWITCH_5: SWITCHED_5,
        START: WAITING,
    }
    with Peer(answers) as peer:
        shown = run(
            "watch",
            peer.url,
            "--application",
            "5",
            "--interpret-as",
            "n: int32",
            "--seconds",
            "0.3",
        )
    assert (shown.code, shown.out) == (0, "")
    assert shown.err.startswith("note: no result came in 0.3 s")


def test_probe_json_gives_every_try_then_the_url(urls: dict[tuple[str, str], str]) -> None:
    url = urls["tcp", "thesis"]
    outcome = run_as_far_as('"url": ', "probe", url.partition("?")[0], "--json")
    *shown, found = outcome.done().lines
    assert [(one["transport"], one["dialect"]) for one in shown] == tries(("tcp", "thesis"))
    *silent, answered = shown
    for one in silent:
        assert "silence" in one["outcome"]
        assert [frame["message"] for frame in one["frames"]] == [
            "Disconnect", "Connect", "Disconnect",
        ]  # fmt: skip
    assert answered["outcome"] == "session"
    assert [frame["message"] for frame in answered["frames"]] == [
        "Disconnect", "Connect", "ConnectAnswer", "StatusReport", "Query", "QueryAnswer",
    ]  # fmt: skip
    assert (found["url"], found["protocol_version"]) == (url, 1)


def test_probe_changes_nothing(urls: dict[tuple[str, str], str]) -> None:
    for url in urls.values():
        with each(url):
            run("trigger", url, "--application", "21").done()
            before = state(url)
            out = run("probe", url, "--timeout", "60").done().out
            assert "status: RUNNING + WAITING_FOR_TRIGGER" in out
            assert state(url) == before


def test_probe_ends_with_disconnect() -> None:
    with Peer(SESSION) as peer:
        run("probe", peer.url, "--timeout", "60").done()
        peer.wait_last(DISCONNECT)


def test_probe_nothing_there_exits_3_and_names_each_try() -> None:
    with closed_port() as address:
        outcome = run("probe", address, "--timeout", "0.3")
    every = [(way, " or ".join(group)) for way in TRIED for group in TRIED[way]]
    outcome.failed(3, address)
    assert probed(outcome.out) == every


def test_probe_garbage_shows_the_broken_bytes() -> None:
    with Peer(greeting=b"HTTP/1.1 400") as peer:
        outcome = run_as_far_as("wrong magic number", "probe", peer.host_and_port, "--json")
    outcome.failed(3, "wrong magic number")
    first = json.loads(outcome.out.splitlines()[0])["frames"]
    assert any(f["direction"] == "!" and f["hex"].startswith("48545450") for f in first)
