"""Check results: whether the layout fits, and whether the values look like SI."""

from __future__ import annotations

import math
import re
import struct
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.doctor._context import application_text
from smartcam.doctor._findings import Exit
from smartcam.exceptions import hex_excerpt
from smartcam.interpreters._inside import LocalizationsInterpreter
from smartcam.layout._inside import SI_SYMBOLS, UNITS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from smartcam.doctor._context import Examination, Reading
    from smartcam.exceptions import InterpretationError
    from smartcam.interpreters import Interpreter
    from smartcam.layout import Layout
    from smartcam.layout._inside import Field
    from smartcam.models import ByteOrder, Result

MAX_ROWS = 40
"""Largest number of rows of a dump of a container: they fit on a screen."""


# ---------------------------------------------------------------------- the layout


class DumpRow(NamedTuple):
    """One field of the layout, with a container's bytes at its offset.

    Attributes:
        offset: position of the field's first byte, from the start of the container's data.
        field: name and type of the field.
        hex: the bytes at its offset, as hex, at most 32.
        value: value of the bytes, or a text about missing or extra bytes.
    """

    offset: int
    field: str
    hex: str
    value: Any


def dump_container(
    layout: Layout, data: bytes, order: ByteOrder = "little", *, shown_offset: int = 0
) -> list[DumpRow]:
    """Return a layout's fields, each with a container's bytes, even if they do not fit.

    ``data``: bytes after the application id. ``order``: byte order of numbers. ``shown_offset``:
    an offset that must be among the rows: repeated records long before it are left out.
    """
    rows: list[DumpRow] = []
    end = 0
    for offset, name, field in _field_places(layout, len(data), shown_offset):
        if len(rows) >= MAX_ROWS:
            rows.append(DumpRow(offset, "...", "", ""))
            return rows
        end = offset + field.size
        field_bytes = data[offset:end]
        label = f"{name}: {str(field).partition(': ')[2]}"
        missing = field.size - len(field_bytes)
        value = (
            f"{missing} of {field.size} bytes are missing"
            if missing
            else _decode_value(field, field_bytes, order)
        )
        rows.append(DumpRow(offset, label, field_bytes[:32].hex(" "), value))
    if len(data) > end:
        rows.append(
            DumpRow(
                end,
                "(no field)",
                data[end : end + 32].hex(" "),
                f"{len(data) - end} bytes too many",
            )
        )
    return rows


def _field_places(layout: Layout, size: int, shown_offset: int) -> Iterator[tuple[int, str, Field]]:
    """Yield offset, name and field of each field that a layout has in ``size`` bytes."""
    offset = 0
    for field in layout.head:
        yield offset, field.name, field
        offset += field.size
    record, repeat = layout.size, layout.repeat
    records_fit = max(0, math.ceil((size - offset) / record))
    count = 1 if repeat is None else repeat if isinstance(repeat, int) else records_fit
    first = min(max(0, (shown_offset - offset) // record - 1), max(0, count - 1))
    for number in range(first, count):
        field_offset = offset + number * record
        for field in layout.fields:
            yield field_offset, field.name if repeat is None else f"[{number}].{field.name}", field
            field_offset += field.size


def _decode_value(field: Field, raw: bytes, order: ByteOrder) -> Any:
    if field.type == "string":
        return raw.partition(b"\0")[0].decode(errors="replace")
    return struct.unpack((">" if order == "big" else "<") + field.wire.code, raw)[0]


def _size_text(layout: Layout) -> str:
    head, repeat = layout.head_size, layout.repeat
    if repeat is None:
        return f"{layout.size} bytes"
    head_text = f"{head} bytes and " if head else ""
    if isinstance(repeat, int):
        return f"{head + repeat * layout.size} bytes"
    return f"{head_text}whole records of {layout.size} bytes"


async def look_at_results(exam: Examination) -> None:
    """Check ``layout`` and ``values``: compare the results with ``--interpret-as``."""
    containers, interpreter = list(exam.recorder.last_results), exam.options.interpreter
    unreadable = exam.recorder.read_error
    if unreadable is not None:
        exam.fail(
            f"a result came that cannot be read: {unreadable}",
            "Compare it with what the camera is told to send; smartcam watch and --trace show it.",
            exit_code=Exit.UNREADABLE,
        )
    elif not containers and interpreter is not None:
        exam.report(
            "hint",
            "no result came, so the layout was not compared with one",
            "With --trigger, or while the application runs free, there are results.",
        )
    elif containers and interpreter is None:
        sizes = sorted({len(result.raw) for result in containers})
        exam.report(
            "ok",
            f"{len(containers)} results looked at, of {_sizes_text(sizes)} bytes: "
            f"{hex_excerpt(containers[0].raw)}; --interpret-as compares them with a layout",
            sizes=sizes,
            first=containers[0].raw,
        )
    elif interpreter is not None:
        _compare(exam, interpreter, containers)


def _compare(exam: Examination, interpreter: Interpreter, containers: list[Result]) -> None:
    """Report the first result that does not fit the layout; if all fit, report on their values."""
    readings: list[Reading] = [result.value for result in containers]
    for result, reading in zip(containers, readings, strict=True):
        if reading.error is not None:
            _report_misfit(exam, interpreter, result, reading, reading.error)
            return
    fit = "were read" if interpreter.layout is None else f"fit the layout '{interpreter.layout}'"
    exam.report("ok", f"{len(readings)} results {fit}", results=len(readings))
    if interpreter.layout is not None:
        # for localizations, integers are metres and radians, too; elsewhere they may count pixels
        integers = isinstance(interpreter, LocalizationsInterpreter)
        _look_at_values(exam, interpreter.layout, readings, integers=integers)


def _sizes_text(sizes: Sequence[int]) -> str:
    shown = ", ".join(map(str, sizes[:8]))
    return shown + (" ..." if len(sizes) > 8 else "")


def _report_misfit(
    exam: Examination,
    interpreter: Interpreter,
    result: Result,
    reading: Reading,
    error: InterpretationError,
) -> None:
    layout, raw = interpreter.layout, reading.data
    details: dict[str, Any] = {
        "application": result.application,
        "offset": error.offset,
        "received": len(raw),
        "raw": raw,
    }
    text = f"a result of {application_text(result.application)} does not fit the layout: {error}"
    if layout is not None:
        details["expected"] = _size_text(layout)
        details["dump"] = dump_container(layout, raw, reading.byte_order, shown_offset=error.offset)
        text += f". The layout has {_size_text(layout)}, {len(raw)} came"
    exam.fail(
        text,
        'Compare it with the "send results" tool, field by field: which one is missing, of another '
        "type, or of another width? All fields after a wrong one are shifted.",
        exit_code=Exit.UNREADABLE,
        **details,
    )


# ---------------------------------------------------------------------- the values


class _PlausibilityLimit(NamedTuple):
    """The largest plausible value of a kind of field without a unit."""

    quantity: str  # quantity that such fields measure
    name_pattern: re.Pattern[str]  # pattern of the names of such fields
    largest: float  # largest plausible magnitude, SI
    meaning: str  # what a larger value probably is
    suggested_unit: str  # unit to write in the layout for it
    reason: str  # reason of the limit


def _name_pattern(words: str) -> re.Pattern[str]:
    """Return a pattern that finds words in a field's name; underscores or digits separate words."""
    return re.compile(rf"(?:^|[_\d])(?:{words})(?:$|[_\d])", re.IGNORECASE)


PLAUSIBILITY_LIMITS: tuple[_PlausibilityLimit, ...] = (
    _PlausibilityLimit(
        "angle",
        _name_pattern("theta|phi|psi|angle|rotation|orientation|roll|pitch|yaw"),
        2 * math.pi + 1e-6,
        "degrees",
        "deg",
        "cameras give angles of half a turn to either side, or of one turn",
    ),
    _PlausibilityLimit(
        "length",
        _name_pattern("x|y|z|width|height|length|distance|diameter|radius"),
        5.0,
        "millimetres (or pixels)",
        "mm",
        "a camera's field of view is below two metres, a robot's reach below five",
    ),
    _PlausibilityLimit(
        "ratio",
        _name_pattern("quality|score"),
        1.0 + 1e-6,
        "percent",
        "percent",
        "they go from 0 to 1",
    ),
)
"""Limits above which a value is implausible; the first one that fits the field's name applies."""


class _ConversionLimit(NamedTuple):
    """A bound: if all converted values of a unit are below, the camera may have sent SI units."""

    largest: float  # largest such magnitude, SI
    meaning: str  # unit that the camera may send instead
    reason: str  # reason of the limit


CONVERSION_LIMITS: dict[str, _ConversionLimit] = {
    "mm": _ConversionLimit(
        2e-3, "metres", "in metres, a camera with a field of view of 2 m sends values up to 2"
    ),
    "deg": _ConversionLimit(
        2 * math.pi * math.pi / 180 + 1e-6, "radians", "a turn is 6.28 in radians, 360 in degrees"
    ),
}
"""Limits, by unit. If all values are smaller than the limit, the camera may have sent SI units. But
the values of parts within two millimetres of the origin, or turned by less than six degrees, are as
small, so the finding is only a hint."""

PLAUSIBLE_REAL_RANGE = (1e-20, 1e20)
"""Range of plausible reals; others, except zero, are probably bytes of other types."""


def _look_at_values(
    exam: Examination, layout: Layout, readings: list[Reading], *, integers: bool
) -> None:
    """Report each field whose values are not plausible in its unit or, without one, in SI."""
    largest: dict[str, float] = {}  # largest magnitude by field
    # converted values, by unit
    converted: dict[str, dict[str, float]] = {unit: {} for unit in CONVERSION_LIMITS}
    absurd_values: dict[str, float] = {}
    fields = [f for f in layout.fields if f.wire.is_number and (integers or not f.wire.is_integer)]
    for reading in readings:
        for record in layout.parse_records(reading.data, reading.byte_order):
            for field in fields:
                value = abs(float(getattr(record, field.name)))
                if (
                    value
                    and not field.wire.is_integer
                    and not PLAUSIBLE_REAL_RANGE[0] < value < PLAUSIBLE_REAL_RANGE[1]
                ):
                    absurd_values.setdefault(field.name, value)
                elif field.unit is None:
                    largest[field.name] = max(value, largest.get(field.name, 0.0))
                elif field.unit in CONVERSION_LIMITS and not field.wire.is_integer:
                    magnitudes_of_unit = converted[field.unit]
                    magnitudes_of_unit[field.name] = max(
                        value, magnitudes_of_unit.get(field.name, 0.0)
                    )
    for unit, magnitudes in converted.items():
        _hint_at_si_values(exam, unit, magnitudes)
    for name, value in absurd_values.items():
        exam.report(
            "hint",
            f"{name} has values such as {value:g}, which no camera measures",
            "A field before it is missing or has another type, so that all after it are shifted; "
            "or the camera sends no real number there.",
            check="values",
            field=name,
            value=value,
        )
    for name, value in largest.items():
        rule = next((rule for rule in PLAUSIBILITY_LIMITS if rule.name_pattern.search(name)), None)
        if rule is not None and value > rule.largest:
            field = next(field for field in fields if field.name == name)
            exam.report(
                "hint",
                f"{name} goes up to {value:g}: as {_SI_UNIT_TEXTS[rule.quantity]} that is not "
                f"plausible, it looks like {rule.meaning}",
                f"Write {name}: {field.type_text} {rule.suggested_unit} in the layout, and the "
                "value comes in SI.",
                check="values",
                field=name,
                value=value,
                most=rule.largest,
            )


def _hint_at_si_values(exam: Examination, unit: str, magnitudes: Mapping[str, float]) -> None:
    """Report if all values in a unit are so small that the camera may have sent SI units."""
    rule, largest = CONVERSION_LIMITS[unit], max(magnitudes.values(), default=0.0)
    if not 0.0 < largest <= rule.largest:
        return
    unit_definition, names = UNITS[unit], ", ".join(magnitudes)
    symbol = SI_SYMBOLS[unit_definition.quantity]
    sent = largest * unit_definition.divide / unit_definition.multiply
    exam.report(
        "hint",
        f"{names}: no more than {sent:.4g} {unit}, which looks like {rule.meaning}: {rule.reason}",
        f"If the camera sends {rule.meaning}, write {symbol} instead of {unit} in the layout.",
        check="values",
        field=names,
        value=largest,
        most=rule.largest,
    )


_SI_UNIT_TEXTS = {"angle": "radians", "length": "metres", "ratio": "a ratio from 0 to 1"}
