"""Decide which agent of a fleet has a name and a camera, and when a standby agent takes over.

Each agent publishes the time of its start. If two agents have the same name, the agent that was
started earlier keeps the name; the later agent gives up its cameras, and logs that.

An agent announces each camera by a presence on the bus, which ends with the agent. Another agent
with the same camera refuses to start, or stands by: it makes no session until that presence ends.
After a split of the network two agents may share one camera. Then the camera decides, since it
serves the newest client: the agent that has lost its session asks the other agent whether that one
has a session, and if so, leaves the camera to it. In case both agents give up the camera at the
same time, each of them stands by again when the other agent no longer has the camera.
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
    from smartcam.fleet._agent.shared_camera import SharedCamera
    from smartcam.fleet._bus.bus import Bus, Handle
    from smartcam.fleet._bus.keys import Keys
    from smartcam.fleet._file.standby import Standby
    from smartcam.models import CameraEvent
    from smartcam.settings import Address, CameraSettings

logger: logging.Logger = logging.getLogger("smartcam.fleet")

HOLD_OFF_DELAY = 0.2
"""Seconds that a standby agent waits before it takes over a camera that has no agent, for each unit
of the agent's rank; so the agent with the lowest rank is first."""

ASK_TIMEOUT = 0.5
"""Seconds for another agent's answer, and between two checks of the other agent's cameras."""

RESOLVE_TIMEOUT = 2.0
"""Seconds to find the addresses of host names."""

RETURN_WAIT = 4.0
"""Seconds to wait for other agents to return after the bus was lost; then their cameras are taken
over."""

CONTEST_TIME = 30.0
"""Seconds after another agent with the same camera has appeared or disappeared, in which a client
that takes the camera is assumed to be that agent."""

TAKE_BACK_INTERVAL = 600.0
"""Least number of seconds between two times that this agent takes a camera back from another
client. Otherwise two clients could take the camera from each other again and again."""


class Claims:
    """The cameras that an agent shares or stands by for.

    Args:
        agent: the agent.
        keys: keys of the fleet.
        bus: the agent's connection to the bus.
        standby: settings of a standby agent; None: the agent does not stand by.

    Attributes:
        given_up: reason why a camera was left to another agent, as an error, by the camera's name.
    """

    def __init__(self, agent: Agent, keys: Keys, bus: Bus, standby: Standby | None) -> None:
        self._agent, self._keys, self._bus, self._standby = agent, keys, bus, standby
        self._wanted: dict[str, CameraSettings] = {}
        self._other_agents: dict[str, set[str]] = {}  # other agents that announce each camera
        # loop time until which another agent counts as the probable taker of the camera
        self._contested_until: dict[str, float] = {}
        self._uncontested_until: dict[str, float] = {}  # before it, presences do not contest
        self._deciding: set[str] = set()
        self._undecided: set[str] = set()
        self._other_appeared: dict[
            str, asyncio.Event
        ] = {}  # awaited presences of another agent, by camera
        self._presence_watch: Handle | None = None
        self.given_up: dict[str, ConnectionTakenError] = {}
        self._start_id = f"{agent.epoch}-{secrets.token_hex(4)}"
        self._name_handles: list[Handle] = []

    async def check_name_free(self, timeout: float) -> None:
        """Check that no other agent has the name, before the name is used on the bus.

        Raises:
            ConfigurationError: another agent has the name, and is still present after the time
                in which the bus notices that an agent has died.
        """
        loop, name = asyncio.get_running_loop(), self._agent.name
        give_up_at = loop.time() + LEASE_TIME + 1.0
        while await self._bus.present_keys(self._keys.agent(name), timeout):
            if loop.time() > give_up_at:
                raise ConfigurationError(
                    f"an agent named {name} is in fleet {self._keys.fleet} already: give each "
                    "agent a name of its own, by `agent:` in its fleet file"
                )
            await asyncio.sleep(ASK_TIMEOUT)

    async def claim_name(self, timeout: float) -> None:
        """Announce the agent's start, unless an agent of this name was started earlier.

        Raises:
            ConfigurationError: another agent has the name.
        """
        keys, bus, name = self._keys, self._bus, self._agent.name
        self._name_handles.append(bus.announce(keys.start(name, self._start_id)))
        for key in await bus.present_keys(keys.start(name, "*"), timeout):
            if self._is_earlier(key):
                raise self._namesake_error()
        self._name_handles.append(bus.watch(keys.start(name, "*"), self._on_namesake))

    def _is_earlier(self, key: str) -> bool:
        """Return True if another agent of this name was started earlier; starts are never equal."""
        return _start_order(self._keys.tail(key, "presence/start")[-1]) < _start_order(
            self._start_id
        )

    def _namesake_error(self) -> ConfigurationError:
        name, fleet = self._agent.name, self._keys.fleet
        return ConfigurationError(
            f"an agent named {name} is in fleet {fleet}, which was started before this one: this "
            "one gives up its cameras; give each agent its own name, by `agent:` in its fleet file"
        )

    def _on_namesake(self, key: str, present: bool) -> None:
        if present and self._is_earlier(key):
            self._agent.retire(self._namesake_error())
        elif present and not key.endswith(f"/{self._start_id}"):
            logger.warning(
                "%s ! another agent of this name started later: that one ends", self._agent.name
            )
        elif not present:
            for camera in self._agent.shared_cameras.values():
                camera.client.try_take_back()  # the other agent may have taken the camera

    async def open(self, cameras: Mapping[str, CameraSettings], timeout: float) -> None:
        """Share the cameras that no other agent has.

        Raises:
            ConfigurationError: another agent has a camera and neither stands by, or an option of a
                camera is wrong; nothing is shared.
        """
        self._wanted = dict(cameras)
        keys, bus = self._keys, self._bus
        for key in await bus.present_keys(keys.camera("*", "**"), timeout):
            self._note_presence(key, True)
        self._presence_watch = bus.watch(keys.camera("*", "**"), self._on_presence)
        if self._standby is None:
            await self._check_cameras_free()
        others = self._other_agents
        free = {name: settings for name, settings in cameras.items() if not others.get(name)}
        await self.check_addresses_free(free)
        for name, settings in cameras.items():
            if self._other_agents.get(name):
                self._decide_soon(name)
            else:
                self._agent.share(name, settings)

    async def claim_camera(self, name: str, settings: CameraSettings) -> None:
        """Share a further camera, at once or when no other agent has it.

        Raises:
            ConfigurationError: another agent has the camera, and this agent does not stand by.
        """
        self._wanted[name] = settings
        for key in await self._bus.present_keys(self._keys.camera("*", name), ASK_TIMEOUT):
            self._note_presence(key, True)
        others = self._other_agents.get(name)
        if not others:
            try:
                await self.check_addresses_free({name: settings})
            except ConfigurationError:
                self.drop_claim(name)
                raise
            self._agent.share(name, settings)
        elif self._standby is not None:
            self._decide_soon(name)
        else:
            self.drop_claim(name)
            raise ConfigurationError(
                f"{name}: the agent {min(others)} has this camera, which serves one client"
            )

    async def check_addresses_free(self, cameras: Mapping[str, CameraSettings]) -> None:
        """Check that the fleet has none of these cameras under another name.

        The addresses of the cameras are compared, since a camera serves one client. No other task
        runs between the check of this agent's own cameras and the return. But two agents that check
        at the same time do not detect each other.

        Raises:
            ConfigurationError: an address is taken; the text names the address and its agent.
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
        hosts |= {shared.settings.address.host for shared in self._agent.shared_cameras.values()}
        addresses = await _resolve_hosts(hosts)
        listed_cameras += [
            (name, self._agent.name, shared.settings.address)
            for name, shared in self._agent.shared_cameras.items()
        ]
        taken: dict[tuple[str, int], list[tuple[str, str]]] = {}
        for camera, agent, address in listed_cameras:
            for ip_address in addresses.get(address.host, {address.host}):
                taken.setdefault((ip_address, address.port), []).append((camera, agent))
        for name, settings in cameras.items():
            address = settings.address
            for ip_address in addresses[address.host]:
                for camera, agent in taken.get((ip_address, address.port), ()):
                    if camera != name:
                        raise ConfigurationError(
                            f"{name}: {address.url} is the camera {camera} of the agent {agent}, "
                            "and a camera takes one client; use it under that name"
                        )

    def drop_claim(self, name: str) -> None:
        """Stop claiming a camera."""
        self._wanted.pop(name, None)
        self._other_agents.pop(name, None)
        self._contested_until.pop(name, None)
        self._uncontested_until.pop(name, None)
        self.given_up.pop(name, None)

    def close(self) -> None:
        """Stop claiming cameras. Idempotent."""
        self._wanted.clear()
        for handle in self._name_handles:
            handle.close()
        self._name_handles.clear()
        if self._presence_watch is not None:
            self._presence_watch.close()
            self._presence_watch = None

    async def _check_cameras_free(self) -> None:
        """Check that no other agent has a camera of this agent, unless one of them stands by.

        An agent that does not answer may have died just before: the bus ends its presence only
        after a lease time. So this method waits for the lease time.
        """
        loop = asyncio.get_running_loop()
        give_up_at = loop.time() + LEASE_TIME + 1.0
        while True:
            contested = {
                (name, other) for name, others in self._other_agents.items() for other in others
            }
            if not contested:
                return
            standby_of = {
                (answer.summary.camera, answer.summary.agent): answer.standby
                for agent in sorted({agent for _, agent in contested})
                for answer in await ask_cameras(self._bus, self._keys, agent, "**", ASK_TIMEOUT)
            }
            if all(standby_of.get(claim) for claim in contested):
                return
            has_no_answer = not contested & standby_of.keys()
            if not has_no_answer or loop.time() > give_up_at:
                name, agent = min(claim for claim in contested if not standby_of.get(claim))
                more_text = f", and {len(contested) - 1} more cameras" if len(contested) > 1 else ""
                says = ", which does not answer" if has_no_answer else ""
                raise ConfigurationError(
                    f"{name}: the agent {agent} of fleet {self._keys.fleet}{says} has this camera "
                    f"already{more_text}; a camera has one agent. `standby: true` in both fleet "
                    "files makes this one stand by"
                )
            await asyncio.sleep(ASK_TIMEOUT)

    # ------------------------------------------------------------------ other agents

    def _note_presence(self, key: str, present: bool) -> str:
        """Note that another agent announces a camera, or no longer does; return the camera's name.

        The name is "" if this agent does not claim the camera.
        """
        agent, *chunks = self._keys.tail(key, "presence/camera")
        name = "/".join(chunks)
        if agent == self._agent.name or name not in self._wanted:
            return ""
        others = self._other_agents.setdefault(name, set())
        (others.add if present else others.discard)(agent)
        now = asyncio.get_running_loop().time()
        if now >= self._uncontested_until.get(name, now):
            self._contested_until[name] = now + CONTEST_TIME
        return name

    def _on_presence(self, key: str, present: bool) -> None:
        if name := self._note_presence(key, present):
            if present and name in self._other_appeared:
                self._other_appeared[name].set()
            self._decide_soon(name)

    def on_event(self, event: CameraEvent) -> None:
        """Handle an event of a camera of this agent."""
        if isinstance(event, Disconnected):
            name = event.camera
            if not self._bus.is_connected or self._is_contested(name):
                self._decide_soon(name)

    def _is_contested(self, name: str) -> bool:
        """Return True if another agent announces the camera, or did so in :data:`CONTEST_TIME`."""
        now = asyncio.get_running_loop().time()
        return bool(self._other_agents.get(name)) or now < self._contested_until.get(name, now)

    def _decide_soon(self, name: str) -> None:
        """Start a task that decides which agent has a camera; each camera has one task at most."""
        self._undecided.add(name)
        if name not in self._deciding:
            self._deciding.add(name)
            self._agent.start_task(self._decide(name), f"smartcam.fleet.{name}.claim")

    async def _decide(self, name: str) -> None:
        try:
            while name in self._undecided and name in self._wanted:
                self._undecided.discard(name)
                if name in self._agent.shared_cameras:
                    await self._defend(name)
                else:
                    await self._stand_by(name)
        finally:
            self._deciding.discard(name)

    async def _stand_by(self, name: str) -> None:
        """Take over a camera that no agent has."""
        if self._standby is None or self._other_agents.get(name):
            return
        was_cut_off = not self._bus.is_connected  # then the other agents may still have the camera
        await asyncio.sleep(HOLD_OFF_DELAY * self._standby.rank)
        while was_cut_off or not self._bus.is_connected:
            if self._bus.is_connected:
                if await self._wait_for_other(name, RETURN_WAIT):
                    return  # a later presence or loss starts a new decision
                was_cut_off = False
            else:
                was_cut_off = True
                await asyncio.sleep(ASK_TIMEOUT)
        settings = self._wanted.get(name)
        if settings is None or self._other_agents.get(name) or name in self._agent.shared_cameras:
            return
        try:
            await self.check_addresses_free({name: settings})
        except ConfigurationError as exc:
            logger.warning("! %s", exc)
            await asyncio.sleep(RETURN_WAIT)
            self._undecided.add(name)
            return
        shared_cameras = self._agent.shared_cameras
        if name not in self._wanted or self._other_agents.get(name) or name in shared_cameras:
            return
        logger.warning("%s = the agent %s takes it over", name, self._agent.name)
        self.given_up.pop(name, None)
        self._agent.share(name, settings)

    async def _wait_for_other(self, name: str, timeout: float) -> bool:
        """Wait until another agent announces a camera; return False after the timeout."""
        if self._other_agents.get(name):
            return True
        appeared = self._other_appeared[name] = asyncio.Event()
        try:
            async with asyncio.timeout(timeout):
                await appeared.wait()
        except TimeoutError:
            return False
        else:
            return True
        finally:
            del self._other_appeared[name]

    async def _defend(self, name: str) -> None:
        """Decide whether this agent keeps a camera with which it has no session.

        If another agent announces the camera, too, and has a session, this agent gives up the
        camera. If no other agent announces it, but another client took it, this agent stands by.
        """
        agent, was_cut_off = self._agent, False
        # a session lost later is reported to on_event, which starts a new decision
        while (camera := agent.shared_cameras.get(name)) and not camera.connected:
            if others := self._other_agents.get(name):
                was_cut_off = False
                other = min(others)
                if await self._should_give_up(camera, other):
                    await self._give_up(name, other)
                    return
                await asyncio.sleep(ASK_TIMEOUT)
            elif was_cut_off or not self._bus.is_connected:
                was_cut_off = not self._bus.is_connected
                await self._wait_for_other(name, ASK_TIMEOUT if was_cut_off else RETURN_WAIT)
            elif self._standby is not None and _is_taken(camera):
                logger.warning(
                    "! %s: a client outside the fleet has it: %s stands by", name, agent.name
                )
                self._contested_until.pop(name, None)
                self._uncontested_until[name] = (
                    asyncio.get_running_loop().time() + TAKE_BACK_INTERVAL
                )
                await agent.unshare(name, "another client has taken it")
                self._undecided.add(name)
                return
            elif self._is_contested(name):
                await self._wait_for_other(name, ASK_TIMEOUT)
            else:
                return

    async def _should_give_up(self, camera: SharedCamera, other: str) -> bool:
        """Return True if this agent, which has no session, must leave a camera to another agent.

        If neither agent has a session, the agent whose name sorts first keeps the camera.
        """
        agent, name = self._agent, camera.name
        cameras = await ask_cameras(self._bus, self._keys, other, name, ASK_TIMEOUT)
        if camera.connected or not agent.is_shared(camera):
            return False
        other_keeps = bool(cameras) and (cameras[0].summary.connected or other < agent.name)
        return other_keeps and other in self._other_agents.get(name, ())

    async def _give_up(self, name: str, other: str) -> None:
        action = "stands by" if self._standby is not None else "shares it no more"
        error = self.given_up[name] = ConnectionTakenError(
            f"{name}: the agent {other} has the camera now, which serves one client; the agent "
            f"{self._agent.name} {action}"
        )
        logger.warning("! %s", error)
        await self._agent.unshare(name, f"the agent {other} has it")


def _start_order(start: str) -> tuple[int, str]:
    """Return the sort key of an agent's start: its time, then a random word."""
    epoch, _, random_word = start.partition("-")
    return int(epoch) if epoch.isdecimal() else 0, random_word


async def _resolve_hosts(hosts: set[str]) -> dict[str, set[str]]:
    """Return the IP addresses of each host, and its name if it is no IP address; bounded."""
    addresses: dict[str, set[str]] = {}
    names: list[str] = []
    for host in hosts:
        try:
            addresses[host] = {ipaddress.ip_address(host).compressed}
        except ValueError:
            names.append(host)
            addresses[host] = {host.lower()}

    async def resolve(host: str) -> None:
        loop = asyncio.get_running_loop()
        try:
            found = await loop.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError):
            return  # the client reports an unknown host
        addresses[host] |= {str(info[4][0]) for info in found}

    if names:
        tasks = [asyncio.create_task(resolve(name)) for name in names]
        try:
            await asyncio.wait(tasks, timeout=RESOLVE_TIMEOUT)
        finally:
            for task in tasks:
                task.cancel()
    return addresses


def _is_taken(camera: SharedCamera) -> bool:
    """Return True if another client has taken the camera, so that no further session follows."""
    return isinstance(camera.client.trouble, ConnectionTakenError)
