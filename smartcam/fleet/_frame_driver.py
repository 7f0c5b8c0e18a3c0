"""The scheme ``fleet://`` of frame sources: the frames of a camera that an agent shares."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, urlencode, urlsplit, urlunsplit

from smartcam.exceptions import SmartCamError
from smartcam.fleet._frame_caller import SharedFrameDriver, as_source_error
from smartcam.fleet._frame_wire import FrameForm
from smartcam.fleet._opening import fleet_camera

if TYPE_CHECKING:
    from smartcam.fleet._camera import FleetCamera
    from smartcam.frames import FrameAddress, StreamFormat


class FleetFrameDriver(SharedFrameDriver):
    """Frames of a fleet's camera: ``fleet://HOST/CAMERA?encoding=jpeg&quality=15``.

    The other parameters are those of :func:`smartcam.connect`: ``fleet``, ``certificates``.
    """

    def __init__(self, address: FrameAddress) -> None:
        url, said = _split(address.url)
        quality = said.get("quality")
        number = None if quality is None else int(address.number("quality", quality, 1, 100))
        encoding = FrameForm.checked(said.get("encoding", "raw"), number, f"{address.shown!r}")
        self._url = url
        self._camera = self._make()
        super().__init__(address, self._camera.frame_caller, encoding)

    def _make(self) -> FleetCamera[Any]:
        return fleet_camera(self._url, {}, ())

    async def open(self) -> StreamFormat:
        """Come to the agent, and have it open the device."""
        if self._camera.ended:  # it was closed before
            self._camera = self._make()
            self._frames = self._camera.frame_caller
        try:
            await self._camera.attend(self._camera.settings.connect_timeout, session=False)
        except SmartCamError as exc:
            raise as_source_error(self.name, exc) from exc
        return await super().open()

    async def close(self) -> None:
        """Leave the agent."""
        await super().close()
        await self._camera.close()


def _split(url: str) -> tuple[str, dict[str, str]]:
    """Return a fleet URL, and what its query says of frames."""
    parts = urlsplit(url)
    said = parse_qsl(parts.query, keep_blank_values=True)
    own = {key: value for key, value in said if key in {"encoding", "quality"}}
    query = urlencode([(key, value) for key, value in said if key not in own])
    return urlunsplit(parts._replace(query=query)), own
