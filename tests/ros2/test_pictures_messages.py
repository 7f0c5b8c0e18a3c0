"""Converting pictures, lenses and clouds to messages of ROS and back."""

from __future__ import annotations

import asyncio
import struct
import time
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from smartcam.calibration import CameraModel
from smartcam.exceptions import CalibrationError, FrameFormatError, RosMessageError
from smartcam.frames import Codecs, Frame, Moment, find_format
from smartcam.ros2 import RosTypes, cloud_from, frame_from, pixels_from
from smartcam.ros2._cameras.cloud_messages import (
    cloud_fields,
    compressed_depth_fields,
    depth_fields,
    depth_points,
)
from tests.frames.pictures import RAW_FORMATS as RAW
from tests.ros2.inside import (
    ENCODINGS,
    array_fields,
    choose_compression,
    compressed_fields,
    header_fields_at,
    image_fields,
    lens_fields,
    lens_from,
    to_ros_format,
)

TYPES = RosTypes("jazzy")
IMAGE = TYPES.message("sensor_msgs/msg/Image")
COMPRESSED = TYPES.message("sensor_msgs/msg/CompressedImage")
INFO = TYPES.message("sensor_msgs/msg/CameraInfo")
CLOUD = TYPES.message("sensor_msgs/msg/PointCloud2")
WIDTH, HEIGHT = 12, 6
UTC = 1_700_000_000.25
HEADER = header_fields_at(UTC, "cam")


async def as_png(frame: Frame) -> Frame:
    async with Codecs() as codecs:
        return await codecs.png(frame)


def picture(name: str, padding: int = 0, *, whole: bool = True) -> Frame:
    form = find_format(name)
    stride = form.stride(WIDTH) + padding
    size = form.size(WIDTH, HEIGHT, stride)
    if whole and hasattr(form.layout, "channels"):
        size = stride * HEIGHT
    data = np.random.default_rng(1).integers(0, 256, size, np.uint8)
    if form.depth in (10, 12, 14) and form.bits == 16:
        data[1::2] &= (1 << (form.depth - 8)) - 1
    return Frame(
        data=data.tobytes(),
        format=form,
        width=WIDTH,
        height=HEIGHT,
        stride=stride,
        captured=time.monotonic(),
        utc=UTC,
        moment=Moment.EXPOSURE_START,
        sequence=3,
        source="cam3",
    )


def there(frame: Frame) -> Any:
    """Return the message of a frame after its way through bytes."""
    return IMAGE.decode(IMAGE.encode(image_fields(to_ros_format(frame), "cam3_optical")))


def test_every_format_has_the_same_pixels_there_and_back() -> None:
    for name in RAW:
        frame = picture(name)
        message = there(frame)
        assert (message.width, message.height, message.is_bigendian) == (WIDTH, HEIGHT, 0), name
        assert len(message.data) == message.step * HEIGHT, name
        stamp = message.header.stamp
        assert (stamp.sec, stamp.nanosec) == (1_700_000_000, 250_000_000)
        back = frame_from(message)
        assert back.utc == UTC
        assert back.source == message.header.frame_id == "cam3_optical"
        samples = name in ENCODINGS or name.startswith(("Mono", "Bayer"))
        sent, came = (frame.array(), back.array()) if samples else (frame.rgb(), back.rgb())
        assert sent.any(), name
        assert np.array_equal(sent, came), name


@pytest.mark.parametrize("name", ["Mono8", "Mono16", "RGB8", "YUV422_8", "Coord3D_C16"])
@pytest.mark.parametrize("whole", [True, False])
def test_rows_may_have_padding_also_where_the_last_came_without(name: str, whole: bool) -> None:
    frame = picture(name, padding=6, whole=whole)
    message = there(frame)
    assert message.step == frame.stride
    assert len(message.data) == message.step * HEIGHT
    assert np.array_equal(frame_from(message).array(), frame.array())


def test_encodings_have_the_names_that_ros_gives_them() -> None:
    names = {
        "Mono8": "mono8",
        "Mono12": "mono16",
        "Mono12p": "mono16",
        "BayerRG8": "bayer_rggb8",
        "BayerGB10p": "bayer_gbrg16",
        "BGR8": "bgr8",
        "YUV422_8": "yuv422_yuy2",
        "YUV422_8_UYVY": "yuv422",
        "YCbCr709_422_8": "rgb8",
        "NV12": "rgb8",
        "Coord3D_C16": "16UC1",
    }
    assert {name: there(picture(name)).encoding for name in names} == names


def test_other_encodings_are_read_too() -> None:
    values = np.arange(HEIGHT * WIDTH * 4, dtype=np.uint8).reshape(HEIGHT, WIDTH, 4)
    header = header_fields_at(UTC, "a")
    four = IMAGE.new(**array_fields(values, "bgra8", header))
    assert np.array_equal(frame_from(four).rgb(), values[..., 2::-1])
    depth = np.linspace(0, 9, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
    metres = IMAGE.decode(IMAGE.encode(array_fields(depth, "32FC1", header)))
    assert np.array_equal(pixels_from(metres), depth)
    with pytest.raises(FrameFormatError, match="32FC1"):
        frame_from(metres)
    big = IMAGE.new(
        **array_fields(values[..., 0], "mono8", header)
        | {
            "encoding": "mono16",
            "is_bigendian": 1,
            "step": 2 * WIDTH,
            "data": np.arange(HEIGHT * WIDTH, dtype=">u2").view(np.uint8),
        }
    )
    assert np.array_equal(frame_from(big).array().ravel(), np.arange(HEIGHT * WIDTH))
    assert frame_from(there(picture("Mono8")), source="me", sequence=7).sequence == 7


@pytest.mark.parametrize(
    "change",
    [
        {"encoding": "mono7"},
        {"encoding": ""},
        {"step": WIDTH - 1},
        {"height": HEIGHT + 1},
        {"width": 0},
        {"width": 1 << 31, "step": 1 << 31},
        {"encoding": "rgba8"},
        {"encoding": "mono16", "is_bigendian": 1},
    ],
)
def test_an_image_that_is_none_is_refused(change: dict[str, Any]) -> None:
    fields = image_fields(picture("Mono8"), "a") | change
    with pytest.raises(FrameFormatError, match="expected"):
        frame_from(IMAGE.new(**fields))


def test_the_time_of_a_picture_from_the_future_is_now() -> None:
    before = time.monotonic()
    frame = frame_from(there(replace(picture("Mono8"), utc=time.time() + 100)))
    assert before <= frame.captured <= time.monotonic()
    old = frame_from(there(replace(picture("Mono8"), utc=time.time() - 100)))
    assert 99 < old.age < 101


# ---------------------------------------------------------------------- compressed


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("Mono8", "mono8; jpeg compressed mono8"),
        ("Mono12", "mono8; jpeg compressed mono8"),
        ("RGB8", "rgb8; jpeg compressed bgr8"),
        ("BGR8", "bgr8; jpeg compressed bgr8"),
        ("BayerRG8", "bgr8; jpeg compressed bgr8"),
        ("YUV422_8", "bgr8; jpeg compressed bgr8"),
        ("Coord3D_C16", "16UC1; png compressed 16UC1"),
    ],
)
def test_the_format_of_compressed_pictures(name: str, text: str) -> None:
    assert choose_compression(picture(name)).format_text() == text


def test_compressed_pictures_are_read() -> None:
    from smartcam.frames._inside import decode_frame, to_jpeg

    grey = picture("Mono8")
    jpeg = to_jpeg(grey, 90)
    message = COMPRESSED.decode(COMPRESSED.encode(compressed_fields(jpeg, "x", "a")))
    back = frame_from(message)
    assert (back.format.name, back.width, back.height) == ("MJPEG", WIDTH, HEIGHT)
    assert bytes(back.data) == bytes(jpeg.data)
    assert choose_compression(jpeg).format_text() == "mono8; jpeg compressed mono8"
    depth = picture("Coord3D_C16")
    png = COMPRESSED.new(**compressed_fields(asyncio.run(as_png(depth)), "x", "a"))
    assert np.array_equal(decode_frame(frame_from(png), "Coord3D_C16").array(), depth.array())
    for data in (b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"GIF89a"):
        with pytest.raises(FrameFormatError):
            frame_from(COMPRESSED.new(format="jpeg", data=data))


# ---------------------------------------------------------------------- lenses

MATRIX = np.array([[600.0, 0, 5.5], [0, 610, 2.5], [0, 0, 1]])


@pytest.mark.parametrize(
    ("model", "count"), [("plumb_bob", 5), ("rational_polynomial", 8), ("equidistant", 4)]
)
def test_lenses_there_and_back(model: Any, count: int) -> None:
    coefficients = np.arange(1, count + 1) / 100
    lens = CameraModel(size=(12, 6), matrix=MATRIX, distortion=coefficients, distortion_model=model)
    message = INFO.decode(INFO.encode(lens_fields(lens, header_fields_at(UTC, "a"), (12, 6))))
    assert message.p.tolist() == [600.0, 0, 5.5, 0, 0, 610, 2.5, 0, 0, 0, 1, 0]
    back = lens_from(message)
    assert back is not None
    assert (back.camera.size, back.camera.distortion_model) == ((12, 6), model)
    assert np.array_equal(back.camera.matrix, MATRIX)
    assert np.array_equal(back.camera.distortion, coefficients)
    assert np.array_equal(back.rectification, np.eye(3))


def test_a_camera_that_is_not_calibrated_has_zeros() -> None:
    message = INFO.new(**lens_fields(None, header_fields_at(UTC, "a"), (12, 6)))
    assert (message.width, message.height, message.distortion_model) == (12, 6, "")
    assert not np.any(message.k)
    assert not np.any(message.r)
    assert not np.any(message.p)
    assert not len(message.d)
    assert lens_from(message) is None


@pytest.mark.parametrize(
    "change",
    [
        {"distortion_model": "fisheye62"},
        {"d": np.zeros(7)},
        {"binning_x": 2},
        {"roi": {"x_offset": 3}},
        {"k": np.ravel(MATRIX) * [1, 1, 1, 1, -1, 1, 1, 1, 1]},
        {"k": [600.0, 1, 5.5, 0, 610, 2.5, 0, 0, 1]},
        {"d": [0, 0, float("nan"), 0, 0]},
        {"width": 0},
        {"p": [float("inf")] * 12},
    ],
)
def test_a_lens_that_is_none_is_refused(change: dict[str, Any]) -> None:
    lens = CameraModel(size=(12, 6), matrix=MATRIX)
    fields = lens_fields(lens, header_fields_at(UTC, "a"), (12, 6)) | change
    with pytest.raises((RosMessageError, CalibrationError)):
        lens_from(INFO.new(**fields))


# ---------------------------------------------------------------------- clouds


def test_a_cloud_there_and_back() -> None:
    depth = np.full((4, 5), 2.0, np.float32)
    depth[1, 2] = 0
    lens = CameraModel(size=(5, 4), matrix=np.array([[10.0, 0, 2], [0, 10, 1], [0, 0, 1]]))
    points = depth_points(depth, lens)
    assert np.isnan(points[1, 2]).all()
    assert points[0, 4].tolist() == pytest.approx([0.4, -0.2, 2.0])
    colours = np.arange(60, dtype=np.uint8).reshape(4, 5, 3)
    header = header_fields_at(UTC, "a")
    message = CLOUD.decode(CLOUD.encode(cloud_fields(points, colours, header)))
    assert (message.width, message.height, message.is_dense) == (5, 4, False)
    assert [one.name for one in message.fields] == ["x", "y", "z", "rgb"]
    there = depth.astype(bool)
    found = cloud_from(message)
    assert np.array_equal(found.points, points[there])
    assert found.colours is not None
    assert np.array_equal(found.colours, colours[there])
    plain = CLOUD.new(**cloud_fields(points[there], None, header))
    assert (plain.height, plain.is_dense, plain.point_step) == (1, True, 12)
    assert cloud_from(plain).colours is None
    grey = CLOUD.new(**cloud_fields(points, colours[..., 0], header))
    as_grey = cloud_from(grey).colours
    assert as_grey is not None
    assert np.array_equal(as_grey, np.repeat(colours[..., 0][there][:, None], 3, axis=1))
    empty = CLOUD.new(**cloud_fields(points[:0].reshape(0, 3), None, header))
    assert cloud_from(empty).points.shape == (0, 3)


def test_a_cloud_of_another_kind_is_read() -> None:
    kind = np.dtype(
        {
            "names": ["z", "y", "x", "rgb"],
            "formats": [">f8", ">f8", ">f8", ">u4"],
            "offsets": [0, 8, 16, 28],
            "itemsize": 40,
        }
    )
    rows = np.zeros((2, 3), kind)
    rows["x"], rows["y"], rows["z"], rows["rgb"] = 1, 2, 3, 0xFF010203
    message = CLOUD.new(
        height=2,
        width=3,
        point_step=40,
        row_step=120,
        is_bigendian=True,
        data=rows.reshape(-1).view(np.uint8),
        fields=[
            {"name": name, "offset": at, "datatype": datatype, "count": 1}
            for name, at, datatype in (("x", 16, 8), ("y", 8, 8), ("z", 0, 8), ("rgba", 28, 6))
        ],
    )
    found = cloud_from(message)
    assert found.points.tolist() == [[1, 2, 3]] * 6
    assert found.colours is not None
    assert found.colours.tolist() == [[1, 2, 3]] * 6


@pytest.mark.parametrize(
    "change",
    [
        {"fields": []},
        {"point_step": 8},
        {"row_step": 8},
        {"width": 1 << 30},
        {"data": b""},
        {"fields": [{"name": n, "offset": 0, "datatype": 2, "count": 1} for n in "xyz"]},
        {"fields": [{"name": n, "offset": 1 << 31, "datatype": 7, "count": 1} for n in "xyz"]},
    ],
)
def test_a_cloud_that_is_none_is_refused(change: dict[str, Any]) -> None:
    fields = cloud_fields(np.ones((3, 3), np.float32), None, header_fields_at(UTC, "a"))
    with pytest.raises(RosMessageError, match="point cloud"):
        cloud_from(CLOUD.new(**(fields | change)))


def test_depth_in_millimetres_and_in_metres() -> None:
    depth = np.array([[0, 1.2344, 65.5, 70]], np.float32)
    header = header_fields_at(UTC, "a")
    whole = pixels_from(IMAGE.new(**depth_fields(depth, header, "16UC1")))
    assert whole.tolist() == [[0, 1234, 65500, 0]]
    metres = pixels_from(IMAGE.new(**depth_fields(depth, header)))
    assert np.isnan(metres[0, 0])
    assert np.array_equal(metres[0, 1:], depth[0, 1:])


def decompressed(fields: dict[str, Any]) -> np.ndarray[Any, Any]:
    """Return what compressed_depth_image_transport makes of a message (its ``codec.cpp``)."""
    encoding, _, how = fields["format"].partition("; ")
    assert how == "compressedDepth png"
    kind, a, b = struct.unpack("<iff", fields["data"][:12])
    png = np.frombuffer(fields["data"][12:], np.uint8)
    values: np.ndarray[Any, Any] = np.asarray(cv2.imdecode(png, cv2.IMREAD_UNCHANGED))
    assert kind == 0
    assert values.dtype == np.uint16
    if encoding == "16UC1":
        return values
    with np.errstate(divide="ignore", invalid="ignore"):
        metres = np.float32(a) / (values.astype(np.float32) - np.float32(b))
    return np.where(values > 0, metres, np.nan)


@pytest.mark.parametrize(("near", "far"), [(0.3, 2.0), (0.05, 60.0), (1.0, 1.0)])
def test_compressed_depth_is_read_as_it_was(near: float, far: float) -> None:
    rng = np.random.default_rng(1)
    depth = rng.uniform(near, far, (20, 30)).astype(np.float32)
    depth[0, 0], depth[0, 1] = near, far
    depth[5:7, 3:9] = 0
    fields = compressed_depth_fields(depth, HEADER)
    assert COMPRESSED.new(**fields).header.frame_id == "cam"
    found = decompressed(fields)
    assert np.array_equal(np.isnan(found), depth == 0)
    there = depth > 0
    step = depth**2 * (1 / near - 1 / max(far, near * 1.001)) / 65534
    assert (np.abs(found - depth)[there] <= 0.6 * step[there] + 1e-6 * depth[there]).all()
    whole = decompressed(compressed_depth_fields(depth, HEADER, "16UC1"))
    assert np.array_equal(whole, np.rint(depth * np.float32(1000)))


def test_compressed_depth_of_nothing_is_nothing() -> None:
    nothing = np.zeros((3, 4), np.float32)
    assert np.isnan(decompressed(compressed_depth_fields(nothing, HEADER))).all()
    assert not decompressed(compressed_depth_fields(nothing, HEADER, "16UC1")).any()
