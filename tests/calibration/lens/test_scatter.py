"""The error of a lens from views with common errors: simulation with known truth."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
import pytest

from smartcam.calibration import Checkerboard, calibrate_intrinsics, compare_lenses
from smartcam.calibration._inside import Lens, compare_estimates
from smartcam.geometry._inside import Code
from tests.calibration.inside import half_turned, lens_values, with_lens
from tests.calibration.lens.estimates import spread_poses
from tests.calibration.lenskit import BOARD, FISHEYE, LEFT, poses, seen

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.calibration import TargetView, Transform


def bent_anew(around: list[Transform], seed: int) -> list[TargetView]:
    """Return views of a sheet that bends by another half a millimetre in each."""
    random, views = np.random.default_rng(seed), []
    x, y = ((BOARD.points - BOARD.points.mean(axis=0)) / 0.1).T[:2]
    for number, pose in enumerate(around):
        points = BOARD.points.copy()
        points[:, 2] = 4e-4 * random.normal(size=3) @ [x**2, x * y, y**2]
        views += seen(LEFT, [pose], seed=1000 * seed + number, points=points)
    return views


def rolled(around: list[Transform], seed: int) -> list[TargetView]:
    """Return views of a moving sheet, whose rows were not exposed at once."""
    random, views = np.random.default_rng(seed), seen(LEFT, around, seed=seed)
    return [
        dataclasses.replace(
            one, points=one.points + (one.points[:, 1:] / 480 - 0.5) * random.normal(size=2)
        )
        for one in views
    ]


@pytest.mark.long
@pytest.mark.parametrize("views_of", [bent_anew, rolled], ids=["bent anew", "rolling shutter"])
def test_predicted_uncertainty_is_right_for_views_with_common_errors(
    views_of: Callable[[list[Transform], int], list[TargetView]],
) -> None:
    around = spread_poses(LEFT, 16)
    found = [calibrate_intrinsics(views_of(around, seed), sheet="exact") for seed in range(30)]
    lenses = np.array([lens_values(one.camera) for one in found])
    middle = Lens(with_lens(LEFT, lenses.mean(axis=0)), np.zeros((9, 9)), found[0].target_points)
    compared = [compare_estimates(Lens.of(one), middle, distance=0.5) for one in found]
    observed = np.mean([one.difference**2 for one in compared], axis=0).sum(axis=2)
    predicted = np.mean([one.predicted.rms**2 for one in compared if one.predicted])
    assert np.sqrt(2 * predicted / observed.mean()) == pytest.approx(1.0, abs=0.15)


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize(
    "views_of",
    [bent_anew, rolled, lambda around, seed: seen(FISHEYE, poses(10, distance=0.2), seed=seed)],
    ids=["bent anew", "rolling shutter", "another model"],
)
def test_misfit_of_other_causes_is_not_taken_for_flips_or_a_zoom(
    views_of: Callable[[list[Transform], int], list[TargetView]],
) -> None:
    for seed in range(2):
        found = calibrate_intrinsics(views_of(spread_poses(LEFT, 8), seed))
        assert {Code.MIRRORED, Code.WRONG_LENS}.isdisjoint(one.code for one in found.warnings)


def test_zoom_between_views_is_reported_with_the_rejected_causes() -> None:
    matrix = LEFT.matrix.copy()
    matrix[[0, 1], [0, 1]] *= 1.05
    around = spread_poses(LEFT, 12)
    zoomed = seen(dataclasses.replace(LEFT, matrix=matrix), around)[7:]
    views = seen(LEFT, around)
    resized = [dataclasses.replace(one, points=0.99 * one.points) for one in views[7:]]
    for others in (zoomed, resized):
        found = calibrate_intrinsics([*views[:7], *others])
        (remark,) = [one for one in found.warnings if one.code == Code.WRONG_LENS]
        assert "those from 07 on do not fit those before: was the zoom" in remark.text
        assert "sheets that bend anew" in remark.text


@pytest.mark.long
def test_held_out_error_near_a_singular_lens_is_that_of_refits() -> None:
    views = bent_anew(poses(12), 4)
    found = calibrate_intrinsics(views, distortion_model="rational_polynomial", sheet="exact")
    for number in (0, 11):
        rest = [*views[:number], *views[number + 1 :]]
        again = calibrate_intrinsics(rest, distortion_model="rational_polynomial", sheet="exact")
        (errors,) = again.point_errors([views[number]])
        rms = np.sqrt((errors**2).sum() / (errors.size - 6))
        assert found.views[number].held_out == pytest.approx(rms, rel=0.1)


def test_halves_of_views_with_common_errors_give_the_same_lens() -> None:
    found = [calibrate_intrinsics(rolled(spread_poses(LEFT, 10), seed)) for seed in (1, 2)]
    compared = compare_lenses(*found)
    assert compared.same
    assert compared.ratio is not None
    assert compared.ratio < 2.0


@pytest.mark.judged
def test_views_that_number_a_board_from_its_other_end_are_numbered_as_the_rest() -> None:
    """A sheet that bends to one side shows its ends, whose numbers a picture does not show."""
    board = Checkerboard(columns=8, rows=6, square=0.025)
    across = (board.points[:, 0] - 0.0875) / 0.0875
    bent = board.points + np.outer(6e-4 * across**3, [0.0, 0.0, 1.0])
    views = seen(LEFT, poses(12), target=board, points=bent)
    other = {1, 3, 4, 8, 9}
    mixed = [half_turned(one) if number in other else one for number, one in enumerate(views)]
    mixed = [dataclasses.replace(one, name=f"v{number}") for number, one in enumerate(mixed)]
    found = calibrate_intrinsics(mixed)
    assert found.sheet is not None
    assert found.camera.matrix[0, 0] == pytest.approx(LEFT.matrix[0, 0], rel=2e-3)
    assert found.rms < 2 * calibrate_intrinsics(views).rms
    assert "v1, v3, v4, v8, v9 numbered it from its other end" in found.warnings[-1].text


def test_views_that_all_differ_a_little_are_not_called_views_of_two_settings() -> None:
    random, middle = np.random.default_rng(2), LEFT.matrix[:2, 2]
    views = [
        dataclasses.replace(
            view, points=middle + (1 + random.normal(0, 0.003)) * (view.points - middle)
        )
        for view in seen(LEFT, spread_poses(LEFT, 12), seed=2)
    ]
    remarks = calibrate_intrinsics(views).warnings
    assert not [remark.text for remark in remarks if "two settings" in remark.text]
