"""A GigE Vision camera through our own control and stream."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from smartcam.exceptions import FrameFormatError, FrameSourceError
from smartcam.frames._driver import FrameDriver
from smartcam.frames._frame import Frame, Moment
from smartcam.frames._gige._assembler import Assembler
from smartcam.frames._gige._gvcp import Register
from smartcam.frames._gige._gvsp import IP_UDP
from smartcam.frames._gige._places import place
from smartcam.frames._gige._session import GigESession
from smartcam.frames._gige._setup import connect, lock, set_up
from smartcam.frames._gige._stream import Stream, StreamSocket

if TYPE_CHECKING:
    from smartcam.frames._address import FrameAddress
    from smartcam.frames._driver import FrameSink, StreamFormat
    from smartcam.frames._gige._assembler import PacketCounts
    from smartcam.frames._gige._block import WholePicture
    from smartcam.frames._gige._setup import StreamShape, WantedStream


class OwnDriver(FrameDriver):
    """A camera through our own GVCP and GVSP; see :class:`.driver.GigEDriver`.

    Args:
        address: what the URL says.
        wanted: the same, read.
    """

    def __init__(self, address: FrameAddress, wanted: WantedStream) -> None:
        super().__init__(address)
        self._wanted = wanted
        self._session: GigESession | None = None
        self._shape: StreamShape | None = None
        self._stream: Stream | None = None
        self._sink: FrameSink | None = None
        self._packet_size = 0  # that was found to come through
        self.counts: PacketCounts | None = None
        """What became of the packets of the stream that is under way, or was the last."""

    @property
    def name(self) -> str:
        """What somebody called the camera, or its model and serial number; closed: the URL."""
        return self.address.shown if self._session is None else self._session.label

    async def open(self) -> StreamFormat:
        """Take control of the camera and set it."""
        host, port = await place(self.address, self._wanted)
        self._session = await GigESession.open(host, port, self.address.shown)
        try:
            self._shape = await set_up(self._session, self._wanted)
        except BaseException:
            await self.close()
            raise
        return self._shape.format

    async def start(self, sink: FrameSink) -> None:
        """Have it stream."""
        if self._session is not None and self._session.lost is not None:
            await self.close()
        if self._session is None:
            await self.open()
        session, shape = self._session, self._shape
        if session is None or shape is None:
            raise FrameSourceError(f"{self.name}: it is not open", source=self.name)
        self._sink = sink
        try:
            self._stream = await self._listen(session, shape)
            session.on_lost = self._end
            await lock(session.features, True)
            await session.features.execute("AcquisitionStart")
        except BaseException:
            self._quiet()
            raise

    async def stop(self) -> None:
        """Have it stream no longer."""
        streamed, session = self._stream is not None, self._session
        self._quiet()
        if not streamed or session is None or session.lost is not None:
            return
        try:
            await session.features.execute("AcquisitionStop")
            await lock(session.features, False)
            await session.control.write_register(Register.STREAM_PORT, 0)
        except FrameSourceError as exc:  # it is gone; the next start opens it anew
            session.lost = exc

    async def close(self) -> None:
        """Give it back."""
        try:
            await self.stop()
        finally:
            session, self._session = self._session, None
            if session is not None:
                await session.close()

    async def _listen(self, session: GigESession, shape: StreamShape) -> Stream:
        """Have the stream come to a socket of ours."""
        try:
            where = StreamSocket(session.control.local_address, session.control.camera_address)
        except OSError as exc:
            raise FrameSourceError(
                f"{self.name}: no socket for it: {exc}", source=self.name
            ) from exc
        try:
            asked = self._wanted.packet_size or self._packet_size
            size = self._packet_size = await connect(session, where, asked)
            resend = session.can_resend and self._wanted.resend
            assembler = Assembler(shape.payload, size - IP_UDP, resend=resend)
            self.counts = assembler.counts
            return Stream(where, assembler, self._take, session.control.resend)
        except BaseException:
            where.close()
            raise

    def _quiet(self) -> None:
        """Listen no longer; what was lost is told."""
        stream, self._stream = self._stream, None
        sink, self._sink = self._sink, None
        if self._session is not None:
            self._session.on_lost = lambda _: None
        if stream is not None:
            stream.close()
            if sink is not None and (lost := stream.assembler.take_lost()):
                sink.lost(lost)

    def _end(self, error: FrameSourceError) -> None:
        sink = self._sink
        self._quiet()
        if sink is not None:
            sink.ended(error)

    def _take(self, pictures: list[WholePicture]) -> None:
        """Take what the stream has; it may be closed by whoever takes a frame."""
        for picture in pictures:
            if self._sink is None or self._shape is None or self._session is None:
                return
            shape, leader = self._shape, picture.leader
            if (leader.pixel_format, leader.width) != (shape.number, shape.format.width):
                self._end(self._changed(picture, shape))
                return
            self._sink.frame(self._frame(picture, shape, self._session))
        fault = None if self._stream is None else self._stream.assembler.fault
        if fault is not None:
            error = FrameFormatError(f"{self.name}: its stream: {fault}", source=self.name)
            error.__cause__ = fault
            self._end(error)

    def _changed(self, picture: WholePicture, shape: StreamShape) -> FrameFormatError:
        leader = picture.leader
        return FrameFormatError(
            f"{self.name}: it streams {shape.format} ({shape.number:#010x}), then came "
            f"{leader.width}x{leader.height} of {leader.pixel_format:#010x}",
            source=self.name,
            available=(str(shape.format),),
        )

    def _frame(self, picture: WholePicture, shape: StreamShape, session: GigESession) -> Frame:
        ticks = session.ticks_per_second
        return Frame(
            data=picture.data,
            format=shape.format.format,
            width=picture.leader.width,
            height=picture.rows,
            stride=picture.stride,
            captured=picture.arrived,
            utc=time.time() - (time.monotonic() - picture.arrived),
            moment=Moment.ARRIVAL,
            duration=shape.duration,
            device_time=picture.leader.ticks / ticks if ticks else None,
            sequence=picture.number,
            lost=picture.lost,
            source=session.label,
        )
