"""Streams and files that FFmpeg reads, through PyAV."""

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
    PictureReading,
    VideoPlan,
    VideoReading,
    is_pictures,
)
from smartcam.frames._video.frames import CONVERTIBLE

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.frames._address import FrameAddress
    from smartcam.frames._driver import FrameSink
    from smartcam.frames._pixels.formats import PixelFormat
    from smartcam.frames._video.files import Read


T = TypeVar("T")

_log = logging.getLogger("smartcam.frames")

GRACE: Final = 1.0
"""Seconds that a thread gets beyond its own limits before it is left to itself."""

PICTURE_RATE: Final = 10.0
"""Pictures a second that are read from a folder, unless the URL says otherwise."""

MAX_PLAYBACK_DELAY: Final = 0.5
"""Seconds that a recording may be late before its clock is set anew."""

LIVE_OPTIONS: Final = {"fpsprobesize": "0", "probesize": "32768", "analyzeduration": "500000"}
"""FFmpeg's options for a live stream, which it otherwise studies for a second and gives late."""

_COMMON: Final = ("delay", "elsewhere", "format", "name", "timeout")
_RECORDED: Final = ("fps", "pace")
_KNOWN: Final = {
    "file": ("format", "mixed", "name", "timeout", *_RECORDED),
    "http": (*_COMMON, *_RECORDED),
    "https": (*_COMMON, *_RECORDED, "ca", "verify"),
    "rtsp": (*_COMMON, "transport"),
    "rtsps": (*_COMMON, "ca", "transport", "verify"),
}


class VideoDriver(FrameDriver):
    """A camera or file that FFmpeg reads: ``http:``, ``https:``, a path, or ``rtsp:``.

    Cameras by RTSP come here with encodings alone that our own receiver has not, and web cameras
    with all but JPEGs in parts.

    A query belongs to the server, so our parameters stand behind ``#``, also behind a path:
    ``rtsp://admin:PASSWORD@camera/stream?channel=1#transport=udp&timeout=3``,
    ``belt.mp4#pace=none``, ``shots/*.png#fps=5``.

    ================= =============================================================================
    ``transport``     of RTSP: ``tcp`` (usual), where nothing is lost, or ``udp``, where what is
                      lost may spoil pictures until the next key frame
    ``timeout``       seconds for connecting, and without data before it counts as dead; usual 5
    ``format``        pixels are converted to ``RGB8``, ``BGR8`` or ``Mono8``; ``MJPEG`` or ``H264``
                      hands the bytes on that came, where it is that; usual: as the decoder has them
    ``delay``         of a live stream: longest time from exposure to arrival, seconds; usual 1
    ``pace``          of a recording: ``real`` (usual) by its time stamps, or ``none``: each picture
                      when the readers have taken the last one; none is skipped
    ``fps``           of a recording: pictures per second instead of its time stamps; usual 10 of
                      files in a folder
    ``mixed``         of files: ``yes`` takes pictures of other sizes and formats than the first
                      one's, too, and counts damaged ones as lost; usual ``no``
    ``verify``        of TLS: ``no`` trusts any certificate
    ``ca``            of TLS: file with the certificates that are trusted; usual: the system's
    ``elsewhere``     of a server: ``yes`` goes where it sends us, by a redirect to another host or
                      port or by a playlist (HLS, DASH); usual ``no``
    ``name``          of the camera
    ================= =============================================================================

    A live stream's frames are stamped with their arrival; those that waited while FFmpeg looked
    what comes, with when it began to. Only RTSP has a clock, ``device_time``.
    None has numbers, so ``sequence`` counts what came, and ``lost`` what was damaged. A damaged
    picture is never given, nor one that rests on it as far as the decoder can tell.
    """

    def __init__(self, address: FrameAddress) -> None:
        super().__init__(address)
        self._path, fragment = _split(address)
        said = address.parameters(_KNOWN[address.scheme], fragment)
        number = address.number
        self._name = said.get("name") or _name(address, self._path)
        self._timeout = number("timeout", said.get("timeout", "5"), 0.1, 600)
        self._delay = number("delay", said.get("delay", "1"), 0, 600)
        self._fps = number("fps", said["fps"], 0.01, 10_000) if "fps" in said else None
        self._paced = one_of(address, "pace", said, ("real", "none")) == "real"
        self._format = wanted_format(address, said.get("format"))
        self._options = _options(address, said)
        self._mixed = one_of(address, "mixed", said, ("no", "yes")) == "yes"
        self._elsewhere = one_of(address, "elsewhere", said, ("no", "yes")) == "yes"
        self._tls = tls_of(address, said)
        self._thread: _ReadingThread | None = None
        self._task: asyncio.Task[None] | None = None
        self._stream: StreamFormat | None = None
        self._number = 0

    @property
    def name(self) -> str:
        """The address without password, query and fragment, or as the URL says."""
        return self._name

    async def open(self) -> StreamFormat:
        """Read a picture of it, and let it go again.

        Raises:
            FrameFormatError: the source is no video, or has pixels that we have no name for.
            FrameSourceError: the source is not there, refuses, or is silent.
            MissingExtraError: the extra ``video`` is not installed.
        """
        try:
            reading, first = await self._begin()
        finally:
            await self.stop()
        rate, pixels = self._fps or reading.rate, first.pixels
        rates = (rate,) if rate else ()
        self._stream = StreamFormat(pixels.format, pixels.width, pixels.height, rates)
        return self._stream

    async def start(self, sink: FrameSink) -> None:
        """Connect anew and read; a recording begins at its beginning.

        Raises:
            FrameSourceError: the source is gone, or silent.
        """
        try:
            reading, first = await self._begin()
        except BaseException:
            await self.stop()
            raise
        pumping = self._pump(sink, reading, first)
        self._task = asyncio.create_task(pumping, name=f"frames of {self.name}")

    async def stop(self) -> None:
        """Read no longer. What hangs in a read is waited for until its timeout, no longer."""
        task, self._task = self._task, None
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.stop()
        if task is not None:
            task.cancel()
            await asyncio.wait([task])
        if thread is not None and not await thread.ended(self._timeout + GRACE):
            _log.warning("! %s: its thread hangs, and is left to end by itself", self.name)

    async def close(self) -> None:
        """Release everything. Idempotent."""
        await self.stop()

    async def _begin(self) -> tuple[PictureReading, Read]:
        """Open the video and read the first picture."""
        await self.stop()
        thread = self._thread = _ReadingThread(self.name)
        reading = await thread.open(self._opened)
        first = await thread.do(reading.read)
        if first is None:
            raise FrameFormatError(f"{self.name}: there is no picture in it", source=self.name)
        if self._fps and reading.live:
            raise self.address.wrong("fps", "a recording, which alone has it", "a live stream")
        return reading, first

    def _opened(self) -> PictureReading:
        address = self.address
        network = address.scheme != "file"
        url = address.url.partition("#")[0] if network else f"file:{self._path}"
        pictures = not network and is_pictures(self._path)
        plan = VideoPlan(
            name=self.name,
            url=self._path if pictures else url,
            options=self._options,
            timeout=self._timeout,
            format=self._format,
            network=network,
            elsewhere=self._elsewhere,
            tls=self._tls,
            skips_damaged=self._mixed,
        )
        return PictureFiles(plan) if pictures else VideoReading(plan)

    async def _pump(self, sink: FrameSink, reading: PictureReading, first: Read) -> None:
        rate, live, thread = reading.rate, reading.live, self._thread
        clock = _Playback(self._fps or (None if rate else PICTURE_RATE), rate)
        read: Read | None = first
        try:
            while read is not None and thread is not None:
                if self._paced and not live:
                    await clock.wait_for(read.time)
                sink.frame(self._frame(read, live))
                if not self._paced and not live:
                    await sink.taken()
                read = await thread.do(reading.read)
        except FrameSourceError as error:
            sink.ended(error)
        except Exception as exc:  # noqa: BLE001 - readers are told, whatever it is
            failed = FrameSourceError(f"{self.name}: {exc!r}", source=self.name)
            failed.__cause__ = exc
            sink.ended(failed)
        else:
            sink.ended(None)

    def _frame(self, read: Read, live: bool) -> Frame:
        pixels, now = read.pixels, time.monotonic()
        comes = (pixels.format, pixels.width, pixels.height)
        if self._stream is not None and comes != self._stream[:3] and not self._mixed:
            raise FrameFormatError(
                f"{self.name}: expected {StreamFormat(*self._stream[:3])}, as it was opened, got "
                f"{StreamFormat(*comes)}: open it anew",
                source=self.name,
                available=(str(StreamFormat(*comes)),),
            )
        captured = read.arrived if live else now
        self._number += 1 + read.lost
        return Frame(
            data=pixels.data,
            format=pixels.format,
            width=pixels.width,
            height=pixels.height,
            stride=pixels.stride,
            captured=captured,
            utc=time.time() - (now - captured),
            moment=Moment.ARRIVAL,
            duration=self._delay if live else 0.0,
            device_time=read.time if read.clock else None,
            sequence=self._number,
            lost=read.lost,
            source=self.name,
        )


class _ReadingThread:
    """One thread, and what is read in it: it opens that, reads, and gives it back."""

    def __init__(self, name: str) -> None:
        self._pool = ThreadPoolExecutor(1, f"frames of {name}")
        self._reading: PictureReading | None = None

    async def open(self, make: Callable[[], PictureReading]) -> PictureReading:
        """Return the opened reading; the thread keeps it even if the caller is cancelled."""

        def opened() -> PictureReading:
            self._reading = made = make()
            return made

        return await self.do(opened)

    async def do(self, work: Callable[[], T]) -> T:
        """Have something done; what is cancelled is done all the same."""
        doing = asyncio.get_running_loop().run_in_executor(self._pool, work)
        doing.add_done_callback(_looked_at)
        return await asyncio.shield(doing)

    def stop(self) -> None:
        """Have a picture that is looked for given up."""
        if self._reading is not None:
            self._reading.stopped.set()

    async def ended(self, within: float) -> bool:
        """Give everything back, and return whether the thread did so in time."""
        last = asyncio.get_running_loop().run_in_executor(self._pool, self._give_back)
        last.add_done_callback(_looked_at)
        self._pool.shutdown(wait=False)
        _, late = await asyncio.wait([last], timeout=within)
        return not late

    def _give_back(self) -> None:
        reading, self._reading = self._reading, None
        if reading is not None:
            reading.close()


def _looked_at(done: asyncio.Future[Any]) -> None:
    if not done.cancelled():
        done.exception()  # nobody may be there for it any longer


class _Playback:
    """The times at which a recording's pictures are due.

    Args:
        fps: pictures per second; None: by their time stamps.
        rate: rate of frames without a stamp.
    """

    def __init__(self, fps: float | None, rate: float | None) -> None:
        self._fps, self._rate = fps, rate or PICTURE_RATE
        self._began: float | None = None
        self._count = 0
        self._last = 0.0

    async def wait_for(self, stamp: float | None) -> None:
        """Wait until a picture is due, by its time stamp in seconds."""
        if self._fps is not None:
            at = self._count / self._fps
        else:
            at = self._last + 1 / self._rate if stamp is None else stamp
        self._count += 1
        self._last = at
        now = asyncio.get_running_loop().time()
        if self._began is None or now > self._began + at + MAX_PLAYBACK_DELAY:
            self._began = now - at
        await asyncio.sleep(self._began + at - now)


def _split(address: FrameAddress) -> tuple[str, str]:
    """Return the path and our parameters; a path's own # is one that no parameter follows."""
    if address.scheme != "file":
        return address.path, address.fragment
    if "://" in address.url:
        if address.host not in ("", "localhost"):
            raise address.wrong("file", "file:///PATH, or the path alone", address.shown)
        return address.path, address.fragment
    found = re.fullmatch(r"(.*)#(\w+=[^#/]*)", address.path, re.DOTALL)
    return (found[1], found[2]) if found else (address.path, "")


def _name(address: FrameAddress, path: str) -> str:
    if address.scheme == "file":
        return path
    return address.shown.partition("#")[0].partition("?")[0]


def wanted_format(address: FrameAddress, said: str | None) -> PixelFormat | None:
    known = [*CONVERTIBLE, "MJPEG", "H264"]
    if said is None:
        return None
    try:
        found = find_format(said)
    except FrameFormatError:
        found = None
    if found is None or found.name not in known:
        raise address.wrong("format", f"one of {', '.join(known)}", said)
    return found


def one_of(address: FrameAddress, name: str, said: dict[str, str], known: tuple[str, ...]) -> str:
    """Return a parameter's value, by default the first of the known values."""
    value = said.get(name, known[0])
    if value not in known:
        raise address.wrong(name, " or ".join(known), value)
    return value


def _options(address: FrameAddress, said: dict[str, str]) -> dict[str, str]:
    """Return FFmpeg's."""
    options: dict[str, str] = {}
    if address.scheme.startswith("rtsp"):
        options |= LIVE_OPTIONS | {
            "rtsp_transport": one_of(address, "transport", said, ("tcp", "udp"))
        }
    if address.scheme in ("https", "rtsps"):
        verified = one_of(address, "verify", said, ("yes", "no")) == "yes"
        options |= (
            {"tls_verify": "1", "ca_file": _trusted(said)} if verified else {"tls_verify": "0"}
        )
    return options


def _trusted(said: dict[str, str]) -> str:
    """Return the file with the certificates that are trusted."""
    paths = ssl.get_default_verify_paths()
    return said.get("ca") or paths.cafile or paths.openssl_cafile


def tls_of(address: FrameAddress, said: dict[str, str]) -> ssl.SSLContext | None:
    """Return a context that checks the certificate as the URL says; None without TLS."""
    if address.scheme not in ("https", "rtsps"):
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    if one_of(address, "verify", said, ("yes", "no")) == "no":
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
    elif trusted := _trusted(said):
        with contextlib.suppress(OSError, ssl.SSLError):  # the connection says what is wrong
            context.load_verify_locations(trusted)
    return context
