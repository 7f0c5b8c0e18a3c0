"""Strips: narrow parts of a picture in which edges are searched.

A strip has a middle, a direction, a length and a width. Coordinates in a strip are ``along`` its
direction from its middle, and ``beside``, across it. An edge crosses a strip at about a right
angle. Strips of a circle are bent: ``along`` is the distance from the circle outwards, ``beside``
the arc length, so that a circle's edge is straight in its strips.

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

    def points(self, along: Array, beside: Array) -> Array:
        """Return the points (N, ..., 2) at places (N, ...) in each strip."""
        shape = (len(self.middles),) + (1,) * (along.ndim - 1) + (2,)
        ahead = self.directions.reshape(shape)
        aside = ahead[..., ::-1] * [-1.0, 1.0]
        at: Array = (
            self.middles.reshape(shape) + along[..., None] * ahead + beside[..., None] * aside
        )
        return at

    def ahead(self, beside: Array) -> Array:
        """Return the directions (N, ..., 2) of the strips at places beside their middles."""
        shape = (len(self.middles),) + (1,) * (beside.ndim - 1) + (2,)
        return np.broadcast_to(self.directions.reshape(shape), (*beside.shape, 2))

    def places(self, at: Array) -> tuple[Array, Array]:
        """Return the places of points (N, P, 2) in each strip: along and beside, (N, P)."""
        offsets = at - self.middles[:, None]
        (du, dv), (u, v) = self.directions.T[:, :, None], (offsets[..., 0], offsets[..., 1])
        return du * u + dv * v, du * v - dv * u

    def selected(self, which: NDArray[np.intp]) -> Strips:
        """Return a selection of the strips."""
        return self._replace(middles=self.middles[which], directions=self.directions[which])


class Sectors(NamedTuple):
    """N bent strips across a circle, which point away from its centre; lengths are pixels."""

    centre: Array  # (2,)
    radius: float
    angles: Array  # (N,), angles of the strips' middles, radians, from u to v
    length: float
    width: float

    @property
    def middles(self) -> Array:
        """Middles of the strips, (N, 2)."""
        return self.points(np.zeros(len(self.angles)), np.zeros(len(self.angles)))

    def points(self, along: Array, beside: Array) -> Array:
        """Return the points (N, ..., 2) at places (N, ...) in each strip."""
        at: Array = self.centre + (self.radius + along)[..., None] * self.ahead(beside)
        return at

    def ahead(self, beside: Array) -> Array:
        """Return the directions (N, ..., 2) of the strips at places beside their middles."""
        angles = self.angles.reshape((-1,) + (1,) * (beside.ndim - 1)) + beside / self.radius
        return np.stack([np.cos(angles), np.sin(angles)], axis=-1)

    def places(self, at: Array) -> tuple[Array, Array]:
        """Return the places of points (N, P, 2) in each strip: along and beside, (N, P)."""
        offsets = at - self.centre
        turned = np.arctan2(offsets[..., 1], offsets[..., 0]) - self.angles[:, None]
        turned -= 2 * np.pi * np.rint(turned / (2 * np.pi))
        return np.hypot(offsets[..., 0], offsets[..., 1]) - self.radius, turned * self.radius

    def selected(self, which: NDArray[np.intp]) -> Sectors:
        """Return a selection of the strips."""
        return self._replace(angles=self.angles[which])


class StripPixels(NamedTuple):
    """P pixels of each of N strips; unused pixels have the weight 0."""

    along: Array  # (N, P), place along the strip
    beside: Array  # (N, P)
    ahead: Array  # (N, P, 2), direction of the strip at the pixel
    levels: Array  # (N, P)
    weights: Array  # (N, P), 1 or 0

    @property
    def counts(self) -> Array:
        """Number of used pixels of each strip, (N,)."""
        counts: Array = self.weights.sum(axis=1)
        return counts

    def selected(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> StripPixels:
        """Return the pixels of some strips."""
        return StripPixels(*(array[which] for array in self))


def profiles(image: NDArray[np.generic], strips: Strips | Sectors) -> Array:
    """Return the mean grey levels (N, T) across each strip at steps of a pixel along it.

    Levels between pixels are interpolated linearly. T is the strips' length in whole pixels plus 1;
    the middle value is at the strip's middle. The strips must lie inside of the picture.
    """
    count, across = steps_of(strips.length), steps_of(strips.width)
    along: Array = np.arange(count, dtype=float) - (count - 1) / 2
    beside: Array = (np.arange(across, dtype=float) - (across - 1) / 2)[None, :]
    number = len(strips.middles)
    shape = (number, count, across)
    at = strips.points(
        np.broadcast_to(along[None, :, None], shape), np.broadcast_to(beside[None], shape)
    )
    height, width = image.shape
    left = np.floor(at[..., 0]).astype(np.intp).clip(0, max(width - 2, 0))
    top = np.floor(at[..., 1]).astype(np.intp).clip(0, max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    u, v = (at[..., 0] - left).clip(0, 1), (at[..., 1] - top).clip(0, 1)
    upper = (1 - u) * image[top, left] + u * image[top, right]
    lower = (1 - u) * image[bottom, left] + u * image[bottom, right]
    levels: Array = ((1 - v) * upper + v * lower).mean(axis=2)
    return levels


def steps_of(length: float) -> int:
    """Return the number of points at steps of a pixel that fit into a length."""
    return max(int(length + 1e-9) + 1, 1)


def inside(image: NDArray[np.generic], strips: Strips | Sectors) -> NDArray[np.bool_]:
    """Return the mask (N,) of the strips that lie inside of the picture."""
    ends = np.array([-0.5, 0.0, 0.5])
    along, beside = (
        side.ravel() for side in np.meshgrid(ends * strips.length, ends * strips.width)
    )
    shape = (len(strips.middles), len(along))
    at = strips.points(np.broadcast_to(along, shape), np.broadcast_to(beside, shape))
    height, width = image.shape
    within = (at > -0.5) & (at < [width - 0.5, height - 0.5])
    fits: NDArray[np.bool_] = np.logical_and.reduce(within, axis=(1, 2))
    return fits


def cut(
    image: NDArray[np.generic], strips: Strips | Sectors, low: Array, high: Array
) -> StripPixels:
    """Return the pixels of each strip whose place along it is between ``low`` and ``high`` (N,)."""
    middle = strips.points((low + high) / 2, np.zeros(len(low)))
    nearest = np.rint(middle).astype(np.intp)
    half = int(np.ceil(np.hypot((high - low).max() / 2, strips.width / 2))) + 1
    if isinstance(strips, Sectors):
        half += int(strips.width**2 / (8 * strips.radius)) + 1
    span = np.arange(-half, half + 1)
    v, u = (side.ravel() for side in np.meshgrid(span, span, indexing="ij"))
    columns, rows = nearest[:, :1] + u, nearest[:, 1:] + v
    along, beside = strips.places(np.stack([columns, rows], axis=-1).astype(np.float64))
    height, width = image.shape
    counted = (
        (along >= low[:, None])
        & (along <= high[:, None])
        & (np.abs(beside) <= strips.width / 2)
        & (columns >= 0)
        & (columns < width)
        & (rows >= 0)
        & (rows < height)
    )
    owner, which = np.nonzero(counted)
    counts = counted.sum(axis=1)
    place = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    shape = (len(low), max(int(counts.max(initial=0)), 1))

    def packed(values: Array, empty: float = 0.0) -> Array:
        result = np.full(shape, empty)
        result[owner, place] = values
        return result

    return StripPixels(
        packed(along[owner, which]),
        packed(beside[owner, which]),
        strips.ahead(packed(beside[owner, which])),
        packed(image[rows[owner, which], columns[owner, which]].astype(np.float64)),
        packed(np.ones(len(owner))),
    )
