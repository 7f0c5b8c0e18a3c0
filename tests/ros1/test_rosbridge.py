"""Nodes through a rosbridge: their operations, and a bridge that fails."""

from __future__ import annotations

import asyncio
import base64
import logging
import re
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import smartcam
from smartcam.exceptions import ConfigurationError, RosError, RosMessageError
from smartcam.ros1 import RosbridgeNode, _link, _outbox, _serving
from smartcam.ros1._link import web_socket
from smartcam.ros2 import QoS
from tests.fleet.fleetkit import until
from tests.frames.pictures import served as listening
from tests.frames.test_elsewhere import answering, nobody_comes, redirect
from tests.ros1.bridge import Bridge, Gone

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

FAST = smartcam.Backoff(initial=0.01, maximum=0.05)
LATCHED = QoS(latched=True, depth=1)
STRING, IMAGE = "std_msgs/msg/String", "sensor_msgs/msg/Image"
TRIGGER, EMPTY, SET = "std_srvs/srv/Trigger", "std_srvs/srv/Empty", "std_srvs/srv/SetBool"
PARAMETERS = "rcl_interfaces/srv/ListParameters"


@pytest.fixture
async def bridge() -> AsyncIterator[Bridge]:
    async with Bridge() as bridge:
        yield bridge


def node_of(bridge: Bridge) -> RosbridgeNode:
    return RosbridgeNode("cam3", namespace="/line1", bridge=bridge.url, backoff=FAST)


@pytest.fixture
async def node(bridge: Bridge) -> AsyncIterator[RosbridgeNode]:
    async with node_of(bridge) as node:
        await node.wait_connected(60)
        yield node


async def yes(_request: Any) -> Any:
    return {"success": True, "message": "yes"}


async def never(_request: Any) -> Any:
    await asyncio.Event().wait()


# ---------------------------------------------------------------------- topics


async def test_publish(bridge: Bridge, node: RosbridgeNode) -> None:
    publisher = node.publisher("~/status", STRING)
    assert publisher.has_subscribers
    publisher.publish(data="one")
    publisher.publish({"data": "two"})
    publisher.publish(publisher.type.new(data="three"))
    publisher.publish_encoded(publisher.type.encode({"data": "four"}))
    await bridge.until(lambda: len(bridge.published) == 4)
    name = "/line1/cam3/status"
    assert bridge.topics[name] == {
        "op": "advertise", "topic": name, "type": "std_msgs/String", "latch": False,
    }  # fmt: skip
    assert bridge.published[0] == {"op": "publish", "topic": name, "msg": {"data": "one"}}
    assert [one["msg"]["data"] for one in bridge.published] == ["one", "two", "three", "four"]
    assert (publisher.published, publisher.dropped) == (4, 0)
    publisher.close()
    publisher.close()
    await bridge.until(lambda: name not in bridge.topics)
    with pytest.raises(RosError, match="/line1/cam3/status: this publisher is closed"):
        publisher.publish(data="five")
    async with node.publisher("~/status", STRING) as again:
        again.publish(data="six")
        await bridge.until(lambda: len(bridge.published) == 5)


async def test_names(bridge: Bridge, node: RosbridgeNode) -> None:
    for topic in ("/tf", "poses", "~/poses"):
        node.publisher(topic, STRING)
    await bridge.until(lambda: len(bridge.topics) == 3)
    assert {*bridge.topics} == {"/tf", "/line1/poses", "/line1/cam3/poses"}
    assert (node.full_name, node.name, node.namespace) == ("/line1/cam3", "cam3", "/line1")
    assert node.parameters is None


async def test_a_picture(bridge: Bridge, node: RosbridgeNode) -> None:
    data = bytes(range(256)) * 1600  # of several parts, none a multiple of three
    publisher = node.publisher("~/image_raw", IMAGE)
    publisher.publish(height=640, width=640, encoding="mono8", step=640, data=data)
    await bridge.until(lambda: bridge.published)
    message = bridge.published[0]["msg"]
    assert base64.b64decode(message["data"]) == data
    assert message["header"] == {"seq": 0, "stamp": {"secs": 0, "nsecs": 0}, "frame_id": ""}
    assert (message["height"], message["encoding"]) == (640, "mono8")


async def test_no_message(node: RosbridgeNode) -> None:
    publisher = node.publisher("~/status", STRING)
    with pytest.raises(RosMessageError, match="data: expected string, got 5"):
        publisher.publish(data=5)
    with pytest.raises(RosMessageError, match="a message or its fields, got both"):
        publisher.publish({"data": "a"}, data="b")
    with pytest.raises(
        RosMessageError, match="std_msgs/msg/String: expected a message of this type"
    ):
        publisher.publish(node.types.message("std_msgs/msg/Bool").new())
    assert publisher.published == publisher.dropped == 0


async def test_without_a_bridge_the_last_latched_message_is_kept(bridge: Bridge) -> None:
    await bridge.stop()
    async with node_of(bridge) as node:
        status = node.publisher("~/status", STRING, qos=LATCHED)
        results = node.publisher("~/results", STRING)
        for number in range(3):
            status.publish(data=f"s{number}")
            results.publish(data=f"r{number}")
        assert (status.dropped, results.dropped) == (0, 3)
        assert (status.has_subscribers, results.has_subscribers) == (True, False)
        with pytest.raises(TimeoutError):
            await node.wait_connected(5)
        assert node.failure.startswith(f"{bridge.url}: [Errno ")
        await bridge.start()
        await node.wait_connected(60)
        assert node.failure == ""
        results.publish(data="r3")
        await bridge.until(lambda: len(bridge.published) == 2)
        assert bridge.published == [
            {"op": "publish", "topic": status.name, "latch": True, "msg": {"data": "s2"}},
            {"op": "publish", "topic": results.name, "msg": {"data": "r3"}},
        ]
        assert bridge.topics[status.name]["latch"] is True


async def test_everything_is_there_again(bridge: Bridge, node: RosbridgeNode) -> None:
    status = node.publisher("~/status", STRING, qos=LATCHED)
    node.serve("~/trigger", TRIGGER, yes)
    status.publish(data="first")
    await bridge.until(lambda: bridge.published and bridge.services)
    for number in range(1, 4):
        await bridge.restart()
        await bridge.until(lambda: status.name in bridge.topics)
        response = await bridge.call("/line1/cam3/trigger")
        assert (response["result"], response["values"]["message"]) == (True, "yes")
        await bridge.until(lambda number=number: len(bridge.published) == number + 1)
    assert {one["msg"]["data"] for one in bridge.published} == {"first"}


async def test_what_is_latched_and_shared_is_said_again(
    bridge: Bridge, node: RosbridgeNode
) -> None:
    shared = node.publisher("/tf_static", "tf2_msgs/msg/TFMessage", qos=LATCHED)
    own = node.publisher("~/status", STRING, qos=LATCHED)
    own.publish(data="once")
    shared.publish(transforms=[{"child_frame_id": "cam3"}])
    await bridge.until(lambda: len(bridge.published) == 4)
    assert [one["topic"] for one in bridge.published].count(own.name) == 1


@pytest.mark.real_time  # full buffers of sockets are emptied in the system's time
async def test_newest_pictures_win_over_a_bridge_that_does_not_read(
    bridge: Bridge, node: RosbridgeNode
) -> None:
    publisher = node.publisher("~/image_raw", IMAGE, qos=QoS(depth=2))
    await bridge.until(lambda: publisher.name in bridge.topics)
    bridge.reading.clear()
    data = bytes(1_000_000)
    for number in range(60):  # more than any buffer of sockets holds
        publisher.publish(height=number, data=data)
        await asyncio.sleep(0)
    waiting = len(publisher.queue._waiting)  # one less where the last turn has taken one
    assert publisher.published + publisher.dropped + waiting == 60
    assert publisher.dropped > 30
    assert publisher.queue.waiting_bytes < 3_000_000
    bridge.reading.set()
    await bridge.until(lambda: bridge.published and bridge.published[-1]["msg"]["height"] == 59)
    heights = [one["msg"]["height"] for one in bridge.published]
    assert heights == sorted({*heights})
    assert heights[-2:] == [58, 59]
    assert node.connected


async def test_a_topic_has_so_many_bytes(
    bridge: Bridge, node: RosbridgeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_outbox, "MAX_WAITING_BYTES", 3000)
    publisher = node.publisher("~/image_raw", IMAGE, qos=QoS(depth=100))
    for number in range(5):
        publisher.publish(height=number, data=bytes(900))
    publisher.publish(height=5, data=bytes(9000))  # alone it may
    assert publisher.dropped == 5
    await bridge.until(lambda: bridge.published)
    assert [one["msg"]["height"] for one in bridge.published] == [5]


async def test_a_bridge_that_reads_no_more_is_left(
    bridge: Bridge, node: RosbridgeNode, caplog: pytest.LogCaptureFixture
) -> None:
    publisher = node.publisher("~/image_raw", IMAGE, qos=QoS(depth=1))
    bridge.reading.clear()
    while node.connected:
        publisher.publish(data=bytes(1_000_000))
        await asyncio.sleep(0.1)
    # which comes first: nobody reads what is sent, or nobody answers a ping
    assert "did not read a message within 10 s" in caplog.text or "PONG" in caplog.text
    bridge.reading.set()
    await node.wait_connected(60)


async def test_who_hears_pictures(bridge: Bridge) -> None:
    subscribers: Any = {"values": {"subscribers": ["/viewer"]}, "result": True}
    bridge.rosapi = lambda asked: subscribers if asked == {"topic": "/line1/cam3/image"} else None
    async with node_of(bridge) as node:
        image, text = node.publisher("~/image", IMAGE), node.publisher("~/text", STRING)
        await node.wait_connected(60)
        assert image.has_subscribers
        assert text.has_subscribers
        await asyncio.sleep(5)
        assert image.has_subscribers
        subscribers = {"values": {"subscribers": []}, "result": True}
        await asyncio.sleep(5)
        assert not image.has_subscribers
        assert text.has_subscribers
        image.publish(data=b"abc")  # it may be said all the same
        await bridge.until(lambda: bridge.published)
        for nothing in (None, {"values": "none", "result": False}, {"values": {}}, {}):
            subscribers = nothing
            await asyncio.sleep(5)
            assert image.has_subscribers
            subscribers = {"values": {"subscribers": []}, "result": True}
            await bridge.restart()
            await node.wait_connected(60)
            await asyncio.sleep(5)
            assert not image.has_subscribers


async def test_what_ros1_has_not_is_left_out(
    bridge: Bridge, node: RosbridgeNode, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    absent = node.publisher("~/detections", "vision_msgs/msg/Detection3DArray")
    served = node.serve("~/list_parameters", PARAMETERS, yes)
    absent.publish(detections=[])
    assert not absent.has_subscribers
    there = node.publisher("~/status", STRING)
    there.publish(data="a")
    await bridge.until(lambda: bridge.published)
    assert [*bridge.topics] == [there.name]
    assert "left out, ROS 1 has no vision_msgs/msg/Detection3DArray" in caplog.text
    assert "left out, ROS 1 has no rcl_interfaces/srv/ListParameters" in caplog.text
    absent.close()
    served.close()
    await bridge.restart()
    await bridge.until(lambda: there.name in bridge.topics)
    assert not bridge.services


# ---------------------------------------------------------------------- services


async def test_call(bridge: Bridge, node: RosbridgeNode) -> None:
    heard = []

    async def handler(request: Any) -> Any:
        heard.append(request.data)
        return service.type.response.new(success=request.data, message="grün")

    service = node.serve("~/set", SET, handler)
    response = await bridge.call("/line1/cam3/set", {"data": True})
    assert response == {
        "op": "service_response",
        "service": "/line1/cam3/set",
        "id": "service_request:/line1/cam3/set:1",
        "result": True,
        "values": {"success": True, "message": "grün"},
    }
    response = await bridge.call("/line1/cam3/set", [False])
    assert response["values"]["success"] is False
    assert heard == [True, False]
    assert (service.calls, service.failed) == (2, 0)


async def test_calls_side_by_side(bridge: Bridge, node: RosbridgeNode) -> None:
    gates = {True: asyncio.Event(), False: asyncio.Event()}

    async def handler(request: Any) -> Any:
        await gates[request.data].wait()
        return {"success": request.data}

    node.serve("~/set", SET, handler)
    calls = [
        asyncio.create_task(bridge.call("/line1/cam3/set", {"data": one})) for one in (True, False)
    ]
    gates[False].set()
    assert (await calls[1])["values"]["success"] is False
    gates[True].set()
    assert (await calls[0])["values"]["success"] is True


@pytest.mark.parametrize(
    ("args", "text"),
    [
        ({"date": True}, "date: no such field, expected data"),
        ({"data": "yes"}, "data: expected bool, got 'yes'"),
        ("yes", "expected an object, got 'yes'"),
        ([True, True], "expected up to 1 values, got 2"),
    ],
)
async def test_a_request_that_is_none(
    bridge: Bridge, node: RosbridgeNode, args: Any, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    service = node.serve("~/set", SET, yes)
    response = await bridge.call("/line1/cam3/set", args)
    assert response["result"] is False
    assert response["values"]["success"] is False
    assert text in response["values"]["message"]
    assert text in caplog.text
    assert service.failed == 1


async def refuses(_request: Any) -> Any:
    raise smartcam.TriggerError("the camera is not running")


async def breaks(_request: Any) -> Any:
    raise ValueError("a mistake")


async def gives_another(_request: Any) -> Any:
    return {"succes": True}


HANDLERS = {
    refuses: "the camera is not running",
    breaks: "ValueError: a mistake",
    gives_another: "succes: .* has no such field",
    never: "no answer in 5 s",
}


@pytest.mark.parametrize("handler", HANDLERS, ids=lambda one: one.__name__)
async def test_errors_are_in_the_field_for_them(
    bridge: Bridge, node: RosbridgeNode, handler: Any, caplog: pytest.LogCaptureFixture
) -> None:
    node.serve("~/trigger", TRIGGER, handler, timeout=5)
    response = await bridge.call("/line1/cam3/trigger")
    assert (response["result"], response["values"]["success"]) == (False, False)
    assert re.search(HANDLERS[handler], response["values"]["message"])
    assert re.search(HANDLERS[handler], caplog.text)


async def test_errors_without_a_field_for_them(bridge: Bridge, node: RosbridgeNode) -> None:
    fails, others = asyncio.Event(), []

    async def handler(_request: Any) -> Any:
        others.append(1)
        if len(others) == 1:
            return {}
        if len(others) == 3:
            await fails.wait()
            raise smartcam.TriggerError("no")
        return await never(_request)

    service = node.serve("~/empty", EMPTY, handler)
    assert (await bridge.call("/line1/cam3/empty"))["values"] == {}
    calls = [asyncio.create_task(bridge.call("/line1/cam3/empty")) for _ in range(2)]
    await bridge.until(lambda: bridge.services["/line1/cam3/empty"].count == 3)
    fails.set()
    for call in calls:
        with pytest.raises(Gone):
            await call
    others.clear()
    assert (await bridge.call("/line1/cam3/empty"))["values"] == {}
    assert service.failed == 1


async def test_responses_are_handed_over_before_their_service_goes(
    bridge: Bridge, node: RosbridgeNode
) -> None:
    """One that the bridge has not handed over stays, for the call of the same number."""
    numbers: list[int] = []

    async def handler(_request: Any) -> Any:
        numbers.append(len(numbers))
        if len(numbers) == 2:
            raise smartcam.TriggerError("no")
        return {}

    service = node.serve("~/empty", EMPTY, handler)
    first, second = [asyncio.create_task(bridge.call(service.name)) for _ in range(2)]
    assert (await first)["result"] is True
    with pytest.raises(Gone):
        await second
    await bridge.call(service.name)
    assert len(numbers) == 3


async def test_a_call_of_before_is_not_carried_out_afterwards(
    bridge: Bridge, node: RosbridgeNode
) -> None:
    """The bridge has aborted it, and would give its answer to the call of the same number."""
    numbers: list[int] = []

    async def handler(_request: Any) -> Any:
        numbers.append(len(numbers))
        if len(numbers) == 1:
            raise smartcam.TriggerError("no")
        return {}

    service = node.serve("~/empty", EMPTY, handler)
    number = f"service_request:{service.name}:1"
    bridge.late = {"op": "call_service", "id": number, "service": service.name}
    await bridge.until(lambda: service.name in bridge.services)
    before = bridge.services[service.name]
    with pytest.raises(Gone):
        await bridge.call(service.name)
    await bridge.another(service.name, before)
    await asyncio.sleep(2)
    assert len(numbers) == 1
    bridge.late = None
    assert (await bridge.call(service.name))["id"] == number
    assert len(numbers) == 2


async def test_a_handler_that_does_not_end_answers_nobody_afterwards(
    bridge: Bridge, node: RosbridgeNode
) -> None:
    began, goes_on = [asyncio.Event(), asyncio.Event()], asyncio.Event()

    async def handler(_request: Any) -> Any:
        if not began[0].is_set():
            began[0].set()
            try:
                await asyncio.Event().wait()
            except asyncio.CancelledError:
                await goes_on.wait()
                return {"message": "old"}
        began[1].set()
        await goes_on.wait()
        await asyncio.sleep(1)
        return {"message": "new"}

    service = node.serve("~/trigger", TRIGGER, handler)
    old = asyncio.create_task(bridge.call(service.name))
    await began[0].wait()
    before = bridge.services[service.name]
    await bridge.cut()
    await bridge.another(service.name, before)
    new = asyncio.create_task(bridge.call(service.name))
    await began[1].wait()
    goes_on.set()
    assert (await new)["values"]["message"] == "new"
    with pytest.raises(Gone):
        await old
    assert sum(one["op"] == "service_response" for one in bridge.said) == 1


async def test_too_many_calls(
    bridge: Bridge, node: RosbridgeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_serving, "MAX_CONCURRENT_CALLS", 3)
    node.serve("~/trigger", TRIGGER, never)
    calls = [asyncio.create_task(bridge.call("/line1/cam3/trigger")) for _ in range(4)]
    response = await calls[3]
    assert "3 calls are running, the maximum" in response["values"]["message"]
    await node.stop()
    for call in calls[:3]:
        with pytest.raises(Gone):
            await call


async def test_a_call_ends_with_its_bridge(bridge: Bridge, node: RosbridgeNode) -> None:
    began, ended = asyncio.Event(), asyncio.Event()

    async def handler(_request: Any) -> Any:
        began.set()
        try:
            await asyncio.Event().wait()
        finally:
            ended.set()

    node.serve("~/trigger", TRIGGER, handler)
    call = asyncio.create_task(bridge.call("/line1/cam3/trigger"))
    await began.wait()
    await bridge.restart()
    with pytest.raises(Gone):
        await call
    await ended.wait()


async def test_who_waited_at_the_bridge_gets_no_answer_to_another(
    bridge: Bridge, node: RosbridgeNode
) -> None:
    """The link breaks and the bridge lives: it counts the calls from one again."""
    number = 0

    async def handler(_request: Any) -> Any:
        nonlocal number
        number += 1
        if number == 1:
            await asyncio.Event().wait()
        return {"message": str(number)}

    node.serve("~/trigger", TRIGGER, handler)
    old = asyncio.create_task(bridge.call("/line1/cam3/trigger"))
    await bridge.until(lambda: bridge.services and bridge.services["/line1/cam3/trigger"].count)
    first = bridge.services["/line1/cam3/trigger"]
    await bridge.cut()
    late = asyncio.create_task(bridge.call("/line1/cam3/trigger"))  # with nobody behind it
    await bridge.another("/line1/cam3/trigger", first)
    assert (await bridge.call("/line1/cam3/trigger"))["values"]["message"] == "2"
    for call in (old, late):
        with pytest.raises(Gone):
            await call


async def test_close_a_service(bridge: Bridge, node: RosbridgeNode) -> None:
    service = node.serve("~/trigger", TRIGGER, never)
    call = asyncio.create_task(bridge.call("/line1/cam3/trigger"))
    await bridge.until(lambda: bridge.services and bridge.services[service.name].count)
    service.close()
    service.close()
    with pytest.raises(Gone):
        await call
    await service.wait_closed()
    async with node.serve("~/trigger", TRIGGER, yes):
        assert (await bridge.call("/line1/cam3/trigger"))["result"] is True


async def test_close_services_one_after_another(bridge: Bridge, node: RosbridgeNode) -> None:
    services = [node.serve(f"~/trigger{one}", TRIGGER, yes) for one in range(3)]
    await bridge.until(lambda: len(bridge.services) == 3)
    for number, service in enumerate(services, 1):  # each while the one before is withdrawn
        service.close()
        await bridge.until(lambda number=number: len(bridge.services) <= 3 - number)
        again = node.serve(f"~/again{number}", TRIGGER, yes)
        again.close()
    await bridge.until(lambda: not bridge.services)
    node.serve("~/last", TRIGGER, yes)
    assert (await bridge.call("/line1/cam3/last"))["result"] is True
    assert not node._to_withdraw
    assert [*bridge.services] == ["/line1/cam3/last"]


async def test_who_is_told_of_a_bridge_may_fail(
    bridge: Bridge, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(_node: RosbridgeNode) -> None:
        raise ValueError("no")

    async with RosbridgeNode("a", bridge=bridge.url, backoff=FAST, on_change=fails) as node:
        node.serve("~/trigger", TRIGGER, yes)
        assert (await bridge.call("/a/trigger"))["result"] is True
        await bridge.restart()
        assert (await bridge.call("/a/trigger"))["result"] is True
    assert caplog.text.count("ValueError: no") >= 3


async def test_a_call_of_what_is_not_served(
    bridge: Bridge, node: RosbridgeNode, caplog: pytest.LogCaptureFixture
) -> None:
    for service in (5, None, "/other"):
        await bridge.say({"op": "call_service", "id": 7, "service": service})
    await bridge.say('{"op": "call_service", "id": NaN, "service": "/other"}')
    await bridge.until(lambda: any(one["op"] == "service_response" for one in bridge.said))
    answer = {"op": "service_response", "service": "/other", "id": 7, "result": False}
    assert answer in bridge.said
    assert "got a call of '/other', which it does not serve" in caplog.text
    node.serve("~/trigger", TRIGGER, yes)
    assert (await bridge.call("/line1/cam3/trigger"))["result"] is True


# ---------------------------------------------------------------------- bridges


async def test_the_bridges_errors_are_in_the_log(
    bridge: Bridge, node: RosbridgeNode, caplog: pytest.LogCaptureFixture
) -> None:
    status = {"op": "status", "level": "error", "id": "advertise:1", "msg": "no such type"}
    await bridge.say(status)
    await bridge.say({"op": "status", "level": ["?"], "msg": None})
    node.serve("~/trigger", TRIGGER, yes)
    assert (await bridge.call("/line1/cam3/trigger"))["result"] is True
    found = [one for one in caplog.records if one.levelno == logging.ERROR]
    assert [one.getMessage() for one in found] == [
        "/line1/cam3: the bridge says (advertise:1): no such type"
    ]


@pytest.mark.parametrize("text", ["[]", "no JSON", '{"op": 5}', "[" * 5000, '{"a": 1}'])
async def test_what_is_no_operation(
    bridge: Bridge, node: RosbridgeNode, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    await bridge.say(text)
    await bridge.say('{"op": "of later"}')
    node.serve("~/trigger", TRIGGER, yes)
    assert (await bridge.call("/line1/cam3/trigger"))["result"] is True
    assert "expected an operation of rosbridge" in caplog.text


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=5,
)
OPERATIONS = st.fixed_dictionaries(
    {"op": st.sampled_from(["call_service", "status", "service_response", "publish"]) | JSON},
    optional={
        "id": JSON,
        "service": st.just("/line1/cam3/set") | JSON,
        "args": st.fixed_dictionaries({"data": JSON}) | JSON,
        "level": st.just("error") | JSON,
        "msg": JSON,
    },
)


async def test_nothing_that_a_bridge_says_ends_a_node(bridge: Bridge, node: RosbridgeNode) -> None:
    node.serve("~/set", SET, yes)
    await bridge.until(lambda: bridge.services)
    said = []

    @given(OPERATIONS)
    def collect(operation: dict[str, Any]) -> None:
        said.append(operation)

    collect()
    for operation in said:
        await bridge.say(operation)
    assert (await bridge.call("/line1/cam3/set", {"data": True}))["result"] is True
    assert len(bridge.links) == 1


async def test_bytes_are_of_another_mode(
    bridge: Bridge, node: RosbridgeNode, caplog: pytest.LogCaptureFixture
) -> None:
    await bridge.links[0].send_bytes(b"\x05\0\0\0\0")
    node.serve("~/trigger", TRIGGER, yes)
    assert (await bridge.call("/line1/cam3/trigger"))["result"] is True
    assert "expected text, got binary: is it in BSON mode?" in caplog.text


async def test_a_message_that_is_too_long(bridge: Bridge, node: RosbridgeNode) -> None:
    node.serve("~/trigger", TRIGGER, yes)
    await bridge.until(lambda: bridge.services)
    before = bridge.services["/line1/cam3/trigger"]
    await bridge.say(" " * (_link.MAX_MESSAGE_BYTES + 1))
    await bridge.another("/line1/cam3/trigger", before)
    assert (await bridge.call("/line1/cam3/trigger"))["result"] is True


@pytest.mark.real_time  # full buffers of sockets are emptied in the system's time
async def test_answers_to_a_bridge_that_does_not_read_have_a_bound(
    bridge: Bridge, node: RosbridgeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_outbox, "MAX_WAITING_OPERATIONS", 8)
    service = node.serve("~/trigger", TRIGGER, yes)
    await bridge.until(lambda: bridge.services)
    publisher = node.publisher("~/image_raw", IMAGE)
    bridge.reading.clear()
    for _ in range(30):
        publisher.publish(data=bytes(1_000_000))
        await asyncio.sleep(0.001)

    async def call() -> None:
        for number in range(200):
            await bridge.say({"op": "call_service", "service": service.name, "id": str(number)})

    calling = asyncio.create_task(call())
    while not node._outbox.is_full:  # noqa: ASYNC110 - there is no event for it
        await asyncio.sleep(0.001)
    assert service.calls < 20
    bridge.reading.set()
    await bridge.until(lambda: sum(one["op"] == "service_response" for one in bridge.said) == 200)
    await calling


@pytest.mark.parametrize(
    "url", ["", "host:9090", "http://host:9090", "ws://", "ws://host:0", "ws://host:x", "ws://[::1"]
)
def test_no_url(url: str) -> None:
    with pytest.raises(
        ConfigurationError, match=r"expected a URL such as ws://192\.168\.0\.5:9090"
    ):
        RosbridgeNode("cam3", bridge=url)


@pytest.mark.parametrize(("name", "namespace"), [("", "/"), ("a/b", "/"), ("a", "/b b")])
def test_no_name(name: str, namespace: str) -> None:
    with pytest.raises(ConfigurationError, match="expected"):
        RosbridgeNode(name, namespace=namespace, bridge="ws://localhost:9090")


async def test_what_is_there_already(bridge: Bridge) -> None:
    node = node_of(bridge)
    with pytest.raises(RosError, match="/line1/cam3: the node is not open"):
        node.publisher("~/a", STRING)
    async with node:
        node.publisher("~/a", STRING)
        node.serve("~/a", TRIGGER, yes)
        with pytest.raises(ConfigurationError, match="the topic /line1/cam3/a is there already"):
            node.publisher("/line1/cam3/a", STRING)
        with pytest.raises(ConfigurationError, match="the service /line1/cam3/a is there already"):
            node.serve("~/a", TRIGGER, yes)
    async with node:  # once more
        node.serve("~/a", TRIGGER, yes)
        assert (await bridge.call("/line1/cam3/a"))["result"] is True
    await bridge.until(lambda: not bridge.services)
    await node.stop()


async def test_stop_withdraws_what_there_is(bridge: Bridge) -> None:
    async with node_of(bridge) as node:
        await node.wait_connected(60)
        for number in range(20):
            node.serve(f"~/trigger{number}", TRIGGER, yes)
        await bridge.call("/line1/cam3/trigger19")
        publisher = node.publisher("~/status", STRING)
        publisher.publish(data="the last words")
        began = asyncio.get_running_loop().time()
    assert not bridge.services
    assert bridge.published[-1]["msg"]["data"] == "the last words"
    assert asyncio.get_running_loop().time() - began < 6  # a second each, one after another: 20


@pytest.mark.parametrize("delay", [0.0, 0.0005, 0.001, 0.3, 0.6, 2.0])
async def test_stop_can_be_cancelled(bridge: Bridge, delay: float) -> None:
    node = node_of(bridge)
    await node.start()
    await node.wait_connected(60)
    node.serve("~/trigger", TRIGGER, yes)
    await bridge.call("/line1/cam3/trigger")
    before = bridge.services["/line1/cam3/trigger"]
    stopping = asyncio.create_task(node.stop())
    await asyncio.sleep(delay)
    stopping.cancel()
    await asyncio.wait((stopping,))
    assert not node.connected
    await bridge.until(lambda: not bridge.links)
    async with node:
        node.serve("~/trigger", TRIGGER, yes)
        await bridge.another("/line1/cam3/trigger", before)
        assert (await bridge.call("/line1/cam3/trigger"))["result"] is True


# ---------------------------------------------------------------------- what is heard


async def test_a_topic_is_heard_also_from_another_bridge(
    bridge: Bridge, node: RosbridgeNode
) -> None:
    heard = node.subscribe("text", STRING, qos=QoS(depth=2))
    await bridge.until(lambda: bridge.heard)
    (asked,) = bridge.heard.values()
    assert (asked["topic"], asked["type"], asked["queue_length"]) == (
        *("/line1/text", "std_msgs/String"),
        2,
    )
    await bridge.publish("/line1/text", {"data": "one"})
    assert (await anext(heard)).data == "one"
    bridge.heard.clear()
    await bridge.restart()
    await bridge.until(lambda: bridge.heard)
    await bridge.publish("/line1/text", {"data": "two"})
    assert (await anext(heard)).data == "two"
    heard.close()
    await bridge.until(lambda: not bridge.heard)
    heard.close()
    assert [one async for one in heard] == []


async def test_newest_messages_wait_and_wrong_ones_are_left_out(
    bridge: Bridge, node: RosbridgeNode
) -> None:
    heard, other = (node.subscribe("text", STRING, qos=QoS(depth=3)) for _ in range(2))
    await bridge.until(lambda: len(bridge.heard) == 2)
    for said in ({"data": "old"}, {"data": 1}, {"date": ""}, {"data": "new"}):
        await bridge.publish("/line1/text", said)
    await until(lambda: other.statistics().offered == 4)
    assert (await anext(heard)).data == "new"
    assert (heard.rejected, heard.statistics().dropped) == (2, 1)
    assert (await anext(other)).data == "new"


async def test_what_ros1_has_not_is_not_asked_for(bridge: Bridge, node: RosbridgeNode) -> None:
    heard = node.subscribe("found", "vision_msgs/msg/Detection3DArray")
    assert not heard.has_ros1_type
    heard.close()
    with pytest.raises(ConfigurationError):
        node.subscribe("no topic", STRING)
    await node.stop()
    with pytest.raises(RosError, match="the node is not open"):
        node.subscribe("text", STRING)
    assert not bridge.heard


async def test_a_bridge_that_sends_us_elsewhere_is_none() -> None:
    async with nobody_comes() as there:
        for to in (f"http://127.0.0.1:{there.port}/", f"ws://127.0.0.1:{there.port}/", "/other"):
            asked: list[str] = []

            def answer(path: str, to: str = to, asked: list[str] = asked) -> bytes:
                asked.append(path)
                return redirect(to)

            async with listening(answering(answer)) as port:
                with pytest.raises(OSError, match="got a redirect to"):
                    async with web_socket(f"ws://127.0.0.1:{port}/"):
                        pass
            assert asked == ["/"]
