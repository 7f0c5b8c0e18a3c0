"""Sheets drawn by Chromium and PDFium, measured with smartcam's detection."""

from __future__ import annotations

import os
import shutil
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
import pytest_asyncio

from smartcam.calibration import Charuco, Checkerboard, CircleGrid, find_target, make_sheet
from smartcam.calibration._inside import Target
from tests.calibration.inside import Rays, Sheet

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from numpy.typing import NDArray
    from playwright.async_api import Browser

    Picture = NDArray[np.uint8]

playwright = pytest.importorskip("playwright.async_api")
pdfium = pytest.importorskip("pypdfium2")

CHROMIUM = os.environ.get("CHROMIUM") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
pytestmark = [
    pytest.mark.long,
    pytest.mark.real_time,
    pytest.mark.asyncio(loop_scope="module"),
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on the path, nor named by CHROMIUM"),
]

DPI = 300.0
CSS_PIXEL = 25.4 / 96
"""Millimetres."""

OFF_DRAWN = 0.025
"""Millimetres: Chromium draws an edge's height to a quarter of a pixel, 0.021 mm at ``DPI``."""

TARGETS: list[Target] = [
    Checkerboard(columns=9, rows=6, square=0.025, origin_mark=True),
    Checkerboard(columns=7, rows=7, square=0.012, origin_mark=True),
    Checkerboard(columns=8, rows=5, square=0.02),
    Charuco(columns=7, rows=5, square=0.03, marker=0.022),
    Charuco(columns=6, rows=6, square=0.025, marker=0.018, legacy_pattern=True),
    CircleGrid(columns=10, rows=10, spacing=0.015, diameter=0.008, origin_diameter=0.012),
    CircleGrid(columns=4, rows=11, spacing=0.04, diameter=0.015, asymmetric=True),
]


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def browser() -> AsyncIterator[Browser]:
    async with playwright.async_playwright() as tool:
        browser = await tool.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        await browser.close()


async def drawn_svg(browser: Browser, sheet: Sheet) -> Picture:
    """Return the picture that Chromium makes of a sheet, pixel 0, 0 at its upper left corner."""
    view: Any = {
        "width": int(sheet.width / CSS_PIXEL) + 1,
        "height": int(sheet.height / CSS_PIXEL) + 1,
    }
    page = await browser.new_page(viewport=view, device_scale_factor=DPI / 96)
    _, _, document = sheet.svg().partition("\n")
    await page.set_content(f"<style>body {{ margin: 0 }}</style>{document}")
    png = np.frombuffer(await page.screenshot(), dtype=np.uint8)
    await page.close()
    return np.asarray(cv2.imdecode(png, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def drawn_pdf(sheet: Sheet) -> Picture:
    """Return the picture that PDFium makes of a sheet, the page drawn to whole pixels."""
    document = pdfium.PdfDocument(sheet.pdf())
    picture = np.array(document[0].render(scale=DPI / 72, grayscale=True).to_numpy())
    document.close()
    return picture.reshape(picture.shape[:2])


def seen_by_camera(picture: Picture) -> Picture:
    """Return a picture with the blur of a lens."""
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.7), dtype=np.uint8)


def off(picture: Picture, sheet: Sheet, scale: Any) -> float:
    """Return the largest distance of a point from its nominal place on the sheet, mm."""
    assert not isinstance(sheet.target, Rays)
    view = find_target(seen_by_camera(picture), sheet.target)
    assert len(view.ids) == len(sheet.target.points)
    x, y = 1e3 * view.object_points[:, :2].T + np.array(sheet.origin)[:, None]
    # a pixel's middle is a whole number
    seen = (view.points + 0.5) / scale
    return float(np.hypot(*(seen - np.column_stack([x, sheet.height - y])).T).max())


def black_length(picture: Picture, axis: int, longest: float) -> float:
    """Return the length of the longest line of black along an axis but below ``longest``, pixels.
    Grey pixels at its ends count by their darkness.
    """
    lines = picture if axis == 1 else picture.T
    best = 0.0
    for line in lines[(lines < 64).sum(axis=1) > 0.3 * longest]:
        dark = np.concatenate([[False], line < 250, [False]])
        starts, ends = np.flatnonzero(np.diff(dark.astype(int))).reshape(-1, 2).T
        lengths = [float((1 - line[a:b] / 255).sum()) for a, b in zip(starts, ends, strict=True)]
        best = max([best, *(length for length in lengths if length < longest)])
    return best


@pytest.mark.parametrize("target", TARGETS, ids=lambda one: make_sheet(one).id)
async def test_svg_has_each_point_at_its_stated_place(browser: Browser, target: Target) -> None:
    sheet = make_sheet(target)
    assert off(await drawn_svg(browser, sheet), sheet, DPI / 25.4) < OFF_DRAWN


@pytest.mark.parametrize("target", TARGETS, ids=lambda one: make_sheet(one).id)
async def test_pdf_has_each_point_at_its_stated_place(target: Target) -> None:
    sheet = make_sheet(target)
    picture = drawn_pdf(sheet)
    scale = np.array(picture.shape[::-1]) / (sheet.width, sheet.height)
    np.testing.assert_allclose(scale, DPI / 25.4, rtol=5e-4)
    assert off(picture, sheet, scale) < 0.02


async def test_rulers_are_100_mm_long(browser: Browser) -> None:
    sheet = make_sheet(Rays())
    drawn = await drawn_svg(browser, sheet)
    pdf = drawn_pdf(sheet)
    for picture, scales in (
        (drawn, [DPI / 25.4] * 2),
        (pdf, [pdf.shape[0] / sheet.height, pdf.shape[1] / sheet.width]),
    ):
        for axis, scale in enumerate(scales):
            # rays are longer
            length = black_length(picture, axis, 105 * scale) / scale
            assert length == pytest.approx(100, abs=0.05)


async def test_svg_and_pdf_show_the_same(browser: Browser) -> None:
    sheet = make_sheet(TARGETS[3])
    svg, pdf = await drawn_svg(browser, sheet), drawn_pdf(sheet)
    small = [
        cv2.resize(one[: int(210 * 11.8), : int(297 * 11.8)], (297, 210), interpolation=3)
        for one in (svg, pdf)
    ]
    assert np.mean(np.abs(small[0].astype(float) - small[1])) < 2


async def test_sheet_turned_by_half_has_its_origin_on_the_other_side() -> None:
    for target in TARGETS[:2]:
        sheet = make_sheet(target)
        picture = seen_by_camera(drawn_pdf(sheet))
        turned = np.ascontiguousarray(picture[::-1, ::-1])
        upright, other = (find_target(one, target).points[0] for one in (picture, turned))
        np.testing.assert_allclose(upright + other, np.array(picture.shape[::-1]) - 1, atol=0.2)
