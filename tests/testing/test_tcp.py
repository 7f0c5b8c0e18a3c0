"""The proxy on TCP, between bare ends: each rule at the first byte, in the middle, at the last."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import functools
import hashlib
import itertools
import random
import socket
from collections.abc import Iterator
from typing import NamedTuple

import pytest

from smartcam.testing.proxy import (
    CoalesceBytes,
    Cut,
    DelayBytes,
    Drip,
    DropBytes,
    DuplicateBytes,
    Flip,
    InsertBytes,
    LinkProxy,
    Rate,
    ResetConnection,
    Rule,
    SplitBytes,
    Stall,
)
from smartcam.testing.proxy import _directions as directions
from smartcam.testing.proxy import _tcp as tcp
from tests.handmade import until
from tests.testing.inside import Direction, Entry
from tests.testing.proxykit import (
    HOST,
    MESSAGE,
    OFFSETS,
    PLACES,
    SHORT,
    End,
    client,
    linked,
    raw_client,
    rest_of,
    target,
)

BEHIND = b"abc"
"""Bytes that the camera sends after the message."""


class Write(NamedTuple):
    """One write of the proxy: a segment, since nothing waits for more."""

    data: bytes
    turn: int


@pytest.fixture
def writes(monkeypatch: pytest.MonkeyPatch) -> list[Write]:
    """Every write of a proxy, and the turn of the loop it was made in, counted from the first."""
    made: list[Write] = []
    turn = 0
    write = directions.Pipe._write

    def next_turn() -> None:
        nonlocal turn
        turn += 1
        if turn < 1_000_000:
            asyncio.get_running_loop().call_soon(next_turn)

    def noted(pipe: directions.Pipe, data: bytearray) -> int:
        if not made:
            next_turn()
        written = write(pipe, data)
        made.append(Write(bytes(data[:written]), turn))
        return written

    monkeypatch.setattr(directions.Pipe, "_write", noted)
    return made


def segments(writes: list[Write]) -> list[bytes]:
    return [write.data for write in writes]


# ---------------------------------------------------------------------- without rules


async def test_bytes_pass_both_ways_unchanged() -> None:
    async with linked(echo=True) as (proxy, end, camera):
        end.write(MESSAGE)
        await end.wait_data(MESSAGE)
        assert camera.data == MESSAGE
        assert proxy.passed == {"up": 10, "down": 10}
        assert list(proxy.log) == [Entry("connect", 1)]


async def test_half_close_of_the_client_leaves_the_way_down_open() -> None:
    async with linked() as (proxy, end, camera):
        end.write(MESSAGE)
        end.transport.write_eof()
        await camera.wait_eof()
        assert camera.data == MESSAGE
        camera.write(BEHIND)
        await end.wait_data(BEHIND)
        assert not end.eof
        camera.transport.close()
        await end.wait_eof()
        await until(lambda: proxy.open_connections == 0)


async def test_half_close_of_the_camera_leaves_the_way_up_open() -> None:
    async with linked() as (proxy, end, camera):
        camera.write(MESSAGE)
        camera.transport.write_eof()
        await end.wait_eof()
        assert end.data == MESSAGE
        end.write(BEHIND)
        await camera.wait_data(BEHIND)
        assert not camera.eof
        end.transport.close()
        await camera.wait_eof()
        await until(lambda: proxy.open_connections == 0)
        assert list(proxy.log)[1:] == [Entry("eof", 1, "down", 10), Entry("eof", 1, "up", 3)]


async def test_reset_of_one_side_reaches_the_other() -> None:
    async with linked() as (proxy, end, camera):
        end.reset()
        await camera.wait_reset()
        assert proxy.log[-1] == Entry("lost", 1, "up", 0)
        assert proxy.open_connections == 0


async def test_reset_of_the_camera_reaches_the_client() -> None:
    async with linked() as (proxy, end, camera):
        camera.reset()
        await end.wait_reset()
        assert proxy.log[-1] == Entry("lost", 1, "down", 0)


async def test_reset_that_is_not_read_shows_when_something_is_sent() -> None:
    async with linked() as (proxy, end, camera):
        proxy.stall("up")
        end.reset()
        await end.wait_lost()
        camera.write(MESSAGE)
        await camera.wait_reset()
        assert proxy.log[-1] == Entry("lost", 1, "down", 10)


async def test_target_that_refuses_resets_the_client() -> None:
    with socket.socket() as sock:
        sock.bind((HOST, 0))
        async with LinkProxy(HOST, sock.getsockname()[1]) as proxy:
            with raw_client(proxy.port) as raw:
                assert await rest_of(raw) == (b"", "RST")
            assert [entry.what for entry in proxy.log] == ["no target"]
            assert proxy.open_connections == 0


async def test_target_that_takes_no_connection_ends_at_the_deadline(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tcp, "CONNECT_TIMEOUT", SHORT)
    with socket.socket() as full, contextlib.ExitStack() as waiting:
        full.bind((HOST, 0))
        full.listen(0)
        for _ in range(4):  # more than its backlog takes: later calls get no answer
            sock = waiting.enter_context(socket.socket())
            sock.setblocking(False)
            sock.connect_ex(full.getsockname())
        async with LinkProxy(HOST, full.getsockname()[1]) as proxy:
            with raw_client(proxy.port) as raw:
                assert await rest_of(raw) == (b"", "RST")
            assert proxy.counts["no target"] == 1


async def test_many_connections_keep_their_bytes_apart() -> None:
    async with contextlib.AsyncExitStack() as stack:
        camera = await stack.enter_async_context(target(echo=True))
        proxy = await stack.enter_async_context(LinkProxy(HOST, camera.port))
        ends = [await stack.enter_async_context(client(proxy.port)) for _ in range(40)]
        for number, end in enumerate(ends):
            end.write(b"%d" % number * 100)
        for number, end in enumerate(ends):
            await end.wait_data(b"%d" % number * 100)
        assert proxy.open_connections == 40


async def test_connections_beyond_the_limit_are_reset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp, "MAX_CONNECTIONS", 1)
    async with linked() as (proxy, end, camera):
        end.write(b"a")
        await camera.wait_data(b"a")
        camera.write(b"b")
        await end.wait_data(b"b")
        with raw_client(proxy.port) as raw:
            assert await rest_of(raw) == (b"", "RST")
        assert proxy.log[-1] == Entry("turned away", 2)
        assert proxy.open_connections == 1


async def test_connection_that_was_not_answered_makes_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp, "MAX_CONNECTIONS", 1)
    async with target(echo=True) as camera, LinkProxy(HOST, camera.port) as proxy:
        with raw_client(proxy.port) as raw:
            await proxy.wait_for("connect")
            async with client(proxy.port) as newcomer:
                assert await rest_of(raw) == (b"", "RST")
                newcomer.write(b"a")
                await newcomer.wait_data(b"a")
            assert Entry("turned away", 1) in proxy.log


async def test_large_transfers_both_ways_at_once_are_intact() -> None:
    sent = random.Random(1).randbytes(5_000_000)  # noqa: S311 - no secret
    async with linked() as (proxy, end, camera):
        end.write(sent)
        camera.write(sent[::-1])
        await proxy.wait_passed("up", len(sent), timeout=20)
        await proxy.wait_passed("down", len(sent), timeout=20)
        await until(lambda: sum(map(len, camera.chunks)) == sum(map(len, end.chunks)) == len(sent))
        assert hashlib.sha256(camera.data).digest() == hashlib.sha256(sent).digest()
        assert hashlib.sha256(end.data).digest() == hashlib.sha256(sent[::-1]).digest()


async def test_receiver_that_does_not_read_stops_the_sender() -> None:
    sent = bytes(range(256)) * 125_000  # more than the system's own buffers
    async with linked() as (proxy, end, camera):
        end.transport.pause_reading()
        camera.write(sent)
        pipe = proxy._relay.clients[1]._pipes["down"]  # type: ignore[union-attr]
        await until(lambda: pipe._writing and not pipe._reading)
        assert (
            directions.MAX_QUEUED_BYTES
            <= pipe.held_bytes
            < directions.MAX_QUEUED_BYTES + directions.CHUNK
        )
        assert camera.transport.get_write_buffer_size() > 0
        end.transport.resume_reading()
        await proxy.wait_passed("down", len(sent), timeout=20)
        await until(lambda: sum(map(len, end.chunks)) == len(sent))
        assert end.data == sent


# ---------------------------------------------------------------------- cut and reset


@contextlib.contextmanager
def bare_target() -> Iterator[socket.socket]:
    """A bare listening socket."""
    with socket.socket() as listener:
        listener.setblocking(False)
        listener.bind((HOST, 0))
        listener.listen()
        yield listener


@pytest.mark.parametrize("at", OFFSETS)
@pytest.mark.parametrize(("rule", "end"), [(Cut, "FIN"), (ResetConnection, "RST")])
async def test_end_after_exactly_so_many_bytes_is_the_one_asked_for(
    rule: type[Cut | ResetConnection], end: str, at: int
) -> None:
    loop = asyncio.get_running_loop()
    with bare_target() as listener:
        port = listener.getsockname()[1]
        async with LinkProxy(HOST, port, rules=[rule(at=at)]) as proxy:
            with raw_client(proxy.port) as raw, (await loop.sock_accept(listener))[0] as camera:
                if at:  # at 0 it ends before a word is said
                    camera.send(MESSAGE + BEHIND)
                assert await rest_of(raw) == (MESSAGE[:at], end)
                assert await rest_of(camera) == (b"", end)
                assert proxy.passed["down"] == at
                assert proxy.log[-1] == Entry(rule.name, 1, "down", at)


@pytest.mark.parametrize("at", OFFSETS)
async def test_cut_on_the_way_up_lets_so_many_bytes_through(at: int) -> None:
    async with linked(Cut(at=at, direction="up")) as (_, end, camera):
        end.write(MESSAGE + BEHIND)
        await camera.wait_eof()
        assert camera.data == MESSAGE[:at]
        await end.wait_eof()


async def test_cut_goes_on_reading_so_that_it_stays_a_fin() -> None:
    async with linked(Cut(at=4)) as (proxy, end, camera):
        camera.write(MESSAGE)
        await end.wait_eof()
        end.write(bytes(100_000))  # nobody takes it: closing over it would be a reset
        end.transport.write_eof()
        await camera.wait_eof()
        camera.transport.write_eof()
        await until(lambda: proxy.open_connections == 0)
        await end.stays_silent()
        assert (end.data, end.lost) == (MESSAGE[:4], None)


async def test_cut_connection_is_let_go_where_both_answer_with_a_reset() -> None:
    async with linked(Cut()) as (proxy, end, camera):
        for one in (end, camera):
            await one.wait_eof()
            one.reset()
        await until(lambda: proxy.open_connections == 0)


async def test_cut_connection_is_let_go_if_nobody_answers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tcp, "LINGER_TIME", SHORT)
    async with linked(Cut()) as (proxy, end, _):
        await end.wait_eof()
        assert proxy.open_connections == 1
        await until(lambda: proxy.open_connections == 0)


async def test_rule_for_the_second_connection_leaves_the_others() -> None:
    async with (
        target(echo=True) as camera,
        LinkProxy(HOST, camera.port, rules=[Cut(at=3, connection=2)]) as proxy,
    ):
        for whole in (True, False, True):
            async with client(proxy.port) as end:
                end.write(MESSAGE)
                await end.wait_data(MESSAGE if whole else MESSAGE[:3])


async def test_rules_changed_later_hold_for_connections_to_come() -> None:
    async with linked(echo=True) as (proxy, end, _):
        proxy.rules.append(DropBytes(at=0))
        end.write(MESSAGE)
        await end.wait_data(MESSAGE)
        async with client(proxy.port) as second:
            second.write(MESSAGE)
            await second.wait_data(MESSAGE[1:])


@pytest.mark.parametrize("at", OFFSETS)
async def test_rule_from_now_counts_from_here(at: int) -> None:
    async with linked(Flip(at=13), echo=True) as (proxy, end, _):
        end.write(MESSAGE)
        await end.wait_data(MESSAGE)
        proxy.from_now(
            InsertBytes(at=at, data=b"!"), DropBytes(at=0, count=99, direction="up", connection=2)
        )
        expected = MESSAGE + MESSAGE[:3] + b"\xcc" + MESSAGE[4:]
        end.write(MESSAGE)
        await end.wait_data(expected[: 10 + at] + b"!" + expected[10 + at :])


async def test_rule_from_now_at_0_acts_at_once() -> None:
    async with linked() as (proxy, end, camera):
        camera.write(MESSAGE)
        await end.wait_data(MESSAGE)
        proxy.from_now(Cut())
        await end.wait_eof()
        await camera.wait_eof()


async def test_pace_from_now_holds_for_what_comes() -> None:
    async with linked() as (proxy, end, camera):
        proxy.from_now(DelayBytes(seconds=SHORT))
        begin = asyncio.get_running_loop().time()
        camera.write(MESSAGE)
        await end.wait_data(MESSAGE)
        assert end.times[0] - begin >= SHORT * 0.8


# ---------------------------------------------------------------------- stall


@pytest.mark.parametrize("at", OFFSETS)
async def test_stall_is_silent_and_leaves_the_other_way_alone(at: int) -> None:
    async with linked(Stall(at=at), echo=True) as (proxy, end, camera):
        end.write(MESSAGE + BEHIND)
        await camera.wait_data(MESSAGE + BEHIND)
        await proxy.wait_for("stall")
        await until(lambda: len(end.data) == at)
        camera.transport.write_eof()
        await end.stays_silent()
        assert end.data == MESSAGE[:at]
        end.write(b"more")
        await camera.wait_data(MESSAGE + BEHIND + b"more")


async def test_stall_of_both_ways_is_a_dead_peer() -> None:
    async with linked(Stall(at=4, both=True), echo=True) as (proxy, end, camera):
        camera.write(MESSAGE)
        await end.wait_data(MESSAGE[:4])
        end.write(MESSAGE)
        end.transport.write_eof()
        await camera.stays_silent()
        await end.stays_silent()
        assert (camera.data, end.data) == (b"", MESSAGE[:4])
        assert proxy.passed == {"down": 4}


async def test_stalled_bytes_come_whole_when_it_resumes() -> None:
    async with linked(Stall(at=4, both=True)) as (proxy, end, camera):
        camera.write(MESSAGE)
        await proxy.wait_for("stall")
        end.write(BEHIND)
        end.transport.write_eof()
        await camera.stays_silent()
        proxy.resume()
        await end.wait_data(MESSAGE)
        await camera.wait_eof()
        assert camera.data == BEHIND


async def test_stalled_sender_is_stopped_by_full_buffers() -> None:
    async with linked() as (proxy, _, camera):
        proxy.stall()
        camera.write(bytes(32_000_000))
        await until(lambda: camera.transport.get_write_buffer_size() > 0)
        await camera.stays_silent()
        assert camera.transport.get_write_buffer_size() > 0
        assert proxy.passed == {}


# ---------------------------------------------------------------------- segments


@pytest.mark.parametrize(
    ("at", "expected"),
    [
        (0, [MESSAGE + BEHIND]),
        (5, [MESSAGE[:5], MESSAGE[5:] + BEHIND]),
        (10, [MESSAGE, BEHIND]),
        (13, [MESSAGE + BEHIND]),
    ],
)
async def test_split_makes_two_segments_of_one(
    at: int, expected: list[bytes], writes: list[Write]
) -> None:
    async with linked(SplitBytes(at=at)) as (proxy, end, camera):
        camera.write(MESSAGE + BEHIND)
        await end.wait_data(MESSAGE + BEHIND)
        assert segments(writes) == expected
        assert proxy.counts["split"] == 1


async def test_split_without_a_pause_lets_the_loop_turn_twice(writes: list[Write]) -> None:
    async with linked(SplitBytes(at=3), SplitBytes(at=6)) as (_, end, camera):
        camera.write(MESSAGE)
        await end.wait_data(MESSAGE)
        first, second, third = (write.turn for write in writes)
        assert second - first >= 2
        assert third - second >= 2


async def test_split_with_a_pause_keeps_the_rest_so_long() -> None:
    async with linked(SplitBytes(at=5, pause=SHORT)) as (_, end, camera):
        camera.write(MESSAGE)
        await end.wait_data(MESSAGE)
        assert end.chunks == [MESSAGE[:5], MESSAGE[5:]]
        assert end.times[1] - end.times[0] >= SHORT * 0.8


async def test_stall_and_resume_do_not_shorten_a_pause() -> None:
    async with linked(SplitBytes(at=5, pause=2 * SHORT)) as (proxy, end, camera):
        camera.write(MESSAGE)
        await end.wait_data(MESSAGE[:5])
        proxy.stall()
        proxy.resume()
        await end.wait_data(MESSAGE)
        assert end.times[1] - end.times[0] >= 2 * SHORT * 0.8


async def in_pieces(end: End, proxy: LinkProxy, data: bytes) -> None:
    """Write byte by byte, the next when the proxy has read the one before."""
    pipe = proxy._relay.clients[1]._pipes["down"]  # type: ignore[union-attr]
    for position, byte in enumerate(data, pipe._editor.position + 1):
        end.write(bytes([byte]))
        await until(functools.partial(pipe_is_at, pipe, position))


def pipe_is_at(pipe: directions.Pipe, position: int) -> bool:
    return pipe._editor.position >= position


@pytest.mark.parametrize("at", [0, 5, 7])
async def test_coalesce_gathers_exactly_so_many_bytes(at: int) -> None:
    async with linked(CoalesceBytes(at=at, size=3, seconds=5)) as (proxy, end, camera):
        for number in range(len(MESSAGE)):
            await in_pieces(camera, proxy, MESSAGE[number : number + 1])
            came = at if at <= number < at + 2 else number + 1
            await end.wait_data(MESSAGE[:came])
        assert MESSAGE[at : at + 3] in end.chunks
        assert len(end.chunks) == len(MESSAGE) - 2


async def test_coalesce_ends_at_its_time() -> None:
    async with linked(CoalesceBytes(at=2, size=100, seconds=SHORT)) as (proxy, end, camera):
        await in_pieces(camera, proxy, MESSAGE)
        await end.wait_data(MESSAGE)
        assert end.chunks[-1] == MESSAGE[2:]
        camera.write(BEHIND)
        await end.wait_data(MESSAGE + BEHIND)


@pytest.mark.parametrize("rule", [None, SplitBytes(at=10), Stall(at=10)])
async def test_coalesce_ends_at_the_senders_end_and_at_another_rule(rule: Rule | None) -> None:
    rules = [CoalesceBytes(at=0, size=100, seconds=60), Flip(at=3), *([rule] if rule else [])]
    async with linked(*rules) as (proxy, end, camera):
        await in_pieces(camera, proxy, MESSAGE)
        if rule is None:
            camera.transport.write_eof()
        await until(lambda: len(end.data) == len(MESSAGE))
        assert end.chunks == [b"012\xcc456789"]
        assert proxy.counts["flip"] == 1


@pytest.mark.parametrize("at", [0, 8])
async def test_coalesce_ends_where_bytes_drip(at: int, writes: list[Write]) -> None:
    async with linked(CoalesceBytes(at=at, size=100, seconds=60), Drip(at=8)) as (_, end, camera):
        camera.write(MESSAGE)
        await end.wait_data(MESSAGE)
        assert segments(writes) == [MESSAGE[:8], b"8", b"9"]


async def test_coalesce_ends_at_a_cut_from_now() -> None:
    async with linked(CoalesceBytes(at=0, size=100, seconds=60)) as (proxy, end, camera):
        await in_pieces(camera, proxy, MESSAGE)
        proxy.from_now(Cut())
        await end.wait_eof()
        assert end.chunks == [MESSAGE]


async def test_drip_writes_byte_by_byte(writes: list[Write]) -> None:
    async with linked(Drip()) as (_, end, camera):
        camera.write(MESSAGE)
        await end.wait_data(MESSAGE)
        assert segments(writes) == [bytes([byte]) for byte in MESSAGE]
        turns = [write.turn for write in writes]
        assert all(later - earlier >= 2 for earlier, later in itertools.pairwise(turns))


@pytest.mark.parametrize(
    ("at", "expected"),
    [
        (0, [b"0", b"1", b"23456789"]),
        (5, [b"01234", b"5", b"6", b"789"]),
        (8, [b"01234567", b"8", b"9"]),
    ],
)
async def test_drip_is_for_its_range(at: int, expected: list[bytes], writes: list[Write]) -> None:
    async with linked(Drip(at=at, count=2)) as (_, end, camera):
        camera.write(MESSAGE)
        await end.wait_data(MESSAGE)
        assert segments(writes) == expected
        assert writes[1].turn - writes[0].turn >= 2


# ---------------------------------------------------------------------- changes


@pytest.mark.parametrize("at", PLACES)
async def test_flip_changes_one_byte(at: int) -> None:
    async with linked(Flip(at=at, mask=0x80)) as (proxy, end, camera):
        camera.write(MESSAGE)
        changed = MESSAGE[:at] + bytes([MESSAGE[at] ^ 0x80]) + MESSAGE[at + 1 :]
        await end.wait_data(changed)
        assert proxy.log[-1] == Entry("flip", 1, "down", at)


@pytest.mark.parametrize("at", OFFSETS)
async def test_insert_puts_bytes_in(at: int) -> None:
    async with linked(InsertBytes(at=at, data=b"xyz")) as (_, end, camera):
        camera.write(MESSAGE)
        await end.wait_data(MESSAGE[:at] + b"xyz" + MESSAGE[at:])


@pytest.mark.parametrize("at", PLACES)
async def test_drop_leaves_bytes_out(at: int) -> None:
    async with linked(DropBytes(at=at, count=2)) as (_, end, camera):
        camera.write(MESSAGE + b".")
        await end.wait_data((MESSAGE + b".")[:at] + (MESSAGE + b".")[at + 2 :])


@pytest.mark.parametrize("at", PLACES)
async def test_duplicate_sends_bytes_again(at: int) -> None:
    async with linked(DuplicateBytes(at=at, count=1)) as (_, end, camera):
        camera.write(MESSAGE)
        await end.wait_data(MESSAGE[: at + 1] + MESSAGE[at:])


async def test_change_on_the_way_up_leaves_the_way_down() -> None:
    async with linked(DropBytes(at=0, count=3, direction="up"), echo=True) as (_, end, camera):
        end.write(MESSAGE)
        await end.wait_data(MESSAGE[3:])
        assert camera.data == MESSAGE[3:]


# ---------------------------------------------------------------------- time


async def test_delay_holds_bytes_and_the_end_back() -> None:
    loop = asyncio.get_running_loop()
    async with linked(DelayBytes(seconds=SHORT, jitter=0.01)) as (_, end, camera):
        begin = loop.time()
        camera.write(MESSAGE)
        await end.wait_data(MESSAGE)
        assert end.times[0] - begin >= SHORT * 0.8
        begin = loop.time()
        camera.transport.write_eof()
        await end.wait_eof()
        assert loop.time() - begin >= SHORT * 0.8


async def test_delay_with_jitter_keeps_the_order() -> None:
    async with linked(DelayBytes(seconds=0, jitter=0.02, seed=3)) as (proxy, end, camera):
        await in_pieces(camera, proxy, MESSAGE)
        await end.wait_data(MESSAGE)


async def test_jitter_is_the_same_again_with_the_same_seed() -> None:
    delays = []
    for seed in (1, 1, 2):
        async with linked(DelayBytes(seconds=10, jitter=100, seed=seed)) as (proxy, _, camera):
            begin = asyncio.get_running_loop().time()
            await in_pieces(camera, proxy, b"0")
            pipe = proxy._relay.clients[1]._pipes["down"]  # type: ignore[union-attr]
            delays.append(pipe._delay_line._queue[0].due_at * 1e-9 - begin)
    assert delays[0] == pytest.approx(delays[1], abs=3)
    assert abs(delays[0] - delays[2]) > 50


async def test_rate_is_not_exceeded(writes: list[Write]) -> None:
    async with linked(Rate(bytes_per_second=20_000)) as (proxy, end, camera):
        proxy.from_now(Flip(at=99_999))  # which leaves the rate as it is
        camera.write(bytes(2_000))
        await end.wait_data(bytes(2_000))
        # the first piece goes at once, the others each when it is their time
        assert end.times[-1] - end.times[0] >= 0.08
        assert set(map(len, segments(writes))) == {200}


async def test_slow_rate_stops_the_sender_and_not_only_the_receiver() -> None:
    async with linked(Rate(bytes_per_second=1_000)) as (proxy, _, camera):
        camera.write(bytes(32_000_000))
        await proxy.wait_passed("down", 60)
        pipe = proxy._relay.clients[1]._pipes["down"]  # type: ignore[union-attr]
        assert pipe.held_bytes < directions.MAX_QUEUED_BYTES + directions.CHUNK
        assert not pipe._reading


async def test_rate_and_drip_together_keep_both(writes: list[Write]) -> None:
    async with linked(Rate(bytes_per_second=1_000), Drip(pause=0.001)) as (_, end, camera):
        camera.write(MESSAGE * 5)
        await end.wait_data(MESSAGE * 5)
        assert set(map(len, segments(writes))) == {1}
        assert end.times[-1] - end.times[0] >= 0.04


# ---------------------------------------------------------------------- told while it runs


@pytest.mark.parametrize("connection", [None, 1])
async def test_cut_ends_both_sides_in_order(connection: int | None) -> None:
    async with linked(echo=True) as (proxy, end, camera):
        end.write(MESSAGE)
        await end.wait_data(MESSAGE)
        proxy.cut(connection)
        proxy.cut(connection)
        await end.wait_eof()
        await camera.wait_eof()


async def test_reset_ends_both_sides_hard() -> None:
    async with linked() as (proxy, end, camera):
        proxy.reset()
        assert proxy.open_connections == 0
        await end.wait_reset()
        await camera.wait_reset()


async def test_reset_of_another_connection_leaves_this_one() -> None:
    async with linked(echo=True) as (proxy, end, _):
        proxy.reset(7)
        end.write(MESSAGE)
        await end.wait_data(MESSAGE)


@pytest.mark.parametrize("direction", ["up", "down"])
async def test_stall_of_one_way_leaves_the_other(direction: Direction) -> None:
    async with linked() as (proxy, end, camera):
        sides = {"up": (end, camera), "down": (camera, end)}
        proxy.stall(direction)
        for sender, _ in sides.values():
            sender.write(MESSAGE)
        await sides[direction][0].wait_data(MESSAGE)
        await sides[direction][1].stays_silent()
        assert sides[direction][1].data == b""
        proxy.resume()
        await sides[direction][1].wait_data(MESSAGE)


async def test_stall_is_for_connections_to_come_too() -> None:
    async with linked(echo=True) as (proxy, _, _), client(proxy.port) as other:
        await proxy.wait_for("connect", 2)
        proxy.stall()
        async with client(proxy.port) as late:
            await proxy.wait_for("connect", 3)
            for one in (other, late):
                one.write(MESSAGE)
            await late.stays_silent()
            assert proxy.passed == {}
            proxy.resume()
            await other.wait_data(MESSAGE)
            await late.wait_data(MESSAGE)
        async with client(proxy.port) as after:
            after.write(MESSAGE)
            await after.wait_data(MESSAGE)


async def test_stall_of_one_connection_leaves_the_others() -> None:
    async with linked(echo=True) as (proxy, end, _), client(proxy.port) as other:
        await proxy.wait_for("connect", 2)
        proxy.stall(connection=1)
        for one in (end, other):
            one.write(MESSAGE)
        await other.wait_data(MESSAGE)
        await end.stays_silent()
        assert end.data == b""


async def test_refused_port_is_the_systems_own_refusal_and_open_links_stay() -> None:
    async with linked(echo=True) as (proxy, end, _):
        proxy.refuse()
        proxy.refuse()
        with pytest.raises(ConnectionRefusedError) as caught:
            async with client(proxy.port):
                pass
        assert caught.value.errno == errno.ECONNREFUSED
        end.write(MESSAGE)
        await end.wait_data(MESSAGE)
        proxy.refuse(False)
        async with client(proxy.port) as again:
            again.write(MESSAGE)
            await again.wait_data(MESSAGE)


async def test_killed_camera_resets_and_refuses() -> None:
    async with linked() as (proxy, end, camera):
        proxy.kill()
        await end.wait_reset()
        await camera.wait_reset()
        with pytest.raises(ConnectionRefusedError):
            async with client(proxy.port):
                pass


async def test_closing_is_at_once_and_ends_what_is_open() -> None:
    async with target() as camera:
        async with LinkProxy(HOST, camera.port, rules=[DelayBytes(seconds=60)]) as proxy:
            _, end = await asyncio.get_running_loop().create_connection(End, HOST, proxy.port)
            end.write(MESSAGE)
            camera_end = await camera.accept()
            camera_end.write(MESSAGE)
            begin = asyncio.get_running_loop().time()
        assert asyncio.get_running_loop().time() - begin < 1
        await end.wait_reset()
        await camera_end.wait_reset()


async def test_closing_while_the_target_is_being_called_leaves_nothing() -> None:
    async with target() as camera:
        async with LinkProxy(HOST, camera.port) as proxy:
            with raw_client(proxy.port):
                await until(lambda: proxy.open_connections == 1)
        assert proxy.open_connections == 0
