"""Whose result is it? The wire carries no correlation; this is what stands in for it.

A trigger has a *fence* in front of it, in the same write: a Query. The camera does one message
after the other and says things in order (inferred), so what comes before the fence's answer is
older than the trigger. Behind it, an inspection of the trigger's begins with Waiting for Trigger
going away, as at each trigger that is taken (a status comes after every change: SC manual p. 29,
published); a container that comes before that is none of its. Where the status has to be asked for
(``bid``), one behind the answer to the trigger confirms that it was taken, before its results are
told. So what another inspection says that began before the trigger was sent is never taken for the
trigger's, whoever began it.

Where the layout of the trigger has an ``@sequence`` field, the number decides as well: it was set
with Set sequence number right before the trigger, and only the container that carries it is its
result. A wide number of our own needs neither fence nor drop; one that somebody else's run may
carry, since it is narrow or the user's own, does.

A trigger that was given up leaves a *debt*; the next trigger settles it first
(:meth:`~smartcam._client.triggering.Triggers.trigger`). Only what comes behind the fence of the
trigger that was given up, and after its inspection began, pays it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from smartcam.models import Status

Debt = Literal["late", "streamed"]

NUMBER_STEP = 1000
"""Distance of the numbers of two triggers, downwards: runs that somebody else triggers in between
count up from ours, away from the next of ours."""

FEWEST_NUMBERS = 64
"""Triggers until a narrow field's numbers begin again; its step is smaller for that."""

WIDE = (1 << 31) - 1
"""Largest number of a field that is wide enough: nobody else's run carries ours by chance."""

MAX_OWED = 1024
"""Given-up triggers that are remembered; an older one's result counts as streamed."""


@dataclass(slots=True, eq=False)
class Progress:
    """How far the camera is with a trigger, as far as is heard.

    Attributes:
        reached: the fence was answered: what came before is older than the trigger. True from the
            beginning where there is no fence.
        confirmed: nothing says that it was not taken, where a status behind its answer would.
        answered: that answer has come.
        begun: Waiting for Trigger has dropped behind the fence.
        over: it has dropped once more, for another inspection: what has no number is that one's.
        shown: it has to drop: the camera did not wait for a trigger at the fence.
    """

    reached: bool = True
    confirmed: bool = True
    answered: bool = False
    begun: bool = False
    over: bool = False
    shown: bool = False


@dataclass(slots=True, eq=False)
class SentTrigger:
    """The trigger under way.

    Attributes:
        wanted: how many results it is to have.
        number: sequence number set for it, None where its layout has none.
        certain: no run of others may carry its number.
        progress: how far the camera is with it.
        came: how many of its results came.
        early: containers that came before its fence was answered.
        given_up: what it still misses is owed.
        ended: nobody waits for it any more.
    """

    wanted: int
    number: int | None
    certain: bool
    progress: Progress
    came: int = field(init=False, default=0)
    early: int = field(init=False, default=0)
    given_up: bool = field(init=False, default=False)
    ended: bool = field(init=False, default=False)


@dataclass(frozen=True, slots=True)
class Match:
    """Whose a container is.

    Attributes:
        fate: ``triggered``: of the trigger under way; ``late`` or ``streamed``: of one that was
            given up; ``nobody``: of none of ours; ``held``: not known yet, see
            :meth:`Correlation.on_query_answer`.
        extra: of a trigger that has all its results.
    """

    fate: Literal["triggered", "late", "streamed", "nobody", "held"]
    extra: bool = False


OURS, HELD = Match("triggered"), Match("held")
NOBODYS, EXTRA = Match("nobody"), Match("nobody", extra=True)

_WAITING, _RUNNING = int(Status.WAITING_FOR_TRIGGER), int(Status.RUNNING)


@dataclass(slots=True, eq=False)
class _Owed:
    """Results of a trigger that was given up, which may still come."""

    fate: Debt
    number: int | None
    missing: int
    progress: Progress


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
        self._ordered = False
        self._drops_waiting: bool | None = None  # whether it shows a trigger; None: not known yet
        self.satisfied: bool = False
        self._last: Progress | None = None  # of the last trigger, until it has its results
        self.owed: list[_Owed] = []
        self._given_up: dict[int, Debt] = {}  # by number; their results are late whenever they come
        self._last_number: int | None = None  # of the last trigger that had its results
        self._turn = int(chance * WIDE)
        self._given: int | None = None

    @property
    def debt(self) -> Debt | None:
        """Fate of the result of an earlier trigger that may still come."""
        return self.owed[0].fate if self.owed else None

    # ------------------------------------------------------------------ the session

    def begin_session(self, *, ordered: bool) -> None:
        """A new link: what earlier triggers owe may still come over it."""
        self._ordered = ordered
        self.satisfied = self.doubted = False
        self._last = None
        for one in self.owed:  # whether it began may have been told to nobody
            one.progress = Progress(begun=True)

    def settled(self) -> None:
        """Nothing of before can come: the application was stopped, and all of that was heard."""
        self.owed.clear()
        self.satisfied = self.doubted = False
        self._last = None

    def heard(self) -> None:
        """All that the camera said before now is heard, a Query that was sent since is answered.

        A trigger that would have shown by now, and has not, was not taken: nothing of it comes.
        """
        self.doubted = False
        if self._ordered and self._drops_waiting:
            self.owed = [one for one in self.owed if one.progress.begun]
            self._last = None

    # ------------------------------------------------------------------ the trigger

    def take_number(self, highest: int) -> tuple[int, bool]:
        """Return the next trigger's number, and whether nobody else's run may carry it.

        It is the one that the user has set, or ours, 0 to ``highest``.
        """
        given, self._given = self._given, None
        used = given is None or given in self._given_up or given == self._last_number
        if given is not None and given <= highest and not used:
            return given, False
        step = min(NUMBER_STEP, (highest + 1) // FEWEST_NUMBERS)
        self._turn -= step
        return self._turn % (highest + 1), highest >= WIDE

    def give_number(self, number: int) -> None:
        """The user has set the number of the next run."""
        self._given = number

    def send(self, pending: SentTrigger) -> None:
        """A trigger is sent now."""
        self.pending, self.satisfied = pending, False
        self._last = pending.progress
        if pending.number is None:
            self._given = None  # its run has it

    def leave(self) -> None:
        """The trigger's caller goes on."""
        self.pending = None

    def done(self, pending: SentTrigger) -> None:
        """The trigger has all its results."""
        self.satisfied, self._last_number = True, pending.number
        self._last = None

    def give_up(self, pending: SentTrigger, fate: Debt = "late", *, unread: int = 0) -> None:
        """Nobody waits for the trigger any more; its results may still come.

        Args:
            pending: the trigger.
            fate: of what still comes.
            unread: containers of it that came and could not be interpreted.
        """
        missing = pending.wanted - pending.came - unread
        if pending.given_up or missing <= 0:
            return
        pending.given_up = True
        self.doubted = self.doubted or not pending.progress.begun
        self.owed.append(_Owed(fate, pending.number, missing, pending.progress))
        del self.owed[:-MAX_OWED]
        if pending.number is not None:
            self._given_up[pending.number] = fate
            if len(self._given_up) > MAX_OWED:
                del self._given_up[next(iter(self._given_up))]

    # ------------------------------------------------------------------ what comes

    def on_fence(self, status: int) -> None:
        """The Query in front of the last trigger is answered; the status is as it is now."""
        run = self._last
        if run is not None:
            run.reached, run.shown = True, self._ordered and not status & _WAITING

    def on_query_answer(self) -> None:
        """A Query is answered that was sent behind the last trigger.

        A camera that shows the trigger has done so by now. Of one that was never seen to, it is
        known now that it does not, and a container that was held for that is the trigger's.
        """
        run = self._last
        if run is not None and run.reached and not run.begun and self._drops_waiting is None:
            self._drops_waiting = False

    def on_answer(self) -> None:
        """The last trigger itself is answered; a status behind that confirms it."""
        if self._last is not None:
            self._last.answered = True

    def on_status(self, previous: int | None, status: int) -> bool:
        """Note where an inspection begins: Waiting for Trigger drops while running.

        Args:
            previous: the status before, None where there was none in this session.
            status: the new one.

        Returns:
            Whether it is one that somebody else has triggered.
        """
        last = self._last
        if last is not None and last.answered:
            last.confirmed = True
        if status & _WAITING or not status & _RUNNING:
            return False
        if previous is not None and not previous & _WAITING:
            return False
        if previous is not None:
            self._drops_waiting = True
        if last is not None and last.reached and not last.begun:
            last.begun = True
            self.doubted = False
            return False
        if last is not None and last.begun:
            last.over = self._ordered
        self.satisfied = False
        self._given = None  # that run has it
        return self._ordered and previous is not None

    def judge(self, number: int | None) -> Match:
        """Say whose a container of the right application is.

        Args:
            number: its sequence number, None where it has none or none of ours is about.
        """
        pending = self.pending
        if pending is not None and not pending.ended:
            if not pending.progress.reached:
                pending.early += 1
            elif pending.came == pending.wanted:
                pass  # all are there, and are still to be confirmed
            elif pending.certain and number is not None:
                if number == pending.number:
                    return OURS
            elif number is None or pending.number is None or number == pending.number:
                run = pending.progress
                known = number is not None and pending.number is not None
                if (
                    (run.begun and (known or not run.over))
                    or not self._ordered
                    or (self._drops_waiting is False and not run.shown)
                ):
                    return OURS
                if self._drops_waiting is None and not run.shown:
                    return HELD
        return self.judge_older(number)

    def _may_pay(self, run: Progress) -> bool:
        """Whether a container that comes now may be of a run: where it shows, it has begun."""
        shows = self._ordered and self._drops_waiting
        return run.begun or (run.reached and not run.shown and not shows)

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
                if (number is None or one.number is None) and self._may_pay(one.progress)
            ]
            if open_:
                return Match(self._pay(open_))
        return EXTRA if self.satisfied and number is None else NOBODYS

    def _pay(self, owed: list[_Owed]) -> Debt:
        """One result of the first of these has come."""
        if not owed:
            return "late"
        owed[0].missing -= 1
        if owed[0].missing == 0:
            self.owed.remove(owed[0])
        return owed[0].fate
