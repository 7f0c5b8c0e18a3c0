"""Both storms and the soak, short: ``late_storm.py``, ``adversary_storm.py``, ``chaos_soak.py``."""

from __future__ import annotations

import asyncio
import runpy
import sys
from functools import partial
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING

import pytest

import smartcam
from smartcam.emulator import EmulatedCamera
from smartcam.emulator import faults as f
from smartcam.models import Status
from smartcam.protocols import messages as m
from tests.proofs import adversary_storm, chaos_soak, late_storm
from tests.proofs.adversary_storm import AdversaryStorm
from tests.proofs.books import RECORD, BookKeeper, Ledger
from tests.proofs.chaos_station import Station, Watch
from tests.proofs.late_storm import LateStorm
from tests.proofs.storm import storms, table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.emulator._inside import BaseFault

pytestmark = pytest.mark.long

LATE_CALLS, ADVERSARY_CALLS = 150, 100
SEED = 1


async def test_storm_of_late_results_gives_no_trigger_another_ones_result(
    capsys: pytest.CaptureFixture[str],
) -> None:
    variants = [one for one in late_storm.VARIANTS if one.rule == "own"]
    done = await storms(LateStorm, variants, LATE_CALLS, SEED, at_once=7)
    with capsys.disabled():
        print(f"\nseed {SEED}\n{table(LateStorm, done)}")  # noqa: T201
    assert [text for one in done for text in one.violations] == []
    for one, variant in zip(done, variants, strict=True):
        assert one.outcomes["result"] > one.calls / 20, one.variant.name
        # loading an application after each trigger whose input is in doubt pays the debts
        fewest = 0.0 if variant.reads_input else one.calls / 20
        assert one.late > fewest, one.variant.name


async def test_storm_where_nothing_is_promised_counts_wrong_results() -> None:
    """The proof itself: it sees a wrong result where there is one."""
    variant = next(one for one in late_storm.VARIANTS if one.name == "best effort: udp held")
    (done,) = await storms(LateStorm, [variant], LATE_CALLS, SEED)
    assert done.violations == []
    assert done.wrong > 0


async def test_debt_that_is_paid_soon_costs_no_stop() -> None:
    assert await late_storm.debt_cost(0.01) < await late_storm.debt_cost(1.0)


async def test_debt_is_awaited_where_no_stop_can_void_it() -> None:
    assert await late_storm.debt_cost(0.3, "bid") > 290


FEEDABLE = {"id": 5, "layout": "n: int32", "input": "token: int32", "generator": "sequence"}
ANSWER_IS_LATE: dict[str, Sequence[BaseFault]] = {
    "SetInputAnswer": [f.Delay(on="SetInputAnswer", seconds=0.1)],
    "ResetErrorsAnswer": [
        f.Overtrigger(on="Trigger"),
        f.Delay(on="ResetErrorsAnswer", seconds=0.1),
    ],
}


@pytest.mark.parametrize("name", ANSWER_IS_LATE)
async def test_trigger_shorter_than_an_answer_that_it_needs_does_not_cost_the_link(
    name: str,
) -> None:
    faults = ANSWER_IS_LATE[name]
    async with (
        EmulatedCamera([FEEDABLE], active=5, dialect="bid", faults=faults) as emulator,
        smartcam.connect(emulator.url) as camera,
    ):
        for _ in faults[1:]:
            with pytest.raises(smartcam.OvertriggeredError):
                await camera.trigger(input=bytes(4))
        with pytest.raises(smartcam.TriggerTimeoutError, match="no trigger was sent"):
            await camera.trigger(input=bytes(4), timeout=0.05)
        assert (await camera.trigger(input=bytes(4))).application == 5
        assert Status.OVERTRIGGERED not in camera.status
        assert camera.statistics().sessions == 1


async def test_storm_of_an_adversary_gives_no_trigger_an_older_result(
    capsys: pytest.CaptureFixture[str],
) -> None:
    variants = [one for one in adversary_storm.VARIANTS if one.rule != "count"]
    done = await storms(AdversaryStorm, variants, ADVERSARY_CALLS, SEED, at_once=len(variants))
    with capsys.disabled():
        print(f"\nseed {SEED}\n{table(AdversaryStorm, done)}")  # noqa: T201
    assert [text for one in done for text in one.violations] == []
    for one in done:
        assert one.outcomes["result"] > one.calls / 20, one.variant.name


async def test_storm_of_an_adversary_counts_wrong_results_where_nothing_is_promised() -> None:
    """The proof itself: it sees a wrong result where there is one."""
    variant = next(one for one in adversary_storm.VARIANTS if one.name == "best effort: udp")
    (done,) = await storms(AdversaryStorm, [variant], ADVERSARY_CALLS, SEED)
    assert done.violations == []
    assert done.wrong > 0


# ---------------------------------------------------------------------- the soak under chaos


async def test_soak_under_chaos_has_no_wrong_result_and_loses_nothing_unseen(
    capsys: pytest.CaptureFixture[str],
) -> None:
    made = await chaos_soak.soak(4, 3.0, SEED, interval=0.1)
    with capsys.disabled():
        print(f"\nseed {SEED}\n{chaos_soak.report(made)}")  # noqa: T201
    assert made.watch.violations == []
    assert made.watch.counts["trigger: done"] > 50
    assert made.faults.total() > 5


def a_ledger(*runs: int) -> tuple[Ledger, list[str]]:
    """Return a ledger of a camera that has sent some containers over one link."""
    emulator = BookKeeper({1: {}}, marked=True)
    for run in runs:
        data = RECORD.pack(0, run, 0, 1)
        message = m.ResultContainer(application=1, data=data)
        frame = emulator.wire_dialect.to_frame(message)
        emulator._traffic.add(0.0, "somebody:1", m.Sender.CAMERA, frame)
    complaints: list[str] = []
    return Ledger("camera", emulator, complaints.append, ordered=True), complaints


async def test_ledger_complains_of_a_gap_and_of_one_too_many() -> None:
    ledger, complaints = a_ledger(1, 2, 3)
    ledger.on_received(1)
    assert complaints == []
    ledger.on_received(3)
    ledger.on_received(3)
    assert complaints == [
        "camera: 1 containers before 3 are missing",
        "camera: container 3 came once more than it was sent",
    ]


async def test_ledger_takes_the_end_of_a_link_for_lost_with_it() -> None:
    ledger, complaints = a_ledger(1, 2, 3)
    ledger.on_received(1)
    ledger.close()
    assert (ledger.sent, ledger.received, ledger.lost) == (3, 1, 2)
    assert complaints == []


async def test_wait_beyond_its_timeout_is_a_violation() -> None:
    watch = Watch()
    station = Station(0, watch, Random(SEED))  # noqa: S311
    await station._bounded("sleep", asyncio.sleep(0.3), 0.05)
    assert [text for text in watch.violations if "sleep took" in text]


async def test_result_of_another_trigger_is_a_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    """The proof itself, with a camera whose runs say that nobody began them."""
    watch = Watch()
    station = Station(2, watch, Random(SEED))  # noqa: S311
    emulator = station.emulator
    handle = partial(EmulatedCamera.handle_message, emulator)
    monkeypatch.setattr(emulator, "handle_message", handle)
    await station.open()
    work = asyncio.create_task(station.work())
    try:
        async with asyncio.timeout(10):
            while not watch.counts["wrong"]:  # noqa: ASYNC110 - whatever it is counted by
                await asyncio.sleep(0)
    finally:
        station.stop()
        await asyncio.wait({work})
        await station.close()
    assert "has a result of -1" in watch.violations[0]


# ---------------------------------------------------------------------- the long forms


COMMANDS = [
    path
    for path in sorted(Path(__file__).parent.glob("*.py"))
    if "\ndef main(" in path.read_text(encoding="utf-8")
]


@pytest.mark.parametrize("path", COMMANDS, ids=lambda path: path.stem)
def test_long_form_starts_as_a_command(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [str(path), "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(path), run_name="__main__")
    assert ended.value.code == 0
    assert "usage:" in capsys.readouterr().out
