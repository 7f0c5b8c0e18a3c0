"""A camera's pictures over TCP: the newest, while they have subscribers, each with its lens."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import struct
import sys
import textwrap
import time
from collections.abc import AsyncIterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import smartcam.frames
from smartcam import Backoff
from smartcam.calibration import CameraModel
from smartcam.calibration.formats import read_cameras, write_camera_info
from smartcam.exceptions import (
    ConfigurationError,
    FrameSourceError,
    FrameTimeoutError,
    UnsupportedError,
)
from smartcam.frames import FrameSource, find_format
from smartcam.ros2 import Node, frame_from
from smartcam.ros2._cameras import picture_stream
from smartcam.ros2._cameras.lens import path_from_url
from smartcam.ros2._cameras.pictures import CameraPictures
from smartcam.ros2._inside import DRIVER
from tests.frames.drivers import ScriptedDriver, frame
from tests.processes import free_place
from tests.ros2.inside import header_fields_at, lens_fields
from tests.ros2.roskit import soon, two_nodes, until

pytestmark = pytest.mark.real_time

IMAGE = "sensor_msgs/msg/Image"
INFO = "sensor_msgs/msg/CameraInfo"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
SET = "sensor_msgs/srv/SetCameraInfo"
GET = "smartcam_msgs/srv/RequestImage"
CAM = "/line1/cam3"
LENS = CameraModel(size=(4, 2), matrix=np.array([[5.0, 0, 1.5], [0, 6, 0.5], [0, 0, 1]]))


@contextlib.asynccontextmanager
async def pictures(
    **options: Any,
) -> AsyncIterator[tuple[ScriptedDriver, CameraPictures, Node, Node]]:
    """Give a device that does what the test says, its pictures on ROS, and both nodes."""
    driver = ScriptedDriver()
    source = FrameSource(driver, stall=None, camera_info=options.pop("camera_info", None))
    async with two_nodes() as (here, there), source:
        shown = CameraPictures(None, here, frames=source, **options)
        shown.start()
        try:
            yield driver, shown, here, there
        finally:
            await shown.close()


async def given(driver: ScriptedDriver, *frames: Any) -> None:
    """Have the device give frames, once it streams."""
    async with asyncio.timeout(60):
        await driver.streams()
    driver.give(*frames)


async def heard(node: Node, topic: str, kind: str) -> None:
    """Wait until a node knows that somebody hears a topic of its own."""
    with contextlib.closing(node.publisher(topic, kind, qos=DRIVER)) as other:
        await until(lambda: other.has_subscribers)


def readers(driver: ScriptedDriver) -> int:
    """Return how many read what it streams."""
    return driver.sink.statistics().readers if isinstance(driver.sink, FrameSource) else 0


# ---------------------------------------------------------------------- streams


async def test_the_device_streams_while_somebody_hears() -> None:
    async with pictures(camera_info=LENS) as (driver, shown, here, there):
        assert driver.calls == ["open"]
        images = there.subscribe(f"{CAM}/image_raw", IMAGE)
        infos = there.subscribe(f"{CAM}/camera_info", INFO)
        await heard(here, f"{CAM}/image_raw", IMAGE)
        await heard(here, f"{CAM}/camera_info", INFO)
        for number in (1, 2):
            sent = frame(number, utc=100.5 + number)
            await given(driver, sent)
            image, info = await soon(anext(images)), await soon(anext(infos))
            assert bytes(image.data) == sent.data
            assert (image.encoding, image.width, image.height, image.step) == ("mono8", 4, 2, 4)
            assert image.header.stamp.sec == 100 + number
            assert image.header.stamp.nanosec == 500_000_000
            assert (info.header.stamp, info.header.frame_id) == (
                image.header.stamp,
                image.header.frame_id,
            )
            assert image.header.frame_id == shown.frame_id == "cam3_optical"
            assert info.k.tolist() == LENS.matrix.ravel().tolist()
        images.close()
        infos.close()
        await soon(driver.rests())
        assert driver.calls == ["open", "start", "stop"]
        await shown.close()
        shown.start()
        images = there.subscribe(f"{CAM}/image_raw", IMAGE)
        await given(driver, frame(3))
        assert (await soon(anext(images))).data[0] == 3


async def test_two_hear_all_that_is_offered_and_only_the_last_one_ends_it() -> None:
    async with pictures() as (driver, _, here, there):
        one = there.subscribe(f"{CAM}/image_raw", IMAGE)
        await given(driver, frame(1))
        assert (await soon(anext(one))).data[0] == 1
        async with Node("other", context=here.context) as node:  # which is on the driver's session
            two = node.subscribe(f"{CAM}/image_raw", IMAGE)
            driver.give(frame(2))
            assert (await soon(anext(one))).data[0] == (await soon(anext(two))).data[0] == 2
        driver.give(frame(3))
        assert (await soon(anext(one))).data[0] == 3
        one.close()
        await soon(driver.rests())


async def test_pixels_are_the_same_at_the_far_end() -> None:
    async with pictures() as (driver, _, _, there):
        images = there.subscribe(f"{CAM}/image_raw", IMAGE)
        for name in ("RGB8", "BGR8", "BayerRG8", "Mono12", "Mono12p", "YUV422_8", "Coord3D_C16"):
            form = find_format(name)
            values = np.random.default_rng(2).integers(0, 16, form.size(4, 2), np.uint8)
            sent = frame(1, data=values.tobytes(), format=form, stride=form.stride(4))
            await given(driver, sent)
            back = frame_from(await soon(anext(images)))
            assert np.array_equal(back.array(), sent.array()), name


async def test_a_lens_of_another_size_is_no_lens(caplog: pytest.LogCaptureFixture) -> None:
    other = CameraModel(size=(8, 4), matrix=LENS.matrix)
    async with pictures() as (driver, _, _, there):
        infos = there.subscribe(f"{CAM}/camera_info", INFO)
        for number in (1, 2):
            await given(driver, frame(number, camera_info=other))
            info = await soon(anext(infos))
            assert not np.any(info.k)
            assert (info.width, info.height) == (4, 2)
    assert caplog.text.count("these have 4x2") == 1


async def test_compressed_pictures_have_a_lens_of_their_stamp() -> None:
    async with pictures(camera_info=LENS) as (driver, _, _, there):
        small = there.subscribe(f"{CAM}/image_raw/compressed", COMPRESSED)
        infos = there.subscribe(f"{CAM}/camera_info", INFO)
        await until(lambda: readers(driver) == 2)  # each of the two streams has one
        await given(driver, frame(200))
        message, info = await soon(anext(small)), await soon(anext(infos))
        assert message.format == "mono8; jpeg compressed mono8"
        assert info.header.stamp == message.header.stamp
        assert np.abs(frame_from(message).grey().astype(int) - 200).max() <= 2
        driver.give(frame(2, utc=5.0))
        await soon(anext(infos))  # one, though two streams have the picture
        assert infos.statistics().queued == 0


async def test_a_jpeg_goes_as_it_came_and_decoded() -> None:
    async with (
        two_nodes() as (here, there),
        smartcam.frames.open("synthetic://?format=MJPEG&size=320x64&fps=50") as source,
    ):
        shown = CameraPictures(None, here, frames=source)
        shown.start()
        raw = there.subscribe(f"{CAM}/image_raw", IMAGE)
        small = there.subscribe(f"{CAM}/image_raw/compressed", COMPRESSED)
        image, jpeg = await soon(anext(raw)), await soon(anext(small))
        assert (image.encoding, image.width) == ("mono8", 320)
        assert frame_from(jpeg).grey().shape == (64, 320)
        await shown.close()


async def test_what_ends_or_fails_is_told_once_and_tried_again(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(picture_stream, "CHECK_INTERVAL", 0.01)
    monkeypatch.setattr(picture_stream, "REOPEN_BACKOFF", Backoff(initial=0.01, maximum=0.02))
    async with pictures() as (driver, _, _, there):
        images = there.subscribe(f"{CAM}/image_raw", IMAGE)
        await given(driver, frame(1))
        await soon(anext(images))
        assert driver.sink is not None
        driver.sink.ended(None)
        await until(lambda: driver.calls.count("start") == 2)
        await given(driver, frame(2))
        assert (await soon(anext(images))).data[0] == 2
        driver.fails["start"] = FrameSourceError("scripted: it is in use", source="scripted")
        driver.sink.ended(FrameSourceError("scripted: unplugged", source="scripted"))
        await until(lambda: driver.calls.count("start") > 5)
        driver.fails.clear()
        await until(lambda: driver.sink is not None)
        driver.give(frame(3, data=b"short"), frame(3, data=b"short"))
        await until(lambda: "8 bytes" in caplog.text)
        driver.give(frame(4))
        assert (await soon(anext(images))).data[0] == 4
        images.close()
        await soon(driver.rests())
    for text in ("source of pictures ended", "unplugged", "it is in use", "expected 8 bytes"):
        assert caplog.text.count(text) == 1, text


SLOW = """
    import asyncio, sys
    from smartcam.ros2 import Node

    async def main():
        async with Node("slow", connect=sys.argv[1], domain=7) as node:
            async for message in node.subscribe("/line1/cam3/image_raw", "sensor_msgs/msg/Image"):
                print(message.data[0], flush=True)

    asyncio.run(main())
"""


async def test_a_subscriber_that_is_stopped_holds_up_nobody() -> None:
    place, driver = free_place(), ScriptedDriver()
    large = {"width": 1280, "height": 1024, "stride": 1280}
    async with (
        Node("cam3", namespace="line1", listen=place, domain=7) as here,
        Node("viewer", connect=place, domain=7) as there,
        FrameSource(driver, stall=None) as source,
    ):
        shown = CameraPictures(None, here, frames=source)
        shown.start()
        slow = await asyncio.create_subprocess_exec(
            sys.executable, "-c", textwrap.dedent(SLOW), place, stdout=asyncio.subprocess.PIPE
        )
        try:
            images = there.subscribe(f"{CAM}/image_raw", IMAGE)
            assert slow.stdout is not None
            await until(lambda: len(here.graph.endpoints(f"{CAM}/image_raw", "MS")) == 2)
            line = b""
            while not line:  # until it hears them
                await given(driver, frame(1, data=bytes([1]) * (1280 * 1024), **large))
                await soon(anext(images))
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(0.2):
                        line = await slow.stdout.readline()
            os.kill(slow.pid, signal.SIGSTOP)
            for number in range(2, 22):  # 26 MB, more than all queues on the way have room for
                driver.give(frame(number, data=bytes([number]) * (1280 * 1024), **large))
                async with asyncio.timeout(4.5):  # the engine gives one up after 5 s
                    assert (await anext(images)).data[0] == number
        finally:
            with contextlib.suppress(ProcessLookupError):
                slow.kill()
            await slow.wait()
            await shown.close()


def there_is_a_task(name: str) -> bool:
    return any(one.get_name().startswith(name) for one in asyncio.all_tasks())


async def test_it_ends_in_the_middle_of_a_picture_and_once_only() -> None:
    async with pictures() as (driver, shown, here, there):
        images = there.subscribe(f"{CAM}/image_raw", IMAGE)
        await given(driver, *[frame(n) for n in range(5)])
        closing = asyncio.create_task(shown.close())
        await asyncio.sleep(0)
        closing.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await closing
        await soon(driver.rests())
        await until(lambda: not there_is_a_task("pictures of"))
        await shown.close()
        await until(lambda: not here.graph.endpoints(f"{CAM}/image_raw", "MP"))
        images.close()


@pytest.mark.parametrize("options", [{"quality": 0}, {"camera_info_url": "http://a/b.yaml"}])
def test_values_that_cannot_be_are_refused(options: dict[str, Any]) -> None:
    source = SimpleNamespace(frames=None, has_frames=True)
    node = SimpleNamespace(name="cam3", full_name="/cam3")
    with pytest.raises(ConfigurationError, match="expected"):
        CameraPictures(source, node, **options)  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match="expected"):
        CameraPictures(None, node)


def test_where_a_lens_is_kept() -> None:
    assert path_from_url("") is None
    assert path_from_url("file:///a/b%20c.yaml") == Path("/a/b c.yaml")
    assert path_from_url("b.yaml") == Path("b.yaml")


# ---------------------------------------------------------------------- set_camera_info


def request(size: tuple[int, int] = (4, 2), **change: Any) -> dict[str, Any]:
    lens = CameraModel(size=size, matrix=LENS.matrix, distortion=np.arange(5) / 100)
    return {"camera_info": lens_fields(lens, header_fields_at(1.0, "a"), size) | change}


async def test_a_lens_that_is_set_is_kept_and_published(tmp_path: Path) -> None:
    path = tmp_path / "cam3.yaml"
    turn = [0.0, -1, 0, 1, 0, 0, 0, 0, 1]
    straight = [7.0, 0, 1, -3, 0, 7, 1, 0, 0, 0, 1, 0]
    async with pictures(camera_info_url=path.as_uri()) as (driver, _, _, there):
        infos = there.subscribe(f"{CAM}/camera_info", INFO)
        await given(driver, frame(1, camera_info=LENS))
        assert not np.any((await soon(anext(infos))).d)  # that of the frames
        client = there.client(f"{CAM}/set_camera_info", SET)
        reply = await client.call(request(r=turn, p=straight))
        assert reply.success, reply.status_message
        driver.give(frame(2))
        info = await soon(anext(infos))
        assert info.d.tolist() == [0, 0.01, 0.02, 0.03, 0.04]
        assert (info.r.tolist(), info.p.tolist()) == (turn, straight)
    (kept,) = read_cameras(path, "camera_info").cameras
    assert np.array_equal(kept.matrix, LENS.matrix)
    async with pictures(camera_info_url=str(path)) as (driver, _, _, there):
        infos = there.subscribe(f"{CAM}/camera_info", INFO)
        await given(driver, frame(1))
        assert (await soon(anext(infos))).p.tolist() == straight


async def test_a_lens_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cam3.yaml"
    write_camera_info(path, LENS)
    before = path.read_bytes()
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"size": (8, 4)}, "expected the size of the pictures, 4x2, got 8x4"),
        ({"k": np.zeros(9)}, "K[0] = 0"),
        ({"distortion_model": "fov"}, "plumb_bob"),
        ({"d": [1.0, 2]}, "with 2"),
        ({"binning_x": 2}, "whole picture"),
    ]
    async with pictures(camera_info_url=str(path)) as (_, _, _, there):
        client = there.client(f"{CAM}/set_camera_info", SET)
        for change, says in wrong:
            reply = await client.call(request(**change))
            assert not reply.success
            assert says in reply.status_message
            assert path.read_bytes() == before


async def test_a_lens_that_cannot_be_kept_is_refused(tmp_path: Path) -> None:
    for url, says in (("", "camera_info_url"), (str(tmp_path / "no/such.yaml"), "no")):
        async with pictures(camera_info_url=url) as (_, _, _, there):
            reply = await there.client(f"{CAM}/set_camera_info", SET).call(request())
            assert not reply.success
            assert says in reply.status_message


async def test_a_file_that_is_none_leaves_the_camera_uncalibrated(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "cam3.yaml"
    path.write_bytes(b"\xff\xfe image_width: [")
    async with pictures(camera_info_url=str(path)) as (driver, _, _, there):
        infos = there.subscribe(f"{CAM}/camera_info", INFO)
        await given(driver, frame(1))
        assert not np.any((await soon(anext(infos))).k)
    assert str(path) in caplog.text


# ---------------------------------------------------------------------- one on request


async def test_a_picture_on_request_is_exposed_after_it() -> None:
    async with pictures(camera_info=LENS) as (driver, _, _, there):
        client = there.client(f"{CAM}/request_image", GET)
        asking = asyncio.create_task(client.call())
        await soon(driver.streams())
        driver.give(frame(1, captured=time.monotonic() - 100), frame(2, utc=7.25))
        reply = await soon(asking)
        assert reply.error == ""
        image, info = reply.image, reply.camera_info
        assert (image.header.stamp.sec, image.header.stamp.nanosec) == (7, 250_000_000)
        assert image.data[0] == 2
        assert (info.header, info.k[0]) == (image.header, 5.0)
        await soon(driver.rests())


async def test_a_request_without_a_picture_ends_in_its_time() -> None:
    async with pictures() as (driver, _, _, there):
        client = there.client(f"{CAM}/request_image", GET)
        reply = await client.call({"timeout": 0.05})
        assert "in time" in reply.error
        for wrong in (-1.0, 61.0, float("nan")):
            assert "timeout: expected 0 to 60" in (await client.call({"timeout": wrong})).error
        driver.fails["start"] = FrameSourceError("scripted: it is in use", source="scripted")
        assert "in use" in (await client.call()).error


def bitmap(value: int) -> bytes:
    """Return a file of 4 x 2 grey pixels."""
    palette = b"".join(bytes([n, n, n, 0]) for n in range(256))
    offset = 54 + len(palette)
    head = struct.pack("<2sIHHI", b"BM", offset + 8, 0, 0, offset)
    info = struct.pack("<IiiHHIIiiII", 40, 4, 2, 1, 8, 0, 8, 0, 0, 256, 0)
    return head + info + palette + bytes([value]) * 8


class LastPicture:
    """A camera that can be asked for its last picture, and has no frames."""

    name = "line1/cam3"
    capabilities = SimpleNamespace(read_image=True)

    def __init__(self) -> None:
        self.file = bitmap(1)
        self.waits = False

    def frames(self, **_: Any) -> Any:
        raise UnsupportedError("no frames")

    async def read_image(self, *, timeout: float | None = None) -> bytes:
        if self.waits:
            raise FrameTimeoutError("no answer")
        return self.file


async def test_of_a_camera_with_single_pictures_they_come_on_request(tmp_path: Path) -> None:
    camera: Any = LastPicture()
    async with two_nodes() as (here, there):
        shown = CameraPictures(camera, here, camera_info_url=str(tmp_path / "a.yaml"))
        shown.start()
        assert not here.graph.endpoints(f"{CAM}/image_raw", "MP")
        client = there.client(f"{CAM}/request_image", GET)
        for number in range(3):
            camera.file = bitmap(number)
            reply = await client.call()
            assert (reply.error, bytes(reply.image.data)) == ("", bytes([number]) * 8)
        reply = await there.client(f"{CAM}/set_camera_info", SET).call(request())
        assert reply.success, reply.status_message
        camera.file = b"GIF89a"
        assert "bitmap" in (await client.call()).error
        camera.waits = True
        assert "no answer" in (await client.call()).error
        await shown.close()


class Fleet(LastPicture):
    """A camera of a fleet, whose agent encodes what is asked for."""

    def __init__(self, source: FrameSource) -> None:
        super().__init__()
        self.source, self.has_frames = source, True
        self.asked: list[Any] = []

    @contextlib.asynccontextmanager
    async def frames(self, **options: Any) -> AsyncIterator[Any]:
        self.asked.append(options)
        async with self.source.reader(timeout=options["timeout"]) as reader:
            yield reader

    async def frame_after(self, *, timeout: float) -> Any:
        return await self.source.after(time.monotonic(), timeout=timeout)


async def test_a_camera_of_a_fleet_gives_jpegs_where_those_are_heard(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with (
        two_nodes() as (here, there),
        smartcam.frames.open("synthetic://?size=320x64&fps=50") as source,
    ):
        camera: Any = Fleet(source)
        shown = CameraPictures(camera, here, frame_id="a", quality=40)
        shown.start()
        small = there.subscribe(f"{CAM}/image_raw/compressed", COMPRESSED)
        assert (await soon(anext(small))).header.frame_id == "a"
        assert [(one["encoding"], one["quality"]) for one in camera.asked] == [("jpeg", 40)]
        reply = await there.client(f"{CAM}/request_image", GET).call()
        assert reply.error == ""
        await shown.close()
        assert source.statistics().readers == 0
    assert not [one for one in caplog.records if one.levelno > logging.INFO]
