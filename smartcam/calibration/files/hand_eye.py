"""A hand-eye calibration as plain data, as the store keeps it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from smartcam.calibration.codes import Code, Remark
from smartcam.calibration.files.cameras import (
    CameraData,
    MotionData,
    RemarkData,
    ViewData,
    camera_from_data,
    camera_to_data,
)
from smartcam.calibration.files.planes import Number
from smartcam.calibration.geometry.frames import Transform
from smartcam.calibration.hand_eye.equations import RobotSigmas, Setup
from smartcam.calibration.hand_eye.result import HandEyeCalibration
from smartcam.calibration.targets import target_from_data, target_to_data
from smartcam.calibration.views import TargetView
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from smartcam.calibration.geometry.rotations import Array
    from smartcam.calibration.targets import Target

__all__ = [
    "HandEyeData",
    "from_data",
    "motion_from_data",
    "motion_to_data",
    "to_data",
    "view_from_data",
    "view_to_data",
]


class HandEyeData(BaseModel):
    """Everything of a hand-eye calibration; the names are the attributes'."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")

    setup: Setup
    frames: tuple[str, str] = Field(description="the robot's base and its flange")
    camera_pose: MotionData
    target_pose: MotionData
    camera: CameraData | None
    target: dict[str, Any] | None
    target_scale: Number = Field(gt=0)
    method: str
    candidates: dict[str, Number | None] = Field(description="rms held-out error, m")
    errors: list[Number | None] = Field(min_length=3, description="m; null: none")
    mean_error: Number = Field(ge=0, description="m")
    leave_one_out: list[Number | None] = Field(min_length=3, description="m; null: none")
    held_out_error: Number | None = Field(description="m")
    covariance: list[list[Number]] | None = Field(description="rad and m; null: none")
    robot_sigmas: tuple[Number, Number] | None = Field(description="rad, m")
    robot_poses: list[MotionData] = Field(min_length=3, description="T_base_flange")
    used: list[bool] = Field(min_length=3)
    target_poses: list[MotionData] = Field(min_length=3, description="T_camera_target")
    views: list[ViewData]
    warnings: list[RemarkData]


def to_data(calibration: HandEyeCalibration) -> dict[str, Any]:
    """Return a calibration as JSON takes it, None for NaN."""
    first = calibration.robot_poses[0]
    known = np.isfinite(calibration.covariance).all()
    camera, views, sigmas = calibration.camera, calibration.views, calibration.robot_sigmas
    return {
        "setup": calibration.setup,
        "frames": [first.target, first.source],
        "camera_pose": motion_to_data(calibration.camera_pose),
        "target_pose": motion_to_data(calibration.target_pose),
        "camera": None if camera is None else camera_to_data(camera),
        "target": target_to_data(views[0].target) if views else None,
        "target_scale": calibration.target_scale,
        "method": calibration.method,
        "candidates": dict(calibration.candidates),
        "errors": _nulls(calibration.errors),
        "mean_error": calibration.mean_error,
        "leave_one_out": _nulls(calibration.leave_one_out),
        "held_out_error": calibration.held_out_error,
        "covariance": calibration.covariance.tolist() if known else None,
        "robot_sigmas": None if sigmas is None else list(sigmas),
        "robot_poses": [motion_to_data(one) for one in calibration.robot_poses],
        "used": list(calibration.used),
        "target_poses": [motion_to_data(one) for one in calibration.target_poses],
        "views": [view_to_data(one) for one in views],
        "warnings": [{"code": one.code.value, "text": one.text} for one in calibration.warnings],
    }


def from_data(data: Mapping[str, Any]) -> HandEyeCalibration:
    """Return the calibration that data were made of.

    Raises:
        CalibrationError: SHAPE: the data are no hand-eye calibration.
    """
    stored = _parsed(HandEyeData, data)
    _check_counts(stored)
    base, flange = stored.frames
    carries, shows = (flange, base) if stored.setup == "eye-in-hand" else (base, flange)
    target = None if stored.target is None else target_from_data(stored.target)
    return HandEyeCalibration(
        setup=stored.setup,
        camera_pose=_motion(stored.camera_pose, carries, "camera"),
        target_pose=_motion(stored.target_pose, shows, "target"),
        camera=None if stored.camera is None else camera_from_data(stored.camera.model_dump()),
        target_scale=stored.target_scale,
        method=stored.method,
        candidates=stored.candidates,
        errors=_numbers(stored.errors),
        mean_error=stored.mean_error,
        leave_one_out=_numbers(stored.leave_one_out),
        held_out_error=stored.held_out_error,
        covariance=_covariance(stored.covariance),
        robot_sigmas=None if stored.robot_sigmas is None else RobotSigmas(*stored.robot_sigmas),
        robot_poses=tuple(_motion(one, base, flange) for one in stored.robot_poses),
        used=tuple(stored.used),
        target_poses=tuple(_motion(one, "camera", "target") for one in stored.target_poses),
        views=tuple(_view(one, target) for one in stored.views if target is not None),
        warnings=tuple(Remark(one.code, one.text) for one in stored.warnings),
    )


def _nulls(values: Array) -> list[float | None]:
    return [None if math.isnan(value) else value for value in values.tolist()]


def _numbers(values: Sequence[float | None]) -> Array:
    return np.array([math.nan if value is None else value for value in values])


M = TypeVar("M", bound=BaseModel)


def _parsed(kind: type[M], data: Mapping[str, Any]) -> M:
    try:
        return kind.model_validate(data)
    except ValidationError as exc:
        first = exc.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise _no_calibration(f"{where}: {first['msg']}", first["input"]) from exc


def motion_to_data(transform: Transform) -> dict[str, Any]:
    """Return a rigid motion as JSON takes it, without its frames."""
    return {
        "rotation": transform.rotation.tolist(),
        "translation": transform.translation.tolist(),
    }


def _motion(stored: MotionData, target: str, source: str) -> Transform:
    return Transform(target, source, np.array(stored.rotation), np.array(stored.translation))


def motion_from_data(data: Mapping[str, Any], target: str, source: str) -> Transform:
    """Return the motion that :func:`motion_to_data` was made of.

    Raises:
        CalibrationError: SHAPE: the data are no motion.
    """
    return _motion(_parsed(MotionData, data), target, source)


def view_from_data(data: Mapping[str, Any], target: Target) -> TargetView:
    """Return the view that :func:`view_to_data` was made of.

    Raises:
        CalibrationError: SHAPE: the data are no view of this target.
    """
    return _view(_parsed(ViewData, data), target)


def view_to_data(view: TargetView) -> dict[str, Any]:
    """Return a view as JSON takes it, without its target."""
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
    if not count == len(stored.points) == len(stored.covariance):
        raise _no_calibration(f"views: expected {count} points", len(stored.points))
    if max(stored.ids, default=0) >= len(target.points):
        raise _no_calibration(f"views: expected ids below {len(target.points)}", max(stored.ids))
    return TargetView(
        target=target,
        size=stored.size,
        ids=np.array(stored.ids, dtype=np.intp),
        points=np.array(stored.points).reshape(-1, 2),
        covariance=np.array(stored.covariance).reshape(-1, 2, 2),
        margin=stored.margin,
        name=stored.name,
    )


def _covariance(stored: list[list[float]] | None) -> Array:
    if stored is None:
        return np.full((12, 12), np.nan)
    if len(stored) != 12 or any(len(row) != 12 for row in stored):
        raise _no_calibration("covariance: expected 12 rows of 12", len(stored))
    return np.array(stored)


def _check_counts(stored: HandEyeData) -> None:
    count = len(stored.robot_poses)
    for name in ("errors", "leave_one_out", "used", "target_poses"):
        if len(getattr(stored, name)) != count:
            raise _no_calibration(f"{name}: expected {count}", len(getattr(stored, name)))
    if stored.views and (stored.target is None or len(stored.views) != count):
        raise _no_calibration(f"views: expected {count}, and their target", len(stored.views))


def _no_calibration(text: str, got: object) -> CalibrationError:
    return CalibrationError(f"stored hand-eye calibration: {text}", code=Code.SHAPE, got=got)
