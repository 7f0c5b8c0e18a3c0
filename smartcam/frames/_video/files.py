"""Read pictures by FFmpeg in a video source's thread."""

from __future__ import annotations

import errno
import glob
import logging
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from smartcam._extras import load
from smartcam._natural import natural
from smartcam.exceptions import FrameFormatError, FrameSourceError
from smartcam.frames._video.frames import CONVERTIBLE, Pixels, from_av_frame, reformatted
from smartcam.frames._video.jpegxl import is_jpegxl, read_jpegxl
from smartcam.frames._video.redirects import follow_redirects

if TYPE_CHECKING:
    import ssl
    from collections.abc import Callable, Mapping

    from smartcam.frames._pixels.formats import PixelFormat


_log: Final = logging.getLogger("smartcam.frames")

PICTURE_SUFFIXES: Final = frozenset(
    {".bmp", ".jpeg", ".jpg", ".jxl", ".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff", ".webp"}
)
"""Suffixes by which picture files in a folder are found."""

MIN_REDIRECT_VERSION: Final = (62, 0, 0)
"""First version of libavformat with an option against redirects."""

UNBUFFERED_WAIT_TIME: Final = 0.01
"""A read that waited at least this long, seconds, got a new packet, not a buffered one."""

_PASSED_ON: Final = {"mjpeg": "MJPEG", "h264": "H264"}
"""Codecs whose bytes can be passed on unchanged, with smartcam's formats."""

_INDEPENDENT_PICTURES: Final = frozenset(
    {"mjpeg", "png", "rawvideo", "bmp", "jpeg2000", "ffv1", "huffyuv"}
)
"""Codecs whose pictures are independent, so a damaged picture does not affect later ones."""

_STRICT_ABOUT_TAGS: Final = frozenset({"tiff"})
"""Codecs that report unknown tags as damage in FFmpeg's strict mode, which is therefore not used
for them; they report cut pictures without it, too."""

FORMATS: Final = (
    "asf,avi,dv,flv,gif,h264,hevc,ivf,m4v,matroska,mjpeg,mov,mpeg,mpegts,mpegvideo,mpjpeg,mxf,nut,"
    "obu,ogg,rawvideo,vc1,wtv,yuv4mpegpipe,apng,webp,bmp_pipe,j2k_pipe,jpeg_pipe,jpegls_pipe,"
    "jpegxl_pipe,pam_pipe,pbm_pipe,pgm_pipe,png_pipe,ppm_pipe,tiff_pipe,webp_pipe"
)
"""Formats that FFmpeg may read, which contain their pictures. Playlists and descriptions (HLS,
DASH, SDP, concat and others) could name other files and hosts."""

PROTOCOLS: Final = {
    "file": "file",
    "http": "http,httpproxy,tcp",
    "https": "http,https,httpproxy,tcp,tls",
    "rtsp": "rtp,tcp,udp",
    "rtsps": "rtp,tcp,tls,udp",
}
"""Protocols that FFmpeg may use, by the URL's scheme; the environment may name a proxy."""

REMOTE_PROTOCOLS: Final = "crypto,data,http,https,httpproxy,rtp,tcp,tls,udp"
"""Protocols that FFmpeg may use with ``elsewhere``, which excludes this machine's files."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoPlan:
    """The plan for reading a video: its URL, options and bounds.

    Attributes:
        name: name of the source for errors, without a password.
        url: URL for FFmpeg.
        options: options for FFmpeg.
        timeout: seconds for connecting, and for every wait after that.
        format: pixel format to convert to, or format of encoded bytes that are passed on; None: the
            decoder's format.
        is_network: whether the video comes from a server; if its length is unknown, it is live.
        allows_other_hosts: whether FFmpeg may follow redirects and playlists to other hosts.
        tls: context that checks the server's certificate; None: the default check.
        skips_damaged: whether damaged files of a folder are left out and counted as lost.
    """

    name: str
    url: str
    options: Mapping[str, str] = field(default_factory=dict)
    timeout: float = 5.0
    format: PixelFormat | None = None
    is_network: bool = False
    allows_other_hosts: bool = False
    tls: ssl.SSLContext | None = None
    skips_damaged: bool = False

    def format_error(self, text: str) -> FrameFormatError:
        """Return an error of the video's content."""
        return FrameFormatError(f"{self.name}: {text}", source=self.name)


class TimedPicture(NamedTuple):
    """A picture that was read from a source, with its times.

    Attributes:
        pixels: pixels of the picture.
        time: time stamp, seconds of the stream's clock; None: no time stamp.
        arrived_at: time of arrival, or an earlier time if FFmpeg buffered the packet, seconds of
            ``time.monotonic()``.
        lost: number of damaged pictures since the last one that was returned.
        is_device_time: whether ``time`` is from the camera's clock.
    """

    pixels: Pixels
    time: float | None
    arrived_at: float
    lost: int
    is_device_time: bool = False


class PictureReader(ABC):
    """A reader of pictures; its methods block, and one thread calls them.

    Attributes:
        stopped: event that aborts the search for the next picture.
    """

    def __init__(self, plan: VideoPlan) -> None:
        self.plan = plan
        self.stopped = threading.Event()

    @property
    @abstractmethod
    def is_live(self) -> bool:
        """True for a live stream, whose pictures cannot wait."""

    @property
    @abstractmethod
    def rate(self) -> float | None:
        """Pictures per second; None: unknown."""

    @abstractmethod
    def read(self) -> TimedPicture | None:
        """Return the next picture; None at the end, or when stopped.

        Raises:
            FrameSourceError: the source is gone, does not answer, or has changed.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the source. Idempotent."""


class VideoReader(PictureReader):
    """A reader of an open stream or file.

    Raises:
        FrameFormatError: the source has no video.
        FrameSourceError: the source is not there, refuses, or is silent.
        MissingExtraError: the extra ``video`` is not installed.
    """

    def __init__(self, plan: VideoPlan) -> None:
        super().__init__(plan)
        self._has_returned_picture = False
        self._start_code_filter: Any = None
        self._started_at = time.monotonic()
        self._container = self._open_container()
        self._opened_at = time.monotonic()
        self._is_buffered = True  # whether packets have waited during FFmpeg's analysis
        try:
            self._stream = self._first_stream()
            self._packets = self._container.demux(self._stream)
            rate = self._stream.average_rate  # cannot be read after closing
            self._rate = float(rate) if rate else None
            self._is_live = self.plan.is_network and self._container.duration is None
        except BaseException:
            self.close()
            raise
        self._pictures: deque[tuple[Any, float]] = deque()
        self._lost = 0
        self._decode_error = ""  # error of the last undecodable picture

    def _open_container(self) -> Any:
        """Return FFmpeg's container for the URL, without access to other addresses."""
        plan, scheme = self.plan, self.plan.url.partition(":")[0]
        if plan.allows_other_hosts:
            return self._open(plan.url, {"protocol_whitelist": REMOTE_PROTOCOLS})
        formats = {"file": f"{FORMATS},image2", "rtsp": "rtsp", "rtsps": "rtsp"}
        bounds = {
            "protocol_whitelist": PROTOCOLS[scheme],
            "format_whitelist": formats.get(scheme, FORMATS),
        }
        if scheme.startswith("rtsp"):
            return self._open(self._redirected_url(), bounds)
        if scheme == "file":
            return self._open(plan.url, bounds)
        bounds["max_redirects"] = "0"
        if load("av").library_versions["libavformat"] < MIN_REDIRECT_VERSION:
            return self._open(self._redirected_url(), bounds)
        try:
            return self._open(plan.url, bounds)
        except FrameSourceError as error:
            cause = error.__cause__
            if not isinstance(cause, OSError) or cause.errno != errno.EIO:
                raise
            url = self._redirected_url()
            if url == plan.url:
                raise
        return self._open(url, bounds)

    def _redirected_url(self) -> str:
        plan = self.plan
        return follow_redirects(plan.url, name=plan.name, timeout=plan.timeout, tls=plan.tls)

    def _open(self, url: str, bounds: Mapping[str, str]) -> Any:
        options = {**self.plan.options, **bounds}
        limits = (self.plan.timeout, self.plan.timeout)
        try:
            return self._call_ffmpeg(lambda: load("av").open(url, options=options, timeout=limits))
        except FrameFormatError as error:
            cause = error.__cause__
            if isinstance(cause, OSError) and cause.errno == errno.EINVAL:
                hint = "; #elsewhere=yes follows a playlist" if self.plan.is_network else ""
                raise self.plan.format_error(
                    "expected a format with the pictures in it, got one that is not supported, or "
                    f"a playlist{hint}"
                ) from cause
            raise

    def _call_ffmpeg(self, call: Callable[[], Any]) -> Any:
        """Return the result of a call to FFmpeg; None at the end of the video."""
        started_at = time.monotonic()
        try:
            return call()
        except EOFError as exc:
            failure: Exception = exc
        except load("av").FFmpegError as exc:
            failure = exc
        if isinstance(failure, EOFError) and self._has_returned_picture:
            return None
        # raised outside of the handler, since FFmpeg's error text has the URL with the password
        raise self._error(failure, time.monotonic() - started_at) from _plain_error(failure)

    def _first_stream(self) -> Any:
        streams = self._container.streams.video
        if not streams:
            raise self.plan.format_error(f"expected video, got {self._container.format.long_name}")
        stream = streams[0]
        if stream.codec_context is None:
            actual = self._container.format.long_name
            raise self.plan.format_error(f"expected video that FFmpeg decodes here, got {actual}")
        stream.codec_context.thread_count = 1  # more threads delay frames
        if stream.codec_context.name not in _STRICT_ABOUT_TAGS:
            stream.codec_context.options = {"err_detect": "explode"}  # refuse incomplete pictures
        wanted = self.plan.format
        if wanted is not None and wanted.compressed:
            actual = _PASSED_ON.get(stream.codec_context.name, stream.codec_context.name)
            if actual != wanted.name:
                raise self.plan.format_error(f"expected {wanted.name}, got {actual}")
            if actual == "H264":  # files have lengths in place of start codes
                bitstream = load("av.bitstream").BitStreamFilterContext
                self._start_code_filter = bitstream("h264_mp4toannexb", stream)
        return stream

    @property
    def is_live(self) -> bool:
        """True if a server sends pictures without a known end."""
        return self._is_live

    @property
    def rate(self) -> float | None:
        """Pictures per second of the stream; None: unknown."""
        return self._rate

    def read(self) -> TimedPicture | None:
        """Return the next picture."""
        started_at = time.monotonic()
        while not self._pictures and not self.stopped.is_set():
            if self.plan.is_network and time.monotonic() - started_at > self.plan.timeout:
                raise self.plan.format_error(
                    "expected a picture, got bytes that make no picture for "
                    f"{self.plan.timeout:g} s"
                )
            asked_at = time.monotonic()
            packet = self._call_ffmpeg(lambda: next(self._packets, None))
            if packet is None:
                self._check_end()
                return None
            self._decode_packet(packet, self._arrival_time(asked_at, time.monotonic()))
        if not self._pictures or self.stopped.is_set():
            return None
        picture, arrived_at = self._pictures.popleft()
        lost, self._lost = self._lost, 0
        self._has_returned_picture = True
        base = picture.time_base or self._stream.time_base
        at = None if picture.pts is None else float(picture.pts * base)
        is_device_time = (
            at is not None
            and self._container.format.name == "rtsp"
            and arrived_at > self._started_at
        )
        return TimedPicture(self._pixels(picture), at, arrived_at, lost, is_device_time)

    def _arrival_time(self, asked_at: float, now: float) -> float:
        """Return a packet's arrival, or the earliest possible time if FFmpeg buffered it."""
        if self._is_buffered:
            drained = now - self._opened_at > self._opened_at - self._started_at
            self._is_buffered = not drained and now - asked_at < UNBUFFERED_WAIT_TIME
        return self._started_at if self._is_buffered else now

    def _check_end(self) -> None:
        """Raise if a live stream has ended, or if the video had no picture."""
        if self.is_live:
            raise FrameSourceError(
                f"{self.plan.name}: the server ended the stream", source=self.plan.name
            )
        if not self._has_returned_picture:
            cause = f": {self._decode_error}" if self._decode_error else ""
            raise self.plan.format_error(f"expected pictures, the video ended without one{cause}")

    def _decode_packet(self, packet: Any, arrived_at: float) -> None:
        """Decode a packet, or pass it on."""
        if self.plan.format is not None and self.plan.format.compressed:
            if packet.is_corrupt:
                self._lost += self._has_returned_picture
            elif packet.size:
                codes = self._start_code_filter
                filtered = codes.filter(packet) if codes else [packet]
                self._pictures.extend((picture, arrived_at) for picture in filtered)
            return
        is_damaged = bool(packet.is_corrupt)
        try:
            pictures = packet.decode()
        except load("av").FFmpegError as exc:
            is_damaged, pictures, self._decode_error = True, [], _reason(exc)
        intact = [picture for picture in pictures if not picture.is_corrupt]
        if is_damaged or len(intact) < len(pictures):
            self._lost += self._has_returned_picture  # a stream may begin midway
            if self._stream.codec_context.name not in _INDEPENDENT_PICTURES:
                intact = []
                self._stream.codec_context.flush_buffers()  # dependent pictures are dropped
        self._pictures.extend((picture, arrived_at) for picture in intact)

    def _pixels(self, picture: Any) -> Pixels:
        wanted = self.plan.format
        if wanted is not None and wanted.compressed:
            context = self._stream.codec_context
            return Pixels(wanted, context.width, context.height, 0, bytes(picture))
        try:
            if wanted is not None:
                picture = reformatted(picture, CONVERTIBLE[wanted.name])
            return from_av_frame(picture)
        except FrameFormatError as exc:
            raise self.plan.format_error(f"{exc}; #format=RGB8 converts") from exc

    def close(self) -> None:
        """Close the video."""
        self._container.close()

    def _error(self, failure: Exception, duration: float) -> FrameSourceError:
        """Return the error for a failure of FFmpeg, without its text, which has the password."""
        name, limit = self.plan.name, self.plan.timeout
        timed_out = self.plan.is_network and duration >= limit and isinstance(failure, ValueError)
        if timed_out or isinstance(failure, load("av").ExitError):  # the timeout of RTSP
            text = f"{name}: expected an answer, got none within {limit:g} s"
            return FrameSourceError(text, source=name)
        error_class = FrameFormatError if isinstance(failure, ValueError) else FrameSourceError
        return error_class(f"{name}: cannot be read: {_reason(failure)}", source=name)


def _reason(failure: Exception) -> str:
    return getattr(failure, "strerror", None) or type(failure).__name__


def _plain_error(failure: Exception) -> OSError:
    """Return an error's cause without the URL, which may have a password."""
    return OSError(getattr(failure, "errno", None) or errno.EIO, _reason(failure))


class PictureFiles(PictureReader):
    """A reader of picture files in the order of their names."""

    def __init__(self, plan: VideoPlan) -> None:
        super().__init__(plan)
        self._files = deque(picture_files(plan.url))
        if not self._files:
            raise FrameSourceError(f"{plan.name}: there is no picture file", source=plan.name)

    @property
    def is_live(self) -> bool:
        """Always False."""
        return False

    @property
    def rate(self) -> float | None:
        """Always None: files have no rate."""
        return None

    def read(self) -> TimedPicture | None:
        """Return the next picture."""
        lost = 0
        while self._files and not self.stopped.is_set():
            path = self._files.popleft()
            try:
                picture = self._read_file(path)
            except FrameSourceError as exc:
                if not (self.plan.skips_damaged and self._files):
                    raise
                _log.warning("! %s: left out: %s", self.plan.name, exc)
                lost += 1
            else:
                return None if picture is None else picture._replace(lost=lost)
        return None

    def _read_file(self, path: str) -> TimedPicture | None:
        if is_jpegxl(path):
            return TimedPicture(read_jpegxl(path, self.plan.format), None, time.monotonic(), 0)
        plan = VideoPlan(name=path, url=f"file:{path}", format=self.plan.format)
        reader = VideoReader(plan)
        try:
            picture = reader.read()
        finally:
            reader.close()
        return None if picture is None else picture._replace(time=None)

    def close(self) -> None:
        """Release everything."""
        self._files.clear()


def picture_files(path: str) -> list[str]:
    """Return the sorted picture files of a folder or pattern; for a file only this file."""
    if Path(path).is_file():
        return [path]
    if Path(path).is_dir():
        paths = [
            str(path) for path in Path(path).iterdir() if path.suffix.lower() in PICTURE_SUFFIXES
        ]
        return sorted(paths, key=natural)
    return sorted(glob.glob(path), key=natural)  # noqa: PTH207 - a pattern with its folder in one string


def is_pictures(path: str) -> bool:
    """Return True for a folder, a pattern, or a picture file that FFmpeg does not read."""
    if Path(path).exists():
        return Path(path).is_dir() or is_jpegxl(path)
    return glob.has_magic(path)
