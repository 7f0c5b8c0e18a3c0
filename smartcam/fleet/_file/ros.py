"""Define the sections about ROS 2 in a fleet file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from smartcam._ros_names import as_name, check_namespace

if TYPE_CHECKING:
    from pathlib import Path

    from smartcam.calibration import HandEyeCalibration
    from smartcam.calibration._inside import AnyCalibration
    from smartcam.geometry import Transform

MAX_DOMAIN_ID = 0xFFFFFFFF
MAX_FRAME_CHARACTERS = 200


class Fields(BaseModel):
    """The base of every section of a fleet file."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid", frozen=True, hide_input_in_errors=True
    )


Frame = Annotated[str, Field(min_length=1, max_length=MAX_FRAME_CHARACTERS)]
Namespace = Annotated[str, AfterValidator(check_namespace)]


class RosSection(Fields):
    """The view of the cameras in ROS 2."""

    domain: int | None = Field(
        None,
        ge=0,
        le=MAX_DOMAIN_ID,
        description="number of the domain; default: ROS_DOMAIN_ID, or 0",
    )
    namespace: Namespace = Field("/", description="namespace of the cameras' nodes")
    distribution: Literal["humble", "jazzy", "kilted", "lyrical", "rolling"] = Field(
        "jazzy",
        description="distribution of ROS, whose message types are used; through rclpy, the "
        "default is the installed one",
    )
    autostart: bool = Field(True, description="the nodes become active by themselves")
    through: Literal["zenoh", "rclpy"] = Field(
        "zenoh",
        description="transport: smartcam's own, compatible with rmw_zenoh; or the installed rclpy, "
        "over any middleware",
    )
    args: tuple[str, ...] = Field(
        (), description="arguments for rclpy, such as --ros-args -p use_sim_time:=true"
    )


class RosCamera(Fields):
    """The view of one camera in ROS 2."""

    frame_id: Frame | None = Field(
        None, description="frame of reference of its results; default: the camera's name"
    )
    parent_frame: Frame | None = Field(
        None, description="the robot's frame, such as base_link; default: that of a calibration"
    )
    flange_frame: Frame | None = Field(
        None,
        description="frame of the part of the robot that carries the camera, such as tool0; "
        "default: that of a calibration",
    )
    calibration: str | None = Field(
        None, description="file, beside this file, with the calibration to the robot's frame"
    )
    calibration_pose: Annotated[tuple[float, ...], Field(min_length=7, max_length=7)] | None = (
        Field(
            None,
            description="pose, at the calibration, of the part that carries the camera, in the "
            "robot's frame: x, y, z in metres, and the quaternion x, y, z, w",
        )
    )
    hand_eye: str | None = Field(
        None,
        description="file, beside this file, with a hand-eye calibration: the camera's place for "
        "/tf_static",
    )

    def load_calibration(self, folder: Path) -> AnyCalibration | None:
        """Read the calibration, and return it; None without ``calibration``.

        Args:
            folder: folder of the fleet file.

        Raises:
            CalibrationError: the file has no calibration.
            OSError: the file cannot be read.
        """
        if self.calibration is None:
            return None
        from smartcam.calibration import load_calibration

        return load_calibration(folder / self.calibration)

    def load_hand_eye(self, folder: Path) -> HandEyeCalibration | None:
        """Read the hand-eye calibration like :meth:`load_calibration`; None without one."""
        if self.hand_eye is None:
            return None
        from smartcam.calibration import HandEyeCalibration

        return HandEyeCalibration.load(folder / self.hand_eye)

    def robot_pose(self) -> Transform | None:
        """Return the pose of ``calibration_pose``; None without it.

        Raises:
            CalibrationError: the numbers are not a pose.
        """
        if self.calibration_pose is None:
            return None
        from smartcam.geometry import Transform

        position, quaternion = self.calibration_pose[:3], self.calibration_pose[3:]
        flange = self.flange_frame or "flange"
        return Transform.from_quaternion("robot", flange, position, quaternion)


def node_names(cameras: list[str]) -> dict[str, str]:
    """Return the name of each camera's node in ROS.

    Raises:
        ValueError: two cameras have the same name.
    """
    names: dict[str, str] = {}
    for camera in cameras:
        name = as_name(camera)
        other = names.setdefault(name, camera)
        if other != camera:
            raise ValueError(f"{other} and {camera} would both be /{name} in ROS")
    return {camera: name for name, camera in names.items()}
