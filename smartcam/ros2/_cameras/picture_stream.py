"""Publish the newest pictures on a topic while it has a subscriber."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from smartcam.backoff import Backoff
from smartcam.exceptions import FrameFormatError, FrameTimeoutError, SmartCamError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
    from contextlib import AbstractAsyncContextManager

logger: logging.Logger = logging.getLogger("smartcam.ros2")

Item = TypeVar("Item")

CHECK_INTERVAL: Final = 0.1
"""Seconds between two checks for a subscriber."""

IDLE_CHECK_INTERVAL: Final = 1.0
"""Seconds between two checks for a subscriber if the graph also reports new subscribers."""

REOPEN_BACKOFF: Final = Backoff(initial=0.5, maximum=10.0)
"""Delays before a source that has ended is opened again, while there is a subscriber."""


class SubscribedPictures(Generic[Item]):
    """Reads a source while one of its topics has a subscriber, and publishes each frame.

    Args:
        name: name of the camera, for the log.
        publishers: publishers of the topics.
        make_reader: function that makes a reader with this timeout of each frame, seconds.
        publish: coroutine function that publishes a frame; the next frame is read after it.

    Attributes:
        frames: number of published frames.
    """

    def __init__(
        self,
        name: str,
        publishers: Sequence[Any],
        make_reader: Callable[[float], AbstractAsyncContextManager[AsyncIterator[Item]]],
        publish: Callable[[Item], Awaitable[None]],
    ) -> None:
        self.frames: int = 0
        self._name, self._publishers = name, publishers
        self._make_reader, self._publish = make_reader, publish
        self._last_warning = ""
        self._subscriber_event = asyncio.Event()
        self._stop_watching: list[Callable[[], None]] = []
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Start to check for subscribers."""
        if self._task is None:
            methods = [getattr(publisher, "watch", None) for publisher in self._publishers]
            if None not in methods:
                self._stop_watching = [
                    watch(self._subscriber_event.set) for watch in methods if watch
                ]
            self._task = asyncio.get_running_loop().create_task(
                self._run(), name=f"pictures of {self._name}"
            )

    def cancel(self) -> None:
        """Stop reading as soon as possible. Idempotent."""
        stop_watching, self._stop_watching = self._stop_watching, []
        for stop in stop_watching:
            stop()
        if self._task is not None:
            self._task.cancel()

    async def close(self) -> None:
        """Stop reading. Idempotent.

        Cancellation: reading still ends.
        """
        self.cancel()
        if self._task is not None:
            await asyncio.wait([self._task])
            self._task = None

    @property
    def has_subscriber(self) -> bool:
        """True if one of the topics has a subscriber, as far as is known."""
        return any(getattr(publisher, "has_subscribers", True) for publisher in self._publishers)

    async def _run(self) -> None:
        while True:
            await self._wait_for_subscriber()
            last_count = self.frames
            delays = REOPEN_BACKOFF.delays()
            while self.has_subscriber:
                await self._publish_until_end()
                if self.frames > last_count:
                    last_count, delays = self.frames, REOPEN_BACKOFF.delays()
                await self._wait_to_reopen(next(delays))

    async def _wait_for_subscriber(self) -> None:
        """Wait for a subscriber; check less often if the graph reports new subscribers."""
        loop = asyncio.get_running_loop()
        check_often_until = 0.0
        while not self.has_subscriber:
            pause = (
                CHECK_INTERVAL
                if not self._stop_watching or loop.time() < check_often_until
                else IDLE_CHECK_INTERVAL
            )
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(pause):
                    await self._subscriber_event.wait()
                check_often_until = loop.time() + IDLE_CHECK_INTERVAL
                self._subscriber_event.clear()
                await asyncio.sleep(0)

    async def _wait_to_reopen(self, seconds: float) -> None:
        """Wait before the source is opened again, while there is a subscriber."""
        loop = asyncio.get_running_loop()
        end = loop.time() + seconds
        while self.has_subscriber and loop.time() < end:  # noqa: ASYNC110 - there is no event for it
            await asyncio.sleep(CHECK_INTERVAL)

    async def _publish_until_end(self) -> None:
        """Publish until there is no subscriber, or the source ends."""
        try:
            async with self._make_reader(CHECK_INTERVAL) as reader:
                while self.has_subscriber:
                    with contextlib.suppress(FrameTimeoutError):
                        await self._publish_one(await anext(reader))
        except StopAsyncIteration:
            self._warn_once(
                "the source of pictures ended; it is opened again while there is a subscriber"
            )
        except SmartCamError as exc:
            self._warn_once(str(exc))
        except Exception:
            logger.exception("%s ! its pictures failed", self._name)

    async def _publish_one(self, frame: Item) -> None:
        try:
            await self._publish(frame)
        except FrameFormatError as exc:  # the next frame may be complete
            self._warn_once(str(exc))
            return
        self.frames += 1
        self._last_warning = ""

    def _warn_once(self, text: str) -> None:
        """Log an error unless it is the same as the last one since a picture was published."""
        if text != self._last_warning:
            self._last_warning = text
            logger.warning("%s ! %s", self._name, text)


async def publish_newest(publisher: Any, fields: dict[str, Any]) -> None:
    """Publish a message that must not queue up; ROS 1's publishers can only queue it."""
    newest = getattr(publisher, "publish_newest", None)
    if newest is None:
        publisher.publish(fields)
    else:
        await newest(fields)
