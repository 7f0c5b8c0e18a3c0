"""Finding out that the camera is gone although nobody said so: a pulled cable, a lost supply.

Any received byte is a sign of life. After half the timeout without one a Query asks for one, and
after the whole timeout the link is given up. While an application is loaded the camera may be
silent for longer: then it is asked after ``switch_timeout`` only.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from smartcam.exceptions import SmartCamError
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Generator

    from smartcam._client.link import Link
    from smartcam._client.requests import Conversation

__all__ = ["watched"]


@contextlib.contextmanager
def watched(
    link: Link, talk: Conversation, timeout: float | None, switch_timeout: float
) -> Generator[None]:
    """Watch a link while the body runs; with ``timeout=None`` do not."""
    if timeout is None:
        yield
        return
    watch = _Watch(link, talk, timeout / 2, switch_timeout)
    watch.look()
    try:
        yield
    finally:
        watch.stop()


class _Watch:
    """One timer; set again each time it fires, never by what is received."""

    def __init__(
        self, link: Link, talk: Conversation, patience: float, switch_timeout: float
    ) -> None:
        self._link = link
        self._talk = talk
        self._patience = patience  # seconds of silence before a question, and after it
        self._switch_timeout = switch_timeout
        self._loop = asyncio.get_running_loop()
        self._asked_at: float | None = None
        self._timer: asyncio.TimerHandle | None = None

    def stop(self) -> None:
        """Look no more."""
        if self._timer is not None:
            self._timer.cancel()

    def look(self) -> None:
        """Ask, give up, or wait; then look again when there is something to do next."""
        now, heard_at = self._loop.time(), self._link.heard_at
        if self._asked_at is not None and self._asked_at <= heard_at:  # a clock may be coarse
            self._asked_at = None
        if self._asked_at is None:
            quiet = self._switch_timeout if self._loading else self._patience
            if now >= heard_at + quiet:
                self._ask(now)
                when = now + self._patience
            else:
                # a load may begin or end meanwhile, so look at each step
                when = min(heard_at + quiet, now + self._patience)
        else:
            when = self._asked_at + self._patience
            if now >= when:
                silence = f"no sign of life for {now - heard_at:.1f} s"
                self._link.give_up(TimeoutError(silence))
                return
        self._timer = self._loop.call_at(when, self.look)

    def _ask(self, now: float) -> None:
        self._asked_at = now
        with contextlib.suppress(SmartCamError):  # the link is over: the receive task tells
            self._talk.ask_for_life(now + self._patience)

    @property
    def _loading(self) -> bool:
        """A switch is under way, ours or somebody else's, or a trigger that will be answered."""
        owed = self._talk.inbox.answers
        loads = m.SwitchAnswer in owed or m.TriggerAnswer in owed
        return loads or self._talk.status.loading
