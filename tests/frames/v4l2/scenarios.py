"""Programs that use a camera: recorded with the kernel's vivid, and replayed."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import smartcam.frames
from smartcam.exceptions import FrameSourceError
from smartcam.frames import FoundSource, Frame, FrameReader
from tests.frames.inside import FORMATS, CaptureDevice, DeviceControl, V4L2Driver, abi

__all__ = ["DeviceControl", "V4L2Driver", "abi"]

URL = "v4l2:///dev/video0?format=YUYV&size=320x180&fps=25"


FEW = {abi.fourcc(one): FORMATS[abi.fourcc(one)] for one in ("GREY", "YUYV")}
"""Formats that the search for cameras enumerates: all would make a long table."""

CONTROLS = {
    "timestamp_source": 0xF0F018,
    "wrap_timestamp": 0xF0F027,
    "percentage_of_dropped_buffers": 0xF0F040,
    "disconnect": 0xF0F041,
    "inject_v4l2_buf_flag_error": 0xF0F042,
    "inject_vidioc_reqbufs_error": 0xF0F043,
    "inject_vidioc_qbuf_error": 0xF0F044,
    "inject_vidioc_streamon_error": 0xF0F045,
    "inject_fatal_streaming_error": 0xF0F046,
}
"""Some controls of vivid, and their numbers."""


def press(name: str, value: int = 1) -> None:
    """Set a control as another program would."""
    device = CaptureDevice.open("/dev/video0")
    try:
        device.checked_ioctl(abi.S_CTRL, CONTROLS[name], value)
    finally:
        device.close()


async def take(reader: FrameReader, count: int) -> list[Frame]:
    return [await reader.__anext__() for _ in range(count)]


async def refusal(awaited: Awaitable[object]) -> FrameSourceError:
    """Return the expected error."""
    try:
        await awaited
    except FrameSourceError as exc:
        return exc
    raise AssertionError("nothing was refused")


async def opened(url: str) -> None:
    async with smartcam.frames.open(url):
        pass


async def stream() -> list[Frame]:
    async with smartcam.frames.open(URL) as source, source.reader() as reader:
        return await take(reader, 6)


async def exposure() -> list[Frame]:
    url = f"{URL}&control.timestamp_source=start_of_exposure"
    async with smartcam.frames.open(url) as source, source.reader() as reader:
        frames = await take(reader, 3)
    press("timestamp_source", 0)
    return frames


async def wrapped() -> list[Frame]:
    url = f"{URL}&control.wrap_timestamp=32_bit"
    async with smartcam.frames.open(url) as source, source.reader() as reader:
        frames = await take(reader, 3)
    press("wrap_timestamp", 0)
    return frames


async def losses() -> tuple[list[Frame], int]:
    async with smartcam.frames.open(URL) as source, source.reader() as reader:
        frames = await take(reader, 1)
        press("inject_v4l2_buf_flag_error")
        press("percentage_of_dropped_buffers", 50)
        frames += await take(reader, 8)
        press("percentage_of_dropped_buffers", 0)
        return frames, reader.statistics().lost


async def broken(name: str) -> tuple[FrameSourceError, list[Frame]]:
    """Return the end of a stream, and the frames after a restart."""
    async with smartcam.frames.open(URL) as source:
        async with source.reader() as reader:
            await take(reader, 2)
            press(name)
            error = await refusal(take(reader, 50))
        async with source.reader() as reader:
            return error, await take(reader, 2)


async def gives_up() -> tuple[FrameSourceError, list[Frame]]:
    return await broken("inject_fatal_streaming_error")


async def unplugged() -> tuple[FrameSourceError, list[Frame]]:
    return await broken("disconnect")


async def no_start() -> tuple[list[FrameSourceError], list[Frame]]:
    errors = []
    async with smartcam.frames.open(URL) as source:
        for name in ("reqbufs", "qbuf", "streamon"):
            press(f"inject_vidioc_{name}_error")
            async with source.reader() as reader:
                errors.append(await refusal(take(reader, 1)))
        async with source.reader() as reader:
            return errors, await take(reader, 1)


async def refused() -> list[FrameSourceError]:
    base = "v4l2:///dev/video0?format="
    return [
        await refusal(opened(url))
        for url in (
            f"{base}MJPEG",
            f"{base}YUYV&size=641x480",
            f"{base}YUYV&size=640x480&fps=33",
            "v4l2:///dev/video9",
            "v4l2:///dev/null",
            "v4l2:///dev/video4",
            "v4l2:///dev/video5",
            "v4l2:///dev/video0?control.brightness=256",
            "v4l2:///dev/video0?control.brigthness=2",
        )
    ]


async def in_use() -> FrameSourceError:
    async with smartcam.frames.open(URL) as source, source.reader() as reader:
        await take(reader, 1)
        return await refusal(opened("v4l2:///dev/video0?format=GREY"))


async def controls() -> tuple[dict[str, DeviceControl], list[int], FrameSourceError]:
    async with smartcam.frames.open(URL) as source:
        driver = source.driver
        assert isinstance(driver, V4L2Driver)
        found = await driver.controls()
        values = [
            await driver.set_control("Menu", "Menu Item 4"),
            await driver.set_control("boolean", "off"),
            await driver.set_control("integer_menu", 5),
            await driver.set_control("hue", -128),
        ]
        return found, values, await refusal(driver.set_control("menu", 2))


async def found() -> list[FoundSource]:
    return await smartcam.frames.discover("v4l2")


SCENARIOS: dict[str, Callable[[], Awaitable[object]]] = {
    one.__name__: one
    for one in (
        stream, exposure, wrapped, losses, gives_up, unplugged, no_start, refused, in_use, controls,
        found,
    )
}  # fmt: skip
