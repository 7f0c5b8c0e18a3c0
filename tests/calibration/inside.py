"""Private names of the room that several of its tests use."""

from __future__ import annotations

from smartcam.calibration._files import store
from smartcam.calibration._files.store import keep_backup, read, read_document, replace_file, write
from smartcam.calibration._hand_eye.closed_forms import LINEAR
from smartcam.calibration._hand_eye.equations import Setup
from smartcam.calibration._homography import apply_homography, fit_homography
from smartcam.calibration._lens.bundle import lens_values, with_lens
from smartcam.calibration._lens.poses import half_turned
from smartcam.calibration._printing.sheets import Rays
from smartcam.calibration._solvers import CameraPosition2D, RealWorldPosition
from smartcam.calibration.formats._cameras import CameraForm
from smartcam.calibration.simulation import _scenes
from smartcam.calibration.wizards._journal import Journal
from smartcam.calibration.wizards._view_suggestions import outline

__all__ = [
    "LINEAR",
    "CameraForm",
    "CameraPosition2D",
    "Journal",
    "Rays",
    "RealWorldPosition",
    "Setup",
    "_scenes",
    "apply_homography",
    "fit_homography",
    "half_turned",
    "keep_backup",
    "lens_values",
    "outline",
    "read",
    "read_document",
    "replace_file",
    "store",
    "with_lens",
    "write",
]
