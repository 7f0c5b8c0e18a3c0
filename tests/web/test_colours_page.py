"""The page on which a colour is picked, in a real browser."""

from __future__ import annotations

import asyncio
import contextlib
import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import pytest_asyncio

from smartcam.depth import ColourRange
from smartcam.web import ColourSite
from tests.frames.drivers import GoneError, ScriptedDriver, scripted
from tests.handmade import until
from tests.web.browser import BROWSER_MARKS, HIDE, PATIENCE, new_page, nothing_wrong, pass_gate, see
from tests.web.sitekit import TOKEN
from tests.web.test_colours import SIZE, coloured, picture

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from playwright.async_api import Page

pytestmark = BROWSER_MARKS

LIVE = "#live[data-state=live]"


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def page() -> AsyncIterator[Page]:
    """The one page of all tests; each opens a site of its own in it."""
    async with new_page(1280, 800) as page:
        yield page


class Camera:
    """A device that gives one picture after the other, of a block of a colour."""

    def __init__(self, driver: ScriptedDriver) -> None:
        self.driver = driver
        self.colour = (20, 20, 22)
        self.number = 0
        self.gives = True
        self.ends = False

    async def run(self) -> None:
        while True:
            await asyncio.sleep(0.03)
            if self.driver.sink is None:
                continue
            if self.ends:  # again for who comes back, as a recording does
                self.driver.sink.ended(None)
            elif self.gives:
                self.number += 1
                self.driver.give(coloured(self.number, self.colour))


@contextlib.asynccontextmanager
async def shown(page: Page, **options: Any) -> AsyncIterator[tuple[Camera, ColourSite]]:
    """Show a camera; what the browser finds wrong with the page fails the test."""
    driver, source = scripted(stall=None, linger=1.0)
    camera = Camera(driver)
    with nothing_wrong(page):
        async with source, ColourSite(source, **options) as site:
            giving = asyncio.create_task(camera.run())
            await page.goto(site.url)
            yield camera, site
            await page.goto("about:blank")
            giving.cancel()


async def slide(page: Page, which: str, value: int) -> None:
    await page.eval_on_selector(
        f"#{which}",
        "(e, value) => { e.value = value; e.dispatchEvent(new Event('input')); }",
        str(value),
    )


async def said(page: Page) -> ColourRange:
    """Return the range that the page says, which is the same in both its forms."""
    told = ColourRange(**json.loads(await page.inner_text("#json")))
    assert await page.inner_text("#python") == repr(told)
    return told


async def white(page: Page) -> np.ndarray[Any, Any]:
    """Return the white pixels of the mask on the page, without frames of regions."""
    data = await page.eval_on_selector(
        "#mask", "c => Array.from(c.getContext('2d').getImageData(0, 0, c.width, c.height).data)"
    )
    pixels = np.array(data, np.uint8).reshape(SIZE[1], SIZE[0], 4)
    found: np.ndarray[Any, Any] = pixels[..., 2] > 200
    return found


async def click(page: Page, x: int, y: int) -> None:
    box = await page.locator("#picture").bounding_box()
    assert box is not None
    scale = box["width"] / SIZE[0]
    await page.mouse.click(box["x"] + (x + 0.5) * scale, box["y"] + (y + 0.5) * scale)


async def test_sliders_make_the_mask_and_the_range_to_copy(page: Page) -> None:
    async with shown(page):
        await see(page, LIVE)
        assert await said(page) == ColourRange()
        await see(page, "#part", "100.0 %")
        await slide(page, "value-to", 60)
        await see(page, "#part", "12.5 %")
        assert await said(page) == ColourRange(value=(0, 60))
        await see(page, "#regions li", "1200 pixels, 60 x 20, sides 3.00:1, 0.0")
        block = (picture() == (20, 20, 22)).all(axis=2)
        inner = block.copy()
        inner[:34] = inner[46:] = inner[:, :46] = inner[:, 94:] = False  # the frame is drawn over
        mask = await white(page)
        assert mask[inner].mean() > 0.9  # its number is drawn there, too
        assert not mask[~block].any()
        await slide(page, "value-from", 80)  # takes the other end along
        assert await said(page) == ColourRange(value=(80, 80))
        await slide(page, "hue-from", 170)
        await slide(page, "hue-to", 10)  # goes over red
        assert (await said(page)).hue == (170, 10)
        await page.click("#all")
        assert await said(page) == ColourRange()


async def test_click_in_the_picture_takes_the_colour_there(page: Page) -> None:
    async with shown(page) as (camera, _):
        camera.colour = (200, 30, 20)
        await see(page, LIVE)
        await click(page, 70, 40)
        await see(page, "#part", "12.5 %")
        taken = await said(page)
        assert taken.mask(picture((200, 30, 20))).sum() == 1200
        await click(page, 10, 10)
        await see(page, "#part", "87.5 %")


async def test_range_is_tried_on_the_picture_if_no_other_comes(page: Page) -> None:
    async with shown(page, colours=ColourRange(value=(0, 60))) as (camera, _):
        await see(page, LIVE)
        await see(page, "#part", "12.5 %")
        camera.gives = False
        await see(page, "#live", "not fresh")
        await see(page, "main.old")
        await slide(page, "value-to", 255)
        await see(page, "#part", "100.0 %")
        await click(page, 70, 40)
        await see(page, "#part", "12.5 %")
        camera.gives = True
        await see(page, LIVE)


async def test_source_that_ends_leaves_its_last_picture(page: Page) -> None:
    async with shown(page) as (camera, _):
        await see(page, LIVE)
        camera.ends = True
        await see(page, "#alarm", "scripted has ended")
        await see(page, "#live", "ended")
        await slide(page, "value-to", 60)
        await see(page, "#part", "12.5 %")


async def test_source_that_dies_is_said_and_comes_back(page: Page) -> None:
    async with shown(page) as (camera, _):
        await see(page, LIVE)
        camera.driver.fails["start"] = GoneError("scripted: it was unplugged <b>")
        assert camera.driver.sink is not None
        camera.driver.sink.ended(GoneError("scripted: it was unplugged <b>"))
        await see(page, "#alarm", "it was unplugged <b>")
        del camera.driver.fails["start"]
        await see(page, LIVE)
        assert not await page.is_visible("#alarm")


async def test_hidden_page_lets_the_device_rest(page: Page) -> None:
    async with shown(page) as (camera, site):
        await see(page, LIVE)
        await page.evaluate(HIDE, True)
        await until(lambda: camera.driver.sink is None, PATIENCE)
        assert site.source.statistics().readers == 0
        await page.evaluate(HIDE, False)
        await until(lambda: camera.driver.sink is not None, PATIENCE)
        await see(page, LIVE)


async def test_token_is_asked_for(page: Page) -> None:
    driver, source = scripted(stall=None, linger=1.0)
    camera = Camera(driver)
    async with source, ColourSite(source, token=TOKEN) as site:
        giving = asyncio.create_task(camera.run())
        await page.goto(site.origin)
        await pass_gate(page)
        await see(page, LIVE)
        await page.goto("about:blank")
        giving.cancel()


async def test_copying_says_what_became_of_it(page: Page) -> None:
    async with shown(page, colours=ColourRange(value=(0, 60))):
        await see(page, LIVE)
        await page.context.grant_permissions(["clipboard-read", "clipboard-write"])
        await page.click("[data-copy=python]")
        await see(page, "#copied", "Copied.")
        copied = await page.evaluate("navigator.clipboard.readText()")
        assert copied == repr(ColourRange(value=(0, 60)))


@pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 800)])
async def test_nothing_is_cut(page: Page, width: int, height: int) -> None:
    await page.set_viewport_size({"width": width, "height": height})
    async with shown(page, colours=ColourRange(value=(0, 60))):
        await see(page, "#regions li")
        assert await page.evaluate("document.documentElement.scrollWidth") == width
        wide = await page.evaluate(
            "[...document.querySelectorAll('.panel, .view, canvas, code, input, button, output')]"
            ".filter((e) => e.offsetParent && (e.getBoundingClientRect().right > innerWidth"
            " || e.scrollWidth > e.clientWidth + 2)).map((e) => e.outerHTML.slice(0, 80))"
        )
        assert wide == []
        shapes = await page.evaluate(
            "[...document.querySelectorAll('canvas')]"
            ".map((c) => [c.width / c.height, c.clientWidth / c.clientHeight])"
        )
        for natural, drawn in shapes:
            assert drawn == pytest.approx(natural, rel=0.02)
        low = await page.evaluate(
            "Math.min(...[...document.querySelectorAll('input[type=range]')]"
            ".map((e) => e.clientHeight))"
        )
        await page.locator("#value-to").scroll_into_view_if_needed()
        mask, slider = [await page.locator(one).bounding_box() for one in ("#mask", "#value-to")]
        assert mask is not None
        assert slider is not None
        seen = mask["y"] >= 0 and mask["y"] + mask["height"] <= slider["y"]
        assert seen or width > 760  # on a phone the mask stays while a slider is moved
        assert low >= (34 if width < 760 else 26)  # a finger finds them
    await page.set_viewport_size({"width": 1280, "height": 800})
