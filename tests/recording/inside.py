"""Names behind the wall of the room that several of its tests use."""

from __future__ import annotations

from smartcam.recording import _recorder
from smartcam.recording._mcap.form import KINDS, Item, message_fields, message_of, nanoseconds

__all__ = ["KINDS", "Item", "_recorder", "message_fields", "message_of", "nanoseconds"]
