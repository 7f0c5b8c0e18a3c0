"""Cameras of a fleet as nodes of ROS 2, on the fleet's own session."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import smartcam
import smartcam.fleet
from smartcam.calibration import fit_plane
from smartcam.emulator import Application, EmulatedCamera
from smartcam.exceptions import ConfigurationError
from smartcam.fleet import FleetFile, load_fleet
from smartcam.fleet._inside import FleetAddress, RosSection, ros_of
from smartcam.ros2 import Node, QoS
from smartcam.ros2._inside import LATCHED
from tests.processes import free_place
from tests.ros2.roskit import PATIENCE, TRIGGER, called, peer, router, soon, until
from tests.ros2.tfkit import TransformTree

pytestmark = pytest.mark.real_time

ROOT = Path(__file__).parents[2]

EMULATED = {"emulated": {}, "application": 7, "interpret_as": "localizations"}
STATUS = "smartcam_msgs/msg/CameraStatus"
LOCALIZE = "smartcam_msgs/srv/TriggerLocalization"
POSES = "geometry_msgs/msg/PoseArray"


def plant(place: str, cameras: dict[str, Any], **more: Any) -> FleetFile:
    return FleetFile.model_validate({"listen": place, "cameras": cameras, "ros2": {}, **more})


async def test_a_plant_is_seen_and_used_from_ros() -> None:
    place = free_place()
    file = plant(place, {"line-1/**": {**EMULATED, "emulated": {"count": 2}}}, ros2={"domain": 9})
    async with (
        smartcam.fleet.serve(file) as server,
        Node("viewer", connect=place, domain=9) as viewer,
    ):
        names = ["/line_1/cam1", "/line_1/cam2"]
        assert server.ros_nodes == names
        await until(lambda: viewer.graph.nodes() == [*names, "/viewer"])

        status = viewer.subscribe(
            "/line_1/cam2/status", "smartcam_msgs/msg/CameraStatus", qos=LATCHED
        )
        async with asyncio.timeout(PATIENCE):
            async for said in status:
                if said.ready and said.application_id == 7:
                    break
        assert said.camera_name == "line-1/cam2"

        state = viewer.client("/line_1/cam2/get_state", "lifecycle_msgs/srv/GetState")
        async with asyncio.timeout(PATIENCE):
            while (await state.call()).current_state.label != "active":  # noqa: ASYNC110
                await asyncio.sleep(0.02)

        poses = viewer.subscribe("/line_1/cam2/localizations", POSES, qos=QoS(depth=5))
        others = viewer.subscribe("/line_1/cam1/localizations", POSES, qos=QoS(depth=5))
        publishers = {one.node.full_name: one for one in server._ros.nodes.values()}  # type: ignore[union-attr]
        heard = [one.results._publishers["localizations"] for one in publishers.values()]
        await until(lambda: all(one.has_subscribers for one in heard))
        direct: Any = smartcam.connect(server.urls["line-1/cam2"])
        async with direct as camera:
            result = await camera.trigger()
            message = await soon(anext(poses))
            assert message.header.frame_id == "line_1_cam2"
            assert [(one.position.x, one.position.y) for one in message.poses] == [
                pytest.approx((one.pose.position.x, one.pose.position.y)) for one in result.value
            ]
        assert not others.statistics().offered

        calls = viewer.client("/line_1/cam1/trigger", TRIGGER)
        reply = await soon(calls.call(timeout=PATIENCE))
        assert reply.success, reply.message
        assert len((await soon(anext(others))).poses) >= 1
    assert server.ros_nodes == []


async def test_the_frames_that_a_file_names_are_those_that_tf_knows(tmp_path: Path) -> None:
    seen = np.array([[0, 0], [0.1, 0], [0, 0.1], [0.1, 0.1]])
    touched = np.column_stack([seen, np.zeros(4)]) + np.array([0.4, 0.1, 0])
    fit_plane(seen, touched, model="similarity").save(tmp_path / "plane.json")
    place, path = free_place(), tmp_path / "plant.yaml"
    path.write_text(
        f"listen: {place}\nros2: {{domain: 9}}\ncameras:\n  line-1/cam:\n    emulated: {{}}\n"
        "    application: 7\n    interpret_as: localizations\n    frames: synthetic://\n"
        "    ros2: {frame_id: cam_plane, parent_frame: base_link, calibration: plane.json}\n"
    )
    tree = TransformTree()
    async with (
        smartcam.fleet.serve(path),
        Node("viewer", connect=place, domain=9) as viewer,
    ):
        frames = viewer.subscribe("/tf_static", "tf2_msgs/msg/TFMessage", qos=LATCHED)
        tree.hear(await soon(anext(frames)))
        trigger = viewer.client("/line_1/cam/TriggerLocalization", LOCALIZE)
        reply = await soon(trigger.call(timeout=PATIENCE))
        assert reply.error == ""
        assert reply.localizations
        for one in reply.localizations:
            assert one.pose.header.frame_id == "base_link"
            tree.lookup("cam_plane", one.pose.header.frame_id)
        picture = viewer.subscribe("/line_1/cam/image_raw", "sensor_msgs/msg/Image")
        assert (await soon(anext(picture))).header.frame_id == "cam_plane_optical"


async def test_nodes_go_on_without_the_router_that_they_connect_to() -> None:
    place = free_place()
    file = FleetFile.model_validate(
        {"connect": place, "cameras": {"cam": EMULATED}, "ros2": {"domain": 9}}
    )
    async with contextlib.AsyncExitStack() as stack:
        with router(place):
            await stack.enter_async_context(smartcam.fleet.serve(file))
            viewer = stack.enter_context(peer(place))
            assert (await called(viewer, 9, "/cam/trigger")).success
        # the router is gone
        assert (await called(viewer, 9, "/cam/trigger")).success
        with router(place), peer(place) as later:
            assert (await called(later, 9, "/cam/trigger")).success


async def test_nodes_begin_without_the_router_that_they_connect_to(
    caplog: pytest.LogCaptureFixture,
) -> None:
    place = free_place()
    file = FleetFile.model_validate(
        {"connect": place, "cameras": {"cam": EMULATED}, "ros2": {"domain": 9}}
    )
    async with smartcam.fleet.serve(file) as server:
        assert server.ros_nodes == ["/cam"]
        assert "no router at" in caplog.text
        with router(place), peer(place) as viewer:
            assert (await called(viewer, 9, "/cam/trigger")).success


@pytest.mark.parametrize(
    ("section", "entry", "runs"),
    [({}, {}, True), ({}, {"restore": False}, False), ({"autostart": False}, {}, False)],
)
async def test_an_application_runs_again_after_its_camera_restarts(
    section: dict[str, Any], entry: dict[str, Any], runs: bool
) -> None:
    place = free_place()
    application = Application(id=7, layout="n: int32", cycle=[{"n": 1}], load_time=0.01)
    async with EmulatedCamera([application], builtins=False, quirks={"reboot_time": 0.3}) as box:
        camera = {"url": box.url, "application": 7, "interpret_as": "n: int32", **entry}
        async with (
            smartcam.fleet.serve(plant(place, {"cam": camera}, ros2=section)) as server,
            Node("viewer", connect=place) as viewer,
        ):
            await server.wait_first_attempts()
            heard = viewer.subscribe("/cam/status", STATUS, qos=LATCHED)
            await wait_for(heard, lambda one: one.running)
            assert (await soon(viewer.client("/cam/reboot", TRIGGER).call())).success
            await wait_for(heard, lambda one: not one.connected)
            if runs:
                await wait_for(heard, lambda one: one.connected)
                await until(lambda: box.device.running)
            else:
                await wait_for(heard, lambda one: one.connected and not one.running)
                await asyncio.sleep(0.3)
                assert not box.device.running
            restores = await viewer.parameters_of("/cam").get("restore")
            assert restores == {"restore": runs}


async def wait_for(heard: Any, fits: Callable[[Any], bool]) -> Any:
    """Return the next message that fits."""
    while not fits(said := await soon(anext(heard))):
        pass
    return said


def test_a_calibration_of_ours_is_no_camera_info_that_ros_may_write(tmp_path: Path) -> None:
    (tmp_path / "ours.json").write_text('{"kind": "lens"}')
    (tmp_path / "ros.yaml").write_text("image_width: 640")
    urls = []
    for name in ("ours.json", "ros.yaml", "later.yaml"):
        frames = {"url": "synthetic://", "camera_info": name}
        file = FleetFile.model_validate({"cameras": {"cam": {"emulated": {}, "frames": frames}}})
        entry = file.cameras["cam"].frames
        assert entry is not None
        urls.append(entry.camera_info_url(tmp_path))
    assert urls == ["", *((tmp_path / one).as_uri() for one in ("ros.yaml", "later.yaml"))]


async def test_a_node_goes_with_its_agent_and_comes_with_it() -> None:
    place, other = free_place(), free_place()
    async with Node("viewer", listen=place) as viewer:
        for _ in range(2):
            file = FleetFile.model_validate(
                {"connect": place, "listen": other, "cameras": {"cam": EMULATED}, "ros2": {}}
            )
            async with smartcam.fleet.serve(file):
                await until(lambda: "/cam" in viewer.graph.nodes())
                await until(lambda: "/cam/trigger" in viewer.graph.services())
                assert viewer.graph.services()["/cam/trigger"] == [TRIGGER]
            await until(lambda: viewer.graph.nodes() == ["/viewer"])
            await until(lambda: "/cam/trigger" not in viewer.graph.services())


async def test_a_fleet_that_is_served_already_is_seen_by_its_url() -> None:
    place = free_place()
    file = FleetFile.model_validate({"listen": place, "cameras": {"line1/cam": EMULATED}})
    async with smartcam.fleet.serve(file) as server:
        assert server.ros_nodes == []
        address = FleetAddress.parse(f"fleet://{place.partition('/')[2]}")
        given = {"domain": 3, "namespace": "plant", "autostart": False}
        section = RosSection.model_validate(given)
        async with (
            ros_of(address, section) as ros,
            Node("viewer", connect=place, domain=3) as viewer,
        ):
            assert ros.names == ["/plant/line1/cam"]
            state = viewer.client("/plant/line1/cam/get_state", "lifecycle_msgs/srv/GetState")
            reply = await soon(state.call(timeout=PATIENCE))
            assert reply.current_state.label == "unconfigured"
            file = FleetFile.model_validate(
                {"connect": place, "agent": "late", "cameras": {"line2/cam": EMULATED}}
            )
            async with smartcam.fleet.serve(file):
                await until(lambda: "/plant/line2/cam" in viewer.graph.nodes())


async def test_in_one_process_there_is_no_ros() -> None:
    file = plant("tcp/127.0.0.1:0", {"cam": EMULATED})
    async with smartcam.fleet.open(file) as fleet:
        assert [camera.name for camera in fleet] == ["cam"]


WRONG = {
    "cameras: a-b and a_b would both be /a_b in ROS": "ros2: {}\ncameras: {a-b: E, a_b: E}",
    "ros2.domain": "ros2: {domain: -1}\ncameras: {a: E}",
    "ros2.distribution": "ros2: {distribution: foxy}\ncameras: {a: E}",
    "ros2.namespace": "ros2: {namespace: 1x}\ncameras: {a: E}",
    "cameras.a.ros2.calibration": "cameras: {a: {emulated: {}, ros2: {calibration: none.json}}}",
    "cameras.a.ros2.frame": "cameras: {a: {emulated: {}, ros2: {frame: x}}}",
}


@pytest.mark.parametrize(("text", "file"), WRONG.items())
def test_a_wrong_file_is_told(text: str, file: str, tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(file.replace("E", "{emulated: {}}"))
    with pytest.raises(ConfigurationError) as told:
        load_fleet(path)
    assert text in str(told.value).replace(" > ", ".")


def rows(page: str) -> dict[str, str]:
    """Return what the page's tables of topics and services say: a type by each name."""
    found: dict[str, str] = {}
    for line in page.splitlines():
        cells = [cell.strip() for cell in line.split("|")]
        if len(cells) == 5 and "`" in cells[1] and ("/msg/" in cells[2] or "/srv/" in cells[2]):
            names = cells[1].replace("`", "").split(", ")
            types = cells[2].replace("`", "").split(", ")
            for n, name in enumerate(names):
                found[name] = types[min(n, len(types) - 1)]
    return found


async def test_the_page_has_what_a_node_has() -> None:
    place = free_place()
    frames = {**EMULATED, "frames": "synthetic://?size=320x240&fps=5"}
    async with (
        smartcam.fleet.serve(plant(place, {"line1/cam3": frames})),
        Node("viewer", connect=place, parameters=False) as viewer,
    ):
        said = rows((ROOT / "docs" / "ros2.md").read_text(encoding="utf-8"))
        own = "/line1/cam3/"

        def there() -> dict[str, list[str]]:
            both = {**viewer.graph.topics(), **viewer.graph.services()}
            return {name.removeprefix(own): types for name, types in both.items()}

        await until(lambda: len(there()) >= len(said) - 1)
        found = there()
        assert set(said) - set(found) == {"/tf_static"}
        for name, (type,) in found.items():
            package = said[name].removesuffix("...")
            assert type.startswith(package) or type.endswith(f"/{package}"), (name, type)
