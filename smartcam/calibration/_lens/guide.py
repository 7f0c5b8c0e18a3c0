"""Suggest the next view of the target: the view that reduces the lens' uncertainty most.

The uncertainty of the lens with each of many possible views is predicted, without an image, from
the calibration's covariance and from the information that the view would add.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam._argument_checks import a_number, a_target, check_arguments, of_class, or_none
from smartcam.calibration._least_squares import inverse_scaled
from smartcam.calibration._lens.bundle import Bundle, BundleEquations, IndexedView
from smartcam.calibration._lens.field import (
    check_distance,
    finite_points,
    map_pixels,
    points_of_pixels,
    sensitivity,
)
from smartcam.calibration._lens.poses import CAMERA, TARGET
from smartcam.calibration._lens.projection import MIN_SIGMA_PX, pixels_by_pose
from smartcam.geometry import Transform
from smartcam.geometry._inside import Rigid, exp_rotation

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    from smartcam.calibration._lens.intrinsics import IntrinsicCalibration
    from smartcam.calibration._targets import Target
    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array

    Mask: TypeAlias = NDArray[np.bool_]

COLUMNS: Final = {0.0: "left", 0.5: "middle", 1.0: "right"}
ROWS: Final = {0.0: "upper", 0.5: "middle", 1.0: "lower"}
"""Names of the rows of places for the target, by the part of its possible range in the image."""

SIZES: Final = {0.85: "near", 0.6: "at a middle distance", 0.4: "far"}
"""Names of distances, by the part of the image's width or height that the target then fills."""

MAX_TILT_DEG: Final = 35.0
"""Tilt of the suggested tilted views, degrees: a larger one adds little and is hard to detect."""

SIDES: Final = {"lower": (1.0, 0.0), "upper": (-1.0, 0.0), "left": (0.0, 1.0), "right": (0.0, -1.0)}
"""For each tilt: the side of the target that is then farther away, and the tilt's axis in the
camera's x and y."""

MARGIN_RATIO: Final = 0.02
"""Margin that stays free between the target and each side of the image, as a fraction of that
side."""

MAX_STEPS: Final = 12
"""A target is moved to its place in at most this many steps; five are usually enough."""

MAP_SHAPE: Final = (9, 12)
"""Rows and columns of the map over which the uncertainty is averaged."""

MAX_SAME_RAY_RADIANS: Final = 1e-3
"""A point is projected, and its pixel is mapped back to a ray. If the ray misses the point by more
than this angle, radians, the lens' model is not valid there."""


class NextView(NamedTuple):
    """A view that may be taken next.

    Attributes:
        text: text for people: place and tilt of the target.
        transform: ``T_camera_target``.
        outline: (4, 2), the target's corners as they would be seen, pixels.
        rms_with: RMS uncertainty of a coordinate over the field with this view, pixels.
        rms_without: RMS uncertainty of a coordinate over the field without this view, pixels.
    """

    text: str
    transform: Transform
    outline: Array
    rms_with: float
    rms_without: float


class CandidateViews(NamedTuple):
    """C possible views, in which all points of the target would be inside of the image."""

    texts: list[str]
    poses: Rigid  # ``T_camera_target`` of each
    outlines: Array  # (C, 4, 2), pixels


@check_arguments(
    calibration=of_class("IntrinsicCalibration"),
    distance=or_none(a_number),
    roll=a_number,
    target=or_none(a_target),
)
def suggest_views(
    calibration: IntrinsicCalibration,
    *,
    distance: float | None = None,
    roll: float = 0.0,
    target: Target | None = None,
) -> list[NextView]:
    """Return views that could be taken next, the most useful one first.

    They are chosen from about a hundred: nine places in the image, three distances, head-on and
    tilted to four sides. Each is assumed to show all of the target's points, with the noise of the
    calibration's views. They are ranked by the mean of :meth:`IntrinsicCalibration.uncertainty`.

    Args:
        calibration: calibration from the views so far.
        distance: distance of the points whose uncertainty counts, metres; None: infinity.
        roll: turn of the target about the line of sight, radians; 0 is upright.
        target: the target to be shown; None: that of the views.

    Raises:
        CalibrationError: ``NOT_FINITE``: the distance is not valid.
    """
    check_distance(distance)
    camera = calibration.camera
    shown_target = target or calibration.views[0].view.target
    suggestions = candidate_views(camera, shown_target, roll)
    basis = _fitted_basis(calibration.covariance)
    covariance, scatter_ratio = _mixed_covariance(calibration, basis)
    weight = basis.T @ _mean_variance_matrix(calibration, distance) @ basis
    information = _information_matrices(camera, suggestions.poses, shown_target.points, basis)
    information = information / (_point_variance(calibration) * scatter_ratio)
    new_covariances = np.linalg.inv(np.linalg.inv(covariance) + information)
    rms_with = np.sqrt(np.maximum(np.einsum("cij,ji->c", new_covariances, weight), 0.0) / 2)
    rms_without = math.sqrt(max(float(np.einsum("ij,ji->", covariance, weight)), 0.0) / 2)
    return [
        NextView(
            suggestions.texts[number],
            Transform(CAMERA, TARGET, *suggestions.poses.subset(number)),
            suggestions.outlines[number],
            float(rms_with[number]),
            rms_without,
        )
        for number in np.argsort(rms_with, kind="stable").tolist()
    ]


def _point_variance(calibration: IntrinsicCalibration) -> float:
    """Return the variance of a coordinate in the views so far, pixels^2."""
    sigmas = np.concatenate([fit.view.sigmas for fit in calibration.views if fit.used])
    return max(float(np.median(sigmas)) ** 2 + calibration.sigma**2, MIN_SIGMA_PX**2)


def _fitted_basis(covariance: Array) -> Array:
    """Return the derivatives (4 + K, F) of the lens' values by the F that were fitted."""
    columns, fixed = np.eye(len(covariance)), np.diag(covariance) <= 0.0
    # fx and fy were fitted as one unknown
    if not fixed[0] and np.allclose(covariance[0], covariance[1], rtol=1e-9):
        columns[1, 0], fixed[1] = 1.0, True
    fitted: Array = columns[:, ~fixed]
    return fitted


def _mixed_covariance(calibration: IntrinsicCalibration, basis: Array) -> tuple[Array, float]:
    """Return the covariance of the fitted values (F, F), and its ratio to that of noise alone.

    V views determine the covariance along V directions only. So the result is a mean with weights:
    V / (V + F) for the scatter of the views, the rest for the noise of the points times the ratio.
    """
    used = [fit for fit in calibration.views if fit.used]
    points = None
    if calibration.sheet is not None:
        points = used[0].view.target.points + calibration.sheet
    poses = Rigid.stack(fit.transform.rigid for fit in used)
    bundle = Bundle.single(calibration.camera, poses, basis, points)
    indexed = [IndexedView(0, number, fit.view) for number, fit in enumerate(used)]
    equations = BundleEquations(bundle, indexed, calibration.sigma**2)
    information = equations.normal(bundle).eliminate_poses()[0]
    inverse = np.linalg.pinv(basis)
    scatter_covariance, count = inverse @ calibration.covariance @ inverse.T, len(information)
    scatter_ratio = float(np.trace(information @ scatter_covariance)) / max(count, 1)
    share = len(used) / (len(used) + count)
    noise_covariance = scatter_ratio * inverse_scaled(information)
    return share * scatter_covariance + (1.0 - share) * noise_covariance, max(scatter_ratio, 1e-12)


def _mean_variance_matrix(calibration: IntrinsicCalibration, distance: float | None) -> Array:
    """Return M such that ``trace(C M)`` is the mean variance of a coordinate for a covariance C."""
    camera = calibration.camera
    points = points_of_pixels(camera, map_pixels(camera.size, MAP_SHAPE).reshape(-1, 2), distance)
    field = sensitivity(camera, finite_points(points), at_infinity=distance is None)
    by_lens = field.without_motion(sensitivity(camera, finite_points(calibration.target_points)))
    criterion: Array = np.einsum("nip,niq->pq", by_lens, by_lens) / len(by_lens)
    return criterion


def _information_matrices(camera: CameraModel, poses: Rigid, points: Array, basis: Array) -> Array:
    """Return the information (C, F, F) of each view on the fitted values, for 1 pixel of noise."""
    # The pose of the view is unknown, so B^T B becomes B^T B - B^T A (A^T A)^-1 A^T B.
    shape = (poses.size, 2 * len(points), -1)
    turned = points @ poses.rotation.swapaxes(1, 2)
    in_camera = (turned + poses.translation[:, None]).reshape(-1, 3)
    projection = sensitivity(camera, in_camera)
    by_lens = (projection.by_lens @ basis).reshape(shape)
    by_pose = pixels_by_pose(projection.by_point, turned.reshape(-1, 3)).reshape(shape)
    mixed = by_pose.swapaxes(1, 2) @ by_lens
    pose_information = by_pose.swapaxes(1, 2) @ by_pose
    information: Array = by_lens.swapaxes(1, 2) @ by_lens - mixed.swapaxes(1, 2) @ np.linalg.solve(
        pose_information, mixed
    )
    return information


def candidate_views(camera: CameraModel, target: Target, roll: float = 0.0) -> CandidateViews:
    """Return possible views of a target that is turned by ``roll`` about the line of sight."""
    low, high = target.points[:, :2].min(axis=0), target.points[:, :2].max(axis=0)
    centre = np.append((low + high) / 2, 0.0)
    half_size = (high - low) / 2
    unit_rim = np.array(
        [[-1, -1], [1, -1], [1, 1], [-1, 1], [0, -1], [1, 0], [0, 1], [-1, 0]], dtype=np.float64
    )
    rim_points = np.column_stack([unit_rim * half_size, np.zeros(len(unit_rim))])
    tilts = {"": (0.0, 0.0), **SIDES}
    combinations = list(itertools.product(SIZES, ROWS, COLUMNS, tilts))
    turns = np.array([[*tilts[side], 0.0] for *_, side in combinations]) * math.radians(
        MAX_TILT_DEG
    )
    upright = exp_rotation(np.array([0.0, 0.0, roll])) @ np.diag([1.0, -1.0, -1.0])
    rotations = exp_rotation(turns) @ upright
    turned = rim_points @ rotations.swapaxes(1, 2)
    fills, fractions = (
        np.array([fill for fill, *_ in combinations]),
        np.array([[u, v] for _, v, u, _ in combinations]),
    )
    shifts = _place_targets(camera, turned, fills, fractions)
    poses = Rigid(rotations, shifts - rotations @ centre)
    visible = _is_visible(camera, turned + shifts[:, None])
    indices = np.flatnonzero(visible).tolist()
    corners = (turned[visible, :4] + shifts[visible, None]).reshape(-1, 3)
    return CandidateViews(
        [_describe(*combinations[number], roll) for number in indices],
        poses.subset(indices),
        camera.project(corners).reshape(-1, 4, 2),
    )


def _place_targets(camera: CameraModel, turned: Array, fills: Array, fractions: Array) -> Array:
    """Return the centres (C, 3) of targets that appear in the wanted places of the image.

    ``turned`` (C, 8, 3): points on the rim of each target, relative to its centre, along the
    camera's axes. ``fills`` (C,): part of the image's width or height that the target fills.
    ``fractions`` (C, 2): place of the target within the rest of the image, from 0 to 1.
    """
    size = np.array(camera.size, dtype=np.float64)
    extent = float(np.linalg.norm(turned, axis=2).max())
    depth = 2 * extent * camera.matrix[0, 0] / (fills * size[0])
    centres = np.broadcast_to((size - 1) / 2, (len(turned), 2)).copy()
    shifts = np.zeros((len(turned), 3))
    for _ in range(MAX_STEPS):
        directions = np.column_stack([camera.directions(centres), np.ones(len(centres))])
        shifts = directions * depth[:, None]
        pixels = camera.project((turned + shifts[:, None]).reshape(-1, 3)).reshape(
            len(centres), -1, 2
        )
        first, last = pixels.min(axis=1), pixels.max(axis=1)
        extents = last - first
        lowest_centre, room = (
            MARGIN_RATIO * size + extents / 2,
            np.maximum((1 - 2 * MARGIN_RATIO) * size - extents, 0.0),
        )
        step = lowest_centre + room * fractions - (first + last) / 2
        centres = np.clip(centres + np.nan_to_num(step), 0.0, size - 1)
        depth = depth * np.nan_to_num(
            np.clip((extents / size).max(axis=1) / fills, 0.7, 1.5), nan=1.5
        )
    return shifts


def _is_visible(camera: CameraModel, points: Array) -> Mask:
    """Return a mask of views whose points (C, N, 3) lie in the image, where the model is valid."""
    all_points = points.reshape(-1, 3)
    pixels = camera.project(all_points)
    is_inside = ((pixels >= 0.0) & (pixels <= np.array(camera.size) - 1.0)).all(
        axis=1, keepdims=True
    )
    round_trip = points_of_pixels(camera, np.where(is_inside, pixels, 0.0), None)
    directions = all_points / np.linalg.norm(all_points, axis=1, keepdims=True)
    error = np.where(is_inside, np.abs(round_trip - directions), np.inf).reshape(len(points), -1)
    is_visible: Mask = error.max(axis=1) < MAX_SAME_RAY_RADIANS
    return is_visible


def _describe(fill: float, row: float, column: float, side: str, roll: float) -> str:
    column_name, row_name = COLUMNS[column], ROWS[row]
    place = {
        (True, True): "in the middle of the image",
        (True, False): f"at the {column_name} edge of the image",
        (False, True): f"at the {row_name} edge of the image",
        (False, False): f"in the {row_name} {column_name} corner of the image",
    }[row == 0.5, column == 0.5]
    tilt_text = f"tilted by {MAX_TILT_DEG:.0f} degrees, its {side} side farther away"
    tilt = tilt_text if side else "not tilted"
    roll_text = f", turned by {abs(math.degrees(roll)):.0f} degrees" if roll else ""
    return f"{place}, {SIZES[fill]}, {tilt}{roll_text}"
