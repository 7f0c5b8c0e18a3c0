"""Faults on the wire over TCP, by exact bytes."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator
from typing import Any

import pytest

from smartcam.emulator import EmulatedCamera, ManualClock, faults
from smartcam.protocols import messages as m
from tests.emulator import camera_wire as wire
from tests.emulator.camera_wire import RawClient
from tests.handmade import until


@pytest.fixture
async def emulator(clock: ManualClock) -> AsyncIterator[EmulatedCamera]:
    async with EmulatedCamera(clock=clock) as camera:
        yield camera


@pytest.fixture
async def session(emulator: EmulatedCamera) -> AsyncIterator[RawClient]:
    async with RawClient(emulator) as client:
        await wire.greet(client)
        yield client


def clock_timers(clock: ManualClock) -> list[object]:
    """Return the timers that will still call."""
    return [timer for _, _, timer in clock._timers if timer.callback is not None]


def outgoing(emulator: EmulatedCamera) -> list[tuple[str, str | None, str | None]]:
    """Return what the log says of the camera's messages since Connect: what, fault, wire."""
    return [
        (type(entry.message).__name__, entry.fault, entry.wire)
        for entry in emulator.log
        if entry.direction == "out"
    ][2:]


# ---------------------------------------------------------------------- delay


async def test_delay_keeps_the_order(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.Delay(on="QueryAnswer", seconds=2))
    session.send(wire.QUERY, wire.GET_CLOCK)
    await emulator.wait_received(m.GetClock)
    clock.advance(1.999)
    session.expect_silence()
    assert outgoing(emulator) == []
    clock.advance(0.001)
    assert await session.receive() == wire.ACTIVE_1 + wire.CLOCK_0
    assert outgoing(emulator) == [("QueryAnswer", "delay", None), ("ClockAnswer", None, None)]
    assert emulator.log[-1].time == 2.0


async def test_delay_overtaken_lets_later_messages_pass(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.Delay(on="QueryAnswer", seconds=2, overtaken=True))
    session.send(wire.QUERY, wire.GET_CLOCK)
    await session.expect(wire.CLOCK_0)
    clock.advance(1.999)
    session.expect_silence()
    clock.advance(0.001)
    await session.expect(wire.ACTIVE_1)


async def test_delay_times_none_is_a_slow_line(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.Delay(seconds=1, times=None))
    session.send(wire.QUERY)
    await emulator.wait_received(m.Query)
    clock.advance(0.5)
    session.send(wire.GET_CLOCK)
    await emulator.wait_received(m.GetClock)
    clock.advance(0.5)
    assert await session.receive() == wire.ACTIVE_1
    clock.advance(0.5)
    await session.expect(wire.CLOCK_0)
    assert len(emulator.faults) == 1


async def test_delay_of_the_clients_message_is_before_the_camera_hears_it(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.Delay(on=m.Start, seconds=2))
    session.send(wire.START, wire.QUERY)
    await until(lambda: len(emulator.fired) == 1)
    clock.advance(1.999)
    session.expect_silence()
    assert not emulator.device.running
    clock.advance(0.001)
    assert await session.receive() == wire.WAITING + wire.ACTIVE_1
    assert [(e.time, e.fault) for e in emulator.log if e.message == m.Start()] == [(2.0, "delay")]
    listener: Any = emulator._listener
    assert [link._faulty for link in listener.all_links] == [None]


async def test_delay_of_the_clients_message_overtaken(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.Delay(on=m.Start, seconds=2, overtaken=True))
    session.send(wire.START, wire.QUERY)
    await session.expect(wire.ACTIVE_1)
    clock.advance(2)
    await session.expect(wire.WAITING)


@pytest.mark.parametrize("broken", [False, True])
async def test_delay_of_the_clients_message_delays_the_end_after_it(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock, broken: bool
) -> None:
    emulator.inject(faults.Delay(on="Start", seconds=2), faults.Delay(on="Stop", seconds=3))
    session.send(wire.START, wire.STOP, wire.QUERY)
    await until(lambda: len(emulator.fired) == 2)
    if broken:
        session.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        session.socket.close()
        await until(lambda: not emulator.has_session)
        clock.advance(5)
        assert not emulator.device.running
        return
    listener: Any = emulator._listener
    (link,) = listener.all_links
    session.socket.shutdown(socket.SHUT_WR)
    await until(lambda: link._close_is_pending)
    clock.advance(2)
    await session.expect(wire.WAITING)
    assert emulator.has_session
    clock.advance(1)
    await session.expect(wire.NO_BIT, wire.ACTIVE_1)
    await session.expect_fin()
    assert not emulator.has_session


@pytest.mark.parametrize("on", ["QueryAnswer", "Query"])
async def test_delay_on_real_time(on: str) -> None:
    given = [{"kind": "delay", "on": on, "seconds": 0.05}]
    async with EmulatedCamera(faults=given) as emulator, RawClient(emulator) as client:
        client.send(wire.CONNECT, wire.QUERY)
        await client.expect(*wire.HELLO, wire.ACTIVE_1)
        answered, connected = emulator.log[-1], emulator.log[0]
        assert answered.time - connected.time >= 0.049


# ---------------------------------------------------------------------- cut, joined, changed


async def test_split_with_a_pause(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.Split(on="QueryAnswer", after=3, pause=0.5))
    session.send(wire.QUERY, wire.GET_CLOCK)
    assert await session.receive() == wire.ACTIVE_1[:3]
    await emulator.wait_received(m.GetClock)
    clock.advance(0.499)
    session.expect_silence()
    clock.advance(0.001)
    assert await session.receive() == wire.ACTIVE_1[3:] + wire.CLOCK_0
    assert outgoing(emulator) == [("QueryAnswer", "split", None), ("ClockAnswer", None, None)]


async def test_split_without_a_pause_is_two_writes(
    emulator: EmulatedCamera, session: RawClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    listener: Any = emulator._listener
    (link,) = listener.all_links
    written: list[bytes] = []
    write = link._transport.write

    def note(data: bytes) -> None:
        written.append(data)
        write(data)

    monkeypatch.setattr(link._transport, "write", note)
    emulator.inject(faults.Split(on="QueryAnswer", after=15))
    session.send(wire.QUERY)
    await session.expect(wire.ACTIVE_1)
    assert written == [wire.ACTIVE_1[:15], wire.ACTIVE_1[15:]]


async def test_split_after_the_end_leaves_it_whole(
    emulator: EmulatedCamera, session: RawClient
) -> None:
    emulator.inject(faults.Split(on="QueryAnswer", after=16, pause=5))
    session.send(wire.QUERY)
    await session.expect(wire.ACTIVE_1)


async def test_coalesce_waits_for_the_messages_behind(
    emulator: EmulatedCamera, session: RawClient
) -> None:
    emulator.inject(faults.Coalesce(on="QueryAnswer", count=2, seconds=5))
    session.send(wire.QUERY)
    await emulator.wait_received(m.Query)
    session.send(wire.GET_CLOCK)
    await emulator.wait_received(m.GetClock)
    session.expect_silence()
    session.send(wire.QUERY)
    assert await session.receive() == wire.ACTIVE_1 + wire.CLOCK_0 + wire.ACTIVE_1


async def test_coalesce_waits_no_longer_than_it_says(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.Coalesce(on="QueryAnswer", count=2, seconds=5))
    session.send(wire.QUERY, wire.GET_CLOCK)
    await emulator.wait_received(m.GetClock)
    clock.advance(4.999)
    session.expect_silence()
    clock.advance(0.001)
    assert await session.receive() == wire.ACTIVE_1 + wire.CLOCK_0


@pytest.mark.parametrize(
    ("change", "offset", "byte"),
    [
        ({"offset": 0, "value": 0x51}, 0, 0x51),
        ({"offset": -4, "value": 7}, 12, 7),
        ({"offset": 12, "xor": 0xFF}, 12, 0xFE),
        ({"offset": 4, "xor": 0x80}, 4, 0x84),
        ({"offset": 16, "xor": 1}, 0, 0x50),
        ({"offset": -17, "xor": 1}, 0, 0x50),
    ],
)
async def test_corrupt_changes_one_byte(
    emulator: EmulatedCamera, session: RawClient, change: dict[str, int], offset: int, byte: int
) -> None:
    emulator.inject({"kind": "corrupt", "on": "QueryAnswer", **change})
    expected = bytearray(wire.ACTIVE_1)
    expected[offset] = byte
    session.send(wire.QUERY)
    await session.expect(bytes(expected))
    shown = None if expected == wire.ACTIVE_1 else expected.hex(" ")
    assert outgoing(emulator) == [("QueryAnswer", "corrupt", shown)]


async def test_corrupt_of_the_clients_message_is_what_the_camera_hears(
    emulator: EmulatedCamera, session: RawClient
) -> None:
    emulator.inject(faults.Corrupt(on="Query", offset=8, value=0x32))
    for answer in (wire.CLOCK_0, wire.ACTIVE_1):
        session.send(wire.QUERY)
        await session.expect(answer)
    heard = [(e.message, e.fault) for e in emulator.log if e.direction == "in"][1:]
    assert heard == [(m.GetClock(), "corrupt"), (m.Query(), None)]
    assert [fired.message for fired in emulator.fired] == [m.Query()]


async def test_corrupt_magic_of_the_client_is_skipped_by_the_camera(
    emulator: EmulatedCamera, session: RawClient
) -> None:
    emulator.inject(faults.Corrupt(on="Query", offset=0, xor=1))
    session.send(wire.QUERY, wire.GET_CLOCK)
    await session.expect(wire.CLOCK_0)
    (error,) = [entry for entry in emulator.log if entry.error is not None]
    assert "wrong magic number" in str(error.error)
    assert error.fault == "corrupt"


async def test_drop_of_the_cameras_message(emulator: EmulatedCamera, session: RawClient) -> None:
    emulator.inject(faults.Drop(on="QueryAnswer"))
    session.send(wire.QUERY, wire.QUERY, wire.GET_CLOCK)
    await session.expect(wire.ACTIVE_1, wire.CLOCK_0)
    assert outgoing(emulator)[0] == ("QueryAnswer", "drop", "")
    assert outgoing(emulator)[1] == ("QueryAnswer", None, None)


async def test_drop_of_the_clients_message(emulator: EmulatedCamera, session: RawClient) -> None:
    emulator.inject(faults.Drop(on=0x30, sender="client"))
    session.send(wire.QUERY, wire.GET_CLOCK)
    await session.expect(wire.CLOCK_0)
    dropped = emulator.log[3]
    assert (dropped.direction, dropped.message, dropped.fault, dropped.wire) == (
        "in", m.Query(), "drop", "",
    )  # fmt: skip
    await emulator.wait_received(m.GetClock)
    assert emulator.faults == []


async def test_duplicate_of_the_cameras_message(
    emulator: EmulatedCamera, session: RawClient
) -> None:
    emulator.inject(faults.Duplicate(on="QueryAnswer", copies=2))
    session.send(wire.QUERY, wire.GET_CLOCK)
    await session.expect(*[wire.ACTIVE_1] * 3, wire.CLOCK_0)
    assert outgoing(emulator)[:3] == [("QueryAnswer", "duplicate", None)] * 3


async def test_duplicate_of_the_clients_message(
    emulator: EmulatedCamera, session: RawClient
) -> None:
    emulator.inject(faults.Duplicate(on="Query"))
    session.send(wire.QUERY, wire.GET_CLOCK)
    await session.expect(wire.ACTIVE_1, wire.ACTIVE_1, wire.CLOCK_0)
    await emulator.wait_received(m.Query, count=2)


@pytest.mark.parametrize(
    ("where", "expected"),
    [
        ("before", (wire.RUNNING, wire.ACTIVE_1)),
        ("after", (wire.ACTIVE_1, wire.RUNNING)),
        ("instead", (wire.RUNNING,)),
    ],
)
async def test_insert_a_message(
    emulator: EmulatedCamera, session: RawClient, where: Any, expected: tuple[bytes, ...]
) -> None:
    emulator.inject(
        faults.Insert(on="QueryAnswer", message=m.StatusReport, fields={"status": 128}, where=where)
    )
    session.send(wire.QUERY, wire.GET_CLOCK)
    await session.expect(*expected, wire.CLOCK_0)
    told = [(type(e.message).__name__, e.fault) for e in emulator.log if e.fault is not None]
    assert ("StatusReport", "insert") in told


@pytest.mark.parametrize(
    "data",
    ["50535642 00000000 77000000", "50535642 ffffff7f 30000000", "00"],
    ids=["unknown id", "length bomb", "garbage"],
)
async def test_insert_bytes(emulator: EmulatedCamera, session: RawClient, data: str) -> None:
    emulator.inject({"kind": "insert", "on": "QueryAnswer", "data": data})
    session.send(wire.QUERY)
    await session.expect(bytes.fromhex(data), wire.ACTIVE_1)
    inserted = emulator.log[-2]
    assert inserted.fault == "insert"
    assert inserted.message_id == (0x77 if "77" in data else None)


# ---------------------------------------------------------------------- ends


@pytest.mark.parametrize("keep", [0, 1, 11, 15, 16])
async def test_truncate_close(emulator: EmulatedCamera, session: RawClient, keep: int) -> None:
    emulator.inject(faults.Truncate(on="QueryAnswer", keep=keep, then="close"))
    session.send(wire.QUERY, wire.GET_CLOCK)
    await session.expect(wire.ACTIVE_1[:keep])
    await session.expect_fin()
    assert not emulator.has_session
    shown = None if keep == 16 else wire.ACTIVE_1[:keep].hex(" ")
    assert outgoing(emulator) == [
        ("QueryAnswer", "truncate", shown),
        ("ClockAnswer", "connection ended", ""),
    ]


async def test_truncate_reset(emulator: EmulatedCamera, session: RawClient) -> None:
    emulator.inject(faults.Truncate(on="QueryAnswer", keep=5, then="reset"))
    session.send(wire.QUERY)
    await session.expect(wire.ACTIVE_1[:5])
    await session.expect_reset()


async def test_truncate_stall_says_nothing_more_and_goes_on_listening(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.Truncate(on="QueryAnswer", keep=5, then="stall"))
    session.send(wire.QUERY, wire.START)
    await session.expect(wire.ACTIVE_1[:5])
    await emulator.wait_received(m.Start)
    clock.advance(100)
    assert emulator.device.running
    session.expect_silence()
    assert outgoing(emulator)[-1] == ("StatusReport", "truncate", "")


async def test_truncate_continue(emulator: EmulatedCamera, session: RawClient) -> None:
    emulator.inject(faults.Truncate(on="QueryAnswer", keep=5, then="continue"))
    session.send(wire.QUERY, wire.QUERY)
    await session.expect(wire.ACTIVE_1[:5], wire.ACTIVE_1)


async def test_close_before_the_message_is_an_orderly_end(
    emulator: EmulatedCamera, session: RawClient
) -> None:
    emulator.inject(faults.Close(on="QueryAnswer"))
    session.send(wire.GET_CLOCK, wire.QUERY, wire.GET_CLOCK)
    await session.expect(wire.CLOCK_0)
    await session.expect_fin()
    assert not emulator.has_session


async def test_close_after_the_message(emulator: EmulatedCamera, session: RawClient) -> None:
    emulator.inject(faults.Close(on="QueryAnswer", when="after"))
    session.send(wire.QUERY, wire.GET_CLOCK)
    await session.expect(wire.ACTIVE_1)
    await session.expect_fin()


async def test_close_is_orderly_with_unread_bytes_and_waits_for_the_client(
    emulator: EmulatedCamera, session: RawClient
) -> None:
    emulator.inject(faults.Close(on="QueryAnswer"))
    session.send(wire.QUERY)
    await session.expect_fin()
    for _ in range(20):
        session.send(wire.QUERY)
        await asyncio.sleep(0)
    assert await session.receive() == b""
    assert emulator.links == [session.address]
    session.socket.close()
    await until(lambda: emulator.links == [])


async def test_close_waits_for_the_client_no_longer_than_the_farewell(
    emulator: EmulatedCamera, session: RawClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("smartcam.emulator._links.CLOSE_TIMEOUT", 0.05)
    emulator.inject(faults.Close(on="QueryAnswer"))
    session.send(wire.QUERY)
    await session.expect_fin()
    await until(lambda: emulator.links == [])


@pytest.mark.parametrize("when", ["before", "after"])
async def test_reset_is_a_reset(emulator: EmulatedCamera, session: RawClient, when: str) -> None:
    emulator.inject({"kind": "reset", "on": "QueryAnswer", "when": when})
    session.send(wire.QUERY, wire.GET_CLOCK)
    if when == "after":
        await session.expect(wire.ACTIVE_1)
    await session.expect_reset()
    assert not emulator.has_session
    assert emulator.links == []


@pytest.mark.parametrize("kind", ["close", "reset"])
async def test_end_before_the_clients_message_is_not_heard(
    emulator: EmulatedCamera, session: RawClient, kind: str
) -> None:
    emulator.inject({"kind": kind, "on": "Start"})
    session.send(wire.QUERY, wire.START, wire.QUERY)
    await session.expect(wire.ACTIVE_1)
    await (session.expect_fin if kind == "close" else session.expect_reset)()
    assert not emulator.device.running
    (unheard,) = [entry for entry in emulator.log if entry.message == m.Start()]
    assert (unheard.fault, unheard.wire) == (kind, "")


async def test_close_after_the_clients_message_is_after_its_answer(
    emulator: EmulatedCamera, session: RawClient
) -> None:
    emulator.inject(faults.Close(on="Start", when="after"))
    session.send(wire.START, wire.QUERY)
    await session.expect(wire.WAITING)
    await session.expect_fin()
    assert emulator.device.running


async def test_half_open_neither_says_nor_hears_and_stays_open(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.HalfOpen(on="QueryAnswer"))
    session.send(wire.QUERY)
    await until(lambda: len(emulator.fired) == 1)
    session.send(wire.START)
    emulator.device.start()
    clock.advance(3600)
    session.expect_silence()
    assert emulator.has_session
    assert emulator.links == [session.address]
    assert outgoing(emulator) == [
        ("QueryAnswer", "half_open", ""),
        ("StatusReport", "half_open", ""),
    ]
    async with RawClient(emulator) as newcomer:
        newcomer.send(wire.CONNECT)
        await newcomer.expect(wire.CONNECTED, wire.WAITING)
        session.expect_silence()
        assert len(emulator.links) == 2
    await emulator.stop()
    await session.expect_reset()


async def test_half_open_ends_with_a_reset_after_its_time(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.HalfOpen(on="Query", seconds=10), faults.Drop(on="GetClock"))
    session.send(wire.QUERY, wire.GET_CLOCK)
    await until(lambda: len(emulator.fired) == 1)
    clock.advance(9.999)
    session.expect_silence()
    assert emulator.faults == [faults.Drop(on="GetClock")]  # it was not read
    clock.advance(0.001)
    await session.expect_reset()
    assert not emulator.has_session


@pytest.mark.parametrize("kind", ["half_open", "truncate"])
async def test_clear_faults_ends_what_is_half_open_or_stalled(
    emulator: EmulatedCamera, session: RawClient, kind: str
) -> None:
    more = {"keep": 0, "then": "stall"} if kind == "truncate" else {}
    emulator.inject({"kind": kind, "on": "QueryAnswer", "times": None, **more})
    session.send(wire.QUERY)
    await until(lambda: len(emulator.fired) == 1)
    session.expect_silence()
    emulator.clear_faults()
    await session.expect_reset()
    assert emulator.faults == []


# ---------------------------------------------------------------------- refuse


async def test_refuse_closes_the_port_and_nothing_else(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    port = emulator.port
    emulator.inject(faults.Refuse(seconds=3))
    with pytest.raises(ConnectionRefusedError):
        RawClient(emulator)
    session.send(wire.QUERY)
    await session.expect(wire.ACTIVE_1)
    clock.advance(2.999)
    with pytest.raises(ConnectionRefusedError):
        RawClient(emulator)
    clock.advance(0.001)
    assert emulator.port == port
    async with RawClient(emulator) as newcomer:
        await wire.greet(newcomer)


async def test_refuse_from_the_beginning_and_until_cleared(clock: ManualClock) -> None:
    async with EmulatedCamera(clock=clock, faults=[faults.Refuse(seconds=3000)]) as emulator:
        with pytest.raises(ConnectionRefusedError):
            RawClient(emulator)
        emulator.clear_faults()
        async with RawClient(emulator) as client:
            await wire.greet(client)


async def test_refuse_longer_than_a_reboot(emulator: EmulatedCamera, clock: ManualClock) -> None:
    emulator.inject(faults.Refuse(seconds=40), faults.Refuse(seconds=10), faults.PowerCycle())
    clock.advance(39)
    assert not emulator.device.rebooting
    with pytest.raises(ConnectionRefusedError):
        RawClient(emulator)
    clock.advance(1)
    async with RawClient(emulator) as client:
        await wire.greet(client)


async def test_refuse_shorter_than_a_reboot(emulator: EmulatedCamera, clock: ManualClock) -> None:
    emulator.inject(faults.PowerCycle(), faults.Refuse(seconds=10))
    clock.advance(20)
    with pytest.raises(ConnectionRefusedError):
        RawClient(emulator)
    clock.advance(10)
    async with RawClient(emulator) as client:
        await wire.greet(client)


async def test_refuse_after_the_connection_is_lost(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(
        faults.Refuse(on="QueryAnswer", seconds=5), faults.Reset(on="QueryAnswer", when="after")
    )
    session.send(wire.QUERY)
    await session.expect(wire.ACTIVE_1)
    await session.expect_reset()
    with pytest.raises(ConnectionRefusedError):
        RawClient(emulator)


# ---------------------------------------------------------------------- several


NINE_LAST = {"kind": "corrupt", "offset": -1, "value": 9}
NINE_FIRST = {"kind": "corrupt", "offset": 0, "value": 9}
NINE_6TH = {"kind": "corrupt", "offset": 5, "value": 9}
CUT_3, CUT_6 = ({"kind": "truncate", "keep": keep, "then": "continue"} for keep in (3, 6))
SPLIT_1, SPLIT_2, SPLIT_4 = ({"kind": "split", "after": after} for after in (1, 2, 4))
DROP, TWICE = {"kind": "drop"}, {"kind": "duplicate"}
AABB = {"kind": "insert", "data": "aabb"}
AA_BEHIND, BB_BEHIND = ({"kind": "insert", "data": one, "where": "after"} for one in ("aa", "bb"))
WHOLE = "50535642 04000000 30000000 01000000"
ORDERS: list[tuple[list[dict[str, Any]], list[str]]] = [
    ([SPLIT_4, NINE_6TH], ["50535642", "04090000 30000000 01000000"]),
    ([TWICE, NINE_LAST], ["50535642 04000000 30000000 01000009"] * 2),
    ([NINE_LAST, TWICE], ["50535642 04000000 30000000 01000009"] * 2),
    ([CUT_3, NINE_LAST], ["505309"]),
    ([NINE_LAST, CUT_3], ["505356"]),
    ([{**AABB, "where": "instead"}, NINE_FIRST], ["09bb"]),
    ([AABB, NINE_FIRST], ["aabb", "09535642 04000000 30000000 01000000"]),
    ([DROP, TWICE], []),
    ([TWICE, DROP], []),
    ([{**SPLIT_4, "pause": 5}, CUT_3, SPLIT_1], ["50", "5356"]),
    ([DROP, {"kind": "insert", "data": "aa"}], []),
    ([AA_BEHIND, BB_BEHIND], [WHOLE, "bb", "aa"]),
    ([TWICE, AA_BEHIND], [WHOLE, WHOLE, "aa"]),
    ([CUT_6, SPLIT_2, SPLIT_4, SPLIT_4], ["5053", "5642", "0400"]),
]


@pytest.mark.parametrize(("given", "expected"), ORDERS)
async def test_several_act_in_the_order_given(
    emulator: EmulatedCamera, session: RawClient, given: list[dict[str, Any]], expected: list[str]
) -> None:
    emulator.inject(*[{"on": "QueryAnswer", **one} for one in given])
    session.send(wire.QUERY, wire.GET_CLOCK)
    await session.expect(*map(bytes.fromhex, expected), wire.CLOCK_0)
    assert [fired.fault.kind for fired in emulator.fired] == [one["kind"] for one in given]
    assert {fired.message for fired in emulator.fired} == {m.QueryAnswer(application=1)}


async def test_each_fault_counts_for_itself(emulator: EmulatedCamera, session: RawClient) -> None:
    emulator.inject(
        faults.Drop(on="QueryAnswer", nth=2, times=2),
        faults.Duplicate(on="QueryAnswer", nth=3, times=2),
    )
    session.send(*[wire.QUERY] * 5, wire.GET_CLOCK)
    # 1 passes, 2 and 3 are dropped, 4 comes twice, 5 passes
    await session.expect(*[wire.ACTIVE_1] * 4, wire.CLOCK_0)
    assert emulator.faults == []
    assert [fired.fault.kind for fired in emulator.fired] == [
        "drop", "drop", "duplicate", "duplicate",
    ]  # fmt: skip


async def test_delay_and_close_close_late(
    emulator: EmulatedCamera, session: RawClient, clock: ManualClock
) -> None:
    emulator.inject(faults.Delay(on="QueryAnswer", seconds=1), faults.Close(on="QueryAnswer"))
    session.send(wire.QUERY)
    await until(lambda: len(emulator.fired) == 2)
    session.expect_silence()
    clock.advance(1)
    await session.expect_fin()


async def test_first_end_counts(emulator: EmulatedCamera, session: RawClient) -> None:
    emulator.inject(
        faults.Truncate(on="QueryAnswer", keep=4, then="reset"),
        faults.Close(on="QueryAnswer", when="after"),
    )
    session.send(wire.QUERY)
    await session.expect(wire.MAGIC)
    await session.expect_reset()


async def test_same_faults_same_bytes(clock: ManualClock) -> None:
    given: list[dict[str, Any]] = [
        {"kind": "split", "on": "ConnectAnswer", "after": 5},
        {"kind": "delay", "on": "StatusReport", "seconds": 1, "times": None},
        {"kind": "duplicate", "on": "QueryAnswer", "nth": 2},
        {"kind": "corrupt", "on": "Query", "offset": 8, "value": 0x32, "nth": 3},
        {"kind": "truncate", "on": "ClockAnswer", "keep": 20, "nth": 2},
    ]
    received: list[bytes] = []
    for _ in range(2):
        manual = ManualClock()
        async with (
            EmulatedCamera(clock=manual, faults=given) as emulator,
            RawClient(emulator) as client,
        ):
            client.send(wire.CONNECT, *[wire.QUERY] * 4, wire.START, wire.GET_CLOCK)
            await emulator.wait_received(m.GetClock, count=2)
            manual.advance(5)
            data = b""
            while more := await client.receive():
                data += more
            received.append(data)
    assert received[0] == received[1]
    assert received[0].startswith(wire.CONNECTED + wire.NO_BIT + wire.ACTIVE_1 * 3)


# ---------------------------------------------------------------------- while it runs


async def test_faults_given_in_the_middle_of_a_frame_leave_that_frame(
    emulator: EmulatedCamera, session: RawClient
) -> None:
    listener: Any = emulator._listener
    (link,) = listener.all_links
    session.send(wire.QUERY[:7])
    await until(lambda: link.machine.buffered == 7)
    emulator.inject(faults.Drop(on="Query"), faults.Drop(on="GetClock"))
    session.send(wire.QUERY[7:], wire.QUERY, wire.QUERY, wire.GET_CLOCK)
    await session.expect(wire.ACTIVE_1, wire.ACTIVE_1)
    session.send(wire.GET_CLOCK)
    await session.expect(wire.CLOCK_0)


async def test_short_way_is_taken_again_when_no_fault_waits(
    emulator: EmulatedCamera, session: RawClient
) -> None:
    listener: Any = emulator._listener
    (link,) = listener.all_links
    emulator.inject(faults.Drop(on="Query", nth=2))
    session.send(wire.QUERY, wire.QUERY[:5])
    await session.expect(wire.ACTIVE_1)
    assert link._faulty is not None
    session.send(wire.QUERY[5:], wire.QUERY, wire.QUERY[:3])
    await session.expect(wire.ACTIVE_1)
    assert link._faulty is None
    session.send(wire.QUERY[3:])
    await session.expect(wire.ACTIVE_1)


async def test_stop_while_things_are_held_back_leaves_nothing(clock: ManualClock) -> None:
    given: list[dict[str, Any]] = [
        {"kind": "delay", "on": "QueryAnswer", "seconds": 60},
        {"kind": "delay", "on": "StatusReport", "seconds": 60, "overtaken": True},
        {"kind": "delay", "on": "GetClock", "seconds": 60},
        {"kind": "busy_for_ever", "seconds": 50},
        {"kind": "refuse", "on": "StatusReport", "seconds": 70},
        {"kind": "half_open", "on": "Trigger", "seconds": 70},
    ]
    emulator = EmulatedCamera(clock=clock, faults=given)
    await emulator.start()
    async with RawClient(emulator) as client, RawClient(emulator) as other:
        other.send(wire.TRIGGER)
        await until(lambda: len(emulator.fired) == 2)
        client.send(wire.CONNECT, wire.QUERY, wire.GET_CLOCK)
        await client.expect(wire.CONNECTED)
        await until(lambda: len(emulator.fired) == 6)
        assert len(clock_timers(clock)) == 5
        await emulator.stop()
        await client.expect_fin()
        await other.expect_fin()
    assert clock_timers(clock) == []
    assert [(e.fault, e.wire) for e in emulator.log if e.fault is not None] == [
        ("half_open", ""),
        ("delay, connection ended", ""),
        ("delay, connection ended", ""),
        ("delay, connection ended", ""),
    ]
    before = emulator.device.time
    clock.advance(100)
    assert emulator.device.time == before
    await emulator.start()
    async with RawClient(emulator) as client:
        client.send(wire.CONNECT)
        await client.expect(wire.CONNECTED, wire.BUSY)
    await emulator.stop()


async def test_too_much_held_back_ends_the_connection(
    clock: ManualClock, caplog: pytest.LogCaptureFixture
) -> None:
    big = {"id": 2, "layout": "s: string[60000]", "constant": [""], "rate": 100}
    given = [faults.Delay(on="ResultContainer", seconds=3600, times=None)]
    async with (
        EmulatedCamera([big], clock=clock, faults=given, running=True) as emulator,
        RawClient(emulator) as client,
    ):
        client.send(wire.CONNECT)
        await client.expect(wire.CONNECTED, wire.RUNNING)
        with caplog.at_level("INFO", logger="smartcam.emulator"):
            clock.advance(1)
        assert "more than 1048576 bytes are held back" in caplog.text
        results = [entry for entry in emulator.log if entry.message_id == 0x20]
        assert len(results) == 18  # 17 fit
        assert {entry.fault for entry in results} == {"delay, connection ended"}
        await client.expect_fin()


async def test_in_the_dialect_of_the_thesis(clock: ManualClock) -> None:
    given = [
        faults.Insert(on="QueryAnswer", message=m.ConnectAnswer, fields={"version": 1}),
        faults.Drop(on="GetClock"),
        faults.Corrupt(on="QueryAnswer", offset=12, value=21),
    ]  # fmt: skip
    async with (
        EmulatedCamera(clock=clock, dialect="thesis", faults=given) as emulator,
        RawClient(emulator) as client,
    ):
        client.send(*map(wire.thesis, (wire.CONNECT, wire.GET_CLOCK, wire.QUERY)))
        await client.expect(*map(wire.thesis, (*wire.HELLO, wire.CONNECTED, wire.ACTIVE_21)))


async def test_client_that_is_turned_away_is_not_heard_any_more(clock: ManualClock) -> None:
    given = [faults.Delay(sender="client", nth=2, times=2, seconds=1)]
    quirks = {"second_client": "refuse"}
    async with (
        EmulatedCamera(clock=clock, quirks=quirks, faults=given) as emulator,
        RawClient(emulator) as first,
        RawClient(emulator) as second,
    ):
        await wire.greet(first)
        second.send(wire.CONNECT, wire.STOP)
        await until(lambda: len(emulator.fired) == 2)
        clock.advance(1)
        await second.expect_fin()
        (unheard,) = [entry for entry in emulator.log if entry.message == m.Stop()]
        assert (unheard.fault, unheard.wire) == ("delay, connection ended", "")


async def test_client_that_does_not_read_is_gone_before_a_fault_ends_it(
    emulator: EmulatedCamera, session: RawClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(EmulatedCamera, "write_limit", 20)
    emulator.inject(faults.Close(on="Start", when="after"), faults.Duplicate(on="StatusReport"))
    session.send(wire.START)
    await session.expect_fin()
    assert emulator.links == []
    assert not emulator.has_session


async def test_debug_log_tells_what_faults_did(
    emulator: EmulatedCamera, session: RawClient, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("DEBUG", logger="smartcam.emulator"):
        emulator.inject(faults.Drop(on="Query"), faults.Truncate(keep=2, then="continue"))
        session.send(wire.QUERY, wire.GET_CLOCK)
        await session.expect(wire.CLOCK_0[:2])
    assert "= fault: Drop(" in caplog.text
    assert f"< {session.address}: Query() (drop; on the wire: )" in caplog.text
    assert "(truncate; on the wire: 50 53)" in caplog.text
