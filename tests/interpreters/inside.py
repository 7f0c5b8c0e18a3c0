"""Names behind the wall of the room that several of its tests use."""

from __future__ import annotations

from smartcam.interpreters._basic import TableInterpreter

__all__ = [
    "TableInterpreter",
]
