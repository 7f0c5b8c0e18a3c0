"""Poll the status, in dialects that do not send it unasked (``bid``), while somebody needs it.

There is one timer, which runs while a wait for a status or a trigger is pending, or while statuses
or events are subscribed to. It asks only if no question is open, from whichever task; an unanswered
question is repeated after a while, since a datagram may be lost. On TCP nothing is lost: if a
camera sends other messages but no answer, the link is given up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from smartcam._arguments import shown_time
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
"""Seconds between two questions while somebody waits: a fraction of a usual inspection time."""

IDLE_PERIOD = 0.25
"""Seconds between two questions while statuses are only subscribed to."""

REPEAT_AFTER = 0.5
"""Seconds until an open question counts as lost: answers take milliseconds."""


@dataclass(eq=False)
class Polling:
    """Polls the status over the link of each session that needs it."""

    _connection: Connection
    _requests: Requests
    _state: CameraState
    _waits: Waits
    _listeners: Listeners
    _patience: float  # seconds that an answer may take

    def __post_init__(self) -> None:
        self._running = False
        self._triggered = False  # whether a trigger is pending
        self._timer: asyncio.TimerHandle | None = None
        self._due = 0.0  # time at which the timer fires; a timer of uvloop does not say
        self._open_since = 0.0
        self._heard = -1  # number of statuses that had come when the timer fired last

    def begin_session(self) -> None:
        """Begin to ask, if the dialect does not send the status unasked."""
        self._running = self._connection.features.polled
        self._open_since = 0.0
        self._heard = -1
        self.wanted()

    def end_session(self) -> None:
        """Stop asking."""
        self._running = False
        self._stop()

    def wanted(self) -> None:
        """Begin to ask for the status, or ask more often, since somebody wants it."""
        if not self._running:
            return
        loop = self._connection.loop
        if self._timer is not None and self._due - loop.time() <= PERIOD:
            return
        self._stop()
        self._set_timer(0.0)

    def begin_trigger(self, questions: int) -> None:
        """Note that a trigger is pending, which needs the status.

        Args:
            questions: number of questions that were sent together with the trigger.
        """
        self._triggered = True
        if questions:
            self._state.status_asked(self._connection.loop.time(), questions)
        self.wanted()

    def end_trigger(self) -> None:
        """Note that no trigger is pending any more."""
        self._triggered = False

    def _stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _tick(self) -> None:
        self._timer = None
        link, heard = self._connection.link, self._state.statuses_heard
        soon = self._triggered or self._waits.statuses
        if not (soon or self._listeners.watches_status) or link is None or link.lost:
            return
        loop = self._connection.loop
        now = loop.time()
        state = self._state
        if heard != self._heard or not state.owes_status or self._may_be_silent:
            self._heard, self._open_since = heard, now
        elif self._connection.features.ordered and now - self._open_since >= self._patience:
            open_for = shown_time(now - self._open_since, coarse=True)
            silence = f"no status within {open_for} of being asked for"
            link.give_up(ResponseTimeoutError(f"{self._connection.name}: {silence}"))
            return
        if state.owes_status and now - state.status_asked_at >= REPEAT_AFTER:
            state.status_lost()
        if not state.owes_status:
            try:
                self._requests.ask_status()
            except SmartCamError:  # the link has ended, which the receive task reports
                return
        self._set_timer(PERIOD if soon else IDLE_PERIOD)

    def _set_timer(self, seconds: float) -> None:
        loop = self._connection.loop
        self._due = loop.time() + seconds
        self._timer = loop.call_later(seconds, self._tick)

    @property
    def _may_be_silent(self) -> bool:
        """Return True while the camera loads or inspects, since it may answer only afterwards."""
        return self._waits.owes(SwitchAnswer) or self._waits.owes(TriggerAnswer)
