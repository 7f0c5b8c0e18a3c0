"""Serve, at a node, the five calibration services of the thesis with which smartcam began."""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING, Any

from smartcam._client._inside import Interpretation
from smartcam._thesis_calibration import (
    CALIBRATION,
    CalibrationCall,
    checked_localizations,
    localization_spec,
)
from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT
from smartcam.ros2._cameras.image_messages import stamp_fields, utc_of
from smartcam.ros2._cameras.picture_requests import take_frame
from smartcam.ros2._cameras.reading import interpretation_of
from smartcam.settings import validated

if TYPE_CHECKING:
    from datetime import datetime

    from smartcam.calibration._inside import ThesisCalibration
    from smartcam.camera import Camera
    from smartcam.models import Localization, Pose, Result

OWN_PICTURE_TIMEOUT = 20.0
"""Seconds that taking a picture with the camera may take."""


def open_calibrations(
    calibrations: ThesisCalibration | str | os.PathLike[str] | None, camera: str
) -> ThesisCalibration | None:
    """Return a camera's calibrations; for a path, open or create the folder of the calibrations.

    Raises:
        OSError: the folder cannot be created.
    """
    if not isinstance(calibrations, str | os.PathLike):
        return calibrations
    from smartcam.calibration._inside import ThesisCalibration

    return ThesisCalibration(calibrations, camera)


class RosCalibrationCamera:
    """The camera of a node during a calibration; results are interpreted without a calibration.

    Args:
        camera: the camera.
    """

    def __init__(self, camera: Camera[Any]) -> None:
        self._camera = camera
        self.name: str = camera.name
        self.y_down: bool = camera.settings.y_down
        self.unit: str
        self._spec, self.unit = localization_spec(
            interpretation_of(camera), camera.active_application
        )

    async def localize(self) -> list[Localization]:
        """Trigger; return the localizations in the camera's own frame."""
        settings = self._camera.settings
        lenient, y_down = settings.lenient, settings.y_down
        interpretation: Any = Interpretation(self._spec, lenient=lenient, y_down=y_down)
        result: Result[Any] = await self._camera.trigger(
            interpret_as=interpretation, timeout=DEFAULT_TRIGGER_TIMEOUT
        )
        return checked_localizations(result.value, self.name)

    async def take_picture(self) -> Any:
        """Return the grey levels of a picture of the camera."""
        camera = self._camera
        if camera.capabilities.read_image and not getattr(camera, "has_frames", False):
            await camera.trigger(interpret_as="raw")
        frame = await take_frame(None, camera, OWN_PICTURE_TIMEOUT)
        return await asyncio.to_thread(frame.grey)


class CalibrationServices:
    """Answers the five calibration services of a camera's node.

    Args:
        camera: the camera.
        calibrations: calibrations of the camera; None if there is no folder for them.
    """

    def __init__(self, camera: Camera[Any], calibrations: ThesisCalibration | None) -> None:
        self._camera = camera
        self.name: str = camera.name
        self.thesis_calibration: ThesisCalibration | None = calibrations

    def camera(self, timeout: float) -> RosCalibrationCamera:
        """Return the camera for a call; ``timeout`` has no effect here."""
        return RosCalibrationCamera(self._camera)

    async def answer(self, name: str, message: Any) -> dict[str, Any]:
        """Carry out a request of the service ``name``; return the fields of its answer.

        Raises:
            SmartCamError: the service failed.
        """
        service = CALIBRATION[name]
        field_names = [field for field in service.request.model_fields if hasattr(message, field)]
        fields = {field: _request_value(getattr(message, field)) for field in field_names}
        request = validated(service.request, fields, f"{self.name}: {name}")
        answer = await service.do(CalibrationCall(self, request, service.timeout))
        if "pose" in answer:
            answer["pose"] = _pose_stamped_fields(answer["pose"])
        return answer


def _request_value(value: Any) -> Any:
    """Return the value of a message's field as a plain value for the request."""
    if hasattr(value, "frame_id"):
        return {"stamp": utc_of(value), "frame_id": value.frame_id}
    if hasattr(value, "tolist"):
        return value.tolist()
    return list(value) if isinstance(value, list | tuple) else value


def _pose_stamped_fields(pose: Pose) -> dict[str, Any]:
    """Return ``geometry_msgs/PoseStamped``."""
    stamp: datetime = pose.header.stamp
    return {
        "header": {"stamp": stamp_fields(stamp.timestamp()), "frame_id": pose.header.frame_id},
        "pose": {"position": pose.position._asdict(), "orientation": pose.orientation._asdict()},
    }
