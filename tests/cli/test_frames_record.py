"""``smartcam frames record``, as a command."""

from __future__ import annotations

import re
import signal
import sys
from pathlib import Path
from typing import Any

import pytest

from smartcam.recording import load_recording
from tests.cli.commandline import run
from tests.processes import Process, wait_until

posix = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")


def start(*arguments: str) -> Process:
    return Process("smartcam", "frames", "record", *arguments)


def record(*arguments: str) -> Any:
    return run("frames", "record", *arguments)


def test_frames_record_ends_with_count_and_tells_what_is_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    done = record("synthetic://?fps=100", "-o", str(path), "--count", "5", "--json").done()
    recording = load_recording(path)
    assert (recording.counts.pictures, [*recording.cameras]) == (5, ["synthetic"])
    told = {"pictures": 5, "left_out": 0, "bytes": path.stat().st_size}
    begun, ended = done.lines
    assert begun == {"url": "synthetic", "file": str(path)}
    assert {**ended, "lost": 0} == {"file": str(path), **told, "lost": 0}
    again = record(f"{path}#pace=none", "-o", str(tmp_path / "two.mcap"), "--name", "b").done()
    assert re.search(r"pictures 5, left out 0, lost \d+;", again.out)  # as many as in between
    assert [*load_recording(tmp_path / "two.mcap").cameras] == ["b"]


def test_frames_record_writes_a_video(tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="needs the extra video")
    path = tmp_path / "run.mkv"
    record("synthetic://?fps=100", "-o", str(path), "--count", "5").done()
    with av.open(str(path)) as container:
        assert len([*container.decode(video=0)]) == 5
    refused = record("synthetic://?format=Z16", "-o", str(tmp_path / "deep.mkv"))
    assert refused.code == 5
    assert "Coord3D_C16 cannot become a video without loss" in refused.err
    assert "(.mcap) takes any format" in refused.err
    assert not (tmp_path / "deep.mkv").exists()


def test_frames_record_into_a_folder_begins_new_files(tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    record("synthetic://?fps=50", "-o", str(folder), "--seconds", "1.5", "--size", "1 MB").done()
    assert len([*folder.glob("synthetic_*.mcap")]) > 1
    assert load_recording(folder).counts.pictures >= 2


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["-o", "run.avi"], "expected FILE.mcap, FILE.mkv, or a folder"),
        (["-o", "run.mcap", "--keep", "1 GB"], "--keep is for a folder"),
        (["-o", "run", "--size", "1 elephant"], "expected a number and one of kB, MB"),
        (["-o", "run", "--size", "1 GB", "--keep", "1 GB"], "keep: expected"),
        ([], "Missing option '-o'"),
    ],
)
def test_frames_record_wrong_usage_is_reported(
    arguments: list[str], text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = record("synthetic://", *arguments)
    assert done.code == 2
    assert text in done.err
    assert [*tmp_path.iterdir()] == []


def test_frames_record_over_a_file_needs_force(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("precious")
    refused = record("synthetic://", "-o", str(path), "--count", "1")
    assert (refused.code, path.read_text()) == (2, "precious")
    assert "the file exists already" in refused.err
    record("synthetic://", "-o", str(path), "--count", "1", "--force").done()
    assert load_recording(path).counts.pictures == 1


def test_frames_record_of_what_is_not_there_leaves_no_file(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    refused = record(str(tmp_path / "gone.mcap"), "-o", str(path))
    assert refused.code == 3
    assert not path.exists()


@posix
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_frames_record_signal_ends_the_file(number: int, code: int, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with start("synthetic://?fps=50", "-o", str(path)) as process:
        wait_until(lambda: path.exists() and path.stat().st_size > 1_000_000)
        process.send_signal(number)
        outcome = process.wait()
    assert outcome.code == code
    recording = load_recording(path)
    assert recording.remark == ""
    assert recording.counts.pictures >= 2


@posix
@pytest.mark.parametrize("suffix", [".mcap", ".mkv"])
def test_frames_record_killed_has_what_was_written(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"run{suffix}"
    with start("synthetic://?fps=50&format=MJPEG", "-o", str(path)) as process:
        wait_until(lambda: path.exists() and path.stat().st_size > 500_000)
        process.send_signal(signal.SIGKILL)
        process.wait()
    if suffix == ".mcap":
        recording = load_recording(path)
        assert "cut off" in recording.remark
        sequences = [one.sequence for one in recording.pictures()]
    else:
        av = pytest.importorskip("av", reason="needs the extra video")
        with av.open(str(path)) as container:
            sequences = [one.pts for one in container.decode(video=0)]
    assert len(sequences) >= 10
    assert sequences == sorted(set(sequences))
