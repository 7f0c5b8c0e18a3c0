"""``smartcam record --bag`` and ``smartcam bag``, as commands."""

from __future__ import annotations

import contextlib
import json
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader

from smartcam.calibration import fit_plane
from smartcam.recording import load_recording
from tests.cli.commandline import closed_port, emulators, run
from tests.processes import Process, largest_file, wait_until
from tests.recording.bagkit import on, read, read_by_rosbags, read_raw

posix = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")

TANGRAM = ("--application", "7", "--interpret-as", "localizations", "--every", "0.02")


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Give a camera with the applications of ``commandline.SCENARIO``; 5 runs 100 a second."""
    with emulators(tmp_path_factory.mktemp("emulator"), ()) as (one,):
        yield one


@pytest.fixture(scope="module")
def recorded(url: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a run as ``run.mcap`` and the bag ``bag``; give their folder."""
    folder = tmp_path_factory.mktemp("run")
    to = ("-o", str(folder / "run.mcap"), "--bag", str(folder / "bag"))
    done = run("record", url, *to, *TANGRAM, "--name", "table", "--count", "3", "--json").done()
    first, file, bag = done.lines
    assert first == {"url": url, "file": to[1], "bag": to[3]}
    assert file["file"] == to[1]
    messages = read_by_rosbags(folder / "bag")
    found = len(on("/table/results", messages))
    assert bag == {
        "bag": to[3],
        "messages": len(messages),
        "results": found,
        "uninterpreted": 0,
        "localizations": found,
        "errors": 0,
    }
    return folder


def test_bag_command_makes_of_the_file_what_was_recorded_beside_it(
    recorded: Path, tmp_path: Path
) -> None:
    done = run("bag", str(recorded / "run.mcap"), "-o", str(tmp_path / "bag")).done()
    made, live = read_raw(tmp_path / "bag/bag_0.mcap"), read_raw(recorded / "bag/bag_0.mcap")
    assert made == live
    results = sum(one.topic == "/table/results" for one in made)
    assert results >= 3
    assert done.out == (
        f"{tmp_path / 'bag'}: messages {len(made)}, results {results}, uninterpreted 0, "
        f"localizations {results}, errors 0\n"
    )
    assert done.err == ""


def test_bag_command_tells_what_could_not_be_read(recorded: Path, tmp_path: Path) -> None:
    command = ["bag", str(recorded / "run.mcap"), "-o", str(tmp_path / "bag"), "--json"]
    done = run(*command, "--interpret-as", "n: int32")
    (told,) = done.lines
    assert told["uninterpreted"] == told["results"] >= 3
    assert done.code == 0
    assert done.err == (
        f"smartcam: note: {told['uninterpreted']} of {told['results']} results could not be read: "
        "their messages say why\n"
    )
    (again,) = run(*command, "--interpret-as", "localizations", "--force").done().lines
    assert (again["uninterpreted"], again["localizations"]) == (0, told["results"])


@pytest.mark.long
def test_bag_command_with_a_calibration_wants_what_it_was_made_with(
    recorded: Path, tmp_path: Path
) -> None:
    marks = np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.2], [0.3, 0.2], [0.1, 0.05], [0.22, 0.16]])
    lifted = np.pad(marks, ((0, 0), (0, 1)), constant_values=0.125)
    found = fit_plane(marks, lifted, model="rigid", y_down=True, tool_z=(0, 0, -1))
    assert found.verdict.level == "good"  # else each command says that it is not
    found.save(tmp_path / "cal.json")
    command = ["bag", str(recorded / "run.mcap"), "-o", str(tmp_path / "bag")]
    command += ["--calibration", str(tmp_path / "cal.json")]
    run(*command).failed(2, "y_down")
    assert not (tmp_path / "bag").exists()
    done = run(*command, "--y-down", "--json").done()
    for one in on("/table/localizations", read(tmp_path / "bag")):
        assert one.message.header.frame_id == "robot"
        assert all(pose.position.z == pytest.approx(0.125) for pose in one.message.poses)
    assert done.lines[0]["localizations"] >= 3


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["{run}", "-o", "{here}"], 2, "it exists already; overwrite (--force)"),
        (["{run}", "-o", "{here}", "--force"], 2, "which is no part of a bag"),
        (["{run}", "-o", "{here}/none/bag"], 2, "No such file or directory"),
        (["{here}/none.mcap", "-o", "{here}/bag"], 2, "No such file or directory"),
        (["{bag}", "-o", "{here}/bag"], 2, "is no recording of smartcam; it holds"),
        (["{run}", "-o", "{here}/bag", "--camera", "other"], 2, "it has no camera 'other'"),
        (["{run}", "-o", "{here}/bag", "--interpret-as", "n: int33"], 2, "int33"),
        (["{run}"], 2, "Missing option '-o'"),
    ],
)
def test_bag_command_that_cannot_work_says_why(
    recorded: Path, tmp_path: Path, arguments: list[str], code: int, text: str
) -> None:
    (tmp_path / "precious").write_text("mine")
    names = {"run": recorded / "run.mcap", "bag": recorded / "bag/bag_0.mcap", "here": tmp_path}
    done = run("bag", *(argument.format(**names) for argument in arguments))
    assert (done.code, text in done.err) == (code, True), done.err
    assert [one.name for one in tmp_path.iterdir()] == ["precious"]


def test_record_wants_a_place_and_one_that_can_be(tmp_path: Path) -> None:
    with closed_port() as address:  # no camera is there, and none is looked for
        url = f"bvs://{address}"
        done = run("record", url)
        assert (done.code, "Missing option '-o' / '--output', or '--bag'." in done.err) == (2, True)
        file = ["record", url, "-o", str(tmp_path / "run.mcap"), "--timeout", "1"]
        done = run(*file, "--bag", str(tmp_path / "none/bag"))
        done.failed(2, f"bag {tmp_path / 'none/bag'}: No such file or directory")
        done = run(*file, "--bag", str(tmp_path))
        done.failed(2, "run.mcap: it would be in the bag's own folder")
        done = run(*file, "--bag", str(tmp_path / "bag"))
        done.failed(3, "no session with bvs://")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
@posix
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_record_bag_ends_in_order_with_a_signal(url: str, tmp_path: Path, number: int) -> None:
    with Process("smartcam", "record", url, "--bag", str(tmp_path / "bag"), *TANGRAM) as process:
        process.read_until(b"\n")
        process.send_signal(number)
        done = process.wait()
    assert (done.code, done.err) == (0 if number == signal.SIGINT else 143, "")
    messages = read(tmp_path / "bag")
    status = [one.message for one in messages if one.topic.endswith("/status")]
    assert any(one.connected for one in status)
    assert not status[-1].connected


@pytest.mark.long
@posix
def test_record_bag_killed_has_what_was_written(url: str, tmp_path: Path) -> None:
    command = ["record", url, "--bag", str(tmp_path / "bag"), "--application", "5"]
    with Process("smartcam", *command, "--interpret-as", "n: int32 @sequence") as process:
        process.read_until(b"\n")
        wait_until(lambda: len(numbers(tmp_path / "bag/bag_0.mcap")) >= 100)
        process.send_signal(signal.SIGKILL)
        process.wait()
    found = numbers(tmp_path / "bag/bag_0.mcap")
    assert found == list(range(found[0], found[0] + len(found)))
    assert not (tmp_path / "bag/metadata.yaml").exists()
    done = run("record", url, "--bag", str(tmp_path / "bag"), "--seconds", "0.1")
    done.failed(2, "it exists already")


def numbers(path: Path) -> list[int]:
    """Return the numbers that stand in the results of a file without an end."""
    found: list[int] = []
    topics: dict[int, str] = {}
    with path.open("rb") as stream, contextlib.suppress(McapError):
        for record in StreamReader(stream).records:
            match record:
                case Channel():
                    topics[record.id] = record.topic
                case Message() if topics[record.channel_id].endswith("/results"):
                    found.append(json.loads(record.data.split(b'{"n":')[1].split(b"}")[0]))
                case _:
                    pass
    return found


@pytest.mark.long
def test_record_bag_to_a_disk_that_gets_full_ends_with_its_text(url: str, tmp_path: Path) -> None:
    with largest_file(4096):
        done = run("record", url, "--bag", str(tmp_path / "bag"), "--application", "5")
    done.failed(1, f"recording {tmp_path / 'bag'}: File too large")
    assert not (tmp_path / "bag/metadata.yaml").exists()


@pytest.mark.long
def test_bag_command_on_a_disk_that_gets_full_leaves_nothing(
    recorded: Path, tmp_path: Path
) -> None:
    with largest_file(2048):
        done = run("bag", str(recorded / "run.mcap"), "-o", str(tmp_path / "bag"))
    done.failed(1, f"bag {tmp_path / 'bag'}: File too large")
    assert list(tmp_path.iterdir()) == []
    assert load_recording(recorded / "run.mcap").remark == ""
