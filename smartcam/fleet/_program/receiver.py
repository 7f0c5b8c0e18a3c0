"""Receive the states and results of a fleet's camera, and pass on each of them once, in order."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import weakref
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._client._inside import Listeners, new_tuple
from smartcam.exceptions import (
    InterpretationError,
    ProtocolError,
    SmartCamError,
    WrongApplicationError,
)
from smartcam.fleet._bus.log import Feed
from smartcam.fleet._bus.wire import CURRENT, LATE, ResultGroup, decode, decode_groups, decode_state
from smartcam.fleet._program.reading import interpret_single, split_group, to_result
from smartcam.models import Result

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam._client._inside import ClientCounters, Interpretation
    from smartcam.fleet._bus.bus import Handle
    from smartcam.fleet._bus.wire import BusMessage, ResultsMessage, TriggerReply
    from smartcam.fleet._program.caller import Caller, CameraAgent

logger: logging.Logger = logging.getLogger("smartcam.fleet")

MISSING_TIMEOUT = 5.0
"""Seconds for the answer to a request for missing messages; after that, it is sent again."""


class StateMessage(NamedTuple):
    """An event of the camera, and its state after the event.

    Attributes:
        number: number of the event.
        next: number of the following event.
        fields: fields of the event and of the camera's state.
    """

    number: int
    next: int
    fields: dict[str, Any]

    @property
    def size(self) -> int:
        """Approximate number of bytes."""
        return 500

    def since(self, number: int) -> StateMessage:
        """Return the message unchanged, since it has only one number."""
        return self


def read_state(data: bytes) -> StateMessage:
    """Return the event from an agent's bytes.

    Raises:
        ValueError: the bytes are not an event.
    """
    fields = decode_state(data)
    number: int = fields["number"]
    message: StateMessage = new_tuple(StateMessage, (number, number + 1, fields))
    return message


class FleetListeners(Listeners):
    """Listeners of a fleet's camera. Each one gets only results that came after its own start."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._wanted_since: weakref.WeakKeyDictionary[asyncio.Future[Result], float] = (
            weakref.WeakKeyDictionary()
        )

    def waits_without_start(self) -> list[asyncio.Future[Result]]:
        """Return the waits for the next result whose start is not set yet."""
        return [wait for wait in self._next_results if wait not in self._wanted_since]

    def set_wait_start(self, future: asyncio.Future[Result], clock: float) -> None:
        """Set the agent's time from which a result can end this wait for the next result."""
        self._wanted_since[future] = clock

    def _take_next_results(self) -> list[asyncio.Future[Result]]:
        offered = self.results.offered_at
        later_waits = [
            wait for wait in self._next_results if self._wanted_since.get(wait, -math.inf) > offered
        ]
        taken = super()._take_next_results()
        if later_waits:
            self._next_results.update(later_waits)
            taken = [wait for wait in taken if wait not in later_waits]
        return taken

    def report_missed(self, count: int, next_group: ResultGroup | None) -> None:
        """Report to the streams that ``count`` results before ``next_group`` are missed.

        A stream that was started while these results came cannot know how many of them it should
        have got: it counts all of them.
        """
        self.results.offered_at = math.inf if next_group is None else next_group.clock
        for stream in self.results:
            stream.miss(count)
        self.results.offered_at = math.inf


class OwnTrigger:
    """A trigger of this program whose caller waits for the results.

    Args:
        interpretation: interpretation of the trigger's results.
        expected: application whose results are expected; None for any.

    Attributes:
        outcomes: result, or error, of each result number that was received for this trigger.
    """

    def __init__(self, interpretation: Interpretation, expected: int | None) -> None:
        self.interpretation, self.expected = interpretation, expected
        self.outcomes: dict[int, Result | InterpretationError] = {}


class Receiver:
    """Receives the agent's messages, and makes results from groups of containers.

    Args:
        name: name of the camera in results.
        camera: name of the camera in the fleet.
        caller: caller that asks the agent for missing messages.
        listeners: listeners for results.
        counters: counters of results.
        interpretation: function that returns the interpretation of results without an own trigger.
        on_state: callback for the camera's events.
        expected: function that returns the expected application; None for any.
    """

    def __init__(
        self,
        name: str,
        camera: str,
        caller: Caller,
        listeners: FleetListeners,
        counters: ClientCounters,
        interpretation: Callable[[], Interpretation],
        on_state: Callable[[dict[str, Any]], None],
        expected: Callable[[], int | None],
    ) -> None:
        self.own_triggers: dict[int, OwnTrigger] = {}
        self._name, self._camera, self._caller = name, camera, caller
        self._listeners, self._counters = listeners, counters
        self._interpretation, self._on_state, self._expected = interpretation, on_state, expected
        self._program = 0  # the number that the agent has given this program
        self._states: Feed[StateMessage] = Feed(
            self._take_state, _ignore_missed, lambda: self._fetch_soon("states")
        )
        self._results: Feed[ResultGroup] = Feed(
            self._pass_group,
            listeners.report_missed,
            lambda: self._fetch_soon("results"),
            resumes_epochs=True,
        )
        self._handles: dict[str, Handle] = {}
        self._results_since = math.inf  # agent's time from which results are needed
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._receive_waits: list[tuple[Feed[Any], int, asyncio.Future[None]]] = []

    # ------------------------------------------------------------------ open and close

    def open(self) -> None:
        """Subscribe to the camera's states."""
        program = self._caller.program
        key = program.keys.states(self._camera)
        self._handles["states"] = program.bus.subscribe(key, self._on_state_message)

    async def close(self) -> None:
        """Unsubscribe."""
        for handle in self._handles.values():
            handle.close()
        self._handles.clear()
        tasks, self._tasks = [*self._tasks.values()], {}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self._wake_waits(every_wait=True)

    def misses_states(self, agent: CameraAgent) -> bool:
        """Return True if the agent is the same as before, and has sent states not received here."""
        feed = self._states
        return feed.epoch == agent.epoch and 0 < feed.expected < int(agent.hello["states"])

    def begin_agent(self, agent: CameraAgent) -> None:
        """Expect the next messages of an agent, whose numbers are in its answer to the hello."""
        hello = agent.hello
        self._program = int(hello.get("program", 0))
        states, results = int(hello["states"]), int(hello["results"])
        self._states.begin(agent.epoch, states, states)
        if "results" not in self._handles:
            return
        if self._results.expected:  # of a restarted or new agent, all results are wanted
            self._results.begin(agent.epoch, int(hello.get("first_result", 1)), results)
        else:
            self._start_task("find", self._find_first_result())

    def lose_agent(self) -> None:
        """Stop requests to the lost agent; missing messages are requested when an agent is back."""
        for task in self._tasks.values():
            task.cancel()
        self._tasks.clear()
        self._states.interrupt()
        if self._results.expected:
            self._results.interrupt()
        self._wake_waits(every_wait=True)

    @property
    def epoch(self) -> int:
        """Epoch of the agent of the last received states; 0 before."""
        return self._states.epoch

    # ------------------------------------------------------------------ results on demand

    def subscribe_results(self, since: float) -> None:
        """Receive results from ``since`` on, a time of the agent's clock. Idempotent."""
        if "results" in self._handles:
            return
        program = self._caller.program
        key = program.keys.results(self._camera)
        self._results_since, self._caller.streams_results = since, True
        self._handles["results"] = program.bus.subscribe(key, self._on_result_message)
        self._start_task("find", self._find_first_result())

    def _unsubscribe_results(self) -> None:
        self._handles.pop("results").close()
        self._caller.streams_results = False
        self._results.stop()
        self._wake_waits(every_wait=True)

    async def _find_first_result(self) -> None:
        """Ask the agent for the number of the first result that came after the first listener."""
        while self._caller.agent is not None:
            agent = self._caller.agent
            with contextlib.suppress(SmartCamError):
                reply = await self._caller.call(
                    "find_first_result", self._fetch_deadline(), {"since": self._results_since}
                )
                answer = reply.fields["answer"]
                self._results.begin(agent.epoch, int(answer["first"]), int(answer["next_number"]))
                self._wake_waits()
                return

    async def wait_received(self, kind: str, number: int, deadline: float) -> None:
        """Wait until all messages before ``number`` were received, or until the deadline."""
        feed: Feed[Any] = self._states if kind == "states" else self._results
        if kind not in self._handles or feed.expected >= number:
            return
        reached: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._receive_waits.append((feed, number, reached))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout_at(deadline):
                await reached

    def has_received(self, states: int, results: int) -> bool:
        """Return True if all states, and subscribed results, before these numbers were received."""
        has_results = "results" not in self._handles or self._results.expected >= results
        return has_results and self._states.expected >= states

    def _wake_waits(self, *, every_wait: bool = False) -> None:
        if not self._receive_waits:
            return
        remaining: list[tuple[Feed[Any], int, asyncio.Future[None]]] = []
        for feed, number, reached in self._receive_waits:
            if every_wait or feed.expected >= number:
                if not reached.done():
                    reached.set_result(None)
            elif not reached.done():
                remaining.append((feed, number, reached))
        self._receive_waits = remaining

    # ------------------------------------------------------------------ missing messages

    def _fetch_soon(self, kind: str) -> None:
        if kind not in self._tasks and self._caller.agent is not None:
            self._start_task(kind, self._fetch_missing(kind))

    def _start_task(self, kind: str, work: Any) -> None:
        task = asyncio.get_running_loop().create_task(
            work, name=f"smartcam.fleet.{self._camera}.{kind}"
        )
        self._tasks[kind] = task

        def on_done(task: asyncio.Task[None]) -> None:
            if self._tasks.get(kind) is task:
                del self._tasks[kind]
            if not task.cancelled() and task.exception() is not None:
                logger.error("%s ! %s", self._name, task.exception(), exc_info=task.exception())

        task.add_done_callback(on_done)

    async def _fetch_missing(self, kind: str) -> None:
        """Request missing messages until none is missing."""
        feed: Feed[Any] = self._states if kind == "states" else self._results
        while feed.has_gap and feed.expected and self._caller.agent is not None:
            epoch = feed.epoch
            try:
                reply = await self._caller.call(
                    kind, self._fetch_deadline(), {"first": feed.expected}
                )
            except SmartCamError:
                continue
            try:
                answer = reply.fields["answer"]
                first, next_number = int(answer["first"]), int(answer["next_number"])
                messages = _decode_messages(kind, reply)
            except (ProtocolError, KeyError, TypeError, ValueError) as exc:
                logger.warning("%s ! what was missing cannot be read: %s", self._name, exc)
                # skip the message, not to request it forever
                first = next_number = feed.expected + 1
                messages = []
            feed.fill(epoch, first, next_number, messages)
            self._wake_waits()

    def _fetch_deadline(self) -> float:
        return asyncio.get_running_loop().time() + MISSING_TIMEOUT

    # ------------------------------------------------------------------ messages

    def _on_state_message(self, key: str, payload: bytes) -> None:
        origin = f"the agent's message about {self._camera}"
        try:
            message = decode(payload, origin)
            epoch, next_number = int(message.fields["epoch"]), int(message.fields["next_number"])
            self._count_message(payload)
            known_count = 0  # states that came before, with replies
            if epoch == self.epoch:
                known_count = max(0, self._states.expected - next_number + len(message.blobs))
            states = [read_state(blob) for blob in message.blobs[known_count:]]
        except (ProtocolError, KeyError, TypeError, ValueError) as exc:
            logger.warning("%s ! %s: %s", self._name, origin, exc)
            return
        self._check_restart(epoch)
        self._states.receive(epoch, next_number, states)
        self._wake_waits()

    def take_states(self, reply: TriggerReply) -> None:
        """Take the states in a reply, which the agent has not published yet."""
        if not reply.new_states:
            return
        try:
            states = [read_state(reported) for reported in reply.new_states]
        except ValueError as exc:
            logger.warning("%s ! the states in a reply are not valid: %s", self._camera, exc)
            return
        self._states.receive(reply.epoch, reply.next_state, states)
        self._wake_waits()

    def _on_result_message(self, key: str, payload: bytes) -> None:
        try:
            message = decode_groups(payload, f"results of {self._camera}")
        except ProtocolError as exc:
            logger.warning("%s ! %s", self._name, exc)
            return
        self._count_message(payload)
        listeners = self._listeners
        if not (listeners.wants_results or listeners.has_result_observer):
            self._unsubscribe_results()
            return
        self._check_restart(message.epoch)
        self._results.receive(message.epoch, message.next_number, message.groups)
        self._wake_waits()

    def _check_restart(self, epoch: int) -> None:
        """Drop the agent if it was restarted, which its presence on the bus may not show."""
        agent = self._caller.agent
        if agent is not None and self._caller.has_restarted(epoch):
            self._caller.lose_agent(f"the agent {agent.name} was restarted")

    def _count_message(self, payload: bytes) -> None:
        counters = self._caller.counters
        counters.frames_received += 1
        counters.bytes_received += len(payload)

    def _take_state(self, taken: StateMessage) -> None:
        self._on_state(taken.fields)

    # ------------------------------------------------------------------ results

    def trigger_results(self, own_trigger: OwnTrigger, message: ResultsMessage) -> list[Result]:
        """Return the results in the reply to an own trigger.

        Raises:
            InterpretationError: results cannot be interpreted; this is the first one's error.
        """
        results: list[Result] = []
        error, latency = None, math.nan
        for group in message.groups:
            outcome, latency = self._trigger_outcome(own_trigger, group), group.latency
            if not isinstance(outcome, InterpretationError):
                results.append(outcome)
            elif error is None:
                error = outcome
        if not math.isnan(latency):
            self._counters.processing.add(latency)
        if error is not None:
            raise error
        return results

    def _trigger_outcome(
        self, own_trigger: OwnTrigger, group: ResultGroup
    ) -> Result | InterpretationError:
        """Return a trigger's result, or its error.

        A result can arrive twice: in the reply, and for all programs. It is counted once.
        """
        known = own_trigger.outcomes.get(group.number)
        if known is not None:
            return known
        counters = self._counters
        try:
            if own_trigger.expected is not None and group.application != own_trigger.expected:
                counters.count("wrong_application")
                raise self._wrong_application_error(group, own_trigger.expected)
            try:
                outcome: Result | InterpretationError = self._interpret(
                    group, own_trigger.interpretation
                )
            except InterpretationError:
                counters.count("uninterpretable")
                raise
            counters.count("triggered")
        except InterpretationError as error:
            outcome = error
        own_trigger.outcomes[group.number] = outcome
        return outcome

    def _pass_group(self, group: ResultGroup) -> None:
        """Pass results to the listeners that came before these results."""
        listeners = self._listeners
        listeners.results.offered_at = group.clock
        try:
            now = asyncio.get_running_loop().time()
            own_trigger = (
                self.own_triggers.get(group.call)
                if group.owner and group.owner == self._program
                else None
            )
            if own_trigger is not None:
                self._offer(group, self._trigger_outcome(own_trigger, group), now, owned=True)
                return
            expected = self._expected()
            if expected is not None and group.application != expected:
                self._counters.count("wrong_application", len(group.payloads))
                return
            if listeners.results_only_streamed and self._pass_burst(group, now):
                return
            for single in split_group(group):
                fate = "late" if group.flags & LATE else "streamed"
                try:
                    outcome: Result | InterpretationError = self._interpret(
                        single, self._interpretation()
                    )
                except InterpretationError as error:
                    outcome, fate = error, "late" if fate == "late" else "uninterpretable"
                self._counters.count(fate)
                self._offer(single, outcome, now, owned=False)
        finally:
            listeners.results.offered_at = math.inf

    def _offer(
        self, group: ResultGroup, outcome: Result | InterpretationError, now: float, *, owned: bool
    ) -> None:
        current, listeners = bool(group.flags & CURRENT), self._listeners
        if isinstance(outcome, InterpretationError):
            size = len(group.payloads[0])
            listeners.offer_error(outcome, now, size, current=current, reported_by_caller=owned)
        else:
            listeners.offer_result(outcome, now, current=current, late=bool(group.flags & LATE))

    def _pass_burst(self, group: ResultGroup, now: float) -> bool:
        """Pass all results of a group to streams at once; return whether that was possible."""
        if group.cells or not group.flags & CURRENT:
            return False
        interpreted = self._interpretation().burst(
            group.application,
            group.payloads,
            group.endian,
            camera=self._name,
            number=group.number,
            at=group.received_at,
        )
        if interpreted is None:
            return False
        values, empty_slots = interpreted
        count, name, at, trigger = len(values), self._name, group.received_at, group.trigger_time
        latency = None if math.isnan(group.latency) else group.latency
        results = [
            Result(name, group.application, None, number, trigger, at, latency, raw, value)
            for number, raw, value in zip(
                range(group.number, group.next), group.payloads, values, strict=True
            )
        ]
        self._counters.add_empty_slots(empty_slots)
        self._counters.count("streamed", count)
        self._listeners.offer_burst(results, now, group.size)
        return True

    def _interpret(self, group: ResultGroup, interpretation: Interpretation) -> Result:
        at = group.received_at
        value, sequence, empty_slots = interpret_single(group, interpretation, self._name, at)
        if empty_slots:
            self._counters.add_empty_slots(empty_slots)
        return to_result(group, self._name, value, sequence, at)

    def _wrong_application_error(self, group: ResultGroup, expected: int) -> WrongApplicationError:
        return WrongApplicationError(
            f"{self._name}: a result of application {group.application} came, "
            f"application {expected} was expected",
            expected=expected,
            got=group.application,
        )


def _decode_messages(kind: str, reply: BusMessage) -> list[Any]:
    if kind == "states":
        return [read_state(blob) for blob in reply.blobs]
    return decode_groups(reply.blobs[0], "results that were asked for").groups


def _ignore_missed(_count: int, _following: StateMessage | None) -> None:
    """Ignore missed states, since each message has the whole state of the camera."""
