"""Values that come as texts, put into the bytes of a layout: a spreadsheet's cells.

So that every interpreter reads them as it reads a container, in the layout's units.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

from smartcam.exceptions import InterpretationError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from smartcam.layout import Layout
    from smartcam.layout.text import Field

__all__ = ["pack_texts"]

_BOOLS = {"0": 0x00, "1": 0xFF}


def pack_texts(layout: Layout, cells: Sequence[tuple[str, str | None]]) -> bytes:
    """Return the little-endian bytes of a layout whose fields are these texts, in order.

    Numbers are what they are on the wire: in the field's own unit, not in SI.

    Args:
        layout: the fields; a group takes as many records as there are cells for.
        cells: the name of each cell and its text; None for one that has none.

    Raises:
        InterpretationError: a text is no value of its field, or there are too few or too many.
    """
    fields = list(_fields(layout, len(cells)))
    if len(fields) != len(cells):
        raise InterpretationError(
            f"{len(cells)} cells came, the layout has {len(fields)} fields: {layout.text}",
            expected=len(fields),
            got=len(cells),
        )
    parts: list[bytes] = []
    offset = 0
    for field, (cell, text) in zip(fields, cells, strict=True):
        try:
            part = _pack(field, text)
        except (ValueError, OverflowError, struct.error) as exc:
            raise InterpretationError(
                f"{field.label}: cell {cell} holds {text!r:.64}: {exc}",
                field=field.name,
                offset=offset,
                expected=field.type_text,
                got=text,
            ) from exc
        parts.append(part)
        offset += len(part)
    return b"".join(parts)


def _fields(layout: Layout, count: int) -> Iterator[Field]:
    """Return the field of each cell, where there are ``count`` cells."""
    yield from layout.head
    repeat = layout.repeat
    left = max(0, count - len(layout.head))
    records = repeat if isinstance(repeat, int) else -(-left // len(layout.fields))
    for _ in range(1 if repeat is None else records):
        yield from layout.fields


def _pack(field: Field, text: str | None) -> bytes:
    """Return one field's bytes.

    Raises:
        ValueError, OverflowError, struct.error: it is no value of the field.
    """
    if text is None:
        raise ValueError("it has no value")
    if text.startswith("#ERR"):
        raise ValueError("its function failed")
    if field.type == "string":
        raw = text.encode()
        if len(raw) > field.size or b"\0" in raw:
            raise ValueError(f"no text of at most {field.size} bytes in UTF-8")
        return raw.ljust(field.size, b"\0")
    number: Any = float(text)
    if field.type == "bool":
        key = f"{number:g}"
        if key not in _BOOLS:
            raise ValueError("neither 0 nor 1")
        number = _BOOLS[key]
    elif field.wire.is_integer:
        number = _whole(text)
    return struct.pack("<" + field.wire.code, number)


def _whole(text: str) -> int:
    """Return a whole number, which may be written with decimals that are zeros."""
    whole, point, decimals = text.strip().partition(".")
    if point and decimals.strip("0"):
        raise ValueError("no whole number")
    return int(whole)
