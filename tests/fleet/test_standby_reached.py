"""An end learns of its own loss of the bus before it loses the other ends."""

from __future__ import annotations

import asyncio

import pytest

pytest.importorskip("zenoh")

from smartcam._zenoh import BusLink
from smartcam.fleet._inside import Keys, ZenohConnection
from tests.fleet.fleetkit import FLEET, PATIENCE, until
from tests.processes import free_place

pytestmark = pytest.mark.real_time

MANY = 300
"""Cameras of an agent: the engine tells one after the other that they are gone."""


async def test_router_that_is_gone_is_known_before_its_agents_are() -> None:
    keys = Keys(FLEET)
    places = (free_place(),)
    router, end = ZenohConnection(BusLink(listen=places)), ZenohConnection(BusLink(connect=places))
    await router.open(PATIENCE)
    try:
        await end.open(PATIENCE)
        there: set[str] = set()
        reached: list[bool] = []

        def see(key: str, present: bool) -> None:
            if present:
                there.add(key)
            else:
                reached.append(end.is_connected)

        end.watch(keys.camera("*", "**"), see)
        for number in range(MANY):
            router.announce(keys.camera("north", f"cam{number}"))
        await until(lambda: len(there) == MANY)
        assert end.is_connected
        await asyncio.to_thread(router.session.close)  # all at once, as where it is killed
        await until(lambda: len(reached) == MANY)
        assert not any(reached)
    finally:
        await end.close()
        await router.close()
