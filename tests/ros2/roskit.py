"""Helpers of tests of ROS 2: two nodes, with TCP between them, or Fast DDS.

A module whose tests use the fixture ``way`` runs them on both: with smartcam's own wire format, and
through rclpy where that can be imported.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import json
import os
import struct
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from typing import Any

import pytest
import zenoh

from smartcam.ros2 import Node, RosTypes
from smartcam.ros2._inside import NativeContext, NativeNode, RosContext
from tests.processes import free_place

PATIENCE = 60.0
"""Seconds that only a failure takes."""

STRING = "std_msgs/msg/String"
TRIGGER = "std_srvs/srv/Trigger"
SET_BOOL = "std_srvs/srv/SetBool"


NO_RCLPY = "needs rclpy, which the step ros_native_short of .ci/run installs"
NEEDS_RCLPY = pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason=NO_RCLPY)
WAYS = ["zenoh", pytest.param("rclpy", marks=NEEDS_RCLPY)]

DOMAIN = 1 + os.getpid() % 100
"""Number of a domain of DDS that no other process of tests has at the same time, as a rule."""

_way = "zenoh"


@pytest.fixture(params=WAYS)
def way(request: pytest.FixtureRequest) -> Iterator[str]:
    """Have :func:`node` and :func:`two_nodes` speak in each way."""
    global _way
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    before, _way = _way, request.param
    yield request.param
    _way = before


def make_node(name: str, place: str, *, listens: bool = False, **more: Any) -> Any:
    """Return a node in the present way, which is not open yet.

    Args:
        name: name of the node.
        place: endpoint of the router, for the own wire format.
        listens: whether the node is the router.
        **more: further arguments of both kinds of nodes.
    """
    if _way == "zenoh":
        where: dict[str, Any] = {"listen": place} if listens else {"connect": place}
        return Node(name, domain=7, **where, **more)
    return NativeNode(name, context=NativeContext(domain=DOMAIN), **more)


@contextlib.asynccontextmanager
async def two_nodes(**more: Any) -> AsyncIterator[tuple[Any, Any]]:
    """Give ``/line1/cam3``, which is the router, too, and ``/viewer``, connected to it."""
    place = free_place()
    if _way == "rclpy":
        async with (
            make_node("cam3", place, namespace="line1") as here,
            make_node("viewer", place, managed=False) as there,
        ):
            yield here, there
        return
    async with (
        Node("cam3", namespace="line1", context=RosContext(listen=place, domain=7), **more) as here,
        Node("viewer", connect=place, domain=7, **more) as there,
    ):
        yield here, there


async def until(true: Callable[[], object]) -> None:
    """Wait until something is true."""
    async with asyncio.timeout(PATIENCE):
        while not true():  # noqa: ASYNC110 - there is no event for it
            await asyncio.sleep(0.005)


async def soon(waits: Any) -> Any:
    """Return what comes."""
    async with asyncio.timeout(PATIENCE):
        return await waits


@contextlib.contextmanager
def peer(place: str) -> Iterator[Any]:
    """Give a session of rmw_zenoh."""
    settings = {
        "mode": "peer",
        "connect/endpoints": [place],
        "listen/endpoints": ["tcp/127.0.0.1:0"],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "scouting/gossip/multihop": False,
        "scouting/gossip/target": {"router": ["router", "peer"], "peer": ["router"]},
        "timestamping/enabled": {"router": True, "peer": True, "client": True},
        "queries_default_timeout": 600_000,
    }
    with opened(settings) as session:
        yield session


@contextlib.contextmanager
def router(place: str) -> Iterator[Any]:
    """Give the router of rmw_zenoh."""
    settings = {
        "mode": "router",
        "listen/endpoints": [place],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "timestamping/enabled": {"router": True, "peer": True, "client": True},
    }
    with opened(settings) as session:
        yield session


@contextlib.contextmanager
def opened(settings: Mapping[str, Any]) -> Iterator[Any]:
    """Give a session of Zenoh."""
    config = zenoh.Config()
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    session = zenoh.open(config)
    try:
        yield session
    finally:
        session.close()  # type: ignore[no-untyped-call]


async def called(session: Any, domain: int, name: str) -> Any:
    """Call a service without a request as a node of rmw_zenoh does, once it is known."""
    type = RosTypes().service(TRIGGER)
    extra, key = (
        struct.pack("<qqB16s", 1, 1, 16, bytes(16)),
        f"{domain}{name}/{type.dds}/{type.hash}",
    )

    def ask() -> Any:
        data = type.request.encode({})
        for reply in session.get(key, payload=data, attachment=extra, timeout=PATIENCE):
            if reply.ok is not None:
                return type.response.decode(reply.ok.payload.to_bytes())
        return None

    async with asyncio.timeout(PATIENCE):
        while (reply := await asyncio.to_thread(ask)) is None:  # noqa: ASYNC110
            await asyncio.sleep(0.05)
    return reply
