"""Inputs that the parsers of several rooms read."""

from __future__ import annotations

import functools

from smartcam.models import Status
from smartcam.protocols import LineRow
from smartcam.protocols import messages as m
from smartcam.ros2 import RosTypes
from tests.budgets.parser import Make, fill, fill_text

UDP_BYTES = 65_507
"""Bytes of the largest datagram."""

LINE_ROWS = (
    LineRow(m.Connect, "HELLO", m.ConnectAnswer, lambda _: m.ConnectAnswer(version=1)),
    LineRow(m.Query, "ASK", m.QueryAnswer, lambda said: m.QueryAnswer(application=int(said))),
    LineRow(
        m.SetClock,
        "C {year} {month} {day} {hour} END",
        m.SetClockAnswer,
        lambda _: m.SetClockAnswer(),
    ),
    LineRow(None, "", m.StatusReport, lambda said: {"S": m.StatusReport(status=Status(0))}[said]),
)

TEXT_LINES: dict[str, Make] = {
    "short lines": fill(b"S\n"),
    "empty lines": fill(b"\n"),
    "a line without an end": fill(b"x"),
    "a line that nearly fits": lambda size: b"C" + b" 1" * (min(size, 4000) // 2) + b"\n",
    "half line ends": fill(b"\r"),
}

MERGED = "mappings merged one into the other"

PAST_LOOKAHEAD = 1500
"""Bytes from which on PyYAML's work grows with the input: until 1,024 characters behind an opening
bracket it may be a key, and for each token all open brackets are looked at."""

YAML: dict[str, Make] = {
    "a long list": fill_text("- 1\n"),
    "a list in brackets": fill_text("1,", "[", "]"),
    "keys": fill_text("k{}: 1\n"),
    "one key again and again": fill_text("k: 1\n"),
    "nested brackets": fill_text("["),
    "nested mappings": fill_text("{a: "),
    "nested lists": lambda size: "- " * (size // 2),
    "quotation marks": fill_text("'' "),
    "a text that does not end": fill_text("a", '"'),
    "a long text": fill_text("a "),
    "a text of many lines": fill_text("  a\n", "|\n"),
    "a folded text": fill_text("  a\n\n", ">\n"),
    "comments": fill_text("# a\n", tail="a: 1"),
    "anchors": fill_text("- &a{} 1\n"),
    "aliases": fill_text("- *a\n", "- &a [1]\n"),
    "aliases of aliases": lambda size: laughs_of(size),
    "merged mappings": fill_text("- {<<: *a, k{}: 1}\n", "- &a {b: 1, c: 2}\n"),
    "a mapping merged many times": lambda size: (
        "- &a {b: 1}\n- <<: [" + "*a, " * (size // 4) + "*a]\n"
    ),
    MERGED: lambda size: (
        "- &a0 {b: 1}\n"
        + "".join(f"- &a{n + 1} {{<<: *a{n}, k{n}: 1}}\n" for n in range(size // 30))
    ),
    "keys that are aliases of aliases": lambda size: laughs_of(size) + "? *a9\n: 1\n",
    "a number of many digits": fill_text("9", "a: "),
    "a number of many zeros": fill_text("0", "a: 0."),
    "a number to the base 60": fill_text(":1", "a: 1"),
    "numbers with an exponent": fill_text("- 1e999999999\n"),
    "tags": fill_text("- !!int x{}\n"),
    "documents": fill_text("--- 1\n"),
    "complex keys": fill_text("? [a{}]\n: 1\n"),
    "directives": fill_text("%TAG !a{}! tag:\n", tail="--- 1\n"),
    "escapes": fill_text("\\x41", '"', '"'),
    "binary": fill_text("AAAA", "!!binary "),
    "dates": fill_text("- 2001-01-01 1:1:1\n"),
}


def laughs_of(size: int) -> str:
    lines = ["- &a0 [1, 1]"]
    lines += [f"- &a{n + 1} [*a{n}, *a{n}]" for n in range(max(10, size // 20))]
    return "\n".join(lines) + "\n"


JSON: dict[str, Make] = {
    "a list": fill_text("1,", "[", "1]"),
    "lists in a list": fill_text("[],", "[", "1]"),
    "nested lists": fill_text("["),
    "nested objects": fill_text('{"a":'),
    "keys": fill_text('"k{}":1,', "{", '"z":1}'),
    "a long text": fill_text("a", '"', '"'),
    "escapes": fill_text("\\u0041", '"', '"'),
    "a number of many digits": fill_text("9"),
    "numbers with an exponent": fill_text("1e999999999,", "[", "1]"),
    "no end": fill_text("a", '"'),
}


@functools.cache
def ros_types() -> RosTypes:
    types = RosTypes("jazzy")
    types.add("a_b/msg/Part", "")
    types.add("a_b/msg/Parts", "Part[] parts\nstring[] texts\nuint8[] data\nfloat64[] numbers\n")
    return types
