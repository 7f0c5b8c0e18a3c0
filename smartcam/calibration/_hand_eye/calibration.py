"""A camera on a robot's hand, or beside the robot and looking at it: where it is.

::

    calibration = calibrate_hand_eye(robot_poses, views, setup="eye-in-hand", camera=camera)
    calibration.held_out_error                 # metres, of poses that were left out
    table = calibration.target_pose            # the sheet's plane, in the robot's frame
    calibration.to_plane([[640, 480]], plane=table, robot_pose=now)

The robot takes the camera to ten poses or more, turned about different axes, from which it sees the
sheet; beside the robot the camera stays, and the robot shows it the sheet.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from smartcam.calibration._codes import Code, Remark
from smartcam.calibration._geometry.frames import Transform
from smartcam.calibration._geometry.rigid import Rigid
from smartcam.calibration._geometry.rotations import as_vector
from smartcam.calibration._hand_eye.closed_forms import check_motion, second_turns
from smartcam.calibration._hand_eye.equations import (
    PixelObservations,
    PoseObservations,
    RobotPoses,
    RobotSigmas,
)
from smartcam.calibration._hand_eye.model_selection import (
    METHODS,
    NOTHING,
    Problem,
    candidates,
)
from smartcam.calibration._hand_eye.result import HandEyeCalibration, as_transform
from smartcam.calibration._hand_eye.sights import locate_all
from smartcam.calibration._hand_eye.validation import (
    check_poses,
    expected_error,
    most_error,
    poor_fit,
    seen_poses,
)
from smartcam.calibration._least_squares import inverse_scaled
from smartcam.calibration._lens.intrinsics import calibrate_intrinsics
from smartcam.calibration._lens.poses import CAMERA, TARGET
from smartcam.calibration._lens.projection import excess, whitening
from smartcam.calibration._lens.suspicions import without_strays
from smartcam.calibration._views import as_list, as_views
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from smartcam.calibration._geometry.rotations import Array
    from smartcam.calibration._hand_eye.equations import Setup
    from smartcam.calibration._hand_eye.model_selection import Candidate
    from smartcam.calibration._lens.model import CameraModel
    from smartcam.calibration._lens.poses import TargetPose
    from smartcam.calibration._views import TargetView
    from smartcam.models import Pose

MOST_POSES = 200
"""Of one calibration, which takes some seconds then."""

ADVISED_POSES = 8
"""Below as many, what is left over tells little of the error."""

ADVISED_TURN = math.radians(8.0)
"""Rms turn of the poses about the second of their axes that is worth its name; that of some of
eight poses differs by two degrees or three."""

SCALE_OFF = 0.005
"""Difference between the target's size and the nominal one that is worth a remark."""

BAD = 4.0
"""A pose whose held-out error is more times the median is bad: of normal errors along two axes one
in 60000 is."""

EXACT = 1e-7
"""Metres: what is less off, rounding alone may explain."""

MOST_BAD = 1 / 3
"""Of the poses that may be left out."""

LEAST_GOOD = 5
"""Poses that must be left where others, which belong to other views, are left out."""

LEAST_KNOWN = 5
"""Poses from which the robot's sigmas are estimated well enough to tell errors from them."""

POOR = RobotSigmas(math.radians(0.25), 2e-3)
"""Of a robot that is worse than most: a held-out error beyond what it gives is worth a remark."""

POSE_SIGMAS = RobotSigmas(1e-3, 1e-3)
"""Of poses of the target that come without a covariance: their ratio counts."""


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
) -> HandEyeCalibration:
    """Calibrate the pose of a camera on a robot, or beside it.

    Args:
        robot_poses: ``T_base_flange`` at each view: the flange's pose in the robot's base.
        views: of one target, as many.
        setup: whether the camera is on the hand (``eye-in-hand``, the target stays), or stands
            beside the robot (``eye-to-hand``, the target is on the hand).
        camera: its lens; None: calibrated from the same views, which should then tilt the target.
            The expected errors take it as exact either way: from the same views it is not, and they
            come out up to three times too small.
        method: ``auto``: what lies between ``robot`` and ``reprojection`` and predicts left-out
            poses best; or one of these, or one of OpenCV's closed forms, see
            :data:`~smartcam.calibration._hand_eye.model_selection.METHODS`.
        adjust: what is adjusted besides the poses: the target's ``scale`` (printers change it),
            the ``camera``, ``nothing``; ``auto``: what the held-out error asks for.
        robot_sigmas: of each axis of the robot's poses; None: estimated, of 5 poses or more: of
            fewer the covariance is NaN.
        drop_bad: whether poses that are far off what the others say of them are left out (and
            named), at most a third of them, and while 8 are left; else they are only named. Of
            poses that are nowhere near, as those of other views, 5 must be left.

    The order of the poses does not matter.

    Raises:
        CalibrationError: ``TOO_FEW``, ``POSES_TOO_SIMILAR``, ``INSUFFICIENT_ROTATION``; ``SHAPE``:
            not as many views as poses, or something else; ``WRONG_SIZE``; ``WRONG_FRAME``: poses of
            several frames, or that fit only when inverted or transposed; ``MIRRORED``: the robot's
            base is left-handed, or pictures are flipped; ``DIFFERENT_TARGETS``; ``POOR_FIT``:
            nothing fits, as where poses and views are mixed up or lengths are in millimetres; and
            what :func:`~smartcam.calibration.calibrate_intrinsics` says.
        MissingExtraError: SciPy or OpenCV is not installed, or OpenCV is 5.0.0.
    """
    views = as_views(views, "hand-eye")
    transforms, order, robot = _robot(robot_poses, len(views), "views", setup)
    if any(one.target != views[0].target for one in views):
        raise CalibrationError(
            "hand-eye: expected views of one target, got views of several",
            code=Code.DIFFERENT_TARGETS,
            expected=views[0].target,
        )
    ordered = [views[i] for i in order]
    lens = camera if camera is not None else calibrate_intrinsics(ordered, sheet="exact").camera
    located = locate_all(ordered, lens)
    ordered, strays = without_strays(ordered, located, lens)
    located = locate_all(ordered, lens) if strays else located
    poses = Rigid.stacked(one.transform.rigid for one in located)
    problem = Problem(
        robot=robot,
        seen=_observations(ordered, located, lens),
        poses=poses,
        given=_given(ordered),
        sigmas=_positive(robot_sigmas),
    )
    named = [one.name or f"pose {i}" for i, one in zip(order, ordered, strict=True)]
    kept = [5 + i for i in np.flatnonzero(lens.distortion).tolist()]
    free = {NOTHING: (), "scale": (0,), "camera": (1, 2, 3, 4, *kept)}
    free["scale and camera"] = (0, *free["camera"])
    asked = _Asked(_allowed(free, adjust), method, drop_bad)
    result = _without_bad(problem, asked, named, [transforms[i] for i in order], ordered)
    remarks = [] if camera is None else _lens_remarks(camera, result.camera)
    return dataclasses.replace(
        _reordered(result, np.argsort(order)),
        warnings=(*result.warnings, *remarks, *strays),
        robot_poses=tuple(transforms),
        views=tuple(views),
        target_poses=tuple(located[i].transform for i in np.argsort(order)),
    )


def calibrate_hand_eye_from_poses(
    robot_poses: Sequence[Transform | Pose],
    target_poses: Sequence[Transform],
    *,
    setup: Setup,
    method: str = "auto",
    adjust: Literal["auto", "nothing", "scale"] = "auto",
    robot_sigmas: RobotSigmas | None = None,
    drop_bad: bool = True,
) -> HandEyeCalibration:
    """Calibrate the pose of a camera on a robot, or beside it, from poses of the target.

    For cameras that say where a target is instead of where its points are in the image. Errors are
    those of the target's origin.

    Args:
        robot_poses: ``T_base_flange``.
        target_poses: ``T_camera_target``, as many.
        setup: as for :func:`calibrate_hand_eye`.
        method: as for :func:`calibrate_hand_eye`; ``reprojection`` weighs a milliradian as a
            millimetre.
        adjust: as for :func:`calibrate_hand_eye`.
        robot_sigmas: as for :func:`calibrate_hand_eye`.
        drop_bad: as for :func:`calibrate_hand_eye`.

    Raises:
        CalibrationError: as :func:`calibrate_hand_eye`.
    """
    target_poses = seen_poses(target_poses)
    transforms, order, robot = _robot(robot_poses, len(target_poses), "poses of the target", setup)
    seen = [target_poses[i] for i in order]
    poses = Rigid.stacked(one.rigid for one in seen)
    scale = np.repeat(1.0 / np.array(POSE_SIGMAS), 3)
    white = np.broadcast_to(np.diag(scale), (len(order), 6, 6))
    problem = Problem(
        robot=robot,
        seen=PoseObservations(white, poses),
        poses=poses,
        sigmas=_positive(robot_sigmas),
    )
    named = [f"pose {i}" for i in order]
    asked = _Asked(_allowed({NOTHING: (), "scale": (0,)}, adjust), method, drop_bad)
    result = _without_bad(problem, asked, named, [transforms[i] for i in order], seen)
    return dataclasses.replace(
        _reordered(result, np.argsort(order)),
        robot_poses=tuple(transforms),
        target_poses=tuple(Transform(CAMERA, TARGET, *one.rigid) for one in target_poses),
    )


def _robot(
    robot_poses: Sequence[Transform | Pose], count: int, what: str, setup: str
) -> tuple[list[Transform], list[int], RobotPoses]:
    """Return the robot's poses, an order that does not depend on how they come, and them so.

    Raises SHAPE, WRONG_FRAME, and what :func:`check_motion` says.
    """
    if not isinstance(setup, str) or setup not in ("eye-in-hand", "eye-to-hand"):
        raise CalibrationError(
            f"hand-eye: expected setup eye-in-hand or eye-to-hand, got {setup!r}",
            code=Code.SHAPE,
            expected=["eye-in-hand", "eye-to-hand"],
            got=setup,
        )
    robot_poses = as_list(robot_poses, object, "pose of the robot")
    if len(robot_poses) != count or count > MOST_POSES:
        raise CalibrationError(
            f"hand-eye: expected as many {what} as poses of the robot, {MOST_POSES} at most, got "
            f"{count} and {len(robot_poses)}",
            code=Code.SHAPE,
            expected=len(robot_poses),
            got=count,
        )
    transforms = [as_transform(pose, "flange").undated() for pose in robot_poses]
    for one in transforms:
        if one.label != transforms[0].label:
            raise CalibrationError(
                f"hand-eye: expected all poses of the robot to be {transforms[0].label}, got "
                f"{one.label}",
                code=Code.WRONG_FRAME,
                expected=transforms[0].label,
                got=one.label,
            )
    rows = np.array([[*one.translation, *one.rotation.ravel()] for one in transforms])
    order = np.lexsort(rows.T[::-1]).tolist() if len(rows) else []
    ordered = Rigid.stacked(transforms[i].rigid for i in order)
    robot = RobotPoses(ordered, setup == "eye-in-hand")
    check_motion(robot)
    return transforms, order, robot


def _positive(sigmas: RobotSigmas | None) -> RobotSigmas | None:
    if sigmas is None:
        return None
    given = as_vector(sigmas, 2, "robot_sigmas")
    if not (given > 0).all():
        raise CalibrationError(
            "robot_sigmas: expected two positive numbers, radians and metres, got "
            f"{tuple(given.tolist())}",
            code=Code.NOT_FINITE,
            expected="two positive numbers",
            got=tuple(given.tolist()),
        )
    return RobotSigmas(*given.tolist())


def _given(views: Sequence[TargetView]) -> Any:
    counts = np.array([len(one.ids) for one in views])
    return np.arange(counts.max())[None] < counts[:, None]


def _observations(
    views: Sequence[TargetView], located: Sequence[TargetPose], camera: CameraModel
) -> PixelObservations:
    """Return the views' points with their noise, as large as the views themselves show it."""
    off = np.concatenate([one.residuals for one in located])
    noise = np.concatenate([one.covariance for one in views])
    more = excess(off, noise, off.size - 6 * len(views))
    given = _given(views)
    points, pixels = np.zeros((*given.shape, 3)), np.zeros((*given.shape, 2))
    white = np.zeros((*given.shape, 2, 2))
    for index, one in enumerate(views):
        points[index], pixels[index] = one.object_points[0], one.points[0]
        mask = given[index]
        points[index, mask], pixels[index, mask] = one.object_points, one.points
        white[index, mask] = whitening(one.covariance, more)
    return PixelObservations(white, camera, points, pixels)


def _allowed(free: Mapping[str, tuple[int, ...]], adjust: str) -> dict[str, tuple[int, ...]]:
    if isinstance(adjust, str) and adjust == "auto":
        return dict(free)
    if not isinstance(adjust, str) or adjust not in free:
        raise CalibrationError(
            f"adjust: expected auto or one of {list(free)}, got {adjust!r}",
            code=Code.SHAPE,
            expected=list(free),
            got=adjust,
        )
    return {adjust: free[adjust]}


class _Asked(NamedTuple):
    """What the user asked for."""

    free: Mapping[str, tuple[int, ...]]  # what may be adjusted, and the numbers of its parameters
    method: str  # which, or ``auto``
    drop_bad: bool  # whether bad poses are left out


def _without_bad(
    problem: Problem,
    asked: _Asked,
    named: Sequence[str],
    robot_poses: Sequence[Transform],
    seen: Sequence[TargetView | Transform],
) -> HandEyeCalibration:
    """Return the calibration by the poses that are not bad, with the errors of all of them."""
    used, remarks = _near(problem, asked, named)
    result = _solved(problem.taken(used), asked, robot_poses[0])
    while len(bad := _bad(result)) and asked.drop_bad:
        worst = int(used[result.worst])
        fewer = used[used != worst]
        most = MOST_BAD * problem.count
        if len(fewer) < ADVISED_POSES or problem.count - len(fewer) > most:
            break
        try:
            check_motion(problem.robot.taken(fewer))
        except CalibrationError:  # nothing is left without it
            break
        remarks[worst] = _bad_view(result, result.worst, named[worst], "was not used")
        used, result = fewer, _solved(problem.taken(fewer), asked, robot_poses[0])
    for index in bad:
        number = int(used[index])
        kept = _bad_view(result, index, named[number], "is used all the same")
        remarks.setdefault(number, kept)
    errors, left_out = np.full((2, problem.count), np.nan)
    for number in np.setdiff1d(np.arange(problem.count), used).tolist():
        (off,) = result.point_errors([robot_poses[number]], [seen[number]])
        if np.isfinite(off).all():
            errors[number] = left_out[number] = math.sqrt(float((off**2).mean()))
    errors[used], left_out[used] = result.errors, result.leave_one_out
    some = problem.taken(used)
    _check_fit(some, result)
    return dataclasses.replace(
        result,
        errors=errors,
        leave_one_out=left_out,
        used=tuple(np.isin(np.arange(problem.count), used).tolist()),
        warnings=(*_remarks(some, result), *remarks.values()),
    )


def _near(
    problem: Problem, asked: _Asked, named: Sequence[str]
) -> tuple[NDArray[np.intp], dict[int, Remark]]:
    """Return the poses to begin with, and remarks on those, by number, that belong to other views.

    Raises ``WRONG_FRAME`` or ``POOR_FIT``.
    """
    agreed, everything = check_poses(problem), np.arange(problem.count)
    gross = agreed.gross(most_error(problem))
    left = problem.count - len(gross)
    drop = asked.drop_bad and left >= LEAST_GOOD and len(gross) <= MOST_BAD * problem.count
    used = np.setdiff1d(everything, gross) if drop else everything
    try:
        check_motion(problem.robot.taken(used))
    except CalibrationError:  # nothing is left without them
        drop, used = False, everything
    done = "was not used" if drop else "is used all the same"
    return used, {
        index: Remark(
            Code.BAD_VIEW,
            f"{named[index]} is {1e3 * agreed.off[index]:.3g} mm off what most poses agree with to "
            f"{1e3 * agreed.median:.3g} mm: it belongs to another view; it {done}",
        )
        for index in gross.tolist()
    }


def _bad(result: HandEyeCalibration) -> list[int]:
    """Return the poses that the others do not predict."""
    if result.held_out_error is None:
        return []
    errors = result.leave_one_out
    bad: list[int] = np.flatnonzero(errors > BAD * max(float(np.median(errors)), EXACT)).tolist()
    return bad


def _bad_view(result: HandEyeCalibration, index: int, name: str, done: str) -> Remark:
    errors = 1e3 * result.leave_one_out
    return Remark(
        Code.BAD_VIEW,
        f"{name} is {errors[index]:.3g} mm off what the others say of it, half of them are "
        f"{np.median(errors):.3g} mm or less: its pose of the robot or its image is wrong; it "
        f"{done}",
    )


def _solved(problem: Problem, asked: _Asked, pose: Transform) -> HandEyeCalibration:
    free, method = asked.free, asked.method
    if not isinstance(method, str) or method not in ("auto", *METHODS):
        raise CalibrationError(
            f"method: expected auto or one of {list(METHODS)}, got {method!r}",
            code=Code.SHAPE,
            expected=list(METHODS),
            got=method,
        )
    chosen, found = candidates(problem, free, method)
    if chosen is None:
        raise poor_fit(f"none at all {problem.count} poses", None)
    return _result(problem, chosen, found, pose)


def _check_fit(problem: Problem, result: HandEyeCalibration) -> None:
    """Raise (``POOR_FIT``) where poses and views do not belong together."""
    errors = result.errors if result.held_out_error is None else result.leave_one_out
    off, most = float(np.median(errors)), most_error(problem)
    if off > most:
        raise poor_fit(f"one {1e3 * off:.3g} mm off, {1e3 * most:.3g} mm at most expected", off)


def _result(
    problem: Problem,
    chosen: Candidate,
    found: Sequence[Candidate],
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
            one.name: one.held_out if math.isfinite(one.held_out) else None for one in found
        },
        errors=np.array([math.sqrt(float((one**2).mean())) for one in errors]),
        mean_error=float(np.concatenate(errors).mean()),
        leave_one_out=held_out,
        held_out_error=chosen.held_out if math.isfinite(chosen.held_out) else None,
        covariance=_covariance(problem, chosen),
        robot_sigmas=None if solution.noise is None else solution.noise.robot,
        robot_poses=(),
        used=(True,) * problem.count,
    )


def _covariance(problem: Problem, chosen: Candidate) -> Array:
    """Return that of the steps of camera and target (12, 12).

    Where the noise of the robot was part of the solution, it says; where that was estimated, the
    estimate's own chance makes it larger as it makes Student's t wider than a normal distribution.
    Otherwise the solutions without some of the poses say, by the jackknife. NaN where the poses are
    too few to estimate any noise.
    """
    wider, solution, others = 1.0, chosen.solution, chosen.others
    if problem.sigmas is None:
        if problem.count < LEAST_KNOWN:
            return np.full((12, 12), np.nan)
        # the variance of Student's t with n degrees of freedom is n / (n - 2)
        freedom = 3 * problem.count - 6  # half of the equations each tell one of the two sigmas
        wider = freedom / (freedom - 2)
    if solution.information is not None and solution.noise is not None:
        joint: Array = wider * inverse_scaled(solution.information)[:12, :12]
        return joint
    if others is None:
        return np.full((12, 12), np.nan)
    cameras, targets = solution.camera.before(others.camera), solution.target.before(others.target)
    steps = np.concatenate([cameras, targets], axis=1)
    # (n - 1) / n sum (x_i - mean) (x_i - mean)^T of the n solutions that leave one out.
    # Source: Efron and Tibshirani, An Introduction to the Bootstrap (1993), chapter 11.
    off = steps - steps.mean(axis=0)
    folds: Array = (len(off) - 1) / len(off) * off.T @ off
    return folds


def _remarks(problem: Problem, result: HandEyeCalibration) -> Iterator[Remark]:
    if abs(result.target_scale - 1.0) > SCALE_OFF:
        yield Remark(
            Code.SCALE_MISMATCH,
            f"expected the target as large as it was said, got {result.target_scale:.4f} times "
            "that by the robot's motions: measure the print; poses and errors are those of a "
            "target of that size",
        )
    if problem.count < ADVISED_POSES:
        yield Remark(
            Code.TOO_FEW,
            f"expected {ADVISED_POSES} poses or more for an error that can be relied on, got "
            f"{problem.count}",
        )
    # a remark that one pose more or less brings or takes away helps nobody
    turn = float(second_turns(problem.robot).max())
    if turn < ADVISED_TURN:
        yield Remark(
            Code.INSUFFICIENT_ROTATION,
            f"expected the robot to turn by {math.degrees(ADVISED_TURN):g} deg rms about a second "
            f"axis, got {math.degrees(turn):.1f} deg, whichever pose is left out: tilt it more to "
            "both sides",
        )
    if result.held_out_error is None:
        yield Remark(Code.NOT_HELD_OUT, "too few poses to leave one out: no held-out error")
    elif result.held_out_error > (most := expected_error(problem, POOR)):
        yield Remark(
            Code.POOR_FIT,
            f"expected a held-out error of {1e3 * most:.3g} mm at most, as of a robot that is "
            f"{1e3 * POOR.translation:g} mm and {math.degrees(POOR.rotation):g} deg off, got "
            f"{1e3 * result.held_out_error:.3g} mm: did the robot stand still, does the target or "
            "the camera slip, is a pose one of another view?",
        )


def _lens_remarks(given: CameraModel, adjusted: CameraModel | None) -> list[Remark]:
    if adjusted is None or np.array_equal(given.matrix, adjusted.matrix):
        return []
    before, after = given.matrix[0, 0], adjusted.matrix[0, 0]
    return [
        Remark(
            Code.POOR_FIT,
            f"expected the lens as it was given, got one that fits far better: fx {after:.1f} px "
            f"instead of {before:.1f} px; the calibration's camera is that one",
        )
    ]


def _reordered(result: HandEyeCalibration, back: Any) -> HandEyeCalibration:
    return dataclasses.replace(
        result,
        errors=result.errors[back],
        leave_one_out=result.leave_one_out[back],
        used=tuple(result.used[i] for i in back),
    )
