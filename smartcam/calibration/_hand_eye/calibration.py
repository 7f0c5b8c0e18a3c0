"""Calibrate the pose of a camera on a robot's hand, or of a fixed camera beside the robot.

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

from smartcam._argument_checks import a_list, a_number, check_arguments, each, of_class, or_none
from smartcam._arguments import check_flag, check_text
from smartcam.calibration._hand_eye.closed_forms import (
    MIN_POSES,
    OPENCV_METHODS,
    check_motion,
    estimate_scale,
    left_out_second_axis_turns,
    same_place_indices,
)
from smartcam.calibration._hand_eye.equations import (
    PixelObservations,
    PoseObservations,
    RobotPoses,
    RobotSigmas,
    bend_heights,
    derivatives_by_parameters,
    is_in_hand,
)
from smartcam.calibration._hand_eye.model_selection import (
    MAX_FOLDS,
    METHODS,
    NOTHING,
    Problem,
    fit_candidates,
)
from smartcam.calibration._hand_eye.result import HandEyeCalibration, as_transform
from smartcam.calibration._hand_eye.validation import (
    as_target_poses,
    check_poses,
    expected_error,
    find_other_numbering,
    max_plausible_error,
    poor_fit_error,
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
"""Before each new solution one bad pose is left out; with many poses, one more for each of this
many poses."""

MIN_ADVISED_POSES = 8
"""With fewer poses than this, a remark says that the residuals tell little about the error."""

MIN_ADVISED_TURN_RADIANS = math.radians(8.0)
"""If the RMS turn of the poses about their second axis is smaller, the result has a remark. Leaving
out some of eight poses changes this turn by two or three degrees."""

MAX_SCALE_ERROR = 0.2
"""Default of ``max_scale_error``: fraction by which a target's size may differ from the nominal."""

REMARKED_SCALE_ERROR = 0.005
"""A size of the target that differs from the nominal one by more than this fraction is remarked."""

REMARKED_SCALE_SIGMAS = 5.0
"""If the target's size is not adjusted, there is a remark if it differs by more than this many
standard deviations."""

BAD_POSE_RATIO = 4.0
"""A pose is bad if its held-out error is more than this many times the median. Of normal errors
along two axes, one in 60000 is as large."""

ROUNDING_ERROR_M = 1e-7
"""No pose is bad with an error below this length, metres, which may be a rounding error."""

MAX_BAD_POSE_SHARE = 1 / 3
"""At most this fraction of the poses may be left out."""

MIN_GOOD_POSES = 5
"""At least this many poses must remain after those that were paired with a wrong view are left
out."""

MIN_POSES_FOR_ERROR = 5
"""The covariance is estimated from the scatter of at least this many poses."""

WEIGHT_POWER = 1 / 2
"""Power of a pose's weight in the covariance: errors of poses are independent of each other."""

POOR_ROBOT = RobotSigmas(math.radians(0.25), 2e-3)
"""Standard deviations of a robot that is worse than most, 0.25 degrees and 2 mm. If the held-out
error is larger than such a robot causes, the result has a remark."""

ASSUMED_POSE_SIGMAS = RobotSigmas(1e-3, 1e-3)
"""Standard deviations (rad, m) that are assumed for target poses without a covariance; only their
ratio matters."""


@check_arguments(
    robot_poses=a_list,
    views=each(of_class("TargetView")),
    setup=check_text,
    camera=or_none(of_class("CameraModel")),
    method=check_text,
    adjust=check_text,
    drop_bad=check_flag,
    max_scale_error=a_number,
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
    max_scale_error: float = MAX_SCALE_ERROR,
) -> HandEyeCalibration:
    """Calibrate the pose of a camera on a robot, or beside it, from views of a target.

    Args:
        robot_poses: ``T_base_flange`` at each view: the flange's pose in the robot's base.
        views: one view of the target for each robot pose. A target that looks the same after half a
            turn is numbered from the same end in all of them, as the robot's motions tell.
        setup: place of the camera: on the hand (``eye-in-hand``, with a fixed target), or fixed
            beside the robot (``eye-to-hand``, with the target on the hand).
        camera: the camera's lens, which the expected errors assume to be exact. None: the lens is
            calibrated, too, from the same views and the robot's motions, together with bends of the
            target. The views should then show the target tilted, and the expected errors include
            those of the lens. If ``adjust`` keeps the lens, it is calibrated from the views alone,
            with the target's points adjusted.
        method: ``auto`` chooses the one of ``robot`` and ``reprojection`` that predicts left-out
            poses better; or one of these two, or one of OpenCV's closed forms, see
            :data:`~smartcam.calibration._hand_eye.model_selection.METHODS`.
        adjust: value that is adjusted besides the poses: the target's ``scale`` (printers change
            it), the ``camera``, or ``nothing``; ``auto`` chooses by the held-out error.
        robot_sigmas: standard deviations of each axis of the robot's poses; None: estimated.
        drop_bad: whether poses that are far from the others' prediction are left out and named, at
            most a third of them, and only while 8 are left; else they are only named. Poses that
            were paired with a wrong view are left out as long as 5 poses remain.
        allowed_error: largest error, metres, that 95 of 100 points on the target may have; None: a
            hundredth of the target's distance. See :attr:`HandEyeCalibration.verdict`.
        max_scale_error: fraction by which the target's size may be off. The robot's motions show
            how large the target is, and a larger difference is refused.

    The order of the poses does not matter.

    Raises:
        CalibrationError: ``TOO_FEW``, ``POSES_TOO_SIMILAR``, ``INSUFFICIENT_ROTATION``; ``SHAPE``:
            the numbers of views and poses differ, or these are something else; ``WRONG_SIZE``;
            ``WRONG_FRAME``: poses are in several frames, or fit only when inverted or transposed;
            ``MIRRORED``: the robot's base is left-handed, or pictures are flipped;
            ``DIFFERENT_TARGETS``; ``SCALE_MISMATCH``: the size of the print is off by more than
            ``max_scale_error``; ``POOR_FIT``: nothing fits, as when poses and views are mixed up or
            lengths are in millimetres; and those of
            :func:`~smartcam.calibration.calibrate_intrinsics`.
        MissingExtraError: SciPy or OpenCV is not installed, or OpenCV is 5.0.0.
    """
    views = as_views(views, "hand-eye")
    check_positive(allowed_error, "allowed_error", "metres")
    check_positive(max_scale_error, "max_scale_error", "parts of its size")
    transforms, order, robot = _check_robot_poses(robot_poses, len(views), "views", setup)
    if any(view.target != views[0].target for view in views):
        raise Code.DIFFERENT_TARGETS.error(
            "hand-eye: expected views of one target, got views of several", views[0].target
        )
    ordered = [views[i] for i in order]
    lens, lens_calibration, sheet_remarks = camera, None, list[Remark]()
    if lens is None:
        # If the views alone determine the lens, a sheet bent by 0.1 mm, which views cannot show,
        # makes the camera's error 1.7 mm where 0.7 mm are expected (simulated).
        can_adjust_sheet = len(ordered[0].target.points) <= MAX_FREE_POINTS
        sheet_option: SheetOption = "free" if can_adjust_sheet else "exact"
        lens_calibration = calibrate_intrinsics(
            ordered, sheet="auto" if adjust == "auto" else sheet_option
        )
        lens = lens_calibration.camera
        sheet_remarks = [
            warning for warning in lens_calibration.warnings if warning.code == Code.SHEET_NOT_EXACT
        ]
    located = [locate(view, lens) for view in ordered]
    if ordered[0].target.half_turn_symmetric:
        ordered = _renumber_views(ordered, robot, located)
        located = [locate(view, lens) for view in ordered]
        views = [ordered[i] for i in np.argsort(order)]
    ordered, stray_remarks = remove_strays(ordered, located, lens, is_lens_given=camera is not None)
    located = [locate(view, lens) for view in ordered] if stray_remarks else located
    poses = Rigid.stack(view.transform.rigid for view in located)
    observations = _pixel_observations(ordered, located, lens)
    problem = Problem(
        robot=robot,
        observations=observations,
        target_poses=poses,
        point_mask=_point_mask(ordered),
        robot_sigmas=_check_sigmas(robot_sigmas),
        lens_covariance=None if lens_calibration is None else lens_calibration.covariance,
    )
    names = [view.name or f"pose {i}" for i, view in zip(order, ordered, strict=True)]
    distortion_indices = [5 + i for i in np.flatnonzero(lens.distortion).tolist()]
    if lens_calibration is not None:
        # a sheet bent by 0.15 mm would bend a lens that takes it as flat
        distortion_indices += [
            5 + len(lens.distortion) + i for i in range(observations.heights.shape[2])
        ]
    parameter_choices = {NOTHING: (), "scale": (0,), "camera": (1, 2, 3, 4, *distortion_indices)}
    parameter_choices["scale and camera"] = (0, *parameter_choices["camera"])
    if lens_calibration is not None and adjust == "auto":
        # The robot's motions determine a lens better than views of a bent sheet: if the sheet bends
        # anew by 0.5 mm, cameras are 0.9 mm off instead of 1.8 mm (simulated).
        del parameter_choices[NOTHING], parameter_choices["scale"]
    options = _HandEyeOptions(
        _choices_of(parameter_choices, adjust), method, drop_bad, order, max_scale_error
    )
    result = _calibrate_without_bad(problem, options, names, transforms, ordered)
    remarks = [] if camera is None else _lens_remarks(camera, result.camera)
    if remarks:
        stray_remarks = [remark for remark in stray_remarks if remark.code != Code.WRONG_LENS]
    return dataclasses.replace(
        result,
        warnings=(*result.warnings, *remarks, *sheet_remarks, *stray_remarks),
        views=tuple(views),
        target_poses=tuple(located[i].transform for i in np.argsort(order)),
        allowed_error=allowed_error,
    )


@check_arguments(
    robot_poses=a_list,
    target_poses=each(of_class("Transform")),
    setup=check_text,
    method=check_text,
    adjust=check_text,
    drop_bad=check_flag,
    max_scale_error=a_number,
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
    max_scale_error: float = MAX_SCALE_ERROR,
) -> HandEyeCalibration:
    """Calibrate the pose of a camera on a robot, or beside it, from poses of the target.

    This is for cameras that return the pose of a target instead of its points in the image. Errors
    are those of the target's origin.

    Args:
        robot_poses: ``T_base_flange``.
        target_poses: ``T_camera_target``, one for each robot pose.
        setup: as for :func:`calibrate_hand_eye`.
        method: as for :func:`calibrate_hand_eye`; ``reprojection`` gives a milliradian the weight
            of a millimetre.
        adjust: as for :func:`calibrate_hand_eye`.
        robot_sigmas: as for :func:`calibrate_hand_eye`.
        drop_bad: as for :func:`calibrate_hand_eye`.
        allowed_error: as for :func:`calibrate_hand_eye`.
        max_scale_error: as for :func:`calibrate_hand_eye`.

    Raises:
        CalibrationError: as for :func:`calibrate_hand_eye`.
    """
    target_poses = as_target_poses(target_poses)
    check_positive(allowed_error, "allowed_error", "metres")
    check_positive(max_scale_error, "max_scale_error", "parts of its size")
    transforms, order, robot = _check_robot_poses(
        robot_poses, len(target_poses), "poses of the target", setup
    )
    ordered = [target_poses[i] for i in order]
    poses = Rigid.stack(pose.rigid for pose in ordered)
    scale = np.repeat(1.0 / np.array(ASSUMED_POSE_SIGMAS), 3)
    whitening = np.broadcast_to(np.diag(scale), (len(order), 6, 6))
    problem = Problem(
        robot=robot,
        observations=PoseObservations(whitening, poses),
        target_poses=poses,
        robot_sigmas=_check_sigmas(robot_sigmas),
    )
    names = [f"pose {i}" for i in order]
    parameter_choices = _choices_of({NOTHING: (), "scale": (0,)}, adjust)
    options = _HandEyeOptions(parameter_choices, method, drop_bad, order, max_scale_error)
    return dataclasses.replace(
        _calibrate_without_bad(problem, options, names, transforms, ordered),
        target_poses=tuple(Transform(CAMERA, TARGET, *pose.rigid) for pose in target_poses),
        allowed_error=allowed_error,
    )


def _check_robot_poses(
    robot_poses: Sequence[Transform | Pose], count: int, label: str, setup: str
) -> tuple[list[Transform], list[int], RobotPoses]:
    """Return the robot's poses, an order that depends only on their values, and the sorted poses.

    Raises SHAPE, WRONG_FRAME, and the errors of :func:`check_motion`.
    """
    in_hand = is_in_hand(setup, "hand-eye")
    robot_poses = as_list(robot_poses, object, "pose of the robot")
    if len(robot_poses) != count:
        raise Code.SHAPE.error(
            f"hand-eye: expected as many {label} as poses of the robot, got {count} and "
            f"{len(robot_poses)}",
            len(robot_poses),
            count,
        )
    transforms = [as_transform(pose, "flange").undated() for pose in robot_poses]
    for transform in transforms:
        if transform.label != transforms[0].label:
            raise Code.WRONG_FRAME.error_with_value(
                f"hand-eye: expected all poses of the robot to be {transforms[0].label}",
                transforms[0].label,
                transform.label,
            )
    rows = np.array(
        [[*transform.translation, *transform.rotation.ravel()] for transform in transforms]
    )
    order = np.lexsort(rows.T[::-1]).tolist() if len(rows) else []
    ordered = Rigid.stack(transforms[i].rigid for i in order)
    robot = RobotPoses(ordered, in_hand)
    check_motion(robot)
    return transforms, order, robot


def _check_sigmas(sigmas: RobotSigmas | None) -> RobotSigmas | None:
    if sigmas is None:
        return None
    values = as_vector(sigmas, 2, "robot_sigmas")
    if not (values > 0).all():
        raise Code.NOT_FINITE.error_with_value(
            "robot_sigmas: expected two positive numbers, radians and metres",
            "two positive numbers",
            tuple(values.tolist()),
        )
    return RobotSigmas(*values.tolist())


def _renumber_views(
    views: Sequence[TargetView], robot: RobotPoses, located: Sequence[TargetPose]
) -> list[TargetView]:
    """Return the views of a target that looks the same after half a turn, numbered from one end."""
    target = views[0].target
    poses = Rigid.stack(view.transform.rigid for view in located)
    lever = float(np.ptp(target.points, axis=0).max())
    turned_mask = find_other_numbering(robot, poses, half_turn(target), lever).tolist()
    return [
        half_turned(view) if is_turned else view
        for view, is_turned in zip(views, turned_mask, strict=True)
    ]


def _point_mask(views: Sequence[TargetView]) -> Any:
    counts = np.array([len(view.ids) for view in views])
    return np.arange(counts.max())[None] < counts[:, None]


def _pixel_observations(
    views: Sequence[TargetView], located: Sequence[TargetPose], camera: CameraModel
) -> PixelObservations:
    """Return the views' points, weighted by the noise that the views show."""
    residuals = np.concatenate([view.residuals for view in located])
    noise = np.concatenate([view.covariance for view in views])
    extra_variance = excess_variance(residuals, noise, residuals.size - 6 * len(views))
    point_mask = _point_mask(views)
    points, pixels = np.zeros((*point_mask.shape, 3)), np.zeros((*point_mask.shape, 2))
    whitening_matrices = np.zeros((*point_mask.shape, 2, 2))
    for index, view in enumerate(views):
        points[index], pixels[index] = view.object_points[0], view.points[0]
        seen_points = point_mask[index]
        points[index, seen_points], pixels[index, seen_points] = view.object_points, view.points
        whitening_matrices[index, seen_points] = whitening(view.covariance, extra_variance)
    return PixelObservations(
        whitening_matrices, camera, points, pixels, bend_heights(points, point_mask)
    )


def _choices_of(
    parameter_choices: Mapping[str, tuple[int, ...]], adjust: str
) -> dict[str, tuple[int, ...]]:
    check_choice(adjust, ["auto", *parameter_choices], "adjust")
    return dict(parameter_choices) if adjust == "auto" else {adjust: parameter_choices[adjust]}


class _HandEyeOptions(NamedTuple):
    """The options that the user gave."""

    # values that may be adjusted, such as ``scale``, with the indices of their parameters
    parameter_choices: Mapping[str, tuple[int, ...]]
    method: str  # name of the method, or ``auto``
    drop_bad: bool  # whether bad poses are left out
    order: list[int]  # indices of the given poses, sorted by the values of the poses
    max_scale_error: float  # fraction by which the target's size may be off


def _calibrate_without_bad(
    problem: Problem,
    options: _HandEyeOptions,
    names: Sequence[str],
    transforms: Sequence[Transform],
    views: Sequence[TargetView | Transform],
) -> HandEyeCalibration:
    """Return the calibration from the good poses; its errors include those of the bad poses.

    ``transforms`` are the robot's poses as given; all other arguments are in ``options.order``.
    Raises ``SCALE_MISMATCH``, and the errors of poses that do not fit.
    """
    robot_poses = [transforms[i] for i in options.order]
    used, remarks = _start_poses(problem, options, names)
    result = _solve(problem.subset(used), options, robot_poses[0])
    while len(bad := _bad_indices(result)) and options.drop_bad:
        worst_indices = sorted(bad, key=lambda index: -result.leave_one_out[index])
        worst_indices = worst_indices[: 1 + len(used) // POSES_PER_EXTRA_REMOVAL]
        remaining = np.delete(used, worst_indices)
        max_removed = MAX_BAD_POSE_SHARE * problem.count
        if len(remaining) < MIN_ADVISED_POSES or problem.count - len(remaining) > max_removed:
            break
        try:
            check_motion(problem.robot.subset(remaining))
        except CalibrationError:  # the remaining poses do not determine the camera
            break
        for index in worst_indices:
            number = int(used[index])
            remarks[number] = _bad_pose_remark(result, index, names[number], "was not used")
        used, result = remaining, _solve(problem.subset(remaining), options, robot_poses[0])
    for index in bad:
        number = int(used[index])
        remark = _bad_pose_remark(result, index, names[number], "is used all the same")
        remarks.setdefault(number, remark)
    errors, held_out_errors = np.full((2, problem.count), np.nan)
    unused = np.setdiff1d(np.arange(problem.count), used)
    unused_list: list[int] = unused.tolist()
    for number in unused_list:
        (errors_of_pose,) = result.point_errors([robot_poses[number]], [views[number]])
        if np.isfinite(errors_of_pose).all():
            errors[number] = held_out_errors[number] = math.sqrt(float((errors_of_pose**2).mean()))
    errors[used], held_out_errors[used] = result.errors, result.leave_one_out
    used_problem, given_order = problem.subset(used), np.argsort(options.order)
    _check_fit(used_problem, result)
    _check_scale(result.target_scale, options.max_scale_error)
    return dataclasses.replace(
        result,
        errors=errors[given_order],
        leave_one_out=held_out_errors[given_order],
        robot_poses=tuple(transforms),
        used=tuple(np.isin(given_order, used).tolist()),
        warnings=(
            *_size_remarks(used_problem, options),
            *_remarks(used_problem, result),
            *_move_remarks(problem.subset(unused), result, [names[i] for i in unused_list]),
            *remarks.values(),
        ),
    )


def _move_remarks(
    unused: Problem, result: HandEyeCalibration, names: Sequence[str]
) -> Iterator[Remark]:
    """Yield a remark if the left-out poses agree on another place: something was moved."""
    if not names:
        return
    motion, target_poses = (
        unused.robot.carrier_motion,
        unused.target_poses.scaled(result.target_scale),
    )
    camera, target = result.camera_pose.rigid, result.target_pose.rigid
    lever = float(np.linalg.norm(target_poses.translation, axis=1).mean())
    steps_by_object = {"target": target.source_steps_to(motion.inverse() @ (camera @ target_poses))}
    steps_by_object["camera"] = camera.source_steps_to(motion @ (target @ target_poses.inverse()))
    for name, steps in steps_by_object.items():
        if (shift := common_move(steps * np.repeat([lever, 1.0], 3))) is not None:
            yield Code.POOR_FIT.remark(
                f"the {name} seems to have moved by {1e3 * np.linalg.norm(shift[3:]):.3g} mm: "
                f"{', '.join(names)} were left out, and agree with each other on another place of "
                "it; find out which of the two places is the current one"
            )
            return


def _start_poses(
    problem: Problem, options: _HandEyeOptions, names: Sequence[str]
) -> tuple[NDArray[np.intp], dict[int, Remark]]:
    """Return the indices of the poses to start with, and remarks on poses of other views.

    Raises ``WRONG_FRAME`` or ``POOR_FIT``.
    """
    agreement, all_indices = check_poses(problem), np.arange(problem.count)
    gross_indices = agreement.gross_error_indices(max_plausible_error(problem))
    remaining_count = problem.count - len(gross_indices)
    can_drop = (
        options.drop_bad
        and remaining_count >= MIN_GOOD_POSES
        and len(gross_indices) <= MAX_BAD_POSE_SHARE * problem.count
    )
    used = np.setdiff1d(all_indices, gross_indices) if can_drop else all_indices
    try:
        check_motion(problem.robot.subset(used))
    except CalibrationError:  # the remaining poses do not determine the camera
        can_drop, used = False, all_indices
    outcome = "was not used" if can_drop else "is used all the same"
    return used, {
        index: Code.BAD_VIEW.remark(
            f"{names[index]} is {1e3 * agreement.errors[index]:.3g} mm away from what most poses "
            f"agree on within {1e3 * agreement.median:.3g} mm: it was paired with a wrong view, "
            f"or its view is numbered from the target's other end; it {outcome}"
        )
        for index in gross_indices.tolist()
    }


def _bad_indices(result: HandEyeCalibration) -> list[int]:
    """Return the indices of poses that the other poses do not predict."""
    if result.held_out_error is None:
        return []
    errors = result.leave_one_out
    bad: list[int] = np.flatnonzero(
        errors > BAD_POSE_RATIO * max(float(np.median(errors)), ROUNDING_ERROR_M)
    ).tolist()
    return bad


def _bad_pose_remark(result: HandEyeCalibration, index: int, name: str, outcome: str) -> Remark:
    errors = 1e3 * result.leave_one_out
    return Code.BAD_VIEW.remark(
        f"{name} is {errors[index]:.3g} mm away from where the other poses predict it; the median "
        f"of all poses is {np.median(errors):.3g} mm: its pose of the robot or its image is wrong; "
        f"it {outcome}"
    )


def _solve(problem: Problem, options: _HandEyeOptions, pose: Transform) -> HandEyeCalibration:
    check_choice(options.method, ["auto", *METHODS], "method")
    best, all_candidates = fit_candidates(problem, options.parameter_choices, options.method)
    if best is None:
        raise poor_fit_error(f"no solution for all {problem.count} poses", None)
    return _build_calibration(problem, best, all_candidates, pose)


def _check_fit(problem: Problem, result: HandEyeCalibration) -> None:
    """Raise ``POOR_FIT`` if poses and views do not belong together."""
    errors = result.errors if result.held_out_error is None else result.leave_one_out
    error, max_error = float(np.median(errors)), max_plausible_error(problem)
    if error > max_error:
        raise poor_fit_error(
            f"one {1e3 * error:.3g} mm off, {1e3 * max_error:.3g} mm at most expected", error
        )


def _build_calibration(
    problem: Problem,
    best: Candidate,
    all_candidates: Sequence[Candidate],
    pose: Transform,
) -> HandEyeCalibration:
    in_hand, solution = problem.robot.in_hand, best.solution
    hand, base = pose.source, pose.target
    observations = best.problem.observations
    errors = best.problem.errors(solution)
    held_out = np.where(np.isfinite(best.held_out_errors), best.held_out_errors, np.nan)
    camera = (
        observations.camera(solution.change)
        if isinstance(observations, PixelObservations)
        else None
    )
    return HandEyeCalibration(
        setup="eye-in-hand" if in_hand else "eye-to-hand",
        camera_pose=Transform(hand if in_hand else base, CAMERA, *solution.camera),
        target_pose=Transform(base if in_hand else hand, TARGET, *solution.target),
        camera=camera,
        target_scale=observations.scale(solution.change),
        method=best.name,
        candidate_errors={
            candidate.name: candidate.held_out if math.isfinite(candidate.held_out) else None
            for candidate in all_candidates
        },
        errors=np.array([math.sqrt(float((error**2).mean())) for error in errors]),
        mean_error=float(np.concatenate(errors).mean()),
        leave_one_out=held_out,
        held_out_error=best.held_out if math.isfinite(best.held_out) else None,
        covariance=_covariance(best),
        robot_sigmas=None if solution.noise is None else solution.noise.robot,
        robot_poses=(),
        used=(True,) * problem.count,
    )


def _check_scale(scale: float, max_error: float) -> None:
    """Raise ``SCALE_MISMATCH`` if the target's size is off by more than is allowed."""
    if abs(scale - 1.0) > max_error:
        raise Code.SCALE_MISMATCH.error(
            "hand-eye: expected a target of the given size, with a difference of "
            f"{100 * max_error:g} % at most, got one {scale:.3f} times as large by the robot's "
            "motions: measure the print, and give its size; or allow more by max_scale_error",
            max_error,
            scale,
        )


def _covariance(candidate: Candidate) -> Array:
    """Return the covariance of steps of camera and target (12, 12), from the scatter between poses.

    The differences to rival solutions are included, and the error of a lens that was calibrated
    from the same views and not adjusted since. NaN if there are too few poses.
    """
    solution, left_out = candidate.solution, candidate.left_out_solutions
    if left_out is None or candidate.problem.count < MIN_POSES_FOR_ERROR:
        return np.full((12, 12), np.nan)
    cameras, targets = (
        solution.camera.source_steps_to(left_out.camera),
        solution.target.source_steps_to(left_out.target),
    )
    steps = np.concatenate([cameras, targets], axis=1)
    information, left_out_information = solution.information, left_out.information
    if information is None or left_out_information is None:
        # a closed form was solved without groups of poses, not without each pose
        return jackknife(steps[:MAX_FOLDS])
    if len(information) > 12:
        steps = np.concatenate([steps, left_out.change - solution.change], axis=1)
    place_indices = same_place_indices(candidate.problem.robot.poses)
    # poses at the same place are left out together; the sum of steps is correct to first order
    masks = [place_indices == index for index in np.unique(place_indices)]
    steps = np.array([steps[mask].sum(axis=0) for mask in masks])
    left_out_information = np.array(
        [information - (information - left_out_information[mask]).sum(axis=0) for mask in masks]
    )
    left_out_covariances = np.array(
        [inverse_scaled(information_left) for information_left in left_out_information]
    )
    covariance_of_all = inverse_scaled(information)
    scatter = weighted_jackknife(steps, left_out_covariances, covariance_of_all, WEIGHT_POWER)[
        :12, :12
    ]
    for rival in candidate.rivals:
        differences = (
            solution.camera.source_steps_to(rival.camera),
            solution.target.source_steps_to(rival.target),
        )
        scatter += np.outer(step := np.concatenate(differences), step)
    lens, observations = candidate.problem.lens_covariance, candidate.problem.observations
    if (
        lens is None
        or not isinstance(observations, PixelObservations)
        or any(observations.free_parameters)
    ):
        return scatter
    numbers = tuple(range(1, 5 + len(observations.model.distortion)))
    slopes = derivatives_by_parameters(candidate.problem.robot, observations, solution, numbers)
    covariance: Array = scatter + slopes @ lens @ slopes.T
    return covariance


def _size_remarks(problem: Problem, options: _HandEyeOptions) -> Iterator[Remark]:
    """Yield a remark if the target has another size, but the size was not to be adjusted."""
    if options.method not in OPENCV_METHODS and any(
        0 in numbers for numbers in options.parameter_choices.values()
    ):
        return
    indices = np.arange(problem.count)
    scale = estimate_scale(problem.robot, problem.target_poses)
    subsets = [problem.subset(indices[indices != i]) for i in indices if problem.count > MIN_POSES]
    left_out_scales = [estimate_scale(subset.robot, subset.target_poses) for subset in subsets]
    if scale is None or not left_out_scales or None in left_out_scales:
        return
    sigma = math.sqrt(float(jackknife(np.array(left_out_scales, dtype=np.float64)[:, None])[0, 0]))
    if abs(scale - 1.0) > max(REMARKED_SCALE_ERROR, REMARKED_SCALE_SIGMAS * sigma):
        yield Code.SCALE_MISMATCH.remark(
            f"expected a target of the given size, got one {scale:.4f} times as large by the "
            "robot's motions, and the size was not to be adjusted: measure the print; or the "
            "lens' focal length is off by as much"
        )


def _remarks(problem: Problem, result: HandEyeCalibration) -> Iterator[Remark]:
    if abs(result.target_scale - 1.0) > REMARKED_SCALE_ERROR:
        yield Code.SCALE_MISMATCH.remark(
            f"expected a target of the given size, got one {result.target_scale:.4f} times as "
            "large by the robot's motions: measure the print; poses and errors are those of a "
            "target of that size"
        )
    place_count = len(np.unique(same_place_indices(problem.robot.poses)))
    if place_count < MIN_ADVISED_POSES:
        suffix = f" that are different, of {problem.count}" if place_count < problem.count else ""
        yield Code.TOO_FEW.remark(
            f"expected {MIN_ADVISED_POSES} poses or more for an error that can be relied on, got "
            f"{place_count}{suffix}"
        )
    # each turn is without one pose; the largest is taken, so that no single pose decides
    turn = float(left_out_second_axis_turns(problem.robot).max())
    if turn < MIN_ADVISED_TURN_RADIANS:
        yield Code.INSUFFICIENT_ROTATION.remark(
            f"expected the robot to turn by {math.degrees(MIN_ADVISED_TURN_RADIANS):g} deg rms "
            f"about a second axis, got {math.degrees(turn):.1f} deg, whichever pose is left out: "
            "tilt it more to both sides"
        )
    if result.held_out_error is None:
        yield Code.NOT_HELD_OUT.remark("too few poses to leave one out: no held-out error")
    elif result.held_out_error > (max_error := expected_error(problem, POOR_ROBOT)):
        yield Code.POOR_FIT.remark(
            f"expected a held-out error of {1e3 * max_error:.3g} mm at most, as of a robot that is "
            f"{1e3 * POOR_ROBOT.translation:g} mm and {math.degrees(POOR_ROBOT.rotation):g} deg "
            f"off, got {1e3 * result.held_out_error:.3g} mm: did the robot stand still, does the "
            "target or the camera slip, is a pose one of another view?"
        )


def _lens_remarks(given_camera: CameraModel, adjusted_camera: CameraModel | None) -> list[Remark]:
    if adjusted_camera is None or np.array_equal(given_camera.matrix, adjusted_camera.matrix):
        return []
    given_focal, adjusted_focal = given_camera.matrix[0, 0], adjusted_camera.matrix[0, 0]
    return [
        Code.WRONG_LENS.remark(
            f"expected the lens as it was given, got one that fits far better: fx "
            f"{adjusted_focal:.1f} px instead of {given_focal:.1f} px; the calibration's camera is "
            "that one"
        )
    ]
