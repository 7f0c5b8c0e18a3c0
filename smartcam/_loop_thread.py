"""Run an event loop in a thread, and call into it from other threads."""

from __future__ import annotations

import asyncio
import collections
import contextlib
import inspect
import os
import sys
import threading
import time
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar, cast

from smartcam._forks import notify_of_forks
from smartcam.exceptions import ConfigurationError, LocalProtocolError, ResponseTimeoutError

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine
    from concurrent.futures import Future

T = TypeVar("T")
P = ParamSpec("P")

CALL_TIMEOUT = 10.0
"""Seconds that a call into the thread may take if it has no deadline of its own. It normally takes
less than a millisecond. If it takes longer, a function in the thread does not return, such as a
user's generator."""

MAX_LOCK_WAIT_TIME = 0.1
"""Seconds of one wait for a lock, after which Ctrl-C takes effect. On Windows, Ctrl-C does not
interrupt the wait; elsewhere it does not if it comes between Python's check and the wait."""


def start_task(work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
    """Return a task; from Python 3.12 on it has already started, which saves a turn of the loop."""
    loop = asyncio.get_running_loop()
    if sys.version_info >= (3, 12):
        return asyncio.Task(work, loop=loop, eager_start=True)
    return loop.create_task(work)


class _Mailbox:
    """Functions from other threads, to be called in a loop's thread.

    On Linux a counter of the system (eventfd) wakes the loop. It takes a fifth of the time that the
    loop's own pair of sockets takes.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._functions: collections.deque[Callable[[], object]] = collections.deque()
        self._closed = False
        self._counter: int | None = None
        if sys.platform == "linux":
            self._counter = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
            loop.add_reader(self._counter, self._on_wake)

    def post(self, function: Callable[[], object]) -> None:
        """Schedule a function, from any thread.

        Raises:
            ConfigurationError: the loop has ended; the function is not called.
        """
        self._functions.append(function)
        if not self._closed:
            self._wake()
        elif function in self._functions:  # otherwise close() has called it
            self._functions.remove(function)
            raise ConfigurationError("the thread of the event loop has ended")

    def close(self) -> None:
        """Call the remaining functions, and refuse new ones; in the loop's thread."""
        self._closed = True
        if self._counter is not None:
            self._loop.remove_reader(self._counter)
        self._call_all()

    def __del__(self) -> None:
        if self._counter is not None:  # no thread writes to the counter any more
            os.close(self._counter)

    def _wake(self) -> None:
        if sys.platform == "linux" and self._counter is not None:
            os.eventfd_write(self._counter, 1)
        else:
            self._loop.call_soon_threadsafe(self._call_all)

    def _on_wake(self) -> None:
        if sys.platform == "linux" and self._counter is not None:
            os.eventfd_read(self._counter)
        self._call_all()

    def _call_all(self) -> None:
        while self._functions:
            self._functions.popleft()()


class _ThreadCall:
    """A call that runs in the loop's thread, while another thread waits for it.

    It needs one lock, and wakes each of the two threads once: half of what
    ``asyncio.run_coroutine_threadsafe`` needs.
    """

    __slots__ = (
        *(
            "_cancelled",
            "_done_lock",
            "_error",
            "_finished",
            "_function",
            "_mailbox",
            "_result",
            "_task",
            "_coroutine",
        ),
    )

    def __init__(self, mailbox: _Mailbox, function: Callable[[], object]) -> None:
        # wait() begins the call, so that the thread that begins it can also end it
        self._mailbox = mailbox
        self._function = function
        self._task: asyncio.Task[Any] | None = None
        self._coroutine: Coroutine[Any, Any, object] | None = None
        self._result: Any = None
        self._error: BaseException | None = None
        self._cancelled = self._finished = False
        self._done_lock = threading.Lock()
        self._done_lock.acquire()

    def wait(self, timeout: float | None) -> bool:
        """Begin the call, and wait until it ends; return False if it did not end in time.

        Ctrl-C cancels the call, and is raised.

        Args:
            timeout: seconds; None if the called function has its own deadlines.
        """
        try:
            self._mailbox.post(self._begin)
            deadline = None if timeout is None else time.monotonic() + timeout
            while not self._done_lock.acquire(timeout=MAX_LOCK_WAIT_TIME):
                if deadline is not None and time.monotonic() >= deadline:
                    return False
        except BaseException:  # KeyboardInterrupt, in the main thread
            self.cancel()
            if not self._finished:  # a cancelled call ends at once
                self._done_lock.acquire(timeout=CALL_TIMEOUT)
            raise
        return True

    def cancel(self) -> None:
        """Cancel the call, from any thread; a call that has not begun will not begin."""
        self._cancelled = True
        with contextlib.suppress(ConfigurationError):  # the loop has ended, and the call with it
            self._mailbox.post(self._cancel)

    def result(self) -> Any:
        """Return the result of the call once it is done, or raise its error."""
        if self._error is not None:
            try:
                raise self._error
            finally:
                self._error = None  # this object and the traceback would keep each other alive
        return self._result

    # ------------------------------------------------------------------ in the thread

    def _begin(self) -> None:
        if self._cancelled:
            self._fail(asyncio.CancelledError())
            return
        try:
            returned = self._function()
            if inspect.iscoroutine(returned):
                self._coroutine = returned
                task = self._task = start_task(self._run_to_end(returned))
                if sys.version_info < (3, 12):
                    task.add_done_callback(self._close_unstarted)
                return
        except BaseException as exc:  # noqa: BLE001 - it is raised where the call was made
            self._fail(exc)
        else:
            self._succeed(returned)

    async def _run_to_end(self, work: Coroutine[Any, Any, object]) -> None:
        """Run a coroutine, and release the waiting thread in the same turn of the loop."""
        if sys.version_info < (3, 12) and self._task is not None:
            self._task.remove_done_callback(self._close_unstarted)  # it would need another turn
        try:
            outcome = await work
        except asyncio.CancelledError:
            self._fail(LocalProtocolError("cancelled: the thread of the event loop has ended"))
            raise
        except BaseException as exc:  # noqa: BLE001 - it is raised where the call was made
            self._fail(exc)
        else:
            self._succeed(outcome)

    def _close_unstarted(self, _: asyncio.Task[None]) -> None:
        """Close a coroutine whose task was cancelled before its first step; asyncio does not."""
        if not self._finished and self._coroutine is not None:
            self._coroutine.close()
            self._fail(asyncio.CancelledError())

    def _succeed(self, result: object) -> None:
        self._result = result
        self._finish()

    def _fail(self, error: BaseException) -> None:
        self._error = error
        self._finish()

    def _finish(self) -> None:
        self._finished = True
        self._done_lock.release()

    def _cancel(self) -> None:
        if self._task is not None:
            self._task.cancel()
        elif not self._finished:  # the call has not begun
            self._fail(asyncio.CancelledError())


class LoopThread:
    """An event loop in a thread.

    Args:
        name: the thread's name, which is also in errors.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._loop: asyncio.AbstractEventLoop | None = None
        self._mailbox: _Mailbox | None = None
        self._end_event: asyncio.Event | None = None
        self._thread: threading.Thread | None = None
        self._forked = False
        notify_of_forks(self)

    def start(self) -> None:
        """Start the thread; do nothing if it runs."""
        if self._thread is not None:
            return
        ready: threading.Event = threading.Event()

        async def run_until_end() -> None:
            self._loop = asyncio.get_running_loop()
            end = self._end_event = asyncio.Event()
            # last, since the thread counts as running once it has a mailbox
            mailbox = self._mailbox = _Mailbox(self._loop)
            ready.set()
            await end.wait()
            mailbox.close()

        # a daemon, so that a program that is killed does not wait for it
        self._thread = threading.Thread(
            target=_run_loop, args=(run_until_end,), name=self._name, daemon=True
        )
        self._thread.start()
        if not ready.wait(CALL_TIMEOUT):
            raise ResponseTimeoutError(
                f"the thread {self._name} did not start", message_id=None, waited=CALL_TIMEOUT
            )

    def stop(self) -> None:
        """End the thread. Do nothing if it has ended, or in a fork, which has no such thread."""
        if self._forked:
            return
        thread, self._thread = self._thread, None
        if thread is not None and self._mailbox is not None and self._end_event is not None:
            self._mailbox.post(self._end_event.set)
            thread.join(CALL_TIMEOUT)
            self._loop = self._mailbox = None

    @property
    def running(self) -> bool:
        """True while the thread runs in this process."""
        return self._mailbox is not None and not self._forked

    @property
    def is_current_thread(self) -> bool:
        """True if the caller is in the loop's own thread."""
        return self._thread is not None and threading.get_ident() == self._thread.ident

    def on_fork(self) -> None:
        """Note that this process is a fork; the thread, if any, belongs to its parent."""
        self._forked = self._thread is not None

    def run_coroutine(
        self, function: Callable[[], Coroutine[Any, Any, T]], timeout: float | None = None
    ) -> T:
        """Call a function in the thread, and run the coroutine that it returns to its end.

        Args:
            function: function that returns the coroutine.
            timeout: seconds; None if the coroutine has deadlines of its own.

        Raises:
            ConfigurationError: the thread does not run.
            LocalProtocolError: the function is called in the thread itself, or in a fork of the
                process.
            ResponseTimeoutError: the coroutine took longer than ``timeout``; it was cancelled.
            KeyboardInterrupt: Ctrl-C; it was cancelled.
            Exception: any error of the coroutine.
        """
        return cast("T", self._call(function, timeout))

    def call_function(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function in the thread and return its value; errors as :meth:`run_coroutine`."""
        return cast("T", self._call(lambda: function(*args, **kwargs), CALL_TIMEOUT))

    def _call(self, function: Callable[[], object], timeout: float | None) -> Any:
        call = _ThreadCall(self._require_mailbox(), function)
        if not call.wait(timeout):
            call.cancel()
            raise ResponseTimeoutError(
                f"the thread {self._name} did not answer within {timeout:g} s",
                message_id=None,
                waited=timeout or 0.0,
            )
        return call.result()

    def submit(self, work: Coroutine[Any, Any, T]) -> Future[T]:
        """Start a coroutine in the thread without waiting; errors as of :meth:`run_coroutine`."""
        try:
            self._refuse_fork()
            if self._loop is None:
                raise self._not_running_error()
        except BaseException:
            work.close()
            raise
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def post(self, function: Callable[[], object]) -> None:
        """Schedule a function in the thread without waiting; do nothing if it does not run."""
        if self._mailbox is not None and not self._forked:
            with contextlib.suppress(ConfigurationError):
                self._mailbox.post(function)

    def _require_mailbox(self) -> _Mailbox:
        """Return the mailbox; raise an error if no call is possible."""
        self._refuse_fork()
        if self._mailbox is None:
            raise self._not_running_error()
        if self.is_current_thread:
            raise LocalProtocolError(
                f"{self._name}: called in its own thread (by a predicate, an observer or an "
                "interpreter), which would wait for itself"
            )
        return self._mailbox

    def _refuse_fork(self) -> None:
        if self._forked:
            raise LocalProtocolError(
                f"{self._name}: this process is a fork of the one that it was made in, and a fork "
                "has no threads; make it in this process"
            )

    def _not_running_error(self) -> ConfigurationError:
        return ConfigurationError(f"the thread {self._name} does not run: not started, or ended")


def _run_loop(run_until_end: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run a coroutine in a new loop until it ends, even while the interpreter ends."""
    try:
        asyncio.run(run_until_end())
    except RuntimeError:
        # asyncio starts a thread to end its executor, and from Python 3.12 on an interpreter that
        # ends starts none; the loop is closed nevertheless
        if threading.main_thread().is_alive():
            raise
