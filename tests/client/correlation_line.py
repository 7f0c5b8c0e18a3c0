"""A correlation with what the rest of the client does around it."""

from __future__ import annotations

from smartcam import Status
from tests.client.inside import (
    Correlation,
    EvidenceByAnswer,
    EvidenceByRoundTrip,
    EvidenceByStatus,
    Match,
    OwedFate,
    SentTrigger,
    TriggerEvidence,
)

READY = Status.RUNNING | Status.WAITING_FOR_TRIGGER
WORKING = Status.RUNNING

_FAILING = Status.OVERTRIGGERED
"""Bits whose rise ends a trigger; the fall of Running does, too."""


class Line:
    """A correlation with what the rest of the client does around it.

    Args:
        gets_every_status: every status comes, and in order.
        polled: statuses are asked for, triggers are answered (``bid`` over TCP).
        by_round_trip: a Query is sent before a trigger, which nothing shows
            (``shows_triggers=no``).
    """

    def __init__(
        self, *, gets_every_status: bool = True, polled: bool = False, by_round_trip: bool = False
    ) -> None:
        self.is_complete = gets_every_status
        self.is_polled = polled
        self.is_by_round_trip = by_round_trip
        self.at = Correlation(first_number_share=0.5)
        self.at.begin_session(gets_every_status=gets_every_status)
        self.status: Status | None = None
        self.open_queries = 0  # Queries that were written with the trigger and are not answered
        self.numbered = False  # a trigger had a number: a container's is read
        self.cancelled = False  # the trigger's caller, who was not woken yet
        self.doubts = 0  # triggers that ended since nobody can tell which one the camera took
        self.results: list[object] = []  # the containers of the trigger under way
        self.returned: list[object] = []  # those of the last trigger that had all of them
        self.judged: list[tuple[object, Match]] = []  # each container's fate, in order
        self.others = 0  # inspections that somebody else has triggered

    @property
    def pending(self) -> SentTrigger | None:
        return self.at.pending

    # -- what the client does

    def send(self, number: int | None = None, wanted: int = 1) -> SentTrigger:
        """Send a trigger; the Queries in front of it and behind it are not answered yet."""
        evidence = TriggerEvidence()
        if self.is_polled:
            evidence, self.open_queries = EvidenceByAnswer(), 1
        elif self.is_complete:
            evidence, self.open_queries = EvidenceByStatus(), 2
        elif self.is_by_round_trip:
            evidence, self.open_queries = EvidenceByRoundTrip(), 1
        pending = SentTrigger(wanted, number, evidence)
        self.numbered = self.numbered or number is not None
        self.results = []
        self.at.begin_trigger(pending)
        return pending

    def trigger(self, number: int | None = None, wanted: int = 1) -> SentTrigger:
        """Send a trigger; the Query in front of it is answered at once."""
        pending = self.send(number, wanted)
        self.answer()
        return pending

    def begin(self, number: int | None = None, wanted: int = 1) -> SentTrigger:
        """Send a trigger that the camera takes: Waiting drops between the two answers."""
        pending = self.trigger(number, wanted)
        self.hear(WORKING)
        self.answer()
        return pending

    def leave(self) -> None:
        """The caller of the trigger has been woken."""
        self.look()
        self.at.end_trigger()
        self.cancelled = False

    def cancel(self) -> None:
        """The trigger's caller is cancelled, which shows when it, or the client, looks."""
        self.cancelled = True

    def look(self) -> None:
        """The client looks at the trigger."""
        if self.cancelled and self.pending is not None and not self.pending.ended:
            self.fail("late")

    def fail(self, debt: OwedFate) -> None:
        """The trigger ends without its results; its caller was not woken yet."""
        assert self.pending is not None
        self.at.give_up(self.pending, debt)
        self.pending.ended = True

    def give_up(self, debt: OwedFate = "late") -> None:
        assert self.pending is not None
        self.at.give_up(self.pending, debt)
        self.leave()

    def reconnect(self) -> None:
        self.look()
        if self.pending is not None and not self.pending.ended:
            self.fail("late")
        self.open_queries = 0
        self.leave()
        self.at.begin_session(gets_every_status=self.is_complete)
        self.status = None

    # -- what comes

    def answer(self) -> None:
        """A Query that was written with the trigger is answered."""
        self.open_queries -= 1
        self.at.on_trigger_query_answer()
        self.decide()

    def trigger_answer(self) -> None:
        """The trigger itself is answered: it was heard."""
        self.at.on_trigger_answer()
        self.decide()

    def hear(self, *statuses: Status) -> None:
        for status in statuses:
            before, self.status = self.status, status
            was = before or Status(0)
            if (status & ~was) & _FAILING or (was & ~status) & Status.RUNNING:
                self.look()
                if self.pending is not None and not self.pending.ended:
                    self.fail("streamed")
            self.others += self.at.on_status(None if before is None else int(before), int(status))
            self.decide()

    def result(self, number: int | None = None, container: object = None) -> Match:
        """A container comes."""
        self.look()
        match = self.at.judge(number)
        self.judged.append((container, match))
        if match.fate == "triggered":
            assert self.pending is not None
            self.pending.received += 1
            self.results.append(container)
            self._complete()
        return match

    def decide(self) -> None:
        """End the trigger where what was said of it is enough for that."""
        self.look()
        if self.pending is None or self.pending.ended:
            return
        if self.pending.evidence.doubtful:
            self.doubts += 1
            self.fail("streamed")
        else:
            self._complete()

    def _complete(self) -> None:
        pending = self.pending
        assert pending is not None
        if pending.evidence.proven and pending.received == pending.wanted:
            self.at.complete(pending)
            pending.ended = True
            self.returned = self.results


def ready(*, gets_every_status: bool = True) -> Line:
    """A camera that waits for a trigger."""
    line = Line(gets_every_status=gets_every_status)
    line.hear(READY)
    return line


def after_one(*, gets_every_status: bool = True) -> Line:
    """A camera that waits again behind a trigger that had its result."""
    line = ready(gets_every_status=gets_every_status)
    line.send()
    if gets_every_status:
        line.answer()
        line.hear(WORKING)
        line.answer()
    line.result()
    line.leave()
    line.hear(READY)
    line.judged.clear()
    return line
