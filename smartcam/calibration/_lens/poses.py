"""Find the pose of a target in front of a camera with a known lens."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Final

import numpy as np

from smartcam._extras import load
from smartcam.calibration._files import storage
from smartcam.calibration._lens.bundle import AdjustedBundle, Bundle, IndexedView, adjust
from smartcam.calibration._lens.projection import excess_variance
from smartcam.calibration._views import TargetView, check_type
from smartcam.geometry import CameraModel, Transform
from smartcam.geometry._inside import Code, Rigid, exp_rotation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.calibration._targets import Target
    from smartcam.geometry._inside import Array

CAMERA: Final = "camera"
"""Name of the camera's frame."""

TARGET: Final = "target"
"""Name of the target's frame."""

# T_camera_target
PoseInCamera = Annotated[Transform, storage.motion(lambda _: (CAMERA, TARGET))]

MIN_POINTS: Final = 4
"""The pose of a plane needs at least this many of its points."""

MIN_SPREAD_RATIO: Final = 1e-3
"""Points are on a line if their spread across it is less than this fraction of the spread along
it."""

MAX_OUTSIDE_RATIO: Final = 0.1
"""A point may lie outside of the image by this fraction of the image's sides."""

MIN_HANDEDNESS: Final = 0.5
"""The handedness of a view, from -1 to 1, is near -1 in a correct view and must be below minus this
value. If it is above this value, the view shows the sheet in a mirror. Views of steep sheets and of
fisheyes have -0.8."""

MAX_RAY_SHIFT_RATIO: Final = 1e-9
"""Rays are shifted by at most this fraction of the focal length, to avoid rounding errors in
OpenCV."""

MAX_AMBIGUOUS_RATIO: Final = 4.0
"""Both poses of a view are refined if the squared residuals of one are at most this many times
those of the other."""

MAX_SAME_TURN_RADIANS: Final = 1e-3
"""Two poses turned by less than this angle, rad, are the same minimum."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TargetPose:
    """The result of :func:`locate`.

    Attributes:
        transform: ``T_camera_target``.
        covariance: (6, 6), of a small turn (rad) and shift (m) of the target in the camera's frame:
            the rotation is ``exp([turn]x) R``. It is computed from the points' covariance, enlarged
            if the residuals are larger than that covariance explains. It does not include errors of
            the lens.
        residuals: (N, 2), seen minus projected, pixels.
        rms: RMS of a coordinate of the residuals, pixels, corrected for their degrees of freedom.
        ambiguity: RMS of this pose over that of the other possible pose: near 1 if the points
            cannot show which pose is right, as for a plane that is far away or seen head-on; 0 if
            there is no other pose.
        other: the other possible pose; None if there is none.
    """

    transform: Transform
    covariance: Array
    residuals: Array
    rms: float
    ambiguity: float
    other: Transform | None = None


def locate(view: TargetView, camera: CameraModel) -> TargetPose:
    """Return the pose of a target in the camera's frame.

    The image of a plane is explained by two poses. Both are refined by the reprojection error, each
    point weighted by its covariance and by the additional variance that the residuals show; the
    better one is returned.

    Args:
        view: view of at least 4 points of the target that are not on a line.
        camera: the lens, for images of the same size.

    Raises:
        CalibrationError: ``TOO_FEW`` points; ``COLLINEAR`` points; ``WRONG_SIZE``: the image has
            another size than the camera's, or points lie far outside of it; ``MIRRORED``: the
            picture was flipped; ``POOR_FIT``: the points have wrong numbers, or no pose puts them
            in front of the camera; ``SHAPE``: the arguments are no view and no camera.
    """
    check_type(camera, CameraModel, "pose of the target: camera")
    check_view(view, camera.size)
    indexed = [IndexedView(0, 0, view)]
    fits = [
        adjust(Bundle.single(camera, start), indexed, 0.0) for start in plane_poses(view, camera)
    ]
    fits = sorted(
        (fit for fit in fits if math.isfinite(fit.weighted_squares)),
        key=lambda fit: fit.weighted_squares,
    )
    if not fits:
        raise Code.POOR_FIT.error(
            f"pose of the target{_in_view(view)}: expected one in front of the camera that "
            f"explains where its {len(view.ids)} points are seen, got none",
            "a pose in front of the camera",
        )
    extra_variance = excess_variance(fits[0].residuals[0], view.covariance, fits[0].freedom)
    if extra_variance:
        fits = [adjust(fit.bundle, indexed, extra_variance) for fit in fits]
    best, pose = fits[0], fits[0].bundle.poses
    other = next(
        (fit for fit in fits[1:] if pose.angle_to(fit.bundle.poses)[0] > MAX_SAME_TURN_RADIANS),
        None,
    )
    rms = view_rms(best.residuals[0])
    return TargetPose(
        transform=_transform(best),
        covariance=best.pose_covariance[0],
        residuals=best.residuals[0],
        rms=rms,
        ambiguity=rms / view_rms(other.residuals[0]) if other else 0.0,
        other=_transform(other) if other else None,
    )


def _transform(fit: AdjustedBundle) -> Transform:
    return Transform(CAMERA, TARGET, *fit.bundle.poses.subset(0))


def view_rms(residuals: Array) -> float:
    """Return the RMS of a coordinate of residuals (N, 2), corrected for a pose's six parameters."""
    # E[sum r^2] = sigma^2 (2 N - 6): each fitted parameter takes one square away.
    return math.sqrt(float((residuals**2).sum()) / (2 * len(residuals) - 6))


def check_view(view: TargetView, size: tuple[int, int]) -> None:
    """Raise an error if a view does not determine the pose, or if its image has another size.

    Raises the errors of :func:`locate`.
    """
    label = f"pose of the target{_in_view(check_type(view, TargetView, 'pose of the target'))}"
    count = len(view.ids)
    if count < MIN_POINTS:
        raise Code.TOO_FEW.error_with_value(
            f"{label}: expected {MIN_POINTS} points or more", MIN_POINTS, count
        )
    if tuple(view.size) != tuple(size):
        raise Code.WRONG_SIZE.error(
            f"{label}: expected an image of {size[0]} x {size[1]} pixels, got {view.size[0]} x "
            f"{view.size[1]}",
            size,
            view.size,
        )
    _check_inside(view, label)
    plane = view.object_points[:, :2]
    spread = np.linalg.svd(plane - plane.mean(axis=0), compute_uv=False)
    if spread[1] < MIN_SPREAD_RATIO * spread[0]:
        raise Code.COLLINEAR.error(
            f"{label}: expected points that are not on one line, got {count} on one",
            got=view.ids.tolist(),
        )
    _check_numbering(view, label)


def _check_inside(view: TargetView, label: str) -> None:
    """Raise ``WRONG_SIZE`` for points that are far outside of the image."""
    sides = np.array(view.size)
    excess = (np.maximum(-view.points, view.points - (sides - 1)) / sides).max(axis=1)
    row = int(np.argmax(excess))
    if excess[row] > MAX_OUTSIDE_RATIO:
        point = view.points[row].tolist()
        raise Code.WRONG_SIZE.error(
            f"{label}: expected points in the image of {sides[0]} x {sides[1]} pixels, "
            f"got {point} in row {row}",
            view.size,
            point,
        )


def _check_numbering(view: TargetView, label: str) -> None:
    """Raise ``MIRRORED`` for a mirrored sheet, and ``POOR_FIT`` for points with wrong numbers."""
    handedness = view.handedness
    if handedness > MIN_HANDEDNESS:
        raise Code.MIRRORED.error(
            f"{label}: expected the target's y axis to the left of its x axis, as on the sheet, "
            "got a view as in a mirror: was the picture flipped, or are u and v exchanged?",
            "y to the left of x",
            handedness,
        )
    if handedness > -MIN_HANDEDNESS:
        raise Code.POOR_FIT.error(
            f"{label}: expected points with the numbers that they have on {view.target}, got an "
            f"order that agrees with it by {-handedness:.2g} of 1 only",
            MIN_HANDEDNESS,
            -handedness,
        )


def half_turn(target: Target) -> Rigid:
    """Return the half turn, in a target's frame, after which the target looks the same."""
    return Rigid(np.diag([-1.0, -1.0, 1.0]), target.points[0] + target.points[-1])


def half_turned(view: TargetView) -> TargetView:
    """Return a view whose points are numbered from the target's other end."""
    ids = len(view.target.points) - 1 - view.ids[::-1]
    return dataclasses.replace(
        view, ids=ids, points=view.points[::-1], covariance=view.covariance[::-1]
    )


def _in_view(view: TargetView) -> str:
    return f" in {view.name}" if view.name else ""


def plane_poses(view: TargetView, camera: CameraModel) -> list[Rigid]:
    """Return the two poses that explain a plane's image, each in an array of one.

    The likelier one comes first.

    Source: Collins and Bartoli, Infinitesimal Plane-based Pose Estimation (2014).
    """
    rays = camera.directions(view.points)
    poses = _solve_ippe(view.object_points, rays)
    if not poses:  # exact rays: OpenCV took the root of a negative rounding error
        poses = _solve_ippe(
            view.object_points, rays + MAX_RAY_SHIFT_RATIO * np.sin(np.arange(len(rays)))[:, None]
        )
    return poses


def likeliest_poses(views: Sequence[TargetView], camera: CameraModel) -> Rigid:
    """Return the likelier of the two poses of each view, not yet refined.

    Raises ``POOR_FIT`` if no pose puts the target in front of the camera.
    """
    return Rigid.stack(_likeliest(view, camera) for view in views)


def _likeliest(view: TargetView, camera: CameraModel) -> Rigid:
    poses = [pose.subset(0) for pose in plane_poses(view, camera)]
    residuals = (camera.project(pose.apply(view.object_points)) - view.points for pose in poses)
    squares = [float(np.nan_to_num((pixels**2).sum(), nan=math.inf)) for pixels in residuals]
    best, second, *_ = [*sorted(squares), math.inf, math.inf]
    if math.isfinite(best) and second > MAX_AMBIGUOUS_RATIO * best:
        return poses[squares.index(best)]
    return locate(view, camera).transform.rigid


def _solve_ippe(points: Array, rays: Array) -> list[Rigid]:
    cv2 = load("cv2")
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            points.reshape(-1, 1, 3),
            rays.reshape(-1, 1, 2),
            np.eye(3),
            None,
            flags=cv2.SOLVEPNP_IPPE,
        )
    except cv2.error:
        return []
    return [
        Rigid(exp_rotation(turn.reshape(1, 3)), np.asarray(shift, dtype=np.float64).reshape(1, 3))
        for turn, shift in zip(turns, shifts, strict=True)
        if np.isfinite(turn).all() and np.isfinite(shift).all()
    ]
