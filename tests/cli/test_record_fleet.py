"""``record:`` in a fleet file on the command line, and a folder of it played as a fleet."""

from __future__ import annotations

import itertools
import shutil
import signal
from pathlib import Path

import pytest

from smartcam.recording import load_recording
from tests.cli.commandline import emulators, run
from tests.fleet.fleetkit import NumberedCamera
from tests.processes import Process, wait_until
from tests.recording.folderkit import files, recording, runs, write_often
from tests.recording.folderkit import until as until_true

FLEET = """\
fleet: plant
listen: tcp/127.0.0.1:0
record: {{folder: rec, cameras: line1/*}}
cameras:
  line1/cam1: {{url: "{first}", application: 5, interpret_as: "n: int32"}}
  line1/text: {{url: "{text}", application: 21}}
  line2/cam1: {{url: "{other}"}}
"""


def serving(folder: Path, urls: list[str]) -> Process:
    first, text, other = urls
    path = folder / "plant.yaml"
    path.write_text(FLEET.format(first=first, text=text, other=other), encoding="utf-8")
    return Process("smartcam", "serve", str(path))


def numbers(path: Path) -> list[int]:
    return [result.value["n"] for result in load_recording(path).results("line1/cam1")]


def test_folder_goes_on_after_a_kill_and_is_played_as_a_fleet(tmp_path: Path) -> None:
    with emulators(tmp_path, (), (), ()) as urls:
        for file, end in enumerate((signal.SIGKILL, signal.SIGTERM)):
            with serving(tmp_path, urls) as agent:
                shown = agent.read_until(b"\n", count=3).split()
                assert [url.split("/", 3)[3] for url in shown] == [
                    "line1/cam1",
                    "line1/text",
                    "line2/cam1",
                ]
                run("trigger", shown[1], "--count", "3").done()
                run("watch", shown[0], "--count", "40").done()
                run("status", shown[2]).done()
                _until_written(tmp_path, 3, file)
                agent.send_signal(end)
                outcome = agent.wait()
        outcome.done()
    first, second = files(tmp_path)
    assert not files(tmp_path, "line2/cam1")
    assert "the recording was cut off" in load_recording(first).remark
    assert load_recording(second).remark == ""
    for path in (first, second):
        found = numbers(path)
        assert found == list(range(found[0], found[0] + len(found)))

    with Process("smartcam", "replay", str(tmp_path / "rec"), "--speed", "5") as played:
        cam, text = played.read_until(b"\n", count=2).split()
        assert cam.endswith("/line1/cam1")
        again = run("trigger", text, "--count", "6", "--json").done()
        assert [line["raw"] for line in again.lines] == [b"Hello World".ljust(20, b"\0").hex()] * 6
        over = played.read_until(b"line1/text: the end of its recording", stream="stderr")
        assert over.count("the recording was cut off") == 2
        played.send_signal(signal.SIGTERM)
        assert played.wait().code == 0


def _until_written(folder: Path, count: int, file: int) -> None:
    """Wait until file number ``file`` of ``line1/text`` is there and has ``count`` results."""
    wait_until(lambda: len(files(folder, "line1/text")) > file)
    path = files(folder, "line1/text")[file]
    wait_until(lambda: load_recording(path).counts.results >= count)


@pytest.fixture
async def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give a folder with four files or more of a camera that runs free."""
    write_often(monkeypatch)
    async with NumberedCamera(rate=400) as box, recording(tmp_path, box.url, size=6000):
        await until_true(lambda: len(files(tmp_path)) >= 5)
    return tmp_path / "rec"


@pytest.mark.real_time
def test_damage_is_reported_and_skipped_and_the_rest_is_played(folder: Path) -> None:
    paths = files(folder.parent)
    whole = [runs(load_recording(path)) for path in paths]
    damaged = bytearray(paths[1].read_bytes())
    middle = len(damaged) // 3
    damaged[middle : middle + 400] = bytes(400)  # more than there is between two chunks
    paths[1].write_bytes(damaged)
    paths[2].write_bytes(b"no recording at all")
    found = load_recording(folder)
    remarks = found.remark.splitlines()  # a busy machine may have more to tell of other files
    damage = f"{paths[1].name}: the file is damaged after message "
    first = next((line for line in remarks if line.startswith(damage)), None)
    assert first is not None, remarks
    no_mcap = f"recording {paths[2]}: this is no MCAP file"
    assert any(line.startswith(no_mcap) for line in remarks), remarks
    kept = runs(load_recording(paths[1]))
    assert len(kept) < len(whole[1])
    assert kept or len(whole[1]) < 10  # of a few, none may stand before the damage
    assert runs(found) == [*whole[0], *kept, *itertools.chain(*whole[3:])]
    with Process("smartcam", "replay", str(folder), "--loop") as played:
        url = played.read_until(b"\n").split()[0]
        rest = [*whole[0], *kept, *itertools.chain(*whole[3:])]
        got: set[int] = set()

        def all_came() -> bool:
            out = run("watch", url, "--count", str(2 * len(rest)), "--json").done()
            got.update(line["value"]["run"] for line in out.lines)
            return set(rest) <= got

        wait_until(all_came)  # round and round, and who is held up leaves some out
        # before the damage a frame may have come whose result stood behind it
        lost = [run for run in whole[1] if run not in kept]
        more = got & set(lost)
        assert more == set(lost[: len(more)])
        assert len(more) < len(lost)
        assert not got & set(whole[2])
        played.send_signal(signal.SIGTERM)
        assert first in played.wait().err


@pytest.mark.real_time
def test_from_and_until_choose_what_is_played(folder: Path) -> None:
    results = [*load_recording(folder).results("line1/cam1")]
    begin, end = results[len(results) // 3], results[2 * len(results) // 3]
    since, until = begin.received_at, end.received_at
    part = load_recording(folder, since=since, until=until)
    chosen = runs(part)
    assert chosen == [one.value["run"] for one in results if since <= one.received_at <= until]
    assert {begin.value["run"], end.value["run"]} <= set(chosen) < {*runs(load_recording(folder))}
    span = ("--from", since.isoformat(), "--until", until.isoformat())
    with Process("smartcam", "replay", str(folder), "--loop", *span) as played:
        url = played.read_until(b"\n").split()[0]
        out = run("watch", url, "--count", "5", "--json").done()
        got = [line["value"]["run"] for line in out.lines]
        # what is played is what came then: of the last ones, the results may have been later
        came = {
            int.from_bytes(bytes.fromhex(one.fields["data"])[:4], "little")
            for one in part.frames()
            if one.message == "ResultContainer"
        }
        assert set(got) <= came
        played.send_signal(signal.SIGTERM)
        played.wait()
    refused = run("replay", str(folder), "--from", "noon")
    assert (refused.code, "'noon' is no time such as" in refused.err) == (2, True)
    late = ("--from", "2001-01-01T00:00:00Z", "--until", "2001-01-02T00:00:00Z")
    run("replay", str(folder), *late).failed(2, "no recordings of a fleet are in this folder")


@pytest.mark.long
def test_serve_says_where_it_cannot_record_and_goes_on(tmp_path: Path) -> None:
    with emulators(tmp_path, (), (), ()) as urls, serving(tmp_path, urls) as agent:
        shown = agent.read_until(b"\n", count=3).split()
        wait_until(lambda: files(tmp_path, "line1/text"))
        shutil.rmtree(tmp_path / "rec")
        run("trigger", shown[1], "--count", "2").done()
        said = agent.read_until(b"until the disk works again", stream="stderr")
        assert f"recordings {tmp_path / 'rec'}: No such file or directory" in said
        (tmp_path / "rec").mkdir()
        run("trigger", shown[1], "--count", "2").done()
        agent.read_until(b"records are written again", stream="stderr")
        agent.send_signal(signal.SIGTERM)
        assert agent.wait().code == 0
    assert files(tmp_path)


def test_replay_of_a_folder_without_recordings_is_refused(tmp_path: Path) -> None:
    run("replay", str(tmp_path)).failed(2, "no recordings of a fleet are in this folder")
