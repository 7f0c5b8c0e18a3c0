"""What views say of themselves once a lens is fitted: points that are off, flipped pictures.

Both are told by what the pose of each view cannot make up for: its part of the residuals, and of
what another lens would change, is taken off first.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools
import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._codes import Code, Remark
from smartcam.calibration._least_squares import solve_scaled
from smartcam.calibration._lens.bundle import lens_values
from smartcam.calibration._lens.projection import excess, linearize, pose_changes, whitening
from smartcam.calibration._views import label
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from smartcam.calibration._geometry.rigid import Rigid
    from smartcam.calibration._geometry.rotations import Array
    from smartcam.calibration._lens.intrinsics import IntrinsicCalibration
    from smartcam.calibration._lens.model import CameraModel
    from smartcam.calibration._lens.poses import TargetPose
    from smartcam.calibration._views import TargetView

    Mask = NDArray[np.bool_]

OFF: Final = ((7.0, 1.5), (12.0, 0.25))
"""Standard deviations and pixels by which a point that is not the target's is off, either pair: of
the points of 200 recorded views, whose noise is not quite normal, the farthest is 9.6 and 0.8 off,
or 5.9 and 1.8 (measured)."""

MOST_STRAYS: Final = 0.2
"""Of a view's points: more are no strays, the view is bad as a whole."""

LEAST_KEPT: Final = 8
"""Points that must be left where others are strays: with fewer, each may be the wrong one."""

MEDIAN: Final = 2.0 * math.log(2.0)
"""Of the squared length of two independent normal numbers."""

NAMED: Final = 5
"""Points that a text names at most."""

WORST: Final = 10.0
"""Pixels rms, beyond which the points are not those of the target: the wrong model of a lens leaves
less."""

WORST_PART: Final = 0.015
"""The same as a part of the longer side of the image, where that is more."""

WORST_SIGMAS: Final = 20.0
"""The same as a multiple of the points' standard deviation, where that is more."""

WAYS: Final = {"left to right": (0,), "top to bottom": (1,), "by half a turn": (0, 1)}
"""How a picture may be flipped: the axes of the image whose direction changes."""

EXPLAINED: Final = 0.75
"""Part of what views disagree in about the principal point that flips must explain: true ones
explain all, those by chance 0.56 at most (measured on recorded views)."""

GAIN: Final = 1.055
"""Weighted squares over those with pictures flipped back, from which on flips are no chance and do
harm: recorded views reach 1.037 by chance, and 1.07 and more where three of 29 are flipped."""

DEFORMATIONS: Final = 5
"""Of a sheet that are not taken for flips: x stretches, y leans, and three ways to bend."""

GAIN_OF_POOR: Final = 2.0
"""The same where the residuals are of a pixel and more: the lens may be of another model."""

POOR: Final = 1.0
"""This pixel."""

LONGEST: Final = 20.0
"""Metres that no target is long: a board in millimetres is 200."""

OFF_MIDDLE: Final = 0.2
"""Of the image's sides by which the principal point is off where the image is another one."""

SURE: Final = 5.0
"""Standard deviations by which it is so."""

TURNS: Final = 20
"""In which lens and flips are chosen in turn, at most."""


class Fitted(NamedTuple):
    """A view and what was fitted to it."""

    view: TargetView
    camera: CameraModel
    pose: Rigid  # ``T_camera_target``
    points: Array  # (T, 3), of the target, metres

    def equations(self, more: float) -> Equations:
        """Return the view's equations; ``more``: variance beside the points' own, pixels^2."""
        flat = self.points[self.view.ids]
        turned = flat @ self.pose.rotation.T
        seen = linearize(turned + self.pose.translation, self.camera)
        white = whitening(self.view.covariance, more)
        by_sheet = seen.by_point @ self.pose.rotation @ _deformations(flat)
        return Equations(
            white @ pose_changes(seen.by_point, turned),
            white @ np.concatenate([seen.by_lens, by_sheet], axis=2),
            (white @ (self.view.points - seen.pixels)[..., None])[..., 0],
            np.sqrt(more + self.view.sigmas**2),
        )


def _deformations(flat: Array) -> Array:
    """Return how points (N, 3) move where the sheet stretches, shears and bends (N, 3, D)."""
    x, y = (flat[:, :2] / np.ptp(flat, axis=0).max()).T
    moves = np.zeros((len(flat), 3, DEFORMATIONS))
    moves[:, 0, 0], moves[:, 0, 1] = x, y
    moves[:, 2, 2], moves[:, 2, 3], moves[:, 2, 4] = x**2, x * y, y**2
    return moves


class Equations(NamedTuple):
    """Of one view, in standard deviations."""

    by_pose: Array  # (N, 2, 6)
    by_shared: Array  # (N, 2, 4 + K + D), by the lens' values, and by deformations of the sheet
    residuals: Array  # (N, 2), seen minus projected
    deviations: Array  # (N,), what one of them is, pixels

    def stray_squares(self, scale: float) -> Array:
        """Return the squared lengths (N,) by which points are off, 0 where that is little.

        That is from where the other points of the view have them. ``scale``: squared length of one
        standard deviation along each axis.
        """
        kept = np.full(len(self.residuals), np.isfinite(self.residuals).all())
        least = max(LEAST_KEPT, (1.0 - MOST_STRAYS) * len(kept))
        while kept.sum() >= least:
            rows, right = self.by_pose[kept].reshape(-1, 6), self.residuals[kept].ravel()
            step = solve_scaled(rows.T @ rows, rows.T @ right)
            off = ((self.residuals - self.by_pose @ step) ** 2).sum(axis=1)
            far = self._far(off, scale)
            if not (kept & far).any():
                return np.where(~kept & far, off, 0.0)
            kept[int(np.argmax(np.where(kept & far, off, 0.0)))] = False
        return np.zeros(len(self.residuals))

    def _far(self, squares: Array, scale: float) -> Mask:
        pixels = self.deviations * np.sqrt(squares)
        times = np.sqrt(squares / max(scale, np.finfo(np.float64).tiny))
        far: Mask = np.any([(times > most) & (pixels > least) for most, least in OFF], axis=0)
        return far


class Stray(NamedTuple):
    """A point of a view that is not where the others have it."""

    number: int  # of the view
    row: int  # of the point in the view
    ident: int  # its number on the target
    off: float  # pixels


def strays(
    fitted: Sequence[Fitted], more: float, used: Sequence[bool], *, lens: bool = True
) -> list[Stray]:
    """Return the points that are far off what all others say.

    ``more``: variance beside the points' own, pixels^2. ``used``: the views that it is of; of the
    others, a view may be bad for a few of its points. ``lens``: whether the lens is fitted to the
    views; else a point is none that one that fits the other points brings to its place.
    """
    equations = [one.equations(more) for one in fitted]
    off = _stray_squares(equations, used)
    if not lens and any(one.any() for one in off):
        equations = _with_their_lens(equations, [one == 0 for one in off])
        off = _stray_squares(equations, used)
    found = []
    for number, (one, squares) in enumerate(zip(equations, off, strict=True)):
        for row in np.flatnonzero(squares).tolist():
            pixels = float(one.deviations[row]) * math.sqrt(squares[row])
            found.append(Stray(number, row, int(fitted[number].view.ids[row]), pixels))
    return found


def _with_their_lens(equations: Sequence[Equations], kept: Sequence[Mask]) -> list[Equations]:
    """Return the equations with what the lens leaves that fits the points best that are kept."""
    some = [
        Equations(*(part[rows] for part in one)) for one, rows in zip(equations, kept, strict=True)
    ]
    change = _Reduced.of(some).best(_lens_alone(equations[0]))[0]
    left = []
    for one, rows in zip(equations, kept, strict=True):
        residuals = one.residuals - one.by_shared @ change
        by_pose, right = one.by_pose[rows].reshape(-1, 6), residuals[rows].ravel()
        step = solve_scaled(by_pose.T @ by_pose, by_pose.T @ right)
        left.append(one._replace(residuals=residuals - one.by_pose @ step))
    return left


def _stray_squares(equations: Sequence[Equations], used: Sequence[bool]) -> list[Array]:
    """Return the squared lengths (N,) by which points of each view are off, 0 for most."""
    of_used = itertools.compress(equations, used)
    # the median stays what it is, whatever a few strays do to the variance of all
    middle = np.median(np.concatenate([(one.residuals**2).sum(axis=1) for one in of_used]))
    return [one.stray_squares(float(middle) / MEDIAN) for one in equations]


def _lens_alone(equations: Equations) -> Mask:
    """Return which of the shared unknowns are a lens' values."""
    count = equations.by_shared.shape[2]
    of_lens: Mask = np.arange(count) < count - DEFORMATIONS
    return of_lens


def without(views: Sequence[TargetView], found: Sequence[Stray]) -> list[TargetView]:
    """Return views without some of their points."""
    fewer = list(views)
    for number, group in itertools.groupby(found, key=lambda one: one.number):
        view = views[number]
        kept = np.setdiff1d(np.arange(len(view.ids)), [one.row for one in group])
        fewer[number] = dataclasses.replace(
            view,
            ids=view.ids[kept],
            points=view.points[kept],
            covariance=view.covariance[kept],
        )
    return fewer


def stray_remarks(found: Sequence[Stray], names: Sequence[str], done: str) -> Iterator[Remark]:
    """Yield what is to be said of strays; ``names``: of the views."""
    counts = collections.Counter(one.ident for one in found)
    often = {ident for ident, count in counts.items() if count >= max(3, len(names) / 2)}
    for ident in sorted(often):
        off = [one.off for one in found if one.ident == ident]
        yield Remark(
            Code.OUTLIER,
            f"point {ident} of the target is {np.median(off):.3g} pixels off in {len(off)} of "
            f"{len(names)} views: it is not where it was meant to be, or something is taken for "
            f"it; it {done} there",
        )
    rest = [one for one in found if one.ident not in often]
    if rest:
        each = [f"{one.ident} in {names[one.number]} ({one.off:.3g} pixels)" for one in rest]
        more = f", and {len(each) - NAMED} more" if len(each) > NAMED else ""
        yield Remark(
            Code.OUTLIER,
            f"points that are not where the others of their views have them: "
            f"{', '.join(each[:NAMED])}{more}: each {done}",
        )


def without_strays(
    views: Sequence[TargetView], poses: Sequence[TargetPose], camera: CameraModel
) -> tuple[list[TargetView], list[Remark]]:
    """Return views before a known camera without their strays, and what is to be said of these."""
    off = np.concatenate([one.residuals for one in poses])
    noise = np.concatenate([one.covariance for one in views])
    more = excess(off, noise, off.size - 6 * len(views))
    fitted = [
        Fitted(view, camera, pose.transform.rigid, view.target.points)
        for view, pose in zip(views, poses, strict=True)
    ]
    found = strays(fitted, more, [True] * len(fitted), lens=False)
    names = [label(view, number) for number, view in enumerate(views)]
    remarks = [*stray_remarks(found, names, "was not used"), *view_remarks(views, names)]
    return without(views, found), remarks


def examined(
    found: IntrinsicCalibration,
    again: Callable[[list[TargetView]], IntrinsicCalibration],
    *,
    drop: bool,
) -> IntrinsicCalibration:
    """Return a calibration of a lens without the points that are far off, and with remarks on them.

    ``again`` calibrates it from other views. ``drop``: whether the points are left out. Raises
    ``POOR_FIT``: the points are not the target's; ``MIRRORED``: some pictures are flipped.
    """
    views, used = [one.view for one in found.views], [one.used for one in found.views]
    points = views[0].target.points + (0.0 if found.sheet is None else found.sheet)
    fitted = [Fitted(one.view, found.camera, one.transform.rigid, points) for one in found.views]
    names = [label(view, number) for number, view in enumerate(views)]
    check_rms("intrinsics", found.rms, views)
    said = [*view_remarks(views, names), *_remarks_on_middle(found)]
    check_flips(
        list(itertools.compress(fitted, used)),
        found.sigma**2,
        np.diag(found.covariance) > 0,
        list(itertools.compress(names, used)),
    )
    off = strays(fitted, found.sigma**2, used)
    if off and drop:
        found, said = again(without(views, off)), []  # which says it of them
    done = "was not used" if drop else "is used all the same"
    remarks = stray_remarks(off, names, done)
    return dataclasses.replace(found, warnings=(*remarks, *found.warnings, *said))


def view_remarks(views: Sequence[TargetView], names: Sequence[str]) -> Iterator[Remark]:
    """Yield what is to be said of views that are copies, or show a target as large as a house."""
    groups = collections.defaultdict[tuple[bytes, bytes], list[str]](list)
    for view, name in zip(views, names, strict=True):
        groups[view.ids.tobytes(), view.points.tobytes()].append(name)
    copies = [", ".join(one) for one in groups.values() if len(one) > 1]
    if copies:
        more = f", and {len(copies) - NAMED} more" if len(copies) > NAMED else ""
        yield Remark(
            Code.COINCIDENT,
            f"views that are the same to the last digit: {'; '.join(copies[:NAMED])}{more}: they "
            "count as often as they are there, and errors come out too small",
        )
    length = float(np.ptp(views[0].target.points, axis=0).max())
    if length > LONGEST:
        yield Remark(
            Code.SCALE_MISMATCH,
            f"expected a target of {LONGEST:g} m at most, got one of {length:g} m: are its lengths "
            "in metres? All lengths that are found are in proportion",
        )


def _remarks_on_middle(found: IntrinsicCalibration) -> Iterator[Remark]:
    size = np.array(found.camera.size)
    middle, sigmas = found.camera.matrix[:2, 2], np.sqrt(np.diag(found.covariance)[2:4])
    off = np.abs(middle - (size - 1) / 2)
    if ((off > OFF_MIDDLE * size) & (off > SURE * sigmas)).any():
        yield Remark(
            Code.WRONG_SIZE,
            f"expected the principal point near the middle of an image of {size[0]} x {size[1]} "
            f"pixels, got ({middle[0]:.0f}, {middle[1]:.0f}): were points taken from an image of "
            "another size? Where images are cut to a part of the sensor's, all is well",
        )


def lens_gain(fitted: Sequence[Fitted], more: float) -> float:
    """Return the weighted squares of views over those with a lens of the same model fitted to them.

    1 where the lens that they have is theirs. ``more``: variance beside the points' own, pixels^2.
    """
    equations = [one.equations(more) for one in fitted]
    reduced = _Reduced.of(equations)
    before, after = float(reduced.squares.sum()), reduced.best(_lens_alone(equations[0]))[1]
    return before / after if after > 0 else 1.0


def check_rms(what: str, rms: float, views: Sequence[TargetView]) -> None:
    """Raise (``POOR_FIT``) where residuals are so large that the points are not the target's."""
    most = most_rms(views)
    if rms > most:
        raise CalibrationError(
            f"{what}: expected views of {views[0].target}, got residuals of {rms:.3g} pixels rms, "
            f"{most:.3g} at most expected: are columns and rows those of the sheet, and are the "
            "points those that their numbers say?",
            code=Code.POOR_FIT,
            expected=most,
            got=rms,
        )


def most_rms(views: Sequence[TargetView]) -> float:
    """Return the residuals, rms of a coordinate in pixels, beyond which views cannot be so."""
    noise = float(np.median(np.concatenate([one.sigmas for one in views])))
    longer = max(max(one.size) for one in views)
    return max(WORST, WORST_PART * longer, WORST_SIGMAS * noise)


# ---------------------------------------------------------------------- flipped pictures


class _Reduced(NamedTuple):
    """What views say of the values of a lens and a sheet, whatever their poses.

    Where the values change by x, the weighted squares of view i are
    ``squares[i] - 2 right[i] x + x matrix[i] x``.
    """

    matrix: Array  # (V, L, L)
    right: Array  # (V, L)
    squares: Array  # (V,)

    @classmethod
    def of(cls, equations: Sequence[Equations]) -> _Reduced:
        """Return those of views, the best pose of each taken in."""
        parts = []
        for one in equations:
            rows = one.by_pose.reshape(-1, 6)
            rest = np.column_stack([one.by_shared.reshape(len(rows), -1), one.residuals.ravel()])
            rest = rest - rows @ solve_scaled(rows.T @ rows, rows.T @ rest)
            parts.append(rest.T @ rest)
        found = np.array(parts)
        return cls(found[:, :-1, :-1], found[:, :-1, -1], found[:, -1, -1])

    def misfits(self, change: Array) -> Array:
        """Return the weighted squares of each view (V,) where the values change by (L,)."""
        misfits: Array = self.squares - 2.0 * self.right @ change + self.matrix @ change @ change
        return misfits

    def best(self, free: Mask, places: Sequence[int] = ()) -> tuple[Array, float]:
        """Return the change of the free values (L,) with the least squares, and these.

        At some places each view may have a value of its own.
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


class _Flipping(NamedTuple):
    """How a flip changes the values of a lens: by ``shift``, and their changes by ``mirror``."""

    mirror: Array  # (L,), 1 or -1
    shift: Array  # (L,)

    @classmethod
    def of(cls, camera: CameraModel, axes: Sequence[int]) -> _Flipping:
        """Return what flipping pictures along some axes does."""
        values = np.concatenate([lens_values(camera), np.zeros(DEFORMATIONS)])
        mirror, goal = np.ones(len(values)), values.copy()
        for axis in axes:
            mirror[2 + axis], goal[2 + axis] = -1.0, camera.size[axis] - 1 - values[2 + axis]
            if camera.distortion_model != "equidistant":
                place = (7, 6)[axis]  # p2 stands for a tilt along x, p1 for one along y
                mirror[place], goal[place] = -1.0, -values[place]
        return cls(mirror, goal - values)

    def best(self, reduced: _Reduced, free: Mask, flipped: Mask) -> tuple[Mask, float]:
        """Return which views are better flipped, from a guess, and the squares of all then."""
        # Lens and flips are chosen in turn, which only lowers the squares.
        # Source: Lloyd, Least Squares Quantization in PCM (1982).
        basis = np.eye(len(self.mirror))[:, free]
        for _ in range(TURNS):
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


def check_flips(fitted: Sequence[Fitted], more: float, free: Mask, names: Sequence[str]) -> None:
    """Raise (``MIRRORED``) where some of the pictures are flipped against the others.

    A picture of a board that looks the same in a mirror is found when it is flipped, too; its
    points are then what a camera with a mirrored lens sees. ``more``: variance beside the points'
    own, pixels^2. ``free`` (4 + K,): the lens' values that were fitted. ``names``: of the views.
    """
    if len(fitted) < 3:
        return
    reduced = _Reduced.of([one.equations(more) for one in fitted])
    free = np.concatenate([free, np.ones(DEFORMATIONS, dtype=np.bool_)])
    before = reduced.best(free)[1]
    gain = GAIN if more <= POOR**2 else GAIN_OF_POOR
    best: tuple[float, str, Mask] | None = None
    for how, axes in WAYS.items():
        flip, places = _Flipping.of(fitted[0].camera, axes), [2 + axis for axis in axes]
        tried = [flip.best(reduced, free, one) for one in _guesses(reduced, places)]
        flipped, after = min(tried, key=lambda one: one[1])
        apart = before - reduced.best(free, places)[1]
        clear = before > gain * after and before - after > EXPLAINED * apart
        if flipped.any() and not flipped.all() and clear and (best is None or after < best[0]):
            best = after, how, flipped
    if best is not None:
        after, how, flipped = best
        fewer = flipped if 2 * flipped.sum() <= len(flipped) else ~flipped
        which = [name for name, one in zip(names, fewer.tolist(), strict=True) if one]
        raise CalibrationError(
            f"intrinsics: expected pictures as the camera takes them, got some that are flipped "
            f"{how} against the others ({', '.join(which)}), or those of another camera: the "
            f"squares of all are {before / after:.3g} times smaller when they are flipped back",
            code=Code.MIRRORED,
            expected="pictures as the camera takes them",
            got=which,
        )


def _guesses(reduced: _Reduced, places: Sequence[int]) -> Iterator[Mask]:
    """Yield views that may be flipped: those that want the principal point elsewhere."""
    for place in places:
        weight = np.maximum(reduced.matrix[:, place, place], np.finfo(np.float64).tiny)
        wish = reduced.right[:, place] / weight
        yield wish < np.median(wish)
        yield wish < 0
        yield np.abs(wish) > 3 * np.median(np.abs(wish))
