"""Publish the depth of two cameras: disparity, depth, a cloud, and their ``CameraInfo``."""

from __future__ import annotations

import asyncio
import contextlib
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from smartcam.exceptions import ConfigurationError
from smartcam.geometry import Transform
from smartcam.ros2._cameras.cloud_messages import (
    cloud_fields,
    compressed_depth_fields,
    depth_fields,
    depth_points,
    disparity_fields,
)
from smartcam.ros2._cameras.image_messages import array_fields, header_fields_at
from smartcam.ros2._cameras.lens_messages import lens_fields
from smartcam.ros2._cameras.picture_stream import SubscribedPictures, publish_newest
from smartcam.ros2._cameras.transforms import StaticTransforms
from smartcam.ros2._node.qos import DRIVER

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from smartcam.calibration import HandEyeCalibration
    from smartcam.depth import DepthFrame, StereoDepth

TOPICS: Final = {
    "disparity": "stereo_msgs/msg/DisparityImage",
    "depth/image_rect": "sensor_msgs/msg/Image",
    "depth/image_rect/compressedDepth": "sensor_msgs/msg/CompressedImage",
    "depth/camera_info": "sensor_msgs/msg/CameraInfo",
    "points2": "sensor_msgs/msg/PointCloud2",
    "left/image_rect": "sensor_msgs/msg/Image",
    "left/camera_info": "sensor_msgs/msg/CameraInfo",
    "right/camera_info": "sensor_msgs/msg/CameraInfo",
}
"""Names, private to the node, and types, the same as in ROS' ``stereo_image_proc``."""


class DepthTopics:
    """Publishes the depth of two cameras while it has a subscriber, the newest pair only.

    ::

        topics = DepthTopics(lambda: StereoDepth(open(LEFT), open(RIGHT), calibration), node)

    All messages of a pair have one stamp, the time of the left picture's capture, and one frame:
    the frame of the left camera after rectification, z ahead and y down. With ``place`` the frame
    is on ``/tf_static`` from the first pair on.

    Args:
        stereo: function that returns a new :class:`smartcam.depth.StereoDepth`, not open, when a
            subscriber comes; or an open one, which the caller closes, and which always streams.
        node: open node of ROS.
        frame_id: frame id of the left camera after rectification; "": the node's name with
            ``_left_optical``.
        depth_encoding: ``32FC1``, metres, or ``16UC1``, millimetres.
        place: place of the left camera: its hand-eye calibration, or a transform from the left
            camera's frame; None: not known, and not published.
        parent_frame: name of the parent frame of ``place``; empty: the name that ``place`` has.
        organized: whether clouds have a point for each pixel, NaN for no depth; otherwise they
            have only valid points.

    Raises:
        ConfigurationError: another encoding.
    """

    def __init__(
        self,
        stereo: StereoDepth | Callable[[], StereoDepth],
        node: Any,
        *,
        frame_id: str = "",
        depth_encoding: Literal["32FC1", "16UC1"] = "32FC1",
        organized: bool = True,
        place: HandEyeCalibration | Transform | None = None,
        parent_frame: str = "",
    ) -> None:
        if depth_encoding not in {"32FC1", "16UC1"}:
            raise ConfigurationError(
                f"depth_encoding: expected 32FC1 or 16UC1, got {depth_encoding!r:.40}"
            )
        self._stereo, self._node = stereo, node
        self.frame_id: str = frame_id or f"{node.name}_left_optical"
        self._encoding, self._organized = depth_encoding, organized
        place_or_calibration: Any = place
        self._place: Transform | None = getattr(
            place_or_calibration, "camera_pose", place_or_calibration
        )
        self._parent_frame = parent_frame
        self._transforms = StaticTransforms(node)
        self._min_depth = 0.0
        self._publishers: dict[str, Any] = {}
        self._stream: SubscribedPictures[DepthFrame] | None = None
        self._thread: ThreadPoolExecutor | None = None

    def start(self) -> None:
        """Declare the topics; the cameras stream while there is a subscriber."""
        if self._stream is not None:
            return
        for name, type_name in TOPICS.items():
            self._publishers[name] = self._node.publisher(f"~/{name}", type_name, qos=DRIVER)
        self._thread = ThreadPoolExecutor(1, "smartcam-ros2-depth")
        publishers = list(self._publishers.values())
        self._stream = SubscribedPictures(
            self._node.full_name, publishers, self._open_stereo, self._publish
        )
        self._stream.start()

    async def close(self) -> None:
        """Withdraw the topics; a pair that the caller opened stays open. Idempotent.

        Cancellation: everything is still closed.
        """
        stream, self._stream = self._stream, None
        try:
            if stream is not None:
                await stream.close()
        finally:
            for publisher in self._publishers.values():
                publisher.close()
            self._publishers.clear()
            await self._transforms.close()
            thread, self._thread = self._thread, None
            if thread is not None:
                thread.shutdown(wait=False, cancel_futures=True)

    @contextlib.asynccontextmanager
    async def _open_stereo(self, _: float) -> AsyncIterator[StereoDepth]:
        if callable(self._stereo):
            async with self._stereo() as stereo:
                self._use_stereo(stereo)
                yield stereo
        else:
            self._use_stereo(self._stereo)
            yield self._stereo

    def _use_stereo(self, stereo: StereoDepth) -> None:
        """Keep the smallest depth of an open pair, and publish the left camera's transform."""
        self._min_depth, place = stereo.min_depth, self._place
        if place is not None:
            rectification = Transform(place.source, self.frame_id, stereo.rotation.T, np.zeros(3))
            rectified = place @ rectification
            parent = self._parent_frame or place.target
            transform = Transform(parent, self.frame_id, rectified.rotation, rectified.translation)
            self._transforms.replace([transform])

    async def _publish(self, frame: DepthFrame) -> None:
        publishers = {
            name: publisher
            for name, publisher in self._publishers.items()
            if getattr(publisher, "has_subscribers", True)
        }
        if self._thread is None or not publishers:
            return
        loop = asyncio.get_running_loop()
        for name, publisher in publishers.items():
            fields = await loop.run_in_executor(self._thread, self._make_fields, name, frame)
            await publish_newest(publisher, fields)

    def _make_fields(self, name: str, frame: DepthFrame) -> dict[str, Any]:
        header = header_fields_at(frame.utc, self.frame_id)
        focal = float(frame.camera_info.matrix[0, 0])
        if name == "disparity":
            largest = focal * frame.baseline / self._min_depth
            return disparity_fields(frame.disparity, header, focal, frame.baseline, largest)
        if name == "depth/image_rect":
            return depth_fields(frame.depth, header, self._encoding)
        if name == "depth/image_rect/compressedDepth":
            return compressed_depth_fields(frame.depth, header, self._encoding)
        if name == "points2":
            return self._cloud_fields(frame, header)
        if name == "left/image_rect":
            return array_fields(frame.left, "mono8" if frame.left.ndim == 2 else "rgb8", header)
        lens, projection = frame.camera_info, None
        if name == "right/camera_info":
            # ROS' projection is from the left rectified frame, so it includes the shift
            projection = np.column_stack([lens.matrix, [-focal * frame.baseline, 0, 0]])
        height, width = frame.depth.shape
        return lens_fields(lens, header, (width, height), projection=projection)

    def _cloud_fields(self, frame: DepthFrame, header: dict[str, Any]) -> dict[str, Any]:
        points, colours = depth_points(frame.depth, frame.camera_info), frame.left
        if not self._organized:
            valid = frame.depth > 0
            points, colours = points[valid], colours[valid]
        return cloud_fields(points, colours, header)
