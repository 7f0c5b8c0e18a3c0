"""A sheet's calibration as plain data, as the store keeps it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from smartcam.calibration.codes import Code, Remark
from smartcam.calibration.files.cameras import (
    CameraData,
    RemarkData,
    ViewData,
    camera_from_data,
    camera_to_data,
)
from smartcam.calibration.files.hand_eye import view_from_data, view_to_data
from smartcam.calibration.files.planes import Number
from smartcam.calibration.files.planes import from_data as plane_from_data
from smartcam.calibration.sheet.calibration import SheetCalibration
from smartcam.calibration.sheet.plane import SheetPlane
from smartcam.calibration.targets import target_from_data, target_to_data
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["SheetData", "from_data", "to_data"]

Triple = tuple[Number, Number, Number]


class SheetData(BaseModel):
    """Everything of a sheet's calibration."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")

    target: dict[str, Any]
    view: ViewData
    camera: CameraData | None
    matrix: tuple[Triple, Triple, Triple] = Field(
        description="w (p, 1) = matrix (x, y, 1): from the sheet, m, to pixels or directions"
    )
    covariance: list[list[Number]] = Field(min_length=9, max_length=9)
    rms: Number = Field(ge=0, description="pixels")
    plane: dict[str, Any] = Field(description="from the sheet to the robot, a plane's data")
    camera_frame: str | None
    warnings: list[RemarkData] = Field(description="of the view; the touches' are the plane's")


def to_data(calibration: SheetCalibration) -> dict[str, Any]:
    """Return a calibration as JSON takes it."""
    sheet = calibration.sheet
    return {
        "target": target_to_data(calibration.view.target),
        "view": view_to_data(calibration.view),
        "camera": None if sheet.camera is None else camera_to_data(sheet.camera),
        "matrix": sheet.matrix.tolist(),
        "covariance": sheet.covariance.tolist(),
        "rms": calibration.rms,
        "plane": calibration.plane.to_data(),
        "camera_frame": calibration.camera_frame,
        "warnings": [{"code": one.code.value, "text": one.text} for one in calibration.remarks],
    }


def from_data(data: Mapping[str, Any]) -> SheetCalibration:
    """Return the calibration that data were made of.

    Raises:
        CalibrationError: SHAPE: the data are no sheet's calibration.
    """
    try:
        stored = SheetData.model_validate(data)
    except ValidationError as exc:
        first = exc.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise _no_calibration(f"{where}: {first['msg']}", first["input"]) from exc
    if any(len(row) != 9 for row in stored.covariance):
        raise _no_calibration("covariance: expected 9 rows of 9", len(stored.covariance))
    if abs(np.linalg.det(np.array(stored.matrix))) == 0.0:
        raise _no_calibration("matrix: expected one that can be inverted", stored.matrix)
    view = view_from_data(stored.view.model_dump(), target_from_data(stored.target))
    camera = None if stored.camera is None else camera_from_data(stored.camera.model_dump())
    return SheetCalibration(
        view=view,
        sheet=SheetPlane(view.size, stored.matrix, stored.covariance, camera),
        plane=plane_from_data(stored.plane),
        rms=stored.rms,
        camera_frame=stored.camera_frame,
        remarks=tuple(Remark(one.code, one.text) for one in stored.warnings),
    )


def _no_calibration(text: str, got: object) -> CalibrationError:
    return CalibrationError(f"stored sheet's calibration: {text}", code=Code.SHAPE, got=got)
