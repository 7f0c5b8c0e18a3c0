"""Publish values and events in order, from one queue."""

from __future__ import annotations

import asyncio
import collections
import contextlib
import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

logger: logging.Logger = logging.getLogger("smartcam.outlets")

MAX_FAILURES = 100
"""Number of consecutive calls that fail to publish, after which the server is restarted."""


class PublishQueue:
    """A queue of calls that publish something; a task makes these calls in order.

    The queue is not bounded: whoever adds calls then waits in :meth:`wait_published`.
    """

    def __init__(self) -> None:
        self._calls: collections.deque[Callable[[], Awaitable[None]]] = collections.deque()
        self._wake = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Start the task that publishes."""
        self._task = asyncio.get_running_loop().create_task(self._run())

    async def stop(self) -> None:
        """End the task, and drop calls that have not run yet."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait({self._task})

    def put(self, call: Callable[[], Awaitable[None]]) -> None:
        """Append a call to the queue."""
        self._calls.append(call)
        self._wake.set()

    async def wait_published(self) -> None:
        """Wait until all earlier calls are done, or publishing has failed for good."""
        done = asyncio.Event()

        async def set_done() -> None:
            done.set()

        self.put(set_done)
        waiting = asyncio.get_running_loop().create_task(done.wait())
        try:
            ends = {waiting} if self._task is None else {waiting, self._task}
            await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
        finally:
            waiting.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await waiting

    async def wait_failed(self) -> None:
        """Wait until publishing has failed for good, and raise the reason."""
        if self._task is not None:
            await asyncio.shield(self._task)

    async def _run(self) -> None:
        failures = 0
        while True:
            await self._wake.wait()
            self._wake.clear()
            while self._calls:
                call = self._calls.popleft()
                try:
                    await call()
                    failures = 0
                except Exception:
                    logger.exception("outlet: publishing failed")
                    failures += 1
                    if failures > MAX_FAILURES:
                        raise
