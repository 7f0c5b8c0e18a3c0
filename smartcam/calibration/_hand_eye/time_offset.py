"""Estimate the offset between the clocks of a robot and a camera from a robot that moves.

A robot at 250 mm/s whose pose is taken 20 ms late is 5 mm off. A camera on it, or one that watches
the target on its hand, sees where it really was. The right offset is the one with which poses and
views agree best on one place of the camera.
"""

from __future__ import annotations

import math
from datetime import timedelta
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam._argument_checks import a_number, of_class, takes
from smartcam._extras import load
from smartcam.calibration._hand_eye.closed_forms import check_motion, solve_linear
from smartcam.calibration._hand_eye.equations import RobotPoses, is_in_hand, predicted_views
from smartcam.calibration._hand_eye.validation import seen_poses
from smartcam.calibration._jackknife import jackknife
from smartcam.calibration._plane.validation import check_positive
from smartcam.geometry._inside import Code, Rigid

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from smartcam.calibration._hand_eye.equations import Setup
    from smartcam.geometry import PoseHistory, Transform

COARSE_STEPS = 41
"""The whole range is first searched at this many offsets."""

LEFT_OUT_PARTS = 20
"""The offset is estimated again without each of this many parts of the views, for its sigma."""

MIN_VIEWS_FOR_OFFSET = 10
"""An offset needs at least this many views: it is one more unknown, about which each view says
little."""

MAX_SIGMA_SHARE = 0.25
"""An offset is returned only if its sigma is at most this part of the range."""


class TimeOffset(NamedTuple):
    """An offset between the clocks of a robot and a camera, with its sigma.

    Attributes:
        seconds: time to add to a picture's time to ask the robot's history for its pose.
        sigma: standard deviation of ``seconds``, by the scatter between views, seconds.
        before: rms difference of poses and views without the offset, metres.
        after: rms difference of poses and views with the offset, metres.
    """

    seconds: float
    sigma: float
    before: float
    after: float


@takes(history=of_class("PoseHistory"), most=a_number)
def estimate_time_offset(
    history: PoseHistory, target_poses: Sequence[Transform], *, setup: Setup, most: float = 0.2
) -> TimeOffset:
    """Estimate by how much the times of pictures differ from those of a robot's poses.

    ::

        offset = estimate_time_offset(history, seen, setup="eye-in-hand")
        poses = [history.at(one.at + timedelta(seconds=offset.seconds)) for one in seen]

    Args:
        history: ``T_base_flange`` while the pictures were taken, and ``most`` before and after.
        target_poses: ``T_camera_target`` of each picture, with its time (``at``): ten or more,
            taken while the robot moves and turns, fast enough to matter and in several directions.
        setup: place of the camera, as for :func:`~smartcam.calibration.calibrate_hand_eye`.
        most: largest offset to look for, seconds.

    Raises:
        CalibrationError: TOO_FEW; BAD_TIME: a view without a time, a history that does not reach
            far enough, or views that determine no offset in the range, as when the robot stood
            still; and the errors of ``calibrate_hand_eye`` about poses.
    """
    check_positive(most, "most", "seconds")
    views = seen_poses(target_poses)
    if len(views) < MIN_VIEWS_FOR_OFFSET:
        raise Code.TOO_FEW.unexpected(
            f"time offset: expected {MIN_VIEWS_FOR_OFFSET} views or more",
            MIN_VIEWS_FOR_OFFSET,
            len(views),
        )
    fit = _Moving(history, views, setup, most)
    everything = np.arange(len(views))
    offset = fit.best(everything)
    part = everything % LEFT_OUT_PARTS
    folds = np.unique(part)
    others = [fit.refined(everything[part != fold], offset) for fold in folds]
    scatter = math.sqrt(float(jackknife(np.array(others)[:, None])[0, 0]))
    sigma = max(scatter, fit.least_sigma(offset, everything))
    if abs(offset) > 0.99 * most or sigma > MAX_SIGMA_SHARE * most:
        raise Code.BAD_TIME.refusal(
            f"time offset: expected views that tell one within {most:g} s, got {offset:.3g} s with "
            f"a sigma of {sigma:.2g} s: take pictures while the robot moves, or allow more",
            most,
            offset,
        )
    return TimeOffset(offset, sigma, fit.error(0.0, everything), fit.error(offset, everything))


class _Moving:
    """A moving robot and the views of its camera, to be compared at different offsets."""

    def __init__(
        self, history: PoseHistory, views: Sequence[Transform], setup: str, most: float
    ) -> None:
        self._history, self._most = history, most
        self._in_hand = is_in_hand(setup, "time offset")
        self._views = Rigid.stacked(view.rigid for view in views)
        for number, view in enumerate(views):
            if view.at is None:
                raise Code.BAD_TIME.refusal(
                    f"time offset: expected view {number} with a time, got none", got=None
                )
        self._times = [view.at for view in views if view.at is not None]
        self._arm = float(np.median(np.linalg.norm(self._views.translation, axis=1)))
        check_motion(self._robot(0.0, np.arange(len(views))))

    def _robot(self, offset: float, index: NDArray[np.intp]) -> RobotPoses:
        step = timedelta(seconds=offset)
        poses = [self._history.at(self._times[i] + step).rigid for i in index.tolist()]
        return RobotPoses(Rigid.stacked(poses), self._in_hand)

    def error(self, offset: float, index: NDArray[np.intp]) -> float:
        """Return the RMS difference between poses and views at some indices, metres."""
        robot, seen = self._robot(offset, index), self._views.subset(index)
        solution = solve_linear("shah", robot, seen)
        if solution is None:
            return math.inf
        turn, shift = np.split(
            seen.steps_to(predicted_views(solution[0], robot, solution[1])), 2, axis=1
        )
        squares = (shift**2).sum(axis=1) + self._arm**2 * (turn**2).sum(axis=1)
        return math.sqrt(float(squares.mean()))

    def least_sigma(self, offset: float, index: NDArray[np.intp]) -> float:
        """Return the sigma of an offset if all errors were noise; infinite if none is better."""
        # The minimum x of a mean square m + c x^2 of n values with noise m has the variance m/cn.
        step = math.copysign(4.0 * self._most / (COARSE_STEPS - 1), -offset)
        least, beside = (self.error(lag, index) ** 2 for lag in (offset, offset + step))
        rise = (beside - least) / step**2
        return math.sqrt(least / (rise * 6 * len(index))) if rise > 0 else math.inf

    def best(self, index: NDArray[np.intp]) -> float:
        """Return the best offset of the whole range."""
        tried = np.linspace(-self._most, self._most, COARSE_STEPS)
        return self.refined(index, min(tried.tolist(), key=lambda lag: self.error(lag, index)))

    def refined(self, index: NDArray[np.intp], start: float) -> float:
        """Return the best offset near a given one."""
        step = 2.0 * self._most / (COARSE_STEPS - 1)
        low, high = max(start - step, -self._most), min(start + step, self._most)
        search = load("scipy.optimize").minimize_scalar
        minimum = search(lambda lag: self.error(lag, index), bounds=(low, high), method="bounded")
        return float(minimum.x)
