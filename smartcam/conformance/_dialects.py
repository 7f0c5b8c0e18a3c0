"""Names of the dialects in which cameras and clients are judged."""

from __future__ import annotations

SMART: tuple[str, ...] = ("handbook", "thesis", "b16")
"""The dialects of smart cameras: with a run mode, unasked statuses, and no result codes."""

EVERY_DIALECT: tuple[str, ...] = (*SMART, "bid")
"""Names of all dialects."""
