"""Where the solution begins: OpenCV's closed-form methods, and what no method can make up for."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from smartcam.calibration.codes import Code
from smartcam.calibration.hand_eye.equations import Rigid, log_rotation
from smartcam.calibration.optional_imports import load
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.calibration.geometry.rotations import Array
    from smartcam.calibration.hand_eye.equations import Robot

__all__ = ["LEAST_POSES", "LINEAR", "check_motion", "mean_target", "second_turn", "solve_linear"]

LEAST_POSES = 3
"""Two motions about axes that differ determine the camera."""

SAME_TURN = math.radians(0.5)
"""Poses turned less against each other count as one."""

LEAST_TURN = math.radians(2.0)
"""Rms turn of the poses about the second of their axes; one axis alone determines nothing."""

HAND_EYE = {
    "tsai": "CALIB_HAND_EYE_TSAI",
    "park": "CALIB_HAND_EYE_PARK",
    "horaud": "CALIB_HAND_EYE_HORAUD",
    "andreff": "CALIB_HAND_EYE_ANDREFF",
    "daniilidis": "CALIB_HAND_EYE_DANIILIDIS",
}
ROBOT_WORLD = {
    "shah": "CALIB_ROBOT_WORLD_HAND_EYE_SHAH",
    "li": "CALIB_ROBOT_WORLD_HAND_EYE_LI",
}


def check_motion(robot: Robot) -> None:
    """Raise where the robot's poses do not determine where the camera is.

    Raises:
        CalibrationError: ``TOO_FEW``: fewer than three poses; ``POSES_TOO_SIMILAR``: fewer than
            three whose orientations differ; ``INSUFFICIENT_ROTATION``: turned about one axis only.
    """
    turns = robot.poses.rotation
    if len(turns) < LEAST_POSES:
        raise CalibrationError(
            f"hand-eye: expected at least {LEAST_POSES} poses with a view, got {len(turns)}",
            code=Code.TOO_FEW,
            expected=LEAST_POSES,
            got=len(turns),
        )
    against = log_rotation(np.swapaxes(turns, 1, 2)[:, None] @ turns[None])
    apart = np.linalg.norm(against, axis=-1) > SAME_TURN
    distinct: list[int] = []
    for index in range(len(turns)):
        if apart[index, distinct].all():
            distinct.append(index)
    if len(distinct) < LEAST_POSES:
        raise CalibrationError(
            f"hand-eye: expected at least {LEAST_POSES} orientations of the robot that are "
            f"{math.degrees(SAME_TURN):g} deg apart or more, got {len(distinct)}: pure shifts do "
            "not tell where the camera is",
            code=Code.POSES_TOO_SIMILAR,
            expected=LEAST_POSES,
            got=len(distinct),
        )
    second = second_turn(robot)
    if not second > LEAST_TURN:
        raise CalibrationError(
            "hand-eye: expected turns about two axes or more, "
            f"{math.degrees(LEAST_TURN):g} deg rms about the second one, got "
            f"{math.degrees(second):.2g} deg: along a single axis the camera is not determined",
            code=Code.INSUFFICIENT_ROTATION,
            expected=LEAST_TURN,
            got=second,
        )


def second_turn(robot: Robot) -> float:
    """Return the rms turn of the poses against each other about the second of their axes, rad."""
    turns = robot.poses.rotation
    first, later = np.triu_indices(len(turns), 1)
    between = log_rotation(np.swapaxes(turns[first], 1, 2) @ turns[later])
    singular = np.asarray(np.linalg.svd(between, compute_uv=False), dtype=np.float64)
    return float(singular[1] / math.sqrt(len(between)))


def solve_linear(name: str, robot: Robot, seen: Rigid) -> tuple[Rigid, Rigid] | None:
    """Return ``X`` and ``Z`` by one of OpenCV's methods; None where it fails.

    Args:
        name: one of :data:`LINEAR`.
        robot: its poses.
        seen: ``T_camera_target`` of each view.
    """
    found = LINEAR[name](name, robot, seen)
    return found if found is not None and _sound(found) else None


def _hand_eye(name: str, robot: Robot, seen: Rigid) -> tuple[Rigid, Rigid] | None:
    cv2 = load("cv2")
    carrier = robot.between.inverse()
    try:
        # the fifth argument is an output: a method without its name would be ignored
        turn, shift = cv2.calibrateHandEye(
            *_lists(carrier), *_lists(seen), method=getattr(cv2, HAND_EYE[name])
        )
    except cv2.error:
        return None
    camera = Rigid(np.asarray(turn, dtype=np.float64), np.ravel(shift).astype(np.float64))
    if not np.isfinite(camera.rotation).all():
        return None
    return camera, mean_target(camera, robot, seen)


def _robot_world(name: str, robot: Robot, seen: Rigid) -> tuple[Rigid, Rigid] | None:
    cv2 = load("cv2")
    try:
        turn, shift, hand_turn, hand_shift = cv2.calibrateRobotWorldHandEye(
            *_lists(seen), *_lists(robot.between), method=getattr(cv2, ROBOT_WORLD[name])
        )
    except cv2.error:
        return None
    target = Rigid(np.asarray(turn, dtype=np.float64), np.ravel(shift).astype(np.float64))
    camera = Rigid(np.asarray(hand_turn, dtype=np.float64), np.ravel(hand_shift).astype(np.float64))
    return camera.inverse(), target.inverse()


LINEAR: dict[str, Callable[[str, Robot, Rigid], tuple[Rigid, Rigid] | None]] = {
    **dict.fromkeys(HAND_EYE, _hand_eye),
    **dict.fromkeys(ROBOT_WORLD, _robot_world),
}
"""OpenCV's methods by their authors."""


def mean_target(camera: Rigid, robot: Robot, seen: Rigid) -> Rigid:
    """Return the mean of where each view alone puts the target, ``Z``."""
    each = robot.between.inverse() @ (camera @ seen)
    left, _, right = np.linalg.svd(each.rotation.mean(axis=0))
    proper = np.diag([1.0, 1.0, float(np.linalg.det(left @ right))])
    return Rigid(left @ proper @ right, each.translation.mean(axis=0))


def _lists(motions: Rigid) -> tuple[list[Array], list[Array]]:
    return list(np.ascontiguousarray(motions.rotation)), list(motions.translation)


def _sound(found: tuple[Rigid, Rigid]) -> bool:
    for motion in found:
        if not all(np.isfinite(part).all() for part in motion):
            return False
        off = np.abs(motion.rotation @ motion.rotation.T - np.eye(3)).max()
        if off > 1e-6 or np.linalg.det(motion.rotation) < 0:
            return False
    return True
