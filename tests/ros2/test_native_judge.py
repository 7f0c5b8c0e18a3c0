"""A camera's node through rclpy, judged by a program that is written against rclpy alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.ros2.roskit import DOMAIN, NEEDS_RCLPY

pytestmark = [NEEDS_RCLPY, pytest.mark.long]

BRINGUP = Path(__file__).parents[2] / "ros2" / "smartcam_bringup"
JUDGE = Path(__file__).with_name("native_judge.py")
PATIENCE = 300.0
"""Seconds for all of what is judged."""

PLANT = """\
listen: tcp/127.0.0.1:0
ros2: {through: rclpy}
cameras:
  line1/cam3:
    emulated: {}
    application: 7
    interpret_as: localizations
    frames: "synthetic://?size=320x240&fps=10"
"""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Findings of the judge, by the name of the check."""
    folder = tmp_path_factory.mktemp("judged")
    (folder / "plant.yaml").write_text(PLANT)
    local = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    environment = {**os.environ, **local, "PYTHONPATH": os.pathsep.join(sys.path)}
    serve = [sys.executable, "-m", "smartcam", "ros2", "plant.yaml", "--rmw", "native"]
    serve += ["--ros-args", "--params-file", str(BRINGUP / "config" / "parameters.yaml")]
    with (
        (folder / "log").open("w") as log,
        subprocess.Popen(  # noqa: S603 - ours
            serve, cwd=folder, env=environment, stdout=log, stderr=log
        ) as node,
    ):
        try:
            judge = [sys.executable, str(JUDGE), str(node.pid)]
            told = subprocess.run(  # noqa: S603 - ours
                judge,
                env=environment,
                capture_output=True,
                text=True,
                timeout=PATIENCE,
                check=False,
            )
        finally:
            node.kill()
    lines = [json.loads(line) for line in told.stdout.splitlines()]
    failed = [one for one in lines if "failed" in one]
    assert not failed, (failed, told.stderr[-2000:], (folder / "log").read_text()[-4000:])
    assert told.returncode == 0, told.stderr[-4000:]
    return {one["check"]: one for one in lines}


STANDARD = {
    "trigger": "std_srvs/srv/Trigger",
    "run": "std_srvs/srv/SetBool",
    "change_state": "lifecycle_msgs/srv/ChangeState",
    "get_state": "lifecycle_msgs/srv/GetState",
    "get_transition_graph": "lifecycle_msgs/srv/GetAvailableTransitions",
    "set_parameters": "rcl_interfaces/srv/SetParameters",
    "set_camera_info": "sensor_msgs/srv/SetCameraInfo",
    "get_type_description": "type_description_interfaces/srv/GetTypeDescription",
}


def test_it_is_listed_with_what_it_has(found: dict[str, Any]) -> None:
    services, topics = found["list"]["services"], found["list"]["topics"]
    assert {name: services[name] for name in STANDARD} == {
        name: [kind] for name, kind in STANDARD.items()
    }
    assert topics["localizations"] == ["geometry_msgs/msg/PoseArray"]
    assert topics["image_raw"] == ["sensor_msgs/msg/Image"]
    assert topics["transition_event"] == ["lifecycle_msgs/msg/TransitionEvent"]
    assert "/diagnostics" in topics


def test_each_result_is_heard_once(found: dict[str, Any]) -> None:
    one = found["results"]
    assert one["success"] == [True] * 10
    assert one["numbers"] == [*range(one["numbers"][0], one["numbers"][0] + 10)]
    assert (one["heard"], one["parts"], one["frame"]) == (10, True, "line1_cam3")
    assert 0 <= one["age"] < 120


def test_services_answer(found: dict[str, Any]) -> None:
    replies = found["services"]["replies"]
    refused = replies.pop("reset_errors")
    assert not refused[0]
    assert "has no ResetErrors" in refused[1]
    for name, reply in replies.items():
        assert reply[0], (name, reply)


def test_the_thesis_services_answer_where_their_package_is_built(found: dict[str, Any]) -> None:
    one = found["thesis"]
    if not one["built"]:
        pytest.skip("smartcam_msgs is not built here")
    assert one["connected"]
    assert one["localizations"][1] == one["results"][1] == ""
    assert one["results"][0] == 1
    assert "timeout -1" in one["refused"]


def test_parameters_are_ros_own_and_set_the_camera(found: dict[str, Any]) -> None:
    one = found["parameters"]
    assert {"application", "url", "use_sim_time", "frame_id"} <= set(one["names"])
    assert (one["application"], one["most"]) == (7, 0xFFFFFFFF)
    assert one["url"].startswith("bvs://")
    answers = [(name, done) for name, done, _ in one["answers"]]
    assert answers == [
        ("application", True),
        ("application", True),
        ("application", False),
        ("application", False),
        ("url", False),
        ("nothing", False),
        ("diagnostics_period", True),
    ]
    assert "4000" in one["answers"][2][2]


def test_the_life_cycle_is_ros_own(found: dict[str, Any]) -> None:
    one = found["lifecycle"]
    states = ["active", "active", "inactive", "unconfigured", "unconfigured", "inactive", "active"]
    assert one["states"] == states
    assert one["made"] == [False, True, True, False, True, True]
    assert one["heard"] == [1, 0, 0, 0, 0, 1]
    assert one["ways"] == ["deactivate", "shutdown"]
    goals = ["deactivating", "inactive", "cleaningup", "unconfigured"]
    goals += ["configuring", "inactive", "activating", "active"]
    assert one["goals"] == goals


def test_pictures_have_their_lens(found: dict[str, Any]) -> None:
    one = found["pictures"]
    width, height, encoding, size = one["size"]
    assert (width, height, size) == (
        320,
        240,
        320 * 240 * (3 if encoding.endswith("8") else 1),
    ) or (encoding == "mono8" and size == 320 * 240)
    assert one["lens"] > 0.5
    assert one["jpeg"] == "ffd8"


def test_it_is_well(found: dict[str, Any]) -> None:
    assert found["diagnostics"]["name"] == "line1/cam3: camera"
    assert found["diagnostics"]["level"] == 0


def test_a_client_that_is_killed_harms_nobody(found: dict[str, Any]) -> None:
    assert found["client killed"]["success"]


def test_a_node_that_is_killed_leaves_the_graph(found: dict[str, Any]) -> None:
    assert found["node killed"]["seconds"] < 60
