"""Test the driver with recorded answers of a kernel; tests/frames/vivid uses a real one."""

from __future__ import annotations

import asyncio
import errno
import itertools
import struct
from collections.abc import Callable, Iterator

import pytest

import smartcam.frames
from smartcam.exceptions import ConfigurationError, FrameFormatError, FrameSourceError
from smartcam.frames import Moment
from smartcam.frames._v4l2 import stream
from tests.frames.inside import FORMATS, CaptureDevice, abi, discovery, system
from tests.frames.v4l2 import scenarios
from tests.frames.v4l2.conversations import WRAPPED, Answer, Replay

Player = Callable[[str], Replay]
Begin = Callable[[Replay], None]


@pytest.fixture
def begin(monkeypatch: pytest.MonkeyPatch) -> Iterator[Begin]:
    """Replay answers in the system's stead; check that devices and buffers are released."""
    played: list[Replay] = []

    def put(replay: Replay) -> None:
        played.append(replay)
        for name in WRAPPED:
            monkeypatch.setattr(system, name, getattr(replay, name))

    yield put
    for one in played:
        assert not one.devices, "a device is open still"
        assert not any(pages.open for pages in one.mapped), "a buffer is mapped still"


@pytest.fixture
def play(begin: Begin) -> Player:
    """Replay the system's answers."""

    def play_scenario(scenario: str) -> Replay:
        replay = Replay(scenario)
        begin(replay)
        return replay

    return play_scenario


def whole(replay: Replay) -> None:
    """Check that all recorded calls were made, except for pictures."""
    assert [one for one in replay.left if one.asked not in ("DQBUF", "QBUF")] == []


async def test_stream_is_whole_with_the_kernel_s_numbers_and_times(play: Player) -> None:
    replay = play("stream")
    frames = await scenarios.stream()
    whole(replay)
    assert [one.sequence for one in frames] == list(range(6))
    for one in frames:
        assert (one.width, one.height, one.stride, one.lost) == (320, 180, 640, 0)
        assert one.format.name == "YUV422_8"
        # from the right buffer, before the driver overwrote it
        assert one.data == bytes([one.sequence + 1]) * 115200
    assert {one.moment for one in frames} == {Moment.FRAME_END}
    steps = [b.captured - a.captured for a, b in itertools.pairwise(frames)]
    assert steps == pytest.approx([0.04] * 5, abs=0.01)
    assert all(0.08 <= one.duration < 0.12 for one in frames)
    assert all(one.device_time is None for one in frames)


async def test_stamp_of_the_start_of_the_exposure_is_marked(play: Player) -> None:
    replay = play("exposure")
    frames = await scenarios.exposure()
    whole(replay)
    assert {(one.moment, one.duration) for one in frames} == {(Moment.EXPOSURE_START, 0.0)}


async def test_impossible_stamp_becomes_the_arrival_and_is_logged_once(
    play: Player, caplog: pytest.LogCaptureFixture
) -> None:
    play("wrapped")
    frames = await scenarios.wrapped()
    assert {one.moment for one in frames} == {Moment.ARRIVAL}
    assert all(abs((one.device_time or 0) - one.captured) > 1e9 for one in frames)
    assert all(0.08 <= one.duration < 0.3 for one in frames)
    assert len([one for one in caplog.records if "not plausible" in one.getMessage()]) == 1


async def test_lost_frames_and_buffers_with_errors_are_counted_once(play: Player) -> None:
    replay = play("losses")
    frames, lost = await scenarios.losses()
    last = frames[-1].sequence
    wrong = {
        abi.FULL_BUFFER.unpack_from(one)[-1]
        for one in replay.taken
        if abi.FULL_BUFFER.unpack_from(one)[2] & abi.BUF_ERROR
    }
    assert len(wrong) == 1, "the kernel was told to have one"
    numbers = {abi.FULL_BUFFER.unpack_from(one)[-1] for one in replay.taken}
    came = {one for one in numbers if one <= last} - wrong
    assert lost == last + 1 - len(came)
    assert sum(one.lost for one in frames) == lost - 1  # that loss was reported at once
    assert not wrong & {one.sequence for one in frames}


@pytest.mark.parametrize(
    ("scenario", "words"),
    [("gives_up", ["EIO"]), ("unplugged", ["ENODEV", "unplugged", "/dev/video0 (vivid-000"])],
)
async def test_broken_stream_ends_its_readers_and_restarts(
    play: Player, scenario: str, words: list[str]
) -> None:
    replay = play(scenario)
    error, frames = await getattr(scenarios, scenario)()
    whole(replay)
    for word in words:
        assert word in str(error)
    assert [(one.sequence, one.lost) for one in frames] == [(0, 0), (1, 0)]


async def test_failed_start_names_its_step_and_leaves_nothing_open(play: Player) -> None:
    replay = play("no_start")
    errors, frames = await scenarios.no_start()
    whole(replay)
    texts = [str(one) for one in errors]
    for text, word in zip(
        texts, ("asking for buffers", "buffer 0", "starting the stream"), strict=True
    ):
        assert word in text
    assert len(frames) == 1


async def test_unsupported_settings_are_refused_with_the_possible_ones(play: Player) -> None:
    replay = play("refused")
    errors = await scenarios.refused()
    whole(replay)
    shape, size, rate, nothing, null, metadata, planes, bounds, name = errors
    assert "Mono8 (GREY)" in shape.available
    assert "YVYU" in shape.available
    assert "1280x720" in size.available
    assert "641x480, the device took 640x480" in str(size)
    assert rate.available[:3] == ("25/s", "15/s", "12.5/s")
    assert "expected 33 frames/s" in str(rate)
    assert all(isinstance(one, FrameFormatError) for one in (shape, size, rate))
    assert "ENOENT" in str(nothing)
    assert nothing.available[0] == "/dev/video0 (vivid-000-vid-cap)"
    assert "not a V4L2 device" in str(null)
    assert "metadata of a camera" in str(metadata)
    assert "several planes" in str(planes)
    assert "expected 0 to 255, got '256'" in str(bounds)
    assert bounds.available == ("brightness: 0 to 255; default 128, now 128",)
    assert "did you mean 'brightness'" in str(name)
    assert "hue: -128 to 128; default 0, now 0" in name.available


async def test_device_in_use_is_reported(play: Player) -> None:
    play("in_use")
    error = await scenarios.in_use()
    assert "EBUSY, it is in use by another program" in str(error)


async def test_controls_have_ranges_menus_and_values(play: Player) -> None:
    replay = play("controls")
    controls, values, error = await scenarios.controls()
    whole(replay)
    assert str(controls["brightness"]) == "brightness: 0 to 255; default 128, now 128"
    assert controls["menu"].menu == {1: "Menu Item 1", 3: "Menu Item 3", 4: "Menu Item 4"}
    assert controls["integer_menu"].menu[5] == "8"
    assert controls["bitmask"].range == "bits of 0x80402010"
    assert controls["boolean"].range == "0 (off), 1 (on)"
    assert controls["button"].kind == "button"
    assert values == [4, 0, 5, -128]
    assert "expected 1 (Menu Item 1), 3 (Menu Item 3), 4 (Menu Item 4), got 2" in str(error)


async def test_only_cameras_are_found(play: Player, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(discovery, "FORMATS", scenarios.FEW)
    replay = play("found")
    found = await scenarios.found()
    whole(replay)
    assert [one.url for one in found] == [f"v4l2:///dev/video{one}" for one in range(4)]
    assert found[0].name == "vivid"
    assert "YUV422_8 640x480 at 25, 15, 12.5, 10, 5, 4, 2, 1/s" in map(str, found[0].formats)
    assert "YVYU" in found[0].remark


async def test_a_device_that_may_not_be_opened_is_found_with_the_reason(
    play: Player, monkeypatch: pytest.MonkeyPatch
) -> None:
    play("found")

    def refuse(_: str) -> int:
        raise PermissionError(errno.EACCES, "no")

    monkeypatch.setattr(system, "open", refuse)
    found = await scenarios.found()
    assert len(found) == 6
    assert all("EACCES, access is denied" in one.remark for one in found)


def changed(replay: Replay, monkeypatch: pytest.MonkeyPatch, **fields: int) -> None:
    """Change the kernel's fields of each picture."""
    places = {"used": 8, "flags": 12, "sequence": 56}

    def ioctl(device: int, request: abi.Ioctl, argument: bytearray) -> None:
        replay.ioctl(device, request, argument)
        if request.name == "DQBUF":
            for name, value in fields.items():
                argument[places[name] : places[name] + 4] = value.to_bytes(4, "little")

    monkeypatch.setattr(system, "ioctl", ioctl)


async def _reading(expected: type[Exception]) -> str:
    with pytest.raises(expected) as caught:
        await scenarios.stream()
    return str(caught.value)


async def test_half_a_picture_is_never_delivered(
    play: Player, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "MAX_CONSECUTIVE_BAD", 3)
    changed(play("stream"), monkeypatch, used=57600)
    message = await _reading(FrameFormatError)
    assert "expected YUV422_8 320x180, 115200 bytes or more, got 57600 bytes 3 times" in message


async def test_a_device_with_nothing_but_errors_ends(
    play: Player, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "MAX_CONSECUTIVE_BAD", 3)
    changed(play("stream"), monkeypatch, flags=abi.BUF_ERROR | abi.TIMESTAMP_MONOTONIC)
    assert "got an error of the device 3 times" in await _reading(FrameFormatError)


async def test_a_driver_that_does_not_count_has_none_lost(
    play: Player, monkeypatch: pytest.MonkeyPatch
) -> None:
    changed(play("stream"), monkeypatch, sequence=0)
    frames = await scenarios.stream()
    assert [(one.sequence, one.lost) for one in frames] == [(place, 0) for place in range(6)]


async def test_stamps_of_an_unknown_clock_are_arrival(
    play: Player, monkeypatch: pytest.MonkeyPatch
) -> None:
    changed(play("stream"), monkeypatch, flags=0)
    frames = await scenarios.stream()
    assert {(one.moment, one.device_time) for one in frames} == {(Moment.ARRIVAL, None)}


async def test_driver_that_is_ready_for_ever_without_a_frame_ends(
    play: Player, monkeypatch: pytest.MonkeyPatch
) -> None:
    replay = play("stream")

    def ioctl(device: int, request: abi.Ioctl, argument: bytearray) -> None:
        if request.name == "DQBUF":
            raise BlockingIOError
        replay.ioctl(device, request, argument)

    monkeypatch.setattr(system, "ioctl", ioctl)
    assert "reports a picture, but has none" in await _reading(FrameSourceError)


@pytest.mark.parametrize("steps", range(0, 40, 3))
async def test_cancelled_start_leaves_nothing_open(play: Player, steps: int) -> None:
    play("stream")

    async def read() -> None:
        await scenarios.stream()

    task = asyncio.create_task(read())
    for _ in range(steps):
        await asyncio.sleep(0)
    task.cancel()
    await asyncio.wait([task], timeout=10)
    assert task.done()


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("v4l2://dev/video0", "v4l2:///dev/video0"),
        ("v4l2://", "v4l2:///dev/video0"),
        ("v4l2:///dev/video0?rate=3", "control.NAME"),
        ("v4l2:///dev/video0?buffers=1", "from 2 to 32"),
        ("v4l2:///dev/video0?buffers=2.5", "a whole number"),
        ("v4l2:///dev/video0?size=640", "640x480"),
        ("v4l2:///dev/video0?fps=0", "0.001"),
        ("v4l2:///dev/video0?control.gain=1&control.gain=2", "twice"),
    ],
)
def test_wrong_url_is_refused_with_the_expected_form(url: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        smartcam.frames.open(url)


DEFAULT, FULL, LIMITED = 0, 1, 2


@pytest.mark.parametrize(
    ("fourcc", "colorspace", "encoding", "quantization", "name"),
    [
        ("YUYV", 8, 0, DEFAULT, "YUV422_8"),  # sRGB, as most webcams say
        ("YUYV", 1, 0, DEFAULT, "YUV422_8"),  # SMPTE 170M
        ("YUYV", 8, 0, FULL, "YCbCr422_8"),
        ("YUYV", 7, 0, DEFAULT, "YCbCr422_8"),  # JPEG
        ("YUYV", 7, 0, LIMITED, "YUV422_8"),
        ("YUYV", 3, 0, DEFAULT, "YCbCr709_422_8"),  # Rec. 709
        ("YUYV", 3, 1, DEFAULT, "YUV422_8"),  # with BT.601's matrix
        ("UYVY", 8, 2, FULL, "YUV422_8_UYVY_709_full"),
        ("NV12", 10, 0, DEFAULT, "NV12_2020"),  # BT.2020
        ("YU12", 8, 6, FULL, "I420_2020_full"),
        ("422P", 8, 4, DEFAULT, "I422_709"),  # xvYCC of 709
        ("RGB3", 8, 0, DEFAULT, "RGB8"),
        ("BGR3", 8, 0, LIMITED, "BGR8_limited"),
        ("GREY", 8, 0, FULL, "Mono8"),
        ("MJPG", 3, 2, LIMITED, "MJPEG"),
    ],
)
def test_colours_are_those_of_the_device(
    fourcc: str, colorspace: int, encoding: int, quantization: int, name: str
) -> None:
    device = CaptureDevice.__new__(CaptureDevice)
    code = abi.fourcc(fourcc)
    layout = abi.BufferLayout(8, 8, code, 1, 16, 128, colorspace, abi.PRIVATE_MAGIC, 0, encoding)
    read = layout._replace(quantization=quantization)
    assert device._with_matrix_and_range(FORMATS[code], read).name == name
    # an older kernel leaves any values in these fields
    unset = read._replace(private=0)
    by_colorspace = read._replace(ycbcr_enc=0, quantization=0)
    assert device._with_matrix_and_range(FORMATS[code], unset) is device._with_matrix_and_range(
        FORMATS[code], by_colorspace
    )


@pytest.mark.parametrize(("colorspace", "encoding"), [(2, 0), (8, 8), (10, 7)])
def test_unknown_matrix_is_refused(colorspace: int, encoding: int) -> None:
    device = CaptureDevice.__new__(CaptureDevice)
    device.path = "/dev/video0"
    code = abi.fourcc("YUYV")
    layout = abi.BufferLayout(8, 8, code, 1, 16, 128, colorspace, abi.PRIVATE_MAGIC, 0, encoding)
    with pytest.raises(FrameFormatError, match=r"BT.601, BT.709 or BT.2020, the device has"):
        device._with_matrix_and_range(FORMATS[code], layout)


# ------------------------------------------------------------------ colours, through the whole path

FORMAT_FIELDS = struct.Struct("I" if abi.POINTER == 4 else "Q")
COLOUR_FIELDS = struct.Struct("5I")
COLOURS_AT = FORMAT_FIELDS.size + 6 * 4
"""Offset of the color space in ``struct v4l2_format``; private, flags, encoding and quantization
follow."""

WEIGHTS = {"601": (0.299, 0.114), "709": (0.2126, 0.0722), "2020": (0.2627, 0.0593)}
"""Shares of red and blue in Y, from the recommendations of ITU-R."""


class ColouredDevice(Replay):
    """The recorded device with other colours in its format, and a red picture.

    Args:
        colours: color space, ``private``, encoding and quantization.
        red: the four bytes of two red pixels.
    """

    def __init__(self, colours: tuple[int, int, int, int], red: bytes) -> None:
        super().__init__("stream")
        self._colours, self._red = colours, red

    def ioctl(self, device: int, request: abi.Ioctl, argument: bytearray) -> None:
        super().ioctl(device, request, argument)
        if request.name in ("G_FMT", "S_FMT"):
            space, private, encoding, quantization = self._colours
            fields = space, private, 0, encoding, quantization
            COLOUR_FIELDS.pack_into(argument, COLOURS_AT, *fields)

    def close(self, device: int) -> None:
        if self.left[-1].asked != "close":  # the format was refused
            self.left = [Answer("close", "", 0, "", 0)]
        super().close(device)

    def _write(self, argument: bytearray) -> None:
        super()._write(argument)
        for pages in self.mapped:
            if pages.open:
                pages.data[:] = self._red * (len(pages.data) // 4)


def red_pixels(matrix: str, *, full: bool) -> bytes:
    """Return two red pixels as YUYV, by the recommendations' formulas."""
    red, blue = WEIGHTS[matrix]
    y, u, v = red, -red / (2 * (1 - blue)), 0.5
    if full:
        values = [round(255 * y), round(128 + 255 * u), min(255, round(128 + 255 * v))]
    else:
        values = [round(16 + 219 * y), round(128 + 224 * u), round(128 + 224 * v)]
    return bytes([values[0], values[1], values[0], values[2]])


@pytest.mark.parametrize(
    ("colours", "matrix", "full", "name"),
    [
        ((8, abi.PRIVATE_MAGIC, 0, DEFAULT), "601", False, "YUV422_8"),
        ((7, abi.PRIVATE_MAGIC, 0, DEFAULT), "601", True, "YCbCr422_8"),
        ((8, abi.PRIVATE_MAGIC, 0, FULL), "601", True, "YCbCr422_8"),
        ((3, abi.PRIVATE_MAGIC, 0, DEFAULT), "709", False, "YCbCr709_422_8"),
        ((8, abi.PRIVATE_MAGIC, 2, DEFAULT), "709", False, "YCbCr709_422_8"),
        ((3, abi.PRIVATE_MAGIC, 2, FULL), "709", True, "YUV422_8_709_full"),
        ((3, abi.PRIVATE_MAGIC, 1, LIMITED), "601", False, "YUV422_8"),
        ((10, abi.PRIVATE_MAGIC, 0, LIMITED), "2020", False, "YUV422_8_2020"),
        ((8, abi.PRIVATE_MAGIC, 6, FULL), "2020", True, "YUV422_8_2020_full"),
        ((3, 0, 1, FULL), "709", False, "YCbCr709_422_8"),  # a kernel that only knows color spaces
    ],
)
async def test_red_of_an_open_device_is_red_with_any_matrix(
    begin: Begin, colours: tuple[int, int, int, int], matrix: str, full: bool, name: str
) -> None:
    begin(ColouredDevice(colours, red_pixels(matrix, full=full)))
    for frame in await scenarios.stream():
        assert frame.format.name == name
        assert abs(frame.rgb().astype(int) - [255, 0, 0]).max() <= 2


async def test_open_device_of_another_matrix_is_refused_and_released(begin: Begin) -> None:
    begin(ColouredDevice((2, abi.PRIVATE_MAGIC, 0, DEFAULT), bytes(4)))
    with pytest.raises(FrameFormatError, match=r"the device has those of 240M \(color space 2"):
        await scenarios.opened(scenarios.URL)
