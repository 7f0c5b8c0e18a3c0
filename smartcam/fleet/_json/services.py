"""Define the JSON services for programs that do not use smartcam; see ``docs/bus.md``."""

from __future__ import annotations

import base64
import itertools
from datetime import UTC, datetime
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PlainValidator

from smartcam._client._inside import TriggerRequest
from smartcam._thesis import DEFAULT_TIMEOUT, MAX_TIMEOUT
from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT
from smartcam.exceptions import FrameFormatError, UnsupportedError
from smartcam.fleet._agent.calls import ACTIONS, MAX_REPLY_BYTES, ProgramCall, trigger_encoded
from smartcam.fleet._agent.client import AgentInterpretation
from smartcam.fleet._bus.keys import COMMANDS
from smartcam.fleet._bus.wire import decode_local_group
from smartcam.fleet._frames.stream import FrameCall
from smartcam.fleet._frames.wire import FrameForm, to_fields
from smartcam.fleet._program.reading import result_fields, split_group
from smartcam.models import Status

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from smartcam._client._inside import Interpretation
    from smartcam.calibration._inside import CalibrationsByCamera
    from smartcam.fleet._agent.client import Owner
    from smartcam.fleet._agent.shared_camera import SharedCamera
    from smartcam.fleet._bus.wire import ResultGroup
    from smartcam.fleet._json.topics import CameraTopics
    from smartcam.frames import Frame

MAX_RESULTS = 1000
"""Largest number of results in one answer."""

MAX_INPUT_BYTES = 1 << 16
MAX_PICTURE_BYTES = 1 << 20
"""Largest number of bytes of a frame in an answer."""

MAX_ID_LENGTH = 200


def _check_hex(text: str) -> str:
    try:
        bytes.fromhex(text)
    except ValueError as exc:
        raise ValueError("expected bytes as hex, such as 0aff") from exc
    return text


def _check_id(value: object) -> str | int:
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) < 10**MAX_ID_LENGTH:
        return value
    if isinstance(value, str) and 1 <= len(value.encode(errors="replace")) <= MAX_ID_LENGTH:
        return value
    raise ValueError(
        f"expected a text of 1 to {MAX_ID_LENGTH} bytes, or an integer of at most as many digits"
    )


def _check_time_text(text: str) -> str:
    try:
        datetime.fromisoformat(text)
    except ValueError as exc:
        raise ValueError("expected a time such as 2030-01-31T12:00:00") from exc
    return text


Hex = Annotated[str, Field(max_length=2 * MAX_INPUT_BYTES), AfterValidator(_check_hex)]
Number = Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
Text = Annotated[str, Field(max_length=200)]
Name = Annotated[str, Field(min_length=1, max_length=200)]
Id = Annotated[str | int, PlainValidator(_check_id)]
Deadline = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Interpret = Annotated[str, Field(max_length=10_000)]


class JsonRequest(BaseModel):
    """A request with the fields that every request may have."""

    model_config: ClassVar[ConfigDict] = ConfigDict(extra="forbid", frozen=True, strict=True)

    timeout: Annotated[float, Field(gt=0, le=MAX_TIMEOUT, allow_inf_nan=False)] | None = None
    id: Id | None = None
    program: Text = ""
    epoch: Text | None = None
    deadline: Deadline | None = None


class _JsonTrigger(JsonRequest):
    application: Number | None = None
    input: Hex | None = None
    results_per_trigger: Annotated[int, Field(ge=1, le=MAX_RESULTS)] | None = None
    when_busy: Literal["wait", "refuse"] = "wait"
    interpret_as: Interpret | None = None


class _JsonSwitch(JsonRequest):
    application: Number | Text


class _JsonInput(JsonRequest):
    input: Hex


class _JsonNumber(JsonRequest):
    number: Number


class _JsonClock(JsonRequest):
    when: Annotated[Text, AfterValidator(_check_time_text)]


class _JsonResults(JsonRequest):
    first: Annotated[int, Field(ge=1)] | None = None
    most: Annotated[int, Field(ge=1, le=MAX_RESULTS)] = 100


class _JsonFrame(JsonRequest):
    encoding: Literal["jpeg", "png", "jpegxl"] = "jpeg"
    quality: Annotated[int, Field(ge=1, le=100)] | None = None
    max_age: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1.0
    fresh: bool = False


class _JsonTriggerFrame(JsonRequest):
    encoding: Literal["jpeg", "png", "jpegxl"] = "jpeg"
    quality: Annotated[int, Field(ge=1, le=100)] | None = None
    when_busy: Literal["wait", "refuse"] = "wait"


class _JsonFeatures(JsonRequest):
    name: Name | None = None


class _JsonFeature(JsonRequest):
    name: Name


class _JsonSetFeature(JsonRequest):
    name: Name
    value: bool | int | Annotated[float, Field(allow_inf_nan=False)] | Interpret


class Work(NamedTuple):
    """A running service.

    Attributes:
        camera: the camera.
        topics: topics of the camera in JSON.
        request: request of the service's class.
        timeout: seconds of the service's timeout.
        owner: owner of the results of the service's trigger.
        calibrations: calibrations of the agent's cameras, by name; None without a folder for them.
    """

    camera: SharedCamera
    topics: CameraTopics
    request: Any
    timeout: float
    owner: Owner
    calibrations: CalibrationsByCamera | None = None


class Service(NamedTuple):
    """A service.

    Attributes:
        request: class of the requests.
        carry_out: function that carries out the service, and returns the fields of the answer
            without ``error``.
        is_command: whether it commands the camera, so that it waits while another program has
            reserved the camera.
        timeout: seconds of the timeout for a request without one.
        empty_fields: fields of an answer with an error, besides those of the error.
    """

    request: type[JsonRequest]
    carry_out: Callable[[Work], Awaitable[dict[str, Any]]]
    is_command: bool = True
    timeout: float = DEFAULT_TIMEOUT
    empty_fields: Mapping[str, Any] = MappingProxyType({})


async def trigger_camera(
    work: Work,
    interpretation: Interpretation | None,
    application: int | None,
    *,
    data: bytes | None = None,
    result_count: int = 1,
    wait: bool = True,
) -> list[ResultGroup]:
    """Trigger; return the trigger's containers, each as a group of one container.

    Raises:
        SmartCamError: like :meth:`smartcam.Camera.trigger`.
    """
    layouts = interpretation.numbered_layouts() if interpretation is not None else None
    request = TriggerRequest(AgentInterpretation(work.owner, layouts), data, result_count, wait)
    groups = await trigger_encoded(work.camera, work.owner, request, application, work.timeout)
    return [single for group in groups for single in split_group(decode_local_group(group))]


async def _trigger(work: Work) -> dict[str, Any]:
    request, topics = work.request, work.topics
    interpretation = topics.interpretation
    if request.interpret_as is not None:
        interpretation = topics.make_interpretation(request.interpret_as)
    groups = await trigger_camera(
        work,
        interpretation,
        request.application,
        data=None if request.input is None else bytes.fromhex(request.input),
        result_count=request.results_per_trigger or 1,
        wait=request.when_busy == "wait",
    )
    results = [result_fields(group, interpretation, work.camera.name) for group in groups]
    answer: dict[str, Any] = {"result": results[0]}
    if request.results_per_trigger is not None:
        answer = {"results": results}
    for result in results:
        if result["error"]:
            return {**answer, "error": result["error"], "kind": result["kind"]}
    return answer


async def _status(work: Work) -> dict[str, Any]:
    topics = work.topics
    return {**topics.state(), "number": topics.next_status - 1, "at": datetime.now(UTC).isoformat()}


def _service_of_call(action: str) -> Callable[[Work], Awaitable[dict[str, Any]]]:
    """Return the function of a service that does the same as a call of smartcam's own programs."""

    async def service(work: Work) -> dict[str, Any]:
        arguments: dict[str, Any] = work.request.model_dump(exclude=_COMMON_FIELDS)
        blobs = [bytes.fromhex(arguments.pop(name)) for name in ("input",) if name in arguments]
        call = ProgramCall(work.camera, "", work.owner, arguments, blobs, work.timeout, {})
        fields, attached = await ACTIONS[action](call)
        if "status" in fields:
            fields["status_names"] = Status(fields["status"]).names
        return {**fields, "image": base64.b64encode(attached[0]).decode()} if attached else fields

    return service


async def _results(work: Work) -> dict[str, Any]:
    log, max_count = work.camera.results, work.request.most
    first = work.request.first
    if first is None:
        first = max(1, log.next_number - max_count)
    part = log.read_part(first, MAX_REPLY_BYTES)
    groups = map(decode_local_group, part.data)
    each = (single for group in groups for single in split_group(group))
    matching = (single for single in each if single.number >= part.first)
    results = [work.topics.result(single) for single in itertools.islice(matching, max_count)]
    return {"first": part.first, "next_result": part.next_number, "results": results}


async def _frame(work: Work) -> dict[str, Any]:
    request, camera = work.request, work.camera
    encoding = FrameForm.checked(request.encoding, request.quality, camera.name)
    call = FrameCall("", work.owner.call, encoding, work.timeout)
    frame, encoding_time = await camera.frames.get_frame(
        call, max_age=request.max_age, after=None, fresh=request.fresh
    )
    return _frame_answer(camera, encoding, frame, encoding_time)


async def _trigger_frame(work: Work) -> dict[str, Any]:
    request, camera = work.request, work.camera
    encoding = FrameForm.checked(request.encoding, request.quality, camera.name)
    call = FrameCall("", work.owner.call, encoding, work.timeout)
    frame, encoding_time = await camera.frames.trigger_frame(call, wait=request.when_busy == "wait")
    return _frame_answer(camera, encoding, frame, encoding_time)


def _frame_answer(
    camera: SharedCamera, encoding: FrameForm, frame: Frame, encoding_time: float
) -> dict[str, Any]:
    """Return the fields of an answer that has a frame."""
    if len(frame.data) > MAX_PICTURE_BYTES:
        raise FrameFormatError(
            f"{camera.name}: the frame has {len(frame.data)} bytes as {encoding.name}, expected "
            f"{MAX_PICTURE_BYTES} at most",
            source=camera.name,
        )
    fields = to_fields(frame, 0.0, encoding_time, 0)
    public_fields = {
        name: value for name, value in fields.items() if name not in {"captured", "lens"}
    }
    if "trigger" in public_fields:  # its time is of the agent's clock
        trigger = public_fields["trigger"]
        public_fields["trigger"] = {name: trigger[name] for name in ("number", "evidence")}
    return {"frame": {**public_fields, "data": base64.b64encode(frame.data).decode()}}


async def _unknown(work: Work) -> dict[str, Any]:
    raise UnsupportedError(f"{work.camera.name}: there is no such service")


UNKNOWN = Service(JsonRequest, _unknown)
"""Service that stands for all services that do not exist."""

_COMMON_FIELDS = {*JsonRequest.model_fields}

_REQUESTS: dict[str, type[JsonRequest]] = {
    "switch_application": _JsonSwitch,
    "start": JsonRequest,
    "stop": JsonRequest,
    "reset_errors": JsonRequest,
    "set_input": _JsonInput,
    "set_sequence_number": _JsonNumber,
    "set_clock": _JsonClock,
    "reboot": JsonRequest,
    "take_back": JsonRequest,
    "query_status": JsonRequest,
    "query_application": JsonRequest,
    "wait_ready": JsonRequest,
    "get_clock": JsonRequest,
    "read_image": JsonRequest,
    "features": _JsonFeatures,
    "set_feature": _JsonSetFeature,
    "execute_feature": _JsonFeature,
}
"""Class of the requests, for each service that does the same as a call of smartcam's programs."""

SERVICES: dict[str, Service] = {
    "trigger": Service(_JsonTrigger, _trigger, timeout=DEFAULT_TRIGGER_TIMEOUT),
    "status": Service(JsonRequest, _status, is_command=False),
    "results": Service(_JsonResults, _results, is_command=False),
    "frame": Service(_JsonFrame, _frame, is_command=False),
    "trigger_frame": Service(_JsonTriggerFrame, _trigger_frame),
    **{
        action: Service(request, _service_of_call(action), action in COMMANDS)
        for action, request in _REQUESTS.items()
    },
}
"""The services in JSON by name."""
