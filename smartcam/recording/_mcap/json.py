"""Frames and results as JSON, with fast code, since a recording consists mostly of them.

The text is that of ``json.dumps(jsonable(item))`` without white space and without fields that are
None, but bytes are in it only once (:func:`frame_text`, :func:`result_text`). Values of types that
a client does not make are converted by that call itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam._json import NULL, hex_text, text_of
from smartcam.observers import TraceEntry
from smartcam.protocols.messages import Sender

if TYPE_CHECKING:
    from smartcam.models import Result
    from smartcam.observers import RawFrame

MAX_CACHED_FRAME_TEXTS = 256
"""Largest number of kinds of frames whose text is kept, without their time and data."""

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
    number = "" if message_id is None else f'"message_id":{text_of(message_id)},'
    body = "" if fields is None else f'"fields":{text_of(fields)},'
    data_text = hex_text(data) if type(data) is str else text_of(data)
    begins = "" if data_from is None else f',"data_from":{data_from}'
    return (
        f'{{"at":{text_of(at)},"camera":{text_of(camera)},"direction":{text_of(direction)},'
        f'{number}"message":{text_of(message)},{body}"hex":{data_text}{begins}}}'
    )


class FrameTexts:
    """Makes the texts of frames, with cached parts for frames that differ only in their data."""

    def __init__(self) -> None:
        # text before and after the data, by the kind of frame. The dialect is kept as well, since
        # its id in memory could otherwise be reused
        self._known: dict[tuple[object, ...], tuple[str, str, object]] = {}
        # of the last frame: time, camera, dialect, sender, id, bytes of the payload, those before
        # its data, and the text before and after that
        self._last: tuple[Any, ...] = (None, None, None, None, None, 0, b"", "", "")

    def text(self, raw: RawFrame) -> tuple[str, str]:
        """Return a frame's text, as from :func:`frame_text`, and its data as hex.

        The data is "" if the frame has no data or is a frame of the client.
        """
        at, camera, dialect, sender, frame = raw
        if isinstance(frame, TraceEntry):
            return frame_text(frame), body_of(frame)
        message_id, payload = frame
        known_at, name, known_dialect, known_sender, known_id, size, head, front, end = self._last
        if (
            at is known_at
            and camera is name
            and dialect is known_dialect
            and sender is known_sender
            and message_id == known_id
            and len(payload) == size
            and payload.startswith(head)
        ):  # came together with the last one, and differs only in its data
            data = payload[len(head) :].hex()
            return f"{front}{data}{end}", data
        begins = dialect.data_begins(sender, message_id)
        if begins is None or len(payload) <= begins or sender is not Sender.CAMERA:
            entry = raw.entry()
            return frame_text(entry), body_of(entry)
        kind = camera, id(dialect), message_id, payload[:begins], len(payload)
        data, known = payload[begins:].hex(), self._known.get(kind)
        if known is None:
            entry = raw.entry()
            text = frame_text(entry)
            before = f'{{"at":{text_of(at)}'
            behind = f'","data_from":{len(entry.hex) // 2 - len(payload) + begins}}}'
            if text.startswith(before) and text.endswith(data + behind):
                if len(self._known) >= MAX_CACHED_FRAME_TEXTS:
                    self._known.clear()
                front = text[len(before) : len(text) - len(data) - len(behind)]
                self._known[kind] = front, behind, dialect
            return text, body_of(entry)
        front, end = f'{{"at":{text_of(at)}{known[0]}', known[1]
        about = at, camera, dialect, sender, message_id, len(payload), payload[:begins]
        self._last = (*about, front, end)
        return f"{front}{data}{end}", data


def body_of(entry: TraceEntry) -> str:
    """Return the data of a camera's frame as hex; "" without data."""
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


def result_text(result: Result[Any], raw_from: int | None = None) -> str:
    """Return a result's text, without bytes that are elsewhere in the file.

    Args:
        result: result to write.
        raw_from: number of the frame whose ``data`` is :attr:`~smartcam.Result.raw`; None:
            write ``raw`` itself.
    """
    camera, application, sequence, number, triggered_at, received_at, latency, raw, value = result
    text = f'{{"camera":{text_of(camera)},"application":{text_of(application)}'
    if sequence is not None:
        text += f',"sequence":{text_of(sequence)}'
    text += f',"number":{text_of(number)}'
    if triggered_at is not None:
        text += f',"triggered_at":{text_of(triggered_at)}'
    text += f',"received_at":{text_of(received_at)}'
    if latency is not None and (field_text := text_of(latency)) != NULL:
        text += f',"latency":{field_text}'
    if raw_from is None:
        text += f',"raw":{text_of(raw)}'
    if value is raw:
        end = f',"value_from":{VALUE_IS_RAW}}}'
    else:
        end = "}"
        field_text = text_of(value)
        if field_text != NULL:
            text += f',"value":{field_text}'
    if raw_from is not None:
        text += f',"raw_from":{raw_from}'
    return text + end
