"""ROS 2 in asyncio, without a ROS installation: over the wire format of rmw_zenoh.

:class:`Node` publishes, hears, serves and calls; other nodes see it as one of their own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.ros2._context import RosContext
    from smartcam.ros2._node import Node
    from smartcam.ros2._qos import QoS

__all__ = ["Node", "QoS", "RosContext"]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {"_context": "RosContext", "_node": "Node", "_qos": "QoS"},
    )
