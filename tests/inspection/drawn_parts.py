"""Drawn parts at exact poses, for tests and judges of locating.

A part is made of polygons and discs, one on the other, each of a grey level. Each pixel is the mean
of what a Gaussian blur makes of the part, by samples of a quarter of a pixel whose own share of a
shape follows from the distance to its edge. Nothing of :mod:`smartcam.inspection` draws here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

Array = np.ndarray[tuple[int, ...], np.dtype[np.float64]]

SAMPLES = 4
"""Samples along each side of a pixel."""


class Shape(NamedTuple):
    """A polygon (K, 2), or a disc, in the part's places."""

    level: float  # 0 to 1: from the background's level to the part's
    corners: tuple[tuple[float, float], ...] = ()
    centre: tuple[float, float] = (0.0, 0.0)
    radius: float = 0.0

    def inside(self, u: Array, v: Array) -> Array:
        """Return how far points are inside of the shape; negative: outside."""
        if self.radius:
            return self.radius - np.hypot(u - self.centre[0], v - self.centre[1])
        corners = np.asarray(self.corners)
        nearest = np.full(u.shape, np.inf, np.float32)
        within = np.zeros(u.shape, dtype=np.bool_)
        for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            dx, dy = bx - ax, by - ay
            along = (((u - ax) * dx + (v - ay) * dy) / (dx * dx + dy * dy)).clip(0, 1)
            far = (u - ax - along * dx) ** 2 + (v - ay - along * dy) ** 2
            np.minimum(nearest, far, out=nearest)
            if ay != by:
                within ^= ((v < ay) != (v < by)) & (u < ax + (v - ay) * dx / dy)
        distance = np.sqrt(nearest)
        return np.where(within, distance, -distance)


def polygon(level: float, *corners: tuple[float, float]) -> Shape:
    """Return a polygon."""
    return Shape(level, corners)


def disc(level: float, x: float, y: float, radius: float) -> Shape:
    """Return a disc."""
    return Shape(level, (), (x, y), radius)


def _ngon(count: int, radius: float) -> tuple[tuple[float, float], ...]:
    turns = [2 * math.pi * k / count for k in range(count)]
    return tuple((radius * math.cos(one), radius * math.sin(one)) for one in turns)


PARTS: dict[str, tuple[Shape, ...]] = {
    "bracket": (
        polygon(1.0, (-60, -35), (40, -35), (40, -5), (0, 5), (0, 40), (-60, 40)),
        disc(0.0, -38, 18, 12),
        disc(0.0, 20, -20, 7),
        polygon(0.35, (-50, -26), (-10, -26), (-10, -12), (-50, -12)),
    ),
    "tee": (
        polygon(
            1.0,
            (-50, -40),
            (50, -40),
            (50, -14),
            (13, -14),
            (13, 45),
            (-13, 45),
            (-13, -14),
            (-50, -14),
        ),
        disc(0.0, 0, 28, 7),
    ),
    "bolt": (
        Shape(1.0, tuple((x - 30, y) for x, y in _ngon(6, 24))),
        polygon(0.8, (-12, -9), (62, -9), (62, 9), (-12, 9)),
        disc(0.3, -30, 0, 11),
    ),
    "square": (polygon(1.0, (-40, -40), (40, -40), (40, 40), (-40, 40)), disc(0.0, 0, 0, 15)),
    "hexagon": (Shape(1.0, _ngon(6, 45)), disc(0.0, 0, 0, 18)),
    "washer": (disc(1.0, 0, 0, 45), disc(0.0, 0, 0, 22)),
}
"""Parts by name; about 100 pixels across."""


@dataclass(frozen=True, kw_only=True)
class Look:
    """Light and photography of a scene.

    Attributes:
        dark: level of the background, 0 to 255.
        contrast: levels from the background to the part.
        noise: standard deviation, levels.
        blur: standard deviation of the lens' blur, pixels.
        slope: levels by which the light rises from the left to the right.
        bits: bits of a pixel.
    """

    dark: float = 60.0
    contrast: float = 120.0
    noise: float = 2.0
    blur: float = 0.8
    slope: float = 0.0
    bits: int = 8


@dataclass(frozen=True)
class PlacedPart:
    """A part at a pose: pixels, radians from x towards y, and a scale."""

    shapes: tuple[Shape, ...]
    x: float
    y: float
    angle: float = 0.0
    scale: float = 1.0
    size: float = field(default=70.0, compare=False)


def shares(
    shape: tuple[int, ...], parts: Sequence[PlacedPart], blur: float, samples: int = SAMPLES
) -> Array:
    """Return the light of parts (H, W), 0 for the background; exact to about 0.001 pixels.

    ``samples``: along each side of a pixel.
    """
    canvas = np.zeros(shape)
    for part in parts:
        corner, fine = _samples(part, blur, samples)
        own, light = _pixels(fine, samples)
        low = max(corner[0], 0), max(corner[1], 0)
        high = min(corner[0] + len(own), shape[1]), min(corner[1] + len(own), shape[0])
        if high[0] <= low[0] or high[1] <= low[1]:
            continue
        cut = (
            slice(low[1] - corner[1], high[1] - corner[1]),
            slice(low[0] - corner[0], high[0] - corner[0]),
        )
        there = slice(low[1], high[1]), slice(low[0], high[0])
        canvas[there] = canvas[there] * (1 - own[cut]) + light[cut]
    return canvas


def slopes(shape: tuple[int, ...], part: PlacedPart, blur: float, samples: int = SAMPLES) -> Array:
    """Return the derivatives of a part's light (4, H, W) by its x, y, angle and scale."""
    corner, fine = _samples(part, blur, samples)
    down, across = np.gradient(fine[..., 1].astype(float) * samples)
    places = _places(corner, len(fine), samples)
    u, v = (one - at for one, at in zip(places, (part.x, part.y), strict=True))
    ways = (
        -across,
        -down,
        across * v - down * u,
        -(across * u + down * v) / part.scale,
    )
    found = np.zeros((4, *shape))
    for one, way in zip(found, ways, strict=True):
        (small,) = _pixels(way[..., None], samples)
        rows, columns = (
            slice(corner[1], corner[1] + len(small)),
            slice(corner[0], corner[0] + len(small)),
        )
        one[rows, columns] = small
    return found


def _places(corner: tuple[int, int], count: int, samples: int) -> list[Array]:
    at = (np.arange(count, dtype=np.float32) + 0.5) / samples - 0.5
    return list(np.meshgrid(at + corner[0], at + corner[1]))


def _samples(
    part: PlacedPart, blur: float, samples: int
) -> tuple[tuple[int, int], NDArray[np.float32]]:
    """Return the first pixel of a part, and at its samples how much is of the part, and light."""
    reach = math.ceil(part.size * part.scale + 5 * blur + 4)
    corner = math.floor(part.x) - reach, math.floor(part.y) - reach
    u, v = _places(corner, (2 * reach + 1) * samples, samples)
    cos, sin = math.cos(part.angle) / part.scale, math.sin(part.angle) / part.scale
    u, v = u - np.float32(part.x), v - np.float32(part.y)
    x, y = cos * u + sin * v, cos * v - sin * u
    light = np.zeros(u.shape, np.float32)
    own = np.zeros(u.shape, np.float32)
    for shape in part.shapes:
        share = (shape.inside(x, y) * part.scale * samples + 0.5).clip(0, 1).astype(np.float32)
        light += share * (np.float32(shape.level) - light)
        own = np.maximum(own, share)
    blurred = cv2.GaussianBlur(np.dstack([own, light]), (0, 0), blur * samples)
    return corner, np.asarray(blurred, np.float32)


def _pixels(fine: NDArray[np.generic], samples: int) -> Array:
    """Return the means over pixels, (K, H, W), of samples (H, W, K)."""
    side = len(fine) // samples
    means = fine.reshape(side, samples, side, samples, -1).mean(axis=(1, 3), dtype=np.float64)
    return np.moveaxis(means, 2, 0)


def photograph(light: Array, look: Look, random: np.random.Generator) -> NDArray[np.generic]:
    """Return the picture of light (H, W) that is 0 to 1."""
    slope = look.slope * (np.arange(light.shape[1]) / light.shape[1] - 0.5)
    top = 2**look.bits - 1
    levels = (look.dark + look.contrast * light + slope) * top / 255
    noisy = levels + random.normal(scale=max(look.noise, 1e-9) * top / 255, size=light.shape)
    pixels: Array = np.rint(noisy).clip(0, top)
    return pixels.astype(np.uint8) if look.bits == 8 else pixels.astype(np.uint16)
