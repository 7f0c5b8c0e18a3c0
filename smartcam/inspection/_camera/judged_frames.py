"""The judged pictures of a software camera, as a source of frames."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
from typing import TYPE_CHECKING, Final

from smartcam.exceptions import FrameSourceError, SmartCamError
from smartcam.frames import FrameAddress, FrameDriver, FrameSource, StreamFormat, find_format

if TYPE_CHECKING:
    from smartcam.frames import Frame, FrameSink
    from smartcam.inspection._camera.eyes import Eyes, Judged

_log: Final = logging.getLogger("smartcam.inspection")


class JudgedDriver(FrameDriver):
    """Gives each picture that was judged, the newest where they come faster than they are drawn.

    Args:
        eyes: the camera's eyes.
        drawn: with the marks of the tools, as RGB8; else as they came.
    """

    def __init__(self, eyes: Eyes, *, drawn: bool) -> None:
        super().__init__(FrameAddress.parse("judged://"))
        self._eyes, self._drawn = eyes, drawn
        self._next: asyncio.Queue[Judged] = asyncio.Queue(1)
        self._task: asyncio.Task[None] | None = None
        self._sink: FrameSink | None = None

    @property
    def name(self) -> str:
        """The camera's name."""
        return self._eyes.name

    async def open(self) -> StreamFormat:
        """Return the format of the source's frames, RGB8 of that size where they are drawn.

        Raises:
            FrameSourceError: the source was not there yet.
        """
        form = self._eyes.format
        if form is None:
            raise FrameSourceError(
                f"{self.name}: no pictures yet: {self._eyes.trouble}", source=self.name
            )
        kind = find_format("RGB8") if self._drawn else form.format
        return StreamFormat(kind, form.width, form.height)

    async def start(self, sink: FrameSink) -> None:
        """Give what is judged from now on, after the last picture that was."""
        self._sink = sink
        self._eyes.viewers.add(self._take)
        if self._eyes.judged is not None:
            self._take(self._eyes.judged)
        self._task = asyncio.create_task(self._give(sink), name=f"judged frames of {self.name}")

    async def stop(self) -> None:
        """Give nothing more."""
        self._eyes.viewers.discard(self._take)
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait({task})

    async def close(self) -> None:
        """Release everything."""
        await self.stop()

    def _take(self, judged: Judged) -> None:
        if self._next.full():
            self._next.get_nowait()
            if self._sink is not None:
                self._sink.skipped(1)
        self._next.put_nowait(judged)

    async def _give(self, sink: FrameSink) -> None:
        try:
            while True:
                judged = await self._next.get()
                try:
                    frame = await self._frame(judged)
                except SmartCamError as exc:  # a damaged picture
                    _log.debug("%s ! a picture is not shown: %s", self.name, exc)
                    sink.lost(1)
                else:
                    sink.frame(frame)
        except Exception as exc:  # noqa: BLE001 - else readers wait for ever
            _log.exception("%s ! its pictures are not shown any more", self.name)
            sink.ended(FrameSourceError(f"{self.name}: {exc!r}", source=self.name))

    async def _frame(self, judged: Judged) -> Frame:
        return await asyncio.to_thread(_drawn, judged) if self._drawn else judged.marked_frame


def judged_source(eyes: Eyes, *, drawn: bool) -> FrameSource:
    """Return a source of the pictures that a camera's eyes judge, unopened."""
    return FrameSource(JudgedDriver(eyes, drawn=drawn), timeout=None, stall=None, linger=2.0)


def _drawn(judged: Judged) -> Frame:
    """Return the frame with the marks of the tools."""
    frame = judged.frame
    pixels = frame.rgb() if judged.inspection is None else judged.inspection.drawn()
    height, width = pixels.shape[:2]
    return dataclasses.replace(
        frame,
        data=pixels.tobytes(),
        format=find_format("RGB8"),
        width=width,
        height=height,
        stride=3 * width,
        lost=0,
    )
