"""Measure the distance of a region of a depth map, and show its small differences."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from smartcam._argument_checks import a_number, check_arguments
from smartcam._arguments import excerpt
from smartcam.depth._cleaning import MILLIMETRE, as_metres
from smartcam.exceptions import ConfigurationError, FrameFormatError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

DepthArea: TypeAlias = "tuple[int, int, int, int] | Sequence[tuple[float, float]] | NDArray[Any]"
"""A box ``(x, y, width, height)``, a polygon (N, 2) of ``x, y``, or a mask (H, W) of bool; in
pixels; the middle of the upper left pixel is at (0, 0)."""

SIGMA_PER_MAD: Final = 1.4826
"""Standard deviation of normal noise as a multiple of its median absolute deviation (MAD)."""

MEDIAN_EXCESS_VARIANCE: Final = math.pi / 2 - 1
"""Excess of a median's variance over a mean's, as a multiple of a pixel's variance divided by the
number of pixels, for independent normal noise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RegionDepth:
    """The depth of a region, and its standard deviations.

    Attributes:
        median: median of the depths, metres.
        sigma: standard deviation of ``median`` from noise alone, metres.
        spread: standard deviation of one pixel, metres, from the median absolute deviation. Single
            outliers do not change it; a slope of the surface does.
        count: number of pixels with a depth.
        pixels: number of pixels of the region.
    """

    median: float
    sigma: float
    spread: float
    count: int
    pixels: int


@check_arguments(scale=a_number, correlated_pixels=a_number)
def region_depth(
    depth: NDArray[Any],
    region: DepthArea | None = None,
    *,
    scale: float = MILLIMETRE,
    correlated_pixels: float = 1.0,
) -> RegionDepth:
    """Return the median of a region's depths; holes do not count.

    Args:
        depth: (H, W): float in metres, or uint16 in steps of ``scale``.
        region: a box, a polygon or a mask; None: the whole map. Parts outside of the map are
            ignored.
        scale: metres of a step of uint16.
        correlated_pixels: number of pixels over which noise is correlated, for ``sigma``. It is 1
            if each pixel has its own noise. After a filter it is
            :attr:`SpatialFilter.correlated_pixels` (with 5 % of holes, ``sigma`` is then a fifth
            too large). For a window matcher it is about the number of pixels of the window.

    Raises:
        ConfigurationError: the region is not valid, or ``correlated_pixels`` is below 1.
        FrameFormatError: no pixel of the region has a depth, or the array is no depth map.
    """
    if not (correlated_pixels >= 1 and math.isfinite(correlated_pixels)):
        raise ConfigurationError(
            "region_depth: correlated_pixels: expected 1 or more pixels, got "
            f"{excerpt(correlated_pixels)}"
        )
    metres = as_metres(depth, scale)
    region_depths = metres[_region_mask(region, metres.shape)]
    measured = region_depths[region_depths > 0].astype(float)
    if not measured.size:
        raise FrameFormatError(
            f"region_depth: expected a depth in {_describe(region)}, "
            f"got none in {region_depths.size} pixels"
        )
    median = float(np.median(measured))
    spread = SIGMA_PER_MAD * float(np.median(np.abs(measured - median)))
    # variance of the median as a share of a pixel's variance
    variance = min(1.0, (correlated_pixels + MEDIAN_EXCESS_VARIANCE) / measured.size)
    return RegionDepth(
        median=median,
        sigma=spread * math.sqrt(variance),
        spread=spread,
        count=int(measured.size),
        pixels=int(region_depths.size),
    )


def equalize_depth(
    depth: NDArray[Any], region: DepthArea | None = None, *, scale: float = MILLIMETRE
) -> NDArray[np.uint8]:
    """Return a picture that makes small differences in a region visible.

    Each grey level has the same number of pixels: the nearest are 255, the farthest 1. Holes, and
    pixels outside of a polygon or a mask, are black, 0.

    Args:
        depth: (H, W): float in metres, or uint16 in steps of ``scale``.
        region: a box, a polygon or a mask; None: the whole map.
        scale: metres of a step of uint16.

    Returns:
        (h, w) of the box around the region.

    Raises:
        ConfigurationError: the region is not valid, or wholly outside of the map.
        FrameFormatError: the array is no depth map.
    """
    metres = as_metres(depth, scale)
    mask = _region_mask(region, metres.shape)
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    if not rows.size:
        raise ConfigurationError(f"equalize_depth: {_describe(region)} is outside of the map")
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    shown = mask[box] & (metres[box] > 0)
    picture = np.zeros(shown.shape, np.uint8)
    if shown.any():
        picture[shown] = _equalize(-metres[box][shown])
    return picture


def _equalize(levels: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return levels as greys from 1 to 255, each grey with about the same number of pixels."""
    _, level_index, counts = np.unique(levels, return_inverse=True, return_counts=True)
    pixels_up_to = np.cumsum(counts)
    span = pixels_up_to[-1] - pixels_up_to[0]
    if not span:
        return np.full(levels.shape, 255, np.uint8)
    greys: NDArray[np.uint8] = np.rint(1 + 254 * (pixels_up_to - pixels_up_to[0]) / span).astype(
        np.uint8
    )
    return greys[level_index.reshape(levels.shape)]


def _describe(region: DepthArea | None) -> str:
    if region is None:
        return "the map"
    given = np.asarray(region)
    if given.dtype == bool:
        return "the mask"
    return f"the {'box' if given.ndim == 1 else 'polygon'} {given.tolist()}"


def _region_mask(region: DepthArea | None, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return a region as a mask of a map's shape."""
    if region is None:
        return np.ones(shape, bool)
    try:
        given: NDArray[Any] = np.asarray(region)
    except ValueError:
        given = np.zeros(0)
    if given.dtype == bool and given.shape == shape:
        return given
    if given.dtype.kind in "iuf" and np.isfinite(given).all():
        if given.shape == (4,) and given.dtype.kind != "f" and given[2:].min() > 0:
            x, y, width, height = (int(number) for number in given)
            mask = np.zeros(shape, bool)
            mask[max(0, y) : max(0, y + height), max(0, x) : max(0, x + width)] = True
            return mask
        if given.ndim == 2 and given.shape[1] == 2 and len(given) > 2:
            return _polygon_mask(given.astype(float), shape)
    raise ConfigurationError(
        "region: expected a box (x, y, width, height) of whole pixels, a polygon (N, 2) or a mask "
        f"of bool {shape}, got {excerpt(region)}"
    )


def _polygon_mask(corners: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return the mask of the pixels with centres in a polygon, by the even-odd rule."""
    columns = np.arange(shape[1], dtype=float)
    rows = np.arange(shape[0], dtype=float)[:, None]
    inside = np.zeros(shape, bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 == y1:
            continue
        crossed = (y0 <= rows) != (y1 <= rows)
        crossings = x0 + (rows - y0) * (x1 - x0) / (y1 - y0)
        inside ^= crossed & (crossings <= columns)
    return inside
