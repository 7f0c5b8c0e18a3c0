"""Map points (x, y) of a plane as a camera without distortion does.

A point p is mapped by ``w (p, 1) = matrix (x, y, 1)``. The matrix is (3, 3) if the results are
points in a plane, and (4, 3) if they are points in space.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from smartcam._extras import load

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.geometry._inside import Array


def fit_homography(flat: Array, pixels: Array) -> Array | None:
    """Return the (3, 3) matrix from points of a plane to pixels; None if no matrix fits.

    Four points or more are needed: ``flat`` (N, 2), metres, and ``pixels`` (N, 2).
    """
    # Each pair of a point x and its pixel (u, v) gives two linear equations of the nine elements,
    # u (h3 x) = h1 x and v (h3 x) = h2 x. The singular vector of the least singular value, for
    # normalised points, is the start of a least-squares refinement of the distances in pixels.
    # Source: Hartley and Zisserman, Multiple View Geometry, 2nd edition, sections 4.1 and 4.4.4.
    cv2 = load("cv2")
    matrix = cv2.findHomography(flat, pixels)[0]
    return None if matrix is None else np.array(matrix, dtype=np.float64)


def apply_homography(matrix: Array, points: Array) -> Array:
    """Map points (N, 2) to (N, 2) or (N, 3); infinite or NaN for one on the horizon."""
    mapped = points @ matrix[:, :2].T + matrix[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        projected: Array = mapped[:, :-1] / mapped[:, -1:]
    return projected


def derivatives(matrix: Array, points: Array) -> Array:
    """Return the derivatives of mapped points by u and v, (N, 2, 2) or (N, 3, 2).

    With ``p = q / w`` the derivative is ``dp = (dq - p dw) / w``.
    """
    projected = apply_homography(matrix, points)
    depth = points @ matrix[-1, :2] + matrix[-1, 2]
    slopes: Array = (matrix[:-1, :2] - projected[:, :, None] * matrix[-1, :2]) / depth[
        :, None, None
    ]
    return slopes


def element_derivatives(matrix: Array, points: Array) -> Array:
    """Return the derivatives of mapped points by the matrix' elements, (N, 2, 9) or (N, 3, 12).

    They are ``dp = (dq - p dw) / w``, as in :func:`derivatives`; an element changes ``q`` or ``w``,
    whichever its row computes, by ``(u, v, 1)``.
    """
    homogeneous = np.column_stack([points, np.ones(len(points))])
    scaled = homogeneous / (homogeneous @ matrix[-1])[:, None]
    size = len(matrix) - 1
    result = np.zeros((len(points), size, size + 1, 3))
    for axis in range(size):
        result[:, axis, axis] = scaled
    result[:, :, size] = -apply_homography(matrix, points)[:, :, None] * scaled[:, None, :]
    return result.reshape(len(points), size, 3 * (size + 1))


def tangent_frames(slopes: Array, directions: Array) -> Array:
    """Return rotations (N, 3, 3) with a plane's normal as z and a direction of the camera as x.

    ``slopes`` (N, 3, 2): the derivatives of the mapped point at each place, or multiples of these.
    ``directions`` (N, 2): in the camera's coordinates.
    """
    first = np.einsum("nij,nj->ni", slopes, directions)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    normals = np.cross(slopes[:, :, 0], slopes[:, :, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first), normals], axis=-1)


def local_steps(project: Callable[[Array], Array], points: Array, step: float) -> Array:
    """Return the image vectors of ``step`` along x and along y, (N, 2, 2), pixels.

    ``project`` maps points (N, 2) of the plane to pixels; ``step`` is in the plane's unit.
    """
    steps = [(project(points + shift) - project(points - shift)) / 2 for shift in step * np.eye(2)]
    return np.stack(steps, axis=1)
