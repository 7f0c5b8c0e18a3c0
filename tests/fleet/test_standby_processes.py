"""Agents that stand by as processes, over Zenoh: killed, stopped, and without their router."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import subprocess
from collections.abc import AsyncIterator, Iterator

import pytest

pytest.importorskip("zenoh")

from smartcam._zenoh import BusLink
from smartcam.exceptions import SmartCamError
from smartcam.fleet import Fleet
from smartcam.fleet._inside import FleetAddress, Keys, ZenohConnection
from tests.fleet.fleetkit import FLEET, LAYOUT, NAME, PATIENCE, NumberedCamera, until
from tests.fleet.partner import Partner, partner
from tests.fleet.test_standby import QUICK, Work
from tests.processes import free_place

pytestmark = [pytest.mark.real_time, pytest.mark.long]


class Hosts:
    """A router, a camera, two agents and a program.

    Attributes:
        place: the router's.
        router: its end.
        agents: the processes, by name.
    """

    def __init__(self, box: NumberedCamera, address: str) -> None:
        self.box = box
        self.place = free_place(address)
        self.router = ZenohConnection(BusLink(listen=(self.place,)))
        self.agents: dict[str, Partner] = {}

    async def restart_router(self) -> None:
        await self.router.close()
        await asyncio.sleep(1.0)
        self.router = ZenohConnection(BusLink(listen=(self.place,)))
        await self.router.open(PATIENCE)

    async def sharing(self) -> list[str]:
        """Return the agents that say that they have the camera."""
        keys = Keys(FLEET)
        found = await self.router.present_keys(keys.camera("*", NAME), PATIENCE)
        return sorted(keys.tail(key, "presence/camera")[0] for key in found)

    async def settled(self, *agents: str) -> None:
        async with asyncio.timeout(PATIENCE):
            while await self.sharing() != [*agents]:  # noqa: ASYNC110 - the bus tells
                await asyncio.sleep(0.05)


@contextlib.asynccontextmanager
async def hosts_at_work(
    address: str = "127.0.0.1", within: tuple[str, ...] = ()
) -> AsyncIterator[tuple[Hosts, Work]]:
    """Give a pair of which north has the camera and south stands by, and a program at work.

    Args:
        address: of the router and the camera.
        within: a command that runs north elsewhere.
    """
    async with contextlib.AsyncExitStack() as stack:
        box = await stack.enter_async_context(NumberedCamera(time=0.01, host=address))
        hosts = Hosts(box, address)
        await hosts.router.open(PATIENCE)
        stack.push_async_callback(lambda: hosts.router.close())
        for name in ("north", "south"):
            hosts.agents[name] = await stack.enter_async_context(
                partner(
                    *("standby", hosts.place, box.url, name),
                    within=within if name == "north" else (),
                )
            )
        place = FleetAddress.parse(f"fleet://{hosts.place.partition('/')[2]}")
        link = ZenohConnection(BusLink(connect=(hosts.place,)))
        options = {"interpret_as": LAYOUT, "reconnect": QUICK}
        fleet = Fleet(link, place, FLEET, None, PATIENCE, options)
        await stack.enter_async_context(fleet)
        await until(lambda: fleet[NAME].connected)
        work = Work(fleet[NAME])
        async with work.going_on():
            await hosts.settled("north")
            yield hosts, work
        # a link that comes and goes may end a command of the agent's in any way that has a name
        work.check(box, ends=(SmartCamError,))


async def test_killed_agent_is_replaced() -> None:
    async with hosts_at_work() as (hosts, work):
        await hosts.agents["north"].kill()
        await hosts.settled("south")
        await work.some()
        assert "Reconnected" in await work.told()


@pytest.mark.widest
async def test_stopped_agent_is_replaced_and_does_not_take_it_back() -> None:
    async with hosts_at_work() as (hosts, work):
        hosts.agents["north"].signal(signal.SIGSTOP)  # as if its cable was cut
        await hosts.settled("south")
        await work.some()
        hosts.agents["north"].signal(signal.SIGCONT)
        await asyncio.sleep(2.0)
        async with asyncio.timeout(PATIENCE):
            while len(await hosts.sharing()) != 1:  # noqa: ASYNC110 - the bus tells
                await asyncio.sleep(0.05)
        await work.some()


def ip(*arguments: str) -> None:
    command = ["ip", *arguments]
    subprocess.run(command, check=True, capture_output=True)  # noqa: S603 - our own words


@pytest.fixture
def elsewhere() -> Iterator[tuple[str, str, str]]:
    """Give a namespace, the end of the cable to it, and the address of this side of the cable."""
    space, here, there = (f"{kind}{os.getpid()}" for kind in ("stby", "sh", "st"))
    with contextlib.ExitStack() as stack:
        try:
            ip("netns", "add", space)
            stack.callback(ip, "netns", "delete", space)
            ip("link", "add", here, "type", "veth", "peer", there, "netns", space)
            stack.callback(ip, "link", "delete", here)
            ip("address", "add", "10.79.0.1/24", "dev", here)
            ip("link", "set", here, "up")
            ip("-n", space, "address", "add", "10.79.0.2/24", "dev", there)
            ip("-n", space, "link", "set", there, "up")
        except (OSError, subprocess.CalledProcessError) as exc:
            pytest.skip(f"no network namespaces can be made here: {exc}")
        yield space, here, "10.79.0.1"


async def test_host_that_is_cut_off_is_replaced_and_stands_by_when_it_is_back(
    elsewhere: tuple[str, str, str],
) -> None:
    space, cable, address = elsewhere
    async with hosts_at_work(address, ("ip", "netns", "exec", space)) as (hosts, work):
        ip("link", "set", cable, "down")
        # the router may not be asked who is there: it closes what is cut off after its lease
        await hosts.settled("south")
        await work.some()
        await asyncio.sleep(3.0)
        ip("link", "set", cable, "up")
        await asyncio.sleep(10.0)
        assert len(await hosts.sharing()) == 1
        await work.some()
        assert work.camera.connected


@pytest.mark.widest
async def test_router_that_is_back_leaves_one_agent_with_the_camera() -> None:
    """It is the one that had it, unless a slow machine brings the other back that much earlier."""
    async with hosts_at_work() as (hosts, work):
        await hosts.restart_router()
        async with asyncio.timeout(PATIENCE):
            while len(found := await hosts.sharing()) != 1:  # noqa: ASYNC110 - the bus tells
                await asyncio.sleep(0.05)
            await work.some()
            while len(now := await hosts.sharing()) != 1:  # noqa: ASYNC110 - the bus tells
                await asyncio.sleep(0.05)
        await asyncio.sleep(3.0)
        assert await hosts.sharing() == now
        assert found == now or "south" in now
