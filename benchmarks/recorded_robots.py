"""Recorded robots, as their owners publish them: poses of the flange, views or poses of a sheet.

Each is a folder somewhere under the one that SMARTCAM_DATA names. A set is *chosen-by* where
something in smartcam was chosen by looking at it, else *unseen*.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from smartcam.calibration._detection.find import find_target
from smartcam.calibration._targets import Charuco, Checkerboard, CircleGrid
from smartcam.calibration._views import TargetView
from smartcam.exceptions import CalibrationError
from smartcam.geometry import Transform

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from smartcam.calibration._hand_eye.equations import Setup
    from smartcam.calibration._targets import Target

    Matrix = np.ndarray[Any, np.dtype[np.float64]]
    Pairs = tuple[list[Transform], list[TargetView] | list[Transform]]

__all__ = ["CHARUCO", "DOTS", "SETS", "RecordedSet", "read_poses", "read_set"]

_QUATERNION = ("qx", "qy", "qz", "qw")

DOTS = CircleGrid(columns=10, rows=10, spacing=0.0254, diameter=0.0127, origin_diameter=0.0203)
CHARUCO = Charuco(columns=5, rows=7, square=0.036195, marker=0.018256, dictionary="DICT_6X6_250")


@dataclass(frozen=True, slots=True)
class RecordedSet:
    """A recorded robot.

    Attributes:
        name: how the table calls it.
        seen: whether something was chosen by looking at it.
        folder: what is looked for under SMARTCAM_DATA: a path's end.
        setup: where the camera was.
        read: gives the poses of the flange, and as many views or poses of the target.
    """

    name: str
    seen: Literal["chosen-by", "unseen"]
    folder: str
    setup: Setup
    read: Callable[[Path], Pairs]


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
        view = _found(folder / entry["image"], target)
        if view is None or len(view.ids) < least:
            continue
        said = yaml.safe_load((folder / entry["pose"]).read_text())
        place, turn = ([said[key] for key in keys] for keys in (("x", "y", "z"), _QUATERNION))
        poses.append(Transform.from_quaternion("base", "flange", place, turn))
        views.append(view)
    return poses, views


def read_poses(path: Path) -> tuple[list[Transform], list[Transform]]:
    """Return poses of the flange and of the target of MoveIt's samples."""
    poses: list[list[Transform]] = [[], []]
    for pair in json.loads(path.read_text()):
        for found, matrix, frames in zip(
            poses, pair, (("base", "flange"), ("camera", "target")), strict=True
        ):
            found.append(_motion(np.array(matrix), *frames))
    return poses[0], poses[1]


def _found(path: Path, target: Target) -> TargetView | None:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        return None
    try:
        return find_target(image, target, name=path.name)
    except CalibrationError as exc:
        print(f"{path.parent.name}: {exc}", file=sys.stderr)
        return None


def _motion(matrix: Matrix, target: str = "base", source: str = "flange") -> Transform:
    left, _, right = np.linalg.svd(matrix[:3, :3])  # printed with few digits
    return Transform(target, source, left @ right, matrix[:3, 3].astype(np.float64))


def _turned(turn: Any, shift: Any, target: str = "base", source: str = "flange") -> Transform:
    return Transform(target, source, turn.as_matrix(), np.asarray(shift, dtype=np.float64))


def _paired(pairs: Iterable[tuple[Transform, TargetView | None]]) -> Pairs:
    both = [(pose, view) for pose, view in pairs if view is not None]
    return [pose for pose, _ in both], [view for _, view in both]


def _dots(
    points: Matrix, columns: int, rows: int, spacing: float, size: tuple[int, int], name: str
) -> TargetView:
    """Return a view of an asymmetric grid by centres in OpenCV's order, which begins anywhere."""
    grid = CircleGrid(
        columns=columns, rows=rows, spacing=spacing, diameter=0.4 * spacing, asymmetric=True
    )
    centres = points.reshape(rows, columns, 2)
    across, along = centres[0, -1] - centres[0, 0], centres[-1, 0] - centres[0, 0]
    if across[0] * along[1] - across[1] * along[0] > 0:  # v counts down, the target's y up
        centres = centres[::-1]
    count = rows * columns
    return TargetView(
        target=grid,
        size=size,
        ids=np.arange(count),
        points=centres.reshape(count, 2).astype(np.float64),
        covariance=np.broadcast_to(0.01 * np.eye(2), (count, 2, 2)).copy(),
        name=name,
    )


def _vathos(folder: Path) -> Pairs:
    """Matrices column by column after an image's name."""
    target = Checkerboard(columns=10, rows=7, square=0.025)

    def pairs() -> Iterator[tuple[Transform, TargetView | None]]:
        for line in (folder / "resources/poses.csv").read_text().splitlines():
            name, *numbers = line.split(",")
            pose = np.array(numbers[:16], dtype=np.float64).reshape(4, 4).T
            yield _motion(pose), _found(folder / name, target)

    return _paired(pairs())


def _open3dv(spacing: float) -> Callable[[Path], Pairs]:
    """White dots on black; roll, pitch, yaw in degrees, then millimetres, one a line."""

    def pairs(folder: Path) -> Iterator[tuple[Transform, TargetView | None]]:
        for path in sorted(folder.glob("pos*.txt")):
            numbers = np.array(path.read_text().split(), dtype=np.float64)
            turn = Rotation.from_euler("xyz", numbers[:3], degrees=True)
            image = cv2.imread(str(path.with_suffix(".bmp")), cv2.IMREAD_GRAYSCALE)
            if image is None:
                continue
            found, points = cv2.findCirclesGrid(
                255 - image, (7, 11), flags=cv2.CALIB_CB_ASYMMETRIC_GRID
            )
            size = (image.shape[1], image.shape[0])
            centres = np.array(points, dtype=np.float64)
            view = _dots(centres, 7, 11, spacing, size, path.stem) if found else None
            yield _turned(turn, numbers[3:] / 1e3), view

    return lambda folder: _paired(pairs(folder))


# angle between the z axes (deg), distance along x (mm), along z, and offset (deg) of each joint
_RM65 = (
    (0, 0, 240.5, 0),
    (90, 0, 0, 90),
    (0, 256, 0, 90),
    (90, 0, 210, 0),
    (-90, 0, 0, 0),
    (90, 0, 161.2, 0),
)


def _rm65(folder: Path) -> Pairs:
    """Joint angles, one robot pose a line; images are numbered from 1."""
    target = Checkerboard(columns=6, rows=4, square=0.05)

    def pairs() -> Iterator[tuple[Transform, TargetView | None]]:
        lines = (folder / "hand_angle.txt").read_text().split("\n")
        for number, line in enumerate(filter(str.strip, lines), start=1):
            pose = np.eye(4)
            for (twist, out, up, offset), joint in zip(_RM65, line.split(","), strict=True):
                pose = pose @ _link(twist, out, up, float(joint) + np.deg2rad(offset))
            yield _motion(pose), _found(folder / f"images/{number}.png", target)

    return _paired(pairs())


def _link(twist: float, out: float, up: float, angle: float) -> Matrix:
    """Return one joint's matrix by Craig's (modified) parameters."""
    found = np.eye(4)
    found[:3, :3] = (
        Rotation.from_euler("x", twist, degrees=True) * Rotation.from_euler("z", angle)
    ).as_matrix()
    turn = np.deg2rad(twist)
    found[:3, 3] = np.array([out, -np.sin(turn) * up, np.cos(turn) * up]) / 1e3
    return found


def _humanoid(folder: Path) -> Pairs:
    """Centres of an asymmetric grid beside each pose."""
    poses, views = [], []
    for path in sorted(folder.glob("calib_records/*.json")):
        record = json.loads(path.read_text())
        points = np.array(record["board_detection"]["imgpts2d"] or np.zeros((0, 2)))
        if len(points) != 20:
            continue
        poses.append(_motion(np.array(record["gripper_pose_base"]["H"])))
        views.append(_dots(points, 4, 5, 0.04, (1280, 720), path.stem))
    return poses, views


def _franka(folder: Path) -> Pairs:
    poses, seen = [], []
    for path in sorted(folder.glob("*/data.json")):
        record = json.loads(path.read_text())
        if not record.get("charuco_detected"):
            continue
        poses.append(_motion(np.array(record["O_T_EE"]).reshape(4, 4)))
        turn = Rotation.from_rotvec(np.ravel(record["T_cam_target_rvec"]))
        seen.append(_turned(turn, np.ravel(record["T_cam_target_tvec"]), "camera", "target"))
    return poses, seen


def _aubo(path: Path) -> Pairs:
    """Lines of ``hand`` and ``eye`` in turn: place, roll, pitch, yaw in degrees."""
    found: dict[str, list[Transform]] = {"hand": [], "eye": []}
    frames = {"hand": ("base", "flange"), "eye": ("camera", "target")}
    for line in path.read_text().splitlines():
        name, *numbers = line.split(",")
        if len(numbers) == 6:
            values = np.array(numbers, dtype=np.float64)
            turn = Rotation.from_euler("xyz", values[3:], degrees=True)
            found[name.strip()].append(_turned(turn, values[:3], *frames[name.strip()]))
    count = len(found["eye"])
    return found["hand"][:count], found["eye"]


SETS = (
    RecordedSet(
        "ROS-Industrial, dots",
        "chosen-by",
        "test_set_10x10",
        "eye-in-hand",
        lambda folder: read_set(folder, DOTS),
    ),
    RecordedSet(
        "ROS-Industrial, ChArUco",
        "chosen-by",
        "test_set_charuco",
        "eye-to-hand",
        lambda folder: read_set(folder, CHARUCO),
    ),
    RecordedSet("MoveIt, poses", "chosen-by", "pose_samples.json", "eye-to-hand", read_poses),
    RecordedSet(
        "vathos", "chosen-by", "hand-eye.calibation.demos.vathos.net", "eye-in-hand", _vathos
    ),
    RecordedSet("RM65, 1920x1080", "chosen-by", "calib_data1920x1080", "eye-to-hand", _rm65),
    RecordedSet("humanoid, first", "chosen-by", "0911_1024", "eye-to-hand", _humanoid),
    RecordedSet("humanoid, cup", "chosen-by", "move_to_cup_demo", "eye-to-hand", _humanoid),
    RecordedSet("Aubo i5, poses", "chosen-by", "base_aubo_i5_data.csv", "eye-in-hand", _aubo),
    RecordedSet("Open3DV, hand", "unseen", "input_EyeInHand", "eye-in-hand", _open3dv(0.02)),
    RecordedSet("Open3DV, beside", "unseen", "input_EyeToHand", "eye-to-hand", _open3dv(0.04)),
    RecordedSet("RM65, 640x480", "unseen", "calib_data640x480", "eye-to-hand", _rm65),
    RecordedSet("humanoid, second", "unseen", "0911_1412", "eye-to-hand", _humanoid),
    RecordedSet("humanoid, third", "unseen", "0911_1428", "eye-to-hand", _humanoid),
    RecordedSet("Franka, poses", "unseen", "captured-data", "eye-in-hand", _franka),
    RecordedSet(
        "Aubo i10, poses",
        "unseen",
        "base_hand_on_eye_test_data_aubo_i10_test_data.csv",
        "eye-in-hand",
        _aubo,
    ),
)
"""All of them; the first half was looked at while methods were chosen."""
