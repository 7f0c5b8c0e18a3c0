"""Frames of FFmpeg become smartcam's frames with the same samples, from any layout."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smartcam import frames
from smartcam.exceptions import FrameFormatError
from smartcam.frames import Frame, find_format
from smartcam.frames._pixels.layouts import SampleLayout
from smartcam.frames._video.frames import from_av_frame
from tests.frames.inside import MATRICES, PIXEL_FORMATS, to_jpegxl, to_png, yuv_to_rgb
from tests.frames.pictures import frame_of

if TYPE_CHECKING:
    from collections.abc import Callable

av = pytest.importorskip("av")

WIDTH, HEIGHT = 37, 19
"""Odd, so that the last column and row of U and V belong to half a pair."""


def filled(name: str, bits: int = 8, seed: int = 7) -> tuple[Any, list[Any]]:
    """Return a frame of FFmpeg of random samples, and the samples of each plane."""
    video = av.VideoFrame(WIDTH, HEIGHT, name)
    chance = np.random.default_rng(seed)
    planes = []
    for plane in video.planes:
        kind = np.dtype(np.uint8 if bits == 8 else ">u2" if name.endswith("be") else "<u2")
        shape = (plane.height, plane.line_size // kind.itemsize)
        samples = chance.integers(0, 2**bits, shape).astype(kind)
        plane.update(samples.tobytes())
        planes.append(samples)
    return video, planes


def pixels(video: Any) -> tuple[Any, Any]:
    """Return the resulting format, and the samples."""
    came = from_av_frame(video)
    return came.format, came.format.array(came.data, came.width, came.height, came.stride)


def planes_of(video: Any) -> tuple[Any, list[Any]]:
    """Return the resulting format, and its Y, U and V."""
    came = from_av_frame(video)
    return came.format, list(came.format.planes(came.data, came.width, came.height, came.stride))


@pytest.mark.parametrize(
    ("name", "order", "to"),
    [
        ("rgba", [0, 1, 2, 3], "RGBa8"),
        ("bgra", [0, 1, 2, 3], "BGRa8"),
        ("argb", [1, 2, 3, 0], "RGBa8"),
        ("abgr", [3, 2, 1, 0], "RGBa8"),
        ("bgr0", [2, 1, 0], "RGB8"),
        ("0rgb", [1, 2, 3], "RGB8"),
        ("rgb24", [0, 1, 2], "RGB8"),
    ],
)
def test_samples_of_eight_bits_side_by_side(name: str, order: list[int], to: str) -> None:
    video, (samples,) = filled(name)
    found, came = pixels(video)
    size = 3 if name == "rgb24" else 4
    wanted = samples[:, : size * WIDTH].reshape(HEIGHT, WIDTH, size)[..., order]
    assert found.name == to
    assert np.array_equal(came, wanted)


@pytest.mark.parametrize(
    ("name", "order", "to"),
    [
        ("rgb48be", [0, 1, 2], "RGB16"),
        ("rgb48le", [0, 1, 2], "RGB16"),
        ("bgr48le", [2, 1, 0], "RGB16"),
        ("rgba64be", [0, 1, 2, 3], "RGBa16"),
        ("gray16be", [0], "Mono16"),
    ],
)
def test_samples_of_sixteen_bits_in_either_order(name: str, order: list[int], to: str) -> None:
    video, (samples,) = filled(name, 16)
    found, came = pixels(video)
    wanted = samples[:, : len(order) * WIDTH].reshape(HEIGHT, WIDTH, -1)[..., order]
    assert found.name == to
    assert np.array_equal(came.reshape(wanted.shape), wanted.astype(np.uint16))


@pytest.mark.parametrize(("name", "bits"), [("gray10be", 10), ("gray12be", 12), ("gray14be", 14)])
def test_grey_of_few_bits_keeps_its_depth(name: str, bits: int) -> None:
    video, (samples,) = filled(name, bits)
    found, came = pixels(video)
    assert (found.name, found.depth) == (f"Mono{bits}", bits)
    assert np.array_equal(came, samples[:, :WIDTH])


def test_planes_of_red_green_and_blue() -> None:
    video, (green, blue, red) = filled("gbrp")
    found, came = pixels(video)
    assert found.name == "RGB8"
    assert np.array_equal(came, np.dstack([red, green, blue])[:, :WIDTH])


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_deep_planes_of_red_green_and_blue_keep_their_order(bits: int) -> None:
    video, (green, _, _) = filled(f"gbrp{bits}le", bits)
    found, came = pixels(video)
    assert found.name == "RGB16"
    scaled = green[:, :WIDTH].astype(float) * 65535 / (2**bits - 1)
    assert np.abs(came[..., 1] - scaled).max() <= 2 ** (16 - bits)
    assert np.array_equal(came[..., 1] >> (16 - bits), green[:, :WIDTH])


def test_palette_and_alpha_of_grey() -> None:
    video, (samples, *_) = filled("ya8")
    found, came = pixels(video)
    pairs = samples[:, : 2 * WIDTH].reshape(HEIGHT, WIDTH, 2)
    assert found.name == "RGBa8"
    assert np.array_equal(came, pairs[..., [0, 0, 0, 1]])


@pytest.mark.parametrize(("name", "to"), [("monob", 255), ("monow", 0)])
def test_one_bit_is_black_or_white(name: str, to: int) -> None:
    video, (samples,) = filled(name)
    found, came = pixels(video)
    bits = np.unpackbits(samples, axis=1)[:, :WIDTH]
    assert found.name == "Mono8"
    assert np.array_equal(came, np.where(bits, to, 255 - to))


@pytest.mark.parametrize(
    ("name", "bits", "to"),
    [
        *((f"yuv{digits}p", 8, f"I{digits}") for digits in ("420", "422", "444")),
        *((f"yuvj{digits}p", 8, f"I{digits}_full") for digits in ("420", "422", "444")),
        *(
            (f"yuv{digits}p{bits}le", bits, f"I{digits}_{bits}")
            for digits in ("420", "422", "444")
            for bits in (10, 12, 16)
        ),
        ("yuv420p10be", 10, "I420_10"),
        ("yuv444p16be", 16, "I444_16"),
    ],
)
def test_planes_of_y_u_and_v(name: str, bits: int, to: str) -> None:
    video, samples = filled(name, bits)
    found, came = planes_of(video)
    assert (found.name, found.depth) == (to, bits)
    for one, wanted in zip(came, samples, strict=True):
        assert np.array_equal(one, wanted[:, : one.shape[1]])


@pytest.mark.parametrize(
    ("name", "to"), [("nv12", "NV12"), ("nv21", "I420"), ("nv16", "I422"), ("nv24", "I444")]
)
def test_woven_planes(name: str, to: str) -> None:
    video, (y, interleaved) = filled(name)
    found, (first, u, v) = planes_of(video)
    pairs = interleaved[:, : 2 * u.shape[1]].reshape(u.shape[0], -1, 2)
    assert found.name == to
    assert np.array_equal(first, y[:, :WIDTH])
    for one, place in ((u, 0), (v, 1)):
        assert np.array_equal(one, pairs[..., place ^ (name == "nv21")])


def test_woven_planes_of_ten_bits_in_the_high_bits() -> None:
    video, (y, interleaved) = filled("p010le", 16)
    y, interleaved = y & 0xFFC0, interleaved & 0xFFC0
    for plane, samples in zip(video.planes, (y, interleaved), strict=True):
        plane.update(samples.tobytes())
    found, (first, u, _) = planes_of(video)
    assert found.name == "I420_10"
    assert np.array_equal(first, y[:, :WIDTH] >> 6)
    assert np.array_equal(u, interleaved[:, : 2 * u.shape[1] : 2] >> 6)


@pytest.mark.parametrize("name", ["p010le", "p016le", "p210le", "p416be", "y210le", "xv48le"])
def test_deep_rows_of_an_odd_width_are_those_of_a_wider_picture(name: str) -> None:
    """FFmpeg alone writes colour into Y here."""
    chance, first = np.random.default_rng(7), []
    wide, narrow = (av.VideoFrame(width, 481, name) for width in (672, 641))
    for whole, part in zip(wide.planes, narrow.planes, strict=True):
        rows = chance.integers(0, 2**16, (whole.height, whole.line_size // 2)).astype("<u2")
        rows &= 0xFFC0 if "10" in name else 0xFFFF
        whole.update(rows.tobytes())
        part.update(np.ascontiguousarray(rows[:, : part.line_size // 2]).tobytes())
    for video in (wide, narrow):
        found, (y, *_) = planes_of(video)
        assert found.name.startswith("I4")
        first.append(y[:, :641])
    assert np.array_equal(*first)


@pytest.mark.skipif(av.__version__ < "18", reason="older versions crash")
def test_format_that_ffmpeg_cannot_convert_is_an_error_of_ours() -> None:
    with pytest.raises(FrameFormatError, match="rgb4: no conversion to rgb24"):
        from_av_frame(av.VideoFrame(16, 16, "rgb4"))


@pytest.mark.parametrize(
    ("name", "across", "down"),
    [("yuv411p", 4, 1), ("yuv410p", 4, 4), ("yuv440p", 1, 2), ("yuvj440p", 1, 2)],
)
def test_other_sharing_is_repeated(name: str, across: int, down: int) -> None:
    video, (y, u, v) = filled(name)
    found, came = planes_of(video)
    assert found.name == ("I444_full" if "j" in name else "I444")
    for one, wanted, times in (
        (came[0], y, (1, 1)),
        (came[1], u, (down, across)),
        (came[2], v, (down, across)),
    ):
        wider = wanted.repeat(times[0], axis=0).repeat(times[1], axis=1)
        assert np.array_equal(one, wider[:HEIGHT, :WIDTH])


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize(("space", "end"), [(1, "_709"), (2, ""), (5, ""), (6, ""), (9, "_2020")])
@pytest.mark.parametrize(("told", "full"), [(0, ""), (1, ""), (2, "_full")])
@pytest.mark.parametrize("name", ["yuv420p", "nv12", "nv21", "yuv420p10le", "p010le", "yuv411p"])
def test_matrix_and_range_are_those_of_the_stream(
    name: str, told: int, full: str, space: int, end: str
) -> None:
    video, _ = filled(name, 16 if "10" in name else 8)
    video.color_range, video.colorspace = told, space
    found = from_av_frame(video).format
    assert found.name.endswith(end + full)
    assert ("709" in found.name, "2020" in found.name) == ("709" in end, "2020" in end)
    assert ("full" in found.name) == bool(full)


@pytest.mark.parametrize("alpha", [255, 128])
def test_alpha_after_y_u_and_v(alpha: int) -> None:
    video, (y, u, v, _) = filled("yuva444p")
    plane = video.planes[3]
    plane.update(bytes([alpha]) * plane.buffer_size)
    found, came = pixels(video) if alpha != 255 else planes_of(video)
    if alpha == 255:  # opaque
        assert found.name == "I444"
        assert np.array_equal(came[1], u[:, :WIDTH])
        return
    assert found.name == "RGBa8"
    rgb = yuv_to_rgb(y, (u, v), MATRICES["601"])[:, :WIDTH]
    assert np.array_equal(came, np.dstack([rgb, np.full((HEIGHT, WIDTH), alpha, np.uint8)]))


@pytest.mark.parametrize("name", ["grayf32le", "gbrpf32le", "xyz12le", "yuva444p10le"])
def test_formats_that_would_lose_values_are_refused_by_name(name: str) -> None:
    with pytest.raises(FrameFormatError, match=f"{name}: expected one that converts without loss"):
        from_av_frame(av.VideoFrame(WIDTH, HEIGHT, name))


def test_other_matrix_is_refused() -> None:
    video, _ = filled("yuv420p")
    video.colorspace = 7
    with pytest.raises(FrameFormatError, match="AVColorSpace 7"):
        from_av_frame(video)


# ------------------------------------------------------------------ files


async def first_frame(path: Path) -> Frame:
    async with frames.open(str(path)) as source:
        return await source.newest()


def write(path: Path, codec: str, video: Any, **options: str) -> None:
    """Write a file of one picture with FFmpeg."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = video.width, video.height, video.format.name
        stream.options = options
        for packet in [*stream.encode(video), *stream.encode(None)]:
            container.mux(packet)


@pytest.mark.sampled(every=2)
@pytest.mark.parametrize(
    ("file", "codec", "name"),
    [
        ("colours.png", "png", "rgb24"),
        ("alpha.png", "png", "rgba"),
        ("deep.png", "png", "rgb48be"),
        ("deep_alpha.png", "png", "rgba64be"),
        ("grey.png", "png", "gray"),
        ("deep_grey.png", "png", "gray16be"),
        ("grey_alpha.png", "png", "ya8"),
        ("bits.png", "png", "monob"),
        ("colours.tiff", "tiff", "rgb24"),
        ("deep.tif", "tiff", "rgb48le"),
        ("deep_grey.tif", "tiff", "gray16le"),
        ("alpha.tif", "tiff", "rgba"),
        ("colours.bmp", "bmp", "bgr24"),
        ("deep.ppm", "ppm", "rgb48be"),
        ("lossless.avi", "magicyuv", "gbrp"),
        ("lossless10.mkv", "ffv1", "gbrp10le"),
        ("lossless_alpha.avi", "magicyuv", "gbrap"),
        ("yuv10.mkv", "ffv1", "yuv420p10le"),
        ("yuv12.mkv", "ffv1", "yuv444p12le"),
        ("yuv_alpha.mkv", "ffv1", "yuva420p"),
    ],
)
async def test_file_gives_the_written_pixels(
    tmp_path: Path, file: str, codec: str, name: str
) -> None:
    bits = 16 if "16" in name or "48" in name or "64" in name else 10 if "10" in name else 8
    video, _ = filled(name, 12 if "12" in name else bits)
    wanted, samples = pixels(video)
    write(tmp_path / file, codec, video)
    frame = await first_frame(tmp_path / file)
    assert frame.rgb().shape == (HEIGHT, WIDTH, 3)
    assert frame.format is wanted
    if samples.ndim > 1:
        assert np.array_equal(frame.array(), samples)
    else:
        came = frame.format.planes(frame.data, WIDTH, HEIGHT, frame.stride)
        assert all(map(np.array_equal, came, planes_of(video)[1]))


async def test_error_of_a_lossy_file_names_the_cure(tmp_path: Path) -> None:
    video, _ = filled("yuva444p10le", 10)
    write(tmp_path / "a.mkv", "ffv1", video)
    with pytest.raises(FrameFormatError, match=r"yuva444p10le: expected .*#format=RGB8 converts"):
        await first_frame(tmp_path / "a.mkv")


async def test_palette_gives_its_colours(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    colours = np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    palette = image.fromarray(colours).quantize(64)
    palette.save(tmp_path / "palette.png")
    frame = await first_frame(tmp_path / "palette.png")
    assert np.array_equal(frame.rgb(), np.asarray(palette.convert("RGB")))


@pytest.mark.parametrize(("file", "name"), [("a.webp", "bgra"), ("b.webp", "yuva420p")])
async def test_webp_with_alpha(tmp_path: Path, file: str, name: str) -> None:
    video, _ = filled(name)
    write(tmp_path / file, "libwebp", video, lossless=str(int(name == "bgra")))
    frame = await first_frame(tmp_path / file)
    assert frame.format.name in ("RGBa8", "BGRa8")
    if name == "bgra":
        hidden = frame.array()[..., 3] == 0  # the encoder makes their colours one
        assert np.array_equal(frame.rgb()[~hidden], from_rgb(video)[~hidden])


def from_rgb(video: Any) -> Any:
    came = from_av_frame(video)
    return came.format.rgb(came.data, came.width, came.height, came.stride)


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize(
    "name", [one.name for one in PIXEL_FORMATS if isinstance(one.layout, SampleLayout)]
)
async def test_written_pictures_are_read_back(tmp_path: Path, name: str) -> None:
    found = find_format(name)
    layout, top = found.layout, 2**found.depth
    assert isinstance(layout, SampleLayout)
    if layout.packing is None:
        channels = layout.channels
        shape = (HEIGHT, WIDTH, channels) if channels > 1 else (HEIGHT, WIDTH)
        samples = np.random.default_rng(5).integers(0, top, shape)
        frame = frame_of(samples.astype(f"<u{layout.sample_bytes}"), name)
    else:
        data = np.random.default_rng(5).bytes(found.size(WIDTH, HEIGHT))
        frame = replace(
            frame_of(np.zeros((HEIGHT, WIDTH), np.uint8), "Mono8"),
            data=data, format=found, stride=found.stride(WIDTH),
        )  # fmt: skip
    (tmp_path / "x.png").write_bytes(to_png(frame).data)
    (tmp_path / "x.jxl").write_bytes(to_jpegxl(frame).data)
    for place in (tmp_path / one for one in ("x.png", "*.png", "x.jxl", "*.jxl")):
        back = await first_frame(place)
        wanted = frame.rgb() if name.endswith("_limited") else frame.array()
        if name in ("BGR8", "BGRa8"):
            wanted = wanted[..., [2, 1, 0, *range(3, wanted.shape[2])]]
        assert np.array_equal(back.array(), wanted)


async def test_jpegxl_is_converted_and_may_be_among_other_pictures(tmp_path: Path) -> None:
    colours = np.random.default_rng(6).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    frame = frame_of(colours, "RGB8")
    (tmp_path / "1.png").write_bytes(to_png(frame).data)
    (tmp_path / "2.jxl").write_bytes(to_jpegxl(frame_of(255 - colours, "RGB8")).data)
    async with frames.open(f"{tmp_path}#pace=none") as source:
        seen = [one.array() async for one in source.reader()]
    assert [np.array_equal(*one) for one in zip(seen, (colours, 255 - colours), strict=True)]
    for name, wanted in (("Mono8", frame.grey()), ("BGR8", colours[..., ::-1])):
        there = 255 - (await first_frame(Path(f"{tmp_path}/2.jxl#format={name}"))).array()
        assert np.abs(there.astype(int) - wanted).max() <= 1


@pytest.mark.parametrize(
    ("file", "data", "message"),
    [
        ("cut.jxl", lambda whole: whole[:-20], "expected a whole picture"),
        ("none.jxl", lambda _: b"GIF89a", "expected a JPEG XL"),
        ("empty.jxl", lambda _: b"", "expected a JPEG XL"),
        (
            "named.bin",
            lambda whole: whole,
            "expected video that FFmpeg decodes here, got piped jpegxl",
        ),
        ("array.npy", lambda _: b"\x93NUMPY", "cannot be read: Invalid data"),
    ],
)
async def test_error_of_an_invalid_file_names_the_cause(
    tmp_path: Path, file: str, data: Callable[[bytes], bytes], message: str
) -> None:
    whole = to_jpegxl(frame_of(np.zeros((HEIGHT, WIDTH, 3), np.uint8), "RGB8")).data
    (tmp_path / file).write_bytes(data(bytes(whole)))
    with pytest.raises(FrameFormatError, match=message):
        await first_frame(tmp_path / file)


async def test_error_of_another_codec_names_the_cause(tmp_path: Path) -> None:
    """FFmpeg does not read a TIFF of 32-bit floats, which is common."""
    head = struct.pack("<2sHI", b"II", 42, 8)
    tags = {256: 4, 257: 4, 258: 32, 259: 1, 262: 1, 273: 200, 277: 1, 278: 4, 279: 64, 339: 3}
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, one) for tag, one in tags.items())
    body = head + struct.pack("<H", len(tags)) + entries + bytes(4)
    (tmp_path / "floats.tif").write_bytes(body.ljust(200, b"\0") + np.ones(16, "<f4").tobytes())
    with pytest.raises(FrameFormatError, match=r"the video ended without one: .*[Ii]nvalid data"):
        await first_frame(tmp_path / "floats.tif")
