"""A front end of somebody else, written against rclpy alone: it drives calibrations to their end.

``native_front.py CELL.npz``, where CELL has what its robot and the camera on the hand do, prints
what it saw as JSON. Nothing of smartcam is imported. Where there is tf2_msgs the robot is in TF,
else its poses are typed.
"""

from __future__ import annotations

import json
import os
import re
import sys
import threading
import time
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import Image
from smartcam_msgs.srv import (
    ExportCalibration,
    LoadCalibration,
    PerformCurrentAndGetNextStep,
    StartCalibration,
    TransformPixelPose,
)

try:
    from geometry_msgs.msg import TransformStamped
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

CAMERA, IMAGES = "/line1/cam3", "/hand/image"
PATIENCE = 160.0
"""Seconds that a step may take."""

SETTLED = 0.3
"""Seconds after which transforms and pictures show where the robot is now."""

SERVICES = (
    *(ExportCalibration, LoadCalibration, PerformCurrentAndGetNextStep),
    *(StartCalibration, TransformPixelPose),
)


class Cell:
    """A robot over a table, which holds a camera, and a panel that calls services."""

    def __init__(self, file: str) -> None:
        rclpy.init()
        self.data = np.load(file)
        self.tip: tuple[float, ...] = (0.0, 0.0, 0.0)
        self.view = 0
        self.node = rclpy.create_node("panel")
        self.clients = {
            kind: self.node.create_client(kind, f"{CAMERA}/{kind.__name__}") for kind in SERVICES
        }
        self.moves = TFMessage and self.node.create_publisher(TFMessage, "/tf", 10)
        self.images = self.node.create_publisher(Image, IMAGES, 5)
        self.node.create_timer(0.05, self.say)
        executor = SingleThreadedExecutor()
        executor.add_node(self.node)
        threading.Thread(target=executor.spin, daemon=True).start()

    def say(self) -> None:
        now, data = self.node.get_clock().now().to_msg(), self.data
        if TFMessage is not None:
            down = self.transform("tip", self.tip, (1.0, 0.0, 0.0, 0.0), now)
            places = data["places"][self.view].tolist(), data["turns"][self.view].tolist()
            flange = self.transform("flange", *places, now)
            self.moves.publish(TFMessage(transforms=[down, flange]))
        pixels, image = data["images"][self.view], Image(encoding="mono8")
        image.header.stamp = now
        image.height, image.width = pixels.shape
        image.step, image.data = image.width, pixels.tobytes()
        self.images.publish(image)

    @staticmethod
    def transform(child: str, place: Any, turn: Any, now: Any) -> Any:
        one = TransformStamped(child_frame_id=child)
        one.header.stamp, one.header.frame_id = now, "base_link"
        moved, turned = one.transform.translation, one.transform.rotation
        moved.x, moved.y, moved.z = place
        turned.x, turned.y, turned.z, turned.w = turn
        return one

    def call(self, kind: Any, **fields: Any) -> Any:
        client = self.clients[kind]
        assert client.wait_for_service(timeout_sec=30), kind
        future, end = client.call_async(kind.Request(**fields)), time.monotonic() + PATIENCE
        while not future.done():
            assert time.monotonic() < end, kind
            time.sleep(0.005)
        return future.result()

    def step(self, **fields: Any) -> Any:
        return self.call(PerformCurrentAndGetNextStep, **fields)

    def drive(self, answer: Any, **start: Any) -> dict[str, Any]:
        """Start a calibration, and answer each step until the end."""
        began = self.call(StartCalibration, **start).error
        again = self.call(StartCalibration, **start).error
        step, seen, errors = self.step(), [], []
        while step.button_text:
            seen.append(step.header_text)
            given = {
                "value_inputs": list(step.default_needed_values),
                "text_inputs": list(step.default_needed_strings),
                "option_inputs": [one.split()[0] for one in step.default_needed_options],
            }
            answer(step, given)
            following = self.step(**given)
            errors.append(following.error)
            if following.error and errors.count(following.error) > 1:
                break
            step = following
        last = {"began": began, "again": again, "end": step.header_text}
        return {**last, "steps": seen, "errors": [one for one in errors if one]}

    # ------------------------------------------------------------------ what is typed

    def plane(self, step: Any, given: dict[str, Any]) -> None:
        title = step.header_text
        if title == "Calibration":
            given["text_inputs"] = ["table"]
        elif title == "What came out":
            given["option_inputs"] = ["accept"]
        elif title.startswith("Touch mark"):
            seen = re.search(r"at x (-?[0-9.]+) mm, y (-?[0-9.]+) mm", step.description_text)
            assert seen is not None
            x, y = (float(one) / 1000 for one in seen.groups())
            self.tip = (x + 1.0, y, 0.5)
            time.sleep(SETTLED)
            if step.default_needed_values:
                given["value_inputs"] = [1000 * one for one in self.tip]

    def robot(self, step: Any, given: dict[str, Any]) -> None:
        title, data = step.header_text, self.data
        if title == "Calibration":
            given["text_inputs"] = ["gripper"]
        elif title == "Camera and robot" and TFMessage is None:
            given["option_inputs"][1] = str(data["robot"])
        elif title == "Which sheet lies there?":
            given["option_inputs"] = ["checkerboard"]
        elif title == "What is on it":
            given["value_inputs"][:2] = data["size"].tolist()
            given["option_inputs"] = [str(data["mark"])]
        elif title == "What came out":
            given["option_inputs"] = ["accept"]
        elif title.startswith("View"):
            self.view = min(int(title.split()[1]), len(data["images"])) - 1
            if int(title.split()[1]) > len(data["images"]):
                given["option_inputs"] = ["calculate"]
            elif TFMessage is None:
                given["value_inputs"] = data["typed"][self.view].tolist()
            time.sleep(SETTLED)


def judged(cell: Cell) -> dict[str, Any]:
    """Return what was seen of all services."""
    frames = {} if TFMessage is None else {"tf_frame_robot_tcp": "tip"}
    smart = {"topic_image2": "SMARTCAMERA", "fixed_camera": "True"}
    found: dict[str, Any] = {"tf": TFMessage is not None}
    cell.call(StartCalibration, **smart)
    cell.step()
    wrong = cell.step(text_inputs=["../table"])
    cell.step(text_inputs=["table"])
    back = cell.step(repeat_last_step=True)
    found["wrong"] = wrong.error
    found["back"] = [back.error, back.header_text, list(back.default_needed_strings)]
    found["aborted"] = cell.step(abort=True).header_text
    found["over"] = cell.step().error
    found["plane"] = cell.drive(cell.plane, **smart, **frames)
    pose = cell.call(TransformPixelPose, x=0.05, y=0.02)
    place = pose.pose.pose.position
    found["pose"] = [pose.error, pose.pose.header.frame_id, place.x, place.y, place.z]
    copied = {"calibration_name": "table", "target_path": "copy.json"}
    found["exported"] = cell.call(ExportCalibration, **copied).error
    loaded = {"calibration_name_or_path": "exports/copy.json"}
    found["loaded"] = cell.call(LoadCalibration, **loaded).error
    found["refused"] = cell.call(LoadCalibration, calibration_name_or_path="../plant").error
    hand = {} if TFMessage is None else {"tf_frame_robot_tcp": "flange"}
    square = float(cell.data["square"])
    start = {"topic_image1": IMAGES, "checkerboard_squaresize_m": square, "fixed_camera": "False"}
    found["robot"] = cell.drive(cell.robot, **start, **hand)
    return found


if __name__ == "__main__":
    sys.stdout.write(json.dumps(judged(Cell(sys.argv[1]))))
    sys.stdout.flush()
    os._exit(0)  # a thread of rclpy's spins
