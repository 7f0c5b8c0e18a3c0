"""Find candidate places of a part, by the directions of gradients, from coarse to fine.

The picture is reduced to a pyramid of smaller and smaller pictures, its *levels*. In each level,
the gradient of a pixel is rounded to one of sixteen directions. A map for each direction tells how
well the pixels around a place agree with this direction. The agreement of a part's points is read
from these maps, for all places at once, one rotation of the part after the other. This is done at
the smallest level; the best places are refined at the larger levels.
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
"""Agreement of two directions that are 0, 1 or 2 steps apart; 0 for more steps."""

MAX_TOP_POINTS: Final = 44
"""Largest number of points of a part that are compared at all places. The time grows with it; each
point adds up to 4 to the agreement, whose sum has to stay below 256."""

MAX_POINTS: Final = 150
"""Largest number of points of a part that are compared at the places that are refined."""

MIN_RADIUS_PX: Final = 8.0
"""Least distance, pixels, of the farthest point from the part's reference at the smallest level."""

MAX_PYRAMID_LEVELS: Final = 6
"""Largest number of levels of the pyramid."""

MAX_STACK_BYTES: Final = 1 << 26
"""Largest number of bytes of agreement values (one for each place and rotation at the smallest
level) that are in memory at a time."""

MAX_CANDIDATES: Final = 100
"""Largest number of places of a part that are kept at the smallest level; about a quarter as many
are kept at each larger level."""

TOP_STEP_PX: Final = 1.6
"""Motion of the farthest point, pixels, between two rotations at the smallest level."""

LOWER_STEP_PX: Final = 1.0
"""Motion of the farthest point, pixels, between two rotations at other levels."""

TOP_SHARE, LOWER_SHARE = 0.8, 0.85
"""Shares of the required score that a place must reach to be refined further: at the smallest
level, and at the other levels."""

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
        points: places relative to the part's reference, (N, 2), pixels of the taught picture, by
            level from 0.
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
        angles: first and last angle, radians; a range as long as the period includes all angles.
        scales: smallest and largest scale.
        period: angle after which the part looks like itself, radians.
        any_polarity: whether dark and bright may be exchanged.
        contrast: least difference of the grey levels, of 255, on both sides of an edge.
        min_score: least score of a found place.
    """

    angles: tuple[float, float]
    scales: tuple[float, float]
    period: float
    any_polarity: bool
    contrast: float
    min_score: float

    @property
    def covers_all_angles(self) -> bool:
        """True if the range includes all angles."""
        return self.angles[1] - self.angles[0] >= self.period - 1e-9

    def list_angles(self, step: float) -> tuple[Array, bool]:
        """Return angles at most a step apart, and True if the last one is next to the first one."""
        start, span = self.angles[0], min(self.angles[1] - self.angles[0], self.period)
        if self.covers_all_angles:
            count = max(math.ceil(span / step), 1)
            return start + span * np.arange(count) / count, self.period > 6.28
        return np.linspace(start, start + span, max(math.ceil(span / step), 0) + 1), False

    def list_scales(self, step: float) -> Array:
        """Return scales that grow by the factor ``1 + step`` at most."""
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

    def min_response(self, contrast: float) -> float:
        """Return the least response at which a pixel has a direction."""
        return max(EDGE_RESPONSE * contrast, NOISE_RESPONSE * self._noise)

    def unit_gradient(self, contrast: float) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the gradient with a length of 1, or 0 where it has no direction, (H, W)."""
        cv2 = load("cv2", "inspection needs")
        across, down = (component.astype(np.float32) for component in self.gradient)
        magnitude = cv2.magnitude(across, down)
        magnitude[magnitude < np.float32(self.min_response(contrast))] = np.inf
        return cv2.divide(across, magnitude), cv2.divide(down, magnitude)

    def agreement(self, contrast: float, *, any_polarity: bool) -> list[NDArray[np.uint8]]:
        """Return maps (H, W) of the agreement around each pixel with each direction, 0 to 4."""
        cv2 = load("cv2", "inspection needs")
        across, down = (component.astype(np.float32) for component in self.gradient)
        magnitude, angle = cv2.cartToPolar(across, down)
        direction_index = (angle * (DIRECTIONS / (2 * math.pi)) + 0.5).astype(np.uint8) % DIRECTIONS
        direction_count = DIRECTIONS // 2 if any_polarity else DIRECTIONS
        direction_index %= direction_count
        direction_index[magnitude < self.min_response(contrast)] = 255
        neighbourhood = np.ones((3, 3), np.uint8)
        spread_directions = [
            cv2.dilate((direction_index == k).view(np.uint8), neighbourhood)
            for k in range(direction_count)
        ]
        agreements = []
        for k in range(direction_count):
            agreement = spread_directions[k] * AGREEMENT[0]
            for apart in (1, 2):
                both_sides = (
                    spread_directions[(k + apart) % direction_count] | spread_directions[k - apart]
                )
                agreement = np.maximum(agreement, both_sides * AGREEMENT[apart])
            agreements.append(agreement)
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
        self._unit_gradients: dict[tuple[int, float], tuple[NDArray[Any], NDArray[Any]]] = {}

    def level(self, number: int) -> PyramidLevel:
        """Return a level; 0 is the picture."""
        cv2 = load("cv2", "inspection needs")
        while len(self._levels) <= number:
            larger = self._levels[-1].grey
            # the first smaller level has 0.4 of the noise, each further level half of that
            noise = self._noise * (1.0 if number == 0 else 0.4 * 0.5 ** (len(self._levels) - 1))
            self._levels.append(PyramidLevel(cv2.pyrDown(larger), noise))
        return self._levels[number]

    def agreement(
        self, level: int, contrast: float, *, any_polarity: bool
    ) -> list[NDArray[np.uint8]]:
        """Return a level's maps of agreement; models with the same contrast share these maps."""
        key = level, contrast, any_polarity
        if key not in self._agreement:
            maps = self.level(level).agreement(contrast, any_polarity=any_polarity)
            self._agreement[key] = maps
        return self._agreement[key]

    def unit_gradient(self, level: int, contrast: float) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return a level's gradient with a length of 1."""
        key = level, contrast
        if key not in self._unit_gradients:
            self._unit_gradients[key] = self.level(level).unit_gradient(contrast)
        return self._unit_gradients[key]


def find_candidates(
    pyramid: PicturePyramid, model: CoarseModel, ranges: Ranges, max_parts: int
) -> tuple[list[RoughPlace], RoughPlace | None]:
    """Return the places where a part may be, the best first, and the best refused place.

    The places are exact to about a pixel.
    """
    top = model.top
    candidates = list(_search_top_level(pyramid, model, ranges))
    refused: RoughPlace | None = None
    candidates, refused = _keep_best(
        candidates, TOP_SHARE * ranges.min_score, 2.0**top, MAX_CANDIDATES, None
    )
    for level in range(top - 1, 0, -1):
        if not candidates:
            break
        candidates = _refine_places(pyramid, model, ranges, level, candidates)
        max_kept = max(2 * max_parts + 8, MAX_CANDIDATES >> (2 * (top - level)))
        min_score = LOWER_SHARE * ranges.min_score
        candidates, refused = _keep_best(candidates, min_score, 2.0**level, max_kept, refused)
    return candidates, refused


def _search_top_level(
    pyramid: PicturePyramid, model: CoarseModel, ranges: Ranges
) -> Iterator[RoughPlace]:
    """Search the smallest level, at all angles and scales; yield the places that agree."""
    top = model.top
    maps = pyramid.agreement(top, ranges.contrast, any_polarity=ranges.any_polarity)
    radius = model.radius(top)
    points, normals = _thin_out(model.points[top], model.normals[top], MAX_TOP_POINTS)
    points = points / 2**top
    for scale in ranges.list_scales(TOP_STEP_PX / radius).tolist():
        angles, wraps = ranges.list_angles(TOP_STEP_PX / (radius * scale))
        table = _AgreementTable(maps, math.ceil(radius * scale) + 1)
        for chunk_angles in np.array_split(
            angles, max(1, -(-table.bytes_per_angle * len(angles) // MAX_STACK_BYTES))
        ):
            stack = table.sum_agreement(scale * points, normals, chunk_angles)
            min_sum = max(1, math.floor(TOP_SHARE * ranges.min_score * 4 * len(points)))
            chunk_wraps = wraps and len(chunk_angles) == len(angles)
            for angle_index, y, x, total in table.find_peaks(stack, min_sum, wraps=chunk_wraps):
                score = total / (4 * len(points))
                yield RoughPlace(
                    x * 2**top, y * 2**top, float(chunk_angles[angle_index]), scale, score
                )


class _AgreementTable:
    """Maps of agreement with a border of zeros, flattened."""

    def __init__(self, maps: list[NDArray[np.uint8]], border: int) -> None:
        self._height, self._width = maps[0].shape
        self._row_length = self._width + 2 * border
        self._start = border * self._row_length + border
        self._border = border
        # one row more, since the last sums read beyond the end of their row
        padded = [np.pad(map_, ((border, border + 1), (border, border))) for map_ in maps]
        self._flat = [map_.ravel() for map_ in padded]
        self.bytes_per_angle = self._row_length * self._height

    def sum_agreement(self, points: Array, normals: Array, angles: Array) -> NDArray[np.uint8]:
        """Return the summed agreement of all points, (A, H, W), for each angle and place."""
        stack = np.zeros((len(angles), self.bytes_per_angle), np.uint8)
        count, size = len(self._flat), self.bytes_per_angle
        directions = np.arctan2(normals[:, 1], normals[:, 0])
        cos, sin = np.cos(angles)[:, None], np.sin(angles)[:, None]
        x, y = points.T
        columns = np.rint(cos * x - sin * y).astype(int)
        rows = np.rint(sin * x + cos * y).astype(int)
        starts = (self._start + rows * self._row_length + columns).tolist()
        turned = (directions + angles[:, None]) * (DIRECTIONS / (2 * math.pi))
        indices_by_angle = (np.rint(turned).astype(int) % count).tolist()
        flat, add = self._flat, np.add
        for total, offsets, direction_indices in zip(stack, starts, indices_by_angle, strict=True):
            for start, direction_index in zip(offsets, direction_indices, strict=True):
                add(total, flat[direction_index][start : start + size], total)
        return stack.reshape(len(angles), self._height, self._row_length)

    def find_peaks(
        self, stack: NDArray[np.uint8], min_sum: int, *, wraps: bool
    ) -> list[tuple[int, int, int, int]]:
        """Return the highest peaks as tuples: index of the angle, row, column, and sum."""
        cv2 = load("cv2", "inspection needs")
        flat = stack.reshape(len(stack), -1)
        peaks_found: list[tuple[int, int, int, int]] = []
        neighbourhood = np.ones((3, 3), np.uint8)
        for angle_index in np.flatnonzero(flat.max(axis=1) >= min_sum).tolist():
            high_indices = np.flatnonzero(flat[angle_index] >= min_sum)
            totals = flat[angle_index][high_indices]
            highest = totals >= cv2.dilate(stack[angle_index], neighbourhood).ravel()[high_indices]
            for other in (angle_index - 1, angle_index + 1):
                if wraps or 0 <= other < len(stack):
                    highest &= totals >= flat[other % len(stack)][high_indices]
            high_indices, totals = high_indices[highest], totals[highest]
            rows, columns = np.divmod(high_indices, self._row_length)
            is_in_picture = columns < self._width
            peaks_found += zip(
                [angle_index] * int(np.count_nonzero(is_in_picture)),
                rows[is_in_picture].tolist(),
                columns[is_in_picture].tolist(),
                totals[is_in_picture].tolist(),
                strict=True,
            )
        return sorted(peaks_found, key=lambda peak: -peak[3])[: 4 * MAX_CANDIDATES]


def _thin_out(points: Array, normals: Array, max_count: int) -> tuple[Array, Array]:
    """Return ``max_count`` of the points, evenly spread, or all points if there are fewer."""
    if len(points) <= max_count:
        return points, normals
    chosen = np.linspace(0, len(points) - 1, max_count).round().astype(int)
    return points[chosen], normals[chosen]


def _refine_places(
    pyramid: PicturePyramid,
    model: CoarseModel,
    ranges: Ranges,
    level: int,
    places: list[RoughPlace],
) -> list[RoughPlace]:
    """Return the best pose at a level near each place that was found at the next smaller level."""
    nx, ny = pyramid.unit_gradient(level, ranges.contrast)
    points, normals = _thin_out(model.points[level], model.normals[level], MAX_POINTS)
    points = points / 2**level
    radius = model.radius(level)
    step = LOWER_STEP_PX / radius
    turns = np.array([-1.0, 0.0, 1.0]) * step
    searches_scale = ranges.scales[1] > ranges.scales[0]
    factors = np.array([1 - step, 1.0, 1 + step]) if searches_scale else [1.0]
    trials = np.array([(turn, factor) for turn in turns for factor in factors])
    start = np.array([(place.x, place.y, place.angle, place.scale) for place in places])
    angles = (start[:, 2, None] + trials[:, 0]).ravel()
    scales = (start[:, 3, None] * trials[:, 1]).ravel()
    pixels = np.rint(start[:, :2] / 2**level).astype(int).repeat(len(trials), axis=0)
    scores = _score_places((nx, ny), points, normals, (angles, scales), pixels, ranges.any_polarity)
    best = scores.reshape(len(places), -1).argmax(axis=1)
    refined = []
    for index, best_trial in enumerate(best.tolist()):
        trial, offset = divmod(best_trial, scores.shape[1])
        row = index * len(trials) + trial
        x, y = pixels[row] + OFFSETS[offset]
        refined.append(
            RoughPlace(
                float(x) * 2**level,
                float(y) * 2**level,
                float(angles[row]),
                float(scales[row].clip(*ranges.scales)),
                float(scores[row, offset]),
            )
        )
    return refined


OFFSETS: Final = np.array([(x, y) for y in range(-2, 3) for x in range(-2, 3)])
"""Offsets, pixels, of the search around a place that was found at the next smaller level."""


def _score_places(
    units: tuple[NDArray[Any], NDArray[Any]],
    points: Array,
    normals: Array,
    poses: tuple[Array, Array],
    pixels: NDArray[Any],
    any_polarity: bool,
) -> Array:
    """Return (M, 25): the mean agreement for each of M poses, moved by each of the 25 offsets."""
    height, width = units[0].shape
    cos, sin = np.cos(poses[0])[:, None], np.sin(poses[0])[:, None]
    x, y = points.T
    u, v = normals.T
    columns = np.rint(poses[1][:, None] * (cos * x - sin * y)).astype(np.int32) + pixels[:, :1]
    rows = np.rint(poses[1][:, None] * (sin * x + cos * y)).astype(np.int32) + pixels[:, 1:]
    right = (cos * u - sin * v).astype(np.float32)
    down = (sin * u + cos * v).astype(np.float32)
    scores = np.empty((len(pixels), len(OFFSETS)), np.float32)
    # a row of zeros follows the last row
    flat = [np.pad(unit, ((0, 1), (0, 0))).ravel() for unit in units]
    zero_index = height * width
    for offset_index, (dx, dy) in enumerate(OFFSETS.tolist()):
        column, row = columns + dx, rows + dy
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        index = np.where(inside, row * width + column, zero_index)
        agreement = flat[0].take(index) * right + flat[1].take(index) * down
        agreement = np.abs(agreement) if any_polarity else np.maximum(agreement, 0)
        scores[:, offset_index] = agreement.mean(axis=1)
    return scores.astype(np.float64)


def _keep_best(
    places: list[RoughPlace],
    min_score: float,
    pixel_size: float,
    max_count: int,
    refused: RoughPlace | None,
) -> tuple[list[RoughPlace], RoughPlace | None]:
    """Return the best places without duplicates, and the best place with too low a score."""
    best: list[RoughPlace] = []
    for place in sorted(places, key=lambda place: -place.score):
        if place.score < min_score:
            if refused is None or place.score > refused.score:
                refused = place
            break
        if len(best) == max_count:
            break
        if not any(_is_same_place(place, other, pixel_size) for other in best):
            best.append(place)
    return best, refused


def _is_same_place(one: RoughPlace, other: RoughPlace, pixel_size: float) -> bool:
    is_near = math.hypot(one.x - other.x, one.y - other.y) <= 2 * pixel_size
    angle_difference = abs(math.remainder(one.angle - other.angle, 2 * math.pi))
    return is_near and angle_difference < 0.12 and abs(math.log(one.scale / other.scale)) < 0.1
