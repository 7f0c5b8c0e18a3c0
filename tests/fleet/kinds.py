"""Kinds of cameras, directly and in a fleet over either bus, created like by ``connect()``."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from smartcam import Camera, SmartCamera
from smartcam._zenoh import BusLink
from smartcam.fleet import FleetCamera, MemoryBus
from smartcam.fleet._inside import Bus, Keys, ZenohConnection
from smartcam.observers import Observer
from smartcam.settings import Address, CameraSettings
from tests.fleet.inside import Agent, Program
from tests.processes import free_place

FLEET = "plant"

AGENTS = {
    "connect_timeout",
    "connect_attempts",
    "switch_timeout",
    "request_timeout",
    "close_timeout",
    "liveness_timeout",
    "reconnect",
    "restore",
    "max_length",
}
"""Options that are the agent's, since it has the session."""


class OwnAgentCamera(FleetCamera[Any]):
    """A camera of a fleet whose agent begins and ends with it."""

    def __init__(
        self,
        url: str,
        ends: tuple[Bus, Bus],
        options: dict[str, Any],
        observers: Iterable[Observer],
    ) -> None:
        name = "line1/cam1"
        theirs = {key: value for key, value in options.items() if key in AGENTS}
        session = CameraSettings.make(url, options.pop("model", None), {**theirs, "name": name})
        self.agent = Agent("agent", Keys(FLEET), ends[0], {name: session})
        address = Address("fleet", "fleet", "localhost", 7447, path=name)
        own = {key: value for key, value in options.items() if key not in {"max_length", "restore"}}
        super().__init__(
            CameraSettings.of(address, own),
            name,
            Program(ends[1], FLEET, name),
            observers=observers,
        )

    async def connect_to_agent(self, timeout: float, *, wait_for_session: bool = True) -> None:
        await self.agent.open(timeout)
        await super().connect_to_agent(timeout, wait_for_session=wait_for_session)

    async def close(self) -> None:
        try:
            await super().close()
        finally:
            await self.agent.close()


def connect(
    kind: str, url: str, *, observers: Iterable[Observer] = (), **options: Any
) -> Camera[Any]:
    """Return an unopened camera of a kind, for one that is at ``url``."""
    if kind == "wire":
        model = options.pop("model", None)
        return SmartCamera(CameraSettings.make(url, model, options), observers=observers)
    if kind == "in_process":
        bus = MemoryBus()
        return OwnAgentCamera(url, (bus.new_connection(), bus.new_connection()), options, observers)
    place = free_place()
    ends = ZenohConnection(BusLink(listen=(place,))), ZenohConnection(BusLink(connect=(place,)))
    return OwnAgentCamera(url, ends, options, observers)
