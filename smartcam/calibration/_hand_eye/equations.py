"""Find a camera's pose on a robot by least squares, from ``T_camera_target = X^-1 A Z``.

``X`` is the pose of the camera on its carrier, ``Z`` the pose of the target on its carrier, and
``A`` the motion of the robot between the carriers: ``T_flange_base`` for a camera on the hand,
``T_base_flange`` for a camera that looks at the hand. A small change of a view's pose is a turn w
and a shift d in the camera's frame: R becomes ``exp([w]x) R``, and t becomes ``t + d``. All
derivatives are by w and d, so points in an image and poses without an image are adjusted by the
same steps.

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
from smartcam.calibration._lens.projection import linearize, pixels_by_pose
from smartcam.geometry._inside import Rigid, check_choice, cross_matrix, right_jacobian

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array

    Index = NDArray[np.intp] | slice
    Mask = NDArray[np.bool_]

Setup: TypeAlias = Literal["eye-in-hand", "eye-to-hand"]
"""Place of the camera: on the robot's hand, or fixed, looking at the hand."""


def is_in_hand(setup: object, label: str) -> bool:
    """Return True if the camera is on the hand, False if it looks at the robot.

    ``label`` names the calibration. Raises SHAPE if there is no such setup.
    """
    check_choice(setup, get_args(Setup), f"{label}: setup")
    return setup == "eye-in-hand"


MIN_GAIN = 1e-11
"""A final fit ends when a step gains less than this fraction of the cost."""

ROUGH_GAIN = 1e-7
"""A fit that is only compared with others ends when a step gains less than this fraction of the
cost: it is then a hundredth of a standard deviation from the minimum."""

FIRST_DAMPING = 1e-6
"""Damping of the first step, as a fraction of the diagonal: closed forms are so near to the minimum
that hardly any damping is needed."""

MIN_UNEXPLAINED_BEND_SHARE = 1e-3
"""A bend of the target is adjusted only if at least this share of the points' heights under the
bend is neither a tilt of the target nor an earlier bend."""

ROUNDING_COST = 100.0
"""Constant that is added to the cost, in squared standard deviations, before a gain is compared
with a part of it, so that rounding errors do not count as a gain."""


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
    # factor by which the errors of the views' poses exceed those that the noise of the points
    # causes: errors that all points of a view share, such as errors of the lens, do not average out
    view_error_factor: float = 1.0


@dataclass(frozen=True, slots=True)
class RobotPoses:
    """The robot's poses, and whether the camera is on its hand."""

    poses: Rigid  # V times ``T_base_flange``
    in_hand: bool  # whether the camera is on the hand

    @property
    def carrier_motion(self) -> Rigid:
        """``A`` of each view: the motion from the target's carrier to the camera's."""
        return self.poses.inverse() if self.in_hand else self.poses

    def subset(self, index: Index) -> RobotPoses:
        """Return the poses at some indices."""
        return dataclasses.replace(self, poses=self.poses.subset(index))


def predicted_views(camera: Rigid, robot: RobotPoses, target: Rigid) -> Rigid:
    """Return ``T_camera_target`` of each view."""
    return camera.inverse() @ (robot.carrier_motion @ target)


def _pose_derivatives(camera: Rigid, robot: RobotPoses, target: Rigid) -> tuple[Array, Array]:
    """Return the derivatives of ``T_camera_target`` of each view, (V, 6, 12) and (V, 6, 6).

    The first are those by steps of ``X`` and ``Z``, as in :meth:`Rigid.turned_in_source`, the
    second those by a step of the robot's pose.
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
    target_poses = predicted_views(camera, robot, target)
    inverse_rotation = camera.rotation.T
    count, robot_rotation = target_poses.size, robot.poses.rotation
    by_motions = np.zeros((count, 6, 12))
    by_motions[:, :3, 0:3] = -np.eye(3)
    by_motions[:, 3:, 0:3] = cross_matrix(target_poses.translation)
    by_motions[:, 3:, 3:6] = -inverse_rotation
    by_motions[:, :3, 6:9] = target_poses.rotation
    by_motions[:, 3:, 9:12] = inverse_rotation @ robot.carrier_motion.rotation
    by_robot = np.zeros((count, 6, 6))
    if robot.in_hand:
        lever = target_poses.translation + camera.translation @ camera.rotation
        by_robot[:, :3, :3] = -inverse_rotation
        by_robot[:, 3:, :3] = cross_matrix(lever) @ inverse_rotation
        by_robot[:, 3:, 3:] = -inverse_rotation @ np.swapaxes(robot_rotation, 1, 2)
    else:
        lever = (
            target_poses.translation
            + (camera.translation - robot.poses.translation) @ camera.rotation
        )
        by_robot[:, :3, :3] = inverse_rotation @ robot_rotation
        by_robot[:, 3:, :3] = -cross_matrix(lever) @ inverse_rotation @ robot_rotation
        by_robot[:, 3:, 3:] = inverse_rotation
    return by_motions, by_robot


@dataclass(frozen=True, slots=True)
class Observations(ABC):
    """The camera's observations, view by view."""

    whitening: Array  # matrices that make the errors independent, with a variance of 1
    # numbers of the parameters that are adjusted in addition to the poses, ascending: 0 is the
    # target's scale, 1 to 4 are fx, fy, cx, cy, the next K the distortion, from 5 + K on bends
    free_parameters: tuple[int, ...] = field(default=(), kw_only=True)

    @property
    def extra_count(self) -> int:
        """Number of parameters that are adjusted in addition to the poses."""
        return len(self.free_parameters)

    def with_scaled_sigmas(self, factor: float) -> Self:
        """Return the observations with all standard deviations multiplied by a factor."""
        return dataclasses.replace(self, whitening=self.whitening / factor)

    def scale(self, change: Array) -> float:
        """Return the target's size, relative to the nominal size, after a change (extra,)."""
        return 1.0 + float(change[0]) if 0 in self.free_parameters else 1.0

    @abstractmethod
    def subset(self, index: Index) -> Self:
        """Return the views at some indices."""

    @abstractmethod
    def with_change(self, change: Array) -> Self:
        """Return the observations after a change (extra,) of parameters, which are then fixed."""

    @abstractmethod
    def evaluate(self, target_poses: Rigid, change: Array) -> tuple[Array, Array]:
        """Return whitened residuals (V, M) and their derivatives (V, M, 6 + extra).

        ``target_poses``: ``T_camera_target`` of each view. ``change`` (extra,): change of the
        parameters.
        """


@dataclass(frozen=True, slots=True)
class PixelObservations(Observations):
    """Points in images; views with fewer points than others are padded with points of no weight.

    Attributes:
        whitening: (V, N, 2, 2), for the residual of each point.
        model: the camera.
        points: (V, N, 3), on the target, metres.
        pixels: (V, N, 2).
        heights: (V, N, B), of each point per metre of each bend, metres: see :func:`bend_heights`.
    """

    model: CameraModel
    points: Array
    pixels: Array
    heights: Array

    def subset(self, index: Index) -> PixelObservations:
        """Return the views at some indices."""
        return dataclasses.replace(
            self,
            points=self.points[index],
            pixels=self.pixels[index],
            heights=self.heights[index],
            whitening=self.whitening[index],
        )

    def with_change(self, change: Array) -> PixelObservations:
        """Return the observations after a change (extra,) of parameters, which are then fixed."""
        points = self.scale(change) * self._bend_points(self._full_change(change))
        return dataclasses.replace(
            self, model=self.camera(change), points=points, free_parameters=()
        )

    def camera(self, change: Array) -> CameraModel:
        """Return the camera after a change (extra,) of the parameters."""
        if not any(self.free_parameters):
            return self.model
        return with_lens(
            self.model, lens_values(self.model) + self._full_change(change)[1 : self._bends_start]
        )

    def evaluate(self, target_poses: Rigid, change: Array) -> tuple[Array, Array]:
        """Return whitened residuals (V, 2 N) and their derivatives (V, 2 N, 6 + extra).

        They are NaN if the change makes the target's size or a focal length 0 or less.
        """
        views, count = self.pixels.shape[:2]
        full_change = self._full_change(change)
        if min(1.0 + full_change[0], *(np.diag(self.model.matrix)[:2] + full_change[1:3])) <= 0:
            undefined = np.full((views, 2 * count), np.nan)
            return undefined, np.full((*undefined.shape, 6 + self.extra_count), np.nan)
        # A point of a target of size s is at p = s R m + t: dp/ds = R m. Poses move p as in
        # pixels_by_pose, lenses move the pixel as the projection says, and a bend b moves m by b h
        # along the target's normal n: dp/db = s h R n.
        nominal = self._bend_points(full_change) @ np.swapaxes(target_poses.rotation, 1, 2)
        scaled_points = self.scale(change) * nominal
        projection = linearize(
            (scaled_points + target_poses.translation[:, None]).reshape(-1, 3), self.camera(change)
        )
        by_pose = pixels_by_pose(projection.by_point, scaled_points.reshape(-1, 3))
        by_scale = projection.by_point @ nominal.reshape(-1, 3, 1)
        bend_shifts = (
            self.scale(change) * target_poses.rotation[:, None, :, 2:] * self.heights[:, :, None]
        )
        by_bend = projection.by_point @ bend_shifts.reshape(
            views * count, 3, -1 if bend_shifts.size else 0
        )
        by_parameters = np.concatenate([by_scale, projection.by_lens, by_bend], axis=2)[
            :, :, list(self.free_parameters)
        ]
        slopes = np.concatenate([by_pose, by_parameters], axis=2).reshape(views, count, 2, -1)
        residuals = (projection.pixels.reshape(views, count, 2) - self.pixels)[..., None]
        residuals, slopes = self.whitening @ residuals, self.whitening @ slopes
        return residuals.reshape(views, -1), slopes.reshape(views, 2 * count, -1)

    @property
    def _bends_start(self) -> int:
        """Index of the first bend; the target's scale and the lens' parameters come before."""
        return 5 + len(self.model.distortion)

    def _full_change(self, change: Array) -> Array:
        """Return the change of all parameters, 0 for those that are not adjusted."""
        full_change = np.zeros(self._bends_start + self.heights.shape[2])
        full_change[list(self.free_parameters)] = change
        return full_change

    def _bend_points(self, full_change: Array) -> Array:
        """Return the target's points (V, N, 3) after the bends in ``full_change``."""
        points = self.points.copy()
        points[..., 2] += self.heights @ full_change[self._bends_start :]
        return points


def bend_heights(points: Array, mask: Mask) -> Array:
    """Return the heights (V, N, B) of a target's points per metre of each bend; their mean is 0.

    The bends grow with x^2, x y and y^2. A bend that cannot be distinguished from a tilt or another
    bend at these points is left out: four corners of a rectangle show only one bend.

    ``points`` (V, N, 3): points of all views, not all on one line. ``mask`` (V, N): True for points
    that were seen.
    """
    seen_points = points[mask][:, :2]
    x, y = np.moveaxis(
        (points[..., :2] - seen_points.mean(axis=0)) / np.ptp(seen_points, axis=0), 2, 0
    )
    columns = [np.ones_like(x), x, y]
    for bend in (x * x, x * y, y * y):
        known_columns = np.stack([column[mask] for column in columns], axis=1)
        unexplained = (
            bend[mask] - known_columns @ np.linalg.lstsq(known_columns, bend[mask], rcond=None)[0]
        )
        if np.linalg.norm(unexplained) > MIN_UNEXPLAINED_BEND_SHARE * np.linalg.norm(bend[mask]):
            columns.append(bend)
    heights = np.stack(columns, axis=2)[:, :, 3:]
    return np.asarray(heights - heights[mask].mean(axis=0), dtype=np.float64)


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
        """Return the views at some indices."""
        return dataclasses.replace(
            self, poses=self.poses.subset(index), whitening=self.whitening[index]
        )

    def with_change(self, change: Array) -> PoseObservations:
        """Return the observations after a change (extra,) of parameters, which are then fixed."""
        return dataclasses.replace(
            self, poses=self.poses.scaled(self.scale(change)), free_parameters=()
        )

    def evaluate(self, target_poses: Rigid, change: Array) -> tuple[Array, Array]:
        """Return whitened residuals (V, 6) and their derivatives (V, 6, 6 + extra)."""
        # The turn e = log(R_S R_m^T) becomes log(exp([w]x) exp([e]x)), to first order e +
        # J_l(e)^-1 w, and the left Jacobian is J_l(e) = J_r(-e).
        # Source: Sola, Deray and Atchuthan, A micro Lie theory (arXiv 1812.01537), appendix B.
        residuals = self.poses.scaled(self.scale(change)).target_steps_to(target_poses)
        slopes = np.zeros((len(residuals), 6, 6 + self.extra_count))
        slopes[:, :3, :3] = np.linalg.inv(right_jacobian(-residuals[:, :3]))
        slopes[:, 3:, 3:6] = np.eye(3)
        slopes[:, 3:, 6:] = -self.poses.translation[..., None][..., : self.extra_count]
        whitened = (self.whitening @ residuals[..., None])[..., 0]
        return whitened, self.whitening @ slopes


@dataclass(frozen=True, slots=True)
class Solution:
    """The poses of camera and target, and all other values that were adjusted."""

    camera: Rigid  # ``X``
    target: Rigid  # ``Z``
    # (extra,), by how much the target's scale and the lens differ from their nominal values
    change: Array = field(default_factory=lambda: np.zeros(0))
    # (V, 6), corrections of the robot's poses; empty if they were not adjusted
    corrections: Array = field(default_factory=lambda: np.zeros((0, 6)))
    # weighted sum of squares of residuals and corrections; infinite before an adjustment, and if
    # points lie behind the camera
    cost: float = math.inf
    # (12 + extra, 12 + extra), information of ``X``, ``Z`` and the other parameters after
    # eliminating the robot's corrections, stacked if the solutions are; None for closed forms
    information: Array | None = None
    # noise of the adjustment; None if the robot's poses were taken as exact
    noise: RobotNoise | None = None


def view_products(
    robot: RobotPoses, observations: Observations, solution: Solution, *, poses_only: bool = False
) -> tuple[Array, float]:
    """Return the products J^T J of derivatives and residuals of each view, and all squares' sum.

    J has 6 + P + 1 columns: derivatives by the correction of the robot's pose (6), derivatives by
    ``X``, ``Z`` and the other parameters (P), and the residuals without the corrections (1). The
    sum is that of the squared residuals with the corrections. The derivatives are taken at
    ``solution``. ``poses_only`` leaves out the part of the residuals that no change of the view's
    pose can reduce.
    """
    corrected = dataclasses.replace(robot, poses=robot.poses.turned_in_source(solution.corrections))
    residuals, slopes = observations.evaluate(
        predicted_views(solution.camera, corrected, solution.target), solution.change
    )
    by_motions, by_robot = _pose_derivatives(solution.camera, corrected, solution.target)
    # A correction v changes R to R exp([v]x), and exp([v + dv]x) = exp([v]x) exp([J_r(v) dv]x).
    # With it the equations are linearised at v; the residuals at v = 0 are, to first order, r - J
    # v.
    by_robot[:, :, :3] = by_robot[:, :, :3] @ right_jacobian(solution.corrections[:, :3])
    by_correction = slopes[:, :, :6] @ by_robot
    uncorrected = residuals[..., None] - by_correction @ solution.corrections[..., None]
    rows = np.concatenate(
        [by_correction, slopes[:, :, :6] @ by_motions, slopes[:, :, 6:], uncorrected], axis=2
    )
    # Of residuals r = J w + e only the part in the columns of J depends on the pose: with J = Q R
    # it is Q^T r.
    if poses_only:
        rows = np.swapaxes(np.linalg.qr(slopes[:, :, :6])[0], 1, 2) @ rows
    return np.swapaxes(rows, 1, 2) @ rows, float((residuals**2).sum())


def _view_equations(
    robot: RobotPoses, observations: Observations, solution: Solution
) -> tuple[float, Array, Array]:
    """Return the cost, and the matrix and right side of each view's equations for a step.

    Their shapes are (V, 6 + P, 6 + P) and (V, 6 + P), with the unknowns in the order of
    :func:`view_products`.
    """
    with np.errstate(all="ignore"):
        products, squares = view_products(robot, observations, solution)
    cost = squares if math.isfinite(squares) else math.inf
    matrix = products[:, :-1, :-1]
    right = -products[:, :-1, -1] - (products[:, :-1, :6] @ solution.corrections[..., None])[..., 0]
    if solution.noise is None:
        return cost, matrix, right
    # Each correction is also a residual: its expected value is 0, with the robot's variance, since
    # the controller reports the mean pose.
    weights = 1.0 / np.repeat(solution.noise.robot, 3) ** 2
    matrix[:, range(6), range(6)] += weights
    right[:, :6] -= weights * solution.corrections
    return cost + float((weights * solution.corrections**2).sum()), matrix, right


def _normal_equations(
    robot: RobotPoses, observations: Observations, solution: Solution
) -> NormalEquations:
    """Return the equations of a step; ``X``, ``Z`` and the other parameters are shared."""
    cost, matrix, right = _view_equations(robot, observations, solution)
    correction, shared = slice(0, 6 if solution.noise else 0), slice(6, None)
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
    observations: Observations,
    start: Solution,
    noise: RobotNoise | None = None,
    *,
    min_gain: float = MIN_GAIN,
) -> Solution:
    """Minimize the weighted squares by Levenberg and Marquardt's steps.

    The ``cost`` of the result is infinite if the target is behind the camera at the start, or if
    the poses are not determined at the end. If ``noise`` is None, the robot's poses are exact. The
    fit ends when a step gains less than the part ``min_gain`` of the cost plus ROUNDING_COST, since
    exact samples leave only rounding errors to gain.
    """
    scaled_observations = (
        observations if noise is None else observations.with_scaled_sigmas(noise.view_error_factor)
    )
    change = start.change if start.change.size else np.zeros(observations.extra_count)
    no_corrections = np.zeros((robot.poses.size, 6))
    solution, normal = minimize(
        Solution(start.camera, start.target, change, no_corrections, noise=noise),
        lambda solution: _normal_equations(robot, scaled_observations, solution),
        _apply_steps,
        min_gain=min_gain,
        rounding_cost=ROUNDING_COST,
        damping=FIRST_DAMPING,
    )
    if not math.isfinite(normal.cost):
        return solution
    try:
        information = normal.eliminate_poses()[0]
    except np.linalg.LinAlgError:  # some pose puts the target into the camera
        return dataclasses.replace(solution, cost=math.inf)
    return dataclasses.replace(solution, cost=normal.cost, information=information)


def _apply_steps(solution: Solution, step: Array, corrections: Array) -> Solution:
    return dataclasses.replace(
        solution,
        camera=solution.camera.turned_in_source(step[:6]),
        target=solution.target.turned_in_source(step[6:12]),
        change=solution.change + step[12:],
        corrections=solution.corrections + corrections
        if corrections.size
        else solution.corrections,
    )


def leave_each_out(robot: RobotPoses, observations: Observations, solution: Solution) -> Solution:
    """Return the solutions without each view, stacked (V, ...); ``solution`` is that of all views.

    The noise that was estimated from all views is kept.
    """
    # One Gauss-Newton step from the solution of all views, with the view's part subtracted from the
    # normal equations, which are a sum over views. The error of this step is of second order.
    # Source: Cook and Weisberg, Residuals and Influence in Regression (1982), section 5.2.
    scaled_observations = (
        observations
        if solution.noise is None
        else observations.with_scaled_sigmas(solution.noise.view_error_factor)
    )
    _, matrix, right = _view_equations(robot, scaled_observations, solution)
    correction, shared = slice(0, 6 if solution.noise else 0), slice(6, None)
    mixed = np.swapaxes(matrix[:, correction, shared], 1, 2)
    right_sides = np.concatenate(
        [matrix[:, correction, shared], right[:, correction, None]], axis=2
    )
    solved = mixed @ np.linalg.solve(matrix[:, correction, correction], right_sides)
    matrices, rights = (
        matrix[:, shared, shared] - solved[..., :-1],
        right[:, shared] - solved[..., -1],
    )
    remaining, rights = matrices.sum(axis=0) - matrices, rights.sum(axis=0) - rights
    steps = np.stack([solve_scaled(*system) for system in zip(remaining, rights, strict=True)])
    return Solution(
        solution.camera.turned_in_source(steps[:, :6]),
        solution.target.turned_in_source(steps[:, 6:12]),
        solution.change + steps[:, 12:],
        information=remaining,
    )


def derivatives_by_parameters(
    robot: RobotPoses, observations: Observations, solution: Solution, numbers: tuple[int, ...]
) -> Array:
    """Return the derivatives of ``X`` and ``Z`` by other parameters that were not adjusted."""
    # The gradient g(x, l) of a least-squares solution is 0 for any l, such as a lens:
    # dx/dl = -(dg/dx)^-1 dg/dl.
    freed_observations = dataclasses.replace(
        observations, free_parameters=(*observations.free_parameters, *numbers)
    )
    change, no_corrections = (
        np.zeros(freed_observations.extra_count),
        np.zeros((robot.poses.size, 6)),
    )
    change[: observations.extra_count] = solution.change
    scaled_observations = (
        freed_observations
        if solution.noise is None
        else freed_observations.with_scaled_sigmas(solution.noise.view_error_factor)
    )
    corrections = solution.corrections if solution.corrections.size else no_corrections
    start = dataclasses.replace(solution, change=change, corrections=corrections)
    matrix = _normal_equations(robot, scaled_observations, start).eliminate_poses()[0]
    count = 12 + observations.extra_count
    slopes: Array = -solve_scaled(matrix[:count, :count], matrix[:count, count:])[:12]
    return slopes


def fisher_information(robot: RobotPoses, observations: Observations, truth: Solution) -> Array:
    """Return Fisher's information of ``X`` and ``Z`` at the true values, (12 + extra, 12 + extra).

    ``robot`` and ``observations`` are without noise; ``truth`` has the noise of the robot.
    """
    no_corrections = np.zeros((robot.poses.size, 6))
    return _normal_equations(
        robot, observations, dataclasses.replace(truth, corrections=no_corrections)
    ).eliminate_poses()[0]
