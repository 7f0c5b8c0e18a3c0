"""Cameras of a running fleet through rclpy, with ``smartcam ros2 fleet://…``."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from smartcam.ros2._inside import NativeContext, NativeNode
from tests.processes import free_place
from tests.ros2.roskit import DOMAIN, NEEDS_RCLPY, TRIGGER, soon, until

pytestmark = [NEEDS_RCLPY, pytest.mark.real_time, pytest.mark.long]

CAMERA = "/line1/cam3"
PLANT = """\
listen: {place}
cameras:
  line1/cam3:
    emulated: {{}}
    application: 7
    interpret_as: localizations
    frames: "synthetic://?size=320x240&fps=10"
"""


@contextlib.asynccontextmanager
async def smartcam(folder: Path, *arguments: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """Give a command that has printed its first line; it is killed at the end."""
    local = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": str(DOMAIN)}
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "smartcam", *arguments),
        cwd=folder,
        env={**os.environ, **local, "PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=pipe,
        stderr=pipe,
    )
    assert process.stdout is not None
    try:
        await soon(process.stdout.readline())
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.communicate()


class Panel:
    """A node beside the cameras', which calls and hears."""

    def __init__(self, node: NativeNode) -> None:
        self.node = node

    async def call(self, name: str, kind: str, **fields: Any) -> Any:
        """Return the reply of a service of the camera's node."""
        client = self.node.client(f"{CAMERA}/{name}", kind)
        try:
            return await client.call(fields, timeout=60)
        finally:
            client.close()

    async def trigger_until(self, success: bool) -> str:
        """Trigger until that succeeds, or fails; return the message."""
        async with asyncio.timeout(60):
            while (  # noqa: ASYNC110 - nothing tells of it
                reply := await self.call("trigger", TRIGGER)
            ).success is not success:
                await asyncio.sleep(0.2)
        return str(reply.message)

    async def switch(self, application: int) -> str:
        """Set the parameter of the camera's application; return why that was refused."""
        value = {"name": "application", "value": {"type": 2, "integer_value": application}}
        kind = "rcl_interfaces/srv/SetParameters"
        (result,) = (await self.call("set_parameters", kind, parameters=[value])).results
        assert result.successful is (result.reason == "")
        return str(result.reason)

    async def state(self) -> str:
        """Return the state of the camera's node."""
        reply = await self.call("get_state", "lifecycle_msgs/srv/GetState")
        return str(reply.current_state.label)


async def test_a_fleet_that_is_served_already_is_seen_through_rclpy(tmp_path: Path) -> None:
    place = free_place()
    (tmp_path / "plant.yaml").write_text(PLANT.format(place=place))
    serve = tmp_path, "serve", "plant.yaml"
    seen = tmp_path, "ros2", place.replace("tcp/", "fleet://"), "--rmw", "native"
    context = NativeContext(domain=DOMAIN)
    async with NativeNode("panel", context=context, managed=False) as node:
        panel = Panel(node)
        async with smartcam(*serve) as agent, smartcam(*seen) as nodes:
            await until(lambda: CAMERA in node.graph.nodes())
            poses = node.subscribe(f"{CAMERA}/localizations", "geometry_msgs/msg/PoseArray")
            images = node.subscribe(f"{CAMERA}/image_raw", "sensor_msgs/msg/Image")
            while not poses.statistics().queued:  # who publishes has yet to know of who hears
                result = json.loads(await panel.trigger_until(True))
                await asyncio.sleep(0.2)
            message = await soon(anext(poses))
            assert (result["application"], message.header.frame_id) == (7, "line1_cam3")
            assert message.poses
            assert (await soon(anext(images))).width == 320
            for application in (1, 7):
                assert await panel.switch(application) == ""
            assert "4000" in await panel.switch(4000)
            assert await panel.state() == "active"

            agent.send_signal(signal.SIGKILL)
            assert "cam3" in await panel.trigger_until(False)
            async with smartcam(*serve):
                begun = time.time()
                await panel.trigger_until(True)  # of the agent that came for the other
                while (await soon(anext(images))).header.stamp.sec <= begun:
                    pass

                nodes.send_signal(signal.SIGINT)
                assert await soon(nodes.wait()) == 0
                await until(lambda: CAMERA not in node.graph.nodes())


async def test_a_fleet_that_is_not_there_ends_the_command(tmp_path: Path) -> None:
    place = free_place().replace("tcp/", "fleet://")
    async with smartcam(tmp_path, "ros2", place, "--rmw", "native") as nodes:
        _, told = await soon(nodes.communicate())
    assert nodes.returncode == 3
    assert place.removeprefix("fleet://") in told.decode()
