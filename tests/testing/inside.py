"""Private names of the room that its kits or several of its tests use."""

from __future__ import annotations

from smartcam.testing.proxy import _log
from smartcam.testing.proxy._log import Entry
from smartcam.testing.proxy._rules import (
    MAX_COPY_BYTES,
    MAX_RULE_BYTES,
    Direction,
    PointRule,
    RangeRule,
)
