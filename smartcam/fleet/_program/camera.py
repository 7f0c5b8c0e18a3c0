"""Use a camera that an agent shares."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import math
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from smartcam._arguments import (
    check_seconds,
)
from smartcam._client._inside import Interpretation
from smartcam._forks import cached_property
from smartcam.camera import (
    FRAME_TIMEOUT,
    STREAM_ENCODINGS,
    Camera,
    StreamRequest,
)
from smartcam.exceptions import (
    CommandRejectedError,
    ConfigurationError,
    ConnectFailedError,
    ConnectionClosedError,
    ConnectionLostError,
    LinkError,
    LocalProtocolError,
    NotAllowedError,
    ReservationLostError,
    ResponseTimeoutError,
    SmartCamError,
    TriggerTimeoutError,
)
from smartcam.fleet._bus.errors import from_fields
from smartcam.fleet._bus.wire import grace
from smartcam.fleet._frames.wire import FrameForm
from smartcam.fleet._program.caller import Caller, Lease, Met
from smartcam.fleet._program.program_name import in_words
from smartcam.fleet._program.receiver import FleetListeners, Own, Receiver
from smartcam.models import (
    ApplicationChanged,
    CameraEvent,
    Capabilities,
    Connected,
    Disconnected,
    NoticeReceived,
    Reconnected,
    Result,
    Status,
    StatusChanged,
    ValueT,
)
from smartcam.protocols._inside import Counters
from smartcam.settings import parse_address

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Iterable, Sequence
    from typing import Self

    from smartcam._client._inside import Listeners, TriggerRequest
    from smartcam.camera import FrameRequest, StreamEncoding
    from smartcam.fleet._bus.wire import BusMessage
    from smartcam.fleet._frames.caller import FrameCaller
    from smartcam.fleet._frames.wire import FleetFrame
    from smartcam.fleet._program.program import Program
    from smartcam.frames import FrameReader, FrameSource
    from smartcam.observers import Observer
    from smartcam.settings import Address, CameraSettings

QUESTION_TIMEOUT = 2.0
"""Seconds for the answer to a question; then it is asked again until its deadline."""

REACH_TIMEOUT = 0.5
"""Seconds to wait for the events that the agent sent before a reply, which count as lost if they
come later."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReservationLost(CameraEvent):
    """A program has lost its reservation of the camera before the end of its block.

    Attributes:
        by: the program in words, as in errors: ``robot1 on host7, pid 31``.
    """

    by: str


class FleetCamera(Camera[ValueT]):
    """A camera that an agent of a fleet shares with other programs.

    It is made by :func:`smartcam.connect` with a fleet URL, and by a
    :class:`~smartcam.fleet.Fleet`. The agent carries out commands, each once; results are read
    in this process.

    The link is that to the agent, too: its loss is a :exc:`~smartcam.ConnectionLostError` that
    names it. It is then unknown whether a running call was carried out.

    Args:
        settings: validated options; options of the session with the camera are the agent's.
        camera: name of the camera in the fleet.
        program: program with an end of the bus.
        shared: whether other cameras use that end, too; then it is not closed with this camera.
        observers: observers of the camera.
    """

    def __init__(
        self,
        settings: CameraSettings,
        camera: str,
        program: Program,
        *,
        shared: bool = False,
        observers: Iterable[Observer] = (),
    ) -> None:
        self._agents_layout: Any = None  # layout for results if this program gives none
        self._unreadable: ConfigurationError | None = None  # reason why that layout cannot be used
        self._met = False
        super().__init__(settings, observers=observers)
        self._program, self._shared = program, shared
        self._wire = Counters()
        self._caller = Caller(
            settings.name,
            camera,
            program,
            self._wire,
            self._on_met,
            self._on_lost,
            self._on_lease_lost,
        )
        self._expected = settings.application
        self._switch_in_doubt = False  # a switch was interrupted: either application may be active
        self._receiver = Receiver(
            settings.name,
            camera,
            self._caller,
            self._listeners,
            self._counters,
            lambda: self._default,
            self._on_state,
            lambda: None if self._switch_in_doubt else self._expected,
        )
        self._opened = False
        self.opening: asyncio.Task[None] | None = None  # the fleet that made it waits for its agent
        self._sessions = 0
        self._linked = False  # the agent has a session with the camera
        self._trying = True  # whether the agent's first attempt to connect has not ended
        self._status: Status | None = None
        self._active: int | None = None
        self._about: dict[str, Any] = {}  # facts about the camera from its agent
        self._trouble: LinkError | None = None
        self._closed: LinkError | None = None
        self._watching: set[asyncio.Queue[Status | LinkError]] = set()

    _listeners: FleetListeners

    def _make_listeners(self) -> Listeners:
        return FleetListeners(self.settings.name, self._observers)

    def _interpretation(self, spec: object, *, of_camera: bool = False) -> Interpretation:
        if spec is None:
            spec = self._agents_layout
        if self._met:
            return super()._interpretation(spec, of_camera=of_camera)
        return self._provisional(spec, of_camera)

    def _provisional(self, spec: object, own: bool) -> Interpretation:
        """Return the interpretation of results until the agent's answer.

        Raises:
            ConfigurationError: ``spec`` cannot work with any agent.
        """
        settings = self.settings
        if spec is None and settings.calibration is not None:
            spec = "localizations"
        is_given = "y_down" in settings.given
        refused: ConfigurationError | None = None
        for y_down in [settings.y_down] if is_given else [False, True]:
            try:
                return Interpretation(
                    spec,
                    lenient=settings.lenient,
                    y_down=y_down,
                    calibration=settings.calibration,
                    own=own,
                )
            except ConfigurationError as exc:
                refused = refused or exc
        raise refused or ConfigurationError(f"{self.name}: {spec!r:.80} cannot be read")

    # ------------------------------------------------------------------ life

    def _release_unreferenced(self) -> bool:
        # the bus refers to the camera until it is closed; its own bus is dropped with it
        attributes = vars(self)
        opened = attributes.get("_opened", False) and attributes.get("_closed") is None
        return opened and not attributes.get("_shared", True)

    async def open(self) -> Self:
        if self._opened or self._closed is not None:
            raise LocalProtocolError(f"{self.name}: opened or closed before; make a new one")
        try:
            await self.follow(self.settings.connect_timeout)
            self._check_session()
            if self.settings.application is not None:
                application = self.settings.application
                await self._do("ensure", self.settings.switch_timeout, application=application)
        except BaseException as exc:
            if isinstance(exc, LinkError):
                self._finish(exc)
            await self.close()
            raise
        return self

    async def follow(self, timeout: float, *, session: bool = True) -> None:
        """Start to follow the camera, even if it is not there yet.

        Args:
            timeout: seconds for connecting to the bus, and for an agent's first answer.
            session: whether to wait also for the agent's first attempt of a session.
        """
        self._opened = True
        deadline = self._deadline(timeout)
        if not self._shared:
            try:
                await self._program.open(timeout)
            except ConnectFailedError as exc:
                raise self._not_reached_error(str(exc)) from exc
        self._receiver.open()
        self._caller.open()
        await self._settle(deadline, session=session)
        if self._has_observers:
            self._on_listener_added(self._listeners.results)

    async def _settle(self, deadline: float, *, session: bool) -> None:
        """Wait until the agent has a session with the camera, or has tried in vain; bounded."""

        def settled() -> bool:
            met = self._caller.met is not None
            return self.ended or (met and not (session and self._trying))

        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout_at(deadline):
                await self._stirred_until(settled)

    async def _stirred_until(self, condition: Callable[[], bool]) -> None:
        """Wait until a condition on the agent's messages is true."""
        queue: asyncio.Queue[Status | LinkError] = asyncio.Queue()
        self._watching.add(queue)
        try:
            while not condition():
                await queue.get()
        finally:
            self._watching.discard(queue)

    def _check_session(self) -> None:
        """Raise the reason why there is no session, or no usable one."""
        if self._closed is not None:
            raise self._closed.with_traceback(None)
        if self._unreadable is not None:
            raise self._unreadable
        if not self.connected:
            trouble = self._caller.trouble or self._trouble
            waited = self.settings.connect_timeout
            fleet = self._program.keys.fleet
            why = f"no agent of fleet {fleet} has this camera, or none answered within {waited:g} s"
            raise self._not_reached_error(
                why if trouble is None else str(trouble).removeprefix(f"{self.name}: ")
            ) from trouble

    def _not_reached_error(self, why: str) -> ConnectFailedError:
        address = self.settings.address
        text = f"{self.name}: {self.url}: {why}"
        return ConnectFailedError(text, host=address.host, port=address.port, attempts=(why,))

    async def close(self) -> None:
        self._finish(ConnectionClosedError(f"{self.name}: the connection is closed"))
        try:
            await self._receiver.close()
            await self._caller.close()
        finally:
            if not self._shared:
                await self._program.close()

    def _finish(self, error: LinkError) -> None:
        """End for good: there will be no further session."""
        if self._closed is not None:
            return
        self._closed = error
        wanted = isinstance(error, ConnectionClosedError)
        if self._linked:
            self._linked = False
            self._publish_end("closed by this side" if wanted else str(error), expected=wanted)
        self._counters.end()
        self._fail(error)
        self._listeners.end(None if wanted else error)

    async def _wait_connected(self, timeout: float) -> None:
        deadline = self._deadline(timeout)
        if not (self._opened or self._shared) and self._closed is None:
            raise ConnectionClosedError(f"{self.name}: not connected: open it first")
        loop = asyncio.get_running_loop()
        queue: asyncio.Queue[Status | LinkError] = asyncio.Queue()
        self._watching.add(queue)
        why: object = "none yet"
        try:
            async with asyncio.timeout_at(deadline + grace(timeout)):
                while True:
                    if self._closed is not None:
                        raise self._closed.with_traceback(None)
                    if not self.connected:
                        await queue.get()
                        continue
                    left = max(0.0, deadline - loop.time())
                    try:
                        # by then the agent has restored the state, or gone back
                        await self._do("wait_connected", min(left, QUESTION_TIMEOUT))
                    except ConnectionLostError:
                        continue
                    except ResponseTimeoutError as exc:  # or the message was lost on the way
                        why = exc
                        if left <= QUESTION_TIMEOUT:
                            raise TimeoutError from exc
                    else:
                        return
        except TimeoutError as exc:
            raise ResponseTimeoutError(
                f"{self.name}: no session within {timeout:g} s; the last error: "
                f"{self._trouble or why}",
                waited=timeout,
            ) from exc
        finally:
            self._watching.discard(queue)

    # ------------------------------------------------------------------ hooks

    def _require_session(self) -> Met:
        if self._closed is not None:
            raise self._closed.with_traceback(None)
        if self._unreadable is not None:
            raise self._unreadable
        met = self._caller.require()
        if not self._linked:
            trouble = self._trouble or ConnectionLostError(f"{self.name}: not connected")
            raise trouble.with_traceback(None)
        return met

    def _deadline(self, timeout: float) -> float:
        return asyncio.get_running_loop().time() + check_seconds(timeout, "timeout", self.name)

    def _on_listener_added(self, subscribers: object) -> None:
        if subscribers is not self._listeners.results or self._closed is not None:
            return
        if not self._opened:
            return  # open() does this
        since = self._caller.clock(asyncio.get_running_loop().time())
        for stream in self._listeners.results:
            if stream.since == -math.inf:
                stream.since = since
        for future in self._listeners.unmarked():
            self._listeners.waits_since(future, since)
        self._receiver.want_results(since)

    def _end_of_streams(self) -> tuple[SmartCamError | None] | None:
        if self._closed is None:
            return None
        return (None if isinstance(self._closed, ConnectionClosedError) else self._closed,)

    # ------------------------------------------------------------------ what comes

    def _on_met(self, met: Met) -> None:
        """Take over the camera's state from an agent that has answered."""
        if self._closed is not None:
            return
        hello = met.hello
        self._caller.look_at_leases()
        known = self._about.get("capabilities")  # an agent's camera may have no session yet
        self._about = hello if known is None else {"capabilities": known, **hello}
        self._read_as(hello)
        # later events are newer; the missed ones bring everything in order
        if not self._receiver.misses_states(met):
            self._on_state({"kind": "Hello", **hello})
        self._receiver.meet(met)
        if self._listeners.wants_results:
            self._on_listener_added(self._listeners.results)

    def _read_as(self, hello: dict[str, Any]) -> None:
        """Use the agent's knowledge of the results' contents, unless this program gives its own."""
        settings, layout = self.settings, hello.get("interpret_as")
        if isinstance(layout, dict):
            layout = {int(key): value for key, value in layout.items()}
        offered = {name: bool(hello.get(name)) for name in ("y_down", "lenient")}
        changes: dict[str, Any] = {
            key: on for key, on in offered.items() if key not in settings.given
        }
        self.settings: CameraSettings = replace(settings, **changes)
        self._agents_layout = layout
        self._interpretations.clear()
        self._met, self._unreadable = True, None
        try:
            self._default = self._interpretation(self._default_spec, of_camera=True)
        except ConfigurationError as exc:
            self._unreadable = exc

    def _on_lease_lost(self) -> None:
        """Report that this program has lost its reservation."""
        self._publish_reservation_lost(self._program.name, datetime.now(UTC))

    def _publish_reservation_lost(self, program: str, at: datetime) -> None:
        self._listeners.publish(ReservationLost(camera=self.name, at=at, by=in_words(program)))

    def agent_left(self, agent: str) -> None:
        """End the session of an agent that no longer shares the camera."""
        self._caller.agent_left(agent)

    def _on_lost(self, error: LinkError) -> None:
        """End the session, since the agent is gone."""
        self._receiver.lose()
        self._lose(error, str(error))

    def _lose(self, error: LinkError, reason: str, *, expected: bool = False) -> None:
        self._trouble = error
        self._caller.unlink()
        if not self._linked:
            self._stir(error)
            return
        self._linked = False
        if not expected:
            self._counters.note_loss(error)
            self._observers.error(self.name, error)
        self._publish_end(reason, expected=expected)
        self._fail(error)
        if self.settings.reconnect is None:
            self._finish(error)

    def _publish_end(self, reason: str, *, expected: bool) -> None:
        self._listeners.publish(
            Disconnected(camera=self.name, at=datetime.now(UTC), reason=reason, expected=expected)
        )

    def _fail(self, error: LinkError) -> None:
        """End all waiting calls with the error that ended the session."""
        self._listeners.fail(error)
        self._stir(error)

    def _stir(self, what: Status | LinkError) -> None:
        """Wake the callers that wait for a change."""
        for queue in self._watching:
            queue.put_nowait(what)

    def _on_state(self, state: dict[str, Any]) -> None:
        """Process an event of the camera, with its present state."""
        if self._closed is not None:
            return
        if state["kind"] == "Status" and self._changes_status_only(state):
            self._take_status(_status(state["status"]), state)
            return
        at = _time(state)
        linked = bool(state.get("connected"))
        if state["kind"] == "Removed":
            self._caller.removed(str(state.get("why")))
        elif state["kind"] == "NoticeReceived":
            self._take_notice(state.get("event", {}), at)
        elif state["kind"] == "ReservationLost":
            self._take_reservation_lost(str(state.get("by")), at)
        if self._trying and not state.get("trying"):
            self._stir(self._status or Status(0))
        self._trying = bool(state.get("trying"))
        if not linked:
            error, event = self._trouble_of(state), state.get("event", {})
            self._lose(
                error,
                str(event.get("reason") or error),
                expected=bool(event.get("expected")),
            )
            if state.get("over") and self._closed is None:
                self._counters.note_loss(error)
                self._finish(error)
        elif not self._linked:
            self._begin_session(state, at)
        status, application = state.get("status"), state.get("application")
        if application is not None and application != self._active:
            previous, self._active = self._active, int(application)
            self._listeners.publish(
                ApplicationChanged(
                    camera=self.name, at=at, application=self._active, previous=previous
                )
            )
        if status is not None and linked:
            self._take_status(_status(int(status)), state)

    def _changes_status_only(self, state: dict[str, Any]) -> bool:
        """Return True if an event leaves all but the camera's status as it is known."""
        application = state.get("application")
        return (
            self._linked
            and not self._trying
            and "trying" not in state
            and state.get("connected") is True
            and state.get("status") is not None
            and (application is None or application == self._active)
        )

    def _take_notice(self, fields: dict[str, Any], at: datetime) -> None:
        """Publish a notice from the camera."""
        self._counters.note_notice()
        kind, code, text = (
            str(fields.get("kind")),
            int(fields.get("code", 0)),
            str(fields.get("text")),
        )
        event = NoticeReceived(camera=self.name, at=at, kind=kind, code=code, text=text)
        self._listeners.publish(event)

    def _take_reservation_lost(self, program: str, at: datetime) -> None:
        """Take the agent's report of a lost reservation; this program's may be known already."""
        if program == self._program.name and self._caller.leases:
            self._caller.report_leases_lost()
        else:
            self._publish_reservation_lost(program, at)

    def _trouble_of(self, state: dict[str, Any]) -> LinkError:
        """Return why the agent has no session with the camera."""
        if "error" not in state:
            return ConnectionLostError(f"{self.name}: the agent has no session with the camera yet")
        error = from_fields(state["error"])
        if isinstance(error, LinkError) and not isinstance(error, ConnectFailedError):
            return error
        lost = ConnectionLostError(
            f"{self.name}: the agent has no session with the camera: {error}"
        )
        lost.__cause__ = error
        return lost

    def _begin_session(self, state: dict[str, Any], at: datetime) -> None:
        self._linked, self._trouble = True, None
        self._caller.linked = True
        self._about |= state.get("about", {})
        self._counters.begin(self._wire if not self._sessions else Counters())
        self._sessions += 1
        event = Connected if self._sessions == 1 else Reconnected
        self._listeners.publish(event(camera=self.name, at=at, url=self.url))
        self._stir(self._status or Status(0))

    def _take_status(self, status: Status, state: dict[str, Any]) -> None:
        listeners, previous = self._listeners, self._status
        self._status = status
        if state["kind"] == "Status":
            if listeners.wants_statuses:
                listeners.offer_status(status, asyncio.get_running_loop().time())
        elif status == previous:
            return
        if status != previous and listeners.wants_events:
            listeners.publish(
                StatusChanged(camera=self.name, at=_time(state), status=status, previous=previous)
            )
        if self._watching:
            self._stir(status)

    # ------------------------------------------------------------------ what is known

    @property
    def url(self) -> str:
        return self.settings.address.url

    @property
    def _place(self) -> Address:
        url = self._about.get("url")
        return self.settings.address if url is None else parse_address(url)

    @property
    def ended(self) -> bool:
        """True if there will be no further session: closed, taken, or given up."""
        return self._closed is not None

    @property
    def met(self) -> bool:
        """True if the camera's agent has answered, and is present."""
        return self._caller.met is not None

    @property
    def connected(self) -> bool:
        return self._linked and self._caller.met is not None

    @property
    def status(self) -> Status:
        if self._status is None:
            unopened = ConnectionClosedError(f"{self.name}: not connected: open it first")
            raise (self._closed or unopened).with_traceback(None)
        return self._status

    @property
    def active_application(self) -> int | None:
        return self._active

    @property
    def protocol_version(self) -> int | None:
        return self._about.get("protocol_version")

    @property
    def endian(self) -> int:
        """Byte order in the camera's status at the first answer of its agent."""
        return int(self._about.get("endian", 0))

    @property
    def capabilities(self) -> Capabilities:
        flags = self._about.get("capabilities")
        if flags is None:
            raise ConnectionClosedError(f"{self.name}: not connected: open it first")
        known = Capabilities.__dataclass_fields__
        return Capabilities(**{key: value for key, value in flags.items() if key in known})

    # ------------------------------------------------------------------ calls

    async def _do(
        self,
        do: str,
        timeout: float | None,
        blobs: Sequence[bytes] = (),
        call: int | None = None,
        **arguments: Any,
    ) -> BusMessage:
        """Make a call at the agent; first process the events that it sent before its reply."""
        limit = self._limit(timeout, self.settings.request_timeout)
        deadline = self._deadline(limit)
        await self._met_first(deadline)
        self._require_session()
        reply = await self._caller.call(do, deadline, arguments, blobs, call, limit)
        states, results = reply.fields.get("states"), reply.fields.get("results")
        if isinstance(states, int) and isinstance(results, int):
            await self._reach(states, results, deadline)
        return reply

    async def _met_first(self, deadline: float) -> None:
        """Wait for an agent that has not answered yet; bounded."""
        opening = self.opening
        if opening is not None:
            await asyncio.wait({opening}, timeout=deadline - asyncio.get_running_loop().time())
            if opening.done():
                self.opening = None

    async def _reach(self, states: int, results: int, deadline: float) -> None:
        """Wait for the messages that the agent sent before its reply."""
        if not self._receiver.has(states, results):
            soon = min(deadline, asyncio.get_running_loop().time() + REACH_TIMEOUT)
            await self._receiver.reach("states", states, soon)
            await self._receiver.reach("results", results, soon)

    async def _trigger(
        self, application: int | None, request: TriggerRequest, timeout: float
    ) -> list[Result]:
        if self._switch_in_doubt:
            timeout = await self._settle_switch(timeout)
        expected = application if application is not None else self._expected
        deadline = asyncio.get_running_loop().time() + timeout
        if self.opening is not None:
            await self._met_first(deadline)
        self._require_session()
        receiver, number = self._receiver, self._program.next_call()
        own_call = receiver.own_calls[number] = Own(request.interpretation, expected)
        try:
            reply = await self._caller.trigger(
                request, application, expected, number, deadline, timeout
            )
            receiver.take_states(reply)
            if not receiver.has(reply.states, reply.batch.following):
                await self._reach(reply.states, reply.batch.following, deadline)
            return receiver.outcomes(own_call, reply.batch)
        finally:
            del receiver.own_calls[number]

    async def _switch_application(self, application: int | str, timeout: float) -> None:
        self._require_session()
        self._switch_in_doubt = self._expected is not None
        try:
            reply = await self._do("switch_application", timeout, application=application)
        except (CommandRejectedError, NotAllowedError, ReservationLostError):
            self._switch_in_doubt = False
            raise
        self._expected, self._switch_in_doubt = reply.fields["answer"]["application"], False

    async def _settle_switch(self, timeout: float) -> float:
        """Ask for the active application, whose results are expected then.

        Returns:
            The seconds that are left for a trigger.
        """
        loop = asyncio.get_running_loop()
        begun = loop.time()
        try:
            self._expected = await self.query_application(timeout=timeout)
        except ResponseTimeoutError as exc:
            raise TriggerTimeoutError(f"{exc}; no trigger was sent", waited=exc.waited) from exc
        self._switch_in_doubt = False
        return max(0.0, timeout - (loop.time() - begun))

    @contextlib.asynccontextmanager
    async def _in_application(self, application: int) -> AsyncGenerator[Self]:
        limit = self.settings.switch_timeout
        number = self._program.next_call()
        await self._do("enter", limit, call=number, application=application)
        before, self._expected = self._expected, application
        try:
            yield self
        except BaseException:
            self._expected = before
            self._caller.notify("leave", {"entered": number, "wait": False})
            raise
        self._expected = before
        if self.connected:
            await self._do("leave", limit, entered=number)
        else:  # the next session restores the application first
            self._caller.notify("leave", {"entered": number, "wait": False})

    @contextlib.asynccontextmanager
    async def _reserved(self, timeout: float) -> AsyncGenerator[Self]:
        number, leases = self._program.next_call(), self._caller.leases
        try:
            reply = await self._do("reserve", timeout, call=number)
            leases[number] = Lease(int(reply.fields["epoch"]))
            yield self
            await self._check_kept(number)
        finally:
            leases.pop(number, None)
            self._caller.notify("release", {"reservation": number})

    async def _check_kept(self, reservation: int) -> None:
        """Check with the agent that a reservation has not ended; bounded.

        Raises:
            ReservationLostError: the reservation has ended, or this is unknown.
        """
        caller = self._caller
        deadline = self._deadline(self.settings.request_timeout)
        arguments = {"reservation": reservation}
        while True:
            caller.lease(reservation)
            soon = min(deadline, self._deadline(QUESTION_TIMEOUT))
            try:
                reply = await caller.call("reserved", soon, arguments)
            except ResponseTimeoutError as exc:
                why: SmartCamError = exc
                if soon < deadline:
                    continue  # the message was lost on the way
            except SmartCamError as exc:
                why = exc
            else:
                if reply.fields["answer"].get("reserved") is not True:
                    caller.lose_lease(reservation, "its agent reported it")
                caller.lease(reservation)
                return
            raise ReservationLostError(
                f"{self.name}: whether the camera was reserved until the end of the block is "
                f"unknown: {why}"
            ) from why

    async def _start(self, timeout: float) -> None:
        await self._do("start", timeout)

    async def _stop(self, timeout: float) -> None:
        await self._do("stop", timeout)

    async def _query_application(self, timeout: float) -> int:
        return int((await self._do("query_application", timeout)).fields["answer"]["application"])

    async def _query_status(self, timeout: float) -> Status:
        return await self._status_of("query_status", timeout)

    async def _reset_errors(self, timeout: float) -> Status:
        return await self._status_of("reset_errors", timeout)

    async def _wait_ready(self, timeout: float) -> Status:
        return await self._status_of("wait_ready", timeout)

    async def _status_of(self, do: str, timeout: float) -> Status:
        return Status(int((await self._do(do, timeout)).fields["answer"]["status"]))

    async def _wait_status(self, predicate: Callable[[Status], bool], timeout: float) -> Status:
        deadline = self._deadline(timeout)
        self._require_session()
        queue: asyncio.Queue[Status | LinkError] = asyncio.Queue()
        self._watching.add(queue)
        try:
            present = self.status
            reply = await self._do("refresh", timeout)
            if reply.fields["answer"]["asked"]:  # an earlier status is not the current one
                present = self.status
                while not queue.empty():
                    status = queue.get_nowait()
                    if isinstance(status, LinkError):
                        raise status.with_traceback(None)
            if predicate(present):
                return present
            async with asyncio.timeout_at(deadline):
                while True:
                    status = await queue.get()
                    if isinstance(status, LinkError):
                        raise status.with_traceback(None)
                    if predicate(status):
                        return status
        except TimeoutError as exc:
            if isinstance(exc, SmartCamError):
                raise
            raise ResponseTimeoutError(
                f"{self.name}: waited {timeout:g} s for the status wanted; status: {self.status}",
                waited=timeout,
            ) from exc
        finally:
            self._watching.discard(queue)

    async def _read_image(self, timeout: float) -> bytes:
        return (await self._do("read_image", timeout)).blobs[0]

    @cached_property
    def frame_caller(self) -> FrameCaller:
        """Caller that asks the camera's agent for frames."""
        from smartcam.fleet._frames.caller import FrameCaller

        return FrameCaller(self.name, self._caller)

    @contextlib.asynccontextmanager
    async def _frames(self, wanted: StreamRequest) -> AsyncGenerator[FrameReader]:
        source = self._frame_source(wanted)
        async with source, source.reader() as reader:
            yield reader

    @property
    def has_frames(self) -> bool:
        """True if the agent reported that the camera has frames."""
        return bool(self._about.get("frames"))

    def frame_source(
        self, encoding: StreamEncoding = "raw", quality: int | None = None
    ) -> FrameSource:
        """Return the source that :meth:`frames` reads, for several readers; not opened yet."""
        form = self._check_form(encoding, quality, STREAM_ENCODINGS)
        return self._frame_source(
            StreamRequest(*form, bitrate=None, latency=None, decode=True, timeout=FRAME_TIMEOUT)
        )

    def _frame_source(self, wanted: StreamRequest) -> FrameSource:
        from smartcam.fleet._frames.shared_driver import SharedFrameDriver
        from smartcam.fleet._frames.stream_form import StreamForm
        from smartcam.frames import FrameAddress, FrameSource

        request = StreamForm.checked(*wanted[:4], self.name, decode=wanted.decode)
        driver = SharedFrameDriver(FrameAddress.parse(self.url), self.frame_caller, request)
        return FrameSource(driver, timeout=wanted.timeout, stall=None)

    async def _newest_frame(self, max_age: float, form: FrameRequest, timeout: float) -> FleetFrame:
        wanted = FrameForm.checked(*form, self.name)
        age = None if math.isinf(max_age) else max_age
        return await self.frame_caller.frame(wanted, timeout, max_age=age)

    async def _frame_after(
        self, moment: float | None, form: FrameRequest, timeout: float
    ) -> FleetFrame:
        wanted = FrameForm.checked(*form, self.name)
        if moment is None:
            return await self.frame_caller.frame(wanted, timeout, fresh=True)
        return await self.frame_caller.frame(wanted, timeout, moment=moment)

    async def _get_clock(self, timeout: float) -> datetime:
        reply = await self._do("get_clock", timeout)
        return datetime.fromisoformat(reply.fields["answer"]["clock"])

    async def _set_clock(self, when: datetime) -> None:
        await self._do("set_clock", None, when=when.isoformat())

    async def _set_input(self, data: bytes) -> None:
        await self._do("set_input", None, [data])

    async def _set_sequence_number(self, number: int) -> None:
        await self._do("set_sequence_number", None, number=number)

    async def reboot(self) -> None:
        await self._do("reboot", None)
        # the source learns that the session is over
        with contextlib.suppress(TimeoutError, LinkError):
            async with asyncio.timeout(REACH_TIMEOUT):
                await self._stirred_until(lambda: not self.connected)

    async def _take_back(self, timeout: float) -> None:
        deadline = self._deadline(timeout)
        await self._met_first(deadline)
        if self._closed is not None:
            raise self._closed.with_traceback(None)
        reply = await self._caller.call("take_back", deadline, timeout=timeout)
        fields = reply.fields
        await self._reach(int(fields["states"]), int(fields["results"]), deadline)

    async def _request(
        self, message_id: int | str, payload: bytes, answered: bool | None, timeout: float
    ) -> bytes | None:
        arguments: dict[str, Any] = {"message_id": message_id, "answered": answered}
        reply = await self._do("request", timeout, [payload], **arguments)
        return reply.blobs[0] if reply.blobs else None


_status = functools.lru_cache(maxsize=256)(Status)
"""Return the status with given bits; a new object costs more than a look at the last ones."""


def _time(state: dict[str, Any]) -> datetime:
    if "event" not in state:
        return datetime.now(UTC)
    try:
        return datetime.fromisoformat(state["event"]["at"])
    except (KeyError, TypeError, ValueError):
        return datetime.now(UTC)
