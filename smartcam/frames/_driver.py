"""What a source of frames is made of: a driver for each scheme of URLs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, NamedTuple

if TYPE_CHECKING:
    from smartcam.exceptions import FrameSourceError
    from smartcam.frames._address import FrameAddress
    from smartcam.frames._frame import Frame
    from smartcam.frames._pixels import PixelFormat


class StreamFormat(NamedTuple):
    """What a source streams, or could.

    Attributes:
        format: of the pixels.
        width: pixels.
        height: pixels.
        rates: frames a second that it can do, the first is the fastest; empty: it does not say.
    """

    format: PixelFormat
    width: int
    height: int
    rates: tuple[float, ...] = ()

    def __str__(self) -> str:
        """Return it as URLs and error texts have it."""
        rates = f" at {', '.join(f'{rate:g}' for rate in self.rates)}/s" if self.rates else ""
        return f"{self.format.name} {self.width}x{self.height}{rates}"


@dataclass(frozen=True, slots=True)
class FoundSource:
    """A source that a driver found on this machine or its network.

    Attributes:
        url: opens it.
        name: for people.
        formats: what it can stream.
        remark: what keeps it from being opened, or "".
    """

    url: str
    name: str
    formats: tuple[StreamFormat, ...] = field(default=())
    remark: str = ""


class FrameSink(ABC):
    """Where a driver puts what comes. All is called in the event loop's thread."""

    @abstractmethod
    def frame(self, frame: Frame) -> None:
        """Take a frame; ``frame.lost`` says what was lost before it."""

    @abstractmethod
    def lost(self, count: int) -> None:
        """Take that frames were lost; the next frame does not count them again."""

    def skipped(self, count: int) -> None:  # noqa: B027 - most drivers have none
        """Take that frames came to the far end of a link, where newer ones took their place."""

    @abstractmethod
    def ended(self, error: FrameSourceError | None) -> None:
        """Take that nothing more comes: None at the end of a file. Readers get the error."""

    async def taken(self) -> None:  # noqa: B027 - who has no readers waits for none
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
    """

    times_frames: ClassVar[bool] = False

    def __init__(self, address: FrameAddress) -> None:
        self.address = address

    @classmethod
    async def discover(cls) -> list[FoundSource]:
        """Return what is there; nothing is opened for longer than that takes."""
        return []

    @property
    def name(self) -> str:
        """The camera's name in frames, logs and errors."""
        return self.address.shown

    @abstractmethod
    async def open(self) -> StreamFormat:
        """Find the device, see that it can do what the address asks for; it does not stream yet.

        Raises:
            FrameSourceError: it is not there, is in use, or cannot do that; it says what it can.
        """

    @abstractmethod
    async def start(self, sink: FrameSink) -> None:
        """Have it stream into ``sink``. A device that was lost since is opened anew.

        Raises:
            FrameSourceError: it does not; nothing streams.
        """

    @abstractmethod
    async def stop(self) -> None:
        """Have it stream no longer: nothing runs for it. After that ``sink`` hears nothing."""

    @abstractmethod
    async def close(self) -> None:
        """Give it back. Idempotent, and right after any failure."""
