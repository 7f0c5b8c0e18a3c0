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
        width: pixels.
        height: pixels.
        rates: frames a second that it can do, the first is the fastest; empty: it does not say.
    """

    format: PixelFormat
    width: int
    height: int
    rates: tuple[float, ...] = ()

    def __str__(self) -> str:
        """Return the format as URLs and error texts have it."""
        rates = f" at {', '.join(f'{rate:g}' for rate in self.rates)}/s" if self.rates else ""
        return f"{self.format.name} {self.width}x{self.height}{rates}"


@dataclass(frozen=True, slots=True)
class FoundSource:
    """A source that a driver found on this machine or its network.

    Attributes:
        url: opens it.
        name: name shown to people.
        formats: what it can stream.
        remark: what keeps it from being opened, or "".
    """

    url: str
    name: str
    formats: tuple[StreamFormat, ...] = field(default=())
    remark: str = ""


class FrameSink(ABC):
    """The place into which a driver puts frames. All is called in the event loop's thread."""

    @abstractmethod
    def frame(self, frame: Frame) -> None:
        """Take a frame; ``frame.lost`` says what was lost before it."""

    @abstractmethod
    def lost(self, count: int) -> None:
        """Count lost frames; the next frame does not count them again."""

    def skipped(self, count: int) -> None:  # noqa: B027 - most drivers have none
        """Note that frames came to the far end of a link, where newer ones took their place."""

    @abstractmethod
    def ended(self, error: FrameSourceError | None) -> None:
        """Note that nothing more comes: None at the end of a file. Readers get the error."""

    def trigger_failed(self, error: SmartCamError) -> None:  # noqa: B027 - most have no trigger
        """Note that the picture of the trigger under way will not come."""

    async def taken(self) -> None:  # noqa: B027 - a driver without readers waits for none
        """Return once every reader has taken the last frame: for a recording that is to lose none.

        Cancellation: safe.
        """


class FrameDriver(ABC):
    """One device, file or address that frames come from; made of its address.

    A :class:`~smartcam.frames.FrameSource` calls its coroutines one after the other, never two at a
    time. A new scheme is a subclass under the entry point ``smartcam.frames``; the entry's name is
    the scheme.

    Args:
        address: what the URL says. A wrong parameter is a
            :exc:`~smartcam.ConfigurationError` that names the known ones.

    Attributes:
        times_frames: ``captured`` of its frames is their time on our clock, also where they have a
            ``device_time``; else the source finds it out.
        lists_features: whether its device tells which features it has, if it has any.
        form: format of the stream since a feature changed it; None: as :meth:`open` returned it.
        waits_for: what the device waits for before each picture, as a text for errors, such as
            ``TriggerSource is Line1``; ``""``: it streams by itself. One that waits is never stuck.
    """

    times_frames: ClassVar[bool] = False
    lists_features: ClassVar[bool] = True
    form: StreamFormat | None = None
    waits_for: str = ""

    def __init__(self, address: FrameAddress) -> None:
        self.address = address

    @classmethod
    async def discover(cls) -> list[FoundSource]:
        """Return the sources found; open a device only for as long as the search takes."""
        return []

    @property
    def name(self) -> str:
        """The camera's name in frames, logs and errors."""
        return self.address.shown

    @property
    def features(self) -> DeviceFeatures:
        """The features of the device that can be read and set while it is open.

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
        """Have the device tell events; return the coroutine function that ends it.

        Args:
            names: names of the events.
            take: takes each event.
            ended: called when no more will come.

        Raises:
            UnsupportedError: devices of this kind tell no events.
            FrameSourceError: the device has no such event.
        """
        raise UnsupportedError(f"{self.name}: a source of this kind tells no events")

    async def trigger(
        self, pending: AwaitedTrigger, fire: Callable[[], Awaitable[object]] | None
    ) -> None:
        """Trigger one picture, and return when the device has taken the trigger.

        The frame that the trigger causes goes into the sink with ``pending.number`` in its
        ``trigger``; ``sink.trigger_failed`` tells a picture that will not come. It is called while
        the device streams, and again only after :meth:`disarm`.

        Args:
            pending: the trigger; ``pending.fire_begins()`` is called right before it is sent, and
                ``pending.refused()`` where the device surely did not take it.
            fire: coroutine function that sets the trigger's line; None: by software.

        Raises:
            UnsupportedError: devices of this kind have no trigger.
            TriggerError: the device does not take it.
            FrameSourceError: the device does not answer.
        """
        raise UnsupportedError(
            f"{self.name}: a source of this kind has no trigger; that of gige: has one. "
            "after(time.monotonic()) is the first picture that is exposed from now on"
        )

    async def trigger_elsewhere(self, timeout: float, *, refuse: bool) -> Frame | None:
        """Have the device's owner trigger it, and return the picture that this caused.

        Args:
            timeout: seconds for everything.
            refuse: whether to raise where another trigger is under way.

        Returns:
            None where the device is here: :meth:`trigger` triggers it.

        Raises:
            SmartCamError: as :meth:`FrameSource.trigger`.
        """
        del timeout, refuse
        return None

    def disarm(self) -> None:  # noqa: B027 - most drivers have no trigger
        """Take no picture for that of the last trigger any longer."""

    @abstractmethod
    async def open(self) -> StreamFormat:
        """Find the device, see that it can do what the address asks for; it does not stream yet.

        Raises:
            FrameSourceError: the device is not there, is in use, or cannot do that; it says what it
                can.
        """

    @abstractmethod
    async def start(self, sink: FrameSink) -> None:
        """Start the stream into ``sink``. A device that was lost since is opened anew.

        Raises:
            FrameSourceError: the device does not; nothing streams.
        """

    @abstractmethod
    async def stop(self) -> None:
        """Stop the stream and all that runs for it. After that ``sink`` hears nothing."""

    @abstractmethod
    async def close(self) -> None:
        """Give the device back. Idempotent, and right after any failure."""


class TaskDriver(FrameDriver):
    """A driver whose frames come from a task: a subclass says by :meth:`deliver` how."""

    _task: asyncio.Task[None] | None = None

    @abstractmethod
    async def deliver(self, sink: FrameSink) -> None:
        """Hand frames to the sink until the task is cancelled."""

    async def start(self, sink: FrameSink) -> None:
        """Begin to deliver."""
        self._task = asyncio.create_task(self.deliver(sink), name=f"frames of {self.name}")

    async def stop(self) -> None:
        """End the task."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait([task])

    async def close(self) -> None:
        """End the task, where it still delivers."""
        await self.stop()
