"""How an agent encodes frames: the one place that knows the codecs."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from smartcam.fleet._frame_wire import FrameForm
    from smartcam.frames import Codecs, Frame

FORMATS = {"jpeg": "MJPEG", "png": "PNG", "jpegxl": "JPEGXL"}
"""Pixel formats of what is encoded."""


class FrameEncoder:
    """Encodes frames of all cameras of an agent, in threads that begin with the first one."""

    def __init__(self) -> None:
        self._codecs: Codecs | None = None

    async def encoded(self, frame: Frame, encoding: FrameForm) -> Frame:
        """Return a frame encoded; one that its camera has encoded so is left as it is.

        Raises:
            FrameFormatError: its pixels are not for this codec, or its bytes are wrong.
            MissingExtraError: the codec is not installed.
        """
        if frame.format.name == FORMATS[encoding.name] and encoding.quality is None:
            return frame
        if self._codecs is None:
            from smartcam.frames import Codecs  # with numpy, which not every agent needs

            self._codecs = Codecs()
            await self._codecs.__aenter__()
        codecs = self._codecs
        if encoding.name == "jpeg":
            if encoding.quality is None:
                return await codecs.jpeg(frame)
            return await codecs.jpeg(frame, quality=encoding.quality)
        return await (codecs.png if encoding.name == "png" else codecs.jpegxl)(frame)

    async def close(self) -> None:
        """End the threads; what they are at is finished. Idempotent."""
        codecs, self._codecs = self._codecs, None
        if codecs is not None:
            await codecs.close()
