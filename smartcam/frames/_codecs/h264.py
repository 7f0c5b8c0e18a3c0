"""Encode and decode H.264 by x264 and FFmpeg, without a frame of delay."""

from __future__ import annotations

import asyncio
import threading
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Final, Protocol, TypeVar

from smartcam._arguments import check_integer, check_number
from smartcam._extras import load
from smartcam.exceptions import FrameFormatError
from smartcam.frames._codecs.pictures import decoded
from smartcam.frames._frame import changed
from smartcam.frames._pixels.formats import find_format
from smartcam.frames._video.frames import converted, from_video, to_video

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.frames._frame import Frame


T = TypeVar("T")

MAX_WAITING_FRAMES: Final = 32
"""Largest number of encoded frames whose data a decoder keeps until it returns their pictures."""


class Runs(Protocol):
    """A function that runs work in a thread or at once, such as a method of ``Codecs``."""

    def __call__(self, work: Callable[[], T], /) -> Awaitable[T]:
        """Run the work, in a thread or at once, and return its result."""
        ...


class H264Encoder:
    """Encoder of one stream of H.264, made by :meth:`Codecs.h264_encoder`.

    Each frame is encoded at once into its own bytes. Instead of large key frames, a column of each
    frame is encoded without reference to earlier ones (intra refresh). The parameter sets are
    repeated, so a viewer can join late. Another size or format restarts the stream with a key
    frame; so does a cancelled call, whose bytes are lost.

    Four pixels share U and V. Y is encoded as the camera sent it, and the stream says its range;
    only RGB is converted, to BT.601 with limited range. A JPEG is decoded to RGB first.
    """

    def __init__(
        self, run: Runs, *, fps: float, keyint: int, crf: float, bitrate: int | None
    ) -> None:
        load("av")
        caller = "h264_encoder"
        fps = check_number(fps, "fps", 0.01, 1000.0, caller)
        keyint = check_integer(keyint, "keyint", 2, 600, caller)
        crf = check_number(crf, "crf", 0, 51, caller)
        if bitrate is not None:
            bitrate = check_integer(bitrate, "bitrate", 10_000, 1_000_000_000, caller)
        self._run = run
        self._rate = Fraction(fps).limit_denominator(1000)
        self._time_base = 1 / self._rate
        self._options = {
            "preset": "ultrafast",
            "tune": "zerolatency",
            "x264-params": f"intra-refresh=1:keyint={keyint}:repeat-headers=1",
        }
        if bitrate is None:
            self._options["crf"] = f"{crf:g}"
        else:
            self._options |= {"maxrate": str(bitrate), "bufsize": str(bitrate // 4)}
        self._bitrate = bitrate
        self._turn = asyncio.Lock()
        self._in_use = threading.Lock()  # the thread of a cancelled call may still be using it
        self._codec: Any = None
        self._grey: Any = None  # frame of the last grey picture, of which x264 has made a copy
        self._kind: tuple[object, ...] = ()
        self._broken = 0  # number of calls whose bytes were never returned
        self._count = 0

    def begin_anew(self) -> None:
        """Make the next frame a key frame, for a viewer that joins or has lost data."""
        self._broken += 1

    async def encode(self, frame: Frame) -> Frame:
        """Return a frame of format ``H264`` with all other attributes of the given one.

        Raises:
            FrameFormatError: the frame cannot be encoded; the error says which formats can.
            LocalProtocolError: the codecs are closed.

        Cancellation: safe; the stream restarts with the next frame.
        """
        async with self._turn:
            try:
                return await self._run(partial(self._encode, frame, self._broken))
            except BaseException:
                self.begin_anew()
                raise

    def _encode(self, frame: Frame, broken: int) -> Frame:
        with self._in_use:
            if frame.format.name == "MJPEG":
                frame = decoded(frame, "RGB8")
            video = to_video(frame, self._grey)
            self._grey = video if frame.format.name == "Mono8" else None
            kind = (broken, video.width, video.height, video.format.name, *_colours(video))
            if kind != self._kind:
                self._codec = self._begun(video)
                self._kind = kind
            video.pts = self._count
            video.time_base = self._time_base
            self._count += 1
            packets = self._codec.encode(video)
            data = bytes(packets[0]) if len(packets) == 1 else b"".join(map(bytes, packets))
            return changed(frame, data=data, format=find_format("H264"), stride=0)

    def _begun(self, video: Any) -> Any:
        codec = load("av").CodecContext.create("libx264", "w")
        codec.width, codec.height, codec.pix_fmt = video.width, video.height, video.format.name
        codec.framerate, codec.time_base = self._rate, self._time_base
        codec.color_range, codec.colorspace = _colours(video)
        codec.thread_count = 1
        codec.options = self._options
        if self._bitrate is not None:
            codec.bit_rate = self._bitrate
        return codec


class H264Decoder:
    """Decoder of one stream of H.264, made by :meth:`Codecs.h264_decoder`.

    It returns only whole pictures. The first one follows a key frame, or the end of a refresh that
    began after the decoder had decoded something: FFmpeg may take a refresh for complete although
    its first frame had no reference. In the middle of a stream the first picture takes up to three
    times the encoder's ``keyint``, after a loss two times, and after :meth:`H264Encoder.begin_anew`
    no time.

    Args:
        run: function that runs the work.
        reorders: whether pictures are sent in another order than they are shown, so that some wait
            for others.
        to: pixel format of FFmpeg that pictures are converted to; "": no conversion.
    """

    CODEC: ClassVar = "h264"
    """The codec's name in FFmpeg."""
    NAME: ClassVar = "H264"
    """The codec's name in texts."""

    def __init__(self, run: Runs, *, reorders: bool = False, to: str = "") -> None:
        load("av")
        self._run, self._reorders, self._to = run, reorders, to
        self._turn = asyncio.Lock()
        self._in_use = threading.Lock()
        self._codec: Any = None
        self._size = (0, 0)
        self._losses = self._losses_seen = 0
        # number of frames until the picture is whole; None: unknown
        self._missing: int | None = None
        self._begun = False  # whether something was decoded that a refresh can refer to
        self._waiting: dict[int, Frame] = {}
        self._count = 0

    @property
    def whole(self) -> bool:
        """True if the decoder has decoded a whole picture since its start or the last loss."""
        return self._missing == 0 and self._losses == self._losses_seen

    def lost(self) -> None:
        """Report missing bytes: no picture is returned until a whole one was decoded.

        A decoder cannot detect missing bytes, and would return broken pictures.
        """
        self._losses += 1

    async def decode(self, frame: Frame) -> Frame | None:
        """Return the next picture, with all other attributes of its encoded frame.

        Args:
            frame: frame of format ``H264``; one encoded frame, whole.

        Returns:
            None without a whole picture: after a start in the middle of a stream, and after a loss.

        Raises:
            FrameFormatError: the frame is damaged, or its picture has another size; this counts as
                a loss.
            LocalProtocolError: the codecs are closed.

        Cancellation: safe; a cancelled call counts as a loss.
        """
        async with self._turn:
            try:
                return await self._run(partial(self._decode, frame, self._losses))
            except BaseException:
                self.lost()
                raise

    def _decode(self, frame: Frame, losses: int) -> Frame | None:
        with self._in_use:
            if self._size != (frame.width, frame.height):
                self._begin(frame)
            if losses != self._losses_seen:
                self._losses_seen, self._missing = losses, None
            missing = self._follow(bytes(frame.data))
            packet = self._packet(frame)
            try:
                pictures = self._codec.decode(packet)
            except load("av").FFmpegError as exc:
                if self._missing is None:
                    return None
                raise self._damaged_error(frame, str(exc)) from exc
            self._begun = True
            made = [self._made(picture) for picture in pictures]
            if any(picture.is_corrupt for picture in pictures) and missing == 0:
                raise self._damaged_error(frame, "a picture with holes")
            return made[-1] if made and missing == 0 else None

    def _begin(self, frame: Frame) -> None:
        self._codec = codec = load("av").CodecContext.create(self.CODEC, "r")
        codec.thread_count = 1
        self._size = (frame.width, frame.height)
        room = (frame.width + 64) * (frame.height + 64)
        codec.options = {
            "max_pixels": str(room),
            "err_detect": "explode",  # half a picture must be refused
        } | ({} if self._reorders else {"flags": "low_delay"})
        self._waiting.clear()
        self._missing, self._begun = None, False

    def _follow(self, data: bytes) -> int | None:
        """Return the number of frames until the picture is whole; None if that is not known."""
        if self._missing == 0:
            return 0
        key, refresh = self._entry_point(data)
        if key:
            self._missing = 0
        elif self._missing is not None:
            self._missing -= 1
        elif refresh is not None and self._begun:
            self._missing = refresh
        return self._missing

    def _entry_point(self, data: bytes) -> tuple[bool, int | None]:
        return entry_point(data)

    def _packet(self, frame: Frame) -> Any:
        packet = load("av").Packet(frame.data)
        self._count += 1
        packet.pts = self._count
        self._waiting[self._count] = frame
        if len(self._waiting) > MAX_WAITING_FRAMES:
            del self._waiting[next(iter(self._waiting))]
        return packet

    def _made(self, picture: Any) -> Frame:
        frame = self._waiting.pop(picture.pts)
        picture = converted(picture, self._to) if self._to else picture
        pixels = from_video(picture, apart=True)
        if (pixels.width, pixels.height) != (frame.width, frame.height):
            raise self._damaged_error(frame, f"a picture of {pixels.width}x{pixels.height}")
        return changed(frame, data=pixels.data, format=pixels.format, stride=pixels.stride)

    def _damaged_error(self, frame: Frame, actual: str) -> FrameFormatError:
        return FrameFormatError(
            f"{frame.source}: {self.NAME} {frame.width}x{frame.height}: expected a whole encoded "
            f"frame, got {len(frame.data)} bytes: {actual}",
            source=frame.source,
        )


SLICES, KEY, SEI, RECOVERY_POINT = (1, 2, 3, 4), 5, 6, 6
"""Types of NAL units (ITU-T H.264, table 7-1), and one type of message in an SEI unit (annex D)."""


def entry_point(data: bytes) -> tuple[bool, int | None]:
    """Return True for a key frame, and the number of frames until a refresh is complete.

    The number is None if no refresh begins with the frame.
    """
    refresh = None
    place = data.find(b"\0\0\1")
    while 0 <= place < len(data) - 3:
        kind, after = data[place + 3] & 0x1F, data.find(b"\0\0\1", place + 3)
        if kind == KEY or kind in SLICES:
            return kind == KEY, refresh
        if kind == SEI:
            end = after if after >= 0 else len(data)
            frames_to_recovery = _recovery(data[place + 4 : end].replace(b"\0\0\3", b"\0\0"))
            refresh = refresh if frames_to_recovery is None else frames_to_recovery
        place = after
    return False, refresh


def _recovery(messages: bytes) -> int | None:
    """Return recovery_frame_cnt from the messages of an SEI unit."""
    place = 0
    while place + 2 <= len(messages) and messages[place] != 0x80:
        numbers = []
        for _ in range(2):  # type and size: each is a sum of bytes of 255 and a last smaller one
            number = 0
            while place < len(messages) and messages[place] == 0xFF:
                number, place = number + 0xFF, place + 1
            if place == len(messages):
                return None
            numbers.append(number + messages[place])
            place += 1
        kind, size = numbers
        if kind == RECOVERY_POINT:
            return _exp_golomb(messages[place : place + size])
        place += size
    return None


def _exp_golomb(data: bytes) -> int | None:
    bits = "".join(f"{byte:08b}" for byte in data[:8])
    zeros = len(bits) - len(bits.lstrip("0"))
    return int(bits[zeros : 2 * zeros + 1], 2) - 1 if len(bits) > 2 * zeros else None


def _colours(video: Any) -> tuple[int, int]:
    return int(video.color_range), int(video.colorspace)
