"""Frames and results as JSON, put together: they are nearly all that is in a recording.

The text is that of ``json.dumps(jsonable(item))`` without white space and without what is None,
character for character, but that bytes are in it once (:func:`frame_text`, :func:`result_text`).
What is not of the types that a client makes goes that way itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam._json import NULL, hex_text, text_of
from smartcam.models import Result

if TYPE_CHECKING:
    from smartcam.observers import TraceEntry

VALUE_IS_RAW = '"raw"'

_RESULT = tuple(f'"{name}":' for name in (*Result._fields, "raw_from", "value_from"))


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
    raw, value = result.raw, result.value
    raw_text = NULL if raw_from is not None else text_of(raw)
    said, said_from = (NULL, VALUE_IS_RAW) if value is raw else (text_of(value), NULL)
    last = raw_text, said, text_of(raw_from), said_from
    return _object_of(_RESULT, (*map(text_of, result[:-2]), *last))


def _object_of(names: tuple[str, ...], texts: tuple[str, ...]) -> str:
    pairs = zip(names, texts, strict=True)
    return f"{{{','.join([name + text for name, text in pairs if text != NULL])}}}"
