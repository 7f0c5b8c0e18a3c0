"""Estimate the offset between the clocks of a robot and a camera, while the robot moves.

A robot at 250 mm/s whose pose is taken 20 ms late is 5 mm off. A camera on the robot, or one
that watches the target on its hand, sees where the robot really was. With the right offset, poses
and views agree best on one place of the camera.
"""

from __future__ import annotations

import math
from datetime import timedelta
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam._argument_checks import a_number, check_arguments, of_class
from smartcam._extras import load
from smartcam.calibration._hand_eye.closed_forms import check_motion, solve_closed_form
from smartcam.calibration._hand_eye.equations import RobotPoses, is_in_hand, predicted_views
from smartcam.calibration._hand_eye.validation import as_target_poses
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

MAX_FOLDS = 20
"""The sigma of the offset is found by leaving out each of up to this many groups of views."""

MIN_VIEWS_FOR_OFFSET = 10
"""An offset needs at least this many views, since each view says little about it."""

MAX_SIGMA_SHARE = 0.25
"""An offset is returned only if its sigma is at most this fraction of the largest offset."""


class TimeOffset(NamedTuple):
    """An offset between the clocks of a robot and a camera, with its sigma.

    Attributes:
        seconds: time to add to a picture's time to ask the robot's history for its pose.
        sigma: standard deviation of ``seconds``, by the scatter between views, seconds.
        rms_before: rms difference of poses and views without the offset, metres.
        rms_after: rms difference of poses and views with the offset, metres.
    """

    seconds: float
    sigma: float
    rms_before: float
    rms_after: float


@check_arguments(history=of_class("PoseHistory"), max_offset=a_number)
def estimate_time_offset(
    history: PoseHistory,
    target_poses: Sequence[Transform],
    *,
    setup: Setup,
    max_offset: float = 0.2,
) -> TimeOffset:
    """Estimate by how much the times of pictures differ from those of a robot's poses.

    ::

        offset = estimate_time_offset(history, seen, setup="eye-in-hand")
        poses = [history.at(one.at + timedelta(seconds=offset.seconds)) for one in seen]

    Args:
        history: ``T_base_flange`` while the pictures were taken, and for ``max_offset`` seconds
            before and after.
        target_poses: ``T_camera_target`` of each picture, with its time (``at``): ten or more,
            taken while the robot moves and turns, fast enough to matter and in several directions.
        setup: place of the camera, as for :func:`~smartcam.calibration.calibrate_hand_eye`.
        max_offset: largest offset to look for, seconds.

    Raises:
        CalibrationError: TOO_FEW; BAD_TIME: a view without a time, a history that does not reach
            far enough, or views that determine no offset in the range, as when the robot stood
            still; and the errors of ``calibrate_hand_eye`` about poses.
    """
    check_positive(max_offset, "max_offset", "seconds")
    views = as_target_poses(target_poses)
    if len(views) < MIN_VIEWS_FOR_OFFSET:
        raise Code.TOO_FEW.error_with_value(
            f"time offset: expected {MIN_VIEWS_FOR_OFFSET} views or more",
            MIN_VIEWS_FOR_OFFSET,
            len(views),
        )
    fit = _OffsetFit(history, views, setup, max_offset)
    all_views = np.arange(len(views))
    offset = fit.find_offset(all_views)
    fold_of_view = all_views % MAX_FOLDS
    folds = np.unique(fold_of_view)
    left_out_offsets = [
        fit.refine_offset(all_views[fold_of_view != fold], offset) for fold in folds
    ]
    scatter = math.sqrt(float(jackknife(np.array(left_out_offsets)[:, None])[0, 0]))
    sigma = max(scatter, fit.noise_sigma(offset, all_views))
    if abs(offset) > 0.99 * max_offset or sigma > MAX_SIGMA_SHARE * max_offset:
        raise Code.BAD_TIME.error(
            f"time offset: expected views that determine an offset up to {max_offset:g} s, got "
            f"{offset:.3g} s with a sigma of {sigma:.2g} s: take pictures while the robot moves, "
            "or allow a larger offset",
            max_offset,
            offset,
        )
    return TimeOffset(offset, sigma, fit.error(0.0, all_views), fit.error(offset, all_views))


class _OffsetFit:
    """The fit of an offset to a moving robot's poses and the views of its camera."""

    def __init__(
        self, history: PoseHistory, views: Sequence[Transform], setup: str, max_offset: float
    ) -> None:
        self._history, self._max_offset = history, max_offset
        self._in_hand = is_in_hand(setup, "time offset")
        self._views = Rigid.stack(view.rigid for view in views)
        for number, view in enumerate(views):
            if view.at is None:
                raise Code.BAD_TIME.error(
                    f"time offset: expected view {number} with a time, got none", got=None
                )
        self._times = [view.at for view in views if view.at is not None]
        self._lever = float(np.median(np.linalg.norm(self._views.translation, axis=1)))
        check_motion(self._robot(0.0, np.arange(len(views))))

    def _robot(self, offset: float, index: NDArray[np.intp]) -> RobotPoses:
        shift = timedelta(seconds=offset)
        poses = [self._history.at(self._times[i] + shift).rigid for i in index.tolist()]
        return RobotPoses(Rigid.stack(poses), self._in_hand)

    def error(self, offset: float, index: NDArray[np.intp]) -> float:
        """Return the RMS difference between poses and views at some indices, metres."""
        robot, target_poses = self._robot(offset, index), self._views.subset(index)
        solution = solve_closed_form("shah", robot, target_poses)
        if solution is None:
            return math.inf
        turn, shift = np.split(
            target_poses.target_steps_to(predicted_views(solution[0], robot, solution[1])),
            2,
            axis=1,
        )
        squares = (shift**2).sum(axis=1) + self._lever**2 * (turn**2).sum(axis=1)
        return math.sqrt(float(squares.mean()))

    def noise_sigma(self, offset: float, index: NDArray[np.intp]) -> float:
        """Return the sigma of an offset if all errors are noise; infinite if it is no minimum."""
        # If the mean square of n values is m + c x^2, its minimum x has the variance m / (c n).
        step = math.copysign(4.0 * self._max_offset / (COARSE_STEPS - 1), -offset)
        square, next_square = (self.error(tried, index) ** 2 for tried in (offset, offset + step))
        curvature = (next_square - square) / step**2
        return math.sqrt(square / (curvature * 6 * len(index))) if curvature > 0 else math.inf

    def find_offset(self, index: NDArray[np.intp]) -> float:
        """Return the best offset in the whole range."""
        offsets = np.linspace(-self._max_offset, self._max_offset, COARSE_STEPS)
        return self.refine_offset(
            index, min(offsets.tolist(), key=lambda offset: self.error(offset, index))
        )

    def refine_offset(self, index: NDArray[np.intp], start: float) -> float:
        """Return the best offset near ``start``."""
        step = 2.0 * self._max_offset / (COARSE_STEPS - 1)
        low, high = max(start - step, -self._max_offset), min(start + step, self._max_offset)
        search = load("scipy.optimize").minimize_scalar
        minimum = search(
            lambda offset: self.error(offset, index), bounds=(low, high), method="bounded"
        )
        return float(minimum.x)
