"""A camera on the robot is right for an unmoved plane, and refused for a moved one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from smartcam.calibration import Chain, MovingCamera, PoseHistory, Transform, chain_of, fit_plane
from smartcam.calibration._plane.moving_camera import RigidMotion
from tests.calibration.inside import Poses, RealWorldPosition
from tests.geometry.rigid import (
    NOON,
    after,
    angles,
    localization,
    refused,
    rotation_about,
    transforms,
    yaw,
)

SEEN = np.array([[0.0, 0.0], [0.15, 0.05], [-0.1, 0.12], [0.02, -0.14]])
TABLE = np.column_stack([SEEN, np.zeros(4)])


def camera(table: Transform, flange: Transform, tolerance: float = 2e-4) -> MovingCamera:
    """Return a moving camera whose frame was the table's at the calibration."""
    static = RealWorldPosition(table.translation, table.rotation)
    return MovingCamera(static, flange, field=table.apply(TABLE), tolerance=tolerance)


def carried(table: Transform, motion: Transform, flange: Transform) -> Transform:
    """Return the flange's pose after a motion that is given in the table's frame."""
    return table @ motion @ table.inverse() @ flange


def in_plane(turn: float, x: float, y: float) -> Transform:
    return Transform("table", "table", yaw(turn), np.array([x, y, 0.0]))


@given(
    transforms("base", "table"),
    transforms("base", "flange"),
    angles,
    st.floats(-1, 1),
    st.floats(-1, 1),
)
def test_moving_camera_is_the_static_one_calibrated_at_the_new_pose(
    table: Transform, flange: Transform, turn: float, x: float, y: float
) -> None:
    motion = in_plane(turn, x, y)
    chain = camera(table, flange).at_pose(carried(table, motion, flange))
    anew = table @ motion
    static = RealWorldPosition(anew.translation, anew.rotation)
    found = chain.solve(Poses.planar(SEEN, [0.1, 0.2, 0.3, 0.4]))
    expected = static.solve(Poses.planar(SEEN, [0.1, 0.2, 0.3, 0.4]))
    np.testing.assert_allclose(found.points, expected.points, atol=1e-9)
    same = np.abs(np.sum(found.quaternions * expected.quaternions, axis=1))
    np.testing.assert_allclose(same, 1, atol=1e-12)


TABLE_POSE = Transform(
    "base", "table", rotation_about(np.array([0.1, 0.2, 1]), 0.4), np.array([0.4, -0.3, 0.1])
)
FLANGE = Transform(
    "base",
    "flange",
    rotation_about(np.array([0.3, 0.1, -1]), 2.0),
    np.array([0.5, -0.2, 0.6]),
    NOON,
)


def test_moving_camera_that_stayed_is_the_static_one() -> None:
    chain = camera(TABLE_POSE, FLANGE).at_pose(FLANGE, NOON)
    (part,) = chain.to_robot([localization(0.15, 0.05)])
    expected = TABLE_POSE.apply([0.15, 0.05, 0])
    np.testing.assert_allclose(part.pose.position, expected, atol=1e-15)
    assert part.pose.header.frame_id == "base"


@pytest.mark.parametrize(
    ("rotation", "shift", "texts"),
    [
        (
            np.eye(3),
            (0, 0, 0.01),
            ("by 10.00 mm along its normal and tilts it by 0.00 deg", "10.00 mm at"),
        ),
        (
            rotation_about(np.array([0, np.sin(0.0349), np.cos(0.0349)]), 0),
            (0, 0, 0),
            ("2.00 deg",),
        ),
        (np.diag([1.0, -1.0, -1.0]), (0, 0, 0), ("180.00 deg",)),
    ],
    ids=["raised", "tilted", "upside down"],
)
def test_moving_camera_whose_plane_moves_is_refused(
    rotation: NDArray[np.float64], shift: tuple[float, float, float], texts: tuple[str, ...]
) -> None:
    motion = Transform("table", "table", rotation, np.array(shift))
    pose = carried(TABLE_POSE, motion, FLANGE)
    with refused("PLANE_MOVED", "within 0.2 mm", *texts):
        camera(TABLE_POSE, FLANGE).at_pose(pose)


def test_moving_camera_tolerance_is_checked_in_the_field() -> None:
    tilt = Transform("table", "table", rotation_about(np.array([0, 1e-3, 1.0]), 0), np.zeros(3))
    pose = carried(TABLE_POSE, tilt, FLANGE)
    camera(TABLE_POSE, FLANGE, tolerance=2e-4).at_pose(pose)
    with refused("PLANE_MOVED", "within 0.1 mm"):
        camera(TABLE_POSE, FLANGE, tolerance=1e-4).at_pose(pose)


def test_moving_camera_noise_of_the_touches_is_no_motion() -> None:
    touched = TABLE_POSE.apply(TABLE + np.outer([5e-4, -5e-4, 5e-4, -5e-4], [0, 0, 1]))
    static = RealWorldPosition(TABLE_POSE.translation, TABLE_POSE.rotation)
    MovingCamera(static, FLANGE, field=touched, tolerance=1e-6).at_pose(FLANGE)


def test_moving_camera_image_and_pose_must_belong_together() -> None:
    one = camera(TABLE_POSE, FLANGE)
    one.at_pose(FLANGE, after(0.001))
    with refused("NOT_SIMULTANEOUS", "within 1 ms of the image, got one 20 ms from it"):
        one.at_pose(FLANGE, after(-0.02))
    with refused("NOT_SIMULTANEOUS", "the time of T_base_flange"):
        one.at_pose(FLANGE.undated(), NOON)
    one.at_pose(FLANGE.undated())


def test_moving_camera_takes_the_pose_at_the_image_from_a_history() -> None:
    """The robot goes 250 mm/s; a pose 20 ms old would be 5 mm off."""
    flange = PoseHistory()
    along = TABLE_POSE.rotation[:, 0]
    for seconds in (0.0, 0.05):
        place = FLANGE.translation + 0.25 * seconds * along
        flange.add(Transform("base", "flange", FLANGE.rotation, place, after(seconds)))
    image_at = after(0.02)
    chain = camera(TABLE_POSE, FLANGE).at_pose(flange.at(image_at), image_at)
    expected = TABLE_POSE.apply([0.15 + 0.005, 0.05, 0])
    np.testing.assert_allclose(chain.transform([(0.15, 0.05)])[0], expected, atol=1e-12)


def test_moving_camera_pose_of_other_frames_is_refused() -> None:
    with refused("WRONG_FRAME", "expected T_base_flange", "got T_flange_base"):
        camera(TABLE_POSE, FLANGE).at_pose(FLANGE.inverse())


def test_moving_camera_takes_the_poses_of_its_own_camera_only() -> None:
    static = Chain([], camera_frame="left")
    one = MovingCamera(static, FLANGE, field=TABLE_POSE.apply(TABLE))
    with refused("WRONG_FRAME", "the frame 'left'"):
        one.at_pose(FLANGE).to_robot([localization(0, 0)])


def test_moving_camera_knows_the_y_down_of_its_chain() -> None:
    field = TABLE_POSE.apply(TABLE)
    static = Chain([], y_down=True)
    assert MovingCamera(static, FLANGE, field=field).at_pose(FLANGE).y_down is True
    alone = MovingCamera(RigidMotion(FLANGE), FLANGE, field=field)
    assert (alone.at_pose(FLANGE).y_down, alone.at_pose(FLANGE).camera_frame) == (None, None)


def test_moving_camera_field_that_is_no_plane_is_refused() -> None:
    static = Chain([])
    with refused("TOO_FEW", "3 points of the field or more, got 2"):
        MovingCamera(static, FLANGE, field=[[0, 0, 0], [1, 0, 0]])
    with refused("COLLINEAR", "not on one line"):
        MovingCamera(static, FLANGE, field=[[0, 0, 0], [1, 0, 0], [2, 0, 0]])


def test_moved_before_the_chain_is_wrong() -> None:
    """The thesis' form: the same motion applied before all other solvers."""
    motion = in_plane(0.5, 0.1, 0.0)
    pose = carried(TABLE_POSE, motion, FLANGE)
    moved = RigidMotion(pose.undated() @ FLANGE.undated().inverse())
    static = RealWorldPosition(TABLE_POSE.translation, TABLE_POSE.rotation)
    right = Chain([static, moved]).transform(SEEN)
    np.testing.assert_allclose(right, (TABLE_POSE @ motion).apply(TABLE), atol=1e-12)
    assert np.linalg.norm(Chain([moved, static]).transform(SEEN) - right, axis=1).min() > 0.01


# ---------------------------------------------------------------------- a pinhole on the flange

HAND_EYE = Transform(
    "flange", "camera", rotation_about(np.array([0.3, -0.2, 1]), 0.8), np.array([0.05, 0.02, 0.08])
)
"""Place of the camera on the flange, which only the simulation uses."""

GRID = np.array([(x, y, 0.0) for x in (-0.12, 0.0, 0.12) for y in (-0.1, 0.0, 0.1)])


def pixels(camera_in_base: Transform, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a pinhole's pixels (N, 2), y up, of points of the base; 1200 pixels in a radian."""
    x, y, z = camera_in_base.inverse().apply(points).T
    return 1200 * np.column_stack([x / z, -y / z])


def flange_at(view: Transform) -> Transform:
    """Return the flange's pose for a pose of the camera on the table."""
    return TABLE_POSE @ view @ HAND_EYE.inverse()


VIEW = Transform(
    "table",
    "camera",
    np.diag([1.0, -1.0, -1.0]) @ rotation_about(np.array([0.03, 0.04, 1]), 0.2),
    np.array([0.02, -0.01, 0.5]),
)
"""Half a metre above the table, 3 degrees tilted."""


def calibrated() -> MovingCamera:
    flange = flange_at(VIEW)
    touched = TABLE_POSE.apply(GRID)
    seen = pixels(flange @ HAND_EYE, touched)
    calibration = fit_plane(seen, touched, model="homography", robot_frame="base")
    return MovingCamera(chain_of(calibration), flange, field=calibration.robot_points)


@given(angles, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_moving_pinhole_maps_parts_to_their_true_places(turn: float, x: float, y: float) -> None:
    motion = in_plane(turn, x, y)
    flange = flange_at(motion @ VIEW)
    parts = TABLE_POSE.apply(motion.apply(GRID * 0.8))
    found = calibrated().at_pose(flange).transform(pixels(flange @ HAND_EYE, parts))
    np.testing.assert_allclose(found, parts, rtol=0, atol=1e-9)


def test_raised_moving_pinhole_is_refused_with_its_error() -> None:
    lift = Transform("table", "table", np.eye(3), np.array([0, 0, 0.01]))
    flange = flange_at(lift @ VIEW)
    with refused("PLANE_MOVED", "10.00 mm"):
        calibrated().at_pose(flange)
    one = MovingCamera(
        calibrated()._static, flange_at(VIEW), field=TABLE_POSE.apply(GRID), tolerance=1
    )
    parts = TABLE_POSE.apply(GRID)
    found = one.at_pose(flange).transform(pixels(flange @ HAND_EYE, parts))
    errors = 1e3 * np.linalg.norm(found - parts, axis=1)
    assert 10 < np.sqrt(np.mean(errors**2)) < 10.6


def test_image_time_without_a_time_zone_is_refused() -> None:
    table = Transform("base", "table", np.eye(3), np.zeros(3))
    flange = Transform("base", "flange", np.eye(3), np.zeros(3), NOON)
    with refused("BAD_TIME", "expected an image's time with its time zone"):
        camera(table, flange).at_pose(flange, NOON.replace(tzinfo=None))


@pytest.mark.parametrize(
    ("field", "code"), [(SEEN, "SHAPE"), (np.full((4, 3), np.nan), "NOT_FINITE")]
)
def test_invalid_field_is_refused(field: NDArray[np.float64], code: str) -> None:
    flange = Transform("robot", "flange", np.eye(3), np.zeros(3))
    with refused(code, "moving camera: points of the field"):
        MovingCamera(chain_of(fit_plane(SEEN, TABLE)), flange, field=field)
