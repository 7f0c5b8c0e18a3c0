"""Encode H.264 by x264, without a frame of delay, and decode it by FFmpeg."""

from __future__ import annotations

import asyncio
import threading
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Final, Protocol, TypeVar

from smartcam._arguments import check_integer, check_number
from smartcam._extras import load
from smartcam.exceptions import FrameFormatError
from smartcam.frames._codecs.pictures import decode_frame
from smartcam.frames._frame import copy_with
from smartcam.frames._pixels.formats import find_format
from smartcam.frames._video.frames import from_av_frame, reformatted, to_av_frame

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.frames._frame import Frame


T = TypeVar("T")

MAX_WAITING_FRAMES: Final = 32
"""Largest number of encoded frames whose data a decoder keeps until it returns their pictures."""


class RunsWork(Protocol):
    """A callable that runs work in a thread or at once, such as a method of ``Codecs``."""

    def __call__(self, work: Callable[[], T], /) -> Awaitable[T]:
        """Run the work in a thread or at once; return its result."""
        ...


class H264Encoder:
    """Encoder of one stream of H.264, made by :meth:`Codecs.h264_encoder`.

    Each frame is encoded at once into its own bytes. Instead of large key frames, a column of each
    frame is encoded without reference to earlier frames (intra refresh). The parameter sets are
    repeated, so a viewer can join late. Another size or format restarts the stream with a key
    frame. A cancelled call does so too, since its bytes are lost.

    Four pixels share U and V. Y is encoded as the camera sent it, and the stream says its range;
    only RGB is converted, to BT.601 with limited range. A JPEG is decoded to RGB first.
    """

    def __init__(
        self, run: RunsWork, *, fps: float, keyint: int, crf: float, bitrate: int | None
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
        self._call_lock = asyncio.Lock()
        self._codec_lock = (
            threading.Lock()
        )  # the thread of a cancelled call may still use the codec
        self._codec: Any = None
        self._grey: Any = None  # the last grey picture's frame, reusable since x264 copied it
        self._stream_key: tuple[object, ...] = ()
        self._restarts = 0  # number of requests to restart with a key frame
        self._count = 0

    def request_key_frame(self) -> None:
        """Make the next frame a key frame, for a viewer that joins or has lost data."""
        self._restarts += 1

    async def encode(self, frame: Frame) -> Frame:
        """Return a frame of format ``H264`` with all other attributes of the given one.

        Raises:
            FrameFormatError: the frame cannot be encoded; the error says which formats can.
            LocalProtocolError: the codecs are closed.

        Cancellation: safe; the stream restarts with the next frame.
        """
        async with self._call_lock:
            try:
                return await self._run(partial(self._encode, frame, self._restarts))
            except BaseException:
                self.request_key_frame()
                raise

    def _encode(self, frame: Frame, restarts: int) -> Frame:
        with self._codec_lock:
            if frame.format.name == "MJPEG":
                frame = decode_frame(frame, "RGB8")
            video = to_av_frame(frame, self._grey)
            self._grey = video if frame.format.name == "Mono8" else None
            stream_key = (
                restarts,
                video.width,
                video.height,
                video.format.name,
                *_colour_properties(video),
            )
            if stream_key != self._stream_key:
                self._codec = self._new_codec(video)
                self._stream_key = stream_key
            video.pts = self._count
            video.time_base = self._time_base
            self._count += 1
            packets = self._codec.encode(video)
            data = bytes(packets[0]) if len(packets) == 1 else b"".join(map(bytes, packets))
            return copy_with(frame, data=data, format=find_format("H264"), stride=0)

    def _new_codec(self, video: Any) -> Any:
        codec = load("av").CodecContext.create("libx264", "w")
        codec.width, codec.height, codec.pix_fmt = video.width, video.height, video.format.name
        codec.framerate, codec.time_base = self._rate, self._time_base
        codec.color_range, codec.colorspace = _colour_properties(video)
        codec.thread_count = 1
        codec.options = self._options
        if self._bitrate is not None:
            codec.bit_rate = self._bitrate
        return codec


class H264Decoder:
    """Decoder of one stream of H.264, made by :meth:`Codecs.h264_decoder`.

    It returns only whole pictures. The first one follows a key frame, or the end of a refresh that
    began after the decoder had decoded something: FFmpeg may take a refresh for complete although
    its first frame had no reference. A decoder that starts in the middle of a stream returns its
    first picture after at most 3 * ``keyint`` frames of the encoder, a decoder that lost frames
    after at most 2 * ``keyint``, and each at once after :meth:`H264Encoder.request_key_frame`.

    Args:
        run: function that runs the work.
        reorders: whether pictures are sent in another order than they are shown, so that some wait
            for others.
        pixel_format: pixel format of FFmpeg that pictures are converted to; "": no conversion.
    """

    CODEC: ClassVar = "h264"
    """The codec's name in FFmpeg."""
    NAME: ClassVar = "H264"
    """The codec's name in texts."""

    def __init__(self, run: RunsWork, *, reorders: bool = False, pixel_format: str = "") -> None:
        load("av")
        self._run, self._reorders, self._pixel_format = run, reorders, pixel_format
        self._call_lock = asyncio.Lock()
        self._codec_lock = threading.Lock()
        self._codec: Any = None
        self._size = (0, 0)
        self._losses = self._losses_seen = 0
        # number of frames until the picture is whole; 0: it is whole; None: unknown
        self._frames_until_whole: int | None = None
        self._has_decoded = False  # whether something was decoded that a refresh can refer to
        self._pending_frames: dict[int, Frame] = {}
        self._count = 0

    @property
    def has_whole_picture(self) -> bool:
        """True if the decoder has decoded a whole picture since its start or the last loss."""
        return self._frames_until_whole == 0 and self._losses == self._losses_seen

    def note_loss(self) -> None:
        """Tell the decoder that bytes were lost: it returns no picture until one is whole again.

        A decoder cannot detect lost bytes, and would return broken pictures.
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
        async with self._call_lock:
            try:
                return await self._run(partial(self._decode, frame, self._losses))
            except BaseException:
                self.note_loss()
                raise

    def _decode(self, frame: Frame, losses: int) -> Frame | None:
        with self._codec_lock:
            if self._size != (frame.width, frame.height):
                self._restart(frame)
            if losses != self._losses_seen:
                self._losses_seen, self._frames_until_whole = losses, None
            until_whole = self._count_until_whole(bytes(frame.data))
            packet = self._packet(frame)
            try:
                pictures = self._codec.decode(packet)
            except load("av").FFmpegError as exc:
                if self._frames_until_whole is None:
                    return None
                raise self._damaged_error(frame, str(exc)) from exc
            self._has_decoded = True
            frames = [self._to_frame(picture) for picture in pictures]
            if any(picture.is_corrupt for picture in pictures) and until_whole == 0:
                raise self._damaged_error(frame, "a picture with holes")
            return frames[-1] if frames and until_whole == 0 else None

    def _restart(self, frame: Frame) -> None:
        self._codec = codec = load("av").CodecContext.create(self.CODEC, "r")
        codec.thread_count = 1
        self._size = (frame.width, frame.height)
        max_pixels = (frame.width + 64) * (frame.height + 64)
        codec.options = {
            "max_pixels": str(max_pixels),
            "err_detect": "explode",  # half a picture must be refused
        } | ({} if self._reorders else {"flags": "low_delay"})
        self._pending_frames.clear()
        self._frames_until_whole, self._has_decoded = None, False

    def _count_until_whole(self, data: bytes) -> int | None:
        """Return the number of frames until the picture is whole; None if that is not known."""
        if self._frames_until_whole == 0:
            return 0
        is_key_frame, refresh = self._random_access_point(data)
        if is_key_frame:
            self._frames_until_whole = 0
        elif self._frames_until_whole is not None:
            self._frames_until_whole -= 1
        elif refresh is not None and self._has_decoded:
            self._frames_until_whole = refresh
        return self._frames_until_whole

    def _random_access_point(self, data: bytes) -> tuple[bool, int | None]:
        return random_access_point(data)

    def _packet(self, frame: Frame) -> Any:
        packet = load("av").Packet(frame.data)
        self._count += 1
        packet.pts = self._count
        self._pending_frames[self._count] = frame
        if len(self._pending_frames) > MAX_WAITING_FRAMES:
            del self._pending_frames[next(iter(self._pending_frames))]
        return packet

    def _to_frame(self, picture: Any) -> Frame:
        frame = self._pending_frames.pop(picture.pts)
        picture = reformatted(picture, self._pixel_format) if self._pixel_format else picture
        pixels = from_av_frame(picture, keep_planes=True)
        if (pixels.width, pixels.height) != (frame.width, frame.height):
            raise self._damaged_error(frame, f"a picture of {pixels.width}x{pixels.height}")
        return copy_with(frame, data=pixels.data, format=pixels.format, stride=pixels.stride)

    def _damaged_error(self, frame: Frame, actual: str) -> FrameFormatError:
        return FrameFormatError(
            f"{frame.source}: {self.NAME} {frame.width}x{frame.height}: expected a whole encoded "
            f"frame, got {len(frame.data)} bytes: {actual}",
            source=frame.source,
        )


SLICES, KEY_SLICE, SEI, RECOVERY_POINT = (1, 2, 3, 4), 5, 6, 6
"""Types of NAL units (ITU-T H.264, table 7-1), and one type of message in an SEI unit (annex D)."""


def random_access_point(data: bytes) -> tuple[bool, int | None]:
    """Return True for a key frame, and the number of frames until a refresh is complete.

    The number is None if no refresh begins with the frame.
    """
    refresh = None
    offset = data.find(b"\0\0\1")
    while 0 <= offset < len(data) - 3:
        unit_type, next_start = data[offset + 3] & 0x1F, data.find(b"\0\0\1", offset + 3)
        if unit_type == KEY_SLICE or unit_type in SLICES:
            return unit_type == KEY_SLICE, refresh
        if unit_type == SEI:
            end = next_start if next_start >= 0 else len(data)
            frames_to_recovery = _recovery_frame_count(
                data[offset + 4 : end].replace(b"\0\0\3", b"\0\0")
            )
            refresh = refresh if frames_to_recovery is None else frames_to_recovery
        offset = next_start
    return False, refresh


def _recovery_frame_count(messages: bytes) -> int | None:
    """Return recovery_frame_cnt from the messages of an SEI unit."""
    offset = 0
    while offset + 2 <= len(messages) and messages[offset] != 0x80:
        numbers = []
        for _ in range(2):  # type and size: each is a sum of bytes of 255 and a last smaller one
            number = 0
            while offset < len(messages) and messages[offset] == 0xFF:
                number, offset = number + 0xFF, offset + 1
            if offset == len(messages):
                return None
            numbers.append(number + messages[offset])
            offset += 1
        payload_type, size = numbers
        if payload_type == RECOVERY_POINT:
            return _exp_golomb(messages[offset : offset + size])
        offset += size
    return None


def _exp_golomb(data: bytes) -> int | None:
    bits = "".join(f"{byte:08b}" for byte in data[:8])
    zeros = len(bits) - len(bits.lstrip("0"))
    return int(bits[zeros : 2 * zeros + 1], 2) - 1 if len(bits) > 2 * zeros else None


def _colour_properties(video: Any) -> tuple[int, int]:
    return int(video.color_range), int(video.colorspace)
