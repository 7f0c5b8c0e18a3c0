"""What the client's tests share: sessions with both cameras, and loop steps."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

from camera_by_hand import HandmadeCamera

import smartcam
from smartcam.emulator import EmulatedCamera, ManualClock

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from smartcam.client import SmartCamera
    from smartcam.models import Statistics

SHORT = 0.05
"""Seconds of a timeout that is meant to fire."""


@contextlib.asynccontextmanager
async def by_hand(
    *, box: dict[str, Any] | None = None, **options: Any
) -> AsyncIterator[tuple[HandmadeCamera, SmartCamera]]:
    """A handmade camera and a client in a session with it, which does not reconnect by default."""
    options.setdefault("reconnect", None)
    async with (
        nothing_unheard(),
        HandmadeCamera(**(box or {})) as made,
        smartcam.connect(made.url, **options) as camera,
    ):
        yield made, camera


@contextlib.asynccontextmanager
async def emulated(
    *, box: dict[str, Any] | None = None, **options: Any
) -> AsyncIterator[tuple[EmulatedCamera, ManualClock, SmartCamera]]:
    """An emulated camera on a clock that stands still, and a client in a session with it.

    It does not reconnect by default.
    """
    options.setdefault("reconnect", None)
    clock = ManualClock()
    async with (
        nothing_unheard(),
        EmulatedCamera(clock=clock, **(box or {})) as emulator,
        smartcam.connect(emulator.url, **options) as camera,
    ):
        yield emulator, clock, camera


@contextlib.asynccontextmanager
async def nothing_unheard() -> AsyncIterator[None]:
    """Assert that the loop has no error to report that reached nobody."""
    loop = asyncio.get_running_loop()
    reports: list[dict[str, Any]] = []
    handler = loop.get_exception_handler()
    loop.set_exception_handler(lambda _, context: reports.append(context))
    try:
        yield
    finally:
        loop.set_exception_handler(handler)
    assert reports == []


async def steps(count: int) -> None:
    """Let the loop run ``count`` times."""
    for _ in range(count):
        await asyncio.sleep(0)


async def until(condition: Callable[[], object]) -> None:
    """Let the loop run until something is true."""
    async with asyncio.timeout(5):
        while not condition():  # noqa: ASYNC110 - whatever the condition is
            await asyncio.sleep(0)


async def cancelled(task: asyncio.Task[Any]) -> None:
    """Cancel a task and wait for its end; it must end by that."""
    task.cancel()
    await asyncio.wait({task})
    assert task.cancelled()


async def gone(waiting: Awaitable[object]) -> BaseException | None:
    """Return the error that something ends with, None if it gives a value."""
    return (await asyncio.gather(waiting, return_exceptions=True))[0]  # type: ignore[return-value]


def balance(statistics: Statistics) -> None:
    """Assert that both accounts balance."""
    fates = (
        statistics.triggered
        + statistics.streamed
        + statistics.late
        + statistics.wrong_application
        + statistics.uninterpretable
        + statistics.unclaimed
    )
    assert statistics.received == fates
    for one in statistics.subscribers:
        assert one.offered == one.taken + one.dropped + one.queued
