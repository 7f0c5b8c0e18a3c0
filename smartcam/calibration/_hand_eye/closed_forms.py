"""Find the camera's pose by OpenCV's closed forms; refuse robot poses that do not determine it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam._extras import load
from smartcam.geometry._inside import Code, Rigid, log_rotation

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from smartcam.calibration._hand_eye.equations import RobotPoses
    from smartcam.geometry._inside import Array

MIN_POSES = 3
"""Least number of poses: two motions about different axes determine the camera's pose."""

SAME_TURN_RADIANS = math.radians(0.5)
"""Poses that differ by less than this angle count as one orientation."""

SAME_PLACE_M = 0.001
"""Poses are at the same place if they are nearer than this, metres, and turned by less than
SAME_TURN_RADIANS."""

MAX_POSES_PAIRED = 40
"""Methods of OpenCV that use all pairs of poses get at most this many poses, since their time grows
with the square of the number of poses."""

MAX_POSES_COMPARED = 200
"""At most this many poses are compared with each other; of more poses, only a part is compared."""

MIN_TURN_RADIANS = math.radians(2.0)
"""Least RMS turn of the poses about the second of their principal axes; turns about a single axis
do not determine the camera."""

# A motion of the robot between two poses, A, and the motion that the camera sees, B, are the same:
# A X = X B, so R_A R_X = R_X R_B and (R_A - I) t_X = R_X t_B - t_A. Each pair of poses gives one
# such equation; two of them about different axes determine X. Tsai, Park and Horaud find the
# rotation first, and then the translation, which is linear; the other two find both at once:
# - tsai: with P = 2 sin(angle / 2) axis, [P_A + P_B]x P' = P_B - P_A is linear, and P' gives R_X.
#   Tsai and Lenz, A New Technique for Fully Autonomous and Efficient 3D Robotics Hand/Eye
#   Calibration (1989).
# - park: log R_A = R_X log R_B, so R_X = (M^T M)^(-1/2) M^T with M = sum log(R_B) log(R_A)^T.
#   Park and Martin, Robot Sensor Calibration: Solving AX = XB on the Euclidean Group (1994).
# - horaud: quaternions satisfy q_A q_X = q_X q_B; q_X is an eigenvector of a 4 x 4 matrix.
#   Horaud and Dornaika, Hand-Eye Calibration (1995).
# - andreff: (I - R_A (x) R_B) vec(R_X) = 0 with Kronecker's product, and t_X in the same
#   equations. Andreff, Horaud and Espiau, On-line Hand-Eye Calibration (1999).
# - daniilidis: dual quaternions satisfy a q = q b; q is a combination of the last two right
#   singular vectors of a 6 N x 8 matrix. Daniilidis, Hand-Eye Calibration Using Dual Quaternions
#   (1999).
HAND_EYE = {
    "tsai": "CALIB_HAND_EYE_TSAI",
    "park": "CALIB_HAND_EYE_PARK",
    "horaud": "CALIB_HAND_EYE_HORAUD",
    "andreff": "CALIB_HAND_EYE_ANDREFF",
    "daniilidis": "CALIB_HAND_EYE_DANIILIDIS",
}

# Without differences of poses: A X = Z B for each pose, with both X and Z unknown.
# - shah: R_A R_X = R_Z R_B by Kronecker's product, from the largest singular vectors; then t_X and
#   t_Z together. Shah, Solving the Robot-World/Hand-Eye Calibration Problem Using the Kronecker
#   Product (2013).
# - li: rotations and translations in one linear system by Kronecker's product. Li, Wang and Wu,
#   Simultaneous robot-world and hand-eye calibration using dual-quaternions and Kronecker product
#   (2010).
ROBOT_WORLD = {
    "shah": "CALIB_ROBOT_WORLD_HAND_EYE_SHAH",
    "li": "CALIB_ROBOT_WORLD_HAND_EYE_LI",
}


def check_motion(robot: RobotPoses) -> None:
    """Raise if the robot's poses do not determine the camera's pose.

    Raises ``TOO_FEW`` for fewer than three poses; ``POSES_TOO_SIMILAR`` if fewer than three differ
    in orientation; ``INSUFFICIENT_ROTATION`` if they are turned about one axis only.
    """
    rotations = _sampled_rotations(robot)
    if len(rotations) < MIN_POSES:
        raise Code.TOO_FEW.error_with_value(
            f"hand-eye: expected at least {MIN_POSES} poses with a view", MIN_POSES, len(rotations)
        )
    turns_between = log_rotation(np.swapaxes(rotations, 1, 2)[:, None] @ rotations[None])
    is_apart = np.linalg.norm(turns_between, axis=-1) > SAME_TURN_RADIANS
    distinct: list[int] = []
    for index in range(len(rotations)):
        if is_apart[index, distinct].all():
            distinct.append(index)
    if len(distinct) < MIN_POSES:
        raise Code.POSES_TOO_SIMILAR.error(
            f"hand-eye: expected at least {MIN_POSES} orientations of the robot that are "
            f"{math.degrees(SAME_TURN_RADIANS):g} deg apart or more, got {len(distinct)}: pure "
            "shifts do not tell where the camera is",
            MIN_POSES,
            len(distinct),
        )
    second = second_axis_turn(robot)
    if not second > MIN_TURN_RADIANS:
        raise Code.INSUFFICIENT_ROTATION.error(
            "hand-eye: expected turns about two axes or more, "
            f"{math.degrees(MIN_TURN_RADIANS):g} deg rms about the second one, got "
            f"{math.degrees(second):.2g} deg: turns about a single axis do not determine the "
            "camera's position along this axis",
            MIN_TURN_RADIANS,
            second,
        )


def same_place_indices(poses: Rigid) -> NDArray[np.intp]:
    """Return for each pose (V,) the index of the first pose that is about the same.

    A robot has the same error each time it is at a place, so several views there tell no more than
    one.
    """
    indices = np.arange(poses.size)
    for index in indices[1:]:
        turns = log_rotation(poses.rotation[:index].swapaxes(1, 2) @ poses.rotation[index])
        shifts = poses.translation[:index] - poses.translation[index]
        is_near = np.linalg.norm(turns, axis=1) < SAME_TURN_RADIANS
        is_near &= np.linalg.norm(shifts, axis=1) < SAME_PLACE_M
        if is_near.any():
            indices[index] = indices[int(np.argmax(is_near))]
    return indices


def _sampled_rotations(robot: RobotPoses) -> Array:
    """Return the rotations of the poses, or of a part of the poses if there are many."""
    rotations, count = robot.poses.rotation, robot.poses.size
    if count <= MAX_POSES_COMPARED:
        return rotations
    sampled: Array = rotations[
        np.linspace(0, count - 1, MAX_POSES_COMPARED).round().astype(np.intp)
    ]
    return sampled


def second_axis_turn(robot: RobotPoses) -> float:
    """Return the RMS turn between the poses about the second of their axes, radians."""
    products = _turn_products(robot)
    return float(_second_axis_rms(products.sum(axis=(0, 1)), len(products)))


def left_out_second_axis_turns(robot: RobotPoses) -> Array:
    """Return :func:`second_axis_turn` without each compared pose, or of all poses if few."""
    products = _turn_products(robot)
    total, count = products.sum(axis=(0, 1)), len(products)
    if count <= MIN_POSES:
        return np.full(count, _second_axis_rms(total, count))
    return _second_axis_rms(total - 2.0 * products.sum(axis=1), count - 1)


def _turn_products(robot: RobotPoses) -> Array:
    """Return the products b b^T (V, V, 3, 3) of the turns b from each pose to each other pose."""
    rotations = _sampled_rotations(robot)
    turns_between = log_rotation(np.swapaxes(rotations, 1, 2)[:, None] @ rotations[None])
    products: Array = turns_between[..., None] * turns_between[..., None, :]
    return products


def _second_axis_rms(products: Array, count: int) -> Array:
    # Rotation vectors of one axis are multiples of each other, so the second eigenvalue of the sum
    # of their products is 0. The second eigenvalue divided by their number is a mean square.
    roots: Array = np.sqrt(np.maximum(np.linalg.eigvalsh(products)[..., 1], 0.0))
    return roots / math.sqrt(count * (count - 1))


def solve_closed_form(
    name: str, robot: RobotPoses, target_poses: Rigid, *, use_all_views: bool = False
) -> tuple[Rigid, Rigid] | None:
    """Return ``X`` and ``Z`` by one of OpenCV's methods (:data:`OPENCV_METHODS`); None if it fails.

    ``target_poses``: ``T_camera_target`` of each view. ``use_all_views``: False gives methods that
    use pairs of views only a part of many views, which is enough for a start.
    """
    if name in HAND_EYE and not use_all_views and target_poses.size > MAX_POSES_PAIRED:
        sampled = np.linspace(0, target_poses.size - 1, MAX_POSES_PAIRED).round().astype(np.intp)
        robot, target_poses = robot.subset(sampled), target_poses.subset(sampled)
    try:
        solution = OPENCV_METHODS[name](name, robot, target_poses)
    except (load("cv2").error, np.linalg.LinAlgError):
        return None
    return solution if _is_valid(solution) else None


def _hand_eye(name: str, robot: RobotPoses, target_poses: Rigid) -> tuple[Rigid, Rigid]:
    cv2, inverse_motion = load("cv2"), robot.carrier_motion.inverse()
    # the fifth argument is an output: a method without its name would be ignored
    solution = cv2.calibrateHandEye(
        *_as_lists(inverse_motion), *_as_lists(target_poses), method=getattr(cv2, HAND_EYE[name])
    )
    camera = _as_rigid(*solution)
    return camera, mean_target(camera, robot, target_poses)


def _robot_world(name: str, robot: RobotPoses, target_poses: Rigid) -> tuple[Rigid, Rigid]:
    cv2 = load("cv2")
    solution = cv2.calibrateRobotWorldHandEye(
        *_as_lists(target_poses),
        *_as_lists(robot.carrier_motion),
        method=getattr(cv2, ROBOT_WORLD[name]),
    )
    return _as_rigid(*solution[2:]).inverse(), _as_rigid(*solution[:2]).inverse()


def _as_rigid(turn: Any, shift: Any) -> Rigid:
    motion = Rigid(np.asarray(turn, dtype=np.float64), np.ravel(shift).astype(np.float64))
    if not np.isfinite(motion.rotation).all():
        raise np.linalg.LinAlgError("no rotation")
    return motion


OPENCV_METHODS: dict[str, Callable[[str, RobotPoses, Rigid], tuple[Rigid, Rigid]]] = {
    **dict.fromkeys(HAND_EYE, _hand_eye),
    **dict.fromkeys(ROBOT_WORLD, _robot_world),
}
"""Functions for OpenCV's methods, which need no start value, by their authors."""


def mean_target(camera: Rigid, robot: RobotPoses, target_poses: Rigid) -> Rigid:
    """Return the mean of the target's poses ``Z`` that each view alone shows."""
    # S = X^-1 A Z, so each view alone says Z = A^-1 X S.
    poses = robot.carrier_motion.inverse() @ (camera @ target_poses)
    # The rotation nearest to the mean matrix, in the sum of squared elements: U diag(1, 1, +-1) V^T
    # of U S V^T. SciPy's Rotation.mean is the same, but refuses reflections, which a closed form
    # may give; these are sorted out later. Source: Hartley, Trumpf, Dai and Li, Rotation Averaging
    # (2013), on the chordal L2 mean.
    left, _, right = np.linalg.svd(poses.rotation.mean(axis=0))
    proper = np.diag([1.0, 1.0, float(np.linalg.det(left @ right))])
    return Rigid(left @ proper @ right, poses.translation.mean(axis=0))


def estimate_scale(robot: RobotPoses, target_poses: Rigid) -> float | None:
    """Return the target's size that the robot's motions show, relative to the nominal size."""
    solution = solve_closed_form(
        "park", robot, target_poses
    )  # the camera's rotation does not depend on lengths
    if solution is None:
        return None
    # S = X^-1 A Z with all of the camera's lengths times s: R_A t_Z - t_X - s R_X t_S = -t_A.
    carrier_motion, count = robot.carrier_motion, target_poses.size
    rows = np.zeros((count, 3, 7))
    rows[:, :, :3], rows[:, :, 3:6] = carrier_motion.rotation, -np.eye(3)
    rows[:, :, 6] = -target_poses.translation @ solution[0].rotation.T
    right_side = -carrier_motion.translation.reshape(-1)
    return float(np.linalg.lstsq(rows.reshape(-1, 7), right_side, rcond=None)[0][6])


def _as_lists(motions: Rigid) -> tuple[list[Array], list[Array]]:
    return list(np.ascontiguousarray(motions.rotation)), list(motions.translation)


def _is_valid(motions: tuple[Rigid, Rigid]) -> bool:
    for motion in motions:
        if not all(np.isfinite(part).all() for part in motion):
            return False
        error = np.abs(motion.rotation @ motion.rotation.T - np.eye(3)).max()
        if error > 1e-6 or np.linalg.det(motion.rotation) < 0:
            return False
    return True
