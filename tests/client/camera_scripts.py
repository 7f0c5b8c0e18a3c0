"""What the camera by hand does in tests of losses and outcomes."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from camera_by_hand import (
    CONNECT,
    DISCONNECT,
    QUERY,
    HandmadeCamera,
)
from clientkit import gone, steps, until

from smartcam import (
    Backoff,
    ConnectionLostError,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam import SmartCamera

FAST = Backoff(initial=0.001, factor=2, maximum=0.01, jitter=0.0)
NEVER_YET = Backoff(initial=60.0, maximum=60.0, jitter=0.0)
"""The first try is so far away that the outage lasts as long as the test."""

SOON = 5.0
"""Seconds after which what should happen at once fails the test."""

OPENING = [DISCONNECT, CONNECT, QUERY]
"""What a client says first in a session."""


def quiet(_: bytes) -> bytes:
    """Say nothing."""
    return b""


def answers(*statuses: int, result: bytes | None = None, application: int | None = None) -> Any:
    """Return what the camera does at a trigger: statuses, then perhaps a result."""

    def script(box: HandmadeCamera) -> Callable[[bytes], bytes]:
        def at_trigger(_: bytes) -> bytes:
            said = b"".join(box.status_frame(status) for status in statuses)
            return said if result is None else said + box.result_frame(result, application)

        return at_trigger

    return script


async def lose(box: HandmadeCamera, camera: SmartCamera) -> None:
    """End the link from the camera's side, and wait until the client has told it."""
    waiting = asyncio.create_task(camera.wait_status(lambda _: False))
    await steps(2)
    box.hang_up()
    assert isinstance(await gone(waiting), ConnectionLostError)


async def lose_and_come_back(box: HandmadeCamera, camera: SmartCamera) -> None:
    """End the link from the camera's side, and wait until there is the next session."""
    sessions = camera.statistics().sessions
    box.hang_up()
    await until(lambda: camera.statistics().sessions > sessions)
    await camera.wait_connected(SOON)


def only(times: int, answer: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """Return what answers so many times as before, and then no more."""
    left = iter(range(times))
    return lambda payload: b"" if next(left, None) is None else answer(payload)
