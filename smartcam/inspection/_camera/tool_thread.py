"""A thread for tools: one that never ends keeps no process from its end."""

from __future__ import annotations

import collections
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
        self._changed = threading.Condition()
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
        with self._changed:
            waiting = [job for job in self._jobs if not job[0].cancelled()]
            self._jobs = collections.deque([*waiting, (future, do)])
            self._changed.notify()
        return future

    def close(self) -> None:
        """Have the thread end after the work that waits, and return at once."""
        with self._changed:
            self._closing = True
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._jobs and not self._closing:
                    self._changed.wait()
                if not self._jobs:
                    return
                future, do = self._jobs.popleft()
                self._at_work = True
            self._do(future, do)
            del future, do  # they hold a picture

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
