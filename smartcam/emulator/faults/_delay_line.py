"""Transmissions on their way: in order, each when it is time. It knows no socket and no fault.

It is the engine of everything that holds back what passes a link: the emulator's faults give it
messages, the link proxy gives it bytes of a stream or datagrams.
"""

from __future__ import annotations

from collections import deque
from dataclasses import KW_ONLY, dataclass, field
from typing import TYPE_CHECKING, Generic, Literal, NamedTuple, TypeVar

from smartcam.emulator._clock import OneTimer, nanoseconds

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from smartcam.emulator._clock import Clock


class Ending(NamedTuple):
    """The end of a connection: its kind, its cause, and its time if it is half open."""

    # event; ``eof`` means that the sender has ended
    how: Literal["close", "reset", "stall", "half_open", "eof"]
    cause: str  # kind of the fault, or name of the rule, behind it
    # seconds that a half-open connection stays; None: as long as possible
    seconds: float | None = None


@dataclass(slots=True, eq=False)
class Transmission:
    """Something that passes a link, and how."""

    parts: list[bytes]  # bytes still to pass; each part is one write
    _: KW_ONLY
    pauses: list[float] = field(
        default_factory=list[float]
    )  # seconds before each part but the first
    delay: float = 0.0  # seconds before the first part
    overtaken: bool = False  # whether later parts may pass this one while it waits
    # number of following parts that it waits for, and the most seconds
    gather: tuple[int, float] | None = None
    # without an order: whether it goes after those parts and not together with them
    behind: bool = False
    end: Ending | None = None  # event of the connection after it
    faults: list[str] = field(
        default_factory=list[str]
    )  # kinds, or names of rules, that acted on it

    @property
    def size(self) -> int:
        """The number of bytes still to pass."""
        return sum(map(len, self.parts))

    def take(self) -> bytes:
        """Take the next part away."""
        return self.parts.pop(0) if self.parts else b""


T = TypeVar("T", bound=Transmission)


class _Waiting(Generic[T]):
    """A transmission that has not passed yet; ``missing`` is how much it still waits for."""

    __slots__ = ("company", "due", "missing", "paused", "sent", "turns", "until")

    def __init__(self, sent: T, now: int) -> None:
        self.sent = sent
        self.due = now + nanoseconds(sent.delay)  # when its next part may pass, nanoseconds
        self.missing, seconds = sent.gather or (0, 0.0)
        # when it waits for that no longer, nanoseconds
        self.until = self.due + nanoseconds(seconds)
        self.company: list[T] = []  # parts that have come for it, without an order
        self.paused = False  # whether a part has passed and the pause behind it has not begun
        self.turns = 0  # how often the timer has to go off before it passes

    @property
    def when(self) -> int:
        """Time at which the message passes if nothing more comes, nanoseconds."""
        return self.until if self.missing > 0 else self.due

    def pause(self, now: int, turns: int) -> None:
        """Begin the pause before the next part."""
        seconds = self.sent.pauses.pop(0)
        self.paused, self.due = False, now + nanoseconds(seconds)
        self.turns = 0 if seconds else turns


@dataclass(eq=False)
class DelayLine(Generic[T]):
    """One direction of one link.

    :meth:`put` what is to pass, then :meth:`run`. What passes is handed to ``carry``.
    """

    clock: Clock
    _: KW_ONLY
    # nothing passes what waits before it, unless it may be overtaken; what passes at one time is
    # carried together (TCP). Otherwise each part goes for itself (UDP)
    ordered: bool
    wake: Callable[[], None]  # called when it is time to run()
    # takes what passes, in one write: transmissions and the bytes of each; it may stop() the line
    carry: Callable[[list[tuple[T, bytes]]], None]
    end: Callable[[Ending], None]  # does to the connection what a transmission says
    lost: Callable[[T], None]  # told of each one that was under way when the line was closed
    turns: int = 0  # turns of the event loop that a pause of no time takes

    def __post_init__(self) -> None:
        self.size: int = 0  # bytes on it
        self.stopped: bool = False  # whether nothing passes until go_on()
        self._queue: deque[_Waiting[T]] = deque()
        self._loose: list[_Waiting[T]] = []
        self._timer = OneTimer(self.clock, self._tick)
        self._running = False

    def __len__(self) -> int:
        return len(self._queue) + len(self._loose)

    def put(self, sent: Iterable[T], amount: int = 1) -> None:
        """Take what a message has become; :meth:`run` next.

        It counts as ``amount`` for those that wait for what follows.
        """
        now = self._now
        gatherer = self._count(amount, now)
        for one in sent:
            self.size += one.size
            if gatherer is not None and not one.delay:
                gatherer.company.append(one)
            elif self.ordered and not one.overtaken:
                self._queue.append(_Waiting(one, now))
            else:
                self._loose.append(_Waiting(one, now))

    def run(self) -> None:
        """Let everything pass for which it is time."""
        if self._running or self.stopped:
            return
        self._running = True
        try:
            self._run_loose()
            self._run_queue()
        finally:
            self._running = False
        self._arm()

    def stop(self) -> None:
        """Let nothing pass, for the time being."""
        self.stopped = True
        self._timer.set(None)

    def go_on(self) -> None:
        """Let pass what waits, as :meth:`run`, also where it was stopped."""
        self.stopped = False
        self.run()

    def close(self) -> None:
        """Drop what is on it. Harmless when called twice."""
        self._timer.set(None)
        self.size = 0
        left = [*self._queue, *self._loose]
        self._queue.clear()
        self._loose.clear()
        for waiting in left:
            for one in (waiting.sent, *waiting.company):
                self.lost(one)

    @property
    def _now(self) -> int:
        return nanoseconds(self.clock.now)

    def _count(self, amount: int, now: int) -> _Waiting[T] | None:
        """Count what comes for those that wait for it; return the one that it goes with."""
        waiting = [one for one in (*self._queue, *self._loose) if one.missing > 0]
        for one in waiting:
            one.missing -= amount
            if one.sent.behind and one.missing <= 0:
                one.due = max(one.due, now)
        together = [one for one in waiting if not self.ordered and not one.sent.behind]
        return together[0] if together else None

    def _run_loose(self) -> None:
        """Let pass what may be overtaken: behind the queue, or at once where there is no order."""
        now = self._now
        due = [one for one in self._loose if one.when <= now]
        for one in sorted(due, key=lambda one: (one.when, one.sent.behind)):
            if one not in self._loose:  # closed meanwhile
                return
            if self.ordered:
                self._loose.remove(one)
                self._queue.append(one)
            else:
                self._pass_datagrams(one)

    def _pass_datagrams(self, one: _Waiting[T]) -> None:
        """Let the parts pass that are due, one datagram each; with company all are one."""
        sent = one.sent
        if sent.gather is not None and not sent.behind:
            self._loose.remove(one)
            together = [sent, *one.company]
            self._hand_over([self._next(each, whole=True) for each in together])
            for each in together:
                self._finish(each)
            return
        one.missing = 0
        while one in self._loose and one.due <= self._now:
            self._hand_over([self._next(sent)])
            if sent.parts:
                one.pause(self._now, 0)
            elif one in self._loose:
                self._loose.remove(one)
                self._finish(sent)

    def _run_queue(self) -> None:
        batch: list[tuple[T, bytes]] = []
        while self._queue and not self.stopped and self._queue[0].when <= self._now:
            one = self._queue[0]
            if one.paused:
                one.pause(self._now, self.turns)
            if one.turns or one.due > self._now:
                break
            one.missing = 0
            sent = one.sent
            batch.append(self._next(sent))
            if sent.parts:
                one.paused = True
                batch = self._hand_over(batch)
                continue
            self._queue.popleft()
            if sent.end is not None:
                batch = self._hand_over(batch)
                if self.stopped:  # what stands before the end has not passed yet
                    self._queue.appendleft(one)
                else:
                    self._finish(sent)
        self._hand_over(batch)

    def _next(self, sent: T, *, whole: bool = False) -> tuple[T, bytes]:
        data = sent.take()
        while whole and sent.parts:
            data += sent.take()
        self.size -= len(data)
        return sent, data

    def _hand_over(self, batch: list[tuple[T, bytes]]) -> list[tuple[T, bytes]]:
        """Carry a batch and return an empty one."""
        if batch:
            self.carry(batch)
        return []

    def _finish(self, sent: T) -> None:
        if sent.end is not None:
            self.end(sent.end)

    def _arm(self) -> None:
        """Set the timer for what passes next."""
        waiting = [*list(self._queue)[:1], *self._loose]
        when = min((one.when for one in waiting), default=None)
        self._timer.set(None if self.stopped else when)

    def _tick(self) -> None:
        if self._queue and self._queue[0].turns:
            self._queue[0].turns -= 1
        self.wake()
