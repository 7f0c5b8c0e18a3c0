"""Use a reader of frames, as from ``camera.frames()``, as a source that can be paired."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, ClassVar

from smartcam.exceptions import FrameSourceError, FrameTimeoutError
from smartcam.frames import FrameAddress, FrameDriver, StreamFormat

if TYPE_CHECKING:
    from contextlib import AbstractAsyncContextManager

    from smartcam.frames import FrameReader, FrameSink


class ReaderDriver(FrameDriver):
    """Driver that passes on the frames of a reader; it enters and leaves this reader."""

    sets_captured: ClassVar[bool] = True  # the reader's source sets ``captured``

    def __init__(self, frames: AbstractAsyncContextManager[FrameReader], name: str) -> None:
        super().__init__(FrameAddress.parse("synthetic://"))
        self._frames, self._name = frames, name
        self._reader: FrameReader | None = None
        self._task: asyncio.Task[None] | None = None

    @property
    def name(self) -> str:
        """``left`` or ``right``; after the first frame, the name of its source."""
        return self._name

    async def open(self) -> StreamFormat:
        """Enter the reader, and wait for its first frame.

        Raises:
            FrameTimeoutError: no frame came in time.
            FrameSourceError: the reader's source is not available.
        """
        self._reader = await self._frames.__aenter__()
        first = await self._reader.newest(max_age=math.inf)
        self._name = first.source
        return StreamFormat(first.format, first.width, first.height)

    async def start(self, sink: FrameSink) -> None:
        """Start passing on the reader's frames."""
        if self._reader is None:
            raise FrameSourceError(f"{self._name}: the reader is closed", source=self._name)
        self._task = asyncio.create_task(
            _pass_frames(self._reader, sink), name=f"frames of {self._name} for depth"
        )

    async def stop(self) -> None:
        """Stop passing on frames."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait([task])

    async def close(self) -> None:
        """Leave the reader."""
        await self.stop()
        reader, self._reader = self._reader, None
        if reader is not None:
            await self._frames.__aexit__(None, None, None)


async def _pass_frames(reader: FrameReader, sink: FrameSink) -> None:
    while True:
        try:
            async for frame in reader:
                sink.frame(frame)
        except FrameTimeoutError:
            continue  # the iterator over pairs has a timeout of its own
        except FrameSourceError as error:
            sink.ended(error)
        else:
            sink.ended(None)
        return
