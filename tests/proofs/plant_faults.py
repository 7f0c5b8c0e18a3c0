"""Events that happen to a plant: faults, each for a while, by a plan or by chance."""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from random import Random
from typing import Any

from smartcam._zenoh import LEASE_TIME
from smartcam.fleet._inside import make_certificates
from tests.fleet.fleetkit import PATIENCE
from tests.proofs.plant_hosts import HUB, LINE, SITES, address
from tests.proofs.plant_pace import Limit
from tests.proofs.plant_part import START
from tests.proofs.plant_site import MARGIN, PORT, Site
from tests.recording.full_disk import fill

CALLS = 30
"""That end while a disk is full."""

LONE = 3
"""The host whose agent nobody stands by for."""

STRANGERS = 200

STARTS = Limit(START)
SEEN = Limit(MARGIN, LEASE_TIME)
"""For all to see that somebody is cut off."""


@dataclass
class Fault:
    """A kind of event.

    Attributes:
        act: does it to a host, for so many seconds.
        seconds: how long it may last; one of them, by chance.
        gone: seconds until the host's agent is gone, if it lasts that long; None: it stays.
        moves: how often a camera of the pair may go from one agent to the other by it, where it is
            the pair's; of one that only stands by none does. Who is cut off and comes back takes
            the camera, and so does the other one, until they see each other.
        network: it is in the way of who is to take over.
        chance: of being chosen, against 1 of others.
        only: the host to which alone it may happen; None: any.
    """

    act: Callable[[Site, int, float], Awaitable[None]]
    seconds: tuple[float, ...]
    gone: float | None = None
    moves: int = 0
    network: bool = False
    chance: float = 1.0
    only: int | None = None


@dataclass(frozen=True)
class Happening:
    """One fault of a plan."""

    name: str
    host: int
    seconds: float

    @property
    def fault(self) -> Fault:
        """The kind of fault."""
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


async def guest_triggers(site: Site, camera: str) -> None:
    """Have somebody come and trigger a camera, which nobody may keep from it."""
    said: list[Any] = []
    given = (site.url("guest"), camera, str(next(site.tokens)))
    part = site.part(LINE, "guest", "guest", *given, hear=said)
    await part.start()
    async with asyncio.timeout(2 * START + PATIENCE):
        await part.ended()
    if not said or said[0]["outcome"] != "result":
        site.storm.complain(f"a guest at {camera}: {said or [*part.last]}")


async def holder_and_agent_killed(site: Site, host: int, seconds: float) -> None:
    """Have a program reserve a camera and die with its agent: the next start's camera is free."""
    camera = f"host{host}/cam1"
    holder = site.part(LINE, "holder", "holder", site.url("guest"), camera, hear=[])
    await holder.start()
    async with asyncio.timeout(2 * START + PATIENCE):
        ready = asyncio.create_task(holder.ready.wait())
        ended = asyncio.create_task(holder.ended())
        await asyncio.wait({ready, ended}, return_when=asyncio.FIRST_COMPLETED)
        ready.cancel()
    site.kills[host] += 1
    if holder.ready.is_set():
        await asyncio.gather(holder.kill(), site.agents[host].kill())
    else:
        site.storm.notes.append(f"a holder got no reservation: {[*holder.last][-1:]}")
        await site.agents[host].kill()
    site.storm.memory[site.agents[host].name].clear()
    await asyncio.sleep(seconds)
    await site.agents[host].come()
    await guest_triggers(site, camera)


async def equal_names(site: Site, host: int, seconds: float) -> None:
    """Start an agent of a name that is there: it ends, and the other one notices nothing."""
    before = site.sessions.copy()
    path = site.folder / f"host{host}.yaml"
    part = site.part(host, "namesake", "agent", str(path), hear=[])
    await part.start()
    try:
        async with asyncio.timeout(START + PATIENCE):
            code = await part.ended()
    except TimeoutError:
        site.storm.complain(f"a second agent host{host} did not end")
        await part.kill()
        return
    if code == 0:
        site.storm.complain(f"a second agent host{host} ended well: {[*part.last]}")
    new = {name for name in site.sessions if site.sessions[name] != before[name]}
    if any(name.startswith(f"host{host}/") for name in new):
        site.storm.complain(f"a second agent host{host} took cameras: {sorted(new)}")


async def cameras_stalled(site: Site, host: int, seconds: float) -> None:
    site.boxes[host].pause(True)
    await asyncio.sleep(seconds)
    site.boxes[host].pause(False)


async def certificate_renewed(site: Site, host: int, seconds: float) -> None:
    """Give an agent at work another certificate, which it takes within 10 s or when it is idle."""
    name = f"host{host}"
    (site.keys / name / "cert.pem").unlink()
    await asyncio.to_thread(make_certificates, site.keys, {"agent": [name]})
    await asyncio.sleep(seconds)


async def camera_renamed(site: Site, host: int, seconds: float) -> None:
    """Have an agent read a file in which a camera has another name, while it is triggered."""
    path, camera, other = (
        site.folder / f"host{host}.yaml",
        f"host{host}/cam1",
        f"host{host}/renamed",
    )
    text = path.read_text(encoding="utf-8")
    site.renamed.add(camera)
    for name, said in ((other, text.replace(f"{camera}:", f"{other}:")), (camera, text)):
        path.write_text(said, encoding="utf-8")
        site.agents[host].signal(signal.SIGHUP)

        def there(name: str = name) -> bool:
            return all(name in site.here[one] for one in SITES)

        if name == other and await site.until(there, STARTS) is None:
            site.storm.complain(f"{camera} is not there as {other}: {site.missing()}")
        await asyncio.sleep(seconds / 2)


async def late_joiner(site: Site, host: int, seconds: float) -> None:
    """Have somebody come to a host that is without the router, and in once it has it again."""
    said: list[Any] = []
    given = (site.url("guest"), f"{seconds + START:g}")
    part = site.part(host, "late joiner", "joiner", *given, hear=said)
    await part.start()
    await router_cut_off(site, host, seconds)
    async with asyncio.timeout(2 * START + PATIENCE):
        await part.ended()
    if not said or said[0]["outcome"] != "here":
        site.storm.complain(f"somebody who came to host {host} late: {said or [*part.last]}")


async def half_open(site: Site, host: int, seconds: float) -> None:
    """Have strangers hold connections to the router that say nothing; others come in."""
    given = (address(HUB), str(PORT), str(STRANGERS))
    part = site.part(LINE, "strangers", "strangers", *given, hear=[])
    await part.come()
    await asyncio.sleep(seconds)
    said: list[Any] = []
    joiner = site.part(host, "joiner", "joiner", site.url("guest"), f"{START:g}", hear=said)
    await joiner.start()
    async with asyncio.timeout(2 * START + PATIENCE):
        await joiner.ended()
    if not said or said[0]["outcome"] != "here":
        site.storm.complain(f"somebody who came beside strangers: {said or [*joiner.last]}")
    await part.kill()


LOST = partial(cable_bad, what="loss", value=0.05)
LATE = partial(cable_bad, what="delay", value=0.2)

FAULTS: dict[str, Fault] = {
    "agent killed": Fault(agent_killed, (0.0, 1.0, 3.0), 0.0, moves=1, network=True),
    "router killed": Fault(router_killed, (0.5, 3.0), network=True),
    "cable cut": Fault(cable_cut, (1.0, 10.0), LEASE_TIME, moves=4, network=True),
    "cable cut for a minute": Fault(
        cable_cut, (60.0,), LEASE_TIME, moves=4, network=True, chance=0.1
    ),
    "router cut off": Fault(router_cut_off, (1.0, 12.0), LEASE_TIME, moves=4, network=True),
    "5 % of packets lost": Fault(LOST, (5.0, 15.0), network=True),
    "packets 200 ms late": Fault(LATE, (5.0, 15.0), network=True),
    "program stopped": Fault(program_stopped, (1.0, 12.0)),
    "disk full": Fault(disk_full, (5.0,)),
    "certificate expired": Fault(certificate_expired, (10.0,)),
    "holder and agent killed": Fault(
        holder_and_agent_killed, (0.0, 2.0), 0.0, moves=1, network=True, only=LONE
    ),
    "equal names": Fault(equal_names, (0.0,), chance=0.5),
    "cameras stalled": Fault(cameras_stalled, (3.0, 9.0)),
    "certificate renewed": Fault(certificate_renewed, (12.0,), network=True, only=LONE),
    "camera renamed": Fault(camera_renamed, (4.0,), only=LONE),
    "late joiner": Fault(late_joiner, (9.0,), LEASE_TIME, moves=4, network=True, chance=0.5),
    "half-open handshakes": Fault(half_open, (3.0, 12.0)),
}

SHORT: tuple[tuple[Happening, ...], ...] = (
    (Happening("cable cut", 2, 1.0), Happening("disk full", 1, 1.5)),
    (Happening("agent killed", 3, 0.0), Happening("packets 200 ms late", 1, 2.0)),
    (Happening("program stopped", 2, 5.0), Happening("5 % of packets lost", 3, 2.0)),
    (Happening("router killed", HUB, 0.5),),
    (Happening("agent killed", 1, 1.0),),
    (Happening("router cut off", 2, 9.0), Happening("certificate expired", 1, 10.0)),
    (Happening("holder and agent killed", LONE, 0.0), Happening("equal names", 1, 0.0)),
    (Happening("cameras stalled", 1, 6.0), Happening("camera renamed", LONE, 2.0)),
    (Happening("half-open handshakes", 2, 2.0), Happening("certificate renewed", LONE, 12.0)),
)
"""Rounds of the short form: each fault once, and the pair's agents in turn."""


def by_chance(chance: Random) -> list[Happening]:
    """Return one or two faults that happen together, on hosts of their own."""
    names = [*FAULTS]
    victims = chance.sample([*SITES], chance.choice((1, 2, 2)))
    found: dict[str, Happening] = {}
    for host in victims:
        (name,) = chance.choices(names, [one.chance for one in FAULTS.values()])
        fault = FAULTS[name]
        seconds = chance.choice(fault.seconds)
        where = HUB if name == "router killed" else fault.only or host
        if all(one.host != where for one in found.values()):
            found[name] = Happening(name, where, seconds)
    return [*found.values()]
