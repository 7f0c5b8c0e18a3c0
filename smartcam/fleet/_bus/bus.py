"""Define the bus of a fleet, on which programs and agents exchange messages under keys.

A key consists of chunks joined by ``/``; in a pattern ``*`` stands for one chunk, and ``**`` for
any number of chunks. Messages reach a subscriber in the order in which they were sent. But sending
never waits, and messages may be lost. So senders number the messages whose loss matters.

:class:`MemoryBus` is the bus inside a process; :mod:`smartcam.fleet._bus.zenoh` has the bus between
processes. A connection to a bus belongs to one event loop, in which all its callbacks run.
"""

from __future__ import annotations

import abc
import asyncio
import contextlib
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from smartcam.fleet._bus.keys import patterns_overlap

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import Self

    from smartcam.fleet._security.certificates import Identity

Data = bytes | bytearray | memoryview


def never(_: str) -> bool:
    """Return False: no question has a low priority."""
    return False


def always(_: str) -> bool:
    """Return True: each question has a low priority."""
    return True


class Handle(abc.ABC):
    """A subscription, or another declaration on the bus, that lasts until it is closed."""

    @abc.abstractmethod
    def close(self) -> None:
        """End the declaration; idempotent."""


class Publisher(Handle):
    """A declaration that publishes under one key.

    Attributes:
        has_subscribers: whether the publisher has a known subscriber.
    """

    has_subscribers: bool = False

    @abc.abstractmethod
    def put(self, payload: bytes) -> None:
        """Publish the payload; never block."""


class Bus(abc.ABC):
    """A connection of a program or an agent to a bus.

    Attributes:
        local: whether all connections to the bus are in this event loop. Then large data are passed
            on without a copy, and all share one clock.
        identity: identity in the certificate of this program or agent; None without a certificate.
    """

    local: bool = False
    identity: Identity | None = None

    @property
    def waiting_bytes(self) -> int:
        """Number of bytes that wait to be sent; 0 if nothing ever waits."""
        return 0

    @property
    @abc.abstractmethod
    def is_connected(self) -> bool:
        """True if this connection is open, and no loss of the bus is known."""

    @abc.abstractmethod
    async def open(self, timeout: float) -> Self:
        """Connect to the bus.

        Raises:
            ConnectFailedError: there is no bus within ``timeout`` seconds.
        """

    @abc.abstractmethod
    async def close(self) -> None:
        """Leave the bus, which ends all its declarations. Idempotent."""

    @abc.abstractmethod
    def put(self, key: str, payload: bytes) -> None:
        """Send a message for which a receiver waits, such as a call or a reply; never block."""

    @abc.abstractmethod
    def put_part(self, key: str, head: bytes, data: Data) -> None:
        """Send a part of large data at the lowest priority, with a head that describes the part.

        The part is dropped if there is no room in the queue. ``data`` must not be changed later.
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
            on_subscribers: callback that is called with True when the key gets its first
                subscriber, and with False when the last subscriber has left.
            urgent: True: messages wait in the same queue as messages of :meth:`put`; False: they
                wait until that queue is empty.
        """

    @abc.abstractmethod
    def subscribe(
        self, pattern: str, on_message: Callable[[str, bytes], None], *, low_priority: bool = False
    ) -> Handle:
        """Call ``on_message(key, payload)`` for messages under ``pattern``.

        Args:
            pattern: pattern of the keys.
            on_message: the callback.
            low_priority: whether messages wait until all messages of other subscriptions were
                handled. The waiting messages have a bound of their own.
        """

    @abc.abstractmethod
    def answer(
        self,
        pattern: str,
        answer: Callable[[BusQuestion], None],
        *,
        low_priority: Callable[[str], bool] = never,
    ) -> Handle:
        """Call ``answer(question)`` for questions under ``pattern``.

        Args:
            pattern: pattern of the keys.
            answer: the callback.
            low_priority: function that returns whether a question under a key waits until other
                messages were received, as in :meth:`subscribe`. It may be called in any thread.
        """

    @abc.abstractmethod
    async def ask(self, pattern: str, payload: bytes, timeout: float) -> list[tuple[str, bytes]]:
        """Return the answers to a question that come within ``timeout`` seconds, by their keys."""

    @abc.abstractmethod
    def announce(self, key: str) -> Handle:
        """Announce a presence under a key until the handle is closed."""

    @abc.abstractmethod
    async def present_keys(self, pattern: str, timeout: float) -> list[str]:
        """Return the keys of all presences that become known within ``timeout`` seconds."""

    @abc.abstractmethod
    def watch(self, pattern: str, on_presence: Callable[[str, bool], None]) -> Handle:
        """Call ``on_presence(key, present)`` for all presences, and at each change."""


class BusQuestion(abc.ABC):
    """A received question that is not answered yet.

    Attributes:
        key: key or pattern to which the question was sent.
        payload: bytes of the question.
    """

    key: str
    payload: bytes

    @abc.abstractmethod
    def reply(self, key: str, payload: bytes) -> None:
        """Send an answer; call it once for each key if the question asks for several keys.

        The bus may hold the answers back until the question is closed.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """End the question after its last answer; never block. Idempotent."""


# ---------------------------------------------------------------------- inside a process


class MemoryBus:
    """A bus inside this process, for agents and programs in one event loop.

    Each agent and program gets its own ``MemoryBus().new_connection()``. Messages are delivered by
    the event loop, in order.
    """

    def __init__(self) -> None:
        self.connections: list[MemoryConnection] = []

    def new_connection(self) -> MemoryConnection:
        """Return a connection that is not open yet."""
        return MemoryConnection(self)


class _Patterned(Protocol):
    pattern: str


P = TypeVar("P", bound=_Patterned)


class _PatternTable(Generic[P]):
    """Declarations of one kind of a connection, by pattern, to find those of a key fast."""

    def __init__(self) -> None:
        self._exact_keys: dict[str, dict[P, None]] = {}
        self._wildcards: dict[P, None] = {}

    def __iter__(self) -> Iterator[P]:
        for entries in (*self._exact_keys.values(), self._wildcards):
            yield from tuple(entries)

    def __contains__(self, entry: P) -> bool:
        return entry in self._wildcards or entry in self._exact_keys.get(entry.pattern, ())

    def add(self, entry: P) -> None:
        entries = (
            self._wildcards
            if "*" in entry.pattern
            else self._exact_keys.setdefault(entry.pattern, {})
        )
        entries[entry] = None

    def remove(self, entry: P) -> None:
        self._wildcards.pop(entry, None)
        entries = self._exact_keys.get(entry.pattern, {})
        entries.pop(entry, None)
        if not entries:
            self._exact_keys.pop(entry.pattern, None)

    def clear(self) -> None:
        self._exact_keys.clear()
        self._wildcards.clear()

    def matching(self, pattern: str) -> list[P]:
        """Return the entries whose pattern can match the same key as the given pattern or key."""
        if "*" in pattern:
            return [entry for entry in self if patterns_overlap(entry.pattern, pattern)]
        wild = [entry for entry in self._wildcards if patterns_overlap(entry.pattern, pattern)]
        return [*self._exact_keys.get(pattern, ()), *wild]


class _MemoryDeclaration(Handle):
    """A declaration of a connection under a pattern."""

    def __init__(
        self, table: _PatternTable[_MemoryDeclaration], pattern: str, call: Callable[..., None]
    ) -> None:
        self.pattern = pattern
        self.call = call
        self._table = table
        self._on_close: Callable[[], None] = _do_nothing
        table.add(self)

    def on_close(self, callback: Callable[[], None]) -> Self:
        """Call ``callback`` when the declaration is closed; return the declaration."""
        self._on_close = callback
        return self

    @property
    def closed(self) -> bool:
        """True once the declaration is closed."""
        return self not in self._table

    def close(self) -> None:
        if not self.closed:
            self._table.remove(self)
            self._on_close()


class MemoryConnection(Bus):
    """A connection to a :class:`MemoryBus`."""

    local = True

    def __init__(self, bus: MemoryBus) -> None:
        self._bus = bus
        self.part_subscriptions: _PatternTable[_MemoryDeclaration] = _PatternTable[
            _MemoryDeclaration
        ]()
        self.subscriptions: _PatternTable[_MemoryDeclaration] = _PatternTable[_MemoryDeclaration]()
        self.answerers: _PatternTable[_MemoryDeclaration] = _PatternTable[_MemoryDeclaration]()
        self.watchers: _PatternTable[_MemoryDeclaration] = _PatternTable[_MemoryDeclaration]()
        self.presences: _PatternTable[_MemoryDeclaration] = _PatternTable[_MemoryDeclaration]()
        self.publishers: _PatternTable[_MemoryPublisher] = _PatternTable[_MemoryPublisher]()

    @property
    def attached(self) -> bool:
        """True if this connection is on the bus now: opened, and not detached."""
        return self in self._bus.connections

    @property
    def is_connected(self) -> bool:
        return self.attached

    async def open(self, timeout: float) -> Self:
        self._loop = asyncio.get_running_loop()
        self.attach()
        return self

    async def close(self) -> None:
        self.detach()
        tables = (
            self.subscriptions,
            self.part_subscriptions,
            self.answerers,
            self.watchers,
            self.presences,
        )
        for table in tables:
            table.clear()

    def attach(self) -> None:
        """Join the bus, or join it again."""
        if not self.attached:
            self._bus.connections.append(self)
            self._report_presences(True)
            self._check_subscribers("**")

    def detach(self) -> None:
        """Leave the bus as if a cable broke: this connection and the others lose each other."""
        if self.attached:
            self._report_presences(False)
            self._bus.connections.remove(self)
            self._check_subscribers("**")

    def put(self, key: str, payload: bytes) -> None:
        for connection in self._connections():
            for subscription in connection.subscriptions.matching(key):
                self._loop.call_soon(_call, subscription, key, payload)

    def put_part(self, key: str, head: bytes, data: Data) -> None:
        for connection in self._connections():
            for subscription in connection.part_subscriptions.matching(key):
                self._loop.call_soon(_call, subscription, key, head, data)

    def subscribe_parts(self, pattern: str, on_part: Callable[[str, bytes, Data], None]) -> Handle:
        return _MemoryDeclaration(self.part_subscriptions, pattern, on_part)

    def publisher(
        self,
        key: str,
        on_subscribers: Callable[[bool], None] | None = None,
        *,
        urgent: bool = False,
    ) -> Publisher:
        return _MemoryPublisher(self, self.publishers, key, on_subscribers)

    def subscribe(
        self, pattern: str, on_message: Callable[[str, bytes], None], *, low_priority: bool = False
    ) -> Handle:
        declaration = _MemoryDeclaration(self.subscriptions, pattern, on_message)
        self._check_subscribers(pattern)
        return declaration.on_close(lambda: self._check_subscribers(pattern))

    def answer(
        self,
        pattern: str,
        answer: Callable[[BusQuestion], None],
        *,
        low_priority: Callable[[str], bool] = never,
    ) -> Handle:
        return _MemoryDeclaration(self.answerers, pattern, answer)

    async def ask(self, pattern: str, payload: bytes, timeout: float) -> list[tuple[str, bytes]]:
        questions = [
            (answerer, _MemoryQuestion(pattern, payload))
            for connection in self._connections()
            for answerer in connection.answerers.matching(pattern)
        ]
        for answerer, question in questions:
            self._loop.call_soon(_call, answerer, question)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                for _, question in questions:
                    await question.done.wait()
        return [answer for _, question in questions for answer in question.answers]

    def announce(self, key: str) -> Handle:
        declaration = _MemoryDeclaration(self.presences, key, _do_nothing)
        self._report_presence(key, True)
        return declaration.on_close(lambda: self._report_presence(key, False))

    async def present_keys(self, pattern: str, timeout: float) -> list[str]:
        return [
            token.pattern
            for connection in self._connections()
            for token in connection.presences.matching(pattern)
        ]

    def watch(self, pattern: str, on_presence: Callable[[str, bool], None]) -> Handle:
        declaration = _MemoryDeclaration(self.watchers, pattern, on_presence)
        for connection in self._connections():
            for token in connection.presences.matching(pattern):
                self._loop.call_soon(_call, declaration, token.pattern, True)
        return declaration

    # ------------------------------------------------------------------ presence and subscribers

    def _connections(self) -> list[MemoryConnection]:
        """Return all connections to the bus, with this one; none if this one is not on the bus."""
        return list(self._bus.connections) if self.attached else []

    def _report_presences(self, present: bool) -> None:
        """Report this connection's presences to all others, and theirs to this one."""
        for connection in self._connections():
            for token in connection.presences:
                if connection is not self:
                    for watch in self.watchers.matching(token.pattern):
                        self._loop.call_soon(_call, watch, token.pattern, present)
        for token in self.presences:
            self._report_presence(token.pattern, present)

    def _report_presence(self, key: str, present: bool) -> None:
        for connection in self._connections():
            for watcher in connection.watchers.matching(key):
                self._loop.call_soon(_call, watcher, key, present)

    def _check_subscribers(self, pattern: str) -> None:
        """Make the publishers under a pattern check for subscribers."""
        for connection in self._bus.connections:
            for publisher in connection.publishers.matching(pattern):
                publisher.check_subscribers()

    def has_subscribers(self, key: str) -> bool:
        """Return True if this connection's messages under ``key`` have a subscriber."""
        return any(connection.subscriptions.matching(key) for connection in self._connections())


class _MemoryPublisher(Publisher):
    def __init__(
        self,
        connection: MemoryConnection,
        table: _PatternTable[_MemoryPublisher],
        key: str,
        on_subscribers: Callable[[bool], None] | None,
    ) -> None:
        self.pattern = key
        self._connection, self._table = connection, table
        self._on_subscribers = on_subscribers
        table.add(self)
        self.check_subscribers()

    def check_subscribers(self) -> None:
        """Check for subscribers, and report a change."""
        has_subscribers = self._connection.has_subscribers(self.pattern)
        if has_subscribers != self.has_subscribers:
            self.has_subscribers = has_subscribers
            if self._on_subscribers is not None:
                self._on_subscribers(has_subscribers)

    def put(self, payload: bytes) -> None:
        self._connection.put(self.pattern, payload)

    def close(self) -> None:
        self._table.remove(self)


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


def _call(declared: _MemoryDeclaration, *arguments: object) -> None:
    """Call the callback of a declaration, unless the declaration is closed."""
    if not declared.closed:
        declared.call(*arguments)


def _do_nothing(*_: object) -> None:
    pass
