"""Solve least squares with many poses, where each pose affects only its own views.

There are unknowns that all residuals share (lenses, a rig, the place of a camera on a robot), and
six or no unknowns of each pose. The matrix of the normal equations then has the form of an arrow: a
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
"""Least and largest part of the diagonal that is added to the diagonal; with the largest, no step
is long enough to gain anything."""

RANK_TOLERANCE = 1e-14
"""In a matrix with a unit diagonal, singular values below this fraction of the largest are rounding
errors."""

COVARIANCE_RANK_TOLERANCE = 1e-12
"""In a covariance with a unit diagonal, eigenvalues below this fraction of the largest are rounding
errors."""

MAX_UNKNOWNS_BY_SVD = 60
"""Equations of more unknowns than this are solved without a singular value decomposition, which
would take too much time."""


class NormalEquations(NamedTuple):
    """Normal equations ``J^T J x = J^T r`` of residuals r = measured - modelled."""

    cost: float  # sum of the squared residuals; infinite where there is no model
    shared: Array  # (S, S), J^T J of the shared unknowns
    shared_right_side: Array  # (S,), J^T r of the shared unknowns
    # (P, K, K), J^T J of each pose's K unknowns; 0 for a pose that has no observation
    pose_blocks: Array
    pose_right_sides: Array  # (P, K), J^T r of each pose's unknowns
    coupling: Array  # (P, K, S), J^T J between a pose's unknowns and the shared ones

    @classmethod
    def zeros(cls, shared_count: int, pose_count: int, unknowns_per_pose: int) -> NormalEquations:
        """Return equations to which no residuals were added yet."""
        return cls(
            0.0,
            np.zeros((shared_count, shared_count)),
            np.zeros(shared_count),
            np.zeros((pose_count, unknowns_per_pose, unknowns_per_pose)),
            np.zeros((pose_count, unknowns_per_pose)),
            np.zeros((pose_count, unknowns_per_pose, shared_count)),
        )

    def eliminate_poses(self, damping: float = 0.0) -> tuple[Array, Array, Array, Array]:
        """Eliminate the poses; return the shared equations, and what gives the poses' changes.

        The result is the matrix (S, S) and the right side (S,) of the shared equations, then a
        matrix M (P, K, S) and a vector v (P, K): the poses change by v - M x if the shared unknowns
        change by x. ``damping``: part of the diagonal that is added to the diagonal.
        """
        # Schur's complement. Of the equations
        #     A x + sum_p B_p^T y_p = a      (shared)
        #     B_p x + C_p y_p       = b_p    (pose p)
        # the second gives y_p = C_p^-1 b_p - C_p^-1 B_p x, and with that the first
        #     (A - sum_p B_p^T C_p^-1 B_p) x = a - sum_p B_p^T C_p^-1 b_p.
        # Damping is Marquardt's: A + damping diag(A), which does not depend on the unknowns' units.
        # Source: Marquardt, An Algorithm for Least-Squares Estimation of Nonlinear Parameters
        # (1963); Triggs et al., section 6.1.
        damped = self.pose_blocks + damping * self.pose_blocks * np.eye(self.pose_blocks.shape[-1])
        right_sides = np.concatenate([self.coupling, self.pose_right_sides[..., None]], axis=2)
        solved = np.asarray(np.linalg.solve(damped, right_sides), dtype=np.float64)
        complement = np.tensordot(self.coupling, solved, axes=((0, 1), (0, 1)))
        matrix = self.shared + damping * np.diag(np.diag(self.shared)) - complement[:, :-1]
        return matrix, self.shared_right_side - complement[:, -1], solved[..., :-1], solved[..., -1]

    def step(self, damping: float) -> tuple[Array, Array]:
        """Return the changes of the shared unknowns (S,) and of the poses (P, K)."""
        matrix, right, pose_by_shared, pose_constant = self.eliminate_poses(damping)
        shared = solve_scaled(matrix, right)
        return shared, pose_constant - pose_by_shared @ shared

    def covariance(self) -> tuple[Array, Array]:
        """Return the covariances of the shared unknowns (S, S) and of each pose (P, K, K).

        They are NaN if ``cost`` is infinite.
        """
        if not math.isfinite(self.cost):
            return np.full_like(self.shared, np.nan), np.full_like(self.pose_blocks, np.nan)
        # With residuals of variance 1 the covariance is the inverse of J^T J. Its upper left block
        # is that of Schur's complement, S^-1; those of the poses are C_p^-1 + D_p S^-1 D_p^T, with
        # D_p = C_p^-1 B_p: the poses' own errors, and the effect of the shared unknowns' errors.
        # Source: Hartley and Zisserman, section 5.2 and appendix 6.
        matrix, _, pose_by_shared, _ = self.eliminate_poses()
        shared = inverse_scaled(matrix)
        return shared, np.linalg.inv(
            self.pose_blocks
        ) + pose_by_shared @ shared @ pose_by_shared.swapaxes(1, 2)


def minimize(
    start: T,
    evaluate: Callable[[T], NormalEquations],
    apply_steps: Callable[[T, Array, Array], T],
    *,
    min_gain: float,
    rounding_cost: float = 0.0,
    damping: float = 1e-4,
) -> tuple[T, NormalEquations]:
    """Minimise the sum of squares; return the solution and the normal equations there.

    Levenberg's and Marquardt's method: a step that lowers the sum makes the damping ten times
    smaller; any other step is undone and makes the damping ten times larger.

    ``apply_steps`` returns a solution changed by steps of the shared unknowns (S,) and of the poses
    (P, K); it raises :class:`CalibrationError` if the steps lead to no valid solution. The search
    ends with a step that lowers the cost by less than the part ``min_gain`` of the cost. For this
    comparison ``rounding_cost`` is added to the cost, since exact samples leave only rounding
    errors to gain. ``damping`` is the part of the diagonal that is added to the diagonal at first;
    it may be small if the start is near. The best solution found is returned; its cost is infinite
    if the cost of the start is.
    """
    solution, normal = start, evaluate(start)
    for _ in range(MAX_STEPS):
        if not math.isfinite(normal.cost):
            break
        try:
            candidate = apply_steps(solution, *normal.step(damping))
            candidate_normal = evaluate(candidate)
        except (CalibrationError, np.linalg.LinAlgError):
            candidate, candidate_normal = solution, normal._replace(cost=math.inf)
        gain = normal.cost - candidate_normal.cost
        smallest_gain = min_gain * (normal.cost + rounding_cost)
        if gain < 0:
            if damping >= MAX_DAMPING or -gain <= smallest_gain:
                break
            damping = max(10.0 * damping, 1e-6)
            continue
        solution, normal = candidate, candidate_normal
        damping = max(damping / 10.0, MIN_DAMPING)
        if gain <= smallest_gain:
            break
    return solution, normal


def diagonal_scale(matrix: Array) -> Array:
    """Return the divisors of the rows and columns of a positive matrix that make its diagonal 1."""
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
    scale = diagonal_scale(matrix)
    by_row = scale.reshape(-1, *[1] * (right.ndim - 1))
    scaled = matrix / np.outer(scale, scale)
    if len(matrix) > MAX_UNKNOWNS_BY_SVD:
        with contextlib.suppress(np.linalg.LinAlgError):
            return np.asarray(np.linalg.solve(scaled, right / by_row) / by_row, dtype=np.float64)
    solution: Array = np.linalg.lstsq(scaled, right / by_row, rcond=RANK_TOLERANCE)[0] / by_row
    return solution


def inverse_scaled(matrix: Array) -> Array:
    """Return the pseudoinverse (S, S) of a positive matrix whose unknowns have several units."""
    scale = diagonal_scale(matrix)
    outer = np.outer(scale, scale)
    inverse = np.linalg.pinv(matrix / outer, rcond=RANK_TOLERANCE, hermitian=True)
    return np.asarray(inverse / outer, dtype=np.float64)


def independent_parts(covariance: Array) -> Array:
    """Return independent vectors (K, S) whose outer products add up to a covariance."""
    scale = diagonal_scale(covariance)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    significant = values > COVARIANCE_RANK_TOLERANCE * values.max(initial=0.0)
    parts: Array = (vectors[:, significant] * np.sqrt(values[significant])).T * scale
    return parts
