"""Many writers of one file, and killed ones, write whole or not at all, and leave nothing."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from smartcam import _whole_files
from smartcam.exceptions import CalibrationError
from tests.calibration.inside import keep_backup, read, replace_file, write

WRITER = """
import sys
from concurrent.futures import ThreadPoolExecutor
from smartcam.calibration._files.store import write

path, who = sys.argv[1], int(sys.argv[2])


def save(thread):
    for number in range(15):
        write(path, "plane", {"who": [who, thread], "n": number, "much": [0.1] * 2000})


print("ready", flush=True)
sys.stdin.read(1)
with ThreadPoolExecutor(3) as pool:
    list(pool.map(save, range(3)))
"""


def files(folder: Path) -> list[str]:
    return sorted(one.name for one in folder.iterdir())


@pytest.mark.long
def test_many_writers_at_once_leave_whole_files_and_the_last_ones(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write(path, "plane", {"n": -1})
    command = [sys.executable, "-c", WRITER, str(path)]
    writers = [
        subprocess.Popen(  # noqa: S603 - our own interpreter
            [*command, str(who)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        for who in range(4)
    ]
    for one in writers:
        assert one.stdout is not None
        assert one.stdout.readline() == b"ready\n"
    for one in writers:
        assert one.stdin is not None
        one.stdin.write(b"\n")
        one.stdin.flush()
    while any(one.poll() is None for one in writers):
        read(path, "plane")  # at every moment
    for one in writers:
        one.communicate()
    assert [one.returncode for one in writers] == [0] * 4
    assert read(path, "plane")["n"] == 14
    assert files(tmp_path) == ["a.json", "a.json.1", "a.json.2", "a.json.3"]
    kept = [read(tmp_path / name, "plane") for name in files(tmp_path)]
    assert len({(*one["who"], one["n"]) for one in kept}) == 4  # no save is there twice


def test_many_threads_replace_without_locks_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_whole_files, "try_lock", lambda _: None)  # a file system without links
    path = tmp_path / "a"
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda n: replace_file(path, b"%d" % n, backups=2), range(20)))
    assert re.fullmatch(rb"\d+", path.read_bytes())


KILLED = """
import os, signal, sys
from pathlib import Path
from smartcam.calibration._files.store import write

CALLS = {"open", "os.rename", "os.remove", "os.link", "os.truncate", "os.scandir"}
left = []


def hook(event, _):
    if left and event in CALLS:
        left[0] -= 1
        if left[0] < 0:
            os.kill(os.getpid(), signal.SIGKILL)


sys.addaudithook(hook)
links = sys.argv[2] == "links"
if not links:
    def refuse(*_):
        raise OSError("no links here")
    os.link = refuse


def killed(path, step, number):
    child = os.fork()
    if not child:
        left.append(step)
        write(path, "plane", {"n": number})
        os._exit(0)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


step, more = 0, True
while more:
    folder = Path(sys.argv[1], str(step))
    folder.mkdir()
    for number in range(4):
        write(folder / "a.json", "plane", {"n": number})
    more = False
    for number in range(4, 9):  # again and again at the same step
        more |= killed(folder / "a.json", step, number)
    step += 1
"""


@pytest.mark.long
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs os.fork")
@pytest.mark.parametrize("links", ["links", "copies"])
def test_process_killed_at_each_step_leaves_a_file_and_the_next_save_clears_up(
    tmp_path: Path, links: str
) -> None:
    command = [sys.executable, "-c", KILLED, str(tmp_path), links]
    subprocess.run(command, check=True)  # noqa: S603 - our own interpreter
    seen: list[int] = []
    left_behind = 0
    for step in range(len(files(tmp_path))):
        folder = tmp_path / str(step)
        left_behind += any(name.endswith(".tmp") for name in files(folder))
        seen.append(read(folder / "a.json", "plane")["n"])
        kept = [read(one, "plane")["n"] for one in sorted(folder.glob("a.json.*"))]
        assert {1, 2, 3} <= {*kept, seen[-1]} or seen[-1] > 3
        assert len(kept) >= 2
        write(folder / "a.json", "plane", {"n": 99})
        assert read(folder / "a.json", "plane")["n"] == 99
        assert read(folder / "a.json.1", "plane")["n"] == seen[-1]
        assert files(folder) == ["a.json", "a.json.1", "a.json.2", "a.json.3"]
    assert (seen[0], seen[-1]) == (3, 8)
    assert left_behind


def test_write_after_crashes_of_an_earlier_version(tmp_path: Path) -> None:
    # a file and all its backups are names of one file: three crashes after the backup
    path = tmp_path / "a.json"
    write(path, "plane", {"n": 0})
    for number in (1, 2, 3):
        os.link(path, tmp_path / f"a.json.{number}")
    for number in (1, 2, 3, 4):
        write(path, "plane", {"n": number})
    kept = [read(tmp_path / name, "plane")["n"] for name in files(tmp_path)]
    assert kept == [4, 3, 2, 1]


def test_write_leaves_the_temporary_files_of_others(tmp_path: Path) -> None:
    ours, theirs = tmp_path / ".a.json.abcd_123.tmp", tmp_path / ".a.json.1.abcd_123.tmp"
    for one in (ours, theirs):
        one.write_text("half")
    write(tmp_path / "a.json", "plane", {})
    assert files(tmp_path) == [theirs.name, "a.json"]


def refused(path: Path) -> tuple[str, str]:
    with pytest.raises(CalibrationError) as caught:
        write(path, "plane", {})
    return caught.value.code, str(caught.value)


def test_write_that_the_disk_refuses_is_a_calibration_error(tmp_path: Path) -> None:
    path = tmp_path / "none" / "a.json"
    text = f"{path}: cannot be written: No such file or directory"
    assert refused(path) == ("NOT_WRITTEN", text)
    folder = tmp_path / "a.json"
    folder.mkdir()
    assert refused(folder) == ("NOT_WRITTEN", f"{folder}: cannot be written: Is a directory")
    assert files(tmp_path) == ["a.json"]


def test_write_waits_for_another_one_but_not_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_whole_files, "LOCK_TIMEOUT", 0.0)
    path = tmp_path / "a.json"
    write(path, "plane", {"n": 1})
    with _whole_files._writing(path):
        assert refused(path)[0] == "IN_USE"
    assert read(path, "plane") == {"n": 1}


def test_keep_backup_of_nothing_does_nothing(tmp_path: Path) -> None:
    keep_backup(tmp_path / "a", 2)
    assert files(tmp_path) == []
