"""What happens to a plant: faults, each for a while, by a plan or by chance."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from random import Random
from typing import Any

from smartcam._zenoh import LEASE
from smartcam.fleet._authority import make_certificates
from tests.fleet.fleetkit import PATIENCE
from tests.proofs.plant_hosts import HUB, SITES
from tests.proofs.plant_pace import Limit
from tests.proofs.plant_part import START
from tests.proofs.plant_site import MARGIN, Site
from tests.recording.full_disk import fill

CALLS = 30
"""That end while a disk is full."""

STARTS = Limit(START)
SEEN = Limit(MARGIN, LEASE)
"""For all to see that somebody is cut off."""


@dataclass
class Fault:
    """What may happen.

    Attributes:
        act: does it to a host, for so many seconds.
        seconds: how long it may last; one of them, by chance.
        gone: seconds until the host's agent is gone, if it lasts that long; None: it stays.
        moves: how often a camera of the pair may go from one agent to the other by it, where it is
            the pair's; of one that only stands by none does. Who is cut off and comes back takes
            the camera, and so does the other one, until they see each other.
        network: it is in the way of who is to take over.
        chance: of being chosen, against 1 of others.
    """

    act: Callable[[Site, int, float], Awaitable[None]]
    seconds: tuple[float, ...]
    gone: float | None = None
    moves: int = 0
    network: bool = False
    chance: float = 1.0


@dataclass(frozen=True)
class Happening:
    """One fault of a plan."""

    name: str
    host: int
    seconds: float

    @property
    def fault(self) -> Fault:
        """What it is."""
        return FAULTS[self.name]

    @property
    def gone(self) -> float | None:
        """Seconds until its host's agent is gone; None where it stays."""
        gone = self.fault.gone
        lasts = not gone or self.seconds > gone + MARGIN  # an agent that is killed is gone at once
        return gone if lasts else None

    def __str__(self) -> str:
        return f"{self.name} {self.host} {self.seconds:g} s"


async def agent_killed(site: Site, host: int, seconds: float) -> None:
    site.kills[host] += 1
    await site.agents[host].kill()
    site.storm.memory[site.agents[host].name].clear()
    await asyncio.sleep(seconds)
    await site.agents[host].come()


async def router_killed(site: Site, host: int, seconds: float) -> None:
    await site.router.kill()
    site.storm.memory[site.router.name].clear()
    await asyncio.sleep(seconds)
    await site.router.come()


async def cut_off(site: Site, host: int, seconds: float) -> None:
    """Look whether others see that the host is cut off from the router, until ``seconds`` end."""
    begun = time.monotonic()
    if seconds > SEEN.seconds:
        others = [one for one in SITES if one != host]
        cut = {name for name in site.names if name.startswith(f"host{host}/")}
        gone = await site.until(lambda: not any(cut & {*site.here[one]} for one in others), SEEN)
        if gone is None:
            site.storm.complain(
                f"host {host} is cut off: its cameras are here {SEEN.seconds:g} s later"
            )
    await asyncio.sleep(begun + seconds - time.monotonic())


async def cable_cut(site: Site, host: int, seconds: float) -> None:
    cable = site.switch.cables[host]
    cable.cut = True
    await cut_off(site, host, seconds)
    cable.cut = False


async def router_cut_off(site: Site, host: int, seconds: float) -> None:
    """Have a host without the router, and with all else: what its agent has, it keeps."""
    way = frozenset((host, HUB))
    site.switch.apart.add(way)
    await cut_off(site, host, seconds)
    site.switch.apart.discard(way)


async def cable_bad(site: Site, host: int, seconds: float, *, what: str, value: float) -> None:
    setattr(site.switch.cables[host], what, value)
    await asyncio.sleep(seconds)
    setattr(site.switch.cables[host], what, 0.0)


async def program_stopped(site: Site, host: int, seconds: float) -> None:
    site.programs[host].pause(True)
    await asyncio.sleep(seconds)
    site.programs[host].pause(False)


async def disk_full(site: Site, host: int, seconds: float) -> None:
    ballast = site.disk(host) / "ballast"
    begun = time.monotonic()
    site.recording.pop(host, None)
    await asyncio.to_thread(fill, ballast)
    if await site.until(lambda: site.recording.get(host) is False, STARTS) is None:
        site.storm.complain(f"disk of host {host} full: the agent did not say so")
    seen = site.storm.figures.calls
    await asyncio.sleep(begun + seconds - time.monotonic())
    await site.until(lambda: site.storm.figures.calls > seen + CALLS, STARTS)
    ballast.unlink()
    if await site.until(lambda: site.recording.get(host) is True, STARTS) is None:
        site.storm.complain(f"disk of host {host} cleared: it does not record again")


async def certificate_expired(site: Site, host: int, seconds: float) -> None:
    """Have somebody come whose certificate has expired, and again with a new one."""

    async def visit() -> Any:
        said: list[Any] = []
        part = site.part(1, "visitor", "visitor", site.url("visitor"), f"{seconds:g}", hear=said)
        begun = time.monotonic()
        await part.start()
        async with asyncio.timeout(START + PATIENCE):
            await part.ended()
        if not said:
            site.storm.complain(f"a visitor said nothing: {[*part.last]}")
            return {"outcome": "", "text": ""}
        if said[0]["took"] > seconds + MARGIN * site.pace.since(begun):
            site.storm.complain(f"a visitor came to an end after {said[0]['took']:.1f} s")
        return said[0]

    (site.keys / "visitor" / "cert.pem").unlink()
    lifetime = timedelta(hours=-3)  # by all clocks
    await asyncio.to_thread(
        make_certificates, site.keys, {"operator": ["visitor"]}, lifetime=lifetime
    )
    said = await visit()
    if said["outcome"] != "ConnectFailedError" or "expired" not in said["text"]:
        site.storm.complain(f"a visitor whose certificate has expired: {said}")
    await asyncio.to_thread(make_certificates, site.keys, {"operator": ["visitor"]})
    said = await visit()
    if said["outcome"] not in {"here", "ConnectFailedError"} or "expired" in said["text"]:
        site.storm.complain(f"a visitor with a renewed certificate: {said}")


LOST = partial(cable_bad, what="loss", value=0.05)
LATE = partial(cable_bad, what="delay", value=0.2)

FAULTS: dict[str, Fault] = {
    "agent killed": Fault(agent_killed, (0.0, 1.0, 3.0), 0.0, moves=1, network=True),
    "router killed": Fault(router_killed, (0.5, 3.0), network=True),
    "cable cut": Fault(cable_cut, (1.0, 10.0), LEASE, moves=4, network=True),
    "cable cut for a minute": Fault(cable_cut, (60.0,), LEASE, moves=4, network=True, chance=0.1),
    "router cut off": Fault(router_cut_off, (1.0, 12.0), LEASE, moves=4, network=True),
    "5 % of packets lost": Fault(LOST, (5.0, 15.0), network=True),
    "packets 200 ms late": Fault(LATE, (5.0, 15.0), network=True),
    "program stopped": Fault(program_stopped, (1.0, 12.0)),
    "disk full": Fault(disk_full, (5.0,)),
    "certificate expired": Fault(certificate_expired, (10.0,)),
}

SHORT: tuple[tuple[Happening, ...], ...] = (
    (Happening("cable cut", 2, 1.0), Happening("disk full", 1, 1.5)),
    (Happening("agent killed", 3, 0.0), Happening("packets 200 ms late", 1, 2.0)),
    (Happening("program stopped", 2, 5.0), Happening("5 % of packets lost", 3, 2.0)),
    (Happening("router killed", HUB, 0.5),),
    (Happening("agent killed", 1, 1.0),),
    (Happening("router cut off", 2, 9.0), Happening("certificate expired", 1, 10.0)),
)
"""Rounds of the short form: each fault once, and the pair's agents in turn."""


def by_chance(chance: Random) -> list[Happening]:
    """Return one or two faults that happen together, on hosts of their own."""
    names = [*FAULTS]
    victims = chance.sample([*SITES], chance.choice((1, 2, 2)))
    found: dict[str, Happening] = {}
    for host in victims:
        (name,) = chance.choices(names, [one.chance for one in FAULTS.values()])
        seconds = chance.choice(FAULTS[name].seconds)
        found[name] = Happening(name, HUB if name == "router killed" else host, seconds)
    return [*found.values()]
