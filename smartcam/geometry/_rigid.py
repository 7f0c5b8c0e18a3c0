"""Compute with arrays of rigid motions: compose, invert, apply small steps, compare.

A motion is ``p' = R p + t``. Rotations are matrices, since points are multiplied with them;
their exponential and logarithm are those of SciPy's ``Rotation``.

A small step ``(w, d)`` is a rotation vector and a shift. The shift is always added to ``t``, along
the axes of the target frame. The turn is multiplied to R from the left or from the right:
``exp([w]x) R`` turns about the target frame's axes, ``R exp([w]x)`` about the source frame's axes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam._extras import load

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from smartcam.geometry._rotations import Array

    Index = NDArray[np.intp] | Sequence[int] | slice | int

SMALL_ANGLE = 1e-4
"""Angle, radians, below which the first term of a series replaces a formula; the error is 1e-9."""


class Rigid(NamedTuple):
    """Rigid motions, one or many.

    Attributes:
        rotation: (..., 3, 3).
        translation: (..., 3), metres.
    """

    rotation: Array
    translation: Array

    @classmethod
    def stack(cls, motions: Iterable[Rigid]) -> Rigid:
        """Return single motions as one array."""
        rows = list(motions)
        rotations = np.array([row.rotation for row in rows], dtype=np.float64)
        translations = np.array([row.translation for row in rows], dtype=np.float64)
        return cls(rotations.reshape(-1, 3, 3), translations.reshape(-1, 3))

    @property
    def size(self) -> int:
        """Number of motions in an array (N, ...)."""
        return len(self.translation)

    def __matmul__(self, other: Rigid) -> Rigid:
        """Return the motion ``other`` followed by this motion."""
        # R1 (R2 p + t2) + t1 = (R1 R2) p + (R1 t2 + t1)
        turned = (self.rotation @ other.translation[..., None])[..., 0]
        return Rigid(self.rotation @ other.rotation, turned + self.translation)

    def inverse(self) -> Rigid:
        """Return the inverse motions."""
        # p' = R p + t  <=>  p = R^T p' - R^T t
        transposed = np.swapaxes(self.rotation, -1, -2)
        return Rigid(transposed, -(transposed @ self.translation[..., None])[..., 0])

    def apply(self, points: Array) -> Array:
        """Return the moved points (..., N, 3)."""
        moved: Array = points @ np.swapaxes(self.rotation, -1, -2) + self.translation[..., None, :]
        return moved

    def subset(self, index: Index) -> Rigid:
        """Return the motions at an index, a slice, a mask or an array of indices."""
        return Rigid(self.rotation[index], self.translation[index])

    def scaled(self, scale: float) -> Rigid:
        """Return the motions with their translations scaled."""
        return Rigid(self.rotation, scale * self.translation)

    def turned_in_source(self, step: Array) -> Rigid:
        """Return the motions after small steps (..., 6) that turn about their source's axes."""
        return Rigid(self.rotation @ exp_rotation(step[..., :3]), self.translation + step[..., 3:])

    def turned_in_target(self, step: Array) -> Rigid:
        """Return the motions after small steps (..., 6) that turn about their target's axes."""
        return Rigid(exp_rotation(step[..., :3]) @ self.rotation, self.translation + step[..., 3:])

    def source_steps_to(self, other: Rigid) -> Array:
        """Return the steps (..., 6) with which :meth:`turned_in_source` gives the other motions."""
        turn = log_rotation(np.swapaxes(self.rotation, -1, -2) @ other.rotation)
        return np.concatenate([turn, other.translation - self.translation], axis=-1)

    def target_steps_to(self, other: Rigid) -> Array:
        """Return the steps (..., 6) with which :meth:`turned_in_target` gives the other motions."""
        turn = log_rotation(other.rotation @ np.swapaxes(self.rotation, -1, -2))
        return np.concatenate([turn, other.translation - self.translation], axis=-1)

    def angle_to(self, other: Rigid) -> Array:
        """Return the angles (...) between the rotations of these and other motions, radians."""
        angles: Array = np.linalg.norm(self.source_steps_to(other)[..., :3], axis=-1)
        return angles


IDENTITY = Rigid(np.eye(3), np.zeros(3))
"""The motion that moves nothing."""


def cross_matrix(vectors: Array) -> Array:
    """Return the matrices (..., 3, 3) with ``matrix @ v = cross(vector, v)``, written ``[w]x``."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    rows = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])
    return np.moveaxis(rows, (0, 1), (-2, -1))


def exp_rotation(vectors: Array) -> Array:
    """Return the rotations (..., 3, 3) about vectors (..., 3) by their lengths, radians."""
    # Rodrigues: exp([w]x) = I + sin(a)/a [w]x + (1 - cos(a))/a^2 [w]x^2, a = |w|.
    if not vectors.size:  # SciPy before 1.13 refuses empty arrays
        return np.zeros((*vectors.shape, 3))
    turns = load("scipy.spatial.transform").Rotation.from_rotvec(vectors.reshape(-1, 3))
    rotations: Array = turns.as_matrix().reshape(*vectors.shape, 3)
    return rotations


def log_rotation(rotations: Array) -> Array:
    """Return the rotation vectors (..., 3) of rotations (..., 3, 3), of length pi at most."""
    if not rotations.size:  # SciPy before 1.13 refuses empty arrays
        return np.zeros(rotations.shape[:-1])
    turns = load("scipy.spatial.transform").Rotation.from_matrix(rotations.reshape(-1, 3, 3))
    vectors: Array = turns.as_rotvec().reshape(rotations.shape[:-1])
    return vectors


def right_jacobian(vectors: Array) -> Array:
    """Return J (..., 3, 3) with ``exp(v + d) = exp(v) exp(J d)`` for small d."""
    # J(v) = I - (1 - cos(a))/a^2 [v]x + (a - sin(a))/a^3 [v]x^2, a = |v|.
    # Its inverse is the derivative of log(R exp([d]x)) by d, at d = 0 and v = log(R).
    # Source: Sola, Deray and Atchuthan, A micro Lie theory for state estimation in robotics
    # (arXiv 1812.01537), appendix B.
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    safe_angle = np.where(angle < SMALL_ANGLE, 1.0, angle)
    first = np.where(angle < SMALL_ANGLE, 0.5, (1.0 - np.cos(safe_angle)) / safe_angle**2)
    second = np.where(
        angle < SMALL_ANGLE, 1.0 / 6.0, (safe_angle - np.sin(safe_angle)) / safe_angle**3
    )
    cross = cross_matrix(vectors)
    jacobian: Array = np.eye(3) - first * cross + second * (cross @ cross)
    return jacobian
