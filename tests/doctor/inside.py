"""Private names of the room that several of its tests use."""

from __future__ import annotations

from smartcam.doctor._findings import Exit

__all__ = ["Exit"]
