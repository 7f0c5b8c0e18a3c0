"""Two cameras: held-out error on OpenCV's pairs of images, and on rendered pairs of known truth.

OpenCV's samples are 13 pairs of a checkerboard with squares of 25 mm. Each pair is triangulated by
a calibration that never saw it; the error is the rms of the distances between neighbouring corners
less 25 mm, at the same corners whoever calibrated. Parameters of smartcam were chosen on the
odd-numbered pairs. SMARTCAM_PAIRS names the folder that the images are in, or SMARTCAM_DATA one
that they are under; Debian's package opencv-doc has them, too. Without any of these it is the
odd-numbered ones of ``tests/data``, and the case says so. Other recorded sets are those of
:mod:`benchmarks.pairs`, sheets that are not what they were meant to be those of
:mod:`benchmarks.sheets`.

Rendered pairs tell a checkerboard from dots, and a bent sheet from a flat one, by what is true: the
error is that of points all over the space before the cameras.
"""

from __future__ import annotations

import functools
import math
import os
import sys
import time
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.measure import Comparison, Goal, Series
from benchmarks.pairs import compared, corners, opencv_pair
from benchmarks.sheets import Rig, free_sheets
from smartcam.calibration._detection.find import find_target
from smartcam.calibration._stereo.calibration import calibrate_stereo
from smartcam.calibration._stereo.errors import pair_errors
from smartcam.calibration._targets import Checkerboard, CircleGrid
from smartcam.calibration._views import TargetView
from smartcam.calibration.simulation import _scenes as scenes
from smartcam.calibration.simulation._images import render
from smartcam.geometry import CameraModel, Transform

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from benchmarks.measure import Plan
    from smartcam.calibration._stereo.calibration import StereoCalibration
    from smartcam.calibration._targets import Target
    from smartcam.geometry._inside import Array

__all__ = ["run"]

Folder = Path | zipfile.Path

DEBIAN = Path("/usr/share/doc/opencv-doc/examples/data")
ODD = Path(__file__).parents[1] / "tests" / "data" / "opencv_pairs" / "pairs.zip"
LAST = 14
"""Number of the last pair; there is no tenth."""

BOARD = Checkerboard(columns=9, rows=6, square=0.025)
DOTS = CircleGrid(columns=9, rows=6, spacing=0.025, diameter=0.0125, origin_diameter=0.018)

PAIRS = 12
"""Rendered for each calibration."""

FEW = 5
"""Pairs where it is only to be seen that it works."""

WINDOWS = {"corners as in its tutorial, (11, 11)": 11, "corners in 0.35 of their distance": 0}
"""Half windows of OpenCV's corner refinement, pixels; 0: 0.35 of the corners' distance."""

LEFT = CameraModel(
    size=(640, 480),
    matrix=np.array([[530.0, 0.0, 325.0], [0.0, 531.0, 236.0], [0.0, 0.0, 1.0]]),
    distortion=np.array([-0.28, 0.07, 1e-3, -5e-4, 0.02]),
)
RIGHT = CameraModel(
    size=(640, 480),
    matrix=np.array([[541.0, 0.0, 317.0], [0.0, 540.0, 244.0], [0.0, 0.0, 1.0]]),
    distortion=np.array([-0.29, 0.1, -7e-4, 3e-4, 0.0]),
)
RIG = Transform(
    "right",
    "left",
    Rotation.from_rotvec([0.01, -0.05, 0.02]).as_matrix(),
    np.array([-0.08, 0.001, 0.002]),
)
SPACE = np.stack(
    np.meshgrid(np.linspace(-0.12, 0.14, 7), np.linspace(-0.12, 0.12, 7), [0.35, 0.45, 0.55]), -1
).reshape(-1, 3)
"""Points before the left camera, metres."""


def run(plan: Plan) -> Iterator[Comparison]:
    """Measure OpenCV's pairs, then the rendered ones."""
    folder = _folder()
    if folder is None:
        print("stereo: no left01.jpg where it is looked for: left out", file=sys.stderr)
    else:
        yield from _recorded(plan, folder)
    yield from compared(plan)
    yield from _rendered(plan)
    yield _bent(plan)
    yield from free_sheets(plan, Rig(LEFT, RIGHT, RIG, BOARD))


def _folder() -> Folder | None:
    given, under = (os.environ.get(name) for name in ("SMARTCAM_PAIRS", "SMARTCAM_DATA"))
    places = [
        *(() if given is None else (Path(given),)),
        *(() if under is None else (path.parent for path in Path(under).rglob("left01.jpg"))),
        DEBIAN,
        zipfile.Path(ODD),
    ]
    return next((place for place in places if (place / "left01.jpg").exists()), None)


def _numbers(plan: Plan, folder: Folder) -> list[int]:
    """Return the numbers of the pairs that are there and are to be taken."""
    there = [
        number
        for number in range(1, LAST + 1)
        if all((folder / f"{side}{number:02d}.jpg").exists() for side in ("left", "right"))
    ]
    return there[: plan.operations(len(there), least=FEW)]


def _called(numbers: Sequence[int]) -> str:
    odd = all(number % 2 for number in numbers)
    return f"OpenCV's {len(numbers)} {'odd-numbered ' if odd else ''}pairs"


# ---------------------------------------------------------------------- recorded


def _recorded(plan: Plan, folder: Folder) -> Iterator[Comparison]:
    numbers = _numbers(plan, folder)
    _views(folder, "left", numbers[:1])  # what is imported late is not timed
    begin = time.perf_counter()
    views = [_views(folder, side, numbers) for side in ("left", "right")]
    detected = time.perf_counter()
    found = calibrate_stereo(views[0], views[1])
    done = time.perf_counter()
    note = (
        f"{1e3 * (detected - begin) / (2 * len(numbers)):.0f} ms an image to find corners, "
        f"{done - detected:.1f} s to calibrate with each pair left out once; held-out epipolar "
        f"error {found.held_out_epipolar:.3f} px, {found.rms:.3f} px rms of residuals"
    )
    ours = Series("smartcam", "mm", [1e3 * found.held_out])
    exact = calibrate_stereo(views[0], views[1], sheet="exact")
    case = f"{_called(numbers)}, each left out once: held-out error of the squares"
    best: Series | None = None
    for name, window in WINDOWS.items():
        by_ours, by_own = _peer(plan, folder, numbers, window, views)
        best = Series(f"OpenCV, {name}", "mm", [by_ours])
        yield Comparison(
            "stereo",
            f"{case}, judged by smartcam's corners",
            ours,
            best,
            "ratio",
            None,
            f"{by_own:.4f} mm is what OpenCV's has by its own corners: another ruler, and what "
            "measuring with both of OpenCV's is worth",
        )
    yield Comparison("stereo", case, ours, best, "alone", Goal("at most", 0.105, "mm"), note)
    yield Comparison(
        "stereo",
        f"{case}, the sheet taken as exact",
        Series("smartcam", "mm", [1e3 * exact.held_out]),
        best,
        "alone",
        None,
        f"held-out epipolar error {exact.held_out_epipolar:.3f} px",
    )
    shares = [found.rectify(alpha) for alpha in (0.0, 1.0)]
    yield Comparison(
        "stereo",
        f"{_called(numbers)}, rectified with alpha = 0: source pixels lost",
        Series("smartcam", "percent", [100 * max(shares[0].lost)]),
        None,
        "alone",
        None,
        f"with alpha = 1, {100 * max(shares[1].invalid):.0f} percent of the output are invalid; "
        "about 10 percent lost were published",
    )


@functools.cache
def _image(folder: Folder, side: str, number: int) -> Any:
    data = (folder / f"{side}{number:02d}.jpg").read_bytes()
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)


def _views(folder: Folder, side: str, numbers: Sequence[int]) -> list[TargetView]:
    return [find_target(_image(folder, side, number), BOARD) for number in numbers]


def _peer(
    plan: Plan,
    folder: Folder,
    numbers: Sequence[int],
    window: int,
    views: Sequence[Sequence[TargetView]],
) -> tuple[float, float]:
    """Return the held-out error of OpenCV's own calibration, mm, by our corners and by its own."""
    own: list[list[TargetView]] = []
    for side, some in zip(("left", "right"), views, strict=True):
        found = [
            corners(_image(folder, side, n), one, window)
            for n, one in zip(numbers, some, strict=True)
        ]
        own.append([one for one in found if one is not None])
    errors: tuple[list[Array], list[Array]] = ([], [])
    for left_out in range(plan.operations(len(numbers))):
        rest = [pair for n, pair in enumerate(zip(*own, strict=True)) if n != left_out]
        cameras = opencv_pair(rest, "plumb_bob")
        for parts, ruler in zip(errors, (views, own), strict=True):
            left, right = (side[left_out] for side in ruler)
            parts.append(pair_errors(cameras, left, right).spacing)
    by_ours, by_own = (1e3 * math.sqrt(float((np.concatenate(one) ** 2).mean())) for one in errors)
    return by_ours, by_own


# ---------------------------------------------------------------------- rendered


def _poses(seed: int, count: int) -> list[Transform]:
    """Return poses of a sheet before the left camera that both cameras see whole."""
    random, found = np.random.default_rng(seed), list[Transform]()
    around = scenes.poses_around(BOARD, 4 * count, tilt=0.6, distance=0.42, random=random)
    for one in around:
        back = one.inverse()
        pose = Transform("left", "target", back.rotation, back.translation)
        seen = [
            LEFT.project(pose.apply(BOARD.points)),
            RIGHT.project((RIG @ pose).apply(BOARD.points)),
        ]
        if all(((one > 25) & (one < np.array(LEFT.size) - 25)).all() for one in seen):
            found.append(pose)
    return [found[number] for number in random.permutation(len(found))[:count]]


def _error(found: StereoCalibration) -> float:
    """Return the rms error of points in space whose pixels are exact, metres."""
    pixels = LEFT.project(SPACE), RIGHT.project(RIG.apply(SPACE))
    off = found.triangulate(*pixels) - SPACE
    return math.sqrt(float((off**2).sum(axis=1).mean()))


def _rendered(plan: Plan) -> Iterator[Comparison]:
    """Compare a checkerboard with dots of the same size and number."""
    targets: dict[str, Target] = {"checkerboard": BOARD, "dots": DOTS}
    names = ("true", "held out", "residuals")
    values: dict[str, dict[str, list[float]]] = {
        name: {what: [] for what in names} for name in targets
    }
    count = plan.operations(PAIRS, least=FEW)
    for number in range(1 if plan.quick else min(plan.rounds, 3)):
        poses = _poses(number, count)
        for name, target in targets.items():
            random = np.random.default_rng(number)
            sides = [
                [
                    find_target(
                        render(target, camera, one, blur=0.8, noise=2.0, random=random), target
                    )
                    for one in some
                ]
                for camera, some in ((LEFT, poses), (RIGHT, [RIG @ one for one in poses]))
            ]
            found = calibrate_stereo(*sides)
            for what, value in zip(
                names, (1e3 * _error(found), 1e3 * found.held_out, found.rms), strict=True
            ):
                values[name][what].append(value)
    notes = {
        name: f"held-out error {np.median(one['held out']):.4f} mm, residuals "
        f"{np.median(one['residuals']):.4f} px"
        for name, one in values.items()
    }
    yield Comparison(
        "stereo",
        f"{count} rendered pairs: rms error of points in space, checkerboard over dots",
        Series("checkerboard", "mm", values["checkerboard"]["true"]),
        Series("dots", "mm", values["dots"]["true"]),
        "ratio",
        None,
        "; ".join(f"{name}: {note}" for name, note in notes.items()),
    )


def _bent(plan: Plan) -> Comparison:
    """Compare a bent sheet whose shape is found with one that is taken as exact."""
    errors: dict[str, list[float]] = {"auto": [], "exact": []}
    count = plan.operations(PAIRS, least=FEW)
    for number in range(1 if plan.quick else min(plan.rounds, 3)):
        random = np.random.default_rng(number)
        bent = BOARD.points + 1e-4 * random.normal(size=BOARD.points.shape)
        bent[:, 2] += 1e-3 * np.sin(np.pi * bent[:, 0] / 0.2)
        poses = _poses(number, count)
        sides = [
            [_seen(camera, one, bent, random) for one in some]
            for camera, some in ((LEFT, poses), (RIGHT, [RIG @ one for one in poses]))
        ]
        errors["auto"].append(1e3 * _error(calibrate_stereo(*sides)))
        errors["exact"].append(1e3 * _error(calibrate_stereo(*sides, sheet="exact")))
    return Comparison(
        "stereo",
        f"{count} pairs of a sheet bent by 1 mm: rms error of points in space, its shape found",
        Series("auto", "mm", errors["auto"]),
        Series("exact", "mm", errors["exact"]),
        "ratio",
    )


def _seen(
    camera: CameraModel, pose: Transform, points: Array, random: np.random.Generator
) -> TargetView:
    sigma = 0.03
    pixels = camera.project(pose.apply(points)) + sigma * random.normal(size=(len(points), 2))
    return TargetView(
        target=BOARD,
        size=camera.size,
        ids=np.arange(len(points)),
        points=pixels,
        covariance=np.tile(sigma**2 * np.eye(2), (len(points), 1, 1)),
    )
