from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smartcam import CalibrationError
from smartcam.calibration import Transform
from smartcam.calibration._inside import rectify
from smartcam.calibration._stereo.triangulation import CameraPair, epipolar_distances, triangulate
from smartcam.geometry._inside import Array, Code
from tests.calibration.lenskit import FISHEYE, LEFT, RIG, RIGHT

if TYPE_CHECKING:
    from smartcam.calibration import CameraModel
    from smartcam.calibration._inside import Rectification

POINTS = np.array([[0.05, -0.04, 0.4], [-0.05, 0.08, 0.5], [0.02, 0.01, 0.6]])


def _rectified(found: Rectification, side: int, points: Array) -> Array:
    near = points @ found.rotations[0].T
    seen = np.column_stack([near, np.ones(len(near))]) @ found.projections[side].T
    return np.asarray(seen[:, :2] / seen[:, 2:], dtype=np.float64)


@pytest.mark.parametrize(("left", "right"), [(LEFT, RIGHT), (FISHEYE, FISHEYE)])
def test_rectify_puts_partners_into_one_row(left: CameraModel, right: CameraModel) -> None:
    found = rectify(left, right, RIG)
    one, two = _rectified(found, 0, POINTS), _rectified(found, 1, POINTS)
    np.testing.assert_allclose(one[:, 1], two[:, 1], atol=1e-6)
    disparity = one[:, 0] - two[:, 0]
    back = np.column_stack([one, disparity, np.ones(3)]) @ found.disparity_to_point.T
    np.testing.assert_allclose(back[:, :3] / back[:, 3:] @ found.rotations[0], POINTS, atol=1e-9)


def test_rectify_maps_lead_to_the_source() -> None:
    found = rectify(LEFT, RIGHT, RIG)
    u, v = np.rint(_rectified(found, 0, POINTS)[0]).astype(int)
    assert found.masks[0][v, u]
    np.testing.assert_allclose(found.maps[0][v, u], LEFT.project(POINTS)[0], atol=1.0)


def test_rectify_with_alpha_0_has_no_invalid_pixels_and_loses_some() -> None:
    found = rectify(LEFT, RIGHT, RIG, alpha=0.0)
    assert max(found.invalid) < 0.002
    assert 0.7 < min(found.kept) < max(found.kept) < 0.95
    assert found.lost == pytest.approx((1 - found.kept[0], 1 - found.kept[1]))


def test_rectify_with_alpha_1_keeps_all_and_has_invalid_pixels() -> None:
    found = rectify(LEFT, RIGHT, RIG, alpha=1.0)
    assert min(found.kept) > 0.995
    assert min(found.invalid) > 0.1
    assert found.invalid[0] == pytest.approx(1.0 - found.masks[0].mean())


def test_rectify_to_another_size_has_that_size() -> None:
    found = rectify(LEFT, RIGHT, RIG, size=(320, 240))
    assert found.size == (320, 240)
    assert [found.maps[0].shape, found.masks[1].shape] == [(240, 320, 2), (240, 320)]
    assert max(found.invalid) < 0.01


def test_rectification_apply_brings_a_grey_ramp_along_its_map() -> None:
    found = rectify(LEFT, RIGHT, RIG)
    ramp = np.tile((np.arange(640) / 4).astype(np.uint8), (480, 1))
    left, right = found.apply(ramp, ramp)
    assert left.shape == right.shape == (480, 640)
    inside = found.masks[0]
    off = left[inside].astype(float) - found.maps[0][inside][:, 0] / 4
    assert np.abs(off).max() <= 1.5


@pytest.mark.parametrize(
    ("changes", "code", "text"),
    [
        ({"alpha": 1.5}, Code.SHAPE, "alpha: expected 0 to 1, got 1.5"),
        ({"alpha": math.nan}, Code.SHAPE, "alpha: expected 0 to 1, got nan"),
        ({"size": (0, 10)}, Code.SHAPE, "size: expected 1 to 100000000 pixels"),
        ({"size": (100_000, 100_000)}, Code.SHAPE, "size: expected 1 to 100000000 pixels"),
        ({"right": FISHEYE}, Code.SHAPE, "two of plumb_bob, got equidistant"),
        (
            {"right": dataclasses.replace(RIGHT, size=(320, 240))},
            Code.WRONG_SIZE,
            "640 x 480, got 320 x 240 on the right",
        ),
    ],
)
def test_rectify_of_a_wrong_pair_raises(changes: dict[str, Any], code: Code, text: str) -> None:
    right = changes.pop("right", RIGHT)
    with pytest.raises(CalibrationError, match=text) as caught:
        rectify(LEFT, right, RIG, **changes)
    assert caught.value.code == code


@pytest.mark.parametrize(
    ("turn", "shift", "alpha"),
    [
        (np.diag([-1.0, -1.0, 1.0]), [0.02, 0.05, 0.0], 0.5),  # one camera upside down
        (np.eye(3), [0.01, 0.0, -0.1], 1.0),  # one camera behind the other
    ],
)
def test_rectify_of_cameras_that_no_rows_join_raises(
    turn: Array, shift: list[float], alpha: float
) -> None:
    rig = Transform("right", "left", turn, np.array(shift))
    text = "expected two cameras beside each other that see the same place the same way up"
    with pytest.raises(CalibrationError, match=text) as caught:
        rectify(LEFT, LEFT, rig, alpha=alpha)
    assert caught.value.code == Code.OUT_OF_FIELD


# ---------------------------------------------------------------------- triangulation


PAIR = CameraPair(LEFT, RIGHT, RIG)
SEEN_POINTS = np.array(
    [[0.05, -0.04, 0.4], [-0.1, 0.08, 0.5], [0.0, 0.0, 0.3], [0.12, 0.1, 0.6], [0.1, -0.1, 1.5]]
)
Both = tuple[Array, Array]


def _seen(points: Array) -> Both:
    return LEFT.project(points), RIGHT.project(RIG.apply(points))


def _alike(count: int, sigma: float = 1.0) -> Both:
    each = np.tile(sigma**2 * np.eye(2), (count, 1, 1))
    return each, each


def test_triangulate_of_exact_pixels_gives_the_points() -> None:
    found = triangulate(PAIR, _seen(SEEN_POINTS), _alike(5))
    np.testing.assert_allclose(found.points, SEEN_POINTS, atol=1e-9)


def test_triangulate_of_fisheyes_gives_the_points() -> None:
    pixels = FISHEYE.project(SEEN_POINTS), FISHEYE.project(RIG.apply(SEEN_POINTS))
    found = triangulate(CameraPair(FISHEYE, FISHEYE, RIG), pixels, _alike(5))
    np.testing.assert_allclose(found.points, SEEN_POINTS, atol=1e-9)


def test_triangulate_covariance_is_that_of_its_errors() -> None:
    random, sigma = np.random.default_rng(1), 0.2
    many = np.tile(SEEN_POINTS[:1], (2000, 1))
    left, right = _seen(many)
    pixels = (
        left + sigma * random.normal(size=left.shape),
        right + sigma * random.normal(size=right.shape),
    )
    found = triangulate(PAIR, pixels, _alike(2000, sigma))
    np.testing.assert_allclose(
        np.cov((found.points - many).T), found.covariance[0], rtol=0.1, atol=1e-9
    )


def test_triangulate_trusts_the_sharper_pixel() -> None:
    left, right = _seen(SEEN_POINTS)
    blurred = right + np.array([0.0, 3.0])
    wide, narrow = _alike(5, 3.0)[0], _alike(5, 0.01)[0]
    found = triangulate(PAIR, (left, blurred), (narrow, wide)).points
    np.testing.assert_allclose(LEFT.project(found), left, atol=0.001)
    other = triangulate(PAIR, (left, blurred), (wide, narrow)).points
    assert np.abs(LEFT.project(other) - left).max() > 1.0


def test_triangulate_of_rays_that_part_gives_nan_alone() -> None:
    left, right = _seen(SEEN_POINTS)
    right[1, 0] += 300.0
    found = triangulate(PAIR, (left, right), _alike(5))
    np.testing.assert_array_equal(
        np.isnan(found.points).any(axis=1), [False, True, False, False, False]
    )
    assert np.isnan(found.covariance[1]).all()
    np.testing.assert_allclose(found.points[2:], SEEN_POINTS[2:], atol=1e-9)


def test_triangulate_of_no_points_gives_none() -> None:
    nothing = np.zeros((0, 2))
    found = triangulate(PAIR, (nothing, nothing), _alike(0))
    assert found.points.shape == (0, 3)


def test_epipolar_distances_of_partners_are_zero() -> None:
    found = epipolar_distances(PAIR, _seen(SEEN_POINTS))
    np.testing.assert_allclose(found, 0.0, atol=1e-6)


def test_epipolar_distances_are_the_offsets_across_the_line() -> None:
    left, right = _seen(SEEN_POINTS[2:3])
    found = epipolar_distances(PAIR, (left, right + np.array([0.0, 1.0])))
    assert found[0] == pytest.approx([1.0, 1.0], abs=0.1)
    along = epipolar_distances(PAIR, (left, right + np.array([1.0, 0.0])))
    assert along.max() < 0.1
