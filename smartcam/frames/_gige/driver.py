"""Use GigE Vision cameras as sources of frames."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING, Any, Final

from smartcam.exceptions import (
    CameraBusyError,
    FrameFormatError,
    FrameLostError,
    FrameSourceError,
    OvertriggeredError,
    SmartCamError,
)
from smartcam.frames._driver import FoundSource, FrameDriver
from smartcam.frames._frame import Frame, Moment
from smartcam.frames._gige.assembler import Assembler
from smartcam.frames._gige.camera_url import as_source, find_camera, read_wanted_stream
from smartcam.frames._gige.control import RequestRefusedError
from smartcam.frames._gige.device_features import GigEFeatures
from smartcam.frames._gige.discovery import find_cameras, networks
from smartcam.frames._gige.gvcp import GvcpStatus, Register
from smartcam.frames._gige.gvsp import IP_UDP_BYTES, ImpliedPicture, PayloadType
from smartcam.frames._gige.messages import doubt_about_size
from smartcam.frames._gige.session import GigESession
from smartcam.frames._gige.setup import (
    MAX_NUMBER,
    connect_stream,
    read_exposure,
    read_shape,
    set_locked,
    set_up,
)
from smartcam.frames._gige.stream import Stream, StreamSocket
from smartcam.frames._gige.triggering import (
    EXPOSURE_END_EVENT,
    MISSED_EVENT,
    ArmedTrigger,
    read_settings,
    selected_trigger,
    usable_setting,
)

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Mapping

    from smartcam.frames._address import FrameAddress
    from smartcam.frames._driver import FrameSink, StreamFormat
    from smartcam.frames._events import FrameEvent
    from smartcam.frames._features import FeatureValue
    from smartcam.frames._frame import FrameTrigger
    from smartcam.frames._gige.assembler import PacketCounts
    from smartcam.frames._gige.block import WholePicture
    from smartcam.frames._gige.features import GenicamFeatures
    from smartcam.frames._gige.setup import StreamShape
    from smartcam.frames._gige.triggering import TriggerSetting
    from smartcam.frames._trigger import AwaitedTrigger

MAX_LATE_PICTURE_TIME: Final = 30.0
"""Longest time, seconds, that a restart of the stream waits for the picture of a failed trigger."""


class GigEDriver(FrameDriver):
    """A camera that speaks GigE Vision: ``gige://192.168.0.10?format=Mono8&fps=25``.

    The driver controls the camera from opening to closing. A heartbeat keeps control: a register is
    read three times within the camera's own timeout, even while there are no readers.

    A frame's ``captured`` is the time at which its first packet was read, so ``moment`` is
    ``ARRIVAL``. Its ``duration`` is the exposure time plus one frame time for the readout, as far
    as the camera states them. If the camera chooses the exposure time, it is the frame's
    ``ChunkExposureTime``, or else the longest possible one. ``device_time`` is the camera's own
    clock.

    The URL's parameters are applied in their order:

    - ``format``: a pixel format, by its name in the camera, in PFNC or in V4L2.
    - ``size``: ``WIDTHxHEIGHT``.
    - ``fps``: frames per second, by ``AcquisitionFrameRate``.
    - ``feature.NAME``: the value of any GenICam feature.

    and, anywhere in the URL:

    - ``serial``: the camera's serial number, instead of an address. Without both, the only camera
      on the networks is used.
    - ``packet_size``: bytes of the stream's IP packets, 576 to 16384; ``auto`` (default): the
      largest that passes a test, or the camera's own if it sends no test packets.
    - ``resend=off``: missing packets are not requested.
    - ``trigger``: source of triggers, such as ``Software`` or ``Line1``, each of which causes one
      picture; ``off``: the camera streams freely. Applied after all other parameters.

    Args:
        address: parts of the URL.
    """

    def __init__(self, address: FrameAddress) -> None:
        super().__init__(address)
        self._options = read_wanted_stream(address)
        self._session: GigESession | None = None
        self._shape: StreamShape | None = None
        self._stream: Stream | None = None
        self._sink: FrameSink | None = None
        self._packet_size = 0  # packet size that passed the test
        self._feature_lock = asyncio.Lock()  # held while related features are set
        self._open_lock = asyncio.Lock()
        self._features = GigEFeatures(
            self._current_features, self._feature_changed, self._feature_lock
        )
        self._triggers: list[TriggerSetting] = []
        self._armed: ArmedTrigger | None = None
        self._busy_until = 0.0  # on the clock of time.monotonic()
        self._is_open = False  # whether the driver is open
        self._has_changed_features = False  # whether a feature was set during the stream
        # longest duration before the last change of a feature, and the time until which frames with
        # this duration may come
        self._old_duration = 0.0, 0.0
        self.counts: PacketCounts | None = None
        """Packet counts of the running stream, or of the last one."""

    @classmethod
    async def discover(cls) -> list[FoundSource]:
        """Return the cameras that answer on this machine's networks, within half a second."""
        return [as_source(camera) for camera in await find_cameras(networks())]

    @property
    def name(self) -> str:
        """User-defined name of the camera, or model and serial number; the URL if closed."""
        return self.address.shown if self._session is None else self._session.label

    async def open(self) -> StreamFormat:
        """Take control of the camera, and apply the URL's settings."""
        self._is_open = True
        return (await self._open_session())[1].format

    async def _open_session(self) -> tuple[GigESession, StreamShape]:
        """Return the open session; open a new one if it was lost.

        Raises:
            FrameSourceError: the session cannot be opened, or was closed meanwhile.
        """
        async with self._open_lock:
            if self._session is not None and self._session.loss_error is not None:
                await self._close_session()
            if self._session is None or self._shape is None:
                host, port = await find_camera(self.address, self._options)
                session = await GigESession.open(host, port, self.address.shown)
                try:
                    self._shape = await set_up(session, self._options)
                    self.changed_format = self._shape.format
                    await self._read_triggers(session)
                    if not self._is_open:
                        raise FrameSourceError(f"{self.name}: closed meanwhile", source=self.name)
                except BaseException:
                    await session.close()
                    raise
                self._session = session
            return self._session, self._shape

    async def start(self, sink: FrameSink) -> None:
        """Start the stream, and open the camera if needed."""
        self._is_open = True
        session, shape = await self._open_session()
        self._sink = sink
        try:
            if self._has_changed_features:
                shape = await self._read_shape(session)
            # the picture of an earlier trigger must not come into this stream
            await asyncio.sleep(max(0.0, self._busy_until - time.monotonic()))
            self._stream = await self._open_stream(session, shape)
            session.on_lost = self._end_stream
            await set_locked(session.features, True)
            await session.features.execute("AcquisitionStart")
        except BaseException:
            self._close_stream()
            raise

    async def stop(self) -> None:
        """Stop the stream; the camera stays open."""
        was_streaming, session = self._stream is not None, self._session
        self._close_stream()
        if not was_streaming or session is None or session.loss_error is not None:
            return
        try:
            await session.features.execute("AcquisitionStop")
            await set_locked(session.features, False)
            await session.control.write_register(Register.STREAM_PORT, 0)
        except FrameSourceError as exc:  # the camera is gone; the next start opens it again
            session.loss_error = exc

    async def close(self) -> None:
        """Stop the stream and give up control of the camera."""
        self._is_open = False
        await self._close_session()

    async def _close_session(self) -> None:
        """Stop the stream and give up control of the camera, which may be opened again."""
        try:
            await self.stop()
        finally:
            session, self._session = self._session, None
            if session is not None:
                await session.close()

    # features and triggers

    @property
    def features(self) -> GigEFeatures:
        """The features that the camera's GenICam description lists."""
        return self._features

    async def _current_features(self) -> GenicamFeatures:
        return (await self._open_session())[0].features

    async def _feature_changed(self) -> None:
        """Read the format and the trigger settings, which a feature may have changed."""
        session, shape = await self._open_session()
        if self._stream is not None:
            exposure = await read_exposure(session.features)
            now = time.monotonic()
            longest = max(self._longest_duration(shape, now), exposure.duration)
            self._old_duration = longest, now + 2 * longest
            self._shape = shape._replace(exposure=exposure)
        await self._read_triggers(session)
        self._has_changed_features = True
        if self._stream is None:
            await self._read_shape(session)

    def _longest_duration(self, shape: StreamShape, arrived: float) -> float:
        """Return the longest possible duration, seconds, of a frame that arrived at a time."""
        before, until = self._old_duration
        return max(shape.exposure.duration, before if arrived < until else 0.0)

    async def _read_shape(self, session: GigESession) -> StreamShape:
        shape = self._shape = await read_shape(session)
        self.changed_format, self._has_changed_features = shape.format, False
        return shape

    async def _read_triggers(self, session: GigESession) -> None:
        self._triggers = await read_settings(session.features)
        self.awaited_condition = "; ".join(map(str, self._triggers))

    async def trigger(
        self, pending: AwaitedTrigger, fire: Callable[[], Awaitable[object]] | None
    ) -> None:
        """Trigger one picture by the command TriggerSoftware, or by ``fire``."""
        session, stream = self._session, self._stream
        if session is None or stream is None:
            raise FrameSourceError(f"{self.name}: the camera does not stream", source=self.name)
        async with self._feature_lock:
            setting = await usable_setting(
                self._triggers, session.features, fire is not None, self.name
            )
            await self._watch_exposures(session)
            async with selected_trigger(session.features, setting):
                armed = ArmedTrigger(
                    pending,
                    await session.read_clock(),
                    setting,
                    delay=(await session.features.number("TriggerDelay") or 0.0) / 1e6,
                    is_first=not stream.assembler.counts.pictures,
                )

                def begin() -> None:
                    self._armed = armed
                    pending.record_fire()

                if fire is None:
                    await self._send_software_trigger(session, pending, begin)
        if fire is not None:
            begin()
            await fire()

    async def _send_software_trigger(
        self, session: GigESession, pending: AwaitedTrigger, begin: Callable[[], None]
    ) -> None:
        try:
            await session.features.execute("TriggerSoftware", before_write=begin)
        except RequestRefusedError as exc:
            pending.record_refusal()
            if exc.status != GvcpStatus.BUSY:
                raise
            raise CameraBusyError(f"{self.name}: the camera accepts no trigger now: {exc}") from exc

    def disarm(self) -> None:
        """Assign no more pictures to the last trigger."""
        armed, self._armed = self._armed, None
        if armed is not None and armed.pending.fired is not None and self._shape is not None:
            longest = self._longest_duration(self._shape, time.monotonic())
            busy = min(longest + armed.delay, MAX_LATE_PICTURE_TIME)
            self._busy_until = armed.pending.fired + busy

    def _trigger_of(
        self, picture: WholePicture, session: GigESession
    ) -> FrameTrigger | SmartCamError | None:
        """Return the trigger that caused a picture, or an error if that is not certain."""
        armed = self._armed
        if armed is None or armed.is_older(picture):
            return None
        if doubt := armed.reason_for_doubt(picture, event_ids_match=session.event_ids_match):
            self.disarm()
            return FrameLostError(
                f"{self.name}: the trigger of block {picture.block_id} is uncertain: {doubt}"
            )
        self._armed = None
        session.event_ids_match = session.event_ids_match or picture.block_id in armed.exposed
        return armed.to_frame_trigger(picture, session.ticks_per_second)

    async def watch_events(
        self,
        names: tuple[str, ...],
        take: Callable[[FrameEvent], None],
        ended: Callable[[FrameSourceError | None], None],
    ) -> Callable[[], Coroutine[Any, Any, None]]:
        """Start reports of the camera's events through its message channel."""
        async with self._feature_lock:
            session, _ = await self._open_session()
            stop_watching = await session.events.watch(names, take, ended)

        async def stop() -> None:
            async with self._feature_lock:
                await stop_watching()

        return stop

    async def _watch_exposures(self, session: GigESession) -> None:
        """Start reports of the supported events about triggers."""
        if session.watches_exposures:
            return
        session.watches_exposures = True
        names = [
            name
            for name in await session.events.names()
            if name in (EXPOSURE_END_EVENT, MISSED_EVENT)
        ]
        if names:
            with contextlib.suppress(FrameSourceError):  # triggering works without these events
                await session.events.watch(names, self._on_event, lambda _: None)

    def _on_event(self, event: FrameEvent) -> None:
        armed, session = self._armed, self._session
        if armed is None or session is None:
            return
        ticks = session.ticks_per_second
        event_ticks = None if event.device_time is None else event.device_time * ticks
        if armed.on_event(event, event_ticks) and self._sink is not None:
            self.disarm()
            self._sink.trigger_failed(
                OvertriggeredError(f"{self.name}: its event {event.name} came for this trigger")
            )

    async def _open_stream(self, session: GigESession, shape: StreamShape) -> Stream:
        """Direct the camera's stream to a new socket."""
        try:
            sock = StreamSocket(session.control.local_address, session.control.camera_address)
        except OSError as exc:
            raise FrameSourceError(
                f"{self.name}: no socket for the stream: {exc}", source=self.name
            ) from exc
        try:
            packet_size = self._options.packet_size or self._packet_size
            size = self._packet_size = await connect_stream(session, sock, packet_size)
            resend = session.can_resend and self._options.resend
            assembler = Assembler(
                shape.payload,
                size - IP_UDP_BYTES,
                resend=resend,
                starts_at_one=not self._triggers and not session.has_streamed,
                implied_picture=ImpliedPicture(
                    shape.format_code, shape.format.width, shape.format.height
                ),
            )
            session.has_streamed = True
            self.counts = assembler.counts
            return Stream(sock, assembler, self._on_pictures, session.control.request_resend)
        except BaseException:
            sock.close()
            raise

    def _close_stream(self) -> None:
        """Stop listening; report lost frames."""
        self.disarm()
        stream, self._stream = self._stream, None
        sink, self._sink = self._sink, None
        if self._session is not None:
            self._session.on_lost = lambda _: None
        if stream is not None:
            stream.close()
            if sink is not None and (lost := stream.assembler.take_lost()):
                sink.lost(lost)

    def _end_stream(self, error: FrameSourceError) -> None:
        sink = self._sink
        self._close_stream()
        if sink is not None:
            sink.ended(error)

    def _on_pictures(self, pictures: list[WholePicture]) -> None:
        """Pass pictures to the sink, which may close the stream; note losses for a trigger."""
        stream = self._stream
        sink = None if pictures or self._armed is None else self._sink
        if sink is not None and stream is not None and (lost := stream.assembler.take_lost()):
            self.disarm()
            sink.lost(lost)
            sink.trigger_failed(
                FrameLostError(
                    f"{self.name}: {lost} picture{'s' if lost > 1 else ''} came incomplete while "
                    "a trigger waited for its picture"
                )
            )
        for picture in pictures:
            if self._sink is None or self._shape is None or self._session is None:
                return
            shape, leader = self._shape, picture.leader
            if (leader.pixel_format, leader.width) != (shape.format_code, shape.format.width):
                self._end_stream(self._changed_format_error(picture, shape))
                return
            chunks, remark = self._session.read_chunks(picture)
            if leader.payload_type == PayloadType.CHUNK and (
                doubt := doubt_about_size(picture, chunks)
            ):
                self._end_stream(FrameFormatError(f"{self.name}: {doubt}", source=self.name))
                return
            trigger = self._trigger_of(picture, self._session)
            if isinstance(trigger, SmartCamError):
                self._sink.trigger_failed(trigger)
                trigger = None
            self._sink.frame(
                self._new_frame(picture, shape, self._session, trigger, chunks, remark)
            )
        fault = None if self._stream is None else self._stream.assembler.fault
        if fault is not None:
            error = FrameFormatError(f"{self.name}: its stream: {fault}", source=self.name)
            error.__cause__ = fault
            self._end_stream(error)

    def _changed_format_error(self, picture: WholePicture, shape: StreamShape) -> FrameFormatError:
        leader = picture.leader
        return FrameFormatError(
            f"{self.name}: it streams {shape.format} ({shape.format_code:#010x}), then came "
            f"{leader.width}x{leader.height} of {leader.pixel_format:#010x}",
            source=self.name,
            available=(str(shape.format),),
        )

    def _new_frame(
        self,
        picture: WholePicture,
        shape: StreamShape,
        session: GigESession,
        trigger: FrameTrigger | None,
        chunks: Mapping[str, FeatureValue],
        remark: str,
    ) -> Frame:
        ticks = session.ticks_per_second
        duration = self._longest_duration(shape, picture.arrived_at)
        exposure = chunks.get("ChunkExposureTime") if shape.exposure.is_auto else None
        if isinstance(exposure, (int, float)) and 0 < exposure < MAX_NUMBER:
            duration = exposure / 1e6 + shape.exposure.readout
        return Frame(
            data=picture.data,
            format=shape.format.format,
            width=picture.leader.width,
            height=picture.rows,
            stride=picture.stride,
            captured=picture.arrived_at,
            utc=time.time() - (time.monotonic() - picture.arrived_at),
            moment=Moment.ARRIVAL,
            duration=duration,
            device_time=picture.leader.ticks / ticks if ticks else None,
            sequence=picture.number,
            lost=picture.lost,
            source=session.label,
            remark=remark,
            chunks=chunks,
            trigger=trigger,
        )
