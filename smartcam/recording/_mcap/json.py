"""Write frames and results as JSON quickly, since most records are frames or results.

The text is that of ``json.dumps(jsonable(item))`` without white space and without fields that are
None. Bytes are written only once (:func:`frame_text`, :func:`result_text`). Values of types that no
client makes are converted by ``jsonable`` and ``json.dumps``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam._json import NULL, hex_json, json_of
from smartcam.observers import TraceEntry
from smartcam.protocols.messages import Sender

if TYPE_CHECKING:
    from smartcam.models import Result
    from smartcam.observers import RawFrame

MAX_CACHED_FRAME_TEXTS = 256
"""Largest number of cached texts of frames; a cached text lacks the frame's time and data."""

VALUE_IS_RAW = '"raw"'


def frame_text(entry: TraceEntry) -> str:
    """Return a frame's text.

    If a body's ``data`` is the end of the frame, it is not written a second time: ``data_from`` is
    the byte of the frame at which it begins (:func:`with_data`).
    """
    at, camera, direction, message_id, message, fields, data = entry
    data_from = None
    if type(fields) is dict and type(data) is str:
        end = fields.get("data")
        if type(end) is str and end and data.endswith(end) and len(data) % 2 == len(end) % 2 == 0:
            data_from = (len(data) - len(end)) // 2
            fields = {name: value for name, value in fields.items() if name != "data"}
    number = "" if message_id is None else f'"message_id":{json_of(message_id)},'
    body = "" if fields is None else f'"fields":{json_of(fields)},'
    data_text = hex_json(data) if type(data) is str else json_of(data)
    data_from_text = "" if data_from is None else f',"data_from":{data_from}'
    return (
        f'{{"at":{json_of(at)},"camera":{json_of(camera)},"direction":{json_of(direction)},'
        f'{number}"message":{json_of(message)},{body}"hex":{data_text}{data_from_text}}}'
    )


class FrameTexts:
    """Makes the texts of frames, with cached parts for frames that differ only in their data."""

    def __init__(self) -> None:
        # text before and after the data, by properties of the frame. The dialect is kept, too:
        # otherwise another object could get its id
        self._cached_texts: dict[tuple[object, ...], tuple[str, str, object]] = {}
        # of the last frame: time, camera, dialect, sender, message id, payload size, payload before
        # the data, text before the data, text after the data
        self._last: tuple[Any, ...] = (None, None, None, None, None, 0, b"", "", "")

    def text(self, raw: RawFrame) -> tuple[str, str]:
        """Return a frame's text, as from :func:`frame_text`, and its data as hex.

        The data is "" if the frame has no data or is a frame of the client.
        """
        at, camera, dialect, sender, frame = raw
        if isinstance(frame, TraceEntry):
            return frame_text(frame), data_of(frame)
        message_id, payload = frame
        last_at, last_camera, last_dialect, last_sender, last_id, size, head, start, end = (
            self._last
        )
        if (
            at is last_at
            and camera is last_camera
            and dialect is last_dialect
            and sender is last_sender
            and message_id == last_id
            and len(payload) == size
            and payload.startswith(head)
        ):  # came together with the last frame, and differs only in its data
            data = payload[len(head) :].hex()
            return f"{start}{data}{end}", data
        data_offset = dialect.data_begins(sender, message_id)
        if data_offset is None or len(payload) <= data_offset or sender is not Sender.CAMERA:
            entry = raw.entry()
            return frame_text(entry), data_of(entry)
        key = camera, id(dialect), message_id, payload[:data_offset], len(payload)
        data, cached = payload[data_offset:].hex(), self._cached_texts.get(key)
        if cached is None:
            entry = raw.entry()
            text = frame_text(entry)
            time_text = f'{{"at":{json_of(at)}'
            end = f'","data_from":{len(entry.hex) // 2 - len(payload) + data_offset}}}'
            if text.startswith(time_text) and text.endswith(data + end):
                if len(self._cached_texts) >= MAX_CACHED_FRAME_TEXTS:
                    self._cached_texts.clear()
                start = text[len(time_text) : len(text) - len(data) - len(end)]
                self._cached_texts[key] = start, end, dialect
            return text, data_of(entry)
        start, end = f'{{"at":{json_of(at)}{cached[0]}', cached[1]
        properties = at, camera, dialect, sender, message_id, len(payload), payload[:data_offset]
        self._last = (*properties, start, end)
        return f"{start}{data}{end}", data


def data_of(entry: TraceEntry) -> str:
    """Return the ``data`` of a frame from the camera as hex; "" without data."""
    data = entry.fields.get("data") if entry.direction == "<" and entry.fields else None
    return data if type(data) is str else ""


def with_data(fields: dict[str, Any] | None, data: str, data_from: int) -> dict[str, Any]:
    """Return a body with its ``data``, which begins at byte ``data_from`` of the frame.

    Raises:
        ValueError: the frame has no such byte.
    """
    end = data[2 * data_from :]
    if data_from < 0 or not end:
        raise ValueError(f"data_from: {data_from} came, expected an offset below {len(data) // 2}")
    return {**(fields or {}), "data": end}


def result_text(result: Result[Any], raw_frame: int | None = None) -> str:
    """Return a result's text, without bytes that are elsewhere in the file.

    Args:
        result: result to write.
        raw_frame: number of the frame whose ``data`` is :attr:`~smartcam.Result.raw`; None:
            write ``raw`` itself.
    """
    camera, application, sequence, number, triggered_at, received_at, latency, raw, value = result
    text = f'{{"camera":{json_of(camera)},"application":{json_of(application)}'
    if sequence is not None:
        text += f',"sequence":{json_of(sequence)}'
    text += f',"number":{json_of(number)}'
    if triggered_at is not None:
        text += f',"triggered_at":{json_of(triggered_at)}'
    text += f',"received_at":{json_of(received_at)}'
    if latency is not None and (field_text := json_of(latency)) != NULL:
        text += f',"latency":{field_text}'
    if raw_frame is None:
        text += f',"raw":{json_of(raw)}'
    if value is raw:
        end = f',"value_from":{VALUE_IS_RAW}}}'
    else:
        end = "}"
        field_text = json_of(value)
        if field_text != NULL:
            text += f',"value":{field_text}'
    if raw_frame is not None:
        text += f',"raw_from":{raw_frame}'
    return text + end
