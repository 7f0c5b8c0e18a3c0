"""Send transmissions in order, each at its time, without knowledge of sockets and faults.

The emulator's faults delay messages by this module; the link proxy, bytes of a stream or datagrams.
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
    cause: str  # kind of the fault, or name of the rule
    # seconds for which a half-open connection stays; None: as long as possible
    seconds: float | None = None


@dataclass(slots=True, eq=False)
class Transmission:
    """Bytes for a link, with their delays and pauses."""

    parts: list[bytes]  # bytes still to send; each part is one write
    _: KW_ONLY
    pauses: list[float] = field(
        default_factory=list[float]
    )  # seconds before each part but the first
    delay: float = 0.0  # seconds before the first part
    overtaken: bool = False  # whether later parts may pass this one while it waits
    # number of later parts to wait for, and the longest wait in seconds
    gather: tuple[int, float] | None = None
    # without an order: whether the transmission is sent after those parts, not with them
    behind: bool = False
    end: Ending | None = None  # event of the connection after it
    faults: list[str] = field(
        default_factory=list[str]
    )  # kinds, or names of rules, that acted on it

    @property
    def size(self) -> int:
        """The number of bytes still to send."""
        return sum(map(len, self.parts))

    def take(self) -> bytes:
        """Remove and return the next part."""
        return self.parts.pop(0) if self.parts else b""


T = TypeVar("T", bound=Transmission)


class _Waiting(Generic[T]):
    """A waiting transmission; ``missing``: number of later parts that it still waits for."""

    __slots__ = ("company", "due", "missing", "paused", "sent", "turns", "until")

    def __init__(self, sent: T, now: int) -> None:
        self.sent = sent
        self.due = now + nanoseconds(sent.delay)  # instant when its next part may pass, nanoseconds
        self.missing, seconds = sent.gather or (0, 0.0)
        # time until which it waits for others, nanoseconds
        self.until = self.due + nanoseconds(seconds)
        self.company: list[T] = []  # parts that it waited for, without an order
        self.paused = False  # whether a part was sent, and its pause has not begun
        self.turns = 0  # turns of the timer before the next part is sent

    @property
    def when(self) -> int:
        """Time at which the message is sent if no later one arrives, nanoseconds."""
        return self.until if self.missing > 0 else self.due

    def pause(self, now: int, turns: int) -> None:
        """Begin the pause before the next part."""
        seconds = self.sent.pauses.pop(0)
        self.paused, self.due = False, now + nanoseconds(seconds)
        self.turns = 0 if seconds else turns


@dataclass(eq=False)
class DelayLine(Generic[T]):
    """One direction of one link.

    :meth:`put` transmissions, then call :meth:`run`. ``carry`` is called with the bytes to send.
    """

    clock: Clock
    _: KW_ONLY
    # with an order (TCP), nothing passes a waiting transmission unless it may be overtaken, and
    # all transmissions of one time are carried together; without it (UDP) each part goes by itself
    ordered: bool
    wake: Callable[[], None]  # called when run() is due
    # gets passing transmissions and the bytes of each, for one write; it may stop() the line
    carry: Callable[[list[tuple[T, bytes]]], None]
    end: Callable[[Ending], None]  # ends the connection after a transmission
    lost: Callable[[T], None]  # called with each transmission that was dropped by close()
    turns: int = 0  # turns of the event loop that a pause of no time takes

    def __post_init__(self) -> None:
        self.size: int = 0  # bytes of all waiting transmissions
        self.stopped: bool = False  # whether nothing passes until go_on()
        self._queue: deque[_Waiting[T]] = deque()
        self._loose: list[_Waiting[T]] = []
        self._timer = OneTimer(self.clock, self._tick)
        self._running = False

    def __len__(self) -> int:
        return len(self._queue) + len(self._loose)

    def put(self, sent: Iterable[T], amount: int = 1) -> None:
        """Add the transmissions of a message; call :meth:`run` next.

        They count as ``amount`` for transmissions that wait for later ones.
        """
        now = self._now
        gatherer = self._count(amount, now)
        for transmission in sent:
            self.size += transmission.size
            if gatherer is not None and not transmission.delay:
                gatherer.company.append(transmission)
            elif self.ordered and not transmission.overtaken:
                self._queue.append(_Waiting(transmission, now))
            else:
                self._loose.append(_Waiting(transmission, now))

    def run(self) -> None:
        """Send all transmissions whose time has come."""
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
        """Send nothing until :meth:`go_on`."""
        self.stopped = True
        self._timer.set(None)

    def go_on(self) -> None:
        """Send waiting transmissions like :meth:`run`, also after :meth:`stop`."""
        self.stopped = False
        self.run()

    def close(self) -> None:
        """Drop all transmissions. Harmless when called twice."""
        self._timer.set(None)
        self.size = 0
        left = [*self._queue, *self._loose]
        self._queue.clear()
        self._loose.clear()
        for waiting in left:
            for transmission in (waiting.sent, *waiting.company):
                self.lost(transmission)

    @property
    def _now(self) -> int:
        return nanoseconds(self.clock.now)

    def _count(self, amount: int, now: int) -> _Waiting[T] | None:
        """Count new transmissions for waiting ones; return the transmission to join."""
        waiting = [entry for entry in (*self._queue, *self._loose) if entry.missing > 0]
        for entry in waiting:
            entry.missing -= amount
            if entry.sent.behind and entry.missing <= 0:
                entry.due = max(entry.due, now)
        together = [entry for entry in waiting if not self.ordered and not entry.sent.behind]
        return together[0] if together else None

    def _run_loose(self) -> None:
        """Send transmissions that may be overtaken, and all without an order."""
        now = self._now
        due = [entry for entry in self._loose if entry.when <= now]
        for entry in sorted(due, key=lambda entry: (entry.when, entry.sent.behind)):
            if entry not in self._loose:  # closed meanwhile
                return
            if self.ordered:
                self._loose.remove(entry)
                self._queue.append(entry)
            else:
                self._pass_datagrams(entry)

    def _pass_datagrams(self, entry: _Waiting[T]) -> None:
        """Send the due parts, one datagram each; joined parts are one datagram."""
        sent = entry.sent
        if sent.gather is not None and not sent.behind:
            self._loose.remove(entry)
            together = [sent, *entry.company]
            self._hand_over([self._next(each, whole=True) for each in together])
            for each in together:
                self._finish(each)
            return
        entry.missing = 0
        while entry in self._loose and entry.due <= self._now:
            self._hand_over([self._next(sent)])
            if sent.parts:
                entry.pause(self._now, 0)
            elif entry in self._loose:
                self._loose.remove(entry)
                self._finish(sent)

    def _run_queue(self) -> None:
        batch: list[tuple[T, bytes]] = []
        while self._queue and not self.stopped and self._queue[0].when <= self._now:
            first = self._queue[0]
            if first.paused:
                first.pause(self._now, self.turns)
            if first.turns or first.due > self._now:
                break
            first.missing = 0
            sent = first.sent
            batch.append(self._next(sent))
            if sent.parts:
                first.paused = True
                batch = self._hand_over(batch)
                continue
            self._queue.popleft()
            if sent.end is not None:
                batch = self._hand_over(batch)
                if self.stopped:  # bytes before the end were not sent yet
                    self._queue.appendleft(first)
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
        """Set the timer for the next transmission."""
        waiting = [*list(self._queue)[:1], *self._loose]
        when = min((entry.when for entry in waiting), default=None)
        self._timer.set(None if self.stopped else when)

    def _tick(self) -> None:
        if self._queue and self._queue[0].turns:
            self._queue[0].turns -= 1
        self.wake()
