"""The base class of the pydantic models that describe emulated cameras."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import BaseModel, ConfigDict, Field

from smartcam._forks import cached_property

Seconds = Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)]
"""A time of up to an hour."""


class EmulatorData(BaseModel):
    """Base of the data: objects do not change, and unknown fields are refused."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        frozen=True, extra="forbid", ignored_types=(cached_property,)
    )
