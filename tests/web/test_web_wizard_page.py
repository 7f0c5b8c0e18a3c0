"""The wizard's page in a real browser."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest
import pytest_asyncio
from browser import BROWSER_MARKS, new_page, nothing_wrong
from sitekit import TOKEN
from test_web_wizard import MARKS, World, run_through, served

from smartcam.exceptions import NotRunningError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from playwright.async_api import Page

pytestmark = BROWSER_MARKS

TOUCHES = [
    (x + shift, y - shift, 0.0) for (x, y), shift in zip(MARKS, (0, 3e-4, 0, 0), strict=True)
]


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def page() -> AsyncIterator[Page]:
    """The one page of all tests; each opens a site of its own in it."""
    async with new_page() as page:
        yield page


class View(NamedTuple):
    """The page of a world."""

    page: Page
    world: World

    async def see(self, selector: str, text: str = "") -> None:
        await self.page.locator(selector).filter(has_text=text).first.wait_for()

    async def answer(self, title: str, **answers: Any) -> None:
        """Answer the step of that title."""
        await self.see("#title", title)
        for name, value in answers.items():
            field = self.page.locator(f"#form [name={name}]")
            if await field.first.get_attribute("type") == "radio":
                await self.page.locator(f"#form [name={name}][value='{value}']").check()
            else:
                await field.fill(str(value))
        await self.page.click("#go")

    async def how_many(self, selector: str) -> int:
        return await self.page.locator(selector).count()


@contextlib.asynccontextmanager
async def opened(page: Page, folder: Path, token: str | None = None) -> AsyncIterator[View]:
    """Show the page; what the browser finds wrong with it fails the test."""
    with nothing_wrong(page):
        async with served(folder, token) as world:
            await page.goto(world.site.url)
            yield View(page, world)
            await page.goto("about:blank")


async def begin(view: View) -> None:
    """Start, and go on to the touches."""
    await view.page.fill("#name", "table")
    await view.page.click("#start-form button")
    await view.answer("Camera, robot and tool", unit="m", side="+z", touch_sigma="0,2")
    await view.answer("Marks in the camera's field")
    await view.answer("Which ones will be touched?")


async def test_page_drives_the_wizard_to_a_calibration(page: Page, tmp_path: Path) -> None:
    async with opened(page, tmp_path) as view:
        await begin(view)
        for number, (x, y, z) in enumerate(TOUCHES, 1):
            await view.see("#title", f"Touch mark {number} of 4")
            assert await view.how_many("#plot .next") == 1
            assert await view.how_many("#plot .seen") == 4
            assert await view.how_many("#plot .touched") == number - 1
            assert [await page.input_value(f"#input-{axis}") for axis in "xyz"] == ["", "", ""]
            await view.answer("Touch mark", x=y, y=x, z=z)
        await view.see("#title", "What came out")
        assert await view.how_many("#plot .touched") == 4
        assert await view.how_many("#plot .residual") == 4
        assert await view.how_many("#plot .ellipse") == 4
        assert await view.how_many("#plot .worst") == 1
        assert await view.how_many("#plot .axis-robot") == 2
        _, step = await view.world.call("GET", "/step")
        assert await view.how_many("#plot .heat rect") == sum(map(len, step["preview"]["heat"]))
        await view.see("#legend", "predicted error, 0.")
        await view.answer("What came out", next="accept")
        await view.answer("Save table")
        await view.see("#title", "Done")
        await view.see("#result", "table.json")
        await view.page.click("#again")
        await view.see("#names li", "table")


async def test_page_shows_what_is_left_out_as_crosses(page: Page, tmp_path: Path) -> None:
    async with opened(page, tmp_path) as view:
        await begin(view)
        for x, y, z in TOUCHES:
            await view.answer("Touch mark", x=y, y=x, z=z)
        await view.answer("What came out", next="more")
        await view.answer("Marks in the camera's field")
        await view.answer("Which ones will be touched?")
        for number, (x, y) in enumerate(MARKS):
            await view.answer("Touch mark", x=y + 0.02 * (number == 1), y=x, z=0.0)
        await view.answer("What came out", next="robust")
        await view.see("#legend", "Crosses: left out.")
        assert await view.how_many("#plot .left-out") == 2
        assert await view.how_many("#plot .touched") == 7
        assert await view.how_many("#plot .residual") == 7


async def test_page_checks_a_calibration(page: Page, tmp_path: Path) -> None:
    async with opened(page, tmp_path) as view:
        step = await view.world.post("/start", name="table")
        await run_through(view.world, step)
        await page.reload()
        await page.click("#again")
        await page.fill("#name", "table")
        await page.check("#wizards [value=drift]")
        await page.click("#start-form button")
        await view.answer("Is table still true?", unit="m")
        await view.answer("Marks in the camera's field")
        await view.answer("Which ones will be touched?")
        for x, y in MARKS:
            await view.answer("Touch mark", x=y, y=x, z=0.0005)
        await view.see("#title", "table still holds")
        assert await view.how_many("#plot .touched") == 4
        assert await view.how_many("#plot .heat") == 1
        await view.answer("table still holds")
        await view.see("#result", "table.checks.jsonl")


async def test_page_shows_errors_at_their_inputs_and_keeps_what_was_typed(
    page: Page, tmp_path: Path
) -> None:
    async with opened(page, tmp_path) as view:
        await begin(view)
        await view.answer("Touch mark 1 of 4", x="1.5", y="much")
        await view.see("#error-y", "'much': expected a number")
        await view.see("#error-z", "no answer")
        assert await page.input_value("#input-x") == "1.5"
        view.world.broken.append(NotRunningError("the camera is stopped"))
        await page.click("#undo")
        await page.click("#undo")
        await view.answer("Marks in the camera's field")
        await view.see("#base", "the camera is stopped")


async def test_page_loaded_again_shows_the_same_step(page: Page, tmp_path: Path) -> None:
    async with opened(page, tmp_path) as view:
        await begin(view)
        await page.reload()
        await view.see("#title", "Touch mark 1 of 4")
        await page.click("#abort")
        await view.see("#title", "Aborted")


async def test_page_of_a_step_that_somebody_else_answered_shows_the_new_one(
    page: Page, tmp_path: Path
) -> None:
    async with opened(page, tmp_path) as view:
        await begin(view)
        _, step = await view.world.call("GET", "/step")
        await view.world.post("/step", token=step["token"], answers={"x": 0, "y": 0, "z": 0})
        await view.answer("Touch mark 1 of 4", x=1, y=1, z=1)
        await view.see("#title", "Touch mark 2 of 4")
        await view.see("#base", "the step has changed meanwhile")


async def test_page_with_a_token_asks_for_it(page: Page, tmp_path: Path) -> None:
    async with opened(page, tmp_path, TOKEN) as view:
        await view.see("#start h2", "Calibrations")
        await page.evaluate("sessionStorage.clear()")
        await page.reload()
        await page.fill("#token", TOKEN)
        await page.click("#gate button")
        await view.see("#start h2", "Calibrations")
        await page.evaluate("sessionStorage.clear()")


@pytest.mark.parametrize("width", [360, 1200])
async def test_page_fits_its_width(page: Page, tmp_path: Path, width: int) -> None:
    async with opened(page, tmp_path) as view:
        await page.set_viewport_size({"width": width, "height": 900})
        await begin(view)
        await view.see("#title", "Touch mark 1 of 4")
        assert await page.evaluate("document.documentElement.scrollWidth") <= width
        await page.set_viewport_size({"width": 1200, "height": 900})
