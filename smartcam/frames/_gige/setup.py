"""Apply a URL's settings to a camera, and set its stream channel's registers."""

from __future__ import annotations

import contextlib
import ipaddress
from typing import TYPE_CHECKING, Final, NamedTuple

from smartcam._suggestions import did_you_mean
from smartcam.exceptions import FrameFormatError, FrameSourceError
from smartcam.frames._driver import StreamFormat
from smartcam.frames._gige.gvcp import (
    DO_NOT_FRAGMENT,
    FIRE_TEST_PACKET,
    PACKET_SIZE_MASK,
    Register,
)
from smartcam.frames._gige.gvsp import EXTENDED_HEADER_BYTES, IP_UDP_BYTES, bits_of
from smartcam.frames._gige.triggering import set_trigger
from smartcam.frames._pixels.formats import find_format

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.frames._gige.features import GenicamFeatures
    from smartcam.frames._gige.session import GigESession
    from smartcam.frames._gige.stream import StreamSocket
    from smartcam.frames._pixels.formats import PixelFormat

FEATURE_PREFIX: Final = "feature."
"""Prefix of the URL's parameters that set features."""

PACKET_SIZES: Final = (576, 16384)
"""Least and largest size of the stream's IP packets, bytes; every network carries the least."""

TEST_WAIT: Final = 0.1
"""Seconds for a test packet."""

MAX_FRAME_BYTES: Final = 1 << 30
"""Largest size of a frame, bytes."""

MAX_NUMBER: Final = 1e12
"""Largest plausible number of frames per second, or of microseconds."""

_RATES: Final = ("AcquisitionFrameRate", "AcquisitionFrameRateAbs")
_RATE_SWITCHES: Final = ("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled")
_EXPOSURES: Final = ("ExposureTime", "ExposureTimeAbs")
"""Names of the exposure time, microseconds: in today's SFNC, then in its first versions."""


class WantedStream(NamedTuple):
    """The stream that a URL asks for.

    Attributes:
        parameters: parameters of the URL, in their order.
        size: width and height, pixels; None: the camera's setting.
        rate: frames per second; None: the camera's setting.
        packet_size: bytes of an IP packet; 0: the largest that passes a test.
        resend: whether missing packets are requested.
        trigger: source of the triggers, or ``off``; None: the camera's setting.
    """

    parameters: Mapping[str, str]
    size: tuple[int, int] | None
    rate: float | None
    packet_size: int
    resend: bool
    trigger: str | None = None


class Exposure(NamedTuple):
    """The longest possible duration of a frame, as far as the camera states it.

    Attributes:
        duration: seconds of the longest exposure and of the readout.
        readout: seconds of the readout.
        is_auto: whether the camera chooses the exposure time.
    """

    duration: float
    readout: float
    is_auto: bool


class StreamShape(NamedTuple):
    """The properties of a camera's stream after its setup.

    Attributes:
        format: format of the frames.
        format_code: PFNC's number of the pixel format.
        payload: largest number of bytes of a frame.
        exposure: longest time of a frame.
    """

    format: StreamFormat
    format_code: int
    payload: int
    exposure: Exposure


async def set_up(session: GigESession, wanted: WantedStream) -> StreamShape:
    """Apply a URL's parameters to a camera in their order; return the resulting stream.

    Raises:
        FrameSourceError: the camera has no such feature or value; the text lists the existing ones.
    """
    features = session.features
    with contextlib.suppress(FrameSourceError):  # an error if it does not stream
        await features.execute("AcquisitionStop")
    await set_locked(features, False)
    mode = "AcquisitionMode"
    if mode in features and "Continuous" in await features.entries(mode):
        await features.set(mode, "Continuous")
    for name, value in wanted.parameters.items():
        if name == "format":
            await _set_format(session, value)
        elif name == "size" and wanted.size is not None:
            await _set_size(features, wanted.size)
        elif name == "fps" and wanted.rate is not None:
            await _set_rate(session, wanted.rate)
        elif name.startswith(FEATURE_PREFIX):
            await features.set(name.removeprefix(FEATURE_PREFIX), value)
    if wanted.trigger is not None:
        await set_trigger(features, wanted.trigger)
    return await read_shape(session)


async def set_locked(features: GenicamFeatures, locked: bool) -> None:
    """Lock or unlock the stream's parameters, as some cameras require."""
    if "TLParamsLocked" in features:
        with contextlib.suppress(FrameSourceError):  # some cameras have it read-only
            await features.set("TLParamsLocked", int(locked))


async def _set_format(session: GigESession, name: str) -> None:
    entries = await session.features.entries("PixelFormat")
    for entry, number in entries.items():
        pixel_format = _format_of_code(number)
        names = [entry] if pixel_format is None else [entry, pixel_format.name, pixel_format.fourcc]
        if name.upper() in (spelling.upper() for spelling in names):
            await session.features.set("PixelFormat", entry)
            return
    raise FrameFormatError(
        f"{session.label}: it has no format {name!r}{did_you_mean(name, entries)}; it has "
        f"{', '.join(entries)}",
        source=session.label,
        available=tuple(entries),
    )


async def _set_size(features: GenicamFeatures, size: tuple[int, int]) -> None:
    for name in ("OffsetX", "OffsetY"):  # the width is limited by the offset
        if name in features:
            with contextlib.suppress(FrameSourceError):
                await features.set(name, 0)
    for name, value in zip(("Width", "Height"), size, strict=True):
        try:
            await features.set(name, value)
        except FrameSourceError as exc:
            if isinstance(exc, TimeoutError):
                raise
            raise FrameFormatError(str(exc), source=exc.source, available=exc.available) from exc


async def _set_rate(session: GigESession, rate: float) -> None:
    features = session.features
    for name in _RATE_SWITCHES:
        if name in features:
            with contextlib.suppress(FrameSourceError):
                await features.set(name, "true")
    for name in _RATES:
        if name in features:
            await features.set(name, rate)
            return
    raise FrameSourceError(
        f"{session.label}: it has no frame rate to set; it has {', '.join(features.names())}",
        source=session.label,
        available=tuple(features.names()),
    )


async def read_shape(session: GigESession) -> StreamShape:
    """Return the shape of the stream with the camera's present settings.

    Raises:
        FrameSourceError: the camera does not state it, or has an unknown format.
    """
    features = session.features
    entry = await features.get("PixelFormat")
    entries = await features.entries("PixelFormat")
    number = int(await features.number("PixelFormat") or 0)
    pixels = _format_of_code(number)
    if pixels is None:
        known = tuple(name for name, entry in entries.items() if _format_of_code(entry) is not None)
        raise FrameFormatError(
            f"{session.label}: it is set to {entry}, {number:#010x}, which is unknown; of "
            f"its formats, smartcam knows {', '.join(known) or 'none'}",
            source=session.label,
            available=known,
        )
    width, height = (
        int(await features.number("Width") or 0),
        int(await features.number("Height") or 0),
    )
    min_bytes = (width * height * bits_of(number) + 7) // 8
    payload = int(await features.number("PayloadSize") or min_bytes)
    if not 0 < min_bytes <= payload <= MAX_FRAME_BYTES:
        raise FrameSourceError(
            f"{session.label}: expected a PayloadSize of {min_bytes} to {MAX_FRAME_BYTES} bytes "
            f"for {width}x{height} pixels of {entry}, got {payload}",
            source=session.label,
        )
    rate = await _first_number(features, _RATES)
    form = StreamFormat(pixels, width, height, (rate,) if rate else ())
    return StreamShape(form, number, payload, await read_exposure(features))


async def read_exposure(features: GenicamFeatures) -> Exposure:
    """Return the longest time of a frame with the camera's present settings."""
    rate = await _first_number(features, _RATES)
    exposure = await _first_number(features, _EXPOSURES) or 0.0
    is_auto = False
    if "ExposureAuto" in features:
        with contextlib.suppress(FrameSourceError):
            is_auto = await features.get("ExposureAuto") != "Off"
            for name in (exposure for exposure in _EXPOSURES if is_auto and exposure in features):
                longest = (await features.describe(name)).maximum
                if longest is not None and longest < MAX_NUMBER:
                    exposure = max(exposure, longest)
    readout = 1 / rate if rate else 0.0
    return Exposure(exposure / 1e6 + readout, readout, is_auto)


def _format_of_code(number: int) -> PixelFormat | None:
    """Return the format of PFNC's number; cameras may use older names."""
    with contextlib.suppress(FrameFormatError):
        return find_format(number)
    return None


async def _first_number(features: GenicamFeatures, names: tuple[str, ...]) -> float | None:
    for name in names:
        if (number := await features.number(name)) is not None and 0 < number < MAX_NUMBER:
            return float(number)
    return None


# the stream channel


async def connect_stream(session: GigESession, sock: StreamSocket, packet_size: int) -> int:
    """Direct the camera's stream channel to a socket.

    Args:
        session: the camera.
        sock: socket that receives the packets.
        packet_size: number of bytes of a packet; 0: the largest that passes a test.

    Returns:
        Number of bytes of an IP packet of the stream.

    Raises:
        FrameSourceError: the camera refuses the destination or the packet size.
    """
    control = session.control
    address = int(ipaddress.IPv4Address(control.local_address))
    await control.write_register(Register.STREAM_DESTINATION, address)
    await control.write_register(Register.STREAM_PORT, sock.port)
    if packet_size:
        size = await _set_packet_size(session, packet_size)
    else:
        size = await _largest_tested_size(session, sock)
    if not size > IP_UDP_BYTES + EXTENDED_HEADER_BYTES:
        raise FrameSourceError(
            f"{session.label}: packet_size: expected {PACKET_SIZES[0]} bytes or more, got {size}",
            source=session.label,
        )
    return size


async def _set_packet_size(session: GigESession, packet_size: int) -> int:
    control = session.control
    await control.write_register(Register.STREAM_PACKET_SIZE, packet_size | DO_NOT_FRAGMENT)
    size = await control.read_register(Register.STREAM_PACKET_SIZE) & PACKET_SIZE_MASK
    if size > packet_size:
        raise FrameSourceError(
            f"{session.label}: packet_size: asked for {packet_size} bytes, the camera sends {size}",
            source=session.label,
        )
    return size


async def _largest_tested_size(session: GigESession, sock: StreamSocket) -> int:
    """Return the size of the largest received test packet, or the camera's own size."""
    control = session.control
    configured = await control.read_register(Register.STREAM_PACKET_SIZE) & PACKET_SIZE_MASK
    largest = min(control.path_mtu, 9000)
    for size in sorted({largest, min(largest, 1500), PACKET_SIZES[0]}, reverse=True):
        value = size | DO_NOT_FRAGMENT | FIRE_TEST_PACKET
        # an error means that the camera does not send test packets of this size
        with contextlib.suppress(FrameSourceError):
            await control.write_register(Register.STREAM_PACKET_SIZE, value)
            actual = await control.read_register(Register.STREAM_PACKET_SIZE) & PACKET_SIZE_MASK
            if actual <= size and await sock.receives_test_packet(actual, TEST_WAIT):
                return actual
    return await _set_packet_size(session, min(configured or 1500, largest, 1500))
