"""Adjust lenses, a rig of cameras and poses of targets together to the least reprojection error.

If a sheet is not exact, its points are adjusted, too, in the same equations. Each
target pose affects only its own views, so its six unknowns are eliminated; see
:mod:`smartcam.calibration._least_squares`.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from smartcam.calibration._jackknife import weighted_jackknife
from smartcam.calibration._least_squares import (
    NormalEquations,
    inverse_scaled,
    minimize,
    solve_scaled,
)
from smartcam.calibration._lens.projection import excess, linearize, pose_changes, whitening
from smartcam.geometry._inside import IDENTITY, Rigid

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from smartcam.calibration._views import TargetView
    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array

SETTLED_COST_RATIO: Final = 1e-7
"""A fit ends when a step lowers the weighted squares by less than this part: with 1000 coordinates
it is then a hundredth of a standard deviation from the minimum."""

LOOSE_SIGMA_RATIO: Final = 0.01
"""Assumed standard deviation of a sheet's points, as a part of their distance to the next. With six
recorded views a tenth makes the held-out error 1.7 times as large as an exact sheet does, a
hundredth 1.1; with many views both give the same (measured)."""

TIGHT_SIGMA_RATIO: Final = 1e-4
"""Assumed standard deviation of the place, direction and size of a sheet's points as a whole, which
no view shows, as a part of their distance to the next."""

WEIGHT_POWER: Final = 1 / 3
"""Power of a view's weight in the covariance of a lens. With 1/2 halves of recorded sets differ by
1.2 times as much as expected; with 0 they differ by 0.8 times as much, and simulated lenses by 0.7
(measured)."""

SETTLED_REFIT_RATIO: Final = 1e-5
"""A fit without one of the poses ends when a step lowers the weighted squares by less than this
part."""

MAX_FEW_POSES: Final = 5
"""With at most this many poses, leaving one out changes the fit too much for a single step."""

MAX_ONE_STEP_COST_RATIO: Final = 1.2
"""A single step is not enough if the cost without a pose is more than this many times the cost that
the step predicts, as happens when a lens' coefficients compensate each other."""

Indices: TypeAlias = np.ndarray[tuple[int, ...], np.dtype[np.intp]]
"""An array of indices."""


class Sight(NamedTuple):
    """One view: a camera has at most one of each pose."""

    camera: int  # index of the camera
    pose: int  # index of the target's pose
    view: TargetView


@dataclass(frozen=True, slots=True)
class Bundle:
    """All values that are adjusted."""

    cameras: tuple[CameraModel, ...]
    rig: Rigid  # poses of the further cameras, from the first camera's frame into their own
    # poses of the targets, into the first camera's frame; one that no view shows stays
    poses: Rigid
    # for each camera (4 + K, F): how fx, fy, cx, cy and the K coefficients change with each of its
    # F unknowns; (4 + K, 0) for a lens that is known
    basis: tuple[Array, ...]
    rigid: bool = False  # whether ``rig`` is known and not adjusted
    # (T, 3), points of the target, metres, if they are not the nominal ones
    points: Array | None = None
    free: bool = False  # whether ``points`` are adjusted; then they must be given

    @classmethod
    def single(
        cls,
        camera: CameraModel,
        poses: Rigid,
        basis: Array | None = None,
        points: Array | None = None,
    ) -> Bundle:
        """Return the bundle of one camera; without a basis its lens is known."""
        known = known_lens(camera) if basis is None else basis
        return cls((camera,), Rigid.stacked([]), poses, (known,), points=points)

    def known(self) -> Bundle:
        """Return the bundle with only the poses to adjust."""
        lenses = tuple(known_lens(camera) for camera in self.cameras)
        return dataclasses.replace(self, basis=lenses, rigid=True, free=False)

    @property
    def lens_columns(self) -> list[slice]:
        """Slices of each camera's unknowns among the shared ones."""
        ends = np.cumsum([0, *(basis.shape[1] for basis in self.basis)]).tolist()
        return [slice(first, last) for first, last in itertools.pairwise(ends)]

    @property
    def of_cameras(self) -> int:
        """Number of unknowns of the cameras: the lenses', then 6 of each further camera."""
        lenses = sum(int(basis.shape[1]) for basis in self.basis)
        return lenses + (0 if self.rigid else 6 * (len(self.cameras) - 1))

    @property
    def shared(self) -> int:
        """Number of unknowns that all views share: the cameras', then 3 of each free point."""
        free = self.points.size if self.free and self.points is not None else 0
        return self.of_cameras + free

    def from_first(self, camera: int) -> Rigid:
        """Return the motion from the first camera's frame into that of a camera."""
        return self.rig.subset(camera - 1) if camera else IDENTITY

    def moved(self, shared: Array, poses: Array) -> Bundle:
        """Return the bundle after steps of the shared unknowns (S,) and of the poses (P, 6)."""
        columns = self.lens_columns
        cameras = tuple(
            with_lens(camera, lens_values(camera) + basis @ shared[part]) if basis.size else camera
            for camera, basis, part in zip(self.cameras, self.basis, columns, strict=True)
        )
        rig, points = self.rig, self.points
        if not self.rigid and rig.size:
            rig = rig.turned_after(shared[columns[-1].stop : self.of_cameras].reshape(-1, 6))
        if points is not None and self.free:
            points = points + shared[self.of_cameras :].reshape(-1, 3)
        return dataclasses.replace(
            self, cameras=cameras, rig=rig, poses=self.poses.turned_after(poses), points=points
        )

    def camera_changes(self, other: Bundle) -> Array:
        """Return the cameras' unknowns of another bundle minus those of this one."""
        lenses = [
            np.linalg.pinv(basis) @ (lens_values(to) - lens_values(camera))
            for camera, to, basis in zip(self.cameras, other.cameras, self.basis, strict=True)
        ]
        return np.concatenate([*lenses, *([] if self.rigid else self.rig.steps_to(other.rig))])


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
    """The result of adjusting a bundle."""

    bundle: Bundle  # bundle with the least weighted squares
    residuals: list[Array]  # residuals of each sight (N, 2), seen minus projected, pixels
    weighted: float  # sum of the weighted squares; infinite if points lie behind a camera
    more: float  # variance that was added to that of each coordinate, pixels^2
    normal: NormalEquations  # normal equations at the solution
    freedom: int  # number of coordinates minus number of unknowns

    @property
    def by_noise(self) -> Array:
        """Covariance of the cameras' unknowns if the errors of all points were independent.

        It is far too small if the points of a view share errors, but shows what the views do not
        determine. NaN if ``weighted`` is infinite.
        """
        count = self.bundle.of_cameras
        if not math.isfinite(self.weighted):
            return np.full((count, count), np.nan)
        # the inverse's upper left block is that of Schur's complement: see
        # NormalEquations.covariance
        matrix = self.normal.eliminate_poses()[0]
        between, points = matrix[:count, count:], matrix[count:, count:]
        return inverse_scaled(matrix[:count, :count] - between @ np.linalg.solve(points, between.T))

    @property
    def pose_covariance(self) -> Array:
        """Covariance of each pose (P, 6, 6)."""
        return self.normal.covariance()[1]

    @property
    def rms(self) -> float:
        """Standard deviation of a coordinate of the residuals, pixels."""
        squares = sum(float((residual**2).sum()) for residual in self.residuals)
        return math.sqrt(squares / max(self.freedom, 1))


def adjust_weighted(bundle: Bundle, sights: Sequence[Sight], more: float = 0.0) -> AdjustedBundle:
    """Return the least-squares solution with weights that match its residuals.

    Residuals beyond the points' covariance (from a lens that does not quite follow its model, or a
    sheet that is not quite flat) are taken as one additional variance of all points, which is
    estimated together with the fit.
    """
    # Weights need the variance, and the variance needs the residuals, so both are computed in
    # turns. The fit depends little on the weights, so the second turn hardly changes anything.
    covariance = np.concatenate([sight.view.covariance for sight in sights])
    for _ in range(3):
        adjusted = adjust(bundle, sights, more)
        covariance_excess = excess(np.concatenate(adjusted.residuals), covariance, adjusted.freedom)
        if abs(covariance_excess - more) <= 0.01 * more:
            return adjusted
        bundle, more = adjusted.bundle, covariance_excess
    return adjust(bundle, sights, more)


def adjust(
    bundle: Bundle, sights: Sequence[Sight], more: float, gain: float = SETTLED_COST_RATIO
) -> AdjustedBundle:
    """Return the least-squares solution, each point weighted by its covariance plus ``more``.

    ``more`` is a variance, pixels^2. The fit ends when a step lowers the weighted squares by less
    than the part ``gain``.
    """
    normal_at = BundleEquations(bundle, sights, more).normal
    bundle, normal = minimize(bundle, normal_at, Bundle.moved, min_gain=gain)
    count = 2 * sum(len(sight.view.ids) for sight in sights)
    seen = len({sight.pose for sight in sights})
    return AdjustedBundle(
        bundle=bundle,
        residuals=residuals(bundle, sights),
        weighted=normal.cost,
        more=more,
        normal=normal,
        freedom=count - bundle.of_cameras - 6 * seen - (free_points(sights) if bundle.free else 0),
    )


class LeftOut(NamedTuple):
    """One pose, with cameras that were fitted without its views."""

    pose: int
    bundle: Bundle  # cameras and sheet, fitted without the pose's views
    # residuals of each of the pose's views (N, 2), pixels, after fitting the pose alone to them
    residuals: list[Array]
    # covariance of the cameras' unknowns without the pose's views, if the errors of all points were
    # independent with a variance of 1
    by_noise: Array


def leave_out(adjusted: AdjustedBundle, sights: Sequence[Sight]) -> list[LeftOut]:
    """Leave out each observed pose in turn, by a single step or, if needed, a new fit."""
    # At the solution the normal equations without a pose are all less its own, both with their
    # poses eliminated: their solution is Gauss' and Newton's step from the whole fit to that
    # without the pose. The rest is of second order in the pull of the pose on the others.
    # Source: Cook and Weisberg, Residuals and Influence in Regression (1982), section 2.2.
    matrix, right, _, _ = adjusted.normal.eliminate_poses()
    count, left_out = adjusted.bundle.of_cameras, []
    poses = sorted({sight.pose for sight in sights})
    for pose in poses:
        sights_of_pose = [sight._replace(pose=0) for sight in sights if sight.pose == pose]
        bundle = dataclasses.replace(adjusted.bundle, poses=adjusted.bundle.poses.subset([pose]))
        equations = BundleEquations(bundle, sights_of_pose, adjusted.more, prior=False)
        at = equations.normal(bundle)
        part = at.eliminate_poses()
        wanted = np.column_stack([right - part[1], np.eye(len(right), count)])
        step, by_noise = np.split(solve_scaled(matrix - part[0], wanted), [1], axis=1)
        shared = step[:, 0]
        without = bundle.moved(shared, part[3] - part[2] @ shared)
        squares = at.cost - float((at.pose_right * part[3]).sum()) - 2.0 * part[1] @ shared
        squares += float(shared @ part[0] @ shared)
        if (
            len(poses) <= MAX_FEW_POSES
            or not equations.normal(without).cost <= MAX_ONE_STEP_COST_RATIO * squares
        ):
            without = _fitted_without(adjusted, sights, pose, sights_of_pose)
        left_out.append(
            LeftOut(pose, without, residuals(without, sights_of_pose), by_noise[:count])
        )
    return left_out


def _fitted_without(
    adjusted: AdjustedBundle, sights: Sequence[Sight], pose: int, sights_of_pose: Sequence[Sight]
) -> Bundle:
    """Fit the cameras to all views but those of one pose, then this pose to its views."""
    others = [sight for sight in sights if sight.pose != pose]
    anew = adjust(adjusted.bundle, others, adjusted.more, SETTLED_REFIT_RATIO).bundle
    without = dataclasses.replace(anew, poses=adjusted.bundle.poses.subset([pose]))
    at = adjust(without.known(), sights_of_pose, adjusted.more).bundle.poses
    return dataclasses.replace(without, poses=at)


def camera_covariance(adjusted: AdjustedBundle, left_out: Sequence[LeftOut]) -> Array:
    """Return the covariance of the cameras' unknowns from the scatter between views.

    ``left_out``: all poses, each once.
    """
    changes = [adjusted.bundle.camera_changes(left.bundle) for left in left_out]
    spreads = np.array([left.by_noise for left in left_out])
    return weighted_jackknife(np.array(changes), spreads, adjusted.by_noise, WEIGHT_POWER)


def free_points(sights: Sequence[Sight]) -> int:
    """Return the number of unknowns of the visible points, less 7 for their pose and size."""
    return 3 * len(np.unique(np.concatenate([sight.view.ids for sight in sights]))) - 7


class _Group(NamedTuple):
    """All N points that one camera sees."""

    camera: int
    poses: list[int]  # index of the pose of each of its views
    bounds: list[slice]  # number of points in each of its views
    pose: Indices  # (N,), index of the pose of each point
    ids: Indices  # (N,), index of each point on the target
    pixels: Array  # (N, 2), pixels
    white: Array  # (N, 2, 2), whitening of each point's residual


def _group(camera: int, sights: Sequence[Sight], more: float) -> _Group:
    views, poses = [sight.view for sight in sights], [sight.pose for sight in sights]
    ends = np.cumsum([0, *(len(view.ids) for view in views)])
    return _Group(
        camera,
        poses,
        bounds=[slice(first, last) for first, last in itertools.pairwise(ends.tolist())],
        pose=np.repeat(poses, np.diff(ends)),
        ids=np.concatenate([view.ids for view in views]),
        pixels=np.concatenate([view.points for view in views]),
        white=whitening(np.concatenate([view.covariance for view in views]), more),
    )


class BundleEquations:
    """The parts of a bundle's equations that do not change while the bundle is adjusted.

    ``prior``: whether free points are held at their nominal places, within
    LOOSE_SIGMA_RATIO and TIGHT_SIGMA_RATIO.
    """

    def __init__(
        self,
        bundle: Bundle,
        sights: Sequence[Sight],
        more: float,
        *,
        prior: bool = True,
    ) -> None:
        sides = (
            [sight for sight in sights if sight.camera == k] for k in range(len(bundle.cameras))
        )
        self._groups = [_group(k, side, more) for k, side in enumerate(sides) if side]
        self._unseen = ~np.isin(np.arange(bundle.poses.size), [sight.pose for sight in sights])
        self._meant = sights[0].view.target.points
        self._prior = _prior(self._meant) if prior and bundle.free else None

    def normal(self, bundle: Bundle) -> NormalEquations:
        """Return the normal equations."""
        normal, cost = NormalEquations.zeros(bundle.shared, bundle.poses.size, 6), 0.0
        normal.pose_blocks[self._unseen] = np.eye(
            6
        )  # poses without an observation stay as they are
        matrix, right = normal.shared, normal.shared_right
        for group in self._groups:
            columns, jacobian, by_points = self._columns(bundle, group)
            for pose, rows_of_pose in zip(group.poses, group.bounds, strict=True):
                rows = jacobian[rows_of_pose]
                flat = rows.reshape(-1, rows.shape[2])
                # derivatives by the pose, by the shared unknowns, and the residuals
                product = flat.T @ flat
                normal.pose_blocks[pose] += product[:6, :6]
                normal.pose_right[pose] += product[:6, -1]
                normal.coupling[pose][:, columns] += product[:6, 6:-1]
                matrix[np.ix_(columns, columns)] += product[6:-1, 6:-1]
                right[columns] += product[6:-1, -1]
                cost += float(product[-1, -1])
                if not bundle.free:
                    continue
                turned = by_points[rows_of_pose].swapaxes(1, 2)
                places = bundle.of_cameras + 3 * group.ids[rows_of_pose, None] + np.arange(3)
                between = (turned @ rows).reshape(places.size, -1)
                matrix[places[:, :, None], places[:, None, :]] += turned @ by_points[rows_of_pose]
                matrix[np.ix_(places.ravel(), columns)] += between[:, 6:-1]
                matrix[np.ix_(columns, places.ravel())] += between[:, 6:-1].T
                right[places.ravel()] += between[:, -1]
                normal.coupling[pose][:, places.ravel()] += between[:, :6].T
        if bundle.points is not None and self._prior is not None:
            # minimise also |p - nominal|^2 / loose^2, and the same of the whole sheet: see _prior
            sheet, shift = slice(bundle.of_cameras, bundle.shared), bundle.points - self._meant
            pull = self._prior @ shift.ravel()
            matrix[sheet, sheet] += self._prior
            right[sheet] -= pull
            cost += float(shift.ravel() @ pull)
        return normal._replace(cost=cost if math.isfinite(cost) else math.inf)

    def _columns(self, bundle: Bundle, group: _Group) -> tuple[Indices, Array, Array]:
        """Return the indices of a camera's shared unknowns, and the derivatives of its pixels.

        Whitened, (N, 2, ...): by the pose, by these unknowns, and the residuals in one; by the
        points on the target (N, 2, 3).
        """
        # p = R_c (R m + t) + t_c moves with a pose's turn by R_c (w x R m), with the rig's by
        # w x (R_c (R m + t)), with the point by R_c R; see pose_changes.
        number, rig, pose = group.camera, bundle.from_first(group.camera), bundle.poses
        points, rotation = self._meant if bundle.points is None else bundle.points, pose.rotation
        turned = np.einsum("nij,nj->ni", rotation[group.pose], points[group.ids])
        rotated = (turned + pose.translation[group.pose]) @ rig.rotation.T
        seen = linearize(rotated + rig.translation, bundle.cameras[number])
        by_near = seen.by_point @ rig.rotation
        places = [np.arange(bundle.shared)[bundle.lens_columns[number]]]
        parts = [pose_changes(by_near, turned), seen.by_lens @ bundle.basis[number]]
        if number and not bundle.rigid:
            places.append(bundle.lens_columns[-1].stop + 6 * (number - 1) + np.arange(6))
            parts.append(pose_changes(seen.by_point, rotated))
        parts.append((group.pixels - seen.pixels)[..., None])
        by_point = group.white @ (by_near @ rotation[group.pose]) if bundle.free else by_near
        return np.concatenate(places), group.white @ np.concatenate(parts, axis=2), by_point


def residuals(bundle: Bundle, sights: Iterable[Sight]) -> list[Array]:
    """Return the residuals of each view (N, 2), seen minus projected, pixels."""
    per_view = []
    for number, pose, view in sights:
        points = view.object_points if bundle.points is None else bundle.points[view.ids]
        in_camera = (bundle.from_first(number) @ bundle.poses.subset(pose)).apply(points)
        per_view.append(view.points - bundle.cameras[number].project(in_camera))
    return per_view


def _prior(nominal: Array) -> Array:
    """Return the weights (3 T, 3 T) that hold a sheet's points near their nominal places.

    Single points are held loosely; their common shift, turn and scale, which move no pixel, firmly.
    """
    spacing = float(np.linalg.norm(nominal[1:] - nominal[0], axis=1).min())
    centred, axes = nominal - nominal.mean(axis=0), np.eye(3)
    moves = [
        *(np.cross(axis, centred) for axis in axes),
        *(0.0 * centred + axis for axis in axes),
        centred,
    ]
    motions = np.linalg.qr(np.column_stack([move.ravel() for move in moves]))[0]
    weights: Array = motions @ motions.T / (TIGHT_SIGMA_RATIO * spacing) ** 2
    return weights + np.eye(3 * len(nominal)) / (LOOSE_SIGMA_RATIO * spacing) ** 2
