"""Depth: from two cameras to metres, clouds, and what is done to them.

Distances are metres, in the frame of the left camera after rectification: x right, y down, z ahead.
A depth of 0 is none. The extra ``depth`` brings OpenCV and small-gicp.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

__all__: list[str] = []

if not TYPE_CHECKING:
    __getattr__ = lazy(__name__, {})
