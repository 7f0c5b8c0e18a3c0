"""Private names of the room that several of its tests use."""

from __future__ import annotations

from smartcam.inspection._read.gs1 import elements

__all__ = ["elements"]
