"""Subscriptions to topics through a rosbridge."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any, ClassVar, Final

from smartcam.ros1._json_messages import encode_operation, from_json, ros1_name
from smartcam.ros2._inside import TopicReader

if TYPE_CHECKING:
    from smartcam.ros1._rosbridge import RosbridgeNode
    from smartcam.ros2 import QoS
    from smartcam.ros2._inside import MessageType

MAX_WAITING_MESSAGES: Final = 1000
"""Largest number of messages that wait for a reader, even if ``depth`` is larger."""


class RosbridgeSubscription(TopicReader[object]):
    """Subscription to a topic through a rosbridge, made by :meth:`RosbridgeNode.subscribe`.

    Attributes:
        name: absolute name of the topic.
        has_ros1_type: True if ROS 1 has the type; otherwise no message comes.
    """

    _logger: ClassVar[logging.Logger] = logging.getLogger("smartcam.ros1")

    def __init__(self, node: RosbridgeNode, name: str, message_type: MessageType, qos: QoS) -> None:
        self._depth = min(qos.kept, MAX_WAITING_MESSAGES)
        super().__init__(name, message_type, self._depth)
        self.name: str = name
        self.has_ros1_type: bool = ros1_name(message_type.name) is not None
        self._node = node

    def _decode_item(self, item: object) -> Any:
        return from_json(self.type, item)

    def close(self) -> None:
        """End the subscription and its iterators. Idempotent."""
        self._node.forget_subscription(self)
        self._queue.close()

    # ------------------------------------------------------------------ for the node

    def send_subscribe(self) -> None:
        """Subscribe at the bridge."""
        operation = {"op": "subscribe", "topic": self.name, "type": ros1_name(self.type.name)}
        self._node.send(
            encode_operation({**operation, "id": self._id, "queue_length": self._depth})
        )

    def send_unsubscribe(self) -> None:
        """Unsubscribe at the bridge."""
        operation = {"op": "unsubscribe", "topic": self.name, "id": self._id}
        self._node.send(encode_operation(operation))

    def on_message(self, message: object) -> None:
        """Handle a message from the bridge."""
        self._queue.offer(message, 0.0, 0)

    @property
    def _id(self) -> str:
        return f"subscribe:{self.name}:{id(self)}"
