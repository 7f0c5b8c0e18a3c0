"""Get pictures from topics and frames of TF from ROS, for a calibration."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any, Final

from smartcam._ros_names import resolve
from smartcam.exceptions import RosError
from smartcam.geometry._inside import Code
from smartcam.ros2._cameras.image_messages import frame_from, utc_of
from smartcam.ros2._cameras.lens_messages import lens_from
from smartcam.ros2._cameras.transform_listener import TransformListener
from smartcam.ros2._node.qos import QoS

if TYPE_CHECKING:
    from smartcam.calibration._inside import ThesisCalibration
    from smartcam.geometry import CameraModel, Transform

IMAGE: Final = "sensor_msgs/msg/Image"
COMPRESSED: Final = "sensor_msgs/msg/CompressedImage"

CAMERA_INFO: Final = "sensor_msgs/msg/CameraInfo"

LENS_TIMEOUT: Final = 1.5
"""Seconds to wait for a lens from a topic before a calibration begins."""

PICTURE_TIMEOUT: Final = 25.0
"""Seconds to wait for a picture from a topic."""

MAX_CLOCK_DIFFERENCE: Final = 60.0
"""Largest number of seconds between a stamp and this computer's clock; beyond it the stamp is of
another clock."""


class CameraGraph:
    """The ROS graph of a camera's node, for the calibrations of the camera.

    Args:
        node: open node of ROS.
        calibrations: the calibrations; None if there are none.
        owned: True if the calibrations are closed with the node: no other interface shares them.
    """

    def __init__(self, node: Any, calibrations: ThesisCalibration | None, *, owned: bool) -> None:
        self._node, self._calibrations, self._owned = node, calibrations, owned
        self._transforms = TransformListener(node)

    def start(self) -> None:
        """Let the calibrations use the graph."""
        if self._calibrations is not None:
            self._calibrations.graph = self

    async def close(self) -> None:
        """End the calibrations' use of the graph. Idempotent."""
        calibrations = self._calibrations
        if calibrations is not None and calibrations.graph is self:
            calibrations.graph = None
            if self._owned:
                calibrations.close()
        await self._transforms.close()

    def check_topic(self, topic: str) -> None:
        """Raise ConfigurationError if a topic is not valid."""
        self._full_name(topic)

    def listen(self) -> None:
        """Subscribe to transforms from now on."""
        self._transforms.listen()

    async def pose(self, frame: str, base: str, utc: float | None) -> Transform:
        """Return the pose of a frame in another one, as :meth:`TransformListener.pose`."""
        return await self._transforms.pose(frame, base, utc)

    async def root(self, frame: str) -> str:
        """Return the root of the tree that a frame is in."""
        return await self._transforms.root(frame)

    async def picture(self, topic: str) -> tuple[Any, float | None]:
        """Return the grey levels of a picture that was taken after this call, and its time, UTC.

        If a stamp is not of this computer's clock, the second picture that comes is returned,
        without a time.

        Raises:
            CalibrationError: NO_PICTURE: no picture came in time.
            FrameFormatError: the message is no picture.
        """
        name = self._full_name(topic)
        type_name = self._picture_type(name)
        times: list[float] = []
        subscription = self._node.subscribe(name, type_name, qos=QoS(reliable=False, depth=1))
        try:
            async with asyncio.timeout(PICTURE_TIMEOUT):
                message, utc = await _next_picture(subscription, times)
        except TimeoutError as exc:
            raise self._missing_error(name, type_name, times) from exc
        except StopAsyncIteration as exc:
            raise RosError(f"{name}: the node of the camera was closed meanwhile") from exc
        finally:
            subscription.close()
        frame = frame_from(message, source=topic)
        return await asyncio.to_thread(frame.grey), utc

    async def lens(self, topic: str) -> CameraModel | None:
        """Return the lens from the ``camera_info`` of a topic with pictures.

        None if no message came within :data:`LENS_TIMEOUT`, or the lens is not calibrated.

        Raises:
            RosMessageError, CalibrationError: the message is not a valid lens, or its model is
                unknown.
        """
        info_topic = (
            f"{self._full_name(topic).removesuffix('/compressed').rpartition('/')[0]}/camera_info"
        )
        subscription = self._node.subscribe(
            info_topic, CAMERA_INFO, qos=QoS(reliable=False, depth=1)
        )
        try:
            async with asyncio.timeout(LENS_TIMEOUT):
                lens = lens_from(await anext(subscription))
        except (TimeoutError, StopAsyncIteration):
            return None
        finally:
            subscription.close()
        return None if lens is None else lens.camera

    def _full_name(self, topic: str) -> str:
        return resolve(topic, self._node.namespace, self._node.name)

    def _picture_type(self, topic: str) -> str:
        """Return the type of a topic with pictures, from the graph, otherwise from its name."""
        graph = getattr(self._node, "graph", None)
        types = [] if graph is None else graph.topics().get(topic, [])
        for type_name in (IMAGE, COMPRESSED):
            if type_name in types:
                return type_name
        return COMPRESSED if topic.endswith("/compressed") else IMAGE

    def _missing_error(self, topic: str, type_name: str, times: list[float]) -> Exception:
        earlier = f"; {len(times)} came with an earlier stamp, or another clock's" if times else ""
        return Code.NO_PICTURE.error(
            f"{topic}: no picture came within {PICTURE_TIMEOUT:g} s{earlier}; expected {type_name} "
            "with the time of its exposure, from a camera that is running",
            type_name,
            len(times),
        )


async def _next_picture(subscription: Any, times: list[float]) -> tuple[Any, float | None]:
    """Return the first picture that was taken after the call, and its time, None if unknown."""
    started_at = time.time()
    while True:
        message = await anext(subscription)
        utc = utc_of(message.header)
        if abs(utc - time.time()) <= MAX_CLOCK_DIFFERENCE:
            if utc >= started_at:
                return message, utc
        elif times:
            return message, None
        times.append(utc)
