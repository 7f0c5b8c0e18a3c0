"""Names behind the wall of the room that several of its tests use."""

from __future__ import annotations

from smartcam.ros1._json_messages import from_json

__all__ = ["from_json"]
