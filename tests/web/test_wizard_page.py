"""The wizard's page in a real browser."""

from __future__ import annotations

import asyncio
import contextlib
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytest
import pytest_asyncio

from smartcam._extras import load
from smartcam.calibration import (
    CameraModel,
    Checkerboard,
    Folder,
    SheetCalibration,
    Transform,
    target_to_data,
)
from smartcam.calibration._inside import PictureFolder
from smartcam.calibration.simulation import render
from smartcam.calibration.wizards import CalibrationService, hand_eye_wizard, sheet_wizard
from smartcam.exceptions import NotRunningError
from smartcam.web import WizardSite
from tests.processes import printed_by
from tests.web.browser import BROWSER_MARKS, new_page, nothing_wrong, see
from tests.web.sitekit import TOKEN
from tests.web.test_wizard import MARKS, World, run_through, served

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
        await see(self.page, selector, text)

    async def answer(self, title: str, **answers: Any) -> None:
        """Answer the step of that title."""
        await answer(self.page, title, **answers)

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


async def begin(view: View, *, chosen: bool = True) -> None:
    """Start, and go on to the touches; or only until marks are chosen."""
    await view.page.fill("#name", "table")
    await view.page.click("#start-form button")
    await view.answer("Camera, robot and tool", unit="m", side="+z", touch_sigma="0,2")
    await view.answer("Marks in the camera's field")
    if chosen:
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
        await view.see("#verdict.unknown", "touch 5 or more")
        await view.see("#result", str(tmp_path / "table.json"))
        await view.see("#result", "held-out error")
        assert await view.how_many("#plot .touched") == 4
        assert str(tmp_path) in await page.inner_text("#use-command")
        python = await page.inner_text("#use-python")
        assert (await asyncio.to_thread(printed_by, python)).startswith("[[")
        await page.locator("#use button").last.click()
        await view.see("#use button", "Copied")
        await page.click("#again")
        await view.see("#names td", "table")


async def test_page_says_what_is_wrong_in_words_and_chooses_what_mends_it(
    page: Page, tmp_path: Path
) -> None:
    async with opened(page, tmp_path) as view:
        await begin(view)
        for number, (x, y, z) in enumerate(TOUCHES):
            await view.answer("Touch mark", x=y, y=x + 0.003 * (number == 2), z=z)
        await view.see("#verdict.poor", "Not good enough: touch point 3 again")
        await view.see("#notes .warning b", "Warning")
        await view.see("#notes .warning code")
        assert await page.is_checked("#form [name=next][value=redo]")
        await view.answer("What came out")
        await view.answer("Touch point 3 again", x=TOUCHES[2][1], y=TOUCHES[2][0], z=0.0)
        await view.see("#verdict.unknown", "touch 5 or more")
        assert await page.is_checked("#form [name=next][value=more]")


async def test_page_s_marks_are_chosen_by_a_click(page: Page, tmp_path: Path) -> None:
    async with opened(page, tmp_path) as view:
        await begin(view, chosen=False)
        await view.see("#title", "Which ones will be touched?")
        await view.see("#form label", "2: mark at x 200.0 mm, y 0.0 mm")
        assert await view.how_many("#plot .choice.chosen") == 4
        for number in (2, 3, 2):
            await page.locator("#plot .choice").nth(number).click()
        ticked = [await page.is_checked(f"#form [name=mark_{n}]") for n in (1, 2, 3, 4)]
        assert ticked == [True, True, True, False]
        assert await view.how_many("#plot .choice.chosen") == 3
        await page.check("#form [name=mark_4]")
        assert await view.how_many("#plot .choice.chosen") == 4
        await page.locator("#plot .choice").nth(0).click()
        await view.answer("Which ones will be touched?")
        await view.see("#title", "Touch mark 1 of 3")
        for x, y, _ in TOUCHES[1:]:
            await view.answer("Touch mark", x=y, y=x, z=0.0)
        await view.see("#title", "What came out")
        await page.locator("#plot .choice").nth(2).click()
        assert await page.input_value("#input-point") == "3"


async def test_page_lists_calibrations_with_date_error_and_last_check(
    page: Page, tmp_path: Path
) -> None:
    async with opened(page, tmp_path) as view:
        await run_through(view.world, await view.world.post("/start", name="table"))
        step = await view.world.post("/start", name="table", wizard="drift")
        touches = [{"x": y + 0.002, "y": x, "z": 0.0} for x, y in MARKS]
        for answers in ({"unit": "m"}, {}, {}, *touches, {}):
            step = await view.world.post("/step", token=step["token"], answers=answers)
        (tmp_path / "broken.json").write_text("{")
        await page.reload()
        await page.click("#again")
        await view.see("#names td.problem", "Cannot be read: ")
        cells = await page.locator("#names tbody tr").nth(1).locator("td").all_inner_texts()
        assert cells[:2] == ["table", "plane"]
        assert str(datetime.now(UTC).year) in cells[2]
        assert cells[3] == "0.00 mm"
        assert cells[4].startswith("\u2717 stale, ")
        await page.fill("#name", "")
        await page.locator("#names button", has_text="table").click()
        assert await page.input_value("#name") == "table"


async def test_page_shows_what_is_left_out_as_crosses(page: Page, tmp_path: Path) -> None:
    async with opened(page, tmp_path) as view:
        await begin(view)
        for x, y, z in TOUCHES:
            await view.answer("Touch mark", x=y, y=x, z=z)
        await view.answer("What came out", next="more")
        await view.answer("Marks in the camera's field")
        await view.answer("Which ones will be touched?")
        for number, (x, y) in enumerate(MARKS):
            await view.answer("Touch mark", x=y + 0.02 * (number == 1), y=x, z=1e-4)
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


async def test_page_of_one_that_was_broken_off_says_since_when_and_begins_anew(
    page: Page, tmp_path: Path
) -> None:
    async with opened(page, tmp_path) as view:
        await begin(view)
        await view.see("#number", "Step 4 of about 9")
    async with opened(page, tmp_path) as view:
        await page.fill("#name", "table")
        await page.click("#start-form button")
        await view.see("#since", "Broken off: begun ")
        assert await page.locator("#done li").count() == 3
        await page.click("#anew")
        await view.see("#number", "Step 1 of about 9")
        assert await page.locator("#resumed").is_hidden()


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


async def in_sight(page: Page) -> None:
    """Check that the present step needs no scrolling, and nothing is beside the screen."""
    box = await page.locator("button.primary:visible").bounding_box()
    size = page.viewport_size
    assert box is not None
    assert size is not None
    title = await page.inner_text("#title")
    assert box["y"] >= 0, title
    assert box["y"] + box["height"] <= size["height"], title
    assert await page.evaluate("document.documentElement.scrollWidth") <= size["width"], title


@pytest.mark.parametrize("size", [(1280, 800), (390, 844)])
async def test_page_s_button_is_in_sight_in_every_step(
    page: Page, tmp_path: Path, size: tuple[int, int]
) -> None:
    async with opened(page, tmp_path) as view:
        await page.set_viewport_size({"width": size[0], "height": size[1]})
        await page.wait_for_selector("#start:not([hidden])")
        await in_sight(page)
        await page.click("#start-form button.primary")
        touches = [{"x": y, "y": x + 0.003 * (x > 0), "z": 0.0} for x, y in MARKS]
        about = {"unit": "m", "side": "+z", "touch_sigma": "0.2"}
        steps: list[dict[str, Any]] = [about, {}, {}, *touches, {"next": "accept"}, {}]
        for answers in steps:
            await view.see("#go")
            await in_sight(page)
            title = await page.inner_text("#title")
            await view.answer(title, **answers)
            await page.wait_for_function(
                "old => document.getElementById('title').textContent !== old", arg=title
            )
        await view.see("#use-python")
        assert await page.evaluate("document.documentElement.scrollWidth") <= size[0]
        await page.set_viewport_size({"width": 1200, "height": 900})


# ---------------------------------------------------------------------- steps that look at pictures


TARGET = Checkerboard(columns=9, rows=6, square=0.025, origin_mark=True)
CAMERA = CameraModel(
    size=(640, 480),
    matrix=np.array([[700.0, 0, 320], [0, 700.0, 240], [0, 0, 1]]),
    distortion=np.array([-0.1, 0.02, 0, 0, 0]),
)
SEEN = Transform("camera", "target", np.diag([1.0, -1.0, -1.0]), np.array([-0.1, 0.06, 0.5]))


@pytest_asyncio.fixture(loop_scope="module")
async def site(tmp_path: Path) -> AsyncIterator[WizardSite]:
    """A site over a camera that sees a sheet, at second sight."""
    shown = [np.full((480, 640), 90, dtype=np.uint8)]

    async def take_picture() -> Any:
        return shown.pop() if shown else render(TARGET, CAMERA, SEEN, noise=2.0)

    folder = Folder(tmp_path)
    options: dict[str, Any] = {
        "take_picture": take_picture,
        "save_to": folder.calibration,
        "suggested": TARGET,
        "camera": CAMERA,
    }
    service = CalibrationService(folder, [sheet_wizard(**options), hand_eye_wizard(**options)])
    async with WizardSite(service) as site:
        yield site
        service.close()


async def answer(page: Page, title: str, **answers: Any) -> None:
    """Answer the step of that title."""
    await page.locator("#title").filter(has_text=title).wait_for()
    # or it is the step before, whose answer is under way
    await page.locator("#go:enabled").wait_for()
    for name, value in answers.items():
        field = page.locator(f"#form [name={name}]")
        if await field.first.get_attribute("type") == "radio":
            await page.locator(f"#form [name={name}][value='{value}']").check()
        else:
            await field.fill(str(value))
    await page.click("#go")


async def picture_size(page: Page) -> list[int]:
    """Return the size of the camera's picture when it was decoded."""
    found: list[int] = await page.evaluate(
        """async () => {
            const image = document.getElementById("camera-picture");
            await image.decode();
            return [image.naturalWidth, image.naturalHeight];
        }"""
    )
    return found


async def begin_sheet(page: Page, site: WizardSite, wizard: str) -> None:
    await page.goto(site.url)
    await page.locator(f"#wizards [value={wizard}]").check()
    await page.fill("#name", "table")
    await page.click("#start-form button")


async def test_page_shows_the_sheet_in_the_cameras_picture(page: Page, site: WizardSite) -> None:
    await begin_sheet(page, site, "sheet")
    await answer(page, "Camera, robot and tool", unit="m", touch_sigma="0,1")
    await answer(page, "Which sheet lies there?")
    await answer(page, "Was the sheet printed true to size?")
    assert await page.locator("#camera").is_hidden()
    await answer(page, "The sheet in the camera's field")
    await page.locator("#base").filter(has_text="9 x 6").wait_for()
    await answer(page, "The sheet in the camera's field")
    await page.locator("#title").filter(has_text="Touch point 1").wait_for()
    assert await page.locator("#camera-choices .choice.chosen").count() == 1
    await page.locator("#camera-choices .choice").nth(9 * 2 + 4).click()
    assert [await page.input_value(f"#input-{one}") for one in ("column", "row")] == ["5", "3"]
    await page.locator("#camera-choices .choice").first.click()
    for number in range(1, 5):
        await page.locator("#title").filter(has_text=f"Touch point {number}").wait_for()
        await in_sight(page)
        assert await picture_size(page) == [940, 775]
        column = int(await page.input_value("#input-column"))
        row = int(await page.input_value("#input-row"))
        x, y, _ = TARGET.points[9 * (row - 1) + column - 1].tolist()
        await answer(page, "Touch point", x=x, y=y, z=0.0)
    await page.locator("#title").filter(has_text="What came out").wait_for()
    assert await page.locator("#camera").is_hidden()
    assert await page.locator("#plot .touched").count() == 4
    await answer(page, "What came out", next="accept")
    await answer(page, "Save table")
    await page.locator("#result").filter(has_text="table.json").wait_for()
    found = SheetCalibration.load(site.service.folder.calibration("table"))
    assert found.view.size == (640, 480)


async def test_page_says_which_file_it_waits_for(page: Page, tmp_path: Path) -> None:
    inbox, folder = tmp_path / "ftp", Folder(tmp_path / "kept")
    inbox.mkdir()
    pictures = PictureFolder(inbox, timeout=60.0)
    wizard = sheet_wizard(
        take_picture=pictures.take,
        save_to=folder.calibration,
        suggested=TARGET,
        awaited=pictures.awaited,
    )
    service = CalibrationService(folder, [wizard])
    async with WizardSite(service) as site:
        service.start("table", "sheet", {"target": target_to_data(TARGET)})
        await page.goto(site.url)
        await answer(page, "Camera, robot and tool")
        await answer(page, "Was the sheet printed true to size?")
        await page.locator("#notes li").filter(has_text="picture 1 of 1").wait_for()
        await answer(page, "The sheet in the camera's field")
        said = f"Waiting: the first file written to {inbox} from now on counts"
        await page.locator("#waiting").filter(has_text=said).wait_for()
        data = load("cv2").imencode(".png", render(TARGET, CAMERA, SEEN))[1].tobytes()
        title = page.locator("#title").filter(has_text="Touch point 1")
        while not await title.count():  # a file that comes before the first look is one of before
            (inbox / "shot.png").write_bytes(data)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(5):
                    await title.wait_for()
        assert await page.inner_text("#waiting") == ""
        service.close()


async def test_page_shows_the_view_that_was_taken_last(page: Page, site: WizardSite) -> None:
    await begin_sheet(page, site, "hand-eye")
    await answer(page, "Camera and robot", robot="xyzw", setup="eye-to-hand")
    await answer(page, "Which sheet lies there?")
    await answer(page, "Was the sheet printed true to size?")
    pose = {"x": 0.5, "y": 0.1, "z": 0.3, "qx": 0, "qy": 0, "qz": 0, "qw": 1}
    await answer(page, "View 1", **pose)
    await page.locator("#base").filter(has_text="9 x 6").wait_for()
    await answer(page, "View 1")
    await page.locator("#title").filter(has_text="View 2").wait_for()
    assert await picture_size(page) == [940, 775]
    assert await page.input_value("#input-qw") == ""
