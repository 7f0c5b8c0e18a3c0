"""Set up and solve the equations of a camera and a robot: ``T_camera_target = X^-1 A Z``.

``X`` is the pose of the camera on its carrier, ``Z`` that of the target on its carrier, and ``A``
is the motion of the robot between the two: ``T_flange_base`` for a camera on the hand,
``T_base_flange`` for one that looks at the hand. A view's pose changes by a turn w and a shift d in
the camera's frame, R becomes ``exp([w]x) R`` and t ``t + d``; all derivatives are expressed by
these, so points in an image and poses without an image are adjusted by the same steps.

If the robot's poses have noise, each gets a correction; the corrections are eliminated from the
normal equations, see :mod:`smartcam.calibration._least_squares`.
"""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NamedTuple, Self, TypeAlias, get_args

import numpy as np

from smartcam.calibration._least_squares import NormalEquations, minimize, solve_scaled
from smartcam.calibration._lens.bundle import lens_values, with_lens
from smartcam.calibration._lens.projection import linearize, pose_changes
from smartcam.geometry._inside import Rigid, check_choice, cross_matrix, right_jacobian

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array

    Index = NDArray[np.intp] | slice
    Mask = NDArray[np.bool_]

Setup: TypeAlias = Literal["eye-in-hand", "eye-to-hand"]
"""Place of the camera: on the robot's hand, or beside the robot, looking at it."""


def is_in_hand(setup: object, label: str) -> bool:
    """Return True if the camera is on the hand, False if it looks at the robot.

    ``label`` names the calibration. Raises SHAPE if there is no such setup.
    """
    check_choice(setup, get_args(Setup), f"{label}: setup")
    return setup == "eye-in-hand"


MIN_GAIN = 1e-11
"""A fit for a result ends when a step gains less than this part of the cost."""

ROUGH_GAIN = 1e-7
"""A fit that is only compared ends when a step gains less than this part of the cost: it is then a
hundredth of a standard deviation off."""

FIRST_DAMPING = 1e-6
"""Part of the diagonal that is added at first: closed forms are so near that hardly any damping is
needed."""

MIN_OWN_SHARE_OF_BEND = 1e-3
"""Least share of a bend's heights that no tilt of the target and no bend before it has."""

ROUNDING_COST = 100.0
"""Squared standard deviations that are added to the cost with which a gain is compared, for
rounding errors."""


class RobotSigmas(NamedTuple):
    """Accuracy of a robot's poses, as standard deviations of each axis.

    Attributes:
        rotation: standard deviation of the turn about each axis, radians.
        translation: standard deviation of the shift along each axis, metres.
    """

    rotation: float
    translation: float


class RobotNoise(NamedTuple):
    """Noise of the robot's poses and of the camera's views."""

    robot: RobotSigmas  # standard deviations of the robot's poses
    # factor by which the views' poses are further off than the noise of their points causes: errors
    # that all points of a view share, such as those of the lens, do not average out
    shared: float = 1.0


@dataclass(frozen=True, slots=True)
class RobotPoses:
    """The robot's poses, with their role between camera and target."""

    poses: Rigid  # V times ``T_base_flange``
    in_hand: bool  # whether the camera is on the hand

    @property
    def between(self) -> Rigid:
        """``A`` of each view: from the target's carrier to the camera's."""
        return self.poses.inverse() if self.in_hand else self.poses

    def subset(self, index: Index) -> RobotPoses:
        """Return some of the poses."""
        return dataclasses.replace(self, poses=self.poses.subset(index))


def predicted_views(camera: Rigid, robot: RobotPoses, target: Rigid) -> Rigid:
    """Return ``T_camera_target`` of each view."""
    return camera.inverse() @ (robot.between @ target)


def _chain(camera: Rigid, robot: RobotPoses, target: Rigid) -> tuple[Array, Array]:
    """Return the derivatives of the views' poses, (V, 6, 12) and (V, 6, 6).

    The first are by steps of camera and target, as in :meth:`Rigid.turned_before`, the second by a
    step of the robot's pose.
    """
    # S = X^-1 A Z has R_S = R_X^T R_A R_Z and t_S = R_X^T (R_A t_Z + t_A - t_X). Each step (a, b)
    # turns by R exp([a]x) and shifts by b; what it does to S is written exp([w]x) R_S, t_S + d.
    # By R exp([a]x) = exp([R a]x) R, to first order:
    #     X: R_X^T becomes exp(-[a]x) R_X^T:  w = -a,            d = t_S x a - R_X^T b
    #     Z:                                  w = R_S a,         d = R_X^T R_A b
    #     robot beside the camera, A = T:     w = R_X^T R_T a,   d = w x lever + R_X^T b,
    #         lever = R_X^T R_T t_Z = t_S + R_X^T (t_X - t_T)
    #     camera on the hand, A = T^-1:       w = -R_X^T a,      d = w x lever - R_X^T R_T^T b,
    #         lever = R_X^T R_T^T (t_Z - t_T) = t_S + R_X^T t_X
    # Source of the conventions: Sola, Deray and Atchuthan, A micro Lie theory (arXiv 1812.01537).
    seen = predicted_views(camera, robot, target)
    back = camera.rotation.T
    count, turn = seen.size, robot.poses.rotation
    outer = np.zeros((count, 6, 12))
    outer[:, :3, 0:3] = -np.eye(3)
    outer[:, 3:, 0:3] = cross_matrix(seen.translation)
    outer[:, 3:, 3:6] = -back
    outer[:, :3, 6:9] = seen.rotation
    outer[:, 3:, 9:12] = back @ robot.between.rotation
    inner = np.zeros((count, 6, 6))
    if robot.in_hand:
        lever = seen.translation + camera.translation @ camera.rotation
        inner[:, :3, :3] = -back
        inner[:, 3:, :3] = cross_matrix(lever) @ back
        inner[:, 3:, 3:] = -back @ np.swapaxes(turn, 1, 2)
    else:
        lever = seen.translation + (camera.translation - robot.poses.translation) @ camera.rotation
        inner[:, :3, :3] = back @ turn
        inner[:, 3:, :3] = -cross_matrix(lever) @ back @ turn
        inner[:, 3:, 3:] = back
    return outer, inner


@dataclass(frozen=True, slots=True)
class Observations(ABC):
    """The camera's observations, view by view."""

    whitening: Array  # matrices that make the errors independent, with a variance of 1
    # numbers of the parameters that are adjusted beside the poses, ascending: 0 is the target's
    # scale, 1 to 4 are fx, fy, cx, cy, from 5 on the K of the distortion, from 5 + K on bends
    free: tuple[int, ...] = field(default=(), kw_only=True)

    @property
    def extra_count(self) -> int:
        """Number of parameters that are adjusted beside the poses."""
        return len(self.free)

    def spread(self, factor: float) -> Self:
        """Return the observations with all standard deviations multiplied by a factor."""
        return dataclasses.replace(self, whitening=self.whitening / factor)

    def scale(self, change: Array) -> float:
        """Return the target's size over the nominal one after a change (extra,)."""
        return 1.0 + float(change[0]) if 0 in self.free else 1.0

    @abstractmethod
    def subset(self, index: Index) -> Self:
        """Return some of the views."""

    @abstractmethod
    def settled(self, change: Array) -> Self:
        """Return the observations with a change (extra,) of the other parameters made and fixed."""

    @abstractmethod
    def evaluate(self, seen: Rigid, change: Array) -> tuple[Array, Array]:
        """Return whitened residuals (V, M) and their derivatives (V, M, 6 + extra).

        ``seen``: ``T_camera_target`` of each view. ``change`` (extra,): change of the parameters
        beside the poses.
        """


@dataclass(frozen=True, slots=True)
class PixelObservations(Observations):
    """Points in images; views with fewer points than others are padded with points of no weight.

    Attributes:
        whitening: (V, N, 2, 2), for the residual of each point.
        model: the camera.
        points: (V, N, 3), on the target, metres.
        pixels: (V, N, 2).
        heights: (V, N, B), of each point per metre of each bend, metres: see :func:`bends`.
    """

    model: CameraModel
    points: Array
    pixels: Array
    heights: Array

    def subset(self, index: Index) -> PixelObservations:
        """Return some of the views."""
        return dataclasses.replace(
            self,
            points=self.points[index],
            pixels=self.pixels[index],
            heights=self.heights[index],
            whitening=self.whitening[index],
        )

    def settled(self, change: Array) -> PixelObservations:
        """Return the observations with a change (extra,) of the other parameters made and fixed."""
        points = self.scale(change) * self._bent(self._full(change))
        return dataclasses.replace(self, model=self.camera(change), points=points, free=())

    def camera(self, change: Array) -> CameraModel:
        """Return the camera with some of its parameters changed, (extra,)."""
        if not any(self.free):
            return self.model
        return with_lens(self.model, lens_values(self.model) + self._full(change)[1 : self._lens])

    def evaluate(self, seen: Rigid, change: Array) -> tuple[Array, Array]:
        """Return whitened residuals (V, 2 N) and their derivatives (V, 2 N, 6 + extra).

        They are NaN for a change to an impossible target or lens, with a size or focal length below
        0.
        """
        views, count = self.pixels.shape[:2]
        full = self._full(change)
        if min(1.0 + full[0], *(np.diag(self.model.matrix)[:2] + full[1:3])) <= 0:
            nothing = np.full((views, 2 * count), np.nan)
            return nothing, np.full((*nothing.shape, 6 + self.extra_count), np.nan)
        # A point of a target of size s is at p = s R m + t: dp/ds = R m. Poses move p as
        # pose_changes has it, lenses move the pixel as the projection says, and a bend b moves m by
        # b h along the target's normal n: dp/db = s h R n.
        nominal = self._bent(full) @ np.swapaxes(seen.rotation, 1, 2)
        moved_points = self.scale(change) * nominal
        linearized = linearize(
            (moved_points + seen.translation[:, None]).reshape(-1, 3), self.camera(change)
        )
        moved = pose_changes(linearized.by_point, moved_points.reshape(-1, 3))
        grown = linearized.by_point @ nominal.reshape(-1, 3, 1)
        risen = self.scale(change) * seen.rotation[:, None, :, 2:] * self.heights[:, :, None]
        bent = linearized.by_point @ risen.reshape(views * count, 3, -1 if risen.size else 0)
        beside = np.concatenate([grown, linearized.by_lens, bent], axis=2)[:, :, list(self.free)]
        slopes = np.concatenate([moved, beside], axis=2).reshape(views, count, 2, -1)
        residuals = (linearized.pixels.reshape(views, count, 2) - self.pixels)[..., None]
        residuals, slopes = self.whitening @ residuals, self.whitening @ slopes
        return residuals.reshape(views, -1), slopes.reshape(views, 2 * count, -1)

    @property
    def _lens(self) -> int:
        """Number of the parameters up to the last one of the lens."""
        return 5 + len(self.model.distortion)

    def _full(self, change: Array) -> Array:
        full = np.zeros(self._lens + self.heights.shape[2])
        full[list(self.free)] = change
        return full

    def _bent(self, full: Array) -> Array:
        """Return the target's points with the bends of ``full`` made, (V, N, 3)."""
        points = self.points.copy()
        points[..., 2] += self.heights @ full[self._lens :]
        return points


def bends(points: Array, given: Mask) -> Array:
    """Return the heights of a target's points per metre of each bend, (V, N, B), 0 in the mean.

    The bends grow with x^2, x y and y^2. One that is a tilt of the target or another bend at these
    points is left out: four corners of a rectangle show one bend only.

    ``points`` (V, N, 3) are those of all views, not all on one line, ``given`` (V, N) the mask of
    those that were seen.
    """
    seen = points[given][:, :2]
    x, y = np.moveaxis((points[..., :2] - seen.mean(axis=0)) / np.ptp(seen, axis=0), 2, 0)
    known = [np.ones_like(x), x, y]
    for bend in (x * x, x * y, y * y):
        before = np.stack([column[given] for column in known], axis=1)
        unexplained = bend[given] - before @ np.linalg.lstsq(before, bend[given], rcond=None)[0]
        if np.linalg.norm(unexplained) > MIN_OWN_SHARE_OF_BEND * np.linalg.norm(bend[given]):
            known.append(bend)
    heights = np.stack(known, axis=2)[:, :, 3:]
    return np.asarray(heights - heights[given].mean(axis=0), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class PoseObservations(Observations):
    """Poses of the target without an image.

    If the target's scale is adjusted, all distances from the camera are proportional to it.

    Attributes:
        whitening: (V, 6, 6), for errors ``(w, d)``.
        poses: V times ``T_camera_target``.
    """

    poses: Rigid

    def subset(self, index: Index) -> PoseObservations:
        """Return some of the views."""
        return dataclasses.replace(
            self, poses=self.poses.subset(index), whitening=self.whitening[index]
        )

    def settled(self, change: Array) -> PoseObservations:
        """Return the observations with a change (extra,) of the other parameters made and fixed."""
        return dataclasses.replace(self, poses=self.poses.scaled(self.scale(change)), free=())

    def evaluate(self, seen: Rigid, change: Array) -> tuple[Array, Array]:
        """Return whitened residuals (V, 6) and their derivatives (V, 6, 6 + extra)."""
        # The turn e = log(R_S R_m^T) becomes log(exp([w]x) exp([e]x)), to first order e +
        # J_l(e)^-1 w, and the left Jacobian is J_l(e) = J_r(-e).
        # Source: Sola, Deray and Atchuthan, A micro Lie theory (arXiv 1812.01537), appendix B.
        residuals = self.poses.scaled(self.scale(change)).steps_to(seen)
        slopes = np.zeros((len(residuals), 6, 6 + self.extra_count))
        slopes[:, :3, :3] = np.linalg.inv(right_jacobian(-residuals[:, :3]))
        slopes[:, 3:, 3:6] = np.eye(3)
        slopes[:, 3:, 6:] = -self.poses.translation[..., None][..., : self.extra_count]
        whitened = (self.whitening @ residuals[..., None])[..., 0]
        return whitened, self.whitening @ slopes


@dataclass(frozen=True, slots=True)
class Solution:
    """The poses of camera and target, with everything else that was adjusted."""

    camera: Rigid  # ``X``
    target: Rigid  # ``Z``
    # (extra,), change of the parameters beside the poses
    change: Array = field(default_factory=lambda: np.zeros(0))
    # (V, 6), corrections of the robot's poses; empty if they were not adjusted
    corrections: Array = field(default_factory=lambda: np.zeros((0, 6)))
    # weighted sum of squares of residuals and corrections; infinite before an adjustment, and if
    # points lie behind the camera
    cost: float = math.inf
    # (12 + extra, 12 + extra), information of ``X``, ``Z`` and the other parameters after
    # eliminating the robot's corrections, one for each solution; None for closed forms
    information: Array | None = None
    # noise of the adjustment; None if the robot's poses were taken as exact
    noise: RobotNoise | None = None


def sums(
    robot: RobotPoses, seen: Observations, at: Solution, *, poses_only: bool = False
) -> tuple[Array, float]:
    """Return the products of an adjustment's derivatives and residuals, view by view.

    The first result (V, 6 + P + 1, 6 + P + 1) has the derivatives by the correction of the robot's
    pose (6), by ``X``, ``Z`` and the other parameters (P), and the residuals without the
    corrections (1). The second are the squares of the residuals with the corrections. The
    derivatives are taken at ``at``. ``poses_only`` leaves out the part of the residuals that no
    pose of the view can change.
    """
    moved = dataclasses.replace(robot, poses=robot.poses.turned_before(at.corrections))
    residuals, slopes = seen.evaluate(predicted_views(at.camera, moved, at.target), at.change)
    outer, inner = _chain(at.camera, moved, at.target)
    # A correction v stands in R exp([v]x), and exp([v + dv]x) = exp([v]x) exp([J_r(v) dv]x). With
    # it the equations are linearised at v; the residuals at v = 0 are, to first order, r - J v.
    inner[:, :, :3] = inner[:, :, :3] @ right_jacobian(at.corrections[:, :3])
    by_pose = slopes[:, :, :6] @ inner
    before = residuals[..., None] - by_pose @ at.corrections[..., None]
    rows = np.concatenate([by_pose, slopes[:, :, :6] @ outer, slopes[:, :, 6:], before], axis=2)
    # Of residuals r = J w + e only the part in the columns of J depends on the pose: Q^T r, J = Q
    # R.
    if poses_only:
        rows = np.swapaxes(np.linalg.qr(slopes[:, :, :6])[0], 1, 2) @ rows
    return np.swapaxes(rows, 1, 2) @ rows, float((residuals**2).sum())


def _by_view(robot: RobotPoses, seen: Observations, at: Solution) -> tuple[float, Array, Array]:
    """Return the cost, and each view's part of the equations of a step.

    These are (V, 6 + P, 6 + P) and (V, 6 + P), for the correction of the robot's pose, then as in
    :func:`sums`.
    """
    with np.errstate(all="ignore"):
        total, squares = sums(robot, seen, at)
    cost = squares if math.isfinite(squares) else math.inf
    matrix = total[:, :-1, :-1]
    right = -total[:, :-1, -1] - (total[:, :-1, :6] @ at.corrections[..., None])[..., 0]
    if at.noise is None:
        return cost, matrix, right
    # A correction is a residual, too, measured as 0 with the robot's variance, since its controller
    # states the mean.
    weights = 1.0 / np.repeat(at.noise.robot, 3) ** 2
    matrix[:, range(6), range(6)] += weights
    right[:, :6] -= weights * at.corrections
    return cost + float((weights * at.corrections**2).sum()), matrix, right


def _normal(robot: RobotPoses, seen: Observations, at: Solution) -> NormalEquations:
    """Return the equations of a step; ``X``, ``Z`` and the other parameters are shared."""
    cost, matrix, right = _by_view(robot, seen, at)
    correction, shared = slice(0, 6 if at.noise else 0), slice(6, None)
    return NormalEquations(
        cost,
        matrix[:, shared, shared].sum(axis=0),
        right[:, shared].sum(axis=0),
        matrix[:, correction, correction],
        right[:, correction],
        matrix[:, correction, shared],
    )


def adjust(
    robot: RobotPoses,
    seen: Observations,
    start: Solution,
    noise: RobotNoise | None = None,
    *,
    gain: float = MIN_GAIN,
) -> Solution:
    """Minimize the weighted squares by Levenberg and Marquardt's steps.

    The ``cost`` of the result is infinite if the target begins behind the camera, or ends where
    nothing determines the poses. If ``noise`` is None, the robot's poses are exact. The fit ends
    when a step gains less than the part ``gain`` of the cost plus ROUNDING_COST, since exact
    samples leave only rounding errors to gain.
    """
    spread = seen if noise is None else seen.spread(noise.shared)
    change = start.change if start.change.size else np.zeros(seen.extra_count)
    none = np.zeros((robot.poses.size, 6))
    at, normal = minimize(
        Solution(start.camera, start.target, change, none, noise=noise),
        lambda at: _normal(robot, spread, at),
        _stepped,
        min_gain=gain,
        rounding_cost=ROUNDING_COST,
        damping=FIRST_DAMPING,
    )
    if not math.isfinite(normal.cost):
        return at
    try:
        information = normal.eliminate_poses()[0]
    except np.linalg.LinAlgError:  # poses and views so wrong that a target is in the camera
        return dataclasses.replace(at, cost=math.inf)
    return dataclasses.replace(at, cost=normal.cost, information=information)


def _stepped(at: Solution, step: Array, corrections: Array) -> Solution:
    return dataclasses.replace(
        at,
        camera=at.camera.turned_before(step[:6]),
        target=at.target.turned_before(step[6:12]),
        change=at.change + step[12:],
        corrections=at.corrections + corrections if corrections.size else at.corrections,
    )


def without_each(robot: RobotPoses, seen: Observations, solution: Solution) -> Solution:
    """Return the solutions without each view, stacked (V, ...); ``solution`` is that of all views.

    The noise is the one estimated from all views.
    """
    # One Gauss-Newton step from the whole solution, with the view's own part taken out of the sums:
    # its normal equations are a sum over views, and only steps of second order are lost.
    # Source: Cook and Weisberg, Residuals and Influence in Regression (1982), section 5.2.
    spread = seen if solution.noise is None else seen.spread(solution.noise.shared)
    _, matrix, right = _by_view(robot, spread, solution)
    correction, shared = slice(0, 6 if solution.noise else 0), slice(6, None)
    mixed = np.swapaxes(matrix[:, correction, shared], 1, 2)
    both = np.concatenate([matrix[:, correction, shared], right[:, correction, None]], axis=2)
    solved = mixed @ np.linalg.solve(matrix[:, correction, correction], both)
    matrices, rights = (
        matrix[:, shared, shared] - solved[..., :-1],
        right[:, shared] - solved[..., -1],
    )
    left, rights = matrices.sum(axis=0) - matrices, rights.sum(axis=0) - rights
    steps = np.stack([solve_scaled(*system) for system in zip(left, rights, strict=True)])
    return Solution(
        solution.camera.turned_before(steps[:, :6]),
        solution.target.turned_before(steps[:, 6:12]),
        solution.change + steps[:, 12:],
        information=left,
    )


def pull(robot: RobotPoses, seen: Observations, at: Solution, numbers: tuple[int, ...]) -> Array:
    """Return the derivatives of ``X`` and ``Z`` by other parameters that were not adjusted."""
    # The gradient g(x, l) of a least-squares solution is 0 for any l, such as a lens:
    # dx/dl = -(dg/dx)^-1 dg/dl.
    freed = dataclasses.replace(seen, free=(*seen.free, *numbers))
    change, none = np.zeros(freed.extra_count), np.zeros((robot.poses.size, 6))
    change[: seen.extra_count] = at.change
    spread = freed if at.noise is None else freed.spread(at.noise.shared)
    corrections = at.corrections if at.corrections.size else none
    begin = dataclasses.replace(at, change=change, corrections=corrections)
    matrix, fitted = _normal(robot, spread, begin).eliminate_poses()[0], 12 + seen.extra_count
    slopes: Array = -solve_scaled(matrix[:fitted, :fitted], matrix[:fitted, fitted:])[:12]
    return slopes


def information(robot: RobotPoses, seen: Observations, truth: Solution) -> Array:
    """Return Fisher's information of ``X`` and ``Z`` at the true values, (12 + extra, 12 + extra).

    ``robot`` and ``seen`` are without noise; ``truth`` has the noise of the robot.
    """
    none = np.zeros((robot.poses.size, 6))
    return _normal(robot, seen, dataclasses.replace(truth, corrections=none)).eliminate_poses()[0]
