"""Define what the live page needs from a site, and a camera of a fleet that such a page shows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

from smartcam.web._live_frames import LiveFrames
from smartcam.web._live_view import LiveView
from smartcam.web._streams import Streams

if TYPE_CHECKING:
    from smartcam.camera import Camera
    from smartcam.web._fleet_rows import FleetRow
    from smartcam.web._units import PageUnits


class ShowsCamera(Protocol):
    """A site with the live page: the camera that the page's calls act on, and its state."""

    control: bool  # whether the page may command the camera
    units: PageUnits  # units that the page can show instead of SI
    view: LiveView
    frames: LiveFrames
    streams: Streams

    def state(self) -> dict[str, Any]:
        """Return the state of the camera and the rights of the page, as values for JSON."""
        ...


class WatchedCamera:
    """One camera of a site with many cameras, followed while viewers watch it.

    Args:
        camera: camera that the caller opens and closes.
        control: whether the page may command the camera.
        units: units that the page can show instead of SI.
        row: row of the camera in the fleet's table; None: the page keeps a history of its own.

    Attributes:
        used_at: time of the last call, on the loop's clock.
    """

    def __init__(
        self,
        camera: Camera[Any],
        *,
        control: bool,
        units: PageUnits,
        row: FleetRow | None = None,
    ) -> None:
        self.control: bool = control
        self.units: PageUnits = units
        self.streams: Streams = Streams()
        history = None if row is None else row.history
        self.view: LiveView = LiveView(camera, lambda: bool(len(self.streams)), history)
        if row is not None:
            self.view.changed_at, self.view.changed_at_exact = row.changed_at, row.changed_at_exact
        self.frames: LiveFrames = LiveFrames(lambda: self.view.camera)
        self.used_at: float = 0.0

    @property
    def is_watched(self) -> bool:
        """True while there are viewers."""
        pictures = self.frames.pictures
        return bool(len(self.streams)) or (pictures is not None and bool(pictures.viewers))

    def start(self) -> None:
        """Follow the camera."""
        self.view.start()
        self.frames.start()

    async def stop(self) -> None:
        """Stop following the camera; viewers get a last event."""
        self.streams.close()
        await self.frames.stop()
        await self.view.stop()

    def state(self) -> dict[str, Any]:
        """Return the state of the camera and the rights of the page, as values for JSON."""
        return state_of(self)


def state_of(live: ShowsCamera) -> dict[str, Any]:
    """Return the state of a shown camera and the rights of its page, as values for JSON."""
    has_frames = live.frames.pictures is not None
    return {
        **live.view.state(),
        "control": live.control,
        "frames": has_frames,
        "units": live.units.as_json(),
    }
