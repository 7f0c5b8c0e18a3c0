"""Use web cameras as sources of frames: JPEG streams directly, other streams by FFmpeg."""

from __future__ import annotations

import asyncio
import contextlib
import urllib.request
from typing import TYPE_CHECKING, Final

from smartcam._extras import load
from smartcam.exceptions import FrameFormatError, FrameSourceError, MessageError
from smartcam.frames._codecs.jpeg import jpeg_header
from smartcam.frames._driver import StreamFormat
from smartcam.frames._streaming.rtp.assembling import AccessUnit
from smartcam.frames._streaming.rtp.decoding import DecodingPlan, UnitDecoding
from smartcam.frames._streaming.rtp.driver import FirstPicture
from smartcam.frames._streaming.rtp.stream_codecs import JPEG
from smartcam.frames._video.driver import VideoDriver
from smartcam.frames._video.frames import CONVERTIBLE
from smartcam.frames._video.multipart import PictureCutter
from smartcam.frames._video.redirects import failure_reason
from smartcam.frames._video.web_request import WebStream

if TYPE_CHECKING:
    from smartcam.frames._driver import FrameSink


STREAM_STATUSES: Final = (200, 203, 206)
"""Status codes of answers with a stream."""


class WebDriver(VideoDriver):
    """A web camera or a recording on a web server; parameters as in :class:`VideoDriver`.

    A multipart stream of JPEGs is read without FFmpeg, so that each picture is delivered when
    its last byte comes.
    """

    _multipart_stream: _MultipartStream | None = None
    _is_multipart = False
    _size: tuple[int, int] | None = None

    async def open(self) -> StreamFormat:
        """Read one picture, and close the connection again.

        Raises:
            FrameFormatError: the source is no video, or has an unknown pixel format.
            FrameSourceError: the source is not there, refuses, or is silent.
            MissingExtraError: the extra ``video`` is not installed.
        """
        load("av")
        first = FirstPicture()
        try:
            self._is_multipart = await self._start_multipart(first)
            if not self._is_multipart:
                return await super().open()
            if self._fps:
                raise self.address.wrong("fps", "a recording (for fps)", "a live stream")
            frame = await first.outcome
        finally:
            await self.stop()
        self._size = (frame.width, frame.height)
        return StreamFormat(frame.format, *self._size)

    async def start(self, sink: FrameSink) -> None:
        """Connect and read; a recording starts at its beginning.

        Raises:
            FrameSourceError: the source is gone, or does not answer.
        """
        if not self._is_multipart:
            await super().start(sink)
        elif not await self._start_multipart(sink):
            raise FrameFormatError(
                f"{self.name}: expected a multipart stream again, got another answer: reopen it",
                source=self.name,
            )

    async def stop(self) -> None:
        """Stop reading."""
        stream, self._multipart_stream = self._multipart_stream, None
        if stream is not None:
            await stream.stop()
        await super().stop()

    async def _start_multipart(self, sink: FrameSink) -> bool:
        """Start reading a multipart stream; return False for other streams, or with a proxy."""
        if self._allows_other_hosts or _needs_proxy(self.address.scheme, self.address.host):
            return False
        url = self.address.url.partition("#")[0]
        stream = WebStream(self.name, url, self._tls)
        try:
            async with asyncio.timeout(self._timeout):
                await stream.open()
            self._check_answer(stream)
            if stream.answer.is_pictures:
                self._multipart_stream = _MultipartStream(
                    stream, self._decoding_plan(), self._timeout, sink
                )
                await self._multipart_stream.start()
        except FrameSourceError:
            raise
        except TimeoutError:
            raise self._source_error(
                f"expected an answer, got none within {self._timeout:g} s"
            ) from None
        except (OSError, ValueError) as exc:
            raise self._source_error(f"cannot be read: {failure_reason(exc)}") from None
        finally:
            if self._multipart_stream is None:
                stream.close()
        return self._multipart_stream is not None

    def _check_answer(self, stream: WebStream) -> None:
        answer = stream.answer
        if answer.status not in STREAM_STATUSES:
            status = f"{answer.status} {answer.reason}".strip()
            raise self._source_error(f"cannot be read: {status}")
        coding = answer.header("content-encoding").lower()
        if answer.is_pictures and coding not in ("", "identity"):
            raise self._source_error(f"expected no encoding, got Content-Encoding: {coding[:40]}")
        if answer.is_pictures and self._format is not None and self._format.name == "H264":
            raise self._source_error("expected H264, got MJPEG")

    def _decoding_plan(self) -> DecodingPlan:
        wanted = "" if self._format is None else self._format.name
        passes_encoded = wanted == "MJPEG"
        pixel_format = "" if passes_encoded or not wanted else CONVERTIBLE[wanted]
        coding = JPEG._replace(size_in=_size_in)
        return DecodingPlan(
            self.name, coding, self._delay, self._size, b"", pixel_format, passes_encoded
        )

    def _source_error(self, text: str) -> FrameSourceError:
        return FrameSourceError(f"{self.name}: {text}", source=self.name)


class _MultipartStream:
    """The tasks and the connection of a driver while a camera sends parts."""

    def __init__(
        self, stream: WebStream, plan: DecodingPlan, timeout: float, sink: FrameSink
    ) -> None:
        self._stream, self._name, self._timeout = stream, plan.name, timeout
        self._loop = asyncio.get_running_loop()
        self._decoding = UnitDecoding(plan, sink)
        self._tasks: list[asyncio.Task[None]] = []
        self._decoded_at = self._received_at = self._loop.time()

    async def start(self) -> None:
        """Start cutting and decoding pictures."""
        await self._decoding.start(self)
        self._tasks = [
            asyncio.create_task(work, name=f"{label} of {self._name}")
            for work, label in ((self._read(), "parts"), (self._watch_silence(), "silence"))
        ]

    async def stop(self) -> None:
        """Stop; the sink is not called any more."""
        self._stream.close()
        for task in self._tasks:
            task.cancel()
        try:
            if self._tasks:
                await asyncio.wait(self._tasks)
        finally:
            await self._decoding.stop()

    def utc(self, timestamp: int) -> float | None:
        """Return None: parts have no time."""
        return None

    def request_key_frame(self) -> None:
        """Do nothing: every picture is a key frame."""

    def note_decoded(self) -> None:
        """Record that a picture was decoded."""
        self._decoded_at = self._loop.time()

    async def _read(self) -> None:
        cutter, is_first = PictureCutter(), True
        error: FrameSourceError
        try:
            async with contextlib.aclosing(self._stream.pieces()) as pieces:
                async for piece in pieces:
                    self._received_at = self._loop.time()
                    for picture in cutter.feed(piece):
                        damaged, cutter.damaged = cutter.damaged, 0
                        unit = AccessUnit(picture, 0, 0, damaged, self._received_at, is_first)
                        self._decoding.queue_units([unit])
                        is_first = False
            error = FrameSourceError(f"{self._name}: the server ended the stream")
        except MessageError as exc:
            error = FrameFormatError(f"{self._name}: expected JPEGs, got {exc}")
        except OSError as exc:
            error = FrameSourceError(f"{self._name}: cannot be read: {failure_reason(exc)}")
        await self._decoding.finish(error)

    async def _watch_silence(self) -> None:
        while (remaining := self._decoded_at + self._timeout - self._loop.time()) > 0:  # noqa: ASYNC110
            await asyncio.sleep(remaining)
        seconds = f"{self._timeout:g} s"
        if self._loop.time() - self._received_at < self._timeout:
            text = f"expected a picture, got bytes that make no picture for {seconds}"
            self._decoding.report_end(FrameFormatError(f"{self._name}: {text}"))
        else:
            text = f"expected a picture, got no bytes for {seconds}"
            self._decoding.report_end(FrameSourceError(f"{self._name}: {text}"))


def _size_in(picture: bytes) -> tuple[int, int] | None:
    try:
        width, height, _ = jpeg_header(picture, "a part")
    except FrameFormatError:
        return None  # decoding reports the error
    return width, height


def _needs_proxy(scheme: str, host: str) -> bool:
    """Return True if the environment names a proxy for a host; FFmpeg uses the proxy."""
    return bool(urllib.request.getproxies().get(scheme)) and not urllib.request.proxy_bypass(host)
