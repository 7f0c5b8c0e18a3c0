"""Invalid and misleading pairs give a typed error, or a remark with their name."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest

from smartcam.calibration import Code, StereoCalibration, TargetView, Transform, calibrate_stereo
from smartcam.geometry._inside import exp_rotation
from tests.calibration.inside import check_apart
from tests.calibration.lens.test_wrong_views import flipped, mirrored
from tests.calibration.lenskit import BOARD, LEFT, RIG, RIGHT, pairs, poses, seen
from tests.calibration.scenes import refused

IMAGE = np.zeros((480, 640), dtype=np.uint8)

known = functools.partial(calibrate_stereo, left=LEFT, right=RIGHT, sheet="exact")


@pytest.mark.parametrize("views", [None, 3, IMAGE, "left", {}, [IMAGE] * 3])
def test_calibrate_stereo_of_no_views_is_refused(views: Any) -> None:
    left, right = pairs(3)
    with refused("SHAPE", "left view"):
        known(views, right)
    with refused("SHAPE", "right view"):
        known(left, views)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"left": np.eye(3)}, "stereo: left: expected a CameraModel"),
        ({"right": "right.yaml"}, "stereo: right: expected a CameraModel"),
        ({"sheet": "flat"}, "sheet: expected one of"),
        ({"fixed": "k3"}, "fixed: name: expected a list"),
    ],
)
def test_calibrate_stereo_of_wrong_options_is_refused(options: dict[str, Any], text: str) -> None:
    with refused("SHAPE", text):
        known(*pairs(3), **options)


def test_calibrate_stereo_accepts_an_iterator() -> None:
    left, right = pairs(2)
    once: Any = iter(left)
    found = known(once, right)
    assert np.linalg.norm(found.transform.translation - RIG.translation) < 2e-4


def test_calibrate_stereo_with_exchanged_lenses_is_refused() -> None:
    left, right = pairs(4)
    with refused("SWAPPED_LENSES", "times as large as with the two exchanged"):
        calibrate_stereo(left, right, left=RIGHT, right=LEFT)


def test_calibrate_stereo_with_equal_lenses_has_no_remark_on_them() -> None:
    left = poses(4, name="left")
    views = seen(LEFT, left, seed=1), seen(LEFT, [RIG @ one for one in left], seed=2)
    found = known(*views, right=LEFT)
    assert found.warnings == ()


def test_calibrate_stereo_of_one_image_on_both_sides_is_refused() -> None:
    left, right = pairs(3)
    with refused("COINCIDENT", "the same image on both sides in 00"):
        known(left, left)
    with refused("COINCIDENT", "the same image on both sides in 02"):
        known(left, [*right[:2], left[2]])


@pytest.mark.parametrize("lens", [LEFT, pytest.param(None, marks=pytest.mark.long)])
def test_calibrate_stereo_of_one_camera_twice_is_refused(lens: Any) -> None:
    both = poses(4, name="left")
    with refused("COINCIDENT", "are the images of both sides those of one camera?"):
        known(seen(LEFT, both, seed=1), seen(LEFT, both, seed=2), left=lens, right=lens)


def test_cameras_stand_apart_by_more_than_chance() -> None:
    covariance = np.diag([1e-6] * 6)
    check_apart(Transform("right", "left", np.eye(3), np.array([0.006, 0.0, 0.0])), covariance)
    with refused("COINCIDENT", "5 mm from the other"):
        check_apart(Transform("right", "left", np.eye(3), np.array([0.0, 0.005, 0.0])), covariance)


def test_calibrate_stereo_of_mirrored_right_images_is_refused() -> None:
    left, right = pairs(4)
    with refused("MIRRORED", "in 00", "was the picture flipped"):
        known(left, [mirrored(one) for one in right])
    with refused("POOR_FIT", "are they in the same order"):
        known(left, [flipped(one, 0) for one in right])


@pytest.mark.long
@pytest.mark.parametrize("side", [0, 1])
def test_calibrate_stereo_names_points_that_are_off_and_leaves_them_out(side: int) -> None:
    views, random = pairs(6), np.random.default_rng(1)
    for number, view in enumerate(views[side]):
        points = view.points.copy()
        points[random.integers(len(points))] += [2.0, 2.2]
        views[side][number] = dataclasses.replace(view, points=points)
    found = known(*views)
    (remark,) = [one for one in found.warnings if one.code == Code.OUTLIER]
    assert f"in 00, {('left', 'right')[side]} (" in remark.text
    assert found.rms < 0.055
    assert _points(found, side) == [len(one.ids) - 1 for one in views[side]]
    assert _points(found, 1 - side) == [len(one.ids) for one in views[1 - side]]


def _points(found: StereoCalibration, side: int) -> list[int]:
    views: list[TargetView | None] = [(one.left, one.right)[side] for one in found.pairs]
    return [len(one.ids) for one in views if one is not None]


def test_calibrate_stereo_with_a_lens_of_another_camera_has_a_remark() -> None:
    left, right = pairs(4)
    found = known(left, right, left=LEFT, right=LEFT)
    (remark,) = [one for one in found.warnings if one.code == Code.WRONG_LENS]
    assert remark.text.startswith("the right lens that was given leaves 4.")


def test_calibrate_stereo_of_invalid_arguments_is_refused() -> None:
    left, right = pairs(3)
    twice = [*left, left[0]], [*right, right[0]]
    found = known(*twice)
    texts = {one.code: one.text for one in found.warnings}
    assert texts[Code.COINCIDENT].startswith("views that are the same to the last digit: 00, left")


def zoomed(view: TargetView, factor: float) -> TargetView:
    """Return the view in a picture that is larger around its middle."""
    middle = (np.array(view.size) - 1) / 2
    points = factor * (view.points - middle) + middle
    there = ((points > 0) & (points < np.array(view.size) - 1)).all(axis=1)
    return dataclasses.replace(
        view, ids=view.ids[there], points=points[there], covariance=view.covariance[there]
    )


def knocked(turn: float, shift: float) -> Transform:
    """Return the rig after a turn about y, rad, and a shift along x, metres."""
    turned = exp_rotation(np.array([0.0, turn, 0.0])) @ RIG.rotation
    return Transform("right", "left", turned, RIG.translation + np.array([shift, 0.0, 0.0]))


@pytest.mark.parametrize(
    ("change", "code", "text"),
    [
        ("zoom", Code.WRONG_LENS, "right camera: was the zoom or the focus moved"),
        # a turn by 2 mrad hardly differs from a principal point that moved by one pixel
        ("turn", Code.WRONG_LENS, "did the cameras move against each other"),
        ("shift", Code.POOR_FIT, "those from 05 on do not fit those before: did the cameras move"),
        ("apart", Code.NOT_SIMULTANEOUS, "did the target move between the two"),
    ],
)
def test_calibrate_stereo_reports_what_changed_between_pairs(
    change: str, code: Code, text: str
) -> None:
    (left, right), lefts = pairs(10), poses(10, name="left")
    random = np.random.default_rng(5)
    moved = [
        Transform("left", "target", one.rotation, one.translation + random.normal(0, 3e-4, 3))
        for one in lefts
    ]
    rig = knocked(0.0, 1e-3) if change == "shift" else knocked(2e-3, 0.0)
    other = {
        "zoom": [zoomed(one, 1.01) for one in right],
        "apart": seen(RIGHT, [RIG @ one for one in moved], seed=2),
    }.get(change, seen(RIGHT, [rig @ one for one in lefts], seed=2))
    found = calibrate_stereo(left, other if change == "apart" else [*right[:5], *other[5:]])
    (remark,) = found.warnings
    assert remark.code == code
    assert text in remark.text
    assert "sheets that bend anew" in remark.text


def test_calibrate_stereo_of_sheets_that_bend_anew_reports_no_change() -> None:
    random, lefts = np.random.default_rng(6), poses(10, name="left")
    x, y = ((BOARD.points - BOARD.points.mean(axis=0)) / 0.1).T[:2]
    left, right = list[TargetView](), list[TargetView]()
    for number, pose in enumerate(lefts):
        points = BOARD.points.copy()
        points[:, 2] = 4e-4 * random.normal(size=3) @ [x**2, x * y, y**2]
        left += seen(LEFT, [pose], seed=number, points=points)
        right += seen(RIGHT, [RIG @ pose], seed=100 + number, points=points)
    codes = {one.code for one in calibrate_stereo(left, right).warnings}
    assert codes.isdisjoint({Code.WRONG_LENS, Code.POOR_FIT, Code.NOT_SIMULTANEOUS})
