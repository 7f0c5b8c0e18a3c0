"""Drawn edges and circles whose place is exact, for tests and judges of measuring.

Each pixel is the mean over its own square of what a Gaussian blur makes of the scene, by Gauss'
quadrature: nothing of :mod:`smartcam.inspection` draws here.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import i0e, ndtr

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

Array = np.ndarray[tuple[int, ...], np.dtype[np.float64]]
Scene = "Callable[[Array, Array], Array]"

NODES = 6
"""Number of samples of the blurred scene along each side of a pixel."""


def pixel_means(
    shape: tuple[int, int], scene: Callable[[Array, Array], Array], nodes: int = NODES
) -> Array:
    """Return the mean of a scene over each pixel (H, W); ``scene`` gives levels at points u, v."""
    height, width = shape
    at, weights = np.polynomial.legendre.leggauss(nodes)
    v, u = np.mgrid[:height, :width].astype(np.float64)
    total = np.zeros(shape)
    for du, first in zip(at / 2, weights / 2, strict=True):
        for dv, second in zip(at / 2, weights / 2, strict=True):
            total += first * second * scene(u + du, v + dv)
    return total


def half_plane(
    place: tuple[float, float], angle: float, blur: float
) -> Callable[[Array, Array], Array]:
    """Return the scene that is 1 beyond a straight edge through a point, along its normal."""
    normal = math.cos(angle), math.sin(angle)

    def scene(u: Array, v: Array) -> Array:
        off = (u - place[0]) * normal[0] + (v - place[1]) * normal[1]
        shares: Array = ndtr(off / blur)
        return shares

    return scene


def disc(
    centre: tuple[float, float], radius: float, blur: float
) -> Callable[[Array, Array], Array]:
    """Return the scene that is 1 inside of a disc."""
    # A disc behind a Gaussian, at a distance r: the integral over the disc's radii a of
    #     a / s^2 exp(-(a - r)^2 / (2 s^2)) i0e(a r / s^2);
    # it is taken once along the radius, and interpolated.
    far = np.arange(0.0, radius + 12 * blur + 4, min(0.02, blur / 20))
    nodes, weights = np.polynomial.legendre.leggauss(200)
    table = np.zeros_like(far)
    low, high = np.maximum(0.0, far - 9 * blur), np.minimum(radius, far + 9 * blur)
    wide = np.maximum(high - low, 0.0)
    for node, weight in zip(nodes, weights, strict=True):
        a = low + (node + 1) / 2 * wide
        part = a / blur**2 * np.exp(-((a - far) ** 2) / (2 * blur**2)) * i0e(a * far / blur**2)
        table += weight / 2 * wide * part

    def scene(u: Array, v: Array) -> Array:
        return np.interp(np.hypot(u - centre[0], v - centre[1]), far, table, right=0.0)

    return scene


def photographed(
    levels: Array, noise: float, random: np.random.Generator, bits: int = 8
) -> NDArray[np.generic]:
    """Return levels (H, W) with noise, rounded to a camera's whole levels."""
    most = 2**bits - 1
    seen = np.rint(levels + random.normal(scale=noise, size=levels.shape)).clip(0, most)
    return seen.astype(np.uint8 if bits == 8 else np.uint16)
