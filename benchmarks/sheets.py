"""Sheets that are not what they were meant to be: how near lens and pair come to what noise allows.

A sheet is stretched, bent or uneven; what is found of it is compared with the truth, with OpenCV's
``calibrateCameraRO`` where one camera is calibrated, and with the Cramer-Rao bound of all unknowns:
lenses, pair, poses and the sheet's points, which keep place, direction and size as meant. The error
of a lens is that of its projection over the middle nine tenths of the field; that of a pair is that
of points all over the space before it.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from benchmarks.measure import Comparison, Goal, Series
from smartcam.calibration._lens.bundle import Bundle, IndexedView, adjust
from smartcam.calibration._lens.intrinsics import calibrate_intrinsics
from smartcam.calibration._lens.projection import linearize
from smartcam.calibration._lens.sheet_shape import moved_to_nominal
from smartcam.calibration._stereo.calibration import calibrate_stereo
from smartcam.calibration._stereo.triangulation import CameraPair, triangulate
from smartcam.calibration.simulation import _scenes as scenes
from smartcam.geometry import Transform
from smartcam.geometry._inside import Rigid

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from benchmarks.measure import Plan
    from smartcam.calibration._targets import Checkerboard
    from smartcam.calibration._views import TargetView
    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array

__all__ = ["KINDS", "Rig", "free_sheets", "sheet"]

RUNS = 12
"""Calibrations of one kind of sheet."""

SIGMA = 0.05
"""Of the corners, pixels."""

KINDS: dict[str, Callable[[Array, np.random.Generator], Array]] = {
    "bent by 2 mm": lambda points, _: points + _height(2e-3 * np.sin(np.pi * _part(points))),
    "stretched by 1 %": lambda points, _: points * [1.01, 1.0, 1.0],
    "stretched by 0.8 %, shrunk by 0.5 % across": lambda points, _: points * [1.008, 0.995, 1.0],
    "0.2 mm of random height": lambda points, random: (
        points + _height(2e-4 * random.normal(size=len(points)))
    ),
}


class Rig:
    """Two cameras, what they see, and where it is judged."""

    def __init__(
        self, left: CameraModel, right: CameraModel, rig: Transform, board: Checkerboard
    ) -> None:
        self.left, self.right, self.rig, self.board = left, right, rig, board
        width, height = left.size
        across, down = np.linspace(0.05, 0.95, 13) * width, np.linspace(0.05, 0.95, 10) * height
        pixels = np.stack(np.meshgrid(across, down), -1).reshape(-1, 2)
        self.rays = np.column_stack([left.directions(pixels), np.ones(len(pixels))])
        places = np.meshgrid(np.linspace(-0.12, 0.14, 7), np.linspace(-0.12, 0.12, 7), [0.35, 0.45])
        self.space = np.stack(places, -1).reshape(-1, 3)
        self.pixels = left.project(self.space), right.project(rig.apply(self.space))

    def poses(self, count: int, seed: int) -> list[Transform]:
        """Return poses of a sheet that is all over the field."""
        random, found = np.random.default_rng(seed), list[Transform]()
        around = scenes.poses_around(self.board, count, tilt=0.6, distance=0.35, random=random)
        for one in around:
            back, aside = one.inverse(), random.uniform([-0.08, -0.06, 0], [0.08, 0.06, 0])
            found.append(Transform("left", "target", back.rotation, back.translation + aside))
        return found

    def seen(
        self, points: Array, poses: Sequence[Transform], random: np.random.Generator | None
    ) -> list[list[TargetView]]:
        """Return both cameras' views of a sheet; without noise where nothing is random."""
        return [
            [self._view(camera, pose, points, random) for pose in some]
            for camera, some in (
                (self.left, poses),
                (self.right, [self.rig @ one for one in poses]),
            )
        ]

    def _view(
        self,
        camera: CameraModel,
        pose: Transform,
        points: Array,
        random: np.random.Generator | None,
    ) -> TargetView:
        exact = np.random.default_rng(0)
        flat = scenes.view(self.board, camera, pose, sigma=0.0, random=exact)
        pixels = camera.project(pose.apply(points[flat.ids]))
        if random is not None:
            pixels = pixels + SIGMA * random.normal(size=pixels.shape)
        covariance = np.tile(SIGMA**2 * np.eye(2), (len(pixels), 1, 1))
        return dataclasses.replace(flat, points=pixels, covariance=covariance)

    def lens_error(self, camera: CameraModel) -> float:
        """Return the rms error of a left lens, pixels."""
        off = camera.project(self.rays) - self.left.project(self.rays)
        return math.sqrt(float((off**2).sum(axis=1).mean()))

    def pair_error(self, points: Array) -> float:
        """Return the rms error of the points in space, mm."""
        return 1e3 * math.sqrt(float(((points - self.space) ** 2).sum(axis=1).mean()))

    def bounds(self, points: Array, poses: Sequence[Transform]) -> tuple[float, float]:
        """Return the least rms errors that noise allows: of one lens, px, and of the pair, mm."""
        views = self.seen(points, poses, None)
        motions = Rigid.stack(one.rigid for one in poses)
        columns = np.eye(4 + len(self.left.distortion))
        one = Bundle(
            (self.left,),
            Rigid.stack([]),
            motions,
            (columns,),
            points=points,
            has_free_points=True,
        )
        indexed = [IndexedView(0, number, view) for number, view in enumerate(views[0])]
        by_lens = linearize(self.rays, self.left).by_lens
        lens = np.einsum(
            "nij,jk,nik->n", by_lens, adjust(one, indexed, 0.0).noise_covariance, by_lens
        )
        both = Bundle(
            (self.left, self.right),
            Rigid.stack([self.rig.rigid]),
            motions,
            (columns, columns),
            points=points,
            has_free_points=True,
        )
        indexed += [IndexedView(1, number, view) for number, view in enumerate(views[1])]
        covariance = adjust(both, indexed, 0.0).noise_covariance
        by_unknown = self._derivatives(both, np.sqrt(np.diag(covariance)))
        space = np.einsum("nij,jk,nik->n", by_unknown, covariance, by_unknown)
        return math.sqrt(float(lens.mean())), 1e3 * math.sqrt(float(space.mean()))

    def _derivatives(self, bundle: Bundle, steps: Array) -> Array:
        """Return by how much the points in space move with the cameras' unknowns (N, 3, S)."""

        def found(change: Array) -> Array:
            unknowns = np.concatenate([change, np.zeros(bundle.shared_count - len(change))])
            moved = bundle.with_steps(unknowns, np.zeros((bundle.poses.size, 6)))
            transform = Transform("right", "left", *moved.rig.subset(0))
            each = np.tile(np.eye(2), (len(self.space), 1, 1))
            left, right = moved.cameras
            pair = CameraPair(left, right, transform)
            return triangulate(pair, self.pixels, (each, each)).points

        changes = 0.1 * np.diag(steps)
        return np.stack([(found(one) - found(-one)) / (2 * one.sum()) for one in changes], axis=-1)


def _part(points: Array) -> Array:
    part: Array = points[:, 0] / points[:, 0].max()
    return part


def _height(height: Array) -> Array:
    return np.column_stack([np.zeros((len(height), 2)), height])


def sheet(kind: str, board: Checkerboard, random: np.random.Generator) -> Array:
    """Return where the points (T, 3) of a sheet are, place, direction and size as meant."""
    return moved_to_nominal(KINDS[kind](board.points, random), board.points)


def _released(views: Sequence[TargetView]) -> Any:
    """Return what calibrateCameraRO finds: its lens."""
    whole = [one for one in views if len(one.ids) == len(one.target.points)]
    points = [one.object_points.astype(np.float32) for one in whole]
    pixels = [one.points.astype(np.float32) for one in whole]
    calibrate: Any = cv2.calibrateCameraRO
    _, matrix, bends, *_ = calibrate(points, pixels, views[0].size, 8, None, None)
    return matrix, bends


def free_sheets(plan: Plan, rig: Rig) -> Iterator[Comparison]:
    """Compare lens and pair with the bound, and with OpenCV's."""
    runs = plan.operations(RUNS, least=1)
    for kind in list(KINDS)[:1] if plan.quick else KINDS:
        for count in (12,) if plan.quick else (12, 30):
            yield from _kind(kind, count, runs, rig)


def _kind(kind: str, count: int, runs: int, rig: Rig) -> Iterator[Comparison]:
    squares: dict[str, list[float]] = {}
    chosen = 0
    for run in range(runs):
        random = np.random.default_rng(run)
        points, poses = sheet(kind, rig.board, random), rig.poses(count, run)
        lefts, rights = rig.seen(points, poses, random)
        one = calibrate_intrinsics(lefts, sheet="auto")
        both = calibrate_stereo(lefts, rights, sheet="auto")
        chosen += (one.sheet is not None) + (both.sheet is not None)
        matrix, bends = _released(lefts)
        lens_bound, pair_bound = rig.bounds(points, poses)
        other = dataclasses.replace(rig.left, matrix=matrix, distortion=np.ravel(bends)[:5])
        for name, value in (
            ("lens", rig.lens_error(one.camera)),
            ("RO", rig.lens_error(other)),
            ("lens bound", lens_bound),
            ("pair", rig.pair_error(both.triangulate(*rig.pixels))),
            ("pair bound", pair_bound),
        ):
            squares.setdefault(name, []).append(value**2)
    rms = {name: math.sqrt(float(np.mean(some))) for name, some in squares.items()}
    note = f"sheet='auto' chose free {chosen} times of {2 * runs}"
    case = f"{count} views of a sheet {kind}: error of"
    lens = Series("smartcam", "px", [rms["lens"]])
    bound = Series("Cramer-Rao bound", "px", [rms["lens bound"]])
    yield Comparison("stereo", f"{case} a lens", lens, bound, "ratio", Goal("at most", 1.15), note)
    released = Series("OpenCV's calibrateCameraRO", "px", [rms["RO"]])
    yield Comparison("stereo", f"{case} a lens", lens, released, "ratio", Goal("at most", 1.05))
    yield Comparison(
        "stereo",
        f"{case} points in space, of a pair",
        Series("smartcam", "mm", [rms["pair"]]),
        Series("Cramer-Rao bound", "mm", [rms["pair bound"]]),
        "ratio",
        Goal("at most", 1.15),
        note,
    )
