"""Values as text for people."""

from __future__ import annotations

import math
import shlex
from typing import TYPE_CHECKING, Any

from smartcam.exceptions import NotRunningError, hex_excerpt

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from smartcam.camera import Camera
    from smartcam.emulator import WireCamera
    from smartcam.layout import Layout
    from smartcam.layout._inside import ShownUnits
    from smartcam.models import Localization, Result


MAX_SIGNIFICANT_DIGITS = 6
"""Number of significant digits of the largest number in a column."""

MIN_ALIGNED, MAX_ALIGNED = 1e-3, 1e6
"""Range of a column's largest number within which the column's decimal points are aligned."""


def table_text(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return rows as aligned columns; numbers to the right, with aligned decimal points."""
    cells = [*zip(*map(_column, zip(*rows, strict=True)), strict=True)]
    widths = [max(len(text) for text in column) for column in zip(head, *cells, strict=True)]
    numeric = [bool(rows) and isinstance(value, (int, float)) for value in (rows or [head])[0]]
    lines = [
        "  ".join(
            text.rjust(width) if right else text.ljust(width)
            for text, width, right in zip(line, widths, numeric, strict=True)
        ).rstrip()
        for line in [list(head), *cells]
    ]
    return "\n".join("  " + line for line in lines)


def _column(values: Sequence[object]) -> list[str]:
    """Return a column's cells: floats with as many decimals as the largest needs for 6 digits."""
    floats = [value for value in values if isinstance(value, float) and math.isfinite(value)]
    largest = max(map(abs, floats), default=0.0)
    if len(floats) < len(values) or not MIN_ALIGNED <= largest < MAX_ALIGNED:
        return [_cell(value) for value in values]
    decimals = max(0, MAX_SIGNIFICANT_DIGITS - 1 - math.floor(math.log10(largest)))
    if any(0 < abs(value) < 10**-decimals for value in floats):
        return [_cell(value) for value in values]  # some would have no digits left
    texts = [f"{value:.{decimals}f}" for value in floats]
    needless = min(len(text) - len(text.rstrip("0")) for text in texts) if decimals else 0
    return [text[: len(text) - needless].removesuffix(".") for text in texts]


def emulator_data(emulator: WireCamera) -> dict[str, Any]:
    """Return an emulated camera's address and applications, for JSON."""
    return {
        "url": emulator.url,
        "host": emulator.host,
        "port": emulator.port,
        "transport": emulator.transport,
        "dialect": emulator.dialect,
        "applications": sorted(emulator.application_ids),
    }


def application_text(application: int | None) -> str:
    """Return the text of an application's id; some cameras' jobs have no id."""
    from smartcam.protocols.messages import UNNAMED_APPLICATION

    if application == UNNAMED_APPLICATION:
        return "application without an id"
    return f"application {application}"


def not_running_error(error: NotRunningError, camera: Camera, verb: str) -> NotRunningError:
    """Return the error with advice how to start the camera; ``verb``: the command that failed."""
    return NotRunningError(
        f"{error}. To start it: smartcam start {shlex.quote(camera.url)}, or {verb} with "
        f"--application {camera.active_application}"
    )


def result_text(result: Result, units: ShownUnits, layout: Layout | None) -> str:
    """Return a result: a line about it, then its value.

    ``units``: units in which values are shown. ``layout``: layout of the value, which has the units
    of a table's columns.
    """
    latency = f", {1e3 * result.latency:.1f} ms after its trigger" if result.latency else ""
    sequence = f", sequence {result.sequence}" if result.sequence is not None else ""
    return (
        f"result {result.number} of {application_text(result.application)}{sequence}{latency}\n"
        f"{value_text(result.value, units, layout)}"
    )


def value_text(value: Any, units: ShownUnits, layout: Layout | None) -> str:
    """Return an interpreter's value as text; arguments as for :func:`result_text`."""
    from smartcam.layout._inside import units_of
    from smartcam.models import Localization, jsonable

    if isinstance(value, bytes):
        return f"  {hex_excerpt(value)}"
    if isinstance(value, list) and value and all(isinstance(v, Localization) for v in value):
        return _localizations_text(value, units)
    plain, symbols = jsonable(value), units_of(value, layout)
    if isinstance(plain, dict):
        lists = {name: units_of(getattr(value, name, None)) for name in plain}
        texts = (_field_text(name, field, symbols, units, lists) for name, field in plain.items())
        return "\n".join(texts)
    if _is_table(plain):
        return _records_text(plain, symbols, units)
    if isinstance(plain, list):
        return "\n".join(f"  {_cell(item)}" for item in plain) or "  (nothing)"
    return f"  {_cell(plain)}"


def _is_table(plain: Any) -> bool:
    return isinstance(plain, list) and bool(plain) and all(isinstance(item, dict) for item in plain)


def _field_text(
    name: str,
    value: Any,
    symbols: Mapping[str, str],
    units: ShownUnits,
    lists: Mapping[str, Mapping[str, str]],
) -> str:
    """Return a field's line; for a list of records, a table.

    ``lists``: units of the records' fields, by the name of the list.
    """
    if _is_table(value):
        return f"  {name}:\n{_records_text(value, lists[name], units)}"
    symbol = symbols.get(name, "")
    text = f"  {name} = {_cell(units.shown(value, symbol))}"
    return f"{text} {units.of(symbol).name}" if symbol else text


def _records_text(rows: list[dict[str, Any]], symbols: Mapping[str, str], units: ShownUnits) -> str:
    """Return a table with a row for each record, and the units in the headings."""
    heads = [_heading(name, symbols.get(name, ""), units) for name in rows[0]]
    cells = [
        [units.shown(value, symbols.get(name, "")) for name, value in row.items()] for row in rows
    ]
    return table_text(heads, cells)


def _heading(name: str, symbol: str, units: ShownUnits) -> str:
    return f"{name} [{units.of(symbol).name}]" if symbol else name


def _localizations_text(parts: list[Localization], units: ShownUnits) -> str:
    """Return a table of parts: x, y and theta in the plane; else position and quaternion."""
    head: tuple[str, ...]
    rows: list[tuple[object, ...]]
    if any(pose.position.z or any(pose.orientation[:2]) for *_, pose in parts):
        head = ("x", "y", "z", "qx", "qy", "qz", "qw")
        rows = [(*part.pose.position, *part.pose.orientation) for part in parts]
    else:
        head = ("x", "y", "theta")
        rows = [(*part.pose.position[:2], part.pose.orientation.theta) for part in parts]
    names = ("feature_id", "quality", *head)
    all_rows = [(*part[:2], *row) for part, row in zip(parts, rows, strict=True)]
    symbols = {"x": "m", "y": "m", "z": "m", "theta": "rad"}
    return _records_text([dict(zip(names, row, strict=True)) for row in all_rows], symbols, units)


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    text = str(value)
    # a camera's text stays in its cell: no line breaks, no control characters
    return "".join(char if char.isprintable() else ascii(char)[1:-1] for char in text)
