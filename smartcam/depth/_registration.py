"""Find the pose of one cloud in another (registration) by small-gicp's ICP, with covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numpy as np

from smartcam._argument_checks import a_number, check_arguments, of_class, or_none
from smartcam._arguments import check_text, excerpt
from smartcam._extras import load
from smartcam.depth._filters import voxel_grid
from smartcam.depth._surface import displacement_jacobian, fit_planes, undetermined_steps
from smartcam.exceptions import ConfigurationError
from smartcam.geometry import Transform

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.depth._cloud import Cloud

    Array = NDArray[np.float64]

METHODS: Final = {"gicp": "GICP", "icp": "ICP", "plane": "PLANE_ICP"}
"""small-gicp's name of each method."""

NEIGHBOURS: Final = 20
"""Number of neighbours to which the plane around each point is fitted."""

MAX_STEPS: Final = 60
FURTHER_STEPS: Final = 10
"""Number of further steps that test convergence, since matches may alternate between neighbours."""

MIN_TURN_STEP: Final = 1e-5
MIN_SHIFT_STEP: Final = 1e-4
"""Steps below which the iteration ends: radians, and a share of ``max_distance``."""

MAX_DISTANCE_FACTOR: Final = 5.0
"""Points that start farther off than this multiple of ``max_distance`` are left out.

small-gicp takes very long to find the neighbours of points that are far away.
"""

MAX_FURTHER_SHARE: Final = 1e-3
"""Largest move by :data:`FURTHER_STEPS` of a converged fit, as a share of ``max_distance``."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Registration:
    """The pose of the source in the target.

    Check ``converged`` before using the pose; otherwise ``reason`` says what is wrong.

    Attributes:
        pose: :class:`~smartcam.calibration.Transform`, from source to target.
        converged: whether the iteration ended, enough of the source lies on the target, and every
            direction is determined.
        reason: reason why the registration has not converged, in words; else empty.
        rms: RMS distance of the matched points from the target's planes, or for ``icp`` from its
            points, metres.
        overlap: share of the source's points with a target point within ``max_distance``, 0 to 1.
        matched: number of the source's points with such a target point.
        information: (6, 6), J^T J of the matched points' distances from the target's planes, for a
            small turn in radians about the target's axes, then a shift in metres. Divide it by the
            variance of a distance to get the inverse covariance.
        covariance: (6, 6), of the same turn and shift; None for ``icp``, which has no surfaces, and
            if a direction is not determined.
        undetermined: (K, 6), turns and shifts that the surfaces do not determine, scaled to move
            the source's points by a metre on average.
    """

    pose: Transform
    converged: bool
    reason: str
    rms: float
    overlap: float
    matched: int
    information: Array
    covariance: Array | None
    undetermined: Array


class _Neighbours(NamedTuple):
    """The matched points, in target coordinates relative to the target's centre."""

    moved: Array  # (M, 3), points of the source
    nearest: NDArray[np.intp]  # (M,), index of the matched point of the target
    offsets: Array  # (M, 3), vectors between these two points
    arms: Array  # (M, 3), rotated vectors from the source's origin to its points


@check_arguments(
    source=of_class("Cloud"),
    target=of_class("Cloud"),
    method=check_text,
    voxel=or_none(a_number),
    max_distance=a_number,
    min_overlap=a_number,
)
def register(
    source: Cloud,
    target: Cloud,
    *,
    method: Literal["gicp", "icp", "plane"] = "gicp",
    voxel: float | None = None,
    max_distance: float = 0.05,
    initial: Transform | None = None,
    min_overlap: float = 0.3,
) -> Registration:
    """Return the pose of a cloud in another cloud.

    The result is the pose nearest to ``initial``, whose error should be less than ``max_distance``;
    points with five times this error are left out. The call holds Python's GIL, for tenths of a
    second with 100,000 points: in a program with an event loop, call it in another process.

    Args:
        source: cloud of at least 20 points.
        target: cloud of at least 20 points that does not move.
        method: ``gicp`` from surface to surface, ``plane`` from point to surface, ``icp`` from
            point to point.
        voxel: size, metres, of the voxels to which both clouds are thinned first; None: no
            thinning.
        max_distance: largest distance, metres, at which two points are matched.
        initial: first estimate of ``T_target_source``, with the frames' names for the result; None:
            the identity, between frames ``target`` and ``source``.
        min_overlap: least share of the source that must lie on the target.

    Raises:
        ConfigurationError: an unknown method, a length that is not above 0, or fewer than 20
            points.
        MissingExtraError: the extra ``depth`` is not installed.
    """
    _check_arguments(method, max_distance, min_overlap)
    start = Transform("target", "source", np.eye(3), np.zeros(3)) if initial is None else initial
    if not isinstance(start, Transform):
        raise ConfigurationError(f"initial: expected a Transform, got {type(start).__name__}")
    clouds = []
    for name, cloud in (("source", source), ("target", target)):
        thinned = cloud if voxel is None else voxel_grid(cloud, voxel)
        if len(thinned) < NEIGHBOURS:
            raise ConfigurationError(
                f"register: {name}: expected {NEIGHBOURS} points or more"
                f"{'' if voxel is None else f', thinned to {voxel:g} m'}, got {len(thinned)}"
            )
        clouds.append(thinned.points.astype(np.float64))
    points, target_points = clouds
    tree = load("scipy.spatial").cKDTree(target_points)
    distances, _ = tree.query(
        start.apply(points), distance_upper_bound=MAX_DISTANCE_FACTOR * max_distance
    )
    points_near = points[np.isfinite(distances)]
    pose, has_ended = start, True
    if len(points_near) >= NEIGHBOURS:
        pose, has_ended = _align(points_near, target_points, start, METHODS[method], max_distance)
    match = _match_points(points, tree, pose, max_distance)
    return _judge(method, pose, has_ended, match, len(points), target_points, tree, min_overlap)


def _check_arguments(method: str, max_distance: float, min_overlap: float) -> None:
    if method not in METHODS:
        raise ConfigurationError(
            f"method: expected one of {', '.join(METHODS)}, got {excerpt(method)}"
        )
    if not 0 < max_distance < math.inf:
        raise ConfigurationError(
            f"max_distance: expected metres above 0, got {excerpt(max_distance)}"
        )
    if not 0 <= min_overlap <= 1:
        raise ConfigurationError(f"min_overlap: expected 0 to 1, got {excerpt(min_overlap)}")


def _align(
    points: Array, target_points: Array, start: Transform, kind: str, reach: float
) -> tuple[Transform, bool]:
    """Return the pose, and whether the iteration converged; both clouds are centred for it."""
    gicp = load("small_gicp")
    centre, target_centre = points.mean(axis=0), target_points.mean(axis=0)
    clouds = [gicp.PointCloud(points - centre), gicp.PointCloud(target_points - target_centre)]
    for cloud in clouds:
        gicp.estimate_normals_covariances(cloud, None, NEIGHBOURS)
    tree = gicp.KdTree(clouds[1])

    def run_steps(motion: Array, max_steps: int) -> Any:
        return gicp.align(
            clouds[1],
            clouds[0],
            tree,
            motion,
            registration_type=kind,
            max_correspondence_distance=reach,
            max_iterations=max_steps,
            rotation_epsilon=MIN_TURN_STEP,
            translation_epsilon=MIN_SHIFT_STEP * reach,
        )

    motion = np.eye(4)
    motion[:3, :3] = start.rotation
    motion[:3, 3] = start.rotation @ centre + start.translation - target_centre
    result = run_steps(motion, MAX_STEPS)
    motion, has_ended = np.asarray(result.T_target_source, np.float64), bool(result.converged)
    if np.isfinite(motion).all() and not has_ended:
        before = motion
        motion = np.asarray(run_steps(before, FURTHER_STEPS).T_target_source, np.float64)
        change = (points - centre) @ (motion - before)[:3, :3].T + (motion - before)[:3, 3]
        has_ended = bool(np.sqrt((change**2).sum(axis=1).mean()) < MAX_FURTHER_SHARE * reach)
    if not np.isfinite(motion).all():
        return start, False
    # The product of many small turns is not exactly a rotation.
    left, _, right = np.linalg.svd(motion[:3, :3])
    rotation = left @ right
    translation = motion[:3, 3] - rotation @ centre + target_centre
    return Transform(start.target, start.source, rotation, translation), has_ended


def _match_points(points: Array, tree: Any, pose: Transform, reach: float) -> _Neighbours:
    turned = points @ pose.rotation.T
    moved = turned + pose.translation
    distances, nearest = tree.query(moved, distance_upper_bound=reach)
    is_near = np.isfinite(distances)
    index = nearest[is_near]
    return _Neighbours(moved[is_near], index, tree.data[index] - moved[is_near], turned[is_near])


def _judge(
    method: str,
    pose: Transform,
    has_ended: bool,
    match: _Neighbours,
    count: int,
    target_points: Array,
    tree: Any,
    min_overlap: float,
) -> Registration:
    matched = len(match.nearest)
    reasons = []
    if not has_ended:
        reasons.append(f"the steps did not end within {MAX_STEPS}")
    if matched / count < min_overlap or matched < NEIGHBOURS:
        reasons.append(
            f"{matched} of {count} points of the source lie on the target, "
            f"{matched / count:.0%}; expected {min_overlap:.0%}"
        )
    rms, information, covariance, undetermined = math.nan, np.zeros((6, 6)), None, np.eye(6)
    if matched >= NEIGHBOURS:
        matched_points, plane_of_match = np.unique(match.nearest, return_inverse=True)
        planes = fit_planes(target_points, tree, NEIGHBOURS, matched_points).subset(
            plane_of_match.reshape(-1)
        )
        centre = match.moved.mean(axis=0)
        steps = undetermined_steps(match.moved - centre, planes)
        reasons += [_describe_motion(step, match.moved - centre) for step in steps]
        undetermined = steps.copy()
        undetermined[:, 3:] += np.cross(steps[:, :3], pose.translation - centre)
        rows = displacement_jacobian(match.arms, planes.normals)
        information = rows.T @ rows
        plane_distances = (match.offsets * planes.normals).sum(axis=1)
        distances = np.linalg.norm(match.offsets, axis=1) if method == "icp" else plane_distances
        rms = float(np.sqrt((distances**2).mean()))
        if method != "icp" and not len(steps):
            covariance = _covariance(rows, plane_distances, match.nearest)
    for array in (information, covariance, undetermined):
        if array is not None:
            array.flags.writeable = False
    return Registration(
        pose=pose,
        converged=not reasons,
        reason="; ".join(reasons),
        rms=rms,
        overlap=matched / count,
        matched=matched,
        information=information,
        covariance=covariance,
        undetermined=undetermined,
    )


def _covariance(rows: Array, plane_distances: Array, nearest: NDArray[np.intp]) -> Array:
    """Return the covariance of a fit to planes, from its residuals.

    Residuals at the same point of the target share this point's error, so they are added before
    they are squared.
    """
    # Source: White, A heteroskedasticity-consistent covariance matrix estimator (1980), over
    # groups by the method of Liang and Zeger (1986).
    group_of_match = np.unique(nearest, return_inverse=True)[1].reshape(-1)
    groups = np.zeros((int(group_of_match.max()) + 1, 6))
    np.add.at(groups, group_of_match, rows * plane_distances[:, None])
    inverse = np.linalg.inv(rows.T @ rows)
    spread = len(groups) / max(len(groups) - 6, 1)
    covariance: Array = spread * inverse @ (groups.T @ groups) @ inverse
    return covariance


def _describe_motion(step: Array, arms: Array) -> str:
    """Describe an undetermined motion about the matched points' centre in words."""
    turn, shift = step[:3], step[3:]
    reach = float(np.sqrt((arms**2).sum(axis=1).mean())) or 1.0
    size = np.linalg.norm(turn) * reach
    main, word = (turn, "turn about") if size > np.linalg.norm(shift) else (shift, "shift along")
    axis = main / np.linalg.norm(main)
    axis = axis * (1.0 if axis[np.argmax(np.abs(axis))] > 0 else -1.0)
    axis_text = ", ".join(f"{value + 0.0:.2f}" for value in np.round(axis, 2))
    return f"the surfaces do not determine a {word} ({axis_text})"
