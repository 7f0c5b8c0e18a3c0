"""Calibrate the pose of a camera on a robot's hand, or of one beside the robot.

::

    calibration = calibrate_hand_eye(robot_poses, views, setup="eye-in-hand", camera=camera)
    calibration.held_out_error                 # metres, of poses that were left out
    table = calibration.target_pose            # the sheet's plane, in the robot's frame
    calibration.to_plane([[640, 480]], plane=table, robot_pose=now)

The robot moves the camera to ten poses or more, turned about different axes, from which it sees the
sheet. A camera beside the robot is fixed, and the robot shows it the sheet.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from smartcam._argument_checks import a_list, a_number, each, of_class, or_none, takes
from smartcam._arguments import check_flag, check_text
from smartcam.calibration._hand_eye.closed_forms import (
    LINEAR,
    MIN_POSES,
    check_motion,
    of_one_place,
    scale_of,
    second_turns,
)
from smartcam.calibration._hand_eye.equations import (
    PixelObservations,
    PoseObservations,
    RobotPoses,
    RobotSigmas,
    bends,
    is_in_hand,
    pull,
)
from smartcam.calibration._hand_eye.model_selection import (
    MAX_FOLDS,
    METHODS,
    NOTHING,
    Problem,
    candidates,
)
from smartcam.calibration._hand_eye.result import HandEyeCalibration, as_transform
from smartcam.calibration._hand_eye.validation import (
    check_poses,
    expected_error,
    max_plausible_error,
    other_numbering,
    poor_fit_error,
    seen_poses,
)
from smartcam.calibration._jackknife import jackknife, weighted_jackknife
from smartcam.calibration._least_squares import inverse_scaled
from smartcam.calibration._lens.intrinsics import calibrate_intrinsics
from smartcam.calibration._lens.poses import CAMERA, TARGET, half_turn, half_turned, locate
from smartcam.calibration._lens.projection import excess_variance, whitening
from smartcam.calibration._lens.sheet_shape import MAX_FREE_POINTS, SheetOption
from smartcam.calibration._lens.suspicions import remove_strays
from smartcam.calibration._one_blas_thread import one_blas_thread
from smartcam.calibration._plane.validation import check_positive
from smartcam.calibration._statistics import common_move
from smartcam.calibration._views import as_list, as_views
from smartcam.exceptions import CalibrationError
from smartcam.geometry import Transform
from smartcam.geometry._inside import Code, Remark, Rigid, as_vector, check_choice

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from smartcam.calibration._hand_eye.equations import Setup
    from smartcam.calibration._hand_eye.model_selection import Candidate
    from smartcam.calibration._lens.poses import TargetPose
    from smartcam.calibration._views import TargetView
    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array
    from smartcam.models import Pose

POSES_PER_EXTRA_REMOVAL = 100
"""One bad pose, and one more for each of this many poses, is left out before the others are solved
again."""

MIN_ADVISED_POSES = 8
"""With fewer poses than this, the residuals say little about the error."""

MIN_ADVISED_TURN_RADIANS = math.radians(8.0)
"""Least RMS turn of the poses about the second of their axes without a remark; leaving out some of
eight poses changes it by two or three degrees."""

MAX_SCALE_ERROR = 0.2
"""A target's size may be off by this part unless the user gives another."""

REMARKED_SCALE_ERROR = 0.005
"""A target's size that differs from the nominal one by more than this part is remarked on."""

REMARKED_SCALE_SIGMAS = 5.0
"""A target's size is remarked on, if it is not adjusted, when it differs by this many standard
deviations."""

BAD_POSE_RATIO = 4.0
"""A pose is bad if its held-out error is more than this many times the median: of normal errors
along two axes, one in 60000 is."""

ROUNDING_ERROR_M = 1e-7
"""Errors below this length, metres, may be rounding errors."""

MAX_BAD_POSE_SHARE = 1 / 3
"""At most this part of the poses may be left out."""

MIN_GOOD_POSES = 5
"""At least this many poses must be left after leaving out those that belong to other views."""

MIN_POSES_FOR_ERROR = 5
"""The scatter of at least this many poses gives an expected error."""

WEIGHT_POWER = 1 / 2
"""Power of a pose's weight in the covariance: errors of poses are independent of each other."""

POOR_ROBOT = RobotSigmas(math.radians(0.25), 2e-3)
"""Standard deviations of a robot that is worse than most, 0.25 degrees and 2 mm: a held-out error
beyond what they cause is remarked on."""

ASSUMED_POSE_SIGMAS = RobotSigmas(1e-3, 1e-3)
"""Standard deviations (rad, m) of target poses without a covariance: only their ratio counts."""


@takes(
    robot_poses=a_list,
    views=each(of_class("TargetView")),
    setup=check_text,
    camera=or_none(of_class("CameraModel")),
    method=check_text,
    adjust=check_text,
    drop_bad=check_flag,
    most_scale=a_number,
)
@one_blas_thread
def calibrate_hand_eye(
    robot_poses: Sequence[Transform | Pose],
    views: Sequence[TargetView],
    *,
    setup: Setup,
    camera: CameraModel | None = None,
    method: str = "auto",
    adjust: Literal["auto", "nothing", "scale", "camera", "scale and camera"] = "auto",
    robot_sigmas: RobotSigmas | None = None,
    drop_bad: bool = True,
    allowed_error: float | None = None,
    most_scale: float = MAX_SCALE_ERROR,
) -> HandEyeCalibration:
    """Calibrate the pose of a camera on a robot, or beside it, from views of a target.

    Args:
        robot_poses: ``T_base_flange`` at each view: the flange's pose in the robot's base.
        views: views of one target, as many. A target that looks the same after half a turn is
            numbered from the same end in all of them, as the robot's motions tell.
        setup: place of the camera: on the hand (``eye-in-hand``, with a fixed target), or fixed
            beside the robot (``eye-to-hand``, with the target on the hand).
        camera: the camera's lens, which the expected errors assume to be exact; None: it is
            calibrated from the same views, which should then show the target tilted, and from the
            robot's motions, together with bends of the target, and the expected errors include
            those of the lens. Where ``adjust`` keeps the lens, the views alone tell it, with the
            target's points adjusted.
        method: ``auto`` chooses the one of ``robot`` and ``reprojection`` that predicts left-out
            poses better; or one of these two, or one of OpenCV's closed forms, see
            :data:`~smartcam.calibration._hand_eye.model_selection.METHODS`.
        adjust: value that is adjusted besides the poses: the target's ``scale`` (printers change
            it), the ``camera``, or ``nothing``; ``auto`` chooses by the held-out error.
        robot_sigmas: standard deviations of each axis of the robot's poses; None: estimated.
        drop_bad: whether poses that are far from the others' prediction are left out and named, at
            most a third of them, and only while 8 are left; else they are only named. After leaving
            out poses that are much farther off, as those of other views, 5 must be left.
        allowed_error: largest error, metres, that 95 of 100 points on the target may have; None: a
            hundredth of the target's distance. See :attr:`HandEyeCalibration.verdict`.
        most_scale: part by which the target's size may be off. The robot's motions show how large
            the target is, and a larger difference is refused.

    The order of the poses does not matter.

    Raises:
        CalibrationError: ``TOO_FEW``, ``POSES_TOO_SIMILAR``, ``INSUFFICIENT_ROTATION``; ``SHAPE``:
            the numbers of views and poses differ, or these are something else; ``WRONG_SIZE``;
            ``WRONG_FRAME``: poses are in several frames, or fit only when inverted or transposed;
            ``MIRRORED``: the robot's base is left-handed, or pictures are flipped;
            ``DIFFERENT_TARGETS``; ``SCALE_MISMATCH``: the size of the print is off by more than
            ``most_scale``; ``POOR_FIT``: nothing fits, as when poses and views are mixed up or
            lengths are in millimetres; and those of
            :func:`~smartcam.calibration.calibrate_intrinsics`.
        MissingExtraError: SciPy or OpenCV is not installed, or OpenCV is 5.0.0.
    """
    views = as_views(views, "hand-eye")
    check_positive(allowed_error, "allowed_error", "metres")
    check_positive(most_scale, "most_scale", "parts of its size")
    transforms, order, robot = _robot(robot_poses, len(views), "views", setup)
    if any(view.target != views[0].target for view in views):
        raise Code.DIFFERENT_TARGETS.refusal(
            "hand-eye: expected views of one target, got views of several", views[0].target
        )
    ordered = [views[i] for i in order]
    lens, lens_calibration, of_sheet = camera, None, list[Remark]()
    if lens is None:
        # A sheet bent by a tenth of a millimetre, which views cannot show, makes cameras 1.7 mm off
        # where 0.7 mm are expected, if the views alone tell the lens (measured in simulation).
        few = len(ordered[0].target.points) <= MAX_FREE_POINTS
        alone: SheetOption = "free" if few else "exact"
        lens_calibration = calibrate_intrinsics(
            ordered, sheet="auto" if adjust == "auto" else alone
        )
        lens = lens_calibration.camera
        of_sheet = [
            warning for warning in lens_calibration.warnings if warning.code == Code.SHEET_NOT_EXACT
        ]
    located = [locate(view, lens) for view in ordered]
    if ordered[0].target.half_turn_symmetric:
        ordered = _numbered_alike(ordered, robot, located)
        located = [locate(view, lens) for view in ordered]
        views = [ordered[i] for i in np.argsort(order)]
    ordered, strays = remove_strays(ordered, located, lens, is_lens_given=camera is not None)
    located = [locate(view, lens) for view in ordered] if strays else located
    poses = Rigid.stacked(view.transform.rigid for view in located)
    seen = _observations(ordered, located, lens)
    problem = Problem(
        robot=robot,
        seen=seen,
        poses=poses,
        given=_given_points(ordered),
        sigmas=_positive(robot_sigmas),
        lens=None if lens_calibration is None else lens_calibration.covariance,
    )
    named = [view.name or f"pose {i}" for i, view in zip(order, ordered, strict=True)]
    bend_places = [5 + i for i in np.flatnonzero(lens.distortion).tolist()]
    if lens_calibration is not None:
        # a sheet bent by 0.15 mm would bend a lens that takes it as flat
        bend_places += [5 + len(lens.distortion) + i for i in range(seen.heights.shape[2])]
    free = {NOTHING: (), "scale": (0,), "camera": (1, 2, 3, 4, *bend_places)}
    free["scale and camera"] = (0, *free["camera"])
    if lens_calibration is not None and adjust == "auto":
        # The robot's motions tell a lens better than views of a bent sheet do: where it bends anew
        # by 0.5 mm, cameras are 0.9 mm off instead of 1.8 (simulated).
        del free[NOTHING], free["scale"]
    request = _Asked(_allowed(free, adjust), method, drop_bad, order, most_scale)
    result = _without_bad(problem, request, named, transforms, ordered)
    remarks = [] if camera is None else _lens_remarks(camera, result.camera)
    if remarks:
        strays = [outlier for outlier in strays if outlier.code != Code.WRONG_LENS]
    return dataclasses.replace(
        result,
        warnings=(*result.warnings, *remarks, *of_sheet, *strays),
        views=tuple(views),
        target_poses=tuple(located[i].transform for i in np.argsort(order)),
        allowed_error=allowed_error,
    )


@takes(
    robot_poses=a_list,
    target_poses=each(of_class("Transform")),
    setup=check_text,
    method=check_text,
    adjust=check_text,
    drop_bad=check_flag,
    most_scale=a_number,
)
@one_blas_thread
def calibrate_hand_eye_from_poses(
    robot_poses: Sequence[Transform | Pose],
    target_poses: Sequence[Transform],
    *,
    setup: Setup,
    method: str = "auto",
    adjust: Literal["auto", "nothing", "scale"] = "auto",
    robot_sigmas: RobotSigmas | None = None,
    drop_bad: bool = True,
    allowed_error: float | None = None,
    most_scale: float = MAX_SCALE_ERROR,
) -> HandEyeCalibration:
    """Calibrate the pose of a camera on a robot, or beside it, from poses of the target.

    This is for cameras that return the pose of a target instead of its points in the image. Errors
    are those of the target's origin.

    Args:
        robot_poses: ``T_base_flange``.
        target_poses: ``T_camera_target``, as many.
        setup: as for :func:`calibrate_hand_eye`.
        method: as for :func:`calibrate_hand_eye`; ``reprojection`` gives a milliradian the weight
            of a millimetre.
        adjust: as for :func:`calibrate_hand_eye`.
        robot_sigmas: as for :func:`calibrate_hand_eye`.
        drop_bad: as for :func:`calibrate_hand_eye`.
        allowed_error: as for :func:`calibrate_hand_eye`.
        most_scale: as for :func:`calibrate_hand_eye`.

    Raises:
        CalibrationError: as for :func:`calibrate_hand_eye`.
    """
    target_poses = seen_poses(target_poses)
    check_positive(allowed_error, "allowed_error", "metres")
    check_positive(most_scale, "most_scale", "parts of its size")
    transforms, order, robot = _robot(robot_poses, len(target_poses), "poses of the target", setup)
    seen = [target_poses[i] for i in order]
    poses = Rigid.stacked(pose.rigid for pose in seen)
    scale = np.repeat(1.0 / np.array(ASSUMED_POSE_SIGMAS), 3)
    white = np.broadcast_to(np.diag(scale), (len(order), 6, 6))
    problem = Problem(
        robot=robot,
        seen=PoseObservations(white, poses),
        poses=poses,
        sigmas=_positive(robot_sigmas),
    )
    named = [f"pose {i}" for i in order]
    free = _allowed({NOTHING: (), "scale": (0,)}, adjust)
    request = _Asked(free, method, drop_bad, order, most_scale)
    return dataclasses.replace(
        _without_bad(problem, request, named, transforms, seen),
        target_poses=tuple(Transform(CAMERA, TARGET, *pose.rigid) for pose in target_poses),
        allowed_error=allowed_error,
    )


def _robot(
    robot_poses: Sequence[Transform | Pose], count: int, label: str, setup: str
) -> tuple[list[Transform], list[int], RobotPoses]:
    """Return the robot's poses, an order that depends only on their values, and the sorted poses.

    Raises SHAPE, WRONG_FRAME, and the errors of :func:`check_motion`.
    """
    in_hand = is_in_hand(setup, "hand-eye")
    robot_poses = as_list(robot_poses, object, "pose of the robot")
    if len(robot_poses) != count:
        raise Code.SHAPE.refusal(
            f"hand-eye: expected as many {label} as poses of the robot, got {count} and "
            f"{len(robot_poses)}",
            len(robot_poses),
            count,
        )
    transforms = [as_transform(pose, "flange").undated() for pose in robot_poses]
    for transform in transforms:
        if transform.label != transforms[0].label:
            raise Code.WRONG_FRAME.unexpected(
                f"hand-eye: expected all poses of the robot to be {transforms[0].label}",
                transforms[0].label,
                transform.label,
            )
    rows = np.array(
        [[*transform.translation, *transform.rotation.ravel()] for transform in transforms]
    )
    order = np.lexsort(rows.T[::-1]).tolist() if len(rows) else []
    ordered = Rigid.stacked(transforms[i].rigid for i in order)
    robot = RobotPoses(ordered, in_hand)
    check_motion(robot)
    return transforms, order, robot


def _positive(sigmas: RobotSigmas | None) -> RobotSigmas | None:
    if sigmas is None:
        return None
    given = as_vector(sigmas, 2, "robot_sigmas")
    if not (given > 0).all():
        raise Code.NOT_FINITE.unexpected(
            "robot_sigmas: expected two positive numbers, radians and metres",
            "two positive numbers",
            tuple(given.tolist()),
        )
    return RobotSigmas(*given.tolist())


def _numbered_alike(
    views: Sequence[TargetView], robot: RobotPoses, located: Sequence[TargetPose]
) -> list[TargetView]:
    """Return views with one origin, for a target that looks the same after half a turn."""
    target = views[0].target
    poses = Rigid.stacked(view.transform.rigid for view in located)
    lever = float(np.ptp(target.points, axis=0).max())
    other = other_numbering(robot, poses, half_turn(target), lever).tolist()
    return [
        half_turned(view) if turned else view for view, turned in zip(views, other, strict=True)
    ]


def _given_points(views: Sequence[TargetView]) -> Any:
    counts = np.array([len(view.ids) for view in views])
    return np.arange(counts.max())[None] < counts[:, None]


def _observations(
    views: Sequence[TargetView], located: Sequence[TargetPose], camera: CameraModel
) -> PixelObservations:
    """Return the views' points, with noise as large as the views themselves show."""
    residuals = np.concatenate([view.residuals for view in located])
    noise = np.concatenate([view.covariance for view in views])
    more = excess_variance(residuals, noise, residuals.size - 6 * len(views))
    given = _given_points(views)
    points, pixels = np.zeros((*given.shape, 3)), np.zeros((*given.shape, 2))
    white = np.zeros((*given.shape, 2, 2))
    for index, view in enumerate(views):
        points[index], pixels[index] = view.object_points[0], view.points[0]
        mask = given[index]
        points[index, mask], pixels[index, mask] = view.object_points, view.points
        white[index, mask] = whitening(view.covariance, more)
    return PixelObservations(white, camera, points, pixels, bends(points, given))


def _allowed(free: Mapping[str, tuple[int, ...]], adjust: str) -> dict[str, tuple[int, ...]]:
    check_choice(adjust, ["auto", *free], "adjust")
    return dict(free) if adjust == "auto" else {adjust: free[adjust]}


class _Asked(NamedTuple):
    """The options that the user gave."""

    # values that may be adjusted, with the numbers of their parameters
    free: Mapping[str, tuple[int, ...]]
    method: str  # name of the method, or ``auto``
    drop_bad: bool  # whether bad poses are left out
    order: list[int]  # numbers of the given poses in the order of their values
    most_scale: float  # part by which the target's size may be off


def _without_bad(
    problem: Problem,
    request: _Asked,
    named: Sequence[str],
    transforms: Sequence[Transform],
    seen: Sequence[TargetView | Transform],
) -> HandEyeCalibration:
    """Return the calibration from the poses that are not bad, with the errors of all poses.

    ``transforms`` are the robot's poses as given, all else is in the order of their values. Raises
    ``SCALE_MISMATCH``, besides the errors of poses that do not fit.
    """
    robot_poses = [transforms[i] for i in request.order]
    used, remarks = _start_poses(problem, request, named)
    result = _solved(problem.subset(used), request, robot_poses[0])
    while len(bad := _bad(result)) and request.drop_bad:
        worst = sorted(bad, key=lambda index: -result.leave_one_out[index])
        worst = worst[: 1 + len(used) // POSES_PER_EXTRA_REMOVAL]
        fewer = np.delete(used, worst)
        most = MAX_BAD_POSE_SHARE * problem.count
        if len(fewer) < MIN_ADVISED_POSES or problem.count - len(fewer) > most:
            break
        try:
            check_motion(problem.robot.subset(fewer))
        except CalibrationError:  # too few are left without it
            break
        for index in worst:
            number = int(used[index])
            remarks[number] = _bad_view(result, index, named[number], "was not used")
        used, result = fewer, _solved(problem.subset(fewer), request, robot_poses[0])
    for index in bad:
        number = int(used[index])
        remark = _bad_view(result, index, named[number], "is used all the same")
        remarks.setdefault(number, remark)
    errors, left_out = np.full((2, problem.count), np.nan)
    unused = np.setdiff1d(np.arange(problem.count), used)
    left: list[int] = unused.tolist()
    for number in left:
        (errors_of_pose,) = result.point_errors([robot_poses[number]], [seen[number]])
        if np.isfinite(errors_of_pose).all():
            errors[number] = left_out[number] = math.sqrt(float((errors_of_pose**2).mean()))
    errors[used], left_out[used] = result.errors, result.leave_one_out
    sampled, back = problem.subset(used), np.argsort(request.order)
    _check_fit(sampled, result)
    _check_scale(result.target_scale, request.most_scale)
    return dataclasses.replace(
        result,
        errors=errors[back],
        leave_one_out=left_out[back],
        robot_poses=tuple(transforms),
        used=tuple(np.isin(back, used).tolist()),
        warnings=(
            *_size_remark(sampled, request),
            *_remarks(sampled, result),
            *_moved_remark(problem.subset(unused), result, [named[i] for i in left]),
            *remarks.values(),
        ),
    )


def _moved_remark(
    unused: Problem, result: HandEyeCalibration, named: Sequence[str]
) -> Iterator[Remark]:
    """Yield a remark if the poses that were left out agree on another place of camera or target."""
    if not named:
        return
    between, seen = unused.robot.between, unused.poses.scaled(result.target_scale)
    camera, target = result.camera_pose.rigid, result.target_pose.rigid
    lever = float(np.linalg.norm(seen.translation, axis=1).mean())
    places = {"target": target.before(between.inverse() @ (camera @ seen))}
    places["camera"] = camera.before(between @ (target @ seen.inverse()))
    for thing, steps in places.items():
        if (move := common_move(steps * np.repeat([lever, 1.0], 3))) is not None:
            yield Code.POOR_FIT.remark(
                f"the {thing} seems to have moved by {1e3 * np.linalg.norm(move[3:]):.3g} mm: "
                f"{', '.join(named)} were left out, and agree on another place of it than all "
                "others; which of both holds now, they cannot tell"
            )
            return


def _start_poses(
    problem: Problem, request: _Asked, named: Sequence[str]
) -> tuple[NDArray[np.intp], dict[int, Remark]]:
    """Return the poses to begin with, and remarks, by number, on those that belong to other views.

    Raises ``WRONG_FRAME`` or ``POOR_FIT``.
    """
    agreed, everything = check_poses(problem), np.arange(problem.count)
    gross = agreed.gross(max_plausible_error(problem))
    left = problem.count - len(gross)
    drop = (
        request.drop_bad
        and left >= MIN_GOOD_POSES
        and len(gross) <= MAX_BAD_POSE_SHARE * problem.count
    )
    used = np.setdiff1d(everything, gross) if drop else everything
    try:
        check_motion(problem.robot.subset(used))
    except CalibrationError:  # too few are left without them
        drop, used = False, everything
    done = "was not used" if drop else "is used all the same"
    return used, {
        index: Code.BAD_VIEW.remark(
            f"{named[index]} is {1e3 * agreed.off[index]:.3g} mm off what most poses agree with to "
            f"{1e3 * agreed.median:.3g} mm: it belongs to another view, or numbers the target from "
            f"its other end; it {done}"
        )
        for index in gross.tolist()
    }


def _bad(result: HandEyeCalibration) -> list[int]:
    """Return the indices of poses that the others do not predict."""
    if result.held_out_error is None:
        return []
    errors = result.leave_one_out
    bad: list[int] = np.flatnonzero(
        errors > BAD_POSE_RATIO * max(float(np.median(errors)), ROUNDING_ERROR_M)
    ).tolist()
    return bad


def _bad_view(result: HandEyeCalibration, index: int, name: str, done: str) -> Remark:
    errors = 1e3 * result.leave_one_out
    return Code.BAD_VIEW.remark(
        f"{name} is {errors[index]:.3g} mm off what the others say of it, half of them are "
        f"{np.median(errors):.3g} mm or less: its pose of the robot or its image is wrong; it "
        f"{done}"
    )


def _solved(problem: Problem, request: _Asked, pose: Transform) -> HandEyeCalibration:
    check_choice(request.method, ["auto", *METHODS], "method")
    chosen, candidates_ = candidates(problem, request.free, request.method)
    if chosen is None:
        raise poor_fit_error(f"none at all {problem.count} poses", None)
    return _result(problem, chosen, candidates_, pose)


def _check_fit(problem: Problem, result: HandEyeCalibration) -> None:
    """Raise ``POOR_FIT`` if poses and views do not belong together."""
    errors = result.errors if result.held_out_error is None else result.leave_one_out
    error, most = float(np.median(errors)), max_plausible_error(problem)
    if error > most:
        raise poor_fit_error(
            f"one {1e3 * error:.3g} mm off, {1e3 * most:.3g} mm at most expected", error
        )


def _result(
    problem: Problem,
    chosen: Candidate,
    considered: Sequence[Candidate],
    pose: Transform,
) -> HandEyeCalibration:
    in_hand, solution = problem.robot.in_hand, chosen.solution
    hand, base = pose.source, pose.target
    seen = chosen.problem.seen
    errors = chosen.problem.errors(solution)
    held_out = np.where(np.isfinite(chosen.errors), chosen.errors, np.nan)
    camera = seen.camera(solution.change) if isinstance(seen, PixelObservations) else None
    return HandEyeCalibration(
        setup="eye-in-hand" if in_hand else "eye-to-hand",
        camera_pose=Transform(hand if in_hand else base, CAMERA, *solution.camera),
        target_pose=Transform(base if in_hand else hand, TARGET, *solution.target),
        camera=camera,
        target_scale=seen.scale(solution.change),
        method=chosen.name,
        candidates={
            candidate.name: candidate.held_out if math.isfinite(candidate.held_out) else None
            for candidate in considered
        },
        errors=np.array([math.sqrt(float((error**2).mean())) for error in errors]),
        mean_error=float(np.concatenate(errors).mean()),
        leave_one_out=held_out,
        held_out_error=chosen.held_out if math.isfinite(chosen.held_out) else None,
        covariance=_covariance(chosen),
        robot_sigmas=None if solution.noise is None else solution.noise.robot,
        robot_poses=(),
        used=(True,) * problem.count,
    )


def _check_scale(scale: float, most: float) -> None:
    """Raise ``SCALE_MISMATCH`` if the target's size is off by more than is allowed."""
    if abs(scale - 1.0) > most:
        raise Code.SCALE_MISMATCH.refusal(
            f"hand-eye: expected the target as large as it was said, to {100 * most:g} %, got one "
            f"{scale:.3f} times as large by the robot's motions: measure the print, and say how "
            "large it is; or allow more by most_scale",
            most,
            scale,
        )


def _covariance(chosen: Candidate) -> Array:
    """Return the covariance of steps of camera and target (12, 12), from the scatter between poses.

    The differences to solutions that may be right as well are included. If the lens was calibrated
    from the same views and not adjusted since, its own error is, too. NaN if there are too few
    poses.
    """
    solution, others = chosen.solution, chosen.others
    if others is None or chosen.problem.count < MIN_POSES_FOR_ERROR:
        return np.full((12, 12), np.nan)
    cameras, targets = solution.camera.before(others.camera), solution.target.before(others.target)
    steps = np.concatenate([cameras, targets], axis=1)
    information, left = solution.information, others.information
    if information is None or left is None:  # solved without a part of the poses, not without each
        return jackknife(steps[:MAX_FOLDS])
    if len(information) > 12:
        steps = np.concatenate([steps, others.change - solution.change], axis=1)
    places = of_one_place(chosen.problem.robot.poses)
    # poses of one place are left out together
    alike = [places == place for place in np.unique(places)]
    steps = np.array([steps[mask].sum(axis=0) for mask in alike])  # correct to first order
    left = np.array([information - (information - left[mask]).sum(axis=0) for mask in alike])
    spreads = np.array([inverse_scaled(information_left) for information_left in left])
    full = inverse_scaled(information)
    scatter = weighted_jackknife(steps, spreads, full, WEIGHT_POWER)[:12, :12]
    for rival in chosen.rivals:
        both = solution.camera.before(rival.camera), solution.target.before(rival.target)
        scatter += np.outer(step := np.concatenate(both), step)
    lens, seen = chosen.problem.lens, chosen.problem.seen
    if lens is None or not isinstance(seen, PixelObservations) or any(seen.free):
        return scatter
    numbers = tuple(range(1, 5 + len(seen.model.distortion)))
    slopes = pull(chosen.problem.robot, seen, solution, numbers)
    joint: Array = scatter + slopes @ lens @ slopes.T
    return joint


def _size_remark(problem: Problem, request: _Asked) -> Iterator[Remark]:
    """Return a remark if the target has another size, and that was not to be adjusted."""
    if request.method not in LINEAR and any(0 in freed for freed in request.free.values()):
        return
    numbers = np.arange(problem.count)
    scale = scale_of(problem.robot, problem.poses)
    parts = [problem.subset(numbers[numbers != i]) for i in numbers if problem.count > MIN_POSES]
    others = [scale_of(part.robot, part.poses) for part in parts]
    if scale is None or not others or None in others:
        return
    sigma = math.sqrt(float(jackknife(np.array(others, dtype=np.float64)[:, None])[0, 0]))
    if abs(scale - 1.0) > max(REMARKED_SCALE_ERROR, REMARKED_SCALE_SIGMAS * sigma):
        yield Code.SCALE_MISMATCH.remark(
            f"expected the target as large as it was said, got {scale:.4f} times that by the "
            "robot's motions, and the size was not to be adjusted: measure the print; or the "
            "lens' focal length is off by as much"
        )


def _remarks(problem: Problem, result: HandEyeCalibration) -> Iterator[Remark]:
    if abs(result.target_scale - 1.0) > REMARKED_SCALE_ERROR:
        yield Code.SCALE_MISMATCH.remark(
            f"expected the target as large as it was said, got {result.target_scale:.4f} times "
            "that by the robot's motions: measure the print; poses and errors are those of a "
            "target of that size"
        )
    places = len(np.unique(of_one_place(problem.robot.poses)))
    if places < MIN_ADVISED_POSES:
        alike = f" that are different, of {problem.count}" if places < problem.count else ""
        yield Code.TOO_FEW.remark(
            f"expected {MIN_ADVISED_POSES} poses or more for an error that can be relied on, got "
            f"{places}{alike}"
        )
    # a remark that depends on a single pose is of no use
    turn = float(second_turns(problem.robot).max())
    if turn < MIN_ADVISED_TURN_RADIANS:
        yield Code.INSUFFICIENT_ROTATION.remark(
            f"expected the robot to turn by {math.degrees(MIN_ADVISED_TURN_RADIANS):g} deg rms "
            f"about a second axis, got {math.degrees(turn):.1f} deg, whichever pose is left out: "
            "tilt it more to both sides"
        )
    if result.held_out_error is None:
        yield Code.NOT_HELD_OUT.remark("too few poses to leave one out: no held-out error")
    elif result.held_out_error > (most := expected_error(problem, POOR_ROBOT)):
        yield Code.POOR_FIT.remark(
            f"expected a held-out error of {1e3 * most:.3g} mm at most, as of a robot that is "
            f"{1e3 * POOR_ROBOT.translation:g} mm and {math.degrees(POOR_ROBOT.rotation):g} deg "
            f"off, got {1e3 * result.held_out_error:.3g} mm: did the robot stand still, does the "
            "target or the camera slip, is a pose one of another view?"
        )


def _lens_remarks(given: CameraModel, adjusted: CameraModel | None) -> list[Remark]:
    if adjusted is None or np.array_equal(given.matrix, adjusted.matrix):
        return []
    before, after = given.matrix[0, 0], adjusted.matrix[0, 0]
    return [
        Code.WRONG_LENS.remark(
            f"expected the lens as it was given, got one that fits far better: fx {after:.1f} px "
            f"instead of {before:.1f} px; the calibration's camera is that one"
        )
    ]
