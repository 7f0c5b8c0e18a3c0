"""Faults of the device: what the camera then says, on a real socket and on its own."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Any

import pytest

from smartcam.emulator import Application, EmulatedCamera, ManualClock, Quirks, faults
from smartcam.emulator._inside import Device
from smartcam.models import Status
from smartcam.protocols import Frame
from smartcam.protocols import messages as m
from smartcam.protocols._inside import HANDBOOK
from tests.emulator import camera_wire as wire
from tests.emulator.camera_wire import RawClient, UdpClient, heard
from tests.emulator.inside import SecondClientSession
from tests.handmade import until

HELLO = (wire.CONNECTED, wire.WAITING)


@pytest.fixture
async def emulator(clock: ManualClock) -> AsyncIterator[EmulatedCamera]:
    async with EmulatedCamera(clock=clock, active=21, running=True) as camera:
        yield camera


@pytest.fixture
async def session(emulator: EmulatedCamera) -> AsyncIterator[RawClient]:
    async with RawClient(emulator) as client:
        client.send(wire.CONNECT)
        await client.expect(*HELLO)
        yield client


def status(bits: int) -> bytes:
    return bytes.fromhex("50535642 08000000 12000000") + bits.to_bytes(8, "little")


RUN_BUSY = status(0x90)


# ---------------------------------------------------------------------- BUSY


async def test_busy_for_ever_takes_no_trigger_and_answers_everything(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.BusyForEver())
    await session.expect(RUN_BUSY)
    session.send(wire.TRIGGER, wire.QUERY)
    await session.expect(wire.ACTIVE_21)
    clock.advance(3600)
    assert not emulator.device.processing
    emulator.clear_faults()
    await session.expect(wire.WAITING)
    session.send(wire.TRIGGER)
    await session.expect(wire.RUNNING)


async def test_busy_for_ever_for_a_time(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.BusyForEver(seconds=4))
    await session.expect(RUN_BUSY)
    clock.advance(3.999)
    session.expect_silence()
    clock.advance(0.001)
    await session.expect(wire.WAITING)


async def test_busy_for_ever_at_a_switch_stays_after_its_answer(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    session.send(wire.STOP)
    await session.expect(wire.NO_BIT)
    emulator.inject(faults.BusyForEver(on="SwitchApplication"))
    session.send(wire.SWITCH_21)
    await session.expect(wire.BUSY)
    clock.advance(0.3)
    await session.expect(wire.SWITCHED_21)
    session.send(wire.QUERY)
    await session.expect(wire.ACTIVE_21)


async def test_busy_for_ever_ends_with_a_reboot(
    emulator: EmulatedCamera, clock: ManualClock
) -> None:
    emulator.inject(faults.BusyForEver(), faults.PowerCycle(seconds=2))
    clock.advance(2)
    assert emulator.device.status == Status(0)


def test_device_that_reboots_is_not_held_busy() -> None:
    device = Device([Application(id=2)])
    device.reboot(1)
    device.hold_busy()
    device.tick(1)
    assert device.status == Status(0)


def test_device_held_busy_lets_a_free_running_application_rest() -> None:
    free = Application(id=2, layout="n: uint8", constant=[1], rate=10, processing_time=0.01)
    device = Device([free], running=True)
    device.tick(0.35)
    assert device.next_number == 4
    device.hold_busy(0.5)
    device.tick(0.5)
    assert device.next_number == 4
    device.tick(0.1)
    assert device.next_number == 5


# ---------------------------------------------------------------------- triggers and results


async def test_overtrigger_drops_the_trigger_it_waits_for(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.Overtrigger(on="Trigger"))
    session.send(wire.TRIGGER)
    await session.expect(wire.OVERTRIGGERED_WAITING)
    assert emulator.device.next_number == 0
    clock.advance(0.1)
    await session.expect(wire.WAITING)
    session.send(wire.TRIGGER)
    await session.expect(wire.RUNNING)
    clock.advance(0.05)
    await session.expect(wire.HELLO_WORLD, wire.WAITING)


async def test_overtrigger_at_once_counts_triggers_of_any_kind(
    emulator: EmulatedCamera, session: RawClient
) -> None:
    emulator.inject(faults.Overtrigger(count=2))
    assert not emulator.device.trigger()
    session.send(wire.TRIGGER)
    await session.expect(wire.OVERTRIGGERED_WAITING)
    await emulator.wait_received(m.Trigger)
    assert emulator.device.trigger()


async def test_late_result_of_the_trigger(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.LateResult(on="Trigger", nth=2, seconds=3))
    for late in (0.0, 3.0, 0.0):
        session.send(wire.TRIGGER)
        await session.expect(wire.RUNNING)
        clock.advance(0.049 + late)
        session.expect_silence()
        clock.advance(0.001)
        await session.expect(wire.HELLO_WORLD, wire.WAITING)


async def test_late_result_of_the_inspection_under_way(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    session.send(wire.TRIGGER)
    await session.expect(wire.RUNNING)
    clock.advance(0.04)
    emulator.inject(faults.LateResult(seconds=1), faults.LateResult(seconds=2))
    clock.advance(3.009)
    session.expect_silence()
    clock.advance(0.001)
    await session.expect(wire.HELLO_WORLD, wire.WAITING)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ([faults.NoResult(on="Trigger")], []),
        ([faults.NoResult()], []),
        ([faults.NoResult(on="Trigger", when="after")], []),
        ([faults.ExtraResult(on="Trigger")], [wire.HELLO_WORLD] * 2),
        ([faults.ExtraResult(count=3)], [wire.HELLO_WORLD] * 4),
        ([faults.ExtraResult(), faults.NoResult()], []),
    ],
)
async def test_results_of_one_inspection(
    emulator: EmulatedCamera,
    session: RawClient,
    clock: ManualClock,
    given: list[faults.Fault],
    expected: list[bytes],
) -> None:
    emulator.inject(*given)
    session.send(wire.TRIGGER)
    await session.expect(wire.RUNNING)
    clock.advance(0.05)
    await session.expect(*expected, wire.WAITING)
    session.send(wire.TRIGGER)
    await session.expect(wire.RUNNING)
    clock.advance(0.05)
    await session.expect(wire.HELLO_WORLD, wire.WAITING)


def test_device_change_of_a_run_that_is_void_is_forgotten() -> None:
    device = Device([Application(id=2, layout="n: uint8", constant=[1])], running=True)
    device.handle(m.Connect())
    device.handle(m.Trigger())
    device.change_inspection(no_result=True)
    device.stop()
    device.start()
    device.handle(m.Trigger())
    heard(device)
    device.tick(0.05)
    assert heard(device) == ["result 2 01", "[run wait]"]


def test_device_late_free_run_swallows_the_runs_that_would_begin_meanwhile() -> None:
    free = Application(
        id=2, layout="n: uint8 @sequence", generator="sequence", rate=10, processing_time=0.02
    )
    device = Device([free], running=True)
    device.handle(m.Connect())
    device.tick(0.05)
    device.change_inspection(late=0.25)
    assert heard(device)[2:] == ["result 2 00"]
    device.tick(0.3)
    assert heard(device) == []
    device.tick(0.02)
    assert heard(device) == ["result 2 01"]
    device.tick(0.1)
    assert heard(device) == ["result 2 02"]


# ---------------------------------------------------------------------- the operator


async def test_operator_faults_at_once(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.OperatorStop())
    await session.expect(wire.NO_BIT)
    emulator.inject(faults.OperatorStart())
    await session.expect(wire.WAITING)
    emulator.inject(faults.Condition(condition="overheat"))
    await session.expect(status(0x281))
    emulator.inject(faults.Condition(condition="overheat", active=False))
    await session.expect(wire.WAITING)
    emulator.inject(faults.Condition(condition="system_error"))
    await session.expect(status(0x82))
    emulator.inject({"kind": "condition", "condition": "system_error", "active": False})
    await session.expect(wire.WAITING)
    emulator.inject(faults.OperatorSwitch(application=3, running=True))
    await session.expect(wire.BUSY)
    clock.advance(0.3)
    await session.expect(wire.NO_BIT, wire.WAITING)
    assert emulator.device.active_application == 3


async def test_stop_before_and_after_the_trigger(
    emulator: EmulatedCamera, session: RawClient
) -> None:
    emulator.inject(faults.OperatorStop(on="Trigger"))
    session.send(wire.TRIGGER, wire.START)
    await session.expect(wire.NO_BIT, wire.WAITING)
    emulator.inject(faults.OperatorStop(on="Trigger", when="after"))
    session.send(wire.TRIGGER)
    await session.expect(wire.RUNNING, wire.NO_BIT)


@pytest.mark.parametrize(
    ("when", "expected"),
    [("before", (wire.NO_BIT, wire.ACTIVE_21)), ("after", (wire.ACTIVE_21, wire.NO_BIT))],
)
async def test_stop_on_a_message_of_the_camera(
    emulator: EmulatedCamera, session: RawClient, when: str, expected: tuple[bytes, ...]
) -> None:
    emulator.inject({"kind": "stop", "on": "QueryAnswer", "when": when})
    session.send(wire.QUERY)
    await session.expect(*expected)


async def test_device_faults_do_not_wake_each_other_for_ever(
    emulator: EmulatedCamera, session: RawClient
) -> None:
    emulator.inject(
        faults.OperatorStop(on="StatusReport", times=None),
        faults.OperatorStart(on="StatusReport", times=None),
    )
    emulator.device.set_condition(Status.OVERHEAT, True)
    await session.expect(status(1), status(0x281), status(0x281))
    session.send(wire.QUERY)
    await session.expect(wire.ACTIVE_21)


async def test_reboot_with_its_own_time(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.PowerCycle(on="Trigger", seconds=2))
    session.send(wire.QUERY, wire.TRIGGER, wire.QUERY)
    await session.expect(wire.ACTIVE_21)
    await session.expect_fin()
    clock.advance(1.999)
    with pytest.raises(ConnectionRefusedError):
        RawClient(emulator)
    clock.advance(0.001)
    async with RawClient(emulator) as client:
        client.send(wire.CONNECT)
        await client.expect(wire.CONNECTED, wire.NO_BIT)


async def test_reboot_in_place_of_the_result(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.PowerCycle(on="ResultContainer", seconds=2))
    session.send(wire.TRIGGER)
    await session.expect(wire.RUNNING)
    clock.advance(0.05)
    await session.expect_fin()


async def test_faults_given_at_first_happen_at_the_start(clock: ManualClock) -> None:
    given: list[Any] = [{"kind": "start"}, faults.Condition(condition="overheat")]
    emulator = EmulatedCamera(clock=clock, faults=given)
    assert len(emulator.faults) == 2
    assert not emulator.device.running
    async with emulator, RawClient(emulator) as client:
        client.send(wire.CONNECT)
        await client.expect(wire.CONNECTED, status(0x281))
    assert emulator.faults == []
    assert [(fired.time, fired.message) for fired in emulator.fired] == [(0.0, None)] * 2


async def test_device_faults_count_what_the_device_handles(
    emulator: EmulatedCamera, session: RawClient
) -> None:
    emulator.inject(faults.OperatorStop(on="Query", nth=2))
    async with RawClient(emulator) as other:
        other.send(wire.QUERY, wire.QUERY)
        await emulator.wait_received(m.Query, count=2)
    session.send(wire.QUERY)
    await session.expect(wire.ACTIVE_21)
    assert len(emulator.faults) == 1
    session.send(wire.QUERY)
    await session.expect(wire.NO_BIT, wire.ACTIVE_21)


# ---------------------------------------------------------------------- the second client


async def test_second_client_over_tcp_closes_the_first(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.SecondClient(on="Query"))
    session.send(wire.GET_CLOCK, wire.QUERY)
    await session.receive()
    await session.expect_fin()
    assert emulator.sessions == ["second client"]
    emulator.device.trigger()
    clock.advance(0.05)
    told = [
        (type(e.message).__name__, e.fault, e.wire)
        for e in emulator.log
        if e.peer == "second client"
    ]
    names = ["ConnectAnswer", "StatusReport", "StatusReport", "ResultContainer", "StatusReport"]
    assert told == [(name, "second_client", "") for name in names]
    async with RawClient(emulator) as client:
        client.send(wire.CONNECT, wire.QUERY)
        await client.expect(*HELLO, wire.ACTIVE_21)
        assert emulator.sessions == [client.address]


async def test_second_client_over_udp_is_silence_for_the_first(clock: ManualClock) -> None:
    async with (
        EmulatedCamera(transport="udp", clock=clock, active=21, running=True) as emulator,
        UdpClient(emulator) as client,
    ):
        client.send(wire.CONNECT)
        await client.expect(*HELLO)
        emulator.inject(faults.SecondClient())
        client.send(wire.QUERY)
        await emulator.wait_received(m.Query)
        emulator.device.trigger()
        clock.advance(1)
        client.expect_silence()
        client.send(wire.CONNECT)
        await client.expect(*HELLO)


async def test_second_client_is_turned_away_where_newcomers_are(clock: ManualClock) -> None:
    quirks = Quirks(second_client="refuse")
    async with EmulatedCamera(clock=clock, quirks=quirks) as emulator:
        async with RawClient(emulator) as client:
            client.send(wire.CONNECT)
            await client.expect(wire.CONNECTED, wire.NO_BIT)
            emulator.inject(faults.SecondClient())
            client.send(wire.QUERY)
            await client.expect(wire.ACTIVE_1)
        await until(lambda: not emulator.has_session)
        emulator.inject(faults.SecondClient())
        assert emulator.sessions == ["second client"]
        async with RawClient(emulator) as client:
            client.send(wire.CONNECT)
            await client.expect_fin()
        emulator.clear_faults()
        async with RawClient(emulator) as client:
            client.send(wire.CONNECT)
            await client.expect(wire.CONNECTED, wire.NO_BIT)


async def test_second_client_finds_no_camera_that_is_down(
    emulator: EmulatedCamera, clock: ManualClock
) -> None:
    emulator.inject(faults.PowerCycle(seconds=5), faults.SecondClient())
    assert not emulator.has_session
    clock.advance(5)
    emulator.inject(faults.Refuse(seconds=5), faults.SecondClient())
    assert not emulator.has_session


async def test_second_client_goes_when_the_emulator_stops(emulator: EmulatedCamera) -> None:
    emulator.inject(faults.SecondClient())
    assert emulator.has_session
    await emulator.stop()
    assert not emulator.has_session
    assert not emulator.device.connected


def test_second_client_is_told_nothing_that_makes_no_frame() -> None:
    told: list[Frame] = []
    session = SecondClientSession(HANDBOOK, told.append)
    session.send(m.QueryAnswer(application=1 << 40))
    session.send(m.QueryAnswer(application=1))
    assert [HANDBOOK.encode_frame(frame) for frame in told] == [wire.ACTIVE_1]


async def test_clear_faults_before_the_start(clock: ManualClock) -> None:
    emulator = EmulatedCamera(clock=clock, faults=[faults.OperatorStart(), faults.Drop(times=None)])
    emulator.clear_faults()
    async with emulator, RawClient(emulator) as client:
        client.send(wire.CONNECT)
        await client.expect(wire.CONNECTED, wire.NO_BIT)
