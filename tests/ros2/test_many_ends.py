"""Many endpoints in one process, and a late one."""

from __future__ import annotations

import pytest

from smartcam.ros2 import Node
from tests.processes import free_place
from tests.ros2.roskit import STRING, until

pytestmark = pytest.mark.real_time

MANY = 1000
"""Number of ends whose tokens together exceed what the engine lets wait for a link, 128 KiB."""


async def test_who_comes_later_sees_all_of_many() -> None:
    place = free_place()
    async with Node("many", listen=place, domain=7) as many:
        topics = [f"/plant/line1/station{number}/state" for number in range(MANY)]
        for topic in topics:
            many.publisher(topic, STRING)
        for _ in range(2):
            async with Node("viewer", connect=place, domain=7, parameters=False) as viewer:
                await until(lambda: len(viewer.graph.nodes()) == 2)
                await until(lambda: viewer.graph.topics().keys() >= set(topics))


async def test_who_has_many_is_seen_by_a_router_that_comes_later() -> None:
    place = free_place()
    async with Node("router", listen=place, domain=7, parameters=False):
        many = Node("many", connect=place, domain=7)
        await many.start()
        for number in range(MANY):
            many.publisher(f"/plant/line1/station{number}/state", STRING)
    try:
        async with Node("router", listen=place, domain=7, parameters=False) as late:
            await until(lambda: len(late.graph.topics()) >= MANY)
    finally:
        await many.stop()
