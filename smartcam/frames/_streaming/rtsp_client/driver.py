"""Use cameras with RTSP as sources of frames."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from smartcam._extras import load
from smartcam.exceptions import UnsupportedError
from smartcam.frames._driver import FrameDriver, StreamFormat
from smartcam.frames._streaming.rtp.decoding import DecodingPlan, UnitDecoding
from smartcam.frames._streaming.rtp.driver import FirstPicture
from smartcam.frames._streaming.rtp.jpeg import JpegPayloadFormat
from smartcam.frames._streaming.rtp.receiver import RtpStatistics, StreamReceiver
from smartcam.frames._streaming.rtsp_client.conversation import (
    ConversationPlan,
    OtherCodecError,
    RtspConversation,
)
from smartcam.frames._streaming.rtsp_client.parameters import RtspParameters
from smartcam.frames._video.driver import VideoDriver, one_of, tls_context, wanted_format
from smartcam.frames._video.frames import CONVERTIBLE

if TYPE_CHECKING:
    from smartcam.frames._address import FrameAddress
    from smartcam.frames._driver import FrameSink
    from smartcam.frames._features import DeviceFeatures
    from smartcam.frames._streaming.rtp.assembling import PayloadFormat
    from smartcam.frames._streaming.rtsp_client.answers import ServerAnswer
    from smartcam.frames._streaming.rtsp_client.description import VideoTrack


PARAMETERS: Final = ("delay", "elsewhere", "format", "name", "timeout", "transport")


class RtspDriver(FrameDriver):
    """A camera with RTSP: ``rtsp://admin:PASSWORD@camera/stream?channel=1``.

    The driver reads H.264, H.265 and JPEG; FFmpeg reads other codecs. The query belongs to the
    camera, so smartcam's parameters follow ``#``: ``...#transport=udp&timeout=3``.

    ================= =============================================================================
    ``transport``     ``tcp``, over the connection, or ``udp``; default: over the connection, or by
                      UDP if the camera refuses that
    ``timeout``       seconds until PLAY, until the first picture, and without a packet until the
                      camera counts as lost; default 5
    ``format``        ``RGB8``, ``BGR8`` or ``Mono8`` converts the pixels; ``MJPEG`` or ``H264``
                      passes such bytes on unchanged; default: the decoder's format
    ``delay``         assumed longest time from exposure to arrival, seconds; default 1
    ``verify``        of TLS (``rtsps:``): ``no`` trusts any certificate
    ``ca``            of TLS: file with the certificates that are trusted; default: the system's
    ``elsewhere``     ``yes`` follows a redirect to another host or port; default ``no``
    ``name``          of the camera
    ================= =============================================================================

    Only complete pictures are returned, each when its last packet comes. After a loss, pictures
    continue at the next key frame, which is requested, or at the end of a refresh. ``frame.lost``
    counts lost frames.

    ``captured`` is the arrival of a frame's first packet. Once the camera has reported its clock
    (RTCP sender reports), ``device_time`` is the frame's time on that clock, in seconds since 1970.

    The features are parameters of RTSP, by their names in the maker's documents.
    """

    lists_features = False

    def __init__(self, address: FrameAddress) -> None:
        super().__init__(address)
        secure = address.scheme == "rtsps"
        parameters = address.parameters(
            sorted((*PARAMETERS, "ca", "verify")) if secure else PARAMETERS, address.fragment
        )
        number = address.number
        self._name = parameters.get("name") or address.shown.partition("#")[0].partition("?")[0]
        self._delay = number("delay", parameters.get("delay", "1"), 0, 600)
        wanted = wanted_format(address, parameters.get("format"))
        self._format = "" if wanted is None else wanted.name
        transport = one_of(address, "transport", parameters, ("tcp", "udp"))
        transports = (transport,) if "transport" in parameters else ("tcp", "udp")
        follows_elsewhere = one_of(address, "elsewhere", parameters, ("no", "yes")) == "yes"
        timeout = number("timeout", parameters.get("timeout", "5"), 0.1, 600)
        url = address.url.partition("#")[0]
        tls = tls_context(address, parameters)
        if not address.host:
            raise address.wrong("address", "rtsp://HOST/PATH", address.shown)
        self._plan = ConversationPlan(self._name, url, timeout, transports, follows_elsewhere, tls)
        self._size: tuple[int, int] | None = None
        self._correct_markers = 0
        self._playing: _PlayingSession | None = None
        self._ffmpeg_driver: VideoDriver | None = None

    @property
    def name(self) -> str:
        """Address without password, query and fragment, or the name in the URL."""
        return self._name

    @property
    def features(self) -> DeviceFeatures:
        """Parameters of the camera, which RTSP can read and set by name, but not list."""
        return RtspParameters(self._name, self._ask)

    async def _ask(self, method: str, body: bytes) -> ServerAnswer:
        """Send a request on the playing connection, or on a new connection."""
        if self._ffmpeg_driver is not None:
            raise UnsupportedError(f"{self._name}: FFmpeg reads this stream, without parameters")
        if self._playing is not None:
            return await self._playing.conversation.send_parameter(method, body)
        conversation = RtspConversation(self._plan)
        try:
            return await conversation.send_parameter(method, body)
        finally:
            await conversation.close()

    def statistics(self) -> RtpStatistics:
        """Return the counts of packets since the driver last began to stream."""
        return RtpStatistics() if self._playing is None else self._playing.statistics()

    async def open(self) -> StreamFormat:
        """Wait for a picture, then disconnect from the camera.

        Raises:
            FrameFormatError: there is no video.
            FrameSourceError: the camera is missing, refuses, or does not answer.
            MissingExtraError: the extra ``video`` is not installed.
        """
        load("av")
        first = FirstPicture()
        try:
            await self._start(first)
            async with asyncio.timeout(self._plan.timeout):
                frame = await first.outcome
        except OtherCodecError:
            self._ffmpeg_driver = VideoDriver(self.address)
            return await self._ffmpeg_driver.open()
        except TimeoutError:
            raise self._plan.source_error(
                f"expected a whole picture, got none within {self._plan.timeout:g} s: "
                f"{self.statistics()}"
            ) from None
        finally:
            await self.stop()
        self._size = (frame.width, frame.height)
        return StreamFormat(frame.format, *self._size)

    async def start(self, sink: FrameSink) -> None:
        """Connect and play.

        Raises:
            FrameSourceError: the camera is gone, refuses, or does not answer.
        """
        if self._ffmpeg_driver is not None:
            await self._ffmpeg_driver.start(sink)
        else:
            await self._start(sink)

    async def _start(self, sink: FrameSink) -> None:
        await self.stop()
        conversation = RtspConversation(self._plan)
        try:
            await conversation.set_up()
            plan = self._decoding_plan(conversation.track)
            has_size = self._size is not None
            self._playing = _PlayingSession(
                self._plan, plan, conversation, sink, has_size, self._correct_markers
            )
            await self._playing.start()
        except BaseException:
            try:
                await self.stop()
            finally:
                await conversation.close()
            raise

    def _decoding_plan(self, track: VideoTrack) -> DecodingPlan:
        codec = track.codec
        assert codec is not None  # noqa: S101 - others are not chosen
        passes_encoded = self._format in ("H264", "MJPEG")
        actual = codec.format if codec.name != "H265" else codec.name
        if passes_encoded and actual != self._format:
            raise self._plan.source_error(f"expected {self._format}, got {actual}")
        converts = bool(self._format) and not passes_encoded
        return DecodingPlan(
            self._name,
            codec,
            self._delay,
            self._size,
            track.parameter_sets,
            CONVERTIBLE[self._format] if converts else "",
            passes_encoded,
        )

    async def stop(self) -> None:
        """End the session."""
        if self._ffmpeg_driver is not None:
            await self._ffmpeg_driver.stop()
        playing, self._playing = self._playing, None
        if playing is not None:
            self._correct_markers = playing.correct_markers
            await playing.stop()

    async def close(self) -> None:
        """Release everything. Idempotent."""
        await self.stop()


class _PlayingSession:
    """The tasks and the connection of a driver while a camera plays.

    Args:
        detects_silence: whether a pause without packets is an error; :meth:`RtspDriver.open` waits
            for a picture with a timeout of its own instead.
        correct_markers: number of earlier frames of the camera with a correct marker.
    """

    def __init__(
        self,
        plan: ConversationPlan,
        decoding: DecodingPlan,
        conversation: RtspConversation,
        sink: FrameSink,
        detects_silence: bool,
        correct_markers: int,
    ) -> None:
        self._plan, self.conversation, self._detects_silence = plan, conversation, detects_silence
        track = conversation.track
        payload_format: PayloadFormat = decoding.codec.payload_format()
        if isinstance(payload_format, JpegPayloadFormat):
            payload_format.size = track.size
        self._decoding = UnitDecoding(decoding, sink)
        self._silence_task: asyncio.Task[None] | None = None
        self._receiver = StreamReceiver(
            *(
                conversation.channels,
                track.payload_type,
                0.0,
                self._decoding.queue_units,
                self._on_goodbye,
            ),
            only_hosts=conversation.senders,
            payload_format=payload_format,
            is_negotiated=True,
            correct_markers=correct_markers,
        )
        conversation.link.on_end = self._report_end

    async def start(self) -> None:
        """Start playing, and decode the camera's packets."""
        await self._decoding.start(self._receiver)
        await self.conversation.play()
        if self._detects_silence:
            name = f"silence of {self._plan.name}"
            self._silence_task = asyncio.create_task(self._watch_silence(), name=name)

    async def stop(self) -> None:
        """Stop; the sink is not called any more."""
        silence_task, self._silence_task = self._silence_task, None
        if silence_task is not None:
            silence_task.cancel()
        try:
            if silence_task is not None:
                await asyncio.wait([silence_task])
            self._receiver.close()
            await self.conversation.close()
        finally:
            self._receiver.close()
            await self._decoding.stop()

    @property
    def correct_markers(self) -> int:
        """Number of the camera's frames with a correct marker."""
        return self._receiver.correct_markers

    def statistics(self) -> RtpStatistics:
        """Return the counts of packets received."""
        return self._receiver.statistics(self._decoding.overflows)

    def _on_goodbye(self, reason: str) -> None:
        self._report_end(f"the server ended the stream{f' ({reason})' if reason else ''}")

    def _report_end(self, reason: str) -> None:
        self._decoding.report_end(self._plan.source_error(reason))

    async def _watch_silence(self) -> None:
        loop, timeout = asyncio.get_running_loop(), self._plan.timeout
        receiver = self._receiver
        while (remaining := receiver.last_packet_at + timeout - loop.time()) > 0:  # noqa: ASYNC110
            await asyncio.sleep(remaining)
        self._report_end(f"no packet came for {timeout:g} s")
