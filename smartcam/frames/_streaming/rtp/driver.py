"""Use H.264 over RTP as a source of frames."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final, NamedTuple

from smartcam._extras import load
from smartcam.exceptions import FrameSourceError, LocalProtocolError
from smartcam.frames._driver import FrameDriver, FrameSink, StreamFormat
from smartcam.frames._pixels.formats import find_format
from smartcam.frames._streaming.rtp.decoding import DecodingPlan, UnitDecoding
from smartcam.frames._streaming.rtp.receiver import RtpStatistics, StreamReceiver
from smartcam.frames._streaming.rtp.sockets import SocketPair, resolve
from smartcam.frames._streaming.rtp.stream_codecs import H264

if TYPE_CHECKING:
    from smartcam.frames._address import FrameAddress
    from smartcam.frames._frame import Frame
    from smartcam.frames._streaming.rtp.sockets import Endpoint


PARAMETERS: Final = ("delay", "from", "name", "payload", "repair", "size", "timeout")


class RtpDriver(FrameDriver):
    """A stream of H.264 sent to this machine by RTP: ``rtp://0.0.0.0:5004?size=640x480``.

    The address is this machine's, or a multicast group to join. RTCP uses the next port.

    ============ =================================================================================
    ``size``     of the pictures; default: from the stream, for which opening waits
    ``payload``  type of the packets, default 96; others are dropped
    ``repair``   seconds to wait for a missing packet, which is requested from the sender;
                 default 0.1; 0: no repair
    ``timeout``  seconds without a packet after which the sender counts as gone; default 5
    ``delay``    assumed longest time from exposure to arrival, seconds; default 1
    ``from``     only accepted sender; default: any host, one sender at a time
    ``name``     of the camera
    ============ =================================================================================

    Only complete pictures are returned. Lost packets are requested again (generic NACK). If they do
    not come, a key frame is requested (PLI). If the sender supports neither, pictures continue
    after its next refresh. ``frame.lost`` is the estimated number of lost frames.

    ``captured`` is the arrival of a frame's first packet. Once the sender has reported its clock
    (RTCP sender reports), ``device_time`` is the frame's time on that clock, in seconds since 1970.
    """

    def __init__(self, address: FrameAddress) -> None:
        super().__init__(address)
        parameters = address.parameters(PARAMETERS)
        number = address.number
        self._size = address.size(parameters["size"]) if "size" in parameters else None
        self._plan = _RtpPlan(
            parameters.get("name") or address.shown.partition("?")[0],
            int(number("payload", parameters.get("payload", "96"), 0, 127)),
            number("repair", parameters.get("repair", "0.1"), 0, 1),
            number("timeout", parameters.get("timeout", "5"), 0.1, 600),
            number("delay", parameters.get("delay", "1"), 0, 600),
        )
        self._sender_host = parameters.get("from", "")
        if not address.host or not 1 <= (address.port or 5004) < 65535:
            raise address.wrong("address", "HOST:PORT with a port below 65535", address.shown)
        self._host_and_port = (address.host, address.port or 5004)
        self._endpoint: Endpoint | None = None
        self._stream: _RtpStream | None = None

    @property
    def name(self) -> str:
        """Address, or the name in the URL."""
        return self._plan.name

    def statistics(self) -> RtpStatistics:
        """Return the counts of packets since the driver last began to stream."""
        return RtpStatistics() if self._stream is None else self._stream.statistics()

    async def open(self) -> StreamFormat:
        """Check that the port is free; without a ``size``, also wait for a first picture.

        Raises:
            FrameSourceError: the port is in use, the address is not this machine's, or no picture
                comes in time.
            MissingExtraError: the extra ``video`` is not installed.
        """
        load("av")
        self._endpoint = await resolve(*self._host_and_port, self.name)
        if self._sender_host:
            sender = await resolve(self._sender_host, 0, self.name)
            self._plan = self._plan._replace(only_host=sender.host.partition("%")[0])
        if self._size is not None:
            self._open_sockets(self._endpoint).close()
            return StreamFormat(find_format("I420"), *self._size)
        first = FirstPicture()
        try:
            await self.start(first)
            async with asyncio.timeout(self._plan.timeout):
                frame = await first.outcome
        except TimeoutError:
            raise FrameSourceError(
                f"{self.name}: expected a whole picture of H.264 with payload type "
                f"{self._plan.payload} within {self._plan.timeout:g} s, got none: "
                f"{self.statistics()}",
                source=self.name,
            ) from None
        finally:
            await self.stop()
        self._size = (frame.width, frame.height)
        return StreamFormat(frame.format, *self._size)

    def _open_sockets(self, endpoint: Endpoint) -> SocketPair:
        try:
            return SocketPair.open_listening(endpoint)
        except OSError as exc:
            raise FrameSourceError(
                f"{self.name}: cannot listen on this port and, for RTCP, on the next: {exc}",
                source=self.name,
            ) from exc

    async def start(self, sink: FrameSink) -> None:
        """Start listening.

        Raises:
            FrameSourceError: the port is in use.
        """
        await self.stop()
        if self._endpoint is None:
            raise LocalProtocolError(f"{self.name} is not open")
        pair = self._open_sockets(self._endpoint)
        self._stream = stream = _RtpStream(self._plan, self._size, pair, sink)
        await stream.start()

    async def stop(self) -> None:
        """Stop listening."""
        stream, self._stream = self._stream, None
        if stream is not None:
            await stream.stop()

    async def close(self) -> None:
        """Release everything. Idempotent."""
        await self.stop()


class FirstPicture(FrameSink):
    """A sink that waits for one picture."""

    def __init__(self) -> None:
        self.outcome: asyncio.Future[Frame] = asyncio.get_running_loop().create_future()

    def frame(self, frame: Frame) -> None:
        if not self.outcome.done():
            self.outcome.set_result(frame)

    def lost(self, count: int) -> None:
        pass

    def ended(self, error: FrameSourceError | None) -> None:
        if error is not None and not self.outcome.done():
            self.outcome.set_exception(error)
            self.outcome.exception()  # mark the error as retrieved


class _RtpPlan(NamedTuple):
    """The options in a URL."""

    name: str
    payload: int
    repair: float
    timeout: float
    delay: float
    only_host: str = ""  # address of the only accepted host; "": any host


class _RtpStream:
    """The tasks and sockets of a driver while it streams.

    Args:
        size: size of the pictures; None: from the stream.
    """

    def __init__(
        self, plan: _RtpPlan, size: tuple[int, int] | None, pair: SocketPair, sink: FrameSink
    ) -> None:
        self._plan, self._has_size = plan, size is not None
        self._decoding = UnitDecoding(DecodingPlan(plan.name, H264, plan.delay, size), sink)
        self._silence_task: asyncio.Task[None] | None = None
        self._receiver = StreamReceiver(
            pair,
            plan.payload,
            plan.repair,
            self._decoding.queue_units,
            self._on_goodbye,
            (plan.only_host,) * bool(plan.only_host),
        )

    async def start(self) -> None:
        """Start receiving and decoding."""
        await self._decoding.start(self._receiver)
        if self._has_size:  # without a size, open() waits for a picture with a timeout of its own
            name = f"silence of {self._plan.name}"
            self._silence_task = asyncio.create_task(self._watch_silence(), name=name)

    async def stop(self) -> None:
        """Stop; the sink is not called any more."""
        self._receiver.close()
        silence_task, self._silence_task = self._silence_task, None
        if silence_task is not None:
            silence_task.cancel()
        try:
            if silence_task is not None:
                await asyncio.wait([silence_task])
        finally:
            await self._decoding.stop()

    def statistics(self) -> RtpStatistics:
        """Return the counts of packets received."""
        return self._receiver.statistics(self._decoding.overflows)

    def _on_goodbye(self, reason: str) -> None:
        suffix = f" ({reason})" if reason else ""
        self._decoding.report_end(
            FrameSourceError(f"{self._plan.name}: the sender said goodbye{suffix}")
        )

    async def _watch_silence(self) -> None:
        receiver, timeout = self._receiver, self._plan.timeout
        loop = asyncio.get_running_loop()
        while (remaining := receiver.last_packet_at + timeout - loop.time()) > 0:  # noqa: ASYNC110
            await asyncio.sleep(remaining)
        text = f"{self._plan.name}: no packet came for {self._plan.timeout:g} s"
        self._decoding.report_end(FrameSourceError(text))
