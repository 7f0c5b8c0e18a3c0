"""The six camera services of the thesis with which smartcam began: their requests and actions.

The names of services and fields are those of the thesis, which existing programs use. Programs
call the services in JSON on a fleet's bus, at a node of ROS 2, or at a node of ROS 1. Each of these
converts its messages to requests and the answers to its messages, and gives the services the camera
as a :class:`ThesisCamera`. A field that is 0 or an empty text counts as missing, since a field of a
ROS message cannot be left out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, NamedTuple, Protocol

from pydantic import BaseModel, ConfigDict, Field

from smartcam._client._inside import has_pixel_positions, localizations_of, name_if_poseless
from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT
from smartcam.exceptions import ConfigurationError, InterpretationError, LocalProtocolError
from smartcam.settings import FLEET_SCHEMES, parse_address

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam._client._inside import Interpretation
    from smartcam.settings import Address

DEFAULT_TIMEOUT: Final = 10.0
"""Seconds for a service that does not trigger, if the request gives no timeout."""

MAX_TIMEOUT: Final = 600.0
"""Largest timeout that a request may give, in seconds."""

MAX_DELAY: Final = 3600.0
"""Longest delay between two published results, in seconds."""

MAX_QUEUED_RESULTS: Final = 10_000
DEFAULT_QUEUED_RESULTS: Final = 100
"""Largest number of results that wait for a delay to pass, if the request gives no number."""

_KEYWORDS: Final = {"localizations": "localizations", "50bytestrings": "strings50"}

_Text = Annotated[str, Field(max_length=200)]
_Application = Annotated[int, Field(ge=0, le=0xFFFFFFFF)]


def spec_of_text(text: str) -> str | None:
    """Return the interpretation's specification for a text of a request; None for an empty text."""
    spec = text.strip()
    return _KEYWORDS.get(spec.lower(), spec) or None


class ThesisRequest(BaseModel):
    """The fields that every request may have; SmartcameraStop has no others."""

    model_config: ClassVar[ConfigDict] = ConfigDict(extra="forbid", frozen=True, strict=True)

    camera_name: _Text = ""
    timeout: Annotated[float, Field(ge=0, le=MAX_TIMEOUT, allow_inf_nan=False)] | None = None


class SetupRequest(ThesisRequest):
    """A request that names a camera by its address, its application and its interpretation."""

    camera_model_name: _Text = ""
    port: Annotated[int, Field(ge=0, le=0xFFFF)] | _Text = 0
    con_address: _Text = ""
    application_id: _Application = 0
    interpret_as: Annotated[str, Field(max_length=10_000)] = ""
    topic_status: _Text = ""

    def address(self) -> Address:
        """Return the camera's address.

        Raises:
            ConfigurationError: no camera can have this address.
        """
        text = self.con_address
        if "://" not in text:
            text = f"[{text}]" if text.count(":") > 1 and "[" not in text else text
            if self.port not in {0, "", "0"} and ":" not in text.rpartition("]")[2]:
                text = f"{text}:{self.port}"
        return parse_address(text, model=self.camera_model_name or None)


class PublishingRequest(ThesisRequest):
    """A request that names the topic for results, and the least time between two results."""

    topic_for_outputs: _Text = ""
    min_delay: Annotated[float, Field(ge=0, le=MAX_DELAY, allow_inf_nan=False)] = 0.0
    queue_size: Annotated[int, Field(ge=0, le=MAX_QUEUED_RESULTS)] = 0


class ApplicationRequest(ThesisRequest):
    """A request that names the application to load."""

    application_id: Annotated[int, Field(ge=1, le=0xFFFFFFFF)]


class ThesisTriggerRequest(ThesisRequest):
    """A request that names the application for this trigger only; 0 is the active application."""

    application_id: _Application = 0


class ThesisCamera(Protocol):
    """The camera that the six services work on, with the publisher of its results and status.

    Attributes:
        name: the camera's name.
        address: address of the camera itself.
        application: the id of the active application; None if that is not known.
        interpretation: interpretation of its results; None if no layout of results is known.
        stopped: whether SmartcameraStop has closed the camera for these services.
    """

    @property
    def stopped(self) -> bool: ...

    @stopped.setter
    def stopped(self, stopped: bool) -> None: ...

    @property
    def name(self) -> str: ...

    @property
    def address(self) -> Address: ...

    @property
    def application(self) -> int | None: ...

    @property
    def interpretation(self) -> Interpretation | None: ...

    def check_interpretation(self, spec: str) -> None:
        """Raise ConfigurationError if results cannot be interpreted by ``spec``."""

    def interpret_as(self, spec: str | None) -> None:
        """Interpret results by ``spec`` from now on; None: by the settings."""

    def is_calibrated(self, application: int) -> bool:
        """Return True if a calibration transforms an application's localizations."""
        ...

    def check_status_topic(self, topic: str) -> None:
        """Raise ConfigurationError if a topic cannot have this name."""

    def publish_status(self, topic: str) -> dict[str, Any]:
        """Publish the status on this topic, and no longer on the topic of an earlier call."""
        ...

    async def publish_results(self, topic: str, min_delay: float, queue: int) -> dict[str, Any]:
        """Publish results on this topic, and no longer on the topic of an earlier call."""
        ...

    async def end_publishing(self) -> None:
        """Publish nothing more on the topics that requests have named."""

    async def require_session(self) -> None:
        """Raise an error with the reason if there is no session with the camera."""

    async def ensure(self, application: int, timeout: float) -> None:
        """Switch to an application if it is not running and ready already."""

    async def switch(self, application: int, timeout: float) -> None:
        """Load an application."""

    async def trigger(self, application: int | None, spec: Any, timeout: float) -> tuple[int, Any]:
        """Trigger; return the result's application, and its value, interpreted by ``spec``."""
        ...


class ThesisCall(NamedTuple):
    """A running call of a service.

    Attributes:
        camera: the camera.
        request: the request, an object of the service's request class.
        timeout: longest duration of the call, seconds.
    """

    camera: ThesisCamera
    request: Any
    timeout: float


class ThesisService(NamedTuple):
    """One of the six services.

    Attributes:
        request: class of its requests.
        do: function that carries the service out, and returns the answer's fields except ``error``.
        timeout: seconds, if the request gives none.
        changes_publishing: True for a service that changes publishing; these run one at a time.
        after_stop: True if the service works after SmartcameraStop, before the next
            SmartcameraSetup.
        empty_field: name of the answer's field that is an empty list after an error; None if the
            answer has no such field.
    """

    request: type[ThesisRequest]
    do: Callable[[ThesisCall], Awaitable[dict[str, Any]]]
    timeout: float = DEFAULT_TIMEOUT
    changes_publishing: bool = False
    after_stop: bool = False
    empty_field: str | None = None

    async def answer(self, call: ThesisCall) -> dict[str, Any]:
        """Carry the service out; return the answer's fields except ``error``.

        Raises:
            LocalProtocolError: the camera was stopped.
            SmartCamError: the service failed.
        """
        if call.camera.stopped and not self.after_stop:
            raise LocalProtocolError(
                f"{call.camera.name}: SmartcameraStop has closed it: expected "
                "SmartcameraSetup first"
            )
        return await self.do(call)


async def _setup(call: ThesisCall) -> dict[str, Any]:
    """Set up the camera, after checking that the request is for this camera."""
    camera, request = call.camera, call.request
    _check_same_camera(camera, request)
    spec = spec_of_text(request.interpret_as)
    if spec is not None:
        camera.check_interpretation(spec)
    camera.check_status_topic(request.topic_status)
    await camera.require_session()
    if request.application_id:
        await camera.ensure(request.application_id, call.timeout)
    if spec is not None:
        camera.interpret_as(spec)
    camera.stopped = False
    return camera.publish_status(request.topic_status)


def _check_same_camera(camera: ThesisCamera, request: SetupRequest) -> None:
    """Check that a request is for this camera.

    Raises:
        ConfigurationError: the request is for another camera.
    """
    name, actual, model = camera.name, camera.address, request.camera_model_name
    cure = "; Stop it first, or choose another camera_name"
    if not (model or request.con_address):
        return
    if actual.scheme in FLEET_SCHEMES:
        raise ConfigurationError(
            f"{name}: the fleet knows its address: expected con_address and "
            "camera_model_name to be empty"
        )
    if model and (protocol := parse_address(actual.host, model=model).protocol) != actual.protocol:
        raise ConfigurationError(
            f"{name}: Setup says it is a {model}, which speaks {protocol}, but it speaks "
            f"{actual.protocol}{cure}"
        )
    if request.con_address:
        asked = request.address()
        if (asked.host, asked.port, asked.protocol) != (actual.host, actual.port, actual.protocol):
            raise ConfigurationError(
                f"{name}: Setup says it is at {asked.url}, but it is at {actual.url}{cure}"
            )


async def _enable_publishing(call: ThesisCall) -> dict[str, Any]:
    request: PublishingRequest = call.request
    queue = request.queue_size or DEFAULT_QUEUED_RESULTS
    return await call.camera.publish_results(request.topic_for_outputs, request.min_delay, queue)


async def _stop(call: ThesisCall) -> dict[str, Any]:
    await call.camera.end_publishing()
    call.camera.interpret_as(None)
    call.camera.stopped = True
    return {}


async def _change_application(call: ThesisCall) -> dict[str, Any]:
    await call.camera.switch(call.request.application_id, call.timeout)
    return {}


async def _trigger_strings(call: ThesisCall) -> dict[str, Any]:
    application = call.request.application_id or None
    _, strings = await call.camera.trigger(application, "strings50", call.timeout)
    return {"strings": strings}


async def _trigger_localizations(call: ThesisCall) -> dict[str, Any]:
    camera, requested = call.camera, call.request.application_id or None
    spec = _spec_of_localizations(camera, requested)
    application, value = await camera.trigger(requested, spec, call.timeout)
    localizations = localizations_of(value)
    interpreter = _interpreter_of(spec, application)
    are_pixels = has_pixel_positions(interpreter) and not camera.is_calibrated(application)
    if localizations is None or are_pixels:
        raise InterpretationError(
            f"{camera.name}: expected localizations in metres, got {value!r:.80}; "
            "camera.trigger() returns the values that the layout describes",
            expected="localizations",
        )
    return {"localizations": localizations}


def _spec_of_localizations(camera: ThesisCamera, application: int | None) -> Any:
    """Return the specification for localizations: the camera's own, or the thesis' fields."""
    interpretation = camera.interpretation
    if interpretation is None:
        return "localizations"
    if not interpretation.by_application:
        return _with_poses(interpretation, None)
    ids = {*interpretation.applications, application, camera.application} - {None}
    return {id_: _with_poses(interpretation, id_) for id_ in ids}


def _with_poses(interpretation: Interpretation, application: int | None) -> Any:
    """Return an application's own interpreter if it makes localizations, else "localizations"."""
    own = interpretation.interpreter(application)
    has_poses = own is not None and name_if_poseless(own) is None
    return own if has_poses else "localizations"


def _interpreter_of(spec: Any, application: int) -> Any:
    """Return the interpreter of an application; None if the fields of the thesis are read."""
    own_spec = spec.get(application) if isinstance(spec, dict) else spec
    return None if isinstance(own_spec, str) else own_spec


THESIS: Final[dict[str, ThesisService]] = {
    "SmartcameraSetup": ThesisService(
        SetupRequest, _setup, changes_publishing=True, after_stop=True
    ),
    "EnablePublishing": ThesisService(
        PublishingRequest, _enable_publishing, changes_publishing=True
    ),
    "SmartcameraStop": ThesisService(
        ThesisRequest, _stop, changes_publishing=True, after_stop=True
    ),
    "ChangeApplication": ThesisService(ApplicationRequest, _change_application),
    "Trigger50ByteString": ThesisService(
        ThesisTriggerRequest, _trigger_strings, DEFAULT_TRIGGER_TIMEOUT, empty_field="strings"
    ),
    "TriggerLocalization": ThesisService(
        ThesisTriggerRequest,
        _trigger_localizations,
        DEFAULT_TRIGGER_TIMEOUT,
        empty_field="localizations",
    ),
}
"""The six services by name."""
