"""Close resources completely, even if the caller is cancelled meanwhile."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable


async def finish(close: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Close a resource in a task of its own, completely; closing has to be bounded and idempotent.

    If that task is cancelled, perhaps before its first step, the calling task closes the resource.

    Raises:
        Exception: the error of closing.

    Cancellation: takes effect when the resource is closed.
    """
    closing = asyncio.ensure_future(close())
    cancelled: asyncio.CancelledError | None = None
    while not closing.done():
        try:
            await asyncio.wait({closing})
        except asyncio.CancelledError as exc:
            cancelled = exc
    if closing.cancelled():
        await close()
    else:
        closing.result()
    if cancelled is not None:
        raise cancelled


async def close_all(closes: Iterable[Callable[[], Coroutine[Any, Any, None]]]) -> None:
    """Close several resources at the same time; each closing has to be bounded and idempotent.

    If the task of one is cancelled, perhaps before its first step, the calling task closes that
    resource.

    Raises:
        Exception: the first error; raised when all have ended.

    Cancellation: passed on to each; takes effect when all have ended.
    """
    begun: set[asyncio.Task[None] | None] = set()

    async def run(close: Callable[[], Coroutine[Any, Any, None]]) -> None:
        begun.add(asyncio.current_task())
        await close()

    closing = {asyncio.ensure_future(run(close)): close for close in closes}
    if not closing:
        return
    try:
        await asyncio.wait(closing)
    except asyncio.CancelledError:
        for task in closing:
            task.cancel()
        await asyncio.wait(closing)
        # somebody may have cancelled all tasks at once
        await _close_each(close for task, close in closing.items() if task not in begun)
        raise
    await _close_each(close for task, close in closing.items() if task.cancelled())
    for task in closing:
        if not task.cancelled():
            task.result()


async def _close_each(closes: Iterable[Callable[[], Coroutine[Any, Any, None]]]) -> None:
    """Close resources one after the other, also those after one that fails."""
    async with contextlib.AsyncExitStack() as stack:
        for close in closes:
            stack.push_async_callback(close)
