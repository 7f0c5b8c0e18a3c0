"""Keys that match patterns."""

from __future__ import annotations

import importlib
import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smartcam.fleet._inside import Keys, patterns_overlap

CHUNKS = ("a", "b", "*", "**")
SHORT = [
    "/".join(chunks) for count in (1, 2, 3) for chunks in itertools.product(CHUNKS, repeat=count)
]
NAMES = [
    "/".join(chunks) for count in range(1, 5) for chunks in itertools.product("ab", repeat=count)
]
PATTERNS = st.lists(st.sampled_from(CHUNKS), min_size=1, max_size=4).map("/".join)


def means(pattern: list[str], name: list[str]) -> bool:
    """Return True if a name is meant, tried in every way."""
    if not pattern:
        return not name
    if pattern[0] == "**":
        return any(means(pattern[1:], name[place:]) for place in range(len(name) + 1))
    return bool(name) and pattern[0] in {"*", name[0]} and means(pattern[1:], name[1:])


MEANT = {
    pattern: {name for name in NAMES if means(pattern.split("/"), name.split("/"))}
    for pattern in SHORT
}


@pytest.mark.parametrize("one", SHORT)
def test_patterns_meet_where_a_name_is_meant_by_both(one: str) -> None:
    """Two patterns of three chunks have at most four patterns in common."""
    for other in SHORT:
        common = MEANT[one] & MEANT[other]
        assert patterns_overlap(one, other) == bool(common), (one, other)


@given(pattern=PATTERNS, name=st.sampled_from(NAMES))
def test_pattern_means_names(pattern: str, name: str) -> None:
    meant = means(pattern.split("/"), name.split("/"))
    assert patterns_overlap(pattern, name) == patterns_overlap(name, pattern) == meant


@pytest.mark.real_time
@settings(max_examples=300)
@given(one=PATTERNS, other=PATTERNS)
def test_patterns_meet_as_the_engine_says(one: str, other: str) -> None:
    zenoh = importlib.import_module("zenoh")
    left, right = zenoh.KeyExpr.autocanonize(one), zenoh.KeyExpr.autocanonize(other)
    assert patterns_overlap(one, other) == left.intersects(right)


@pytest.mark.real_time
def test_keys_are_keys_of_the_engine() -> None:
    zenoh = importlib.import_module("zenoh")
    keys = Keys("plant")
    every = [
        keys.agent("desk-1"),
        keys.camera("desk-1", "line1/cam3"),
        keys.program("operator-robot-1.secret"),
        keys.command("desk-1", "line1/cam3"),
        *(keys.ask(role, "desk-1", "line1/cam3") for role in ("viewer", "operator")),
        keys.reply("robot-1"),
        keys.states("line1/cam3"),
        keys.results("line1/cam3"),
    ]
    for one, other in itertools.product(every, repeat=2):
        assert zenoh.KeyExpr(one).intersects(zenoh.KeyExpr(other)) == (one == other)
    assert keys.tail(every[1], "presence/camera") == ["desk-1", "line1", "cam3"]
    for pattern in ("*", "**"):
        other_fleet = Keys("plant2").camera("*", pattern)
        assert not any(patterns_overlap(other_fleet, one) for one in every)
