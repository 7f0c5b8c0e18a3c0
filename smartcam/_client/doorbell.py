"""Wake the receive task without a turn of the event loop.

A future wakes its task by way of the event loop: a handle, another turn, another system call. For
each delivery of bytes that costs more than processing them. A caller that rings this doorbell from
a callback of the loop, as a transport does, makes the task go on at once. It is still a task: an
exception in it ends the task, and never reaches the caller.

:class:`Doorbell` uses the protocol between asyncio's tasks and futures
(``_asyncio_future_blocking``), as other implementations of futures do. :class:`PlainDoorbell` uses
only a future: it is chosen by the environment variable ``SMARTCAM_DOORBELL=plain``, for a Python or
an event loop that does not have this protocol.
"""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import contextvars
    from collections.abc import Callable, Generator


class Doorbell:
    """One task may ``await`` it repeatedly; :meth:`ring` makes the task go on.

    Args:
        loop: event loop of the task and of the callers.

    Cancellation: safe; the task is woken by the loop.
    """

    __slots__ = ("_asyncio_future_blocking", "_context", "_loop", "_wake")

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._asyncio_future_blocking = False
        # function that wakes the waiting task; None if nobody waits
        self._wake: Callable[[Doorbell], None] | None = None
        self._context: contextvars.Context | None = None

    def ring(self) -> None:
        """Make the task go on: at once, or if another task rings, in the loop's next turn."""
        wake, context = self._wake, self._context
        if wake is None or context is None:
            return
        self._wake = None
        if asyncio.current_task(self._loop) is None:
            context.run(wake, self)
        else:
            self._loop.call_soon(wake, self, context=context)

    # ------------------------------------------------------------------ for the task's machinery

    def __await__(self) -> Generator[Doorbell, None, None]:
        self._asyncio_future_blocking = True
        yield self

    def get_loop(self) -> asyncio.AbstractEventLoop:
        """Return the loop that the task runs in."""
        return self._loop

    def add_done_callback(
        self, wake: Callable[[Doorbell], None], *, context: contextvars.Context
    ) -> None:
        """Note that the task sleeps now; ``wake`` makes it go on."""
        self._wake, self._context = wake, context

    def cancel(self, msg: Any = None) -> bool:
        """Wake the task, which is then cancelled."""
        wake, self._wake = self._wake, None
        if wake is not None:
            self._loop.call_soon(wake, self, context=self._context)
        return False

    def result(self) -> None:
        """Return nothing: a ring carries no value."""


class PlainDoorbell:
    """A doorbell with a future: a ring makes the task go on in the loop's next turn.

    Args:
        loop: event loop of the task and of the callers.

    Cancellation: safe.
    """

    __slots__ = ("_loop", "_ringing")

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        # future of the waiting task; None if nobody waits
        self._ringing: asyncio.Future[None] | None = None

    def ring(self) -> None:
        """Make the task go on."""
        if self._ringing is not None and not self._ringing.done():
            self._ringing.set_result(None)

    def __await__(self) -> Generator[Any, None, None]:
        self._ringing = self._loop.create_future()
        try:
            yield from self._ringing
        finally:
            self._ringing = None


def make_doorbell(loop: asyncio.AbstractEventLoop) -> Doorbell | PlainDoorbell:
    """Return a doorbell of the kind that ``SMARTCAM_DOORBELL`` selects."""
    plain = os.environ.get("SMARTCAM_DOORBELL") == "plain"
    return PlainDoorbell(loop) if plain else Doorbell(loop)
