"""The spool: entries in it survive, and others are counted."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pytest

from smartcam.exceptions import ConfigurationError
from smartcam.outlets import OutletEntry
from smartcam.outlets._entry import OutletCounts
from smartcam.outlets._spool import ROW_BYTES, Spool, read_outlet_counts


def entry(number: int, spool: Spool, camera: str = "cam", body: str = "{}") -> OutletEntry:
    return OutletEntry(camera, spool.epoch, number, "result", 1, 1e9 + number, body)


def opened(path: Path, size: int = 1 << 20, policy: str = "drop_oldest") -> Spool:
    spool = Spool(path / "a.spool", size, policy)  # type: ignore[arg-type]
    spool.open()
    return spool


def gaps(spool: Spool) -> list[tuple[str, int, int]]:
    found = spool.head(100_000).entries
    return [(e.camera, e.number, json.loads(e.body)["lost"]) for e in found if e.kind == "gap"]


def test_what_is_added_is_there_in_order_after_a_restart(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.add([entry(n, spool) for n in range(1, 11)])
    spool.remove_delivered(spool.head(3))
    first = spool.epoch
    spool.close()
    again = opened(tmp_path)
    assert [one.number for one in again.head(100).entries] == [4, 5, 6, 7, 8, 9, 10]
    assert again.counts == OutletCounts(10, 3, 7, {})
    assert again.epoch > first
    again.close()


def test_the_epoch_grows_where_the_clock_is_set_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spool = opened(tmp_path)
    first = spool.epoch
    spool.close()
    monkeypatch.setattr(time, "time_ns", lambda: 1_000_000)
    again = opened(tmp_path)
    assert again.epoch > first
    again.close()


def test_beyond_the_bound_the_oldest_make_room_and_a_gap_stands_in_front(tmp_path: Path) -> None:
    spool = opened(tmp_path, 10 * (ROW_BYTES + 2))
    for n in range(1, 31):
        spool.add([entry(n, spool)])
    assert spool.counts == OutletCounts(30, 0, 10, {"full": 20})
    found = spool.head(100).entries
    assert [(one.kind, one.number) for one in found[:2]] == [("gap", 20), ("result", 21)]
    assert gaps(spool) == [("cam", 20, 20)]
    spool.close()


def test_beyond_the_bound_the_newest_are_refused_where_the_policy_says_so(tmp_path: Path) -> None:
    spool = opened(tmp_path, 10 * (ROW_BYTES + 2), "drop_newest")
    for n in range(1, 31):
        spool.add([entry(n, spool)])
    assert spool.counts == OutletCounts(30, 0, 10, {"full": 20})
    assert [one.number for one in spool.head(10).entries] == [*range(1, 11)]
    assert gaps(spool) == [("cam", 30, 20)]
    spool.close()


def test_the_gap_of_a_crash_has_another_id_than_that_of_a_refused_entry(tmp_path: Path) -> None:
    spool = opened(tmp_path, 2 * (ROW_BYTES + 2), "drop_newest")
    spool.add([entry(n, spool) for n in range(1, 4)])
    first = spool.head(10).entries
    spool.remove_delivered(spool.head(10))
    spool.close(all_written=False)  # as if it was killed
    again = opened(tmp_path, 2 * (ROW_BYTES + 2), "drop_newest")
    second = [one for one in again.head(10).entries if one.camera]
    assert [one.number for one in first + second] == [1, 2, 3, 4]
    assert len({one.id for one in first + second}) == 4
    again.close()


def test_an_entry_that_is_not_what_was_written_is_dropped_and_told(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.add([entry(n, spool, body=f'{{"n": {n}}}') for n in range(1, 6)])
    spool._open_database.execute("UPDATE entries SET body = '{\"n\": 7}' WHERE number = 3")
    head = spool.head(10).entries
    assert [one.number for one in head if one.kind == "result"] == [1, 2, 4, 5]
    (gap,) = [one for one in head if one.kind == "gap"]
    assert (gap.camera, json.loads(gap.body)["lost"]) == ("", 1)
    assert spool.counts == OutletCounts(5, 0, 4, {"damaged": 1})
    spool.close()


@pytest.mark.parametrize("gone", ["all of it", "what was written since the last start"])
def test_a_spool_that_is_deleted_or_older_than_its_last_start_is_told(
    tmp_path: Path, gone: str
) -> None:
    spool, path = opened(tmp_path), tmp_path / "a.spool"
    spool.close()
    older, first = path.read_bytes(), spool.epoch
    spool = opened(tmp_path)
    spool.add([entry(1, spool)])
    spool.close()
    if gone == "all of it":
        path.unlink()
    else:
        path.write_bytes(older)
    again = opened(tmp_path)
    (gap,) = again.head(10).entries
    assert (gap.camera, gap.kind, json.loads(gap.body)["at_least"]) == ("", "gap", True)
    assert again.epoch > spool.epoch > first
    again.close()


def test_counts_that_do_not_balance_are_damage(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.add([entry(n, spool) for n in range(1, 6)])
    spool._open_database.execute("UPDATE counts SET value = 3 WHERE name = 'results'")
    spool.close()
    again = opened(tmp_path)
    assert again.counts == OutletCounts(5, 0, 5, {})
    assert any("do not balance" in one.body for one in again.head(10).entries)
    again.close()


def test_what_was_in_flight_when_a_spool_began_anew_comes_again(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.add([entry(n, spool) for n in range(1, 6)])
    waiting = spool.head(2)
    spool.replace_damaged("as a test says")
    spool.remove_delivered(waiting)
    head = [one.number for one in spool.head(10).entries if one.kind == "result"]
    assert head == [1, 2, 3, 4, 5]
    assert spool.counts == OutletCounts(5, 0, 5, {})
    spool.close()


def test_what_is_being_delivered_is_not_dropped(tmp_path: Path) -> None:
    spool = opened(tmp_path, 10 * (ROW_BYTES + 2))
    spool.add([entry(n, spool) for n in range(1, 11)])
    waiting = spool.head(5)
    spool.add([entry(n, spool) for n in range(11, 21)])
    spool.remove_delivered(waiting)
    account = spool.counts
    assert account.balanced
    assert account.delivered == 5
    spool.close()


def test_a_second_process_is_refused(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    with pytest.raises(ConfigurationError, match="another process has it"):
        opened(tmp_path)
    spool.close()


def test_the_account_can_be_read_while_a_process_has_the_spool(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.add([entry(1, spool), entry(2, spool)])
    assert read_outlet_counts(tmp_path / "a.spool") == OutletCounts(2, 0, 2, {})
    spool.close()


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("seed", range(6))
def test_the_account_balances_whatever_is_done(tmp_path: Path, seed: int) -> None:
    dice = random.Random(seed)  # noqa: S311
    policy = dice.choice(["drop_oldest", "drop_newest"])
    spool, number, waiting = opened(tmp_path, 4000, policy), 0, None
    for _ in range(200):
        what = dice.randrange(6)
        if what < 3:
            many = dice.randrange(1, 8)
            new = [
                entry(number + n, spool, dice.choice("abc"), "x" * dice.randrange(300))
                for n in range(1, many + 1)
            ]
            number += many
            spool.add(new)
        elif what == 3:
            waiting = spool.head(dice.randrange(1, 10))
        elif what == 4 and waiting is not None and waiting.row_ids:
            refused = "no" if dice.random() < 0.3 else ""
            spool.remove_delivered(waiting, dice.randrange(len(waiting.row_ids)), refused)
            waiting = None
        elif what == 5:
            spool.close()
            spool, waiting = opened(tmp_path, 4000, policy), None
        assert spool.counts.balanced, spool.counts
        assert spool.counts == read_outlet_counts(tmp_path / "a.spool")
        there = spool._open_database.execute("SELECT SUM(bytes) FROM entries").fetchone()[0] or 0
        assert spool.bytes == there
    assert spool.counts.results == number
    told = sum(lost for _, _, lost in gaps(spool))
    assert told <= spool.counts.dropped.get("full", 0)
    spool.close()


def test_a_full_disk_keeps_nothing_of_a_write_and_counts_nothing(tmp_path: Path) -> None:
    import sqlite3

    spool = opened(tmp_path)
    spool.add([entry(1, spool)])
    pages = spool._open_database.execute("PRAGMA page_count").fetchone()[0]
    spool._open_database.execute(f"PRAGMA max_page_count = {pages}")
    with pytest.raises(sqlite3.OperationalError, match="full"):
        spool.add([entry(n, spool, body="x" * 2000) for n in range(2, 200)])
    assert spool.counts == OutletCounts(1, 0, 1, {})
    spool._open_database.execute("PRAGMA max_page_count = 100000")
    spool.add([entry(n, spool, body="x" * 2000) for n in range(2, 200)])
    assert spool.counts == OutletCounts(199, 0, 199, {})
    spool.close()


_WRITER = """
import sys
from pathlib import Path
from smartcam.outlets._entry import OutletEntry
from smartcam.outlets._spool import Spool
spool = Spool(Path(sys.argv[1]) / "a.spool", 1 << 30)
spool.open()
for n in range(1, 10_000_000):
    spool.add([OutletEntry("cam", spool.epoch, n, "result", 1, 0.0, "{}")])
    print(n, flush=True)
    if n % 7 == 0:
        waiting = spool.head(3)
        spool.remove_delivered(waiting)
"""


@pytest.mark.parametrize("seed", range(3))
def test_a_killed_process_loses_nothing_that_was_spooled_and_a_gap_tells_of_the_rest(
    tmp_path: Path, seed: int
) -> None:
    dice, said = random.Random(seed), 0  # noqa: S311
    for _round in range(2):
        process = subprocess.Popen(  # noqa: S603
            [sys.executable, "-c", _WRITER, str(tmp_path)], stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        last = 0
        for _ in range(dice.randrange(20, 200)):
            last = int(process.stdout.readline())
        os.kill(process.pid, signal.SIGKILL)
        rest = process.stdout.read().split("\n")
        last = max([last, *(int(one) for one in rest[:-1] if one)])
        process.wait()
        process.stdout.close()
        spool = opened(tmp_path)
        account = spool.counts
        assert account.balanced
        assert account.results - said in (last, last + 1)  # one may be written and not said
        said = account.results
        head = spool.head(100_000).entries
        ids = [one.id for one in head]
        assert len(set(ids)) == len(ids)
        assert head[-1].kind == "gap"
        assert json.loads(head[-1].body)["at_least"]
        spool.close()


def test_a_spool_whose_tables_have_no_readable_names_is_put_aside(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.add([entry(1, spool)])
    spool.close()
    path = tmp_path / "a.spool"
    damaged = path.read_bytes().replace(b"tableentriesentries", b"tableentr\xd4\xd4sentries")
    assert damaged != path.read_bytes()
    path.write_bytes(damaged)
    with pytest.raises(sqlite3.DatabaseError, match="malformed database schema"):
        read_outlet_counts(path)
    again = opened(tmp_path)
    assert [one.kind for one in again.head(10).entries] == ["gap"]
    assert [*tmp_path.glob("a.spool.damaged-*")]
    again.close()


def test_an_entry_at_another_place_than_its_own_is_damaged(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.add([entry(n, spool) for n in range(1, 6)])
    spool.close()
    with contextlib.closing(sqlite3.connect(tmp_path / "a.spool")) as database:
        database.execute("UPDATE entries SET place = 9 WHERE place = 2")
        database.commit()
    again = opened(tmp_path)
    head = again.head(10).entries
    assert [one.number for one in head if one.kind == "result"] == [1, 3, 4, 5]
    assert [one.kind for one in head[4:]] == ["gap"]
    assert again.counts == OutletCounts(5, 0, 4, {"damaged": 1})
    again.close()


@pytest.mark.parametrize("last", [-1, 2, (1 << 63) - 1, "none"])
def test_a_spool_whose_last_place_is_damaged_is_put_aside(tmp_path: Path, last: object) -> None:
    spool = opened(tmp_path)
    spool.add([entry(n, spool) for n in range(1, 4)])
    spool.close()
    with contextlib.closing(sqlite3.connect(tmp_path / "a.spool")) as database:
        database.execute("UPDATE sqlite_sequence SET seq = ?", (last,))
        database.commit()
    again = opened(tmp_path)
    assert [*tmp_path.glob("a.spool.damaged-*")]
    again.add([entry(1, again)])
    kinds = [one.kind for one in again.head(10).entries]
    assert kinds.count("result") == 4
    assert again.counts.balanced
    again.close()


@pytest.mark.parametrize("place", [18, 19])
def test_a_spool_whose_version_is_damaged_is_put_aside(tmp_path: Path, place: int) -> None:
    spool = opened(tmp_path)
    spool.add([entry(1, spool)])
    spool.close()
    path = tmp_path / "a.spool"
    data = bytearray(path.read_bytes())
    data[place] = 0xD4
    path.write_bytes(data)
    again = opened(tmp_path)
    kinds = [one.kind for one in again.head(10).entries]
    assert kinds == (["result", "gap"] if place == 18 else ["gap"])  # 19: nobody may read it
    assert [*tmp_path.glob("a.spool.damaged-*")]
    again.close()


@pytest.mark.parametrize("seed", range(12))
def test_a_damaged_spool_is_put_aside_and_a_gap_tells_of_it(tmp_path: Path, seed: int) -> None:
    spool = opened(tmp_path)
    spool.add([entry(n, spool, body="x" * 500) for n in range(1, 101)])
    spool.remove_delivered(spool.head(20))
    before = spool.epoch
    spool.close()
    path, dice = tmp_path / "a.spool", random.Random(seed)  # noqa: S311
    data = bytearray(path.read_bytes())
    if seed % 3 == 0:
        begin = dice.randrange(0, len(data) - 4096)
        data[begin : begin + 4096] = dice.randbytes(4096)
    elif seed % 3 == 1:
        del data[dice.randrange(100, len(data)) :]
    else:
        data[:] = dice.randbytes(len(data))
    path.write_bytes(data)
    again = opened(tmp_path)
    assert again.counts.balanced
    head = again.head(1000).entries
    kept = [one.number for one in head if one.kind == "result"]
    assert set(kept) <= {*range(1, 101)}
    if kept:  # else nothing in the file says what was
        assert again.epoch > before
    told = [one for one in head if one.kind == "gap"]
    if len(kept) < 80:
        assert told
        assert [*tmp_path.glob("a.spool.damaged-*")]
    again.add([entry(1, again)])
    assert again.counts.balanced
    again.close()
