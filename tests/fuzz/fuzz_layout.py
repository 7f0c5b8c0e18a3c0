"""Target ``layout``: any text to a layout, and any payload through it in every direction.

Input: the text, a zero byte, a byte of :class:`Turn` flags, a number, then the payload.
"""

from __future__ import annotations

import enum
import json
import math
import pickle
from typing import Any

from smartcam.exceptions import ConfigurationError, InterpretationError, LayoutError
from smartcam.layout import Layout, Record
from smartcam.layout._inside import Field
from smartcam.models import ByteOrder, jsonable
from tests.fuzz.fuzz_input import Choices, text_of


class Turn(enum.IntFlag):
    """Uses of a layout beside parsing."""

    LENIENT = 1
    BIG = 2
    FIT = 4
    """The payload is made as long as the layout wants it."""
    DATA = 8
    YAML = 16
    MODEL = 32
    NO_TABLE = 64
    """Leave numpy out: it takes the most time."""


LARGEST = 2_000
"""Bytes of a fitted payload at most, for speed."""

EXACT = 1 << 52
"""Integers up to here keep their value as a float, whatever the unit."""


def check(data: bytes) -> None:
    """Read a layout text; parse a payload with it and build it again."""
    raw, _, tail = data.partition(b"\0")
    text = text_of(raw)
    choices = Choices(tail)
    turn, number = Turn(choices.byte() & 127), choices.byte()
    try:
        layout = Layout(text, lenient=Turn.LENIENT in turn)
    except LayoutError as error:
        check_refusal(error, text)
        return
    check_text(layout, text)
    if Turn.DATA in turn:
        assert Layout.from_dict(json.loads(json.dumps(layout.to_dict()))) == layout
    if Turn.YAML in turn:
        assert Layout.from_yaml(layout.to_yaml()) == layout
    payload = choices.rest()
    if Turn.FIT in turn:
        payload = fitted(layout, payload, number)
    order: ByteOrder = "big" if Turn.BIG in turn else "little"
    check_payload(layout, payload, order, turn)


# ---------------------------------------------------------------------- texts


def check_refusal(error: LayoutError, text: str) -> None:
    """A mistake has its place in the text, counted from where the text begins."""
    assert error.text == text
    assert 0 <= error.position <= len(text)
    assert len(str(error)) < 600 + 4 * 200
    again: Any = pickle.loads(pickle.dumps(error))  # noqa: S301 - our own
    assert (str(again), again.position, again.text) == (str(error), error.position, text)
    before = "name:\n"
    try:
        Layout(before + text, start=len(before))
    except LayoutError as shifted:
        assert shifted.position == error.position + len(before)
    else:
        raise AssertionError("with something before it, the text is none of a mistake")


def check_text(layout: Layout, text: str) -> None:
    """Assert that a layout that was read prints, and reads again as the same."""
    assert "\n" not in layout.text
    again = Layout(layout.text, lenient=layout.lenient)
    assert again == layout
    assert again.text == layout.text
    assert hash(again) == hash(layout)
    assert (again.fields, again.head, again.repeat, again.group) == (
        layout.fields,
        layout.head,
        layout.repeat,
        layout.group,
    )
    before = "table:"
    assert Layout(before + text, start=len(before), lenient=layout.lenient) == layout
    names = [field.name for field in (*layout.head, *layout.fields)]
    assert len(names) == len(set(names))
    assert all(name.isidentifier() for name in names)
    assert layout.size == sum(field.size for field in layout.fields) > 0
    assert layout.head_size == sum(field.size for field in layout.head)
    assert sum(field.sequence for field in (*layout.head, *layout.fields)) <= 1


# ---------------------------------------------------------------------- payloads


def fitted(layout: Layout, payload: bytes, number: int) -> bytes:
    """Return the payload cut, or filled with zeros, to a length that the layout may have."""
    count = layout.repeat if isinstance(layout.repeat, int) else number % 8
    size = layout.size if layout.repeat is None else layout.head_size + count * layout.size
    return payload[:size].ljust(min(size, LARGEST), b"\0")


def check_payload(layout: Layout, payload: bytes, order: ByteOrder, turn: Turn) -> None:
    """Parse a payload in every way; the ways must agree."""
    try:
        value = layout.parse(payload, order)
    except InterpretationError as error:
        check_misfit(error, layout, payload)
        for parse in (layout.parse_records, layout.sequence, layout.parse_table):
            try:
                parse(payload, order)
            except InterpretationError as other:
                check_misfit(other, layout, payload)
        return
    records = layout.parse_records(payload, order)
    if layout.repeat is None:
        assert repr([value]) == repr(records)
    elif layout.is_list:
        assert repr(value) == repr(records)
    else:
        assert repr(value[-1]) == repr(records)
    for record in records:
        check_values(record, layout.fields)
    json.dumps(jsonable(value), allow_nan=False).encode()
    check_sequence(layout, payload, order, value, records)
    if Turn.NO_TABLE not in turn:
        check_table(layout, payload, order, records)
    if Turn.MODEL in turn:
        layout.model.model_validate(value)
        json.dumps(layout.json_schema())
    check_building(layout, payload, order, value)


def check_misfit(error: InterpretationError, layout: Layout, payload: bytes) -> None:
    """Assert that an error has its place in the payload, and a field's name or none."""
    assert 0 <= error.offset <= len(payload)
    names = {field.name for field in (*layout.head, *layout.fields)}
    assert error.field in names | {""}
    assert len(str(error)) < 700


def check_values(record: Record, fields: tuple[Field, ...]) -> None:
    """Every value has its field's type and range."""
    assert record._fields == tuple(field.name for field in fields)
    for field, value in zip(fields, record, strict=True):
        if field.type == "string":
            assert isinstance(value, str)
            assert "\0" not in value
            assert len(value.encode()) <= field.size
        elif field.type == "bool":
            assert isinstance(value, bool)
        elif field.unit is not None or field.type.startswith("real"):
            assert isinstance(value, float)
        else:
            assert isinstance(value, int)
            assert (field.wire.low or 0) <= value <= (field.wire.high or 0)


def check_sequence(
    layout: Layout, payload: bytes, order: ByteOrder, value: Any, records: list[Record]
) -> None:
    """The sequence number is the value of its field."""
    number = layout.sequence(payload, order)
    field = layout.sequence_field
    if field is None:
        assert number is None
    elif field in layout.head:
        if not layout.is_list:
            assert number == value[layout.head.index(field)]
    else:
        assert number == (records[0][layout.fields.index(field)] if records else None)


def check_table(layout: Layout, payload: bytes, order: ByteOrder, records: list[Record]) -> None:
    """numpy sees what Python sees, to the last bit."""
    dtype = layout.dtype_for(order)
    assert dtype.itemsize == layout.size
    table = layout.parse_table(payload, order)
    assert table.shape == (len(records),)
    assert not table.flags.writeable
    for field in layout.fields:
        column: list[Any] = table[field.name].tolist()
        if field.type == "string":
            column = [raw.partition(b"\0")[0].decode() for raw in column]
        assert repr(column) == repr([record[field.name] for record in records])


# ---------------------------------------------------------------------- building


def check_building(layout: Layout, payload: bytes, order: ByteOrder, value: Any) -> None:
    """Assert that a parsed value can be built, and that the same is parsed from its bytes."""
    if not all(buildable(field, item) for field, item in flat(layout, value)):
        return
    head_field = layout.sequence_field if layout.sequence_field in layout.head else None
    sequence = layout.sequence(payload, order) if head_field is not None else None
    try:
        built = layout.build(value, order, sequence=sequence)
    except ConfigurationError as error:
        raise AssertionError(f"parsed, but not built: {error}") from error
    again = layout.parse(built, order)
    assert repr(again) == repr(value)
    assert layout.build(again, order, sequence=sequence) == built
    whole = len(built) == len(payload) or isinstance(layout.repeat, str)
    assert whole, "another length was built"
    if all(exact(field, item) for field, item in flat(layout, value)) and not layout.lenient:
        assert built == payload[: len(built)]


def flat(layout: Layout, value: Any) -> list[tuple[Field, Any]]:
    """Return every field with its value, record by record."""
    if layout.repeat is None:
        return list(zip(layout.fields, value, strict=True))
    records = value if layout.is_list else value[-1]
    found = [] if layout.is_list else list(zip(layout.head, value[:-1], strict=True))
    for record in records:
        found += zip(layout.fields, record, strict=True)
    return found


def buildable(field: Field, value: Any) -> bool:
    """Return True if the value can go back: a large integer with a unit was rounded as a float."""
    if field.unit is None or not field.wire.is_integer:
        return True
    return field.size < 8 or abs(value) < EXACT / 1_000_000


def exact(field: Field, value: Any) -> bool:
    """Return True if the same bytes must be built: some bytes mean no more than others."""
    if field.type == "string":
        return False  # what stands behind the first zero is lost
    if not isinstance(value, float):
        return True
    if math.isnan(value):
        return False  # and so are a NaN's other bits
    return field.unit is None or field.size < 8  # a double is rounded twice
