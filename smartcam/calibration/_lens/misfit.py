"""Explain why views fit worse than noise alone would: flipped pictures, a changed camera, ...

The likeliest explanation is not proven, so a warning gives this explanation together with others:
sheets that bend anew for each view, a rolling shutter, a lens of another model. The pose of each
view is eliminated first, from the residuals and from the changes that each cause would make, so
only the parts that no pose can compensate are compared.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._least_squares import RANK_TOLERANCE, inverse_scaled, solve_scaled
from smartcam.calibration._lens.bundle import lens_values
from smartcam.calibration._lens.projection import (
    SMOOTH_TERM_COUNT,
    linearize,
    pixels_by_pose,
    pixels_by_smooth_errors,
    whitening,
)
from smartcam.geometry._inside import COEFFICIENT_COUNTS, Code, Remark

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from smartcam.calibration._views import TargetView
    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array, Rigid

    Mask = NDArray[np.bool_]

FLIPS: Final = {"left to right": (0,), "top to bottom": (1,), "by half a turn": (0, 1)}
"""Ways to flip a picture, each with the axes of the image whose direction changes."""

_LENS_VALUES: Final = 4 + max(COEFFICIENT_COUNTS.values())
_ENDS: Final = np.cumsum(
    [0, _LENS_VALUES, _LENS_VALUES, 6, 5, 2, SMOOTH_TERM_COUNT, SMOOTH_TERM_COUNT]
).tolist()
LENS, RIGHT_LENS, RIG, SHEET, SHUTTER, IMAGE, RIGHT_IMAGE = (
    range(first, last) for first, last in itertools.pairwise(_ENDS)
)
"""Indices of the shared unknowns: values of the lens, or of both lenses of a pair; the pose of one
camera of a pair in the other's frame; five deformations of a sheet (stretching along x, shearing,
and three bends); two deformations of a picture by a rolling shutter (leaning, and stretching from
row to row); smooth changes of the image."""

UNKNOWN_COUNT: Final = _ENDS[-1]
"""Number of the shared unknowns."""

LENS_MASK: Final = np.arange(UNKNOWN_COUNT) < RIG.start
"""Mask of the lenses' values among the shared unknowns."""

MIN_VIEWS_TO_EXPLAIN: Final = 4
"""The misfit of fewer views than this is not explained."""

MIN_CHANGE_EVIDENCE: Final = 40.0
"""A change of the camera from one view on is reported if the information criterion prefers this
cause to all others by this much. 170 random parts of recorded sets reach 32; pictures resized by 1
% reach 48 to 350 (measured)."""

RANDOM_ORDERS: Final = 100
"""A change from one view on is reported only if it explains more than the best change of this many
random orders of the views: four subsets of OpenCV's 13 right views, taken by an unchanged camera,
reach an evidence of 53 to 74, and 16 to 23 of 100 random orders reach more (measured)."""

APART_COST_RATIO: Final = 4.0
"""The views of a pair are reported as taken at different times if cameras that move between the
pairs reduce the squares by this factor: OpenCV's recorded pairs reach 1.6, two recorded sets of a
hand-held board 8 to 19, a board that moves by 0.2 mm between the two views 8 (measured)."""

FITTED_COST_RATIO: Final = 1.2
"""A known lens is wrong if fitting a lens to the views reduces the squares by this factor. Lenses
from other views reach 1.04 on recorded pairs; a focal length that is 1 % off reaches 2 with a noise
of 0.05 pixels."""

MIN_VIEWS_FOR_LENS: Final = 3
"""A lens is fitted to at least this many views to test a known lens."""

MAX_ITERATIONS: Final = 20
"""Alternations between fitting the lens and choosing which views are flipped."""


class FittedView(NamedTuple):
    """A view, with the pose and the points that were fitted to it."""

    view: TargetView
    camera: CameraModel
    pose: Rigid  # ``T_camera_target``
    points: Array  # (T, 3), points of the target, metres
    # ``T_right_left`` if the camera is the right one of a pair: ``pose`` is in this camera, but the
    # eliminated unknown is the target's pose in the left one
    rig: Rigid | None = None

    def equations(self, extra_variance: float) -> Equations:
        """Return the view's equations; ``extra_variance``, pixels^2, is added to its covariance."""
        target_points = self.points[self.view.ids]
        turned = target_points @ self.pose.rotation.T
        projection = linearize(turned + self.pose.translation, self.camera)
        white = whitening(self.view.covariance, extra_variance)
        by_pose, lens, image = pixels_by_pose(projection.by_point, turned), LENS, IMAGE
        shared = np.zeros((*projection.pixels.shape, UNKNOWN_COUNT))
        if self.rig is not None:
            lens, image = RIGHT_LENS, RIGHT_IMAGE
            from_rig_origin = turned + self.pose.translation - self.rig.translation
            shared[..., RIG] = pixels_by_pose(projection.by_point, from_rig_origin)
            by_pose = pixels_by_pose(
                projection.by_point @ self.rig.rotation, turned @ self.rig.rotation
            )
        shared[..., lens[: projection.by_lens.shape[2]]] = projection.by_lens
        shared[..., SHEET] = projection.by_point @ self.pose.rotation @ _deformations(target_points)
        shared[..., SHUTTER] = projection.pixels[:, 1, None, None] / self.camera.size[1] * np.eye(2)
        shared[..., image] = pixels_by_smooth_errors(projection.pixels, self.camera.size)
        return Equations(
            white @ by_pose,
            white @ shared,
            (white @ (self.view.points - projection.pixels)[..., None])[..., 0],
            np.sqrt(extra_variance + self.view.sigmas**2),
        )


def _deformations(points: Array) -> Array:
    """Return the shifts (N, 3, 5) of points (N, 3) by each of the five deformations of a sheet."""
    x, y = (points[:, :2] / np.ptp(points, axis=0).max()).T
    moves = np.zeros((len(points), 3, len(SHEET)))
    moves[:, 0, 0], moves[:, 0, 1] = x, y
    moves[:, 2, 2], moves[:, 2, 3], moves[:, 2, 4] = x**2, x * y, y**2
    return moves


class Equations(NamedTuple):
    """The linear equations of one view, or of a pair's two views, in standard deviations."""

    by_pose: Array  # (N, 2, 6), derivatives by the pose
    by_shared: Array  # (N, 2, UNKNOWN_COUNT), derivatives by the shared unknowns
    residuals: Array  # (N, 2), seen minus projected
    deviations: Array  # (N,), standard deviation of each point, pixels


class SharedEquations(NamedTuple):
    """Normal equations of views for the L shared unknowns, after eliminating the poses.

    If the unknowns change by x, the weighted squares of view i are ``squares[i] - 2
    right_sides[i] x + x matrix[i] x``.
    """

    matrix: Array  # (V, L, L), J^T J
    right_sides: Array  # (V, L), J^T r
    squares: Array  # (V,), weighted squares before any change

    @classmethod
    def from_views(cls, equations: Sequence[Equations]) -> SharedEquations:
        """Return the equations of views after eliminating the pose of each."""
        products = []
        for equation in equations:
            rows = equation.by_pose.reshape(-1, 6)
            rows_of_shared = np.column_stack(
                [equation.by_shared.reshape(len(rows), -1), equation.residuals.ravel()]
            )
            rows_of_shared = rows_of_shared - rows @ solve_scaled(
                rows.T @ rows, rows.T @ rows_of_shared
            )
            products.append(rows_of_shared.T @ rows_of_shared)
        sums = np.array(products)
        return cls(sums[:, :-1, :-1], sums[:, :-1, -1], sums[:, -1, -1])

    def misfits(self, change: Array) -> Array:
        """Return the weighted squares (V,) of the views after a change (L,) of the unknowns."""
        squares = self.squares - 2.0 * self.right_sides @ change + self.matrix @ change @ change
        return np.asarray(squares, dtype=np.float64)

    def solve(self, free: Mask, per_view: Sequence[int] = ()) -> tuple[Array, float]:
        """Return the change (L,) of the free unknowns with the least squares, and those squares.

        The unknowns at the indices ``per_view`` may differ between the views.
        """
        # Schur's complement eliminates the unknowns of each view: x_v = M_vv^-1 (b_v - M_v x)
        matrix, right_side = self.matrix.sum(axis=0), self.right_sides.sum(axis=0)
        squares = self.squares.sum()
        for sums_matrix, sums_right in (
            zip(self.matrix, self.right_sides, strict=True) if per_view else ()
        ):
            block = sums_matrix[np.ix_(per_view, per_view)]
            solved = solve_scaled(
                block, np.column_stack([sums_matrix[per_view], sums_right[per_view]])
            )
            matrix = matrix - sums_matrix[:, per_view] @ solved[:, :-1]
            right_side = right_side - sums_matrix[:, per_view] @ solved[:, -1]
            squares = squares - sums_right[per_view] @ solved[:, -1]
        basis = np.eye(len(right_side))[:, free]
        change = basis @ solve_scaled(basis.T @ matrix @ basis, basis.T @ right_side)
        return change, float(squares - change @ right_side)


class _FlippedLens(NamedTuple):
    """The lens of a flipped picture: values ``v + shift``, with changes times ``mirror``."""

    mirror: Array  # (L,), 1 or -1 for each value
    shift: Array  # (L,), in the unit of each value

    @classmethod
    def from_camera(cls, camera: CameraModel, axes: Sequence[int]) -> _FlippedLens:
        """Return the lens that pictures flipped along some axes show."""
        values = np.zeros(UNKNOWN_COUNT)
        values[: 4 + len(camera.distortion)] = lens_values(camera)
        mirror, flipped_values = np.ones(len(values)), values.copy()
        for axis in axes:
            mirror[2 + axis], flipped_values[2 + axis] = (
                -1.0,
                camera.size[axis] - 1 - values[2 + axis],
            )
            if camera.distortion_model != "equidistant":
                coefficient = (7, 6)[axis]  # p2 describes a tilt along x, p1 one along y
                mirror[coefficient], flipped_values[coefficient] = -1.0, -values[coefficient]
        return cls(mirror, flipped_values - values)

    def find_flips(self, reduced: SharedEquations, free: Mask, flipped: Mask) -> tuple[Mask, float]:
        """Improve a guess ``flipped`` of the flipped views; return their mask, and the squares."""
        # Fitting the lens and choosing the flipped views alternately only lowers the squares.
        # Source: Lloyd, Least Squares Quantization in PCM (1982).
        basis = np.eye(len(self.mirror))[:, free]
        plain_misfits = flipped_misfits = reduced.squares
        for _ in range(MAX_ITERATIONS):
            plain_matrix, flipped_matrix = (
                reduced.matrix[mask].sum(axis=0) for mask in (~flipped, flipped)
            )
            flipped_right = self.mirror * (
                reduced.right_sides[flipped].sum(axis=0) - flipped_matrix @ self.shift
            )
            matrix = plain_matrix + self.mirror[:, None] * flipped_matrix * self.mirror
            right = reduced.right_sides[~flipped].sum(axis=0) + flipped_right
            change = basis @ solve_scaled(basis.T @ matrix @ basis, basis.T @ right)
            plain_misfits = reduced.misfits(change)
            flipped_misfits = reduced.misfits(self.shift + self.mirror * change)
            is_better = flipped_misfits < plain_misfits
            if (is_better == flipped).all():
                break
            flipped = is_better
        return flipped, float(np.minimum(plain_misfits, flipped_misfits).sum())


class _Misfit:
    """The misfit of views, and how much of it ordinary causes explain, which are no blunders."""

    def __init__(self, equations: Sequence[Equations], free: Mask) -> None:
        """``free`` (UNKNOWN_COUNT,): mask of the values that were fitted."""
        self.reduced = SharedEquations.from_views(equations)
        self._residual_count, view_count = (
            sum(equation.residuals.size for equation in equations),
            len(equations),
        )
        determined = np.diag(self.reduced.matrix.sum(axis=0)) > 0.0
        self.free, smooth = free & determined, determined.copy()
        self.free[SHEET], smooth[: IMAGE.start] = True, False
        solve = self.reduced.solve
        explained = {
            "sheets that bend anew in each view": (
                solve(self.free, SHEET)[1],
                view_count * len(SHEET),
            ),
            "a shutter that rolls": (solve(self.free, SHUTTER)[1], view_count * len(SHUTTER)),
            "a lens of another model": (solve(self.free | smooth)[1], float(smooth.sum())),
        }
        self._unexplained = solve(self.free)[1]
        self._best_score = min(
            self.score(squares, count)
            for squares, count in [(self._unexplained, 0), *explained.values()]
        )
        self._other_causes = ", ".join(
            f"{name} {self._unexplained / max(after, 1e-300):.3g}"
            for name, (after, _) in explained.items()
        )

    def score(self, squares: float, unknowns: float) -> float:
        """Return the information criterion of a cause that leaves these squares."""
        # Schwarz, Estimating the Dimension of a Model (1978)
        return self._residual_count * math.log(max(squares, 1e-300)) + unknowns * math.log(
            self._residual_count
        )

    def accept_cause(
        self, squares: float, unknowns: float, ratio: float = 1.0, evidence: float = 0.0
    ) -> bool:
        """Compare a cause with all causes before; return True if it explains the misfit best.

        ``squares``: the squares that the cause leaves. ``ratio``: least factor by which the cause
        must reduce the squares. ``evidence``: least difference of the information criterion to all
        causes before.
        """
        gain = self._best_score - self.score(squares, unknowns)
        self._best_score -= max(gain, 0.0)
        return gain > evidence and self._unexplained > ratio * squares

    def comparison(self, squares: float) -> str:
        """Return a sentence that compares a cause that leaves these squares with the others."""
        return (
            "With this cause the squared residuals of all views are "
            f"{self._unexplained / max(squares, 1e-300):.3g} times smaller; "
            f"other causes that were tried explain less: {self._other_causes}"
        )

    def _change_costs(self, indices: Sequence[int], order: NDArray[np.intp]) -> Array:
        """Return the squares (V - 3,) if unknowns changed once, from the view ``order[2 + k]`` on.

        ``indices``: the K unknowns. ``order`` (V,): indices of the views, in the order in which the
        change may have happened.
        """
        free = self.free.copy()
        free[indices] = True
        # The later views have a change d of their own besides the change x of all. Eliminating x
        # leaves (L - C M^-1 C^T) d = l - C M^-1 b, where L, C and l are sums over the later views.
        inverse = inverse_scaled(self.reduced.matrix.sum(axis=0)[np.ix_(free, free)])
        right = self.reduced.right_sides.sum(axis=0)[free]
        rows = self.reduced.matrix[np.ix_(order, np.asarray(indices))]
        parts = (
            rows[..., free],
            rows[..., indices],
            self.reduced.right_sides[np.ix_(order, np.asarray(indices))],
        )
        coupling, own, own_right = (part[::-1].cumsum(axis=0)[-3:0:-1] for part in parts)
        projected = coupling @ inverse
        reduced_right = own_right - projected @ right
        blocks = own - projected @ coupling.transpose(0, 2, 1)
        scales = np.sqrt(np.maximum(np.diagonal(blocks, axis1=1, axis2=2), np.finfo(float).tiny))
        scaled = blocks / (scales[:, :, None] * scales[:, None, :])
        solved = (
            np.linalg.pinv(scaled, rcond=RANK_TOLERANCE, hermitian=True)
            @ ((reduced_right / scales)[..., None])
        )
        gains = (reduced_right / scales * solved[..., 0]).sum(axis=1)
        costs: Array = self.reduced.squares.sum() - right @ inverse @ right - gains
        return costs

    def change_remarks(
        self, changes: Mapping[str, Sequence[int]], names: Sequence[str]
    ) -> Iterator[Remark]:
        """Yield a remark if unknowns that change from one view on explain the views best.

        ``changes``: question about each possible change, with the indices of its unknowns.
        """
        costs = {
            cause: self._change_costs(indices, np.arange(len(names)))
            for cause, indices in changes.items()
        }
        after, best_cause = min((float(each.min()), cause) for cause, each in costs.items())
        first_changed = 2 + int(costs[best_cause].argmin())
        max_score = self.score(after, len(changes[best_cause]) + 1) + MIN_CHANGE_EVIDENCE
        if not self.accept_cause(after, len(changes[best_cause]) + 1, evidence=MIN_CHANGE_EVIDENCE):
            return
        # Errors that all points of a view share make any two groups of views differ. So a change is
        # reported only if no random order of the views shows a larger one.
        random = np.random.default_rng(len(names))
        for _ in range(RANDOM_ORDERS):
            order = random.permutation(len(names))
            if any(
                self._change_costs(indices, order).min() < (1.0 - 1e-9) * after
                for indices in changes.values()
            ):
                return
        similar_costs = sorted(
            (float(each[first_changed - 2]), cause) for cause, each in costs.items()
        )
        similar_causes = [
            cause
            for squares, cause in similar_costs
            if self.score(squares, len(changes[cause]) + 1) < max_score
        ]
        code = Code.POOR_FIT if similar_causes == [MOVE_QUESTION] else Code.WRONG_LENS
        yield code.remark(
            f"views of two settings: those from {names[first_changed]} on do not fit those before: "
            f"{', or '.join(similar_causes)}? {self.comparison(after)}"
        )


ZOOM_QUESTION: Final = "was the zoom or the focus moved, or were pictures resized or cut"
MOVE_QUESTION: Final = "did the cameras move against each other"


def misfit_remarks(
    fitted: Sequence[Sequence[FittedView]], extra_variance: float, free: Mask, names: Sequence[str]
) -> Iterator[Remark]:
    """Yield a remark if a blunder explains the misfit of views better than all other causes.

    Blunders are flipped pictures, and a camera that was changed from one view on. For a pair they
    are also cameras that move against each other, and views of different moments. A board that
    looks the same in a mirror is also found in a flipped picture, as if the lens was mirrored. A
    large misfit may have other causes, so each cause is fitted, and only the best one is reported.

    ``fitted``: the view, or the left and the right view of a pair, of each moment.
    ``extra_variance``, pixels^2, is added to the points' covariance. ``free`` (UNKNOWN_COUNT,):
    mask of the values that were fitted. ``names``: names of the views.
    """
    if len(fitted) < MIN_VIEWS_TO_EXPLAIN:
        return
    equations = [[view.equations(extra_variance) for view in views] for views in fitted]
    equations_by_time = [
        Equations(*map(np.concatenate, zip(*equation, strict=True))) for equation in equations
    ]
    misfit, is_apart = _Misfit(equations_by_time, free), False
    reduced, usable, changes = misfit.reduced, misfit.free, {ZOOM_QUESTION: LENS[:4]}
    if len(fitted[0]) > 1:
        sides = {"left": LENS[:4], "right": RIGHT_LENS[:4]}
        changes = {
            f"{side} camera: {ZOOM_QUESTION}": indices
            for side, indices in sides.items()
            if usable[indices[0]]
        }
        changes[MOVE_QUESTION] = RIG
        squares = reduced.solve(usable, RIG)[1]
        is_apart = misfit.accept_cause(squares, len(RIG) * len(fitted), APART_COST_RATIO)
    if remarks := list(misfit.change_remarks(changes, names)):
        yield from remarks
    elif is_apart:
        yield Code.NOT_SIMULTANEOUS.remark(
            "the views of each pair do not belong together: did the target move between the two, "
            f"or one camera against the other? {misfit.comparison(squares)}"
        )
    elif len(fitted[0]) == 1:
        yield from _flip_remarks(misfit, fitted[0][0].camera, names)


def _flip_remarks(misfit: _Misfit, camera: CameraModel, names: Sequence[str]) -> Iterator[Remark]:
    fits = [
        (
            *_FlippedLens.from_camera(camera, axes).find_flips(misfit.reduced, misfit.free, guess),
            direction,
        )
        for direction, axes in FLIPS.items()
        for guess in _guess_flips(misfit.reduced, [2 + axis for axis in axes])
    ]
    flipped, squares, direction = min(fits, key=lambda fit: fit[1])
    if flipped.any() and not flipped.all() and misfit.accept_cause(squares, len(names)):
        minority = flipped if 2 * flipped.sum() <= len(flipped) else ~flipped
        flipped_names = ", ".join(itertools.compress(names, minority.tolist()))
        yield Code.MIRRORED.remark(
            f"pictures that look flipped {direction} against the others, or those of another "
            f"camera: {flipped_names}. {misfit.comparison(squares)}"
        )


def _guess_flips(reduced: SharedEquations, indices: Sequence[int]) -> Iterator[Mask]:
    """Yield masks of views that may be flipped: those that fit another principal point."""
    for index in indices:
        weight = np.maximum(reduced.matrix[:, index, index], np.finfo(np.float64).tiny)
        shifts = reduced.right_sides[:, index] / weight
        yield shifts < np.median(shifts)
        yield shifts < 0
        yield np.abs(shifts) > 3 * np.median(np.abs(shifts))


def lens_remarks(
    fitted: Sequence[FittedView], label: str, extra_variance: float
) -> Iterator[Remark]:
    """Yield a remark if a known lens is not the camera's (``WRONG_LENS``).

    ``fitted``: views through that lens. ``label``: name of the lens, for messages.
    ``extra_variance``, pixels^2, is added to the points' covariance.
    """
    if len(fitted) < MIN_VIEWS_FOR_LENS:
        return
    equations = [view.equations(extra_variance) for view in fitted]
    reduced = SharedEquations.from_views(equations)
    before, after = float(reduced.squares.sum()), reduced.solve(LENS_MASK)[1]
    if before > FITTED_COST_RATIO * after:
        yield Code.WRONG_LENS.remark(
            f"the {label} that was given leaves {math.sqrt(before / max(after, 1e-300)):.3g} times "
            "the residuals of one that is fitted to its views: is it this camera's, at this focus?"
        )
