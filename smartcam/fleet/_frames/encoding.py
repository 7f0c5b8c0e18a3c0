"""Encode an agent's frames; no other module of the agent uses the codecs."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from smartcam.fleet._frames.wire import FrameForm
    from smartcam.frames import Codecs, Frame
    from smartcam.frames._inside import H264Encoder

ENCODED_FORMATS = {"jpeg": "MJPEG", "png": "PNG", "jpegxl": "JPEGXL", "h264": "H264"}
"""Name of the pixel format that frames have in each encoding."""


class FrameEncoder:
    """Encodes frames of all cameras of an agent, in threads that start with the first frame."""

    def __init__(self) -> None:
        self._codecs: Codecs | None = None

    async def encode(self, frame: Frame, encoding: FrameForm) -> Frame:
        """Return a frame in an encoding; unchanged if the camera has already encoded it so.

        Raises:
            FrameFormatError: the codec does not support the frame's pixels, or its bytes are wrong.
            MissingExtraError: the codec is not installed.
        """
        if frame.format.name == ENCODED_FORMATS[encoding.name] and encoding.quality is None:
            return frame
        codecs = self._codecs_with_threads()
        if encoding.name == "jpeg":
            if encoding.quality is None:
                return await codecs.jpeg(frame)
            return await codecs.jpeg(frame, quality=encoding.quality)
        return await (codecs.png if encoding.name == "png" else codecs.jpegxl)(frame)

    def h264(self, fps: float | None, bitrate: int | None) -> H264Encoder:
        """Return an encoder of one stream, which works in the same threads.

        Args:
            fps: frames per second; None: unknown.
            bitrate: bits per second; None: constant quality.

        Raises:
            MissingExtraError: the codec is not installed.
        """
        rate = 30.0 if fps is None else min(1000.0, max(0.01, fps))
        return self._codecs_with_threads().h264_encoder(fps=rate, bitrate=bitrate)

    def _codecs_with_threads(self) -> Codecs:
        if self._codecs is None:
            from smartcam.frames import Codecs  # with numpy, which not every agent needs

            self._codecs = Codecs()
            self._codecs.begin()
        return self._codecs

    async def close(self) -> None:
        """End the threads after their running work. Idempotent."""
        codecs, self._codecs = self._codecs, None
        if codecs is not None:
            await codecs.close()
