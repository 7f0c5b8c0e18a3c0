"""Check whether a robot's poses and the views belong together, and find those that do not.

A closed form finds camera and target from each of many small groups of poses. The answer that fits
most of all poses is used, so a few poses that belong to other views do not spoil the rest.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._hand_eye.closed_forms import solve_linear
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
"""At most this many groups are tried: if a third of the poses is wrong, one group in six has none
of them."""

MIN_GROSS_ERROR_RATIO: Final = 10.0
"""A pose whose error is more than this many times the median belongs to another view."""

MIN_INVERTED_FIT_RATIO: Final = 5.0
"""Poses are taken for inverted, or a view for numbered from the target's other end, only if they
then fit this many times better."""

MIN_OTHER_FIT_RATIO: Final = 20.0
"""Poses are taken for transposed, mirrored or in another unit of length only if they then fit this
many times better: such mistakes are rarer than a pose of another view."""

WORST_USABLE_ROBOT: Final = RobotSigmas(math.radians(2.0), 0.01)
"""Largest noise of a usable robot: 2 degrees and 10 mm."""

MILLI: Final = 1e-3

X_MIRROR: Final = np.diag([-1.0, 1.0, 1.0])
"""Mirror of the x axis: mirrors of other axes differ by rotations of base and flange only."""


class Agreed(NamedTuple):
    """The poses of camera and target on which most of the robot's poses agree."""

    camera: Rigid  # ``X``
    target: Rigid  # ``Z``
    off: Array  # (V,), error of each pose, metres on the target

    @property
    def median(self) -> float:
        """Median error of all poses, metres."""
        return float(np.median(self.off))

    def gross(self, limit: float) -> NDArray[np.intp]:
        """Return the indices of poses whose error is above ``limit`` and far above the others'."""
        return np.flatnonzero(self.off > max(limit, MIN_GROSS_ERROR_RATIO * self.median))


def seen_poses(target_poses: Sequence[Transform]) -> list[Transform]:
    """Return poses of the target in the camera's frame as a list.

    Raises SHAPE if these are no poses; WRONG_FRAME if they are in several frames, or inverted.
    """
    label = "pose of the target"
    poses_seen = [
        as_motion(pose, f"{label} {number}", CAMERA, TARGET)
        for number, pose in enumerate(as_list(target_poses, object, label))
    ]
    for number, pose in enumerate(poses_seen):
        if pose.label != poses_seen[0].label or (pose.target, pose.source) == (TARGET, CAMERA):
            wanted = f"T_{CAMERA}_{TARGET}" if number == 0 else poses_seen[0].label
            raise Code.WRONG_FRAME.unexpected(
                f"{label} {number}: expected {wanted}", wanted, pose.label
            )
    return poses_seen


def _target_extent(views: PixelObservations) -> float:
    """Return the largest extent of the seen points along an axis of the target, metres."""
    return float(np.ptp(views.points.reshape(-1, 3), axis=0).max())


def meaningless_error(problem: Problem) -> float:
    """Return the error above which a calibration is meaningless, metres.

    It is the target's extent; without views it is half of the target's distance.
    """
    if isinstance(problem.seen, PixelObservations):
        return _target_extent(problem.seen)
    return 0.5 * float(np.median(np.linalg.norm(problem.poses.translation, axis=1)))


def expected_error(problem: Problem, sigmas: RobotSigmas) -> float:
    """Return the RMS error on the target that a robot's noise causes, metres.

    Assumes that a rotation moves the target in proportion to its distance from the camera.
    """
    distance = float(np.median(np.linalg.norm(problem.poses.translation, axis=1)))
    return math.sqrt(2.0) * math.hypot(sigmas.translation, sigmas.rotation * distance)


def max_plausible_error(problem: Problem) -> float:
    """Return the error above which poses and views do not belong together, metres."""
    return min(meaningless_error(problem), expected_error(problem, WORST_USABLE_ROBOT))


def agreement(problem: Problem) -> Agreed | None:
    """Return camera and target that fit most of the poses; None if no closed form finds them."""
    # Least median over proposals of small groups: right as long as most of the poses are.
    # Source: Rousseeuw, Least Median of Squares Regression (1984).
    lever = _target_extent(problem.seen) if isinstance(problem.seen, PixelObservations) else 0.0
    best: Agreed | None = None
    for indices in _groups(problem.count):
        best = _better(problem, indices, lever, best)
    if best is not None:
        agreeing = np.flatnonzero(best.off <= 3.0 * best.median)
        best = _better(problem, agreeing, lever, best)
    return best


def _groups(count: int) -> Iterator[NDArray[np.intp]]:
    """Yield the indices of all poses, then those of groups, the same in every call."""
    yield np.arange(count)
    if count > POSES_PER_GROUP:
        random = np.random.default_rng(count)
        for _ in range(MAX_GROUPS):
            yield np.sort(random.choice(count, POSES_PER_GROUP, replace=False))


def _better(
    problem: Problem, indices: NDArray[np.intp], lever: float, best: Agreed | None
) -> Agreed | None:
    """Return camera and target from some poses if they fit all poses better than ``best``."""
    for name in CLOSED_FORMS:
        motion = solve_linear(name, problem.robot.subset(indices), problem.poses.subset(indices))
        if motion is None:
            continue
        expected = predicted_views(motion[0], problem.robot, motion[1])
        tried = Agreed(*motion, _apart(problem.poses, expected, lever))
        if best is None or tried.median < best.median:
            best = tried
    return best


def _apart(poses: Rigid, expected: Rigid, lever: float) -> Array:
    """Return the distances (V,) of poses from the expected ones, metres at the lever's length."""
    turn, shift = np.split(poses.steps_to(expected), 2, axis=1)
    apart: Array = np.hypot(np.linalg.norm(shift, axis=1), lever * np.linalg.norm(turn, axis=1))
    return apart


def other_numbering(
    robot: RobotPoses, poses: Rigid, turn: Rigid, lever: float
) -> NDArray[np.bool_]:
    """Return a mask of views that number a target from its other end: at most half of them.

    The target looks the same after a half ``turn``, and each view alone may take either end for the
    origin: the robot's motions show which one. ``lever``: the target's extent, metres.
    """
    least, other = math.inf, np.zeros(poses.size, dtype=np.bool_)
    for indices, name in itertools.product(_groups(poses.size), CLOSED_FORMS):
        solution = solve_linear(name, robot.subset(indices), poses.subset(indices))
        if solution is None:
            continue
        expected = predicted_views(solution[0], robot, solution[1])
        as_is, turned = (_apart(seen, expected, lever) for seen in (poses, poses @ turn))
        middle = float(np.median(np.minimum(as_is, turned)))
        if middle < least:
            least, other = middle, MIN_INVERTED_FIT_RATIO * turned < as_is
    return ~other if 2 * other.sum() > len(other) else other


def _readings(robot: RobotPoses) -> Iterator[tuple[RobotPoses, float, Code, str]]:
    """Yield the poses in every other way that they may have been meant.

    Each item has the changed poses, the factor by which they must fit better, the error's code, and
    words for what they are then taken for, and for the mistake.
    """
    poses, in_hand = robot.poses, robot.in_hand
    how = "the other way round: they are inverted, or the camera is on the other side"
    yield RobotPoses(poses, not in_hand), MIN_INVERTED_FIT_RATIO, Code.WRONG_FRAME, how
    transposed = Rigid(np.swapaxes(poses.rotation, 1, 2), poses.translation)
    how = "with rotations transposed: their matrices or quaternions are inverted rotations"
    yield RobotPoses(transposed, in_hand), MIN_OTHER_FIT_RATIO, Code.WRONG_FRAME, how
    mirrored = Rigid(X_MIRROR @ poses.rotation @ X_MIRROR, poses.translation @ X_MIRROR)
    how = "in a left-handed base: expected axes x, y, z of a right hand"
    yield RobotPoses(mirrored, in_hand), MIN_OTHER_FIT_RATIO, Code.MIRRORED, how
    how = "as millimetres: expected metres"
    yield RobotPoses(poses.scaled(MILLI), in_hand), MIN_OTHER_FIT_RATIO, Code.POOR_FIT, how
    how = "with the target in millimetres: expected its lengths in metres"
    yield RobotPoses(poses.scaled(1 / MILLI), in_hand), MIN_OTHER_FIT_RATIO, Code.POOR_FIT, how


def check_poses(problem: Problem) -> Agreed:
    """Return the motion that most of the poses agree with.

    Raises ``WRONG_FRAME`` or ``MIRRORED`` if the poses fit far better when they are read otherwise,
    and ``POOR_FIT`` if they do not fit at all.
    """
    as_given = agreement(problem)
    error = math.inf if as_given is None else _on_target(problem, as_given)
    for robot, min_ratio, code, how in _readings(problem.robot):
        other = dataclasses.replace(problem, robot=robot)
        agreed = agreement(other)
        if agreed is None:
            continue
        less = _on_target(other, agreed)
        if less < max_plausible_error(other) and error > min_ratio * less:
            off = f"{1e3 * error:.3g} mm off" if math.isfinite(error) else "nowhere near"
            raise code.refusal(
                "hand-eye: expected poses of the flange in the base, and the setup as it is, got "
                f"poses that are {off} as given, but {1e3 * less:.3g} mm when read {how}",
                "T_base_flange",
                less,
            )
    most = max_plausible_error(problem)
    if as_given is None or error > most:
        off = f"one {1e3 * error:.3g} mm off" if math.isfinite(error) else "nothing near"
        raise poor_fit_error(f"{off}, {1e3 * most:.3g} mm at most expected", error)
    return as_given


def poor_fit_error(actual: str, error: float | None) -> CalibrationError:
    """Return the error for poses and views that do not belong together.

    ``actual``: what was got instead. ``error``: error of the target, metres; None if
    it is not known.
    """
    return Code.POOR_FIT.refusal(
        f"hand-eye: expected a camera that sees the target where it is, got {actual}: are the "
        "poses those of the views, in their order and in metres, are their angles in the "
        "convention that was read, is the setup right, and is the target numbered from the same "
        "end in all views?",
        got=error,
    )


def _on_target(problem: Problem, agreed: Agreed) -> float:
    """Return the median error of the points on the target, metres."""
    solution = Solution(agreed.camera, agreed.target, np.zeros(problem.seen.extra_count))
    return float(np.median(np.concatenate(problem.errors(solution))))
