"""Calibration: how near the error is to what noise allows, what is predicted, how long it takes.

A robot touches marks of a field of 300 x 240 mm with noise of 0.2 mm on each axis. The error is the
rms over the field, over many calibrations; no fit without a bias can have a smaller one than the
Cramer-Rao bound. The others get the same touches.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.measure import Comparison, Curve, Goal, Plan, Series, cpu_microseconds, take_turns
from smartcam.calibration import fit_plane
from smartcam.models import Header, Localization, Pose, Position, Quaternion

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from benchmarks.measure import Cost
    from smartcam.geometry._inside import Array

    Fit = Callable[[Array, Array], Callable[[Array], Array]]

__all__ = ["run"]

WIDTH, HEIGHT = 0.3, 0.24
"""Of the field, metres."""

SIGMA = 0.0002
"""Of a touch, each axis, metres."""

RUNS = 400
"""Calibrations of one layout in a round."""

POINTS = 1_000_000
POSES = 20_000

TURN = Rotation.from_euler("zyx", [0.7, 0.4, -2.5]).as_matrix()
ORIGIN = np.array([0.6, -0.4, 0.2])


def _grid(columns: int, rows: int, part: float = 1.0) -> Array:
    across = np.linspace(0.5 - part / 2, 0.5 + part / 2, columns) * WIDTH
    along = np.linspace(0.5 - part / 2, 0.5 + part / 2, rows) * HEIGHT
    return np.stack(np.meshgrid(across, along), axis=-1).reshape(-1, 2)


FIELD = _grid(13, 11)
LAYOUTS = {
    "O, A, B in a corner": np.array([[0.0, 0.0], [0.2, 0.0], [0.0, 0.15]]),
    "3 spread": np.array([[0.0, 0.0], [WIDTH, 0.0], [WIDTH / 2, HEIGHT]]),
    "4 corners": _grid(2, 2),
    "3x3": _grid(3, 3),
    "4x4": _grid(4, 4),
    "5x5": _grid(5, 5),
    "3x3 in the middle third": _grid(3, 3, 1 / 3),
}


def run(plan: Plan) -> Iterable[Comparison | Curve]:
    """Measure error and prediction for every layout, then the time of points and poses."""
    for name, marks in LAYOUTS.items():
        yield from _accuracy(plan, name, marks)
    yield from _points(plan)
    yield _poses(plan)


def _robot(marks: Array) -> Array:
    lying: Array = marks @ TURN[:, :2].T + ORIGIN
    return lying


def _bound(marks: Array) -> float:
    """Return the Cramer-Rao bound of a similarity, rms over the field, metres."""
    count, centre = len(marks), marks.mean(axis=0)
    levers, near = FIELD - centre, marks - centre
    inside = 2 / count + 2 * (levers**2).sum(axis=1) / (near**2).sum()
    tilt = (levers.T * np.linalg.solve(near.T @ near, levers.T)).sum(axis=0)
    return SIGMA * math.sqrt(float((inside + 1 / count + tilt).mean()))


@dataclass(slots=True)
class _Errors:
    """Mean squares of one side, m^2, one a round."""

    observed: list[float] = field(default_factory=list[float])
    predicted: list[float] = field(default_factory=list[float])

    def rms(self, name: str) -> Series:
        return Series(name, "mm", [1e3 * math.sqrt(value) for value in self.observed])


def _accuracy(plan: Plan, layout: str, marks: Array) -> Iterator[Comparison]:
    """Compare with the bound: smartcam with its model named and chosen, then the others."""
    sides: dict[str, Fit | None] = {
        "fit_plane": None,
        "OpenCV estimateAffine3D": _opencv,
        "SciPy align_vectors": _scipy,
    }
    if layout == "3x3":
        sides["fit_plane, auto"] = None
    if layout.startswith("O"):
        sides["the thesis' construction"] = _construction
    found = {name: _Errors() for name in sides}
    truth, runs = _robot(FIELD), plan.operations(RUNS, least=8)
    for number in range(plan.rounds):
        for name, peer in sides.items():
            random = np.random.default_rng([number, len(marks)])
            observed = predicted = 0.0
            for _ in range(runs):
                touched = _robot(marks) + SIGMA * random.normal(size=(len(marks), 3))
                if peer is not None:
                    mapped = peer(marks, touched)(FIELD)
                else:
                    model: Any = "auto" if name.endswith("auto") else "similarity"
                    fitted = fit_plane(marks, touched, model=model, touch_sigma=SIGMA)
                    mapped = fitted.transform(FIELD)
                    predicted += float((fitted.predicted_error(FIELD) ** 2).mean()) / runs
                observed += float(((mapped - truth) ** 2).sum(axis=1).mean()) / runs
            found[name].observed.append(observed)
            found[name].predicted.append(predicted)
    bound = Series("Cramer-Rao bound", "mm", [1e3 * _bound(marks)] * plan.rounds)
    for name, errors in found.items():
        goal = Goal("at most", 1.03) if name == "fit_plane" else None
        case = f"{layout}: rms error of {name} over the bound"
        yield Comparison("calibration", case, errors.rms(name), bound, "ratio", goal)
    ours = found["fit_plane"]
    ratio = math.sqrt(sum(ours.predicted) / sum(ours.observed))
    yield Comparison(
        "calibration",
        f"{layout}: predicted error off the observed one",
        Series("smartcam", "percent", [100 * abs(ratio - 1.0)]),
        None,
        "alone",
        Goal("at most", 3.0, "percent"),
        f"of all calibrations of a layout together; here predicted over observed is {ratio:.3f}",
    )


def _opencv(marks: Array, touched: Array) -> Callable[[Array], Array]:
    flat = np.column_stack([marks, np.zeros(len(marks))])
    matrix, scale = cv2.estimateAffine3D(flat, touched, force_rotation=True)
    return lambda points: points @ (scale * matrix[:, :2]).T + matrix[:, 3]


def _scipy(marks: Array, touched: Array) -> Callable[[Array], Array]:
    """A rotation is all that SciPy fits: scale and shift are added as they should be."""
    near, far = marks - marks.mean(axis=0), touched - touched.mean(axis=0)
    flat = np.column_stack([near, np.zeros(len(near))])
    turn = Rotation.align_vectors(far, flat)[0].as_matrix()[:, :2]
    scale = float((far * (near @ turn.T)).sum() / (near**2).sum())
    shift = touched.mean(axis=0) - scale * turn @ marks.mean(axis=0)
    return lambda points: scale * points @ turn.T + shift


def _construction(marks: Array, touched: Array) -> Callable[[Array], Array]:
    """Point, normal and scale from O, A and B, with the yaw that the thesis leaves open."""
    o, a, b = touched
    x = (a - o) / np.linalg.norm(a - o)
    normal = np.cross(a - o, b - o)
    y = np.cross(normal / np.linalg.norm(normal), x)
    scale = float(np.linalg.norm(a - o) / np.linalg.norm(marks[1] - marks[0]))
    return lambda points: o + scale * points @ np.stack([x, y])


def _timed(work: Callable[[], object], operations: int) -> Callable[[], Cost]:
    def measure() -> Cost:
        begin = time.process_time()
        for _ in range(operations):
            work()
        return cpu_microseconds(begin, operations)

    return measure


def _fastest(work: Callable[[], object], times: int) -> Callable[[], Cost]:
    """Measure the run that others disturbed least."""

    def measure() -> Cost:
        costs: list[float] = []
        for _ in range(times):
            begin = time.process_time()
            work()
            costs.append(cpu_microseconds(begin, 1))
        return min(costs)

    return measure


def _points(plan: Plan) -> Iterator[Comparison]:
    """Map 10^6 points into an array that is there, beside copying that array."""
    from scipy.spatial.transform import RigidTransform

    count = plan.operations(POINTS, least=1000)
    seen = np.random.default_rng(1).uniform(0, 0.3, size=(count, 2))
    homogeneous = np.column_stack([seen, np.ones(count)])
    source, out = np.random.default_rng(2).uniform(size=(count, 3)), np.zeros((count, 3))
    marks, touched = _grid(3, 3), _robot(_grid(3, 3))
    similar = fit_plane(marks, touched, model="similarity")
    view = marks / (1.0 + 0.3 * marks[:, :1])
    projective = fit_plane(view, touched, model="homography")
    view_matrix = np.column_stack([projective.matrix, np.zeros(4)])
    rigid = RigidTransform.from_matrix(np.vstack([np.column_stack([TURN, ORIGIN]), [0, 0, 0, 1]]))
    copying, peer = "memory copy of the result", "OpenCV perspectiveTransform, (u, v, 1)"
    work: dict[str, Callable[[], object]] = {
        copying: lambda: np.copyto(out, source),
        "similarity, (u, v)": lambda: similar.transform(seen, out),
        "similarity, (u, v, 1)": lambda: similar.transform(homogeneous, out),
        "homography, (u, v)": lambda: projective.transform(seen, out),
        "homography, (u, v, 1)": lambda: projective.transform(homogeneous, out),
        peer: lambda: cv2.perspectiveTransform(
            homogeneous.reshape(-1, 1, 3), view_matrix, dst=out.reshape(-1, 1, 3)
        ),
        "SciPy RigidTransform": lambda: rigid.apply(homogeneous),
    }
    repeats = plan.operations(20)
    series = take_turns(plan, {name: _fastest(one, repeats) for name, one in work.items()})
    for name in [*work][1:]:
        goal = Goal("at most", 2.0) if name.startswith("similarity") else None
        case = f"{count:,} points: {name}"
        yield Comparison("calibration", case, series[name], series[copying], "ratio", goal)
    for name in ("homography, (u, v)", "homography, (u, v, 1)"):
        case = f"{count:,} points: {name} over OpenCV's function alone"
        note = "which divides, point by point: no call of OpenCV or NumPy is nearer to the copy"
        goal = Goal("at most", 1.5)
        yield Comparison("calibration", case, series[name], series[peer], "ratio", goal, note)


def _poses(plan: Plan) -> Comparison:
    """Bring one localization to the robot."""
    marks = _grid(3, 3)
    calibration = fit_plane(marks, _robot(marks), model="similarity")
    header = Header(1, datetime(2024, 5, 1, tzinfo=UTC), "camera")
    pose = Pose(header, Position(0.1, 0.05), Quaternion.from_theta(0.3))
    part = Localization("cube", 0.9, 0, pose)
    count = plan.operations(POSES)
    series = take_turns(plan, {"to_robot": _timed(lambda: calibration.to_robot(part), count)})
    goal = Goal("at most", 5.0, "us")
    return Comparison("calibration", "one pose", series["to_robot"], None, "alone", goal)
