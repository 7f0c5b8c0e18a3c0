"""Private names of the room that several of its tests use."""

from __future__ import annotations

from smartcam.protocols._base import UNDOCUMENTED
from smartcam.protocols._insight.dialect import NATIVE
from smartcam.protocols._insight.machine import InSightMachine

__all__ = ["NATIVE", "UNDOCUMENTED", "InSightMachine"]
