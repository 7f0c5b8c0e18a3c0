"""Grids of markers: Kalibr's AprilGrid and OpenCV's GridBoard, their numbers and corners."""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np
import pytest

from smartcam.calibration import MarkerGrid, find_target, target_from_data, target_to_data
from smartcam.calibration._detection.marker_grids import marker_patterns
from smartcam.calibration._targets import resized
from smartcam.geometry._inside import Code
from tests.calibration.scenes import STRAIGHT, drawn, refused

APRIL = MarkerGrid.april_grid(columns=6, rows=4, tag=0.03, spacing=0.3)
PLAIN = MarkerGrid(columns=5, rows=4, marker=0.04, gap=0.01)
LATER = MarkerGrid(
    columns=4, rows=3, marker=0.04, gap=0.02, dictionary="DICT_APRILTAG_36h11", first_id=7
)

CODES = {0: 0xD5D628584, 1: 0xD97F18B49, 5: 0xF31DAB3AC, 23: 0x9F21CC2D7}
"""Tags of AprilTag's family 36h11 from its tables: 36 bits from the upper left on, a set bit is
white."""


@pytest.mark.parametrize("identity", CODES)
def test_tags_of_kalibr_are_those_of_apriltags_tables(identity: int) -> None:
    pattern = marker_patterns(APRIL)[identity]
    assert pattern.shape == (10, 10)
    inner = pattern[2:-2, 2:-2]
    assert pattern.sum() == 64 + inner.sum()  # a border of two black modules
    bits = [CODES[identity] >> (35 - place) & 1 for place in range(36)]
    assert (~inner).ravel().astype(int).tolist() == bits


def test_points_and_numbers_of_kalibrs_grid_are_those_of_its_description() -> None:
    # 2 x 2 tags of Kalibr: the lowest row of points is 0 to 3, tag 0 has the points 0, 1, 5, 4
    grid = MarkerGrid.april_grid(columns=2, rows=2, tag=0.1, spacing=0.3)
    np.testing.assert_allclose(grid.points[:4, 0], [0, 0.1, 0.13, 0.23])
    np.testing.assert_allclose(grid.points[::4, 1], [0, 0.1, 0.13, 0.23])
    assert [set(one) for one in grid.corners.tolist()] == [
        {0, 1, 4, 5},
        {2, 3, 6, 7},
        {8, 9, 12, 13},
        {10, 11, 14, 15},
    ]


def test_corners_of_a_grid_board_are_opencvs() -> None:
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.GridBoard((5, 4), 0.04, 0.01, known)
    theirs = np.array(board.getObjPoints())[:, :, :2]
    theirs[:, :, 1] = theirs[:, :, 1].max() - theirs[:, :, 1]  # its y points down
    np.testing.assert_allclose(PLAIN.points[PLAIN.corners, :2], theirs, atol=1e-7)


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("grid", [APRIL, PLAIN, LATER], ids=lambda one: one.dictionary)
@pytest.mark.parametrize(("tilt", "roll"), [(0, 0), (30, 70), (25, 200)])
def test_grid_has_each_corner_at_its_true_place(grid: MarkerGrid, tilt: int, roll: int) -> None:
    picture = drawn(grid, camera=STRAIGHT, tilt=tilt, roll=roll, away=0.4, noise=1)
    view = find_target(picture.image, grid, name="one")
    assert len(view.ids) >= 0.9 * len(grid.points)
    off = picture.off(view)
    assert np.sqrt((off**2).mean()) < 0.03
    assert (off < 0.05 + 4 * view.sigmas).all()
    assert (view.name, view.target, view.warnings) == ("one", grid, ())


def test_picture_that_opencv_draws_of_its_board_has_its_corners() -> None:
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.GridBoard((5, 4), 0.04, 0.01, known)
    image = cv2.copyMakeBorder(
        board.generateImage((500, 400), marginSize=5),
        40,
        40,
        40,
        40,
        cv2.BORDER_CONSTANT,
        value=255,
    )
    view = find_target(cv2.GaussianBlur(image, (0, 0), 0.8), PLAIN)
    assert len(view.ids) == 80
    first = view.points[PLAIN.corners[0]]
    assert np.linalg.norm(first - [44.5, 44.5], axis=1).min() < 3  # marker 0 is at the upper left
    middle = first.mean(axis=0)
    assert (first[0] < middle).all()


@pytest.mark.sampled(every=2)
@pytest.mark.parametrize("grid", [APRIL, PLAIN], ids=lambda one: one.dictionary)
def test_grid_of_which_a_part_is_hidden_has_the_rest(grid: MarkerGrid) -> None:
    picture = drawn(grid, camera=STRAIGHT, tilt=20, away=0.4)
    picture.image[:, :300] = 100
    view = find_target(picture.image, grid)
    assert 8 <= len(view.ids) < 0.7 * len(grid.points)
    assert picture.off(view).max() < 0.1


def test_grid_with_a_marker_of_another_place_leaves_it_out() -> None:
    picture = drawn(PLAIN, camera=STRAIGHT, away=0.5)
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    marker = cv2.copyMakeBorder(
        known.generateImageMarker(11, 24), 5, 5, 5, 5, cv2.BORDER_CONSTANT, value=235
    )
    picture.image[20:54, 40:74] = marker
    view = find_target(picture.image, PLAIN)
    assert picture.off(view).max() < 0.1
    (told,) = view.warnings
    assert told.code == Code.OUTLIER
    assert told.text.endswith(": 11")


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize(
    ("shown", "said", "code"),
    [
        (PLAIN, dataclasses.replace(PLAIN, columns=4), Code.WRONG_TARGET),
        (PLAIN, APRIL, Code.TARGET_NOT_FOUND),
        (APRIL, dataclasses.replace(APRIL, border=1), Code.TARGET_NOT_FOUND),
        (APRIL, dataclasses.replace(APRIL, columns=5), Code.WRONG_TARGET),
        (LATER, dataclasses.replace(LATER, kalibr=True), Code.WRONG_TARGET),
    ],
)
def test_grid_that_is_another_one_is_refused(
    shown: MarkerGrid, said: MarkerGrid, code: Code
) -> None:
    with refused(code, "markers"):
        find_target(drawn(shown, camera=STRAIGHT, tilt=15, away=0.4).image, said)


def test_grid_from_its_data_is_equal() -> None:
    for grid in (APRIL, PLAIN, LATER):
        assert target_from_data(target_to_data(grid)) == grid
    twice = resized(APRIL, 2.0)
    assert (twice.marker, twice.gap, twice.border, twice.first_id) == (0.06, 0.018, 2, 0)


@pytest.mark.parametrize(
    ("field", "value", "text"),
    [
        ("columns", 0, "columns to be a whole number of at least 1"),
        ("border", 0, "border to be a whole number of at least 1"),
        ("first_id", -1, "first_id to be a whole number of at least 0"),
        ("gap", 0.0, "gap to be a length in metres"),
        ("kalibr", 1, "kalibr to be True or False"),
        ("dictionary", 5, "the name of a dictionary"),
    ],
)
def test_grid_that_cannot_be_is_refused(field: str, value: Any, text: str) -> None:
    with refused(Code.SHAPE, text):
        dataclasses.replace(PLAIN, **{field: value})


def test_length_of_millimetres_is_asked_for() -> None:
    with refused(Code.UNIT_UNKNOWN, "marker_grid: expected marker to be a length of 1 m at most"):
        dataclasses.replace(PLAIN, marker=40.0)
