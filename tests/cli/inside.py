"""Private names of the room that several of its tests use."""

from __future__ import annotations

from smartcam._cli.calibrate import calibrate

__all__ = ["calibrate"]
