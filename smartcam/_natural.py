"""Sort names by the numbers in them, as people do: view 2 before view 10."""

from __future__ import annotations

import re


def natural(name: str) -> list[tuple[int, str]]:
    """Return the sort key of a name: its texts and its numbers, in turn."""
    parts = re.split(r"([0-9]+)", name)
    return [(int(part), part) if index % 2 else (0, part) for index, part in enumerate(parts)]
