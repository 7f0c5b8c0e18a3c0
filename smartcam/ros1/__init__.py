"""ROS 1 in asyncio, without a ROS installation: over a rosbridge.

:class:`RosbridgeNode` publishes topics and serves services; programs of ROS 1 see them as topics
and services of the bridge's own node.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.ros1._rosbridge import RosbridgeNode

__all__ = ["RosbridgeNode"]

if not TYPE_CHECKING:
    __getattr__ = lazy(__name__, {"_rosbridge": "RosbridgeNode"})
