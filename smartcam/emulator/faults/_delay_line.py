"""Send transmissions in order, each at its time; this module knows no sockets or faults.

The emulator's faults use it to delay messages, the link proxy to delay bytes and datagrams.
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
    # number of later transmissions that this one waits for, and the longest wait in seconds
    gather: tuple[int, float] | None = None
    # only on UDP: whether it is sent after them, not in one datagram with them
    after_gathered: bool = False
    end: Ending | None = None  # event of the connection after it
    effects: list[str] = field(
        default_factory=list[str]
    )  # kinds of faults, or names of rules, that acted on it; the reason of a loss

    @property
    def size(self) -> int:
        """The number of bytes still to send."""
        return sum(map(len, self.parts))

    def take(self) -> bytes:
        """Remove and return the next part."""
        return self.parts.pop(0) if self.parts else b""


T = TypeVar("T", bound=Transmission)


class _WaitingTransmission(Generic[T]):
    """A waiting transmission; ``missing_count``: number of later ones for which it still waits."""

    __slots__ = (
        *("due_at", "gather_until", "gathered", "missing_count", "pause_is_due", "transmission"),
        "turns_left",
    )

    def __init__(self, transmission: T, now: int) -> None:
        self.transmission = transmission
        self.due_at = now + nanoseconds(
            transmission.delay
        )  # instant when its next part may pass, nanoseconds
        self.missing_count, seconds = transmission.gather or (0, 0.0)
        # time until which it waits for later parts, nanoseconds
        self.gather_until = self.due_at + nanoseconds(seconds)
        self.gathered: list[T] = []  # transmissions that go with it, in one datagram
        self.pause_is_due = False  # whether a part was sent, and its pause has not begun
        self.turns_left = 0  # turns of the timer before the next part is sent

    @property
    def send_at(self) -> int:
        """Time at which the message is sent if no later one arrives, nanoseconds."""
        return self.gather_until if self.missing_count > 0 else self.due_at

    def pause(self, now: int, turns: int) -> None:
        """Begin the pause before the next part."""
        seconds = self.transmission.pauses.pop(0)
        self.pause_is_due, self.due_at = False, now + nanoseconds(seconds)
        self.turns_left = 0 if seconds else turns


@dataclass(eq=False)
class DelayLine(Generic[T]):
    """Delays transmissions in one direction of one link.

    :meth:`put` transmissions, then call :meth:`run`. ``carry`` is called with the bytes to send.
    """

    clock: Clock
    _: KW_ONLY
    # True (TCP): nothing passes a waiting transmission unless it may be overtaken, and all
    # transmissions of one time are carried together. False (UDP): each part is carried by itself
    keeps_order: bool
    wake: Callable[[], None]  # called when run() is due
    # gets due transmissions and the bytes of each, for one write; the function may stop() the line
    carry: Callable[[list[tuple[T, bytes]]], None]
    end: Callable[[Ending], None]  # ends the connection after a transmission
    on_dropped: Callable[[T], None]  # called with each transmission that was dropped by close()
    turns: int = 0  # turns of the event loop for a pause of 0 seconds

    def __post_init__(self) -> None:
        self.size: int = 0  # bytes of all waiting transmissions
        self.stopped: bool = False  # whether nothing passes until go_on()
        self._queue: deque[_WaitingTransmission[T]] = deque()
        self._unordered: list[_WaitingTransmission[T]] = []
        self._timer = OneTimer(self.clock, self._tick)
        self._running = False

    def __len__(self) -> int:
        return len(self._queue) + len(self._unordered)

    def put(self, transmissions: Iterable[T], amount: int = 1) -> None:
        """Add the transmissions of a message; call :meth:`run` next.

        Together they count as ``amount`` later ones for the transmissions that wait already.
        """
        now = self._now
        gatherer = self._count_new(amount, now)
        for transmission in transmissions:
            self.size += transmission.size
            if gatherer is not None and not transmission.delay:
                gatherer.gathered.append(transmission)
            elif self.keeps_order and not transmission.overtaken:
                self._queue.append(_WaitingTransmission(transmission, now))
            else:
                self._unordered.append(_WaitingTransmission(transmission, now))

    def run(self) -> None:
        """Send all transmissions whose time has come."""
        if self._running or self.stopped:
            return
        self._running = True
        try:
            self._send_unordered()
            self._send_queued()
        finally:
            self._running = False
        self._set_timer()

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
        dropped = [*self._queue, *self._unordered]
        self._queue.clear()
        self._unordered.clear()
        for waiting in dropped:
            for transmission in (waiting.transmission, *waiting.gathered):
                self.on_dropped(transmission)

    @property
    def _now(self) -> int:
        return nanoseconds(self.clock.now)

    def _count_new(self, amount: int, now: int) -> _WaitingTransmission[T] | None:
        """Count new transmissions for waiting ones; return the one that the new ones join."""
        waiting = [entry for entry in (*self._queue, *self._unordered) if entry.missing_count > 0]
        for entry in waiting:
            entry.missing_count -= amount
            if entry.transmission.after_gathered and entry.missing_count <= 0:
                entry.due_at = max(entry.due_at, now)
        gatherers = (entry for entry in waiting if not entry.transmission.after_gathered)
        return None if self.keeps_order else next(gatherers, None)

    def _send_unordered(self) -> None:
        """Send due datagrams; on TCP, queue the due transmissions that others could overtake."""
        now = self._now
        due_entries = [entry for entry in self._unordered if entry.send_at <= now]
        for entry in sorted(
            due_entries, key=lambda entry: (entry.send_at, entry.transmission.after_gathered)
        ):
            if entry not in self._unordered:  # closed meanwhile
                return
            if self.keeps_order:
                self._unordered.remove(entry)
                self._queue.append(entry)
            else:
                self._send_datagrams(entry)

    def _send_datagrams(self, entry: _WaitingTransmission[T]) -> None:
        """Send the due parts, one datagram each; joined parts are one datagram."""
        transmission = entry.transmission
        if transmission.gather is not None and not transmission.after_gathered:
            self._unordered.remove(entry)
            joined = [transmission, *entry.gathered]
            self._carry_batch([self._take_next(each, whole=True) for each in joined])
            for each in joined:
                self._finish(each)
            return
        entry.missing_count = 0
        while entry in self._unordered and entry.due_at <= self._now:
            self._carry_batch([self._take_next(transmission)])
            if transmission.parts:
                entry.pause(self._now, 0)
            elif entry in self._unordered:
                self._unordered.remove(entry)
                self._finish(transmission)

    def _send_queued(self) -> None:
        batch: list[tuple[T, bytes]] = []
        while self._queue and not self.stopped and self._queue[0].send_at <= self._now:
            oldest = self._queue[0]
            if oldest.pause_is_due:
                oldest.pause(self._now, self.turns)
            if oldest.turns_left or oldest.due_at > self._now:
                break
            oldest.missing_count = 0
            transmission = oldest.transmission
            batch.append(self._take_next(transmission))
            if transmission.parts:
                oldest.pause_is_due = True
                batch = self._carry_batch(batch)
                continue
            self._queue.popleft()
            if transmission.end is not None:
                batch = self._carry_batch(batch)
                if self.stopped:  # bytes before the end were not sent yet
                    self._queue.appendleft(oldest)
                else:
                    self._finish(transmission)
        self._carry_batch(batch)

    def _take_next(self, transmission: T, *, whole: bool = False) -> tuple[T, bytes]:
        data = transmission.take()
        while whole and transmission.parts:
            data += transmission.take()
        self.size -= len(data)
        return transmission, data

    def _carry_batch(self, batch: list[tuple[T, bytes]]) -> list[tuple[T, bytes]]:
        """Carry a batch and return an empty one."""
        if batch:
            self.carry(batch)
        return []

    def _finish(self, transmission: T) -> None:
        if transmission.end is not None:
            self.end(transmission.end)

    def _set_timer(self) -> None:
        """Set the timer for the next transmission."""
        waiting = [*list(self._queue)[:1], *self._unordered]
        send_at = min((entry.send_at for entry in waiting), default=None)
        self._timer.set(None if self.stopped else send_at)

    def _tick(self) -> None:
        if self._queue and self._queue[0].turns_left:
            self._queue[0].turns_left -= 1
        self.wake()
