"""A front end in rclpy drives calibrations of a camera's node through rclpy to their end."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smartcam.calibration import HandEyeCalibration, PlaneCalibration
from smartcam.calibration._inside import ROBOTS
from smartcam.calibration.formats import pose_to
from smartcam.fleet._inside import RosSection

pytestmark = pytest.mark.long

FRONT = Path(__file__).with_name("native_front.py")
PATIENCE = 400.0
"""Seconds for both calibrations."""

DOMAIN = 101 + os.getpid() % 100
"""Number of a domain of DDS that no other process of tests has at the same time, as a rule."""

PLANT = """\
listen: tcp/127.0.0.1:0
ros2: {through: rclpy}
calibrations: calibrations
cameras:
  line1/cam3: {emulated: {}, application: 7, interpret_as: localizations}
"""


def cell(file: Path) -> None:
    """Write what the robot does and what the camera on its hand sees."""
    from tests.calibration.scenes import SHEET
    from tests.calibration.wizards.test_hand_eye import TRUTH, picture

    poses = TRUTH.robot_poses
    np.savez(
        file,
        images=np.stack([np.asarray(picture(one), np.uint8) for one in range(len(poses))]),
        places=np.stack([one.translation for one in poses]),
        turns=np.stack([one.quaternion for one in poses]),
        typed=np.array([pose_to("ur", one) for one in poses]),
        robot="ur",
        square=SHEET.square,
        size=np.array([SHEET.columns, SHEET.rows], float),
        mark="yes" if SHEET.origin_mark else "no",
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the fleet file."""
    return tmp_path_factory.mktemp("front")


@pytest.fixture(scope="module")
def found(folder: Path) -> dict[str, Any]:
    """Messages that the front end saw."""
    for name in ("rclpy", "smartcam_msgs", "cv2"):
        if importlib.util.find_spec(name) is None:
            pytest.skip(f"needs {name}, which the step ros_native of .ci/run installs")
    if "through" not in RosSection.model_fields:
        pytest.skip("needs nodes that speak through rclpy")
    cell(folder / "cell.npz")
    (folder / "plant.yaml").write_text(PLANT)
    local = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    environment = {**os.environ, **local, "PYTHONPATH": os.pathsep.join(sys.path)}
    serve = [sys.executable, "-m", "smartcam", "ros2", "plant.yaml"]
    with (
        (folder / "log").open("w") as log,
        subprocess.Popen(  # noqa: S603 - ours
            serve, cwd=folder, env=environment, stdout=log, stderr=log
        ) as node,
    ):
        try:
            told = subprocess.run(  # noqa: S603 - ours
                [sys.executable, str(FRONT), str(folder / "cell.npz")],
                env=environment,
                capture_output=True,
                text=True,
                timeout=PATIENCE,
                check=False,
            )
        finally:
            node.kill()
    assert told.returncode == 0, (told.stderr[-4000:], (folder / "log").read_text()[-4000:])
    seen: dict[str, Any] = json.loads(told.stdout)
    return seen


def test_wrong_input_undo_and_abort(found: dict[str, Any]) -> None:
    assert found["wrong"] == "name: '../table': expected letters, digits, '-' and '_'"
    assert found["back"] == ["", "Calibration", ["table"]]
    assert found["aborted"] == "Aborted"
    assert "the last one was aborted" in found["over"]


def test_a_plane_is_calibrated(found: dict[str, Any], folder: Path) -> None:
    plane = found["plane"]
    assert (plane["began"], plane["errors"]) == ("", [])
    assert "a calibration is under way" in plane["again"]
    assert plane["steps"][-3:] == ["Touch mark 7 of 7", "What came out", "Save table"]
    assert plane["end"] == "The calibration table is done"
    error, frame, *place = found["pose"]
    assert (error, frame) == ("", "base_link" if found["tf"] else "robot")
    assert place == pytest.approx([1.05, 0.02, 0.5], abs=1e-3)
    assert (found["exported"], found["loaded"]) == ("", "")
    assert "cannot be used" in found["refused"]
    assert PlaneCalibration.load(folder / "calibrations/exports/copy.json").robot_frame == frame


def test_a_camera_on_a_robot_is_calibrated(found: dict[str, Any], folder: Path) -> None:
    from tests.calibration.wizards.test_hand_eye import TRUTH

    robot = found["robot"]
    assert (robot["began"], robot["errors"]) == ("", [])
    assert robot["steps"][-4:] == ["View 9", "Calculate", "What came out", "Save gripper"]
    calibration = HandEyeCalibration.load(folder / "calibrations/gripper.json")
    assert len(calibration.views) == 8
    assert TRUTH.errors(calibration.camera_pose)[1] < 1e-3


def test_the_front_end_speaks_of_robots_that_are_known() -> None:
    assert len(ROBOTS["ur"].numbers) == 6
