"""Explain views that fit a lens worse than noise would: flipped pictures, a zoom, or others.

The likeliest explanation is not proven. So it is given as a warning, which names the other
explanations: sheets that bend anew, a rolling shutter, a lens of another model. The pose of each
view is eliminated first, from the residuals and from the changes that each cause would make, so
only the parts that no pose can compensate are compared.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._least_squares import solve_scaled
from smartcam.calibration._lens.bundle import lens_values
from smartcam.calibration._lens.projection import (
    SMOOTH,
    linearize,
    pose_changes,
    smooth_changes,
    whitening,
)
from smartcam.geometry import Code, Remark

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from smartcam.calibration._views import TargetView
    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array, Rigid

    Mask = NDArray[np.bool_]

FLIPS: Final = {"left to right": (0,), "top to bottom": (1,), "by half a turn": (0, 1)}
"""Ways to flip a picture, each with the axes of the image whose direction changes."""

DEFORMATIONS: Final = 5
"""Number of ways in which a sheet deforms: stretching along x, shearing, and three ways to bend."""

SHUTTER: Final = 2
"""Number of ways in which a rolling shutter deforms a picture: leaning and stretching from row to
row."""

FURTHER_VALUES: Final = DEFORMATIONS + SHUTTER + SMOOTH
"""Number of values, beyond those of the lens, that may explain its misfit."""

MIN_VIEWS_TO_EXPLAIN: Final = 4
"""The misfit of fewer views than this is not explained."""

ZOOM_COST_RATIO: Final = 1.5
"""A zoom is reported if two focal lengths reduce the squares by this factor: recorded views reach
1.08, a rolling shutter 1.32, a zoom of 3 % 1.87 (measured)."""

FITTED_COST_RATIO: Final = 1.2
"""A known lens is wrong if one fitted to the views reduces the squares by this factor: lenses from
other views reach 1.04 on recorded pairs; a focal length that is 1 % off reaches 2 with a noise of
0.05 pixels."""

MIN_VIEWS_FOR_LENS: Final = 3
"""A lens for that comparison is fitted to at least this many views."""

MAX_ROUNDS: Final = 20
"""Lens and flips are chosen in turn, in at most this many rounds."""


class Fitted(NamedTuple):
    """A view, with the pose and the points that were fitted to it."""

    view: TargetView
    camera: CameraModel
    pose: Rigid  # ``T_camera_target``
    points: Array  # (T, 3), points of the target, metres

    def equations(self, more: float) -> Equations:
        """Return the view's equations; ``more``: variance added to the points' own, pixels^2."""
        flat = self.points[self.view.ids]
        turned = flat @ self.pose.rotation.T
        seen = linearize(turned + self.pose.translation, self.camera)
        white = whitening(self.view.covariance, more)
        by_sheet = seen.by_point @ self.pose.rotation @ _deformations(flat)
        rows = seen.pixels[:, 1, None, None] / self.camera.size[1]
        further = by_sheet, rows * np.eye(2), smooth_changes(seen.pixels, self.camera.size)
        return Equations(
            white @ pose_changes(seen.by_point, turned),
            white @ np.concatenate([seen.by_lens, *further], axis=2),
            (white @ (self.view.points - seen.pixels)[..., None])[..., 0],
            np.sqrt(more + self.view.sigmas**2),
        )


def _deformations(flat: Array) -> Array:
    """Return the moves of points (N, 3) as the sheet stretches, shears and bends, (N, 3, D)."""
    x, y = (flat[:, :2] / np.ptp(flat, axis=0).max()).T
    moves = np.zeros((len(flat), 3, DEFORMATIONS))
    moves[:, 0, 0], moves[:, 0, 1] = x, y
    moves[:, 2, 2], moves[:, 2, 3], moves[:, 2, 4] = x**2, x * y, y**2
    return moves


class Equations(NamedTuple):
    """The linear equations of one view, in standard deviations."""

    by_pose: Array  # (N, 2, 6), derivatives by the pose
    # (N, 2, ...), derivatives by the lens' values, deformations of the sheet, a rolling shutter,
    # and smooth changes of the image
    by_shared: Array
    residuals: Array  # (N, 2), seen minus projected
    deviations: Array  # (N,), standard deviation of each point, pixels


def lens_alone(equations: Equations) -> Mask:
    """Return a mask of the shared unknowns that are values of the lens."""
    count = equations.by_shared.shape[2]
    of_lens: Mask = np.arange(count) < count - FURTHER_VALUES
    return of_lens


class Reduced(NamedTuple):
    """Normal equations of views for the values of a lens and a sheet, without their poses.

    If the values change by x, the weighted squares of view i are ``squares[i] - 2 right[i] x + x
    matrix[i] x``.
    """

    matrix: Array  # (V, L, L), J^T J
    right: Array  # (V, L), J^T r
    squares: Array  # (V,), weighted squares before any change

    @classmethod
    def of(cls, equations: Sequence[Equations]) -> Reduced:
        """Return the equations of views after eliminating the pose of each."""
        parts = []
        for one in equations:
            rows = one.by_pose.reshape(-1, 6)
            rest = np.column_stack([one.by_shared.reshape(len(rows), -1), one.residuals.ravel()])
            rest = rest - rows @ solve_scaled(rows.T @ rows, rows.T @ rest)
            parts.append(rest.T @ rest)
        found = np.array(parts)
        return cls(found[:, :-1, :-1], found[:, :-1, -1], found[:, -1, -1])

    def misfits(self, change: Array) -> Array:
        """Return the weighted squares of each view (V,) if the values change by (L,)."""
        misfits: Array = self.squares - 2.0 * self.right @ change + self.matrix @ change @ change
        return misfits

    def best(self, free: Mask, places: Sequence[int] = ()) -> tuple[Array, float]:
        """Return the change of the free values (L,) with the least squares, and those squares.

        The values at the indices ``places`` may differ between the views.
        """
        # Schur's complement once more: x_own = M_oo^-1 (b_o - M_o x)
        matrix, right, squares = self.matrix.sum(axis=0), self.right.sum(axis=0), self.squares.sum()
        for whole, side in zip(self.matrix, self.right, strict=True) if places else ():
            own = whole[np.ix_(places, places)]
            both = solve_scaled(own, np.column_stack([whole[places], side[places]]))
            matrix = matrix - whole[:, places] @ both[:, :-1]
            right = right - whole[:, places] @ both[:, -1]
            squares = squares - side[places] @ both[:, -1]
        basis = np.eye(len(right))[:, free]
        change = basis @ solve_scaled(basis.T @ matrix @ basis, basis.T @ right)
        return change, float(squares - change @ right)


class _FlippedLens(NamedTuple):
    """Effect of a flip on a lens' values: ``shift`` is added, ``mirror`` a factor of changes."""

    mirror: Array  # (L,), 1 or -1 for each value
    shift: Array  # (L,), in the unit of each value

    @classmethod
    def of(cls, camera: CameraModel, axes: Sequence[int]) -> _FlippedLens:
        """Return the effect of flipping pictures along some axes."""
        values = np.concatenate([lens_values(camera), np.zeros(FURTHER_VALUES)])
        mirror, goal = np.ones(len(values)), values.copy()
        for axis in axes:
            mirror[2 + axis], goal[2 + axis] = -1.0, camera.size[axis] - 1 - values[2 + axis]
            if camera.distortion_model != "equidistant":
                place = (7, 6)[axis]  # p2 describes a tilt along x, p1 one along y
                mirror[place], goal[place] = -1.0, -values[place]
        return cls(mirror, goal - values)

    def best(self, reduced: Reduced, free: Mask, flipped: Mask) -> tuple[Mask, float]:
        """Improve a guess which views are flipped; return the mask and the squares of all views."""
        # Lens and flips are chosen in turn, which only lowers the squares.
        # Source: Lloyd, Least Squares Quantization in PCM (1982).
        basis = np.eye(len(self.mirror))[:, free]
        as_is = mirrored = reduced.squares
        for _ in range(MAX_ROUNDS):
            plain, other = (reduced.matrix[one].sum(axis=0) for one in (~flipped, flipped))
            back = self.mirror * (reduced.right[flipped].sum(axis=0) - other @ self.shift)
            matrix = plain + self.mirror[:, None] * other * self.mirror
            right = reduced.right[~flipped].sum(axis=0) + back
            change = basis @ solve_scaled(basis.T @ matrix @ basis, basis.T @ right)
            as_is = reduced.misfits(change)
            mirrored = reduced.misfits(self.shift + self.mirror * change)
            better = mirrored < as_is
            if (better == flipped).all():
                break
            flipped = better
        return flipped, float(np.minimum(as_is, mirrored).sum())


def misfit_remarks(
    fitted: Sequence[Fitted], more: float, free: Mask, names: Sequence[str]
) -> Iterator[Remark]:
    """Yield a remark if flipped pictures, or a zoom, explain the views better than all else.

    In a flipped picture a board is found as well if it looks the same in a mirror; its points are
    then those of a camera with a mirrored lens. But such a large misfit may have other causes: each
    cause is fitted, and the best one counts.

    ``more``: variance in addition to the points' own, pixels^2. ``free`` (4 + K,): mask of the
    lens' values that were fitted. ``names``: names of the views.
    """
    if len(fitted) < MIN_VIEWS_TO_EXPLAIN:
        return
    equations = [one.equations(more) for one in fitted]
    reduced, count = Reduced.of(equations), sum(one.residuals.size for one in equations)
    lens, views = len(free), len(fitted)
    places = np.split(lens + np.arange(FURTHER_VALUES), np.cumsum([DEFORMATIONS, SHUTTER]))
    sheet, shutter, smooth = (one.tolist() for one in places)
    usual = np.zeros(lens + FURTHER_VALUES, dtype=np.bool_)
    usual[:lens], usual[sheet] = free, True
    other = usual.copy()
    other[smooth] = True

    def score(squares: float, unknowns: float) -> float:
        # Schwarz, Estimating the Dimension of a Model (1978)
        return count * math.log(max(squares, 1e-300)) + unknowns * math.log(count)

    before = reduced.best(usual)[1]
    explained = {
        "sheets that bend anew in each view": (reduced.best(usual, sheet)[1], views * len(sheet)),
        "a shutter that rolls": (reduced.best(usual, shutter)[1], views * len(shutter)),
        "a lens of another model": (reduced.best(other)[1], len(smooth)),
    }
    best = min(score(before, 0), *(score(*one) for one in explained.values()))
    others = ", ".join(
        f"{what} {before / max(after, 1e-300):.3g}" for what, (after, _) in explained.items()
    )
    rest = f"times smaller so; what else was tried explains less for what it takes: {others}"
    changed, after = _zoomed(reduced, usual)
    if before > ZOOM_COST_RATIO * after and score(after, 3) < best:
        yield Code.WRONG_LENS.remark(
            f"views of two focal lengths: those from {names[changed]} on are of another one than "
            f"those before, was the zoom or the focus moved? The squares of all are "
            f"{before / max(after, 1e-300):.3g} {rest}"
        )
        return
    flips = [_FlippedLens.of(fitted[0].camera, axes) for axes in FLIPS.values()]
    tried = [
        (how, *min((flip.best(reduced, usual, one) for one in guesses), key=lambda one: one[1]))
        for (how, axes), flip in zip(FLIPS.items(), flips, strict=True)
        for guesses in [list(_guesses(reduced, [2 + axis for axis in axes]))]
    ]
    how, flipped, after = min(tried, key=lambda one: one[2])
    if flipped.any() and not flipped.all() and score(after, views) < best:
        fewer = flipped if 2 * flipped.sum() <= len(flipped) else ~flipped
        which = ", ".join(itertools.compress(names, fewer.tolist()))
        yield Code.MIRRORED.remark(
            f"pictures that look flipped {how} against the others, or those of another camera: "
            f"{which}. The squares of all are {before / max(after, 1e-300):.3g} {rest}"
        )


def _zoomed(reduced: Reduced, free: Mask) -> tuple[int, float]:
    """Return the view from which on other focal lengths explain most, and the squares with them."""
    found = []
    for first in range(2, len(reduced.squares) - 1):
        parts = [slice(None, first), slice(first, None)]
        sums = Reduced(*(np.array([part[some].sum(axis=0) for some in parts]) for part in reduced))
        found.append((first, sums.best(free, [0, 1])[1]))
    return min(found, key=lambda one: one[1])


def _guesses(reduced: Reduced, places: Sequence[int]) -> Iterator[Mask]:
    """Yield guesses which views are flipped: those that fit another principal point."""
    for place in places:
        weight = np.maximum(reduced.matrix[:, place, place], np.finfo(np.float64).tiny)
        wish = reduced.right[:, place] / weight
        yield wish < np.median(wish)
        yield wish < 0
        yield np.abs(wish) > 3 * np.median(np.abs(wish))


def lens_remarks(fitted: Sequence[Fitted], what: str, more: float) -> Iterator[Remark]:
    """Yield a remark if a known lens is not the camera's (``WRONG_LENS``).

    ``fitted``: views through that lens; ``what``: name of the lens, for messages; ``more``:
    variance in addition to the points' own, pixels^2.
    """
    if len(fitted) < MIN_VIEWS_FOR_LENS:
        return
    equations = [one.equations(more) for one in fitted]
    reduced = Reduced.of(equations)
    before, after = float(reduced.squares.sum()), reduced.best(lens_alone(equations[0]))[1]
    if before > FITTED_COST_RATIO * after:
        yield Code.WRONG_LENS.remark(
            f"the {what} that was given leaves {math.sqrt(before / max(after, 1e-300)):.3g} times "
            "the residuals of one that is fitted to its views: is it this camera's, at this focus?"
        )
