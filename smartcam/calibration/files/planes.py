"""A plane calibration as plain data, as the store keeps it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    StrictBool,
    ValidationError,
)

from smartcam.calibration.codes import Code, Remark
from smartcam.calibration.geometry.rotations import LARGEST
from smartcam.calibration.plane.calibration import PlaneCalibration
from smartcam.calibration.plane.fitting import Frame, ModelName
from smartcam.calibration.plane.mapping import PlaneMap
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from smartcam.calibration.geometry.rotations import Array

__all__ = ["Number", "PlaceData", "PlaneData", "RemarkData", "from_data", "to_data"]


def _bounded(value: float) -> float:
    if abs(value) > LARGEST:
        raise ValueError(f"expected a number up to {LARGEST:g}")
    return value


Number = Annotated[FiniteFloat, AfterValidator(_bounded)]
"""A number that may stand in a file: what is calculated of a few of them is finite, too."""

Pair = tuple[Number, Number]
Triple = tuple[Number, Number, Number]
NonNegative = Annotated[Number, Field(ge=0)]
Open = tuple[Number | None, Number | None, Number | None]


class _Stored(BaseModel):
    """Whatever is stored: nothing more than its fields, none of them changed."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")


class PlaceData(_Stored):
    """Centre and size of the points in both spaces."""

    camera: Pair = Field(description="centre, in the camera's unit")
    camera_size: Number = Field(gt=0, description="rms distance from it")
    robot: Triple = Field(description="centre, m")
    robot_size: Number = Field(gt=0, description="rms distance from it, m")


class RemarkData(_Stored):
    """One warning."""

    code: Code
    text: str


class PlaneData(_Stored):
    """Everything of a plane calibration; the names are the attributes'."""

    model: ModelName | Literal["touches"]
    camera_points: list[Pair] = Field(min_length=3, description="the camera's unit")
    robot_points: list[Triple] = Field(min_length=3, description="m")
    weights: list[NonNegative] = Field(min_length=3, description="0: the point was left out")
    matrix: tuple[Triple, Triple, Triple, Triple] = Field(
        description="w (x, y, z, 1) = matrix (u, v, 1), m"
    )
    place: PlaceData
    unit_covariance: list[list[Number]] = Field(min_length=12, max_length=12)
    residuals: list[Triple] = Field(min_length=3, description="m")
    leave_one_out: list[Open] = Field(min_length=3, description="m; null: none")
    freedom: int = Field(ge=0)
    touch_sigma: Number | None = Field(ge=0, description="m")
    sigma_given: bool
    candidates: dict[str, Number | None] = Field(description="rms held-out error, m")
    nominal_scale: Number | None = Field(gt=0, description="m for each unit of the camera")
    tool_z: Triple | None = None
    height: Number = Field(0.0, description="over the touched plane, m")
    robot_frame: str
    camera_frame: str | None = None
    y_down: StrictBool | None = Field(None, description="y was turned up; null: not known")
    warnings: list[RemarkData]


def to_data(calibration: PlaneCalibration) -> dict[str, Any]:
    """Return a calibration as JSON takes it, None for NaN."""
    place = calibration.place
    tool_z = calibration.tool_z
    return {
        "model": calibration.model,
        "camera_points": calibration.camera_points.tolist(),
        "robot_points": calibration.robot_points.tolist(),
        "weights": calibration.weights.tolist(),
        "matrix": calibration.matrix.tolist(),
        "place": {
            "camera": place.camera.tolist(),
            "camera_size": place.camera_size,
            "robot": place.robot.tolist(),
            "robot_size": place.robot_size,
        },
        "unit_covariance": calibration.unit_covariance.tolist(),
        "residuals": calibration.residuals.tolist(),
        "leave_one_out": [
            [None if math.isnan(value) else value for value in row]
            for row in calibration.leave_one_out.tolist()
        ],
        "freedom": calibration.freedom,
        "touch_sigma": calibration.touch_sigma,
        "sigma_given": calibration.sigma_given,
        "candidates": dict(calibration.candidates),
        "nominal_scale": calibration.nominal_scale,
        "tool_z": None if tool_z is None else tool_z.tolist(),
        "height": calibration.height,
        "robot_frame": calibration.robot_frame,
        "camera_frame": calibration.camera_frame,
        "y_down": calibration.y_down,
        "warnings": [{"code": one.code.value, "text": one.text} for one in calibration.warnings],
    }


def from_data(data: Mapping[str, Any]) -> PlaneCalibration:
    """Return the calibration that data were made of.

    Raises:
        CalibrationError: SHAPE: the data are no plane calibration; NOT_FINITE: its matrix maps
            nothing anywhere.
    """
    try:
        stored = PlaneData.model_validate(data)
        _check_counts(stored)
    except ValidationError as exc:
        first = exc.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise _no_calibration(f"{where}: {first['msg']}", first["input"]) from exc
    place = stored.place
    PlaneMap(_array(stored.matrix), _array(place.camera))  # refused here, not with the first part
    return PlaneCalibration(
        model=stored.model,
        camera_points=_array(stored.camera_points),
        robot_points=_array(stored.robot_points),
        weights=_array(stored.weights),
        matrix=_array(stored.matrix),
        place=Frame(_array(place.camera), place.camera_size, _array(place.robot), place.robot_size),
        unit_covariance=_array(stored.unit_covariance),
        residuals=_array(stored.residuals),
        leave_one_out=_array(
            [math.nan if value is None else value for value in row] for row in stored.leave_one_out
        ),
        freedom=stored.freedom,
        touch_sigma=stored.touch_sigma,
        sigma_given=stored.sigma_given,
        candidates=stored.candidates,
        nominal_scale=stored.nominal_scale,
        tool_z=None if stored.tool_z is None else _array(stored.tool_z),
        height=stored.height,
        robot_frame=stored.robot_frame,
        camera_frame=stored.camera_frame,
        y_down=stored.y_down,
        warnings=tuple(Remark(one.code, one.text) for one in stored.warnings),
    )


def _array(values: Iterable[Any]) -> Array:
    return np.array(list(values), dtype=np.float64)


def _check_counts(stored: PlaneData) -> None:
    count = len(stored.camera_points)
    for name in ("robot_points", "weights", "residuals", "leave_one_out"):
        if len(getattr(stored, name)) != count:
            raise _no_calibration(f"{name}: expected {count}", len(getattr(stored, name)))
    if np.count_nonzero(stored.weights) < 3:
        raise _no_calibration("weights: expected 3 that are not 0", stored.weights)
    if any(len(row) != 12 for row in stored.unit_covariance):
        raise _no_calibration("unit_covariance: expected rows of 12", None)


def _no_calibration(text: str, got: object) -> CalibrationError:
    return CalibrationError(f"stored plane calibration: {text}", code=Code.SHAPE, got=got)
