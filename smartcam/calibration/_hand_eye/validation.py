"""Check whether a robot's poses and the views belong together, and find those that do not.

A closed form finds camera and target from each of many small groups of poses. The result that fits
most of the poses is used, so a few poses that were paired with a wrong view have no influence.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._hand_eye.closed_forms import solve_closed_form
from smartcam.calibration._hand_eye.equations import (
    PixelObservations,
    RobotPoses,
    RobotSigmas,
    Solution,
    predicted_views,
)
from smartcam.calibration._lens.poses import CAMERA, TARGET
from smartcam.calibration._views import as_list
from smartcam.geometry._inside import Code, Rigid, as_motion

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from smartcam.calibration._hand_eye.model_selection import Problem
    from smartcam.exceptions import CalibrationError
    from smartcam.geometry import Transform
    from smartcam.geometry._inside import Array

CLOSED_FORMS: Final = ("park", "shah")
"""Closed forms that are tried. They are of different kinds: one works when the other fails."""

POSES_PER_GROUP: Final = 4
"""A group has this many poses, one more than a closed form needs."""

MAX_GROUPS: Final = 60
"""At most this many groups are tried: if a third of the poses is wrong, one group in six has no
wrong pose."""

MIN_GROSS_ERROR_RATIO: Final = 10.0
"""A pose whose error is more than this many times the median was paired with a wrong view."""

MIN_INVERTED_FIT_RATIO: Final = 5.0
"""Poses are taken as inverted, or a view as numbered from the target's other end, only if they then
fit this many times better."""

MIN_OTHER_FIT_RATIO: Final = 20.0
"""Poses are taken as transposed, mirrored or in another unit of length only if they then fit this
many times better: such mistakes are rarer than a single pose with a wrong view."""

WORST_USABLE_ROBOT: Final = RobotSigmas(math.radians(2.0), 0.01)
"""Largest noise of a usable robot: 2 degrees and 10 mm."""

METRES_PER_MILLIMETRE: Final = 1e-3

MIRROR_X: Final = np.diag([-1.0, 1.0, 1.0])
"""Mirror of the x axis; mirrors of other axes differ only by rotations of base and flange."""


class AgreedPoses(NamedTuple):
    """The poses of camera and target on which most of the robot's poses agree."""

    camera: Rigid  # ``X``
    target: Rigid  # ``Z``
    errors: Array  # (V,), error of each pose, metres on the target

    @property
    def median(self) -> float:
        """Median error of all poses, metres."""
        return float(np.median(self.errors))

    def gross_error_indices(self, limit: float) -> NDArray[np.intp]:
        """Return the indices of poses whose error is above ``limit`` and far above the others'."""
        return np.flatnonzero(self.errors > max(limit, MIN_GROSS_ERROR_RATIO * self.median))


def as_target_poses(target_poses: Sequence[Transform]) -> list[Transform]:
    """Return poses of the target in the camera's frame as a list.

    Raises SHAPE if these are no poses; WRONG_FRAME if they are in several frames, or inverted.
    """
    label = "pose of the target"
    poses = [
        as_motion(pose, f"{label} {number}", CAMERA, TARGET)
        for number, pose in enumerate(as_list(target_poses, object, label))
    ]
    for number, pose in enumerate(poses):
        if pose.label != poses[0].label or (pose.target, pose.source) == (TARGET, CAMERA):
            expected = f"T_{CAMERA}_{TARGET}" if number == 0 else poses[0].label
            raise Code.WRONG_FRAME.error_with_value(
                f"{label} {number}: expected {expected}", expected, pose.label
            )
    return poses


def _target_extent(views: PixelObservations) -> float:
    """Return the largest extent of the seen points along an axis of the target, metres."""
    return float(np.ptp(views.points.reshape(-1, 3), axis=0).max())


def meaningless_error(problem: Problem) -> float:
    """Return the error above which a calibration is meaningless, metres.

    It is the target's extent; without views it is half of the target's distance.
    """
    if isinstance(problem.observations, PixelObservations):
        return _target_extent(problem.observations)
    return 0.5 * float(np.median(np.linalg.norm(problem.target_poses.translation, axis=1)))


def expected_error(problem: Problem, sigmas: RobotSigmas) -> float:
    """Return the RMS error on the target that a robot's noise causes, metres.

    A rotation is assumed to move the target in proportion to its distance from the camera.
    """
    distance = float(np.median(np.linalg.norm(problem.target_poses.translation, axis=1)))
    return math.sqrt(2.0) * math.hypot(sigmas.translation, sigmas.rotation * distance)


def max_plausible_error(problem: Problem) -> float:
    """Return the largest error, metres, with which poses and views may belong together."""
    return min(meaningless_error(problem), expected_error(problem, WORST_USABLE_ROBOT))


def find_agreement(problem: Problem) -> AgreedPoses | None:
    """Return the poses of camera and target that fit most of the views; None if there are none."""
    # The proposal with the least median error is chosen; it is right if most of the poses are.
    # Source: Rousseeuw, Least Median of Squares Regression (1984).
    lever = (
        _target_extent(problem.observations)
        if isinstance(problem.observations, PixelObservations)
        else 0.0
    )
    best: AgreedPoses | None = None
    for indices in _groups(problem.count):
        best = _improve_agreement(problem, indices, lever, best)
    if best is not None:
        agreeing = np.flatnonzero(best.errors <= 3.0 * best.median)
        best = _improve_agreement(problem, agreeing, lever, best)
    return best


def _groups(count: int) -> Iterator[NDArray[np.intp]]:
    """Yield the indices of all poses, then those of groups, the same in every call."""
    yield np.arange(count)
    if count > POSES_PER_GROUP:
        random = np.random.default_rng(count)
        for _ in range(MAX_GROUPS):
            yield np.sort(random.choice(count, POSES_PER_GROUP, replace=False))


def _improve_agreement(
    problem: Problem, indices: NDArray[np.intp], lever: float, best: AgreedPoses | None
) -> AgreedPoses | None:
    """Return camera and target from the poses at ``indices`` if they fit better than ``best``."""
    for name in CLOSED_FORMS:
        motions = solve_closed_form(
            name, problem.robot.subset(indices), problem.target_poses.subset(indices)
        )
        if motions is None:
            continue
        expected = predicted_views(motions[0], problem.robot, motions[1])
        candidate = AgreedPoses(*motions, _pose_distances(problem.target_poses, expected, lever))
        if best is None or candidate.median < best.median:
            best = candidate
    return best


def _pose_distances(poses: Rigid, expected: Rigid, lever: float) -> Array:
    """Return the distances (V,) of poses from the expected ones, metres.

    A turn counts as the distance by which it moves a point at the distance ``lever``.
    """
    turn, shift = np.split(poses.target_steps_to(expected), 2, axis=1)
    distances: Array = np.hypot(np.linalg.norm(shift, axis=1), lever * np.linalg.norm(turn, axis=1))
    return distances


def find_other_numbering(
    robot: RobotPoses, poses: Rigid, half_turn: Rigid, lever: float
) -> NDArray[np.bool_]:
    """Return a mask of the views that number a target from its other end, at most half of all.

    The target looks the same after ``half_turn``, so a view alone cannot tell which end is the
    origin; the robot's motions show it. ``lever``: the target's extent, metres.
    """
    least_median, is_turned = math.inf, np.zeros(poses.size, dtype=np.bool_)
    for indices, name in itertools.product(_groups(poses.size), CLOSED_FORMS):
        solution = solve_closed_form(name, robot.subset(indices), poses.subset(indices))
        if solution is None:
            continue
        expected = predicted_views(solution[0], robot, solution[1])
        distances, turned_distances = (
            _pose_distances(views, expected, lever) for views in (poses, poses @ half_turn)
        )
        median = float(np.median(np.minimum(distances, turned_distances)))
        if median < least_median:
            least_median, is_turned = median, MIN_INVERTED_FIT_RATIO * turned_distances < distances
    return ~is_turned if 2 * is_turned.sum() > len(is_turned) else is_turned


def _other_readings(robot: RobotPoses) -> Iterator[tuple[RobotPoses, float, Code, str]]:
    """Yield the poses after undoing each of some common mistakes.

    An item has the changed poses, the factor by which they must fit better than the given poses,
    the error's code, and words for the mistake.
    """
    poses, in_hand = robot.poses, robot.in_hand
    reading = "the other way round: they are inverted, or the camera is on the other side"
    yield RobotPoses(poses, not in_hand), MIN_INVERTED_FIT_RATIO, Code.WRONG_FRAME, reading
    transposed_poses = Rigid(np.swapaxes(poses.rotation, 1, 2), poses.translation)
    reading = "with rotations transposed: their matrices or quaternions are inverted rotations"
    yield RobotPoses(transposed_poses, in_hand), MIN_OTHER_FIT_RATIO, Code.WRONG_FRAME, reading
    mirrored_poses = Rigid(MIRROR_X @ poses.rotation @ MIRROR_X, poses.translation @ MIRROR_X)
    reading = "in a left-handed base: expected axes x, y, z of a right hand"
    yield RobotPoses(mirrored_poses, in_hand), MIN_OTHER_FIT_RATIO, Code.MIRRORED, reading
    reading = "as millimetres: expected metres"
    yield (
        RobotPoses(poses.scaled(METRES_PER_MILLIMETRE), in_hand),
        MIN_OTHER_FIT_RATIO,
        Code.POOR_FIT,
        reading,
    )
    reading = "with the target in millimetres: expected its lengths in metres"
    yield (
        RobotPoses(poses.scaled(1 / METRES_PER_MILLIMETRE), in_hand),
        MIN_OTHER_FIT_RATIO,
        Code.POOR_FIT,
        reading,
    )


def check_poses(problem: Problem) -> AgreedPoses:
    """Return the poses of camera and target with which most of the robot's poses agree.

    Raises ``WRONG_FRAME``, ``MIRRORED`` or ``POOR_FIT`` if the poses fit far better after undoing a
    mistake, and ``POOR_FIT`` if they do not fit at all.
    """
    as_given = find_agreement(problem)
    error = math.inf if as_given is None else _median_error(problem, as_given)
    for robot, min_ratio, code, reading in _other_readings(problem.robot):
        other_problem = dataclasses.replace(problem, robot=robot)
        other_agreement = find_agreement(other_problem)
        if other_agreement is None:
            continue
        other_error = _median_error(other_problem, other_agreement)
        if other_error < max_plausible_error(other_problem) and error > min_ratio * other_error:
            error_text = f"{1e3 * error:.3g} mm off" if math.isfinite(error) else "nowhere near"
            raise code.error(
                "hand-eye: expected poses of the flange in the base and the right setup, got poses "
                f"that are {error_text} as given, but only {1e3 * other_error:.3g} mm off if read "
                f"{reading}",
                "T_base_flange",
                other_error,
            )
    max_error = max_plausible_error(problem)
    if as_given is None or error > max_error:
        error_text = f"one {1e3 * error:.3g} mm off" if math.isfinite(error) else "nothing near"
        raise poor_fit_error(f"{error_text}, {1e3 * max_error:.3g} mm at most expected", error)
    return as_given


def poor_fit_error(actual: str, error: float | None) -> CalibrationError:
    """Return the error for poses and views that do not belong together.

    ``actual``: description of the actual misfit. ``error``: error on the target, metres; None if it
    is not known.
    """
    return Code.POOR_FIT.error(
        f"hand-eye: expected a camera that sees the target where it is, got {actual}: are the "
        "poses those of the views, in their order and in metres, are their angles in the "
        "convention that was read, is the setup right, and is the target numbered from the same "
        "end in all views?",
        got=error,
    )


def _median_error(problem: Problem, agreed: AgreedPoses) -> float:
    """Return the median error of the points on the target, metres."""
    solution = Solution(agreed.camera, agreed.target, np.zeros(problem.observations.extra_count))
    return float(np.median(np.concatenate(problem.errors(solution))))
