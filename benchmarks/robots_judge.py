"""Poses that were left out: by how much smartcam and each closed form are off there.

Both get the same corners, the same lens and the sheet as large as it is said to be; the errors of
both are those on the sheet that ``HandEyeCalibration.point_errors`` gives.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np

from smartcam.calibration._hand_eye.calibration import (
    calibrate_hand_eye,
    calibrate_hand_eye_from_poses,
)
from smartcam.calibration._hand_eye.closed_forms import OPENCV_METHODS, solve_closed_form
from smartcam.calibration._hand_eye.equations import RobotPoses, Solution
from smartcam.calibration._views import TargetView
from smartcam.geometry._inside import Rigid

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from smartcam.calibration._hand_eye.equations import Setup
    from smartcam.calibration._hand_eye.result import HandEyeCalibration
    from smartcam.geometry import CameraModel, Transform
    from smartcam.geometry._inside import Array

    Numbers = NDArray[np.intp]

__all__ = ["OURS", "folds", "judged", "rms"]

OURS = "smartcam"

FOLDS = 5


def folds(count: int) -> Iterator[tuple[Numbers, Numbers]]:
    """Yield numbers of poses to calibrate with, and of the others; of few poses each alone."""
    numbers = np.arange(count)
    parts = FOLDS if count >= 2 * FOLDS else count
    for part in range(parts):
        yield numbers[numbers % parts != part], numbers[numbers % parts == part]


def judged(
    poses: Sequence[Transform],
    seen: Sequence[TargetView] | Sequence[Transform],
    setup: Setup,
    camera: CameraModel | None,
    split: tuple[Numbers, Numbers],
) -> dict[str, Array]:
    """Return squared errors of smartcam's default and of each closed form at the other poses, m^2.

    ``camera`` is the lens of views; ``split``: the poses to calibrate with, and the others.
    """
    used, fresh = split
    some, other = [poses[i] for i in used], [poses[i] for i in fresh]
    views = [one for one in seen if isinstance(one, TargetView)]
    if views:
        ours = calibrate_hand_eye(
            some, [views[i] for i in used], setup=setup, camera=camera, adjust="nothing"
        )
    else:
        given = [one for one in seen if not isinstance(one, TargetView)]
        ours = calibrate_hand_eye_from_poses(
            some, [given[i] for i in used], setup=setup, adjust="nothing"
        )
    shown = [seen[i] for i in fresh]
    found = {OURS: _squares(ours, other, shown)}
    robot = RobotPoses(Rigid.stack(one.rigid for one in some), setup == "eye-in-hand")
    placed = Rigid.stack(one.rigid for one in ours.target_poses)
    for name in OPENCV_METHODS:
        pair = solve_closed_form(name, robot, placed, use_all_views=True)
        found[name] = np.full(1, math.inf)
        if pair is not None:
            found[name] = _squares(_replaced(ours, Solution(*pair)), other, shown)
    return found


def _replaced(one: HandEyeCalibration, by: Solution) -> HandEyeCalibration:
    camera = dataclasses.replace(
        one.camera_pose, rotation=by.camera.rotation, translation=by.camera.translation
    )
    target = dataclasses.replace(
        one.target_pose, rotation=by.target.rotation, translation=by.target.translation
    )
    return dataclasses.replace(one, camera_pose=camera, target_pose=target)


def _squares(
    one: HandEyeCalibration,
    poses: Sequence[Transform],
    seen: Sequence[TargetView | Transform],
) -> Array:
    squares: Array = np.concatenate(one.point_errors(poses, seen)) ** 2
    return squares


def rms(parts: Sequence[Mapping[str, Array]]) -> dict[str, float]:
    """Return the rms of each side over several parts, metres."""
    return {
        name: math.sqrt(float(np.concatenate([one[name] for one in parts]).mean()))
        for name in parts[0]
    }
