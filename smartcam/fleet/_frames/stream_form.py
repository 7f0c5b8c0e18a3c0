"""A program's request for a stream: the encoding, and the control of bit rate or latency."""

from __future__ import annotations

from typing import NamedTuple

from smartcam.exceptions import ConfigurationError
from smartcam.fleet._frames.encoding import FORMATS
from smartcam.fleet._frames.wire import VIDEO, FrameForm
from smartcam.frames import RateControl, find_format


class StreamForm(NamedTuple):
    """A program's request for a stream.

    Attributes:
        form: form in which frames come.
        rate: control of the stream's bit rate or latency; None for no control.
        decode: whether H.264 becomes pictures again.
    """

    form: FrameForm = FrameForm()
    rate: RateControl | None = None
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
    ) -> StreamForm:
        """Return a checked request of ``caller``, with arguments of :meth:`smartcam.Camera.frames`.

        Raises:
            ConfigurationError: the arguments do not fit together, or one is out of range.
        """
        if bitrate is None and latency is None:
            return cls(FrameForm.checked(encoding, quality, caller, stream=True), None, decode)
        if encoding == VIDEO and latency is None and bitrate is not None:
            form = FrameForm.checked(VIDEO, quality, caller, bitrate=round(bitrate), stream=True)
            return cls(form, None, decode)
        if encoding != "jpeg":
            option = "latency" if bitrate is None or encoding == VIDEO else "bitrate"
            raise ConfigurationError(
                f"{caller}: {option}: {encoding!r:.40} cannot hold one; jpeg can"
                + (f", and {VIDEO}" if option == "bitrate" else "")
            )
        if quality is not None:
            raise ConfigurationError(
                f"{caller}: quality: expected none beside a bit rate or a latency, which set it, "
                f"got {quality!r:.40}"
            )
        return cls(FrameForm("jpeg"), RateControl(bitrate, latency), decode)

    def pixels(self, given: str) -> str:
        """Return the format of received frames from the camera's format."""
        if self.form.name != VIDEO or not self.decode:
            return FORMATS.get(self.form.name, given)
        from smartcam.frames._inside import colour_properties, format_of

        if given in _ENCODED_AS_LIMITED:
            return "I420"
        return format_of("yuv420p", *colour_properties(find_format(given))).name


_ENCODED_AS_LIMITED = {"MJPEG", "RGB8", "BGR8"}
