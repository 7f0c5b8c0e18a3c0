"""The thread that passes a node's messages to the middleware, which may block."""

from __future__ import annotations

import collections
import logging
import threading
from typing import TYPE_CHECKING, NamedTuple

from smartcam.exceptions import RosError

if TYPE_CHECKING:
    from collections.abc import Callable

logger: logging.Logger = logging.getLogger("smartcam.ros2")

MAX_WAITING_MESSAGES = 10_000
"""Largest number of messages of a node that wait for the middleware; beyond it the oldest is
dropped and counted."""

MAX_WAITING_BYTES = 1 << 26
"""Largest number of bytes of a node's messages that wait for the middleware."""


class _ThreadJob(NamedTuple):
    run: Callable[[], None]
    size: int
    on_drop: Callable[[], None] | None  # function for a dropped job; None: the job is never dropped


class MessageThread:
    """Runs blocking jobs in a thread, in order, with a bound on waiting jobs.

    Args:
        name: name of the thread.
    """

    def __init__(self, name: str) -> None:
        self._jobs: collections.deque[_ThreadJob] = collections.deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def add_job(
        self, run: Callable[[], None], size: int = 0, on_drop: Callable[[], None] | None = None
    ) -> None:
        """Add a job; if too many jobs wait, drop the oldest of those that may be dropped.

        Raises:
            RosError: the thread ends, or has ended.
        """
        with self._changed:
            if self._closing:
                raise RosError(f"{self._thread.name}: it is closed")
            self._jobs.append(_ThreadJob(run, size, on_drop))
            self._bytes += size
            while len(self._jobs) > MAX_WAITING_MESSAGES or self._bytes > MAX_WAITING_BYTES:
                if not self._drop_oldest():
                    break
            self._changed.notify()

    def _drop_oldest(self) -> bool:
        for index, job in enumerate(self._jobs):
            if job.on_drop is not None and index < len(self._jobs) - 1:
                del self._jobs[index]
                self._bytes -= job.size
                job.on_drop()
                return True
        return False

    def close(self, timeout: float) -> bool:
        """Run the waiting jobs, and end the thread; blocks.

        Returns:
            True if the thread has ended in time.
        """
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._jobs and not self._closing:
                    self._changed.wait()
                if not self._jobs:
                    return
                job = self._jobs.popleft()
                self._bytes -= job.size
            try:
                job.run()
            except Exception as exc:  # noqa: BLE001 - the middleware may raise any error
                logger.debug("%s ! %s", self._thread.name, exc)
