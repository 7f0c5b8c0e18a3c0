"""What tests of ROS 2 share: two nodes, with TCP between them."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from typing import Any

from smartcam.ros2 import Node, RosContext
from tests.processes import free_place

PATIENCE = 60.0
"""Seconds that only a failure takes."""

STRING = "std_msgs/msg/String"
TRIGGER = "std_srvs/srv/Trigger"
SET_BOOL = "std_srvs/srv/SetBool"


@contextlib.asynccontextmanager
async def two_nodes(**more: Any) -> AsyncIterator[tuple[Node, Node]]:
    """Give ``/line1/cam3``, which is the router, too, and ``/viewer``, connected to it."""
    place = free_place()
    async with (
        Node("cam3", namespace="line1", context=RosContext(listen=place, domain=7), **more) as here,
        Node("viewer", connect=place, domain=7, **more) as there,
    ):
        yield here, there


async def until(true: Callable[[], object]) -> None:
    """Wait until something is true."""
    async with asyncio.timeout(PATIENCE):
        while not true():  # noqa: ASYNC110 - of what nothing tells
            await asyncio.sleep(0.005)


async def soon(waits: Any) -> Any:
    """Return what comes."""
    async with asyncio.timeout(PATIENCE):
        return await waits
