"""Another implementation of rmw_zenoh's format, in a process of its own: ``zenoh-ros2-sdk``.

``python -m tests.ros2.sdk_partner PORT FOLDER`` does what it is told by lines of JSON on its
standard input, and answers each by one on its standard output. It wants the files of messages from
git repositories; FOLDER gets such ones, with definitions that are ours.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

MESSAGES = {
    "rcl_interfaces/builtin_interfaces/msg/Time.msg": "int32 sec\nuint32 nanosec\n",
    "common_interfaces/std_msgs/msg/String.msg": "string data\n",
    "common_interfaces/std_msgs/msg/Header.msg": (
        "builtin_interfaces/Time stamp\nstring frame_id\n"
    ),
    "common_interfaces/geometry_msgs/msg/Point.msg": "float64 x\nfloat64 y\nfloat64 z\n",
    "common_interfaces/geometry_msgs/msg/Quaternion.msg": (
        "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n"
    ),
    "common_interfaces/geometry_msgs/msg/Pose.msg": "Point position\nQuaternion orientation\n",
    "common_interfaces/geometry_msgs/msg/PoseArray.msg": "std_msgs/Header header\nPose[] poses\n",
    "common_interfaces/sensor_msgs/msg/Image.msg": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
        "uint8 is_bigendian\nuint32 step\nuint8[] data\n"
    ),
}
SET_BOOL = ("bool data", "bool success\nstring message")


def write_definitions(folder: Path) -> None:
    """Write the repositories that it looks for, each with a branch of the distribution's name."""
    for name, text in MESSAGES.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    who = ("-c", "user.name=test", "-c", "user.email=test@localhost")
    for repository in {Path(name).parts[0] for name in MESSAGES}:
        for command in (("init", "-q", "-b", "jazzy"), ("add", "."), ("commit", "-qm", "it")):
            subprocess.run(["git", *who, *command], cwd=folder / repository, check=True)  # noqa: S603, S607 - of ours


def plain(message: Any) -> Any:
    """Return a message as JSON can have it."""
    if dataclasses.is_dataclass(message) and not isinstance(message, type):
        names = [one.name for one in dataclasses.fields(message) if one.name[0] != "_"]
        return {name: plain(getattr(message, name)) for name in names}
    if isinstance(message, list):
        return [plain(one) for one in message]
    return message.tolist() if hasattr(message, "tolist") else message


class Partner:
    """A partner that acts when it is told."""

    def __init__(self, port: int) -> None:
        self.port = {"router_port": port, "domain_id": 7}
        self.heard: list[Any] = []
        self.came = threading.Condition()
        self.kept: list[Any] = []

    def topics(self) -> Any:
        """List topics with their types."""
        from zenoh_ros2_sdk.discovery import get_topic_names_and_types

        return get_topic_names_and_types(timeout=60.0, **self.port)

    def services(self) -> Any:
        """List services with their types."""
        from zenoh_ros2_sdk.discovery import get_service_names_and_types

        return get_service_names_and_types(timeout=60.0, **self.port)

    def subscribe(self, topic: str, type: str) -> None:
        """Hear a topic."""
        from zenoh_ros2_sdk import ROS2Subscriber

        def hear(message: Any) -> None:
            with self.came:
                self.heard.append(plain(message))
                self.came.notify()

        self.kept.append(ROS2Subscriber(topic, type, hear, **self.port))

    def take(self) -> Any:
        """Return the next message that came."""
        with self.came:
            if not self.came.wait_for(lambda: self.heard, 60):
                raise TimeoutError
            return self.heard.pop(0)

    def publish(self, topic: str, type: str, times: int, **fields: Any) -> None:
        """Publish."""
        from zenoh_ros2_sdk import ROS2Publisher

        publisher = ROS2Publisher(topic, type, **self.port)
        self.kept.append(publisher)
        for _ in range(times):
            publisher.publish(**fields)

    def call(self, service: str, **fields: Any) -> Any:
        """Call a SetBool."""
        from zenoh_ros2_sdk import ROS2ServiceClient

        client = ROS2ServiceClient(service, "std_srvs/srv/SetBool", *SET_BOOL, **self.port)
        self.kept.append(client)
        return plain(client.call(**fields))

    def serve(self, service: str) -> None:
        """Serve a SetBool that says what it was asked for."""
        from zenoh_ros2_sdk import ROS2ServiceServer

        def answer(request: Any) -> Any:
            return server.response_msg_class(success=request.data, message=f"was {request.data}")

        server = ROS2ServiceServer(
            service,
            "std_srvs/srv/SetBool",
            answer,
            request_definition=SET_BOOL[0],
            response_definition=SET_BOOL[1],
            **self.port,
        )
        self.kept.append(server)


def main() -> None:
    """Do what the lines of standard input say."""
    port, folder = int(sys.argv[1]), Path(sys.argv[2])
    write_definitions(folder)
    os.environ |= {"ZENOH_ROS2_SDK_CACHE": str(folder), "HOME": str(folder)}
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what it prints is not an answer
    partner = Partner(port)
    for line in sys.stdin:
        told = json.loads(line)
        do: Callable[..., Any] = getattr(partner, told.pop("do"))
        print(json.dumps(do(**told)), file=out, flush=True)
    os._exit(0)  # its threads do not end


if __name__ == "__main__":
    main()
