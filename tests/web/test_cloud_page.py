"""The page of a cloud in a real browser, which draws by software."""

from __future__ import annotations

import contextlib
import io
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import pytest_asyncio

from smartcam.depth import Cloud
from smartcam.web import CloudSite
from tests.handmade import until
from tests.processes import free_port
from tests.web.browser import BROWSER_MARKS, PATIENCE, new_page, nothing_wrong
from tests.web.inside import _clouds as clouds_module
from tests.web.sitekit import TOKEN

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from numpy.typing import NDArray
    from playwright.async_api import Page

    from smartcam.web._inside import UpAxis

imagecodecs: Any = pytest.importorskip("imagecodecs", reason="needs the extra frames")

pytestmark = BROWSER_MARKS

RED, GREEN, BLUE = (220, 30, 30), (60, 160, 60), (20, 60, 200)
LIVE = "#live[data-state=live]"
DRAWN = "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def page() -> AsyncIterator[Page]:
    """The one page of all tests; each opens a site of its own in it."""
    async with new_page(800, 700) as page:
        yield page


def patch(place: list[float], size: float, colour: tuple[int, int, int]) -> Cloud:
    """Return a square across z, about a place, without gaps."""
    steps = np.linspace(-size / 2, size / 2, 160)
    flat = np.stack([*np.meshgrid(steps, steps), np.zeros((160, 160))], axis=-1).reshape(-1, 3)
    return Cloud(flat + place, np.full((len(flat), 3), colour, np.uint8))


SCENE = Cloud.joined(
    [
        patch([0, 0, 1], 0.4, GREEN),  # a wall
        patch([0.1, 0, 0.98], 0.06, RED),  # before it and to the right, seen from the origin
        patch([0, -0.1, 0.98], 0.06, BLUE),  # above, for a camera
    ]
)


@contextlib.asynccontextmanager
async def opened(
    page: Page, cloud: Cloud | None, *, up: UpAxis = "-y", **options: Any
) -> AsyncIterator[CloudSite]:
    """Show a cloud; what the browser finds wrong with the page fails the test."""
    with nothing_wrong(page):
        async with CloudSite(cloud, up=up, **options) as site:
            await page.goto(site.url)
            await page.locator(LIVE).wait_for()
            if cloud is not None:
                await page.locator("#empty").wait_for(state="hidden")
            yield site
            await page.goto("about:blank")


async def picture(page: Page) -> NDArray[np.uint8]:
    """Return the picture on the canvas, (H, W, 3)."""
    await page.evaluate(DRAWN)
    shot = await page.locator("#canvas").screenshot()
    pixels: NDArray[np.uint8] = imagecodecs.png_decode(io.BytesIO(shot).getvalue())[..., :3]
    return pixels


def where(pixels: NDArray[np.uint8], colour: tuple[int, int, int]) -> tuple[float, float, int]:
    """Return the middle (x, y) and the number of pixels of a colour."""
    rows, columns = np.nonzero((np.abs(pixels.astype(int) - colour) <= 2).all(axis=2))
    assert len(rows), f"nothing of {colour}"
    return float(columns.mean()), float(rows.mean()), len(rows)


async def test_colours_and_places_are_those_of_the_cloud(page: Page) -> None:
    async with opened(page, SCENE):
        pixels = await picture(page)
        wall, red, blue = (where(pixels, colour) for colour in (GREEN, RED, BLUE))
        assert red[0] > wall[0] + 20  # x is to the right, not mirrored
        assert blue[1] < wall[1] - 20  # -y is up
        assert wall[2] > 10 * red[2]
        assert await page.inner_text("#points") == f"{len(SCENE):,}"
        assert await page.inner_text("#extent") == "0.4 x 0.4 x 0.02 m"
        assert await page.inner_text("#thinned") == ""
        # the bar's length on the screen is so many metres at the distance of the wall's middle
        bar = await page.inner_text("#scale span")
        box = await page.locator("#scale").bounding_box()
        assert box is not None
        across = np.ptp(np.nonzero((np.abs(pixels.astype(int) - GREEN) <= 2).all(axis=2))[1])
        seen = across * float(bar.removesuffix(" m")) / box["width"]
        assert seen == pytest.approx(0.4 * np.cos(0.35), rel=0.12)


@pytest.mark.widest
async def test_dragging_turns_and_reset_turns_back(page: Page) -> None:
    async with opened(page, SCENE):
        before = await picture(page)
        box = await page.locator("#canvas").bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        await page.mouse.move(x, y)
        await page.mouse.down()
        await page.mouse.move(x - 44, y - 36, steps=4)  # 0.35 radians: it is seen from the front
        await page.mouse.up()
        turned = await picture(page)
        assert not np.array_equal(before, turned)
        assert where(turned, GREEN)[2] > 1.05 * where(before, GREEN)[2]
        await page.keyboard.down("Shift")
        await page.mouse.down()
        await page.mouse.move(x + 56, y - 36, steps=4)
        await page.mouse.up()
        await page.keyboard.up("Shift")
        moved = await picture(page)
        assert where(moved, GREEN)[0] == pytest.approx(where(turned, GREEN)[0] + 100, abs=5)
        await page.click("#reset")
        assert np.array_equal(before, await picture(page))
        await page.focus("#canvas")
        await page.keyboard.press("ArrowLeft")
        assert not np.array_equal(before, await picture(page))


@pytest.mark.widest
async def test_wheel_zooms(page: Page) -> None:
    async with opened(page, SCENE):
        before = where(await picture(page), RED)[2]
        await page.hover("#canvas")
        await page.mouse.wheel(0, -200)
        await until_grown(page, before)


async def until_grown(page: Page, before: int) -> None:
    for _ in range(100):
        if where(await picture(page), RED)[2] > 1.3 * before:
            return
    pytest.fail("it did not grow")


@pytest.mark.widest
async def test_two_fingers_zoom_and_one_turns(page: Page) -> None:
    async with opened(page, SCENE):
        before = await picture(page)
        touch = await page.context.new_cdp_session(page)

        async def fingers(kind: str, *places: tuple[float, float]) -> None:
            points = [{"x": x, "y": y, "id": id} for id, (x, y) in enumerate(places)]
            await touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

        await fingers("touchStart", (350, 400))
        await fingers("touchStart", (350, 400), (450, 400))
        await fingers("touchMove", (325, 400), (475, 400))
        await fingers("touchMove", (300, 400), (500, 400))
        await fingers("touchEnd")
        after = await picture(page)
        assert where(after, RED)[2] > 2 * where(before, RED)[2]
        await page.click("#reset")
        await fingers("touchStart", (350, 400))
        await fingers("touchMove", (400, 400))
        await fingers("touchEnd")
        assert not np.array_equal(before, await picture(page))
        await touch.detach()


@pytest.mark.widest
async def test_colour_by_height_point_size_and_axes(page: Page) -> None:
    async with opened(page, Cloud(SCENE.points), up="-z") as site:
        assert await page.input_value("#colour") == "height"  # it has no picture
        await page.locator("#legend").wait_for()
        low, high = await page.inner_text("#low"), await page.inner_text("#high")
        assert (low, high) == ("-1 m", "-0.98 m")
        pixels = await picture(page)
        assert where(pixels, (59, 77, 191))[2] > 10 * where(pixels, (191, 38, 38))[2]
        site.show(SCENE)
        await page.locator("#number").filter(has_text="2").wait_for()
        await page.select_option("#colour", "picture")
        fine = where(await picture(page), RED)[2]
        await page.locator("#size").fill("12")
        assert where(await picture(page), RED)[2] > 1.1 * fine
        at_origin = Cloud(SCENE.points - np.array([0, 0, 1]), SCENE.colours)
        site.show(at_origin)
        await page.locator("#number").filter(has_text="3").wait_for()
        await page.click("#reset")
        await page.select_option("#up", "z")
        await page.evaluate(DRAWN)
        names = page.locator(".axis:not([hidden])")
        assert await names.all_inner_texts() == ["x", "y", "z"]
        await page.uncheck("#axes")
        await page.evaluate(DRAWN)
        assert await names.count() == 0


def refuse(*_args: object) -> Any:
    raise MemoryError("too much")


@pytest.mark.widest
async def test_newer_cloud_takes_the_place(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    async with opened(page, None) as site:
        assert await page.inner_text("#empty") == "No cloud yet."
        site.show(SCENE)
        await page.locator("#empty").wait_for(state="hidden")
        where(await picture(page), RED)
        site.show(patch([0, 0, 1], 0.4, (1, 200, 250)))
        await page.locator("#number").filter(has_text="2").wait_for()
        pixels = await picture(page)
        where(pixels, (1, 200, 250))
        with pytest.raises(AssertionError, match="nothing of"):
            where(pixels, GREEN)
        monkeypatch.setattr(clouds_module, "MAX_CLOUD_POINTS", 1000)
        site.show(SCENE)
        await page.locator("#thinned").filter(has_text="Thinned for this page").wait_for()
        assert await page.inner_text("#points") == f"{len(SCENE):,}"
        assert await page.locator("#alarm").is_hidden()
        with monkeypatch.context() as patched:
            patched.setattr(clouds_module, "thin_cloud", refuse)
            site.show(SCENE)
            await page.locator("#alarm").filter(has_text="cannot be shown: too much").wait_for()
        site.show(Cloud(np.empty((0, 3))))
        await page.locator("#alarm").wait_for(state="hidden")
        await page.locator("#points").filter(has_text="0").wait_for()
        await until(lambda: len(site.viewers) == 1, PATIENCE)


async def test_server_that_goes_is_said_and_comes_back(page: Page) -> None:
    with nothing_wrong(page):
        async with CloudSite(SCENE, token=TOKEN, port=free_port()) as site:
            await page.goto(site.origin)
            await page.fill("#token", TOKEN)
            await page.click("#gate button")
            await page.locator(LIVE).wait_for()
            assert TOKEN not in page.url
            port = site.port
        await page.locator("#alarm").filter(has_text="does not answer").wait_for()
        async with CloudSite(SCENE, token=TOKEN, port=port):
            await page.locator(LIVE).wait_for()
            await page.goto("about:blank")


@pytest.mark.widest
async def test_lost_context_comes_back(page: Page) -> None:
    async with opened(page, SCENE):
        before = await picture(page)
        await page.evaluate(
            "() => { const canvas = document.querySelector('canvas');"
            " const lose = canvas.getContext('webgl2').getExtension('WEBGL_lose_context');"
            " const is = (what) => new Promise((done) => canvas.addEventListener("
            "`webglcontext${what}`, () => setTimeout(done), { once: true }));"
            " const [lost, restored] = [is('lost'), is('restored')]; lose.loseContext();"
            " return lost.then(() => lose.restoreContext()).then(() => restored); }"
        )
        assert np.array_equal(before, await picture(page))


@pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 800)])
async def test_nothing_is_cut(page: Page, width: int, height: int) -> None:
    await page.set_viewport_size({"width": width, "height": height})
    async with opened(page, SCENE):
        assert await page.evaluate("document.documentElement.scrollWidth") == width
        assert await page.evaluate("document.documentElement.scrollHeight") <= height
        pixels = await picture(page)
        rows, columns = np.nonzero((np.abs(pixels.astype(int) - GREEN) <= 2).all(axis=2))
        assert 5 < columns.min() < columns.max() < pixels.shape[1] - 5
        assert 5 < rows.min() < rows.max() < pixels.shape[0] - 5
