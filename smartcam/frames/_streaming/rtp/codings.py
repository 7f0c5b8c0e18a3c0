"""Define the codecs of streams: payloads, parameters and decoders."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Final, NamedTuple

from smartcam.frames._codecs.h264 import H264Decoder
from smartcam.frames._streaming.rtp import h265, jpeg, parameters
from smartcam.frames._streaming.rtp.h264 import H264Units
from smartcam.frames._streaming.rtp.h265 import H265Unit, H265Units
from smartcam.frames._streaming.rtp.jpeg import JpegUnits

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.frames._streaming.rtp.assembling import UnitKind


class H265Decoder(H264Decoder):
    """Decoder of a stream of H.265, which begins at key frames only."""

    CODEC: ClassVar = "hevc"
    NAME: ClassVar = "H265"

    def _entry_point(self, data: bytes) -> tuple[bool, int | None]:
        kinds = [H265Unit.kind_of(unit[0]) for unit in H265Unit.leading(data)]
        return bool(kinds) and kinds[-1] in h265.KEYS, None


class JpegDecoder(H264Decoder):
    """Decoder of a stream of independent JPEGs."""

    CODEC: ClassVar = "mjpeg"
    NAME: ClassVar = "JPEG"

    def _entry_point(self, data: bytes) -> tuple[bool, int | None]:
        return True, None


class Coding(NamedTuple):
    """The codec of a stream.

    Attributes:
        name: name of the codec.
        format: name of the encoded frames' format.
        kind: function that returns an object that assembles the payloads.
        size_in: function that returns the size of the pictures from an encoded frame; None if it
            lacks parameters.
        decoder: function that returns a decoder for a stream.
    """

    name: str
    format: str
    kind: Callable[[], UnitKind]
    size_in: Callable[[bytes], tuple[int, int] | None]
    decoder: type[H264Decoder]


H264: Final = Coding("H264", "H264", H264Units, parameters.size_in, H264Decoder)
H265: Final = Coding("H265", "H264", H265Units, h265.size_in, H265Decoder)
JPEG: Final = Coding("JPEG", "MJPEG", JpegUnits, jpeg.size_in, JpegDecoder)
