"""A camera's node: its topics and services, its parameters, and its end."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from typing import Any, NamedTuple

import pytest

import smartcam
from smartcam.exceptions import ConfigurationError, RosError, SmartCamError
from smartcam.ros2 import CameraNode, CameraNodeOptions, Node
from smartcam.ros2._inside import LATCHED, OK
from smartcam.settings import CameraSettings
from tests.fleet.fleetkit import Plant
from tests.processes import free_place
from tests.ros2.inside import RosParameters
from tests.ros2.nodekit import COUNTER, FAST, NAME, OTHER, NotedNode, away, box, seen, until
from tests.ros2.roskit import make_node, soon, way

ERROR, STALE = 2, 3
"""Levels of ``diagnostic_msgs/msg/DiagnosticStatus``."""

FULL = f"/{NAME}"
LIFE = "lifecycle_msgs/srv/"

__all__ = ["way"]  # the fixture

BOTH_WAYS = pytest.mark.usefixtures("way")
"""Mark of tests that run with smartcam's own wire format, and through rclpy."""

# ---------------------------------------------------------------------- as others see it


class Meeting(NamedTuple):
    """A camera in ROS, and a node of somebody else, who listens at ``place``."""

    place: str
    box: Any
    camera: Any
    seen: CameraNode
    viewer: Any

    async def call(self, name: str, kind: str, **fields: Any) -> Any:
        client = self.viewer.client(f"{FULL}/{name}", kind)
        try:
            return await client.call(fields, timeout=60)
        finally:
            client.close()

    async def lose(self, seconds: float) -> None:
        """Have the camera away for so long."""
        self.box.inject({"kind": "refuse", "seconds": seconds}, {"kind": "close"})
        with pytest.raises(SmartCamError):
            await self.camera.query_application()

    async def state(self) -> str:
        reply = await self.call("get_state", f"{LIFE}GetState")
        return str(reply.current_state.label)

    async def change(self, label: str) -> bool:
        reply = await self.call("change_state", f"{LIFE}ChangeState", transition={"label": label})
        return bool(reply.success)


@contextlib.asynccontextmanager
async def meeting(**options: Any) -> AsyncIterator[Meeting]:
    place = free_place()
    async with box() as emulated, smartcam.connect(emulated.url, name=NAME, reconnect=FAST) as one:
        node = make_node("cam3", place, namespace="/line1")
        made = CameraNode(one, node, options=CameraNodeOptions(**options))
        viewer = make_node("viewer", place, listens=True)
        async with viewer, made:
            await until(lambda: FULL in viewer.graph.nodes())
            yield Meeting(place, emulated, one, made, viewer)


@BOTH_WAYS
@pytest.mark.real_time
async def test_others_see_and_command_it() -> None:
    async with meeting() as one:
        viewer = one.viewer
        statuses = viewer.subscribe(f"{FULL}/status", "smartcam_msgs/msg/CameraStatus", qos=LATCHED)
        diagnostics = viewer.subscribe("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        events = viewer.subscribe(f"{FULL}/transition_event", "lifecycle_msgs/msg/TransitionEvent")
        assert (await soon(anext(statuses))).ready  # said before it was asked for
        (found,) = (await soon(anext(diagnostics))).status
        assert (found.level, found.name) == (OK, f"{NAME}: camera")
        await until(lambda: one.seen.lifecycle.active)
        assert await one.state() == "active"
        assert await one.change("deactivate")
        assert not await one.change("deactivate")
        assert await one.state() == "inactive"
        while (event := await soon(anext(events))).goal_state.label != "inactive":
            pass
        assert event.transition.id in {0, 10, 40}  # ROS' own machine leaves it out
        one.box.inject({"kind": "condition", "condition": "system_error"})
        while not (status := await soon(anext(statuses))).error:
            pass
        assert status.status_names[0] == "SYSTEM_ERROR"
        while (found := (await soon(anext(diagnostics))).status[0]).level != ERROR:
            pass
        assert "System Error" in found.message


@BOTH_WAYS
@pytest.mark.real_time
async def test_parameters_are_those_of_the_file() -> None:
    async with meeting(frame_id="cell") as one:
        kind = "rcl_interfaces/srv/"
        names = ["url", "application", "frame_id", "connect_timeout"]
        values = (await one.call("get_parameters", f"{kind}GetParameters", names=names)).values
        assert values[0].string_value == one.camera.url
        assert (values[1].integer_value, values[2].string_value) == (COUNTER, "cell")
        assert values[3].double_value == 10.0
        wanted = {"name": "application", "value": {"type": 2, "integer_value": OTHER}}
        reply = await one.call("set_parameters", f"{kind}SetParameters", parameters=[wanted])
        assert reply.results[0].successful
        assert one.camera.active_application == OTHER
        wanted["value"] = {"type": 2, "integer_value": 99}
        reply = await one.call("set_parameters", f"{kind}SetParameters", parameters=[wanted])
        assert not reply.results[0].successful
        assert "99" in reply.results[0].reason


@BOTH_WAYS
@pytest.mark.real_time
async def test_nothing_of_it_stays_in_the_graph() -> None:
    async with meeting() as one:
        assert await one.state()
        graph = one.viewer.graph
        services = [name for name in graph.services() if name.startswith(f"{FULL}/")]
        assert len(services) > 10
        await one.seen.stop()
        await until(lambda: FULL not in graph.nodes())
        assert not [name for name in graph.services() if name.startswith(f"{FULL}/")]
        await one.seen.stop()
        assert one.camera.connected
        again = make_node("cam3", one.place, namespace="/line1")
        async with CameraNode(one.camera, again) as made:
            await until(lambda: made.lifecycle.active)
            assert await one.state() == "active"
        await until(lambda: FULL not in graph.nodes())


@pytest.mark.real_time
async def test_a_client_that_is_gone_in_the_middle_of_a_transition() -> None:
    async with meeting(autostart=False) as one:
        await one.lose(60.0)
        client = one.viewer.client(f"{FULL}/change_state", f"{LIFE}ChangeState")
        asking = asyncio.create_task(client.call(transition={"label": "configure"}, timeout=60))
        await until(lambda: one.seen.lifecycle.state.label == "configuring")
        client.close()
        with pytest.raises(SmartCamError):
            await asking
        one.box.clear_faults()
        assert await one.change("activate")  # it waited for the camera, and for its turn
        assert await one.state() == "active"


@BOTH_WAYS
@pytest.mark.real_time
async def test_closing_in_the_middle_of_a_transition() -> None:
    async with meeting(autostart=False) as one:
        await one.lose(60.0)
        asking = asyncio.create_task(one.change("configure"))
        await until(lambda: one.seen.lifecycle.state.label == "configuring")
        await one.seen.stop()
        assert not await asking
        await until(lambda: FULL not in one.viewer.graph.nodes())


def _is_active(made: CameraNode) -> Callable[[], bool]:
    return lambda: made.lifecycle.active


@pytest.mark.long
@pytest.mark.real_time
async def test_nodes_come_and_go_while_others_call_and_listen() -> None:
    """Objects on the engine's threads end, whatever they are doing."""
    place = free_place()
    status = "smartcam_msgs/msg/CameraStatus"
    async with (
        box() as emulated,
        smartcam.connect(emulated.url, name=NAME, reconnect=FAST) as camera,
        Node("viewer", listen=place, domain=7) as viewer,
        Node("anchor", connect=place, domain=7) as anchor,
    ):
        state = viewer.client(f"{FULL}/get_state", f"{LIFE}GetState")
        answers = 0

        async def ask() -> None:
            nonlocal answers
            while True:
                with contextlib.suppress(SmartCamError):
                    await state.call(timeout=1.0)
                    answers += 1

        asking = [asyncio.create_task(ask()) for _ in range(4)]
        for number in range(60):
            node = Node("cam3", namespace="/line1", context=anchor.context)
            async with CameraNode(camera, node) as made:
                statuses = viewer.subscribe(f"{FULL}/status", status, qos=LATCHED)
                assert (await soon(anext(statuses))).connected
                statuses.close()
                await until(_is_active(made))
                await asyncio.sleep(0.01 * (number % 7))
            await until(lambda: not viewer.graph.of_node(FULL))
        for task in asking:
            task.cancel()
        await asyncio.wait(asking)
        assert answers > 60
        await until(lambda: viewer.graph.nodes() == ["/anchor", "/viewer"])


# ---------------------------------------------------------------------- parameters


@contextlib.asynccontextmanager
async def with_parameters(**options: Any) -> AsyncIterator[tuple[Any, RosParameters]]:
    node = NotedNode()
    node.parameters = RosParameters(node, served=False)
    async with seen(node=node, **options) as one:
        yield one, node.parameters
    assert node.parameters.names() == ["use_sim_time"]  # it takes back its own


async def test_what_is_read_only_cannot_be_set() -> None:
    parameters = {"video_device": "v4l2:///dev/video0"}
    async with with_parameters(video_parameters=parameters) as (_, found):
        settable = {"application", "diagnostics_period", "use_sim_time"}
        assert settable < set(found.names())
        for name in set(found.names()) - settable:
            assert found.describe(name).description
            with pytest.raises(ConfigurationError, match="read-only"):
                await found.set(name, found.get(name))
        assert found.get("video_device") == "v4l2:///dev/video0"
        assert found.get("interpret_as") == "n: int32"


async def test_application_follows_the_camera_and_leads_it() -> None:
    async with with_parameters() as (one, found):
        await found.set("application", OTHER)
        assert (one.camera.active_application, found.get("application")) == (OTHER, OTHER)
        assert smartcam.Status.BUSY not in one.camera.status
        one.box.inject({"kind": "switch_application", "application": COUNTER})
        await until(lambda: found.get("application") == COUNTER)
        for wrong, why in [(99, "99"), (-1, "range|0 to"), ("x", "integer")]:
            with pytest.raises(SmartCamError, match=why):
                await found.set("application", wrong)
        assert one.camera.active_application == COUNTER
        sent = one.camera.statistics().frames_sent
        await found.set("application", COUNTER)
        assert one.camera.statistics().frames_sent - sent <= 2  # it is not stopped for that
        one.box.inject({"kind": "refuse", "seconds": 5}, {"kind": "close"})
        await until(lambda: found.get("application") == 0)
        with pytest.raises(SmartCamError, match=r"closed the connection|refused"):
            await found.set("application", OTHER)
        await until(lambda: found.get("application") == COUNTER)


async def test_a_switch_that_does_not_end_is_refused_in_time() -> None:
    async with with_parameters(client={"switch_timeout": 60.0}) as (one, found):
        one.box.inject({"kind": "busy_for_ever"})
        begun = asyncio.get_running_loop().time()
        with pytest.raises(smartcam.ResponseTimeoutError, match="BUSY"):
            await found.set("application", OTHER)
        assert asyncio.get_running_loop().time() - begun < 10.0
        await until(lambda: found.get("application") == one.camera.active_application)


async def test_the_period_of_diagnostics_can_be_set() -> None:
    async with with_parameters() as (one, found):
        said = one.node.topics["/diagnostics"].said
        await found.set("diagnostics_period", 0.5)
        before = len(said)
        await asyncio.sleep(2.1)
        assert len(said) - before in {4, 5}
        with pytest.raises(ConfigurationError):
            await found.set("diagnostics_period", 0.0)


async def test_the_agent_s_settings_are_those_that_are_shown() -> None:
    url = "insight://admin:secret@10.0.0.7?x=1".partition("?")[0]
    settings = CameraSettings.make(url, None, {"interpret_as": {7: "n: int32"}, "y_down": True})
    async with with_parameters(settings=settings) as (one, found):
        assert found.get("url").startswith("insight://admin@10.0.0.7:")
        assert "secret" not in "".join(str(found.get(name)) for name in found.names())
        assert found.get("interpret_as") == '{"7": "n: int32"}'
        assert found.get("y_down") is True
        assert one.node.last("/diagnostics").status[0].hardware_id.startswith("10.0.0.7:")


# ---------------------------------------------------------------------- how it begins and ends


def test_options_that_cannot_be() -> None:
    for wrong in [{"diagnostics_period": 0.0}, {"status_rate": float("nan")}]:
        with pytest.raises(ConfigurationError, match=next(iter(wrong))):
            CameraNodeOptions(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("refuses", ["~/status", "/diagnostics", "~/transition_event"])
async def test_a_part_that_does_not_start_undoes_the_others(refuses: str) -> None:
    async with box() as emulated, smartcam.connect(emulated.url, name=NAME) as camera:
        node = NotedNode()
        node.parameters = RosParameters(node, served=False)
        node.refuses = refuses
        made = CameraNode(camera, node)
        with pytest.raises(RosError, match="refused"):
            await made.start()
        assert (node.open, node.still_declared) == (False, [])
        assert node.parameters.names() == ["use_sim_time"]
        node.refuses = ""
        async with made:
            await until(lambda: made.lifecycle.active)
            assert node.open


async def test_it_can_be_cancelled_and_closed_at_any_moment() -> None:
    async with box() as emulated, smartcam.connect(emulated.url, name=NAME) as camera:
        for turns in range(40):
            node = NotedNode()
            made = CameraNode(camera, node, options=CameraNodeOptions(application=OTHER))
            starting = asyncio.create_task(made.start())
            for _ in range(turns):
                await asyncio.sleep(0)
            starting.cancel()
            await asyncio.wait((starting,))
            stopping = asyncio.create_task(made.stop())
            for _ in range(turns % 5):
                await asyncio.sleep(0)
            stopping.cancel()
            await asyncio.wait((stopping,))
            await made.stop()
            assert (node.open, node.still_declared) == (False, [])
            assert camera.connected


async def test_closing_waits_for_what_is_being_opened() -> None:
    async with box() as emulated, smartcam.connect(emulated.url, name=NAME) as camera:
        node = NotedNode()
        made = CameraNode(camera, node)
        await asyncio.gather(made.start(), made.start(), made.stop())
        assert (node.open, node.still_declared) == (False, [])


async def test_a_camera_of_a_fleet_whose_agent_goes_and_comes() -> None:
    async with Plant() as plant, plant.camera() as camera:
        node = NotedNode()
        options = CameraNodeOptions(is_agent_alive=lambda: camera._caller.agent is not None)
        async with CameraNode(camera, node, options=options) as made:
            await until(lambda: made.lifecycle.active)
            assert node.last("~/status").ready
            await plant.stop_agent()
            await until(lambda: node.last("/diagnostics").status[0].level == STALE)
            assert "agent" in node.last("/diagnostics").status[0].message
            assert not node.last("~/status").connected
            await plant.start_agent()
            await until(lambda: node.last("~/status").ready)
            await until(lambda: node.last("/diagnostics").status[0].level == OK)
            assert made.lifecycle.active
            await plant.box.stop()
            await until(lambda: node.last("/diagnostics").status[0].level == ERROR)
            await plant.box.start()
            await until(lambda: node.last("~/status").ready)


async def test_an_application_waits_for_who_has_reserved_the_camera() -> None:
    async with Plant() as plant, plant.cameras(2, switch_timeout=1.0) as (ours, theirs):
        made = CameraNode(ours, NotedNode(), options=CameraNodeOptions(application=1))
        async with theirs.reserve():
            await theirs.switch_application(2)
            await made.start()
            await asyncio.sleep(30)
            with pytest.raises(smartcam.ResponseTimeoutError, match="reserved"):
                await made.lifecycle.configure()
            assert made.lifecycle.state.label == "unconfigured"
            assert await theirs.query_application() == 2
        await made.lifecycle.configure()
        assert ours.active_application == 1
        await made.stop()


async def test_a_node_does_not_disconnect_other_programs() -> None:
    async with Plant() as plant, plant.cameras(2) as (ours, theirs):
        made = CameraNode(ours, NotedNode())
        async with made:
            await until(lambda: made.lifecycle.active)
            for label in ("deactivate", "cleanup", "configure", "activate", "shutdown"):
                await made.lifecycle.change(label)
            assert (await theirs.trigger()).value["run"] == 1
        assert theirs.statistics().reconnects == 0
        assert (await theirs.trigger()).value["run"] == 2


async def test_behind_a_rosbridge_it_has_no_parameters_and_no_life_cycle_s_services() -> None:
    async with seen(node=NotedNode(ros1=True)) as one:
        await until(lambda: one.seen.lifecycle.active)
        assert one.node.last("~/status").ready
        assert one.node.last("/diagnostics").status[0].level == OK
    async with away(5) as one:
        assert one.node.last("/diagnostics").status[0].level == ERROR
