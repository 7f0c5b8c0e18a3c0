"""The tests that ``pytest --pyargs smartcam.conformance.camera`` runs."""

from __future__ import annotations

from smartcam.conformance.camera._suite import CameraConformance


class TestCamera(CameraConformance):
    """The camera of ``--camera-url``."""
