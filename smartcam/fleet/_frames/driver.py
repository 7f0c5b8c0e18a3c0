"""Define the scheme ``fleet://`` of frame sources: the frames of a camera that an agent shares."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, urlencode, urlsplit, urlunsplit

from smartcam.exceptions import SmartCamError
from smartcam.fleet._frames.caller import as_source_error
from smartcam.fleet._frames.shared_driver import SharedFrameDriver
from smartcam.fleet._frames.stream_form import FleetStreamRequest
from smartcam.fleet._opening import fleet_camera

if TYPE_CHECKING:
    from smartcam.fleet._program.camera import FleetCamera
    from smartcam.frames import FrameAddress, StreamFormat


_NUMBERS = {"quality": (1, 100), "bitrate": (1e4, 1e9), "latency": (1e-3, 60.0)}
"""Smallest and largest value of each parameter of a URL that is a number."""


class FleetFrameDriver(SharedFrameDriver):
    """Frames of a fleet's camera: ``fleet://HOST/CAMERA?encoding=jpeg&quality=15``.

    ``bitrate`` and ``latency`` have the meaning of :meth:`smartcam.Camera.frames`. The other
    parameters are those of :func:`smartcam.connect`: ``fleet``, ``certificates``.
    """

    def __init__(self, address: FrameAddress) -> None:
        url, options = _split_options(address.url)
        numbers = {
            name: address.number(name, options[name], low, high)
            for name, (low, high) in _NUMBERS.items()
            if name in options
        }
        quality = numbers.get("quality")
        request = FleetStreamRequest.checked(
            options.get("encoding", "raw"),
            None if quality is None else int(quality),
            numbers.get("bitrate"),
            numbers.get("latency"),
            f"{address.shown!r}",
        )
        self._url = url
        self._camera = self._make_camera()
        super().__init__(address, self._camera.frame_client, request)

    def _make_camera(self) -> FleetCamera[Any]:
        return fleet_camera(self._url, {}, ())

    async def open(self) -> StreamFormat:
        """Connect to the agent, which opens the device."""
        if self._camera.ended:  # the driver was closed before
            self._camera = self._make_camera()
            self._frame_client = self._camera.frame_client
        try:
            await self._camera.connect_to_agent(
                self._camera.settings.connect_timeout, wait_for_session=False
            )
        except SmartCamError as exc:
            raise as_source_error(self.name, exc) from exc
        return await super().open()

    async def close(self) -> None:
        """Close the connection to the agent."""
        await super().close()
        await self._camera.close()


def _split_options(url: str) -> tuple[str, dict[str, str]]:
    """Return a fleet URL without the options for frames in its query, and these options."""
    parts = urlsplit(url)
    pairs = parse_qsl(parts.query, keep_blank_values=True)
    frame_options = {key: value for key, value in pairs if key in {"encoding", *_NUMBERS}}
    query = urlencode([(key, value) for key, value in pairs if key not in frame_options])
    return urlunsplit(parts._replace(query=query)), frame_options
