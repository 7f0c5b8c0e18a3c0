"""Offer the inspected pictures of a software camera as a source of frames."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
from typing import TYPE_CHECKING, Final

from smartcam.exceptions import FrameSourceError, SmartCamError
from smartcam.frames import FrameAddress, FrameDriver, FrameSource, StreamFormat, find_format

if TYPE_CHECKING:
    from smartcam.frames import Frame, FrameSink
    from smartcam.inspection._camera.frame_inspector import FrameInspector, InspectedPicture

_log: Final = logging.getLogger("smartcam.inspection")


class JudgedDriver(FrameDriver):
    """Deliver inspected pictures; skip all but the newest if drawing them takes too long.

    Args:
        inspector: inspector of the camera's frames.
        drawn: whether to draw the tools' marks, as RGB8; else the pictures are unchanged.
    """

    def __init__(self, inspector: FrameInspector, *, drawn: bool) -> None:
        super().__init__(FrameAddress.parse("judged://"))
        self._inspector, self._drawn = inspector, drawn
        self._newest: asyncio.Queue[InspectedPicture] = asyncio.Queue(1)
        self._task: asyncio.Task[None] | None = None
        self._sink: FrameSink | None = None

    @property
    def name(self) -> str:
        """The camera's name."""
        return self._inspector.name

    async def open(self) -> StreamFormat:
        """Return the format of the source's frames; RGB8 of the same size for drawn pictures.

        Raises:
            FrameSourceError: the source was never open.
        """
        form = self._inspector.format
        if form is None:
            raise FrameSourceError(
                f"{self.name}: no pictures yet: {self._inspector.trouble}", source=self.name
            )
        pixel_format = find_format("RGB8") if self._drawn else form.format
        return StreamFormat(pixel_format, form.width, form.height)

    async def start(self, sink: FrameSink) -> None:
        """Deliver the last inspected picture, then all later ones."""
        self._sink = sink
        self._inspector.viewers.add(self._queue_picture)
        if self._inspector.last_picture is not None:
            self._queue_picture(self._inspector.last_picture)
        self._task = asyncio.create_task(self._deliver(sink), name=f"judged frames of {self.name}")

    async def stop(self) -> None:
        """Stop delivering pictures."""
        self._inspector.viewers.discard(self._queue_picture)
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait({task})

    async def close(self) -> None:
        """Release everything."""
        await self.stop()

    def _queue_picture(self, inspected: InspectedPicture) -> None:
        if self._newest.full():
            self._newest.get_nowait()
            if self._sink is not None:
                self._sink.skipped(1)
        self._newest.put_nowait(inspected)

    async def _deliver(self, sink: FrameSink) -> None:
        try:
            while True:
                inspected = await self._newest.get()
                try:
                    frame = await self._make_frame(inspected)
                except SmartCamError as exc:  # a damaged picture
                    _log.debug("%s ! a picture is not shown: %s", self.name, exc)
                    sink.lost(1)
                else:
                    sink.frame(frame)
        except Exception as exc:  # noqa: BLE001 - else readers wait for ever
            _log.exception("%s ! its pictures are not shown any more", self.name)
            sink.ended(FrameSourceError(f"{self.name}: {exc!r}", source=self.name))

    async def _make_frame(self, inspected: InspectedPicture) -> Frame:
        if self._drawn:
            return await asyncio.to_thread(_draw_marks, inspected)
        return inspected.frame_with_drawings


def judged_source(inspector: FrameInspector, *, drawn: bool) -> FrameSource:
    """Return the unopened source of a camera's inspected pictures."""
    return FrameSource(JudgedDriver(inspector, drawn=drawn), timeout=None, stall=None, linger=2.0)


def _draw_marks(inspected: InspectedPicture) -> Frame:
    """Return the frame with the marks of the tools in its pixels."""
    frame = inspected.frame
    pixels = frame.rgb() if inspected.inspection is None else inspected.inspection.drawn()
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
