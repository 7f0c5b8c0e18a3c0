"""Detect that a camera was lost without a message, as with a pulled cable or a lost supply.

Any received byte is a sign of life. A camera need not send bytes by itself, so after half the
timeout without a byte the client sends a Query, which the camera must answer within the whole
timeout. So no pause shorter than the timeout ends a session, and a loss is detected at most one and
a half timeouts after the last byte. While the camera loads an application, it may be silent for
longer: then the Query is sent only after ``switch_timeout``.
"""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from smartcam._arguments import duration_text
from smartcam.exceptions import SmartCamError
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam._client.camera_state import CameraState
    from smartcam._client.link import Link
    from smartcam._client.requests import Requests
    from smartcam._client.waits import Waits


@dataclass(eq=False)
class KeepAlive:
    """Watches the link of each session."""

    _requests: Requests
    _waits: Waits
    _state: CameraState
    _timeout: float | None  # seconds that a camera has for a sign of life; None: unlimited
    _switch_timeout: float  # seconds that loading an application may take

    def watch(self, link: Link) -> Callable[[], None]:
        """Watch a link; return the function that ends the watch."""
        if self._timeout is None:
            return _nothing
        watch = _Watch(self, link, self._timeout)
        watch.check_link()
        return watch.stop

    def ask_sign_of_life(self, due: float) -> None:
        """Ask for a sign of life, which is awaited until ``due`` (loop time)."""
        # if the link has ended, the receive task reports it
        with contextlib.suppress(SmartCamError):
            self._requests.ask_sign_of_life(due)

    def allowed_silence(self, usual_silence: float) -> float:
        """Return the seconds of silence that are allowed before a Query is sent.

        They are more while the camera loads an application, or while a switch or trigger of this
        client is unanswered.
        """
        pending = self._waits.is_pending
        slow = self._state.loading or pending(m.SwitchAnswer) or pending(m.TriggerAnswer)
        return self._switch_timeout if slow else usual_silence


def _nothing() -> None: ...


class _Watch:
    """A timer that is set again each time it fires, but not when bytes are received."""

    def __init__(self, owner: KeepAlive, link: Link, timeout: float) -> None:
        self._owner = owner
        self._link = link
        self._timeout = timeout  # seconds that the camera has to answer a Query
        self._query_delay = timeout / 2  # seconds of silence before a Query is sent
        self._loop = asyncio.get_running_loop()
        self._asked_at: float | None = None
        self._timer: asyncio.TimerHandle | None = None

    def stop(self) -> None:
        """Stop watching."""
        if self._timer is not None:
            self._timer.cancel()

    def check_link(self) -> None:
        """Ask, give up, or wait; then set the timer for the next step."""
        now, heard_at = self._loop.time(), self._link.last_byte_at
        if self._asked_at is not None and self._asked_at <= heard_at:  # a clock may be coarse
            self._asked_at = None
        if self._asked_at is None:
            silence_allowed = self._owner.allowed_silence(self._query_delay)
            if now >= heard_at + silence_allowed:
                self._asked_at = now
                self._owner.ask_sign_of_life(now + self._timeout)
                check_at = now + self._query_delay
            else:
                # a load may begin or end, so check again at each step
                check_at = min(heard_at + silence_allowed, now + self._query_delay)
        else:
            end = self._asked_at + self._timeout
            if now >= end:
                reason = f"no sign of life for {duration_text(now - heard_at, coarse=True)}"
                self._link.give_up(TimeoutError(reason))
                return
            # the camera may answer, so check again when the next Query is due
            check_at = min(end, now + self._query_delay)
        self._timer = self._loop.call_at(check_at, self.check_link)
