"""Asking for the status where it does not come by itself (``bid``), while somebody wants it.

One timer, there as long as a wait for a status or a trigger is under way, or statuses or events are
subscribed to. At most one question is open; one that was not answered is repeated after a while,
since a datagram may be lost. On TCP none is: there a camera that says something and answers no
question does not say what it should, and the link is given up.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from smartcam.exceptions import ResponseTimeoutError, SmartCamError
from smartcam.protocols.base import Transport
from smartcam.protocols.messages import GetStatus, SwitchAnswer, TriggerAnswer

if TYPE_CHECKING:
    from smartcam._client.dispatch import Inbox
    from smartcam._client.link import Link

__all__ = ["StatusPoll"]

PERIOD = 0.02
"""Seconds between two questions while somebody waits: a fraction of a usual inspection."""

IDLE_PERIOD = 0.25
"""Seconds between two questions where statuses are only subscribed to."""

REPEAT_AFTER = 0.5
"""Seconds until an open question counts as lost: answers take milliseconds."""


class StatusPoll:
    """Asks for the status over one link.

    Args:
        link: the link.
        inbox: knows who wants a status, and how many have come.
        patience: seconds that an answer may take.
    """

    def __init__(self, link: Link, inbox: Inbox, patience: float) -> None:
        self._link = link
        self._inbox = inbox
        self._patience = patience
        self._ordered = link.machine.transport is Transport.TCP
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._asked_at = 0.0
        self._open_since = 0.0
        self._heard = -1  # statuses that had come when the open question was asked

    def wanted(self) -> None:
        """Somebody wants a status: begin to ask, or ask more often."""
        if self._timer is not None and self._timer.when() - self._loop.time() <= PERIOD:
            return
        self.stop()
        self._timer = self._loop.call_later(0.0, self._tick)

    def ask(self) -> None:
        """Ask now, whatever is open: what was asked before may tell of what was before."""
        with contextlib.suppress(SmartCamError):  # the link is over: the receive task tells
            self._link.send(GetStatus(), answered=False)

    def stop(self) -> None:
        """Ask no more."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _tick(self) -> None:
        self._timer = None
        inbox = self._inbox
        if not (inbox.awaits_status or inbox.watches_status) or self._link.lost:
            return
        now = self._loop.time()
        answered = inbox.statuses_heard != self._heard
        if answered or self._may_be_silent:
            self._open_since = now
        elif self._ordered and now - self._open_since >= self._patience:
            silence = f"no status within {now - self._open_since:.1f} s of being asked for"
            self._link.give_up(ResponseTimeoutError(f"{inbox.name}: {silence}"))
            return
        if answered or now - self._asked_at >= REPEAT_AFTER:
            self._heard, self._asked_at = inbox.statuses_heard, now
            try:
                self._link.send(GetStatus(), answered=False)
            except SmartCamError:  # the link is over: the receive task tells
                return
        period = PERIOD if inbox.awaits_status else IDLE_PERIOD
        self._timer = self._loop.call_later(period, self._tick)

    @property
    def _may_be_silent(self) -> bool:
        """Something is loaded or inspected, and one thing may be done after the other."""
        answers = self._inbox.answers
        return SwitchAnswer in answers or TriggerAnswer in answers
