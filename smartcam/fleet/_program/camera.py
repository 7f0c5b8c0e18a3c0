"""Define the camera object with which a program uses a camera that an agent shares."""

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
from smartcam.fleet._bus.wire import reply_grace
from smartcam.fleet._frames.wire import FrameForm
from smartcam.fleet._program.caller import Caller, CameraAgent, Lease
from smartcam.fleet._program.program_name import in_words
from smartcam.fleet._program.receiver import FleetListeners, OwnTrigger, Receiver
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
    from smartcam.fleet._frames.caller import FrameClient
    from smartcam.fleet._frames.wire import FleetFrame
    from smartcam.fleet._program.program import Program
    from smartcam.frames import FrameReader, FrameSource
    from smartcam.observers import Observer
    from smartcam.settings import Address, CameraSettings

QUESTION_TIMEOUT = 2.0
"""Seconds for the answer to a question; after that, the question is sent again, until its
deadline."""

CATCH_UP_TIMEOUT = 0.5
"""Seconds to wait for events that the agent sent before a reply, or before a reboot ended the
session. Events that have not arrived by then count as lost."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReservationLost(CameraEvent):
    """A program has lost its reservation of the camera before its block has ended.

    Attributes:
        program: the program that had the reservation, such as ``robot1 on host7, pid 31``.
    """

    program: str


class FleetCamera(Camera[ValueT]):
    """A camera that an agent of a fleet shares with other programs.

    :func:`smartcam.connect` makes it for a fleet URL, and a :class:`~smartcam.fleet.Fleet` for each
    camera. The agent carries out each command once; this process interprets the results.

    If the agent or the link to it is lost, running calls raise a
    :exc:`~smartcam.ConnectionLostError` that names the agent. It is then unknown whether these
    calls were carried out.

    Args:
        settings: validated options; the agent's file has the options of the camera's session.
        camera: name of the camera in the fleet.
        program: program with a connection to the bus.
        shared: whether other cameras use this program, too; then this camera does not close it.
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
        self._layout_error: ConfigurationError | None = None  # why that layout cannot be used
        self._has_agent_options = False
        super().__init__(settings, observers=observers)
        self._program, self._shared = program, shared
        self._wire = Counters()
        self._caller = Caller(
            settings.name,
            camera,
            program,
            self._wire,
            self._on_agent_found,
            self._on_lost,
            self._on_lease_lost,
        )
        self._expected_application = settings.application
        self._is_switch_uncertain = False  # an interrupted switch: either application may be active
        self._receiver = Receiver(
            settings.name,
            camera,
            self._caller,
            self._listeners,
            self._counters,
            lambda: self._default,
            self._on_state,
            lambda: None if self._is_switch_uncertain else self._expected_application,
        )
        self._opened = False
        self.opening_task: asyncio.Task[None] | None = None  # waits for the agent's first answer
        self._sessions = 0
        self._has_session = False  # the agent has a session with the camera
        self._first_attempt_pending = True  # until the agent's first attempt to connect has ended
        self._status: Status | None = None
        self._active_application: int | None = None
        self._agent_facts: dict[str, Any] = {}  # facts about the camera from its agent
        self._no_session_error: LinkError | None = None
        self._closed: LinkError | None = None
        self._change_queues: set[asyncio.Queue[Status | LinkError]] = set()

    _listeners: FleetListeners

    def _make_listeners(self) -> Listeners:
        return FleetListeners(self.settings.name, self._observers)

    def _interpretation(self, spec: object, *, of_camera: bool = False) -> Interpretation:
        if spec is None:
            spec = self._agents_layout
        if self._has_agent_options:
            return super()._interpretation(spec, of_camera=of_camera)
        return self._provisional_interpretation(spec, of_camera)

    def _provisional_interpretation(self, spec: object, strict_calibration: bool) -> Interpretation:
        """Return the interpretation of results that applies until the agent has answered.

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
                    strict_calibration=strict_calibration,
                )
            except ConfigurationError as exc:
                refused = refused or exc
        raise refused or ConfigurationError(f"{self.name}: {spec!r:.80} cannot be read")

    # ------------------------------------------------------------------ open and close

    def _release_unreferenced(self) -> bool:
        # True: close it; a shared bus refers to the camera until the camera is closed
        attributes = vars(self)
        opened = attributes.get("_opened", False) and attributes.get("_closed") is None
        return opened and not attributes.get("_shared", True)

    async def open(self) -> Self:
        if self._opened or self._closed is not None:
            raise LocalProtocolError(f"{self.name}: opened or closed before; make a new one")
        try:
            await self.connect_to_agent(self.settings.connect_timeout)
            self._check_session()
            if self.settings.application is not None:
                application = self.settings.application
                await self._call_agent(
                    "ensure_application", self.settings.switch_timeout, application=application
                )
        except BaseException as exc:
            if isinstance(exc, LinkError):
                self._end_for_good(exc)
            await self.close()
            raise
        return self

    async def connect_to_agent(self, timeout: float, *, wait_for_session: bool = True) -> None:
        """Subscribe to the camera's messages, even if no agent shares it yet.

        Args:
            timeout: seconds for connecting to the bus, and for an agent's first answer.
            wait_for_session: whether to wait also for the agent's first attempt of a session.
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
        await self._wait_first_session(deadline, wait_for_session=wait_for_session)
        if self._has_observers:
            self._on_listener_added(self._listeners.results)

    async def _wait_first_session(self, deadline: float, *, wait_for_session: bool) -> None:
        """Wait for the agent's answer and its first attempt of a session; bounded."""

        def is_decided() -> bool:
            agent = self._caller.agent is not None
            return self.ended or (agent and not (wait_for_session and self._first_attempt_pending))

        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout_at(deadline):
                await self._wait_until(is_decided)

    async def _wait_until(self, condition: Callable[[], bool]) -> None:
        """Wait until a condition on the agent's messages is true."""
        queue: asyncio.Queue[Status | LinkError] = asyncio.Queue()
        self._change_queues.add(queue)
        try:
            while not condition():
                await queue.get()
        finally:
            self._change_queues.discard(queue)

    def _check_session(self) -> None:
        """Raise the error that tells why there is no session, or why it cannot be used."""
        if self._closed is not None:
            raise self._closed.with_traceback(None)
        if self._layout_error is not None:
            raise self._layout_error
        if not self.connected:
            trouble = self._caller.no_agent_error or self._no_session_error
            waited = self.settings.connect_timeout
            fleet = self._program.keys.fleet
            lacking = f"no agent of fleet {fleet} has this camera, or none answered within"
            reason = f"{lacking} {waited:g} s"
            raise self._not_reached_error(
                reason if trouble is None else str(trouble).removeprefix(f"{self.name}: ")
            ) from trouble

    def _not_reached_error(self, reason: str) -> ConnectFailedError:
        address = self.settings.address
        text = f"{self.name}: {self.url}: {reason}"
        return ConnectFailedError(text, host=address.host, port=address.port, attempts=(reason,))

    async def close(self) -> None:
        self._end_for_good(ConnectionClosedError(f"{self.name}: the connection is closed"))
        try:
            await self._receiver.close()
            await self._caller.close()
        finally:
            if not self._shared:
                await self._program.close()

    def _end_for_good(self, error: LinkError) -> None:
        """End the camera's use with this error: there will be no further session."""
        if self._closed is not None:
            return
        self._closed = error
        wanted = isinstance(error, ConnectionClosedError)
        if self._has_session:
            self._has_session = False
            self._publish_end("closed by this side" if wanted else str(error), expected=wanted)
        self._counters.end_session()
        self._fail(error)
        self._listeners.end(None if wanted else error)

    async def _wait_connected(self, timeout: float) -> None:
        deadline = self._deadline(timeout)
        if not (self._opened or self._shared) and self._closed is None:
            raise ConnectionClosedError(f"{self.name}: not connected: open it first")
        loop = asyncio.get_running_loop()
        queue: asyncio.Queue[Status | LinkError] = asyncio.Queue()
        self._change_queues.add(queue)
        reason: object = "none yet"
        try:
            async with asyncio.timeout_at(deadline + reply_grace(timeout)):
                while True:
                    if self._closed is not None:
                        raise self._closed.with_traceback(None)
                    if not self.connected:
                        await queue.get()
                        continue
                    left = max(0.0, deadline - loop.time())
                    try:
                        # the agent answers after it has restored the camera's state
                        await self._call_agent("wait_connected", min(left, QUESTION_TIMEOUT))
                    except ConnectionLostError:
                        continue
                    except ResponseTimeoutError as exc:  # or the message was lost on the way
                        reason = exc
                        if left <= QUESTION_TIMEOUT:
                            raise TimeoutError from exc
                    else:
                        return
        except TimeoutError as exc:
            raise ResponseTimeoutError(
                f"{self.name}: no session within {timeout:g} s; the last error: "
                f"{self._no_session_error or reason}",
                waited=timeout,
            ) from exc
        finally:
            self._change_queues.discard(queue)

    # ------------------------------------------------------------------ hooks

    def _require_session(self) -> CameraAgent:
        if self._closed is not None:
            raise self._closed.with_traceback(None)
        if self._layout_error is not None:
            raise self._layout_error
        agent = self._caller.require()
        if not self._has_session:
            trouble = self._no_session_error or ConnectionLostError(f"{self.name}: not connected")
            raise trouble.with_traceback(None)
        return agent

    def _deadline(self, timeout: float) -> float:
        return asyncio.get_running_loop().time() + check_seconds(timeout, "timeout", self.name)

    def _on_listener_added(self, subscribers: object) -> None:
        if subscribers is not self._listeners.results or self._closed is not None:
            return
        if not self._opened:
            return  # open() does this
        since = self._caller.earliest_agent_time(asyncio.get_running_loop().time())
        for stream in self._listeners.results:
            if stream.since == -math.inf:
                stream.since = since
        for future in self._listeners.waits_without_start():
            self._listeners.set_wait_start(future, since)
        self._receiver.subscribe_results(since)

    def _end_of_streams(self) -> tuple[SmartCamError | None] | None:
        # None: not ended; (None,): closed by this program; (error,): ended by the error
        if self._closed is None:
            return None
        return (None if isinstance(self._closed, ConnectionClosedError) else self._closed,)

    # ------------------------------------------------------------------ messages of the agent

    def _on_agent_found(self, agent: CameraAgent) -> None:
        """Take over the camera's state from an agent that has answered."""
        if self._closed is not None:
            return
        hello = agent.hello
        self._caller.check_leases()
        known = self._agent_facts.get("capabilities")  # an agent's camera may have no session yet
        self._agent_facts = hello if known is None else {"capabilities": known, **hello}
        self._use_agents_layout(hello)
        # missed events are requested, and bring the state in their order
        if not self._receiver.misses_states(agent):
            self._on_state({"kind": "Hello", **hello})
        self._receiver.begin_agent(agent)
        if self._listeners.wants_results:
            self._on_listener_added(self._listeners.results)

    def _use_agents_layout(self, hello: dict[str, Any]) -> None:
        """Use the agent's options for results, except for those that this program gives."""
        settings, layout = self.settings, hello.get("interpret_as")
        if isinstance(layout, dict):
            layout = {int(key): value for key, value in layout.items()}
        agents_flags = {name: bool(hello.get(name)) for name in ("y_down", "lenient")}
        changes: dict[str, Any] = {
            key: on for key, on in agents_flags.items() if key not in settings.given
        }
        self.settings: CameraSettings = replace(settings, **changes)
        self._agents_layout = layout
        self._interpretations.clear()
        self._has_agent_options, self._layout_error = True, None
        try:
            self._default = self._interpretation(self._default_spec, of_camera=True)
        except ConfigurationError as exc:
            self._layout_error = exc

    def _on_lease_lost(self) -> None:
        """Report that this program has lost its reservation."""
        self._publish_reservation_lost(self._program.name, datetime.now(UTC))

    def _publish_reservation_lost(self, program: str, at: datetime) -> None:
        self._listeners.publish(ReservationLost(camera=self.name, at=at, program=in_words(program)))

    def agent_left(self, agent: str) -> None:
        """End the session of an agent that no longer shares the camera."""
        self._caller.agent_left(agent)

    def _on_lost(self, error: LinkError) -> None:
        """End the session, since the agent is gone."""
        self._receiver.lose_agent()
        self._lose(error, str(error))

    def _lose(self, error: LinkError, reason: str, *, expected: bool = False) -> None:
        self._no_session_error = error
        self._caller.note_session_end()
        if not self._has_session:
            self._wake_waits(error)
            return
        self._has_session = False
        if not expected:
            self._counters.note_loss(error)
            self._observers.error(self.name, error)
        self._publish_end(reason, expected=expected)
        self._fail(error)
        if self.settings.reconnect is None:
            self._end_for_good(error)

    def _publish_end(self, reason: str, *, expected: bool) -> None:
        self._listeners.publish(
            Disconnected(camera=self.name, at=datetime.now(UTC), reason=reason, expected=expected)
        )

    def _fail(self, error: LinkError) -> None:
        """End all waiting calls with the error that ended the session."""
        self._listeners.fail(error)
        self._wake_waits(error)

    def _wake_waits(self, what: Status | LinkError) -> None:
        """Wake the callers that wait for a change."""
        for queue in self._change_queues:
            queue.put_nowait(what)

    def _on_state(self, state: dict[str, Any]) -> None:
        """Process an event of the camera, with the camera's state after it."""
        if self._closed is not None:
            return
        if state["kind"] == "Status" and self._is_status_change_only(state):
            self._take_status(_status_of_bits(state["status"]), state)
            return
        at = _time_of(state)
        linked = bool(state.get("connected"))
        if state["kind"] == "Removed":
            self._caller.note_removal(str(state.get("reason")))
        elif state["kind"] == "NoticeReceived":
            self._publish_notice(state.get("event", {}), at)
        elif state["kind"] == "ReservationLost":
            self._report_reservation_lost(str(state.get("program")), at)
        if self._first_attempt_pending and not state.get("trying"):
            self._wake_waits(self._status or Status(0))
        self._first_attempt_pending = bool(state.get("trying"))
        if not linked:
            error, event = self._read_session_error(state), state.get("event", {})
            self._lose(
                error,
                str(event.get("reason") or error),
                expected=bool(event.get("expected")),
            )
            if state.get("over") and self._closed is None:
                self._counters.note_loss(error)
                self._end_for_good(error)
        elif not self._has_session:
            self._begin_session(state, at)
        status, application = state.get("status"), state.get("application")
        if application is not None and application != self._active_application:
            previous, self._active_application = self._active_application, int(application)
            self._listeners.publish(
                ApplicationChanged(
                    camera=self.name, at=at, application=self._active_application, previous=previous
                )
            )
        if status is not None and linked:
            self._take_status(_status_of_bits(int(status)), state)

    def _is_status_change_only(self, state: dict[str, Any]) -> bool:
        """Return True if an event changes nothing but the camera's status."""
        application = state.get("application")
        return (
            self._has_session
            and not self._first_attempt_pending
            and "trying" not in state
            and state.get("connected") is True
            and state.get("status") is not None
            and (application is None or application == self._active_application)
        )

    def _publish_notice(self, fields: dict[str, Any], at: datetime) -> None:
        """Publish a notice from the camera."""
        self._counters.note_notice()
        kind, code, text = (
            str(fields.get("kind")),
            int(fields.get("code", 0)),
            str(fields.get("text")),
        )
        event = NoticeReceived(camera=self.name, at=at, kind=kind, code=code, text=text)
        self._listeners.publish(event)

    def _report_reservation_lost(self, program: str, at: datetime) -> None:
        """Publish the agent's report of a lost reservation; of one's own, publish it only once."""
        if program == self._program.name and self._caller.leases:
            self._caller.report_leases_lost()
        else:
            self._publish_reservation_lost(program, at)

    def _read_session_error(self, state: dict[str, Any]) -> LinkError:
        """Return the error that says why the agent has no session with the camera."""
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
        self._has_session, self._no_session_error = True, None
        self._caller.has_session = True
        self._agent_facts |= state.get("about", {})
        self._counters.begin_session(self._wire if not self._sessions else Counters())
        self._sessions += 1
        event = Connected if self._sessions == 1 else Reconnected
        self._listeners.publish(event(camera=self.name, at=at, url=self.url))
        self._wake_waits(self._status or Status(0))

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
                StatusChanged(
                    camera=self.name, at=_time_of(state), status=status, previous=previous
                )
            )
        if self._change_queues:
            self._wake_waits(status)

    # ------------------------------------------------------------------ the camera's state

    @property
    def url(self) -> str:
        return self.settings.address.url

    @property
    def _camera_address(self) -> Address:
        url = self._agent_facts.get("url")
        return self.settings.address if url is None else parse_address(url)

    @property
    def ended(self) -> bool:
        """True if no further session follows: closed, taken by another client, or given up."""
        return self._closed is not None

    @property
    def has_agent(self) -> bool:
        """True if the camera's agent has answered, and is present."""
        return self._caller.agent is not None

    @property
    def connected(self) -> bool:
        return self._has_session and self._caller.agent is not None

    @property
    def status(self) -> Status:
        if self._status is None:
            unopened = ConnectionClosedError(f"{self.name}: not connected: open it first")
            raise (self._closed or unopened).with_traceback(None)
        return self._status

    @property
    def active_application(self) -> int | None:
        return self._active_application

    @property
    def protocol_version(self) -> int | None:
        return self._agent_facts.get("protocol_version")

    @property
    def endian(self) -> int:
        """Byte order in the camera's status at the first answer of its agent."""
        return int(self._agent_facts.get("endian", 0))

    @property
    def capabilities(self) -> Capabilities:
        flags = self._agent_facts.get("capabilities")
        if flags is None:
            raise ConnectionClosedError(f"{self.name}: not connected: open it first")
        known = Capabilities.__dataclass_fields__
        return Capabilities(**{key: value for key, value in flags.items() if key in known})

    # ------------------------------------------------------------------ calls

    async def _call_agent(
        self,
        do: str,
        timeout: float | None,
        blobs: Sequence[bytes] = (),
        call: int | None = None,
        **arguments: Any,
    ) -> BusMessage:
        """Make a call at the agent; process the events that it sent before its reply."""
        limit = self._limit(timeout, self.settings.request_timeout)
        deadline = self._deadline(limit)
        await self._wait_opening(deadline)
        self._require_session()
        reply = await self._caller.call(do, deadline, arguments, blobs, call, limit)
        states, results = reply.fields.get("states"), reply.fields.get("results")
        if isinstance(states, int) and isinstance(results, int):
            await self._wait_received(states, results, deadline)
        return reply

    async def _wait_opening(self, deadline: float) -> None:
        """Wait until the fleet has opened this camera; bounded."""
        task = self.opening_task
        if task is not None:
            await asyncio.wait({task}, timeout=deadline - asyncio.get_running_loop().time())
            if task.done():
                self.opening_task = None

    async def _wait_received(self, states: int, results: int, deadline: float) -> None:
        """Wait for the messages that the agent sent before its reply."""
        if not self._receiver.has_received(states, results):
            wait_until = min(deadline, asyncio.get_running_loop().time() + CATCH_UP_TIMEOUT)
            await self._receiver.wait_received("states", states, wait_until)
            await self._receiver.wait_received("results", results, wait_until)

    async def _trigger(
        self, application: int | None, request: TriggerRequest, timeout: float
    ) -> list[Result]:
        if self._is_switch_uncertain:
            timeout = await self._query_expected_application(timeout)
        expected = application if application is not None else self._expected_application
        deadline = asyncio.get_running_loop().time() + timeout
        if self.opening_task is not None:
            await self._wait_opening(deadline)
        self._require_session()
        receiver, number = self._receiver, self._program.next_call()
        own_trigger = receiver.own_triggers[number] = OwnTrigger(request.interpretation, expected)
        try:
            reply = await self._caller.trigger(
                request, application, expected, number, deadline, timeout
            )
            receiver.take_states(reply)
            if not receiver.has_received(reply.next_state, reply.results.next_number):
                await self._wait_received(reply.next_state, reply.results.next_number, deadline)
            return receiver.trigger_results(own_trigger, reply.results)
        finally:
            del receiver.own_triggers[number]

    async def _switch_application(self, application: int | str, timeout: float) -> None:
        self._require_session()
        self._is_switch_uncertain = self._expected_application is not None
        try:
            reply = await self._call_agent("switch_application", timeout, application=application)
        except (CommandRejectedError, NotAllowedError, ReservationLostError):
            self._is_switch_uncertain = False
            raise
        self._expected_application, self._is_switch_uncertain = (
            reply.fields["answer"]["application"],
            False,
        )

    async def _query_expected_application(self, timeout: float) -> float:
        """Query the active application, and expect its results from now on.

        Returns:
            Seconds of the timeout that are left for a trigger.
        """
        loop = asyncio.get_running_loop()
        started_at = loop.time()
        try:
            self._expected_application = await self.query_application(timeout=timeout)
        except ResponseTimeoutError as exc:
            raise TriggerTimeoutError(f"{exc}; no trigger was sent", waited=exc.waited) from exc
        self._is_switch_uncertain = False
        return max(0.0, timeout - (loop.time() - started_at))

    @contextlib.asynccontextmanager
    async def _in_application(self, application: int) -> AsyncGenerator[Self]:
        limit = self.settings.switch_timeout
        number = self._program.next_call()
        await self._call_agent("enter_application", limit, call=number, application=application)
        before, self._expected_application = self._expected_application, application
        try:
            yield self
        except BaseException:
            self._expected_application = before
            self._caller.notify("leave_application", {"entered": number, "wait": False})
            raise
        self._expected_application = before
        if self.connected:
            await self._call_agent("leave_application", limit, entered=number)
        else:  # the next session restores the application first
            self._caller.notify("leave_application", {"entered": number, "wait": False})

    @contextlib.asynccontextmanager
    async def _reserved(self, timeout: float) -> AsyncGenerator[Self]:
        number, leases = self._program.next_call(), self._caller.leases
        try:
            reply = await self._call_agent("reserve", timeout, call=number)
            leases[number] = Lease(int(reply.fields["epoch"]))
            yield self
            await self._check_reservation_kept(number)
        finally:
            leases.pop(number, None)
            self._caller.notify("release", {"reservation": number})

    async def _check_reservation_kept(self, reservation: int) -> None:
        """Check with the agent that a reservation has not ended; bounded.

        Raises:
            ReservationLostError: the reservation has ended, or this is unknown.
        """
        caller = self._caller
        deadline = self._deadline(self.settings.request_timeout)
        arguments = {"reservation": reservation}
        while True:
            caller.require_lease(reservation)
            question_deadline = min(deadline, self._deadline(QUESTION_TIMEOUT))
            try:
                reply = await caller.call("reserved", question_deadline, arguments)
            except ResponseTimeoutError as exc:
                reason: SmartCamError = exc
                if question_deadline < deadline:
                    continue  # the message was lost on the way
            except SmartCamError as exc:
                reason = exc
            else:
                if reply.fields["answer"].get("reserved") is not True:
                    caller.lose_lease(reservation, "its agent reported it")
                caller.require_lease(reservation)
                return
            raise ReservationLostError(
                f"{self.name}: whether the camera was reserved until the end of the block is "
                f"unknown: {reason}"
            ) from reason

    async def _start(self, timeout: float) -> None:
        await self._call_agent("start", timeout)

    async def _stop(self, timeout: float) -> None:
        await self._call_agent("stop", timeout)

    async def _query_application(self, timeout: float) -> int:
        return int(
            (await self._call_agent("query_application", timeout)).fields["answer"]["application"]
        )

    async def _query_status(self, timeout: float) -> Status:
        return await self._status_of("query_status", timeout)

    async def _reset_errors(self, timeout: float) -> Status:
        return await self._status_of("reset_errors", timeout)

    async def _wait_ready(self, timeout: float) -> Status:
        return await self._status_of("wait_ready", timeout)

    async def _status_of(self, do: str, timeout: float) -> Status:
        return Status(int((await self._call_agent(do, timeout)).fields["answer"]["status"]))

    async def _wait_status(self, predicate: Callable[[Status], bool], timeout: float) -> Status:
        deadline = self._deadline(timeout)
        self._require_session()
        queue: asyncio.Queue[Status | LinkError] = asyncio.Queue()
        self._change_queues.add(queue)
        try:
            present = self.status
            reply = await self._call_agent("refresh_status", timeout)
            if reply.fields["answer"]["asked"]:  # the agent asked the camera; queued ones are old
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
            self._change_queues.discard(queue)

    async def _read_image(self, timeout: float) -> bytes:
        return (await self._call_agent("read_image", timeout)).blobs[0]

    @cached_property
    def frame_client(self) -> FrameClient:
        """The object that asks the camera's agent for frames."""
        from smartcam.fleet._frames.caller import FrameClient

        return FrameClient(self.name, self._caller)

    @contextlib.asynccontextmanager
    async def _frames(self, wanted: StreamRequest) -> AsyncGenerator[FrameReader]:
        source = self._frame_source(wanted)
        async with source, source.reader() as reader:
            yield reader

    @property
    def has_frames(self) -> bool:
        """True if the agent reported that the camera has frames."""
        return bool(self._agent_facts.get("frames"))

    def frame_source(
        self, encoding: StreamEncoding = "raw", quality: int | None = None
    ) -> FrameSource:
        """Return the source that :meth:`frames` reads, for several readers; not opened yet."""
        form = self._check_encoding(encoding, quality, STREAM_ENCODINGS)
        return self._frame_source(
            StreamRequest(*form, bitrate=None, latency=None, decode=True, timeout=FRAME_TIMEOUT)
        )

    def _frame_source(self, wanted: StreamRequest) -> FrameSource:
        from smartcam.fleet._frames.shared_driver import SharedFrameDriver
        from smartcam.fleet._frames.stream_form import FleetStreamRequest
        from smartcam.frames import FrameAddress, FrameSource

        request = FleetStreamRequest.checked(*wanted[:4], self.name, decode=wanted.decode)
        driver = SharedFrameDriver(FrameAddress.parse(self.url), self.frame_client, request)
        return FrameSource(driver, timeout=wanted.timeout, stall=None)

    async def _newest_frame(self, max_age: float, form: FrameRequest, timeout: float) -> FleetFrame:
        wanted = FrameForm.checked(*form, self.name)
        age = None if math.isinf(max_age) else max_age
        return await self.frame_client.get_frame(wanted, timeout, max_age=age)

    async def _frame_after(
        self, moment: float | None, form: FrameRequest, timeout: float
    ) -> FleetFrame:
        wanted = FrameForm.checked(*form, self.name)
        if moment is None:
            return await self.frame_client.get_frame(wanted, timeout, fresh=True)
        return await self.frame_client.get_frame(wanted, timeout, moment=moment)

    async def _get_clock(self, timeout: float) -> datetime:
        reply = await self._call_agent("get_clock", timeout)
        return datetime.fromisoformat(reply.fields["answer"]["clock"])

    async def _set_clock(self, when: datetime) -> None:
        await self._call_agent("set_clock", None, when=when.isoformat())

    async def _set_input(self, data: bytes) -> None:
        await self._call_agent("set_input", None, [data])

    async def _set_sequence_number(self, number: int) -> None:
        await self._call_agent("set_sequence_number", None, number=number)

    async def reboot(self) -> None:
        await self._call_agent("reboot", None)
        # wait until this program knows that the session has ended
        with contextlib.suppress(TimeoutError, LinkError):
            async with asyncio.timeout(CATCH_UP_TIMEOUT):
                await self._wait_until(lambda: not self.connected)

    async def _take_back(self, timeout: float) -> None:
        deadline = self._deadline(timeout)
        await self._wait_opening(deadline)
        if self._closed is not None:
            raise self._closed.with_traceback(None)
        reply = await self._caller.call("take_back", deadline, timeout=timeout)
        fields = reply.fields
        await self._wait_received(int(fields["states"]), int(fields["results"]), deadline)

    async def _request(
        self, message_id: int | str, payload: bytes, answered: bool | None, timeout: float
    ) -> bytes | None:
        arguments: dict[str, Any] = {"message_id": message_id, "answered": answered}
        reply = await self._call_agent("request", timeout, [payload], **arguments)
        return reply.blobs[0] if reply.blobs else None


_status_of_bits = functools.lru_cache(maxsize=256)(Status)
"""Return the status with these bits; a look-up costs less than a new object."""


def _time_of(state: dict[str, Any]) -> datetime:
    if "event" not in state:
        return datetime.now(UTC)
    try:
        return datetime.fromisoformat(state["event"]["at"])
    except (KeyError, TypeError, ValueError):
        return datetime.now(UTC)
