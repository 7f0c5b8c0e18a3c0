"""Request the status repeatedly while it is needed, if the dialect does not send it (``bid``).

One timer runs while a trigger or a wait for a status is pending, or while statuses or events are
subscribed to. It sends a request only if no request for the status is open; an
unanswered request is repeated after a while, since a datagram may be lost. On TCP nothing is lost:
if a camera sends other messages but no answer, the link is given up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from smartcam._arguments import duration_text
from smartcam.exceptions import ResponseTimeoutError, SmartCamError
from smartcam.protocols.messages import SwitchAnswer, TriggerAnswer

if TYPE_CHECKING:
    import asyncio

    from smartcam._client.camera_state import CameraState
    from smartcam._client.connection import Connection
    from smartcam._client.listeners import Listeners
    from smartcam._client.requests import Requests
    from smartcam._client.waits import Waits

PERIOD = 0.02
"""Seconds between two requests while a task waits: a fraction of a usual inspection time."""

IDLE_PERIOD = 0.25
"""Seconds between two requests while statuses are only subscribed to."""

REPEAT_AFTER = 0.5
"""Seconds until an open request counts as lost: answers take milliseconds."""


@dataclass(eq=False)
class Polling:
    """Polls the status over the link of each session that needs it."""

    _connection: Connection
    _requests: Requests
    _state: CameraState
    _waits: Waits
    _listeners: Listeners
    _answer_timeout: float  # seconds

    def __post_init__(self) -> None:
        self._needs_polling = False
        self._trigger_is_pending = False
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = 0.0  # time at which the timer fires; a timer of uvloop does not have it
        self._open_since = 0.0
        self._last_status_count = -1  # number of statuses received when the timer last fired

    def begin_session(self) -> None:
        """Begin to request the status, if the dialect does not send it by itself."""
        self._needs_polling = self._connection.features.polled
        self._open_since = 0.0
        self._last_status_count = -1
        self.poll_soon()

    def end_session(self) -> None:
        """Stop requesting the status."""
        self._needs_polling = False
        self._stop()

    def poll_soon(self) -> None:
        """Request the status now, and then repeatedly, since a task needs it."""
        if not self._needs_polling:
            return
        loop = self._connection.loop
        if self._timer is not None and self._timer_at - loop.time() <= PERIOD:
            return
        self._stop()
        self._set_timer(0.0)

    def begin_trigger(self, request_count: int) -> None:
        """Record that a trigger is pending, which needs the status.

        Args:
            request_count: number of requests for the status that were sent with the trigger.
        """
        self._trigger_is_pending = True
        if request_count:
            self._state.note_status_request(self._connection.loop.time(), request_count)
        self.poll_soon()

    def end_trigger(self) -> None:
        """Record that no trigger is pending any more."""
        self._trigger_is_pending = False

    def _stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _tick(self) -> None:
        self._timer = None
        link, status_count = self._connection.link, self._state.statuses_received
        soon = self._trigger_is_pending or self._waits.status_waiters
        if not (soon or self._listeners.needs_polling) or link is None or link.lost:
            return
        loop = self._connection.loop
        now = loop.time()
        state = self._state
        if (
            status_count != self._last_status_count
            or not state.status_is_pending
            or self._is_silence_allowed
        ):
            self._last_status_count, self._open_since = status_count, now
        elif (
            self._connection.features.keeps_order and now - self._open_since >= self._answer_timeout
        ):
            open_for = duration_text(now - self._open_since, coarse=True)
            silence = f"no status within {open_for} of being asked for"
            link.give_up(ResponseTimeoutError(f"{self._connection.name}: {silence}"))
            return
        if state.status_is_pending and now - state.status_asked_at >= REPEAT_AFTER:
            state.note_statuses_lost()
        if not state.status_is_pending:
            try:
                self._requests.ask_status()
            except SmartCamError:  # the link has ended, which the receive task reports
                return
        self._set_timer(PERIOD if soon else IDLE_PERIOD)

    def _set_timer(self, seconds: float) -> None:
        loop = self._connection.loop
        self._timer_at = loop.time() + seconds
        self._timer = loop.call_later(seconds, self._tick)

    @property
    def _is_silence_allowed(self) -> bool:
        """True while the camera loads or inspects, since it may answer only afterwards."""
        return self._waits.is_pending(SwitchAnswer) or self._waits.is_pending(TriggerAnswer)
