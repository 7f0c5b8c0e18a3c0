"""The choice of the next view by its gain, and its text."""

from __future__ import annotations

import math

import numpy as np
import pytest

from smartcam.calibration import CameraModel, Charuco, Transform, suggest_views
from smartcam.calibration._inside import Target
from smartcam.calibration._lens.guide import NextView, candidate_views
from smartcam.exceptions import CalibrationError
from smartcam.geometry._inside import Code, exp_rotation
from tests.calibration import lenskit
from tests.calibration.lens.estimates import Bench, spread_poses

LENS = lenskit.LEFT
CENTRE = Bench(LENS, lenskit.poses(4, seed=3))
CHARUCO = Charuco(columns=7, rows=5, square=0.03, marker=0.0225)


def test_best_view_comes_first_and_each_view_has_its_gain() -> None:
    found = suggest_views(CENTRE.calibration())
    means = [one.rms_with for one in found]
    assert len(found) > 60
    assert means == sorted(means)
    assert means[-1] < found[0].rms_without
    assert found[0].rms_with < 0.1 * found[0].rms_without


def test_mean_of_a_view_is_the_uncertainty_after_it() -> None:
    best = suggest_views(CENTRE.calibration(), distance=0.4)[0]
    taken = Bench(LENS, [*CENTRE.poses, best.transform])
    before = CENTRE.calibration().uncertainty(distance=0.4, shape=(9, 12))
    assert best.rms_without == pytest.approx(before.figures.rms, rel=1e-6)
    # the gauge includes the new view, too, so both differ a little
    after = taken.calibration().uncertainty(distance=0.4, shape=(9, 12))
    assert best.rms_with == pytest.approx(after.figures.rms, rel=0.3)


def test_view_at_a_new_place_of_the_target_helps_more() -> None:
    best = suggest_views(CENTRE.calibration())[0]
    corners = np.array([[0, 0], [639, 0], [639, 479], [0, 479]])
    near = np.linalg.norm(best.outline[:, None] - corners, axis=2).min()
    was = min(np.linalg.norm(view.points[:, None] - corners, axis=2).min() for view in CENTRE.views)
    assert near < was


@pytest.mark.parametrize("camera", [lenskit.LEFT, lenskit.WIDE, lenskit.FISHEYE])
@pytest.mark.parametrize("target", [lenskit.BOARD, CHARUCO])
def test_all_points_of_a_candidate_are_in_the_image(camera: CameraModel, target: Target) -> None:
    found = candidate_views(camera, target, roll=math.pi / 2)
    assert len(found.texts) >= 50
    for pose in map(found.poses.subset, range(found.poses.size)):
        seen = camera.project(pose.apply(target.points))
        assert ((seen >= 0) & (seen <= np.array(camera.size) - 1)).all()


def test_text_names_the_target_s_place_and_its_far_side() -> None:
    straight = CameraModel(size=(640, 480), matrix=LENS.matrix)
    found = candidate_views(straight, lenskit.BOARD)
    poses = dict(zip(found.texts, map(found.poses.subset, range(found.poses.size)), strict=True))
    where = {
        "in the upper left corner of the image": (0, 0),
        "in the lower right corner of the image": (1, 1),
        "at the left edge of the image": (0, None),
        "at the lower edge of the image": (None, 1),
        "in the middle of the image": (None, None),
    }
    for place, (right, lower) in where.items():
        pose = poses[f"{place}, far, not tilted"]
        middle = straight.project(pose.apply(lenskit.BOARD.points)).mean(axis=0) / [640, 480]
        for part, beyond in zip(middle, (right, lower), strict=True):
            if beyond is None:
                assert part == pytest.approx(0.5, abs=0.03)
            else:
                assert (part > 0.55) == beyond
    for side, axis, sign in (("right", 0, 1), ("left", 0, -1), ("lower", 1, 1), ("upper", 1, -1)):
        text = f"in the middle of the image, near, tilted by 35 degrees, its {side} side farther"
        pose = poses[f"{text} away"]
        points = pose.apply(lenskit.BOARD.points)
        farthest = points[points[:, 2].argmax()] - points.mean(axis=0)
        assert sign * farthest[axis] > 0.04


def test_fixed_values_stay_fixed() -> None:
    held = CENTRE.calibration()
    held.covariance[8] = held.covariance[:, 8] = 0.0  # k3
    found = suggest_views(held)
    assert all(math.isfinite(one.rms_with) and one.rms_with < one.rms_without for one in found)


def test_invalid_distance_is_refused() -> None:
    with pytest.raises(CalibrationError) as caught:
        suggest_views(CENTRE.calibration(), distance=-1.0)
    assert caught.value.code == Code.NOT_FINITE


def held(best: NextView, random: np.random.Generator) -> Transform:
    """Return a pose that a person would hold: 3 degrees and 10 mm off the suggested one."""
    turn = exp_rotation(random.normal(0, math.radians(3), 3)) @ best.transform.rotation
    shift = best.transform.translation + random.normal(0, 0.01, 3)
    return Transform("camera", "target", turn, shift)


@pytest.mark.long
@pytest.mark.parametrize("camera", [lenskit.LEFT, lenskit.FISHEYE])
def test_ten_suggested_views_beat_ten_random_ones(camera: CameraModel) -> None:
    ratios = []
    for seed in range(3):
        random = np.random.default_rng(seed)
        first = spread_poses(camera, 3, seed=seed)
        guided, anyhow = list(first), [*first, *spread_poses(camera, 10, seed=100 + seed)]
        for number in range(10):
            found = suggest_views(Bench(camera, guided).calibration(number))
            guided.append(held(found[0], random))
        means = [
            Bench(camera, poses).calibration().uncertainty().figures.rms
            for poses in (guided, anyhow)
        ]
        ratios.append(means[1] / means[0])
    assert min(ratios) > 1.2
    assert float(np.median(ratios)) > 1.5
