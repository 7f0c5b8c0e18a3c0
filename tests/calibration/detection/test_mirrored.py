"""Mirrored images are refused if and only if the print shows it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from smartcam.calibration import Charuco, Checkerboard, CircleGrid, find_target
from smartcam.calibration._inside import Target
from smartcam.geometry._inside import Code
from tests.calibration.scenes import drawn, refused


def board(columns: int, rows: int, *, mark: bool = False) -> Checkerboard:
    return Checkerboard(columns=columns, rows=rows, square=0.025, origin_mark=mark)


def dots(columns: int, rows: int, *, shifted: bool, larger: float | None = None) -> CircleGrid:
    return CircleGrid(
        columns=columns,
        rows=rows,
        spacing=0.04 if shifted else 0.02,
        diameter=0.01,
        asymmetric=shifted,
        origin_diameter=larger,
    )


TOLD: list[Target] = [
    board(9, 7),
    board(5, 3),
    board(9, 6, mark=True),
    dots(10, 8, shifted=False, larger=0.016),
    dots(4, 6, shifted=True),
    dots(4, 11, shifted=True, larger=0.016),
    Charuco(columns=8, rows=6, square=0.03, marker=0.02),
]
NOT_TOLD: list[Target] = [
    board(9, 6),
    board(8, 6),
    board(7, 7),
    board(7, 7, mark=True),
    dots(7, 7, shifted=False, larger=0.015),
    dots(4, 11, shifted=True),
    dots(4, 8, shifted=True),
    dots(4, 8, shifted=True, larger=0.016),
]


def short(targets: list[Target], *which: int) -> list[Any]:
    """Return targets, most of them for the long run only."""
    return [
        target if number in which else pytest.param(target, marks=pytest.mark.long)
        for number, target in enumerate(targets)
    ]


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("target", short(TOLD, 0, 4, 6), ids=repr)
def test_find_target_in_mirror_image_is_refused(target: Target, axis: int) -> None:
    image = drawn(target, tilt=25, roll=70).image
    with refused(Code.MIRRORED, "mirrored"):
        find_target(np.ascontiguousarray(np.flip(image, axis)), target)


@pytest.mark.parametrize("target", short(TOLD, 0, 4, 6), ids=repr)
def test_find_target_of_an_asymmetric_target_keeps_its_orientation(target: Target) -> None:
    picture = drawn(target, tilt=25, roll=70)
    assert picture.off(find_target(picture.image, target)).max() < 0.02


@pytest.mark.parametrize("target", short(NOT_TOLD, 0), ids=repr)
def test_find_target_in_mirror_image_that_looks_like_a_turned_one_is_found(target: Target) -> None:
    picture = drawn(target, tilt=25, roll=70)
    view = find_target(np.ascontiguousarray(picture.image[:, ::-1]), target)
    # the points are the same ones, but for their numbers
    mirrored = picture.pixels * (-1, 1) + (639, 0)
    apart = np.linalg.norm(view.points[:, None] - mirrored, axis=2)
    assert apart.min(axis=1).max() < 0.03
    assert not (apart.argmin(axis=1) == np.arange(len(mirrored))).all()


def test_find_target_of_exchanged_counts_reports_them() -> None:
    text = "got a white one: an image that is mirrored, or a negative, or the board is one of 9 x 7"
    with refused(Code.MIRRORED, "checkerboard of 7 x 9 corners: expected a black square", text):
        find_target(drawn(board(9, 7)).image, board(7, 9))
