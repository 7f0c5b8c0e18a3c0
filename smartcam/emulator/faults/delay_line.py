"""Parcels on their way: in order, each when it is time. It knows no socket."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

from smartcam.emulator.clock import NANOSECONDS, OneTimer

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.emulator.clock import Clock
    from smartcam.emulator.faults.wire_effects import Ending, Parcel

__all__ = ["Conveyor", "Piece"]


class Piece(NamedTuple):
    """What of a parcel passes now."""

    parcel: Parcel
    data: bytes


class _Waiting:
    """A parcel that has not passed yet.

    Attributes:
        due: when it may pass, nanoseconds.
        missing: messages it waits for.
        until: when it waits for them no longer, nanoseconds.
        company: what has come for it, where there is no order.
    """

    __slots__ = ("company", "due", "missing", "parcel", "until")

    def __init__(self, parcel: Parcel, now: int) -> None:
        self.parcel = parcel
        self.due = now + _ns(parcel.delay)
        self.missing, seconds = parcel.gather or (0, 0.0)
        self.until = self.due + _ns(seconds)
        self.company: list[Parcel] = []

    @property
    def when(self) -> int:
        """When it passes if nothing more comes, nanoseconds."""
        return self.until if self.missing > 0 else self.due


def _ns(seconds: float) -> int:
    return round(seconds * NANOSECONDS)


class Conveyor:
    """One direction of one link.

    :meth:`put` the parcels of a message, then :meth:`run`. What passes is handed to ``carry``.

    Args:
        clock: whose time counts.
        ordered: nothing passes what waits before it, unless it may be overtaken; what passes at one
            time is carried together (TCP). Otherwise each part goes for itself (UDP).
        wake: called when it is time to :meth:`run`.
        carry: takes what passes, in one write.
        end: does to the connection what a parcel says.
        lost: told of each parcel that was under way when the conveyor was closed.
    """

    def __init__(
        self,
        clock: Clock,
        *,
        ordered: bool,
        wake: Callable[[], None],
        carry: Callable[[list[Piece]], None],
        end: Callable[[Ending], None],
        lost: Callable[[Parcel], None],
    ) -> None:
        self.size: int = 0
        """Bytes on it."""
        self._clock = clock
        self._ordered = ordered
        self._carry = carry
        self._end = end
        self._lost = lost
        self._queue: deque[_Waiting] = deque()
        self._loose: list[_Waiting] = []
        self._timer = OneTimer(clock, wake)
        self._running = False

    @property
    def idle(self) -> bool:
        """Whether nothing is on it."""
        return not self._queue and not self._loose

    def put(self, parcels: list[Parcel]) -> None:
        """Take the parcels of one message; :meth:`run` next."""
        gatherer = self._count_message()
        now = self._now
        for parcel in parcels:
            self.size += parcel.size
            if gatherer is not None and not parcel.delay:
                gatherer.company.append(parcel)
            elif self._ordered and not parcel.overtaken:
                self._queue.append(_Waiting(parcel, now))
            else:
                self._loose.append(_Waiting(parcel, now))

    def run(self) -> None:
        """Let everything pass for which it is time."""
        if self._running:
            return
        self._running = True
        try:
            self._run_loose()
            self._run_queue()
        finally:
            self._running = False
        self._arm()

    def close(self) -> None:
        """Drop what is on it; nothing passes any more. Harmless when done twice."""
        self._timer.set(None)
        self.size = 0
        left = [*self._queue, *self._loose]
        self._queue.clear()
        self._loose.clear()
        for waiting in left:
            for parcel in (waiting.parcel, *waiting.company):
                self._lost(parcel)

    @property
    def _now(self) -> int:
        return _ns(self._clock.now)

    def _count_message(self) -> _Waiting | None:
        """Count a message for those that wait for some; return the one that it goes with."""
        waiting = [one for one in (*self._queue, *self._loose) if one.missing > 0]
        for one in waiting:
            one.missing -= 1
        return waiting[0] if waiting and not self._ordered else None

    def _run_loose(self) -> None:
        """Let pass what may be overtaken: behind the queue, or at once where there is no order."""
        now = self._now
        due = sorted((one for one in self._loose if one.when <= now), key=lambda one: one.when)
        for one in due:
            if one not in self._loose:  # closed meanwhile
                return
            if self._ordered:
                self._loose.remove(one)
                self._queue.append(one)
            else:
                self._pass_datagrams(one)

    def _pass_datagrams(self, one: _Waiting) -> None:
        """Let the parts pass that are due, one datagram each; with company all are one."""
        parcel = one.parcel
        if parcel.gather is not None:
            self._loose.remove(one)
            together = [parcel, *one.company]
            self._hand_over([self._piece(each, whole=True) for each in together])
            for each in together:
                self._finish(each)
            return
        while one in self._loose and one.due <= self._now:
            self._hand_over([self._piece(parcel)])
            if parcel.parts:
                one.due = self._now + _ns(parcel.pauses.pop(0))
            elif one in self._loose:
                self._loose.remove(one)
                self._finish(parcel)

    def _run_queue(self) -> None:
        batch: list[Piece] = []
        while self._queue and self._queue[0].when <= self._now:
            one = self._queue[0]
            one.missing = 0
            parcel = one.parcel
            batch.append(self._piece(parcel))
            if parcel.parts:
                one.due = self._now + _ns(parcel.pauses.pop(0))
                batch = self._hand_over(batch)
                continue
            self._queue.popleft()
            if parcel.end is not None:
                batch = self._hand_over(batch)
                self._finish(parcel)
        self._hand_over(batch)

    def _piece(self, parcel: Parcel, *, whole: bool = False) -> Piece:
        data = parcel.take()
        while whole and parcel.parts:
            data += parcel.take()
        self.size -= len(data)
        parcel.passed += data
        return Piece(parcel, data)

    def _hand_over(self, batch: list[Piece]) -> list[Piece]:
        """Carry a batch and return an empty one."""
        if batch:
            self._carry(batch)
        return []

    def _finish(self, parcel: Parcel) -> None:
        if parcel.end is not None:
            self._end(parcel.end)

    def _arm(self) -> None:
        """Set the timer for what passes next."""
        waiting = [*list(self._queue)[:1], *self._loose]
        self._timer.set(min((one.when for one in waiting), default=None))
