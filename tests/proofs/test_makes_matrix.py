"""The makes' fault matrix and cancel sweep, a sample: ``makes_matrix.py`` has the long form."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from smartcam.testing import proxy
from tests.proofs import makes_matrix
from tests.proofs.makes_matrix import (
    CALLS,
    MAKES,
    Bench,
    Books,
    Cell,
    Tally,
    cells,
    frame_cells,
    judge,
    others_cells,
    sweep,
)
from tests.timed_loop import TimedLoop

pytestmark = pytest.mark.long

STRIDE = 90
"""One of so many cells of the calls that are triggers; the short form takes seconds."""

SWEEP = 25
"""Steps between two cancellations of the short form."""


def judged(cell: Cell) -> list[str]:
    """Return what is found to be wrong with one cell."""
    with asyncio.Runner(loop_factory=TimedLoop) as runner:
        return runner.run(judge(cell))[1]


def cut(make: str, call: str = "trigger") -> Cell:
    return Cell(make, call, "cut", lambda bench: bench.proxy.from_now(proxy.Cut(at=3)))


@pytest.mark.parametrize("make", MAKES)
def test_sample_of_the_makes_matrix_passes(make: str) -> None:
    found = [*frame_cells(make, "trigger"), *others_cells(make, "trigger")]
    tally = Tally()
    makes_matrix.run([*found[:: STRIDE // 10], cut(make), cut(make, "query")], tally)
    sweep(make, "trigger", SWEEP, tally)
    assert tally.failures == []
    assert tally.ends[make, "over"] == 1
    assert tally.ends[make, "cancelled"] > 0


@pytest.mark.widest
@pytest.mark.parametrize("make", MAKES)
def test_every_ninetieth_cell_of_a_make_passes(make: str) -> None:
    with asyncio.Runner(loop_factory=TimedLoop) as runner:
        found = runner.run(cells([make]))
    assert {cell.call for cell in found} == set(MAKES[make].calls) <= set(CALLS)
    tally = Tally()
    makes_matrix.run(found[::STRIDE], tally)
    assert tally.failures == []


# ---------------------------------------------------------------------- the matrix itself


@pytest.mark.parametrize("make", MAKES)
def test_stale_result_is_wrong(make: str, monkeypatch: pytest.MonkeyPatch) -> None:
    note = Books.note

    def stale(books: Books) -> int:
        return max(1, note(books) - 1)

    monkeypatch.setattr(Books, "note", stale)
    given = Cell(make, "trigger", "none", lambda _: None, happens=_triggers_before)
    assert any("a stale result" in one for one in judged(given))


async def _triggers_before(bench: Bench) -> None:
    await bench.trigger()


@pytest.mark.parametrize("make", ["ifm v3", "iv3"])
def test_result_that_is_told_of_another_application_is_wrong(
    make: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    note = Books.note

    def other(books: Any) -> int:
        number = note(books)
        books.made[number] = 3
        return number

    monkeypatch.setattr(Books, "note", other)
    found = judged(Cell(make, "trigger", "none", lambda _: None))
    assert any("told as of 1, it is of 3" in one for one in found)


def test_task_that_is_left_is_wrong() -> None:
    left: list[asyncio.Task[Any]] = []

    def leave(_: Bench) -> None:
        left.append(asyncio.create_task(asyncio.sleep(3600), name="left alone"))

    found = judged(Cell("iv3", "query", "leaves a task", leave))
    assert found == ["tasks were left: ['left alone']"]
