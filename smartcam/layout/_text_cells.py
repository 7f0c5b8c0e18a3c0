"""Pack values that are texts, such as a spreadsheet's cells, into the bytes of a layout.

Every interpreter then reads these bytes like a container, in the layout's units.
"""

from __future__ import annotations

import math
import re
import struct
from typing import TYPE_CHECKING

from smartcam.exceptions import InterpretationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.layout import Layout
    from smartcam.layout._text import Field

_NUMBER = re.compile(
    r"(?P<whole>[+-]?[0-9]+)(?:\.0*)?|[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,4})?"
)


def pack_texts(layout: Layout, cells: Sequence[tuple[str, str | None]]) -> bytes:
    """Return the little-endian bytes of a layout whose fields have these texts, in order.

    Numbers are in the field's own unit, as on the wire, not in SI. If a field counts the
    records of a group, texts after the counted records are ignored, and may be missing.

    Args:
        layout: the fields; ``( ... )*`` and a counted group take as many records as the cells
            fill.
        cells: name and text of each cell; the text is None for a cell without one.

    Raises:
        InterpretationError: a text is no value of its field, or there are too few or too many
            cells.
    """
    fields = _cell_fields(layout, len(cells))
    used_count = len(fields)
    parts: list[bytes] = []
    offset = 0
    for index, (field, (cell, text)) in enumerate(zip(fields, cells, strict=True)):
        try:
            part = _pack_field(field, text) if index < used_count else bytes(field.size)
        except (ValueError, OverflowError) as exc:
            raise InterpretationError(
                f"{field.label}: cell {cell} holds {text!r:.64}: {exc}"
                if text is not None
                else f"{field.label}: cell {cell} has no value",
                field=field.name,
                offset=offset,
                expected=field.type_text,
                got=text,
            ) from exc
        parts.append(part)
        offset += len(part)
        # the head's field that counts the records
        if index < len(layout.head) and field.name == layout.repeat and text is not None:
            used_count = len(layout.head) + _parse_integer(text) * len(layout.fields)
    return b"".join(parts)


def _cell_fields(layout: Layout, count: int) -> Sequence[Field]:
    """Return the field of each of ``count`` cells; raise InterpretationError if they do not fit."""
    record_count = layout.repeat  # a number, the name of the field that counts them, or None
    if not isinstance(record_count, int):
        cells_of_records = max(0, count - len(layout.head))
        record_count = 1 if record_count is None else -(-cells_of_records // len(layout.fields))
    expected = len(layout.head) + record_count * len(layout.fields)
    if expected != count:
        cause = "" if count else "; ?cells=B2,C2 in the URL names those that are read"
        raise InterpretationError(
            f"{count} cells came, the layout has {expected} fields: {layout.text}{cause}",
            expected=expected,
            got=count,
        )
    return (*layout.head, *layout.fields * record_count)


def _pack_field(field: Field, text: str | None) -> bytes:
    """Return the bytes of one field; raise ValueError or OverflowError for a wrong value."""
    if text is None:
        raise ValueError("it has no value")
    if field.type == "string":
        raw = text.encode()
        if len(raw) > field.size or b"\0" in raw:
            raise ValueError(f"at most {field.size} bytes of UTF-8 without a zero were expected")
        return raw.ljust(field.size, b"\0")
    if field.type == "bool":
        number = _parse_integer(text)
        if number not in {0, 1}:
            raise ValueError("neither 0 nor 1")
        return b"\xff" if number else b"\0"
    low, high = field.wire.low, field.wire.high
    if low is not None and high is not None:
        number = _parse_integer(text)
        if not low <= number <= high:
            raise ValueError(f"{low} to {high} was expected")
        return struct.pack("<" + field.wire.code, number)
    return struct.pack("<" + field.wire.code, _parse_real(text))


def _parse_real(text: str) -> float:
    """Parse a number; raise ValueError if it is no number, or too large."""
    if not _NUMBER.fullmatch(text.strip()):
        raise ValueError("no number")
    number = float(text)
    if math.isinf(number):
        raise ValueError("too large")
    return number


def _parse_integer(text: str) -> int:
    """Parse an integer, perhaps with decimals that are zeros; raise ValueError for others."""
    match = _NUMBER.fullmatch(text.strip())
    if match is None or match["whole"] is None:
        raise ValueError("no whole number")
    return int(match["whole"])
