"""Find suspicious views once a lens is fitted: points that are off, views that are copies.

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
    COUNT,
    LENSES,
    Equations,
    Fitted,
    Reduced,
    lens_remarks,
    misfit_remarks,
)
from smartcam.calibration._lens.projection import excess
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
"""A point is a stray if it is off by both the standard deviations and the pixels of either pair. In
200 recorded views, whose noise is not quite normal, the farthest points are 9.6 deviations and 0.8
pixels off, or 5.9 and 1.8 (measured)."""

MAX_STRAY_SHARE: Final = 0.2
"""At most this part of a view's points are strays: with more, the view is bad as a whole."""

MIN_POINTS_KEPT: Final = 8
"""Strays are left out only if this many points are left: with fewer, any of them may be the wrong
one."""

MEDIAN_SQUARED_LENGTH: Final = 2.0 * math.log(2.0)
"""Median of the squared length of two independent normal numbers with a variance of 1."""

MAX_POINTS_IN_MESSAGE: Final = 5
"""A message names at most this many points."""

MAX_RMS_PX: Final = 10.0
"""Residual RMS, pixels, above which points are not the target's: the wrong model of a lens leaves
less."""

MAX_RMS_SHARE: Final = 0.015
"""The limit MAX_RMS_PX as a part of the longer side of the image; the larger of both holds."""

MAX_RMS_SIGMAS: Final = 20.0
"""The limit MAX_RMS_PX as a multiple of the points' standard deviation; the larger holds."""

DOUBTED_CENTRE_OFFSET_SHARE: Final = 0.2
"""A principal point that lies this part of the image's sides off the centre may belong to another
image."""

DOUBTED_CENTRE_SIGMAS: Final = 5.0
"""Least distance of a doubted principal point from the centre, in standard deviations."""


class Stray(NamedTuple):
    """A point of a view that is not where the others predict it."""

    number: int  # index of the view
    row: int  # index of the point in the view
    ident: int  # number of the point on the target
    off: float  # distance from the predicted place, pixels


def strays(
    fitted: Sequence[Fitted], more: float, used: Sequence[bool], *, lens: bool = True
) -> list[Stray]:
    """Return the points that lie far from where all others predict them.

    ``more``: variance in addition to the points' own, pixels^2. ``used``: mask of the views that it
    was estimated from; another view may be bad because of a few of its points. ``lens``: whether
    the lens was fitted to the views; if not, a point is no stray when a lens that fits the other
    points predicts its place.
    """
    equations = [view.equations(more) for view in fitted]
    squares_of_views = _stray_squares(equations, used)
    if not lens and any(squares.any() for squares in squares_of_views):
        equations = _with_their_lens(equations, [squares == 0 for squares in squares_of_views])
        squares_of_views = _stray_squares(equations, used)
    outliers = []
    for number, (equation, squares) in enumerate(zip(equations, squares_of_views, strict=True)):
        for row in np.flatnonzero(squares).tolist():
            pixels = float(equation.deviations[row]) * math.sqrt(squares[row])
            outliers.append(Stray(number, row, int(fitted[number].view.ids[row]), pixels))
    return outliers


def _with_their_lens(equations: Sequence[Equations], masks: Sequence[Mask]) -> list[Equations]:
    """Return the equations after fitting the lens to the kept points."""
    masked = [
        Equations(*(part[rows] for part in equation))
        for equation, rows in zip(equations, masks, strict=True)
    ]
    change = Reduced.of(masked).best(LENSES)[0]
    left = []
    for equation, rows in zip(equations, masks, strict=True):
        residuals = equation.residuals - equation.by_shared @ change
        by_pose, right = equation.by_pose[rows].reshape(-1, 6), residuals[rows].ravel()
        step = solve_scaled(by_pose.T @ by_pose, by_pose.T @ right)
        left.append(equation._replace(residuals=residuals - equation.by_pose @ step))
    return left


def squares_off(equations: Equations, scale: float) -> Array:
    """Return the squared distances (N,) of points from their predicted places, 0 for small ones.

    The other points of the view predict the places. ``scale``: squared length of one standard
    deviation along each axis.
    """
    inliers = np.full(len(equations.residuals), np.isfinite(equations.residuals).all())
    least = max(MIN_POINTS_KEPT, (1.0 - MAX_STRAY_SHARE) * len(inliers))
    while inliers.sum() >= least:
        rows, right = (
            equations.by_pose[inliers].reshape(-1, 6),
            equations.residuals[inliers].ravel(),
        )
        step = solve_scaled(rows.T @ rows, rows.T @ right)
        squares = ((equations.residuals - equations.by_pose @ step) ** 2).sum(axis=1)
        outlying = _outlying(equations, squares, scale)
        if not (inliers & outlying).any():
            return np.where(~inliers & outlying, squares, 0.0)
        inliers[int(np.argmax(np.where(inliers & outlying, squares, 0.0)))] = False
    return np.zeros(len(equations.residuals))


def _outlying(equations: Equations, squares: Array, scale: float) -> Mask:
    pixels = equations.deviations * np.sqrt(squares)
    times = np.sqrt(squares / max(scale, np.finfo(np.float64).tiny))
    outlying: Mask = np.any(
        [(times > most) & (pixels > least) for most, least in STRAY_LIMITS], axis=0
    )
    return outlying


def _stray_squares(equations: Sequence[Equations], used: Sequence[bool]) -> list[Array]:
    """Return the squared distances (N,) from their predicted places in each view, 0 for most."""
    of_used = itertools.compress(equations, used)
    # unlike the variance of all points, the median is hardly changed by a few strays
    middle = np.median(
        np.concatenate([(equation.residuals**2).sum(axis=1) for equation in of_used])
    )
    return [squares_off(equation, float(middle) / MEDIAN_SQUARED_LENGTH) for equation in equations]


def without(views: Sequence[TargetView], outliers: Sequence[Stray]) -> list[TargetView]:
    """Return views without some of their points."""
    fewer = list(views)
    for number, group in itertools.groupby(outliers, key=lambda outlier: outlier.number):
        view = views[number]
        rows = np.setdiff1d(np.arange(len(view.ids)), [outlier.row for outlier in group])
        fewer[number] = dataclasses.replace(
            view,
            ids=view.ids[rows],
            points=view.points[rows],
            covariance=view.covariance[rows],
        )
    return fewer


def stray_remarks(outliers: Sequence[Stray], names: Sequence[str], done: str) -> Iterator[Remark]:
    """Yield the remarks on strays; ``names`` are those of the views."""
    counts = collections.Counter(outlier.ident for outlier in outliers)
    often = {ident for ident, count in counts.items() if count >= max(3, len(names) / 2)}
    for ident in sorted(often):
        distances = [outlier.off for outlier in outliers if outlier.ident == ident]
        yield Code.OUTLIER.remark(
            f"point {ident} of the target is {np.median(distances):.3g} pixels off in "
            f"{len(distances)} of {len(names)} views: it is not at its nominal place, "
            "or something is taken for "
            f"it; it {done} there"
        )
    rest = [outlier for outlier in outliers if outlier.ident not in often]
    if rest:
        each = [
            f"{outlier.ident} in {names[outlier.number]} ({outlier.off:.3g} pixels)"
            for outlier in rest
        ]
        yield Code.OUTLIER.remark(
            f"points that are not where the others of their views have them: "
            f"{_listed(each, ', ')}: each {done}"
        )


def _listed(texts: Sequence[str], separator: str) -> str:
    more = len(texts) - MAX_POINTS_IN_MESSAGE
    first = separator.join(texts[:MAX_POINTS_IN_MESSAGE])
    return f"{first}, and {more} more" if more > 0 else first


def without_strays(
    views: Sequence[TargetView], poses: Sequence[TargetPose], camera: CameraModel, *, given: bool
) -> tuple[list[TargetView], list[Remark]]:
    """Return the views without their stray points, and the remarks about views, points and lens.

    ``given``: the user gave the lens, so it may be another camera's; else these views gave it.
    """
    residuals = np.concatenate([pose.residuals for pose in poses])
    noise = np.concatenate([view.covariance for view in views])
    more = excess(residuals, noise, residuals.size - 6 * len(views))
    fitted = [
        Fitted(view, camera, pose.transform.rigid, view.target.points)
        for view, pose in zip(views, poses, strict=True)
    ]
    outliers = strays(fitted, more, [True] * len(fitted), lens=False)
    names = [view_name(view, number) for number, view in enumerate(views)]
    left = without(views, outliers)
    cleaned = [fit._replace(view=view) for fit, view in zip(fitted, left, strict=True)]
    remarks = stray_remarks(outliers, names, "was not used"), view_remarks(views, names)
    of_lens = lens_remarks(cleaned, "lens", more) if given else ()
    return left, [*itertools.chain(*remarks), *of_lens]


def examined(
    calibration: IntrinsicCalibration,
    again: Callable[[list[TargetView]], IntrinsicCalibration],
    *,
    drop: bool,
) -> IntrinsicCalibration:
    """Return the calibration without stray points, and with remarks on them.

    ``again`` calibrates from other views. ``drop``: whether stray points are left out. Raises
    ``POOR_FIT``: the points are not the target's.
    """
    views, used = (
        [fit.view for fit in calibration.views],
        [fit.used for fit in calibration.views],
    )
    points = views[0].target.points + (0.0 if calibration.sheet is None else calibration.sheet)
    fitted = [
        Fitted(fit.view, calibration.camera, fit.transform.rigid, points)
        for fit in calibration.views
    ]
    names = [view_name(view, number) for number, view in enumerate(views)]
    check_rms("intrinsics", calibration.rms, views)
    of_fit = [*view_remarks(views, names), *_remarks_on_middle(calibration)]
    free = np.zeros(COUNT, dtype=np.bool_)
    free[: len(calibration.covariance)] = np.diag(calibration.covariance) > 0
    of_used = [[fit] for fit in itertools.compress(fitted, used)], calibration.sigma**2, free
    of_fit += misfit_remarks(*of_used, list(itertools.compress(names, used)))
    outliers = strays(fitted, calibration.sigma**2, used)
    if outliers and drop:
        calibration, of_fit = again(without(views, outliers)), []  # remarked on by check_rms
    done = "was not used" if drop else "is used all the same"
    remarks = stray_remarks(outliers, names, done)
    return dataclasses.replace(calibration, warnings=(*remarks, *calibration.warnings, *of_fit))


def view_remarks(views: Sequence[TargetView], names: Sequence[str]) -> Iterator[Remark]:
    """Yield a remark on copied views."""
    groups = collections.defaultdict[tuple[bytes, bytes], list[str]](list)
    for view, name in zip(views, names, strict=True):
        groups[view.ids.tobytes(), view.points.tobytes()].append(name)
    copies = [", ".join(group) for group in groups.values() if len(group) > 1]
    if copies:
        yield Code.COINCIDENT.remark(
            "views that are the same to the last digit: "
            f"{_listed(copies, '; ')}: "
            "they count as often as they are there, and errors come out too small"
        )


def _remarks_on_middle(calibration: IntrinsicCalibration) -> Iterator[Remark]:
    size = np.array(calibration.camera.size)
    middle, sigmas = calibration.camera.matrix[:2, 2], np.sqrt(np.diag(calibration.covariance)[2:4])
    distances = np.abs(middle - (size - 1) / 2)
    if (
        (distances > DOUBTED_CENTRE_OFFSET_SHARE * size)
        & (distances > DOUBTED_CENTRE_SIGMAS * sigmas)
    ).any():
        yield Code.WRONG_SIZE.remark(
            f"expected the principal point near the middle of an image of {size[0]} x {size[1]} "
            f"pixels, got ({middle[0]:.0f}, {middle[1]:.0f}): were points taken from an image of "
            "another size? Where images are cut to a part of the sensor's, all is well"
        )


def check_rms(label: str, rms: float, views: Sequence[TargetView]) -> None:
    """Raise ``POOR_FIT`` if the residuals are so large that the points cannot be the target's."""
    most = most_rms(views)
    if rms > most:
        raise Code.POOR_FIT.refusal(
            f"{label}: expected views of {views[0].target}, got residuals of {rms:.3g} pixels rms, "
            f"{most:.3g} at most expected: are columns and rows those of the sheet, and are the "
            "points those that their numbers say?",
            most,
            rms,
        )


def most_rms(
    views: Sequence[TargetView], worst: float = MAX_RMS_PX, part: float = MAX_RMS_SHARE
) -> float:
    """Return the RMS of a coordinate, pixels, above which views are impossible."""
    noise = float(np.median(np.concatenate([view.sigmas for view in views])))
    longer = max(max(view.size) for view in views)
    return max(worst, part * longer, MAX_RMS_SIGMAS * noise)
