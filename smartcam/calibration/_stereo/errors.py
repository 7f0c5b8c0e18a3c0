"""Compute the errors of two cameras at a pair of views."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.calibration._stereo import triangulation

if TYPE_CHECKING:
    from smartcam.calibration._lens.bundle import Indices
    from smartcam.calibration._stereo.triangulation import CameraPair
    from smartcam.calibration._targets import Target
    from smartcam.calibration._views import TargetView
    from smartcam.geometry._inside import Array

NEIGHBOUR_DISTANCE_RATIO: Final = 1.01
"""Points are neighbours if they are at most this many times the least distance apart."""


class PairErrors(NamedTuple):
    """Errors of two cameras at one pair of views.

    Attributes:
        spacing: (M,), triangulated minus true distances between neighbouring points of the target,
            metres.
        epipolar: (N, 2), distances of the points from the epipolar lines of their partners, in the
            left image and in the right one, pixels without distortion.
    """

    spacing: Array
    epipolar: Array


def pair_errors(cameras: CameraPair, left: TargetView, right: TargetView) -> PairErrors:
    """Return the errors of two cameras at one pair of views of a target.

    The points of both views must be numbered alike.
    """
    ids, first, second = np.intersect1d(left.ids, right.ids, return_indices=True)
    pixels = left.points[first], right.points[second]
    covariance = left.covariance[first], right.covariance[second]
    points = triangulation.triangulate(cameras, pixels, covariance).points
    return PairErrors(
        spacing_errors(left.target, np.asarray(ids, dtype=np.intp), points),
        triangulation.epipolar_distances(cameras, pixels),
    )


def spacing_errors(target: Target, ids: Indices, points: Array) -> Array:
    """Return the errors (M,) of triangulated distances between neighbours on a target, metres.

    ``ids`` (N,): numbers of points on the target. ``points`` (N, 3): their places in space, metres;
    points that are NaN are left out.
    """
    is_finite = np.isfinite(points).all(axis=1)
    true_points, points = target.points[ids[is_finite]], points[is_finite]
    if len(true_points) < 2:
        return np.zeros(0)
    spacing = np.linalg.norm(target.points - target.points[0], axis=1)[1:].min()
    tree = load("scipy.spatial").cKDTree(true_points)
    first, second = tree.query_pairs(NEIGHBOUR_DISTANCE_RATIO * spacing, output_type="ndarray").T
    true_distances = np.linalg.norm(true_points[first] - true_points[second], axis=1)
    errors: Array = np.linalg.norm(points[first] - points[second], axis=1) - true_distances
    return errors
