"""A fleet as a program uses it: its cameras, all of them or those of a pattern."""

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
    check_flag,
    check_instant,
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
from smartcam.fleet._agent.summary import ask_cameras, by_name
from smartcam.fleet._bus.address import FleetAddress, check_name, check_pattern
from smartcam.fleet._bus.keys import meets
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

    from smartcam.fleet._agent.outlet_service import ToldOutlet, ToldStore
    from smartcam.fleet._agent.reload import FleetChanges
    from smartcam.fleet._agent.summary import CameraSummary
    from smartcam.fleet._bus.bus import Bus, Handle
    from smartcam.models import Result, SubscriberStatistics

MAX_CAMERAS_MET = 256
"""Largest number of cameras of a fleet that are met when it is opened; of a larger one each when it
is used."""

AT_ONCE = 100
"""Cameras that are met, or left, at a time."""

MAX_CAMERAS_SUBSCRIBED = 64
"""Largest number of cameras whose results are heard one by one; of more, and most of the fleet, all
together."""

STATUS_TIMEOUT = 5.0
"""Seconds for the answers of all agents."""

STORE_TIMEOUT = 30.0
"""Seconds for the answers of all stores of results, which read a file."""


@dataclass(frozen=True, slots=True)
class FleetEvent:
    """Something that happened to a fleet.

    Attributes:
        fleet: name of the fleet.
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


class _QueueBell(asyncio.Event):
    """Calls somebody where a queue has something, or ends."""

    def __init__(self, ring: Callable[[], None]) -> None:
        super().__init__()
        self._ring = ring

    def set(self) -> None:
        self._ring()


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
        # the subscription of each camera; earlier ones in the list ended with a camera that was
        # given up
        self._streams: dict[str, list[Subscription[Result[ValueT]]]] = {}
        # subscriptions that have results
        self._line: collections.deque[Subscription[Result[ValueT]]] = collections.deque()
        self._in_line: set[Subscription[Result[ValueT]]] = set()
        self._ready = asyncio.Event()
        self._ended = False

    def add(self, camera: FleetCamera[Any]) -> None:
        """Have a camera's results in it."""
        known = self._streams.setdefault(camera.name, [])
        if self._ended or (known and not known[-1].ended):
            return
        stream = self._subscribe(camera)
        known.append(stream)
        stream.share(_QueueBell(functools.partial(self._queue, stream)))

    def _queue(self, stream: Subscription[Result[ValueT]]) -> None:
        if stream not in self._in_line:
            self._in_line.add(stream)
            self._line.append(stream)
        self._ready.set()

    def statistics(self) -> dict[str, SubscriberStatistics]:
        """Return the account of each camera's queue."""
        return {
            name: _sum([stream.statistics() for stream in streams])
            for name, streams in self._streams.items()
            if streams
        }

    def end(self) -> None:
        """End the stream; results in the queue may still be read. Idempotent."""
        self._ended = True
        self._ready.set()

    def close(self) -> None:
        """Unsubscribe; what is queued counts as dropped. Idempotent."""
        for streams in self._streams.values():
            for stream in streams:
                stream.close()
        self.end()

    def __aiter__(self) -> AsyncIterator[Result[ValueT]]:
        return self

    async def __anext__(self) -> Result[ValueT]:
        """Return the next result.

        Raises:
            InterpretationError: what came cannot be read; the stream stays usable.
            SubscriberOverflowError: more came of a camera than its queue holds, and that is an
                error; it has no results here any more, the others go on.
            LinkError: the same, for a camera that is lost for good.
            StopAsyncIteration: closed, or the fleet is.
        """
        while True:
            while self._line:
                stream = self._line.popleft()
                self._in_line.discard(stream)
                if not stream.waiting:
                    if not stream.ended:
                        continue
                    try:
                        return await anext(stream)  # which says how it ended, once
                    except StopAsyncIteration:
                        continue
                try:
                    return await anext(stream)  # something is there: it does not wait
                finally:
                    if stream.waiting or stream.ended:
                        self._queue(stream)  # behind the others
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


def _sum(accounts: list[SubscriberStatistics]) -> SubscriberStatistics:
    """Return the account of queues that were one after the other."""
    *_, last = accounts
    counts = ("offered", "taken", "dropped", "queued", "queued_bytes", "missed")
    return dataclasses.replace(
        last, **{name: sum(getattr(one, name) for one in accounts) for name in counts}
    )


class Fleet:
    """The cameras of a fleet, made by :func:`smartcam.fleet.open`.

    ``fleet["line1/cam3"]`` is a :class:`~smartcam.Camera` like any other. Patterns mean several:
    ``*`` is one part of a name, ``**`` any number of them.

    Args:
        bus: end of the bus, for this fleet alone.
        address: address of the fleet; None if it is in this process.
        fleet: name of the fleet; None for the only one that is there.
        around: context that is entered while the fleet is open.
        timeout: seconds in which the fleet has to be reached.
        options: options of the cameras, as :func:`smartcam.connect` takes them.
        guest: whether the end of the bus is another's, which opens and closes it.
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
        guest: bool = False,
    ) -> None:
        self._address = address
        self._exchange = Exchange(bus, lambda: self._program.keys)
        called = None if address is None else address.program
        self._program = Program(self._exchange, fleet, guest=guest, called=called)
        self._around, self._timeout = around, timeout
        self._options = dict(options)
        self._cameras: dict[str, FleetCamera[Any]] = {}
        self._present: set[str] = set()  # agents
        self._agents: dict[str, set[str]] = {}  # agents that share each camera
        self._handles: list[Handle] = []
        self._opening: dict[str, asyncio.Task[None]] = {}
        self._events: Subscribers[FleetEvent] = Subscribers()
        self._results: list[tuple[str, weakref.ref[FleetResults[Any]]]] = []
        self._stack = contextlib.AsyncExitStack()
        self._state: Literal["new", "open", "closed"] = "new"
        self._meets = True  # every camera at once: there are not so many
        self._turn = asyncio.Semaphore(AT_ONCE)
        self._make("camera")  # wrong options are told at once

    # ------------------------------------------------------------------ life

    async def open(self) -> Self:
        """Come to the fleet, and meet the cameras that are there.

        Raises:
            ConnectFailedError: no bus, or no agent with a camera, within the time.
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
            there = await bus.present(keys.camera("*", "**"), max(0.0, deadline - loop.time()))
            self._meets = len(there) <= MAX_CAMERAS_MET
            for key in there:
                self._on_camera(key, True)
            if self._meets:
                self._handles.append(bus.watch(keys.camera("*", "**"), self._on_camera))
            else:
                self._exchange.see_all(self._on_camera)
                self._exchange.cover("states")
            self._handles.append(bus.watch(keys.agent("*"), self._on_agent))
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout_at(deadline):
                    await self._met(self._opening.values())
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
        cameras = [*self._cameras.values()]
        for begin in range(0, len(cameras), AT_ONCE):
            await close_all(one.close for one in cameras[begin : begin + AT_ONCE])
        for results in self._subscribed("**"):
            results.end()
        for stream in self._events:
            stream.end(None)
        await self._exchange.leave()
        await self._program.close()
        await self._stack.aclose()

    async def __aenter__(self) -> Self:
        return await self.open()

    async def __aexit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        await self.close()

    def __del__(self) -> None:
        # its bus refers to it until it is closed; so nobody has it when that is gone, too
        if vars(self).get("_state") == "open":
            warnings.warn(f"{self!r} was not closed", ResourceWarning, source=self, stacklevel=2)

    def __repr__(self) -> str:
        return f"<Fleet {self.url}, {len(self)} cameras>"

    # ------------------------------------------------------------------ who is there

    @property
    def url(self) -> str:
        """Its URL; that of one in this process names no host."""
        return "fleet://" if self._address is None else self._address.url

    @property
    def warning(self) -> str:
        """Warning that this program's certificate ends soon, with the cure; empty for none."""
        identity = self._program.bus.identity
        return "" if identity is None else identity.warning

    def cameras(self, pattern: str = "**") -> list[FleetCamera[Any]]:
        """Return the cameras that an agent shares now, by name.

        Raises:
            ConfigurationError: the pattern cannot be one.
        """
        return [self._known(name) for name in self.names(pattern)]

    def names(self, pattern: str = "**") -> list[str]:
        """Return the names of the cameras that an agent shares now.

        Raises:
            ConfigurationError: the pattern cannot be one.
        """
        pattern = check_pattern(pattern)
        there = self._agents.items()
        return sorted(name for name, agents in there if agents and meets(pattern, name))

    def url_of(self, name: str) -> str:
        """Return the URL of a camera, by which :func:`smartcam.connect` has it alone.

        Raises:
            ConfigurationError: the name cannot be one.
        """
        url: str = self._address_of(check_name(name)).url
        return url

    def _known(self, name: str) -> FleetCamera[Any]:
        """Return a camera; of a large fleet it is met now, if it was not before."""
        camera = self._cameras.get(name)
        if camera is None:
            camera = self._meet(name)
        return camera

    def agents(self, pattern: str = "**") -> list[str]:
        """Return the agents that share a camera of a pattern, by name.

        Raises:
            ConfigurationError: the pattern cannot be one.
        """
        pattern = check_pattern(pattern)
        sharing = (agents for name, agents in self._agents.items() if meets(pattern, name))
        return sorted({agent for agents in sharing for agent in agents})

    def __getitem__(self, name: str) -> FleetCamera[Any]:
        """Return a camera, which an agent shares or has shared.

        One that was given up (taken by another client, or lost with ``reconnect=None``) is another
        object once an agent shares it again.

        Raises:
            ConfigurationError: no camera is called so.
        """
        name = check_text(name, "camera", self.url)
        if name not in self._agents:
            there = ", ".join(sorted(self._agents)[:20]) or "none"
            raise ConfigurationError(
                f"the fleet has no camera {name!r}; there are {there}"
                f"{did_you_mean(name, self._agents)}"
            )
        return self._known(name)

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and name in self._agents

    def __iter__(self) -> Iterator[FleetCamera[Any]]:
        return iter(self.cameras())

    def __len__(self) -> int:
        return sum(map(bool, self._agents.values()))

    async def meet(self, pattern: str = "**") -> list[FleetCamera[Any]]:
        """Return the cameras of a pattern once their agents have answered, or were silent.

        A fleet of up to 256 cameras is met when it is opened; in a larger one each camera is met
        when it is first asked for. Its commands wait for that, what is known of it does not.

        Raises:
            ConfigurationError: the pattern cannot be one.
            ConnectionClosedError: the fleet is not open.

        Cancellation: safe; they are met nevertheless.
        """
        cameras = self.cameras(pattern)
        self._require_open()
        meeting = [self._opening[one.name] for one in cameras if one.name in self._opening]
        await self._met(meeting)
        self._require_open()
        return cameras

    async def _met(self, meeting: Iterable[asyncio.Task[None]]) -> None:
        """Wait until cameras were met; who is cancelled leaves that as it is."""
        if left := {*meeting}:
            await asyncio.wait(left)

    async def status(
        self, pattern: str = "**", *, timeout: float = STATUS_TIMEOUT
    ) -> dict[str, CameraSummary]:
        """Return the summary of every camera of a pattern, by name.

        Each agent is asked once and answers from what it knows; no camera is asked anything.
        Cameras whose agent does not answer in time are left out.

        Args:
            pattern: pattern of the cameras' names.
            timeout: seconds for the answers of all agents.

        Raises:
            ConfigurationError: the pattern, or the timeout, cannot work.
            ConnectionClosedError: the fleet is not open.

        Cancellation: safe.
        """
        pattern = check_pattern(pattern)
        timeout = check_seconds(timeout, "timeout", "status")
        self._require_open()
        program = self._program
        told = await ask_cameras(program.bus, program.keys, "*", pattern, timeout)
        best = by_name(told, lambda one: (one.summary.connected, one.summary.agent))
        return {name: best[name].summary for name in sorted(best)}

    async def outlets(self, *, timeout: float = STATUS_TIMEOUT) -> list[ToldOutlet]:
        """Return the accounts of all agents' outlets, by agent and name.

        Args:
            timeout: seconds for the answers of all agents; those that do not answer are left out.

        Raises:
            ConfigurationError: the timeout cannot work.
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
        failed: bool = False,
        most: int = 100,
        timeout: float = STORE_TIMEOUT,
    ) -> list[ToldStore]:
        """Return the answers of agents' stores of results, by agent and outlet.

        Args:
            pattern: pattern of the cameras' names.
            since: time with its zone from which on; None: all that is there.
            failed: whether rows are only errors, gaps, and results that did not pass.
            most: rows of each store at most, the newest of all.
            timeout: seconds for the answers of all agents; those that do not answer are left out.

        Raises:
            ConfigurationError: an argument cannot work.
            ConnectionClosedError: the fleet is not open.

        Cancellation: safe.
        """
        who = "stored_results"
        at = check_instant(since, "since", who)
        request = StoredRequest(
            since=None if at is None else at.astimezone(UTC).isoformat(),
            failed=check_flag(failed, "failed", who),
            camera=check_pattern(pattern),
            most=check_integer(most, "most", 0, MAX_STORED_ROWS, who),
        )
        timeout = check_seconds(timeout, "timeout", who)
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
        """Subscribe to agents and cameras that come and go; those that are there come first."""
        stream = Subscription[FleetEvent]("events", max_queue=max_queue, overflow=overflow)
        if self._state == "closed":
            stream.end(None)
            return stream
        at = datetime.now(UTC)
        for agent in self.agents():
            stream.offer(AgentJoined(self._name, at, agent), 0.0)
        for camera, agents in sorted(self._agents.items()):
            for agent in sorted(agents):
                stream.offer(CameraJoined(self._name, at, agent, camera), 0.0)
        self._events.add(stream)
        return stream

    def _tell(self, kind: type[FleetEvent], *names: str) -> None:
        for stream in self._events:
            stream.offer(kind(self._name, datetime.now(UTC), *names), 0.0)

    @property
    def _name(self) -> str:
        return self._program.keys.fleet

    def _on_agent(self, key: str, present: bool) -> None:
        (agent,) = self._program.keys.tail(key, "presence/agent")
        if present == (agent in self._present):
            return
        if present:
            self._present.add(agent)
            self._tell(AgentJoined, agent)
            return
        for name in sorted(name for name, agents in self._agents.items() if agent in agents):
            self._leave(agent, name)
        self._present.discard(agent)
        self._tell(AgentLeft, agent)

    def _on_camera(self, key: str, present: bool) -> None:
        keys = self._program.keys
        agent, *chunks = keys.tail(key, "presence/camera")
        name = "/".join(chunks)
        sharing = self._agents.setdefault(name, set())
        if present == (agent in sharing):
            return
        if not present:
            self._leave(agent, name)
            return
        self._on_agent(keys.agent(agent), True)  # it comes before its cameras
        sharing.add(agent)
        known = self._cameras.get(name)
        wanted = self._meets or bool(self._subscribed(name))
        if (known is None and wanted) or (known is not None and known.ended):
            self._meet(name)
        self._tell(CameraJoined, agent, name)

    def _leave(self, agent: str, name: str) -> None:
        self._agents[name].discard(agent)
        camera = self._cameras.get(name)
        if camera is not None:
            camera.agent_left(agent)  # it knows before anybody reads the event
        self._tell(CameraLeft, agent, name)

    # ------------------------------------------------------------------ cameras

    def _address_of(self, name: str) -> Any:
        return (self._address or FleetAddress("fleet", "", 0)).of(name)

    def _make(self, name: str) -> FleetCamera[Any]:
        own = {"name": name, "connect_timeout": self._timeout}
        settings = CameraSettings.of(self._address_of(name), {**self._options, **own})
        return FleetCamera[Any](settings, name, self._program, shared=True)

    def _meet(self, name: str) -> FleetCamera[Any]:
        before = self._cameras.get(name)
        camera = self._cameras[name] = self._make(name)
        for results in self._subscribed(name):
            results.add(camera)
        task = asyncio.get_running_loop().create_task(
            self._attend(camera, before), name=f"smartcam.fleet.{name}.open"
        )
        self._opening[name] = task

        def forget(done: asyncio.Task[None]) -> None:
            if self._opening.get(name) is done:
                del self._opening[name]

        task.add_done_callback(forget)
        camera.opening = task
        return camera

    async def _attend(self, camera: FleetCamera[Any], before: FleetCamera[Any] | None) -> None:
        if before is not None:
            await before.close()
        async with self._turn:
            await camera.attend(self._timeout)

    # ------------------------------------------------------------------ over many

    async def trigger(
        self, pattern: str = "**", *, timeout: float = DEFAULT_TRIGGER_TIMEOUT, **options: Any
    ) -> dict[str, Result[Any] | SmartCamError]:
        """Trigger every camera of a pattern at the same time; exactly one outcome for each.

        Args:
            pattern: pattern of the cameras' names.
            timeout: seconds for each.
            **options: as :meth:`smartcam.Camera.trigger` takes them.

        Returns:
            The result (with ``results_per_trigger`` the list of them), or the error, by the
            camera's name.

        Raises:
            ConfigurationError: no camera is meant, or an argument cannot work for any of them.
            ConnectionClosedError: the fleet is not open.

        Cancellation: cancels each; which ones were triggered then is unknown.
        """
        return await self._each(pattern, lambda one: one.trigger(timeout=timeout, **options))

    async def reload(
        self, agent: str | None = None, *, timeout: float = 30.0
    ) -> dict[str, FleetChanges | SmartCamError]:
        """Have agents read their fleet files again: :meth:`smartcam.fleet.FleetServer.reload`.

        Args:
            agent: name of the agent; None for all agents that are there.
            timeout: seconds for the answers.

        Returns:
            What has changed, or the error, by the agent's name. A ``ConfigurationError`` says that
            all stayed as it was at this agent.

        Raises:
            ConfigurationError: there is no such agent.
            ConnectionClosedError: the fleet is not open.

        Cancellation: what the agents have begun goes on.
        """
        timeout = check_seconds(timeout, "timeout", "reload")
        if agent is not None:
            agent = check_text(agent, "agent", "reload")
        self._require_open()
        there = sorted(self._present)
        if agent is not None and agent not in there:
            raise ConfigurationError(
                f"the fleet has no agent {agent!r}; there are {', '.join(there[:20]) or 'none'}"
                f"{did_you_mean(agent, there)}"
            )
        program = self._program
        wanted = there if agent is None else [agent]
        return await reload_agents(program.bus, program.keys, wanted, timeout)

    async def _each(
        self, pattern: str, do: Callable[[FleetCamera[Any]], Coroutine[Any, Any, Any]]
    ) -> dict[str, Any]:
        pattern = check_pattern(pattern)
        self._require_open()
        cameras = await self.meet(pattern)
        if not cameras:
            there = ", ".join(self.names()[:20]) or "none"
            raise ConfigurationError(f"no camera of the fleet is {pattern!r}; there are {there}")

        async def outcome(doing: Coroutine[Any, Any, Any]) -> Any:
            try:
                return await doing
            except SmartCamError as error:
                return error

        doing = {one.name: do(one) for one in cameras}
        try:
            async with asyncio.TaskGroup() as group:
                tasks = {name: group.create_task(outcome(one)) for name, one in doing.items()}
        finally:
            for one in doing.values():
                one.close()  # its task may never have begun
        outcomes = {name: task.result() for name, task in tasks.items()}
        if all(isinstance(one, ConfigurationError) for one in outcomes.values()):
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
        """Subscribe to the results of every camera of a pattern; subscribed when called.

        Args:
            pattern: pattern of the cameras' names.
            min_interval: as :meth:`smartcam.Camera.results` has it; for each camera.
            max_queue: results of each camera that are kept for a slow reader.
            max_queue_bytes: bytes of each camera's results that are kept for a slow reader.
            overflow: action beyond either bound: drop the oldest result, or raise an error.

        Raises:
            ConfigurationError: the pattern, or an argument, cannot work.
        """
        pattern = check_pattern(pattern)
        bounds: dict[str, Any] = {"min_interval": min_interval, "max_queue": max_queue}
        bounds |= {"max_queue_bytes": max_queue_bytes, "overflow": overflow}
        Subscription[Any]("results", **bounds)  # what cannot work is told at once

        def subscribe(camera: FleetCamera[Any]) -> Subscription[Result[Any]]:
            stream: Subscription[Result[Any]] = camera.results(**bounds)
            return stream

        results = FleetResults[Any](subscribe)
        self._results = [one for one in self._results if one[1]() is not None]
        self._results.append((pattern, weakref.ref(results)))
        names = {*self.names(pattern), *(name for name in self._cameras if meets(pattern, name))}
        if len(names) > MAX_CAMERAS_SUBSCRIBED and 2 * len(names) > len(self):
            self._exchange.cover("results")
        for name in names:
            results.add(self._known(name))
        if self._state == "closed":
            results.end()
        return results

    def _subscribed(self, name: str) -> list[FleetResults[Any]]:
        """Return the streams whose pattern has a name in common with a name or pattern."""
        found = [results() for pattern, results in self._results if meets(pattern, name)]
        return [one for one in found if one is not None]
