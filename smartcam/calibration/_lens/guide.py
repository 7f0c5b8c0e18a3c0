"""Suggest the next view of the target: the one that makes the lens most certain.

For each of many possible views the uncertainty of the lens with that view is computed, from the
calibration's covariance and from the information that the view would add. That needs no image.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam._argument_checks import a_number, a_target, of_class, or_none, takes
from smartcam.calibration._least_squares import inverse_scaled
from smartcam.calibration._lens.bundle import Bundle, BundleEquations, Sight
from smartcam.calibration._lens.field import (
    check_distance,
    known_points,
    places,
    points_at,
    sensitivity,
)
from smartcam.calibration._lens.poses import CAMERA, TARGET
from smartcam.calibration._lens.projection import MIN_SIGMA_PX, pose_changes
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
"""Rows that the target may be brought to, as parts of its range in the image."""

SIZES: Final = {0.85: "near", 0.6: "at a middle distance", 0.4: "far"}
"""Parts of the image's width or height that the target may take."""

MAX_TILT_DEG: Final = 35.0
"""Largest tilt of a suggested view, degrees: more adds little information and is hard to detect."""

SIDES: Final = {"lower": (1.0, 0.0), "upper": (-1.0, 0.0), "left": (0.0, 1.0), "right": (0.0, -1.0)}
"""Side of the target that is farther away, and the camera's axis that the target is tilted
about."""

MARGIN_RATIO: Final = 0.02
"""Each side of the image keeps this part free beside the target."""

MAX_STEPS: Final = 12
"""A target is moved to its place in at most this many steps; most are there after five."""

MAP_SHAPE: Final = (9, 12)
"""Rows and columns of the map over which the uncertainty is averaged."""

MAX_SAME_RAY_RADIANS: Final = 1e-3
"""A point that lies off the ray of its own pixel by more than this angle, radians, is where the
lens' model is not valid."""


class NextView(NamedTuple):
    """A view that may be taken.

    Attributes:
        text: text for people: place and tilt of the target.
        transform: ``T_camera_target``.
        outline: (4, 2), the target's corners as they would be seen, pixels.
        mean: RMS uncertainty of a coordinate over the field with this view, pixels.
        present: RMS uncertainty of a coordinate over the field without this view, pixels.
    """

    text: str
    transform: Transform
    outline: Array
    mean: float
    present: float


class CandidateViews(NamedTuple):
    """C views that could be taken; all of their points are inside of the image."""

    texts: list[str]
    poses: Rigid  # ``T_camera_target`` of each
    outlines: Array  # (C, 4, 2), pixels


@takes(
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

    They are taken from about a hundred: nine places in the image, three distances, head-on and
    tilted to four sides. Each is assumed to show all of the target's points, with the noise of the
    calibration's views. They are ranked by the mean of :meth:`IntrinsicCalibration.uncertainty`.

    Args:
        calibration: calibration from the views so far.
        distance: distance at which the uncertainty counts, metres; None: infinity.
        roll: turn of the target about the line of sight, radians; 0 is upright.
        target: the target to be shown; None: that of the views.

    Raises:
        CalibrationError: ``NOT_FINITE``: the distance is not valid.
    """
    check_distance(distance)
    camera = calibration.camera
    shown = target or calibration.views[0].view.target
    suggestions = candidates(camera, shown, roll)
    basis = _fitted(calibration.covariance)
    start, times = _mixed_covariance(calibration, basis)
    weight = basis.T @ _criterion(calibration, distance) @ basis
    added = _informations(camera, suggestions.poses, shown.points, basis)
    added = added / (_variance(calibration) * times)
    after = np.linalg.inv(np.linalg.inv(start) + added)
    means = np.sqrt(np.maximum(np.einsum("cij,ji->c", after, weight), 0.0) / 2)
    present = math.sqrt(max(float(np.einsum("ij,ji->", start, weight)), 0.0) / 2)
    return [
        NextView(
            suggestions.texts[number],
            Transform(CAMERA, TARGET, *suggestions.poses.subset(number)),
            suggestions.outlines[number],
            float(means[number]),
            present,
        )
        for number in np.argsort(means, kind="stable").tolist()
    ]


def _variance(calibration: IntrinsicCalibration) -> float:
    """Return the variance of a coordinate in the views so far, pixels^2."""
    sigmas = np.concatenate([fit.view.sigmas for fit in calibration.views if fit.used])
    return max(float(np.median(sigmas)) ** 2 + calibration.sigma**2, MIN_SIGMA_PX**2)


def _fitted(covariance: Array) -> Array:
    """Return the derivatives (4 + K, F) of all values by those that were fitted."""
    columns, fixed = np.eye(len(covariance)), np.diag(covariance) <= 0.0
    # fx and fy are one unknown
    if not fixed[0] and np.allclose(covariance[0], covariance[1], rtol=1e-9):
        columns[1, 0], fixed[1] = 1.0, True
    fitted: Array = columns[:, ~fixed]
    return fitted


def _mixed_covariance(calibration: IntrinsicCalibration, basis: Array) -> tuple[Array, float]:
    """Return the covariance of the fitted values (F, F), and its ratio to that of noise alone.

    V views determine the covariance along V directions only. So it is mixed: V / (V + F) of it
    comes from the views' scatter, the rest from the noise of the points times that ratio.
    """
    used = [fit for fit in calibration.views if fit.used]
    points = None
    if calibration.sheet is not None:
        points = used[0].view.target.points + calibration.sheet
    poses = Rigid.stacked(fit.transform.rigid for fit in used)
    bundle = Bundle.single(calibration.camera, poses, basis, points)
    sights = [Sight(0, number, fit.view) for number, fit in enumerate(used)]
    equations = BundleEquations(bundle, sights, calibration.sigma**2)
    information = equations.normal(bundle).eliminate_poses()[0]
    back = np.linalg.pinv(basis)
    scattered, count = back @ calibration.covariance @ back.T, len(information)
    times = float(np.trace(information @ scattered)) / max(count, 1)
    part = len(used) / (len(used) + count)
    by_noise = times * inverse_scaled(information)
    return part * scattered + (1.0 - part) * by_noise, max(times, 1e-12)


def _criterion(calibration: IntrinsicCalibration, distance: float | None) -> Array:
    """Return M such that ``trace(C M)`` is the mean variance of a coordinate for a covariance C."""
    camera = calibration.camera
    points = points_at(camera, places(camera.size, MAP_SHAPE).reshape(-1, 2), distance)
    field = sensitivity(camera, known_points(points), at_infinity=distance is None)
    freed = field.freed(sensitivity(camera, known_points(calibration.target_points)))
    criterion: Array = np.einsum("nip,niq->pq", freed, freed) / len(freed)
    return criterion


def _informations(camera: CameraModel, poses: Rigid, points: Array, basis: Array) -> Array:
    """Return each view's information on the fitted values (C, F, F), at a variance of 1 pixel^2."""
    # The pose is unknown, too, so that B^T B becomes B^T B - B^T A (A^T A)^-1 A^T B.
    shape = (poses.size, 2 * len(points), -1)
    turned = points @ poses.rotation.swapaxes(1, 2)
    in_camera = (turned + poses.translation[:, None]).reshape(-1, 3)
    at = sensitivity(camera, in_camera)
    by_lens = (at.by_lens @ basis).reshape(shape)
    by_pose = pose_changes(at.by_point, turned.reshape(-1, 3)).reshape(shape)
    both = by_pose.swapaxes(1, 2) @ by_lens
    inner = by_pose.swapaxes(1, 2) @ by_pose
    left: Array = by_lens.swapaxes(1, 2) @ by_lens - both.swapaxes(1, 2) @ np.linalg.solve(
        inner, both
    )
    return left


def candidates(camera: CameraModel, target: Target, roll: float = 0.0) -> CandidateViews:
    """Return possible views of a target that is turned by ``roll`` about the line of sight."""
    low, high = target.points[:, :2].min(axis=0), target.points[:, :2].max(axis=0)
    centre = np.append((low + high) / 2, 0.0)
    half = (high - low) / 2
    rim = np.array(
        [[-1, -1], [1, -1], [1, 1], [-1, 1], [0, -1], [1, 0], [0, 1], [-1, 0]], dtype=np.float64
    )
    around = np.column_stack([rim * half, np.zeros(len(rim))])
    tilts = {"": (0.0, 0.0), **SIDES}
    ways = list(itertools.product(SIZES, ROWS, COLUMNS, tilts))
    turns = np.array([[*tilts[side], 0.0] for *_, side in ways]) * math.radians(MAX_TILT_DEG)
    upright = exp_rotation(np.array([0.0, 0.0, roll])) @ np.diag([1.0, -1.0, -1.0])
    rotations = exp_rotation(turns) @ upright
    turned = around @ rotations.swapaxes(1, 2)
    fills, parts = np.array([fill for fill, *_ in ways]), np.array([[u, v] for _, v, u, _ in ways])
    shifts = _placed(camera, turned, fills, parts)
    poses = Rigid(rotations, shifts - rotations @ centre)
    good = _visible(camera, turned + shifts[:, None])
    chosen = np.flatnonzero(good).tolist()
    corners = (turned[good, :4] + shifts[good, None]).reshape(-1, 3)
    return CandidateViews(
        [_words(*ways[number], roll) for number in chosen],
        poses.subset(chosen),
        camera.project(corners).reshape(-1, 4, 2),
    )


def _placed(camera: CameraModel, turned: Array, fills: Array, parts: Array) -> Array:
    """Return the centres (C, 3) at which targets appear in the wanted places.

    ``turned`` (C, 8, 3): their rims around their centres, in the camera's axes. ``fills`` (C,) says
    how much of the image they take, ``parts`` (C, 2) their place within the room that is left.
    """
    size = np.array(camera.size, dtype=np.float64)
    extent = float(np.linalg.norm(turned, axis=2).max())
    depth = 2 * extent * camera.matrix[0, 0] / (fills * size[0])
    at = np.broadcast_to((size - 1) / 2, (len(turned), 2)).copy()
    shifts = np.zeros((len(turned), 3))
    for _ in range(MAX_STEPS):
        ahead = np.column_stack([camera.directions(at), np.ones(len(at))])
        shifts = ahead * depth[:, None]
        seen = camera.project((turned + shifts[:, None]).reshape(-1, 3)).reshape(len(at), -1, 2)
        first, last = seen.min(axis=1), seen.max(axis=1)
        wide = last - first
        lowest, room = (
            MARGIN_RATIO * size + wide / 2,
            np.maximum((1 - 2 * MARGIN_RATIO) * size - wide, 0.0),
        )
        step = lowest + room * parts - (first + last) / 2
        at = np.clip(at + np.nan_to_num(step), 0.0, size - 1)
        depth = depth * np.nan_to_num(np.clip((wide / size).max(axis=1) / fills, 0.7, 1.5), nan=1.5)
    return shifts


def _visible(camera: CameraModel, points: Array) -> Mask:
    """Return a mask of views whose points (C, N, 3) lie in the image, where the model is valid."""
    flat = points.reshape(-1, 3)
    seen = camera.project(flat)
    inside = ((seen >= 0.0) & (seen <= np.array(camera.size) - 1.0)).all(axis=1, keepdims=True)
    back = points_at(camera, np.where(inside, seen, 0.0), None)
    ahead = flat / np.linalg.norm(flat, axis=1, keepdims=True)
    error = np.where(inside, np.abs(back - ahead), np.inf).reshape(len(points), -1)
    good: Mask = error.max(axis=1) < MAX_SAME_RAY_RADIANS
    return good


def _words(fill: float, row: float, column: float, side: str, roll: float) -> str:
    across, down = COLUMNS[column], ROWS[row]
    place = {
        (True, True): "in the middle of the image",
        (True, False): f"at the {across} edge of the image",
        (False, True): f"at the {down} edge of the image",
        (False, False): f"in the {down} {across} corner of the image",
    }[row == 0.5, column == 0.5]
    tilted = f"tilted by {MAX_TILT_DEG:.0f} degrees, its {side} side farther away"
    tilt = tilted if side else "not tilted"
    turned = f", turned by {abs(math.degrees(roll)):.0f} degrees" if roll else ""
    return f"{place}, {SIZES[fill]}, {tilt}{turned}"
