"""A program of somebody else, written against rclpy alone, that judges a camera's node.

It is run as a program; each of its checks prints one line of JSON. Nothing of smartcam is imported.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from lifecycle_msgs.msg import TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_srvs.srv import SetBool, Trigger

NODE, NAMESPACE = "cam3", "/line1"
FULL = f"{NAMESPACE}/{NODE}"
PATIENCE = 60.0
"""Seconds that only a failure takes."""

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Judge:
    """A node of rclpy that is spun by a thread, as many programs have it."""

    def __init__(self) -> None:
        rclpy.init()
        self.node = rclpy.create_node("judge")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        # from the beginning, so that their publishers know of them when it counts
        self.poses = self.hear("localizations", PoseArray)
        self.events = self.hear("transition_event", TransitionEvent)
        threading.Thread(target=self.executor.spin, daemon=True).start()

    def until(self, true: Callable[[], Any], what: str, seconds: float = PATIENCE) -> Any:
        """Return what is found; end the program where nothing is."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            found = true()
            if found:
                return found
            time.sleep(0.02)
        say(failed=what, seconds=seconds)
        os._exit(1)  # a thread of rclpy's spins

    def until_more(self, heard: list[Any], count: int, what: str) -> None:
        """Wait until more messages than ``count`` have come; end the program where they do not."""
        self.until(lambda: len(heard) > count, what)

    def there(self) -> bool:
        """Return whether the camera's node is in the graph."""
        return (NODE, NAMESPACE) in self.node.get_node_names_and_namespaces()

    def call(self, name: str, kind: Any, request: Any = None, seconds: float = PATIENCE) -> Any:
        """Return the reply of a service of the camera's node."""
        client = self.node.create_client(kind, f"{FULL}/{name}")
        try:
            self.until(client.service_is_ready, f"{name} is there", seconds)
            future = client.call_async(request or kind.Request())
            self.until(future.done, f"a reply of {name}", seconds)
            return future.result()
        finally:
            self.node.destroy_client(client)

    def hear(self, topic: str, kind: Any, qos: Any = 10) -> list[Any]:
        """Return the list that a topic's messages come into."""
        heard: list[Any] = []
        name = topic if topic.startswith("/") else f"{FULL}/{topic}"
        self.node.create_subscription(kind, name, heard.append, qos)
        return heard


def say(**what: Any) -> None:
    """Print what was found."""
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


def list_it(judge: Judge) -> None:
    """Find the node with all that it has."""
    judge.until(judge.there, "the node is there")
    judge.until(lambda: "set_camera_info" in services(judge), "its services are there")
    time.sleep(1.0)
    node = judge.node
    found = node.get_publisher_names_and_types_by_node(NODE, NAMESPACE)
    own = {name.removeprefix(f"{FULL}/"): types for name, types in found}
    say(check="list", services=services(judge), topics=own)


def services(judge: Judge) -> dict[str, list[str]]:
    """Return the services of the node."""
    try:
        found = judge.node.get_service_names_and_types_by_node(NODE, NAMESPACE)
    except Exception:  # noqa: BLE001 - it is not there yet
        return {}
    return {name.removeprefix(f"{FULL}/"): types for name, types in found}


def hear_results(judge: Judge) -> None:
    """Trigger, and hear each result once."""

    def first() -> bool:
        judge.call("trigger", Trigger)
        time.sleep(0.2)
        return bool(judge.poses)

    judge.until(first, "a result")
    time.sleep(1.0)
    begin = len(judge.poses)
    messages = [judge.call("trigger", Trigger) for _ in range(10)]
    judge.until(lambda: len(judge.poses) - begin >= 10, "ten results")
    time.sleep(0.3)
    poses = judge.poses[begin:]
    numbers = [json.loads(one.message)["number"] for one in messages]
    parts = [len(json.loads(one.message)["value"]) for one in messages]
    say(
        check="results",
        success=[one.success for one in messages],
        numbers=numbers,
        heard=len(poses),
        parts=parts == [len(one.poses) for one in poses],
        frame=poses[0].header.frame_id,
        age=time.time() - poses[-1].header.stamp.sec,
    )


def call_services(judge: Judge) -> None:
    """Call all that has no other check."""
    found = {}
    for name in ("stop", "start", "reset_errors"):
        reply = judge.call(name, Trigger)
        found[name] = [reply.success, reply.message]
    for wanted in (False, True):
        found[f"run {wanted}"] = [judge.call("run", SetBool, SetBool.Request(data=wanted)).success]
    say(check="services", replies=found)


def call_thesis(judge: Judge) -> None:
    """Call the thesis' services, where their package is built."""
    try:
        from smartcam_msgs.msg import CameraStatus
        from smartcam_msgs.srv import TriggerLocalization, TriggerResults
    except ImportError:
        say(check="thesis", built=False)
        return
    status = judge.hear("status", CameraStatus, LATCHED)
    judge.until(lambda: status, "a status that was said before")
    one = judge.call("TriggerLocalization", TriggerLocalization)
    request = TriggerResults.Request(timeout=5.0)
    typed = judge.call("trigger_results", TriggerResults, request)
    bad = TriggerResults.Request(timeout=-1.0)
    say(
        check="thesis",
        built=True,
        connected=status[-1].connected,
        localizations=[len(one.localizations), one.error],
        results=[len(typed.results), typed.error],
        refused=judge.call("trigger_results", TriggerResults, bad).error,
    )


def use_parameters(judge: Judge) -> None:
    """List, get, describe and set parameters, right and wrong."""
    names = judge.call("list_parameters", ListParameters).result.names
    asked = ["application", "url", "use_sim_time"]
    values = judge.call("get_parameters", GetParameters, GetParameters.Request(names=asked)).values
    request = DescribeParameters.Request(names=["application"])
    (told,) = judge.call("describe_parameters", DescribeParameters, request).descriptors
    answers = []
    for name, value in (
        ("application", 1),
        ("application", values[0].integer_value),
        ("application", 4000),
        ("application", "seven"),
        ("url", "bvs://elsewhere"),
        ("nothing", 1),
        ("diagnostics_period", 0.5),
    ):
        message = Parameter(name, value=value).to_parameter_msg()
        reply = judge.call(
            "set_parameters", SetParameters, SetParameters.Request(parameters=[message])
        )
        (result,) = reply.results
        answers.append([name, result.successful, result.reason])
    say(
        check="parameters",
        names=list(names),
        application=values[0].integer_value,
        url=values[1].string_value,
        most=told.integer_range[0].to_value,
        answers=answers,
    )


def go_through_states(judge: Judge) -> None:
    """Make each transition, and hear of it; results only while the node is active."""
    poses, begin = judge.poses, len(judge.events)
    states, made, heard = [state(judge)], [], []
    for label in ("activate", "deactivate", "cleanup", "activate", "configure", "activate"):
        request = ChangeState.Request()
        request.transition.label = label
        made.append(judge.call("change_state", ChangeState, request).success)
        before = len(poses)
        judge.call("trigger", Trigger)
        states.append(state(judge))
        if states[-1] == "active":
            judge.until_more(poses, before, "a result of an active node")
        time.sleep(0.4)
        heard.append(len(poses) - before)
    ways = judge.call("get_available_transitions", GetAvailableTransitions).available_transitions
    judge.until_more(judge.events, begin + 7, "each step of the life cycle")
    say(
        check="lifecycle",
        states=states,
        made=made,
        heard=heard,
        ways=sorted(one.transition.label for one in ways),
        goals=[one.goal_state.label for one in judge.events[begin:]],
    )


def state(judge: Judge) -> str:
    """Return the state of the node."""
    return str(judge.call("get_state", GetState).current_state.label)


def see_pictures(judge: Judge) -> None:
    """Hear pictures with their lens, also as sensors' consumers do."""
    images = judge.hear("image_raw", Image, qos_profile_sensor_data)
    lenses = judge.hear("camera_info", CameraInfo, qos_profile_sensor_data)
    small = judge.hear("image_raw/compressed", CompressedImage, qos_profile_sensor_data)
    judge.until(lambda: len(images) > 5 and len(small) > 5 and len(lenses) > 5, "pictures")
    stamps = {(one.header.stamp.sec, one.header.stamp.nanosec) for one in lenses}
    seen = [(one.header.stamp.sec, one.header.stamp.nanosec) in stamps for one in images[1:-2]]
    last = images[-1]
    say(
        check="pictures",
        size=[last.width, last.height, last.encoding, len(last.data)],
        lens=sum(seen) / len(seen),
        jpeg=bytes(small[-1].data[:2]).hex(),
    )


def hear_diagnostics(judge: Judge) -> None:
    """Hear that the camera is well."""
    heard = judge.hear("/diagnostics", DiagnosticArray)
    judge.until(lambda: heard, "diagnostics")
    (one,) = heard[-1].status
    say(check="diagnostics", name=one.name, level=int.from_bytes(one.level, "little"))


CALLER = """
import rclpy
from std_srvs.srv import Trigger
rclpy.init()
node = rclpy.create_node("caller")
client = node.create_client(Trigger, "/line1/cam3/trigger")
client.wait_for_service()
print("calling", flush=True)
while True:
    calls = [client.call_async(Trigger.Request()) for _ in range(4)]
    rclpy.spin_until_future_complete(node, calls[-1])
"""


def kill_a_client(judge: Judge) -> None:
    """Kill a client in the middle of its calls; others are served."""
    command = [sys.executable, "-c", CALLER]
    caller = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)  # noqa: S603 - ours
    assert caller.stdout is not None
    caller.stdout.readline()
    time.sleep(1.0)
    caller.send_signal(signal.SIGKILL)
    caller.wait()
    begin = time.monotonic()
    reply = judge.call("trigger", Trigger)
    say(check="client killed", success=reply.success, seconds=time.monotonic() - begin)


def kill_the_node(judge: Judge, pid: int) -> None:
    """Kill the camera's node: a call that is under way ends at its caller's deadline."""
    os.kill(pid, signal.SIGKILL)
    begin = time.monotonic()
    judge.until(lambda: not judge.there(), "the node is gone", 90.0)
    say(check="node killed", seconds=time.monotonic() - begin)


CHECKS = (
    list_it, hear_results, call_services, call_thesis, use_parameters, hear_diagnostics,
    go_through_states, see_pictures, kill_a_client,
)  # fmt: skip


def main() -> None:
    judge = Judge()
    for check in CHECKS:
        check(judge)
    kill_the_node(judge, int(sys.argv[1]))


if __name__ == "__main__":
    main()
    sys.stdout.flush()
    os._exit(0)  # a thread of rclpy's spins
