"""Two nodes over TCP: topics, services, the graph, and the end of everything."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import os
import signal
import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest

from smartcam.exceptions import (
    ConfigurationError,
    ConnectFailedError,
    RosError,
    RosMessageError,
    ServiceCallError,
    ServiceTimeoutError,
)
from smartcam.ros2 import Node, QoS
from smartcam.ros2._inside import LATCHED, RosContext
from smartcam.testing.proxy import LinkProxy
from tests.processes import free_place
from tests.ros2.inside import Attachment
from tests.ros2.roskit import PATIENCE, SET_BOOL, STRING, TRIGGER, soon, two_nodes, until

MAX_CONCURRENT_CALLS = 64
MAX_REQUEST_BYTES = 16 << 20


SUM = "example_interfaces/srv/AddTwoInts"

pytestmark = pytest.mark.real_time


async def trigger(_: object) -> dict[str, Any]:
    return {"success": True, "message": "done"}


# ---------------------------------------------------------------------- topics


async def test_messages_come_in_order_with_number_and_publisher() -> None:
    async with two_nodes() as (here, there):
        hears = there.subscribe("/line1/chatter", STRING)
        says = here.publisher("chatter", STRING)
        await until(lambda: says.has_subscribers)
        for n in range(20):
            says.publish(data=str(n))
            message = await soon(anext(hears))
            assert message.data == str(n)
            assert hears.attachment is not None
            assert hears.attachment.number == n + 1
            assert hears.attachment.gid == says.entity.gid
        await until(lambda: says.published == 20)  # which its thread counts
        assert not hears.statistics().dropped


async def test_a_latched_topic_has_the_last_for_who_comes_later() -> None:
    async with two_nodes() as (here, there):
        says = here.publisher("status", STRING, qos=LATCHED)
        for text in ("old", "last"):
            says.publish({"data": text})
        await until(lambda: says.published == 2)  # which its thread counts
        hears = there.subscribe("/line1/status", STRING, qos=LATCHED)
        assert (await soon(anext(hears))).data == "last"
        says.publish(data="next")
        assert (await soon(anext(hears))).data == "next"


async def test_the_oldest_makes_room_for_who_reads_slowly() -> None:
    async with two_nodes() as (here, there):
        hears = there.subscribe("/line1/chatter", STRING, qos=QoS(depth=3))
        says = here.publisher("chatter", STRING)
        await until(lambda: says.has_subscribers)
        for n in range(10):
            says.publish(data=str(n))
        await until(lambda: hears.statistics().offered == 10)
        assert [(await soon(anext(hears))).data for _ in range(3)] == ["7", "8", "9"]
        assert hears.statistics().dropped == 7


async def test_long_messages_come_whole_and_in_order() -> None:
    async with two_nodes() as (here, there):
        hears = there.subscribe("/image", "sensor_msgs/msg/Image", qos=QoS(depth=5))
        says = here.publisher("/image", "sensor_msgs/msg/Image", qos=QoS(depth=5))
        await until(lambda: says.has_subscribers)
        for n in range(8):
            says.publish(height=n, data=bytes([n]) * 1_000_000)
            message = await soon(anext(hears))
            assert message.height == n
            assert bytes(message.data) == bytes([n]) * 1_000_000
        assert not says.dropped


async def test_what_is_no_message_is_left_out_and_told(caplog: pytest.LogCaptureFixture) -> None:
    async with two_nodes() as (here, there):
        hears = there.subscribe("/line1/chatter", STRING)
        says = here.publisher("chatter", STRING)
        await until(lambda: says.has_subscribers)
        session, key = here.context.zenoh.session, says.entity.key
        extra = Attachment(1, 1, bytes(16)).encode()
        session.put(key, b"\0\1\0\0\xff\xff\xff\xff", attachment=extra)
        session.put(key, b"", attachment=extra)
        session.put(key, says.type.encode({"data": "no attachment"}))
        session.put(key, says.type.encode({"data": "short"}), attachment=b"short")
        says.publish(data="good")
        with caplog.at_level(logging.WARNING, "smartcam.ros2"):
            assert (await soon(anext(hears))).data == "good"
        assert hears.rejected == 4
        assert "left out" in caplog.text


async def test_a_message_that_cannot_be_is_refused_at_once() -> None:
    async with two_nodes() as (here, _):
        says = here.publisher("chatter", STRING)
        for wrong in ({"data": 1}, {"dat": "x"}):
            with pytest.raises(RosMessageError, match="std_msgs/msg/String"):
                says.publish(wrong)
        with pytest.raises(RosMessageError, match="both"):
            says.publish({"data": "x"}, data="x")
        with pytest.raises(ConfigurationError, match=r"no/such/Type|expected"):
            here.publisher("chatter", "no/such/Type")
        with pytest.raises(ConfigurationError, match="ROS topic"):
            here.publisher("chat ter", STRING)


# ---------------------------------------------------------------------- services


async def test_calls_side_by_side_each_have_their_own_reply() -> None:
    async def answer(request: Any) -> dict[str, Any]:
        await asyncio.sleep(0.001 * (request.data % 7) if isinstance(request.data, int) else 0)
        return {"success": bool(request.data), "message": str(request.data)}

    async with two_nodes() as (here, there):
        here.serve("~/flip", SET_BOOL, answer)
        calls = there.client("/line1/cam3/flip", SET_BOOL)
        replies = await soon(asyncio.gather(*(calls.call(data=bool(n % 2)) for n in range(40))))
        assert [reply.message for reply in replies] == ["False", "True"] * 20


async def test_a_handler_that_fails_is_told_by_an_ordinary_reply(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def fails(_: object) -> object:
        raise RosError("the camera is gone")

    async def breaks(_: object) -> object:
        raise ZeroDivisionError("by zero")

    async def wrong(_: object) -> object:
        return {"succes": True}

    async with two_nodes() as (here, there):
        for handler, text in ((fails, "is gone"), (breaks, "by zero"), (wrong, "succes")):
            name = handler.__name__
            here.serve(f"~/{name}", TRIGGER, handler)
            calls = there.client(f"/line1/cam3/{name}", TRIGGER)
            reply = await soon(calls.call(timeout=PATIENCE))
            assert (reply.success, text in reply.message) == (False, True)
        here.serve("~/sum", SUM, fails)  # whose reply has no field to say it
        with pytest.raises(ServiceCallError, match="is gone"):
            await soon(there.client("/line1/cam3/sum", SUM).call(timeout=PATIENCE))
        assert "by zero" in caplog.text


async def test_a_request_that_cannot_be_read_is_told_by_an_ordinary_reply() -> None:
    async with two_nodes() as (here, there):

        async def answers(kind: str, data: bytes, attachment: bytes | None) -> list[Any]:
            served = here.serve("~/it", kind, trigger)
            with contextlib.closing(there.client("/line1/cam3/it", kind)) as calls:
                await soon(calls.wait_served(PATIENCE))
                replies = there.context.zenoh.session.get(
                    calls.entity.key, payload=data, attachment=attachment, timeout=PATIENCE
                )
                found = await soon(asyncio.to_thread(list, replies))
            assert served.failed == 1
            served.close()
            await until(lambda: not there.graph.endpoints("/line1/cam3/it", "SS"))
            ok = [one.ok and one.ok.payload.to_bytes() for one in found]
            return [one and served.type.response.decode(one) for one in ok]

        extra = Attachment(5, 1, bytes(range(16))).encode()
        for data in (b"rubbish", b"", bytes(MAX_REQUEST_BYTES + 1)):
            (reply,) = await answers(TRIGGER, data, extra)
            assert not reply.success
            assert "expected" in reply.message or "no such message" in reply.message
        (reply,) = await answers("smartcam_msgs/srv/ChangeApplication", b"rubbish", extra)
        assert "expected CDR" in reply.error
        (reply,) = await answers("rcl_interfaces/srv/SetParameters", b"rubbish", extra)
        assert "expected CDR" in reply.results[0].reason
        (reply,) = await answers("rcl_interfaces/srv/GetParameters", b"rubbish", extra)
        assert reply.values == []
        (reply,) = await answers("lifecycle_msgs/srv/GetState", b"rubbish", extra)
        assert reply.current_state.label == "unknown"
        assert await answers(SUM, b"rubbish", extra) == [None]  # no sum is right
        assert await answers(TRIGGER, b"\0\1\0\0\0", None) == [None]  # it may be anybody's


async def test_nobody_serves_it() -> None:
    async with two_nodes() as (here, there):
        here.serve("~/trigger", SET_BOOL, trigger)
        calls = there.client("/line1/cam3/trigger", TRIGGER)
        await until(lambda: "/line1/cam3/trigger" in there.graph.services())
        with pytest.raises(ServiceTimeoutError, match="but one for std_srvs/srv/SetBool"):
            await calls.call(timeout=0.1)


async def test_a_call_ends_with_its_timeout_and_the_handler_with_its_own() -> None:
    ended = asyncio.Event()

    async def never(_: object) -> None:
        try:
            await asyncio.Event().wait()
        finally:
            ended.set()

    async with two_nodes() as (here, there):
        here.serve("~/never", TRIGGER, never, timeout=0.3)
        calls = there.client("/line1/cam3/never", TRIGGER)
        await soon(calls.wait_served(PATIENCE))
        with pytest.raises(ServiceTimeoutError, match="unknown"):
            await calls.call(timeout=0.05)
        await soon(ended.wait())
        assert "no answer in 0.3 s" in (await calls.call(timeout=PATIENCE)).message


async def test_calls_beyond_the_bound_are_refused() -> None:
    release = asyncio.Event()

    async def waits(_: object) -> dict[str, Any]:
        await release.wait()
        return {"success": True}

    async with two_nodes() as (here, there):
        served = here.serve("~/waits", TRIGGER, waits)
        calls = there.client("/line1/cam3/waits", TRIGGER)
        tasks = [
            asyncio.create_task(calls.call(timeout=PATIENCE))
            for _ in range(MAX_CONCURRENT_CALLS + 5)
        ]
        done, _ = await asyncio.wait(tasks, return_when="FIRST_COMPLETED", timeout=PATIENCE)
        assert "are running" in done.pop().result().message
        await until(lambda: served.calls == len(tasks))
        release.set()
        replies = await soon(asyncio.gather(*tasks))
        assert [one.success for one in replies].count(False) == 5
        assert (await soon(calls.call())).success


async def test_calls_that_no_reply_can_refuse_wait_for_their_turn() -> None:
    release, under_way, most = asyncio.Event(), 0, 0

    async def adds(request: Any) -> dict[str, Any]:
        nonlocal under_way, most
        under_way += 1
        most = max(most, under_way)
        await release.wait()
        under_way -= 1
        return {"sum": request.a + request.b}

    async with two_nodes() as (here, there):
        served = here.serve("~/adds", SUM, adds)
        calls = there.client("/line1/cam3/adds", SUM)
        count = MAX_CONCURRENT_CALLS + 5
        tasks = [asyncio.create_task(calls.call(a=n, b=1, timeout=PATIENCE)) for n in range(count)]
        await until(lambda: served.calls == count)
        assert most == MAX_CONCURRENT_CALLS
        release.set()
        replies = await soon(asyncio.gather(*tasks))
        assert [one.sum for one in replies] == [*range(1, count + 1)]
        assert most == MAX_CONCURRENT_CALLS


async def test_cancelling_a_call_leaves_the_client_usable() -> None:
    async with two_nodes() as (here, there):
        here.serve("~/trigger", TRIGGER, trigger)
        calls = there.client("/line1/cam3/trigger", TRIGGER)
        for _ in range(20):
            task = asyncio.create_task(calls.call())
            await asyncio.sleep(0)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
        assert (await soon(calls.call())).message == "done"


CALLER = """
import asyncio, sys
from smartcam.ros2 import Node

async def main():
    async with Node("caller", connect=sys.argv[1], domain=7) as node:
        calls = node.client("/line1/cam3/waits", "std_srvs/srv/Trigger")
        await calls.wait_served(60)
        print("calling", flush=True)
        await calls.call(timeout=600)

asyncio.run(main())
"""


async def test_a_call_ends_with_its_caller_which_is_killed(tmp_path: Path) -> None:
    began, ended = asyncio.Event(), asyncio.Event()

    async def waits(_: object) -> None:
        began.set()
        try:
            await asyncio.Event().wait()
        finally:
            ended.set()

    place = free_place()
    script = tmp_path / "caller.py"
    script.write_text(textwrap.dedent(CALLER))
    async with Node("cam3", namespace="line1", listen=place, domain=7) as here:
        here.serve("~/waits", TRIGGER, waits)
        caller = await asyncio.create_subprocess_exec(sys.executable, str(script), place)
        try:
            await soon(began.wait())
            assert "/caller" in here.graph.nodes()
            os.kill(caller.pid, signal.SIGKILL)
            await soon(ended.wait())
            await until(lambda: here.graph.nodes() == ["/line1/cam3"])
        finally:
            if caller.returncode is None:
                caller.kill()
            await caller.wait()


# ---------------------------------------------------------------------- the graph


async def test_the_graph_says_who_does_what_and_forgets_who_is_gone() -> None:
    async with two_nodes(parameters=False) as (here, there):
        here.publisher("chatter", STRING)
        served = here.serve("~/trigger", TRIGGER, trigger)
        there.subscribe("/line1/chatter", STRING)
        there.client("/line1/cam3/trigger", TRIGGER)
        for node in (here, there):
            graph = node.graph
            await until(lambda graph=graph: len(list(graph)) == 6)  # type: ignore[misc]
            assert graph.nodes() == ["/line1/cam3", "/viewer"]
            assert graph.topics() == {"/line1/chatter": [STRING]}
            assert graph.services() == {"/line1/cam3/trigger": [TRIGGER]}
            kinds = {one.kind for one in graph.of_node("/viewer")}
            assert kinds == {"MS", "SC"}
            assert [one.node for one in graph.endpoints("/line1/chatter", "MP")] == ["cam3"]
        served.close()
        await until(lambda: there.graph.services() == {})
        await here.stop()
        assert not here._endpoints


async def test_nodes_of_one_session_do_not_collide() -> None:
    place = free_place()
    context = RosContext(listen=place, domain=7)
    async with (
        Node("twin", context=context) as one,
        Node("twin", context=context) as other,
        Node("viewer", connect=place, domain=7) as viewer,
    ):
        one.publisher("chatter", STRING)
        other.publisher("chatter", STRING)
        await until(lambda: len(viewer.graph.endpoints("/chatter", "MP")) == 2)
        await until(lambda: viewer.graph.nodes() == ["/twin", "/twin", "/viewer"])
        await other.stop()
        await until(lambda: viewer.graph.nodes() == ["/twin", "/viewer"])
        assert len(viewer.graph.endpoints("/chatter", "MP")) == 1
        hears, says = viewer.subscribe("/chatter", STRING), one.publisher("/chatter", STRING)
        await until(lambda: says.has_subscribers)
        says.publish(data="still here")
        assert (await soon(anext(hears))).data == "still here"


async def test_domains_are_apart() -> None:
    place = free_place()
    async with (
        Node("cam3", listen=place, domain=7) as here,
        Node("viewer", connect=place, domain=8) as there,
    ):
        says = here.publisher("/chatter", STRING)
        there.subscribe("/chatter", STRING)
        await until(lambda: there.graph.endpoints("/chatter", "MS"))
        assert there.graph.nodes() == ["/viewer"]
        assert not says.has_subscribers


async def test_who_has_another_type_is_told(caplog: pytest.LogCaptureFixture) -> None:
    place = free_place()
    async with (
        Node("cam3", listen=place, domain=7) as here,
        Node("old", connect=place, domain=7, distribution="humble") as there,
    ):
        here.publisher("/chatter", STRING)
        here.serve("/trigger", TRIGGER, trigger)
        there.subscribe("/chatter", STRING)
        there.client("/trigger", TRIGGER)
        await until(lambda: caplog.text.count("do not hear each other") >= 2)
        assert "TypeHashNotSupported" in caplog.text


# ---------------------------------------------------------------------- life


async def test_without_a_router_there_is_an_error() -> None:
    with pytest.raises(ConnectFailedError, match="ROS 2: cannot reach"):
        async with Node("viewer", connect=free_place(), open_timeout=2):
            pass


async def test_a_closed_node_does_nothing() -> None:
    async with two_nodes() as (here, there):
        says, hears = here.publisher("chatter", STRING), there.subscribe("chatter", STRING)
        calls = there.client("/trigger", TRIGGER)
        waiting = asyncio.create_task(calls.call(timeout=PATIENCE))
        await asyncio.sleep(0)
        await here.stop()
        await there.stop()
        with pytest.raises(RosError, match="closed"):
            says.publish(data="x")
        with pytest.raises(StopAsyncIteration):
            await anext(hears)
        with pytest.raises(ServiceCallError):
            await soon(waiting)
        with pytest.raises(RosError, match="not open"):
            here.publisher("chatter", STRING)
        await here.stop()


async def test_opening_may_be_cancelled_and_closing_leaves_nothing() -> None:
    place = free_place()
    opening = asyncio.create_task(Node("viewer", connect=place, open_timeout=PATIENCE).start())
    await asyncio.sleep(0)
    opening.cancel()
    with pytest.raises((asyncio.CancelledError, ConnectFailedError)):
        await opening
    async with two_nodes() as (here, _):
        here.serve("~/trigger", TRIGGER, trigger)
    gc.collect()
    assert not [task for task in asyncio.all_tasks() if "_serve" in repr(task)]


def test_domains_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    assert RosContext().domain == 42
    assert RosContext(domain=3).domain == 3
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    with pytest.raises(ConfigurationError, match="ROS_DOMAIN_ID"):
        RosContext()
    monkeypatch.delenv("ROS_DOMAIN_ID")
    assert RosContext().domain == 0
    with pytest.raises(ConfigurationError, match="domain -1"):
        RosContext(domain=-1)


ROUTER = """
import asyncio, sys
from smartcam.ros2 import Node

async def main():
    async with Node("cam3", listen=sys.argv[1], domain=7) as node:
        says = node.publisher("/chatter", "std_msgs/msg/String")
        print("there", flush=True)
        while True:
            says.publish(data=sys.argv[2])
            await asyncio.sleep(0.02)

asyncio.run(main())
"""


async def test_a_router_that_is_killed_and_comes_back(tmp_path: Path) -> None:
    place = free_place()
    script = tmp_path / "router.py"
    script.write_text(textwrap.dedent(ROUTER))

    async def start(word: str) -> asyncio.subprocess.Process:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, str(script), place, word), stdout=asyncio.subprocess.PIPE
        )
        assert process.stdout is not None
        assert await soon(process.stdout.readline()) == b"there\n"
        return process

    router = await start("first")
    try:
        async with Node("viewer", connect=place, domain=7) as viewer:
            hears = viewer.subscribe("/chatter", STRING)
            assert (await soon(anext(hears))).data == "first"
            router.kill()
            await router.wait()
            await until(lambda: "/cam3" not in viewer.graph.nodes())
            router = await start("second")
            async with asyncio.timeout(PATIENCE):
                async for message in hears:
                    if message.data == "second":
                        break
            await until(lambda: "/cam3" in viewer.graph.nodes())
    finally:
        router.kill()
        await router.wait()


async def test_a_burst_comes_whole() -> None:
    async with two_nodes() as (here, there):
        hears = there.subscribe("/line1/chatter", STRING, qos=QoS(depth=2000))
        says = here.publisher("chatter", STRING, qos=QoS(depth=5))
        await until(lambda: says.has_subscribers)
        for _ in range(2):
            for n in range(500):
                says.publish(data=f"{n} {'x' * 4000}")
            came = [(await soon(anext(hears))).data.partition(" ")[0] for _ in range(500)]
            assert came == [str(n) for n in range(500)]
        assert not says.dropped


async def test_pause_of_a_link_loses_nothing_of_a_reliable_topic() -> None:
    """The engine drops silently what the event loop hands to it while its queue is full."""
    place = free_place()
    port = int(place.rpartition(":")[2])
    async with (
        Node("cam3", listen=place) as here,
        LinkProxy("127.0.0.1", port) as link,
        Node("viewer", connect=f"tcp/127.0.0.1:{link.port}") as there,
    ):
        hears = there.subscribe("/chatter", STRING, qos=QoS(depth=1000))
        says = here.publisher("chatter", STRING)
        await until(lambda: says.has_subscribers)
        link.stall()
        for n in range(300):
            says.publish(data=f"{n} {'x' * 50_000}")
            await asyncio.sleep(0.004)
        link.resume()
        came = [(await soon(anext(hears))).data.partition(" ")[0] for _ in range(300)]
        assert came == [str(n) for n in range(300)]
        assert not says.dropped
