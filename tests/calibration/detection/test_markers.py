"""Markers on a board: each number is checked by its neighbours, and contradictions are reported."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from smartcam.calibration import Charuco, TargetView, find_target
from smartcam.exceptions import CalibrationError
from smartcam.geometry._inside import Code
from tests.calibration.inside import Markers, compare_with_board
from tests.calibration.scenes import BENT, STRAIGHT, Drawn, drawn, refused

NEW = Charuco(columns=9, rows=6, square=0.03, marker=0.02, dictionary="DICT_4X4_50")
LEGACY = dataclasses.replace(NEW, legacy_pattern=True)
BOARD = np.array([[x, y] for y in range(4) for x in range(5)], dtype=np.float64)[
    :, None
] + np.array([[-0.3, 0.3], [0.3, 0.3], [0.3, -0.3], [-0.3, -0.3]])
"""(20, 4, 2), markers in rows of five, a unit apart."""


def seen(ids: list[int], *, turn: float = 0.3, scale: float = 40.0) -> Markers:
    """Return the markers of BOARD with these numbers, seen from the side."""
    c, s = np.cos(turn), np.sin(turn)
    flat = BOARD[ids].reshape(-1, 2)
    depth = 1 + 0.05 * flat[:, :1] + 0.03 * flat[:, 1:]
    pixels = scale * flat @ np.array([[c, s], [-s, c]]) / depth + 200
    return Markers(pixels.reshape(-1, 4, 2), np.array(ids))


def test_agreeing_of_a_right_board_has_all_markers() -> None:
    good, contrary = compare_with_board(seen(list(range(20))), BOARD)
    assert good.all()
    assert contrary == 0


@pytest.mark.parametrize("wrong", [0, 7, 12, 19])
@pytest.mark.parametrize("read", [1, 6, 13, 18, 33])
def test_agreeing_leaves_out_a_marker_with_another_number(wrong: int, read: int) -> None:
    markers = seen(list(range(20)))
    markers.ids[wrong] = read
    good, contrary = compare_with_board(markers, BOARD)
    there = markers.ids == np.arange(20)
    assert good.tolist() == there.tolist()
    assert contrary <= 1


def test_agreeing_leaves_out_a_marker_that_is_turned() -> None:
    markers = seen(list(range(20)))
    markers.quads[8] = np.roll(markers.quads[8], 1, axis=0)
    assert np.flatnonzero(~compare_with_board(markers, BOARD).mask).tolist() == [8]


@pytest.mark.parametrize("ids", [[], [3], [3, 44], [44, 45]])
def test_agreeing_of_fewer_than_two_of_the_board_is_none(ids: list[int]) -> None:
    markers = Markers(np.zeros((len(ids), 4, 2)) + np.eye(4, 2), np.array(ids, dtype=np.intp))
    good, contrary = compare_with_board(markers, BOARD)
    assert not good.any()
    assert contrary == 0


def test_agreeing_joins_the_parts_beside_a_hand() -> None:
    board = np.concatenate([BOARD, BOARD + np.array([9, 0])])
    good, contrary = compare_with_board(Markers(50 + 40 * board, np.arange(40)), board)
    assert good.all()
    assert contrary == 0


def test_agreeing_of_rows_of_another_length_speaks_against_the_map() -> None:
    markers = seen(list(range(20)))
    narrow = BOARD.reshape(4, 5, 4, 2)[:, :4].reshape(-1, 4, 2)
    good, contrary = compare_with_board(markers, narrow)
    assert good.sum() == 4
    assert contrary >= 3


# ---------------------------------------------------------------------- ChArUco boards


def covered(picture: Drawn, columns: range, target: Charuco) -> Drawn:
    """Return a picture in which the markers of some columns of squares are white."""
    flat = (np.array([[columns.start, 0], [columns.stop, target.rows]]) - 1) * target.square
    (left, low), (right, high) = flat
    outline = np.array([[left, low], [right, low], [right, high], [left, high]])
    matrix, _ = cv2.findHomography(target.points[:, :2], picture.pixels)
    seen = cv2.perspectiveTransform(outline[None], matrix)[0]
    cv2.fillConvexPoly(picture.image, np.rint(seen).astype(np.int32), 235)
    return picture


@pytest.mark.sampled(every=5)
@pytest.mark.parametrize("said", [NEW, LEGACY])
@pytest.mark.parametrize(
    ("columns", "rows", "hidden"), [(9, 6, 0), (9, 6, 2), (8, 6, 0), (7, 4, 0), (8, 6, 3)]
)
def test_find_charuco_of_the_other_pattern_names_both(
    said: Charuco, columns: int, rows: int, hidden: int
) -> None:
    said = dataclasses.replace(said, columns=columns, rows=rows)
    there = dataclasses.replace(said, legacy_pattern=not said.legacy_pattern)
    picture = drawn(there, camera=STRAIGHT, tilt=20)
    if hidden:
        # only the markers at one side show it: those at the left of the new pattern's rows, and
        # those at the right of the legacy pattern's
        side = range(columns - hidden, columns) if said.legacy_pattern else range(hidden)
        picture = covered(picture, side, there)
    text = f"legacy_pattern={said.legacy_pattern}", f"legacy_pattern={there.legacy_pattern}"
    with refused(Code.WRONG_TARGET, *text):
        find_target(picture.image, said)
    assert picture.off(find_target(picture.image, there)).max() < 0.1


def test_find_charuco_of_other_counts_is_another_board() -> None:
    said = dataclasses.replace(NEW, columns=8)
    with refused(Code.WRONG_TARGET, "charuco of 8 x 6 squares", "other numbers of columns"):
        find_target(drawn(NEW, tilt=20).image, said)


def test_find_charuco_of_two_alike_boards_is_refused() -> None:
    small = drawn(NEW, tilt=20, away=0.9).image
    image = np.hstack([small[:, 150:490], small[:, 150:490]])
    with refused(Code.WRONG_TARGET, "several boards with the same numbers"):
        find_target(image, NEW)


def test_find_charuco_with_a_hand_in_the_middle_has_both_sides() -> None:
    wide = dataclasses.replace(NEW, columns=14, rows=5, square=0.02, marker=0.015)
    picture = covered(drawn(wide, tilt=30), range(4, 10), wide)
    view = find_target(picture.image, wide)
    assert {0, 12} <= set(view.ids.tolist())
    assert picture.off(view).max() < 0.1
    assert view.warnings == ()


def wild(picture: Drawn, numbers: list[int], side: int = 24) -> Drawn:
    """Return a picture with markers of the board's dictionary around it, along the upper edge."""
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for place, number in enumerate(numbers):
        marker = known.generateImageMarker(number, side, borderBits=1)
        marker = cv2.copyMakeBorder(marker, 5, 5, 5, 5, cv2.BORDER_CONSTANT, value=235)
        left = 4 + place * (side + 20)
        picture.image[4 : 4 + len(marker), left : left + len(marker)] = marker
    return picture


def test_find_charuco_leaves_misplaced_markers_out_with_a_remark() -> None:
    picture = wild(drawn(NEW, tilt=20, away=0.6), [3, 11, 26])
    view = find_target(picture.image, NEW)
    assert len(view.ids) == len(NEW.points)
    assert picture.off(view).max() < 0.1
    (told,) = view.warnings
    assert told.code == Code.OUTLIER
    assert "3, 11, 26" in told.text
    again = TargetView.from_data(view.to_data(), target=NEW)
    assert again.warnings == view.warnings


def test_find_charuco_of_one_marker_is_not_found() -> None:
    picture = covered(drawn(NEW, tilt=20), range(1, 9), NEW)
    cv2.rectangle(picture.image, (0, 0), (639, 250), 235, -1)
    with refused(Code.TARGET_NOT_FOUND, "found 0 corners and"):
        find_target(picture.image, NEW)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(20))
def test_find_charuco_among_wild_markers_has_no_corner_with_a_wrong_number(seed: int) -> None:
    rng = np.random.default_rng(seed)
    target = dataclasses.replace(NEW, columns=int(rng.integers(5, 10)))
    picture = drawn(
        target,
        camera=BENT,
        tilt=rng.uniform(0, 60),
        roll=rng.uniform(0, 360),
        away=rng.uniform(0.4, 0.8),
        noise=4,
    )
    numbers = rng.integers(0, 50, 12).tolist()
    try:
        view = find_target(wild(picture, numbers).image, target)
    except CalibrationError as exc:
        assert exc.code in {Code.TARGET_NOT_FOUND, Code.WRONG_TARGET}  # noqa: PT017 - or few seen
        return
    assert picture.off(view).max() < 2
