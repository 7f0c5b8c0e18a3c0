"""The streams of frames at an agent, which choose the next frames for programs."""

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
"""Seconds without a request after which a stream has ended."""

HOLD_TIMEOUT = 1.0
"""Seconds for which a request waits for a frame; then the answer is that there is none."""


class FrameOrder(NamedTuple):
    """A request for a frame: the program, and the form.

    Attributes:
        program: name of the program.
        call: number of the program's call.
        encoding: form of the frame.
        timeout: seconds of the call's timeout.
        min_interval: least seconds from one frame of a stream to the next.
        have: number, for H.264, of the last encoded frame that the program has; 0 for none.
    """

    program: str
    call: int
    encoding: FrameForm
    timeout: float
    min_interval: float = 0.0
    have: int = 0


class TakenFrame(NamedTuple):
    """A frame for a program.

    Attributes:
        frame: the encoded frame.
        took: seconds to encode it.
        number: place of a frame of H.264 in the stream; otherwise 0.
    """

    frame: Frame
    took: float
    number: int = 0


@dataclass(eq=False)
class FrameStream(ABC):
    """A stream of a program.

    Attributes:
        number: number of the stream.
        busy: whether a request of the stream is running.
    """

    number: int
    idle: asyncio.TimerHandle | None = field(default=None, kw_only=True)
    busy: bool = field(default=False, kw_only=True)

    def mark_idle(self, close: Callable[[], None]) -> None:
        """Count the stream as idle; ``close`` is called if it stays so."""
        self.busy = False
        self.idle = asyncio.get_running_loop().call_later(IDLE_TIMEOUT, close)

    def wake(self) -> None:
        """Count the stream as busy with a request."""
        self.busy = True
        if self.idle is not None:
            self.idle.cancel()
            self.idle = None

    @abstractmethod
    async def take(self, order: FrameOrder) -> list[TakenFrame]:
        """Return the next frame, or several frames of H.264.

        Raises:
            TimeoutError: there is no frame for now.
            StopAsyncIteration: the stream has ended.
            SmartCamError: the stream has ended with this error.
        """

    @abstractmethod
    def counts(self) -> dict[str, int]:
        """Return the numbers of sent, skipped and lost frames, for the next reply."""

    def close(self) -> None:
        """End the stream. Idempotent."""
        self.wake()


@dataclass(eq=False)
class PictureStream(FrameStream):
    """A stream of independent frames, of which the newest is next.

    Args:
        reader: reader of the source.
        encode: function that encodes a frame and returns the seconds that this took.
    """

    reader: FrameReader
    encode: Callable[[Frame, FrameForm], Awaitable[tuple[Frame, float]]]
    pace: FramePace = field(default_factory=FramePace)

    async def take(self, order: FrameOrder) -> list[TakenFrame]:
        loop, reader = asyncio.get_running_loop(), self.reader
        since, until = self.pace.window(loop.time(), reader.last_arrival, order.min_interval)
        async with asyncio.timeout(min(order.timeout, HOLD_TIMEOUT)):
            await reader.fresh(since, until)
            frame = await anext(reader)
        self.pace.note_taken(reader.last_arrival, reader.statistics().offered)
        async with asyncio.timeout(order.timeout):
            taken = TakenFrame(*await self.encode(frame, order.encoding))
        self.pace.note_sent(loop.time())
        return [taken]

    def counts(self) -> dict[str, int]:
        account = self.reader.statistics()
        return {"sent": account.delivered, "skipped": account.skipped, "lost": account.lost}

    def close(self) -> None:
        super().close()
        self.reader.close()


@dataclass(eq=False)
class VideoStream(FrameStream):
    """A stream of H.264: all encoded frames after the frames that the program has.

    Args:
        video: the encoder's stream, shared with other viewers.
        leave: function that is called at the end; None after it.
    """

    video: SharedVideo
    leave: Callable[[SharedVideo], None] | None
    _highest: int = 0
    _sent: int = 0
    _first: tuple[int, int] | None = None  # frames offered and lost before the first one
    _last: tuple[int, int] = (0, 0)

    async def take(self, order: FrameOrder) -> list[TakenFrame]:
        async with asyncio.timeout(min(order.timeout, HOLD_TIMEOUT)):
            units = await self.video.after(order.have)
        if self._first is None:
            self._first = units[0].offered - 1, units[0].lost
        self._sent += sum(unit.number > self._highest for unit in units)
        self._highest = max(self._highest, units[-1].number)
        self._last = units[-1].offered, units[-1].lost
        return [TakenFrame(unit.frame, unit.took, unit.number) for unit in units]

    def counts(self) -> dict[str, int]:
        offered, lost = self._first or (0, 0)
        skipped = self._last[0] - offered - self._sent
        return {"sent": self._sent, "skipped": skipped, "lost": self._last[1] - lost}

    def close(self) -> None:
        super().close()
        leave, self.leave = self.leave, None
        if leave is not None:
            leave(self.video)
