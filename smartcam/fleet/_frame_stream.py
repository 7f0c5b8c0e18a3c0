"""The streams of frames that programs have at an agent: what each is given next."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from smartcam.fleet._frame_pace import FramePace

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.fleet._frame_video import SharedVideo
    from smartcam.fleet._frame_wire import FrameForm
    from smartcam.frames import Frame, FrameReader

IDLE = 3.0
"""Seconds without a request after which a stream has ended."""

HOLD = 1.0
"""Seconds that a request waits for a frame at most; then it is answered that there is none."""


class FrameOrder(NamedTuple):
    """Who wants a frame, and how.

    Attributes:
        program: its name.
        call: number of its call.
        encoding: how it is to come.
        timeout: seconds.
        rest: seconds from one frame of a stream to the next at least.
        have: of H.264, number of the last encoded frame that is there; 0: none is.
    """

    program: str
    call: int
    encoding: FrameForm
    timeout: float
    rest: float = 0.0
    have: int = 0


class TakenFrame(NamedTuple):
    """A frame for a program.

    Attributes:
        frame: as it is to come.
        took: seconds to encode it.
        number: of H.264, its place in the stream.
    """

    frame: Frame
    took: float
    number: int = 0


@dataclass(eq=False)
class FrameStream(ABC):
    """A stream of a program.

    Attributes:
        number: its own.
        busy: whether something is asked for.
    """

    number: int
    idle: asyncio.TimerHandle | None = field(default=None, kw_only=True)
    busy: bool = field(default=False, kw_only=True)

    def rest(self, close: Callable[[], None]) -> None:
        """Nothing is asked for now: ``close`` is called if that stays so."""
        self.busy = False
        self.idle = asyncio.get_running_loop().call_later(IDLE, close)

    def wake(self) -> None:
        """Something is asked for."""
        self.busy = True
        if self.idle is not None:
            self.idle.cancel()
            self.idle = None

    @abstractmethod
    async def take(self, order: FrameOrder) -> list[TakenFrame]:
        """Return what goes next: one frame, or several of H.264.

        Raises:
            TimeoutError: there is none for now.
            StopAsyncIteration: it has ended.
            SmartCamError: why it has ended.
        """

    @abstractmethod
    def counts(self) -> dict[str, int]:
        """Return what was sent, skipped and lost until now; it is said with what goes now."""

    def close(self) -> None:
        """End it. Idempotent."""
        self.wake()


@dataclass(eq=False)
class PictureStream(FrameStream):
    """A stream of frames that are each for themselves: the newest one.

    Args:
        reader: of the source.
        encode: makes a frame small, and returns how long that took.
    """

    reader: FrameReader
    encode: Callable[[Frame, FrameForm], Awaitable[tuple[Frame, float]]]
    pace: FramePace = field(default_factory=FramePace)

    async def take(self, order: FrameOrder) -> list[TakenFrame]:
        loop, reader = asyncio.get_running_loop(), self.reader
        since, until = self.pace.asked(loop.time(), reader.came, order.rest)
        async with asyncio.timeout(min(order.timeout, HOLD)):
            await reader.fresh(since, until)
            frame = await anext(reader)
        self.pace.took(reader.came, reader.statistics().offered)
        async with asyncio.timeout(order.timeout):
            taken = TakenFrame(*await self.encode(frame, order.encoding))
        self.pace.gave(loop.time())
        return [taken]

    def counts(self) -> dict[str, int]:
        account = self.reader.statistics()
        return {"sent": account.delivered, "skipped": account.skipped, "lost": account.lost}

    def close(self) -> None:
        super().close()
        self.reader.close()


@dataclass(eq=False)
class VideoStream(FrameStream):
    """A stream of H.264: all encoded frames since those that are there.

    Args:
        video: the encoder's, which others look at, too.
        leave: called at the end.
    """

    video: SharedVideo
    leave: Callable[[SharedVideo], None] | None
    _highest: int = 0
    _sent: int = 0
    _first: tuple[int, int] | None = None  # offered and lost before the first one
    _last: tuple[int, int] = (0, 0)

    async def take(self, order: FrameOrder) -> list[TakenFrame]:
        async with asyncio.timeout(min(order.timeout, HOLD)):
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
