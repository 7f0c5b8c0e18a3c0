"""The thesis' calibration services, driven to their end by front ends: in JSON, ROS 2 and ROS 1.

The front ends know the fields of the thesis and nothing else of smartcam. Real Zenoh, our nodes,
and a rosbridge; a robot that is in TF, and a camera of its hand on a topic.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import functools
import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import smartcam
from smartcam.calibration import HandEyeCalibration, PlaneCalibration
from smartcam.calibration.simulation import render
from smartcam.emulator import Application, EmulatedCamera
from smartcam.fleet import FleetFile, FleetServer
from smartcam.fleet._inside import FleetAddress, RosSection
from smartcam.geometry import Transform
from smartcam.ros1._inside import run_bridged_nodes
from smartcam.ros2 import Node, QoS
from tests.calibration.scenes import SHEET
from tests.calibration.wizards.bench import GRID, OFFSET, ROTATION, Bench, where
from tests.calibration.wizards.test_hand_eye import CAMERA, TRUTH
from tests.fleet.plainkit import NAME, ask_thesis, zenoh_session
from tests.processes import free_place
from tests.ros1.bridge import Bridge

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping

pytestmark = pytest.mark.real_time

PATIENCE = 120.0
"""Seconds; only what has gone wrong takes as long."""

IMAGES, LENS = "/hand/image", "/hand/camera_info"
"""The topics of the camera on the hand."""

LAYOUT = (
    "(feature_id: string[50], quality: real32, photo_index: int32, x: real32, y: real32, "
    "theta: real32)*"
)

PERIOD = 0.05
"""Seconds between two transforms of the robot, and between two pictures."""

START, STEP = "StartCalibration", "PerformCurrentAndGetNextStep"


class Robot:
    """A robot in TF, and the camera on its hand.

    Attributes:
        tip: where the tip of the tool is in the base.
        view: number of the pose of the flange, and of the picture that the camera takes there.
        moving: whether the robot says where it is.
    """

    def __init__(self) -> None:
        self.tip: tuple[float, float, float] = (0.3, 0.1, 0.4)
        self.view = 0
        self.moving = True

    def transforms(self, utc: float) -> list[dict[str, Any]]:
        """Return the transforms that move: the tip's and the flange's."""
        flange = TRUTH.robot_poses[self.view]
        down = Transform.from_quaternion("base_link", "tip", self.tip, (1.0, 0.0, 0.0, 0.0))
        named = Transform("base_link", "flange", flange.rotation, flange.translation)
        return [transform_of(one, utc) for one in (down, named)]


def stamp_of(utc: float) -> dict[str, int]:
    return {"sec": int(utc), "nanosec": int(utc % 1 * 1e9)}


def transform_of(transform: Transform, utc: float) -> dict[str, Any]:
    xyzw = dict(zip("xyzw", transform.quaternion.tolist(), strict=True))
    xyz = dict(zip("xyz", transform.translation.tolist(), strict=True))
    return {
        "header": {"stamp": stamp_of(utc), "frame_id": transform.target},
        "child_frame_id": transform.source,
        "transform": {"translation": xyz, "rotation": xyzw},
    }


WORLD = Transform("world", "base_link", np.eye(3), np.array([10.0, 0.0, 1.0]))
"""Place of the robot in the hall: a static transform."""


@functools.cache
def picture(number: int) -> bytes:
    """Return the pixels that the camera on the hand sees at a pose."""
    image = render(SHEET, CAMERA, TRUTH.target_in_camera(TRUTH.robot_poses[number]), blur=0.7)
    pixels: bytes = np.ascontiguousarray(image, np.uint8).tobytes()
    return pixels


def image_of(number: int, utc: float) -> dict[str, Any]:
    width, height = CAMERA.size
    header = {"stamp": stamp_of(utc), "frame_id": "hand"}
    size = {"width": width, "height": height, "step": width}
    return {"header": header, **size, "encoding": "mono8", "data": picture(number)}


def lens_of(utc: float) -> dict[str, Any]:
    width, height = CAMERA.size
    return {
        "header": {"stamp": stamp_of(utc), "frame_id": "hand"},
        "width": width,
        "height": height,
        "distortion_model": "plumb_bob",
        "d": [0.0] * 5,
        "k": CAMERA.matrix.ravel().tolist(),
    }


# ---------------------------------------------------------------------- ways to the services


class Face:
    """A way to the services.

    Attributes:
        server: the agent.
        robot: the robot; nobody hears of it in JSON.
    """

    def __init__(self, server: FleetServer) -> None:
        self.server, self.robot = server, Robot()

    @property
    def folder(self) -> Path:
        """The agent's folder of calibrations."""
        return self.server.folder / "calibrations"

    async def ask(self, service: str, **fields: Any) -> dict[str, Any]:
        """Return the fields of an answer."""
        raise NotImplementedError

    async def step(self, **fields: Any) -> dict[str, Any]:
        """Perform a step that must be taken."""
        answer = await self.ask(STEP, **fields)
        assert answer["error"] == "", answer
        return answer


class JsonFace(Face):
    """Plain Zenoh."""

    def __init__(self, server: FleetServer, session: Any) -> None:
        super().__init__(server)
        self._session = session

    async def ask(self, service: str, **fields: Any) -> dict[str, Any]:
        return await ask_thesis(self._session, service, fields)


def fields_of(value: Any) -> Any:
    """Return a message of ROS 2 as plain data."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [fields_of(one) for one in value]
    if hasattr(value, "__dataclass_fields__"):
        return {name: fields_of(getattr(value, name)) for name in value.__dataclass_fields__}
    return value


class Ros2Face(Face):
    """A node of ours in another context, which has the robot, too."""

    def __init__(self, server: FleetServer, viewer: Node) -> None:
        super().__init__(server)
        self._viewer = viewer

    async def ask(self, service: str, **fields: Any) -> dict[str, Any]:
        client = self._viewer.client(f"/{NAME}/{service}", f"smartcam_msgs/srv/{service}")
        try:
            answer: dict[str, Any] = fields_of(await client.call(fields, timeout=PATIENCE))
        finally:
            client.close()
        return answer

    async def run_robot(self) -> None:
        """Say where the robot is, and what its camera sees."""
        viewer, kind = self._viewer, "tf2_msgs/msg/TFMessage"
        moves = viewer.publisher("/tf", kind, qos=QoS(depth=100))
        stands = viewer.publisher("/tf_static", kind, qos=QoS(latched=True, depth=1))
        images = viewer.publisher(IMAGES, "sensor_msgs/msg/Image", qos=QoS(depth=5))
        lenses = viewer.publisher(LENS, "sensor_msgs/msg/CameraInfo", qos=QoS(depth=5))
        stands.publish(transforms=[transform_of(WORLD, time.time())])
        while True:
            now = time.time()
            if self.robot.moving:
                moves.publish(transforms=self.robot.transforms(now))
            if images.has_subscribers:
                images.publish(image_of(self.robot.view, now))
            if lenses.has_subscribers:
                lenses.publish(lens_of(now))
            await asyncio.sleep(PERIOD)


def of_ros1(value: Any) -> Any:
    """Return fields as a rosbridge says them."""
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, list):
        return [of_ros1(one) for one in value]
    if isinstance(value, dict):
        names = {"sec": "secs", "nanosec": "nsecs", "d": "D", "k": "K"}
        return {names.get(name, name): of_ros1(one) for name, one in value.items()}
    return value


class Ros1Face(Face):
    """A rosbridge, behind which there would be ROS 1 with the robot."""

    def __init__(self, server: FleetServer, bridge: Bridge) -> None:
        super().__init__(server)
        self._bridge = bridge

    async def ask(self, service: str, **fields: Any) -> dict[str, Any]:
        said = await self._bridge.call(f"/{NAME}/{service}", of_ros1(fields))
        answer: dict[str, Any] = said["values"]
        return answer

    async def run_robot(self) -> None:
        """Say where the robot is, and what its camera sees."""
        bridge = self._bridge
        while True:
            now = time.time()
            stands = [transform_of(WORLD, now)]
            await bridge.publish("/tf_static", of_ros1({"transforms": stands}))
            if self.robot.moving:
                moves = self.robot.transforms(now)
                await bridge.publish("/tf", of_ros1({"transforms": moves}))
            await bridge.publish(LENS, of_ros1(lens_of(now)))
            await bridge.publish(IMAGES, of_ros1(image_of(self.robot.view, now)))
            await asyncio.sleep(PERIOD)


# ---------------------------------------------------------------------- a plant for each


def camera_of_marks() -> EmulatedCamera:
    """Return a camera that sees the marks of the bench."""
    marks = [
        {"feature_id": "mark", "quality": 0.9, "photo_index": 0, "x": x, "y": y, "theta": 0.3}
        for x, y in GRID
    ]
    one = Application(id=1, layout=LAYOUT, constant=marks, load_time=0.0)
    return EmulatedCamera([one], builtins=False, active=1, running=True)


@contextlib.asynccontextmanager
async def plant(
    folder: Path, *, frames: str | None = None, **more: Any
) -> AsyncIterator[FleetServer]:
    """An agent that has one camera, and a folder for calibrations."""
    async with camera_of_marks() as box:
        entry: dict[str, Any] = {"url": box.url, "interpret_as": "localizations"}
        entry |= {"application": 1, "frames": frames}
        fields: dict[str, Any] = {"listen": free_place(), "cameras": {NAME: entry}}
        file = FleetFile.model_validate({"calibrations": "calibrations", **fields, **more})
        async with FleetServer(file, folder=folder) as server:
            await server.wait_first_attempts()
            yield server


@contextlib.asynccontextmanager
async def in_json(folder: Path, **more: Any) -> AsyncIterator[Face]:
    async with plant(folder, **more) as server:
        session = await asyncio.to_thread(zenoh_session, server.address.port)
        try:
            yield JsonFace(server, session)
        finally:
            await asyncio.to_thread(session.close)


@contextlib.asynccontextmanager
async def running(work: Any) -> AsyncIterator[None]:
    task = asyncio.create_task(work)
    try:
        yield
    finally:
        task.cancel()
        await asyncio.wait((task,))
        if not task.cancelled():
            task.result()


@contextlib.asynccontextmanager
async def in_ros2(folder: Path, **more: Any) -> AsyncIterator[Face]:
    async with plant(folder, ros2={}, **more) as server:
        place = f"tcp/127.0.0.1:{server.address.port}"
        async with Node("viewer", connect=place) as viewer:
            face = Ros2Face(server, viewer)
            async with running(face.run_robot()):
                yield face


@contextlib.asynccontextmanager
async def in_ros1(folder: Path, **more: Any) -> AsyncIterator[Face]:
    async with plant(folder, **more) as server, Bridge(wakes_after=0.002) as bridge:
        address = FleetAddress.parse(server.address.url)
        section = RosSection.model_validate({})
        given = (bridge.url, lambda _: None, address, section)
        async with run_bridged_nodes(*given, calibrations_by_camera=server.calibrations) as ros:
            await ros.wait_first_attempts()
            face = Ros1Face(server, bridge)
            async with running(face.run_robot()):
                yield face


@contextlib.asynccontextmanager
async def in_json_beside_ros(folder: Path, **more: Any) -> AsyncIterator[Face]:
    """Plain Zenoh, at an agent whose cameras are nodes, too: it has TF, and topics."""
    async with in_ros2(folder, **more) as beside:
        session = await asyncio.to_thread(zenoh_session, beside.server.address.port)
        try:
            face = JsonFace(beside.server, session)
            face.robot = beside.robot
            yield face
        finally:
            await asyncio.to_thread(session.close)


ALL = pytest.mark.parametrize("face", [in_json, in_ros2, in_ros1])
WITH_TF = pytest.mark.parametrize("face", [in_json_beside_ros, in_ros2, in_ros1])


# ---------------------------------------------------------------------- a front end


def defaults(answer: Mapping[str, Any], **other: str) -> dict[str, Any]:
    """Return the inputs that leave everything as it is shown, but for options by their first."""
    options = [one.split()[0] for one in answer["default_needed_options"]]
    for first, wanted in other.items():
        options = [wanted if one == first else one for one in options]
    return {
        "value_inputs": list(answer["default_needed_values"]),
        "text_inputs": list(answer["default_needed_strings"]),
        "option_inputs": options,
    }


async def to_the_first_touch(face: Face, name: str, about: Mapping[str, Any]) -> dict[str, Any]:
    """Go through the steps up to the first touch of a mark."""
    answer = await face.step()
    assert answer["header_text"] == "Calibration"
    assert answer["descriptions_for_needed_strings"] == ["Name of the calibration"]
    answer = await face.step(text_inputs=[name], **about)
    assert answer["header_text"] == "Camera, robot and tool"
    inputs = defaults(answer)
    inputs["value_inputs"][0] = 0.2  # the sigma of a touch, mm
    answer = await face.step(**inputs)
    assert (answer["header_text"], answer["button_text"]) == (
        "Marks in the camera's field",
        "Take a picture",
    )
    answer = await face.step()
    assert answer["header_text"] == "Which ones will be touched?"
    return await face.step(**defaults(answer))


async def to_the_end(face: Face, answer: Mapping[str, Any]) -> dict[str, Any]:
    """Accept what came out, and save it."""
    assert answer["header_text"] == "What came out"
    assert "Good for" in answer["description_text"]
    answer = await face.step(**defaults(answer))
    assert answer["button_text"] == "Save"
    answer = await face.step()
    assert answer["button_text"] == ""
    return answer


@ALL
async def test_a_plane_is_calibrated_by_typed_touches(face: Any, tmp_path: Path) -> None:
    bench = Bench()
    async with asyncio.timeout(PATIENCE), face(tmp_path) as way:
        # what is not so far
        for service, fields, error in (
            (STEP, {}, "no calibration is under way"),
            (START, {"fixed_camera": "perhaps"}, "fixed_camera"),
            (START, {"checkerboard_squaresize_m": -1.0}, "checkerboard_squaresize_m"),
            ("TransformPixelPose", {"x": 0.0, "y": 0.0}, "no calibration is loaded"),
            ("LoadCalibration", {"calibration_name_or_path": "table"}, "no calibration 'table'"),
        ):
            assert error in (await way.ask(service, **fields))["error"], service
        assert (await way.ask(START, topic_image2="SMARTCAMERA"))["error"] == ""
        # another client
        assert "is under way" in (await way.ask(START))["error"]
        answer = await to_the_first_touch(way, "table", {"option_inputs": ["True"]})
        # wrong input keeps the step, and says what was expected
        assert answer["header_text"] == "Touch mark 1 of 9"
        assert answer["descriptions_for_needed_values"] == ["x [mm]", "y [mm]", "z [mm]"]
        for wrong, error in (
            ({"value_inputs": [1.0]}, "1 values: expected 3"),
            ({"value_inputs": [1.0, 2.0, 3e9]}, "z: "),
            ({"value_inputs": [1.0, 2.0, 3.0], "text_inputs": ["?"]}, "1 strings: expected 0"),
        ):
            answer = await way.ask(STEP, **wrong)
            assert error in answer["error"]
            assert answer["header_text"] == "Touch mark 1 of 9"
        for number, mark in enumerate(GRID):
            if number == 2:  # a wrong touch, undone
                answer = await way.step(value_inputs=[1.0, 2.0, 3.0])
                answer = await way.step(repeat_last_step=True)
                assert answer["header_text"] == "Touch mark 3 of 9"
                assert answer["default_needed_values"] == [1.0, 2.0, 3.0]
            answer = await way.step(value_inputs=[1e3 * one for one in bench.touch(*mark)])
        answer = await to_the_end(way, answer)
        assert "table.json" in answer["description_text"]
        assert "'table' was finished" in (await way.ask(STEP))["error"]
        found = PlaneCalibration.load(way.folder / "table.json")
        assert np.allclose(found.rotation, ROTATION, atol=1e-6)
        # what it is good for, at once and loaded
        await judge_pose(way)
        for service, fields in (
            ("ExportCalibration", {"calibration_name": "table", "target_path": "copy.json"}),
            ("LoadCalibration", {"calibration_name_or_path": "exports/copy.json"}),
            ("LoadCalibration", {"calibration_name_or_path": "table"}),
        ):
            assert (await way.ask(service, **fields))["error"] == ""
        await judge_pose(way)
        await judge_names(way, tmp_path)


async def judge_pose(way: Face) -> None:
    header = {"frame_id": "anything"}
    answer = await way.ask("TransformPixelPose", header=header, x=0.1, y=0.2, theta=0.5)
    assert answer["error"] == ""
    pose = answer["pose"].get("pose", answer["pose"])  # PoseStamped of ROS; JSON as the thesis
    assert [pose["position"][one] for one in "xyz"] == pytest.approx(where(0.1, 0.2), abs=1e-7)
    assert answer["pose"]["header"]["frame_id"] == "robot"


def tree(folder: Path) -> list[str]:
    return sorted(str(one) for one in folder.rglob("*"))


async def judge_names(way: Face, folder: Path) -> None:
    """Nothing outside of the folder is read or written, whatever a client says."""
    secret = folder / "secret.json"
    secret.write_bytes((way.folder / "table.json").read_bytes())
    (way.folder / "link.json").symlink_to(secret)
    before = tree(folder)
    for bad in ("../secret", "../secret.json", str(secret), "link", "exports/../../secret.json"):
        answer = await way.ask("LoadCalibration", calibration_name_or_path=bad)
        assert answer["error"], bad
        for fields in (
            {"calibration_name": bad, "target_path": "out.json"},
            {"calibration_name": "table", "target_path": bad},
            {"calibration_name": "table", "target_path": f"{bad}.json"},
        ):
            assert (
                fields["target_path"] == "link.json"
                or ((await way.ask("ExportCalibration", **fields))["error"])
            ), fields
    assert (await way.ask(START, fixed_camera="True"))["error"] == ""
    await way.step()
    for bad in ("../secret", str(secret), "link", ""):
        assert (await way.ask(STEP, text_inputs=[bad, "SMARTCAMERA"]))["error"], bad
    assert (await way.step(abort=True))["header_text"] == "Aborted"
    assert "was aborted" in (await way.ask(STEP))["error"]
    assert tree(folder) == before


@pytest.mark.sampled(every=3)
@WITH_TF
async def test_a_plane_is_calibrated_by_the_tip_in_tf(face: Any, tmp_path: Path) -> None:
    bench = Bench()
    async with asyncio.timeout(PATIENCE), face(tmp_path) as way:
        start = {
            "topic_image2": "SMARTCAMERA",
            "tf_frame_robot_tcp": "tip",
            "tf_frame_robot_base": "base_link",
            "fixed_camera": "True",
        }
        assert (await way.ask(START, **start))["error"] == ""
        answer = await to_the_first_touch(way, "table", {})
        assert answer["descriptions_for_needed_values"] == []  # nobody types
        way.robot.moving = False  # the driver of the robot dies
        await asyncio.sleep(2.5)
        answer = await way.ask(STEP)
        assert "TF: base_link -> tip: the newest transform came" in answer["error"]
        way.robot.moving = True
        for mark in GRID:
            way.robot.tip = bench.touch(*mark)
            await asyncio.sleep(3 * PERIOD)
            answer = await way.step()
        await to_the_end(way, answer)
        found = PlaneCalibration.load(way.folder / "table.json")
        assert found.robot_frame == "base_link"
        assert np.allclose(found.origin, OFFSET, atol=1e-6)
        await judge_frames(way)


async def judge_frames(way: Face) -> None:
    """A pose is wanted in frames of TF."""
    for frame, offset in (("", 0.0), ("base_link", 0.0), ("world", 10.0)):
        asked = {"x": 0.1, "y": 0.2, "tf_frame_reference": frame}
        answer = await way.ask("TransformPixelPose", **asked)
        assert answer["error"] == "", frame
        assert answer["pose"]["header"]["frame_id"] == (frame or "base_link")
        x = answer["pose"].get("pose", answer["pose"])["position"]["x"]
        assert x == pytest.approx(where(0.1, 0.2)[0] + offset, abs=1e-7)
    answer = await way.ask("TransformPixelPose", x=0.1, y=0.2, tf_frame_reference="moon")
    assert "'moon'" in answer["error"]


@pytest.mark.long
@WITH_TF
async def test_a_camera_on_a_robot_is_calibrated_from_a_topic(face: Any, tmp_path: Path) -> None:
    async with asyncio.timeout(PATIENCE), face(tmp_path) as way:
        start = {
            "topic_image1": IMAGES,
            "checkerboard_squaresize_m": SHEET.square,
            "tf_frame_robot_tcp": "flange",
        }
        assert (await way.ask(START, **start))["error"] == ""
        answer = await way.step()
        answer = await way.step(text_inputs=["gripper"], option_inputs=["False"])
        assert answer["header_text"] == "Camera and robot"
        assert answer["default_needed_options"][0].split()[0] == "eye-in-hand"
        answer = await way.step(**defaults(answer))
        answer = await way.step(**defaults(answer, described="checkerboard"))
        size = [float(SHEET.columns), float(SHEET.rows), 1e3 * SHEET.square]
        assert answer["default_needed_values"] == [0.0, 0.0, pytest.approx(size[2])]
        mark = "yes" if SHEET.origin_mark else "no"
        answer = await way.step(value_inputs=size, option_inputs=[mark])
        answer = await way.step(**defaults(answer))
        for number in range(len(TRUTH.robot_poses)):
            assert answer["header_text"] == f"View {number + 1}"
            way.robot.view = number
            await asyncio.sleep(3 * PERIOD)
            answer = await way.step(**defaults(answer))
        answer = await way.step(**defaults(answer, view="calculate"))
        answer = await way.step()
        await to_the_end(way, answer)
        found = HandEyeCalibration.load(way.folder / "gripper.json")
        assert (found.camera_pose.target, len(found.views)) == ("flange", 8)
        assert TRUTH.errors(found.camera_pose)[1] < 1e-3


async def test_one_wizard_has_many_faces(tmp_path: Path) -> None:
    """A calibration that is begun in ROS goes on in JSON, with the tip in TF."""
    async with asyncio.timeout(PATIENCE), in_json_beside_ros(tmp_path) as way:
        place = f"tcp/127.0.0.1:{way.server.address.port}"
        async with Node("panel", connect=place) as panel:
            other = Ros2Face(way.server, panel)
            start = {"tf_frame_robot_tcp": "tip", "topic_image2": "SMARTCAMERA"}
            assert (await other.ask(START, **start))["error"] == ""
            answer = await to_the_first_touch(way, "table", {"option_inputs": ["True"]})
            assert answer["header_text"] == "Touch mark 1 of 9"
            assert (await other.step())["header_text"] == "Touch mark 2 of 9"
            assert (await way.step(abort=True))["header_text"] == "Aborted"


@pytest.mark.sampled(every=3)
@ALL
@pytest.mark.parametrize(
    ("frames", "error"),
    [("synthetic://?size=320x240&fps=10", "found none"), (None, "has no frames|sends no pictures")],
)
async def test_pictures_may_be_the_cameras_own(
    face: Any, frames: str | None, error: str, tmp_path: Path
) -> None:
    """No sheet is in this one's pictures, which says that one was looked at."""
    async with asyncio.timeout(PATIENCE), face(tmp_path, frames=frames) as way:
        start = {"topic_image2": "SMARTCAMERA", "fixed_camera": "False"}
        assert (await way.ask(START, **start))["error"] == ""
        answer = await way.step()
        while not answer["header_text"].startswith("View 1"):
            inputs = defaults(answer, described="checkerboard")
            if answer["header_text"] == "What is on it":
                inputs["value_inputs"] = [9.0, 6.0, 25.0]
            answer = await way.step(**inputs)
        inputs = {"value_inputs": [0.0] * 6}
        answer = await way.ask(STEP, **inputs)
        assert re.search(error, answer["error"]), answer["error"]
        assert answer["header_text"] == "View 1"


async def test_an_agent_without_a_folder_refuses_and_says_why(tmp_path: Path) -> None:
    async with asyncio.timeout(PATIENCE), in_json(tmp_path, calibrations=None) as way:
        answer = await way.ask(START)
        assert "calibrations: FOLDER in the fleet file" in answer["error"]
        assert answer["kind"] == "ConfigurationError"
        assert not way.folder.exists()


async def test_topics_and_frames_are_refused_without_ros(tmp_path: Path) -> None:
    async with asyncio.timeout(PATIENCE), in_json(tmp_path) as way:
        for fields in ({"topic_image1": "/image"}, {"tf_frame_robot_tcp": "tip"}):
            answer = await way.ask(START, **fields)
            assert "this camera is not seen in ROS" in answer["error"]
            assert answer["kind"] == smartcam.CalibrationError.__name__
        answer = await way.ask("TransformPixelPose", x=0.0, y=0.0)
        assert (answer["kind"], answer["pose"]) == ("CalibrationError", None)
