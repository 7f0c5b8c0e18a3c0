"""Names of the dialects that cameras and clients are judged in."""

from __future__ import annotations

SMART: tuple[str, ...] = ("handbook", "thesis", "b16")
"""The dialects of smart cameras: with a run mode, statuses by themselves, and no result codes."""

EVERY_DIALECT: tuple[str, ...] = (*SMART, "bid")
"""Names of all dialects."""
