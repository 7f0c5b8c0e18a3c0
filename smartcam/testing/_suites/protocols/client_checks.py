"""Common helpers of the checks with a client connected to a camera."""
# ruff: noqa: S101 - they are tests, in a package so that others can run them

from __future__ import annotations

import asyncio
import contextlib
import functools
import re
from typing import TYPE_CHECKING, Any

import pytest

import smartcam
from smartcam.exceptions import UnsupportedError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Coroutine
    from typing import Concatenate, ParamSpec, TypeVar

    from smartcam.camera import Camera
    from smartcam.models import Statistics
    from smartcam.testing._suites.protocols.cameras_under_test import CameraKind, LiveCamera

    Suite = TypeVar("Suite")
    Given = ParamSpec("Given")

SHORT_TIMEOUT = 0.05
"""Seconds of a timeout that is meant to fire."""

SOON_TIMEOUT = 5.0
"""Seconds after which an event that should happen at once fails the check."""

CHECK_TIMEOUT = 60.0
"""Seconds for a whole check."""

GRACE_STEPS = 100
"""Largest number of steps of the loop in which a cancelled task has to end."""


def in_a_loop(
    check: Callable[Concatenate[Suite, Given], Coroutine[Any, Any, None]],
) -> Callable[Concatenate[Suite, Given], None]:
    """Turn a check into an ordinary test, with an event loop of its own.

    So it needs no plugin for asynchronous tests, and works with any of them. Tasks that a check
    leaves running fail it.
    """

    @functools.wraps(check)
    def run(suite: Suite, /, *args: Given.args, **kwargs: Given.kwargs) -> None:
        # with a factory the thread's current loop is not changed
        with asyncio.Runner(loop_factory=asyncio.new_event_loop) as runner:
            runner.run(_watched(check(suite, *args, **kwargs)))

    return run


async def _watched(check: Coroutine[Any, Any, None]) -> None:
    async with asyncio.timeout(CHECK_TIMEOUT):
        await check
    steps = 0
    while left := asyncio.all_tasks() - {asyncio.current_task()}:
        steps += 1
        if steps > GRACE_STEPS:
            pytest.fail(f"left behind: {'; '.join(sorted(map(repr, left)))}")
        await asyncio.sleep(0)


def needs(camera_kind: CameraKind, *applications: int) -> None:
    """Skip the check if a camera does not have all of these applications."""
    missing = [number for number in applications if number not in camera_kind.applications]
    if missing:
        pytest.skip(f"{camera_kind} has no application {', '.join(map(str, missing))}")


def client(camera_kind: CameraKind, live: LiveCamera, **options: Any) -> Camera:
    """Return a client that interprets numbers, and does not reconnect."""
    options = {"reconnect": None, "interpret_as": camera_kind.numbers, **options}
    return smartcam.connect(live.url, **options)


@contextlib.asynccontextmanager
async def visiting(
    camera_kind: CameraKind, **options: Any
) -> AsyncIterator[tuple[LiveCamera, Camera]]:
    """Open a camera, and a client in a session with it."""
    if "application" in options:
        needs(camera_kind, options["application"])
    async with camera_kind.open() as live, client(camera_kind, live, **options) as camera:
        yield live, camera


async def number(camera: Camera, application: int | None = None, **options: Any) -> int:
    """Trigger and return the number in the result."""
    options.setdefault("timeout", SOON_TIMEOUT)
    result = await camera.trigger(application, **options)
    return int(result.value.n)


async def until(condition: Callable[[], object]) -> None:
    """Run the loop until a condition is true."""
    async with asyncio.timeout(SOON_TIMEOUT):
        while not condition():  # noqa: ASYNC110 - whatever the condition is
            await asyncio.sleep(0)


async def refused(camera: Camera, call: Coroutine[Any, Any, object]) -> None:
    """Check that a call is an UnsupportedError, and that the session continues."""
    dialect = re.escape(camera.capabilities.dialect)
    abilities = re.escape(", ".join(camera.capabilities.names))
    with pytest.raises(UnsupportedError, match=rf"dialect {dialect} .*{abilities}"):
        await call
    assert camera.connected
    await number(camera)


def balance(statistics: Statistics) -> None:
    """Check that both accounts balance."""
    assert statistics.received == (
        statistics.triggered
        + statistics.streamed
        + statistics.late
        + statistics.wrong_application
        + statistics.uninterpretable
        + statistics.unclaimed
    )
    for subscriber in statistics.subscribers:
        assert subscriber.offered == subscriber.taken + subscriber.dropped + subscriber.queued
