"""Outlets from an offer to the far end: order, accounts, restarts, stalled and damaged ends."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from smartcam.exceptions import ConfigurationError, EntryRefusedError
from smartcam.outlets import OutletEntry, Outlets
from smartcam.outlets._inside import OutletsFile
from smartcam.registry import OUTLETS
from tests.outlets.outletkit import FarEnd, ListOutlet, numbers, result, until

pytestmark = pytest.mark.real_time


@pytest.fixture
def far() -> Iterator[FarEnd]:
    OUTLETS.register("list", ListOutlet)
    ListOutlet.far = FarEnd()
    yield ListOutlet.far
    OUTLETS._registered.pop("list")
    OUTLETS._loaded.pop("list", None)


def account(outlets: Outlets) -> Any:
    found = outlets.states["list"].counts
    assert found.balanced, found
    return found


async def test_all_that_comes_is_delivered_in_order(far: FarEnd, tmp_path: Path) -> None:
    async with Outlets({"list": {}}, tmp_path) as outlets:
        for n in range(500):
            outlets.offer_result(result(n))
            account(outlets)
        await until(lambda: account(outlets).delivered == 500)
    assert numbers(far.taken) == [*range(500)]
    assert len({one.id for one in far.taken}) == 500


async def test_what_comes_while_the_far_end_is_away_is_delivered_later_also_by_a_new_process(
    far: FarEnd, tmp_path: Path
) -> None:
    far.there = False
    async with Outlets({"list": {}}, tmp_path) as outlets:
        for n in range(50):
            outlets.offer_result(result(n))
        await until(lambda: "it is away" in outlets.states["list"].trouble)
    async with Outlets({"list": {}}, tmp_path) as outlets:
        assert account(outlets).spooled == 50
        outlets.offer_result(result(50))
        far.there = True
        await until(lambda: account(outlets).delivered == 51)
        await until(lambda: not outlets.states["list"].trouble)
    assert numbers(far.taken) == [*range(51)]


async def test_a_far_end_that_stalls_is_left_after_the_timeout_and_tried_again(
    far: FarEnd, tmp_path: Path
) -> None:
    far.stalled = True
    async with Outlets({"list": {"timeout": 0.05}}, tmp_path) as outlets:
        outlets.offer_result(result(1))
        await until(lambda: "Timeout" in outlets.states["list"].trouble)
        far.stalled = False
        await until(lambda: account(outlets).delivered == 1)


async def test_what_the_far_end_never_takes_is_dropped_counted_and_the_rest_delivered(
    far: FarEnd, tmp_path: Path
) -> None:
    class Picky(ListOutlet):
        async def deliver(self, entries: Any) -> None:
            for place, entry in enumerate(entries):
                if entry.number == 4:
                    await super().deliver(entries[:place])
                    raise EntryRefusedError("not this one", index=place)
            await super().deliver(entries)

    OUTLETS.register("picky", Picky)
    try:
        async with Outlets({"picky": {}}, tmp_path) as outlets:
            for n in range(1, 8):
                outlets.offer_result(result(n))
            await until(lambda: outlets.states["picky"].counts.spooled == 0)
            found = outlets.states["picky"].counts
            assert found.balanced
            assert found.dropped == {"refused": 1}
    finally:
        OUTLETS._registered.pop("picky")
        OUTLETS._loaded.pop("picky", None)
    assert numbers(far.taken) == [1, 2, 3, 5, 6, 7]


async def test_what_finds_no_room_in_memory_is_counted_and_a_gap_is_delivered(
    far: FarEnd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("smartcam.outlets._pump.MAX_WAITING", 10)
    async with Outlets({"list": {}}, tmp_path) as outlets:
        for n in range(25):  # the loop does not run between them
            outlets.offer_result(result(n))
        assert account(outlets).dropped == {"memory": 15}
        await until(lambda: account(outlets).delivered == 10)
        outlets.offer_result(result(25))
        await until(lambda: account(outlets).delivered == 11)
    assert numbers(far.taken) == [*range(10), 25]
    (gap,) = [one for one in far.taken if one.kind == "gap"]
    assert '"lost": 15' in gap.body
    assert far.taken[10] is gap


async def test_a_disk_that_is_full_for_a_while_loses_nothing_that_memory_holds(
    far: FarEnd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("smartcam.outlets._pump.DISK_RETRY_SECONDS", 0.01)
    async with Outlets({"list": {}}, tmp_path) as outlets:
        spool = outlets._pumps["list"].spool
        far.there = False
        pages = spool._open_database.execute("PRAGMA page_count").fetchone()[0]
        spool._open_database.execute(f"PRAGMA max_page_count = {pages}")
        for n in range(300):
            outlets.offer_result(result(n, value={"n": n, "text": "x" * 500}))
        await until(lambda: "full" in outlets.states["list"].trouble)
        assert account(outlets).spooled == 300
        await asyncio.wrap_future(
            outlets._pumps["list"]._thread.submit(
                lambda: spool._open_database.execute("PRAGMA max_page_count = 100000") and None
            )
        )
        far.there = True
        await until(lambda: account(outlets).delivered == 300)
    assert numbers(far.taken) == [*range(300)]


async def test_whatever_a_spool_raises_is_told_and_tried_again(
    far: FarEnd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("smartcam.outlets._pump.DISK_RETRY_SECONDS", 0.01)
    async with Outlets({"list": {}}, tmp_path) as outlets:
        spool, left = outlets._pumps["list"].spool, [OSError("gone"), RuntimeError("odd")]
        add = spool.add

        def failing(*given: Any) -> None:
            if left:
                raise left.pop()
            add(*given)

        monkeypatch.setattr(spool, "add", failing)
        outlets.offer_result(result(1))
        await until(lambda: "odd" in outlets.states["list"].trouble or not left)
        await until(lambda: account(outlets).delivered == 1)
        assert not outlets.states["list"].trouble


async def test_what_a_full_disk_keeps_out_until_the_end_is_told_by_the_next_start(
    far: FarEnd, tmp_path: Path
) -> None:
    far.there = False
    async with Outlets({"list": {}}, tmp_path) as outlets:
        spool = outlets._pumps["list"].spool
        pages = spool._open_database.execute("PRAGMA page_count").fetchone()[0]
        spool._open_database.execute(f"PRAGMA max_page_count = {pages}")
        outlets.offer_result(result(1, value={"n": 1, "text": "x" * 100_000}))
        await until(lambda: "full" in outlets.states["list"].trouble)
        epoch = spool.epoch
    far.there = True
    async with Outlets({"list": {}}, tmp_path) as outlets:
        await until(lambda: bool(far.taken))
    assert [(one.kind, one.epoch) for one in far.taken] == [("gap", epoch)]
    assert '"at_least": true' in far.taken[0].body


async def test_a_spool_that_is_damaged_while_it_is_used_is_begun_anew(
    far: FarEnd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("smartcam.outlets._pump.DISK_RETRY_SECONDS", 0.01)
    far.there = False
    async with Outlets({"list": {}}, tmp_path) as outlets:
        outlets.offer_result(result(0))
        await until(lambda: outlets._pumps["list"]._counts.spooled == 1)
        spool = outlets._pumps["list"].spool

        def damage() -> None:
            spool._open_database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            spool.path.write_bytes(b"\xff" * spool.path.stat().st_size)

        await asyncio.wrap_future(outlets._pumps["list"]._thread.submit(damage))
        for n in range(1, 2000):
            outlets.offer_result(result(n))
            account(outlets)
        far.there = True
        await until(lambda: 1999 in numbers(far.taken))
        await until(lambda: account(outlets).spooled == 0)
    assert numbers(far.taken)[-1999:] == [*range(1, 2000)]
    assert 0 in numbers(far.taken) or any(one.kind == "gap" for one in far.taken)


async def test_an_interpreter_that_fails_gives_an_error_with_the_bytes(
    far: FarEnd, tmp_path: Path
) -> None:
    def read() -> Any:
        raise ZeroDivisionError("of a plug-in")

    async with Outlets({"list": {}}, tmp_path) as outlets:
        outlets.offer_result(result(1), read)
        await until(lambda: account(outlets).delivered == 1)
    (entry,) = far.taken
    assert entry.kind == "error"
    assert "ZeroDivisionError" in entry.body
    assert "01" * 20 in entry.body


async def test_each_outlet_gets_the_cameras_that_it_names(far: FarEnd, tmp_path: Path) -> None:
    section: dict[str, dict[str, Any]] = {
        "list": {"cameras": "line1/**"},
        "other": {"kind": "list", "cameras": ["line2/*"]},
    }
    async with Outlets(section, tmp_path) as outlets:
        for camera in ("line1/a", "line2/b", "line2/b/c", "line3/a"):
            outlets.offer_result(result(1, camera))
        assert account(outlets).results == 1
        assert outlets.states["other"].counts.results == 1


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("outlets:\n  list: {siez: 1 GB}\n", r"line 2.*outlets\.list\.siez"),
        ("outlets:\n  list:\n    size: 1 GB\n    full: whatever\n", r"line 4.*drop_oldest"),
        ("outlets:\n  nothing: {}\n", r"line 2.*nothing.*unknown; known are"),
        ("outlets:\n  'a b': {kind: list}\n", "line 2.*letters, digits"),
    ],
)
def test_a_wrong_setting_is_told_with_its_line(
    far: FarEnd, tmp_path: Path, text: str, told: str
) -> None:
    path = tmp_path / "outlets.yaml"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=told):
        OutletsFile.load(path)


async def test_a_spool_that_another_process_has_is_a_typed_error(
    far: FarEnd, tmp_path: Path
) -> None:
    async with Outlets({"list": {}}, tmp_path):
        with pytest.raises(ConfigurationError, match="another process"):
            await Outlets({"list": {}}, tmp_path).start()


async def test_stopping_again_and_starting_again_is_harmless(far: FarEnd, tmp_path: Path) -> None:
    outlets = Outlets({"list": {}}, tmp_path)
    await outlets.start()
    await outlets.start()
    await outlets.stop()
    await outlets.stop()


async def test_threads_have_short_turns_as_long_as_outlets_run(far: FarEnd, tmp_path: Path) -> None:
    before = sys.getswitchinterval()
    one, other = Outlets({"list": {}}, tmp_path / "1"), Outlets({"list": {}}, tmp_path / "2")
    await one.start()
    await other.start()
    await one.stop()
    assert sys.getswitchinterval() == pytest.approx(0.0005)
    await other.stop()
    await other.stop()
    assert sys.getswitchinterval() == pytest.approx(before)


def test_an_id_says_camera_epoch_and_number() -> None:
    assert OutletEntry("a/b", 7, 3, "result", 1, 0.0, "{}").id == "a/b/7/3"


def test_an_outlet_whose_name_is_no_kind_is_told_how_to_say_it(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"outlets\.plc: .*'plc' is unknown.*`kind:`"):
        Outlets({"plc": {"type": "mqtt"}}, tmp_path)
