"""Bounded streams: what a camera says, to any number of subscribers side by side."""

from __future__ import annotations

import asyncio
import collections
import enum
from typing import TYPE_CHECKING, Generic, TypeVar

from smartcam.exceptions import ConfigurationError, SmartCamError, SubscriberOverflowError
from smartcam.models import SubscriberStatistics

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from types import TracebackType
    from typing import Self

__all__ = ["Overflow", "Subscription"]

T = TypeVar("T")


class Overflow(enum.Enum):
    """What happens when a subscriber's queue is full."""

    DROP_OLDEST = "drop_oldest"
    """The oldest item makes room; it is counted."""
    ERROR = "error"
    """The stream ends with :exc:`~smartcam.exceptions.SubscriberOverflowError`, after what is
    queued."""


class Subscription(Generic[T]):
    """A bounded stream of items: ``async for item in subscription``.

    It subscribes when it is made and ends when it is closed, garbage collected, or the client
    closes. Its account always balances: ``offered == taken + dropped + queued``.

    Cancellation: safe, nothing is lost; an item is taken as the last step.

    Args:
        name: what is subscribed to.
        max_queue: items kept for a slow reader.
        overflow: what happens beyond that: a value of :class:`Overflow`.
        min_interval: seconds; an item that comes sooner after the last one kept is dropped.

    Raises:
        ConfigurationError: an argument cannot work.
    """

    def __init__(
        self, name: str, *, max_queue: int, overflow: str, min_interval: float = 0.0
    ) -> None:
        if max_queue < 1 or not 0 <= min_interval < float("inf"):
            raise ConfigurationError(
                f"{name}(): max_queue must be 1 or more (got {max_queue}), "
                f"min_interval 0 or more seconds (got {min_interval})"
            )
        try:
            self._overflow = Overflow(overflow)
        except ValueError as exc:
            known = " or ".join(repr(one.value) for one in Overflow)
            raise ConfigurationError(f"{name}(): overflow is {known}, not {overflow!r}") from exc
        self._name = name
        self._max_queue = max_queue
        self._min_interval = min_interval
        self._items: collections.deque[T | SmartCamError] = collections.deque()
        self._ready = asyncio.Event()
        self._ended = False
        self._end_error: SmartCamError | None = None
        self._last = float("-inf")
        self._offered = self._taken = self._dropped = 0

    @property
    def ended(self) -> bool:
        """Whether nothing more will come."""
        return self._ended

    def statistics(self) -> SubscriberStatistics:
        """Return the account as it is now."""
        return SubscriberStatistics(
            name=self._name,
            policy=self._overflow.value,
            offered=self._offered,
            taken=self._taken,
            dropped=self._dropped,
            queued=len(self._items),
        )

    def close(self) -> None:
        """Unsubscribe; what is queued counts as dropped. Idempotent."""
        self._dropped += len(self._items)
        self._items.clear()
        self.end(None)

    def __aiter__(self) -> AsyncIterator[T]:
        return self

    async def __anext__(self) -> T:
        """Return the next item.

        Raises:
            StopAsyncIteration: closed.
            SmartCamError: an item that is an error (the stream stays usable), or how it ended.
        """
        while not self._items:
            if self._ended:
                if self._end_error is not None:
                    raise self._end_error.with_traceback(None)  # it would grow with each raise
                raise StopAsyncIteration
            self._ready.clear()
            await self._ready.wait()
        item = self._items.popleft()
        self._taken += 1
        if isinstance(item, SmartCamError):
            raise item
        return item

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        self.close()

    # ------------------------------------------------------------------ for the client

    def offer(self, item: T | SmartCamError, now: float) -> None:
        """Hand an item to the subscriber; never waits."""
        if self._ended:
            return
        self._offered += 1
        if now - self._last < self._min_interval:
            self._dropped += 1
            return
        if len(self._items) >= self._max_queue:
            self._dropped += 1
            if self._overflow is Overflow.ERROR:
                self.end(
                    SubscriberOverflowError(
                        f"{self._name}(): more than {self._max_queue} items were waiting"
                    )
                )
                return
            self._items.popleft()
        self._last = now
        self._items.append(item)
        self._ready.set()

    def end(self, error: SmartCamError | None) -> None:
        """End the stream after what is queued; the first reason stays."""
        if not self._ended:
            self._ended = True
            self._end_error = error
        self._ready.set()
