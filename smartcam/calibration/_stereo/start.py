"""Guess two cameras' lenses, poses and transform, with which their calibration starts."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from smartcam.calibration._lens.bundle import Bundle, IndexedView, adjust, empty_basis
from smartcam.calibration._lens.intrinsics import check_tilts, check_views
from smartcam.calibration._lens.poses import half_turn, half_turned, likeliest_poses
from smartcam.calibration._lens.start import fit_lens, lens_basis
from smartcam.calibration._views import TargetView, as_list
from smartcam.geometry._inside import IDENTITY, Code, Rigid

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array, DistortionModel

LEFT: Final = "left"
"""Name of the left camera's frame."""

RIGHT: Final = "right"
"""Name of the right camera's frame."""

SIDES: Final = (LEFT, RIGHT)
"""Names of the sides by their index."""

MAX_GUESSES: Final = 20
"""At most this many pairs are tried for a first guess of the transform."""

MIN_MISMATCH_RATIO: Final = 10.0
"""The views of a pair do not belong together if its error is more than this many times the median,
and above MIN_MISMATCH_SHARE as well."""

MIN_MISMATCH_SHARE: Final = 0.01
"""The views of a pair do not belong together only if its points are off by more than this fraction
of the image's longer side: neither noise nor a lens that is not yet adjusted causes that."""


class Lenses(NamedTuple):
    """The known lenses, and the model of those to be fitted."""

    # left and right lens; None for one that is to be fitted
    known: tuple[CameraModel | None, CameraModel | None]
    model: DistortionModel  # model of the lenses that are to be fitted
    # coefficients of these lenses that stay 0, as in :func:`lens_basis`
    fixed: tuple[str, ...]

    def basis(self, side: int) -> Array:
        """Return the basis (4 + K, F) of the unknowns of a side's lens."""
        known = self.known[side]
        return lens_basis(self.model, self.fixed) if known is None else empty_basis(known)


ViewPair: TypeAlias = tuple["TargetView | None", "TargetView | None"]
"""Views of the target by both cameras at one time."""


def as_view_pairs(
    left_views: Sequence[TargetView | None], right_views: Sequence[TargetView | None]
) -> list[ViewPair]:
    """Return the views as pairs.

    Raises errors with these codes: ``SHAPE``: the lists have different lengths;
    ``DIFFERENT_TARGETS`` or ``WRONG_SIZE``: views do not belong together; ``TOO_FEW``,
    ``COLLINEAR`` or ``NOT_FINITE``: a view is unusable.
    """
    left_views, right_views = (
        as_list(views, (TargetView, type(None)), f"{side} view")
        for side, views in zip(SIDES, (left_views, right_views), strict=True)
    )
    if len(left_views) != len(right_views):
        raise Code.SHAPE.error(
            f"stereo: expected as many left views as right ones, got {len(left_views)} and "
            f"{len(right_views)}",
            len(left_views),
            len(right_views),
        )
    for side, views in zip(SIDES, (left_views, right_views), strict=True):
        check_views([view for view in views if view is not None], f"{side} camera", 1)
    view_pairs = list(zip(left_views, right_views, strict=True))
    for left, right in view_pairs:
        if left is not None and right is not None and left.target != right.target:
            raise Code.DIFFERENT_TARGETS.error(
                f"stereo: expected views of one target, {left.target}, got {right.target} on the "
                "right",
                left.target,
                right.target,
            )
    return view_pairs


class FirstGuess(NamedTuple):
    """A first guess of lenses, transform and poses."""

    # points of the right views are numbered from the same end of the target as in the left ones
    view_pairs: list[ViewPair]
    bundle: Bundle  # lenses, transform and poses
    # indices of pairs whose views do not belong together, with the mean distance, pixels, of the
    # right view's points from where the left view and the other pairs predict them; infinite if
    # that is behind the camera
    mismatched: dict[int, float]


def guess_start(view_pairs: list[ViewPair], lenses: Lenses) -> FirstGuess:
    """Return a first guess of lenses, transform and poses.

    Raises ``POOR_FIT`` if no lens or no transform fits the views; ``INSUFFICIENT_ROTATION``;
    ``WRONG_SIZE`` if views are from another camera than the known one.
    """
    (left, left_poses), (right, right_poses) = (
        _fit_side(view_pairs, side, lenses) for side in range(2)
    )
    poses: list[Poses] = list(zip(left_poses, right_poses, strict=True))
    target = next(view.target for view_pair in view_pairs for view in view_pair if view is not None)
    turns = [IDENTITY]
    if target.half_turn_symmetric:
        turns.append(half_turn(target))
    rig, mismatched, renumbered = _guess_rig(view_pairs, poses, right, turns)
    for pair_index in renumbered:
        (left_pose, right_pose), (left_view, right_view) = (
            poses[pair_index],
            view_pairs[pair_index],
        )
        if right_pose is not None and right_view is not None:
            view_pairs[pair_index], poses[pair_index] = (
                (left_view, half_turned(right_view)),
                (left_pose, right_pose @ turns[1]),
            )
    target_poses = Rigid.stack(
        in_left or (rig.inverse() @ in_right if in_right else IDENTITY)
        for in_left, in_right in poses
    )
    basis = lenses.basis(0), lenses.basis(1)
    return FirstGuess(
        view_pairs, Bundle((left, right), Rigid.stack([rig]), target_poses, basis), mismatched
    )


Poses: TypeAlias = tuple["Rigid | None", "Rigid | None"]


def _fit_side(
    view_pairs: list[ViewPair], side: int, lenses: Lenses
) -> tuple[CameraModel, list[Rigid | None]]:
    """Return one side's lens, and the target's pose at each moment."""
    pair_indices = [
        index for index, view_pair in enumerate(view_pairs) if view_pair[side] is not None
    ]
    views = [view for view_pair in view_pairs if (view := view_pair[side]) is not None]
    known, label = lenses.known[side], f"{SIDES[side]} camera"
    if known is None:
        adjusted = fit_lens(views, lenses.model, lenses.fixed)
        check_tilts(adjusted, label)
    else:
        check_views(views, label, 1, known.size)
        indexed = [IndexedView(0, index, view) for index, view in enumerate(views)]
        adjusted = adjust(Bundle.single(known, likeliest_poses(views, known)), indexed, 0.0)
    poses: list[Rigid | None] = [None] * len(view_pairs)
    for pose_index, index in enumerate(pair_indices):
        poses[index] = adjusted.bundle.poses.subset(pose_index)
    return adjusted.bundle.cameras[0], poses


def _guess_rig(
    view_pairs: list[ViewPair], poses: list[Poses], right: CameraModel, turns: Sequence[Rigid]
) -> tuple[Rigid, dict[int, float], list[int]]:
    """Return the transform that fits most of the pairs, and the distances of pairs that do not fit.

    The third result are the indices of pairs whose right view is numbered from the target's other
    end. ``turns``: turns of the target after which it looks the same. All pairs together decide
    which numbering fits, since a camera may be upside down. Raises ``POOR_FIT``.
    """
    pairs = [
        (pair_index, in_left, in_right, view_pair[1])
        for pair_index, ((in_left, in_right), view_pair) in enumerate(
            zip(poses, view_pairs, strict=True)
        )
        if in_left is not None and in_right is not None and view_pair[1] is not None
    ]
    best_guess, least_median, distances = IDENTITY, math.inf, np.zeros((len(pairs), len(turns)))
    sampled = pairs[:: math.ceil(len(pairs) / MAX_GUESSES)]
    for turn, (_, in_left, in_right, _) in itertools.product(turns, sampled):
        # T_right_left = T_right_target T_target_left; the guess with the least median error is
        # taken, which up to half of the pairs cannot spoil: Rousseeuw, Least Median of Squares
        # Regression (1984).
        guess = in_right @ turn @ in_left.inverse()
        candidate_distances = np.array(
            [_mean_distances(guess @ pose, view, right, turns) for _, pose, _, view in pairs]
        )
        median = float(np.median(candidate_distances.min(axis=1)))
        if median < least_median:
            best_guess, least_median, distances = guess, median, candidate_distances
    if not math.isfinite(least_median):
        raise Code.POOR_FIT.error(
            f"stereo: expected one transform from left to right that fits most of the "
            f"{len(pairs)} pairs, got none: were the views taken at the same moments?"
        )
    limit = max(MIN_MISMATCH_RATIO * least_median, MIN_MISMATCH_SHARE * max(right.size))
    pair_indices, nearest = [index for index, *_ in pairs], distances.min(axis=1).tolist()
    mismatched = {
        index: distance
        for index, distance in zip(pair_indices, nearest, strict=True)
        if distance > limit
    }
    renumbered = [
        index
        for index, distances_by_turn in zip(pair_indices, distances, strict=True)
        if distances_by_turn[0] > distances_by_turn[-1]
    ]
    return best_guess, mismatched, renumbered


def _mean_distances(
    pose: Rigid, view: TargetView, camera: CameraModel, turns: Sequence[Rigid]
) -> list[float]:
    """Return the mean distance, pixels, of a view's points from those of a pose after each turn."""
    projected = [camera.project((pose @ turn).apply(view.object_points)) for turn in turns]
    distances = [np.linalg.norm(points - view.points, axis=1) for points in projected]
    return [float(np.nan_to_num(distance, nan=math.inf).mean()) for distance in distances]
