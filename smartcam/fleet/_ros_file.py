"""What a fleet file says of ROS 2."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from smartcam.ros2._names import as_name, check_namespace

if TYPE_CHECKING:
    from pathlib import Path

    from smartcam.calibration._files.load import AnyCalibration

MOST_DOMAIN = 0xFFFFFFFF
MOST_FRAME = 200


class Fields(BaseModel):
    """What every part of a fleet file is."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid", frozen=True, hide_input_in_errors=True
    )


Frame = Annotated[str, Field(min_length=1, max_length=MOST_FRAME)]
Namespace = Annotated[str, AfterValidator(check_namespace)]


class RosSection(Fields):
    """How the cameras are seen in ROS 2."""

    domain: int | None = Field(
        None, ge=0, le=MOST_DOMAIN, description="number of the domain; default: ROS_DOMAIN_ID, or 0"
    )
    namespace: Namespace = Field("/", description="in front of the cameras' names")
    distribution: Literal["humble", "jazzy", "kilted", "lyrical", "rolling"] = Field(
        "jazzy", description="of ROS: its type hashes are part of all names"
    )
    autostart: bool = Field(True, description="the nodes become active by themselves")


class RosCamera(Fields):
    """How one camera is seen in ROS 2."""

    frame_id: Frame | None = Field(
        None, description="frame of reference of its results; default: the camera's name"
    )
    parent_frame: Frame | None = Field(
        None, description="frame that a calibration has the camera's place in, such as base_link"
    )
    calibration: str | None = Field(
        None, description="file with the calibration, beside this one: results are the robot's then"
    )

    def load_calibration(self, folder: Path) -> AnyCalibration | None:
        """Return the calibration, None where none is said.

        Args:
            folder: that the fleet file is in.

        Raises:
            CalibrationError: the file holds something else.
            OSError: it cannot be read.
        """
        if self.calibration is None:
            return None
        from smartcam.calibration._files.load import load_calibration

        return load_calibration(folder / self.calibration)


def node_names(cameras: list[str]) -> dict[str, str]:
    """Return the name in the graph of each camera.

    Raises:
        ValueError: two have the same.
    """
    found: dict[str, str] = {}
    for camera in cameras:
        name = as_name(camera)
        other = found.setdefault(name, camera)
        if other != camera:
            raise ValueError(f"{other} and {camera} would both be /{name} in ROS")
    return {camera: name for name, camera in found.items()}
