"""Check whether the views of two cameras, and the calibration found from them, are plausible."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._lens.misfit import (
    LENS,
    RIG,
    RIGHT_LENS,
    UNKNOWN_COUNT,
    FittedView,
    lens_remarks,
    misfit_remarks,
)
from smartcam.calibration._lens.poses import locate
from smartcam.calibration._lens.suspicions import (
    find_strays,
    max_plausible_rms,
    remove_points,
    stray_remarks,
    view_remarks,
)
from smartcam.calibration._stereo.start import SIDES
from smartcam.calibration._views import check_type, view_name
from smartcam.geometry import CameraModel
from smartcam.geometry._inside import Code, Remark

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from smartcam.calibration._lens.bundle import IndexedView
    from smartcam.calibration._stereo.calibration import StereoCalibration
    from smartcam.calibration._stereo.start import ViewPair
    from smartcam.calibration._views import TargetView
    from smartcam.geometry import Transform
    from smartcam.geometry._inside import Array

MAX_RMS_PX: Final = 5.0
"""Residual RMS, pixels, above which the views of pairs do not belong together."""

MAX_RMS_SHARE: Final = 0.005
"""MAX_RMS_PX is raised to this fraction of the longer side of the image if that is larger."""

EXCHANGED_RESIDUAL_RATIO: Final = 1.05
"""Lenses were given in the wrong order if exchanging them makes the residuals this many times
smaller. Two lenses of one model in the wrong order make them 1.7 times larger or more (measured on
recorded pairs)."""

MIN_SWAPPED_SHARE: Final = 0.75
"""Lenses are swapped only if at least this fraction of the pairs fits better with them
exchanged."""

MIN_APART_CHI2: Final = 30.0
"""The cameras stand apart if the square of their distance, in standard deviations, is more than
this. For two cameras at one place, noise exceeds this value once in a million calibrations."""

RIGHT_ANGLE_TRACE: Final = 1.0
"""Trace of a rotation by a right angle."""


def check_pairs(view_pairs: Sequence[ViewPair], known: tuple[CameraModel | None, ...]) -> None:
    """Refuse pairs that one camera took, and known lenses that were given for the wrong sides.

    Raises ``COINCIDENT`` if an image is given for both sides, and ``SWAPPED_LENSES``.
    """
    for side, lens in zip(SIDES, known, strict=True):
        check_type(lens, (CameraModel, type(None)), f"stereo: {side}")
    pairs = [
        (number, left, right)
        for number, (left, right) in enumerate(view_pairs)
        if left is not None and right is not None
    ]
    for number, left, right in pairs:
        if np.array_equal(left.ids, right.ids) and np.array_equal(left.points, right.points):
            raise Code.COINCIDENT.error(
                "stereo: expected images of two cameras, got the same image on both sides in "
                f"{view_name(left, number)}",
                "two cameras",
                number,
            )
    first, second = known
    if first is None or second is None or first.size != second.size or not pairs:
        return
    views = [(left, right) for _, left, right in pairs if left.size == right.size == first.size]
    squares, exchanged_squares = (
        np.array(
            [
                sum(_squares(view, lens) for view, lens in zip(pair, lenses, strict=True))
                for pair in views
            ]
        )
        for lenses in ((first, second), (second, first))
    )
    ratio = (
        math.sqrt(float(squares.sum() / exchanged_squares.sum()))
        if exchanged_squares.sum() > 0
        else 1.0
    )
    if (
        ratio > EXCHANGED_RESIDUAL_RATIO
        and (exchanged_squares < squares).mean() >= MIN_SWAPPED_SHARE
    ):
        raise Code.SWAPPED_LENSES.error(
            "stereo: expected the left camera's lens as left and the right one's as right, got "
            f"residuals {ratio:.3g} times as large as with the two exchanged",
            1.0,
            ratio,
        )


def _squares(view: TargetView, camera: CameraModel) -> float:
    return float((locate(view, camera).residuals ** 2).sum())


def check_cameras_apart(transform: Transform, covariance: Array) -> None:
    """Raise ``COINCIDENT`` if both cameras are at the same place.

    ``covariance`` (6, 6) is that of ``T_right_left``.
    """
    # only the variance along the shift is used: even a few views are enough to determine it, but
    # not the whole covariance
    shift, shift_covariance = transform.translation, covariance[3:, 3:]
    if float(shift @ shift) ** 2 <= MIN_APART_CHI2 * float(shift @ shift_covariance @ shift):
        raise Code.COINCIDENT.error(
            "stereo: expected two cameras that stand apart, got one "
            f"{1e3 * float(np.linalg.norm(shift)):.2g} mm from the other, a distance that may be "
            "zero within its uncertainty: are the images of both sides those of one camera?",
            "two places",
            float(np.linalg.norm(shift)),
        )


def examine_pairs(
    calibration: StereoCalibration,
    recalibrate: Callable[..., StereoCalibration],
    *,
    known: tuple[CameraModel | None, CameraModel | None],
    drop_strays: bool,
) -> StereoCalibration:
    """Return the calibration with remarks on suspicious views, and without stray points.

    ``recalibrate`` calibrates from other views of both sides. ``known``: the known lenses.
    ``drop_strays``: whether stray points are left out. Raises ``COINCIDENT`` if the cameras do not
    stand apart.
    """
    check_cameras_apart(calibration.transform, calibration.covariance)
    views_by_side = [
        [pair.left for pair in calibration.pairs],
        [pair.right for pair in calibration.pairs],
    ]
    side_views = list(_side_views(calibration))
    fitted, used = [entry.fitted for entry in side_views], [entry.used for entry in side_views]
    names = [
        f"{view_name(entry.fitted.view, entry.pair)}, {SIDES[entry.side]}" for entry in side_views
    ]
    fit_remarks = list(view_remarks([fit.view for fit in fitted], names))
    for side, name in enumerate(SIDES):
        if known[side] is not None:
            fits = [entry.fitted for entry in side_views if entry.used and entry.side == side]
            fit_remarks += lens_remarks(fits, f"{name} lens", calibration.sigma**2)
    pairs = [
        list(group) for _, group in itertools.groupby(side_views, key=lambda entry: entry.pair)
    ]
    complete = [
        pair_views
        for pair_views in pairs
        if len(pair_views) == 2 and all(entry.used for entry in pair_views)
    ]
    free = np.zeros(UNKNOWN_COUNT, dtype=np.bool_)
    free[LENS], free[RIGHT_LENS] = (lens is None for lens in known)
    free[RIG] = True
    fit_remarks += misfit_remarks(
        [
            (left.fitted, right.fitted._replace(rig=calibration.transform.rigid))
            for left, right in complete
        ],
        calibration.sigma**2,
        free,
        [view_name(left.fitted.view, left.pair) for left, _ in complete],
    )
    outliers = find_strays(fitted, calibration.sigma**2, used)
    if outliers and drop_strays:
        for entry, view in zip(
            side_views, remove_points([fit.view for fit in fitted], outliers), strict=True
        ):
            views_by_side[entry.side][entry.pair] = view
        # the new calibration already has the remarks on its own fit
        calibration, fit_remarks = recalibrate(*views_by_side), []
    outcome = "was not used" if drop_strays else "is used all the same"
    remarks = stray_remarks(outliers, names, outcome)
    return dataclasses.replace(
        calibration, warnings=(*remarks, *calibration.warnings, *fit_remarks)
    )


class _SideView(NamedTuple):
    """The view of one camera in a pair."""

    side: int
    pair: int
    used: bool
    fitted: FittedView


def _side_views(calibration: StereoCalibration) -> Iterator[_SideView]:
    for number, pair in enumerate(calibration.pairs):
        if pair.transform is None:
            continue
        poses = pair.transform, calibration.transform @ pair.transform
        for side, view in enumerate((pair.left, pair.right)):
            if view is not None:
                points = view.target.points + (
                    0.0 if calibration.sheet is None else calibration.sheet
                )
                camera = (calibration.left, calibration.right)[side]
                yield _SideView(
                    side,
                    number,
                    pair.used[side],
                    FittedView(view, camera, poses[side].rigid, points),
                )


def check_fit(rms: float, indexed: Sequence[IndexedView], bad: Sequence[IndexedView]) -> None:
    """Raise ``POOR_FIT`` if the views of pairs do not belong together.

    ``rms``: RMS of a coordinate of the residuals, pixels. ``indexed``: the used views.
    ``bad``: the views that fit worst.
    """
    max_rms = max_plausible_rms([entry.view for entry in indexed], MAX_RMS_PX, MAX_RMS_SHARE)
    if rms <= max_rms:
        return
    names = ", ".join(
        f"{view_name(entry.view, entry.pose_index)} ({SIDES[entry.camera_index]})" for entry in bad
    )
    raise Code.POOR_FIT.error(
        "stereo: expected cameras that fit the pairs of views, got residuals of "
        f"{rms:.3g} pixels rms, {max_rms:.3g} at most expected: were the views of each pair taken "
        f"at the same moment, and are they in the same order? Those that fit worst: "
        f"{names or 'all alike'}",
        max_rms,
        rms,
    )


def side_remarks(transform: Transform) -> list[Remark]:
    """Return a remark if the right camera is left of the left one, by ``T_right_left``."""
    shift = transform.translation
    is_swapped = shift[0] > 0 and shift[0] == np.abs(shift).max()
    if not is_swapped or float(np.trace(transform.rotation)) <= RIGHT_ANGLE_TRACE:
        return []
    return [
        Code.SWAPPED_SIDES.remark(
            "left and right seem swapped: expected the right camera on the right of the left one, "
            f"got it {1e3 * shift[0]:.3g} mm on the left; if that is intended, ignore this"
        )
    ]
