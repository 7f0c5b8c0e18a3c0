"""The site on which a colour is picked: its calls, and its page in a real browser (below)."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
from collections.abc import AsyncIterator
from typing import Any, NamedTuple

import aiohttp
import numpy as np
import pytest
from numpy.typing import NDArray

from smartcam.depth import ColourRange
from smartcam.exceptions import ConfigurationError
from smartcam.frames import Frame, FrameSource, find_format
from smartcam.web import ColourSite
from smartcam.web import _colours as colours_module
from smartcam.web._colours import CALLS, MAX_VIEWERS_KEPT, MAX_WAITING_REQUESTS, PICTURES_PER_VIEWER
from tests import ROOT
from tests.cli.commandline import run
from tests.frames.drivers import GoneError, ScriptedDriver, frame, scripted
from tests.handmade import until
from tests.processes import Process
from tests.web.sitekit import TOKEN, Answer, Caller

cv2 = pytest.importorskip("cv2", reason="needs the extra depth")
simplejpeg = pytest.importorskip("simplejpeg", reason="needs the extra frames")

BLACK: dict[str, Any] = {"hue": [0, 179], "saturation": [0, 255], "value": [0, 60]}
SIZE = (120, 80)
BLOCK = np.s_[30:50, 40:100]


def picture(colour: tuple[int, int, int] = (20, 20, 22)) -> NDArray[np.uint8]:
    """Return a block of a colour on a light table."""
    seen = np.full((SIZE[1], SIZE[0], 3), (190, 200, 150), np.uint8)
    seen[BLOCK] = colour
    return seen


def coloured(number: int, colour: tuple[int, int, int] = (20, 20, 22), **other: Any) -> Frame:
    about = {
        "data": picture(colour).tobytes(),
        "format": find_format("RGB8"),
        "width": SIZE[0],
        "height": SIZE[1],
        "stride": 3 * SIZE[0],
    }
    return frame(number, **(about | other))


class Look(NamedTuple):
    """An answer that a page gets."""

    about: dict[str, Any]
    pixels: NDArray[np.uint8]
    mask: NDArray[np.uint8]


class World(NamedTuple):
    driver: ScriptedDriver
    source: FrameSource
    site: ColourSite
    caller: Caller

    async def ask(self, again: bool = False, **other: Any) -> Look:
        body = {"viewer": "me", "range": BLACK, "again": again, **other}
        url = self.caller.url("/api/look")
        async with self.caller.session.post(url, json=body) as response:
            assert response.status == 200, await response.text()
            data = await response.read()
        end = 4 + int.from_bytes(data[:4], "little")
        about = json.loads(data[4:end])
        jpeg, png = data[end : end + about["jpeg"]], data[end + about["jpeg"] :]
        mask = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
        return Look(about, simplejpeg.decode_jpeg(jpeg), mask)

    async def get(self, one: Frame, **other: Any) -> Look:
        """Ask for a picture, and have the device give this one."""
        asking = asyncio.create_task(self.ask(**other))
        await until(lambda: self.source.statistics().readers == 1)
        await self.driver.streams()
        self.driver.give(one)
        return await asking

    async def refused(self, path: str, **body: Any) -> Answer:
        return await self.caller.call("POST", path, {"viewer": "me", **body})


@contextlib.asynccontextmanager
async def world(*, opened: bool = True, token: str | None = None) -> AsyncIterator[World]:
    driver, source = scripted(stall=None)
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    async with contextlib.AsyncExitStack() as stack:
        if opened:
            await stack.enter_async_context(source)
        site = ColourSite(source, colours=ColourRange(value=(0, 90)), token=token)
        await stack.enter_async_context(site)
        session = await stack.enter_async_context(aiohttp.ClientSession(headers=headers))
        yield World(driver, source, site, Caller(site, session, ""))


async def test_picture_comes_with_its_mask_and_regions() -> None:
    async with world() as all_of:
        seen = await all_of.get(coloured(7))
    assert seen.about["sequence"] == 7
    assert seen.about["range"] == BLACK
    assert seen.about["share"] == pytest.approx(1200 / 9600)
    (region,) = seen.about["regions"]
    assert (region["area"], region["sides"], region["orientation"]) == (1200, [60, 20], 0)
    assert region["centre"] == [69.5, 39.5]
    expected = np.zeros(SIZE[::-1], np.uint8)
    expected[BLOCK] = 255
    np.testing.assert_array_equal(seen.mask, expected)
    assert np.abs(seen.pixels[BLOCK].astype(int) - (20, 20, 22)).mean() < 8


async def test_device_streams_for_who_asks_and_the_newest_is_shown() -> None:
    async with world() as all_of:
        assert all_of.driver.calls == ["open"]
        await all_of.get(coloured(1))
        await all_of.driver.rests()
        asking = asyncio.create_task(all_of.ask())
        await all_of.driver.streams()
        all_of.driver.give(coloured(2), coloured(3))
        assert (await asking).about["sequence"] in {2, 3}


async def test_other_range_is_shown_of_the_same_picture_without_the_device() -> None:
    async with world() as all_of:
        await all_of.get(coloured(1))
        await all_of.driver.rests()
        calls = list(all_of.driver.calls)
        light = {**BLACK, "value": [100, 255]}
        seen = await all_of.ask(again=True, range=light)
        assert (seen.about["sequence"], seen.about["range"]) == (1, light)
        assert seen.about["share"] == pytest.approx(1 - 1200 / 9600)
        assert all_of.driver.calls == calls


async def test_click_takes_the_colours_of_the_picture_that_was_shown() -> None:
    async with world() as all_of:
        await all_of.get(coloured(1, (20, 20, 22)))
        await all_of.get(coloured(2, (200, 30, 20)))
        where = {"viewer": "me", "x": 70, "y": 40}
        dark = await all_of.caller.post("/api/around", {**where, "sequence": 1})
        red = await all_of.caller.post("/api/around", {**where, "sequence": 2})
        assert ColourRange(**dark["range"]).mask(picture()).sum() == 1200
        assert not ColourRange(**dark["range"]).mask(picture((200, 30, 20))).any()
        assert ColourRange(**red["range"]).mask(picture((200, 30, 20))).sum() == 1200
        await all_of.get(coloured(3))
        gone = await all_of.refused("/api/around", sequence=1, x=70, y=40)
        assert gone.status == 409
        assert "picture 1 that is not kept any longer" in gone.value["error"]
        for x, y in ((120, 0), (0, -1)):
            outside = await all_of.refused("/api/around", sequence=3, x=x, y=y)
            assert (outside.status, outside.value["expected"]) == (422, "one within 120x80")


async def test_pictures_of_few_are_kept_and_two_of_each() -> None:
    async with world() as all_of:
        for number in range(MAX_VIEWERS_KEPT + 1):
            await all_of.get(coloured(number), viewer=f"viewer {number}")
        kept = [f"viewer {number}" for number in range(1, MAX_VIEWERS_KEPT + 1)]
        assert list(all_of.site._pictures) == kept
        for number in range(4):
            await all_of.get(coloured(number), viewer=kept[0])
        assert [one.sequence for one in all_of.site._pictures[kept[0]]] == [2, 3]
        assert PICTURES_PER_VIEWER == 2
        gone = await all_of.refused("/api/look", viewer="viewer 0", range=BLACK, again=True)
        assert gone.status == 409


async def test_those_who_wait_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(colours_module, "MAX_WAITING_REQUESTS", 1)
    assert MAX_WAITING_REQUESTS >= 8
    async with world() as all_of:
        asking = asyncio.create_task(all_of.ask())
        await all_of.driver.streams()
        assert (await all_of.refused("/api/look", range=BLACK)).status == 503
        all_of.driver.give(coloured(1))
        assert (await asking).about["sequence"] == 1
        assert (await all_of.get(coloured(2))).about["sequence"] == 2


async def test_source_that_gives_nothing_says_why() -> None:
    async with world(opened=False) as all_of:
        answer = await all_of.refused("/api/look", range=BLACK)
        assert (answer.status, answer.value["received"]) == (409, "scripted is not open")
    async with world() as all_of:
        answer = await all_of.refused("/api/look", range=BLACK)
        assert answer.status == 409
        assert "got none in time" in answer.value["error"]
        for error, status in ((GoneError("scripted: it was unplugged"), 409), (None, 410)):
            await all_of.driver.rests()
            asking = asyncio.create_task(all_of.refused("/api/look", range=BLACK))
            await all_of.driver.streams()
            assert all_of.driver.sink is not None
            all_of.driver.sink.ended(error)
            answer = await asking
            assert answer.status == status
            assert answer.value["received"] == (
                "scripted has ended" if error is None else str(error)
            )


async def test_broken_frame_is_reported_and_the_next_is_shown() -> None:
    async with world() as all_of:
        asking = asyncio.create_task(all_of.refused("/api/look", range=BLACK))
        await all_of.driver.streams()
        all_of.driver.give(coloured(1, data=b"torn"))
        answer = await asking
        assert (answer.status, answer.value["expected"]) == (409, "a frame that can be read")
        assert (await all_of.get(coloured(2))).about["sequence"] == 2


@pytest.mark.parametrize(
    ("path", "body", "text"),
    [
        ("/api/look", {"range": {**BLACK, "hue": [0, 180]}}, "whole numbers 0 to 179"),
        ("/api/look", {"range": {**BLACK, "value": [9, 3]}}, "whole numbers 0 to 255"),
        ("/api/look", {"range": {**BLACK, "hue": [0] * 1000}}, "(from, to)"),
        ("/api/look", {"range": {"hue": [0, 1]}}, "a value"),
        ("/api/look", {"range": BLACK, "viewer": "x" * 65}, "at most 64 characters"),
        ("/api/around", {"sequence": 1, "x": 1.5, "y": 0}, "valid integer"),
    ],
)
async def test_wrong_call_is_reported(path: str, body: dict[str, Any], text: str) -> None:
    async with world() as all_of:
        answer = await all_of.refused(path, **body)
        assert answer.status == 422
        assert text in answer.value["error"]
        assert all_of.driver.calls == ["open"]


async def test_calls_tell_of_the_source_and_need_the_token() -> None:
    async with world(token=TOKEN) as all_of, aiohttp.ClientSession() as stranger:
        calls = (await all_of.caller.get("/api"))["calls"]
        assert [one["path"] for one in calls] == [one.path for one in CALLS]
        told = await all_of.caller.get("/api/source")
        assert told == {"name": "scripted", "range": {**BLACK, "value": [0, 90]}}
        for path in ("/api/source", "/api"):
            async with stranger.get(all_of.caller.url(path)) as response:
                assert response.status == 401
        for path in ("/", "/colours.js", "/colours.css", "/base.css", "/base.js"):
            async with stranger.get(all_of.caller.url(path)) as response:
                assert response.status == 200


async def test_threads_end_with_the_site() -> None:
    async with world() as all_of:
        await all_of.get(coloured(1))
        assert any("smartcam.web.colours" in one.name for one in threading.enumerate())
        await all_of.site.stop()
        assert not any("smartcam.web.colours" in one.name for one in threading.enumerate())
        await all_of.site.start()
        assert (await all_of.get(coloured(2))).about["sequence"] == 2


def test_quality_that_is_none_is_reported() -> None:
    _, source = scripted()
    with pytest.raises(ConfigurationError, match="quality: expected 1 to 100, got 0"):
        ColourSite(source, quality=0)


def test_document_has_every_bound() -> None:
    page = (ROOT / "docs" / "tower.md").read_text(encoding="utf-8")
    assert PICTURES_PER_VIEWER == 2
    assert f"two pictures are kept for each of the last {MAX_VIEWERS_KEPT}" in page
    assert f"At most {MAX_WAITING_REQUESTS} calls may wait" in page


# ---------------------------------------------------------------------- the command


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ('{"value": [60, 0]}', "--range: ColourRange: value: expected"),
        ("[0, 60]", "--range: expected JSON such as"),
        ("value", "--range: expected JSON such as"),
        ('{"brightness": [0, 60]}', "--range: expected JSON such as"),
    ],
)
def test_command_tells_a_wrong_range(given: str, text: str) -> None:
    outcome = run("frames", "colours", "synthetic://", "--range", given)
    assert outcome.code == 2
    assert text in outcome.err


@pytest.mark.long
@pytest.mark.real_time
def test_command_serves_the_page_until_it_is_ended() -> None:
    with Process("smartcam", "frames", "colours", "synthetic://", "--json") as process:
        told = json.loads(process.read_until(b"\n"))
        assert told["page"].startswith("http://127.0.0.1:")
        process.send_signal(2)
        process.wait().done()
