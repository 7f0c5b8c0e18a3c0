"""Keep numbered messages of one camera at its agent, and put them in order at their receiver.

An agent numbers its messages without gaps, and keeps the last messages (:class:`AgentLog`). A
receiver (:class:`Feed`) passes on each number once, in order: it drops repetitions, and asks the
agent for missing messages. Messages that the agent no longer has are counted as missed.
"""

from __future__ import annotations

import collections
from typing import TYPE_CHECKING, Generic, NamedTuple, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Self


MAX_EPOCHS_REMEMBERED = 16
"""Largest number of earlier epochs (starts of an agent) whose next numbers are remembered."""


class Numbered(Protocol):
    """One message, or several with consecutive numbers."""

    @property
    def number(self) -> int:
        """The number of the first message."""
        ...

    @property
    def next(self) -> int:
        """The number that follows the last message's."""
        ...

    @property
    def size(self) -> int:
        """Number of kept bytes."""
        ...

    def since(self, number: int) -> Self:
        """Return the part with ``number`` and later numbers."""
        ...


_LogEntry = tuple[int, int, float, bytes]
"""An entry of a log: its first number, the number after its last one, the time by the agent's clock
at which it was added, and its bytes."""


class LogPart(NamedTuple):
    """A part of a log.

    Attributes:
        first: first number of the part, which is later than the requested number if that number is
            no longer kept.
        data: the kept entries, one after the other.
        next_number: the agent's next number.
    """

    first: int
    data: list[bytes]
    next_number: int


class AgentLog:
    """The last messages of an agent about one camera, as bytes; bounded.

    Args:
        max_messages: number of kept messages, by which older entries are dropped. An entry is kept
            while some of its messages are among them.
        max_bytes: largest number of kept bytes. The last entry is kept even if it is larger.

    Attributes:
        next_number: number of the next message, from 1.
    """

    def __init__(self, max_messages: int, max_bytes: int) -> None:
        self.next_number: int = 1
        self._max_messages, self._max_bytes = max_messages, max_bytes
        self._entries: collections.deque[_LogEntry] = collections.deque()
        self._bytes = 0

    @property
    def first(self) -> int:
        """The first kept number; the next number if none is kept."""
        return self._entries[0][0] if self._entries else self.next_number

    @property
    def kept_count(self) -> int:
        """Number of kept messages."""
        return self.next_number - self.first

    @property
    def kept_bytes(self) -> int:
        """Number of kept bytes."""
        return self._bytes

    def add(self, count: int, clock: float, data: bytes) -> None:
        """Keep ``count`` messages with the next numbers, which are in ``data``."""
        entries, number = self._entries, self.next_number
        next_number = self.next_number = number + count
        entries.append((number, next_number, clock, data))
        size = self._bytes + len(data)
        while next_number - entries[0][1] >= self._max_messages or size > self._max_bytes:
            if len(entries) == 1:
                break
            size -= len(entries.popleft()[3])
        self._bytes = size

    def read_part(self, first: int, max_bytes: int) -> LogPart:
        """Return entries from number ``first`` on: up to ``max_bytes`` bytes, at least one entry.

        The entry that contains ``first`` is returned whole, with its earlier messages.
        """
        begin = max(first, self.first)
        parts: list[bytes] = []
        for _, next_number, _, data in self._entries:
            if next_number <= begin:
                continue
            max_bytes -= len(data)
            if parts and max_bytes < 0:
                break
            parts.append(data)
        return LogPart(begin, parts, self.next_number)

    def first_since(self, clock: float) -> int:
        """Return the number of the first message at ``clock`` or later."""
        number = self.next_number
        for first, _, at, _ in reversed(self._entries):
            if at < clock:
                break
            number = first
        return number


NumberedT = TypeVar("NumberedT", bound=Numbered)


class Feed(Generic[NumberedT]):
    """Puts the messages of one camera's agent in order.

    Args:
        on_message: callback that gets each message once, in the order of the numbers.
        on_missed: callback for messages that are lost for good. It gets their count, and the
            message that follows them, or None.
        on_gap: callback that is called when a message is missing. The feed's owner then asks the
            agent for messages from ``expected`` on, and adds them by :meth:`fill`.
        max_held_bytes: largest number of bytes of messages that are held until a missing message
            has come. Further messages are dropped, and requested later.
        resumes_epochs: whether the feed remembers its position in an epoch (one run of an agent)
            when another epoch begins, and goes on there if the epoch returns. Messages that are
            missing when an epoch ends are then reported as missed.

    Attributes:
        epoch: number of the agent's start; 0 before the first.
        expected: number of the next message; 0 if that is not known yet.
        has_gap: whether messages are held, until missing ones came or :meth:`begin` is called.
    """

    def __init__(
        self,
        on_message: Callable[[NumberedT], None],
        on_missed: Callable[[int, NumberedT | None], None],
        on_gap: Callable[[], None],
        *,
        max_held_bytes: int = 1 << 23,
        resumes_epochs: bool = False,
    ) -> None:
        self.epoch: int = 0
        self.expected: int = 0
        self.has_gap: bool = False
        self._on_message, self._on_missed, self._on_gap = on_message, on_missed, on_gap
        self._held: collections.deque[NumberedT] = collections.deque()
        self._held_epoch = 0
        self._held_bytes, self._max_held_bytes = 0, max_held_bytes
        self._resumes_epochs = resumes_epochs
        self._highest_next = 0  # the agent's highest next number in this epoch
        self._expected_in_epoch: dict[int, int] = {}  # next expected number, by earlier epoch
        self._next_in_epoch: dict[
            int, int
        ] = {}  # the agent's next number, by epochs for which begin() was not called yet

    def begin(self, epoch: int, expected: int, next_number: int) -> None:
        """Begin an epoch of the agent, with ``expected`` as the number of its first message.

        If the epoch was begun before, the expected number of that time is used. ``next_number`` is
        the number of the agent's next message: missing messages before it are requested.
        """
        if epoch != self.epoch or not self.expected:
            if self._resumes_epochs and self.expected:
                self._end_epoch()
                expected = self._expected_in_epoch.get(epoch, expected)
            self.epoch, self.expected = epoch, expected
            self._highest_next = 0
            next_number = max(next_number, self._next_in_epoch.pop(epoch, 0))
        if epoch != self._held_epoch:
            self._drop_held()
        self._take_held(next_number)

    def _end_epoch(self) -> None:
        """End the current epoch: pass on its held messages, and report its missing messages."""
        held = self._held_in_epoch()
        while held:
            message = held.popleft()
            self._held_bytes -= message.size
            if message.number > self.expected:
                self._on_missed(message.number - self.expected, message)
                self.expected = message.number
            if message.next > self.expected:
                self._take_new_part(message)
        if self._highest_next > self.expected:
            self._on_missed(self._highest_next - self.expected, None)
            self.expected = self._highest_next
        self._expected_in_epoch[self.epoch] = self.expected
        if len(self._expected_in_epoch) > MAX_EPOCHS_REMEMBERED:
            del self._expected_in_epoch[next(iter(self._expected_in_epoch))]

    def receive(self, epoch: int, next_number: int, messages: list[NumberedT]) -> None:
        """Take messages that the agent published; ``next_number`` is the agent's next number."""
        if epoch == self.epoch and self.expected and not self.has_gap:
            for message in messages:
                if message.number == self.expected:
                    self.expected = message.next
                    self._on_message(message)
                elif message.number > self.expected:
                    self._hold(epoch, message)
                elif message.next > self.expected:
                    self._take_new_part(message)
            self._take_held(next_number)
            return
        if epoch == self.epoch and self.expected:
            self._highest_next = max(self._highest_next, next_number)
        else:  # begin() requests messages that are not held
            self._next_in_epoch[epoch] = max(next_number, self._next_in_epoch.get(epoch, 0))
            if len(self._next_in_epoch) > MAX_EPOCHS_REMEMBERED:
                del self._next_in_epoch[next(iter(self._next_in_epoch))]
        if epoch >= self.epoch:
            for message in messages:
                self._hold(epoch, message)

    def fill(self, epoch: int, first: int, next_number: int, messages: list[NumberedT]) -> None:
        """Take requested messages, which begin at number ``first``; later ones may be left out."""
        if epoch != self.epoch or not self.expected:
            return  # a newer epoch starts with begin(), or the feed is stopped
        held = self._held_in_epoch()
        expected, first_held = self.expected, held[0].number if held else next_number
        if first <= expected and not messages:
            # the agent sent nothing, although it has announced messages: they are lost
            first = max(next_number, first_held)
        if first > expected:
            self._on_missed(first - expected, messages[0] if messages else None)
            self.expected = first
        for message in messages:
            if message.next > self.expected:
                self._take_new_part(message)
        self._take_held(next_number)

    def interrupt(self) -> None:
        """Hold messages until :meth:`begin`: there is no agent to ask for missing messages."""
        self.has_gap = True

    def stop(self) -> None:
        """Stop taking messages."""
        self.expected = self._highest_next = 0
        self._expected_in_epoch.clear()
        self._next_in_epoch.clear()
        self.has_gap = False
        self._drop_held()

    def _take_new_part(self, message: NumberedT) -> None:
        new_part = message.since(self.expected)
        self.expected = new_part.next
        self._on_message(new_part)

    def _take_held(self, next_number: int) -> None:
        """Pass on held messages that are next in order; report a gap before the other ones."""
        self.has_gap = False
        if next_number > self._highest_next:
            self._highest_next = next_number
        if not self._held and next_number <= self.expected:
            return
        held = self._held_in_epoch()
        while held and held[0].number <= self.expected:
            message = held.popleft()
            self._held_bytes -= message.size
            if message.next > self.expected:
                self._take_new_part(message)
        if held or next_number > self.expected:
            self.has_gap = True
            self._on_gap()

    def _held_in_epoch(self) -> collections.deque[NumberedT]:
        """Return the held messages if they belong to this epoch, else an empty queue."""
        return self._held if self._held_epoch == self.epoch else collections.deque()

    def _hold(self, epoch: int, message: NumberedT) -> None:
        if epoch != self._held_epoch:
            if epoch < self._held_epoch:
                return
            self._drop_held()
            self._held_epoch = epoch
        if self._held_bytes + message.size > self._max_held_bytes:
            return  # a later ``next_number`` shows that this message is missing
        self._held.append(message)
        self._held_bytes += message.size

    def _drop_held(self) -> None:
        self._held.clear()
        self._held_bytes = 0
