"""Frames and results as JSON, put together: they are nearly all that is in a recording.

The text is that of ``json.dumps(jsonable(item))`` without white space and without what is None,
character for character, but that bytes are in it once (:func:`frame_text`, :func:`result_text`).
What is not of the types that a client makes goes that way itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam._json import NULL, hex_text, text_of
from smartcam.observers import TraceEntry
from smartcam.protocols.messages import Sender

if TYPE_CHECKING:
    from smartcam.models import Result
    from smartcam.observers import RawFrame

MAX_FRAMES_ALIKE = 256
"""Kinds of frames whose text is kept, apart from their time and data."""

VALUE_IS_RAW = '"raw"'


def frame_text(entry: TraceEntry) -> str:
    """Return a frame's text.

    A body's ``data`` that is the end of the frame is not written a second time: ``data_from`` says
    at which of the frame's bytes it begins (:func:`with_data`).
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
    said = hex_text(data) if type(data) is str else text_of(data)
    begins = "" if data_from is None else f',"data_from":{data_from}'
    return (
        f'{{"at":{text_of(at)},"camera":{text_of(camera)},"direction":{text_of(direction)},'
        f'{number}"message":{text_of(message)},{body}"hex":{said}{begins}}}'
    )


class FrameTexts:
    """Makes the texts of frames; of those that are alike but for their data, most of it once."""

    def __init__(self) -> None:
        # by all that tells a kind: what stands in front of the data and behind it. The dialect is
        # kept with them, as its place in memory would be another one's afterwards
        self._known: dict[tuple[object, ...], tuple[str, str, object]] = {}

    def text(self, raw: RawFrame) -> tuple[str, str]:
        """Return a frame's text as :func:`frame_text` makes it, and its data as hex.

        The data is "" where there is none, and where the frame is no camera's.
        """
        frame, dialect = raw.frame, raw.dialect
        if isinstance(frame, TraceEntry):
            return frame_text(frame), body_of(frame)
        begins, payload = dialect.data_begins(raw.sender, frame.message_id), frame.payload
        if begins is None or len(payload) <= begins or raw.sender is not Sender.CAMERA:
            entry = raw.entry()
            return frame_text(entry), body_of(entry)
        kind = raw.camera, id(dialect), frame.message_id, payload[:begins], len(payload)
        data, known = payload[begins:].hex(), self._known.get(kind)
        if known is None:
            entry = raw.entry()
            text = frame_text(entry)
            before = f'{{"at":{text_of(raw.at)}'
            behind = f'","data_from":{len(entry.hex) // 2 - len(payload) + begins}}}'
            if text.startswith(before) and text.endswith(data + behind):
                if len(self._known) >= MAX_FRAMES_ALIKE:
                    self._known.clear()
                front = text[len(before) : len(text) - len(data) - len(behind)]
                self._known[kind] = front, behind, dialect
            return text, body_of(entry)
        return f'{{"at":{text_of(raw.at)}{known[0]}{data}{known[1]}', data


def body_of(entry: TraceEntry) -> str:
    """Return the data that a frame of the camera has, as hex; "" where it has none."""
    data = entry.fields.get("data") if entry.direction == "<" and entry.fields else None
    return data if type(data) is str else ""


def with_data(fields: dict[str, Any] | None, data: str, data_from: int) -> dict[str, Any]:
    """Return a body with its ``data`` again, which begins at that byte of the frame.

    Raises:
        ValueError: the frame has no such byte.
    """
    end = data[2 * data_from :]
    if data_from < 0 or not end:
        raise ValueError(f"data_from: {data_from} came, expected a byte of {len(data) // 2}")
    return {**(fields or {}), "data": end}


def result_text(result: Result[Any], raw_from: int | None = None) -> str:
    """Return a result's text, without what stands elsewhere in the file.

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
    if latency is not None and (said := text_of(latency)) != NULL:
        text += f',"latency":{said}'
    if raw_from is None:
        text += f',"raw":{text_of(raw)}'
    if value is raw:
        end = f',"value_from":{VALUE_IS_RAW}}}'
    else:
        end = "}"
        said = text_of(value)
        if said != NULL:
            text += f',"value":{said}'
    if raw_from is not None:
        text += f',"raw_from":{raw_from}'
    return text + end
