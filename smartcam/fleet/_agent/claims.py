"""Decide which agent of a fleet has a name and a camera, and when a standby agent takes over.

Two agents of one name see each other's starts. The earlier start keeps the name; the later agent
gives up its cameras, and logs that.

An agent announces a camera by a presence. Another agent with the same camera either refuses to
start, or stands by: it has no session until that presence ends. If two agents share one camera
after a split of the network, the camera decides, since it serves the newest client: the agent that
has lost its session and sees the other's presence asks the other, and leaves the camera to it. Both
may give up at the same time. So an agent that gave up the camera stands by again when the other no
longer has it.
"""

from __future__ import annotations

import asyncio
import ipaddress
import json
import logging
import secrets
import socket
from typing import TYPE_CHECKING

from smartcam._zenoh import LEASE_TIME
from smartcam.exceptions import ConfigurationError, ConnectionTakenError, SmartCamError
from smartcam.fleet._agent.summary import ask_cameras
from smartcam.models import Disconnected
from smartcam.settings import parse_address

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.fleet._agent.agent import Agent
    from smartcam.fleet._agent.host import Host
    from smartcam.fleet._bus.bus import Bus, Handle
    from smartcam.fleet._bus.keys import Keys
    from smartcam.fleet._file.standby import Standby
    from smartcam.models import CameraEvent
    from smartcam.settings import Address, CameraSettings

logger: logging.Logger = logging.getLogger("smartcam.fleet")

HOLD_OFF_DELAY = 0.2
"""Seconds per step of preference until a standby agent takes a camera that has no agent."""

ASK_TIMEOUT = 0.5
"""Seconds for another agent's answer, and between two checks of its cameras."""

RESOLVE_TIMEOUT = 2.0
"""Seconds of the timeout for the addresses of a host's name."""

RETURN_WAIT = 4.0
"""Seconds for other agents to return after a loss of the bus, before their cameras are taken."""

CONTESTED_SECONDS = 30.0
"""Seconds after another agent with the same camera appeared or disappeared, in which it is the
probable taker of the camera."""

TAKE_ONCE_SECONDS = 600.0
"""Seconds in which a camera that another client took is taken back at most once: otherwise two
clients would take it from each other again and again."""


class Claims:
    """The cameras that an agent shares or stands by for.

    Args:
        agent: the agent.
        keys: keys of the fleet.
        bus: the agent's end of the bus.
        standby: settings of standing by; None: the agent does not stand by.

    Attributes:
        given_up: errors for cameras that were left to another agent, by the camera's name.
    """

    def __init__(self, agent: Agent, keys: Keys, bus: Bus, standby: Standby | None) -> None:
        self._agent, self._keys, self._bus, self._standby = agent, keys, bus, standby
        self._wanted: dict[str, CameraSettings] = {}
        self._others: dict[str, set[str]] = {}  # other agents with a camera of this agent
        # loop time until which another agent may take the camera
        self._contested: dict[str, float] = {}
        self._calm: dict[str, float] = {}  # loop time until which a takeover is excluded
        self._settling: set[str] = set()
        self._again: set[str] = set()
        self._back: dict[str, asyncio.Event] = {}  # awaited presences of other agents
        self._watch: Handle | None = None
        self.given_up: dict[str, ConnectionTakenError] = {}
        self._start = f"{agent.epoch}-{secrets.token_hex(4)}"
        self._name: list[Handle] = []

    async def refuse_namesake(self, timeout: float) -> None:
        """Raise if another agent has the name; called before the name is used on the bus.

        Raises:
            ConfigurationError: there is another agent: its presence lasts longer than the presence
                of an agent that has died.
        """
        loop, name = asyncio.get_running_loop(), self._agent.name
        patience = loop.time() + LEASE_TIME + 1.0
        while await self._bus.present(self._keys.agent(name), timeout):
            if loop.time() > patience:
                raise ConfigurationError(
                    f"an agent named {name} is in fleet {self._keys.fleet} already; each has a "
                    "name of its own: `agent:` in its fleet file"
                )
            await asyncio.sleep(ASK_TIMEOUT)

    async def claim_name(self, timeout: float) -> None:
        """Take the agent's name, unless an agent that was started earlier has it.

        Raises:
            ConfigurationError: another agent has the name.
        """
        keys, bus, name = self._keys, self._bus, self._agent.name
        self._name.append(bus.be_present(keys.start(name, self._start)))
        for key in await bus.present(keys.start(name, "*"), timeout):
            if self._is_earlier(key):
                raise self._namesake_error()
        self._name.append(bus.watch(keys.start(name, "*"), self._on_namesake))

    def _is_earlier(self, key: str) -> bool:
        """Return True if another agent of this name was started earlier; there are no ties."""
        return _order(self._keys.tail(key, "presence/start")[-1]) < _order(self._start)

    def _namesake_error(self) -> ConfigurationError:
        name, fleet = self._agent.name, self._keys.fleet
        return ConfigurationError(
            f"an agent named {name} is in fleet {fleet}, which was started before this one: this "
            "one ends its cameras; each has a name of its own: `agent:` in its fleet file"
        )

    def _on_namesake(self, key: str, present: bool) -> None:
        if present and self._is_earlier(key):
            self._agent.retire(self._namesake_error())
        elif present and not key.endswith(f"/{self._start}"):
            logger.warning(
                "%s ! another agent of this name was started later: that one ends", self._agent.name
            )
        elif not present:
            for host in self._agent.hosts.values():
                host.camera.take_again()  # take back the camera that the other agent took

    async def open(self, cameras: Mapping[str, CameraSettings], timeout: float) -> None:
        """Share the cameras that no other agent has.

        Raises:
            ConfigurationError: another agent has a camera and neither stands by, or an option of a
                camera is wrong; nothing is shared.
        """
        self._wanted = dict(cameras)
        keys, bus = self._keys, self._bus
        for key in await bus.present(keys.camera("*", "**"), timeout):
            self._note(key, True)
        self._watch = bus.watch(keys.camera("*", "**"), self._on_presence)
        if self._standby is None:
            await self._refuse()
        others = self._others
        await self.refuse_taken({n: wanted for n, wanted in cameras.items() if not others.get(n)})
        for name, settings in cameras.items():
            if self._others.get(name):
                self._consider(name)
            else:
                self._agent.share(name, settings)

    async def want(self, name: str, settings: CameraSettings) -> None:
        """Share a further camera, at once or when no other agent has it.

        Raises:
            ConfigurationError: another agent has it, and this one does not stand by.
        """
        self._wanted[name] = settings
        for key in await self._bus.present(self._keys.camera("*", name), ASK_TIMEOUT):
            self._note(key, True)
        others = self._others.get(name)
        if not others:
            try:
                await self.refuse_taken({name: settings})
            except ConfigurationError:
                self.drop(name)
                raise
            self._agent.share(name, settings)
        elif self._standby is not None:
            self._consider(name)
        else:
            self.drop(name)
            raise ConfigurationError(
                f"{name}: the agent {min(others)} has this camera, which serves one"
            )

    async def refuse_taken(self, cameras: Mapping[str, CameraSettings]) -> None:
        """Raise if the fleet has one of these cameras under another name.

        A camera serves one client. There is no await between the check of this agent's own cameras
        and the return. Two agents that check at the same time do not see each other.

        Raises:
            ConfigurationError: one of the addresses is taken; the text names it and its agent.
        """
        listing = self._keys.listing("**")
        answers = await self._bus.ask(listing, b"", ASK_TIMEOUT) if cameras else ()
        ports = {settings.address.port for settings in cameras.values()}
        listed_cameras: list[tuple[str, str, Address]] = []
        for _, payload in answers:
            try:
                listed = json.loads(payload)
                address = parse_address(str(listed["url"]))
                if address.port in ports:
                    listed_cameras.append((str(listed["camera"]), str(listed["agent"]), address))
            except (ValueError, TypeError, KeyError, SmartCamError) as exc:
                logger.warning("! an agent's message about a camera cannot be read: %s", exc)
        hosts = {settings.address.host for settings in cameras.values()}
        hosts |= {address.host for _, _, address in listed_cameras}
        hosts |= {host.settings.address.host for host in self._agent.hosts.values()}
        addresses = await _places_of(hosts)
        listed_cameras += [
            (name, self._agent.name, host.settings.address)
            for name, host in self._agent.hosts.items()
        ]
        taken: dict[tuple[str, int], list[tuple[str, str]]] = {}
        for camera, agent, address in listed_cameras:
            for place in addresses.get(address.host, {address.host}):
                taken.setdefault((place, address.port), []).append((camera, agent))
        for name, settings in cameras.items():
            address = settings.address
            for place in addresses[address.host]:
                for camera, agent in taken.get((place, address.port), ()):
                    if camera != name:
                        raise ConfigurationError(
                            f"{name}: {address.url} is the camera {camera} of the agent {agent}, "
                            "and a camera takes one client; use it under that name"
                        )

    def drop(self, name: str) -> None:
        """Stop claiming a camera."""
        self._wanted.pop(name, None)
        self._others.pop(name, None)
        self._contested.pop(name, None)
        self._calm.pop(name, None)
        self.given_up.pop(name, None)

    def close(self) -> None:
        """Stop claiming cameras. Idempotent."""
        self._wanted.clear()
        for handle in self._name:
            handle.close()
        self._name.clear()
        if self._watch is not None:
            self._watch.close()
            self._watch = None

    async def _refuse(self) -> None:
        """Raise if another agent has a camera of this agent, and neither stands by.

        An agent that does not answer may have died a moment ago: its presence ends only with the
        engine's lease.
        """
        loop = asyncio.get_running_loop()
        patience = loop.time() + LEASE_TIME + 1.0
        while True:
            contested = {(name, other) for name, others in self._others.items() for other in others}
            if not contested:
                return
            standby_of = {
                (answer.summary.camera, answer.summary.agent): answer.standby
                for agent in sorted({agent for _, agent in contested})
                for answer in await ask_cameras(self._bus, self._keys, agent, "**", ASK_TIMEOUT)
            }
            if all(standby_of.get(claim) for claim in contested):
                return
            silent = not contested & standby_of.keys()
            if not silent or loop.time() > patience:
                name, agent = min(claim for claim in contested if not standby_of.get(claim))
                more = f", and {len(contested) - 1} more cameras" if len(contested) > 1 else ""
                says = ", which does not answer" if silent else ""
                raise ConfigurationError(
                    f"{name}: the agent {agent} of fleet {self._keys.fleet}{says} has this camera "
                    f"already{more}; a camera has one agent. `standby: true` in both fleet files "
                    "makes this one stand by"
                )
            await asyncio.sleep(ASK_TIMEOUT)

    # ------------------------------------------------------------------ other agents

    def _note(self, key: str, present: bool) -> str:
        """Note another agent's presence; return its camera, "" if this agent does not have it."""
        agent, *chunks = self._keys.tail(key, "presence/camera")
        name = "/".join(chunks)
        if agent == self._agent.name or name not in self._wanted:
            return ""
        others = self._others.setdefault(name, set())
        (others.add if present else others.discard)(agent)
        now = asyncio.get_running_loop().time()
        if now >= self._calm.get(name, now):
            self._contested[name] = now + CONTESTED_SECONDS
        return name

    def _on_presence(self, key: str, present: bool) -> None:
        if name := self._note(key, present):
            if present and name in self._back:
                self._back[name].set()
            self._consider(name)

    def on_event(self, event: CameraEvent) -> None:
        """Handle an event of a camera of this agent."""
        if isinstance(event, Disconnected):
            name = event.camera
            if not self._bus.reached or self._is_contested(name):
                self._consider(name)

    def _is_contested(self, name: str) -> bool:
        """Return True if another agent announces a camera of this agent, or did a moment ago."""
        now = asyncio.get_running_loop().time()
        return bool(self._others.get(name)) or now < self._contested.get(name, now)

    def _consider(self, name: str) -> None:
        """Decide in a task which agent gets a camera; one task at a time for each camera."""
        self._again.add(name)
        if name not in self._settling:
            self._settling.add(name)
            self._agent.begin(self._settle(name), f"smartcam.fleet.{name}.claim")

    async def _settle(self, name: str) -> None:
        try:
            while name in self._again and name in self._wanted:
                self._again.discard(name)
                if name in self._agent.hosts:
                    await self._defend(name)
                else:
                    await self._stand_by(name)
        finally:
            self._settling.discard(name)

    async def _stand_by(self, name: str) -> None:
        """Take over a camera that no agent has."""
        if self._standby is None or self._others.get(name):
            return
        away = not self._bus.reached  # only this agent was cut off, not the others
        await asyncio.sleep(HOLD_OFF_DELAY * self._standby.preference)
        while away or not self._bus.reached:
            if self._bus.reached:
                if await self._appears(name, RETURN_WAIT):
                    return  # a further loss is handled by a new task
                away = False
            else:
                away = True
                await asyncio.sleep(ASK_TIMEOUT)
        settings = self._wanted.get(name)
        if settings is None or self._others.get(name) or name in self._agent.hosts:
            return
        try:
            await self.refuse_taken({name: settings})
        except ConfigurationError as exc:
            logger.warning("! %s", exc)
            await asyncio.sleep(RETURN_WAIT)
            self._again.add(name)
            return
        if name not in self._wanted or self._others.get(name) or name in self._agent.hosts:
            return
        logger.warning("%s = the agent %s takes it over", name, self._agent.name)
        self.given_up.pop(name, None)
        self._agent.share(name, settings)

    async def _appears(self, name: str, timeout: float) -> bool:
        """Wait until another agent announces a camera; return whether one did."""
        if self._others.get(name):
            return True
        back = self._back[name] = asyncio.Event()
        try:
            async with asyncio.timeout(timeout):
                await back.wait()
        except TimeoutError:
            return False
        else:
            return True
        finally:
            del self._back[name]

    async def _defend(self, name: str) -> None:
        """Decide whether this agent keeps a camera without a session.

        Another agent that also announces the camera keeps it if it has a session. If no other agent
        announces it, and another client took the camera, this agent stands by.
        """
        agent, away = self._agent, False
        while (host := agent.hosts.get(name)) and not host.connected:  # a later loss is an event
            if others := self._others.get(name):
                away = False
                other = min(others)
                if await self._yields(host, other):
                    await self._give_up(name, other)
                    return
                await asyncio.sleep(ASK_TIMEOUT)
            elif away or not self._bus.reached:
                away = not self._bus.reached
                await self._appears(name, ASK_TIMEOUT if away else RETURN_WAIT)
            elif self._standby is not None and _is_taken(host):
                logger.warning("! %s: no agent has it: %s stands by", name, agent.name)
                self._contested.pop(name, None)
                self._calm[name] = asyncio.get_running_loop().time() + TAKE_ONCE_SECONDS
                await agent.unshare(name, "another client has taken it")
                self._again.add(name)
                return
            elif self._is_contested(name):
                await self._appears(name, ASK_TIMEOUT)
            else:
                return

    async def _yields(self, host: Host, other: str) -> bool:
        """Return True if this agent, which has no session, leaves a camera to another agent.

        Of two agents without a session the first by name keeps the camera.
        """
        agent, name = self._agent, host.name
        cameras = await ask_cameras(self._bus, self._keys, other, name, ASK_TIMEOUT)
        if host.connected or agent.hosts.get(name) is not host:
            return False
        yields = bool(cameras) and (cameras[0].summary.connected or other < agent.name)
        return yields and other in self._others.get(name, ())

    async def _give_up(self, name: str, other: str) -> None:
        stays = "stands by" if self._standby is not None else "shares it no more"
        error = self.given_up[name] = ConnectionTakenError(
            f"{name}: the agent {other} has the camera now, which serves one; the agent "
            f"{self._agent.name} {stays}"
        )
        logger.warning("! %s", error)
        await self._agent.unshare(name, f"the agent {other} has it")


def _order(start: str) -> tuple[int, str]:
    """Return the sort key of agents' starts: time, then a random word."""
    epoch, _, chance = start.partition("-")
    return int(epoch) if epoch.isdecimal() else 0, chance


async def _places_of(hosts: set[str]) -> dict[str, set[str]]:
    """Return the addresses of each host, or its name if it has none; bounded."""
    places: dict[str, set[str]] = {}
    names: list[str] = []
    for host in hosts:
        try:
            places[host] = {ipaddress.ip_address(host).compressed}
        except ValueError:
            names.append(host)
            places[host] = {host.lower()}

    async def resolve(host: str) -> None:
        loop = asyncio.get_running_loop()
        try:
            addresses = await loop.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError):
            return  # the client reports an unknown host
        places[host] |= {str(address[4][0]) for address in addresses}

    if names:
        tasks = [asyncio.create_task(resolve(name)) for name in names]
        try:
            await asyncio.wait(tasks, timeout=RESOLVE_TIMEOUT)
        finally:
            for task in tasks:
                task.cancel()
    return places


def _is_taken(host: Host) -> bool:
    """Return True if there will be no further session, since another client has the camera."""
    return isinstance(host.camera.trouble, ConnectionTakenError)
