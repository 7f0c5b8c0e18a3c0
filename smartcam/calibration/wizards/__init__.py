"""Wizards, which guide people through a calibration step by step, in any front-end."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.calibration.wizards._hand_eye import hand_eye_wizard
    from smartcam.calibration.wizards._plane import plane_wizard
    from smartcam.calibration.wizards._sequence import Wizard, WizardSession, ask
    from smartcam.calibration.wizards._services import CalibrationService
    from smartcam.calibration.wizards._sheet import sheet_wizard
    from smartcam.calibration.wizards._steps import (
        Flag,
        Number,
        Option,
        Step,
        Text,
        as_lists,
        from_lists,
    )
    from smartcam.calibration.wizards._verification import drift_wizard

__all__ = [
    "CalibrationService",
    "Flag",
    "Number",
    "Option",
    "Step",
    "Text",
    "Wizard",
    "WizardSession",
    "as_lists",
    "ask",
    "drift_wizard",
    "from_lists",
    "hand_eye_wizard",
    "plane_wizard",
    "sheet_wizard",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_hand_eye": "hand_eye_wizard",
            "_plane": "plane_wizard",
            "_sequence": "Wizard WizardSession ask",
            "_services": "CalibrationService",
            "_sheet": "sheet_wizard",
            "_steps": "Flag Number Option Step Text as_lists from_lists",
            "_verification": "drift_wizard",
        },
    )
