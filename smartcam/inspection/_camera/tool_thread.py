"""A thread for tools: one that never ends keeps no process from its end."""

from __future__ import annotations

import collections
import contextlib
import threading
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any, Final

from smartcam._short_turns import short_turns

if TYPE_CHECKING:
    from collections.abc import Callable

MAX_TURN_SECONDS: Final = 0.001
"""Seconds that a tool's Python goes on while the event loop waits for its turn. Python's own 5 ms
were all that a loop may be held; NumPy, OpenCV and zxing-cpp let the loop run meanwhile."""


class ToolThread:
    """Does what it is given, one after the other, in a daemon thread.

    Args:
        name: name of the thread.
    """

    def __init__(self, name: str) -> None:
        self._jobs: collections.deque[tuple[Future[Any], Callable[[], Any]]] = collections.deque()
        self._lock = threading.Lock()  # of the jobs
        # Locked while there is nothing to do. A condition would wake the thread into its own lock,
        # which takes one change of threads more.
        self._bell = threading.Lock()
        self._bell.acquire()
        self._closing = False
        self._at_work = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def at_work(self) -> bool:
        """Something was begun that has not ended."""
        return self._at_work

    def submit(self, do: Callable[[], Any]) -> Future[Any]:
        """Have something done, after all that waits; what was cancelled waits no longer."""
        future: Future[Any] = Future()
        with self._lock:
            if self._jobs:
                waiting = [job for job in self._jobs if not job[0].cancelled()]
                self._jobs = collections.deque(waiting)
            self._jobs.append((future, do))
        self._ring()
        return future

    def close(self) -> None:
        """Have the thread end after the work that waits, and return at once."""
        self._closing = True
        self._ring()

    def _ring(self) -> None:
        with contextlib.suppress(RuntimeError):  # it has been rung, and the thread will look
            self._bell.release()

    def _run(self) -> None:
        while True:
            self._bell.acquire()
            while (job := self._next_job()) is not None:
                self._do(*job)
                del job  # it holds a picture
            if self._closing and not self._jobs:
                return

    def _next_job(self) -> tuple[Future[Any], Callable[[], Any]] | None:
        with self._lock:
            if not self._jobs:
                return None
            self._at_work = True
            return self._jobs.popleft()

    def _do(self, future: Future[Any], do: Callable[[], Any]) -> None:
        if not future.set_running_or_notify_cancel():
            self._at_work = False
            return
        try:
            with short_turns(MAX_TURN_SECONDS):
                result = do()
        except BaseException as exc:  # noqa: BLE001 - it is whose who waits for it
            self._at_work = False
            future.set_exception(exc)
        else:
            self._at_work = False
            future.set_result(result)
