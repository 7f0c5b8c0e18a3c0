"""What the conformance checks share."""

from __future__ import annotations

import asyncio
import contextlib
import re
from typing import TYPE_CHECKING, Any

import pytest

import smartcam
from smartcam import UnsupportedError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Coroutine

    from worlds import Site, World

    from smartcam import SmartCamera, Statistics

SHORT = 0.05
"""Seconds of a timeout that is meant to fire."""

SOON = 5.0
"""Seconds after which what should happen at once fails the check."""


def client(world: World, site: Site, **options: Any) -> SmartCamera:
    """Return a client that reads numbers, and does not reconnect."""
    options = {"reconnect": None, "interpret_as": world.numbers, **options}
    return smartcam.connect(site.url, **options)


@contextlib.asynccontextmanager
async def visiting(world: World, **options: Any) -> AsyncIterator[tuple[Site, SmartCamera]]:
    """A camera that is up, and a client in a session with it."""
    async with world.open() as site, client(world, site, **options) as camera:
        yield site, camera


async def number(camera: SmartCamera, application: int | None = None, **options: Any) -> int:
    """Trigger and return the number that came."""
    options.setdefault("timeout", SOON)
    result = await camera.trigger(application, **options)
    return int(result.value.n)


async def until(condition: Callable[[], object]) -> None:
    """Let the loop run until something is true."""
    async with asyncio.timeout(SOON):
        while not condition():  # noqa: ASYNC110 - whatever the condition is
            await asyncio.sleep(0)


async def refused(camera: SmartCamera, call: Coroutine[Any, Any, object]) -> None:
    """See that the dialect cannot do it, that the error says so, and that the session goes on."""
    dialect = camera.capabilities.dialect
    abilities = ", ".join(camera.capabilities.names)
    with pytest.raises(UnsupportedError, match=rf"dialect {dialect} .*{re.escape(abilities)}"):
        await call
    assert camera.connected
    await number(camera)


def balance(statistics: Statistics) -> None:
    """See that both accounts balance."""
    assert statistics.received == (
        statistics.triggered
        + statistics.streamed
        + statistics.late
        + statistics.wrong_application
        + statistics.uninterpretable
        + statistics.unclaimed
    )
    for one in statistics.subscribers:
        assert one.offered == one.taken + one.dropped + one.queued
