"""Define a source of frames, whose device streams while there are readers."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
import warnings
import weakref
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from smartcam._arguments import (
    check_age,
    check_callable,
    check_choice,
    check_clock_seconds,
    check_number,
    check_seconds,
    check_seconds_or_none,
)
from smartcam._finishing import finish
from smartcam._user_code import ENDS_PROGRAM
from smartcam.exceptions import (
    FrameFormatError,
    FrameSourceError,
    LocalProtocolError,
)
from smartcam.frames._clocks import DeviceClock
from smartcam.frames._driver import FrameDriver, FrameSink
from smartcam.frames._events import FrameEvents
from smartcam.frames._features import FrameFeatures
from smartcam.frames._frame import copy_with
from smartcam.frames._reader import FRAME_TIMEOUT, FrameReader
from smartcam.frames._trigger import TriggerQueue

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine
    from types import EllipsisType
    from typing import Literal, Self

    from smartcam.exceptions import SmartCamError
    from smartcam.frames._clocks import ClockStatistics
    from smartcam.frames._driver import StreamFormat
    from smartcam.frames._events import FrameEvent
    from smartcam.frames._features import DeviceFeatures
    from smartcam.frames._frame import Frame
    from smartcam.geometry import CameraModel


_log = logging.getLogger(__name__)

MAX_LINGER = 3600.0
"""Longest time, seconds, that a device may stream after its last reader has gone."""


@dataclass(frozen=True, slots=True)
class SourceStatistics:
    """Counts of a source since it was opened.

    Attributes:
        streaming: whether the device streams now.
        readers: number of current readers.
        started: number of starts of the device's stream.
        frames: number of frames that came, with or without a reader, or were skipped on the way.
        lost: number of frames lost in the camera or on the way.
        ahead: number of frames whose time was later than their arrival; the arrival replaced it.
        clock: drift and jumps of the camera's own clock; None: no clock.
    """

    streaming: bool
    readers: int
    started: int
    frames: int
    lost: int
    ahead: int
    clock: ClockStatistics | None


class FrameSource(FrameSink):
    """Frames of one camera, for any number of readers; ``async with`` opens and closes it.

    The device streams only while there are readers. Made by :func:`smartcam.frames.open`.

    Args:
        driver: driver of the device, which then belongs to the source.
        camera_info: lens of the camera, which is added to every frame; None: the driver's.
        timeout: seconds that an iteration waits for a frame; None: without limit.
        stall: seconds without a frame after which a streaming device counts as stuck: readers get a
            :exc:`~smartcam.FrameSourceError`. None: never, as for triggered devices.
        linger: seconds for which the device streams after its last reader has gone.

    Raises:
        ConfigurationError: a time that is not valid.
    """

    def __init__(
        self,
        driver: FrameDriver,
        *,
        camera_info: CameraModel | None = None,
        timeout: float | None = FRAME_TIMEOUT,
        stall: float | None = 5.0,
        linger: float = 0.0,
    ) -> None:
        self._timeout = check_seconds_or_none(timeout, "timeout", exclusive=True)
        self._stall = check_seconds_or_none(stall, "stall", exclusive=True)
        self._linger = check_number(linger, "linger", 0, MAX_LINGER, unit="seconds")
        self._driver = driver
        self._camera_info = camera_info
        self._readers: set[weakref.ref[FrameReader]] = set()
        self._format: StreamFormat | None = None
        self._loop: asyncio.AbstractEventLoop | None = None  # while the source is open
        self._task: asyncio.Task[None] | None = None  # while it streams or lingers
        self._state_changed = asyncio.Event()  # set when readers change, or the driver ends
        self._reader_advanced = asyncio.Event()  # set when a reader takes a frame or is closed
        self._waits_for_readers = False  # whether the driver waits for readers
        self._is_streaming = False
        # error with which the driver ended, or None, in a tuple; None: it has not ended
        self._end_cause: tuple[FrameSourceError | None] | None = None
        self._frames = self._lost = self._started = self._ahead = 0
        self._clock: DeviceClock | None = None
        self._newest_frame: Frame | None = None
        self._must_restart = False  # whether to restart the stream
        self._triggers = TriggerQueue(self)
        self._last_arrival = self._idle_since = 0.0  # on the loop's clock

    @property
    def name(self) -> str:
        """The camera's name."""
        return self._driver.name

    @property
    def driver(self) -> FrameDriver:
        """The device's driver, for driver-specific functions."""
        return self._driver

    @property
    def features(self) -> FrameFeatures:
        """Features of the device: ``await source.features["ExposureTime"].set(5000.0)``.

        GigE Vision cameras have the features of their GenICam description, V4L2 devices their
        controls, and RTSP cameras parameters by names from the maker's documents.
        """
        return FrameFeatures(self._device_features, self._feature_changed)

    @property
    def has_features(self) -> bool:
        """True if devices of this kind can list their features."""
        driver = type(self._driver)
        return driver.lists_features and driver.features is not FrameDriver.features

    def events(self, *names: str, size: int = 1000, timeout: float | None = None) -> FrameEvents:
        """Return the events that the device reports, such as ``ExposureEnd``; see the class.

        Args:
            *names: names of the events in ``EventSelector``.
            size: number of events that are kept for a slow reader.
            timeout: seconds that an iteration waits for an event; None: without limit.

        Raises:
            ConfigurationError: there is no name, or a number is not valid.
        """
        return FrameEvents(self, names, size, timeout)

    async def watch_events(
        self,
        names: tuple[str, ...],
        take: Callable[[FrameEvent], None],
        ended: Callable[[FrameSourceError | None], None],
    ) -> Callable[[], Coroutine[Any, Any, None]]:
        """Start reports of events, as in :meth:`FrameDriver.watch_events`.

        Raises:
            LocalProtocolError: the source is not open.
            FrameSourceError: the device has no such event, or does not answer.
        """
        if self._loop is None:
            raise LocalProtocolError(f"{self.name} is not open: use `async with`")
        return await self._driver.watch_events(names, take, ended)

    def _device_features(self) -> DeviceFeatures:
        if self._loop is None:
            raise LocalProtocolError(f"{self.name} is not open: use `async with`")
        return self._driver.features

    async def _feature_changed(self) -> None:
        """Update the stream's format after a feature was set."""
        if self._loop is not None and self._driver.changed_format is not None:
            self._format = self._driver.changed_format
        self._state_changed.set()

    @property
    def format(self) -> StreamFormat:
        """Format of the stream.

        Raises:
            LocalProtocolError: the source is not open.
        """
        if self._format is None:
            raise LocalProtocolError(f"{self.name} is not open: use `async with`")
        return self._format

    def statistics(self) -> SourceStatistics:
        """Return the counts of the source since it was opened."""
        return SourceStatistics(
            self._is_streaming,
            len(self._readers),
            self._started,
            self._frames,
            self._lost,
            self._ahead,
            None if self._clock is None else self._clock.statistics(),
        )

    async def __aenter__(self) -> Self:
        """Open the device; it does not stream yet.

        Raises:
            FrameSourceError: the device does not exist, is in use, or does not support the URL.

        Cancellation: nothing stays open.
        """
        if self._loop is not None:
            raise LocalProtocolError(f"{self.name} is open already")
        try:
            self._format = self._checked_format(await self._driver.open())
        except BaseException:
            await self._driver.close()
            raise
        self._loop = asyncio.get_running_loop()
        return self

    def _start_task(self, loop: asyncio.AbstractEventLoop) -> None:
        """Start the task that streams for readers."""
        self._task = loop.create_task(self._stream_for_readers(), name=f"frames of {self.name}")
        self._task.add_done_callback(self._on_task_done)

    def _on_task_done(self, task: asyncio.Task[None]) -> None:
        """Restart for new readers; end the readers of a cancelled task."""
        if task is not self._task or self._loop is None:
            return
        self._task = None
        if task.cancelled() or task.exception() is not None:
            self._end_readers(
                FrameSourceError(f"{self.name}: its task was cancelled", source=self.name)
            )
        elif self._readers:
            self._start_task(self._loop)

    def _checked_format(self, stream_format: StreamFormat) -> StreamFormat:
        size = (stream_format.width, stream_format.height)
        if self._camera_info is not None and tuple(self._camera_info.size) != size:
            raise FrameFormatError(
                f"{self.name}: expected frames of camera_info's size, "
                f"{self._camera_info.size[0]}x{self._camera_info.size[1]}, got {stream_format}",
                source=self.name,
                available=(str(stream_format),),
            )
        return stream_format

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Stop streaming and release the device; readers end. Idempotent.

        Cancellation: the device is released first, within the bounds of its driver.
        """
        loop, self._loop = self._loop, None
        task, self._task, self._format = self._task, None, None
        for reader in self._live_readers():
            reader.close()
        if loop is None:
            return
        if task is not None:
            task.cancel()
        await finish(partial(self._release_device, task))

    async def _release_device(self, task: asyncio.Task[None] | None) -> None:
        """Close the device after the task, even if the task never began."""
        if task is not None:
            await asyncio.wait({task})
        await self._driver.close()
        if task is not None and not task.cancelled() and (error := task.exception()) is not None:
            raise error

    def __del__(self) -> None:
        loop: asyncio.AbstractEventLoop | None = getattr(self, "_loop", None)
        if loop is None:
            return
        warnings.warn(f"{self!r} was not closed", ResourceWarning, source=self, stacklevel=2)
        with contextlib.suppress(RuntimeError):  # the loop is closed
            loop.call_soon_threadsafe(_close, loop, self._driver)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name}>"

    def reader(self, *, timeout: float | EllipsisType | None = ...) -> FrameReader:
        """Return a new reader; the device streams from now on.

        Args:
            timeout: seconds that an iteration waits for a frame; None: without limit; omitted: the
                source's.

        Raises:
            LocalProtocolError: the source is not open.
        """
        if timeout is ...:
            timeout = self._timeout
        seconds = check_seconds_or_none(timeout, "timeout")
        if self._loop is None:
            raise LocalProtocolError(f"{self.name} is not open: use `async with`, then read")
        reader = FrameReader(self, seconds)
        self.attach(reader)
        return reader

    def attach(self, reader: FrameReader) -> None:
        """Pass frames to a reader from now on."""
        self._readers.add(weakref.ref(reader, self._on_reader_gone))
        self._state_changed.set()
        if self._task is None and self._loop is not None:
            self._start_task(self._loop)

    def __aiter__(self) -> FrameReader:
        return self.reader()

    async def newest(self, *, max_age: float = 1.0, timeout: float | None = FRAME_TIMEOUT) -> Frame:
        """Return the newest frame, as :meth:`FrameReader.newest` does.

        For frequent calls, keep a reader, or open the source with ``linger``: otherwise the device
        starts its stream for each call.
        """
        max_age = check_age(max_age, "max_age")
        timeout = check_seconds_or_none(timeout, "timeout")
        async with self.reader() as reader:
            if self._newest_frame is not None and self._newest_frame.age <= max_age:
                return self._newest_frame
            return await reader.newest(max_age=max_age, timeout=timeout)

    async def after(self, moment: float, *, timeout: float | None = FRAME_TIMEOUT) -> Frame:
        """Return the first frame exposed after a moment, as :meth:`FrameReader.after` does."""
        moment = check_clock_seconds(moment, "moment")
        timeout = check_seconds_or_none(timeout, "timeout")
        async with self.reader() as reader:
            if self._newest_frame is not None and self._newest_frame.began >= moment:
                return self._newest_frame
            return await reader.after(moment, timeout=timeout)

    async def trigger(
        self,
        *,
        timeout: float = FRAME_TIMEOUT,
        when_busy: Literal["wait", "refuse"] = "wait",
        fire: Callable[[], Awaitable[object]] | None = None,
    ) -> Frame:
        """Trigger the device once, and return the picture that this trigger caused.

        The result is never an earlier picture, or the picture of an earlier trigger: after a
        cancelled trigger or a timeout, the stream is restarted. :attr:`Frame.trigger` gives the
        evidence. The device streams for the trigger; for frequent triggers, keep a reader, or open
        the source with ``linger``.

        Args:
            timeout: seconds for the whole call: waiting for earlier triggers, the start of the
                stream, the trigger and its picture.
            when_busy: whether to wait for a pending trigger, or to raise.
            fire: coroutine function that sets the line of ``TriggerSource``; None: the device is
                triggered by its command ``TriggerSoftware``.

        Raises:
            UnsupportedError: a source of this kind has no trigger.
            NotRunningError: the device is not set for this trigger; the text names the settings.
            CameraBusyError: another trigger is pending, and ``when_busy`` is ``refuse``; or the
                device accepts no trigger now.
            OvertriggeredError: the device reports that it missed the trigger.
            FrameLostError: the picture was certainly or possibly lost on the way.
            TriggerTimeoutError: no picture came within ``timeout``.
            FrameSourceError: the device does not stream, or was lost.

        Cancellation: the source continues; a late picture is passed only to readers.
        """
        seconds = check_seconds(timeout, "timeout", "trigger", exclusive=True)
        check_choice(when_busy, "when_busy", ("wait", "refuse"), "trigger")
        if fire is not None:
            check_callable(fire, "fire", "trigger")
        if self._loop is None:
            raise LocalProtocolError(f"{self.name} is not open: use `async with`, then trigger")
        return self._with_lens(await self._triggers.trigger(seconds, when_busy == "refuse", fire))

    def _with_lens(self, frame: Frame) -> Frame:
        """Return a frame with the source's lens added."""
        if self._camera_info is None or frame.camera_info is not None:
            return frame
        return copy_with(frame, camera_info=self._camera_info)

    async def wait_until_streaming(self, reader: FrameReader, *, anew: bool) -> None:
        """Wait until the device streams; with ``anew`` restart the stream first.

        Raises:
            FrameSourceError: the device does not begin to stream.
        """
        if anew and self._is_streaming:
            self._must_restart = True
            self._state_changed.set()
        while not self._is_streaming or self._must_restart:
            reader.check_not_ended()
            self._state_changed.clear()
            await self._state_changed.wait()

    # called by the driver

    def trigger_failed(self, error: SmartCamError) -> None:
        """Fail the pending trigger, whose picture will not come."""
        self._triggers.fail_pending(error)

    def frame(self, frame: Frame) -> None:
        """Pass a frame of the driver to the readers."""
        if frame.lost:
            self.lost(frame.lost)
        self._last_arrival = asyncio.get_running_loop().time()
        frame = self._with_lens(self._with_host_time(frame, time.monotonic()))
        self._frames += 1
        self._newest_frame = frame
        if frame.trigger is not None:
            self._triggers.on_frame(frame)
        for reader in self._live_readers():
            reader._offer(frame)  # noqa: SLF001 - its own reader

    def _with_host_time(self, frame: Frame, now: float) -> Frame:
        """Return a frame with its time on the host's clock, not later than now."""
        captured = frame.captured
        if frame.device_time is not None and not self._driver.sets_captured:
            if self._clock is None:
                self._clock = DeviceClock()
            jumps = self._clock.jumps
            captured = self._clock.host_time(frame.device_time, captured)
            if self._clock.jumps > jumps:
                _log.warning(
                    "%s: the camera's clock was reset, at frame %d", self.name, frame.sequence
                )
        if captured > now:  # a capture cannot be in the future
            self._ahead += 1
            captured = now
        if captured == frame.captured:
            return frame
        shift = captured - frame.captured
        return copy_with(frame, captured=captured, utc=frame.utc + shift)

    def lost(self, count: int) -> None:
        """Count lost frames."""
        self._lost += count
        for reader in self._live_readers():
            reader._miss(count)  # noqa: SLF001

    def skipped(self, count: int) -> None:
        """Count frames that the far end of a link replaced by newer ones."""
        self._frames += count
        for reader in self._live_readers():
            reader._skip(count)  # noqa: SLF001

    def ended(self, error: FrameSourceError | None) -> None:
        """Record that there will be no more frames."""
        self._end_cause = (error,)
        self._state_changed.set()

    async def wait_taken(self) -> None:
        """Wait until every reader has taken the last frame; this time does not count as a stall."""
        self._waits_for_readers = True
        try:
            while any(reader._next is not None for reader in self._live_readers()):  # noqa: SLF001
                self._reader_advanced.clear()
                await self._reader_advanced.wait()
        finally:
            self._waits_for_readers = False
            self._last_arrival = asyncio.get_running_loop().time()

    def _live_readers(self) -> list[FrameReader]:
        return [reader for reference in self._readers if (reader := reference()) is not None]

    def _on_reader_gone(self, reference: weakref.ref[FrameReader]) -> None:
        self._readers.discard(reference)
        if not self._readers and self._loop is not None:
            self._idle_since = self._loop.time()
        self._state_changed.set()
        self._reader_advanced.set()

    def _remove_reader(self, reader: FrameReader) -> None:
        self._on_reader_gone(weakref.ref(reader))

    async def _stream_for_readers(self) -> None:
        """Stream while there are readers."""
        while self._readers:
            try:
                await self._stream_once()
            except FrameSourceError as error:
                self._end_readers(error)
            except asyncio.CancelledError:
                raise
            except ENDS_PROGRAM:
                raise
            except BaseException as error:  # noqa: BLE001 - a driver may be a plug-in
                _log.exception("%s: its driver failed", self.name)
                self._end_readers(FrameSourceError(f"{self.name}: {error!r}", source=self.name))

    async def _stream_once(self) -> None:
        """Stream until there are no readers, or the device ends."""
        self._end_cause = None
        self._newest_frame = None
        self._must_restart = False
        try:
            await self._driver.start(self)
            self._triggers.picture_may_come = False
            self._is_streaming = True
            self._started += 1
            await self._feature_changed()
            self._last_arrival = asyncio.get_running_loop().time()
            await self._wait_for_end()
        finally:
            self._is_streaming = False
            self._newest_frame = None
            default = FrameSourceError(f"{self.name}: its stream ended", source=self.name)
            self._triggers.fail_pending((self._end_cause and self._end_cause[0]) or default)
            await self._driver.stop()
        end_cause, self._end_cause = self._end_cause, None
        if end_cause is not None:
            self._end_readers(end_cause[0])

    async def _wait_for_end(self) -> None:
        """Wait until the driver ends or is stuck, or no reader came for the linger time."""
        while self._end_cause is None and not self._must_restart:
            if not self._readers:
                remaining = self._idle_since + self._linger - asyncio.get_running_loop().time()
                if (
                    not await self._reached_within(remaining, lambda: bool(self._readers))
                    and remaining <= 0
                ):
                    return
            elif self._stall is None or self._driver.awaited_condition:
                condition = self._driver.awaited_condition
                await self._wait_until(partial(self._must_check_again, condition))
                self._last_arrival = asyncio.get_running_loop().time()
            else:
                remaining = self._last_arrival + self._stall - asyncio.get_running_loop().time()
                if remaining <= 0 and self._waits_for_readers:
                    remaining = self._stall
                if remaining <= 0:
                    raise FrameSourceError(
                        f"{self.name}: it streams, but gave no frame for {self._stall:g} s",
                        source=self.name,
                    )
                await self._reached_within(remaining, lambda: not self._readers)

    def _must_check_again(self, condition: str) -> bool:
        """Return True if the readers are gone, or the device no longer awaits this condition."""
        return not self._readers or self._driver.awaited_condition != condition

    async def _reached_within(self, seconds: float, condition: Callable[[], bool]) -> bool:
        """Wait for a condition; return whether it was reached in time."""
        try:
            async with asyncio.timeout(seconds):
                await self._wait_until(condition)
        except TimeoutError:
            return False
        return True

    async def _wait_until(self, condition: Callable[[], bool]) -> None:
        while not (condition() or self._end_cause is not None or self._must_restart):
            self._state_changed.clear()
            await self._state_changed.wait()

    def _end_readers(self, error: FrameSourceError | None) -> None:
        """End all readers; a later reader starts the device again."""
        if error is not None:
            self._triggers.fail_pending(error)
        for reader in self._live_readers():
            reader._end(error)  # noqa: SLF001
            self._remove_reader(reader)


_closing: set[asyncio.Task[None]] = set()
"""Tasks that release the devices of sources that were garbage-collected."""


def _close(loop: asyncio.AbstractEventLoop, driver: FrameDriver) -> None:
    task = loop.create_task(driver.close(), name=f"closing {driver.name}")
    _closing.add(task)
    task.add_done_callback(_closing.discard)
