"""The store of results: tables by layouts, no doubles, gaps as rows, retention, migrations."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sqlite3
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from smartcam._client._inside import Interpretation
from smartcam.exceptions import ConfigurationError, EntryRefusedError
from smartcam.models import PoseSigma
from smartcam.outlets import OutletContext, OutletEntry, Outlets
from smartcam.outlets._inside import StoreQuery, columns_of, read_store
from smartcam.registry import OUTLETS
from tests.outlets.outletkit import result, until

pytestmark = pytest.mark.real_time

STORE: Any = OUTLETS.load("sqlite")
COLUMNS = [("n", "int32", ""), ("x", "real64", "m"), ("passed", "bool", "")]


def entry(number: int, value: Any, *, at: float | None = None, kind: str = "result") -> OutletEntry:
    at = time.time() if at is None else at
    said = {"camera": "line1/cam1", "application": 7, "value": value, "number": number}
    if kind != "result":
        said = {"error": "no result", "kind": "TriggerTimeoutError"}
    application = 7 if kind == "result" else None
    return OutletEntry("line1/cam1", 1, number, kind, application, at, json.dumps(said))  # type: ignore[arg-type]


def store(folder: Path, columns: Any = COLUMNS, **settings: Any) -> Any:
    found = STORE.settings_class.model_validate({"file": "results.sqlite", **settings})
    return STORE("sqlite", found, folder, OutletContext(lambda _camera, _application: columns))


def rows(folder: Path, query: str) -> list[Any]:
    with contextlib.closing(sqlite3.connect(folder / "results.sqlite")) as database:
        return database.execute(query).fetchall()


def files(folder: Path) -> list[Path]:
    return [*folder.glob("results.sqlite*")]


async def written(made: Any, *entries: OutletEntry) -> None:
    await made.open()
    try:
        await made.deliver(entries)
    finally:
        await made.close()


async def test_a_result_is_a_row_of_its_application_with_types_and_units(tmp_path: Path) -> None:
    await written(store(tmp_path), entry(1, {"n": 5, "x": 0.25, "passed": True}))
    assert rows(tmp_path, "SELECT n, x, passed FROM app_7") == [(5, 0.25, 1)]
    assert rows(tmp_path, "SELECT name, type, unit FROM fields") == COLUMNS


async def test_what_comes_again_is_not_written_twice(tmp_path: Path) -> None:
    made = store(tmp_path)
    for _ in range(2):
        await written(made, entry(1, [{"n": 1}, {"n": 2}]), entry(2, {"n": 3}))
    assert rows(tmp_path, "SELECT n FROM app_7 ORDER BY n") == [(1,), (2,), (3,)]
    assert rows(tmp_path, "SELECT COUNT(*) FROM results") == [(2,)]


async def test_errors_and_gaps_are_rows(tmp_path: Path) -> None:
    gap = OutletEntry(
        "line1/cam1", 1, 9, "gap", None, 1e9, '{"error":"full","kind":"Gap","lost":4}'
    )
    await written(store(tmp_path), entry(8, None, kind="error"), gap)
    assert rows(tmp_path, "SELECT kind, error, lost FROM results ORDER BY number") == [
        ("error", "no result", None),
        ("gap", "full", 4),
    ]


async def test_a_layout_that_changes_gets_new_columns_and_keeps_the_old_ones(
    tmp_path: Path,
) -> None:
    await written(store(tmp_path), entry(1, {"n": 5, "x": 0.5, "passed": True}))
    changed = [("n", "string", ""), ("y", "real64", "m"), ("N", "int32", "")]
    await written(store(tmp_path, changed), entry(2, {"n": "five", "y": 1.5, "N": 2}))
    assert rows(tmp_path, "SELECT n, x, n_string, y, N_int32 FROM app_7 ORDER BY id") == [
        (5, 0.5, None, None, None),
        (None, None, "five", 1.5, 2),
    ]


async def test_a_unit_that_changes_gets_a_column_of_its_own(tmp_path: Path) -> None:
    await written(store(tmp_path, [("x", "real32", "")]), entry(1, {"x": 250.0}))
    await written(store(tmp_path, [("x", "real64", "m")]), entry(2, {"x": 0.25}))
    await written(store(tmp_path, [("x", "real32", "")]), entry(3, {"x": 260.0}))
    found = rows(tmp_path, "SELECT x, x_m FROM app_7 ORDER BY id")
    assert found == [(250.0, None), (None, 0.25), (260.0, None)]


async def test_names_that_are_no_columns_are_harmless(tmp_path: Path) -> None:
    value = {'a"b; DROP TABLE results': 1, "id": 2, "record": 3, "große": 4, "select": 5}
    await written(store(tmp_path, []), entry(1, value))
    names = dict(rows(tmp_path, "SELECT name, column_name FROM fields"))
    cells = ", ".join(f'"{one}"' for one in names.values())
    assert set(names) == set(value)
    assert rows(tmp_path, f"SELECT {cells} FROM app_7") == [(1, 2, 3, 4, 5)]  # noqa: S608


async def test_texts_and_numbers_that_sqlite_does_not_know_keep_nothing_else_back(
    tmp_path: Path,
) -> None:
    value = {"t": "a\ud800b", "k\udfff": 1, "n": 2**64 - 1}
    given = entry(1, value)
    said = json.loads(given.body) | {"sequence": 2**64 - 1}
    await written(store(tmp_path, []), given._replace(body=json.dumps(said)), entry(2, {"n": 5}))
    assert rows(tmp_path, "SELECT t, k_, n FROM app_7 ORDER BY id") == [
        ("a?b", 1, str(2**64 - 1)),
        (None, None, 5),
    ]
    assert rows(tmp_path, "SELECT sequence FROM results WHERE number = 1") == [(str(2**64 - 1),)]


async def test_an_entry_that_no_table_can_have_is_refused_and_those_before_it_are_written(
    tmp_path: Path,
) -> None:
    made = store(tmp_path, [])
    with pytest.raises(EntryRefusedError) as refused:
        await written(made, entry(1, {"n": 1}), entry(2, {})._replace(body="{"), entry(3, {"n": 3}))
    assert refused.value.index == 1
    assert rows(tmp_path, "SELECT number FROM results") == [(1,)]
    assert rows(tmp_path, "SELECT n FROM app_7") == [(1,)]


async def test_a_store_that_a_disk_held_for_too_long_is_opened_again_when_it_is_closed(
    tmp_path: Path,
) -> None:
    made = store(tmp_path)
    await made.open()
    with contextlib.closing(sqlite3.connect(tmp_path / "results.sqlite")) as other:
        other.execute("BEGIN IMMEDIATE")  # as slow as a disk may be
        for do in (lambda: made.deliver([entry(1, {"n": 1})]), made.close, made.open):
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(0.05):
                    await do()
        assert sum("store" in one.name for one in threading.enumerate()) == 1
        other.execute("COMMIT")
    await written(made, entry(2, {"n": 2}))
    assert rows(tmp_path, "SELECT number FROM results ORDER BY number") == [(1,), (2,)]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows keeps an open file where it is")
async def test_a_store_that_is_moved_away_is_begun_anew_and_nothing_is_lost(tmp_path: Path) -> None:
    section = {"sqlite": {"file": "results.sqlite"}}
    async with Outlets(section, tmp_path) as outlets:

        async def delivered(number: int) -> None:
            outlets.offer_result(result(number))
            await until(lambda: outlets.states["sqlite"].counts.delivered == number)

        await delivered(1)
        for file in files(tmp_path):
            file.rename(tmp_path / f"archive-{file.name}")
        await delivered(2)
        assert rows(tmp_path, "SELECT number FROM results") == [(2,)]
        for file in files(tmp_path):
            file.unlink()
        await delivered(3)
    assert rows(tmp_path, "SELECT number FROM results") == [(3,)]


async def test_old_results_are_deleted_with_their_records(tmp_path: Path) -> None:
    now = time.time()
    old = [entry(n, {"n": n}, at=now - 7200) for n in range(1, 1203)]
    await written(store(tmp_path), *old, entry(2000, {"n": 0}))
    assert rows(tmp_path, "SELECT COUNT(*) FROM results") == [(1203,)]
    await written(store(tmp_path, keep="1 h"), entry(2001, {"n": 1}))
    assert rows(tmp_path, "SELECT number FROM results ORDER BY number") == [(2000,), (2001,)]
    assert rows(tmp_path, "SELECT COUNT(*) FROM app_7") == [(2,)]


async def test_a_store_beyond_its_size_loses_the_oldest(tmp_path: Path) -> None:
    many = [entry(n, {"t": "x" * 1000}, at=1e9 + n) for n in range(1, 2001)]
    await written(store(tmp_path, keep_size="1 MB"), *many)
    (least, most, count), *_ = rows(
        tmp_path, "SELECT MIN(number), MAX(number), COUNT(*) FROM results"
    )
    assert most == 2000
    assert least == 2001 - count
    assert 0 < count < 1000


async def test_a_picture_is_referred_to_where_it_is_there(tmp_path: Path) -> None:
    (tmp_path / "pictures/line1").mkdir(parents=True)
    (tmp_path / "pictures/line1/cam1-1.png").write_bytes(b"png")
    made = store(tmp_path, pictures="pictures/{camera}-{number}.png")
    await written(made, entry(1, {"n": 1}), entry(2, {"n": 2}))
    found = rows(tmp_path, "SELECT picture FROM results ORDER BY number")
    assert found == [("pictures/line1/cam1-1.png",), (None,)]


async def test_a_store_whose_tables_have_no_readable_names_is_told(tmp_path: Path) -> None:
    await written(store(tmp_path), entry(1, {"n": 1}))
    path = tmp_path / "results.sqlite"
    damaged = path.read_bytes().replace(b"tableresultsresults", b"tablere\xd4\xd4ltsresults")
    assert damaged != path.read_bytes()
    path.write_bytes(damaged)
    with pytest.raises(ConfigurationError, match="malformed database schema"):
        read_store(path, StoreQuery(None, False, "**", 10))
    with pytest.raises(sqlite3.DatabaseError, match="malformed database schema"):
        await store(tmp_path).open()


async def test_a_store_of_a_newer_version_is_refused(tmp_path: Path) -> None:
    await written(store(tmp_path), entry(1, {"n": 1}))
    with contextlib.closing(sqlite3.connect(tmp_path / "results.sqlite")) as database:
        database.execute("PRAGMA user_version = 99")
    made = store(tmp_path)
    with pytest.raises(ConfigurationError, match="newer smartcam"):
        await made.open()
    await made.close()


async def test_a_store_of_version_1_gets_the_column_that_it_lacks(tmp_path: Path) -> None:
    await written(store(tmp_path), entry(1, {"n": 1}))
    with contextlib.closing(sqlite3.connect(tmp_path / "results.sqlite")) as database:
        database.execute("ALTER TABLE results DROP COLUMN at_least")
        database.execute("PRAGMA user_version = 1")
    gap = '{"error":"full","kind":"Gap","lost":4,"at_least":true}'
    await written(store(tmp_path), OutletEntry("line1/cam1", 1, 9, "gap", None, 1e9, gap))
    found = rows(tmp_path, "SELECT kind, lost, at_least FROM results ORDER BY number")
    assert found == [("result", None, None), ("gap", 4, 1)]


async def test_a_localization_is_a_row_with_its_pose(tmp_path: Path) -> None:
    pose = {
        "header": {"seq": 1, "stamp": None, "frame_id": "c"},
        "position": {"x": 0.1, "y": 0.2, "z": 0.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
    }
    parts = Interpretation("localizations", lenient=False, y_down=False)
    part = {"feature_id": "bolt", "quality": 0.9, "photo_index": 1, "pose": pose}
    sigma = PoseSigma(1e-4, 2e-4, 1e-3, 0.5)._asdict()
    told = {**part, "pose": {**pose, "sigma": sigma}}
    await written(store(tmp_path, columns_of(parts.interpreter(7))), entry(1, [part, told]))
    names = "record, feature_id, x, y, qw, sigma_x, sigma_theta, correlation_xy"
    assert rows(tmp_path, f"SELECT {names} FROM app_7") == [  # noqa: S608 - of this test
        (0, "bolt", 0.1, 0.2, 1.0, None, None, None),
        (1, "bolt", 0.1, 0.2, 1.0, 1e-4, 1e-3, 0.5),
    ]


def test_columns_come_from_the_layout_in_si_units() -> None:
    read = Interpretation("a: real32 mm, t: real32 deg, n: int32", lenient=False, y_down=False)
    assert columns_of(read.interpreter(1)) == [
        ("a", "real64", "m"),
        ("t", "real64", "rad"),
        ("n", "int32", ""),
    ]
    raw = Interpretation("raw", lenient=False, y_down=False)
    assert columns_of(raw.interpreter(1)) == ()
