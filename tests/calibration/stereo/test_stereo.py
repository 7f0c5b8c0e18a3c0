from __future__ import annotations

import dataclasses
import functools
import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartcam import CalibrationError
from smartcam.calibration import (
    Checkerboard,
    CircleGrid,
    StereoCalibration,
    Transform,
    calibrate_stereo,
)
from smartcam.calibration._stereo.errors import spacing_errors
from smartcam.calibration._stereo.start import Lenses, as_view_pairs, guess_start
from smartcam.geometry._inside import Code
from tests.calibration.inside import (
    IndexedView,
    check_fit,
    half_turned,
    moved_to_nominal,
    side_remarks,
)
from tests.calibration.lenskit import BOARD, LEFT, RIG, RIGHT, pairs, poses, seen
from tests.calibration.scenes import refused

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.calibration import TargetView
    from smartcam.geometry._inside import Array

Views = list["TargetView | None"]


@functools.cache
def _calibrated() -> StereoCalibration:
    return calibrate_stereo(*pairs(6))


@functools.cache
def _exactly(first: int = 0) -> StereoCalibration:
    """Return the calibration from pairs from ``first`` on, of a sheet taken as exact."""
    left, right = pairs(6)
    return calibrate_stereo(left[first:], right[first:], sheet="exact")


def _off(found: Transform) -> Array:
    turn = Rotation.from_matrix(found.rotation @ RIG.rotation.T).as_rotvec()
    return np.concatenate([turn, found.translation - RIG.translation])


def test_calibrate_stereo_finds_the_transform_within_its_covariance() -> None:
    found = _calibrated()
    off = _off(found.transform)
    assert np.abs(off / np.sqrt(np.diag(found.covariance))).max() < 4.0
    assert (found.transform.target, found.transform.source) == ("right", "left")
    assert np.linalg.norm(off[3:]) < 2e-4
    assert (found.sheet, found.bad_views, found.warnings) == (None, (), ())


@pytest.mark.long
def test_calibrate_stereo_of_pairs_without_noise_is_exact() -> None:
    found = calibrate_stereo(*pairs(4, sigma=0.0))
    np.testing.assert_allclose(_off(found.transform), 0.0, atol=1e-6)
    assert found.held_out < 1e-6


def test_calibrate_stereo_with_known_lenses_keeps_them() -> None:
    left, right = pairs(2)
    found = calibrate_stereo(left, right, left=LEFT, right=RIGHT)
    assert found.left.matrix.tolist() == LEFT.matrix.tolist()
    assert found.right.distortion.tolist() == RIGHT.distortion.tolist()
    assert np.linalg.norm(_off(found.transform)[3:]) < 2e-4
    assert [one.code for one in found.warnings] == [Code.NOT_HELD_OUT]
    assert math.isnan(found.held_out)


def test_calibrate_stereo_held_out_errors_are_those_of_each_pair() -> None:
    found = _calibrated()
    each = [one.held_out for one in found.pairs]
    assert found.held_out == pytest.approx(math.sqrt(np.mean(np.square(each))), rel=0.05)
    assert 2e-5 < min(each) < max(each) < 4e-4
    assert found.epipolar < found.held_out_epipolar < 0.1


@pytest.mark.long
def test_calibrate_stereo_held_out_error_is_that_of_a_calibration_without_the_pair() -> None:
    left, right = pairs(6)
    found, rest = _exactly(), _exactly(1)
    ids, one, two = np.intersect1d(left[0].ids, right[0].ids, return_indices=True)
    points = rest.triangulate(left[0].points[one], right[0].points[two])
    errors = spacing_errors(BOARD, ids, points)
    assert found.pairs[0].held_out == pytest.approx(math.sqrt(np.mean(errors**2)), rel=1e-3)


@pytest.mark.judged
def test_calibrate_stereo_uses_views_of_one_camera_alone() -> None:
    left, right = pairs(8)
    some: Views = [None if number == 2 else view for number, view in enumerate(right)]
    found = calibrate_stereo(left, some, left=LEFT, right=RIGHT)
    assert found.pairs[2].used == (True, False)
    assert math.isnan(found.pairs[2].held_out)
    assert found.pairs[2].transform is not None
    assert np.linalg.norm(_off(found.transform)[3:]) < 4e-4


def test_calibrate_stereo_of_a_moment_without_views_leaves_it_open() -> None:
    left, right = pairs(6)
    found = calibrate_stereo([*left, None], [*right, None], left=LEFT, right=RIGHT)
    assert found.pairs[6].used == (False, False)
    assert found.pairs[6].transform is None


def test_calibrate_stereo_names_a_view_of_another_moment_and_leaves_it_out() -> None:
    left, right = pairs(10)
    moved = seen(RIGHT, [RIG @ poses(10, seed=77, name="left")[3]], seed=5)[0]
    right[3] = dataclasses.replace(moved, name="late")
    found = calibrate_stereo(left, right, left=LEFT, right=RIGHT)
    assert len(found.bad_views) == 1
    assert found.bad_views[0] in {"03", "late"}
    assert sum(found.pairs[3].used) == 1
    assert found.warnings[0].code == Code.BAD_VIEW
    assert np.linalg.norm(_off(found.transform)[3:]) < 4e-4


@pytest.mark.judged
def test_calibrate_stereo_leaves_a_swapped_pair_out() -> None:
    left, right = pairs(8)
    left[3], right[3] = right[3], left[3]
    found = calibrate_stereo(left, right, left=LEFT, right=RIGHT, sheet="exact")
    assert not found.pairs[3].used[1]
    assert sum(one.used == (True, True) for one in found.pairs) == 7
    assert "pixels off where the left view and the other pairs have it" in found.warnings[0].text
    assert found.warnings[0].text.startswith("03, right: is ")
    assert np.linalg.norm(_off(found.transform)[3:]) < 4e-4


def test_calibrate_stereo_of_shifted_pairs_is_refused() -> None:
    left, right = pairs(6)
    with pytest.raises(CalibrationError, match="are they in the same order") as caught:
        calibrate_stereo(left, [*right[1:], right[0]], left=LEFT, right=RIGHT, sheet="exact")
    assert caught.value.code == Code.POOR_FIT


def test_calibrate_stereo_with_a_kept_wrong_pair_is_refused_and_names_it() -> None:
    left, right = pairs(6)
    right[2] = dataclasses.replace(right[5], name="other")
    with pytest.raises(CalibrationError, match=r"worst: other \(right\)") as caught:
        calibrate_stereo(left, right, left=LEFT, right=RIGHT, sheet="exact", drop_bad=False)
    assert caught.value.code == Code.POOR_FIT


def test_calibrate_stereo_of_swapped_sides_has_a_remark() -> None:
    left, right = pairs(5)
    found = calibrate_stereo(right, left, left=RIGHT, right=LEFT, sheet="exact")
    assert [one.code for one in found.warnings] == [Code.SWAPPED_SIDES]
    assert "left and right seem swapped" in found.warnings[0].text
    assert "got it 79.7 mm on the left" in found.warnings[0].text
    assert found.transform.translation[0] == pytest.approx(0.08, rel=0.01)


def test_calibrate_stereo_numbers_a_sheet_that_looks_the_same_when_turned_alike() -> None:
    target = Checkerboard(columns=8, rows=6, square=0.025)
    assert target.half_turn_symmetric
    lefts = poses(6, name="left")
    left = seen(LEFT, lefts, target=target)
    right = seen(RIGHT, [RIG @ one for one in lefts], target=target, seed=2)
    turned = [
        dataclasses.replace(
            view,
            ids=47 - view.ids[::-1],
            points=view.points[::-1],
            covariance=view.covariance[::-1],
        )
        for view in right
    ]
    found = calibrate_stereo(left, turned, left=LEFT, right=RIGHT)
    assert np.linalg.norm(_off(found.transform)[3:]) < 4e-4
    assert found.held_out < 5e-4


def test_calibrate_stereo_of_a_camera_on_its_head_numbers_alike() -> None:
    target = Checkerboard(columns=8, rows=6, square=0.025)
    over = Transform("right", "right", np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    lefts = poses(6, name="left")
    rights = [over @ RIG @ one for one in lefts]
    left, right = seen(LEFT, lefts, target=target), seen(RIGHT, rights, target=target, seed=2)
    # numbered by each picture: the right one from the other end, except for two pairs
    right = [half_turned(one) if number > 1 else one for number, one in enumerate(right)]
    found = calibrate_stereo(left, right, left=LEFT, right=RIGHT)
    assert 1e3 * np.linalg.norm(found.transform.translation) == pytest.approx(80.0, abs=0.5)
    assert found.bad_views == ()


@pytest.mark.judged
def test_calibrate_stereo_of_a_bent_sheet_finds_its_shape() -> None:
    bent = BOARD.points + np.random.default_rng(7).normal(size=(54, 3)) * 2e-4
    left, right = pairs(6, sigma=0.02, points=bent)
    found, exact = (
        calibrate_stereo(left, right, left=LEFT, right=RIGHT, sheet=one)
        for one in ("auto", "exact")
    )
    assert found.sheet is not None
    assert found.rms < 0.5 * exact.rms
    assert found.held_out_epipolar < exact.held_out_epipolar


@pytest.mark.judged
def test_calibrate_stereo_of_a_stretched_sheet_adjusts_it_or_has_a_remark() -> None:
    stretched = moved_to_nominal(BOARD.points * [1.01, 1.0, 1.0], BOARD.points)
    left, right = pairs(8, points=stretched)
    found, exact = (calibrate_stereo(left, right, sheet=one) for one in ("auto", "exact"))
    assert found.sheet is not None
    np.testing.assert_allclose(found.sheet, stretched - BOARD.points, atol=2e-4)
    off = _off(found.transform)
    assert np.abs(off / np.sqrt(np.diag(found.covariance))).max() < 4.0
    assert exact.sheet is None
    for one, said in ((found, "the print or the board is not exact"), (exact, "sheet='auto'")):
        (remark,) = [other for other in one.warnings if other.code == Code.SHEET_NOT_EXACT]
        assert said in remark.text


def test_triangulate_finds_points_in_the_left_frame() -> None:
    found = _calibrated()
    points = np.array([[0.02, 0.01, 0.4], [-0.03, 0.02, 0.5]])
    pixels = found.left.project(points), found.right.project(found.transform.apply(points))
    np.testing.assert_allclose(found.triangulate(*pixels), points, atol=1e-9)


def test_triangulate_takes_covariances() -> None:
    found, point = _calibrated(), np.array([[0.02, 0.01, 0.4]])
    left = found.left.project(point)
    right = found.right.project(found.transform.apply(point)) + np.array([0.0, 2.0])
    trusted = found.triangulate(left, right, left_covariance=1e-6 * np.eye(2)[None])
    np.testing.assert_allclose(found.left.project(trusted), left, atol=1e-3)


@pytest.mark.parametrize(
    ("left", "right", "more", "text"),
    [
        ([[1.0, 2.0]], [[1.0, 2.0], [3.0, 4.0]], {}, "as many on both sides, got 1 and 2"),
        ([[1.0]], [[1.0, 2.0]], {}, "left pixels: expected shape"),
        (
            [[1.0, 2.0]],
            [[1.0, 2.0]],
            {"right_covariance": np.eye(2)},
            r"right covariance: expected shape \(1, 2, 2\), got \(2, 2\)",
        ),
    ],
)
def test_triangulate_of_pixels_of_other_shapes_raises(
    left: Array, right: Array, more: dict[str, Array], text: str
) -> None:
    with pytest.raises(CalibrationError, match=text) as caught:
        _calibrated().triangulate(left, right, **more)
    assert caught.value.code == Code.SHAPE


def test_point_covariance_grows_with_the_fourth_power_of_the_distance() -> None:
    found = _calibrated().point_covariance([[0.0, 0.0, 0.4], [0.0, 0.0, 0.8], [0.0, 0.0, -1.0]])
    assert found[1, 2, 2] / found[0, 2, 2] == pytest.approx(16.0, rel=0.2)
    assert np.isnan(found[2]).all()
    doubled = _calibrated().point_covariance([[0.0, 0.0, 0.4]], 2 * _calibrated().rms)
    np.testing.assert_allclose(doubled[0], 4 * found[0], rtol=1e-4)


def test_epipolar_distances_and_rectify_use_the_calibration() -> None:
    found = _calibrated()
    left, right = found.pairs[0].left, found.pairs[0].right
    assert left is not None
    assert right is not None
    _, one, two = np.intersect1d(left.ids, right.ids, return_indices=True)
    assert found.epipolar_distances(left.points[one], right.points[two]).max() < 0.4
    assert found.rectify(1.0).alpha == 1.0


@pytest.mark.long
def test_point_errors_of_a_pair_left_out_are_its_held_out_errors() -> None:
    left, right = pairs(6)
    found, rest = _exactly(), _exactly(1)
    (errors,) = rest.point_errors(left[:1], right[:1])
    spacing, epipolar = (math.sqrt(float((one**2).mean())) for one in errors)
    assert spacing == pytest.approx(found.pairs[0].held_out, rel=1e-3)
    assert epipolar == pytest.approx(found.pairs[0].epipolar, rel=1e-3)


def test_point_errors_of_a_moment_without_a_pair_are_none_at_all() -> None:
    left, right = pairs(6)
    found = _calibrated()
    nobody, apart = found.point_errors(
        [None, _part(left[0], slice(0, 20))], [right[0], _part(right[0], slice(20, 54))]
    )
    assert [one.size for one in (*nobody, *apart)] == [0, 0, 0, 0]


def _part(view: TargetView, some: slice) -> TargetView:
    return dataclasses.replace(
        view, ids=view.ids[some], points=view.points[some], covariance=view.covariance[some]
    )


def test_point_errors_of_a_view_numbered_from_the_other_end_are_the_same() -> None:
    found, around = _calibrated(), poses(2, seed=4, name="left")
    dots = CircleGrid(columns=8, rows=6, spacing=0.025, diameter=0.01)
    left = seen(LEFT, around, target=dots)
    right = seen(RIGHT, [RIG @ one for one in around], target=dots)
    turned = [
        dataclasses.replace(
            one, ids=47 - one.ids[::-1], points=one.points[::-1], covariance=one.covariance[::-1]
        )
        for one in right
    ]
    for one, other in zip(
        found.point_errors(left, right), found.point_errors(left, turned), strict=True
    ):
        np.testing.assert_allclose(one.spacing, other.spacing, atol=1e-15)
        np.testing.assert_allclose(one.epipolar, other.epipolar, atol=1e-12)


def test_point_errors_of_images_of_another_size_are_refused() -> None:
    left, right = pairs(1)
    small = dataclasses.replace(right[0], size=(800, 600))
    with pytest.raises(CalibrationError, match="640 x 480 pixels, got 800 x 600") as caught:
        _calibrated().point_errors(left, [small])
    assert caught.value.code == Code.WRONG_SIZE


@pytest.mark.parametrize(
    ("target", "neighbours"),
    [
        (BOARD, 8 * 6 + 9 * 5),
        (CircleGrid(columns=4, rows=5, spacing=0.02, diameter=0.01), 3 * 5 + 4 * 4),
        (CircleGrid(columns=4, rows=3, spacing=0.02, diameter=0.01, asymmetric=True), 14),
    ],
)
def test_spacing_errors_are_those_of_neighbours(
    target: Checkerboard | CircleGrid, neighbours: int
) -> None:
    ids = np.arange(len(target.points))
    found = spacing_errors(target, ids, 1.01 * target.points)
    assert len(found) == neighbours
    slanted = isinstance(target, CircleGrid) and target.asymmetric
    apart = 0.02 * math.sqrt(0.5) if slanted else 0.02
    np.testing.assert_allclose(found, 0.01 * (0.025 if target is BOARD else apart), rtol=1e-6)


def test_spacing_errors_of_points_that_are_nan_are_left_out() -> None:
    points = BOARD.points.copy()
    points[1:] = np.nan
    assert spacing_errors(BOARD, np.arange(54), points).shape == (0,)


def _one_less(left: Views, right: Views) -> None:
    right.pop()


def _few(left: Views, right: Views) -> None:
    right[2:] = [None] * 3


def _sheet(left: Views, right: Views) -> None:
    other = Checkerboard(columns=9, rows=6, square=0.02)
    right[:] = [dataclasses.replace(view, target=other) for view in right if view]


def _size(left: Views, right: Views) -> None:
    left[1] = dataclasses.replace(left[1], size=(100, 100)) if left[1] else None


@pytest.mark.parametrize(
    ("spoil", "code", "text"),
    [
        (_one_less, Code.SHAPE, "as many left views as right ones, got 5 and 4"),
        (_few, Code.TOO_FEW, "3 pairs or more in which both cameras see the target, got 2"),
        (_sheet, Code.DIFFERENT_TARGETS, "got .*square=0.02.* on the right"),
        (_size, Code.WRONG_SIZE, "in 01: expected an image of 640 x 480 pixels, got 100 x 100"),
    ],
)
def test_calibrate_stereo_of_pairs_that_tell_nothing_raises(
    spoil: Callable[[Views, Views], None], code: Code, text: str
) -> None:
    left, right = pairs(5)
    lefts, rights = Views(left), Views(right)
    spoil(lefts, rights)
    with pytest.raises(CalibrationError, match=text) as caught:
        calibrate_stereo(lefts, rights)
    assert caught.value.code == code


def test_calibrate_stereo_of_a_sheet_that_was_never_tilted_raises() -> None:
    facing = np.diag([1.0, -1.0, -1.0])
    lefts = [
        Transform("left", "target", facing, np.array([-0.1, 0.06, 0.4 + 0.1 * number]))
        for number in range(4)
    ]
    left, right = seen(LEFT, lefts), seen(RIGHT, [RIG @ one for one in lefts])
    with pytest.raises(CalibrationError, match=r"left camera: expected .* tilt") as caught:
        calibrate_stereo(left, right)
    assert caught.value.code == Code.INSUFFICIENT_ROTATION


def test_calibrate_stereo_with_a_known_lens_of_another_size_raises() -> None:
    left, right = pairs(3)
    small = dataclasses.replace(LEFT, size=(320, 240))
    with pytest.raises(CalibrationError, match="an image of 320 x 240 pixels") as caught:
        calibrate_stereo(left, right, left=small)
    assert caught.value.code == Code.WRONG_SIZE


# ---------------------------------------------------------------------- the start


def test_start_is_near_the_truth() -> None:
    left, right = pairs(4)
    lenses = Lenses((LEFT, RIGHT), "plumb_bob", ())
    view_pairs, bundle, apart = guess_start(as_view_pairs(left, right), lenses)
    assert [one[0] for one in view_pairs] == left
    np.testing.assert_allclose(bundle.rig.rotation[0], RIG.rotation, atol=0.01)
    np.testing.assert_allclose(bundle.rig.translation[0], RIG.translation, atol=2e-3)
    assert bundle.shared_count == 6
    assert apart == {}


def test_start_names_the_pair_that_does_not_belong_together() -> None:
    left, right = pairs(6)
    views = [*right[:4], right[0], right[5]]
    _, bundle, apart = guess_start(
        as_view_pairs(left, views), Lenses((LEFT, RIGHT), "plumb_bob", ())
    )
    assert list(apart) == [4]
    assert apart[4] > 50
    np.testing.assert_allclose(bundle.rig.translation[0], RIG.translation, atol=2e-3)


# ---------------------------------------------------------------------- what is refused


def test_check_fit_of_more_pixels_than_can_be_names_the_worst_views() -> None:
    left, right = pairs(2)
    indexed = [IndexedView(0, 0, left[0]), IndexedView(1, 0, right[0])]
    check_fit(4.9, indexed, [])
    with refused("POOR_FIT", "got residuals of 5.1 pixels rms, 5 at most", "worst: 01 (right)"):
        check_fit(5.1, indexed, [IndexedView(1, 1, right[1])])


def test_check_fit_allows_more_for_less_certain_points() -> None:
    left, _ = pairs(2, sigma=0.5)
    indexed = [IndexedView(0, 0, left[0])]
    check_fit(9.9, indexed, [])
    with refused("POOR_FIT", "10 at most expected", "worst: all alike"):
        check_fit(10.1, indexed, [])


@pytest.mark.parametrize(
    ("turn", "shift", "codes"),
    [
        (0.0, [0.1, 0.01, 0.0], [Code.SWAPPED_SIDES]),
        (0.0, [-0.1, 0.01, 0.0], []),
        (0.0, [0.01, 0.1, 0.0], []),
        (np.pi, [0.1, 0.01, 0.0], []),
    ],
)
def test_remark_sides_is_made_for_a_right_camera_on_the_left(
    turn: float, shift: list[float], codes: list[Code]
) -> None:
    rotation = Rotation.from_rotvec([0.0, 0.0, turn]).as_matrix()
    remarks = side_remarks(Transform("right", "left", rotation, np.array(shift)))
    assert [one.code for one in remarks] == codes
