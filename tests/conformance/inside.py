"""Names behind the wall of the room that its kits or several of its tests use."""

from __future__ import annotations

from smartcam.conformance.camera._report import CameraReport
from smartcam.conformance.client._tasks import Client, read_results
