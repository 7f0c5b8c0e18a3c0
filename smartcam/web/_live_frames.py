"""The newest frame of the live page's camera, if that has frames."""

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
"""Quality, 1 to 100, of the JPEGs that the agent makes; low, to save traffic on the bus."""

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
    """Follows the page's camera, and gives its frames to viewers.

    A camera without frames is not asked for any; a camera with frames streams while it has viewers.

    Args:
        camera: function that returns the camera that the page shows now.

    Attributes:
        pictures: pictures of its frames; None without frames.
    """

    def __init__(self, camera: Callable[[], object]) -> None:
        self.pictures: SitePictures | None = None
        self._camera = camera
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin."""
        self._task = asyncio.create_task(self._follow(), name="smartcam.live.frames")

    async def stop(self) -> None:
        """End. Harmless when called twice."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait([task])

    async def _follow(self) -> None:
        while True:
            camera: object = self._camera()
            if isinstance(camera, HasFrames) and camera.has_frames:
                await self._show(camera)
            await asyncio.sleep(CHECK_INTERVAL)

    async def _show(self, camera: HasFrames) -> None:
        """Keep the camera's frames until the page shows another camera."""
        pictures = SitePictures([camera.frame_source("jpeg", JPEG_QUALITY)], JPEG_QUALITY)
        pictures.start()
        keeping = asyncio.create_task(pictures.keep_open(0), name="smartcam.live.source")
        self.pictures = pictures
        try:
            while (  # noqa: ASYNC110 - nothing tells of it
                self._camera() is camera and camera.has_frames and not keeping.done()
            ):
                await asyncio.sleep(CHECK_INTERVAL)
        finally:
            self.pictures = None
            keeping.cancel()
            await asyncio.wait([keeping])
            await pictures.stop()
            if not keeping.cancelled():
                _log.error("! the live page's frames end", exc_info=keeping.exception())
