"""The thesis' five calibration services: their requests, and the work for each.

They have the same faces as the six camera services, see :mod:`smartcam._thesis`. The work is done
by :class:`~smartcam.calibration.wizards._thesis.ThesisCalibration`, one object for each camera,
which all faces share.
"""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal, NamedTuple, Protocol

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from smartcam._client._inside import in_pixels, localizations_of, without_poses
from smartcam._extras import from_part
from smartcam._thesis import DEFAULT_TIMEOUT, ThesisRequest
from smartcam.exceptions import ConfigurationError, InterpretationError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam._client._inside import Interpretation
    from smartcam.calibration._inside import CalibrationCamera, ThesisCalibration
    from smartcam.models import Localization

STEP_TIMEOUT: Final = 150.0
"""Seconds for a step if the request gives none: a calculation has 120, a picture 60."""

MAX_INPUTS: Final = 100
"""Largest number of answers of one kind that a request may have; a step asks for some dozen."""

MAX_COORDINATE: Final = 1e9
"""Coordinate of a pose that is transformed, in the calibration's unit, either way from 0."""

_Text = Annotated[str, Field(max_length=200)]
_Answer = Annotated[str, Field(max_length=2000)]
_Real = Annotated[float, Field(allow_inf_nan=False)]
_Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE, allow_inf_nan=False)]


def _place(value: object) -> object:
    """Return the text of a place in the spelling that is compared."""
    return value.strip().capitalize() if isinstance(value, str) else value


class StartRequest(ThesisRequest):
    """The sources of pictures and poses, and the place of the camera."""

    topic_image1: _Text = ""
    topic_image2: _Text = ""
    checkerboard_squaresize_m: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 0.0
    tf_frame_robot_tcp: _Text = ""
    tf_frame_robot_base: _Text = ""
    fixed_camera: Annotated[Literal["True", "False", ""], BeforeValidator(_place)] = ""


class PerformRequest(ThesisRequest):
    """The answers of a step, or the action instead of answering."""

    repeat_last_step: bool = False
    abort: bool = False
    value_inputs: Annotated[list[_Real], Field(max_length=MAX_INPUTS, default_factory=list)]
    text_inputs: Annotated[list[_Answer], Field(max_length=MAX_INPUTS, default_factory=list)]
    option_inputs: Annotated[list[_Answer], Field(max_length=MAX_INPUTS, default_factory=list)]


class ExportRequest(ThesisRequest):
    """The calibration to copy, and the path of the copy."""

    calibration_name: Annotated[str, Field(max_length=1000)]
    target_path: Annotated[str, Field(max_length=1000)]


class LoadRequest(ThesisRequest):
    """The calibration to load."""

    calibration_name_or_path: Annotated[str, Field(max_length=1000)]


class RequestHeader(BaseModel):
    """The header of a request; ``stamp`` and ``time`` are the same, ISO text or seconds, UTC."""

    model_config: ClassVar[ConfigDict] = ConfigDict(extra="forbid", frozen=True, strict=True)

    seq: int = 0
    stamp: str | float = ""
    time: str | float = ""
    frame_id: _Text = ""

    @property
    def utc(self) -> float | None:
        """The time in seconds since 1970; None if the header has none.

        Raises:
            ConfigurationError: the stamp is no time.
        """
        moment = self.stamp or self.time
        try:
            if isinstance(moment, str):
                moment = datetime.fromisoformat(moment).timestamp() if moment else 0.0
            datetime.fromtimestamp(moment)  # noqa: DTZ006 - only whether there is such a time
        except (ValueError, OverflowError, OSError) as exc:
            raise ConfigurationError(
                f"header: stamp {moment!r:.60}: expected a time such as 2030-01-31T12:00:00+00:00, "
                "or seconds since 1970"
            ) from exc
        return moment or None


class TransformRequest(ThesisRequest):
    """The camera's view, and the frame for the robot's pose."""

    header: RequestHeader = RequestHeader()
    x: _Coordinate
    y: _Coordinate
    theta: _Real = 0.0
    tf_frame_reference: _Text = ""


class CalibrationFace(Protocol):
    """A camera as the five services see it.

    Attributes:
        name: the camera's name.
        calibrations: calibrations of the camera; None if no folder for them is set.
        camera: function that returns the camera, for one call of that number of seconds.
    """

    name: str

    @property
    def calibrations(self) -> ThesisCalibration | None: ...

    def camera(self, timeout: float) -> CalibrationCamera: ...


class CalibrationCall(NamedTuple):
    """A running call of a service.

    Attributes:
        face: the camera.
        request: the request, of the service's own class.
        timeout: seconds.
    """

    face: CalibrationFace
    request: Any
    timeout: float

    @property
    def calibrations(self) -> ThesisCalibration:
        """The calibrations of the camera.

        Raises:
            ConfigurationError: no folder for them is set.
        """
        calibrations = self.face.calibrations
        if calibrations is None:
            raise ConfigurationError(
                f"{self.face.name}: there is no folder for calibrations; expected "
                "calibrations: FOLDER in the fleet file of its agent, and to be asked there"
            )
        return calibrations


class WizardService(NamedTuple):
    """One of the five services.

    Attributes:
        request: class of its requests.
        do: function that carries the service out, and returns the fields of its answer.
        timeout: seconds, if the request gives none.
    """

    request: type[ThesisRequest]
    do: Callable[[CalibrationCall], Awaitable[dict[str, Any]]]
    timeout: float = DEFAULT_TIMEOUT


async def _start(call: CalibrationCall) -> dict[str, Any]:
    with from_part("calibration", "the calibration services need"):
        from smartcam.calibration._inside import CalibrationStart
    request = call.request
    await call.calibrations.start(
        CalibrationStart(*(getattr(request, name) for name in CalibrationStart._fields))
    )
    return {}


async def _perform(call: CalibrationCall) -> dict[str, Any]:
    with from_part("calibration", "the calibration services need"):
        from smartcam.calibration._inside import StepRequest
    request = call.request
    step_request = StepRequest(*(getattr(request, name) for name in StepRequest._fields))
    return await call.calibrations.perform(step_request, call.face.camera(call.timeout))


async def _export(call: CalibrationCall) -> dict[str, Any]:
    call.calibrations.export(call.request.calibration_name, call.request.target_path)
    return {}


async def _load(call: CalibrationCall) -> dict[str, Any]:
    call.calibrations.load(call.request.calibration_name_or_path)
    return {}


async def _transform(call: CalibrationCall) -> dict[str, Any]:
    with from_part("calibration", "the calibration services need"):
        from smartcam.calibration._inside import PixelPoseRequest
    request = call.request
    header = request.header
    seen = PixelPoseRequest(
        *(request.x, request.y, request.theta),
        *(header.frame_id, request.tf_frame_reference, header.seq, header.utc),
    )
    return {"pose": await call.calibrations.transform(seen)}


def own_localizations(reading: Interpretation | None, application: int | None) -> tuple[Any, str]:
    """Return the specification for reading a camera's localizations, and their unit.

    Args:
        reading: interpretation of the camera's results; None if their contents are not known.
        application: the active application; None if that is not known.
    """
    interpreter = None if reading is None else reading.interpreter(application)
    if interpreter is None or without_poses(interpreter) is not None:
        return "localizations", "m"
    return interpreter, "px" if in_pixels(interpreter) else "m"


def checked_localizations(value: object, camera: str) -> list[Localization]:
    """Return a value as a list of localizations.

    Raises:
        InterpretationError: the value is not valid.
    """
    localizations = localizations_of(value)
    if localizations is None:
        raise InterpretationError(
            f"{camera}: expected localizations, got {value!r:.80}", expected="localizations"
        )
    return localizations


CALIBRATION: Final[dict[str, WizardService]] = {
    "StartCalibration": WizardService(StartRequest, _start),
    "PerformCurrentAndGetNextStep": WizardService(PerformRequest, _perform, STEP_TIMEOUT),
    "ExportCalibration": WizardService(ExportRequest, _export),
    "LoadCalibration": WizardService(LoadRequest, _load),
    "TransformPixelPose": WizardService(TransformRequest, _transform),
}
"""The five services by name."""
