"""Hand-eye: how near the error is to what noise allows, and the held-out error of recorded robots.

In simulation a camera, on the hand and beside the robot in turn, sees a sheet from 8 to 15 poses of
a robot; the errors are the rms distance of the camera from where it is, and the rms turn, over many
robots. No calibration without a bias can have smaller ones than the Cramer-Rao bound. The others
get the same views.

Then robots of many kinds that err by more than noise, and recorded ones: what is shown is the error
at poses that were left out, over that of the best of OpenCV's closed forms, chosen afterwards. Both
get the same corners and lens, and the sheet as large as it is said to be.

Two robots of ROS-Industrial (``test_set_10x10``: dots, the camera on the hand;
``test_set_charuco``: the camera beside the robot; Apache-2.0) are compared with what was published,
too, with the target as large as it was said, and with whatever the held-out error asks to be
adjusted. The environment variable SMARTCAM_DATA names a folder that recorded data are under; what
is not there is left out.
"""

from __future__ import annotations

import math
import os
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from benchmarks import robots
from benchmarks.measure import Comparison, Goal, Series
from benchmarks.recorded_robots import CHARUCO, DOTS, SETS, RecordedSet, read_set
from benchmarks.robots import KINDS, Kind
from benchmarks.robots_judge import OURS, folds, judged, rms
from smartcam.calibration._hand_eye.calibration import calibrate_hand_eye
from smartcam.calibration._hand_eye.closed_forms import OPENCV_METHODS, solve_closed_form
from smartcam.calibration._hand_eye.equations import RobotPoses, RobotSigmas
from smartcam.calibration._lens.intrinsics import calibrate_intrinsics
from smartcam.calibration._lens.poses import locate
from smartcam.calibration._targets import Checkerboard
from smartcam.calibration._views import TargetView
from smartcam.calibration.simulation._scenes import HandEyeScene, hand_eye_scene
from smartcam.geometry import CameraModel, Transform
from smartcam.geometry._inside import Rigid

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from benchmarks.measure import Plan
    from smartcam.calibration._hand_eye.equations import Setup
    from smartcam.calibration._targets import Target

__all__ = ["FOLDER", "RECORDED", "Recorded", "find", "run"]

FOLDER = os.environ.get("SMARTCAM_DATA")
"""Where recorded robots are; None: nowhere."""

RUNS = 12
"""Robots of one mix in a round."""

KIND_RUNS = 2
"""Robots of one kind in a round."""

MAX_BEHIND = 1.03

SHEET = Checkerboard(columns=9, rows=6, square=0.02)
CAMERA = CameraModel(
    size=(1280, 960), matrix=np.array([[1200.0, 0, 640], [0, 1200, 480], [0, 0, 1]])
)


@dataclass(frozen=True, slots=True)
class Mix:
    """What noise there is, and from how far around a camera looks."""

    pixels: float
    degrees: float
    millimetres: float
    poses: int
    cone: float

    def __str__(self) -> str:
        robot = f"robot {self.degrees:g} deg, {self.millimetres:g} mm" if self.degrees else "exact"
        return f"{self.pixels:g} px, {robot}, {self.poses} poses, {self.cone:g} deg"

    @property
    def sigmas(self) -> RobotSigmas:
        return RobotSigmas(math.radians(self.degrees), 1e-3 * self.millimetres)


MIXES = [
    Mix(0.1, 0.0, 0.0, 15, 30),
    Mix(0.1, 0.02, 0.1, 15, 30),
    Mix(0.3, 0.05, 0.3, 10, 30),
    Mix(0.1, 0.02, 0.1, 15, 8),
    Mix(0.5, 0.02, 0.05, 8, 20),
]


@dataclass(frozen=True, slots=True)
class Recorded:
    """A recorded robot.

    Attributes:
        name: of its folder.
        setup: where the camera was.
        target: what it saw.
        focal: fx, fy, cx, cy as they were published with it, pixels.
        published: mean 3D error, mm.
        mean: goal of the mean 3D error with the nominal target, mm; None: none was set.
    """

    name: str
    setup: Setup
    target: Target
    focal: tuple[float, float, float, float]
    published: float
    mean: float | None


RECORDED = [
    Recorded(
        "test_set_10x10",
        "eye-in-hand",
        DOTS,
        (550.0, 550.0, 320.0, 240.0),
        2.899,
        2.26,
    ),
    Recorded(
        "test_set_charuco",
        "eye-to-hand",
        CHARUCO,
        (1352.02747, 1356.14287, 789.67065, 627.2995),
        0.956,
        None,
    ),
]


def run(plan: Plan) -> Iterator[Comparison]:
    """Measure the simulated robots, then those that were recorded."""
    for mix in MIXES[1:2] if plan.quick else MIXES:
        yield from _simulated(plan, mix)
    for kind in KINDS[1:2] if plan.quick else KINDS:
        yield _kind(plan, kind)
    for one in RECORDED:
        folder = find(one.name)
        if folder is not None:
            yield from _recorded(one, folder)
    for recorded in SETS:
        folder = find(recorded.folder)
        if folder is None:
            _left_out(recorded.folder)
        else:
            yield _left_out_poses(recorded, folder)


def _left_out(name: str) -> None:
    print(f"hand_eye: no {name} under SMARTCAM_DATA ({FOLDER})", file=sys.stderr)


def find(name: str) -> Path | None:
    """Return a file or folder of the recorded data; None where it is not there."""
    return None if FOLDER is None else next(Path(FOLDER).rglob(name), None)


@dataclass(slots=True)
class _Errors:
    """Mean squares of one side, of turns (rad^2) and of shifts (m^2), one a round."""

    squares: list[tuple[float, float]] = field(default_factory=list[tuple[float, float]])

    def turns(self, name: str) -> Series:
        return Series(name, "mrad", [1e3 * math.sqrt(turn) for turn, _ in self.squares])

    def shifts(self, name: str) -> Series:
        return Series(name, "mm", [1e3 * math.sqrt(shift) for _, shift in self.squares])

    @property
    def mean(self) -> float:
        """Of the shifts, m^2."""
        return sum(shift for _, shift in self.squares) / len(self.squares)


def _simulated(plan: Plan, mix: Mix) -> Iterator[Comparison]:
    """Compare with the bound: smartcam, then the best closed form."""
    names = ("smartcam", "bound", "predicted", *OPENCV_METHODS)
    found = {name: _Errors() for name in names}
    runs, seconds = plan.operations(RUNS), []
    for number in range(plan.rounds):
        squares = {name: np.zeros(2) for name in names}
        for index in range(runs):
            random = np.random.default_rng([number, index, mix.poses, round(mix.cone)])
            scene = hand_eye_scene(
                SHEET,
                CAMERA,
                setup="eye-in-hand" if (number + index) % 2 else "eye-to-hand",
                poses=mix.poses,
                tilt=math.radians(mix.cone),
                distance=0.5,
                random=random,
            )
            poses, views = scene.simulate_measurements(
                pixel_sigma=mix.pixels, robot_sigmas=mix.sigmas, random=random
            )
            begin = time.perf_counter()
            ours = calibrate_hand_eye(poses, views, setup=scene.setup, camera=CAMERA)
            seconds.append(time.perf_counter() - begin)
            bound = scene.cramer_rao_bound(pixel_sigma=mix.pixels, robot_sigmas=mix.sigmas)
            errors = {
                "bound": bound,
                "smartcam": scene.errors(ours.camera_pose),
                "predicted": (ours.rotation_error, ours.translation_error),
                **_closed_forms(scene, poses, views),
            }
            for name, pair in errors.items():
                squares[name] += np.square(pair) / runs
        for name, (turn, shift) in squares.items():
            found[name].squares.append((float(turn), float(shift)))
    limit, turned = (
        one("Cramer-Rao bound") for one in (found["bound"].shifts, found["bound"].turns)
    )
    yield Comparison(
        "hand_eye",
        f"{mix}: rms error of the camera's place over the bound",
        found["smartcam"].shifts("smartcam"),
        limit,
        "ratio",
        Goal("at most", 1.2),
        f"{1e3 * float(np.median(seconds)):.0f} ms a calibration; predicted error over the bound "
        f"{math.sqrt(found['predicted'].mean / found['bound'].mean):.2f}",
    )
    best = min(OPENCV_METHODS, key=lambda name: found[name].mean)
    case = f"{mix}: the same of OpenCV's best, {best}"
    yield Comparison("hand_eye", case, found[best].shifts("OpenCV"), limit, "ratio")
    case = f"{mix}: rms error of the camera's orientation over the bound"
    ours_turned = found["smartcam"].turns("smartcam")
    yield Comparison("hand_eye", case, ours_turned, turned, "ratio", Goal("at most", 1.2))
    case = f"{mix}: the same of OpenCV's {best}"
    yield Comparison("hand_eye", case, found[best].turns("OpenCV"), turned, "ratio")


def _closed_forms(
    scene: HandEyeScene, poses: Sequence[Transform], views: Sequence[TargetView]
) -> dict[str, tuple[float, float]]:
    """Return by how much each of OpenCV's methods is off, rad and m; infinite where it fails."""
    robot = RobotPoses(Rigid.stack(one.rigid for one in poses), scene.setup == "eye-in-hand")
    seen = Rigid.stack(locate(view, CAMERA).transform.rigid for view in views)
    result = {}
    for name in OPENCV_METHODS:
        found = solve_closed_form(name, robot, seen, use_all_views=True)
        result[name] = (math.inf, math.inf)
        if found is not None:
            pose = Transform(scene.camera_pose.target, "camera", *found[0])
            result[name] = scene.errors(pose)
    return result


def _recorded(one: Recorded, folder: Path) -> Iterator[Comparison]:
    """Compare with what was published, and with the best closed form."""
    poses, views = read_set(folder, one.target)
    fx, fy, cx, cy = one.focal
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    file = CameraModel(size=views[0].size, matrix=matrix)
    published = Series("published", "mm", [one.published])
    same = calibrate_hand_eye(
        poses, views, setup=one.setup, camera=file, adjust="nothing", method="reprojection"
    )
    yield Comparison(
        "hand_eye",
        f"{one.name}: mean 3D error with the published lens and target, to see that it is theirs",
        Series("reprojection", "mm", [1e3 * same.mean_error]),
        published,
        "ratio",
    )
    for adjust, about in _TARGETS.items():
        nominal = adjust == "nothing"  # the target as it is described, for the lens, too
        lens = calibrate_intrinsics(views, sheet="exact").camera if nominal else None
        ours = calibrate_hand_eye(poses, views, setup=one.setup, camera=lens, adjust=adjust)
        goal = one.mean if nominal else None
        yield Comparison(
            "hand_eye",
            f"{one.name}: mean 3D error, {about}",
            Series(ours.method, "mm", [1e3 * ours.mean_error]),
            published,
            "alone",
            None if goal is None else Goal("at most", goal, "mm"),
            f"{one.published} mm were published; the target is {ours.target_scale:.4f} times as "
            f"large as nominal; {len(views)} views",
        )


_TARGETS: Mapping[Literal["nothing", "auto"], str] = {
    "nothing": "the nominal target",
    "auto": "the adjusted target",
}


def _kind(plan: Plan, kind: Kind) -> Comparison:
    """Compare at poses of simulated robots of a kind that were left out."""
    found: dict[str, list[float]] = {}
    for number in range(plan.rounds):
        runs = plan.operations(KIND_RUNS)
        seeds = range(number * runs, (number + 1) * runs)
        robots_of_round = [_robot(kind, seed) for seed in seeds]
        for name in robots_of_round[0]:
            squares = [one[name] ** 2 for one in robots_of_round]
            found.setdefault(name, []).append(1e3 * math.sqrt(sum(squares) / runs))
    ours = found.pop(OURS)
    best = min(found, key=lambda name: sum(np.square(found[name])))
    return Comparison(
        "hand_eye",
        f"{kind.seen}, simulated, {kind.name}: error of poses left out over the best closed form's",
        Series("smartcam", "mm", ours),
        Series(f"OpenCV {best}", "mm", found[best]),
        "ratio",
        Goal("at most", MAX_BEHIND),
    )


def _robot(kind: Kind, seed: int) -> dict[str, float]:
    """Return the rms error of each side at the poses of a robot that were left out, metres."""
    found = kind.measured("eye-in-hand" if seed % 2 else "eye-to-hand", seed)
    split = (found.used, found.fresh)
    return rms([judged(found.poses, found.views, found.setup, robots.CAMERA, split)])


def _left_out_poses(one: RecordedSet, folder: Path) -> Comparison:
    """Compare at poses of a recorded robot that were left out."""
    poses, seen = one.read(folder)
    views = [view for view in seen if isinstance(view, TargetView)]
    camera = calibrate_intrinsics(views, sheet="exact").camera if views else None
    found = rms([judged(poses, seen, one.setup, camera, split) for split in folds(len(poses))])
    ours = found.pop(OURS)
    best = min(found, key=lambda name: found[name])
    return Comparison(
        "hand_eye",
        f"{one.seen}, {one.name}: error of {len(poses)} poses left out over the best closed form's",
        Series("smartcam", "mm", [1e3 * ours]),
        Series(f"OpenCV {best}", "mm", [1e3 * found[best]]),
        "ratio",
        Goal("at most", MAX_BEHIND),
    )
