"""The layout language, and a layout's many faces."""

from __future__ import annotations

import copy
import gc
import json
import math
import pickle
import struct
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from smartcam.exceptions import (
    ConfigurationError,
    InterpretationError,
    LayoutError,
    MissingExtraError,
)
from smartcam.layout import Layout, Record
from smartcam.layout._inside import Field

ByteOrder = Literal["little", "big"]
ORDERS = st.sampled_from(["little", "big"])

PART = "passed: bool, count: int32, x: real32 mm, theta: real32 deg, code: string[20]"
PART_BYTES = b"\xff" + struct.pack("<iff", 7, 12.5, 90.0) + b"A1".ljust(20, b"\0")
NAMED_ALIKE = "int8: int8, string: string[1], m: real32 m"  # fields like types and units
BOOL_BYTES = "0x00 or 0xFF for a bool"


# -- texts ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "canonical"),
    [
        ("a:int8", "a: int8"),
        (" a : int8 ,\n b:string [ 007 ],", "a: int8, b: string[7]"),
        ("a: real32 mm # millimetres, (really)\n, b: bool # last", "a: real32 mm, b: bool"),
        ("(a:int8)*", "(a: int8)*"),
        ("(a: int8,)[32],", "(a: int8)[32]"),
        ("n: int32,(a: int8)[n]", "n: int32, (a: int8)[n]"),
        ("n: uint8, parts:(a: int8)*", "n: uint8, parts: (a: int8)*"),
        ("s: uint32@sequence, (a: real64 percent)*", "s: uint32 @sequence, (a: real64 percent)*"),
        (NAMED_ALIKE, NAMED_ALIKE),
        ("count: int32, index: int8, match: bool", "count: int32, index: int8, match: bool"),
        ("ﬁeld: int8", "field: int8"),
        ("records: int32, (a: int8)[records]", "records: int32, (a: int8)[records]"),
    ],
)
def test_text_is_canonical_and_stays_so(text: str, canonical: str) -> None:
    layout = Layout(text)
    assert layout.text == str(layout) == canonical
    assert Layout(canonical) == layout


@pytest.mark.parametrize(
    ("text", "position", "part"),
    [
        ("", 0, "expected a field or a group, got the end"),
        ("# nothing", 9, "got the end"),
        (",a: int8", 0, "expected a field or a group, got ','"),
        ("a", 1, "expected ':' and a type after 'a', got the end"),
        ("a: int8 b: int8", 8, "a comma is missing before it"),
        ("a: int8, ,", 9, "expected a field or a group, got ','"),
        ("a: float", 3, "did you mean 'real32'?"),
        ("a: Int32", 3, "did you mean 'int32'?"),
        ("a: whatever", 3, "expected a type (bool, int8,"),
        ("a: int8 furlong", 8, "expected a unit (m, mm, um, inch, rad, deg, percent, px, s, ms)"),
        ("a: int8 mm mm", 11, "expected ',' or the end, got 'mm'"),
        ("a: int8 )", 8, "expected a unit, ',' or the end, got ')'"),
        ("a: bool mm", 8, "expected no unit, a bool has none, got 'mm'"),
        ("a: string[3] mm", 13, "a string has none"),
        ("a: string", 9, "expected '[' and the string's length in bytes, got the end"),
        ("a: string[]", 10, "expected a number of bytes from 1 to 65535, got ']'"),
        ("a: string[0]", 10, "got '0'"),
        ("a: string[65536]", 10, "got '65536'"),
        (f"a: string[{'9' * 5000}]", 10, "expected a number of bytes"),
        ("a: string[3", 11, "expected ']', got the end"),
        ("_a: int8", 0, "expected a name that can be an attribute"),
        ("class: int8", 0, "no Python keyword"),
        ("a: int8, a: bool", 9, "expected a new name, 'a' is there already"),
        ("a: int8, (a: bool)*", 10, "'a' is there already"),
        ("1a: int8", 0, "expected a field or a group, got '1'"),
        ("a: int8; b: int8", 7, "expected a name, a number or one of : , ( ) [ ] * @ #, got ';'"),
        ("a: int8 @seq", 8, "expected '@sequence', got '@' and 'seq'"),
        ("a: real32 @sequence", 10, "only after an integer without a unit"),
        ("a: int32 mm @sequence", 12, "only after an integer without a unit"),
        ("a: int8 @sequence, b: int8 @sequence", 27, "expected one '@sequence', got a second"),
        ("(a: int8)", 9, "expected '*', '[number]' or '[name]' after the group, got the end"),
        ("()*", 1, "expected a field, got ')'"),
        ("(a: int8", 8, "expected a unit, ',' or ')', got the end"),
        ("(a: bool b: int8)*", 9, "a comma is missing before it"),
        ("(a: int8)[0]", 10, "expected a number of records from 1 to 65535, got '0'"),
        ("(a: int8)[*]", 10, "expected a number or the name of a count field, got '*'"),
        ("(a: int8)[3", 11, "expected ']', got the end"),
        ("(a: int8)[n]", 10, "(there: none), got 'n'"),
        ("m: int8, (a: int8)[n]", 19, "(there: m), got 'n'"),
        ("n: real32, (a: int8)[n]", 21, "expected an integer field without a unit as the count"),
        ("n: int8 mm, (a: int8)[n]", 22, "field 'n' (int8 mm)"),
        ("n: int8 @sequence, (a: int8)[n]", 29, "as the count"),
        ("(a: int8)*, b: int8", 12, "expected the end, a group comes last, got 'b'"),
        ("(a: int8)* b: int8", 11, "expected the end, a group comes last, got 'b'"),
        ("(a: int8, (b: int8)*)*", 10, "groups do not nest"),
        ("(a: int8, p: (b: int8)*)*", 10, "groups do not nest"),
        ("records: int8, (a: int8)*", 15, "expected a name before the group"),
        ("\u2160a\u0660: int8, \u00b7", 11, "expected a name, a number"),
        ("a\u00b2: int8", 0, "expected a name that can be an attribute"),
    ],
)
def test_mistake_is_a_layout_error_with_its_position(text: str, position: int, part: str) -> None:
    with pytest.raises(LayoutError) as caught:
        Layout(text)
    assert part in str(caught.value)
    assert caught.value.position == position
    assert caught.value.text == text
    assert f"at character {position}" in str(caught.value)


def test_mistake_shows_line_and_caret() -> None:
    with pytest.raises(LayoutError) as caught:
        Layout("a: int8,\n  b: real32 mn,\nc: bool")
    assert str(caught.value).splitlines()[-3:] == [
        "layout: expected a unit (m, mm, um, inch, rad, deg, percent, px, s, ms), got 'mn' "
        "at line 2, column 13",
        "    b: real32 mn,",
        "              ^",
    ]


def test_mistake_in_a_long_line_shows_a_window_of_it() -> None:
    text = ", ".join(f"a{i}: int8" for i in range(200)) + ", \x07: bool, " + "b: bool" * 50
    with pytest.raises(LayoutError) as caught:
        Layout(text)
    _, shown, caret = str(caught.value).splitlines()
    assert len(shown) <= 82
    assert caret.index("^") == 52
    assert "\x07" not in shown


def test_text_too_long_is_refused() -> None:
    with pytest.raises(LayoutError, match="expected at most 20000 characters, got 20001"):
        Layout("a: int8," + " " * 19_993)


def test_start_counts_positions_from_the_whole_text() -> None:
    assert Layout("table: x: bool", start=6) == Layout("x: bool")
    with pytest.raises(LayoutError) as caught:
        Layout("table: x: boo", start=6)
    assert caught.value.position == 10
    with pytest.raises(LayoutError) as caught:
        Layout("table:", start=6)
    assert caught.value.position == 6


# -- what it is -----------------------------------------------------------------------------------


def test_properties_tell_head_fields_and_sizes() -> None:
    layout = Layout("n: int32, q: uint16 @sequence, parts: (x: real32 mm, code: string[9])[n]")
    assert layout.head == (Field("n", "int32"), Field("q", "uint16", sequence=True))
    assert layout.fields == (Field("x", "real32", unit="mm"), Field("code", "string", 9))
    assert (layout.repeat, layout.group, layout.is_list) == ("n", "parts", False)
    assert (layout.head_size, layout.size) == (6, 13)
    assert layout.sequence_field == layout.head[1]
    assert layout.dtype.itemsize == layout.size


def test_without_a_group_the_fields_are_the_record() -> None:
    layout = Layout(PART)
    assert [field.name for field in layout.fields] == ["passed", "count", "x", "theta", "code"]
    assert (layout.head, layout.repeat, layout.group, layout.head_size) == ((), None, None, 0)
    assert layout.sequence_field is None


def test_layouts_of_one_text_are_equal_and_hash_alike() -> None:
    assert Layout("a: int8") == Layout(" a:int8,")
    assert hash(Layout("a: int8")) == hash(Layout(" a:int8,"))
    assert Layout("a: int8") != Layout("a: int8", lenient=True)
    assert Layout("a: int8") != "a: int8"
    assert Layout("a: int8").__eq__("a: int8") is NotImplemented


def test_layout_is_immutable_and_survives_pickle() -> None:
    layout = Layout("a: bool", lenient=True)
    with pytest.raises(AttributeError):
        layout.text = "b: bool"  # type: ignore[misc]
    with pytest.raises(AttributeError):
        layout.other = 1  # type: ignore[attr-defined]
    again = pickle.loads(pickle.dumps(layout))  # noqa: S301
    assert again == layout
    assert again.lenient
    assert repr(layout) == "Layout('a: bool', lenient=True)"
    assert repr(Layout("a: bool")) == "Layout('a: bool')"


def test_import_is_light() -> None:
    code = (
        "import sys, smartcam.layout, smartcam.interpreters._localizations\n"
        "smartcam.layout.Layout('(a: int8)*').parse(b'12')\n"
        "print([m for m in ('numpy', 'pydantic', 'yaml') if m in sys.modules])"
    )
    done = subprocess.run(  # noqa: S603  the code above
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


# -- values ---------------------------------------------------------------------------------------


def test_one_record_has_si_values() -> None:
    record = Layout(PART).parse(PART_BYTES)
    assert record == (True, 7, 0.0125, math.pi / 2, "A1")


def test_group_gives_a_list() -> None:
    layout = Layout("(a: int8, b: uint8)*")
    assert layout.parse(b"\xff\xff\x01\x02") == [(-1, 255), (1, 2)]
    assert layout.parse(b"") == []


def test_fixed_group_takes_exactly_so_many() -> None:
    layout = Layout("(a: int16)[2]")
    assert layout.parse(b"\1\0\2\0") == [(1,), (2,)]
    assert layout.parse(b"\1\0\2\0", "big") == [(256,), (512,)]


def test_counted_group_ignores_unused_slots() -> None:
    layout = Layout("n: uint8, (a: bool)[n]")
    assert layout.parse(b"\1\xff\x77") == [(True,)]
    assert layout.parse(b"\0\x77") == []


def test_head_or_group_name_gives_a_record_with_a_list() -> None:
    value = Layout("ok: bool, n: int8, (a: int8)[n]").parse(b"\xff\1\5\0")
    assert isinstance(value, Record)
    assert value._asdict() == {"ok": True, "n": 1, "records": [(5,)]}
    named = Layout("parts: (a: int8)*").parse(b"\5\6")
    assert isinstance(named, Record)
    assert named["parts"] == [(5,), (6,)]


def test_sequence_in_the_head_alone_keeps_the_list() -> None:
    layout = Layout("s: uint16 @sequence, n: int8, (a: int8)[n]")
    assert layout.parse(b"\7\0\1\5") == [(5,)]


@pytest.mark.parametrize(
    ("unit", "wire", "value"),
    [
        ("m", 3, 3.0),
        ("mm", 3, 0.003),
        ("um", 3, 0.000003),
        ("inch", 3, 0.0762),
        ("rad", 3, 3.0),
        ("deg", 180, math.pi),
        ("percent", 7, 0.07),
        ("px", 3, 3.0),
        ("s", 3, 3.0),
        ("ms", 3, 0.003),
    ],
)
@pytest.mark.parametrize(("type_", "code"), [("int16", "h"), ("real32", "f"), ("real64", "d")])
def test_units_are_rounded_once(unit: str, wire: int, value: float, type_: str, code: str) -> None:
    layout = Layout(f"v: {type_} {unit}")
    payload = struct.pack(f"<{code}", wire)
    record = layout.parse(payload)
    assert record == (value,)
    assert type(record[0]) is float
    assert layout.parse_table(payload)["v"][0] == value
    assert layout.parse(layout.build((value,))) == (value,)


@pytest.mark.parametrize(
    ("text", "payload", "field", "offset", "expected", "got", "part"),
    [
        (PART, b"", "passed", 0, 33, 0, "field 'passed' (bool) at offset 0: expected 1 bytes"),
        (PART, PART_BYTES[:3], "count", 1, 33, 3, "expected 4 bytes, got 2 (the container has 3"),
        (PART, PART_BYTES + b"1", "", 33, 33, 34, "1 too many from offset 33; for several"),
        ("(a: int8, b: int16)*", b"1234", "b", 4, 6, 4, "record 1: field 'b' (int16) at offset 4"),
        ("(a: int8, b: int16)[2]", b"123", "a", 3, 6, 3, "record 1: field 'a'"),
        ("(a: int8, b: int16)[1]", b"1234", "", 3, 3, 4, "expected 3 bytes, got 4: 1 too many"),
        ("n: int16, (a: int8)[n]", b"1", "n", 0, 2, 1, "field 'n' (int16) at offset 0"),
        ("n: int8, m: int8, (a: int8)*", b"1", "m", 1, 2, 1, "field 'm' (int8) at offset 1"),
        ("n: int8, (a: int16)[n]", b"\1ab\0", "a", 3, 5, 4, "record 1: field 'a'"),
        ("n: int8, (a: int8)[n]", b"\3ab", "n", 0, "0 to 2", 3, "field 'n' (int8) at offset 0"),
        ("n: int8, (a: int8)[n]", b"\xffab", "n", 0, "0 to 2", -1, "expected 0 to 2"),
        ("a: bool", b"\1", "a", 0, BOOL_BYTES, "0x01", "got 0x01"),
        ("(a: int8, b: bool)*", b"1\0002\xfe", "b", 3, BOOL_BYTES, "0xFE", "record 1"),
    ],
)
def test_misfit_names_field_offset_expected_and_got(
    text: str, payload: bytes, field: str, offset: int, expected: object, got: object, part: str
) -> None:
    with pytest.raises(InterpretationError) as caught:
        Layout(text).parse(payload)
    error = caught.value
    assert part in str(error)
    assert (error.field, error.offset) == (field, offset)
    assert (error.expected, error.got) == (expected, got)


def test_text_that_is_no_utf8_names_the_bad_byte() -> None:
    layout = Layout("(a: int8, code: string[4])*")
    with pytest.raises(InterpretationError) as caught:
        layout.parse(b"1abcd2a\xffcd")
    assert (caught.value.field, caught.value.offset) == ("code", 7)
    assert isinstance(caught.value.__cause__, UnicodeDecodeError)
    assert "record 1: field 'code' (string[4]) at offset 7: expected UTF-8 text" in str(
        caught.value
    )


def test_first_of_two_mistakes_is_reported() -> None:
    with pytest.raises(InterpretationError) as caught:
        Layout("(code: string[1], a: bool)*").parse(b"a\x02\xff\xff")
    assert caught.value.offset == 1


def test_text_ends_at_the_first_zero() -> None:
    assert Layout("a: string[6], b: string[3]").parse(b"\xc3\xa4\0\xff\xffzabc") == ("ä", "abc")


def test_lenient_takes_any_byte_for_true() -> None:
    assert Layout("(a: bool)*", lenient=True).parse(b"\0\1\xff") == [(False,), (True,), (True,)]


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_payload_may_be_any_bytes(kind: type) -> None:
    assert Layout(PART).parse(kind(PART_BYTES))["code"] == "A1"
    assert Layout("n: int8, (a: bool)[n]").parse(kind(b"\1\xff\0")) == [(True,)]


def test_parse_records_gives_them_whatever_the_head() -> None:
    assert Layout("ok: bool, (a: int8)*").parse_records(b"\xff\1\2") == [(1,), (2,)]
    assert Layout("a: int8").parse_records(b"\1") == [(1,)]


# -- records --------------------------------------------------------------------------------------


def test_record_is_read_by_name_place_and_attribute() -> None:
    record = Layout(PART).parse(PART_BYTES)
    assert isinstance(record, Record)
    assert record.x == record["x"] == record[2] == record[-3] == 0.0125
    assert record[:2] == (True, 7)
    assert record._fields == ("passed", "count", "x", "theta", "code")
    assert repr(record).startswith("Record(passed=True, count=7, x=0.0125, ")
    with pytest.raises(KeyError, match="'y' is not a field; fields are passed, count"):
        record["y"]
    with pytest.raises(IndexError):
        record[5]
    with pytest.raises(AttributeError):
        record.x = 1  # type: ignore[attr-defined]


def test_field_names_go_before_the_tuples_own() -> None:
    record = Layout("count: int8, index: int8").parse(b"\1\2")
    assert isinstance(record, Record)
    assert (record.count, record.index) == (1, 2)


def test_record_unpacks_and_matches() -> None:
    (record,) = Layout("(x: int8, y: int8)*").parse(b"\1\2")
    x, y = record
    match record:
        case Record(x=1, y=other):
            assert (x, y, other) == (1, 2, 2)
        case _:
            pytest.fail("no match")


def test_record_survives_pickle_and_copy() -> None:
    value = Layout("ok: bool, (count: int8)*").parse(b"\xff\1\2")
    assert isinstance(value, Record)
    pickled = pickle.loads(pickle.dumps(value))  # noqa: S301
    for again in (pickled, copy.deepcopy(value)):
        assert again == value
        assert again.records[1].count == 2


# -- sequence -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "payload", "sequence"),
    [
        ("a: int8", b"\1", None),
        ("a: int8, s: uint16 @sequence", b"\1\2\0", 2),
        ("s: uint16 @sequence, (a: int8)*", b"\2\0", 2),
        ("(a: int8, s: int8 @sequence)*", b"\1\2\3\4", 2),
        ("(a: int8, s: int8 @sequence)*", b"", None),
        ("n: int8, (s: int8 @sequence)[n]", b"\0\7", None),
        ("n: int8, (s: int8 @sequence)[n]", b"\1\7", 7),
    ],
)
def test_sequence_is_the_heads_or_the_first_records(
    text: str, payload: bytes, sequence: int | None
) -> None:
    assert Layout(text).sequence(payload) == sequence


def test_sequence_follows_the_byte_order() -> None:
    assert Layout("s: uint16 @sequence").sequence(b"\1\0", "big") == 256


def test_sequence_of_a_misfit_raises() -> None:
    with pytest.raises(InterpretationError):
        Layout("s: uint16 @sequence").sequence(b"\1")


# -- build ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["little", "big"])
def test_build_takes_mapping_record_and_sequence(order: ByteOrder) -> None:
    layout = Layout(PART)
    values = {"passed": True, "count": 7, "x": 0.0125, "theta": math.pi / 2, "code": "A1"}
    payload = layout.build(values, order)
    assert layout.parse(payload, order) == tuple(values.values())
    assert layout.build(list(values.values()), order) == payload
    assert layout.build(layout.parse(payload, order), order) == payload


def test_build_list_fills_in_count_and_pads() -> None:
    layout = Layout("n: int16, (a: int8, b: bool)[n]")
    assert layout.build([(1, True)], slots=3) == b"\1\0\1\xff\0\0\0\0"
    assert layout.build([], "big") == b"\0\0"
    assert Layout("(a: int8)*").build([{"a": 1}], slots=2) == b"\1\0"
    assert Layout("(a: int8)[2]").build([[1]], slots=2) == b"\1\0"


def test_build_container_with_head() -> None:
    layout = Layout("ok: bool, n: int8, (a: int8)[n]")
    assert layout.build({"ok": True, "records": [(5,), (6,)]}) == b"\xff\2\5\6"
    assert layout.build((True, 1, [(5,)])) == b"\xff\1\5"
    assert layout.build(layout.parse(b"\xff\1\5\0")) == b"\xff\1\5"
    assert Layout("parts: (a: int8)*").build({"parts": [(5,)]}) == b"\5"


def test_build_sequence_goes_before_the_value() -> None:
    assert Layout("s: int8 @sequence, (a: int8)*").build([(1,)], sequence=5) == b"\5\1"
    assert Layout("s: int8 @sequence, (a: int8)*").build([(1,)]) == b"\0\1"
    assert Layout("a: int8, s: int8 @sequence").build({"a": 1}, sequence=5) == b"\1\5"
    assert Layout("a: int8, s: int8 @sequence").build((1, 2), sequence=5) == b"\1\5"
    assert Layout("(a: int8, s: int8 @sequence)*").build([(1, 2)], sequence=5) == b"\1\5"
    layout = Layout("ok: bool, s: int8 @sequence, (a: int8)*")
    assert layout.build({"ok": False, "records": []}, sequence=5) == b"\0\5"


def test_build_rounds_integers_to_the_wire() -> None:
    assert Layout("a: int16 um, b: uint8 percent").build((0.0000104, 0.119)) == b"\x0a\0\x0c"
    assert Layout("a: int8, b: int8").build((2.0, np.int32(3))) == b"\2\3"


@pytest.mark.parametrize(
    ("text", "value", "part"),
    [
        ("a: int8", (128,), "field 'a' (int8): expected -128 to 127, got 128"),
        ("a: uint8", (-1,), "expected 0 to 255, got -1"),
        ("a: int8", (1.5,), "got 1.5"),
        ("a: int8", ("1",), "got '1'"),
        ("a: int8", (None,), "got None"),
        ("a: int8", (math.nan,), "got nan"),
        ("a: int8 mm", (math.inf,), "on the wire (metres here), got inf"),
        ("a: int8 mm", (0.128,), "expected -128 to 127 on the wire (metres here), got 0.128"),
        ("a: real32", (1e39,), "field 'a' (real32): expected a number in range, got 1e+39"),
        ("a: real64", (10**400,), "expected a number in range"),
        ("a: real64 mm", (1e308,), "got 1e+308"),
        ("a: real32", ("x" * 100,), "got '" + "x" * 63 + " ..."),
        ("a: bool", ("yes",), "expected True or False, got 'yes'"),
        ("a: string[2]", ("äb",), "expected a text of at most 2 bytes in UTF-8"),
        ("a: string[2]", ("a\0",), "without a zero character"),
        ("a: string[2]", (b"a",), "got b'a'"),
        ("a: string[9]", ("\ud800",), "expected a text"),
        ("(a: int8)*", [(1,), (300,)], "record 1: field 'a'"),
        ("a: int8", (1, 2), "expected 1 values (a), got 2"),
        ("a: int8", "1", "expected a mapping or a sequence of values, got '1'"),
        ("a: int8, b: int8", {"a": 1, "c": 2}, "the fields a, b; missing: b; unknown: c"),
        ("(a: int8)*", 1, "expected a list of records, got 1"),
        ("(a: int8)*", b"1", "expected a list of records, got b'1'"),
        ("(a: int8)[2]", [(1,)], "expected 2 records, got 1; slots=2 pads with zeros"),
        ("(a: int8)[2]", [(1,)] * 3, "expected 2 records, got 3"),
        ("ok: bool, (a: int8)*", {"ok": True}, "missing: records"),
        ("ok: bool, (a: int8)*", [(1,)], "expected 2 values (ok, records), got 1"),
        ("ok: bool, (a: int8)*", {"ok": 1, "records": [], "z": 1}, "unknown: z"),
        ("ok: bool, (a: int8)*", {"ok": 1, "records": 5}, "expected a list of records, got 5"),
        (
            "b: bool, n: int8, (a: int8)[n]",
            {"b": True, "n": 2, "records": []},
            "count field 'n': expected 0, the number of records, got 2",
        ),
        ("n: int8, (a: bool)[n]", [(True,)] * 128, "field 'n' (int8): expected -128 to 127"),
    ],
)
def test_build_refuses_what_does_not_fit(text: str, value: Any, part: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        Layout(text).build(value)
    assert part in str(caught.value)


def test_build_refuses_slots_and_sequence_without_a_place() -> None:
    with pytest.raises(ConfigurationError, match="slots= is for layouts with a group"):
        Layout("a: int8").build((1,), slots=2)
    with pytest.raises(ConfigurationError, match="expected at most 1 records, got 2"):
        Layout("(a: int8)*").build([(1,), (2,)], slots=1)
    with pytest.raises(ConfigurationError, match="expected a field with @sequence"):
        Layout("a: int8").build((1,), sequence=2)


# -- numpy ----------------------------------------------------------------------------------------


def test_dtype_is_the_wires() -> None:
    layout = Layout(PART)
    assert layout.dtype == np.dtype(
        [("passed", "u1"), ("count", "<i4"), ("x", "<f4"), ("theta", "<f4"), ("code", "S20")]
    )
    assert layout.dtype_for("big")["count"] == np.dtype(">i4")
    assert layout.dtype_for("big").itemsize == layout.size == 33


@pytest.mark.skipif(sys.byteorder != "little", reason="the view is of the machine's byte order")
@pytest.mark.parametrize("kind", [bytes, bytearray])
def test_table_is_a_view_if_nothing_is_converted(kind: type) -> None:
    payload = kind(b"\2\0\1\0\2\0\3\0")
    table = Layout("n: int16, (a: int16)[n]").parse_table(payload)
    assert table["a"].tolist() == [1, 2]
    assert np.shares_memory(table, np.frombuffer(payload, "u1"))
    assert not table.flags.writeable


def test_table_converts_units_bools_and_byte_order() -> None:
    layout = Layout("(ok: bool, x: int16 mm, n: int32, code: string[2])*")
    payload = layout.build([(True, 0.5, 3, "a"), (False, -0.001, 4, "bc")], "big")
    table = layout.parse_table(payload, "big")
    assert table.dtype == np.dtype([("ok", "?"), ("x", "=f8"), ("n", "=i4"), ("code", "S2")])
    assert table.tolist() == [(True, 0.5, 3, b"a"), (False, -0.001, 4, b"bc")]
    assert not table.flags.writeable


def test_table_may_be_empty_or_one_row() -> None:
    assert Layout("(a: int8, b: real32 mm)*").parse_table(b"").shape == (0,)
    assert Layout("a: int8").parse_table(b"\5").tolist() == [(5,)]


def test_table_checks_bools() -> None:
    with pytest.raises(InterpretationError) as caught:
        Layout("(a: int8, ok: bool)*").parse_table(b"1\0002\1")
    assert (caught.value.field, caught.value.offset) == ("ok", 3)
    lenient = Layout("(a: int8, ok: bool)*", lenient=True)
    assert lenient.parse_table(b"1\0002\1")["ok"].tolist() == [False, True]


@pytest.mark.parametrize(
    "text", ["a: int16, b: int8", "(a: int16, b: int8)[2]", "(a: int16, b: int8)*"]
)
@pytest.mark.parametrize("size", range(11))
def test_table_without_conversion_checks_the_size_as_parse_does(text: str, size: int) -> None:
    layout = Layout(text)
    layout.dtype_for("little")  # the short way is there from now on
    payload = bytes(range(size))
    expected, found = (
        error_of(face, payload) for face in (layout.parse_records, layout.parse_table)
    )
    assert str(found) == str(expected)
    if found is None:
        table = layout.parse_table(payload)
        assert table.tolist() == layout.parse_records(payload)
        assert not table.flags.writeable


def test_table_of_a_bytearray_is_read_only_and_follows_it() -> None:
    layout, payload = Layout("(a: uint8)*"), bytearray(b"\1\2")
    layout.dtype_for("little")
    table = layout.parse_table(payload)
    payload[0] = 9
    assert table["a"].tolist() == [9, 2]
    assert not table.flags.writeable


def test_table_in_the_other_byte_order_is_a_copy_in_the_machines() -> None:
    layout = Layout("(a: int16, s: string[2])*")
    cases: list[tuple[ByteOrder, bytes]] = [("little", b"\1\0ab"), ("big", b"\0\1ab")]
    for order, raw in cases:
        table = layout.parse_table(raw * 2, order)
        assert table.tolist() == [(1, b"ab")] * 2
        assert table.dtype == np.dtype([("a", "=i2"), ("s", "S2")])


# -- values on the wire ---------------------------------------------------------------------------


def test_wire_records_are_not_converted() -> None:
    layout = Layout("n: int8, (ok: bool, x: int16 mm, s: string[3])[n]")
    payload = layout.build([(True, 0.005, "a")], slots=3)
    assert list(layout.wire_records(payload)) == [(0xFF, 5, b"a\0\0")]
    with pytest.raises(InterpretationError, match="field 'x'"):
        layout.wire_records(payload[:-4])


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
@pytest.mark.parametrize("text", ["(a: int8)*", "n: int8, (a: int8)[n]"])
def test_wire_records_may_be_left_half_read(kind: type, text: str) -> None:
    # CPython 3.11 crashes where such an iterator holds a memoryview
    layout = Layout(text)
    for _ in range(100):
        rows = layout.wire_records(kind(b"\3\1\2\3"))
        next(rows)
        cycle: list[Any] = [rows]
        cycle.append(cycle)
    del rows, cycle
    gc.collect()


# -- pydantic, JSON Schema ------------------------------------------------------------------------


def test_model_takes_what_parse_gives() -> None:
    layout = Layout(PART)
    value = layout.model.model_validate(layout.parse(PART_BYTES))
    assert value.model_dump(by_alias=True) == layout.parse(PART_BYTES)._asdict()
    assert layout.model is layout.model


def test_model_names_that_pydantic_keeps_become_aliases() -> None:
    layout = Layout("json: int8, json_: int8, model_config: int8, model_x: bool")
    record = layout.parse(b"\1\2\3\xff")
    value = layout.model.model_validate(record)
    assert isinstance(record, Record)
    assert value.model_dump(by_alias=True) == record._asdict()
    assert list(layout.json_schema()["properties"]) == list(record._fields)


def test_model_of_a_list_is_a_root_model() -> None:
    layout = Layout("(a: int8)[2]")
    dumped: Any = layout.model.model_validate(layout.parse(b"\1\2")).model_dump()
    assert dumped == [{"a": 1}, {"a": 2}]
    schema = layout.json_schema()
    assert (schema["type"], schema["minItems"], schema["maxItems"]) == ("array", 2, 2)


def test_json_schema_tells_units_and_ranges() -> None:
    schema = Layout(
        "n: uint8, s: int8 @sequence, parts: (x: real32 mm, c: string[5])[n]"
    ).json_schema()
    assert schema["properties"]["n"]["maximum"] == 255
    assert schema["properties"]["s"]["description"] == "int8, the sequence number"
    part = schema["$defs"]["Record"]["properties"]
    assert part["x"]["description"] == "metres; real32 mm on the wire"
    assert part["c"]["maxLength"] == 5
    assert json.dumps(schema)
    assert Layout("x: real64").json_schema()["properties"]["x"]["description"] == "real64"


# -- plain data and YAML --------------------------------------------------------------------------

WHOLE = "n: int32, q: uint8 @sequence, parts: (x: real32 mm, code: string[20])[n]"


@pytest.mark.parametrize("text", [PART, WHOLE, "(a: int8)*", "(a: int8)[3]"])
@pytest.mark.parametrize("lenient", [False, True])
def test_dict_and_yaml_round_trip(text: str, lenient: bool) -> None:
    layout = Layout(text, lenient=lenient)
    assert Layout.from_dict(layout.to_dict()) == layout
    assert Layout.from_dict(json.loads(json.dumps(layout.to_dict()))) == layout
    assert Layout.from_yaml(layout.to_yaml()) == layout


def test_to_dict_leaves_out_what_is_usual() -> None:
    assert Layout("a: string[3], b: real32 mm").to_dict() == {
        "fields": [
            {"name": "a", "type": "string[3]"},
            {"name": "b", "type": "real32", "unit": "mm"},
        ]
    }


@pytest.mark.parametrize(
    "text",
    [
        "x: int32",
        "x: int32, y: int32",
        "(x: int32)*",
        "'x: int32, y: bool'",
        "|\n  x: int32,\n  y: bool\n",
        "fields: int32",
        "n: int8, (a: int8)[n]",
        "# a comment\nx: int32",
    ],
)
def test_from_yaml_takes_a_layout_text(text: str) -> None:
    assert Layout.from_yaml(text).text == Layout(text.strip("'|\n")).text


@pytest.mark.parametrize(
    ("data", "part"),
    [
        ({}, "layout: fields: Field required"),
        ({"fields": []}, "fields: List should have at least 1 item"),
        ({"fields": [{"name": "a", "type": "int8", "units": "mm"}]}, "fields.0.units: Extra"),
        ({"fields": [{"name": "a: int8, b", "type": "int8"}]}, "fields.0.name"),
        ({"fields": [{"name": "a", "type": "float"}]}, "field 'a': expected a type (bool, int8"),
        ({"fields": [{"name": "a", "type": "string[3]x"}]}, "got 'string[3]x'"),
        ({"fields": [{"name": "a", "type": "int8", "unit": "ell"}]}, "expected a unit (m, mm"),
        ({"fields": [{"name": "a", "type": "int8"}], "group": "g"}, "for layouts with repeat"),
        ({"fields": [{"name": "a", "type": "int8"}], "repeat": 0}, "repeat"),
        ({"fields": [{"name": "a", "type": "int8"}], "repeat": "n]"}, "repeat"),
        (5, "layout: layout: Input should be"),
        ({1: 2}, "layout: "),
    ],
)
def test_from_dict_refuses_what_is_no_layout(data: Any, part: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        Layout.from_dict(data)
    assert part in str(caught.value)


@pytest.mark.parametrize(
    "fields",
    [
        [{"name": "a", "type": "string"}],
        [{"name": "a", "type": "string[0]"}],
        [{"name": "a", "type": "bool[2]"}],
        [{"name": "a", "type": "int8"}, {"name": "a", "type": "int8"}],
        [{"name": "_a", "type": "int8"}],
    ],
)
def test_from_dict_that_makes_no_layout_is_a_layout_error(fields: Any) -> None:
    with pytest.raises(LayoutError):
        Layout.from_dict({"fields": fields})


@pytest.mark.parametrize(
    "text", ["", "{", "fields: [1", "x: int32, y: boo", "[" * 9000, "2001-99-99"]
)
def test_from_yaml_of_neither_is_a_layout_error(text: str) -> None:
    with pytest.raises(LayoutError):
        Layout.from_yaml(text)


def test_from_yaml_of_a_broken_document_tells_both() -> None:
    with pytest.raises(LayoutError) as caught:
        Layout.from_yaml("fields:\n- {name: x")
    assert "nor is it YAML" in str(caught.value)


def test_yaml_without_pyyaml_says_which_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(MissingExtraError, match=r'pip install "smartcam\[yaml\]"') as caught:
        Layout("a: int8").to_yaml()
    assert caught.value.extra == "yaml"


# -- properties -----------------------------------------------------------------------------------

INTEGERS = ["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"]
NUMBERS = [*INTEGERS, "real32", "real64"]
UNIT_NAMES = ["m", "mm", "um", "inch", "rad", "deg", "percent", "px", "s", "ms"]
SPACES = st.sampled_from(["", " ", "\n", " # a: comment, (\n"])


@st.composite
def fields(draw: st.DrawFn, prefix: str, *, least: int = 1) -> list[str]:
    """Texts of some fields with white space in all places."""
    texts: list[str] = []
    for number in range(draw(st.integers(least, 4))):
        type_ = draw(st.sampled_from([*NUMBERS, "bool", "string"]))
        if type_ == "string":
            type_ = f"string[{draw(st.integers(1, 9))}]"
        unit = draw(st.sampled_from(["", *UNIT_NAMES])) if type_ in NUMBERS else ""
        gap = draw(SPACES)
        texts.append(f"{prefix}{number}{gap}:{gap}{type_} {unit}{gap}")
    return texts


@st.composite
def layouts(draw: st.DrawFn) -> str:
    """Texts of layouts of every kind."""
    body = ",".join(draw(fields("f")))
    kind = draw(st.sampled_from(["one", "*", "fixed", "counted"]))
    if kind == "one":
        return body + draw(st.sampled_from(["", ","]))
    head = draw(fields("h", least=0))
    if draw(st.booleans()):
        head.append(f"q: {draw(st.sampled_from(INTEGERS))} @sequence")
    repeat = {"*": "*", "fixed": f"[{draw(st.integers(1, 3))}]", "counted": "[n]"}[kind]
    if kind == "counted":
        head.append(f"n: {draw(st.sampled_from(INTEGERS))}")
    group = draw(st.sampled_from(["", "parts:"]))
    return ",".join([*head, f"{group}({body}){repeat}"])


def wire_values(field: Field) -> st.SearchStrategy[bytes]:
    """Bytes of one field, little endian, that parse."""
    if field.type == "bool":
        return st.sampled_from([b"\0", b"\xff"])
    if field.type == "string":
        size = field.size
        texts = st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=size)
        fitting = texts.map(str.encode).filter(lambda raw: len(raw) <= size)
        return fitting.map(lambda raw: raw.ljust(size, b"\0"))
    if not field.wire.is_integer:
        floats = st.floats(
            width=32 if field.size == 4 else 64, allow_nan=False, allow_infinity=False
        )
        return floats.filter(lambda v: abs(v) < 1e300).map(
            lambda v: struct.pack(f"<{field.wire.code}", v)
        )
    # a float has no room to spare for larger integers with a unit
    bound = 2**50 if field.unit is not None else 2**64
    low, high = max(field.wire.low or 0, -bound), min(field.wire.high or 0, bound)
    return st.integers(low, high).map(lambda v: struct.pack(f"<{field.wire.code}", v))


@st.composite
def containers(draw: st.DrawFn) -> tuple[Layout, bytes]:
    """A layout and a container that fits it, little endian."""
    layout = Layout(draw(layouts()))
    count = layout.repeat if isinstance(layout.repeat, int) else draw(st.integers(0, 3))
    if layout.repeat is None:
        count = 1
    head = b"".join(
        struct.pack(f"<{field.wire.code}", count)
        if field.name == layout.repeat
        else draw(wire_values(field))
        for field in layout.head
    )
    body = (draw(wire_values(field)) for _ in range(count) for field in layout.fields)
    return layout, head + b"".join(body)


def error_of(call: Callable[..., object], *args: object) -> Exception | None:
    """Return the error of a call, None without one."""
    try:
        call(*args)
    except Exception as exc:  # noqa: BLE001  the tests look at which it is
        return exc
    return None


MANY = settings(max_examples=5 * settings().max_examples, deadline=None)


@MANY
@given(layouts())
def test_canonical_text_gives_an_equal_layout(text: str) -> None:
    layout = Layout(text)
    assert Layout(layout.text) == layout
    assert Layout(layout.text).text == layout.text
    assert Layout.from_dict(layout.to_dict()) == layout


@MANY
@given(containers(), ORDERS)
def test_what_is_built_parses_to_the_same(case: tuple[Layout, bytes], order: ByteOrder) -> None:
    layout, payload = case
    value = layout.parse(payload)
    in_head = layout.sequence_field in layout.head
    sequence = layout.sequence(payload) if layout.is_list and in_head else None
    built = layout.build(value, order, sequence=sequence)
    assert len(built) == len(payload)
    assert layout.parse(built, order) == value
    assert layout.sequence(built, order) == layout.sequence(payload)


@MANY
@given(containers())
def test_table_agrees_with_parse(case: tuple[Layout, bytes]) -> None:
    layout, payload = case
    records = layout.parse_records(payload)
    rows = layout.parse_table(payload).tolist()
    texts = [index for index, field in enumerate(layout.fields) if field.type == "string"]
    for record, row in zip(records, rows, strict=True):
        decoded = [v.decode() if i in texts else v for i, v in enumerate(row)]
        assert decoded == list(record)


@pytest.mark.parametrize(
    ("text", "payloads"),
    [
        ("(a: int8)[2]", [b"\1", b"\1\2\3"]),
        ("a: int8", [b"", b"\1\2"]),
        ("(a: int16)*", [b"\1", b"\1\2\3"]),
        ("(ok: bool)*", [b"\0", b"\1"]),
    ],
)
def test_payloads_together_have_the_error_of_the_first_that_does_not_fit(
    text: str, payloads: list[bytes]
) -> None:
    layout = Layout(text)
    (first, *_) = (error for one in payloads if (error := error_of(layout.parse, one)) is not None)
    assert str(error_of(layout.parse_all, payloads)) == str(first)


@MANY
@given(containers(), st.lists(st.binary(max_size=40), max_size=3), st.integers(1, 9), ORDERS)
def test_payloads_together_give_what_each_gives(
    case: tuple[Layout, bytes], others: list[bytes], times: int, order: ByteOrder
) -> None:
    layout, payload = case
    for payloads in ([payload] * times, [payload, *others] * times):
        errors = [error_of(layout.parse, one, order) for one in payloads]
        if any(errors):
            (first, *_) = (one for one in errors if one is not None)
            caught = error_of(layout.parse_all, payloads, order)
            assert (type(caught), str(caught)) == (type(first), str(first))
        else:
            each, together = (
                [layout.parse(one, order) for one in payloads],
                layout.parse_all(payloads, order),
            )
            assert repr(together) == repr(each)  # NaN, too
            assert [*map(type, together)] == [*map(type, each)]


@MANY
@given(layouts(), st.binary(max_size=60), st.booleans(), ORDERS)
def test_any_bytes_give_a_value_or_an_interpretation_error(
    text: str, payload: bytes, lenient: bool, order: ByteOrder
) -> None:
    layout = Layout(text, lenient=lenient)
    read: list[Callable[..., Any]] = [layout.parse, layout.parse_table, layout.sequence]
    for face in read:
        with suppress(InterpretationError):
            value = face(payload, order)
            assert face != layout.parse or isinstance(value, list) == layout.is_list
    if (error := error_of(layout.parse, payload, order)) is not None:
        assert isinstance(error, InterpretationError)
        assert 0 <= error.offset <= len(payload)
        assert error.expected is not None


@MANY
@example("a: string[" + "0" * 6000 + "1]")
@example("٣: int8")
@given(st.text() | st.text(alphabet="ab:,()[]*@# \nint8stringbool1mm_sequence", max_size=40))
def test_any_text_gives_a_layout_or_a_layout_error(text: str) -> None:
    error = error_of(Layout, text)
    if error is None:
        assert Layout(Layout(text).text) == Layout(text)
    else:
        assert isinstance(error, LayoutError)
        assert 0 <= error.position <= len(text)
