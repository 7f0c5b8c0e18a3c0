"""Check results: whether the layout fits, and whether the values look like SI."""

from __future__ import annotations

import math
import re
import struct
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.doctor._context import called
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
"""Largest number of rows of a dump: a screen."""


# ---------------------------------------------------------------------- the layout


class DumpRow(NamedTuple):
    """One field of a container by the layout, with the bytes at its place.

    Attributes:
        offset: place of the field's first byte, from the start of the container's data.
        field: name and type of the field.
        hex: the bytes at its place, at most 32.
        value: meaning of the bytes; or the number that is missing or left over.
    """

    offset: int
    field: str
    hex: str
    value: Any


def aligned(
    layout: Layout, data: bytes, order: ByteOrder = "little", *, around: int = 0
) -> list[DumpRow]:
    """Return a container's bytes beside a layout's fields, even if they do not fit.

    ``data``: bytes after the application id. ``order``: byte order of numbers. ``around``:
    an offset that must be among the rows: repeated records long before it are left out.
    """
    rows: list[DumpRow] = []
    end = 0
    for offset, name, field in _places(layout, len(data), around):
        if len(rows) >= MAX_ROWS:
            rows.append(DumpRow(offset, "...", "", ""))
            return rows
        end = offset + field.size
        raw = data[offset:end]
        label = f"{name}: {str(field).partition(': ')[2]}"
        missing = field.size - len(raw)
        value = (
            f"{missing} of {field.size} bytes are missing" if missing else _value(field, raw, order)
        )
        rows.append(DumpRow(offset, label, raw[:32].hex(" "), value))
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


def _places(layout: Layout, size: int, around: int) -> Iterator[tuple[int, str, Field]]:
    """Yield offset, name and field of all fields of the layout in ``size`` bytes."""
    offset = 0
    for field in layout.head:
        yield offset, field.name, field
        offset += field.size
    record, repeat = layout.size, layout.repeat
    records_fit = max(0, math.ceil((size - offset) / record))
    count = 1 if repeat is None else repeat if isinstance(repeat, int) else records_fit
    first = min(max(0, (around - offset) // record - 1), max(0, count - 1))
    for number in range(first, count):
        begin = offset + number * record
        for field in layout.fields:
            yield begin, field.name if repeat is None else f"[{number}].{field.name}", field
            begin += field.size


def _value(field: Field, raw: bytes, order: ByteOrder) -> Any:
    if field.type == "string":
        return raw.partition(b"\0")[0].decode(errors="replace")
    return struct.unpack((">" if order == "big" else "<") + field.wire.code, raw)[0]


def _size_text(layout: Layout) -> str:
    head, repeat = layout.head_size, layout.repeat
    if repeat is None:
        return f"{layout.size} bytes"
    front = f"{head} bytes and " if head else ""
    if isinstance(repeat, int):
        return f"{head + repeat * layout.size} bytes"
    return f"{front}whole records of {layout.size} bytes"


async def look_at_results(exam: Examination) -> None:
    """Check ``layout`` and ``values``: compare the results with ``--interpret-as``."""
    containers, interpreter = list(exam.witness.containers), exam.options.interpreter
    unreadable = exam.witness.unreadable
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
            f"{len(containers)} results looked at, of {_listed(sizes)} bytes: "
            f"{hex_excerpt(containers[0].raw)}; --interpret-as compares them with a layout",
            sizes=sizes,
            first=containers[0].raw,
        )
    elif interpreter is not None:
        _compare(exam, interpreter, containers)


def _compare(exam: Examination, interpreter: Interpreter, containers: list[Result]) -> None:
    """Report the first result that does not fit, or that all fit and how their values look."""
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


def _listed(sizes: Sequence[int]) -> str:
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
    text = f"a result of {called(result.application)} does not fit the layout: {error}"
    if layout is not None:
        details["expected"] = _size_text(layout)
        details["dump"] = aligned(layout, raw, reading.byte_order, around=error.offset)
        text += f". The layout has {_size_text(layout)}, {len(raw)} came"
    exam.fail(
        text,
        'Compare it with the "send results" tool, field by field: which one is missing, of another '
        "type, or of another width? All fields after a wrong one are shifted.",
        exit_code=Exit.UNREADABLE,
        **details,
    )


# ---------------------------------------------------------------------- the values


class _Plausible(NamedTuple):
    """The plausible values of a field without a unit."""

    quantity: str  # quantity that such fields measure
    names: re.Pattern[str]  # pattern of the names of such fields
    most: float  # the largest magnitude that is plausible, SI
    text: str  # description of a larger value
    unit: str  # unit to write after the type then
    reason: str  # reason of the limit


def _named(words: str) -> re.Pattern[str]:
    """Return a pattern of words in a field's name, parted by underscores or digits."""
    return re.compile(rf"(?:^|[_\d])(?:{words})(?:$|[_\d])", re.IGNORECASE)


PLAUSIBLE: tuple[_Plausible, ...] = (
    _Plausible(
        "angle",
        _named("theta|phi|psi|angle|rotation|orientation|roll|pitch|yaw"),
        2 * math.pi + 1e-6,
        "degrees",
        "deg",
        "cameras give angles of half a turn to either side, or of one turn",
    ),
    _Plausible(
        "length",
        _named("x|y|z|width|height|length|distance|diameter|radius"),
        5.0,
        "millimetres (or pixels)",
        "mm",
        "a camera's field of view is below two metres, a robot's reach below five",
    ),
    _Plausible(
        "ratio",
        _named("quality|score"),
        1.0 + 1e-6,
        "percent",
        "percent",
        "they go from 0 to 1",
    ),
)
"""Limits above which a value is implausible; the first row with the field's name counts."""


class _Converted(NamedTuple):
    """The signs of a field with a unit whose values were in SI already."""

    most: float  # largest magnitude, SI, that looks so
    text: str  # text that the camera may send instead
    reason: str  # reason of the limit


CONVERTED: dict[str, _Converted] = {
    "mm": _Converted(
        2e-3, "metres", "a camera whose field of view is two metres sends up to 2 for it in metres"
    ),
    "deg": _Converted(
        2 * math.pi * math.pi / 180 + 1e-6, "radians", "a turn is 6.28 in radians, 360 in degrees"
    ),
}
"""Limits, by unit, below which all values look like SI that was converted again. Parts
that all lie within two millimetres, or are turned by less than six degrees, look the same: so the
hint only asks."""

PLAUSIBLE_REALS = (1e-20, 1e20)
"""Reals outside of these limits, except zero, are probably bytes of other types."""


def _look_at_values(
    exam: Examination, layout: Layout, readings: list[Reading], *, integers: bool
) -> None:
    """Give a hint for each field whose values are not plausible in its unit, or without one."""
    largest: dict[str, float] = {}  # largest magnitude by field
    # converted values, by unit
    converted: dict[str, dict[str, float]] = {unit: {} for unit in CONVERTED}
    nonsense: dict[str, float] = {}
    fields = [f for f in layout.fields if f.wire.is_number and (integers or not f.wire.is_integer)]
    for reading in readings:
        for record in layout.parse_records(reading.data, reading.byte_order):
            for field in fields:
                value = abs(float(getattr(record, field.name)))
                if (
                    value
                    and not field.wire.is_integer
                    and not PLAUSIBLE_REALS[0] < value < PLAUSIBLE_REALS[1]
                ):
                    nonsense.setdefault(field.name, value)
                elif field.unit is None:
                    largest[field.name] = max(value, largest.get(field.name, 0.0))
                elif field.unit in CONVERTED and not field.wire.is_integer:
                    of_unit = converted[field.unit]
                    of_unit[field.name] = max(value, of_unit.get(field.name, 0.0))
    for unit, magnitudes in converted.items():
        _ask_for_si(exam, unit, magnitudes)
    for name, value in nonsense.items():
        exam.report(
            "hint",
            f"{name} has values such as {value:g}, which nothing measures",
            "A field before it is missing or has another type, so that all after it are shifted; "
            "or the camera sends no real number there.",
            check="values",
            field=name,
            value=value,
        )
    for name, value in largest.items():
        rule = next((rule for rule in PLAUSIBLE if rule.names.search(name)), None)
        if rule is not None and value > rule.most:
            kind = next(field for field in fields if field.name == name)
            exam.report(
                "hint",
                f"{name} goes up to {value:g}: as {_SI[rule.quantity]} that is not plausible, it "
                f"looks like {rule.text}",
                f"Write {name}: {kind.type_text} {rule.unit} in the layout, and the value comes "
                "in SI.",
                check="values",
                field=name,
                value=value,
                most=rule.most,
            )


def _ask_for_si(exam: Examination, unit: str, values: Mapping[str, float]) -> None:
    """Give a hint if the values of all fields with a unit look as if they had been SI already."""
    rule, most = CONVERTED[unit], max(values.values(), default=0.0)
    if not 0.0 < most <= rule.most:
        return
    made, names = UNITS[unit], ", ".join(values)
    symbol = SI_SYMBOLS[made.quantity]
    exam.report(
        "hint",
        f"{names}: no more than {most * made.divide / made.multiply:.4g} {unit}, which looks like "
        f"{rule.text}: {rule.reason}",
        f"If the camera sends {rule.text}, write {symbol} instead of {unit} in the layout.",
        check="values",
        field=names,
        value=most,
        most=rule.most,
    )


_SI = {"angle": "radians", "length": "metres", "ratio": "a ratio from 0 to 1"}
