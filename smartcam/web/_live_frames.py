"""Serve the newest frames of the camera that a live page shows, if this camera has frames."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any, Final, Protocol, runtime_checkable

from smartcam.web._pictures import SitePictures

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.frames import FrameSource

_log = logging.getLogger("smartcam.web")

JPEG_QUALITY: Final = 80
"""Quality, 1 to 100, of the JPEGs that the agent makes: low, to save traffic on the bus."""

CHECK_INTERVAL: Final = 0.1
"""Seconds between two checks of which camera the page shows, and whether it has frames."""


@runtime_checkable
class HasFrames(Protocol):
    """A camera that may have frames, such as a camera of a fleet."""

    @property
    def has_frames(self) -> bool:
        """True if the camera has frames."""
        ...

    def frame_source(self, encoding: Any, quality: int | None) -> FrameSource:
        """Return the source of the camera's frames, unopened."""
        ...


class LiveFrames:
    """Gives viewers the frames of the camera that the page shows.

    A camera without frames is not asked for any. A camera with frames streams while it has viewers.

    Args:
        camera: function that returns the camera that the page shows now.

    Attributes:
        pictures: pictures of the shown camera; None if it has no frames.
    """

    def __init__(self, camera: Callable[[], object]) -> None:
        self.pictures: SitePictures | None = None
        self._camera = camera
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Start to follow the page's camera."""
        self._task = asyncio.create_task(self._follow(), name="smartcam.live.frames")

    async def stop(self) -> None:
        """Stop following the camera; do nothing if stopped."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait([task])

    async def _follow(self) -> None:
        while True:
            camera: object = self._camera()
            if isinstance(camera, HasFrames) and camera.has_frames:
                await self._serve_frames_of(camera)
            await asyncio.sleep(CHECK_INTERVAL)

    async def _serve_frames_of(self, camera: HasFrames) -> None:
        """Serve a camera's frames until the page shows another camera."""
        pictures = SitePictures([camera.frame_source("jpeg", JPEG_QUALITY)], JPEG_QUALITY)
        pictures.start()
        open_task = asyncio.create_task(pictures.keep_open(0), name="smartcam.live.source")
        self.pictures = pictures
        try:
            while (  # noqa: ASYNC110 - there is no event for it
                self._camera() is camera and camera.has_frames and not open_task.done()
            ):
                await asyncio.sleep(CHECK_INTERVAL)
        finally:
            self.pictures = None
            open_task.cancel()
            await asyncio.wait([open_task])
            await pictures.stop()
            if not open_task.cancelled():
                _log.error("! the live page's frames end", exc_info=open_task.exception())
