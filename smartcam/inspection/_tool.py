"""Define the base class of tools, their settings, and the input that a tool gets for a picture."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from smartcam._forks import cached_property
from smartcam.inspection._places import (
    IDENTITY,
    PixelPose,
    PlacedRegion,
    RegionSetting,
)

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from smartcam.calibration._inside import AnyCalibration
    from smartcam.inspection._finding import Finding
    from smartcam.inspection._picture import Picture


class ToolSettings(BaseModel):
    """Common settings of all tools; a tool's settings derive from this class."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid", frozen=True, hide_input_in_errors=True
    )

    region: RegionSetting | None = Field(
        None,
        description="region: [x, y, width, height] or corners, in pixels; default: whole picture",
    )
    follow: str | None = Field(
        None,
        description="name of an earlier tool or an application: coordinates are in the frame of "
        "reference that it found",
    )


S = TypeVar("S", bound=ToolSettings)


@dataclass(frozen=True, slots=True, kw_only=True)
class ToolSetup:
    """Folder and calibration with which a tool is made.

    Attributes:
        folder: folder of the file, to which paths in the settings are relative.
        calibration: calibration of the camera; None: not calibrated.
    """

    folder: Path
    calibration: AnyCalibration | None = None


@dataclass(frozen=True, kw_only=True)
class View:
    """Input of a tool for one trigger.

    Attributes:
        picture: the whole picture.
        region: the region of the settings, placed in this picture.
        reference: frame of reference that the tool follows; the picture's if it follows none.
        follows: True if the tool follows another tool.
        input: input data of the trigger.
        earlier: findings of the tools that ran before this one, by the tools' names.
    """

    picture: Picture
    region: PlacedRegion
    reference: PixelPose = IDENTITY
    follows: bool = False
    input: bytes = b""
    earlier: Mapping[str, Finding]

    @cached_property
    def grey(self) -> NDArray[np.uint8]:
        """Brightness around the region, (H, W), uint8; its first pixel is at ``origin``."""
        return self.picture.grey[self.region.rows_columns]

    @cached_property
    def rgb(self) -> NDArray[np.uint8]:
        """Colours around the region, (H, W, 3), uint8, red first."""
        return self.picture.rgb[self.region.rows_columns]

    @property
    def origin(self) -> tuple[int, int]:
        """Column and row of the region's first pixel in the picture."""
        return self.region.left, self.region.top


class Tool(ABC, Generic[S]):
    """A tool, which is made once for a program and then inspects each picture.

    A subclass has a settings model, fields, and :meth:`inspect`. Packages offer tools as entry
    points of the group ``smartcam.tools``; :func:`register_tool` adds a tool in this process.

    ``inspect`` is a pure function of the view: it keeps no state between pictures, and several
    threads may call it at once.

    Args:
        settings: the tool's settings in the program.
        setup: folder and calibration.

    Raises:
        ConfigurationError: the settings are wrong.

    Attributes:
        settings: the settings as given.
        setup: folder and calibration.
    """

    settings_model: ClassVar[type[ToolSettings]]
    """Pydantic model of the tool's settings in a program file."""

    needs_whole_region: ClassVar[bool] = True
    """If True, a region that reaches out of the picture gives a finding that is not ok."""

    def __init__(self, settings: S, setup: ToolSetup) -> None:
        self.settings = settings
        self.setup = setup

    @property
    def fields(self) -> str:
        """Layout text of the values, such as ``"count: uint16, area: real32 px"``; "" for none."""
        return ""

    @property
    def records(self) -> str:
        """Layout text of one record, for tools that find several objects; "": no records."""
        return ""

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences about the tool's taught data and their quality, for the teaching page."""
        return ()

    @abstractmethod
    def inspect(self, view: View) -> Finding:
        """Return the finding in a picture.

        A picture that is too dark or blurred, or lacks the part, gives a finding that is not ok,
        with its reason. An exception is a fault of the tool; the camera's result is then not ok,
        with the error as the reason.
        """


AnyTool = Tool[Any]
