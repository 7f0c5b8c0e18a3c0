"""Things that are published, in order, by one task."""

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
"""Failures to publish in a row behind which the server is opened again."""


class PublishQueue:
    """A queue of calls that publish something; nothing that is cancelled leaves one half done.

    It is bounded by its users: methods and batches wait in :meth:`settled` for what they have put.
    """

    def __init__(self) -> None:
        self._calls: collections.deque[Callable[[], Awaitable[None]]] = collections.deque()
        self._wake = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin to publish."""
        self._task = asyncio.get_running_loop().create_task(self._run())

    async def stop(self) -> None:
        """End; what is not published yet is dropped."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait({self._task})

    def put(self, call: Callable[[], Awaitable[None]]) -> None:
        """Have a call done behind all before it."""
        self._calls.append(call)
        self._wake.set()

    async def settled(self) -> None:
        """Return when all calls that were put before are done."""
        done = asyncio.Event()

        async def tell() -> None:
            done.set()

        self.put(tell)
        waiting = asyncio.get_running_loop().create_task(done.wait())
        try:
            ends = {waiting} if self._task is None else {waiting, self._task}
            await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
        finally:
            waiting.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await waiting

    async def failed(self) -> None:
        """Wait until nothing can be published any more, and raise the reason."""
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
                    logger.exception("outlet: publishing")
                    failures += 1
                    if failures > MAX_FAILURES:
                        raise
