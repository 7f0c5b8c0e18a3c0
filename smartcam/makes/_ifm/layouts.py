"""Convert layouts of results to PCIC's JSON, and encode results for the emulated sensor."""

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

RESULT_MARK = "smartcam;"
"""Text at the beginning of each result in a layout that smartcam has uploaded, and of no other
result."""

_ELEMENT_TYPES: Mapping[str, tuple[str, str]] = {
    **{f"int{bits}": (f"int{bits}", code) for bits, code in ((8, "b"), (16, "h"), (32, "i"))},
    **{f"uint{bits}": (f"uint{bits}", code) for bits, code in ((8, "B"), (16, "H"), (32, "I"))},
    "real32": ("float32", "f"),
    "real64": ("float64", "d"),
    "bool": ("uint8", "B"),
}
"""For each type of smartcam's layouts: ifm's name, and the letter for ``struct``."""

_STRUCT_CODES: Mapping[str, str] = dict(_ELEMENT_TYPES.values())

MAX_DEPTH = 8
"""Largest depth of nested records of a layout."""


def layout_json(layout: Layout) -> str:
    """Return the JSON that makes a device send the fields of a layout in binary.

    Raises:
        ConfigurationError: the device has no such type, or the layout fixes the number of records.
    """
    elements: list[dict[str, Any]] = [
        {"type": "string", "value": RESULT_MARK, "id": "start_string"}
    ]
    elements += map(_describe_field, layout.head)
    fields = [_describe_field(field) for field in layout.fields]
    if isinstance(layout.repeat, int):
        raise ConfigurationError(
            f"ifm: a layout cannot fix the number of records; write ( ... )*: {layout.text}"
        )
    if layout.repeat is None:
        elements += fields
    else:
        elements.append({"type": "records", "id": layout.group or "records", "elements": fields})
    element_format = {"dataencoding": "binary", "order": "little"}
    return json.dumps({"layouter": "flexible", "format": element_format, "elements": elements})


def _describe_field(field: Field) -> dict[str, Any]:
    if field.type == "string":
        text_format = {"width": field.size, "fill": "\0", "alignment": "left"}
        return {"type": "string", "id": field.name, "format": text_format}
    if field.type not in _ELEMENT_TYPES:
        raise ConfigurationError(f"ifm: a device has no {field.type}: {field.label}")
    return {"type": _ELEMENT_TYPES[field.type][0], "id": field.name}


def convert_bools(layout: Layout, data: bytes) -> bytes:
    """Return a result's bytes with each bool as smartcam's layouts have it: 1 becomes 0xFF."""
    if not any(field.type == "bool" for field in (*layout.head, *layout.fields)):
        return data
    head_size, record_size = (
        sum(field.size for field in fields) for fields in (layout.head, layout.fields)
    )
    record_offsets = (
        range(head_size, len(data), record_size) if layout.repeat is not None else (head_size,)
    )
    converted = bytearray(data)
    for start, fields in ((0, layout.head), *((start, layout.fields) for start in record_offsets)):
        offsets = itertools.accumulate((field.size for field in fields), initial=start)
        for offset, field in zip(offsets, fields, strict=False):
            if field.type == "bool" and data[offset : offset + 1] == b"\x01":
                converted[offset] = 0xFF
    return bytes(converted)


def check_layout(text: str) -> dict[str, Any]:
    """Return a layout from the JSON of a client; raise ValueError if a device would refuse it."""
    description = json.loads(text)
    if not isinstance(description, dict) or description.get("layouter") != "flexible":
        raise ValueError('the layouter is not "flexible"')
    _check_elements(description.get("elements"), MAX_DEPTH)
    return description


def _check_elements(elements: object, depth: int) -> None:
    if depth < 1:
        raise ValueError(f"records are nested deeper than {MAX_DEPTH}")
    if not isinstance(elements, list):
        raise ValueError(f"not a list of elements: {elements!r:.80}")  # noqa: TRY004
    for element in elements:
        element_type = element.get("type") if isinstance(element, dict) else None
        if element_type == "records":
            _check_elements(element.get("elements"), depth - 1)
        elif element_type not in {"string", "blob", *_STRUCT_CODES} or not isinstance(
            element.get("id"), str
        ):
            raise ValueError(f"not an element: {element!r:.80}")


def encode(layout: Mapping[str, Any], values: Mapping[str, Any]) -> bytes:
    """Return a result as a device sends it; ``values`` are by id of element, records are lists."""
    return b"".join(_encode_elements(layout["elements"], values, layout.get("format", {})))


def _encode_elements(
    elements: list[dict[str, Any]], values: Mapping[str, Any], default: Mapping[str, Any]
) -> Iterator[bytes]:
    for element in elements:
        element_format = {**default, **element.get("format", {})}
        value = element.get("value", values.get(element.get("id", "")))
        if element["type"] == "records":
            for record in value or ():
                yield from _encode_elements(element["elements"], record, element_format)
        elif element["type"] == "blob":
            yield value or b""
        elif element["type"] == "string" or element_format.get("dataencoding", "ascii") == "ascii":
            yield _encode_text(value, element["type"], element_format).encode()
        else:
            code = _STRUCT_CODES[element["type"]]
            number = float(value or 0) if code in "fd" else int(value or 0)
            yield struct.pack(
                ("<" if element_format.get("order") == "little" else ">") + code, number
            )


def _encode_text(value: Any, element_type: str, element_format: Mapping[str, Any]) -> str:
    """Return a value as ASCII; ``scale`` and ``offset`` are applied to numbers."""
    text = "" if value is None else str(value)
    if element_type != "string":
        number = float(value or 0) * element_format.get("scale", 1) + element_format.get(
            "offset", 0
        )
        text = (
            f"{number:.{element_format.get('precision', 4)}f}"
            if element_type[0] == "f"
            else f"{number:.0f}"
        )
        text = text.replace(".", element_format.get("decimalseparator", "."))
    width, fill = element_format.get("width", 0), element_format.get("fill", " ")
    text = text[:width] if width and element_type == "string" else text
    return (
        text.ljust(width, fill)
        if element_format.get("alignment") == "left"
        else text.rjust(width, fill)
    )
