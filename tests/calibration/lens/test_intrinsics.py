from __future__ import annotations

import dataclasses
import functools
import math
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartcam import CalibrationError
from smartcam.calibration import (
    Charuco,
    Checkerboard,
    IntrinsicCalibration,
    Transform,
    calibrate_intrinsics,
)
from smartcam.calibration._lens.start import fit_lens, lens_basis, parameter_names
from smartcam.geometry._inside import Code, Rigid
from tests.calibration.inside import (
    Bundle,
    Coverage,
    IndexedView,
    adjust_shape,
    adjust_weighted,
    choose_shape,
    coverage,
    leave_out,
    lens_values,
    moved_to_nominal,
    residuals,
    with_lens,
)
from tests.calibration.inside import bundle_adjust as adjust
from tests.calibration.lenskit import BOARD, FISHEYE, LEFT, RIG, RIGHT, WIDE, pairs, poses, seen

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.calibration import CameraModel, TargetView


@functools.cache
def _calibrated(first: int = 0) -> IntrinsicCalibration:
    """Return the calibration from eight views, from ``first`` on."""
    return calibrate_intrinsics(seen(LEFT, poses(8))[first:])


def test_calibrate_intrinsics_finds_the_lens_within_its_covariance() -> None:
    found = calibrate_intrinsics(seen(LEFT, poses(9)), sheet="auto")
    off = lens_values(found.camera) - lens_values(LEFT)
    deviations = np.array(list(found.deviations.values()))
    assert np.abs(off / deviations).max() < 4.0
    assert found.deviations["fx"] == pytest.approx(0.3, abs=0.2)
    assert list(found.deviations) == ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"]
    assert (found.sheet, found.sigma, found.bad_views) == (None, 0.0, ())


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


def test_calibrate_intrinsics_keeps_a_bad_view_on_request_and_names_it() -> None:
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
    assert "mm rms from their nominal places" in remark.text


def test_point_errors_of_a_view_left_out_are_its_held_out_error() -> None:
    views = seen(LEFT, poses(8))
    found, rest = _calibrated(), _calibrated(1)
    (errors,) = rest.point_errors(views[:1])
    assert errors.shape == (len(views[0].ids), 2)
    rms = math.sqrt(float((errors**2).sum()) / (errors.size - 6))
    assert rms == pytest.approx(found.views[0].held_out, rel=1e-3)


def test_point_errors_of_another_target_are_computed_too() -> None:
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


def test_calibrate_intrinsics_of_three_views_reports_that_none_was_held_out() -> None:
    found = calibrate_intrinsics(seen(LEFT, poses(3, seed=3)))
    assert math.isnan(found.held_out)
    codes = [one.code for one in found.warnings]
    assert Code.NOT_HELD_OUT in codes
    assert Code.POOR_COVERAGE in codes


def test_calibrate_intrinsics_of_the_wrong_model_has_a_remark() -> None:
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


# ---------------------------------------------------------------------- the start


@pytest.mark.parametrize(
    ("camera", "tilt", "distance"),
    [
        (LEFT, 0.6, 0.35),
        pytest.param(WIDE, 0.7, 0.25, marks=pytest.mark.long),
        (FISHEYE, 0.9, 0.12),
    ],
)
def test_fit_lens_of_views_without_noise_finds_the_lens(
    camera: CameraModel, tilt: float, distance: float
) -> None:
    views = seen(camera, poses(10, tilt=tilt, distance=distance), sigma=0.0)
    found = fit_lens(views, camera.distortion_model).bundle.cameras[0]
    assert found.distortion_model == camera.distortion_model
    rays = camera.directions([[120.0, 100.0], [camera.size[0] - 90.0, 200.0], [300.0, 350.0]])
    flat = np.column_stack([rays, np.ones(3)])
    np.testing.assert_allclose(found.project(flat), camera.project(flat), atol=0.01)


@pytest.mark.parametrize("fails", [1, 2])
def test_fit_lens_has_another_start_if_opencv_gives_up(
    fails: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    calibrate, calls = cv2.calibrateCamera, []

    def failing(*given: object, **how: object) -> object:
        calls.append(given)
        if len(calls) <= fails:
            raise cv2.error("no")
        return calibrate(*given, **how)  # type: ignore[call-overload]

    monkeypatch.setattr(cv2, "calibrateCamera", failing)
    found = fit_lens(seen(LEFT, poses(8)), "plumb_bob").bundle.cameras[0]
    assert len(calls) == fails + 1
    assert found.matrix[0, 0] == pytest.approx(530, abs=1.0)


def test_fit_lens_that_nothing_leads_to_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_given: object, **_how: object) -> object:
        raise cv2.error("no")

    monkeypatch.setattr(cv2, "calibrateCamera", failing)
    with pytest.raises(
        CalibrationError, match=r"got none from focal lengths of 0\.4 to 4"
    ) as caught:
        fit_lens(seen(LEFT, poses(4)), "plumb_bob")
    assert caught.value.code == Code.POOR_FIT


def test_fit_lens_of_views_of_different_noise_trusts_the_sharp_ones() -> None:
    around = poses(12)
    views = [*seen(LEFT, around[:6], sigma=0.02), *seen(LEFT, around[6:], sigma=1.0, seed=3)]
    sharp, all_of_them = fit_lens(views[:6], "plumb_bob"), fit_lens(views, "plumb_bob")
    deviations = np.sqrt(np.diag(sharp.noise_covariance))
    off = lens_values(all_of_them.bundle.cameras[0]) - lens_values(sharp.bundle.cameras[0])
    assert np.abs(off / deviations).max() < 0.5
    assert (np.diag(all_of_them.noise_covariance) < np.diag(sharp.noise_covariance)).all()


def test_fit_lens_with_fixed_coefficients_leaves_them_at_zero() -> None:
    views = seen(LEFT, poses(8))
    lens = fit_lens(views, "plumb_bob", ["k3", "p1", "aspect"]).bundle.cameras[0]
    assert lens.distortion[[2, 4]].tolist() == [0.0, 0.0]
    assert lens.distortion[0] < -0.2
    assert lens.matrix[0, 0] == lens.matrix[1, 1]


def test_lens_basis_has_a_column_for_each_unknown() -> None:
    assert lens_basis("plumb_bob").shape == (9, 9)
    basis = lens_basis("equidistant", ["aspect", "k4"])
    assert basis.shape == (8, 6)
    np.testing.assert_array_equal(basis[:, 0], [1, 1, 0, 0, 0, 0, 0, 0])


def test_lens_basis_of_an_unknown_coefficient_raises() -> None:
    with pytest.raises(CalibrationError, match="got k4") as caught:
        lens_basis("plumb_bob", ["k4"])
    assert caught.value.code == Code.SHAPE
    assert "k1, k2, p1, p2, k3" in str(caught.value)


def test_parameter_names_are_those_of_the_values() -> None:
    named = dict(zip(parameter_names("plumb_bob"), lens_values(LEFT), strict=True))
    assert (named["fx"], named["cy"], named["p1"], named["k3"]) == (530.0, 236.0, 1e-3, 0.02)


# ---------------------------------------------------------------------- the shape of the sheet


RANDOM = np.random.default_rng(11)
OFF = BOARD.points + 2e-4 * RANDOM.normal(size=(54, 3))


def test_moved_to_nominal_removes_place_direction_and_size() -> None:
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = 1.7 * BOARD.points @ turn.T + [0.3, -0.2, 0.5]
    np.testing.assert_allclose(moved_to_nominal(moved, BOARD.points), BOARD.points, atol=1e-12)


def test_adjust_shape_finds_the_places_of_the_points() -> None:
    views = seen(LEFT, poses(15), sigma=0.02, points=OFF)
    indexed = [IndexedView(0, number, view) for number, view in enumerate(views)]
    before = fit_lens(views, "plumb_bob")
    found = adjust_shape(before.bundle, indexed, before.extra_variance)
    assert found.bundle.points is not None
    off = found.bundle.points - moved_to_nominal(OFF, BOARD.points)
    assert np.sqrt((off**2).mean()) < 4e-5
    assert found.extra_variance < 0.1 * before.extra_variance
    assert found.freedom == before.freedom - 3 * 54 + 7


@pytest.mark.parametrize(
    ("count", "free"), [(4, False), (7, False), pytest.param(9, True, marks=pytest.mark.long)]
)
def test_held_out_is_that_of_a_fit_without_the_views(count: int, *, free: bool) -> None:
    views = seen(LEFT, poses(count), points=OFF if free else None)
    indexed = [IndexedView(0, number, view) for number, view in enumerate(views)]
    whole = fit_lens(views, "plumb_bob")
    if free:
        whole = adjust_shape(whole.bundle, indexed, whole.extra_variance)
    for one in leave_out(whole, indexed):
        others = [each for each in indexed if each.pose_index != one.pose]
        again = adjust(whole.bundle, others, whole.extra_variance).bundle
        only = dataclasses.replace(again, poses=again.poses.subset([one.pose])).with_known_cameras()
        (expected,) = adjust(
            only, [IndexedView(0, 0, views[one.pose])], whole.extra_variance
        ).residuals
        off, rms = (math.sqrt(float((r**2).mean())) for r in (one.residuals[0], expected))
        assert off == pytest.approx(rms, rel=0.01)


def test_held_out_error_of_a_view_does_not_use_it() -> None:
    views = seen(LEFT, poses(8))
    shaken = views[3].points + 2.0 * np.random.default_rng(4).normal(size=views[3].points.shape)
    spoiled = [*views[:3], dataclasses.replace(views[3], points=shaken), *views[4:]]
    (fitted, again) = (
        [IndexedView(0, n, view) for n, view in enumerate(s)] for s in (views, spoiled)
    )
    whole = fit_lens(views, "plumb_bob")
    true = next(one for one in leave_out(whole, fitted) if one.pose == 3)
    moved = adjust(whole.bundle, again, whole.extra_variance)
    other = next(one for one in leave_out(moved, again) if one.pose == 3)
    lenses = [lens_values(one.bundle.cameras[0]) for one in (true, other)]
    deviations = np.sqrt(np.diag(whole.noise_covariance))
    assert np.abs((lenses[0] - lenses[1]) / deviations).max() < 1.0
    assert np.abs((lens_values(moved.bundle.cameras[0]) - lenses[0]) / deviations).max() > 5.0


STRETCHED = moved_to_nominal(BOARD.points * [1.008, 0.995, 1.0], BOARD.points)


def test_calibrate_intrinsics_of_a_stretched_sheet_finds_by_how_much_both_ways() -> None:
    found = calibrate_intrinsics(seen(LEFT, poses(10), points=STRETCHED), sheet="auto")
    assert found.sheet is not None
    off = found.sheet - (STRETCHED - BOARD.points)
    assert np.sqrt((off**2).mean()) < 2.5e-5
    error = lens_values(found.camera) - lens_values(LEFT)
    assert np.abs(error / np.array(list(found.deviations.values()))).max() < 4.0


def test_calibrate_intrinsics_of_a_stretched_sheet_has_a_remark() -> None:
    found = calibrate_intrinsics(seen(LEFT, poses(8), points=STRETCHED), sheet="exact")
    assert found.sheet is None
    (remark,) = [one for one in found.warnings if one.code == Code.SHEET_NOT_EXACT]
    assert remark.text.startswith("the sheet's points are 0.46 mm rms from")
    assert remark.text.endswith("sheet='auto' would adjust them")


@pytest.mark.parametrize("fixed", [(), pytest.param(("k2", "k3"), marks=pytest.mark.long)])
def test_exact_sheet_stays_exact_even_before_a_lens_that_is_not_of_its_model(
    fixed: tuple[str, ...],
) -> None:
    for seed in range(2):
        views = seen(LEFT, poses(8, seed=seed), seed=seed)
        indexed = [IndexedView(0, number, view) for number, view in enumerate(views)]
        found = choose_shape(fit_lens(views, "plumb_bob", fixed), indexed, "auto")
        assert found.offsets is None
        assert found.remarks == []


def test_calibrate_intrinsics_with_more_points_free_than_fit_in_memory_is_refused() -> None:
    fine = Checkerboard(columns=40, rows=30, square=0.005)
    views = seen(LEFT, poses(4), target=fine)
    with pytest.raises(
        CalibrationError, match="1000 points at most that are free, got 12"
    ) as caught:
        calibrate_intrinsics(views, sheet="free")
    assert caught.value.code == Code.SHAPE
    assert calibrate_intrinsics(views, sheet="auto").sheet is None


@pytest.mark.long
def test_adjust_shape_errors_are_those_that_the_bound_allows() -> None:
    squares = []
    for seed in range(12):
        views = seen(LEFT, poses(8, seed=seed), seed=seed, points=OFF)
        indexed = [IndexedView(0, number, view) for number, view in enumerate(views)]
        fitted = fit_lens(views, "plumb_bob")
        found = adjust_shape(fitted.bundle, indexed, fitted.extra_variance)
        off = lens_values(found.bundle.cameras[0]) - lens_values(LEFT)
        squares.append(off @ np.linalg.solve(found.noise_covariance, off))
    assert np.mean(squares) == pytest.approx(9.0, abs=3.7)  # 3 sigma of the mean


def test_adjust_shape_keeps_the_nominal_place_direction_and_size() -> None:
    views = seen(LEFT, poses(8), points=OFF)
    indexed = [IndexedView(0, number, view) for number, view in enumerate(views)]
    fitted = fit_lens(views, "plumb_bob")
    found = adjust_shape(fitted.bundle, indexed, fitted.extra_variance).bundle
    assert found.points is not None
    np.testing.assert_allclose(
        moved_to_nominal(found.points, BOARD.points), found.points, atol=1e-9
    )
    together = np.concatenate(residuals(found, indexed))
    assert together.std() == pytest.approx(0.045, rel=0.1)


# ---------------------------------------------------------------------- coverage


SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def test_coverage_of_one_place_is_nothing() -> None:
    assert coverage([100 * SQUARE, 100 * SQUARE], (640, 480)) == (0.0, 0.0, 0.0, 0.0)
    assert coverage([], (640, 480)) == (0.0, 0.0, 0.0, 0.0)


def test_coverage_from_corner_to_corner_fills_the_bars_of_place() -> None:
    there = 100 * SQUARE + [540, 380]
    bars = coverage([100 * SQUARE, there], (640, 480))
    assert (bars.x, bars.y, bars.size, bars.skew) == (1.0, 1.0, 0.0, 0.0)
    assert bars.lacking == ("size", "skew")


def test_coverage_is_a_part_of_the_enough_range() -> None:
    middle = 100 * SQUARE + [0.35 * 540, 0]
    assert coverage([100 * SQUARE, middle], (640, 480)).x == pytest.approx(0.5)


def test_coverage_from_far_to_near_fills_the_bar_of_size() -> None:
    near = 480 * SQUARE
    expected = (480 - 48) / math.sqrt(640 * 480) / 0.4
    assert coverage([48 * SQUARE, 240 * SQUARE], (640, 480)).size == pytest.approx(
        (240 - 48) / math.sqrt(640 * 480) / 0.4
    )
    assert expected > 1.0
    assert coverage([48 * SQUARE, near], (640, 480)).size == 1.0


def test_coverage_of_a_tilted_view_fills_the_bar_of_skew() -> None:
    sheared = 100 * SQUARE @ np.array([[1.0, 0.0], [math.tan(0.125), 1.0]])
    assert coverage([100 * SQUARE, sheared], (640, 480)).skew == pytest.approx(0.5)


def test_coverage_lacking_of_full_bars_is_empty() -> None:
    assert Coverage(1.0, 1.0, 1.0, 1.0).lacking == ()


# ---------------------------------------------------------------------- the bundle


def _bundle(count: int, *, free: bool = True) -> Bundle:
    """Return the truth of the two cameras of the kit."""
    columns = np.eye(9) if free else np.zeros((9, 0))
    return Bundle(
        (LEFT, RIGHT),
        Rigid.stack([RIG.rigid]),
        Rigid.stack(one.rigid for one in poses(count, name="left")),
        (columns, columns),
        is_rig_known=not free,
    )


def _indexed_views(count: int, sigma: float) -> list[IndexedView]:
    both = pairs(count, sigma=sigma)
    return [
        IndexedView(side, n, view)
        for side, views in enumerate(both)
        for n, view in enumerate(views)
    ]


def test_with_lens_of_the_values_is_the_same_lens() -> None:
    again = with_lens(RIGHT, lens_values(RIGHT))
    assert again.matrix.tolist() == RIGHT.matrix.tolist()
    assert again.distortion.tolist() == RIGHT.distortion.tolist()


def test_bundle_shared_counts_lenses_and_rig() -> None:
    assert (_bundle(3).shared_count, _bundle(3, free=False).shared_count) == (24, 0)
    assert _bundle(3).lens_columns == [slice(0, 9), slice(9, 18)]


def test_adjust_from_near_goes_back_to_the_truth() -> None:
    truth = _bundle(6)
    random = np.random.default_rng(1)
    scale = np.array([5, 5, 5, 5, 0.02, 0.02, 1e-3, 1e-3, 0.02] * 2 + [0.02] * 6)
    away = truth.with_steps(scale * random.normal(size=24), 0.01 * random.normal(size=(6, 6)))
    found = adjust(away, _indexed_views(6, 0.0), 0.0)
    assert found.weighted_squares < 1e-3
    for one, other in zip(found.bundle.cameras, truth.cameras, strict=True):
        np.testing.assert_allclose(one.matrix, other.matrix, atol=1e-3)
    np.testing.assert_allclose(found.bundle.rig.translation[0], RIG.translation, atol=1e-6)


def test_adjust_sum_of_squares_is_its_freedom() -> None:
    found = adjust(_bundle(8), _indexed_views(8, 0.1), 0.0)
    count = sum(len(one) for one in found.residuals)
    assert found.freedom == 2 * count - 24 - 6 * 8
    assert found.weighted_squares == pytest.approx(found.freedom, rel=0.15)


def test_adjust_covariance_of_poses_is_that_of_their_errors() -> None:
    squares = []
    for seed in range(20):
        truth = poses(4, seed=seed)
        views = seen(LEFT, truth, sigma=0.1, seed=seed)
        motions = Rigid.stack(one.rigid for one in truth)
        bundle = Bundle.single(LEFT, motions, np.eye(9)[:, :2])
        found = adjust(bundle, [IndexedView(0, n, view) for n, view in enumerate(views)], 0.0)
        turn = found.bundle.poses.rotation[0] @ truth[0].rotation.T
        shift = found.bundle.poses.translation[0] - truth[0].translation
        off = np.concatenate([Rotation.from_matrix(turn).as_rotvec(), shift])
        squares.append(off @ np.linalg.solve(found.pose_covariance[0], off))
    assert np.mean(squares) == pytest.approx(6.0, abs=2.4)  # 3 sigma of the mean


def test_adjust_leaves_a_pose_that_no_view_shows() -> None:
    bundle, indexed = (_bundle(4), [one for one in _indexed_views(4, 0.05) if one.pose_index != 2])
    found = adjust(bundle, indexed, 0.0)
    unseen = [one.poses.translation[2].tolist() for one in (found.bundle, bundle)]
    assert unseen[0] == unseen[1]
    assert found.freedom == 2 * sum(len(one) for one in found.residuals) - 24 - 6 * 3


def test_adjust_of_points_behind_the_camera_gives_up() -> None:
    bundle = _bundle(3)
    behind = bundle.poses.turned_in_target(np.tile([0, 0, 0, 0, 0, -9.0], (3, 1)))
    away = Bundle(bundle.cameras, bundle.rig, behind, bundle.basis)
    found = adjust(away, _indexed_views(3, 0.0), 0.0)
    assert math.isinf(found.weighted_squares)
    assert np.isnan(found.noise_covariance).all()


def test_adjust_weighted_finds_the_variance_beyond_the_covariance() -> None:
    indexed = [
        one._replace(view=dataclasses.replace(one.view, covariance=0.01 * one.view.covariance))
        for one in _indexed_views(8, 0.2)
    ]
    found = adjust_weighted(_bundle(8), indexed)
    assert math.sqrt(found.extra_variance) == pytest.approx(0.2, rel=0.1)
    assert found.weighted_squares == pytest.approx(found.freedom, rel=0.02)
