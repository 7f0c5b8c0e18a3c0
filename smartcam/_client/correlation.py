"""Decide to which trigger a result belongs, since the wire carries no correlation.

A container is a trigger's result only if the camera's messages show that the camera accepted this
trigger (:class:`TriggerEvidence` and its subclasses). Messages that merely do not contradict are
not enough.

If every status is sent (TCP, all dialects but ``bid``), one Query is sent before the trigger and
one after it, in the same write. The camera handles one message after the other and sends in order
(inferred). Waiting for Trigger falls whenever an inspection begins, and Overtriggered rises
whenever a trigger is dropped (a status comes after every change: SC manual p. 29, published).
So if exactly one inspection begins between the two answers, and Overtriggered was clear during
that time, the inspection is the trigger's. Its results come after its beginning and before the next
inspection's. If two inspections begin, the trigger's cannot be identified.

If the status must be requested (``bid``), the camera answers the trigger itself, and containers
before this answer are older. The status is requested before the trigger and after it, in
the same write: the first status must show that the camera waits for a trigger, the second that it
has dropped none, since that bit stays until it is reset.

If the layout of the trigger has an ``@sequence`` field, the number must be right, too. The client
sets it by Set sequence number right before the trigger.

A trigger that was given up leaves an *owed* result. The next trigger waits for this result, or
makes it impossible (:meth:`~smartcam._client.triggering.Triggers.trigger`). Only a container after
the beginning of the given-up trigger's inspection can be the owed result.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from smartcam.models import Status

OwedFate = Literal["late", "streamed"]
"""Fate as which a given-up trigger's result is counted; streams get the result in both cases."""

NUMBER_STEP = 1000
"""Step by which each trigger's number is lower than the number of the trigger before.

Inspections that others trigger meanwhile count up from this number, away from the next one.
"""

FEWEST_NUMBERS = 64
"""Least number of triggers until numbers repeat; in a field of few bits the step is smaller."""

RANGE_OF_FIRST_NUMBER = (1 << 31) - 1
"""Number of values from which a new client draws its first number at random."""

MAX_OWED = 1024
"""Largest number of remembered given-up triggers; results of older ones count as streamed."""


class TriggerEvidence:
    """Evidence that the camera accepted a trigger; this base class takes it for granted.

    It is for UDP, where statuses and their order may be lost, and for cameras that handle commands
    one after the other, so that an answer needs no proof (In-Sight).

    Attributes:
        begin_count: number of observed beginnings of inspections that may belong to the trigger. If
            the client gets every status and ``proven`` is True, the first inspection is the
            trigger's.
        takes_containers: True if containers that arrive now count as the trigger's: none of them
            can be older than the trigger.
        proven: True if the messages prove that the camera accepted this trigger.
        doubtful: True if the messages can no longer show which trigger the camera accepted.
    """

    __slots__ = ("begin_count", "doubtful", "proven", "takes_containers")

    def __init__(self) -> None:
        self.begin_count = 0
        self.takes_containers = self.proven = True
        self.doubtful = False

    def on_trigger_query_answer(self) -> None:
        """Record that a Query that was sent with the trigger is answered."""

    def on_trigger_answer(self) -> None:
        """Record that the trigger is answered: the camera has received it."""

    def on_status(self, status: int) -> None:
        """Record a status."""

    def note_exchange(self) -> bool:
        """Record a trigger's usual messages together; return False to record each one singly."""
        return False

    def on_beginning(self) -> bool:
        """Record that an inspection began; return True if it may be the trigger's."""
        self.begin_count += 1
        return self.begin_count == 1


class EvidenceByAcknowledgement(TriggerEvidence):
    """Evidence of a camera that answers each accepted trigger: earlier containers are older."""

    __slots__ = ()

    def __init__(self) -> None:
        super().__init__()
        self.takes_containers = self.proven = False

    def on_trigger_answer(self) -> None:
        """Record that the camera has accepted the trigger."""
        self.takes_containers = self.proven = True


class EvidenceByRoundTrip(TriggerEvidence):
    """Evidence without statuses: containers before the Query's answer are older.

    About containers after the answer it shows nothing.
    """

    __slots__ = ()

    def __init__(self) -> None:
        super().__init__()
        self.takes_containers = False

    def on_trigger_query_answer(self) -> None:
        """Record that the camera has answered the Query before the trigger."""
        self.takes_containers = True


class EvidenceByStatus(TriggerEvidence):
    """Evidence by every status, in order: the inspections between two Queries are counted.

    If a camera answers the second Query before it shows an inspection, the next inspection that it
    shows is the trigger's.
    """

    __slots__ = ("_answer_count",)

    def __init__(self) -> None:  # does not call the base's, to be fast: each trigger makes one
        self.begin_count = 0
        self.takes_containers = self.proven = self.doubtful = False
        self._answer_count = 0  # answers to the Queries before the trigger and after it

    def on_trigger_query_answer(self) -> None:
        """Record an answer; the second one completes the count of inspections between both."""
        self._answer_count += 1
        self.proven = self._answer_count == 2 and self.begin_count > 0

    def on_beginning(self) -> bool:
        """Count the inspection; if two begin between the answers, the trigger's is not known."""
        if not self._answer_count:
            return False
        self.begin_count += 1
        self.takes_containers = self.begin_count == 1
        if self._answer_count == 2:
            self.proven = True
        else:
            self.doubtful = self.begin_count > 1
        return self.takes_containers

    def note_exchange(self) -> bool:
        """Record both Queries' answers and one inspection between them, if none was noted yet."""
        if self._answer_count or self.begin_count:
            return False
        self._answer_count, self.begin_count, self.takes_containers, self.proven = 2, 1, True, True
        return True


class EvidenceByAnswer(TriggerEvidence):
    """Evidence by the trigger's answer and the requested statuses around it (``bid`` over TCP)."""

    __slots__ = ("_query_answered", "_waited_before")

    def __init__(self) -> None:
        super().__init__()
        self.takes_containers = self.proven = False
        self._query_answered = False
        # whether the camera waited for a trigger, by the first status after the Query's answer
        self._waited_before: bool | None = None

    def on_trigger_query_answer(self) -> None:
        """Record that the next status shows the camera's state before the trigger."""
        self._query_answered = True

    def on_trigger_answer(self) -> None:
        """Record the trigger's answer; if the camera is busy, the trigger stays doubtful."""
        self.takes_containers = True
        self.doubtful = not self._waited_before

    def on_status(self, status: int) -> None:
        """Check that the camera waited for the trigger, and dropped no trigger."""
        if self.takes_containers:
            if status & _OVERTRIGGERED:
                self.doubtful = True
            else:
                self.proven = True
        elif self._query_answered and self._waited_before is None:
            self._waited_before = status & (_WAITING | _OVERTRIGGERED) == _WAITING


@dataclass(slots=True, eq=False)
class SentTrigger:
    """A trigger that was sent.

    Attributes:
        wanted: number of results expected.
        number: sequence number set for the trigger, None if its layout has none.
        evidence: evidence from the camera's messages.
        received: number of its received results.
        early_count: containers received before the camera showed that it had accepted the trigger.
        given_up: True if the trigger was given up; its missing results are owed.
        ended: True if its caller no longer waits.
    """

    wanted: int
    number: int | None
    evidence: TriggerEvidence
    received: int = field(init=False, default=0)
    early_count: int = field(init=False, default=0)
    given_up: bool = field(init=False, default=False)
    ended: bool = field(init=False, default=False)


@dataclass(frozen=True, slots=True)
class Match:
    """The trigger to which a container belongs, if any.

    Attributes:
        fate: ``triggered``: result of the running trigger; ``late`` or ``streamed``: result of a
            given-up trigger; ``nobody``: result of no trigger of this client.
        extra: True for a further result of a trigger that has all its results.
    """

    fate: Literal["triggered", "late", "streamed", "nobody"]
    extra: bool = False


OURS = Match("triggered")
NOBODYS, EXTRA = Match("nobody"), Match("nobody", extra=True)

_WAITING, _RUNNING = int(Status.WAITING_FOR_TRIGGER), int(Status.RUNNING)
_OVERTRIGGERED = int(Status.OVERTRIGGERED)


@dataclass(slots=True, eq=False)
class _Owed:
    """Results of a given-up trigger, which may still arrive."""

    fate: OwedFate
    number: int | None
    missing_count: int
    evidence: TriggerEvidence


class Correlation:
    """Decides to which trigger each container belongs, without I/O and time.

    Args:
        first_number_share: random number, 0 to 1, from which the first sequence number is made, so
            that results of another client most probably have other numbers.

    Attributes:
        pending: the running trigger.
        satisfied: whether the last trigger has its results, and no inspection has begun since.
        owed: results of given-up triggers, which may still arrive; the oldest first.
        status_may_be_old: whether the status may be older than the last trigger, which was given
            up. Then the status may show that the camera waits although it is inspecting.
    """

    def __init__(self, first_number_share: float) -> None:
        self.pending: SentTrigger | None = None
        self.status_may_be_old: bool = False
        self._gets_every_status = False  # whether every status is sent, in order
        self.satisfied: bool = False
        # evidence of the last trigger, until it has its results
        self._last: TriggerEvidence | None = None
        self.owed: list[_Owed] = []
        # fates of given-up triggers' results, by the triggers' numbers; kept until MAX_OWED
        self._given_up_fates: dict[int, OwedFate] = {}
        self._last_number: int | None = None  # number of the last trigger that had its results
        self._last_own_number = int(first_number_share * RANGE_OF_FIRST_NUMBER)
        self._user_number: int | None = None

    @property
    def owed_fate(self) -> OwedFate | None:
        """Fate of the oldest owed result; None if no result is owed."""
        return self.owed[0].fate if self.owed else None

    # ------------------------------------------------------------------ the session

    def begin_session(self, *, gets_every_status: bool) -> None:
        """Begin a session; owed results of earlier triggers may still arrive in it.

        Args:
            gets_every_status: True if every change of the status is sent, in order.
        """
        self._gets_every_status = gets_every_status
        self.satisfied = self.status_may_be_old = False
        self._last = None
        for owed in self.owed:  # the status with its inspection's beginning may have been lost
            owed.evidence = TriggerEvidence()
            owed.evidence.begin_count = 1

    def forget_owed(self) -> None:
        """Forget owed results, since none can arrive: the application was stopped or replaced."""
        self.owed.clear()
        self.satisfied = self.status_may_be_old = False
        self._last = None

    def note_query_answered(self) -> None:
        """Record that a Query is answered, so that all messages of earlier triggers are received.

        An earlier trigger without a sign of an inspection was not accepted: it has no result.
        """
        self.status_may_be_old = False
        if self._gets_every_status:
            self.owed = [owed for owed in self.owed if owed.evidence.begin_count]
            self._last = None

    # ------------------------------------------------------------------ the trigger

    def take_number(self, highest: int) -> int:
        """Return the next trigger's number: the one that the user has set, or the client's own.

        Args:
            highest: largest number that the field holds.
        """
        user_number, self._user_number = self._user_number, None
        used = (
            user_number is None
            or user_number in self._given_up_fates
            or user_number == self._last_number
        )
        if user_number is not None and user_number <= highest and not used:
            return user_number
        step = min(NUMBER_STEP, (highest + 1) // FEWEST_NUMBERS)
        self._last_own_number -= step
        return self._last_own_number % (highest + 1)

    def set_next_number(self, number: int) -> None:
        """Record that the user has set the number of the next inspection."""
        self._user_number = number

    def begin_trigger(self, pending: SentTrigger) -> None:
        """Record that a trigger is sent."""
        self.pending, self.satisfied = pending, False
        self._last = pending.evidence
        if pending.number is None:
            self._user_number = None  # the trigger's inspection uses it

    def end_trigger(self) -> None:
        """Record that the trigger's caller no longer waits."""
        self.pending = None

    def complete(self, pending: SentTrigger) -> None:
        """Record that the trigger has all its results."""
        self.satisfied, self._last_number = True, pending.number
        self._last = None

    def give_up(self, pending: SentTrigger, fate: OwedFate = "late", *, unread: int = 0) -> None:
        """Record that the caller no longer waits for the trigger, whose results may still arrive.

        Args:
            pending: the trigger.
            fate: fate of results that arrive later.
            unread: number of its containers that could not be interpreted.
        """
        # without evidence the received results may belong to another trigger
        received = pending.received if pending.evidence.proven else 0
        missing_count = pending.wanted - received - unread
        if pending.given_up or missing_count <= 0:
            return
        pending.given_up = True
        self.status_may_be_old = self.status_may_be_old or not pending.evidence.begin_count
        self.owed.append(_Owed(fate, pending.number, missing_count, pending.evidence))
        del self.owed[:-MAX_OWED]
        if pending.number is not None:
            self._given_up_fates[pending.number] = fate
            if len(self._given_up_fates) > MAX_OWED:
                del self._given_up_fates[next(iter(self._given_up_fates))]

    # ------------------------------------------------------------------ received messages

    def on_trigger_query_answer(self) -> None:
        """Record that a Query that was sent with the last trigger is answered."""
        if self._last is not None:
            self._last.on_trigger_query_answer()

    def on_trigger_answer(self) -> None:
        """Record that the last trigger was acknowledged."""
        if self._last is not None:
            self._last.on_trigger_answer()

    def note_exchange(self, pending: SentTrigger) -> bool:
        """Record two answers and one inspection between them; return False if this is not possible.

        It is not possible if the trigger already has a result, if an earlier result is owed, or if
        the evidence is of another kind. After True, the inspection's container is this trigger's.
        """
        evidence = pending.evidence
        if not self._gets_every_status or self.owed or self._last is not evidence:
            return False
        if not evidence.note_exchange():
            return False
        self.status_may_be_old = False
        return True

    def on_status(self, previous: int | None, status: int) -> bool:
        """Record the beginning of an inspection: Waiting for Trigger falls while running.

        Args:
            previous: the status before, None if there was none in this session.
            status: the new status.

        Returns:
            True if the inspection was triggered by others.
        """
        last = self._last
        if last is not None:
            last.on_status(status)
        if status & _WAITING or not status & _RUNNING:
            return False
        if previous is not None and not previous & _WAITING:
            return False
        if last is not None and last.on_beginning():
            self.status_may_be_old = False
            return False
        self.satisfied = False
        self._user_number = None  # the inspection uses the number
        return self._gets_every_status and previous is not None

    def judge_requested(self, is_ours: bool) -> Match:
        """Return the trigger of a container that shows whether this client requested it."""
        pending = self.pending
        if not is_ours:
            return NOBODYS
        if pending is not None and not pending.ended:
            return OURS if pending.received < pending.wanted else EXTRA
        return Match(self._count_owed(self.owed[:1]))

    def judge(self, number: int | None) -> Match:
        """Return the trigger that a container of the right application belongs to.

        Args:
            number: sequence number of the container, None if the container has none, or no trigger
                waits.
        """
        pending = self.pending
        if pending is not None and not pending.ended:
            numbered = number is not None and pending.number is not None
            if not numbered or number == pending.number:
                if pending.evidence.takes_containers:
                    return OURS if pending.received < pending.wanted else EXTRA
                if not pending.evidence.begin_count:
                    pending.early_count += 1
        return self.judge_older(number)

    def judge_older(self, number: int | None) -> Match:
        """Return the trigger of a container that does not belong to the running trigger."""
        if number is not None and number in self._given_up_fates:
            self._count_owed([owed for owed in self.owed if owed.number == number])
            return Match(self._given_up_fates[number])
        if number is not None and number == self._last_number:
            return EXTRA
        # an unknown number may belong to a trigger that was sent without a number
        if self.owed:
            candidates = [
                owed
                for owed in self.owed
                if (number is None or owed.number is None) and self._may_be_owed(owed.evidence)
            ]
            if candidates:
                return Match(self._count_owed(candidates))
        return EXTRA if self.satisfied and number is None else NOBODYS

    def _may_be_owed(self, evidence: TriggerEvidence) -> bool:
        """Return True if a container that arrives now may be a result of a given-up trigger."""
        return bool(evidence.begin_count) or (
            evidence.takes_containers and not self._gets_every_status
        )

    def _count_owed(self, owed: list[_Owed]) -> OwedFate:
        """Record that the first of these owed results has arrived, and return its fate."""
        if not owed:
            return "late"
        owed[0].missing_count -= 1
        if owed[0].missing_count == 0:
            self.owed.remove(owed[0])
        return owed[0].fate
