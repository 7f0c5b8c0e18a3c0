"""Sheets: places of their parts, texts, limits of the page, scale of the printer."""

from __future__ import annotations

import json
import os
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from smartcam.calibration import (
    Charuco,
    Checkerboard,
    CircleGrid,
    MarkerGrid,
    make_sheet,
    scale_target,
    target_from_data,
)
from smartcam.calibration._inside import Target, target_from_description
from smartcam.exceptions import CalibrationError
from smartcam.geometry._inside import Code
from tests import ROOT
from tests.calibration.inside import BORDER_MM, Disc, Label, Polygon, Rays, Sheet, page_size

GOLDEN = ROOT / "docs" / "sheet.svg"

BOARD = Checkerboard(columns=9, rows=6, square=0.025, origin_mark=True)
TARGETS: list[Target | Rays] = [
    BOARD,
    Checkerboard(columns=7, rows=7, square=0.012, origin_mark=True),
    Checkerboard(columns=3, rows=12, square=0.004, origin_mark=True),
    Charuco(columns=7, rows=5, square=0.03, marker=0.022),
    CircleGrid(columns=10, rows=10, spacing=0.015, diameter=0.008, origin_diameter=0.012),
    CircleGrid(columns=4, rows=11, spacing=0.04, diameter=0.015, asymmetric=True),
    Rays(),
]

Bounds = tuple[float, float, float, float]


def bounds(shape: Polygon | Disc | Label) -> Bounds:
    """Return the box of a shape, generous for texts: left, low, right, high."""
    match shape:
        case Polygon(points):
            x, y = zip(*points, strict=True)
            return min(x), min(y), max(x), max(y)
        case Disc((x, y), radius):
            return x - radius, y - radius, x + radius, y + radius
        case Label((x, y), text, size, turned):
            long = 0.6 * size * len(text)
            return (x - size, y, x, y + long) if turned else (x, y, x + long, y + size)


def apart(one: Bounds, other: Bounds) -> bool:
    return one[0] >= other[2] or other[0] >= one[2] or one[1] >= other[3] or other[1] >= one[3]


def texts(sheet: Sheet) -> list[str]:
    return [one.text for one in sheet.shapes if isinstance(one, Label)]


def pattern_length(sheet: Sheet) -> int:
    """Return the number of a sheet's shapes that belong to the target."""
    return next(
        number
        for number, one in enumerate(sheet.shapes)
        if isinstance(one, Polygon) and bounds(one)[3] - bounds(one)[1] == pytest.approx(0.4)
    )


def test_sheet_equals_the_approved_one() -> None:
    """To approve a new sheet, run this test with SMARTCAM_REWRITE=1 and view the file."""
    document = make_sheet(BOARD).svg()
    if os.environ.get("SMARTCAM_REWRITE"):
        GOLDEN.write_text(document, encoding="utf-8", newline="\n")
    assert document == GOLDEN.read_text(encoding="utf-8")


@pytest.mark.parametrize("target", TARGETS, ids=lambda one: one.kind)
def test_sheet_is_inside_the_border_and_nothing_overlaps_the_pattern(target: Target) -> None:
    sheet = make_sheet(target)
    boxes = [bounds(shape) for shape in sheet.shapes]
    for left, low, right, high in boxes:
        assert min(left, low, sheet.width - right, sheet.height - high) >= BORDER_MM - 1e-9
    count = pattern_length(sheet)
    pattern = np.array(boxes[:count])
    whole = (*pattern[:, :2].min(axis=0), *pattern[:, 2:].max(axis=0))
    if isinstance(target, Checkerboard):  # its mark is away from the board
        squares = pattern[:-1]
        whole = (*squares[:, :2].min(axis=0), *squares[:, 2:].max(axis=0))
    assert all(apart(whole, box) for box in boxes[count:])


def see_white_areas(sheet: Sheet, target: Checkerboard) -> None:
    """Check that the areas of the three corners without the mark are empty."""
    radius = 1e3 * target.corner_area_diameter / 2
    x, y = sheet.origin
    for a, b in 1e3 * target.corner_areas[1:]:
        area = (x + a - radius, y + b - radius, x + a + radius, y + b + radius)
        assert min(sheet.width - area[2], sheet.height - area[3]) >= 0
        assert all(apart(area, bounds(shape)) for shape in sheet.shapes)


@given(
    columns=st.integers(3, 30),
    rows=st.integers(3, 30),
    square=st.floats(1, 40),
    page=st.sampled_from(["A4", "A3", "Letter", "300x1000", "2000x2000"]),
)
@example(columns=3, rows=3, square=6.0, page="A5")  # a tick of the ruler touched an area
def test_sheet_of_any_board_leaves_areas_white_or_does_not_fit(
    columns: int, rows: int, square: float, page: str
) -> None:
    target = Checkerboard(columns=columns, rows=rows, square=square / 1e3, origin_mark=True)
    try:
        sheet = make_sheet(target, page=page)
    except CalibrationError as exc:
        refused = exc.code
    else:
        see_white_areas(sheet, target)
        return
    assert (refused, page == "2000x2000") == (Code.PAGE_TOO_SMALL, False)


def test_sheet_rays_run_through_the_origin() -> None:
    sheet = make_sheet(Rays())
    x, y = sheet.origin
    count = pattern_length(sheet)
    along, up = bounds(sheet.shapes[count]), bounds(sheet.shapes[count + 3])
    assert (along[1] + along[3]) / 2 == pytest.approx(y)
    assert (up[0] + up[2]) / 2 == pytest.approx(x)
    assert along[2] - x > 150
    assert up[3] - y > 200


def test_sheet_rulers_are_100_mm_along_x_and_y() -> None:
    sheet = make_sheet(BOARD)
    boxes = [bounds(shape) for shape in sheet.shapes if isinstance(shape, Polygon)]
    sizes = [(box[2] - box[0], box[3] - box[1]) for box in boxes]
    assert sum(size == pytest.approx((100, 0.3)) for size in sizes) == 1
    assert sum(size == pytest.approx((0.3, 100)) for size in sizes) == 1
    assert sum(size == pytest.approx((0.3, 2.7)) for size in sizes) == 11


def test_sheet_has_a_line_with_its_parameters() -> None:
    sheet = make_sheet(BOARD)
    assert sheet.id == "7af2c1ac"
    said = texts(sheet)
    about = "checkerboard, 9 x 6 corners, squares of 25 mm, marked origin"
    assert f"smartcam sheet 7af2c1ac: {about}" in said
    assert {"A", "B"} <= set(said)
    assert said.count("100 mm") == 2
    assert any("Print at 100 %" in one for one in said)


@pytest.mark.parametrize(
    ("number", "title"),
    [
        (3, "ChArUco, 7 x 5 squares of 30 mm, markers of 22 mm, DICT_5X5_250"),
        (4, "circles, 10 x 10, 15 mm apart, diameter 8 mm, origin 12 mm"),
        (5, "asymmetric circles, 4 x 11, 40 mm apart, diameter 15 mm"),
        (6, "rays A and B, origin mark of 20 mm"),
    ],
)
def test_sheet_title_has_kind_counts_and_lengths(number: int, title: str) -> None:
    assert make_sheet(TARGETS[number]).title.partition(": ")[2] == title


def test_sheet_id_depends_on_the_target_alone() -> None:
    ids = {make_sheet(target, page="A3").id for target in TARGETS}
    assert ids == {make_sheet(target).id for target in TARGETS}
    assert len(ids) == len(TARGETS)


def test_sheet_files_carry_the_description() -> None:
    sheet = make_sheet(BOARD)
    root = ET.fromstring(sheet.svg().encode())  # noqa: S314
    text = root.findtext("{http://www.w3.org/2000/svg}metadata")
    assert text is not None
    assert target_from_data(json.loads(text)) == BOARD
    assert f"/Subject ({text})".encode() in sheet.pdf()


@pytest.mark.parametrize("target", TARGETS, ids=lambda one: make_sheet(one).id)
def test_sheet_data_gives_back_the_target(target: Target | Rays) -> None:
    assert target_from_description(json.loads(json.dumps(make_sheet(target).data))) == target


@pytest.mark.parametrize("data", [{}, {"kind": "rays"}, {"kind": "rays", "diameter": 1, "x": 2}])
def test_data_that_describes_no_sheet_is_refused(data: dict[str, object]) -> None:
    with pytest.raises(CalibrationError, match=r"target: expected a kind of \['charuco', "):
        target_from_description(data)


def test_sheet_takes_the_page_upright_or_lying() -> None:
    upright = CircleGrid(columns=4, rows=11, spacing=0.04, diameter=0.015, asymmetric=True)
    assert (make_sheet(BOARD).width, make_sheet(BOARD).height) == (297, 210)
    assert (make_sheet(upright).width, make_sheet(upright).height) == (210, 297)
    with pytest.raises(CalibrationError, match=r"does not fit on 210 x 297 mm"):
        make_sheet(BOARD, page="210x297")


def test_error_of_a_too_large_sheet_names_the_excess() -> None:
    with pytest.raises(
        CalibrationError,
        match=r"^checkerboard, 9 x 6 corners, squares of 30 mm, marked origin: does not fit on A4 "
        r"\(297 x 210 mm\): .* takes 337\.5 x 247\.5 mm, 40\.5 mm too wide and 37\.5 mm too high$",
    ) as caught:
        make_sheet(Checkerboard(columns=9, rows=6, square=0.03, origin_mark=True))
    assert caught.value.code == Code.PAGE_TOO_SMALL
    assert caught.value.got == (297, 210)


@pytest.mark.parametrize("page", ["a4", "300", "0x100", "100x3001", "300 x 200", "x" * 200])
def test_invalid_page_is_refused(page: str) -> None:
    with pytest.raises(CalibrationError, match="page: expected one of A5, A4, ") as caught:
        page_size(page)
    assert caught.value.code == Code.SHAPE
    assert caught.value.got == page[:64]


@pytest.mark.parametrize("diameter", [0, -1, float("nan"), float("inf"), True, "20"])
def test_rays_without_a_diameter_are_refused(diameter: float) -> None:
    with pytest.raises(CalibrationError, match="rays: expected diameter to be a length in metres"):
        Rays(diameter=diameter)


# ---------------------------------------------------------------------- the printer's scale


def test_scaled_takes_the_mean_of_both_rulers() -> None:
    board = scale_target(BOARD, (99.0, 99.4))
    assert board == Checkerboard(columns=9, rows=6, square=0.0248, origin_mark=True)


def test_scaled_changes_every_length_and_no_count() -> None:
    charuco = Charuco(columns=7, rows=5, square=0.03, marker=0.02)
    assert scale_target(charuco, (101, 101)) == Charuco(
        columns=7, rows=5, square=0.0303, marker=0.0202
    )
    grid = CircleGrid(columns=4, rows=3, spacing=1, diameter=0.5, origin_diameter=0.6)
    real = scale_target(grid, (98, 98))
    assert (real.spacing, real.diameter, real.origin_diameter) == (0.98, 0.49, 0.588)
    assert (real.columns, real.rows, real.asymmetric) == (4, 3, False)
    plain = CircleGrid(columns=4, rows=3, spacing=1, diameter=0.5)
    assert scale_target(plain, (98, 98)).origin_diameter is None
    markers = MarkerGrid(columns=3, rows=2, marker=0.02, gap=0.01, border=2, first_id=5)
    assert scale_target(markers, (101, 101)) == replace(markers, marker=0.0202, gap=0.0101)
    assert scale_target(Rays(), (99, 99)) == Rays(diameter=0.0198)


@pytest.mark.parametrize(
    ("rulers", "axis"),
    [((94.9, 100), "x"), ((100, 105.1), "y"), ((float("nan"), 100), "x"), ((3.9, 3.9), "x")],
)
def test_scaled_refuses_lengths_more_than_a_twentieth_off(
    rulers: tuple[float, float], axis: str
) -> None:
    with pytest.raises(
        CalibrationError, match=f"ruler along {axis}: expected 100 mm within 5%"
    ) as (caught):
        scale_target(BOARD, rulers)
    assert caught.value.code == Code.SCALE_MISMATCH


def test_scaled_refuses_rulers_that_differ() -> None:
    with pytest.raises(CalibrationError, match=r"within 0\.5%, got 99 and 100 mm") as caught:
        scale_target(BOARD, (99, 100))
    assert caught.value.code == Code.SCALE_MISMATCH
    assert scale_target(BOARD, (99.6, 100)).square == 0.02495
