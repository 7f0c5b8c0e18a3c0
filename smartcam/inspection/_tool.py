"""The contract of tools: settings, fields, and a function from a view to a finding."""

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
    """The settings that every tool has in a program; a tool's own ones derive from them."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid", frozen=True, hide_input_in_errors=True
    )

    region: RegionSetting | None = Field(
        None,
        description="where it looks: [x, y, width, height] or corners, in pixels; default: "
        "everywhere",
    )
    follow: str | None = Field(
        None,
        description="name of a tool before this one, or of an application: coordinates are in the "
        "frame of reference that it found",
    )


S = TypeVar("S", bound=ToolSettings)


@dataclass(frozen=True, slots=True, kw_only=True)
class ToolSetup:
    """The surroundings that a tool is made in.

    Attributes:
        folder: folder that the paths in its settings are relative to.
        calibration: calibration of the camera; None: it has none.
    """

    folder: Path
    calibration: AnyCalibration | None = None


@dataclass(frozen=True, kw_only=True)
class View:
    """All that a tool may see of one trigger.

    Attributes:
        picture: the whole picture.
        region: the region of the settings, where it lies in this picture.
        reference: the frame of reference that the tool follows; the picture's own if it follows
            none.
        follows: True if the tool follows another one.
        input: input data of the trigger.
        earlier: what the tools before it found, by their names.
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
    """A tool: made once for a program, then asked about each picture.

    A class with a settings model, its fields, and :meth:`inspect`. Packages offer theirs as entry
    points of the group ``smartcam.tools``; :func:`register_tool` does it for this process.

    ``inspect`` is a pure function of the view: it keeps nothing between pictures, and may run in
    any thread, several at once.

    Args:
        settings: the tool's settings in the program.
        setup: what it may use besides.

    Raises:
        ConfigurationError: the settings cannot work.

    Attributes:
        settings: the settings as given.
        setup: what it may use besides.
    """

    settings_model: ClassVar[type[ToolSettings]]
    """The pydantic model of its settings in a program file."""

    needs_whole_region: ClassVar[bool] = True
    """Not ok where the region reaches out of the picture; the tool is not asked then."""

    def __init__(self, settings: S, setup: ToolSetup) -> None:
        self.settings = settings
        self.setup = setup

    @property
    def fields(self) -> str:
        """Layout text of the values, such as ``"count: uint16, area: real32 px"``; "" for none."""
        return ""

    @property
    def records(self) -> str:
        """Layout text of one thing found, for tools that find several; "" if there is none."""
        return ""

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences for those who teach it: what it was taught, and how good that is."""
        return ()

    @abstractmethod
    def inspect(self, view: View) -> Finding:
        """Return the finding in a picture.

        What is missing in the picture, too dark or too blurred is a finding that is not ok, with
        its reason. An exception is a fault of the tool; a camera gives a result then that is not
        ok and says so.
        """


AnyTool = Tool[Any]
