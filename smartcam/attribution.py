"""Whose result is it? The wire carries no correlation; this is what stands in for it.

Where the layout of the trigger under way has an ``@sequence`` field, the number decides: it was set
with Set sequence number right before the trigger, and only the container that carries it is its
result. Without it, what comes after a trigger is its result, unless it is known to be older:

* A camera that was seen to drop Waiting for Trigger at a trigger does so at each (a status comes
  after every change: SC manual p. 29, published), so what comes before it drops is older. On TCP
  only, where no status is lost.
* A trigger that was given up leaves a *debt*; the next trigger settles it first
  (:meth:`~smartcam.triggering.Triggers.trigger`).
* An inspection that somebody else triggered may still have a result in flight when the camera waits
  again; then :attr:`Attribution.unsettled` asks for a fence before the next trigger.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NamedTuple

from smartcam.models import Result, Status

if TYPE_CHECKING:
    import asyncio
    from datetime import datetime

    from smartcam.interpretation import Interpretation

__all__ = ["NUMBER_STEP", "Attribution", "Debt", "PendingTrigger", "Verdict"]

Debt = Literal["late", "streamed"]

NUMBER_STEP = 1000
"""Distance of the numbers of two triggers: runs that somebody else triggers in between count on
from ours by one, and do not reach the next of ours."""

FEWEST_NUMBERS = 64
"""Triggers until a narrow field's numbers begin again; its step is smaller for that."""

MAX_OWED = 1024
"""Given-up triggers that are remembered; an older one's result counts as streamed."""


@dataclass(slots=True)
class PendingTrigger:
    """The trigger under way.

    Attributes:
        outcome: gets the results or the error.
        interpretation: how to read its results.
        has_input: input data was sent with it.
        sent_at: loop time.
        triggered_at: wall clock, UTC.
        wanted: how many results it is to have.
        number: sequence number set for it, None where its layout has none.
        application: the one that is believed to be active, None where any will do.
        results: those that came.
        dropped_waiting: Waiting for Trigger has dropped since it was sent.
        given_up: nobody waits for it any more.
    """

    outcome: asyncio.Future[list[Result]]
    interpretation: Interpretation
    has_input: bool
    sent_at: float
    triggered_at: datetime
    wanted: int = 1
    number: int | None = None
    application: int | None = None
    results: list[Result] = field(default_factory=list[Result])
    dropped_waiting: bool = False
    given_up: bool = False


class Verdict(NamedTuple):
    """Whose a container is.

    Attributes:
        fate: ``triggered``: of the trigger under way; ``late`` or ``streamed``: of one that was
            given up; ``nobody``: of none of ours.
        extra: of a trigger that has all its results.
    """

    fate: Literal["triggered", "late", "streamed", "nobody"]
    extra: bool = False


OURS = Verdict("triggered")

_WAITING, _RUNNING = int(Status.WAITING_FOR_TRIGGER), int(Status.RUNNING)


@dataclass(slots=True, eq=False)
class _Owed:
    """Results of a trigger that was given up, which may still come."""

    fate: Debt
    number: int | None
    missing: int


class Attribution:
    """Decides whose each container is; knows no wire and no time.

    Attributes:
        pending: the trigger under way.
        unsettled: a result of somebody else's inspection may still be in flight.
        numbering: how to read a container's number while ours are about; None where none is.
    """

    def __init__(self) -> None:
        self.pending: PendingTrigger | None = None
        self.unsettled: bool = False
        self.numbering: Interpretation | None = None
        self._ordered = False
        self._drops_waiting = False  # the camera is known to show a trigger in its status
        self._satisfied = False  # the last trigger has its results, no other inspection was seen
        self._owed: list[_Owed] = []
        self._given_up: dict[int, Debt] = {}  # by number; their results are late whenever they come
        self._last_number: int | None = None  # of the last trigger that had its results
        # another client's numbers, perhaps still in flight, lie elsewhere most probably
        self._turn = random.randrange(1, 1 << 20)  # noqa: S311
        self._given: int | None = None

    @property
    def debt(self) -> Debt | None:
        """Fate of the result of an earlier trigger that may still come."""
        return self._owed[0].fate if self._owed else None

    @property
    def satisfied(self) -> bool:
        """The last trigger has its results, and no other inspection was seen since."""
        return self._satisfied

    @property
    def quiet(self) -> bool:
        """Nothing of ours is about: a container that comes is nobody's."""
        return self.pending is None and not self._owed and self.numbering is None

    # ------------------------------------------------------------------ the session

    def begin_session(self, *, ordered: bool) -> None:
        """A new link: what earlier triggers owe may still come over it."""
        self._ordered = ordered
        self._satisfied = self.unsettled = False

    def settled(self) -> None:
        """Nothing of before can come: the application was stopped, and all of that was heard."""
        self._owed.clear()
        self._satisfied = self.unsettled = False

    # ------------------------------------------------------------------ the trigger

    def take_number(self, highest: int) -> int:
        """Return the next trigger's number, 0 to ``highest``: the one the user has set, or ours."""
        given, self._given = self._given, None
        if given is not None and given <= highest and given not in self._given_up:
            return given
        self._turn += 1
        step = min(NUMBER_STEP, (highest + 1) // FEWEST_NUMBERS)
        return self._turn * step % (highest + 1)

    def give_number(self, number: int) -> None:
        """The user has set the number of the next run."""
        self._given = number

    def send(self, pending: PendingTrigger) -> None:
        """A trigger is sent now."""
        self.pending, self._satisfied = pending, False
        if pending.number is not None:
            self.numbering = pending.interpretation

    def done(self, pending: PendingTrigger) -> None:
        """The trigger has all its results."""
        self._satisfied, self._last_number = True, pending.number

    def give_up(self, pending: PendingTrigger, fate: Debt = "late", *, unread: int = 0) -> None:
        """Nobody waits for the trigger any more; its results may still come.

        Args:
            pending: the trigger.
            fate: of what still comes.
            unread: containers of it that came and could not be interpreted.
        """
        missing = pending.wanted - len(pending.results) - unread
        if pending.given_up or missing <= 0:
            return
        pending.given_up = True
        self._owed.append(_Owed(fate, pending.number, missing))
        del self._owed[:-MAX_OWED]
        if pending.number is not None:
            self._given_up[pending.number] = fate
            if len(self._given_up) > MAX_OWED:
                del self._given_up[next(iter(self._given_up))]

    # ------------------------------------------------------------------ what comes

    def on_status(self, previous: int | None, status: int) -> None:
        """Note where an inspection begins: Waiting for Trigger drops while running.

        Args:
            previous: the status before, None where there was none in this session.
            status: the new one.
        """
        if status & _WAITING or not status & _RUNNING:
            return
        if previous is not None and not previous & _WAITING:
            return
        self._drops_waiting = self._drops_waiting or previous is not None
        pending = self.pending
        if pending is not None and not pending.outcome.done():
            pending.dropped_waiting = True
        else:
            self._satisfied = False
            self.unsettled = self.debt is None  # else it is our own that was given up

    def judge(self, number: int | None) -> Verdict:
        """Say whose a container of the right application is.

        Args:
            number: its sequence number, None where it has none or none of ours is about.
        """
        pending = self.pending
        if pending is not None and not pending.outcome.done():
            if pending.number is None or number is None:
                if pending.dropped_waiting or not (self._ordered and self._drops_waiting):
                    return OURS
            elif number == pending.number:
                return OURS
        elif pending is not None and pending.outcome.cancelled():
            self.give_up(pending)  # its caller was not woken yet
        return self._judge_other(number)

    def _judge_other(self, number: int | None) -> Verdict:
        if number is not None and number in self._given_up:
            self._pay([one for one in self._owed if one.number == number])
            return Verdict(self._given_up[number])
        if number is not None and number == self._last_number:
            return Verdict("nobody", extra=True)
        # a number that is none of ours may be that of a trigger that was sent without one
        open_ = [one for one in self._owed if number is None or one.number is None]
        if open_:
            return Verdict(self._pay(open_))
        return Verdict("nobody", extra=self._satisfied and number is None)

    def _pay(self, owed: list[_Owed]) -> Debt:
        """One result of the first of these has come."""
        if not owed:
            return "late"
        owed[0].missing -= 1
        if owed[0].missing == 0:
            self._owed.remove(owed[0])
        return owed[0].fate
