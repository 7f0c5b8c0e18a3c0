"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.calibration._drawing.files import draw_file
    from smartcam.calibration._files.load import AnyCalibration
    from smartcam.calibration._least_squares import independent_parts
    from smartcam.calibration._lens.comparison import (
        Lens,
        LensComparison,
        compare_estimates,
        rig_difference,
    )
    from smartcam.calibration._lens.uncertainty import MapFigures
    from smartcam.calibration._plane.drawing import draw
    from smartcam.calibration._printing.sheets import target_from_description
    from smartcam.calibration._stereo.rectification import Rectification, rectify
    from smartcam.calibration._targets import Target
    from smartcam.calibration._units import METRES_PER_UNIT, LengthUnit
    from smartcam.calibration._verdict import doubt_text
    from smartcam.calibration.formats._cameras import (
        MAX_CAMERA_FILE_BYTES,
        CameraInfo,
        parse_camera_info,
    )
    from smartcam.calibration.formats._lenses import StoredLenses, read_lenses
    from smartcam.calibration.formats._robots import ROBOTS
    from smartcam.calibration.wizards._listing import list_calibrations
    from smartcam.calibration.wizards._pictures import (
        MAX_PICTURE_BYTES,
        PICTURE_SUFFIXES,
        PictureFolder,
        decode_picture,
    )
    from smartcam.calibration.wizards._steps import Input
    from smartcam.calibration.wizards._thesis import (
        CalibrationCamera,
        CalibrationsByCamera,
        CalibrationStart,
        PixelPoseRequest,
        StepRequest,
        ThesisCalibration,
    )
    from smartcam.calibration.wizards._verification import VERIFICATION_WIZARD
    from smartcam.calibration.wizards._view_suggestions import STANDARD_VIEWS, suggest_view

__all__ = [
    "MAX_CAMERA_FILE_BYTES",
    "MAX_PICTURE_BYTES",
    "METRES_PER_UNIT",
    "PICTURE_SUFFIXES",
    "ROBOTS",
    "STANDARD_VIEWS",
    "VERIFICATION_WIZARD",
    "AnyCalibration",
    "CalibrationCamera",
    "CalibrationStart",
    "CalibrationsByCamera",
    "CameraInfo",
    "Input",
    "LengthUnit",
    "Lens",
    "LensComparison",
    "MapFigures",
    "PictureFolder",
    "PixelPoseRequest",
    "Rectification",
    "StepRequest",
    "StoredLenses",
    "Target",
    "ThesisCalibration",
    "compare_estimates",
    "decode_picture",
    "doubt_text",
    "draw",
    "draw_file",
    "independent_parts",
    "list_calibrations",
    "parse_camera_info",
    "read_lenses",
    "rectify",
    "rig_difference",
    "suggest_view",
    "target_from_description",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "formats._robots": "ROBOTS",
            "_drawing.files": "draw_file",
            "_files.load": "AnyCalibration",
            "_least_squares": "independent_parts",
            "_lens.comparison": "LensComparison Lens compare_estimates rig_difference",
            "_lens.uncertainty": "MapFigures",
            "_plane.drawing": "draw",
            "_printing.sheets": "target_from_description",
            "_stereo.rectification": "Rectification rectify",
            "_targets": "Target",
            "_units": "LengthUnit METRES_PER_UNIT",
            "_verdict": "doubt_text",
            "formats._cameras": "CameraInfo MAX_CAMERA_FILE_BYTES parse_camera_info",
            "formats._lenses": "StoredLenses read_lenses",
            "wizards._listing": "list_calibrations",
            "wizards._pictures": "PictureFolder MAX_PICTURE_BYTES PICTURE_SUFFIXES decode_picture",
            "wizards._steps": "Input",
            "wizards._thesis": "CalibrationCamera CalibrationsByCamera CalibrationStart "
            "PixelPoseRequest StepRequest ThesisCalibration",
            "wizards._verification": "VERIFICATION_WIZARD",
            "wizards._view_suggestions": "STANDARD_VIEWS suggest_view",
        },
    )
