"""Lenses, a rig of cameras and poses of targets, adjusted together to the least reprojection error.

Each target pose concerns its own views alone, so the six unknowns of each are eliminated from the
normal equations before what all views share is solved: time grows with the number of views, not
with its cube.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from smartcam.calibration.lens.projection import (
    excess,
    linearize,
    pose_changes,
    turned,
    whitening,
)
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.calibration.geometry.rotations import Array
    from smartcam.calibration.lens.model import CameraModel
    from smartcam.calibration.views import TargetView

__all__ = [
    "IDENTITY",
    "Adjusted",
    "Bundle",
    "Indices",
    "Motion",
    "Sight",
    "adjust",
    "adjust_weighted",
    "lens_values",
    "with_lens",
]

STEPS: Final = 100
"""Of an adjustment at most; from a linear solution it takes about ten."""

SETTLED: Final = 1e-7
"""Part of the weighted squares by which the last step still lowers them: of 1000 coordinates it is
a hundredth of a standard deviation."""

LEAST_DAMPING: Final = 1e-9
MOST_DAMPING: Final = 1e9


Indices: TypeAlias = np.ndarray[tuple[int], np.dtype[np.intp]]
"""Numbers of things."""


class Motion(NamedTuple):
    """A rigid motion.

    Attributes:
        rotation: (3, 3).
        translation: (3,), metres.
    """

    rotation: Array
    translation: Array

    def moved(self, change: Array) -> Motion:
        """Return it after a small turn and shift (6,) in the frame that it leads to."""
        return Motion(turned(change[:3], self.rotation), self.translation + change[3:])


IDENTITY: Final = Motion(np.eye(3), np.zeros(3))
"""No motion."""


class Sight(NamedTuple):
    """One view.

    Attributes:
        camera: number of the camera.
        pose: number of the target's pose.
        view: what it saw.
    """

    camera: int
    pose: int
    view: TargetView


@dataclass(frozen=True, slots=True)
class Bundle:
    """All that is adjusted.

    Attributes:
        cameras: the lenses.
        rig: of each camera, from the first camera's frame into its own.
        poses: of the targets, into the first camera's frame; one that no view shows stays.
        basis: of each camera (4 + K, F): by how much fx, fy, cx, cy and the K coefficients change
            with each of its F unknowns; (4 + K, 0) for a lens that is known.
        rigid: whether ``rig`` is known.
        points: (T, 3), of the target, metres, where they are not as they were meant to be; they are
            not adjusted here.
    """

    cameras: tuple[CameraModel, ...]
    rig: tuple[Motion, ...]
    poses: tuple[Motion, ...]
    basis: tuple[Array, ...]
    rigid: bool = False
    points: Array | None = None

    @property
    def lens_columns(self) -> list[slice]:
        """Where each camera's unknowns stand among the shared ones."""
        ends = np.cumsum([0, *(one.shape[1] for one in self.basis)]).tolist()
        return [slice(first, last) for first, last in itertools.pairwise(ends)]

    @property
    def shared(self) -> int:
        """Number of unknowns that all views share: the lenses', then 6 of each further camera."""
        lenses = sum(int(one.shape[1]) for one in self.basis)
        return lenses + (0 if self.rigid else 6 * (len(self.cameras) - 1))

    def moved(self, shared: Array, poses: Array) -> Bundle:
        """Return it changed by the shared unknowns (S,) and by those of the poses (P, 6)."""
        columns = self.lens_columns
        cameras = tuple(
            with_lens(camera, lens_values(camera) + basis @ shared[some])
            for camera, basis, some in zip(self.cameras, self.basis, columns, strict=True)
        )
        rig = self.rig
        if not self.rigid:
            changes = shared[columns[-1].stop :].reshape(-1, 6)
            further = zip(self.rig[1:], changes, strict=True)
            rig = (self.rig[0], *(one.moved(change) for one, change in further))
        return dataclasses.replace(
            self,
            cameras=cameras,
            rig=rig,
            poses=tuple(one.moved(change) for one, change in zip(self.poses, poses, strict=True)),
        )


def lens_values(camera: CameraModel) -> Array:
    """Return fx, fy, cx, cy and the coefficients (4 + K,)."""
    (fx, _, cx), (_, fy, cy), _ = camera.matrix
    return np.concatenate([[fx, fy, cx, cy], camera.distortion])


def with_lens(camera: CameraModel, values: Array) -> CameraModel:
    """Return a camera with other values, as :func:`lens_values` gives them."""
    fx, fy, cx, cy = values[:4]
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return dataclasses.replace(camera, matrix=matrix, distortion=values[4:])


@dataclass(frozen=True, slots=True)
class Adjusted:
    """What an adjustment leads to.

    Attributes:
        bundle: the values with the least weighted squares.
        residuals: of each sight (N, 2), seen minus projected, pixels.
        weighted: sum of the weighted squares; infinite where points lie behind a camera.
        more: variance that each coordinate was given beside its own, pixels^2.
        covariance: (S, S), of the shared unknowns; NaN where ``weighted`` is infinite.
        pose_covariance: (P, 6, 6), of each pose.
        freedom: coordinates less unknowns.
    """

    bundle: Bundle
    residuals: list[Array]
    weighted: float
    more: float
    covariance: Array
    pose_covariance: Array
    freedom: int


def adjust_weighted(bundle: Bundle, sights: Sequence[Sight], more: float = 0.0) -> Adjusted:
    """Return the least squares with weights that fit their residuals.

    What the residuals show beside the points' covariance (a lens that is not quite of its model, a
    sheet that is not quite flat) is taken as one variance of all points and is found together with
    the fit.
    """
    covariance = np.concatenate([sight.view.covariance for sight in sights])
    for _ in range(3):
        adjusted = adjust(bundle, sights, more)
        found = excess(np.concatenate(adjusted.residuals), covariance, adjusted.freedom)
        if abs(found - more) <= 0.01 * more:
            return adjusted
        bundle, more = adjusted.bundle, found
    return adjust(bundle, sights, more)


def adjust(bundle: Bundle, sights: Sequence[Sight], more: float) -> Adjusted:
    """Return the least squares, each point weighted by its covariance and ``more`` variance."""
    scene = _Scene(bundle, sights, more)
    normal = scene.look(bundle)
    damping = 1e-4
    for _ in range(STEPS):
        if not math.isfinite(normal.weighted):
            break
        try:
            tried = bundle.moved(*normal.step(damping))
            after = scene.look(tried)
        except CalibrationError:  # a step to where there is no lens
            tried, after = bundle, _Normal.empty(0, 0, math.inf)
        gain = normal.weighted - after.weighted
        if gain < 0:
            if damping >= MOST_DAMPING or -gain <= SETTLED * normal.weighted:
                break
            damping = max(10.0 * damping, 1e-6)
            continue
        settled = gain <= SETTLED * normal.weighted
        bundle, normal = tried, after
        damping = max(damping / 10.0, LEAST_DAMPING)
        if settled:
            break
    covariance, pose_covariance = normal.covariance()
    count = 2 * sum(len(sight.view.ids) for sight in sights)
    seen = len({sight.pose for sight in sights})
    return Adjusted(
        bundle=bundle,
        residuals=scene.apart(normal.residuals),
        weighted=normal.weighted,
        more=more,
        covariance=covariance,
        pose_covariance=pose_covariance,
        freedom=count - bundle.shared - 6 * seen - _free_points(bundle, sights),
    )


def _free_points(bundle: Bundle, sights: Sequence[Sight]) -> int:
    """Return how many unknowns the target's points are; as a whole they keep 7 of them."""
    if bundle.points is None:
        return 0
    return 3 * len(np.unique(np.concatenate([one.view.ids for one in sights]))) - 7


class _Group(NamedTuple):
    """All that one camera sees, in one array.

    Attributes:
        camera: its number.
        sights: numbers of its views.
        poses: of each of its views.
        bounds: rows of each of its views.
        rows: pose of each row (N,).
        points: (N, 3), on the targets, metres.
        pixels: (N, 2).
        white: (N, 2, 2).
    """

    camera: int
    sights: list[int]
    poses: list[int]
    bounds: list[slice]
    rows: Indices
    points: Array
    pixels: Array
    white: Array


class _Scene:
    """What does not change while a bundle is adjusted."""

    def __init__(self, bundle: Bundle, sights: Sequence[Sight], more: float) -> None:
        cameras, poses = len(bundle.cameras), len(bundle.poses)
        self._poses = poses
        self._count = len(sights)
        self._seen = np.isin(np.arange(poses), [one.pose for one in sights])
        chosen = ([i for i, one in enumerate(sights) if one.camera == k] for k in range(cameras))
        self._groups = [
            _group(camera, [sights[i] for i in some], some, more, bundle.points)
            for camera, some in enumerate(chosen)
            if some
        ]

    def look(self, bundle: Bundle) -> _Normal:
        """Return residuals and normal equations."""
        columns, shared = bundle.lens_columns, bundle.shared
        normal = _Normal.empty(shared, self._poses)
        rotations = np.array([one.rotation for one in bundle.poses])
        translations = np.array([one.translation for one in bundle.poses])
        for group in self._groups:
            number = group.camera
            turned_points = np.einsum("nij,nj->ni", rotations[group.rows], group.points)
            first = turned_points + translations[group.rows]
            rig = bundle.rig[number]
            near = first @ rig.rotation.T
            seen = linearize(near + rig.translation, bundle.cameras[number])
            residuals = group.pixels - seen.pixels
            own = np.arange(columns[number].start, columns[number].stop)
            parts = [
                pose_changes(seen.by_point @ rig.rotation, turned_points),
                seen.by_lens @ bundle.basis[number],
            ]
            if number and not bundle.rigid:
                start = columns[-1].stop + 6 * (number - 1)
                own = np.concatenate([own, np.arange(start, start + 6)])
                parts.append(pose_changes(seen.by_point, near))
            parts.append(residuals[..., None])
            jacobian = group.white @ np.concatenate(parts, axis=2)
            normal.residuals.append(residuals)
            for pose, some in zip(group.poses, group.bounds, strict=True):
                rows = jacobian[some].reshape(-1, jacobian.shape[2])
                normal.add(pose, own, rows.T @ rows)
        normal.own[~self._seen] = np.eye(6)  # poses that nothing moves stay
        return normal

    def apart(self, residuals: list[Array]) -> list[Array]:
        """Return residuals by view, in the order of the sights."""
        found: dict[int, Array] = {}
        for group, some in zip(self._groups, residuals, strict=True):
            found |= {
                number: some[rows] for number, rows in zip(group.sights, group.bounds, strict=True)
            }
        return [found[number] for number in range(self._count)]


def _group(
    camera: int, sights: Sequence[Sight], numbers: list[int], more: float, points: Array | None
) -> _Group:
    views = [one.view for one in sights]
    ends = np.cumsum([0, *(len(one.view.ids) for one in sights)]).tolist()
    covariance = np.concatenate([one.view.covariance for one in sights])
    return _Group(
        camera=camera,
        sights=numbers,
        poses=[one.pose for one in sights],
        bounds=[slice(first, last) for first, last in itertools.pairwise(ends)],
        rows=np.repeat([one.pose for one in sights], np.diff(ends)),
        points=np.concatenate(
            [one.object_points if points is None else points[one.ids] for one in views]
        ),
        pixels=np.concatenate([one.view.points for one in sights]),
        white=whitening(covariance, more),
    )


@dataclass(slots=True)
class _Normal:
    """Normal equations whose matrix is an arrow.

    Attributes:
        residuals: of each group (N, 2), pixels.
        weighted: sum of the weighted squares.
        shared: (S, S).
        own: (P, 6, 6), of each pose.
        between: (P, 6, S).
        right: (S,), right side of the shared unknowns.
        own_right: (P, 6), of the poses.
    """

    residuals: list[Array]
    weighted: float
    shared: Array
    own: Array
    between: Array
    right: Array
    own_right: Array

    @classmethod
    def empty(cls, shared: int, poses: int, weighted: float = 0.0) -> _Normal:
        return cls(
            [],
            weighted,
            np.zeros((shared, shared)),
            np.zeros((poses, 6, 6)),
            np.zeros((poses, 6, shared)),
            np.zeros(shared),
            np.zeros((poses, 6)),
        )

    def add(self, pose: int, columns: Indices, product: Array) -> None:
        """Add a view's J^T J, whose columns are the pose's, shared ones and the residuals."""
        last = product.shape[0] - 1
        self.own[pose] += product[:6, :6]
        self.own_right[pose] += product[:6, last]
        self.between[pose][:, columns] += product[:6, 6:last]
        self.shared[np.ix_(columns, columns)] += product[6:last, 6:last]
        self.right[columns] += product[6:last, last]
        square = float(product[last, last])
        self.weighted += square if math.isfinite(square) else math.inf

    def reduced(self, damping: float) -> tuple[Array, Array, Array, Array]:
        """Return the shared unknowns' matrix and right side without the poses, and the poses'."""
        grown = self.own + damping * self.own * np.eye(6)
        both = np.concatenate([self.between, self.own_right[..., None]], axis=2)
        solved = np.asarray(np.linalg.solve(grown, both), dtype=np.float64)
        matrix = self.shared + damping * np.diag(np.diag(self.shared))
        matrix = matrix - np.einsum("pis,pit->st", self.between, solved[..., :-1])
        right = self.right - np.einsum("pis,pi->s", self.between, solved[..., -1])
        return matrix, right, solved[..., :-1], solved[..., -1]

    def step(self, damping: float) -> tuple[Array, Array]:
        """Return the changes of the shared unknowns (S,) and of the poses (P, 6)."""
        matrix, right, by_shared, alone = self.reduced(damping)
        if not len(right):
            return right, alone
        scale = _scale(matrix)
        shared = (
            np.linalg.lstsq(matrix / scale / scale[:, None], right / scale, rcond=None)[0] / scale
        )
        return shared, alone - by_shared @ shared

    def covariance(self) -> tuple[Array, Array]:
        """Return those of the shared unknowns (S, S) and of each pose (P, 6, 6)."""
        if not math.isfinite(self.weighted):
            return np.full_like(self.shared, np.nan), np.full_like(self.own, np.nan)
        matrix, _, by_shared, _ = self.reduced(0.0)
        scale = _scale(matrix)
        inverse = np.linalg.pinv(matrix / scale / scale[:, None], hermitian=True)
        shared = np.asarray(inverse / scale / scale[:, None], dtype=np.float64)
        poses = np.linalg.inv(self.own) + by_shared @ shared @ by_shared.swapaxes(1, 2)
        return shared, poses


def _scale(matrix: Array) -> Array:
    """Return what makes a matrix' diagonal ones."""
    diagonal = np.sqrt(np.abs(np.diag(matrix)))
    scale: Array = np.where(diagonal > 0, diagonal, 1.0)
    return scale
