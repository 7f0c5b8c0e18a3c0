from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from lenskit import LEFT, RIG, RIGHT, pairs, poses, seen
from scipy.spatial.transform import Rotation

from smartcam.calibration.lens.bundle import (
    IDENTITY,
    Bundle,
    Motion,
    Sight,
    adjust,
    adjust_weighted,
    lens_values,
    with_lens,
)


def _bundle(count: int, *, free: bool = True) -> Bundle:
    """Return the truth of the two cameras of the kit."""
    columns = np.eye(9) if free else np.zeros((9, 0))
    return Bundle(
        (LEFT, RIGHT),
        (IDENTITY, Motion(RIG.rotation, RIG.translation)),
        tuple(Motion(one.rotation, one.translation) for one in poses(count, name="left")),
        (columns, columns),
        rigid=not free,
    )


def _sights(count: int, sigma: float) -> list[Sight]:
    both = pairs(count, sigma=sigma)
    return [Sight(side, n, view) for side, views in enumerate(both) for n, view in enumerate(views)]


def test_with_lens_of_the_values_is_the_same_lens() -> None:
    again = with_lens(RIGHT, lens_values(RIGHT))
    assert again.matrix.tolist() == RIGHT.matrix.tolist()
    assert again.distortion.tolist() == RIGHT.distortion.tolist()


def test_bundle_shared_counts_lenses_and_rig() -> None:
    assert (_bundle(3).shared, _bundle(3, free=False).shared) == (24, 0)
    assert _bundle(3).lens_columns == [slice(0, 9), slice(9, 18)]


def test_motion_moved_turns_and_shifts_in_the_frame_it_leads_to() -> None:
    moved = Motion(RIG.rotation, RIG.translation).moved(np.array([0.1, 0, 0, 1, 2, 3]))
    expected = Rotation.from_rotvec([0.1, 0, 0]).as_matrix() @ RIG.rotation
    np.testing.assert_allclose(moved.rotation, expected, atol=1e-12)
    np.testing.assert_allclose(moved.translation, RIG.translation + np.array([1, 2, 3]))


def test_adjust_from_near_goes_back_to_the_truth() -> None:
    truth = _bundle(6)
    random = np.random.default_rng(1)
    scale = np.array([5, 5, 5, 5, 0.02, 0.02, 1e-3, 1e-3, 0.02] * 2 + [0.02] * 6)
    away = truth.moved(scale * random.normal(size=24), 0.01 * random.normal(size=(6, 6)))
    found = adjust(away, _sights(6, 0.0), 0.0)
    assert found.weighted < 1e-3
    for one, other in zip(found.bundle.cameras, truth.cameras, strict=True):
        np.testing.assert_allclose(one.matrix, other.matrix, atol=1e-3)
    np.testing.assert_allclose(found.bundle.rig[1].translation, RIG.translation, atol=1e-6)


def test_adjust_sum_of_squares_is_its_freedom() -> None:
    found = adjust(_bundle(8), _sights(8, 0.1), 0.0)
    count = sum(len(one) for one in found.residuals)
    assert found.freedom == 2 * count - 24 - 6 * 8
    assert found.weighted == pytest.approx(found.freedom, rel=0.15)


def test_adjust_covariance_of_poses_is_that_of_their_errors() -> None:
    squares = []
    for seed in range(20):
        truth = poses(4, seed=seed)
        views = seen(LEFT, truth, sigma=0.1, seed=seed)
        motions = tuple(Motion(one.rotation, one.translation) for one in truth)
        bundle = Bundle((LEFT,), (IDENTITY,), motions, (np.eye(9)[:, :2],))
        found = adjust(bundle, [Sight(0, n, view) for n, view in enumerate(views)], 0.0)
        turn = found.bundle.poses[0].rotation @ truth[0].rotation.T
        shift = found.bundle.poses[0].translation - truth[0].translation
        off = np.concatenate([Rotation.from_matrix(turn).as_rotvec(), shift])
        squares.append(off @ np.linalg.solve(found.pose_covariance[0], off))
    assert np.mean(squares) == pytest.approx(6.0, abs=2.4)  # 3 sigma of the mean


def test_adjust_leaves_a_pose_that_no_view_shows() -> None:
    bundle, sights = _bundle(4), [one for one in _sights(4, 0.05) if one.pose != 2]
    found = adjust(bundle, sights, 0.0)
    assert found.bundle.poses[2].translation.tolist() == bundle.poses[2].translation.tolist()
    assert found.freedom == 2 * sum(len(one) for one in found.residuals) - 24 - 6 * 3


def test_adjust_of_points_behind_the_camera_gives_up() -> None:
    bundle = _bundle(3)
    behind = tuple(one.moved(np.array([0, 0, 0, 0, 0, -9.0])) for one in bundle.poses)
    away = Bundle(bundle.cameras, bundle.rig, behind, bundle.basis)
    found = adjust(away, _sights(3, 0.0), 0.0)
    assert math.isinf(found.weighted)
    assert np.isnan(found.covariance).all()


def test_adjust_weighted_finds_what_the_covariance_does_not_say() -> None:
    sights = [
        one._replace(view=dataclasses.replace(one.view, covariance=0.01 * one.view.covariance))
        for one in _sights(8, 0.2)
    ]
    found = adjust_weighted(_bundle(8), sights)
    assert math.sqrt(found.more) == pytest.approx(0.2, rel=0.1)
    assert found.weighted == pytest.approx(found.freedom, rel=0.02)
