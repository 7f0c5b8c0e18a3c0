"""``/tf_static``: where calibrations put a camera, and who hears of it."""

from __future__ import annotations

import logging
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from smartcam.calibration import Transform, fit_plane
from smartcam.calibration._geometry.rotations import matrix_from_quaternion
from smartcam.exceptions import ConfigurationError
from smartcam.ros2._qos import LATCHED
from smartcam.ros2._transforms import StaticTransforms, camera_transforms, transform_fields
from tests.ros2.roskit import soon, two_nodes

TF = "tf2_msgs/msg/TFMessage"


def turned(target: str, source: str, shift: tuple[float, float, float]) -> Transform:
    quaternion = np.array([0.1, -0.5, 0.3, 0.8])
    turn = matrix_from_quaternion(quaternion / np.linalg.norm(quaternion))
    return Transform(target, source, turn, np.array(shift))


@pytest.mark.parametrize(
    ("pose", "parent", "named"),
    [("base", "", "base"), ("flange", "", "flange"), ("flange", "tool0", "tool0")],
)
def test_hand_eye_puts_the_camera_at_the_base_or_the_flange(
    pose: str, parent: str, named: str
) -> None:
    found = turned(pose, "camera", (0.1, 0.2, 0.3))
    calibration = SimpleNamespace(kind="hand-eye", camera_pose=found)
    (one,) = camera_transforms(calibration, "cam3_optical", parent=parent)
    assert (one.target, one.source) == (named, "cam3_optical")
    points = np.array([[0.0, 0, 1], [0.3, -0.2, 2]])
    assert np.allclose(one.apply(points), found.apply(points))


def test_of_a_pair_the_right_camera_is_where_the_left_one_has_it() -> None:
    shift = Transform("right", "left", np.eye(3), np.array([-0.12, 0, 0]))
    calibration = SimpleNamespace(kind="stereo", transform=shift)
    (one,) = camera_transforms(calibration, "head_optical")
    assert (one.target, one.source) == ("head_optical", "head_right_optical")
    assert one.translation.tolist() == pytest.approx([0.12, 0, 0])  # to the right of the left one


def test_a_plane_is_where_its_poses_are() -> None:
    seen = np.array([[0, 0], [100, 0], [0, 100], [100, 100], [50, 20]], float)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    touched = (np.column_stack([seen, np.zeros(5)]) / 1000) @ turn.T + [0.5, 0.1, 0.02]
    calibration = fit_plane(seen, touched, model="similarity")
    (one,) = camera_transforms(calibration, "cam3_optical")
    assert (one.target, one.source) == ("robot", "cam3_optical_plane")
    assert np.allclose(one.apply(np.array([[0.1, 0, 0]])), touched[1])


def test_what_says_nothing_of_a_place_gives_none(caplog: pytest.LogCaptureFixture) -> None:
    seen = np.array([[0, 0], [100, 0], [0, 100], [100, 100], [50, 20]], float)
    touched = np.column_stack([seen[:, 0] * 0.001, seen[:, 1] * 0.002, np.zeros(5)])
    with caplog.at_level(logging.INFO, "smartcam.ros2"):
        assert camera_transforms(fit_plane(seen, touched, model="affine"), "a") == []
    assert "scale" in caplog.text
    assert camera_transforms(None, "a") == []
    assert camera_transforms(SimpleNamespace(kind="sheet"), "a") == []


def test_a_quaternion_is_of_length_one() -> None:
    fields = transform_fields(turned("base", "cam", (1, 2, 3)), 10.5)
    turn = fields["transform"]["rotation"]
    assert sum(one * one for one in turn.values()) == pytest.approx(1, abs=1e-12)
    assert fields["transform"]["translation"] == {"x": 1, "y": 2, "z": 3}
    assert fields["header"] == {"stamp": {"sec": 10, "nanosec": 500_000_000}, "frame_id": "base"}
    assert fields["child_frame_id"] == "cam"


@pytest.mark.parametrize(
    "names",
    [[("", "a")], [("/base", "a")], [("a", "a")], [("base", "a"), ("flange", "a")]],
)
def test_a_tree_that_is_none_is_refused(names: list[tuple[str, str]]) -> None:
    with pytest.raises(ConfigurationError, match="tf: "):
        StaticTransforms(None, [turned(*pair, (0, 0, 0)) for pair in names])


@pytest.mark.real_time
async def test_who_comes_late_hears_all_of_them() -> None:
    async with two_nodes() as (here, there):
        transforms = StaticTransforms(
            here, [turned("base", "a_optical", (1, 0, 0)), turned("base", "b_optical", (2, 0, 0))]
        )
        transforms.start()
        hears = there.subscribe("/tf_static", TF, qos=LATCHED)
        message: Any = await soon(anext(hears))
        assert [one.child_frame_id for one in message.transforms] == ["a_optical", "b_optical"]
        assert [one.header.frame_id for one in message.transforms] == ["base", "base"]
        transforms.replace([turned("flange", "a_optical", (3, 0, 0))])
        (one,) = (await soon(anext(hears))).transforms
        assert one.transform.translation.x == 3
        later = there.subscribe("/tf_static", TF, qos=LATCHED)
        (one,) = (await soon(anext(later))).transforms
        assert one.header.frame_id == "flange"
        await transforms.close()
        await transforms.close()


@pytest.mark.real_time
async def test_without_any_there_is_no_topic() -> None:
    async with two_nodes() as (here, _):
        transforms = StaticTransforms(here)
        transforms.start()
        assert transforms._publisher is None
        transforms.replace([turned("base", "a_optical", (1, 0, 0))])
        assert transforms._publisher is not None
        await transforms.close()
