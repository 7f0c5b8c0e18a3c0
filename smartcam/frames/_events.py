"""Read the events that a device reports in addition to its pictures."""

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
"""Largest number of event names that one reader may read."""


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
        lost: number of events dropped right before this one, since the reader was too slow.
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
        self._changed = asyncio.Event()
        self._stop_reports: Callable[[], Coroutine[Any, Any, None]] | None = None
        # error with which the events ended, or None, in a tuple; None: they have not ended
        self._end_cause: tuple[FrameSourceError | None] | None = None

    async def __aenter__(self) -> Self:
        """Start reports of the device's events.

        Raises:
            UnsupportedError: a source of this kind reports no events.
            FrameSourceError: the device has no such event, or does not answer.

        Cancellation: the events are switched off again.
        """
        if self._stop_reports is not None:
            raise LocalProtocolError(f"{self._source.name}: these events are read already")
        self._end_cause = None
        self._stop_reports = await self._source.watch_events(
            self._names, self._add_event, self._finish
        )
        return self

    async def __aexit__(self, *_: object) -> None:
        """Switch the events off, unless another reader uses them."""
        stop_reports, self._stop_reports = self._stop_reports, None
        self._finish(None)
        if stop_reports is not None:
            await finish(stop_reports)

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
                    if self._end_cause is not None:
                        raise self._end_cause[0] or StopAsyncIteration
                    self._changed.clear()
                    await self._changed.wait()
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

    def _add_event(self, event: FrameEvent) -> None:
        if len(self._queue) >= self._size:
            self._queue.popleft()
            self._lost += 1
        self._queue.append(event)
        self._changed.set()

    def _finish(self, error: FrameSourceError | None) -> None:
        self._end_cause = self._end_cause or (error,)
        self._changed.set()
