"""Manage one camera of an agent: its session, its messages, and which program may command it."""

from __future__ import annotations

import asyncio
import collections
import contextlib
import math
from typing import TYPE_CHECKING, Any

from smartcam._client._inside import DeadlineTimer, Interpretation, new_tuple
from smartcam.exceptions import (
    ConnectionLostError,
    ReservationLostError,
    SmartCamError,
    UnsupportedError,
)
from smartcam.fleet._agent.client import AgentCallbacks, AgentClient
from smartcam.fleet._agent.gate import Gate
from smartcam.fleet._bus.errors import late_call_error, to_fields
from smartcam.fleet._bus.log import AgentLog
from smartcam.fleet._bus.wire import (
    CURRENT,
    LATE,
    ResultGroup,
    encode,
    encode_groups,
    encode_state,
    encode_status,
    timestamp,
)
from smartcam.fleet._json.topics import CameraTopics
from smartcam.fleet._operations.trigger_counts import RESULT, outcome_of
from smartcam.fleet._program.program_name import in_words
from smartcam.models import Connected, Disconnected, Reconnected, StatusChanged, jsonable

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterator, Sequence

    from smartcam.fleet._agent.bundle import AgentBundle
    from smartcam.fleet._agent.client import Owner, RawValue
    from smartcam.fleet._agent.gate import Change
    from smartcam.fleet._bus.bus import Bus, Publisher
    from smartcam.fleet._bus.keys import Keys
    from smartcam.fleet._frames.camera_frames import SharedFrames
    from smartcam.fleet._json.topics import Topics
    from smartcam.models import CameraEvent, Result, Status
    from smartcam.observers import Observer
    from smartcam.settings import CameraSettings

MAX_STATES_PER_BUNDLE = 1000
MAX_STATE_BYTES = 1 << 19
STATUS_DELAY = 0.005
"""Seconds that a status waits for further statuses, so that all are sent in one message. A program
that triggers gets the status earlier, with the reply."""

CATCH_UP_DELAY = 0.2
"""Seconds after a reply with a status until the number of the next state is published, unless a
state is published before. Without this number, nobody would notice the loss of the reply."""

RESULTS_INTERVAL = 0.002
"""Least number of seconds between two messages with results; results in between are sent
together."""

FULL_MESSAGE_BYTES = 1 << 16
"""Number of collected bytes of results that are sent without waiting for RESULTS_INTERVAL."""

REMINDER_DELAYS = (0.05, 0.2, 1.0, 5.0)
"""Delays, seconds, of messages without results that follow results, and have the number of the next
result. Without these messages, no program would notice the loss of the last results."""


class SharedCamera:
    """A camera that an agent shares.

    Args:
        name: name of the camera in the fleet.
        settings: settings of the client that has the session.
        bus: bus on which results and states are sent.
        keys: keys of the fleet.
        epoch: number of the agent's start.
        history: largest count of kept results, and of their bytes.
        on_event: callback for the camera's events.
        topics: topics of the agent's cameras in JSON.
        frames: frames of the camera.
        bundle: sender of bundles, which have results of all the agent's cameras.
        observers: observers of the camera's sessions.

    Attributes:
        epoch: number of the agent's start.
        first_result: number of the first result of this epoch.
        is_only_agent: whether no other agent can take over the camera.
        gate: gate that decides which program's commands may pass.
        results: the last results of the camera.
        states: the last states of the camera.
        outcomes: lists that collect the results of running triggers, by the trigger's owner.
        topics: topics of the camera in JSON, for other programs.
        frames: frames of the camera.
        failure: error of the last attempt before the first session; None from that session on.
        triggers: counts of programs' triggers, by their outcome (a word of ``OUTCOMES``).
    """

    def __init__(
        self,
        name: str,
        settings: CameraSettings,
        bus: Bus,
        keys: Keys,
        epoch: int,
        history: tuple[int, int],
        on_event: Callable[[CameraEvent], None],
        topics: Topics,
        frames: SharedFrames,
        bundle: AgentBundle,
        observers: Sequence[Observer] = (),
    ) -> None:
        self.name = name
        self.frames = frames
        self.settings = settings
        self.gate: Gate = Gate(self._on_reservation)
        self.results: AgentLog = AgentLog(*history)
        self.states: AgentLog = AgentLog(MAX_STATES_PER_BUNDLE, MAX_STATE_BYTES)
        self.outcomes: dict[Owner, list[bytes]] = {}
        self.failure: SmartCamError | None = None
        self.triggers: collections.Counter[str] = collections.Counter()
        self.epoch: int = epoch
        self.first_result: int = 1
        self.is_only_agent: bool = True
        self._report_event, self._bundle, self._observers = on_event, bundle, observers
        # made only to raise for an invalid ``interpret_as``; programs set the other options
        Interpretation(settings.interpret_as, lenient=True, y_down=False)
        self.topics: CameraTopics = CameraTopics(self, topics)
        self._client = self._make_client()
        self._unsent_groups: list[bytes] = []
        self._unsent_states: list[bytes] = []
        self._unsent_bytes = 0
        self._flush_handle: asyncio.Handle | None = None  # the next sending of results
        self._sent_at = -math.inf
        self._states_timer = DeadlineTimer(self._flush_states)
        self._next_number_timer = DeadlineTimer(self._put_states)
        self._reminder: asyncio.TimerHandle | None = None
        self._was_tried = asyncio.Event()
        self._has_ended = False  # whether there will be no further session
        self._states_out: Publisher = bus.publisher(keys.states(name), urgent=True)
        self._results_out: Publisher = bus.publisher(keys.results(name), self._on_subscribers)

    @property
    def client(self) -> AgentClient:
        """The client that has the session."""
        return self._client

    @property
    def was_tried(self) -> bool:
        """True once the first attempt has ended, with or without success."""
        return self._was_tried.is_set()

    @property
    def connected(self) -> bool:
        """True while there is a session."""
        return self._client.connected

    @property
    def numbers(self) -> tuple[int, ...]:
        """Numbers of the next result, state, status and event, also for when it is shared again."""
        topics = self.topics
        next_numbers = self.results.next_number, self.states.next_number
        return *next_numbers, topics.next_status, topics.next_event

    @numbers.setter
    def numbers(self, numbers: tuple[int, ...]) -> None:
        topics = self.topics
        self.results.next_number, self.states.next_number, topics.next_status, topics.next_event = (
            numbers
        )

    def _make_client(self) -> AgentClient:
        callbacks = AgentCallbacks(
            self._on_results, self._on_status, self._on_event, self._on_end, self._on_taken_by_other
        )
        return AgentClient(self.settings, callbacks, self._observers)

    # ------------------------------------------------------------------ open and close

    async def run(self) -> None:
        """Try until the first session is open, or no further attempt is allowed."""
        backoff = self.settings.reconnect
        delays = iter(()) if backoff is None else backoff.delays()
        try:
            while True:
                try:
                    await self._client.open()
                except (SmartCamError, OSError) as error:
                    self._fail(error)
                    delay = next(delays, None)
                    if delay is None or backoff is None or not backoff.transient(error):
                        self._has_ended = True
                        return
                    await asyncio.sleep(delay)
                    self._client = self._make_client()
                else:
                    self.failure = None
                    return
        finally:
            self._was_tried.set()
            self._publish_state({"kind": "Tried"})

    async def wait_first_attempt(self, timeout: float) -> None:
        """Wait until the first attempt has ended, with or without success; bounded."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                await self._was_tried.wait()

    async def close(self) -> None:
        """End the session with Disconnect; bounded."""
        self._was_tried.clear()  # later messages have no further effect
        try:
            await self.frames.close()
        finally:
            await self._client.close()
        self.lose_reservation()
        if self._reminder is not None:
            self._reminder.cancel()
        self.flush()
        self._states_timer.cancel()
        self._next_number_timer.cancel()
        self._states_out.close()
        self._results_out.close()
        self.topics.close()

    def _fail(self, error: BaseException) -> None:
        if not isinstance(error, SmartCamError):
            error = ConnectionLostError(f"{self.name}: {error}")
        self.failure = error
        self._was_tried.set()
        self._publish_state({"kind": "Absent"})

    def require_client(self) -> AgentClient:
        """Return the camera.

        Raises:
            LinkError: there is no session; the text has the reason.
        """
        if self.failure is not None or not (self._was_tried.is_set() or self.connected):
            reason = self.failure or "it tries for the first time"
            raise ConnectionLostError(
                f"{self.name}: the agent has no session with the camera: {reason}"
            ) from self.failure
        return self._client

    @contextlib.contextmanager
    def counting_trigger(self, action: str) -> Iterator[None]:
        """Count the outcome of the block, if ``action`` is a trigger."""
        outcome = RESULT
        try:
            yield
        except BaseException as exc:
            outcome = outcome_of(exc)
            raise
        finally:
            if "trigger" in action.lower():
                self.triggers[outcome] += 1

    async def enter_gate(self, program: str, action: str, timeout: float) -> None:
        """Wait for the turn of a command of ``program``, like :meth:`Gate.enter`.

        Raises:
            ResponseTimeoutError, TriggerTimeoutError: another program has reserved the camera for
                ``timeout`` seconds more.
        """
        try:
            await self.gate.enter(program, timeout)
        except TimeoutError as exc:
            raise self._not_granted_error(action, timeout) from exc

    async def reserve(self, program: str, reservation: Hashable, timeout: float) -> None:
        """Keep the commands of other programs out, like :meth:`Gate.reserve`.

        If another agent may take over the camera, it can be reserved only during a session.

        Raises:
            ResponseTimeoutError: another program holds the camera longer than ``timeout`` seconds.
            LinkError: this agent has no session, and another agent may have one.
        """
        try:
            await self.gate.reserve(program, reservation, timeout)
        except TimeoutError as exc:
            raise self._not_granted_error("reserve", timeout) from exc
        if not (self.is_only_agent or self.connected):
            self.gate.release(reservation)
            raise ConnectionLostError(
                f"{self.name}: the agent has no session with the camera, and another one may have; "
                "reserve was not done"
            )

    def check_reserved(self, reservation: Hashable, action: str) -> None:
        """Refuse a command of a block whose reservation has ended.

        Raises:
            ReservationLostError: the reservation has ended, or was made by another agent.
        """
        if not self.gate.holds(reservation):
            raise ReservationLostError(
                f"{self.name}: the agent does not know the reservation in whose block {action} was "
                "called: it was lost, and commands of others may have come between; "
                f"{action} was not done"
            )

    async def still_holds(self, reservation: Hashable, timeout: float) -> bool:
        """Return True if a reservation still holds, and this agent still has the camera.

        If another agent may take over the camera, a request is sent to the camera. An answer shows
        that this agent still has the camera, since a camera answers only one client.

        Raises:
            SmartCamError: the camera does not answer.
        """
        if not self.is_only_agent and self.gate.holds(reservation):
            with contextlib.suppress(UnsupportedError):
                await self.require_client().query_application(timeout=timeout)
        return self.gate.holds(reservation)

    def lose_reservation(self) -> None:
        """End a reservation that its holder has not released, if there is one."""
        if self.gate.holder is not None:
            self.gate.lose_program(self.gate.holder)

    def _on_reservation(self, change: Change, program: str) -> None:
        self.topics.on_reservation(change, program)
        if change == "ReservationLost" and self._was_tried.is_set():
            self._publish_state({"kind": change, "program": program})
        else:
            self.topics.on_state()

    def _not_granted_error(self, action: str, timeout: float) -> SmartCamError:
        """Return the error for a program whose wait for other programs timed out."""
        holder = self.gate.holder
        cause = "commands of others" if holder is None else f"reserved by {in_words(holder)}, which"
        text = f"{self.name}: {cause} did not let go within {timeout:.3g} s; {action} was not done"
        return late_call_error(action, text)

    # ------------------------------------------------------------------ state

    def state_fields(self) -> dict[str, Any]:
        """Return the fields of a state message."""
        camera = self._client
        try:
            status: int | None = int(camera.status)
        except SmartCamError:
            status = None
        # camera.connected would change too early: results from before a link's end are sent first
        trouble = self.failure or camera.trouble
        fields: dict[str, Any] = {
            "connected": trouble is None,
            "status": status,
            "endian": camera.endian,
            "application": camera.active_application,
        }
        if not self._was_tried.is_set():
            fields["trying"] = True
        elif trouble is not None:
            fields |= {"error": to_fields(trouble), "over": self._has_ended and self.is_only_agent}
        return fields

    def session_state(self) -> tuple[bool, int | None, int | None, str | None]:
        """Return the session's state: connected, status, application, reason if not connected."""
        camera, trouble = self._client, self.failure or self._client.trouble
        try:
            status: int | None = int(camera.status)
        except SmartCamError:
            status = None
        reason = None if trouble is None else str(trouble)
        return trouble is None, status, camera.active_application, reason

    def camera_fields(self) -> dict[str, Any]:
        """Return the fields of the camera that do not change during a session."""
        camera, settings = self._client, self.settings
        fields: dict[str, Any] = {
            "camera": self.name,
            "url": camera.url,
            "protocol_version": camera.protocol_version,
            "interpret_as": jsonable(settings.interpret_as),
            "y_down": settings.y_down,
            "lenient": settings.lenient,
        }
        with contextlib.suppress(SmartCamError):
            fields["capabilities"] = jsonable(camera.capabilities)
        return fields

    # ------------------------------------------------------------------ events of the client

    def _on_status(self, status: Status) -> None:
        self.topics.on_status(status)
        camera, number = self._client, self.states.next_number
        if not (camera.connected and self._was_tried.is_set()):
            self._publish_state({"kind": "Status"}, max_delay=STATUS_DELAY)
            return
        # three times as fast as int(status)
        bits, application = status._value_, camera.active_application
        data = encode_status(number, bits, camera.endian, application)
        self._add_state(data, asyncio.get_running_loop().time(), STATUS_DELAY)

    def _on_event(self, event: CameraEvent) -> None:
        self._report_event(event)
        if isinstance(event, StatusChanged):
            return  # reported by a status message
        self.topics.on_event(event)
        fields: dict[str, Any] = jsonable(event)
        del fields["camera"]
        state: dict[str, Any] = {"kind": type(event).__name__, "event": fields}
        if isinstance(event, (Connected, Reconnected)):
            state["about"] = self.camera_fields()
        self._publish_state(state)
        if isinstance(event, Disconnected) and not (event.expected or self.is_only_agent):
            self.lose_reservation()  # another agent may have taken the camera

    def _on_end(self) -> None:
        if self._was_tried.is_set() and self.failure is None:
            self._has_ended = True
            self._publish_state({"kind": "Over"})
        self.lose_reservation()

    def announce_removed(self, reason: str) -> None:
        """Announce that this agent no longer shares the camera, and why."""
        self._publish_state({"kind": "Removed", "reason": reason})

    def _on_taken_by_other(self) -> None:
        """Announce that another client has the camera."""
        self._publish_state({"kind": "Taken"})

    def _publish_state(self, fields: dict[str, Any], *, max_delay: float = 0.0) -> None:
        """Send an event with the camera's state, at the latest after ``max_delay`` seconds."""
        clock = asyncio.get_running_loop().time()
        state = {**fields, **self.state_fields(), "number": self.states.next_number, "clock": clock}
        self._add_state(encode_state(state), clock, max_delay)

    def _add_state(self, data: bytes, clock: float, max_delay: float) -> None:
        self.states.add(1, clock, data)
        self._unsent_states.append(data)
        if not max_delay:
            self._flush_states()
        elif len(self._unsent_states) == 1:
            self._states_timer.set(clock + max_delay)
        self.topics.on_state()

    def _on_results(self, results: Sequence[Result[RawValue]], current: bool, late: bool) -> None:
        """Keep results that arrived together, and send them soon, together with later results."""
        first = results[0]
        owner = first.value.owner
        flags = (CURRENT if current else 0) | (LATE if late else 0)
        cells_json = first.value.cells
        clock = asyncio.get_running_loop().time()
        group: ResultGroup = new_tuple(
            ResultGroup,
            (
                self.results.next_number,
                first.application,
                self._client.endian,
                flags,
                owner.program,
                owner.call,
                clock,
                first.received_at.timestamp(),
                timestamp(first.triggered_at),
                timestamp(None) if first.latency is None else first.latency,
                [result.raw for result in results],
                cells_json,
            ),
        )
        data = group.encode()
        self.results.add(len(group.payloads), clock, data)
        outcomes = self.outcomes.get(owner)
        if outcomes is not None:
            outcomes.append(data)
        if self._results_out.has_subscribers or self._bundle.has_subscribers:
            self._unsent_groups.append(data)
            self._unsent_bytes += len(data)
            if self._unsent_bytes >= FULL_MESSAGE_BYTES:
                self._flush_results()
            elif self._flush_handle is None:
                loop = asyncio.get_running_loop()
                send_at = self._sent_at + RESULTS_INTERVAL
                if send_at > loop.time():
                    self._flush_handle = loop.call_at(send_at, self._flush_results)
                else:
                    self._flush_handle = loop.call_soon(self._flush_results)
        self.topics.on_group(group)

    def unsent_states(self, since: int) -> list[bytes]:
        """Return the states that are not sent yet, from number ``since`` on."""
        unsent = self._unsent_states
        return unsent[max(0, since - self.states.next_number + len(unsent)) :]

    def drop_unsent_states(self) -> None:
        """Drop the unsent states: the only program of the agent gets them with a reply."""
        self._states_timer.clear()
        self._unsent_states.clear()
        self._next_number_timer.set(asyncio.get_running_loop().time() + CATCH_UP_DELAY)

    def flush(self, *, states: bool = True) -> None:
        """Send the results and, with ``states``, the states that were not sent yet."""
        if states:
            self._flush_states()
        self._flush_results()
        self._bundle.flush()

    def _flush_states(self) -> None:
        self._states_timer.clear()
        if self._unsent_states:
            self._put_states()

    def _put_states(self) -> None:
        self._next_number_timer.clear()
        states, self._unsent_states = self._unsent_states, []
        next_number = self.states.next_number
        self._states_out.put(encode({"epoch": self.epoch, "next_number": next_number}, states))

    def _flush_results(self) -> None:
        if self._flush_handle is not None:
            self._flush_handle.cancel()
            self._flush_handle = None
        if self._unsent_groups:
            self._sent_at, self._unsent_bytes = asyncio.get_running_loop().time(), 0
            groups, self._unsent_groups = self._unsent_groups, []
            payload = encode_groups(self.epoch, self.results.next_number, groups)
            if self._bundle.has_subscribers:
                self._bundle.add(self.name, payload)
            if self._results_out.has_subscribers:
                self._results_out.put(payload)
                self._schedule_reminder(0)

    def _on_subscribers(self, has_subscribers: bool) -> None:
        if has_subscribers:
            self._schedule_reminder(0)

    def _schedule_reminder(self, step: int) -> None:
        """Send the number of the next result later; ``step``: number of such messages before."""
        if self._reminder is not None:
            self._reminder.cancel()
            self._reminder = None
        if step < len(REMINDER_DELAYS):
            loop = asyncio.get_running_loop()
            self._reminder = loop.call_later(REMINDER_DELAYS[step], self._send_reminder, step + 1)

    def _send_reminder(self, step: int) -> None:
        self._reminder = None
        if self._results_out.has_subscribers:
            self._results_out.put(encode_groups(self.epoch, self.results.next_number, []))
            self._schedule_reminder(step)
