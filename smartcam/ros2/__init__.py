"""ROS 2 in asyncio, without a ROS installation: over the wire format of rmw_zenoh.

:class:`Node` publishes, hears, serves and calls; other nodes see it as one of their own.
:class:`CameraNode` is a camera as a node.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.ros2._camera_node import CameraNode, CameraNodeOptions
    from smartcam.ros2._cloud_messages import cloud_from
    from smartcam.ros2._context import RosContext
    from smartcam.ros2._depth_topics import DepthTopics
    from smartcam.ros2._graph import RosGraph
    from smartcam.ros2._image_messages import frame_from, pixels_from
    from smartcam.ros2._node import Node
    from smartcam.ros2._parameter_client import ParameterClient
    from smartcam.ros2._parameters import RosParameters
    from smartcam.ros2._qos import QoS
    from smartcam.ros2._services import RosClient, RosService
    from smartcam.ros2._topics import RosPublisher, RosSubscription
    from smartcam.ros2._types import MessageType, RosTypes, ServiceType

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
            "_camera_node": "CameraNode CameraNodeOptions",
            "_cloud_messages": "cloud_from",
            "_context": "RosContext",
            "_depth_topics": "DepthTopics",
            "_graph": "RosGraph",
            "_image_messages": "frame_from pixels_from",
            "_node": "Node",
            "_parameter_client": "ParameterClient",
            "_parameters": "RosParameters",
            "_qos": "QoS",
            "_services": "RosClient RosService",
            "_topics": "RosPublisher RosSubscription",
            "_types": "MessageType RosTypes ServiceType",
        },
    )
