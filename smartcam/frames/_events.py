"""Read the events that a device reports beside its pictures."""

from __future__ import annotations

import asyncio
import collections
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from smartcam._arguments import check_integer, check_seconds_or_none, check_text, wrong_argument
from smartcam._finishing import finish
from smartcam.exceptions import FrameSourceError, FrameTimeoutError, LocalProtocolError

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping
    from typing import Self

    from smartcam.frames._features import FeatureValue
    from smartcam.frames._source import FrameSource

MAX_QUEUED_EVENTS = 100_000

MAX_EVENT_NAMES = 64
"""Largest number of kinds of events of one reader."""


@dataclass(frozen=True, slots=True)
class FrameEvent:
    """An event that a device reported.

    Attributes:
        name: name of the event in ``EventSelector``, such as ``ExposureEnd``.
        number: number of the event in the device's protocol.
        block: id of the picture that the event belongs to; 0: no picture.
        device_time: seconds of the device's own clock; None: the device has none.
        arrived: time of arrival, seconds of ``time.monotonic()``.
        data: values that came with the event, by the name of their feature.
        lost: number of events that this reader lost right before, since it was too slow.
        remark: reason why a value could not be read; mostly empty.
    """

    name: str
    number: int
    block: int
    device_time: float | None
    arrived: float
    data: Mapping[str, FeatureValue] = field(default_factory=dict)
    lost: int = 0
    remark: str = ""


class FrameEvents:
    """Events of a source's device, in their order. Made by :meth:`FrameSource.events`.

    ::

        async with source.events("ExposureEnd") as events:
            async for event in events:
                ...

    If a reader is slow, its oldest events are dropped; ``FrameEvent.lost`` counts them.

    Args:
        source: source of the events.
        names: names of the events.
        size: number of events that are kept for a slow reader.
        timeout: seconds that an iteration waits for an event; None: without limit.
    """

    def __init__(
        self, source: FrameSource, names: tuple[str, ...], size: int, timeout: float | None
    ) -> None:
        if not 0 < len(names) <= MAX_EVENT_NAMES:
            raise wrong_argument("names", f"1 to {MAX_EVENT_NAMES} names", names, "events")
        self._names = tuple(check_text(name, "name", "events", most=200) for name in names)
        self._timeout = check_seconds_or_none(timeout, "timeout", "events")
        size = check_integer(size, "size", 1, MAX_QUEUED_EVENTS, "events")
        self._source = source
        self._queue: collections.deque[FrameEvent] = collections.deque()
        self._size = size
        self._lost = 0
        self._arrived = asyncio.Event()
        self._end: Callable[[], Coroutine[Any, Any, None]] | None = None
        self._over: tuple[FrameSourceError | None] | None = None

    async def __aenter__(self) -> Self:
        """Start reports of the device's events.

        Raises:
            UnsupportedError: a source of this kind reports no events.
            FrameSourceError: the device has no such event, or does not answer.

        Cancellation: the events are switched off again.
        """
        if self._end is not None:
            raise LocalProtocolError(f"{self._source.name}: these events are read already")
        self._over = None
        self._end = await self._source.watch_events(self._names, self._take, self._ended)
        return self

    async def __aexit__(self, *_: object) -> None:
        """Switch the events off, unless another reader uses them."""
        end, self._end = self._end, None
        self._ended(None)
        if end is not None:
            await finish(end)

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> FrameEvent:
        """Return the next event.

        Raises:
            FrameTimeoutError: no event came in time; the caller may wait again.
            FrameSourceError: the device is gone.

        Cancellation: safe; no event is lost.
        """
        try:
            async with asyncio.timeout(self._timeout):
                while not self._queue:
                    if self._over is not None:
                        raise self._over[0] or StopAsyncIteration
                    self._arrived.clear()
                    await self._arrived.wait()
        except FrameSourceError:
            raise
        except TimeoutError as exc:
            raise FrameTimeoutError(
                f"{self._source.name}: expected {' or '.join(self._names)}, none came in "
                f"{self._timeout:g} s",
                source=self._source.name,
            ) from exc
        lost, self._lost = self._lost, 0
        event = self._queue.popleft()
        return replace(event, lost=lost) if lost else event

    def _take(self, event: FrameEvent) -> None:
        if len(self._queue) >= self._size:
            self._queue.popleft()
            self._lost += 1
        self._queue.append(event)
        self._arrived.set()

    def _ended(self, error: FrameSourceError | None) -> None:
        self._over = self._over or (error,)
        self._arrived.set()
