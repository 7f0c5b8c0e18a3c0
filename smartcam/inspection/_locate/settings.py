"""Settings of the tool `locate`."""

from __future__ import annotations

import math
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field, model_validator

from smartcam.inspection._places import RegionSetting
from smartcam.inspection._tool import ToolSettings

MAX_PARTS: Final = 200
"""Largest number of parts in one result."""

MAX_MODELS: Final = 50
"""Largest number of models that one tool searches."""

MAX_SECONDS: Final = 30.0
"""Largest time limit of a search, seconds."""


def _check_order(limits: tuple[float, float]) -> tuple[float, float]:
    if limits[0] > limits[1]:
        raise ValueError(f"expected the smaller number first, got {list(limits)}")
    return limits


Angle = Annotated[float, Field(ge=-360, le=360, allow_inf_nan=False)]
Scale = Annotated[float, Field(ge=0.25, le=4.0, allow_inf_nan=False)]
Number = Annotated[int, Field(ge=0, le=MAX_PARTS)]
File = Annotated[str, Field(min_length=1)]


class LocateSettings(ToolSettings):
    """The models that are searched, and the poses that they may have."""

    model: File | Annotated[list[File], Field(min_length=1, max_length=MAX_MODELS)] | None = Field(
        None,
        description="file with a model of the part, beside this file, as PartModel.write makes it; "
        "or a list of them",
    )
    taught: File | None = Field(
        None, description="instead of a model: file with a picture of the part, beside this file"
    )
    part: RegionSetting | None = Field(
        None,
        description="where the part is in the taught picture: [x, y, width, height] or corners; "
        "default: the whole picture",
    )
    outline: File | None = Field(
        None,
        description="instead of a model: file with the part's outline (DXF, SVG), beside this file",
    )
    pixels_per_mm: float | None = Field(
        None,
        gt=0,
        le=10_000,
        description="with an outline: pixels of the picture per millimetre of the part",
    )
    unit: Literal["mm", "cm", "m", "inch", "px"] | None = Field(
        None, description="with an outline: unit of its file; default: the unit that the file names"
    )
    bright: bool = Field(
        True, description="with an outline: whether the part is brighter than its background"
    )
    angle: Annotated[tuple[Angle, Angle], AfterValidator(_check_order)] = Field(
        (-180.0, 180.0),
        description="smallest and largest rotation since the part was taught, degrees",
    )
    scale: Annotated[tuple[Scale, Scale], AfterValidator(_check_order)] = Field(
        (1.0, 1.0), description="smallest and largest size, as a ratio to the taught size"
    )
    most: int = Field(
        1, ge=1, le=MAX_PARTS, description="largest number of parts of each model in the result"
    )
    count: Annotated[tuple[Number, Number], AfterValidator(_check_order)] | Number | None = Field(
        None,
        description="expected number of parts, or its limits; default: one or more",
    )
    least_score: float = Field(
        0.7, ge=0.3, le=1.0, description="least share of a part's edges that must be visible"
    )
    overlap: float = Field(
        0.5,
        ge=0.0,
        le=1.0,
        description="largest common area of two parts, as a share of the smaller",
    )
    polarity: Literal["same", "any"] = Field(
        "same", description="any: dark and bright may be exchanged"
    )
    contrast: float | None = Field(
        None,
        ge=1,
        le=255,
        description="least contrast of an edge, grey levels of 255; default: an eighth of the "
        "taught contrast",
    )
    sigma: float | None = Field(
        None,
        gt=0,
        allow_inf_nan=False,
        description="largest standard deviation of a place, pixels, or millimetres with a "
        "calibration; a part whose place is less certain is not ok",
    )
    seconds: float = Field(
        1.0, ge=0.01, le=MAX_SECONDS, description="seconds after which the search ends"
    )

    @model_validator(mode="after")
    def _check_consistency(self) -> LocateSettings:
        given = [name for name in ("model", "taught", "outline") if getattr(self, name) is not None]
        if len(given) != 1:
            actual = " and ".join(given) or "none of them"
            raise ValueError(f"expected a model, a taught picture or an outline, got {actual}")
        if (self.outline is None) != (self.pixels_per_mm is None):
            raise ValueError("expected outline: and pixels_per_mm: together")
        if self.unit is not None and self.outline is None:
            raise ValueError("unit: expected it with an outline only")
        if self.part is not None and self.taught is None:
            raise ValueError("part: expected it with a taught picture only")
        if self.angle[1] - self.angle[0] > 360:
            raise ValueError(f"angle: expected 360 degrees at most, got {list(self.angle)}")
        return self

    @property
    def models(self) -> list[str]:
        """Files of the models."""
        return [self.model] if isinstance(self.model, str) else self.model or []

    @property
    def angles(self) -> tuple[float, float]:
        """The angles in radians."""
        return math.radians(self.angle[0]), math.radians(self.angle[1])
