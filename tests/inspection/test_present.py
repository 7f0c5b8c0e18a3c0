"""The tool `present`: spots by grey level and colour, their number, place and direction."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from tests.inspection.cells import board, inspected

if TYPE_CHECKING:
    from pathlib import Path

LIGHT = "grey: [200, 255]"
TWO = board((20, 20, 10, 10, 250), (100, 50, 30, 12, 230))


def test_largest_spot_has_its_place_in_the_result(tmp_path: Path) -> None:
    value = inspected(tmp_path, f"{{present: {{{LIGHT}}}}}", TWO).value
    assert (value.ok, value.count, value.area) == (True, 2, 360)
    assert (value.x, value.y, value.angle) == (114.5, 55.5, 0.0)


@pytest.mark.parametrize(
    ("said", "ok"),
    [("2", True), ("1", False), ("3", False), ("[1, 2]", True), ("[0, 1]", False), ("0", False)],
)
def test_number_of_spots_is_judged(tmp_path: Path, said: str, ok: bool) -> None:
    found = inspected(tmp_path, f"{{present: {{{LIGHT}, count: {said}}}}}", TWO)
    assert found.ok is ok
    assert bool(found.reason) is not ok


def test_spots_of_another_area_do_not_count(tmp_path: Path) -> None:
    for area, count in (("[50, 150]", 1), ("[360, 360]", 1), ("[101, 359]", 0), ("[1, 999]", 2)):
        cell = f"{{present: {{{LIGHT}, area: {area}}}}}"
        assert inspected(tmp_path, cell, TWO).value.count == count


def test_spots_come_as_a_list_the_largest_first(tmp_path: Path) -> None:
    value = inspected(tmp_path, f"{{present: {{{LIGHT}, most: 5}}}}", TWO).value
    assert value.count == 2
    assert [spot.area for spot in value.present] == [360, 100]
    assert [spot.x for spot in value.present] == [114.5, 24.5]


@pytest.mark.parametrize("degrees", [-80, -30, 0, 25, 60])
def test_direction_is_that_of_the_long_axis(tmp_path: Path, degrees: float) -> None:
    picture = board()
    box = ((100.0, 50.0), (50.0, 14.0), degrees)
    cv2.fillPoly(picture, [np.rint(cv2.boxPoints(box)).astype(np.int32)], 250)
    value = inspected(tmp_path, f"{{present: {{{LIGHT}}}}}", picture).value
    assert abs(value.angle - math.radians(degrees)) < math.radians(2)
    assert math.dist((value.x, value.y), (100, 50)) < 0.6


def test_round_spot_has_no_direction_and_can_be_followed(tmp_path: Path) -> None:
    picture = cv2.circle(board(), (60, 40), 20, 250, -1)
    follower = "present in: {follow: present, region: [-9, -9, 18, 18], grey: [240, 255]}"
    cell = f"{{present: {{{LIGHT}}}, {follower}}}"
    found = inspected(tmp_path, cell, picture)
    assert found.ok
    assert math.isnan(found.value.present_angle)
    assert found.value.in_area == 19 * 19  # centres on the border count


def test_colour_is_found_among_equal_greys(tmp_path: Path) -> None:
    picture = np.full((80, 120, 3), (0, 130, 0), np.uint8)  # a green about as bright as the red
    picture[30:50, 40:70] = (255, 0, 0)
    red = "present: {colour: {hue: [170, 10], saturation: [100, 255]}}"
    value = inspected(tmp_path, f"{{{red}}}", picture).value
    assert (value.count, value.x, value.y, value.area) == (1, 54.5, 39.5, 600)
    assert not inspected(tmp_path, f"{{{red}}}", picture[:, :, ::-1].copy()).ok


def test_grey_picture_is_never_good_for_its_colours(tmp_path: Path) -> None:
    colour = "colour: {hue: [170, 10], saturation: [100, 255]}"
    for count in ("0", "[0, 5]", "1"):
        found = inspected(tmp_path, f"{{present: {{{colour}, count: {count}}}}}", TWO)
        assert (found.ok, found.value.count) == (False, 0)
        assert "the picture has no colours" in found.reason


def test_polygon_region_counts_spots_inside(tmp_path: Path) -> None:
    picture = np.full((100, 200), 250, np.uint8)
    triangle = "[[20, 10], [60, 10], [20, 50]]"
    value = inspected(tmp_path, f"{{present: {{{LIGHT}, region: {triangle}}}}}", picture).value
    assert value.area == pytest.approx(800, rel=0.08)
    assert math.dist((value.x, value.y), (20 + 40 / 3, 10 + 40 / 3)) < 1
    square = inspected(tmp_path, f"{{present: {{{LIGHT}, region: [20, 10, 40, 30]}}}}", picture)
    assert (square.value.area, square.value.x, square.value.y) == (1200, 39.5, 24.5)
