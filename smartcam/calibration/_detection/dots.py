"""Refine the centres of a circle grid's dots to a fraction of a pixel.

A round dot is seen as an ellipse. Behind a lens that blurs by a Gaussian of width ``s`` the grey
levels around its rim are ``offset + gain * erf(d / s')``, where ``d`` is the distance from the rim
and ``s' = sqrt(2) * s``. Eight values, the centre (two), the shape (three), blur, gain and offset,
are fitted to all pixels around a dot.

The centre of the ellipse is not the image of the dot's centre: perspective makes the nearer half
larger, and the lens bends the outline. :class:`GridMap` maps the whole grid into the image, which
gives the offset between the two centres.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.calibration._detection.image import GreyImage, shrink_image
from smartcam.calibration._detection.levenberg import (
    GAIN,
    covariances,
    fit_windows,
    make_fits,
)
from smartcam.calibration._detection.pixels import cut_windows, edge_profile
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
"""Largest RMS of a good fit's residuals, as a fraction of the gain; without a dot the RMS is as
large as the gain."""

UNREFINED_SIGMA_PX = 0.5
"""Standard deviation, pixels, that is assumed for a dot that could not be refined: a usual error of
other detectors."""

CENTRE, ELLIPSE = slice(0, 2), slice(2, 5)

MIN_DOTS_FOR_LENS = 20
"""The distortion of the grid by the lens, ten values for each axis, is fitted only to grids of at
least this many dots."""

# The mean squared distance of a polygon's points from its centre is R^2 / 2 (1 - 2/3 sin^2(pi / n))
# if its n corners are at distance R; for the unit disc it is 1/2.
_ANGLES = np.arange(32) * np.pi / 16
OUTLINE = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
OUTLINE /= np.sqrt(1 - 2 / 3 * np.sin(np.pi / 32) ** 2)
"""(32, 2), corners of a polygon with the same mean squared distance from its centre as the unit
disc."""


class Dots(NamedTuple):
    """Dots as ellipses in an image."""

    points: Array  # (N, 2), centres, pixels
    covariance: Array  # (N, 2, 2), pixels^2
    areas: Array  # (N,), pixels^2
    # (N,), whether the fit was good; the others have the point given to refine_dots
    fitted: NDArray[np.bool_]


class GridMap:
    """The map from a flat grid to pixels: a homography, and a cubic for the lens' distortion.

    Args:
        sheet_points: (N, 2), places of the dots on the sheet, in any unit.
        pixels: (N, 2), places of the dots in the image.
    """

    def __init__(self, sheet_points: Array, pixels: Array) -> None:
        homography = fit_homography(sheet_points, pixels)
        self.matrix: Array = np.full((3, 3), np.nan) if homography is None else homography
        self._centre = sheet_points.mean(axis=0)
        self._scale = np.abs(sheet_points - self._centre).max()
        self._bend = np.zeros((10, 2))
        if len(sheet_points) >= MIN_DOTS_FOR_LENS and homography is not None:
            deviations = pixels - apply_homography(homography, sheet_points)
            self._bend[:] = np.linalg.lstsq(self._powers(sheet_points), deviations, rcond=None)[0]

    def _powers(self, points: Array) -> Array:
        x, y = ((points - self._centre) / self._scale).T
        return np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)

    def __call__(self, points: Array) -> Array:
        """Map points (N, 2) of the sheet to pixels, (N, 2)."""
        return apply_homography(self.matrix, points) + self._powers(points) @ self._bend

    def shifts(self, points: Array, diameters: Array) -> Array:
        """Return the offsets (N, 2) of the outlines' centres from the dots' own centres, pixels."""
        # A tilted circle's image is an ellipse whose middle is not the image of the circle's
        # centre. The formula for a pinhole would ignore the lens, so the dot's outline is mapped
        # like the grid, and the centre of its area computed. For a polygon with corners p_i it is
        #     sum (p_i + p_i+1) (p_i x p_i+1) / (3 sum p_i x p_i+1).
        # Source, on this offset: Heikkila, Geometric Camera Calibration Using Circular Control
        # Points (2000).
        rim_points = points[:, None] + diameters[:, None, None] / 2 * OUTLINE
        outline = self(rim_points.reshape(-1, 2)).reshape(rim_points.shape) - self(points)[:, None]
        next_corners = np.roll(outline, -1, axis=1)
        doubled_areas = (
            outline[:, :, 0] * next_corners[:, :, 1] - outline[:, :, 1] * next_corners[:, :, 0]
        )
        moments = ((outline + next_corners) * doubled_areas[:, :, None]).sum(axis=1)
        centres: Array = moments / (3 * doubled_areas.sum(axis=1)[:, None])
        return centres


def refine_dots(image: GreyImage, points: Array, radii: Array, reaches: Array) -> Dots:
    """Return the fitted ellipses of dots.

    ``points`` (N, 2): centres, which may be off by a fraction of the radius. ``radii`` (N, 2, 2):
    vectors from the centre to the rim along the sheet's x and y. ``reaches`` (N, 2, 2): in the same
    directions, to the beginning of the next printed mark. All are in pixels.
    """
    longest_reach = float(np.hypot(reaches[:, 0], reaches[:, 1]).max())
    if longest_reach > MAX_REACH_PX:
        return _refine_smaller(
            image, points, radii, reaches, math.ceil(longest_reach / MAX_REACH_PX)
        )
    windows = cut_windows(image, points, reaches, MAX_REACH_PX, elliptical=True)
    start_offsets = points - windows.centre
    start_values = _start_values(start_offsets, radii)
    fits, is_good = fit_windows(
        _evaluate,
        windows,
        start_values,
        position_indices=(0, 1),
        max_residual_ratio=MAX_RESIDUAL_RATIO,
    )
    a, b, d = fits.values[:, ELLIPSE].T
    inverse_area = a * d - b * b  # the area is pi / det S
    distances = np.linalg.norm(fits.values[:, CENTRE] - start_offsets, axis=1)
    smallest_radii = np.linalg.norm(radii, axis=2).min(axis=1)
    is_good &= (
        (inverse_area > 0)
        & (distances < np.maximum(smallest_radii, 1.0))
        & (fits.values[:, GAIN] > 0)
    )
    centres = np.where(is_good[:, None], fits.values[:, CENTRE] + windows.centre, points)
    covariance = covariances(fits, windows.counts)[:, CENTRE, CENTRE].copy()
    covariance[~is_good] = UNREFINED_SIGMA_PX**2 * np.eye(2)
    expected_areas = np.pi * np.abs(np.linalg.det(radii))
    areas = np.where(is_good, np.pi / np.where(is_good, inverse_area, 1.0), expected_areas)
    return Dots(centres, covariance, areas, is_good)


def _refine_smaller(
    image: GreyImage, points: Array, radii: Array, reaches: Array, factor: int
) -> Dots:
    """Fit the dots in an image whose pixels are means of ``factor`` by ``factor`` pixels."""
    levels = shrink_image(image.levels, factor)
    smaller = GreyImage(levels, np.rint(levels).astype(np.uint8))
    dots = refine_dots(smaller, (points + 0.5) / factor - 0.5, radii / factor, reaches / factor)
    return Dots(
        (dots.points + 0.5) * factor - 0.5,
        dots.covariance * factor**2,
        dots.areas * factor**2,
        dots.fitted,
    )


def _start_values(centres: Array, radii: Array) -> Array:
    """Return the start values (N, 8) of a fit: those of ellipses with the given radii."""
    values = np.zeros((len(centres), 8))
    values[:, CENTRE] = centres
    # With the vectors to the rim as rows of W, m + W^T c is the rim for |c| = 1, so |W^-T (p - m)|
    # = 1 there. S = (W^T W)^(-1/2) is the symmetric matrix with the same lengths |S (p - m)|.
    squared_lengths, axes = np.linalg.eigh(radii.transpose(0, 2, 1) @ radii)
    shape = (axes / np.sqrt(np.maximum(squared_lengths, 0.25))[:, None]) @ axes.transpose(0, 2, 1)
    values[:, ELLIPSE] = shape[:, [0, 0, 1], [0, 1, 1]]
    return values


def _evaluate(windows: Windows, values: Array) -> Fits:
    # The ellipse is |S (p - m)| = 1 with S = (a b; b d). The distance from its rim is, to first
    # order, (r - 1) / |grad r| with r = |S (p - m)| and grad r = S S (p - m) / r.
    # Source: Sampson, Fitting Conic Sections to "Very Scattered" Data (1982).
    # Columns of r: for m -grad r, for a, b, d the entries of (S (p - m) / r) (p - m)^T. The change
    # of |grad r| with these values is neglected.
    weights = windows.weights
    u, v, a, b, d, blur, gain, offset = values.astype(np.float32).T[:, :, None]
    x, y = windows.x - u, windows.y - v
    normal_x, normal_y = a * x + b * y, b * x + d * y
    radius = np.maximum(np.sqrt(normal_x * normal_x + normal_y * normal_y), np.float32(1e-3))
    normal_x, normal_y = normal_x / radius, normal_y / radius
    # the gradient of r; r - 1 divided by its length is the distance from the rim
    gradient_x, gradient_y = a * normal_x + b * normal_y, b * normal_x + d * normal_y
    distance_scale = 1 / np.maximum(
        np.sqrt(gradient_x * gradient_x + gradient_y * gradient_y), np.float32(1e-6)
    )
    scale = 1 / (np.sqrt(np.float32(2)) * blur)
    signed_distance = (radius - 1) * distance_scale * scale
    profile, slope = edge_profile(signed_distance)
    slope = slope * weights
    slope_scale = slope * distance_scale
    product = profile * weights
    columns = (
        slope_scale * gradient_x,
        slope_scale * gradient_y,
        slope_scale * normal_x * x,
        slope_scale * (normal_x * y + normal_y * x),
        slope_scale * normal_y * y,
        slope * signed_distance,
        product,
        weights,
    )
    ones, gain_scale = np.ones_like(gain), gain * scale
    factors = (
        -gain_scale,
        -gain_scale,
        gain_scale,
        gain_scale,
        gain_scale,
        -gain / blur,
        ones,
        ones,
    )
    return make_fits(values, columns, factors, windows.levels - gain * product - offset * weights)
