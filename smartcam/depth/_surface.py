"""Fit a plane around each point of a cloud, and find the motions that planes do not determine."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._extras import load

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

POINTS_AT_A_TIME: Final = 1 << 15
"""Number of points whose neighbours are in memory at a time."""

MIN_INFORMATION_FACTOR: Final = 12.0
"""Least ratio of a direction's information to the information from the normals' noise alone.

On simulated clouds the ratio is 0.8 to 1.4 for the free directions of planes, edges and corridors,
up to 11 for the free directions of cylinders and spheres, and 29 or more in a corner.
"""


class SurfacePlanes(NamedTuple):
    """Planes fitted around points.

    Attributes:
        normals: (N, 3), of length 1.
        along: (N, 3, 2), two directions in each plane.
        tilts: (N, 2), variances of the normal's turn towards each of ``along``, radians squared.
    """

    normals: Array
    along: Array
    tilts: Array

    def subset(self, index: Any) -> SurfacePlanes:
        """Return the planes that an index selects."""
        return SurfacePlanes(*(column[index] for column in self))


def fit_planes(points: Array, tree: Any, neighbours: int, index: NDArray[np.intp]) -> SurfacePlanes:
    """Fit a plane through each point that an index selects, and its nearest points.

    ``tree``: search tree of all points.
    """
    planes = []
    for start in range(0, len(index), POINTS_AT_A_TIME):
        _, nearest = tree.query(points[index[start : start + POINTS_AT_A_TIME]], k=neighbours)
        planes.append(_fit_groups(points[nearest]))
    return SurfacePlanes(*(np.concatenate(parts) for parts in zip(*planes, strict=True)))


def _fit_groups(groups: Array) -> SurfacePlanes:
    """Fit planes through groups (N, K, 3) of points."""
    offsets = groups - groups.mean(axis=1, keepdims=True)
    spreads = offsets.transpose(0, 2, 1) @ offsets / groups.shape[1]
    values, vectors = np.linalg.eigh(spreads)
    # Noise turns an eigenvector towards another with variance l0 l1 / (K (l1 - l0)^2).
    # Source: Anderson, Asymptotic theory for principal component analysis (1963).
    squared_gaps = np.maximum((values[:, 1:] - values[:, :1]) ** 2, np.finfo(float).tiny)
    tilts = values[:, :1] * values[:, 1:] / (groups.shape[1] * squared_gaps)
    return SurfacePlanes(vectors[:, :, 0], vectors[:, :, 1:], np.clip(tilts, 0.0, 1.0))


def displacement_jacobian(arms: Array, directions: Array) -> Array:
    """Return the derivatives (N, 6) of displacements along directions (N, 3) by turn and shift.

    ``arms`` (N, 3): vectors to the points from the centre of the turn.
    """
    return np.concatenate([np.cross(arms, directions), directions], axis=1)


def undetermined_steps(arms: Array, planes: SurfacePlanes) -> Array:
    """Return the steps (K, 6), turn in radians and shift in metres, that planes do not determine.

    ``arms`` (N, 3): vectors to the points on the planes from their centre, about which the steps
    turn. Each step moves the points by one metre on average.
    """
    reach = float(np.sqrt((arms**2).sum(axis=1).mean())) or 1.0
    scaled = arms / reach
    rows = displacement_jacobian(scaled, planes.normals)
    information = rows.T @ rows
    noise = np.zeros((6, 6))
    for axis in range(2):
        part = displacement_jacobian(scaled, planes.along[:, :, axis]) * np.sqrt(
            planes.tilts[:, axis, None]
        )
        noise += part.T @ part
    # Rounding to float32 is noise, too: without it, a flat cloud would have no tilts.
    noise += 1e-7 * np.trace(information) * np.eye(6)
    ratios, steps = load("scipy.linalg").eigh(information, noise)
    basis, _ = np.linalg.qr(steps[:, ratios < MIN_INFORMATION_FACTOR])
    # Any combination of undetermined steps is undetermined: return turns first, then pure shifts.
    turn_basis, _, _ = np.linalg.svd(basis.T[:, :3])
    undetermined: Array = (turn_basis.T @ basis.T) / np.array([reach] * 3 + [1.0] * 3)
    return undetermined
