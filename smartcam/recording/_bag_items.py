"""What goes into a bag of each thing that a client saw, or that a recording holds."""

from __future__ import annotations

import contextlib
from collections import deque
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.models import (
    ApplicationChanged,
    CameraEvent,
    Connected,
    Disconnected,
    Header,
    Localization,
    Pose,
    Position,
    Quaternion,
    Reconnected,
    Result,
    Status,
    StatusChanged,
)
from smartcam.observers import TraceEntry
from smartcam.recording._bag import Topic
from smartcam.recording._bag_messages import (
    DETECTIONS,
    DIAGNOSTICS,
    ERROR,
    OK,
    POSE_ARRAY,
    RESULT,
    STALE,
    STATUS,
    WARN,
    detections,
    diagnostics,
    localizations,
    parts_of,
    result_fields,
    ros_name,
    status_fields,
)
from smartcam.recording._form import RecordedError, nanoseconds

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

_DIAGNOSTICS = Topic("/diagnostics", DIAGNOSTICS)

_CONTAINERS = 64
"""Containers that are kept until what became of them is told: many came in one burst."""

UNREADABLE = frozenset({"InterpretationError", "WrongApplicationError"})
"""Errors that say why a container could not be read."""

_FAULTS = Status.OVERHEAT | Status.SYSTEM_ERROR


class BagCounts(NamedTuple):
    """What a bag holds.

    Attributes:
        messages: all of them.
        results: results, each on the topic ``results``; those that could not be read, too.
        unread: of these, the ones that could not be read; ``/diagnostics`` says why.
        localizations: of these, the ones that are localizations, which two more topics have.
        errors: other errors, on ``/diagnostics``.
    """

    messages: int = 0
    results: int = 0
    unread: int = 0
    localizations: int = 0
    errors: int = 0


class BagMessage(NamedTuple):
    """A message for a bag: where, when (nanoseconds since 1970, UTC), and its fields."""

    topic: Topic
    at: int
    fields: Mapping[str, Any]


class ReadResult(NamedTuple):
    """A result as it goes into the bag; ``error``: why it could not be read, else "".

    ``again``: it was read anew, so that an earlier error says nothing any more.
    """

    result: Result
    error: str = ""
    again: bool = False


@dataclass(eq=False)
class BagItems:
    """Makes messages of items, in order; knows the state of each camera.

    Args:
        read: what each result goes through; default as it is.
    """

    _read: Callable[[Result], ReadResult] = ReadResult
    _cameras: dict[str, _BagCamera] = field(init=False, default_factory=dict[str, "_BagCamera"])

    def __post_init__(self) -> None:
        self.counts: BagCounts = BagCounts()
        self._titles: set[str] = set()

    def describe(self, facts: Mapping[str, str]) -> None:
        """Take facts about a camera, as a recorder is told them."""
        camera = self._of(facts["camera"])
        camera.spec = facts.get("interpret_as", camera.spec)

    def messages(self, item: object) -> Iterator[BagMessage]:
        """Yield what an item comes to; nothing of frames, which ROS has no message for."""
        for message in self._messages(item):
            self._count(messages=1)
            yield message

    def _messages(self, item: object) -> Iterator[BagMessage]:
        match item:
            case Result():
                camera = self._of(item.camera)
                camera.settle(item.raw)
                yield from self._result(camera, *self._read(item)[:2])
            case TraceEntry():
                self._of(item.camera).see_frame(item)
            case RecordedError():
                yield from self._error(self._of(item.camera), item)
            case CameraEvent():
                camera = self._of(item.camera)
                camera.see_event(item)
                yield from camera.state(item.at)
            case _:
                pass

    def _of(self, name: str) -> _BagCamera:
        known = self._cameras.get(name)
        if known is None:
            base = title = ros_name(name)
            number = 2
            while title in self._titles:
                title, number = f"{base}_{number}", number + 1
            self._titles.add(title)
            known = self._cameras[name] = _BagCamera(name, title)
        return known

    def _result(self, camera: _BagCamera, result: Result, error: str) -> Iterator[BagMessage]:
        at, stamp = nanoseconds(result.received_at), result.received_at
        parts = None if error else camera.parts(result)
        self._count(results=1, unread=bool(error), localizations=parts is not None)
        how = "" if error else camera.interpreter(result)
        yield BagMessage(camera.results, at, result_fields(result, camera.name, stamp, how))
        if error:  # its message has no field for that
            facts = {"application_id": result.application, "result_id": result.number}
            yield camera.warning(stamp, error, **facts)
        if parts is not None:
            frame = parts[0].pose.header.frame_id if parts else camera.name
            yield BagMessage(camera.localizations, at, localizations(parts, frame, stamp))
            yield BagMessage(camera.detections, at, detections(parts, frame, stamp))

    def _error(self, camera: _BagCamera, item: RecordedError) -> Iterator[BagMessage]:
        text = f"{item.error}: {item.text}"
        if item.error not in UNREADABLE:
            self._count(errors=1)
            yield camera.warning(item.at, text, triggered_at=item.triggered_at)
            return
        application, raw, at = camera.unread() or (-1, b"", item.at)
        result = Result(item.camera, application, None, 0, item.triggered_at, at, None, raw, None)
        found = self._read(result) if raw else ReadResult(result)
        yield from self._result(camera, found.result, found.error if found.again else text)

    def _count(self, **more: int) -> None:
        now = {name: getattr(self.counts, name) + more[name] for name in more}
        self.counts = self.counts._replace(**now)


@dataclass(eq=False)
class _BagCamera:
    """One camera: its topics, its state as far as it was told, and containers on their way."""

    name: str
    title: str  # for topics
    url: str = ""
    connected: bool = False
    status: Status | None = None
    application: int | None = None
    why: str = ""  # it is not connected
    spec: str = ""  # how its results are read, as far as is known

    def __post_init__(self) -> None:
        self.results = Topic(f"/{self.title}/results", RESULT)
        self.localizations = Topic(f"/{self.title}/localizations", POSE_ARRAY)
        self.detections = Topic(f"/{self.title}/detections", DETECTIONS)
        self._status = Topic(f"/{self.title}/status", STATUS, latched=True)
        self._told: object = None  # of the last diagnostics
        self._locating: set[int] = set()  # applications whose results are localizations
        self._containers: deque[tuple[int, bytes, datetime]] = deque(maxlen=_CONTAINERS)

    def see_event(self, event: CameraEvent) -> None:
        """Keep what an event tells."""
        match event:
            case Connected() | Reconnected():
                self.connected, self.url, self.why = True, event.url, ""
            case Disconnected():
                self.connected, self.status = False, None
                self.why = event.reason
            case StatusChanged():
                self.status = event.status
            case ApplicationChanged():
                self.application = event.application
            case _:
                pass

    def state(self, at: datetime) -> Iterator[BagMessage]:
        """Yield the state for its topic, and for the diagnostics what is new to them."""
        when = nanoseconds(at)
        yield BagMessage(
            self._status,
            when,
            status_fields(
                self.name,
                at,
                connected=self.connected,
                status=self.status,
                application=self.application,
                error=self.why,
            ),
        )
        level, text = OK, "connected"
        if not self.connected:
            level, text = (ERROR, f"not connected: {self.why}") if self.why else (STALE, "starting")
        elif self.status is not None and self.status & _FAULTS:
            level, text = ERROR, " ".join((self.status & _FAULTS).names)
        if (level, text, self.application) != self._told:
            self._told = (level, text, self.application)
            told = diagnostics(self.title, self.url, at, level, text, application=self.application)
            yield BagMessage(_DIAGNOSTICS, when, told)

    def warning(self, at: datetime, text: str, **values: object) -> BagMessage:
        """Return a message of the diagnostics about something that went wrong once."""
        told = diagnostics(self.title, self.url, at, WARN, text, **values)
        return BagMessage(_DIAGNOSTICS, nanoseconds(at), told)

    # ------------------------------------------------------------------ results

    def parts(self, result: Result) -> list[Localization] | None:
        """Return a result's localizations; None where it has none, and where [] may be anything."""
        parts = parts_of(result.value)
        if parts:
            self._locating.add(result.application)
        known = result.application in self._locating or self.spec.startswith("localizations")
        return parts if known else None

    def interpreter(self, result: Result) -> str:
        """Return how a result was read, "" where its value is nothing but its bytes."""
        value = result.value
        if value is None or isinstance(value, bytes) or value_is_hex(value, result.raw):
            return ""
        known = "localizations" if result.application in self._locating else "unknown"
        return self.spec or known

    def see_frame(self, entry: TraceEntry) -> None:
        """Keep a container until it is told what became of it."""
        if entry.direction == "<" and entry.message == "ResultContainer" and entry.fields:
            data, application = entry.fields.get("data"), entry.fields.get("application", -1)
            if isinstance(data, str) and isinstance(application, int):
                with contextlib.suppress(ValueError):
                    self._containers.append((application, bytes.fromhex(data), entry.at))

    def settle(self, raw: bytes) -> None:
        """A container was read: forget it and those before it."""
        for place, (_, data, _) in enumerate(self._containers):
            if data == raw:
                for _ in range(place + 1):
                    self._containers.popleft()
                return

    def unread(self) -> tuple[int, bytes, datetime] | None:
        """Return application, bytes and time of the container that an error means.

        Where several came of which nothing was told, it is not known which: None.
        """
        known = self._containers.pop() if len(self._containers) == 1 else None
        self._containers.clear()
        return known


def value_is_hex(value: object, raw: bytes) -> bool:
    """Return whether a recorded value is the bytes as a recording shows them."""
    return isinstance(value, str) and value == raw.hex()


def parts_from_json(value: object) -> list[Localization] | None:
    """Return what a recording has of localizations as localizations, None where it is none."""
    if not isinstance(value, list):
        return None
    said: list[Any] = value
    try:
        return [_part(one) for one in said]
    except (KeyError, TypeError, ValueError, OverflowError):
        return None


def _part(said: Mapping[str, Any]) -> Localization:
    """Return a localization of JSON; raises where it is none."""
    if set(said) != set(Localization._fields):
        raise ValueError("these are not its fields")
    pose, feature, photo = said["pose"], said["feature_id"], said["photo_index"]
    header = pose["header"]
    if not (isinstance(feature, str) and isinstance(header["frame_id"], str)):
        raise TypeError("no text")
    if type(photo) is not int:
        raise TypeError("no index")
    return Localization(
        feature,
        _number(said["quality"]),
        photo,
        Pose(
            Header(header["seq"], datetime.fromisoformat(header["stamp"]), header["frame_id"]),
            Position(*(_number(pose["position"][name]) for name in "xyz")),
            Quaternion(*(_number(pose["orientation"][name]) for name in "xyzw")),
        ),
    )


def _number(said: object) -> float:
    if isinstance(said, bool) or not isinstance(said, (int, float)):
        raise TypeError("no number")
    return float(said)
