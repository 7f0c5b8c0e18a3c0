"""Faults on the wire over UDP, datagram by datagram."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator

import pytest

from smartcam.emulator import EmulatedCamera, ManualClock, faults
from smartcam.protocols import messages as m
from tests.emulator import camera_wire as wire
from tests.emulator.camera_wire import UdpClient
from tests.handmade import until


@pytest.fixture
async def emulator(clock: ManualClock) -> AsyncIterator[EmulatedCamera]:
    async with EmulatedCamera(transport="udp", clock=clock) as camera:
        yield camera


@pytest.fixture
async def session(emulator: EmulatedCamera) -> AsyncIterator[UdpClient]:
    async with UdpClient(emulator) as client:
        await wire.greet(client)
        yield client


@pytest.mark.parametrize("overtaken", [False, True])
async def test_delay_is_for_this_datagram_alone(
    emulator: EmulatedCamera, session: UdpClient, clock: ManualClock, overtaken: bool
) -> None:
    emulator.inject(faults.Delay(on="QueryAnswer", seconds=2, overtaken=overtaken))
    session.send(wire.QUERY, wire.GET_CLOCK)
    await session.expect(wire.CLOCK_0)
    clock.advance(1.999)
    session.expect_silence()
    clock.advance(0.001)
    await session.expect(wire.ACTIVE_1)


async def test_delays_of_one_instant_come_in_the_order_they_were_said(
    emulator: EmulatedCamera, session: UdpClient, clock: ManualClock
) -> None:
    emulator.inject(
        faults.Delay(on="QueryAnswer", seconds=2), faults.Delay(on="ClockAnswer", seconds=2)
    )
    session.send(wire.QUERY, wire.GET_CLOCK)
    await emulator.wait_received(m.GetClock)
    clock.advance(2)
    await session.expect(wire.ACTIVE_1, wire.CLOCK_0)


async def test_delay_of_the_clients_datagram(
    emulator: EmulatedCamera, session: UdpClient, clock: ManualClock
) -> None:
    emulator.inject(faults.Delay(on="Query", seconds=2))
    session.send(wire.QUERY, wire.GET_CLOCK)
    await session.expect(wire.CLOCK_0)
    clock.advance(2)
    await session.expect(wire.ACTIVE_1)


async def test_split_gives_two_datagrams(
    emulator: EmulatedCamera, session: UdpClient, clock: ManualClock
) -> None:
    emulator.inject(
        faults.Split(on="QueryAnswer", after=4), faults.Split(on="QueryAnswer", after=9, pause=1)
    )
    session.send(wire.QUERY, wire.GET_CLOCK)
    await session.expect(wire.ACTIVE_1[:4], wire.ACTIVE_1[4:9], wire.CLOCK_0)
    session.expect_silence()
    clock.advance(1)
    await session.expect(wire.ACTIVE_1[9:])


async def test_coalesce_gives_one_datagram(
    emulator: EmulatedCamera, session: UdpClient, clock: ManualClock
) -> None:
    emulator.inject(faults.Coalesce(on="QueryAnswer", seconds=5))
    session.send(wire.QUERY)
    await emulator.wait_received(m.Query)
    clock.advance(4.999)
    session.expect_silence()
    session.send(wire.SWITCH_5, wire.QUERY)
    await session.expect(wire.ACTIVE_1 + wire.REFUSED_1, wire.ACTIVE_1)
    emulator.inject(faults.Coalesce(on="QueryAnswer", count=2, seconds=5))
    session.send(wire.QUERY, wire.SWITCH_5)
    await emulator.wait_received(m.SwitchApplication, count=2)
    clock.advance(5)
    await session.expect(wire.ACTIVE_1 + wire.REFUSED_1)
    assert [entry.fault for entry in emulator.log][-2:] == ["coalesce", None]


async def test_truncate_is_a_short_datagram(emulator: EmulatedCamera, session: UdpClient) -> None:
    emulator.inject(faults.Truncate(on="QueryAnswer", keep=5, then="continue"))
    session.send(wire.QUERY, wire.QUERY)
    await session.expect(wire.ACTIVE_1[:5], wire.ACTIVE_1)


async def test_truncate_to_nothing_sends_no_datagram(
    emulator: EmulatedCamera, session: UdpClient
) -> None:
    emulator.inject(faults.Truncate(on="QueryAnswer", keep=0, then="continue"))
    session.send(wire.QUERY, wire.GET_CLOCK)
    await session.expect(wire.CLOCK_0)


async def test_truncate_stall_says_nothing_more_until_cleared(
    emulator: EmulatedCamera, session: UdpClient
) -> None:
    emulator.inject(faults.Truncate(on="QueryAnswer", keep=5, then="stall"))
    session.send(wire.QUERY, wire.START)
    await session.expect(wire.ACTIVE_1[:5])
    await emulator.wait_received(m.Start)
    assert emulator.device.running
    session.expect_silence()
    emulator.clear_faults()
    session.send(wire.QUERY)
    await session.expect(wire.ACTIVE_1)


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (faults.Drop(on="QueryAnswer"), ()),
        (faults.Drop(on="Query"), ()),
        (faults.Duplicate(on="QueryAnswer"), (wire.ACTIVE_1, wire.ACTIVE_1)),
        (faults.Duplicate(on="Query", copies=2), (wire.ACTIVE_1,) * 3),
        (faults.Corrupt(on="QueryAnswer", offset=12, value=21), (wire.ACTIVE_21,)),
        (faults.Corrupt(on="Query", offset=8, value=0x32), (wire.CLOCK_0,)),
        (faults.Insert(on="QueryAnswer", data=b"?"), (b"?", wire.ACTIVE_1)),
        (faults.Insert(on="QueryAnswer", data=b"?", where="after"), (wire.ACTIVE_1, b"?")),
        (faults.Insert(on="QueryAnswer", data=b"?", where="instead"), (b"?",)),
    ],
    ids=str,
)
async def test_datagrams(
    emulator: EmulatedCamera, session: UdpClient, fault: faults.Fault, expected: tuple[bytes, ...]
) -> None:
    emulator.inject(fault)
    session.send(wire.QUERY, wire.SWITCH_5)
    await session.expect(*expected, wire.REFUSED_1)


@pytest.mark.parametrize("kind", ["close", "reset"])
@pytest.mark.parametrize("on", ["QueryAnswer", "Query"])
async def test_close_and_reset_forget_the_session_in_silence(
    emulator: EmulatedCamera, session: UdpClient, kind: str, on: str
) -> None:
    emulator.inject({"kind": kind, "on": on})
    session.send(wire.QUERY, wire.START)
    await emulator.wait_received(m.Start)
    assert not emulator.has_session
    assert not emulator.device.running
    session.expect_silence()
    await wire.greet(session)


async def test_half_open_loses_both_directions_for_its_time(
    emulator: EmulatedCamera, session: UdpClient, clock: ManualClock
) -> None:
    emulator.inject(faults.HalfOpen(on="QueryAnswer", seconds=10))
    session.send(wire.QUERY)
    await until(lambda: len(emulator.fired) == 1)
    emulator.device.start()
    clock.advance(9.999)
    session.send(wire.STOP)
    async with UdpClient(emulator) as other:
        other.send(wire.GET_CLOCK)  # without a session: it only shows that Stop was lost
        await emulator.wait_received(m.GetClock)
    assert emulator.device.running
    clock.advance(0.001)
    session.expect_silence()
    session.send(wire.QUERY)
    await session.expect(wire.ACTIVE_1)


async def test_half_open_stays_deaf_if_another_client_takes_over(
    emulator: EmulatedCamera, session: UdpClient
) -> None:
    emulator.inject(faults.HalfOpen(on="QueryAnswer"))
    session.send(wire.QUERY)
    await until(lambda: len(emulator.fired) == 1)
    async with UdpClient(emulator) as newcomer:
        await wire.greet(newcomer)
        session.send(wire.CONNECT)
        newcomer.send(wire.QUERY)
        await newcomer.expect(wire.ACTIVE_1)
        assert emulator.sessions == [newcomer.address]
        emulator.clear_faults()
        await wire.greet(session)


async def test_refuse_loses_both_directions_and_keeps_the_session(
    emulator: EmulatedCamera, session: UdpClient, clock: ManualClock
) -> None:
    emulator.inject(faults.Refuse(seconds=3))
    session.send(wire.START)
    with pytest.raises(ConnectionRefusedError):  # the system tells a connected socket
        session.socket.recv(1)
    emulator.device.trigger()
    emulator.device.start()
    clock.advance(3)
    opening = emulator._port._opening
    assert opening is not None
    await until(opening.done)
    assert emulator.has_session
    lost = [entry for entry in emulator.log if entry.fault is not None]
    assert [(e.message, e.fault, e.wire) for e in lost] == [
        (m.StatusReport(status=emulator.device.status), "refuse", "")
    ]
    session.send(wire.QUERY)
    await session.expect(wire.ACTIVE_1)


async def test_refuse_loses_what_is_said_until_the_port_is_open_again(
    emulator: EmulatedCamera, session: UdpClient
) -> None:
    emulator.inject(faults.Refuse(seconds=3))
    emulator.clear_faults()
    emulator.device.start()
    assert (emulator.log[-1].fault, emulator.log[-1].wire) == ("refuse", "")
    session.expect_silence()


async def test_refuse_cleared_and_stopped_at_once_leaves_nothing() -> None:
    emulator = EmulatedCamera(transport="udp", clock=ManualClock())
    await emulator.start()
    for _ in range(3):
        emulator.inject(faults.Refuse(seconds=3))
        emulator.clear_faults()
    emulator.inject(faults.Refuse(seconds=3))
    await emulator.stop()
    await emulator.start()
    async with UdpClient(emulator) as client:
        await wire.greet(client)
    await emulator.stop()


@pytest.mark.parametrize("rounds", range(6))
async def test_refuse_while_the_port_opens_leaves_nothing(
    clock: ManualClock, rounds: int, caplog: pytest.LogCaptureFixture
) -> None:
    emulator = EmulatedCamera(transport="udp", clock=clock)
    await emulator.start()
    for _ in range(2):
        emulator.inject(faults.Refuse(seconds=3))
        emulator.clear_faults()
        for _ in range(rounds):
            await asyncio.sleep(0)
    emulator.inject(faults.Refuse(seconds=3))
    for _ in range(4):
        await asyncio.sleep(0)
    emulator.clear_faults()
    opening = emulator._port._opening
    assert opening is not None
    await until(opening.done)
    async with UdpClient(emulator) as client:
        await wire.greet(client)
        emulator.clear_faults()
        client.send(wire.QUERY)
        await client.expect(wire.ACTIVE_1)
    await emulator.stop()
    assert [one for one in caplog.records if one.levelno >= logging.WARNING] == []


async def test_empty_datagram_and_two_in_one_pass_the_long_way(
    emulator: EmulatedCamera, session: UdpClient
) -> None:
    emulator.inject(faults.Drop(on="Trigger"))
    session.send(b"", wire.QUERY + wire.QUERY, wire.QUERY)
    await session.expect(wire.ACTIVE_1)
    errors = [str(entry.error) for entry in emulator.log if entry.error is not None]
    assert len(errors) == 2
    assert all("not one whole frame" in error for error in errors)


async def test_stop_while_datagrams_are_held_back_leaves_nothing(clock: ManualClock) -> None:
    given = [
        faults.Delay(on="QueryAnswer", seconds=60),
        faults.Delay(on="GetClock", seconds=60),
        faults.HalfOpen(on="Start", seconds=60),
    ]
    emulator = EmulatedCamera(transport="udp", clock=clock, faults=given)
    await emulator.start()
    async with UdpClient(emulator) as client:
        client.send(wire.CONNECT, wire.QUERY, wire.GET_CLOCK, wire.START)
        await client.expect(*wire.HELLO)
        await until(lambda: len(emulator.fired) == 3)
        await emulator.stop()
        clock.advance(100)
        client.expect_silence()


async def test_too_much_held_back_forgets_the_client(clock: ManualClock) -> None:
    big = {"id": 2, "layout": "s: string[60000]", "constant": [""], "rate": 100}
    given = [faults.Delay(on="ResultContainer", seconds=3600, times=None)]
    async with (
        EmulatedCamera([big], transport="udp", clock=clock, faults=given, running=True) as emulator,
        UdpClient(emulator) as client,
    ):
        client.send(wire.CONNECT)
        await client.expect(wire.CONNECTED, wire.RUNNING)
        clock.advance(1)
        assert not emulator.has_session
        assert emulator.links == []
