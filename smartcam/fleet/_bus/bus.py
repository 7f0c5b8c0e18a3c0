"""The bus of a fleet: programs and agents send messages under keys, and receive others'.

A key is chunks joined by ``/``; in a pattern ``*`` is one chunk and ``**`` any number of them. A
message reaches each subscriber in the order of sending, or not at all: a bus may lose messages, and
never waits. So senders number messages whose loss matters.

:class:`MemoryBus` is the bus inside a process; :mod:`smartcam.fleet._bus.zenoh` has the bus between
processes. Everything here belongs to one event loop, and every callback runs in it.
"""

from __future__ import annotations

import abc
import asyncio
import contextlib
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from smartcam.fleet._bus.keys import meets

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import Self

    from smartcam.fleet._security.certificates import Identity

Data = bytes | bytearray | memoryview


def never(_: str) -> bool:
    """Return False: no key is patient."""
    return False


def always(_: str) -> bool:
    """Return True: each key is patient."""
    return True


class Handle(abc.ABC):
    """A declaration that lasts until it is closed."""

    @abc.abstractmethod
    def close(self) -> None:
        """End the declaration; idempotent."""


class Publisher(Handle):
    """An end that publishes under one key.

    Attributes:
        has_subscribers: whether the publisher has a known subscriber.
    """

    has_subscribers: bool = False

    @abc.abstractmethod
    def put(self, payload: bytes) -> None:
        """Publish the payload; never block."""


class Bus(abc.ABC):
    """One end of a bus, of a program or an agent.

    Attributes:
        local: whether all ends are in this event loop: then parts are passed on without a copy, and
            all ends share one clock.
        identity: identity in the certificate of this end; None without a certificate.
    """

    local: bool = False
    identity: Identity | None = None

    @property
    def waiting_bytes(self) -> int:
        """Number of bytes that wait to be sent; 0 if nothing ever waits."""
        return 0

    @property
    @abc.abstractmethod
    def reached(self) -> bool:
        """True if this end is open, and no loss of the bus is known."""

    @abc.abstractmethod
    async def open(self, timeout: float) -> Self:
        """Connect to the bus.

        Raises:
            ConnectFailedError: there is no bus within ``timeout`` seconds.
        """

    @abc.abstractmethod
    async def close(self) -> None:
        """Leave the bus, which ends all declarations of this end. Idempotent."""

    @abc.abstractmethod
    def put(self, key: str, payload: bytes) -> None:
        """Send a message that a receiver waits for; never blocks."""

    @abc.abstractmethod
    def put_part(self, key: str, head: bytes, data: Data) -> None:
        """Send a part of large data after all other messages, with a head that describes the part.

        It is dropped if there is no room; never blocks. ``data`` must not be changed later.
        """

    @abc.abstractmethod
    def subscribe_parts(self, pattern: str, on_part: Callable[[str, bytes, Data], None]) -> Handle:
        """Call ``on_part(key, head, data)`` for parts that are sent under ``pattern``."""

    @abc.abstractmethod
    def publisher(
        self,
        key: str,
        on_subscribers: Callable[[bool], None] | None = None,
        *,
        urgent: bool = False,
    ) -> Publisher:
        """Return a publisher of messages under ``key``.

        Args:
            key: key of the messages.
            on_subscribers: callback for whether the key has subscribers, when that changes.
            urgent: whether messages wait in one line with messages of :meth:`put`; else after them.
        """

    @abc.abstractmethod
    def subscribe(
        self, pattern: str, on_message: Callable[[str, bytes], None], *, patient: bool = False
    ) -> Handle:
        """Call ``on_message(key, payload)`` for messages under ``pattern``.

        Args:
            pattern: pattern of the keys.
            on_message: the callback.
            patient: whether messages wait after all others, with a bound of their own.
        """

    @abc.abstractmethod
    def answer(
        self,
        pattern: str,
        answer: Callable[[BusQuestion], None],
        *,
        patient: Callable[[str], bool] = never,
    ) -> Handle:
        """Call ``answer(question)`` for questions under ``pattern``.

        Args:
            pattern: pattern of the keys.
            answer: the callback.
            patient: function, called in any thread, that returns whether a question with a key
                waits like a message, see :meth:`subscribe`.
        """

    @abc.abstractmethod
    async def ask(self, pattern: str, payload: bytes, timeout: float) -> list[tuple[str, bytes]]:
        """Return the answers to a question that come within ``timeout`` seconds, by their keys."""

    @abc.abstractmethod
    def be_present(self, key: str) -> Handle:
        """Announce this end's presence until the handle is closed."""

    @abc.abstractmethod
    async def present(self, pattern: str, timeout: float) -> list[str]:
        """Return the keys of the present ends that become known within ``timeout`` seconds."""

    @abc.abstractmethod
    def watch(self, pattern: str, on_presence: Callable[[str, bool], None]) -> Handle:
        """Call ``on_presence(key, present)`` for present ends, and for later changes."""


class BusQuestion(abc.ABC):
    """A question on the bus, waiting for its answer.

    Attributes:
        key: requested key, or a pattern.
        payload: bytes of the question.
    """

    key: str
    payload: bytes

    @abc.abstractmethod
    def reply(self, key: str, payload: bytes) -> None:
        """Send an answer; more than once if several keys are asked for.

        Answers may be sent only when the question is closed.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """End the question after its last answer; never block. Idempotent."""


# ---------------------------------------------------------------------- inside a process


class MemoryBus:
    """A bus inside this process, for agents and programs in one event loop.

    Hand ``MemoryBus().end()`` to each as its ``bus``. Deliveries are calls of the event loop, in
    order.
    """

    def __init__(self) -> None:
        self.ends: list[MemoryEnd] = []

    def end(self) -> MemoryEnd:
        """Return an end that is not open yet."""
        return MemoryEnd(self)


class _Patterned(Protocol):
    pattern: str


P = TypeVar("P", bound=_Patterned)


class _ByPattern(Generic[P]):
    """The declarations of one kind at an end, by pattern, to find the few that match a key."""

    def __init__(self) -> None:
        self._exact: dict[str, dict[P, None]] = {}
        self._wild: dict[P, None] = {}

    def __iter__(self) -> Iterator[P]:
        for same in (*self._exact.values(), self._wild):
            yield from tuple(same)

    def __contains__(self, entry: P) -> bool:
        return entry in self._wild or entry in self._exact.get(entry.pattern, ())

    def add(self, entry: P) -> None:
        same = self._wild if "*" in entry.pattern else self._exact.setdefault(entry.pattern, {})
        same[entry] = None

    def remove(self, entry: P) -> None:
        self._wild.pop(entry, None)
        same = self._exact.get(entry.pattern, {})
        same.pop(entry, None)
        if not same:
            self._exact.pop(entry.pattern, None)

    def clear(self) -> None:
        self._exact.clear()
        self._wild.clear()

    def meeting(self, pattern: str) -> list[P]:
        """Return the entries whose patterns overlap with a pattern or a key."""
        if "*" in pattern:
            return [entry for entry in self if meets(entry.pattern, pattern)]
        wild = [entry for entry in self._wild if meets(entry.pattern, pattern)]
        return [*self._exact.get(pattern, ()), *wild]


class _MemoryDeclared(Handle):
    """A declaration of an end under a pattern."""

    def __init__(
        self, place: _ByPattern[_MemoryDeclared], pattern: str, call: Callable[..., None]
    ) -> None:
        self.pattern = pattern
        self.call = call
        self._place = place
        self._after: Callable[[], None] = _nothing
        place.add(self)

    def then(self, after: Callable[[], None]) -> Self:
        """Call ``after`` once the declaration is closed."""
        self._after = after
        return self

    @property
    def closed(self) -> bool:
        """True once the declaration is closed."""
        return self not in self._place

    def close(self) -> None:
        if not self.closed:
            self._place.remove(self)
            self._after()


class MemoryEnd(Bus):
    """One end of a :class:`MemoryBus`."""

    local = True

    def __init__(self, bus: MemoryBus) -> None:
        self._bus = bus
        self.part_subscriptions: _ByPattern[_MemoryDeclared] = _ByPattern[_MemoryDeclared]()
        self.subscriptions: _ByPattern[_MemoryDeclared] = _ByPattern[_MemoryDeclared]()
        self.answered: _ByPattern[_MemoryDeclared] = _ByPattern[_MemoryDeclared]()
        self.watched: _ByPattern[_MemoryDeclared] = _ByPattern[_MemoryDeclared]()
        self.present_here: _ByPattern[_MemoryDeclared] = _ByPattern[_MemoryDeclared]()
        self.publishers: _ByPattern[_MemoryPublisher] = _ByPattern[_MemoryPublisher]()

    @property
    def attached(self) -> bool:
        """True if this end is on the bus now: open, and not cut off."""
        return self in self._bus.ends

    @property
    def reached(self) -> bool:
        return self.attached

    async def open(self, timeout: float) -> Self:
        self._loop = asyncio.get_running_loop()
        self.attach()
        return self

    async def close(self) -> None:
        self.detach()
        places = (
            self.subscriptions,
            self.part_subscriptions,
            self.answered,
            self.watched,
            self.present_here,
        )
        for place in places:
            place.clear()

    def attach(self) -> None:
        """Join the bus, or join it again."""
        if not self.attached:
            self._bus.ends.append(self)
            self._report_presences(True)
            self._check_subscribers("**")

    def detach(self) -> None:
        """Leave the bus like after a broken cable: both sides lose each other."""
        if self.attached:
            self._report_presences(False)
            self._bus.ends.remove(self)
            self._check_subscribers("**")

    def put(self, key: str, payload: bytes) -> None:
        for end in self._others():
            for subscription in end.subscriptions.meeting(key):
                self._loop.call_soon(_call, subscription, key, payload)

    def put_part(self, key: str, head: bytes, data: Data) -> None:
        for end in self._others():
            for subscription in end.part_subscriptions.meeting(key):
                self._loop.call_soon(_call, subscription, key, head, data)

    def subscribe_parts(self, pattern: str, on_part: Callable[[str, bytes, Data], None]) -> Handle:
        return _MemoryDeclared(self.part_subscriptions, pattern, on_part)

    def publisher(
        self,
        key: str,
        on_subscribers: Callable[[bool], None] | None = None,
        *,
        urgent: bool = False,
    ) -> Publisher:
        return _MemoryPublisher(self, self.publishers, key, on_subscribers)

    def subscribe(
        self, pattern: str, on_message: Callable[[str, bytes], None], *, patient: bool = False
    ) -> Handle:
        made = _MemoryDeclared(self.subscriptions, pattern, on_message)
        self._check_subscribers(pattern)
        return made.then(lambda: self._check_subscribers(pattern))

    def answer(
        self,
        pattern: str,
        answer: Callable[[BusQuestion], None],
        *,
        patient: Callable[[str], bool] = never,
    ) -> Handle:
        return _MemoryDeclared(self.answered, pattern, answer)

    async def ask(self, pattern: str, payload: bytes, timeout: float) -> list[tuple[str, bytes]]:
        questions = [
            (answerer, _MemoryQuestion(pattern, payload))
            for end in self._others()
            for answerer in end.answered.meeting(pattern)
        ]
        for answerer, question in questions:
            self._loop.call_soon(_call, answerer, question)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                for _, question in questions:
                    await question.done.wait()
        return [answer for _, question in questions for answer in question.answers]

    def be_present(self, key: str) -> Handle:
        made = _MemoryDeclared(self.present_here, key, _nothing)
        self._report_presence(key, True)
        return made.then(lambda: self._report_presence(key, False))

    async def present(self, pattern: str, timeout: float) -> list[str]:
        return [
            token.pattern for end in self._others() for token in end.present_here.meeting(pattern)
        ]

    def watch(self, pattern: str, on_presence: Callable[[str, bool], None]) -> Handle:
        made = _MemoryDeclared(self.watched, pattern, on_presence)
        for end in self._others():
            for token in end.present_here.meeting(pattern):
                self._loop.call_soon(_call, made, token.pattern, True)
        return made

    # ------------------------------------------------------------------ among ends

    def _others(self) -> list[MemoryEnd]:
        """Return the ends that receive from this one: all on the bus, including itself."""
        return list(self._bus.ends) if self.attached else []

    def _report_presences(self, present: bool) -> None:
        """Report this end's presences to all ends, and theirs to this one."""
        for end in self._others():
            for token in end.present_here:
                if end is not self:
                    for watch in self.watched.meeting(token.pattern):
                        self._loop.call_soon(_call, watch, token.pattern, present)
        for token in self.present_here:
            self._report_presence(token.pattern, present)

    def _report_presence(self, key: str, present: bool) -> None:
        for end in self._others():
            for watcher in end.watched.meeting(key):
                self._loop.call_soon(_call, watcher, key, present)

    def _check_subscribers(self, pattern: str) -> None:
        """Make the publishers under a pattern check for subscribers."""
        for end in self._bus.ends:
            for publisher in end.publishers.meeting(pattern):
                publisher.look()

    def has_subscribers(self, key: str) -> bool:
        """Return True if this end's messages under ``key`` have a subscriber."""
        return any(end.subscriptions.meeting(key) for end in self._others())


class _MemoryPublisher(Publisher):
    def __init__(
        self,
        end: MemoryEnd,
        place: _ByPattern[_MemoryPublisher],
        key: str,
        on_subscribers: Callable[[bool], None] | None,
    ) -> None:
        self.pattern = key
        self._end, self._place = end, place
        self._on_subscribers = on_subscribers
        place.add(self)
        self.look()

    def look(self) -> None:
        """Check for subscribers, and report a change."""
        has_subscribers = self._end.has_subscribers(self.pattern)
        if has_subscribers != self.has_subscribers:
            self.has_subscribers = has_subscribers
            if self._on_subscribers is not None:
                self._on_subscribers(has_subscribers)

    def put(self, payload: bytes) -> None:
        self._end.put(self.pattern, payload)

    def close(self) -> None:
        self._place.remove(self)


class _MemoryQuestion(BusQuestion):
    def __init__(self, key: str, payload: bytes) -> None:
        self.key, self.payload = key, payload
        self.answers: list[tuple[str, bytes]] = []
        self.done = asyncio.Event()

    def reply(self, key: str, payload: bytes) -> None:
        if not self.done.is_set():
            self.answers.append((key, payload))

    def close(self) -> None:
        self.done.set()


def _call(declared: _MemoryDeclared, *arguments: object) -> None:
    """Call a callback of an open declaration; log its error."""
    if not declared.closed:
        declared.call(*arguments)


def _nothing(*_: object) -> None:
    pass
