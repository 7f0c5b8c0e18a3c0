"""Cameras of a fleet on the command line: ``serve``, ``fleet``, and commands with fleet URLs."""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from smartcam import _zenoh
from smartcam.recording import load_recording
from tests.cli.commandline import (
    DISCONNECT,
    SESSION,
    Peer,
    closed_port,
    each,
    emulators,
    run,
    run_as_far_as,
)
from tests.cli.test_calibrate import ABOUT, TOUCHES, as_lines, calibrating
from tests.cli.test_doctor import checks
from tests.cli.test_live import page_of, wait_for
from tests.doctor.doctorkit import be_patient
from tests.processes import Process, free_port

FLEET = """\
fleet: plant
agent: north
listen: tcp/127.0.0.1:0
cameras:
  line1/text: {{url: "{text}", application: 21, interpret_as: "text: string[20]"}}
  line4/free: {{url: "{free}", application: 5, interpret_as: "n: int32"}}
  line1/lost: {{url: "bvs://{gone}", connect_timeout: 1, reconnect: {{initial: 0.1, maximum: 0.1}}}}
  line2/parts: {{url: "{parts}", application: 7, interpret_as: localizations}}
  line2/mirrored: {{url: "{mirrored}", application: 7, y_down: true}}
  line1/idle: {{url: "{spare}"}}
  line3/picture: {{url: "{picture}", application: 1}}
"""
NAMES = ["line1/idle", "line1/lost", "line1/text", "line2/mirrored", "line2/parts"]
NAMES += ["line3/picture", "line4/free"]


@contextlib.contextmanager
def serving(path: Path, text: str, *options: str, cameras: int) -> Iterator[tuple[Process, str]]:
    """Run an agent for a fleet file; gives it, and its first lines."""
    path.write_text(text, encoding="utf-8")
    with Process("smartcam", "serve", str(path), *options) as agent:
        yield agent, agent.read_until(b"\n", count=cameras)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Give the URL of a fleet of six cameras, and one that is not there."""
    folder = tmp_path_factory.mktemp("fleet")
    with contextlib.ExitStack() as stack:
        gone = stack.enter_context(closed_port())
        urls = stack.enter_context(emulators(folder, (), (), (), (), ()))
        insight = stack.enter_context(Process("smartcam-emulator", "--protocol", "insight"))
        picture = insight.read_until(b"\n").strip()
        given = dict(zip(("text", "free", "parts", "mirrored", "spare"), urls, strict=True))
        text = FLEET.format(**given, picture=picture, gone=gone)
        agent, lines = stack.enter_context(serving(folder / "plant.yaml", text, cameras=len(NAMES)))
        yield lines.splitlines()[0].removesuffix("/line1/text")
        agent.send_signal(signal.SIGTERM)
        agent.wait().done()


# ---------------------------------------------------------------------- commands of one camera


def test_status_and_what_changes_it_take_a_fleet_url(fleet: str) -> None:
    url = f"{fleet}/line1/idle"
    told = {"camera": "line1/idle", "url": url, "status": [], "protocol_version": 1}
    assert run("stop", url, "--json").done().lines == [{**told, "active_application": 2}]
    assert run("switch", url, "3", "--json").done().lines == [{**told, "active_application": 3}]
    running = ["RUNNING", "WAITING_FOR_TRIGGER"]
    for command in ("start", "status"):
        (line,) = run(command, url, "--json").done().lines
        assert line == {**told, "active_application": 3, "status": running}


def test_trigger_and_watch_read_results_as_the_fleet_file_says(fleet: str) -> None:
    (line,) = run("trigger", f"{fleet}/line1/text", "--json").done().lines
    assert (line["camera"], line["value"]) == ("line1/text", {"text": "Hello World"})
    plain = run("trigger", f"{fleet}/line1/text", "--interpret-as", "raw").done().out
    assert "48 65 6c 6c 6f" in plain
    lines = run("watch", f"{fleet}/line4/free", "--count", "3", "--json").done().lines
    first = lines[0]["value"]["n"]
    assert [line["value"]["n"] for line in lines] == [first, first + 1, first + 2]


def test_y_down_is_the_fleet_files_where_the_command_does_not_say(fleet: str) -> None:
    told = ("--interpret-as", "localizations", "--json")
    plain, mirrored, said = (
        run("trigger", f"{fleet}/line2/{name}", *told, *more).done().lines[0]["value"]
        for name, more in (("parts", ()), ("mirrored", ()), ("parts", ("--y-down",)))
    )
    ys = [[part["pose"]["position"]["y"] for part in one] for one in (plain, mirrored, said)]
    assert all(y > 0 for y in ys[0])
    assert all(y < 0 for y in (*ys[1], *ys[2]))


def test_image_comes_over_the_bus(fleet: str, tmp_path: Path) -> None:
    url, path = f"{fleet}/line3/picture", tmp_path / "seen.bmp"
    run("trigger", url).done()
    run("image", url, "-o", str(path)).done()
    assert path.read_bytes().startswith(b"BM")
    run("image", f"{fleet}/line1/text", "-o", str(path), "--force").failed(5, "ReadImage")


def test_live_shows_a_camera_of_a_fleet(fleet: str) -> None:
    with Process("smartcam", "live", f"{fleet}/line4/free") as live:
        seen = wait_for(page_of(live), "connected")
        assert (seen["name"], seen["application"]) == ("line4/free", 5)
        live.send_signal(signal.SIGINT)
        assert live.wait().code == 0


def test_record_keeps_what_can_be_replayed(fleet: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    often = ("--every", "0.05", "--count", "3")
    run("record", f"{fleet}/line1/text", "-o", str(path), *often).done()
    recording = load_recording(path)
    assert (recording.counts.frames, recording.counts.errors) == (0, 0)
    assert [one.value for one in recording.results()][:3] == [{"text": "Hello World"}] * 3
    with Process("smartcam", "replay", str(path)) as replayed:
        url = replayed.read_until(b"\n").strip()
        told = ("--application", "21", "--interpret-as", "text: string[20]", "--json")
        (line,) = run("trigger", url, *told).done().lines
    assert line["value"] == {"text": "Hello World"}
    refused = run("pcap", str(path), "-o", str(tmp_path / "run.pcap"))
    refused.failed(5, "camera 'line1/text' belongs to a fleet, so the recording has no frames")


def test_record_of_a_free_run_plays_by_itself(fleet: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    run("record", f"{fleet}/line4/free", "-o", str(path), "--count", "5").done()
    wanted = [one.raw.hex() for one in load_recording(path).results()]
    with Process("smartcam", "replay", str(path)) as replayed:
        url = replayed.read_until(b"\n").strip()
        lines = run("watch", url, "--count", "5", "--json").done().lines
    assert [line["raw"] for line in lines] == wanted[:5]


def test_calibrate_a_camera_of_a_fleet(fleet: str, tmp_path: Path) -> None:
    lines = as_lines(ABOUT, {}, {}, *TOUCHES, {}, {})
    done = calibrating(f"{fleet}/line2/parts", tmp_path, lines, "--json").done()
    assert done.lines[-1]["result"]["points"] == 7
    told = ["--calibration", str(tmp_path / "plane.json"), "--json"]
    told += ["--interpret-as", "localizations"]
    (line,) = run("trigger", f"{fleet}/line2/parts", *told).done().lines
    assert line["value"][0]["pose"]["position"]["x"] > 0.2  # of the robot
    mirrored = run("trigger", f"{fleet}/line2/mirrored", *told)
    mirrored.failed(2, "made with y_down=False, so with y_down=True its poses would be mirrored")
    wrong = calibrating(f"{fleet}/line2/mirrored", tmp_path / "other", lines[:2], "--json")
    assert "its agent has y_down: true: give --y-down here, too" in wrong.out + wrong.err


def test_doctor_examines_a_camera_of_a_fleet(fleet: str, monkeypatch: pytest.MonkeyPatch) -> None:
    be_patient(monkeypatch)
    done = run("doctor", f"{fleet}/line1/text", "--trigger", "--count", "2").done()
    assert [check for severity, check in checks(done)] == [
        *("notice", "bus", "agent", "session", "reservation", "status", "application"),
        *("round trip", "run state", "trigger", "layout", "clock"),
    ]
    assert "ok       agent: agent north of the fleet plant has this camera; cameras there: 7\n" in (
        done.out
    )
    assert done.out.endswith("Nothing is wrong.\n")


@pytest.mark.long
def test_doctor_says_what_is_wrong_on_the_way(fleet: str) -> None:
    with closed_port() as nothing, Peer(greeting=b"hello\n") as peer:
        cases = [
            (f"fleet://{nothing}/line1/text", "60", "bus: nothing takes a connection at 127.0.0.1"),
            (f"fleet://{peer.host_and_port}/line1/text", "1", "and it is no bus of a fleet: "),
            (f"{fleet}/line1/texts", "60", "camera line1/texts; did you mean 'line1/text'?"),
            (f"{fleet}/line1/text?fleet=other", "60", "and no agent of the fleet other is there"),
            (f"{fleet}/line1/lost", "60", "session: the agent has no session with the camera: "),
        ]
        for url, seconds, text in cases:
            with each(url):
                done = run("doctor", url, "--timeout", seconds)
                assert (done.code, done.err) == (3, "")
                assert text in done.out
                assert done.out.count("\nerror ") == 1
    run("doctor", fleet).failed(2, "names no camera", "smartcam fleet list")


@pytest.mark.long
def test_doctor_leaves_triggers_to_who_has_reserved_the_camera(fleet: str) -> None:
    reserving = (
        "import asyncio, sys, smartcam\n"
        "async def main():\n"
        "    async with smartcam.connect(sys.argv[1]) as camera, camera.reserve():\n"
        "        print('reserved', flush=True)\n"
        "        sys.stdin.read()\n"
        "asyncio.run(main())"
    )
    url = f"{fleet}/line1/idle"
    with Process(sys.executable, "-c", reserving, url, fresh=True) as other:
        other.read_until(b"reserved")
        done = run("doctor", url, "--trigger", "--timeout", "2", "--seconds", "0.05")
        other.close_stdin()
        other.wait().done()
    assert ("error", "reservation") in checks(done)
    assert "reserved by python on " in done.out
    assert "trigger:" not in done.out.replace("--trigger", "")


@pytest.mark.parametrize(
    ("args", "text"),
    [
        (("probe",), "the camera's own address is needed here, which begins with bvs://"),
        (("status", "--trace", "frames.jsonl"), "frames of fleet://"),
        (("doctor", "--trace", "frames.jsonl"), "frames of fleet://"),
    ],
)
def test_what_cannot_cross_the_bus_says_why(
    args: tuple[str, ...], text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    name, *options = args
    run(name, "fleet://127.0.0.1:9/line1/cam3", *options).failed(5, text)
    assert not [*tmp_path.iterdir()]


def test_camera_url_without_host_or_camera_is_wrong_use() -> None:
    run("status", "fleet:///line1/cam3").failed(2, "has no host")
    run("status", "fleet://127.0.0.1:9").failed(2, "names no camera")


# ---------------------------------------------------------------------- serve


def test_serve_prints_a_line_for_each_camera(fleet: str, tmp_path: Path) -> None:
    router = fleet.replace("fleet://", "tcp/")
    with Peer(SESSION) as peer, closed_port() as gone:
        text = (
            f"agent: south\nconnect: {router}\ncameras:\n"
            f"  cell/peer: {{url: '{peer.url}'}}\n"
            f"  cell/gone: {{url: 'bvs://{gone}', connect_timeout: 1}}\n"
        )
        with serving(tmp_path / "cell.yaml", text, cameras=2) as (agent, lines):
            there, away = lines.splitlines()
            assert "application 21, running" in run("status", there).done().out
            agent.send_signal(signal.SIGTERM)
            outcome = agent.wait()
    assert there == f"{fleet}/cell/peer?fleet=plant"
    assert away.startswith(f"{fleet}/cell/gone?fleet=plant  not connected: no session with bvs://")
    assert outcome == (0, lines, "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_serve_signal_ends_sessions_with_disconnect(number: int, tmp_path: Path) -> None:
    with Peer(SESSION) as peer:
        text = f"listen: tcp/127.0.0.1:0\ncameras:\n  peer: {{url: '{peer.url}'}}\n"
        with serving(tmp_path / "one.yaml", text, cameras=1) as (agent, line):
            agent.send_signal(number)
            assert agent.wait() == (0, line, "")
        peer.wait_last(DISCONNECT)


def test_serve_tells_what_comes_and_goes(tmp_path: Path) -> None:
    port = free_port()
    address = f"bvs://127.0.0.1:{port}"
    retry = "{initial: 0.05, maximum: 0.05}"
    text = (
        "listen: tcp/127.0.0.1:0\ncameras:\n"
        f"  late: {{url: '{address}', connect_timeout: 1, reconnect: {retry}}}\n"
    )
    with serving(tmp_path / "late.yaml", text, cameras=1) as (agent, line):
        with Process("smartcam-emulator", "--port", str(port)):
            agent.read_until(b" late: connected\n", stream="stderr")
        agent.read_until(b" late: not connected: ", stream="stderr")
        agent.send_signal(signal.SIGINT)
        assert agent.wait().out == line
    with serving(tmp_path / "late.yaml", text, "--json", cameras=1) as (agent, line):
        first = json.loads(line)
        assert (first["name"], first["connected"], first["camera"]) == ("late", False, address)
        assert "nothing listens at" in first["reason"]
        with Process("smartcam-emulator", "--port", str(port)):
            agent.read_until(b"\n", count=2)
        agent.read_until(b"\n", count=3)
        agent.send_signal(signal.SIGINT)
        _, came, went = agent.wait().done().lines
    assert {**came, "at": ""} == {
        **first,
        "camera": f"{address}?dialect=handbook",
        "connected": True,
        "application": 1,
        "reason": None,
        "at": "",
    }
    assert (went["connected"], went["application"]) == (False, None)
    assert went["reason"]


def test_serve_schema_is_that_of_fleet_files() -> None:
    schema = json.loads(run("serve", "--schema").done().out)
    assert schema["title"] == "smartcam fleet"
    assert {"fleet", "agent", "listen", "connect", "cameras"} <= schema["properties"].keys()


@pytest.mark.parametrize(
    ("text", "texts"),
    [
        ("cameras:\n  line1/cam3: {ulr: 'bvs://a'}\n", ["line 2", "cameras.line1/cam3.ulr"]),
        ("cameras:\n  Line1: {url: 'bvs://a'}\n", ["line 2", "'Line1'"]),
        ("fleet: plant\ncameras:\n  a: {}\n", ["line 3", "url, emulated, software"]),
        ("cameras: [\n", ["line "]),
    ],
)
def test_serve_wrong_file_exits_2(text: str, texts: list[str], tmp_path: Path) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text(text, encoding="utf-8")
    assert run("serve", str(path)).failed(2, str(path), *texts).out == ""
    run("fleet", "list", str(path)).failed(2, str(path), *texts)


def test_serve_wrong_use_exits_2(tmp_path: Path) -> None:
    run("serve", str(tmp_path / "none.yaml")).failed(2, "none.yaml", "No such file")
    assert "a fleet file is missing" in run("serve").err
    assert run("serve", "--json").failed(2, "UsageError").out == ""


def test_serve_port_in_use_exits_3(tmp_path: Path) -> None:
    path = tmp_path / "taken.yaml"
    with socket.create_server(("127.0.0.1", 0)) as taken:
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        path.write_text(f"listen: {endpoint}\ncameras: {{a: {{emulated: {{}}}}}}\n")
        run("serve", str(path)).failed(3, f"cannot listen on {endpoint}: Address already in use")


def test_without_the_extra_everything_reports_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_zenoh, "load_zenoh", _zenoh.load_zenoh.__wrapped__)
    monkeypatch.setitem(sys.modules, "zenoh", None)
    path = tmp_path / "one.yaml"
    path.write_text("cameras: {a: {emulated: {}, application: 21}}\n", encoding="utf-8")
    url = "fleet://127.0.0.1:9"
    for command in (
        ("serve", str(path)),
        ("status", f"{url}/a"),
        ("doctor", f"{url}/a"),
        ("fleet", "list", url),
        ("demo", "--fleet"),
    ):
        with each(command):
            run(*command).failed(2, 'pip install "smartcam[fleet]"')
    (line,) = run("fleet", "trigger", str(path), "--json").done().lines  # in this process
    assert (line["camera"], line["application"]) == ("a", 21)


# ---------------------------------------------------------------------- fleet


def test_fleet_list_shows_cameras_and_their_agents(fleet: str) -> None:
    lines = run("fleet", "list", fleet, "--json").done().lines
    assert [line["camera"] for line in lines] == sorted(NAMES)
    by_name: dict[str, dict[str, Any]] = {line["camera"]: line for line in lines}
    assert by_name["line1/text"] == {
        "camera": "line1/text",
        "agents": ["north"],
        "connected": True,
        "application": 21,
        "status": ["RUNNING", "WAITING_FOR_TRIGGER"],
        "url": f"{fleet}/line1/text",
        "reason": None,
    }
    gone = by_name["line1/lost"]
    assert (gone["connected"], gone["status"], gone["application"]) == (False, None, None)
    assert "nothing listens at" in gone["reason"]
    run("fleet", "list", fleet, "line1/*o*").failed(2, "pattern 'line1/*o*'")
    out = run("fleet", "list", fleet, "line1/lost").done().out.splitlines()
    assert out[0].split() == ["camera", "agent", "application", "status", "url"]
    assert out[1].split() == ["line1/lost", "north", "not", "connected", f"{fleet}/line1/lost"]
    assert out[2].startswith("line1/lost: the agent has no session with the camera: ")
    assert "no camera of the fleet matches" in run("fleet", "list", fleet, "line9/*").done().out


def test_fleet_trigger_gives_one_outcome_each(fleet: str) -> None:
    run("stop", f"{fleet}/line1/idle").done()
    done = run("fleet", "trigger", fleet, "line1/*", "--json")
    assert (done.code, done.err) == (5, "")  # that of the first by name
    idle, lost, text = done.lines
    errors = [(one["camera"], one["error"], one["exit_code"]) for one in (idle, lost)]
    assert errors == [
        ("line1/idle", "NotRunningError", 5),
        ("line1/lost", "ConnectionLostError", 3),
    ]
    assert (text["camera"], text["value"]) == ("line1/text", {"text": "Hello World"})
    shown = run("fleet", "trigger", fleet, "line1/lost")
    assert shown.code == 3
    assert shown.out.startswith("line1/lost: error: the agent has no session with the camera: ")
    plain = run("fleet", "trigger", fleet, "*/text").done().out
    assert plain.startswith("line1/text: result ")
    assert plain.endswith("\n  text = Hello World\n")
    run("fleet", "trigger", fleet, "line9/*").failed(2, "no camera of the fleet is 'line9/*'")
    run("fleet", "trigger", f"{fleet}/line1/text").failed(2, "is a camera's")


def test_what_is_not_there_is_reported_with_what_is(fleet: str) -> None:
    meant = "did you mean 'line1/text'?"
    absent = run_as_far_as(meant, "trigger", f"{fleet}/line1/tekst")
    absent.failed(3, "no agent there has a camera line1/tekst", meant)
    nobody = f"{fleet}?fleet=hall: no agent shares a camera"
    for command in (("fleet", "list"), ("fleet", "trigger")):
        run_as_far_as(nobody, *command, f"{fleet}?fleet=hall").failed(3, nobody)
    other = run("trigger", f"{fleet.replace('fleet:', 'fleet+tls:')}/a?certificates=/nope")
    other.failed(2, "/nope has no ca.pem, no cert.pem, no key.pem")


def test_fleet_watch_shows_results_and_who_comes_and_goes(fleet: str, tmp_path: Path) -> None:
    router = fleet.replace("fleet://", "tcp/")
    text = f"agent: west\nconnect: {router}\ncameras:\n  line5/**: {{emulated: {{count: 2}}}}\n"
    with Process("smartcam", "fleet", "watch", fleet, "line5/*", "--json") as watching:
        watching.read_until(b'"agent": "north"')
        with serving(tmp_path / "west.yaml", text, cameras=2) as (agent, lines):
            run("switch", lines.splitlines()[1], "9").done()
            run("start", lines.splitlines()[1]).done()
            watching.read_until(b'"raw": ', count=2)
            agent.send_signal(signal.SIGTERM)
            agent.wait().done()
        watching.read_until(b'"AgentLeft"')
        watching.read_until(b'"CameraLeft"', count=2)
        watching.send_signal(signal.SIGINT)
        said = watching.wait().done().lines
    results = [one for one in said if "event" not in one]
    events = [(one["event"], one["agent"], one.get("camera")) for one in said if "event" in one]
    assert {one["camera"] for one in results} == {"line5/cam2"}
    assert [one["number"] for one in results] == [*range(1, len(results) + 1)]
    assert events[0] == ("AgentJoined", "north", None)
    for kind in ("Joined", "Left"):
        assert (f"Agent{kind}", "west", None) in events
        for name in ("line5/cam1", "line5/cam2"):
            assert events.count((f"Camera{kind}", "west", name)) == 1


def test_fleet_watch_ends_with_count_and_seconds(fleet: str) -> None:
    out = run("fleet", "watch", fleet, "line4/free", "--count", "2").done().out.splitlines()
    assert out[:2] == ["agent north: is there", "line4/free: shared by agent north"]
    assert [line.partition(": result")[0] for line in out[2::2]] == ["line4/free"] * 2
    assert run("fleet", "watch", fleet, "line9/*", "--seconds", "0.1").done().out == out[0] + "\n"


def test_killed_agent_ends_a_command_that_uses_it(tmp_path: Path) -> None:
    text = "listen: tcp/127.0.0.1:0\ncameras:\n  a: {emulated: {}, application: 7}\n"
    with (
        serving(tmp_path / "one.yaml", text, cameras=1) as (agent, line),
        Process("smartcam", "trigger", line.strip(), "--count", "1000000") as triggering,
    ):
        triggering.read_until(b"result 2 ")
        agent.send_signal(signal.SIGKILL)
        ended = triggering.wait()
    gone, end = "the agent ", " is gone, or the way to it"
    ended.failed(3, gone, end)
    assert ended.err.partition(end)[2] in {
        "\n",
        "; whether what was under way was done is unknown\n",
    }


# ---------------------------------------------------------------------- the demo


@pytest.mark.long
def test_demo_with_fleet_tells_a_true_story() -> None:
    with Process("smartcam", "demo", "--fleet", "--json") as demo:
        lines = demo.wait().done().lines
    assert [line["step"] for line in lines if "step" in line] == [*range(1, 9)]
    numbers = {line["program"]: line["numbers"] for line in lines if "program" in line}
    assert numbers["recorder"] == [*range(1, 13)]
    assert sorted([*numbers["robot"], *numbers["dashboard"]]) == numbers["recorder"]
    assert any(line["text"].endswith("12 results: each trigger got its own") for line in lines)
    counts = next(line["counts"] for line in lines if "counts" in line)
    assert (counts["offered"], counts["taken"], counts["missed"]) == (12, 12, 0)
    reserved = next(line for line in lines if "reason" in line)
    assert reserved["error"] == "TriggerTimeoutError"
    assert "reserved by smartcam on " in reserved["reason"]
    assert next(line["results"] for line in lines if "results" in line) == 10
    assert next((line["gone"], line["left"]) for line in lines if "gone" in line) == (4, 6)
    assert lines[-1]["error"] == "ConnectionLostError"


def test_demo_with_fleet_and_pick_is_wrong_use() -> None:
    outcome = run("demo", "--fleet", "--pick")
    assert outcome.code == 2
    assert "--pick and --fleet do not go together" in outcome.err
