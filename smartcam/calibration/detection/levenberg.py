"""Many small least-squares problems of one kind, solved side by side.

Levenberg's and Marquardt's method, for fits to the pixels around each of many points: NumPy's cost
of a call is paid once for all of them, and those that no longer move drop out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from smartcam.calibration.detection.pixels import Floats, Windows
    from smartcam.calibration.geometry.rotations import Array

__all__ = ["Fits", "covariances", "fits_of", "fitted", "solve"]

MOST_STEPS = 20
"""Of a fit; most take four to seven."""

STILL = 1e-3
"""Pixels by which a point moves in the last step at most."""

RIDGE = 1e-6
"""Added to the diagonal: what no pixel determines stays finite."""


class Fits(NamedTuple):
    """A model with M values at each of N points.

    Attributes:
        values: (N, M).
        cost: (N,), sum of the squared residuals.
        hessian: (N, M, M), the Jacobian's transpose by the Jacobian.
        gradient: (N, M), the Jacobian's transpose by the residuals.
    """

    values: Array
    cost: Array
    hessian: Array
    gradient: Array

    def put(self, which: NDArray[np.intp], others: Fits, chosen: NDArray[np.bool_]) -> None:
        """Take over the chosen ones of others; ``which`` says whose they are."""
        for mine, other in zip(self, others, strict=True):
            mine[which[chosen]] = other[chosen]


def fits_of(
    values: Array, columns: Sequence[Floats], factors: Sequence[Floats], residuals: Floats
) -> Fits:
    """Return the normal equations.

    Args:
        values: (N, M).
        columns: M of the Jacobian, (N, P) each, 0 where a pixel does not count.
        factors: (N, 1), by which each of them is multiplied.
        residuals: (N, P), measured less modelled, 0 where a pixel does not count.
    """
    jacobian = np.stack(columns, axis=1)
    scale = np.concatenate(factors, axis=1).astype(np.float64)
    hessian = (jacobian @ jacobian.transpose(0, 2, 1)) * scale[:, :, None] * scale[:, None]
    gradient = (jacobian @ residuals[:, :, None])[:, :, 0] * scale
    cost = np.einsum("np,np->n", residuals, residuals).astype(np.float64)
    return Fits(values.copy(), cost, hessian, gradient)


def fitted(fits: Fits, which: slice) -> Array:
    """Return the best of some values (N, K) on which the model depends linearly, the others kept.

    They must be 0 in ``fits``.
    """
    hessian = fits.hessian[:, which, which] + RIDGE * np.eye(fits.hessian[0, which].shape[0])
    return np.asarray(np.linalg.solve(hessian, fits.gradient[:, which, None])[:, :, 0], np.float64)


def solve(
    evaluate: Callable[[Windows, Array], Fits],
    windows: Windows,
    values: Array,
    *,
    moving: Sequence[int],
    bounds: Mapping[int, tuple[float, float]],
) -> tuple[Fits, NDArray[np.bool_]]:
    """Return the best fits.

    Args:
        evaluate: the model.
        windows: the pixels of N points.
        values: (N, M), to start from.
        moving: which of the values are pixels that must come to rest.
        bounds: of values, by their number.

    Returns:
        Fits with a cost not above the start's, and (N,), which of them came to rest.
    """
    best = evaluate(windows, values)
    settled = np.zeros(len(values), dtype=np.bool_)
    damping = np.full(len(values), 1e-3)
    active = np.arange(len(values))
    identity = np.eye(values.shape[1])
    for _ in range(MOST_STEPS):
        hessian = best.hessian[active]
        diagonal = np.einsum("nii->ni", hessian) * damping[active, None] + RIDGE
        damped = hessian + diagonal[:, :, None] * identity
        step = np.linalg.solve(damped, best.gradient[active, :, None])[:, :, 0]
        trial = best.values[active] + step
        for number, (low, high) in bounds.items():
            trial[:, number] = np.clip(trial[:, number], low, high)
        tried = evaluate(windows, trial)
        better = tried.cost <= best.cost[active]
        best.put(active, tried, better)
        damping[active] *= np.where(better, 0.1, 10.0)
        still = np.abs(step[:, moving]).max(axis=1) < STILL
        settled[active[still]] = True
        windows, active = windows.some(~still), active[~still]
        if not len(active):
            break
    return best, settled


def covariances(fits: Fits, counts: Array) -> Array:
    """Return each fit's covariance (N, M, M), with the noise that its residuals show.

    Args:
        fits: N of them.
        counts: (N,), pixels that count.
    """
    size = fits.values.shape[1]
    variance = fits.cost / np.maximum(counts - size, 1)
    inverse = np.linalg.inv(fits.hessian + RIDGE * np.eye(size))
    covariance: Array = inverse * variance[:, None, None]
    return covariance
