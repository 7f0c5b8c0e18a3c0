"""A camera's pictures in ROS: ``image_raw``, ``camera_info``, ``image_raw/compressed``."""

from __future__ import annotations

import asyncio
import collections
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeVar

from smartcam.exceptions import ConfigurationError, RosError, UnsupportedError
from smartcam.frames import Codecs, FrameSource
from smartcam.ros2._cameras.image_messages import (
    ENCODINGS,
    choose_compression,
    compressed_fields,
    image_fields,
    to_ros_format,
)
from smartcam.ros2._cameras.lens import CameraLens
from smartcam.ros2._cameras.picture_requests import PictureRequests, take_frame
from smartcam.ros2._cameras.picture_stream import SubscribedPictures, publish_newest
from smartcam.ros2._node.qos import DRIVER

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractAsyncContextManager

    from smartcam.camera import Camera
    from smartcam.frames import Frame, FrameReader

Value = TypeVar("Value")

SIZE_TIMEOUT: Final = 10.0
"""Seconds that taking a picture may take, if it is taken only to know its size."""

MAX_STAMPS: Final = 16
"""Number of remembered stamps, so that one ``camera_info`` is published for each stamp."""


class CameraPictures:
    """Publishes a camera's pictures while there is a subscriber, and serves single pictures.

    Topics, private to the node: ``image_raw``, ``camera_info``, ``image_raw/compressed``; services:
    ``set_camera_info`` and ``request_image``. A picture and its ``camera_info`` have one stamp: the
    time of the capture. A slow subscriber gets the newest picture, and delays no other.

    Args:
        camera: the camera; None if there is only ``frames``.
        node: open node of ROS.
        frames: an open source of pictures, which the caller closes; None: the camera's own
            :meth:`~smartcam.Camera.frames`, if it has some.
        frame_id: the optical frame, z ahead and y down (REP-103); "": the node's name with
            ``_optical``.
        camera_info_url: the file of the lens, ``file:///PATH`` or a path, which need not exist
            yet; "": no file, and the frames' lens is used.
        quality: quality of JPEGs, 1 to 100.

    Raises:
        ConfigurationError: a value is not valid, or there is neither a camera nor a source.
    """

    def __init__(
        self,
        camera: Camera[Any] | None,
        node: Any,
        *,
        frames: FrameSource | None = None,
        frame_id: str = "",
        camera_info_url: str = "",
        quality: int = 85,
    ) -> None:
        if camera is None and frames is None:
            raise ConfigurationError("pictures: expected a camera or a source of frames, got none")
        if not 1 <= quality <= 100:
            raise ConfigurationError(f"pictures: quality: expected 1 to 100, got {quality!r}")
        self._camera, self._node, self._frames, self._quality = camera, node, frames, quality
        self.frame_id: str = frame_id or f"{node.name}_optical"
        self._lens = CameraLens(node.name, self.frame_id, camera_info_url, self._picture_size)
        self._requests = PictureRequests(node, self.frame_id, self._lens, self._take_frame)
        self._closables: list[Any] = []
        self._streams: list[SubscribedPictures[Frame]] = []
        self._stamps: collections.deque[float] = collections.deque(maxlen=MAX_STAMPS)
        self._size: tuple[int, int] | None = None
        self._codecs = Codecs(threads=1)
        self._thread: ThreadPoolExecutor | None = None

    @property
    def has_frames(self) -> bool:
        """True if the camera or source delivers a stream of frames, not only single pictures."""
        if self._frames is not None:
            return True
        has_frames = getattr(self._camera, "has_frames", None)
        if has_frames is not None:
            return bool(has_frames)
        try:
            self._make_reader(1.0)
        except UnsupportedError:
            return False
        return True

    def start(self) -> None:
        """Declare topics and services; the device streams while there is a subscriber."""
        if self._thread is not None:
            return
        self._thread = ThreadPoolExecutor(1, "smartcam-ros2-pictures")
        self._codecs = Codecs(threads=1)
        self._codecs.begin()
        node = self._node
        if self.has_frames:
            image = node.publisher("~/image_raw", "sensor_msgs/msg/Image", qos=DRIVER)
            info = node.publisher("~/camera_info", "sensor_msgs/msg/CameraInfo", qos=DRIVER)
            compressed = node.publisher(
                "~/image_raw/compressed", "sensor_msgs/msg/CompressedImage", qos=DRIVER
            )
            self._closables += [image, info, compressed]
            self._image, self._info, self._compressed = image, info, compressed
            name = node.full_name
            self._streams = [
                SubscribedPictures(name, (image, info), self._make_reader, self._publish_raw),
                SubscribedPictures(
                    name,
                    (compressed,),
                    partial(self._make_reader, encoding="jpeg"),
                    self._publish_compressed,
                ),
            ]
        self._closables.append(
            node.serve(
                "~/set_camera_info",
                "sensor_msgs/srv/SetCameraInfo",
                self._lens.serve_set_camera_info,
            )
        )
        type_name = "smartcam_msgs/srv/RequestImage"
        self._closables.append(node.serve("~/request_image", type_name, self._requests.serve))
        for stream in self._streams:
            stream.start()

    async def close(self) -> None:
        """Withdraw topics and services; a source that the caller opened stays open. Idempotent.

        Cancellation: everything is still closed.
        """
        streams, self._streams = self._streams, []
        for stream in streams:
            stream.cancel()
        try:
            for stream in streams:
                await stream.close()
        finally:
            for closable in self._closables:
                closable.close()
            self._closables.clear()
            thread, self._thread = self._thread, None
            if thread is not None:
                thread.shutdown(wait=False, cancel_futures=True)
            await self._codecs.close()

    # ------------------------------------------------------------------ frames

    def _make_reader(
        self, timeout: float, encoding: Any = "raw"
    ) -> AbstractAsyncContextManager[FrameReader]:
        if self._frames is not None:
            return self._frames.reader(timeout=timeout)
        if self._camera is None:
            raise ConfigurationError("pictures: there is no source")
        quality = None if encoding == "raw" else self._quality
        return self._camera.frames(encoding=encoding, quality=quality, timeout=timeout)

    async def _take_frame(self, timeout: float) -> Frame:
        frame = await take_frame(self._frames, self._camera, timeout)
        self._size = (frame.width, frame.height)
        return frame

    async def _picture_size(self) -> tuple[int, int]:
        if self._frames is not None:
            return self._frames.format.width, self._frames.format.height
        if self._size is None:
            await self._take_frame(SIZE_TIMEOUT)
        return self._size or (0, 0)

    # ------------------------------------------------------------------ messages

    async def _publish_raw(self, frame: Frame) -> None:
        self._size = (frame.width, frame.height)
        if _has_subscribers(self._image):
            converted = frame
            if frame.format.name not in ENCODINGS:
                converted = await self._run_in_thread(lambda: to_ros_format(frame))
            await publish_newest(self._image, image_fields(converted, self.frame_id))
        await self._publish_info(frame)

    async def _publish_compressed(self, frame: Frame) -> None:
        self._size = (frame.width, frame.height)
        compression = choose_compression(frame)
        compressed = frame
        if compression.convert_to:
            compressed = await self._codecs.converted(compressed, compression.convert_to)
        if compression.codec == "png":
            compressed = await self._codecs.png(compressed)
        elif compression.codec == "jpeg":
            compressed = await self._codecs.jpeg(compressed, quality=self._quality)
        await publish_newest(
            self._compressed,
            compressed_fields(compressed, compression.format_text(), self.frame_id),
        )
        await self._publish_info(frame)

    async def _publish_info(self, frame: Frame) -> None:
        """Publish the ``CameraInfo`` of a picture, unless it was published for the same stamp."""
        if frame.utc in self._stamps:
            return
        self._stamps.append(frame.utc)
        if _has_subscribers(self._info):
            await self._lens.load()
            self._info.publish(self._lens.camera_info_fields(frame))

    async def _run_in_thread(self, function: Callable[[], Value]) -> Value:
        """Run a function in the thread for pictures; once started, it runs to its end."""
        if self._thread is None:
            raise RosError("the publisher of pictures is closed")
        return await asyncio.get_running_loop().run_in_executor(self._thread, function)


def _has_subscribers(publisher: Any) -> bool:
    return bool(getattr(publisher, "has_subscribers", True))
