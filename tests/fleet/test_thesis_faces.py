"""The thesis' six services behave the same in JSON, at a node of ROS 2 and at one of ROS 1.

One table of requests is run over each face of one agent: real Zenoh, our nodes, and a rosbridge.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest

import smartcam
from smartcam.fleet import FleetFile, FleetServer
from smartcam.fleet._inside import FleetAddress, RosSection
from smartcam.ros1._inside import run_bridged_nodes
from smartcam.ros2 import Node, QoS
from tests.fleet.fleetkit import until
from tests.fleet.plainkit import NAME, PATIENCE, PREFIX, ask_thesis, zenoh_session
from tests.processes import free_place
from tests.ros1.bridge import Bridge
from tests.ros2.camerakit import BROKEN, PARTS, PIXELS, READ_AS, TEXTS, PartsCamera

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

pytestmark = pytest.mark.real_time

OUTPUTS = "/line1/outputs"
"""The topic ``outputs`` beside a camera's node, in full."""

FIELDS = ("error", "strings", "localizations")

ANOTHER_WAY = "text: string[9]"
"""Reads the containers of application BROKEN, which the fleet file reads as localizations."""


class Ask(NamedTuple):
    """A request, and what is expected of its answer.

    Attributes:
        service: which.
        fields: of the request.
        error: a part of the error; "" for none.
        found: names of localizations, or strings; None where the answer has neither.
    """

    service: str
    fields: dict[str, Any]
    error: str = ""
    found: list[str] | None = None


class Publish(NamedTuple):
    """Another program triggers; what is published then.

    Attributes:
        application: that the other program triggers.
        value: of the result; None where it cannot be read.
    """

    application: int
    value: Any


CLOSED = "expected SmartcameraSetup first"

STEPS: tuple[Ask | Publish, ...] = (
    Ask("SmartcameraSetup", {"application_id": PARTS}),
    Ask("TriggerLocalization", {}, found=["run1", "run1"]),
    Ask("TriggerLocalization", {"application_id": TEXTS}, "expected 50 bytes, got 30", []),
    Ask("TriggerLocalization", {"application_id": BROKEN}, "expected 50 bytes, got 9", []),
    Ask("TriggerLocalization", {"application_id": PIXELS}, "expected localizations in metres", []),
    Ask("TriggerLocalization", {"application_id": 77}, "77", []),
    Ask("TriggerLocalization", {"timeout": -1.0}, "timeout", []),
    Ask("TriggerLocalization", {"timeout": 601.0}, "timeout", []),
    Ask("Trigger50ByteString", {"application_id": TEXTS, "timeout": 5.0}, found=["one", "two"]),
    Ask("ChangeApplication", {"application_id": 77}, "77"),
    Ask("ChangeApplication", {"application_id": 0}, "application_id"),
    Ask("SmartcameraSetup", {"con_address": "192.0.2.1"}, "Setup says it is at"),
    Ask("SmartcameraSetup", {"camera_model_name": "BVS003"}, "unknown camera model"),
    Ask("SmartcameraSetup", {"interpret_as": "no such"}, "no such"),
    Ask("SmartcameraSetup", {"topic_status": "no topic"}, "no topic"),
    Ask("EnablePublishing", {"topic_for_outputs": "no topic"}, "no topic"),
    Ask("EnablePublishing", {"min_delay": -1.0}, "min_delay"),
    Ask("EnablePublishing", {"queue_size": 10_001}, "queue_size"),
    Ask("EnablePublishing", {"topic_for_outputs": "outputs"}),
    Publish(TEXTS, ["one", "two"]),
    Publish(BROKEN, None),
    Ask("SmartcameraSetup", {"interpret_as": ANOTHER_WAY}),
    Publish(BROKEN, {"text": "no part"}),
    Publish(TEXTS, None),
    Ask("SmartcameraSetup", {"interpret_as": "50ByteStrings"}),
    Publish(TEXTS, ["one", "two"]),
    Ask("SmartcameraStop", {}),
    Ask("SmartcameraStop", {}),
    Ask("TriggerLocalization", {}, CLOSED, []),
    Ask("Trigger50ByteString", {}, CLOSED, []),
    Ask("ChangeApplication", {"application_id": TEXTS}, CLOSED),
    Ask("EnablePublishing", {"topic_for_outputs": "outputs"}, CLOSED),
    Ask("SmartcameraSetup", {"application_id": 77}, "77"),
    Ask("SmartcameraSetup", {}),
    Ask("EnablePublishing", {"topic_for_outputs": "outputs"}),
    Publish(BROKEN, None),
    Publish(TEXTS, ["one", "two"]),
    Ask("ChangeApplication", {"application_id": TEXTS}),
    Publish(BROKEN, None),
    Ask("SmartcameraStop", {}),
    Ask("SmartcameraSetup", {}),
    Ask("Trigger50ByteString", {}, found=["one", "two"]),
    Ask("SmartcameraSetup", {"application_id": PARTS, "interpret_as": "50ByteStrings"}),
    Ask("TriggerLocalization", {}, found=["run2", "run2"]),
)


class Face:
    """A way to the services.

    Attributes:
        came: the values of results that were published; None for one that cannot be read.
    """

    def __init__(self) -> None:
        self.came: asyncio.Queue[Any] = asyncio.Queue()

    async def hear(self) -> None:
        """Hear the topic ``outputs`` from now on."""

    async def ask(self, service: str, fields: dict[str, Any]) -> dict[str, Any]:
        """Return the fields of an answer."""
        raise NotImplementedError

    @staticmethod
    def found(answer: dict[str, Any]) -> list[str] | None:
        """Return the names of localizations, or the strings."""
        if "strings" in answer:
            return list(answer["strings"])
        if "localizations" in answer:
            return [one["feature_id"] for one in answer["localizations"]]
        return None


class JsonFace(Face):
    """Plain Zenoh."""

    def __init__(self, server: FleetServer, session: Any) -> None:
        super().__init__()
        self._session, self._server = session, server
        self._heard: Any = None

    async def hear(self) -> None:
        loop = asyncio.get_running_loop()

        def take(sample: Any) -> None:
            said = json.loads(sample.payload.to_bytes())
            value = None if said["error"] else said["value"]
            loop.call_soon_threadsafe(self.came.put_nowait, value)

        if self._heard is None:
            key = f"{PREFIX}/thesis/topic/outputs"
            self._heard = self._session.declare_subscriber(key, take)
        topics = self._server.shared_cameras[NAME].topics
        await until(
            lambda: topics.results_out is not None and topics.results_out.publisher.has_subscribers
        )

    async def ask(self, service: str, fields: dict[str, Any]) -> dict[str, Any]:
        return await ask_thesis(self._session, service, fields)


class Ros2Face(Face):
    """A node of ours in another context."""

    def __init__(self, server: FleetServer, viewer: Node) -> None:
        super().__init__()
        self._server, self._viewer = server, viewer
        self._task: asyncio.Task[None] | None = None

    async def hear(self) -> None:
        kind = "smartcam_msgs/msg/Result"
        if self._task is None:
            heard = self._viewer.subscribe(OUTPUTS, kind, qos=QoS(depth=10))
            self._task = asyncio.create_task(self._take(heard))
        assert self._server._ros is not None
        (node,) = self._server._ros.nodes.values()
        await until(lambda: (topic := node.results._delayed) is not None and topic.has_subscribers)

    async def _take(self, heard: Any) -> None:
        async for message in heard:
            self.came.put_nowait(None if message.error else json.loads(message.json))

    async def ask(self, service: str, fields: dict[str, Any]) -> dict[str, Any]:
        client = self._viewer.client(f"/{NAME}/{service}", f"smartcam_msgs/srv/{service}")
        reply = await client.call({"camera_name": NAME, **fields}, timeout=PATIENCE)
        found = {one: getattr(reply, one) for one in FIELDS if hasattr(reply, one)}
        for name in found.keys() & {"localizations"}:
            found[name] = [{"feature_id": one.feature_id} for one in found[name]]
        return found


class Ros1Face(Face):
    """A rosbridge, behind which there would be ROS 1."""

    def __init__(self, bridge: Bridge) -> None:
        super().__init__()
        self._bridge = bridge
        self._task: asyncio.Task[None] | None = None

    async def hear(self) -> None:
        await self._bridge.until(lambda: OUTPUTS in self._bridge.topics)
        self._task = self._task or asyncio.create_task(self._take())

    async def close(self) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait((self._task,))

    async def _take(self) -> None:
        taken = 0
        while True:
            said = [one["msg"] for one in self._bridge.published if one["topic"] == OUTPUTS]
            for message in said[taken:]:
                self.came.put_nowait(None if message["error"] else json.loads(message["json"]))
            taken = len(said)
            await asyncio.sleep(0.01)

    async def ask(self, service: str, fields: dict[str, Any]) -> dict[str, Any]:
        said = await self._bridge.call(f"/{NAME}/{service}", {"camera_name": NAME, **fields})
        answer: dict[str, Any] = said["values"]
        return answer


# ---------------------------------------------------------------------- a plant for each face


@contextlib.asynccontextmanager
async def plant(**more: Any) -> AsyncIterator[FleetServer]:
    """An agent that has one camera."""
    async with PartsCamera(time=0.0) as box:
        entry: dict[str, Any] = {"url": box.url, "interpret_as": READ_AS, "application": PARTS}
        fields: dict[str, Any] = {"listen": free_place(), "cameras": {NAME: entry}, **more}
        async with smartcam.fleet.serve(FleetFile.model_validate(fields)) as server:
            yield server


@contextlib.asynccontextmanager
async def in_json() -> AsyncIterator[tuple[FleetServer, Face]]:
    async with plant(fleet="plant") as server:
        session = await asyncio.to_thread(zenoh_session, server.address.port)
        try:
            yield server, JsonFace(server, session)
        finally:
            await asyncio.to_thread(session.close)


@contextlib.asynccontextmanager
async def in_ros2() -> AsyncIterator[tuple[FleetServer, Face]]:
    async with plant(ros2={}) as server:
        place = f"tcp/127.0.0.1:{server.address.port}"
        async with Node("viewer", connect=place) as viewer:
            yield server, Ros2Face(server, viewer)


@contextlib.asynccontextmanager
async def in_ros1() -> AsyncIterator[tuple[FleetServer, Face]]:
    async with plant() as server, Bridge(wakes_after=0.002) as bridge:
        address = FleetAddress.parse(server.address.url)
        section = RosSection.model_validate({})
        async with run_bridged_nodes(bridge.url, lambda _: None, address, section) as ros:
            await ros.wait_first_attempts()
            made = Ros1Face(bridge)
            try:
                yield server, made
            finally:
                await made.close()


async def run(face: Face, other: smartcam.Camera[Any]) -> None:
    """Do all steps, each judged."""
    for number, step in enumerate(STEPS):
        where = f"step {number}: {step}"
        if isinstance(step, Ask):
            answer = await face.ask(step.service, step.fields)
            error = answer.get("error", "")
            assert (error == "") == (step.error == ""), f"{where}: {answer}"
            assert step.error in error, where
            assert face.found(answer) == step.found, where
            if step.service == "EnablePublishing" and not error:
                await face.hear()
        else:
            await other.trigger(step.application, interpret_as="raw")
            try:
                came = await asyncio.wait_for(face.came.get(), 5)
            except TimeoutError:
                pytest.fail(f"{where}: nothing was published")
            assert came == step.value, where
    assert face.came.empty()


@pytest.mark.parametrize("face", [in_json, in_ros2, in_ros1])
async def test_a_face_answers_as_the_table_says(face: Any) -> None:
    async with asyncio.timeout(PATIENCE), face() as (server, made):
        await server.wait_first_attempts()
        async with smartcam.connect(server.urls[NAME]) as other:
            await run(made, other)
