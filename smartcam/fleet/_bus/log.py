"""Numbered messages of one camera: kept by its agent, and put in order by their receiver.

An agent numbers its messages without gaps and keeps the last ones (:class:`AgentLog`). A receiver
(:class:`Feed`) takes each number once and in order: it drops repetitions, and asks for missing
messages. Those that the agent no longer has are missed, and their number is known.
"""

from __future__ import annotations

import collections
from typing import TYPE_CHECKING, Generic, NamedTuple, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Self


MAX_EPOCHS_REMEMBERED = 16
"""Largest number of earlier epochs whose next numbers are remembered."""


class Numbered(Protocol):
    """One message, or several with consecutive numbers."""

    @property
    def number(self) -> int:
        """The number of the first one."""
        ...

    @property
    def next(self) -> int:
        """The number after the last one."""
        ...

    @property
    def size(self) -> int:
        """Number of kept bytes."""
        ...

    def since(self, number: int) -> Self:
        """Return the part with ``number`` and later numbers."""
        ...


_Kept = tuple[int, int, float, bytes]
"""A number, the one after the entry's last, the clock, and the entry; each message makes one."""


class LogPart(NamedTuple):
    """A part of a log.

    Attributes:
        first: first number of the part; later than the requested one if that is no longer kept.
        data: the kept entries, one after the other.
        following: the agent's next number.
    """

    first: int
    data: list[bytes]
    following: int


class AgentLog:
    """The last messages of an agent about one camera, as bytes; bounded.

    Args:
        most: largest number of kept messages.
        most_bytes: largest number of kept bytes; the last entry is always kept.

    Attributes:
        following: number of the next message, from 1.
    """

    def __init__(self, most: int, most_bytes: int) -> None:
        self.following: int = 1
        self._most, self._most_bytes = most, most_bytes
        self._entries: collections.deque[_Kept] = collections.deque()
        self._bytes = 0

    @property
    def first(self) -> int:
        """The first kept number; the next number if none is kept."""
        return self._entries[0][0] if self._entries else self.following

    @property
    def kept(self) -> int:
        """Number of kept messages."""
        return self.following - self.first

    @property
    def kept_bytes(self) -> int:
        """Number of kept bytes."""
        return self._bytes

    def add(self, count: int, clock: float, data: bytes) -> None:
        """Keep ``count`` messages with the next numbers, which are in ``data``."""
        entries, number = self._entries, self.following
        following = self.following = number + count
        entries.append((number, following, clock, data))
        size = self._bytes + len(data)
        while following - entries[0][1] >= self._most or size > self._most_bytes:
            if len(entries) == 1:
                break
            size -= len(entries.popleft()[3])
        self._bytes = size

    def part(self, first: int, most_bytes: int) -> LogPart:
        """Return the entries from ``first`` on: up to ``most_bytes`` bytes, and at least one.

        An entry that contains ``first`` is returned completely.
        """
        begin = max(first, self.first)
        parts: list[bytes] = []
        for _, following, _, data in self._entries:
            if following <= begin:
                continue
            most_bytes -= len(data)
            if parts and most_bytes < 0:
                break
            parts.append(data)
        return LogPart(begin, parts, self.following)

    def first_since(self, clock: float) -> int:
        """Return the number of the first message at ``clock`` or later."""
        number = self.following
        for first, _, at, _ in reversed(self._entries):
            if at < clock:
                break
            number = first
        return number


NumberedT = TypeVar("NumberedT", bound=Numbered)


class Feed(Generic[NumberedT]):
    """The messages of one camera's agent, put in order.

    Args:
        take: function that is called with each message once, in order of the numbers.
        miss: function that is called with the number of missed messages, and the message after
            them; None without one.
        lacks: function that is called if a message is missing; then the feed's owner should ask
            the agent for messages from ``expected`` on, and :meth:`fill` them in.
        most_held: largest number of bytes of messages that wait for a missing one; further ones are
            dropped, and requested later.
        returns: whether an epoch that comes again after another one continues at its next number;
            missing messages of an epoch that ends are reported.

    Attributes:
        epoch: number of the agent's start; 0 before the first.
        expected: number of the next message; 0 if that is not known yet.
        lacking: whether a message is missing and awaited.
    """

    def __init__(
        self,
        take: Callable[[NumberedT], None],
        miss: Callable[[int, NumberedT | None], None],
        lacks: Callable[[], None],
        *,
        most_held: int = 1 << 23,
        returns: bool = False,
    ) -> None:
        self.epoch: int = 0
        self.expected: int = 0
        self.lacking: bool = False
        self._take, self._miss, self._lacks = take, miss, lacks
        self._held: collections.deque[NumberedT] = collections.deque()
        self._held_epoch = 0
        self._held_bytes, self._most_held = 0, most_held
        self._returns = returns
        self._announced = 0  # the highest next number of this epoch from the agent
        self._places: dict[int, int] = {}  # next expected number, by earlier epoch
        self._next_numbers: dict[int, int] = {}  # next number from the agent, by other epoch

    def begin(self, epoch: int, expected: int, following: int) -> None:
        """Take messages with ``expected`` or a later number, of this epoch of the agent.

        In a known epoch the expected number stays. ``following`` is the agent's next number:
        missing messages before it are requested.
        """
        if epoch != self.epoch or not self.expected:
            if self._returns and self.expected:
                self._end_epoch()
                expected = self._places.get(epoch, expected)
            self.epoch, self.expected = epoch, expected
            self._announced = 0
            following = max(following, self._next_numbers.pop(epoch, 0))
        if epoch != self._held_epoch:
            self._drop_held()
        self._go_on(following)

    def _end_epoch(self) -> None:
        """End this epoch, since another begins: take held messages, report missed ones."""
        held = self._now_held()
        while held:
            thing = held.popleft()
            self._held_bytes -= thing.size
            if thing.number > self.expected:
                self._miss(thing.number - self.expected, thing)
                self.expected = thing.number
            if thing.next > self.expected:
                self._have(thing)
        if self._announced > self.expected:
            self._miss(self._announced - self.expected, None)
            self.expected = self._announced
        self._places[self.epoch] = self.expected
        if len(self._places) > MAX_EPOCHS_REMEMBERED:
            del self._places[next(iter(self._places))]

    def receive(self, epoch: int, following: int, things: list[NumberedT]) -> None:
        """Take messages that the agent sent by itself; ``following`` is its next number."""
        if epoch == self.epoch and self.expected and not self.lacking:
            for thing in things:
                if thing.number == self.expected:
                    self.expected = thing.next
                    self._take(thing)
                elif thing.number > self.expected:
                    self._hold(epoch, thing)
                elif thing.next > self.expected:
                    self._have(thing)
            self._go_on(following)
            return
        if epoch == self.epoch and self.expected:
            self._announced = max(self._announced, following)
        else:  # begin() requests messages that are not held
            self._next_numbers[epoch] = max(following, self._next_numbers.get(epoch, 0))
            if len(self._next_numbers) > MAX_EPOCHS_REMEMBERED:
                del self._next_numbers[next(iter(self._next_numbers))]
        if epoch >= self.epoch:
            for thing in things:
                self._hold(epoch, thing)

    def fill(self, epoch: int, first: int, following: int, things: list[NumberedT]) -> None:
        """Take requested messages: all messages of the agent from ``first`` on, or some."""
        if epoch != self.epoch or not self.expected:
            return  # a newer epoch starts with begin(), or the feed is stopped
        held = self._now_held()
        before, stuck = self.expected, held[0].number if held else following
        if first <= before and not things:
            first = max(following, stuck)  # the agent announces more, but sends nothing
        if first > before:
            self._miss(first - before, things[0] if things else None)
            self.expected = first
        for thing in things:
            if thing.next > self.expected:
                self._have(thing)
        self._go_on(following)

    def interrupt(self) -> None:
        """Wait for :meth:`begin`, since the agent cannot be asked."""
        self.lacking = True

    def stop(self) -> None:
        """Stop taking messages."""
        self.expected = self._announced = 0
        self._places.clear()
        self._next_numbers.clear()
        self.lacking = False
        self._drop_held()

    def _have(self, thing: NumberedT) -> None:
        new = thing.since(self.expected)
        self.expected = new.next
        self._take(new)

    def _go_on(self, following: int) -> None:
        """Take held messages that are next; request the missing ones before the rest."""
        self.lacking = False
        if following > self._announced:
            self._announced = following
        if not self._held and following <= self.expected:
            return
        held = self._now_held()
        while held and held[0].number <= self.expected:
            thing = held.popleft()
            self._held_bytes -= thing.size
            if thing.next > self.expected:
                self._have(thing)
        if held or following > self.expected:
            self.lacking = True
            self._lacks()

    def _now_held(self) -> collections.deque[NumberedT]:
        """Return the messages held for this epoch; messages of the next epoch wait for begin()."""
        return self._held if self._held_epoch == self.epoch else collections.deque()

    def _hold(self, epoch: int, thing: NumberedT) -> None:
        if epoch != self._held_epoch:
            if epoch < self._held_epoch:
                return
            self._drop_held()
            self._held_epoch = epoch
        if self._held_bytes + thing.size > self._most_held:
            return  # the number in following shows that it is missing
        self._held.append(thing)
        self._held_bytes += thing.size

    def _drop_held(self) -> None:
        self._held.clear()
        self._held_bytes = 0
