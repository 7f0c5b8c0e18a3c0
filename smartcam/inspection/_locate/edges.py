"""Find the edges of a taught picture as segments, with their place, direction and height."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.inspection._locate.segments import (
    BLURS_PX2,
    MIN_BLUR_PX,
    Segments,
    fit_bands,
    make_bands,
    normal_equations,
    pixels_in,
)
from smartcam.inspection._measure.edges import ROUNDING

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array
    from smartcam.inspection._locate.segments import BandPixels

SMOOTH_PX: Final = 1.0
"""Standard deviation of the Gaussian before the gradient, in pixels."""

HALF_LENGTH_PX: Final = 4.0
"""Largest half length of a segment, pixels."""

MAX_LINE_DISTANCE_PX: Final = 1.0
"""Largest distance of a segment's points from a straight line through its middle, pixels."""

MAX_TURN: Final = math.radians(20.0)
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
"""Largest distance, pixels, by which a fit may move a segment; farther off is another edge."""

MAX_BLUR_PX: Final = 3.0
"""Largest blur of an edge whose place is measured, in pixels."""

MISFIT_NOISES, MAX_MISFIT = 2.0, 0.08
"""Largest RMS residual of a band, as a multiple of the noise, and as a share of the edge's height,
up to which the edge is a step whose place can be measured to a fraction of a pixel."""

MAX_SIGMA_PX: Final = 0.3
"""Largest standard deviation of the place of a taught edge, pixels."""

STEP_SLOPE: Final = 8 / (math.sqrt(2 * math.pi) * 1.5)
"""Response of Sobel's operator to an edge of one grey level with a blur of 1.5 pixels, that of the
picture and the Gaussian together."""


class EdgePoints(NamedTuple):
    """Edge pixels with their subpixel places."""

    points: Array  # (N, 2), pixels
    normals: Array  # (N, 2), of length 1, to the brighter side
    slopes: Array  # (N,), response of Sobel's operator


class TaughtEdges(NamedTuple):
    """The edges of a picture as segments."""

    segments: Segments  # places in pixels of the picture
    exact: NDArray[np.bool_]  # (N,), those whose place is measured to a fraction of a pixel
    points: Array  # (M, 2), all edge pixels


def edge_points(grey: NDArray[np.uint8], contrast: float) -> EdgePoints:
    """Return the edge pixels of a picture (H, W) with at least a contrast in grey levels."""
    cv2 = load("cv2", "inspection needs")
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), SMOOTH_PX)
    across, down = (cv2.Sobel(smooth, cv2.CV_32F, *direction) for direction in ((1, 0), (0, 1)))
    quarters = (np.rint(4 * gradient).astype(np.int16) for gradient in (across, down))
    most = 4 * STEP_SLOPE * contrast
    edges = cv2.Canny(*quarters, 0.5 * most, most, L2gradient=True)
    edges[:2], edges[-2:], edges[:, :2], edges[:, -2:] = 0, 0, 0, 0
    rows, columns = np.nonzero(edges)
    slope = np.hypot(across[rows, columns], down[rows, columns]).astype(np.float64)
    normals = np.column_stack([across[rows, columns], down[rows, columns]]) / slope[:, None]
    at = np.column_stack([columns, rows]).astype(np.float64)
    size = cv2.magnitude(across, down)
    before, after = (_sampled(size, at + side * normals) for side in (-1.0, 1.0))
    bend = before - 2 * slope + after
    shift = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)
    return EdgePoints(at + shift.clip(-1, 1)[:, None] * normals, normals, slope)


def _sampled(image: NDArray[Any], at: Array) -> Array:
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


def segments_of(edges: EdgePoints) -> Segments:
    """Divide edge pixels into segments, the strongest first."""
    points, normals = edges.points, edges.normals
    if not len(points):
        return _no_segments()
    index = load("scipy.spatial", "locate needs").cKDTree(points)
    free = np.ones(len(points), dtype=np.bool_)
    rows: list[tuple[Array, Array, float, float]] = []
    for start in np.argsort(-edges.slopes, kind="stable").tolist():
        if not free[start] or len(rows) == MAX_SEGMENTS:
            continue
        around = np.array(index.query_ball_point(points[start], HALF_LENGTH_PX + 0.5))
        normal = normals[start]
        offsets = points[around] - points[start]
        alike = normals[around] @ normal >= math.cos(MAX_TURN)
        members = around[free[around] & alike & (np.abs(offsets @ normal) <= MAX_LINE_DISTANCE_PX)]
        free[start] = False
        if len(members) < MIN_POINTS:
            continue
        free[members] = False
        rows.append(_segment(points[members], normals[members]))
    if not rows:
        return _no_segments()
    middles, directions, bends, halves = (np.array(column) for column in zip(*rows, strict=True))
    ones = np.ones(len(rows))
    moves = np.zeros((len(rows), len(BLURS_PX2)))
    return Segments(middles, directions, bends, halves, 0 * ones, 1.2 * ones, 0 * ones, moves)


def _no_segments() -> Segments:
    none = np.zeros(0)
    places, moves = np.zeros((0, 2)), np.zeros((0, len(BLURS_PX2)))
    return Segments(places, places, none, none, none, none, none, moves)


def _segment(points: Array, normals: Array) -> tuple[Array, Array, float, float]:
    """Return middle, normal, bend and half length of the segment through some points."""
    normal = normals.mean(axis=0)
    normal = normal / math.hypot(*normal)
    tangent = np.array([-normal[1], normal[0]])
    along = (points - points.mean(axis=0)) @ tangent
    middle = points.mean(axis=0) + tangent * (along.max() + along.min()) / 2
    along = (points - middle) @ tangent
    columns = np.column_stack([np.ones(len(along)), along, 0.5 * along**2])
    # the change of the normals along the segment determines its bend better than the points do
    turning = np.column_stack([np.zeros(len(along)), -np.ones(len(along)), -along])
    rows = np.vstack([columns, 4.0 * turning])
    values = np.concatenate([(points - middle) @ normal, 4.0 * (normals @ tangent)])
    offset, tilt, bend = np.linalg.lstsq(rows, values, rcond=None)[0].tolist()
    middle = middle + offset * normal
    turned = normal - tilt * tangent
    half = float(along.max() - along.min()) / 2 + 0.5
    return middle, turned / math.hypot(*turned), bend, min(half, HALF_LENGTH_PX)


def fit_segments(levels: NDArray[Any], rough: Segments, points: Array, top: float) -> TaughtEdges:
    """Return segments, fitted to the pixels of their picture.

    ``top`` is the largest grey level of the picture; heights are returned in levels of 255.
    """
    count = len(rough.halves)
    shifted, good = rough, np.ones(count, dtype=np.bool_)
    noise, sigmas = np.full(count, ROUNDING), np.full(count, np.inf)
    identity = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    for _ in range(FITS):
        pixels = pixels_in(make_bands(shifted, points), identity, levels)
        shifted, noise, good, sigmas = _fitted(pixels, shifted)
    moved = ((shifted.middles - rough.middles) ** 2).sum(axis=1) <= MAX_SHIFT_PX**2
    typical = max(float(np.median(noise[good])), ROUNDING) if good.any() else ROUNDING
    step = noise <= np.maximum(MISFIT_NOISES * typical, MAX_MISFIT * shifted.heights)
    shifted = shifted._replace(sigmas=sigmas * np.maximum(noise, typical))
    exact = good & moved & step & (shifted.sigmas <= MAX_SIGMA_PX) & (shifted.blurs <= MAX_BLUR_PX)
    shifted = shifted._replace(heights=shifted.heights * 255 / top)
    return TaughtEdges(shifted, exact & (shifted.heights > 0), points)


def blurred_moves(levels: NDArray[Any], segments: Segments, points: Array) -> Array:
    """Return the shifts of segments, (N, K), across their edges, that each of K blurs causes.

    The picture is blurred for this. Beside a corner, a bend or another edge, blur moves an edge.
    """
    cv2 = load("cv2", "inspection needs")
    bands = make_bands(segments, points)
    identity = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    exact = levels.astype(np.float64)
    moves = []
    for variance in BLURS_PX2:
        more = cv2.GaussianBlur(exact, (0, 0), math.sqrt(variance), borderType=cv2.BORDER_REPLICATE)
        pixels = pixels_in(bands, identity, more)
        blurs = np.sqrt(segments.blurs**2 + variance)[pixels.owners]
        moved = np.zeros(len(segments.halves))
        for _ in range(BLURRED_FITS):
            across, _ = segments.places(pixels.points, pixels.owners)
            fit = fit_bands(across - moved[pixels.owners], blurs, pixels, len(moved))
            moved = moved + np.where(np.isfinite(fit.sigmas), fit.shifts, 0.0).clip(-0.5, 0.5)
        moves.append(moved.clip(-MAX_SHIFT_PX, MAX_SHIFT_PX))
    return np.column_stack(moves)


def _fitted(
    pixels: BandPixels, segments: Segments
) -> tuple[Segments, Array, NDArray[np.bool_], Array]:
    """Return segments after one iteration of a fit of place, tilt, blur and levels.

    Also return the RMS residuals of the pixels, a mask of the segments that could be fitted, and
    the standard deviations of the places for noise of one grey level.
    """
    count = len(segments.halves)
    across, along = segments.places(pixels.points, pixels.owners)
    blurs = segments.blurs[pixels.owners]
    part = across / blurs
    slope = np.exp(-0.5 * part * part) / (blurs * math.sqrt(2 * math.pi))
    rise = load("scipy.special").ndtr(part)
    columns = np.stack([np.ones_like(part), rise, slope, slope * along, slope * part * blurs])
    square, right = normal_equations(columns, pixels.levels, pixels.owners, count)
    number = np.bincount(pixels.owners, minlength=count)
    good = number >= 20
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", square), 1e-12))
    unit = square / scale[:, :, None] / scale[:, None] + 1e-6 * np.eye(5)
    inverse = np.linalg.inv(unit)
    values = (inverse @ (right / scale)[:, :, None])[:, :, 0] / scale
    inverse = inverse / scale[:, :, None] / scale[:, None]
    fitted = np.einsum("kp,pk->p", columns, values[pixels.owners])
    left = np.bincount(pixels.owners, (pixels.levels - fitted) ** 2, count)
    rms = np.sqrt(left / np.maximum(number - 5, 1))
    height = values[:, 1]
    good &= height > 1e-3
    tall = np.where(good, height, 1.0)
    shift, tilt, growth = (
        np.where(good, -values[:, k] / tall, 0.0).clip(-most, most)
        for k, most in ((2, 0.5), (3, 0.1), (4, 0.3))
    )
    normals = segments.normals - tilt[:, None] * segments.tangents
    made = segments._replace(
        middles=segments.middles + shift[:, None] * segments.normals,
        normals=normals / np.linalg.norm(normals, axis=1)[:, None],
        heights=height,
        blurs=np.maximum(segments.blurs * (1 + growth), MIN_BLUR_PX),
    )
    return made, rms, good, np.sqrt(inverse[:, 2, 2]) / tall
