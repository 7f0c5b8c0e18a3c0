"""Subscriptions to topics through a rosbridge."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any, ClassVar, Final

from smartcam.ros1._json_messages import encoded, from_json, ros1_name
from smartcam.ros2._inside import TopicReader

if TYPE_CHECKING:
    from smartcam.ros1._rosbridge import RosbridgeNode
    from smartcam.ros2 import QoS
    from smartcam.ros2._inside import MessageType

MAX_WAITING_MESSAGES: Final = 1000
"""Largest number of messages that wait for a reader, whatever the quality of service."""


class RosbridgeSubscription(TopicReader[object]):
    """Subscription to a topic through a rosbridge, made by :meth:`RosbridgeNode.subscribe`.

    Attributes:
        name: absolute name of the topic.
        exists: whether ROS 1 has the type.
    """

    _logger: ClassVar[logging.Logger] = logging.getLogger("smartcam.ros1")

    def __init__(self, node: RosbridgeNode, name: str, kind: MessageType, qos: QoS) -> None:
        self._depth = min(qos.kept, MAX_WAITING_MESSAGES)
        super().__init__(name, kind, self._depth)
        self.name: str = name
        self.exists: bool = ros1_name(kind.name) is not None
        self._node = node

    def _read(self, item: object) -> Any:
        return from_json(self.type, item)

    def close(self) -> None:
        """End the subscription and its iterators. Idempotent."""
        self._node.forget_subscription(self)
        self._queue.close()

    # ------------------------------------------------------------------ for the node

    def ask(self) -> None:
        """Subscribe at the bridge."""
        operation = {"op": "subscribe", "topic": self.name, "type": ros1_name(self.type.name)}
        self._node.send(encoded({**operation, "id": self._id, "queue_length": self._depth}))

    def leave(self) -> None:
        """Unsubscribe at the bridge."""
        operation = {"op": "unsubscribe", "topic": self.name, "id": self._id}
        self._node.send(encoded(operation))

    def take(self, message: object) -> None:
        """Handle a message from the bridge."""
        self._queue.offer(message, 0.0, 0)

    @property
    def _id(self) -> str:
        return f"subscribe:{self.name}:{id(self)}"
