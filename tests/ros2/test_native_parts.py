"""Parts of a node through rclpy that need no rclpy."""

from __future__ import annotations

import ast
import importlib.util
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest

from smartcam.exceptions import ConfigurationError, RosError
from smartcam.fleet import FleetFile
from smartcam.ros2 import RosTypes
from smartcam.ros2._inside import NativeContext
from smartcam.ros2._native import parameters
from smartcam.ros2._native.outbox import MAX_WAITING_MESSAGES, MessageThread
from smartcam.ros2._native.stamps import BILLION, MAX_STAMPS, RosStamps
from tests.cli.commandline import run

TYPES = RosTypes()
BRINGUP = Path(__file__).parents[2] / "ros2" / "smartcam_bringup"


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is not None, reason="rclpy is here")
def test_without_rclpy_the_error_says_how_to_get_it() -> None:
    with pytest.raises(ConfigurationError, match=r"rclpy cannot be imported.*setup\.bash"):
        NativeContext()


# ---------------------------------------------------------------------- the command, and bring-up


def test_the_launch_file_has_a_command_that_is_understood() -> None:
    tree = ast.parse((BRINGUP / "launch" / "cameras.launch.py").read_text(encoding="utf-8"))
    texts = [one.value for one in ast.walk(tree) if isinstance(one, ast.Constant)]
    ours = {"--rmw", "--namespace"}
    said = {one for one in texts if str(one).startswith("--")}
    assert said == {*ours, "--ros-args", "--params-file"}
    told = run("ros2", "--help").out
    assert all(option in told for option in (*ours, "--ros-args", "[zenoh|native]"))


def test_the_key_of_rosdep_is_the_one_that_the_package_wants() -> None:
    yaml = pytest.importorskip("yaml", reason="needs the extra yaml")
    (key,) = yaml.safe_load((BRINGUP / "rosdep.yaml").read_text(encoding="utf-8"))
    package = ElementTree.parse(BRINGUP / "package.xml")  # noqa: S314 - ours
    assert key in [one.text for one in package.findall("exec_depend")]
    assert FleetFile.model_validate(
        yaml.safe_load((BRINGUP / "config" / "plant.yaml").read_text(encoding="utf-8"))
    ).cameras


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--ros-args", "-p", "a:=1"], "--ros-args: expected --rmw native"),
        (["--rmw", "fastrtps"], "Invalid value for '--rmw'"),
        (["--rwm", "native"], "No such option"),
    ],
)
def test_arguments_for_ros_want_ros(arguments: list[str], text: str) -> None:
    told = run("ros2", "fleet://127.0.0.1:1", *arguments)
    assert told.code == 2
    assert text in told.err


# ---------------------------------------------------------------------- the outbox


def test_jobs_are_done_in_order_and_all_before_it_ends() -> None:
    done: list[int] = []
    box = MessageThread("test")
    for number in range(1000):
        box.add_job(lambda number=number: done.append(number))  # type: ignore[misc]
    assert box.close(10.0)
    assert done == [*range(1000)]
    with pytest.raises(RosError, match="closed"):
        box.add_job(lambda: done.append(1))


def test_what_waits_is_bounded_and_the_oldest_goes() -> None:
    go, done, dropped = threading.Event(), list[int](), list[int]()
    box = MessageThread("test")
    box.add_job(go.wait)  # type: ignore[arg-type]
    box.add_job(lambda: done.append(-1))  # which cannot be dropped
    for number in range(MAX_WAITING_MESSAGES + 10):
        box.add_job(
            lambda number=number: done.append(number),  # type: ignore[misc]
            1,
            lambda number=number: dropped.append(number),  # type: ignore[misc]
        )
    go.set()
    assert box.close(10.0)
    assert dropped == [*range(len(dropped))]
    assert 9 <= len(dropped) <= 12
    assert done == [-1, *range(len(dropped), MAX_WAITING_MESSAGES + 10)]


def test_one_that_does_not_end_holds_up_nobody_for_long() -> None:
    go = threading.Event()
    box = MessageThread("test")
    box.add_job(go.wait)  # type: ignore[arg-type]
    assert not box.close(0.05)
    go.set()
    assert box.close(10.0)


def test_a_job_that_fails_leaves_the_others() -> None:
    done: list[int] = []
    box = MessageThread("test")
    box.add_job(lambda: [][0])
    box.add_job(lambda: done.append(1))
    assert box.close(10.0)
    assert done == [1]


# ---------------------------------------------------------------------- parameters


def test_changes_of_parameters_reach_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    node: Any = SimpleNamespace(full_name="/cam", types=TYPES)
    seen: list[tuple[str, object]] = []
    node.rclpy_node = SimpleNamespace(
        add_on_set_parameters_callback=lambda _hook: None,
        describe_parameter=lambda _name: SimpleNamespace(read_only=False),
        set_parameters=lambda values: seen.append(("set", values)),
        undeclare_parameter=lambda name: seen.append(("undeclare", name)),
    )
    made = parameters.NativeParameters(node)
    monkeypatch.setattr(made, "_declare_in_ros", lambda name: seen.append(("declare", name)))
    monkeypatch.setattr(made, "_rclpy_parameter", lambda name: (name, made.get(name)))
    made.declare("rate", 1)
    assert seen == []
    made.open()
    made.declare("gain", 2)
    made.update("rate", 3)
    made.undeclare("gain")
    assert seen[:2] == [("declare", "rate"), ("declare", "gain")]
    assert seen[2:] == [("set", [("rate", 3)]), ("undeclare", "gain")]


# ---------------------------------------------------------------------- stamps


def test_all_headers_are_moved_and_equal_stamps_stay_equal() -> None:
    shifts = iter([-1.5, -1.25])
    stamps = RosStamps(lambda: next(shifts))
    image = TYPES.message("sensor_msgs/msg/Image")
    result = TYPES.message("smartcam_msgs/msg/Result")
    first = {"stamp": {"sec": 100, "nanosec": 250_000_000}, "frame_id": "cam"}
    moved = image.decode(
        stamps.to_ros_time(image, image.encode({"header": first, "data": b"\1\2"}))
    )
    assert (moved.header.stamp.sec, moved.header.stamp.nanosec) == (98, 750_000_000)
    assert (moved.header.frame_id, bytes(moved.data)) == ("cam", b"\1\2")
    later = {"stamp": {"sec": 101}}
    parts = [{"pose": {"header": later}}, {"pose": {"header": first}}]
    fields = {"header": first, "localizations": parts}
    again = result.decode(stamps.to_ros_time(result, result.encode(fields)))
    seconds = [again.header.stamp.sec, *(one.pose.header.stamp.sec for one in again.localizations)]
    assert seconds == [98, 99, 98]


def test_few_stamps_are_remembered() -> None:
    stamps = RosStamps(lambda: 1.0)
    for second in range(2 * MAX_STAMPS):
        assert stamps._shift_stamp(second * BILLION) == (second + 1) * BILLION
    assert len(stamps._shifted_stamps) == MAX_STAMPS
