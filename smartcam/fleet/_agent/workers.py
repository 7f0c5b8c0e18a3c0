"""Keep tasks (*workers*) that carry out one trigger after another.

A new task takes its first step only in the next turn of the event loop. A waiting worker begins at
once, so that the camera is triggered in the turn in which the call arrived.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from smartcam._client._inside import make_doorbell

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

MAX_IDLE_WORKERS = 16
"""Largest number of idle workers that are kept for further work; further workers end."""


class TriggerWorker:
    """A task that does one piece of work after another.

    Args:
        workers: the workers of the agent, to which this one belongs.

    Attributes:
        task: the worker's task; cancelling it ends the worker.
    """

    def __init__(self, workers: Workers) -> None:
        loop = asyncio.get_running_loop()
        self._workers = workers
        self._bell = make_doorbell(loop)
        self._work: Callable[[], Awaitable[None]] | None = None
        self.task: asyncio.Task[None] = loop.create_task(self._run(), name="smartcam.fleet.worker")

    def start_work(self, work: Callable[[], Awaitable[None]]) -> None:
        """Give the worker one piece of work; it begins at once if a callback gives it."""
        self._work = work
        self._bell.ring()

    async def _run(self) -> None:
        while True:
            work, self._work = self._work, None
            if work is None:
                await self._bell
                continue
            await work()
            if not self._workers.keep_worker(self):
                return


class Workers:
    """The workers of an agent."""

    def __init__(self) -> None:
        self._idle: list[TriggerWorker] | None = []  # None after close()

    def get_worker(self) -> TriggerWorker:
        """Return a worker that has nothing to do; give it work before the next turn of the loop.

        Workers that were cancelled are left out: they would never begin the work.
        """
        while self._idle:
            worker = self._idle.pop()
            if not worker.task.done() and not worker.task.cancelling():
                return worker
        return TriggerWorker(self)

    def keep_worker(self, worker: TriggerWorker) -> bool:
        """Keep a worker for further work; return False if there are enough, and it must end."""
        if self._idle is None or len(self._idle) >= MAX_IDLE_WORKERS:
            return False
        self._idle.append(worker)
        return True

    def close(self) -> list[asyncio.Task[None]]:
        """Cancel the waiting workers, and keep none from now on; return their tasks. Idempotent."""
        idle, self._idle = self._idle or (), None
        for worker in idle:
            worker.task.cancel()
        return [worker.task for worker in idle]
