"""Receive a fleet camera's states and results, each once and in order, for its listeners."""

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
from smartcam.fleet._bus.wire import CURRENT, LATE, ResultRun, decode, decode_runs, decode_state
from smartcam.fleet._program.reading import as_result, interpreted, singles
from smartcam.models import Result

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam._client._inside import ClientCounters, Interpretation
    from smartcam.fleet._bus.bus import Handle
    from smartcam.fleet._bus.wire import Batch, BusMessage, TriggerReply
    from smartcam.fleet._program.caller import Caller, Met

logger: logging.Logger = logging.getLogger("smartcam.fleet")

FILL_TIMEOUT = 5.0
"""Seconds for the answer to a request for missing messages; then it is sent again."""


class StateMessage(NamedTuple):
    """An event of the camera, and its state after the event.

    Attributes:
        number: number of the event.
        next: number of the event after it.
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
        """Return this state, which has one number only."""
        return self


def state(data: bytes) -> StateMessage:
    """Return the event from an agent's bytes.

    Raises:
        ValueError: the bytes are not an event.
    """
    fields = decode_state(data)
    number: int = fields["number"]
    message: StateMessage = new_tuple(StateMessage, (number, number + 1, fields))
    return message


class FleetListeners(Listeners):
    """Skips listeners that came later than the results that are passed on."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._since: weakref.WeakKeyDictionary[asyncio.Future[Result], float] = (
            weakref.WeakKeyDictionary()
        )

    def unmarked(self) -> list[asyncio.Future[Result]]:
        """Return the waiters whose start is not known yet."""
        return [wait for wait in self._next_results if wait not in self._since]

    def waits_since(self, future: asyncio.Future[Result], clock: float) -> None:
        """Note that a waiter for the next result needs one from ``clock`` on."""
        self._since[future] = clock

    def _take_next_results(self) -> list[asyncio.Future[Result]]:
        horizon = self.results.horizon
        late = [wait for wait in self._next_results if self._since.get(wait, -math.inf) > horizon]
        taken = super()._take_next_results()
        if late:
            self._next_results.update(late)
            taken = [wait for wait in taken if wait not in late]
        return taken

    def miss(self, count: int, then: ResultRun | None) -> None:
        """Report to the streams that results before ``then`` are missed.

        A stream that subscribed in between cannot know how many it has missed: it counts all.
        """
        self.results.horizon = math.inf if then is None else then.clock
        for stream in self.results:
            stream.miss(count)
        self.results.horizon = math.inf


class Own:
    """A trigger of this program, while its caller waits.

    Args:
        interpretation: interpretation of the trigger's results.
        expected: application whose results are expected; None for any.
    """

    def __init__(self, interpretation: Interpretation, expected: int | None) -> None:
        self.interpretation, self.expected = interpretation, expected
        self.outcomes: dict[int, Result | InterpretationError] = {}


class Receiver:
    """Receives the agent's messages, and makes results from runs.

    Args:
        name: name of the camera in results.
        camera: name of the camera in the fleet.
        caller: caller that asks the agent for missing messages.
        listeners: listeners for results.
        counters: counters of results.
        interpretation: function that returns the interpretation, unless a trigger has its own.
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
        self.own_calls: dict[int, Own] = {}
        self._name, self._camera, self._caller = name, camera, caller
        self._listeners, self._counters = listeners, counters
        self._interpretation, self._on_state, self._expected = interpretation, on_state, expected
        self._program = 0  # the agent's number for this program
        self._states: Feed[StateMessage] = Feed(
            self._take_state, _ignore, lambda: self._lack("states")
        )
        self._results: Feed[ResultRun] = Feed(
            self._take_run, listeners.miss, lambda: self._lack("results"), returns=True
        )
        self._handles: dict[str, Handle] = {}
        self._since = math.inf  # agent's time from which results are needed
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._reaching: list[tuple[Feed[Any], int, asyncio.Future[None]]] = []

    # ------------------------------------------------------------------ life

    def open(self) -> None:
        """Subscribe to the camera's states."""
        program = self._caller.program
        key = program.keys.states(self._camera)
        self._handles["states"] = program.bus.subscribe(key, self._take_state_message)

    async def close(self) -> None:
        """Unsubscribe."""
        for handle in self._handles.values():
            handle.close()
        self._handles.clear()
        tasks, self._tasks = [*self._tasks.values()], {}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self._wake(everyone=True)

    def misses_states(self, met: Met) -> bool:
        """Return True if an agent, met again, has sent states that were not received."""
        feed = self._states
        return feed.epoch == met.epoch and 0 < feed.expected < int(met.hello["states"])

    def meet(self, met: Met) -> None:
        """Start with an agent that has answered with its next numbers."""
        hello = met.hello
        self._program = int(hello.get("program", 0))
        states, results = int(hello["states"]), int(hello["results"])
        self._states.begin(met.epoch, states, states)
        if "results" not in self._handles:
            return
        if self._results.expected:  # after a new start, or a takeover, all results
            self._results.begin(met.epoch, int(hello.get("began", 1)), results)
        else:
            self._begin("find", self._find())

    def lose(self) -> None:
        """Stop asking, since the agent is lost; missing messages are requested at its return."""
        for task in self._tasks.values():
            task.cancel()
        self._tasks.clear()
        self._states.interrupt()
        if self._results.expected:
            self._results.interrupt()
        self._wake(everyone=True)

    @property
    def epoch(self) -> int:
        """Epoch of the agent of the last received states; 0 before."""
        return self._states.epoch

    # ------------------------------------------------------------------ on demand

    def want_results(self, since: float) -> None:
        """Note that results from ``since`` on (the agent's clock) are needed."""
        if "results" in self._handles:
            return
        program = self._caller.program
        key = program.keys.results(self._camera)
        self._since, self._caller.streamed = since, True
        self._handles["results"] = program.bus.subscribe(key, self._take_result_message)
        self._begin("find", self._find())

    def _leave_results(self) -> None:
        self._handles.pop("results").close()
        self._caller.streamed = False
        self._results.stop()
        self._wake(everyone=True)

    async def _find(self) -> None:
        """Find the first needed result: earlier ones came before there was a listener."""
        while self._caller.met is not None:
            met = self._caller.met
            with contextlib.suppress(SmartCamError):
                reply = await self._caller.call("find", self._soon(), {"since": self._since})
                answer = reply.fields["answer"]
                self._results.begin(met.epoch, int(answer["first"]), int(answer["following"]))
                self._wake()
                return

    async def reach(self, kind: str, number: int, deadline: float) -> None:
        """Wait until all messages before ``number`` were received; bounded, and never fails."""
        feed: Feed[Any] = self._states if kind == "states" else self._results
        if kind not in self._handles or feed.expected >= number:
            return
        reached: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._reaching.append((feed, number, reached))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout_at(deadline):
                await reached

    def has(self, states: int, results: int) -> bool:
        """Return True if all states, and subscribed results, before these numbers were received."""
        enough = "results" not in self._handles or self._results.expected >= results
        return enough and self._states.expected >= states

    def _wake(self, *, everyone: bool = False) -> None:
        if not self._reaching:
            return
        left: list[tuple[Feed[Any], int, asyncio.Future[None]]] = []
        for feed, number, reached in self._reaching:
            if everyone or feed.expected >= number:
                if not reached.done():
                    reached.set_result(None)
            elif not reached.done():
                left.append((feed, number, reached))
        self._reaching = left

    # ------------------------------------------------------------------ missing messages

    def _lack(self, kind: str) -> None:
        if kind not in self._tasks and self._caller.met is not None:
            self._begin(kind, self._fill(kind))

    def _begin(self, kind: str, work: Any) -> None:
        task = asyncio.get_running_loop().create_task(
            work, name=f"smartcam.fleet.{self._camera}.{kind}"
        )
        self._tasks[kind] = task

        def done(ended: asyncio.Task[None]) -> None:
            if self._tasks.get(kind) is ended:
                del self._tasks[kind]
            if not ended.cancelled() and ended.exception() is not None:
                logger.error("%s ! %s", self._name, ended.exception(), exc_info=ended.exception())

        task.add_done_callback(done)

    async def _fill(self, kind: str) -> None:
        """Request missing messages until none is missing."""
        feed: Feed[Any] = self._states if kind == "states" else self._results
        while feed.lacking and feed.expected and self._caller.met is not None:
            epoch = feed.epoch
            try:
                reply = await self._caller.call(kind, self._soon(), {"first": feed.expected})
            except SmartCamError:
                continue
            try:
                answer = reply.fields["answer"]
                first, following = int(answer["first"]), int(answer["following"])
                things = _things(kind, reply)
            except (ProtocolError, KeyError, TypeError, ValueError) as exc:
                logger.warning("%s ! what was missing cannot be read: %s", self._name, exc)
                first = following = feed.expected + 1  # skip it, to not request it forever
                things = []
            feed.fill(epoch, first, following, things)
            self._wake()

    def _soon(self) -> float:
        return asyncio.get_running_loop().time() + FILL_TIMEOUT

    # ------------------------------------------------------------------ messages

    def _take_state_message(self, key: str, payload: bytes) -> None:
        origin = f"the agent's message about {self._camera}"
        try:
            message = decode(payload, origin)
            epoch, following = int(message.fields["epoch"]), int(message.fields["following"])
            self._count(payload)
            known = 0  # states that came with replies
            if epoch == self.epoch:
                known = max(0, self._states.expected - following + len(message.blobs))
            states = [state(blob) for blob in message.blobs[known:]]
        except (ProtocolError, KeyError, TypeError, ValueError) as exc:
            logger.warning("%s ! %s: %s", self._name, origin, exc)
            return
        self._see(epoch)
        self._states.receive(epoch, following, states)
        self._wake()

    def take_states(self, reply: TriggerReply) -> None:
        """Take the states in a reply, which the agent has not published yet."""
        if not reply.new_states:
            return
        try:
            states = [state(reported) for reported in reply.new_states]
        except ValueError as exc:
            logger.warning("%s ! the states in a reply are not valid: %s", self._camera, exc)
            return
        self._states.receive(reply.epoch, reply.states, states)
        self._wake()

    def _take_result_message(self, key: str, payload: bytes) -> None:
        try:
            batch = decode_runs(payload, f"results of {self._camera}")
        except ProtocolError as exc:
            logger.warning("%s ! %s", self._name, exc)
            return
        self._count(payload)
        listeners = self._listeners
        if not (listeners.wants_results or listeners.has_result_observer):
            self._leave_results()
            return
        self._see(batch.epoch)
        self._results.receive(batch.epoch, batch.following, batch.runs)
        self._wake()

    def _see(self, epoch: int) -> None:
        """Check whether the agent was restarted: presence does not show a quick restart."""
        met = self._caller.met
        if met is not None and self._caller.restarted(epoch):
            self._caller.lose(f"the agent {met.agent} was restarted")

    def _count(self, payload: bytes) -> None:
        counters = self._caller.counters
        counters.frames_received += 1
        counters.bytes_received += len(payload)

    def _take_state(self, taken: StateMessage) -> None:
        self._on_state(taken.fields)

    # ------------------------------------------------------------------ results

    def outcomes(self, own_call: Own, batch: Batch) -> list[Result]:
        """Return a trigger's results.

        Raises:
            InterpretationError: a result cannot be interpreted; the error of the first one.
        """
        results: list[Result] = []
        error, latency = None, math.nan
        for run in batch.runs:
            outcome, latency = self._outcome(own_call, run), run.latency
            if not isinstance(outcome, InterpretationError):
                results.append(outcome)
            elif error is None:
                error = outcome
        if not math.isnan(latency):
            self._counters.processing.add(latency)
        if error is not None:
            raise error
        return results

    def _outcome(self, own_call: Own, run: ResultRun) -> Result | InterpretationError:
        """Return a trigger's result, made and counted once, though it comes in two ways."""
        known = own_call.outcomes.get(run.number)
        if known is not None:
            return known
        counters = self._counters
        try:
            if own_call.expected is not None and run.application != own_call.expected:
                counters.count("wrong_application")
                raise self._wrong_application_error(run, own_call.expected)
            try:
                outcome: Result | InterpretationError = self._interpret(
                    run, own_call.interpretation
                )
            except InterpretationError:
                counters.count("uninterpretable")
                raise
            counters.count("triggered")
        except InterpretationError as error:
            outcome = error
        own_call.outcomes[run.number] = outcome
        return outcome

    def _take_run(self, run: ResultRun) -> None:
        """Pass containers that came together to listeners that came before them."""
        listeners = self._listeners
        listeners.results.horizon = run.clock
        try:
            now = asyncio.get_running_loop().time()
            own_call = (
                self.own_calls.get(run.call) if run.owner and run.owner == self._program else None
            )
            if own_call is not None:
                self._offer(run, self._outcome(own_call, run), now, owned=True)
                return
            expected = self._expected()
            if expected is not None and run.application != expected:
                self._counters.count("wrong_application", len(run.payloads))
                return
            if listeners.only_streams_results and self._take_burst(run, now):
                return
            for single in singles(run):
                fate = "late" if run.flags & LATE else "streamed"
                try:
                    outcome: Result | InterpretationError = self._interpret(
                        single, self._interpretation()
                    )
                except InterpretationError as error:
                    outcome, fate = error, "late" if fate == "late" else "uninterpretable"
                self._counters.count(fate)
                self._offer(single, outcome, now, owned=False)
        finally:
            listeners.results.horizon = math.inf

    def _offer(
        self, run: ResultRun, outcome: Result | InterpretationError, now: float, *, owned: bool
    ) -> None:
        current, listeners = bool(run.flags & CURRENT), self._listeners
        if isinstance(outcome, InterpretationError):
            size = len(run.payloads[0])
            listeners.offer_error(outcome, now, size, current=current, reported_by_caller=owned)
        else:
            listeners.offer_result(outcome, now, current=current, late=bool(run.flags & LATE))

    def _take_burst(self, run: ResultRun, now: float) -> bool:
        """Pass containers to streams, all at once; return False if that is not possible."""
        if run.cells or not run.flags & CURRENT:
            return False
        done = self._interpretation().burst(
            run.application,
            run.payloads,
            run.endian,
            camera=self._name,
            number=run.number,
            at=run.received_at,
        )
        if done is None:
            return False
        values, empty_slots = done
        count, name, at, trigger = len(values), self._name, run.received_at, run.trigger_time
        latency = None if math.isnan(run.latency) else run.latency
        results = [
            Result(name, run.application, None, number, trigger, at, latency, raw, value)
            for number, raw, value in zip(
                range(run.number, run.next), run.payloads, values, strict=True
            )
        ]
        self._counters.skip(empty_slots)
        self._counters.count("streamed", count)
        self._listeners.offer_burst(results, now, run.size)
        return True

    def _interpret(self, run: ResultRun, interpretation: Interpretation) -> Result:
        at = run.received_at
        value, sequence, empty_slots = interpreted(run, interpretation, self._name, at)
        if empty_slots:
            self._counters.skip(empty_slots)
        return as_result(run, self._name, value, sequence, at)

    def _wrong_application_error(self, run: ResultRun, expected: int) -> WrongApplicationError:
        return WrongApplicationError(
            f"{self._name}: a result of application {run.application} came, "
            f"application {expected} was expected",
            expected=expected,
            got=run.application,
        )


def _things(kind: str, reply: BusMessage) -> list[Any]:
    if kind == "states":
        return [state(blob) for blob in reply.blobs]
    return decode_runs(reply.blobs[0], "results that were asked for").runs


def _ignore(_count: int, _then: StateMessage | None) -> None:
    """Ignore missed states: the next one has the camera's state."""
