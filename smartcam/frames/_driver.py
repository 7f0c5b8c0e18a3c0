"""The parts of a source of frames: a driver for each scheme of URLs, and its sink."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from smartcam.exceptions import UnsupportedError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine

    from smartcam.exceptions import FrameSourceError, SmartCamError
    from smartcam.frames._address import FrameAddress
    from smartcam.frames._events import FrameEvent
    from smartcam.frames._features import DeviceFeatures
    from smartcam.frames._frame import Frame
    from smartcam.frames._pixels.formats import PixelFormat
    from smartcam.frames._trigger import AwaitedTrigger


class StreamFormat(NamedTuple):
    """The format and size that a source streams, or could.

    Attributes:
        format: format of the pixels.
        width: width in pixels.
        height: height in pixels.
        rates: possible frame rates, frames per second, the fastest first; empty: not known.
    """

    format: PixelFormat
    width: int
    height: int
    rates: tuple[float, ...] = ()

    def __str__(self) -> str:
        """Return the format as in URLs and error texts."""
        rates = f" at {', '.join(f'{rate:g}' for rate in self.rates)}/s" if self.rates else ""
        return f"{self.format.name} {self.width}x{self.height}{rates}"


@dataclass(frozen=True, slots=True)
class FoundSource:
    """A source that a driver found on this machine or its network.

    Attributes:
        url: URL that opens it.
        name: display name.
        formats: formats that it can stream.
        remark: reason why it cannot be opened, or "".
    """

    url: str
    name: str
    formats: tuple[StreamFormat, ...] = field(default=())
    remark: str = ""


class FrameSink(ABC):
    """The receiver of a driver's frames. All methods are called in the event loop's thread."""

    @abstractmethod
    def frame(self, frame: Frame) -> None:
        """Receive a frame; ``frame.lost`` is the number of frames lost before it."""

    @abstractmethod
    def lost(self, count: int) -> None:
        """Count lost frames; the next frame does not count them again."""

    def skipped(self, count: int) -> None:  # noqa: B027 - most drivers have none
        """Count frames that the far end of a link replaced by newer ones."""

    @abstractmethod
    def ended(self, error: FrameSourceError | None) -> None:
        """End the stream: readers get ``error``, which is None at the end of a file."""

    def trigger_failed(self, error: SmartCamError) -> None:  # noqa: B027 - most have no trigger
        """Report that the picture of the pending trigger will not come."""

    async def wait_taken(self) -> None:  # noqa: B027 - a driver without readers waits for none
        """Wait until every reader has taken the last frame, for a source that must lose none.

        Cancellation: safe.
        """


class FrameDriver(ABC):
    """One device, file or address that frames come from, created from its URL.

    A :class:`~smartcam.frames.FrameSource` calls its coroutines one after the other, never two at a
    time. A new scheme is a subclass under the entry point ``smartcam.frames``; the entry's name is
    the scheme.

    Args:
        address: parts of the URL. A wrong parameter raises a :exc:`~smartcam.ConfigurationError`
            that names the known ones.

    Attributes:
        sets_captured: whether the driver sets ``captured`` on the host's clock for all its frames;
            else the source computes ``captured`` of frames with a ``device_time``.
        lists_features: whether the device can list its features.
        changed_format: format of the stream after a feature changed it; None: as at the opening.
        awaited_condition: condition that the device awaits before each picture, for error texts,
            such as ``TriggerSource is Line1``; ``""``: the device streams freely. A device that
            awaits a condition is never considered stuck.
    """

    sets_captured: ClassVar[bool] = False
    lists_features: ClassVar[bool] = True
    changed_format: StreamFormat | None = None
    awaited_condition: str = ""

    def __init__(self, address: FrameAddress) -> None:
        self.address = address

    @classmethod
    async def discover(cls) -> list[FoundSource]:
        """Return the sources found; a device opened for the search is closed again."""
        return []

    @property
    def name(self) -> str:
        """Name of the camera in frames, logs and errors."""
        return self.address.shown

    @property
    def features(self) -> DeviceFeatures:
        """Features of the device that can be read and set while it is open.

        Raises:
            UnsupportedError: devices of this kind have none.
        """
        raise UnsupportedError(
            f"{self.name}: a source of this kind has no features to read or set; those of gige:, "
            "v4l2: and rtsp: have them"
        )

    async def watch_events(
        self,
        names: tuple[str, ...],
        take: Callable[[FrameEvent], None],
        ended: Callable[[FrameSourceError | None], None],
    ) -> Callable[[], Coroutine[Any, Any, None]]:
        """Start reports of the device's events; return the coroutine function that stops them.

        Args:
            names: names of the events.
            take: function that is called with each event.
            ended: function that is called when no more events will come.

        Raises:
            UnsupportedError: devices of this kind report no events.
            FrameSourceError: the device has no such event.
        """
        raise UnsupportedError(f"{self.name}: a source of this kind reports no events")

    async def trigger(
        self, pending: AwaitedTrigger, fire: Callable[[], Awaitable[object]] | None
    ) -> None:
        """Trigger one picture, and return when the device has accepted the trigger.

        The frame that the trigger causes goes into the sink with ``pending.number`` in its
        ``trigger``; ``sink.trigger_failed`` reports a picture that will not come. The source calls
        this method while the device streams, and again only after :meth:`disarm`.

        Args:
            pending: the trigger; ``pending.record_fire()`` is called right before it is sent, and
                ``pending.record_refusal()`` if the device certainly did not accept it.
            fire: coroutine function that sets the trigger's line; None: a software trigger.

        Raises:
            UnsupportedError: devices of this kind have no trigger.
            TriggerError: the device does not accept it.
            FrameSourceError: the device does not answer.
        """
        raise UnsupportedError(
            f"{self.name}: a source of this kind has no trigger; that of gige: has one. "
            "after(time.monotonic()) is the first picture that is exposed from now on"
        )

    async def trigger_by_owner(self, timeout: float, *, refuse: bool) -> Frame | None:
        """Let the process that owns the device trigger it, and return the picture.

        Args:
            timeout: seconds for the whole call.
            refuse: whether to raise if another trigger is pending.

        Returns:
            The picture; None for a local device, which :meth:`trigger` triggers.

        Raises:
            SmartCamError: as for :meth:`FrameSource.trigger`.
        """
        del timeout, refuse
        return None

    def disarm(self) -> None:  # noqa: B027 - most drivers have no trigger
        """Assign no more pictures to the last trigger."""

    @abstractmethod
    async def open(self) -> StreamFormat:
        """Find the device and check that it supports the address; it does not stream yet.

        Raises:
            FrameSourceError: the device does not exist, is in use, or does not support the address;
                the error says what it supports.
        """

    @abstractmethod
    async def start(self, sink: FrameSink) -> None:
        """Start the stream into ``sink``; open the device again if it was lost meanwhile.

        Raises:
            FrameSourceError: the device does not start; nothing streams.
        """

    @abstractmethod
    async def stop(self) -> None:
        """Stop the stream and everything that runs for it; then ``sink`` is not called any more."""

    @abstractmethod
    async def close(self) -> None:
        """Release the device. Idempotent, and allowed after any failure."""


class TaskDriver(FrameDriver):
    """A driver whose frames come from a task, which runs :meth:`deliver` of a subclass."""

    _task: asyncio.Task[None] | None = None

    @abstractmethod
    async def deliver(self, sink: FrameSink) -> None:
        """Hand frames to the sink until the task is cancelled."""

    async def start(self, sink: FrameSink) -> None:
        """Start the task."""
        self._task = asyncio.create_task(self.deliver(sink), name=f"frames of {self.name}")

    async def stop(self) -> None:
        """End the task if it is running."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait([task])

    async def close(self) -> None:
        """Stop the task if it is running."""
        await self.stop()
