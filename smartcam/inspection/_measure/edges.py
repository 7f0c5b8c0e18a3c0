"""Find edges in strips of a picture, to a fraction of a pixel and with a standard deviation.

First the profile of grey levels along a strip is filtered by the derivative of a Gaussian; its
peaks are rough places of edges. Then blurred steps are fitted to the strip's pixels, which locates
the edges exactly. The fit does not interpolate pixels, so that the noise of the pixels stays
independent.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from smartcam._extras import load
from smartcam.inspection._measure.steps import StepFits, fit_steps
from smartcam.inspection._measure.strips import (
    Sectors,
    StripPixels,
    Strips,
    count_samples,
    cut_pixels,
    find_strips_inside,
    mean_profiles,
)
from smartcam.inspection._measure.troubles import NotMeasuredError, NoValueReason

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array

Polarity: TypeAlias = Literal["any", "rising", "falling"]
"""``rising``: from dark to light along the strip; ``falling``: from light to dark."""

Choice: TypeAlias = Literal["single", "first", "last", "strongest", "nearest"]
"""Choice among several edges. ``single``: several are an error; ``nearest``: nearest to the middle
of the strip."""

PairChoice: TypeAlias = Literal["single", "first", "last", "strongest", "outermost"]
"""Choice among several pairs of edges. ``single``: there must be exactly two edges."""

PIXEL_VARIANCE: Final = 1 / 12
"""Variance of a uniform distribution over a pixel, which adds to the blur's, pixels^2."""

MIN_EDGE_SIGMAS = 6.0
"""Least height of an edge, in standard deviations of the noise."""

MIN_RELATIVE_HEIGHT = 0.2
"""Least height of an edge, as a share of the strongest edge's in its strip."""

MAX_SAMPLES = 8_000_000
"""Largest number of pixels in all strips of a search together."""

MAX_WIDTH_PX = 250.0
"""Largest width of a strip, pixels."""

MAX_EDGES = 12
"""Largest number of edges that are fitted in a strip; the strongest are used."""

MAX_GROUP_EDGES = 4
"""Largest number of edges with overlapping blurs that are fitted together."""

MAX_GROUP_GAP_PX = 8.0
"""Distance, pixels, below which two edges are fitted together."""

MAX_GROUP_GAP_BLURS = 7.0
"""Distance, in blurs, below which two edges are fitted together."""

MIN_SIDE_BLURS = 1.5
"""Least length of the strip, in blurs, on each side of an edge; the fit needs it to determine the
levels."""

FIT_REACH_BLURS, FIT_REACH_PX = 4.0, 8.0
"""Reach of a fit to each side of an edge, in blurs and in pixels; the larger one is used. Compared
with a reach of 15 pixels, sigma is 8 % larger with 3 pixels, and 2 % larger with 8 pixels. A longer
reach may include other grey levels."""

FIRST_FIT_REACH_PX = 12.0
"""Reach of the first fit to each side of an edge, pixels, while the blur is unknown."""

MAX_SIGMA_PX = 0.5
"""Largest standard deviation of an accepted edge, pixels."""

MAX_RELATIVE_MISFIT = 0.15
"""Largest RMS residual of a step, as a share of the edge's height."""

ACCEPTED_NOISE_RATIO = 3.0
"""Ratio of a step's RMS residual to the picture's noise up to which the step is always accepted."""

MODEL_ERROR_RATIO = 1.3
"""Ratio of a step's RMS residual to the picture's noise above which the edge is not exactly a
blurred step, because of lens, sharpening or compression."""

MAX_SATURATED_SHARE = 0.03
"""Largest share of saturated pixels of an edge: in simulations, more pixels move the edge by more
than a tenth of its standard deviation."""

MIN_UNSATURATED_NOISE = 0.5
"""Noise, in steps of grey levels, below which all pixels of a uniform area may be equal although
they are not saturated."""

MIN_BRIGHT_NOISE_SHARE = 0.5
"""Least ratio of the bright side's noise to the dark side's: a tone curve reduces it."""

MAX_PLATEAU_CHANCE = 1e-4
"""If so many pixels at the largest level would occur without saturation with less than this
probability, they are saturated."""

ROUNDING: Final = math.sqrt(1 / 12)
"""Standard deviation of rounding a grey level, the least noise of a picture."""

MAX_NOISE_SAMPLE = 1 << 16
"""Largest number of pixels from which a picture's noise is estimated."""


@dataclass(frozen=True, kw_only=True)
class EdgeSettings:
    """Settings of the search for edges.

    Attributes:
        polarity: direction of the step.
        smoothing: standard deviation of the Gaussian whose derivative finds edges, pixels.
        contrast: least height of an edge, grey levels.
        max_blur: largest blur of an edge, pixels.
        black: least possible grey level of the picture.
        white: largest possible grey level of the picture.
        allow_saturated: whether edges next to saturated pixels are measured.
        clipped: mask (H, W) of other saturated pixels, such as those of one colour; None: no pixel.
    """

    polarity: Polarity = "any"
    smoothing: float = 1.2
    contrast: float = 10.0
    max_blur: float = 5.0
    black: float = 0.0
    white: float = 255.0
    allow_saturated: bool = False
    clipped: NDArray[np.bool_] | None = field(default=None, repr=False, compare=False)


class Edge(NamedTuple):
    """One edge in a strip."""

    place: float  # place along the strip, from its middle, pixels
    # (K + 1, K + 1), covariance of the places of K edges that were fitted together, and of their
    # tilt, if the noise is one grey level; the K edges share this array
    unit_covariance: Array
    row: int  # row of the edge in the covariance
    noise: float  # standard deviation of the pixels about the fit, grey levels
    height: float  # grey levels after minus before the edge
    blur: float  # standard deviation of the lens' blur, pixels
    tilt: float  # tangent of the edge's rotation in the strip
    model_error: float  # possible error of the place from a wrong model of the edge, pixels

    @property
    def sigma(self) -> float:
        """Standard deviation of the place, pixels."""
        return self.noise * self.unit_sigma

    @property
    def unit_sigma(self) -> float:
        """Standard deviation of the place for noise of one grey level, pixels."""
        return math.sqrt(float(self.unit_covariance[self.row, self.row]))


class JudgedEdge(NamedTuple):
    """An edge, and the reason why its place is not usable; None: the place is usable."""

    edge: Edge
    trouble: NotMeasuredError | None


class StripEdges(NamedTuple):
    """The wanted edges of one strip in their order, or the reason why there are none."""

    edges: tuple[JudgedEdge, ...]
    trouble: NotMeasuredError | None = None
    too_many: NotMeasuredError | None = None  # error if more, weaker edges were not fitted


def noise_of(image: NDArray[np.generic]) -> float:
    """Return the standard deviation of the noise of a picture's pixels (H, W), grey levels.

    It is estimated from the median second difference along both axes, since most differences are
    not at edges.
    """
    height, width = image.shape
    if height < 3 or width < 3:
        return ROUNDING
    step = max(1, math.ceil(height * width / MAX_NOISE_SAMPLE))
    rows = (
        image
        if step == 1
        else np.concatenate([image[i : i + 3] for i in _block_starts(height, step)])
    )
    levels = rows.astype(np.float64)
    row_differences = levels[:-2] - 2 * levels[1:-1] + levels[2:]
    if step > 1:  # rows at the border of two blocks are no neighbours
        row_differences = row_differences[::3]
    differences = row_differences[:, :-2] - 2 * row_differences[:, 1:-1] + row_differences[:, 2:]
    # the squares of the coefficients sum to 36; the median of a normal magnitude is 0.6745 sigma
    return max(float(np.median(np.abs(differences))) / (6 * 0.6745), ROUNDING)


def _block_starts(height: int, step: int) -> range:
    return range(0, height - 2, 3 * step)


def find_edges(
    image: NDArray[np.generic],
    strips: Strips | Sectors,
    settings: EdgeSettings,
    *,
    tilted: bool = False,
) -> list[StripEdges]:
    """Return all edges of each strip with the wanted contrast and polarity.

    ``image`` (H, W), grey levels. ``tilted``: whether edges may be oblique in their strips;
    edges of lines and circles are always at right angles to them.
    """
    strip_count = len(strips.middles)
    lies_inside = find_strips_inside(image, strips)
    edges_of_strips = [
        StripEdges(
            (), NotMeasuredError(NoValueReason.OUTSIDE, "a part of it is outside of the picture")
        )
        for _ in range(strip_count)
    ]
    inside_indices = np.flatnonzero(lies_inside)
    if not len(inside_indices):
        return edges_of_strips
    strips_inside = strips.selected(inside_indices)
    samples = len(inside_indices) * count_samples(strips.length) * count_samples(strips.width)
    if samples > MAX_SAMPLES or strips.width > MAX_WIDTH_PX:
        text = (
            f"{samples} pixels in strips {strips.width:.0f} wide, {MAX_SAMPLES} and "
            f"{MAX_WIDTH_PX:g} can be measured"
        )
        return [
            StripEdges((), NotMeasuredError(NoValueReason.TOO_LARGE, text))
            for _ in range(strip_count)
        ]
    noise = noise_of(_crop(image, strips_inside))
    candidates, candidate_counts = _find_candidates(
        mean_profiles(image, strips_inside), strips_inside, settings, noise
    )
    steps = _fit_twice(image, strips_inside, candidates, settings, noise, tilted=tilted)
    for index, strip_number in enumerate(inside_indices.tolist()):
        own_steps = [step for step in steps if step.strip_index == index]
        has_unfitted = sum(map(len, candidates[index : index + 1])) > len(own_steps)
        edges_of_strips[strip_number] = _judge_steps(
            own_steps,
            settings,
            noise,
            has_unfitted=has_unfitted,
            candidate_count=candidate_counts[index],
        )
    return edges_of_strips


def _judge_steps(
    steps: list[_FittedStep],
    settings: EdgeSettings,
    noise: float,
    *,
    has_unfitted: bool,
    candidate_count: int,
) -> StripEdges:
    """Return the edges of a strip from its fitted steps.

    ``has_unfitted``: whether edges are too near to each other to be fitted. ``candidate_count``:
    number of possible edges, of which only the strongest were fitted.
    """
    if has_unfitted:
        text = f"more than {MAX_GROUP_EDGES} edges that are too near to each other to be separated"
        return StripEdges((), NotMeasuredError(NoValueReason.NO_STEP, text))
    judged = [step for step in steps if is_wanted(step.edge, settings) or not step.converged]
    too_many = None
    # if a fitted edge has too little contrast, the weaker edges have, too
    if candidate_count > MAX_EDGES and all(
        abs(step.edge.height) >= settings.contrast for step in steps
    ):
        text = f"{candidate_count} edges in one strip, {MAX_EDGES} at most can be separated"
        too_many = NotMeasuredError(NoValueReason.SEVERAL_EDGES, text)
    if not judged and too_many is not None:
        return StripEdges((), too_many)
    if not judged:
        kind = {"any": "", "rising": " from dark to light", "falling": " from light to dark"}
        text = f"no edge{kind[settings.polarity]} of {settings.contrast:g} grey levels"
        return StripEdges((), NotMeasuredError(NoValueReason.NO_EDGE, text))
    edges = tuple(JudgedEdge(step.edge, _find_trouble(step, settings, noise)) for step in judged)
    return StripEdges(edges, too_many=too_many)


def _crop(image: NDArray[np.generic], strips: Strips | Sectors) -> NDArray[np.generic]:
    """Return the part of the picture that contains the strips."""
    reach = math.hypot(strips.length, strips.width) / 2 + 1
    low = np.floor(strips.middles.min(axis=0) - reach).astype(int).clip(0)
    high = np.ceil(strips.middles.max(axis=0) + reach).astype(int)
    return image[low[1] : high[1] + 1, low[0] : high[0] + 1]


def _find_candidates(
    levels: Array, strips: Strips | Sectors, settings: EdgeSettings, noise: float
) -> tuple[list[Array], list[int]]:
    """Find possible edges in profiles (N, T).

    Return the places of each strip's strongest edges, ascending, and the number of all its edges.
    """
    smoothing = settings.smoothing
    slopes = _filter_slopes(levels, smoothing)
    # The noise of a mean over the width after a Gaussian's derivative, the integral of whose square
    # is 1 / (4 sqrt(pi) smooth^3).
    profile_noise = noise / math.sqrt(max(strips.width, 1.0))
    slope_noise = profile_noise / math.sqrt(4 * math.sqrt(math.pi) * smoothing**3)
    middle = (levels.shape[1] - 1) / 2
    candidates, counts = [], []
    for row in slopes:
        min_slope = max(
            MIN_EDGE_SIGMAS * slope_noise, 0.5 * MIN_RELATIVE_HEIGHT * float(np.abs(row).max())
        )
        peaks = [(index, side) for side in (row, -row) for index in _find_peaks(side, min_slope)]
        strongest = sorted(peaks, key=lambda peak: -peak[1][peak[0]])[:MAX_EDGES]
        candidates.append(
            np.array(sorted(_refine_peak(side, index) - middle for index, side in strongest))
        )
        counts.append(len(peaks))
    return candidates, counts


def _filter_slopes(levels: Array, smoothing: float) -> Array:
    """Return profiles (N, T) filtered by a Gaussian's derivative, with constant continuation."""
    reach = math.ceil(4 * smoothing)
    offsets = np.arange(-reach, reach + 1, dtype=np.float64)
    kernel: Array = offsets * np.exp(-(offsets**2) / (2 * smoothing**2))
    kernel = kernel / float((kernel * offsets).sum())  # so that a ramp of 1 has the slope 1
    padded = np.pad(levels, ((0, 0), (reach, reach)), mode="edge")
    slopes: Array = np.lib.stride_tricks.sliding_window_view(padded, len(offsets), axis=1) @ kernel
    return slopes


def _find_peaks(slopes: Array, min_height: float) -> list[int]:
    """Return the indices of peaks with a height of ``min_height`` and half of it as prominence."""
    after, before = np.append(slopes[1:], -np.inf), np.insert(slopes[:-1], 0, -np.inf)
    peaks = []
    for index in np.flatnonzero(
        (slopes > before) & (slopes >= after) & (slopes >= min_height)
    ).tolist():
        higher = np.flatnonzero(slopes > slopes[index])
        left = higher[higher < index].max(initial=-1)
        right = higher[higher > index].min(initial=len(slopes))
        # prominence: height above the higher one of the valleys between the peak and higher peaks
        # on both sides; the end of the strip is no valley
        valleys = [slopes[left + 1 : index + 1].min()] if left >= 0 else []
        valleys += [slopes[index:right].min()] if right < len(slopes) else []
        if not valleys or slopes[index] - max(valleys) >= min_height / 2:
            peaks.append(index)
    return peaks


def _refine_peak(slopes: Array, peak: int) -> float:
    """Return the place of the maximum of a parabola through a peak and its neighbours."""
    if not 0 < peak < len(slopes) - 1:
        return float(peak)
    before, top, after = slopes[peak - 1 : peak + 2]
    bend = before - 2 * top + after
    return peak if bend >= 0 else peak + 0.5 * float(before - after) / float(bend)


class _EdgeGroup(NamedTuple):
    """Edges of one strip that are fitted together."""

    strip_index: int  # index among the strips inside the picture
    places: tuple[float, ...]
    low: float  # first place of the fitted pixels along the strip
    high: float  # last place


class _FittedStep(NamedTuple):
    """A fitted step that was not judged yet."""

    strip_index: int  # index among the strips inside the picture
    edge: Edge
    side_length: float  # distance from the edge to the nearer end of its strip, pixels
    rms_residual: float  # grey levels
    saturated: tuple[float, float]  # shares of pixels saturated at black and at white
    converged: bool


def _group_candidates(
    candidates: list[Array], half: float, gaps: Array, reach: Array
) -> list[_EdgeGroup]:
    """Return the groups of edges; ``gaps`` and ``reach`` (N,), pixels, of each strip."""
    groups = []
    for strip_index, places in enumerate(candidates):
        if not len(places):
            continue
        chunks = np.split(places, np.flatnonzero(np.diff(places) >= gaps[strip_index]) + 1)
        between = [float(a[-1] + b[0]) / 2 for a, b in itertools.pairwise(chunks)]
        for chunk, before, after in zip(chunks, [-half, *between], [*between, half], strict=True):
            low = max(float(chunk[0] - reach[strip_index]), before)
            high = min(float(chunk[-1] + reach[strip_index]), after)
            groups.append(_EdgeGroup(strip_index, tuple(chunk.tolist()), low, high))
    return groups


def _fit_twice(
    image: NDArray[np.generic],
    strips: Strips | Sectors,
    candidates: list[Array],
    settings: EdgeSettings,
    noise: float,
    *,
    tilted: bool,
) -> list[_FittedStep]:
    """Fit steps twice: the first fit finds the blur, which sets the reach of the second fit."""
    strip_count, half = len(candidates), strips.length / 2
    gaps, reach = np.full(strip_count, MAX_GROUP_GAP_PX), np.full(strip_count, FIRST_FIT_REACH_PX)
    blurs = np.ones(strip_count)
    groups = _group_candidates(candidates, half, gaps, reach)
    for step in _fit_groups(image, strips, groups, settings, noise, tilted=tilted):
        if step.converged:
            visible_blur = _visible_blur(min(step.edge.blur, settings.max_blur))
            gaps[step.strip_index] = max(gaps[step.strip_index], MAX_GROUP_GAP_BLURS * visible_blur)
            reach[step.strip_index] = FIT_REACH_BLURS * visible_blur + FIT_REACH_PX
            blurs[step.strip_index] = step.edge.blur
    groups = _group_candidates(candidates, half, gaps, reach)
    return _fit_groups(image, strips, groups, settings, noise, tilted=tilted, blurs=blurs)


def _visible_blur(blur: float) -> float:
    """Return an edge's blur in the picture: the lens' blur widened by the pixels' area."""
    return math.sqrt(blur * blur + PIXEL_VARIANCE)


def _fit_groups(
    image: NDArray[np.generic],
    strips: Strips | Sectors,
    groups: list[_EdgeGroup],
    settings: EdgeSettings,
    noise: float,
    *,
    tilted: bool,
    blurs: Array | None = None,
) -> list[_FittedStep]:
    """Return the fitted steps of all groups; ``blurs`` (N,) of the strips; None: unknown."""
    steps = []
    for count in sorted({len(group.places) for group in groups}):
        groups_of_count = [group for group in groups if len(group.places) == count]
        strip_indices = np.array([group.strip_index for group in groups_of_count])
        low, high = (np.array([group[end] for group in groups_of_count]) for end in (2, 3))
        pixels = cut_pixels(image, strips.selected(strip_indices), low, high)
        if count > MAX_GROUP_EDGES:
            continue
        places = np.array([group.places for group in groups_of_count])
        known_blurs = None if blurs is None else blurs[strip_indices]
        fits = fit_steps(pixels, places, tilted=tilted, blurs=known_blurs)
        saturated = np.zeros((len(groups_of_count), 2))
        if blurs is not None and not settings.allow_saturated:
            saturated = _saturated_shares(pixels, settings)
            if settings.clipped is not None:
                masks = cut_pixels(settings.clipped, strips.selected(strip_indices), low, high)
                saturated[:, 1] = np.maximum(
                    saturated[:, 1], _pixel_shares(masks.levels > 0, pixels)
                )
            saturated[:, 1] = np.maximum(saturated[:, 1], _plateau_shares(pixels, fits))
        steps += _as_steps(groups_of_count, fits, pixels, saturated, strips.length / 2, noise)
    return sorted(steps, key=lambda step: (step.strip_index, step.edge.place))


def _as_steps(
    groups: list[_EdgeGroup],
    fits: StepFits,
    pixels: StripPixels,
    saturated: Array,
    half: float,
    noise: float,
) -> list[_FittedStep]:
    counts = np.maximum(pixels.counts, 1.0)
    noises = np.maximum(np.sqrt(fits.variance), ROUNDING)
    covariance = fits.unit_covariance()[:, : fits.step_count + 1, : fits.step_count + 1]
    steps = []
    for i, group in enumerate(groups):
        shared = covariance[i]
        for k, place in enumerate(fits.places[i].tolist()):
            edge = Edge(
                place,
                shared,
                k,
                float(noises[i]),
                float(fits.heights[i, k]),
                float(fits.blurs[i]),
                float(fits.tilts[i]),
                0.0,
            )
            edge = edge._replace(model_error=_model_error(edge, noise))
            steps.append(
                _FittedStep(
                    group.strip_index,
                    edge,
                    half - abs(place),
                    math.sqrt(float(fits.cost[i] / counts[i])),
                    (float(saturated[i, 0]), float(saturated[i, 1])),
                    bool(fits.converged[i]) and group.low <= place <= group.high,
                )
            )
    return steps


def _pixel_shares(mask: NDArray[np.bool_], pixels: StripPixels) -> Array:
    """Return the share (N,) of each strip's pixels in a mask (N, P)."""
    shares: Array = (mask * pixels.weights).sum(axis=1) / np.maximum(pixels.counts, 1.0)
    return shares


def _saturated_shares(pixels: StripPixels, settings: EdgeSettings) -> Array:
    """Return the shares (N, 2) of the pixels saturated at black and at white."""
    black, white = pixels.levels <= settings.black, pixels.levels >= settings.white
    return np.column_stack([_pixel_shares(black, pixels), _pixel_shares(white, pixels)])


def _plateau_shares(pixels: StripPixels, fits: StepFits) -> Array:
    """Return the share (N,) of pixels at the largest level, 0 if this level is not saturation.

    White may be below the largest value of the pixels' type. Black is not tested in this way: dark
    pixels may be equal without saturation, since they have no photon noise.
    """
    levels = np.where(pixels.weights > 0, pixels.levels, -np.inf)
    shares = _pixel_shares(levels == levels.max(axis=1, keepdims=True), pixels)
    for i in np.flatnonzero(shares > MAX_SATURATED_SHARE).tolist():
        if not _is_plateau(pixels.selected(np.array([i])), fits, i):
            shares[i] = 0.0
    return np.where(shares > MAX_SATURATED_SHARE, shares, 0.0)


def _is_plateau(pixels: StripPixels, fits: StepFits, strip: int) -> bool:
    """Return True if noise like the dark side's cannot explain the pixels at the largest level."""
    used = pixels.weights[0] > 0
    levels, across = pixels.levels[0][used], pixels.across[0][used]
    along = pixels.along[0][used] - float(fits.tilts[strip]) * across
    order = np.argsort(fits.places[strip])
    places = fits.places[strip][order]
    heights = np.cumsum([0.0, *fits.heights[strip][order]])
    distance = 2 * _visible_blur(float(fits.blurs[strip])) + 0.5
    is_flat = np.abs(along[:, None] - places).min(axis=1) > distance
    level = np.searchsorted(places, along)
    dark, bright = (
        is_flat & (level == extreme) for extreme in (heights.argmin(), heights.argmax())
    )
    noise = MIN_BRIGHT_NOISE_SHARE * _noise_in_steps(levels[dark], along[dark], across[dark])
    values, counts = np.unique(levels[bright], return_counts=True)
    if noise < MIN_BRIGHT_NOISE_SHARE * MIN_UNSATURATED_NOISE or not len(values):
        return False
    top_count = int(counts[-1])
    if values[-1] < levels.max() or top_count < counts.max():  # saturation has most pixels
        return False
    # With normal noise, the share of pixels at the largest value gives the mean of the level, which
    # is the middle of this value if the share is nearly 1.
    special = load("scipy.special")
    share = min(top_count / len(levels[bright]), float(special.ndtr(0.5 / noise)))
    share_above = float(special.ndtr(special.ndtri(share) - 1 / noise)) / share
    return top_count * math.log1p(-share_above) < math.log(MAX_PLATEAU_CHANCE)


def _noise_in_steps(levels: Array, along: Array, across: Array) -> float:
    """Return the standard deviation of pixels from a fitted plane, in steps, less rounding.

    A step is the least difference of two levels: 16 for levels of 12 bits in 16.
    """
    values = np.unique(levels)
    if len(values) < 2 or len(levels) < 8:
        return 0.0
    design = np.column_stack([np.ones(len(levels)), along, across])
    residuals = levels - design @ np.linalg.lstsq(design, levels, rcond=None)[0]
    differences = np.diff(residuals, 2)  # of neighbours: JPEG's errors are correlated
    variance = min(
        float(residuals @ residuals) / (len(levels) - 3),
        float(differences @ differences) / (6 * len(differences)),
    )
    return math.sqrt(max(variance / float(np.diff(values).min()) ** 2 - ROUNDING**2, 0.0))


def _model_error(edge: Edge, noise: float) -> float:
    """Return the place error, pixels, that explains the residuals that exceed the noise."""
    excess_variance = edge.noise**2 - noise**2
    steepest = abs(edge.height) / (math.sqrt(2 * math.pi) * _visible_blur(edge.blur))
    if edge.noise < MODEL_ERROR_RATIO * noise or steepest == 0.0:
        return 0.0
    return math.sqrt(excess_variance) / steepest


def _find_trouble(
    step: _FittedStep, settings: EdgeSettings, noise: float
) -> NotMeasuredError | None:
    """Return the reason why a step is not a usable edge; None if it is usable."""
    edge, (black, white) = step.edge, step.saturated
    height = abs(edge.height)
    if step.converged and edge.blur > settings.max_blur:
        text = f"the edge is blurred by {edge.blur:.1f} px, {settings.max_blur:g} px are allowed"
        return NotMeasuredError(NoValueReason.BLURRED, text)
    if step.side_length < MIN_SIDE_BLURS * _visible_blur(min(edge.blur, settings.max_blur)) + 0.5:
        text = f"the edge is {max(step.side_length, 0.0):.1f} px from the end of its region"
        return NotMeasuredError(NoValueReason.AT_BORDER, text)
    if not step.converged:
        return NotMeasuredError(
            NoValueReason.NO_STEP, "the grey levels are not those of a blurred step"
        )
    if max(black, white) > MAX_SATURATED_SHARE and not settings.allow_saturated:
        limit, share = ("black", black) if black > white else ("white", white)
        text = f"{100 * share:.0f} % of the pixels beside the edge are {limit} to the limit"
        return NotMeasuredError(NoValueReason.SATURATED, text)
    if (
        step.rms_residual > ACCEPTED_NOISE_RATIO * noise
        and step.rms_residual > MAX_RELATIVE_MISFIT * height
    ):
        text = f"the grey levels are {step.rms_residual:.1f} from a step of {height:.0f}"
        return NotMeasuredError(NoValueReason.NO_STEP, text)
    if edge.sigma > min(MAX_SIGMA_PX, 0.5 * _visible_blur(edge.blur)):
        text = f"noise makes the edge uncertain by {edge.sigma:.2f} px (one standard deviation)"
        return NotMeasuredError(NoValueReason.NOISY, text)
    return None


def is_wanted(edge: Edge, settings: EdgeSettings) -> bool:
    """Return True if an edge has the wanted contrast and polarity."""
    has_polarity = settings.polarity == "any" or (edge.height > 0) == (
        settings.polarity == "rising"
    )
    return has_polarity and abs(edge.height) >= settings.contrast


def choose_edge(strip_edges: StripEdges, which: Choice) -> Edge:
    """Return the chosen edge; raise NotMeasuredError if there is none, or no clear choice."""
    if strip_edges.trouble is not None:
        raise strip_edges.trouble
    if strip_edges.too_many is not None and which != "strongest":
        raise strip_edges.too_many
    edges = strip_edges.edges
    if which == "single" and len(edges) > 1:
        raise _several_edges_error(edges, "one was")
    if which == "strongest":
        return require_usable(max(edges, key=lambda judged_edge: abs(judged_edge.edge.height)))
    if which == "nearest":
        return require_usable(min(edges, key=lambda judged_edge: abs(judged_edge.edge.place)))
    return require_usable(edges[-1 if which == "last" else 0])


def choose_pair(strip_edges: StripEdges, which: PairChoice) -> tuple[Edge, Edge]:
    """Return the two edges of a bar; raise NotMeasuredError as :func:`choose_edge` does."""
    if strip_edges.trouble is not None:
        raise strip_edges.trouble
    if strip_edges.too_many is not None:
        raise strip_edges.too_many
    edges = strip_edges.edges
    if len(edges) < 2:
        place = strip_edges.edges[0].edge.place
        text = f"only one edge where two were expected, {place:.1f} px from the middle"
        raise NotMeasuredError(NoValueReason.NO_EDGE, text)
    if which == "outermost":
        return require_usable(edges[0]), require_usable(edges[-1])
    if which == "single" and len(edges) > 2:
        raise _several_edges_error(edges, "two were")
    pairs = [
        (first, other)
        for first, other in itertools.pairwise(edges)
        if first.edge.height * other.edge.height < 0
    ]
    if not pairs:
        text = (
            "no two edges of which one is from dark to light and the other one from light to dark"
        )
        raise NotMeasuredError(NoValueReason.NO_EDGE, text)
    pair = pairs[-1 if which == "last" else 0]
    if which == "strongest":
        pair = max(pairs, key=lambda two: min(abs(judged_edge.edge.height) for judged_edge in two))
    return require_usable(pair[0]), require_usable(pair[1])


def require_usable(judged_edge: JudgedEdge) -> Edge:
    """Return the edge; raise NotMeasuredError if its place is not usable."""
    if judged_edge.trouble is not None:
        raise judged_edge.trouble
    return judged_edge.edge


def _several_edges_error(edges: tuple[JudgedEdge, ...], expected: str) -> NotMeasuredError:
    places = ", ".join(f"{edge.edge.place:.1f}" for edge in edges[:4])
    text = f"{len(edges)} edges where {expected} expected, {places} px from the region's middle"
    return NotMeasuredError(NoValueReason.SEVERAL_EDGES, text)
