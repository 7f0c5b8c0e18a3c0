"""Frames and results as JSON, put together: they are nearly all that is in a recording.

The text is that of ``json.dumps(jsonable(item))`` without white space and without what is None,
character for character, but that bytes are in it once (:func:`frame_text`, :func:`result_text`).
What is not of the types that a client makes goes that way itself.
"""

from __future__ import annotations

import json
import math
import sys
from datetime import UTC, datetime
from json.encoder import encode_basestring_ascii
from typing import TYPE_CHECKING, Any

from smartcam.models import (
    Header,
    Localization,
    Pose,
    Position,
    Quaternion,
    Result,
    jsonable,
)
from smartcam.observers import TraceEntry

if TYPE_CHECKING:
    from collections.abc import Callable

LONG = 1024
"""Characters of a text from which on it pays to look whether it is nothing but hex, which needs no
quoting: that takes most of the time of a large container."""

NULL = "null"
VALUE_IS_RAW = '"raw"'

_HEX = b"0123456789abcdef"
EPOCH = datetime.fromtimestamp(0, UTC)
_PLAIN = frozenset({str, int, float, bool, type(None)})
_FLOAT = frozenset({float})
_INTEGERS = frozenset({int})
_COLUMNS = frozenset("iufbS")
"""Kinds of a table's columns whose values numpy gives as Python's."""

_quoted: Callable[[str], str] = encode_basestring_ascii
_encode = json.JSONEncoder(separators=(",", ":")).encode
_encode_finite = json.JSONEncoder(separators=(",", ":"), allow_nan=False).encode

_FRAME = tuple(f'"{name}":' for name in (*TraceEntry._fields, "data_from"))
_RESULT = tuple(f'"{name}":' for name in (*Result._fields, "raw_from", "value_from"))

_HEADER = '{"seq":%s,"stamp":%s,"frame_id":%s}'
_PART = (
    '{"feature_id":%s,"quality":%r,"photo_index":%d,"pose":{"header":%s,'
    '"position":{"x":%r,"y":%r,"z":%r},"orientation":{"x":%r,"y":%r,"z":%r,"w":%r}}}'
)


def object_text(fields: dict[str, Any]) -> str:
    """Return the text of an object of plain values."""
    return _encode(fields)


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
    texts = (
        *(_text(at), _text(camera), _text(direction), _text(message_id), _text(message)),
        _text(fields),
        _hex_text(data) if type(data) is str else _text(data),
        _text(data_from),
    )
    return _object_of(_FRAME, texts)


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
    """Return a result's text, without what is said elsewhere.

    Args:
        result: it.
        raw_from: number of the frame whose ``data`` is :attr:`~smartcam.Result.raw`; None: write
            it.
    """
    raw, value = result.raw, result.value
    if raw_from is not None:
        raw_text = NULL
    else:
        raw_text = f'"{raw.hex()}"' if type(raw) is bytes else _text(raw)
    value_text, value_from = (NULL, VALUE_IS_RAW) if value is raw else (_value_text(value), NULL)
    last = raw_text, value_text, _text(raw_from), value_from
    return _object_of(_RESULT, (*map(_text, result[:-2]), *last))


def _object_of(names: tuple[str, ...], texts: tuple[str, ...]) -> str:
    pairs = zip(names, texts, strict=True)
    return f"{{{','.join([name + text for name, text in pairs if text != NULL])}}}"


def _text(value: object) -> str:
    if type(value) is str:
        return _quoted(value)
    if type(value) is int:
        return repr(value)
    if value is None:
        return NULL
    if type(value) is datetime:
        return _time_text(value)
    return _value_text(value)


_latest: list[tuple[datetime, str]] = [(EPOCH, f'"{EPOCH.isoformat()}"')]
"""The time that was written last, and its text: a result and its parts have the same one."""


def _time_text(at: datetime) -> str:
    known, text = _latest[0]
    if known is not at:
        text = f'"{at.isoformat()}"'
        _latest[0] = at, text
    return text


def _hex_text(text: str) -> str:
    if len(text) > LONG and text.isascii() and not text.encode().translate(None, _HEX):
        return f'"{text}"'
    return _quoted(text)


def _value_text(value: object) -> str:
    if type(value) is list:
        text = _parts_text(value)
        if text is not None:
            return text
    elif type(value) is dict and _INTEGERS.issuperset(map(type, value.values())):
        return f"{{{','.join([f'{_quoted(str(name))}:{one}' for name, one in value.items()])}}}"
    try:
        return _encode_finite(_plain(value))
    except (TypeError, ValueError):  # NaN, infinity, or what numpy knows and Python does not
        return _encode(jsonable(value))


def _parts_text(value: list[object]) -> str | None:
    """Return the text of localizations; None where it is to be made in another way."""
    texts: list[str] = []
    header: object = None
    header_text = ""
    for part in value:
        if type(part) is not Localization:
            return None
        feature_id, quality, photo_index, pose = part
        if type(pose) is not Pose or type(feature_id) is not str or type(photo_index) is not int:
            return None
        of, position, orientation = pose
        if type(position) is not Position or type(orientation) is not Quaternion:
            return None
        numbers = quality, *position, *orientation
        if not _FLOAT.issuperset(map(type, numbers)) or not math.isfinite(sum(numbers)):
            return None  # a sum is not finite where one of them is not
        if of is not header:  # they have the same one
            if type(of) is not Header:
                return None
            header, header_text = of, _HEADER % (*map(_text, of),)
        front = _quoted(feature_id), quality, photo_index, header_text
        texts.append(_PART % (*front, *numbers[1:]))
    return f"[{','.join(texts)}]"


def _plain(value: Any) -> Any:
    """Return what :func:`~smartcam.models.jsonable` does, but floats as they are."""
    kind = type(value)
    if kind in _PLAIN:
        return value
    if kind is list or kind is tuple:
        return value if _PLAIN.issuperset(map(type, value)) else [_plain(one) for one in value]
    if kind is dict:
        return {str(name): _plain(one) for name, one in value.items()}
    if issubclass(kind, tuple) and hasattr(value, "_asdict"):
        fields: dict[str, Any] = value._asdict()
        if _PLAIN.issuperset(map(type, fields.values())):
            return fields
        return {name: _plain(one) for name, one in fields.items()}
    numpy = sys.modules.get("numpy")
    if numpy is not None and kind is numpy.ndarray:
        rows = _rows(value)
        if rows is not None:
            return rows
    return jsonable(value)


def _rows(table: Any) -> Any:
    """Return a table's rows; None where they are not simple."""
    names, fields = table.dtype.names, table.dtype.fields
    kinds = [fields[name][0].kind for name in names or ()]
    if table.ndim != 1 or not kinds or not _COLUMNS.issuperset(kinds):
        return None
    texts = [place for place, kind in enumerate(kinds) if kind == "S"]
    rows: list[Any] = table.tolist()
    if texts:
        columns = [*zip(*rows, strict=True)]
        for place in texts if columns else ():
            columns[place] = tuple(map(_text_or_hex, columns[place]))
        rows = [*zip(*columns, strict=True)]
    return [dict(zip(names, row, strict=True)) for row in rows]


def _text_or_hex(data: bytes) -> str:
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.hex()
