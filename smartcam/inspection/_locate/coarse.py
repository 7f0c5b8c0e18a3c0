"""Find places where a part may be, by the directions of gradients, from coarse to fine.

The gradient of a pixel of a pyramid level has one of sixteen directions. A map for each direction
gives the agreement of the pixels around a place with it. The agreement of a part's points is read
from these maps, for all places at once, one rotation of the part after the other. The best places
are refined at the larger levels of the pyramid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam._forks import cached_property

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array

DIRECTIONS: Final = 16
"""Number of directions of gradients in the full circle that are distinguished."""

AGREEMENT: Final = (np.uint8(4), np.uint8(3), np.uint8(1))
"""Agreement of two directions by the steps between them; 0 for more steps."""

MAX_TOP_POINTS: Final = 44
"""Largest number of points of a part that are compared at all places: each adds 4 at most to the
agreement, so that the sum fits into a byte."""

MAX_POINTS: Final = 150
"""Largest number of points of a part that are compared at the places that are refined."""

MIN_RADIUS_PX: Final = 8.0
"""Least distance, pixels, from the reference to the farthest point at the smallest level."""

MAX_LEVELS: Final = 6
"""Largest number of levels of the pyramid."""

MAX_STACK_BYTES: Final = 1 << 26
"""Largest number of bytes of the agreement of all places and rotations at the smallest level that
is kept at a time."""

MAX_CANDIDATES: Final = 100
"""Largest number of places of a part, for each scale, that are refined down the pyramid."""

TOP_STEP_PX: Final = 1.6
"""Motion of the farthest point, pixels, between two rotations at the smallest level."""

LOWER_STEP_PX: Final = 1.0
"""Motion of the farthest point, pixels, between two rotations at other levels."""

TOP_SHARE, LOWER_SHARE = 0.8, 0.85
"""Shares of the least score from which places are refined, at the smallest and at other levels."""

EDGE_RESPONSE: Final = 2.2
"""Response of Sobel's operator to an edge of one grey level in a pyramid level."""

NOISE_RESPONSE: Final = 12.0
"""Sobel's response, in standard deviations of its noise, above which a pixel has a direction."""


class RoughPlace(NamedTuple):
    """A place where a part may be."""

    x: float  # pixels of the picture
    y: float
    angle: float  # radians
    scale: float
    score: float  # agreement, 0 to 1


@dataclass(frozen=True, slots=True)
class CoarseModel:
    """The points of a part at the levels of a pyramid.

    Attributes:
        points: places relative to the reference, (N, 2), pixels of the taught picture, by level
            from 0.
        normals: directions to the brighter side, (N, 2), by level.
    """

    points: tuple[Array, ...]
    normals: tuple[Array, ...]

    @property
    def top(self) -> int:
        """The smallest level."""
        return len(self.points) - 1

    def radius(self, level: int) -> float:
        """Return the distance of the farthest point at a level, in the level's pixels."""
        return float(np.linalg.norm(self.points[level], axis=1).max()) / float(1 << level)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ranges:
    """The poses that are searched.

    Attributes:
        angles: first and last angle, radians; a range of the period includes all angles.
        scales: smallest and largest scale.
        period: angle after which the part looks like itself, radians.
        any_polarity: whether dark and bright may be exchanged.
        contrast: least difference of the grey levels, of 255, on both sides of an edge.
        least_score: least score of a found place.
    """

    angles: tuple[float, float]
    scales: tuple[float, float]
    period: float
    any_polarity: bool
    contrast: float
    least_score: float

    @property
    def is_round(self) -> bool:
        """True if all angles are searched."""
        return self.angles[1] - self.angles[0] >= self.period - 1e-9

    def turns(self, step: float) -> tuple[Array, bool]:
        """Return angles with distances of a step at most, and whether they close a circle."""
        start, span = self.angles[0], min(self.angles[1] - self.angles[0], self.period)
        if self.is_round:
            count = max(math.ceil(span / step), 1)
            return start + span * np.arange(count) / count, self.period > 6.28
        return np.linspace(start, start + span, max(math.ceil(span / step), 0) + 1), False

    def sizes(self, step: float) -> Array:
        """Return scales with distances of a step at most."""
        low, high = self.scales
        count = math.ceil(math.log(high / low) / step) + 1 if high > low else 1
        return np.geomspace(low, high, count)


class PyramidLevel:
    """One level of a picture's pyramid; computed values are kept."""

    def __init__(self, grey: NDArray[np.uint8], noise: float) -> None:
        self.grey = grey
        self._noise = noise

    @cached_property
    def gradient(self) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
        """Sobel's responses across and down, (H, W)."""
        cv2 = load("cv2", "inspection needs")
        return cv2.Sobel(self.grey, cv2.CV_16S, 1, 0), cv2.Sobel(self.grey, cv2.CV_16S, 0, 1)

    def least_response(self, contrast: float) -> float:
        """Return the response from which on a pixel has a direction."""
        return max(EDGE_RESPONSE * contrast, NOISE_RESPONSE * self._noise)

    def unit_gradient(self, contrast: float) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the gradient with a length of 1, or 0 where it has no direction, (H, W)."""
        cv2 = load("cv2", "inspection needs")
        across, down = (component.astype(np.float32) for component in self.gradient)
        size = cv2.magnitude(across, down)
        least = np.float32(self.least_response(contrast))
        size[size < least] = np.inf
        return cv2.divide(across, size), cv2.divide(down, size)

    def agreement(self, contrast: float, *, any_polarity: bool) -> list[NDArray[np.uint8]]:
        """Return maps (H, W) of the agreement around each pixel with each direction, 0 to 4."""
        cv2 = load("cv2", "inspection needs")
        across, down = (component.astype(np.float32) for component in self.gradient)
        size, angle = cv2.cartToPolar(across, down)
        number = (angle * (DIRECTIONS / (2 * math.pi)) + 0.5).astype(np.uint8) % DIRECTIONS
        count = DIRECTIONS // 2 if any_polarity else DIRECTIONS
        number %= count
        number[size < self.least_response(contrast)] = 255
        around = np.ones((3, 3), np.uint8)
        spread_directions = [cv2.dilate((number == k).view(np.uint8), around) for k in range(count)]
        agreements = []
        for k in range(count):
            best = spread_directions[k] * AGREEMENT[0]
            for apart in (1, 2):
                both = spread_directions[(k + apart) % count] | spread_directions[k - apart]
                best = np.maximum(best, both * AGREEMENT[apart])
            agreements.append(best)
        return agreements


class PicturePyramid:
    """A picture in sizes that halve from level to level.

    Args:
        grey: brightness, (H, W).
        noise: standard deviation of its noise, grey levels.
    """

    def __init__(self, grey: NDArray[np.uint8], noise: float) -> None:
        self._levels = [PyramidLevel(grey, noise)]
        self._noise = noise
        self._agreement: dict[tuple[int, float, bool], list[NDArray[np.uint8]]] = {}
        self._units: dict[tuple[int, float], tuple[NDArray[Any], NDArray[Any]]] = {}

    def level(self, number: int) -> PyramidLevel:
        """Return a level; 0 is the picture."""
        cv2 = load("cv2", "inspection needs")
        while len(self._levels) <= number:
            below = self._levels[-1].grey
            # a pixel of the level above has 0.4 of the noise, further ones half of it
            noise = self._noise * (1.0 if number == 0 else 0.4 * 0.5 ** (len(self._levels) - 1))
            self._levels.append(PyramidLevel(cv2.pyrDown(below), noise))
        return self._levels[number]

    def agreement(
        self, level: int, contrast: float, *, any_polarity: bool
    ) -> list[NDArray[np.uint8]]:
        """Return a level's maps of agreement; models with one contrast share them."""
        key = level, contrast, any_polarity
        if key not in self._agreement:
            made = self.level(level).agreement(contrast, any_polarity=any_polarity)
            self._agreement[key] = made
        return self._agreement[key]

    def units(self, level: int, contrast: float) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return a level's gradient with a length of 1."""
        key = level, contrast
        if key not in self._units:
            self._units[key] = self.level(level).unit_gradient(contrast)
        return self._units[key]


def find_candidates(
    pyramid: PicturePyramid, model: CoarseModel, ranges: Ranges, most: int
) -> tuple[list[RoughPlace], RoughPlace | None]:
    """Return the places where a part may be, the best first, and the best refused place.

    The error of a place is about a pixel.
    """
    top = model.top
    candidates = list(_everywhere(pyramid, model, ranges))
    refused: RoughPlace | None = None
    candidates, refused = _best(
        candidates, TOP_SHARE * ranges.least_score, 2.0**top, MAX_CANDIDATES, None
    )
    for level in range(top - 1, 0, -1):
        if not candidates:
            break
        candidates = _followed(pyramid, model, ranges, level, candidates)
        most_kept = max(2 * most + 8, MAX_CANDIDATES >> (2 * (top - level)))
        least = LOWER_SHARE * ranges.least_score
        candidates, refused = _best(candidates, least, 2.0**level, most_kept, refused)
    return candidates, refused


def _everywhere(
    pyramid: PicturePyramid, model: CoarseModel, ranges: Ranges
) -> Iterator[RoughPlace]:
    """Yield places at the smallest level, of all angles and scales."""
    top = model.top
    maps = pyramid.agreement(top, ranges.contrast, any_polarity=ranges.any_polarity)
    radius = model.radius(top)
    points, normals = _thinned(model.points[top], model.normals[top], MAX_TOP_POINTS)
    points = points / 2**top
    for scale in ranges.sizes(TOP_STEP_PX / radius).tolist():
        angles, closed = ranges.turns(TOP_STEP_PX / (radius * scale))
        table = _AgreementTable(maps, math.ceil(radius * scale) + 1)
        for part in np.array_split(
            angles, max(1, -(-table.bytes * len(angles) // MAX_STACK_BYTES))
        ):
            stack = table.sums(scale * points, normals, part)
            least = max(1, math.floor(TOP_SHARE * ranges.least_score * 4 * len(points)))
            closes = closed and len(part) == len(angles)
            for turn, y, x, total in table.peaks(stack, least, closes=closes):
                score = total / (4 * len(points))
                yield RoughPlace(x * 2**top, y * 2**top, float(part[turn]), scale, score)


class _AgreementTable:
    """Maps of agreement, with a border of nothing, as flat rows."""

    def __init__(self, maps: list[NDArray[np.uint8]], border: int) -> None:
        self._height, self._width = maps[0].shape
        self._row = self._width + 2 * border
        self._start = border * self._row + border
        self._border = border
        # a row more: the last sums reach beyond their line
        padded = [np.pad(map_, ((border, border + 1), (border, border))) for map_ in maps]
        self._flat = [map_.ravel() for map_ in padded]
        self.bytes = self._row * self._height

    def sums(self, points: Array, normals: Array, angles: Array) -> NDArray[np.uint8]:
        """Return the agreement of all points (A, H, W) at all places, by angle."""
        stack = np.zeros((len(angles), self.bytes), np.uint8)
        count, size = len(self._flat), self.bytes
        directions = np.arctan2(normals[:, 1], normals[:, 0])
        cos, sin = np.cos(angles)[:, None], np.sin(angles)[:, None]
        x, y = points.T
        columns = np.rint(cos * x - sin * y).astype(int)
        rows = np.rint(sin * x + cos * y).astype(int)
        starts = (self._start + rows * self._row + columns).tolist()
        turned = (directions + angles[:, None]) * (DIRECTIONS / (2 * math.pi))
        numbers = (np.rint(turned).astype(int) % count).tolist()
        flat, add = self._flat, np.add
        for total, line, which in zip(stack, starts, numbers, strict=True):
            for start, number in zip(line, which, strict=True):
                add(total, flat[number][start : start + size], total)
        return stack.reshape(len(angles), self._height, self._row)

    def peaks(
        self, stack: NDArray[np.uint8], least: int, *, closes: bool
    ) -> list[tuple[int, int, int, int]]:
        """Return the highest peaks: index of the angle, row, column, and sum."""
        cv2 = load("cv2", "inspection needs")
        flat = stack.reshape(len(stack), -1)
        peaks_found: list[tuple[int, int, int, int]] = []
        around = np.ones((3, 3), np.uint8)
        for turn in np.flatnonzero(flat.max(axis=1) >= least).tolist():
            high = np.flatnonzero(flat[turn] >= least)
            totals = flat[turn][high]
            highest = totals >= cv2.dilate(stack[turn], around).ravel()[high]
            for other in (turn - 1, turn + 1):
                if closes or 0 <= other < len(stack):
                    highest &= totals >= flat[other % len(stack)][high]
            high, totals = high[highest], totals[highest]
            rows, columns = np.divmod(high, self._row)
            inner = columns < self._width
            peaks_found += zip(
                [turn] * int(np.count_nonzero(inner)),
                rows[inner].tolist(),
                columns[inner].tolist(),
                totals[inner].tolist(),
                strict=True,
            )
        return sorted(peaks_found, key=lambda peak: -peak[3])[: 4 * MAX_CANDIDATES]


def _thinned(points: Array, normals: Array, most: int) -> tuple[Array, Array]:
    """Return at most a number of the points, evenly spread."""
    if len(points) <= most:
        return points, normals
    chosen = np.linspace(0, len(points) - 1, most).round().astype(int)
    return points[chosen], normals[chosen]


def _followed(
    pyramid: PicturePyramid,
    model: CoarseModel,
    ranges: Ranges,
    level: int,
    places: list[RoughPlace],
) -> list[RoughPlace]:
    """Return the best pose at a level near each place that was found at the next smaller level."""
    nx, ny = pyramid.units(level, ranges.contrast)
    points, normals = _thinned(model.points[level], model.normals[level], MAX_POINTS)
    points = points / 2**level
    radius = model.radius(level)
    step = LOWER_STEP_PX / radius
    turns = np.array([-1.0, 0.0, 1.0]) * step
    sizes = np.array([1 - step, 1.0, 1 + step]) if ranges.scales[1] > ranges.scales[0] else [1.0]
    ways = np.array([(turn, size) for turn in turns for size in sizes])
    start = np.array([(place.x, place.y, place.angle, place.scale) for place in places])
    angles = (start[:, 2, None] + ways[:, 0]).ravel()
    scales = (start[:, 3, None] * ways[:, 1]).ravel()
    at = np.rint(start[:, :2] / 2**level).astype(int).repeat(len(ways), axis=0)
    scores = _scores((nx, ny), points, normals, (angles, scales), at, ranges.any_polarity)
    best = scores.reshape(len(places), -1).argmax(axis=1)
    followed = []
    for number, which in enumerate(best.tolist()):
        trial, offset = divmod(which, scores.shape[1])
        row = number * len(ways) + trial
        x, y = at[row] + OFFSETS[offset]
        followed.append(
            RoughPlace(
                float(x) * 2**level,
                float(y) * 2**level,
                float(angles[row]),
                float(scales[row].clip(*ranges.scales)),
                float(scores[row, offset]),
            )
        )
    return followed


OFFSETS: Final = np.array([(x, y) for y in range(-2, 3) for x in range(-2, 3)])
"""Offsets, pixels, of the search around a place that was found at the next smaller level."""


def _scores(
    units: tuple[NDArray[Any], NDArray[Any]],
    points: Array,
    normals: Array,
    poses: tuple[Array, Array],
    at: NDArray[Any],
    any_polarity: bool,
) -> Array:
    """Return the mean agreement of the directions (M, 25) at poses (M,) around places (M, 2)."""
    height, width = units[0].shape
    cos, sin = np.cos(poses[0])[:, None], np.sin(poses[0])[:, None]
    x, y = points.T
    u, v = normals.T
    columns = np.rint(poses[1][:, None] * (cos * x - sin * y)).astype(np.int32) + at[:, :1]
    rows = np.rint(poses[1][:, None] * (sin * x + cos * y)).astype(np.int32) + at[:, 1:]
    ahead = (cos * u - sin * v).astype(np.float32)
    down = (sin * u + cos * v).astype(np.float32)
    scores = np.empty((len(at), len(OFFSETS)), np.float32)
    flat = [np.pad(unit, ((0, 1), (0, 0))).ravel() for unit in units]  # nothing behind the last row
    nothing = height * width
    for number, (dx, dy) in enumerate(OFFSETS.tolist()):
        column, row = columns + dx, rows + dy
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        index = np.where(inside, row * width + column, nothing)
        agreed = flat[0].take(index) * ahead + flat[1].take(index) * down
        agreed = np.abs(agreed) if any_polarity else np.maximum(agreed, 0)
        scores[:, number] = agreed.mean(axis=1)
    return scores.astype(np.float64)


def _best(
    places: list[RoughPlace],
    least: float,
    pixel: float,
    most: int,
    refused: RoughPlace | None,
) -> tuple[list[RoughPlace], RoughPlace | None]:
    """Return the best places without duplicates, and the best place with too low a score."""
    best: list[RoughPlace] = []
    for place in sorted(places, key=lambda place: -place.score):
        if place.score < least:
            if refused is None or place.score > refused.score:
                refused = place
            break
        if len(best) == most:
            break
        if not any(_alike(place, other, pixel) for other in best):
            best.append(place)
    return best, refused


def _alike(one: RoughPlace, other: RoughPlace, pixel: float) -> bool:
    is_near = math.hypot(one.x - other.x, one.y - other.y) <= 2 * pixel
    turned = abs(math.remainder(one.angle - other.angle, 2 * math.pi))
    return is_near and turned < 0.12 and abs(math.log(one.scale / other.scale)) < 0.1
