"""Record of a shared camera the pictures that its results were made of."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Final

from smartcam.frames._inside import FrameTap
from smartcam.observers import Observer
from smartcam.recording._judged import PictureMatcher
from smartcam.recording._mcap.form import RecordedPicture, captured_at

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.frames import Frame, FrameSource
    from smartcam.models import Result
    from smartcam.recording._recorder import Recorder

MAX_MATCHED_BYTES: Final = 1 << 26
"""Largest number of bytes of a camera's last pictures that are kept until the result that was made
of one comes."""

FIRST_PICTURE_TIMEOUT: Final = 2.0
"""Seconds until the first picture is there, at most, before the first trigger is sent."""

LAST_PICTURE_TIMEOUT: Final = 2.0
"""Seconds that the picture of a result may come behind it, at most, where the recording ends."""


class JudgedPictures(Observer):
    """Puts the picture of each result into a recording, where the times say which one it is.

    It observes the camera whose results are recorded; its pictures come from elsewhere.

    Args:
        recorder: recorder that keeps the pictures.
    """

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._matcher = PictureMatcher(MAX_MATCHED_BYTES)
        self._settled = asyncio.Event()
        self._streams = asyncio.Event()

    def on_results(self, results: Sequence[Result]) -> None:
        """Look for the pictures of results."""
        self._settled.clear()
        self._matcher.results += results
        self._settle(results[0].camera)

    async def record(self, source: FrameSource, camera: str) -> None:
        """Record pictures of an open source until it ends.

        Raises:
            FrameSourceError: the source is gone, or stuck.

        Cancellation: safe; everything until then is recorded.
        """

        def take(frame: Frame) -> bool:
            self._streams.set()
            self._matcher.add_picture(RecordedPicture(camera, captured_at(frame), frame))
            self._settle(camera)
            return True

        tap = FrameTap(source, take, lambda: not self._recorder.has_room)
        try:
            await tap.ended()
        finally:
            tap.close()

    async def wait_streaming(self) -> None:
        """Wait until a picture has come, before which no result can have one; 2 s at most."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(FIRST_PICTURE_TIMEOUT):
                await self._streams.wait()

    async def wait_settled(self) -> None:
        """Wait until each result so far has its picture, or can have none; 2 s at most."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LAST_PICTURE_TIMEOUT):
                await self._settled.wait()

    def _settle(self, camera: str) -> None:
        for _, picture, _ in self._matcher.settled_by_time():
            if picture is not None:
                self._recorder.add_picture(picture, camera=camera)
        if not self._matcher.results:
            self._settled.set()
