"""Calibrate a camera's lens from views of a printed target."""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, get_args

import numpy as np
from pydantic import Field

from smartcam._argument_checks import check_arguments, each, of_class
from smartcam._arguments import check_flag, check_text
from smartcam.calibration._files import storage
from smartcam.calibration._lens.bundle import Bundle, IndexedView, adjust, camera_covariance
from smartcam.calibration._lens.coverage import Coverage, coverage
from smartcam.calibration._lens.field import DEFAULT_MAP_SHAPE, map_pixels, points_of_pixels
from smartcam.calibration._lens.poses import (
    CAMERA,
    TARGET,
    PoseInCamera,
    check_view,
    half_turned,
    locate,
    view_rms,
)
from smartcam.calibration._lens.projection import whitening
from smartcam.calibration._lens.sheet_shape import MAX_FREE_POINTS, SheetOption, choose_shape
from smartcam.calibration._lens.start import fit_lens, parameter_names
from smartcam.calibration._lens.suspicions import examine_views
from smartcam.calibration._lens.uncertainty import ProjectionUncertainty, uncertainty
from smartcam.calibration._one_blas_thread import one_blas_thread
from smartcam.calibration._views import TargetView, as_list, as_views, view_name
from smartcam.geometry import CameraModel, Transform
from smartcam.geometry._inside import Array, Code, Remark, Rigid, check_choice

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from smartcam.calibration._lens.bundle import AdjustedBundle
    from smartcam.geometry._inside import DistortionModel

CoverageValue = Annotated[storage.NonNegative, Field(le=1)]
COVERAGE_FORM = storage.row(
    tuple[CoverageValue, CoverageValue, CoverageValue, CoverageValue], Coverage._make
)

MIN_VIEWS: Final = 3
"""At least this many views are needed: two views determine a lens, and a third one shows how much
noise the points have."""

MIN_TILT_RADIANS: Final = math.radians(5.0)
"""The two most different orientations of the target must differ by this angle: parallel planes do
not determine the focal length."""

MIN_MOTION_SHARE: Final = 0.02
"""Two views count as the same if no point moves between them by this fraction of the image's longer
side."""

MAX_FOCAL_SIGMA_RATIO: Final = 0.1
"""The focal length is not determined if its standard deviation is more than this fraction of it."""

BAD_VIEW_RATIO: Final = 3.0
"""A view is bad if its weighted RMS is more than this many times the median of the other views:
good views reach 1.6 (measured)."""

MAX_BAD_VIEW_SHARE: Final = 1 / 3
"""At most this fraction of the views may be left out."""

MIN_REACHED_SHARE: Final = 0.9
"""If the lens' model is valid in less than this fraction of the image, a warning says so: models of
wide lenses may not be valid in the corners."""

POOR_FIT_RMS_PX: Final = 1.0
"""Residual RMS, pixels, above which the model of the lens, or the sheet, may be wrong."""

MAX_ITERATIONS: Final = 10
"""Alternations between fitting the sheet's shape and renumbering views; 16 views, half of them
turned, take four."""

MAX_RENUMBERED_RMS_SHARE: Final = 0.7
"""Views are renumbered only if that reduces the RMS of the residuals to less than this fraction:
for a sheet that bends by 0.6 mm to one side the ratio is 0.4 or less (simulated)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewFit(storage.Stored):
    """The fit of a lens to one view.

    Attributes:
        view: the view as given, without the points that an ``OUTLIER`` warning names.
        used: whether the lens is fitted to it; False for a bad view.
        transform: ``T_camera_target``.
        residuals: (N, 2), seen minus projected, pixels.
        rms: RMS of a coordinate of ``residuals``, pixels, corrected for their degrees of freedom.
        held_out: RMS of a coordinate, pixels, for a lens that was fitted without this view, after
            fitting only the pose to it; NaN if there were too few other views.
    """

    _keys: ClassVar[storage.Keys] = {"transform": "pose"}

    view: TargetView
    used: bool
    transform: PoseInCamera
    residuals: Annotated[Array, storage.rows(storage.Pair, 2)]
    rms: storage.NonNegative
    held_out: storage.NumberOrNaN


@dataclass(frozen=True, kw_only=True, eq=False)
class IntrinsicCalibration(storage.SavedCalibration):
    """The result of :func:`calibrate_intrinsics`.

    Attributes:
        camera: the lens.
        covariance: (4 + K, 4 + K), of fx, fy, cx, cy and the coefficients, from how much each view
            changes them (a jackknife). It includes errors that all points of a view share, such as
            a sheet that bends anew. It is 0 for values that were not fitted. From V views its rank
            is at most V, and from few views it is rough: from ten views it is accurate to 25 %.
        views: fit of each given view, in the order of the views.
        rms: RMS of a coordinate of the residuals of the used views, pixels, corrected for their
            degrees of freedom. It is not the accuracy of the lens: see ``held_out``.
        sigma: standard deviation of a coordinate, pixels, that the points' covariance does not
            explain: the lens or the sheet is not quite as modelled, or the points have more noise
            than their covariance says.
        held_out: held-out error, RMS of a coordinate over all used views, pixels; see
            :attr:`ViewFit.held_out`. It is corrected for the six parameters of each held-out pose.
            NaN if there were too few views.
        coverage: range of places, sizes and tilts in which the target was shown.
        sheet: (T, 3), offsets of the target's points from their nominal places, metres; None
            if they are taken as exact.
        warnings: remarks to read before using the calibration.
    """

    kind: ClassVar[str] = "camera"
    _label: ClassVar[str] = "calibration of cameras"
    _extra_keys: ClassVar[storage.ExtraKeys] = {
        "target": (storage.StoredTarget, lambda calibration: calibration.views[0].view.target)
    }

    camera: CameraModel
    covariance: Annotated[Array, storage.matrix()]
    views: Annotated[tuple[ViewFit, ...], storage.AsList(1)]
    rms: storage.NonNegative
    sigma: storage.NonNegative
    held_out: storage.NumberOrNaN
    coverage: Annotated[Coverage, COVERAGE_FORM]
    sheet: storage.SheetOffsets | None
    warnings: storage.Remarks

    @property
    def deviations(self) -> dict[str, float]:
        """Standard deviations by name: ``fx``, ``fy``, ``cx``, ``cy`` in pixels, ``k1``, ...

        They hold to first order. The coefficients ``k1`` to ``k6`` of ``rational_polynomial``
        compensate each other so much that each may be tens of its deviations off the true value,
        while ``fx`` to ``cy``, and the lens that the coefficients describe together, are right.
        """
        names = parameter_names(self.camera.distortion_model)
        values = np.sqrt(np.maximum(np.diag(self.covariance), 0.0)).tolist()
        return dict(zip(names, values, strict=True))

    @property
    def bad_views(self) -> tuple[str, ...]:
        """Names of the views that were left out."""
        return tuple(
            view_name(fit.view, number) for number, fit in enumerate(self.views) if not fit.used
        )

    def uncertainty(
        self, *, distance: float | None = None, shape: tuple[int, int] = DEFAULT_MAP_SHAPE
    ) -> ProjectionUncertainty:
        """Return a map of the uncertainty with which the lens projects, over its field.

        It is computed from ``covariance``, for a fixed point. A small motion of the camera, the one
        that fits best to the target's points, is removed, since every pose that is found with this
        lens compensates it. The uncertainty is least at the distances at which the target was
        shown. Where it was never shown, the map extrapolates the lens' model, and no covariance can
        say whether the model fits there.

        Args:
            distance: distance of the points from the camera, metres; None: infinity.
            shape: rows and columns of the map, 2 to 500 each, from corner to corner.

        Raises:
            CalibrationError: ``NOT_FINITE``: the distance is not valid; ``SHAPE``: the rows or
                columns are not.
        """
        return uncertainty(
            self.camera, self.covariance, self.target_points, distance=distance, shape=shape
        )

    @property
    def target_points(self) -> Array:
        """Places of the target's points in the camera's frame, all used views, (N, 3), metres."""
        return np.concatenate(
            [fit.transform.apply(fit.view.object_points) for fit in self.views if fit.used]
        )

    def point_errors(self, views: Sequence[TargetView]) -> tuple[Array, ...]:
        """Return the errors of the lens at any views.

        To see how good the lens is, give views to which it was not fitted. Only the pose of the
        target is fitted to each, as for :attr:`ViewFit.held_out`.

        Args:
            views: views of any target; of the same one if its points were adjusted (``sheet``).

        Returns:
            For each view (N, 2), seen minus projected, pixels, with 2 N - 6 degrees of freedom.

        Raises:
            CalibrationError: ``DIFFERENT_TARGETS``; and those of
                :func:`~smartcam.calibration.locate`.
        """
        return tuple(self._view_errors(view) for view in views)

    def _view_errors(self, view: TargetView) -> Array:
        target = self.views[0].view.target
        if self.sheet is not None and view.target != target:
            raise Code.DIFFERENT_TARGETS.error(
                f"point_errors: expected views of {target}, whose points were adjusted, got one of "
                f"{view.target}",
                target,
                view.target,
            )
        pose = Rigid.stack([locate(view, self.camera).transform.rigid])
        points = None if self.sheet is None else target.points + self.sheet
        bundle = Bundle.single(self.camera, pose, points=points)
        return adjust(bundle, [IndexedView(0, 0, view)], self.sigma**2).residuals[0]

    def _check(self, fields: Mapping[str, Any], label: str) -> None:
        count = 4 + len(self.camera.distortion)
        storage.check_shape(self.covariance, (count, count), label, "covariance")
        for fit in self.views:
            storage.check_shape(fit.residuals, fit.view.points.shape, label, "residuals")
        if self.sheet is not None:
            storage.check_shape(self.sheet, fields["target"].points.shape, label, "sheet")


@check_arguments(
    views=each(of_class("TargetView")),
    distortion_model=check_text,
    fixed=each(check_text),
    sheet=check_text,
    drop_bad=check_flag,
)
@one_blas_thread
def calibrate_intrinsics(
    views: Sequence[TargetView],
    *,
    distortion_model: DistortionModel = "plumb_bob",
    fixed: Iterable[str] = (),
    sheet: SheetOption = "auto",
    drop_bad: bool = True,
) -> IntrinsicCalibration:
    """Calibrate a lens from views of a target.

    The reprojection error is minimized; each point is weighted by its covariance, and by the
    additional variance that the residuals show. The order of the views does not matter. Points that
    lie far from where the others of their view predict them are left out and named (``OUTLIER``). A
    view of a target that looks the same after half a turn may number its points from either end.

    If *all* pictures were flipped and the target looks the same in a mirror, as a checkerboard
    does, no test can notice it: the lens is then right only for flipped pictures.

    Args:
        views: views of one target, 3 or more, of images of one size; tilted in several directions,
            near and far, out to the corners.
        distortion_model: ``plumb_bob`` for most lenses, ``rational_polynomial`` for wide ones,
            ``equidistant`` for fisheyes.
        fixed: coefficients that stay 0, such as ``k3``; ``aspect`` makes fx and fy the same.
        sheet: whether the target's points are adjusted, too, since printers stretch and paper
            bends. ``auto``: if that lowers the held-out error by more than chance. ``exact``:
            never. ``free``: always. Adjusted points that few views show stay near their nominal
            places. A warning ``SHEET_NOT_EXACT`` says that the held-out error contradicts an exact
            sheet. Targets of more than 1000 points are taken as exact without this test.
        drop_bad: whether views that fit far worse than the others are left out, at most a third of
            them; a warning names them in any case.

    Raises:
        CalibrationError: ``TOO_FEW`` views or points; ``COLLINEAR`` points of a view;
            ``WRONG_SIZE``: images of several sizes; ``DIFFERENT_TARGETS``; ``POSES_TOO_SIMILAR``:
            the views are nearly the same; ``INSUFFICIENT_ROTATION``: the target was never tilted,
            or so little that the focal length stays open; ``SHAPE``: the coefficient or the model
            is unknown, or these are no views; ``NOT_FINITE`` pixels; ``MIRRORED``: a view shows the
            target as in a mirror; ``POOR_FIT``: no lens of this model fits the views.
    """
    all_views = as_views(views, "intrinsics")
    check_choice(sheet, get_args(SheetOption), "sheet")
    check_views(all_views, "intrinsics", MIN_VIEWS)
    _check_motion(all_views)
    fixed_names = tuple(as_list(fixed, str, "fixed: name"))
    used = list(range(len(all_views)))
    while True:
        adjusted = fit_lens([all_views[number] for number in used], distortion_model, fixed_names)
        worst, ratio = worst_view([all_views[number] for number in used], adjusted)
        dropped_count = len(all_views) - len(used) + 1
        can_drop = len(used) > MIN_VIEWS and dropped_count <= MAX_BAD_VIEW_SHARE * len(all_views)
        if ratio <= BAD_VIEW_RATIO or not (drop_bad and can_drop):
            break
        del used[worst]
    check_tilts(adjusted, "intrinsics")
    bad = [used[worst]] if ratio > BAD_VIEW_RATIO else []
    calibration = _build_calibration(
        all_views, used, adjusted, [*bad, *sorted(set(range(len(all_views))) - set(used))], sheet
    )
    renumbered = list[str]()
    target = all_views[0].target
    if target.half_turn_symmetric and sheet != "exact" and len(target.points) <= MAX_FREE_POINTS:
        calibration, renumbered = _renumber_views(calibration, distortion_model, fixed_names, sheet)
    recalibrate = functools.partial(
        calibrate_intrinsics,
        distortion_model=distortion_model,
        fixed=fixed_names,
        sheet=sheet,
        drop_bad=drop_bad,
    )
    calibration = examine_views(calibration, recalibrate, drop_strays=drop_bad)
    if not renumbered:
        return calibration
    remark = Code.SHEET_NOT_EXACT.remark(
        f"the target looks the same after half a turn, and its shape shows that "
        f"{', '.join(renumbered)} numbered it from its other end than the rest; they are "
        "numbered as the rest here"
    )
    return dataclasses.replace(calibration, warnings=(*calibration.warnings, remark))


def _renumber_views(
    calibration: IntrinsicCalibration,
    model: DistortionModel,
    fixed: tuple[str, ...],
    sheet: SheetOption,
) -> tuple[IntrinsicCalibration, list[str]]:
    """Return the calibration from views numbered from one end, and the names of turned views.

    The result is ``calibration`` and no names if no view is turned, or if renumbering does not
    reduce the residuals much.
    """
    # Fitting the lens and choosing each view's numbering in turn can only lower the sum of squared
    # residuals: Lloyd (1982).
    views = [fit.view for fit in calibration.views]
    used = [number for number, fit in enumerate(calibration.views) if fit.used]
    bad = sorted(set(range(len(views))) - set(used))
    renumbered, is_turned = list(views), np.zeros(len(views), dtype=np.bool_)
    candidate = calibration
    for _ in range(MAX_ITERATIONS):
        adjusted = fit_lens([renumbered[i] for i in used], model, fixed)
        candidate = _build_calibration(renumbered, used, adjusted, bad, "free")
        is_wrong = np.zeros(len(views), dtype=np.bool_)
        for number in used:
            numberings = renumbered[number], half_turned(renumbered[number])
            error, turned_error = (
                float((errors**2).sum()) for errors in candidate.point_errors(numberings)
            )
            is_wrong[number] = turned_error < error
        if not is_wrong.any():
            break
        is_turned ^= is_wrong
        renumbered = [half_turned(view) if is_turned[i] else view for i, view in enumerate(views)]
    if not is_turned.any() or candidate.rms > MAX_RENUMBERED_RMS_SHARE * calibration.rms:
        return calibration, []
    if 2 * is_turned.sum() > len(is_turned):
        is_turned = ~is_turned
        renumbered = [half_turned(view) if is_turned[i] else view for i, view in enumerate(views)]
    adjusted = fit_lens([renumbered[i] for i in used], model, fixed)
    calibrated = _build_calibration(renumbered, used, adjusted, bad, sheet)
    names = [view_name(view, i) for i, view in enumerate(views) if is_turned[i]]
    return (calibration, []) if calibrated.sheet is None else (calibrated, names)


def check_views(
    views: Sequence[TargetView], label: str, minimum: int, size: tuple[int, int] | None = None
) -> None:
    """Raise an error for views that do not belong together, or cannot be used.

    ``label``: name for messages. ``minimum``: least number of views. ``size``: size of the images,
    pixels; None: that of the first. Raises ``TOO_FEW``, ``COLLINEAR``, ``WRONG_SIZE``,
    ``DIFFERENT_TARGETS``, ``NOT_FINITE``.
    """
    if len(views) < minimum:
        raise Code.TOO_FEW.error_with_value(
            f"{label}: expected {minimum} views or more", minimum, len(views)
        )
    for number, view in enumerate(views):
        if view.target != views[0].target:
            raise Code.DIFFERENT_TARGETS.error(
                f"{label}: expected views of one target, {views[0].target}, got {view.target} in "
                f"{view_name(view, number)}",
                views[0].target,
                view.target,
            )
        check_view(view, size or views[0].size)


def _check_motion(views: Sequence[TargetView]) -> None:
    """Raise ``POSES_TOO_SIMILAR`` if all views are nearly the same."""
    min_move, largest_move = MIN_MOTION_SHARE * max(views[0].size), 0.0
    for view in views[1:]:
        common, first, second = np.intersect1d(views[0].ids, view.ids, return_indices=True)
        if not len(common):
            return
        moves = views[0].points[first] - view.points[second]
        largest_move = max(largest_move, float(np.linalg.norm(moves, axis=1).max()))
    if largest_move < min_move:
        raise Code.POSES_TOO_SIMILAR.error(
            f"intrinsics: expected views in which the target moves by {min_move:.3g} pixels or "
            f"more, got {len(views)} that differ by {largest_move:.3g}",
            min_move,
            largest_move,
        )


def check_tilts(adjusted: AdjustedBundle, label: str) -> None:
    """Raise ``INSUFFICIENT_ROTATION`` for parallel planes, or an undetermined focal length.

    ``label``: name for messages.
    """
    normals = adjusted.bundle.poses.rotation[:, :, 2]
    sines = np.linalg.norm(np.cross(normals[:, None], normals), axis=2)
    tilt = math.asin(min(1.0, float(sines.max())))
    if tilt < MIN_TILT_RADIANS:
        raise Code.INSUFFICIENT_ROTATION.error(
            f"{label}: expected the target tilted by {math.degrees(MIN_TILT_RADIANS):.0f} degrees "
            f"or more between two views, got {math.degrees(tilt):.2g}: parallel planes leave the "
            "focal length open",
            MIN_TILT_RADIANS,
            tilt,
        )
    # values = basis times unknowns, so their covariance is B C B^T
    covariance = adjusted.bundle.basis[0] @ adjusted.noise_covariance @ adjusted.bundle.basis[0].T
    length = float(adjusted.bundle.cameras[0].matrix[0, 0])
    sigma_ratio = math.sqrt(max(float(covariance[0, 0]), 0.0)) / length
    if sigma_ratio > MAX_FOCAL_SIGMA_RATIO:
        raise Code.INSUFFICIENT_ROTATION.error(
            f"{label}: expected views that tell the focal length to "
            f"{MAX_FOCAL_SIGMA_RATIO:.0%}, got {length:.5g} pixels with a standard deviation of "
            f"{sigma_ratio:.2g} of it: tilt the "
            "target more, and show it nearer",
            MAX_FOCAL_SIGMA_RATIO,
            sigma_ratio,
        )


def worst_view(views: Sequence[TargetView], adjusted: AdjustedBundle) -> tuple[int, float]:
    """Return the index of the worst view, and its weighted RMS over the median of the others."""
    errors = [
        weighted_rms(view, residuals, adjusted.extra_variance)
        for view, residuals in zip(views, adjusted.residuals, strict=True)
    ]
    worst = int(np.argmax(errors))
    others = float(np.median(np.delete(errors, worst)))
    return worst, errors[worst] / others if others > 0 else 1.0


def weighted_rms(view: TargetView, residuals: Array, extra_variance: float) -> float:
    """Return the RMS of a view's residuals, in standard deviations."""
    whitened = whitening(view.covariance, extra_variance) @ residuals[..., None]
    return math.sqrt(float((whitened**2).mean()))


def _combined_rms(errors: Sequence[float], views: Sequence[TargetView]) -> float:
    weights = [2 * len(view.ids) - 6 for view in views]
    return math.sqrt(float(np.average(np.square(errors), weights=weights)))


def _build_calibration(
    views: Sequence[TargetView],
    used: list[int],
    adjusted: AdjustedBundle,
    bad: list[int],
    sheet: SheetOption,
) -> IntrinsicCalibration:
    used_views = [views[number] for number in used]
    indexed = [IndexedView(0, number, view) for number, view in enumerate(used_views)]
    sheet_fit = choose_shape(adjusted, indexed, sheet)
    errors = [
        view_rms(left_out_fit.residuals[0]) if len(used) > MIN_VIEWS else math.nan
        for left_out_fit in sheet_fit.left_out
    ]
    adjusted, bundle = sheet_fit.adjusted, sheet_fit.adjusted.bundle
    camera, basis = bundle.cameras[0], bundle.basis[0]
    held_out_errors = dict(zip(used, errors, strict=True))
    fits = [
        _view_fit(view, camera, adjusted, used.index(number), held_out_errors[number])
        if number in held_out_errors
        else _view_fit(view, camera)
        for number, view in enumerate(views)
    ]
    calibration = IntrinsicCalibration(
        camera=camera,
        covariance=basis @ camera_covariance(adjusted, sheet_fit.left_out) @ basis.T,
        views=tuple(fits),
        rms=adjusted.rms,
        sigma=math.sqrt(adjusted.extra_variance),
        held_out=_combined_rms(errors, used_views),
        sheet=sheet_fit.offsets,
        coverage=coverage([_outline(fits[number], camera) for number in used], camera.size),
        warnings=(),
    )
    return dataclasses.replace(
        calibration, warnings=tuple(_remarks(calibration, bad, sheet_fit.remarks))
    )


def _view_fit(
    view: TargetView,
    camera: CameraModel,
    adjusted: AdjustedBundle | None = None,
    pose_index: int = 0,
    held_out: float = math.nan,
) -> ViewFit:
    """Return the fit of the lens to a view; for a bad view only its pose is fitted."""
    if adjusted is None:
        pose = locate(view, camera)
        transform, residuals, held_out = pose.transform, pose.residuals, pose.rms
    else:
        transform = Transform(CAMERA, TARGET, *adjusted.bundle.poses.subset(pose_index))
        residuals = adjusted.residuals[pose_index]
    return ViewFit(
        view=view,
        used=adjusted is not None,
        transform=transform,
        residuals=residuals,
        rms=view_rms(residuals),
        held_out=held_out,
    )


def _outline(fit: ViewFit, camera: CameraModel) -> Array:
    """Return the pixels (4, 2) of the target's four corners, even if these were hidden."""
    low, high = fit.view.target.points.min(axis=0), fit.view.target.points.max(axis=0)
    corners = np.array(
        [[low[0], low[1], 0], [high[0], low[1], 0], [high[0], high[1], 0], [low[0], high[1], 0]]
    )
    projected = camera.project(fit.transform.apply(corners))
    return np.where(np.isfinite(projected), projected, fit.view.points.mean(axis=0))


def _remarks(
    calibration: IntrinsicCalibration, bad: list[int], sheet_remarks: list[Remark]
) -> Iterator[Remark]:
    for number, fit in enumerate(calibration.views):
        for code, text in fit.view.warnings:
            yield Remark(code, f"{view_name(fit.view, number)}: {text}")
    for number in bad:
        fit = calibration.views[number]
        outcome = "was not used" if not fit.used else "is used all the same"
        yield Code.BAD_VIEW.remark(
            f"{view_name(fit.view, number)}: {fit.rms:.3g} pixels rms where the lens has "
            f"{calibration.rms:.3g} in all: it {outcome}"
        )
    if calibration.rms > POOR_FIT_RMS_PX:
        yield Code.POOR_FIT.remark(
            f"residuals of {calibration.rms:.3g} pixels rms, expected {POOR_FIT_RMS_PX:g} at most: "
            f"the lens is not of the model {calibration.camera.distortion_model}, the sheet is not "
            "flat, or points were taken for others"
        )
    yield from sheet_remarks
    camera = calibration.camera
    seen = points_of_pixels(camera, map_pixels(camera.size, DEFAULT_MAP_SHAPE).reshape(-1, 2), None)
    reached_share = float(np.isfinite(seen[:, 0]).mean())
    if reached_share < MIN_REACHED_SHARE:
        yield Code.OUT_OF_FIELD.remark(
            f"the model {camera.distortion_model} is not valid in {1 - reached_share:.0%} of the "
            "image, to which no direction is projected; show the target there, or take another "
            "model"
        )
    if lacking := calibration.coverage.lacking:
        values = ", ".join(f"{name} {getattr(calibration.coverage, name):.0%}" for name in lacking)
        yield Code.POOR_COVERAGE.remark(
            f"the views cover too little: {values} of what is good enough"
        )
    if math.isnan(calibration.held_out):
        yield Code.NOT_HELD_OUT.remark(
            f"{sum(view.used for view in calibration.views)} views are no more than a lens "
            "has need of: none can be left out to see how good it is"
        )
