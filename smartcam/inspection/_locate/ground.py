"""Fit steps whose sides are not of one level, such as edges of a part on a textured ground.

What the light beside an edge does *along* the edge moves no step, so it can be measured alone.
A texture does the same across the edge, where it does move the step: each side then has a slope
that is unknown, but no larger than those along the edges around it.
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

GROUND_SQUARE: Final = 4.0
"""Square of the slope along an edge, in parts of its variance by noise, that a quarter of the edges
have at least where the ground is not of one level; by noise alone it is 1.3."""

MIN_BANDS: Final = 12
"""Least number of bands from which the light on the ground is computed."""

GROUND_DISTANCE_PX: Final = 10.0
"""Standard deviation of the distance of the bands from which the ground beside a band is measured,
in pixels of the taught picture."""

COMMON_PX, COMMON_DIRECTION = 24.0, 0.5
"""Distance in pixels, and cosine of the angle between the normals, of edges that may have errors in
common."""

CHANCES: Final = 3.0
"""Standard deviations by which neighbours agree in their errors that have one in common."""

LEAST_PART: Final = 1e-4
"""Least standard deviation of a slope, as a share of the noise."""


class Ground(NamedTuple):
    """Light beside N edges that is not of one level: (N,), grey levels for a band's half width."""

    dark: Array  # standard deviation of the slope on the darker side
    bright: Array


def ground_beside(
    places: tuple[Array, Array],
    blurs: Array,
    pixels: BandPixels,
    segments: Segments,
    used: NDArray[np.bool_],
) -> Ground | None:
    """Return the slopes of the light along edges; None: each side has one level.

    ``places``: across and along, (P,) each; ``used`` (N,): the bands that have an edge.
    """
    rise, slope = _step(places[0], blurs)
    along, ones = places[1] / BAND_PX, np.ones_like(rise)
    columns = np.stack([ones, rise, slope, (1 - rise) * along, rise * along])
    values, inverse, variances, _ = _solved(columns, pixels, np.zeros((len(used), 5)))
    measured = used & (variances > 0)
    if np.count_nonzero(measured) < MIN_BANDS:
        return None
    by_noise = float(np.median(variances[measured])) * np.diagonal(inverse, axis1=1, axis2=2)
    grounds = []
    for side, shift in ((3, -0.5), (4, 0.5)):
        squares, noise = values[measured, side] ** 2, by_noise[measured, side]
        if float(np.percentile(squares / noise, 75)) < GROUND_SQUARE:
            grounds.append(np.zeros(len(used)))
            continue
        at = segments.middles + shift * BAND_PX * segments.normals
        distances = np.linalg.norm(at[:, None] - at[measured], axis=2)
        closeness = np.exp(-0.5 * (distances / GROUND_DISTANCE_PX) ** 2) / noise
        beyond = (closeness @ (squares - noise)) / np.maximum(closeness.sum(axis=1), 1e-9)
        grounds.append(np.sqrt(np.maximum(beyond, 0.0)))
    return Ground(*grounds) if any(ground.any() for ground in grounds) else None


def fit_on_ground(
    places: tuple[Array, Array], blurs: Array, pixels: BandPixels, ground: Ground, noise: float
) -> StepFit:
    """Return the steps of all bands beside a ground, for a picture of some noise."""
    rise, slope = _step(places[0], blurs)
    columns, known = [np.ones_like(rise), rise, slope], [np.zeros_like(ground.dark)] * 3
    for side, steep in ((1 - rise, ground.dark), (rise, ground.bright)):
        if steep.any():
            columns += [side * place / BAND_PX for place in places]
            known += [1 / np.maximum(steep / noise, LEAST_PART) ** 2] * 2
    values, inverse, variances, freedoms = _solved(
        np.stack(columns), pixels, np.column_stack(known)
    )
    good = variances > 0
    heights = np.where(good, values[:, 1], 0.0)
    tall = np.where(np.abs(heights) > 1e-6, heights, 1e-6)
    infinite = np.where(good, 0.0, np.inf)
    return StepFit(
        np.where(good, -values[:, 2] / tall, 0.0),
        np.sqrt(np.maximum(inverse[:, 2, 2], 0.0)) / np.abs(tall) + infinite,
        heights,
        np.sqrt(np.maximum(inverse[:, 1, 1], 0.0)) + infinite,
        np.maximum(variances, ROUNDING**2),
        freedoms,
        0.0,
    )


def common_error(
    segments: Segments, shifts: Array, used: NDArray[np.bool_], *, sure: bool
) -> float:
    """Return the factor of a pose's variance for errors that neighbours have in common.

    ``shifts`` (N,): in parts of their standard deviations. ``sure``: there are such errors; else
    there are where they are more than chance.
    """
    middles, normals, z = segments.middles[used], segments.normals[used], shifts[used]
    is_near = np.linalg.norm(middles[:, None] - middles, axis=2) <= COMMON_PX
    is_near &= normals @ normals.T >= COMMON_DIRECTION
    np.fill_diagonal(is_near, val=False)
    common = float(z @ is_near @ z) / max(float(z @ z), 1e-9)
    chance = math.sqrt(2 * int(is_near.sum())) / max(len(z), 1)
    return 1 + max(common, 0.0) if sure or common > CHANCES * chance else 1.0


def _step(across: Array, blurs: Array) -> tuple[Array, Array]:
    part = across / blurs
    slope = np.exp(-0.5 * part * part) / (blurs * math.sqrt(2 * math.pi))
    return load("scipy.special").ndtr(part), slope


def _solved(columns: Array, pixels: BandPixels, known: Array) -> tuple[Array, Array, Array, Array]:
    """Return the values (N, K) of bands, and their covariance for noise of one grey level.

    Besides, the pixels' variance about them, 0 where a band has too few, and degrees of freedom.
    ``known`` (N, K): the variance of the noise relative to the variance of each value; 0: it is
    unknown.
    """
    owners, (count, size) = pixels.owners, known.shape
    number = np.bincount(owners, minlength=count).astype(np.float64)
    means = np.bincount(owners, pixels.levels, count) / np.maximum(number, 1.0)
    levels = pixels.levels - means[owners]
    square, right = normal_equations(columns, levels, owners, count)
    regular = square + (known[:, :, None] + 1e-7) * np.eye(size)
    inverse = np.asarray(np.linalg.inv(regular), np.float64)
    values = (inverse @ right[:, :, None])[:, :, 0]
    fitted = (columns * values[owners].T).sum(axis=0)
    left = np.bincount(owners, (levels - fitted) ** 2, count)
    taken: Array = size - (np.diagonal(inverse, axis1=1, axis2=2) * known).sum(axis=1)
    freedoms = number - taken
    good = (number >= MIN_BAND_PIXELS) & (freedoms >= 2)
    variances: Array = np.where(good, left / np.maximum(freedoms, 1.0), 0.0)
    return values, inverse, variances, np.maximum(freedoms, 1.0)
