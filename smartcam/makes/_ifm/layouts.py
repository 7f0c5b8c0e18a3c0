"""The layout of a session's results: from smartcam's language to PCIC's JSON, and JSON to bytes."""

from __future__ import annotations

import itertools
import json
import struct
from typing import TYPE_CHECKING, Any

from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from smartcam.layout import Layout
    from smartcam.layout._inside import Field

MARK = "smartcam;"
"""Text at the beginning of each result in an uploaded layout; a result in another layout begins
with another text."""

_TYPES: Mapping[str, tuple[str, str]] = {
    **{f"int{bits}": (f"int{bits}", code) for bits, code in ((8, "b"), (16, "h"), (32, "i"))},
    **{f"uint{bits}": (f"uint{bits}", code) for bits, code in ((8, "B"), (16, "H"), (32, "I"))},
    "real32": ("float32", "f"),
    "real64": ("float64", "d"),
    "bool": ("uint8", "B"),
}
"""smartcam's types: ifm's name, and the letter in ``struct``."""

_CODES: Mapping[str, str] = dict(_TYPES.values())

MAX_DEPTH = 8
"""Largest depth of nested records of a layout."""


def layout_json(layout: Layout) -> str:
    """Return the layout for a device, which makes it send the declared fields in binary.

    Raises:
        ConfigurationError: the device has no such type, or the layout fixes the number of records.
    """
    elements: list[dict[str, Any]] = [{"type": "string", "value": MARK, "id": "start_string"}]
    elements += map(_element, layout.head)
    fields = [_element(field) for field in layout.fields]
    if isinstance(layout.repeat, int):
        raise ConfigurationError(
            f"ifm: a layout cannot fix the number of records; write ( ... )*: {layout.text}"
        )
    if layout.repeat is None:
        elements += fields
    else:
        elements.append({"type": "records", "id": layout.group or "records", "elements": fields})
    form = {"dataencoding": "binary", "order": "little"}
    return json.dumps({"layouter": "flexible", "format": form, "elements": elements})


def _element(field: Field) -> dict[str, Any]:
    if field.type == "string":
        width = {"width": field.size, "fill": "\0", "alignment": "left"}
        return {"type": "string", "id": field.name, "format": width}
    if field.type not in _TYPES:
        raise ConfigurationError(f"ifm: a device has no {field.type}: {field.label}")
    return {"type": _TYPES[field.type][0], "id": field.name}


def with_bools(layout: Layout, data: bytes) -> bytes:
    """Return a result's bytes with the bools of smartcam's layouts: 1 becomes 0xFF."""
    if not any(field.type == "bool" for field in (*layout.head, *layout.fields)):
        return data
    begin, size = (sum(field.size for field in fields) for fields in (layout.head, layout.fields))
    starts = range(begin, len(data), size) if layout.repeat is not None else (begin,)
    changed = bytearray(data)
    for start, fields in ((0, layout.head), *((start, layout.fields) for start in starts)):
        places = itertools.accumulate((field.size for field in fields), initial=start)
        for at, field in zip(places, fields, strict=False):
            if field.type == "bool" and data[at : at + 1] == b"\x01":
                changed[at] = 0xFF
    return bytes(changed)


def check_layout(text: str) -> dict[str, Any]:
    """Return a layout that a client uploads; ValueError if a device would refuse it."""
    described = json.loads(text)
    if not isinstance(described, dict) or described.get("layouter") != "flexible":
        raise ValueError('the layouter is not "flexible"')
    _check(described.get("elements"), MAX_DEPTH)
    return described


def _check(elements: object, depth: int) -> None:
    if depth < 1:
        raise ValueError(f"records are nested deeper than {MAX_DEPTH}")
    if not isinstance(elements, list):
        raise ValueError(f"not a list of elements: {elements!r:.80}")  # noqa: TRY004
    for element in elements:
        kind = element.get("type") if isinstance(element, dict) else None
        if kind == "records":
            _check(element.get("elements"), depth - 1)
        elif kind not in {"string", "blob", *_CODES} or not isinstance(element.get("id"), str):
            raise ValueError(f"not an element: {element!r:.80}")


def encode(described: Mapping[str, Any], values: Mapping[str, Any]) -> bytes:
    """Return a result as a device sends it; ``values`` by id of element, records as lists."""
    return b"".join(_encode(described["elements"], values, described.get("format", {})))


def _encode(
    elements: list[dict[str, Any]], values: Mapping[str, Any], default: Mapping[str, Any]
) -> Iterator[bytes]:
    for element in elements:
        form = {**default, **element.get("format", {})}
        value = element.get("value", values.get(element.get("id", "")))
        if element["type"] == "records":
            for record in value or ():
                yield from _encode(element["elements"], record, form)
        elif element["type"] == "blob":
            yield value or b""
        elif element["type"] == "string" or form.get("dataencoding", "ascii") == "ascii":
            yield _text(value, element["type"], form).encode()
        else:
            code = _CODES[element["type"]]
            number = float(value or 0) if code in "fd" else int(value or 0)
            yield struct.pack(("<" if form.get("order") == "little" else ">") + code, number)


def _text(value: Any, kind: str, form: Mapping[str, Any]) -> str:
    """Return a value as ASCII; ``scale`` and ``offset`` are applied to numbers."""
    text = "" if value is None else str(value)
    if kind != "string":
        number = float(value or 0) * form.get("scale", 1) + form.get("offset", 0)
        text = f"{number:.{form.get('precision', 4)}f}" if kind[0] == "f" else f"{number:.0f}"
        text = text.replace(".", form.get("decimalseparator", "."))
    width, fill = form.get("width", 0), form.get("fill", " ")
    text = text[:width] if width and kind == "string" else text
    return text.ljust(width, fill) if form.get("alignment") == "left" else text.rjust(width, fill)
