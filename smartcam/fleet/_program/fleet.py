"""Define the fleet object with which a program uses all cameras of a fleet together."""

from __future__ import annotations

import asyncio
import collections
import contextlib
import dataclasses
import functools
import warnings
import weakref
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Generic

from smartcam._arguments import (
    check_aware_datetime,
    check_flag,
    check_integer,
    check_seconds,
    check_text,
)
from smartcam._finishing import close_all
from smartcam._suggestions import did_you_mean
from smartcam.camera import DEFAULT_MAX_QUEUE, DEFAULT_MAX_QUEUE_BYTES, DEFAULT_TRIGGER_TIMEOUT
from smartcam.exceptions import (
    ConfigurationError,
    ConnectionClosedError,
    LocalProtocolError,
    SmartCamError,
)
from smartcam.fleet._agent.outlet_service import (
    MAX_STORED_ROWS,
    StoredRequest,
    ask_outlets,
    ask_stores,
)
from smartcam.fleet._agent.reload_service import reload_agents
from smartcam.fleet._agent.summary import ask_cameras, best_by_name
from smartcam.fleet._bus.address import FleetAddress, check_name, check_pattern
from smartcam.fleet._bus.keys import patterns_overlap
from smartcam.fleet._program.camera import FleetCamera
from smartcam.fleet._program.exchange import Exchange
from smartcam.fleet._program.program import Program
from smartcam.models import ValueT
from smartcam.settings import CameraSettings
from smartcam.streams import Subscribers, Subscription

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Iterator, Mapping
    from types import TracebackType
    from typing import Literal, Self

    from smartcam.fleet._agent.outlet_service import ReportedOutlet, ReportedStore
    from smartcam.fleet._agent.reload import FleetChanges
    from smartcam.fleet._agent.summary import CameraSummary
    from smartcam.fleet._bus.bus import Bus, Handle
    from smartcam.models import Result, SubscriberStatistics

MAX_CAMERAS_ASKED_AT_OPEN = 256
"""Largest number of cameras of a fleet whose agents are asked for their state when the fleet is
opened. In a larger fleet, the agent of a camera is asked when the camera is first used."""

MAX_CAMERAS_AT_ONCE = 100
"""Largest number of cameras whose agents are asked, or that are closed, at the same time."""

MAX_CAMERAS_SUBSCRIBED = 64
"""Largest number of cameras that each have their own subscription. More cameras, if they are more
than half of the fleet, share one subscription to all cameras."""

STATUS_TIMEOUT = 5.0
"""Seconds of the timeout for the answers of all agents."""

STORE_TIMEOUT = 30.0
"""Seconds of the timeout for the answers of all stores of results. Stores read files, which is
slow."""


@dataclass(frozen=True, slots=True)
class FleetEvent:
    """An event of a fleet.

    Attributes:
        fleet: name of the fleet.
        at: time at which this program received it, UTC.
        agent: the agent's name.
    """

    fleet: str
    at: datetime
    agent: str


@dataclass(frozen=True, slots=True)
class AgentJoined(FleetEvent):
    """An agent is present now."""


@dataclass(frozen=True, slots=True)
class AgentLeft(FleetEvent):
    """An agent is lost, or the connection to it."""


@dataclass(frozen=True, slots=True)
class CameraJoined(FleetEvent):
    """An agent shares a camera, whether it has a session with it or not.

    Attributes:
        camera: the camera's name.
    """

    camera: str


@dataclass(frozen=True, slots=True)
class CameraLeft(FleetEvent):
    """An agent no longer shares a camera, or is lost.

    Attributes:
        camera: the camera's name.
    """

    camera: str


class _QueueBell(asyncio.Event):
    """An event for a queue that calls a function when the queue gets an item, or ends."""

    def __init__(self, ring: Callable[[], None]) -> None:
        super().__init__()
        self._ring = ring

    def set(self) -> None:
        self._ring()


class FleetResults(Generic[ValueT]):
    """Results of several cameras as they come: ``async for result in results``.

    Each camera has its own bounded queue, so that a busy camera takes no room from the others; the
    queues are read in turn. Cameras that join later are included.

    Cancellation: safe, nothing is lost.
    """

    def __init__(
        self, subscribe: Callable[[FleetCamera[Any]], Subscription[Result[ValueT]]]
    ) -> None:
        self._subscribe = subscribe
        # subscriptions of each camera; only the last one of a list may still be open
        self._streams: dict[str, list[Subscription[Result[ValueT]]]] = {}
        # subscriptions that have results
        self._ready_streams: collections.deque[Subscription[Result[ValueT]]] = collections.deque()
        self._marked: set[Subscription[Result[ValueT]]] = set()
        self._ready = asyncio.Event()
        self._ended = False

    def add(self, camera: FleetCamera[Any]) -> None:
        """Include a camera's results."""
        known = self._streams.setdefault(camera.name, [])
        if self._ended or (known and not known[-1].ended):
            return
        stream = self._subscribe(camera)
        known.append(stream)
        stream.share(_QueueBell(functools.partial(self._mark_ready, stream)))

    def _mark_ready(self, stream: Subscription[Result[ValueT]]) -> None:
        if stream not in self._marked:
            self._marked.add(stream)
            self._ready_streams.append(stream)
        self._ready.set()

    def statistics(self) -> dict[str, SubscriberStatistics]:
        """Return the counters of each camera's queue."""
        return {
            name: _sum_counts([stream.statistics() for stream in streams])
            for name, streams in self._streams.items()
            if streams
        }

    def end(self) -> None:
        """End the stream; results in the queue may still be read. Idempotent."""
        self._ended = True
        self._ready.set()

    def close(self) -> None:
        """Unsubscribe; queued results count as dropped. Idempotent."""
        for streams in self._streams.values():
            for stream in streams:
                stream.close()
        self.end()

    def __aiter__(self) -> AsyncIterator[Result[ValueT]]:
        return self

    async def __anext__(self) -> Result[ValueT]:
        """Return the next result.

        Raises:
            InterpretationError: a result cannot be interpreted; the stream stays usable.
            SubscriberOverflowError: a camera's queue overflowed, with ``overflow="error"``; the
                stream has no further results of this camera, the others continue.
            LinkError: a camera is lost for good; the other cameras' results continue.
            StopAsyncIteration: the stream or the fleet was closed.
        """
        while True:
            while self._ready_streams:
                stream = self._ready_streams.popleft()
                self._marked.discard(stream)
                if not stream.waiting:
                    if not stream.ended:
                        continue
                    try:
                        return await anext(stream)  # raises the stream's error, if it has one
                    except StopAsyncIteration:
                        continue
                try:
                    return await anext(stream)  # a result is queued, so there is no wait
                finally:
                    if stream.waiting or stream.ended:
                        self._mark_ready(stream)  # the other streams are read first
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


def _sum_counts(queues: list[SubscriberStatistics]) -> SubscriberStatistics:
    """Return the sums of the counts of a camera's queues, which replaced each other in turn."""
    *_, last = queues
    counts = ("offered", "taken", "dropped", "queued", "queued_bytes", "missed")
    return dataclasses.replace(
        last, **{name: sum(getattr(queue, name) for queue in queues) for name in counts}
    )


class Fleet:
    """The cameras of a fleet, created by :func:`smartcam.fleet.open`.

    ``fleet["line1/cam3"]`` is a :class:`~smartcam.Camera` like any other. In patterns ``*`` is one
    part of a name, ``**`` any number of parts.

    Args:
        bus: connection to the bus, for this fleet alone.
        address: address of the fleet; None if it is in this process.
        fleet: name of the fleet; None for the only one on the bus.
        around: context manager that is entered before the fleet is opened, such as its agent.
        timeout: seconds of the timeout for connecting to the fleet.
        options: options of the cameras, as for :func:`smartcam.connect`.
        bus_is_shared: whether another object opens and closes the connection to the bus.
    """

    def __init__(
        self,
        bus: Bus,
        address: FleetAddress | None,
        fleet: str | None,
        around: contextlib.AbstractAsyncContextManager[object] | None,
        timeout: float,
        options: Mapping[str, Any],
        *,
        bus_is_shared: bool = False,
    ) -> None:
        self._address = address
        self._exchange = Exchange(bus, lambda: self._program.keys)
        display_name = None if address is None else address.program
        self._program = Program(
            self._exchange, fleet, bus_is_shared=bus_is_shared, display_name=display_name
        )
        self._around, self._timeout = around, timeout
        self._options = dict(options)
        self._cameras: dict[str, FleetCamera[Any]] = {}
        self._present: set[str] = set()  # present agents
        self._agents: dict[str, set[str]] = {}  # agents that share each camera
        self._handles: list[Handle] = []
        self._opening_tasks: dict[str, asyncio.Task[None]] = {}
        self._events: Subscribers[FleetEvent] = Subscribers()
        self._results: list[tuple[str, weakref.ref[FleetResults[Any]]]] = []
        self._stack = contextlib.AsyncExitStack()
        self._state: Literal["new", "open", "closed"] = "new"
        self._asks_all_at_open = True  # False in a fleet of many cameras
        self._asking_slots = asyncio.Semaphore(MAX_CAMERAS_AT_ONCE)
        self._make_camera("camera")  # raises for wrong options now

    # ------------------------------------------------------------------ open and close

    async def open(self) -> Self:
        """Connect to the fleet, and find its cameras.

        Raises:
            ConnectFailedError: no bus, or no agent with a camera, is found in time.
            ConfigurationError: there are several fleets, and none was named.

        Cancellation: the fleet is closed again.
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
            remaining = max(0.0, deadline - loop.time())
            present = await bus.present_keys(keys.camera("*", "**"), remaining)
            self._asks_all_at_open = len(present) <= MAX_CAMERAS_ASKED_AT_OPEN
            for key in present:
                self._on_camera(key, True)
            if self._asks_all_at_open:
                self._handles.append(bus.watch(keys.camera("*", "**"), self._on_camera))
            else:
                self._exchange.watch_presences(self._on_camera)
                self._exchange.subscribe_all("states")
            self._handles.append(bus.watch(keys.agent("*"), self._on_agent))
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout_at(deadline):
                    await self._wait_asked(self._opening_tasks.values())
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
        for task in self._opening_tasks.values():
            task.cancel()
        await asyncio.gather(*self._opening_tasks.values(), return_exceptions=True)
        cameras = [*self._cameras.values()]
        for begin in range(0, len(cameras), MAX_CAMERAS_AT_ONCE):
            await close_all(camera.close for camera in cameras[begin : begin + MAX_CAMERAS_AT_ONCE])
        for results in self._matching_results("**"):
            results.end()
        for stream in self._events:
            stream.end(None)
        await self._exchange.stop_receiving()
        await self._program.close()
        await self._stack.aclose()

    async def __aenter__(self) -> Self:
        return await self.open()

    async def __aexit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        await self.close()

    def __del__(self) -> None:
        # an open bus refers to its fleet, so an open fleet is collected only together with its bus
        if vars(self).get("_state") == "open":
            warnings.warn(f"{self!r} was not closed", ResourceWarning, source=self, stacklevel=2)

    def __repr__(self) -> str:
        return f"<Fleet {self.url}, {len(self)} cameras>"

    # ------------------------------------------------------------------ cameras and agents

    @property
    def url(self) -> str:
        """The fleet's URL, without a host if the fleet is in this process."""
        return "fleet://" if self._address is None else self._address.url

    @property
    def warning(self) -> str:
        """Warning that this program's certificate ends soon, with the cure; empty for none."""
        identity = self._program.bus.identity
        return "" if identity is None else identity.warning

    def cameras(self, pattern: str = "**") -> list[FleetCamera[Any]]:
        """Return the cameras that agents share now, in the order of their names.

        Raises:
            ConfigurationError: the pattern is not valid.
        """
        return [self._known_camera(name) for name in self.names(pattern)]

    def names(self, pattern: str = "**") -> list[str]:
        """Return the names of the cameras that agents share now.

        Raises:
            ConfigurationError: the pattern is not valid.
        """
        pattern = check_pattern(pattern)
        shared = (name for name, agents in self._agents.items() if agents)
        return sorted(name for name in shared if patterns_overlap(pattern, name))

    def url_of(self, name: str) -> str:
        """Return the URL of a single camera, for :func:`smartcam.connect`.

        Raises:
            ConfigurationError: the name is not valid.
        """
        url: str = self._address_of(check_name(name)).url
        return url

    def _known_camera(self, name: str) -> FleetCamera[Any]:
        """Return a camera; ask its agent first if that was not done before."""
        camera = self._cameras.get(name)
        if camera is None:
            camera = self._ask_camera(name)
        return camera

    def agents(self, pattern: str = "**") -> list[str]:
        """Return the names of the agents that share a camera of a pattern.

        Raises:
            ConfigurationError: the pattern is not valid.
        """
        pattern = check_pattern(pattern)
        sharing = (
            agents for name, agents in self._agents.items() if patterns_overlap(pattern, name)
        )
        return sorted({agent for agents in sharing for agent in agents})

    def __getitem__(self, name: str) -> FleetCamera[Any]:
        """Return a camera that an agent shares now, or has shared before.

        For a camera that was given up (taken by another client, or lost with ``reconnect=None``)
        there is a new object once an agent shares it again.

        Raises:
            ConfigurationError: there is no camera of this name.
        """
        name = check_text(name, "camera", self.url)
        if name not in self._agents:
            names = ", ".join(sorted(self._agents)[:20]) or "none"
            raise ConfigurationError(
                f"the fleet has no camera {name!r}; there are {names}"
                f"{did_you_mean(name, self._agents)}"
            )
        return self._known_camera(name)

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and name in self._agents

    def __iter__(self) -> Iterator[FleetCamera[Any]]:
        return iter(self.cameras())

    def __len__(self) -> int:
        return sum(map(bool, self._agents.values()))

    async def find_cameras(self, pattern: str = "**") -> list[FleetCamera[Any]]:
        """Return the cameras of a pattern after their agents have answered, or timed out.

        In a fleet of up to 256 cameras, all agents are asked when the fleet is opened; in a larger
        fleet, a camera's agent is asked when the camera is first used. Commands to a camera wait
        for the answer; properties return the state that is known so far.

        Raises:
            ConfigurationError: the pattern is not valid.
            ConnectionClosedError: the fleet is not open.

        Cancellation: safe; the answers still arrive.
        """
        cameras = self.cameras(pattern)
        self._require_open()
        asking = [
            self._opening_tasks[camera.name]
            for camera in cameras
            if camera.name in self._opening_tasks
        ]
        await self._wait_asked(asking)
        self._require_open()
        return cameras

    async def _wait_asked(self, asking: Iterable[asyncio.Task[None]]) -> None:
        """Wait until agents have answered; a cancellation does not cancel the tasks that ask."""
        if tasks := {*asking}:
            await asyncio.wait(tasks)

    async def status(
        self, pattern: str = "**", *, timeout: float = STATUS_TIMEOUT
    ) -> dict[str, CameraSummary]:
        """Return the summary of every camera of a pattern, by name.

        Each agent is asked once, and answers without asking its cameras. Cameras whose agent does
        not answer in time are left out.

        Args:
            pattern: pattern of the cameras' names.
            timeout: seconds for the answers of all agents.

        Raises:
            ConfigurationError: the pattern, or the timeout, is not valid.
            ConnectionClosedError: the fleet is not open.

        Cancellation: safe.
        """
        pattern = check_pattern(pattern)
        timeout = check_seconds(timeout, "timeout", "status")
        self._require_open()
        program = self._program
        summaries = await ask_cameras(program.bus, program.keys, "*", pattern, timeout)
        best = best_by_name(
            summaries, lambda camera: (camera.summary.connected, camera.summary.agent)
        )
        return {name: best[name].summary for name in sorted(best)}

    async def outlets(self, *, timeout: float = STATUS_TIMEOUT) -> list[ReportedOutlet]:
        """Return the counts of all agents' outlets, sorted by agent and outlet.

        Args:
            timeout: seconds for the answers of all agents; agents that do not answer are left out.

        Raises:
            ConfigurationError: the timeout is not valid.
            ConnectionClosedError: the fleet is not open.

        Cancellation: safe.
        """
        timeout = check_seconds(timeout, "timeout", "outlets")
        self._require_open()
        return await ask_outlets(self._program.bus, self._program.keys, timeout)

    async def stored_results(
        self,
        pattern: str = "**",
        *,
        since: datetime | None = None,
        only_failed: bool = False,
        max_rows: int = 100,
        timeout: float = STORE_TIMEOUT,
    ) -> list[ReportedStore]:
        """Return the answers of agents' stores of results, by agent and outlet.

        Args:
            pattern: pattern of the cameras' names.
            since: time of the oldest rows to return, with its zone; None: all rows.
            only_failed: whether rows are only errors, gaps, and results that did not pass.
            max_rows: largest number of rows of each store, which are the newest.
            timeout: seconds for the answers of all agents; agents that do not answer are left out.

        Raises:
            ConfigurationError: an argument is not valid.
            ConnectionClosedError: the fleet is not open.

        Cancellation: safe.
        """
        owner = "stored_results"
        at = check_aware_datetime(since, "since", owner)
        request = StoredRequest(
            since=None if at is None else at.astimezone(UTC).isoformat(),
            only_failed=check_flag(only_failed, "only_failed", owner),
            camera=check_pattern(pattern),
            max_rows=check_integer(max_rows, "max_rows", 0, MAX_STORED_ROWS, owner),
        )
        timeout = check_seconds(timeout, "timeout", owner)
        self._require_open()
        return await ask_stores(self._program.bus, self._program.keys, request, timeout)

    def _require_open(self) -> None:
        if self._state != "open":
            raise ConnectionClosedError(f"{self.url}: not open: the fleet is new, or was closed")

    def events(
        self,
        *,
        max_queue: int = DEFAULT_MAX_QUEUE,
        overflow: Literal["drop_oldest", "error"] = "drop_oldest",
    ) -> Subscription[FleetEvent]:
        """Subscribe to events of agents and cameras; the first ones report the shared cameras."""
        stream = Subscription[FleetEvent]("events", max_queue=max_queue, overflow=overflow)
        if self._state == "closed":
            stream.end(None)
            return stream
        at = datetime.now(UTC)
        for agent in self.agents():
            stream.offer(AgentJoined(self._fleet_name, at, agent), 0.0)
        for camera, agents in sorted(self._agents.items()):
            for agent in sorted(agents):
                stream.offer(CameraJoined(self._fleet_name, at, agent, camera), 0.0)
        self._events.add(stream)
        return stream

    def _publish(self, kind: type[FleetEvent], *names: str) -> None:
        for stream in self._events:
            stream.offer(kind(self._fleet_name, datetime.now(UTC), *names), 0.0)

    @property
    def _fleet_name(self) -> str:
        return self._program.keys.fleet

    def _on_agent(self, key: str, present: bool) -> None:
        (agent,) = self._program.keys.tail(key, "presence/agent")
        if present == (agent in self._present):
            return
        if present:
            self._present.add(agent)
            self._publish(AgentJoined, agent)
            return
        for name in sorted(name for name, agents in self._agents.items() if agent in agents):
            self._remove_camera(agent, name)
        self._present.discard(agent)
        self._publish(AgentLeft, agent)

    def _on_camera(self, key: str, present: bool) -> None:
        keys = self._program.keys
        agent, *chunks = keys.tail(key, "presence/camera")
        name = "/".join(chunks)
        sharing = self._agents.setdefault(name, set())
        if present == (agent in sharing):
            return
        if not present:
            self._remove_camera(agent, name)
            return
        self._on_agent(keys.agent(agent), True)  # the agent's event is before its cameras'
        sharing.add(agent)
        known = self._cameras.get(name)
        wanted = self._asks_all_at_open or bool(self._matching_results(name))
        if (known is None and wanted) or (known is not None and known.ended):
            self._ask_camera(name)
        self._publish(CameraJoined, agent, name)

    def _remove_camera(self, agent: str, name: str) -> None:
        self._agents[name].discard(agent)
        camera = self._cameras.get(name)
        if camera is not None:
            camera.agent_left(agent)  # before the event is read
        self._publish(CameraLeft, agent, name)

    # ------------------------------------------------------------------ cameras

    def _address_of(self, name: str) -> Any:
        return (self._address or FleetAddress("fleet", "", 0)).of(name)

    def _make_camera(self, name: str) -> FleetCamera[Any]:
        own_options = {"name": name, "connect_timeout": self._timeout}
        settings = CameraSettings.of(self._address_of(name), {**self._options, **own_options})
        return FleetCamera[Any](settings, name, self._program, shared=True)

    def _ask_camera(self, name: str) -> FleetCamera[Any]:
        previous = self._cameras.get(name)
        camera = self._cameras[name] = self._make_camera(name)
        for results in self._matching_results(name):
            results.add(camera)
        task = asyncio.get_running_loop().create_task(
            self._follow_camera(camera, previous), name=f"smartcam.fleet.{name}.open"
        )
        self._opening_tasks[name] = task

        def on_done(task: asyncio.Task[None]) -> None:
            if self._opening_tasks.get(name) is task:
                del self._opening_tasks[name]

        task.add_done_callback(on_done)
        camera.opening_task = task
        return camera

    async def _follow_camera(
        self, camera: FleetCamera[Any], previous: FleetCamera[Any] | None
    ) -> None:
        if previous is not None:
            await previous.close()
        async with self._asking_slots:
            await camera.connect_to_agent(self._timeout)

    # ------------------------------------------------------------------ several cameras

    async def trigger(
        self, pattern: str = "**", *, timeout: float = DEFAULT_TRIGGER_TIMEOUT, **options: Any
    ) -> dict[str, Result[Any] | SmartCamError]:
        """Trigger every camera of a pattern at the same time; return one outcome for each.

        Args:
            pattern: pattern of the cameras' names.
            timeout: seconds of each trigger's timeout.
            **options: as for :meth:`smartcam.Camera.trigger`.

        Returns:
            The result (with ``results_per_trigger`` the list of results), or the error, by the
            camera's name.

        Raises:
            ConfigurationError: the pattern has no camera, or an argument is not valid.
            ConnectionClosedError: the fleet is not open.

        Cancellation: cancels each; which cameras were triggered is unknown.
        """
        return await self._call_each(
            pattern, lambda camera: camera.trigger(timeout=timeout, **options)
        )

    async def reload(
        self, agent: str | None = None, *, timeout: float = 30.0
    ) -> dict[str, FleetChanges | SmartCamError]:
        """Make agents read their fleet files again: :meth:`smartcam.fleet.FleetServer.reload`.

        Args:
            agent: name of the agent; None for all present agents.
            timeout: seconds for the answers.

        Returns:
            The changes, or the error, by the agent's name. After a ``ConfigurationError`` nothing
            was changed at this agent.

        Raises:
            ConfigurationError: there is no such agent.
            ConnectionClosedError: the fleet is not open.

        Cancellation: reloads that have begun continue.
        """
        timeout = check_seconds(timeout, "timeout", "reload")
        if agent is not None:
            agent = check_text(agent, "agent", "reload")
        self._require_open()
        agents = sorted(self._present)
        if agent is not None and agent not in agents:
            raise ConfigurationError(
                f"the fleet has no agent {agent!r}; there are {', '.join(agents[:20]) or 'none'}"
                f"{did_you_mean(agent, agents)}"
            )
        program = self._program
        wanted = agents if agent is None else [agent]
        return await reload_agents(program.bus, program.keys, wanted, timeout)

    async def _call_each(
        self, pattern: str, do: Callable[[FleetCamera[Any]], Coroutine[Any, Any, Any]]
    ) -> dict[str, Any]:
        pattern = check_pattern(pattern)
        self._require_open()
        cameras = await self.find_cameras(pattern)
        if not cameras:
            names = ", ".join(self.names()[:20]) or "none"
            raise ConfigurationError(f"no camera of the fleet is {pattern!r}; there are {names}")

        async def outcome(doing: Coroutine[Any, Any, Any]) -> Any:
            try:
                return await doing
            except SmartCamError as error:
                return error

        doing = {camera.name: do(camera) for camera in cameras}
        try:
            async with asyncio.TaskGroup() as group:
                tasks = {name: group.create_task(outcome(work)) for name, work in doing.items()}
        finally:
            for work in doing.values():
                work.close()  # the cancelled task may never have begun
        outcomes = {name: task.result() for name, task in tasks.items()}
        if all(isinstance(outcome, ConfigurationError) for outcome in outcomes.values()):
            raise next(iter(outcomes.values()))
        return outcomes

    def results(
        self,
        pattern: str = "**",
        *,
        min_interval: float = 0.0,
        max_queue: int = DEFAULT_MAX_QUEUE,
        max_queue_bytes: int = DEFAULT_MAX_QUEUE_BYTES,
        overflow: Literal["drop_oldest", "error"] = "drop_oldest",
    ) -> FleetResults[Any]:
        """Subscribe to the results of every camera of a pattern, from the call on.

        Args:
            pattern: pattern of the cameras' names.
            min_interval: as for :meth:`smartcam.Camera.results`, for each camera.
            max_queue: largest number of kept results of each camera, for a slow reader.
            max_queue_bytes: largest number of bytes of each camera's kept results.
            overflow: action beyond either bound: drop the oldest result, or raise an error.

        Raises:
            ConfigurationError: the pattern, or an argument, is not valid.
        """
        pattern = check_pattern(pattern)
        bounds: dict[str, Any] = {"min_interval": min_interval, "max_queue": max_queue}
        bounds |= {"max_queue_bytes": max_queue_bytes, "overflow": overflow}
        Subscription[Any]("results", **bounds)  # raises for wrong arguments now

        def subscribe(camera: FleetCamera[Any]) -> Subscription[Result[Any]]:
            stream: Subscription[Result[Any]] = camera.results(**bounds)
            return stream

        results = FleetResults[Any](subscribe)
        self._results = [entry for entry in self._results if entry[1]() is not None]
        self._results.append((pattern, weakref.ref(results)))
        names = {
            *self.names(pattern),
            *(name for name in self._cameras if patterns_overlap(pattern, name)),
        }
        if len(names) > MAX_CAMERAS_SUBSCRIBED and 2 * len(names) > len(self):
            self._exchange.subscribe_all("results")
        for name in names:
            results.add(self._known_camera(name))
        if self._state == "closed":
            results.end()
        return results

    def _matching_results(self, name: str) -> list[FleetResults[Any]]:
        """Return the streams of results whose pattern can match this name or pattern."""
        streams = [
            results() for pattern, results in self._results if patterns_overlap(pattern, name)
        ]
        return [stream for stream in streams if stream is not None]
