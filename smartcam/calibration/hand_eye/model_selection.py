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
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.calibration.hand_eye.closed_forms import LEAST_POSES, LINEAR, solve_linear
from smartcam.calibration.hand_eye.equations import (
    ROUGH_GAIN,
    Adjusted,
    PixelObservations,
    PoseObservations,
    Rigid,
    adjust,
    carried,
    log_rotation,
)
from smartcam.calibration.hand_eye.robot_noise import Noise, adjust_noisy
from smartcam.calibration.statistics import Noise as Chance

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from smartcam.calibration.geometry.rotations import Array
    from smartcam.calibration.hand_eye.equations import Robot, RobotSigmas
    from smartcam.calibration.lens.model import CameraModel

    Seen = PixelObservations | PoseObservations

__all__ = [
    "ADJUSTABLE",
    "JUDGE",
    "METHODS",
    "NOTHING",
    "Candidate",
    "Problem",
    "Solution",
    "candidates",
    "choose",
    "on_plane",
    "point_errors",
    "steps_between",
]

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
    """Poses of a robot and what the camera saw at each.

    Attributes:
        robot: V poses.
        seen: V views, or poses of the target without views.
        poses: V times ``T_camera_target``, each from its own view.
        given: (V, N), which of the points there are; None without views.
        sigmas: of the robot, where they are known.
    """

    robot: Robot
    seen: Seen
    poses: Rigid
    given: NDArray[np.bool_] | None = None
    sigmas: RobotSigmas | None = None

    @property
    def count(self) -> int:
        """V."""
        return len(self.poses.translation)

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
            seen = Rigid(expected.rotation[index], expected.translation[index])
            result.append(point_errors(camera, seen, pixels, scale * points))
        return result


def point_errors(camera: CameraModel, seen: Rigid, pixels: Array, points: Array) -> Array:
    """Return where rays pass a target's plane, from where its points are (N,), metres.

    Args:
        camera: the lens.
        seen: ``T_camera_target``.
        pixels: (N, 2), of the rays.
        points: (N, 3), on the target, metres.

    Returns:
        Infinite for a ray that does not meet the plane before the camera.
    """
    rays = np.column_stack([camera.directions(pixels), np.ones(len(pixels))])
    off: Array = np.linalg.norm(on_plane(rays, *seen) - points, axis=1)
    return off


def on_plane(rays: Array, turn: Array, shift: Array) -> Array:
    """Return where rays from the origin pass a plane, in the plane's own frame.

    Args:
        rays: (N, 3).
        turn: (3, 3), of the plane's frame; its third column is the normal.
        shift: (3,), its origin.

    Returns:
        (N, 3); infinite where a ray does not meet it.
    """
    normal = turn[:, 2]
    along = rays @ normal
    with np.errstate(all="ignore"):
        reach = float(shift @ normal) / along
        found: Array = (rays * reach[:, None] - shift) @ turn
    found[~(np.isfinite(reach) & (reach > 0))] = np.inf
    return found


class Solution(NamedTuple):
    """Where camera and target are.

    Attributes:
        camera: ``X``.
        target: ``Z``.
        change: (extra,), of what is adjusted besides.
        noise: with which it was found; None for closed forms.
        adjusted: how it was found; None for closed forms.
    """

    camera: Rigid
    target: Rigid
    change: Array
    noise: Noise | None = None
    adjusted: Adjusted | None = None


@dataclass(slots=True)
class Candidate:
    """One way of solving, and how well it predicts.

    Attributes:
        method: one of :data:`METHODS`.
        besides: one of :data:`ADJUSTABLE`.
        problem: with what is adjusted besides set free.
        solution: from all poses; None where it fails.
        folds: solutions from the other poses, by the poses left out.
        errors: (V,) rms held-out error of each pose, metres; infinite where there is none.
        points: how many errors each pose has.
    """

    method: str
    besides: str
    problem: Problem
    solution: Solution | None
    folds: list[tuple[NDArray[np.intp], Solution]] = field(default_factory=list)
    errors: Array = field(default_factory=lambda: np.zeros(0))
    points: Array = field(default_factory=lambda: np.ones(1))

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
        if self.solution is None or self.solution.adjusted is None or not len(self.solution.change):
            return 1.0
        change, whole = self.solution.change, self.solution.adjusted.information
        outer, mixed = whole[:12, :12], whole[:12, 12:]
        size = np.sqrt(np.maximum(np.diag(outer), np.finfo(np.float64).tiny))
        solved = np.linalg.lstsq(outer / np.outer(size, size), mixed / size[:, None], rcond=None)[0]
        own = whole[12:, 12:] - mixed.T @ (solved / size[:, None])
        squares = float(change @ own @ change)
        if not math.isfinite(squares):
            return 1.0
        # half of the equations each tell one of the robot's two sigmas
        freedom = None if self.problem.sigmas else max(1, 3 * self.problem.count - 6)
        return Chance(1.0, freedom).chance(max(squares, 0.0), len(change))


def candidates(
    problem: Problem, free: Mapping[str, tuple[int, ...]], method: str = "auto"
) -> list[Candidate]:
    """Return the candidates with their held-out errors.

    Beside what :func:`choose` asks for, the methods are tried with the poses alone.

    Args:
        problem: poses and views.
        free: numbers of the parameters of each of :data:`ADJUSTABLE` that may be adjusted.
        method: ``auto``, or the only one that is wanted beside the closed forms.
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

    Args:
        found: all of them.
        method: ``auto``, or which it must be.
        besides: what must be adjusted besides; None: what is asked for.
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
    """Return what is to be adjusted besides."""
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
    start = begin.camera, begin.target
    if method == "reprojection":
        found, noise = adjust(problem.robot, problem.seen, *start), None
    elif problem.sigmas is not None:
        noise = Noise(problem.sigmas, 1.0)
        found = adjust(problem.robot, problem.seen, *start, sigmas=problem.sigmas)
    else:
        shared = method == "robot and lens"
        found, noise = adjust_noisy(problem.robot, problem.seen, *start, shared=shared)
    if not math.isfinite(found.cost) or abs(problem.seen.scale(found.change) - 1.0) > MOST_SCALE:
        return None
    return Solution(found.camera, found.target, found.change, noise, found)


def _again(problem: Problem, method: str, whole: Solution) -> Solution | None:
    """Return the solution of a part of the poses, with the noise that all of them told."""
    if method in LINEAR:
        return _closed(problem, method)
    noise = whole.noise
    found = adjust(
        problem.robot,
        problem.seen if noise is None else problem.seen.spread(noise.shared),
        whole.camera,
        whole.target,
        sigmas=None if noise is None else noise.robot,
        change=whole.change,
        gain=ROUGH_GAIN,
    )
    if not math.isfinite(found.cost):
        return None
    return Solution(found.camera, found.target, found.change, noise, found)


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


def steps_between(first: Solution, second: Solution) -> Array:
    """Return the steps (12,) from one solution's camera and target to another's."""
    pairs = (first.camera, second.camera), (first.target, second.target)
    steps = [
        (log_rotation(a.rotation.T @ b.rotation), b.translation - a.translation) for a, b in pairs
    ]
    return np.concatenate([part for step in steps for part in step])
