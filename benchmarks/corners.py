"""Corners and dots in images: how near their error is to what noise allows, how long they take.

Corners are drawn with known places, angles and blur, and noise of 1, 2 and 5 grey levels; no
estimate without a bias can have a smaller error than the Cramer-Rao bound with unknown angles,
blur, gain and offset. All sides get the same images and the same starts.
"""

from __future__ import annotations

import functools
import math
import time
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
from scipy.special import erf

from benchmarks.measure import Comparison, Goal, Plan, Series
from smartcam.calibration._detection.corners import refine_corners
from smartcam.calibration._detection.find import find_target
from smartcam.calibration._detection.image import GreyImage
from smartcam.calibration._geometry.frames import Transform
from smartcam.calibration._lens.model import CameraModel
from smartcam.calibration._targets import Checkerboard, CircleGrid
from smartcam.calibration.simulation._images import render

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from smartcam.calibration._geometry.rotations import Array

    Refine = Callable[[GreyImage, Array, Array], Array]

__all__ = ["run"]

CORNERS = 400
"""Of one noise and blur in a round."""

HALF, CONTRAST, APART = 11, 150.0, 48
"""Pixels to each side of a window, grey levels from black to white, pixels between two corners."""


def run(plan: Plan) -> Iterable[Comparison]:
    """Measure errors of corners over the bound, of dots with and without correction, and times."""
    for noise in (1.0, 2.0, 5.0):
        for blur in (0.7, 1.5):
            yield from _corners(plan, noise, blur)
    yield from _dots(plan)
    yield from _times(plan)


class _Drawn(NamedTuple):
    """Corners side by side.

    Attributes:
        image: each corner in the middle of its own field.
        truth: (N, 2), pixels.
        start: (N, 2), pixels.
        ways: (N, 2, 2), along the edges, half a window long.
        bound: of a coordinate, rms, pixels.
    """

    image: GreyImage
    truth: Array
    start: Array
    ways: Array
    bound: float


def _model(values: Array, x: Array, y: Array) -> Array:
    u, v, first, second, blur, gain, offset = values
    shapes = [
        erf((np.cos(angle) * (x - u) + np.sin(angle) * (y - v)) / (math.sqrt(2) * blur))
        for angle in (first, second)
    ]
    levels: Array = offset + gain * shapes[0] * shapes[1]
    return levels


def _variance(values: Array, noise: float) -> float:
    """Return the least variance of the corner, both coordinates, of a window of 23 x 23."""
    span = np.arange(-HALF, HALF + 1, dtype=np.float64)
    x, y = (side.ravel() for side in np.meshgrid(span, span))
    step = 1e-5 * np.eye(7)
    ends = [(_model(values + change, x, y), _model(values - change, x, y)) for change in step]
    slopes = np.array([(high - low) / 2e-5 for high, low in ends])
    return float(noise**2 * np.trace(np.linalg.inv(slopes @ slopes.T)[:2, :2]))


def _draw(noise: float, blur: float, count: int, random: np.random.Generator) -> _Drawn:
    across = math.ceil(math.sqrt(count))
    levels = np.full((across * APART, across * APART), 128.0)
    y, x = np.mgrid[:APART, :APART].astype(float)
    truth, ways, variances = [], [], []
    for number in range(count):
        row, column = divmod(number, across)
        middle = APART / 2 + random.uniform(-0.5, 0.5, size=2)
        first = random.uniform(0, 2 * math.pi)
        second = first + math.pi / 2 + random.uniform(-0.3, 0.3)
        values = np.array([*middle, first, second, blur, CONTRAST / 2, 128.0])
        field = np.s_[row * APART : (row + 1) * APART, column * APART : (column + 1) * APART]
        levels[field] = _model(values, x, y)
        truth.append(middle + np.array([column, row]) * APART)
        ways.append([[-math.sin(angle), math.cos(angle)] for angle in (first, second)])
        centred = np.array([*(middle - np.rint(middle)), *values[2:]])
        variances.append(_variance(centred, noise))
    levels += random.normal(scale=noise, size=levels.shape)
    seen = np.rint(levels).clip(0, 255)
    return _Drawn(
        GreyImage(seen.astype(np.float32), seen.astype(np.uint8)),
        np.array(truth),
        np.array(truth) + random.normal(scale=0.5, size=(count, 2)),
        (HALF + 0.5) * np.array(ways),
        math.sqrt(float(np.mean(variances)) / 2),
    )


def _sub_pix(half: int, image: GreyImage, start: Array, _ways: Array) -> Array:
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-4)
    found: Any = start.astype(np.float32).reshape(-1, 1, 2)
    found = cv2.cornerSubPix(image.bytes, found, (half, half), (-1, -1), stop)
    refined: Array = np.asarray(found, dtype=np.float64).reshape(-1, 2)
    return refined


def _corners(plan: Plan, noise: float, blur: float) -> Iterator[Comparison]:
    sides: dict[str, Refine] = {
        "refine_corners": lambda image, start, ways: refine_corners(image, start, ways).points,
        "cornerSubPix 5": functools.partial(_sub_pix, 5),
        "cornerSubPix 11": functools.partial(_sub_pix, 11),
    }
    found: dict[str, list[float]] = {name: [] for name in sides}
    bounds = []
    for number in range(plan.rounds):
        random = np.random.default_rng([number, int(10 * noise), int(10 * blur)])
        drawn = _draw(noise, blur, plan.operations(CORNERS, least=16), random)
        bounds.append(drawn.bound)
        for name, refine in sides.items():
            off = refine(drawn.image, drawn.start, drawn.ways) - drawn.truth
            found[name].append(math.sqrt(float((off**2).mean())))
    for name, errors in found.items():
        yield Comparison(
            "corners",
            f"noise {noise:g}, blur {blur:g} px: rms error of {name} over the bound",
            Series(name, "px", errors),
            Series("Cramer-Rao bound", "px", bounds),
            "ratio",
            Goal("at most", 1.15) if name == "refine_corners" else None,
        )


def _pose(target: Checkerboard | CircleGrid, tilt: float) -> Transform:
    turn = np.asarray(cv2.Rodrigues(np.radians(tilt) * np.array([0.6, 0.8, 0]))[0]) @ np.diag(
        [1.0, -1.0, -1.0]
    )
    shift = np.array([0, 0, 0.45]) - turn @ target.points.mean(axis=0)
    return Transform("camera", "target", turn, shift)


def _dots(plan: Plan) -> Iterator[Comparison]:
    """Compare the places of dots on a sheet that is tilted by 40 degrees with OpenCV's."""
    grid = CircleGrid(columns=9, rows=7, spacing=0.025, diameter=0.0125)
    camera = CameraModel(
        size=(640, 480),
        matrix=np.array([[600, 0, 318.3], [0, 602, 241.7], [0, 0, 1]]),
        distortion=np.array([-0.2, 0.08, 0.001, -0.0005, 0.0]),
    )
    pose = _pose(grid, 40)
    truth = camera.project(grid.points @ pose.rotation.T + pose.translation)
    ours, theirs = [], []
    for number in range(plan.rounds):
        image = render(grid, camera, pose, noise=2, random=np.random.default_rng(number))
        view = find_target(image, grid)
        ours.append(_rms(view.points - truth))
        seen, centres = cv2.findCirclesGrid(image, (9, 7), flags=cv2.CALIB_CB_SYMMETRIC_GRID)
        found: Any = np.asarray(centres).reshape(-1, 2) if seen else np.full_like(truth, np.nan)
        nearest = np.linalg.norm(found[None] - truth[:, None], axis=2).argmin(axis=1)
        theirs.append(_rms(found[nearest] - truth))
    yield Comparison(
        "corners",
        "dots tilted by 40 degrees, noise 2: rms error",
        Series("find_target", "px", ours),
        Series("OpenCV findCirclesGrid", "px", theirs),
        "ratio",
        Goal("at most", 0.2),
        "perspective moves the middle of a dot's outline away from its centre",
    )


def _rms(off: Array) -> float:
    return math.sqrt(float((off**2).mean()))


def _times(plan: Plan) -> Iterator[Comparison]:
    """Time 54 corners on one core."""
    board = Checkerboard(columns=9, rows=6, square=0.025)
    camera = CameraModel(
        size=(640, 480), matrix=np.array([[600, 0, 318.3], [0, 602, 241.7], [0, 0, 1]])
    )
    image = render(board, camera, _pose(board, 20), noise=2)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    grey = GreyImage(image.astype(np.float32), image)
    view = find_target(image, board)
    grid = view.points.reshape(6, 9, 2)
    steps = np.stack([np.gradient(grid, axis=1), np.gradient(grid, axis=0)], axis=2)
    ways = 0.45 * steps.reshape(-1, 2, 2)
    start = np.rint(view.points)
    work: dict[str, Callable[[], object]] = {
        "refinement of 54 corners": lambda: refine_corners(grey, start, ways),
        "find_target": lambda: find_target(image, board),
    }
    for name, task in work.items():
        times = []
        for _ in range(plan.rounds):
            task()
            begin = time.process_time()
            task()
            times.append(1e3 * (time.process_time() - begin))
        goal = Goal("at most", 20, "ms") if name.startswith("refinement") else None
        yield Comparison(
            "corners",
            f"{name}, 640 x 480 pixels",
            Series("smartcam", "ms", times),
            None,
            "alone",
            goal,
        )
    cv2.setNumThreads(threads)
