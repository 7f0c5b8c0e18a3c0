"""Pydantic models of a measurement's settings."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PlainValidator, model_validator

from smartcam.exceptions import ConfigurationError
from smartcam.inspection._measure.edges import MAX_WIDTH_PX, Choice, PairChoice, Polarity
from smartcam.inspection._measure.tolerances import Tolerance
from smartcam.inspection._tool import ToolSettings

MAX_COORDINATE_PX: Final = 100_000.0
"""Largest magnitude of a coordinate, pixels; no picture is larger."""

MAX_LENGTH_PX: Final = 4_000.0
"""Largest length of a strip, pixels."""

MAX_STRIPS: Final = 500
"""Largest number of strips of a line or a circle."""

Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE_PX, le=MAX_COORDINATE_PX)]
Place = tuple[Coordinate, Coordinate]


def _apart(given: tuple[Place, Place]) -> tuple[Place, Place]:
    if math.dist(*given) < 1.0:
        raise ValueError(f"expected two points that are a pixel or more apart, got {list(given)}")
    return given


PointPair = Annotated[tuple[Place, Place], AfterValidator(_apart)]
"""Two points that are a pixel or more apart."""


class EdgeSearch(BaseModel):
    """Common settings of searches for edges."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid", frozen=True, hide_input_in_errors=True
    )

    polarity: Polarity = Field(
        "any",
        description="rising: from dark to light along the strip; falling: from light to dark; any",
    )
    contrast: float = Field(
        10.0, gt=0, le=255, description="least height of an edge, in grey levels of 255"
    )
    smoothing: float = Field(
        1.2,
        ge=0.5,
        le=10,
        description="smoothing of the search for edges, pixels; places do not depend on it",
    )
    blur: float = Field(
        5.0, gt=0, le=10, description="largest blur of an edge, pixels; more is an error"
    )
    allow_saturated: bool = Field(
        False,
        description="measure edges beside saturated levels, too, whose error may exceed sigma",
    )


class Across(EdgeSearch):
    """A search for one edge that crosses a strip."""

    across: PointPair = Field(description="start and end of the strip, [[x, y], [x, y]]")
    strip: float = Field(10.0, ge=1, le=MAX_WIDTH_PX, description="width of the strip, pixels")
    which: Choice = Field(
        "single",
        description="first, last, strongest, or nearest to the strip's middle, of several edges; "
        "single: several are an error",
    )


class AcrossPair(EdgeSearch):
    """A search for the two edges of a bar that crosses a strip."""

    across: PointPair = Field(description="start and end of the strip, [[x, y], [x, y]]")
    strip: float = Field(10.0, ge=1, le=MAX_WIDTH_PX, description="width of the strip, pixels")
    which: PairChoice = Field(
        "single",
        description="first, last or strongest pair of neighbours, one from dark to light and one "
        "from light to dark; outermost: the first and the last edge; single: expect two edges",
    )


class StripSearch(EdgeSearch):
    """A search for many edges, each in a strip."""

    search: float = Field(
        20.0, ge=4, le=MAX_LENGTH_PX, description="length of the strips across, pixels"
    )
    strips: int = Field(24, ge=4, le=MAX_STRIPS, description="number of strips")
    strip: float | None = Field(
        None,
        ge=1,
        le=MAX_WIDTH_PX,
        description="width of a strip, pixels; default and largest: the distance between strips",
    )
    which: Choice = Field("single", description="choice among several edges in a strip")


class LineSearch(StripSearch):
    """A search for a straight line."""

    along: PointPair = Field(description="two points near the line, [[x, y], [x, y]]")


class CircleSearch(StripSearch):
    """A search for a circle or an arc."""

    centre: Place = Field(description="approximate centre, [x, y]")
    radius: float = Field(ge=2, le=MAX_COORDINATE_PX, description="approximate radius, pixels")
    arc: tuple[float, float] = Field(
        (0.0, 360.0), description="visible angles [from, to], degrees from x towards y"
    )

    @model_validator(mode="after")
    def _check_arc(self) -> CircleSearch:
        begin, end = self.arc
        if not (-360 <= begin < end <= 720 and end - begin <= 360):
            raise ValueError(f"expected an arc [from, to] of 360 degrees at most, got {self.arc}")
        if self.search / 2 > 0.9 * self.radius:
            raise ValueError(
                f"expected search up to {1.8 * self.radius:g} pixels at a radius of "
                f"{self.radius:g}: strips would cross the centre"
            )
        return self


class FeatureSearch(BaseModel):
    """A feature for a distance: an edge, a line or a circle."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid", frozen=True, hide_input_in_errors=True
    )

    edge: Across | None = Field(None, description="a point: where an edge crosses a strip")
    line: LineSearch | None = Field(None, description="a line")
    circle: CircleSearch | None = Field(None, description="the centre of a circle")

    @model_validator(mode="after")
    def _one_of(self) -> FeatureSearch:
        given = [name for name in ("edge", "line", "circle") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(
                f"expected one of edge, line and circle, got {' and '.join(given) or 'none'}"
            )
        return self


class Between(BaseModel):
    """Two features whose distance is measured."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid", frozen=True, hide_input_in_errors=True
    )

    first: FeatureSearch = Field(description="an edge, a line or a circle")
    second: FeatureSearch = Field(description="an edge, a line or a circle")


class LineFeature(BaseModel):
    """A line for an angle."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid", frozen=True, hide_input_in_errors=True
    )

    line: LineSearch = Field(description="a line, with the direction of its two points")


class BetweenLines(BaseModel):
    """Two lines whose angle is measured."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid", frozen=True, hide_input_in_errors=True
    )

    first: LineFeature = Field(description="a line")
    second: LineFeature = Field(description="the other line")


def _tolerance(given: Any) -> Tolerance:
    if isinstance(given, Tolerance):
        return given
    try:
        return Tolerance.parse(given)
    except ConfigurationError as exc:
        raise ValueError(str(exc)) from exc


KINDS: Final = ("width", "edge", "line", "circle", "distance", "angle")
"""Kinds of measurement; a tool has one kind."""


class MeasureSettings(ToolSettings):
    """A measurement with its tolerance."""

    width: AcrossPair | None = Field(None, description="the width of a bar")
    edge: Across | None = Field(None, description="the place of an edge in its strip")
    line: LineSearch | None = Field(None, description="the direction of a line")
    circle: CircleSearch | None = Field(None, description="the diameter of a circle")
    distance: Between | None = Field(None, description="the distance of two things")
    angle: BetweenLines | None = Field(None, description="the angle between two lines")
    tolerance: Annotated[Tolerance, PlainValidator(_tolerance)] | None = Field(
        None, description="good values, such as 12.00 +- 0.05 mm; default: any"
    )
    guard: float = Field(
        2.0,
        ge=0,
        le=10,
        description="distance of a good value from its limits, in sigmas",
    )
    unit: Literal["mm", "px"] | None = Field(
        None,
        description="mm, by the camera's calibration, or px; default: as the tolerance, else mm "
        "if a plane is calibrated",
    )

    @property
    def kind(self) -> str:
        """Kind of the measurement, one of :data:`KINDS`."""
        return next(name for name in KINDS if getattr(self, name) is not None)

    @model_validator(mode="after")
    def _one_of(self) -> MeasureSettings:
        given = [name for name in KINDS if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(
                f"expected one of {', '.join(KINDS)}, got {' and '.join(given) or 'none'}"
            )
        if self.region is not None:
            raise ValueError("expected no region: strips say where it measures")
        if self.tolerance is not None:
            is_angle = given[0] in {"line", "angle"}
            if is_angle != (self.tolerance.unit == "deg"):
                expected = "deg" if is_angle else "a unit of length or px"
                raise ValueError(f"tolerance: expected {expected}, got {self.tolerance.text!r}")
            one_sided = math.inf in (-self.tolerance.min_value, self.tolerance.max_value)
            if given[0] == "line" and one_sided:
                raise ValueError(
                    "tolerance: expected both limits of a direction, such as '-5 to 5 deg', "
                    f"got {self.tolerance.text!r}"
                )
            if self.unit is not None and self.tolerance.unit not in {"deg", self.unit}:
                raise ValueError(f"tolerance: expected {self.unit}, got {self.tolerance.text!r}")
        return self
