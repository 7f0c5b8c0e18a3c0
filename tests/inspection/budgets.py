"""Parsers of the room for :mod:`tests.budgets`, with the hardest inputs."""

from __future__ import annotations

from tests.budgets.parser import Make, Parser, fill_text
from tests.inspection.inside import split_elements

_ELEMENTS: dict[str, Make] = {
    "elements of a length": fill_text("11250101"),
    "elements with an end": fill_text("10A\x1d"),
    "one element": fill_text("a", "10"),
    "separators": fill_text("\x1d"),
    "no numbers": fill_text("\u00b2"),
}

PARSERS: tuple[Parser, ...] = (
    Parser(
        "GS1 elements",
        split_elements,
        _ELEMENTS,
        4_000,
        "inspection._read.tool.MAX_TEXT_BYTES",
        size=1000,
    ),
)
