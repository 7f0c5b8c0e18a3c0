"""Services of a camera's node, and their errors."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from typing import Any

import pytest

import smartcam
from smartcam import Camera, Status
from smartcam.exceptions import RosError
from smartcam.ros2 import Node
from smartcam.ros2._cameras.services import CameraServices
from smartcam.ros2._inside import LATCHED, RESULT
from tests.fleet.fleetkit import Plant, until
from tests.processes import free_place
from tests.ros2.camerakit import (
    BOTH,
    BROKEN,
    PARTS,
    PIXELS,
    READ_AS,
    RUNNING,
    TEXTS,
    Life,
    PaperNode,
    PartsCamera,
    paper_or_rclpy,
)
from tests.ros2.inside import CameraResults

pytestmark = pytest.mark.through_rclpy


@contextlib.asynccontextmanager
async def parts(camera: Camera[Any], node: Any, life: Any = None) -> AsyncIterator[CameraServices]:
    """The services of a camera at a node, with its results."""
    results = CameraResults(camera, node)
    results.start()
    services = CameraServices(camera, node, results, life or Life("active"))
    services.start()
    try:
        yield services
    finally:
        await services.close()
        await results.close()


@contextlib.asynccontextmanager
async def served(
    box: PartsCamera | None = None, life: Any = None, **options: Any
) -> AsyncIterator[tuple[PartsCamera, Camera[Any], PaperNode]]:
    """A camera that is served on paper."""
    options.setdefault("interpret_as", READ_AS)
    made = box or PartsCamera()
    async with (
        paper_or_rclpy() as node,
        made,
        smartcam.connect(made.url, name="line1/cam3", **options) as camera,
        parts(camera, node, life),
    ):
        yield made, camera, node


class Robot:
    """A calibration to a robot that sees what the camera sees."""

    def to_robot(self, parts: Any) -> Any:
        return list(parts)


# ---------------------------------------------------------------------- triggers


async def test_localizations_are_those_that_a_direct_client_gets() -> None:
    async with served() as (box, camera, node):
        results = camera.results()
        reply = await node.call("TriggerLocalization", camera_name="line1/cam3")
        got = await anext(results)
        assert (reply.error, box.runs) == ("", 1)
        for said, one in zip(reply.localizations, got.value, strict=True):
            position, turn = said.pose.pose.position, said.pose.pose.orientation
            assert (position.x, position.y, position.z) == one.pose.position
            assert (turn.x, turn.y, turn.z, turn.w) == one.pose.orientation
            assert (said.feature_id, said.quality) == (one.feature_id, one.quality)
            assert said.photo_index == one.photo_index
            assert said.pose.header.frame_id == "line1/cam3"


async def test_trigger_of_another_application_goes_back() -> None:
    async with served() as (_, camera, node):
        reply = await node.call("Trigger50ByteString", application_id=TEXTS, timeout=5.0)
        assert (reply.error, reply.strings) == ("", ["one", "two"])
        await until(lambda: camera.active_application == PARTS)
        reply = await node.call("TriggerLocalization")
        assert [one.feature_id for one in reply.localizations] == ["run1", "run1"]


async def test_trigger_reads_localizations_where_nothing_else_is_said() -> None:
    async with served(interpret_as=None) as (_, _, node):
        reply = await node.call("TriggerLocalization")
        assert [one.photo_index for one in reply.localizations] == [0, 1]


async def test_std_trigger_says_the_result_as_json() -> None:
    async with served() as (_, camera, node):
        results = camera.results()
        reply = await node.call("trigger")
        said, got = json.loads(reply.message), await anext(results)
        assert reply.success
        assert (said["application"], said["raw"]) == (PARTS, got.raw.hex())
        assert said["value"][0]["feature_id"] == "run1"


async def test_typed_trigger_has_any_kind_of_result() -> None:
    async with served() as (_, _, node):
        reply = await node.call("trigger_results", application_id=TEXTS)
        assert [(one.json, one.error) for one in reply.results] == [('["one","two"]', "")]
        reply = await node.call("trigger_results", interpret_as="Localizations", timeout=3.0)
        assert [one.feature_id for one in reply.results[0].localizations] == ["run1", "run1"]
        reply = await node.call("trigger_results", interpret_as="raw")
        (raw,) = reply.results
        assert (bytes(raw.data)[:4], raw.json, raw.localizations) == (b"run2", "", [])
        reply = await node.call("trigger_results", results_per_trigger=2, timeout=0.5)
        assert "0.5 s" in reply.error


async def test_each_call_has_its_result_published_once() -> None:
    async with served() as (_, camera, node):
        await node.call("TriggerLocalization")
        await node.call("trigger")
        await node.call("trigger_results")
        await until(lambda: len(node.said("results")) == 3)
        got = [one.localizations[0].feature_id for one in node.said("results")]
        assert (got, len(node.said("detections"))) == (["run1", "run2", "run3"], 3)
        assert camera.statistics().received == 3


async def test_two_callers_each_have_a_run_of_their_own() -> None:
    async with served() as (box, _, node):
        replies = await asyncio.gather(*(node.call("TriggerLocalization") for _ in range(8)))
        found = [one.localizations[0].feature_id for one in replies]
        assert sorted(found) == [f"run{number}" for number in range(1, 9)]
        assert box.runs == 8


# ---------------------------------------------------------------------- what goes wrong


@pytest.mark.parametrize("name", ["line1/cam4", "/line2/cam3", "cam", "\u00fc"])
async def test_name_of_another_camera_is_an_error(name: str) -> None:
    life = Life()
    async with served(life=life) as (box, _, node):
        services = ("TriggerLocalization", "ChangeApplication", "SmartcameraSetup")
        for service in (*services, "SmartcameraStop"):
            reply = await node.call(service, camera_name=name)
            assert "this is the node of 'line1/cam3'" in reply.error
        assert (box.runs, life.asked) == (0, [])


@pytest.mark.parametrize("name", ["", "line1/cam3", "/line1/cam3", "cam3"])
async def test_names_of_this_camera(name: str) -> None:
    async with served() as (_, _, node):
        assert (await node.call("TriggerLocalization", camera_name=name)).error == ""


@pytest.mark.parametrize(
    ("service", "fields", "text"),
    [
        ("TriggerLocalization", {"application_id": 77}, "77"),
        ("Trigger50ByteString", {"application_id": 77}, "77"),
        ("ChangeApplication", {"application_id": 77}, "77"),
        ("ChangeApplication", {}, "application_id"),
        ("trigger_results", {"application_id": 77}, "77"),
        ("TriggerLocalization", {"timeout": -1.0}, "timeout"),
        ("TriggerLocalization", {"timeout": float("nan")}, "timeout"),
        ("Trigger50ByteString", {"timeout": 1e9}, "timeout"),
        ("TriggerLocalization", {"application_id": TEXTS}, "expected 50 bytes, got 30"),
        ("TriggerLocalization", {"application_id": BROKEN}, "expected 50 bytes, got 9"),
        ("TriggerLocalization", {"application_id": PIXELS}, "localizations in metres"),
        ("Trigger50ByteString", {}, "offset"),
        ("trigger_results", {"interpret_as": READ_AS[PIXELS]}, "got pixels"),
        ("trigger_results", {"interpret_as": "no such layout"}, "no such layout"),
        ("trigger_results", {"interpret_as": "x" * 20_000}, "expected 10000 at most"),
        ("trigger_results", {"results_per_trigger": 9999}, "expected 1000 at most"),
        ("trigger_results", {"input": bytes(70_000)}, "expected 65536 at most"),
    ],
)
async def test_errors_stand_in_the_field_and_the_camera_goes_on(
    service: str, fields: dict[str, Any], text: str
) -> None:
    async with served() as (_, _, node):
        reply = await node.call(service, **fields)
        assert text in reply.error
        again = await node.call("TriggerLocalization", application_id=PARTS)
        assert (again.error, len(again.localizations)) == ("", 2)


async def test_pixels_asked_for_are_not_published_as_metres() -> None:
    async with served(box=PartsCamera(active=PIXELS)) as (_, _, node):
        reply = await node.call("TriggerLocalization")
        assert "in metres" in reply.error
        await until(lambda: len(node.said("results")) == 1)
        assert node.said("localizations") == node.said("detections") == []


async def test_stopped_camera_refuses_until_it_is_started() -> None:
    async with served(box=PartsCamera(running=False)) as (box, camera, node):
        reply = await node.call("TriggerLocalization")
        assert "stopped" in reply.error
        assert not (await node.call("trigger")).success
        assert (await node.call("run", data=True)).success
        assert Status.RUNNING in camera.status
        assert (await node.call("trigger")).success
        assert (await node.call("stop")).success
        assert Status.RUNNING not in camera.status
        assert (await node.call("start")).success
        assert (await node.call("run", data=False)).success
        assert (Status.RUNNING in camera.status, box.runs) == (False, 1)


async def test_busy_camera_is_waited_for_within_the_timeout() -> None:
    box = PartsCamera(time=2.0)
    async with served(box=box) as (_, _, node):
        loop = asyncio.get_running_loop()
        first = asyncio.create_task(node.call("TriggerLocalization"))
        await asyncio.sleep(0.5)
        began = loop.time()
        late = await node.call("TriggerLocalization", timeout=0.25)
        assert "0.25 s" in late.error
        exact = type(node) is PaperNode  # whose time is not the system's
        assert loop.time() - began == pytest.approx(0.25, abs=0.01 if exact else 5.0)
        refused = await node.call("trigger_results", refuse_when_busy=True, timeout=5.0)
        assert (await first).error == ""
        assert refused.error or refused.results
        assert (await node.call("TriggerLocalization")).error == ""


async def test_application_that_runs_free_takes_no_trigger() -> None:
    async with served(box=PartsCamera(active=RUNNING)) as (_, _, node):
        reply = await node.call("trigger_results", refuse_when_busy=True)
        assert "wait" in reply.error
        assert reply.results == []


async def test_camera_that_cannot_says_so() -> None:
    async with served() as (_, _, node):
        reply = await node.call("reset_errors")
        assert not reply.success
        assert reply.message


async def test_camera_that_is_gone_is_an_error() -> None:
    box = PartsCamera()
    async with served(box=box, reconnect=None) as (_, camera, node):
        await box.stop()
        await until(lambda: not camera.connected)
        for service in ("TriggerLocalization", "ChangeApplication", "trigger_results"):
            assert (await node.call(service, application_id=1)).error
        for service in ("trigger", "start", "reboot"):
            reply = await node.call(service)
            assert (reply.success, bool(reply.message)) == (False, True)


async def test_reboot_ends_the_session() -> None:
    async with served(reconnect=None) as (_, camera, node):
        assert (await node.call("reboot")).success
        await until(lambda: not camera.connected)


async def test_a_bug_is_an_error_too(caplog: pytest.LogCaptureFixture) -> None:
    async with served() as (_, camera, node):

        async def trigger(*_: Any, **__: Any) -> Any:
            raise ZeroDivisionError("a bug")

        camera.trigger = trigger  # type: ignore[method-assign]
        assert (await node.call("trigger_results")).error == "ZeroDivisionError: a bug"
        assert (await node.call("trigger")).message == "ZeroDivisionError: a bug"
    assert "a service failed" in caplog.text


async def test_caller_that_goes_leaves_the_camera_usable() -> None:
    async with served(box=PartsCamera(time=1.0)) as (_, camera, node):
        for service in ("TriggerLocalization", "trigger", "trigger_results"):
            call = asyncio.create_task(node.call(service))
            await asyncio.sleep(0.25)
            call.cancel()
            await asyncio.wait((call,))
            assert call.cancelled()
        reply = await node.call("TriggerLocalization", timeout=20.0)
        assert reply.error == ""
        said = reply.localizations[0].feature_id
        newest = camera.statistics().received
        assert said == f"run{newest}"


# ---------------------------------------------------------------------- the life cycle


async def test_setup_publishing_and_stop_go_through_the_life_cycle() -> None:
    life = Life()
    async with served(life=life) as (_, camera, node):
        setup = {"camera_name": "line1/cam3", "interpret_as": "Localizations"}
        reply = await node.call("SmartcameraSetup", **setup)
        assert (reply.error, life.asked) == ("", ["configure"])
        fields = {"topic_for_outputs": "/outputs", "min_delay": 0.25, "queue_size": 5}
        reply = await node.call("EnablePublishing", **fields)
        assert (reply.error, life.asked) == ("", ["configure", "activate"])
        await node.call("TriggerLocalization")
        outputs = node.publishers["/outputs"]
        await until(lambda: outputs.messages)
        assert (outputs.type.name, outputs.qos.depth) == (RESULT, 5)
        await node.call("SmartcameraStop", camera_name="line1/cam3")
        assert life.asked == ["configure", "activate", "deactivate", "cleanup"]
        assert outputs.closed
        assert camera.connected
        for service in ("TriggerLocalization", "Trigger50ByteString", "EnablePublishing"):
            assert "expected SmartcameraSetup first" in (await node.call(service)).error
        assert (await node.call("trigger")).success  # which is not the thesis'
        await life.configure()  # by whoever manages the node
        assert (await node.call("TriggerLocalization")).error == ""


async def test_services_of_the_life_cycle_may_be_said_again() -> None:
    life = Life()
    async with served(life=life) as (_, _, node):
        for _ in range(2):
            assert (await node.call("SmartcameraSetup")).error == ""
        for topic in ("a", "b", "b", ""):
            reply = await node.call("EnablePublishing", topic_for_outputs=topic)
            assert reply.error == ""
        assert [node.publishers[f"/line1/{one}"].closed for one in "ab"] == [True, True]
        for _ in range(2):
            await node.call("SmartcameraStop")
        assert life.asked == ["configure", "activate", "deactivate", "cleanup"]


async def test_setup_has_an_application_run() -> None:
    async with served(box=PartsCamera(running=False)) as (_, camera, node):
        reply = await node.call("SmartcameraSetup", application_id=BOTH)
        assert reply.error == ""
        assert camera.active_application == BOTH
        assert Status.RUNNING in camera.status
        assert "77" in (await node.call("SmartcameraSetup", application_id=77)).error


async def test_publishing_before_setup_is_an_error_and_leaves_no_topic() -> None:
    async with served(life=Life()) as (_, _, node):
        reply = await node.call("EnablePublishing", topic_for_outputs="/outputs")
        assert "unconfigured" in reply.error
        assert node.publishers["/outputs"].closed


@pytest.mark.parametrize(
    ("name", "value"),
    [("topic_for_outputs", "no topic"), ("min_delay", -1.0), ("queue_size", 1_000_000)],
)
async def test_publishing_that_cannot_be(name: str, value: Any) -> None:
    life = Life("inactive")
    async with served(life=life) as (_, _, node):
        reply = await node.call("EnablePublishing", **{"topic_for_outputs": "/o", name: value})
        assert (value if name == "topic_for_outputs" else name) in reply.error
        assert life.asked == []


async def test_what_the_life_cycle_refuses_is_told() -> None:
    life = Life()
    life.error = RosError("it is configuring")
    async with served(life=life) as (_, _, node):
        assert (await node.call("SmartcameraSetup")).error == "it is configuring"
        life.state.label = "active"
        assert (await node.call("SmartcameraStop")).error == "it is configuring"
        assert (await node.call("TriggerLocalization")).error == ""  # it was not stopped


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"con_address": "192.0.2.1"}, "Setup says it is at"),
        ({"camera_model_name": "no such"}, "no such"),
        ({"interpret_as": "no such"}, "no such"),
        ({"topic_status": "no topic"}, "no topic"),
    ],
)
async def test_setup_that_means_something_else(fields: dict[str, str], text: str) -> None:
    life = Life()
    async with served(life=life) as (_, _, node):
        reply = await node.call("SmartcameraSetup", **fields)
        assert text in reply.error
        assert life.asked == []


async def test_setup_says_how_results_are_read_until_stop() -> None:
    async with served(box=PartsCamera(active=BROKEN)) as (_, camera, node):
        assert (await node.call("SmartcameraSetup", interpret_as="text: string[9]")).error == ""
        reply = await node.call("trigger")
        assert json.loads(reply.message)["value"] == {"text": "no part"}
        (said,) = node.said("results")
        assert (said.json, said.error) == ('{"text":"no part"}', "")
        assert "got 9" in (await node.call("TriggerLocalization")).error
        await node.call("SmartcameraStop")
        assert "got 9" in (await node.call("trigger")).message
        reply = await node.call("SmartcameraSetup", interpret_as="text: string[9]")
        assert (await camera.trigger()).value.text == "no part"  # whoever has the object
    assert camera._default_spec == READ_AS


async def test_a_calibration_of_localizations_leaves_texts_as_they_are() -> None:
    async with served(interpret_as="localizations", calibration=Robot()) as (_, _, node):
        reply = await node.call("Trigger50ByteString", application_id=TEXTS)
        assert (reply.error, reply.strings) == ("", ["one", "two"])
        fields = {"application_id": TEXTS, "interpret_as": "50ByteStrings"}
        reply = await node.call("trigger_results", **fields)
        assert (reply.error, reply.results[0].json) == ("", '["one","two"]')
        reply = await node.call("SmartcameraSetup", **fields)
        assert reply.error == ""
        assert json.loads((await node.call("trigger")).message)["value"] == ["one", "two"]
        reply = await node.call("TriggerLocalization", application_id=PARTS)
        assert (reply.error, len(reply.localizations)) == ("", 2)


async def test_setup_knows_where_the_camera_is() -> None:
    async with served() as (box, _, node):
        place = {"con_address": "127.0.0.1", "port": str(box.port)}
        assert (await node.call("SmartcameraSetup", **place)).error == ""
        assert (await node.call("SmartcameraSetup", con_address=box.url)).error == ""


async def test_setup_has_the_status_published() -> None:
    async with served(reconnect=None) as (box, _, node):
        reply = await node.call("SmartcameraSetup", topic_status="status")
        assert reply.error == ""
        status = node.publishers["/line1/status"]
        assert (status.type.name, status.qos) == ("smartcam_msgs/msg/CameraStatus", LATCHED)
        await until(lambda: status.messages)
        await node.call("stop")
        await until(lambda: not status.messages[-1].running)
        assert status.messages[0].running
        await node.call("SmartcameraSetup", topic_status="/line1/status")
        assert not status.closed
        await box.stop()
        await until(lambda: not status.messages[-1].connected)
        assert status.messages[-1].error
        await node.call("SmartcameraStop")
        assert status.closed


async def test_status_topic_moves_and_the_nodes_own_needs_nothing() -> None:
    async with served() as (_, _, node):
        for topic in ("a", "b", "/line1/cam3/status"):
            assert (await node.call("SmartcameraSetup", topic_status=topic)).error == ""
        assert [node.publishers[f"/line1/{one}"].closed for one in "ab"] == [True, True]
        assert "/line1/cam3/status" not in node.publishers


# ---------------------------------------------------------------------- a fleet's, and over TCP


async def test_camera_of_a_fleet_is_served_as_any() -> None:
    async with Plant() as plant, plant.cameras(2) as (own, other):
        node, box = PaperNode("cam1"), plant.box
        async with parts(own, node):
            reply = await node.call("trigger_results")
            assert [json.loads(one.json) for one in reply.results] == [{"run": 1, "token": 0}]
            place = {"con_address": "127.0.0.1", "port": str(box.port)}
            assert (await node.call("SmartcameraSetup", **place)).error == ""
            assert (await node.call("SmartcameraSetup", con_address="192.0.2.1")).error
            own._agent_facts.pop("url")  # as before its agent has answered
            reply = await node.call("SmartcameraSetup", con_address="127.0.0.1")
            assert "expected con_address and camera_model_name to be empty" in reply.error
            async with other.reserve():
                late = await node.call("trigger_results", timeout=0.5)
                assert (late.results, late.error) != ([], "")
                assert box.runs == 1
            assert (await node.call("trigger")).success


@pytest.mark.real_time
async def test_another_node_calls_over_tcp_and_dies_in_the_middle() -> None:
    place = free_place()
    box = PartsCamera(time=0.05)
    async with (
        asyncio.timeout(60),
        Node("cam3", namespace="/line1", listen=place) as node,
        box,
        smartcam.connect(box.url, name="line1/cam3", interpret_as=READ_AS) as camera,
        parts(camera, node),
    ):
        async with Node("viewer", connect=place) as viewer:
            name = "/line1/cam3/TriggerLocalization"
            client = viewer.client(name, "smartcam_msgs/srv/TriggerLocalization")
            reply = await client.call(camera_name="line1/cam3", timeout=10.0)
            assert [one.feature_id for one in reply.localizations] == ["run1", "run1"]
            assert "this is the node of" in (await client.call(camera_name="other")).error
            std = viewer.client("/line1/cam3/trigger", "std_srvs/srv/Trigger")
            assert (await std.call()).success
            dying = asyncio.create_task(client.call())
            await until(lambda: box.runs == 3)
        await asyncio.wait((dying,))  # with its reply, if that was quicker
        async with Node("viewer", connect=place) as viewer:
            client = viewer.client(name, "smartcam_msgs/srv/TriggerLocalization")
            reply = await client.call()
            assert (reply.error, reply.localizations[0].feature_id) == ("", "run4")
