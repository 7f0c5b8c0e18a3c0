"""Subscribe once for many cameras, instead of once for each.

A camera of a fleet subscribes to its own keys. For many cameras, :meth:`Exchange.cover` declares
one subscription for all, and this module distributes the messages by their keys: a dictionary
costs less than a subscription of the engine, on both sides.
"""

from __future__ import annotations

import asyncio
import logging
from functools import partial
from typing import TYPE_CHECKING

from smartcam.exceptions import ProtocolError
from smartcam.fleet._agent.bundle import Bundled, decode_bundle
from smartcam.fleet._agent.summary import ask_cameras
from smartcam.fleet._bus.bus import Bus, Handle, never
from smartcam.fleet._bus.wire import encode_runs

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Self

    from smartcam.fleet._bus.bus import BusQuestion, Data, Publisher
    from smartcam.fleet._bus.keys import Keys
    from smartcam.fleet._security.certificates import Identity

logger: logging.Logger = logging.getLogger("smartcam.fleet")

NUMBERS_TIMEOUT = 0.5
"""Seconds for an agent's answer with its next numbers, after which the question is repeated."""

MAX_AGENTS_NUMBERED = 1000
"""Largest number of agents whose bundles' numbers are remembered."""


class _BusPlace(Handle):
    """Receiver of the messages under one key."""

    def __init__(self, exchange: Exchange, key: str, call: Callable[..., None]) -> None:
        self.key, self.call = key, call
        self._exchange = exchange
        self.handle: Handle | None = None
        self.closed = False

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self._exchange.drop(self)
            if self.handle is not None:
                self.handle.close()


class Exchange(Bus):
    """The end of a bus that the cameras of one fleet share.

    Args:
        bus: end of the bus.
        keys: function that returns the fleet's keys once the end is open.
    """

    def __init__(self, bus: Bus, keys: Callable[[], Keys]) -> None:
        self._bus, self._keys = bus, keys
        self.local = bus.local
        # receivers of each kind, by their keys
        self._places: dict[str, dict[str, list[_BusPlace]]] = {}
        self._covers: dict[str, Handle] = {}
        self._present: dict[str, set[str]] = {}  # present agents, by the camera's name
        # epoch and next expected number of each agent
        self._bundles: dict[str, tuple[int, int]] = {}
        # functions that take the presences of all cameras
        self._presence_callbacks: list[Callable[[str, bool], None]] = []
        self._lacking: set[str] = set()  # agents with missing bundles
        self._asking: dict[str, asyncio.Task[None]] = {}

    # ------------------------------------------------------------------ for many

    def see_all(self, on_presence: Callable[[str, bool], None]) -> None:
        """Watch all cameras' presences from now on, for watchers of one camera or of all.

        ``on_presence(key, present)`` is called for each.
        """
        self._presence_callbacks.append(on_presence)
        self.cover("presence/camera")

    def cover(self, kind: str) -> None:
        """Receive all messages of a kind: ``states``, ``results`` or ``presence/camera``."""
        if kind in self._covers:
            return
        keys, bus = self._keys(), self._bus
        if kind == "states":
            made = bus.subscribe(keys.states("**"), self._hand_out)
        elif kind == "results":
            made = bus.subscribe(keys.bundle("*"), self._on_bundle)
        else:
            made = bus.watch(keys.camera("*", "**"), self._on_presence)
        self._covers[kind] = made
        for places in [*self._places.get(kind, {}).values()]:
            # a message that arrives twice now is taken once, by its number
            for place in places:
                handle, place.handle = place.handle, None
                if handle is not None:
                    handle.close()

    def _uncover(self, kind: str) -> None:
        self._covers.pop(kind).close()
        self._bundles.clear()
        self._lacking.clear()

    def _kind(self, key: str) -> str:
        tail = key.removeprefix(f"{self._keys().root}/")
        first, _, behind = tail.partition("/")
        return f"{first}/{behind.partition('/')[0]}" if first == "presence" else first

    def _enter(
        self, key: str, call: Callable[..., None], declare: Callable[[], Handle]
    ) -> _BusPlace:
        kind = self._kind(key)
        place = _BusPlace(self, key, call)
        self._places.setdefault(kind, {}).setdefault(self._name(key), []).append(place)
        if kind not in self._covers:
            place.handle = declare()
        return place

    def _name(self, key: str) -> str:
        """Return the name in a receiver's key; for a presence, with any agent."""
        return key.split("/", 5)[5] if "/presence/camera/" in key else key

    def drop(self, place: _BusPlace) -> None:
        """Drop a receiver that is no longer used."""
        kind, name = self._kind(place.key), self._name(place.key)
        places = self._places[kind]
        places[name].remove(place)
        if not places[name]:
            del places[name]
        if kind == "results" and not places and kind in self._covers:
            self._uncover(kind)

    # ------------------------------------------------------------------ what comes

    def _hand_out(self, key: str, payload: bytes) -> None:
        for place in tuple(self._places.get("states", {}).get(key, ())):
            place.call(key, payload)

    def _on_presence(self, key: str, present: bool) -> None:
        name = self._name(key)
        presences = self._present.setdefault(name, set())
        (presences.add if present else presences.discard)(key)
        for on_presence in self._presence_callbacks:
            on_presence(key, present)
        for place in tuple(self._places.get("presence/camera", {}).get(name, ())):
            place.call(key, present)

    def _on_bundle(self, key: str, payload: bytes) -> None:
        agent = key.rpartition("/")[2]
        try:
            bundle = decode_bundle(payload, f"results of the agent {agent}")
        except ProtocolError as exc:
            logger.warning("! %s", exc)
            return
        self._give(bundle)
        known = self._bundles.get(agent)
        self._bundles[agent] = bundle.epoch, bundle.following
        if known != (bundle.epoch, bundle.number):
            self._lacking.add(agent)
            self._find_gaps(agent)
        if len(self._bundles) > MAX_AGENTS_NUMBERED:
            del self._bundles[next(iter(self._bundles))]

    def _give(self, bundle: Bundled) -> None:
        places, stem = self._places.get("results", {}), self._keys().results("")
        for name, runs in bundle.parts:
            key = stem + name
            for place in tuple(places.get(key, ())):
                place.call(key, runs)

    def _find_gaps(self, agent: str) -> None:
        """Ask for an agent's numbers after a lost bundle, or its first one."""
        asking = self._asking.get(agent)
        if asking is None or asking.done():
            self._asking[agent] = asyncio.get_running_loop().create_task(
                self._ask_numbers(agent), name=f"smartcam.fleet.{agent}.numbers"
            )
            self._asking[agent].add_done_callback(partial(self._end_asking, agent))

    def _end_asking(self, agent: str, task: asyncio.Task[None]) -> None:
        if self._asking.get(agent) is task:
            del self._asking[agent]

    async def _ask_numbers(self, agent: str) -> None:
        """Ask for the next result numbers of an agent's cameras, by which gaps are found."""
        keys, bus = self._keys(), self._bus
        while agent in self._lacking:
            self._lacking.discard(agent)
            cameras = await ask_cameras(bus, keys, agent, "**", NUMBERS_TIMEOUT)
            for camera in cameras:
                places = self._places.get("results", {})
                for place in tuple(places.get(keys.results(camera.summary.camera), ())):
                    place.call(place.key, encode_runs(camera.epoch, camera.following, []))
            if not cameras and await bus.present(keys.agent(agent), NUMBERS_TIMEOUT):
                self._lacking.add(agent)
                await asyncio.sleep(NUMBERS_TIMEOUT)

    # ------------------------------------------------------------------ as a bus

    def subscribe(
        self, pattern: str, on_message: Callable[[str, bytes], None], *, patient: bool = False
    ) -> Handle:
        if "*" in pattern or self._kind(pattern) not in {"states", "results"}:
            return self._bus.subscribe(pattern, on_message, patient=patient)
        return self._enter(pattern, on_message, lambda: self._bus.subscribe(pattern, on_message))

    def watch(self, pattern: str, on_presence: Callable[[str, bool], None]) -> Handle:
        if self._kind(pattern) != "presence/camera" or "*" in self._name(pattern):
            return self._bus.watch(pattern, on_presence)
        place = self._enter(pattern, on_presence, lambda: self._bus.watch(pattern, on_presence))
        if place.handle is None:
            for key in sorted(self._present.get(self._name(pattern), ())):
                on_presence(key, True)
        return place

    @property
    def reached(self) -> bool:
        return self._bus.reached

    @property
    def waiting_bytes(self) -> int:
        return self._bus.waiting_bytes

    @property
    def identity(self) -> Identity | None:  # type: ignore[override]
        """Identity in the certificate of the end."""
        return self._bus.identity

    async def open(self, timeout: float) -> Self:
        await self._bus.open(timeout)
        return self

    async def leave(self) -> None:
        """Stop receiving. Idempotent."""
        tasks = [*self._asking.values()]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for handle in self._covers.values():
            handle.close()
        self._covers.clear()

    async def close(self) -> None:
        await self.leave()
        await self._bus.close()

    def put(self, key: str, payload: bytes) -> None:
        self._bus.put(key, payload)

    def put_part(self, key: str, head: bytes, data: Data) -> None:
        self._bus.put_part(key, head, data)

    def subscribe_parts(self, pattern: str, on_part: Callable[[str, bytes, Data], None]) -> Handle:
        return self._bus.subscribe_parts(pattern, on_part)

    def publisher(
        self,
        key: str,
        on_subscribers: Callable[[bool], None] | None = None,
        *,
        urgent: bool = False,
    ) -> Publisher:
        return self._bus.publisher(key, on_subscribers, urgent=urgent)

    def answer(
        self,
        pattern: str,
        answer: Callable[[BusQuestion], None],
        *,
        patient: Callable[[str], bool] = never,
    ) -> Handle:
        return self._bus.answer(pattern, answer, patient=patient)

    async def ask(self, pattern: str, payload: bytes, timeout: float) -> list[tuple[str, bytes]]:
        return await self._bus.ask(pattern, payload, timeout)

    def be_present(self, key: str) -> Handle:
        return self._bus.be_present(key)

    async def present(self, pattern: str, timeout: float) -> list[str]:
        return await self._bus.present(pattern, timeout)
