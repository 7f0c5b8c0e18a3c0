"""Wake the receive task, and the callers that it answers, without a turn of the event loop.

A future wakes its task through the event loop, which takes a handle, another turn and another
system call. That costs more than processing the received bytes. If a callback of the loop,
such as a transport's, rings this doorbell, the task continues at once. It still is a task: an
exception in the task ends the task, and never reaches the callback.

A caller that waits for a :class:`DirectFuture` continues in the same way when the receive task
sleeps again, since no task can take a step within another task's step. An error, such as a
timeout, wakes the caller through the loop.

:class:`Doorbell` and :class:`DirectFuture` use the protocol between asyncio's tasks and futures
(``_asyncio_future_blocking``), as other implementations of futures do. :class:`PlainDoorbell` uses
only futures: it is chosen by the environment variable ``SMARTCAM_DOORBELL=plain``, for a Python or
an event loop that does not have this protocol.
"""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING, Any, Generic, NoReturn, TypeAlias, TypeVar

from smartcam._user_code import ENDS_PROGRAM

if TYPE_CHECKING:
    import contextvars
    from collections.abc import Callable, Generator

T = TypeVar("T")

PLAIN = os.environ.get("SMARTCAM_DOORBELL") == "plain"
"""True if ``SMARTCAM_DOORBELL`` selected :class:`PlainDoorbell` when this module was imported."""


class Doorbell:
    """An object that one task awaits repeatedly; :meth:`ring` makes the task continue.

    Args:
        loop: event loop of the task and of the callers.

    Cancellation: safe; the task is woken by the loop.
    """

    __slots__ = ("_asyncio_future_blocking", "_context", "_loop", "_wake", "to_wake")

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop  # asyncio's tasks read it
        # futures set while the receive task runs, whose tasks are woken after it; None: a future
        # wakes its task through the loop
        self.to_wake: list[DirectFuture[Any]] | None = None
        self._asyncio_future_blocking = False
        # function that wakes the waiting task; None if no task waits
        self._wake: Callable[[Doorbell], None] | None = None
        self._context: contextvars.Context | None = None

    def ring(self) -> None:
        """Make the task continue at once, or in the loop's next turn if the caller is a task."""
        wake, context = self._wake, self._context
        if wake is None or context is None:
            return
        self._wake = None
        if asyncio.current_task(self._loop) is None:
            context.run(wake, self)
        else:
            self._loop.call_soon(wake, self, context=context)

    def deliver(self) -> None:
        """Make the task continue as by :meth:`ring`, then the callers whose futures it has set.

        Exceptions that end the program are raised in the loop, since a transport would handle them
        as errors of the transport.
        """
        wake, context, loop = self._wake, self._context, self._loop
        if wake is None or context is None or asyncio.current_task(loop) is not None:
            self.ring()
            return
        self._wake, self.to_wake = None, []
        try:
            context.run(wake, self)
        except ENDS_PROGRAM as exc:
            loop.call_soon(_raise, exc)
        finally:
            to_wake, self.to_wake = self.to_wake, None
        for future in to_wake or ():
            try:
                future.wake()
            except ENDS_PROGRAM as exc:
                loop.call_soon(_raise, exc)

    def wake_after_subscribers(self) -> None:
        """Wake callers through the loop, after the tasks that are ready by now.

        So subscribers get a result before its trigger's caller continues.
        """
        to_wake, self.to_wake = self.to_wake, None
        for future in to_wake or ():
            future.wake_soon()

    def make_future(self) -> DirectFuture[Any]:
        """Return a future that one task may wait for."""
        return DirectFuture(self, self._loop)

    def set_future(self, future: AnyFuture, value: object) -> None:
        """Set the result of a future: its task continues at once, unless another task runs."""
        if isinstance(future, asyncio.Future) or asyncio.current_task(self._loop) is not None:
            future.set_result(value)
            return
        to_wake, self.to_wake = self.to_wake, []
        future.set_result(value)
        self.to_wake = to_wake
        try:
            future.wake()
        except ENDS_PROGRAM as exc:
            self._loop.call_soon(_raise, exc)

    # ------------------------------------------------------------------ for asyncio's tasks

    def __await__(self) -> Generator[Doorbell, None, None]:
        self._asyncio_future_blocking = True
        yield self

    def add_done_callback(
        self, wake: Callable[[Doorbell], None], *, context: contextvars.Context
    ) -> None:
        """Record that the task sleeps now; ``wake`` makes it continue."""
        self._wake, self._context = wake, context

    def cancel(self, msg: Any = None) -> bool:
        """Wake the task, which is then cancelled."""
        wake, self._wake = self._wake, None
        if wake is not None:
            self._loop.call_soon(wake, self, context=self._context)
        return False

    def result(self) -> None:
        """Return nothing: a ring carries no value."""


class DirectFuture(Generic[T]):
    """A future for one result or error, which one task awaits once.

    Cancellation: safe; the task is woken by the loop.
    """

    __slots__ = (
        *("_asyncio_future_blocking", "_bell", "_cancelled", "_context", "_done", "_error"),
        *("_loop", "_value", "_wake"),
    )

    def __init__(self, bell: Doorbell, loop: asyncio.AbstractEventLoop) -> None:
        self._bell, self._loop = bell, loop
        self._asyncio_future_blocking = False
        self._done = self._cancelled = False
        self._value: T | None = None
        self._error: BaseException | None = None
        self._wake: Callable[[DirectFuture[T]], None] | None = None  # None: no task waits
        self._context: contextvars.Context | None = None

    def done(self) -> bool:
        """Return True if there is a result or an error, or the wait was cancelled."""
        return self._done

    def cancelled(self) -> bool:
        """Return True if the wait was cancelled before the future was set."""
        return self._cancelled

    def set_result(self, value: T) -> None:
        """Make the task continue with a result.

        Raises:
            asyncio.InvalidStateError: the future is set already.
        """
        if self._done:
            raise asyncio.InvalidStateError("the future is set already")
        self._done, self._value = True, value
        to_wake = self._bell.to_wake
        if to_wake is None:
            self.wake_soon()
        else:
            to_wake.append(self)

    def set_exception(self, error: BaseException) -> None:
        """Make the task continue with an error.

        Raises:
            asyncio.InvalidStateError: the future is set already.
        """
        if self._done:
            raise asyncio.InvalidStateError("the future is set already")
        self._done, self._error = True, error
        self.wake_soon()

    def exception(self) -> BaseException | None:
        """Return the error; None for a result."""
        return self._error

    def wake(self) -> None:
        """Make the task continue at once, if it waits."""
        wake, self._wake = self._wake, None
        if wake is not None and self._context is not None:
            self._context.run(wake, self)

    def wake_soon(self) -> None:
        """Make the task continue in the loop's next turn, if it waits."""
        wake, self._wake = self._wake, None
        if wake is not None:
            self._loop.call_soon(wake, self, context=self._context)

    # ------------------------------------------------------------------ for asyncio's tasks

    def __await__(self) -> Generator[DirectFuture[T], None, T]:
        if not self._done:
            self._asyncio_future_blocking = True
            yield self  # an error is raised here
            return self._value  # type: ignore[return-value]
        return self.result()

    def add_done_callback(
        self, wake: Callable[[DirectFuture[T]], None], *, context: contextvars.Context
    ) -> None:
        """Record that the task sleeps now; ``wake`` makes it continue."""
        self._wake, self._context = wake, context

    def cancel(self, msg: Any = None) -> bool:
        """Wake the task with a CancelledError; return False if it was woken already."""
        if self._done:
            return False
        self._done = self._cancelled = True
        self._error = asyncio.CancelledError(*([] if msg is None else [msg]))
        self.wake_soon()
        return True

    def result(self) -> T:
        """Return the result, or raise the error."""
        error, self._error = self._error, None  # a raised error refers to the waiting task
        if error is not None:
            raise error
        return self._value  # type: ignore[return-value]  # done


Waiter: TypeAlias = "DirectFuture[None] | asyncio.Future[None]"


def wake(waiter: Waiter) -> None:
    """Wake the waiting task, unless it was woken already."""
    if not waiter.done():
        waiter.set_result(None)


async def wait_ended(task: asyncio.Task[Any]) -> None:
    """Wait until a task has ended in any way, like ``asyncio.wait`` but in fewer steps.

    Cancellation: the task is left alone.
    """
    if task.done():
        return
    waiter: asyncio.Future[None] = task.get_loop().create_future()

    def on_end(_: asyncio.Task[Any]) -> None:
        wake(waiter)

    task.add_done_callback(on_end)
    try:
        await waiter
    finally:
        task.remove_done_callback(on_end)


def _raise(error: BaseException) -> NoReturn:
    raise error


class PlainDoorbell:
    """A doorbell with a future: a ring makes the task continue in the loop's next turn.

    Args:
        loop: event loop of the task and of the callers.

    Cancellation: safe.
    """

    __slots__ = ("_loop", "_waiter")

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        # future of the waiting task; None if no task waits
        self._waiter: asyncio.Future[None] | None = None

    def ring(self) -> None:
        """Make the task continue."""
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)

    def deliver(self) -> None:
        """Make the task continue; callers continue after it, through the loop."""
        self.ring()

    def wake_after_subscribers(self) -> None:
        """Do nothing, since all callers continue through the loop anyway."""

    def make_future(self) -> asyncio.Future[Any]:
        """Return a future that one task may wait for."""
        return self._loop.create_future()

    def set_future(self, future: AnyFuture, value: object) -> None:
        """Set the result of a future; the waiting task continues in the loop's next turn."""
        future.set_result(value)

    def __await__(self) -> Generator[Any, None, None]:
        self._waiter = self._loop.create_future()
        try:
            yield from self._waiter
        finally:
            self._waiter = None


AnyFuture: TypeAlias = DirectFuture[Any] | asyncio.Future[Any]
"""The value of :meth:`Doorbell.make_future` or :meth:`PlainDoorbell.make_future`."""


def make_doorbell(loop: asyncio.AbstractEventLoop) -> Doorbell | PlainDoorbell:
    """Return a doorbell of the kind that ``SMARTCAM_DOORBELL`` selects."""
    return PlainDoorbell(loop) if PLAIN else Doorbell(loop)
