"""Invalid and misleading pairs give a typed error, or a remark with their name."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest

from smartcam.calibration import StereoCalibration, TargetView, Transform, calibrate_stereo
from smartcam.geometry._inside import Code, exp_rotation
from tests.calibration.inside import check_cameras_apart
from tests.calibration.lens.test_wrong_views import flipped, mirrored
from tests.calibration.lenskit import LEFT, RIG, RIGHT, pairs, poses, seen
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
    check_cameras_apart(
        Transform("right", "left", np.eye(3), np.array([0.006, 0.0, 0.0])), covariance
    )
    with refused("COINCIDENT", "5 mm from the other"):
        check_cameras_apart(
            Transform("right", "left", np.eye(3), np.array([0.0, 0.005, 0.0])), covariance
        )


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


ZOOMED = dataclasses.replace(RIGHT, matrix=np.diag([1.01, 1.01, 1.0]) @ RIGHT.matrix)
TURNED = dataclasses.replace(RIG, rotation=exp_rotation(np.array([0, 2e-3, 0])) @ RIG.rotation)
SHIFTED = dataclasses.replace(RIG, translation=RIG.translation + np.array([1e-3, 0.0, 0.0]))


@pytest.mark.parametrize(
    ("camera", "rig", "moved", "code", "text"),
    [
        (ZOOMED, RIG, 0.0, Code.WRONG_LENS, "right camera: was the zoom or the focus moved"),
        (RIGHT, TURNED, 0.0, Code.WRONG_LENS, "did the cameras move against each other"),
        (RIGHT, SHIFTED, 0.0, Code.POOR_FIT, "from 05 on do not fit those before: did the cameras"),
        (RIGHT, RIG, 3e-4, Code.NOT_SIMULTANEOUS, "did the target move between the two"),
    ],
)
def test_calibrate_stereo_reports_what_changed_between_pairs(
    camera: Any, rig: Transform, moved: float, code: Code, text: str
) -> None:
    (left, right), random = pairs(10), np.random.default_rng(5)
    then = [
        dataclasses.replace(one, translation=one.translation + random.normal(0, moved, 3))
        for one in poses(10, name="left")
    ]
    other = seen(camera, [rig @ one for one in then], seed=2)
    found = calibrate_stereo(left, other if moved else [*right[:5], *other[5:]])
    (remark,) = found.warnings
    assert remark.code == code
    assert text in remark.text
