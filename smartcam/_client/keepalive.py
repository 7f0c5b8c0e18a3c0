"""Detect that a camera was lost without a message, as with a pulled cable or a lost supply.

Any received byte is a sign of life. A camera need not send bytes by itself, so after half the
timeout without a byte the client sends a Query, and the camera has the whole timeout to answer. So
no pause shorter than the timeout ends a session, and a loss is detected at most one and a half
timeouts after the last byte. While an application is loaded, the camera may be silent for longer:
then the Query is sent only after ``switch_timeout``.
"""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from smartcam._arguments import shown_time
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
        watch.look()
        return watch.stop

    def ask(self, due: float) -> None:
        """Ask for a sign of life, which is awaited until ``due`` (loop time)."""
        # if the link has ended, the receive task reports it
        with contextlib.suppress(SmartCamError):
            self._requests.ask_for_life(due)

    def patience(self, usual: float) -> float:
        """Return the allowed silence, seconds: longer during a switch, or a trigger with an answer.

        The trigger may also be another program's.
        """
        pending = self._waits.is_pending
        slow = self._state.loading or pending(m.SwitchAnswer) or pending(m.TriggerAnswer)
        return self._switch_timeout if slow else usual


def _nothing() -> None: ...


class _Watch:
    """A timer that is set again each time it fires; received bytes do not move it."""

    def __init__(self, owner: KeepAlive, link: Link, timeout: float) -> None:
        self._owner = owner
        self._link = link
        self._timeout = timeout  # seconds that the camera has to answer a Query
        self._quiet = timeout / 2  # seconds of silence before a Query is sent
        self._loop = asyncio.get_running_loop()
        self._asked_at: float | None = None
        self._timer: asyncio.TimerHandle | None = None

    def stop(self) -> None:
        """Stop watching."""
        if self._timer is not None:
            self._timer.cancel()

    def look(self) -> None:
        """Ask, give up, or wait; then set the timer for the next step."""
        now, heard_at = self._loop.time(), self._link.heard_at
        if self._asked_at is not None and self._asked_at <= heard_at:  # a clock may be coarse
            self._asked_at = None
        if self._asked_at is None:
            quiet = self._owner.patience(self._quiet)
            if now >= heard_at + quiet:
                self._asked_at = now
                self._owner.ask(now + self._timeout)
                when = now + self._quiet
            else:
                # a load may begin or end, so check again at each step
                when = min(heard_at + quiet, now + self._quiet)
        else:
            end = self._asked_at + self._timeout
            if now >= end:
                silence = f"no sign of life for {shown_time(now - heard_at, coarse=True)}"
                self._link.give_up(TimeoutError(silence))
                return
            # the camera may answer, so check again when the next Query is due
            when = min(end, now + self._quiet)
        self._timer = self._loop.call_at(when, self.look)
