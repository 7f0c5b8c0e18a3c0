"""Give a web site its own threads for slow functions."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, ClassVar, TypeVar

from smartcam.web._errors import RefusedError
from smartcam.web._site import Site

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")


class ThreadedSite(Site):
    """A site with a few threads, which run as long as its port is open."""

    thread_count: ClassVar[int] = 1

    _threads: ThreadPoolExecutor | None = None

    async def start(self) -> None:
        """Open the port."""
        if self._threads is None:
            name = f"smartcam.web.{self._page}"
            self._threads = ThreadPoolExecutor(self.thread_count, thread_name_prefix=name)
        await super().start()

    async def stop(self) -> None:
        """Close the port, and end the threads; cancel functions that wait for a thread."""
        try:
            await super().stop()
        finally:
            threads, self._threads = self._threads, None
            if threads is not None:
                await asyncio.to_thread(threads.shutdown, cancel_futures=True)

    async def in_thread(self, work: Callable[..., T], *args: object) -> T:
        """Return the result of a function that runs in one of the threads.

        Raises:
            RefusedError: the site is stopped.

        Cancellation: safe; a function that has begun runs to its end.
        """
        if self._threads is None:
            raise RefusedError(503, "a closed site", expected="an open site")
        return await asyncio.get_running_loop().run_in_executor(self._threads, work, *args)
