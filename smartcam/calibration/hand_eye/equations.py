"""The equations of a camera and a robot: ``T_camera_target = X^-1 A Z``, and how they are solved.

``X`` is where the camera is on what carries it, ``Z`` where the target is on what carries that, and
``A`` is the robot between the two: ``T_flange_base`` for a camera on the hand, ``T_base_flange``
for one that looks at the hand. A view's pose changes by a turn w and a shift d in the camera's
frame, R becomes ``exp([w]x) R`` and t ``t + d``; all derivatives pass through them, so points in an
image and poses that come without one are adjusted by the same steps.

A robot that knows its poses with some noise gets a correction for each of them; they are taken out
of the normal equations, so a hundred poses cost no more than a hundred times one.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple, Protocol, TypeAlias

import numpy as np

from smartcam.calibration.lens.projection import linearize, pose_changes
from smartcam.calibration.optional_imports import load

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.calibration.geometry.rotations import Array
    from smartcam.calibration.lens.model import CameraModel

    Index = NDArray[np.intp] | slice

__all__ = [
    "ROUGH_GAIN",
    "SMALLEST_GAIN",
    "Adjusted",
    "Observations",
    "PixelObservations",
    "PoseObservations",
    "Rigid",
    "Robot",
    "RobotSigmas",
    "Setup",
    "Sums",
    "adjust",
    "carried",
    "cross_matrix",
    "discrepancy",
    "exp_rotation",
    "information",
    "log_rotation",
    "sums",
]

Setup: TypeAlias = Literal["eye-in-hand", "eye-to-hand"]
"""Where the camera is: on the robot's hand, or beside the robot, looking at it."""

MOST_STEPS = 60
"""Of an adjustment; it takes 4 to 10."""

SMALLEST_GAIN = 1e-11
"""Of a step, where the result is given out."""

ROUGH_GAIN = 1e-7
"""Of a step, where the result is compared: a hundredth of its standard deviation off."""

MOST_DAMPING = 1e12
"""Of the diagonal: where no smaller step gains anything either."""

TINY_ANGLE = 1e-7
"""Radians below which the series of a rotation are cut after their first term."""


class Rigid(NamedTuple):
    """Rigid motions, one or many.

    Attributes:
        rotation: (..., 3, 3).
        translation: (..., 3), metres.
    """

    rotation: Array
    translation: Array

    def __matmul__(self, other: Rigid) -> Rigid:
        """Return this motion after another."""
        turned = (self.rotation @ other.translation[..., None])[..., 0]
        return Rigid(self.rotation @ other.rotation, turned + self.translation)

    def inverse(self) -> Rigid:
        """Return the motions back."""
        back = np.swapaxes(self.rotation, -1, -2)
        return Rigid(back, -(back @ self.translation[..., None])[..., 0])

    def taken(self, index: Index) -> Rigid:
        """Return some of them."""
        return Rigid(self.rotation[index], self.translation[index])

    def scaled(self, scale: float) -> Rigid:
        """Return them with their distances in proportion."""
        return Rigid(self.rotation, scale * self.translation)

    def moved(self, step: Array) -> Rigid:
        """Return them turned about their own origin, and shifted along the target's axes.

        Args:
            step: (..., 6), rotation vector and shift.
        """
        return Rigid(self.rotation @ exp_rotation(step[..., :3]), self.translation + step[..., 3:])


class RobotSigmas(NamedTuple):
    """How well a robot knows where it is: standard deviations of each axis.

    Attributes:
        rotation: radians.
        translation: metres.
    """

    rotation: float
    translation: float


def cross_matrix(vectors: Array) -> Array:
    """Return the matrices (..., 3, 3) with ``matrix @ v = cross(vector, v)``."""
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def exp_rotation(vectors: Array) -> Array:
    """Return the rotations (..., 3, 3) about vectors (..., 3) by their lengths, radians."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    safe = np.where(angle < TINY_ANGLE, 1.0, angle)
    first = np.where(angle < TINY_ANGLE, 1.0, np.sin(safe) / safe)
    second = np.where(angle < TINY_ANGLE, 0.5, (1.0 - np.cos(safe)) / safe**2)
    cross = cross_matrix(vectors)
    rotation: Array = np.eye(3) + first * cross + second * (cross @ cross)
    return rotation


def log_rotation(rotations: Array) -> Array:
    """Return the rotation vectors (..., 3) of rotations (..., 3, 3), of length pi at most."""
    turns = load("scipy.spatial.transform").Rotation.from_matrix(rotations.reshape(-1, 3, 3))
    vectors: Array = turns.as_rotvec().reshape(rotations.shape[:-1])
    return vectors


def _right_jacobian(vectors: Array) -> Array:
    """Return J (..., 3, 3) with ``exp(v + d) = exp(v) exp(J d)`` for small d."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    safe = np.where(angle < 1e-4, 1.0, angle)
    first = np.where(angle < 1e-4, 0.5, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(angle < 1e-4, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    cross = cross_matrix(vectors)
    jacobian: Array = np.eye(3) - first * cross + second * (cross @ cross)
    return jacobian


@dataclass(frozen=True, slots=True)
class Robot:
    """The robot's poses, and how they stand between camera and target.

    Attributes:
        poses: V times ``T_base_flange``.
        in_hand: whether the camera is on the hand.
    """

    poses: Rigid
    in_hand: bool

    @property
    def between(self) -> Rigid:
        """``A`` of each view: from what carries the target to what carries the camera."""
        return self.poses.inverse() if self.in_hand else self.poses

    def taken(self, index: Index) -> Robot:
        """Return some of the poses."""
        return dataclasses.replace(self, poses=self.poses.taken(index))


def carried(camera: Rigid, robot: Robot, target: Rigid) -> Rigid:
    """Return ``T_camera_target`` of each view."""
    return camera.inverse() @ (robot.between @ target)


def _chain(camera: Rigid, robot: Robot, target: Rigid) -> tuple[Array, Array]:
    """Return how the views' poses change, (V, 6, 12) and (V, 6, 6).

    The first with steps of camera and target, as :meth:`Rigid.moved` takes them, the second with a
    step of the robot's pose.
    """
    seen = carried(camera, robot, target)
    back = camera.rotation.T
    count, turn = len(seen.translation), robot.poses.rotation
    outer = np.zeros((count, 6, 12))
    outer[:, :3, 0:3] = -np.eye(3)
    outer[:, 3:, 0:3] = cross_matrix(seen.translation)
    outer[:, 3:, 3:6] = -back
    outer[:, :3, 6:9] = seen.rotation
    outer[:, 3:, 9:12] = back @ robot.between.rotation
    inner = np.zeros((count, 6, 6))
    if robot.in_hand:
        arm = seen.translation + camera.translation @ camera.rotation
        inner[:, :3, :3] = -back
        inner[:, 3:, :3] = cross_matrix(arm) @ back
        inner[:, 3:, 3:] = -back @ np.swapaxes(turn, 1, 2)
    else:
        arm = seen.translation + (camera.translation - robot.poses.translation) @ camera.rotation
        inner[:, :3, :3] = back @ turn
        inner[:, 3:, :3] = -cross_matrix(arm) @ back @ turn
        inner[:, 3:, 3:] = back
    return outer, inner


class Observations(Protocol):
    """What the camera saw, view by view."""

    @property
    def extra(self) -> int:
        """How many parameters are adjusted beside the poses."""
        ...

    def taken(self, index: Index) -> Observations:
        """Return some of the views."""
        ...

    def scale(self, change: Array) -> float:
        """Return the target's size over the nominal one, of a change (extra,)."""
        ...

    def spread(self, factor: float) -> Observations:
        """Return them with all standard deviations larger by a factor."""
        ...

    def evaluate(self, seen: Rigid, change: Array) -> tuple[Array, Array]:
        """Return whitened residuals (V, M) and their derivatives (V, M, 6 + extra).

        Args:
            seen: ``T_camera_target`` of each view.
            change: (extra,), of the parameters beside the poses.
        """
        ...


@dataclass(frozen=True, slots=True)
class PixelObservations:
    """Points in images; views with fewer than others are filled up with points of no weight.

    Attributes:
        model: the camera.
        points: (V, N, 3), on the target, metres.
        pixels: (V, N, 2).
        whitening: (V, N, 2, 2), what makes errors of a point independent with a variance of 1.
        free: numbers of the parameters that are adjusted beside the poses, ascending: 0 is the
            target's scale, 1 to 4 are fx, fy, cx, cy, from 5 on the distortion.
    """

    model: CameraModel
    points: Array
    pixels: Array
    whitening: Array
    free: tuple[int, ...] = ()

    @property
    def extra(self) -> int:
        """How many parameters are adjusted beside the poses."""
        return len(self.free)

    def taken(self, index: Index) -> PixelObservations:
        """Return some of the views."""
        return dataclasses.replace(
            self,
            points=self.points[index],
            pixels=self.pixels[index],
            whitening=self.whitening[index],
        )

    def scale(self, change: Array) -> float:
        """Return the target's size over the nominal one, of a change (extra,)."""
        return 1.0 + float(self._full(change)[0])

    def spread(self, factor: float) -> PixelObservations:
        """Return them with all standard deviations larger by a factor."""
        return dataclasses.replace(self, whitening=self.whitening / factor)

    def camera(self, change: Array) -> CameraModel:
        """Return the camera with some of its parameters changed, (extra,)."""
        if not any(self.free):
            return self.model
        full = self._full(change)
        matrix = self.model.matrix.copy()
        matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += full[1:5]
        distortion = self.model.distortion + full[5:]
        return dataclasses.replace(self.model, matrix=matrix, distortion=distortion)

    def evaluate(self, seen: Rigid, change: Array) -> tuple[Array, Array]:
        """Return whitened residuals (V, 2 N) and their derivatives (V, 2 N, 6 + extra).

        They are NaN for a change to no target or no lens: of a size or focal length below 0.
        """
        views, count = self.pixels.shape[:2]
        full = self._full(change)
        if min(1.0 + full[0], *(np.diag(self.model.matrix)[:2] + full[1:3])) <= 0:
            nothing = np.full((views, 2 * count), np.nan)
            return nothing, np.full((*nothing.shape, 6 + self.extra), np.nan)
        nominal = self.points @ np.swapaxes(seen.rotation, 1, 2)
        near = self.scale(change) * nominal
        there = linearize((near + seen.translation[:, None]).reshape(-1, 3), self.camera(change))
        moved = pose_changes(there.by_point, near.reshape(-1, 3))
        grown = there.by_point @ nominal.reshape(-1, 3, 1)
        beside = np.concatenate([grown, there.by_lens], axis=2)[:, :, list(self.free)]
        slopes = np.concatenate([moved, beside], axis=2).reshape(views, count, 2, -1)
        off = (there.pixels.reshape(views, count, 2) - self.pixels)[..., None]
        off, slopes = self.whitening @ off, self.whitening @ slopes
        return off.reshape(views, -1), slopes.reshape(views, 2 * count, -1)

    def _full(self, change: Array) -> Array:
        full = np.zeros(5 + len(self.model.distortion))
        full[list(self.free)] = change
        return full


@dataclass(frozen=True, slots=True)
class PoseObservations:
    """Poses of the target that come without an image.

    Attributes:
        poses: V times ``T_camera_target``.
        whitening: (V, 6, 6), what makes errors ``(w, d)`` independent with a variance of 1.
        free: ``(0,)`` where the target's scale is adjusted: all distances from the camera are in
            its proportion.
    """

    poses: Rigid
    whitening: Array
    free: tuple[int, ...] = ()

    @property
    def extra(self) -> int:
        """How many parameters are adjusted beside the poses."""
        return len(self.free)

    def taken(self, index: Index) -> PoseObservations:
        """Return some of the views."""
        return PoseObservations(self.poses.taken(index), self.whitening[index], self.free)

    def scale(self, change: Array) -> float:
        """Return the target's size over the nominal one, of a change (extra,)."""
        return 1.0 + float(change.sum())

    def spread(self, factor: float) -> PoseObservations:
        """Return them with all standard deviations larger by a factor."""
        return dataclasses.replace(self, whitening=self.whitening / factor)

    def evaluate(self, seen: Rigid, change: Array) -> tuple[Array, Array]:
        """Return whitened residuals (V, 6) and their derivatives (V, 6, 6 + extra)."""
        off = discrepancy(self.poses.scaled(self.scale(change)), seen)
        slopes = np.zeros((len(off), 6, 6 + self.extra))
        slopes[:, :3, :3] = np.linalg.inv(_right_jacobian(-off[:, :3]))
        slopes[:, 3:, 3:6] = np.eye(3)
        slopes[:, 3:, 6:] = -self.poses.translation[..., None][..., : self.extra]
        whitened = (self.whitening @ off[..., None])[..., 0]
        return whitened, self.whitening @ slopes


def discrepancy(measured: Rigid, seen: Rigid) -> Array:
    """Return the turns and shifts (..., 6) that lead from measured poses to others."""
    turn = log_rotation(seen.rotation @ np.swapaxes(measured.rotation, -1, -2))
    return np.concatenate([turn, seen.translation - measured.translation], axis=-1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Adjusted:
    """What fits the observations best.

    Attributes:
        camera: ``X``.
        target: ``Z``.
        corrections: (V, 6), of the robot's poses; zeros where they are taken as they are.
        change: (extra,), of the parameters beside the poses.
        cost: weighted sum of squares, of residuals and corrections.
        information: (12 + extra, 12 + extra), of ``X``, ``Z`` and the others; what
            the robot's corrections leave of it.
        converged: whether no step gained anything at the end.
    """

    camera: Rigid
    target: Rigid
    corrections: Array
    change: Array
    cost: float
    information: Array
    converged: bool


def _corrected(robot: Robot, corrections: Array) -> Robot:
    return dataclasses.replace(robot, poses=robot.poses.moved(corrections))


def _spread(sigmas: RobotSigmas) -> Array:
    return np.repeat([sigmas.rotation, sigmas.translation], 3)


class Sums(NamedTuple):
    """Products of an adjustment's derivatives and residuals.

    Attributes:
        total: (V, 6 + P + 1, 6 + P + 1): by the correction of the robot's pose, by ``X``, ``Z`` and
            the parameters beside them (P), and the residuals as they were without the corrections.
        squares: of the residuals with them.
    """

    total: Array
    squares: float


def sums(robot: Robot, seen: Observations, at: Adjusted, *, poses_only: bool = False) -> Sums:
    """Return the products of an adjustment's derivatives and residuals, view by view.

    Args:
        robot: its poses.
        seen: what the camera saw.
        at: where the derivatives are taken.
        poses_only: leave out how well the points of a view fit each other, whatever its pose.
    """
    moved = _corrected(robot, at.corrections)
    off, slopes = seen.evaluate(carried(at.camera, moved, at.target), at.change)
    outer, inner = _chain(at.camera, moved, at.target)
    inner[:, :, :3] = inner[:, :, :3] @ _right_jacobian(at.corrections[:, :3])
    own = slopes[:, :, :6] @ inner
    before = off[..., None] - own @ at.corrections[..., None]
    rows = np.concatenate([own, slopes[:, :, :6] @ outer, slopes[:, :, 6:], before], axis=2)
    if poses_only:
        rows = np.swapaxes(np.linalg.qr(slopes[:, :, :6])[0], 1, 2) @ rows
    return Sums(np.swapaxes(rows, 1, 2) @ rows, float((off**2).sum()))


class _Normal(NamedTuple):
    """Normal equations of a step: of the robot's poses, of the rest, and between them.

    Attributes:
        cost: weighted sum of squares, of residuals and corrections; infinite where a point lies
            behind the camera.
    """

    cost: float
    inner: Array
    inner_right: Array
    mixed: Array
    outer: Array
    outer_right: Array


def _normal(robot: Robot, seen: Observations, at: Adjusted, sigmas: RobotSigmas | None) -> _Normal:
    with np.errstate(all="ignore"):
        total, cost = sums(robot, seen, at)
    cost = cost if math.isfinite(cost) else math.inf
    own, rest = slice(0, 6), slice(6, -1)
    right = total[:, :, -1] + (total[:, :, own] @ at.corrections[..., None])[..., 0]
    outer, outer_right = total[:, rest, rest].sum(axis=0), right[:, rest].sum(axis=0)
    if sigmas is None:
        count, unknown = len(total), len(outer)
        none = np.zeros((count, 0))
        mixed = np.zeros((count, unknown, 0))
        return _Normal(cost, none[..., None], none, mixed, outer, outer_right)
    weights = 1.0 / _spread(sigmas) ** 2
    return _Normal(
        cost + float((weights * at.corrections**2).sum()),
        total[:, own, own] + np.diag(weights),
        right[:, own] + weights * at.corrections,
        total[:, rest, own],
        outer,
        outer_right,
    )


def _reduced(normal: _Normal, damping: float) -> tuple[Array, Array, Array]:
    """Return the equations without the robot's poses, and what gives these back, (V, 6, P)."""
    outer: Array = normal.outer + damping * np.diag(np.diag(normal.outer))
    if not normal.inner_right.size:
        return outer, normal.outer_right, np.zeros((len(normal.inner_right), 0, len(outer)))
    inner = normal.inner + damping * _diagonal(normal.inner)
    solved = np.linalg.solve(inner, np.swapaxes(normal.mixed, 1, 2))
    outer = outer - (normal.mixed @ solved).sum(axis=0)
    own = np.linalg.solve(inner, normal.inner_right[..., None])
    right: Array = normal.outer_right - (normal.mixed @ own).sum(axis=0)[:, 0]
    back: Array = np.asarray(solved, dtype=np.float64)
    return outer, right, back


def _diagonal(blocks: Array) -> Array:
    return blocks * np.eye(blocks.shape[-1])


def _solve_scaled(matrix: Array, right: Array) -> Array:
    """Return the solution of positive equations whose unknowns have several units."""
    size = np.sqrt(np.maximum(np.diag(matrix), np.finfo(np.float64).tiny))
    solution: Array = (
        np.linalg.lstsq(matrix / np.outer(size, size), right / size, rcond=1e-14)[0] / size
    )
    return solution


def adjust(
    robot: Robot,
    seen: Observations,
    camera: Rigid,
    target: Rigid,
    *,
    sigmas: RobotSigmas | None = None,
    change: Array | None = None,
    gain: float = SMALLEST_GAIN,
) -> Adjusted:
    """Return what minimises the weighted squares, by Levenberg and Marquardt's steps.

    Args:
        robot: its poses.
        seen: what the camera saw, of as many views.
        camera: ``X`` to begin with.
        target: ``Z`` to begin with.
        sigmas: of the robot; None: its poses are exact.
        change: (extra,), of the parameters beside the poses, to begin with; None: zeros.
        gain: part of the cost that a step must gain, and beside it 100 times as much of a
            residual's variance: exact samples leave nothing but rounding to gain.

    Returns:
        The best that was found; ``cost`` is infinite where the target begins behind the camera.
    """
    at = _beginning(robot, seen, camera, target, change)
    normal = _normal(robot, seen, at, sigmas)
    damping, converged = 1e-6, False
    for _ in range(MOST_STEPS):
        if not math.isfinite(normal.cost):
            break
        before, tried = normal, at
        while damping < MOST_DAMPING:
            tried = _stepped(at, before, damping)
            normal = _normal(robot, seen, tried, sigmas)
            if normal.cost <= before.cost:
                break
            damping = max(10.0 * damping, 1e-6)
        else:
            normal = before
            break
        at, damping = tried, damping / 10.0
        if not before.cost - normal.cost > gain * (before.cost + 100.0):
            converged = True
            break
    if not math.isfinite(normal.cost):
        return at
    found = _reduced(normal, 0.0)[0]
    return dataclasses.replace(at, cost=normal.cost, information=found, converged=converged)


def _beginning(
    robot: Robot, seen: Observations, camera: Rigid, target: Rigid, change: Array | None
) -> Adjusted:
    return Adjusted(
        camera=camera,
        target=target,
        corrections=np.zeros((len(robot.poses.translation), 6)),
        change=np.zeros(seen.extra) if change is None else change,
        cost=math.inf,
        information=np.zeros((12 + seen.extra,) * 2),
        converged=False,
    )


def _stepped(at: Adjusted, normal: _Normal, damping: float) -> Adjusted:
    outer, right, solved = _reduced(normal, damping)
    step = -_solve_scaled(outer, right)
    corrections = at.corrections
    if normal.inner_right.size:
        inner = normal.inner + damping * _diagonal(normal.inner)
        own = np.linalg.solve(inner, normal.inner_right[..., None])[..., 0]
        corrections = corrections - own - solved @ step
    return dataclasses.replace(
        at,
        camera=at.camera.moved(step[:6]),
        target=at.target.moved(step[6:12]),
        change=at.change + step[12:],
        corrections=corrections,
    )


def information(
    robot: Robot,
    seen: Observations,
    camera: Rigid,
    target: Rigid,
    sigmas: RobotSigmas | None,
) -> Array:
    """Return Fisher's information of ``X`` and ``Z`` at a truth, (12 + extra, 12 + extra).

    Args:
        robot: its true poses.
        seen: what the camera would see without noise.
        camera: ``X``.
        target: ``Z``.
        sigmas: of the robot; None: its poses are known exactly.
    """
    at = _beginning(robot, seen, camera, target, None)
    return _reduced(_normal(robot, seen, at, sigmas), 0.0)[0]
