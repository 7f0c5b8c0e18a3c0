"""Explain views that fit worse than noise would: flipped pictures, a changed camera, or others.

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
from smartcam.geometry._inside import COEFFICIENTS, Code, Remark

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from smartcam.calibration._views import TargetView
    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array, Rigid

    Mask = NDArray[np.bool_]

FLIPS: Final = {"left to right": (0,), "top to bottom": (1,), "by half a turn": (0, 1)}
"""Ways to flip a picture, each with the axes of the image whose direction changes."""

_LENS_VALUES: Final = 4 + max(COEFFICIENTS.values())
_ENDS: Final = np.cumsum([0, _LENS_VALUES, _LENS_VALUES, 6, 5, 2, SMOOTH, SMOOTH]).tolist()
LENS, RIGHT_LENS, RIG, SHEET, SHUTTER, IMAGE, RIGHT_IMAGE = (
    range(first, last) for first, last in itertools.pairwise(_ENDS)
)
"""Places of the shared unknowns: values of the lens, or of a pair's both; the place of a pair's
cameras; five ways in which a sheet deforms (stretching along x, shearing, and three ways to bend);
two in which a rolling shutter deforms a picture (leaning, and stretching from row to row); smooth
changes of the image."""

COUNT: Final = _ENDS[-1]
"""Number of the shared unknowns."""

LENSES: Final = np.arange(COUNT) < RIG.start
"""Mask of the lenses' values among them."""

MIN_VIEWS_TO_EXPLAIN: Final = 4
"""The misfit of fewer views than this is not explained."""

MIN_CHANGE_EVIDENCE: Final = 40.0
"""A change from one view on is reported if the information criterion prefers it by this much to all
else: 170 random parts of recorded sets reach 32, pictures resized by 1 % 48 to 350 (measured)."""

APART_COST_RATIO: Final = 4.0
"""The views of pairs are reported as of different moments if another place of the cameras for each
pair reduces the squares by this factor: OpenCV's recorded pairs reach 1.6, two recorded sets of a
board in the hand 8 to 19, a board that moves by 0.2 mm in between 8 (measured)."""

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
    # of a pair's right camera: ``T_right_left``; the pose that is eliminated is in the left camera
    rig: Rigid | None = None

    def equations(self, more: float) -> Equations:
        """Return the view's equations; ``more``: variance added to the points' own, pixels^2."""
        flat = self.points[self.view.ids]
        turned = flat @ self.pose.rotation.T
        seen = linearize(turned + self.pose.translation, self.camera)
        white = whitening(self.view.covariance, more)
        by_pose, lens, image = pose_changes(seen.by_point, turned), LENS, IMAGE
        shared = np.zeros((*seen.pixels.shape, COUNT))
        if self.rig is not None:
            lens, image = RIGHT_LENS, RIGHT_IMAGE
            away = turned + self.pose.translation - self.rig.translation
            shared[..., RIG] = pose_changes(seen.by_point, away)
            by_pose = pose_changes(seen.by_point @ self.rig.rotation, turned @ self.rig.rotation)
        shared[..., lens[: seen.by_lens.shape[2]]] = seen.by_lens
        shared[..., SHEET] = seen.by_point @ self.pose.rotation @ _deformations(flat)
        shared[..., SHUTTER] = seen.pixels[:, 1, None, None] / self.camera.size[1] * np.eye(2)
        shared[..., image] = smooth_changes(seen.pixels, self.camera.size)
        return Equations(
            white @ by_pose,
            white @ shared,
            (white @ (self.view.points - seen.pixels)[..., None])[..., 0],
            np.sqrt(more + self.view.sigmas**2),
        )


def _deformations(flat: Array) -> Array:
    """Return the moves of points (N, 3) as the sheet stretches, shears and bends, (N, 3, 5)."""
    x, y = (flat[:, :2] / np.ptp(flat, axis=0).max()).T
    moves = np.zeros((len(flat), 3, len(SHEET)))
    moves[:, 0, 0], moves[:, 0, 1] = x, y
    moves[:, 2, 2], moves[:, 2, 3], moves[:, 2, 4] = x**2, x * y, y**2
    return moves


class Equations(NamedTuple):
    """The linear equations of one view, in standard deviations."""

    by_pose: Array  # (N, 2, 6), derivatives by the pose
    by_shared: Array  # (N, 2, COUNT), derivatives by the shared unknowns
    residuals: Array  # (N, 2), seen minus projected
    deviations: Array  # (N,), standard deviation of each point, pixels


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
        for equation in equations:
            rows = equation.by_pose.reshape(-1, 6)
            rows_of_shared = np.column_stack(
                [equation.by_shared.reshape(len(rows), -1), equation.residuals.ravel()]
            )
            rows_of_shared = rows_of_shared - rows @ solve_scaled(
                rows.T @ rows, rows.T @ rows_of_shared
            )
            parts.append(rows_of_shared.T @ rows_of_shared)
        sums = np.array(parts)
        return cls(sums[:, :-1, :-1], sums[:, :-1, -1], sums[:, -1, -1])

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
        for sums_matrix, side in zip(self.matrix, self.right, strict=True) if places else ():
            block = sums_matrix[np.ix_(places, places)]
            both = solve_scaled(block, np.column_stack([sums_matrix[places], side[places]]))
            matrix = matrix - sums_matrix[:, places] @ both[:, :-1]
            right = right - sums_matrix[:, places] @ both[:, -1]
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
        values = np.zeros(COUNT)
        values[: 4 + len(camera.distortion)] = lens_values(camera)
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
            plain, other = (reduced.matrix[mask].sum(axis=0) for mask in (~flipped, flipped))
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


class _Misfit:
    """The misfit of views, and how far the causes that are no blunder explain it."""

    def __init__(self, equations: Sequence[Equations], free: Mask) -> None:
        """``free`` (COUNT,): mask of the values that were fitted."""
        self.reduced = Reduced.of(equations)
        self._count, views = sum(equation.residuals.size for equation in equations), len(equations)
        determined = np.diag(self.reduced.matrix.sum(axis=0)) > 0.0
        self.usual, bends = free & determined, determined.copy()
        self.usual[SHEET], bends[: IMAGE.start] = True, False
        best = self.reduced.best
        explained = {
            "sheets that bend anew in each view": (best(self.usual, SHEET)[1], views * len(SHEET)),
            "a shutter that rolls": (best(self.usual, SHUTTER)[1], views * len(SHUTTER)),
            "a lens of another model": (best(self.usual | bends)[1], float(bends.sum())),
        }
        self._before = best(self.usual)[1]
        self._best = min(
            self.score(squares, count)
            for squares, count in [(self._before, 0), *explained.values()]
        )
        self._others = ", ".join(
            f"{name} {self._before / max(after, 1e-300):.3g}"
            for name, (after, _) in explained.items()
        )

    def score(self, squares: float, unknowns: float) -> float:
        """Return the information criterion of a cause that leaves these squares."""
        # Schwarz, Estimating the Dimension of a Model (1978)
        return self._count * math.log(max(squares, 1e-300)) + unknowns * math.log(self._count)

    def offer(
        self, squares: float, unknowns: float, ratio: float = 1.0, evidence: float = 0.0
    ) -> bool:
        """Offer a further cause; return whether it explains the views best so far, and enough.

        ``ratio``: least factor by which it must reduce the squares. ``evidence``: least difference
        of the information criterion to all causes before.
        """
        gained = self._best - self.score(squares, unknowns)
        self._best -= max(gained, 0.0)
        return gained > evidence and self._before > ratio * squares

    def compared(self, after: float) -> str:
        """Return a sentence that compares a cause that leaves these squares with the others."""
        return (
            f"The squares of all are {self._before / max(after, 1e-300):.3g} times smaller so; "
            f"what else was tried explains less for what it takes: {self._others}"
        )

    def changed(
        self, changes: Mapping[str, Sequence[int]], names: Sequence[str]
    ) -> Iterator[Remark]:
        """Yield a remark if other values from one view on explain the views best.

        ``changes``: what may have changed, with the indices of its values.
        """
        tried = list[tuple[float, int, str]]()
        for first in range(2, len(names) - 1):
            parts = [slice(None, first), slice(first, None)]
            sums = Reduced(
                *(np.array([part[span].sum(axis=0) for span in parts]) for part in self.reduced)
            )
            tried += [
                (sums.best(self.usual, places)[1], first, how) for how, places in changes.items()
            ]
        after, first, best = min(tried)
        least = self.score(after, len(changes[best]) + 1) + MIN_CHANGE_EVIDENCE
        if not self.offer(after, len(changes[best]) + 1, evidence=MIN_CHANGE_EVIDENCE):
            return
        alike = [
            how
            for squares, moment, how in sorted(tried)
            if moment == first and self.score(squares, len(changes[how]) + 1) < least
        ]
        code = Code.POOR_FIT if alike == [MOVED] else Code.WRONG_LENS
        yield code.remark(
            f"views of two settings: those from {names[first]} on do not fit those before: "
            f"{', or '.join(alike)}? {self.compared(after)}"
        )


ZOOMED: Final = "was the zoom or the focus moved, or were pictures resized or cut"
MOVED: Final = "did the cameras move against each other"


def misfit_remarks(
    fitted: Sequence[Sequence[Fitted]], more: float, free: Mask, names: Sequence[str]
) -> Iterator[Remark]:
    """Yield a remark if a blunder explains the views better than all else.

    Blunders are a change of the camera from one view on and flipped pictures; of a pair also
    cameras that move against each other, and views of different moments. In a flipped picture a
    board is found as well if it looks the same in a mirror; its points are then those of a camera
    with a mirrored lens. But a large misfit may have other causes: each cause is fitted, and
    the best one counts.

    ``fitted``: the view, or the left and the right one of a pair, at each moment. ``more``:
    variance in addition to the points' own, pixels^2. ``free`` (COUNT,): mask of the values that
    were fitted. ``names``: names of the views.
    """
    if len(fitted) < MIN_VIEWS_TO_EXPLAIN:
        return
    equations = [[view.equations(more) for view in views] for views in fitted]
    joined = [
        Equations(*map(np.concatenate, zip(*equation, strict=True))) for equation in equations
    ]
    misfit, apart = _Misfit(joined, free), False
    reduced, usual, changes = misfit.reduced, misfit.usual, {ZOOMED: LENS[:4]}
    if len(fitted[0]) > 1:
        sides = {"left": LENS[:4], "right": RIGHT_LENS[:4]}
        changes = {
            f"{side} camera: {ZOOMED}": places for side, places in sides.items() if usual[places[0]]
        }
        changes[MOVED] = RIG
        after = reduced.best(usual, RIG)[1]
        apart = misfit.offer(after, len(RIG) * len(fitted), APART_COST_RATIO)
    if remarks := list(misfit.changed(changes, names)):
        yield from remarks
    elif apart:
        yield Code.NOT_SIMULTANEOUS.remark(
            "the views of each pair do not belong together: did the target move between the two, "
            f"or one camera against the other? {misfit.compared(after)}"
        )
    elif len(fitted[0]) == 1:
        yield from _flipped(misfit, fitted[0][0].camera, names)


def _flipped(misfit: _Misfit, camera: CameraModel, names: Sequence[str]) -> Iterator[Remark]:
    tried = [
        (*_FlippedLens.of(camera, axes).best(misfit.reduced, misfit.usual, guess), how)
        for how, axes in FLIPS.items()
        for guess in _guesses(misfit.reduced, [2 + axis for axis in axes])
    ]
    flipped, after, how = min(tried, key=lambda one: one[1])
    if flipped.any() and not flipped.all() and misfit.offer(after, len(names)):
        fewer = flipped if 2 * flipped.sum() <= len(flipped) else ~flipped
        which = ", ".join(itertools.compress(names, fewer.tolist()))
        yield Code.MIRRORED.remark(
            f"pictures that look flipped {how} against the others, or those of another camera: "
            f"{which}. {misfit.compared(after)}"
        )


def _guesses(reduced: Reduced, places: Sequence[int]) -> Iterator[Mask]:
    """Yield guesses which views are flipped: those that fit another principal point."""
    for place in places:
        weight = np.maximum(reduced.matrix[:, place, place], np.finfo(np.float64).tiny)
        wish = reduced.right[:, place] / weight
        yield wish < np.median(wish)
        yield wish < 0
        yield np.abs(wish) > 3 * np.median(np.abs(wish))


def lens_remarks(fitted: Sequence[Fitted], label: str, more: float) -> Iterator[Remark]:
    """Yield a remark if a known lens is not the camera's (``WRONG_LENS``).

    ``fitted``: views through that lens; ``label``: name of the lens, for messages; ``more``:
    variance in addition to the points' own, pixels^2.
    """
    if len(fitted) < MIN_VIEWS_FOR_LENS:
        return
    equations = [view.equations(more) for view in fitted]
    reduced = Reduced.of(equations)
    before, after = float(reduced.squares.sum()), reduced.best(LENSES)[1]
    if before > FITTED_COST_RATIO * after:
        yield Code.WRONG_LENS.remark(
            f"the {label} that was given leaves {math.sqrt(before / max(after, 1e-300)):.3g} times "
            "the residuals of one that is fitted to its views: is it this camera's, at this focus?"
        )
