"""The options of a camera's node."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    import os
    from collections.abc import Awaitable, Callable, Mapping

    from smartcam.calibration import HandEyeCalibration
    from smartcam.calibration._inside import ThesisCalibration
    from smartcam.frames import FrameSource
    from smartcam.geometry import Transform
    from smartcam.settings import CameraSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraNodeOptions:
    """The options of a camera's node.

    Attributes:
        frame_id: name of the camera's frame; empty for the camera's name.
        parent_frame: name of the robot's frame; empty: the name in a calibration.
        flange_frame: name of the frame of the part of the robot that carries the camera; empty: the
            name in a calibration.
        hand_eye: hand-eye calibration of the camera; None without.
        calibration_pose: pose of the part that carries the camera, in the robot's frame, when the
            calibration of the camera's settings was made; None if the camera stands still.
        autostart: whether the life cycle goes to Active by itself.
        application: id of the application that configuring loads and runs; None: that of the
            camera's settings.
        diagnostics_period: seconds between two diagnostics.
        status_rate: largest number of messages of status a second.
        hardware_id: id of the hardware in diagnostics; empty for the camera's address.
        settings: settings of the session with the camera, if they differ from the camera's own:
            the agent's, for a camera of a fleet.
        is_agent_alive: function that returns whether the agent with the session is alive; None if
            there is no agent.
        video_parameters: parameters for the source of its pictures, by v4l2_camera's names:
            ``video_device``, ``pixel_format``, ``image_size`` and ``camera_info_url``.
        get_frame_source: function that returns the open source of its pictures, whose device's
            controls become parameters; None: no controls.
        calibrations: folder for calibrations of the camera, or calibrations that are shared with
            other interfaces of the camera; None: the services for them refuse.
    """

    frame_id: str = ""
    parent_frame: str = ""
    flange_frame: str = ""
    hand_eye: HandEyeCalibration | None = None
    calibration_pose: Transform | None = None
    autostart: bool = True
    application: int | None = None
    diagnostics_period: float = 1.0
    status_rate: float = 20.0
    hardware_id: str = ""
    settings: CameraSettings | None = None
    is_agent_alive: Callable[[], bool] | None = None
    video_parameters: Mapping[str, Any] = field(default_factory=dict[str, Any])
    get_frame_source: Callable[[], Awaitable[FrameSource]] | None = None
    calibrations: str | os.PathLike[str] | ThesisCalibration | None = None

    def __post_init__(self) -> None:
        for name, value in (
            ("diagnostics_period", self.diagnostics_period),
            ("status_rate", self.status_rate),
        ):
            if not 0.01 <= value <= 3600:
                raise ConfigurationError(f"{name}: {value!r}: expected 0.01 to 3600")
