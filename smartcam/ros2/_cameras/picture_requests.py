"""Serve one picture for each request."""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam.exceptions import FrameFormatError, FrameTimeoutError, RosMessageError, SmartCamError
from smartcam.frames import Frame, FrameSource, Moment, find_format
from smartcam.frames._inside import jpeg_header, read_bitmap
from smartcam.ros2._cameras.image_messages import image_fields, to_ros_format
from smartcam.ros2._cameras.messages import error_text

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.camera import Camera
    from smartcam.ros2._cameras.lens import CameraLens

logger: logging.Logger = logging.getLogger("smartcam.ros2")

MAX_TIMEOUT: Final = 60.0
"""Longest ``timeout`` of a request in seconds, and the default."""


async def take_frame(
    frames: FrameSource | None, camera: Camera[Any] | None, timeout: float
) -> Frame:
    """Return the first frame exposed after the call, or the picture that the camera has last taken.

    Raises:
        SmartCamError: no picture came in time.
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
    """Return the frame of a bitmap's or a JPEG's bytes, with the present time; blocks.

    Raises:
        FrameFormatError: the bytes are neither a bitmap nor a JPEG.
    """
    if data[:2] == b"\xff\xd8":
        width, height, _ = jpeg_header(data, source)
        name, encoded, stride = "MJPEG", memoryview(data), 0
    else:
        try:
            pixels = np.ascontiguousarray(read_bitmap(data))
        except FrameFormatError as exc:
            raise FrameFormatError(f"{source}: {exc}", source=source) from exc
        height, width = pixels.shape[:2]
        name, encoded = "Mono8" if pixels.ndim == 2 else "RGB8", pixels.data.cast("B")
        stride = pixels.nbytes // height
    return Frame(
        data=encoded,
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
    """Serves ``smartcam_msgs/srv/RequestImage``: a picture and its lens.

    Args:
        node: node of the service.
        frame_id: name of the camera's optical frame.
        lens: the camera's lens.
        take_picture: function that returns a picture within a number of seconds.
    """

    def __init__(
        self,
        node: Any,
        frame_id: str,
        lens: CameraLens,
        take_picture: Callable[[float], Awaitable[Frame]],
    ) -> None:
        self._node, self._frame_id, self._lens, self._take_picture = (
            node,
            frame_id,
            lens,
            take_picture,
        )
        self._lock = asyncio.Lock()

    async def serve(self, request: Any) -> dict[str, Any]:
        """Answer a request."""
        try:
            return await self._serve(request.timeout)
        except SmartCamError as exc:
            logger.warning("%s ! a request for a picture failed: %s", self._node.full_name, exc)
            return {"error": error_text(exc)}

    async def _serve(self, seconds: float) -> dict[str, Any]:
        if not 0 <= seconds <= MAX_TIMEOUT:
            raise RosMessageError(
                f"timeout: expected 0 to {MAX_TIMEOUT:g} seconds, got {seconds:g}"
            )
        timeout = seconds or MAX_TIMEOUT
        try:
            async with asyncio.timeout(timeout):
                await self._lock.acquire()
        except TimeoutError as exc:
            raise FrameTimeoutError(
                f"no picture in {timeout:g} s: earlier requests took all the time"
            ) from exc
        try:
            await self._lens.load()
            frame = await asyncio.to_thread(to_ros_format, await self._take_picture(timeout))
        finally:
            self._lock.release()
        return {
            "image": image_fields(frame, self._frame_id),
            "camera_info": self._lens.camera_info_fields(frame),
        }
