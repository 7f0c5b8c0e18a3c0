"""The driver with the answers of a real kernel; tests/frames/vivid has them anew, with pictures."""

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
    """Have a replay answer in the system's stead; devices and buffers are to be given back."""
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
    """Have the system answer as it did."""

    def play_scenario(scenario: str) -> Replay:
        replay = Replay(scenario)
        begin(replay)
        return replay

    return play_scenario


def whole(replay: Replay) -> None:
    """See that all was asked that was asked of the kernel, but for pictures."""
    assert [one for one in replay.left if one.asked not in ("DQBUF", "QBUF")] == []


async def test_a_stream_is_whole_numbered_and_stamped_as_the_kernel_did(play: Player) -> None:
    replay = play("stream")
    frames = await scenarios.stream()
    whole(replay)
    assert [one.sequence for one in frames] == list(range(6))
    for one in frames:
        assert (one.width, one.height, one.stride, one.lost) == (320, 180, 640, 0)
        assert one.format.name == "YUV422_8"
        # of the right buffer, and not of what the driver wrote into it afterwards
        assert one.data == bytes([one.sequence + 1]) * 115200
    assert {one.moment for one in frames} == {Moment.FRAME_END}
    steps = [b.captured - a.captured for a, b in itertools.pairwise(frames)]
    assert steps == pytest.approx([0.04] * 5, abs=0.01)
    assert all(0.08 <= one.duration < 0.12 for one in frames)
    assert all(one.device_time is None for one in frames)


async def test_a_stamp_of_the_start_of_the_exposure_is_told(play: Player) -> None:
    replay = play("exposure")
    frames = await scenarios.exposure()
    whole(replay)
    assert {(one.moment, one.duration) for one in frames} == {(Moment.EXPOSURE_START, 0.0)}


async def test_a_stamp_that_cannot_be_is_arrival_and_said_once(
    play: Player, caplog: pytest.LogCaptureFixture
) -> None:
    play("wrapped")
    frames = await scenarios.wrapped()
    assert {one.moment for one in frames} == {Moment.ARRIVAL}
    assert all(abs((one.device_time or 0) - one.captured) > 1e9 for one in frames)
    assert all(0.08 <= one.duration < 0.3 for one in frames)
    assert len([one for one in caplog.records if "cannot be" in one.getMessage()]) == 1


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
    assert sum(one.lost for one in frames) == lost - 1  # that one was told at once
    assert not wrong & {one.sequence for one in frames}


@pytest.mark.parametrize(
    ("scenario", "words"),
    [("gives_up", ["EIO"]), ("unplugged", ["ENODEV", "unplugged", "/dev/video0 (vivid-000"])],
)
async def test_a_stream_that_breaks_ends_its_readers_and_begins_anew(
    play: Player, scenario: str, words: list[str]
) -> None:
    replay = play(scenario)
    error, frames = await getattr(scenarios, scenario)()
    whole(replay)
    for word in words:
        assert word in str(error)
    assert [(one.sequence, one.lost) for one in frames] == [(0, 0), (1, 0)]


async def test_a_start_that_fails_says_where_and_leaves_nothing(play: Player) -> None:
    replay = play("no_start")
    errors, frames = await scenarios.no_start()
    whole(replay)
    texts = [str(one) for one in errors]
    for text, word in zip(
        texts, ("asking for buffers", "buffer 0", "starting the stream"), strict=True
    ):
        assert word in text
    assert len(frames) == 1


async def test_what_a_device_has_not_is_refused_with_what_it_has(play: Player) -> None:
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


async def test_a_device_in_use_says_so(play: Player) -> None:
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


async def test_cameras_are_found_and_other_devices_left_out(
    play: Player, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    assert all("EACCES, not allowed" in one.remark for one in found)


def changed(replay: Replay, monkeypatch: pytest.MonkeyPatch, **fields: int) -> None:
    """Have the kernel say something else of each picture."""
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
    monkeypatch.setattr(stream, "MAX_BAD_IN_A_ROW", 3)
    changed(play("stream"), monkeypatch, used=57600)
    said = await _reading(FrameFormatError)
    assert "expected YUV422_8 320x180, 115200 bytes or more, got 57600 bytes 3 times" in said


async def test_a_device_with_nothing_but_errors_ends(
    play: Player, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "MAX_BAD_IN_A_ROW", 3)
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


async def test_a_driver_that_says_full_for_ever_and_gives_nothing_ends(
    play: Player, monkeypatch: pytest.MonkeyPatch
) -> None:
    replay = play("stream")

    def ioctl(device: int, request: abi.Ioctl, argument: bytearray) -> None:
        if request.name == "DQBUF":
            raise BlockingIOError
        replay.ioctl(device, request, argument)

    monkeypatch.setattr(system, "ioctl", ioctl)
    assert "says that a picture is there, and gives no picture" in await _reading(FrameSourceError)


@pytest.mark.parametrize("steps", range(0, 40, 3))
async def test_a_start_that_is_cancelled_leaves_nothing(play: Player, steps: int) -> None:
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
def test_a_wrong_url_says_what_is_expected(url: str, words: str) -> None:
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
def test_colours_are_what_the_device_tells(
    fourcc: str, colorspace: int, encoding: int, quantization: int, name: str
) -> None:
    device = CaptureDevice.__new__(CaptureDevice)
    code = abi.fourcc(fourcc)
    layout = abi.BufferLayout(8, 8, code, 1, 16, 128, colorspace, abi.PRIVATE_MAGIC, 0, encoding)
    told = layout._replace(quantization=quantization)
    assert device._coloured(FORMATS[code], told).name == name
    # a kernel that does not know the fields leaves anything there
    untold = told._replace(private=0)
    by_colorspace = told._replace(ycbcr_enc=0, quantization=0)
    assert device._coloured(FORMATS[code], untold) is device._coloured(FORMATS[code], by_colorspace)


@pytest.mark.parametrize(("colorspace", "encoding"), [(2, 0), (8, 8), (10, 7)])
def test_matrix_that_is_not_known_is_refused(colorspace: int, encoding: int) -> None:
    device = CaptureDevice.__new__(CaptureDevice)
    device.path = "/dev/video0"
    code = abi.fourcc("YUYV")
    layout = abi.BufferLayout(8, 8, code, 1, 16, 128, colorspace, abi.PRIVATE_MAGIC, 0, encoding)
    with pytest.raises(FrameFormatError, match=r"BT.601, BT.709 or BT.2020, the device has"):
        device._coloured(FORMATS[code], layout)


# ------------------------------------------------------------------ colours, through the whole path

FORMAT_FIELDS = struct.Struct("I" if abi.POINTER == 4 else "Q")
COLOUR_FIELDS = struct.Struct("5I")
COLOURS_AT = FORMAT_FIELDS.size + 6 * 4
"""Byte of ``struct v4l2_format`` at which the color space stands; private, flags, encoding and
quantization follow."""

WEIGHTS = {"601": (0.299, 0.114), "709": (0.2126, 0.0722), "2020": (0.2627, 0.0593)}
"""Shares of red and blue in Y, from the recommendations of ITU-R."""


class ColouredDevice(Replay):
    """The recorded device, whose format tells other colours, and whose picture is red.

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
        if self.left[-1].asked != "close":  # it was refused
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
        said = [round(255 * y), round(128 + 255 * u), min(255, round(128 + 255 * v))]
    else:
        said = [round(16 + 219 * y), round(128 + 224 * u), round(128 + 224 * v)]
    return bytes([said[0], said[1], said[0], said[2]])


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
async def test_red_of_an_open_device_is_red_whatever_colours_it_tells(
    begin: Begin, colours: tuple[int, int, int, int], matrix: str, full: bool, name: str
) -> None:
    begin(ColouredDevice(colours, red_pixels(matrix, full=full)))
    for frame in await scenarios.stream():
        assert frame.format.name == name
        assert abs(frame.rgb().astype(int) - [255, 0, 0]).max() <= 2


async def test_open_device_of_another_matrix_is_refused_and_given_back(begin: Begin) -> None:
    begin(ColouredDevice((2, abi.PRIVATE_MAGIC, 0, DEFAULT), bytes(4)))
    with pytest.raises(FrameFormatError, match=r"the device has those of 240M \(color space 2"):
        await scenarios.opened(scenarios.URL)
