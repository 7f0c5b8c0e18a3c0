"""The tool `present` (are they there?): count spots of a colour or a grey level."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from smartcam._extras import load
from smartcam.depth import ColourRange
from smartcam.frames._inside import Drawing
from smartcam.inspection._finding import Finding
from smartcam.inspection._places import PixelPose
from smartcam.inspection._tool import Tool, ToolSettings

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from smartcam.inspection._tool import ToolSetup, View

MAX_SPOTS: Final = 1000
"""Largest number of spots in one result."""

MAX_AREA_PX: Final = 1_000_000_000
"""Largest area of a spot in the settings, in pixels."""


def _check_order(limits: tuple[int, int]) -> tuple[int, int]:
    if limits[0] > limits[1]:
        raise ValueError(f"expected the smaller number first, got {list(limits)}")
    return limits


Level = Annotated[int, Field(ge=0, le=255)]
Area = Annotated[int, Field(ge=1, le=MAX_AREA_PX)]
Number = Annotated[int, Field(ge=0, le=MAX_SPOTS)]


class PresentSettings(ToolSettings):
    """Colours and sizes of the wanted spots, and the expected number."""

    grey: Annotated[tuple[Level, Level], AfterValidator(_check_order)] | None = Field(
        None, description="smallest and largest grey level of a spot, 0 to 255"
    )
    colour: ColourRange | None = Field(
        None,
        description="colours of a spot: {hue: [from, to], saturation: [from, to], value: [from, "
        "to]}, as the page of smartcam frames colours finds them",
    )
    area: Annotated[tuple[Area, Area], AfterValidator(_check_order)] = Field(
        (20, MAX_AREA_PX), description="least and largest area of a spot, pixels"
    )
    count: Annotated[tuple[Number, Number], AfterValidator(_check_order)] | Number = Field(
        (1, MAX_SPOTS), description="expected number of spots, or its two limits"
    )
    most: int = Field(1, ge=1, le=MAX_SPOTS, description="largest number of spots in the result")

    @model_validator(mode="after")
    def _one_of(self) -> PresentSettings:
        if (self.grey is None) == (self.colour is None):
            actual = "neither" if self.grey is None else "both"
            raise ValueError(f"expected either grey or colour, got {actual}")
        return self


class Spot(NamedTuple):
    """A connected spot.

    Attributes:
        x: centre of gravity, pixels of the picture.
        y: centre of gravity.
        angle: direction of the long axis, radians from x towards y, above -pi/2, up to pi/2; NaN if
            the spot is not longer than wide.
        area: pixels.
        box: left, top, width, height.
    """

    x: float
    y: float
    angle: float
    area: int
    box: tuple[int, int, int, int]

    def values(self) -> Mapping[str, Any]:
        """Return the fields of a spot."""
        return {"x": self.x, "y": self.y, "angle": self.angle, "area": self.area}


_FIELDS: Final = "x: real32 px, y: real32 px, angle: real32 deg, area: uint32"
MIN_ELONGATION: Final = 1.05
"""Least ratio of length to width of a spot that has a direction."""


class Present(Tool[PresentSettings]):
    """Count spots of a colour or a grey level."""

    settings_model = PresentSettings

    def __init__(self, settings: PresentSettings, setup: ToolSetup) -> None:
        super().__init__(settings, setup)
        count = settings.count
        self._min_count, self._max_count = count if isinstance(count, tuple) else (count, count)

    @property
    def fields(self) -> str:
        """Fields of the number of spots and of the largest spot."""
        return f"count: uint16, {_FIELDS}" if self.settings.most == 1 else "count: uint16"

    @property
    def records(self) -> str:
        """Fields of each spot."""
        return "" if self.settings.most == 1 else _FIELDS

    def inspect(self, view: View) -> Finding:
        """Return the spots, the largest first."""
        lacks_colours = self.settings.colour is not None and not view.picture.has_colours
        spots = [] if lacks_colours else self._find_spots(view)
        count = len(spots)
        least, most = self._min_count, self._max_count
        ok = not lacks_colours and least <= count <= most
        wanted = f"{least}" if least == most else f"{least} to {most}"
        reason = (
            "the picture has no colours" if lacks_colours else f"{count} spots, expected {wanted}"
        )
        spots_kept = spots[: self.settings.most]
        single_values = (
            dict(spots_kept[0].values()) if spots_kept and self.settings.most == 1 else {}
        )
        return Finding(
            ok=ok,
            reason="" if ok else reason,
            values={"count": min(count, 0xFFFF), **single_values},
            records=[] if self.settings.most == 1 else [spot.values() for spot in spots_kept],
            drawings=[
                Drawing("polygon", _corners(view.region.corners), "region"),
                *(_draw_spot(spot, ok=ok) for spot in spots[:MAX_SPOTS]),
            ],
            reference=PixelPose(spots_kept[0].x, spots_kept[0].y, _or_zero(spots_kept[0].angle))
            if spots_kept
            else None,
            details=tuple(spots_kept),
        )

    def _find_spots(self, view: View) -> list[Spot]:
        cv2 = load("cv2", "inspection needs")
        if self.settings.colour is not None:
            mask = self.settings.colour.mask(view.rgb).view(np.uint8)
        else:
            assert self.settings.grey is not None  # noqa: S101 - checked by the settings
            low, high = self.settings.grey
            mask = cv2.inRange(view.grey, low, high)
        mask = cv2.bitwise_and(mask, view.region.mask())
        _, labels, stats, centres = cv2.connectedComponentsWithStats(mask, connectivity=8)
        min_area, max_area = self.settings.area
        areas = stats[1:, cv2.CC_STAT_AREA]
        labels_kept = 1 + np.flatnonzero((areas >= min_area) & (areas <= max_area))
        labels_kept = labels_kept[np.argsort(-stats[labels_kept, cv2.CC_STAT_AREA], kind="stable")]
        return [
            _make_spot(labels, int(label), stats[label], centres[label], view)
            for label in labels_kept
        ]


def _make_spot(
    labels: NDArray[Any], label: int, stats: NDArray[Any], centre: NDArray[Any], view: View
) -> Spot:
    left, top, width, height, area = map(int, stats)
    is_spot = labels[top : top + height, left : left + width] == label
    moments = load("cv2", "inspection needs").moments(is_spot.view(np.uint8), binaryImage=True)
    xx, yy, xy = moments["mu20"], moments["mu02"], moments["mu11"]
    spread = math.hypot(xx - yy, 2 * xy)
    long, short = xx + yy + spread, max(xx + yy - spread, 0.0)
    has_direction = long > MIN_ELONGATION**2 * short
    x0, y0 = view.origin
    return Spot(
        x=float(centre[0]) + x0,
        y=float(centre[1]) + y0,
        angle=0.5 * math.atan2(2 * xy, xx - yy) if has_direction else math.nan,
        area=area,
        box=(left + x0, top + y0, width, height),
    )


def _or_zero(angle: float) -> float:
    return 0.0 if math.isnan(angle) else angle


def _corners(corners: NDArray[Any]) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in corners)


def _draw_spot(spot: Spot, *, ok: bool) -> Drawing:
    left, top, width, height = spot.box
    right, bottom = left + width - 0.5, top + height - 0.5
    corners = ((left - 0.5, top - 0.5), (right, top - 0.5), (right, bottom), (left - 0.5, bottom))
    return Drawing("polygon", corners, "found" if ok else "wrong", f"{spot.area}")
