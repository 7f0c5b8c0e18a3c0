"""An event loop in a thread, and calls into it from other threads."""

from __future__ import annotations

import asyncio
import inspect
import os
import sys
import threading
import weakref
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar, cast

from smartcam.exceptions import ConfigurationError, LocalProtocolError, ResponseTimeoutError

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine
    from concurrent.futures import Future

T = TypeVar("T")
P = ParamSpec("P")

CALL_TIMEOUT = 10.0
"""Seconds that a call into the thread may take that has no deadline of its own. It is answered in
well under a millisecond; longer means that something in there, such as a generator of an
application, does not return."""

SLICE = 0.1 if sys.platform == "win32" else threading.TIMEOUT_MAX
"""Seconds of a wait that Ctrl-C may have to wait for; on Windows a lock is not interrupted."""


class _Call:
    """A call into the thread: begun there, awaited in another.

    A lock and one wake-up each way: half of what ``asyncio.run_coroutine_threadsafe`` takes.
    """

    __slots__ = (
        *("_cancelled", "_done", "_error", "_finished", "_function", "_loop", "_result", "_task"),
    )

    def __init__(self, loop: asyncio.AbstractEventLoop, function: Callable[[], object]) -> None:
        self._loop = loop
        self._function = function
        self._task: asyncio.Task[Any] | None = None
        self._result: Any = None
        self._error: BaseException | None = None
        self._cancelled = self._finished = False
        self._done = threading.Lock()
        self._done.acquire()
        loop.call_soon_threadsafe(self._begin)

    def wait(self, timeout: float | None) -> bool:
        """Wait until it is done; return whether it is. Ctrl-C ends it, and is raised.

        Args:
            timeout: seconds; None where what is called has deadlines of its own.
        """
        try:
            if timeout is not None:
                return self._done.acquire(timeout=timeout)
            while not self._done.acquire(timeout=SLICE):
                pass
        except BaseException:  # KeyboardInterrupt, in the main thread
            self.cancel()
            if not self._finished:  # what is cancelled ends at once
                self._done.acquire(timeout=CALL_TIMEOUT)
            raise
        return True

    def cancel(self) -> None:
        """Have it end, from any thread."""
        self._loop.call_soon_threadsafe(self._cancel)

    def result(self) -> Any:
        """Return what came of it, once it is done, or raise."""
        if self._error is not None:
            try:
                raise self._error
            finally:
                self._error = None  # no circle through the traceback
        return self._result

    # ------------------------------------------------------------------ in the thread

    def _begin(self) -> None:
        if self._cancelled:
            self._fail(asyncio.CancelledError())
            return
        try:
            got = self._function()
        except BaseException as exc:  # noqa: BLE001 - it is raised where the call was made
            self._fail(exc)
            return
        if not inspect.iscoroutine(got):
            self._succeed(got)
            return
        self._task = self._loop.create_task(got)
        self._task.add_done_callback(self._end)

    def _end(self, task: asyncio.Task[Any]) -> None:
        if task.cancelled():
            self._fail(
                LocalProtocolError("the call was cancelled: the event loop's thread has ended")
            )
        elif (error := task.exception()) is not None:
            self._fail(error)
        else:
            self._succeed(task.result())

    def _succeed(self, result: object) -> None:
        self._result = result
        self._finish()

    def _fail(self, error: BaseException) -> None:
        self._error = error
        self._finish()

    def _finish(self) -> None:
        self._finished = True
        self._done.release()

    def _cancel(self) -> None:
        self._cancelled = True
        if self._task is not None:
            self._task.cancel()


class LoopThread:
    """An event loop in a thread.

    Args:
        name: the thread's name, for errors, too.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._loop: asyncio.AbstractEventLoop | None = None
        self._end: asyncio.Event | None = None
        self._thread: threading.Thread | None = None
        self._forked = False
        _threads.add(self)

    def start(self) -> None:
        """Start it; does nothing if it runs."""
        if self._thread is not None:
            return
        ready: threading.Event = threading.Event()

        async def live() -> None:
            self._loop = asyncio.get_running_loop()
            end = self._end = asyncio.Event()
            ready.set()
            await end.wait()

        # a daemon, so that a program that is killed does not wait for it
        self._thread = threading.Thread(
            target=asyncio.run, args=(live(),), name=self._name, daemon=True
        )
        self._thread.start()
        if not ready.wait(CALL_TIMEOUT):
            raise ResponseTimeoutError(
                f"the thread {self._name} did not start", message_id=None, waited=CALL_TIMEOUT
            )

    def stop(self) -> None:
        """End it. Harmless when done twice."""
        thread, self._thread = self._thread, None
        if thread is not None and self._loop is not None and self._end is not None:
            self._loop.call_soon_threadsafe(self._end.set)
            thread.join(CALL_TIMEOUT)
            self._loop = None

    @property
    def running(self) -> bool:
        """Whether it runs, in this process."""
        return self._loop is not None and not self._forked

    @property
    def inside(self) -> bool:
        """Whether this is asked in it."""
        return self._thread is not None and threading.get_ident() == self._thread.ident

    def forked(self) -> None:
        """Note that this process is a fork of the one that has the thread."""
        self._forked = True

    def call(
        self, function: Callable[[], Coroutine[Any, Any, T]], timeout: float | None = None
    ) -> T:
        """Call a function in the thread, and run the coroutine that it returns to its end.

        Args:
            function: it.
            timeout: seconds; None where it has deadlines of its own.

        Raises:
            ConfigurationError: the thread does not run.
            LocalProtocolError: it is called in the thread itself, or in a fork of the process.
            ResponseTimeoutError: it took longer than ``timeout``; it was cancelled.
            KeyboardInterrupt: Ctrl-C; it was cancelled.
            Exception: whatever it raises.
        """
        return cast("T", self._call(function, timeout))

    def run(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function in the thread and return what it returns; errors as of :meth:`call`."""
        return cast("T", self._call(lambda: function(*args, **kwargs), CALL_TIMEOUT))

    def _call(self, function: Callable[[], object], timeout: float | None) -> Any:
        call = _Call(self._running_loop(), function)
        if not call.wait(timeout):
            call.cancel()
            raise ResponseTimeoutError(
                f"the thread {self._name} did not answer within {timeout:g} s",
                message_id=None,
                waited=timeout or 0.0,
            )
        return call.result()

    def wait(self, work: Coroutine[Any, Any, T], timeout: float = CALL_TIMEOUT) -> T:
        """Run a coroutine in the thread to its end; errors as of :meth:`call`."""
        try:
            return self.call(lambda: work, timeout)
        finally:
            work.close()  # where it was not begun

    def submit(self, work: Coroutine[Any, Any, T]) -> Future[T]:
        """Run a coroutine in the thread, and do not wait; errors as of :meth:`call`."""
        try:
            return asyncio.run_coroutine_threadsafe(work, self._running_loop())
        except BaseException:
            work.close()
            raise

    def post(self, function: Callable[[], object]) -> None:
        """Have a function called in the thread, and do not wait; nothing where it does not run."""
        if self._loop is not None and not self._forked:
            self._loop.call_soon_threadsafe(function)

    def _running_loop(self) -> asyncio.AbstractEventLoop:
        if self._forked:
            raise LocalProtocolError(
                f"{self._name}: this process is a fork of the one that it was made in, and a fork "
                "has no threads; make it in this process"
            )
        if self._loop is None or self._thread is None:
            raise ConfigurationError(f"the thread {self._name} does not run: not started, or ended")
        if self.inside:
            raise LocalProtocolError(
                f"{self._name}: called in its own thread (by a predicate, an observer or an "
                "interpreter), which would wait for itself"
            )
        return self._loop


_threads: weakref.WeakSet[LoopThread] = weakref.WeakSet()


def _note_fork() -> None:
    for thread in tuple(_threads):
        thread.forked()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note_fork)
