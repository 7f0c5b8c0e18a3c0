"""Compute the jackknife: the covariance of an estimate from the estimates without each view.

An error that all residuals of a view share (a sheet that bends anew, a rolling shutter, a lens that
does not quite follow its model) is no noise of its hundreds of points: it is one error per view. So
the number of views counts, and the pull of each view on the estimate.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from smartcam.calibration._least_squares import RANK, unit_diagonal

if TYPE_CHECKING:
    from smartcam.geometry._inside import Array


def jackknife(left_out: Array) -> Array:
    """Return the covariance (K, K) of an estimate of K values.

    ``left_out`` (V, K): the estimate without each of its V views, 2 or more, or its difference to
    any fixed value. The covariance is NaN where one of these is.
    """
    # (V - 1) / V times the squares about their mean: an estimate without one view is off the whole
    # one by 1 / (V - 1) of how far that view is off the mean of all.
    # Source: Efron, The Jackknife, the Bootstrap and Other Resampling Plans (1982), section 3.
    count = len(left_out)
    if count < 2:
        raise ValueError(f"jackknife: expected 2 views or more, got {count}")
    deviations = left_out - left_out.mean(axis=0)
    covariance: Array = (count - 1) / count * deviations.T @ deviations
    return covariance


def weighed_jackknife(changes: Array, spreads: Array, whole: Array, power: float) -> Array:
    """Return the jackknife of a least-squares estimate, with less weight for views that pull more.

    The plain jackknife is too large by a half and more if single views carry much of the
    information, as they do for lenses. ``changes`` (V, K): by how much the estimate changes without
    each view. ``spreads`` (V, K, K) is the covariance of the estimate without each view, ``whole``
    (K, K) that with all; both are those that independent errors of all points would cause.
    ``power``: with 1/2, and with all values that are estimated together, the expectation is the
    covariance where points err independently; with less, views that err as a whole count for more.
    """
    # With L L^T the whole covariance and W_i = L^-1 C_i L^-T, change i weighs W_i^-power. The
    # squares' sum of the weighed changes has the expectation L sum(I - W_i^-1) L^T for 1/2, and the
    # information I - W_i^-1 of all views adds up to I. Source: Bell and McCaffrey, Bias Reduction
    # in Standard Errors for Linear Regression with Multi-Stage Samples (2002).
    if not changes.size:
        return np.zeros(whole.shape)
    scale = unit_diagonal(whole)
    values, vectors = np.linalg.eigh(whole / np.outer(scale, scale))
    significant = values > RANK * values.max()
    root = scale[:, None] * vectors[:, significant] * np.sqrt(values[significant])
    back = np.linalg.pinv(root)
    sizes, ways = np.linalg.eigh(back @ spreads @ back.T)
    along = np.einsum("vji,jk,vk->vi", ways, back, changes) / np.maximum(sizes, 1.0) ** power
    steps = np.einsum("kj,vji,vi->vk", root, ways, along)
    covariance: Array = steps.T @ steps
    return covariance
