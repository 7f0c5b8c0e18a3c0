"""The format of a recording: topics, contents of messages, and conversion to and from JSON.

Each camera has four topics, ``/CAMERA/frames``, ``results``, ``events`` and ``errors``. A message
is a JSON object with the field names of the public models; a field that is None is left out, since
viewers such as Foxglove take a field's type from the schema and do not support null. The schemas
use only types that Foxglove supports (``type`` is always one word).

With pictures there is a fifth topic, ``/CAMERA/pictures``, and for the marks on them
``/CAMERA/annotations``, both with Foxglove's messages of Protocol Buffers: see ``_pictures``.
"""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, TypeVar, cast

from smartcam._extras import load
from smartcam._json import object_json
from smartcam.models import (
    ApplicationChanged,
    CameraEvent,
    Connected,
    Disconnected,
    NoticeReceived,
    Reconnected,
    Result,
    Status,
    StatusChanged,
    jsonable,
)
from smartcam.observers import TraceEntry
from smartcam.recording._mcap.json import frame_text, result_text, with_data

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from smartcam.frames import Frame

FORMAT = "3"
"""Version of the format that is written."""

FORMATS = ("1", "2", FORMAT)
"""Versions of the format that are read; others are refused. In version 1 the field ``data`` of a
frame's body repeats the end of the frame; in 1 and 2 a result repeats the bytes of its frame."""

PROFILE = "x-smartcam"
"""Profile in the file's header."""

FILE_METADATA = "smartcam"
"""Name of the metadata record about the file: ``format``, ``version`` (of smartcam), ``began``."""

CAMERA_METADATA = "smartcam.camera"
"""Name of the metadata records about a camera: ``camera``, ``url``, ``dialect`` and others; a
later one overrides an earlier one."""

GAP = "RecordingGap"
"""Name of a :class:`RecordedError` for records that were not written."""

MAX_MESSAGE_BYTES = 1 << 26
"""Largest number of bytes of a message, written or read. A frame's message has its bytes and its
fields, so this is enough for an image of 15 MiB; the largest frame of a BVS camera takes 4 MiB."""

MAX_PICTURE_SIZE_BYTES = 1 << 27
"""Largest number of bytes of a picture that is written: half of the largest record that is read."""

MAX_VALUES = 3_000_000
"""Largest number of commas and opening brackets of a message, written or read: each may become an
object of a hundred times its size. A container of 1 MiB with one field per byte has two million."""

MAX_CAMERAS = 10_000
"""Largest number of cameras in a file: the metadata of all cameras are kept while it is read."""

MAX_NAME_CHARACTERS = 1000
"""Largest number of characters of a camera's name: a client allows 200, and HOST:PORT has fewer
than 300."""

EPOCH = datetime.fromtimestamp(0, UTC)

MAX_CAPTURE_TIME = 18_446_744_073.0
"""Seconds since 1970 of the latest capture, in 2554: times are in nanoseconds, of 64 bits."""


class RecordedError(NamedTuple):
    """An error during the recording, from ``Observer.on_error``.

    Attributes:
        camera: name of the camera.
        at: time of the error, UTC.
        error: name of the exception's class.
        text: text of the error.
        triggered_at: time of the call of ``trigger()`` that ended with the error, UTC; None if the
            error ended no trigger.
        since: time of the first record that was not written, UTC, if ``error`` is
            ``RecordingGap``; ``at`` is the time of the last record. None for other errors.
        records: number of records in a gap that were not written. None for other errors.
    """

    camera: str
    at: datetime
    error: str
    text: str
    triggered_at: datetime | None
    since: datetime | None = None
    records: int | None = None


class RecordedPicture(NamedTuple):
    """A picture from a source of frames.

    Attributes:
        camera: name of the camera.
        at: time of the capture, UTC.
        frame: the :class:`~smartcam.frames.Frame`.
        left_out: number of pictures right before this one that were not written, since too much
            waited for the disk.
        result_number: :attr:`~smartcam.Result.number` of the picture's result; None if it is not
            known.
        result_received_at: arrival of that result, UTC; the number alone is not unique, since each
            client counts its results from 1.
    """

    camera: str
    at: datetime
    frame: Frame
    left_out: int = 0
    result_number: int | None = None
    result_received_at: datetime | None = None


Item: TypeAlias = TraceEntry | Result | CameraEvent | RecordedError | RecordedPicture
"""Any item that a recording holds."""


def captured_at(frame: Frame) -> datetime:
    """Return the time of a picture's capture, with the resolution of a recording."""
    return datetime.fromtimestamp(min(max(0.0, frame.utc), MAX_CAPTURE_TIME), UTC)


class MessageKind(NamedTuple):
    """One kind of message."""

    topic: str  # last part of the topic
    schema: str  # name of the schema
    description: str  # description in the schema
    properties: Mapping[str, Any]  # properties in the schema, by field
    required: tuple[str, ...]  # fields that are always present
    to_text: Callable[..., str]  # function that makes an item's message, in ASCII
    # function that makes the item of a JSON object, or raises any exception
    from_json: Callable[[dict[str, Any]], Item]

    @property
    def json_schema(self) -> dict[str, Any]:
        """The JSON Schema of the messages."""
        return {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "title": self.schema,
            "description": self.description,
            "type": "object",
            "properties": dict(self.properties),
            "required": list(self.required),
        }


def load_extra(name: str) -> Any:
    """Import a module of the extra ``record``.

    Raises:
        MissingExtraError: the package is not installed.
    """
    return load(name, "recordings need")


def load_compress() -> Callable[[bytes], bytes]:
    """Return the function that compresses a chunk; raises as :func:`load_extra`."""
    compress: Callable[[bytes], bytes] = load_extra("zstandard").compress
    return compress


def nanoseconds(at: datetime) -> int:
    """Return a time in MCAP's form: nanoseconds since 1970, UTC; never negative."""
    since = at - EPOCH
    seconds = since.days * 86_400 + since.seconds
    return max(0, seconds * 1_000_000_000 + since.microseconds * 1000)


def count_values(data: bytes) -> int:
    """Check the bounds of a message; return the approximate number of its values.

    Raises:
        ValueError: the message exceeds a bound.
    """
    if len(data) > MAX_MESSAGE_BYTES:
        raise ValueError(f"a message of {len(data)} bytes, expected {MAX_MESSAGE_BYTES} at most")
    values = data.count(b",") + data.count(b"{") + data.count(b"[")
    if values > MAX_VALUES:
        raise ValueError(f"a message of {values} values, expected {MAX_VALUES} at most")
    return values


def message_of(kind: str, item: Item, raw_frame: int | None = None) -> bytes:
    """Return an item's message.

    Args:
        kind: name of the kind of item, a key of ``KINDS``.
        item: item to write.
        raw_frame: number of the frame with the ``raw`` of a result, which is then not
            written again.

    Raises:
        ValueError: the message exceeds the bounds for reading.
    """
    to_text = KINDS[kind].to_text
    return checked_bytes(to_text(item) if raw_frame is None else to_text(item, raw_frame))


def checked_bytes(text: str) -> bytes:
    """Return a message's text as bytes, after checking its bounds.

    Raises:
        ValueError: the message exceeds the bounds for reading.
    """
    data = text.encode()
    size = len(data)
    if size > MAX_VALUES or size > MAX_MESSAGE_BYTES:  # a shorter message has fewer values
        count_values(data)
    return data


def message_fields(data: bytes) -> dict[str, Any]:
    """Return the object of a message.

    Raises:
        ValueError: the message is not valid.
    """
    parsed: Any = json.loads(data)
    if not isinstance(parsed, dict):
        raise ValueError(f"a message is a {type(parsed).__name__}, expected an object")  # noqa: TRY004
    return cast("dict[str, Any]", parsed)


def topic_of(camera: str, kind: str) -> str:
    """Return the topic of a camera's messages of one kind."""
    return f"/{camera}/{KINDS[kind].topic}"


# ---------------------------------------------------------------------- to JSON


def _object(value: object) -> dict[str, Any]:
    """Return an item's fields as JSON, without fields that are None."""
    fields: dict[str, Any] = jsonable(value)
    return {name: field for name, field in fields.items() if field is not None}


def _event_text(event: CameraEvent) -> str:
    fields = _object(event)
    previous = fields.pop("previous", None)
    if previous is not None:
        name = "previous_status" if isinstance(event, StatusChanged) else "previous_application"
        fields[name] = previous
    return object_json({"event": type(event).__name__, **fields})


def _error_text(error: RecordedError) -> str:
    return object_json(_object(error))


# ---------------------------------------------------------------------- from JSON


T = TypeVar("T")


def _required_field(fields: Mapping[str, Any], name: str, kind: type[T]) -> T:
    """Return a required field.

    Raises:
        ValueError: the field is missing, or of another type.
    """
    value = optional_field(fields, name, kind)
    if value is None:
        raise ValueError(f"{name}: the field is missing, expected {kind.__name__}")
    return value


def optional_field(fields: Mapping[str, Any], name: str, kind: type[T]) -> T | None:
    """Return an optional field.

    Raises:
        ValueError: the field is of another type.
    """
    value: object = fields.get(name)
    if value is None:
        return None
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise ValueError(f"{name}: {value!r:.60} came, expected {kind.__name__}")
    return value


def camera_name(fields: Mapping[str, Any]) -> str:
    """Return the name of a message's camera; raises as :func:`_required_field`."""
    name = _required_field(fields, "camera", str)
    if len(name) > MAX_NAME_CHARACTERS:
        raise ValueError(
            f"camera: a name of {len(name)} characters, expected {MAX_NAME_CHARACTERS} at most"
        )
    return name


def time_of(text: str) -> datetime:
    """Return the time of a text, UTC.

    Raises:
        ValueError: the text is not valid, or has no time zone.
    """
    at = datetime.fromisoformat(text)
    if at.tzinfo is None:
        raise ValueError(f"the time {text!r:.60} has no time zone")
    return at.astimezone(UTC)


def _required_time(fields: Mapping[str, Any], name: str) -> datetime:
    return time_of(_required_field(fields, name, str))


def _optional_time(fields: Mapping[str, Any], name: str) -> datetime | None:
    text = optional_field(fields, name, str)
    return None if text is None else time_of(text)


def status_of(names: object) -> Status:
    """Return the status from its bits' names; a bit without a name is written as ``0x40``.

    Raises:
        ValueError: a word is not the name of a bit.
    """
    bits = 0
    for name in cast("list[object]", names) if isinstance(names, list) else [names]:
        if not isinstance(name, str):
            raise ValueError(f"status: {names!r:.60} came, expected names of bits")  # noqa: TRY004
        if name.startswith("0x") and len(name) <= _BIT_DIGITS:
            bits |= int(name, 16)
        elif name in Status.__members__:
            bits |= Status[name].value
        else:
            raise ValueError(f"status: {name!r:.60} is the name of no bit")
    return Status(bits)


_BIT_DIGITS = len("0x") + 16  # 64 bits: the vendor's 32 and 32 of smartcam


def _frame_from_json(fields: dict[str, Any]) -> TraceEntry:
    direction, data = _required_field(fields, "direction", str), _required_field(fields, "hex", str)
    if direction not in {">", "<", "!"}:
        raise ValueError(f"direction: {direction!r:.60} came, expected >, < or !")
    bytes.fromhex(data)
    body = cast("dict[str, Any] | None", optional_field(fields, "fields", dict))
    data_from = optional_field(fields, "data_from", int)
    if data_from is not None:
        body = with_data(body, data, data_from)
    return TraceEntry(
        _required_time(fields, "at"),
        camera_name(fields),
        direction,
        optional_field(fields, "message_id", int),
        _required_field(fields, "message", str),
        body,
        data,
    )


def _result_from_json(fields: dict[str, Any]) -> Result:
    latency = fields.get("latency")
    if latency is not None and not (type(latency) in {int, float} and math.isfinite(latency)):
        raise ValueError(f"latency: {latency!r:.60} came, expected seconds")
    raw = bytes.fromhex(_required_field(fields, "raw", str))
    value_from = optional_field(fields, "value_from", str)
    if value_from not in {None, "raw"}:
        raise ValueError(f"value_from: {value_from!r:.60} came, expected raw")
    return Result(
        camera_name(fields),
        _required_field(fields, "application", int),
        optional_field(fields, "sequence", int),
        _required_field(fields, "number", int),
        _optional_time(fields, "triggered_at"),
        _required_time(fields, "received_at"),
        latency,
        raw,
        fields.get("value") if value_from is None else raw.hex(),
    )


def _event_from_json(fields: dict[str, Any]) -> CameraEvent:
    camera, at = camera_name(fields), _required_time(fields, "at")
    match _required_field(fields, "event", str):
        case "Connected":
            return Connected(camera=camera, at=at, url=_required_field(fields, "url", str))
        case "Reconnected":
            return Reconnected(camera=camera, at=at, url=_required_field(fields, "url", str))
        case "Disconnected":
            return Disconnected(
                camera=camera,
                at=at,
                reason=_required_field(fields, "reason", str),
                expected=_required_field(fields, "expected", bool),
            )
        case "StatusChanged":
            before = fields.get("previous_status")
            return StatusChanged(
                camera=camera,
                at=at,
                status=status_of(_required_field(fields, "status", list)),
                previous=None if before is None else status_of(before),
            )
        case "ApplicationChanged":
            return ApplicationChanged(
                camera=camera,
                at=at,
                application=_required_field(fields, "application", int),
                previous=optional_field(fields, "previous_application", int),
            )
        case "NoticeReceived":
            return NoticeReceived(
                camera=camera,
                at=at,
                kind=_required_field(fields, "kind", str),
                code=_required_field(fields, "code", int),
                text=_required_field(fields, "text", str),
            )
        case _:
            return CameraEvent(camera=camera, at=at)


def _error_from_json(fields: dict[str, Any]) -> RecordedError:
    return RecordedError(
        camera_name(fields),
        _required_time(fields, "at"),
        _required_field(fields, "error", str),
        _required_field(fields, "text", str),
        _optional_time(fields, "triggered_at"),
        _optional_time(fields, "since"),
        optional_field(fields, "records", int),
    )


# ---------------------------------------------------------------------- the table


def _text_schema(description: str) -> dict[str, Any]:
    return {"type": "string", "description": description}


def _integer_schema(description: str) -> dict[str, Any]:
    return {"type": "integer", "description": description}


def _time_schema(description: str) -> dict[str, Any]:
    return {"type": "string", "format": "date-time", "description": f"{description}; ISO 8601, UTC"}


_CAMERA = _text_schema("name of the camera")
_AT = _time_schema("when")
_BITS = {"type": "array", "items": {"type": "string"}, "description": "names of the status bits"}
_TRIGGERED_AT = _time_schema("when it was triggered; absent where it was not")

KINDS: dict[str, MessageKind] = {
    "frames": MessageKind(
        "frames",
        "smartcam.Frame",
        "A frame on the wire, or bytes that make no frame.",
        {
            "at": _AT,
            "camera": _CAMERA,
            "direction": _text_schema("> to the camera, < from it, ! bytes that make no frame"),
            "message_id": _integer_schema("id on the wire"),
            "message": _text_schema("name of the message, or what is wrong with the bytes"),
            "fields": {"type": "object", "properties": {}, "description": "the decoded body"},
            "hex": _text_schema("the bytes"),
            "data_from": _integer_schema("byte at which data begins, if fields leaves it out"),
        },
        ("at", "camera", "direction", "message", "hex"),
        frame_text,
        _frame_from_json,
    ),
    "results": MessageKind(
        "results",
        "smartcam.Result",
        "A decoded result container; in `value` stands what the interpreter made of it.",
        {
            "camera": _CAMERA,
            "application": _integer_schema("id of the application that made it"),
            "sequence": _integer_schema("value of the layout's @sequence field"),
            "number": _integer_schema("the client's own count, from 1"),
            "triggered_at": _TRIGGERED_AT,
            "received_at": _time_schema("when its last byte arrived"),
            "latency": {"type": "number", "description": "seconds from trigger to arrival"},
            "raw": _text_schema("the container's bytes behind the application id, as hex"),
            "raw_from": _integer_schema(
                "number, in /CAMERA/frames, of the frame whose data are raw"
            ),
            "value_from": _text_schema("raw: the value is these bytes"),
        },
        ("camera", "application", "number", "received_at"),
        result_text,
        _result_from_json,
    ),
    "events": MessageKind(
        "events",
        "smartcam.Event",
        "Something happened to the camera.",
        {
            "event": _text_schema(
                "Connected, Reconnected, Disconnected, StatusChanged, ApplicationChanged or "
                "NoticeReceived"
            ),
            "camera": _CAMERA,
            "at": _AT,
            "url": _text_schema("Connected, Reconnected: the URL with dialect, transport and port"),
            "reason": _text_schema("Disconnected: why"),
            "expected": {
                "type": "boolean",
                "description": "Disconnected: by the client's own wish",
            },
            "status": _BITS,
            "previous_status": _BITS,
            "application": _integer_schema("ApplicationChanged: id of the active application"),
            "previous_application": _integer_schema("ApplicationChanged: id of the one before"),
            "kind": _text_schema("NoticeReceived: error, notification or debug"),
            "code": _integer_schema("NoticeReceived: the camera's number of it"),
            "text": _text_schema("NoticeReceived: what the camera says"),
        },
        ("event", "camera", "at"),
        _event_text,
        _event_from_json,
    ),
    "errors": MessageKind(
        "errors",
        "smartcam.Error",
        "Something went wrong: a trigger without a result, a lost link, a container that does "
        "not fit.",
        {
            "camera": _CAMERA,
            "at": _AT,
            "error": _text_schema("name of the exception's class"),
            "text": _text_schema("what it says"),
            "triggered_at": _TRIGGERED_AT,
            "since": _time_schema("RecordingGap: since when records were not written"),
            "records": _integer_schema("RecordingGap: how many were not written"),
        },
        ("camera", "at", "error", "text"),
        _error_text,
        _error_from_json,
    ),
}
"""The kinds of messages, by the last part of their topics."""

PICTURES = "pictures"
"""Last part of the topic of pictures."""

PICTURE_SCHEMAS = ("foxglove.RawImage", "foxglove.CompressedImage", "foxglove.CompressedVideo")
"""Schemas of pictures; to read them, the distribution of frames is needed."""

ANNOTATIONS = "annotations"
"""Last part of the topic of marks on pictures."""

ANNOTATIONS_SCHEMA = "foxglove.ImageAnnotations"
"""Schema of marks on a picture."""
