"""The client of the interleavings: the library's own ``Results``, which can be copied.

Real are :class:`~smartcam._client.results.Results` with its correlation, counters and deadline, the
camera's state, the layout that reads a container, and the future that the caller of a trigger
awaits. Played are the few lines of ``Triggers`` around it, since a coroutine cannot be copied: what
it does when its trigger is sent, and when it is woken.
"""

from __future__ import annotations

import asyncio
import contextlib
import copyreg
import functools
import io
import pickle
import struct
from collections.abc import Callable, Iterator
from contextvars import Context
from datetime import UTC, datetime
from typing import Any, Literal, NamedTuple, TypeVar, TypeVarTuple

from smartcam import Status
from smartcam._client._inside import (
    CameraState,
    ClientCounters,
    DeadlineTimer,
    Interpretation,
    Listeners,
)
from smartcam.exceptions import CameraBusyError
from smartcam.models import Result
from smartcam.observers import Observers
from smartcam.protocols import messages as m
from tests.client.inside import (
    Correlation,
    EvidenceByAnswer,
    EvidenceByRoundTrip,
    EvidenceByStatus,
    PendingTrigger,
    Results,
    TriggerEvidence,
)

APPLICATION = 5
NOW, DEADLINE = 0.0, 1.0
"""Loop times: of all that happens, and of a trigger's deadline."""

AT = datetime(2026, 1, 1, tzinfo=UTC)
NO_STATUSES: frozenset[object] = frozenset()

Family = Literal["status", "answer", "round trip", "nothing"]
Shared = TypeVar("Shared")
Arguments = TypeVarTuple("Arguments")

EVIDENCE: dict[Family, type[TriggerEvidence]] = {
    "status": EvidenceByStatus,
    "answer": EvidenceByAnswer,
    "round trip": EvidenceByRoundTrip,
    "nothing": TriggerEvidence,
}
FIELDS = {8: ("uint8", "B"), 16: ("uint16", "H"), 32: ("int32", "i")}
"""Of a number, by its bits: the layout's type, and that of ``struct``."""


class Container(NamedTuple):
    """A result on its way.

    Attributes:
        whose: the trigger that began its run.
        written: how many triggers the client had written when the run began.
        number: sequence number of the run.
    """

    whose: int
    written: int
    number: int


# ---------------------------------------------------------------------- what all copies share

_SHARED: dict[int, object] = {}
_PARTS: dict[type, Any] = dict(copyreg.dispatch_table)
"""Functions that take objects to pieces, by the class."""


def share(one: Shared) -> Shared:
    """Have all copies share an object, which never changes, or whose changes do not matter."""
    _SHARED[id(one)] = one
    _PARTS[type(one)] = _parts_of_shared
    return one


def _parts_of_shared(one: object) -> tuple[Any, tuple[int]]:
    return _shared, (id(one),)


def _shared(one: int) -> object:
    return _SHARED[one]


LISTENERS = share(Listeners("camera", Observers()))
COUNTERS = share(ClientCounters())
"""It is only looked at what one step adds."""


@functools.cache
def reading(bits: int, *, numbered: bool) -> Interpretation:
    """Return how containers are read."""
    number = f"number: {FIELDS[bits][0]}{' @sequence' if numbered else ''}"
    layout = f"whose: int32, written: int32, {number}"
    return share(Interpretation(layout, lenient=False, y_down=False))


class StillLoop(asyncio.BaseEventLoop):
    """An event loop in which no time passes and nothing is called by itself."""

    def time(self) -> float:
        """Return the time that it always is."""
        return NOW

    def is_closed(self) -> bool:
        """Return True: it has nothing that is to be closed."""
        return True

    def call_at(
        self,
        when: float,
        callback: Callable[[*Arguments], object],
        *args: *Arguments,
        context: Context | None = None,
    ) -> asyncio.TimerHandle:
        """Return a timer that does not go off by itself."""
        return asyncio.TimerHandle(when, callback, args, self, context)

    def call_exception_handler(self, context: dict[str, Any]) -> None:
        """Let go of an outcome that nobody has looked at: there are many in copies."""


LOOP = StillLoop()


@contextlib.contextmanager
def time_stands_still() -> Iterator[None]:
    """Have the loop in which no time passes be the one that runs."""
    before = asyncio._get_running_loop()
    asyncio._set_running_loop(LOOP)
    try:
        yield
    finally:
        asyncio._set_running_loop(before)


# ---------------------------------------------------------------------- copies


def _outcome(ended: str, what: Any) -> asyncio.Future[Any]:
    outcome = LOOP.create_future()
    if ended == "cancelled":
        outcome.cancel()
    elif ended == "failed":
        outcome.set_exception(what)
    elif ended == "done":
        outcome.set_result(what)
    return outcome


def _outcome_parts(outcome: asyncio.Future[Any]) -> tuple[Any, tuple[str, Any]]:
    if not outcome.done():
        return _outcome, ("", None)
    if outcome.cancelled():
        return _outcome, ("cancelled", None)
    error = outcome.exception()
    if error is not None:
        return _outcome, ("failed", error)
    return _outcome, ("done", outcome.result())


_PARTS[asyncio.Future] = _outcome_parts


def freeze(world: object) -> bytes:
    """Return a copy, which :func:`thaw` makes as often as it is asked for.

    All copies share what never changes (:func:`share`).
    """
    into = io.BytesIO()
    pickler = pickle.Pickler(into, 5)
    pickler.dispatch_table = _PARTS
    pickler.dump(world)
    return into.getvalue()


def thaw(frozen: bytes) -> Any:
    """Return what was frozen, anew."""
    return pickle.loads(frozen)  # noqa: S301 - made by freeze


# ---------------------------------------------------------------------- the client


class Client:
    """The library's own results in a session, and what ``Triggers`` does around them.

    Args:
        family: what shows that a trigger was taken.
        bits: of the number in a container.
        numbered: the layout says that it is one.
        kind: of results; another one to see that its fault is found.
    """

    def __init__(
        self, family: Family, *, bits: int, numbered: bool, kind: type[Results] = Results
    ) -> None:
        self.family: Family = family
        self.bits = bits
        self.state = CameraState("camera", APPLICATION, LISTENERS)
        self.state.set_active(APPLICATION, AT)
        self.results = kind(
            "camera", reading(bits, numbered=numbered), self.state, LISTENERS, COUNTERS
        )
        self.results.correlation = Correlation(first_number_share=0.5)
        self.results.begin_session(
            keeps_order=family != "nothing", gets_every_status=family == "status"
        )
        self.results._warned_extra = self.results._warned_others = True  # in each copy anew

    # The timer has a callback of its results, so they are put together anew in each copy.

    def __getstate__(self) -> tuple[Any, ...]:
        results = self.results
        parts = {key: value for key, value in vars(results).items() if key != "_timer"}
        return self.family, self.bits, self.state, type(results), parts, results._timer._deadline

    def __setstate__(self, parts: tuple[Any, ...]) -> None:
        self.family, self.bits, self.state, kind, attributes, deadline = parts
        self.results = results = kind.__new__(kind)
        vars(results).update(attributes)
        results._timer = DeadlineTimer(lambda: results.give_up(TimeoutError()))
        results._timer._deadline = deadline

    @property
    def correlation(self) -> Correlation:
        """The part that says whose each container is."""
        return self.results.correlation

    @property
    def pending(self) -> PendingTrigger | None:
        """The trigger under way, whose caller may have to be woken."""
        return self.results._pending

    @property
    def status(self) -> Status:
        """The last one that came."""
        return Status(self.state.bits)

    # -- what the client does

    def take_number(self) -> int | None:
        """Return the number of the next trigger, None where the layout has none."""
        numbering = self.results.interpretation.numbering(APPLICATION)
        return None if numbering is None else self.correlation.take_number(numbering.highest)

    def send(self, number: int | None, wanted: int) -> None:
        """Begin to wait for a trigger's results, as ``Triggers`` does before it sends it."""
        pending = PendingTrigger(
            wanted,
            number,
            EVIDENCE[self.family](),
            LOOP.create_future(),
            self.results.interpretation,
            False,
            NOW,
            AT,
            APPLICATION,
            [],
        )
        self.results.begin_trigger(pending, DEADLINE)

    def time_out(self) -> None:
        """The deadline of the trigger under way is reached."""
        self.results._timer._on_timer()

    def cancel(self) -> None:
        """The task that awaits the trigger is cancelled; it was not woken yet."""
        assert self.pending is not None
        self.pending.outcome.cancel()

    def wake(self) -> None:
        """The caller of the trigger is woken, as in ``Triggers``; its outcome is there."""
        pending = self.pending
        assert pending is not None
        outcome = pending.outcome
        if outcome.cancelled() or isinstance(outcome.exception(), TimeoutError):
            self.correlation.give_up(pending)
        self.results.end_trigger()

    # -- what comes

    def answer(self) -> None:
        """A Query that was written with the trigger is answered."""
        self.results.on_trigger_query_answer(NOW)

    def trigger_answer(self) -> None:
        """The trigger itself is answered: it was heard."""
        self.results.on_trigger_answer(NOW)

    def refusal(self) -> None:
        """The trigger is answered by a code that says that it was not taken."""
        pending = self.pending
        if pending is not None and not pending.outcome.done():
            pending.fail(CameraBusyError())

    def hear(self, status: Status) -> None:
        """A status comes."""
        previous = self.state.note_status(m.StatusReport(status=status), NO_STATUSES)
        self.results.on_status(previous, self.state.bits, NOW)

    def result(self, container: Container) -> None:
        """A container comes."""
        data = struct.pack(self._form, *container)
        message = m.ResultContainer(application=APPLICATION, data=data)
        self.results.on_result(message, NOW, AT)

    @property
    def returned(self) -> list[Container] | None:
        """The value that wakes the caller of the trigger, or None."""
        outcome = self.pending.outcome if self.pending is not None else None
        if outcome is None or not outcome.done() or outcome.cancelled() or outcome.exception():
            return None
        results: list[Result] = outcome.result()
        return [Container(*struct.unpack(self._form, one.raw)) for one in results]

    @property
    def _form(self) -> str:
        return f"<ii{FIELDS[self.bits][1]}"

    # -- what tells it from others

    @property
    def waiting(self) -> list[Any]:
        """Containers that came and have no fate yet, wherever they are kept."""
        kept = [value for value in vars(self.results).values() if isinstance(value, list)]
        kept += [self.pending.unproven] if self.pending is not None else []
        return [one for some in kept for one in some]

    @property
    def accounted(self) -> int:
        """Containers that have a fate, of all copies, and those that wait for theirs here."""
        return COUNTERS.received + len(self.waiting)

    def key(self) -> object:
        """Return what tells its state from others."""
        at, pending = self.correlation, self.pending
        known: list[TriggerEvidence] = []

        def of(evidence: TriggerEvidence | None) -> int:
            if evidence is None:
                return -1
            if evidence not in known:
                known.append(evidence)
            return known.index(evidence)

        call: object = None
        if pending is not None:
            outcome = pending.outcome
            ended = outcome.done() and (
                "cancelled" if outcome.cancelled() else type(outcome.exception()).__name__
            )
            call = (
                *(pending.number, of(pending.evidence), pending.received, pending.given_up),
                *(pending.ended, ended, tuple(one.raw for one in pending.results)),
            )
        waiting = tuple((one.data, fate, number) for one, fate, number, *_ in self.waiting)
        owed = tuple((one.fate, one.number, one.missing_count, of(one.evidence)) for one in at.owed)
        last = of(at._last)
        evidence = tuple(
            (
                *(min(one.begin_count, 2), one.takes_containers, one.proven, one.doubtful),
                *(getattr(one, name) for name in type(one).__slots__ if name.startswith("_")),
            )
            for one in known
        )
        memory = (
            last,
            evidence,
            at.status_may_be_old,
            at.satisfied,
            at._last_number,
            at._last_own_number,
            at._user_number,
        )
        given_up = tuple(at._given_up_fates.items())
        numbered = self.results._number_reader is not None
        return self.state._last_status, numbered, call, waiting, owed, memory, given_up
