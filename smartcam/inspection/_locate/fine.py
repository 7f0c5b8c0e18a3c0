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
"""Standard deviations of its height that an edge has at least."""

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

FIRST_SIZED_STEP: Final = 2
"""Number of the first step that fits the size, too."""

MAX_INVERSE: Final = 1e8
"""Largest element of the inverse of the scaled equations; above it the edges leave a pose open."""


class FineSettings(NamedTuple):
    """Settings of a fit."""

    contrast: Array  # (N,), grey levels from the darker to the brighter side at least
    noise: float  # standard deviation of the picture's noise, grey levels
    any_polarity: bool = False
    scaled: bool = False  # whether the scale is anything; else it is near that of the start
    least_score: float = 0.0  # of a pose whose ground matters
    turned: bool = True  # whether the angle is fitted; that of a round part is not


class SizePrior(NamedTuple):
    """What is known of a part's size before it is seen."""

    scale: float  # that is expected
    sigma: float  # standard deviation of the scale, in parts of it; infinite: nothing is known

    def off(self, pose: PixelPose) -> float:
        """Return how much larger a pose is than what is expected, in parts of the scale."""
        return pose.scale / self.scale - 1


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
    pose, free = start, np.array([True, True, use.turned, use.scaled])
    size = SizePrior(start.scale, math.inf if use.scaled else SIZE_SIGMA)
    widened, pixels = 0.0, pixels_in(bands, _matrix(start), levels)
    for number in range(MAX_STEPS):
        if 0 < number < 4:
            pixels = pixels_in(bands, _matrix(pose), levels)
        first = FIRST_BLURS_PX[number] if number < len(FIRST_BLURS_PX) else None
        fit, blurs = _steps(pixels, segments, pose, widened, first)
        rows, weights, _, _ = _equations((fit, blurs), segments, pose, use, number)
        free[3] = use.scaled or number >= FIRST_SIZED_STEP
        solved = _solve(rows, fit.shifts, weights, free, (size.off(pose), size.sigma))
        if solved is None:
            return None
        move, _ = solved
        pose = _moved(pose, move)
        if first is None:
            widened = _widened(widened, fit.widening, float(np.median(blurs)))
        if number >= 4 and float(np.abs(rows @ move).max()) < STILL_PX:
            break
    return _result(pixels, segments, pose, widened, use, size)


def _moved(pose: PixelPose, move: Array) -> PixelPose:
    x, y, angle, scale = move.tolist()
    return PixelPose(pose.x + x, pose.y + y, pose.angle + angle, pose.scale * (1 + scale))


def _matrix(pose: PixelPose) -> Array:
    """Return the matrix (2, 3) from a model's places to the picture's pixels."""
    cos, sin = pose.scale * math.cos(pose.angle), pose.scale * math.sin(pose.angle)
    return np.array([[cos, -sin, pose.x], [sin, cos, pose.y]])


def _steps(
    pixels: BandPixels,
    segments: Segments,
    pose: PixelPose,
    widened: float,
    first: float | None,
    ground: Ground | None = None,
    noise: float = 0.0,
) -> tuple[StepFit, Array]:
    """Return the steps in all bands at a pose, and the blurs that they were fitted with."""
    places, blurs = _places(pixels, segments, pose, widened)
    if first is not None:
        blurs = np.full_like(blurs, first)
    count, own = len(segments.halves), blurs[pixels.owners]
    if ground is None:
        return fit_bands(places[0], own, pixels, count), blurs
    return fit_on_ground(places, own, pixels, ground, noise), blurs


def _places(
    pixels: BandPixels, segments: Segments, pose: PixelPose, widened: float
) -> tuple[tuple[Array, Array], Array]:
    """Return the places of pixels across and along their edges (P,), and the edges' blurs (N,)."""
    across, along = segments.places(pose.from_picture(pixels.points), pixels.owners)
    blurs = segments.blurs * pose.scale
    blurs = np.sqrt(np.maximum(blurs**2 + widened, MIN_BLUR_PX**2))
    moved = segments.moved_by(widened / pose.scale**2)
    return (pose.scale * (across - moved[pixels.owners]), pose.scale * along), blurs


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
    """Return the rows (N, 4) and weights (N,) of the steps, the noise, and which are edges."""
    fit, blurs = steps
    edges, noise = _edges(fit, use)
    cos, sin = math.cos(pose.angle), math.sin(pose.angle)
    turn = np.array([[cos, sin], [-sin, cos]])
    normals = segments.normals @ turn
    arms = pose.scale * segments.middles @ turn
    crossed = arms[:, 0] * normals[:, 1] - arms[:, 1] * normals[:, 0]
    rows = np.column_stack([normals, crossed, (normals * arms).sum(axis=1)])
    sigmas = _sigmas(fit, segments, pose, noise, blurs)
    weights = np.where(edges & np.isfinite(sigmas), 1 / np.maximum(sigmas, 1e-6) ** 2, 0.0)
    if number < 3:  # before the pose is near, what is noisy says as much as what is not
        weights = (weights > 0).astype(np.float64)
    return rows, weights, noise, edges


def _edges(fit: StepFit, use: FineSettings) -> tuple[NDArray[np.bool_], float]:
    """Return a mask of the steps that are edges (N,), and the noise of their pixels."""
    there = np.isfinite(fit.sigmas)
    noise = _noise(fit, there)
    heights = np.abs(fit.heights) if use.any_polarity else fit.heights
    tall = heights >= np.maximum(use.contrast, EDGE_SIGNIFICANCE * noise * fit.height_sigmas)
    return there & tall & (_misfits(fit, use) <= 1), noise


def _misfits(fit: StepFit, use: FineSettings) -> Array:
    """Return the rms about each step beyond the noise, in parts of what an edge may have."""
    # by chance a band's pixels stray more or less than others
    noise = use.noise**2 * (1 + 3 * np.sqrt(2 / fit.freedoms))
    beyond = np.sqrt(np.maximum(fit.variances - noise, 0.0))
    misfits: Array = beyond / np.maximum(MAX_MISFIT * np.abs(fit.heights), 1e-6)
    return misfits


def _noise(fit: StepFit, there: NDArray[np.bool_]) -> float:
    """Return the standard deviation of the bands' pixels; most of the bands have nothing else."""
    if not there.any():
        return ROUNDING
    freedom = float(np.median(fit.freedoms[there]))
    median = float(np.median(fit.variances[there])) / (1 - 2 / (9 * freedom)) ** 3
    return max(math.sqrt(median), ROUNDING)


def _sigmas(fit: StepFit, segments: Segments, pose: PixelPose, noise: float, blurs: Array) -> Array:
    """Return the standard deviation of each shift: of both pictures' noise, and of a misfit."""
    # a band whose pixels stray more than by chance from a step has more than noise in it
    beyond = fit.variances > noise**2 * (1 + 2.5 * np.sqrt(2 / fit.freedoms))
    own = np.where(beyond, fit.variances, noise**2)
    # and what it has may move the edge, by as much as it is at the steepest place
    steepest = np.maximum(np.abs(fit.heights), 1e-6) / (math.sqrt(2 * math.pi) * blurs)
    misfit = np.where(beyond, fit.variances - noise**2, 0.0) / steepest**2
    return np.sqrt(own * fit.sigmas**2 + misfit + (pose.scale * segments.sigmas) ** 2)


def _solve(
    rows: Array,
    shifts: Array,
    weights: Array,
    free: NDArray[np.bool_],
    size: tuple[float, float],
) -> tuple[Array, Array] | None:
    """Return the robust solution (4,) and its covariance (4, 4); None: too little is seen.

    ``size``: how much larger the pose is than expected, and the standard deviation of that.
    """
    used = weights > 0
    if np.count_nonzero(used) < MIN_SEEN:
        return None
    a, y, w = rows[used], shifts[used].clip(-MAX_SHIFT_PX, MAX_SHIFT_PX), weights[used]
    robust = np.ones_like(w)
    for _ in range(4):
        solved = _least_squares(a, y, w * robust, free, size)
        if solved is None:
            return None
        scaled = (y - a @ solved[0]) * np.sqrt(w)
        spread = max(1.4826 * float(np.median(np.abs(scaled))), 0.5)
        robust = np.maximum(1 - (scaled / (CUT * 1.5 * spread)) ** 2, 0.0) ** 2
    return _least_squares(a, y, w * robust, free, size)


def _least_squares(
    rows: Array,
    values: Array,
    weights: Array,
    free: NDArray[np.bool_],
    size: tuple[float, float],
) -> tuple[Array, Array] | None:
    root = np.sqrt(weights)
    a, right = rows * root[:, None], values * root
    square, right = a.T @ a, a.T @ right
    off, sigma = size
    square[3, 3] += 1 / sigma**2
    right[3] -= off / sigma**2
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
    found, covariance = np.zeros(4), np.zeros((4, 4))
    found[free] = inverse @ right
    covariance[np.ix_(free, free)] = inverse
    return found, covariance


def _result(
    pixels: BandPixels,
    segments: Segments,
    pose: PixelPose,
    widened: float,
    use: FineSettings,
    size: SizePrior,
) -> FinePose | None:
    """Return the pose with what the steps at it say."""
    free = np.array([True, True, use.turned, True])
    fit, blurs = steps = _steps(pixels, segments, pose, widened, None)
    rows, weights, noise, edges = _equations(steps, segments, pose, use, MAX_STEPS)
    # as much of each edge counts as it is where it should be, and a step
    off = np.abs(fit.shifts) / (SEEN_PX + CUT * np.minimum(_of_weights(weights), 1.0))
    seen = edges & (off <= 1)
    lengths = segments.halves / segments.halves.sum()
    score = float((lengths * (1 - off**2) * (1 - _misfits(fit, use) ** 2))[seen].sum())
    wrong = (fit.heights < -use.contrast) & (not use.any_polarity)
    ground = None
    if score >= use.least_score:
        places, _ = _places(pixels, segments, pose, widened)
        ground = ground_beside(places, blurs[pixels.owners], pixels, segments, seen)
        for _ in range(GROUND_STEPS if ground is not None else 0):
            fit, _ = _steps(pixels, segments, pose, widened, None, ground, noise)
            again = _equations((fit, blurs), segments, pose, use, MAX_STEPS)
            rows, weights, noise = again[0], np.where(seen, again[1], 0.0), again[2]
            solved = _solve(rows, fit.shifts, weights, free, (size.off(pose), size.sigma))
            if solved is None:
                return None
            pose = _moved(pose, solved[0])
    settled = _settled(
        (rows, fit.shifts, np.where(seen, weights, 0.0)), free, size.off(pose), size.sigma
    )
    if settled is None:
        return None
    move, covariance, kept, chi_square = settled
    if ground is not None or _is_misfit(chi_square, kept):
        left = (fit.shifts - rows @ move) * np.sqrt(weights)
        covariance = covariance * common_error(segments, left, kept)
    pose = _moved(pose, move)
    if not use.scaled and covariance[3, 3] == 0:
        pose = pose._replace(scale=size.scale)
    covariance[3] *= pose.scale
    covariance[:, 3] *= pose.scale
    if not use.turned:
        covariance[2, 2] = UNKNOWN_ANGLE**2
    return FinePose(
        pose._replace(angle=math.remainder(pose.angle, 2 * math.pi)),
        covariance,
        score,
        seen,
        kept,
        noise,
        chi_square,
        float(lengths[wrong].sum()),
        float(np.median(blurs)),
    )


def _settled(
    equations: tuple[Array, Array, Array], free: NDArray[np.bool_], off: float, sigma: float
) -> tuple[Array, Array, NDArray[np.bool_], float] | None:
    """Return the last move of a pose (4,), its covariance, and the segments that it follows from.

    ``equations`` are rows, shifts and weights; ``off`` is how much larger the pose is than
    expected, by a standard deviation. Besides, the squares of the shifts in parts of what they may
    have; None: too few agree.
    """
    rows, shifts, weights = equations
    away = np.abs(shifts) * np.sqrt(weights)
    kept, freedom, chi_square, spread = weights > 0, 1, 1.0, 1.0
    if kept.any():  # where the whole part is not quite the taught one, as in too much light
        spread = max(1.4826 * float(np.median(away[kept])), 1.0)
    for _ in range(3):
        kept = (weights > 0) & (away <= CUT * spread)
        if np.count_nonzero(kept) < MIN_SEEN:
            return None
        freedom = max(int(kept.sum()) - int(free.sum()), 1)
        chi_square = float((away[kept] ** 2).sum()) / freedom
        spread = max(math.sqrt(chi_square), 1.0)
    misfit = _is_misfit(chi_square, kept)
    solved = _sized((rows[kept], shifts[kept], weights[kept]), free, off, sigma, chi_square)
    if solved is None:
        return None
    move, covariance = solved
    return move, covariance * (chi_square if misfit else 1.0), kept, chi_square


def _is_misfit(chi_square: float, kept: NDArray[np.bool_]) -> bool:
    """Return True if segments lie beside a pose by more than chance, as of another part."""
    return chi_square > 1 + 4 * math.sqrt(2 / max(int(kept.sum()) - 4, 1))


def _sized(
    told: tuple[Array, Array, Array],
    free: NDArray[np.bool_],
    off: float,
    sigma: float,
    chi_square: float,
) -> tuple[Array, Array] | None:
    """Return the solution of rows, shifts and weights, with the size that is expected if it may be.

    What the edges say of the size beyond their own error says how far off the expected one may be.
    """
    rows, shifts, weights = told
    solved = _least_squares(rows, shifts, weights, free, (off, sigma))
    if solved is None or math.isinf(sigma):
        return solved
    move, covariance = solved
    by_edges = 1 / max(1 / float(covariance[3, 3]) - 1 / sigma**2, 1e-12)
    beyond = (off + float(move[3])) ** 2 - max(chi_square, 1.0) * by_edges
    if beyond > 0:
        return _least_squares(rows, shifts, weights, free, (off, min(math.sqrt(beyond), sigma)))
    expected = np.where([True, True, True, False], free, False)
    solved = _least_squares(rows, shifts + off * rows[:, 3], weights, expected, (0.0, math.inf))
    if solved is not None:
        solved[0][3] = -off
    return solved


def _of_weights(weights: Array) -> Array:
    """Return the standard deviations of weights."""
    return np.where(weights > 0, 1 / np.sqrt(np.maximum(weights, 1e-12)), np.inf)
