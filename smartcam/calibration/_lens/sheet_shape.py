"""Estimate the points of a printed sheet from the views, since printing is not exact.

Printers stretch, paper bends. If many views show the same points off in the same way, the sheet is
wrong, and a lens that is fitted to the nominal points absorbs that error. Then the points are
adjusted together with lenses and poses. As a whole they keep their nominal place, direction and
size, so the scale stays.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from smartcam.calibration._lens.bundle import (
    adjust_weighted,
    leave_out,
)
from smartcam.geometry._inside import Code, Remark, Rigid

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.calibration._lens.bundle import AdjustedBundle, Bundle, IndexedView, LeftOut
    from smartcam.geometry._inside import Array

SheetOption: TypeAlias = Literal["auto", "exact", "free"]
"""Choice between nominal (``exact``) and adjusted points (``free``); ``auto``: the fit decides."""

MIN_POSES: Final = 4
"""Only this many left-out views or more can show whether adjusted points predict better by more
than chance."""

MAX_FREE_POINTS: Final = 1000
"""A target with free points has at most this many: the equations for more would take gigabytes."""


class SheetFit(NamedTuple):
    """A fit with nominal or adjusted points of the sheet, and remarks on the sheet."""

    adjusted: AdjustedBundle
    left_out: list[LeftOut]  # fits without each pose
    # (T, 3), adjusted minus nominal points, metres; None if they are nominal
    offsets: Array | None
    remarks: list[Remark]


def choose_shape(
    adjusted: AdjustedBundle, indexed: Sequence[IndexedView], sheet: SheetOption
) -> SheetFit:
    """Return the fit with the target's points either nominal or adjusted.

    ``adjusted`` has the nominal points. With ``sheet`` ``auto``, points are adjusted if
    that predicts left-out views better, by more than the chance between views.

    Raises ``SHAPE`` if there are more points than may be adjusted.
    """
    count = len(indexed[0].view.target.points)
    if sheet == "free" and count > MAX_FREE_POINTS:
        raise Code.SHAPE.error_with_value(
            f"sheet: expected a target of {MAX_FREE_POINTS} points at most that are free",
            MAX_FREE_POINTS,
            count,
        )
    exact = SheetFit(adjusted, leave_out(adjusted, indexed), None, [])
    if count > MAX_FREE_POINTS or (sheet != "free" and len(exact.left_out) < MIN_POSES):
        return exact
    free_fit = adjust_shape(adjusted.bundle, indexed, adjusted.extra_variance)
    left_out, offsets = (
        leave_out(free_fit, indexed),
        _offsets(free_fit.bundle, indexed[0].view.target.points),
    )
    # nominal points, unless adjusted ones predict better by more than one standard error: Breiman,
    # Friedman, Olshen and Stone, Classification and Regression Trees (1984), section 3.4
    gains = _squares(exact.left_out) - _squares(left_out)
    is_free_better = math.isfinite(free_fit.weighted_squares) and gains.sum() > math.sqrt(
        len(gains)
    ) * gains.std(ddof=1)
    if sheet == "free" or (sheet == "auto" and is_free_better):
        remarks = (
            [_remark(offsets, "the print or the board is not exact")] if is_free_better else []
        )
        return SheetFit(free_fit, left_out, offsets, remarks)
    text = "sheet='exact' keeps the nominal points; sheet='auto' would adjust them"
    return exact._replace(remarks=[_remark(offsets, text)] if is_free_better else [])


def _offsets(bundle: Bundle, nominal: Array) -> Array:
    return np.zeros(nominal.shape) if bundle.points is None else bundle.points - nominal


def _squares(left_out: Sequence[LeftOut]) -> Array:
    return np.array(
        [sum(float((residuals**2).sum()) for residuals in left.residuals) for left in left_out]
    )


def _remark(offsets: Array, text: str) -> Remark:
    rms = 1e3 * math.sqrt(float((offsets**2).sum(axis=1).mean()))
    largest = 1e3 * float(np.linalg.norm(offsets, axis=1).max())
    return Code.SHEET_NOT_EXACT.remark(
        f"the sheet's points are {rms:.2g} mm rms from their nominal places, {largest:.2g} mm "
        f"at most: {text}"
    )


def adjust_shape(
    bundle: Bundle, indexed: Sequence[IndexedView], extra_variance: float
) -> AdjustedBundle:
    """Return the least-squares solution in which the target's points are adjusted, too.

    ``bundle`` is near the solution; the target's points start from its ``points``, or from their
    nominal places if that is None. ``extra_variance``, pixels^2, is a first guess of the variance
    in addition to the points' covariance, which is estimated anew.
    """
    nominal = indexed[0].view.target.points
    points = nominal if bundle.points is None else bundle.points
    free_bundle = dataclasses.replace(bundle, points=points, has_free_points=True)
    adjusted = adjust_weighted(free_bundle, indexed, extra_variance)
    return dataclasses.replace(adjusted, bundle=_move_bundle_to_nominal(adjusted.bundle, nominal))


def _move_bundle_to_nominal(bundle: Bundle, nominal: Array) -> Bundle:
    """Return an equivalent bundle whose points have the nominal place, direction and size."""
    # Points q = s A p + a are shown as p is by poses (R A^T, s t - R A^T a) and a rig (R_c, s t_c):
    # R A^T q + s t - R A^T a = s (R p + t), and a point s times as far away is in the same pixel.
    if bundle.points is None:
        return bundle
    scale, turn, shift = best_similarity(bundle.points, nominal)
    rotation = bundle.poses.rotation @ turn.T
    poses = Rigid(rotation, scale * bundle.poses.translation - rotation @ shift)
    points = scale * bundle.points @ turn.T + shift
    return dataclasses.replace(bundle, points=points, poses=poses, rig=bundle.rig.scaled(scale))


def moved_to_nominal(points: Array, nominal: Array) -> Array:
    """Return the points, moved and scaled to the nominal place, direction and size."""
    scale, turn, shift = best_similarity(points, nominal)
    moved: Array = scale * points @ turn.T + shift
    return moved


def best_similarity(points: Array, nominal: Array) -> tuple[float, Array, Array]:
    """Return the scale, turn and shift that bring points (T, 3) nearest to the nominal ones."""
    # Least squares of s R a + t - b: with the points centred and sum b a^T = U S V^T it is
    # R = U diag(1, 1, det(U V^T)) V^T and s = sum b (R a) / sum |a|^2.
    # Source: Umeyama, Least-Squares Estimation of Transformation Parameters Between Two Point
    # Patterns (1991).
    centre = points.mean(axis=0)
    centred, nominal_centred = points - centre, nominal - nominal.mean(axis=0)
    left, _, right = np.linalg.svd(nominal_centred.T @ centred)
    turn = left @ np.diag([1.0, 1.0, math.copysign(1.0, np.linalg.det(left @ right))]) @ right
    scale = float(((centred @ turn.T) * nominal_centred).sum() / (centred**2).sum())
    return scale, turn, nominal.mean(axis=0) - scale * turn @ centre
