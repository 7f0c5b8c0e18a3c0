"""``smartcam record``, ``replay`` and ``pcap``, as commands."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.exceptions import McapError
from mcap.stream_reader import StreamReader

from smartcam.models import Connected, Reconnected
from smartcam.recording import load_recording
from tests.cli.commandline import closed_port, emulators, run
from tests.processes import PATIENCE, Process, largest_file, wait_until
from tests.wireshark import TSHARK, needs_tshark

SESSIONS = (Connected, Reconnected)
posix = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Give a camera with the applications of ``commandline.SCENARIO``; 5 runs 100 a second."""
    with emulators(tmp_path_factory.mktemp("emulator"), ()) as (one,):
        yield one


def read_by_the_library(path: Path) -> int:
    """Return the number of messages that the mcap library reads of a file without an end."""
    count = 0
    with path.open("rb") as stream:
        try:
            for record in StreamReader(stream).records:
                count += type(record).__name__ == "Message"
        except McapError:
            return count
    raise AssertionError("the file has an end")


def test_record_ends_with_count_and_tells_what_is_in_the_file(url: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    done = run(
        "record", url, "-o", str(path), "--application", "5", "--count", "3", "--json"
    ).done()
    recording = load_recording(path)
    assert recording.counts.results >= 3
    assert done.lines == [
        {"url": url, "file": str(path)},
        {"file": str(path), **recording.counts._asdict(), "bytes": path.stat().st_size},
    ]


def test_record_has_triggers_sent_and_results_read(url: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    options = ["--application", "2", "--interpret-as", "n: int32 @sequence", "--name", "left"]
    run("record", url, "-o", str(path), *options, "--every", "0.05", "--count", "3").done()
    recording = load_recording(path)
    results = list(recording.results("left"))
    assert all(result.latency is not None for result in results)
    assert [set(result.value) for result in results] == [{"n"}] * 3
    first, *_, last = results
    assert (last.received_at - first.received_at).total_seconds() > 0.05  # one may come late
    assert recording.camera().metadata["application"] == "2"


def test_record_ends_after_so_many_seconds(url: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    done = run("record", url, "-o", str(path), "--seconds", "0.2").done()
    first, last = done.out.splitlines()
    assert first == f"recording {url} to {path}, Ctrl-C to end"
    assert last.startswith(f"{path}: frames ")
    assert load_recording(path).remark == ""


@posix
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_record_signal_ends_the_file_in_order(
    url: str, tmp_path: Path, number: int, code: int
) -> None:
    path = tmp_path / "run.mcap"
    with Process("smartcam", "record", url, "-o", str(path)) as process:
        process.read_until(b"\n")
        process.send_signal(number)
        done = process.wait()
    assert (done.code, done.err) == (code, "")
    recording = load_recording(path)
    assert (recording.remark, list(recording.frames())[-1].message) == ("", "Disconnect")


@posix
def test_record_killed_has_what_was_written(url: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Process("smartcam", "record", url, "-o", str(path), "--application", "5") as process:
        process.read_until(b"\n")
        wait_until(lambda: load_recording(path).counts.results >= 100)
        process.send_signal(signal.SIGKILL)
        process.wait()
    recording = load_recording(path)
    assert recording.remark.startswith("the file has no end: the recording was cut off; ")
    assert recording.counts.results >= 100
    numbers = [int.from_bytes(result.raw, "little") for result in recording.results()]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert read_by_the_library(path) == sum(recording.counts)
    replayed = run("replay", str(path), "--speed", "0")
    assert replayed.err.splitlines()[0].endswith(recording.remark)


def test_record_without_a_camera_leaves_no_file(tmp_path: Path) -> None:
    with closed_port() as address:
        done = run("record", f"bvs://{address}", "-o", str(tmp_path / "run.mcap"), "--timeout", "1")
    done.failed(3, "no session with bvs://")
    assert list(tmp_path.iterdir()) == []


def test_record_over_a_file_needs_force(url: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("precious")
    command = ["record", url, "-o", str(path), "--seconds", "0.1"]
    run(*command).failed(2, "run.mcap: the file exists already")
    assert path.read_text() == "precious"
    run(*command, "--force").done()
    assert load_recording(path).remark == ""


def test_record_of_a_stopped_camera_says_how_to_start_it(url: str, tmp_path: Path) -> None:
    run("stop", url).done()
    done = run("record", url, "-o", str(tmp_path / "run.mcap"), "--every", "1", "--seconds", "60")
    assert done.code == 5
    assert "To start it: smartcam start " in done.err
    assert done.out.splitlines()[-1].endswith(" bytes")  # what it saw is kept


def test_record_of_a_camera_that_sends_nothing_asks_for_every(tmp_path: Path) -> None:
    with Process("smartcam-emulator", "--protocol", "insight") as emulator:
        url = emulator.read_until(b"\n").strip()
        run("start", url).done()
        url += "?cells=A1"
        first = run("record", url, "-o", str(tmp_path / "a.mcap"), "--seconds", "60")
        command = ["record", url, "-o", str(tmp_path / "b.mcap"), "--application", "7"]
        run(*command, "--every", "0.05", "--count", "2").done()
    assert first.code == 5
    assert "the camera sends no results by itself" in first.err
    assert "while it is recorded: --every SECONDS" in first.err
    assert load_recording(tmp_path / "b.mcap").counts.results == 2


def test_record_to_a_disk_that_gets_full_ends_with_its_text(url: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with largest_file(8192):
        done = run("record", url, "-o", str(path), "--application", "5", "--seconds", "60")
    done.failed(1, f"recording {path}: File too large")
    recording = load_recording(path)
    assert recording.remark.startswith("the file has no end")
    assert recording.counts.frames > 0


def wait_for_sessions(path: Path, count: int, process: Process) -> None:
    """Wait until the recording tells of so many sessions, or ends."""
    end = time.monotonic() + PATIENCE
    while process.running and count > sum(
        isinstance(event, SESSIONS) for event in load_recording(path).events()
    ):
        assert time.monotonic() < end, f"fewer than {count} sessions"
        time.sleep(0.05)


@posix
def test_record_goes_on_over_a_lost_link_and_ends_when_it_is_taken(
    url: str, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    command = ["record", url, "-o", str(path), "--application", "2", "--every", "0.01"]
    with Process("smartcam", *command) as process:
        process.read_until(b"\n")
        sessions = 1
        while process.running:  # so soon again: another client wants the camera
            run("status", url).done()
            sessions += 1
            wait_for_sessions(path, sessions, process)
        done = process.wait()
    assert done.code == 3
    assert done.err.count("\n") == 1
    assert "another client has the camera" in done.err
    recording = load_recording(path)
    assert recording.remark == ""
    names = [type(event).__name__ for event in recording.events()]
    links = [name for name in names if name in {"Connected", "Disconnected", "Reconnected"}]
    assert links[:3] == ["Connected", "Disconnected", "Reconnected"]
    assert links[-1] == "Disconnected"
    # the trigger under way may be told of the loss a moment later
    assert "ConnectionTakenError" in [error.error for error in recording.errors()][-2:]


@posix
def test_replay_is_a_camera_with_the_recorded_results(url: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    record = ["--application", "2", "--every", "0.01", "--count", "3"]
    run("record", url, "-o", str(path), *record).done()
    recorded = [result.raw.hex() for result in load_recording(path).results()]
    with Process("smartcam", "replay", str(path), "--json") as process:
        told = process.read_until(b"\n")
        replayed = told.partition('"url": "')[2].partition('"')[0]
        done = run("trigger", replayed, "--count", str(len(recorded)), "--json").done()
        process.read_until(b"\n", stream="stderr")
        process.send_signal(signal.SIGINT)
        ended = process.wait()
    assert [line["raw"] for line in done.lines] == recorded
    assert (ended.code, ended.err) == (
        0,
        "smartcam: note: the recording is over: triggers get no result any more\n",
    )
    assert 2 in ended.lines[0]["applications"]
    assert ended.lines[0]["dialect"] == "handbook"


@pytest.mark.parametrize(
    ("options", "code", "text"),
    [
        (["none.mcap"], 2, "recording none.mcap: No such file or directory"),
        ([__file__], 2, "this is no MCAP file: it begins with 22 22 22"),
    ],
)
def test_replay_of_no_recording_is_reported(options: list[str], code: int, text: str) -> None:
    run("replay", *options).failed(code, text)


def test_replay_wrong_camera_and_speed_are_reported(url: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    run("record", url, "-o", str(path), "--seconds", "0.1", "--name", "left").done()
    run("replay", str(path), "--camera", "x").failed(2, "it has no camera 'x'; it has: left")
    run("replay", str(path), "--speed", "0").failed(2, "speed: expected a number, 0.001 to 1000")


@needs_tshark
def test_pcap_is_read_by_tshark(url: str, tmp_path: Path) -> None:
    path, packets = tmp_path / "run.mcap", tmp_path / "run.pcap"
    run("record", url, "-o", str(path), "--seconds", "0.1").done()
    done = run("pcap", str(path), "-o", str(packets), "--json").done()
    shown = subprocess.run(  # noqa: S603
        [TSHARK, "-r", str(packets)], capture_output=True, text=True, check=True, timeout=300
    )
    assert done.lines == [{"file": str(packets), "packets": len(shown.stdout.splitlines())}]
    run("pcap", str(path), "-o", str(packets)).failed(2, "run.pcap: the file exists already")
    assert run("pcap", str(path), "-o", str(packets), "--force").done().out == (
        f"{packets}: {done.lines[0]['packets']} packets\n"
    )
