"""Read the size of pictures from H.264 parameter sets, and write SDP (RFC 8866)."""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING, Final

from smartcam.exceptions import FrameFormatError
from smartcam.frames._streaming.rtp.h264 import H264AccessUnit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

MAX_PICTURE_PIXELS: Final = 1 << 27
"""Largest plausible number of pixels of a picture."""

CLOCK_RATE: Final = 90_000
"""Ticks per second of the clock of video streams."""

_HIGH_PROFILES: Final = frozenset((44, 83, 86, 100, 110, 118, 122, 128, 134, 135, 138, 139, 244))
"""Profiles whose parameters have a chroma format (ITU-T H.264, 7.3.2.1.1)."""

SUBSAMPLING: Final = {0: (1, 1), 1: (2, 2), 2: (2, 1), 3: (1, 1)}
"""Horizontal and vertical chroma subsampling of each chroma format: the units of cropping."""


class FieldBits:
    """Reader of a unit's bit fields in order."""

    def __init__(self, data: bytes) -> None:
        unescaped = data.replace(b"\0\0\3", b"\0\0")
        self._bits = iter("".join(f"{byte:08b}" for byte in unescaped))

    def read_bits(self, count: int) -> int:
        """Read a field u(n)."""
        return int("".join(next(self._bits) for _ in range(count)) or "0", 2)

    def read_unsigned(self) -> int:
        """Read a field ue(v)."""
        zeros = 0
        while next(self._bits) == "0":
            zeros += 1
        return (1 << zeros) - 1 + (self.read_bits(zeros) if zeros else 0)

    def read_signed(self) -> int:
        """Read a field se(v)."""
        number = self.read_unsigned()
        return (number + 1) // 2 if number % 2 else -(number // 2)


def picture_size(sps: bytes) -> tuple[int, int]:
    """Return the width and the height of the pictures, in pixels.

    Args:
        sps: sequence parameter set from
            :func:`~smartcam.frames._streaming.rtp.h264.parameter_sets`.

    Raises:
        FrameFormatError: the parameters are not valid.
    """
    return checked_size("H264", sps, lambda: _size(FieldBits(sps[1:256])))


def checked_size(codec: str, sps: bytes, read: Callable[[], tuple[int, int]]) -> tuple[int, int]:
    """Return the size that ``read`` reads from parameters, after checking it.

    Raises:
        FrameFormatError: the parameters are not valid.
    """
    try:
        width, height = read()
    except (StopIteration, RuntimeError, KeyError):
        raise _format_error(codec, "whole parameters", sps) from None
    if not (width > 0 and height > 0 and width * height <= MAX_PICTURE_PIXELS):
        raise _format_error(
            codec, f"pictures of up to {MAX_PICTURE_PIXELS} pixels, not {width}x{height}", sps
        )
    return width, height


def _size(bits: FieldBits) -> tuple[int, int]:
    profile = bits.read_bits(8)
    bits.read_bits(16)
    bits.read_unsigned()
    chroma_format = _read_chroma_format(bits) if profile in _HIGH_PROFILES else 1
    bits.read_unsigned()
    order_type = bits.read_unsigned()
    if order_type == 0:
        bits.read_unsigned()
    elif order_type == 1:
        bits.read_bits(1)
        bits.read_signed()
        bits.read_signed()
        for _ in range(bits.read_unsigned()):
            bits.read_signed()
    bits.read_unsigned()
    bits.read_bits(1)
    columns, rows = bits.read_unsigned() + 1, bits.read_unsigned() + 1
    fields = 2 - bits.read_bits(1)
    bits.read_bits(2 if fields == 2 else 1)
    crop = [bits.read_unsigned() for _ in range(4)] if bits.read_bits(1) else [0] * 4
    horizontal, vertical = SUBSAMPLING[chroma_format]
    return (
        16 * columns - horizontal * (crop[0] + crop[1]),
        16 * rows * fields - vertical * fields * (crop[2] + crop[3]),
    )


def _read_chroma_format(bits: FieldBits) -> int:
    """Read the fields of a high profile; return the chroma format, 0 for separate planes."""
    chroma_format = bits.read_unsigned()
    separate = bits.read_bits(1) if chroma_format == 3 else 0
    bits.read_unsigned()
    bits.read_unsigned()
    bits.read_bits(1)
    if bits.read_bits(1):
        for number in range(12 if chroma_format == 3 else 8):
            if bits.read_bits(1):
                _skip_scaling_list(bits, 16 if number < 6 else 64)
    return 0 if separate else chroma_format


def _skip_scaling_list(bits: FieldBits, count: int) -> None:
    last_scale = next_scale = 8
    for _ in range(count):
        if next_scale:
            next_scale = (last_scale + bits.read_signed()) % 256
        last_scale = next_scale or last_scale


def size_in(access_unit: bytes) -> tuple[int, int] | None:
    """Return the size of the pictures; None if the encoded frame has no parameter set.

    Raises:
        FrameFormatError: the parameters are not valid.
    """
    for unit in H264AccessUnit.leading_units(access_unit):
        if unit[0] & 0x1F == 7:
            return picture_size(unit)
    return None


def description(
    host: str,
    port: int,
    payload_type: int,
    *,
    session: int = 0,
    ttl: int | None = None,
    sets: tuple[bytes, bytes] | None = None,
    name: str = "smartcam",
) -> str:
    """Return the SDP description of a stream of H.264.

    Args:
        host: destination address of the stream.
        port: destination port of the stream.
        payload_type: payload type of the packets.
        session: number of the session.
        ttl: time to live of multicast; None: no multicast.
        sets: sequence and picture parameter sets; None: unknown.
        name: name of the session, one line.
    """
    return "".join(
        f"{line}\r\n"
        for line in _lines(host, port, payload_type, session, ttl, sets, " ".join(name.split()))
    )


def _lines(
    host: str,
    port: int,
    payload_type: int,
    session: int,
    ttl: int | None,
    sets: tuple[bytes, bytes] | None,
    name: str,
) -> Iterator[str]:
    address_type = "IP6" if ":" in host else "IP4"
    yield "v=0"
    yield f"o=- {session} 0 IN {address_type} {host}"
    yield f"s={name or '-'}"
    hops = f"/{ttl}" if ttl is not None and address_type == "IP4" else ""
    yield f"c=IN {address_type} {host}{hops}"
    yield "t=0 0"
    yield f"m=video {port} RTP/AVP {payload_type}"
    yield f"a=rtpmap:{payload_type} H264/{CLOCK_RATE}"
    parameters = ["packetization-mode=1"]
    if sets is not None:
        encoded = ",".join(base64.b64encode(parameter_set).decode() for parameter_set in sets)
        parameters += [f"profile-level-id={sets[0][1:4].hex()}", f"sprop-parameter-sets={encoded}"]
    yield f"a=fmtp:{payload_type} {'; '.join(parameters)}"


def _format_error(codec: str, expected: str, data: bytes) -> FrameFormatError:
    return FrameFormatError(
        f"{codec}: expected {expected}, got {len(data)} bytes that begin with {data[:8].hex(' ')}"
    )
