"""All parsers, and their budgets as ``results/budgets.md`` has them."""

from __future__ import annotations

import re
from typing import NamedTuple

from tests import ROOT
from tests.budgets.parser import Parser
from tests.calibration import budgets as _calibration
from tests.depth import budgets as _depth
from tests.emulator import budgets as _emulator
from tests.fleet import budgets as _fleet
from tests.frames import budgets as _frames
from tests.gateway import budgets as _gateway
from tests.inspection import budgets as _inspection
from tests.interpreters import budgets as _interpreters
from tests.layout import budgets as _layout
from tests.makes import budgets as _makes
from tests.outlets import budgets as _outlets
from tests.protocols import budgets as _protocols
from tests.recording import budgets as _recording
from tests.ros1 import budgets as _ros1
from tests.ros2 import budgets as _ros2
from tests.web import budgets as _web

PARSERS: dict[str, Parser] = {
    one.name: one
    for room in (
        _calibration,
        _depth,
        _emulator,
        _fleet,
        _frames,
        _gateway,
        _inspection,
        _interpreters,
        _layout,
        _makes,
        _outlets,
        _protocols,
        _recording,
        _ros1,
        _ros2,
        _web,
    )
    for one in room.PARSERS
}
"""Every parser of foreign bytes by its name."""


class _Text:
    """A text that each piece is copied to: an attribute, which nobody makes longer in its place."""

    def __init__(self) -> None:
        self.text = ""

    def add(self, piece: str) -> None:
        self.text += piece


def _copied(pieces: list[bytes]) -> None:
    found = _Text()
    for piece in pieces:
        found.add(piece.decode())


EXAMPLE = Parser(
    "copies for each piece",
    _copied,
    {"pieces": lambda size: [b"a" * 36] * (size // 36)},
    1 << 20,
    "an example of what must not be",
    size=1 << 18,
)

PAGE = ROOT / "results" / "budgets.md"

SPEED = 2_000_000_000
"""Instructions a second of a processor that is not new."""


class Budget(NamedTuple):
    """A row of the page's table.

    Attributes:
        largest: bytes of the largest input.
        bound: what says so.
        instructions: of the processor for each byte, at most.
        memory: bytes for each byte, at most, beside :data:`FREE`.
    """

    largest: str
    bound: str
    instructions: int
    memory: int


FREE = 40 << 20
"""Bytes of memory that every parser may take whatever it is given."""


def budgets() -> dict[str, Budget]:
    """Return the page's table, by parser."""
    text = PAGE.read_text(encoding="utf-8")
    found = re.findall(
        r"^\| ([^|]+) \| ([^|]+) \| ([^|]+) \| ([\d,]+) \| ([\d,]+) \| [^|]+ \|$",
        text,
        re.MULTILINE,
    )
    return {
        name: Budget(largest, bound, *(int(one.replace(",", "")) for one in numbers))
        for name, largest, bound, *numbers in found
    }


def shown(size: int) -> str:
    """Return a number of bytes as the page has it."""
    for unit, name in ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB")):
        if size >= unit:
            return f"{size / unit:.3g} {name}"
    return f"{size} bytes"


def seconds(parser: Parser, instructions: int) -> str:
    """Return how long the largest input takes at most, as the page has it."""
    if parser.largest >= 1 << 40:
        return "-"
    return f"{parser.largest * instructions / SPEED:.2g}"


def row(parser: Parser, instructions: int, memory: int) -> str:
    """Return a row of the page's table."""
    largest = "any" if parser.largest >= 1 << 40 else shown(parser.largest)
    return (
        f"| {parser.name} | {largest} | `{parser.bound}` | {instructions:,} | {memory:,} | "
        f"{seconds(parser, instructions)} |"
    )
