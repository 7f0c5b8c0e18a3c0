"""Serve the five calibration services of the thesis with which smartcam began, in JSON."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

from pydantic import create_model

from smartcam._extras import from_part
from smartcam._json import plain
from smartcam._thesis_calibration import (
    CALIBRATION,
    CalibrationCall,
    checked_localizations,
    localization_spec,
)
from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT
from smartcam.exceptions import UnsupportedError
from smartcam.fleet._frames.stream import FrameCall
from smartcam.fleet._frames.wire import FrameForm
from smartcam.fleet._json.services import Service, trigger_camera
from smartcam.fleet._json.thesis import BusFields
from smartcam.fleet._program.reading import interpret_single

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from smartcam._thesis_calibration import WizardService
    from smartcam.calibration._inside import ThesisCalibration
    from smartcam.fleet._json.services import Work
    from smartcam.models import Localization

RESERVATION_TIMEOUT = 10.0
"""Seconds to wait for the end of another program's reservation."""

PICTURE_TIMEOUT = 20.0
"""Seconds to wait for a picture from the camera."""


class JsonCalibrationCamera:
    """A camera of an agent, for a calibration.

    Args:
        work: the running service.
    """

    def __init__(self, work: Work) -> None:
        self._work, self._camera, self._topics = work, work.camera, work.topics
        self.name: str = work.camera.name
        self.y_down: bool = work.camera.settings.y_down
        self.unit: str
        active = self._camera.client.active_application
        self._spec, self.unit = localization_spec(self._topics.interpretation, active)

    async def localize(self) -> list[Localization]:
        """Trigger; return the localizations in the camera's own frame."""
        interpretation = self._topics.make_interpretation(self._spec)
        async with self._kept_unreserved():
            (group,) = await trigger_camera(
                self._work_with_timeout(DEFAULT_TRIGGER_TIMEOUT), interpretation, None
            )
        value, _, _ = interpret_single(group, interpretation, self.name)
        return checked_localizations(value, self.name)

    async def take_picture(self) -> Any:
        """Return the grey levels of a picture of the camera."""
        camera = self._camera
        if camera.frames.make is not None:
            timeout = min(self._work.timeout, PICTURE_TIMEOUT)
            call = FrameCall("", self._work.owner.call, FrameForm(), timeout)
            frame, _ = await camera.frames.get_frame(call, max_age=None, after=None, fresh=True)
            return await asyncio.to_thread(frame.grey)
        if not camera.client.capabilities.read_image:
            raise UnsupportedError(
                f"{self.name}: its protocol sends no pictures; expected frames: in the fleet file, "
                "or a topic with pictures"
            )
        with from_part("calibration", "the calibration services need"):
            from smartcam.calibration._inside import decode_picture
        async with self._kept_unreserved():
            await trigger_camera(self._work_with_timeout(DEFAULT_TRIGGER_TIMEOUT), None, None)
            data = await camera.require_client().read_image(timeout=PICTURE_TIMEOUT)
        return await asyncio.to_thread(decode_picture, data, self.name)

    @contextlib.asynccontextmanager
    async def _kept_unreserved(self) -> AsyncIterator[None]:
        """Keep other programs from reserving the camera during the block."""
        program = f"{self._work.request.program or 'a program'} (not a smartcam client)"
        await self._camera.enter_gate(program, "a calibration", RESERVATION_TIMEOUT)
        try:
            yield
        finally:
            self._camera.gate.leave(program)

    def _work_with_timeout(self, seconds: float) -> Work:
        """Return the running service with a timeout of at most ``seconds``."""
        return self._work._replace(timeout=min(self._work.timeout, seconds))


class JsonCalibrationOwner:
    """An agent's camera as the five calibration services use it.

    Args:
        work: the running service.
    """

    def __init__(self, work: Work) -> None:
        self._work = work
        self.name: str = work.camera.name

    @property
    def thesis_calibration(self) -> ThesisCalibration | None:
        """The object that calibrates the camera; None if there is no folder for it."""
        calibrations = self._work.calibrations
        return None if calibrations is None else calibrations.of(self.name)

    def camera(self, timeout: float) -> JsonCalibrationCamera:
        """Return the camera, for one call."""
        return JsonCalibrationCamera(self._work)


def _bus_service(name: str) -> Service:
    """Return one of the five services as a service of the bus."""
    wizard_service: WizardService = CALIBRATION[name]
    request: Any = create_model(
        wizard_service.request.__name__, __base__=(wizard_service.request, BusFields)
    )

    async def carry_out(work: Work) -> dict[str, Any]:
        call = CalibrationCall(JsonCalibrationOwner(work), work.request, work.timeout)
        fields = {key: plain(value) for key, value in (await wizard_service.do(call)).items()}
        return {**fields, "kind": "CalibrationError"} if fields.get("error") else fields

    empty_fields: dict[str, Any] = {"pose": None} if name == "TransformPixelPose" else {}
    # no command, which would wait for the end of a reservation: each of its triggers waits itself
    return Service(
        request,
        carry_out,
        is_command=False,
        timeout=wizard_service.timeout,
        empty_fields=empty_fields,
    )


CALIBRATIONS: dict[str, Service] = {name: _bus_service(name) for name in CALIBRATION}
"""The five services by name."""
