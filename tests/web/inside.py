"""Private names of the room that several of its tests use."""

from __future__ import annotations

from smartcam.web import _clouds, _fleet

__all__ = ["_clouds", "_fleet"]
