"""Trigger a source, one trigger at a time; the result is its picture or a typed error.

If a trigger was sent and its picture has not come, the picture may still come. So the stream is
restarted before the next trigger, which drops late pictures.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from smartcam.exceptions import CameraBusyError, FrameSourceError, TriggerTimeoutError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.exceptions import SmartCamError
    from smartcam.frames._frame import Frame
    from smartcam.frames._source import FrameSource


MAX_NOTES = 5
"""Largest number of a trigger's notes in an error's text."""


class AwaitedTrigger:
    """A pending trigger.

    Attributes:
        number: number of the trigger, counted by its source.
        fired: time right before it was sent, seconds of ``time.monotonic()``; None: not sent yet.
        outcome: the frame, or the error.
        notes: remarks on what happened during the wait, for the error's text.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        self.fired: float | None = None
        self.outcome: asyncio.Future[Frame] = asyncio.get_running_loop().create_future()
        self.notes: list[str] = []

    def record_fire(self) -> None:
        """Record the time right before the trigger is sent."""
        self.fired = time.monotonic()

    def record_refusal(self) -> None:
        """Record that the device did not accept the trigger, so no picture will come."""
        self.fired = None


class TriggerQueue:
    """The triggers of a source, one after the other.

    Args:
        source: source that is triggered.

    Attributes:
        picture_may_come: whether the picture of an earlier trigger may still come.
    """

    def __init__(self, source: FrameSource) -> None:
        self._source = source
        self._lock = asyncio.Lock()
        self._pending: AwaitedTrigger | None = None
        self._trigger_count = 0
        self.picture_may_come = False

    async def trigger(
        self, seconds: float, refuse: bool, fire: Callable[[], Awaitable[object]] | None
    ) -> Frame:
        """Trigger once, as :meth:`FrameSource.trigger` does."""
        name = self._source.name
        driver = self._source.driver
        if fire is None and (frame := await driver.trigger_by_owner(seconds, refuse=refuse)):
            return frame
        if refuse and self._lock.locked():
            raise CameraBusyError(f"{name}: another trigger is pending, and when_busy is 'refuse'")
        steps = ["waiting for earlier triggers"]
        pending = AwaitedTrigger(0)
        try:
            async with asyncio.timeout(seconds), self._lock:
                steps.append("starting the stream")
                async with self._source.reader(timeout=None) as reader:
                    await self._source.wait_until_streaming(reader, anew=self.picture_may_come)
                    self._trigger_count += 1
                    pending.number = self._trigger_count
                    steps.append("triggering")
                    return await self._trigger_once(pending, fire)
        except FrameSourceError:
            raise
        except TimeoutError as exc:
            notes = "".join(f"; {note}" for note in pending.notes[:MAX_NOTES])
            condition = self._source.driver.awaited_condition
            raise TriggerTimeoutError(
                f"{name}: no picture of the trigger within {seconds:g} s, which ran out while "
                f"{steps[-1]}{notes}{f'; {condition}' if condition else ''}",
                waited=seconds,
            ) from exc

    async def _trigger_once(
        self, pending: AwaitedTrigger, fire: Callable[[], Awaitable[object]] | None
    ) -> Frame:
        driver = self._source.driver
        self._pending = pending
        try:
            try:
                await driver.trigger(pending, fire)
            except FrameSourceError:
                if not _has_arrived(pending):  # only the answer to the trigger was lost
                    raise
            return await pending.outcome
        finally:
            self._pending = None
            driver.disarm()
            self.picture_may_come |= pending.fired is not None and not _has_arrived(pending)
            if not pending.outcome.cancel() and not pending.outcome.cancelled():
                pending.outcome.exception()  # mark the error as retrieved

    def on_frame(self, frame: Frame) -> None:
        """Pass the frame of the pending trigger to its caller."""
        pending = self._pending
        if (
            pending is not None
            and frame.trigger is not None
            and frame.trigger.number == pending.number
            and not pending.outcome.done()
        ):
            pending.outcome.set_result(frame)

    def fail_pending(self, error: SmartCamError) -> None:
        """Pass an error to the caller of the pending trigger."""
        if self._pending is not None and not self._pending.outcome.done():
            self._pending.outcome.set_exception(error)


def _has_arrived(pending: AwaitedTrigger) -> bool:
    outcome = pending.outcome
    return outcome.done() and not outcome.cancelled() and outcome.exception() is None
