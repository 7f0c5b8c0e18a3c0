"""Recorded sets, whole and in random parts: none is refused, none is taken for flipped pictures.

The sets are those that are always there: OpenCV's pairs (all of Debian's package opencv-doc where
it is installed, else the odd-numbered ones) and MoveIt's robot. With ``-rP`` pytest prints how far
random halves lie apart, in the standard deviations that they predict.
"""

from __future__ import annotations

import functools
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from benchmarks.recorded_robots import read_poses
from smartcam.calibration import (
    calibrate_hand_eye_from_poses,
    calibrate_intrinsics,
    calibrate_stereo,
    compare_lenses,
    find_target,
)
from smartcam.geometry._inside import Code
from tests.calibration.scenes import PAIRS_BOARD

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from smartcam.calibration import HandEyeCalibration, TargetView
    from smartcam.geometry._inside import Remark

DATA = Path(__file__).parents[1] / "data"
DEBIAN = Path("/usr/share/doc/opencv-doc/examples/data")
PARTS = 5
"""Random parts of each set."""

LEAST = 5
"""Views of a part at least."""

HALVES = 4
"""Random divisions of a set into two halves."""

MAX_Z = 2.0
"""Largest z between halves in the median: one of three views hardly knows its own error."""

pytestmark = pytest.mark.long


@functools.cache
def views(side: str) -> list[TargetView]:
    there = (DEBIAN / "left02.jpg").is_file()
    folder = DEBIAN if there else zipfile.Path(DATA / "opencv_pairs" / "pairs.zip")
    found = []
    for number in (one for one in range(1, 15) if (folder / f"{side}{one:02d}.jpg").is_file()):
        name = f"{side}{number:02d}"
        encoded = np.frombuffer((folder / f"{name}.jpg").read_bytes(), dtype=np.uint8)
        image = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)
        found.append(find_target(np.asarray(image, dtype=np.uint8), PAIRS_BOARD, name=name))
    return found


def parts(count: int, least: int = LEAST) -> Iterator[list[int]]:
    """Yield the whole of a set, then random parts of it, in the order of the set."""
    yield list(range(count))
    random = np.random.default_rng(count)
    for _ in range(PARTS):
        size = int(random.integers(least, count))
        yield sorted(random.permutation(count)[:size].tolist())


def halves(count: int) -> Iterator[tuple[list[int], list[int]]]:
    random = np.random.default_rng(count)
    for _ in range(HALVES):
        order = random.permutation(count).tolist()
        yield sorted(order[: count // 2]), sorted(order[count // 2 :])


def check(warnings: Iterable[Remark]) -> None:
    """See that nothing is taken for flipped, no lens for another one, no pair for moved."""
    suspicions = {Code.MIRRORED, Code.WRONG_LENS, Code.NOT_SIMULTANEOUS}
    assert suspicions.isdisjoint(one.code for one in warnings)


def check_z(name: str, found: list[float]) -> None:
    middle = float(np.median(found))
    text = f"{name}: z between random halves {middle:.2f} ({', '.join(f'{z:.2f}' for z in found)})"
    print(text)  # noqa: T201 - pytest shows it with -rP
    assert middle < MAX_Z


@pytest.mark.parametrize("side", ["left", "right"])
def test_lens_of_any_part_of_a_recorded_set_is_calibrated(side: str) -> None:
    for part in parts(len(views(side))):
        check(calibrate_intrinsics([views(side)[i] for i in part]).warnings)


def test_pair_of_any_part_of_a_recorded_set_is_calibrated() -> None:
    for part in parts(len(views("left"))):
        left, right = ([views(side)[i] for i in part] for side in ("left", "right"))
        check(calibrate_stereo(left, right).warnings)


@functools.cache
def robot_of(part: tuple[int, ...]) -> HandEyeCalibration:
    poses, seen = read_poses(DATA / "moveit_calibration" / "pose_samples.json")
    some = [poses[i] for i in part], [seen[i] for i in part]
    return calibrate_hand_eye_from_poses(*some, setup="eye-to-hand")


def test_robot_of_any_part_of_a_recorded_set_is_calibrated() -> None:
    for part in parts(50, least=12):
        check(robot_of(tuple(part)).warnings)


@pytest.mark.parametrize("side", ["left", "right"])
def test_lenses_of_random_halves_differ_as_they_predict(side: str) -> None:
    found = []
    for both in halves(len(views(side))):
        pair = [calibrate_intrinsics([views(side)[i] for i in half]) for half in both]
        ratio = compare_lenses(*pair).ratio
        assert ratio is not None
        found.append(ratio)
    check_z(f"lens of OpenCV's {side} pictures", found)


def test_robots_of_random_halves_differ_as_they_predict() -> None:
    found = []
    for both in halves(50):
        a, b = (robot_of(tuple(half)) for half in both)
        step = a.camera_pose.rigid.source_steps_to(b.camera_pose.rigid).ravel()
        spread = a.covariance[:6, :6] + b.covariance[:6, :6]
        found.append(float(np.sqrt(step @ np.linalg.solve(spread, step) / 6)))
    check_z("camera of MoveIt's robot", found)
