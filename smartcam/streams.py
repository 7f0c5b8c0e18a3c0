"""Bounded streams: each of any number of subscribers gets a camera's items in its own queue."""

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


def _zero_bytes(_item: object) -> int:
    return 0


class Queue(Generic[T]):
    """Base of both kinds of subscription: a bounded queue that counts the items that it drops.

    Args:
        name: kind of the subscribed items.
        max_queue: number of items kept for a slow reader.
        overflow: value of :class:`Overflow`, the consequence of a full queue.
        min_interval: seconds after a kept item during which further items are dropped.
        max_queue_bytes: largest number of bytes of all kept items. A larger single item is kept if
            the queue is empty: otherwise it could never be delivered.
        size_of: function that returns the number of bytes of an item; not called for errors.

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
        size_of: Callable[[T], int] = _zero_bytes,
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
        self._last_kept_at = float("-inf")
        self._offered = self._taken = self._dropped = 0
        self._errors = 0  # number of errors among the items
        # The bytes of taken items are subtracted when a new item comes, so that taking costs
        # nothing. A parcel stands for items that came together: the number of its last item, the
        # number of items, their bytes.
        self._parcels: collections.deque[tuple[int, int, int]] = collections.deque()
        self._bytes = 0  # bytes of all parcels, part of which may belong to items that are gone
        self._missed = 0
        self.since: float = -math.inf  # time of the subscription, on the clock of the items
        self._evicted = 0  # dropped items that had been queued; only these were numbered

    @property
    def ended(self) -> bool:
        """True once nothing more will come."""
        return self._ended

    @property
    def waiting(self) -> bool:
        """True if an item or an error is queued."""
        return bool(self._items)

    def share(self, ready: asyncio.Event) -> None:
        """Set this event when an item comes or the stream ends; several streams may share it."""
        self._ready = ready
        if self._items or self._ended:
            ready.set()

    def hold_source(self, source: object) -> None:
        """Keep a reference to the items' source, since a program may keep only the stream."""
        if not self._ended:
            self._source = source

    def statistics(self) -> SubscriberStatistics:
        """Return the numbers of offered, taken, dropped and queued items so far."""
        self._recount_bytes()
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
        """Wait until an item is queued.

        Raises:
            StopAsyncIteration: the stream is closed.
            SmartCamError: the reason why the stream has ended.
        """
        while not self._items:
            if self._ended:
                if self._end_error is not None:
                    raise self._end_error.with_traceback(None)  # each raise would lengthen it
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
        if now - self._last_kept_at < self._min_interval:
            self._dropped += 1
            return
        items = self._items
        full = len(items) >= self._max_queue or self._bytes + size > self._max_queue_bytes
        if full and not self._make_room(size):
            return
        self._last_kept_at = now
        self._errors += isinstance(item, SmartCamError)
        items.append(item)
        if size:
            self._add_parcel(1, size)
        self._ready.set()

    def offer_all(self, items: Sequence[T], now: float, size: int = 0) -> None:
        """Hand over several items that came together, as :meth:`offer` does for each.

        Args:
            items: the items.
            now: time at which they came.
            size: bytes of all items together.
        """
        queued = self._items
        if (
            self._min_interval
            or len(queued) + len(items) > self._max_queue
            or self._would_exceed(size)
        ):
            for item in items:
                self.offer(item, now, self._size_of(item))
        elif items and not self._ended:
            self._offered += len(items)
            self._last_kept_at = now
            queued.extend(items)
            if size:
                self._add_parcel(len(items), size)
            self._ready.set()

    def miss(self, count: int) -> None:
        """Count items that the camera sent and that were lost on their way."""
        if not self._ended:
            self._missed += count

    def end(self, error: SmartCamError | None) -> None:
        """End the stream after the queued items; if it has ended already, its reason stays."""
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
            elif self._would_exceed(size):
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

    def _would_exceed(self, size: int) -> bool:
        """Return True if the queue has no room for ``size`` more bytes."""
        if self._bytes + size <= self._max_queue_bytes:
            return False
        self._recount_bytes()
        return self._bytes + size > self._max_queue_bytes

    def _add_parcel(self, count: int, size: int) -> None:
        """Count the bytes of the last ``count`` items, which have just been queued."""
        parcels, queued = self._parcels, len(self._items)
        if queued == count:  # nothing else is queued
            parcels.clear()
            self._bytes = size
        else:
            if len(parcels) >= queued:  # some parcels have no queued item any more
                self._forget_gone_parcels()
            self._bytes += size
        parcels.append((self._taken + self._evicted + queued, count, size))

    def _forget_gone_parcels(self) -> int:
        """Forget parcels without queued items; return the number of the last item that is gone."""
        parcels, gone = self._parcels, self._taken + self._evicted
        while parcels and parcels[0][0] <= gone:
            self._bytes -= parcels.popleft()[2]
        return gone

    def _recount_bytes(self) -> None:
        """Make the bytes of all parcels those of the items that are queued now."""
        gone, parcels = self._forget_gone_parcels(), self._parcels
        if parcels and parcels[0][0] - parcels[0][1] < gone:
            # the first parcel is partly gone: each of its other items becomes a parcel
            last, _, size = parcels.popleft()
            remaining = cast("list[T]", list(itertools.islice(self._items, last - gone)))
            sizes = [self._size_of(item) for item in remaining]
            singles = zip(range(gone + 1, last + 1), itertools.repeat(1), sizes, strict=False)
            parcels.extendleft(reversed([*singles]))
            self._bytes += sum(sizes) - size


class Subscription(Queue[T]):
    """A bounded stream of items: ``async for item in subscription``.

    It subscribes when it is made and ends when it is closed, garbage collected, or the client
    closes. Its counts always agree: ``offered == taken + dropped + queued``.

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
    """The queues that get items; a queue to which nothing else refers is removed.

    Adding and removing a queue take the same time for any number of queues.
    """

    __slots__ = ("_references_copy", "added_count", "offered_at", "references")

    def __init__(self) -> None:
        self.added_count: int = 0  # number of queues added so far
        # time of the items that are offered now; queues with a later ``since`` do not get them
        self.offered_at: float = math.inf
        # the queues; every message tests whether there is one
        self.references: dict[weakref.ref[Queue[T]], None] = {}
        # copy to iterate over while queues are removed; None if it has to be made again
        self._references_copy: list[weakref.ref[Queue[T]]] | None = None

    def add(self, queue: Queue[T]) -> None:
        """Offer a subscriber all items from now on."""
        self.references[weakref.ref(queue, self._discard)] = None
        self._references_copy = None
        self.added_count += 1

    def _discard(self, reference: weakref.ref[Queue[T]]) -> None:
        self.references.pop(reference, None)
        self._references_copy = None

    def __bool__(self) -> bool:
        return bool(self.references)

    @property
    def has_open_queue(self) -> bool:
        """True if a queue would take an item that is offered now."""
        for reference in self._references_copy or self._copy_references():
            queue = reference()
            if queue is not None and not queue.ended and queue.since <= self.offered_at:
                return True
        return False

    def offer(self, item: T | SmartCamError, now: float, size: int = 0) -> None:
        """Hand an item of ``size`` bytes to each queue."""
        for reference in self._references_copy or self._copy_references():
            queue = reference()
            if queue is not None and queue.since <= self.offered_at:
                queue.offer(item, now, size)

    def __iter__(self) -> Iterator[Queue[T]]:
        for reference in self._references_copy or self._copy_references():
            queue = reference()
            if queue is not None and queue.since <= self.offered_at:
                yield queue

    def _copy_references(self) -> list[weakref.ref[Queue[T]]]:
        """Return the references in a list that does not change while queues are removed."""
        self._references_copy = references = list(self.references)
        return references
