"""The five calibration services of the thesis: their requests and actions.

Programs call them in JSON on a fleet's bus, in ROS 2 or in ROS 1, like the six services in
:mod:`smartcam._thesis`, which says what the thesis is. Each camera has one
:class:`~smartcam.calibration.wizards._thesis.ThesisCalibration` object, which does the work for all
three.
"""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal, NamedTuple, Protocol

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from smartcam._client._inside import has_pixel_positions, localizations_of, name_if_poseless
from smartcam._extras import from_part
from smartcam._thesis import DEFAULT_TIMEOUT, ThesisRequest
from smartcam.exceptions import ConfigurationError, InterpretationError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam._client._inside import Interpretation
    from smartcam.calibration._inside import CalibrationCamera, ThesisCalibration
    from smartcam.models import Localization

STEP_TIMEOUT: Final = 150.0
"""Seconds for a step if the request gives none: enough for a calculation, which may take 120 s, and
for a picture, which may take 60 s."""

MAX_INPUTS: Final = 100
"""Largest number of a request's values of one kind; a step asks for about a dozen."""

MAX_COORDINATE: Final = 1e9
"""Largest absolute coordinate of a pose to transform, in the calibration's unit."""

_Text = Annotated[str, Field(max_length=200)]
_Answer = Annotated[str, Field(max_length=2000)]
_Real = Annotated[float, Field(allow_inf_nan=False)]
_Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE, allow_inf_nan=False)]


def _capitalize(value: object) -> object:
    """Return a text such as "true" or " TRUE " as "True"; any other value unchanged."""
    return value.strip().capitalize() if isinstance(value, str) else value


class StartRequest(ThesisRequest):
    """The sources of pictures and poses, and whether the camera is fixed or on the robot."""

    topic_image1: _Text = ""
    topic_image2: _Text = ""
    checkerboard_squaresize_m: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 0.0
    tf_frame_robot_tcp: _Text = ""
    tf_frame_robot_base: _Text = ""
    fixed_camera: Annotated[Literal["True", "False", ""], BeforeValidator(_capitalize)] = ""


class PerformRequest(ThesisRequest):
    """The user's answers to a step, or what to do instead: repeat the last step, or abort."""

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
    """The header of a request. Its time is in ``stamp`` or ``time``: ISO text, or seconds, UTC."""

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
    """A pose in the camera's picture to transform, and the frame in which the answer is wanted."""

    header: RequestHeader = RequestHeader()
    x: _Coordinate
    y: _Coordinate
    theta: _Real = 0.0
    tf_frame_reference: _Text = ""


class CalibrationOwner(Protocol):
    """The owner of the camera that the five services calibrate.

    Attributes:
        name: the camera's name.
        thesis_calibration: object that calibrates the camera; None if no folder for it is set.
        camera: function that returns the camera for one call, which takes at most ``timeout``
            seconds.
    """

    name: str

    @property
    def thesis_calibration(self) -> ThesisCalibration | None: ...

    def camera(self, timeout: float) -> CalibrationCamera: ...


class CalibrationCall(NamedTuple):
    """A running call of a service.

    Attributes:
        owner: the owner of the camera.
        request: the request, an object of the service's request class.
        timeout: longest duration of the call, seconds.
    """

    owner: CalibrationOwner
    request: Any
    timeout: float

    @property
    def thesis_calibration(self) -> ThesisCalibration:
        """The object that calibrates the camera.

        Raises:
            ConfigurationError: no folder for it is set.
        """
        thesis_calibration = self.owner.thesis_calibration
        if thesis_calibration is None:
            raise ConfigurationError(
                f"{self.owner.name}: there is no folder for calibrations; expected "
                "calibrations: FOLDER in the fleet file of its agent, and a request to that agent"
            )
        return thesis_calibration


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
    await call.thesis_calibration.start(
        CalibrationStart(*(getattr(request, name) for name in CalibrationStart._fields))
    )
    return {}


async def _perform(call: CalibrationCall) -> dict[str, Any]:
    with from_part("calibration", "the calibration services need"):
        from smartcam.calibration._inside import StepRequest
    request = call.request
    step_request = StepRequest(*(getattr(request, name) for name in StepRequest._fields))
    return await call.thesis_calibration.perform(step_request, call.owner.camera(call.timeout))


async def _export(call: CalibrationCall) -> dict[str, Any]:
    call.thesis_calibration.export(call.request.calibration_name, call.request.target_path)
    return {}


async def _load(call: CalibrationCall) -> dict[str, Any]:
    call.thesis_calibration.load(call.request.calibration_name_or_path)
    return {}


async def _transform(call: CalibrationCall) -> dict[str, Any]:
    with from_part("calibration", "the calibration services need"):
        from smartcam.calibration._inside import PixelPoseRequest
    request = call.request
    header = request.header
    pixel_pose = PixelPoseRequest(
        *(request.x, request.y, request.theta),
        *(header.frame_id, request.tf_frame_reference, header.seq, header.utc),
    )
    return {"pose": await call.thesis_calibration.transform(pixel_pose)}


def localization_spec(
    interpretation: Interpretation | None, application: int | None
) -> tuple[Any, str]:
    """Return the specification for localizations in the camera's own frame, and their unit.

    Args:
        interpretation: interpretation of the camera's results; None if no layout of results is
            known.
        application: the active application; None if that is not known.
    """
    interpreter = None if interpretation is None else interpretation.interpreter(application)
    if interpreter is None or name_if_poseless(interpreter) is not None:
        return "localizations", "m"
    return interpreter, "px" if has_pixel_positions(interpreter) else "m"


def checked_localizations(value: object, camera: str) -> list[Localization]:
    """Return the localizations of a value.

    Raises:
        InterpretationError: the value is not a list of localizations.
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
