"""Record every picture of a source."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Protocol

from smartcam._arguments import check_callable, check_integer, check_kind, check_text
from smartcam.exceptions import SmartCamError
from smartcam.frames import FrameSource
from smartcam.frames._inside import FrameTap
from smartcam.recording._mcap.form import MAX_NAME_CHARACTERS

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.exceptions import RecordingError
    from smartcam.frames import Frame
    from smartcam.frames._inside import ReaderStatistics


class PictureRecorder(Protocol):
    """A recorder of pictures: a file, a video, or a folder of files."""

    @property
    def has_room(self) -> bool:
        """True if a picture would not wait long for the disk."""
        ...

    def add_picture(self, frame: Frame, *, camera: str = "") -> bool:
        """Add a picture; return False if it is left out, and counted."""
        ...

    async def wait_failed(self) -> RecordingError:
        """Wait until the recording fails and return the error."""
        ...


async def record_frames(
    source: FrameSource,
    recorder: PictureRecorder,
    camera: str,
    count: int | None,
    on_start: Callable[[], None],
) -> ReaderStatistics:
    """Record every picture of a source, like :meth:`Recorder.record`."""
    check_kind(source, FrameSource, "source", "a FrameSource", "recording")
    if count is not None:
        count = check_integer(count, "count", 1, 1 << 62, "recording")
    check_callable(on_start, "on_start", "recording")
    camera = check_text(camera, "camera", "recording", most=MAX_NAME_CHARACTERS)
    _ = source.format  # raises if the source is not open
    recorded = 0
    refusals: list[SmartCamError] = []

    def on_frame(frame: Frame) -> bool:
        nonlocal recorded
        try:
            if recorded == count or not recorder.add_picture(frame, camera=camera):
                return False
        except SmartCamError as exc:  # must not reach the driver, which calls this
            refusals.append(exc)
            tap.close()
            return False
        recorded += 1
        if recorded == 1:
            on_start()
        if recorded == count:
            tap.close()
        return True

    tap = FrameTap(source, on_frame, lambda: not recorder.has_room)
    ended = asyncio.ensure_future(tap.pass_until_end())
    failed = asyncio.ensure_future(recorder.wait_failed())
    try:
        await asyncio.wait({ended, failed}, return_when=asyncio.FIRST_COMPLETED)
        if failed.done():
            raise failed.result()
        await ended
        if refusals:
            raise refusals[0]
    finally:
        tap.close()
        ended.cancel()
        failed.cancel()
        await asyncio.wait({ended, failed})
    return tap.statistics()
