"""Where the target is in many views, at once: one adjustment of all instead of one of each."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np

from smartcam.calibration._geometry.frames import Transform
from smartcam.calibration._geometry.rigid import Rigid
from smartcam.calibration._lens.bundle import Bundle, Sight, adjust
from smartcam.calibration._lens.poses import (
    CAMERA,
    SAME,
    TARGET,
    TargetPose,
    check_view,
    locate,
    plane_poses,
    view_rms,
)
from smartcam.calibration._lens.projection import excess, whitening

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.calibration._lens.bundle import AdjustedBundle
    from smartcam.calibration._lens.model import CameraModel
    from smartcam.calibration._views import TargetView


def locate_all(views: Sequence[TargetView], camera: CameraModel) -> list[TargetPose]:
    """Return what :func:`~smartcam.calibration._lens.poses.locate` gives of each view.

    Raises as it does.
    """
    for one in views:
        check_view(one, camera.size)
    starts = [plane_poses(one, camera) for one in views]
    if not views or any(len(one) != 2 for one in starts):
        return [locate(one, camera) for one in views]
    found = _adjusted(views, starts, camera)
    if found is None:
        return [locate(one, camera) for one in views]
    # beside the covariance each view has what its better pose leaves over
    wider = []
    for number, view in enumerate(views):
        off = min((one.residuals[number] for one in found), key=lambda off: _squares(off, view))
        more = excess(off, view.covariance, off.size - 6)
        wider.append(dataclasses.replace(view, covariance=view.covariance + more * np.eye(2)))
    poses = [[one.bundle.poses.taken([i]) for one in found] for i in range(len(views))]
    found = _adjusted(wider, poses, camera)
    if found is None:
        return [locate(one, camera) for one in views]
    return [_better(number, one, found) for number, one in enumerate(wider)]


def _adjusted(
    views: Sequence[TargetView], starts: Sequence[Sequence[Rigid]], camera: CameraModel
) -> list[AdjustedBundle] | None:
    """Return the adjustment from the likelier poses and that from the others; None: one failed."""
    sights = [Sight(0, number, one) for number, one in enumerate(views)]
    found = []
    for begin in zip(*starts, strict=True):
        poses = Rigid(*(np.concatenate(part) for part in zip(*begin, strict=True)))
        found.append(adjust(Bundle.single(camera, poses), sights, 0.0))
    return found if all(math.isfinite(one.weighted) for one in found) else None


def _squares(off: np.ndarray, view: TargetView) -> float:
    white = whitening(view.covariance, 0.0) @ off[..., None]
    return float((white**2).sum())


def _better(number: int, view: TargetView, found: Sequence[AdjustedBundle]) -> TargetPose:
    best, other = sorted(found, key=lambda one: _squares(one.residuals[number], view))
    pose, second = (one.bundle.poses.taken(number) for one in (best, other))
    rms = view_rms(best.residuals[number])
    apart = bool(pose.angle_to(second) > SAME)
    return TargetPose(
        transform=Transform(CAMERA, TARGET, *pose),
        covariance=best.pose_covariance[number],
        residuals=best.residuals[number],
        rms=rms,
        ambiguity=rms / view_rms(other.residuals[number]) if apart else 0.0,
        other=Transform(CAMERA, TARGET, *second) if apart else None,
    )
