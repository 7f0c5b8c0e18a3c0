"""For tests that look at what a client has inside."""

from __future__ import annotations

from typing import Any

from smartcam import Camera, SmartCamera


def inside(camera: Camera[Any]) -> SmartCamera[Any]:
    """Return a camera at the wire as what it is."""
    assert isinstance(camera, SmartCamera)
    return camera
