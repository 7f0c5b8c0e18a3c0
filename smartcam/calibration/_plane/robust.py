"""Find the touches that agree with one another if some are wrong.

A touch of the wrong mark, or of two marks swapped, lies many sigmas off, and least squares spread
it over all the others. Here every small subset of the points proposes a map (MSAC). The cost of a
map is the sum of the other points' squares, each counted up to a threshold. The best maps are
fitted again to the points that agree with them, until those no longer change. A point is left out
if noise alone would move any point so far from the others in only one of 100 calibrations.

The maps are similarities, or homographies if noise does not explain the higher cost of a
similarity. So the corner points of a field under a tilted camera do not become outliers, even if
the final model is a similarity.

The points are sorted first, and random subsets are drawn with a fixed seed, so the same points give
the same answer in any order.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.calibration._homography import apply_homography, element_derivatives
from smartcam.calibration._plane.fitting import (
    MODELS,
    Fit,
    ModelName,
    Pairs,
    fit,
    scaled_axes,
)
from smartcam.calibration._plane.model_selection import ROUNDING_RATIO, sum_of_squares, touch_noise
from smartcam.calibration._statistics import Noise
from smartcam.exceptions import CalibrationError
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array

    Mask = NDArray[np.bool_]

MIN_POINTS = 6
"""At least this many points are needed: of fewer points, hardly more would agree than are needed to
determine a map."""

MAX_SUBSETS_TRIED = 500
"""At most this many subsets propose a map; for up to 12 points these are all subsets.

If half of the points are wrong, all of 500 subsets of four include a wrong point in 1 of 10^14
cases.
"""

MAX_FITTED_PROPOSALS = 5
"""Number of the best proposals that are fitted to the points that agree with them."""

MAX_ITERATIONS = 10
"""Limit of the alternations between fitting and finding the points that agree; usually 2 or 3."""

SIGNIFICANCE_LEVEL = 0.01
"""Probability with which noise alone leads to leaving out a point, or to a homography."""

LEFT_OUT_COST_RATIO = 0.5
"""Cost of a left-out point, as a fraction of the threshold, for comparing similarity and
homography. A homography that only goes through one more wrong point is not chosen: with 1 instead
of this value it was chosen in 7 of 400 cases with two wrong points of six (measured)."""

SEED = 7
"""Subsets are drawn by random numbers from this seed, so that results repeat."""

MEDIAN_SQUARE = 2.366
"""Median of the squared length of a residual in three dimensions with a variance of 1."""

MIN_TRIANGLE_RATIO = 0.02
"""The smallest triangle of a subset must be larger than this fraction of its largest one: otherwise
its map is useless."""

MIN_VARIANCE_RATIO = 1e-8
"""A point is not tested if less than this fraction of its residual's variance remains: the map then
goes through the point."""


class _Agreement(NamedTuple):
    """A map, and the points that agree with it."""

    fitted: Fit
    mask: Mask  # (N,), True for each point that agrees
    # cost of the map: the squares of these points, plus the threshold for each other point
    cost: float

    @property
    def min_count(self) -> int:
        """Least number of points that must agree: more than half, and more than the model needs."""
        return max(len(self.mask) // 2, MODELS[self.fitted.model].min_points) + 1


def find_agreeing(
    camera: Array, robot: Array, weights: Array, touch_sigma: float | None
) -> NDArray[np.bool_]:
    """Return the mask (N,) of points that agree with one another, more than half of them.

    All points agree if no subset determines a map; ``check_samples`` then reports the cause.
    ``camera`` (N, 2), N at least 6; ``robot`` (N, 3), metres; ``weights`` (N,), one over the
    relative variance of each. ``touch_sigma``: standard deviation of one coordinate, metres; None:
    estimated from the points that agree. Without it up to about (N - 3) / 2 wrong points are found,
    with it any number below half of the points.

    Raises TOO_FEW, or OUTLIER: no map agrees with more than half of the points;
    MissingExtraError: SciPy is not installed.
    """
    count = len(camera)
    if count < MIN_POINTS:
        raise Code.TOO_FEW.error_with_value(
            f"robust: expected at least {MIN_POINTS} points", MIN_POINTS, count
        )
    order = np.lexsort((weights, *robot.T, *camera.T))
    pairs, size = _normalize_by_median(camera[order], robot[order], weights[order])
    sigma = None if touch_sigma is None else touch_sigma / size
    agreement = _choose_agreement(pairs, sigma)
    if agreement is None:
        return np.ones(count, dtype=np.bool_)
    min_count, agreeing_count = agreement.min_count, int(agreement.mask.sum())
    if agreeing_count < min_count:
        raise Code.OUTLIER.error_with_value(
            f"expected at least {min_count} of {count} points that agree with one map",
            min_count,
            agreeing_count,
        )
    mask = np.empty(count, dtype=np.bool_)
    mask[order] = agreement.mask
    return mask


def _normalize_by_median(camera: Array, robot: Array, weights: Array) -> tuple[Pairs, float]:
    """Return the points relative to their medians, divided by their size, and the robot's size."""
    scaled, size = [], 0.0
    for points in (camera, robot):
        centred = points - np.median(points, axis=0)
        lengths = np.linalg.norm(centred, axis=1)
        size = float(np.median(lengths)) or float(lengths.max()) or 1.0
        scaled.append(centred / size)
    return Pairs(scaled[0], scaled[1], weights), size


def _choose_agreement(pairs: Pairs, sigma: float | None) -> _Agreement | None:
    """Return the agreement with a similarity, or with a homography if that is much better."""
    similarity, homography = (
        _search_model("similarity", pairs, sigma),
        _search_model("homography", pairs, sigma),
    )
    if similarity is None or homography is None or homography.mask.sum() < homography.min_count:
        return similarity or homography
    noise = min(_touch_noise(agreement, pairs, sigma) for agreement in (similarity, homography))
    left_out_cost = LEFT_OUT_COST_RATIO * noise.variance * _max_square(len(pairs.camera), None)
    similarity_cost, homography_cost = (
        sum_of_squares(agreement.fitted.residuals, pairs.weights[agreement.mask])
        + left_out_cost * float((~agreement.mask).sum())
        for agreement in (similarity, homography)
    )
    extra_parameters = MODELS["homography"].parameters - MODELS["similarity"].parameters
    if (
        noise.chance(max(similarity_cost - homography_cost, 0.0), extra_parameters)
        < SIGNIFICANCE_LEVEL
    ):
        return homography
    return similarity


def _search_model(name: ModelName, pairs: Pairs, sigma: float | None) -> _Agreement | None:
    """Return the points that agree with a map of one model; None if no subset determines a map."""
    matrices = _propose_maps(name, pairs)
    if not len(matrices):
        return None
    squared_residuals = _squared_residuals(matrices, pairs)
    if sigma is None:
        sigma_of_search = _robust_sigma(squared_residuals, MODELS[name].min_points)
    else:
        sigma_of_search = max(sigma, ROUNDING_RATIO)
    threshold = sigma_of_search**2 * _max_square(len(pairs.camera), None)
    # MSAC: sum min(r^2, threshold). Source: Torr and Zisserman, MLESAC (2000).
    costs = np.minimum(squared_residuals, threshold).sum(axis=1)
    agreements: dict[bytes, _Agreement] = {}
    for index in np.argsort(costs, kind="stable")[:MAX_FITTED_PROPOSALS]:
        agreement = _refit_until_stable(
            name, pairs, squared_residuals[index] <= threshold, sigma, threshold
        )
        if agreement is not None:
            agreements.setdefault(agreement.mask.tobytes(), agreement)
    return min(agreements.values(), key=lambda agreement: agreement.cost, default=None)


def _refit_until_stable(
    name: ModelName, pairs: Pairs, mask: Mask, sigma: float | None, threshold: float
) -> _Agreement | None:
    """Fit a map and find the points that agree, in turn, until these points stay the same."""
    fitted = None
    for _ in range(MAX_ITERATIONS):
        if int(mask.sum()) < MODELS[name].min_points:
            return None
        try:
            fitted = fit(name, Pairs(pairs.camera[mask], pairs.robot[mask], pairs.weights[mask]))
        except CalibrationError:  # the points do not determine the model
            return None
        explained = _explained_points(fitted, pairs, mask, sigma)
        if np.array_equal(explained, mask):
            break
        mask = explained
    else:
        return None
    cost = sum_of_squares(fitted.residuals, pairs.weights[mask]) + threshold * float((~mask).sum())
    return _Agreement(fitted, mask, cost)


def _explained_points(fitted: Fit, pairs: Pairs, mask: Mask, sigma: float | None) -> Mask:
    """Return a mask (N,) of the points whose distance from a fit of the others noise explains."""
    derivatives = element_derivatives(fitted.matrix, pairs.camera)
    by_map = derivatives @ fitted.unit_covariance @ derivatives.swapaxes(1, 2)
    # A fitted point attracts the map: its residual has the variance I / w - J C J^T. For other
    # points the variance of the map is added: I / w + J C J^T.
    signs = np.where(mask, -1.0, 1.0)[:, None, None]
    variances = np.eye(3) / pairs.weights[:, None, None] + signs * by_map
    residuals = pairs.robot - apply_homography(fitted.matrix, pairs.camera)
    values, vectors = np.linalg.eigh(variances)
    components = np.einsum("nij,ni->nj", vectors, residuals)
    is_determined = values > MIN_VARIANCE_RATIO / pairs.weights[:, None]
    squares = np.where(
        is_determined, components**2 / np.where(is_determined, values, 1.0), 0.0
    ).sum(axis=1)
    if sigma is not None:
        return np.asarray(squares <= max(sigma, ROUNDING_RATIO) ** 2 * _max_square(len(mask), None))
    # An outlier would enlarge the sum of squares, so the point's own share is subtracted: the sum
    # falls by r^T Var^-1 r when a point of three coordinates leaves the fit, and their ratio is F.
    # Source: Cook and Weisberg, Residuals and Influence in Regression (1982), chapter 2.
    total, freedom = sum_of_squares(fitted.residuals, pairs.weights[mask]), fitted.freedom
    limits = np.full(len(mask), math.inf)
    for group, remaining_freedom in ((mask, freedom - 3), (~mask, freedom)):
        if remaining_freedom > 0:
            other_variances = (
                np.maximum(total - np.where(group & mask, squares, 0.0), 0.0)[group]
                / remaining_freedom
            )
            limits[group] = np.maximum(other_variances, ROUNDING_RATIO**2) * _max_square(
                len(mask), remaining_freedom
            )
    return np.asarray(squares <= limits)


def _touch_noise(agreement: _Agreement, pairs: Pairs, sigma: float | None) -> Noise:
    """Return the touches' noise: the given one, or an estimate from the points that agree."""
    squared = sum_of_squares(agreement.fitted.residuals, pairs.weights[agreement.mask])
    return touch_noise(sigma, squared, agreement.fitted.freedom) or Noise(ROUNDING_RATIO**2)


def _max_square(count: int, freedom: int | None) -> float:
    """Return the squared length of a residual that noise with a variance of 1 seldom exceeds.

    ``count``: number of points, of which one may exceed it in 1 of 100 calibrations. ``freedom``:
    degrees of freedom of the estimated variance; None if the variance is known.
    """
    # Each point with SIGNIFICANCE_LEVEL / N, so that in at most that part of the calibrations one
    # of all points is longer (Bonferroni): chi-square of three coordinates, or three times F of an
    # estimated variance.
    special, chance = load("scipy.special"), SIGNIFICANCE_LEVEL / count
    if freedom is None:
        return float(special.chdtri(3, chance))
    return 3.0 * float(special.fdtri(3, freedom, 1.0 - chance))


def _robust_sigma(squared_residuals: Array, subset_size: int) -> float:
    """Return the sigma of the proposal with the least median of the other points' residuals.

    Source: Rousseeuw and Leroy, Robust Regression and Outlier Detection (1987), chapter 5: least
    median of squares, with their correction for few points.
    """
    count = squared_residuals.shape[1]
    median_index = (count + subset_size + 1) // 2 - 1
    median = float(np.partition(squared_residuals, median_index, axis=1)[:, median_index].min())
    correction = 1.0 + 5.0 / (count - subset_size)
    return float(max(correction * math.sqrt(median / MEDIAN_SQUARE), ROUNDING_RATIO))


def _subsets(count: int, size: int) -> NDArray[np.intp]:
    """Return all subsets of ``size`` points or, if there are too many, random ones."""
    if math.comb(count, size) <= MAX_SUBSETS_TRIED:
        return np.array(list(itertools.combinations(range(count), size)), dtype=np.intp)
    random = np.random.default_rng(SEED).random((MAX_SUBSETS_TRIED, count))
    return np.sort(np.argpartition(random, size, axis=1)[:, :size], axis=1)


def _propose_maps(name: ModelName, pairs: Pairs) -> Array:
    """Return the maps (S, 4, 3) that subsets of the points determine."""
    subsets = _subsets(len(pairs.camera), MODELS[name].min_points)
    subsets = subsets[
        _is_well_shaped(pairs.camera[subsets]) & _is_well_shaped(pairs.robot[subsets])
    ]
    return MAP_SOLVERS[name](pairs.camera[subsets], pairs.robot[subsets])


def _is_well_shaped(points: Array) -> Mask:
    """Return a mask (S,) of the subsets in which no three points lie nearly in a line."""
    areas = []
    for triple in itertools.combinations(range(points.shape[1]), 3):
        first, second = (points[:, corner] - points[:, triple[0]] for corner in triple[1:])
        product = (first * second).sum(axis=1)
        lengths = (first**2).sum(axis=1) * (second**2).sum(axis=1)
        areas.append(np.sqrt(np.maximum(lengths - product**2, 0.0)))
    largest = np.maximum((np.ptp(points, axis=1) ** 2).sum(axis=1), np.max(areas, axis=0))
    return np.asarray((largest > 0.0) & (np.min(areas, axis=0) > MIN_TRIANGLE_RATIO * largest))


def _similarities(camera: Array, robot: Array) -> Array:
    """Return the similarity that fits each subset of three best (S, 4, 3)."""
    mean_u, mean_p = camera.mean(axis=1, keepdims=True), robot.mean(axis=1, keepdims=True)
    u, p = camera - mean_u, robot - mean_p
    axes = scaled_axes(p.swapaxes(1, 2) @ u, (u**2).sum(axis=(1, 2)), None)
    offset = mean_p.swapaxes(1, 2) - axes @ mean_u.swapaxes(1, 2)
    bottom = np.broadcast_to([0.0, 0.0, 1.0], (len(camera), 1, 3))
    return np.concatenate([np.concatenate([axes, offset], axis=2), bottom], axis=1)


def _homographies(camera: Array, robot: Array) -> Array:
    """Return the homography into the plane of each subset of four (S', 4, 3).

    Three of the points, scaled so that they add up to the fourth, are a basis in each plane. A map
    whose horizon separates the four points is left out.
    """
    # With x_4 = a x_1 + b x_2 + c x_3 and u_4 = d u_1 + e u_2 + f u_3 of homogeneous points,
    # H u_i = (a/d, b/e, c/f)_i x_i maps all four: H = (x_1 x_2 x_3) diag(a/d, b/e, c/f)
    # (u_1 u_2 u_3)^-1. The factors are the depths at the first three points, up to a common factor.
    mean = robot.mean(axis=1, keepdims=True)
    axes = np.linalg.svd(robot - mean, full_matrices=False)[2][:, :2]
    in_plane = _homogeneous((robot - mean) @ axes.swapaxes(1, 2)).swapaxes(1, 2)
    u = _homogeneous(camera).swapaxes(1, 2)
    factors = np.linalg.solve(in_plane[..., :3], in_plane[..., 3:])[..., 0]
    factors /= np.linalg.solve(u[..., :3], u[..., 3:])[..., 0]
    in_space = _homogeneous(in_plane[:, :2].swapaxes(1, 2) @ axes + mean).swapaxes(1, 2)
    maps = (in_space[..., :3] * factors[:, None]) @ np.linalg.inv(u[..., :3])
    maps_in_front: Array = maps[(factors > 0.0).all(axis=1)]
    return maps_in_front


def _homogeneous(points: Array) -> Array:
    return np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=2)


MAP_SOLVERS: dict[ModelName, Callable[[Array, Array], Array]] = {
    "similarity": _similarities,
    "homography": _homographies,
}
"""Functions that compute maps from subsets of points, camera (S, n, 2) and robot (S, n, 3)."""


def _squared_residuals(matrices: Array, pairs: Pairs) -> Array:
    """Return the weighted square of each point's residual in each map (S, N)."""
    mapped = pairs.homogeneous @ matrices.swapaxes(1, 2)
    w = mapped[..., 3:]
    depths = np.where(w > 0.0, w, 1.0)
    squared = ((pairs.robot - mapped[..., :3] / depths) ** 2).sum(axis=2) * pairs.weights
    return np.where(w[..., 0] > 0.0, squared, math.inf)
