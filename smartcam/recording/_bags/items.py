"""Make a bag's messages from a client's or a recording's items."""

from __future__ import annotations

import contextlib
from collections import deque
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._ros_names import as_name
from smartcam.exceptions import SmartCamError
from smartcam.models import (
    ApplicationChanged,
    CameraEvent,
    Connected,
    Disconnected,
    Header,
    Localization,
    Pose,
    PoseSigma,
    Position,
    Quaternion,
    Reconnected,
    Result,
    StatusChanged,
)
from smartcam.observers import TraceEntry
from smartcam.recording._bags.specs import RecordedInterpreters
from smartcam.recording._bags.writer import Topic
from smartcam.recording._mcap.form import RecordedError, nanoseconds
from smartcam.ros2._inside import (
    DEFAULT,
    DETECTIONS,
    DIAGNOSTICS,
    DRIVER,
    LATCHED,
    OK,
    POSES,
    RESULT,
    STATUS_TYPE,
    WARN,
    KnownState,
    ResultMessages,
    diagnostic_fields,
    hardware_id,
    header_fields,
    health,
    status_fields,
    utf8,
)
from smartcam.settings import parse_address

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from smartcam.ros2 import RosTypes

_DIAGNOSTICS = Topic("/diagnostics", DIAGNOSTICS, DEFAULT)

_MAX_CONTAINERS = 64
"""Largest number of containers kept until their results come; many containers may come at once."""

NOT_INTERPRETED = frozenset({"InterpretationError", "WrongApplicationError"})
"""Errors of containers that could not be interpreted."""


class BagCounts(NamedTuple):
    """Counts of the messages of a bag.

    Attributes:
        messages: all messages.
        results: results, each on the topic ``results``, also results that could not be interpreted.
        uninterpreted: results that could not be interpreted; their messages have the error.
        localizations: results that are localizations; each is also on two more topics.
        errors: other errors, on ``/diagnostics``.
    """

    messages: int = 0
    results: int = 0
    uninterpreted: int = 0
    localizations: int = 0
    errors: int = 0


class BagMessage(NamedTuple):
    """A message for a bag: topic, time (nanoseconds since 1970, UTC), and the message or fields."""

    topic: Topic
    at: int
    message: Any


class BagResult(NamedTuple):
    """A result as it is written to the bag.

    ``error`` says why the result could not be interpreted, or is "". ``was_reinterpreted`` is True
    if the result was interpreted again, so that a recorded error does not count.
    """

    result: Result
    error: str = ""
    was_reinterpreted: bool = False


@dataclass(eq=False)
class BagItems:
    """Makes messages of items, in order, and keeps the state of each camera.

    Args:
        types: types of the messages.
        interpret: function that each result goes through; default: results stay as they are.
    """

    _types: RosTypes
    _interpret: Callable[[Result], BagResult] = BagResult
    _cameras: dict[str, _BagCamera] = field(init=False, default_factory=dict[str, "_BagCamera"])

    def __post_init__(self) -> None:
        self.counts: BagCounts = BagCounts()
        self._titles: set[str] = set()

    def describe(self, metadata: Mapping[str, Any]) -> None:
        """Keep metadata of a camera, as from ``Recorder.describe``."""
        if {"interpret_as", "pixels"} & metadata.keys():
            camera = self._camera_of(metadata["camera"])
            camera.metadata.update(metadata)
            pixels = camera.metadata.get("pixels") == "True"
            spec = camera.metadata.get("interpret_as", "")
            camera.interpreters = RecordedInterpreters(spec, pixels=pixels)

    def messages(self, item: object) -> Iterator[BagMessage]:
        """Yield the messages of an item; none for a frame, since ROS has no message for it."""
        for message in self._messages(item):
            self._count(messages=1)
            yield message

    def _messages(self, item: object) -> Iterator[BagMessage]:
        match item:
            case Result():
                camera = self._camera_of(item.camera)
                camera.remove_container(item.raw)
                yield from self._result(camera, *self._interpret(item)[:2])
            case TraceEntry():
                self._camera_of(item.camera).keep_container(item)
            case RecordedError():
                yield from self._error(self._camera_of(item.camera), item)
            case CameraEvent():
                camera = self._camera_of(item.camera)
                camera.update_state(item)
                yield from camera.state_messages(item.at)
            case _:
                pass

    def _camera_of(self, name: str) -> _BagCamera:
        camera = self._cameras.get(name)
        if camera is None:
            base = title = topic_of_camera(name)
            number = 2
            while title in self._titles:
                title, number = f"{base}_{number}", number + 1
            self._titles.add(title)
            camera = self._cameras[name] = _BagCamera(
                name, title, ResultMessages(self._types, name, name)
            )
        return camera

    def _result(self, camera: _BagCamera, result: Result, error: str) -> Iterator[BagMessage]:
        at, messages = nanoseconds(result.received_at), camera.result_messages
        if result.application < 0:  # the result's application is unknown
            result = result._replace(application=0)
        found = None if error else camera.interpreters.localizations(result)
        frames = {item.pose.header.frame_id for item in found or ()}
        self._count(results=1, uninterpreted=bool(error), localizations=found is not None)
        if error:
            message = messages.result(result._replace(value=result.raw), None)
            message.error = utf8(error)
        else:
            message = messages.result(result, found)
        yield BagMessage(camera.results, at, message)
        if len(frames) > 1:  # a PoseArray has only one frame
            text = f"result {result.number}: poses in several frames: {', '.join(sorted(frames))}"
            yield camera.warning_message(result.received_at, text)
        elif found is not None:
            yield BagMessage(camera.localizations, at, messages.poses(result, found))
            yield BagMessage(camera.detections, at, messages.detections(result, found))

    def _error(self, camera: _BagCamera, item: RecordedError) -> Iterator[BagMessage]:
        text = f"{item.error}: {item.text}"
        if item.error not in NOT_INTERPRETED:
            self._count(errors=1)
            yield camera.warning_message(item.at, text, triggered_at=item.triggered_at)
            return
        application, raw, at = camera.take_uninterpreted() or (0, b"", item.at)
        result = Result(item.camera, application, None, 0, item.triggered_at, at, None, raw, None)
        interpreted = self._interpret(result) if raw else BagResult(result)
        error = interpreted.error if interpreted.was_reinterpreted else text
        yield from self._result(camera, interpreted.result, error)

    def _count(self, **increments: int) -> None:
        totals = {name: getattr(self.counts, name) + by for name, by in increments.items()}
        self.counts = self.counts._replace(**totals)


@dataclass(eq=False)
class _BagCamera:
    """One camera: its topics, its last known state, and containers whose results have not come."""

    name: str
    title: str  # name in topics
    result_messages: ResultMessages
    url: str = ""
    state: KnownState = field(init=False)  # state, as far as it was recorded
    metadata: dict[str, Any] = field(default_factory=dict[str, Any])  # as recorded
    interpreters: RecordedInterpreters = field(default_factory=RecordedInterpreters)

    def __post_init__(self) -> None:
        self.state = KnownState(self.name)
        self.results = Topic(f"/{self.title}/results", RESULT, DRIVER)
        self.localizations = Topic(f"/{self.title}/localizations", POSES, DRIVER)
        self.detections = Topic(f"/{self.title}/detections", DETECTIONS, DRIVER)
        self._status = Topic(f"/{self.title}/status", STATUS_TYPE, LATCHED)
        self._last_health: object = None  # contents of the last diagnostics
        self._containers: deque[tuple[int, bytes, datetime]] = deque(maxlen=_MAX_CONTAINERS)

    def update_state(self, event: CameraEvent) -> None:
        """Keep the state that an event reports."""
        match event:
            case Connected() | Reconnected():
                self.url = event.url
                self.state = self.state._replace(connected=True, failure="")
            case Disconnected():
                self.state = self.state._replace(connected=False, status=None, failure=event.reason)
            case StatusChanged():
                self.state = self.state._replace(status=event.status)
            case ApplicationChanged():
                self.state = self.state._replace(application=event.application)
            case _:
                pass

    def state_messages(self, at: datetime) -> Iterator[BagMessage]:
        """Yield the messages of the state for its topic and, if they changed, the diagnostics."""
        state = self.state
        # no reason: there was no session yet, which is no error
        condition = health(state, session_alive=bool(state.failure))
        fields = {"header": header_fields(at, self.name), **status_fields(state)}
        yield BagMessage(self._status, nanoseconds(at), fields)
        health_contents = (
            condition.level,
            "" if condition.level == OK else condition.text,
            state.application,
        )
        if health_contents != self._last_health:
            self._last_health = health_contents
            application = [] if state.application is None else [("application", state.application)]
            yield self._diagnostics(at, condition.level, condition.text, application)

    def warning_message(self, at: datetime, text: str, **values: object) -> BagMessage:
        """Return a message of the diagnostics about a single error."""
        pairs = [(key, value) for key, value in values.items() if value is not None]
        return self._diagnostics(at, WARN, text, pairs)

    def _diagnostics(
        self, at: datetime, level: int, text: str, values: list[tuple[str, Any]]
    ) -> BagMessage:
        status = diagnostic_fields(self.title, _hardware(self.url), level, text, values)
        fields = {"header": header_fields(at, self.name), "status": [status]}
        return BagMessage(_DIAGNOSTICS, nanoseconds(at), fields)

    # ------------------------------------------------------------------ containers

    def keep_container(self, entry: TraceEntry) -> None:
        """Keep a container until its result or error comes."""
        if entry.direction == "<" and entry.message == "ResultContainer" and entry.fields:
            data, application = entry.fields.get("data"), entry.fields.get("application", -1)
            if isinstance(data, str) and isinstance(application, int):
                with contextlib.suppress(ValueError):
                    self._containers.append((application, bytes.fromhex(data), entry.at))

    def remove_container(self, raw: bytes) -> None:
        """Remove a container that was interpreted, and earlier ones."""
        for index, (_, data, _) in enumerate(self._containers):
            if data == raw:
                for _ in range(index + 1):
                    self._containers.popleft()
                return

    def take_uninterpreted(self) -> tuple[int, bytes, datetime] | None:
        """Remove all containers; return application, bytes and time of the one an error is about.

        If several containers wait, it is not known which one: None.
        """
        container = self._containers.pop() if len(self._containers) == 1 else None
        self._containers.clear()
        return container


def _hardware(url: str) -> str:
    """Return a camera's hardware id; the URL itself if this version cannot parse it."""
    try:
        return hardware_id(parse_address(url)) if url else ""
    except SmartCamError:
        return url


def topic_of_camera(name: str) -> str:
    """Return a camera's name in topics, which is also its node's name."""
    return "/".join(part for part in as_name(name).split("/") if part) or "camera"


def localizations_from_json(value: object) -> list[Localization] | None:
    """Return the localizations of recorded JSON; None if it has other values."""
    if not isinstance(value, list):
        return None
    items: list[Any] = value
    try:
        return [_localization(item) for item in items]
    except (KeyError, TypeError, ValueError, OverflowError):
        return None


def _localization(fields: Mapping[str, Any]) -> Localization:
    """Return a localization from JSON; raise if it is not valid."""
    if set(fields) != set(Localization._fields):
        raise ValueError("these are not the fields of a localization")
    pose, feature, photo = fields["pose"], fields["feature_id"], fields["photo_index"]
    header = pose["header"]
    if not (isinstance(feature, str) and isinstance(header["frame_id"], str)):
        raise TypeError("no text")
    if type(photo) is not int:
        raise TypeError("no index")
    localized_pose = Pose(
        Header(header["seq"], datetime.fromisoformat(header["stamp"]), header["frame_id"]),
        Position(*(_number(pose["position"][name]) for name in "xyz")),
        Quaternion(*(_number(pose["orientation"][name]) for name in "xyzw")),
    )
    if "sigma" in pose:
        sigma = {name: pose["sigma"][name] for name in PoseSigma._fields}
        errors: dict[str, Any] = {
            name: None if value is None else _number(value) for name, value in sigma.items()
        }
        localized_pose = localized_pose.with_sigma(PoseSigma(**errors))
    return Localization(feature, _number(fields["quality"]), photo, localized_pose)


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError("no number")
    return float(value)
