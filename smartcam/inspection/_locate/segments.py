"""Segments: short straight or bent pieces of a part's edges, and their fit to a picture's pixels.

A segment has a middle, a normal that points to its brighter side, a bend, and a length. Its *band*
consists of the pixels on both sides of the segment. Each pixel of a picture is in the band of one
segment at most, so the errors of segments are independent. The error of a pose follows from them.

A blurred step is fitted to the pixels of each band: two levels, and the place across the edge.
Pixels are used without interpolation.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.inspection._measure.edges import ROUNDING

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array

BAND_PX: Final = 4.0
"""Width of a band to each side of its segment, pixels of the taught picture, unless the part is
smaller in the searched picture."""

MIN_BLUR_PX: Final = 0.35
"""Least standard deviation of an edge's blur, pixels, which includes the area of a pixel."""

BLURS_PX2: Final = (0.5, 1.0, 2.0, 4.0, 6.0, 9.0)
"""Variances of additional blur, pixels^2 of the taught picture, for which a model knows the
shifts of its edges."""

MIN_BAND_PIXELS: Final = 12
"""Least number of pixels of a band; a fit to fewer does not determine their noise."""


class Segments(NamedTuple):
    """N segments; lengths in pixels of the taught picture, places from the part's reference."""

    middles: Array  # (N, 2)
    normals: Array  # (N, 2), of length 1, to the brighter side
    bends: Array  # (N,), 1 over the radius; positive: the edge bends towards its brighter side
    half_lengths: Array  # (N,)
    heights: Array  # (N,), grey levels of 255 from the darker to the brighter side
    blurs: Array  # (N,), standard deviation of the step's blur
    sigmas: Array  # (N,), standard deviation of the place across the edge
    blur_shifts: Array  # (N, K), shift of the fitted step across the edge by each of BLURS_PX2

    def selected(self, which: NDArray[Any]) -> Segments:
        """Return the segments that a mask or indices select."""
        return Segments(*(array[which] for array in self))

    @property
    def tangents(self) -> Array:
        """Unit tangents (N, 2): the normals, rotated by 90 degrees from x to y."""
        return self.normals[:, ::-1] * [-1.0, 1.0]

    def sample_points(self, step: float = 0.5) -> tuple[Array, NDArray[np.intp]]:
        """Return points (M, 2) along all segments, and the segment of each."""
        counts = np.maximum(np.ceil(2 * self.half_lengths / step).astype(int), 1) + 1
        owners = np.repeat(np.arange(len(counts)), counts)
        first = np.cumsum(counts) - counts
        number = np.arange(len(owners)) - first[owners]
        t = (2 * number / (counts[owners] - 1) - 1) * self.half_lengths[owners]
        bend = 0.5 * self.bends[owners] * t * t
        points = self.middles[owners] + t[:, None] * self.tangents[owners]
        return points + bend[:, None] * self.normals[owners], owners

    def blur_shift(self, variance: float) -> Array:
        """Return the shift (N,) across each edge that an additional blur causes.

        ``variance``: variance of this blur; negative: the picture is sharper than the taught one.
        """
        if variance < 0:  # in a sharper picture edges move the other way
            shift_if_sharper: Array = self.blur_shifts[:, 0] * max(variance / BLURS_PX2[0], -1.0)
            return shift_if_sharper
        extra = min(variance, BLURS_PX2[-1])
        index = int(np.searchsorted(BLURS_PX2, extra))
        known_shifts = np.column_stack([np.zeros(len(self.blur_shifts)), self.blur_shifts])
        low, high = (0.0, *BLURS_PX2)[index : index + 2]
        fraction = (extra - low) / (high - low)
        low_shift, high_shift = known_shifts[:, index : index + 2].T
        shift: Array = (1 - fraction) * low_shift + fraction * high_shift
        return shift

    def coordinates_of(self, points: Array, owners: NDArray[np.intp]) -> tuple[Array, Array]:
        """Return the coordinates across and along the edge, (P,) each, of points (P, 2).

        ``owners`` (P,): index of the segment of each point.
        """
        x, y = (points - self.middles[owners]).T
        nx, ny = self.normals[owners].T
        along = nx * y - ny * x
        return nx * x + ny * y - 0.5 * self.bends[owners] * along * along, along


class Bands(NamedTuple):
    """The bands of segments as a map of labels."""

    labels: NDArray[np.int16]  # (H, W), index of the segment; -1: in no band
    corner: tuple[int, int]  # place of the first label, pixels from the part's reference


def make_bands(segments: Segments, others: Array, reach: float = BAND_PX) -> Bands:
    """Return the bands of segments; ``others`` (M, 2) are other edge pixels, at which bands end.

    ``reach``: width of a band to each side of its segment, pixels.
    """
    cv2 = load("cv2", "inspection needs")
    points, owners = segments.sample_points()
    low = np.floor(points.min(axis=0) - reach - 2).astype(int)
    size = np.ceil(points.max(axis=0) + reach + 2).astype(int) - low + 1
    seeds = np.full((int(size[1]), int(size[0])), -2, np.int32)
    curve_pixels = np.rint(points - low).astype(int)
    seeds[curve_pixels[:, 1], curve_pixels[:, 0]] = owners
    own_area = cv2.dilate((seeds >= 0).astype(np.uint8), np.ones((3, 3), np.uint8))
    other_pixels = np.rint(others - low).astype(int)
    other_pixels = other_pixels[((other_pixels >= 0) & (other_pixels < size)).all(axis=1)]
    other_pixels = other_pixels[own_area[other_pixels[:, 1], other_pixels[:, 0]] == 0]
    seeds[other_pixels[:, 1], other_pixels[:, 0]] = -1
    is_free = (seeds == -2).astype(np.uint8)
    distance, nearest = cv2.distanceTransformWithLabels(
        is_free, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    owner_of = np.full(int(nearest.max()) + 1, -1, np.int32)
    owner_of[nearest[is_free == 0]] = seeds[is_free == 0]
    labels = owner_of[nearest]
    rows, columns = np.nonzero((labels >= 0) & (distance <= reach + 1))
    owners_in_band = labels[rows, columns].astype(np.intp)
    across, along = segments.coordinates_of(np.column_stack([columns, rows]) + low, owners_in_band)
    is_in_band = (np.abs(across) <= reach) & (
        np.abs(along) <= segments.half_lengths[owners_in_band] + 0.5
    )
    band_labels = np.full(labels.shape, -1, np.int16)
    band_labels[rows[is_in_band], columns[is_in_band]] = owners_in_band[is_in_band]
    return Bands(band_labels, (int(low[0]), int(low[1])))


class BandPixels(NamedTuple):
    """Pixels of bands in a picture."""

    points: Array  # (P, 2), pixels of the picture
    levels: Array  # (P,), grey levels
    owners: NDArray[np.intp]  # (P,), index of the segment


def find_band_pixels(bands: Bands, matrix: Array, levels: NDArray[Any]) -> BandPixels:
    """Return the pixels of a picture (H, W) that lie in bands.

    ``matrix`` (2, 3) maps the segments' places to pixels of the picture.
    """
    cv2 = load("cv2", "inspection needs")
    height, width = bands.labels.shape
    corners = np.array([(0, 0), (width, 0), (width, height), (0, height)]) + bands.corner
    box = corners @ matrix[:, :2].T + matrix[:, 2]
    low = np.floor(box.min(axis=0)).astype(int).clip(0)
    high = np.minimum(np.ceil(box.max(axis=0)).astype(int) + 1, levels.shape[::-1])
    if (high <= low).any():
        return BandPixels(np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.intp))
    to_crop = matrix.copy()
    to_crop[:, 2] += matrix[:, :2] @ bands.corner - low
    labels = cv2.warpAffine(
        bands.labels,
        to_crop,
        tuple(map(int, high - low)),
        flags=cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=-1,
    )
    rows, columns = np.nonzero(labels >= 0)
    owners = labels[rows, columns].astype(np.intp)
    points = np.column_stack([columns, rows]).astype(np.float64) + low
    crop = levels[low[1] : high[1], low[0] : high[0]]
    return BandPixels(points, crop[rows, columns].astype(np.float64), owners)


class StepFit(NamedTuple):
    """The blurred step in each of N bands; the sigma of a band without a step is infinite."""

    shifts: Array  # (N,), distance from the segment to the edge, towards the brighter side
    sigmas: Array  # (N,), of the shifts, for noise of one grey level
    heights: Array  # (N,), grey levels; negative: the bright side is the other one
    height_sigmas: Array  # (N,), of the heights, for noise of one grey level
    variances: Array  # (N,), of the pixels about the step
    freedoms: Array  # (N,), degrees of freedom: pixels less fitted values
    widening: float  # relative correction of the common blur


def fit_bands(across: Array, blurs: Array, pixels: BandPixels, count: int) -> StepFit:
    """Return the steps of ``count`` bands by a fit that is linear about the given places and blurs.

    ``across`` (P,) and ``blurs`` (P,): distance of each pixel from its edge, and the step's blur,
    both in pixels of the picture.
    """
    scaled = across / blurs
    rise = load("scipy.special").ndtr(scaled)
    slope = np.exp(-0.5 * scaled * scaled) / (blurs * math.sqrt(2 * math.pi))
    owners = pixels.owners
    pixel_counts = np.bincount(owners, minlength=count).astype(np.float64)
    divisors = np.maximum(pixel_counts, 1.0)

    def subtract_means(values: Array) -> Array:
        """Subtract the mean of each band, which eliminates the band's unknown level."""
        deviations: Array = values - (np.bincount(owners, values, count) / divisors)[owners]
        return deviations

    def sums(one: Array, other: Array) -> Array:
        return np.bincount(owners, one * other, count).astype(np.float64, copy=False)

    rise, slope, widen, levels = map(
        subtract_means, (rise, slope, scaled * slope * blurs, pixels.levels)
    )
    rr, rs, ss = sums(rise, rise), sums(rise, slope), sums(slope, slope)
    ry, sy, yy = sums(rise, levels), sums(slope, levels), sums(levels, levels)
    determinant = rr * ss - rs * rs
    is_usable = (pixel_counts >= MIN_BAND_PIXELS) & (
        determinant > 1e-9 * np.maximum(rr * ss, 1e-12)
    )
    safe_determinant = np.where(is_usable, determinant, 1.0)
    heights = np.where(is_usable, (ss * ry - rs * sy) / safe_determinant, 0.0)
    slope_values = np.where(is_usable, (rr * sy - rs * ry) / safe_determinant, 0.0)
    residual_squares = np.maximum(yy - heights * ry - slope_values * sy, 0.0)
    freedoms = np.maximum(pixel_counts - 3.0, 1.0)
    variances = np.maximum(residual_squares / freedoms, ROUNDING**2)
    safe_heights = np.where(np.abs(heights) > 1e-6, heights, 1e-6)
    infinite = np.where(is_usable, 0.0, np.inf)
    # eliminate heights and shifts from the effect of a wider blur and from the pixels
    wr, ws = sums(widen, rise), sums(widen, slope)
    square = (
        sums(widen, widen) - (ss * wr * wr - 2 * rs * wr * ws + rr * ws * ws) / safe_determinant
    )
    grown = sums(widen, levels) - heights * wr - slope_values * ws
    weights = np.where(is_usable, 1 / variances, 0.0)
    weights[np.abs(heights) < np.median(np.abs(heights))] = 0.0
    total = float((weights * heights**2 * square).sum())
    return StepFit(
        -slope_values / safe_heights,
        np.sqrt(np.maximum(rr / safe_determinant, 0.0)) / np.abs(safe_heights) + infinite,
        heights,
        np.sqrt(np.maximum(ss / safe_determinant, 0.0)) + infinite,
        variances,
        freedoms,
        -float((weights * heights * grown).sum()) / total if total > 0 else 0.0,
    )


def normal_equations(
    columns: Array, values: Array, owners: NDArray[np.intp], count: int
) -> tuple[Array, Array]:
    """Return the square matrices (N, K, K) and right sides (N, K) of all bands."""
    size = len(columns)
    square, right = np.zeros((count, size, size)), np.zeros((count, size))
    for i in range(size):
        right[:, i] = np.bincount(owners, columns[i] * values, count)
        for j in range(i, size):
            square[:, i, j] = square[:, j, i] = np.bincount(owners, columns[i] * columns[j], count)
    return square, right
