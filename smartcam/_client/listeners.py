"""Keep a camera's listeners: streams, single waiters for the next result, observers."""

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
        observers: observers that see everything.

    Attributes:
        results: subscriptions to results.
        statuses: subscriptions to statuses.
        events: subscriptions to events.
        observed: True if an observer handles results.
        may_await: True if the next result was requested since the last one.
        hears_all_changes: True if :meth:`publish` passes events on even without a subscriber.
    """

    hears_all_changes: ClassVar[bool] = False

    def __init__(self, name: str, observers: Observers) -> None:
        self.results: Subscribers[Result] = Subscribers()
        self.statuses: Subscribers[Status] = Subscribers()
        self.events: Subscribers[CameraEvent] = Subscribers()
        self.observed: bool = observers.see_results
        self._see_each = observers.see_each
        self._name = name
        self._observers = observers
        # weak: a waiter that was made and never awaited must not count as a listener
        self._next_results: weakref.WeakSet[asyncio.Future[Result]] = weakref.WeakSet()
        self.may_await: bool = False

    def streams(self) -> list[Queue[Any]]:
        """Return every subscription that is still referred to."""
        return [*self.results, *self.statuses, *self.events]

    def next_result(self) -> asyncio.Future[Result]:
        """Return a future that gets the next result; it is dropped without a reference."""
        future: asyncio.Future[Result] = asyncio.get_running_loop().create_future()
        self._next_results.add(future)
        self.may_await = True
        return future

    @property
    def streams_results(self) -> bool:
        """True if results go to streams, and to no caller that waits for a single one."""
        return self._streams_hear and not self._awaits_next

    @property
    def hears_results(self) -> bool:
        """True if a result would go to a listener beside its trigger."""
        return self._streams_hear or self._awaits_next

    @property
    def _streams_hear(self) -> bool:
        return self.results.any_open

    @property
    def _awaits_next(self) -> bool:
        return self.may_await and any(not future.done() for future in self._next_results)

    @property
    def has_subscribers(self) -> bool:
        """True if tasks beside the callers of commands may wait for something."""
        subscribed = self.results.references or self.statuses.references or self.events.references
        return bool(subscribed) or self.may_await

    @property
    def hears_statuses(self) -> bool:
        """True if a status would go to a listener."""
        return bool(self.statuses.references)

    @property
    def watches_status(self) -> bool:
        """True if there is a subscriber to statuses or events."""
        streams: list[Queue[Any]] = [*self.statuses, *self.events]
        return any(not stream.ended for stream in streams)

    @property
    def sees_events(self) -> bool:
        """True if an event would go to a listener."""
        return bool(self.events.references) or self.notes_events()

    @property
    def hears_changes(self) -> bool:
        """True if an event about a session or the active application would go to a listener."""
        return self.hears_all_changes or self.sees_events

    def notes_events(self) -> bool:
        """Return True if an observer or the log needs events, even without a subscriber."""
        return self._observers.see_states or logger.isEnabledFor(logging.DEBUG)

    # ------------------------------------------------------------------ delivery

    def publish(self, event: CameraEvent) -> None:
        """Pass an event to its subscribers."""
        logger.debug("%s = %s", self._name, event)
        self._observers.state(event)
        self.events.offer(event, 0.0)

    def offer_status(self, status: Status, now: float) -> None:
        """Pass a status to its subscribers."""
        if self.statuses.references:
            self.statuses.offer(status, now)

    def offer_burst(self, results: Sequence[Result], now: float, size: int) -> None:
        """Pass on results that are only streamed and observed; ``size`` bytes in all."""
        if self._see_each:
            self._offer_each(results, now)
            return
        if self.observed:
            self._observers.results(results)
        for stream in self.results:
            stream.offer_all(results, now, size)

    def _offer_each(self, results: Sequence[Result], now: float) -> None:
        """Show observers one result after the other, and pass the results on together.

        A listener that a hook adds gets the result that the hook was called with, and later ones.
        """
        heard, streams, joined, done = self.results, [*self.results], self.results.joined, 0
        try:
            for place, result in enumerate(self._observers.each(results)):
                if heard.joined != joined or self.may_await:
                    _offer_all(streams, results[done:place], now)
                    done = place + 1
                    heard.offer(result, now, len(result.raw))
                    for future in self._take_next_results():
                        future.set_result(result)
                    streams, joined = [*heard], heard.joined
        finally:  # a hook may end the program
            _offer_all(streams, results[done:], now)

    def offer_result(self, result: Result, now: float, *, current: bool, late: bool) -> None:
        """Pass a result on.

        Args:
            result: result to deliver.
            now: loop time.
            current: True unless the result is known to belong to an older trigger.
            late: True if the result is known to belong to a trigger that was given up.
        """
        if self.observed:
            self._observers.result(result)
        if self.results.references:
            self.results.offer(result, now, len(result.raw))
        if current and self.may_await:
            for future in self._take_next_results():
                future.set_result(result)

    def offer_error(
        self, error: InterpretationError, now: float, size: int, *, current: bool, owned: bool
    ) -> None:
        """Report that a container cannot be read.

        Args:
            error: the reason.
            now: loop time.
            size: the container's bytes.
            current: as for :meth:`offer_result`.
            owned: the error ends a trigger, and the trigger's caller reports it to observers.
        """
        if self.results:
            _drop_frames(error)
        self.results.offer(error, now, size)
        if current:
            for future in self._take_next_results():
                future.set_exception(error)
        if not owned:
            self._observers.error(self._name, error)

    def fail(self, error: SmartCamError) -> None:
        """Raise an error in every caller that waits for the next result; streams go on."""
        for future in self._take_next_results():
            future.set_exception(error)

    def end(self, error: SmartCamError | None) -> None:
        """End the streams: nothing more will come, because of ``error`` if any."""
        if self.results or self.statuses or self.events:
            for stream in self.streams():
                stream.end(error)

    def _take_next_results(self) -> list[asyncio.Future[Result]]:
        if not self.may_await:
            return []
        waiting = [future for future in self._next_results if not future.done()]
        self._next_results.clear()
        self.may_await = False
        return waiting


def _offer_all(streams: Sequence[Queue[Result]], results: Sequence[Result], now: float) -> None:
    size = sum([len(result.raw) for result in results])
    for stream in streams:
        stream.offer_all(results, now, size)


def _drop_frames(error: SmartCamError) -> None:
    """Remove the frames from an error that may wait in a queue: they hold a delivery's bytes.

    Its cause gets a note with the place where it was raised.
    """
    chain: list[BaseException | None] = [error]
    while chain:
        exc = chain.pop()
        place = exc.__traceback__ if exc is not None else None
        if exc is None or place is None:
            continue
        while place.tb_next is not None:
            place = place.tb_next
        if exc is not error:
            code = place.tb_frame.f_code
            exc.add_note(f"raised in {code.co_qualname}, {code.co_filename}:{place.tb_lineno}")
        exc.__traceback__ = None  # so that each error is visited once
        chain += (exc.__cause__, exc.__context__)
