"""Against another implementation of rmw_zenoh's format: the zenoh-ros2-sdk of ROBOTIS."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from smartcam.exceptions import ServiceCallError
from smartcam.ros2 import Node, QoS
from smartcam.ros2._inside import LATCHED
from tests.processes import free_place
from tests.ros2.roskit import PATIENCE, SET_BOOL, STRING, soon, until

pytestmark = [pytest.mark.real_time, pytest.mark.long]

pytest.importorskip("zenoh_ros2_sdk")

POSES = "geometry_msgs/msg/PoseArray"


class Partner:
    """The other one, in a process of its own."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process

    async def __call__(self, do: str, **more: Any) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps({"do": do, **more}).encode() + b"\n")
        async with asyncio.timeout(PATIENCE):
            line = await self._process.stdout.readline()
        assert line, f"the partner has ended: {do} {more}"
        return json.loads(line)


@contextlib.asynccontextmanager
async def both(folder: Path) -> AsyncIterator[tuple[Node, Partner]]:
    place = free_place()
    async with Node("cam3", namespace="line1", listen=place, domain=7) as node:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "tests.ros2.sdk_partner"),
            *(place.rpartition(":")[2], str(folder)),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            limit=1 << 24,
        )
        try:
            yield node, Partner(process)
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()


async def test_it_lists_what_a_node_has_and_hears_it(tmp_path: Path) -> None:
    async def answer(_: Any) -> dict[str, Any]:
        return {"success": True}

    async with both(tmp_path) as (node, partner):
        poses = node.publisher("localizations", POSES, qos=QoS(depth=5))
        status = node.publisher("status", STRING, qos=LATCHED)
        status.publish(data="latched")
        node.serve("~/run", SET_BOOL, answer)
        topics, services = await partner("topics"), await partner("services")
        assert ["/line1/localizations", [POSES]] in topics
        assert ["/line1/status", [STRING]] in topics
        assert ["/line1/cam3/run", [SET_BOOL]] in services

        await partner("subscribe", topic="/line1/localizations", type=POSES)
        await until(lambda: poses.has_subscribers)
        sent = {
            "header": {"stamp": {"sec": 5, "nanosec": 7}, "frame_id": "cam3"},
            "poses": [
                {
                    "position": {"x": 0.25, "y": -1.5, "z": 3e-9},
                    "orientation": {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8},
                }
            ]
            * 3,
        }
        poses.publish(sent)
        assert await partner("take") == sent


async def test_a_long_message_comes_whole(tmp_path: Path) -> None:
    async with both(tmp_path) as (node, partner):
        says = node.publisher("/image", "sensor_msgs/msg/Image")
        await partner("subscribe", topic="/image", type="sensor_msgs/msg/Image")
        await until(lambda: says.has_subscribers)
        data = bytes(range(256)) * 1200
        says.publish(height=480, width=640, encoding="mono8", step=640, data=data)
        heard = await partner("take")
        assert bytes(heard["data"]) == data
        assert (heard["height"], heard["width"], heard["encoding"]) == (480, 640, "mono8")


async def test_it_is_heard_and_its_publisher_is_known(tmp_path: Path) -> None:
    async with both(tmp_path) as (node, partner):
        hears = node.subscribe("/chatter", STRING)
        await partner("publish", topic="/chatter", type=STRING, times=3, data="é")
        first = await soon(anext(hears))
        assert first.data == "é"
        assert hears.attachment is not None
        assert hears.attachment.number in {0, 1}  # it counts from 0
        assert not hears.rejected
        await until(lambda: node.graph.endpoints("/chatter", "MP"))
        (end,) = node.graph.endpoints("/chatter", "MP")
        assert end.ros_type == STRING
        assert end.hash == hears.entity.hash


async def test_calls_both_ways(tmp_path: Path) -> None:
    asked: list[bool] = []

    async def answer(request: Any) -> dict[str, Any]:
        asked.append(request.data)
        return {"success": not request.data, "message": "ours"}

    async with both(tmp_path) as (node, partner):
        node.serve("~/run", SET_BOOL, answer)
        for data in (True, False):
            reply = await partner("call", service="/line1/cam3/run", data=data)
            assert reply == {"success": not data, "message": "ours"}
        assert asked == [True, False]

        await partner("serve", service="/theirs")
        calls = node.client("/theirs", SET_BOOL)
        async with asyncio.timeout(PATIENCE):
            while True:
                try:
                    reply = await calls.call(data=True, timeout=PATIENCE)
                except ServiceCallError:  # it is seen before it answers
                    await asyncio.sleep(0.1)
                else:
                    break
        assert (reply.success, reply.message) == (True, "was True")
