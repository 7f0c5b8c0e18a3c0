"""Fit lines and circles to edges with outliers.

An edge has a position only along its normal, so residuals are measured along the normal, in the
edge's standard deviations. The fit starts from the line or circle through two or three edges that
has the least median residual (least median of squares), so up to half of the edges may be outliers.
The result is a least-squares fit to the inliers, weighted by their sigmas.

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

MAX_ITERATIONS = 30
"""Largest number of iterations of a fit; three to five are usual."""

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

    middle: Array  # (2,), middle of the edges
    direction: Array  # (2,), of length 1
    # (2, 2), of the offset along the normal at the middle, and of the angle, radians
    covariance: Array
    reach: float  # distance from the middle to the outermost edges

    @property
    def normal(self) -> Array:
        """Unit normal (2,): the direction turned by 90 degrees, from first to second axis."""
        return np.array([-self.direction[1], self.direction[0]])

    def offset_variance(self, point: Array) -> float:
        """Return the variance of the line's offset where it is nearest to a point."""
        lever = np.array([1.0, float((point - self.middle) @ self.direction)])
        return float(lever @ self.covariance @ lever)


class Circle(NamedTuple):
    """A circle, or the circle of an arc."""

    centre: Array  # (2,)
    radius: float
    covariance: Array  # (3, 3), of the centre and the radius


CurveT = TypeVar("CurveT", Line, Circle)


class CurveFit(NamedTuple, Generic[CurveT]):
    """A line or a circle fitted to edges."""

    curve: CurveT
    inliers: Mask  # (N,), mask of inliers
    residuals: Array  # (N,), distances along the edges' normals
    excess: float  # ratio of the residuals' spread to the edges' sigmas, at least 1


def fit_line(edges: Edges, direction: Array, used: Mask | None = None) -> CurveFit[Line]:
    """Return the line through edges, with its direction near ``direction`` (2,).

    ``used`` (N,): mask of the edges to use; None: the inliers, which are searched.

    Raises:
        NotMeasuredError: FEW_EDGES; NO_AGREEMENT.
    """
    return _fit_robustly(
        edges,
        used,
        _lines_through,
        lambda edges_used, start: _refine_line(edges_used, start, direction),
        2,
    )


def fit_circle(edges: Edges, used: Mask | None = None) -> CurveFit[Circle]:
    """Return the circle through edges; ``used`` and errors as in :func:`fit_line`."""
    return _fit_robustly(edges, used, _circles_through, _refine_circle, 3)


def _fit_robustly(
    edges: Edges,
    used: Mask | None,
    curves_through: Callable[[Array], Array],
    fit: Callable[[Edges, Array], tuple[CurveT, Array]],
    min_edges: int,
) -> CurveFit[CurveT]:
    """Return a robust fit.

    ``curves_through`` computes H curves (H, 3) from points (H, min_edges, 2).
    """
    edge_count = len(edges.points)
    if edge_count <= min_edges:
        text = f"{edge_count} edges, more than {min_edges} are needed"
        raise NotMeasuredError(NoValueReason.FEW_EDGES, text)
    if used is not None:
        return _fit_inliers(
            edges,
            used,
            fit,
            _best_start(edges.selected(used), curves_through, min_edges),
            min_edges,
        )
    start = _best_start(edges, curves_through, min_edges)
    all_edges = np.ones(edge_count, dtype=np.bool_)
    fitted = _fit_inliers(edges, all_edges, fit, start, min_edges)
    deviations = np.abs(fitted.residuals) / edges.sigmas
    if fitted.excess == 1.0 and deviations.max() <= OUTLIER_SIGMAS:
        return fitted
    # outliers of the start may be inliers of the fit
    deviations = np.abs(_distances(start[None], edges)[0]) / edges.sigmas
    inliers = deviations <= OUTLIER_SIGMAS * max(
        1.4826 * (1 + 5 / (edge_count - min_edges)) * float(np.median(deviations)), 1.0
    )
    seen_masks = set()
    for _ in range(MAX_ROUNDS):
        count = np.count_nonzero(inliers)
        if count < max(min_edges, math.ceil((1 - MAX_OUTLIER_SHARE) * edge_count)):
            text = f"{count} of {edge_count} edges agree, half of them are needed"
            raise NotMeasuredError(NoValueReason.NO_AGREEMENT, text)
        fitted = _fit_inliers(edges, inliers, fit, start, min_edges)
        deviations = np.abs(fitted.residuals) / edges.sigmas
        next_inliers = deviations <= OUTLIER_SIGMAS * _spread(deviations[inliers])
        if (next_inliers == inliers).all() or next_inliers.tobytes() in seen_masks:
            break
        seen_masks.add(inliers.tobytes())
        inliers = next_inliers
    return fitted


def _spread(deviations: Array) -> float:
    """Return the ratio of the edges' spread to their sigmas; 1 if chance may explain the spread.

    ``deviations`` (N,): magnitudes of the residuals, in sigmas. Edges of real parts are not exactly
    straight or round.
    """
    spread = 1.4826 * float(np.median(deviations))
    return spread if spread > 1 + 4 / math.sqrt(len(deviations)) else 1.0


def _fit_inliers(
    edges: Edges,
    used: Mask,
    fit: Callable[[Edges, Array], tuple[CurveT, Array]],
    start: Array,
    min_edges: int,
) -> CurveFit[CurveT]:
    edges_used = edges.selected(used)
    curve, values = fit(edges_used, start)
    residuals = _distances(values[None], edges)[0]
    freedom = int(np.count_nonzero(used)) - min_edges
    squares = float(((residuals[used] / edges_used.sigmas) ** 2).sum())
    # by chance, a sum of squares exceeds three sigmas once in several hundred fits
    exceeds_chance = freedom > 0 and squares > freedom + 3 * math.sqrt(2 * freedom)
    excess = math.sqrt(squares / freedom) if exceeds_chance else 1.0
    curve = curve._replace(covariance=curve.covariance * excess**2)
    return CurveFit(curve, used, residuals, excess)


def _best_start(edges: Edges, curves_through: Callable[[Array], Array], min_edges: int) -> Array:
    """Return the curve (3,) with the least median residual, in sigmas."""
    edge_count = len(edges.points)
    if math.comb(edge_count, min_edges) <= MAX_STARTS:
        samples = np.array(list(itertools.combinations(range(edge_count), min_edges)))
    else:
        # a fixed seed, so that results are repeatable; the edges come from different sections
        generator = np.random.default_rng(edge_count)
        samples = np.argsort(generator.random((MAX_STARTS, edge_count)), axis=1)[:, :min_edges]
    with np.errstate(all="ignore"):
        values = curves_through(edges.points[samples])
        deviations = np.abs(_distances(values, edges)) / edges.sigmas
        median = np.median(deviations, axis=1)
    median = np.where(np.isfinite(median), median, np.inf)
    best = int(np.argmin(median))
    if not math.isfinite(float(median[best])):
        raise NotMeasuredError(NoValueReason.NO_AGREEMENT, "all edges are at one place")
    start: Array = values[best]
    return start


def _distances(values: Array, edges: Edges) -> Array:
    """Return the distances (H, N) of edges from H curves along the edges' normals.

    ``values`` (H, 3): for lines the angle of the unit normal, the offset along it and NaN; for
    circles the centre and the radius.
    """
    points, normals = edges.points, edges.normals
    first, second, third = values.T[:, :, None]
    is_line = np.isnan(third)
    normal = np.stack([np.cos(first), np.sin(first)], axis=-1)
    offsets = points[None] - np.stack([first, second], axis=-1)
    radii = np.hypot(offsets[..., 0], offsets[..., 1])
    curve_normals = np.where(
        is_line[..., None], normal, offsets / np.maximum(radii, 1e-12)[..., None]
    )
    offsets_from_curve = np.where(
        is_line, (normal * points[None]).sum(axis=-1) - second, radii - third
    )
    cosines = np.abs((curve_normals * normals[None]).sum(axis=-1))
    distances: Array = offsets_from_curve / np.maximum(cosines, 0.1)
    return distances


def _lines_through(points: Array) -> Array:
    directions = points[:, 1] - points[:, 0]
    angle = np.arctan2(directions[:, 0], -directions[:, 1])
    offset = np.cos(angle) * points[:, 0, 0] + np.sin(angle) * points[:, 0, 1]
    coincide = (directions == 0).all(axis=1)
    return np.column_stack(
        [angle, np.where(coincide, np.inf, offset), np.full(len(points), np.nan)]
    )


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


def _refine_line(edges: Edges, start: Array, wanted_direction: Array) -> tuple[Line, Array]:
    weights = 1 / edges.sigmas**2
    centroid = (weights[:, None] * edges.points).sum(axis=0) / weights.sum()
    offsets = edges.points - centroid
    angle = float(start[0])
    hessian: NDArray[Any] = np.eye(2)
    offset = float(start[1] - np.array([math.cos(angle), math.sin(angle)]) @ centroid)
    for _ in range(MAX_ITERATIONS):
        normal = np.array([math.cos(angle), math.sin(angle)])
        along = offsets @ np.array([-normal[1], normal[0]])
        cosines = edges.normals @ normal
        jacobian = np.column_stack([np.ones(len(offsets)), -along]) / cosines[:, None]
        residuals = (offsets @ normal - offset) / cosines
        hessian = (jacobian * weights[:, None]).T @ jacobian
        move = np.linalg.solve(hessian, jacobian.T @ (weights * residuals))
        offset, angle = offset + float(move[0]), angle + float(move[1])
        if abs(move[1]) < 1e-12 and abs(move[0]) < 1e-9 * (1 + abs(offset)):
            break
    normal = np.array([math.cos(angle), math.sin(angle)])
    direction = np.array([normal[1], -normal[0]])
    covariance: Array = np.linalg.inv(hessian)
    if direction @ wanted_direction < 0:
        # offsets are along the normal, which flips with the direction
        direction, covariance = -direction, covariance * np.array([[1.0, -1.0], [-1.0, 1.0]])
    along = offsets @ direction
    middle = centroid + offset * normal
    line = Line(middle, direction, covariance, float(np.abs(along).max()))
    return line, np.array([angle, float(normal @ middle), np.nan])


def _refine_circle(edges: Edges, start: Array) -> tuple[Circle, Array]:
    weights = 1 / edges.sigmas**2
    values = start.copy()
    hessian: NDArray[Any] = np.eye(3)
    for _ in range(MAX_ITERATIONS):
        offsets = edges.points - values[:2]
        distances = np.maximum(np.hypot(offsets[:, 0], offsets[:, 1]), 1e-12)
        radial = offsets / distances[:, None]
        cosines = np.maximum(np.abs((radial * edges.normals).sum(axis=1)), 0.1)
        jacobian = np.column_stack([radial, np.ones(len(offsets))]) / cosines[:, None]
        residuals = (distances - values[2]) / cosines
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
