"""Read a source of frames: the newest frame, and counts of the others."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING

from smartcam._arguments import check_age, check_clock_seconds, check_seconds_or_none
from smartcam.exceptions import FrameSourceError, FrameTimeoutError

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Self

    from smartcam.frames._frame import Frame
    from smartcam.frames._source import FrameSource

RELEASE_INTERVAL = 0.05
"""Seconds between two attempts to pass on a held-back frame."""

FRAME_TIMEOUT = 5.0
"""Default time to wait for a frame, seconds."""


@dataclass(frozen=True, slots=True)
class ReaderStatistics:
    """Counts of the frames since a reader began.

    Attributes:
        offered: frames that came since the reader began; always delivered + skipped + waiting.
        delivered: frames that the reader took.
        skipped: frames replaced by newer ones before the reader took them.
        waiting: 1 if a frame waits for the reader, else 0.
        lost: frames lost in the camera or on the way.
    """

    offered: int
    delivered: int
    skipped: int
    waiting: int
    lost: int


class FrameReader:
    """A reader of a source: an iterator that returns the newest frame and skips older ones.

    The device streams while there is a reader that is referenced and not closed.
    """

    def __init__(self, source: FrameSource, timeout: float | None) -> None:
        self._source: FrameSource | None = source
        self._timeout = timeout
        self._next: Frame | None = None
        self._last: Frame | None = None  # last returned frame
        self._has_ended = False
        self._error: FrameSourceError | None = None
        self._waiters: list[asyncio.Future[bool]] = []
        self._offered = self._delivered = self._skipped = self._lost = 0

    def statistics(self) -> ReaderStatistics:
        """Return the current counts."""
        return ReaderStatistics(
            self._offered,
            self._delivered,
            self._skipped,
            int(self._next is not None),
            self._lost,
        )

    def close(self) -> None:
        """Stop reading; a waiting frame counts as skipped. Idempotent."""
        if self._next is not None:
            self._skipped += 1
            self._next = None
        self._last = None
        self._end(None)
        if self._source is not None:
            self._source._remove_reader(self)  # noqa: SLF001 - its own source
            self._source = None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Frame:
        """Return the newest frame that was not returned yet.

        Raises:
            FrameTimeoutError: no frame came in time; the caller may wait again.
            FrameSourceError: the source ended with this error.

        Cancellation: safe; the next call returns the frame.
        """
        frame = await self._take_next(self._deadline(self._timeout), "the next frame")
        if frame is None:
            raise StopAsyncIteration
        return frame

    async def newest(self, *, max_age: float = 1.0, timeout: float | None = FRAME_TIMEOUT) -> Frame:
        """Return the newest frame that is not older than ``max_age``; wait if there is none.

        Args:
            max_age: largest age since the capture, seconds; ``inf``: any.
            timeout: time limit, seconds; None: without limit.

        Raises:
            ConfigurationError: a time is not valid.
            FrameTimeoutError: no frame came in time.
            FrameSourceError: the source ended.

        Cancellation: safe.
        """
        max_age = check_age(max_age, "max_age")
        timeout = check_seconds_or_none(timeout, "timeout")
        expected = f"a frame of the last {max_age:g} s"
        candidate = self._next or self._last
        if candidate is not None and candidate.age <= max_age:
            return self._mark_taken(candidate)
        return await self._first_matching(expected, timeout, lambda frame: frame.age <= max_age)

    async def after(self, moment: float, *, timeout: float | None = FRAME_TIMEOUT) -> Frame:
        """Return the first frame whose exposure began after a moment.

        The frame may be one that already waits for the reader, or the last one that it returned.

        If the start of the exposure is not known exactly, the frame is the first one that certainly
        was exposed after the moment: see :attr:`Frame.began`.

        Args:
            moment: time of ``time.monotonic()``.
            timeout: time limit, seconds; None: without limit.

        Raises:
            ConfigurationError: a time is not valid.
            FrameTimeoutError: no frame came in time.
            FrameSourceError: the source ended.

        Cancellation: safe; frames that came before are skipped.
        """
        moment = check_clock_seconds(moment, "moment")
        timeout = check_seconds_or_none(timeout, "timeout")
        for candidate in (self._last, self._next):
            if candidate is not None and candidate.began >= moment:
                return self._mark_taken(candidate)
        expected = "a frame exposed after the given moment"
        return await self._first_matching(expected, timeout, lambda frame: frame.began >= moment)

    async def wait_newer(self, since: float, until: float) -> None:
        """Wait until the next frame is newer than a moment, or until a deadline.

        Args:
            since: time of the loop's clock; earlier frames are skipped.
            until: deadline on the loop's clock, after which an older frame, or no frame, is
                accepted.

        Cancellation: safe.
        """
        check_clock_seconds(since, "since")
        check_clock_seconds(until, "until")
        loop = asyncio.get_running_loop()
        while not self._has_ended and loop.time() < until:
            if self._next is not None and self.last_arrival >= since:
                return
            await self._wait_for_change(until)

    @property
    def last_arrival(self) -> float:
        """Time of the newest frame's arrival on the loop's clock; 0.0 before the first."""
        return 0.0 if self._source is None else self._source._last_arrival  # noqa: SLF001

    def check_not_ended(self) -> None:
        """Raise the source's error if it has ended.

        Raises:
            FrameSourceError: the source ended.
        """
        if self._has_ended:
            default = FrameSourceError(f"{self._name}: it ended", source=self._name)
            raise self._error or default

    def _trigger_hint(self) -> str:
        """Return the condition that the device awaits, for an error's text; "": none."""
        condition = "" if self._source is None else self._source.driver.awaited_condition
        return f": {condition}, and nothing triggered it" if condition else ""

    async def _first_matching(
        self, expected: str, timeout: float | None, matches: Callable[[Frame], bool]
    ) -> Frame:
        """Return the first matching frame."""
        deadline = self._deadline(timeout)
        while (frame := await self._take_next(deadline, expected)) is not None:
            if matches(frame):
                return frame
        text = f"{self._name}: expected {expected}, the source ended"
        raise FrameSourceError(text, source=self._name)

    @property
    def _name(self) -> str:
        return self._source.name if self._source is not None else "a closed reader"

    @staticmethod
    def _deadline(timeout: float | None) -> float | None:
        if timeout is None:
            return None
        return asyncio.get_running_loop().time() + timeout

    async def _take_next(self, deadline: float | None, expected: str) -> Frame | None:
        """Return the next frame; None at the end of the source."""
        while self._next is None and not self._has_ended:
            if not await self._wait_for_change(deadline):
                raise FrameTimeoutError(
                    f"{self._name}: expected {expected}, got none in time{self._trigger_hint()}",
                    source=self._name,
                )
        if self._next is not None:
            return self._mark_taken(self._next)
        if self._error is not None:
            raise self._error
        return None

    async def _wait_for_change(self, deadline: float | None) -> bool:
        """Wait for a frame or the end of the source; return False at the deadline.

        The method uses a future and a timer; asyncio's own functions take twice as long per frame.
        """
        loop = asyncio.get_running_loop()
        waiter: asyncio.Future[bool] = loop.create_future()
        timer = None if deadline is None else loop.call_at(deadline, _set_result, waiter, False)
        self._waiters.append(waiter)
        try:
            return await waiter or self._next is not None
        finally:
            self._waiters.remove(waiter)
            if timer is not None:
                timer.cancel()

    def _wake(self) -> None:
        for waiter in self._waiters:
            _set_result(waiter, True)

    def _offer(self, frame: Frame) -> None:
        self._offered += 1
        if self._next is not None:
            self._skipped += 1
        self._next = frame
        self._wake()

    def _miss(self, count: int) -> None:
        self._lost += count

    def _skip(self, count: int) -> None:
        self._offered += count
        self._skipped += count

    def _end(self, error: FrameSourceError | None) -> None:
        if not self._has_ended:
            self._has_ended, self._error = True, error
        self._wake()

    def _mark_taken(self, frame: Frame) -> Frame:
        if frame is self._next:
            self._next = None
            self._delivered += 1
            if self._source is not None:
                self._source._reader_advanced.set()  # noqa: SLF001 - its own source
        self._last = frame
        return frame


class FrameTap(FrameReader):
    """A reader that passes on every frame as it comes.

    While ``busy`` returns True, the last frame is held back. A source that can wait, such as a
    file, waits then; if the source cannot wait, its next frame releases the one held back.

    Args:
        source: open source; the device streams from now on.
        take: function that is called with each frame, and returns False for a frame that counts as
            skipped. It must not block.
        busy: function that returns True to delay frames.
    """

    def __init__(
        self, source: FrameSource, take: Callable[[Frame], bool], busy: Callable[[], bool]
    ) -> None:
        super().__init__(source, None)
        self._take_frame, self._busy = take, busy
        source.attach(self)

    async def pass_until_end(self) -> None:
        """Pass on all frames until the source has ended.

        Raises:
            FrameSourceError: the source ended with this error.

        Cancellation: safe.
        """
        loop = asyncio.get_running_loop()
        while not self._has_ended:
            await self._wait_for_change(loop.time() + RELEASE_INTERVAL)
            if self._next is not None and not self._busy():
                self._pass_on(self._next)
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """Stop reading, and pass on a held-back frame. Idempotent."""
        if self._next is not None:
            self._pass_on(self._next)
        super().close()

    def _offer(self, frame: Frame) -> None:
        self._offered += 1
        if self._next is not None:
            self._pass_on(self._next)
        if self._busy():
            self._next = frame
        else:
            self._pass_on(frame)

    def _pass_on(self, frame: Frame) -> None:
        self._next = None
        if self._take_frame(frame):
            self._delivered += 1
        else:
            self._skipped += 1
        if self._source is not None:
            self._source._reader_advanced.set()  # noqa: SLF001 - its own source

    def _end(self, error: FrameSourceError | None) -> None:
        if self._next is not None:
            self._pass_on(self._next)
        super()._end(error)


def _set_result(waiter: asyncio.Future[bool], received: bool) -> None:
    if not waiter.done():
        waiter.set_result(received)
