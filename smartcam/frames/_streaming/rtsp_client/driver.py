"""Use cameras with RTSP as sources of frames."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from smartcam._extras import load
from smartcam.exceptions import UnsupportedError
from smartcam.frames._driver import FrameDriver, StreamFormat
from smartcam.frames._streaming.rtp.decoding import DecodingPlan, UnitDecoding
from smartcam.frames._streaming.rtp.driver import FirstPicture
from smartcam.frames._streaming.rtp.jpeg import JpegUnits
from smartcam.frames._streaming.rtp.receiver import RtpStatistics, StreamReceiver
from smartcam.frames._streaming.rtsp_client.conversation import (
    ConversationPlan,
    OtherEncodingError,
    RtspConversation,
)
from smartcam.frames._streaming.rtsp_client.parameters import RtspParameters
from smartcam.frames._video.driver import VideoDriver, one_of, tls_of, wanted_format
from smartcam.frames._video.frames import CONVERTIBLE

if TYPE_CHECKING:
    from smartcam.frames._address import FrameAddress
    from smartcam.frames._driver import FrameSink
    from smartcam.frames._features import DeviceFeatures
    from smartcam.frames._streaming.rtp.assembling import UnitKind
    from smartcam.frames._streaming.rtsp_client.answers import ServerAnswer
    from smartcam.frames._streaming.rtsp_client.description import VideoTrack


KNOWN: Final = ("delay", "elsewhere", "format", "name", "timeout", "transport")


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
    ``delay``         longest time from exposure to arrival, seconds; default 1
    ``verify``        of TLS (``rtsps:``): ``no`` trusts any certificate
    ``ca``            of TLS: file with the certificates that are trusted; default: the system's
    ``elsewhere``     ``yes`` follows a redirect to another host or port; default ``no``
    ``name``          of the camera
    ================= =============================================================================

    Only complete pictures are returned, each with its last packet. After a loss, pictures continue
    at the next key frame, which is requested, or at the end of a refresh. ``frame.lost`` counts
    lost frames.

    ``captured`` is the arrival of a frame's first packet. Once the camera has reported its clock
    (RTCP sender reports), ``device_time`` is the frame's time on that clock, in seconds since 1970.

    The features are parameters of RTSP, by their names in the maker's documents.
    """

    lists_features = False

    def __init__(self, address: FrameAddress) -> None:
        super().__init__(address)
        secure = address.scheme == "rtsps"
        given = address.parameters(
            sorted((*KNOWN, "ca", "verify")) if secure else KNOWN, address.fragment
        )
        number = address.number
        self._name = given.get("name") or address.shown.partition("#")[0].partition("?")[0]
        self._delay = number("delay", given.get("delay", "1"), 0, 600)
        wanted = wanted_format(address, given.get("format"))
        self._format = "" if wanted is None else wanted.name
        transport = one_of(address, "transport", given, ("tcp", "udp"))
        transports = (transport,) if "transport" in given else ("tcp", "udp")
        elsewhere = one_of(address, "elsewhere", given, ("no", "yes")) == "yes"
        timeout = number("timeout", given.get("timeout", "5"), 0.1, 600)
        url = address.url.partition("#")[0]
        tls = tls_of(address, given)
        if not address.host:
            raise address.wrong("address", "rtsp://HOST/PATH", address.shown)
        self._plan = ConversationPlan(self._name, url, timeout, transports, elsewhere, tls)
        self._size: tuple[int, int] | None = None
        self._proofs = 0
        self._playing: _Playing | None = None
        self._other: VideoDriver | None = None

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
        if self._other is not None:
            raise UnsupportedError(f"{self._name}: FFmpeg reads this stream, without parameters")
        if self._playing is not None:
            return await self._playing.conversation.parameter(method, body)
        conversation = RtspConversation(self._plan)
        try:
            return await conversation.parameter(method, body)
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
        except OtherEncodingError:
            self._other = VideoDriver(self.address)
            return await self._other.open()
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
        if self._other is not None:
            await self._other.start(sink)
        else:
            await self._start(sink)

    async def _start(self, sink: FrameSink) -> None:
        await self.stop()
        conversation = RtspConversation(self._plan)
        try:
            await conversation.set_up()
            plan = self._decoding(conversation.track)
            watched = self._size is not None
            self._playing = _Playing(self._plan, plan, conversation, sink, watched, self._proofs)
            await self._playing.begin()
        except BaseException:
            try:
                await self.stop()
            finally:
                await conversation.close()
            raise

    def _decoding(self, track: VideoTrack) -> DecodingPlan:
        coding = track.coding
        assert coding is not None  # noqa: S101 - others are not chosen
        passed_on = self._format in ("H264", "MJPEG")
        comes = coding.format if coding.name != "H265" else coding.name
        if passed_on and comes != self._format:
            raise self._plan.source_error(f"expected {self._format}, got {comes}")
        to = "" if passed_on or not self._format else CONVERTIBLE[self._format]
        name, sets = self._name, track.sets
        return DecodingPlan(name, coding, self._delay, self._size, sets, to, passed_on)

    async def stop(self) -> None:
        """End the session."""
        if self._other is not None:
            await self._other.stop()
        playing, self._playing = self._playing, None
        if playing is not None:
            self._proofs = playing.proofs
            await playing.end()

    async def close(self) -> None:
        """Release everything. Idempotent."""
        await self.stop()


class _Playing:
    """The tasks and the connection of a driver while a camera plays.

    Args:
        watched: whether silence is an error; ``open`` has its own timeout with a fuller error.
        proofs: number of earlier frames of the camera with a right marker.
    """

    def __init__(
        self,
        plan: ConversationPlan,
        decoding: DecodingPlan,
        conversation: RtspConversation,
        sink: FrameSink,
        watched: bool,
        proofs: int,
    ) -> None:
        self._plan, self.conversation, self._watched = plan, conversation, watched
        track = conversation.track
        kind: UnitKind = decoding.coding.kind()
        if isinstance(kind, JpegUnits):
            kind.size = track.size
        self._decoding = UnitDecoding(decoding, sink)
        self._watching: asyncio.Task[None] | None = None
        self._receiver = StreamReceiver(
            *(
                conversation.channels,
                track.payload_type,
                0.0,
                self._decoding.take,
                self._said_goodbye,
            ),
            only=conversation.senders,
            kind=kind,
            agreed=True,
            proofs=proofs,
        )
        conversation.link.on_end = self._over

    async def begin(self) -> None:
        """Start playing, and decode the camera's packets."""
        await self._decoding.begin(self._receiver)
        await self.conversation.play()
        if self._watched:
            watching = self._watch()
            self._watching = asyncio.create_task(watching, name=f"silence of {self._plan.name}")

    async def end(self) -> None:
        """Stop; the sink is not called any more."""
        watching, self._watching = self._watching, None
        if watching is not None:
            watching.cancel()
        try:
            if watching is not None:
                await asyncio.wait([watching])
            self._receiver.close()
            await self.conversation.close()
        finally:
            self._receiver.close()
            await self._decoding.end()

    @property
    def proofs(self) -> int:
        """Number of the camera's frames with a right marker."""
        return self._receiver.proofs

    def statistics(self) -> RtpStatistics:
        """Return the counts of packets received."""
        return self._receiver.statistics(self._decoding.overflows)

    def _said_goodbye(self, reason: str) -> None:
        self._over(f"the server ended the stream{f' ({reason})' if reason else ''}")

    def _over(self, why: str) -> None:
        self._decoding.over(self._plan.source_error(why))

    async def _watch(self) -> None:
        loop, longest = asyncio.get_running_loop(), self._plan.timeout
        while (left := self._receiver.last_packet_at + longest - loop.time()) > 0:  # noqa: ASYNC110
            await asyncio.sleep(left)
        self._over(f"no packet came for {longest:g} s")
