"""Solve least squares with many poses, each of which affects its own views only.

The unknowns are those that all residuals share (lenses, a rig, the place of a camera on a robot),
and six or none for each pose. The matrix of the normal equations then has the form of an arrow: a
block for the shared unknowns, a small block for each pose, and blocks between the two, but none
between poses. So the poses are eliminated before the shared unknowns are solved, and the time grows
with the number of poses, not with its cube.

Source: Triggs, McLauchlan, Hartley and Fitzgibbon, Bundle Adjustment - A Modern Synthesis (2000),
section 6; Hartley and Zisserman, Multiple View Geometry, 2nd edition, appendix 6.
"""

from __future__ import annotations

import contextlib
import math
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.geometry._inside import Array

T = TypeVar("T")

MAX_STEPS = 100
"""A fit takes at most this many steps; from a linear solution it takes about ten."""

MIN_DAMPING, MAX_DAMPING = 1e-9, 1e12
"""Least and largest part of the diagonal that is added to it; with the largest no step is long
enough to gain anything."""

RANK = 1e-14
"""In a matrix with a unit diagonal, singular values below this part of the largest are rounding
errors."""

RANK_OF_COVARIANCE = 1e-12
"""In a covariance with a unit diagonal, eigenvalues below this part of the largest are rounding
errors."""

MAX_UNKNOWNS_BY_SVD = 60
"""With more unknowns than this, computing singular values first would take too much time."""


class Normal(NamedTuple):
    """Normal equations ``J^T J x = J^T r`` of residuals r = measured - modelled."""

    cost: float  # sum of the squared residuals; infinite where there is no model
    shared: Array  # (S, S), J^T J of the shared unknowns
    shared_right: Array  # (S,), J^T r of the shared unknowns
    own: Array  # (P, K, K), J^T J of each pose's K unknowns; 0 for a pose that has no observation
    own_right: Array  # (P, K), J^T r of each pose's unknowns
    mixed: Array  # (P, K, S), J^T J between a pose's unknowns and the shared ones

    @classmethod
    def nothing(cls, shared: int, poses: int, per_pose: int) -> Normal:
        """Return the equations of no residuals."""
        return cls(
            0.0,
            np.zeros((shared, shared)),
            np.zeros(shared),
            np.zeros((poses, per_pose, per_pose)),
            np.zeros((poses, per_pose)),
            np.zeros((poses, per_pose, shared)),
        )

    def reduced(self, damping: float = 0.0) -> tuple[Array, Array, Array, Array]:
        """Eliminate the poses; return the shared equations, and the factors that give the poses.

        The result is a matrix (S, S) and a right side (S,), then (P, K, S) and (P, K): the change
        of a pose is the last minus the third times the shared change. ``damping``: part of the
        diagonal that is added to it.
        """
        # Schur's complement. Of the equations
        #     A x + sum_p B_p^T y_p = a      (shared)
        #     B_p x + C_p y_p       = b_p    (pose p)
        # the second gives y_p = C_p^-1 b_p - C_p^-1 B_p x, and with that the first
        #     (A - sum_p B_p^T C_p^-1 B_p) x = a - sum_p B_p^T C_p^-1 b_p.
        # Damping is Marquardt's: A + damping diag(A), which does not depend on the unknowns' units.
        # Source: Marquardt, An Algorithm for Least-Squares Estimation of Nonlinear Parameters
        # (1963); Triggs et al., section 6.1.
        grown = self.own + damping * self.own * np.eye(self.own.shape[-1])
        both = np.concatenate([self.mixed, self.own_right[..., None]], axis=2)
        solved = np.asarray(np.linalg.solve(grown, both), dtype=np.float64)
        complement = np.tensordot(self.mixed, solved, axes=((0, 1), (0, 1)))
        matrix = self.shared + damping * np.diag(np.diag(self.shared)) - complement[:, :-1]
        return matrix, self.shared_right - complement[:, -1], solved[..., :-1], solved[..., -1]

    def step(self, damping: float) -> tuple[Array, Array]:
        """Return the changes of the shared unknowns (S,) and of the poses (P, K)."""
        matrix, right, by_shared, alone = self.reduced(damping)
        shared = solve_scaled(matrix, right)
        return shared, alone - by_shared @ shared

    def covariance(self) -> tuple[Array, Array]:
        """Return the covariances of the shared unknowns (S, S) and of each pose (P, K, K).

        They are NaN if ``cost`` is infinite.
        """
        if not math.isfinite(self.cost):
            return np.full_like(self.shared, np.nan), np.full_like(self.own, np.nan)
        # With residuals of variance 1 the covariance is the inverse of J^T J. Its upper left block
        # is that of Schur's complement, S^-1; those of the poses are C_p^-1 + D_p S^-1 D_p^T, with
        # D_p = C_p^-1 B_p: their own part, and that of the shared unknowns' errors.
        # Source: Hartley and Zisserman, section 5.2 and appendix 6.
        matrix, _, by_shared, _ = self.reduced()
        shared = inverse_scaled(matrix)
        return shared, np.linalg.inv(self.own) + by_shared @ shared @ by_shared.swapaxes(1, 2)


def minimize(
    at: T,
    evaluate: Callable[[T], Normal],
    moved: Callable[[T, Array, Array], T],
    *,
    gain: float,
    noise: float = 0.0,
    damping: float = 1e-4,
) -> tuple[T, Normal]:
    """Minimise the sum of squares; return the solution and the normal equations there.

    Levenberg's and Marquardt's method: a step that lowers the sum makes the damping ten times
    smaller; any other is taken back and makes it ten times larger.

    ``moved`` returns the solution changed by steps of the shared unknowns (S,) and of the poses (P,
    K); it raises :class:`CalibrationError` if the steps lead to no valid one. A step that lowers
    the cost by less than the part ``gain`` of it is the last; for this comparison ``noise`` is
    added to the cost, since exact samples leave only rounding errors to gain. ``damping`` is the
    part of the diagonal that is added to it at first; it may be small if the start is near. The
    best solution found is returned; its cost is infinite if that of the start is.
    """
    normal = evaluate(at)
    for _ in range(MAX_STEPS):
        if not math.isfinite(normal.cost):
            break
        try:
            tried = moved(at, *normal.step(damping))
            after = evaluate(tried)
        except (CalibrationError, np.linalg.LinAlgError):
            tried, after = at, normal._replace(cost=math.inf)
        gained, least = normal.cost - after.cost, gain * (normal.cost + noise)
        if gained < 0:
            if damping >= MAX_DAMPING or -gained <= least:
                break
            damping = max(10.0 * damping, 1e-6)
            continue
        at, normal = tried, after
        damping = max(damping / 10.0, MIN_DAMPING)
        if gained <= least:
            break
    return at, normal


def unit_diagonal(matrix: Array) -> Array:
    """Return the divisors of a positive matrix' rows and columns that make its diagonal 1."""
    # Pixels, radians and metres differ by orders of magnitude; with D = diag(A)^(1/2) the condition
    # of D^-1 A D^-1 is near the least that any diagonal scaling gives.
    # Source: van der Sluis, Condition numbers and equilibration of matrices (1969).
    diagonal = np.diag(matrix)
    scale: Array = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    return scale


def solve_scaled(matrix: Array, right: Array) -> Array:
    """Return the solution (S, ...) of positive equations whose unknowns have several units."""
    if not len(matrix):
        return right
    scale = unit_diagonal(matrix)
    by_row = scale.reshape(-1, *[1] * (right.ndim - 1))
    scaled = matrix / np.outer(scale, scale)
    if len(matrix) > MAX_UNKNOWNS_BY_SVD:
        with contextlib.suppress(np.linalg.LinAlgError):
            return np.asarray(np.linalg.solve(scaled, right / by_row) / by_row, dtype=np.float64)
    solution: Array = np.linalg.lstsq(scaled, right / by_row, rcond=RANK)[0] / by_row
    return solution


def inverse_scaled(matrix: Array) -> Array:
    """Return the pseudoinverse (S, S) of a positive matrix whose unknowns have several units."""
    scale = unit_diagonal(matrix)
    outer = np.outer(scale, scale)
    inverse = np.linalg.pinv(matrix / outer, rcond=RANK, hermitian=True)
    return np.asarray(inverse / outer, dtype=np.float64)


def independent_parts(covariance: Array) -> Array:
    """Return independent vectors (K, S) whose outer products add up to a covariance."""
    scale = unit_diagonal(covariance)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    significant = values > RANK_OF_COVARIANCE * values.max(initial=0.0)
    parts: Array = (vectors[:, significant] * np.sqrt(values[significant])).T * scale
    return parts
