"""Decide to which trigger a result belongs, since the wire carries no correlation.

A container is a trigger's result only where what the camera says shows that it took this trigger
(:class:`TriggerEvidence` and the classes behind it). That nothing speaks against it is not enough.

Where every status is told (TCP, all dialects but ``bid``), a Query goes out in front of the trigger
and one behind it, in the same write. The camera does one message after the other and says things in
order (inferred). Waiting for Trigger goes away whenever an inspection begins, and Overtriggered
rises whenever a trigger is dropped (a status comes after every change: SC manual p. 29, published).
So where exactly one inspection begins between the two answers, and Overtriggered was clear all the
time, that inspection is the trigger's. Its results come behind its beginning and before the next
one's. Where two begin, nobody can tell whose each is.

Where the status has to be asked for (``bid``), the trigger itself is answered, which is the fence:
what comes before that is older. The status is asked for in front of the trigger and behind it, in
the same write: the first one has to say that the camera waits for a trigger, the second one that it
has dropped none, which it would say until it is reset.

Where the layout of the trigger has an ``@sequence`` field, the number has to be right, too: it is
set with Set sequence number right before the trigger.

A trigger that was given up leaves a *debt*; the next trigger settles it first
(:meth:`~smartcam._client.triggering.Triggers.trigger`). Only what comes after the inspection of the
trigger that was given up began pays it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from smartcam.models import Status

Debt = Literal["late", "streamed"]

NUMBER_STEP = 1000
"""Step by which each trigger's number is lower than the number of the trigger before.

Runs that somebody else triggers in between count up from our number, away from the next one.
"""

FEWEST_NUMBERS = 64
"""Triggers at least before the numbers of a narrow field repeat; its step is made smaller."""

RANGE_OF_FIRST_NUMBER = (1 << 31) - 1
"""Count of the numbers from which a new client draws its first one at random."""

MAX_OWED = 1024
"""Given-up triggers that are remembered; an older one's result counts as streamed."""


class TriggerEvidence:
    """Evidence that the camera took one trigger; this class is for cameras that give no evidence.

    That is so over UDP, where statuses and their order may be lost, and where commands are done
    one after the other, so that an answer needs no proof (In-Sight).

    Attributes:
        began: number of inspections that were seen to begin and may belong to the trigger. Where
            every status is reported and ``proven`` is True, the first one does.
        reached: True if whatever comes now is not older than the trigger.
        proven: True if the camera took this trigger, as far as can be known.
        doubtful: True if it can no longer be known which trigger the camera took.
    """

    __slots__ = ("began", "doubtful", "proven", "reached")

    def __init__(self) -> None:
        self.began = 0
        self.reached = self.proven = True
        self.doubtful = False

    def on_query_answer(self) -> None:
        """Note that a Query which was written with the trigger is answered."""

    def on_trigger_answer(self) -> None:
        """Note that the trigger itself is answered: the camera has heard it."""

    def on_status(self, status: int) -> None:
        """Note a status."""

    def take_round(self) -> bool:
        """Note all that comes of a trigger at once; False where each is to be noted by itself."""
        return False

    def on_beginning(self) -> bool:
        """Note that an inspection began; return True if it may be the trigger's."""
        self.began += 1
        return self.began == 1


class EvidenceByAcknowledgement(TriggerEvidence):
    """Evidence of a camera that answers each trigger which it takes: what came before is older."""

    __slots__ = ()

    def __init__(self) -> None:
        super().__init__()
        self.reached = self.proven = False

    def on_trigger_answer(self) -> None:
        """Note that the camera has taken the trigger."""
        self.reached = self.proven = True


class EvidenceByFence(TriggerEvidence):
    """Evidence without statuses: whatever comes before the Query's answer is older.

    That shows nothing of what comes behind it, which is why it has to be asked for.
    """

    __slots__ = ()

    def __init__(self) -> None:
        super().__init__()
        self.reached = False

    def on_query_answer(self) -> None:
        """Note that the camera has taken the Query in front of the trigger."""
        self.reached = True


class EvidenceByStatus(TriggerEvidence):
    """Evidence by every status, in order: the inspections between two Queries are counted.

    A camera that answers the second Query before it shows an inspection is believed: what it shows
    next is the trigger's.
    """

    __slots__ = ("_answers",)

    def __init__(self) -> None:  # without its base's: each trigger makes one
        self.began = 0
        self.reached = self.proven = self.doubtful = False
        self._answers = 0  # to the Queries in front of the trigger and behind it

    def on_query_answer(self) -> None:
        """Note an answer; at the second one, exactly one inspection has begun, or one will."""
        self._answers += 1
        self.proven = self._answers == 2 and self.began > 0

    def on_beginning(self) -> bool:
        """Count the inspection; two between the answers cannot be told apart."""
        if not self._answers:
            return False
        self.began += 1
        self.reached = self.began == 1
        if self._answers == 2:
            self.proven = True
        else:
            self.doubtful = self.began > 1
        return self.reached

    def take_round(self) -> bool:
        """Note an answer, the beginning of an inspection and the other answer, if none came yet."""
        if self._answers or self.began:
            return False
        self._answers, self.began, self.reached, self.proven = 2, 1, True, True
        return True


class EvidenceByAnswer(TriggerEvidence):
    """Evidence by the trigger's answer and the statuses asked for around it (``bid`` over TCP)."""

    __slots__ = ("_queried", "_waited")

    def __init__(self) -> None:
        super().__init__()
        self.reached = self.proven = False
        self._queried = False
        # whether the camera waits for a trigger, by the first status after the Query's answer
        self._waited: bool | None = None

    def on_query_answer(self) -> None:
        """Note that the next status was asked for in front of the trigger, or is as fresh."""
        self._queried = True

    def on_trigger_answer(self) -> None:
        """Take the trigger's answer: earlier containers are older; a busy camera leaves a doubt."""
        self.reached = True
        self.doubtful = not self._waited

    def on_status(self, status: int) -> None:
        """See whether the camera waited for the trigger, and that it has dropped none."""
        if self.reached:
            if status & _OVERTRIGGERED:
                self.doubtful = True
            else:
                self.proven = True
        elif self._queried and self._waited is None:
            self._waited = status & (_WAITING | _OVERTRIGGERED) == _WAITING


@dataclass(slots=True, eq=False)
class SentTrigger:
    """The trigger under way.

    Attributes:
        wanted: how many results it is to have.
        number: sequence number set for it, None if its layout has none.
        evidence: what the camera has said of it.
        came: how many of its results came.
        early: containers that came before the camera showed that it had taken it.
        given_up: what it still misses is owed.
        ended: nobody waits for it any more.
    """

    wanted: int
    number: int | None
    evidence: TriggerEvidence
    came: int = field(init=False, default=0)
    early: int = field(init=False, default=0)
    given_up: bool = field(init=False, default=False)
    ended: bool = field(init=False, default=False)


@dataclass(frozen=True, slots=True)
class Match:
    """The trigger to which a container belongs, if any.

    Attributes:
        fate: ``triggered``: of the trigger under way; ``late`` or ``streamed``: of one that was
            given up; ``nobody``: of none of ours.
        extra: True for one more result of a trigger that has all its results.
    """

    fate: Literal["triggered", "late", "streamed", "nobody"]
    extra: bool = False


OURS = Match("triggered")
NOBODYS, EXTRA = Match("nobody"), Match("nobody", extra=True)

_WAITING, _RUNNING = int(Status.WAITING_FOR_TRIGGER), int(Status.RUNNING)
_OVERTRIGGERED = int(Status.OVERTRIGGERED)


@dataclass(slots=True, eq=False)
class _Owed:
    """Results of a trigger that was given up, which may still come."""

    fate: Debt
    number: int | None
    missing: int
    evidence: TriggerEvidence


class Correlation:
    """Decides whose each container is; knows no wire and no time.

    Args:
        chance: where the numbers begin, 0 to 1, drawn by chance: results that another client has
            asked for may still be in flight, and their numbers lie elsewhere most probably.

    Attributes:
        pending: the trigger under way.
        satisfied: the last trigger has its results, and no other inspection was seen since.
        owed: results of triggers that were given up, which may still come; the oldest first.
        doubted: the status may be older than the last trigger, which was given up: it may say that
            the camera waits for one although it has one.
    """

    def __init__(self, chance: float) -> None:
        self.pending: SentTrigger | None = None
        self.doubted: bool = False
        self._complete = False  # every status is told, in order
        self.satisfied: bool = False
        # evidence of the last trigger, until it has its results
        self._last: TriggerEvidence | None = None
        self.owed: list[_Owed] = []
        # debts by the triggers' numbers; their results are late whenever they come
        self._given_up: dict[int, Debt] = {}
        self._last_number: int | None = None  # number of the last trigger that had its results
        self._turn = int(chance * RANGE_OF_FIRST_NUMBER)
        self._given: int | None = None

    @property
    def debt(self) -> Debt | None:
        """Fate of the result of an earlier trigger that may still come."""
        return self.owed[0].fate if self.owed else None

    # ------------------------------------------------------------------ the session

    def begin_session(self, *, complete: bool) -> None:
        """Begin on a new link: what earlier triggers owe may still come over it.

        Args:
            complete: every change of the status is told, in order.
        """
        self._complete = complete
        self.satisfied = self.doubted = False
        self._last = None
        for one in self.owed:  # whether it began may have been told to nobody
            one.evidence = TriggerEvidence()
            one.evidence.began = 1

    def settled(self) -> None:
        """Note that no older result can come, since the application was stopped."""
        self.owed.clear()
        self.satisfied = self.doubted = False
        self._last = None

    def heard(self) -> None:
        """Note that everything said before now is heard, since a later Query is answered.

        A trigger that would have shown by now, and has not, was not taken: nothing of it comes.
        """
        self.doubted = False
        if self._complete:
            self.owed = [one for one in self.owed if one.evidence.began]
            self._last = None

    # ------------------------------------------------------------------ the trigger

    def take_number(self, highest: int) -> int:
        """Return the next trigger's number: the one that the user has set, or ours.

        Args:
            highest: largest number that the field holds.
        """
        given, self._given = self._given, None
        used = given is None or given in self._given_up or given == self._last_number
        if given is not None and given <= highest and not used:
            return given
        step = min(NUMBER_STEP, (highest + 1) // FEWEST_NUMBERS)
        self._turn -= step
        return self._turn % (highest + 1)

    def give_number(self, number: int) -> None:
        """Note that the user has set the number of the next run."""
        self._given = number

    def send(self, pending: SentTrigger) -> None:
        """Note that a trigger is sent now."""
        self.pending, self.satisfied = pending, False
        self._last = pending.evidence
        if pending.number is None:
            self._given = None  # its run has it

    def leave(self) -> None:
        """Note that the trigger's caller goes on."""
        self.pending = None

    def done(self, pending: SentTrigger) -> None:
        """Note that the trigger has all its results."""
        self.satisfied, self._last_number = True, pending.number
        self._last = None

    def give_up(self, pending: SentTrigger, fate: Debt = "late", *, unread: int = 0) -> None:
        """Nobody waits for the trigger any more; its results may still come.

        Args:
            pending: the trigger.
            fate: fate of the results that still come.
            unread: containers of it that came and could not be interpreted.
        """
        came = pending.came if pending.evidence.proven else 0  # they may be somebody else's
        missing = pending.wanted - came - unread
        if pending.given_up or missing <= 0:
            return
        pending.given_up = True
        self.doubted = self.doubted or not pending.evidence.began
        self.owed.append(_Owed(fate, pending.number, missing, pending.evidence))
        del self.owed[:-MAX_OWED]
        if pending.number is not None:
            self._given_up[pending.number] = fate
            if len(self._given_up) > MAX_OWED:
                del self._given_up[next(iter(self._given_up))]

    # ------------------------------------------------------------------ what comes

    def on_query_answer(self) -> None:
        """Note that a Query which was written with the last trigger is answered."""
        if self._last is not None:
            self._last.on_query_answer()

    def on_trigger_answer(self) -> None:
        """Note that the last trigger itself is answered, and was not refused."""
        if self._last is not None:
            self._last.on_trigger_answer()

    def take_round(self, pending: SentTrigger) -> bool:
        """Note two answers, and one inspection between them; False where more is to be judged.

        That is where something has come of the trigger already, or is owed from before, or where
        its evidence is another one. A container behind the inspection is this trigger's then.
        """
        evidence = pending.evidence
        if not self._complete or self.owed or self._last is not evidence:
            return False
        if not evidence.take_round():
            return False
        self.doubted = False
        return True

    def on_status(self, previous: int | None, status: int) -> bool:
        """Note where an inspection begins: Waiting for Trigger drops while running.

        Args:
            previous: the status before, None if there was none in this session.
            status: the new one.

        Returns:
            Whether it is one that somebody else has triggered.
        """
        last = self._last
        if last is not None:
            last.on_status(status)
        if status & _WAITING or not status & _RUNNING:
            return False
        if previous is not None and not previous & _WAITING:
            return False
        if last is not None and last.on_beginning():
            self.doubted = False
            return False
        self.satisfied = False
        self._given = None  # that run has it
        return self._complete and previous is not None

    def judge_told(self, asked: bool) -> Match:
        """Return the same where the wire says whether a trigger of this client was answered."""
        pending = self.pending
        if not asked:
            return NOBODYS
        if pending is not None and not pending.ended:
            return OURS if pending.came < pending.wanted else EXTRA
        return Match(self._pay(self.owed[:1]))

    def judge(self, number: int | None) -> Match:
        """Return the trigger that a container of the right application belongs to.

        Args:
            number: sequence number of the container, None if the container has none or no trigger
                of ours waits.
        """
        pending = self.pending
        if pending is not None and not pending.ended:
            numbered = number is not None and pending.number is not None
            if not numbered or number == pending.number:
                if pending.evidence.reached:
                    return OURS if pending.came < pending.wanted else EXTRA
                if not pending.evidence.began:
                    pending.early += 1
        return self.judge_older(number)

    def judge_older(self, number: int | None) -> Match:
        """Say the same of one that is known not to be of the trigger under way."""
        if number is not None and number in self._given_up:
            self._pay([one for one in self.owed if one.number == number])
            return Match(self._given_up[number])
        if number is not None and number == self._last_number:
            return EXTRA
        # a number that is none of ours may be that of a trigger that was sent without one
        if self.owed:
            open_ = [
                one
                for one in self.owed
                if (number is None or one.number is None) and self._may_pay(one.evidence)
            ]
            if open_:
                return Match(self._pay(open_))
        return EXTRA if self.satisfied and number is None else NOBODYS

    def _may_pay(self, run: TriggerEvidence) -> bool:
        """Return True if a container that comes now may be from a run that has begun."""
        return bool(run.began) or (run.reached and not self._complete)

    def _pay(self, owed: list[_Owed]) -> Debt:
        """Note that one result of the first of these debts has come."""
        if not owed:
            return "late"
        owed[0].missing -= 1
        if owed[0].missing == 0:
            self.owed.remove(owed[0])
        return owed[0].fate
