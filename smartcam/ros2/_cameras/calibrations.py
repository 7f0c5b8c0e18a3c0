"""Serve the thesis' five calibration services at a camera's node."""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING, Any

from smartcam._client._inside import Interpretation
from smartcam._thesis_calibration import (
    CALIBRATION,
    CalibrationCall,
    checked_localizations,
    own_localizations,
)
from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT
from smartcam.ros2._cameras.image_messages import stamp_fields, utc_of
from smartcam.ros2._cameras.picture_requests import one_frame
from smartcam.ros2._cameras.reading import reading_of
from smartcam.settings import validated

if TYPE_CHECKING:
    from datetime import datetime

    from smartcam.calibration._inside import ThesisCalibration
    from smartcam.camera import Camera
    from smartcam.models import Localization, Pose, Result

OWN_PICTURE_TIMEOUT = 20.0
"""Seconds of the timeout for a picture of the camera itself."""


def calibrations_of(
    given: ThesisCalibration | str | os.PathLike[str] | None, camera: str
) -> ThesisCalibration | None:
    """Return the calibrations of a camera, created if a folder is given.

    Raises:
        OSError: the folder cannot be created.
    """
    if not isinstance(given, str | os.PathLike):
        return given
    from smartcam.calibration._inside import ThesisCalibration

    return ThesisCalibration(given, camera)


class RosCalibrationCamera:
    """A node's camera during calibration; its results are interpreted without a calibration.

    Args:
        camera: the camera.
    """

    def __init__(self, camera: Camera[Any]) -> None:
        self._camera = camera
        self.name: str = camera.name
        self.y_down: bool = camera.settings.y_down
        self.unit: str
        self._spec, self.unit = own_localizations(reading_of(camera), camera.active_application)

    async def localize(self) -> list[Localization]:
        """Trigger; return the localizations in the camera's own frame."""
        settings = self._camera.settings
        lenient, y_down = settings.lenient, settings.y_down
        reading: Any = Interpretation(self._spec, lenient=lenient, y_down=y_down)
        result: Result[Any] = await self._camera.trigger(
            interpret_as=reading, timeout=DEFAULT_TRIGGER_TIMEOUT
        )
        return checked_localizations(result.value, self.name)

    async def take_picture(self) -> Any:
        """Return the grey levels of a picture of the camera."""
        camera = self._camera
        if camera.capabilities.read_image and not getattr(camera, "has_frames", False):
            await camera.trigger(interpret_as="raw")
        frame = await one_frame(None, camera, OWN_PICTURE_TIMEOUT)
        return await asyncio.to_thread(frame.grey)


class RosCalibrationFace:
    """The part of a camera's node that answers the five services.

    Args:
        camera: the camera.
        calibrations: calibrations of the camera; None if there is no folder for them.
    """

    def __init__(self, camera: Camera[Any], calibrations: ThesisCalibration | None) -> None:
        self._camera = camera
        self.name: str = camera.name
        self.calibrations: ThesisCalibration | None = calibrations

    def camera(self, timeout: float) -> RosCalibrationCamera:
        """Return the camera, for one call."""
        return RosCalibrationCamera(self._camera)

    async def answer(self, name: str, message: Any) -> dict[str, Any]:
        """Carry out a request; return the fields of its answer.

        Raises:
            SmartCamError: the service failed.
        """
        service = CALIBRATION[name]
        names = [field for field in service.request.model_fields if hasattr(message, field)]
        fields = {field: _plain(getattr(message, field)) for field in names}
        request = validated(service.request, fields, f"{self.name}: {name}")
        answer = await service.do(CalibrationCall(self, request, service.timeout))
        if "pose" in answer:
            answer["pose"] = _stamped(answer["pose"])
        return answer


def _plain(value: Any) -> Any:
    """Convert a field of a message to the field of a request."""
    if hasattr(value, "frame_id"):
        return {"stamp": utc_of(value), "frame_id": value.frame_id}
    if hasattr(value, "tolist"):
        return value.tolist()
    return list(value) if isinstance(value, list | tuple) else value


def _stamped(pose: Pose) -> dict[str, Any]:
    """Return ``geometry_msgs/PoseStamped``."""
    stamp: datetime = pose.header.stamp
    return {
        "header": {"stamp": stamp_fields(stamp.timestamp()), "frame_id": pose.header.frame_id},
        "pose": {"position": pose.position._asdict(), "orientation": pose.orientation._asdict()},
    }
