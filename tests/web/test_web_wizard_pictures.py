"""The wizard's page with steps that look at pictures, in a real browser."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest_asyncio
from browser import BROWSER_MARKS, new_page

from smartcam.calibration.files.directory import Folder
from smartcam.calibration.geometry.frames import Transform
from smartcam.calibration.lens.model import CameraModel
from smartcam.calibration.sheet.calibration import SheetCalibration
from smartcam.calibration.simulation.images import render
from smartcam.calibration.targets import Checkerboard
from smartcam.calibration.wizards.hand_eye import hand_eye_wizard
from smartcam.calibration.wizards.services import CalibrationService
from smartcam.calibration.wizards.sheet import sheet_wizard
from smartcam.web.wizard import WizardSite

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from playwright.async_api import Page

pytestmark = BROWSER_MARKS

TARGET = Checkerboard(columns=9, rows=6, square=0.025, origin_mark=True)
CAMERA = CameraModel(
    size=(640, 480),
    matrix=np.array([[700.0, 0, 320], [0, 700.0, 240], [0, 0, 1]]),
    distortion=np.array([-0.1, 0.02, 0, 0, 0]),
)
SEEN = Transform("camera", "target", np.diag([1.0, -1.0, -1.0]), np.array([-0.1, 0.06, 0.5]))


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def page() -> AsyncIterator[Page]:
    async with new_page() as page:
        yield page


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


async def begin(page: Page, site: WizardSite, wizard: str) -> None:
    await page.goto(site.url)
    await page.locator(f"#wizards [value={wizard}]").check()
    await page.fill("#name", "table")
    await page.click("#start-form button")


async def test_page_shows_the_sheet_in_the_cameras_picture(page: Page, site: WizardSite) -> None:
    await begin(page, site, "sheet")
    await answer(page, "Camera, robot and tool", unit="m", touch_sigma="0,1")
    await answer(page, "Which sheet lies there?")
    await answer(page, "Was the sheet printed true to size?")
    assert await page.locator("#camera").is_hidden()
    await answer(page, "The sheet in the camera's field")
    await page.locator("#base").filter(has_text="9 x 6").wait_for()
    await answer(page, "The sheet in the camera's field")
    for number in range(1, 5):
        await page.locator("#title").filter(has_text=f"Touch point {number}").wait_for()
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


async def test_page_shows_the_view_that_was_taken_last(page: Page, site: WizardSite) -> None:
    await begin(page, site, "hand-eye")
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
