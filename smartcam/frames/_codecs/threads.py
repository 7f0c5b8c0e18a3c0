"""Run codecs in threads, so that the event loop is not blocked while pictures are compressed."""

from __future__ import annotations

import asyncio
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeVar

from smartcam._arguments import check_integer, check_kind, check_text
from smartcam.exceptions import LocalProtocolError
from smartcam.frames._codecs import pictures as _pictures
from smartcam.frames._codecs.h264 import H264Decoder, H264Encoder
from smartcam.frames._frame import Frame

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine
    from typing import Literal, Self


T = TypeVar("T")

MAX_LOOP_TIME: Final = 0.002
"""Longest CPU time of one picture's work, seconds, for which the work runs in the event loop. For a
small picture, the two wake-ups of a thread take longer than the work."""

LONGEST_TIME_DECAY: Final = 0.8
"""Factor by which the remembered longest time shrinks with each picture."""


def _checked(frame: Frame) -> Frame:
    return check_kind(frame, Frame, "frame", "a Frame", "codecs")


class Codecs:
    """Threads that encode and decode pictures.

    ::

        async with smartcam.frames.Codecs(threads=2) as codecs:
            small = await codecs.jpeg(frame, quality=85)

    The result is a frame of the compressed format with all other attributes of the given one: time
    of capture, number, source, lens. A frame is encoded as its camera sent it. A format that the
    codec does not support is refused; :meth:`converted` converts it to a supported format.

    At most one picture per thread is processed at a time; further calls wait in the order in which
    they came. So a loop that reads a source and encodes its frames skips frames when the machine is
    too slow, and never lags.

    Args:
        threads: number of threads, 1 to 64.

    Cancellation: all coroutines are safe. A picture that a thread is working on occupies the thread
    until it is finished, and is then thrown away.

    Raises:
        ConfigurationError: the number of threads is out of range.
    """

    def __init__(self, threads: int = 2) -> None:
        threads = self._threads = check_integer(threads, "threads", 1, 64, "Codecs")
        self._free_threads = asyncio.Semaphore(threads)
        self._pool: ThreadPoolExecutor | None = None
        self._is_closed = False
        self._running: set[asyncio.Future[Any]] = set()

    async def __aenter__(self) -> Self:
        """Create the threads; each starts with its first picture.

        Raises:
            LocalProtocolError: the object was entered before.
        """
        self.begin()
        return self

    def begin(self) -> None:
        """Create the threads; the caller ends them by :meth:`close`.

        Raises:
            LocalProtocolError: the object was entered before.
        """
        if self._pool is not None or self._is_closed:
            raise LocalProtocolError("Codecs: entered before; make new ones")
        self._pool = ThreadPoolExecutor(self._threads, "smartcam codecs")

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Finish the pictures in progress, and end the threads; waiting calls get an error.

        Idempotent.

        Cancellation: the threads end nevertheless, when they have finished their pictures.
        """
        self._is_closed = True
        pool, self._pool = self._pool, None
        if pool is None:
            return
        pool.shutdown(wait=False)
        if self._running:
            await asyncio.wait(self._running)

    async def jpeg(self, frame: Frame, *, quality: int = 85) -> Frame:
        """Return a frame as a JPEG, format ``MJPEG``.

        Grey stays grey. Y, U and V are encoded as they are, only widened to JPEG's full range;
        U and V of BT.709 are converted through RGB. A JPEG is encoded again. Four pixels of a
        coloured frame share U and V (4:2:0); YUV formats keep their own subsampling.

        Args:
            frame: frame with 8 bits per sample: Mono8, RGB8, BGR8, MJPEG, or any YUV.
            quality: JPEG quality, 1 to 100.

        Raises:
            ConfigurationError: the quality is out of range.
            FrameFormatError: the frame has more than 8 bits or a Bayer pattern, or its bytes are
                wrong.
            LocalProtocolError: these codecs are closed.
            MissingExtraError: the extra ``frames`` is not installed.
        """
        quality = check_integer(quality, "quality", 1, 100, "jpeg")
        return await self._run(partial(_pictures.to_jpeg, _checked(frame), quality))

    async def png(self, frame: Frame) -> Frame:
        """Return a frame as a PNG, without loss: grey, RGB, a Bayer pattern or depth unchanged.

        Raises:
            FrameFormatError: the frame is compressed or YUV, or its bytes are wrong.
            LocalProtocolError: these codecs are closed.
            MissingExtraError: the extra ``frames`` is not installed.
        """
        return await self._run(partial(_pictures.to_png, _checked(frame)))

    async def jpegxl(self, frame: Frame) -> Frame:
        """Return a frame as a JPEG XL, without loss; all else is as for :meth:`png`.

        For 16-bit depth it takes about a tenth of PNG's time.
        """
        return await self._run(partial(_pictures.to_jpegxl, _checked(frame)))

    async def decode(self, frame: Frame, format: str = "") -> Frame:
        """Return the pixels of a JPEG, PNG or JPEG XL.

        Args:
            frame: compressed frame; its width and height must be those in the bytes.
            format: format of the returned pixels: ``Mono8`` of a JPEG is its luma, ``Coord3D_C16``
                of a PNG are its 16 bits; "": Mono8, RGB8 or Mono16, as in the picture.

        Raises:
            FrameFormatError: the frame is damaged, cut off, of another size, or has no such pixels.
            LocalProtocolError: these codecs are closed.
            MissingExtraError: the extra ``frames`` is not installed.
        """
        return await self._run(
            partial(_pictures.decode_frame, _checked(frame), check_text(format, "format", "frame"))
        )

    async def converted(
        self, frame: Frame, format: Literal["Mono8", "Mono16", "RGB8"] = "RGB8"
    ) -> Frame:
        """Return a frame in grey or in colours, as :meth:`Frame.grey` and :meth:`Frame.rgb` do.

        Samples of more than 8 bits become Mono8 or RGB8 by their 8 highest significant bits.

        Raises:
            FrameFormatError: the frame has no brightness or colours, or its bytes are wrong.
            LocalProtocolError: these codecs are closed.
            MissingExtraError: the decoder of its format is not installed.
        """
        return await self._run(
            partial(_pictures.convert_frame, _checked(frame), check_text(format, "format", "frame"))
        )

    def h264_encoder(
        self, *, fps: float = 30.0, keyint: int = 30, crf: float = 23.0, bitrate: int | None = None
    ) -> H264Encoder:
        """Return an encoder for one stream of frames.

        Args:
            fps: frames per second, for the bit rate.
            keyint: number of frames, 2 to 600, within which every part of the picture is refreshed.
                All frames have about the same size.
            crf: quality, 0 (best) to 51.
            bitrate: bits per second to keep to, instead of a quality.

        Raises:
            ConfigurationError: a number is out of range.
            MissingExtraError: the extra ``video`` is not installed.
        """
        return H264Encoder(self._run, fps=fps, keyint=keyint, crf=crf, bitrate=bitrate)

    def h264_decoder(self) -> H264Decoder:
        """Return a decoder for one stream.

        Raises:
            MissingExtraError: the extra ``video`` is not installed.
        """
        return H264Decoder(self._run)

    async def _run(self, work: Callable[[], T]) -> T:
        """Run work in a thread as soon as one is free."""
        self._require_pool()
        await self._free_threads.acquire()
        try:
            future = asyncio.get_running_loop().run_in_executor(self._require_pool(), work)
        except BaseException:
            self._free_threads.release()
            raise
        self._running.add(future)
        future.add_done_callback(self._on_work_done)
        return await asyncio.shield(future)

    def _require_pool(self) -> ThreadPoolExecutor:
        if self._pool is None:
            raise LocalProtocolError(
                "Codecs: they are closed"
                if self._is_closed
                else "Codecs: not open: async with them"
            )
        return self._pool

    def _on_work_done(self, future: asyncio.Future[Any]) -> None:
        self._running.discard(future)
        self._free_threads.release()
        if not future.cancelled():
            future.exception()  # mark the error as retrieved: the caller may be cancelled


class StreamRunner:
    """Run the work of one stream in the event loop if its pictures are small, else in a thread.

    The first picture runs in a thread, which measures its time; later pictures run in the thread if
    one takes longer than :data:`MAX_LOOP_TIME`.

    Args:
        codecs: threads for the work, not closed while it is used.
    """

    def __init__(self, codecs: Codecs) -> None:
        self._codecs = codecs
        self._longest_time: float | None = None  # longest CPU time of recent pictures, seconds

    @property
    def runs_in_loop(self) -> bool:
        """True if the next work runs at once, in the event loop."""
        return self._longest_time is not None and self._longest_time <= MAX_LOOP_TIME

    async def __call__(self, work: Callable[[], T]) -> T:
        """Run the work, and return its result."""
        if not self.runs_in_loop:
            return await self._codecs._run(partial(self._run_timed, work))  # noqa: SLF001
        self._codecs._require_pool()  # noqa: SLF001 - closed codecs run nothing
        return self._run_timed(work)

    def _run_timed(self, work: Callable[[], T]) -> T:
        started_at = time.thread_time()
        try:
            return work()
        finally:
            duration = time.thread_time() - started_at
            self._longest_time = max(duration, LONGEST_TIME_DECAY * (self._longest_time or 0.0))


def run_without_waiting(work: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine that never waits, and return its result.

    Raises:
        RuntimeError: the coroutine waits.
    """
    try:
        work.send(None)
    except StopIteration as stop:
        result: T = stop.value
        return result
    work.close()
    raise RuntimeError("the coroutine waits; expected one that does not")
