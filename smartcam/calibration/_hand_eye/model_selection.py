"""Choose the hand-eye method that predicts unseen poses best.

There are two methods. ``robot`` corrects each pose of the robot as far as noise allows. It is best
where the robot's only error is noise. ``reprojection`` takes the robot's poses as they are and
minimizes the error on the target. It is best where a robot has other errors (joints with offsets,
gears with play, a sheet of another size), which corrections of single poses do not describe.

The poses decide between the two: each method is solved again without one pose, and predicts from
the robot's given pose where the camera would see the target. The distance from where the target was
seen is the held-out error, in metres on the target, as it matters for picking. ``reprojection`` is
taken where its errors are smaller by more than chance. Blends of the two predict no better: 0.2 %
worse over 26 kinds of simulated robots, up to 9 % worse on recorded ones (measured).

The camera's parameters and the target's scale are adjusted as well where two things hold: the
held-out error is smaller with them, and noise alone would hardly ever change them by as much. An
unneeded scale costs much: the camera's place is known two to five times worse.
"""

from __future__ import annotations

import dataclasses
import math
import operator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from smartcam.calibration._hand_eye.closed_forms import LINEAR, MIN_POSES, scale_of, solve_linear
from smartcam.calibration._hand_eye.equations import (
    PixelObservations,
    PoseObservations,
    RobotNoise,
    Solution,
    adjust,
    predicted_views,
    pull,
    without_each,
)
from smartcam.calibration._hand_eye.robot_noise import adjust_noisy
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

    Seen = PixelObservations | PoseObservations

SIGNIFICANCE_LEVEL = 1e-4
"""Further parameters are adjusted only if noise alone would change them by as much with less than
this probability: a scale that is not needed puts the camera up to eight times as far off."""

SURE_GAIN = 2.0
"""A choice is open until poses are predicted better by this many standard errors: simulated robots
that err by noise alone reach 1.9 by chance."""

MAX_SIZE_ERROR_RATIO = 0.05
"""Largest error of a target's stated size, as a part of it, from which the fit still converges."""

ROBOT, REPROJECTION = "robot", "reprojection"

METHODS = (ROBOT, REPROJECTION, *LINEAR)
"""Methods that may be chosen instead of ``auto``; the last are OpenCV's closed forms."""

MAX_FOLDS = 20
"""A closed form is solved again without each of at most this many groups of poses."""

NOTHING = "nothing"
"""Word for a candidate in which only the poses are adjusted."""

ADJUSTABLE = (NOTHING, "scale", "camera", "scale and camera")
"""Choices of values to adjust besides the poses: the target's scale, the camera's parameters."""


@dataclass(frozen=True, slots=True)
class Problem:
    """Poses of a robot, with the camera's observations at each."""

    robot: RobotPoses  # V poses
    seen: Seen  # V views, or poses of the target without views
    poses: Rigid  # V times ``T_camera_target``, each from its own view
    # (V, N), True for points that exist; None without views
    given: NDArray[np.bool_] | None = None
    sigmas: RobotSigmas | None = None  # noise of the robot's poses, if it is known
    # (4 + K, 4 + K), covariance of a lens from the same views; None for an exact one
    lens: Array | None = None

    @property
    def count(self) -> int:
        """Number V of poses."""
        return self.poses.size

    @property
    def mask(self) -> NDArray[np.bool_]:
        """True for points with an error, (V, N); without views, for the target's origin."""
        return np.ones((self.count, 1), dtype=bool) if self.given is None else self.given

    def subset(self, index: NDArray[np.intp]) -> Problem:
        """Return some of the poses."""
        given = None if self.given is None else self.given[index]
        return Problem(
            self.robot.subset(index),
            self.seen.subset(index),
            self.poses.subset(index),
            given,
            self.sigmas,
            self.lens,
        )

    def errors(self, solution: Solution) -> list[Array]:
        """Return a solution's errors on the target, for each view (N,), metres.

        The error of a point in a view is the distance, in the target's plane, between its ray and
        the point. Without views it is the distance of the target's origin.
        """
        errors = np.linalg.norm(self.off(solution), axis=2)
        return [view_errors[mask] for view_errors, mask in zip(errors, self.mask, strict=True)]

    def off(self, solution: Solution) -> Array:
        """Return the errors as vectors, (V, N, 3), metres; 0 for points that do not exist.

        ``solution`` is one, or one for each view.
        """
        expected = predicted_views(solution.camera, self.robot, solution.target)
        change = solution.change
        each = change.ndim > 1
        scales = [self.seen.scale(step) for step in (change if each else change[None])]
        if self.given is None or not isinstance(self.seen, PixelObservations):
            away = expected.translation - np.reshape(scales, (-1, 1)) * self.poses.translation
            return np.asarray(away[:, None], dtype=np.float64)
        points = np.reshape(scales, (-1, 1, 1)) * self.seen.points
        if each and any(self.seen.free):
            one_each = zip(change, self.seen.pixels, strict=True)
            rays = np.stack([self.seen.camera(step).directions(seen) for step, seen in one_each])
        else:
            camera = self.seen.camera(change[0] if each else change)
            rays = camera.directions(self.seen.pixels.reshape(-1, 2)).reshape(
                self.seen.pixels.shape
            )
        rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2)
        residuals: Array = on_plane(rays, *expected) - points
        residuals[~self.given] = 0.0
        return residuals


def point_errors(camera: CameraModel, seen: Rigid, pixels: Array, points: Array) -> Array:
    """Return the distances (N,), metres, in a target's plane between rays and its points.

    They are infinite for a ray that does not meet the plane in front of the camera. ``seen``:
    ``T_camera_target``. ``pixels`` (N, 2) define the rays, ``points`` (N, 3) are on the target,
    metres.
    """
    rays = np.column_stack([camera.directions(pixels), np.ones(len(pixels))])
    errors: Array = np.linalg.norm(on_plane(rays, *seen) - points, axis=1)
    return errors


def on_plane(rays: Array, turn: Array, shift: Array) -> Array:
    """Return the points at which rays (..., N, 3) from the origin meet a plane, in its frame.

    The result is (..., N, 3), infinite if a ray does not meet the plane. ``turn`` (..., 3, 3) is
    the rotation of the plane's frame, whose third column is the normal, ``shift`` (..., 3) its
    origin.
    """
    # s r is in the plane where n (s r - o) = 0: s = n o / n r; then R^T (s r - o) is in its frame.
    normal = turn[..., 2]
    along = (rays @ normal[..., None])[..., 0]
    with np.errstate(all="ignore"):
        reach = (shift * normal).sum(axis=-1)[..., None] / along
        points: Array = (rays * reach[..., None] - shift[..., None, :]) @ turn
    points[~(np.isfinite(reach) & (reach > 0))] = np.inf
    return points


@dataclass(slots=True)
class Candidate:
    """One method with its solution, and how well it predicts."""

    method: str
    besides: str  # values that are adjusted, one of :data:`ADJUSTABLE`
    problem: Problem  # problem with these values free
    solution: Solution  # solution from all poses
    # solutions without each pose, stacked (V, ...); None with too few poses
    others: Solution | None = None
    # (V, N, 3), held-out errors on the target, metres
    off: Array = field(default_factory=lambda: np.zeros((0, 0, 3)))
    # solutions that may be the right ones as well
    rivals: list[Solution] = field(default_factory=list[Solution])

    @property
    def name(self) -> str:
        """Method, and the values that are adjusted besides the poses."""
        return self.method if self.besides == NOTHING else f"{self.method}, {self.besides}"

    @property
    def errors(self) -> Array:
        """RMS held-out error of each pose, (V,), metres; infinite if it has none."""
        if self.others is None:
            return np.full(self.problem.count, np.inf)
        squares = (self.off**2).sum(axis=(1, 2)) / self.problem.mask.sum(axis=1)
        errors: Array = np.sqrt(np.where(np.isfinite(squares), squares, np.inf))
        return errors

    @property
    def held_out(self) -> float:
        """RMS held-out error of all points, metres; infinite if a pose has none."""
        points = self.problem.mask.sum(axis=1)
        return math.sqrt(float((points * self.errors**2).sum() / points.sum()))

    def chance(self, beside: int) -> float:
        """Return the probability that noise alone changes the additional parameters by as much.

        ``beside``: how many of them, the last ones, are adjusted in any case.
        """
        change, information = self.solution.change, self.solution.information
        count = len(change) - beside
        if information is None or count <= 0:
            return 1.0
        # Wald's test: without an error beside noise, x^T C^-1 x of the K parameters x is chi-square
        # with K degrees of freedom; C^-1 is Schur's complement of the part of X and Z in the
        # information. If noise was estimated from few equations, it follows an F distribution (over
        # K). Source: Wald, Tests of Statistical Hypotheses Concerning Several Parameters When the
        # Number of Observations is Large (1943).
        mixed = information[:12, 12:]
        reduced = information[12:, 12:] - mixed.T @ solve_scaled(information[:12, :12], mixed)
        if beside:
            across = reduced[:count, count:]
            reduced = reduced[:count, :count] - across @ solve_scaled(
                reduced[count:, count:], across.T
            )
        squares = float(change[:count] @ reduced @ change[:count])
        if not math.isfinite(squares):
            return 1.0
        # half of the equations each determine one of the robot's two sigmas
        freedom = None if self.problem.sigmas else max(1, 3 * self.problem.count - 6)
        return Noise(1.0, freedom).chance(max(squares, 0.0), count)


def candidates(
    problem: Problem, free: Mapping[str, tuple[int, ...]], method: str = "auto"
) -> tuple[Candidate | None, list[Candidate]]:
    """Return the best candidate, or None if nothing fits, and all candidates.

    ``free``: numbers of the parameters of each of :data:`ADJUSTABLE` that may be adjusted.
    ``method``: ``auto``, or one of :data:`METHODS`.
    """
    begin = _closed(problem, method) if method in LINEAR else _begin(problem)
    if begin is None:
        return None, []
    if method in LINEAR:
        only = _by_closed_form(problem, method, begin)
        return only, [only]
    if method == REPROJECTION and len(free) == 1:
        ((besides, numbers),) = free.items()
        plain = _reprojection(besides, _freed(problem, numbers), begin)
        return plain, [plain] if plain else []
    judges = _robots(problem, free, begin)
    judge = _best_candidate(judges)
    if judge is None or method == ROBOT:
        return judge, judges
    plain = _reprojection_beside(judge)
    if method == REPROJECTION or plain is None:
        return (plain if method == REPROJECTION else judge), [*judges, *([plain] if plain else [])]
    return _likelier(judge, plain), [*judges, plain]


def _reprojection(besides: str, problem: Problem, begin: Solution) -> Candidate | None:
    """Return the candidate that takes the robot's poses as exact."""
    start = dataclasses.replace(begin, noise=None)
    return _candidate(REPROJECTION, besides, problem, adjust(problem.robot, problem.seen, start))


def _reprojection_beside(robot: Candidate) -> Candidate | None:
    """Return the candidate ``reprojection`` with the scale and the lens from another candidate.

    The size of a target determines its distance, which pixels alone hardly do.
    """
    change, freed = robot.solution.change, robot.problem
    known = dataclasses.replace(freed, seen=freed.seen.settled(change))
    start = dataclasses.replace(robot.solution, change=np.zeros(0))
    reprojection = _reprojection(robot.besides, known, start)
    if reprojection is None or not len(change):
        return reprojection
    slopes = pull(known.robot, known.seen, reprojection.solution, freed.seen.free)
    reprojection.problem, reprojection.solution = (
        freed,
        dataclasses.replace(reprojection.solution, change=change),
    )
    if reprojection.others is not None and robot.others is not None:
        # without a view these values differ, too, and pull camera and target with them
        steps = (robot.others.change - change) @ slopes.T
        reprojection.others = dataclasses.replace(
            reprojection.others,
            camera=reprojection.others.camera.turned_before(steps[:, :6]),
            target=reprojection.others.target.turned_before(steps[:, 6:]),
            change=robot.others.change,
        )
        reprojection.off = freed.off(reprojection.others)
    return reprojection


def _robots(
    problem: Problem, free: Mapping[str, tuple[int, ...]], begin: Solution
) -> list[Candidate]:
    """Return candidates that correct the robot's poses, one for each choice of free values."""
    tried: list[Candidate] = []
    any_size = any(0 in numbers for numbers in free.values())
    elsewhere = _begin_of_another_size(problem) if any_size else None
    for besides, numbers in free.items():
        freed = _freed(problem, numbers)
        start = tried[0].solution if tried and tried[0].besides == NOTHING else begin
        if elsewhere is not None and 0 in numbers:
            change = np.concatenate([elsewhere.change, np.zeros(len(numbers) - 1)])
            start = dataclasses.replace(elsewhere, change=change)
        if problem.sigmas is None:
            solution = adjust_noisy(freed.robot, freed.seen, start)
        else:
            solution = adjust(freed.robot, freed.seen, start, RobotNoise(problem.sigmas))
        if (candidate := _candidate(ROBOT, besides, freed, solution)) is not None:
            tried.append(candidate)
    return tried


def _best_candidate(judges: Sequence[Candidate]) -> Candidate | None:
    """Return the candidate with the right choice of adjusted values.

    Values that cannot be right by chance, but predict no better, or hardly, leave the choice open:
    random halves of a recorded robot that hardly turned its camera choose differently, and lie 17
    mm apart where 6 mm are expected of each choice alone.
    """
    if not judges:
        return None
    plain, *others = judges
    beside, by_error = len(plain.solution.change), operator.attrgetter("held_out")
    significant = [judge for judge in others if judge.chance(beside) < SIGNIFICANCE_LEVEL]
    best, *rest = sorted([plain, *significant], key=by_error)
    if rest and (best is plain or _gain(best, plain) < SURE_GAIN):
        best.rivals = [rest[0].solution if best is plain else plain.solution]
    return best


def _likelier(robot: Candidate, plain: Candidate) -> Candidate:
    """Return ``plain`` if it predicts poses better by more than chance, else ``robot``.

    With robots that have no error but noise, ``plain`` looks better by chance, and it puts their
    cameras up to five times as far off. By chance it is taken for two of 140 such robots, so
    the difference of both is an error to expect until the gain is sure.
    """
    gain = _gain(plain, robot)
    if gain <= 1.0:
        return robot
    plain.rivals = [*robot.rivals, *([robot.solution] if gain < SURE_GAIN else [])]
    return plain


def _gain(one: Candidate, other: Candidate) -> float:
    """Return by how many standard errors a candidate predicts poses better than another one.

    Poses are independent of each other, unlike their points.
    """
    after, before = one.errors, other.errors
    if not (np.isfinite(before).all() and np.isfinite(after).all()):
        return math.inf if one.held_out < other.held_out else -math.inf
    gain = one.problem.mask.sum(axis=1) * (before**2 - after**2)
    return float(gain.sum()) / max(math.sqrt(float((gain**2).sum())), 1e-300)


def _freed(problem: Problem, numbers: tuple[int, ...]) -> Problem:
    if not numbers:
        return problem
    return dataclasses.replace(problem, seen=dataclasses.replace(problem.seen, free=numbers))


def _closed(problem: Problem, name: str, *, exactly: bool = True) -> Solution | None:
    solution = solve_linear(name, problem.robot, problem.poses, exactly=exactly)
    return None if solution is None else Solution(*solution, np.zeros(problem.seen.extra_count))


def _begin(problem: Problem) -> Solution | None:
    """Return the closed form that fits best."""
    ranked = []
    for number, name in enumerate(LINEAR):
        solution = _closed(problem, name, exactly=False)
        if solution is not None:
            errors = np.concatenate(problem.errors(solution))
            ranked.append((float(np.median(errors)), number, solution))
    ranked = [entry for entry in ranked if math.isfinite(entry[0])]
    return min(ranked)[2] if ranked else None


def _begin_of_another_size(problem: Problem) -> Solution | None:
    """Return the closed form for a target of the size that the robot's motions show.

    None if that is near the nominal size, or not known.
    """
    scale = scale_of(problem.robot, problem.poses)
    if scale is None or scale <= 0.0 or abs(scale - 1.0) < MAX_SIZE_ERROR_RATIO:
        return None
    change = np.array([scale - 1.0])
    settled = _freed(problem, (0,)).seen.settled(change)
    poses = problem.poses.scaled(scale)
    begin = _begin(dataclasses.replace(problem, seen=settled, poses=poses))
    return None if begin is None else dataclasses.replace(begin, change=change)


def _candidate(method: str, besides: str, problem: Problem, solution: Solution) -> Candidate | None:
    """Return a candidate with its held-out errors; None if it does not fit."""
    if not math.isfinite(solution.cost):
        return None
    candidate = Candidate(method, besides, problem, solution)
    if problem.count > MIN_POSES:
        candidate.others = without_each(problem.robot, problem.seen, solution)
        try:
            candidate.off = problem.off(candidate.others)
        except CalibrationError:  # without one of the views no lens is left
            return None
    return candidate


def _by_closed_form(problem: Problem, name: str, solution: Solution) -> Candidate:
    """Return a closed form with its held-out errors."""
    candidate, count = Candidate(name, NOTHING, problem, solution), problem.count
    if count <= MIN_POSES:
        return candidate
    numbers = np.arange(count)
    part, others = numbers % MAX_FOLDS, [solution] * count
    for fold in range(min(count, MAX_FOLDS)):
        other = _closed(problem.subset(numbers[part != fold]), name)
        if other is None:
            return candidate
        others = [other if part[i] == fold else before for i, before in enumerate(others)]
    candidate.others = Solution(
        Rigid.stacked(left.camera for left in others), Rigid.stacked(left.target for left in others)
    )
    candidate.off = problem.off(candidate.others)
    return candidate
