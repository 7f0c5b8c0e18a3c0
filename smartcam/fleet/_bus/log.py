"""Numbered things of one camera: kept by its agent, and put in order by their receiver.

An agent numbers what it says without gaps and keeps the last of it (:class:`AgentLog`). A receiver
that hears it (:class:`Feed`) takes each number once and in order: what came twice is dropped, and
what is missing is asked for. What the agent no longer has was missed, and how many that were is
known.
"""

from __future__ import annotations

import collections
from typing import TYPE_CHECKING, Generic, NamedTuple, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Self


MAX_EPOCHS_REMEMBERED = 16
"""Earlier epochs whose places are remembered at most."""


class Numbered(Protocol):
    """One thing, or several with consecutive numbers."""

    @property
    def number(self) -> int:
        """The first one's number."""
        ...

    @property
    def next(self) -> int:
        """The number after the last one."""
        ...

    @property
    def size(self) -> int:
        """Bytes that it keeps."""
        ...

    def since(self, number: int) -> Self:
        """Return the part with ``number`` and later numbers."""
        ...


class _Kept(NamedTuple):
    number: int
    next: int
    clock: float
    data: bytes


class LogPart(NamedTuple):
    """A part of a log.

    Attributes:
        first: the number that it begins with; a later one than was asked for where what was before
            is no longer kept.
        data: the kept entries, one after the other.
        following: the number that the agent gives next.
    """

    first: int
    data: list[bytes]
    following: int


class AgentLog:
    """The last things that an agent said of one camera, as bytes; bounded.

    Args:
        most: number of things that are kept at most.
        most_bytes: bytes that are kept at most; the last entry stays, however large it is.

    Attributes:
        following: number of the next thing, from 1.
    """

    def __init__(self, most: int, most_bytes: int) -> None:
        self.following: int = 1
        self._most, self._most_bytes = most, most_bytes
        self._entries: collections.deque[_Kept] = collections.deque()
        self._bytes = 0

    @property
    def first(self) -> int:
        """The first number that is kept; the next one where nothing is."""
        return self._entries[0].number if self._entries else self.following

    @property
    def kept(self) -> int:
        """Number of things that are kept."""
        return self.following - self.first

    @property
    def kept_bytes(self) -> int:
        """The number of bytes that are kept."""
        return self._bytes

    def add(self, count: int, clock: float, data: bytes) -> None:
        """Keep ``count`` things with the next numbers, which ``data`` has in it."""
        entries, number = self._entries, self.following
        self.following = number + count
        entries.append(_Kept(number, self.following, clock, data))
        self._bytes += len(data)
        while len(entries) > 1 and (
            self._bytes > self._most_bytes or self.following - entries[0].next >= self._most
        ):
            self._bytes -= len(entries.popleft().data)

    def part(self, first: int, most_bytes: int) -> LogPart:
        """Return the entries from ``first`` on: up to ``most_bytes`` bytes, and at least one.

        An entry that has ``first`` in it comes whole.
        """
        begin = max(first, self.first)
        found: list[bytes] = []
        for entry in self._entries:
            if entry.next <= begin:
                continue
            most_bytes -= len(entry.data)
            if found and most_bytes < 0:
                break
            found.append(entry.data)
        return LogPart(begin, found, self.following)

    def first_since(self, clock: float) -> int:
        """Return the number of the first one that came at ``clock`` or later."""
        number = self.following
        for entry in reversed(self._entries):
            if entry.clock < clock:
                break
            number = entry.number
        return number


NumberedT = TypeVar("NumberedT", bound=Numbered)


class Feed(Generic[NumberedT]):
    """The messages of one camera's agent, put in order.

    Args:
        take: gets each thing once, in order of the numbers.
        miss: function that is told how many could not be had any more, and what came next; None if
            nothing did.
        lacks: function that is called where something is missing; then who made the feed is to ask
            the agent for what follows ``expected``, and to :meth:`fill` it in.
        most_held: bytes that wait for what is missing before them; what comes beyond is dropped,
            and asked for later.
        returns: an epoch that comes again after another one's goes on where it was; what is
            missing of one that ends is told.

    Attributes:
        epoch: number of the agent's start; 0 before the first.
        expected: number of the next thing; 0 where that is not known yet.
        lacking: whether something is missing and waited for.
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
        self._announced = 0  # the highest number of this epoch that the agent said comes next
        self._places: dict[int, int] = {}  # next expected number, by earlier epoch
        self._said: dict[int, int] = {}  # next number that was announced, by other epoch

    def begin(self, epoch: int, expected: int, following: int) -> None:
        """Take what has ``expected`` or a later number, of this epoch of the agent.

        In the epoch that is already known, what was expected stays so. ``following`` is the number
        that the agent gives next: what is missing before it is asked for.
        """
        if epoch != self.epoch or not self.expected:
            if self._returns and self.expected:
                self._end_epoch()
                expected = self._places.get(epoch, expected)
            self.epoch, self.expected = epoch, expected
            self._announced = 0
            following = max(following, self._said.pop(epoch, 0))
        if epoch != self._held_epoch:
            self._drop_held()
        self._go_on(following)

    def _end_epoch(self) -> None:
        """End with this agent, as another goes on: take what is held, and tell what cannot come."""
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
        """Take what the agent said by itself; ``following`` is the number it gives next."""
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
        else:  # of what is not held then, begin() is to know
            self._said[epoch] = max(following, self._said.get(epoch, 0))
            if len(self._said) > MAX_EPOCHS_REMEMBERED:
                del self._said[next(iter(self._said))]
        if epoch >= self.epoch:
            for thing in things:
                self._hold(epoch, thing)

    def fill(self, epoch: int, first: int, following: int, things: list[NumberedT]) -> None:
        """Take what the agent said when asked: all that it has from ``first`` on, or a part."""
        if epoch != self.epoch or not self.expected:
            return  # a newer one begins with begin(); or nobody wants it any more
        held = self._now_held()
        before, stuck = self.expected, held[0].number if held else following
        if first <= before and not things:
            first = max(following, stuck)  # it says that there is more, and has nothing to show
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
        """Take nothing more, since nobody wants it."""
        self.expected = self._announced = 0
        self._places.clear()
        self._said.clear()
        self.lacking = False
        self._drop_held()

    def _have(self, thing: NumberedT) -> None:
        new = thing.since(self.expected)
        self.expected = new.next
        self._take(new)

    def _go_on(self, following: int) -> None:
        """Take what was held as far as it fits; ask for what is missing before the rest."""
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
        """Return the things held for this epoch; those held for the next one wait for begin()."""
        return self._held if self._held_epoch == self.epoch else collections.deque()

    def _hold(self, epoch: int, thing: NumberedT) -> None:
        if epoch != self._held_epoch:
            if epoch < self._held_epoch:
                return
            self._drop_held()
            self._held_epoch = epoch
        if self._held_bytes + thing.size > self._most_held:
            return  # following tells that it is missing
        self._held.append(thing)
        self._held_bytes += thing.size

    def _drop_held(self) -> None:
        self._held.clear()
        self._held_bytes = 0
