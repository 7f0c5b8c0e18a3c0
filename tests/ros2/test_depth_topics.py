"""Depth of two cameras on topics of ROS."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import Any

import numpy as np
import pytest

from smartcam.calibration import CameraModel
from smartcam.depth import Cloud, DepthFrame
from smartcam.exceptions import ConfigurationError, FrameTimeoutError
from smartcam.geometry import Transform
from smartcam.ros2 import DepthTopics, cloud_from, frame_from, pixels_from
from smartcam.ros2._inside import LATCHED
from tests.ros2.roskit import soon, two_nodes, until
from tests.ros2.tfkit import TransformTree

TOPICS = {
    "disparity": "stereo_msgs/msg/DisparityImage",
    "depth/image_rect": "sensor_msgs/msg/Image",
    "depth/image_rect/compressedDepth": "sensor_msgs/msg/CompressedImage",
    "depth/camera_info": "sensor_msgs/msg/CameraInfo",
    "points2": "sensor_msgs/msg/PointCloud2",
    "left/image_rect": "sensor_msgs/msg/Image",
    "left/camera_info": "sensor_msgs/msg/CameraInfo",
    "right/camera_info": "sensor_msgs/msg/CameraInfo",
}

pytestmark = pytest.mark.real_time

LENS = CameraModel(size=(6, 4), matrix=np.array([[100.0, 0, 2.5], [0, 100, 1.5], [0, 0, 1]]))
BASELINE = 0.1


def depth_frame(number: int = 1) -> DepthFrame:
    disparity = np.full((4, 6), 5.0, np.float32)
    disparity[1, 2] = np.nan
    depth = np.where(np.isnan(disparity), 0, 100 * BASELINE / disparity).astype(np.float32)
    return DepthFrame(
        depth=depth,
        sigma=depth * np.float32(0.01),
        disparity=disparity,
        left=np.arange(72, dtype=np.uint8).reshape(4, 6, 3),
        camera_info=LENS,
        baseline=BASELINE,
        captured=time.monotonic(),
        utc=100.0 + number,
        skew=0.0,
        sequences=(number, number),
    )


class Pair:
    """Two cameras whose pictures the test gives."""

    def __init__(self) -> None:
        self.frames: asyncio.Queue[DepthFrame] = asyncio.Queue()
        self.opened = self.closed = 0
        self.min_depth = 0.5

    async def __aenter__(self) -> Any:
        self.opened += 1
        return self

    async def __aexit__(self, *_: object) -> None:
        self.closed += 1

    def __aiter__(self) -> Any:
        return self

    async def __anext__(self) -> DepthFrame:
        try:
            async with asyncio.timeout(0.05):
                return await self.frames.get()
        except TimeoutError:
            raise FrameTimeoutError("none", source="pair") from None


async def test_all_that_is_heard_is_what_was_found() -> None:
    pair: Any = Pair()
    async with two_nodes() as (here, there):
        topics = DepthTopics(lambda: pair, here)
        topics.start()
        hears = {
            name: there.subscribe(f"/line1/cam3/{name}", kind) for name, kind in TOPICS.items()
        }
        await until(lambda: all(one.has_subscribers for one in topics._publishers.values()))
        frame = depth_frame()
        pair.frames.put_nowait(frame)
        came = {name: await soon(anext(one)) for name, one in hears.items()}
        for message in came.values():
            assert message.header.frame_id == topics.frame_id == "cam3_left_optical"
            assert message.header.stamp.sec == 101
        disparity = came["disparity"]
        assert (disparity.f, disparity.min_disparity, disparity.max_disparity) == (100, 0, 20)
        assert disparity.t == np.float32(BASELINE)
        values = pixels_from(disparity.image)
        none = np.isnan(frame.disparity)
        assert (values[none] < disparity.min_disparity).all()
        assert np.array_equal(values[~none], frame.disparity[~none])
        metres = pixels_from(came["depth/image_rect"])
        assert np.array_equal(np.nan_to_num(metres), frame.depth)
        assert np.isnan(metres[1, 2])
        assert np.array_equal(frame_from(came["left/image_rect"]).rgb(), frame.left)
        points = came["points2"]
        assert (points.height, points.width, points.is_dense) == (4, 6, False)
        found = Cloud(*cloud_from(points))
        wanted = Cloud.from_depth(frame.depth, LENS.matrix, frame.left)
        assert np.allclose(found.points, wanted.points, atol=1e-6)
        assert found.colours is not None
        assert np.array_equal(found.colours, np.asarray(wanted.colours))
        left, right = came["left/camera_info"], came["right/camera_info"]
        assert left.k.tolist() == right.k.tolist() == LENS.matrix.ravel().tolist()
        assert left.p[3] == 0
        assert right.p[3] == -100 * BASELINE
        assert not np.any(left.d)
        for one in hears.values():
            one.close()
        await until(lambda: pair.closed)
        await topics.close()
        await topics.close()
        assert (pair.opened, pair.closed) == (1, 1)


async def test_a_pair_of_the_callers_stays_open_and_clouds_may_be_dense() -> None:
    pair: Any = Pair()
    async with two_nodes() as (here, there):
        topics = DepthTopics(pair, here, depth_encoding="16UC1", organized=False, frame_id="l")
        topics.start()
        depths = there.subscribe("/line1/cam3/depth/image_rect", TOPICS["depth/image_rect"])
        clouds = there.subscribe("/line1/cam3/points2", TOPICS["points2"])
        await until(lambda: topics._publishers["points2"].has_subscribers)
        await until(lambda: topics._publishers["depth/image_rect"].has_subscribers)
        frame = depth_frame()
        pair.frames.put_nowait(frame)
        depth, cloud = await soon(anext(depths)), await soon(anext(clouds))
        assert depth.header.frame_id == cloud.header.frame_id == "l"
        assert np.array_equal(
            frame_from(depth).array(), np.rint(frame.depth * 1000).astype(np.uint16)
        )
        assert (cloud.height, cloud.width, cloud.is_dense) == (1, 23, True)
        await topics.close()
        assert (pair.opened, pair.closed) == (0, 0)


async def test_tf_finds_the_cloud_from_base_link() -> None:
    pair: Any = Pair()
    tilt = Transform.from_quaternion("rect", "l", (0, 0, 0), (np.sin(0.05), 0, 0, np.cos(0.05)))
    pair.rotation = tilt.rotation
    place = Transform.from_quaternion("flange", "l", (0.1, 0, 0.05), (0, 0, 0.6, 0.8))
    tree = TransformTree()
    tree.put("base_link", "tool0", (0.5, 0.2, 0.7), (1, 0, 0, 0))
    async with two_nodes() as (here, there):
        topics = DepthTopics(lambda: pair, here, place=place, parent_frame="tool0")
        topics.start()
        clouds = there.subscribe("/line1/cam3/points2", TOPICS["points2"])
        frames = there.subscribe("/tf_static", "tf2_msgs/msg/TFMessage", qos=LATCHED)
        await until(lambda: pair.opened)
        pair.frames.put_nowait(depth_frame())
        cloud = await soon(anext(clouds))
        tree.hear(await soon(anext(frames)))
        found = tree.lookup("base_link", cloud.header.frame_id)
        robot = tree.lookup("base_link", "tool0")
        seen = np.array([[0.1, 0.2, 1.0]])
        wanted = robot.apply(place.apply(tilt.inverse().apply(seen)))
        assert np.allclose(found.apply(seen), wanted)
        await topics.close()


async def test_closing_in_the_middle_closes_the_cameras() -> None:
    pair: Any = Pair()
    async with two_nodes() as (here, there):
        topics = DepthTopics(lambda: pair, here)
        topics.start()
        clouds = there.subscribe("/line1/cam3/points2", TOPICS["points2"])
        await until(lambda: pair.opened)
        pair.frames.put_nowait(depth_frame())
        closing = asyncio.create_task(topics.close())
        await asyncio.sleep(0)
        closing.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await closing
        await until(lambda: pair.closed)
        await until(lambda: not here.graph.endpoints("/line1/cam3/points2", "MP"))
        clouds.close()


def test_an_encoding_that_depth_has_not() -> None:
    with pytest.raises(ConfigurationError, match="16UC1"):
        DepthTopics(Pair(), None, depth_encoding="mono8")  # type: ignore[arg-type]
