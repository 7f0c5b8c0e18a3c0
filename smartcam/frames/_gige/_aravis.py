"""A GigE Vision camera through aravis: its C library receives, in a thread of its own.

It is used by its GObject binding, which Debian has as ``gir1.2-aravis-0.8`` and ``python3-gi``. The
features are set by our own reading of the description, which checks values and says what there is;
aravis' calls wait, so they run in a thread.
"""

from __future__ import annotations

import asyncio
import functools
import importlib
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final, TypeVar

from smartcam.exceptions import FrameFormatError, FrameSourceError
from smartcam.frames._driver import FrameDriver
from smartcam.frames._frame import Frame, Moment
from smartcam.frames._gige._control import ControlChannel
from smartcam.frames._gige._features import GenicamFeatures
from smartcam.frames._gige._places import place
from smartcam.frames._gige._session import read_description
from smartcam.frames._gige._setup import lock, set_up

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.frames._address import FrameAddress
    from smartcam.frames._driver import FrameSink, StreamFormat
    from smartcam.frames._gige._setup import StreamShape, WantedStream

Result = TypeVar("Result")

BUFFERS: Final = 5
"""Frames that aravis may hold until the event loop has taken them."""

POLL: Final = 100_000
"""Microseconds that the thread waits for a frame before it looks whether it is to end."""

SHORT_IDS: Final = 65535


def load() -> Any:
    """Return aravis' binding; it is untyped.

    Raises:
        FrameSourceError: it is not installed for this Python.
    """
    try:
        gi = importlib.import_module("gi")
        gi.require_version("Aravis", "0.8")
        return importlib.import_module("gi.repository.Aravis")
    except (ImportError, ValueError, AttributeError) as exc:
        raise FrameSourceError(
            "through=aravis: aravis is not installed for this Python: apt-get install "
            f"gir1.2-aravis-0.8 python3-gi, and a Python that sees Debian's packages: {exc}"
        ) from exc


class AravisDriver(FrameDriver):
    """A camera through aravis; see :class:`.driver.GigEDriver`.

    Args:
        address: what the URL says.
        wanted: the same, read.
    """

    def __init__(self, address: FrameAddress, wanted: WantedStream) -> None:
        super().__init__(address)
        self._wanted = wanted
        self.label = address.shown
        self._aravis: Any = None
        self._camera: Any = None
        self._stream: Any = None
        self._control: ControlChannel | None = None
        self._pool: ThreadPoolExecutor | None = None
        self._features: GenicamFeatures | None = None
        self._shape: StreamShape | None = None
        self._sink: FrameSink | None = None
        self._pump: asyncio.Future[None] | None = None
        self._end = threading.Event()
        self._last = 0
        self._number = 0
        self._gone = False

    @property
    def name(self) -> str:
        """The camera's model and serial number; closed: the URL."""
        return self.label

    @property
    def features(self) -> GenicamFeatures:
        """What can be asked and set."""
        if self._features is None:
            raise FrameSourceError(f"{self.label}: it is not open", source=self.label)
        return self._features

    async def open(self) -> StreamFormat:
        """Take control of the camera and set it."""
        self._aravis = load()
        host, port = await place(self.address, self._wanted)
        self._pool = ThreadPoolExecutor(2, thread_name_prefix=f"aravis for {self.address.shown}")
        try:
            self._camera = await self._call("open it", self._aravis.Camera.new, host)
            self._gone = False
            self._control = await ControlChannel.connect(host, port, self.label)
            await self._begin(self._control)
            self._shape = await set_up(self, self._wanted)
        except BaseException:
            await self.close()
            raise
        return self._shape.format

    async def start(self, sink: FrameSink) -> None:
        """Have it stream."""
        if self._gone:
            await self.close()
        if self._camera is None:
            await self.open()
        shape, camera = self._shape, self._camera
        if shape is None or camera is None:
            raise FrameSourceError(f"{self.label}: it is not open", source=self.label)
        try:
            if self._wanted.packet_size:
                size = self._wanted.packet_size
                await self._call("packet_size", camera.gv_set_packet_size, size)
            else:
                await self._call("packet_size", camera.gv_auto_packet_size)
            self._stream = await self._call("its stream", camera.create_stream, None, None)
            self._stream.set_property("packet-resend", self._resend())
            for _ in range(BUFFERS):
                self._stream.push_buffer(self._aravis.Buffer.new_allocate(shape.payload))
            self._sink, self._last = sink, 0
            self._end.clear()
            loop = asyncio.get_running_loop()
            self._pump = loop.run_in_executor(self._pool, self._pumped, self._stream, loop)
            await lock(self.features, True)
            await self.features.execute("AcquisitionStart")
        except BaseException:
            await self._quiet()
            raise

    async def stop(self) -> None:
        """Have it stream no longer."""
        streamed = self._stream is not None
        await self._quiet()
        if streamed and not self._gone:
            try:
                await self.features.execute("AcquisitionStop")
                await lock(self.features, False)
            except FrameSourceError:
                self._gone = True

    async def close(self) -> None:
        """Give it back."""
        try:
            await self.stop()
        finally:
            pool, self._pool = self._pool, None
            control, self._control = self._control, None
            if control is not None:
                control.close()
            held = [self._camera, self._features]
            self._camera = self._features = None
            self.label = self.address.shown
            if pool is not None:  # the camera is given back when nobody holds it, which waits
                given_back = asyncio.get_running_loop().run_in_executor(pool, held.clear)
                pool.shutdown(wait=False)
                await asyncio.wait([given_back])

    # in the event loop

    async def _begin(self, control: ControlChannel) -> None:
        camera = self._camera
        device = camera.get_device()
        model = await self._call("its model", camera.get_model_name)
        serial = await self._call("its serial number", camera.get_device_serial_number)
        self.label = " ".join(part for part in (model, serial) if part) or self.label
        if not device.is_controller():
            raise FrameSourceError(
                f"{self.label} is controlled by another application: it has to give the camera "
                "back first",
                source=self.label,
            )
        nodes = await read_description(control, self.label)
        memory = _AravisMemory(self._call, device, control)
        self._features = GenicamFeatures(nodes, memory, self.label)
        loop = asyncio.get_running_loop()
        device.connect("control-lost", functools.partial(self._control_lost, loop))

    async def _call(self, what: str, function: Callable[..., Result], *arguments: Any) -> Result:
        """Have a thread call one of aravis' functions."""
        if self._pool is None:
            raise FrameSourceError(f"{self.label}: it is closed", source=self.label)
        loop = asyncio.get_running_loop()
        try:
            return await loop.run_in_executor(self._pool, function, *arguments)
        except Exception as exc:
            if type(exc).__name__ not in ("GError", "Error"):  # of gi, which has no types
                raise
            text = getattr(exc, "message", exc)
            raise FrameSourceError(
                f"{self.label}: {what}: aravis says: {text}", source=self.label
            ) from exc

    async def _quiet(self) -> None:
        """Have the thread end, within its poll, and aravis receive no longer."""
        self._sink = None
        self._end.set()
        pump, self._pump = self._pump, None
        held, self._stream = [self._stream], None
        if pump is not None:
            await asyncio.wait([pump])
        if self._pool is not None:  # it ends when nobody holds it, which waits for its thread
            await asyncio.get_running_loop().run_in_executor(self._pool, held.clear)

    def _resend(self) -> Any:
        kinds = self._aravis.GvStreamPacketResend
        return kinds.ALWAYS if self._wanted.resend else kinds.NEVER

    def _take(self, taken: _AravisFrame, stream: Any, buffer: Any) -> None:
        """Take what the thread has; only then aravis gets its buffer back."""
        sink, shape = self._sink, self._shape
        if sink is None or shape is None or stream is not self._stream:
            return
        if taken.data is not None:
            gap = taken.number - self._last if self._last else 1
            if gap < 0:  # ids of 16 bits went round
                gap = gap % SHORT_IDS
            self._number = self._number + gap if self._last else taken.number
            self._last = taken.number
            if (taken.code, taken.width, taken.height) != self._expected(shape):
                self._sink = None
                sink.ended(self._changed(taken, shape))
                return
            sink.frame(self._frame(taken, shape, max(gap - 1, 0)))
        stream.push_buffer(buffer)

    def _expected(self, shape: StreamShape) -> tuple[int, int, int]:
        return shape.number, shape.format.width, shape.format.height

    def _changed(self, taken: _AravisFrame, shape: StreamShape) -> FrameFormatError:
        return FrameFormatError(
            f"{self.label}: it streams {shape.format} ({shape.number:#010x}), then came "
            f"{taken.width}x{taken.height} of {taken.code:#010x}",
            source=self.label,
            available=(str(shape.format),),
        )

    def _frame(self, taken: _AravisFrame, shape: StreamShape, lost: int) -> Frame:
        width, height = shape.format.width, shape.format.height
        return Frame(
            data=taken.data or b"",
            format=shape.format.format,
            width=width,
            height=height,
            stride=shape.format.format.stride(width),
            captured=taken.arrived,
            utc=time.time() - (time.monotonic() - taken.arrived),
            moment=Moment.ARRIVAL,
            duration=shape.duration,
            device_time=taken.device_time,
            sequence=self._number,
            lost=lost,
            source=self.label,
        )

    # in threads

    def _pumped(self, stream: Any, loop: asyncio.AbstractEventLoop) -> None:
        """Hand frames to the loop until told to end."""
        while not self._end.is_set():
            buffer = stream.timeout_pop_buffer(POLL)
            if buffer is not None and not loop.is_closed():
                loop.call_soon_threadsafe(
                    self._take, _AravisFrame(buffer, self._aravis), stream, buffer
                )

    def _control_lost(self, loop: asyncio.AbstractEventLoop, _: object) -> None:
        if not loop.is_closed():
            loop.call_soon_threadsafe(self._lost)

    def _lost(self) -> None:
        self._gone = True
        sink, self._sink = self._sink, None
        if sink is not None:
            sink.ended(
                FrameSourceError(
                    f"{self.label}: control of it was lost, or it is gone", source=self.label
                )
            )


class _AravisFrame:
    """What aravis has of a frame; ``data`` is None where packets of it are missing."""

    def __init__(self, buffer: Any, aravis: Any) -> None:
        self.data: bytes | None = None
        if buffer.get_status() == aravis.BufferStatus.SUCCESS:
            self.data = buffer.get_data()
            self.number = int(buffer.get_frame_id())
            self.code = int(buffer.get_image_pixel_format())
            self.width, self.height = buffer.get_image_width(), buffer.get_image_height()
            ticks = buffer.get_timestamp()
            self.device_time = ticks / 1e9 if ticks else None
            ago = time.time() - buffer.get_system_timestamp() / 1e9
            self.arrived = time.monotonic() - max(0.0, ago)


class _AravisMemory:
    """The camera's memory: aravis writes, a word at a time, since control is its.

    Anybody may read, so our own channel does: the binding reads no more than a word either, and
    gives the description without its end (0.8.26).
    """

    def __init__(self, call: Callable[..., Any], device: Any, control: ControlChannel) -> None:
        self._call, self._device, self._control = call, device, control

    async def read(self, address: int, length: int) -> bytes:
        return await self._control.read(address, length)

    async def write(self, address: int, data: bytes) -> None:
        begin, end = address & ~3, (address + len(data) + 3) & ~3
        if end - begin != len(data):
            before = await self.read(begin, end - begin)
            data = before[: address - begin] + data + before[address - begin + len(data) :]
        for at in range(0, len(data), 4):
            word = int.from_bytes(data[at : at + 4], "big")
            await self._call(f"{begin + at:#06x}", self._device.write_register, begin + at, word)
