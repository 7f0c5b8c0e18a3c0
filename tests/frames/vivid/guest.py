"""Check the driver with the kernel's inside the machine, and write the outcome."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import inspect
import itertools
import json
import logging
import os
import re
import struct
import sys
import time
import traceback
import zlib
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import smartcam.frames
from smartcam.exceptions import FrameFormatError, FrameSourceError
from smartcam.frames import Frame, FrameReader, FrameSource, Moment
from smartcam.frames._v4l2 import abi
from smartcam.frames._v4l2.controls import set_control
from smartcam.frames._v4l2.device import CaptureDevice
from smartcam.frames._v4l2.driver import V4L2Driver

URL = "v4l2:///dev/video{}?format=YUYV&size=320x180&fps=25"
S_INPUT = abi.Ioctl("S_INPUT", 0xC0045627, struct.Struct("i"))
SCALERS = ("enable_capture_scaler", "enable_capture_composing", "enable_capture_cropping")
UNBIND = Path("/sys/bus/platform/drivers/vivid")
CHECKS: dict[str, Callable[[], Awaitable[None]]] = {}


def check(function: Callable[[], Awaitable[None]]) -> Callable[[], Awaitable[None]]:
    """Run the checks in the order of this file."""
    CHECKS[function.__name__] = function
    return function


@asynccontextmanager
async def reading(
    url: str = URL.format(0), stall: float = 1.0
) -> AsyncIterator[tuple[FrameSource, FrameReader]]:
    async with smartcam.frames.open(url, stall=stall) as source, source.reader() as reader:
        yield source, reader


async def take(reader: FrameReader, count: int) -> list[Frame]:
    return [await reader.__anext__() for _ in range(count)]


async def refused(url: str, *words: str, kind: type[FrameSourceError] = FrameSourceError) -> str:
    """Return the error of an opening; its text or ``available`` contains each word."""
    try:
        async with smartcam.frames.open(url):
            pass
    except kind as exc:
        message = f"{exc} {exc.available}"
        assert all(one in message for one in words), (words, message)
        return message
    raise AssertionError(f"{url} was opened")


async def ends(reader: FrameReader, *words: str) -> None:
    """Check that the stream ends with an error that contains the words."""
    message = ""
    try:
        await take(reader, 100)
    except FrameSourceError as exc:
        message = str(exc)
    assert message, "100 frames came"
    assert all(one in message for one in words), (words, message)


def press(number: int, name: str, value: int = 1) -> None:
    """Set a control as another program would."""
    device = CaptureDevice.open(f"/dev/video{number}")
    try:
        set_control(device, name, value)
    finally:
        device.close()


def open_devices() -> int:
    count = 0
    for one in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # the listed name
            count += str(one.readlink()).startswith("/dev/video")
    return count


def maps() -> int:
    return Path("/proc/self/maps").read_text().count("/dev/video")


@check
async def cameras_are_found_with_formats_sizes_and_rates() -> None:
    found = await smartcam.frames.discover("v4l2")
    assert [one.url for one in found] == [f"v4l2:///dev/video{one}" for one in range(4)], found
    assert {one.name for one in found} == {"vivid"}
    some = [str(one) for one in found[0].formats]
    assert "YUV422_8 640x480 at 25, 15, 12.5, 10, 5, 4, 2, 1/s" in some, some
    assert any(one.startswith("Mono8 3840x2160 at ") for one in some), some
    assert "also has YVYU" in found[0].remark
    assert open_devices() == 0


@check
async def frames_are_whole_numbered_and_stamped() -> None:
    async with reading() as (source, reader):
        assert str(source.format) == "YUV422_8 320x180 at 25/s"
        frames = await take(reader, 6)
        assert (open_devices(), maps()) == (5, 4)  # mmap keeps a descriptor of its own
        sums = [zlib.crc32(one.data) for one in frames]
        again = [zlib.crc32(one.data) for one in [*frames, *await take(reader, 6)][:6]]
    assert sums == again, "a buffer was written to that somebody holds"
    assert len(set(sums)) == 6, "a picture came twice"  # the picture shows the counter
    steps = [b.sequence - a.sequence for a, b in itertools.pairwise(frames)]
    assert steps == [one.lost + 1 for one in frames[1:]]
    assert {(len(one.data), one.stride) for one in frames} == {(115200, 640)}
    times = [b.captured - a.captured for a, b in itertools.pairwise(frames)]
    assert all(abs(one - 0.04 * step) < 0.02 for one, step in zip(times, steps, strict=True)), times
    assert {one.moment for one in frames} == {Moment.FRAME_END}
    assert all(0.08 <= one.duration < 0.2 for one in frames)
    assert all(-0.001 < one.age < 1 for one in frames), [one.age for one in frames]
    assert abs(frames[0].utc - (time.time() - frames[0].age)) < 0.01
    grey = frames[0].grey()
    assert grey.shape == (180, 320)
    assert grey.max() > 150 > 50 > grey.min()  # colour bars


@check
async def nothing_is_open_where_nobody_reads() -> None:
    async with smartcam.frames.open(URL.format(0)) as source:
        assert (open_devices(), maps()) == (0, 0)
        await source.newest()
        await until(lambda: open_devices() == 0)
        assert maps() == 0
        async with smartcam.frames.open(URL.format(0)) as other:
            await other.newest()
        began = time.process_time(), time.monotonic()
        await asyncio.sleep(5)
        part = (time.process_time() - began[0]) / (time.monotonic() - began[1])
        assert part < 0.001, part  # of the sleep itself only


async def until(reached: Callable[[], bool]) -> None:
    for _ in range(200):
        if reached():
            return
        await asyncio.sleep(0.01)
    raise AssertionError(inspect.getsource(reached))


@check
async def four_stream_at_once() -> None:
    async def read(number: int) -> list[int]:
        async with reading(URL.format(number)) as (_, reader):
            return [one.sequence for one in await take(reader, 20)]

    got = await asyncio.gather(*(read(one) for one in range(4)))
    for one in got:
        assert one == sorted(set(one)), one
        assert one[-1] - one[0] < 30, one


@check
async def a_start_of_exposure_is_told() -> None:
    async with reading(f"{URL.format(0)}&control.timestamp_source=start_of_exposure") as (
        _,
        reader,
    ):
        for one in await take(reader, 3):
            assert (one.moment, one.duration) == (Moment.EXPOSURE_START, 0.0)
            assert 0 <= one.age < 0.2
    press(0, "timestamp_source", 0)


@check
async def stamps_that_cannot_be_are_not_believed() -> None:
    heard: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: heard.append(record.getMessage())  # type: ignore[method-assign]
    logging.getLogger("smartcam.frames").addHandler(handler)
    async with reading(f"{URL.format(0)}&control.wrap_timestamp=32_bit") as (_, reader):
        frames = await take(reader, 4)
    press(0, "wrap_timestamp", 0)
    logging.getLogger("smartcam.frames").removeHandler(handler)
    assert {one.moment for one in frames} == {Moment.ARRIVAL}
    assert all(0 <= one.age < 0.2 and 0.08 <= one.duration < 0.3 for one in frames)
    assert all(abs(one.device_time - one.captured) > 100 for one in frames if one.device_time)
    assert len(heard) == 1, heard


@check
async def dropped_frames_are_counted() -> None:
    async with reading() as (_, reader):
        await take(reader, 2)
        press(0, "percentage_of_dropped_buffers", 50)
        await take(reader, 1)
        before = reader.statistics()
        frames = await take(reader, 20)
        after = reader.statistics()
        press(0, "percentage_of_dropped_buffers", 0)
    lost = sum(one.lost for one in frames)
    assert lost == after.lost - before.lost >= 5
    steps = [b.sequence - a.sequence - 1 for a, b in itertools.pairwise(frames)]
    assert steps == [one.lost for one in frames[1:]]


@check
async def a_sequence_that_wraps_loses_nothing() -> None:
    async with reading(f"{URL.format(0)}&control.wrap_sequence_number=on") as (
        _,
        reader,
    ):
        frames = await take(reader, 140)
    press(0, "wrap_sequence_number", 0)
    assert frames[0].sequence < 2**32 <= frames[-1].sequence
    lost = sum(one.lost for one in frames)
    assert frames[-1].sequence - frames[0].sequence == 139 + lost
    assert lost < 20  # a busy computer may lose some frames, but not billions


@check
async def a_stuck_device_ends_its_readers_and_goes_on() -> None:
    async with reading(stall=0.5) as (source, reader):
        await take(reader, 2)
        press(0, "percentage_of_dropped_buffers", 100)
        await ends(reader, "gave no frame for 0.5 s")
        press(0, "percentage_of_dropped_buffers", 0)
        assert (await source.newest()).sequence == 0


@check
async def a_buffer_with_an_error_is_lost() -> None:
    async with reading() as (_, reader):
        await take(reader, 2)
        press(0, "inject_v4l2_buf_flag_error")
        frames = await take(reader, 5)
        assert reader.statistics().lost == 1
    numbers = [one.sequence for one in frames]
    assert numbers[-1] - numbers[0] in (4, 5), numbers
    assert sum(one.lost for one in frames) == 0  # reported at its arrival


@check
async def a_driver_that_gives_up_ends_its_readers() -> None:
    async with reading() as (source, reader):
        await take(reader, 2)
        press(0, "inject_fatal_streaming_error")
        await ends(reader, "/dev/video0", "EIO")
        assert (await source.newest()).lost == 0


@check
async def a_start_that_fails_leaves_nothing() -> None:
    for name, word in (
        ("inject_vidioc_reqbufs_error", "asking for buffers"),
        ("inject_vidioc_qbuf_error", "buffer 0"),
        ("inject_vidioc_streamon_error", "starting the stream"),
    ):
        async with smartcam.frames.open(URL.format(0)) as source:
            press(0, name)
            async with source.reader() as reader:
                await ends(reader, word)
            await until(lambda: (open_devices(), maps()) == (0, 0))
            await source.newest()


@check
async def a_device_in_use_says_so_and_is_free_afterwards() -> None:
    async with reading() as (_, reader):
        await take(reader, 1)
        await refused(URL.format(0).replace("320x180", "640x360"), "EBUSY", "in use by another")
    async with smartcam.frames.open(URL.format(0)) as source:
        await source.newest()


@check
async def what_a_device_has_not_is_listed() -> None:
    wrong = FrameFormatError
    await refused("v4l2:///dev/video0?format=MJPEG", "MJPEG", "Mono8 (GREY)", "YVYU", kind=wrong)
    await refused(
        "v4l2:///dev/video0?size=641x480",
        "641x480, the device took 640x480",
        "'1280x720'",
        kind=wrong,
    )
    await refused(
        "v4l2:///dev/video0?format=YUYV&size=640x480&fps=33",
        "expected 33 frames/s", "took 25", "'25/s', '15/s', '12.5/s'", kind=wrong,
    )  # fmt: skip
    await refused("v4l2:///dev/video9", "ENOENT", "'/dev/video0 (vivid-000-vid-cap)'")
    await refused("v4l2:///dev/null", "ENOTTY", "not a V4L2 device")
    await refused("v4l2:///dev/video4", "metadata of a camera")
    await refused("v4l2:///dev/video5", "several planes")
    os.seteuid(65534)
    try:
        await refused("v4l2:///dev/video0", "EACCES", "access is denied")
    finally:
        os.seteuid(0)


@check
async def controls_are_listed_set_and_bounded() -> None:
    async with smartcam.frames.open(f"{URL.format(0)}&control.brightness=0x21") as source:
        driver = source.driver
        assert isinstance(driver, V4L2Driver)
        controls = await driver.controls()
        assert str(controls["brightness"]) == "brightness: 0 to 255; default 128, now 33"
        assert controls["menu"].range == "1 (Menu Item 1), 3 (Menu Item 3), 4 (Menu Item 4)"
        assert controls["integer_menu"].menu[5] == "8"
        assert await driver.set_control("menu", "Menu Item 4") == 4
        assert await driver.set_control("boolean", "off") == 0
        async with source.reader() as reader:
            await take(reader, 1)
            assert await driver.set_control("hue", -128) == -128
            assert (await driver.controls())["hue"].value == -128
        for name, value, words in (
            ("brightness", 256, ("expected 0 to 255, got 256",)),
            ("menu", 2, ("1 (Menu Item 1), 3",)),
            ("brigthness", 1, ("did you mean", "hue: -128 to 128")),
            ("read_only_integer_32_bits", 3, ("read-only",)),
        ):
            try:
                await driver.set_control(name, value)
            except FrameSourceError as exc:
                message = f"{exc} {exc.available}"
                assert all(re.search(re.escape(one), message, re.IGNORECASE) for one in words), (
                    message
                )
            else:
                raise AssertionError(name)
        await driver.set_control("hue", 0)
        assert await source.features["GainAuto"].set("Off") == "Off"
        assert await source.features["Gain"].set(7) == 7
        assert (await driver.controls())["gain"].value == 7
        assert await source.features["ReverseX"].set(True) is True
        assert await source.features["menu"].set("Menu Item 1") == "Menu Item 1"
        await source.features["button"].execute()
        await source.features["ReverseX"].set(False)
    await refused("v4l2:///dev/video0?control.brightness=bright", "expected 0 to 255, got 'bright'")


COLOURS_TOLD = (
    # color space, encoding, quantization: the device's menus; and the format that follows
    (("sRGB", "Default", "Default"), "YUV422_8"),
    (("Rec. 709", "Default", "Default"), "YCbCr709_422_8"),
    (("sRGB", "Rec. 709", "Default"), "YCbCr709_422_8"),
    (("sRGB", "ITU-R 601", "Full Range"), "YCbCr422_8"),
    (("Rec. 709", "Rec. 709", "Full Range"), "YUV422_8_709_full"),
    (("sRGB", "BT.2020", "Limited Range"), "YUV422_8_2020"),
)


@check
async def colours_are_what_the_device_says_they_are() -> None:
    menus = ("colorspace", "y_cbcr_encoding", "quantization")
    device = CaptureDevice.open("/dev/video0")
    for name, values in (("brightness", 128), ("test_pattern", 7), ("osd_text_mode", 2)):
        set_control(device, name, values)
    device.close()
    for told, name in COLOURS_TOLD:
        device = CaptureDevice.open("/dev/video0")
        for menu, value in zip(menus, told, strict=True):
            set_control(device, menu, value)
        device.close()
        async with smartcam.frames.open(URL.format(0)) as source:
            frame = await source.newest()
            assert frame.format.name == name, (told, frame.format.name)
            red = frame.rgb()[90, 160].astype(int)
            assert max(abs(red - [255, 0, 0])) <= 4 or told[0] != "sRGB", (told, red.tolist())
    device = CaptureDevice.open("/dev/video0")
    for name in ("test_pattern", "osd_text_mode", *menus):
        set_control(device, name, 0)
    set_control(device, "colorspace", "sRGB")
    device.close()


@check
async def a_format_that_another_program_set_is_set_back() -> None:
    async with smartcam.frames.open(URL.format(0)) as source:
        device = CaptureDevice.open("/dev/video0")
        device.checked_ioctl(abi.S_FMT, 1, 0, 640, 480, abi.fourcc("GREY"), 1)
        device.close()
        frame = await source.newest()
        assert (frame.format.name, frame.width, len(frame.data)) == ("YUV422_8", 320, 115200)


@check
async def a_device_that_changed_says_what_it_has_now() -> None:
    async with smartcam.frames.open(URL.format(0)) as source:
        device = CaptureDevice.open("/dev/video0")
        device.checked_ioctl(S_INPUT, 1)  # a tuner, of 720 columns
        for one in SCALERS:
            set_control(device, one, 0)
        device.close()
        async with source.reader() as reader:
            await ends(reader, "/dev/video0: expected")
        device = CaptureDevice.open("/dev/video0")
        for one in SCALERS:
            set_control(device, one, 1)
        device.checked_ioctl(S_INPUT, 0)
        device.close()
        await source.newest()


@check
async def a_disconnected_device_ends_its_readers() -> None:
    async with reading(URL.format(3)) as (source, reader):
        await take(reader, 2)
        press(3, "disconnect")
        await ends(reader, "ENODEV", "unplugged", "/dev/video0")
        await until(lambda: (open_devices(), maps()) == (0, 0))
        assert (await source.newest()).sequence == 0  # the last close plugs the device in again


@check
async def a_driver_that_goes_and_comes_back_is_opened_anew() -> None:
    async with reading(URL.format(1)) as (source, reader):
        await take(reader, 2)
        (UNBIND / "unbind").write_text("vivid.0")
        await ends(reader, "ENODEV")
        await until(lambda: (open_devices(), maps()) == (0, 0))
        async with source.reader() as while_away:
            await ends(while_away, "ENOENT")
        (UNBIND / "bind").write_text("vivid.0")
        await until(lambda: Path("/dev/video1").exists())
        frame = await source.newest()
        assert (frame.source, frame.sequence) == (source.name, 0)


@check
async def nothing_is_left() -> None:
    gc.collect()
    await until(lambda: (open_devices(), maps()) == (0, 0))


async def all_checks(names: list[str]) -> dict[str, str]:
    came: dict[str, str] = {}
    await smartcam.frames.discover("v4l2")  # its imports are files of the other computer
    for name, function in CHECKS.items():
        if names and name not in names:
            continue
        began = time.monotonic(), time.process_time()
        try:
            async with asyncio.timeout(60):
                await function()
            came[name] = ""
        except Exception:  # noqa: BLE001 - whatever it is, it is told
            came[name] = traceback.format_exc()
        spent = time.monotonic() - began[0], time.process_time() - began[1]
        sys.stdout.write(f"{spent[0]:6.2f} s, CPU {spent[1]:.2f}  {name} {came[name]}\n")
        sys.stdout.flush()
    return came


if __name__ == "__main__":
    began = time.monotonic()
    results = asyncio.run(all_checks(sys.argv[1:]))
    Path("/run/out/result.json").write_text(json.dumps(results))
    sys.exit(any(results.values()))
