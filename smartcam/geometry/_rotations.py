"""Compute with arrays of rotations, quaternions and points, and check such arguments.

Right-handed, metres, radians. Quaternions are Hamilton's of unit length with the real part last,
arrays of shape (..., 4) in the order x, y, z, w. ``R_a_b`` turns coordinates of b into coordinates
of a.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from smartcam.geometry._codes import Code

if TYPE_CHECKING:
    from smartcam.exceptions import CalibrationError

Array: TypeAlias = NDArray[np.float64]
"""A float64 array; each function names its shape."""

MIN_SINE = 0.17
"""Sine of the least angle between two axes that span a plane: 10 degrees.

An error of 0.5 mm in height tilts the plane's normal by 2.2 degrees if the axes are 5 degrees
apart, and by 10.8 degrees if they are 1 degree apart.
"""

MAX_COORDINATE = 1e100
"""Largest accepted coordinate; a product of three such coordinates is still finite."""


def as_points(values: ArrayLike, columns: int, label: str) -> Array:
    """Return ``values`` as float64 of shape (N, ``columns``); raise SHAPE or NOT_FINITE.

    ``label`` names the points in the error's text.
    """
    try:
        if np.iscomplexobj(values):
            raise TypeError("got complex numbers")
        points = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, ArithmeticError) as exc:
        raise Code.SHAPE.error(
            f"{label}: expected numbers of shape (N, {columns}): {exc!s:.200}", f"(N, {columns})"
        ) from exc
    if points.ndim != 2 or points.shape[1] != columns:
        raise Code.SHAPE.error_with_value(
            f"{label}: expected shape (N, {columns})", f"(N, {columns})", points.shape
        )
    if not np.isfinite(points).all():
        row = int(np.argmin(np.isfinite(points).all(axis=1)))
        raise Code.NOT_FINITE.error(
            f"{label}: expected finite numbers, got {points[row].tolist()} in row {row}",
            "finite numbers",
            points[row].tolist(),
        )
    if points.size and not np.abs(points).max() <= MAX_COORDINATE:
        raise Code.NOT_FINITE.error(
            f"{label}: expected numbers up to {MAX_COORDINATE:g}, got {np.abs(points).max():g}",
            MAX_COORDINATE,
            float(np.abs(points).max()),
        )
    return points


def as_vector(values: ArrayLike, length: int, label: str) -> Array:
    """Return ``values`` as float64 of shape (``length``,); raise SHAPE or NOT_FINITE."""
    rows: Any = [values]
    vector: Array = as_points(rows, length, label)[0]
    return vector


def check_finite(values: Array, label: str) -> None:
    """Raise NOT_FINITE if a calibration's result is not finite; ``label`` names this result."""
    if not np.isfinite(values).all():
        row = int(np.argmin(np.isfinite(values).reshape(len(values), -1).all(axis=1)))
        raise not_finite_error(label, np.atleast_1d(values[row]).tolist())


def not_finite_error(label: str, actual: object) -> CalibrationError:
    """Return the error for a calibration's result that is not finite."""
    return Code.NOT_FINITE.error(
        f"{label}: expected finite numbers, the calibration gives {actual}: it is damaged, or this "
        "is far outside of what it was made for",
        "finite numbers",
        actual,
    )


def rotate_ccw(points: ArrayLike, angle: float) -> Array:
    """Return points (..., 2) turned counter-clockwise by ``angle`` where y is up."""
    sin, cos = math.sin(angle), math.cos(angle)
    turned: Array = np.asarray(points, dtype=np.float64) @ np.array([[cos, sin], [-sin, cos]])
    return turned


def quaternion_about_z(angle: ArrayLike) -> Array:
    """Return the turns by ``angle`` (...) about z, (..., 4)."""
    half = 0.5 * np.asarray(angle, dtype=np.float64)
    zero = np.zeros_like(half)
    return np.stack([zero, zero, np.sin(half), np.cos(half)], axis=-1)


def quaternion_multiply(first: ArrayLike, second: ArrayLike) -> Array:
    """Return Hamilton's product (..., 4): the turn ``second`` followed by ``first``."""
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    va, wa, vb, wb = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    # (v, w) (v', w') = (w v' + w' v + v x v', w w' - v . v')
    # Source: Hamilton; Diebel, Representing Attitude (2006), on quaternion multiplication, with the
    # real part first there.
    vector = wa * vb + wb * va + np.cross(va, vb)
    real = wa * wb - np.sum(va * vb, axis=-1, keepdims=True)
    return np.concatenate([vector, real], axis=-1)


def rotate(quaternion: ArrayLike, vectors: ArrayLike) -> Array:
    """Return vectors (..., 3) turned by unit quaternions (..., 4); the zero vector stays zero."""
    q, v = np.asarray(quaternion, dtype=np.float64), np.asarray(vectors, dtype=np.float64)
    # q v q^-1, multiplied out: v + 2 w (u x v) + 2 u x (u x v), where q = (u, w) has length 1.
    doubled_cross = 2.0 * np.cross(q[..., :3], v)
    return v + q[..., 3:] * doubled_cross + np.cross(q[..., :3], doubled_cross)


def matrix_from_quaternion(quaternion: ArrayLike) -> Array:
    """Return the matrices (..., 3, 3) of unit quaternions (..., 4)."""
    q = np.asarray(quaternion, dtype=np.float64)
    columns = [rotate(q, np.broadcast_to(axis, (*q.shape[:-1], 3))) for axis in np.eye(3)]
    return np.stack(columns, axis=-1)


def quaternion_from_matrix(matrix: ArrayLike) -> Array:
    """Return the unit quaternions (..., 4) of rotation matrices (..., 3, 3).

    The largest element of the quaternion is positive.
    """
    rows = np.moveaxis(np.asarray(matrix, dtype=np.float64), (-2, -1), (0, 1))
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rows
    # Four times q q^T: each column is a multiple of q. The column of q's largest element is never
    # short, so no root of a small difference is taken.
    # Source: Markley, Unit Quaternion from Rotation Matrix (2008); Shepperd, Quaternion from
    # Rotation Matrix (1978).
    scaled_products = [
        [1 + xx - yy - zz, xy + yx, xz + zx, zy - yz],
        [xy + yx, 1 - xx + yy - zz, yz + zy, xz - zx],
        [xz + zx, yz + zy, 1 - xx - yy + zz, yx - xy],
        [zy - yz, xz - zx, yx - xy, 1 + xx + yy + zz],
    ]
    products = np.moveaxis(np.array(scaled_products), (0, 1), (-2, -1))
    diagonal = np.diagonal(products, axis1=-2, axis2=-1)
    largest = np.argmax(diagonal, axis=-1)[..., None, None]
    longest_column = np.take_along_axis(products, largest, axis=-2)[..., 0, :]
    quaternion: Array = longest_column / np.linalg.norm(longest_column, axis=-1, keepdims=True)
    return quaternion


def frame_from_axes(x: ArrayLike, y: ArrayLike) -> Array:
    """Return the rotation (3, 3) with the columns x, n cross x, n, where n is along x cross y.

    ``x`` and ``y`` (3,) have any length; ``y`` need not be at a right angle to ``x``. Raises
    COINCIDENT: a vector has length 0; COLLINEAR: they are less than 10 degrees apart.
    """
    first, second = as_vector(x, 3, "first axis"), as_vector(y, 3, "second axis")
    lengths = np.linalg.norm(first), np.linalg.norm(second)
    if not all(lengths):
        raise Code.COINCIDENT.error(
            "axes of a plane: expected two directions, got a vector of length 0",
            "two directions",
            min(map(float, lengths)),
        )
    # Gram and Schmidt: x stays, n = x cross y over its length, which is the sine of the angle
    # between them, and the second axis is n cross x.
    first, second = first / lengths[0], second / lengths[1]
    normal = np.cross(first, second)
    sine = float(np.linalg.norm(normal))
    if sine < MIN_SINE:
        raise Code.COLLINEAR.error(
            f"axes of a plane: expected at least 10 degrees between them, "
            f"got {math.degrees(math.asin(sine)):.2g}",
            MIN_SINE,
            sine,
        )
    normal /= sine
    return np.stack([first, np.cross(normal, first), normal], axis=-1)
