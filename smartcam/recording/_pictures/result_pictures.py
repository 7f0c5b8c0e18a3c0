"""Record the pictures of a camera's results, which come from a source of frames."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Final

from smartcam.frames._inside import FrameTap
from smartcam.observers import Observer
from smartcam.recording._mcap.form import RecordedPicture, captured_at
from smartcam.recording._picture_matching import PictureMatcher

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.frames import Frame, FrameSource
    from smartcam.models import Result
    from smartcam.recording._recorder import Recorder

MAX_MATCHED_BYTES: Final = 1 << 26
"""Largest number of bytes of a camera's last pictures that are kept until their results
come."""

FIRST_PICTURE_TIMEOUT: Final = 2.0
"""Seconds to wait for the first picture before the first trigger is sent."""

LAST_PICTURE_TIMEOUT: Final = 2.0
"""Seconds to wait for the last result's picture at the end of the recording."""


class ResultPictures(Observer):
    """Adds the picture of each result to a recording, if it can be found by its time.

    This observer gets the results of a camera; the camera's pictures come from a source of frames.

    Args:
        recorder: recorder that keeps the pictures.
    """

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._matcher = PictureMatcher(MAX_MATCHED_BYTES)
        self._all_matched = asyncio.Event()
        self._has_pictures = asyncio.Event()

    def on_results(self, results: Sequence[Result]) -> None:
        """Find the pictures of results."""
        self._all_matched.clear()
        self._matcher.results += results
        self._add_matched(results[0].camera)

    async def record(self, source: FrameSource, camera: str) -> None:
        """Record pictures of an open source until it ends.

        Raises:
            FrameSourceError: the source is lost, or hangs.

        Cancellation: safe; earlier pictures are recorded.
        """

        def on_frame(frame: Frame) -> bool:
            self._has_pictures.set()
            self._matcher.add_picture(RecordedPicture(camera, captured_at(frame), frame))
            self._add_matched(camera)
            return True

        tap = FrameTap(source, on_frame, lambda: not self._recorder.has_room)
        try:
            await tap.pass_until_end()
        finally:
            tap.close()

    async def wait_streaming(self) -> None:
        """Wait until the first picture has come, 2 s at most."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(FIRST_PICTURE_TIMEOUT):
                await self._has_pictures.wait()

    async def wait_settled(self) -> None:
        """Wait until the picture of each result has come or cannot come, 2 s at most."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LAST_PICTURE_TIMEOUT):
                await self._all_matched.wait()

    def _add_matched(self, camera: str) -> None:
        for _, picture, _ in self._matcher.take_matched_by_time():
            if picture is not None:
                self._recorder.add_picture(picture, camera=camera)
        if not self._matcher.results:
            self._all_matched.set()
