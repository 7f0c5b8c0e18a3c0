"""The proof of outlets in short, and that its judge notices what is lost or doubled."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable

import pytest

from tests.proofs.outlet_lives import Life, value_of
from tests.proofs.outlets import KINDS, Arrived, Cell, Lived, judge, plan

CELLS = 2 * len(KINDS)
"""Cells of the short form: two of each kind."""


@pytest.mark.long
@pytest.mark.skipif(not hasattr(os, "fork"), reason="lives are forked")
def test_lives_that_are_cut_off_lose_nothing_unseen_and_double_nothing() -> None:
    process = subprocess.run(  # noqa: S603
        [sys.executable, "-m", "tests.proofs.outlets", "--cells", str(CELLS), "--seed", "7"],
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert process.returncode == 0, process.stdout + process.stderr
    assert f"{CELLS} cells" in process.stdout
    assert "0 cells failed" in process.stdout


def _cell() -> tuple[Cell, list[Lived], dict[str, Arrived]]:
    """Return a cell of two lives: three results of one camera, of which the last was in memory."""
    cell = plan(1, KINDS.index("line"))
    cell.lives = [Life(3), Life(0, drains=True)]
    first = Lived(["cam3"] * 3, epoch=5, before=0, kept=2, code=9)
    account = {"results": 2, "delivered": 2, "spooled": 0, "dropped": {}}
    lives = [first, Lived(epoch=6, before=2, kept=2, account=account)]
    found = {
        f"cam3/5/{n}": Arrived("cam3", 5, n, "result", value_of(0, n - 1), 0, False, None)
        for n in (1, 2)
    }
    gap = Arrived("cam3", 5, 3, "gap", None, 0, True, "the process crashed")
    return cell, lives, {**found, "cam3/5/3/gap": gap}


def test_the_judge_takes_what_is_told() -> None:
    figures = judge(*_cell())
    assert (figures["arrived"], figures["told without a number"]) == (2, 1)


def _lost(found: dict[str, Arrived]) -> None:
    del found["cam3/5/2"]


def _untold(found: dict[str, Arrived]) -> None:
    del found["cam3/5/3/gap"]


def _doubled(found: dict[str, Arrived]) -> None:
    found["cam3/6/1"] = found["cam3/5/1"]._replace(epoch=6, number=1)


def _wrong(found: dict[str, Arrived]) -> None:
    found["cam3/5/2"] = found["cam3/5/2"]._replace(value=value_of(0, 2))


def _disordered(found: dict[str, Arrived]) -> None:
    found["cam3/5/1"] = found.pop("cam3/5/1")


@pytest.mark.parametrize("spoil", [_lost, _untold, _doubled, _wrong, _disordered])
def test_the_judge_notices(spoil: Callable[[dict[str, Arrived]], None]) -> None:
    cell, lives, found = _cell()
    spoil(found)
    with pytest.raises(AssertionError):
        judge(cell, lives, found)
