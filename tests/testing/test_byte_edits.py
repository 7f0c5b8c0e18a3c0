"""Rules to edits, without sockets: exact places, and that the size of the chunks means nothing."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.testing.proxy import (
    CoalesceBytes,
    Cut,
    Drip,
    DropBytes,
    DuplicateBytes,
    Flip,
    InsertBytes,
    ResetConnection,
    SplitBytes,
    Stall,
)
from smartcam.testing.proxy._byte_edits import BOTH_STALL, CUT, RESET, STALL, Edit, Editor
from tests.testing.inside import PointRule, RangeRule

DATA = b"0123456789"


def fed(rules: Iterable[PointRule | RangeRule], *chunks: bytes) -> list[Edit]:
    """Return every edit but the notes."""
    editor = Editor(rules)
    edits = [edit for chunk in (b"", *chunks) for edit in editor.feed(chunk)]
    return [edit for edit in edits if not edit.effects]


def written(edits: Iterable[Edit]) -> bytes:
    return b"".join(part for edit in edits for part in edit.parts)


def shown(edits: Iterable[Edit]) -> list[object]:
    """Return each as what it does: its end, what it gathers, its parts and pauses, or its bytes."""
    return [
        edit.end or edit.gather or ((edit.parts, edit.pauses) if edit.pauses else edit.parts[0])
        for edit in edits
    ]


def gap(seconds: float) -> object:
    return [b"", b""], [seconds]


EDITS = [
    ([], b"0123456789"),
    ([Flip(at=0)], b"\xcf123456789"),
    ([Flip(at=9, mask=1)], b"0123456788"),
    ([Flip(at=4, count=2, mask=4)], b"0123016789"),
    ([DropBytes(at=0)], b"123456789"),
    ([DropBytes(at=3, count=4)], b"012789"),
    ([DropBytes(at=9, count=5)], b"012345678"),
    ([DropBytes(at=2, count=None)], b"01"),
    ([InsertBytes(at=0, data=b"ab")], b"ab0123456789"),
    ([InsertBytes(at=5, data=b"ab")], b"01234ab56789"),
    ([InsertBytes(at=10, data=b"ab")], b"0123456789ab"),
    ([InsertBytes(at=11, data=b"ab")], b"0123456789"),
    ([DuplicateBytes(at=0, count=2)], b"01" + b"01" + b"23456789"),
    ([DuplicateBytes(at=8, count=2)], b"012345678989"),
    ([DuplicateBytes(at=9, count=2)], b"0123456789"),
    ([Flip(at=3, mask=3), DuplicateBytes(at=2, count=2)], b"0120" + b"20" + b"456789"),
    ([DuplicateBytes(at=2, count=4), DropBytes(at=3, count=2)], b"0125" + b"25" + b"6789"),
    ([InsertBytes(at=5, data=b"a"), InsertBytes(at=5, data=b"b")], b"01234ab56789"),
    ([InsertBytes(at=4, data=b"a"), Cut(at=4), InsertBytes(at=4, data=b"b")], b"0123a"),
]


@pytest.mark.parametrize(("rules", "expected"), EDITS)
def test_edit_is_exact_whole_and_byte_by_byte(
    rules: list[PointRule | RangeRule], expected: bytes
) -> None:
    single = [bytes([byte]) for byte in DATA]
    assert written(fed(rules, DATA)) == expected
    assert written(fed(rules, *single)) == expected
    for at in range(1, len(DATA)):
        assert written(fed(rules, DATA[:at], DATA[at:])) == expected


def test_edit_that_needs_no_new_segment_makes_none() -> None:
    rules = (
        Flip(at=2),
        InsertBytes(at=4, data=b"a"),
        DuplicateBytes(at=5, count=2),
        DropBytes(at=8),
    )
    assert len(fed(rules, DATA)) == 1


@pytest.mark.parametrize(
    ("rule", "edit"),
    [
        (SplitBytes(at=4, pause=0.5), gap(0.5)),
        (CoalesceBytes(at=4, size=3), (3, 1.0)),
        (Stall(at=4), STALL),
        (Stall(at=4, both=True), BOTH_STALL),
    ],
)
def test_point_in_the_middle_of_a_chunk_stands_between_two_writes(
    rule: PointRule, edit: object
) -> None:
    assert shown(fed([rule], DATA)) == [DATA[:4], edit, DATA[4:]]


@pytest.mark.parametrize(("rule", "end"), [(Cut(at=4), CUT), (ResetConnection(at=4), RESET)])
def test_nothing_comes_after_an_end(rule: PointRule, end: Any) -> None:
    assert shown(fed([rule], DATA, DATA)) == [DATA[:4], end]


def test_point_acts_as_soon_as_it_is_reached() -> None:
    editor = Editor([Cut(at=4)])
    assert editor.feed(b"") == []
    assert shown(editor.feed(b"012")) == [b"012"]
    assert editor.feed(b"3")[-1].end == CUT


def test_point_at_the_beginning_acts_before_any_byte() -> None:
    note, end = Editor([Cut()]).feed(b"")
    assert (note.effects, note.at, end.end) == (["cut"], 0, CUT)


def test_drip_marks_its_range_only() -> None:
    edits = shown(fed([Drip(at=2, count=3, pause=0.1)], DATA))
    assert edits == [b"01", gap(0.0), ([b"2", b"3", b"4", b""], [0.1] * 3), b"56789"]


def test_notes_name_only_what_is_reached_and_once() -> None:
    rules = [Flip(at=2, count=4), DropBytes(at=20), InsertBytes(at=3, data=b"x"), Flip(at=10)]
    editor = Editor(rules)
    edits = itertools.chain.from_iterable(editor.feed(bytes([byte])) for byte in DATA)
    notes = [(edit.effects, edit.at) for edit in edits if edit.effects]
    assert notes == [(["flip"], 2), (["insert"], 3)]
    assert editor.position == 10


places = st.integers(0, 30)
edits = st.one_of(
    st.builds(Flip, at=places, count=st.integers(1, 8), mask=st.integers(1, 255)),
    st.builds(DropBytes, at=places, count=st.integers(1, 8)),
    st.builds(InsertBytes, at=places, data=st.binary(min_size=1, max_size=4)),
    st.builds(DuplicateBytes, at=places, count=st.integers(1, 8)),
    st.builds(Cut, at=places),
)


def plainly(rules: list[PointRule | RangeRule], data: bytes) -> bytes:
    """Do the same byte by byte, with no state but the bytes."""
    changed: list[bytes] = []
    out = b""
    for place in range(len(data) + 1):
        for rule in rules:
            if isinstance(rule, InsertBytes) and rule.at == place:
                out += rule.data
            elif isinstance(rule, Cut) and rule.at == place:
                return out
            elif isinstance(rule, DuplicateBytes) and rule.end == place:
                out += b"".join(changed[rule.at : place])
        byte = data[place : place + 1]
        for rule in rules:
            if isinstance(rule, RangeRule) and rule.at <= place < (rule.end or 0):
                byte = rule.change(byte)
        changed.append(byte)
        out += byte
    return out


@given(st.lists(edits, max_size=6), st.lists(st.binary(min_size=1, max_size=12), max_size=5))
def test_any_rules_and_chunks_give_what_the_plain_way_gives(
    rules: list[PointRule | RangeRule], chunks: list[bytes]
) -> None:
    # ends of ranges and points at one place go by the list's order, as in the plain way
    assert written(fed(rules, *chunks)) == plainly(rules, b"".join(chunks))


def test_rules_added_later_come_after_and_past_places_do_nothing() -> None:
    editor = Editor([InsertBytes(at=6, data=b"a")])
    editor.feed(DATA[:4])
    editor.add_rules([InsertBytes(at=6, data=b"b"), DropBytes(at=3, count=4), Flip(at=4)])
    assert written(editor.feed(DATA[4:])) == b"\xcb5ab6789"
