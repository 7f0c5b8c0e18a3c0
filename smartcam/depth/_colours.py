"""Find regions of one colour: ranges of colours, masks, and connected regions."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam._argument_checks import a_number, an_integer, as_array, check_arguments, each
from smartcam._arguments import check_flag, excerpt
from smartcam._extras import load
from smartcam.exceptions import ConfigurationError, FrameFormatError
from smartcam.frames import Frame
from smartcam.frames._inside import convert_frame

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_LEVELS: Final = {"hue": 179, "saturation": 255, "value": 255}
"""Largest value of each channel."""

HUE_UNITS: Final = 180
"""Number of OpenCV's hues, each two degrees of the circle of colours."""

MIN_COLOURFUL: Final = 40
"""Saturation or value below which the hue is only noise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ColourRange:
    """A range of colours in HSV, in OpenCV's units of 8 bits; both ends belong to the range.

    Attributes:
        hue: from, to, each 0 to 179, in steps of two degrees on the circle of colours: 0 red, 30
            yellow, 60 green, 90 cyan, 120 blue, 150 magenta. If the first hue is above the second,
            the range goes through 0: ``(170, 10)`` is red.
        saturation: from, to, each 0 (grey) to 255.
        value: from, to, each 0 (black) to 255: the largest of red, green and blue.

    Raises:
        ConfigurationError: a number out of its range, or a lower end above the upper one, except
            for the hue.
    """

    hue: tuple[int, int] = (0, 179)
    saturation: tuple[int, int] = (0, 255)
    value: tuple[int, int] = (0, 255)

    def __post_init__(self) -> None:
        """Check the limits."""
        for name, most in MAX_LEVELS.items():
            given: Any = getattr(self, name)
            try:
                low, high = given
                is_valid = all(type(level) is int and 0 <= level <= most for level in (low, high))
            except (TypeError, ValueError, ArithmeticError):
                low, high, is_valid = 0, 0, False
            if not is_valid or (low > high and name != "hue"):
                raise ConfigurationError(
                    f"ColourRange: {name}: expected (from, to) of whole numbers 0 to {most}, "
                    f"got {excerpt(given)}"
                )
            object.__setattr__(self, name, (low, high))  # JSON gives a list

    def mask(self, picture: Frame | NDArray[Any]) -> NDArray[np.bool_]:
        """Return the mask of the pixels with a colour in the range, (H, W).

        Args:
            picture: a frame with colours (of more than 8 bits, the upper 8 are used), or (H, W, 3)
                of uint8, red first.

        Raises:
            FrameFormatError: the picture has another type or shape.
            MissingExtraError: OpenCV (extra ``depth``) is not installed.
        """
        return self.mask_hsv(hsv(picture))

    def mask_hsv(self, picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Return the mask (H, W) of the pixels in the range, from HSV (H, W, 3) of uint8."""
        low, high = self.hue
        if low <= high:
            mask = self._between(picture, low, high)
        else:
            mask = self._between(picture, low, MAX_LEVELS["hue"]) | self._between(picture, 0, high)
        return mask > 0

    def _between(self, picture: NDArray[np.uint8], low: int, high: int) -> NDArray[np.uint8]:
        lows, highs = zip((low, high), self.saturation, self.value, strict=True)
        return np.asarray(load("cv2").inRange(picture, lows, highs))

    @classmethod
    def around(
        cls, picture: Frame | NDArray[Any], x: int, y: int, *, radius: int = 4, margin: int = 12
    ) -> ColourRange:
        """Return the range of the colours around a pixel.

        Args:
            picture: picture, as for :meth:`mask`.
            x: column of the pixel.
            y: row of the pixel.
            radius: number of pixels to each side that are used.
            margin: units by which the range is widened on each side; half as many for the hue. The
                most extreme tenth of the pixels is ignored. Greys and blacks have no hue, so the
                range includes every hue; for blacks it includes every saturation.

        Raises:
            ConfigurationError: a pixel outside of the picture, or a number out of its range.
            FrameFormatError: the picture has another type or shape.
            MissingExtraError: OpenCV (extra ``depth``) is not installed.
        """
        if not (0 <= radius <= 1000 and 0 <= margin <= 255):
            raise ConfigurationError(
                f"ColourRange: expected a radius of 0 to 1000 and a margin of 0 to 255, got "
                f"{excerpt(radius)} and {excerpt(margin)}"
            )
        return around_hsv(hsv(picture), x, y, radius, margin)

    def as_json(self) -> str:
        """Return the range as JSON; ``ColourRange(**json.loads(text))`` reads it."""
        return json.dumps(asdict(self))


def hsv(picture: Frame | NDArray[Any]) -> NDArray[np.uint8]:
    """Return a picture as hue, saturation and value in OpenCV's units, (H, W, 3) of uint8."""
    source = ""
    if isinstance(picture, Frame):
        source, picture = picture.source, convert_frame(picture, "RGB8").array()
    given = np.asarray(picture)
    if given.dtype != np.uint8 or given.ndim != 3 or given.shape[2] != 3 or not given.size:
        raise FrameFormatError(
            f"{source or 'colours'}: expected (H, W, 3) of uint8, got {given.shape} of "
            f"{given.dtype}",
            source=source,
        )
    cv2 = load("cv2")
    return np.asarray(cv2.cvtColor(given, cv2.COLOR_RGB2HSV))


def around_hsv(picture: NDArray[np.uint8], x: int, y: int, radius: int, margin: int) -> ColourRange:
    """Return the range of the colours around a pixel of an HSV picture."""
    height, width = picture.shape[:2]
    if not (0 <= x < width and 0 <= y < height):
        raise ConfigurationError(
            f"ColourRange: expected a pixel within {width}x{height}, got ({x}, {y})"
        )
    neighbours = picture[max(0, y - radius) : y + radius + 1, max(0, x - radius) : x + radius + 1]
    hues, saturations, values = neighbours.reshape(-1, 3).astype(int).T
    saturation, value = _range_of(saturations, margin), _range_of(values, margin)
    if np.median(values) < MIN_COLOURFUL:
        return ColourRange(value=(0, value[1]))
    if np.median(saturations) < MIN_COLOURFUL:
        return ColourRange(saturation=(0, saturation[1]), value=value)
    # hues relative to their middle, so that red is not split at 0
    middle = round(np.angle(np.exp(2j * np.pi * hues / HUE_UNITS).sum()) * HUE_UNITS / (2 * np.pi))
    differences = (hues - middle + HUE_UNITS // 2) % HUE_UNITS - HUE_UNITS // 2
    low, high = (round(float(difference)) for difference in np.percentile(differences, (5, 95)))
    low, high = low - (margin + 1) // 2, high + (margin + 1) // 2
    hue = (0, MAX_LEVELS["hue"])
    if high - low < HUE_UNITS - 1:
        hue = ((middle + low) % HUE_UNITS, (middle + high) % HUE_UNITS)
    return ColourRange(hue=hue, saturation=saturation, value=value)


def _range_of(levels: NDArray[Any], margin: int) -> tuple[int, int]:
    low, high = np.percentile(levels, (5, 95))
    return max(0, round(float(low)) - margin), min(255, round(float(high)) + margin)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ColourRegion:
    """A connected region of a mask; the middle of the upper left pixel is at (0, 0).

    Attributes:
        centre: x, y of the mean of the region's pixels.
        area: pixels.
        sides: the longer and the shorter side of the smallest rectangle around the region, pixels.
        corners: corners of this rectangle, (4, 2).
        orientation: angle of the region's longer axis, radians, above -pi/2 up to pi/2, from x
            (right) towards y (down). The longer axis is the axis of least inertia; noise at the rim
            changes it less than the rectangle. For squares and circles it has no meaning.
        mask: pixels of the region, (H, W) of bool.
    """

    centre: tuple[float, float]
    area: int
    sides: tuple[float, float]
    corners: NDArray[np.float64]
    orientation: float
    mask: NDArray[np.bool_]

    @property
    def ratio(self) -> float:
        """Ratio of the longer to the shorter side, 1 or more."""
        return self.sides[0] / self.sides[1]

    @property
    def fullness(self) -> float:
        """Share of the smallest rectangle around the region that it fills, up to about 1."""
        return self.area / (self.sides[0] * self.sides[1])


@check_arguments(
    area=each(a_number, 2),
    ratio=each(a_number, 2),
    fullness=a_number,
    whole=check_flag,
    max_regions=an_integer,
)
def find_regions(
    mask: NDArray[np.bool_],
    *,
    area: tuple[float, float] = (1, math.inf),
    ratio: tuple[float, float] = (1, math.inf),
    fullness: float = 0.0,
    whole: bool = False,
    max_regions: int = 1000,
) -> list[ColourRegion]:
    """Return the connected regions of a mask, the largest first.

    Pixels that touch only at a corner are connected, too.

    Args:
        mask: (H, W) of bool.
        area: least and largest area, pixels.
        ratio: least and largest ratio of the longer to the shorter side.
        fullness: least share of the rectangle around a region that the region fills, 0 to 1.
        whole: whether to leave out regions that touch the picture's rim, since they may be cut.
        max_regions: number of regions at most; the largest are returned.

    Raises:
        ConfigurationError: a range whose lower end is above its upper end.
        FrameFormatError: ``mask`` is no mask.
        MissingExtraError: OpenCV (extra ``depth``) is not installed.
    """
    for name, (low, high) in (("area", area), ("ratio", ratio), ("fullness", (fullness, 1))):
        if not 0 <= low <= high:
            raise ConfigurationError(
                f"find_regions: {name}: expected (from, to), got {low}, {high}"
            )
    given = as_array(mask, "mask")
    if given.dtype != bool or given.ndim != 2 or not given.size:
        raise FrameFormatError(
            f"find_regions: expected a mask (H, W) of bool, got {given.shape} of {given.dtype}"
        )
    cv2 = load("cv2")
    _, labels, rows, _ = cv2.connectedComponentsWithStats(given.view(np.uint8), connectivity=8)
    areas = rows[1:, cv2.CC_STAT_AREA]
    wanted = np.flatnonzero((areas >= area[0]) & (areas <= area[1])) + 1
    regions: list[ColourRegion] = []
    for label in sorted(wanted.tolist(), key=lambda index: -int(rows[index, cv2.CC_STAT_AREA])):
        left, top, width, height = (int(number) for number in rows[label, :4])
        touches_rim = (
            min(left, top) == 0 or left + width == given.shape[1] or top + height == given.shape[0]
        )
        if whole and touches_rim:
            continue
        region = _make_region(labels, label, np.s_[top : top + height, left : left + width])
        if ratio[0] <= region.ratio <= ratio[1] and region.fullness >= fullness:
            regions.append(region)
        if len(regions) == max_regions:
            break
    return regions


def _make_region(labels: NDArray[Any], label: int, box: tuple[slice, slice]) -> ColourRegion:
    cv2 = load("cv2")
    pixels = labels[box] == label
    ys, xs = np.nonzero(pixels)
    points = np.column_stack((xs + box[1].start, ys + box[0].start))
    middle = points.mean(axis=0)
    x, y = (points - middle).T
    orientation = 0.5 * math.atan2(
        2 * float(np.mean(x * y)), float(np.mean(x * x) - np.mean(y * y))
    )
    hull = cv2.convexHull(points.astype(np.int32))
    rectangle = cv2.minAreaRect(hull)
    # sizes between the rims, not the centres, of the outer pixels
    (width, height), angle = (side + 1 for side in rectangle[1]), rectangle[2]
    mask = np.zeros(labels.shape, bool)
    mask[box] = pixels
    return ColourRegion(
        centre=(float(middle[0]), float(middle[1])),
        area=len(points),
        sides=(max(width, height), min(width, height)),
        corners=np.asarray(cv2.boxPoints((rectangle[0], (width, height), angle)), float),
        orientation=orientation,
        mask=mask,
    )
