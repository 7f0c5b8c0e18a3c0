"""The live page in a real browser, with emulated cameras at the wire."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import pytest_asyncio

import smartcam
import smartcam.fleet
from smartcam.emulator import Application, EmulatedCamera, EmulatedInSight
from smartcam.fleet import FleetFile
from smartcam.web import LiveSite
from tests.handmade import until
from tests.processes import free_port
from tests.web.browser import BROWSER_MARKS, PATIENCE, new_page, nothing_wrong, see
from tests.web.sitekit import TOKEN

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from playwright.async_api import Page

pytestmark = BROWSER_MARKS

LIVE = "#live[data-state=live]"
FAST = smartcam.Backoff(initial=0.05, maximum=0.2)
CHECK = "ok: bool, defect: bool, here: bool"
CHECKED = Application(
    id=5,
    layout=CHECK,
    constant={"ok": True, "defect": True, "here": True},
    load_time=0,
    processing_time=0,
)
PARTS: dict[str, Any] = {"application": 7, "interpret_as": "localizations"}


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def page() -> AsyncIterator[Page]:
    """The one page of all tests; each opens a site of its own in it."""
    async with new_page(1280, 800) as page:
        yield page


@contextlib.asynccontextmanager
async def opened(
    page: Page,
    url: str,
    *,
    control: bool = True,
    token: str | None = None,
    port: int = 0,
    **options: Any,
) -> AsyncIterator[LiveSite]:
    """Show a camera; what the browser finds wrong with the page fails the test."""
    camera = smartcam.connect(url, **{"reconnect": FAST, "name": "cell", **options})
    with nothing_wrong(page):
        async with LiveSite(camera, control=control, token=token, port=port) as site, camera:
            await page.goto(site.url)
            await see(page, LIVE)
            yield site
        await page.goto("about:blank")


async def counts(page: Page) -> dict[str, int]:
    """Return the account as the page shows it."""
    rows = await page.locator("#counts [data-count]").all()
    return {str(await one.get_attribute("data-count")): int(await one.inner_text()) for one in rows}


async def test_triggered_part_is_drawn_and_the_account_adds_up(page: Page) -> None:
    async with EmulatedCamera() as emulator, opened(page, emulator.url, **PARTS) as site:
        await page.click("#trigger")
        await see(page, "#last", "square")
        (entry,) = site.view.entries
        assert entry.result is not None
        square = next(one for one in entry.result.value if one.feature_id == "square")
        drawn = page.locator(".found[data-part=square]")
        where = f"x {square.pose.position.x * 1000:.1f} mm, y {square.pose.position.y * 1000:.1f}"
        assert where in str(await drawn.locator("title").text_content())
        assert await page.locator(".found").count() == len(entry.result.value)
        assert "frame of cell" in await page.inner_text("#frame")
        await _check_scale(page, square, next(iter(entry.result.value)))
        await see(page, "[data-count=triggered]", "1")
        told = await counts(page)
        assert told["received"] == told["triggered"] == 1
        assert await page.inner_text("#sum") == "adds up"
        await see(page, "#rows tr", f"{len(entry.result.value)} parts: ")
        assert "ago" in await page.inner_text("#age")


async def _check_scale(
    page: Page, one: smartcam.Localization, other: smartcam.Localization
) -> None:
    """See that parts are as far from one another as the scale's line says."""
    centres = [
        await page.eval_on_selector(
            f".found[data-part='{part.feature_id}'] circle",
            "c => { const m = c.getScreenCTM(); return [m.e, m.f]; }",
        )
        for part in (one, other)
    ]
    bar = await page.eval_on_selector("#parts .bar", "b => b.getBoundingClientRect().width")
    length = float(str(await page.get_attribute("#parts [data-scale]", "data-scale")))
    pixels = bar / length * 1000
    a, b = one.pose.position, other.pose.position
    moved = [centres[0][0] - centres[1][0], centres[1][1] - centres[0][1]]
    assert moved == pytest.approx([(a.x - b.x) * pixels, (a.y - b.y) * pixels], abs=3)


async def test_pass_and_fail_are_reported_in_words(page: Page) -> None:
    async with (
        EmulatedCamera([CHECKED], running=True) as emulator,
        opened(page, emulator.url, interpret_as=CHECK),
    ):
        await page.click("#trigger")
        await see(page, "[data-name=ok][data-verdict=pass]", "PASS")
        await see(page, "[data-name=defect][data-verdict=fail]", "FAIL")
        await see(page, "[data-name=here][data-verdict='']", "true")
        await see(page, "#rows b[data-verdict=fail]", "FAIL")
        await see(page, "#failed-since", "fails since ")
        await see(page, "#failures td", "defect is true")
        colours = [
            await page.eval_on_selector(
                f"#verdicts [data-name={name}]", "e => getComputedStyle(e).color"
            )
            for name in ("ok", "defect", "here")
        ]
        assert len(set(colours)) == 3


async def test_failure_shows_the_picture_that_the_camera_had_then(page: Page) -> None:
    job = {"file": "1check.job", "cells": {"A2": 0}}
    async with (
        EmulatedInSight(jobs=[job]) as emulator,
        opened(page, f"{emulator.url}?cells=A2", interpret_as="ok: bool") as site,
    ):
        await site.view.camera.start()
        await page.click("#trigger")
        await page.click("#failures button")
        await see(page, "#failure-caption", "ok is false, expected true")
        await page.wait_for_function("document.querySelector('#failure').naturalWidth > 0")


async def test_lost_camera_and_lost_server_are_reported(page: Page) -> None:
    async with (
        EmulatedCamera(active=21, running=True, port=free_port()) as emulator,
        opened(page, emulator.url, port=free_port()) as site,
    ):
        await page.click("#trigger")
        await see(page, "#last code")
        await emulator.stop()
        await see(page, "#alarm", "The camera is lost since")
        await see(page, "#age", "not fresh")
        assert await page.is_disabled("#trigger")
        async with EmulatedCamera(active=21, running=True, port=emulator.port):
            await page.locator("#alarm").wait_for(state="hidden")
            await see(page, "[data-count=reconnects]", "1")
            await page.click("#trigger")
            await see(page, "[data-count=triggered]", "2")
            await site.stop()
            await see(page, "#alarm", "server does not answer")
            await see(page, "#live[data-state=lost]", "no server")
            await site.start()
            await see(page, LIVE)


async def test_camera_that_is_taken_is_reported(page: Page) -> None:
    async with (
        EmulatedCamera() as emulator,
        opened(page, emulator.url),
        smartcam.connect(emulator.url, reconnect=FAST),
    ):
        await see(page, "#alarm", "Another client has the camera since")


async def test_looking_only_has_no_buttons_and_commands_switch(page: Page) -> None:
    async with EmulatedCamera(active=21, running=True) as emulator:
        async with opened(page, emulator.url, control=False):
            await see(page, "#looking", "Looking only")
            assert await page.is_hidden("#trigger")
        async with opened(page, emulator.url):
            await page.fill("#application", "7")
            await page.click("#switch button")
            await see(page, "#told", "Loaded.")
            await see(page, "#facts", "7")
            await page.click("#stop")
            await see(page, "li[data-bit=RUNNING][data-on=false]")
            await page.click("#trigger")
            await see(page, "#told", "NotRunningError")
            await page.click("#start")
            await see(page, "li[data-bit=RUNNING][data-on=true]")


async def test_picture_of_an_insight_is_shown_with_a_token(page: Page) -> None:
    async with (
        EmulatedInSight(online=True) as emulator,
        opened(page, emulator.url, token=TOKEN) as site,
    ):
        picture = page.locator("#image")
        await picture.wait_for()
        assert str(await picture.get_attribute("src")).startswith("data:image/bmp")
        assert await picture.evaluate("i => i.decode().then(() => i.naturalWidth)") > 1
        before = await picture.get_attribute("src")
        emulator.set_image(np.zeros((8, 16), np.uint8))
        await page.click("#fetch")
        await page.locator(f"#image:not([src='{before}'])").wait_for()
        assert site.view.picture is not None
        assert site.view.picture.serial == 2
        assert await picture.evaluate("i => i.decode().then(() => i.naturalWidth)") == 16
        assert TOKEN not in page.url


@contextlib.asynccontextmanager
async def fleet_shown(
    page: Page, frames: str | None = "synthetic://?fps=20&size=640x480"
) -> AsyncIterator[LiveSite]:
    """Show a camera of a fleet, which may have frames."""
    entry = {"emulated": {}, **PARTS, **({} if frames is None else {"frames": frames})}
    file = FleetFile.model_validate({"agent": "north", "cameras": {"cam": entry}})
    with nothing_wrong(page):
        async with smartcam.fleet.open(file) as fleet, LiveSite(fleet["cam"], control=True) as site:
            await page.goto(site.url)
            await see(page, LIVE)
            yield site
        await page.goto("about:blank")


async def looked_at(site: LiveSite, count: int) -> None:
    """Wait until so many look at the frames."""
    pictures = site.frames.pictures
    assert pictures is not None
    await until(lambda: len(pictures.viewers) == count, PATIENCE)


async def test_what_a_fleets_camera_sees_is_beside_its_results(page: Page) -> None:
    async with fleet_shown(page) as site:
        await page.click("#trigger")
        await see(page, ".found")
        await see(page, ".source[data-state=live]", "What the camera sees")
        number = "Number(document.querySelector('[data-count=number]').textContent)"
        async with asyncio.timeout(60):
            while await page.evaluate(number) <= 5:  # noqa: ASYNC110 - its own wait wants eval
                await asyncio.sleep(0.05)
        boxes = [await page.locator(one).bounding_box() for one in (".now", ".source")]
        assert None not in boxes
        assert boxes[0]["x"] == boxes[1]["x"]  # type: ignore[index]
        small = await page.locator("canvas").bounding_box()
        await page.click(".view")
        await see(page, ".source.large")
        large = await page.locator("canvas").bounding_box()
        assert small is not None
        assert large is not None
        assert large["height"] > 1.2 * small["height"]
        await page.keyboard.press("Escape")
        await page.locator(".source:not(.large)").wait_for()
        await looked_at(site, 1)
        await page.evaluate("document.querySelector('main').style.paddingTop = '3000px'")
        await looked_at(site, 0)


async def test_camera_without_frames_has_no_such_panel_and_asks_for_none(page: Page) -> None:
    asked: list[str] = []
    page.on("websocket", lambda socket: asked.append(socket.url))
    async with fleet_shown(page, None) as site:
        await page.click("#trigger")
        await see(page, ".found")
        assert await page.locator(".source").count() == 0
        assert site.frames.pictures is None
    assert asked == []


@pytest.mark.parametrize(("width", "height"), [(390, 844), (844, 390), (1280, 800)])
async def test_nothing_is_cut_of_frames(page: Page, width: int, height: int) -> None:
    await page.set_viewport_size({"width": width, "height": height})
    try:
        async with fleet_shown(page):
            await page.click("#trigger")
            await see(page, ".found")
            await page.locator(".source").scroll_into_view_if_needed()
            await see(page, ".source[data-state=live]")
            assert await page.evaluate("document.documentElement.scrollWidth") == width
            box = await page.locator("canvas").bounding_box()
            assert box is not None
            assert box["width"] / box["height"] == pytest.approx(640 / 480, rel=0.02)
            assert box["height"] <= height
            panels = await page.evaluate(
                "[...document.querySelectorAll('.panel')].filter((e) => e.checkVisibility())"
                ".map((e) => e.getBoundingClientRect()).map((b) => [b.x, b.y, b.right, b.bottom])"
            )
            for index, one in enumerate(panels):  # none is over another
                for other in panels[:index]:
                    apart = one[0] >= other[2] - 1 or other[0] >= one[2] - 1
                    assert apart or one[1] >= other[3] - 1 or other[1] >= one[3] - 1
    finally:
        await page.set_viewport_size({"width": 1280, "height": 800})


@pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 800)])
async def test_nothing_is_cut(page: Page, width: int, height: int) -> None:
    await page.set_viewport_size({"width": width, "height": height})
    try:
        async with EmulatedCamera() as emulator, opened(page, emulator.url, **PARTS):
            await page.click("#trigger")
            await see(page, ".found")
            for drawn in ("#last th", "#rate text", "#latency text", ".results th"):
                await see(page, drawn)
            assert await page.evaluate("document.documentElement.scrollWidth") == width
            wide = await page.evaluate(
                "[...document.querySelectorAll('.panel, .panel button, .last, dl, svg, .log-box')]"
                ".filter((e) => e.getBoundingClientRect().right > innerWidth"
                " || e.scrollWidth > e.clientWidth + 1).map((e) => e.outerHTML.slice(0, 80))"
            )
            assert wide == []
    finally:
        await page.set_viewport_size({"width": 1280, "height": 800})


async def test_values_have_units_and_a_switch_shows_practical_ones(page: Page) -> None:
    application = Application(
        id=5, layout="x: real32 mm, a: real32 deg", constant={"x": 0.0125, "a": 1.5707964}
    )
    async with (
        EmulatedCamera([application], running=True) as emulator,
        opened(page, emulator.url, interpret_as="x: real32 mm, a: real32 deg"),
    ):
        await page.click("#trigger")
        await see(page, "#last", "0.0125 m")
        await see(page, "#rows tr", "x 0.0125 m, a 1.5708 rad")
        await page.check("#practical")
        await see(page, "#last", "12.5 mm")
        await see(page, "#rows tr", "x 12.5 mm, a 90 deg")
