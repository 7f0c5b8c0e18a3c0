"""The emulated camera over TCP, byte by byte."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from collections.abc import AsyncIterator
from typing import Any, cast

import pytest

from smartcam.emulator import EmulatedCamera, ManualClock
from smartcam.protocols import messages as m
from tests.emulator import camera_wire as wire
from tests.emulator.camera_wire import TcpClient
from tests.handmade import until

FIRST_READ_BYTES = 1 << 10
MAX_INPUT = 64 << 10
MAX_READ_BYTES = 64 << 10


@pytest.fixture
async def emulator() -> AsyncIterator[EmulatedCamera]:
    async with EmulatedCamera(clock=ManualClock()) as camera:
        yield camera


@pytest.fixture
async def client(emulator: EmulatedCamera) -> AsyncIterator[TcpClient]:
    async with await TcpClient.open(emulator) as opened:
        yield opened


@pytest.fixture
async def session(client: TcpClient) -> TcpClient:
    await wire.greet(client)
    return client


def clock_of(emulator: EmulatedCamera) -> ManualClock:
    assert isinstance(emulator.clock, ManualClock)
    return emulator.clock


async def load_21(emulator: EmulatedCamera, session: TcpClient) -> None:
    session.send(wire.SWITCH_21)
    await session.expect(wire.BUSY)
    clock_of(emulator).advance(0.3)
    await session.expect(wire.NO_BIT, wire.SWITCHED_21)
    session.send(wire.START)
    await session.expect(wire.WAITING)


# ---------------------------------------------------------------------- a whole conversation


async def test_tcp_conversation_of_the_manual(emulator: EmulatedCamera, session: TcpClient) -> None:
    await session.expect_nothing_but(wire.QUERY, wire.ACTIVE_1)
    await session.expect_nothing_but(wire.SWITCH_5, wire.REFUSED_1)
    await load_21(emulator, session)
    await session.expect_nothing_but(wire.QUERY, wire.ACTIVE_21)
    session.send(wire.TRIGGER)
    await session.expect(wire.RUNNING)
    clock_of(emulator).advance(0.05)
    await session.expect(wire.HELLO_WORLD, wire.WAITING)
    session.send(wire.SET_CLOCK)
    await session.expect_nothing_but(wire.GET_CLOCK, wire.CLOCK)
    session.send(wire.STOP)
    await session.expect(wire.NO_BIT)
    session.send(wire.DISCONNECT)
    await emulator.wait_received(m.Disconnect)
    assert not emulator.has_session


async def test_tcp_conversation_in_the_dialect_of_the_thesis() -> None:
    clock = ManualClock()
    async with (
        EmulatedCamera(clock=clock, dialect="thesis", active=3) as emulator,
        await TcpClient.open(emulator) as client,
    ):
        assert emulator.url == f"bvs://127.0.0.1:{emulator.port}?dialect=thesis"
        client.send(bytes.fromhex("42565350 04000000 01000000"))
        await client.expect(wire.thesis(wire.CONNECTED), wire.thesis(wire.NO_BIT))
        client.send(wire.thesis(wire.START), wire.thesis(wire.TRIGGER))
        await client.expect(wire.thesis(wire.WAITING), wire.thesis(wire.RUNNING))
        clock.advance(0.05)
        await client.expect(wire.thesis(wire.RESULT_3), wire.thesis(wire.WAITING))


async def test_tcp_on_real_time() -> None:
    fast = {
        "id": 2,
        "layout": "n: uint8 @sequence",
        "constant": [0],
        "rate": 200,
        "processing_time": 0.001,
    }
    async with (
        EmulatedCamera([fast], running=True) as emulator,
        await TcpClient.open(emulator) as client,
    ):
        client.send(wire.CONNECT)
        await client.expect(wire.CONNECTED, wire.RUNNING)
        async with asyncio.timeout(5):
            got = await client.reader.readexactly(5 * 17)
        assert {got[start : start + 16] for start in range(0, 85, 17)} == {
            bytes.fromhex("50535642 05000000 20000000 02000000")
        }
        first = got[16]
        assert [got[start + 16] for start in range(0, 85, 17)] == list(range(first, first + 5))


# ---------------------------------------------------------------------- silence


async def test_tcp_before_connect_silence(emulator: EmulatedCamera, client: TcpClient) -> None:
    client.send(wire.QUERY, wire.START, wire.TRIGGER, wire.REBOOT, wire.DISCONNECT)
    await emulator.wait_received(m.Disconnect)
    await wire.greet(client)


async def test_tcp_after_disconnect_silence(emulator: EmulatedCamera, session: TcpClient) -> None:
    session.send(wire.START, wire.TRIGGER, wire.DISCONNECT, wire.QUERY)
    await session.expect(wire.WAITING, wire.RUNNING)
    await emulator.wait_received(m.Query)
    clock_of(emulator).advance(1.0)
    assert emulator.device.next_number == 1
    session.send(wire.CONNECT)
    await session.expect(wire.CONNECTED, wire.WAITING)


INVALID = {
    "connect with the length of the thesis": "50535642 04000000 01000000 00000000",
    "query with a body": "50535642 01000000 30000000 00",
    "switch without an id": "50535642 00000000 31000000",
    "switch with half an id": "50535642 02000000 31000000 1500",
    "switch with more than an id": "50535642 08000000 31000000 15000000 00000000",
    "clock that is short": "50535642 04000000 33000000 E0070000",
    "unknown id": "50535642 00000000 77000000",
    "unknown id with a body": "50535642 03000000 FFFFFFFF 010203",
    "status, which is the camera's to send": "50535642 00000000 12000000",
    "result, which is the camera's to send": "50535642 04000000 20000000 01000000",
    "other magic": "42565350 00000000 30000000",
    "a Connect of the 16 bit dialect": "01000000",
    "text": "474554202f20485454502f312e310d0a0d0a",
    "4 GiB": "50535642 FFFFFFFF 30000000",
    "more than 64 kB": "50535642 01000100 34000000",
}


@pytest.mark.parametrize("data", INVALID.values(), ids=INVALID.keys())
async def test_tcp_invalid_message_is_ignored_and_the_next_one_taken(
    session: TcpClient, data: str
) -> None:
    session.send(bytes.fromhex(data))
    await session.expect_nothing_but(wire.QUERY, wire.ACTIVE_1)


async def test_tcp_connect_with_a_length_is_no_connect(client: TcpClient) -> None:
    client.send(bytes.fromhex("50535642 04000000 01000000"), wire.CONNECT, wire.CONNECT)
    # its four bytes are the next frame's magic; what is left of that one is garbage
    await client.expect(*wire.HELLO)


@pytest.mark.parametrize("garbage", [b"\x00", b"PSV", b"PSVPSV", b"P" * 1000, bytes(70_000)])
async def test_tcp_garbage_before_the_magic_is_skipped(session: TcpClient, garbage: bytes) -> None:
    session.send(garbage)
    await session.expect_nothing_but(wire.QUERY, wire.ACTIVE_1)


async def test_tcp_quirk_close_ends_the_connection_at_a_broken_frame() -> None:
    async with (
        EmulatedCamera(clock=ManualClock(), quirks={"bad_frame": "close"}) as emulator,
        await TcpClient.open(emulator) as client,
        await TcpClient.open(emulator) as other,
    ):
        client.send(wire.CONNECT, bytes.fromhex(INVALID["unknown id"]), wire.QUERY)
        await client.expect(*wire.HELLO, wire.ACTIVE_1)
        client.send(bytes.fromhex(INVALID["query with a body"]))
        await client.expect_nothing_but(wire.QUERY, wire.ACTIVE_1)
        client.send(b"garbage" + wire.QUERY)
        await client.expect_end()
        assert not emulator.has_session
        await wire.greet(other)


# ---------------------------------------------------------------------- cut and joined


async def test_tcp_byte_by_byte(emulator: EmulatedCamera, client: TcpClient) -> None:
    sock: socket.socket = client.writer.get_extra_info("socket")
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    for byte in wire.CONNECT + wire.SET_CLOCK + wire.SWITCH_21 + wire.QUERY:
        client.send(bytes([byte]))
        await asyncio.sleep(0)
    await client.expect(*wire.HELLO, wire.BUSY, wire.ACTIVE_1)
    await client.expect_nothing_but(wire.GET_CLOCK, wire.CLOCK)


async def test_tcp_requests_in_one_segment_are_answered_in_order(client: TcpClient) -> None:
    client.send(wire.QUERY, wire.CONNECT, wire.QUERY, wire.SWITCH_5, wire.DISCONNECT, wire.QUERY)
    client.send(wire.CONNECT, wire.START, wire.TRIGGER, wire.TRIGGER)
    await client.expect(*wire.HELLO, wire.ACTIVE_1, wire.REFUSED_1)
    await client.expect(*wire.HELLO, wire.WAITING, wire.RUNNING, wire.OVERTRIGGERED)


async def test_tcp_answers_of_one_step_come_in_one_segment(
    emulator: EmulatedCamera, client: TcpClient
) -> None:
    client.send(wire.CONNECT)
    async with asyncio.timeout(5):
        data = await client.reader.read(4096)
    assert data == wire.CONNECTED + wire.NO_BIT


async def test_tcp_has_no_delay(session: TcpClient, emulator: EmulatedCamera) -> None:
    listener: Any = emulator._listener
    (link,) = listener.all_links
    sock = link._transport.get_extra_info("socket")
    assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


# ---------------------------------------------------------------------- overtrigger, free-running


async def test_tcp_overtrigger(emulator: EmulatedCamera, session: TcpClient) -> None:
    await load_21(emulator, session)
    session.send(wire.TRIGGER, wire.TRIGGER, wire.TRIGGER)
    await session.expect(wire.RUNNING, wire.OVERTRIGGERED)
    clock_of(emulator).advance(0.05)
    await session.expect(wire.HELLO_WORLD, wire.OVERTRIGGERED_WAITING)
    clock_of(emulator).advance(0.05)
    await session.expect(wire.WAITING)
    await session.expect_nothing_but(wire.QUERY, wire.ACTIVE_21)


async def test_tcp_free_running_at_the_exact_rate() -> None:
    clock = ManualClock()
    async with (
        EmulatedCamera(active=9, clock=clock) as emulator,
        await TcpClient.open(emulator) as client,
    ):
        client.send(wire.CONNECT, wire.START)
        await client.expect(*wire.HELLO, wire.RUNNING)
        clock.advance(10.0)
        for number in range(200):
            frame = bytes.fromhex("50535642 08000000 20000000 09000000")
            await client.expect(frame + number.to_bytes(4, "little"))
        client.send(wire.STOP)
        await client.expect(wire.NO_BIT)
        clock.advance(10.0)
        await client.expect_nothing_but(wire.QUERY, wire.ACTIVE_1.replace(b"\1", b"\x09"))


# ---------------------------------------------------------------------- clients


async def test_tcp_newcomer_wins_at_its_connect_not_at_accept(
    emulator: EmulatedCamera, session: TcpClient
) -> None:
    async with await TcpClient.open(emulator) as newcomer:
        newcomer.send(wire.QUERY, wire.STOP)
        await emulator.wait_received(m.Stop)
        assert len(emulator.links) == 2
        await session.expect_nothing_but(wire.QUERY, wire.ACTIVE_1)
        session.send(wire.START)
        await session.expect(wire.WAITING)
        newcomer.send(wire.CONNECT)
        await newcomer.expect(wire.CONNECTED, wire.WAITING)
        await session.expect_end()
        port = newcomer.writer.get_extra_info("sockname")[1]
        assert emulator.sessions == [f"127.0.0.1:{port}"]
        assert emulator.device.running


async def test_tcp_quirk_refuse_closes_the_newcomer() -> None:
    async with (
        EmulatedCamera(clock=ManualClock(), quirks={"second_client": "refuse"}) as emulator,
        await TcpClient.open(emulator) as first,
        await TcpClient.open(emulator) as second,
    ):
        await wire.greet(first)
        second.send(wire.CONNECT)
        await second.expect_end()
        await wire.greet(first)


async def test_tcp_end_of_file_ends_the_session(
    emulator: EmulatedCamera, session: TcpClient
) -> None:
    session.send(wire.START)
    await session.expect(wire.WAITING)
    session.writer.write_eof()
    await session.expect_end()
    assert not emulator.has_session
    assert emulator.sessions == []
    assert emulator.device.running
    async with await TcpClient.open(emulator) as other:
        other.send(wire.CONNECT)
        await other.expect(wire.CONNECTED, wire.WAITING)


async def test_tcp_end_of_another_connection_leaves_the_session(
    emulator: EmulatedCamera, session: TcpClient
) -> None:
    async with await TcpClient.open(emulator) as other:
        other.send(wire.QUERY)
        await emulator.wait_received(m.Query)
        other.writer.write_eof()
        await other.expect_end()
    await session.expect_nothing_but(wire.QUERY, wire.ACTIVE_1)


async def test_tcp_reset_ends_the_session(emulator: EmulatedCamera, session: TcpClient) -> None:
    sock: socket.socket = session.writer.get_extra_info("socket")
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
    session.writer.transport.abort()
    async with await TcpClient.open(emulator) as other:
        await until(lambda: not emulator.has_session)
        await wire.greet(other)


async def test_tcp_client_that_does_not_read_is_disconnected(
    caplog: pytest.LogCaptureFixture,
) -> None:
    clock = ManualClock()
    big = {
        "id": 2,
        "layout": "(text: string[60000])*",
        "constant": [{"text": ""}],
        "rate": 1000,
        "processing_time": 0,
    }
    async with (
        EmulatedCamera([big], clock=clock, running=True) as emulator,
        await TcpClient.open(emulator) as client,
    ):
        client.send(wire.CONNECT)
        await emulator.wait_received(m.Connect)
        client.writer.transport.pause_reading()  # type: ignore[attr-defined]  # it is a ReadTransport
        with caplog.at_level(logging.INFO, logger="smartcam.emulator"):
            clock.advance(1.0)
        assert not emulator.has_session
        assert "it does not read: more than 1048576 bytes wait for it" in caplog.text
        assert emulator.links == []


async def test_tcp_connections_are_bounded(
    emulator: EmulatedCamera, session: TcpClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(EmulatedCamera, "max_links", 2)
    async with await TcpClient.open(emulator) as second, await TcpClient.open(emulator) as third:
        await second.expect_end()
        await session.expect_nothing_but(wire.QUERY, wire.ACTIVE_1)
        assert (len(emulator.links), emulator.crowded_out) == (2, 1)
        await wire.greet(third)


async def test_tcp_client_always_gets_in(
    emulator: EmulatedCamera, session: TcpClient, caplog: pytest.LogCaptureFixture
) -> None:
    async with contextlib.AsyncExitStack() as stack:
        idle = [
            await stack.enter_async_context(await TcpClient.open(emulator))
            for _ in range(3 * EmulatedCamera.max_links)
        ]
        for client in idle[::2]:
            client.send(wire.QUERY, wire.MAGIC)  # what it says without a session does not count
        await session.expect_nothing_but(wire.QUERY, wire.ACTIVE_1)
        with caplog.at_level(logging.INFO, logger="smartcam.emulator"):
            newcomer = await stack.enter_async_context(await TcpClient.open(emulator))
            await wire.greet(newcomer)
        assert "32 others are open, it was without a session for longest" in caplog.text
        await session.expect_end()
        for client in idle[: 2 * EmulatedCamera.max_links]:
            await client.expect_end()
        assert len(emulator.links) <= EmulatedCamera.max_links
        assert emulator.crowded_out == 2 * EmulatedCamera.max_links + 2
        assert {one.ended_by for one in emulator.ended_connections} <= {"camera"}


async def test_tcp_client_that_had_a_session_makes_room_after_those_that_had_none(
    emulator: EmulatedCamera, session: TcpClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(EmulatedCamera, "max_links", 3)
    async with await TcpClient.open(emulator) as first, await TcpClient.open(emulator) as second:
        first.send(wire.QUERY)
        second.send(wire.QUERY)
        session.send(wire.DISCONNECT)
        await emulator.wait_received(m.Query, count=2)
        await emulator.wait_received(m.Disconnect)
        async with await TcpClient.open(emulator), await TcpClient.open(emulator):
            await first.expect_end()
            await second.expect_end()
            await wire.greet(session)


async def test_tcp_client_without_a_session_holds_one_frame_at_most(
    emulator: EmulatedCamera, client: TcpClient
) -> None:
    listener: Any = emulator._listener
    bomb = wire.MAGIC + (MAX_INPUT + 1).to_bytes(4, "little") + bytes([0x21, 0, 0, 0])
    half = wire.MAGIC + MAX_INPUT.to_bytes(4, "little") + bytes([0x21, 0, 0, 0])
    half += bytes(MAX_INPUT - 1)
    client.send(bomb, bytes(3 * MAX_INPUT), half)
    await until(lambda: len(listener.all_links) == 1)
    (link,) = listener.all_links
    await until(lambda: link.machine.buffered == len(half))
    client.send(b"!")  # which makes it a whole one
    await emulator.wait_received(0x21)
    assert link.machine.buffered == 0


async def test_tcp_more_requests_than_a_read_takes_are_all_answered_in_order(
    session: TcpClient,
) -> None:
    count = 3 * FIRST_READ_BYTES // len(wire.QUERY)
    session.send(wire.QUERY * count, wire.GET_CLOCK)
    await session.expect(wire.ACTIVE_1 * count, wire.CLOCK_0)


async def test_tcp_idle_connection_has_a_small_buffer_also_after_a_long_input(
    emulator: EmulatedCamera, session: TcpClient
) -> None:
    (link,) = cast("Any", emulator._listener).all_links
    sizes = {len(link._read_buffer)}
    data = wire.MAGIC + MAX_INPUT.to_bytes(4, "little") + bytes([0x21, 0, 0, 0])
    for count in range(1, 4):
        session.send(data + bytes(MAX_INPUT))
        await emulator.wait_received(0x21, count=count)
        sizes.add(len(link._read_buffer))
        await session.expect_nothing_but(wire.GET_CLOCK, wire.CLOCK_0)
    assert len(link._read_buffer) == FIRST_READ_BYTES
    assert max(sizes) <= MAX_READ_BYTES


@pytest.mark.parametrize(
    "sizes", [[1], [FIRST_READ_BYTES - 1, FIRST_READ_BYTES, FIRST_READ_BYTES + 1], [5000, 3]]
)
async def test_tcp_buffer_gives_what_was_written_into_it(
    emulator: EmulatedCamera, session: TcpClient, sizes: list[int]
) -> None:
    (link,) = cast("Any", emulator._listener).all_links
    rest = wire.QUERY * 500
    while rest:  # as a loop does it: a read fills the buffer as far as there is anything
        for size in sizes:
            room = link.get_buffer(-1)
            assert FIRST_READ_BYTES <= len(room) <= MAX_READ_BYTES
            count = min(size, len(room), len(rest))
            room[:count], rest = rest[:count], rest[count:]
            link.buffer_updated(count)
            if not rest:
                break
    await session.expect(wire.ACTIVE_1 * 500)


# ---------------------------------------------------------------------- the operator


async def test_tcp_operators_actions_are_sent(emulator: EmulatedCamera, session: TcpClient) -> None:
    emulator.device.start()
    await session.expect(wire.WAITING)
    emulator.device.trigger()
    await session.expect(wire.RUNNING)
    emulator.device.switch_application(21)
    await session.expect(wire.BUSY)
    clock_of(emulator).advance(0.3)
    await session.expect(wire.NO_BIT)
    await session.expect_nothing_but(wire.QUERY, wire.ACTIVE_21)


async def test_tcp_operator_on_real_time_acts_now_not_in_the_past() -> None:
    slow = {"id": 2, "processing_time": 3600}
    async with (
        EmulatedCamera([slow], running=True) as emulator,
        await TcpClient.open(emulator) as client,
    ):
        client.send(wire.CONNECT)
        await client.expect(wire.CONNECTED, wire.WAITING)
        before = emulator.device.time
        emulator.device.trigger()
        assert emulator.device.time > before
        await client.expect(wire.RUNNING)
        assert emulator.device.processing
