"""A program's request for a stream: the encoding, and the control of bit rate or latency."""

from __future__ import annotations

from typing import NamedTuple

from smartcam.exceptions import ConfigurationError
from smartcam.fleet._frames.encoding import ENCODED_FORMATS
from smartcam.fleet._frames.wire import VIDEO, FrameForm
from smartcam.frames import RateControl, find_format


class FleetStreamRequest(NamedTuple):
    """A program's request for a stream.

    Attributes:
        form: form of the frames.
        rate_control: control of the stream's bit rate or latency; None for no control.
        decode: whether the program decodes H.264 to pictures.
    """

    form: FrameForm = FrameForm()
    rate_control: RateControl | None = None
    decode: bool = True

    @classmethod
    def checked(
        cls,
        encoding: str,
        quality: int | None,
        bitrate: float | None,
        latency: float | None,
        caller: str,
        *,
        decode: bool = True,
    ) -> FleetStreamRequest:
        """Check arguments of :meth:`smartcam.Camera.frames`, and return the request.

        Raises:
            ConfigurationError: arguments exclude each other, or one is out of range.
        """
        if bitrate is None and latency is None:
            return cls(FrameForm.checked(encoding, quality, caller, stream=True), None, decode)
        if encoding == VIDEO and latency is None and bitrate is not None:
            form = FrameForm.checked(VIDEO, quality, caller, bitrate=round(bitrate), stream=True)
            return cls(form, None, decode)
        if encoding != "jpeg":
            option = "latency" if bitrate is None or encoding == VIDEO else "bitrate"
            raise ConfigurationError(
                f"{caller}: {option}: {encoding!r:.40} cannot keep to one; jpeg can"
                + (f", and {VIDEO}" if option == "bitrate" else "")
            )
        if quality is not None:
            raise ConfigurationError(
                f"{caller}: quality: expected none beside a bit rate or a latency, which set it, "
                f"got {quality!r:.40}"
            )
        return cls(FrameForm("jpeg"), RateControl(bitrate, latency), decode)

    def pixel_format(self, camera_format: str) -> str:
        """Return the name of the received frames' pixel format, for the camera's pixel format."""
        if self.form.name != VIDEO or not self.decode:
            return ENCODED_FORMATS.get(self.form.name, camera_format)
        from smartcam.frames._inside import colour_properties, format_of

        if camera_format in _ENCODED_AS_LIMITED:
            return "I420"
        return format_of("yuv420p", *colour_properties(find_format(camera_format))).name


_ENCODED_AS_LIMITED = {"MJPEG", "RGB8", "BGR8"}
"""Pixel formats that become H.264 of limited range."""
