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
    from smartcam.ros2._node.context import RosContext
    from smartcam.ros2._node.graph import RosGraph
    from smartcam.ros2._node.node import Node
    from smartcam.ros2._node.parameter_client import ParameterClient
    from smartcam.ros2._node.parameters import RosParameters
    from smartcam.ros2._node.qos import QoS
    from smartcam.ros2._node.services import RosClient, RosService
    from smartcam.ros2._node.topics import RosPublisher, RosSubscription
    from smartcam.ros2._types.types import MessageType, RosTypes, ServiceType

__all__ = [
    "CameraNode",
    "CameraNodeOptions",
    "DepthTopics",
    "MessageType",
    "Node",
    "ParameterClient",
    "QoS",
    "RosClient",
    "RosContext",
    "RosGraph",
    "RosParameters",
    "RosPublisher",
    "RosService",
    "RosSubscription",
    "RosTypes",
    "ServiceType",
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
            "_node.context": "RosContext",
            "_node.graph": "RosGraph",
            "_node.node": "Node",
            "_node.parameter_client": "ParameterClient",
            "_node.parameters": "RosParameters",
            "_node.qos": "QoS",
            "_node.services": "RosClient RosService",
            "_node.topics": "RosPublisher RosSubscription",
            "_types.types": "MessageType RosTypes ServiceType",
        },
    )
