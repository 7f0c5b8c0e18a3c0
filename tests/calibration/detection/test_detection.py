"""Targets in images are found, with the right numbers, points and origin."""

from __future__ import annotations

import dataclasses
import zipfile
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from smartcam.calibration import Charuco, Checkerboard, CircleGrid, find_target
from smartcam.calibration._detection.ordering import (
    Arrangement,
    choose_marked,
    choose_rightward,
    find_arrangements,
    positions_row_by_row,
)
from smartcam.calibration._detection.sampling import mean_level
from smartcam.calibration._inside import Target
from smartcam.exceptions import CalibrationError
from smartcam.geometry._inside import Code
from tests import ROOT
from tests.calibration.inside import area_test, grey_image, grow_grids, resize_image
from tests.calibration.scenes import STRAIGHT, check_pair, drawn, refused

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array

PLAIN = Checkerboard(columns=9, rows=6, square=0.025)
DARK = Checkerboard(columns=9, rows=7, square=0.025, origin_mark=True)
CHARUCO = Charuco(columns=8, rows=6, square=0.03, marker=0.02)
DOTS = CircleGrid(columns=10, rows=8, spacing=0.02, diameter=0.01, origin_diameter=0.016)
TARGETS: list[Target] = [
    PLAIN,
    DARK,
    Checkerboard(columns=7, rows=7, square=0.025, origin_mark=True),
    CHARUCO,
    Charuco(columns=8, rows=6, square=0.03, marker=0.02, legacy_pattern=True),
    Charuco(columns=5, rows=7, square=0.03, marker=0.018, dictionary="DICT_4X4_50"),
    DOTS,
    CircleGrid(columns=7, rows=7, spacing=0.02, diameter=0.01, origin_diameter=0.015),
    CircleGrid(columns=4, rows=11, spacing=0.04, diameter=0.014, asymmetric=True),
    CircleGrid(
        columns=5, rows=10, spacing=0.04, diameter=0.014, asymmetric=True, origin_diameter=0.02
    ),
]


ROLLS = (0, 70, 200)
TILTED = [(target, ROLLS[number % 3]) for number, target in enumerate(TARGETS)]
OTHERS = [
    *TILTED[2:10:3],
    *((target, ROLLS[(number + 1) % 3]) for number, target in enumerate(TARGETS)),
]
TILTED = [one for one in TILTED if one not in OTHERS]


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize(
    ("target", "roll"), [*TILTED, *(pytest.param(*one, marks=pytest.mark.long) for one in OTHERS)]
)
def test_find_target_of_tilted_sheet_has_true_places(target: Target, roll: int) -> None:
    picture = drawn(target, tilt=35, roll=roll)
    view = find_target(picture.image, target, name="one")
    assert view.ids.tolist() == list(range(len(target.points)))
    assert picture.off(view).max() < 0.02
    assert (view.name, view.size, view.target) == ("one", (640, 480), target)


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("target", [PLAIN, CHARUCO, DOTS], ids=repr)
def test_find_target_covariance_is_that_of_its_errors(target: Target) -> None:
    picture = drawn(target, camera=STRAIGHT, tilt=25, roll=10, noise=4)
    view = find_target(picture.image, target)
    off = view.points - picture.pixels
    squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(view.covariance), off)
    assert 0.5 < squares.mean() / 2 < 1.5
    assert 0.005 < view.sigmas.mean() < 0.025


@pytest.mark.parametrize("tilt", [0, 40])
def test_find_target_in_colour_and_in_16_bits_is_the_same(tilt: int) -> None:
    picture = drawn(PLAIN, tilt=tilt)
    grey = find_target(picture.image, PLAIN).points
    colour = cv2.cvtColor(picture.image, cv2.COLOR_GRAY2BGR)
    deep = picture.image.astype(np.uint16) * 16
    np.testing.assert_allclose(find_target(colour, PLAIN).points, grey, atol=1e-9)
    np.testing.assert_allclose(find_target(deep, PLAIN).points, grey, atol=5e-3)


STEEP = [(PLAIN, 0), (DARK, 130), (DARK, 0), (DOTS, 45), (TARGETS[8], 0), (TARGETS[8], 130)]


@pytest.mark.parametrize(
    ("target", "roll"),
    [(PLAIN, 45), (DOTS, 130), *(pytest.param(*one, marks=pytest.mark.long) for one in STEEP)],
)
def test_find_target_of_steep_far_and_noisy_sheet_has_its_points(target: Target, roll: int) -> None:
    picture = drawn(target, tilt=60, roll=roll, away=0.7, blur=1.2, noise=4)
    off = picture.off(find_target(picture.image, target))
    assert off.max() < 0.3
    assert np.sqrt((off**2).mean()) < 0.08


def test_find_target_leaves_a_covered_corner_out() -> None:
    picture = drawn(PLAIN, tilt=20)
    u, v = np.rint(picture.pixels[31]).astype(int)
    cv2.circle(picture.image, (int(u) + 3, int(v) - 2), 7, 120, -1)
    view = find_target(picture.image, PLAIN)
    assert view.ids.tolist() == [one for one in range(54) if one != 31]
    assert picture.off(view).max() < 0.02


def test_find_charuco_with_small_markers_is_found() -> None:
    target = Charuco(columns=8, rows=6, square=0.03, marker=0.02, dictionary="DICT_4X4_50")
    picture = drawn(target, tilt=10, away=0.9)
    view = find_target(picture.image, target)
    assert len(view.ids) > 20
    assert picture.off(view).max() < 0.1


def test_find_target_in_large_image_is_as_exact() -> None:
    small = drawn(PLAIN, tilt=30)
    large = cv2.resize(small.image, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    view = find_target(large, PLAIN)
    off = (view.points + 0.5) / 4 - 0.5 - small.pixels
    assert view.size == (2560, 1920)
    assert np.abs(off).max() < 0.03


def test_find_target_without_marks_has_its_origin_at_a_black_square() -> None:
    picture = drawn(PLAIN, roll=180)
    view = find_target(picture.image, PLAIN)
    assert picture.off(view).max() < 0.01
    assert view.points[0, 0] > view.points[8, 0]
    assert view.margin is None


@pytest.mark.parametrize("roll", [0, 180])
def test_find_target_that_looks_alike_when_turned_has_x_to_the_right(roll: int) -> None:
    target = Checkerboard(columns=8, rows=6, square=0.025)
    view = find_target(drawn(target, roll=roll).image, target)
    assert view.points[7, 0] > view.points[0, 0]
    assert view.points[8, 1] < view.points[0, 1]


def test_find_target_of_a_negative_is_found_all_the_same() -> None:
    target = Checkerboard(columns=8, rows=6, square=0.025)
    picture = drawn(target)
    view = find_target(255 - picture.image, target)
    assert picture.off(view).max() < 0.01


@pytest.mark.parametrize("target", [DARK, DOTS], ids=repr)
def test_find_target_margin_is_the_marks_contrast(target: Target) -> None:
    view = find_target(drawn(target, tilt=20).image, target)
    assert view.margin is not None
    assert 140 < view.margin < 181


@pytest.mark.parametrize(
    "dictionary", [pytest.param("DICT_5X5_250", marks=pytest.mark.long), "DICT_4X4_50"]
)
def test_find_charuco_in_mirror_image_is_refused(dictionary: str) -> None:
    target = dataclasses.replace(CHARUCO, dictionary=dictionary)
    image = np.ascontiguousarray(drawn(target).image[:, ::-1])
    with refused(Code.MIRRORED, "charuco of 8 x 6 squares: expected an image", "mirrored"):
        find_target(image, target)


def test_find_charuco_of_empty_image_is_not_found() -> None:
    with refused(
        Code.TARGET_NOT_FOUND, "8 x 6 squares, found 0 corners and 0 markers of its dictionary"
    ):
        find_target(np.full((480, 640), 128, dtype=np.uint8), CHARUCO)


def test_find_target_whose_dark_area_is_not_there_is_ambiguous() -> None:
    plain = Checkerboard(columns=9, rows=7, square=0.025)
    text = "expected the origin to be darker than the other corners by 30 grey levels of 255, got"
    with refused(Code.AMBIGUOUS_ORIGIN, text):
        find_target(drawn(plain).image, DARK)


def test_find_target_whose_larger_dot_is_not_there_is_ambiguous() -> None:
    plain = CircleGrid(columns=10, rows=8, spacing=0.02, diameter=0.01)
    with refused(Code.AMBIGUOUS_ORIGIN, "10 x 8 dots, of which the larger one is the origin"):
        find_target(drawn(plain).image, DOTS)


def test_find_target_of_other_board_reports_the_board_in_the_image() -> None:
    wanted = Checkerboard(columns=10, rows=7, square=0.025)
    text = "expected a board of 10 x 7 inner corners that is seen as a whole, found one of about"
    with pytest.raises(CalibrationError, match=text) as caught:
        find_target(drawn(PLAIN).image, wanted)
    assert caught.value.code == Code.TARGET_NOT_FOUND
    assert caught.value.got in ((9, 6), (6, 9))


def test_find_target_of_an_empty_image_reports_that() -> None:
    empty = np.full((480, 640), 128, dtype=np.uint8)
    with refused(Code.TARGET_NOT_FOUND, "9 x 6 inner corners", "found none"):
        find_target(empty, PLAIN)
    with refused(Code.TARGET_NOT_FOUND, "8 x 6 squares, found 0"):
        find_target(empty, CHARUCO)
    with refused(Code.TARGET_NOT_FOUND, "expected 10 x 8 dots, saw 0 dark spots and no such grid"):
        find_target(empty, DOTS)


def test_find_target_of_covered_dots_reports_the_visible_number() -> None:
    picture = drawn(DOTS)
    u, v = np.rint(picture.pixels[35]).astype(int)
    cv2.circle(picture.image, (int(u), int(v)), 11, 210, -1)
    with refused(Code.TARGET_NOT_FOUND, "expected 10 x 8 dots, saw 79 dark spots"):
        find_target(picture.image, DOTS)


def test_find_charuco_of_covered_board_has_the_corners_that_are_seen() -> None:
    picture = drawn(CHARUCO, tilt=20)
    covered = picture.pixels[10]
    u, v = np.rint(covered).astype(int)
    cv2.circle(picture.image, (int(u), int(v)), 15, 90, -1)
    view = find_target(picture.image, CHARUCO)
    assert 10 not in view.ids
    assert len(view.ids) >= 30
    assert picture.off(view).max() < 0.05


def test_find_charuco_of_unknown_dictionary_is_refused() -> None:
    target = Charuco(columns=8, rows=6, square=0.03, marker=0.02, dictionary="DICT_9X9")
    with refused(Code.SHAPE, "dictionaries such as DICT_5X5_250, got 'DICT_9X9'"):
        find_target(np.zeros((480, 640), np.uint8), target)


def test_find_charuco_of_too_small_dictionary_is_refused() -> None:
    target = Charuco(columns=12, rows=12, square=0.03, marker=0.02, dictionary="DICT_4X4_50")
    with refused(Code.SHAPE, "expected at least 72 markers in DICT_4X4_50, got 50"):
        find_target(np.zeros((480, 640), np.uint8), target)


@pytest.mark.parametrize(
    ("image", "got"),
    [
        (np.zeros((480, 640)), "float64 of shape (480, 640)"),
        (np.zeros((480, 640, 4), np.uint8), "uint8 of shape (480, 640, 4)"),
        (np.zeros(640, np.uint8), "uint8 of shape (640,)"),
        (np.zeros((8, 640), np.uint8), "uint8 of shape (8, 640)"),
        (None, "NoneType"),
        ("left01.jpg", "str"),
    ],
)
def test_find_target_in_no_image_is_refused(image: object, got: str) -> None:
    with refused(Code.SHAPE, "image: expected an array of uint8 or uint16", got):
        find_target(image, PLAIN)


def test_find_target_of_no_target_is_refused() -> None:
    with refused(Code.SHAPE, "expected a Checkerboard, Charuco, CircleGrid or MarkerGrid, got str"):
        find_target(np.zeros((480, 640), np.uint8), "board")  # type: ignore[arg-type]


@pytest.mark.parametrize("count", [1, 2])
def test_find_target_of_two_equal_boards_is_refused(count: int) -> None:
    view = find_target(np.hstack([drawn(DARK).image] * count), DARK)
    assert [one.code for one in view.warnings] == [Code.WRONG_TARGET] * (count - 1)


def test_find_target_without_its_origin_area_in_the_image_is_refused() -> None:
    picture = drawn(DARK)
    left = round(picture.pixels[0, 0] - 1.1 * np.ptp(picture.pixels[:2, 0]))
    text = "at the origin (2 of its 4 possible places outside of the image): expected the origin"
    with refused(Code.AMBIGUOUS_ORIGIN, text):
        find_target(np.ascontiguousarray(picture.image[:, left:]), DARK)


def test_find_target_with_other_areas_outside_of_the_image_has_its_origin() -> None:
    picture = drawn(DARK, roll=180)
    left = round(picture.pixels[8, 0] - 1.1 * np.ptp(picture.pixels[:2, 0]))
    picture.image[:, : left + 3] = 0
    view = find_target(np.ascontiguousarray(picture.image[:, left:]), DARK)
    assert np.abs(view.points - picture.pixels + np.array([left, 0])).max() < 0.02


@pytest.mark.parametrize("roll", [0, 180])
def test_find_target_in_uneven_light_has_its_origin(roll: int) -> None:
    picture = drawn(DARK, roll=roll)
    light = np.linspace(1.0, 0.2, 640)
    view = find_target((picture.image * light).astype(np.uint8), DARK)
    assert picture.off(view).max() < 0.1


# ----------------------------------------------------------------------
# Numbers of the points of a grid.


GRIDS = [
    (CircleGrid(columns=6, rows=4, spacing=0.02, diameter=0.01), 4, 2),
    (CircleGrid(columns=5, rows=5, spacing=0.02, diameter=0.01), 8, 4),
    (CircleGrid(columns=4, rows=11, spacing=0.04, diameter=0.01, asymmetric=True), 2, 1),
    (CircleGrid(columns=4, rows=6, spacing=0.04, diameter=0.01, asymmetric=True), 2, 2),
    (CircleGrid(columns=5, rows=10, spacing=0.04, diameter=0.01, asymmetric=True), 4, 2),
]


def laid_out(points: Array) -> NDArray[np.intp]:
    """Return the places (N, 2) of points that are a grid."""
    (grid,) = grow_grids(
        points, area_test(np.ones(len(points))), min_count=len(points), max_count=len(points)
    )
    places = np.zeros((len(points), 2), dtype=np.intp)
    places[list(grid.values())] = list(grid)
    return places


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize(("grid", "count", "proper"), GRIDS, ids=repr)
def test_arrangements_of_shuffled_points_are_those_that_look_alike(
    grid: CircleGrid, count: int, proper: int
) -> None:
    pixels = drawn(grid, tilt=40, roll=25).pixels
    shuffled = np.random.default_rng(1).permutation(len(pixels))
    found = pixels[shuffled]
    ways = find_arrangements(found, laid_out(found), grid)
    assert (len(ways), sum(way.is_front for way in ways)) == (count, proper)
    numbered = [way.order.ravel().tolist() for way in ways if way.is_front]
    assert np.argsort(shuffled).tolist() in numbered


def test_arrangements_of_other_counts_are_none() -> None:
    grid, other = GRIDS[0][0], CircleGrid(columns=8, rows=3, spacing=0.02, diameter=0.01)
    pixels = drawn(grid).pixels
    assert find_arrangements(pixels, laid_out(pixels), other) == []


def test_arrangements_of_a_grid_with_a_point_too_many_are_none() -> None:
    board = Checkerboard(columns=5, rows=4, square=0.02)
    pixels, places = drawn(board).pixels, positions_row_by_row(5, 4)
    more = np.vstack([pixels, pixels[:1] - 30]), np.vstack([places, [[-1, 0]]])
    assert find_arrangements(pixels, places, board) != []
    assert find_arrangements(*more, board) == []


def test_rows_of_counts_columns_first() -> None:
    assert positions_row_by_row(3, 2).tolist() == [[0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 1]]


def test_leftmost_is_proper_and_points_right() -> None:
    order = np.zeros((1, 1), dtype=np.intp)
    ways = [
        Arrangement(order, is_front=False, rightward=1.0),
        Arrangement(order, is_front=True, rightward=-0.9),
        Arrangement(order, is_front=True, rightward=0.9),
    ]
    assert choose_rightward(ways, "board") is ways[2]
    with refused(Code.MIRRORED, "board: expected an image of the sheet as one reads it"):
        choose_rightward(ways[:1], "board")


@pytest.mark.parametrize(("levels", "origin"), [([40, 200, 190, 180], 0), ([9, 9, 0, 200], None)])
def test_marked_takes_the_darkest_by_a_margin(levels: list[float], origin: int | None) -> None:
    board = Checkerboard(columns=5, rows=4, square=0.02)
    pixels = drawn(board).pixels
    ways = find_arrangements(pixels, positions_row_by_row(5, 4), board)
    corners = [0, 4, 19, 15]

    def level(order: np.ndarray) -> float:
        return levels[corners.index(int(order[0, 0]))]

    if origin is None:
        with refused(Code.AMBIGUOUS_ORIGIN, "by 30 grey levels of 255, got 9"):
            choose_marked(ways, level, "board")
    else:
        way, margin = choose_marked(ways, level, "board")
        assert (way.order[0, 0], margin) == (0, 140)


# ----------------------------------------------------------------------
# Images for detectors.


def test_grey_image_of_bytes_keeps_them() -> None:
    image = np.arange(20 * 30, dtype=np.uint16).reshape(20, 30).astype(np.uint8)
    grey = grey_image(image)
    np.testing.assert_array_equal(grey.uint8_levels, image)
    np.testing.assert_array_equal(grey.levels, image)
    assert grey.size == (30, 20)
    assert grey.levels.dtype == np.float32


@pytest.mark.parametrize("brightest", [1023, 4095, 65535])
def test_grey_image_of_16_bits_fills_255_with_its_brightest(brightest: int) -> None:
    image = np.zeros((20, 30), dtype=np.uint16)
    image[0, :2] = (brightest, brightest // 2)
    grey = grey_image(image)
    assert grey.uint8_levels[0, 0] == 255
    assert grey.levels[0, 1] == pytest.approx(127.5, abs=0.2)


def test_grey_image_of_black_16_bits_is_black() -> None:
    assert grey_image(np.zeros((20, 30), dtype=np.uint16)).uint8_levels.max() == 0


def test_grey_image_of_colours_weighs_blue_green_red() -> None:
    image = np.zeros((16, 16, 3), dtype=np.uint8)
    image[:, :, 2] = 200
    assert grey_image(image).uint8_levels[0, 0] == round(0.299 * 200)


def test_grey_image_of_a_cut_of_an_image_is_contiguous() -> None:
    image = np.zeros((64, 64), dtype=np.uint8)[::2, ::2]
    assert grey_image(image).uint8_levels.flags.c_contiguous


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_scaled_image_has_its_stated_places(scale: float) -> None:
    image = np.repeat(np.arange(0, 240, 4, dtype=np.uint8)[None], 40, axis=0)
    bytes_ = resize_image(image, scale)
    assert bytes_.shape == (40 * scale, 60 * scale)
    at = np.arange(4, 60 * scale - 4)
    places = (at + 0.5) / scale - 0.5
    np.testing.assert_allclose(bytes_[8, 4:-4], 4 * places, atol=1)


def test_mean_level_is_between_pixels_and_goes_on_beyond_the_rim() -> None:
    image = np.repeat(np.arange(0, 200, 10, dtype=np.uint8)[None], 20, axis=0)
    grey = grey_image(image)
    assert mean_level(grey, np.array([[4.5, 3.0], [6.5, 8.5]])) == pytest.approx(55, abs=0.2)
    assert mean_level(grey, np.array([[-5.0, 3.0]])) == 0
    assert mean_level(grey, np.array([[30.0, 90.0]])) == 190


# ---------------------------------------------------------------------- real images


ODD_PAIRS = ROOT / "tests" / "data" / "opencv_pairs" / "pairs.zip"


def test_find_target_in_a_pair_has_the_same_origin_in_both() -> None:
    with zipfile.ZipFile(ODD_PAIRS) as pairs:
        for number in range(1, 15, 2):
            left, right = (
                cv2.imdecode(np.frombuffer(pairs.read(f"{side}{number:02}.jpg"), np.uint8), 1)
                for side in ("left", "right")
            )
            check_pair(np.asarray(left, np.uint8), np.asarray(right, np.uint8), f"pair {number}")
