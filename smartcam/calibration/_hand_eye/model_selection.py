"""Which way of solving a camera and a robot predicts poses best that it has not seen.

Each candidate is solved again without one pose (of many poses, without a part of them), and says
from the robot's pose as it was given where the camera would see the target. What lies between that
and what it saw is the held-out error: the error of picking, on the target, in metres.

The camera's parameters and the target's scale are adjusted besides where two things hold: the
held-out error is smaller with them, and noise alone would hardly ever make them differ as much from
what was given. An unneeded scale costs much: the camera's place is known two to five times worse.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from smartcam.calibration._hand_eye.closed_forms import LEAST_POSES, LINEAR, solve_linear
from smartcam.calibration._hand_eye.equations import (
    ROUGH_GAIN,
    PixelObservations,
    PoseObservations,
    RobotNoise,
    Solution,
    adjust,
    carried,
)
from smartcam.calibration._hand_eye.robot_noise import adjust_noisy
from smartcam.calibration._least_squares import solve_scaled
from smartcam.calibration._statistics import Noise

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from smartcam.calibration._geometry.rigid import Rigid
    from smartcam.calibration._geometry.rotations import Array
    from smartcam.calibration._hand_eye.equations import RobotPoses, RobotSigmas
    from smartcam.calibration._lens.model import CameraModel

    Seen = PixelObservations | PoseObservations

MOST_FOLDS = 40
"""Parts that poses are left out in: up to as many, each pose alone."""

LEVEL = 1e-4
"""How seldom noise alone may make more parameters differ from what was given: a scale that is not
needed puts the camera up to eight times as far off."""

MOST_SCALE = 0.2
"""Part of its size that a target may be off; what is more is a mistake of units."""

JUDGE = "robot and lens"
"""The method that tells what is to be adjusted besides: it can explain most."""

METHODS: Mapping[str, float] = {
    "robot": 1.0,
    "robot and lens": 1.0 / 1.05,
    "reprojection": 1.0 / 1.20,
    **dict.fromkeys(LINEAR, 1.0 / 1.20),
}
"""Part of the first one's held-out error that each must stay below to be taken instead.

``robot`` corrects each pose of the robot as its noise allows, and is the best there is where noise
is all there is; ``robot and lens`` lets the points of a view share errors; ``reprojection`` takes
the robot's poses for exact; the others are OpenCV's closed forms. The noise of the pose that is
left out is in every candidate's error and hides the differences: 15 poses of a robot with 0.02
degrees and 0.1 mm gave ``reprojection`` a held-out error 6 % smaller with a camera seven times
farther off (measured in simulation).
"""

MANY = 12
"""Poses more than have to be, from which on the parts above hold; fewer have to show more: 1.2 of
five poses is 3."""

NOTHING = "nothing"
"""Is adjusted besides the poses."""

ADJUSTABLE = (NOTHING, "scale", "camera", "scale and camera")
"""What may be adjusted besides the poses: the target's scale, the camera's parameters."""


@dataclass(frozen=True, slots=True)
class Problem:
    """Poses of a robot and what the camera saw at each."""

    robot: RobotPoses  # V poses
    seen: Seen  # V views, or poses of the target without views
    poses: Rigid  # V times ``T_camera_target``, each from its own view
    # (V, N), which of the points there are; None without views
    given: NDArray[np.bool_] | None = None
    sigmas: RobotSigmas | None = None  # of the robot, where they are known

    @property
    def count(self) -> int:
        """V."""
        return self.poses.size

    def taken(self, index: NDArray[np.intp]) -> Problem:
        """Return some of the poses."""
        given = None if self.given is None else self.given[index]
        return Problem(
            self.robot.taken(index),
            self.seen.taken(index),
            self.poses.taken(index),
            given,
            self.sigmas,
        )

    def errors(self, solution: Solution) -> list[Array]:
        """Return by how much a solution is off on the target, for each view (N,), metres.

        Of a view: where the rays of its points pass the target's plane, from where the points are.
        Without views: where the target's origin is.
        """
        scale = self.seen.scale(solution.change)
        expected = carried(solution.camera, self.robot, solution.target)
        if self.given is None or not isinstance(self.seen, PixelObservations):
            off = expected.translation - scale * self.poses.translation
            return [np.sqrt((one**2).sum(keepdims=True)) for one in off]
        camera = self.seen.camera(solution.change)
        result = []
        for index, mask in enumerate(self.given):
            pixels, points = self.seen.pixels[index][mask], self.seen.points[index][mask]
            result.append(point_errors(camera, expected.taken(index), pixels, scale * points))
        return result


def point_errors(camera: CameraModel, seen: Rigid, pixels: Array, points: Array) -> Array:
    """Return the distances (N,), metres, of rays' crossings with a target's plane from its points.

    Infinite for a ray that does not meet the plane before the camera. ``seen``:
    ``T_camera_target``. ``pixels`` (N, 2) are the rays', ``points`` (N, 3) on the target, metres.
    """
    rays = np.column_stack([camera.directions(pixels), np.ones(len(pixels))])
    off: Array = np.linalg.norm(on_plane(rays, *seen) - points, axis=1)
    return off


def on_plane(rays: Array, turn: Array, shift: Array) -> Array:
    """Return the crossings of rays (N, 3) from the origin with a plane, in its own frame, (N, 3).

    Infinite where a ray does not meet it. ``turn`` (3, 3) is of the plane's frame, its third column
    the normal, ``shift`` (3,) its origin.
    """
    # s r is in the plane where n (s r - o) = 0: s = n o / n r; then R^T (s r - o) is in its frame.
    normal = turn[:, 2]
    along = rays @ normal
    with np.errstate(all="ignore"):
        reach = float(shift @ normal) / along
        found: Array = (rays * reach[:, None] - shift) @ turn
    found[~(np.isfinite(reach) & (reach > 0))] = np.inf
    return found


@dataclass(slots=True)
class Candidate:
    """One way of solving, and how well it predicts."""

    method: str  # one of :data:`METHODS`
    besides: str  # one of :data:`ADJUSTABLE`
    problem: Problem  # with what is adjusted besides set free
    solution: Solution | None  # from all poses; None where it fails
    # solutions from the other poses, by the poses left out
    folds: list[tuple[NDArray[np.intp], Solution]] = field(default_factory=list)
    # (V,) rms held-out error of each pose, metres; infinite where there is none
    errors: Array = field(default_factory=lambda: np.zeros(0))
    points: Array = field(default_factory=lambda: np.ones(1))  # how many errors each pose has

    @property
    def name(self) -> str:
        """Method, and what is adjusted besides."""
        return self.method if self.besides == NOTHING else f"{self.method}, {self.besides}"

    @property
    def held_out(self) -> float:
        """Rms held-out error of all points, metres; infinite where a pose has none."""
        if not len(self.errors) or not np.isfinite(self.errors).all():
            return math.inf
        return math.sqrt(float((self.points * self.errors**2).sum() / self.points.sum()))

    @property
    def chance(self) -> float:
        """How likely noise alone makes what is adjusted besides differ as much, 0 to 1."""
        if self.solution is None or self.solution.information is None:
            return 1.0
        change, whole = self.solution.change, self.solution.information
        if not len(change):
            return 1.0
        # Wald's test: without an error beside noise, x^T C^-1 x of the K parameters x is chi-square
        # with K degrees of freedom; C^-1 is Schur's complement of what X and Z take of the
        # information. Where noise was estimated from few equations it is F (over K).
        # Source: Wald, Tests of Statistical Hypotheses Concerning Several Parameters When the
        # Number of Observations is Large (1943).
        mixed = whole[:12, 12:]
        own = whole[12:, 12:] - mixed.T @ solve_scaled(whole[:12, :12], mixed)
        squares = float(change @ own @ change)
        if not math.isfinite(squares):
            return 1.0
        # half of the equations each tell one of the robot's two sigmas
        freedom = None if self.problem.sigmas else max(1, 3 * self.problem.count - 6)
        return Noise(1.0, freedom).chance(max(squares, 0.0), len(change))


def candidates(
    problem: Problem, free: Mapping[str, tuple[int, ...]], method: str = "auto"
) -> list[Candidate]:
    """Return the candidates with their held-out errors.

    Beside what :func:`choose` asks for, the methods are tried with the poses alone.

    ``free``: numbers of the parameters of each of :data:`ADJUSTABLE` that may be adjusted.
    ``method``: ``auto``, or the only one that is wanted beside the closed forms.
    """
    found = [Candidate(name, NOTHING, problem, _closed(problem, name)) for name in LINEAR]
    begin = _begin(problem, found)
    for one in found:
        _leave_out(one)
    if begin is None or method in LINEAR:
        return found

    def tried(name: str, besides: str) -> Candidate:
        freed = _freed(problem, free[besides])
        one = Candidate(name, besides, freed, _refined(freed, name, begin))
        _leave_out(one)
        return one

    judges = []
    asked = next(iter(free))
    if len(free) > 1 or method in ("auto", JUDGE):
        judges = [tried(JUDGE, besides) for besides in free]
    if len(free) > 1:
        asked = _asked([one for one in judges if one.solution is not None])
    others = [name for name in METHODS if name not in (*LINEAR, JUDGE) and method in ("auto", name)]
    for besides in dict.fromkeys((NOTHING, asked)):
        if besides in free:
            found += [tried(name, besides) for name in others]
    return found + judges


def choose(
    found: Sequence[Candidate], *, method: str = "auto", besides: str | None = None
) -> Candidate | None:
    """Return the candidate that is to be taken; None where none can be.

    First what is adjusted besides, as :data:`JUDGE` says, then the method.

    ``method``: ``auto``, or which it must be. ``besides``: what must be adjusted besides; None:
    what is asked for.
    """
    sound = [one for one in found if one.solution is not None]
    wanted = _asked(sound) if besides is None else besides
    kept = [
        one
        for one in sound
        if method in ("auto", one.method) and (one.method in LINEAR or one.besides == wanted)
    ]
    scored = [one for one in kept if math.isfinite(one.held_out)]
    if scored:
        caution = max(1.0, MANY / (scored[0].problem.count - LEAST_POSES))
        return min(scored, key=lambda one: one.held_out / METHODS[one.method] ** caution)
    order = {name: number for number, name in enumerate(METHODS)}
    return min(kept, key=lambda one: order[one.method], default=None)


def _asked(sound: Sequence[Candidate]) -> str:
    """Return the unknowns that are to be adjusted besides."""
    judges = [one for one in sound if one.method == JUDGE]
    plain = next((one.held_out for one in judges if one.besides == NOTHING), math.inf)
    asked = [one for one in judges if one.chance < LEVEL and one.held_out < plain]
    return min(asked, key=lambda one: one.held_out).besides if asked else NOTHING


def _freed(problem: Problem, numbers: tuple[int, ...]) -> Problem:
    if not numbers:
        return problem
    return dataclasses.replace(problem, seen=dataclasses.replace(problem.seen, free=numbers))


def _closed(problem: Problem, name: str) -> Solution | None:
    found = solve_linear(name, problem.robot, problem.poses)
    return None if found is None else Solution(*found, np.zeros(problem.seen.extra))


def _begin(problem: Problem, closed: Sequence[Candidate]) -> Solution | None:
    """Return the closed form that fits best."""
    ranked = []
    for number, one in enumerate(closed):
        if one.solution is not None:
            errors = np.concatenate(problem.errors(one.solution))
            ranked.append((float(np.median(errors)), number, one.solution))
    ranked = [one for one in ranked if math.isfinite(one[0])]
    return min(ranked)[2] if ranked else None


def _refined(problem: Problem, method: str, begin: Solution) -> Solution | None:
    robot, seen = problem.robot, problem.seen
    if method == "reprojection":
        found = adjust(robot, seen, begin)
    elif problem.sigmas is not None:
        found = adjust(robot, seen, begin, RobotNoise(problem.sigmas))
    else:
        found = adjust_noisy(robot, seen, begin, shared=method == "robot and lens")
    fits = math.isfinite(found.cost) and abs(seen.scale(found.change) - 1.0) <= MOST_SCALE
    return found if fits else None


def _again(problem: Problem, method: str, whole: Solution) -> Solution | None:
    """Return the solution of a part of the poses, with the noise that all of them told."""
    if method in LINEAR:
        return _closed(problem, method)
    found = adjust(problem.robot, problem.seen, whole, whole.noise, gain=ROUGH_GAIN)
    return found if math.isfinite(found.cost) else None


def _leave_out(one: Candidate) -> None:
    """Give a candidate its held-out errors."""
    problem, count = one.problem, one.problem.count
    one.errors = np.full(count, np.inf)
    one.points = np.ones(count) if problem.given is None else problem.given.sum(axis=1)
    if one.solution is None or count <= LEAST_POSES:
        return
    numbers = np.arange(count)
    for fold in range(min(count, MOST_FOLDS)):
        out = numbers[numbers % MOST_FOLDS == fold] if count > MOST_FOLDS else numbers[[fold]]
        found = _again(problem.taken(np.setdiff1d(numbers, out)), one.method, one.solution)
        if found is None:
            continue
        one.folds.append((out, found))
        errors = problem.taken(out).errors(found)
        one.errors[out] = [math.sqrt(float((off**2).mean())) for off in errors]
