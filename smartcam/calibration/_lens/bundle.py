"""Adjust lenses, a rig of cameras and poses of targets together to the least reprojection error.

If a sheet is not exact, its points are adjusted in the same equations. Each target pose affects
only its own views, so its six unknowns are eliminated; see
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
from smartcam.calibration._lens.projection import (
    excess_variance,
    linearize,
    pixels_by_pose,
    whitening,
)
from smartcam.geometry._inside import IDENTITY, Rigid

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from smartcam.calibration._views import TargetView
    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array

MIN_COST_GAIN_RATIO: Final = 1e-7
"""A fit ends when a step lowers the weighted squares by less than this fraction: with 1000
coordinates the fit is then a hundredth of a standard deviation from the minimum."""

LOOSE_SIGMA_RATIO: Final = 0.01
"""Assumed standard deviation of a sheet's points, as a fraction of the distance between
neighbouring points. With six recorded views, a value of 0.1 gives 1.7 times the held-out error of
an exact sheet, a value of 0.01 gives 1.1 times; with many views both give the same (measured)."""

TIGHT_SIGMA_RATIO: Final = 1e-4
"""Assumed standard deviation of the common place, direction and size of a sheet's points, which no
view shows, as a fraction of the distance between neighbouring points."""

WEIGHT_POWER: Final = 1 / 3
"""Power of a view's weight in the covariance of a lens. With a power of 1/2, lenses from the two
halves of recorded sets differ by 1.2 times as much as expected; with a power of 0 they differ by
0.8 times as much, and simulated lenses by 0.7 times (measured)."""

MIN_REFIT_GAIN_RATIO: Final = 1e-5
"""A fit without one of the poses ends when a step lowers the weighted squares by less than this
fraction."""

MAX_FEW_POSES: Final = 5
"""With at most this many poses, leaving one out changes the fit too much for a single step, so the
fit is repeated."""

MAX_ONE_STEP_COST_RATIO: Final = 1.2
"""A single step is not enough if the cost without a pose is more than this many times the cost that
the step predicts, as happens when a lens' coefficients compensate each other."""

Indices: TypeAlias = np.ndarray[tuple[int, ...], np.dtype[np.intp]]
"""An array of indices."""


class IndexedView(NamedTuple):
    """A view with its camera and pose; of each pose, a camera has one view at most."""

    camera_index: int
    pose_index: int  # index of the target's pose
    view: TargetView


@dataclass(frozen=True, slots=True)
class Bundle:
    """The values of a fit: lenses, poses of cameras and targets, and points of the target."""

    cameras: tuple[CameraModel, ...]
    rig: Rigid  # motions from the first camera's frame into the frame of each further camera
    # ``T_camera_target`` of each pose, for the first camera; a pose without a view is not changed
    poses: Rigid
    # for each camera (4 + K, F): how fx, fy, cx, cy and the K coefficients change with each of its
    # F unknowns; (4 + K, 0) for a lens that is known
    basis: tuple[Array, ...]
    is_rig_known: bool = False  # whether ``rig`` is kept, not adjusted
    # (T, 3), points of the target, metres, if they are not the nominal ones
    points: Array | None = None
    has_free_points: bool = False  # whether ``points``, which must be given then, are adjusted

    @classmethod
    def single(
        cls,
        camera: CameraModel,
        poses: Rigid,
        basis: Array | None = None,
        points: Array | None = None,
    ) -> Bundle:
        """Return the bundle of one camera; without a basis its lens is known."""
        lens_basis = empty_basis(camera) if basis is None else basis
        return cls((camera,), Rigid.stack([]), poses, (lens_basis,), points=points)

    def with_known_cameras(self) -> Bundle:
        """Return the bundle with lenses, rig and points fixed, so that only poses are adjusted."""
        lenses = tuple(empty_basis(camera) for camera in self.cameras)
        return dataclasses.replace(self, basis=lenses, is_rig_known=True, has_free_points=False)

    @property
    def lens_columns(self) -> list[slice]:
        """Slices of each camera's unknowns among the shared ones."""
        ends = np.cumsum([0, *(basis.shape[1] for basis in self.basis)]).tolist()
        return [slice(first, last) for first, last in itertools.pairwise(ends)]

    @property
    def camera_unknown_count(self) -> int:
        """Number of unknowns of lenses and rig; 6 for each further camera of an unknown rig."""
        lenses = sum(int(basis.shape[1]) for basis in self.basis)
        return lenses + (0 if self.is_rig_known else 6 * (len(self.cameras) - 1))

    @property
    def shared_count(self) -> int:
        """Number of unknowns that all views share: cameras, and 3 of each free point."""
        point_unknowns = self.points.size if self.has_free_points and self.points is not None else 0
        return self.camera_unknown_count + point_unknowns

    def rig_motion(self, camera: int) -> Rigid:
        """Return the motion from the first camera's frame into a camera's frame."""
        return self.rig.subset(camera - 1) if camera else IDENTITY

    def with_steps(self, shared: Array, poses: Array) -> Bundle:
        """Return the bundle after steps of the shared unknowns (S,) and of the poses (P, 6)."""
        columns = self.lens_columns
        cameras = tuple(
            with_lens(camera, lens_values(camera) + basis @ shared[part]) if basis.size else camera
            for camera, basis, part in zip(self.cameras, self.basis, columns, strict=True)
        )
        rig, points = self.rig, self.points
        if not self.is_rig_known and rig.size:
            rig = rig.turned_in_target(
                shared[columns[-1].stop : self.camera_unknown_count].reshape(-1, 6)
            )
        if points is not None and self.has_free_points:
            points = points + shared[self.camera_unknown_count :].reshape(-1, 3)
        return dataclasses.replace(
            self, cameras=cameras, rig=rig, poses=self.poses.turned_in_target(poses), points=points
        )

    def camera_changes(self, other: Bundle) -> Array:
        """Return the cameras' unknowns of another bundle minus those of this one."""
        lenses = [
            np.linalg.pinv(basis) @ (lens_values(to) - lens_values(camera))
            for camera, to, basis in zip(self.cameras, other.cameras, self.basis, strict=True)
        ]
        return np.concatenate(
            [*lenses, *([] if self.is_rig_known else self.rig.target_steps_to(other.rig))]
        )


def empty_basis(camera: CameraModel) -> Array:
    """Return the basis (4 + K, 0) of a known lens, which has no unknowns."""
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
    residuals: list[Array]  # residuals of each view (N, 2), seen minus projected, pixels
    # sum of the weighted squares of all residuals; infinite if points lie behind a camera
    weighted_squares: float
    extra_variance: float  # variance that was added to that of each coordinate, pixels^2
    normal: NormalEquations  # normal equations at the solution
    freedom: int  # number of coordinates minus number of unknowns

    @property
    def noise_covariance(self) -> Array:
        """Covariance of the cameras' unknowns if the errors of all points were independent.

        If the points of a view share errors, this covariance is far too small, but it still shows
        which values the views do not determine. NaN if ``weighted_squares`` is infinite.
        """
        count = self.bundle.camera_unknown_count
        if not math.isfinite(self.weighted_squares):
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


def adjust_weighted(
    bundle: Bundle, indexed: Sequence[IndexedView], extra_variance: float = 0.0
) -> AdjustedBundle:
    """Return the least-squares solution with weights that match its residuals.

    Residuals beyond the points' covariance (from a lens that does not quite follow its model, or a
    sheet that is not quite flat) are taken as one additional variance of all points, which is
    estimated together with the fit.
    """
    # Weights need the variance, and the variance needs the residuals, so both are computed
    # alternately. The fit depends little on the weights, so the second round hardly changes it.
    covariance = np.concatenate([entry.view.covariance for entry in indexed])
    for _ in range(3):
        adjusted = adjust(bundle, indexed, extra_variance)
        covariance_excess = excess_variance(
            np.concatenate(adjusted.residuals), covariance, adjusted.freedom
        )
        if abs(covariance_excess - extra_variance) <= 0.01 * extra_variance:
            return adjusted
        bundle, extra_variance = adjusted.bundle, covariance_excess
    return adjust(bundle, indexed, extra_variance)


def adjust(
    bundle: Bundle,
    indexed: Sequence[IndexedView],
    extra_variance: float,
    min_gain: float = MIN_COST_GAIN_RATIO,
) -> AdjustedBundle:
    """Return the least-squares solution.

    Each point is weighted by its covariance plus ``extra_variance``, pixels^2. The fit ends when a
    step lowers the weighted squares by less than the part ``min_gain``.
    """
    normal_at = BundleEquations(bundle, indexed, extra_variance).normal
    bundle, normal = minimize(bundle, normal_at, Bundle.with_steps, min_gain=min_gain)
    coordinate_count = 2 * sum(len(entry.view.ids) for entry in indexed)
    pose_count = len({entry.pose_index for entry in indexed})
    return AdjustedBundle(
        bundle=bundle,
        residuals=residuals(bundle, indexed),
        weighted_squares=normal.cost,
        extra_variance=extra_variance,
        normal=normal,
        freedom=coordinate_count
        - bundle.camera_unknown_count
        - 6 * pose_count
        - (_free_point_unknowns(indexed) if bundle.has_free_points else 0),
    )


class LeftOut(NamedTuple):
    """One pose, with cameras that were fitted without its views."""

    pose: int
    bundle: Bundle  # cameras and sheet, fitted without the pose's views
    # residuals of each of the pose's views (N, 2), pixels, after fitting the pose alone to them
    residuals: list[Array]
    # covariance of the cameras' unknowns without the pose's views, if the errors of all points were
    # independent with a variance of 1
    noise_covariance: Array


def leave_out(adjusted: AdjustedBundle, indexed: Sequence[IndexedView]) -> list[LeftOut]:
    """Return the fit without each observed pose, from a single step or, if needed, a new fit."""
    # At the solution, the normal equations without a pose are all equations minus those of the
    # pose, both with the poses eliminated. Their solution is the Gauss-Newton step from the fit to
    # all poses to the fit without the pose. The error of this step is of second order.
    # Source: Cook and Weisberg, Residuals and Influence in Regression (1982), section 2.2.
    matrix, right, _, _ = adjusted.normal.eliminate_poses()
    count, left_out = adjusted.bundle.camera_unknown_count, []
    poses = sorted({entry.pose_index for entry in indexed})
    for pose in poses:
        indexed_of_pose = [
            entry._replace(pose_index=0) for entry in indexed if entry.pose_index == pose
        ]
        bundle = dataclasses.replace(adjusted.bundle, poses=adjusted.bundle.poses.subset([pose]))
        equations = BundleEquations(bundle, indexed_of_pose, adjusted.extra_variance, prior=False)
        pose_normal = equations.normal(bundle)
        pose_matrix, pose_right, pose_by_shared, pose_constant = pose_normal.eliminate_poses()
        right_sides = np.column_stack([right - pose_right, np.eye(len(right), count)])
        solved = solve_scaled(matrix - pose_matrix, right_sides)
        shared, noise_covariance = solved[:, 0], solved[:, 1:]
        refitted = bundle.with_steps(shared, pose_constant - pose_by_shared @ shared)
        squares = (
            pose_normal.cost
            - float((pose_normal.pose_right_sides * pose_constant).sum())
            - 2.0 * pose_right @ shared
        )
        squares += float(shared @ pose_matrix @ shared)
        if (
            len(poses) <= MAX_FEW_POSES
            or not equations.normal(refitted).cost <= MAX_ONE_STEP_COST_RATIO * squares
        ):
            refitted = _fit_without_pose(adjusted, indexed, pose, indexed_of_pose)
        left_out.append(
            LeftOut(pose, refitted, residuals(refitted, indexed_of_pose), noise_covariance[:count])
        )
    return left_out


def _fit_without_pose(
    adjusted: AdjustedBundle,
    indexed: Sequence[IndexedView],
    pose: int,
    indexed_of_pose: Sequence[IndexedView],
) -> Bundle:
    """Fit the cameras to all views but those of one pose, then this pose to its views."""
    others = [entry for entry in indexed if entry.pose_index != pose]
    others_fit = adjust(
        adjusted.bundle, others, adjusted.extra_variance, MIN_REFIT_GAIN_RATIO
    ).bundle
    refitted = dataclasses.replace(others_fit, poses=adjusted.bundle.poses.subset([pose]))
    poses = adjust(
        refitted.with_known_cameras(), indexed_of_pose, adjusted.extra_variance
    ).bundle.poses
    return dataclasses.replace(refitted, poses=poses)


def camera_covariance(adjusted: AdjustedBundle, left_out: Sequence[LeftOut]) -> Array:
    """Return the covariance of the cameras' unknowns from the scatter between views.

    ``left_out``: all poses, each once.
    """
    changes = [adjusted.bundle.camera_changes(left_out_fit.bundle) for left_out_fit in left_out]
    covariances = np.array([left_out_fit.noise_covariance for left_out_fit in left_out])
    return weighted_jackknife(
        np.array(changes), covariances, adjusted.noise_covariance, WEIGHT_POWER
    )


def _free_point_unknowns(indexed: Sequence[IndexedView]) -> int:
    """Return the number of unknowns of the seen points, without the 7 of their pose and size."""
    return 3 * len(np.unique(np.concatenate([entry.view.ids for entry in indexed]))) - 7


class _CameraPoints(NamedTuple):
    """The N points that one camera sees, in all of its views."""

    camera: int
    poses: list[int]  # index of the pose of each of its views
    rows: list[slice]  # rows of the points of each of its views
    pose_of_point: Indices  # (N,), index of the pose of each point
    ids: Indices  # (N,), number of each point on the target
    pixels: Array  # (N, 2), pixels
    whitening: Array  # (N, 2, 2), matrix that whitens each point's residual


def _collect_points(
    camera: int, indexed: Sequence[IndexedView], extra_variance: float
) -> _CameraPoints:
    views, poses = [entry.view for entry in indexed], [entry.pose_index for entry in indexed]
    ends = np.cumsum([0, *(len(view.ids) for view in views)])
    return _CameraPoints(
        camera,
        poses,
        rows=[slice(first, last) for first, last in itertools.pairwise(ends.tolist())],
        pose_of_point=np.repeat(poses, np.diff(ends)),
        ids=np.concatenate([view.ids for view in views]),
        pixels=np.concatenate([view.points for view in views]),
        whitening=whitening(np.concatenate([view.covariance for view in views]), extra_variance),
    )


class BundleEquations:
    """The normal equations of a bundle, for given views.

    ``prior``: whether free points are held near their nominal places, with the standard deviations
    LOOSE_SIGMA_RATIO and TIGHT_SIGMA_RATIO.
    """

    def __init__(
        self,
        bundle: Bundle,
        indexed: Sequence[IndexedView],
        extra_variance: float,
        *,
        prior: bool = True,
    ) -> None:
        indexed_by_camera = (
            [entry for entry in indexed if entry.camera_index == k]
            for k in range(len(bundle.cameras))
        )
        self._groups = [
            _collect_points(k, indexed_of_camera, extra_variance)
            for k, indexed_of_camera in enumerate(indexed_by_camera)
            if indexed_of_camera
        ]
        self._is_unseen_pose = ~np.isin(
            np.arange(bundle.poses.size), [entry.pose_index for entry in indexed]
        )
        self._nominal = indexed[0].view.target.points
        self._prior = _prior_weights(self._nominal) if prior and bundle.has_free_points else None

    def normal(self, bundle: Bundle) -> NormalEquations:
        """Return the normal equations at a bundle."""
        normal, cost = NormalEquations.zeros(bundle.shared_count, bundle.poses.size, 6), 0.0
        normal.pose_blocks[self._is_unseen_pose] = np.eye(
            6
        )  # poses without a view stay as they are
        matrix, right = normal.shared, normal.shared_right_side
        for group in self._groups:
            columns, jacobian, by_points = self._derivatives(bundle, group)
            for pose, rows_of_pose in zip(group.poses, group.rows, strict=True):
                rows = jacobian[rows_of_pose]
                flat_rows = rows.reshape(-1, rows.shape[2])
                # derivatives by the pose, by the shared unknowns, and the residuals
                product = flat_rows.T @ flat_rows
                normal.pose_blocks[pose] += product[:6, :6]
                normal.pose_right_sides[pose] += product[:6, -1]
                normal.coupling[pose][:, columns] += product[:6, 6:-1]
                matrix[np.ix_(columns, columns)] += product[6:-1, 6:-1]
                right[columns] += product[6:-1, -1]
                cost += float(product[-1, -1])
                if not bundle.has_free_points:
                    continue
                transposed = by_points[rows_of_pose].swapaxes(1, 2)
                point_columns = (
                    bundle.camera_unknown_count + 3 * group.ids[rows_of_pose, None] + np.arange(3)
                )
                coupling = (transposed @ rows).reshape(point_columns.size, -1)
                matrix[point_columns[:, :, None], point_columns[:, None, :]] += (
                    transposed @ by_points[rows_of_pose]
                )
                matrix[np.ix_(point_columns.ravel(), columns)] += coupling[:, 6:-1]
                matrix[np.ix_(columns, point_columns.ravel())] += coupling[:, 6:-1].T
                right[point_columns.ravel()] += coupling[:, -1]
                normal.coupling[pose][:, point_columns.ravel()] += coupling[:, :6].T
        if bundle.points is not None and self._prior is not None:
            # also minimise the weighted squares of p - nominal: see _prior_weights
            sheet, shift = (
                slice(bundle.camera_unknown_count, bundle.shared_count),
                bundle.points - self._nominal,
            )
            pull = self._prior @ shift.ravel()
            matrix[sheet, sheet] += self._prior
            right[sheet] -= pull
            cost += float(shift.ravel() @ pull)
        return normal._replace(cost=cost if math.isfinite(cost) else math.inf)

    def _derivatives(self, bundle: Bundle, group: _CameraPoints) -> tuple[Indices, Array, Array]:
        """Return the indices of a camera's shared unknowns, and two arrays of whitened derivatives.

        The first array (N, 2, ...) has the derivatives of the pixels by the pose, then by the
        shared unknowns, and in its last column the residuals. The second array (N, 2, 3) has the
        derivatives by the points on the target, if these are adjusted.
        """
        # p = R_c (R m + t) + t_c moves with a pose's turn by R_c (w x R m), with the rig's by
        # w x (R_c (R m + t)), with the point by R_c R; see pixels_by_pose.
        camera, rig, pose = group.camera, bundle.rig_motion(group.camera), bundle.poses
        points, rotation = self._nominal if bundle.points is None else bundle.points, pose.rotation
        turned = np.einsum("nij,nj->ni", rotation[group.pose_of_point], points[group.ids])
        rotated = (turned + pose.translation[group.pose_of_point]) @ rig.rotation.T
        seen = linearize(rotated + rig.translation, bundle.cameras[camera])
        by_first = seen.by_point @ rig.rotation
        columns = [np.arange(bundle.shared_count)[bundle.lens_columns[camera]]]
        blocks = [pixels_by_pose(by_first, turned), seen.by_lens @ bundle.basis[camera]]
        if camera and not bundle.is_rig_known:
            columns.append(bundle.lens_columns[-1].stop + 6 * (camera - 1) + np.arange(6))
            blocks.append(pixels_by_pose(seen.by_point, rotated))
        blocks.append((group.pixels - seen.pixels)[..., None])
        by_point = (
            group.whitening @ (by_first @ rotation[group.pose_of_point])
            if bundle.has_free_points
            else by_first
        )
        return np.concatenate(columns), group.whitening @ np.concatenate(blocks, axis=2), by_point


def residuals(bundle: Bundle, indexed: Iterable[IndexedView]) -> list[Array]:
    """Return the residuals of each view (N, 2), seen minus projected, pixels."""
    per_view = []
    for camera, pose, view in indexed:
        points = view.object_points if bundle.points is None else bundle.points[view.ids]
        in_camera = (bundle.rig_motion(camera) @ bundle.poses.subset(pose)).apply(points)
        per_view.append(view.points - bundle.cameras[camera].project(in_camera))
    return per_view


def _prior_weights(nominal: Array) -> Array:
    """Return the weights (3 T, 3 T) that hold a sheet's points near their nominal places.

    Single points are held loosely. Their common shift, turn and scale, which move no pixel, are
    held firmly.
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
