"""The task sweep in short: every task cancelled before its first step, and behind some more."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from tests.proofs.task_scenes import SCENES
from tests.proofs.task_sweep import Program, steps_of, sweep

MAX_STEPS = 3
"""Steps of a task behind which it is cancelled, at most; the long form has every one."""


IN_EVERY_RUN = {"client", "frame source", "source closed at once"}


LONG = [pytest.param(name, marks=pytest.mark.long) for name in SCENES if name not in IN_EVERY_RUN]


@pytest.mark.parametrize("name", [*sorted(IN_EVERY_RUN), *LONG])
def test_task_cancelled_by_somebody_leaves_nothing_that_waits_or_stays(name: str) -> None:
    assert sweep(name, MAX_STEPS) > 0


async def _forgetful(program: Program) -> None:
    """Rest on the ``finally`` of a task that may never begin."""
    done = asyncio.get_running_loop().create_future()

    async def work() -> None:
        try:
            await asyncio.sleep(0)
        finally:
            done.set_result(None)

    await program.call(_asked(work, done))


async def _asked(work: Any, done: asyncio.Future[None]) -> None:
    task = asyncio.create_task(work())
    await asyncio.wait({done})
    await task


def test_sweep_finds_a_wait_that_rests_on_a_task_that_never_begins(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("tests.proofs.task_sweep.PACKAGE", __file__)
    monkeypatch.setitem(SCENES, "forgetful", _forgetful)
    assert steps_of(_forgetful) == [1]
    with pytest.raises(AssertionError, match="waits on and on") as caught:
        sweep("forgetful")
    assert "behind step 0" in caught.value.__notes__[0]
