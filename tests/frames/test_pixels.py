"""Pixel formats convert bytes to pixels."""

from __future__ import annotations

import copy
import pickle
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.exceptions import FrameFormatError, MissingExtraError
from smartcam.frames import find_format
from smartcam.frames._inside import Planes, YuvPairs
from smartcam.frames._pixels import compiled
from tests.frames.inside import MATRICES as COLOUR_MATRICES
from tests.frames.inside import PIXEL_FORMATS, with_matrix
from tests.frames.pictures import frame_of, known_of

if TYPE_CHECKING:
    from collections.abc import Iterator

PACKED = [
    (b"\x23\x61\x45\xab\xcd", "Mono10p", [0x123, 0x158, 0x2B4, 0x336]),
    (b"\x23\x61\x45", "Mono12p", [0x123, 0x456]),
    (b"\x12\x63\x45", "Mono12Packed", [0x123, 0x456]),
    (b"\x48\x23\x59", "Mono10Packed", [0x123, 0x166]),
]
"""Bytes and their pixels by the figures of PFNC and GigE Vision, done by hand:
12p 23 61 45 is 0x456123 as a little-endian number, of which the lowest 12 bits come first."""


def packed_by_hand(name: str, pixels: list[int]) -> bytes:
    """Pack one pixel after the other, in plain Python."""
    depth = 10 if "10" in name else 12
    if name.endswith("p"):
        number = sum(pixel << depth * place for place, pixel in enumerate(pixels))
        return number.to_bytes((len(pixels) * depth + 7) // 8, "little")
    packed, low = bytearray(), depth - 8
    for first in range(0, len(pixels), 2):
        pair = pixels[first : first + 2]
        middle = sum((pixel & ((1 << low) - 1)) << 4 * place for place, pixel in enumerate(pair))
        packed += bytes((pair[0] >> low, middle, *(pixel >> low for pixel in pair[1:])))
    return bytes(packed)


@pytest.mark.parametrize(("data", "name", "pixels"), PACKED)
def test_packed_bytes_of_the_standard(data: bytes, name: str, pixels: list[int]) -> None:
    array = find_format(name).array(data, len(pixels), 1, len(data))
    assert array.tolist() == [pixels]
    assert array.dtype == np.uint16
    assert not array.flags.writeable
    assert packed_by_hand(name, pixels) == data


@given(
    name=st.sampled_from([one.name for one in PIXEL_FORMATS if re.search("(p|Packed)$", one.name)]),
    width=st.integers(1, 9),
    height=st.integers(1, 4),
    padding=st.none() | st.integers(0, 3),
    data=st.data(),
)
def test_packing_agrees_with_plain_python(
    name: str, width: int, height: int, padding: int | None, data: st.DataObject
) -> None:
    found = find_format(name)
    values = st.integers(0, (1 << found.depth) - 1)
    rows = data.draw(st.lists(st.lists(values, min_size=width, max_size=width), min_size=height))
    rows = rows[:height]
    if padding is None:  # rows follow each other within a byte
        raw, stride = packed_by_hand(name, [pixel for row in rows for pixel in row]), 0
    else:
        raw = b"".join(packed_by_hand(name, row) + b"\xff" * padding for row in rows)
        stride = found.stride(width) + padding
    assert found.array(raw, width, height, stride).tolist() == rows
    assert found.size(width, height, stride) + (padding or 0) == len(raw)


def test_every_name_code_and_fourcc_finds_its_format() -> None:
    for one in PIXEL_FORMATS:
        keys = (one.name, one.name.lower(), one.fourcc, one.code)
        assert [find_format(key) for key in keys if key] == [one] * sum(map(bool, keys))


def test_codes_contain_the_bits_of_a_pixel() -> None:
    """The third and fourth digit of a code of PFNC are the bits of a pixel."""
    coded = [one for one in PIXEL_FORMATS if one.code]
    assert len(coded) > 40
    assert [one.name for one in coded if one.code >> 16 & 0xFF != one.bits] == []
    assert len({one.code for one in coded}) == len(coded)


def test_names_of_v4l2_are_those_of_the_header() -> None:
    header = Path("/usr/include/linux/videodev2.h")
    if not header.exists():
        pytest.skip("needs Linux' header videodev2.h (Debian: linux-libc-dev)")
    quads = re.findall(r"v4l2_fourcc\('(.)', '(.)', '(.)', '(.)'\)", header.read_text())
    known = {"".join(quad).rstrip() for quad in quads}
    named = {one.fourcc for one in PIXEL_FORMATS} - {""}
    assert len(named) > 25
    assert named - known == set()


def test_alias_and_blanks() -> None:
    assert find_format("Z16 ").name == "Coord3D_C16"
    assert find_format("jpeg").name == "MJPEG"


@pytest.mark.parametrize("name", ["Mono9", 0x01080099])
def test_unknown_format_lists_the_known(name: str | int) -> None:
    with pytest.raises(FrameFormatError, match=r"unknown pixel format .*known are Mono8, ") as got:
        find_format(name)
    assert "NV12" in got.value.available


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_rows_with_padding_are_a_view(kind: type) -> None:
    raw = np.arange(2 * 8, dtype=np.uint8)
    data = kind(raw.tobytes())
    array = find_format("Mono8").array(data, 5, 2, 8)
    assert array.tolist() == raw.reshape(2, 8)[:, :5].tolist()
    assert np.shares_memory(array, np.frombuffer(data, np.uint8))
    assert not array.flags.writeable


def test_last_row_needs_no_padding() -> None:
    assert find_format("Mono8").array(bytes(8 + 5), 5, 2, 8).shape == (2, 5)


def test_sixteen_bit_rows_with_an_odd_stride_are_a_view() -> None:
    raw = bytes([1, 2, 3, 4, 0, 5, 6, 7, 8, 0])
    array = find_format("Mono12").array(raw, 2, 2, 5)
    assert array.tolist() == [[0x201, 0x403], [0x605, 0x807]]
    assert np.shares_memory(array, np.frombuffer(raw, np.uint8))


def test_depth_has_distances_only() -> None:
    depth = find_format("Z16")
    assert depth.array(bytes([1, 2]), 1, 1, 2).tolist() == [[0x201]]
    for read in (depth.grey, depth.rgb):
        with pytest.raises(FrameFormatError, match="got distances"):
            read(bytes(2), 1, 1, 2)


def test_short_bytes_are_refused_at_every_length() -> None:
    for one in (found for found in PIXEL_FORMATS if not found.compressed):
        size, stride = one.size(5, 3), one.stride(5)
        assert one.array(bytes(size), 5, 3, stride).size
        for length in range(size):
            with pytest.raises(FrameFormatError, match=f"expected {size} bytes, got {length}"):
                one.array(bytes(length), 5, 3, stride)
        with pytest.raises(FrameFormatError, match="from row to row"):
            one.array(bytes(size), 5, 3, stride - 1)
        with pytest.raises(FrameFormatError, match="1 or more, got 0x3"):
            one.array(bytes(size), 0, 3, stride)


@pytest.mark.parametrize("name", ["YUYV", "UYVY"])
def test_grey_of_pairs_is_the_cameras_own_plane(name: str) -> None:
    data = bytes(range(16)) + b"\xff\xff"  # two pairs a row, and padding
    found = find_format(name)
    grey = found.grey(data, 4, 2, 9)
    first = 0 if name == "YUYV" else 1
    assert grey.tolist() == [[data[9 * y + first + 2 * x] for x in range(4)] for y in range(2)]
    assert np.shares_memory(grey, np.frombuffer(data, np.uint8))
    assert found.grey_is_sent
    assert found.array(data, 4, 2, 9).shape == (2, 4, 2)


@pytest.mark.parametrize(
    ("name", "planes"),
    [
        ("NV12", ([[0, 1, 2], [4, 5, 6], [8, 9, 10]], [[12, 14], [16, 18]], [[13, 15], [17, 19]])),
        ("I420", ([[0, 1, 2], [4, 5, 6], [8, 9, 10]], [[12, 13], [14, 15]], [[16, 17], [18, 19]])),
    ],
)
def test_planes_with_padding_and_odd_size(name: str, planes: tuple[list[list[int]], ...]) -> None:
    found = find_format(name)
    data = bytes(range(20))
    assert found.size(3, 3, 4) == 20
    assert [plane.tolist() for plane in found.planes(data, 3, 3, 4)] == list(planes)
    assert np.shares_memory(found.grey(data, 3, 3, 4), np.frombuffer(data, np.uint8))
    assert found.rgb(data, 3, 3, 4).shape == (3, 3, 3)
    assert found.array(data, 3, 3, 4).shape == (20,)


MATRICES = {"709": (0.2126, 0.0722), "2020": (0.2627, 0.0593)}
"""Shares of red and blue in Y: ITU-R BT.709-6 and BT.2020-2, tables 4; else BT.601-7's."""


def expected_rgb(y: Any, u: Any, v: Any, name: str, depth: int) -> list[Any]:
    """Return the colours by the formulas of the recommendations, in floating point."""
    red, blue = next((one for end, one in MATRICES.items() if end in name), (0.299, 0.114))
    full = "full" in name or name.startswith("YCbCr422")
    step, most = 2 ** (depth - 8), 2**depth - 1
    bright = y / most if full else (y / step - 16) / 219
    cb, cr = ((one - 128.0 * step) / (most if full else 224 * step) for one in (u, v))
    r, b = bright + 2 * (1 - red) * cr, bright + 2 * (1 - blue) * cb
    g = (bright - red * r - blue * b) / (1 - red - blue)
    return [np.clip(most * one, 0.0, float(most)) for one in (r, g, b)]


COLOURED = [one.name for one in PIXEL_FORMATS if re.match(r"YUV|YCbCr|NV12|I4", one.name)]
"""Formats of Y, U and V."""


@pytest.fixture
def numpy_alone(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Hide OpenCV."""
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "cv2", None)
        compiled.opencv.cache_clear()
        assert compiled.opencv() is None
        yield
    compiled.opencv.cache_clear()


def random_picture(name: str, width: int, height: int, low: int, seed: int) -> tuple[bytes, int]:
    """Return the bytes of a picture whose Y are ``low`` or more, and its stride."""
    found, random = find_format(name), np.random.default_rng(seed)
    stride = found.stride(width) + 4 * int(random.integers(0, 2))
    data = bytearray(random.bytes(found.size(width, height, stride)))
    for plane in found.planes(data, width, height, stride)[:1]:
        plane.flags.writeable = True
        np.maximum(plane, low, out=plane)
    return bytes(data), stride


def expected_picture(name: str, data: bytes, width: int, height: int, stride: int) -> Any:
    """Return the colours (H, W, 3) of a picture, in floating point."""
    found = find_format(name)
    top = (1 << found.depth) - 1
    planes = [np.minimum(one, top) for one in found.planes(data, width, height, stride)]
    rows, columns = np.indices((height, width))
    across, down = 1 + (planes[1].shape[1] < width), 1 + (planes[1].shape[0] < height)
    y, u, v = planes[0], *(one[rows // down, columns // across] for one in planes[1:])
    return np.array(expected_rgb(y.astype(float), u, v, name, found.depth)).transpose(1, 2, 0)


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("low", [0, 16])
@pytest.mark.parametrize("name", COLOURED)
def test_colours_of_any_picture_are_within_a_level(name: str, low: int) -> None:
    for seed, (width, height) in enumerate([(1, 1), (2, 2), (7, 5), (8, 70), (130, 3)]):
        data, stride = random_picture(name, width, height, low, seed)
        got = find_format(name).rgb(data, width, height, stride)
        assert got.shape == (height, width, 3)
        wanted = expected_picture(name, data, width, height, stride)
        assert np.abs(got - wanted).max() < 1


@pytest.mark.sampled(every=3)
@pytest.mark.usefixtures("numpy_alone")
@pytest.mark.parametrize("name", COLOURED)
def test_colours_by_numpy_alone_are_the_nearest(name: str) -> None:
    for seed, (width, height) in enumerate([(1, 1), (2, 2), (7, 5)]):
        data, stride = random_picture(name, width, height, 0, seed)
        got = find_format(name).rgb(data, width, height, stride)
        wanted = expected_picture(name, data, width, height, stride)
        assert np.abs(got - wanted).max() <= 0.501


@pytest.mark.parametrize("matrix", COLOUR_MATRICES)
def test_colours_of_all_u_and_v_are_within_a_level(matrix: str) -> None:
    """Every fifth Y, U and V of 4:4:4, and for OpenCV's own conversions of 4:2:0, too."""
    end = "".join(f"_{part}" for part in matrix.split() if part != "601")
    for name, low in ((f"I444{end}", 0), (f"I420{end}", 16)):
        steps = np.arange(low, 256, 5, dtype=np.uint8)
        y, u, v = (one.reshape(len(steps), -1) for one in np.meshgrid(steps, *[steps] * 2))
        if name.startswith("I420"):
            y = y.repeat(2, axis=0).repeat(2, axis=1)
        data = b"".join(one.tobytes() for one in (y, u, v))
        height, width = y.shape
        got = find_format(name).rgb(data, width, height, width)
        assert np.abs(got - expected_picture(name, data, width, height, width)).max() < 1


@pytest.mark.parametrize("name", ["RGB8", "BGR8", "RGBa8", "BGRa8", "RGB16", "RGBa16"])
def test_grey_of_colours_is_within_a_level(name: str) -> None:
    found = find_format(name)
    kind = np.uint8 if found.depth == 8 else np.uint16
    channels = found.bits // found.depth
    samples = np.random.default_rng(3).integers(0, 2**found.depth, (40, 50, channels), kind)
    samples[0], samples[1] = 2**found.depth - 1, 0
    rgb = samples[..., 2::-1] if name.startswith("BGR") else samples[..., :3]
    wanted = rgb @ np.array([0.299, 0.587, 0.114])
    grey = found.grey(samples.tobytes(), 50, 40, found.stride(50))
    assert grey.dtype == kind
    assert np.abs(grey - wanted).max() < 1
    assert np.array_equal(found.rgb(samples.tobytes(), 50, 40, found.stride(50)), rgb)


@pytest.mark.parametrize("name", COLOURED)
def test_colours_of_known_values_are_those_of_the_formulas(name: str) -> None:
    found = find_format(name)
    step, kind = 2 ** (found.depth - 8), "<u1" if found.depth == 8 else "<u2"
    for plain in [(16, 128, 128), (235, 128, 128), (81, 90, 240), (145, 54, 34), (41, 240, 110)]:
        y, u, v = (one * step + (one % step) for one in plain)
        if name.startswith("Y"):
            first = "UYVY" in name or "CbYCrY" in name
            samples = ([u, y, v, y] if first else [y, u, y, v]) * 2
        else:
            shared = (found.size(2, 2) // (1 if found.depth == 8 else 2) - 4) // 2
            interleaved = name.startswith("NV")
            samples = [y] * 4 + ([u, v] * shared if interleaved else [u] * shared + [v] * shared)
        data = np.array(samples, kind).tobytes()
        got = found.rgb(data, 2, 2, found.stride(2)).astype(float)
        wanted = np.broadcast_to(expected_rgb(y, u, v, name, found.depth), (2, 2, 3))
        assert np.abs(got - wanted).max() <= 0.7, (y, u, v)


def test_every_format_of_y_u_and_v_has_each_matrix() -> None:
    for one in PIXEL_FORMATS:
        if isinstance(one.layout, YuvPairs | Planes):
            for matrix in COLOUR_MATRICES:
                other = with_matrix(one, matrix)
                assert (other.bits, other.depth) == (one.bits, one.depth)
                assert other.layout == replace(one.layout, matrix=matrix)
            assert with_matrix(one, one.layout.matrix) is one


def test_alpha_is_kept_and_left_out_of_colours() -> None:
    data = bytes([1, 2, 3, 4])
    assert find_format("RGBa8").array(data, 1, 1, 4).tolist() == [[[1, 2, 3, 4]]]
    assert find_format("RGBa8").rgb(data, 1, 1, 4).tolist() == [[[1, 2, 3]]]
    assert find_format("BGRa8").rgb(data, 1, 1, 4).tolist() == [[[3, 2, 1]]]
    assert find_format("BGRa8").grey(data, 1, 1, 4).tolist() == [[2]]


def test_limited_red_green_and_blue_are_widened() -> None:
    data = bytes([16, 235, 0, 255, 126, 17])
    assert find_format("RGB8_limited").rgb(data, 2, 1, 6).tolist() == [[[0, 255, 0], [255, 128, 1]]]
    assert find_format("BGR8_limited").rgb(data, 2, 1, 6)[0, 1].tolist() == [1, 128, 255]
    assert find_format("RGB8_limited").array(data, 2, 1, 6)[0, 0].tolist() == [16, 235, 0]


def test_grey_made_of_colours_is_marked() -> None:
    data = bytes([255, 0, 0, 0, 255, 0, 0, 0, 255, 255, 255, 255])
    assert find_format("RGB8").grey(data, 4, 1, 12).tolist() == [[76, 150, 29, 255]]
    assert find_format("BGR8").grey(data, 4, 1, 12).tolist() == [[29, 150, 76, 255]]
    assert find_format("BGR8").rgb(data, 4, 1, 12)[0, 0].tolist() == [0, 0, 255]
    assert not find_format("RGB8").grey_is_sent


def test_colours_of_grey_are_its_grey_three_times() -> None:
    assert find_format("Mono8").rgb(b"\x07\x08", 2, 1, 2).tolist() == [[[7, 7, 7], [8, 8, 8]]]


@pytest.mark.parametrize("pattern", ["RG", "GR", "GB", "BG"])
@pytest.mark.parametrize("end", ["8", "12", "12p", "16"])
def test_bayer_pattern_gives_its_original_colours(pattern: str, end: str) -> None:
    """Each of four fields has one colour, which its middle must have."""
    found = find_format(f"Bayer{pattern}{end}")
    top = (1 << found.depth) - 1
    fields = {(0, 0): (top, 0, 0), (0, 1): (0, top, 0), (1, 0): (0, 0, top), (1, 1): (top, top, 0)}
    letters = pattern + {"RG": "GB", "GR": "BG", "GB": "RG", "BG": "GR"}[pattern]
    rows = [
        [fields[y // 8, x // 8]["RGB".index(letters[y % 2 * 2 + x % 2])] for x in range(16)]
        for y in range(16)
    ]
    flat = np.array(rows, "<u2" if found.depth > 8 else np.uint8)
    data = (
        flat.tobytes()
        if not end.endswith("p")
        else packed_by_hand(end, [pixel for row in rows for pixel in row])
    )
    rgb = found.rgb(data, 16, 16, found.stride(16))
    assert {key: tuple(rgb[4 + 8 * key[0], 4 + 8 * key[1]].tolist()) for key in fields} == fields
    grey = found.grey(data, 16, 16, found.stride(16))
    assert abs(int(grey[4, 12]) - 0.587 * top) <= 0.01 * top
    assert not found.grey_is_sent


def test_bayer_without_opencv_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "cv2", None)
    found = find_format("BayerRG8")
    assert found.array(bytes(4), 2, 2, 2).shape == (2, 2)
    with pytest.raises(MissingExtraError, match=r"smartcam\[calibration\]") as got:
        found.rgb(bytes(4), 2, 2, 2)
    assert got.value.extra == "calibration"


def test_compressed_bytes_are_given_as_they_are() -> None:
    video = find_format("H264")
    assert video.array(b"abc", 640, 480, 0).tolist() == [97, 98, 99]
    assert video.array(b"", 640, 480, 0).size == 0
    for read in (video.grey, video.rgb):
        with pytest.raises(FrameFormatError, match=r"Codecs\.h264_decoder"):
            read(b"abc", 640, 480, 0)


def test_planes_of_another_format_are_refused() -> None:
    with pytest.raises(FrameFormatError, match="a format of Y, U and V"):
        find_format("Mono8").planes(bytes(4), 2, 2, 2)


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_frame_is_pickled_with_bytes_of_any_owner(kind: type) -> None:
    frame = frame_of(np.arange(12, dtype=np.uint8).reshape(3, 4), "Mono8")
    frame = replace(frame, data=kind(frame.data), chunks={"ChunkGain": 1.5})
    sent = pickle.loads(pickle.dumps(frame))  # noqa: S301 - our own
    for one in (sent, copy.copy(frame), copy.deepcopy(frame)):
        assert np.array_equal(one.grey(), frame.grey())
        assert known_of(one) == known_of(frame)
        assert (one.format.name, one.chunks) == ("Mono8", {"ChunkGain": 1.5})
