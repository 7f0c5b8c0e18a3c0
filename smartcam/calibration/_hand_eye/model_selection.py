"""Choose the hand-eye method that predicts unseen poses best.

There are two methods. ``robot`` corrects each pose of the robot as far as noise allows. It is best
where the robot's only error is noise. ``reprojection`` takes the robot's poses as they are and
minimizes the error on the target. It is best where a robot has other errors (joints with offsets,
gears with play, a sheet of another size), which corrections of single poses do not describe.

Left-out poses decide between the two: each method is solved again without one pose, and predicts
from the robot's pose where the camera would see the target. The distance to where the target was
seen, in metres on the target as it matters for picking, is the held-out error. ``reprojection`` is
chosen if its errors are smaller by more than chance. Mixtures of the two methods predict no better:
0.2 % worse over 26 kinds of simulated robots, up to 9 % worse on recorded ones (measured).

The camera's lens and the target's scale are adjusted as well if two conditions hold: the held-out
error is then smaller, and noise alone would hardly ever change them by as much. An unneeded scale
makes the error of the camera's position two to five times as large.
"""

from __future__ import annotations

import dataclasses
import math
import operator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from smartcam.calibration._hand_eye.closed_forms import (
    MIN_POSES,
    OPENCV_METHODS,
    estimate_scale,
    solve_closed_form,
)
from smartcam.calibration._hand_eye.equations import (
    PixelObservations,
    PoseObservations,
    RobotNoise,
    Solution,
    adjust,
    derivatives_by_parameters,
    leave_each_out,
    predicted_views,
)
from smartcam.calibration._hand_eye.robot_noise import adjust_with_noise
from smartcam.calibration._least_squares import solve_scaled
from smartcam.calibration._statistics import Noise
from smartcam.exceptions import CalibrationError
from smartcam.geometry._inside import Rigid

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from smartcam.calibration._hand_eye.equations import RobotPoses, RobotSigmas
    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array

    AnyObservations = PixelObservations | PoseObservations

SIGNIFICANCE_LEVEL = 1e-4
"""Parameters are adjusted only if the probability that noise alone changes them by as much is below
this value: an unneeded scale makes the camera's error up to eight times as large."""

SURE_GAIN = 2.0
"""A method is surely better if it predicts poses better by this many standard errors: simulated
robots whose only error is noise reach 1.9 by chance."""

MAX_SIZE_ERROR_RATIO = 0.05
"""Largest error of a target's stated size, as a fraction of it, from which the fit still
converges."""

ROBOT, REPROJECTION = "robot", "reprojection"

METHODS = (ROBOT, REPROJECTION, *OPENCV_METHODS)
"""Methods that may be chosen instead of ``auto``; the last are OpenCV's closed forms."""

MAX_FOLDS = 20
"""A closed form is solved again without each of at most this many groups of poses."""

NOTHING = "nothing"
"""Name of the choice to adjust only the poses."""

ADJUSTABLE = (NOTHING, "scale", "camera", "scale and camera")
"""Values that may be adjusted in addition to the poses: the target's scale, the camera's lens."""


@dataclass(frozen=True, slots=True)
class Problem:
    """The input of a calibration: the robot's poses, and the camera's observations at each."""

    robot: RobotPoses  # V poses
    observations: AnyObservations  # V views, or poses of the target without views
    target_poses: Rigid  # V times ``T_camera_target``, each from its own view
    # (V, N), False for the padding after the points of a view; None without views
    point_mask: NDArray[np.bool_] | None = None
    robot_sigmas: RobotSigmas | None = None  # noise of the robot's poses; None: to be estimated
    # (4 + K, 4 + K), covariance of a lens from the same views; None for an exact one
    lens_covariance: Array | None = None

    @property
    def count(self) -> int:
        """Number V of poses."""
        return self.target_poses.size

    @property
    def mask(self) -> NDArray[np.bool_]:
        """(V, N), True for points, False for padding; (V, 1) without views."""
        return np.ones((self.count, 1), dtype=bool) if self.point_mask is None else self.point_mask

    def subset(self, index: NDArray[np.intp]) -> Problem:
        """Return some of the poses."""
        point_mask = None if self.point_mask is None else self.point_mask[index]
        return Problem(
            self.robot.subset(index),
            self.observations.subset(index),
            self.target_poses.subset(index),
            point_mask,
            self.robot_sigmas,
            self.lens_covariance,
        )

    def errors(self, solution: Solution) -> list[Array]:
        """Return a solution's errors on the target, for each view (N,), metres.

        The error of a point in a view is the distance, in the target's plane, between its ray and
        the point. Without views it is the distance of the target's origin.
        """
        errors = np.linalg.norm(self.error_vectors(solution), axis=2)
        return [view_errors[mask] for view_errors, mask in zip(errors, self.mask, strict=True)]

    def error_vectors(self, solution: Solution) -> Array:
        """Return the errors as vectors, (V, N, 3), metres; 0 for padding.

        ``solution``: one solution for all views, or stacked solutions, one for each view.
        """
        expected = predicted_views(solution.camera, self.robot, solution.target)
        change = solution.change
        has_one_each = change.ndim > 1
        scales = [
            self.observations.scale(step) for step in (change if has_one_each else change[None])
        ]
        if self.point_mask is None or not isinstance(self.observations, PixelObservations):
            offsets = (
                expected.translation - np.reshape(scales, (-1, 1)) * self.target_poses.translation
            )
            return np.asarray(offsets[:, None], dtype=np.float64)
        points = np.reshape(scales, (-1, 1, 1)) * self.observations.points
        if has_one_each and any(self.observations.free_parameters):
            changes_and_pixels = zip(change, self.observations.pixels, strict=True)
            rays = np.stack(
                [
                    self.observations.camera(step).directions(pixels)
                    for step, pixels in changes_and_pixels
                ]
            )
        else:
            camera = self.observations.camera(change[0] if has_one_each else change)
            rays = camera.directions(self.observations.pixels.reshape(-1, 2)).reshape(
                self.observations.pixels.shape
            )
        rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2)
        residuals: Array = intersect_plane(rays, *expected) - points
        residuals[~self.point_mask] = 0.0
        return residuals


def errors_in_plane(camera: CameraModel, target_pose: Rigid, pixels: Array, points: Array) -> Array:
    """Return the distances (N,), metres, in a target's plane between rays and its points.

    They are infinite for a ray that does not meet the plane in front of the camera.
    ``target_pose``: ``T_camera_target``. ``pixels`` (N, 2) define the rays; ``points`` (N, 3),
    metres, are on the target.
    """
    rays = np.column_stack([camera.directions(pixels), np.ones(len(pixels))])
    errors: Array = np.linalg.norm(intersect_plane(rays, *target_pose) - points, axis=1)
    return errors


def intersect_plane(rays: Array, turn: Array, shift: Array) -> Array:
    """Return the points at which rays (..., N, 3) from the origin meet a plane, in its frame.

    The result is (..., N, 3), infinite if a ray does not meet the plane. ``turn`` (..., 3, 3) is
    the rotation of the plane's frame, whose third column is the normal, ``shift`` (..., 3) its
    origin.
    """
    # s r is in the plane where n (s r - o) = 0: s = n o / n r; then R^T (s r - o) is in its frame.
    normal = turn[..., 2]
    components = (rays @ normal[..., None])[..., 0]
    with np.errstate(all="ignore"):
        factors = (shift * normal).sum(axis=-1)[..., None] / components
        points: Array = (rays * factors[..., None] - shift[..., None, :]) @ turn
    points[~(np.isfinite(factors) & (factors > 0))] = np.inf
    return points


@dataclass(slots=True)
class Candidate:
    """A method with its solution, and the errors of its predictions."""

    method: str
    adjusted_values: str  # values that are adjusted, one of :data:`ADJUSTABLE`
    problem: Problem  # problem with these parameters free
    solution: Solution  # solution from all poses
    # solutions without each pose, stacked (V, ...); None with too few poses
    left_out_solutions: Solution | None = None
    # (V, N, 3), held-out errors on the target, metres
    held_out_vectors: Array = field(default_factory=lambda: np.zeros((0, 0, 3)))
    # solutions of other candidates that are as likely
    rivals: list[Solution] = field(default_factory=list[Solution])

    @property
    def name(self) -> str:
        """Method, and the values that are adjusted besides the poses."""
        return (
            self.method
            if self.adjusted_values == NOTHING
            else f"{self.method}, {self.adjusted_values}"
        )

    @property
    def held_out_errors(self) -> Array:
        """RMS held-out error of each pose, (V,), metres; infinite for a pose without one."""
        if self.left_out_solutions is None:
            return np.full(self.problem.count, np.inf)
        squares = (self.held_out_vectors**2).sum(axis=(1, 2)) / self.problem.mask.sum(axis=1)
        errors: Array = np.sqrt(np.where(np.isfinite(squares), squares, np.inf))
        return errors

    @property
    def held_out(self) -> float:
        """RMS held-out error of all points, metres; infinite if a pose has no held-out error."""
        points = self.problem.mask.sum(axis=1)
        return math.sqrt(float((points * self.held_out_errors**2).sum() / points.sum()))

    def chance_of_change(self, always_free_count: int) -> float:
        """Return the probability that noise alone changes the additional parameters by as much.

        ``always_free_count``: this many of the last parameters are adjusted in any case, and not
            tested.
        """
        change, information = self.solution.change, self.solution.information
        count = len(change) - always_free_count
        if information is None or count <= 0:
            return 1.0
        # Wald's test: if all errors are noise, x^T C^-1 x of the K parameters x is chi-square
        # with K degrees of freedom; C^-1 is Schur's complement of the part of X and Z in the
        # information. If noise was estimated from few equations, the value over K follows an F
        # distribution. Source: Wald, Tests of Statistical Hypotheses Concerning Several Parameters
        # When the Number of Observations is Large (1943).
        coupling_to_poses = information[:12, 12:]
        reduced = information[12:, 12:] - coupling_to_poses.T @ solve_scaled(
            information[:12, :12], coupling_to_poses
        )
        if always_free_count:
            coupling = reduced[:count, count:]
            reduced = reduced[:count, :count] - coupling @ solve_scaled(
                reduced[count:, count:], coupling.T
            )
        squares = float(change[:count] @ reduced @ change[:count])
        if not math.isfinite(squares):
            return 1.0
        # half of the equations determine the robot's sigma of rotation, half that of translation
        freedom = None if self.problem.robot_sigmas else max(1, 3 * self.problem.count - 6)
        return Noise(1.0, freedom).chance(max(squares, 0.0), count)


def fit_candidates(
    problem: Problem, parameter_choices: Mapping[str, tuple[int, ...]], method: str = "auto"
) -> tuple[Candidate | None, list[Candidate]]:
    """Return the best candidate, or None if nothing fits, and all candidates.

    ``parameter_choices``: the entries of :data:`ADJUSTABLE` to try, each with the indices of its
    parameters. ``method``: ``auto``, or one of :data:`METHODS`.
    """
    start = _closed_form(problem, method) if method in OPENCV_METHODS else _best_start(problem)
    if start is None:
        return None, []
    if method in OPENCV_METHODS:
        candidate = _closed_form_candidate(problem, method, start)
        return candidate, [candidate]
    if method == REPROJECTION and len(parameter_choices) == 1:
        ((adjusted_values, parameter_indices),) = parameter_choices.items()
        reprojection = _reprojection_candidate(
            adjusted_values, _with_free_parameters(problem, parameter_indices), start
        )
        return reprojection, [reprojection] if reprojection else []
    robot_candidates = _robot_candidates(problem, parameter_choices, start)
    robot_candidate = _choose_values(robot_candidates)
    if robot_candidate is None or method == ROBOT:
        return robot_candidate, robot_candidates
    reprojection = _reprojection_like(robot_candidate)
    if method == REPROJECTION or reprojection is None:
        return (reprojection if method == REPROJECTION else robot_candidate), [
            *robot_candidates,
            *([reprojection] if reprojection else []),
        ]
    return _choose_method(robot_candidate, reprojection), [*robot_candidates, reprojection]


def _reprojection_candidate(
    adjusted_values: str, problem: Problem, start_solution: Solution
) -> Candidate | None:
    """Return the candidate that takes the robot's poses as exact."""
    start = dataclasses.replace(start_solution, noise=None)
    return _make_candidate(
        REPROJECTION, adjusted_values, problem, adjust(problem.robot, problem.observations, start)
    )


def _reprojection_like(robot: Candidate) -> Candidate | None:
    """Return the candidate ``reprojection`` with the scale and the lens of a candidate ``robot``.

    The scale is not adjusted anew, since pixels alone hardly determine the target's distance.
    """
    change, problem = robot.solution.change, robot.problem
    fixed_problem = dataclasses.replace(
        problem, observations=problem.observations.with_change(change)
    )
    start = dataclasses.replace(robot.solution, change=np.zeros(0))
    reprojection = _reprojection_candidate(robot.adjusted_values, fixed_problem, start)
    if reprojection is None or not len(change):
        return reprojection
    slopes = derivatives_by_parameters(
        fixed_problem.robot,
        fixed_problem.observations,
        reprojection.solution,
        problem.observations.free_parameters,
    )
    reprojection.problem, reprojection.solution = (
        problem,
        dataclasses.replace(reprojection.solution, change=change),
    )
    if reprojection.left_out_solutions is not None and robot.left_out_solutions is not None:
        # leaving out a view also changes scale and lens, which move camera and target
        steps = (robot.left_out_solutions.change - change) @ slopes.T
        reprojection.left_out_solutions = dataclasses.replace(
            reprojection.left_out_solutions,
            camera=reprojection.left_out_solutions.camera.turned_in_source(steps[:, :6]),
            target=reprojection.left_out_solutions.target.turned_in_source(steps[:, 6:]),
            change=robot.left_out_solutions.change,
        )
        reprojection.held_out_vectors = problem.error_vectors(reprojection.left_out_solutions)
    return reprojection


def _robot_candidates(
    problem: Problem, parameter_choices: Mapping[str, tuple[int, ...]], start_solution: Solution
) -> list[Candidate]:
    """Return candidates that correct the robot's poses, one for each choice of parameters."""
    candidates: list[Candidate] = []
    is_scale_free = any(0 in indices for indices in parameter_choices.values())
    rescaled_start = _start_for_rescaled_target(problem) if is_scale_free else None
    for adjusted_values, parameter_indices in parameter_choices.items():
        freed_problem = _with_free_parameters(problem, parameter_indices)
        start = (
            candidates[0].solution
            if candidates and candidates[0].adjusted_values == NOTHING
            else start_solution
        )
        if rescaled_start is not None and 0 in parameter_indices:
            changes = np.concatenate([rescaled_start.change, np.zeros(len(parameter_indices) - 1)])
            start = dataclasses.replace(rescaled_start, change=changes)
        if problem.robot_sigmas is None:
            solution = adjust_with_noise(freed_problem.robot, freed_problem.observations, start)
        else:
            solution = adjust(
                freed_problem.robot,
                freed_problem.observations,
                start,
                RobotNoise(problem.robot_sigmas),
            )
        if (
            candidate := _make_candidate(ROBOT, adjusted_values, freed_problem, solution)
        ) is not None:
            candidates.append(candidate)
    return candidates


def _choose_values(candidates: Sequence[Candidate]) -> Candidate | None:
    """Return the candidate that adjusts as many values as the poses justify.

    If adjusted values are significant but hardly predict better, the choice stays open, and the
    other solution becomes a rival. Random halves of the poses of a recorded robot that hardly
    turned its camera choose differently: their results differ by 17 mm, while each choice alone
    predicts a difference of 6 mm.
    """
    if not candidates:
        return None
    simplest, *others = candidates
    always_free_count, by_error = len(simplest.solution.change), operator.attrgetter("held_out")
    significant = [
        candidate
        for candidate in others
        if candidate.chance_of_change(always_free_count) < SIGNIFICANCE_LEVEL
    ]
    best, *runners_up = sorted([simplest, *significant], key=by_error)
    if runners_up and (best is simplest or _gain_in_sigmas(best, simplest) < SURE_GAIN):
        best.rivals = [runners_up[0].solution if best is simplest else simplest.solution]
    return best


def _choose_method(robot: Candidate, reprojection: Candidate) -> Candidate:
    """Return ``reprojection`` if it predicts poses better by more than chance, else ``robot``.

    For robots whose only error is noise, ``reprojection`` may look better by chance, but its
    cameras are up to five times as far off; it is chosen for two of 140 such robots. So, unless the
    gain is sure, ``robot`` becomes a rival, whose difference is included in the covariance.
    """
    gain = _gain_in_sigmas(reprojection, robot)
    if gain <= 1.0:
        return robot
    reprojection.rivals = [*robot.rivals, *([robot.solution] if gain < SURE_GAIN else [])]
    return reprojection


def _gain_in_sigmas(candidate: Candidate, other: Candidate) -> float:
    """Return by how many standard errors a candidate predicts poses better than another one.

    Poses are independent of each other, unlike their points.
    """
    errors, other_errors = candidate.held_out_errors, other.held_out_errors
    if not (np.isfinite(other_errors).all() and np.isfinite(errors).all()):
        return math.inf if candidate.held_out < other.held_out else -math.inf
    gain = candidate.problem.mask.sum(axis=1) * (other_errors**2 - errors**2)
    return float(gain.sum()) / max(math.sqrt(float((gain**2).sum())), 1e-300)


def _with_free_parameters(problem: Problem, indices: tuple[int, ...]) -> Problem:
    if not indices:
        return problem
    return dataclasses.replace(
        problem, observations=dataclasses.replace(problem.observations, free_parameters=indices)
    )


def _closed_form(problem: Problem, name: str, *, use_all_views: bool = True) -> Solution | None:
    solution = solve_closed_form(
        name, problem.robot, problem.target_poses, use_all_views=use_all_views
    )
    return (
        None
        if solution is None
        else Solution(*solution, np.zeros(problem.observations.extra_count))
    )


def _best_start(problem: Problem) -> Solution | None:
    """Return the solution of the closed form that fits best; None if none fits."""
    ranked = []
    for number, name in enumerate(OPENCV_METHODS):
        solution = _closed_form(problem, name, use_all_views=False)
        if solution is not None:
            errors = np.concatenate(problem.errors(solution))
            ranked.append((float(np.median(errors)), number, solution))
    ranked = [entry for entry in ranked if math.isfinite(entry[0])]
    return min(ranked)[2] if ranked else None


def _start_for_rescaled_target(problem: Problem) -> Solution | None:
    """Return the best closed form for a target of the size that the robot's motions show.

    None if that size is near the nominal one, or not known.
    """
    scale = estimate_scale(problem.robot, problem.target_poses)
    if scale is None or scale <= 0.0 or abs(scale - 1.0) < MAX_SIZE_ERROR_RATIO:
        return None
    change = np.array([scale - 1.0])
    scaled_observations = _with_free_parameters(problem, (0,)).observations.with_change(change)
    poses = problem.target_poses.scaled(scale)
    start = _best_start(
        dataclasses.replace(problem, observations=scaled_observations, target_poses=poses)
    )
    return None if start is None else dataclasses.replace(start, change=change)


def _make_candidate(
    method: str, adjusted_values: str, problem: Problem, solution: Solution
) -> Candidate | None:
    """Return a candidate with its held-out errors; None if it does not fit."""
    if not math.isfinite(solution.cost):
        return None
    candidate = Candidate(method, adjusted_values, problem, solution)
    if problem.count > MIN_POSES:
        candidate.left_out_solutions = leave_each_out(problem.robot, problem.observations, solution)
        try:
            candidate.held_out_vectors = problem.error_vectors(candidate.left_out_solutions)
        except CalibrationError:  # the views that remain determine no lens
            return None
    return candidate


def _closed_form_candidate(problem: Problem, name: str, solution: Solution) -> Candidate:
    """Return the candidate of a closed form, with its held-out errors if there are enough poses."""
    candidate, count = Candidate(name, NOTHING, problem, solution), problem.count
    if count <= MIN_POSES:
        return candidate
    numbers = np.arange(count)
    fold_of_pose, solutions = numbers % MAX_FOLDS, [solution] * count
    for fold in range(min(count, MAX_FOLDS)):
        left_out_solution = _closed_form(problem.subset(numbers[fold_of_pose != fold]), name)
        if left_out_solution is None:
            return candidate
        solutions = [
            left_out_solution if fold_of_pose[i] == fold else previous
            for i, previous in enumerate(solutions)
        ]
    candidate.left_out_solutions = Solution(
        Rigid.stack(solution.camera for solution in solutions),
        Rigid.stack(solution.target for solution in solutions),
    )
    candidate.held_out_vectors = problem.error_vectors(candidate.left_out_solutions)
    return candidate
