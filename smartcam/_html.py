"""Format values as tables for notebooks, for ``_repr_html_`` of the public values."""

from __future__ import annotations

import math
from html import escape
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from smartcam.models import Localization, Result

MAX_ROWS = 100
"""Largest number of rows that are shown; a line below gives the number of the others."""


def localizations_html(localizations: Sequence[Localization]) -> str:
    """Return a table of localized parts, in millimetres and degrees."""
    return _table(
        ("part", "quality", "x mm", "y mm", "z mm", "angle deg"), map(_part_row, localizations)
    )


def result_html(result: Result) -> str:
    """Return a table of a result's fields; localizations and records have a table of their own."""
    value: Any = result.value
    fields = {
        "camera": result.camera,
        "application": result.application,
        "number": result.number,
        "received": f"{result.received_at:%Y-%m-%d %H:%M:%S} UTC",
        "latency": "" if result.latency is None else f"{1e3 * result.latency:.0f} ms",
        "raw": f"{len(result.raw)} bytes",
        "value": _value_text(value),
    }
    rows = [[name, str(text)] for name, text in fields.items() if text != ""]
    if _is_localizations(value):
        return _table((), rows) + localizations_html(value)
    return _table((), rows) + (records_html(value) if _is_records(value) else "")


def _value_text(value: Any) -> str:
    """Return the text of a value in the table of its result."""
    if _is_localizations(value):
        return f"{len(value)} localizations"
    if _is_records(value):
        return f"{len(value)} records" if isinstance(value, list) else "a record"
    return f"{value!r:.1000}"


def _is_records(value: Any) -> bool:
    items: Any = value if isinstance(value, list) else [value]
    return bool(items) and all(hasattr(type(item), "_units") for item in items)


def records_html(value: Any) -> str:
    """Return a table of a record of a layout, or of several, with the units in its header."""
    records: Sequence[Any] = value if isinstance(value, list) else [value]
    kind: Any = type(records[0])
    units = kind._units  # noqa: SLF001 - public for records, as is _fields
    names = [f"{name} [{units[name]}]" if name in units else name for name in kind._fields]
    return _table(names, ([_cell(field) for field in record] for record in records))


def _cell(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else f"{value!s:.1000}"


def _is_localizations(value: object) -> bool:
    items: Any = value if isinstance(value, list) else ()
    return bool(items) and all(hasattr(item, "feature_id") for item in items)


def _part_row(part: Localization) -> list[str]:
    x, y, z = (f"{1e3 * length:.3f}" for length in part.pose.position)
    angle = math.degrees(part.pose.orientation.theta)
    return [part.feature_id, f"{part.quality:.3f}", x, y, z, f"{angle:.2f}"]


def _table(names: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    listed = list(rows)
    head = f"<tr>{_cells('th', names)}</tr>" if names else ""
    body = "".join(f"<tr>{_cells('td', row)}</tr>" for row in listed[:MAX_ROWS])
    hidden_count = len(listed) - MAX_ROWS
    last_line = f"<p>and {hidden_count} more</p>" if hidden_count > 0 else ""
    return f"<table>{head}{body}</table>{last_line}"


def _cells(kind: str, texts: Iterable[str]) -> str:
    return "".join(f"<{kind}>{escape(text)}</{kind}>" for text in texts)
