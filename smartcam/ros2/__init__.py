"""ROS 2 in asyncio, without a ROS installation: over the wire format of rmw_zenoh.

:class:`Node` publishes, subscribes, serves and calls; other nodes see it as a node of ROS.
:class:`CameraNode` is a camera as a node.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.ros2._cameras.cloud_messages import cloud_from
    from smartcam.ros2._cameras.depth_topics import DepthTopics
    from smartcam.ros2._cameras.image_messages import frame_from, pixels_from
    from smartcam.ros2._cameras.node import CameraNode
    from smartcam.ros2._cameras.options import CameraNodeOptions
    from smartcam.ros2._node.node import Node
    from smartcam.ros2._node.qos import QoS
    from smartcam.ros2._types.types import RosTypes

__all__ = [
    "CameraNode",
    "CameraNodeOptions",
    "DepthTopics",
    "Node",
    "QoS",
    "RosTypes",
    "cloud_from",
    "frame_from",
    "pixels_from",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_cameras.cloud_messages": "cloud_from",
            "_cameras.depth_topics": "DepthTopics",
            "_cameras.image_messages": "frame_from pixels_from",
            "_cameras.node": "CameraNode",
            "_cameras.options": "CameraNodeOptions",
            "_node.node": "Node",
            "_node.qos": "QoS",
            "_types.types": "RosTypes",
        },
    )
