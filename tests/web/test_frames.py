"""The site of pictures: viewers get the newest frame, slow ones skip, without viewers no reader."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import threading
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import aiohttp
import numpy as np
import pytest

from smartcam.exceptions import ConfigurationError, FrameFormatError, MissingExtraError
from smartcam.frames import Frame, FrameSource, find_format
from smartcam.web import FramesSite, _jpeg
from smartcam.web._frames import CALLS
from smartcam.web._inside import is_whole_jpeg, pixels_to_show
from smartcam.web._jpeg import HUFFMAN_TABLES, jpeg
from tests.frames.drivers import GoneError, ScriptedDriver, frame, scripted
from tests.handmade import until
from tests.web.inside import PICTURES_MAX_VIEWERS as MAX_VIEWERS
from tests.web.inside import PICTURES_PROTOCOL as PROTOCOL
from tests.web.inside import READER_TIMEOUT, JpegMaker
from tests.web.inside import _pictures as pictures_module
from tests.web.sitekit import TOKEN, Caller, Raw

simplejpeg = pytest.importorskip("simplejpeg", reason="needs the extra frames")


class Shown(NamedTuple):
    """A picture as the page gets it."""

    frame: dict[str, Any]
    account: dict[str, Any]
    pixels: Any


class Looker:
    """One who looks, as the page does."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket

    async def word(self) -> dict[str, Any]:
        """Return the next JSON."""
        async with asyncio.timeout(60):
            told: dict[str, Any] = json.loads(await self.socket.receive_str())
            return told

    async def picture(self) -> Shown:
        """Return the next picture, without a report that it was shown."""
        async with asyncio.timeout(60):
            data = await self.socket.receive_bytes()
        end = 4 + int.from_bytes(data[:4], "little")
        told = json.loads(data[4:end])
        pixels = simplejpeg.decode_jpeg(data[end:], colorspace="GRAY")[..., 0]
        return Shown(told["frame"], told["counts"], pixels)

    async def next(self) -> None:
        await self.socket.send_str("next")


class World(NamedTuple):
    """A device, its source, the site, and who calls it."""

    driver: ScriptedDriver
    source: FrameSource
    site: FramesSite
    caller: Caller

    @contextlib.asynccontextmanager
    async def looking(self, place: int = 0, **options: Any) -> AsyncIterator[Looker]:
        options = {"protocols": [PROTOCOL], **options}
        url = self.caller.url(f"/api/sources/{place}/pictures")
        async with self.caller.session.ws_connect(url, **options) as socket:
            yield Looker(socket)


@contextlib.asynccontextmanager
async def world(*, token: str | None = None, opened: bool = True) -> AsyncIterator[World]:
    driver, source = scripted(stall=None)
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    async with contextlib.AsyncExitStack() as stack:
        if opened:
            await stack.enter_async_context(source)
        site = await stack.enter_async_context(FramesSite([source], token=token))
        session = await stack.enter_async_context(aiohttp.ClientSession(headers=headers))
        yield World(driver, source, site, Caller(site, session, ""))


def plain(number: int, grey: int = 128, **other: Any) -> Frame:
    """Return a frame of 16 x 16 pixels of one grey."""
    about = {"data": bytes([grey]) * 256, "width": 16, "height": 16, "stride": 16}
    return frame(number, **(about | other))


# ---------------------------------------------------------------------- who looks


async def test_looker_gets_the_newest_frame_and_its_account() -> None:
    async with world() as all_of, all_of.looking() as looker:
        told = await looker.word()
        assert (told["state"], told["format"]) == ("no_frame_yet", "Mono8 4x2 at 30/s")
        await all_of.driver.streams()
        all_of.driver.give(plain(7, 200, lost=3))
        shown = await looker.picture()
    assert abs(int(shown.pixels.mean()) - 200) <= 2
    assert {name: shown.frame[name] for name in ("sequence", "width", "height", "format")} == {
        "sequence": 7, "width": 16, "height": 16, "format": "Mono8",
    }  # fmt: skip
    assert shown.frame["moment"] == "start of exposure"
    assert 0 <= shown.frame["age"] < 60
    assert (shown.account["offered"], shown.account["lost"]) == (1, 3)


async def test_slow_looker_skips_and_has_one_picture_on_the_way() -> None:
    async with world() as all_of, all_of.looking() as looker:
        await looker.word()
        await all_of.driver.streams()
        all_of.driver.give(plain(1))
        assert (await looker.picture()).frame["sequence"] == 1
        for number in range(2, 50):  # while the first is not shown yet
            all_of.driver.give(plain(number))
        await looker.next()
        shown = await looker.picture()
        assert shown.frame["sequence"] == 49
        assert (shown.account["offered"], shown.account["skipped"]) == (49, 47)
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(5):  # of the loop's own time: nothing more comes
                await looker.socket.receive()


async def test_device_streams_while_somebody_looks() -> None:
    async with world() as all_of:
        assert all_of.driver.calls == ["open"]
        async with all_of.looking() as one:
            await one.word()
            await all_of.driver.streams()
            async with all_of.looking() as other:
                assert (await other.word())["readers"] == 2
            await until(lambda: all_of.source.statistics().readers == 1)
            assert all_of.driver.calls == ["open", "start"]
        await all_of.driver.rests()
        assert all_of.driver.calls == ["open", "start", "stop"]
        assert all_of.site.viewers == set()


async def test_looker_that_shows_nothing_more_is_disconnected() -> None:
    async with world() as all_of, all_of.looking() as looker:
        await looker.word()
        await all_of.driver.streams()
        all_of.driver.give(plain(1))
        await looker.picture()
        message = (
            await looker.socket.receive()
        )  # takes no time of ours, but pictures_module.READER_TIMEOUT
        assert message.type in {aiohttp.WSMsgType.CLOSED, aiohttp.WSMsgType.ERROR}
        await all_of.driver.rests()


async def test_looker_that_reads_nothing_holds_up_nobody_and_is_disconnected() -> None:
    large = {"width": 1000, "height": 1000, "stride": 1000}
    noise = np.random.default_rng(1).integers(0, 256, 1_000_000, np.uint8).tobytes()
    async with world() as all_of, Raw.connected(all_of.site) as raw, all_of.looking() as looker:
        raw.writer.write(
            b"GET /api/sources/0/pictures HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\n"
            b"Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
        )
        raw.writer.transport.pause_reading()  # type: ignore[attr-defined]
        await looker.word()
        await until(lambda: all_of.source.statistics().readers == 2)
        for number in range(1, 3):
            all_of.driver.give(frame(number, data=noise, **large))
            assert (await looker.picture()).frame["sequence"] == number
            await looker.next()
        await asyncio.sleep(READER_TIMEOUT + 1)
        assert all_of.source.statistics().readers == 1


@pytest.mark.parametrize("word", ["more", "next" * 100])
async def test_looker_that_says_something_else_is_disconnected(word: str) -> None:
    async with world() as all_of, all_of.looking() as looker:
        await looker.word()
        await looker.socket.send_str(word)
        message = await looker.socket.receive()
        assert message.type is aiohttp.WSMsgType.CLOSE
        await all_of.driver.rests()


async def test_looker_is_told_the_account_if_no_frame_comes() -> None:
    async with world() as all_of, all_of.looking() as looker:
        await looker.word()
        await all_of.driver.streams()
        first, second = await looker.word(), await looker.word()
    assert first["counts"]["offered"] == second["counts"]["offered"] == 0


async def test_source_that_dies_is_told_and_read_again() -> None:
    async with world() as all_of, all_of.looking() as looker:
        await looker.word()
        await all_of.driver.streams()
        assert all_of.driver.sink is not None
        all_of.driver.sink.ended(GoneError("scripted: it was unplugged"))
        told = await looker.word()
        assert (told["state"], told["text"]) == ("lost", "scripted: it was unplugged")
        await until(lambda: all_of.driver.calls.count("start") == 2)
        all_of.driver.give(plain(9))
        assert (await looker.picture()).frame["sequence"] == 9


async def test_source_that_has_ended_is_told_and_not_begun_again() -> None:
    async with world() as all_of, all_of.looking() as looker:
        await looker.word()
        await all_of.driver.streams()
        assert all_of.driver.sink is not None
        all_of.driver.sink.ended(None)
        assert (await looker.word())["state"] == "ended"
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(30):
                await looker.socket.receive()
        assert all_of.driver.calls.count("start") == 1


async def test_source_that_is_not_open_is_awaited_with_the_reason() -> None:
    async with world(opened=False) as all_of, all_of.looking() as looker:
        all_of.site.failures[0] = "scripted: no such device"
        assert (await looker.word())["text"] == "scripted is not open"
        assert await looker.word() == {"state": "not_open", "text": "scripted: no such device"}
        async with all_of.source:
            while (await looker.word())["state"] != "no_frame_yet":
                pass


async def test_frame_that_is_broken_is_reported_and_the_next_is_shown() -> None:
    async with world() as all_of, all_of.looking() as looker:
        await looker.word()
        await all_of.driver.streams()
        all_of.driver.give(plain(1, data=b"too short"))
        told = await looker.word()
        assert "expected" in told["bad"]
        assert told["counts"]["bad"] == 1
        all_of.driver.give(plain(2))
        assert (await looker.picture()).account["bad"] == 1
        assert all_of.driver.calls == ["open", "start"]


async def test_looker_that_vanishes_harms_nobody() -> None:
    async with world() as all_of, Raw.connected(all_of.site) as raw, all_of.looking() as looker:
        await looker.word()
        raw.writer.write(
            b"GET /api/sources/0/pictures HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\n"
            b"Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
        )
        await until(lambda: all_of.source.statistics().readers == 2)
        all_of.driver.give(plain(1))
        assert (await looker.picture()).frame["sequence"] == 1
        raw.writer.transport.abort()  # without a word, its picture on the way
        await until(lambda: all_of.source.statistics().readers == 1)
        await looker.next()
        all_of.driver.give(plain(2))
        assert (await looker.picture()).frame["sequence"] == 2
        assert all_of.driver.calls == ["open", "start"]


async def test_picture_that_is_too_large_is_not_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    small = jpeg(plain(1), 80)
    monkeypatch.setattr(pictures_module, "MAX_PICTURE_BYTES", len(small))
    async with world() as all_of, all_of.looking() as looker:
        await looker.word()
        await all_of.driver.streams()
        for extra, number in ((1, 1), (0, 2)):
            data = small + bytes(extra)
            mjpeg = plain(number, data=data, format=find_format("MJPEG"), stride=0)
            all_of.driver.give(mjpeg)
            if extra:
                told = await looker.word()
                assert told["bad"].endswith(f"expected {len(small)} at most")
        assert (await looker.picture()).frame["sequence"] == 2


async def test_site_that_stops_says_good_bye() -> None:
    async with world() as all_of, all_of.looking() as looker:
        await looker.word()
        await all_of.site.stop()
        message = await looker.socket.receive()
        assert (message.type, message.data) == (aiohttp.WSMsgType.CLOSE, 1001)
        await all_of.driver.rests()
        await all_of.site.start()
        async with all_of.looking() as again:
            assert (await again.word())["state"] == "no_frame_yet"


async def test_viewers_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures_module, "MAX_VIEWERS", 1)
    assert MAX_VIEWERS >= 16  # four people before four cameras
    async with world() as all_of, all_of.looking() as looker:
        await looker.word()
        with pytest.raises(aiohttp.WSServerHandshakeError, match="503"):
            await all_of.looking().__aenter__()


# ---------------------------------------------------------------------- who may look


async def test_websocket_needs_the_token_among_its_protocols() -> None:
    async with world(token=TOKEN) as all_of, aiohttp.ClientSession() as stranger:
        url = all_of.caller.url("/api/sources/0/pictures")
        for protocols in ([PROTOCOL], [PROTOCOL, "bearer.another_token-of-24-chars"]):
            with pytest.raises(aiohttp.WSServerHandshakeError, match="401"):
                await stranger.ws_connect(url, protocols=protocols)
        async with stranger.ws_connect(url, protocols=[PROTOCOL, f"bearer.{TOKEN}"]) as socket:
            assert socket.protocol == PROTOCOL
            assert json.loads(await socket.receive_str())["state"] == "no_frame_yet"
        headers = {"Sec-WebSocket-Protocol": f"bearer.{TOKEN}"}
        async with stranger.get(all_of.caller.url("/api/sources"), headers=headers) as response:
            assert response.status == 401  # of a WebSocket alone


async def test_websocket_of_another_site_is_refused() -> None:
    async with world() as all_of:
        with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
            await all_of.looking(origin="http://elsewhere.example").__aenter__()
        assert all_of.driver.calls == ["open"]


@pytest.mark.parametrize(
    ("path", "status", "text"),
    [
        ("/api/sources/0/pictures", 400, "a WebSocket of smartcam.frames"),
        ("/api/sources/1/pictures", 404, "0 to 0"),
        ("/api/sources/x/picture", 404, "0 to 0"),
    ],
)
async def test_wrong_call_is_reported(path: str, status: int, text: str) -> None:
    async with world() as all_of:
        answer = await all_of.caller.call("GET", path)
    assert answer.status == status
    assert text in answer.value["error"]


async def test_websocket_of_another_protocol_is_refused() -> None:
    async with world() as all_of:
        with pytest.raises(aiohttp.WSServerHandshakeError, match="400"):
            await all_of.looking(protocols=["chat"]).__aenter__()


# ---------------------------------------------------------------------- calls


async def test_calls_tell_of_the_sources() -> None:
    async with world() as all_of:
        calls = (await all_of.caller.get("/api"))["calls"]
        assert [one["path"] for one in calls] == [one.path for one in CALLS]
        (told,) = (await all_of.caller.get("/api/sources"))["sources"]
    assert (told["name"], told["streaming"], told["failure"]) == ("scripted", False, "")


async def test_page_has_its_files() -> None:
    async with world() as all_of:
        for path in ("/", "/frames.js", "/frames.css", "/base.css", "/base.js"):
            async with all_of.caller.session.get(all_of.caller.url(path)) as response:
                assert response.status == 200
                assert "connect-src 'self'" in response.headers["Content-Security-Policy"]


async def test_picture_is_the_newest_frame() -> None:
    async with world() as all_of:
        asking = asyncio.create_task(
            all_of.caller.session.get(all_of.caller.url("/api/sources/0/picture"))
        )
        await all_of.driver.streams()
        all_of.driver.give(plain(5, 90))
        async with await asking as response:
            assert (response.status, response.content_type) == (200, "image/jpeg")
            assert response.headers["Frame-Sequence"] == "5"
            grey = simplejpeg.decode_jpeg(await response.read(), colorspace="GRAY")
        assert abs(int(grey.mean()) - 90) <= 2
        await all_of.driver.rests()


async def test_picture_of_a_source_without_frames_reports_it() -> None:
    async with world() as all_of:
        answer = await all_of.caller.call("GET", "/api/sources/0/picture")
        assert answer.status == 409
        assert "got none in time" in answer.value["error"]
    async with world(opened=False) as all_of:
        answer = await all_of.caller.call("GET", "/api/sources/0/picture")
        assert answer.status == 409
        assert "scripted is not open" in answer.value["error"]


# ---------------------------------------------------------------------- JPEGs


async def test_jpeg_is_made_once_for_all_callers_and_a_cancelled_one_spoils_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[int] = []
    gate = threading.Event()

    def slow(one: Frame, _quality: int) -> bytes:
        gate.wait(60)
        made.append(one.sequence)
        return b"jpeg"

    monkeypatch.setattr(_jpeg, "jpeg", slow)
    with ThreadPoolExecutor(1) as threads:
        maker, one = JpegMaker(threads, 80), plain(1)
        waiting = [asyncio.create_task(maker.jpeg(one)) for _ in range(3)]
        await asyncio.sleep(0)
        waiting[0].cancel()
        gate.set()
        assert await asyncio.gather(*waiting[1:]) == [b"jpeg", b"jpeg"]
    assert made == [1]
    assert waiting[0].cancelled()


def test_jpeg_of_a_camera_stays_as_it_came() -> None:
    data = jpeg(plain(1, 100), 60)
    mjpeg = plain(1, data=data, format=find_format("MJPEG"), stride=0)
    assert jpeg(mjpeg, 90) == data


def test_jpeg_that_browsers_cannot_read_is_made_anew() -> None:
    data = jpeg(plain(1, 100), 60)
    begin = data.index(HUFFMAN_TABLES)
    end = data.index(b"\xff\xda")
    bare = data[:begin] + data[end:]  # as webcams send it
    mjpeg = plain(1, data=bare, format=find_format("MJPEG"), stride=0)
    assert not is_whole_jpeg(mjpeg)
    made = jpeg(mjpeg, 90)
    assert HUFFMAN_TABLES in made
    assert abs(int(simplejpeg.decode_jpeg(made, colorspace="GRAY").mean()) - 100) <= 2


def test_jpeg_that_would_be_too_large_is_refused() -> None:
    wide = plain(1, data=bytes(70_000), width=70_000, height=1, stride=70_000)
    with pytest.raises(FrameFormatError, match="no JPEG of 70000x1 pixels"):
        jpeg(wide, 80)


def test_more_than_eight_bits_are_stretched_to_be_seen() -> None:
    levels = np.linspace(0, 4000, 256).astype(np.uint16).reshape(16, 16)
    deep = plain(1, data=levels.tobytes(), format=find_format("Mono12"), stride=32)
    shown = simplejpeg.decode_jpeg(jpeg(deep, 100), colorspace="GRAY")[..., 0]
    assert abs(int(shown[-1, -1]) - 255) <= 2
    assert np.abs(shown - levels / 4000 * 255).max() < 3


def test_distances_are_shown_as_they_are() -> None:
    levels = np.arange(256, dtype=np.uint16).reshape(16, 16)
    depth = plain(1, data=levels.tobytes(), format=find_format("Z16"), stride=32)
    assert np.array_equal(pixels_to_show(depth), levels)
    assert jpeg(depth, 80).startswith(b"\xff\xd8")


def test_colours_stay_colours() -> None:
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 0] = 200
    coloured = plain(1, data=red.tobytes(), format=find_format("RGB8"), stride=48)
    shown = simplejpeg.decode_jpeg(jpeg(coloured, 95))
    assert abs(int(shown[..., 0].mean()) - 200) < 8
    assert shown[..., 1].mean() < 8


def test_site_without_what_makes_jpegs_says_which_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "simplejpeg", None)
    with pytest.raises(MissingExtraError, match=r"smartcam\[frames\]"):
        FramesSite([scripted()[1]])


@pytest.mark.parametrize("quality", [0, 101])
def test_quality_that_is_none_is_refused(quality: int) -> None:
    with pytest.raises(ConfigurationError, match="quality: expected 1 to 100"):
        FramesSite([scripted()[1]], quality=quality)
