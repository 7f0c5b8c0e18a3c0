"""Fit a pose to a picture's edges by weighted least squares, with its covariance."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam.inspection._locate.background import (
    BackgroundSlopes,
    common_error_factor,
    fit_on_background,
    measure_background,
)
from smartcam.inspection._locate.segments import (
    MIN_BLUR_PX,
    BandPixels,
    Bands,
    Segments,
    StepFit,
    find_band_pixels,
    fit_bands,
)
from smartcam.inspection._measure.edges import ROUNDING
from smartcam.inspection._places import PixelPose

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array

FIRST_BLURS_PX: Final = (3.0, 2.0)
"""Blurs, pixels, of the steps that the first iterations fit: a wide step also finds edges that are
farther away."""

MAX_ITERATIONS: Final = 12
"""Largest number of iterations of a fit."""

BACKGROUND_ITERATIONS: Final = 2
"""Number of further iterations of a fit if the brightness beside the edges varies."""

CONVERGENCE_PX: Final = 2e-4
"""A fit ends when no segment moves by more than this many pixels."""

MAX_SHIFT_PX: Final = 2.0
"""Largest shift of a segment that one iteration of the fit takes into account, pixels."""

MAX_BLUR_PX: Final = 4.0
"""Largest blur of edges that are fitted, pixels."""

MAX_DEVIATION_SIGMAS: Final = 4.0
"""Distance of an edge from its segment, in standard deviations, above which it is taken for another
edge."""

EDGE_SIGNIFICANCE: Final = 4.0
"""Least height of an edge, standard deviations of the height."""

SCORED_DISTANCE_PX: Final = 1.0
"""Distance of an edge from its segment, pixels in addition to the noise, from which on the segment
adds nothing to the score."""

MAX_MISFIT: Final = 0.3
"""Largest RMS residual of a fitted step, less the noise, as a share of the step's height."""

MIN_SEGMENTS: Final = 6
"""Least number of segments that determine a pose."""

UNKNOWN_ANGLE: Final = math.pi / math.sqrt(3)
"""Standard deviation of an unknown angle, radians."""

SIZE_SIGMA: Final = 0.02
"""Standard deviation of the size of a part that is searched in one size only, as a share of the
size. Another height or another camera changes the size, and a wrong size shifts the pose."""

STRETCH_SIGMA: Final = 0.01
"""Standard deviation of a part's stretch, as a share of its size. A tilted camera makes a part
longer in one direction and shorter across it."""

GROWTH_SIGMA_PX: Final = 0.3
"""Standard deviation of a common shift of all edges towards one side, pixels: with too much light,
or a camera with little contrast in bright levels, bright areas look larger."""

CHANGE_SIGNIFICANCE: Final = 3.0
"""Least size of a change of the part's shape, in standard deviations, to be fitted. Each fitted
change makes the pose less certain: with 1.0 instead, a bolt's errors were 1.32 times the bound."""

FIRST_CHANGES_ITERATION: Final = 2
"""Number of the first iteration that also fits changes of the part's shape."""

MAX_INVERSE: Final = 1e8
"""Largest element of the inverse of the scaled normal equations; if one is larger, the edges do not
determine the pose."""


class FineSettings(NamedTuple):
    """Settings of a fit."""

    contrast: Array  # (N,), least difference of grey levels between an edge's sides
    noise: float  # standard deviation of the picture's noise, grey levels
    any_polarity: bool = False
    fits_any_scale: bool = False  # whether any scale is allowed; else a scale near the start's
    min_score: float = 0.0  # least score of a pose for which an uneven background is fitted, too
    fits_angle: bool = True  # whether the angle is fitted; not for a round part


class PartShape(NamedTuple):
    """The pose of a part, and the differences of its shape from the taught shape."""

    pose: PixelPose
    stretch: float = 0.0  # share by which the part is longer along the taught x, shorter along y
    shear: float = 0.0  # stretch along the diagonals
    growth: float = 0.0  # shift of all edges towards their brighter side, pixels of the picture

    def add_move(self, move: Array) -> PartShape:
        """Return the shape that a move (7,) leads to."""
        x, y, angle, scale, stretch, shear, growth = move.tolist()
        old = self.pose
        pose = PixelPose(old.x + x, old.y + y, old.angle + angle, old.scale * (1 + scale))
        return PartShape(pose, self.stretch + stretch, self.shear + shear, self.growth + growth)

    def offsets(self, segments: Segments) -> Array:
        """Return the edges' shifts (N,) that the shape's changes cause, pixels of the picture."""
        changes = _change_derivatives(segments, self.pose.scale)
        offsets: Array = changes @ [self.stretch, self.shear, self.growth]
        return offsets


class ExpectedShape(NamedTuple):
    """The scale of a part, and the usual sizes of its changes, before the part is seen."""

    scale: float
    sigmas: Array  # (4,), of size, stretch and shear (shares), growth (pixels); infinite: unknown

    def deviations(self, shape: PartShape) -> Array:
        """Return the deviations (4,) of a shape's size, stretch, shear and growth."""
        size = shape.pose.scale / self.scale - 1
        return np.array([size, shape.stretch, shape.shear, shape.growth])


class FinePose(NamedTuple):
    """A fitted pose."""

    pose: PixelPose
    covariance: Array  # (4, 4), of x, y (pixels), angle (radians), scale
    score: float  # share of the edges that are visible, by length
    visible: NDArray[np.bool_]  # (N,), mask of the visible segments
    inliers: NDArray[np.bool_]  # (N,), mask of the segments that the pose was fitted to
    noise: float  # standard deviation of the pixels, grey levels
    chi_square: float  # chi-square of the kept segments around the pose, per degree of freedom
    reversed_share: float  # share of the edges that are visible with the other polarity
    blur: float  # median standard deviation of the edges' blur, pixels


def fit_pose(
    levels: NDArray[Any], segments: Segments, bands: Bands, start: PixelPose, settings: FineSettings
) -> FinePose | None:
    """Return the best pose near a start that is wrong by two pixels at most; None: no pose fits.

    ``levels`` (H, W) is the picture.
    """
    shape = PartShape(start)
    size_sigma = math.inf if settings.fits_any_scale else SIZE_SIGMA
    sigmas = np.array([size_sigma, STRETCH_SIGMA, STRETCH_SIGMA, GROWTH_SIGMA_PX])
    expected = ExpectedShape(start.scale, sigmas)
    extra_variance, pixels = 0.0, find_band_pixels(bands, _pose_matrix(start), levels)
    for iteration in range(MAX_ITERATIONS):
        if 0 < iteration < 4:
            pixels = find_band_pixels(bands, _pose_matrix(shape.pose), levels)
        first_blur = FIRST_BLURS_PX[iteration] if iteration < len(FIRST_BLURS_PX) else None
        fit, blurs = _fit_bands(pixels, segments, shape, extra_variance, first_blur)
        rows, weights, _, _ = _linearize((fit, blurs), segments, shape.pose, settings, iteration)
        fits_changes = iteration >= FIRST_CHANGES_ITERATION
        fits_scale = settings.fits_any_scale or fits_changes
        free = np.array([True, True, settings.fits_angle, fits_scale, *[fits_changes] * 3])
        solved = _solve(
            (rows, fit.shifts, weights), free, expected.deviations(shape), expected.sigmas
        )
        if solved is None:
            return None
        move, _ = solved
        shape = shape.add_move(move)
        if first_blur is None:
            extra_variance = _update_variance(extra_variance, fit.widening, float(np.median(blurs)))
        if iteration >= 4 and float(np.abs(rows @ move).max()) < CONVERGENCE_PX:
            break
    return _judge_pose(pixels, segments, shape, extra_variance, settings, expected)


def _change_derivatives(segments: Segments, scale: float) -> Array:
    """Return the derivatives (N, 3) of the edges' shifts by stretch, shear and growth."""
    (x, y), (u, v) = segments.middles.T, segments.normals.T
    return np.column_stack([scale * (u * x - v * y), scale * (u * y + v * x), np.ones_like(x)])


def _pose_matrix(pose: PixelPose) -> Array:
    """Return the matrix (2, 3) from a model's places to the picture's pixels."""
    cos, sin = pose.scale * math.cos(pose.angle), pose.scale * math.sin(pose.angle)
    return np.array([[cos, -sin, pose.x], [sin, cos, pose.y]])


def _fit_bands(
    pixels: BandPixels,
    segments: Segments,
    shape: PartShape,
    extra_variance: float,
    first_blur: float | None,
    background: BackgroundSlopes | None = None,
    noise: float = 0.0,
) -> tuple[StepFit, Array]:
    """Fit a step of brightness in each band of a part; return the fits, and the blurs used."""
    places, blurs = _pixel_coordinates(pixels, segments, shape, extra_variance)
    if first_blur is not None:
        blurs = np.full_like(blurs, first_blur)
    count, blurs_of_pixels = len(segments.half_lengths), blurs[pixels.owners]
    if background is None:
        return fit_bands(places[0], blurs_of_pixels, pixels, count), blurs
    return fit_on_background(places, blurs_of_pixels, pixels, background, noise), blurs


def _pixel_coordinates(
    pixels: BandPixels, segments: Segments, shape: PartShape, extra_variance: float
) -> tuple[tuple[Array, Array], Array]:
    """Return the pixels' coordinates across and along their edges, (P,), and the blurs (N,)."""
    pose = shape.pose
    across, along = segments.coordinates_of(pose.from_picture(pixels.points), pixels.owners)
    blurs = segments.blurs * pose.scale
    blurs = np.sqrt(np.maximum(blurs**2 + extra_variance, MIN_BLUR_PX**2))
    shifts = pose.scale * segments.blur_shift(extra_variance / pose.scale**2)
    shifts += shape.offsets(segments)
    return (pose.scale * across - shifts[pixels.owners], pose.scale * along), blurs


def _update_variance(extra_variance: float, widening: float, blur: float) -> float:
    """Return the corrected difference of the squared blurs of this and the taught picture."""
    new_blur = blur * (1 + min(max(widening, -0.3), 0.3))
    extra_variance += min(new_blur, MAX_BLUR_PX) ** 2 - blur**2
    return min(max(extra_variance, -(blur**2)), MAX_BLUR_PX**2)


def _linearize(
    fit_and_blurs: tuple[StepFit, Array],
    segments: Segments,
    pose: PixelPose,
    settings: FineSettings,
    iteration: int,
) -> tuple[Array, Array, float, NDArray[np.bool_]]:
    """Return rows (N, 7) and weights (N,) of the equations, the noise, and the mask of edges."""
    fit, blurs = fit_and_blurs
    is_edge, noise = _find_edges(fit, settings)
    cos, sin = math.cos(pose.angle), math.sin(pose.angle)
    rotation = np.array([[cos, sin], [-sin, cos]])
    normals = segments.normals @ rotation
    arms = pose.scale * segments.middles @ rotation
    torques = arms[:, 0] * normals[:, 1] - arms[:, 1] * normals[:, 0]
    radial = (normals * arms).sum(axis=1)
    rows = np.column_stack([normals, torques, radial, _change_derivatives(segments, pose.scale)])
    sigmas = _shift_sigmas(fit, segments, pose, noise, blurs)
    weights = np.where(is_edge & np.isfinite(sigmas), 1 / np.maximum(sigmas, 1e-6) ** 2, 0.0)
    if iteration < 3:  # far from the solution, noisy edges count like others
        weights = (weights > 0).astype(np.float64)
    return rows, weights, noise, is_edge


def _find_edges(fit: StepFit, settings: FineSettings) -> tuple[NDArray[np.bool_], float]:
    """Return a mask of the steps that are edges (N,), and the noise of their pixels."""
    finite = np.isfinite(fit.sigmas)
    noise = _median_noise(fit, finite)
    heights = np.abs(fit.heights) if settings.any_polarity else fit.heights
    is_high = heights >= np.maximum(
        settings.contrast, EDGE_SIGNIFICANCE * noise * fit.height_sigmas
    )
    return finite & is_high & (_relative_misfits(fit, settings) <= 1), noise


def _relative_misfits(fit: StepFit, settings: FineSettings) -> Array:
    """Return the RMS residual of each step beyond the noise, relative to the largest allowed."""
    # the scatter of a band's pixels varies by chance
    noise = settings.noise**2 * (1 + 3 * np.sqrt(2 / fit.freedoms))
    excess_rms = np.sqrt(np.maximum(fit.variances - noise, 0.0))
    misfits: Array = excess_rms / np.maximum(MAX_MISFIT * np.abs(fit.heights), 1e-6)
    return misfits


def _median_noise(fit: StepFit, finite: NDArray[np.bool_]) -> float:
    """Return the pixels' noise: the median over the bands, most of which have no misfit."""
    if not finite.any():
        return ROUNDING
    freedom = float(np.median(fit.freedoms[finite]))
    median = float(np.median(fit.variances[finite])) / (1 - 2 / (9 * freedom)) ** 3
    return max(math.sqrt(median), ROUNDING)


def _shift_sigmas(
    fit: StepFit, segments: Segments, pose: PixelPose, noise: float, blurs: Array
) -> Array:
    """Return the standard deviation of each shift, from both pictures' noise and from misfits."""
    # pixels that scatter more than chance explains show a structure other than the step
    has_structure = fit.variances > noise**2 * (1 + 2.5 * np.sqrt(2 / fit.freedoms))
    variances = np.where(has_structure, fit.variances, noise**2)
    # the structure may move the edge by its height over the step's steepest slope
    steepest = np.maximum(np.abs(fit.heights), 1e-6) / (math.sqrt(2 * math.pi) * blurs)
    misfit_variances = np.where(has_structure, fit.variances - noise**2, 0.0) / steepest**2
    return np.sqrt(
        variances * fit.sigmas**2 + misfit_variances + (pose.scale * segments.sigmas) ** 2
    )


Equations = tuple["Array", "Array", "Array"]
"""Rows (N, 7), shifts (N,) and weights (N,)."""


def _solve(
    equations: Equations, free: NDArray[np.bool_], deviations: Array, sigmas: Array
) -> tuple[Array, Array] | None:
    """Return the robust solution (7,) and its covariance (7, 7); None: too few edges.

    ``deviations`` (4,): differences of size, stretch, shear and growth from their expected values,
    whose standard deviations are ``sigmas``.
    """
    rows, shifts, weights = equations
    used = weights > 0
    if np.count_nonzero(used) < MIN_SEGMENTS:
        return None
    a, y, w = rows[used], shifts[used].clip(-MAX_SHIFT_PX, MAX_SHIFT_PX), weights[used]
    robust = np.ones_like(w)
    for _ in range(4):
        solved = _least_squares((a, y, w * robust), free, deviations, sigmas)
        if solved is None:
            return None
        scaled = (y - a @ solved[0]) * np.sqrt(w)
        spread = max(1.4826 * float(np.median(np.abs(scaled))), 0.5)
        robust = np.maximum(1 - (scaled / (MAX_DEVIATION_SIGMAS * 1.5 * spread)) ** 2, 0.0) ** 2
    return _least_squares((a, y, w * robust), free, deviations, sigmas)


def _least_squares(
    equations: Equations, free: NDArray[np.bool_], deviations: Array, sigmas: Array
) -> tuple[Array, Array] | None:
    rows, values, weights = equations
    weighted = rows * weights[:, None]
    square, right = rows.T @ weighted, weighted.T @ values
    square[range(3, 7), range(3, 7)] += 1 / sigmas**2
    right[3:] -= deviations / sigmas**2
    square, right = square[np.ix_(free, free)], right[free]
    scale = np.sqrt(np.maximum(np.diag(square), 1e-30))
    unit = square / np.outer(scale, scale)
    try:
        inverse = np.linalg.inv(unit)
    except np.linalg.LinAlgError:
        return None
    if not np.abs(inverse).max() < MAX_INVERSE:
        return None
    inverse = inverse / np.outer(scale, scale)
    solution, covariance = np.zeros(7), np.zeros((7, 7))
    solution[free] = inverse @ right
    covariance[np.ix_(free, free)] = inverse
    return solution, covariance


def _judge_pose(
    pixels: BandPixels,
    segments: Segments,
    shape: PartShape,
    extra_variance: float,
    settings: FineSettings,
    expected: ExpectedShape,
) -> FinePose | None:
    """Return the final pose, its covariance and its score; None: too few edges agree."""
    free = np.array([True, True, settings.fits_angle, True, True, True, True])
    fit, blurs = fit_and_blurs = _fit_bands(pixels, segments, shape, extra_variance, None)
    rows, weights, noise, is_edge = _linearize(
        fit_and_blurs, segments, shape.pose, settings, MAX_ITERATIONS
    )
    # an edge counts more if it is near its segment, and if it fits a step well
    distances = np.abs(fit.shifts) / (
        SCORED_DISTANCE_PX + MAX_DEVIATION_SIGMAS * np.minimum(_sigmas_of(weights), 1.0)
    )
    visible = is_edge & (distances <= 1)
    lengths = segments.half_lengths / segments.half_lengths.sum()
    score = float(
        (lengths * (1 - distances**2) * (1 - _relative_misfits(fit, settings) ** 2))[visible].sum()
    )
    is_reversed = (fit.heights < -settings.contrast) & (not settings.any_polarity)
    background = None
    if score >= settings.min_score:
        places, _ = _pixel_coordinates(pixels, segments, shape, extra_variance)
        background = measure_background(places, blurs[pixels.owners], pixels, segments, visible)
        for _ in range(BACKGROUND_ITERATIONS if background is not None else 0):
            fit, _ = _fit_bands(pixels, segments, shape, extra_variance, None, background, noise)
            rows, weights, noise, _ = _linearize(
                (fit, blurs), segments, shape.pose, settings, MAX_ITERATIONS
            )
            weights = np.where(visible, weights, 0.0)
            equations = rows, fit.shifts, weights
            solved = _solve(equations, free, expected.deviations(shape), expected.sigmas)
            if solved is None:
                return None
            shape = shape.add_move(solved[0])
    equations = rows, fit.shifts, np.where(visible, weights, 0.0)
    final = _solve_final(equations, free, expected.deviations(shape), expected.sigmas)
    if final is None:
        return None
    move, covariance, inliers, chi_square = final
    residuals = (fit.shifts - rows @ move) * np.sqrt(weights)
    covariance = covariance * common_error_factor(
        segments, residuals, inliers, background_varies=background is not None
    )
    pose = shape.add_move(move).pose
    if covariance[3, 3] == 0:
        pose = pose._replace(scale=expected.scale)
    covariance[3] *= pose.scale
    covariance[:, 3] *= pose.scale
    if not settings.fits_angle:
        covariance[2, 2] = UNKNOWN_ANGLE**2
    return FinePose(
        pose._replace(angle=math.remainder(pose.angle, 2 * math.pi)),
        covariance,
        score,
        visible,
        inliers,
        noise,
        chi_square,
        float(lengths[is_reversed].sum()),
        float(np.median(blurs)),
    )


def _solve_final(
    equations: Equations, free: NDArray[np.bool_], deviations: Array, sigmas: Array
) -> tuple[Array, Array, NDArray[np.bool_], float] | None:
    """Return the last move (7,), the pose's covariance (4, 4), the mask of inliers, and chi-square.

    Chi-square is per degree of freedom. None: too few segments agree.
    """
    rows, shifts, weights = equations
    sigmas_off = np.abs(shifts) * np.sqrt(weights)
    inliers, freedom, chi_square, spread = weights > 0, 1, 1.0, 1.0
    if inliers.any():
        # wide, since the whole part may differ from the taught one, as in too much light
        spread = max(1.4826 * float(np.median(sigmas_off[inliers])), 1.0)
    for _ in range(3):
        inliers = (weights > 0) & (sigmas_off <= MAX_DEVIATION_SIGMAS * spread)
        if np.count_nonzero(inliers) < MIN_SEGMENTS:
            return None
        freedom = max(int(inliers.sum()) - 4, 1)
        chi_square = float((sigmas_off[inliers] ** 2).sum()) / freedom
        spread = max(math.sqrt(chi_square), 1.0)
    # with a larger chi-square, the part differs from the taught one
    exceeds_chance = chi_square > 1 + 4 * math.sqrt(2 / freedom)
    inlier_equations = rows[inliers], shifts[inliers], weights[inliers]
    solved = _solve_with_changes(inlier_equations, free, deviations, sigmas, max(chi_square, 1.0))
    if solved is None:
        return None
    move, covariance = solved
    return move, covariance[:4, :4] * (chi_square if exceeds_chance else 1.0), inliers, chi_square


def _solve_with_changes(
    equations: Equations,
    free: NDArray[np.bool_],
    deviations: Array,
    sigmas: Array,
    chi_square: float,
) -> tuple[Array, Array] | None:
    """Return the solution in which only significant changes of the part's shape are fitted.

    The second fit expects each change to be as large as the first fit found it: this size, less
    noise, is the standard deviation of the change before the fit.
    """
    rows, shifts, weights = equations
    solved = _least_squares(equations, free, deviations, sigmas)
    if solved is None:
        return None
    move, covariance = solved
    edge_variances = 1 / np.maximum(1 / np.diag(covariance)[3:] - 1 / sigmas**2, 1e-12)
    min_squares = CHANGE_SIGNIFICANCE**2 * chi_square * edge_variances
    excess_squares = (deviations + move[3:]) ** 2 - min_squares
    keeps_shape = (excess_squares <= 0) & np.isfinite(sigmas)
    change_sigmas = np.minimum(np.sqrt(np.maximum(excess_squares, 1e-12)), sigmas)
    change_sigmas = np.where(np.isfinite(sigmas), change_sigmas, sigmas)
    shifts = shifts + rows[:, 3:] @ np.where(keeps_shape, deviations, 0.0)
    still_free = free.copy()
    still_free[3:] &= ~keeps_shape
    solved = _least_squares((rows, shifts, weights), still_free, deviations, change_sigmas)
    if solved is not None:
        solved[0][3:][keeps_shape] = -deviations[keeps_shape]
    return solved


def _sigmas_of(weights: Array) -> Array:
    """Return the standard deviations that weights stand for."""
    return np.where(weights > 0, 1 / np.sqrt(np.maximum(weights, 1e-12)), np.inf)
