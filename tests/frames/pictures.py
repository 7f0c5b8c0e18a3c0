"""Frames with a stamp, video files, and servers of streams, for the tests of codecs and video."""

from __future__ import annotations

import asyncio
import contextlib
import io
import struct
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam._extras import load
from smartcam.frames import Frame, Moment, find_format
from tests.frames.inside import PIXEL_FORMATS, stripes, write_stamp

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = ["stripes", "write_stamp"]

RAW_FORMATS = [one.name for one in PIXEL_FORMATS if not one.compressed]
"""Names of the formats without compression."""

WIDTH, HEIGHT = 320, 64


def stamped(number: int, width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint8]:
    """Return a picture that moves with its number, which is stamped into it."""
    picture = np.roll(stripes(width, height), number, axis=1)
    write_stamp(picture, number, number * 1000)
    return picture


def frame_of(pixels: NDArray[Any], name: str, number: int = 1) -> Frame:
    """Return a frame of pixels that lie as the format has them, (H, W) or (H, W, C)."""
    height, width = pixels.shape[:2]
    return Frame(
        data=pixels.tobytes(),
        format=find_format(name),
        width=width,
        height=height,
        stride=pixels.nbytes // height,
        captured=number + 0.25,
        utc=number + 0.5,
        moment=Moment.FRAME_END,
        duration=0.125,
        device_time=number + 0.75,
        sequence=number,
        lost=2,
        source="drawn",
    )


def fill(planes: tuple[NDArray[np.uint8], ...], values: tuple[Any, ...]) -> None:
    """Give the planes of a frame under way their values."""
    for plane, value in zip(planes, values, strict=True):
        plane.flags.writeable = True
        plane[...] = value


def known_of(frame: Frame) -> tuple[object, ...]:
    """Return what must stay when a picture is encoded."""
    return (
        frame.width,
        frame.height,
        frame.captured,
        frame.utc,
        frame.moment,
        frame.duration,
        frame.device_time,
        frame.sequence,
        frame.lost,
        frame.source,
    )


def jpeg(number: int, width: int = WIDTH, height: int = HEIGHT) -> bytes:
    """Return a stamped picture as a grey JPEG."""
    data: bytes = load("simplejpeg").encode_jpeg(
        stamped(number, width, height)[..., None], 90, "GRAY", "Gray"
    )
    return data


def write_video(path: Path, codec: str, pixels: str, count: int = 10, rate: int = 20) -> str:
    """Write a video of stamped pictures; return its path."""
    av = load("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, pixels
        stream.bit_rate = 4_000_000
        for number in range(count):
            drawn = av.VideoFrame.from_ndarray(stamped(number), "gray")
            container.mux(stream.encode(drawn.reformat(format=pixels)))
        container.mux(stream.encode())
    return str(path)


@asynccontextmanager
async def served(serve: Callable[[Any, Any], Awaitable[None]]) -> AsyncIterator[int]:
    """Run a server that serves each client so; give its port."""
    at_work: set[asyncio.Task[None]] = set()

    async def client(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        at_work.add(task)
        with contextlib.suppress(
            ConnectionError, asyncio.IncompleteReadError, asyncio.CancelledError
        ):
            await serve(reader, writer)
        writer.transport.abort()
        at_work.discard(task)

    server = await asyncio.start_server(client, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
        for task in list(at_work):
            task.cancel()
        if at_work:
            await asyncio.wait(list(at_work))


MULTIPART = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=next\r\n\r\n"


def part(data: bytes) -> bytes:
    """Return a picture as a part of an MJPEG stream over HTTP."""
    head = b"--next\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(data)
    return head + data + b"\r\n"


def length(data: bytes, more: int = 0) -> bytes:
    """Return the head of a part, with a length that may be wrong."""
    return b"Content-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % (len(data) + more)


PARTS: dict[str, Callable[[bytes], bytes]] = {
    "as it should be": lambda one: b"--b\r\n" + length(one) + one + b"\r\n",
    "the boundary behind it": lambda one: length(one) + one + b"\r\n--b\r\n",
    "no length": lambda one: b"--b\r\nContent-Type: image/jpeg\r\n\r\n" + one + b"\r\n",
    "no head": lambda one: b"--b\r\n\r\n" + one,
    "nothing between": lambda one: one,
    "lines end with LF": lambda one: b"--b\n" + length(one).replace(b"\r", b"") + one + b"\n",
    "a length that is too small": lambda one: b"--b\r\n" + length(one, -9) + one + b"\r\n",
    "a length that is too large": lambda one: b"--b\r\n" + length(one, 99) + one + b"\r\n",
    "a length of 0": lambda one: b"--b\r\nContent-Length: 0\r\n\r\n" + one + b"\r\n",
    "zeros behind it": lambda one: b"--b\r\n" + length(one, 20) + one + bytes(20) + b"\r\n",
    "another boundary": lambda one: b"----other\r\n" + length(one) + one + b"\r\n",
    "a part of text between": lambda one: (
        b"--b\r\nContent-Type: text/plain\r\n\r\nmotion: 1\r\n--b\r\n" + length(one) + one
    ),
    "many headers": lambda one: b"--b\r\n" + b"X-More: 1\r\n" * 90 + length(one) + one + b"\r\n",
}
"""Pictures as cameras send them, by their oddity."""


def rtp_packets(data: bytes, sequence: int, stamp: int) -> list[bytes]:
    """Return an encoded frame as RTP packets of H.264 (RFC 6184), each unit in fragments."""
    units = [unit for unit in data.replace(b"\0\0\0\1", b"\0\0\1").split(b"\0\0\1") if unit]
    pieces: list[bytes] = []
    for unit in units:
        if len(unit) <= 1200:
            pieces.append(unit)
            continue
        chunks = [unit[1:][at : at + 1200] for at in range(0, len(unit) - 1, 1200)]
        for place, chunk in enumerate(chunks):
            ends = (place == 0) << 7 | (place == len(chunks) - 1) << 6
            pieces.append(bytes((unit[0] & 0xE0 | 28, ends | unit[0] & 0x1F)) + chunk)
    return [
        struct.pack(
            "!BBHII", 0x80, 96 | (place == len(pieces) - 1) << 7, sequence + place, stamp, 7
        )
        + piece
        for place, piece in enumerate(pieces)
    ]


async def rtsp_answers(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, seen: list[str]
) -> None:
    """Answer as a camera does until it is to play: RTSP, interleaved over TCP."""
    description = (
        "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=camera\r\nt=0 0\r\nm=video 0 RTP/AVP 96\r\n"
        "a=rtpmap:96 H264/90000\r\na=fmtp:96 packetization-mode=1\r\na=control:track1\r\n"
    )
    while True:
        request = (await reader.readuntil(b"\r\n\r\n")).decode()
        seen.append(request)
        method = request.split()[0]
        number = next(
            line for line in io.StringIO(request) if line.lower().startswith("cseq")
        ).strip()
        answer = {
            "OPTIONS": "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n\r\n",
            "DESCRIBE": "Content-Type: application/sdp\r\n"
            f"Content-Length: {len(description)}\r\n\r\n{description}",
            "SETUP": "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1\r\n\r\n",
            "PLAY": "Session: 1\r\n\r\n",
        }.get(method, "\r\n")
        writer.write(f"RTSP/1.0 200 OK\r\n{number}\r\n{answer}".encode())
        if method == "PLAY":
            return
