"""Compute the jackknife: the covariance of an estimate from the estimates without each view.

An error that all residuals of a view share (a sheet that bends anew for each view, a rolling
shutter, a lens that does not quite follow its model) is one error per view, not noise of the view's
hundreds of points. So the covariance depends on the number of views and on how much the estimate
changes without each of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from smartcam.calibration._least_squares import RANK_TOLERANCE, diagonal_scale

if TYPE_CHECKING:
    from smartcam.geometry._inside import Array


def jackknife(left_out_estimates: Array) -> Array:
    """Return the covariance (K, K) of an estimate of K values.

    ``left_out_estimates`` (V, K): the estimate without each of its V views, 2 or more, or the
    difference of this estimate to any fixed value. The covariance is NaN for values of which an
    estimate is NaN.
    """
    # (V - 1) / V times the squares about their mean: leaving out one view changes the estimate by
    # 1 / (V - 1) of that view's difference from the mean of all views.
    # Source: Efron, The Jackknife, the Bootstrap and Other Resampling Plans (1982), section 3.
    count = len(left_out_estimates)
    if count < 2:
        raise ValueError(f"jackknife: expected 2 views or more, got {count}")
    deviations = left_out_estimates - left_out_estimates.mean(axis=0)
    covariance: Array = (count - 1) / count * deviations.T @ deviations
    return covariance


def weighted_jackknife(
    changes: Array, left_out_covariances: Array, covariance_of_all: Array, power: float
) -> Array:
    """Return the jackknife covariance of least squares, with less weight for influential views.

    The plain jackknife is too large by a half and more if single views carry much of the
    information, as they do for lenses. ``changes`` (V, K): by how much the estimate changes without
    each view. ``left_out_covariances`` (V, K, K): covariance of the estimate without each view, and
    ``covariance_of_all`` (K, K): with all views, both for independent errors of all points.
    ``power``: 1/2 gives the right expectation if points err independently and all values that are
    estimated together are given; a smaller power gives more weight to errors of whole views.
    """
    # With L L^T the covariance of all and W_i = L^-1 C_i L^-T, change i weighs W_i^-power. The
    # squares' sum of the weighed changes has the expectation L sum(I - W_i^-1) L^T for 1/2, and the
    # information I - W_i^-1 of all views adds up to I. Source: Bell and McCaffrey, Bias Reduction
    # in Standard Errors for Linear Regression with Multi-Stage Samples (2002).
    if not changes.size:
        return np.zeros(covariance_of_all.shape)
    scale = diagonal_scale(covariance_of_all)
    values, vectors = np.linalg.eigh(covariance_of_all / np.outer(scale, scale))
    significant = values > RANK_TOLERANCE * values.max()
    root = scale[:, None] * vectors[:, significant] * np.sqrt(values[significant])
    root_inverse = np.linalg.pinv(root)
    eigenvalues, eigenvectors = np.linalg.eigh(root_inverse @ left_out_covariances @ root_inverse.T)
    weighted = (
        np.einsum("vji,jk,vk->vi", eigenvectors, root_inverse, changes)
        / np.maximum(eigenvalues, 1.0) ** power
    )
    weighted_changes = np.einsum("kj,vji,vi->vk", root, eigenvectors, weighted)
    covariance: Array = weighted_changes.T @ weighted_changes
    return covariance
