"""Use streams and files that FFmpeg reads, through PyAV, as sources of frames."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import ssl
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final, TypeVar

from smartcam.exceptions import FrameFormatError, FrameSourceError
from smartcam.frames._driver import FrameDriver, StreamFormat
from smartcam.frames._frame import Frame, Moment
from smartcam.frames._pixels.formats import find_format
from smartcam.frames._video.files import (
    PictureFiles,
    PictureReader,
    VideoPlan,
    VideoReader,
    is_pictures,
)
from smartcam.frames._video.frames import CONVERTIBLE

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.frames._address import FrameAddress
    from smartcam.frames._driver import FrameSink
    from smartcam.frames._pixels.formats import PixelFormat
    from smartcam.frames._video.files import TimedPicture


T = TypeVar("T")

_log = logging.getLogger("smartcam.frames")

THREAD_GRACE: Final = 1.0
"""Seconds to wait for a thread beyond its own limits before it is abandoned."""

PICTURE_RATE: Final = 10.0
"""Default number of pictures per second from a folder."""

MAX_PLAYBACK_DELAY: Final = 0.5
"""Largest delay of a recording's playback, seconds, before its clock is reset."""

LIVE_OPTIONS: Final = {"fpsprobesize": "0", "probesize": "32768", "analyzeduration": "500000"}
"""FFmpeg's options for a live stream, which it otherwise analyses and delays by a second."""

_COMMON: Final = ("delay", "elsewhere", "format", "name", "timeout")
_FOR_RECORDINGS: Final = ("fps", "pace")
_PARAMETERS: Final = {
    "file": ("format", "mixed", "name", "timeout", *_FOR_RECORDINGS),
    "http": (*_COMMON, *_FOR_RECORDINGS),
    "https": (*_COMMON, *_FOR_RECORDINGS, "ca", "verify"),
    "rtsp": (*_COMMON, "transport"),
    "rtsps": (*_COMMON, "ca", "transport", "verify"),
}


class VideoDriver(FrameDriver):
    """A camera or file that FFmpeg reads: ``http:``, ``https:``, a path, or ``rtsp:``.

    FFmpeg reads RTSP cameras only with codecs that smartcam's own receiver lacks, and web addresses
    unless they send multipart JPEG.

    A query belongs to the server, so smartcam's parameters follow ``#``, also after a path:
    ``rtsp://admin:PASSWORD@camera/stream?channel=1#transport=udp&timeout=3``,
    ``belt.mp4#pace=none``, ``shots/*.png#fps=5``.

    ================= =============================================================================
    ``transport``     of RTSP: ``tcp`` (default), without losses, or ``udp``, where a loss may spoil
                      pictures until the next key frame
    ``timeout``       seconds to connect, and without data until the source counts as dead; default
                      5
    ``format``        ``RGB8``, ``BGR8`` or ``Mono8`` converts the pixels; ``MJPEG`` or ``H264``
                      passes such bytes on unchanged; default: the decoder's format
    ``delay``         of a live stream: assumed longest time from exposure to arrival; default 1
    ``pace``          of a recording: ``real`` (default) by its time stamps, or ``none``: each
                      picture as soon as the readers have taken the last one, without skips
    ``fps``           of a recording: pictures per second instead of its time stamps; default 10 of
                      files in a folder
    ``mixed``         of files: ``yes`` also accepts pictures with other sizes and formats than the
                      first one's, and counts damaged ones as lost; default ``no``
    ``verify``        of TLS: ``no`` trusts any certificate
    ``ca``            of TLS: file with the certificates that are trusted; default: the system's
    ``elsewhere``     of a server: ``yes`` follows a redirect to another host or port, and a
                      playlist (HLS, DASH); default ``no``
    ``name``          of the camera
    ================= =============================================================================

    A live stream's frames have the time of their arrival; frames that FFmpeg received during its
    analysis have the time at which the stream began. Only RTSP has a clock, ``device_time``. Frames
    have no numbers, so ``sequence`` counts received pictures, and ``lost`` damaged pictures. Both
    damaged pictures and those that the decoder reports as depending on them are dropped.
    """

    def __init__(self, address: FrameAddress) -> None:
        super().__init__(address)
        self._path, fragment = _split_fragment(address)
        parameters = address.parameters(_PARAMETERS[address.scheme], fragment)
        number = address.number
        self._name = parameters.get("name") or _name(address, self._path)
        self._timeout = number("timeout", parameters.get("timeout", "5"), 0.1, 600)
        self._delay = number("delay", parameters.get("delay", "1"), 0, 600)
        self._fps = number("fps", parameters["fps"], 0.01, 10_000) if "fps" in parameters else None
        self._keeps_pace = one_of(address, "pace", parameters, ("real", "none")) == "real"
        self._format = wanted_format(address, parameters.get("format"))
        self._options = _options(address, parameters)
        self._allows_mixed = one_of(address, "mixed", parameters, ("no", "yes")) == "yes"
        self._allows_other_hosts = one_of(address, "elsewhere", parameters, ("no", "yes")) == "yes"
        self._tls = tls_context(address, parameters)
        self._thread: _ReaderThread | None = None
        self._task: asyncio.Task[None] | None = None
        self._stream: StreamFormat | None = None
        self._sequence = 0

    @property
    def name(self) -> str:
        """Address without password, query and fragment, or the name in the URL."""
        return self._name

    async def open(self) -> StreamFormat:
        """Read one picture, and close the source again.

        Raises:
            FrameFormatError: the source is no video, or its pixel format is not supported.
            FrameSourceError: the source is missing, refuses, or does not answer.
            MissingExtraError: the extra ``video`` is not installed.
        """
        try:
            reader, first = await self._open_and_read()
        finally:
            await self.stop()
        rate, pixels = self._fps or reader.rate, first.pixels
        rates = (rate,) if rate else ()
        self._stream = StreamFormat(pixels.format, pixels.width, pixels.height, rates)
        return self._stream

    async def start(self, sink: FrameSink) -> None:
        """Connect and read; a recording starts at its beginning.

        Raises:
            FrameSourceError: the source is gone, or does not answer.
        """
        try:
            reader, first = await self._open_and_read()
        except BaseException:
            await self.stop()
            raise
        name = f"frames of {self.name}"
        self._task = asyncio.create_task(self._pass_frames(sink, reader, first), name=name)

    async def stop(self) -> None:
        """Stop reading; wait for a hanging read at most until its timeout."""
        task, self._task = self._task, None
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.stop()
        if task is not None:
            task.cancel()
            await asyncio.wait([task])
        if thread is not None and not await thread.close(self._timeout + THREAD_GRACE):
            _log.warning("! %s: the reader thread hangs, and is abandoned", self.name)

    async def close(self) -> None:
        """Release everything. Idempotent."""
        await self.stop()

    async def _open_and_read(self) -> tuple[PictureReader, TimedPicture]:
        """Open the video and read the first picture."""
        await self.stop()
        thread = self._thread = _ReaderThread(self.name)
        reader = await thread.open(self._open_reader)
        first = await thread.run(reader.read)
        if first is None:
            raise FrameFormatError(f"{self.name}: expected a picture, got none", source=self.name)
        if self._fps and reader.is_live:
            raise self.address.wrong("fps", "a recording (for fps)", "a live stream")
        return reader, first

    def _open_reader(self) -> PictureReader:
        address = self.address
        is_network = address.scheme != "file"
        url = address.url.partition("#")[0] if is_network else f"file:{self._path}"
        pictures = not is_network and is_pictures(self._path)
        plan = VideoPlan(
            name=self.name,
            url=self._path if pictures else url,
            options=self._options,
            timeout=self._timeout,
            format=self._format,
            is_network=is_network,
            allows_other_hosts=self._allows_other_hosts,
            tls=self._tls,
            skips_damaged=self._allows_mixed,
        )
        return PictureFiles(plan) if pictures else VideoReader(plan)

    async def _pass_frames(
        self, sink: FrameSink, reader: PictureReader, first: TimedPicture
    ) -> None:
        rate, is_live, thread = reader.rate, reader.is_live, self._thread
        playback = _Playback(self._fps or (None if rate else PICTURE_RATE), rate)
        picture: TimedPicture | None = first
        try:
            while picture is not None and thread is not None:
                if self._keeps_pace and not is_live:
                    await playback.wait_until_due(picture.time)
                sink.frame(self._to_frame(picture, is_live))
                if not self._keeps_pace and not is_live:
                    await sink.wait_taken()
                picture = await thread.run(reader.read)
        except FrameSourceError as exc:
            sink.ended(exc)
        except Exception as exc:  # noqa: BLE001 - passed on to readers
            error = FrameSourceError(f"{self.name}: {exc!r}", source=self.name)
            error.__cause__ = exc
            sink.ended(error)
        else:
            sink.ended(None)

    def _to_frame(self, picture: TimedPicture, is_live: bool) -> Frame:
        pixels, now = picture.pixels, time.monotonic()
        actual = (pixels.format, pixels.width, pixels.height)
        if self._stream is not None and actual != self._stream[:3] and not self._allows_mixed:
            raise FrameFormatError(
                f"{self.name}: expected {StreamFormat(*self._stream[:3])}, as it was opened, got "
                f"{StreamFormat(*actual)}: open it again",
                source=self.name,
                available=(str(StreamFormat(*actual)),),
            )
        captured = picture.arrived_at if is_live else now
        self._sequence += 1 + picture.lost
        return Frame(
            data=pixels.data,
            format=pixels.format,
            width=pixels.width,
            height=pixels.height,
            stride=pixels.stride,
            captured=captured,
            utc=time.time() - (now - captured),
            moment=Moment.ARRIVAL,
            duration=self._delay if is_live else 0.0,
            device_time=picture.time if picture.is_device_time else None,
            sequence=self._sequence,
            lost=picture.lost,
            source=self.name,
        )


class _ReaderThread:
    """A thread that opens, reads and closes a source."""

    def __init__(self, name: str) -> None:
        self._pool = ThreadPoolExecutor(1, f"frames of {name}")
        self._reader: PictureReader | None = None

    async def open(self, make: Callable[[], PictureReader]) -> PictureReader:
        """Return the opened reader; the thread keeps it even if the caller is cancelled."""

        def open_reader() -> PictureReader:
            self._reader = reader = make()
            return reader

        return await self.run(open_reader)

    async def run(self, work: Callable[[], T]) -> T:
        """Run a function in the thread; cancelled calls run nevertheless."""
        future = asyncio.get_running_loop().run_in_executor(self._pool, work)
        future.add_done_callback(_retrieve_error)
        return await asyncio.shield(future)

    def stop(self) -> None:
        """Abort the search for the next picture."""
        if self._reader is not None:
            self._reader.stopped.set()

    async def close(self, timeout: float) -> bool:
        """Close the source in the thread; return False if the thread did not do so in time."""
        closing = asyncio.get_running_loop().run_in_executor(self._pool, self._close_reader)
        closing.add_done_callback(_retrieve_error)
        self._pool.shutdown(wait=False)
        _, pending = await asyncio.wait([closing], timeout=timeout)
        return not pending

    def _close_reader(self) -> None:
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.close()


def _retrieve_error(done: asyncio.Future[Any]) -> None:
    if not done.cancelled():
        done.exception()  # mark the error as retrieved


class _Playback:
    """The schedule of a recording's pictures.

    Args:
        fps: pictures per second; None: the time stamps set the pace.
        rate: pictures per second if they have no time stamps.
    """

    def __init__(self, fps: float | None, rate: float | None) -> None:
        self._fps, self._rate = fps, rate or PICTURE_RATE
        self._started_at: float | None = None
        self._count = 0
        self._last_due = 0.0

    async def wait_until_due(self, stamp: float | None) -> None:
        """Wait until a picture is due, by its time stamp in seconds."""
        if self._fps is not None:
            due = self._count / self._fps
        else:
            due = self._last_due + 1 / self._rate if stamp is None else stamp
        self._count += 1
        self._last_due = due
        now = asyncio.get_running_loop().time()
        if self._started_at is None or now > self._started_at + due + MAX_PLAYBACK_DELAY:
            self._started_at = now - due
        await asyncio.sleep(self._started_at + due - now)


def _split_fragment(address: FrameAddress) -> tuple[str, str]:
    """Split a URL into path and parameters; a # without parameters belongs to the path."""
    if address.scheme != "file":
        return address.path, address.fragment
    if "://" in address.url:
        if address.host not in ("", "localhost"):
            raise address.wrong("file", "file:///PATH, or the path alone", address.shown)
        return address.path, address.fragment
    match = re.fullmatch(r"(.*)#(\w+=[^#/]*)", address.path, re.DOTALL)
    return (match[1], match[2]) if match else (address.path, "")


def _name(address: FrameAddress, path: str) -> str:
    if address.scheme == "file":
        return path
    return address.shown.partition("#")[0].partition("?")[0]


def wanted_format(address: FrameAddress, name: str | None) -> PixelFormat | None:
    """Return the format that a parameter names; None without the parameter."""
    choices = [*CONVERTIBLE, "MJPEG", "H264"]
    if name is None:
        return None
    try:
        pixel_format = find_format(name)
    except FrameFormatError:
        pixel_format = None
    if pixel_format is None or pixel_format.name not in choices:
        raise address.wrong("format", f"one of {', '.join(choices)}", name)
    return pixel_format


def one_of(
    address: FrameAddress, name: str, parameters: dict[str, str], choices: tuple[str, ...]
) -> str:
    """Return a parameter's value, by default the first of the choices."""
    value = parameters.get(name, choices[0])
    if value not in choices:
        raise address.wrong(name, " or ".join(choices), value)
    return value


def _options(address: FrameAddress, parameters: dict[str, str]) -> dict[str, str]:
    """Return FFmpeg's options."""
    options: dict[str, str] = {}
    if address.scheme.startswith("rtsp"):
        options |= LIVE_OPTIONS | {
            "rtsp_transport": one_of(address, "transport", parameters, ("tcp", "udp"))
        }
    if address.scheme in ("https", "rtsps"):
        verifies = one_of(address, "verify", parameters, ("yes", "no")) == "yes"
        options |= (
            {"tls_verify": "1", "ca_file": _trusted_certificates(parameters)}
            if verifies
            else {"tls_verify": "0"}
        )
    return options


def _trusted_certificates(parameters: dict[str, str]) -> str:
    """Return the file of trusted certificates."""
    paths = ssl.get_default_verify_paths()
    return parameters.get("ca") or paths.cafile or paths.openssl_cafile


def tls_context(address: FrameAddress, parameters: dict[str, str]) -> ssl.SSLContext | None:
    """Return the TLS context of a URL's settings; None without TLS."""
    if address.scheme not in ("https", "rtsps"):
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    if one_of(address, "verify", parameters, ("yes", "no")) == "no":
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
    elif trusted := _trusted_certificates(parameters):
        with contextlib.suppress(OSError, ssl.SSLError):  # connecting reports the error
            context.load_verify_locations(trusted)
    return context
