"""Least squares with many poses, each of which concerns its own views alone.

The unknowns are those that all residuals share (lenses, a rig, where a camera is on a robot), and
six or none for each pose. The matrix of the normal equations is an arrow then: a block for what is
shared, a small block for each pose, and what lies between the two; poses have nothing to do with
each other. So poses are eliminated before what is shared is solved, and time grows with their
number, not with its cube.

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
"""Part of the diagonal that is added to it; with the most of it no step is large enough to gain."""

RANK = 1e-14
"""Singular values of a matrix with a unit diagonal are rounding below this part of the largest."""

RANK_OF_COVARIANCE = 1e-12
"""Eigenvalues of a covariance with a unit diagonal are rounding below this part of the largest."""

MAX_UNKNOWNS_BY_SVD = 60
"""Unknowns, beyond which singular values cost too much time to be looked at first."""


class Normal(NamedTuple):
    """Normal equations ``J^T J x = J^T r`` of residuals r = measured - modelled."""

    cost: float  # sum of the squared residuals; infinite where there is no model
    shared: Array  # (S, S), J^T J of the shared unknowns
    shared_right: Array  # (S,), J^T r of them
    own: Array  # (P, K, K), J^T J of each pose's K unknowns; 0 where nothing moves a pose
    own_right: Array  # (P, K), J^T r of them
    mixed: Array  # (P, K, S), J^T J between a pose's unknowns and the shared ones

    @classmethod
    def nothing(cls, shared: int, poses: int, own: int) -> Normal:
        """Return the equations of no residuals."""
        return cls(
            0.0,
            np.zeros((shared, shared)),
            np.zeros(shared),
            np.zeros((poses, own, own)),
            np.zeros((poses, own)),
            np.zeros((poses, own, shared)),
        )

    def reduced(self, damping: float = 0.0) -> tuple[Array, Array, Array, Array]:
        """Return the shared unknowns' matrix and right side, and what gives the poses back.

        Matrix (S, S) and right side (S,), then (P, K, S) and (P, K): a pose's change is the last
        less the one before it times the shared change. ``damping``: part of the diagonal that is
        added to it.
        """
        # Schur's complement. Of the equations
        #     A x + sum_p B_p^T y_p = a      (shared)
        #     B_p x + C_p y_p       = b_p    (pose p)
        # the second gives y_p = C_p^-1 b_p - C_p^-1 B_p x, and with that the first
        #     (A - sum_p B_p^T C_p^-1 B_p) x = a - sum_p B_p^T C_p^-1 b_p.
        # Damping is Marquardt's: A + damping diag(A), which the units of unknowns do not matter to.
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

        They are NaN where ``cost`` is infinite.
        """
        if not math.isfinite(self.cost):
            return np.full_like(self.shared, np.nan), np.full_like(self.own, np.nan)
        # With residuals of variance 1 the covariance is the inverse of J^T J. Its upper left block
        # is that of Schur's complement, S^-1; those of the poses are C_p^-1 + D_p S^-1 D_p^T, with
        # D_p = C_p^-1 B_p: their own, and what the shared unknowns' errors do to them.
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

    Levenberg's and Marquardt's method: a step that gains makes the damping ten times smaller, one
    that does not is taken back and makes it ten times larger.

    ``moved`` gives what the changes of the shared unknowns (S,) and of the poses (P, K) lead to; a
    :class:`CalibrationError` says that they lead nowhere. ``gain``: part of the cost that a step
    must gain, else it was the last; ``noise`` is added to the cost there: exact samples leave only
    rounding errors to gain. ``damping``: part of the diagonal that is added to it at first; little
    where it begins near. The best that was found is returned; its cost is infinite where it is so
    from the beginning.
    """
    normal = evaluate(at)
    for _ in range(MAX_STEPS):
        if not math.isfinite(normal.cost):
            break
        try:
            tried = moved(at, *normal.step(damping))
            after = evaluate(tried)
        except CalibrationError:
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
    """Return by what rows and columns of a positive matrix are divided to make its diagonal 1."""
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
    """Return independent vectors (K, S) of one standard deviation, whose squares add up to it."""
    scale = unit_diagonal(covariance)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = values > RANK_OF_COVARIANCE * values.max(initial=0.0)
    parts: Array = (vectors[:, kept] * np.sqrt(values[kept])).T * scale
    return parts
