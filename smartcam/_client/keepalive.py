"""Notice a camera that is gone without a message: a pulled cable, a lost supply.

Any received byte is a sign of life. A camera need not send any, so after half the timeout without a
byte a Query asks for one, and the camera has the whole timeout from then on: a shorter pause ends
no session, and a camera that is gone is noticed at the latest one and a half timeouts after its
last byte. While an application is loaded the camera may be silent for longer: then it is asked only
after ``switch_timeout``.
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
    _timeout: float | None  # seconds that a camera has for a sign of life; None: no end
    _switch_timeout: float  # seconds that loading an application may take

    def watch(self, link: Link) -> Callable[[], None]:
        """Watch a link; return the function that ends this."""
        if self._timeout is None:
            return _nothing
        watch = _Watch(self, link, self._timeout)
        watch.look()
        return watch.stop

    def ask(self, due: float) -> None:
        """Ask for a sign of life, to come until ``due`` (loop time)."""
        with contextlib.suppress(SmartCamError):  # the link is over: the receive task reports that
            self._requests.ask_for_life(due)

    def patience(self, usual: float) -> float:
        """Return the seconds of allowed silence: more during a switch, or a trigger with an answer.

        The trigger may also be another program's.
        """
        pending = self._waits.is_pending
        slow = self._state.loading or pending(m.SwitchAnswer) or pending(m.TriggerAnswer)
        return self._switch_timeout if slow else usual


def _nothing() -> None: ...


class _Watch:
    """A timer, which is set again each time it fires, and never by received bytes."""

    def __init__(self, owner: KeepAlive, link: Link, timeout: float) -> None:
        self._owner = owner
        self._link = link
        self._timeout = timeout  # seconds that the camera has for a sign of life once it is asked
        self._quiet = timeout / 2  # seconds of silence before the camera is asked
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
                # a load may begin or end meanwhile, so look at each step
                when = min(heard_at + quiet, now + self._quiet)
        else:
            end = self._asked_at + self._timeout
            if now >= end:
                silence = f"no sign of life for {shown_time(now - heard_at, coarse=True)}"
                self._link.give_up(TimeoutError(silence))
                return
            # the camera may answer meanwhile, so look again when the next question is due
            when = min(end, now + self._quiet)
        self._timer = self._loop.call_at(when, self.look)
