"""The black parts of a target, and their SVG and PDF."""

from __future__ import annotations

import json
import math
import re
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from smartcam.calibration import Charuco, Checkerboard, CircleGrid
from smartcam.calibration._inside import Target
from smartcam.calibration._printing.shapes import Box, origin_mark_shapes, outlines, pattern_shapes
from smartcam.exceptions import CalibrationError
from smartcam.geometry._inside import Code
from tests.calibration.inside import Disc, Label, Polygon, PrintedPage, pdf, rectangle, svg

if TYPE_CHECKING:
    from numpy.typing import NDArray

OTHERS = [(3, False), (3, True), (4, False)]


def winding(polygons: list[Polygon], x: float, y: float) -> int:
    """Return the number of counter-clockwise turns of polygons around a point."""
    total = 0.0
    for polygon in polygons:
        turns = np.array([math.atan2(b - y, a - x) for a, b in polygon.points])
        total += sum(math.remainder(step, math.tau) for step in np.roll(turns, -1) - turns)
    return round(total / math.tau)


def polygons(target: Target) -> list[Polygon]:
    return [one for one in pattern_shapes(target)[0] if isinstance(one, Polygon)]


def area(loop: list[tuple[int, int]]) -> float:
    x, y = np.array(loop, dtype=float).T
    return float(x @ np.roll(y, -1) - np.roll(x, -1) @ y) / 2


def test_checkerboard_is_black_at_the_origin_and_in_turns() -> None:
    shapes = polygons(Checkerboard(columns=4, rows=3, square=0.01))
    black = [[winding(shapes, 10 * x - 5, 10 * y - 5) for x in range(5)] for y in range(4)]
    assert black == [[1, 0, 1, 0, 1], [0, 1, 0, 1, 0], [1, 0, 1, 0, 1], [0, 1, 0, 1, 0]]


def test_checkerboard_box_is_that_of_its_squares() -> None:
    target = Checkerboard(columns=4, rows=3, square=0.01, origin_mark=True)
    corners = np.concatenate([one.points for one in polygons(target)])
    assert pattern_shapes(target)[1] == Box(-10, -10, 40, 30)
    assert (*corners.min(axis=0), *corners.max(axis=0)) == (-10, -10, 40, 30)


def test_checkerboard_origin_mark_is_a_dot_in_the_area_of_the_origin() -> None:
    target = Checkerboard(columns=4, rows=3, square=0.01, origin_mark=True)
    mark = pattern_shapes(target)[0][-1]
    assert isinstance(mark, Disc)
    assert mark.centre == pytest.approx((-13, -13))
    assert mark.radius == pytest.approx(1.5)
    assert 1e3 * target.corner_areas[2] == pytest.approx((43, 33))


@pytest.mark.parametrize(
    ("rows", "legacy"),
    [(4, True), *(pytest.param(*one, marks=pytest.mark.long) for one in OTHERS)],
)
def test_charuco_is_the_board_of_opencv(rows: int, legacy: bool) -> None:
    target = Charuco(columns=4, rows=rows, square=0.03, marker=0.021, legacy_pattern=legacy)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
    board = cv2.aruco.CharucoBoard((4, rows), 0.03, 0.021, dictionary)
    board.setLegacyPattern(legacy)
    image = np.asarray(board.generateImage((4 * 120, rows * 120)))  # 4 pixels for a millimetre
    shapes = polygons(target)
    middles = np.arange(0.75, 30 * max(4, rows), 3.0)  # of modules, and of the white around them
    theirs = [
        [image[int(4 * y), int(4 * x)] == 0 for x in middles if x < 120]
        for y in middles
        if y < 30 * rows
    ]
    ours = [
        [winding(shapes, x - 30, 30 * (rows - 1) - y) == 1 for x in middles if x < 120]
        for y in middles
        if y < 30 * rows
    ]
    assert ours == theirs


def test_charuco_with_more_squares_than_markers_is_refused() -> None:
    target = Charuco(columns=20, rows=20, square=0.01, marker=0.006, dictionary="DICT_4X4_50")
    with pytest.raises(CalibrationError, match="at least 200 markers in DICT_4X4_50, got 50"):
        pattern_shapes(target)


def test_charuco_of_an_unknown_dictionary_is_refused() -> None:
    target = Charuco(columns=4, rows=4, square=0.01, marker=0.006, dictionary="DICT_MINE")
    with pytest.raises(CalibrationError, match="got 'DICT_MINE'") as caught:
        pattern_shapes(target)
    assert caught.value.code == Code.SHAPE


def test_circles_are_dots_at_the_points_the_origin_one_larger() -> None:
    target = CircleGrid(columns=4, rows=3, spacing=0.02, diameter=0.01, origin_diameter=0.014)
    dots, box = pattern_shapes(target)
    assert [one.radius for one in dots if isinstance(one, Disc)] == pytest.approx([7] + 11 * [5])
    centres = [one.centre for one in dots if isinstance(one, Disc)]
    np.testing.assert_allclose(centres, 1e3 * target.points[:, :2], atol=1e-12)
    assert box == pytest.approx((-7, -7, 65, 45))


def test_circles_asymmetric_box_has_the_shifted_rows() -> None:
    target = CircleGrid(columns=4, rows=11, spacing=0.04, diameter=0.015, asymmetric=True)
    assert pattern_shapes(target)[1] == pytest.approx((-7.5, -7.5, 147.5, 207.5))


@pytest.mark.parametrize("seed", range(5))
def test_outlines_enclose_exactly_the_black_cells(seed: int) -> None:
    cells: NDArray[np.bool_] = np.random.default_rng(seed).random((6, 7)) < 0.5
    loops = outlines(cells)
    assert sum(area(loop) for loop in loops) == np.count_nonzero(cells)
    shapes = [Polygon(tuple(loop)) for loop in loops]
    drawn = [[winding(shapes, x + 0.5, 5.5 - y) for x in range(7)] for y in range(6)]
    assert np.array_equal(drawn, cells)


def test_outlines_of_a_ring_have_a_hole_that_runs_clockwise() -> None:
    ring = np.ones((3, 3), dtype=bool)
    ring[1, 1] = False
    assert sorted(area(loop) for loop in outlines(ring)) == [-1, 9]


def test_outlines_have_points_only_at_their_turns() -> None:
    assert sorted(outlines(np.ones((2, 5), dtype=bool))[0]) == [(0, 0), (0, 2), (5, 0), (5, 2)]


def test_origin_mark_of_rays_has_two_black_quarters_and_a_white_dot() -> None:
    shapes, box = origin_mark_shapes(10)
    solid = [one for one in shapes if isinstance(one, Polygon)]
    at = [(2, 2), (-4, -4), (4, -4), (-4, 4), (4.2, 4.2), (-7.5, -7.5)]
    assert [winding(solid, x, y) for x, y in at] == [1, 1, 0, 0, 0, 0]
    assert box == (-10, -10, 10, 10)


# ----------------------------------------------------------------------
# Shapes as SVG and PDF: to scale, filled, always the same bytes.


SHAPES = (
    rectangle(10, 20, 30, 5),
    Disc((50.0, 60.0), 2.5),
    Label((10, 90), "a <b> (c) \\", 2.6),
    Label((5, 10), "up", 3, runs_upwards=True),
)
PAGE = PrintedPage(100, 120.5, "A & B", json.dumps({"kind": "<none>"}), SHAPES)
SVG = "{http://www.w3.org/2000/svg}"


def test_svg_has_the_page_s_size_in_millimetres() -> None:
    root = ET.fromstring(svg(PAGE).encode())  # noqa: S314
    assert (root.get("width"), root.get("height")) == ("100mm", "120.5mm")
    assert root.get("viewBox") == "0 0 100 120.5"


def test_svg_turns_y_up_into_y_down() -> None:
    text = svg(PAGE)
    assert "M10 100.5 40 100.5 40 95.5 10 95.5Z" in text
    assert "M47.5 60.5A2.5 2.5 0 0 0 52.5 60.5A2.5 2.5 0 0 0 47.5 60.5Z" in text
    assert '<text x="5" y="110.5" font-size="3" transform="rotate(-90 5 110.5)">up</text>' in text


def test_svg_has_no_stroke_and_carries_title_and_description() -> None:
    root = ET.fromstring(svg(PAGE).encode())  # noqa: S314
    assert "stroke" not in svg(PAGE)
    assert root.findtext(f"{SVG}title") == "A & B"
    assert root.findtext(f"{SVG}metadata") == '{"kind": "<none>"}'
    assert [one.text for one in root.iter(f"{SVG}text")] == ["a <b> (c) \\", "up"]


def test_pdf_has_the_page_s_size_in_points() -> None:
    assert b"/MediaBox [0 0 283.4646 341.5748]" in pdf(PAGE)
    assert b"2.834645669 0 0 2.834645669 0 0 cm\n10 20 m 40 20 l 40 25 l 10 25 l h" in pdf(PAGE)


def test_pdf_finds_its_objects_by_their_offsets() -> None:
    data = pdf(PAGE)
    start = int(data.rsplit(b"startxref\n", 1)[1].split()[0])
    assert data[start:].startswith(b"xref\n0 7\n")
    offsets = [int(one) for one in re.findall(rb"(\d{10}) 00000 n \n", data[start:])]
    assert [data[at:].split(b" obj")[0] for at in offsets] == [b"%d 0" % n for n in range(1, 7)]


def test_pdf_content_has_its_stated_length() -> None:
    data = pdf(PAGE)
    (length,) = re.findall(rb"/Length (\d+)", data)
    content = data.split(b"stream\n", 1)[1]
    assert content[int(length) :].startswith(b"\nendstream")


def test_pdf_requests_its_true_size_and_strokes_nothing() -> None:
    data = pdf(PAGE)
    assert b"/ViewerPreferences << /PrintScaling /None >>" in data
    content = data.split(b"stream\n", 1)[1].split(b"\nendstream")[0].decode()
    assert not re.search(r"(^|\s)[sSbB]\*?($|\n)", re.sub(r"\(.*\)", "", content))
    assert b"(a <b> \\(c\\) \\\\) Tj" in data


@pytest.mark.parametrize("write", [svg, pdf])
def test_document_of_the_same_page_is_the_same(write: object) -> None:
    assert callable(write)
    assert write(PAGE) == write(PrintedPage(100, 120.5, "A & B", PAGE.description, tuple(SHAPES)))


def test_length_is_written_to_a_tenth_of_a_micrometre() -> None:
    page = PrintedPage(10, 10, "", "", (Polygon(((1 / 3, -1e-9), (2, 3), (4.5, 6))),))
    assert b"0.3333 0 m 2 3 l 4.5 6 l h" in pdf(page)
