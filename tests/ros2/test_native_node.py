"""Nodes through rclpy: messages, bounds, and failures of rclpy."""

from __future__ import annotations

import asyncio
import contextlib
import os
import subprocess
import sys
import time
from collections.abc import AsyncIterator
from typing import Any

import pytest

from smartcam.exceptions import (
    ConfigurationError,
    RosError,
    ServiceCallError,
    ServiceTimeoutError,
    SmartCamError,
)
from smartcam.ros2 import QoS
from smartcam.ros2._inside import LATCHED, NativeContext, NativeNode
from tests.ros2.roskit import DOMAIN, NEEDS_RCLPY, STRING, TRIGGER, soon, until

pytestmark = [NEEDS_RCLPY, pytest.mark.real_time]

SET = ("/cam/set_parameters", "rcl_interfaces/srv/SetParameters")
GET = ("/cam/get_parameters", "rcl_interfaces/srv/GetParameters")


@contextlib.asynccontextmanager
async def two(*args: str) -> AsyncIterator[tuple[NativeNode, NativeNode]]:
    """Give ``/cam``, with arguments for ROS, and ``/viewer``, which has a context of its own."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    async with (
        NativeNode("cam", context=NativeContext(domain=DOMAIN, args=args), managed=False) as cam,
        NativeNode("viewer", context=NativeContext(domain=DOMAIN), managed=False) as viewer,
    ):
        yield cam, viewer


async def set_value(viewer: NativeNode, name: str, **value: Any) -> Any:
    """Return the result of setting a parameter of ``/cam``."""
    client = viewer.client(*SET)
    reply = await client.call(parameters=[{"name": name, "value": value}], timeout=60)
    client.close()
    return reply.results[0]


async def get_value(viewer: NativeNode, name: str) -> int:
    """Return the integer that a parameter of ``/cam`` has."""
    client = viewer.client(*GET)
    reply = await client.call(names=[name], timeout=60)
    client.close()
    return int(reply.values[0].integer_value)


# ---------------------------------------------------------------------- topics and services


async def test_messages_come_in_order_and_once() -> None:
    async with two() as (cam, viewer):
        says = cam.publisher("~/chatter", STRING, qos=QoS(depth=2000))
        hears = viewer.subscribe("/cam/chatter", STRING, qos=QoS(depth=2000))
        await until(lambda: says.has_subscribers)
        await asyncio.sleep(0.5)  # who hears knows of us, too
        for number in range(1000):
            says.publish(data=str(number))
        assert [(await soon(anext(hears))).data for _ in range(1000)] == [*map(str, range(1000))]
        assert says.dropped == hears.rejected == 0
        late = viewer.subscribe("/cam/late", STRING, qos=LATCHED)
        cam.publisher("~/late", STRING, qos=LATCHED).publish(data="said before")
        assert (await soon(anext(late))).data == "said before"


async def test_a_service_answers_refuses_and_is_bounded() -> None:
    go = asyncio.Event()

    async def answer(_request: Any) -> Any:
        await go.wait()
        return {"success": True, "message": "done"}

    async def fail(_request: Any) -> Any:
        raise ValueError("odd")

    async def refuse(_request: Any) -> Any:
        raise RosError("not now")

    async with two() as (cam, viewer):
        cam.serve("~/it", TRIGGER, answer)
        client = viewer.client("/cam/it", TRIGGER)
        calls = [asyncio.create_task(client.call(timeout=60)) for _ in range(64)]
        await until(lambda: client.served)
        await asyncio.sleep(2.0)
        beyond = await client.call(timeout=60)
        assert not beyond.success
        assert "64 calls" in beyond.message
        go.set()
        assert all([(await one).success for one in calls])
        for name, handler, text in (("odd", fail, "ValueError: odd"), ("no", refuse, "not now")):
            cam.serve(f"~/{name}", TRIGGER, handler)
            reply = await viewer.client(f"/cam/{name}", TRIGGER).call(timeout=60)
            assert not reply.success
            assert text in reply.message
        cam.serve("~/mute", "std_srvs/srv/Empty", refuse)  # whose response has no field for it
        mute = viewer.client("/cam/mute", "std_srvs/srv/Empty")
        await mute.wait_served(60)
        with pytest.raises(ServiceTimeoutError):
            await mute.call(timeout=1.0)
        with pytest.raises(ServiceTimeoutError, match="no server for"):
            await viewer.client("/nobody", TRIGGER).call(timeout=0.2)


async def test_what_is_not_built_is_told_and_the_rest_goes_on(
    caplog: pytest.LogCaptureFixture,
) -> None:
    kind = "strange_msgs/srv/Odd"
    async with two() as (cam, viewer):
        for node in (cam, viewer):
            node.types.add(kind, "bool request\n---\nbool answer\n")
        service = cam.serve("~/odd", kind, lambda _: asyncio.sleep(0))
        with pytest.raises(ConfigurationError, match=r"strange_msgs.*not built"):
            viewer.client("/cam/odd", kind)
        await until(lambda: "strange_msgs is not built" in caplog.text)
        assert "/cam/odd" in caplog.text
        service.close()
        assert "/cam" in cam.graph.nodes()


# ---------------------------------------------------------------------- parameters


async def test_hooks_carry_out_what_others_set() -> None:
    carried: list[int] = []

    async def hook(value: int) -> None:
        await asyncio.sleep(0.05)
        if value == 13:
            raise SmartCamError("not thirteen")
        carried.append(value)

    async with two("--ros-args", "-p", "given:=5", "-p", "fixed:=5") as (cam, viewer):
        cam.parameters.declare("exposure", 1, minimum=0, maximum=100, on_set=hook)
        cam.parameters.declare("given", 1, on_set=hook)
        cam.parameters.declare("fixed", 1, read_only=True)
        await until(lambda: carried == [5])  # of the command line
        assert cam.parameters.get("given") == 5
        assert (await set_value(viewer, "exposure", type=2, integer_value=7)).successful
        assert cam.parameters.get("exposure") == 7
        assert carried == [5, 7]
        for value in (13, 101):
            assert not (await set_value(viewer, "exposure", type=2, integer_value=value)).successful
        refused = await set_value(viewer, "exposure", type=2, integer_value=13)
        assert refused.reason == "not thirteen"
        assert not (await set_value(viewer, "exposure", type=4, string_value="a")).successful
        assert not (await set_value(viewer, "fixed", type=2, integer_value=2)).successful
        assert await get_value(viewer, "fixed") == 1
        cam.parameters.update("exposure", 9)  # by the node itself: no hook
        assert await get_value(viewer, "exposure") == 9
        await cam.parameters.set("exposure", 10)
        assert await get_value(viewer, "exposure") == 10
        assert carried == [5, 7, 10]


async def test_a_node_that_is_closed_while_a_hook_waits() -> None:
    begun = asyncio.Event()

    async def hook(_value: int) -> None:
        begun.set()
        await asyncio.sleep(3600)

    async with two() as (cam, viewer):
        submit = cam.submit

        def late(make_coroutine: Any) -> Any:
            found = submit(make_coroutine)
            time.sleep(0.2)  # the thread of rclpy learns of its own wait when all is closed
            return found

        cam.submit = late  # type: ignore[method-assign]
        cam.parameters.declare("exposure", 1, on_set=hook)
        setting = asyncio.create_task(set_value(viewer, "exposure", type=2, integer_value=7))
        async with asyncio.timeout(20):
            await begun.wait()
        start = time.monotonic()
        await cam.stop()
        assert time.monotonic() - start < 6
        setting.cancel()
        await asyncio.wait([setting])


async def test_time_is_that_of_the_topic_clock() -> None:
    async with two("--ros-args", "-p", "use_sim_time:=true") as (cam, viewer):
        clock = viewer.publisher("/clock", "rosgraph_msgs/msg/Clock")
        says = cam.publisher("~/image", "sensor_msgs/msg/Image")
        hears = viewer.subscribe("/cam/image", "sensor_msgs/msg/Image")
        await until(lambda: clock.has_subscribers and says.has_subscribers)
        await asyncio.sleep(0.5)

        def tick() -> bool:
            clock.publish(clock={"sec": 1000})
            return abs(cam._time_shift() + time.time() - 1000) < 1

        await until(tick)
        seconds = int(time.time())
        says.publish(header={"stamp": {"sec": seconds}, "frame_id": "cam"})
        said = (await soon(anext(hears))).header
        assert 990 <= said.stamp.sec <= 1001
        assert said.frame_id == "cam"


# ---------------------------------------------------------------------- what dies


async def test_a_context_that_somebody_shuts_down_is_a_typed_error(
    caplog: pytest.LogCaptureFixture,
) -> None:
    go = asyncio.Event()

    async def never(_request: Any) -> Any:
        await go.wait()

    async with two() as (cam, viewer):
        viewer.serve("~/it", TRIGGER, never)
        says = cam.publisher("~/chatter", STRING)
        client = cam.client("/viewer/it", TRIGGER)
        await client.wait_served(60)
        call = asyncio.create_task(client.call(timeout=60))
        await asyncio.sleep(0.5)
        cam.context._context.shutdown()
        start = time.monotonic()
        with pytest.raises(ServiceCallError, match="context was shut down"):
            await call
        with pytest.raises(RosError, match="context was shut down"):
            says.publish(data="a")
        with pytest.raises(RosError, match="context was shut down"):
            cam.publisher("~/other", STRING)
        assert not says.has_subscribers
        await cam.stop()
        assert time.monotonic() - start < 10
        await cam.start()  # it may be opened again
        assert "/cam" in cam.graph.nodes()
    assert "context was shut down" in caplog.text


LOOP_THAT_DIES = """
import asyncio, threading
from smartcam.ros2._inside import NativeContext, NativeNode

async def main():
    node = NativeNode("cam", context=NativeContext(domain={domain}))
    await node.start()
    node.publisher("~/a", "std_msgs/msg/String")
    async def never(_):
        await asyncio.sleep(3600)
    node.serve("~/it", "std_srvs/srv/Trigger", never)
    return node

node = asyncio.run(main())  # and the loop is closed
{then}
print("end", flush=True)
"""


@pytest.mark.parametrize("then", ["", "import time; time.sleep(3)"])
def test_a_loop_that_is_closed_leaves_no_hang(then: str) -> None:
    program = LOOP_THAT_DIES.format(domain=DOMAIN, then=then)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    told = subprocess.run(  # noqa: S603 - ours
        [sys.executable, "-c", program],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (told.returncode, told.stdout) == (0, "end\n"), told.stderr[-2000:]
    if then:
        assert "its event loop is closed" in told.stderr


async def test_arguments_that_ros_refuses() -> None:
    node = NativeNode("cam", context=NativeContext(domain=DOMAIN, args=("--ros-args", "-p", "x")))
    with pytest.raises(ConfigurationError, match="rclpy does not begin"):
        await node.start()
    with pytest.raises(RosError, match="not open"):
        node.publisher("~/a", STRING)


async def test_it_can_be_cancelled_and_closed_at_any_moment() -> None:
    context = NativeContext(domain=DOMAIN)
    async with NativeNode("anchor", context=context, managed=False) as anchor:
        for number in range(6):
            node = NativeNode("cam", context=context)
            starting = asyncio.create_task(node.start())
            await asyncio.sleep(0.02 * number)
            starting.cancel()
            await asyncio.wait([starting])
            await node.stop()
            await node.stop()
        await until(lambda: anchor.graph.nodes() == ["/anchor"])
