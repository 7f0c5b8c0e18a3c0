"""Define where tools work in a picture: frames of reference, and regions.

Pixel coordinates have x to the right and y down; the centre of the upper left pixel is (0, 0), as
in all of smartcam. Angles are in radians from x towards y, so positive angles are clockwise in the
displayed picture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

import numpy as np
from pydantic import PlainValidator, WithJsonSchema

from smartcam._extras import load

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

MAX_CORNERS: Final = 200
"""Largest number of corners of a region."""

MAX_COORDINATE_PX: Final = 100_000.0
"""Largest coordinate of a region, in pixels; no picture is larger."""

MAX_FIXED_PLACES: Final = 256
"""Largest number of places of fixed regions that are kept from one picture to the next."""


class PixelPose(NamedTuple):
    """A frame of reference in a picture, which a tool found and later tools may follow.

    Attributes:
        x: x of the origin, pixels.
        y: y of the origin, pixels.
        angle: direction of the x axis, radians from the picture's x towards the picture's y.
        scale: pixels of the picture per unit of the frame.
    """

    x: float = 0.0
    y: float = 0.0
    angle: float = 0.0
    scale: float = 1.0

    def to_picture(self, points: ArrayLike) -> NDArray[np.float64]:
        """Convert points (..., 2) of this frame to the picture's pixels."""
        cos, sin = self.scale * math.cos(self.angle), self.scale * math.sin(self.angle)
        rotation = np.array([[cos, sin], [-sin, cos]])
        moved: NDArray[np.float64] = np.asarray(points, np.float64) @ rotation + (self.x, self.y)
        return moved

    def from_picture(self, points: ArrayLike) -> NDArray[np.float64]:
        """Convert points (..., 2) of the picture to this frame."""
        cos, sin = math.cos(self.angle) / self.scale, math.sin(self.angle) / self.scale
        rotation = np.array([[cos, -sin], [sin, cos]])
        moved: NDArray[np.float64] = (np.asarray(points, np.float64) - (self.x, self.y)) @ rotation
        return moved


IDENTITY: Final = PixelPose()
"""The frame of reference of the picture itself."""


class Region(tuple[tuple[float, float], ...]):
    """The corners of a tool's region, in order; in a program file ``[x, y, width, height]``.

    ``[0, 0, 640, 480]`` is the first 640 columns of the first 480 rows. A polygon is a list of
    three corners or more, ``[[x, y], ...]``. The coordinates are pixels of the picture, or units of
    the frame of reference that the tool follows.
    """

    __slots__ = ()


def _parse_region(given: object) -> Region:
    if isinstance(given, Region):
        return given
    items: list[Any] = list(given) if isinstance(given, (list, tuple)) else []
    if len(items) == 4 and all(_is_coordinate(item) for item in items):
        x, y, width, height = map(float, items)
        if width <= 0 or height <= 0:
            raise ValueError(f"expected a width and a height above 0, got {width:g} x {height:g}")
        right, bottom = x + width, y + height
        return Region(((x, y), (right, y), (right, bottom), (x, bottom)))
    if 3 <= len(items) <= MAX_CORNERS and all(
        isinstance(item, (list, tuple)) and len(item) == 2 and all(map(_is_coordinate, item))
        for item in items
    ):
        return Region((float(x), float(y)) for x, y in items)
    raise ValueError(
        f"expected [x, y, width, height], or 3 to {MAX_CORNERS} corners [[x, y], ...], in pixels; "
        f"got {given!r:.80}"
    )


def _is_coordinate(value: object) -> bool:
    return (
        isinstance(value, (int, float))
        and not isinstance(value, bool)
        and abs(value) <= MAX_COORDINATE_PX
    )


_CORNER: Final = {"type": "array", "items": {"type": "number"}, "minItems": 2}
RegionSetting = Annotated[
    Region,
    PlainValidator(_parse_region),
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "array", "items": {"type": "number"}, "minItems": 4, "maxItems": 4},
                {"type": "array", "items": _CORNER, "minItems": 3, "maxItems": MAX_CORNERS},
            ]
        }
    ),
]
"""Type of a region in a tool's settings."""


@dataclass(frozen=True, slots=True)
class PlacedRegion:
    """A region placed in one picture.

    Attributes:
        corners: corners in the picture's pixels, (N, 2).
        left: first column that the region touches, within the picture.
        top: first row.
        right: column after the last.
        bottom: row after the last.
        outside: largest distance by which the region reaches out of the picture, pixels.
    """

    corners: NDArray[np.float64]
    left: int
    top: int
    right: int
    bottom: int
    outside: float

    @property
    def is_empty(self) -> bool:
        """True if the region is outside of the picture."""
        return self.right <= self.left or self.bottom <= self.top

    @property
    def rows_columns(self) -> tuple[slice, slice]:
        """Slices of rows and columns that contain the region."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def contains(self, point: tuple[float, float]) -> bool:
        """Return True if a point of the picture is in the region or on its border."""
        cv2 = load("cv2", "inspection needs")
        corners = self.corners.astype(np.float32)[:, np.newaxis]
        return bool(cv2.pointPolygonTest(corners, point, measureDist=False) >= 0)

    def mask(self) -> NDArray[np.uint8]:
        """Return a mask (H, W) of the region's rows and columns: 255 in the region, else 0."""
        mask = np.zeros((self.bottom - self.top, self.right - self.left), np.uint8)
        corners = np.rint(self.corners - (self.left, self.top)).astype(np.int32)
        load("cv2", "inspection needs").fillPoly(mask, [corners], 255)
        return mask


def place_region(
    region: Region | None, pose: PixelPose | None, size: tuple[int, int]
) -> PlacedRegion:
    """Place a region in a picture.

    Args:
        region: the region; None: the whole picture.
        pose: frame of reference of the corners; None: the picture itself, with (0, 0) at the upper
            left corner of its first pixel.
        size: width and height of the picture, pixels.
    """
    if region is None or pose is None:
        return _place_fixed(region, size)
    return _bound_region(pose.to_picture(region), size)


@lru_cache(maxsize=MAX_FIXED_PLACES)
def _place_fixed(region: Region | None, size: tuple[int, int]) -> PlacedRegion:
    """Place a region that follows no tool; its corners cannot be changed."""
    if region is None:
        region = _parse_region([0, 0, *size])
    corners = np.asarray(region) - 0.5
    corners.flags.writeable = False
    return _bound_region(corners, size)


def _bound_region(corners: NDArray[np.float64], size: tuple[int, int]) -> PlacedRegion:
    width, height = size
    (left, top), (right, bottom) = corners.min(axis=0) + 0.5, corners.max(axis=0) + 0.5
    return PlacedRegion(
        corners,
        max(math.floor(left), 0),
        max(math.floor(top), 0),
        min(math.ceil(right), width),
        min(math.ceil(bottom), height),
        float(max(-left, -top, right - width, bottom - height, 0.0)),
    )
