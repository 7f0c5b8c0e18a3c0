"""How well a robot knows its poses, told from what a camera on it sees.

The sums of an adjustment are worked out once; for any two standard deviations of the robot they
give the restricted likelihood of what was seen, in which neither the unknown poses of camera and
target nor the corrections of the robot's poses are left. Its largest value is looked for.

Source: Patterson and Thompson, Biometrika 58 (1971).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.calibration.hand_eye.equations import (
    ROUGH_GAIN,
    SMALLEST_GAIN,
    RobotSigmas,
    adjust,
    sums,
)
from smartcam.calibration.optional_imports import load

if TYPE_CHECKING:
    from smartcam.calibration.geometry.rotations import Array
    from smartcam.calibration.hand_eye.equations import Adjusted, Observations, Rigid, Robot

__all__ = ["FIRST", "Noise", "Noisy", "adjust_noisy"]

FIRST = RobotSigmas(1e-3, 5e-4)
"""With which the first adjustment is made: 0.06 degrees and half a millimetre."""

LEAST = RobotSigmas(1e-7, 1e-8)
"""What no robot is better than: a hundredth of a micrometre."""

MOST = RobotSigmas(0.3, 0.1)
"""What no robot is worse than."""

FIRST_SHARED = 5.0
"""With which the first adjustment is made where it is estimated."""

MOST_SHARED = 300.0
"""A view of 100 points at a tenth of a pixel would say nothing then."""

COARSE = 5
"""Values of each standard deviation that are tried at first."""

ROUNDS = 4
"""Of adjusting and estimating; the estimate hardly changes after two."""

SETTLED = 0.02
"""Part of the estimates by which a round must change them for another one."""


class Noise(NamedTuple):
    """Of robot and camera.

    Attributes:
        robot: standard deviations of its poses.
        shared: factor by which the views' poses are off more than their points tell: what the
            points of a view have in common, such as errors of the lens, does not average out.
    """

    robot: RobotSigmas
    shared: float


class Noisy(NamedTuple):
    """An adjustment, and the noise it was made with."""

    adjusted: Adjusted
    noise: Noise


def adjust_noisy(
    robot: Robot, seen: Observations, camera: Rigid, target: Rigid, *, shared: bool = False
) -> Noisy:
    """Return the adjustment with the noise that makes what was seen most likely.

    Args:
        robot: its poses.
        seen: what the camera saw, of as many views, whitened.
        camera: ``X`` to begin with.
        target: ``Z`` to begin with.
        shared: estimate the errors that the points of a view share, too.
    """
    noise = Noise(FIRST, FIRST_SHARED if shared else 1.0)
    found = adjust(
        robot, seen.spread(noise.shared), camera, target, sigmas=noise.robot, gain=ROUGH_GAIN
    )
    settled = False
    for _ in range(ROUNDS):
        if settled or not math.isfinite(found.cost):
            break
        before, noise = noise, _estimate(robot, seen, found, noise, shared=shared)
        settled = bool(np.abs(_logs(noise) - _logs(before)).max() < SETTLED)
        found = _following(robot, seen, found, noise, ROUGH_GAIN)
    return Noisy(_following(robot, seen, found, noise, SMALLEST_GAIN), noise)


def _following(
    robot: Robot, seen: Observations, at: Adjusted, noise: Noise, gain: float
) -> Adjusted:
    wide = seen.spread(noise.shared)
    start = at.camera, at.target
    return adjust(robot, wide, *start, sigmas=noise.robot, change=at.change, gain=gain)


def _logs(noise: Noise) -> Array:
    logs: Array = np.log([*noise.robot, noise.shared])
    return logs


def _estimate(
    robot: Robot, seen: Observations, at: Adjusted, noise: Noise, *, shared: bool
) -> Noise:
    """Return the standard deviations whose restricted likelihood is largest."""
    total = sums(robot, seen, at, poses_only=shared).total
    low, high = np.log([*LEAST, 1.0]), np.log([*MOST, MOST_SHARED])
    if not shared:
        low, high = low[:2], high[:2]

    def cost(logs: Array) -> float:
        inside = np.clip(logs, low, high)
        beyond = float(((logs - inside) ** 2).sum())
        return _unlikely(total, np.exp(inside)) + 1e3 * beyond

    axes = [np.linspace(a, b, COARSE) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, len(axes))
    start = min([_logs(noise)[: len(axes)], *grid], key=cost)
    settings = {"xatol": 1e-3, "fatol": 1e-4, "maxiter": 300}
    found = load("scipy.optimize").minimize(cost, start, method="Nelder-Mead", options=settings)
    values = np.exp(np.clip(found.x, low, high)).tolist()
    return Noise(RobotSigmas(values[0], values[1]), values[2] if shared else 1.0)


def _unlikely(total: Array, values: Array) -> float:
    """Return -2 log of the restricted likelihood, without its constants.

    Args:
        total: (V, 6 + P + 1, 6 + P + 1), products of the derivatives by the robot's correction, by
            the P other unknowns, and of the residuals without corrections.
        values: (2,), sigmas of rotation and translation; or (3,) with the shared errors' factor.
    """
    spread = np.repeat(values[:2], 3)
    scaled = total.copy()
    determinants = 0.0
    if len(values) > 2:
        scaled /= values[2] ** 2
        determinants = 12.0 * len(total) * math.log(values[2])
    # in units of its sigma a correction has a variance of 1
    scaled[:, :6] *= spread[:, None]
    scaled[:, :, :6] *= spread
    inner = scaled[:, :6, :6] + np.eye(6)
    rest = scaled[:, 6:, 6:] - scaled[:, 6:, :6] @ np.linalg.solve(inner, scaled[:, :6, 6:])
    reduced = rest.sum(axis=0)
    outer, right = reduced[:-1, :-1], reduced[:-1, -1]
    size = np.sqrt(np.maximum(np.diag(outer), np.finfo(np.float64).tiny))
    outer, right = outer / np.outer(size, size), right / size
    squares = float(reduced[-1, -1] - right @ np.linalg.lstsq(outer, right, rcond=1e-14)[0])
    determinants += float(np.linalg.slogdet(inner)[1].sum() + np.linalg.slogdet(outer)[1])
    return squares + determinants + 2.0 * float(np.log(size).sum())
