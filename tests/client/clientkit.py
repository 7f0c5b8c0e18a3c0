"""Helpers of the client's tests: sessions with every camera, events of cameras, and loop steps."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import AbstractAsyncContextManager
from typing import Any, NamedTuple, TypeVar

import pytest

import smartcam
from smartcam import Backoff, Camera, ConnectionLostError
from smartcam.emulator import EmulatedCamera, ManualClock
from smartcam.models import Statistics
from smartcam.observers import Observer, TraceEntry
from tests.client.camera_by_hand import (
    CONNECT,
    DISCONNECT,
    QUERY,
    TRIGGER,
    HandmadeBid,
    HandmadeCamera,
)
from tests.client.inside import polling
from tests.handmade import until
from tests.insides import inside

BoxT = TypeVar("BoxT", HandmadeCamera, HandmadeBid, EmulatedCamera)

SHORT = 0.05
"""Seconds of a timeout that is meant to fire."""


def ask_again_after(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """Have a client repeat a question that has no answer after so long."""
    monkeypatch.setattr(polling, "REPEAT_AFTER", seconds)


def hear(camera: Camera, data: bytes) -> None:
    """Have the client's link read bytes at once; from a task they are handed on a turn later."""
    link: Any = inside(camera)._connection.link
    link.get_buffer(-1)[: len(data)] = data
    link.buffer_updated(len(data))


@contextlib.asynccontextmanager
async def in_session(made: BoxT, **options: Any) -> AsyncIterator[tuple[BoxT, Camera]]:
    """A camera and a client in a session with it, which does not reconnect by default."""
    options.setdefault("reconnect", None)
    async with nothing_unheard(), made, smartcam.connect(made.url, **options) as camera:
        yield made, camera


def by_hand(
    *, box: dict[str, Any] | None = None, **options: Any
) -> AbstractAsyncContextManager[tuple[HandmadeCamera, Camera]]:
    """A handmade camera and a client, :func:`in_session`."""
    return in_session(HandmadeCamera(**(box or {})), **options)


def bid_by_hand(
    *, box: dict[str, Any] | None = None, **options: Any
) -> AbstractAsyncContextManager[tuple[HandmadeBid, Camera]]:
    """A handmade BVS ID and a client, :func:`in_session`."""
    return in_session(HandmadeBid(**(box or {})), **options)


@contextlib.asynccontextmanager
async def emulated(
    *, box: dict[str, Any] | None = None, **options: Any
) -> AsyncIterator[tuple[EmulatedCamera, ManualClock, Camera]]:
    """An emulated camera on a clock that stands still and a client, :func:`in_session`."""
    clock = ManualClock()
    async with in_session(EmulatedCamera(clock=clock, **(box or {})), **options) as (made, camera):
        yield made, clock, camera


@contextlib.contextmanager
def loop_reports() -> Iterator[list[str]]:
    """Give what the loop has to report because nobody else heard of it."""
    loop = asyncio.get_running_loop()
    reports: list[str] = []
    handler = loop.get_exception_handler()
    loop.set_exception_handler(lambda _, context: reports.append(str(context)))
    try:
        yield reports
    finally:
        loop.set_exception_handler(handler)


@contextlib.asynccontextmanager
async def nothing_unheard() -> AsyncIterator[None]:
    """Assert that the loop has no error to report that reached nobody."""
    with loop_reports() as reports:
        yield
    assert reports == []


async def steps(count: int) -> None:
    """Let the loop run ``count`` times."""
    for _ in range(count):
        await asyncio.sleep(0)


async def cancelled(task: asyncio.Task[Any]) -> None:
    """Cancel a task and wait for its end; it must end by that."""
    task.cancel()
    await asyncio.wait({task})
    assert task.cancelled()


async def gone(waiting: Awaitable[object]) -> BaseException | None:
    """Return the error that something ends with, None if it gives a value."""
    return (await asyncio.gather(waiting, return_exceptions=True))[0]  # type: ignore[return-value]


def imbalances(got: Statistics) -> Iterator[str]:
    """Give what does not add up in a client's accounts, in words."""
    fates = got.triggered + got.streamed + got.late + got.unclaimed
    if got.received != fates + got.wrong_application + got.uninterpretable:
        yield f"the fates do not add up: {got}"
    for one in got.subscribers:
        if one.offered != one.taken + one.dropped + one.queued:
            yield f"a subscriber's account does not balance: {one}"


def balance(statistics: Statistics) -> None:
    """Assert that a client's accounts balance."""
    assert [*imbalances(statistics)] == []


FAST = Backoff(initial=0.001, factor=2, maximum=0.01, jitter=0.0)
NEVER_YET = Backoff(initial=60.0, maximum=60.0, jitter=0.0)
"""The first try is so far away that the outage lasts as long as the test."""

SOON = 5.0
"""Seconds after which what should happen at once fails the test."""

OPENING = [DISCONNECT, CONNECT, QUERY]
"""Messages that a client says first in a session."""

TRIGGER_IDS = [QUERY, TRIGGER, QUERY]
"""Messages that a client says for a trigger over TCP, in one write."""


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


async def lose(box: HandmadeCamera, camera: Camera) -> None:
    """End the link from the camera's side, and wait until the client has told it."""
    waiting = asyncio.create_task(camera.wait_status(lambda _: False))
    await steps(2)
    box.hang_up()
    assert isinstance(await gone(waiting), ConnectionLostError)


async def lose_and_come_back(box: HandmadeCamera, camera: Camera) -> None:
    """End the link from the camera's side, and wait until there is the next session."""
    sessions = camera.statistics().sessions
    box.hang_up()
    await until(lambda: camera.statistics().sessions > sessions)
    await camera.wait_connected(SOON)


def only(times: int, answer: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """Return what answers so many times as before, and then no more."""
    left = iter(range(times))
    return lambda payload: b"" if next(left, None) is None else answer(payload)


async def cancelled_at_its_query(box: HandmadeCamera, camera: Camera) -> None:
    """Lose a trigger's result, then cancel the next trigger while its Query is not answered.

    The camera answers Query again from then on, and takes triggers without a result.
    """
    query = box.script[QUERY]
    box.script |= {TRIGGER: box.takes, QUERY: only(2, query)}
    await gone(camera.trigger(timeout=SHORT))
    fencing = asyncio.create_task(camera.trigger())
    await box.wait_for(QUERY, 4)  # at connect, around the first trigger, behind the Stop
    await cancelled(fencing)
    box.script[QUERY] = query


class Sending(NamedTuple):
    """A Trigger message that was sent."""

    session: int  # in which, counted from 1 by the Connects that were sent
    trigger: int  # which of that session, from 1
    at: float  # when, as the loop says


class TriggerEar(Observer):
    """Counts what is said; one for all clients of a camera, one after the other."""

    def __init__(self) -> None:
        self.session = 0  # Connects that were sent
        self.said: Counter[str] = Counter()  # frames that the client sent, by message
        self.results: Counter[int] = Counter()  # containers that came, by session
        # Trigger messages by the task that sent them; a command runs in its caller's
        self.sendings: dict[asyncio.Task[Any], list[Sending]] = {}
        # called when one goes out, with the task that sent it
        self.at_trigger: Callable[[asyncio.Task[Any]], None] | None = None
        self._in_session = 0

    @property
    def last(self) -> tuple[int, int]:
        """Session and count of the last Trigger message."""
        return self.session, self._in_session

    def on_frame(self, entry: TraceEntry) -> None:
        if entry.direction == "<":
            self.results[self.session] += entry.message == "ResultContainer"
            return
        self.said[entry.message] += 1
        if entry.message == "Connect":
            self.session += 1
            self._in_session = 0
        elif entry.message == "Trigger":
            self._in_session += 1
            task = asyncio.current_task()
            assert task is not None
            sending = Sending(self.session, self._in_session, asyncio.get_running_loop().time())
            self.sendings.setdefault(task, []).append(sending)
            if self.at_trigger is not None:
                self.at_trigger(task)
