"""Ask rosapi which topics with long messages have subscribers; the bridge itself does not tell."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.ros1._publishing import RosbridgePublisher
    from smartcam.ros1._rosbridge import RosbridgeNode

SERVICE: Final = "/rosapi/subscribers"
"""Service of the node ``rosapi``, which rosbridge's launch file starts together with the bridge."""
PERIOD = 2.0
"""Seconds between two calls of rosapi."""
LARGE_TYPES: Final = frozenset(
    {"sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud2"}
)
"""Types of messages that are so long that a call of rosapi is worth it."""


async def listen_for_subscribers(
    node: RosbridgeNode, publishers: Mapping[str, RosbridgePublisher]
) -> None:
    """Update ``may_have_subscribers`` of the publishers, as long as rosapi answers."""
    for publisher in publishers.values():
        publisher.may_have_subscribers = True
    while True:
        for publisher in [other for other in publishers.values() if other.type.name in LARGE_TYPES]:
            answer = await node.ask(SERVICE, {"topic": publisher.name})
            values = answer.get("values") if answer else None
            names = values.get("subscribers") if isinstance(values, dict) else None
            if not isinstance(names, list):
                for other in publishers.values():
                    other.may_have_subscribers = True
                return
            publisher.may_have_subscribers = bool(names)
        await asyncio.sleep(PERIOD)
