"""Lenses, a rig of cameras and poses of targets, adjusted together to the least reprojection error.

Each target pose concerns its own views alone, so the six unknowns of each are eliminated; see
:mod:`smartcam.calibration._least_squares`.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from smartcam.calibration._geometry.rigid import IDENTITY, Rigid
from smartcam.calibration._least_squares import Normal, minimize
from smartcam.calibration._lens.projection import excess, linearize, pose_changes, whitening

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.calibration._geometry.rotations import Array
    from smartcam.calibration._lens.model import CameraModel
    from smartcam.calibration._views import TargetView

SETTLED: Final = 1e-7
"""Part of the weighted squares by which the last step still lowers them: of 1000 coordinates it is
a hundredth of a standard deviation."""

Indices: TypeAlias = np.ndarray[tuple[int], np.dtype[np.intp]]
"""Numbers of things."""


class Sight(NamedTuple):
    """One view."""

    camera: int  # number of the camera
    pose: int  # number of the target's pose
    view: TargetView


@dataclass(frozen=True, slots=True)
class Bundle:
    """All that is adjusted."""

    cameras: tuple[CameraModel, ...]
    rig: Rigid  # of the further cameras, from the first camera's frame into their own
    poses: Rigid  # of the targets, into the first camera's frame; one that no view shows stays
    # of each camera (4 + K, F): by how much fx, fy, cx, cy and the K coefficients change with each
    # of its F unknowns; (4 + K, 0) for a lens that is known
    basis: tuple[Array, ...]
    rigid: bool = False  # whether ``rig`` is known
    # (T, 3), of the target, metres, where they are not as they were meant to be; they are not
    # adjusted here
    points: Array | None = None

    @classmethod
    def single(
        cls,
        camera: CameraModel,
        poses: Rigid,
        basis: Array | None = None,
        points: Array | None = None,
    ) -> Bundle:
        """Return that of one camera; without a basis its lens is known."""
        known = known_lens(camera) if basis is None else basis
        return cls((camera,), Rigid.stacked([]), poses, (known,), points=points)

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

    def from_first(self, camera: int) -> Rigid:
        """Return the motion from the first camera's frame into that of a camera."""
        return self.rig.taken(camera - 1) if camera else IDENTITY

    def moved(self, shared: Array, poses: Array) -> Bundle:
        """Return it changed by the shared unknowns (S,) and by those of the poses (P, 6)."""
        columns = self.lens_columns
        cameras = tuple(
            with_lens(camera, lens_values(camera) + basis @ shared[some]) if basis.size else camera
            for camera, basis, some in zip(self.cameras, self.basis, columns, strict=True)
        )
        rig = self.rig
        if not self.rigid and rig.size:
            rig = rig.turned_after(shared[columns[-1].stop :].reshape(-1, 6))
        return dataclasses.replace(
            self, cameras=cameras, rig=rig, poses=self.poses.turned_after(poses)
        )


def known_lens(camera: CameraModel) -> Array:
    """Return the basis (4 + K, 0) of a lens that is known."""
    return np.zeros((4 + len(camera.distortion), 0))


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
class AdjustedBundle:
    """What an adjustment leads to."""

    bundle: Bundle  # the values with the least weighted squares
    residuals: list[Array]  # of each sight (N, 2), seen minus projected, pixels
    weighted: float  # sum of the weighted squares; infinite where points lie behind a camera
    more: float  # variance that each coordinate was given beside its own, pixels^2
    covariance: Array  # (S, S), of the shared unknowns; NaN where ``weighted`` is infinite
    pose_covariance: Array  # (P, 6, 6), of each pose
    freedom: int  # coordinates less unknowns


def adjust_weighted(bundle: Bundle, sights: Sequence[Sight], more: float = 0.0) -> AdjustedBundle:
    """Return the least squares with weights that fit their residuals.

    What the residuals show beside the points' covariance (a lens that is not quite of its model, a
    sheet that is not quite flat) is taken as one variance of all points and is found together with
    the fit.
    """
    # Weights need the variance, and the variance needs the residuals: in turns. The fit depends
    # little on the weights, so the second turn hardly changes anything.
    covariance = np.concatenate([sight.view.covariance for sight in sights])
    for _ in range(3):
        adjusted = adjust(bundle, sights, more)
        found = excess(np.concatenate(adjusted.residuals), covariance, adjusted.freedom)
        if abs(found - more) <= 0.01 * more:
            return adjusted
        bundle, more = adjusted.bundle, found
    return adjust(bundle, sights, more)


def adjust(bundle: Bundle, sights: Sequence[Sight], more: float) -> AdjustedBundle:
    """Return the least squares, each point weighted by its covariance and ``more`` variance."""
    scene = _FixedPart(bundle, sights, more)
    bundle, normal = minimize(bundle, scene.normal, Bundle.moved, gain=SETTLED)
    covariance, pose_covariance = normal.covariance()
    count = 2 * sum(len(sight.view.ids) for sight in sights)
    seen = len({sight.pose for sight in sights})
    return AdjustedBundle(
        bundle=bundle,
        residuals=scene.residuals(bundle),
        weighted=normal.cost,
        more=more,
        covariance=covariance,
        pose_covariance=pose_covariance,
        freedom=count - bundle.shared - 6 * seen - _free_points(bundle, sights),
    )


def _free_points(bundle: Bundle, sights: Sequence[Sight]) -> int:
    """Return the number of unknowns of the target's points; as a whole they keep 7 of them."""
    if bundle.points is None:
        return 0
    return 3 * len(np.unique(np.concatenate([one.view.ids for one in sights]))) - 7


class _Group(NamedTuple):
    """All that one camera sees, in one array."""

    camera: int
    sights: list[int]  # numbers of its views
    poses: list[int]  # of each of its views
    bounds: list[slice]  # rows of each of its views
    rows: Indices  # pose of each row (N,)
    points: Array  # (N, 3), on the targets, metres
    pixels: Array  # (N, 2)
    white: Array  # (N, 2, 2)


class _FixedPart:
    """What does not change while a bundle is adjusted."""

    def __init__(self, bundle: Bundle, sights: Sequence[Sight], more: float) -> None:
        cameras, poses = len(bundle.cameras), bundle.poses.size
        self._poses = poses
        self._count = len(sights)
        self._seen = np.isin(np.arange(poses), [one.pose for one in sights])
        chosen = ([i for i, one in enumerate(sights) if one.camera == k] for k in range(cameras))
        self._groups = [
            _group(camera, [sights[i] for i in some], some, more, bundle.points)
            for camera, some in enumerate(chosen)
            if some
        ]

    def normal(self, bundle: Bundle) -> Normal:
        """Return the normal equations."""
        columns, normal = bundle.lens_columns, Normal.nothing(bundle.shared, self._poses, 6)
        normal.own[~self._seen] = np.eye(6)  # poses that nothing moves stay
        cost = 0.0
        for group in self._groups:
            number = group.camera
            turned = np.einsum("nij,nj->ni", bundle.poses.rotation[group.rows], group.points)
            near = turned + bundle.poses.translation[group.rows]
            rig = bundle.from_first(number)
            there = near @ rig.rotation.T
            seen = linearize(there + rig.translation, bundle.cameras[number])
            # p = R_c (R m + t) + t_c moves with a pose' turn by R_c (w x R m), with the rig's by
            # w x (R_c (R m + t)); see pose_changes.
            own = np.arange(columns[number].start, columns[number].stop)
            parts = [
                pose_changes(seen.by_point @ rig.rotation, turned),
                seen.by_lens @ bundle.basis[number],
            ]
            if number and not bundle.rigid:
                start = columns[-1].stop + 6 * (number - 1)
                own = np.concatenate([own, np.arange(start, start + 6)])
                parts.append(pose_changes(seen.by_point, there))
            parts.append((group.pixels - seen.pixels)[..., None])
            jacobian = group.white @ np.concatenate(parts, axis=2)
            for pose, some in zip(group.poses, group.bounds, strict=True):
                rows = jacobian[some].reshape(-1, jacobian.shape[2])
                product = rows.T @ rows  # of the pose', the shared columns and the residuals
                normal.own[pose] += product[:6, :6]
                normal.own_right[pose] += product[:6, -1]
                normal.mixed[pose][:, own] += product[:6, 6:-1]
                normal.shared[np.ix_(own, own)] += product[6:-1, 6:-1]
                normal.shared_right[own] += product[6:-1, -1]
                cost += float(product[-1, -1])
        return normal._replace(cost=cost if math.isfinite(cost) else math.inf)

    def residuals(self, bundle: Bundle) -> list[Array]:
        """Return them by view, in the order of the sights."""
        found: dict[int, Array] = {}
        for group in self._groups:
            for number, pose, rows in zip(group.sights, group.poses, group.bounds, strict=True):
                whole = bundle.from_first(group.camera) @ bundle.poses.taken(pose)
                seen = bundle.cameras[group.camera].project(whole.apply(group.points[rows]))
                found[number] = group.pixels[rows] - seen
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
