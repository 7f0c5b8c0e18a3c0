"""Failures that clients of such devices are known for. Each has one test here that says it plainly.

The camera is written by hand; where it matters how the bytes arrive, a proxy stands between.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import itertools
import tracemalloc
from collections.abc import AsyncIterator, Iterator
from typing import Any

import pytest

import smartcam
from smartcam import Camera, ConnectionLostError, FrameError, ResponseTimeoutError, Result
from smartcam.testing.proxy import LinkProxy, Rule, SplitBytes
from tests.client.camera_by_hand import (
    HANDBOOK,
    QUERY,
    READY,
    RESULT,
    RUNNING,
    STATUS,
    TRIGGER,
    HandmadeCamera,
    words,
)
from tests.client.clientkit import FAST, SHORT, SOON, balance, bid_by_hand, by_hand, gone, steps
from tests.client.inside import Link
from tests.handmade import until
from tests.protocols.frame_times import give_frames

HEADER = 12
"""Bytes of a frame's header."""
IN_FRONT = HEADER + 4
"""Bytes of a result's frame in front of the container: header and application id."""
SEGMENT = 1460
"""Bytes of payload that Ethernet carries in one TCP segment."""


@contextlib.asynccontextmanager
async def through_proxy(
    **options: Any,
) -> AsyncIterator[tuple[HandmadeCamera, LinkProxy, Camera]]:
    """A handmade camera, a proxy, and a client in a session through it."""
    async with (
        HandmadeCamera() as box,
        LinkProxy("127.0.0.1", box.port) as proxy,
        smartcam.connect(proxy.url(box.url), reconnect=None, **options) as camera,
    ):
        yield box, proxy, camera


class Work:
    """Bytes from the client's socket, and the memory that the client takes for them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.sizes: list[int] = []  # bytes of each delivery
        # bytes of memory that were taken at each, where ``tracemalloc`` runs
        self.taken: list[int] = []
        receive = Link.buffer_updated

        def measured(link: Link, nbytes: int) -> None:
            tracemalloc.reset_peak()
            before, _ = tracemalloc.get_traced_memory()
            receive(link, nbytes)
            self.taken.append(tracemalloc.get_traced_memory()[1] - before)
            self.sizes.append(nbytes)

        monkeypatch.setattr(Link, "buffer_updated", measured)


async def next_of(results: Any) -> Result:
    """Return the next result of a stream, which is to come at once."""
    async with asyncio.timeout(10):
        result: Result = await anext(results)
        return result


def has_received(camera: Camera, count: int) -> bool:
    return camera.statistics().received == count


async def test_results_that_arrive_while_a_command_waits_are_kept() -> None:
    """A client that reads until its answer comes throws away what comes before it: results."""
    async with by_hand() as (box, camera):
        results = camera.results()
        box.script[QUERY] = lambda _: b""
        asking = asyncio.create_task(camera.query_application())
        await box.wait_for(QUERY, count=box.ids.count(QUERY) + 1)
        for number in range(3):
            box.send(box.result_frame(b"%d" % number))
            await until(functools.partial(has_received, camera, number + 1))
        assert not asking.done()
        box.send(box.frame(QUERY, bytes([7, 0, 0, 0])))
        assert await asking == 7
        assert [(await next_of(results)).raw for _ in range(3)] == [b"0", b"1", b"2"]
        assert camera.statistics().streamed == 3
        balance(camera.statistics())


async def test_body_with_the_magic_number_at_a_segments_edge_is_delivered() -> None:
    """A client that takes a segment that begins with the magic number for a new frame loses both.

    The magic number begins a segment, ends one, and lies across the edge.
    """
    magic = HANDBOOK
    body = b"before" + magic + b"behind" + magic
    place = IN_FRONT + len(b"before")
    async with through_proxy() as (box, proxy, camera):
        results = camera.results()
        for edge in range(place, place + len(magic) + 1):
            proxy.from_now(SplitBytes(at=edge))
            box.send(box.result_frame(body) + box.result_frame(b"next"))
            assert [(await next_of(results)).raw for _ in range(2)] == [body, b"next"]
        assert proxy.counts["split"] == len(magic) + 1


async def test_header_split_after_five_bytes_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that wants a whole header from one read fails where it comes as 5 and 7 bytes."""
    work = Work(monkeypatch)
    async with through_proxy() as (box, proxy, camera):
        results = camera.results()
        proxy.from_now(SplitBytes(at=5, pause=SHORT), SplitBytes(at=HEADER, pause=SHORT))
        box.send(box.result_frame(b"found"))
        assert (await next_of(results)).raw == b"found"
        assert work.sizes[-3:] == [5, 7, 9]


async def test_one_split_packet_does_not_spoil_later_ones() -> None:
    """A client that loses its place in the stream once reads garbage from then on."""
    async with through_proxy() as (box, proxy, camera):
        results = camera.results()
        size = len(box.result_frame(b"00"))
        for at in range(1, size):
            proxy.from_now(SplitBytes(at=at))
            bodies = [b"%02d" % at, b"a", b"b" * 50]
            box.send(b"".join(map(box.result_frame, bodies)))
            assert [(await next_of(results)).raw for _ in bodies] == bodies
        assert proxy.counts["split"] == size - 1
        assert await camera.query_application() == 7


async def test_silent_peer_ends_at_the_deadline() -> None:
    """A client without a deadline waits for ever where the peer is gone and its socket is not."""
    async with through_proxy(close_timeout=SHORT) as (_, proxy, camera):
        proxy.stall()
        begin = asyncio.get_running_loop().time()
        with pytest.raises(ResponseTimeoutError):
            async with asyncio.timeout(5):
                await camera.query_application(timeout=SHORT)
        assert asyncio.get_running_loop().time() - begin >= SHORT * 0.8
        assert proxy.open_connections == 1


@pytest.mark.long
async def test_body_of_5_mb_in_segments_is_copied_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that copies what it has with each segment needs minutes for an image."""
    work, size = Work(monkeypatch), 5_000_000
    async with through_proxy(max_length=8 << 20) as (box, proxy, camera):
        results = camera.results()
        body = bytes(range(250)) * (size // 250)
        edges: list[Rule] = [SplitBytes(at=at) for at in range(SEGMENT, size, SEGMENT)]
        proxy.from_now(*edges)
        with tracing_memory():
            box.send(box.result_frame(body))
            assert (await next_of(results)).raw == body
        assert len(work.sizes) > 0.5 * len(edges)  # some come together on a busy machine
    # the buffer, grown once, and the body; a copy with each segment is hundreds of times the size
    assert sum(work.taken) < 5 * size


@contextlib.contextmanager
def tracing_memory() -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
    finally:
        tracemalloc.stop()


async def test_image_sized_answer_pays_no_idle_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that takes silence for the end of an answer pays that silence with every one.

    From the last byte on the loop's time stands still here, so no timer can lie between.
    """
    work = Work(monkeypatch)
    async with by_hand() as (box, camera):
        image = bytes(1_000_000)
        sent = box.status_frame(RUNNING) + box.result_frame(image) + box.status_frame(READY)
        box.script[TRIGGER] = lambda _: sent
        before = sum(work.sizes)
        triggering = asyncio.create_task(camera.trigger(timeout=60))
        answer = box.said(QUERY, box.active)  # to the question in front, and to that behind it
        await until(lambda: sum(work.sizes) == before + 2 * len(answer) + len(sent))
        loop = asyncio.get_running_loop()
        now = loop.time()
        with monkeypatch.context() as standing:
            standing.setattr(loop, "time", lambda: now)
            await steps(10)
        assert triggering.done()
        assert len((await triggering).raw) == len(image)


MILLION = 1_000_000
each_dialect = pytest.mark.parametrize("dialect", ["handbook", "thesis"])


@contextlib.asynccontextmanager
async def speaking(box: HandmadeCamera, data: bytes) -> AsyncIterator[None]:
    """Have a camera say the same again and again, byte by byte, until the client comes back."""
    before = box.connections

    async def speak() -> None:
        for byte in itertools.cycle(data):
            if box.connections != before:
                return
            box.send(bytes([byte]))
            await asyncio.sleep(0.001)  # so that it is a segment of its own, mostly

    task = asyncio.create_task(speak())
    try:
        yield
    finally:
        task.cancel()
        await asyncio.wait({task})


async def lost(camera: Camera) -> str:
    """Wait until the link is lost; return the text of the broken frame's error."""
    async with asyncio.timeout(SOON):
        error = await gone(asyncio.create_task(camera.wait_status(lambda _: False, SOON)))
    assert isinstance(error, ConnectionLostError)
    assert isinstance(error.__cause__, FrameError)
    return str(error.__cause__)


@each_dialect
async def test_false_length_of_a_status_ends_the_link_at_its_header(dialect: str) -> None:
    async with by_hand(box={"dialect": dialect}, reconnect=FAST) as (box, camera):
        losing = asyncio.create_task(lost(camera))
        await steps(2)
        box.send(box.wire.magic + words(MILLION, STATUS))
        assert "announces" in await losing
        await camera.wait_connected(SOON)
        assert (await camera.trigger()).raw == b"found"


@each_dialect
async def test_false_length_of_a_result_ends_the_link_when_others_come(
    dialect: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    give_frames(monkeypatch, HINT_TIME=0.0)
    async with by_hand(box={"dialect": dialect}, reconnect=FAST) as (box, camera):
        results = camera.results()
        losing = asyncio.create_task(lost(camera))
        await steps(2)
        box.send(box.result_frame(b"before") + box.wire.magic + words(MILLION, RESULT))
        async with speaking(box, box.result_frame(b"unheard")):
            assert "holds another header" in await losing
            await camera.wait_connected(SOON)
        box.send(box.result_frame(b"behind"))
        assert [(await anext(results)).raw for _ in range(2)] == [b"before", b"behind"]
        assert (await camera.trigger()).raw == b"found"


@pytest.mark.parametrize("kind", ["handbook", "thesis", "bid"])
async def test_frame_that_trickles_ends_the_link(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    give_frames(monkeypatch, HINT_TIME=0.0, FRAME_TIME=0.0, MIN_BYTES_PER_SECOND=float("inf"))
    box_of: Any = {"dialect": kind} if kind != "bid" else {}
    opening: Any = by_hand if kind != "bid" else bid_by_hand
    async with opening(box=box_of, reconnect=FAST) as (box, camera):
        losing = asyncio.create_task(lost(camera))
        await steps(2)
        box.send(box.frame(RESULT, bytes(60_000))[:99])
        async with speaking(box, b"\xff"):
            assert "does not become whole" in await losing
            await camera.wait_connected(SOON)
        assert (await camera.trigger()).raw == b"found"
