"""One picture on request: ``polled_camera``'s service."""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam.exceptions import FrameFormatError, FrameTimeoutError, RosMessageError, SmartCamError
from smartcam.frames import Frame, FrameSource, Moment, find_format
from smartcam.frames._bitmap import read_bitmap
from smartcam.frames._jpeg import jpeg_header
from smartcam.ros2._image_messages import BILLION, image_fields, prepared, stamp_fields
from smartcam.ros2._qos import LATCHED

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.camera import Camera
    from smartcam.ros2._camera_lens import CameraLens

logger: logging.Logger = logging.getLogger("smartcam.ros2")

MOST_NAMESPACES: Final = 8
"""Namespaces that pictures were asked into whose topics are kept; beyond, the oldest goes."""

LONGEST: Final = 60.0
"""Seconds for a picture where the request sets no limit, or a longer one."""


async def one_frame(
    frames: FrameSource | None, camera: Camera[Any] | None, timeout: float
) -> Frame:
    """Return a picture: the first that is exposed after this, or the last one of the camera.

    Raises:
        SmartCamError: there is none in time.
    """
    if frames is not None:
        return await frames.after(time.monotonic(), timeout=timeout)
    if camera is None:
        raise RosMessageError("there is nothing to take a picture of")
    if camera.capabilities.read_image and not getattr(camera, "has_frames", False):
        data = await camera.read_image(timeout=timeout)
        return await asyncio.to_thread(frame_of_file, data, camera.name)
    return await camera.frame_after(timeout=timeout)


def frame_of_file(data: bytes, source: str) -> Frame:
    """Return the frame of a file's bytes, a bitmap or a JPEG, that came just now; blocks.

    Raises:
        FrameFormatError: it is neither.
    """
    if data[:2] == b"\xff\xd8":
        width, height, _ = jpeg_header(data, source)
        name, kept, stride = "MJPEG", memoryview(data), 0
    else:
        try:
            pixels = np.ascontiguousarray(read_bitmap(data))
        except FrameFormatError as exc:
            raise FrameFormatError(f"{source}: {exc}", source=source) from exc
        height, width = pixels.shape[:2]
        name, kept = "Mono8" if pixels.ndim == 2 else "RGB8", pixels.data.cast("B")
        stride = pixels.nbytes // height
    return Frame(
        data=kept,
        format=find_format(name),
        width=width,
        height=height,
        stride=stride,
        captured=time.monotonic(),
        utc=time.time(),
        moment=Moment.ARRIVAL,
        duration=float("inf"),
        sequence=0,
        source=source,
    )


class PictureRequests:
    """Serves ``polled_camera/srv/GetPolledImage``: a picture into the namespace of who asks.

    ``NAMESPACE/image_raw`` and ``NAMESPACE/camera_info`` are latched there, as the protocol has it.

    Args:
        node: publishes.
        frame_id: the camera's optical frame.
        lens: the camera's.
        take: returns a picture within so many seconds.
    """

    def __init__(
        self,
        node: Any,
        frame_id: str,
        lens: CameraLens,
        take: Callable[[float], Awaitable[Frame]],
    ) -> None:
        self._node, self._frame_id, self._lens, self._take = node, frame_id, lens, take
        self._topics: dict[str, tuple[Any, Any]] = {}
        self._one_at_a_time = asyncio.Lock()

    async def serve(self, request: Any) -> dict[str, Any]:
        """Answer a request.

        Cancellation: nothing is published, or both messages are.
        """
        try:
            stamp = await self._serve(request)
        except SmartCamError as exc:
            logger.warning("%s ! a picture was asked for in vain: %s", self._node.full_name, exc)
            return {"success": False, "status_message": str(exc)}
        return {"success": True, "stamp": stamp}

    async def _serve(self, request: Any) -> dict[str, int]:
        if max(request.binning_x, request.binning_y) > 1:
            raise RosMessageError("binning: expected 0 or 1, since this camera does not bin")
        asked = request.timeout.sec + request.timeout.nanosec / BILLION
        if asked < 0:
            raise RosMessageError(f"timeout: expected 0 or more seconds, got {asked:g}")
        timeout = min(asked or LONGEST, LONGEST)
        try:
            async with asyncio.timeout(timeout):
                await self._one_at_a_time.acquire()
        except TimeoutError as exc:
            raise FrameTimeoutError(
                f"no picture in {timeout:g} s: those that were asked for before took as long"
            ) from exc
        try:
            await self._lens.load()
            frame = await asyncio.to_thread(prepared, await self._take(timeout))
            roi, size = request.roi, (frame.width, frame.height)
            part = (roi.x_offset, roi.y_offset, roi.width or size[0], roi.height or size[1])
            if part != (0, 0, *size):
                raise RosMessageError(
                    f"region of interest: expected the whole picture, {size[0]}x{size[1]}, since "
                    "this camera gives no other"
                )
            image, info = self._publishers(request.response_namespace)
            fields = image_fields(frame, self._frame_id)
            if hasattr(image, "publish_encoded"):
                data = await asyncio.to_thread(image.type.encode, fields)
                info.publish(self._lens.fields(frame))
                image.publish_encoded(data)
            else:
                info.publish(self._lens.fields(frame))
                image.publish(fields)
        finally:
            self._one_at_a_time.release()
        return stamp_fields(frame.utc)

    def _publishers(self, namespace: str) -> tuple[Any, Any]:
        where = namespace.rstrip("/")
        pair = self._topics.pop(where, None)
        if pair is None:
            image = self._node.publisher(f"{where}/image_raw", "sensor_msgs/msg/Image", qos=LATCHED)
            try:
                topic, kind = f"{where}/camera_info", "sensor_msgs/msg/CameraInfo"
                pair = (image, self._node.publisher(topic, kind, qos=LATCHED))
            except BaseException:
                image.close()
                raise
        self._topics[where] = pair  # the newest last
        while len(self._topics) > MOST_NAMESPACES:
            self._close(self._topics.pop(next(iter(self._topics))))
        return pair

    def close(self) -> None:
        """Publish no longer."""
        for pair in self._topics.values():
            self._close(pair)
        self._topics.clear()

    @staticmethod
    def _close(pair: tuple[Any, Any]) -> None:
        for one in pair:
            one.close()
