"""Fit lines and circles to edges with outliers.

An edge has a position only along its normal, so residuals are measured along the normal, in the
edge's standard deviations. The start is the line or circle through two or three edges with the
least median residual (least median of squares), so up to half of the edges may be outliers. The
result is a least-squares fit to the inliers, weighted by their sigmas.

Units are the units of the points: pixels or millimetres.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

import numpy as np

from smartcam.inspection._measure.troubles import NotMeasuredError, NoValueReason

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array

    Mask = NDArray[np.bool_]

MAX_STARTS = 600
"""Largest number of samples of two or three edges that are tried."""

OUTLIER_SIGMAS = 3.5
"""Residual, in standard deviations, from which an edge is an outlier."""

MAX_ROUNDS = 10
"""Largest number of alternations between fitting and choosing inliers; two or three are usual."""

MAX_STEPS = 30
"""Largest number of steps of a fit; three to five are usual."""

MAX_OUTLIER_SHARE = 0.5
"""Largest share of outliers."""


class Edges(NamedTuple):
    """N edges in a plane."""

    points: Array  # (N, 2)
    normals: Array  # (N, 2), directions across the edges, of length 1
    sigmas: Array  # (N,), along the normals

    def selected(self, which: Mask) -> Edges:
        """Return a selection of the edges."""
        return Edges(*(array[which] for array in self))


class Line(NamedTuple):
    """A straight line."""

    at: Array  # (2,), middle of the edges
    direction: Array  # (2,), of length 1
    # (2, 2), of the offset along the normal at the middle, and of the angle in radians
    covariance: Array
    reach: float  # distance from the middle to the outermost edges

    @property
    def normal(self) -> Array:
        """Unit normal (2,): the direction turned by 90 degrees, from first to second axis."""
        return np.array([-self.direction[1], self.direction[0]])

    def offset_variance(self, point: Array) -> float:
        """Return the variance of the line's offset at the foot of a point."""
        lever = np.array([1.0, float((point - self.at) @ self.direction)])
        return float(lever @ self.covariance @ lever)


class Circle(NamedTuple):
    """A circle, or the circle of an arc."""

    centre: Array  # (2,)
    radius: float
    covariance: Array  # (3, 3), of the centre and the radius


ShapeT = TypeVar("ShapeT", Line, Circle)


class ShapeFit(NamedTuple, Generic[ShapeT]):
    """A line or a circle fitted to edges."""

    shape: ShapeT
    kept: Mask  # (N,), mask of inliers
    residuals: Array  # (N,), distances along the edges' normals
    excess: float  # ratio of the residuals' spread to the edges' sigmas, at least 1


def fit_line(edges: Edges, ahead: Array, used: Mask | None = None) -> ShapeFit[Line]:
    """Return the line through edges, with its direction near ``ahead`` (2,).

    ``used`` (N,): the edges to use; None: the inliers.

    Raises:
        NotMeasuredError: FEW_EDGES; NO_AGREEMENT.
    """
    return _robust(
        edges, used, _lines_through, lambda edges_used, start: _line(edges_used, start, ahead), 2
    )


def fit_circle(edges: Edges, used: Mask | None = None) -> ShapeFit[Circle]:
    """Return the circle through edges; ``used`` and errors as in :func:`fit_line`."""
    return _robust(edges, used, _circles_through, _circle, 3)


def _robust(
    edges: Edges,
    used: Mask | None,
    through: Callable[[Array], Array],
    fit: Callable[[Edges, Array], tuple[ShapeT, Array]],
    least: int,
) -> ShapeFit[ShapeT]:
    """Return a robust fit; ``through`` computes H shapes (H, 3) from points (H, least, 2)."""
    number = len(edges.points)
    if number <= least:
        text = f"{number} edges, more than {least} are needed"
        raise NotMeasuredError(NoValueReason.FEW_EDGES, text)
    if used is not None:
        return _fitted(edges, used, fit, _start(edges.selected(used), through, least), least)
    start = _start(edges, through, least)
    all_edges = np.ones(number, dtype=np.bool_)
    fitted = _fitted(edges, all_edges, fit, start, least)
    deviations = np.abs(fitted.residuals) / edges.sigmas
    if fitted.excess == 1.0 and deviations.max() <= OUTLIER_SIGMAS:
        return fitted
    # outliers of the start may be inliers of the fit
    deviations = np.abs(_distances(start[None], edges)[0]) / edges.sigmas
    agree = deviations <= OUTLIER_SIGMAS * max(
        1.4826 * (1 + 5 / (number - least)) * float(np.median(deviations)), 1.0
    )
    seen = set()
    for _ in range(MAX_ROUNDS):
        if np.count_nonzero(agree) < max(least, math.ceil((1 - MAX_OUTLIER_SHARE) * number)):
            text = f"{np.count_nonzero(agree)} of {number} edges agree, half of them are needed"
            raise NotMeasuredError(NoValueReason.NO_AGREEMENT, text)
        fitted = _fitted(edges, agree, fit, start, least)
        deviations = np.abs(fitted.residuals) / edges.sigmas
        again = deviations <= OUTLIER_SIGMAS * _spread(deviations[agree])
        if (again == agree).all() or again.tobytes() in seen:
            break
        seen.add(agree.tobytes())
        agree = again
    return fitted


def _spread(deviations: Array) -> float:
    """Return the ratio of the edges' spread to their sigmas, 1 if chance may explain it.

    ``deviations`` (N,): magnitudes of the residuals, in sigmas. Edges of real parts are not exactly
    straight or round.
    """
    spread = 1.4826 * float(np.median(deviations))
    return spread if spread > 1 + 4 / math.sqrt(len(deviations)) else 1.0


def _fitted(
    edges: Edges,
    used: Mask,
    fit: Callable[[Edges, Array], tuple[ShapeT, Array]],
    start: Array,
    least: int,
) -> ShapeFit[ShapeT]:
    edges_used = edges.selected(used)
    shape, values = fit(edges_used, start)
    residuals = _distances(values[None], edges)[0]
    freedom = int(np.count_nonzero(used)) - least
    squares = float(((residuals[used] / edges_used.sigmas) ** 2).sum())
    # by chance, a sum of squares exceeds three sigmas once in several hundred fits
    much = freedom > 0 and squares > freedom + 3 * math.sqrt(2 * freedom)
    excess = math.sqrt(squares / freedom) if much else 1.0
    shape = shape._replace(covariance=shape.covariance * excess**2)
    return ShapeFit(shape, used, residuals, excess)


def _start(edges: Edges, through: Callable[[Array], Array], least: int) -> Array:
    """Return the shape (3,) with the least median residual, in sigmas."""
    number = len(edges.points)
    if math.comb(number, least) <= MAX_STARTS:
        drawn = np.array(list(itertools.combinations(range(number), least)))
    else:
        # a fixed seed, so that results are repeatable; each edge comes from another section
        random = np.random.default_rng(number)
        drawn = np.argsort(random.random((MAX_STARTS, number)), axis=1)[:, :least]
    with np.errstate(all="ignore"):
        values = through(edges.points[drawn])
        deviations = np.abs(_distances(values, edges)) / edges.sigmas
        median = np.median(deviations, axis=1)
    median = np.where(np.isfinite(median), median, np.inf)
    best = int(np.argmin(median))
    if not math.isfinite(float(median[best])):
        raise NotMeasuredError(NoValueReason.NO_AGREEMENT, "all edges are at one place")
    start: Array = values[best]
    return start


def _distances(values: Array, edges: Edges) -> Array:
    """Return the distances (H, N) of edges from H shapes along the edges' normals.

    ``values`` (H, 3): for lines the angle of the unit normal, the offset along it and NaN; for
    circles the centre and the radius.
    """
    points, normals = edges.points, edges.normals
    first, second, third = values.T[:, :, None]
    lines = np.isnan(third)
    normal = np.stack([np.cos(first), np.sin(first)], axis=-1)
    offsets = points[None] - np.stack([first, second], axis=-1)
    radii = np.hypot(offsets[..., 0], offsets[..., 1])
    across = np.where(lines[..., None], normal, offsets / np.maximum(radii, 1e-12)[..., None])
    beside = np.where(lines, (normal * points[None]).sum(axis=-1) - second, radii - third)
    seen = np.abs((across * normals[None]).sum(axis=-1))
    distances: Array = beside / np.maximum(seen, 0.1)
    return distances


def _lines_through(points: Array) -> Array:
    ahead = points[:, 1] - points[:, 0]
    angle = np.arctan2(ahead[:, 0], -ahead[:, 1])
    offset = np.cos(angle) * points[:, 0, 0] + np.sin(angle) * points[:, 0, 1]
    same = (ahead == 0).all(axis=1)
    return np.column_stack([angle, np.where(same, np.inf, offset), np.full(len(points), np.nan)])


def _circles_through(points: Array) -> Array:
    # |p - c|^2 is equal for three points: (p_k - p_0) . c' = |p_k - p_0|^2 / 2, c' = c - p_0
    first = points[:, 0]
    (a, b), (c, d) = (points[:, 1] - first).T, (points[:, 2] - first).T
    doubled = 2 * (a * d - b * c)
    x = (d * (a * a + b * b) - b * (c * c + d * d)) / doubled
    y = (a * (c * c + d * d) - c * (a * a + b * b)) / doubled
    radius = np.hypot(x, y)
    radius[np.isnan(radius)] = np.inf
    return np.column_stack([first[:, 0] + x, first[:, 1] + y, radius])


def _line(edges: Edges, start: Array, ahead: Array) -> tuple[Line, Array]:
    weights = 1 / edges.sigmas**2
    middle = (weights[:, None] * edges.points).sum(axis=0) / weights.sum()
    offsets = edges.points - middle
    angle = float(start[0])
    hessian: NDArray[Any] = np.eye(2)
    offset = float(start[1] - np.array([math.cos(angle), math.sin(angle)]) @ middle)
    for _ in range(MAX_STEPS):
        normal = np.array([math.cos(angle), math.sin(angle)])
        along = offsets @ np.array([-normal[1], normal[0]])
        seen = edges.normals @ normal
        jacobian = np.column_stack([np.ones(len(offsets)), -along]) / seen[:, None]
        residuals = (offsets @ normal - offset) / seen
        hessian = (jacobian * weights[:, None]).T @ jacobian
        move = np.linalg.solve(hessian, jacobian.T @ (weights * residuals))
        offset, angle = offset + float(move[0]), angle + float(move[1])
        if abs(move[1]) < 1e-12 and abs(move[0]) < 1e-9 * (1 + abs(offset)):
            break
    normal = np.array([math.cos(angle), math.sin(angle)])
    direction = np.array([normal[1], -normal[0]])
    covariance: Array = np.linalg.inv(hessian)
    if direction @ ahead < 0:  # offsets are along the normal, which flips with the direction
        direction, covariance = -direction, covariance * np.array([[1.0, -1.0], [-1.0, 1.0]])
    along = offsets @ direction
    at = middle + offset * normal
    line = Line(at, direction, covariance, float(np.abs(along).max()))
    return line, np.array([angle, float(normal @ at), np.nan])


def _circle(edges: Edges, start: Array) -> tuple[Circle, Array]:
    weights = 1 / edges.sigmas**2
    values = start.copy()
    hessian: NDArray[Any] = np.eye(3)
    for _ in range(MAX_STEPS):
        offsets = edges.points - values[:2]
        distances = np.maximum(np.hypot(offsets[:, 0], offsets[:, 1]), 1e-12)
        across = offsets / distances[:, None]
        seen = np.maximum(np.abs((across * edges.normals).sum(axis=1)), 0.1)
        jacobian = np.column_stack([across, np.ones(len(offsets))]) / seen[:, None]
        residuals = (distances - values[2]) / seen
        hessian = (jacobian * weights[:, None]).T @ jacobian
        if np.linalg.cond(hessian) > 1e14:
            raise NotMeasuredError(
                NoValueReason.UNCERTAIN, "the edges lie on no circle, or on many"
            )
        move = np.linalg.solve(hessian, jacobian.T @ (weights * residuals))
        values = values + move
        if np.abs(move).max() < 1e-10 * (1 + abs(values[2])):
            break
    if not (np.isfinite(values).all() and values[2] > 0):
        raise NotMeasuredError(NoValueReason.UNCERTAIN, "the edges lie on no circle, or on many")
    return Circle(values[:2], float(values[2]), np.linalg.inv(hessian)), values
