"""The short way of a trigger's usual answers gives what the long one gives, event for event.

Two clients get the same random triggers, questions, subscribers, ends and bytes. One takes what
came before as a whole (:meth:`Machine.buffer_updated`, :meth:`Machine.send_all`) and the usual
answers to a trigger in one step (``Dispatch._handle_usual_exchange``); the other one, which judges,
reads each frame by itself and hands on one event after the other. After each step everything that
either knows has to be the same: the bytes written, the events, what is owed, the camera's state,
the evidence, every account, every outcome, every subscriber's items.

Long form: ``python -m tests.client.proofs.straight --events 1000000 --seed 1``. It prints how many
deliveries took the short way, and ends with 1 at the first difference.
"""

from __future__ import annotations

import argparse
import dataclasses
import logging
import random
import struct
import sys
from collections import Counter
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Any

from smartcam._client._inside import CameraState, ClientCounters, Interpretation, Listeners
from smartcam.models import ApplicationChanged, Result, StatusChanged
from smartcam.observers import Observers
from smartcam.protocols import LinkFailed, Role, State, Transport
from smartcam.protocols import messages as m
from smartcam.protocols._inside import HANDBOOK
from smartcam.streams import Queue
from tests.client.camera_by_hand import (
    BUSY,
    CONNECT,
    GET_CLOCK,
    OVERHEAT,
    OVERTRIGGERED,
    QUERY,
    RESULT,
    RUNNING,
    STATUS,
    SYSTEM_ERROR,
    TRIGGER,
    WAITING,
    WIRES,
    words,
)
from tests.client.inside import (
    TRIGGER_BETWEEN_QUERIES,
    Chunk,
    Connection,
    Correlation,
    Dispatch,
    Doorbell,
    EvidenceByStatus,
    PendingTrigger,
    Requests,
    Results,
    StatusWaiter,
    Waits,
)
from tests.client.proofs.interleaved_client import LOOP, time_stands_still
from tests.protocols.frame_times import JudgingMachine, ShortMachine

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

APPLICATION, OTHER_APPLICATION = 5, 6
READY = RUNNING | WAITING
LAYOUT = "n: int32"
NUMBERED = "n: int32 @sequence"
AT = datetime(2026, 1, 1, tzinfo=UTC)
MAX_ITEMS = 8

frame = WIRES["handbook"].frame
_QUERY = m.Query()


class JudgingDispatch(Dispatch):
    """Hands on each event by itself."""

    def _handle_usual_exchange(self, events: list[Any], now: float, at: datetime) -> bool:
        return False


class ShortDispatch(Dispatch):
    """Counts the answers that it takes in one step."""

    taken = 0

    def _handle_usual_exchange(self, events: list[Any], now: float, at: datetime) -> bool:
        taken = super()._handle_usual_exchange(events, now, at)
        ShortDispatch.taken += taken
        return taken


class Client:
    """The receiving half of a client over TCP, and what a trigger does around it.

    Args:
        machine: kind of its machines.
        dispatch: kind of its dispatch.
        layout: how results are read.
        expected: the application that was named.
        shared: others use the camera, too.
    """

    def __init__(
        self,
        machine: type[ShortMachine | JudgingMachine],
        dispatch: type[Dispatch],
        *,
        layout: str,
        expected: int | None,
        shared: bool,
    ) -> None:
        self._machine_kind = machine
        self.bell = Doorbell(LOOP)
        self.listeners = Listeners("camera", Observers())
        self.counters = ClientCounters()
        self.state = CameraState("camera", expected, self.listeners, shared=shared)
        self.waits = Waits(self.counters)
        connection = Connection("camera", self.waits)
        requests = Requests(connection, self.waits, self.state, 1.0, 1.0)
        reading = Interpretation(layout, lenient=False, y_down=False)
        self.results = Results("camera", reading, self.state, self.listeners, self.counters)
        self.results.correlation = Correlation(first_number_share=0.5)
        self.dispatch = dispatch(
            *("camera", self.state, self.waits, self.results, self.listeners, requests),
            self.counters,
        )
        self.queues: list[Queue[Any]] = []
        self.awaited: list[Any] = []  # futures of callers
        self.written = b""
        self.outcomes: list[Any] = []
        self.events: list[Any] = []
        self.begin()

    def begin(self) -> None:
        """Begin a session."""
        self.machine = self._machine_kind(HANDBOOK, Role.CLIENT, Transport.TCP)
        self.frames = self.deliveries = 0
        self.dispatch.begin_session(HANDBOOK, keeps_order=True)
        self.counters.begin_session(self.machine.counters)
        self.machine.send(m.Connect())
        self.written += b"".join(self.machine.data_to_send())

    # -- what a caller does

    def trigger(self, wanted: int, application: int | None, *, has_input: bool) -> None:
        """Send a trigger, where one may be sent."""
        if self.results._pending is not None or self.waits.is_pending(m.QueryAnswer):
            return
        if self.machine.state is not State.CONNECTED:
            return
        numbering = self.results.interpretation.numbering(APPLICATION)
        correlation = self.results.correlation
        number = None if numbering is None else correlation.take_number(numbering.highest)
        reading, evidence = self.results.interpretation, EvidenceByStatus()
        pending = PendingTrigger(
            *(wanted, number, evidence, self.bell.make_future(), reading, has_input, 0.0, AT),
            application,
            [],
        )
        self.results.begin_trigger(pending, 1e9)
        self.machine.send_all(TRIGGER_BETWEEN_QUERIES)
        self.waits.expect_query_answers(2)
        self.written += b"".join(self.machine.data_to_send())

    def wake(self) -> None:
        """Have the caller of the trigger go on, as it does when there is an outcome."""
        pending = self.results._pending
        if pending is None or not pending.outcome.done():
            return
        outcome: Any = pending.outcome
        if outcome.cancelled() or isinstance(outcome.exception(), TimeoutError):
            self.results.correlation.give_up(pending)
        self.outcomes.append(_outcome(outcome))
        self.results.end_trigger()

    def cancel(self) -> None:
        """Cancel the task that awaits the trigger; it goes on later."""
        if self.results._pending is not None:
            self.results._pending.outcome.cancel()

    def ask(self, request: m.Request = _QUERY) -> None:
        """Send a request of a caller, where none of its kind is open."""
        answer = request.answer
        if self.machine.state is State.CONNECTED and answer and not self.waits.is_pending(answer):
            self.machine.send(request)
            owed = self.waits.expect_answer(
                answer, LOOP, LOOP.time(), after_delivery=self.deliveries
            )
            self.awaited.append(owed)
            self.written += b"".join(self.machine.data_to_send())

    def await_status(self, mask: int) -> None:
        """Wait for a status."""
        outcome: Any = LOOP.create_future()
        self.awaited.append(outcome)
        self.waits.status_waiters[StatusWaiter(lambda status: bool(status & mask), outcome)] = None

    def subscribe(self, what: str) -> None:
        """Subscribe to results, statuses or events."""
        if len(self.queues) < 2:
            queue: Queue[Any] = Queue(what, max_queue=MAX_ITEMS, overflow="drop_oldest")
            self.queues.append(queue)
            getattr(self.listeners, what).add(queue)

    def unsubscribe(self) -> None:
        """End every subscription."""
        for queue in self.queues:
            queue.close()
        self.queues.clear()

    def await_result(self) -> None:
        """Wait for the next result."""
        self.awaited.append(self.listeners.next_result())

    # -- what comes

    def hear(self, data: bytes, now: float) -> None:
        """Take bytes in one delivery."""
        room = self.machine.get_buffer()
        while data:
            some, data = data[: len(room)], data[len(room) :]
            room[: len(some)] = some
            if self.machine.buffer_updated(len(some), now):
                self._hand_on(now)
            room = self.machine.get_buffer()

    def _hand_on(self, now: float) -> None:
        self.events = self.machine.events()
        if not self.events:
            return
        received = self.machine.counters.frames_received
        frames, self.frames = received - self.frames, received
        self.deliveries += 1
        self.dispatch.dispatch(Chunk(now, self.events, frames, self.deliveries))
        if self.machine.state is State.FAILED:
            self.begin()

    # -- what it knows

    def known(self) -> Iterator[object]:
        """Yield all that it knows, without what is the same anyway."""
        machine, waits, results = self.machine, self.waits, self.results
        self.written = self.written[-128:]
        yield self.written
        yield machine.counters, machine.state, machine.buffered, machine.get_buffer().nbytes
        yield machine._pending_ids, self.frames, self.deliveries
        yield _parts(self.state, "_listeners")
        yield (
            [*waits.pending_answers],
            waits._last_delivery_before,
            waits.open_queries,
            len(waits.status_waiters),
        )
        correlation = results.correlation
        yield _parts(correlation, "pending", "_last", "owed")
        yield _slots(correlation._last)
        yield [
            (one.fate, one.number, one.missing_count, _slots(one.evidence))
            for one in correlation.owed
        ]
        pending = results._pending
        if pending is not None:
            yield pending.received, pending.early_count, pending.given_up, pending.ended
            yield len(pending.unproven), [*map(_told, pending.results)], _slots(pending.evidence)
            yield _outcome(pending.outcome)
        yield results.input_in_doubt, results._warned_extra, results._warned_others
        yield self.counters.fates, self.counters.received, self.counters.extra_results
        yield self.counters.overtriggers, self.counters.inspections_by_others
        yield self.counters.processing._counts, self.counters.processing._total
        yield self.counters.round_trip._counts
        yield [(queue.statistics(), [*map(_told, queue._items)]) for queue in self.queues]
        yield [*map(_outcome, self.awaited)], self.outcomes[-2:]
        yield [*map(_told, self.events)]


def _parts(one: object, *without: str) -> dict[str, object]:
    return {name: value for name, value in vars(one).items() if name not in without}


def _slots(evidence: Any) -> object:
    if evidence is None:
        return None
    answers = getattr(evidence, "_answer_count", None)
    return (
        evidence.begin_count,
        evidence.takes_containers,
        evidence.proven,
        evidence.doubtful,
        answers,
    )


def _told(one: object) -> object:
    """Return an item without the moment by the wall clock, at which it was handed on."""
    if isinstance(one, Result):
        return one._replace(received_at=AT)
    if isinstance(one, (StatusChanged, ApplicationChanged)):
        return dataclasses.replace(one, at=AT)
    if isinstance(one, LinkFailed):
        one = one.error
    return str(one) if isinstance(one, Exception) else one


def _outcome(one: Any) -> object:
    if not one.done() or one.cancelled():
        return one.done()
    error = one.exception()
    if error is not None:
        return type(error), str(error)
    value = one.result()
    return [*map(_told, value)] if isinstance(value, list) else _told(value)


# ---------------------------------------------------------------------- what happens


def _status(bits: int, endian: int = 0) -> bytes:
    return frame(STATUS, words(bits, endian))


def _answer(application: int = APPLICATION) -> bytes:
    return frame(QUERY, words(application))


def _result(number: int, application: int = APPLICATION, more: bytes = b"") -> bytes:
    return frame(RESULT, words(application) + struct.pack("<i", number) + more)


class Chance:
    """A camera's words at random: mostly what is usual.

    Args:
        seed: of the random numbers.
    """

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)  # noqa: S311 - no secret
        self.number = 0
        self.rest = b""  # of a delivery that was torn

    def delivery(self) -> bytes:
        """Return the bytes of the next delivery."""
        chance, rest, self.rest = self.random, self.rest, b""
        told = self._round()
        if chance.random() < 0.15:
            self._spoil(told)
        while chance.random() < 0.05:
            told += self._round()
        data = rest + b"".join(told)
        if chance.random() < 0.05 and data:
            place = chance.randrange(len(data) + 1)
            data, self.rest = data[:place], data[place:]
        return data

    def _round(self) -> list[bytes]:
        self.number += 1
        dice = self.random.random
        endian = int(dice() < 0.03)
        began = _status(RUNNING, endian ^ (dice() < 0.02))
        ended = _status(READY, endian ^ (dice() < 0.02))
        of = OTHER_APPLICATION if dice() < 0.02 else APPLICATION
        told = [_answer(), began, _result(self.number % 100, of), ended, _answer()]
        kind = self.random.random()
        if kind < 0.1:  # the second answer comes before the result
            told = [_answer(), began, _answer(), _result(self.number), ended]
        elif kind < 0.2:
            del told[self.random.randrange(5) :]
        elif kind < 0.25:
            told = [began, _result(self.number), ended]
        return told

    def _spoil(self, told: list[bytes]) -> None:
        chance = self.random
        if not told:
            return
        place = chance.randrange(len(told))
        odd: list[Callable[[], bytes]] = [
            lambda: _status(chance.choice([0, BUSY, RUNNING, READY, RUNNING | BUSY])),
            lambda: _status(READY | chance.choice([OVERTRIGGERED, OVERHEAT, SYSTEM_ERROR])),
            lambda: _status(RUNNING | chance.choice([OVERTRIGGERED, OVERHEAT])),
            lambda: _status(chance.choice([RUNNING, READY]), endian=1),
            lambda: _answer(OTHER_APPLICATION),
            lambda: _result(self.number, OTHER_APPLICATION),
            lambda: _result(self.number, more=b"+"),
            lambda: _result(self.number, more=bytes(chance.randrange(3))),
            lambda: frame(0x77, b"odd"),
            lambda: frame(GET_CLOCK, words(*range(6))),
            lambda: frame(TRIGGER),
            lambda: frame(QUERY, words(APPLICATION) + b"surplus"),
        ]
        how = chance.random()
        if how < 0.5:
            told[place] = chance.choice(odd)()
        elif how < 0.6:
            del told[place]
        elif how < 0.7:
            told.insert(place, told[place])
        elif how < 0.8:
            other = chance.randrange(len(told))
            told[place], told[other] = told[other], told[place]
        elif how < 0.99:
            told.insert(place, chance.choice(odd)())
        else:
            told[place] = b"no frame at all."


Step = tuple[str, "Callable[[Client], object]"]
"""The name of an event, and a function that makes it happen to a client."""


def steps_of(chance: Chance) -> Iterator[Step]:
    """Yield what happens next: mostly a trigger, and what the camera says to it."""
    dice = chance.random
    if dice.random() < 0.6:
        wanted = 1 if dice.random() < 0.9 else 2
        application = dice.choice([APPLICATION, APPLICATION, None, None, None, OTHER_APPLICATION])
        has_input = dice.random() < 0.1
        yield (
            "trigger",
            partial(Client.trigger, wanted=wanted, application=application, has_input=has_input),
        )
    if dice.random() < 0.12:
        yield _beside(chance)
    if dice.random() < 0.8:
        data, now = chance.delivery(), dice.random()
        yield f"hear {data.hex()}", lambda client: client.hear(data, now)
    if dice.random() < 0.3:
        clock = frame(GET_CLOCK, words(*range(6)))
        yield "hear the clock", lambda client: client.hear(clock, 0.0)
    if dice.random() < 0.1:
        yield "unsubscribe", Client.unsubscribe
        yield "forget those who wait", lambda client: client.waits.status_waiters.clear()


def _beside(chance: Chance) -> Step:
    """Return what else a program does, or happens to it."""
    dice = chance.random
    few: Sequence[Step] = (
        ("cancel", Client.cancel),
        ("cancel", Client.cancel),
        ("time out", lambda client: client.results.give_up(TimeoutError())),
        ("ask", Client.ask),
        ("ask for the clock", partial(Client.ask, request=m.GetClock())),
        ("ask for the clock", partial(Client.ask, request=m.GetClock())),
        ("await a status", partial(Client.await_status, mask=dice.choice([0, WAITING, BUSY]))),
        ("await a result", Client.await_result),
        ("subscribe", partial(Client.subscribe, what=dice.choice(["results", "statuses"]))),
        ("subscribe", partial(Client.subscribe, what="results")),
        ("subscribe to events", partial(Client.subscribe, what="events")),
        ("session", Client.begin),
    )
    return dice.choice(few)


OPENING = (frame(CONNECT, words(1)), _status(READY), _answer())
WAYS: Sequence[dict[str, Any]] = (
    {"layout": LAYOUT, "expected": None, "shared": False},
    {"layout": LAYOUT, "expected": APPLICATION, "shared": False},
    {"layout": LAYOUT, "expected": None, "shared": True},
    {"layout": NUMBERED, "expected": None, "shared": False},
)


class DifferenceError(Exception):
    """The two clients do not know the same."""


def compare(
    events: int,
    seed: int,
    machine: type[ShortMachine] = ShortMachine,
    dispatch: type[ShortDispatch] = ShortDispatch,
) -> Counter[str]:
    """Have both clients go through at least so many events; return what came how often.

    Args:
        events: how many.
        seed: of the random numbers.
        machine: machine of the one with the short way; others to see that a fault is found.
        dispatch: dispatch of the same.

    Raises:
        DifferenceError: they differ, and behind which step.
    """
    counts: Counter[str] = Counter()
    ShortMachine.taken = ShortDispatch.taken = 0
    with time_stands_still():
        number = 0
        while counts["events"] < events:
            chance = Chance(seed * 1_000_003 + number)
            way = WAYS[number % len(WAYS)]
            judge = Client(JudgingMachine, JudgingDispatch, **way)
            _compare_one(Client(machine, dispatch, **way), judge, chance, counts)
            number += 1
    counts["deliveries known"], counts["triggers at once"] = ShortMachine.taken, ShortDispatch.taken
    return counts


STEPS = 400
"""Steps with the same two clients."""


def _compare_one(short: Client, judge: Client, chance: Chance, counts: Counter[str]) -> None:
    both = (short, judge)
    _open(both, chance)
    told: list[str] = []
    for _ in range(STEPS):
        for name, do in steps_of(chance):
            told.append(name)
            for client in both:
                do(client)
            if name == "session":
                _open(both, chance)
            _see_same(short, judge, told)
            if name.startswith("hear"):
                counts["deliveries"] += 1
                counts["events"] += len(short.events)
        sleeps = chance.random.random() < 0.2  # the caller is woken later
        for client in both:
            if not sleeps:
                client.wake()
            client.awaited = [one for one in client.awaited if not one.done()]
        stuck = short.waits.open_queries if short.results._pending is None else 0
        if stuck and chance.random.random() < 0.8:  # the answers that are missing come, too
            for client in both:
                client.hear(chance.rest + _answer() * stuck, 0.0)
            chance.rest = b""
        elif stuck or short.machine.state is not State.CONNECTED:
            for client in both:
                client.begin()
            _open(both, chance)
        _see_same(short, judge, told)
        counts["steps"] += 1
    counts["outcomes"] += len(short.outcomes)


def _open(both: Sequence[Client], chance: Chance) -> None:
    """Begin the session of both; now and then the camera says less than it should."""
    chance.rest = b""
    for client in both:
        client.hear(b"".join(OPENING), 0.0)
    if chance.random.random() < 0.1:
        for client in both:
            client.dispatch.begin_session(HANDBOOK, keeps_order=True)  # all told is forgotten


def _see_same(short: Client, judge: Client, told: list[str]) -> None:
    for one, other in zip(short.known(), judge.known(), strict=True):
        if one != other:
            raise DifferenceError(f"{one}\nthe judge: {other}\nbehind {told[-3:]}")


def main() -> int:
    """Compare both, and tell what was compared."""
    parser = argparse.ArgumentParser(description="Compare the short way with the long one.")
    parser.add_argument("--events", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    logging.disable()  # what cameras say at random is worth many warnings
    try:
        counts = compare(options.events, options.seed)
    except DifferenceError as error:
        sys.stdout.write(f"seed {options.seed}: different: {error}\n")
        return 1
    sys.stdout.write(f"seed {options.seed}, no difference\n")
    for name, count in sorted(counts.items()):
        sys.stdout.write(f"{count:>9} {name}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
