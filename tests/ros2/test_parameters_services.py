"""Parameters of a node, used by other nodes over TCP."""

from __future__ import annotations

import asyncio
import hashlib
import json
from collections.abc import AsyncIterator
from typing import Any

import pytest

from smartcam.exceptions import (
    ConfigurationError,
    RosMessageError,
    ServiceCallError,
    ServiceTimeoutError,
    SmartCamError,
)
from smartcam.ros2 import Node
from smartcam.ros2._inside import RosContext
from tests.processes import free_place
from tests.ros2.inside import PARAMETERS
from tests.ros2.roskit import STRING, soon, two_nodes, until

pytestmark = pytest.mark.real_time

CAMERA = "/line1/cam3"
SERVICES = {
    "describe_parameters": "rcl_interfaces/srv/DescribeParameters",
    "get_parameter_types": "rcl_interfaces/srv/GetParameterTypes",
    "get_parameters": "rcl_interfaces/srv/GetParameters",
    "list_parameters": "rcl_interfaces/srv/ListParameters",
    "set_parameters": "rcl_interfaces/srv/SetParameters",
    "set_parameters_atomically": "rcl_interfaces/srv/SetParametersAtomically",
}
OWN = ["use_sim_time", "start_type_description_service"]
MANY = 10_000


@pytest.fixture
async def nodes(no_leaks: None) -> AsyncIterator[tuple[Node, Node]]:
    async with two_nodes() as both:
        yield both


async def call(node: Node, service: str, **fields: Any) -> Any:
    async with node.client(f"{CAMERA}/{service}", SERVICES[service]) as client:
        return await client.call(**fields, timeout=60)


def integer(name: str, value: int) -> dict[str, Any]:
    return {"name": name, "value": {"type": 2, "integer_value": value}}


async def test_every_node_has_the_services(nodes: tuple[Node, Node]) -> None:
    here, there = nodes
    await until(lambda: len(there.graph.of_node(CAMERA)) == 8)
    services = [one for one in there.graph.of_node(CAMERA) if one.kind == "SS"]
    found = {one.name.removeprefix(f"{CAMERA}/"): one.ros_type for one in services}
    described = "type_description_interfaces/srv/GetTypeDescription"
    assert found == {**SERVICES, "get_type_description": described}
    assert {one.qos for one in services if "parameter" in one.name} == {PARAMETERS}
    (events,) = there.graph.endpoints("/parameter_events", "MP")[:1]
    assert (events.ros_type, events.qos) == ("rcl_interfaces/msg/ParameterEvent", PARAMETERS)
    async with Node("quiet", context=here.context, parameters=False) as quiet:
        quiet.parameters.declare("a", 1)
        assert quiet.parameters.get("a") == 1
        await until(lambda: "/quiet" in there.graph.nodes())
        assert there.graph.of_node("/quiet") == []


async def test_humble_describes_no_types() -> None:
    context = RosContext(listen=free_place(), domain=7, distribution="humble")
    async with Node("old", context=context) as old:
        assert old.parameters.names() == ["use_sim_time"]
        await until(lambda: len(old.graph.of_node("/old")) == 7)
        async with Node("asks", context=context) as asks, asks.parameters_of("old") as client:
            assert await client.get("use_sim_time") == {"use_sim_time": False}


LISTED: list[tuple[list[str], int, list[str], list[str]]] = [
    ([], 0, ["a", "g.x", "g.h.y", "gg.z"], ["g", "g.h", "gg"]),
    ([], 1, ["a"], []),
    ([], 2, ["a", "g.x", "gg.z"], ["g", "gg"]),
    ([], 1 << 63, ["a", "g.x", "g.h.y", "gg.z"], ["g", "g.h", "gg"]),
    (["g"], 0, ["g.x", "g.h.y"], ["g", "g.h"]),
    (["g"], 1, ["g.x"], ["g"]),
    (["g"], 2, ["g.x", "g.h.y"], ["g", "g.h"]),
    (["g.h", "a"], 1, ["a", "g.h.y"], ["g.h"]),
    (["g.x"], 1, ["g.x"], ["g"]),
    (["g."], 0, [], []),
    ([""], 0, [], []),
    (["nothing"], 0, [], []),
]


async def test_lists(shared: tuple[Node, Node]) -> None:
    _, there = shared
    for prefixes, depth, names, groups in LISTED:
        result = (await call(there, "list_parameters", prefixes=prefixes, depth=depth)).result
        found = [one for one in result.names if one not in OWN]
        assert (prefixes, depth, found) == (prefixes, depth, names)
        assert (prefixes, depth, result.prefixes) == (prefixes, depth, groups)


@pytest.fixture
async def shared() -> AsyncIterator[tuple[Node, Node]]:
    async with two_nodes() as (here, there):
        for number, name in enumerate(("a", "g.x", "g.h.y", "gg.z")):
            here.parameters.declare(name, number, minimum=0, description=name.upper())
        yield here, there


async def test_gets_and_describes(shared: tuple[Node, Node]) -> None:
    here, there = shared
    here.parameters.declare("d", 0.5, minimum=0, maximum=2, step=0.25, read_only=True)
    names = ["g.x", "d", "use_sim_time", "g.x"]
    values = (await call(there, "get_parameters", names=names)).values
    assert [one.type for one in values] == [2, 3, 1, 2]
    assert [values[0].integer_value, values[1].double_value, values[2].bool_value] == [1, 0.5, 0]
    types = (await call(there, "get_parameter_types", names=names)).types
    assert list(types) == [2, 3, 1, 2]
    first, second, *_ = (await call(there, "describe_parameters", names=names)).descriptors
    assert (first.name, first.type, first.description) == ("g.x", 2, "G.X")
    (bounds,) = first.integer_range
    assert (bounds.from_value, bounds.to_value, bounds.step) == (0, (1 << 63) - 1, 0)
    (bounds,) = second.floating_point_range
    assert (bounds.from_value, bounds.to_value, bounds.step) == (0, 2, 0.25)
    assert (first.read_only, second.read_only, second.dynamic_typing) == (False, True, False)
    # one that is not declared leaves the answer empty, as rclcpp and rclpy have it
    assert (await call(there, "get_parameters", names=["a", "b"])).values == []
    assert len((await call(there, "get_parameter_types", names=["a", "b"])).types) == 0
    assert (await call(there, "describe_parameters", names=["a", "b"])).descriptors == []


async def test_sets_each_or_all_or_none(shared: tuple[Node, Node]) -> None:
    here, there = shared
    parameters = [
        integer("a", 7),
        integer("a", -1),
        {"name": "a", "value": {"type": 3, "double_value": 1.0}},
        {"name": "a", "value": {"type": 0}},
        {"name": "a", "value": {"type": 99}},
        integer("b", 1),
        integer("start_type_description_service", 1),
        integer("g.x", 8),
    ]
    results = (await call(there, "set_parameters", parameters=parameters)).results
    assert [one.successful for one in results] == [True, *6 * [False], True]
    for result, why in zip(
        results,
        ("", "out of its range", "to double", "unset", "type 99", "not declared", "read-only", ""),
        strict=True,
    ):
        assert why in result.reason
        assert bool(why) == bool(result.reason)
    assert [here.parameters.get(name) for name in ("a", "g.x")] == [7, 8]
    for bad in parameters[1:7]:
        both = [integer("g.x", 9), bad]
        result = (await call(there, "set_parameters_atomically", parameters=both)).result
        assert not result.successful
        assert here.parameters.get("g.x") == 8
    result = (await call(there, "set_parameters_atomically", parameters=[])).result
    assert not result.successful
    # of one that is there twice, the last counts
    twice = [integer("g.x", 1), integer("a", 2), integer("g.x", 3)]
    result = (await call(there, "set_parameters_atomically", parameters=twice)).result
    assert result.successful
    assert [here.parameters.get(name) for name in ("a", "g.x")] == [2, 3]


async def test_events(nodes: tuple[Node, Node]) -> None:
    here, there = nodes
    heard = there.subscribe(
        "/parameter_events", "rcl_interfaces/msg/ParameterEvent", qos=PARAMETERS
    )
    (says,) = [one for one in here._endpoints if one.name == "/parameter_events"]
    await until(lambda: says.has_subscribers)  # type: ignore[attr-defined]
    here.parameters.declare("a", 1)
    here.parameters.declare("b", 1, read_only=True)
    await here.parameters.set_all({"a": 2})
    here.parameters.update("b", 1)  # nothing new, and nothing to tell
    here.parameters.update("b", 3)
    with pytest.raises(ConfigurationError):
        await here.parameters.set("a", "x")
    here.parameters.undeclare("a")
    told = []
    for _ in range(5):
        event = await soon(anext(heard))
        assert event.node == CAMERA
        assert event.stamp.sec > 0
        for what in ("new", "changed", "deleted"):
            told += [
                (what, one.name, one.value.type, one.value.integer_value)
                for one in getattr(event, f"{what}_parameters")
            ]
    assert told == [
        ("new", "a", 2, 1),
        ("new", "b", 2, 1),
        ("changed", "a", 2, 2),
        ("changed", "b", 2, 3),
        ("deleted", "a", 2, 2),
    ]


# ------------------------------------------------------------------ what goes wrong


async def test_ten_thousand_names(shared: tuple[Node, Node]) -> None:
    here, there = shared
    names = ["a"] * MANY
    for service in ("get_parameters", "get_parameter_types", "describe_parameters"):
        reply = await call(there, service, names=names)
        (found,) = (
            getattr(reply, field.name)
            for field in there.types.service(SERVICES[service]).response.fields
        )
        assert len(found) == 0
    assert (await call(there, "list_parameters", prefixes=names)).result.names == []
    many = [integer("a", 5)] * MANY
    results = (await call(there, "set_parameters", parameters=many)).results
    assert len(results) == MANY
    for one in (*results, (await call(there, "set_parameters_atomically", parameters=many)).result):
        assert not one.successful
        assert "10000 names: expected 1024 at most" in one.reason
    assert here.parameters.get("a") == 0
    assert len((await call(there, "get_parameters", names=names[:1024])).values) == 1024


async def test_text_with_nul(shared: tuple[Node, Node]) -> None:
    here, there = shared
    here.parameters.declare("text", "x")
    kind = there.types.service(SERVICES["set_parameters"]).request
    value = {"type": 4, "string_value": "sentinel"}
    data = kind.encode({"parameters": [{"name": "text", "value": value}]})
    async with there.client(f"{CAMERA}/set_parameters", SERVICES["set_parameters"]) as client:
        client.type = _Patched(  # type: ignore[assignment]
            client.type, data.replace(b"sentinel", b"senti\0el")
        )
        (found,) = (await client.call(timeout=60)).results
        assert "NUL" in found.reason
    assert here.parameters.get("text") == "x"


class _Patched:
    """A service's type whose requests are other bytes."""

    def __init__(self, kind: Any, data: bytes) -> None:
        self.name, self.dds, self.hash, self.response = (
            kind.name,
            kind.dds,
            kind.hash,
            kind.response,
        )
        self._data = data

    @property
    def request(self) -> Any:
        return self

    def encode(self, _: object) -> bytes:
        return self._data


class Gate:
    """A hook that says that it has begun, and waits until it may end."""

    def __init__(self, *, refuses: bool = False) -> None:
        self.begun, self.open = asyncio.Event(), asyncio.Event()
        self.values: list[Any] = []
        self.refuses = refuses

    async def __call__(self, value: Any) -> None:
        self.values.append(value)
        self.begun.set()
        await self.open.wait()
        if self.refuses:
            raise SmartCamError("not now")


async def test_a_set_while_another_runs(shared: tuple[Node, Node]) -> None:
    here, there = shared
    gate = Gate()
    here.parameters.declare("slow", 0, on_set=gate)
    client = there.parameters_of(CAMERA)
    first = asyncio.create_task(client.set(slow=1, a=1))
    await soon(gate.begun.wait())
    second = asyncio.create_task(client.set({"a": 2, "g.x": 2}))
    assert await client.get("slow", "a") == {"slow": 0, "a": 0}  # reading does not wait
    assert not second.done()
    gate.open.set()
    await soon(asyncio.gather(first, second))
    assert await client.get("slow", "a", "g.x") == {"slow": 1, "a": 2, "g.x": 2}


async def test_a_caller_that_goes_away_does_not_stop_a_set(shared: tuple[Node, Node]) -> None:
    here, _ = shared
    gate = Gate()
    here.parameters.declare("slow", 0, on_set=gate)
    async with Node("asks", connect=here.context.zenoh._link.listen[0], domain=7) as asks:
        task = asyncio.create_task(asks.parameters_of(CAMERA).set(slow=1))
        await soon(gate.begun.wait())
        task.cancel()
    await until(lambda: "/asks" not in here.graph.nodes())
    gate.open.set()
    await until(lambda: here.parameters.get("slow") == 1)


async def test_a_node_that_is_closed_in_the_middle(no_leaks: None) -> None:
    gate = Gate()
    undone: list[Any] = []
    async with two_nodes() as (here, there):
        here.parameters.declare("first", 0, on_set=undone.append)
        here.parameters.declare("slow", 0, on_set=gate)
        task = asyncio.create_task(there.parameters_of(CAMERA).set(first=1, slow=1))
        await soon(gate.begun.wait())
        await soon(here.stop())
        assert undone == [1, 0]
        assert [here.parameters.get("first"), here.parameters.get("slow")] == [0, 0]
        with pytest.raises(ServiceCallError):
            await soon(task)
        await here.start()
        gate.open.set()
        await until(lambda: CAMERA in there.graph.nodes())
    # what was declared stays with the node


async def test_what_a_hook_says_comes_to_who_sets(shared: tuple[Node, Node]) -> None:
    here, there = shared
    gate = Gate(refuses=True)
    gate.open.set()
    here.parameters.declare("no", 0, on_set=gate)
    with pytest.raises(ServiceCallError, match="refused to set a, no: not now") as refused:
        await there.parameters_of(CAMERA).set(a=5, no=1)
    assert refused.value.service == f"{CAMERA}/set_parameters_atomically"
    assert here.parameters.get("a") == 0


# ------------------------------------------------------------------ another node's


async def test_the_client(shared: tuple[Node, Node]) -> None:
    here, there = shared
    here.parameters.declare("gain", 0.5, minimum=0, maximum=2, step=0.5)
    here.parameters.declare("words", ["a"])
    async with there.parameters_of("line1/cam3") as client:
        assert await client.list() == here.parameters.names()
        assert await client.list("g", depth=1) == ["g.x"]
        assert await client.get("words", "g.x") == {"words": ("a",), "g.x": 1}
        assert await client.get() == {}
        assert await client.describe("gain", "words") == {
            name: here.parameters.describe(name) for name in ("gain", "words")
        }
        await client.set({"g.x": 5}, gain=1.5, words=["b", "c"])
        assert here.parameters.get("words") == ("b", "c")
        with pytest.raises(ServiceCallError, match="not all of gain, nope are declared"):
            await client.get("gain", "nope")
        with pytest.raises(ServiceCallError, match="not all of nope are declared"):
            await client.describe("nope")
        with pytest.raises(ServiceCallError, match="is double, it cannot be set to integer 1"):
            await client.set(gain=1)
        wrong: tuple[dict[str, Any], ...] = ({}, {"words": []}, {"words": None})
        for bad in wrong:
            with pytest.raises(ConfigurationError):
                await client.set(bad)
    assert not [one for one in there._endpoints if one.name.startswith(CAMERA)]


async def test_a_client_of_who_is_not_there_or_answers_nonsense(nodes: tuple[Node, Node]) -> None:
    here, there = nodes
    with pytest.raises(ServiceTimeoutError, match="no server for"):
        await there.parameters_of("/nobody", timeout=0.2).list()
    with pytest.raises(ConfigurationError):
        there.parameters_of("line 1")
    values: list[dict[str, Any]] = [{"type": 77}]

    async def get(_: Any) -> Any:
        return {"values": values}

    async def set_all(_: Any) -> Any:
        return {"result": {"successful": False}}

    here.serve("/odd/get_parameters", SERVICES["get_parameters"], get)
    here.serve("/odd/set_parameters_atomically", SERVICES["set_parameters_atomically"], set_all)
    async with there.parameters_of("/odd") as client:
        with pytest.raises(RosMessageError, match="type 77"):
            await client.get("a")
        values[:] = [{}]
        assert await client.get("a") == {"a": None}
        values[:] = [{}, {}]
        with pytest.raises(ServiceCallError, match="2 answers for 1 names"):
            await client.get("a")
        with pytest.raises(ServiceCallError, match="does not say why"):
            await client.set(a=1)


# ------------------------------------------------------------------ what types are


async def test_types_are_described_as_they_are_hashed(nodes: tuple[Node, Node]) -> None:
    here, there = nodes
    here.publisher("~/chatter", STRING)
    asks = there.client(
        f"{CAMERA}/get_type_description", "type_description_interfaces/srv/GetTypeDescription"
    )
    names = [
        (STRING, here.types.message(STRING).hash),
        (SERVICES["set_parameters"], here.types.service(SERVICES["set_parameters"]).hash),
    ]
    for name, hashed in names:
        reply = await asks.call(type_name=name, type_hash=hashed, timeout=60)
        assert (reply.successful, reply.failure_reason) == (True, "")
        said = reply.type_description
        assert said.type_description.type_name == name
        text = json.dumps(
            {
                "type_description": _plain(said.type_description),
                "referenced_type_descriptions": list(
                    map(_plain, said.referenced_type_descriptions)
                ),
            }
        )
        assert f"RIHS01_{hashlib.sha256(text.encode()).hexdigest()}" == hashed
        _check_sources(reply, name)
        fields = {"type_name": name, "type_hash": hashed, "include_type_sources": False}
        assert (await asks.call(fields, timeout=60)).type_sources == []
    unused = here.types.message("std_msgs/msg/Bool").hash
    for hashed, why in ((unused, "uses no type"), ("", "is no hash"), ("RIHS01_0", "is no hash")):
        reply = await asks.call(type_name=STRING, type_hash=hashed, timeout=60)
        assert not reply.successful
        assert why in reply.failure_reason


def _plain(said: Any) -> dict[str, Any]:
    """Return a type's description as it is hashed."""
    parts = ("type_id", "capacity", "string_capacity", "nested_type_name")
    return {
        "type_name": said.type_name,
        "fields": [
            {"name": field.name, "type": {part: getattr(field.type, part) for part in parts}}
            for field in said.fields
        ],
    }


def _check_sources(reply: Any, name: str) -> None:
    """See that the sources are whole: their types have the hash that was asked for."""
    said = reply.type_description
    wanted = [one.type_name for one in (said.type_description, *said.referenced_type_descriptions)]
    assert [one.type_name for one in reply.type_sources] == wanted
    texts = {one.type_name: one.raw_file_contents for one in reply.type_sources}
    kinds = {one.encoding for one in reply.type_sources}
    assert kinds == ({"srv", "msg", "implicit"} if "/srv/" in name else {"msg"})
    assert (texts[name] == "string data\n") == (name == STRING)
