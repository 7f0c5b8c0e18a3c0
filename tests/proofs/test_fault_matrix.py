"""The fault matrix, a sample of it: ``fault_matrix.py`` has the long form."""

from __future__ import annotations

import asyncio
import itertools
import socket
import sys
from dataclasses import replace
from datetime import datetime
from typing import Any

import pytest

import smartcam
from smartcam.camera import Camera
from smartcam.client import SmartCamera
from smartcam.emulator import EmulatedCamera
from smartcam.emulator import faults as f
from smartcam.observers import TraceEntry
from smartcam.protocols import BVS
from smartcam.protocols._inside import ResultCode
from smartcam.testing import proxy as rules
from tests.proofs import fault_matrix
from tests.proofs.books import BookKeeper, ClientEar
from tests.proofs.fault_matrix import Runner, cells, is_apart, sample
from tests.proofs.matrix_camera import by_camera
from tests.proofs.matrix_cells import LOST, NONE, OPS, SILENT, Cell, Fault, by_rule, ops_of, places
from tests.proofs.matrix_world import PATIENT, Bench, World

STRIDE = 260
"""Of some 49,000 cells; the short form takes seconds."""

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(sys.platform == "win32", reason="link proxies need add_reader"),
]

TCP = World("handbook", "tcp", numbered=True)
BID = World("bid", "tcp", numbered=False)
CUT = by_rule(OPS["trigger"], rules.Cut(at=30), LOST, bounds=PATIENT)
STALL = by_rule(OPS["trigger"], rules.Stall(at=30), SILENT)


async def test_sample_of_the_fault_matrix_passes(capsys: pytest.CaptureFixture[str]) -> None:
    runner = Runner()
    every = await cells()
    assert len({cell.name for cell in every}) == len(every) > 40_000
    for dialect, transport in itertools.product(BVS.dialects, ("tcp", "udp")):
        here = [one for one in every if one.world[:2] == (dialect, transport)]
        assert {one.op for one in here} == set(ops_of(here[0].world))
    chosen = sample(every, STRIDE)
    assert {one.world.dialect for one in chosen} == set(BVS.dialects)
    done = await runner.run([one for one in chosen if not is_apart(one)])
    with capsys.disabled():
        print(f"\n{fault_matrix.table(done)}")  # noqa: T201
    assert fault_matrix.failures(done, most=5) == ""
    assert runner.reports == []


@pytest.mark.real_time
async def test_camera_that_is_killed_or_stopped_at_any_place_passes() -> None:
    runner = Runner()
    done = await runner.run([one for one in sample(await cells(), STRIDE) if is_apart(one)])
    assert done
    assert fault_matrix.failures(done, most=5) == ""
    assert runner.reports == []


async def test_every_message_of_a_dialect_is_a_place_of_the_fault_matrix() -> None:
    for world in (TCP, World("b16", "tcp", numbered=True), BID):
        found = [await places(world, name) for name in ops_of(world)]
        names = {place.frame.message for some in found for place in some}
        assert names == {row.type.__name__ for row in world.spoken.table}


async def judged(fault: Fault, op: str = "trigger", world: World = TCP) -> str:
    """Return what is found to be wrong with one cell."""
    runner = Runner()
    (verdict,) = await runner.run([Cell("one", world, op, "fault", fault)])
    return "\n".join([*verdict.wrong, *runner.reports])


def armed_with(act: Any) -> Fault:
    """Return a fault that does something of this test beside cutting the link."""

    def arm(bench: Bench) -> None:
        CUT.arm(bench)
        act(bench)

    return replace(CUT, arm=arm)


# ---------------------------------------------------------------------- the matrix itself


async def test_cell_in_order_has_nothing_wrong() -> None:
    assert await judged(CUT) == ""
    assert await judged(STALL) == ""


async def test_error_that_is_not_allowed_is_wrong() -> None:
    assert "ended with ConnectionLostError" in await judged(replace(CUT, allowed=NONE))


async def test_error_that_does_not_come_at_once_is_wrong() -> None:
    assert "its bound is 0.000 s" in await judged(replace(STALL, at_once=0.0))


async def test_fault_that_does_not_happen_is_wrong() -> None:
    far = by_rule(OPS["trigger"], rules.Cut(at=1_000_000), LOST)
    assert await judged(far) == "the fault did not happen"


async def test_client_that_does_not_work_again_is_wrong() -> None:
    busy = by_camera([f.BusyForEver(on="Trigger")], SILENT)
    assert "does not work again: {'TriggerTimeoutError'" in await judged(busy)


async def test_result_of_an_earlier_run_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(BookKeeper, "time", 1e6)
    assert "a stale result: run" in await judged(CUT)


async def test_trigger_that_the_camera_refused_may_be_sent_again() -> None:
    busy: dict[str, int | str] = {"code": int(ResultCode.BUSY)}
    refused = f.Insert(on="TriggerAnswer", message="TriggerAnswer", fields=busy, where="instead")
    assert await judged(by_camera([refused], NONE, bounds=PATIENT), world=BID) == ""


async def test_trigger_that_is_sent_twice_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    trigger = Camera.trigger

    async def twice(camera: Camera, *arguments: Any, **options: Any) -> object:
        await trigger(camera, *arguments, **options)
        return await trigger(camera, *arguments, **options)

    monkeypatch.setattr(SmartCamera, "trigger", twice)
    assert "one call sent 2 triggers, 0 were refused" in await judged(CUT)


async def test_clock_that_is_not_the_cameras_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    async def get_clock(_: Camera) -> datetime:
        return datetime(2000, 1, 1)  # noqa: DTZ001 - it has no zone

    monkeypatch.setattr(SmartCamera, "get_clock", get_clock)
    assert "clock 2000-01-01" in await judged(CUT, "query")


async def test_container_that_the_client_counts_and_nobody_hears_is_wrong(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    on_frame = ClientEar.on_frame

    def deaf(ear: ClientEar, entry: TraceEntry) -> None:
        if entry.message != "ResultContainer":
            on_frame(ear, entry)

    monkeypatch.setattr(ClientEar, "on_frame", deaf)
    found = await judged(CUT)
    assert "0 containers heard, 3 in account" in found
    assert "lost without a loss of the link" in found


async def test_task_that_is_left_is_wrong() -> None:
    left: list[asyncio.Task[Any]] = []

    def leave(_: Bench) -> None:
        left.append(asyncio.create_task(asyncio.sleep(3600), name="left alone"))

    try:
        assert await judged(armed_with(leave)) == "tasks were left: ['left alone']"
    finally:
        for task in left:
            task.cancel()


async def test_socket_that_is_left_is_wrong() -> None:
    left: list[socket.socket] = []

    def leave(bench: Bench) -> None:
        left.append(socket.create_connection((bench.proxy.host, bench.proxy.port)))

    try:
        assert await judged(armed_with(leave)) == "a socket was left open"
    finally:
        for sock in left:
            sock.close()


async def test_known_failure_that_does_not_happen_is_wrong() -> None:
    assert await judged(replace(CUT, known="it hangs")) == "no longer so: it hangs"
    assert await judged(replace(CUT, allowed=NONE, known="it ends")) == ""


async def test_report_of_the_loop_is_wrong() -> None:
    def report(_: Bench) -> None:
        asyncio.get_running_loop().call_exception_handler({"message": "lost and found"})

    assert "lost and found" in await judged(armed_with(report))


# ---------------------------------------------------------------------- what it has found


async def test_length_that_swallows_what_follows_ends_the_link_of_who_only_subscribed() -> None:
    """Without a magic number bytes keep coming, so it does not look dead."""
    bomb = [f.Corrupt(on="StatusReport", nth=3, offset=at, value=0xFF) for at in (2, 3)]
    async with EmulatedCamera(dialect="bid", faults=bomb) as emulator:
        camera = smartcam.connect(emulator.url, request_timeout=0.3, liveness_timeout=None)
        events = camera.events()
        reason = ""
        async with camera, asyncio.timeout(5):
            while not reason:
                event = await anext(events)
                reason = event.reason if isinstance(event, smartcam.Disconnected) else ""
            await camera.wait_connected()
    assert "a frame of message 0x12 announces 65535 bytes" in reason
