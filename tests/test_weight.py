"""Rooms keep within their lines in ``docs/architecture/rooms.md``, and pages within their words."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from tests import ROOT
from tests.strategies import over

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

PAGE = ROOT / "docs" / "architecture" / "rooms.md"
MAX_WORDS = 100_000
"""Largest number of words of all pages together."""
BESIDE = "beside the rooms"
"""The table's name for the modules directly in smartcam."""


def budgets() -> dict[str, int]:
    """Return the table: lines at most by the rooms that share them."""
    table = PAGE.read_text(encoding="utf-8").partition("\n## Weight\n")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| ([^|]+) \| ([\d,]+) \| [^|]*\|$", table, re.MULTILINE)
    return {rooms: int(lines.replace(",", "")) for rooms, lines in rows}


def lines_of(files: Iterable[Path]) -> int:
    """Return how many lines some files have together."""
    return sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)


def files_of(name: str) -> Iterable[Path]:
    """Return the modules of a room."""
    if name == BESIDE:
        return (ROOT / "smartcam").glob("*.py")
    return (ROOT / "tests" if name == "tests" else ROOT / "smartcam" / name).rglob("*.py")


@over("rooms", budgets())
def test_rooms_keep_within_their_lines(rooms: str) -> None:
    found = sum(lines_of(files_of(name)) for name in rooms.split(", "))
    assert found <= budgets()[rooms]


def test_each_room_is_in_the_table_once() -> None:
    named = [name for rooms in budgets() for name in rooms.split(", ")]
    there = {one.name for one in (ROOT / "smartcam").iterdir() if any(one.glob("*.py"))}
    assert sorted(named) == sorted([*there, BESIDE, "tests"])


def test_pages_keep_within_their_words() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    assert sum(len(page.read_text(encoding="utf-8").split()) for page in pages) <= MAX_WORDS
