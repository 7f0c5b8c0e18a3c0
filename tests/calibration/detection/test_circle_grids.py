"""Grids of dots among letters, rulers and other dots are found whole or not at all."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from smartcam.calibration import CircleGrid, find_target, make_sheet
from smartcam.calibration._detection.blobs import find_dark_pieces
from smartcam.geometry._inside import Code
from tests.calibration.inside import apply_homography, area_test, fit_homography, grow_grids
from tests.calibration.scenes import STRAIGHT, drawn, refused

ROUND = CircleGrid(columns=7, rows=6, spacing=0.015, diameter=0.0075, origin_diameter=0.011)
SHIFTED = CircleGrid(columns=4, rows=11, spacing=0.04, diameter=0.015, asymmetric=True)
EVEN = CircleGrid(columns=4, rows=6, spacing=0.04, diameter=0.015, asymmetric=True)
PLAIN = CircleGrid(columns=8, rows=6, spacing=0.02, diameter=0.01)
SMALL = CircleGrid(columns=7, rows=6, spacing=0.02, diameter=0.01)

SAMPLES = 3
"""Samples along each side of a pixel."""


def printed(target: CircleGrid, roll: float, tilt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a camera's image of a printed sheet, and the places (N, 2) of its points."""
    pdfium = pytest.importorskip("pypdfium2", reason="needs pypdfium2, of the extra dev")
    sheet = make_sheet(target)
    document = pdfium.PdfDocument(sheet.pdf())
    page = np.array(document[0].render(scale=8 * 25.4 / 72, grayscale=True).to_numpy()).squeeze()
    document.close()
    turn = cv2.Rodrigues(np.array([0.8, 0.6, 0]) * np.radians(tilt))[0]
    turn = turn @ cv2.Rodrigues(np.array([0, 0, np.radians(roll)]))[0] @ np.diag([1, -1, -1.0])
    matrix, middle = STRAIGHT.matrix, np.array([sheet.width, sheet.height, 0]) / 2
    away = 1.35 * max(sheet.width, sheet.height)

    def project(millimetres: np.ndarray) -> np.ndarray:
        seen = ((millimetres - middle) @ turn.T + [0, 0, away]) @ matrix.T
        return np.asarray(seen[:, :2] / seen[:, 2:])

    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * 2 * middle
    scale = np.array(page.shape[::-1]) / (sheet.width, sheet.height)
    places = np.column_stack([corners[:, 0], sheet.height - corners[:, 1]]) * scale - 0.5
    fine = np.array([[SAMPLES, 0, (SAMPLES - 1) / 2], [0, SAMPLES, (SAMPLES - 1) / 2], [0, 0, 1]])
    seen_as = fine @ cv2.findHomography(places, project(corners))[0]
    size = (640 * SAMPLES, 480 * SAMPLES)
    image = cv2.warpPerspective(page, seen_as, size, flags=cv2.INTER_AREA, borderValue=110)
    image = cv2.resize(image, (640, 480), interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(image, (0, 0), 0.7) * 0.7 + 30
    image += np.random.default_rng(1).normal(0, 2, image.shape)
    return image.astype(np.uint8), project(target.points * 1e3 + [*sheet.origin, 0])


@pytest.mark.long
@pytest.mark.parametrize("roll", [0, 115, 250])
@pytest.mark.parametrize("target", [ROUND, SHIFTED], ids=lambda one: make_sheet(one).id)
def test_find_circles_among_letters_and_rulers_of_a_sheet_are_found(
    target: CircleGrid, roll: float
) -> None:
    image, pixels = printed(target, roll, tilt=25)
    view = find_target(image, target)
    assert np.linalg.norm(view.points - pixels, axis=1).max() < 0.5


@pytest.mark.parametrize("target", [ROUND, SHIFTED], ids=repr)
def test_find_circles_light_on_dark_are_as_exact(target: CircleGrid) -> None:
    picture = drawn(target, tilt=30, roll=20, away=0.6)
    view = find_target(255 - picture.image, target)
    assert picture.off(view).max() < 0.02


def test_find_circles_next_to_more_dots_are_refused() -> None:
    with refused(Code.TARGET_NOT_FOUND, "expected 7 x 6 dots, saw more than these in rows"):
        find_target(drawn(PLAIN, tilt=20).image, SMALL)


def test_find_circles_next_to_dots_that_the_border_cuts_are_refused() -> None:
    picture = drawn(PLAIN)
    half = round(picture.pixels[7, 0]) + 1
    with refused(Code.TARGET_NOT_FOUND, "saw more than these in rows and columns"):
        find_target(np.ascontiguousarray(picture.image[:, :half]), SMALL)
    between = round(picture.pixels[6:8, 0].mean())
    view = find_target(np.ascontiguousarray(picture.image[:, :between]), SMALL)
    assert len(view.ids) == 42


def test_find_circles_on_a_sheet_that_ends_next_to_them_are_found() -> None:
    picture = drawn(PLAIN)
    left = round(picture.pixels[:, 0].min() - 0.6 * np.ptp(picture.pixels[:2, 0]))
    picture.image[:, :left] = 20
    assert picture.off(find_target(picture.image, PLAIN)).max() < 0.02


def test_find_circles_with_a_dot_out_of_its_row_are_not_found() -> None:
    picture = drawn(PLAIN)
    u, v = np.rint(picture.pixels[0]).astype(int)
    cv2.circle(picture.image, (int(u), int(v)), 12, 210, -1)
    cv2.circle(picture.image, (int(u) + 9, int(v) - 6), 6, 30, -1)
    with refused(Code.TARGET_NOT_FOUND, "saw 48 dark spots", "at most 47 in rows"):
        find_target(picture.image, PLAIN)


def test_find_circles_of_even_shifted_rows_in_mirror_image_are_refused() -> None:
    image = np.ascontiguousarray(drawn(EVEN, tilt=20).image[:, ::-1])
    with refused(Code.MIRRORED, "4 x 6 dots: expected an image of the sheet as one reads it"):
        find_target(image, EVEN)


def test_find_circles_in_uneven_light_have_their_origin() -> None:
    picture = drawn(ROUND, tilt=20, roll=180, away=0.35)
    light = np.linspace(1.0, 0.35, 640)
    view = find_target((picture.image * light).astype(np.uint8), ROUND)
    assert picture.off(view).max() < 0.1


def test_find_circles_among_thousands_of_spots_reports_them() -> None:
    noise = np.random.default_rng(2).normal(size=(480, 640)).astype(np.float32)
    clouds = 128 + 400 * np.asarray(cv2.GaussianBlur(noise, (0, 0), 3))
    with refused(Code.TARGET_NOT_FOUND, "dark spots and no such grid among them"):
        find_target(clouds.clip(0, 255).astype(np.uint8), ROUND)


def test_spots_are_filled_and_round() -> None:
    image = np.full((200, 300), 200, np.uint8)
    cv2.ellipse(image, (60, 50), (20, 9), 30, 0, 360, 40, -1)
    cv2.circle(image, (150, 60), 20, 40, 5)
    cv2.line(image, (20, 150), (120, 170), 40, 3)
    cv2.putText(image, "KX", (200, 80), cv2.FONT_HERSHEY_SIMPLEX, 2, 40, 4)
    cv2.circle(image, (250, 150), 8, 40, -1)
    spots = find_dark_pieces(image, 80).find_spots(max_count=100)
    np.testing.assert_allclose(spots.points, [[60, 50], [250, 150]], atol=0.2)
    np.testing.assert_allclose(spots.areas, [np.pi * 180, np.pi * 64], rtol=0.4)


def test_spots_beyond_the_most_are_the_smallest() -> None:
    image = np.full((100, 300), 200, np.uint8)
    for u, radius in ((50, 5), (150, 9), (250, 7)):
        cv2.circle(image, (u, 50), radius, 40, -1)
    found = find_dark_pieces(image, 60).find_spots(max_count=2).points
    np.testing.assert_allclose(np.sort(found[:, 0]), [150, 250], atol=0.2)


def test_lattices_among_other_dots_have_each_of_the_grid() -> None:
    pixels = drawn(PLAIN, tilt=50, roll=30).pixels
    others = np.random.default_rng(4).uniform([0, 380], [100, 480], (30, 2))
    points = np.vstack([others, pixels])
    (grid,) = grow_grids(points, area_test(np.ones(len(points))), min_count=20, max_count=60)
    assert sorted(grid.values()) == list(range(30, 78))
    places = np.array(list(grid), dtype=np.float64)
    matrix = fit_homography(places, points[list(grid.values())])
    assert matrix is not None
    off = apply_homography(matrix, places) - points[list(grid.values())]
    assert np.abs(off).max() < 2


def test_lattices_of_larger_grids_end_with_dots_too_many() -> None:
    pixels = drawn(PLAIN).pixels
    same = area_test(np.ones(48))
    assert max(len(one) for one in grow_grids(pixels, same, min_count=9, max_count=20)) > 20
    uneven = np.where(np.arange(48) % 2, 1.0, 3.0)
    assert list(grow_grids(pixels, area_test(uneven), min_count=25, max_count=48)) == []


def test_lattices_of_few_points_are_none() -> None:
    assert list(grow_grids(np.zeros((4, 2)), area_test(np.ones(4)), min_count=4, max_count=9)) == []
    assert list(grow_grids(np.zeros((9, 2)), area_test(np.ones(9)), min_count=4, max_count=9)) == []
