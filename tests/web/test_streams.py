"""Event streams: their events, and that nothing waits for them."""

from __future__ import annotations

import asyncio
import contextlib
import socket

import pytest

import smartcam
from smartcam.emulator import EmulatedCamera
from smartcam.models import Status
from smartcam.web._feed import MAX_LOG_NEWS, EmulatorWatcher
from tests.handmade import until
from tests.web.inside import MAX_STREAMS, StreamEvent
from tests.web.inside import _streams as streams
from tests.web.sitekit import Raw, World, served


async def test_stream_tells_first_how_everything_is() -> None:
    async with served() as world, world.events() as events:
        told = [await events.next() for _ in range(4)]
    assert [one.kind for one in told] == ["camera", "scene", "faults", "clock"]
    assert told[0].data["url"] == world.emulator.url
    assert (len(told[1].data["parts"]), told[1].data["reported"]) == (7, None)
    assert told[2].data == {"waiting": [], "waiting_count": 0, "fired": []}
    assert told[3].data == {"time": 0.0, "clock_time": "1970-01-01T00:00:00+00:00"}


async def test_stream_tells_what_changes_and_nothing_else() -> None:
    async with served() as world, world.events() as events:
        await events.next("clock")
        world.emulator.device.set_condition(Status.OVERHEAT, True)
        assert (await events.next()).data["status"] == ["OVERHEAT"]
        world.emulator.scene.pieces.pop("square")
        assert len((await events.next()).data["parts"]) == 6
        world.emulator.inject({"kind": "drop"})
        assert [(await events.next()).kind for _ in range(2)] == ["camera", "faults"]


async def test_stream_tells_the_log_from_now_or_from_a_serial() -> None:
    async with served(active=21, running=True) as world, smartcam.connect(world.emulator.url):
        count = (await world.caller.get())["log"]["next"]
        async with (
            world.events() as now,
            world.events("?since=2") as later,
            world.events(**{"Last-Event-ID": "3"}) as again,
        ):
            await now.next("clock")
            assert (await later.next("log")).data["entries"][0]["serial"] == 2
            told = await again.next("log")
            assert (told.data["entries"][0]["serial"], told.serial) == (3, str(count))
            world.emulator.device.trigger()
            news = await now.next("log")
    assert news.data["entries"][0]["serial"] == count
    assert (news.data["next"], news.data["missed"]) == (count + 1, 0)
    assert news.serial == str(count + 1)


async def test_stream_shows_where_parts_were_reported() -> None:
    async with (
        served(active=7, running=True) as world,
        smartcam.connect(world.emulator.url),
        world.events() as events,
    ):
        await events.next("clock")
        world.emulator.device.trigger()
        world.clock.advance(0.08)
        scene = await events.until("scene", lambda one: one["reported"])
    assert len(scene["reported"]["parts"]) == 7


async def test_streams_are_no_more_than_fit() -> None:
    async with served() as world, contextlib.AsyncExitStack() as stack:
        for _ in range(MAX_STREAMS):
            await stack.enter_async_context(world.events())
        answer = await world.caller.call("GET", "events")
    assert (answer.status, answer.value["expected"]) == (503, "16 at one time")


async def test_stream_of_a_reader_that_goes_is_given_up() -> None:
    async with served() as world:
        async with world.events() as events:
            await events.next("clock")
            assert len(world.site.streams) == 1
        await until(lambda: not len(world.site.streams))


async def test_site_that_stops_ends_its_streams_at_once() -> None:
    async with served() as world, world.events() as events:
        await events.next("clock")
        async with asyncio.timeout(0.5):
            await world.site.stop()
        assert await events.end() == b""


async def stuffed(raw: Raw, world: World) -> None:
    """CallRequest for a stream, and read nothing of it until the site can write no more."""
    sock = raw.writer.get_extra_info("socket")
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    raw.reader._transport.pause_reading()  # type: ignore[attr-defined]
    raw.writer.write(b"GET /api/cameras/camera/events HTTP/1.1\r\nHost: localhost\r\n\r\n")
    await until(lambda: len(world.site.streams) == 1)


@pytest.fixture
def flood(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make each look of a stream give a lot of news."""
    monkeypatch.setattr(streams, "PERIOD", 0.0)
    monkeypatch.setattr(
        EmulatorWatcher, "find_events", lambda _self: [StreamEvent("log", "x" * 500_000)]
    )


async def test_slow_reader_is_disconnected(flood: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "READER_TIMEOUT", 0.05)
    async with served() as world, Raw.connected(world.site) as raw:
        await stuffed(raw, world)
        await until(lambda: not len(world.site.streams))
        assert (await world.caller.get())["name"] == "camera"


async def test_slow_reader_holds_up_neither_emulator_nor_stop(flood: None) -> None:
    async with served(active=21, running=True) as world, Raw.connected(world.site) as raw:
        await stuffed(raw, world)
        async with smartcam.connect(world.emulator.url, interpret_as="text: string[20]") as camera:
            triggered = asyncio.create_task(camera.trigger())
            await until(lambda: world.emulator.device.processing)
            world.clock.advance(0.05)
            assert (await triggered).value.text == "Hello World"
        async with asyncio.timeout(60):
            await world.site.stop()


# ---------------------------------------------------------------------- looking for news


def log_news(watcher: EmulatorWatcher) -> list[StreamEvent]:
    return [one for one in watcher.find_events() if one.kind == "log"]


async def filled(emulator: EmulatedCamera, count: int) -> None:
    """Put so many messages into the log."""
    for number in range(count):
        emulator.device.set_endian(number % 2)


async def test_watcher_catches_up_in_pieces() -> None:
    async with served() as world, smartcam.connect(world.emulator.url):
        watcher = EmulatorWatcher("camera", world.emulator)
        await filled(world.emulator, MAX_LOG_NEWS + 50)
        pieces = [news.data for _ in range(3) for news in log_news(watcher)]
    assert [len(one["entries"]) for one in pieces] == [MAX_LOG_NEWS, 49]
    assert pieces[0]["next"] == pieces[1]["entries"][0]["serial"]


async def test_watcher_tells_what_it_missed() -> None:
    async with served() as world, smartcam.connect(world.emulator.url):
        watcher = EmulatorWatcher("camera", world.emulator)
        await filled(world.emulator, 11)
        for _ in range(len(world.emulator.log) - 3):
            world.emulator.log.popleft()
        (news,) = log_news(watcher)
        world.emulator.log.clear()
        assert log_news(watcher) == []
    assert (news.data["missed"], len(news.data["entries"])) == (7, 3)


async def test_watcher_with_a_serial_of_another_time_begins_with_the_next() -> None:
    async with served() as world, smartcam.connect(world.emulator.url):
        watcher = EmulatorWatcher("camera", world.emulator, 1_000_000)
        assert log_news(watcher) == []
        world.emulator.device.set_endian(1)
        assert len(log_news(watcher)) == 1
