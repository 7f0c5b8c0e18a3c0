"""Find suspicious views after a fit: points that are off, and views that are copies.

A point is judged by the part of its residual that the pose of its view cannot compensate.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools
import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._least_squares import solve_scaled
from smartcam.calibration._lens.misfit import (
    LENS_MASK,
    UNKNOWN_COUNT,
    Equations,
    FittedView,
    SharedEquations,
    lens_remarks,
    misfit_remarks,
)
from smartcam.calibration._lens.projection import excess_variance
from smartcam.calibration._views import view_name
from smartcam.geometry._inside import Code, Remark

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from smartcam.calibration._lens.intrinsics import IntrinsicCalibration
    from smartcam.calibration._lens.poses import TargetPose
    from smartcam.calibration._views import TargetView
    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array

    Mask = NDArray[np.bool_]

STRAY_LIMITS: Final = ((7.0, 1.5), (12.0, 0.25))
"""Pairs of standard deviations and pixels. A point is a stray if it is off by more than both values
of a pair. In 200 recorded views, whose noise is not quite normal, the farthest points are off by
9.6 deviations and 0.8 pixels, or by 5.9 deviations and 1.8 pixels (measured)."""

MAX_STRAY_SHARE: Final = 0.2
"""At most this fraction of a view's points are strays: with more, the view is bad as a whole."""

MIN_POINTS_KEPT: Final = 8
"""Strays are left out only while at least this many points are kept: among fewer, it is not clear
which are the strays."""

MEDIAN_SQUARED_LENGTH: Final = 2.0 * math.log(2.0)
"""Median of the squared length of two independent normal numbers with a variance of 1."""

MAX_POINTS_IN_MESSAGE: Final = 5
"""A message names at most this many points."""

MAX_RMS_PX: Final = 10.0
"""Residual RMS, pixels, above which points are taken for those of another target: a wrong model of
the lens causes a smaller RMS."""

MAX_RMS_SHARE: Final = 0.015
"""MAX_RMS_PX is raised to this fraction of the longer side of the image if that is larger."""

MAX_RMS_SIGMAS: Final = 20.0
"""MAX_RMS_PX is raised to this many standard deviations of the points if that is larger."""

DOUBTED_CENTRE_OFFSET_SHARE: Final = 0.2
"""A principal point is doubted if it is farther from the centre than this fraction of the image's
sides: it may belong to an image of another size."""

DOUBTED_CENTRE_SIGMAS: Final = 5.0
"""Least distance of a doubted principal point from the centre, in standard deviations."""


class Stray(NamedTuple):
    """A point of a view that is not where the others predict it."""

    view_index: int  # index of the view
    row: int  # index of the point in the view
    point_id: int  # number of the point on the target
    distance: float  # distance from the predicted place, pixels


def find_strays(
    fitted: Sequence[FittedView],
    extra_variance: float,
    used: Sequence[bool],
    *,
    is_lens_fitted: bool = True,
) -> list[Stray]:
    """Return the points that lie far from where all others predict them.

    ``extra_variance``, pixels^2, is added to the points' covariance; ``used`` is the mask of the
    views from which it was estimated. ``is_lens_fitted``: whether the lens was fitted to the views;
    if not, a point is no stray if a lens that fits the other points predicts its place.
    """
    equations = [view.equations(extra_variance) for view in fitted]
    squares_of_views = _stray_squares_of_views(equations, used)
    if not is_lens_fitted and any(squares.any() for squares in squares_of_views):
        equations = _refit_lens(equations, [squares == 0 for squares in squares_of_views])
        squares_of_views = _stray_squares_of_views(equations, used)
    strays = []
    for view_index, (equation, squares) in enumerate(zip(equations, squares_of_views, strict=True)):
        for row in np.flatnonzero(squares).tolist():
            distance = float(equation.deviations[row]) * math.sqrt(squares[row])
            strays.append(Stray(view_index, row, int(fitted[view_index].view.ids[row]), distance))
    return strays


def _refit_lens(equations: Sequence[Equations], kept_masks: Sequence[Mask]) -> list[Equations]:
    """Return the equations after fitting the lens to the kept points."""
    masked = [
        Equations(*(part[mask] for part in equation))
        for equation, mask in zip(equations, kept_masks, strict=True)
    ]
    change = SharedEquations.from_views(masked).solve(LENS_MASK)[0]
    refitted = []
    for equation, mask in zip(equations, kept_masks, strict=True):
        residuals = equation.residuals - equation.by_shared @ change
        by_pose, right = equation.by_pose[mask].reshape(-1, 6), residuals[mask].ravel()
        step = solve_scaled(by_pose.T @ by_pose, by_pose.T @ right)
        refitted.append(equation._replace(residuals=residuals - equation.by_pose @ step))
    return refitted


def stray_squares(equations: Equations, unit_square: float) -> Array:
    """Return the squared distances (N,) of strays from their predicted places; 0 for other points.

    The other points of the view predict the places. ``unit_square``: squared length of one standard
    deviation along each axis.
    """
    inliers = np.full(len(equations.residuals), np.isfinite(equations.residuals).all())
    min_inliers = max(MIN_POINTS_KEPT, (1.0 - MAX_STRAY_SHARE) * len(inliers))
    while inliers.sum() >= min_inliers:
        rows, right = (
            equations.by_pose[inliers].reshape(-1, 6),
            equations.residuals[inliers].ravel(),
        )
        step = solve_scaled(rows.T @ rows, rows.T @ right)
        squares = ((equations.residuals - equations.by_pose @ step) ** 2).sum(axis=1)
        is_outlying = _is_outlying(equations, squares, unit_square)
        if not (inliers & is_outlying).any():
            return np.where(~inliers & is_outlying, squares, 0.0)
        inliers[int(np.argmax(np.where(inliers & is_outlying, squares, 0.0)))] = False
    return np.zeros(len(equations.residuals))


def _is_outlying(equations: Equations, squares: Array, unit_square: float) -> Mask:
    pixels = equations.deviations * np.sqrt(squares)
    sigmas = np.sqrt(squares / max(unit_square, np.finfo(np.float64).tiny))
    is_outlying: Mask = np.any(
        [(sigmas > max_sigmas) & (pixels > min_pixels) for max_sigmas, min_pixels in STRAY_LIMITS],
        axis=0,
    )
    return is_outlying


def _stray_squares_of_views(equations: Sequence[Equations], used: Sequence[bool]) -> list[Array]:
    """Return the :func:`stray_squares` (N,) of each view."""
    used_equations = itertools.compress(equations, used)
    # unlike the variance of all points, the median is hardly changed by a few strays
    median = np.median(
        np.concatenate([(equation.residuals**2).sum(axis=1) for equation in used_equations])
    )
    return [
        stray_squares(equation, float(median) / MEDIAN_SQUARED_LENGTH) for equation in equations
    ]


def remove_points(views: Sequence[TargetView], strays: Sequence[Stray]) -> list[TargetView]:
    """Return the views without the ``strays``."""
    cleaned = list(views)
    for view_index, group in itertools.groupby(strays, key=lambda stray: stray.view_index):
        view = views[view_index]
        rows = np.setdiff1d(np.arange(len(view.ids)), [stray.row for stray in group])
        cleaned[view_index] = dataclasses.replace(
            view,
            ids=view.ids[rows],
            points=view.points[rows],
            covariance=view.covariance[rows],
        )
    return cleaned


def stray_remarks(strays: Sequence[Stray], names: Sequence[str], outcome: str) -> Iterator[Remark]:
    """Yield remarks on strays in views with these names; ``outcome``: what was done, in words."""
    view_counts = collections.Counter(stray.point_id for stray in strays)
    frequent_ids = {
        point_id for point_id, count in view_counts.items() if count >= max(3, len(names) / 2)
    }
    for point_id in sorted(frequent_ids):
        distances = [stray.distance for stray in strays if stray.point_id == point_id]
        yield Code.OUTLIER.remark(
            f"point {point_id} of the target is {np.median(distances):.3g} pixels off in "
            f"{len(distances)} of {len(names)} views: it is not at its nominal place, "
            f"or something is taken for it; it {outcome} there"
        )
    others = [stray for stray in strays if stray.point_id not in frequent_ids]
    if others:
        descriptions = [
            f"{stray.point_id} in {names[stray.view_index]} ({stray.distance:.3g} pixels)"
            for stray in others
        ]
        yield Code.OUTLIER.remark(
            f"points that are not where the others of their views have them: "
            f"{_join_first(descriptions, ', ')}: each {outcome}"
        )


def _join_first(texts: Sequence[str], separator: str) -> str:
    rest_count = len(texts) - MAX_POINTS_IN_MESSAGE
    first = separator.join(texts[:MAX_POINTS_IN_MESSAGE])
    return f"{first}, and {rest_count} more" if rest_count > 0 else first


def remove_strays(
    views: Sequence[TargetView],
    poses: Sequence[TargetPose],
    camera: CameraModel,
    *,
    is_lens_given: bool,
) -> tuple[list[TargetView], list[Remark]]:
    """Return the views without their stray points, and the remarks about views, points and lens.

    ``is_lens_given``: whether the user gave the lens, which may then be another camera's; otherwise
    it was calibrated from these views.
    """
    residuals = np.concatenate([pose.residuals for pose in poses])
    noise = np.concatenate([view.covariance for view in views])
    extra_variance = excess_variance(residuals, noise, residuals.size - 6 * len(views))
    fitted = [
        FittedView(view, camera, pose.transform.rigid, view.target.points)
        for view, pose in zip(views, poses, strict=True)
    ]
    strays = find_strays(fitted, extra_variance, [True] * len(fitted), is_lens_fitted=False)
    names = [view_name(view, number) for number, view in enumerate(views)]
    cleaned_views = remove_points(views, strays)
    cleaned_fits = [
        fit._replace(view=view) for fit, view in zip(fitted, cleaned_views, strict=True)
    ]
    remarks = stray_remarks(strays, names, "was not used"), view_remarks(views, names)
    lens_warnings = lens_remarks(cleaned_fits, "lens", extra_variance) if is_lens_given else ()
    return cleaned_views, [*itertools.chain(*remarks), *lens_warnings]


def examine_views(
    calibration: IntrinsicCalibration,
    recalibrate: Callable[[list[TargetView]], IntrinsicCalibration],
    *,
    drop_strays: bool,
) -> IntrinsicCalibration:
    """Return the calibration with remarks on suspicious views, and without stray points.

    ``recalibrate`` calibrates from other views. ``drop_strays``: whether stray points are left out.
    Raises ``POOR_FIT`` if the points are not the target's.
    """
    views, used = (
        [fit.view for fit in calibration.views],
        [fit.used for fit in calibration.views],
    )
    points = views[0].target.points + (0.0 if calibration.sheet is None else calibration.sheet)
    fitted = [
        FittedView(fit.view, calibration.camera, fit.transform.rigid, points)
        for fit in calibration.views
    ]
    names = [view_name(view, number) for number, view in enumerate(views)]
    check_rms("intrinsics", calibration.rms, views)
    fit_remarks = [*view_remarks(views, names), *_centre_remarks(calibration)]
    free = np.zeros(UNKNOWN_COUNT, dtype=np.bool_)
    free[: len(calibration.covariance)] = np.diag(calibration.covariance) > 0
    misfit_arguments = (
        [[fit] for fit in itertools.compress(fitted, used)],
        calibration.sigma**2,
        free,
    )
    fit_remarks += misfit_remarks(*misfit_arguments, list(itertools.compress(names, used)))
    strays = find_strays(fitted, calibration.sigma**2, used)
    if strays and drop_strays:
        # the new calibration already has the remarks on its own fit
        calibration, fit_remarks = recalibrate(remove_points(views, strays)), []
    outcome = "was not used" if drop_strays else "is used all the same"
    remarks = stray_remarks(strays, names, outcome)
    return dataclasses.replace(
        calibration, warnings=(*remarks, *calibration.warnings, *fit_remarks)
    )


def view_remarks(views: Sequence[TargetView], names: Sequence[str]) -> Iterator[Remark]:
    """Yield a remark on copied views."""
    groups = collections.defaultdict[tuple[bytes, bytes], list[str]](list)
    for view, name in zip(views, names, strict=True):
        groups[view.ids.tobytes(), view.points.tobytes()].append(name)
    copies = [", ".join(group) for group in groups.values() if len(group) > 1]
    if copies:
        yield Code.COINCIDENT.remark(
            "views that are the same to the last digit: "
            f"{_join_first(copies, '; ')}: "
            "each copy counts as a view of its own, so the estimated errors are too small"
        )


def _centre_remarks(calibration: IntrinsicCalibration) -> Iterator[Remark]:
    size = np.array(calibration.camera.size)
    centre, sigmas = calibration.camera.matrix[:2, 2], np.sqrt(np.diag(calibration.covariance)[2:4])
    distances = np.abs(centre - (size - 1) / 2)
    if (
        (distances > DOUBTED_CENTRE_OFFSET_SHARE * size)
        & (distances > DOUBTED_CENTRE_SIGMAS * sigmas)
    ).any():
        yield Code.WRONG_SIZE.remark(
            f"expected the principal point near the middle of an image of {size[0]} x {size[1]} "
            f"pixels, got ({centre[0]:.0f}, {centre[1]:.0f}): were points taken from an image of "
            "another size? If the images are a cut-out of the sensor's image, ignore this"
        )


def check_rms(label: str, rms: float, views: Sequence[TargetView]) -> None:
    """Raise ``POOR_FIT`` if the residuals are so large that the points cannot be the target's."""
    max_rms = max_plausible_rms(views)
    if rms > max_rms:
        raise Code.POOR_FIT.error(
            f"{label}: expected views of {views[0].target}, got residuals of {rms:.3g} pixels rms, "
            f"{max_rms:.3g} at most expected: are columns and rows those of the sheet, and are the "
            "points those that their numbers say?",
            max_rms,
            rms,
        )


def max_plausible_rms(
    views: Sequence[TargetView], max_pixels: float = MAX_RMS_PX, max_share: float = MAX_RMS_SHARE
) -> float:
    """Return the RMS of a coordinate, pixels, above which points are not those of the target."""
    noise = float(np.median(np.concatenate([view.sigmas for view in views])))
    longer_side = max(max(view.size) for view in views)
    return max(max_pixels, max_share * longer_side, MAX_RMS_SIGMAS * noise)
