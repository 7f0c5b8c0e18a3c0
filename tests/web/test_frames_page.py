"""The page of pictures in a real browser."""

from __future__ import annotations

import asyncio
import contextlib
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import pytest_asyncio

import smartcam.frames
from smartcam.frames._inside import read_stamp
from smartcam.web import FramesSite
from tests.frames.drivers import GoneError, frame, scripted
from tests.frames.gige import camera as cameras
from tests.frames.gige.camera import camera
from tests.frames.pictures import stripes, write_stamp
from tests.handmade import until
from tests.processes import free_port
from tests.web.browser import BROWSER_MARKS, HIDE, PATIENCE, new_page, nothing_wrong, pass_gate, see
from tests.web.sitekit import TOKEN

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

    from playwright.async_api import Locator, Page

    from smartcam.frames import Frame, FrameSource
    from tests.frames.drivers import ScriptedDriver

pytestmark = BROWSER_MARKS

LIVE = "#live[data-state=live]"


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def page() -> AsyncIterator[Page]:
    """The one page of all tests; each opens a site of its own in it."""
    async with new_page(1280, 800) as page:
        yield page


@contextlib.asynccontextmanager
async def opened(
    page: Page, sources: Sequence[FrameSource], *, token: str | None = None, changes: bool = False
) -> AsyncIterator[FramesSite]:
    """Show sources; what the browser finds wrong with the page fails the test."""
    with nothing_wrong(page):
        async with FramesSite(sources, token=token, changes=changes) as site:
            await page.goto(site.url)
            await see(page, LIVE)
            yield site
            await page.goto("about:blank")


@contextlib.asynccontextmanager
async def scripted_on(page: Page) -> AsyncIterator[tuple[ScriptedDriver, FrameSource]]:
    """Show a source whose device does what the test says."""
    driver, source = scripted(stall=None)
    async with source, opened(page, [source]):
        await driver.streams()
        yield driver, source


def stamped(number: int, **other: Any) -> Frame:
    picture = stripes(320, 240)
    write_stamp(picture, number, 1)
    about = {"data": picture.tobytes(), "width": 320, "height": 240, "stride": 320}
    return frame(number, **(about | other))


async def shown(page: Page, place: int = 0) -> int | None:
    """Return the number that is drawn into the picture on the page."""
    pixels = await page.eval_on_selector(
        f"[data-place='{place}'] canvas",
        "c => [c.width, c.height, Array.from(c.getContext('2d')"
        ".getImageData(0, 0, c.width, 16).data)]",
    )
    width, height, data = pixels
    assert (width, height) == (320, 240)
    found = read_stamp(np.array(data, np.uint8).reshape(16, width, 4)[..., 0])
    return None if found is None else found[0]


async def test_newest_frame_is_shown_with_its_account(page: Page) -> None:
    async with scripted_on(page) as (driver, _):
        driver.give(stamped(41))
        await see(page, "[data-count=number]", "41")
        assert await shown(page) == 41
        driver.give(stamped(42, lost=2))
        await see(page, "[data-count=number]", "42")
        assert await shown(page) == 42
        assert await page.inner_text("[data-count=format]") == "Mono8 320x240"
        assert await page.inner_text("[data-count=lost]") == "2"
        assert re.match(r"\d+ m?s", await page.inner_text("[data-count=age]"))
        assert (
            await page.get_attribute("[data-count=age]", "title") == "since the start of exposure"
        )


async def test_rates_and_skips_add_up(page: Page) -> None:
    async with (
        smartcam.frames.open("synthetic://?fps=50&size=320x240") as source,
        opened(page, [source]) as site,
    ):
        await see(page, "[data-count=shown]", "/s")
        await until(lambda: source.statistics().frames > 50, PATIENCE)
        for rate in ("shown", "camera"):
            some = page.locator(f"[data-count={rate}]").filter(has_text=re.compile("[1-9].*/s"))
            await some.wait_for()
        assert len(site.viewers) == 1


async def test_frame_that_grows_old_is_said_to_be_so(page: Page) -> None:
    async with scripted_on(page) as (driver, _):
        driver.give(stamped(1))
        await see(page, "[data-count=age].warn", "not fresh")
        await see(page, ".source.old")
        fresh = page.locator(".source:not(.old)")
        async with asyncio.timeout(PATIENCE):
            while not await fresh.count():  # each is so for a while only
                driver.give(stamped(2))
                await asyncio.sleep(0.05)


async def test_source_that_dies_is_said_and_comes_back(page: Page) -> None:
    async with scripted_on(page) as (driver, _):
        driver.give(stamped(1))
        await see(page, "[data-count=number]", "1")
        assert driver.sink is not None
        driver.fails["start"] = GoneError("scripted: it was unplugged <b>")
        driver.sink.ended(GoneError("scripted: it was unplugged <b>"))
        await see(page, ".source[data-state=lost] .why", "it was unplugged <b>")
        await see(page, ".source.old")
        assert await page.inner_text("[data-count=camera]") == "-"
        del driver.fails["start"]
        await driver.streams()
        driver.give(stamped(2))
        await see(page, ".source[data-state=live]")
        assert await page.inner_text(".why") == ""


async def test_frame_that_cannot_be_read_is_counted(page: Page) -> None:
    async with scripted_on(page) as (driver, _):
        driver.give(stamped(1, data=b"torn"))
        await see(page, ".why", "A frame cannot be shown")
        await see(page, "[data-count=lost]", "1 not readable")
        driver.give(stamped(2))
        await see(page, "[data-count=number]", "2")
        assert await page.inner_text(".why") == ""


async def test_source_that_is_awaited_says_why(page: Page) -> None:
    _, source = scripted(stall=None)
    async with opened(page, [source]) as site:
        site.failures[0] = "scripted: no such device"
        await see(page, ".source[data-state=not_open] .why", "scripted: no such device")


async def test_hidden_page_lets_the_device_rest(page: Page) -> None:
    async with scripted_on(page) as (driver, source):
        driver.give(stamped(1))
        await see(page, "[data-count=number]", "1")
        await page.evaluate(HIDE, True)
        await until(lambda: source.statistics().readers == 0, PATIENCE)
        await driver.rests()
        await see(page, ".state", "paused")
        await page.evaluate(HIDE, False)
        await driver.streams()
        driver.give(stamped(2))
        await see(page, "[data-count=number]", "2")


async def test_server_that_goes_is_said_and_comes_back(page: Page) -> None:
    driver, source = scripted(stall=None)
    async with source:
        async with FramesSite([source], port=free_port()) as site:
            await page.goto(site.url)
            await see(page, LIVE)
            port = site.port
        await see(page, "#alarm", "server does not answer")
        await see(page, "#live[data-state=lost]", "no server")
        async with FramesSite([source], port=port):
            await see(page, LIVE)
            await driver.streams()
            driver.give(stamped(5))
            await see(page, "[data-count=number]", "5")
            await page.goto("about:blank")


async def test_token_is_asked_for_and_opens_the_sockets(page: Page) -> None:
    driver, source = scripted(stall=None)
    async with source, FramesSite([source], token=TOKEN) as site:
        await page.goto(site.origin)
        await pass_gate(page)
        await see(page, LIVE)
        await driver.streams()
        driver.give(stamped(3))
        await see(page, "[data-count=number]", "3")
        await page.goto("about:blank")
        async with opened(page, [source], token=TOKEN):
            await driver.streams()
            assert TOKEN not in page.url


SIZES = ["640x480", "320x240", "1280x320", "320x960"]
NAMES = ["left", "a-name-without-any-place-to-break-it-" * 2, "wide", "deep"]

DRAWN = """
() => [...document.querySelectorAll("canvas")].filter((c) => c.checkVisibility()).map((c) => {
  const box = c.getBoundingClientRect();
  const scale = Math.min(box.width / c.width, box.height / c.height);
  const contained = getComputedStyle(c).objectFit === "contain";
  const [width, height] = contained ? [c.width * scale, c.height * scale] : [box.width, box.height];
  const [left, top] = [box.x + (box.width - width) / 2, box.y + (box.height - height) / 2];
  return { natural: c.width / c.height, width, height, left, top };
})
"""
"""Places of pictures on the screen, without the empty space beside them."""


@contextlib.asynccontextmanager
async def four(
    page: Page, width: int, height: int, sizes: Sequence[str] = ("640x480",) * 4
) -> AsyncIterator[FramesSite]:
    """Show a source for each size on a screen; all of them are seen."""
    await page.set_viewport_size({"width": width, "height": height})
    async with contextlib.AsyncExitStack() as stack:
        sources = [
            await stack.enter_async_context(
                smartcam.frames.open(f"synthetic://?fps=10&name={name}&size={size}")
            )
            for name, size in zip(NAMES, sizes, strict=False)
        ]
        site = await stack.enter_async_context(opened(page, sources))
        for place in range(len(sources)):
            await see(page, f"[data-place='{place}'] canvas")
        yield site
    await page.set_viewport_size({"width": 1280, "height": 800})


@pytest.mark.parametrize(("width", "height"), [(390, 844), (844, 390), (1280, 800)])
@pytest.mark.parametrize("count", [1, 4])
async def test_nothing_is_cut(page: Page, width: int, height: int, count: int) -> None:
    async with four(page, width, height, SIZES[:count]):
        assert await page.evaluate("document.documentElement.scrollWidth") == width
        wide = await page.evaluate(
            "[...document.querySelectorAll('.panel, .view, canvas, dl, h2')]"
            ".filter((e) => e.getBoundingClientRect().right > innerWidth || (e.scrollWidth >"
            " e.clientWidth + 1 && getComputedStyle(e).textOverflow !== 'ellipsis'))"
            ".map((e) => e.outerHTML.slice(0, 80))"
        )
        assert wide == []
        for one in await page.evaluate(DRAWN):
            assert one["width"] / one["height"] == pytest.approx(one["natural"], rel=0.02)


@pytest.mark.parametrize(
    ("width", "height", "least"), [(390, 844, 200), (844, 390, 180), (360, 640, 130)]
)
async def test_phone_has_four_pictures_at_once_that_stay_live(
    page: Page, width: int, height: int, least: int
) -> None:
    async with four(page, width, height) as site:
        assert await page.evaluate("document.documentElement.scrollHeight") <= height
        shown = await page.evaluate(DRAWN)
        assert len(shown) == 4
        for one in shown:
            assert one["width"] >= least
            assert one["left"] >= 0
            assert one["top"] >= 0
            assert one["left"] + one["width"] <= width
            assert one["top"] + one["height"] <= height
        for place in range(4):
            await see(page, f"[data-place='{place}'][data-state=live]")
            await see(page, f"[data-place='{place}'] [data-count=age]", "ms")
        before = [source.statistics().frames for source in site.sources]
        numbers = [int(await one.inner_text()) for one in await numbers_of(page)]
        await until(
            lambda: all(
                source.statistics().frames >= number + 5
                for source, number in zip(site.sources, before, strict=True)
            ),
            PATIENCE,
        )
        for place, number in enumerate(numbers):
            await page.wait_for_function(
                "([place, number]) => Number(document.querySelector("
                "`[data-place='${place}'] [data-count=number]`).textContent) > number",
                arg=[place, number],
            )


async def numbers_of(page: Page) -> list[Locator]:
    """Return the place of the frames' numbers, which a phone does not show."""
    return await page.locator("[data-count=number]").all()


@pytest.mark.parametrize(("width", "height"), [(390, 844), (844, 390), (1280, 800)])
async def test_tap_enlarges_one_and_the_others_stop(page: Page, width: int, height: int) -> None:
    async with four(page, width, height) as site:
        (small, *_) = await page.evaluate(DRAWN)
        await page.click("[data-place='2'] .view")
        await until(lambda: [one.index for one in site.viewers] == [2], PATIENCE)
        await until(
            lambda: [s.statistics().readers for s in site.sources] == [0, 0, 1, 0], PATIENCE
        )
        await until(lambda: not site.sources[0].statistics().streaming, PATIENCE)
        (large,) = await page.evaluate(DRAWN)
        assert large["width"] > 1.4 * small["width"]
        assert large["top"] + large["height"] <= height
        assert await page.get_attribute("[data-place='2'] .view", "aria-pressed") == "true"
        await see(page, "[data-place='2'][data-state=live]")
        await page.click("[data-place='2'] .view")
        await until(lambda: len(site.viewers) == 4, PATIENCE)
        await page.click("[data-place='1'] .view")
        await until(lambda: [one.index for one in site.viewers] == [1], PATIENCE)
        await page.keyboard.press("Escape")
        await until(lambda: len(site.viewers) == 4, PATIENCE)
        for place in range(4):
            await see(page, f"[data-place='{place}'][data-state=live]")


async def test_picture_that_is_scrolled_away_stops(page: Page) -> None:
    async with four(page, 1280, 800) as site:
        await page.evaluate("document.querySelector('main').style.paddingTop = '3000px'")
        await until(lambda: not site.viewers, PATIENCE)
        await see(page, ".state", "paused")
        await page.evaluate("document.querySelector('.source').scrollIntoView()")
        await until(lambda: bool(site.viewers), PATIENCE)
        await see(page, "[data-place='0'][data-state=live]")


@pytest.mark.parametrize("changes", [True, False])
async def test_features_are_listed_and_set_where_the_page_may(page: Page, changes: bool) -> None:
    async with (
        camera() as there,
        smartcam.frames.open(
            f"gige://127.0.0.1:{there.port}?packet_size=576&trigger=software", linger=10
        ) as source,
        opened(page, [source], changes=changes),
    ):
        await page.click("details.device summary")
        await page.fill("details.device input[type=search]", "black")
        await see(page, "[data-name=blacklevel] small", "0 to 25.5 DN")
        assert not await page.is_visible("[data-name=width]")
        assert await page.is_visible("details.device > button") == changes
        if not changes:
            assert await page.inner_text("[data-name=blacklevel] output") == "0 DN"
            return
        field = "[data-name=blacklevel] input"
        await page.fill(field, "1.23")
        await page.press(field, "Enter")
        await until(lambda: there.words[cameras.BLACK] == 12)
        await page.fill("details.device input[type=search]", "triggersource")
        await page.select_option("[data-name=triggersource] select", "Line1")
        await until(lambda: there.words[cameras.TRIGGERS + 4] == 1)
        await page.select_option("[data-name=triggersource] select", "Software")
        await until(lambda: there.words[cameras.TRIGGERS + 4] == 0)
        await page.click("details.device > button")
        await see(page, "[data-count=number]", "1")
