"""Rules to steps, without sockets: exact places, and that the size of the chunks means nothing."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.testing.proxy.byte_edits import Act, Editor, Gap, Hold, Note, Send, Step
from smartcam.testing.proxy.rules import (
    Coalesce,
    Cut,
    Drip,
    Drop,
    Duplicate,
    Flip,
    Insert,
    PointRule,
    RangeRule,
    Reset,
    Split,
    Stall,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

DATA = b"0123456789"


def fed(rules: Iterable[PointRule | RangeRule], *chunks: bytes) -> list[Step]:
    """Return every step but the notes."""
    editor = Editor(rules)
    steps = [step for chunk in (b"", *chunks) for step in editor.feed(chunk)]
    return [step for step in steps if not isinstance(step, Note)]


def written(steps: Iterable[Step]) -> bytes:
    return b"".join(bytes(step.data) for step in steps if isinstance(step, Send))


EDITS = [
    ([], b"0123456789"),
    ([Flip(at=0)], b"\xcf123456789"),
    ([Flip(at=9, mask=1)], b"0123456788"),
    ([Flip(at=4, count=2, mask=4)], b"0123016789"),
    ([Drop(at=0)], b"123456789"),
    ([Drop(at=3, count=4)], b"012789"),
    ([Drop(at=9, count=5)], b"012345678"),
    ([Drop(at=2, count=None)], b"01"),
    ([Insert(at=0, data=b"ab")], b"ab0123456789"),
    ([Insert(at=5, data=b"ab")], b"01234ab56789"),
    ([Insert(at=10, data=b"ab")], b"0123456789ab"),
    ([Insert(at=11, data=b"ab")], b"0123456789"),
    ([Duplicate(at=0, count=2)], b"01" + b"01" + b"23456789"),
    ([Duplicate(at=8, count=2)], b"012345678989"),
    ([Duplicate(at=9, count=2)], b"0123456789"),
    ([Flip(at=3, mask=3), Duplicate(at=2, count=2)], b"0120" + b"20" + b"456789"),
    ([Duplicate(at=2, count=4), Drop(at=3, count=2)], b"0125" + b"25" + b"6789"),
    ([Insert(at=5, data=b"a"), Insert(at=5, data=b"b")], b"01234ab56789"),
    ([Insert(at=4, data=b"a"), Cut(at=4), Insert(at=4, data=b"b")], b"0123a"),
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
    rules = (Flip(at=2), Insert(at=4, data=b"a"), Duplicate(at=5, count=2), Drop(at=8))
    assert len(fed(rules, DATA)) == 1


@pytest.mark.parametrize(
    ("rule", "step"),
    [
        (Split(at=4, pause=0.5), Gap(0.5)),
        (Coalesce(at=4, size=3), Hold(3, 1.0)),
        (Stall(at=4), Act(Stall(at=4))),
    ],
)
def test_point_in_the_middle_of_a_chunk_stands_between_two_writes(
    rule: PointRule, step: Step
) -> None:
    assert fed([rule], DATA) == [Send(DATA[:4]), step, Send(DATA[4:])]


@pytest.mark.parametrize("rule", [Cut(at=4), Reset(at=4)])
def test_nothing_comes_behind_an_end(rule: PointRule) -> None:
    assert fed([rule], DATA, DATA) == [Send(DATA[:4]), Act(rule)]  # type: ignore[arg-type]


def test_point_acts_as_soon_as_it_is_reached() -> None:
    editor = Editor([Cut(at=4)])
    assert editor.feed(b"") == []
    assert editor.feed(b"012") == [Send(b"012")]
    assert editor.feed(b"3")[-1] == Act(Cut(at=4))


def test_point_at_the_beginning_acts_before_any_byte() -> None:
    assert Editor([Cut()]).feed(b"") == [Note("cut", 0), Act(Cut())]


def test_drip_marks_its_range_only() -> None:
    steps = fed([Drip(at=2, count=3, pause=0.1)], DATA)
    assert steps == [Send(b"01"), Gap(0.0), Send(b"234", 0.1), Send(b"56789")]


def test_notes_name_only_what_is_reached_and_once() -> None:
    editor = Editor([Flip(at=2, count=4), Drop(at=20), Insert(at=3, data=b"x"), Flip(at=10)])
    steps = itertools.chain.from_iterable(editor.feed(bytes([byte])) for byte in DATA)
    notes = [step for step in steps if isinstance(step, Note)]
    assert notes == [Note("flip", 2), Note("insert", 3)]
    assert editor.position == 10


places = st.integers(0, 30)
edits = st.one_of(
    st.builds(Flip, at=places, count=st.integers(1, 8), mask=st.integers(1, 255)),
    st.builds(Drop, at=places, count=st.integers(1, 8)),
    st.builds(Insert, at=places, data=st.binary(min_size=1, max_size=4)),
    st.builds(Duplicate, at=places, count=st.integers(1, 8)),
    st.builds(Cut, at=places),
)


def plainly(rules: list[PointRule | RangeRule], data: bytes) -> bytes:
    """Do the same byte by byte, with no state but the bytes."""
    changed: list[bytes] = []
    out = b""
    for place in range(len(data) + 1):
        for rule in rules:
            if isinstance(rule, Insert) and rule.at == place:
                out += rule.data
            elif isinstance(rule, Cut) and rule.at == place:
                return out
            elif isinstance(rule, Duplicate) and rule.span.end == place:
                out += b"".join(changed[rule.at : place])
        byte = data[place : place + 1]
        for rule in rules:
            if isinstance(rule, RangeRule) and rule.at <= place < (rule.span.end or 0):
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


def test_rules_added_later_stand_behind_and_past_places_do_nothing() -> None:
    editor = Editor([Insert(at=6, data=b"a")])
    editor.feed(DATA[:4])
    editor.add([Insert(at=6, data=b"b"), Drop(at=3, count=4), Flip(at=4)])
    assert written(editor.feed(DATA[4:])) == b"\xcb5ab6789"
