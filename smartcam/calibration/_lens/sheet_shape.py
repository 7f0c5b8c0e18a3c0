"""What is printed is not quite what was meant: the points of a sheet as the views show them.

Printers stretch, paper bends. Where many views show the same points off in the same way, the sheet
is off, and a lens that is fitted to the points as they were meant takes the blame. Then the points
are adjusted together with lenses and poses. As a whole they keep place, direction and size of the
points that were meant, so no scale is lost.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias, TypeVar

import numpy as np

from smartcam.calibration._codes import Code, Remark
from smartcam.calibration._geometry.rigid import Rigid
from smartcam.calibration._least_squares import inverse_scaled, solve_scaled
from smartcam.calibration._lens.bundle import BundleEquations, adjust_weighted, free_points
from smartcam.calibration._lens.projection import SMOOTH
from smartcam.calibration._statistics import Noise
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from smartcam.calibration._geometry.rotations import Array
    from smartcam.calibration._lens.bundle import AdjustedBundle, Bundle, Sight

Errors = TypeVar("Errors")

Sheet: TypeAlias = Literal["auto", "exact", "free"]
"""Whether a sheet's points are where they were meant to be."""

CHANCE: Final = 1e-3
"""How seldom noise alone may pass for a sheet that is not as it was meant to be."""


MOST_POINTS: Final = 1000
"""Of a target that may be free: the equations of more would take gigabytes."""


class Shape(NamedTuple):
    """Which points a fit has, and what says that they are not as they were meant to be."""

    adjusted: AdjustedBundle
    off: Array | None  # (T, 3), metres, by how much they are adjusted
    remarks: list[Remark]


def choose_shape(
    adjusted: AdjustedBundle,
    sights: Sequence[Sight],
    sheet: Sheet,
    held_out: Callable[[AdjustedBundle], Errors],
    rms: Callable[[Errors], float],
) -> tuple[Shape, Errors]:
    """Return the fit with the target's points as meant or as seen, and its held-out errors.

    ``adjusted`` has the points as they were meant. ``sheet``: ``auto``: adjusted where the
    residuals show that they are not, and the held-out error is not larger with them. ``held_out``
    gives the held-out errors of a fit, ``rms`` is of these; NaN where there are none.

    Raises ``SHAPE``: more points than may be free.
    """
    count = len(sights[0].view.target.points)
    if sheet == "free" and count > MOST_POINTS:
        raise CalibrationError(
            f"sheet: expected a target of {MOST_POINTS} points at most that are free, got {count}",
            code=Code.SHAPE,
            expected=MOST_POINTS,
            got=count,
        )
    doubt, errors = shape_doubt(adjusted, sights), held_out(adjusted)
    if sheet == "free" or (sheet == "auto" and doubt is not None):
        free = adjust_shape(adjusted.bundle, sights, adjusted.more)
        seen = held_out(free)
        if free.bundle.points is not None and (sheet == "free" or rms(seen) <= rms(errors)):
            off = free.bundle.points - sights[0].view.target.points
            return Shape(free, off, [_remark(off, "the print or the board is not exact")]), seen
    done = "it is taken as exact all the same, which sheet='free' does not"
    return Shape(adjusted, None, [] if doubt is None else [_remark(doubt, done)]), errors


def _remark(off: Array, what: str) -> Remark:
    rms = 1e3 * math.sqrt(float((off**2).sum(axis=1).mean()))
    most = 1e3 * float(np.linalg.norm(off, axis=1).max())
    return Remark(
        Code.SHEET_NOT_EXACT,
        f"the sheet's points are {rms:.2g} mm rms from where they were meant to be, {most:.2g} mm "
        f"at most: {what}",
    )


def adjust_shape(bundle: Bundle, sights: Sequence[Sight], more: float) -> AdjustedBundle:
    """Return the least squares in which the target's points are adjusted, too.

    ``bundle`` is near the solution; its ``points`` are where the target's points start from, None
    for where they were meant to be. ``more``: first guess of the variance beside the points'
    covariance, pixels^2; found anew.
    """
    meant = sights[0].view.target.points
    points = meant if bundle.points is None else bundle.points
    free = dataclasses.replace(bundle, points=points, free=True)
    adjusted = adjust_weighted(free, sights, more)
    return dataclasses.replace(adjusted, bundle=_as_meant(adjusted.bundle, meant))


def shape_doubt(adjusted: AdjustedBundle, sights: Sequence[Sight]) -> Array | None:
    """Return by how much (T, 3) the target's points seem off, metres; None where chance may be it.

    ``adjusted`` has them as they were meant. An F-test of what one joint step with the points free
    takes off the weighted squares, beside what any smooth error of the lenses would take.
    """
    # With all else eliminated (Schur's complement, see Normal.reduced) the points' equations are
    # M d = r, and their step takes r^T M^+ r off the squares. Of noise alone it is chi-square, and
    # its mean over that of what remains is F.
    # Source: Seber and Lee, Linear Regression Analysis, 2nd edition (2003), section 4.3.
    meant, count = sights[0].view.target.points, free_points(sights)
    freedom = adjusted.freedom - SMOOTH * len(adjusted.bundle.cameras) - count
    if len(meant) > MOST_POINTS or freedom <= 0:
        return None
    bundle = dataclasses.replace(adjusted.bundle, points=meant, free=True)
    normal = BundleEquations(bundle, sights, adjusted.more, smooth=True).normal(bundle)
    matrix, right, _, alone = normal.reduced()
    points = np.zeros(len(right), dtype=bool)
    points[bundle.of_cameras : bundle.shared] = True
    others = inverse_scaled(matrix[np.ix_(~points, ~points)])
    between = matrix[np.ix_(points, ~points)] @ others
    before = right[~points] @ others @ right[~points] + (normal.own_right * alone).sum()
    step_right = right[points] - between @ right[~points]
    off = solve_scaled(
        matrix[np.ix_(points, points)] - between @ matrix[np.ix_(~points, points)], step_right
    )
    taken = float(step_right @ off)
    left = normal.cost - float(before) - taken
    if left <= 0 or Noise(left / freedom, freedom).chance(taken, count) >= CHANCE:
        return None
    return off.reshape(-1, 3)


def _as_meant(bundle: Bundle, meant: Array) -> Bundle:
    """Return a bundle that shows the same, its points with place, direction and size as meant."""
    # Points q = s A p + a are shown as p is by poses (R A^T, s t - R A^T a) and a rig (R_c, s t_c):
    # R A^T q + s t - R A^T a = s (R p + t), and what is s times as far is in the same pixel.
    if bundle.points is None:
        return bundle
    size, turn, shift = likest(bundle.points, meant)
    back = bundle.poses.rotation @ turn.T
    poses = Rigid(back, size * bundle.poses.translation - back @ shift)
    points = size * bundle.points @ turn.T + shift
    return dataclasses.replace(bundle, points=points, poses=poses, rig=bundle.rig.scaled(size))


def as_meant(points: Array, meant: Array) -> Array:
    """Return points with place, direction and size of those that were meant."""
    size, turn, shift = likest(points, meant)
    fitted: Array = size * points @ turn.T + shift
    return fitted


def likest(points: Array, meant: Array) -> tuple[float, Array, Array]:
    """Return the size, turn and shift that take points (T, 3) to where they were meant to be."""
    # Least squares of s R a + t - b: with the points centred and sum b a^T = U S V^T it is
    # R = U diag(1, 1, det(U V^T)) V^T and s = sum b (R a) / sum |a|^2.
    # Source: Umeyama, Least-Squares Estimation of Transformation Parameters Between Two Point
    # Patterns (1991).
    middle = points.mean(axis=0)
    near, far = points - middle, meant - meant.mean(axis=0)
    left, _, right = np.linalg.svd(far.T @ near)
    turn = left @ np.diag([1.0, 1.0, math.copysign(1.0, np.linalg.det(left @ right))]) @ right
    size = float(((near @ turn.T) * far).sum() / (near**2).sum())
    return size, turn, meant.mean(axis=0) - size * turn @ middle
