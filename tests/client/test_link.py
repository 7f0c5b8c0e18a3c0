"""One link over real sockets, against servers written by hand."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import AsyncIterator, Callable, Sequence

import pytest

from smartcam.exceptions import ConnectionLostError, FrameError, LocalProtocolError
from smartcam.models import Status
from smartcam.observers import RawFrame, TraceEntry
from smartcam.protocols import BVS, LinkEnded, LinkFailed, Machine, Role, State, Transport
from smartcam.protocols import messages as m
from smartcam.protocols._inside import HANDBOOK, Event, ResultBurst
from tests.client.inside import Chunk, Link, open_link, wait_ended
from tests.client.inside import link as connection
from tests.handmade import (
    BUSY,
    CONNECT,
    CONNECT_ANSWER,
    DISCONNECT,
    HOST,
    LIMIT,
    QUERY,
    QUERY_ANSWER,
    RESULT,
    STATUS,
    TRIGGER,
    Listener,
    Peer,
    datagrams,
    listening,
    refusing,
    until,
)
from tests.machines import one_by_one

RUNNING = m.StatusReport(status=Status(0x280))
BUSY_REPORT = m.StatusReport(status=Status.BUSY)
HELLO = m.ResultContainer(application=21, data=b"Hello")


@pytest.fixture
async def server() -> AsyncIterator[Listener]:
    async with listening() as made:
        yield made


async def open_to(
    port: int,
    transport: Transport = Transport.TCP,
    trace: Callable[[Sequence[RawFrame]], None] | None = None,
) -> Link:
    return await open_link(
        BVS, [HANDBOOK], transport, HOST, port, name="cell 1", max_length=1 << 20, trace=trace
    )


async def session(
    server: Listener, trace: Callable[[Sequence[RawFrame]], None] | None = None
) -> tuple[Link, Peer]:
    """Return a link with a session, and its other end."""
    link = await open_to(server.port, trace=trace)
    peer = await server.accept()
    link.send(m.Connect())
    assert await peer.read(12) == CONNECT
    peer.write(CONNECT_ANSWER)
    assert await take(link, 1) == [m.ConnectAnswer(version=1)]
    return link, peer


async def deliver(link: Link, peer: Peer, data: bytes) -> None:
    """Send bytes that arrive in a delivery of their own."""
    expected = link.machine.counters.bytes_received + len(data)
    peer.write(data)
    await until(lambda: link.machine.counters.bytes_received == expected)


async def take(link: Link, count: int) -> list[Event]:
    """Return the next events, whatever chunks they come in."""
    events: list[Event] = []
    async with asyncio.timeout(LIMIT):
        while len(events) < count:
            events += (await link.receive()).events
    assert len(events) == count
    return events


async def lost(link: Link) -> ConnectionLostError:
    """Return how reading ends; no event may come before."""
    async with asyncio.timeout(LIMIT):
        with pytest.raises(ConnectionLostError) as caught:
            await link.receive()
    return caught.value


# ---------------------------------------------------------------------- both directions


async def test_open_link_tcp_has_no_delay(server: Listener) -> None:
    link = await open_to(server.port)
    sock = link._transport.get_extra_info("socket")
    assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) != 0
    assert link.peer == f"127.0.0.1:{server.port}"
    link.abort()


async def test_receive_chunks_come_in_order_with_the_time(server: Listener) -> None:
    link, peer = await session(server)
    before = asyncio.get_running_loop().time()
    peer.write(STATUS + RESULT)
    first = await link.receive()
    peer.write(BUSY)
    second = await link.receive()
    assert first.events == [RUNNING, HELLO]
    assert second.events == [BUSY_REPORT]
    assert before <= first.received_at <= second.received_at
    link.abort()


async def test_receive_frame_in_pieces_is_one_event(server: Listener) -> None:
    link, peer = await session(server)
    for byte in STATUS:
        await deliver(link, peer, bytes([byte]))
    chunk = await link.receive()
    assert isinstance(chunk, Chunk)
    assert chunk.events == [RUNNING]
    link.abort()


async def test_send_several_messages_is_one_write_in_order(server: Listener) -> None:
    link, peer = await session(server)
    link.send_all([m.Query(), m.Trigger()])
    assert await peer.read(24) == QUERY + TRIGGER
    link.abort()


async def test_send_illegal_message_raises_after_the_legal_ones_were_written(
    server: Listener,
) -> None:
    link = await open_to(server.port)
    peer = await server.accept()
    with pytest.raises(LocalProtocolError, match="Query cannot be sent"):
        link.send(m.Query())
    with pytest.raises(LocalProtocolError, match="QueryAnswer cannot be sent"):
        link.send_all([m.Connect(), m.QueryAnswer(application=1)])
    assert await peer.read(12) == CONNECT
    link.abort()


async def test_receive_cancelled_loses_nothing(server: Listener) -> None:
    link, peer = await session(server)
    reading = asyncio.create_task(link.receive())
    await asyncio.sleep(0)
    reading.cancel()
    await asyncio.wait({reading})
    peer.write(STATUS)
    assert await take(link, 1) == [RUNNING]
    link.abort()


# ---------------------------------------------------------------------- one chunk in a turn


async def test_receive_takes_one_chunk_in_a_turn_of_the_loop(
    server: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "MAX_CHUNKS", 8)
    link, peer = await session(server)
    for _ in range(3):
        await deliver(link, peer, BUSY)
    turns: list[int] = []

    async def read() -> None:
        for _ in range(3):
            await link.receive()
            turns.append(len(turns))

    reading = asyncio.create_task(read())
    for turn in range(1, 4):
        await asyncio.sleep(0)
        assert len(turns) <= turn
    await reading
    assert len(turns) == 3
    link.abort()


async def test_delivery_with_many_frames_is_taken_in_several_turns(
    server: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "MAX_CHUNK_FRAMES", 64)
    monkeypatch.setattr(connection, "MIN_FRAMES_PER_CHUNK", 64)
    link, peer = await session(server)
    await deliver(link, peer, RESULT * 120 + BUSY * 10)
    assert not link._transport.is_reading()
    chunks = [await link.receive() for _ in range(3)]
    assert [chunk.frames for chunk in chunks] == [64, 64, 2]
    assert [sum(map(weight, chunk.events)) for chunk in chunks] == [64, 64, 2]
    assert len({chunk.received_at for chunk in chunks}) == 1
    assert link._transport.is_reading()
    link.abort()


def weight(event: Event) -> int:
    return len(event.data) if isinstance(event, ResultBurst) else 1


@pytest.mark.parametrize(
    ("took", "frames"),
    [(0.0, 86), (connection.TURN_TIME, 64), (connection.TURN_TIME * 1.5, 42), (60.0, 32)],
)
async def test_chunk_is_as_large_as_a_turn_takes(
    server: Listener, took: float, frames: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr(connection, "thread_time", lambda: now[0])
    link, peer = await session(server)
    await deliver(link, peer, RESULT * 150)
    assert (await link.receive()).frames == connection.FIRST_CHUNK_FRAMES
    now[0] += took
    assert (await link.receive()).frames == frames
    link.abort()


async def test_frames_of_any_size_come_whole_through_the_transports_reads(server: Listener) -> None:
    link, peer = await session(server)
    heard: list[Event] = []
    sizes = [0, 4083, 4084, 4085, 300_000, 1, *[70] * 20_000, (1 << 20) - 4, 5_000, 7]
    said = [
        m.ResultContainer(application=size % 2, data=size.to_bytes(4, "big") * (size // 4))
        for size in sizes
    ]
    stream = b"".join(map(HANDBOOK.encode, said))
    peer.write(stream)
    async with asyncio.timeout(LIMIT):
        while len(heard) < len(said):
            heard += one_by_one((await link.receive()).events)
    assert heard == said
    assert link.machine.counters.bytes_received == 16 + len(stream)
    link.abort()


# ---------------------------------------------------------------------- how a link ends


async def test_peer_that_closes_gives_its_end_then_lost(server: Listener) -> None:
    link, peer = await session(server)
    peer.write(STATUS + RESULT[:5])
    peer.close()
    assert await take(link, 2) == [RUNNING, LinkEnded(pending=5)]
    error = await lost(link)
    assert str(error) == (
        f"cell 1: the link to 127.0.0.1:{server.port} is gone: the camera closed the connection"
    )
    assert (error.host, error.port) == ("127.0.0.1", server.port)
    assert isinstance(error.__cause__, ConnectionResetError)
    with pytest.raises(ConnectionLostError):
        link.send(m.Query())


async def test_lost_link_of_a_camera_without_a_name_tells_its_address_once(
    server: Listener,
) -> None:
    link, _ = await session(server)
    link.name = link.peer
    link.abort(ValueError("why"))
    assert str(await lost(link)) == f"127.0.0.1:{server.port}: the link is gone: why"


async def test_peer_that_resets_gives_lost_with_the_systems_reason(server: Listener) -> None:
    link, peer = await session(server)
    peer.reset()
    error = await lost(link)
    assert isinstance(error.__cause__, ConnectionResetError)
    assert "reset" in str(error).lower()
    assert link.machine.state is State.CONNECTED


async def test_peer_that_breaks_the_protocol_gives_the_failure_then_lost(server: Listener) -> None:
    link, peer = await session(server)
    peer.write(STATUS + b"HTTP/1.1 400 Bad Request\r\n")
    status, failed = await take(link, 2)
    assert status == RUNNING
    assert isinstance(failed, LinkFailed)
    error = await lost(link)
    assert error.__cause__ is failed.error
    assert isinstance(failed.error, FrameError)
    assert await peer.rest() == b""
    with pytest.raises(ConnectionLostError, match="wrong magic number"):
        link.send(m.Query())


async def test_abort_tells_a_waiting_reader_why(server: Listener) -> None:
    link, _ = await session(server)
    reading = asyncio.create_task(link.receive())
    await asyncio.sleep(0)
    reason = ValueError("had enough")
    link.abort(reason)
    link.abort()
    with pytest.raises(ConnectionLostError, match="had enough") as caught:
        await reading
    assert caught.value.__cause__ is reason


async def test_abort_after_chunks_came_still_gives_them(server: Listener) -> None:
    link, peer = await session(server)
    peer.write(STATUS)
    await until(lambda: link._chunks)
    link.abort()
    assert await take(link, 1) == [RUNNING]
    assert "closed by this side" in str(await lost(link))


async def test_open_link_nothing_listens_is_an_os_error() -> None:
    with refusing(socket.SOCK_STREAM) as port, pytest.raises(ConnectionRefusedError):
        await open_to(port)


async def test_link_that_was_never_opened_closes_and_aborts() -> None:
    machine = Machine(HANDBOOK, Role.CLIENT, Transport.TCP)
    link = Link(machine, name="cell 1", host=HOST, port=1)
    await link.close(0.1)
    link.give_up(ValueError("why"))
    assert "closed by this side" in str(await lost(link))


# ---------------------------------------------------------------------- closing


async def test_close_says_disconnect_then_ends_its_side(server: Listener) -> None:
    link, peer = await session(server)
    closing = asyncio.create_task(link.close(LIMIT))
    assert await peer.rest() == DISCONNECT
    assert not closing.done()
    peer.write(STATUS)
    peer.close()
    await closing
    assert link.machine.state is State.CLOSED
    await lost(link)


async def test_close_peer_that_never_closes_is_bounded(server: Listener) -> None:
    link, peer = await session(server)
    loop = asyncio.get_running_loop()
    start = loop.time()
    await link.close(0.1)
    assert 0.09 < loop.time() - start < 2
    assert await peer.rest() == DISCONNECT
    assert "closed by this side" in str(await lost(link))
    await link.close(LIMIT)


async def test_close_without_a_session_says_nothing(server: Listener) -> None:
    link = await open_to(server.port)
    peer = await server.accept()
    closing = asyncio.create_task(link.close(LIMIT))
    assert await peer.rest() == b""
    peer.close()
    await closing


async def test_close_while_connecting_says_disconnect(server: Listener) -> None:
    link = await open_to(server.port)
    peer = await server.accept()
    link.send(m.Connect())
    closing = asyncio.create_task(link.close(LIMIT))
    assert await peer.rest() == CONNECT + DISCONNECT
    peer.close()
    await closing


async def test_close_cancelled_drops_the_link(server: Listener) -> None:
    link, peer = await session(server)
    closing = asyncio.create_task(link.close(LIMIT))
    assert await peer.read(12) == DISCONNECT
    closing.cancel()
    await asyncio.wait({closing})
    assert closing.cancelled()
    assert await peer.rest() == b""
    assert link._closed


async def test_close_after_the_peer_is_gone_returns_at_once(server: Listener) -> None:
    link, peer = await session(server)
    peer.close()
    assert await take(link, 1) == [LinkEnded(pending=0)]
    await lost(link)
    await link.close(LIMIT)


async def test_close_while_the_transport_is_closing_waits_for_its_end(server: Listener) -> None:
    link, peer = await session(server)
    link._transport.close()
    await link.close(LIMIT)
    assert link._closed
    await peer.rest()


async def test_give_up_says_disconnect_and_drops_the_link(server: Listener) -> None:
    link, peer = await session(server)
    link.give_up(TimeoutError("no answer"))
    assert await peer.rest() == DISCONNECT
    assert str(await lost(link)).endswith("is gone: no answer")
    link.give_up(ValueError("again"))
    assert str(await lost(link)).endswith("is gone: no answer")


# ---------------------------------------------------------------------- bounds


async def test_queue_full_pauses_reading_then_everything_arrives(
    server: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "MAX_CHUNKS", 8)
    link, peer = await session(server)
    for _ in range(8):
        await deliver(link, peer, STATUS)
    assert not link._transport.is_reading()
    peer.write(BUSY * 100)
    await asyncio.sleep(0)
    assert len(link._chunks) == 8
    assert await take(link, 7) == [RUNNING] * 7
    assert not link._transport.is_reading()
    assert await take(link, 1) == [RUNNING]
    assert link._transport.is_reading()
    assert await take(link, 100) == [BUSY_REPORT] * 100
    link.abort()


async def test_close_with_reading_paused_still_ends_in_order(
    server: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "MAX_CHUNKS", 2)
    link, peer = await session(server)
    for _ in range(2):
        await deliver(link, peer, STATUS)
    assert not link._transport.is_reading()
    peer.write(BUSY * 10)
    closing = asyncio.create_task(link.close(60))
    assert await peer.rest() == DISCONNECT
    peer.close()
    async with asyncio.timeout(LIMIT):
        await closing
    assert await take(link, 2) == [RUNNING, RUNNING]


async def test_drain_waits_for_a_peer_that_does_not_read(server: Listener) -> None:
    link, peer = await session(server)
    peer.pause_reading()
    big = m.SetInput(data=bytes(1 << 20))
    while link.is_writable():
        link.send(big)
    draining = asyncio.create_task(link.drain())
    await asyncio.sleep(0)
    assert not draining.done()
    peer.resume_reading()
    reading = asyncio.create_task(peer.rest())
    async with asyncio.timeout(LIMIT):
        await draining
    link.abort()
    await reading


async def test_drain_ends_with_the_link(server: Listener) -> None:
    link, _ = await session(server)
    link.pause_writing()
    draining = asyncio.create_task(link.drain())
    await asyncio.sleep(0)
    assert not draining.done()
    link.abort()
    async with asyncio.timeout(LIMIT):
        await draining


# ---------------------------------------------------------------------- trace


class Entries(list[TraceEntry]):
    """Frames of a trace, decoded."""

    def take(self, frames: Sequence[RawFrame]) -> None:
        self += [frame.entry() for frame in frames]


async def test_trace_has_frames_of_both_directions_and_broken_bytes(server: Listener) -> None:
    entries = Entries()
    link, peer = await session(server, entries.take)
    link.send(m.Query())
    peer.write(QUERY_ANSWER + RESULT + bytes.fromhex("50535642 01000000 77000000 ff") + b"noise")
    assert len(await take(link, 4)) == 4
    assert [entry[1:7] for entry in entries] == [
        ("cell 1", ">", 0x01, "Connect", {}, CONNECT.hex()),
        ("cell 1", "<", 0x01, "ConnectAnswer", {"version": 1}, CONNECT_ANSWER.hex()),
        ("cell 1", ">", 0x30, "Query", {}, QUERY.hex()),
        ("cell 1", "<", 0x30, "QueryAnswer", {"application": 21}, QUERY_ANSWER.hex()),
        (
            *("cell 1", "<", 0x20, "ResultContainer"),
            *({"application": 21, "data": "48656c6c6f"}, RESULT.hex()),
        ),
        ("cell 1", "<", 0x77, "UnknownMessage", {}, "505356420100000077000000ff"),
        (
            *("cell 1", "!", None),
            *("wrong magic number: 6e 6f 69 73 came, 50 53 56 42 was expected", None),
            "6e6f697365",
        ),
    ]
    assert all(entry.at.utcoffset() is not None for entry in entries)


async def test_trace_gets_the_frames_of_a_delivery_together_and_those_sent_at_once(
    server: Listener,
) -> None:
    told: list[Sequence[RawFrame]] = []
    link, peer = await session(server, told.append)
    told.clear()
    for times in (1, 40):
        await deliver(link, peer, RESULT * times + BUSY)
        (frames,) = told
        assert [one.entry().message for one in frames] == ["ResultContainer"] * times + [
            "StatusReport"
        ]
        assert {one.at for one in frames} == {frames[0].at}
        told.clear()
        await take(link, 2)
    link.send(m.Query())
    ((sent,),) = told
    assert sent.entry().message == "Query"
    told.clear()
    peer.write(QUERY_ANSWER + RESULT[:7])
    peer.close()
    with pytest.raises(ConnectionLostError):
        await take(link, 9)
    assert [one.entry().message for frames in told for one in frames] == [
        "QueryAnswer",
        "7 bytes that make no whole frame",
    ]


async def test_trace_of_kin_is_in_the_words_of_the_one_that_answers(server: Listener) -> None:
    """An answer to Connect that has a code is not shown as a version."""
    entries = Entries()
    candidates = BVS.dialect_groups(Transport.TCP)[0]
    assert [one.label for one in candidates] == ["b16", "bid", "b16 with quirk code"]
    link = await open_link(
        BVS,
        candidates,
        Transport.TCP,
        HOST,
        server.port,
        name="c",
        max_length=99,
        trace=entries.take,
    )
    peer = await server.accept()
    link.send(m.Connect())
    assert await peer.read(4) == bytes.fromhex("01000000")
    peer.write(bytes.fromhex("01000400 0000 0100"))
    assert await take(link, 1) == [m.ConnectAnswer(code=0, version=1)]
    assert link.machine.candidates == candidates[1:]
    assert [entry[2:6] for entry in entries] == [
        (">", 0x01, "Connect", {}),
        ("<", 0x01, "ConnectAnswer", {"code": 0, "version": 1}),
    ]
    link.abort()


async def test_trace_body_that_does_not_fit_has_no_fields(server: Listener) -> None:
    entries = Entries()
    link, peer = await session(server, entries.take)
    peer.write(bytes.fromhex("50535642 02000000 12000000 8002"))
    (failed,) = await take(link, 1)
    assert isinstance(failed, LinkFailed)
    frame, broken = entries[-2:]
    assert frame[2:6] == ("<", 0x12, "StatusReport", None)
    assert broken[2:7] == ("!", None, str(failed.error), None, "8002")


async def test_trace_is_logged_where_debugging_is_on(
    server: Listener, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, logger="smartcam.connection")
    link, _ = await session(server)
    link.abort()
    assert [record.getMessage() for record in caplog.records] == [
        f"cell 1 > Connect {CONNECT.hex()}",
        f"cell 1 < ConnectAnswer {CONNECT_ANSWER.hex()}",
    ]


# ---------------------------------------------------------------------- UDP


async def udp_session(port: int) -> Link:
    link = await open_to(port, Transport.UDP)
    link.send_all([m.Disconnect(), m.Connect()])
    assert await take(link, 1) == [m.ConnectAnswer(version=1)]
    return link


def connects(data: bytes) -> list[bytes]:
    return [CONNECT_ANSWER] if data == CONNECT else []


async def test_udp_each_message_is_a_datagram() -> None:
    async with datagrams(connects) as camera:
        link = await udp_session(camera.port)
        camera.send(STATUS, RESULT)
        assert await take(link, 2) == [RUNNING, HELLO]
        await link.close(LIMIT)
        await until(lambda: len(camera.received) == 3)
        assert camera.received == [DISCONNECT, CONNECT, DISCONNECT]


async def test_udp_garbage_datagram_is_ignored_and_counted() -> None:
    async with datagrams(connects) as camera:
        link = await udp_session(camera.port)
        camera.send(b"noise", STATUS[:-1], STATUS + STATUS, STATUS)
        assert await take(link, 1) == [RUNNING]
        assert link.machine.counters.ignored_frames == 3
        assert link.machine.state is State.CONNECTED
        link.abort()


async def test_udp_refused_port_is_lost() -> None:
    with refusing(socket.SOCK_DGRAM) as port:
        link = await open_to(port, Transport.UDP)
        link.send(m.Connect())
        error = await lost(link)
        assert isinstance(error.__cause__, ConnectionRefusedError)
        await until(lambda: link._closed)
        await link.close(LIMIT)


async def test_udp_datagrams_that_have_come_are_taken_together_in_order() -> None:
    async with datagrams(connects) as camera:
        link = await udp_session(camera.port)
        camera.send(STATUS, b"noise", RESULT, BUSY)
        chunk = await asyncio.wait_for(link.receive(), LIMIT)
        assert (chunk.events, chunk.frames) == ([RUNNING, HELLO, BUSY_REPORT], 3)
        assert link.machine.counters.ignored_frames == 1
        camera.send(*[STATUS] * 20)
        chunk = await asyncio.wait_for(link.receive(), LIMIT)
        assert chunk.events == connection.MAX_DATAGRAMS_AT_ONCE * [RUNNING]
        assert await take(link, 12) == 12 * [RUNNING]
        link.abort()
        await until(lambda: link._closed)
        assert link._direct_socket is None


async def test_udp_refusal_among_datagrams_is_told_behind_those_before_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with datagrams(connects) as camera:
        link = await udp_session(camera.port)
        camera.send(STATUS, RESULT)
    hear = Machine.receive_data

    def hear_and_ask(machine: Machine, data: bytes) -> None:
        hear(machine, data)
        link.send(m.Query())  # which the system refuses at once: nothing listens there any more

    monkeypatch.setattr(Machine, "receive_data", hear_and_ask)
    assert await take(link, 1) == [RUNNING]
    error = await lost(link)
    assert isinstance(error.__cause__, ConnectionRefusedError)
    await until(lambda: link._closed)


async def test_udp_queue_full_drops_and_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "MAX_DATAGRAMS", 3)
    async with datagrams(connects) as camera:
        link = await udp_session(camera.port)
        camera.send(*[STATUS] * 5)
        await until(lambda: link.machine.counters.ignored_frames == 2)
        assert await take(link, 3) == [RUNNING] * 3
        camera.send(BUSY)
        assert await take(link, 1) == [BUSY_REPORT]
        link.abort()


@pytest.mark.parametrize("how", ["the camera closes", "the client gives up"])
async def test_trace_shows_what_is_left_of_an_unfinished_frame(server: Listener, how: str) -> None:
    entries = Entries()
    link, peer = await session(server, entries.take)
    peer.write(STATUS[:15])
    await until(lambda: len(link.machine.unfinished_bytes) == 15)
    if how == "the camera closes":
        peer.close()
        await until(lambda: link.lost)
    link.give_up(TimeoutError("silence"))
    left = [entry for entry in entries if entry.direction == "!"]
    assert [(entry.message, entry.hex) for entry in left] == [
        ("15 bytes that make no whole frame", STATUS[:15].hex())
    ]


# ---------------------------------------------------------------------- the end of a task


async def test_outlast_returns_when_the_task_has_failed_and_raises_nothing() -> None:
    async def fail() -> None:
        await asyncio.sleep(0)
        raise ValueError("not for whoever waits")

    task = asyncio.create_task(fail())
    await wait_ended(task)
    assert str(task.exception()) == "not for whoever waits"
    await wait_ended(task)


async def test_outlast_cancelled_leaves_the_task_and_the_others_that_wait_alone() -> None:
    end = asyncio.Event()
    task = asyncio.create_task(end.wait())
    one, other = (asyncio.create_task(wait_ended(task)) for _ in range(2))
    await asyncio.sleep(0)
    one.cancel()
    await asyncio.wait({one})
    assert one.cancelled()
    assert not task.done()
    assert not other.done()
    end.set()
    await other
    assert await task


async def test_wait_closed_ends_at_its_timeout_for_each_that_waits(server: Listener) -> None:
    link, peer = await session(server)
    begin = asyncio.get_running_loop().time()
    longer = asyncio.create_task(link.wait_closed(LIMIT))
    await link.wait_closed(0.01)
    assert asyncio.get_running_loop().time() - begin >= 0.01
    assert not longer.done()
    peer.close()
    await take(link, 1)
    await longer
    link.abort()
