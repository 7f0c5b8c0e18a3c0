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
    Params = ParamSpec("Params")

SHORT_TIMEOUT = 0.05
"""Seconds of a timeout that is meant to fire."""

EVENT_TIMEOUT = 5.0
"""Seconds to wait for an event that should happen at once."""

CHECK_TIMEOUT = 60.0
"""Seconds for a whole check."""

GRACE_STEPS = 100
"""Largest number of steps of the loop in which a cancelled task has to end."""


def with_event_loop(
    check: Callable[Concatenate[Suite, Params], Coroutine[Any, Any, None]],
) -> Callable[Concatenate[Suite, Params], None]:
    """Turn a check into an ordinary test, with an event loop of its own.

    The test needs no plugin for asynchronous tests, and works with any such plugin. A check that
    leaves tasks running fails.
    """

    @functools.wraps(check)
    def run(suite: Suite, /, *args: Params.args, **kwargs: Params.kwargs) -> None:
        # with a factory the thread's current loop is not changed
        with asyncio.Runner(loop_factory=asyncio.new_event_loop) as runner:
            runner.run(_run_without_leftovers(check(suite, *args, **kwargs)))

    return run


async def _run_without_leftovers(check: Coroutine[Any, Any, None]) -> None:
    async with asyncio.timeout(CHECK_TIMEOUT):
        await check
    steps = 0
    while left := asyncio.all_tasks() - {asyncio.current_task()}:
        steps += 1
        if steps > GRACE_STEPS:
            pytest.fail(f"left behind: {'; '.join(sorted(map(repr, left)))}")
        await asyncio.sleep(0)


def skip_without_applications(camera_kind: CameraKind, *applications: int) -> None:
    """Skip the check if a camera does not have all of these applications."""
    missing = [number for number in applications if number not in camera_kind.applications]
    if missing:
        pytest.skip(f"{camera_kind} has no application {', '.join(map(str, missing))}")


def make_client(camera_kind: CameraKind, live: LiveCamera, **options: Any) -> Camera:
    """Return a client that reads results as numbers and never reconnects, unless options differ."""
    options = {"reconnect": None, "interpret_as": camera_kind.numbers, **options}
    return smartcam.connect(live.url, **options)


@contextlib.asynccontextmanager
async def open_session(
    camera_kind: CameraKind, **options: Any
) -> AsyncIterator[tuple[LiveCamera, Camera]]:
    """Open a camera and connect a client to it."""
    if "application" in options:
        skip_without_applications(camera_kind, options["application"])
    async with camera_kind.open() as live, make_client(camera_kind, live, **options) as camera:
        yield live, camera


async def trigger_and_read(camera: Camera, application: int | None = None, **options: Any) -> int:
    """Trigger and return the number in the result."""
    options.setdefault("timeout", EVENT_TIMEOUT)
    result = await camera.trigger(application, **options)
    return int(result.value.n)


async def wait_until(condition: Callable[[], object]) -> None:
    """Run the loop until a condition is true."""
    async with asyncio.timeout(EVENT_TIMEOUT):
        while not condition():  # noqa: ASYNC110 - whatever the condition is
            await asyncio.sleep(0)


async def check_unsupported(camera: Camera, call: Coroutine[Any, Any, object]) -> None:
    """Check that a call raises an UnsupportedError, and that the session continues."""
    dialect = re.escape(camera.capabilities.dialect)
    abilities = re.escape(", ".join(camera.capabilities.names))
    with pytest.raises(UnsupportedError, match=rf"dialect {dialect} .*{abilities}"):
        await call
    assert camera.connected
    await trigger_and_read(camera)


def check_balance(statistics: Statistics) -> None:
    """Check that the fates of all results, and each subscriber's counts, add up."""
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
