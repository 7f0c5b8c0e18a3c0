"""Fit a pose to a picture's edges by weighted least squares, with its covariance."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam.inspection._locate.ground import Ground, common_error, fit_on_ground, ground_beside
from smartcam.inspection._locate.segments import (
    MIN_BLUR_PX,
    BandPixels,
    Bands,
    Segments,
    StepFit,
    fit_bands,
    pixels_in,
)
from smartcam.inspection._measure.edges import ROUNDING
from smartcam.inspection._places import PixelPose

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array

FIRST_BLURS_PX: Final = (3.0, 2.0)
"""Blurs of the first steps of a fit, in pixels: a wide step is drawn from farther away."""

MAX_STEPS: Final = 12
"""Largest number of steps of a fit."""

GROUND_STEPS: Final = 2
"""Number of further steps of a fit if the brightness beside the edges varies."""

CONVERGENCE_PX: Final = 2e-4
"""A fit ends when no segment moves by more than this many pixels."""

MAX_SHIFT_PX: Final = 2.0
"""Largest shift of a segment that one step of the fit takes into account, pixels."""

MAX_BLUR_PX: Final = 4.0
"""Largest blur of edges that are fitted, pixels."""

MAX_DEVIATION_SIGMAS: Final = 4.0
"""Least distance from its place, in standard deviations, at which a segment is another edge."""

EDGE_SIGNIFICANCE: Final = 4.0
"""Least height of an edge, standard deviations of the height."""

SCORED_DISTANCE_PX: Final = 1.0
"""Distance from its place, in pixels beyond the noise, at which a segment adds nothing to the
score."""

MAX_MISFIT: Final = 0.3
"""Largest RMS around an edge's step beyond the noise, as a part of the step's height."""

MIN_SEGMENTS: Final = 6
"""Least number of segments that determine a pose."""

UNKNOWN_ANGLE: Final = math.pi / math.sqrt(3)
"""Standard deviation of an unknown angle, radians."""

SIZE_SIGMA: Final = 0.02
"""Standard deviation of the size of a part that is searched in one size only, as a part of it:
another height or another camera changes the size, and a wrong size shifts the pose."""

STRETCH_SIGMA: Final = 0.01
"""Standard deviation of a part's stretch, longer in one direction and shorter across it, as a part
of its size: a tilted camera causes it."""

GROWTH_SIGMA_PX: Final = 0.3
"""Standard deviation of a common shift of all edges towards one side, pixels: with too much light,
or a camera with little contrast in bright levels, bright areas look larger."""

CHANGE_SIGNIFICANCE: Final = 3.0
"""Least significance, in standard deviations, of a change of the part's shape that is fitted. With
1.0 a bolt's errors were 1.32 times the bound, since each fitted change costs certainty."""

FIRST_CHANGED_STEP: Final = 2
"""Number of the first step that also fits changes of the part's shape."""

MAX_INVERSE: Final = 1e8
"""Largest element of the inverse of the scaled equations; above it the edges do not determine the
pose."""


class FineSettings(NamedTuple):
    """Settings of a fit."""

    contrast: Array  # (N,), least difference of grey levels between an edge's sides
    noise: float  # standard deviation of the picture's noise, grey levels
    any_polarity: bool = False
    scaled: bool = False  # whether any scale is allowed; else only one near the start's
    least_score: float = 0.0  # least score of a pose for which uneven ground is fitted, too
    turned: bool = True  # whether the angle is fitted; for a round part it is not


class PartShape(NamedTuple):
    """The pose of a part, and the changes of its shape against the taught part."""

    pose: PixelPose
    stretch: float = 0.0  # part by which it is longer along the taught x and shorter along y
    shear: float = 0.0  # shear: the stretch along the diagonals
    growth: float = 0.0  # shift of all edges towards their brighter side, pixels of the picture

    def moved(self, move: Array) -> PartShape:
        """Return the shape after a move (7,)."""
        x, y, angle, scale, stretch, shear, growth = move.tolist()
        old = self.pose
        pose = PixelPose(old.x + x, old.y + y, old.angle + angle, old.scale * (1 + scale))
        return PartShape(pose, self.stretch + stretch, self.shear + shear, self.growth + growth)

    def offsets(self, segments: Segments) -> Array:
        """Return the edges' shifts (N,) that the shape's changes cause, pixels of the picture."""
        changes = _changes(segments, self.pose.scale)
        offsets: Array = changes @ [self.stretch, self.shear, self.growth]
        return offsets


class Expected(NamedTuple):
    """The scale of a part, and the usual sizes of its changes, before the part is seen."""

    scale: float
    sigmas: Array  # (4,), of size, stretch, shear (parts) and growth (pixels); infinite: unknown

    def deviations(self, shape: PartShape) -> Array:
        """Return the deviations (4,) of a shape's size, stretch, shear and growth."""
        size = shape.pose.scale / self.scale - 1
        return np.array([size, shape.stretch, shape.shear, shape.growth])


class FinePose(NamedTuple):
    """A fitted pose."""

    pose: PixelPose
    covariance: Array  # (4, 4), of x, y (pixels), angle (radians), scale
    score: float  # part of the edges that were seen, by length
    seen: NDArray[np.bool_]  # (N,), segments that were seen
    kept: NDArray[np.bool_]  # (N,), segments that the pose was fitted to
    noise: float  # standard deviation of the pixels, grey levels
    chi_square: float  # chi-square of the kept segments around the pose, per degree of freedom
    reversed: float  # part of the edges that were seen with the other polarity
    blur: float  # median standard deviation of the edges' blur, pixels


def fit_pose(
    levels: NDArray[Any], segments: Segments, bands: Bands, start: PixelPose, use: FineSettings
) -> FinePose | None:
    """Return the best pose near a start that is right within two pixels; None: none fits.

    ``levels`` (H, W) is the picture.
    """
    shape = PartShape(start)
    size = math.inf if use.scaled else SIZE_SIGMA
    sigmas = np.array([size, STRETCH_SIGMA, STRETCH_SIGMA, GROWTH_SIGMA_PX])
    expected = Expected(start.scale, sigmas)
    widened, pixels = 0.0, pixels_in(bands, _matrix(start), levels)
    for number in range(MAX_STEPS):
        if 0 < number < 4:
            pixels = pixels_in(bands, _matrix(shape.pose), levels)
        first = FIRST_BLURS_PX[number] if number < len(FIRST_BLURS_PX) else None
        fit, blurs = _steps(pixels, segments, shape, widened, first)
        rows, weights, _, _ = _equations((fit, blurs), segments, shape.pose, use, number)
        changed = number >= FIRST_CHANGED_STEP
        free = np.array([True, True, use.turned, use.scaled or changed, *[changed] * 3])
        solved = _solve(
            (rows, fit.shifts, weights), free, expected.deviations(shape), expected.sigmas
        )
        if solved is None:
            return None
        move, _ = solved
        shape = shape.moved(move)
        if first is None:
            widened = _widened(widened, fit.widening, float(np.median(blurs)))
        if number >= 4 and float(np.abs(rows @ move).max()) < CONVERGENCE_PX:
            break
    return _result(pixels, segments, shape, widened, use, expected)


def _changes(segments: Segments, scale: float) -> Array:
    """Return the derivatives (N, 3) of the edges' shifts by stretch, shear and growth."""
    (x, y), (u, v) = segments.middles.T, segments.normals.T
    return np.column_stack([scale * (u * x - v * y), scale * (u * y + v * x), np.ones_like(x)])


def _matrix(pose: PixelPose) -> Array:
    """Return the matrix (2, 3) from a model's places to the picture's pixels."""
    cos, sin = pose.scale * math.cos(pose.angle), pose.scale * math.sin(pose.angle)
    return np.array([[cos, -sin, pose.x], [sin, cos, pose.y]])


def _steps(
    pixels: BandPixels,
    segments: Segments,
    shape: PartShape,
    widened: float,
    first: float | None,
    ground: Ground | None = None,
    noise: float = 0.0,
) -> tuple[StepFit, Array]:
    """Fit a step of brightness in each band of a part; return the fits, and the blurs used."""
    places, blurs = _places(pixels, segments, shape, widened)
    if first is not None:
        blurs = np.full_like(blurs, first)
    count, blurs_of_pixels = len(segments.halves), blurs[pixels.owners]
    if ground is None:
        return fit_bands(places[0], blurs_of_pixels, pixels, count), blurs
    return fit_on_ground(places, blurs_of_pixels, pixels, ground, noise), blurs


def _places(
    pixels: BandPixels, segments: Segments, shape: PartShape, widened: float
) -> tuple[tuple[Array, Array], Array]:
    """Return the places of pixels across and along their edges (P,), and the edges' blurs (N,)."""
    pose = shape.pose
    across, along = segments.places(pose.from_picture(pixels.points), pixels.owners)
    blurs = segments.blurs * pose.scale
    blurs = np.sqrt(np.maximum(blurs**2 + widened, MIN_BLUR_PX**2))
    moved = pose.scale * segments.moved_by(widened / pose.scale**2) + shape.offsets(segments)
    return (pose.scale * across - moved[pixels.owners], pose.scale * along), blurs


def _widened(widened: float, growth: float, blur: float) -> float:
    """Return the new difference between the squared blurs of the picture and the taught one."""
    grown = blur * (1 + min(max(growth, -0.3), 0.3))
    widened += min(grown, MAX_BLUR_PX) ** 2 - blur**2
    return min(max(widened, -(blur**2)), MAX_BLUR_PX**2)


def _equations(
    steps: tuple[StepFit, Array],
    segments: Segments,
    pose: PixelPose,
    use: FineSettings,
    number: int,
) -> tuple[Array, Array, float, NDArray[np.bool_]]:
    """Return rows (N, 7) and weights (N,) of the equations, the noise, and the mask of edges."""
    fit, blurs = steps
    edges, noise = _edges(fit, use)
    cos, sin = math.cos(pose.angle), math.sin(pose.angle)
    turn = np.array([[cos, sin], [-sin, cos]])
    normals = segments.normals @ turn
    arms = pose.scale * segments.middles @ turn
    crossed = arms[:, 0] * normals[:, 1] - arms[:, 1] * normals[:, 0]
    sized = (normals * arms).sum(axis=1)
    rows = np.column_stack([normals, crossed, sized, _changes(segments, pose.scale)])
    sigmas = _sigmas(fit, segments, pose, noise, blurs)
    weights = np.where(edges & np.isfinite(sigmas), 1 / np.maximum(sigmas, 1e-6) ** 2, 0.0)
    if number < 3:  # far from the solution, noisy edges count like others
        weights = (weights > 0).astype(np.float64)
    return rows, weights, noise, edges


def _edges(fit: StepFit, use: FineSettings) -> tuple[NDArray[np.bool_], float]:
    """Return a mask of the steps that are edges (N,), and the noise of their pixels."""
    finite = np.isfinite(fit.sigmas)
    noise = _noise(fit, finite)
    heights = np.abs(fit.heights) if use.any_polarity else fit.heights
    tall = heights >= np.maximum(use.contrast, EDGE_SIGNIFICANCE * noise * fit.height_sigmas)
    return finite & tall & (_misfits(fit, use) <= 1), noise


def _misfits(fit: StepFit, use: FineSettings) -> Array:
    """Return the RMS around each step beyond the noise, as a part of the largest allowed one."""
    # the scatter of a band's pixels varies by chance
    noise = use.noise**2 * (1 + 3 * np.sqrt(2 / fit.freedoms))
    beyond = np.sqrt(np.maximum(fit.variances - noise, 0.0))
    misfits: Array = beyond / np.maximum(MAX_MISFIT * np.abs(fit.heights), 1e-6)
    return misfits


def _noise(fit: StepFit, finite: NDArray[np.bool_]) -> float:
    """Return the pixels' noise: the median over the bands, most of which have no misfit."""
    if not finite.any():
        return ROUNDING
    freedom = float(np.median(fit.freedoms[finite]))
    median = float(np.median(fit.variances[finite])) / (1 - 2 / (9 * freedom)) ** 3
    return max(math.sqrt(median), ROUNDING)


def _sigmas(fit: StepFit, segments: Segments, pose: PixelPose, noise: float, blurs: Array) -> Array:
    """Return the standard deviation of each shift, from both pictures' noise and from misfits."""
    # a larger scatter than by chance shows a structure besides the step
    beyond = fit.variances > noise**2 * (1 + 2.5 * np.sqrt(2 / fit.freedoms))
    variances = np.where(beyond, fit.variances, noise**2)
    # the structure may move the edge by its height over the step's steepest slope
    steepest = np.maximum(np.abs(fit.heights), 1e-6) / (math.sqrt(2 * math.pi) * blurs)
    misfit = np.where(beyond, fit.variances - noise**2, 0.0) / steepest**2
    return np.sqrt(variances * fit.sigmas**2 + misfit + (pose.scale * segments.sigmas) ** 2)


Equations = tuple["Array", "Array", "Array"]
"""Rows (N, 7), shifts (N,) and weights (N,)."""


def _solve(
    equations: Equations, free: NDArray[np.bool_], deviations: Array, sigmas: Array
) -> tuple[Array, Array] | None:
    """Return the robust solution (7,) and its covariance (7, 7); None: too few edges.

    ``deviations`` (4,): how far size, stretch, shear and growth are off their expected values, by
    ``sigmas``.
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


def _result(
    pixels: BandPixels,
    segments: Segments,
    shape: PartShape,
    widened: float,
    use: FineSettings,
    expected: Expected,
) -> FinePose | None:
    """Return the final pose, its covariance and its score; None: too few edges agree."""
    free = np.array([True, True, use.turned, True, True, True, True])
    fit, blurs = steps = _steps(pixels, segments, shape, widened, None)
    rows, weights, noise, edges = _equations(steps, segments, shape.pose, use, MAX_STEPS)
    # an edge counts more the nearer it is to its place, and the better it fits a step
    distances = np.abs(fit.shifts) / (
        SCORED_DISTANCE_PX + MAX_DEVIATION_SIGMAS * np.minimum(_of_weights(weights), 1.0)
    )
    seen = edges & (distances <= 1)
    lengths = segments.halves / segments.halves.sum()
    score = float((lengths * (1 - distances**2) * (1 - _misfits(fit, use) ** 2))[seen].sum())
    wrong = (fit.heights < -use.contrast) & (not use.any_polarity)
    ground = None
    if score >= use.least_score:
        places, _ = _places(pixels, segments, shape, widened)
        ground = ground_beside(places, blurs[pixels.owners], pixels, segments, seen)
        for _ in range(GROUND_STEPS if ground is not None else 0):
            fit, _ = _steps(pixels, segments, shape, widened, None, ground, noise)
            again = _equations((fit, blurs), segments, shape.pose, use, MAX_STEPS)
            rows, weights, noise = again[0], np.where(seen, again[1], 0.0), again[2]
            weighted = rows, fit.shifts, weights
            solved = _solve(weighted, free, expected.deviations(shape), expected.sigmas)
            if solved is None:
                return None
            shape = shape.moved(solved[0])
    weighted = rows, fit.shifts, np.where(seen, weights, 0.0)
    settled = _settled(weighted, free, expected.deviations(shape), expected.sigmas)
    if settled is None:
        return None
    move, covariance, used, chi_square = settled
    left = (fit.shifts - rows @ move) * np.sqrt(weights)
    covariance = covariance * common_error(segments, left, used, sure=ground is not None)
    pose = shape.moved(move).pose
    if covariance[3, 3] == 0:
        pose = pose._replace(scale=expected.scale)
    covariance[3] *= pose.scale
    covariance[:, 3] *= pose.scale
    if not use.turned:
        covariance[2, 2] = UNKNOWN_ANGLE**2
    return FinePose(
        pose._replace(angle=math.remainder(pose.angle, 2 * math.pi)),
        covariance,
        score,
        seen,
        used,
        noise,
        chi_square,
        float(lengths[wrong].sum()),
        float(np.median(blurs)),
    )


def _settled(
    equations: Equations, free: NDArray[np.bool_], deviations: Array, sigmas: Array
) -> tuple[Array, Array, NDArray[np.bool_], float] | None:
    """Return the last move (7,), the pose's covariance (4, 4), the used segments and chi-square.

    Chi-square is per degree of freedom. None: too few segments agree.
    """
    rows, shifts, weights = equations
    away = np.abs(shifts) * np.sqrt(weights)
    used, freedom, chi_square, spread = weights > 0, 1, 1.0, 1.0
    if used.any():  # if the whole part differs from the taught one, as in too much light
        spread = max(1.4826 * float(np.median(away[used])), 1.0)
    for _ in range(3):
        used = (weights > 0) & (away <= MAX_DEVIATION_SIGMAS * spread)
        if np.count_nonzero(used) < MIN_SEGMENTS:
            return None
        freedom = max(int(used.sum()) - 4, 1)
        chi_square = float((away[used] ** 2).sum()) / freedom
        spread = max(math.sqrt(chi_square), 1.0)
    misfit = chi_square > 1 + 4 * math.sqrt(2 / freedom)  # the part differs from the taught one
    weighted = rows[used], shifts[used], weights[used]
    solved = _changed(weighted, free, deviations, sigmas, max(chi_square, 1.0))
    if solved is None:
        return None
    move, covariance = solved
    return move, covariance[:4, :4] * (chi_square if misfit else 1.0), used, chi_square


def _changed(
    equations: Equations,
    free: NDArray[np.bool_],
    deviations: Array,
    sigmas: Array,
    chi_square: float,
) -> tuple[Array, Array] | None:
    """Return the solution in which the part has its expected shape, as far as that is allowed.

    A change is fitted only if it is significant; its size then bounds it in the second fit.
    """
    rows, shifts, weights = equations
    solved = _least_squares(equations, free, deviations, sigmas)
    if solved is None:
        return None
    move, covariance = solved
    by_edges = 1 / np.maximum(1 / np.diag(covariance)[3:] - 1 / sigmas**2, 1e-12)
    beyond = (deviations + move[3:]) ** 2 - CHANGE_SIGNIFICANCE**2 * chi_square * by_edges
    none = (beyond <= 0) & np.isfinite(sigmas)
    known = np.minimum(np.sqrt(np.maximum(beyond, 1e-12)), sigmas)
    known = np.where(np.isfinite(sigmas), known, sigmas)
    shifts = shifts + rows[:, 3:] @ np.where(none, deviations, 0.0)
    freed = free.copy()
    freed[3:] &= ~none
    solved = _least_squares((rows, shifts, weights), freed, deviations, known)
    if solved is not None:
        solved[0][3:][none] = -deviations[none]
    return solved


def _of_weights(weights: Array) -> Array:
    """Return the standard deviations of weights."""
    return np.where(weights > 0, 1 / np.sqrt(np.maximum(weights, 1e-12)), np.inf)
