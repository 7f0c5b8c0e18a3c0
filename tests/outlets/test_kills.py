"""A process that is killed at any moment, and a clock that jumps: nothing lost or doubled."""

from __future__ import annotations

import asyncio
import contextlib
import random
import sqlite3
import sys
import time
from pathlib import Path

import pytest

from smartcam.outlets import Outlets
from tests.outlets.outletkit import result, until

pytestmark = pytest.mark.real_time

SECTION = {"store": {"kind": "sqlite", "file": "results.sqlite"}}

PROGRAM = f"""
import asyncio, sys
from pathlib import Path
from smartcam.outlets import Outlets
from tests.outlets.outletkit import result
async def main():
    async with Outlets({SECTION!r}, Path(sys.argv[1])) as outlets:
        print("open", flush=True)
        for n in range(1_000_000):
            outlets.offer_result(result(n, f"line1/cam{{n % 3}}"))
            await asyncio.sleep(0)
asyncio.run(main())
"""


def rows(folder: Path, query: str) -> list[tuple[object, ...]]:
    with contextlib.closing(sqlite3.connect(folder / "results.sqlite")) as database:
        return database.execute(query).fetchall()


@pytest.mark.parametrize("kills", [2, pytest.param(6, marks=pytest.mark.long)])
async def test_a_process_that_is_killed_at_any_moment_writes_each_spooled_result_once(
    tmp_path: Path, kills: int
) -> None:
    dice = random.Random(1)  # noqa: S311
    for _ in range(kills):
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-c", PROGRAM, str(tmp_path), stdout=asyncio.subprocess.PIPE
        )
        assert process.stdout is not None
        assert await process.stdout.readline() == b"open\n"
        await asyncio.sleep(dice.uniform(0.05, 0.6))
        process.kill()
        await process.communicate()
    async with Outlets(SECTION, tmp_path) as outlets:
        await until(lambda: outlets.states["store"].counts.spooled == 0)
        account = outlets.states["store"].counts
        assert account.balanced
        assert not account.dropped
    written = rows(tmp_path, "SELECT COUNT(*), COUNT(DISTINCT id) FROM results WHERE kind != 'gap'")
    assert written == [(account.delivered, account.delivered)]
    assert account.delivered == account.results > 0
    # within an epoch and camera there is no hole: what is missing is behind the last one, as told
    for count, least, most in rows(
        tmp_path,
        "SELECT COUNT(*), MIN(number), MAX(number) FROM results WHERE kind != 'gap' "
        "GROUP BY epoch, camera",
    ):
        assert (least, most) == (1, count)
    told = rows(tmp_path, "SELECT DISTINCT epoch FROM results WHERE kind = 'gap'")
    assert len(told) >= len(rows(tmp_path, "SELECT DISTINCT epoch FROM results WHERE number > 1"))


async def test_a_clock_that_is_set_back_makes_no_id_come_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = time.time_ns()
    for step in (0, -3_600_000_000_000, 86_400_000_000_000, -7_200_000_000_000):
        monkeypatch.setattr(time, "time_ns", lambda step=step: begun + step)
        async with Outlets(SECTION, tmp_path) as outlets:
            before = outlets.states["store"].counts.delivered
            for n in range(10):
                outlets.offer_result(result(n))
            await until(lambda: outlets.states["store"].counts.delivered == before + 10)  # noqa: B023
    assert rows(tmp_path, "SELECT COUNT(*) FROM results") == [(40,)]
    assert rows(tmp_path, "SELECT COUNT(DISTINCT epoch) FROM results") == [(4,)]
