"""Cells as a layout's bytes: values, numbers that are none, and as many as there should be."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.exceptions import InterpretationError
from smartcam.layout import Layout
from smartcam.layout._inside import pack_texts


def pack(layout: str, *texts: str | None) -> bytes:
    return pack_texts(Layout(layout), [(f"A{row:03d}", text) for row, text in enumerate(texts)])


@pytest.mark.parametrize(
    ("field", "text", "data"),
    [
        ("bool", "1.000", b"\xff"),
        ("bool", "0", b"\0"),
        ("bool", "-0.000", b"\0"),
        ("int8", "-128.000", b"\x80"),
        ("uint8", "255", b"\xff"),
        ("int16", " 258.0 ", b"\x02\x01"),
        ("int32", "-1", b"\xff\xff\xff\xff"),
        ("uint32", "+4294967295.", b"\xff\xff\xff\xff"),
        ("int64", "9007199254740993", (9007199254740993).to_bytes(8, "little")),
        ("uint64", "18446744073709551615", b"\xff" * 8),
        ("real32", "12.500", struct.pack("<f", 12.5)),
        ("real64", "-.5e-003", struct.pack("<d", -0.0005)),
        ("real32 mm", "12.500", struct.pack("<f", 12.5)),
        ("string[4]", "M6", b"M6\0\0"),
        ("string[4]", "", bytes(4)),
        ("string[3]", "\xb05", b"\xc2\xb05"),
    ],
)
def test_text_becomes_the_fields_bytes(field: str, text: str, data: bytes) -> None:
    assert pack(f"x: {field}", text) == data


@pytest.mark.parametrize(
    ("field", "text", "why"),
    [
        ("bool", "2.000", "neither 0 nor 1"),
        ("bool", "1.0000001", "no whole number"),
        ("int32", "12.500", "no whole number"),
        ("int32", "1e3", "no whole number"),
        ("int32", "1_000", "no whole number"),
        ("int32", "\u0661", "no whole number"),
        ("int32", "", "no whole number"),
        ("int8", "128", "-128 to 127 was expected"),
        ("uint32", "-1", "0 to 4294967295 was expected"),
        ("uint64", "9" * 5000, "limit"),
        ("real32", "12,5", "no number"),
        ("real32", "nan", "no number"),
        ("real32", "inf", "no number"),
        ("real32", "#ERR", "no number"),
        ("real32", "0x10", "no number"),
        ("real32", "1e39", "too large"),
        ("real64", "1e999", "too large"),
        ("string[3]", "four", "at most 3 bytes of UTF-8 without a zero were expected"),
        ("string[3]", "\xb0\xb0", "at most 3 bytes of UTF-8 without a zero were expected"),
        ("string[3]", "a\0", "at most 3 bytes of UTF-8 without a zero were expected"),
    ],
)
def test_text_that_is_no_value_names_field_and_cell(field: str, text: str, why: str) -> None:
    with pytest.raises(InterpretationError) as caught:
        pack(f"a: int16, x: {field}", "7", text)
    assert str(caught.value).startswith(f"field 'x' ({field}): cell A001 holds {text!r:.64}: ")
    assert why in str(caught.value)
    assert (caught.value.field, caught.value.offset, caught.value.got) == ("x", 2, text)
    assert caught.value.expected == field


def test_cell_without_a_value_is_an_error() -> None:
    with pytest.raises(InterpretationError) as caught:
        pack("x: string[4]", None)
    assert str(caught.value) == "field 'x' (string[4]): cell A000 has no value"


@pytest.mark.parametrize(
    ("layout", "count", "fields"),
    [
        ("x: int8, y: int8", 1, 2),
        ("x: int8, y: int8", 3, 2),
        ("(x: int8, y: int8)*", 3, 4),
        ("a: int8, (x: int8)*", 0, 1),
        ("(x: int8, y: int8)[3]", 4, 6),
        ("(x: int8, y: int8)[65535]", 4, 131070),
        ("n: int8, (x: int8, y: int8)[n]", 4, 5),
    ],
)
def test_other_number_of_cells_says_both(layout: str, count: int, fields: int) -> None:
    with pytest.raises(InterpretationError) as caught:
        pack(layout, *["1"] * count)
    text = Layout(layout).text
    said, _, cure = str(caught.value).partition("; ?cells=")
    assert said == f"{count} cells came, the layout has {fields} fields: {text}"
    assert bool(cure) == (count == 0)
    assert (caught.value.expected, caught.value.got) == (fields, count)


@pytest.mark.parametrize(
    ("layout", "texts", "value"),
    [
        ("(x: int8, y: int8)*", "1 2 3 4", [(1, 2), (3, 4)]),
        ("(x: int8, y: int8)*", "", []),
        ("(x: int8, y: int8)[2]", "1 2 3 4", [(1, 2), (3, 4)]),
        ("n: uint8, (x: int8)[n]", "2 5 6", [(5,), (6,)]),
        ("n: uint8, (x: int8)[n]", "1 5 - #ERR", [(5,)]),
        ("n: uint8, (x: int8)[n]", "0 - -", []),
    ],
)
def test_groups_take_their_records(layout: str, texts: str, value: list[tuple[int]]) -> None:
    given_ = [None if text == "-" else text for text in texts.split()]
    made = Layout(layout)
    records = made.parse(pack(layout, *given_))
    assert [tuple(record) for record in records] == value


@pytest.mark.parametrize("count", ["3", "-1"])
def test_count_beyond_the_cells_is_the_layouts_error(count: str) -> None:
    made = Layout("n: int8, (x: int8)[n]")
    with pytest.raises(InterpretationError):
        made.parse(pack(made.text, count, "1", "2"))


@given(st.floats(allow_nan=False, allow_infinity=False), st.integers(-(1 << 63), (1 << 63) - 1))
def test_numbers_come_back(real: float, whole: int) -> None:
    data = pack("x: real64, n: int64", repr(real), f"{whole}.000")
    got, number = struct.unpack("<dq", data)
    assert (got, number, math.copysign(1, got)) == (real, whole, math.copysign(1, real))


@given(st.sampled_from(["bool", "int8", "uint64", "real32", "string[3]"]), st.text(max_size=8))
def test_any_text_is_a_value_or_an_interpretation_error(field: str, text: str) -> None:
    layout = Layout(f"x: {field}")
    try:
        data = pack(layout.text, text)
    except InterpretationError:
        return
    assert len(data) == layout.size
