"""Share one subscription between many cameras of a fleet.

The object of each camera subscribes to the keys of this camera. For many cameras,
:meth:`Exchange.subscribe_all` declares one common subscription instead, and distributes the
messages to the cameras by their keys. This takes less time than many subscriptions, here and at the
agents.
"""

from __future__ import annotations

import asyncio
import logging
from functools import partial
from typing import TYPE_CHECKING

from smartcam.exceptions import ProtocolError
from smartcam.fleet._agent.bundle import ResultBundle, decode_bundle
from smartcam.fleet._agent.summary import ask_cameras
from smartcam.fleet._bus.bus import Bus, Handle, never
from smartcam.fleet._bus.wire import encode_groups

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Self

    from smartcam.fleet._bus.bus import BusQuestion, Data, Publisher
    from smartcam.fleet._bus.keys import Keys
    from smartcam.fleet._security.certificates import Identity

logger: logging.Logger = logging.getLogger("smartcam.fleet")

NEXT_NUMBERS_TIMEOUT = 0.5
"""Seconds for an agent's answer with the next result number of each of its cameras; after that, the
question is repeated."""

MAX_AGENTS_REMEMBERED = 1000
"""Largest number of agents whose next bundle number is remembered."""


class _KeyReceiver(Handle):
    """Receiver of the messages under one key."""

    def __init__(self, exchange: Exchange, key: str, call: Callable[..., None]) -> None:
        self.key, self.call = key, call
        self._exchange = exchange
        self.handle: Handle | None = None
        self.closed = False

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self._exchange.remove_receiver(self)
            if self.handle is not None:
                self.handle.close()


class Exchange(Bus):
    """A connection to a bus that the cameras of one fleet share.

    Args:
        bus: connection to the bus.
        keys: function that returns the fleet's keys once the connection is open.
    """

    def __init__(self, bus: Bus, keys: Callable[[], Keys]) -> None:
        self._bus, self._keys = bus, keys
        self.local = bus.local
        # receivers of each kind, by their keys
        self._receivers: dict[str, dict[str, list[_KeyReceiver]]] = {}
        self._common_handles: dict[str, Handle] = {}
        self._present: dict[str, set[str]] = {}  # present agents, by the camera's name
        # epoch and next expected number of each agent
        self._next_bundles: dict[str, tuple[int, int]] = {}
        # functions that take the presences of all cameras
        self._presence_callbacks: list[Callable[[str, bool], None]] = []
        self._agents_with_gaps: set[str] = set()  # agents of which bundles may be missing
        self._asking_tasks: dict[str, asyncio.Task[None]] = {}

    # ------------------------------------------------------------------ common subscriptions

    def watch_presences(self, on_presence: Callable[[str, bool], None]) -> None:
        """Call ``on_presence(key, present)`` for the presence of every camera."""
        self._presence_callbacks.append(on_presence)
        self.subscribe_all("presence/camera")

    def subscribe_all(self, kind: str) -> None:
        """Receive all messages of a kind: ``states``, ``results`` or ``presence/camera``."""
        if kind in self._common_handles:
            return
        keys, bus = self._keys(), self._bus
        if kind == "states":
            handle = bus.subscribe(keys.states("**"), self._on_state)
        elif kind == "results":
            handle = bus.subscribe(keys.bundle("*"), self._on_bundle)
        else:
            handle = bus.watch(keys.camera("*", "**"), self._on_presence)
        self._common_handles[kind] = handle
        for receivers in [*self._receivers.get(kind, {}).values()]:
            # a message may arrive by both subscriptions; its receiver drops one, by its number
            for receiver in receivers:
                own_handle, receiver.handle = receiver.handle, None
                if own_handle is not None:
                    own_handle.close()

    def _unsubscribe_all(self, kind: str) -> None:
        self._common_handles.pop(kind).close()
        self._next_bundles.clear()
        self._agents_with_gaps.clear()

    def _kind_of(self, key: str) -> str:
        tail = key.removeprefix(f"{self._keys().root}/")
        first, _, rest = tail.partition("/")
        return f"{first}/{rest.partition('/')[0]}" if first == "presence" else first

    def _add_receiver(
        self, key: str, call: Callable[..., None], declare: Callable[[], Handle]
    ) -> _KeyReceiver:
        kind = self._kind_of(key)
        receiver = _KeyReceiver(self, key, call)
        self._receivers.setdefault(kind, {}).setdefault(self._receiver_name(key), []).append(
            receiver
        )
        if kind not in self._common_handles:
            receiver.handle = declare()
        return receiver

    def _receiver_name(self, key: str) -> str:
        """Return the name of a key's receivers: the key, or for a presence the camera's name."""
        return key.split("/", 5)[5] if "/presence/camera/" in key else key

    def remove_receiver(self, receiver: _KeyReceiver) -> None:
        """Remove a closed receiver; after the last one for results, end the common subscription."""
        kind, name = self._kind_of(receiver.key), self._receiver_name(receiver.key)
        receivers = self._receivers[kind]
        receivers[name].remove(receiver)
        if not receivers[name]:
            del receivers[name]
        if kind == "results" and not receivers and kind in self._common_handles:
            self._unsubscribe_all(kind)

    # ------------------------------------------------------------------ messages

    def _on_state(self, key: str, payload: bytes) -> None:
        for receiver in tuple(self._receivers.get("states", {}).get(key, ())):
            receiver.call(key, payload)

    def _on_presence(self, key: str, present: bool) -> None:
        name = self._receiver_name(key)
        presences = self._present.setdefault(name, set())
        (presences.add if present else presences.discard)(key)
        for on_presence in self._presence_callbacks:
            on_presence(key, present)
        for receiver in tuple(self._receivers.get("presence/camera", {}).get(name, ())):
            receiver.call(key, present)

    def _on_bundle(self, key: str, payload: bytes) -> None:
        agent = key.rpartition("/")[2]
        try:
            bundle = decode_bundle(payload, f"results of the agent {agent}")
        except ProtocolError as exc:
            logger.warning("! %s", exc)
            return
        self._distribute_bundle(bundle)
        known = self._next_bundles.get(agent)
        self._next_bundles[agent] = bundle.epoch, bundle.next_number
        if known != (bundle.epoch, bundle.number):
            self._agents_with_gaps.add(agent)
            self._start_asking(agent)
        if len(self._next_bundles) > MAX_AGENTS_REMEMBERED:
            del self._next_bundles[next(iter(self._next_bundles))]

    def _distribute_bundle(self, bundle: ResultBundle) -> None:
        receivers, stem = self._receivers.get("results", {}), self._keys().results("")
        for name, groups in bundle.parts:
            key = stem + name
            for receiver in tuple(receivers.get(key, ())):
                receiver.call(key, groups)

    def _start_asking(self, agent: str) -> None:
        """Start to ask for an agent's next result numbers, unless this is under way."""
        asking = self._asking_tasks.get(agent)
        if asking is None or asking.done():
            self._asking_tasks[agent] = asyncio.get_running_loop().create_task(
                self._ask_numbers(agent), name=f"smartcam.fleet.{agent}.numbers"
            )
            self._asking_tasks[agent].add_done_callback(partial(self._end_asking, agent))

    def _end_asking(self, agent: str, task: asyncio.Task[None]) -> None:
        if self._asking_tasks.get(agent) is task:
            del self._asking_tasks[agent]

    async def _ask_numbers(self, agent: str) -> None:
        """Ask for the next result numbers of an agent's cameras, so that receivers find gaps."""
        keys, bus = self._keys(), self._bus
        while agent in self._agents_with_gaps:
            self._agents_with_gaps.discard(agent)
            cameras = await ask_cameras(bus, keys, agent, "**", NEXT_NUMBERS_TIMEOUT)
            for camera in cameras:
                receivers = self._receivers.get("results", {})
                for receiver in tuple(receivers.get(keys.results(camera.summary.camera), ())):
                    # a message without results reports the next number
                    receiver.call(receiver.key, encode_groups(camera.epoch, camera.next_result, []))
            if not cameras and await bus.present_keys(keys.agent(agent), NEXT_NUMBERS_TIMEOUT):
                self._agents_with_gaps.add(agent)
                await asyncio.sleep(NEXT_NUMBERS_TIMEOUT)

    # ------------------------------------------------------------------ as a bus

    def subscribe(
        self, pattern: str, on_message: Callable[[str, bytes], None], *, low_priority: bool = False
    ) -> Handle:
        if "*" in pattern or self._kind_of(pattern) not in {"states", "results"}:
            return self._bus.subscribe(pattern, on_message, low_priority=low_priority)
        return self._add_receiver(
            pattern, on_message, lambda: self._bus.subscribe(pattern, on_message)
        )

    def watch(self, pattern: str, on_presence: Callable[[str, bool], None]) -> Handle:
        if self._kind_of(pattern) != "presence/camera" or "*" in self._receiver_name(pattern):
            return self._bus.watch(pattern, on_presence)
        receiver = self._add_receiver(
            pattern, on_presence, lambda: self._bus.watch(pattern, on_presence)
        )
        if receiver.handle is None:
            for key in sorted(self._present.get(self._receiver_name(pattern), ())):
                on_presence(key, True)
        return receiver

    @property
    def is_connected(self) -> bool:
        return self._bus.is_connected

    @property
    def waiting_bytes(self) -> int:
        return self._bus.waiting_bytes

    @property
    def identity(self) -> Identity | None:  # type: ignore[override]
        """Identity in the certificate of the connection."""
        return self._bus.identity

    async def open(self, timeout: float) -> Self:
        await self._bus.open(timeout)
        return self

    async def stop_receiving(self) -> None:
        """Stop receiving. Idempotent."""
        tasks = [*self._asking_tasks.values()]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for handle in self._common_handles.values():
            handle.close()
        self._common_handles.clear()

    async def close(self) -> None:
        await self.stop_receiving()
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
        low_priority: Callable[[str], bool] = never,
    ) -> Handle:
        return self._bus.answer(pattern, answer, low_priority=low_priority)

    async def ask(self, pattern: str, payload: bytes, timeout: float) -> list[tuple[str, bytes]]:
        return await self._bus.ask(pattern, payload, timeout)

    def announce(self, key: str) -> Handle:
        return self._bus.announce(key)

    async def present_keys(self, pattern: str, timeout: float) -> list[str]:
        return await self._bus.present_keys(pattern, timeout)
