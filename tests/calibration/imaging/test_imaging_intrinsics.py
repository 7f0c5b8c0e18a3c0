from __future__ import annotations

import dataclasses
import functools
import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from lenskit import BOARD, FISHEYE, LEFT, WIDE, poses, seen

from smartcam import CalibrationError
from smartcam.calibration import Code
from smartcam.calibration.geometry.frames import Transform
from smartcam.calibration.lens.bundle import lens_values
from smartcam.calibration.lens.intrinsics import IntrinsicCalibration, calibrate_intrinsics
from smartcam.calibration.targets import Charuco, Checkerboard

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.calibration.views import TargetView


@functools.cache
def _calibrated(first: int = 0) -> IntrinsicCalibration:
    """Return what eight views from ``first`` on give."""
    return calibrate_intrinsics(seen(LEFT, poses(8))[first:])


def test_calibrate_intrinsics_finds_the_lens_as_well_as_it_says() -> None:
    found = calibrate_intrinsics(seen(LEFT, poses(9)), sheet="auto")
    off = lens_values(found.camera) - lens_values(LEFT)
    assert off @ np.linalg.solve(found.covariance, off) < 27.9  # chi-square of 9, 1 in 1000
    assert found.deviations["fx"] == pytest.approx(0.3, abs=0.2)
    assert list(found.deviations) == ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"]
    assert (found.sheet, found.sigma, found.bad_views) == (None, 0.0, ())


@pytest.mark.long
def test_calibrate_intrinsics_covariance_is_that_of_its_errors() -> None:
    squares = []
    for seed in range(9):
        found = calibrate_intrinsics(seen(LEFT, poses(6, seed=seed), seed=seed), sheet="exact")
        off = lens_values(found.camera) - lens_values(LEFT)
        squares.append(off @ np.linalg.solve(found.covariance, off))
    assert np.mean(squares) == pytest.approx(9.0, abs=4.3)  # 3 sigma of the mean


def test_calibrate_intrinsics_residuals_are_the_noise_and_held_out_a_little_more() -> None:
    found = calibrate_intrinsics(seen(LEFT, poses(9), sigma=0.1))
    assert found.rms == pytest.approx(0.1, rel=0.1)
    assert found.rms < found.held_out < 1.1 * found.rms
    assert all(math.isfinite(one.held_out) for one in found.views)


@pytest.mark.parametrize(
    "camera", [pytest.param(WIDE, marks=pytest.mark.long), FISHEYE], ids=["wide", "fisheye"]
)
def test_calibrate_intrinsics_of_other_models_has_small_held_out_error(camera: object) -> None:
    given = WIDE if camera is WIDE else FISHEYE
    distance = 0.25 if camera is WIDE else 0.12
    views = seen(given, poses(12, tilt=0.8, distance=distance))
    found = calibrate_intrinsics(views, distortion_model=given.distortion_model)
    assert found.camera.distortion_model == given.distortion_model
    assert found.held_out == pytest.approx(0.05, rel=0.1)


@pytest.mark.long
def test_calibrate_intrinsics_of_any_order_gives_the_same() -> None:
    views = seen(LEFT, poses(8))
    one, other = _calibrated(), calibrate_intrinsics(views[::-1])
    np.testing.assert_allclose(lens_values(one.camera), lens_values(other.camera), rtol=1e-5)
    assert [fit.view.name for fit in other.views] == [view.name for view in views[::-1]]


def test_calibrate_intrinsics_names_a_bad_view_and_leaves_it_out() -> None:
    views = seen(LEFT, poses(10))
    shaken = views[4].points + 0.5 * np.random.default_rng(2).normal(size=views[4].points.shape)
    views[4] = dataclasses.replace(views[4], points=shaken)
    found = calibrate_intrinsics(views)
    assert found.bad_views == ("04",)
    assert [fit.used for fit in found.views] == [number != 4 for number in range(10)]
    (remark,) = [one for one in found.warnings if one.code == Code.BAD_VIEW]
    assert remark.text.startswith("04: 0.493 pixels rms")
    assert found.rms == pytest.approx(0.05, rel=0.1)


@pytest.mark.long
def test_calibrate_intrinsics_leaves_out_a_third_of_the_views_at_most() -> None:
    views = seen(LEFT, poses(9))
    for number in range(4):
        random = np.random.default_rng(number)
        noise = 2.0**number * random.normal(size=views[number].points.shape)
        views[number] = dataclasses.replace(views[number], points=views[number].points + noise)
    found = calibrate_intrinsics(views)
    assert len(found.bad_views) == 3
    assert [one.code for one in found.warnings].count(Code.BAD_VIEW) == 4


def test_calibrate_intrinsics_told_to_keep_a_bad_view_names_it_only() -> None:
    views = seen(LEFT, poses(10))
    shaken = views[4].points + 0.5 * np.random.default_rng(2).normal(size=views[4].points.shape)
    views[4] = dataclasses.replace(views[4], points=shaken)
    found = calibrate_intrinsics(views, drop_bad=False)
    assert found.bad_views == ()
    (remark,) = [one for one in found.warnings if one.code == Code.BAD_VIEW]
    assert remark.text.endswith("it is used all the same")


def test_calibrate_intrinsics_of_a_bent_sheet_finds_its_shape() -> None:
    bent = BOARD.points + np.random.default_rng(7).normal(size=(54, 3)) * 2e-4
    bent[:, 2] += 2e-3 * np.sin(np.pi * bent[:, 0] / 0.2)
    views = seen(LEFT, poses(7), points=bent)
    found, exact = (
        calibrate_intrinsics(views, sheet="auto"),
        calibrate_intrinsics(views, sheet="exact"),
    )
    assert found.sheet is not None
    assert found.held_out < 0.08 < 0.2 < exact.held_out
    assert abs(found.camera.matrix[0, 0] - 530.0) < 1.5
    (remark,) = [one for one in found.warnings if one.code == Code.SHEET_NOT_EXACT]
    assert "mm rms from where they were meant to be" in remark.text


def test_point_errors_of_a_view_left_out_are_its_held_out_error() -> None:
    views = seen(LEFT, poses(8))
    found, rest = _calibrated(), _calibrated(1)
    (errors,) = rest.point_errors(views[:1])
    assert errors.shape == (len(views[0].ids), 2)
    rms = math.sqrt(float((errors**2).sum()) / (errors.size - 6))
    assert rms == pytest.approx(found.views[0].held_out, rel=1e-3)


def test_point_errors_of_another_target_are_taken_as_well() -> None:
    found = _calibrated()
    finer = Checkerboard(columns=11, rows=8, square=0.02)
    errors = np.concatenate(found.point_errors(seen(LEFT, poses(3, seed=9), target=finer)))
    assert errors.std() == pytest.approx(0.05, rel=0.1)


def test_point_errors_of_another_target_than_the_adjusted_one_are_refused() -> None:
    bent = BOARD.points + np.random.default_rng(7).normal(size=(54, 3)) * 2e-4
    views = seen(LEFT, poses(7), points=bent)
    found = calibrate_intrinsics(views, sheet="free")
    fresh = seen(LEFT, poses(3, seed=9), points=bent)
    assert np.concatenate(found.point_errors(fresh)).std() < 0.08
    other = dataclasses.replace(fresh[0], target=Checkerboard(columns=9, rows=6, square=0.026))
    with pytest.raises(CalibrationError, match=r"whose points were adjusted, .*0\.026") as caught:
        found.point_errors([other])
    assert caught.value.code == Code.DIFFERENT_TARGETS


@pytest.mark.parametrize("place", [(0, 1), (1, 0), (2, 0), (2, 1)])
def test_camera_with_a_matrix_that_project_would_not_follow_is_refused(
    place: tuple[int, int],
) -> None:
    matrix = LEFT.matrix.copy()
    matrix[place] = 0.5
    with pytest.raises(CalibrationError, match="focal lengths and no skew, got") as caught:
        dataclasses.replace(LEFT, matrix=matrix)
    assert caught.value.code == Code.SHAPE


def test_calibrate_intrinsics_of_hidden_corners_uses_those_that_are_seen() -> None:
    target = Charuco(columns=8, rows=6, square=0.025, marker=0.018)
    views = seen(LEFT, poses(8), target=target)
    some = [np.arange(len(view.ids)) % 4 != number % 4 for number, view in enumerate(views)]
    parts = [
        dataclasses.replace(
            view, ids=view.ids[kept], points=view.points[kept], covariance=view.covariance[kept]
        )
        for view, kept in zip(views, some, strict=True)
    ]
    found = calibrate_intrinsics(parts)
    assert found.held_out == pytest.approx(0.05, rel=0.2)
    assert len(found.views[0].residuals) == int(some[0].sum())


def test_calibrate_intrinsics_of_three_views_says_that_none_was_held_out() -> None:
    found = calibrate_intrinsics(seen(LEFT, poses(3, seed=3)))
    assert math.isnan(found.held_out)
    codes = [one.code for one in found.warnings]
    assert Code.NOT_HELD_OUT in codes
    assert Code.POOR_COVERAGE in codes


def test_calibrate_intrinsics_of_the_wrong_model_says_so() -> None:
    views = seen(FISHEYE, poses(6, tilt=0.9, distance=0.12))
    found = calibrate_intrinsics(views, drop_bad=False, fixed=["k1", "k2", "k3"])
    assert any(one.code == Code.POOR_FIT for one in found.warnings)


def _another_size(views: list[TargetView]) -> None:
    views[1] = dataclasses.replace(views[1], size=(641, 480))


def _another_target(views: list[TargetView]) -> None:
    views[1] = dataclasses.replace(views[1], target=Checkerboard(columns=9, rows=6, square=0.026))


def _two(views: list[TargetView]) -> None:
    del views[2:]


def _alike(views: list[TargetView]) -> None:
    views[:] = [views[0]] * 5


def _parallel(views: list[TargetView]) -> None:
    facing = np.diag([1.0, -1.0, -1.0])
    views[:] = seen(
        LEFT,
        [
            Transform("camera", "target", facing, np.array([-0.1, 0.06, 0.4 + 0.1 * number]))
            for number in range(5)
        ],
    )


@pytest.mark.parametrize(
    ("spoil", "code", "text"),
    [
        (_two, Code.TOO_FEW, "expected 3 views or more, got 2"),
        (_another_size, Code.WRONG_SIZE, "640 x 480 pixels, got 641 x 480"),
        (_another_target, Code.DIFFERENT_TARGETS, "square=0.026.* in 01"),
        (_alike, Code.POSES_TOO_SIMILAR, "5 that differ by 0"),
        (_parallel, Code.INSUFFICIENT_ROTATION, "tilt"),
    ],
)
def test_calibrate_intrinsics_of_views_that_tell_no_lens_raises(
    spoil: Callable[[list[TargetView]], None], code: Code, text: str
) -> None:
    views = seen(LEFT, poses(5))
    spoil(views)
    with pytest.raises(CalibrationError, match=text) as caught:
        calibrate_intrinsics(views)
    assert caught.value.code == code


def test_calibrate_intrinsics_of_an_unknown_model_raises() -> None:
    with pytest.raises(CalibrationError, match="plumb_bob") as caught:
        calibrate_intrinsics(seen(LEFT, poses(4)), distortion_model="fov")  # type: ignore[arg-type]
    assert caught.value.code == Code.SHAPE
