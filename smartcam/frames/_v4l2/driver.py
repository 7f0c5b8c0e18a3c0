"""Use cameras of Video4Linux as sources of frames."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from typing import TYPE_CHECKING, Final, TypeVar
from urllib.parse import parse_qsl

from smartcam.exceptions import FrameSourceError, LocalProtocolError
from smartcam.frames._driver import FrameDriver, StreamFormat
from smartcam.frames._pixels.formats import find_format
from smartcam.frames._v4l2.controls import list_controls, set_control
from smartcam.frames._v4l2.device import FORMATS, CaptureDevice, WantedSetting
from smartcam.frames._v4l2.discovery import find_cameras
from smartcam.frames._v4l2.features import V4L2Features
from smartcam.frames._v4l2.stream import CaptureStream

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.frames._address import FrameAddress
    from smartcam.frames._driver import FoundSource, FrameSink
    from smartcam.frames._v4l2.controls import DeviceControl
    from smartcam.frames._v4l2.device import Setting

Value = TypeVar("Value")

DEVICE_TIMEOUT: Final = 10.0
"""Longest time for one call to a device, seconds; the slowest cameras take one or two seconds."""

CONTROL_PREFIX: Final = "control."
"""Prefix of the parameters that set a control."""


class V4L2Driver(FrameDriver):
    """A camera of the Linux kernel: ``v4l2:///dev/video0?format=YUYV&size=640x480&fps=30``.

    A setting that is not in the URL keeps the device's value. An unsupported setting raises a
    :exc:`~smartcam.FrameFormatError` that lists the supported values.

    - the path: path of the device; ``/dev/v4l/by-id/...`` finds the camera at any USB port.
    - ``format``: pixel format, by its name in PFNC or V4L2.
    - ``size``: ``WIDTHxHEIGHT``, pixels.
    - ``fps``: frames per second.
    - ``buffers``: number of buffers that the driver writes into, 2 to 32; default 4.
    - ``control.NAME``: sets a control at each start of the device, in the URL's order:
      ``control.brightness=10``, ``control.power_line_frequency=50_hz``. The name is the control's
      label in lower case with underscores, the value a number, a menu's label, ``on`` or ``off``.

    ``source.features`` sets controls at other times; such a setting lasts until the URL's controls
    are set again.

    Without readers the device is closed, so that other programs can use it. Each frame's bytes are
    copied from the driver's buffer once, even if a newer frame replaces it before a reader gets it:
    keeping the buffer would leave the driver fewer buffers.

    Blocking calls run in a thread; the event loop only reads filled buffers.
    """

    def __init__(self, address: FrameAddress) -> None:
        super().__init__(address)
        controls = [
            name
            for name, _ in parse_qsl(address.query, keep_blank_values=True)
            if name.startswith(CONTROL_PREFIX) and name != CONTROL_PREFIX
        ]
        names = ["format", "size", "fps", "buffers"]
        parameters = address.parameters([*names, *(controls or [f"{CONTROL_PREFIX}NAME"])])
        self._path = address.path
        if address.host or self._path in ("", "/"):
            raise address.wrong("path", "a device, as in v4l2:///dev/video0", address.shown)
        self._wanted_setting = WantedSetting(
            find_format(parameters["format"]) if "format" in parameters else None,
            address.size(parameters["size"]) if "size" in parameters else None,
            address.number("fps", parameters["fps"], 0.001, 100_000)
            if "fps" in parameters
            else None,
        )
        buffers = address.number("buffers", parameters.get("buffers", "4"), 2, 32)
        if buffers != int(buffers):
            raise address.wrong("buffers", "a whole number", parameters["buffers"])
        self._buffers = int(buffers)
        self._controls = {
            name.removeprefix(CONTROL_PREFIX): parameters[name]
            for name in controls
            if name in parameters
        }
        self._identity: tuple[str, str] | None = None
        self._stream: CaptureStream | None = None  # used by the thread; the loop reads frames
        self._watched_descriptor: int | None = None
        self._thread: ThreadPoolExecutor | None = None

    @classmethod
    async def discover(cls) -> list[FoundSource]:
        """Return this machine's cameras with their formats."""
        thread = ThreadPoolExecutor(1, "v4l2")
        try:
            return await asyncio.get_running_loop().run_in_executor(thread, find_cameras)
        finally:
            thread.shutdown(wait=False)

    async def open(self) -> StreamFormat:
        """Open the device, check the URL's settings, and close it again."""
        self._thread = ThreadPoolExecutor(1, f"v4l2 {self._path}")
        return await self._run_in_thread(self._check_device, "open")

    async def start(self, sink: FrameSink) -> None:
        """Open the device and start its stream."""
        stream = await self._run_in_thread(self._start_stream, "start")
        self._watched_descriptor = stream.device.descriptor
        asyncio.get_running_loop().add_reader(
            self._watched_descriptor, self._on_readable, stream, sink
        )

    async def stop(self) -> None:
        """Stop the stream and close the device."""
        self._stop_watching()
        if self._thread is not None:
            await self._run_in_thread(self._stop_stream, "stop")

    async def close(self) -> None:
        """Close the device, and end the thread."""
        try:
            await self.stop()
        finally:
            thread, self._thread = self._thread, None
            if thread is not None:
                thread.shutdown(wait=False)

    @property
    def features(self) -> V4L2Features:
        """The controls, by SFNC's names (``ExposureTime``, ``Gain``) if SFNC has the control."""
        return V4L2Features(self)

    async def controls(self) -> dict[str, DeviceControl]:
        """Return the device's controls by name.

        Raises:
            FrameSourceError: the device is missing.
        """
        return await self._run_in_thread(
            lambda: self._with_device(list_controls), "list its controls"
        )

    async def set_control(self, name: str, value: int | str) -> int:
        """Set a control now; the URL's controls are set again at the next start.

        Returns:
            The device's new value.

        Raises:
            FrameSourceError: there is no control of that name, or it does not accept the value; the
                text lists the controls or the range.
        """
        return await self._run_in_thread(
            lambda: self._with_device(lambda device: set_control(device, name, value)),
            f"set {name}",
        )

    # in the event loop

    def _on_readable(self, stream: CaptureStream, sink: FrameSink) -> None:
        try:
            stream.drain(sink)
        except FrameSourceError as exc:
            self._stop_watching()
            sink.ended(exc)

    def _stop_watching(self) -> None:
        descriptor, self._watched_descriptor = self._watched_descriptor, None
        if descriptor is not None:
            asyncio.get_running_loop().remove_reader(descriptor)

    async def _run_in_thread(self, job: Callable[[], Value], action: str) -> Value:
        """Run a job in the thread, in the order of the calls.

        Cancellation: the job runs nevertheless, and the next :meth:`stop` cleans up.
        """
        if self._thread is None:
            raise LocalProtocolError(f"{self.name} is not open: use `async with`")
        future = asyncio.get_running_loop().run_in_executor(self._thread, job)
        future.add_done_callback(_retrieve_error)
        finished, _ = await asyncio.wait([future], timeout=DEVICE_TIMEOUT)
        if not finished:
            raise FrameSourceError(
                f"{self.name}: the device did not {action} within {DEVICE_TIMEOUT:g} s",
                source=self.name,
            )
        return future.result()

    # in the thread

    def _check_device(self) -> StreamFormat:
        with closing(CaptureDevice.open(self._path)) as device:
            setting = self._apply_setting(device)
            self._identity = device.identity
        rates = () if setting.rate is None else (setting.rate,)
        size = (setting.layout.width, setting.layout.height)
        v4l2_format = FORMATS[setting.layout.fourcc]  # V4L2's format, without matrix and range
        # keep the device's choice
        self._wanted_setting = WantedSetting(v4l2_format, size, self._wanted_setting.rate)
        return StreamFormat(setting.format, *size, rates)

    def _start_stream(self) -> CaptureStream:
        device = CaptureDevice.open(self._path)
        try:
            if device.identity != self._identity:
                raise self._other_device_error(device)
            setting = self._apply_setting(device)
            self._stream = CaptureStream(device, setting, self._buffers, self.name)
        except BaseException:
            device.close()
            raise
        return self._stream

    def _stop_stream(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.close()

    def _apply_setting(self, device: CaptureDevice) -> Setting:
        for name, value in self._controls.items():
            set_control(device, name, value)
        return device.apply(self._wanted_setting)

    def _with_device(self, job: Callable[[CaptureDevice], Value]) -> Value:
        if self._stream is not None:
            return job(self._stream.device)
        with closing(CaptureDevice.open(self._path)) as device:
            return job(device)

    def _other_device_error(self, device: CaptureDevice) -> FrameSourceError:
        expected, actual = (
            "nothing" if identity is None else " at ".join(identity)
            for identity in (self._identity, device.identity)
        )
        return FrameSourceError(
            f"{self.name}: expected {expected}, as when it was opened, got {actual}",
            source=self.name,
            available=(actual,),
        )


def _retrieve_error(future: asyncio.Future[Value]) -> None:
    """Mark the error of an abandoned job as retrieved."""
    if not future.cancelled():
        future.exception()
