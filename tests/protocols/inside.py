"""Names behind the wall of the room that several of its tests use."""

from __future__ import annotations

from smartcam.protocols._base import UNDOCUMENTED

__all__ = [
    "UNDOCUMENTED",
]
