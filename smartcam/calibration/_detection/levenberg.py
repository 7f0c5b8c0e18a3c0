"""Solve many small least-squares problems of one kind at once.

Levenberg's and Marquardt's method, for fits to the pixels around each of many points: each NumPy
call handles all points whose fits have not yet converged.
:mod:`smartcam.calibration._least_squares` is not used here, since it solves single problems.

The models are of blurred edges. Their last three values are the lens' blur, the gain (half the step
from black to white) and the offset of the grey levels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from smartcam.calibration._detection.pixels import Floats, Windows
    from smartcam.geometry._inside import Array

BLUR, GAIN, OFFSET = -3, -2, -1

MIN_BLUR_PIXELS = 0.25
"""Least blur of a fit, pixels: a fit cannot measure a blur that is far below a pixel's width."""

MAX_BLUR_PIXELS = 6.0
"""Largest blur of a good fit, pixels: pixels with a larger blur show no edge."""

MIN_HALF_STEP = 4.0
"""The gain of a good fit, half the step from black to white, is above this, grey levels of 255."""

MAX_STEPS = 20
"""A fit takes at most this many steps; most fits take four to seven."""

MAX_FINAL_STEP_PX = 1e-3
"""A fit has converged when a step moves the point by less than this many pixels."""

DIAGONAL_OFFSET = 1e-6
"""Added to the diagonal, so that a value which no pixel determines stays finite."""


class Fits(NamedTuple):
    """The M fitted values at each of N points, with their normal equations."""

    values: Array  # (N, M)
    cost: Array  # (N,), sum of the squared residuals
    hessian: Array  # (N, M, M), the Jacobian's transpose by the Jacobian
    gradient: Array  # (N, M), the Jacobian's transpose by the residuals

    def replace_where(
        self, indices: NDArray[np.intp], others: Fits, mask: NDArray[np.bool_]
    ) -> None:
        """Replace the fits at ``indices`` by those of ``others`` where ``mask`` is True."""
        for array, other in zip(self, others, strict=True):
            array[indices[mask]] = other[mask]


def make_fits(
    values: Array, columns: Sequence[Floats], factors: Sequence[Floats], residuals: Floats
) -> Fits:
    """Return the normal equations of fits with ``values`` (N, M).

    ``columns``: the M columns of the Jacobian, (N, P) each, to be multiplied by ``factors`` (N, 1).
    ``residuals`` (N, P): measured minus modelled. Both are 0 where a pixel does not count.
    """
    # J = (f_1 c_1, f_2 c_2, ...): J^T J and J^T r of the columns c, in single precision, are
    # scaled by the factors f afterwards, in double precision.
    jacobian = np.stack(columns, axis=1)
    scale = np.concatenate(factors, axis=1).astype(np.float64)
    hessian = (jacobian @ jacobian.transpose(0, 2, 1)) * scale[:, :, None] * scale[:, None]
    gradient = (jacobian @ residuals[:, :, None])[:, :, 0] * scale
    cost = np.einsum("np,np->n", residuals, residuals).astype(np.float64)
    return Fits(values.copy(), cost, hessian, gradient)


def fit_windows(
    evaluate: Callable[[Windows, Array], Fits],
    windows: Windows,
    values: Array,
    *,
    position_indices: Sequence[int],
    max_residual_ratio: float,
) -> tuple[Fits, NDArray[np.bool_]]:
    """Return the best fits, and a mask (N,) of the good ones.

    A fit is good if it converged, and if an edge may have its blur and gain. Fits start from
    ``values`` (N, M), whose blur is set to 1 pixel, and gain and offset to the best for the others.
    ``position_indices``: indices of the values in pixels, by whose steps convergence is judged.
    ``max_residual_ratio``: largest RMS of a good fit's residuals, as a fraction of its gain.
    """
    values[:, BLUR], values[:, GAIN:] = 1.0, 0.0
    # The model is linear in gain and offset, so solving their normal equations once gives the best.
    level_fits = evaluate(windows, values)
    linear = level_fits.hessian[:, GAIN:, GAIN:] + DIAGONAL_OFFSET * np.eye(2)
    values[:, GAIN:] = np.linalg.solve(linear, level_fits.gradient[:, GAIN:, None])[:, :, 0]
    fits, has_converged = _solve(evaluate, windows, values, position_indices)
    blur, gain = fits.values[:, BLUR], np.abs(fits.values[:, GAIN])
    rms = np.sqrt(fits.cost / windows.counts)
    return fits, has_converged & (blur < MAX_BLUR_PIXELS) & (gain > MIN_HALF_STEP) & (
        rms < max_residual_ratio * gain
    )


def _solve(
    evaluate: Callable[[Windows, Array], Fits],
    windows: Windows,
    values: Array,
    position_indices: Sequence[int],
) -> tuple[Fits, NDArray[np.bool_]]:
    """Return the best fits, none worse than its start, and a mask (N,) of those that converged."""
    best = evaluate(windows, values)
    has_converged = np.zeros(len(values), dtype=np.bool_)
    damping = np.full(len(values), 1e-3)
    active = np.arange(len(values))
    identity = np.eye(values.shape[1])
    for _ in range(MAX_STEPS):
        hessian = best.hessian[active]
        # (J^T J + damping diag(J^T J)) step = J^T r, each point with a damping of its own.
        # Source: Marquardt, An Algorithm for Least-Squares Estimation of Nonlinear Parameters
        # (1963).
        diagonal = np.einsum("nii->ni", hessian) * damping[active, None] + DIAGONAL_OFFSET
        damped = hessian + diagonal[:, :, None] * identity
        step = np.linalg.solve(damped, best.gradient[active, :, None])[:, :, 0]
        tried_values = best.values[active] + step
        tried_values[:, BLUR] = np.clip(tried_values[:, BLUR], MIN_BLUR_PIXELS, 2 * MAX_BLUR_PIXELS)
        tried_fits = evaluate(windows, tried_values)
        is_better = tried_fits.cost <= best.cost[active]
        best.replace_where(active, tried_fits, is_better)
        damping[active] *= np.where(is_better, 0.1, 10.0)
        has_stopped = np.abs(step[:, position_indices]).max(axis=1) < MAX_FINAL_STEP_PX
        has_converged[active[has_stopped]] = True
        windows, active = windows.subset(~has_stopped), active[~has_stopped]
        if not len(active):
            break
    return best, has_converged


def covariances(fits: Fits, counts: Array) -> Array:
    """Return the covariance (N, M, M) of each fit, with the noise estimated from its residuals.

    ``counts`` (N,): the number of pixels in each fit.
    """
    # s^2 (J^T J)^-1 with s^2 = sum r^2 / (pixels - M)
    size = fits.values.shape[1]
    variance = fits.cost / np.maximum(counts - size, 1)
    inverse = np.linalg.inv(fits.hessian + DIAGONAL_OFFSET * np.eye(size))
    covariance: Array = inverse * variance[:, None, None]
    return covariance
