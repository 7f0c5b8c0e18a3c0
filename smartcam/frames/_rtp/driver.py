"""H.264 over RTP as a source of frames."""

from __future__ import annotations

import asyncio
import collections
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

from smartcam.exceptions import FrameFormatError, FrameSourceError, LocalProtocolError
from smartcam.frames._codecs import Codecs
from smartcam.frames._driver import FrameDriver, FrameSink, StreamFormat
from smartcam.frames._frame import Frame, Moment
from smartcam.frames._optional_imports import load
from smartcam.frames._pixels import find_format
from smartcam.frames._rtp.parameters import size_in
from smartcam.frames._rtp.receiver import RtpStatistics, StreamReceiver
from smartcam.frames._rtp.sockets import SocketPair, resolved

if TYPE_CHECKING:
    from smartcam.frames._address import FrameAddress
    from smartcam.frames._h264 import H264Decoder
    from smartcam.frames._rtp.assembling import AccessUnit
    from smartcam.frames._rtp.sockets import Endpoint


WAITING: Final = 16
"""Encoded frames that wait for the decoder; what comes beyond ends with a key frame."""

MOST_FAILED: Final = 10
"""Encoded frames in a row that cannot be decoded: then it ends with the reason."""

KNOWN: Final = ("delay", "name", "payload", "repair", "size", "timeout")


class RtpDriver(FrameDriver):
    """H.264 that somebody sends here by RTP: ``rtp://0.0.0.0:5004?size=640x480``.

    The address is one of this machine, or a multicast group, which is joined. RTCP is on the next
    port.

    ============ =================================================================================
    ``size``     of the pictures; usual: as the stream says, for which opening waits
    ``payload``  type of the packets, usual 96; others are dropped
    ``repair``   seconds that a missing packet is waited for while the sender is asked for it;
                 usual 0.1, 0: not at all
    ``timeout``  seconds without a packet after which the sender counts as gone; usual 5
    ``delay``    longest time from exposure to arrival, seconds; usual 1
    ``name``     of the camera
    ============ =================================================================================

    Only whole pictures come. What is lost is asked for again (generic NACK), and if it does not
    come a key frame is (PLI); a sender that knows neither is waited for until its next refresh.
    ``frame.lost`` counts what was seen to be missing: of a gap in which whole frames vanished, one.

    ``captured`` is when a frame's first packet arrived. As soon as the sender told what its clock
    says (RTCP sender reports), ``device_time`` is the frame's time on it, in seconds since 1970.
    """

    def __init__(self, address: FrameAddress) -> None:
        super().__init__(address)
        said = address.parameters(KNOWN)
        number = address.number
        self._wanted = address.size(said["size"]) if "size" in said else None
        self._plan = _RtpPlan(
            said.get("name") or address.shown.partition("?")[0],
            int(number("payload", said.get("payload", "96"), 0, 127)),
            number("repair", said.get("repair", "0.1"), 0, 1),
            number("timeout", said.get("timeout", "5"), 0.1, 600),
            number("delay", said.get("delay", "1"), 0, 600),
        )
        if not address.host or not 1 <= (address.port or 5004) < 65535:
            raise address.wrong("address", "HOST:PORT with a port below 65535", address.shown)
        self._where = (address.host, address.port or 5004)
        self._endpoint: Endpoint | None = None
        self._stream: _RtpStream | None = None

    @property
    def name(self) -> str:
        """The address, or as the URL says."""
        return self._plan.name

    def statistics(self) -> RtpStatistics:
        """Return what came since it last began to stream."""
        return RtpStatistics() if self._stream is None else self._stream.statistics()

    async def open(self) -> StreamFormat:
        """See that it can be listened to; without a ``size`` wait for a first picture, too.

        Raises:
            FrameSourceError: the port is in use, no such address, or nothing comes in time.
            MissingExtraError: the extra ``video`` is not installed.
        """
        load("av")
        self._endpoint = await resolved(*self._where, self.name)
        if self._wanted is not None:
            self._listening(self._endpoint).close()
            return StreamFormat(find_format("I420"), *self._wanted)
        first = _FirstPicture()
        try:
            await self.start(first)
            async with asyncio.timeout(self._plan.timeout):
                frame = await first.came
        except TimeoutError:
            raise FrameSourceError(
                f"{self.name}: expected a whole picture of H.264 with payload type "
                f"{self._plan.payload} within {self._plan.timeout:g} s, got none: "
                f"{self.statistics()}",
                source=self.name,
            ) from None
        finally:
            await self.stop()
        self._wanted = (frame.width, frame.height)
        return StreamFormat(frame.format, *self._wanted)

    def _listening(self, endpoint: Endpoint) -> SocketPair:
        try:
            return SocketPair.listening(endpoint)
        except OSError as exc:
            raise FrameSourceError(
                f"{self.name}: cannot listen there, and at the next port for RTCP: {exc}",
                source=self.name,
            ) from exc

    async def start(self, sink: FrameSink) -> None:
        """Listen.

        Raises:
            FrameSourceError: the port is in use.
        """
        await self.stop()
        if self._endpoint is None:
            raise LocalProtocolError(f"{self.name} is not open")
        pair = self._listening(self._endpoint)
        self._stream = stream = _RtpStream(self._plan, self._wanted, pair, sink)
        await stream.begin()

    async def stop(self) -> None:
        """Listen no longer."""
        stream, self._stream = self._stream, None
        if stream is not None:
            await stream.end()

    async def close(self) -> None:
        """Have nothing left. Idempotent."""
        await self.stop()


class _FirstPicture(FrameSink):
    """Takes one picture."""

    def __init__(self) -> None:
        self.came: asyncio.Future[Frame] = asyncio.get_running_loop().create_future()

    def frame(self, frame: Frame) -> None:
        if not self.came.done():
            self.came.set_result(frame)

    def lost(self, count: int) -> None:
        pass

    def ended(self, error: FrameSourceError | None) -> None:
        if error is not None and not self.came.done():
            self.came.set_exception(error)
            self.came.exception()  # nobody may wait any longer


class _RtpPlan(NamedTuple):
    """What the URL says."""

    name: str
    payload: int
    repair: float
    timeout: float
    delay: float


class _RtpStream:
    """What runs while the driver streams.

    Args:
        size: of the pictures; None: as the stream says.
    """

    def __init__(
        self, plan: _RtpPlan, size: tuple[int, int] | None, pair: SocketPair, sink: FrameSink
    ) -> None:
        self._plan, self._sink = plan, sink
        self._expected = self._size = size
        self._name = plan.name
        self._loop = asyncio.get_running_loop()
        self._units: collections.deque[tuple[AccessUnit, float | None]] = collections.deque()
        self._came = asyncio.Event()
        self._overflows = 0
        self._skipped = 0  # units that were thrown away since the last one was decoded
        self._anew = True  # that what comes is another stream than what was decoded
        self._missed = self._number = 0
        self._failed = 0  # frames in a row that could not be decoded
        self._shown = False
        self._ended = False
        self._codecs = Codecs(threads=1)
        self._tasks: list[asyncio.Task[None]] = []
        self._receiver = StreamReceiver(pair, plan.payload, plan.repair, self._take, self._gone)

    async def begin(self) -> None:
        """Decode what comes."""
        await self._codecs.__aenter__()
        self._tasks = [asyncio.create_task(self._decode(), name=f"frames of {self._name}")]
        if self._expected is not None:  # who opens it has a timeout of its own, and says more
            watching = asyncio.create_task(self._watch(), name=f"silence of {self._name}")
            self._tasks.append(watching)

    async def end(self) -> None:
        """End all; the sink hears no more."""
        self._ended = True
        self._receiver.close()
        for task in self._tasks:
            task.cancel()
        try:
            if self._tasks:
                await asyncio.wait(self._tasks)
        finally:
            await self._codecs.close()

    def statistics(self) -> RtpStatistics:
        """Return what came."""
        return self._receiver.statistics(self._overflows)

    def _take(self, units: list[AccessUnit]) -> None:
        """Have encoded frames wait for the decoder, all or none."""
        self._units += [(one, self._receiver.utc(one.timestamp)) for one in units]
        if len(self._units) > WAITING:
            self._overflows += 1
            self._skipped += len(self._units)
            self._missed += sum(_frames_lost(one) for one, _ in self._units)
            self._anew |= any(one.begins for one, _ in self._units)
            self._units.clear()
            self._receiver.want_picture()
        self._came.set()

    def _gone(self, reason: str) -> None:
        why = f" ({reason})" if reason else ""
        self._over(FrameSourceError(f"{self._name}: the sender said goodbye{why}"))

    def _over(self, error: FrameSourceError) -> None:
        if not self._ended:
            self._ended = True
            error.source = self._name
            self._sink.ended(error)

    async def _watch(self) -> None:
        receiver, longest = self._receiver, self._plan.timeout
        while (left := receiver.heard + longest - self._loop.time()) > 0:  # noqa: ASYNC110
            await asyncio.sleep(left)
        self._over(FrameSourceError(f"{self._name}: no packet came for {self._plan.timeout:g} s"))

    async def _decode(self) -> None:
        try:
            await self._decode_all()
        except FrameSourceError as error:
            self._over(error)
        except Exception as exc:  # noqa: BLE001 - readers are told, whatever it is
            failed = FrameSourceError(f"{self._name}: {exc!r}")
            failed.__cause__ = exc
            self._over(failed)

    async def _decode_all(self) -> None:
        decoder = self._codecs.h264_decoder()
        while not self._ended:
            if not self._units:
                self._came.clear()
                await self._came.wait()
                continue
            unit, device_time = self._units.popleft()
            missing = _frames_lost(unit) + self._skipped
            self._missed += missing
            if unit.begins or self._anew:
                decoder = self._codecs.h264_decoder()
            elif missing:
                decoder.lost()
            self._skipped, self._anew = 0, False
            picture = await self._decoded(decoder, unit, device_time)
            if picture is not None:
                self._show(picture)
            else:
                self._missed += 1
                self._receiver.want_picture()

    async def _decoded(
        self, decoder: H264Decoder, unit: AccessUnit, device_time: float | None
    ) -> Frame | None:
        size = self._size = size_in(unit.data) or self._size
        if size is None:
            return None
        if self._expected not in (None, size):
            raise FrameFormatError(
                f"{self._name}: expected pictures of {_shown(self._expected)}, as it was opened, "
                f"got {_shown(size)}: open it anew",
                available=(_shown(size),),
            )
        passed = self._loop.time() - unit.arrived
        frame = Frame(
            data=unit.data,
            format=find_format("H264"),
            width=size[0],
            height=size[1],
            stride=0,
            captured=time.monotonic() - passed,
            utc=time.time() - passed,
            moment=Moment.ARRIVAL,
            duration=self._plan.delay,
            device_time=device_time,
            sequence=0,
            source=self._name,
        )
        try:
            decoded = await decoder.decode(frame)
        except FrameFormatError as exc:  # one may be damaged; if all are it is something else
            self._failed += 1
            if self._failed < MOST_FAILED:
                return None
            raise FrameFormatError(f"{self._name}: {exc}", available=exc.available) from exc
        self._failed = 0
        return decoded

    def _show(self, picture: Frame) -> None:
        lost, self._missed = self._missed if self._shown else 0, 0
        self._shown = True
        self._number += 1 + lost
        if not self._ended:
            self._sink.frame(replace(picture, sequence=self._number, lost=lost))


def _frames_lost(unit: AccessUnit) -> int:
    """Return how many frames were lost before one, as far as that was seen."""
    return max(unit.damaged, 1 if unit.lost or unit.begins else 0)


def _shown(size: tuple[int, int] | None) -> str:
    return "any size" if size is None else f"{size[0]}x{size[1]}"
