"""Keep a camera's listeners: streams, callers that wait for the next result, and observers."""

from __future__ import annotations

import asyncio
import logging
import weakref
from typing import TYPE_CHECKING, Any, ClassVar

from smartcam.streams import Subscribers

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.exceptions import InterpretationError, SmartCamError
    from smartcam.models import CameraEvent, Result, Status
    from smartcam.observers import Observers
    from smartcam.streams import Queue

logger: logging.Logger = logging.getLogger("smartcam.client")


class Listeners:
    """The subscribers and observers that get a camera's results, statuses and events.

    Args:
        name: the camera's name.
        observers: observers that get everything.

    Attributes:
        results: subscribers' streams of results.
        statuses: subscribers' streams of statuses.
        events: subscribers' streams of events.
        has_result_observer: True if an observer handles results.
        may_have_waiters: True if :meth:`next_result` was called after the last result; the caller
            may have gone since.
        wants_all_changes: True if events about sessions and applications are needed even if there
            is no subscriber or observer; for subclasses.
    """

    wants_all_changes: ClassVar[bool] = False

    def __init__(self, name: str, observers: Observers) -> None:
        self.results: Subscribers[Result] = Subscribers()
        self.statuses: Subscribers[Status] = Subscribers()
        self.events: Subscribers[CameraEvent] = Subscribers()
        self.has_result_observer: bool = observers.handles_results
        self._observes_singly = observers.handles_single_results
        self._name = name
        self._observers = observers
        # weak: a future that was made and never awaited must not count as a listener
        self._next_results: weakref.WeakSet[asyncio.Future[Result]] = weakref.WeakSet()
        self.may_have_waiters: bool = False

    def streams(self) -> list[Queue[Any]]:
        """Return every stream that is still referred to."""
        return [*self.results, *self.statuses, *self.events]

    def next_result(self) -> asyncio.Future[Result]:
        """Return a future that gets the next result; the caller must keep a reference to it."""
        future: asyncio.Future[Result] = asyncio.get_running_loop().create_future()
        self._next_results.add(future)
        self.may_have_waiters = True
        return future

    @property
    def results_only_streamed(self) -> bool:
        """True if results go to streams, and no caller waits for the next one."""
        return self._has_result_streams and not self._has_waiters

    @property
    def wants_results(self) -> bool:
        """True if a stream or a caller of :meth:`next_result` would get a result."""
        return self._has_result_streams or self._has_waiters

    @property
    def _has_result_streams(self) -> bool:
        return self.results.has_open_queue

    @property
    def _has_waiters(self) -> bool:
        return self.may_have_waiters and any(not future.done() for future in self._next_results)

    @property
    def has_subscribers(self) -> bool:
        """True if a subscriber or a caller of :meth:`next_result` may wait for something."""
        subscribed = self.results.references or self.statuses.references or self.events.references
        return bool(subscribed) or self.may_have_waiters

    @property
    def wants_statuses(self) -> bool:
        """True if there is a subscriber to statuses."""
        return bool(self.statuses.references)

    @property
    def needs_polling(self) -> bool:
        """True if an open stream of statuses or events needs the status to be polled."""
        streams: list[Queue[Any]] = [*self.statuses, *self.events]
        return any(not stream.ended for stream in streams)

    @property
    def wants_events(self) -> bool:
        """True if a subscriber, an observer or the log needs events."""
        return bool(self.events.references) or self.observers_want_events()

    @property
    def wants_changes(self) -> bool:
        """True if events about sessions and the active application are needed."""
        return self.wants_all_changes or self.wants_events

    def observers_want_events(self) -> bool:
        """Return True if an observer or the log needs events."""
        return self._observers.handles_states or logger.isEnabledFor(logging.DEBUG)

    # ------------------------------------------------------------------ delivery

    def publish(self, event: CameraEvent) -> None:
        """Pass an event to the log, the observers and the subscribers."""
        logger.debug("%s = %s", self._name, event)
        self._observers.state(event)
        self.events.offer(event, 0.0)

    def offer_status(self, status: Status, now: float) -> None:
        """Pass a status to its subscribers."""
        if self.statuses.references:
            self.statuses.offer(status, now)

    def offer_burst(self, results: Sequence[Result], now: float, size: int) -> None:
        """Pass results of ``size`` bytes to observers and streams; no caller waits for one."""
        if self._observes_singly:
            self._offer_singly(results, now)
            return
        if self.has_result_observer:
            self._observers.results(results)
        for stream in self.results:
            stream.offer_all(results, now, size)

    def _offer_singly(self, results: Sequence[Result], now: float) -> None:
        """Call observers with one result after the other, and pass the results on together.

        A listener that an observer adds gets the result of that call, and later ones.
        """
        subscribers, streams, offered = self.results, [*self.results], 0
        count = subscribers.added_count
        try:
            for index, result in enumerate(self._observers.each(results)):
                if subscribers.added_count != count or self.may_have_waiters:
                    _offer_all(streams, results[offered:index], now)
                    offered = index + 1
                    subscribers.offer(result, now, len(result.raw))
                    for future in self._take_next_results():
                        future.set_result(result)
                    streams, count = [*subscribers], subscribers.added_count
        finally:  # an observer may end the program
            _offer_all(streams, results[offered:], now)

    def offer_result(self, result: Result, now: float, *, current: bool, late: bool) -> None:
        """Pass a result on.

        Args:
            result: result to deliver.
            now: loop time.
            current: True unless the result is known to belong to an older trigger.
            late: True if the result is known to belong to a trigger that was given up.
        """
        if self.has_result_observer:
            self._observers.result(result)
        if self.results.references:
            self.results.offer(result, now, len(result.raw))
        if current and self.may_have_waiters:
            for future in self._take_next_results():
                future.set_result(result)

    def offer_error(
        self,
        error: InterpretationError,
        now: float,
        size: int,
        *,
        current: bool,
        reported_by_caller: bool,
    ) -> None:
        """Report that a container cannot be interpreted.

        Args:
            error: the reason.
            now: loop time.
            size: the container's bytes.
            current: as for :meth:`offer_result`.
            reported_by_caller: True if the error ends a trigger, whose caller reports it to
                observers.
        """
        if self.results:
            _clear_tracebacks(error)
        self.results.offer(error, now, size)
        if current:
            for future in self._take_next_results():
                future.set_exception(error)
        if not reported_by_caller:
            self._observers.error(self._name, error)

    def fail(self, error: SmartCamError) -> None:
        """Raise an error in every caller that waits for the next result; streams stay open."""
        for future in self._take_next_results():
            future.set_exception(error)

    def end(self, error: SmartCamError | None) -> None:
        """End the streams: nothing more will come, because of ``error`` if any."""
        if self.results or self.statuses or self.events:
            for stream in self.streams():
                stream.end(error)

    def _take_next_results(self) -> list[asyncio.Future[Result]]:
        if not self.may_have_waiters:
            return []
        waiting = [future for future in self._next_results if not future.done()]
        self._next_results.clear()
        self.may_have_waiters = False
        return waiting


def _offer_all(streams: Sequence[Queue[Result]], results: Sequence[Result], now: float) -> None:
    size = sum([len(result.raw) for result in results])
    for stream in streams:
        stream.offer_all(results, now, size)


def _clear_tracebacks(error: SmartCamError) -> None:
    """Remove the tracebacks of an error that may wait in a queue: they keep received bytes alive.

    Each error of its chain gets a note with the place where it was raised.
    """
    chain: list[BaseException | None] = [error]
    while chain:
        link = chain.pop()
        traceback = link.__traceback__ if link is not None else None
        if link is None or traceback is None:
            continue
        while traceback.tb_next is not None:
            traceback = traceback.tb_next
        if link is not error:
            code = traceback.tb_frame.f_code
            link.add_note(f"raised in {code.co_qualname}, {code.co_filename}:{traceback.tb_lineno}")
        link.__traceback__ = None  # so that each error is visited once
        chain += (link.__cause__, link.__context__)
