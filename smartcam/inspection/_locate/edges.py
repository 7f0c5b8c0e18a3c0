"""Find the edges of a taught picture, and divide them into segments with place and direction."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.inspection._locate.segments import (
    BLURS_PX2,
    MIN_BLUR_PX,
    Segments,
    find_band_pixels,
    fit_bands,
    make_bands,
    normal_equations,
)
from smartcam.inspection._measure.edges import ROUNDING

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array
    from smartcam.inspection._locate.segments import BandPixels

SMOOTH_PX: Final = 1.0
"""Standard deviation of the Gaussian that smooths the picture before the gradient, pixels."""

HALF_LENGTH_PX: Final = 4.0
"""Largest half length of a segment, pixels."""

MAX_LINE_DISTANCE_PX: Final = 1.0
"""Largest distance of a segment's points from a straight line through its middle, pixels."""

MAX_DIRECTION_CHANGE: Final = math.radians(20.0)
"""Largest angle, radians, between the direction of a segment's point and the direction of its
middle."""

MIN_POINTS: Final = 4
"""Least number of points of a segment."""

MAX_SEGMENTS: Final = 3000
"""Largest number of segments of a picture."""

FITS: Final = 8
"""Number of iterations of the fit of segments to the picture's pixels."""

BLURRED_FITS: Final = 3
"""Number of iterations of the fit of segments to a blurred picture."""

MAX_SHIFT_PX: Final = 1.5
"""Largest distance, pixels, by which a fit may move a segment; an edge farther away is another
one."""

MAX_BLUR_PX: Final = 3.0
"""Largest blur of an edge whose place is measured, in pixels."""

NOISE_RATIO, HEIGHT_RATIO = 2.0, 0.08
"""Largest RMS residual of the step that is fitted to an edge: as a multiple of the noise, and as a
share of the edge's height. With a larger one, the place is not known to a fraction of a pixel."""

MAX_SIGMA_PX: Final = 0.3
"""Largest standard deviation of the place of a taught edge, pixels."""

STEP_SLOPE: Final = 8 / (math.sqrt(2 * math.pi) * 1.5)
"""Response of Sobel's operator to an edge of one grey level with a blur of 1.5 pixels: the
picture's own blur and that of the Gaussian together."""


class EdgePoints(NamedTuple):
    """Edge pixels, with their places to a fraction of a pixel."""

    points: Array  # (N, 2), pixels
    normals: Array  # (N, 2), of length 1, to the brighter side
    slopes: Array  # (N,), response of Sobel's operator


class TaughtEdges(NamedTuple):
    """The edges of a picture as segments."""

    segments: Segments  # places in pixels of the picture
    exact: NDArray[np.bool_]  # (N,), whether the place is measured to a fraction of a pixel
    points: Array  # (M, 2), all edge pixels


def find_edge_points(grey: NDArray[np.uint8], contrast: float) -> EdgePoints:
    """Return the edge pixels of a picture (H, W) with at least a contrast in grey levels."""
    cv2 = load("cv2", "inspection needs")
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), SMOOTH_PX)
    across, down = (cv2.Sobel(smooth, cv2.CV_32F, *direction) for direction in ((1, 0), (0, 1)))
    gradients_in_quarters = (np.rint(4 * gradient).astype(np.int16) for gradient in (across, down))
    high = 4 * STEP_SLOPE * contrast
    edges = cv2.Canny(*gradients_in_quarters, 0.5 * high, high, L2gradient=True)
    edges[:2], edges[-2:], edges[:, :2], edges[:, -2:] = 0, 0, 0, 0
    rows, columns = np.nonzero(edges)
    slope = np.hypot(across[rows, columns], down[rows, columns]).astype(np.float64)
    normals = np.column_stack([across[rows, columns], down[rows, columns]]) / slope[:, None]
    pixels = np.column_stack([columns, rows]).astype(np.float64)
    magnitude = cv2.magnitude(across, down)
    before, after = (_interpolate(magnitude, pixels + side * normals) for side in (-1.0, 1.0))
    bend = before - 2 * slope + after
    shift = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)
    return EdgePoints(pixels + shift.clip(-1, 1)[:, None] * normals, normals, slope)


def _interpolate(image: NDArray[Any], at: Array) -> Array:
    """Return values of an image (H, W) at points (N, 2), interpolated between pixels."""
    cv2 = load("cv2", "inspection needs")
    x, y = at.astype(np.float32).T
    # cv2.remap takes fewer than 32768 columns: the points are laid out in rows
    wide = 4096
    padded = np.zeros((2, (len(x) // wide + 1) * wide), np.float32)
    padded[0, : len(x)], padded[1, : len(x)] = x, y
    maps = padded.reshape(2, -1, wide)
    sampled: Array = cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR).ravel()[: len(x)]
    return sampled.astype(np.float64)


def divide_into_segments(edges: EdgePoints) -> Segments:
    """Divide edge pixels into segments, the strongest first."""
    points, normals = edges.points, edges.normals
    if not len(points):
        return _no_segments()
    index = load("scipy.spatial", "locate needs").cKDTree(points)
    is_free = np.ones(len(points), dtype=np.bool_)
    rows: list[tuple[Array, Array, float, float]] = []
    for start in np.argsort(-edges.slopes, kind="stable").tolist():
        if not is_free[start] or len(rows) == MAX_SEGMENTS:
            continue
        neighbours = np.array(index.query_ball_point(points[start], HALF_LENGTH_PX + 0.5))
        normal = normals[start]
        offsets = points[neighbours] - points[start]
        has_direction = normals[neighbours] @ normal >= math.cos(MAX_DIRECTION_CHANGE)
        members = neighbours[
            is_free[neighbours] & has_direction & (np.abs(offsets @ normal) <= MAX_LINE_DISTANCE_PX)
        ]
        is_free[start] = False
        if len(members) < MIN_POINTS:
            continue
        is_free[members] = False
        rows.append(_fit_segment(points[members], normals[members]))
    if not rows:
        return _no_segments()
    middles, directions, bends, halves = (np.array(column) for column in zip(*rows, strict=True))
    ones = np.ones(len(rows))
    blur_shifts = np.zeros((len(rows), len(BLURS_PX2)))
    return Segments(middles, directions, bends, halves, 0 * ones, 1.2 * ones, 0 * ones, blur_shifts)


def _no_segments() -> Segments:
    none = np.zeros(0)
    places, blur_shifts = np.zeros((0, 2)), np.zeros((0, len(BLURS_PX2)))
    return Segments(places, places, none, none, none, none, none, blur_shifts)


def _fit_segment(points: Array, normals: Array) -> tuple[Array, Array, float, float]:
    """Return middle, normal, bend and half length of the segment through some points."""
    normal = normals.mean(axis=0)
    normal = normal / math.hypot(*normal)
    tangent = np.array([-normal[1], normal[0]])
    along = (points - points.mean(axis=0)) @ tangent
    middle = points.mean(axis=0) + tangent * (along.max() + along.min()) / 2
    along = (points - middle) @ tangent
    columns = np.column_stack([np.ones(len(along)), along, 0.5 * along**2])
    # how the normals turn along the segment determines its bend better than the points do
    normal_rows = np.column_stack([np.zeros(len(along)), -np.ones(len(along)), -along])
    rows = np.vstack([columns, 4.0 * normal_rows])
    values = np.concatenate([(points - middle) @ normal, 4.0 * (normals @ tangent)])
    offset, tilt, bend = np.linalg.lstsq(rows, values, rcond=None)[0].tolist()
    middle = middle + offset * normal
    turned_normal = normal - tilt * tangent
    half = float(along.max() - along.min()) / 2 + 0.5
    return middle, turned_normal / math.hypot(*turned_normal), bend, min(half, HALF_LENGTH_PX)


def fit_segments(levels: NDArray[Any], rough: Segments, points: Array, top: float) -> TaughtEdges:
    """Fit segments to the pixels of their picture.

    ``top`` is the largest possible grey level; heights are returned in levels of 255.
    """
    count = len(rough.half_lengths)
    fitted, is_usable = rough, np.ones(count, dtype=np.bool_)
    noise, sigmas = np.full(count, ROUNDING), np.full(count, np.inf)
    identity = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    for _ in range(FITS):
        pixels = find_band_pixels(make_bands(fitted, points), identity, levels)
        fitted, noise, is_usable, sigmas = _fit_once(pixels, fitted)
    is_near = ((fitted.middles - rough.middles) ** 2).sum(axis=1) <= MAX_SHIFT_PX**2
    typical_noise = (
        max(float(np.median(noise[is_usable])), ROUNDING) if is_usable.any() else ROUNDING
    )
    is_step = noise <= np.maximum(NOISE_RATIO * typical_noise, HEIGHT_RATIO * fitted.heights)
    fitted = fitted._replace(sigmas=sigmas * np.maximum(noise, typical_noise))
    exact = (
        is_usable
        & is_near
        & is_step
        & (fitted.sigmas <= MAX_SIGMA_PX)
        & (fitted.blurs <= MAX_BLUR_PX)
    )
    fitted = fitted._replace(heights=fitted.heights * 255 / top)
    return TaughtEdges(fitted, exact & (fitted.heights > 0), points)


def measure_blur_shifts(levels: NDArray[Any], segments: Segments, points: Array) -> Array:
    """Return the shifts of segments across their edges, (N, K), that each of K blurs causes.

    The picture is blurred for this. Blur moves an edge near a corner, a bend or another edge.
    """
    cv2 = load("cv2", "inspection needs")
    bands = make_bands(segments, points)
    identity = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    exact_levels = levels.astype(np.float64)
    blur_shifts = []
    for variance in BLURS_PX2:
        blurred = cv2.GaussianBlur(
            exact_levels, (0, 0), math.sqrt(variance), borderType=cv2.BORDER_REPLICATE
        )
        pixels = find_band_pixels(bands, identity, blurred)
        blurs = np.sqrt(segments.blurs**2 + variance)[pixels.owners]
        shifts = np.zeros(len(segments.half_lengths))
        for _ in range(BLURRED_FITS):
            across, _ = segments.coordinates_of(pixels.points, pixels.owners)
            fit = fit_bands(across - shifts[pixels.owners], blurs, pixels, len(shifts))
            shifts = shifts + np.where(np.isfinite(fit.sigmas), fit.shifts, 0.0).clip(-0.5, 0.5)
        blur_shifts.append(shifts.clip(-MAX_SHIFT_PX, MAX_SHIFT_PX))
    return np.column_stack(blur_shifts)


def _fit_once(
    pixels: BandPixels, segments: Segments
) -> tuple[Segments, Array, NDArray[np.bool_], Array]:
    """Fit place, tilt, blur and levels of segments in one iteration; return the segments.

    Also return the RMS residuals of the pixels, a mask of the segments that could be fitted, and
    the standard deviations of the places for noise of one grey level.
    """
    count = len(segments.half_lengths)
    across, along = segments.coordinates_of(pixels.points, pixels.owners)
    blurs = segments.blurs[pixels.owners]
    scaled = across / blurs
    slope = np.exp(-0.5 * scaled * scaled) / (blurs * math.sqrt(2 * math.pi))
    rise = load("scipy.special").ndtr(scaled)
    columns = np.stack([np.ones_like(scaled), rise, slope, slope * along, slope * scaled * blurs])
    square, right = normal_equations(columns, pixels.levels, pixels.owners, count)
    pixel_counts = np.bincount(pixels.owners, minlength=count)
    is_usable = pixel_counts >= 20
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", square), 1e-12))
    unit = square / scale[:, :, None] / scale[:, None] + 1e-6 * np.eye(5)
    inverse = np.linalg.inv(unit)
    values = (inverse @ (right / scale)[:, :, None])[:, :, 0] / scale
    inverse = inverse / scale[:, :, None] / scale[:, None]
    fitted = np.einsum("kp,pk->p", columns, values[pixels.owners])
    residual_squares = np.bincount(pixels.owners, (pixels.levels - fitted) ** 2, count)
    rms = np.sqrt(residual_squares / np.maximum(pixel_counts - 5, 1))
    height = values[:, 1]
    is_usable &= height > 1e-3
    safe_heights = np.where(is_usable, height, 1.0)
    shift, tilt, widening = (
        np.where(is_usable, -values[:, k] / safe_heights, 0.0).clip(-limit, limit)
        for k, limit in ((2, 0.5), (3, 0.1), (4, 0.3))
    )
    normals = segments.normals - tilt[:, None] * segments.tangents
    fitted_segments = segments._replace(
        middles=segments.middles + shift[:, None] * segments.normals,
        normals=normals / np.linalg.norm(normals, axis=1)[:, None],
        heights=height,
        blurs=np.maximum(segments.blurs * (1 + widening), MIN_BLUR_PX),
    )
    return fitted_segments, rms, is_usable, np.sqrt(inverse[:, 2, 2]) / safe_heights
