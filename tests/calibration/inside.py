"""Names behind the wall of the room that several of its tests use."""

from __future__ import annotations

from smartcam.calibration._files.directory import MAX_NAME_LENGTH
from smartcam.calibration._files.store import (
    BACKUPS,
    keep_backup,
    read,
    read_document,
    replace_file,
    write,
)
from smartcam.calibration._hand_eye.closed_forms import LINEAR
from smartcam.calibration._hand_eye.equations import Setup
from smartcam.calibration._homography import apply_homography, fit_homography
from smartcam.calibration._lens.bundle import lens_values, with_lens
from smartcam.calibration._lens.poses import half_turned
from smartcam.calibration._printing.page_layout import RULER_MM
from smartcam.calibration._printing.sheets import Rays
from smartcam.calibration._solvers import CameraPosition2D, RealWorldPosition
from smartcam.calibration.formats._cameras import CameraForm
from smartcam.calibration.wizards._journal import Journal
from smartcam.calibration.wizards._services import MAX_EARLIER_JOURNALS
from smartcam.calibration.wizards._view_suggestions import outline

__all__ = [
    "BACKUPS",
    "LINEAR",
    "MAX_EARLIER_JOURNALS",
    "MAX_NAME_LENGTH",
    "RULER_MM",
    "CameraForm",
    "CameraPosition2D",
    "Journal",
    "Rays",
    "RealWorldPosition",
    "Setup",
    "apply_homography",
    "fit_homography",
    "half_turned",
    "keep_backup",
    "lens_values",
    "outline",
    "read",
    "read_document",
    "replace_file",
    "with_lens",
    "write",
]
