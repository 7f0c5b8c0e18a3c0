"""The units of values: of records, of classes, of tables."""

from __future__ import annotations

import copy
import pickle
from dataclasses import dataclass
from typing import Annotated

from smartcam.layout import Layout
from smartcam.layout._inside import ShownUnits, units_of

LAYOUT = Layout("n: int16, x: real32 mm, a: real32 deg, q: real32 percent, t: int16 ms, p: int8 px")
SYMBOLS = {"x": "m", "a": "rad", "t": "s", "p": "px"}


@dataclass
class Part:
    x: Annotated[float, "real32 mm"]
    ok: bool


def test_record_knows_the_units_of_its_values() -> None:
    record = LAYOUT.parse(bytes(LAYOUT.size))
    pickled = pickle.loads(pickle.dumps(record))  # noqa: S301 - of this test
    for one in (record, copy.copy(record), pickled, copy.deepcopy(record)):
        assert units_of(one) == SYMBOLS


def test_records_of_the_same_names_have_units_of_their_own() -> None:
    first, second = Layout("x: real32 mm").parse(bytes(4)), Layout("x: real32").parse(bytes(4))
    assert (units_of(first), units_of(second)) == ({"x": "m"}, {})
    assert first == second


def test_head_and_list_know_theirs() -> None:
    value = Layout("h: int16 mm, parts: (x: int16 deg)*").parse(bytes(4))
    assert units_of(value) == {"h": "m"}
    assert units_of(value.parts) == {"x": "rad"}


def test_object_of_a_class_knows_them_by_its_annotations() -> None:
    assert units_of(Part(0.1, True)) == {"x": "m"}
    assert units_of([Part(0.1, True)]) == {"x": "m"}


def test_table_knows_them_by_its_layout_only() -> None:
    layout = Layout("(x: int16 mm)*")
    table = layout.parse_table(bytes(4))
    assert (units_of(table), units_of(table, layout)) == ({}, {"x": "m"})


def test_values_without_units_have_none() -> None:
    for value in (None, [], b"ab", "text", 3, {"x": 1.0}, [1, 2], print):
        assert units_of(value) == {}


def test_value_is_shown_in_the_unit_that_is_wanted() -> None:
    units = ShownUnits(["inch", "deg"])
    assert units.shown(0.0254, "m") == 1.0
    assert units.of("rad").name == "deg"
    assert ShownUnits().shown(0.0254, "m") == 0.0254
    assert units.shown(2.0, "s") == 2.0
    assert units.shown(None, "m") is None
    assert units.shown(True, "m") is True
