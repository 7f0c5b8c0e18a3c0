"""The teaching page in a real browser, from a drawn region to the saved file."""

from __future__ import annotations

import asyncio
import contextlib
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import pytest_asyncio

from smartcam import frames
from smartcam.calibration import fit_plane
from smartcam.inspection import load_cell
from smartcam.inspection._inside import Teaching
from smartcam.web._inside import TeachSite
from tests.web.browser import BROWSER_MARKS, new_page, nothing_wrong, see

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from playwright.async_api import Page

cv2: Any = pytest.importorskip("cv2")
pytest.importorskip("ruamel.yaml")

pytestmark = BROWSER_MARKS

FILE = """\
# the cell of line 1
cameras:
  cam:
    software:
      frames: shots # beside this file
      applications:
        7: {name: glue, present: {grey: [0, 120]}} # spots
"""


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def page() -> AsyncIterator[Page]:
    async with new_page(1280, 900) as page:
        yield page


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "cell.yaml"
    path.write_text(FILE)
    (tmp_path / "shots").mkdir()
    for number, spots in enumerate((2, 2, 1), start=1):
        pixels = np.full((240, 320), 200, np.uint8)
        for spot in range(spots):
            pixels[100:130, 80 + 100 * spot : 110 + 100 * spot] = 20
        cv2.imwrite(str(tmp_path / "shots" / f"part{number}.png"), pixels)
    return path


@contextlib.asynccontextmanager
async def opened(page: Page, site: TeachSite) -> AsyncIterator[TeachSite]:
    with nothing_wrong(page):
        async with site:
            await page.goto(site.url)
            await see(page, "#live[data-state=live]", "ready")
            yield site


async def drag(page: Page, begin: tuple[float, float], end: tuple[float, float]) -> None:
    """Drag over the picture; places are shares of its width and height."""
    box = await page.locator("#canvas").bounding_box()
    assert box is not None
    places = [(box["x"] + box["width"] * x, box["y"] + box["height"] * y) for x, y in (begin, end)]
    await page.mouse.move(*places[0])
    await page.mouse.down()
    await page.mouse.move(*places[1], steps=4)
    await page.mouse.up()


async def test_a_drawn_region_is_tried_learned_and_saved(page: Page, path: Path) -> None:
    files = sorted((path.parent / "shots").iterdir())
    async with opened(page, TeachSite(Teaching(path, "cam", 7), files)):
        await see(page, "#rows tr[data-picture='1']", "count 2")
        await see(page, "#rows tr[data-picture='3']", "count 1")
        await drag(page, (0.1, 0.3), (0.9, 0.7))
        await see(page, "#marks polygon.region")
        region = await page.input_value("#set-region")
        assert region.startswith("[")
        await page.fill("#set-most", "4")
        await page.locator("#rows tr[data-picture='3'] input").click()
        await see(page, "#counts", "1 judged otherwise")
        await page.click("#learn")
        await see(page, "#counts", "0 judged otherwise")
        await see(page, "#rows tr[data-picture='3'] .bad", "1 spot")
        await page.click("#save")
        await see(page, "#saved", "Saved in")
    text = await asyncio.to_thread(path.read_text)
    assert text.startswith("# the cell of line 1\n")
    assert "# beside this file" in text
    assert "# spots" in text
    program = load_cell(path)["cam"].programs[7]
    tool = program.steps[0].tool
    assert tool.settings.count == (2, 2)
    assert f"region: {region}" in text


async def test_a_way_is_drawn_and_a_measured_tolerance_is_learned(
    page: Page, tmp_path: Path
) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(
        "cameras:\n  cam: {software: {frames: shots, applications: {\n"
        "    8: {measure: {width: {strip: 12}}}}}} # plates\n".replace(
            "{strip", "{across: [[9, 40], [29, 40]], strip"
        )
    )
    rng, files = np.random.default_rng(1), []
    for number in range(1, 8):
        pixels = np.full((120, 320), 40.0)
        pixels[:, 100 : 220 + 40 * (number == 7)] = 200
        blurred = cv2.GaussianBlur(pixels, (0, 0), 1.0) + rng.normal(0, 2, pixels.shape)
        files.append(tmp_path / f"plate{number}.png")
        cv2.imwrite(str(files[-1]), blurred.clip(0, 255).astype(np.uint8))
    async with opened(page, TeachSite(Teaching(path, "cam", 8), files)):
        await see(page, "#rows tr[data-picture='1'] .bad", "no edge")
        await drag(page, (0.15, 0.5), (0.9, 0.5))
        await see(page, "#rows tr[data-picture='1']", "width 1")
        assert "strip: 12" in await page.input_value("#set-width")
        await page.click("#learn")
        await see(page, "#learned li", "from 6 pictures: mean 1")
        await see(page, "#learned li", "Not learned from: 7: plate7.png")
        await see(page, "#rows tr[data-picture='7'] .bad", "is above")
        await see(page, "#counts", "1 judged otherwise")
        await page.click("#save")
        await see(page, "#saved", "Saved in")
    assert (await asyncio.to_thread(path.read_text)).endswith(" # plates\n")
    tolerance = load_cell(path)["cam"].programs[8].steps[0].tool.settings.tolerance
    assert 119 < tolerance.min_value < 120 < tolerance.max_value < 121


async def test_wrong_setting_is_reported_beside_it_and_not_saved(page: Page, path: Path) -> None:
    files = sorted((path.parent / "shots").iterdir())
    async with opened(page, TeachSite(Teaching(path, "cam", 7), files)):
        await page.fill("#set-grey", "[9, 0]")
        await see(page, "#problem", "smaller number first")
        await page.fill("#set-grey", "[0, 120]")
        await see(page, "#rows tr[data-picture='1']", "count 2")
        assert await page.inner_text("#problem") == ""
    assert await asyncio.to_thread(path.read_text) == FILE


async def test_camera_takes_pictures(page: Page, path: Path) -> None:
    async with frames.open("synthetic://?size=320x240&fps=50", linger=2.0) as source:
        site = TeachSite(Teaching(path, "cam", 7), source=source)
        async with opened(page, site):
            await page.click("#shoot")
            await see(page, "#rows tr[data-picture='1']", "ms")
            await page.click("#shoot")
            await see(page, "#rows tr[data-picture='2']", "ms")
            assert len(site.pictures) == 2


def located_cell(folder: Path) -> tuple[Path, list[Path]]:
    """Write a cell with a calibration in which a part is taught, and pictures of it."""
    pixels = np.array([(0, 0), (320, 0), (320, -240), (0, -240)], float)
    robot = np.column_stack([0.0005 * pixels, np.zeros(4)])
    fit_plane(pixels, robot, touch_sigma=1e-5, y_down=True).save(folder / "plane.json")
    path = folder / "cell.yaml"
    path.write_text(
        "cameras:\n  cam: {software: {frames: shots, calibration: plane.json, applications: {\n"
        "    7: {locate: {model: old.model}}}}} # brackets\n"
    )
    (folder / "shots").mkdir()
    files = []
    for number, degrees in enumerate((0, 130, 45), start=1):
        corners = np.array([(-50, -40), (50, -40), (50, -5), (0, 5), (0, 45), (-50, 45)], float)
        turn = cv2.getRotationMatrix2D((0, 0), -degrees, 1.0)[:, :2]
        picture = np.full((240, 320), 60, np.uint8)
        if number < 3:
            places = np.rint((corners @ turn.T + (160, 120)) * 256).astype(np.int32)
            cv2.fillPoly(picture, [places], 190, cv2.LINE_AA, 8)
        noise = np.random.default_rng(number).normal(0, 2, picture.shape)
        blurred = cv2.GaussianBlur(picture, (0, 0), 0.8) + noise
        files.append(folder / "shots" / f"bracket{number}.png")
        cv2.imwrite(str(files[-1]), np.clip(blurred, 0, 255).astype(np.uint8))
    return path, files


@pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 800)])
async def test_a_part_is_taught_from_a_picture(
    page: Page, tmp_path: Path, width: int, height: int
) -> None:
    path, files = located_cell(tmp_path)
    await page.set_viewport_size({"width": width, "height": height})
    async with opened(page, TeachSite(Teaching(path, "cam", 7), files)):
        await see(page, "#problem", "old.model")
        await page.click("#teach")
        await see(page, "#how", "Drag around the part")
        assert await page.input_value("#set-model") == ""
        assert await page.input_value("#set-taught") == "shots/bracket1.png"
        await page.locator("#canvas").scroll_into_view_if_needed()
        await drag(page, (0.28, 0.2), (0.72, 0.8))
        await see(page, "#remarks li", "bracket1: has one angle")
        remark = await page.inner_text("#remarks li")
        assert re.search(r"good to 0\.00\d+ px, 0\.00\d+ mm and 0\.0\d+ degrees", remark)
        await see(page, "#rows tr[data-picture='2']", "count 1, best_score 0.9")
        await see(page, "#rows tr[data-picture='2']", " ms")
        await see(page, "#rows tr[data-picture='3'] .bad", "0 found, expected 1 or more")
        await see(page, "#marks polygon.found")
        await page.locator("#rows tr[data-picture='2']").click()
        await see(page, "#shown-name", "bracket2.png")
        assert await page.is_visible("#teach")
        await page.click("#save")
        await see(page, "#saved", "Saved in")
        wide = await page.evaluate("document.documentElement.scrollWidth")
        assert wide <= width
    await page.set_viewport_size({"width": 1280, "height": 900})
    settings = load_cell(path)["cam"].programs[7].steps[0].tool.settings
    assert (settings.model, settings.taught) == (None, "shots/bracket1.png")
    assert settings.part[0][0] == pytest.approx(0.28 * 320, abs=2)
