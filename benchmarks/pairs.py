"""Recorded pairs of images, in four folds: what a lens or a pair is worth where it was not fitted.

Three calibrations see the same pairs and are judged at the pairs that were left out, by one ruler:
the corners that smartcam finds there. One is smartcam's; one OpenCV's solver, of smartcam's
corners; one OpenCV's, of its own. The last is shown by its own corners, too: that is another ruler.

A printed sheet is never exactly flat. Lenses are compared twice: with the sheet taken as exact, for
the calibration and for the judgement, and with the shape of the sheet that each calibration found.

A set is *chosen by* where parameters of smartcam were chosen on it, else *unseen*.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from benchmarks.measure import Comparison, Goal, Series
from smartcam.calibration._detection.find import find_target
from smartcam.calibration._lens.intrinsics import calibrate_intrinsics
from smartcam.calibration._lens.poses import locate
from smartcam.calibration._stereo.calibration import calibrate_stereo
from smartcam.calibration._stereo.errors import pair_errors
from smartcam.calibration._stereo.triangulation import CameraPair
from smartcam.calibration._targets import Checkerboard
from smartcam.calibration._views import TargetView
from smartcam.exceptions import CalibrationError
from smartcam.geometry import CameraModel, Transform

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from benchmarks.measure import Plan
    from smartcam.geometry._inside import Array, DistortionModel

__all__ = ["SETS", "RecordedPairs", "compared", "corners", "opencv_pair"]

FOLDS = 4
STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-8)

Pair = tuple[TargetView, TargetView]


@dataclass(frozen=True, slots=True)
class RecordedPairs:
    """A set of pairs: ``left1.jpg``, ``right1.jpg`` and so on.

    Attributes:
        name: for texts.
        known: whether parameters were chosen by it.
        end: of the path of its folder.
        first: name of the first left image.
        board: what it shows.
        model: of its lenses.
    """

    name: str
    known: str
    end: str
    first: str
    board: Checkerboard
    model: DistortionModel = "plumb_bob"

    def folder(self) -> Path | None:
        """Return where it is under SMARTCAM_DATA; None where it is not."""
        under = os.environ.get("SMARTCAM_DATA")
        found = [] if under is None else sorted(Path(under).rglob(self.first))
        ends = (one.parent for one in found if one.parent.as_posix().endswith(self.end))
        return next(ends, None)


SETS = (
    RecordedPairs(
        "OpenCV's pairs",
        "odd ones chosen by, even ones unseen",
        "",
        "left01.jpg",
        Checkerboard(columns=9, rows=6, square=0.025),
    ),
    RecordedPairs(
        "sourishg's first stereo set",
        "unseen",
        "calib_imgs/1",
        "left1.jpg",
        Checkerboard(columns=9, rows=6, square=0.02423),
    ),
    RecordedPairs(
        "sourishg's second stereo set",
        "unseen",
        "calib_imgs/2",
        "left1.jpg",
        Checkerboard(columns=9, rows=6, square=0.02423),
    ),
    RecordedPairs(
        "sourishg's fisheye set",
        "unseen",
        "/imgs",
        "left1.jpg",
        Checkerboard(columns=9, rows=6, square=0.02423),
        "equidistant",
    ),
)


def corners(image: Any, near: TargetView, window: int = 0) -> TargetView | None:
    """Return OpenCV's corners, numbered as those of a view; None where it finds none.

    ``window``: half of its refinement's, pixels; 0: 0.35 of the corners' distance.
    """
    columns, rows = 9, 6
    found, first = cv2.findChessboardCorners(image, (columns, rows))
    if not found or len(near.ids) != columns * rows:
        return None
    grid = np.asarray(first, dtype=np.float64).reshape(rows, columns, 2)
    sides = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
    half = window or max(2, math.floor(0.35 * min(sides)))
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-4)
    refined = cv2.cornerSubPix(image, first, (half, half), (-1, -1), stop)
    grid = np.asarray(refined, dtype=np.float64).reshape(rows, columns, 2)
    ways = [grid, grid[::-1], grid[:, ::-1], grid[::-1, ::-1]]
    numbered = min(
        (one.reshape(-1, 2) for one in ways), key=lambda one: float(np.abs(one - near.points).sum())
    )
    return dataclasses.replace(near, points=numbered)


@functools.cache
def _pairs(one: RecordedPairs, folder: Path) -> tuple[list[Pair], list[Pair]]:
    """Return the pairs by smartcam's corners and, of those where both find all, by OpenCV's."""
    numbers = sorted(
        int(match[1])
        for path in folder.iterdir()
        if (match := re.fullmatch(r"left(\d+)\.jpg", path.name))
    )
    digits = len(one.first) - len("left.jpg")
    ours, theirs = list[Pair](), list[Pair]()
    for number in numbers:
        paths = [folder / f"{side}{number:0{digits}d}.jpg" for side in ("left", "right")]
        images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths]
        try:
            left, right = (
                find_target(np.asarray(image, dtype=np.uint8), one.board, name=path.stem)
                for image, path in zip(images, paths, strict=True)
            )
        except CalibrationError:
            continue
        ours.append((left, right))
        first, second = corners(images[0], left), corners(images[1], right)
        if first is not None and second is not None:
            theirs.append((first, second))
    return ours, theirs


def opencv_pair(pairs: Sequence[Pair], model: DistortionModel) -> CameraPair:
    """Return OpenCV's calibration of pairs."""
    size = pairs[0][0].size
    views = [[one[side] for one in pairs] for side in range(2)]
    lenses: list[Any] = []
    for some in views:
        lens = opencv_lens(some, model)
        lenses += [lens.matrix.copy(), lens.distortion.copy()]
    points, sides = _arrays(views, model)
    if model == "equidistant":
        flags = cv2.fisheye.CALIB_USE_INTRINSIC_GUESS | FISHEYE
        calibrate: Any = cv2.fisheye.stereoCalibrate
    else:
        flags, calibrate = cv2.CALIB_USE_INTRINSIC_GUESS, cv2.stereoCalibrate
    found = calibrate(points, *sides, *lenses, size, flags=flags, criteria=STOP)
    left, right = (_camera(found[place], found[place + 1], size, model) for place in (1, 3))
    return CameraPair(left, right, Transform("right", "left", found[5], found[6].ravel()))


FISHEYE = cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW


def opencv_lens(views: Sequence[TargetView], model: DistortionModel) -> CameraModel:
    """Return OpenCV's lens; a fisheye's in two steps, since one step often leads nowhere."""
    points, (pixels,) = _arrays([views], model)
    if model != "equidistant":
        calibrate: Any = cv2.calibrateCamera
        _, matrix, bends, *_ = calibrate(points, pixels, views[0].size, None, None)
        return _camera(matrix, bends, views[0].size, model)
    matrix, bends = np.zeros((3, 3)), np.zeros(4)
    held = cv2.fisheye.CALIB_FIX_K3 | cv2.fisheye.CALIB_FIX_K4
    for flags in (held, cv2.fisheye.CALIB_USE_INTRINSIC_GUESS):
        _, matrix, bends, *_ = cv2.fisheye.calibrate(
            points, pixels, views[0].size, matrix, bends, flags=FISHEYE | flags, criteria=STOP
        )
    return _camera(matrix, bends, views[0].size, model)


def opencv_lens_and_sheet(
    views: Sequence[TargetView], board: Checkerboard, model: DistortionModel
) -> tuple[CameraModel, Array]:
    """Return what calibrateCameraRO finds in whole views: the lens, and offsets (T, 3) of points.

    OpenCV keeps the first point, the last one of the first row, and the height of the last one.
    """
    whole = [view for view in views if len(view.ids) == len(board.points)]
    points, (pixels,) = _arrays([whole], model)
    calibrate: Any = cv2.calibrateCameraRO
    _, matrix, bends, _, _, released = calibrate(
        points, pixels, views[0].size, board.columns - 1, None, None
    )[:6]
    return _camera(matrix, bends, views[0].size, model), released.reshape(-1, 3) - board.points


def _arrays(
    views: Sequence[Sequence[TargetView]], model: DistortionModel
) -> tuple[list[Any], list[list[Any]]]:
    kind = np.float64 if model == "equidistant" else np.float32
    points = [one.object_points.astype(kind).reshape(-1, 1, 3) for one in views[0]]
    pixels = [[one.points.astype(kind).reshape(-1, 1, 2) for one in some] for some in views]
    return points, pixels


def _camera(matrix: Any, bends: Any, size: tuple[int, int], model: DistortionModel) -> CameraModel:
    straight = np.asarray(matrix, dtype=np.float64).copy()
    straight[0, 1] = 0.0
    return CameraModel(
        size=size, matrix=straight, distortion=np.ravel(bends), distortion_model=model
    )


def compared(plan: Plan) -> Iterator[Comparison]:
    """Compare the held-out errors of every set that is there."""
    for one in SETS[1:2] if plan.quick else SETS:
        folder = one.folder()
        if folder is not None:
            ours, theirs = _pairs(one, folder)
            yield from _set(one, ours, theirs)


def _set(one: RecordedPairs, ours: Sequence[Pair], theirs: Sequence[Pair]) -> Iterator[Comparison]:
    errors: dict[str, list[Array]] = {}
    lens: dict[str, list[Array]] = {"exact": [], "OpenCV": [], "shaped": [], "OpenCV, shaped": []}
    costs = [0.0, 0.0]
    for fold in range(FOLDS):
        rest, left_out = _folded(ours, fold)
        rest_own, left_out_own = _folded(theirs, fold)
        begin = time.process_time()
        found = calibrate_stereo(*_sides(rest), distortion_model=one.model)
        middle = time.process_time()
        same = opencv_pair(rest, one.model)
        costs = [costs[0] + middle - begin, costs[1] + time.process_time() - middle]
        own = opencv_pair(rest_own, one.model)
        fits = {"ours": CameraPair(found.left, found.right, found.transform)}
        fits |= {"OpenCV's solver": same, "all OpenCV's": own}
        for name, pair in fits.items():
            errors.setdefault(name, []).extend(
                pair_errors(pair, *some).spacing for some in left_out
            )
        errors.setdefault("all OpenCV's, by its own corners", []).extend(
            pair_errors(own, *some).spacing for some in left_out_own
        )
        for some, others in zip(_sides(rest), _sides(left_out), strict=True):
            mine = calibrate_intrinsics(some, distortion_model=one.model, sheet="exact").camera
            lens["exact"] += [_scaled(view, mine) for view in others]
            theirs_lens = opencv_lens(some, one.model)
            lens["OpenCV"] += [_scaled(view, theirs_lens) for view in others]
            free = calibrate_intrinsics(some, distortion_model=one.model)
            offsets = np.zeros_like(one.board.points) if free.sheet is None else free.sheet
            lens["shaped"] += [_shaped_residuals(view, free.camera, offsets) for view in others]
            if one.model != "equidistant":
                theirs_lens, offsets = opencv_lens_and_sheet(some, one.board, one.model)
            lens["OpenCV, shaped"] += [
                _shaped_residuals(view, theirs_lens, offsets) for view in others
            ]
    case = f"{one.name} ({one.known}), {len(ours)} in four folds"
    values = {name: 1e3 * _rms(some) for name, some in errors.items()}
    own_ruler = values["all OpenCV's, by its own corners"]
    for name in ("OpenCV's solver", "all OpenCV's"):
        whose = "of smartcam's corners" if name == "OpenCV's solver" else "of its own corners"
        yield Comparison(
            "stereo",
            f"{case}: held-out error of the squares, judged by smartcam's corners",
            Series("smartcam", "mm", [values["ours"]]),
            Series(f"OpenCV, {whose}", "mm", [values[name]]),
            "ratio",
            Goal("at most", 1.03),
            f"{own_ruler:.4f} mm is what OpenCV's has by its own corners: another ruler"
            if name == "all OpenCV's"
            else f"CPU {costs[0]:.2f} s with each pair left out, OpenCV's {costs[1]:.2f} s without",
        )
    fisheye = one.model == "equidistant"
    yield Comparison(
        "stereo",
        f"{case}: held-out error of the lenses alone, the same corners, sheets taken as exact",
        Series("smartcam", "px", [_rms(lens["exact"])]),
        Series(
            "OpenCV's fisheye.calibrate" if fisheye else "OpenCV's calibrateCamera",
            "px",
            [_rms(lens["OpenCV"])],
        ),
        "ratio",
        Goal("at most", 1.03),
    )
    yield Comparison(
        "stereo",
        f"{case}: held-out error of the lenses alone, the same corners, with the sheet's shape",
        Series("smartcam", "px", [_rms(lens["shaped"])]),
        Series(
            "OpenCV's fisheye.calibrate, with the shape that smartcam found"
            if fisheye
            else "OpenCV's calibrateCameraRO",
            "px",
            [_rms(lens["OpenCV, shaped"])],
        ),
        "ratio",
        Goal("at most", 1.03),
    )


def _folded(pairs: Sequence[Pair], fold: int) -> tuple[list[Pair], list[Pair]]:
    rest = [one for number, one in enumerate(pairs) if number % FOLDS != fold]
    return rest, [one for number, one in enumerate(pairs) if number % FOLDS == fold]


def _sides(pairs: Sequence[Pair]) -> tuple[list[TargetView], list[TargetView]]:
    return [one for one, _ in pairs], [one for _, one in pairs]


def _scaled(view: TargetView, camera: CameraModel) -> Array:
    """Return residuals of a view whose mean square is that of their freedom."""
    return _freed(locate(view, camera).residuals)


def _shaped_residuals(view: TargetView, camera: CameraModel, offsets: Array) -> Array:
    """Return such residuals of a view on a sheet whose points lie ``offsets`` (T, 3) away."""
    points = view.object_points + offsets[view.ids]
    pose = locate(view, camera).transform

    def residuals(step: Array) -> Array:
        moved = Rotation.from_rotvec(step[:3]).apply(pose.apply(points)) + step[3:]
        return np.asarray(camera.project(moved) - view.points).ravel()

    return _freed(least_squares(residuals, np.zeros(6), x_scale=[1e-2] * 3 + [1e-3] * 3).fun)


def _freed(residuals: Array) -> Array:
    """Scale residuals of a view by the freedom that its six parameters of a pose took."""
    scaled: Array = residuals * math.sqrt(residuals.size / (residuals.size - 6))
    return scaled


def _rms(parts: Sequence[Array]) -> float:
    return math.sqrt(float((np.concatenate([one.ravel() for one in parts]) ** 2).mean()))
