"""What ``pytest --pyargs smartcam.testing.conformance`` runs."""

from __future__ import annotations

from smartcam.testing.conformance.suite import CameraConformance

__all__ = ["TestCamera"]


class TestCamera(CameraConformance):
    """The camera of ``--camera-url``."""
