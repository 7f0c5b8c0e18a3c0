"""Fit edges on a textured background, where the grey level beside an edge is not constant.

A texture changes the grey level along an edge and across it by about the same. Changes along the
edge do not move the fitted step, so they can be measured. Changes across the edge do move the step.
So the fit gives each side of an edge an unknown slope, whose expected size is that of the slopes
measured along neighbouring edges.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.inspection._locate.segments import (
    BAND_PX,
    MIN_BAND_PIXELS,
    StepFit,
    normal_equations,
)
from smartcam.inspection._measure.edges import ROUNDING

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array
    from smartcam.inspection._locate.segments import BandPixels, Segments

UNEVEN_SLOPE_SQUARE: Final = 4.0
"""Upper quartile of the squared slopes along edges, as multiples of their variances from noise,
above which the background is not constant. With noise alone it is 1.3."""

MIN_BANDS: Final = 12
"""Least number of bands from which the background's slopes are computed."""

NEIGHBOUR_DISTANCE_PX: Final = 10.0
"""Standard deviation, pixels of the taught picture, of the Gaussian by which the slopes of other
bands are weighted by their distance from a band."""

COMMON_PX, COMMON_DIRECTION = 24.0, 0.5
"""Edges may have an error in common if they are nearer than this, pixels, and the angle between
their normals has at least this cosine."""

COMMON_ERROR_SIGMAS: Final = 3.0
"""Agreement of neighbours' errors, in standard deviations, above which they have a common error."""

MIN_SLOPE_SHARE: Final = 1e-4
"""Least standard deviation of a slope, as a share of the noise."""


class BackgroundSlopes(NamedTuple):
    """Slopes of the grey level beside N edges, (N,), grey levels per half width of a band."""

    dark: Array  # standard deviation of the slope on the darker side
    bright: Array


def measure_background(
    coordinates: tuple[Array, Array],
    blurs: Array,
    pixels: BandPixels,
    segments: Segments,
    used: NDArray[np.bool_],
) -> BackgroundSlopes | None:
    """Return the slopes of the grey level beside edges; None: each side has a constant level.

    ``coordinates``: of the pixels across and along their edges, (P,) each. ``used`` (N,): mask of
    the bands that have an edge.
    """
    rise, step_derivative = _step_model(coordinates[0], blurs)
    along, ones = coordinates[1] / BAND_PX, np.ones_like(rise)
    columns = np.stack([ones, rise, step_derivative, (1 - rise) * along, rise * along])
    values, inverse, variances, _ = _solve_bands(columns, pixels, np.zeros((len(used), 5)))
    is_measured = used & (variances > 0)
    if np.count_nonzero(is_measured) < MIN_BANDS:
        return None
    noise_variances = float(np.median(variances[is_measured])) * np.diagonal(
        inverse, axis1=1, axis2=2
    )
    slope_sigmas = []
    for side, shift in ((3, -0.5), (4, 0.5)):
        squares, noise = values[is_measured, side] ** 2, noise_variances[is_measured, side]
        if float(np.percentile(squares / noise, 75)) < UNEVEN_SLOPE_SQUARE:
            slope_sigmas.append(np.zeros(len(used)))
            continue
        side_points = segments.middles + shift * BAND_PX * segments.normals
        distances = np.linalg.norm(side_points[:, None] - side_points[is_measured], axis=2)
        closeness = np.exp(-0.5 * (distances / NEIGHBOUR_DISTANCE_PX) ** 2) / noise
        slope_variances = (closeness @ (squares - noise)) / np.maximum(closeness.sum(axis=1), 1e-9)
        slope_sigmas.append(np.sqrt(np.maximum(slope_variances, 0.0)))
    return BackgroundSlopes(*slope_sigmas) if any(map(np.any, slope_sigmas)) else None


def fit_on_background(
    coordinates: tuple[Array, Array],
    blurs: Array,
    pixels: BandPixels,
    background: BackgroundSlopes,
    noise: float,
) -> StepFit:
    """Return the steps of all bands if their sides have slopes; ``noise``: grey levels."""
    rise, step_derivative = _step_model(coordinates[0], blurs)
    columns = [np.ones_like(rise), rise, step_derivative]
    priors = [np.zeros_like(background.dark)] * 3
    for side, sigmas in ((1 - rise, background.dark), (rise, background.bright)):
        if sigmas.any():
            columns += [side * coordinate / BAND_PX for coordinate in coordinates]
            priors += [1 / np.maximum(sigmas / noise, MIN_SLOPE_SHARE) ** 2] * 2
    values, inverse, variances, freedoms = _solve_bands(
        np.stack(columns), pixels, np.column_stack(priors)
    )
    is_usable = variances > 0
    heights = np.where(is_usable, values[:, 1], 0.0)
    safe_heights = np.where(np.abs(heights) > 1e-6, heights, 1e-6)
    infinite = np.where(is_usable, 0.0, np.inf)
    return StepFit(
        np.where(is_usable, -values[:, 2] / safe_heights, 0.0),
        np.sqrt(np.maximum(inverse[:, 2, 2], 0.0)) / np.abs(safe_heights) + infinite,
        heights,
        np.sqrt(np.maximum(inverse[:, 1, 1], 0.0)) + infinite,
        np.maximum(variances, ROUNDING**2),
        freedoms,
        0.0,
    )


def common_error_factor(
    segments: Segments, shifts: Array, used: NDArray[np.bool_], *, background_varies: bool
) -> float:
    """Return the factor of a pose's variance for errors that neighbours have in common.

    ``shifts`` (N,): as multiples of their standard deviations. ``background_varies``: so
    that common errors are expected; else they count only if they exceed chance.
    """
    middles, normals, z = segments.middles[used], segments.normals[used], shifts[used]
    is_near = np.linalg.norm(middles[:, None] - middles, axis=2) <= COMMON_PX
    is_near &= normals @ normals.T >= COMMON_DIRECTION
    np.fill_diagonal(is_near, val=False)
    common = float(z @ is_near @ z) / max(float(z @ z), 1e-9)
    chance_sigma = math.sqrt(2 * int(is_near.sum())) / max(len(z), 1)
    counts = background_varies or common > COMMON_ERROR_SIGMAS * chance_sigma
    return 1 + max(common, 0.0) if counts else 1.0


def _step_model(across: Array, blurs: Array) -> tuple[Array, Array]:
    scaled = across / blurs
    slope = np.exp(-0.5 * scaled * scaled) / (blurs * math.sqrt(2 * math.pi))
    return load("scipy.special").ndtr(scaled), slope


def _solve_bands(
    columns: Array, pixels: BandPixels, priors: Array
) -> tuple[Array, Array, Array, Array]:
    """Return the values (N, K) of bands, and their covariance for noise of one grey level.

    Also return the variance of each band's pixels about the fit, 0 if a band has too few pixels,
    and the degrees of freedom. ``priors`` (N, K): ratio of the noise's variance to the expected
    variance of each value; 0: that variance is not known.
    """
    owners, (count, size) = pixels.owners, priors.shape
    pixel_counts = np.bincount(owners, minlength=count).astype(np.float64)
    means = np.bincount(owners, pixels.levels, count) / np.maximum(pixel_counts, 1.0)
    levels = pixels.levels - means[owners]
    square, right = normal_equations(columns, levels, owners, count)
    regular = square + (priors[:, :, None] + 1e-7) * np.eye(size)
    inverse = np.asarray(np.linalg.inv(regular), np.float64)
    values = (inverse @ right[:, :, None])[:, :, 0]
    fitted = (columns * values[owners].T).sum(axis=0)
    residual_squares = np.bincount(owners, (levels - fitted) ** 2, count)
    fitted_count: Array = size - (np.diagonal(inverse, axis1=1, axis2=2) * priors).sum(axis=1)
    freedoms = pixel_counts - fitted_count
    is_usable = (pixel_counts >= MIN_BAND_PIXELS) & (freedoms >= 2)
    variances: Array = np.where(is_usable, residual_squares / np.maximum(freedoms, 1.0), 0.0)
    return values, inverse, variances, np.maximum(freedoms, 1.0)
