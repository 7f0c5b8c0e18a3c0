"""``/tf_static``: places of calibrated cameras, and their subscribers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from smartcam.calibration import MovingCamera, Transform, chain_of, fit_plane
from smartcam.exceptions import ConfigurationError
from smartcam.geometry._inside import matrix_from_quaternion
from smartcam.ros2._cameras.transforms import CameraFrames, StaticTransforms, transform_fields
from smartcam.ros2._inside import LATCHED
from tests.ros2.camerakit import PartsCamera
from tests.ros2.nodekit import seen, until
from tests.ros2.roskit import soon, two_nodes
from tests.ros2.tfkit import TransformTree, has_tf2

TF = "tf2_msgs/msg/TFMessage"


def turned(target: str, source: str, shift: tuple[float, float, float]) -> Transform:
    quaternion = np.array([0.1, -0.5, 0.3, 0.8])
    turn = matrix_from_quaternion(quaternion / np.linalg.norm(quaternion))
    return Transform(target, source, turn, np.array(shift))


@pytest.mark.parametrize(
    ("setup", "names", "named"),
    [
        ("eye-to-hand", {}, "of_the_robot"),
        ("eye-to-hand", {"parent": "base_link", "flange": "tool0"}, "base_link"),
        ("eye-in-hand", {"parent": "base_link"}, "of_the_robot"),
        ("eye-in-hand", {"parent": "base_link", "flange": "tool0"}, "tool0"),
    ],
)
def test_hand_eye_puts_the_pictures_at_the_base_or_the_flange(
    setup: str, names: dict[str, Any], named: str
) -> None:
    found = turned("of_the_robot", "camera", (0.1, 0.2, 0.3))
    place = SimpleNamespace(setup=setup, camera_pose=found)
    frames = CameraFrames("cam3", hand_eye=place, **names)
    (one,) = frames.transforms()
    assert (one.target, one.source) == (named, "cam3_optical")
    assert frames.optical == "cam3_optical"
    points = np.array([[0.0, 0, 1], [0.3, -0.2, 2]])
    assert np.allclose(one.apply(points), found.apply(points))


SEEN = np.array([[0, 0], [0.1, 0], [0, 0.1], [0.1, 0.1], [0.05, 0.02]], float)
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
TOUCHED = np.column_stack([SEEN, np.zeros(5)]) @ TURN.T + [0.5, 0.1, 0.02]
HIGHER = np.array([0, 0, 0.1])


def test_a_plane_is_where_its_poses_are() -> None:
    calibration = fit_plane(SEEN, TOUCHED, model="similarity")
    (one,) = CameraFrames("cam_plane", calibration).transforms()
    assert (one.target, one.source) == ("robot", "cam_plane")
    assert np.allclose(one.apply(np.array([[0.1, 0, 0]])), TOUCHED[1])
    (one,) = CameraFrames("cam_plane", calibration, parent="base_link").transforms()
    assert (one.target, one.source) == ("base_link", "cam_plane")


def test_each_application_has_a_plane() -> None:
    given = {1: fit_plane(SEEN, TOUCHED), 2: None, 3: fit_plane(SEEN, TOUCHED + HIGHER)}
    found = CameraFrames("cam", given).transforms()
    assert [(one.target, one.source) for one in found] == [("robot", "cam_1"), ("robot", "cam_3")]
    assert found[1].translation[2] - found[0].translation[2] == pytest.approx(0.1)


def test_a_plane_of_two_scales_has_a_frame_too() -> None:
    touched = np.column_stack([SEEN[:, 0], SEEN[:, 1] * 2, np.zeros(5)])
    (one,) = CameraFrames("a", fit_plane(SEEN, touched, model="affine")).transforms()
    assert (one.target, one.source) == ("robot", "a")
    assert np.allclose(one.rotation, np.eye(3))
    assert CameraFrames("a").transforms() == []
    assert CameraFrames("a", SimpleNamespace(to_robot=list)).transforms() == []


# ---------------------------------------------------------------------- what tf2 finds


async def first_pose(**options: Any) -> tuple[Any, TransformTree]:
    """Return the first poses of a camera with a calibration, and the frames that were heard."""
    calibration = fit_plane(SEEN, TOUCHED, model="similarity")
    client = {"interpret_as": "localizations", "calibration": calibration}
    tree = TransformTree()
    async with seen(PartsCamera(), client=client, frame_id="cam", **options) as found:
        tree.hear(found.node.last("/tf_static"))
        await until(lambda: found.seen.lifecycle.active)
        await found.camera.trigger()
        await until(lambda: found.node.topics["~/detections"].said)
        poses = found.node.last("~/localizations")
        for topic in ("~/detections", "~/results"):
            assert found.node.last(topic).header.frame_id == poses.header.frame_id
        texts = await found.node.services["~/TriggerLocalization"].call(camera_name="")
        assert texts.localizations[0].pose.header.frame_id == poses.header.frame_id
        return poses, tree


def where(pose: Any) -> list[list[float]]:
    return [[pose.position.x, pose.position.y, pose.position.z]]


def test_lookups_of_these_tests_are_those_of_tf2_itself() -> None:
    if not has_tf2():
        pytest.skip("needs Debian's tf2: apt-get install python3-tf2 python3-rospy")
    tree = TransformTree()  # which compares each of its lookups with tf2's
    tree.put("base_link", "tool0", (0.5, 0.2, 0.7), (0.6, 0, 0, 0.8))
    tree.put("tool0", "cam", (0.1, 0, 0.05), (0, 0, 0.6, 0.8))
    tree.put("map", "table")
    assert np.allclose(tree.lookup("tool0", "base_link").apply([[0.5, 0.2, 0.7]]), 0)
    assert tree._by_tf2("base_link", "cam")["place"] == pytest.approx([0.6, 0.152, 0.714])
    for target, source in (("base_link", "table"), ("base_link", "robot")):
        with pytest.raises(LookupError):
            tree.lookup(target, source)
        assert "error" in tree._by_tf2(target, source)


async def test_tf_finds_the_poses_of_a_plane_from_base_link() -> None:
    poses, tree = await first_pose(parent_frame="base_link")
    assert poses.header.frame_id == "base_link"
    assert np.allclose(tree.lookup("base_link", poses.header.frame_id).translation, 0)
    plane = tree.lookup("cam", poses.header.frame_id)
    assert np.allclose(plane.apply(where(poses.poses[0])), [[0.001, -0.25, 0]])
    poses, tree = await first_pose()
    tree.lookup("robot", poses.header.frame_id)
    with pytest.raises(LookupError):
        tree.lookup("base_link", poses.header.frame_id)


async def test_tf_finds_the_poses_of_a_camera_that_the_robot_carries() -> None:
    turn = (0.0, 0.0, np.sin(0.2), np.cos(0.2))
    calibration_pose = Transform.from_quaternion("robot", "flange", (0.4, 0.1, 0.6), turn)
    poses, tree = await first_pose(
        parent_frame="base_link", flange_frame="tool0", calibration_pose=calibration_pose
    )
    assert poses.header.frame_id == "cam_robot"
    tree.put("base_link", "tool0", (0.4, 0.1, 0.6), turn)  # the robot as it was then
    still = tree.lookup("base_link", poses.header.frame_id)
    assert np.allclose(still.rotation, np.eye(3))
    assert np.allclose(still.translation, 0)
    now = Transform.from_quaternion("robot", "flange", (0.7, -0.1, 0.6), (0, 0, 0, 1))
    tree.put("base_link", "tool0", (0.7, -0.1, 0.6))  # and somewhere else
    calibration = fit_plane(SEEN, TOUCHED, model="similarity")
    carried = MovingCamera(chain_of(calibration), calibration_pose, field=TOUCHED)
    wanted = carried.at_pose(now).transform([[0.001, -0.25]])
    moved = tree.lookup("base_link", poses.header.frame_id)
    assert np.allclose(moved.apply(where(poses.poses[0])), wanted)


def test_a_quaternion_is_of_length_one() -> None:
    fields = transform_fields(turned("base", "cam", (1, 2, 3)), 10.5)
    turn = fields["transform"]["rotation"]
    assert sum(one * one for one in turn.values()) == pytest.approx(1, abs=1e-12)
    assert fields["transform"]["translation"] == {"x": 1, "y": 2, "z": 3}
    assert fields["header"] == {"stamp": {"sec": 10, "nanosec": 500_000_000}, "frame_id": "base"}
    assert fields["child_frame_id"] == "cam"


@pytest.mark.parametrize(
    "names", [[("", "a")], [("/base", "a")], [("a", "a")], [("base", "a"), ("flange", "a")]]
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
