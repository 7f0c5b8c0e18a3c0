"""Poll the last picture of a smart camera."""

from __future__ import annotations

import asyncio
import math
import time
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, urlencode, urlsplit, urlunsplit

from smartcam.client import SmartCamera
from smartcam.exceptions import FrameFormatError, FrameSourceError, SmartCamError
from smartcam.frames._codecs.bitmap import read_bitmap
from smartcam.frames._driver import FrameDriver, StreamFormat
from smartcam.frames._frame import Frame, Moment
from smartcam.frames._pixels.formats import find_format
from smartcam.settings import CameraSettings

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from smartcam.frames._address import FrameAddress
    from smartcam.frames._driver import FrameSink
    from smartcam.frames._pixels.formats import PixelFormat


OWN_PARAMETERS = ("fps", "name", "timeout")


class InSightDriver(FrameDriver):
    """A source that polls the last picture of a smart camera: ``insight://admin@HOST?fps=2``.

    Further parameters are as in the camera's URL in :func:`smartcam.connect`. The session with
    the camera exists only while there are readers.

    - ``fps``: requests per second; by default 2.
    - ``timeout``: seconds for connecting, and for a picture; by default 10.
    - ``name``: name of the source; by default host and port.

    The camera does not report when a picture was taken, or whether it is new. A picture with the
    same bytes as the last is not returned again, and a source without new pictures counts as stuck:
    use ``stall=None`` if the camera may wait long for a trigger. ``captured`` is the arrival of a
    frame, and ``duration`` the time since the previous request, infinite for the first frame.
    """

    def __init__(self, address: FrameAddress) -> None:
        super().__init__(address)
        parts = urlsplit(address.url)
        given = parse_qsl(parts.query, keep_blank_values=True)
        own_query = urlencode([field for field in given if field[0] in OWN_PARAMETERS])
        query = urlencode([field for field in given if field[0] not in OWN_PARAMETERS])
        own_parameters = address.parameters(OWN_PARAMETERS, own_query)
        self._rate = address.number("fps", own_parameters.get("fps", "2"), 0.001, 100)
        self._timeout = address.number("timeout", own_parameters.get("timeout", "10"), 0.05, 600)
        self._settings = CameraSettings.make(
            urlunsplit(parts._replace(query=query)),
            None,
            {"connect_timeout": self._timeout, "reconnect": None},
        )
        self._name = own_parameters.get("name") or self._settings.name
        self._camera: SmartCamera[Any] | None = None
        self._task: asyncio.Task[None] | None = None
        self._sequence = 0

    @property
    def name(self) -> str:
        """Host and port, or the name in the URL."""
        return self._name

    async def open(self) -> StreamFormat:
        """Read a picture, and disconnect again.

        Raises:
            FrameFormatError: the camera sends no bitmap.
            FrameSourceError: the camera does not answer, refuses the session, or has no picture.
        """
        try:
            await self._connect()
            pixels = self._read_pixels(await self._read_picture())
        finally:
            await self.stop()
        height, width = pixels.shape[:2]
        return StreamFormat(_format(pixels), width, height, (self._rate,))

    async def start(self, sink: FrameSink) -> None:
        """Connect, and start polling pictures.

        Raises:
            FrameSourceError: the camera does not answer, or refuses.
        """
        try:
            await self._connect()
        except BaseException:
            await self.stop()
            raise
        self._task = asyncio.create_task(self._poll(sink), name=f"frames of {self.name}")

    async def stop(self) -> None:
        """Stop polling, and end the session."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait([task])
        camera, self._camera = self._camera, None
        if camera is not None:
            await camera.close()

    async def close(self) -> None:
        """Release everything. Idempotent."""
        await self.stop()

    async def _connect(self) -> None:
        self._camera = SmartCamera(self._settings)
        try:
            await self._camera.open()
        except SmartCamError as exc:
            raise self._source_error(exc) from exc
        if not self._camera.capabilities.read_image:
            raise FrameSourceError(
                f"{self.name}: this camera cannot be asked for a picture", source=self.name
            )

    async def _read_picture(self) -> bytes:
        if self._camera is None:
            raise FrameSourceError(f"{self.name}: stopped", source=self.name)
        try:
            return await self._camera.read_image(timeout=self._timeout)
        except SmartCamError as exc:
            raise self._source_error(exc) from exc

    def _source_error(self, exc: SmartCamError) -> FrameSourceError:
        text = str(exc).removeprefix(f"{self.name}: ")
        return FrameSourceError(f"{self.name}: {text}", source=self.name)

    def _read_pixels(self, data: bytes) -> NDArray[np.uint8]:
        try:
            return read_bitmap(data)
        except FrameFormatError as exc:
            raise FrameFormatError(f"{self.name}: {exc}", source=self.name) from exc

    async def _poll(self, sink: FrameSink) -> None:
        loop = asyncio.get_running_loop()
        due, last_requested_at, last_data = loop.time(), -math.inf, b""
        try:
            while True:
                requested_at = time.monotonic()
                data = await self._read_picture()
                if data != last_data:
                    pixels = await asyncio.to_thread(self._read_pixels, data)
                    sink.frame(self._new_frame(pixels, last_requested_at))
                    last_data = data
                last_requested_at = requested_at
                due = max(due + 1 / self._rate, loop.time())
                await asyncio.sleep(due - loop.time())
        except FrameSourceError as error:
            sink.ended(error)

    def _new_frame(self, pixels: NDArray[np.uint8], last_requested_at: float) -> Frame:
        now = time.monotonic()
        self._sequence += 1
        height, width = pixels.shape[:2]
        return Frame(
            data=pixels.data.toreadonly().cast("B"),
            format=_format(pixels),
            width=width,
            height=height,
            stride=pixels.nbytes // height,
            captured=now,
            utc=time.time(),
            moment=Moment.ARRIVAL,
            duration=now - last_requested_at,
            sequence=self._sequence,
            source=self.name,
        )


def _format(pixels: NDArray[np.uint8]) -> PixelFormat:
    return find_format("Mono8" if pixels.ndim == 2 else "RGB8")
