"""Names of the dialects in which cameras and clients are judged."""

from __future__ import annotations

SMART_DIALECTS: tuple[str, ...] = ("handbook", "thesis", "b16")
"""The dialects of smart cameras: with a run mode, unasked statuses, and no result codes."""

EVERY_DIALECT: tuple[str, ...] = (*SMART_DIALECTS, "bid")
"""Names of all dialects."""
