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
"""Steps of a fit beside a ground that is not of one level."""

STILL_PX: Final = 2e-4
"""Pixels that no segment moves by any more when a fit has come to rest."""

MAX_SHIFT_PX: Final = 2.0
"""Pixels that a segment says in one step at most that it should move."""

MAX_BLUR_PX: Final = 4.0
"""Blur of a picture's edges up to which they are fitted, in pixels."""

CUT: Final = 4.0
"""Standard deviations beside its place from which on a segment is another edge."""

EDGE_SIGNIFICANCE: Final = 4.0
"""Least height of an edge, standard deviations of the height."""

SEEN_PX: Final = 1.0
"""Pixels beside its place, besides the noise, from which on a segment counts nothing as seen."""

MAX_MISFIT: Final = 0.3
"""Rms about a step beyond the noise, in parts of the edge's height, up to which it is an edge."""

MIN_SEEN: Final = 6
"""Least number of segments that a pose is worked out from."""

UNKNOWN_ANGLE: Final = math.pi / math.sqrt(3)
"""Standard deviation of an angle of which nothing is known, in radians."""

SIZE_SIGMA: Final = 0.02
"""Standard deviation, in parts of its size, of a part that is looked for in one size only: another
height or another camera makes it larger or smaller, and a pose of the wrong size is off."""

STRETCH_SIGMA: Final = 0.01
"""Standard deviation of what a part is longer in one direction and shorter across, in parts of its
size, as seen by a camera that is tilted."""

GROWTH_SIGMA_PX: Final = 0.3
"""Standard deviation of what all edges lie nearer to their brighter side, pixels: too much light,
or a camera that tells bright levels less well, makes what is bright larger."""

CHANGE_SIGNIFICANCE: Final = 3.0
"""Standard deviations by which the edges must show a change of the part, or there is none. With 1.0
a bolt's errors were 1.32 times the bound, since each change that is fitted costs certainty."""

FIRST_CHANGED_STEP: Final = 2
"""Number of the first step that fits what may differ from the taught part, too."""

MAX_INVERSE: Final = 1e8
"""Largest element of the inverse of the scaled equations; above it the edges leave a pose open."""


class FineSettings(NamedTuple):
    """Settings of a fit."""

    contrast: Array  # (N,), grey levels from the darker to the brighter side at least
    noise: float  # standard deviation of the picture's noise, grey levels
    any_polarity: bool = False
    scaled: bool = False  # whether any scale is allowed; else only one near the start's
    least_score: float = 0.0  # ground beside the edges, for a pose that it changes
    turned: bool = True  # whether the angle is fitted; for a round part it is not


class PartShape(NamedTuple):
    """The pose of a part, and how else it differs from the taught one."""

    pose: PixelPose
    stretch: float = 0.0  # longer along the taught x and shorter along y, in parts
    shear: float = 0.0  # shear: the stretch along the diagonals
    growth: float = 0.0  # pixels of the picture that edges are nearer to their brighter side

    def moved(self, move: Array) -> PartShape:
        """Return the shape after a move (7,)."""
        x, y, angle, scale, stretch, shear, growth = move.tolist()
        old = self.pose
        pose = PixelPose(old.x + x, old.y + y, old.angle + angle, old.scale * (1 + scale))
        return PartShape(pose, self.stretch + stretch, self.shear + shear, self.growth + growth)

    def offsets(self, segments: Segments) -> Array:
        """Return the shifts of the edges across by the changes, (N,), pixels of the picture."""
        changes = _changes(segments, self.pose.scale)
        offsets: Array = changes @ [self.stretch, self.shear, self.growth]
        return offsets


class Expected(NamedTuple):
    """The scale of a part, and how little it is changed, as known before it is seen."""

    scale: float
    sigmas: Array  # (4,), of size, stretch, shear (parts) and growth (pixels); infinite: unknown

    def off(self, shape: PartShape) -> Array:
        """Return the differences (4,) of a shape from what is expected."""
        size = shape.pose.scale / self.scale - 1
        return np.array([size, shape.stretch, shape.shear, shape.growth])


class FinePose(NamedTuple):
    """A fitted pose."""

    pose: PixelPose
    covariance: Array  # (4, 4), of x, y (pixels), angle (radians), scale
    score: float  # part of the edges that were seen, by length
    seen: NDArray[np.bool_]  # (N,), segments that were seen
    kept: NDArray[np.bool_]  # (N,), segments that the pose follows from
    noise: float  # standard deviation of the pixels, grey levels
    chi_square: float  # chi-square of the kept segments around the pose, per degree of freedom
    reversed: float  # part of the edges that are there with the other polarity
    blur: float  # median standard deviation of the edges' blur, pixels


def fit_pose(
    levels: NDArray[Any], segments: Segments, bands: Bands, start: PixelPose, use: FineSettings
) -> FinePose | None:
    """Return the pose that fits best, from one that is known to two pixels; None: there is none.

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
        solved = _solve((rows, fit.shifts, weights), free, expected.off(shape), expected.sigmas)
        if solved is None:
            return None
        move, _ = solved
        shape = shape.moved(move)
        if first is None:
            widened = _widened(widened, fit.widening, float(np.median(blurs)))
        if number >= 4 and float(np.abs(rows @ move).max()) < STILL_PX:
            break
    return _result(pixels, segments, shape, widened, use, expected)


def _changes(segments: Segments, scale: float) -> Array:
    """Return the shifts (N, 3) of edges across by one of stretch, shear and growth each."""
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
    """Return the steps in all bands of a part, and the blurs that they were fitted with."""
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
    """Return the variance that the picture's blur has beyond that of the taught picture."""
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
    """Return the rows (N, 7) and weights (N,) of the steps, the noise, and which are edges."""
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
    if number < 3:  # before the pose is near, what is noisy says as much as what is not
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
    # by chance a band's pixels stray more or less than others
    noise = use.noise**2 * (1 + 3 * np.sqrt(2 / fit.freedoms))
    beyond = np.sqrt(np.maximum(fit.variances - noise, 0.0))
    misfits: Array = beyond / np.maximum(MAX_MISFIT * np.abs(fit.heights), 1e-6)
    return misfits


def _noise(fit: StepFit, finite: NDArray[np.bool_]) -> float:
    """Return the standard deviation of the bands' pixels; most of the bands have nothing else."""
    if not finite.any():
        return ROUNDING
    freedom = float(np.median(fit.freedoms[finite]))
    median = float(np.median(fit.variances[finite])) / (1 - 2 / (9 * freedom)) ** 3
    return max(math.sqrt(median), ROUNDING)


def _sigmas(fit: StepFit, segments: Segments, pose: PixelPose, noise: float, blurs: Array) -> Array:
    """Return the standard deviation of each shift: of both pictures' noise, and of a misfit."""
    # a band whose pixels stray more than by chance from a step has more than noise in it
    beyond = fit.variances > noise**2 * (1 + 2.5 * np.sqrt(2 / fit.freedoms))
    variances = np.where(beyond, fit.variances, noise**2)
    # and what it has may move the edge, by as much as it is at the steepest place
    steepest = np.maximum(np.abs(fit.heights), 1e-6) / (math.sqrt(2 * math.pi) * blurs)
    misfit = np.where(beyond, fit.variances - noise**2, 0.0) / steepest**2
    return np.sqrt(variances * fit.sigmas**2 + misfit + (pose.scale * segments.sigmas) ** 2)


Equations = tuple["Array", "Array", "Array"]
"""Rows (N, 7), shifts (N,) and weights (N,)."""


def _solve(
    equations: Equations, free: NDArray[np.bool_], residuals: Array, sigmas: Array
) -> tuple[Array, Array] | None:
    """Return the robust solution (7,) and its covariance (7, 7); None: too little is seen.

    ``residuals`` (4,): how far size, stretch, shear and growth are off their expected values, by
    ``sigmas``.
    """
    rows, shifts, weights = equations
    used = weights > 0
    if np.count_nonzero(used) < MIN_SEEN:
        return None
    a, y, w = rows[used], shifts[used].clip(-MAX_SHIFT_PX, MAX_SHIFT_PX), weights[used]
    robust = np.ones_like(w)
    for _ in range(4):
        solved = _least_squares((a, y, w * robust), free, residuals, sigmas)
        if solved is None:
            return None
        scaled = (y - a @ solved[0]) * np.sqrt(w)
        spread = max(1.4826 * float(np.median(np.abs(scaled))), 0.5)
        robust = np.maximum(1 - (scaled / (CUT * 1.5 * spread)) ** 2, 0.0) ** 2
    return _least_squares((a, y, w * robust), free, residuals, sigmas)


def _least_squares(
    equations: Equations, free: NDArray[np.bool_], residuals: Array, sigmas: Array
) -> tuple[Array, Array] | None:
    rows, values, weights = equations
    weighted = rows * weights[:, None]
    square, right = rows.T @ weighted, weighted.T @ values
    square[range(3, 7), range(3, 7)] += 1 / sigmas**2
    right[3:] -= residuals / sigmas**2
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
    """Return the pose, with the brightness steps along its outline."""
    free = np.array([True, True, use.turned, True, True, True, True])
    fit, blurs = steps = _steps(pixels, segments, shape, widened, None)
    rows, weights, noise, edges = _equations(steps, segments, shape.pose, use, MAX_STEPS)
    # as much of each edge counts as it is where it should be, and a step
    deviations = np.abs(fit.shifts) / (SEEN_PX + CUT * np.minimum(_of_weights(weights), 1.0))
    seen = edges & (deviations <= 1)
    lengths = segments.halves / segments.halves.sum()
    score = float((lengths * (1 - deviations**2) * (1 - _misfits(fit, use) ** 2))[seen].sum())
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
            solved = _solve(weighted, free, expected.off(shape), expected.sigmas)
            if solved is None:
                return None
            shape = shape.moved(solved[0])
    weighted = rows, fit.shifts, np.where(seen, weights, 0.0)
    settled = _settled(weighted, free, expected.off(shape), expected.sigmas)
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
    equations: Equations, free: NDArray[np.bool_], residuals: Array, sigmas: Array
) -> tuple[Array, Array, NDArray[np.bool_], float] | None:
    """Return the last move (7,), the pose's covariance (4, 4), and the segments it follows from.

    Besides, the squares of their shifts in parts of what they may have; None: too few agree.
    """
    rows, shifts, weights = equations
    away = np.abs(shifts) * np.sqrt(weights)
    used, freedom, chi_square, spread = weights > 0, 1, 1.0, 1.0
    if used.any():  # if the whole part differs from the taught one, as in too much light
        spread = max(1.4826 * float(np.median(away[used])), 1.0)
    for _ in range(3):
        used = (weights > 0) & (away <= CUT * spread)
        if np.count_nonzero(used) < MIN_SEEN:
            return None
        freedom = max(int(used.sum()) - 4, 1)
        chi_square = float((away[used] ** 2).sum()) / freedom
        spread = max(math.sqrt(chi_square), 1.0)
    misfit = chi_square > 1 + 4 * math.sqrt(2 / freedom)  # the part is not quite the taught one
    weighted = rows[used], shifts[used], weights[used]
    solved = _changed(weighted, free, residuals, sigmas, max(chi_square, 1.0))
    if solved is None:
        return None
    move, covariance = solved
    return move, covariance[:4, :4] * (chi_square if misfit else 1.0), used, chi_square


def _changed(
    equations: Equations,
    free: NDArray[np.bool_],
    residuals: Array,
    sigmas: Array,
    chi_square: float,
) -> tuple[Array, Array] | None:
    """Return the solution in which the part has its expected shape, as far as that is allowed.

    What the edges say of a change beyond their own error says how large that change may be.
    """
    rows, shifts, weights = equations
    solved = _least_squares(equations, free, residuals, sigmas)
    if solved is None:
        return None
    move, covariance = solved
    by_edges = 1 / np.maximum(1 / np.diag(covariance)[3:] - 1 / sigmas**2, 1e-12)
    beyond = (residuals + move[3:]) ** 2 - CHANGE_SIGNIFICANCE**2 * chi_square * by_edges
    none = (beyond <= 0) & np.isfinite(sigmas)
    known = np.minimum(np.sqrt(np.maximum(beyond, 1e-12)), sigmas)
    known = np.where(np.isfinite(sigmas), known, sigmas)
    shifts = shifts + rows[:, 3:] @ np.where(none, residuals, 0.0)
    freed = free.copy()
    freed[3:] &= ~none
    solved = _least_squares((rows, shifts, weights), freed, residuals, known)
    if solved is not None:
        solved[0][3:][none] = -residuals[none]
    return solved


def _of_weights(weights: Array) -> Array:
    """Return the standard deviations of weights."""
    return np.where(weights > 0, 1 / np.sqrt(np.maximum(weights, 1e-12)), np.inf)
