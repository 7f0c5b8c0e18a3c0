"""Bounded streams: a camera's items for any number of independent subscribers."""

from __future__ import annotations

import asyncio
import collections
import enum
import itertools
import math
import sys
import weakref
from typing import TYPE_CHECKING, Generic, TypeVar, cast

from smartcam._arguments import check_choice, check_integer, check_seconds
from smartcam.exceptions import SmartCamError, SubscriberOverflowError
from smartcam.models import SubscriberStatistics

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator, Sequence
    from types import TracebackType
    from typing import NoReturn, Self

__all__ = ["BatchSubscription", "Subscription"]

T = TypeVar("T")


class Overflow(enum.Enum):
    """The treatment of a new item when a subscriber's queue is full."""

    DROP_OLDEST = "drop_oldest"
    """The oldest item is dropped and counted."""
    ERROR = "error"
    """The stream ends with :exc:`~smartcam.SubscriberOverflowError`, after the queued
    items."""


_OVERFLOWS = [overflow.value for overflow in Overflow]


def _weightless(_item: object) -> int:
    return 0


class Queue(Generic[T]):
    """Base of both kinds of subscription: a bounded queue that counts what it drops.

    Args:
        name: kind of the subscribed items.
        max_queue: number of items kept for a slow reader.
        overflow: value of :class:`Overflow`, the consequence of a full queue.
        min_interval: seconds after a kept item in which further items are dropped.
        max_queue_bytes: largest number of bytes of all kept items. A larger single item is kept if
            the queue is empty: otherwise it could never be delivered.
        size_of: function that returns the bytes of an item that is no error.

    Raises:
        ConfigurationError: an argument cannot work.
    """

    def __init__(
        self,
        name: str,
        *,
        max_queue: int,
        overflow: str,
        min_interval: float = 0.0,
        max_queue_bytes: int = sys.maxsize,
        size_of: Callable[[T], int] = _weightless,
    ) -> None:
        owner = f"{name}()"
        self._name = name
        self._max_queue = check_integer(max_queue, "max_queue", 1, owner=owner)
        self._max_queue_bytes = check_integer(max_queue_bytes, "max_queue_bytes", 1, owner=owner)
        self._overflow = Overflow(check_choice(overflow, "overflow", _OVERFLOWS, owner))
        self._min_interval = check_seconds(min_interval, "min_interval", owner)
        self._size_of = size_of
        self._items: collections.deque[T | SmartCamError] = collections.deque()
        self._ready = asyncio.Event()
        self._ended = False
        self._end_error: SmartCamError | None = None
        self._source: object = None
        self._last = float("-inf")
        self._offered = self._taken = self._dropped = 0
        self._errors = 0  # number of errors among the items
        # Bytes are counted, and the bytes of taken items subtracted, when items come, so that
        # taking costs nothing. A parcel came together: number of its last item, items, bytes.
        self._parcels: collections.deque[tuple[int, int, int]] = collections.deque()
        self._bytes = 0  # bytes of all parcels, some of which may belong to dropped items
        self._missed = 0
        self.since: float = -math.inf  # time of the subscription, on the clock of the items
        self._evicted = 0  # dropped items that were queued before: only these have numbers

    @property
    def ended(self) -> bool:
        """True once nothing more will come."""
        return self._ended

    @property
    def waiting(self) -> bool:
        """True if something is there to be taken."""
        return bool(self._items)

    def share(self, ready: asyncio.Event) -> None:
        """Set this event when an item comes, or the stream ends; for readers of several streams."""
        self._ready = ready
        if self._items or self._ended:
            ready.set()

    def keep(self, source: object) -> None:
        """Keep a reference to the items' source, for a program that keeps the stream alone."""
        if not self._ended:
            self._source = source

    def statistics(self) -> SubscriberStatistics:
        """Return the account as it is now."""
        self._weigh()
        return SubscriberStatistics(
            name=self._name,
            policy=self._overflow.value,
            offered=self._offered,
            taken=self._taken,
            dropped=self._dropped,
            queued=len(self._items),
            queued_bytes=self._bytes,
            missed=self._missed,
        )

    def close(self) -> None:
        """Unsubscribe; queued items count as dropped. Idempotent."""
        self._dropped += len(self._items)
        self._evicted += len(self._items)
        self._items.clear()
        self._parcels.clear()
        self._errors = self._bytes = 0
        self.end(None)

    async def _wait(self) -> None:
        """Wait until an item is there.

        Raises:
            StopAsyncIteration: the stream is closed.
            SmartCamError: the reason why the stream has ended.
        """
        while not self._items:
            if self._ended:
                if self._end_error is not None:
                    raise self._end_error.with_traceback(None)  # else it grows with each raise
                raise StopAsyncIteration
            self._ready.clear()
            await self._ready.wait()

    def __iter__(self) -> NoReturn:
        raise TypeError(
            f"{self._name}() is read by `async for`; without asyncio: smartcam.sync.connect(...)"
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        self.close()

    # ------------------------------------------------------------------ for the client

    def offer(self, item: T | SmartCamError, now: float, size: int = 0) -> None:
        """Hand an item of ``size`` bytes to the subscriber; never waits."""
        if self._ended:
            return
        self._offered += 1
        if now - self._last < self._min_interval:
            self._dropped += 1
            return
        items = self._items
        full = len(items) >= self._max_queue or self._bytes + size > self._max_queue_bytes
        if full and not self._make_room(size):
            return
        self._last = now
        self._errors += isinstance(item, SmartCamError)
        items.append(item)
        if size:
            self._add_parcel(1, size)
        self._ready.set()

    def offer_all(self, items: Sequence[T], now: float, size: int = 0) -> None:
        """Hand several items over that came together; as :meth:`offer` for each.

        Args:
            items: the items.
            now: when they came.
            size: bytes of all of them.
        """
        queued = self._items
        if (
            self._min_interval
            or len(queued) + len(items) > self._max_queue
            or self._exceeded_by(size)
        ):
            for item in items:
                self.offer(item, now, self._size_of(item))
        elif items and not self._ended:
            self._offered += len(items)
            self._last = now
            queued.extend(items)
            if size:
                self._add_parcel(len(items), size)
            self._ready.set()

    def miss(self, count: int) -> None:
        """Count items that were sent and cannot come any more."""
        if not self._ended:
            self._missed += count

    def end(self, error: SmartCamError | None) -> None:
        """End the stream after the queued items; the first reason stays."""
        if not self._ended:
            self._ended = True
            self._end_error = error
            self._source = None
        self._ready.set()

    # ------------------------------------------------------------------ inside

    def _make_room(self, size: int) -> bool:
        """Apply the overflow policy to an item of ``size`` bytes; return False if it is refused."""
        items = self._items
        while items:
            if len(items) >= self._max_queue:
                bound = f"{self._max_queue} items"
            elif self._exceeded_by(size):
                bound = f"{self._max_queue_bytes} bytes"
            else:
                break
            self._dropped += 1
            if self._overflow is Overflow.ERROR:
                self.end(SubscriberOverflowError(f"{self._name}(): more than {bound} were waiting"))
                return False
            self._evicted += 1
            self._errors -= isinstance(items.popleft(), SmartCamError)
        return True

    def _exceeded_by(self, size: int) -> bool:
        """Return True if ``size`` bytes more are too many for the queue."""
        if self._bytes + size <= self._max_queue_bytes:
            return False
        self._weigh()
        return self._bytes + size > self._max_queue_bytes

    def _add_parcel(self, count: int, size: int) -> None:
        """Count the bytes of the last ``count`` items, which are queued by now."""
        parcels, queued = self._parcels, len(self._items)
        if queued == count:  # nothing else is queued
            parcels.clear()
            self._bytes = size
        else:
            if len(parcels) >= queued:  # some are of items that are gone
                self._subtract_gone()
            self._bytes += size
        parcels.append((self._taken + self._evicted + queued, count, size))

    def _subtract_gone(self) -> int:
        """Forget parcels without queued items; return the number of all items gone so far."""
        parcels, gone = self._parcels, self._taken + self._evicted
        while parcels and parcels[0][0] <= gone:
            self._bytes -= parcels.popleft()[2]
        return gone

    def _weigh(self) -> None:
        """Recount the bytes of all parcels from the items that are queued."""
        gone, parcels = self._subtract_gone(), self._parcels
        if parcels and parcels[0][0] - parcels[0][1] < gone:
            # partly taken: from now on each of its other items is a parcel
            last, _, size = parcels.popleft()
            left = cast("list[T]", list(itertools.islice(self._items, last - gone)))
            sizes = [self._size_of(item) for item in left]
            each = zip(range(gone + 1, last + 1), itertools.repeat(1), sizes, strict=False)
            parcels.extendleft(reversed([*each]))
            self._bytes += sum(sizes) - size


class Subscription(Queue[T]):
    """A bounded stream of items: ``async for item in subscription``.

    It subscribes when it is made and ends when it is closed, garbage collected, or the client
    closes. Its account always balances: ``offered == taken + dropped + queued``.

    Cancellation: safe, nothing is lost; an item is taken as the last step.
    """

    def __aiter__(self) -> AsyncIterator[T]:
        return self

    async def __anext__(self) -> T:
        """Return the next item.

        Raises:
            StopAsyncIteration: the stream is closed.
            SmartCamError: an item that is an error (the stream stays usable), or the stream's end.
        """
        if not self._items:
            await self._wait()
        item = self._items.popleft()
        self._taken += 1
        if isinstance(item, SmartCamError):
            self._errors -= 1
            raise item
        return item


class BatchSubscription(Queue[T]):
    """A bounded stream of batches: ``async for items in subscription`` gives all waiting items.

    Cancellation: safe, nothing is lost; a batch is taken as the last step.
    """

    def __aiter__(self) -> AsyncIterator[list[T]]:
        return self

    async def __anext__(self) -> list[T]:
        """Return all items that wait, at least one; only those before an error, if there is one.

        Raises:
            StopAsyncIteration: the stream is closed.
            SmartCamError: an item that is an error (the stream stays usable), or the stream's end.
        """
        if not self._items:
            await self._wait()
        items = self._items
        batch: list[T] = []  # list[T]() costs twenty times as much
        if not self._errors:
            batch = cast("list[T]", list(items))
            items.clear()
        while items:
            item = items.popleft()
            if not isinstance(item, SmartCamError):
                batch.append(item)
            elif batch:
                items.appendleft(item)
                break
            else:
                self._errors -= 1
                self._taken += 1
                raise item
        self._taken += len(batch)
        return batch


class Subscribers(Generic[T]):
    """The queues that are offered items; a queue without other references is removed.

    The work to subscribe and to leave does not depend on the number of queues.
    """

    __slots__ = ("_in_order", "added_count", "horizon", "references")

    def __init__(self) -> None:
        self.added_count: int = 0  # number of subscribers so far
        # age of the items offered now; later subscribers do not get them
        self.horizon: float = math.inf
        # empty without subscribers: looked at for every message
        self.references: dict[weakref.ref[Queue[T]], None] = {}
        # copy to iterate over while some leave; None if it must be made again
        self._in_order: list[weakref.ref[Queue[T]]] | None = None

    def add(self, queue: Queue[T]) -> None:
        """Offer a subscriber all items from now on."""
        self.references[weakref.ref(queue, self._discard)] = None
        self._in_order = None
        self.added_count += 1

    def _discard(self, reference: weakref.ref[Queue[T]]) -> None:
        self.references.pop(reference, None)
        self._in_order = None

    def __bool__(self) -> bool:
        return bool(self.references)

    @property
    def any_open(self) -> bool:
        """True if something that is offered now would be queued."""
        for reference in self._in_order or self._ordered():
            queue = reference()
            if queue is not None and not queue.ended and queue.since <= self.horizon:
                return True
        return False

    def offer(self, item: T | SmartCamError, now: float, size: int = 0) -> None:
        """Hand an item of ``size`` bytes to each queue."""
        for reference in self._in_order or self._ordered():
            queue = reference()
            if queue is not None and queue.since <= self.horizon:
                queue.offer(item, now, size)

    def __iter__(self) -> Iterator[Queue[T]]:
        for reference in self._in_order or self._ordered():
            queue = reference()
            if queue is not None and queue.since <= self.horizon:
                yield queue

    def _ordered(self) -> list[weakref.ref[Queue[T]]]:
        """Return the references, in a list that stays as it is while some leave."""
        self._in_order = references = list(self.references)
        return references
