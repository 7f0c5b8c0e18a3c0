"""Private names of the room that several of its tests use."""

from __future__ import annotations

from smartcam.emulator._generators import generator_names
from smartcam.emulator._links import _TcpLink

__all__ = ["_TcpLink", "generator_names"]
