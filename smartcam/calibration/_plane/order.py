"""Find touches that were given for the wrong marks, because they were exchanged or shifted.

If the touches of two marks are exchanged, or all of them are shifted by one, least squares spread
the mistake over all points. This module searches for the right order. The search starts from the
order as given, from each shift of this order, and from the reverse of each. Each step exchanges the
two touches that lower the sum of squares most, until no exchange lowers it. An order is reported
only if a simple map explains it and explains the order as given far worse.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.calibration._plane.model_selection import ROUNDING_RATIO
from smartcam.calibration._statistics import Noise
from smartcam.geometry._inside import Code, Remark

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array

    Order = NDArray[np.intp]

SIGNIFICANCE_LEVEL = 1e-6
"""Another order is reported only if the probability that noise alone makes it look so much better
is at most this value."""

MIN_NOISE_CHANCE = 0.001
"""Another order is reported only if the touches' noise explains its residuals with at least this
probability."""

MAX_POINTS_TO_ORDER = 40
"""The order of at most this many points is searched: the work of a step grows with the square of
their number."""

MIN_SURE_ORDER_RATIO = 2
"""An order is sure if every other order that fits as well moves at least this many times as many
touches."""

MIN_POINTS_FOR_AFFINE = 6
"""An affine map is used only with at least this many points: it nearly fits any four points."""


class Reordered(NamedTuple):
    """An order of the touches that explains them better than the given order.

    Attributes:
        order: (N,), index of the touch that belongs to each mark.
        before: sigma of a touch, estimated with the order as given, metres.
        after: sigma of a touch, estimated with the better order, metres.
        sure: True if every other order that fits as well moves far more touches: marks in a regular
            grid look alike from several sides.
    """

    order: Order
    before: float
    after: float
    sure: bool

    @property
    def moved(self) -> tuple[int, ...]:
        """Indices of the marks that get another touch."""
        return tuple(np.flatnonzero(self.order != np.arange(len(self.order))).tolist())

    def remark(self, numbers: NDArray[np.intp]) -> Remark:
        """Return a remark that reports the better order.

        ``numbers`` (N,): numbers of the points in messages.
        """
        moved = [int(numbers[i]) for i in self.moved]
        points_text = f"{', '.join(map(str, moved[:-1]))} and {moved[-1]}"
        problem = "exchanged" if len(moved) == 2 else "in the wrong order"
        note = "" if self.sure else "; more than one order does as well: touch them again"
        return Code.WRONG_ORDER.remark(
            f"the touches of points {points_text} look {problem}: their sigma is "
            f"{1e3 * self.before:.3g} mm in the given order, and {1e3 * self.after:.3g} mm in the "
            f"corrected order{note}"
        )


def find_better_order(camera: Array, robot: Array, sigma: float) -> Reordered | None:
    """Return an order that explains the touches far better than the given one; None without one.

    ``camera`` (N, 2), ``robot`` (N, 3), metres, in the order as given. ``sigma``: largest
    plausible standard deviation of a touch's coordinate, metres.
    """
    count = len(camera)
    if not 3 < count <= MAX_POINTS_TO_ORDER:
        return None
    models = [_Similarity(camera, robot)]
    if count >= MIN_POINTS_FOR_AFFINE:
        models.append(_Affine(camera, robot))
    for model in models:
        squares_as_given, freedom = (
            model.squares(np.arange(count)[None])[0],
            3 * count - model.parameters,
        )
        if Noise(sigma**2).chance(squares_as_given, freedom) > SIGNIFICANCE_LEVEL:
            return None  # a simple map already explains the given order
        orders, squares_of_orders = model.search()
        variance = max(squares_of_orders.min() / freedom, (ROUNDING_RATIO * model.extent) ** 2)
        noise = Noise(variance, freedom)
        if Noise(sigma**2).chance(squares_of_orders.min(), freedom) < MIN_NOISE_CHANCE or (
            noise.chance(squares_as_given, freedom) > SIGNIFICANCE_LEVEL
        ):
            continue
        is_equivalent = np.array(
            [noise.chance(square, freedom) > MIN_NOISE_CHANCE for square in squares_of_orders]
        )
        moved_counts = np.where(is_equivalent, (orders != np.arange(count)).sum(axis=1), 2 * count)
        best, *others = np.argsort(moved_counts, kind="stable").tolist()
        is_sure = all(
            MIN_SURE_ORDER_RATIO * moved_counts[best] <= moved_counts[other] for other in others
        )
        after = max(squares_of_orders[best] / freedom, variance)
        return Reordered(
            orders[best], float((squares_as_given / freedom) ** 0.5), float(after**0.5), is_sure
        )
    return None


class _Similarity:
    """Computes the squared residuals that similarities leave, for many orders at once."""

    parameters = 7

    def __init__(self, camera: Array, robot: Array) -> None:
        self._marks, self._touches = camera - camera.mean(axis=0), robot - robot.mean(axis=0)
        self._scaled_marks = self._scale_marks()
        self._total = float((self._touches**2).sum())
        self.extent = self._total**0.5

    def _scale_marks(self) -> Array:
        return np.asarray(self._marks / np.linalg.norm(self._marks))

    def squares(self, orders: Order) -> Array:
        """Return the sums of squares (K,) of orders (K, N)."""
        return self._remaining_squares(
            np.einsum("kni,nj->kij", self._touches[orders], self._scaled_marks)
        )

    def _remaining_squares(self, cross: Array) -> Array:
        """Return the sums of squares that similarities leave, from products (..., 3, 2)."""
        # If the squares of the marks add up to 1, the best scale is the sum of the singular values
        # of C = sum p u^T, and the fit removes its square. (s1 + s2)^2 = tr C^T C + 2
        # sqrt(det C^T C). Source: Umeyama, Least-Squares Estimation of Transformation Parameters
        # (1991).
        inner = np.swapaxes(cross, -1, -2) @ cross
        root = np.sqrt(np.maximum(np.linalg.det(inner), 0.0))
        remaining = self._total - np.trace(inner, axis1=-2, axis2=-1) - 2.0 * root
        return np.asarray(np.maximum(remaining, 0.0))

    def search(self) -> tuple[Order, Array]:
        """Return the orders (K, N) that no exchange improves, and their sums of squares (K,)."""
        rows = np.arange(len(self._marks))
        starts = [np.roll(order, by) for order in (rows, rows[::-1]) for by in rows]
        orders = np.unique([self._descend(start) for start in starts], axis=0)
        return orders, self.squares(orders)

    def _descend(self, order: Order) -> Order:
        """Return the order after the exchanges that lower its sum of squares."""
        first, second = np.triu_indices(len(order), 1)
        order, best_squares = order.copy(), float(self.squares(order[None])[0])
        while True:
            touches = self._touches[order]
            cross = touches.T @ self._scaled_marks
            # exchanging the touches of i and j adds (p_j - p_i) (u_i - u_j)^T
            changes = (touches[second] - touches[first])[:, :, None] * (
                self._scaled_marks[first] - self._scaled_marks[second]
            )[:, None, :]
            squares = self._remaining_squares(cross + changes)
            best = int(np.argmin(squares))
            if not squares[best] < best_squares * (1.0 - 1e-9):
                return order
            best_squares, (i, j) = float(squares[best]), (first[best], second[best])
            order[[i, j]] = order[[j, i]]


class _Affine(_Similarity):
    """Computes the squared residuals that affine maps leave, as those of a tilted camera."""

    parameters = 9

    def _scale_marks(self) -> Array:
        return np.linalg.qr(self._marks)[0]

    def _remaining_squares(self, cross: Array) -> Array:
        return np.asarray(np.maximum(self._total - (cross**2).sum(axis=(-2, -1)), 0.0))
