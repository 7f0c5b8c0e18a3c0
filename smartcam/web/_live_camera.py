"""What the live page shows of one camera, on whichever site that page is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

from smartcam.web._live_frames import LiveFrames
from smartcam.web._live_view import LiveView
from smartcam.web._streams import Streams

if TYPE_CHECKING:
    from smartcam.camera import Camera


class ShowsCamera(Protocol):
    """What the live page's calls are done to."""

    control: bool  # whether the page may command the camera
    view: LiveView
    frames: LiveFrames
    streams: Streams

    def state(self) -> dict[str, Any]:
        """Return how the camera is, and what the page may do, as JSON."""
        ...


class WatchedCamera:
    """One camera of a site of many, while somebody looks at it.

    Args:
        camera: it; opened and closed by whoever made it.
        control: whether the page may command it.

    Attributes:
        used_at: when a call was made last, on the loop's clock.
    """

    def __init__(self, camera: Camera[Any], *, control: bool) -> None:
        self.control: bool = control
        self.streams: Streams = Streams()
        self.view: LiveView = LiveView(camera, lambda: bool(len(self.streams)))
        self.frames: LiveFrames = LiveFrames(lambda: self.view.camera)
        self.used_at: float = 0.0

    @property
    def watched(self) -> bool:
        """Whether anybody looks."""
        pictures = self.frames.pictures
        return bool(len(self.streams)) or (pictures is not None and bool(pictures.viewers))

    def start(self) -> None:
        """Follow the camera."""
        self.view.start()
        self.frames.start()

    async def stop(self) -> None:
        """Leave the camera alone; whoever looks is told that it ends."""
        self.streams.close()
        await self.frames.stop()
        await self.view.stop()

    def state(self) -> dict[str, Any]:
        """Return how the camera is, and what the page may do, as JSON."""
        return state_of(self)


def state_of(shown: ShowsCamera) -> dict[str, Any]:
    """Return how a camera is, and what the page may do, as JSON."""
    has_frames = shown.frames.pictures is not None
    return {**shown.view.state(), "control": shown.control, "frames": has_frames}
