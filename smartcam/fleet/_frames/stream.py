"""Define the streams of frames at an agent: a stream chooses the next frame for one program."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from smartcam.fleet._frames.pace import FramePace

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.fleet._frames.video import SharedVideo
    from smartcam.fleet._frames.wire import FrameForm
    from smartcam.frames import Frame, FrameReader

IDLE_TIMEOUT = 3.0
"""Seconds without a request after which a stream is closed."""

HOLD_TIMEOUT = 1.0
"""Seconds for which a request waits for a frame; after that, it is answered without one."""


class FrameCall(NamedTuple):
    """A program's request for a frame.

    Attributes:
        program: name of the program.
        call: number of the call among the program's calls.
        encoding: form of the frame.
        timeout: seconds of the call's timeout.
        min_interval: least seconds from one frame of a stream to the next.
        last_number: number of the last H.264 frame that the program has; 0 for none.
    """

    program: str
    call: int
    encoding: FrameForm
    timeout: float
    min_interval: float = 0.0
    last_number: int = 0


class TakenFrame(NamedTuple):
    """A frame that was taken from a stream for a program.

    Attributes:
        frame: the encoded frame.
        encoding_time: seconds to encode the frame.
        number: number of a frame of H.264 in its stream; otherwise 0.
    """

    frame: Frame
    encoding_time: float
    number: int = 0


@dataclass(eq=False)
class FrameStream(ABC):
    """A stream of a program.

    Attributes:
        number: number of the stream.
        busy: whether a request of the stream is running.
        idle_timer: timer that closes an idle stream; None while the stream is busy.
    """

    number: int
    idle_timer: asyncio.TimerHandle | None = field(default=None, kw_only=True)
    busy: bool = field(default=False, kw_only=True)

    def mark_idle(self, close: Callable[[], None]) -> None:
        """Count the stream as idle; call ``close`` after :data:`IDLE_TIMEOUT` without a request."""
        self.busy = False
        self.idle_timer = asyncio.get_running_loop().call_later(IDLE_TIMEOUT, close)

    def mark_busy(self) -> None:
        """Count the stream as busy with a request; stop the timer of an idle stream."""
        self.busy = True
        if self.idle_timer is not None:
            self.idle_timer.cancel()
            self.idle_timer = None

    @abstractmethod
    async def take_frames(self, call: FrameCall) -> list[TakenFrame]:
        """Return the next frame, or several frames of H.264.

        Raises:
            TimeoutError: no frame came in time; the stream goes on.
            StopAsyncIteration: the stream has ended.
            SmartCamError: the stream has ended with this error.
        """

    @abstractmethod
    def counts(self) -> dict[str, int]:
        """Return the numbers of frames sent, skipped and lost, for the next reply."""

    def close(self) -> None:
        """End the stream. Idempotent."""
        self.mark_busy()


@dataclass(eq=False)
class PictureStream(FrameStream):
    """A stream of independent frames; older frames are skipped.

    Args:
        reader: reader of the source.
        encode: function that returns a frame encoded, and the seconds that this took.
    """

    reader: FrameReader
    encode: Callable[[Frame, FrameForm], Awaitable[tuple[Frame, float]]]
    pace: FramePace = field(default_factory=FramePace)

    async def take_frames(self, call: FrameCall) -> list[TakenFrame]:
        loop, reader = asyncio.get_running_loop(), self.reader
        oldest_arrival, wait_until = self.pace.choose_window(
            loop.time(), reader.last_arrival, call.min_interval
        )
        async with asyncio.timeout(min(call.timeout, HOLD_TIMEOUT)):
            await reader.wait_newer(oldest_arrival, wait_until)
            frame = await anext(reader)
        self.pace.note_taken(reader.last_arrival, reader.statistics().offered)
        async with asyncio.timeout(call.timeout):
            taken = TakenFrame(*await self.encode(frame, call.encoding))
        self.pace.note_sent(loop.time())
        return [taken]

    def counts(self) -> dict[str, int]:
        counts = self.reader.statistics()
        return {"sent": counts.delivered, "skipped": counts.skipped, "lost": counts.lost}

    def close(self) -> None:
        super().close()
        self.reader.close()


@dataclass(eq=False)
class VideoStream(FrameStream):
    """A stream of H.264, of which a program gets all encoded frames, in order.

    Args:
        video: the encoder's stream, shared with other viewers.
        release_video: function that is called once when this stream is closed; None afterwards.
    """

    video: SharedVideo
    release_video: Callable[[SharedVideo], None] | None
    _highest_number: int = 0
    _sent_count: int = 0
    _first_counts: tuple[int, int] | None = None  # frames offered and lost before the first frame
    _last_counts: tuple[int, int] = (0, 0)

    async def take_frames(self, call: FrameCall) -> list[TakenFrame]:
        async with asyncio.timeout(min(call.timeout, HOLD_TIMEOUT)):
            units = await self.video.next_units(call.last_number)
        if self._first_counts is None:
            self._first_counts = units[0].offered_count - 1, units[0].lost_count
        self._sent_count += sum(unit.number > self._highest_number for unit in units)
        self._highest_number = max(self._highest_number, units[-1].number)
        self._last_counts = units[-1].offered_count, units[-1].lost_count
        return [TakenFrame(unit.frame, unit.encoding_time, unit.number) for unit in units]

    def counts(self) -> dict[str, int]:
        first_offered, first_lost = self._first_counts or (0, 0)
        skipped = self._last_counts[0] - first_offered - self._sent_count
        lost = self._last_counts[1] - first_lost
        return {"sent": self._sent_count, "skipped": skipped, "lost": lost}

    def close(self) -> None:
        super().close()
        release_video, self.release_video = self.release_video, None
        if release_video is not None:
            release_video(self.video)
