"""Run blocking calls one after the other in one separate thread."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, TypeVar

from smartcam.exceptions import LocalProtocolError

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")


class OneThread:
    """A thread that runs one call at a time; its owner closes it.

    Cancellation: the running call finishes, and its result is dropped.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._pool: ThreadPoolExecutor | None = ThreadPoolExecutor(1, f"smartcam {name}")
        self._running: asyncio.Future[Any] | None = None

    async def wait_until_idle(self) -> None:
        """Wait until no call is running."""
        while self._running is not None and not self._running.done():
            await asyncio.wait([self._running])

    async def run(self, function: Callable[[], T]) -> T:
        """Run a function in the thread, in the order of the calls.

        Raises LocalProtocolError: the thread was closed.
        """
        await self.wait_until_idle()
        if self._pool is None:
            raise LocalProtocolError(f"{self._name}: closed")
        self._running = asyncio.get_running_loop().run_in_executor(self._pool, function)
        self._running.add_done_callback(_retrieve_error)
        return await asyncio.shield(self._running)

    async def close(self) -> None:
        """End the thread after its running call. Idempotent.

        Cancellation: the thread ends nevertheless.
        """
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown(wait=False)
            await self.wait_until_idle()


def _retrieve_error(done: asyncio.Future[Any]) -> None:
    if not done.cancelled():
        done.exception()  # mark the error as retrieved: the caller may be cancelled
