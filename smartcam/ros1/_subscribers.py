"""Find out which topics with long messages have subscribers, which a bridge does not report."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.ros1._publishing import RosbridgePublisher
    from smartcam.ros1._rosbridge import RosbridgeNode

SERVICE: Final = "/rosapi/subscribers"
"""Service of the node ``rosapi``, which rosbridge's launch file starts beside the bridge."""
PERIOD = 2.0
"""Seconds between two calls of rosapi."""
LARGE_TYPES: Final = frozenset(
    {"sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud2"}
)
"""Types of messages that are long enough for a call of rosapi."""


async def listen_for_subscribers(
    node: RosbridgeNode, publishers: Mapping[str, RosbridgePublisher]
) -> None:
    """Update ``subscribed`` of the publishers, as long as rosapi answers."""
    for publisher in publishers.values():
        publisher.subscribed = True
    while True:
        for publisher in [each for each in publishers.values() if each.type.name in LARGE_TYPES]:
            answer = await node.ask(SERVICE, {"topic": publisher.name})
            values = answer.get("values") if answer else None
            names = values.get("subscribers") if isinstance(values, dict) else None
            if not isinstance(names, list):
                for each in publishers.values():
                    each.subscribed = True
                return
            publisher.subscribed = bool(names)
        await asyncio.sleep(PERIOD)
