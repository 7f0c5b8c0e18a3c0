"""Web cameras send JPEGs in parts, and each picture comes at once."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from smartcam import frames
from smartcam.exceptions import (
    ConfigurationError,
    FrameFormatError,
    FrameSourceError,
)
from smartcam.frames._inside import read_stamp
from tests.frames.pictures import PARTS, jpeg, served

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

pytestmark = pytest.mark.usefixtures("no_leaks")

PICTURES = [jpeg(number) for number in range(8)]

HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: %s\r\n%s\r\n"


class Pace:
    """The times of a camera's pictures: each 0.2 s of the loop, or up to an allowed number."""

    def __init__(self) -> None:
        self.most: int | None = None
        self.sent = 0
        self._changed = asyncio.Condition()

    async def next(self, number: int) -> None:
        """Return as soon as the picture after ``number`` may be sent."""
        self.sent = max(self.sent, number)
        if self.most is None:
            await asyncio.sleep(0.2)
        async with self._changed:
            await self._changed.wait_for(lambda: self.most is None or self.most > number)

    async def up_to(self, number: int) -> None:
        """Allow all connections to send pictures up to a number."""
        self.most = number
        async with self._changed:
            self._changed.notify_all()


@asynccontextmanager
async def camera(
    head: bytes,
    wrap: Callable[[bytes], bytes] = PARTS["as it should be"],
    pace: Pace | None = None,
) -> AsyncIterator[str]:
    """Give the URL of a camera that sends pictures at a pace."""
    pace = pace or Pace()
    chunked = b"chunked" in head

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(head)
        for number in range(10_000):
            data = wrap(PICTURES[number % 8])
            if chunked:
                half = len(data) // 2
                parts = (data[:half], data[half:])
                data = b"".join(b"%x;a=b\r\n%s\r\n" % (len(part), part) for part in parts)
            writer.write(data)
            await pace.next(number)

    async with served(serve) as port:
        yield f"http://127.0.0.1:{port}/video"


@pytest.mark.parametrize(
    ("kind", "more"),
    [
        (b"multipart/x-mixed-replace; boundary=b", b""),
        (b"multipart/x-mixed-replace;boundary=--b", b"Transfer-Encoding: chunked\r\n"),
        (b'Multipart/x-mixed-replace; boundary="b"', b"Connection: close\r\n"),
        (b"multipart/x-mixed-replace", b""),
        (b"multipart/mixed", b""),
        (b"video/x-motion-jpeg", b""),
        (b"video/x-mjpeg", b"Transfer-Encoding: chunked\r\n"),
    ],
)
async def test_cameras_of_all_kinds_are_read(kind: bytes, more: bytes) -> None:
    async with camera(HEAD % (kind, more)) as url, frames.open(url) as source:
        got = []
        async with source.reader() as reader:
            async for frame in reader:
                got.append(read_stamp(frame.grey()))
                if len(got) == 8:
                    break
            assert reader.statistics().lost == 0
    numbers = [stamp[0] for stamp in got if stamp is not None]
    assert numbers == [(numbers[0] + place) % 8 for place in range(8)]


@pytest.mark.parametrize("way", ["as it should be", "no length", "the boundary behind it"])
@pytest.mark.real_time
async def test_no_picture_waits_for_the_next_one(way: str) -> None:
    pace = Pace()
    head = HEAD % (b"multipart/x-mixed-replace; boundary=b", b"")
    async with (
        asyncio.timeout(60),  # exceeded if a picture comes only with the next one
        camera(head, PARTS[way], pace) as url,
        frames.open(url) as source,
        source.reader() as reader,
    ):
        await anext(reader)
        for number in range(pace.sent + 2, pace.sent + 7):
            await pace.up_to(number)
            shown = None
            while shown != number % 8:
                shown, _ = read_stamp((await anext(reader)).grey()) or (None, None)


async def test_stream_without_parts_is_left_to_ffmpeg() -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(
            b"HTTP/1.1 200 OK\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n"
            % len(PICTURES[3])
        )
        writer.write(PICTURES[3])
        await writer.drain()
        await reader.read()

    async with served(serve) as port, frames.open(f"http://127.0.0.1:{port}/shot") as source:
        stamp = read_stamp((await source.newest(max_age=100)).grey())
        assert stamp is not None
        assert stamp[0] == 3


@pytest.mark.parametrize(
    ("fragment", "error", "message"),
    [
        ("#format=H264", FrameSourceError, "expected H264, got MJPEG"),
        ("#fps=3", ConfigurationError, "expected a recording"),
    ],
)
async def test_unsupported_options_of_a_stream_of_parts_are_errors(
    fragment: str, error: type[Exception], message: str
) -> None:
    head = HEAD % (b"multipart/x-mixed-replace; boundary=b", b"")
    async with camera(head) as url:
        with pytest.raises(error, match=message):
            await frames.open(url + fragment).__aenter__()


async def test_pixels_and_bytes_come_as_requested() -> None:
    head = HEAD % (b"multipart/x-mixed-replace; boundary=b", b"")
    async with camera(head) as url:
        async with frames.open(f"{url}#format=MJPEG") as source:
            frame = await source.newest()
            assert bytes(frame.data) in PICTURES
        async with frames.open(f"{url}#format=RGB8") as source:
            assert (await source.newest()).format.name == "RGB8"


@pytest.mark.parametrize("line", [b"zz\r\n", b"1" * 5000, b"-1\r\n"])
async def test_invalid_chunks_are_errors(line: bytes) -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(HEAD % (b"multipart/mixed", b"Transfer-Encoding: chunked\r\n") + line)
        await reader.read()

    async with served(serve) as port:
        with pytest.raises(FrameFormatError, match="a chunk: expected its size"):
            await frames.open(f"http://127.0.0.1:{port}/").__aenter__()


@pytest.mark.parametrize(
    "before", [b"HTTP/1.1 100 Continue\r\n\r\nHTTP/1.1 200 OK", b"HTTP/1.0 206 Partial Content"]
)
async def test_other_first_lines_are_accepted(before: bytes) -> None:
    head = HEAD % (b"multipart/x-mixed-replace; boundary=b", b"")
    before += head[len(b"HTTP/1.1 200 OK") :]
    async with camera(before) as url, frames.open(url) as source:
        assert read_stamp((await source.newest()).grey()) is not None


async def test_webcams_with_stray_bytes_before_a_marker_are_read() -> None:
    head = HEAD % (b"multipart/x-mixed-replace; boundary=b", b"")

    def wrapped(picture: bytes) -> bytes:
        place = picture.index(b"\xff\xdb")
        return PARTS["as it should be"](picture[:place] + b"\0" + picture[place:])

    async with (
        camera(head, wrapped) as url,
        frames.open(url) as source,
        source.reader() as reader,
    ):
        for _ in range(3):
            assert read_stamp((await anext(reader)).grey()) is not None
        assert reader.statistics().lost == 0


PARTED = HEAD % (b"multipart/x-mixed-replace; boundary=b", b"")
JPEG_PART = b"--b\r\nContent-Type: image/jpeg\r\n"
BAD = {
    "no parts": (PARTED, "expected a picture, got no bytes for 0.5 s"),
    "parts of text": (
        PARTED + b"--b\r\nContent-Type: text/plain\r\nContent-Length: 2\r\n\r\nhi\r\n" * 9,
        "expected a picture, got no bytes for 0.5 s",
    ),
    "JPEGs of nothing": (
        PARTED + (JPEG_PART + b"Content-Length: 4\r\n\r\n\xff\xd8\xff\xd9\r\n") * 9,
        "expected a picture, got no bytes for 0.5 s",
    ),
    "a part without an end": (
        PARTED + JPEG_PART + b"Content-Length: 2000000000\r\n\r\n\xff\xd8",
        "expected a picture, got no bytes for 0.5 s",
    ),
    "a part of less than nothing": (
        PARTED + JPEG_PART + b"Content-Length: -5\r\n\r\n\xff\xd8",
        "expected a picture, got no bytes for 0.5 s",
    ),
    "bytes of nothing": (PARTED + b"x" * 3_000_000, "bytes came that belong to no picture"),
    "packed": (
        HEAD % (b"multipart/x-mixed-replace; boundary=b", b"Content-Encoding: gzip\r\n"),
        "expected no encoding, got Content-Encoding: gzip",
    ),
    "nothing but beginnings": (b"HTTP/1.1 102 Processing\r\n\r\n" * 9, "102 Processing"),
    "not found": (b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n", "404 Not Found"),
    "no HTTP": (b"\xde\xad" * 100_000, "the answer is not readable"),
    "silence": (b"", "expected an answer, got none within 0.5 s"),
}


@pytest.mark.parametrize("name", BAD)
async def test_bad_web_camera_is_reported_in_time(name: str) -> None:
    data, message = BAD[name]

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(data)
        await reader.read()

    async with asyncio.timeout(20), served(serve) as port:
        with pytest.raises(FrameSourceError, match=message):
            await frames.open(f"http://127.0.0.1:{port}/#timeout=0.5").__aenter__()
