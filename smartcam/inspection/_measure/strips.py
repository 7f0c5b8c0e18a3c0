"""Strips: narrow parts of a picture in which edges are searched.

A strip has a middle, a direction, a length and a width. It has two coordinates, which are 0 at its
middle: ``along``, in its direction, and ``across``, at a right angle to the direction. An edge
crosses a strip at about a right angle. Strips of a circle are bent: ``along`` is the distance from
the circle outwards, ``across`` is the arc length, so a circle's edge is straight in its strips.

The origin is the middle of the upper left pixel; u points right and v down.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array


class Strips(NamedTuple):
    """N straight strips of one length and width, pixels."""

    middles: Array  # (N, 2)
    directions: Array  # (N, 2), of length 1
    length: float
    width: float

    def points(self, along: Array, across: Array) -> Array:
        """Return the points (N, ..., 2) in the picture at coordinates (N, ...) in each strip."""
        shape = (len(self.middles),) + (1,) * (along.ndim - 1) + (2,)
        direction = self.directions.reshape(shape)
        normal = direction[..., ::-1] * [-1.0, 1.0]
        points: Array = (
            self.middles.reshape(shape) + along[..., None] * direction + across[..., None] * normal
        )
        return points

    def directions_at(self, across: Array) -> Array:
        """Return the directions (N, ..., 2) of the strips at coordinates ``across`` (N, ...)."""
        shape = (len(self.middles),) + (1,) * (across.ndim - 1) + (2,)
        return np.broadcast_to(self.directions.reshape(shape), (*across.shape, 2))

    def coordinates_of(self, points: Array) -> tuple[Array, Array]:
        """Return the coordinates ``along`` and ``across``, (N, P), of points (N, P, 2)."""
        offsets = points - self.middles[:, None]
        (du, dv), (u, v) = self.directions.T[:, :, None], (offsets[..., 0], offsets[..., 1])
        return du * u + dv * v, du * v - dv * u

    def selected(self, which: NDArray[np.intp]) -> Strips:
        """Return the strips with the given indices."""
        return self._replace(middles=self.middles[which], directions=self.directions[which])


class Sectors(NamedTuple):
    """N bent strips across a circle, which point away from its centre; lengths are pixels."""

    centre: Array  # (2,)
    radius: float
    angles: Array  # (N,), of the strips' middles, radians, from u towards v
    length: float
    width: float

    @property
    def middles(self) -> Array:
        """Middles of the strips, (N, 2)."""
        return self.points(np.zeros(len(self.angles)), np.zeros(len(self.angles)))

    def points(self, along: Array, across: Array) -> Array:
        """Return the points (N, ..., 2) in the picture at coordinates (N, ...) in each strip."""
        points: Array = self.centre + (self.radius + along)[..., None] * self.directions_at(across)
        return points

    def directions_at(self, across: Array) -> Array:
        """Return the directions (N, ..., 2) of the strips at coordinates ``across`` (N, ...)."""
        angles = self.angles.reshape((-1,) + (1,) * (across.ndim - 1)) + across / self.radius
        return np.stack([np.cos(angles), np.sin(angles)], axis=-1)

    def coordinates_of(self, points: Array) -> tuple[Array, Array]:
        """Return the coordinates ``along`` and ``across``, (N, P), of points (N, P, 2)."""
        offsets = points - self.centre
        turned = np.arctan2(offsets[..., 1], offsets[..., 0]) - self.angles[:, None]
        turned -= 2 * np.pi * np.rint(turned / (2 * np.pi))
        return np.hypot(offsets[..., 0], offsets[..., 1]) - self.radius, turned * self.radius

    def selected(self, which: NDArray[np.intp]) -> Sectors:
        """Return the strips with the given indices."""
        return self._replace(angles=self.angles[which])


class StripPixels(NamedTuple):
    """P pixels of each of N strips; unused pixels have the weight 0."""

    along: Array  # (N, P), coordinate in the strip's direction
    across: Array  # (N, P), coordinate at a right angle to the direction
    directions: Array  # (N, P, 2), direction of the strip at the pixel
    levels: Array  # (N, P)
    weights: Array  # (N, P), 1 or 0

    @property
    def counts(self) -> Array:
        """Number of used pixels of each strip, (N,)."""
        counts: Array = self.weights.sum(axis=1)
        return counts

    def selected(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> StripPixels:
        """Return the pixels of the strips that a mask or indices select."""
        return StripPixels(*(array[which] for array in self))


def mean_profiles(image: NDArray[np.generic], strips: Strips | Sectors) -> Array:
    """Return grey levels (N, T) at steps of a pixel along each strip, averaged over its width.

    Levels between pixels are interpolated linearly. T is the strips' length in whole pixels plus 1;
    the middle value is at the strip's middle. The strips must lie inside of the picture.
    """
    length_count, width_count = count_samples(strips.length), count_samples(strips.width)
    along: Array = np.arange(length_count, dtype=float) - (length_count - 1) / 2
    across: Array = (np.arange(width_count, dtype=float) - (width_count - 1) / 2)[None, :]
    strip_count = len(strips.middles)
    shape = (strip_count, length_count, width_count)
    points = strips.points(
        np.broadcast_to(along[None, :, None], shape), np.broadcast_to(across[None], shape)
    )
    height, width = image.shape
    left = np.floor(points[..., 0]).astype(np.intp).clip(0, max(width - 2, 0))
    top = np.floor(points[..., 1]).astype(np.intp).clip(0, max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    u, v = (points[..., 0] - left).clip(0, 1), (points[..., 1] - top).clip(0, 1)
    upper = (1 - u) * image[top, left] + u * image[top, right]
    lower = (1 - u) * image[bottom, left] + u * image[bottom, right]
    levels: Array = ((1 - v) * upper + v * lower).mean(axis=2)
    return levels


def count_samples(length: float) -> int:
    """Return the number of samples, a pixel apart, that fit into a length."""
    return max(int(length + 1e-9) + 1, 1)


def find_strips_inside(image: NDArray[np.generic], strips: Strips | Sectors) -> NDArray[np.bool_]:
    """Return the mask (N,) of the strips that lie inside of the picture."""
    ends = np.array([-0.5, 0.0, 0.5])
    along, across = (
        side.ravel() for side in np.meshgrid(ends * strips.length, ends * strips.width)
    )
    shape = (len(strips.middles), len(along))
    points = strips.points(np.broadcast_to(along, shape), np.broadcast_to(across, shape))
    height, width = image.shape
    is_inside = (points > -0.5) & (points < [width - 0.5, height - 0.5])
    fits: NDArray[np.bool_] = np.logical_and.reduce(is_inside, axis=(1, 2))
    return fits


def cut_pixels(
    image: NDArray[np.generic], strips: Strips | Sectors, low: Array, high: Array
) -> StripPixels:
    """Return the pixels of each strip whose ``along`` is between ``low`` and ``high`` (N,)."""
    middle = strips.points((low + high) / 2, np.zeros(len(low)))
    nearest = np.rint(middle).astype(np.intp)
    half = int(np.ceil(np.hypot((high - low).max() / 2, strips.width / 2))) + 1
    if isinstance(strips, Sectors):
        half += int(strips.width**2 / (8 * strips.radius)) + 1
    span = np.arange(-half, half + 1)
    v, u = (side.ravel() for side in np.meshgrid(span, span, indexing="ij"))
    columns, rows = nearest[:, :1] + u, nearest[:, 1:] + v
    along, across = strips.coordinates_of(np.stack([columns, rows], axis=-1).astype(np.float64))
    height, width = image.shape
    is_used = (
        (along >= low[:, None])
        & (along <= high[:, None])
        & (np.abs(across) <= strips.width / 2)
        & (columns >= 0)
        & (columns < width)
        & (rows >= 0)
        & (rows < height)
    )
    strip_index, pixel = np.nonzero(is_used)
    counts = is_used.sum(axis=1)
    slots = np.arange(len(strip_index)) - np.repeat(np.cumsum(counts) - counts, counts)
    shape = (len(low), max(int(counts.max(initial=0)), 1))

    def pack(pixel_values: Array, empty: float = 0.0) -> Array:
        result = np.full(shape, empty)
        result[strip_index, slots] = pixel_values
        return result

    return StripPixels(
        pack(along[strip_index, pixel]),
        pack(across[strip_index, pixel]),
        strips.directions_at(pack(across[strip_index, pixel])),
        pack(image[rows[strip_index, pixel], columns[strip_index, pixel]].astype(np.float64)),
        pack(np.ones(len(strip_index))),
    )
