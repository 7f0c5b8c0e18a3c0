"""A fleet as a program uses it: its cameras, all of them or those of a pattern."""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Generic

from smartcam._suggestions import did_you_mean
from smartcam.camera import DEFAULT_MAX_QUEUE, DEFAULT_MAX_QUEUE_BYTES, DEFAULT_TRIGGER_TIMEOUT
from smartcam.exceptions import (
    ConfigurationError,
    LocalProtocolError,
    SmartCamError,
)
from smartcam.fleet._address import FleetAddress, check_pattern
from smartcam.fleet._camera import FleetCamera
from smartcam.fleet._keys import meets
from smartcam.fleet._program import Program
from smartcam.models import ValueT
from smartcam.settings import CameraSettings
from smartcam.streams import Subscribers, Subscription

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping
    from types import TracebackType
    from typing import Literal, Self

    from smartcam.fleet._bus import Bus, Handle
    from smartcam.models import Result, SubscriberStatistics

MOST_AT_ONCE = 64
"""Cameras that are met at a time when a fleet is opened."""


@dataclass(frozen=True, slots=True)
class FleetEvent:
    """Something that happened to a fleet.

    Attributes:
        fleet: its name.
        at: when this program learned of it, UTC.
        agent: the agent's name.
    """

    fleet: str
    at: datetime
    agent: str


@dataclass(frozen=True, slots=True)
class AgentJoined(FleetEvent):
    """An agent is there."""


@dataclass(frozen=True, slots=True)
class AgentLeft(FleetEvent):
    """An agent is gone, or the way to it."""


@dataclass(frozen=True, slots=True)
class CameraJoined(FleetEvent):
    """An agent shares a camera, whether it has a session with it or not.

    Attributes:
        camera: the camera's name.
    """

    camera: str


@dataclass(frozen=True, slots=True)
class CameraLeft(FleetEvent):
    """An agent shares a camera no more, or is gone.

    Attributes:
        camera: the camera's name.
    """

    camera: str


class FleetResults(Generic[ValueT]):
    """Results of several cameras as they come: ``async for result in results``.

    Each camera has a bounded queue of its own, so that one that sends much takes nothing from the
    others; they are read in turn. Cameras that join later are in it, too.

    Cancellation: safe, nothing is lost.
    """

    def __init__(
        self, subscribe: Callable[[FleetCamera[Any]], Subscription[Result[ValueT]]]
    ) -> None:
        self._subscribe = subscribe
        self._streams: dict[str, Subscription[Result[ValueT]]] = {}
        self._order: list[str] = []
        self._ready = asyncio.Event()
        self._ended = False

    @property
    def closed(self) -> bool:
        """Whether it is."""
        return self._ended

    def add(self, camera: FleetCamera[Any]) -> None:
        """Have a camera's results in it."""
        if camera.name not in self._streams and not self._ended:
            stream = self._streams[camera.name] = self._subscribe(camera)
            self._order.append(camera.name)
            stream.share(self._ready)

    def statistics(self) -> dict[str, SubscriberStatistics]:
        """Return the account of each camera's queue."""
        return {name: stream.statistics() for name, stream in self._streams.items()}

    def close(self) -> None:
        """Unsubscribe; what is queued counts as dropped. Idempotent."""
        self._ended = True
        for stream in self._streams.values():
            stream.close()
        self._ready.set()

    def __aiter__(self) -> AsyncIterator[Result[ValueT]]:
        return self

    async def __anext__(self) -> Result[ValueT]:
        """Return the next result.

        Raises:
            InterpretationError: what came cannot be read; the stream stays usable.
            StopAsyncIteration: closed, or the fleet is.
        """
        while True:
            for place, name in enumerate(self._order):
                stream = self._streams[name]
                if stream.waiting:
                    # whoever was read now comes last
                    self._order.append(self._order.pop(place))
                    return await anext(stream)
            if self._ended:
                raise StopAsyncIteration
            self._ready.clear()
            await self._ready.wait()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        self.close()


class Fleet:
    """The cameras of a fleet, made by :func:`smartcam.fleet.open`.

    ``fleet["line1/cam3"]`` is a :class:`~smartcam.Camera` like any other. Patterns mean several:
    ``*`` is one part of a name, ``**`` any number of them.

    Args:
        bus: an end of its own.
        address: where it is; None where it is in this process.
        fleet: its name; None for the only one that is there.
        around: what it stands on while it is open.
        timeout: seconds for coming to it.
        options: of the cameras, as :func:`smartcam.connect` takes them.
    """

    def __init__(
        self,
        bus: Bus,
        address: FleetAddress | None,
        fleet: str | None,
        around: contextlib.AbstractAsyncContextManager[object] | None,
        timeout: float,
        options: Mapping[str, Any],
    ) -> None:
        self._address = address
        self._program = Program(bus, fleet)
        self._around, self._timeout = around, timeout
        self._options = dict(options)
        self._cameras: dict[str, FleetCamera[Any]] = {}
        self._agents: dict[str, set[str]] = {}  # of a camera, those that share it
        self._handles: list[Handle] = []
        self._opening: dict[str, asyncio.Task[None]] = {}
        self._turns = asyncio.Semaphore(MOST_AT_ONCE)
        self._events: Subscribers[FleetEvent] = Subscribers()
        self._results: list[tuple[str, FleetResults[Any]]] = []
        self._stack = contextlib.AsyncExitStack()
        self._state: Literal["new", "open", "closed"] = "new"
        self._settings(self._address_of("camera"), {})  # wrong options are told at once

    # ------------------------------------------------------------------ life

    async def open(self) -> Self:
        """Come to the fleet, and meet the cameras that are there.

        Raises:
            ConnectFailedError: no bus, or no agent with a camera, within the time.
            ConfigurationError: there are several fleets, and none was named.

        Cancellation: it is closed again.
        """
        if self._state != "new":
            raise LocalProtocolError("the fleet was opened or closed before; make a new one")
        self._state = "open"
        loop = asyncio.get_running_loop()
        try:
            if self._around is not None:
                await self._stack.enter_async_context(self._around)
            deadline = loop.time() + self._timeout
            await self._program.open(self._timeout)
            keys, bus = self._program.keys, self._program.bus
            there = await bus.present(keys.camera("*", "**"), max(0.0, deadline - loop.time()))
            for key in there:
                self._on_camera(key, True)
            self._handles = [
                bus.watch(keys.camera("*", "**"), self._on_camera),
                bus.watch(keys.agent("*"), self._on_agent),
            ]
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout_at(deadline):
                    await asyncio.gather(*map(asyncio.shield, self._opening.values()))
        except BaseException:
            await self.close()
            raise
        return self

    async def close(self) -> None:
        """Leave the fleet; its cameras are closed with it. Idempotent, bounded."""
        self._state = "closed"
        for handle in self._handles:
            handle.close()
        self._handles = []
        for task in self._opening.values():
            task.cancel()
        await asyncio.gather(*self._opening.values(), return_exceptions=True)
        for _, results in self._results:
            results.close()
        for camera in self._cameras.values():
            await camera.close()
        for stream in self._events:
            stream.end(None)
        await self._program.close()
        await self._stack.aclose()

    async def __aenter__(self) -> Self:
        return await self.open()

    async def __aexit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        await self.close()

    def __repr__(self) -> str:
        return f"<Fleet {self.url}, {len(self)} cameras>"

    # ------------------------------------------------------------------ who is there

    @property
    def url(self) -> str:
        """Its URL; that of one in this process names no host."""
        return "fleet://" if self._address is None else self._address.url

    def cameras(self, pattern: str = "**") -> list[FleetCamera[Any]]:
        """Return the cameras that an agent shares now, by name.

        Raises:
            ConfigurationError: the pattern cannot be one.
        """
        check_pattern(pattern)
        there = sorted(name for name, agents in self._agents.items() if agents)
        return [self._cameras[name] for name in there if meets(pattern, name)]

    def agents(self, pattern: str = "**") -> list[str]:
        """Return the agents that share a camera of a pattern, by name.

        Raises:
            ConfigurationError: the pattern cannot be one.
        """
        check_pattern(pattern)
        sharing = (agents for name, agents in self._agents.items() if meets(pattern, name))
        return sorted({agent for agents in sharing for agent in agents})

    def __getitem__(self, name: str) -> FleetCamera[Any]:
        """Return a camera, which an agent shares or has shared.

        Raises:
            ConfigurationError: none is called so.
        """
        camera = self._cameras.get(name)
        if camera is None:
            there = ", ".join(sorted(self._cameras)[:20]) or "none"
            raise ConfigurationError(
                f"the fleet has no camera {name!r}; there are {there}"
                f"{did_you_mean(name, self._cameras)}"
            )
        return camera

    def __contains__(self, name: object) -> bool:
        return name in self._cameras

    def __iter__(self) -> Iterator[FleetCamera[Any]]:
        return iter(self.cameras())

    def __len__(self) -> int:
        return len(self.cameras())

    def events(
        self,
        *,
        max_queue: int = DEFAULT_MAX_QUEUE,
        overflow: Literal["drop_oldest", "error"] = "drop_oldest",
    ) -> Subscription[FleetEvent]:
        """Subscribe to agents and cameras that come and go; those that are there come first."""
        stream = Subscription[FleetEvent]("events", max_queue=max_queue, overflow=overflow)
        if self._state == "closed":
            stream.end(None)
        at = datetime.now(UTC)
        for agent in self.agents():
            stream.offer(AgentJoined(self._name, at, agent), 0.0)
        for camera, agents in sorted(self._agents.items()):
            for agent in sorted(agents):
                stream.offer(CameraJoined(self._name, at, agent, camera), 0.0)
        self._events.add(stream)
        return stream

    @property
    def _name(self) -> str:
        return self._program.keys.fleet

    def _tell(self, event: FleetEvent) -> None:
        for stream in self._events:
            stream.offer(event, 0.0)

    def _on_agent(self, key: str, present: bool) -> None:
        (agent,) = self._program.keys.tail(key, "presence/agent")
        kind = AgentJoined if present else AgentLeft
        self._tell(kind(self._name, datetime.now(UTC), agent))

    def _on_camera(self, key: str, present: bool) -> None:
        agent, *chunks = self._program.keys.tail(key, "presence/camera")
        name = "/".join(chunks)
        sharing = self._agents.setdefault(name, set())
        if present == (agent in sharing):
            return
        kind = CameraJoined if present else CameraLeft
        (sharing.add if present else sharing.discard)(agent)
        if name not in self._cameras:
            self._meet(name)
        self._tell(kind(self._name, datetime.now(UTC), agent, name))

    # ------------------------------------------------------------------ cameras

    def _address_of(self, name: str) -> Any:
        return (self._address or FleetAddress("fleet", "", 0)).of(name)

    def _settings(self, address: Any, options: Mapping[str, Any]) -> CameraSettings:
        return CameraSettings.of(address, {**self._options, **options})

    def _meet(self, name: str) -> None:
        settings = self._settings(self._address_of(name), {"name": name})
        camera = FleetCamera[Any](settings, name, self._program, shared=True)
        self._cameras[name] = camera
        for pattern, results in self._results:
            if meets(pattern, name):
                results.add(camera)
        task = asyncio.get_running_loop().create_task(
            self._open_camera(camera), name=f"smartcam.fleet.{name}.open"
        )
        self._opening[name] = task
        task.add_done_callback(lambda _: self._opening.pop(name, None))

    async def _open_camera(self, camera: FleetCamera[Any]) -> None:
        async with self._turns:
            await camera.attend(self._timeout)

    # ------------------------------------------------------------------ over many

    async def trigger(
        self, pattern: str = "**", *, timeout: float = DEFAULT_TRIGGER_TIMEOUT, **options: Any
    ) -> dict[str, Result[Any] | SmartCamError]:
        """Trigger every camera of a pattern at the same time; exactly one outcome for each.

        Args:
            pattern: of names.
            timeout: seconds for each.
            **options: as :meth:`smartcam.Camera.trigger` takes them.

        Returns:
            The result, or the error, by the camera's name.

        Raises:
            ConfigurationError: no camera is meant, or an argument cannot work.

        Cancellation: cancels each; which ones were triggered then is unknown.
        """
        return await self._each(pattern, lambda one: one.trigger(timeout=timeout, **options))

    async def _each(
        self, pattern: str, do: Callable[[FleetCamera[Any]], Awaitable[Any]]
    ) -> dict[str, Any]:
        cameras = self.cameras(pattern)
        if not cameras:
            there = ", ".join(one.name for one in self.cameras()[:20]) or "none"
            raise ConfigurationError(f"no camera of the fleet is {pattern!r}; there are {there}")

        async def outcome(camera: FleetCamera[Any]) -> Any:
            try:
                return await do(camera)
            except ConfigurationError:
                raise
            except SmartCamError as error:
                return error

        async with asyncio.TaskGroup() as group:
            tasks = {one.name: group.create_task(outcome(one)) for one in cameras}
        return {name: task.result() for name, task in tasks.items()}

    def results(
        self,
        pattern: str = "**",
        *,
        min_interval: float = 0.0,
        max_queue: int = DEFAULT_MAX_QUEUE,
        max_queue_bytes: int = DEFAULT_MAX_QUEUE_BYTES,
        overflow: Literal["drop_oldest", "error"] = "drop_oldest",
    ) -> FleetResults[Any]:
        """Subscribe to the results of every camera of a pattern; subscribed when called.

        Args:
            pattern: of names.
            min_interval: as :meth:`smartcam.Camera.results` has it; for each camera.
            max_queue: the same.
            max_queue_bytes: the same.
            overflow: the same.

        Raises:
            ConfigurationError: the pattern cannot be one.
        """
        check_pattern(pattern)

        def subscribe(camera: FleetCamera[Any]) -> Subscription[Result[Any]]:
            return camera.results(
                min_interval=min_interval,
                max_queue=max_queue,
                max_queue_bytes=max_queue_bytes,
                overflow=overflow,
            )

        results = FleetResults[Any](subscribe)
        self._results = [one for one in self._results if not one[1].closed]
        self._results.append((pattern, results))
        for name, camera in self._cameras.items():
            if meets(pattern, name):
                results.add(camera)
        return results
