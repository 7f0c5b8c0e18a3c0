"""Calibrate two cameras that look at the same place, and the pose of one in the other's frame."""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, NamedTuple, get_args

import numpy as np

from smartcam._argument_checks import a_list, check_arguments, each
from smartcam._arguments import check_flag, check_text
from smartcam.calibration._files import storage
from smartcam.calibration._lens.bundle import (
    Bundle,
    IndexedView,
    adjust_weighted,
    camera_covariance,
)
from smartcam.calibration._lens.intrinsics import (
    BAD_VIEW_RATIO,
    MAX_BAD_VIEW_SHARE,
    MIN_VIEWS,
    POOR_FIT_RMS_PX,
    worst_view,
)
from smartcam.calibration._lens.poses import TARGET, check_view, half_turned
from smartcam.calibration._lens.sheet_shape import SheetOption, choose_shape
from smartcam.calibration._one_blas_thread import one_blas_thread
from smartcam.calibration._stereo import triangulation
from smartcam.calibration._stereo.checks import check_fit, check_pairs, examine_pairs, side_remarks
from smartcam.calibration._stereo.errors import PairErrors, pair_errors
from smartcam.calibration._stereo.rectification import Rectification, rectify
from smartcam.calibration._stereo.start import (
    LEFT,
    RIGHT,
    SIDES,
    Lenses,
    ViewPair,
    as_view_pairs,
    guess_start,
)
from smartcam.calibration._stereo.triangulation import CameraPair
from smartcam.calibration._views import TargetView, as_covariances, as_list, view_name
from smartcam.geometry import CameraModel, Transform
from smartcam.geometry._inside import Array, Code, Remark, as_points, check_choice

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from numpy.typing import ArrayLike

    from smartcam.calibration._lens.bundle import AdjustedBundle, LeftOut
    from smartcam.calibration._targets import Target
    from smartcam.geometry._inside import DistortionModel

PoseInLeft = Annotated[Transform, storage.motion(lambda _: (LEFT, TARGET))]
LeftInRight = Annotated[Transform, storage.motion(lambda _: (RIGHT, LEFT))]

MIN_PAIRS: Final = 2
"""Cameras with known lenses need this many pairs: one gives the transform, another confirms it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PairFit(storage.Stored):
    """The fit of two cameras to one pair of views.

    Attributes:
        left: view of the left camera, as it was given.
        right: view of the right camera, as it was given, but perhaps numbered from the other end of
            a target that looks the same when turned.
        used: whether the cameras are fitted to the view of each side; False for a bad or missing
            view.
        transform: ``T_left_target``; None if neither view is used.
        rms: RMS of a coordinate of each side's residuals, pixels; NaN for a side that is not used.
        held_out: RMS error of the distances between neighbouring points, as triangulated by cameras
            that were fitted without this pair, metres; NaN if a view is missing or bad, or if there
            are too few pairs.
        epipolar: RMS distance of the points from their epipolar lines, pixels, by cameras that were
            fitted without this pair, as for ``held_out``; NaN if ``held_out`` is.
    """

    _keys: ClassVar[storage.Keys] = {"transform": "pose"}

    left: TargetView | None
    right: TargetView | None
    used: Annotated[tuple[bool, bool], storage.row(tuple[bool, bool])]
    transform: PoseInLeft | None
    rms: storage.PairOrNaN
    held_out: storage.NumberOrNaN
    epipolar: storage.NumberOrNaN


@dataclass(frozen=True, kw_only=True, eq=False)
class StereoCalibration(storage.SavedCalibration):
    """The result of :func:`calibrate_stereo`.

    Attributes:
        left: lens of the left camera.
        right: lens of the right camera.
        transform: ``T_right_left``.
        covariance: (6, 6), of a small turn (rad) and shift (m) of the left camera in the right
            one's frame, from how much each pair changes it (a jackknife), so it includes errors
            that all points of a pair share.
        pairs: fit of each given pair, in the order of the pairs.
        rms: RMS of a coordinate of the residuals of all used views, pixels, corrected for their
            degrees of freedom. It is not the accuracy of the cameras: see ``held_out``.
        sigma: standard deviation of a coordinate, pixels, that the points' covariance does not
            explain.
        epipolar: rms distance of the used points from their epipolar lines, pixels.
        held_out: held-out error: RMS error, metres, of the distances between neighbouring points of
            the target, as triangulated by cameras that were fitted without the pair, over all
            pairs. NaN if there were too few pairs.
        held_out_epipolar: RMS distance from the epipolar lines, pixels, of cameras that were
            fitted without the pair.
        sheet: (T, 3), offsets of the target's points from their nominal places, metres; None
            if they are taken as exact.
        warnings: remarks to read before using the calibration.
    """

    kind: ClassVar[str] = "stereo"
    _label: ClassVar[str] = "calibration of cameras"
    _extra_keys: ClassVar[storage.ExtraKeys] = {
        "target": (storage.StoredTarget, lambda calibration: _first_target(calibration))
    }

    left: CameraModel
    right: CameraModel
    transform: LeftInRight
    covariance: Annotated[Array, storage.matrix(6)]
    pairs: Annotated[tuple[PairFit, ...], storage.AsList(1)]
    rms: storage.NonNegative
    sigma: storage.NonNegative
    epipolar: storage.NonNegative
    held_out: storage.NumberOrNaN
    held_out_epipolar: storage.NumberOrNaN
    sheet: storage.SheetOffsets | None
    warnings: storage.Remarks

    @property
    def bad_views(self) -> tuple[str, ...]:
        """Names of the views that were left out."""
        return tuple(
            view_name(view, number)
            for number, pair in enumerate(self.pairs)
            for view, used in zip((pair.left, pair.right), pair.used, strict=True)
            if view is not None and not used
        )

    def triangulate(
        self,
        left_pixels: ArrayLike,
        right_pixels: ArrayLike,
        *,
        left_covariance: ArrayLike | None = None,
        right_covariance: ArrayLike | None = None,
    ) -> Array:
        """Triangulate points that both cameras see, to the least reprojection error.

        Args:
            left_pixels: (N, 2), pixels of the points in the left image, with distortion.
            right_pixels: (N, 2), pixels of the same points in the right image.
            left_covariance: (N, 2, 2), covariance of ``left_pixels``, pixels^2; None: the same for
                all.
            right_covariance: (N, 2, 2), covariance of ``right_pixels``, pixels^2; None: the same
                for all.

        Returns:
            (N, 3), left camera's frame, metres; NaN where the rays do not meet in front of both
            cameras.

        Raises:
            CalibrationError: ``SHAPE`` or ``NOT_FINITE``.
        """
        pixels = self._as_pixels(left_pixels, right_pixels)
        covariance = tuple(
            _pixel_covariances(covariance, len(pixels[0]), side)
            for covariance, side in zip((left_covariance, right_covariance), SIDES, strict=True)
        )
        both = covariance[0], covariance[1]
        return triangulation.triangulate(self._cameras, pixels, both).points

    def point_covariance(self, points: ArrayLike, pixel_sigma: float | None = None) -> Array:
        """Return the covariance of triangulated points, the calibration taken as exact.

        Args:
            points: (N, 3), left camera's frame, metres.
            pixel_sigma: standard deviation of a coordinate in an image, pixels; None: that of the
                calibration's residuals.

        Returns:
            (N, 3, 3), m^2; NaN for points that are not in front of both cameras.

        Raises:
            CalibrationError: ``SHAPE`` or ``NOT_FINITE``.
        """
        all_points = as_points(points, 3, "points in front of the cameras")
        sigma = self.rms if pixel_sigma is None else pixel_sigma
        projected = (
            self.left.project(all_points),
            self.right.project(self.transform.apply(all_points)),
        )
        is_seen = np.isfinite(projected[0]).all(axis=1) & np.isfinite(projected[1]).all(axis=1)
        pixel_covariance = np.tile(sigma**2 * np.eye(2), (int(is_seen.sum()), 1, 1))
        covariances = np.full((len(all_points), 3, 3), np.nan)
        pixels = projected[0][is_seen], projected[1][is_seen]
        covariances[is_seen] = triangulation.triangulate(
            self._cameras, pixels, (pixel_covariance, pixel_covariance)
        ).covariance
        return covariances

    def epipolar_distances(self, left_pixels: ArrayLike, right_pixels: ArrayLike) -> Array:
        """Return the distances of points from the epipolar lines of their partners.

        Args:
            left_pixels: (N, 2).
            right_pixels: (N, 2).

        Returns:
            (N, 2): in the left image and in the right one, pixels without distortion.

        Raises:
            CalibrationError: ``SHAPE`` or ``NOT_FINITE``.
        """
        pixels = self._as_pixels(left_pixels, right_pixels)
        return triangulation.epipolar_distances(self._cameras, pixels)

    def point_errors(
        self,
        left_views: Sequence[TargetView | None],
        right_views: Sequence[TargetView | None],
    ) -> tuple[PairErrors, ...]:
        """Return the errors of the cameras at any pairs of views.

        To see how good the cameras are, give pairs that were not used in the fit. The target does
        not have to be the same.

        Args:
            left_views: a view for each moment; None if the left camera does not see the target.
            right_views: views of the right camera at the same moments. Those of a target that looks
                the same when turned are numbered to match the left ones.

        Returns:
            The errors of each moment; empty if a view is missing.

        Raises:
            CalibrationError: ``SHAPE``: lists of different lengths; ``WRONG_SIZE``; ``TOO_FEW``,
                ``COLLINEAR``, ``NOT_FINITE``: a view is unusable; ``DIFFERENT_TARGETS``.
        """
        view_pairs = as_view_pairs(left_views, right_views)
        for side, camera in enumerate((self.left, self.right)):
            for view_pair in view_pairs:
                if (view := view_pair[side]) is not None:
                    check_view(view, camera.size)
        return tuple(self._view_errors(*view_pair) for view_pair in view_pairs)

    def _view_errors(self, left: TargetView | None, right: TargetView | None) -> PairErrors:
        if left is None or right is None:
            return PairErrors(np.zeros(0), np.zeros((0, 2)))
        numberings = [right]
        if right.target.half_turn_symmetric:
            numberings.append(half_turned(right))
        errors = [pair_errors(self._cameras, left, view) for view in numberings]
        return min(errors, key=lambda errors_of_pair: _rms([errors_of_pair.epipolar]))

    def rectify(self, alpha: float = 0.0, size: tuple[int, int] | None = None) -> Rectification:
        """Return the maps that make the rows of both images show the same points.

        Args:
            alpha: 0: all pixels of the output are valid; 1: all source pixels are kept; or between.
            size: size of the output, width and height in pixels; None: the source's.

        Raises:
            CalibrationError: ``SHAPE``, ``WRONG_SIZE``: as in
                :func:`~smartcam.calibration._stereo.rectification.rectify`.
        """
        return rectify(self.left, self.right, self.transform, alpha=alpha, size=size)

    @property
    def _cameras(self) -> CameraPair:
        return CameraPair(self.left, self.right, self.transform)

    def _as_pixels(self, left: ArrayLike, right: ArrayLike) -> tuple[Array, Array]:
        first, second = as_points(left, 2, "left pixels"), as_points(right, 2, "right pixels")
        if len(first) != len(second):
            raise Code.SHAPE.error(
                f"pixels: expected as many on both sides, got {len(first)} and {len(second)}",
                len(first),
                len(second),
            )
        return first, second

    def _check(self, fields: Mapping[str, Any], label: str) -> None:
        storage.check_shape(self.covariance, (6, 6), label, "covariance")
        if self.sheet is not None:
            storage.check_shape(self.sheet, fields["target"].points.shape, label, "sheet")


def _first_target(calibration: StereoCalibration) -> Target:
    pairs = calibration.pairs
    return next(view.target for pair in pairs for view in (pair.left, pair.right) if view)


@check_arguments(
    left_views=a_list,
    right_views=a_list,
    distortion_model=check_text,
    fixed=each(check_text),
    sheet=check_text,
    drop_bad=check_flag,
)
@one_blas_thread
def calibrate_stereo(
    left_views: Sequence[TargetView | None],
    right_views: Sequence[TargetView | None],
    *,
    left: CameraModel | None = None,
    right: CameraModel | None = None,
    distortion_model: DistortionModel = "plumb_bob",
    fixed: Iterable[str] = (),
    sheet: SheetOption = "auto",
    drop_bad: bool = True,
) -> StereoCalibration:
    """Calibrate both lenses and the pose of the left camera in the right one's frame.

    Lenses, transform and poses are adjusted together to the least reprojection error in both
    images; each point is weighted by its covariance, and by the additional variance that the
    residuals show. The order of the pairs does not matter.

    Args:
        left_views: views of one target, one for each moment; None if the left camera does not see
            it.
        right_views: views of the right camera at the same moments.
        left: lens of the left camera, if it is known and must not change; None: it is fitted.
        right: lens of the right camera, if it is known and must not change; None: it is fitted.
        distortion_model: model of the lenses that are fitted.
        fixed: coefficients of fitted lenses that stay 0, such as ``k3``; ``aspect`` makes fx and fy
            the same.
        sheet: ``auto``, ``exact`` or ``free``: whether the target's points are adjusted, too, as in
            :func:`~smartcam.calibration.calibrate_intrinsics`.
        drop_bad: whether views that fit far worse than the others are left out, at most a third of
            them; a warning names them in any case. In a pair whose views do not belong together the
            right view is left out.

    Raises:
        CalibrationError: ``TOO_FEW``: fewer than 3 pairs, or than 2 if both lenses are known;
            ``SHAPE``: lists of different lengths, a coefficient that is not valid, or more points
            than can be adjusted; ``WRONG_SIZE``, ``DIFFERENT_TARGETS``, ``COLLINEAR``,
            ``NOT_FINITE``; ``POOR_FIT``: no lens or no transform fits the views, as when the views
            of many pairs are from different moments; ``INSUFFICIENT_ROTATION``: the target was not
            tilted; ``MIRRORED``: pictures were flipped; ``COINCIDENT``: both sides are of one
            camera; ``SWAPPED_LENSES``: ``left`` is the right camera's, and ``right`` the left
            one's.
    """
    view_pairs = as_view_pairs(left_views, right_views)
    check_pairs(view_pairs, (left, right))
    check_choice(sheet, get_args(SheetOption), "sheet")
    min_pairs = MIN_PAIRS if left and right else MIN_VIEWS
    complete = [number for number, view_pair in enumerate(view_pairs) if None not in view_pair]
    if len(complete) < min_pairs:
        raise Code.TOO_FEW.error_with_value(
            f"stereo: expected {min_pairs} pairs or more in which both cameras see the target",
            min_pairs,
            len(complete),
        )
    lenses = Lenses((left, right), distortion_model, tuple(as_list(fixed, str, "fixed: name")))
    view_pairs, bundle, mismatched = guess_start(view_pairs, lenses)
    indexed = [
        IndexedView(side, number, view)
        for number, view_pair in enumerate(view_pairs)
        for side, view in enumerate(view_pair)
        if view is not None
    ]
    max_bad, bad = MAX_BAD_VIEW_SHARE * len(indexed), list[IndexedView]()
    bad += [
        entry for entry in indexed if entry.camera_index == 1 and entry.pose_index in mismatched
    ]
    others = [entry for entry in indexed if entry not in bad]
    if (
        drop_bad
        and len(bad) <= MAX_BAD_VIEW_SHARE * len(complete)
        and len(_complete_pairs(others)) >= min_pairs
    ):
        indexed = others
    while True:
        adjusted = adjust_weighted(bundle, indexed)
        if not math.isfinite(adjusted.weighted_squares):
            raise Code.POOR_FIT.error(
                "stereo: expected cameras that fit the pairs of views, got points of the target "
                "behind a camera"
            )
        worst, ratio = worst_view([entry.view for entry in indexed], adjusted)
        if ratio <= BAD_VIEW_RATIO:
            break
        if indexed[worst] not in bad:
            bad.append(indexed[worst])
        others = indexed[:worst] + indexed[worst + 1 :]
        if not drop_bad or len(bad) > max_bad or len(_complete_pairs(others)) < min_pairs:
            break
        indexed, bundle = others, adjusted.bundle
    recalibrate = functools.partial(
        calibrate_stereo,
        left=left,
        right=right,
        distortion_model=distortion_model,
        fixed=lenses.fixed,
        sheet=sheet,
        drop_bad=drop_bad,
    )
    calibration = _build_calibration(
        _StereoSolution(view_pairs, indexed, bad, adjusted, min_pairs, mismatched), sheet
    )
    return examine_pairs(calibration, recalibrate, known=(left, right), drop_strays=drop_bad)


def _complete_pairs(indexed: Sequence[IndexedView]) -> list[int]:
    """Return the indices of the moments at which both cameras see the target."""
    sides = [
        {entry.pose_index for entry in indexed if entry.camera_index == side} for side in range(2)
    ]
    return sorted(sides[0] & sides[1])


class _StereoSolution(NamedTuple):
    """The fit from which a calibration is built."""

    view_pairs: list[ViewPair]  # all views, the right ones numbered as the left ones
    indexed: list[IndexedView]  # used views
    bad: list[IndexedView]  # views that fit badly, whether used or not
    adjusted: AdjustedBundle  # fitted cameras
    min_pairs: int  # number of pairs that are needed
    # indices of pairs whose views do not belong together, as in :class:`FirstGuess`
    mismatched: Mapping[int, float]

    def pair(self, number: int) -> tuple[TargetView, TargetView]:
        """Return the views of a moment that both cameras see."""
        left, right = self.view_pairs[number]
        if left is None or right is None:
            raise KeyError(number)
        return left, right


def _held_out_errors(
    solution: _StereoSolution, left_out: Sequence[LeftOut]
) -> dict[int, PairErrors]:
    """Return the errors of each pair, with cameras that were fitted without this pair."""
    pairs = _complete_pairs(solution.indexed)
    if len(pairs) <= solution.min_pairs:
        return {}
    return {
        fit.pose: pair_errors(_camera_pair(fit.bundle), *solution.pair(fit.pose))
        for fit in left_out
        if fit.pose in pairs
    }


def _camera_pair(bundle: Bundle) -> CameraPair:
    left, right = bundle.cameras
    return CameraPair(left, right, Transform(RIGHT, LEFT, *bundle.rig.subset(0)))


def _build_calibration(solution: _StereoSolution, sheet: SheetOption) -> StereoCalibration:
    check_fit(solution.adjusted.rms, solution.indexed, solution.bad)
    sheet_fit = choose_shape(solution.adjusted, solution.indexed, sheet)
    adjusted = sheet_fit.adjusted
    solution, held_out_errors = (
        solution._replace(adjusted=adjusted),
        _held_out_errors(solution, sheet_fit.left_out),
    )
    cameras = _camera_pair(adjusted.bundle)
    epipolar = [
        pair_errors(cameras, *solution.pair(n)).epipolar for n in _complete_pairs(solution.indexed)
    ]
    calibration = StereoCalibration(
        **cameras._asdict(),
        covariance=camera_covariance(adjusted, sheet_fit.left_out)[-6:, -6:],
        pairs=tuple(
            _pair_fit(solution, number, held_out_errors)
            for number in range(len(solution.view_pairs))
        ),
        rms=adjusted.rms,
        sigma=math.sqrt(adjusted.extra_variance),
        epipolar=_rms(epipolar),
        held_out=_rms([errors.spacing for errors in held_out_errors.values()]),
        held_out_epipolar=_rms([errors.epipolar for errors in held_out_errors.values()]),
        sheet=sheet_fit.offsets,
        warnings=(),
    )
    remarks = _remarks(calibration, solution, sheet_fit.remarks)
    return dataclasses.replace(calibration, warnings=tuple(remarks))


def _rms(arrays: Sequence[Array]) -> float:
    values = np.concatenate([array.ravel() for array in arrays]) if arrays else np.zeros(0)
    return math.sqrt(float((values**2).mean())) if len(values) else math.nan


def _pair_fit(
    solution: _StereoSolution, number: int, held_out_errors: Mapping[int, PairErrors]
) -> PairFit:
    rms = {
        entry.camera_index: _rms([residuals])
        for entry, residuals in zip(solution.indexed, solution.adjusted.residuals, strict=True)
        if entry.pose_index == number
    }
    pose = Transform(LEFT, TARGET, *solution.adjusted.bundle.poses.subset(number))
    left, right = solution.view_pairs[number]
    errors = held_out_errors.get(number)
    return PairFit(
        left=left,
        right=right,
        used=(0 in rms, 1 in rms),
        transform=pose if rms else None,
        rms=(rms.get(0, math.nan), rms.get(1, math.nan)),
        held_out=_rms([errors.spacing]) if errors else math.nan,
        epipolar=_rms([errors.epipolar]) if errors else math.nan,
    )


def _remarks(
    calibration: StereoCalibration, solution: _StereoSolution, sheet_remarks: list[Remark]
) -> Iterator[Remark]:
    for bad in solution.bad:
        is_used = any(bad is entry for entry in solution.indexed)
        outcome = "is used all the same" if is_used else "was not used"
        reason = f"fits more than {BAD_VIEW_RATIO:g} times worse than the others"
        if bad.camera_index == 1 and bad.pose_index in solution.mismatched:
            pixels = solution.mismatched[bad.pose_index]
            distance = f"{pixels:.3g} pixels off" if math.isfinite(pixels) else "nowhere near"
            reason = (
                f"is {distance} where the left view and the other pairs have it: the two are of "
                "different moments, or swapped"
            )
        name = f"{view_name(bad.view, bad.pose_index)}, {SIDES[bad.camera_index]}"
        yield Code.BAD_VIEW.remark(f"{name}: {reason}; it {outcome}")
    if calibration.rms > POOR_FIT_RMS_PX:
        yield Code.POOR_FIT.remark(
            f"residuals of {calibration.rms:.3g} pixels rms, expected {POOR_FIT_RMS_PX:g} at most: "
            "a lens is not of its model, the sheet is not flat, or the pairs were not taken at the "
            "same moments"
        )
    yield from side_remarks(calibration.transform)
    yield from sheet_remarks
    if math.isnan(calibration.held_out):
        yield Code.NOT_HELD_OUT.remark(
            f"{len(_complete_pairs(solution.indexed))} pairs are just enough for the fit: "
            "with more pairs, the cameras could be tested with pairs that were not used to fit them"
        )


def _pixel_covariances(covariance: ArrayLike | None, count: int, side: str) -> Array:
    if covariance is None:
        return np.tile(np.eye(2), (count, 1, 1))
    return as_covariances(covariance, count, f"{side} covariance")
