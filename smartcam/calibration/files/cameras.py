"""Calibrations of cameras and of pairs as plain data, as the store keeps them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from smartcam.calibration.codes import Code, Remark
from smartcam.calibration.files.planes import Number
from smartcam.calibration.geometry.frames import Transform
from smartcam.calibration.lens.coverage import Coverage
from smartcam.calibration.lens.intrinsics import IntrinsicCalibration, ViewFit
from smartcam.calibration.lens.model import CameraModel, DistortionModel
from smartcam.calibration.lens.poses import CAMERA, TARGET
from smartcam.calibration.stereo.calibration import LEFT, RIGHT, PairFit, StereoCalibration
from smartcam.calibration.targets import target_from_data, target_to_data
from smartcam.calibration.views import TargetView
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from smartcam.calibration.geometry.rotations import Array
    from smartcam.calibration.targets import Target

__all__ = [
    "CameraData",
    "IntrinsicData",
    "MotionData",
    "PairData",
    "RemarkData",
    "StereoData",
    "ViewData",
    "ViewFitData",
    "camera_from_data",
    "camera_to_data",
    "intrinsics_from_data",
    "intrinsics_to_data",
    "stereo_from_data",
    "stereo_to_data",
]

Pair = tuple[Number, Number]
Triple = tuple[Number, Number, Number]
Open = Number | None
Bar = Annotated[Number, Field(ge=0, le=1)]


class _Stored(BaseModel):
    """Whatever is stored: nothing more than its fields, none of them changed."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")


class CameraData(_Stored):
    """A lens."""

    size: tuple[int, int] = Field(description="width and height, pixels")
    matrix: tuple[Triple, Triple, Triple] = Field(description="pixels")
    distortion: list[Number]
    distortion_model: DistortionModel


class MotionData(_Stored):
    """A rigid motion."""

    rotation: tuple[Triple, Triple, Triple]
    translation: Triple = Field(description="m")


class ViewData(_Stored):
    """A target as one image shows it."""

    size: tuple[int, int] = Field(description="width and height, pixels")
    ids: list[Annotated[int, Field(ge=0)]]
    points: list[Pair] = Field(description="pixels")
    covariance: list[tuple[Pair, Pair]] = Field(description="pixels^2")
    margin: Number | None = None
    name: str = ""


class RemarkData(_Stored):
    """One warning."""

    code: Code
    text: str


class ViewFitData(_Stored):
    """One view of a calibration of a camera."""

    view: ViewData
    used: bool
    pose: MotionData = Field(description="T_camera_target")
    residuals: list[Pair] = Field(description="pixels")
    rms: Number = Field(ge=0, description="pixels")
    held_out: Open = Field(description="pixels; null: none")


class IntrinsicData(_Stored):
    """Everything of a calibration of a camera; the names are the attributes'."""

    target: dict[str, Any]
    camera: CameraData
    covariance: list[list[Number]]
    views: list[ViewFitData] = Field(min_length=1)
    rms: Number = Field(ge=0, description="pixels")
    sigma: Number = Field(ge=0, description="pixels")
    held_out: Open = Field(description="pixels; null: none")
    coverage: tuple[Bar, Bar, Bar, Bar] = Field(description="x, y, size, skew")
    sheet: list[Triple] | None = Field(description="m; null: as meant")
    warnings: list[RemarkData]


class PairData(_Stored):
    """One pair of views of a calibration of two cameras."""

    left: ViewData | None
    right: ViewData | None
    used: tuple[bool, bool]
    pose: MotionData | None = Field(description="T_left_target")
    rms: tuple[Open, Open] = Field(description="pixels; null: none")
    held_out: Open = Field(description="m; null: none")
    epipolar: Open = Field(description="pixels; null: none")


class StereoData(_Stored):
    """Everything of a calibration of two cameras; the names are the attributes'."""

    target: dict[str, Any]
    left: CameraData
    right: CameraData
    transform: MotionData = Field(description="T_right_left")
    covariance: list[list[Number]] = Field(min_length=6, max_length=6)
    pairs: list[PairData] = Field(min_length=1)
    rms: Number = Field(ge=0, description="pixels")
    sigma: Number = Field(ge=0, description="pixels")
    epipolar: Number = Field(ge=0, description="pixels")
    held_out: Open = Field(description="m; null: none")
    held_out_epipolar: Open = Field(description="pixels; null: none")
    sheet: list[Triple] | None = Field(description="m; null: as meant")
    warnings: list[RemarkData]


def intrinsics_to_data(calibration: IntrinsicCalibration) -> dict[str, Any]:
    """Return a calibration as JSON takes it, None for NaN."""
    return {
        "target": target_to_data(calibration.views[0].view.target),
        "camera": camera_to_data(calibration.camera),
        "covariance": calibration.covariance.tolist(),
        "views": [
            {
                "view": _view_to_data(fit.view),
                "used": fit.used,
                "pose": _motion_to_data(fit.transform),
                "residuals": fit.residuals.tolist(),
                "rms": fit.rms,
                "held_out": _closed(fit.held_out),
            }
            for fit in calibration.views
        ],
        "rms": calibration.rms,
        "sigma": calibration.sigma,
        "held_out": _closed(calibration.held_out),
        "coverage": list(calibration.coverage),
        "sheet": _sheet_to_data(calibration.sheet),
        "warnings": [{"code": one.code.value, "text": one.text} for one in calibration.warnings],
    }


def intrinsics_from_data(data: Mapping[str, Any]) -> IntrinsicCalibration:
    """Return the calibration that data were made of.

    Raises:
        CalibrationError: SHAPE: the data are no calibration of a camera.
    """
    stored = _checked(IntrinsicData, data)
    target, camera = target_from_data(stored.target), _camera(stored.camera)
    count = 4 + len(camera.distortion)
    return IntrinsicCalibration(
        camera=camera,
        covariance=_array(stored.covariance, (count, count), "covariance"),
        views=tuple(_fit(one, target) for one in stored.views),
        rms=stored.rms,
        sigma=stored.sigma,
        held_out=_opened(stored.held_out),
        coverage=Coverage(*stored.coverage),
        sheet=_sheet(stored.sheet, target),
        warnings=tuple(Remark(one.code, one.text) for one in stored.warnings),
    )


def stereo_to_data(calibration: StereoCalibration) -> dict[str, Any]:
    """Return a calibration as JSON takes it, None for NaN."""
    views = [view for pair in calibration.pairs for view in (pair.left, pair.right) if view]
    return {
        "target": target_to_data(views[0].target),
        "left": camera_to_data(calibration.left),
        "right": camera_to_data(calibration.right),
        "transform": _motion_to_data(calibration.transform),
        "covariance": calibration.covariance.tolist(),
        "pairs": [
            {
                "left": _view_to_data(pair.left) if pair.left else None,
                "right": _view_to_data(pair.right) if pair.right else None,
                "used": list(pair.used),
                "pose": _motion_to_data(pair.transform) if pair.transform else None,
                "rms": [_closed(value) for value in pair.rms],
                "held_out": _closed(pair.held_out),
                "epipolar": _closed(pair.epipolar),
            }
            for pair in calibration.pairs
        ],
        "rms": calibration.rms,
        "sigma": calibration.sigma,
        "epipolar": calibration.epipolar,
        "held_out": _closed(calibration.held_out),
        "held_out_epipolar": _closed(calibration.held_out_epipolar),
        "sheet": _sheet_to_data(calibration.sheet),
        "warnings": [{"code": one.code.value, "text": one.text} for one in calibration.warnings],
    }


def stereo_from_data(data: Mapping[str, Any]) -> StereoCalibration:
    """Return the calibration that data were made of.

    Raises:
        CalibrationError: SHAPE: the data are no calibration of two cameras.
    """
    stored = _checked(StereoData, data)
    target = target_from_data(stored.target)
    return StereoCalibration(
        left=_camera(stored.left),
        right=_camera(stored.right),
        transform=_motion(stored.transform, RIGHT, LEFT),
        covariance=_array(stored.covariance, (6, 6), "covariance"),
        pairs=tuple(_pair(one, target) for one in stored.pairs),
        rms=stored.rms,
        sigma=stored.sigma,
        epipolar=stored.epipolar,
        held_out=_opened(stored.held_out),
        held_out_epipolar=_opened(stored.held_out_epipolar),
        sheet=_sheet(stored.sheet, target),
        warnings=tuple(Remark(one.code, one.text) for one in stored.warnings),
    )


def camera_to_data(camera: CameraModel) -> dict[str, Any]:
    """Return a lens as JSON takes it."""
    return {
        "size": list(camera.size),
        "matrix": camera.matrix.tolist(),
        "distortion": camera.distortion.tolist(),
        "distortion_model": camera.distortion_model,
    }


def camera_from_data(data: Mapping[str, Any]) -> CameraModel:
    """Return the lens that data were made of.

    Raises:
        CalibrationError: SHAPE: the data are no lens.
    """
    return _camera(_checked(CameraData, data))


M = TypeVar("M", bound=BaseModel)


def _checked(kind: type[M], data: Mapping[str, Any]) -> M:
    try:
        return kind.model_validate(data)
    except ValidationError as exc:
        first = exc.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise _broken(f"{where}: {first['msg']}", first["input"]) from exc


def _broken(text: str, got: object) -> CalibrationError:
    return CalibrationError(f"stored calibration of cameras: {text}", code=Code.SHAPE, got=got)


def _closed(value: float) -> float | None:
    return None if math.isnan(value) else value


def _opened(value: float | None) -> float:
    return math.nan if value is None else value


def _array(values: Sequence[Any], shape: tuple[int, ...], what: str) -> Array:
    """Return values that must have a shape, which lists of lists may not have."""
    try:
        found = np.array(values, dtype=np.float64)
    except ValueError:
        found = np.zeros(0)
    if not math.prod(shape):
        return np.zeros(shape)
    if found.shape != shape:
        raise _broken(f"{what}: expected shape {shape}", found.shape)
    return found


def _sheet_to_data(sheet: Array | None) -> list[list[float]] | None:
    return None if sheet is None else sheet.tolist()


def _sheet(stored: list[Triple] | None, target: Target) -> Array | None:
    return None if stored is None else _array(stored, target.points.shape, "sheet")


def _camera(stored: CameraData) -> CameraModel:
    return CameraModel(
        size=stored.size,
        matrix=np.array(stored.matrix),
        distortion=np.array(stored.distortion),
        distortion_model=stored.distortion_model,
    )


def _motion_to_data(transform: Transform) -> dict[str, Any]:
    return {
        "rotation": transform.rotation.tolist(),
        "translation": transform.translation.tolist(),
    }


def _motion(stored: MotionData, target: str, source: str) -> Transform:
    return Transform(target, source, np.array(stored.rotation), np.array(stored.translation))


def _view_to_data(view: TargetView) -> dict[str, Any]:
    return {
        "size": list(view.size),
        "ids": view.ids.tolist(),
        "points": view.points.tolist(),
        "covariance": view.covariance.tolist(),
        "margin": view.margin,
        "name": view.name,
    }


def _view(stored: ViewData, target: Target) -> TargetView:
    count = len(stored.ids)
    if max(stored.ids, default=0) >= len(target.points):
        raise _broken(f"ids: expected less than {len(target.points)}", max(stored.ids))
    return TargetView(
        target=target,
        size=stored.size,
        ids=np.array(stored.ids, dtype=np.intp),
        points=_array(stored.points, (count, 2), "points"),
        covariance=_array(stored.covariance, (count, 2, 2), "covariance of the points"),
        margin=stored.margin,
        name=stored.name,
    )


def _fit(stored: ViewFitData, target: Target) -> ViewFit:
    view = _view(stored.view, target)
    return ViewFit(
        view=view,
        used=stored.used,
        transform=_motion(stored.pose, CAMERA, TARGET),
        residuals=_array(stored.residuals, (len(view.ids), 2), "residuals"),
        rms=stored.rms,
        held_out=_opened(stored.held_out),
    )


def _pair(stored: PairData, target: Target) -> PairFit:
    return PairFit(
        left=None if stored.left is None else _view(stored.left, target),
        right=None if stored.right is None else _view(stored.right, target),
        used=stored.used,
        transform=None if stored.pose is None else _motion(stored.pose, LEFT, TARGET),
        rms=(_opened(stored.rms[0]), _opened(stored.rms[1])),
        held_out=_opened(stored.held_out),
        epipolar=_opened(stored.epipolar),
    )
