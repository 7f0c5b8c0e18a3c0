"""Refine the dots of a circle grid.

A round dot is seen as an ellipse. Behind a lens that blurs by a Gaussian of width ``s`` the grey
levels around its rim are ``offset + gain * erf(d / s')``, where ``d`` is the distance from the rim
and ``s' = sqrt(2) * s``. Eight values, the centre (two), the shape (three), blur, gain and offset,
are fitted to all pixels around a dot.

The centre of the ellipse is not the image of the dot's centre: perspective makes the nearer half
larger, and a lens bends it. :class:`GridMap` maps the whole grid into the image, and so gives the
distance of a round dot's outline's centre from the image of the dot's centre.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.calibration._detection.image import GreyImage, reduced
from smartcam.calibration._detection.levenberg import (
    GAIN,
    covariances,
    fits_of,
    refined,
)
from smartcam.calibration._detection.pixels import cut_windows, edge
from smartcam.calibration._homography import apply_homography, fit_homography

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.calibration._detection.levenberg import Fits
    from smartcam.calibration._detection.pixels import Windows
    from smartcam.geometry._inside import Array

MAX_REACH_PX = 20
"""A dot's window reaches at most this many pixels to each side; a larger dot is fitted in a reduced
image."""

MAX_RESIDUAL_RATIO = 0.5
"""Largest RMS of a good fit's residuals, as a part of the gain; where there is no dot it is 1."""

UNREFINED_SIGMA_PX = 0.5
"""Standard deviation, pixels, of a dot that could not be refined: that of common detectors."""

MIDDLE, SHAPE = slice(0, 2), slice(2, 5)

MIN_DOTS_FOR_LENS = 20
"""From this many dots on, the bend of the lens is fitted to the grid, too: ten values for each
axis."""

# The points of a regular polygon with n corners at distance R are on average, squared,
# R^2 / 2 (1 - 2/3 sin^2(pi / n)) from its middle; those of the unit disc 1/2.
_ANGLES = np.arange(32) * np.pi / 16
OUTLINE = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
OUTLINE /= np.sqrt(1 - 2 / 3 * np.sin(np.pi / 32) ** 2)
"""(32, 2), corners of a polygon whose points are on average as far from its middle, squared, as
those of the unit disc."""


class Dots(NamedTuple):
    """Dots as ellipses in an image."""

    points: Array  # (N, 2), centres, pixels
    covariance: Array  # (N, 2, 2), pixels^2
    areas: Array  # (N,), pixels^2
    # (N,), whether the fit was good; a dot that was not fitted keeps its place
    fitted: NDArray[np.bool_]


class GridMap:
    """The map from a flat grid to pixels: a homography, and a cubic where a lens bends the grid.

    Args:
        flat: (N, 2), places of the dots on the sheet, metres.
        pixels: (N, 2), places of the dots in the image.
    """

    def __init__(self, flat: Array, pixels: Array) -> None:
        homography = fit_homography(flat, pixels)
        self.matrix: Array = np.full((3, 3), np.nan) if homography is None else homography
        self._middle = flat.mean(axis=0)
        self._scale = np.abs(flat - self._middle).max()
        self._bend = np.zeros((10, 2))
        if len(flat) >= MIN_DOTS_FOR_LENS and homography is not None:
            deviations = pixels - apply_homography(homography, flat)
            self._bend[:] = np.linalg.lstsq(self._powers(flat), deviations, rcond=None)[0]

    def _powers(self, flat: Array) -> Array:
        x, y = ((flat - self._middle) / self._scale).T
        return np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)

    def __call__(self, flat: Array) -> Array:
        """Map points (N, 2) of the sheet to pixels, (N, 2)."""
        return apply_homography(self.matrix, flat) + self._powers(flat) @ self._bend

    def shifts(self, flat: Array, diameters: Array) -> Array:
        """Return the offsets of the outlines' centres from those of the dots, (N, 2), pixels."""
        # A tilted circle's image is an ellipse whose middle is not the image of the circle's
        # centre. Instead of a formula for a pinhole, the dot's outline is mapped as the grid is,
        # lens and all, and the middle of its area taken: of a polygon with corners p_i     sum (p_i
        # + p_i+1) (p_i x p_i+1) / (3 sum p_i x p_i+1). Source of the bias: Heikkila, Geometric
        # Camera Calibration Using Circular Control Points (2000).
        at = flat[:, None] + diameters[:, None, None] / 2 * OUTLINE
        outline = self(at.reshape(-1, 2)).reshape(at.shape) - self(flat)[:, None]
        ahead = np.roll(outline, -1, axis=1)
        doubled = outline[:, :, 0] * ahead[:, :, 1] - outline[:, :, 1] * ahead[:, :, 0]
        moments = ((outline + ahead) * doubled[:, :, None]).sum(axis=1)
        middles: Array = moments / (3 * doubled.sum(axis=1)[:, None])
        return middles


def refine_dots(image: GreyImage, points: Array, radii: Array, reaches: Array) -> Dots:
    """Return the fitted ellipses of dots.

    ``points`` (N, 2) are known to a fraction of the radius. ``radii`` (N, 2, 2) lead from the
    centre to the rim along the sheet's x and y, ``reaches`` as far as nothing but the dot is
    visible; all in pixels.
    """
    longest = float(np.hypot(reaches[:, 0], reaches[:, 1]).max())
    if longest > MAX_REACH_PX:
        return _refine_smaller(image, points, radii, reaches, math.ceil(longest / MAX_REACH_PX))
    windows = cut_windows(image, points, reaches, MAX_REACH_PX, round_=True)
    offsets = points - windows.middle
    guess = _guess(offsets, radii)
    fits, good = refined(_evaluate, windows, guess, moving=(0, 1), worst=MAX_RESIDUAL_RATIO)
    a, b, d = fits.values[:, SHAPE].T
    inverse_area = a * d - b * b  # the area is pi / det S
    moved = np.linalg.norm(fits.values[:, MIDDLE] - offsets, axis=1)
    smallest = np.linalg.norm(radii, axis=2).min(axis=1)
    good &= (inverse_area > 0) & (moved < np.maximum(smallest, 1.0)) & (fits.values[:, GAIN] > 0)
    middles = np.where(good[:, None], fits.values[:, MIDDLE] + windows.middle, points)
    covariance = covariances(fits, windows.counts)[:, MIDDLE, MIDDLE].copy()
    covariance[~good] = UNREFINED_SIGMA_PX**2 * np.eye(2)
    expected = np.pi * np.abs(np.linalg.det(radii))
    areas = np.where(good, np.pi / np.where(good, inverse_area, 1.0), expected)
    return Dots(middles, covariance, areas, good)


def _refine_smaller(
    image: GreyImage, points: Array, radii: Array, reaches: Array, times: int
) -> Dots:
    """Fit the dots in an image whose pixels are means of ``times`` by ``times`` pixels."""
    levels = reduced(image.levels, times)
    smaller = GreyImage(levels, np.rint(levels).astype(np.uint8))
    dots = refine_dots(smaller, (points + 0.5) / times - 0.5, radii / times, reaches / times)
    return Dots(
        (dots.points + 0.5) * times - 0.5,
        dots.covariance * times**2,
        dots.areas * times**2,
        dots.fitted,
    )


def _guess(start: Array, radii: Array) -> Array:
    """Return the values (N, 8) that a fit begins with: the ellipses of the given radii."""
    values = np.zeros((len(start), 8))
    values[:, MIDDLE] = start
    # With W the ways (as rows) to the rim, m + W^T c is the rim for |c| = 1, so |W^-T (p - m)| = 1
    # there. S = (W^T W)^(-1/2) is the symmetric matrix with the same lengths |S (p - m)|.
    lengths, axes = np.linalg.eigh(radii.transpose(0, 2, 1) @ radii)
    shape = (axes / np.sqrt(np.maximum(lengths, 0.25))[:, None]) @ axes.transpose(0, 2, 1)
    values[:, SHAPE] = shape[:, [0, 0, 1], [0, 1, 1]]
    return values


def _evaluate(windows: Windows, values: Array) -> Fits:
    # The ellipse is |S (p - m)| = 1 with S = (a b; b d). The distance from its rim is, to first
    # order, (r - 1) / |grad r| with r = |S (p - m)| and grad r = S S (p - m) / r.
    # Source: Sampson, Fitting Conic Sections to "Very Scattered" Data (1982).
    # Columns: of m -grad r, of a, b, d the elements of (S (p - m) / r) (p - m)^T; that |grad r|
    # moves with them, too, is left out.
    weights = windows.weights
    u, v, a, b, d, blur, gain, offset = values.astype(np.float32).T[:, :, None]
    x, y = windows.x - u, windows.y - v
    across, down = a * x + b * y, b * x + d * y
    radius = np.maximum(np.sqrt(across * across + down * down), np.float32(1e-3))
    across, down = across / radius, down / radius
    # the gradient of the radius, whose length turns it into a distance from the rim
    by_x, by_y = a * across + b * down, b * across + d * down
    steep = 1 / np.maximum(np.sqrt(by_x * by_x + by_y * by_y), np.float32(1e-6))
    scale = 1 / (np.sqrt(np.float32(2)) * blur)
    outward = (radius - 1) * steep * scale
    shape, slope = edge(outward)
    slope = slope * weights
    rise = slope * steep
    product = shape * weights
    columns = (
        rise * by_x,
        rise * by_y,
        rise * across * x,
        rise * (across * y + down * x),
        rise * down * y,
        slope * outward,
        product,
        weights,
    )
    ones, tall = np.ones_like(gain), gain * scale
    factors = (-tall, -tall, tall, tall, tall, -gain / blur, ones, ones)
    return fits_of(values, columns, factors, windows.levels - gain * product - offset * weights)
