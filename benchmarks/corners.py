"""Corners and dots in images: how near their error is to what noise allows, how long they take.

Searches are timed beside OpenCV's: where no target is, and in large images with one.

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
from smartcam.calibration._targets import Charuco, Checkerboard, CircleGrid
from smartcam.calibration.simulation._images import render
from smartcam.exceptions import CalibrationError
from smartcam.geometry import CameraModel, Transform

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from numpy.typing import NDArray

    from smartcam.calibration._targets import Target
    from smartcam.geometry._inside import Array

    Image = NDArray[np.uint8]
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
    for case, image in _empty_scenes():
        yield from _searches(plan, f"no target, {case}", image, Goal("at most", 30, "ms"))
    for target in (PLAIN, BOARD, GRID):
        yield from _large(plan, target)


PLAIN = Checkerboard(columns=9, rows=6, square=0.025)
BOARD = Charuco(columns=8, rows=6, square=0.03, marker=0.02)
GRID = CircleGrid(columns=10, rows=8, spacing=0.02, diameter=0.01, origin_diameter=0.016)

CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE


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
    found = cv2.cornerSubPix(image.uint8_levels, found, (half, half), (-1, -1), stop)
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


def _pose(target: Target, tilt: float) -> Transform:
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


def _empty_scenes() -> Iterator[tuple[str, Image]]:
    """Yield images of 640 x 480 pixels that show no target."""
    random = np.random.default_rng(7)
    frequency = np.hypot(np.fft.fftfreq(480)[:, None], np.fft.fftfreq(640))
    frequency[0, 0] = 1.0
    clouds = np.fft.ifft2(np.fft.fft2(random.normal(size=(480, 640))) / frequency).real
    yield "texture (1/f)", _bytes(128 + 45 * clouds / clouds.std())
    yield "noise of 40", _bytes(random.normal(128, 40, (480, 640)))
    desk = np.full((480, 640), 200, dtype=np.uint8)
    for _ in range(250):
        corners = random.uniform((0, 0), (640, 480)) + random.uniform(-45, 45, (4, 2))
        hull = cv2.convexHull(corners.astype(np.int32))
        cv2.fillConvexPoly(desk, hull, (random.uniform(0, 255),))
    yield "polygons", desk
    page = np.full((480, 640), 230, dtype=np.uint8)
    for row in range(20, 480, 15):
        line = "".join(map(chr, random.integers(33, 126, 90)))
        cv2.putText(page, line, (5, row), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (20.0,), 1, cv2.LINE_AA)
    yield "text", page
    yield "uniform", np.full((480, 640), 128, dtype=np.uint8)
    other = Checkerboard(columns=10, rows=7, square=0.02)
    yield "another board", render(other, _camera(640), _pose(other, 20), noise=2)


def _bytes(levels: Array) -> Image:
    return np.asarray(np.rint(levels).clip(0, 255), dtype=np.uint8)


def _camera(width: int) -> CameraModel:
    scale = width / 640
    return CameraModel(
        size=(width, round(480 * scale) if width == 640 else width * 9 // 16),
        matrix=np.array([[600 * scale, 0, width / 2], [0, 600 * scale, width * 0.3], [0, 0, 1]]),
    )


def _large(plan: Plan, target: Target) -> Iterator[Comparison]:
    camera = _camera(960 if plan.quick else 3840)
    image = render(target, camera, _pose(target, 30), noise=2)
    wide, high = camera.size
    case = f"{target.kind} seen, {wide} x {high} pixels"
    yield from _searches(plan, case, image, Goal("at most", 100, "ms"), target)


def _searches(
    plan: Plan, case: str, image: Image, goal: Goal, target: Target | None = None
) -> Iterator[Comparison]:
    """Time searches for a target on one core, those of OpenCV for a board of 9 x 6.

    Without a ``target`` all three kinds are looked for, one after the other.
    """
    ours: dict[str, Callable[[], object]] = {
        wanted.kind: functools.partial(_search, image, wanted)
        for wanted in ((PLAIN, BOARD, GRID) if target is None else (target,))
    }
    pattern = (PLAIN.columns, PLAIN.rows)
    find, sectors = cv2.findChessboardCorners, cv2.findChessboardCornersSB
    theirs: dict[str, Callable[[], object]] = {
        "findChessboardCorners": lambda: find(image, pattern, flags=CLASSIC),
        "findChessboardCorners, FAST_CHECK": lambda: find(
            image, pattern, flags=CLASSIC | cv2.CALIB_CB_FAST_CHECK
        ),
        "findChessboardCornersSB": lambda: sectors(image, pattern),
    }
    if target not in (None, PLAIN):
        theirs = {}
    found = _taking_turns(plan, {**ours, **theirs})
    for kind in ours:
        yield Comparison(
            "corners", f"{case}: find_target, {kind}", found[kind], None, "alone", goal
        )
    for name in theirs:
        yield Comparison(
            "corners",
            f"{case}: find_target, checkerboard, over {name}",
            found[PLAIN.kind],
            found[name],
        )


def _search(image: Image, target: Target) -> bool:
    try:
        find_target(image, target)
    except CalibrationError:
        return False
    return True


def _taking_turns(plan: Plan, work: dict[str, Callable[[], object]]) -> dict[str, Series]:
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    times: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(plan.rounds):
        for name, task in work.items():
            begin = time.process_time()
            task()
            times[name].append(1e3 * (time.process_time() - begin))
    cv2.setNumThreads(threads)
    return {name: Series(name, "ms", of) for name, of in times.items()}
