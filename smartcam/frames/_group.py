"""Read several cameras at once, in sets of frames of the same moment."""

from __future__ import annotations

import asyncio
import collections
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from smartcam._arguments import check_kind, check_seconds_or_none
from smartcam.exceptions import (
    ConfigurationError,
    FrameSourceError,
    FrameTimeoutError,
    LocalProtocolError,
)
from smartcam.frames._reader import FRAME_TIMEOUT, FrameReader

if TYPE_CHECKING:
    from typing import Self

    from smartcam.frames._frame import Frame
    from smartcam.frames._source import FrameSource


MAX_WAITING_FRAMES: Final = 8
"""Largest number of frames of each camera that wait for frames of the others."""

UNKNOWN_PERIOD: Final = 0.04
"""Assumed time between frames, seconds, if the frame rate is unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """Frames of the same moment, one from each camera.

    Attributes:
        frames: frames by the names of the cameras.
        skew: seconds from the first frame to the last, by ``Frame.captured``.
    """

    frames: Mapping[str, Frame]
    skew: float

    def __getitem__(self, name: str) -> Frame:
        """Return the frame of one camera."""
        return self.frames[name]

    @property
    def captured(self) -> float:
        """Capture time of the latest frame, seconds of ``time.monotonic()``."""
        return max(frame.captured for frame in self.frames.values())


@dataclass(frozen=True, slots=True)
class GroupStatistics:
    """Counts of the frames of a group.

    Attributes:
        offered: number of complete sets; always delivered + skipped + waiting.
        delivered: number of sets that a reader took.
        skipped: number of sets that were replaced by a newer one.
        waiting: 1 if a set waits for a reader, else 0.
        alone: number of each camera's frames that are in no set, by the camera's name.
        skew: largest skew of any set, seconds.
    """

    offered: int
    delivered: int
    skipped: int
    waiting: int
    alone: Mapping[str, int]
    skew: float


class FrameGroup:
    """Cameras that are opened, started and stopped together; an iterator of :class:`FrameSet`.

    ::

        async with FrameGroup({"left": open(LEFT), "right": open(RIGHT)}) as pair:
            async for both in pair:
                both["left"], both["right"], both.skew

    An iteration returns the newest set and skips older ones. All cameras stream from the first
    iteration until the group is closed. Each frame is in one set at most.

    Args:
        sources: unopened sources by name; the group opens and closes them.
        within: largest skew of a set, seconds; None: half of the time between two frames of the
            fastest camera, so that a frame matches only one of them.
        timeout: seconds that an iteration waits for a set; None: without limit.

    Raises:
        ConfigurationError: there are no sources, one is given twice, or a time is not valid.
    """

    def __init__(
        self,
        sources: Mapping[str, FrameSource],
        *,
        within: float | None = None,
        timeout: float | None = FRAME_TIMEOUT,
    ) -> None:
        check_kind(sources, Mapping, "group of frame sources", "a mapping from name to source")
        if not sources or len({id(source) for source in sources.values()}) < len(sources):
            raise ConfigurationError(
                f"group of frame sources: expected one or more, each once, got {list(sources)}"
            )
        self._within = check_seconds_or_none(within, "within", exclusive=True)
        self._timeout = check_seconds_or_none(timeout, "timeout", exclusive=True)
        self._sources = dict(sources)
        self._readers: dict[str, _GroupReader] = {}
        self._is_open = False
        self._queues: dict[str, collections.deque[Frame]] = {
            name: collections.deque() for name in sources
        }
        self._alone = dict.fromkeys(sources, 0)
        self._next_set: FrameSet | None = None
        # error with which the group ended, or None, in a tuple; None: it has not ended
        self._end_cause: tuple[FrameSourceError | None] | None = None
        self._changed = asyncio.Event()
        self._offered = self._delivered = self._skipped = 0
        self._skew = 0.0

    @property
    def sources(self) -> Mapping[str, FrameSource]:
        """The cameras by name."""
        return self._sources

    @property
    def within(self) -> float:
        """Largest skew of a set, seconds.

        Raises:
            LocalProtocolError: the skew follows from the cameras' frame rates, and they are not
                open.
        """
        if self._within is not None:
            return self._within
        rates = [rate for source in self._sources.values() for rate in source.format.rates[:1]]
        return 0.5 * (1 / max(rates) if rates else UNKNOWN_PERIOD)

    def statistics(self) -> GroupStatistics:
        """Return the present counts."""
        return GroupStatistics(
            self._offered,
            self._delivered,
            self._skipped,
            int(self._next_set is not None),
            dict(self._alone),
            self._skew,
        )

    async def __aenter__(self) -> Self:
        """Open all cameras at the same time; they do not stream yet.

        Raises:
            FrameSourceError: a camera cannot be opened; all are closed again.
        """
        if self._is_open:
            raise LocalProtocolError("the group of frame sources is open already")
        opening = [asyncio.ensure_future(source.__aenter__()) for source in self._sources.values()]
        try:
            await asyncio.gather(*opening)
        except BaseException:
            for task in opening:
                task.cancel()
            await asyncio.wait(opening)
            await self._close_all()
            raise
        self._is_open = True
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Stop and close all cameras. Idempotent."""
        self._is_open = False
        for reader in self._readers.values():
            reader.close()
        self._readers.clear()
        if self._next_set is not None:
            self._next_set = None
            self._skipped += 1
        self._end(None)
        await self._close_all()

    async def _close_all(self) -> None:
        for source in self._sources.values():
            await source.close()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> FrameSet:
        """Return the newest set that was not returned yet.

        Raises:
            FrameTimeoutError: no set came in time; the text says which cameras gave frames.
            FrameSourceError: a camera ended with an error.

        Cancellation: safe; the next call returns the set.
        """
        self._start()
        try:
            async with asyncio.timeout(self._timeout):
                while self._next_set is None and self._end_cause is None:
                    self._changed.clear()
                    await self._changed.wait()
        except TimeoutError:
            raise FrameTimeoutError(self._timeout_text(), source=", ".join(self._sources)) from None
        if self._next_set is not None:
            frame_set, self._next_set = self._next_set, None
            self._delivered += 1
            return frame_set
        if self._end_cause is not None and self._end_cause[0] is not None:
            raise self._end_cause[0]
        raise StopAsyncIteration

    def _start(self) -> None:
        if not self._is_open:
            raise LocalProtocolError("the group of frame sources is not open: use `async with`")
        if not self._readers and self._end_cause is None:
            # made in one step of the loop, so that all cameras start together
            self._readers = {
                name: _GroupReader(source, self, name) for name, source in self._sources.items()
            }

    def _timeout_text(self) -> str:
        counts = ", ".join(
            f"{name} {reader.statistics().offered}" for name, reader in self._readers.items()
        )
        return (
            f"frames of {' and '.join(self._sources)}: expected one of each, "
            f"at most {self.within * 1e3:.3g} ms apart, in {self._timeout:g} s, got none; frames "
            f"received in total: {counts}"
        )

    def _add_frame(self, name: str, frame: Frame) -> None:
        """Add a camera's frame; if it completes a set, store the set for the next iteration."""
        queue = self._queues[name]
        queue.append(frame)
        if len(queue) > MAX_WAITING_FRAMES:
            queue.popleft()
            self._alone[name] += 1
        frames = {name: frame}
        for other, candidates in self._queues.items():
            if other != name:
                if not candidates:
                    return
                frames[other] = min(
                    candidates, key=lambda candidate: abs(candidate.captured - frame.captured)
                )
        moments = [member.captured for member in frames.values()]
        skew = max(moments) - min(moments)
        if skew > self.within:
            return
        for other, member in frames.items():
            self._drop_until(other, member)
        self._offered += 1
        self._skew = max(self._skew, skew)
        if self._next_set is not None:
            self._skipped += 1
        self._next_set = FrameSet({key: frames[key] for key in self._sources}, skew)
        self._changed.set()

    def _drop_until(self, name: str, frame: Frame) -> None:
        """Drop a frame that is in a set, and all earlier frames, which cannot be in a later set."""
        queue = self._queues[name]
        while queue.popleft() is not frame:
            self._alone[name] += 1

    def _end(self, error: FrameSourceError | None) -> None:
        if self._end_cause is None:
            self._end_cause = (error,)
        self._changed.set()


class _GroupReader(FrameReader):
    """A reader that passes each frame to its group at once."""

    def __init__(self, source: FrameSource, group: FrameGroup, name: str) -> None:
        super().__init__(source, None)
        self._group, self._member = group, name
        source.attach(self)

    def _offer(self, frame: Frame) -> None:
        self._offered += 1
        self._delivered += 1
        self._group._add_frame(self._member, frame)  # noqa: SLF001 - same module

    def _end(self, error: FrameSourceError | None) -> None:
        super()._end(error)
        self._group._end(error)  # noqa: SLF001
