"""Write values as JSON, as ``json.dumps(jsonable(value))`` without white space, but faster.

Values of types that the client does not make are converted by :func:`smartcam.models.jsonable`.
"""

from __future__ import annotations

import functools
import json
import math
import sys
from datetime import UTC, datetime
from json.encoder import encode_basestring_ascii
from typing import TYPE_CHECKING, Any

from smartcam.models import Header, Localization, Pose, Position, Quaternion, jsonable

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

MIN_HEX_CHARACTERS = 1024
"""Texts with more characters are checked for hex, which needs no quoting; quoting takes most of the
time of a large container."""

NULL = "null"

_HEX = b"0123456789abcdef"
_EPOCH = datetime.fromtimestamp(0, UTC)
_PLAIN = frozenset({str, int, float, bool, type(None)})
_FLOAT = frozenset({float})
_INTEGERS = frozenset({int})
_FORMATS = {"i": "%d", "u": "%d", "f": "%r", "S": "%s"}
"""The ``%`` formats of values in a table's columns, by numpy's kind of the column."""

MAX_FLOAT_BYTES = 8
"""Largest size in bytes of numpy's floats that Python's ``float`` can hold."""

_COLUMNS = frozenset("iufbS")
"""Numpy's kinds of columns whose values become values of Python's own types."""

_quoted: Callable[[str], str] = encode_basestring_ascii
_encode = json.JSONEncoder(separators=(",", ":")).encode
_encode_finite = json.JSONEncoder(separators=(",", ":"), allow_nan=False).encode

_HEADER = '{"seq":%s,"stamp":%s,"frame_id":%s}'
_LOCALIZATION = (
    '{"feature_id":%s,"quality":%r,"photo_index":%d,"pose":{"header":%s,'
    '"position":{"x":%r,"y":%r,"z":%r},"orientation":{"x":%r,"y":%r,"z":%r,"w":%r}}}'
)


def object_json(fields: Mapping[str, object]) -> str:
    """Return an object as JSON."""
    return f"{{{','.join([f'{_quoted(name)}:{json_of(item)}' for name, item in fields.items()])}}}"


def bytes_json(data: bytes) -> str:
    """Return bytes as JSON: a text of hex, which needs no quoting."""
    return f'"{data.hex()}"'


def json_of(value: object) -> str:
    """Return the text of a value."""
    if type(value) is str:
        return _quoted(value)
    if type(value) is int:
        return repr(value)
    if value is None:
        return NULL
    if type(value) is datetime:
        return _time_text(value)
    if type(value) is bytes:
        return bytes_json(value)
    return _container_text(value)


_latest: list[tuple[datetime, str]] = [(_EPOCH, f'"{_EPOCH.isoformat()}"')]
"""The last time written, and its text: a result and its parts share the time."""


def _time_text(at: datetime) -> str:
    last, text = _latest[0]
    if last is not at:
        text = f'"{at.isoformat()}"'
        _latest[0] = at, text
    return text


def hex_json(text: str) -> str:
    """Return the JSON text of a string that is probably hex."""
    if (
        len(text) > MIN_HEX_CHARACTERS
        and text.isascii()
        and not text.encode().translate(None, _HEX)
    ):
        return f'"{text}"'
    return _quoted(text)


def _container_text(value: object) -> str:
    if type(value) is list:
        text = _localizations_json(value)
        if text is not None:
            return text
    elif type(value) is dict and _INTEGERS.issuperset(map(type, value.values())):
        return f"{{{','.join([f'{_quoted(str(name))}:{item}' for name, item in value.items()])}}}"
    elif _is_table(value):
        text = _table_text(value)
        if text is not None:
            return text
    try:
        return _encode_finite(plain(value))
    except (TypeError, ValueError):  # NaN, infinity, or a type of numpy
        return _encode(jsonable(value))


def _is_table(value: object) -> bool:
    # another thread may be importing numpy just now
    return type(value) is getattr(sys.modules.get("numpy"), "ndarray", None)


def _table_text(table: Any) -> str | None:
    """Return the text of a table's rows; None if :func:`jsonable` has to make it."""
    row_format = _row_format(table.dtype)
    if table.ndim != 1 or row_format is None:
        return None
    format_text, text_indices, float_indices = row_format
    rows: list[str] = []
    for values in table.tolist():
        fields = [*values]
        total = 0.0
        for index in float_indices:
            total += fields[index]
        if not math.isfinite(total):
            return None  # the sum is finite only if all values are
        for index in text_indices:
            fields[index] = _quoted(_text_or_hex(fields[index]))
        rows.append(format_text % (*fields,))
    return f"[{','.join(rows)}]"


@functools.lru_cache(maxsize=256)
def _row_format(dtype: Any) -> tuple[str, tuple[int, ...], tuple[int, ...]] | None:
    """Return a row's format, indices of texts and of floats; None for kinds not in ``_FORMATS``."""
    kinds = [dtype.fields[name][0] for name in dtype.names or ()]
    if not kinds or any(
        kind.kind not in _FORMATS or (kind.kind == "f" and kind.itemsize > MAX_FLOAT_BYTES)
        for kind in kinds
    ):
        return None
    fields = zip(dtype.names, kinds, strict=True)
    format_text = ",".join(
        [f"{_quoted(name).replace('%', '%%')}:{_FORMATS[kind.kind]}" for name, kind in fields]
    )
    texts = tuple(index for index, kind in enumerate(kinds) if kind.kind == "S")
    floats = tuple(index for index, kind in enumerate(kinds) if kind.kind == "f")
    return f"{{{format_text}}}", texts, floats


def _localizations_json(value: list[object]) -> str | None:
    """Return the text of localizations; None if :func:`jsonable` has to make it."""
    texts: list[str] = []
    header: object = None
    header_text = ""
    for part in value:
        if type(part) is not Localization:
            return None
        feature_id, quality, photo_index, pose = part
        if type(pose) is not Pose or type(feature_id) is not str or type(photo_index) is not int:
            return None
        part_header, position, orientation = pose
        if type(position) is not Position or type(orientation) is not Quaternion:
            return None
        numbers = quality, *position, *orientation
        if not _FLOAT.issuperset(map(type, numbers)) or not math.isfinite(sum(numbers)):
            return None  # the sum is finite only if all values are
        if part_header is not header:  # parts of one result share a header
            if type(part_header) is not Header:
                return None
            header, header_text = part_header, _HEADER % (*map(json_of, part_header),)
        front = _quoted(feature_id), quality, photo_index, header_text
        texts.append(_LOCALIZATION % (*front, *numbers[1:]))
    return f"[{','.join(texts)}]"


def plain(value: Any) -> Any:
    """Return a value as :func:`~smartcam.models.jsonable` does, but keep NaN and infinity."""
    kind = type(value)
    if kind in _PLAIN:
        return value
    if kind is list or kind is tuple:
        return value if _PLAIN.issuperset(map(type, value)) else [plain(item) for item in value]
    if kind is dict:
        return {str(name): plain(item) for name, item in value.items()}
    if issubclass(kind, tuple) and hasattr(value, "_asdict"):
        fields: dict[str, Any] = value._asdict()
        if _PLAIN.issuperset(map(type, fields.values())):
            return fields
        return {name: plain(field) for name, field in fields.items()}
    if _is_table(value):
        rows = _rows(value)
        if rows is not None:
            return rows
    return jsonable(value)


def _rows(table: Any) -> Any:
    """Return a table's rows; None if :func:`jsonable` has to make them."""
    names, fields = table.dtype.names, table.dtype.fields
    kinds = [fields[name][0].kind for name in names or ()]
    if table.ndim != 1 or not kinds or not _COLUMNS.issuperset(kinds):
        return None
    texts = [index for index, kind in enumerate(kinds) if kind == "S"]
    rows: list[Any] = table.tolist()
    if texts:
        columns = [*zip(*rows, strict=True)]
        for index in texts if columns else ():
            columns[index] = tuple(map(_text_or_hex, columns[index]))
        rows = [*zip(*columns, strict=True)]
    return [dict(zip(names, row, strict=True)) for row in rows]


def _text_or_hex(data: bytes) -> str:
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.hex()
