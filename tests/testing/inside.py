"""Names behind the wall of the room that its kits or several of its tests use."""

from __future__ import annotations

from smartcam.testing.proxy._rules import (
    MAX_COPY_BYTES,
    MAX_HOLD_BYTES,
    Direction,
    PointRule,
    RangeRule,
)
