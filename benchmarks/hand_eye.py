"""Hand-eye: how near the error is to what noise allows, and the held-out error of recorded robots.

In simulation a camera, on the hand and beside the robot in turn, sees a sheet from 8 to 15 poses of
a robot; the errors are the rms distance of the camera from where it is, and the rms turn, over many
robots. No calibration without a bias can have smaller ones than the Cramer-Rao bound. The others
get the same views.

Recorded are two robots of ROS-Industrial (``test_set_10x10``: dots, the camera on the hand;
``test_set_charuco``: the camera beside the robot; Apache-2.0) and one of MoveIt
(``pose_samples.json``, BSD-3). The environment variable SMARTCAM_DATA names a folder that they are
under; what is not there is left out. Both are shown with the target as large as it was said, and
with whatever the held-out error asks to be adjusted.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
import yaml

from benchmarks.measure import Comparison, Goal, Series
from smartcam.calibration._detection.find import find_target
from smartcam.calibration._geometry.frames import Transform
from smartcam.calibration._geometry.rigid import Rigid
from smartcam.calibration._hand_eye.calibration import (
    calibrate_hand_eye,
    calibrate_hand_eye_from_poses,
)
from smartcam.calibration._hand_eye.closed_forms import LINEAR, solve_linear
from smartcam.calibration._hand_eye.equations import RobotPoses, RobotSigmas
from smartcam.calibration._lens.model import CameraModel
from smartcam.calibration._lens.poses import locate
from smartcam.calibration._targets import Charuco, Checkerboard, CircleGrid
from smartcam.calibration.simulation._scenes import HandEyeScene, hand_eye_scene
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from benchmarks.measure import Plan
    from smartcam.calibration._hand_eye.equations import Setup
    from smartcam.calibration._targets import Target
    from smartcam.calibration._views import TargetView

__all__ = ["FOLDER", "RECORDED", "Recorded", "find", "read_poses", "read_set", "run"]

FOLDER = os.environ.get("SMARTCAM_DATA")
"""Where recorded robots are; None: nowhere."""

RUNS = 12
"""Robots of one mix in a round."""

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
        ratio: goal of the held-out error over that of the best closed form.
    """

    name: str
    setup: Setup
    target: Target
    focal: tuple[float, float, float, float]
    published: float
    mean: float | None
    ratio: float


RECORDED = [
    Recorded(
        "test_set_10x10",
        "eye-in-hand",
        CircleGrid(columns=10, rows=10, spacing=0.0254, diameter=0.0127, origin_diameter=0.0203),
        (550.0, 550.0, 320.0, 240.0),
        2.899,
        2.26,
        0.41,
    ),
    Recorded(
        "test_set_charuco",
        "eye-to-hand",
        Charuco(columns=5, rows=7, square=0.036195, marker=0.018256, dictionary="DICT_6X6_250"),
        (1352.02747, 1356.14287, 789.67065, 627.2995),
        0.956,
        None,
        0.61,
    ),
]


def run(plan: Plan) -> Iterator[Comparison]:
    """Measure the simulated robots, then those that were recorded."""
    for mix in MIXES[1:2] if plan.quick else MIXES:
        yield from _simulated(plan, mix)
    for one in RECORDED:
        folder = find(one.name)
        if folder is None:
            _left_out(one.name)
        else:
            yield from _recorded(one, folder)
    poses = find("pose_samples.json")
    if poses is None:
        _left_out("pose_samples.json")
    else:
        yield _poses_only(poses)


def _left_out(name: str) -> None:
    print(f"hand_eye: no {name} under SMARTCAM_DATA ({FOLDER})", file=sys.stderr)


def find(name: str) -> Path | None:
    """Return a file or folder of the recorded data; None where it is not there."""
    return None if FOLDER is None else next(Path(FOLDER).rglob(name), None)


def read_set(
    folder: Path, target: Target, least: int = 6
) -> tuple[list[Transform], list[TargetView]]:
    """Return poses and views of one of ROS-Industrial's sets.

    Args:
        folder: with ``cal_data.yaml``.
        target: what is to be found.
        least: points that a view must have; images without it are left out.
    """
    poses, views = [], []
    for entry in yaml.safe_load((folder / "cal_data.yaml").read_text())["data"]:
        image = cv2.imread(str(folder / entry["image"]), cv2.IMREAD_GRAYSCALE)
        try:
            view = find_target(image, target, name=entry["image"])
        except CalibrationError as exc:
            print(f"{folder.name}: {exc}", file=sys.stderr)
            continue
        if len(view.ids) < least:
            continue
        said = yaml.safe_load((folder / entry["pose"]).read_text())
        place, turn = ([said[key] for key in keys] for keys in (("x", "y", "z"), _QUATERNION))
        poses.append(Transform.from_quaternion("base", "flange", place, turn))
        views.append(view)
    return poses, views


_QUATERNION = ("qx", "qy", "qz", "qw")


def read_poses(path: Path) -> tuple[list[Transform], list[Transform]]:
    """Return poses of the flange and of the target of MoveIt's samples."""
    poses: list[list[Transform]] = [[], []]
    for pair in json.loads(path.read_text()):
        for found, matrix, frames in zip(
            poses, pair, (("base", "flange"), ("camera", "target")), strict=True
        ):
            given = np.array(matrix)
            left, _, right = np.linalg.svd(given[:3, :3])  # printed with few digits
            found.append(Transform(*frames, left @ right, given[:3, 3]))
    return poses[0], poses[1]


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
    names = ("smartcam", "bound", "predicted", *LINEAR)
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
            poses, views = scene.measured(
                pixel_sigma=mix.pixels, robot_sigmas=mix.sigmas, random=random
            )
            begin = time.perf_counter()
            ours = calibrate_hand_eye(poses, views, setup=scene.setup, camera=CAMERA)
            seconds.append(time.perf_counter() - begin)
            bound = scene.bound(pixel_sigma=mix.pixels, robot_sigmas=mix.sigmas)
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
    best = min(LINEAR, key=lambda name: found[name].mean)
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
    robot = RobotPoses(Rigid.stacked(one.rigid for one in poses), scene.setup == "eye-in-hand")
    seen = Rigid.stacked(locate(view, CAMERA).transform.rigid for view in views)
    result = {}
    for name in LINEAR:
        found = solve_linear(name, robot, seen)
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
        ours = calibrate_hand_eye(poses, views, setup=one.setup, adjust=adjust)
        goal = one.mean if adjust == "nothing" else None
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
        closed = {name: ours.candidates[name] for name in LINEAR}
        best, least = min(
            ((name, value) for name, value in closed.items() if value is not None),
            key=lambda pair: pair[1],
        )
        yield Comparison(
            "hand_eye",
            f"{one.name}: held-out error over the best closed form's, {about}",
            Series(ours.method, "mm", [1e3 * (ours.held_out_error or math.nan)]),
            Series(f"OpenCV {best}", "mm", [1e3 * least]),
            "ratio",
            Goal("at most", one.ratio) if adjust == "auto" else None,
        )


_TARGETS: Mapping[Literal["nothing", "auto"], str] = {
    "nothing": "the nominal target",
    "auto": "the adjusted target",
}


def _poses_only(path: Path) -> Comparison:
    poses, seen = read_poses(path)
    ours = calibrate_hand_eye_from_poses(poses, seen, setup="eye-to-hand")
    least = min(value for name in LINEAR if (value := ours.candidates[name]) is not None)
    return Comparison(
        "hand_eye",
        f"{path.stem}: held-out error of {len(poses)} poses over the best closed form's",
        Series(ours.method, "mm", [1e3 * (ours.held_out_error or math.nan)]),
        Series("OpenCV", "mm", [1e3 * least]),
        "ratio",
    )
