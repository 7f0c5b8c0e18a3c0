"""Estimate a robot's pose noise from the views of a camera on it.

The noise of a robot is two standard deviations, of rotation and of translation. They are chosen so
that the restricted likelihood of the observations is largest: the likelihood from which the unknown
poses of camera and target and the corrections of the robot's poses are eliminated. Sums that are
computed once give this likelihood for any standard deviations.

Source: Patterson and Thompson, Biometrika 58 (1971).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from smartcam._extras import load
from smartcam.calibration._hand_eye.equations import (
    ROUGH_GAIN,
    RobotNoise,
    RobotSigmas,
    adjust,
    view_products,
)
from smartcam.calibration._least_squares import solve_scaled

if TYPE_CHECKING:
    from smartcam.calibration._hand_eye.equations import Observations, RobotPoses, Solution
    from smartcam.geometry._inside import Array

FIRST_SIGMAS = RobotSigmas(1e-3, 5e-4)
"""Noise of the robot that the first adjustment assumes: 0.06 degrees and half a millimetre."""

MIN_SIGMAS = RobotSigmas(1e-7, 1e-8)
"""Least noise that is considered for a robot: 0.1 microradian and a hundredth of a micrometre."""

MAX_SIGMAS = RobotSigmas(0.3, 0.1)
"""Largest noise that is considered for a robot: 0.3 rad and 100 mm."""

FIRST_SHARED_FACTOR = 5.0
"""Factor of the views' shared errors that the first adjustment assumes, if the factor is
estimated."""

MAX_SHARED_FACTOR = 300.0
"""Largest factor of the views' shared errors; with a larger factor, 100 points with a noise of 0.1
pixels would tell nothing."""

COARSE_VALUES = 5
"""Each standard deviation is first tried at this many values."""

MAX_ITERATIONS = 4
"""Limit of the alternations between adjusting and estimating the noise; two are usually enough."""

CONVERGED_RATIO = 0.02
"""The alternation ends when the estimates change by less than this fraction."""


def adjust_with_noise(robot: RobotPoses, observations: Observations, start: Solution) -> Solution:
    """Return the adjustment with the noise that makes the observations most likely.

    ``observations`` is whitened. The adjustment begins at ``start`` and, if ``start`` has a noise,
    with this noise.
    """
    noise = start.noise or RobotNoise(FIRST_SIGMAS, FIRST_SHARED_FACTOR)
    adjusted = adjust(robot, observations, start, noise, min_gain=ROUGH_GAIN)
    for iteration in range(MAX_ITERATIONS):
        if not math.isfinite(adjusted.cost):
            break
        previous = noise
        noise = _estimate_noise(
            robot,
            observations,
            adjusted,
            noise,
            search_everywhere=not iteration and start.noise is None,
        )
        has_converged = bool(np.abs(_logs(noise) - _logs(previous)).max() < CONVERGED_RATIO)
        adjusted = adjust(robot, observations, adjusted, noise, min_gain=ROUGH_GAIN)
        if has_converged:
            break
    return adjust(robot, observations, adjusted, noise)


def _logs(noise: RobotNoise) -> Array:
    logs: Array = np.log([*noise.robot, noise.view_error_factor])
    return logs


def _estimate_noise(
    robot: RobotPoses,
    observations: Observations,
    solution: Solution,
    noise: RobotNoise,
    *,
    search_everywhere: bool,
) -> RobotNoise:
    """Return the standard deviations whose restricted likelihood is largest.

    ``search_everywhere``: search the whole range, not only from ``noise`` on.
    """
    products = view_products(robot, observations, solution, poses_only=True)[0]
    low, high = np.log([*MIN_SIGMAS, 1.0]), np.log([*MAX_SIGMAS, MAX_SHARED_FACTOR])

    def cost(logs: Array) -> float:
        clipped = np.clip(logs, low, high)
        excess = float(((logs - clipped) ** 2).sum())
        return _likelihood_cost(products, np.exp(clipped)) + 1e3 * excess

    axes = [
        np.linspace(a, b, COARSE_VALUES if search_everywhere else 0)
        for a, b in zip(low, high, strict=True)
    ]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
    start = min([_logs(noise), *grid], key=cost)
    settings = {"xatol": 3e-3, "fatol": 1e-3, "maxiter": 300}
    minimum = load("scipy.optimize").minimize(cost, start, method="Nelder-Mead", options=settings)
    values = np.exp(np.clip(minimum.x, low, high)).tolist()
    return RobotNoise(RobotSigmas(values[0], values[1]), values[2])


def _likelihood_cost(products: Array, values: Array) -> float:
    """Return -2 log of the restricted likelihood, without its constants.

    ``products`` (V, 6 + P + 1, 6 + P + 1): products of the derivatives with respect to the robot's
    correction and the P other unknowns, and of the residuals without corrections. ``values`` (3,):
    sigmas of rotation and translation, and the factor of the views' errors.
    """
    # Residuals r = J x + B c + e, with corrections c of covariance D = diag(sigma^2) and noise e of
    # covariance I, have V = I + B D B^T. The restricted likelihood does not depend on x:
    #     -2 log L = log|V| + log|J^T V^-1 J| + r^T V^-1 r - r^T V^-1 J (J^T V^-1 J)^-1 J^T V^-1 r.
    # By Woodbury's identity V^-1 = I - B s (I + s B^T B s)^-1 s B^T with s = D^(1/2), and
    # |V| = |I + s B^T B s|: so the products of B, J and r, view by view, are all that is needed,
    # and V^-1 between J and r is Schur's complement of I + s B^T B s. Errors that a view's points
    # share make the covariance of its six residuals f^2 times as large: 6 log f^2 for each view.
    # Source: Patterson and Thompson, Recovery of inter-block information when block sizes are
    # unequal (1971); Harville, Bayesian inference for variance components using only error
    # contrasts (1974), for the form with determinants.
    sigmas = np.repeat(values[:2], 3)
    scaled = products / values[2] ** 2
    determinants = 12.0 * len(products) * math.log(values[2])
    # in units of its sigma a correction has a variance of 1
    scaled[:, :6] *= sigmas[:, None]
    scaled[:, :, :6] *= sigmas
    correction_matrix = scaled[:, :6, :6] + np.eye(6)
    complements = scaled[:, 6:, 6:] - scaled[:, 6:, :6] @ np.linalg.solve(
        correction_matrix, scaled[:, :6, 6:]
    )
    reduced = complements.sum(axis=0)
    matrix, right = reduced[:-1, :-1], reduced[:-1, -1]
    squares = float(reduced[-1, -1] - right @ solve_scaled(matrix, right))
    determinants += float(
        np.linalg.slogdet(correction_matrix)[1].sum() + np.linalg.slogdet(matrix)[1]
    )
    return squares + determinants
