"""Private names of the room that its kits or several of its tests use."""

from __future__ import annotations

from smartcam.conformance.camera._report import CameraReport
from smartcam.conformance.client._runs import ClientRun, run_scene
from smartcam.conformance.client._scenes import SCENES
from smartcam.conformance.client._tasks import (
    Client,
    CommandClient,
    FunctionClient,
    Outcome,
    read_results,
)
