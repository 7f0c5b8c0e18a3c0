"""List the codecs of streams, each with its payload format, size reader and decoder."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Final, NamedTuple

from smartcam.frames._codecs.h264 import H264Decoder
from smartcam.frames._streaming.rtp import h265, jpeg, parameters
from smartcam.frames._streaming.rtp.h264 import H264PayloadFormat
from smartcam.frames._streaming.rtp.h265 import H265AccessUnit, H265PayloadFormat
from smartcam.frames._streaming.rtp.jpeg import JpegPayloadFormat

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.frames._streaming.rtp.assembling import PayloadFormat


class H265Decoder(H264Decoder):
    """Decoder of a stream of H.265; decoding can start at key frames only."""

    CODEC: ClassVar = "hevc"
    NAME: ClassVar = "H265"

    def _random_access_point(self, data: bytes) -> tuple[bool, int | None]:
        types = [H265AccessUnit.unit_type(unit[0]) for unit in H265AccessUnit.leading_units(data)]
        return bool(types) and types[-1] in h265.KEY_SLICES, None


class JpegDecoder(H264Decoder):
    """Decoder of a stream of independent JPEGs."""

    CODEC: ClassVar = "mjpeg"
    NAME: ClassVar = "JPEG"

    def _random_access_point(self, data: bytes) -> tuple[bool, int | None]:
        return True, None


class StreamCodec(NamedTuple):
    """The codec of a stream.

    Attributes:
        name: name of the codec.
        format: name of the encoded frames' format; for H.265, which has none, that of H.264.
        payload_format: class of the RTP payload format.
        size_in: function that returns the size of the pictures from an encoded frame; None if the
            frame lacks parameters.
        decoder: class of the decoder.
    """

    name: str
    format: str
    payload_format: Callable[[], PayloadFormat]
    size_in: Callable[[bytes], tuple[int, int] | None]
    decoder: type[H264Decoder]


H264: Final = StreamCodec("H264", "H264", H264PayloadFormat, parameters.size_in, H264Decoder)
H265: Final = StreamCodec("H265", "H264", H265PayloadFormat, h265.size_in, H265Decoder)
JPEG: Final = StreamCodec("JPEG", "MJPEG", JpegPayloadFormat, jpeg.size_in, JpegDecoder)
