"""Run tools in a thread of their own, which does not keep the process from exiting."""

from __future__ import annotations

import collections
import contextlib
import threading
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any, Final

from smartcam._switch_interval import short_switch_interval

if TYPE_CHECKING:
    from collections.abc import Callable

MAX_TURN_SECONDS: Final = 0.001
"""Python's switch interval, seconds, while tools run: the longest time that Python code of a tool
delays the event loop. NumPy, OpenCV and zxing-cpp release the GIL."""


class ToolThread:
    """Run jobs one after the other in a daemon thread.

    Args:
        name: name of the thread.
    """

    def __init__(self, name: str) -> None:
        self._jobs: collections.deque[tuple[Future[Any], Callable[[], Any]]] = collections.deque()
        self._lock = threading.Lock()  # guards the jobs
        # Locked while there are no jobs: the thread waits for it. A condition would cost one more
        # switch of threads.
        self._no_jobs = threading.Lock()
        self._no_jobs.acquire()
        self._closing = False
        self._is_busy = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def is_busy(self) -> bool:
        """True while a job is running."""
        return self._is_busy

    def submit(self, function: Callable[[], Any]) -> Future[Any]:
        """Queue a job; cancelled jobs are removed from the queue."""
        future: Future[Any] = Future()
        with self._lock:
            if self._jobs:
                waiting = [job for job in self._jobs if not job[0].cancelled()]
                self._jobs = collections.deque(waiting)
            self._jobs.append((future, function))
        self._wake_thread()
        return future

    def close(self) -> None:
        """End the thread after its queued jobs; return at once."""
        self._closing = True
        self._wake_thread()

    def _wake_thread(self) -> None:
        with contextlib.suppress(RuntimeError):  # already released: the thread will look for jobs
            self._no_jobs.release()

    def _run(self) -> None:
        while True:
            self._no_jobs.acquire()
            while (job := self._next_job()) is not None:
                self._run_job(*job)
                del job  # releases its picture
            if self._closing and not self._jobs:
                return

    def _next_job(self) -> tuple[Future[Any], Callable[[], Any]] | None:
        with self._lock:
            if not self._jobs:
                return None
            self._is_busy = True
            return self._jobs.popleft()

    def _run_job(self, future: Future[Any], function: Callable[[], Any]) -> None:
        if not future.set_running_or_notify_cancel():
            self._is_busy = False
            return
        try:
            with short_switch_interval(MAX_TURN_SECONDS):
                result = function()
        except BaseException as exc:  # noqa: BLE001 - passed on by the future
            self._is_busy = False
            future.set_exception(exc)
        else:
            self._is_busy = False
            future.set_result(result)
