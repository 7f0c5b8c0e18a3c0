"""The soak under chaos, short: ``chaos_soak.py`` has the long form."""

from __future__ import annotations

import asyncio
from functools import partial
from random import Random

import chaos_soak
import pytest
from chaos_ledger import NOBODY, RECORD, Ledger
from chaos_station import Station, TellingEmulator, Watch

from smartcam.emulator import EmulatedCamera
from smartcam.protocols import messages as m

pytestmark = pytest.mark.long

SEED = 1


async def test_soak_under_chaos_has_no_wrong_result_and_loses_nothing_unseen(
    capsys: pytest.CaptureFixture[str],
) -> None:
    made = await chaos_soak.soak(4, 6.0, SEED, interval=0.2)
    with capsys.disabled():
        print(f"\nseed {SEED}\n{chaos_soak.report(made)}")  # noqa: T201
    assert made.watch.violations == []
    assert made.watch.counts["trigger: done"] > 50
    assert made.faults.total() > 5


def a_ledger(*serials: int) -> tuple[Ledger, list[str]]:
    """Return a ledger of a camera that has sent some containers over one link."""
    emulator = TellingEmulator(numbered=True)
    for serial in serials:
        data = RECORD.pack(serial, NOBODY, 0, 0, 1)
        message = m.ResultContainer(application=1, data=data)
        frame = emulator.spoken.to_frame(message)
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
    monkeypatch.setattr(emulator, "received", partial(EmulatedCamera.received, emulator))
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
