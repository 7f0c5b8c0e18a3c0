"""Publishers of topics through a rosbridge."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam.exceptions import RosError, RosMessageError
from smartcam.ros1._json_messages import encode_operation, ros1_name, to_json
from smartcam.ros1._outbox import TopicQueue

if TYPE_CHECKING:
    from typing import Self

    from smartcam.ros1._rosbridge import RosbridgeNode
    from smartcam.ros2 import QoS
    from smartcam.ros2._inside import MessageType


class RosbridgePublisher:
    """Publishes on a topic; made by :meth:`RosbridgeNode.publisher`.

    Attributes:
        name: the topic's absolute name.
        type: type of the messages.
        queue: messages that wait to be sent.
        has_ros1_type: True if ROS 1 has the type; otherwise nothing is published.
        may_have_subscribers: False if the topic is known to have no subscribers.
    """

    def __init__(self, node: RosbridgeNode, name: str, message_type: MessageType, qos: QoS) -> None:
        self.name: str = name
        self.type: MessageType = message_type
        self.queue: TopicQueue = TopicQueue(qos.kept, latched=qos.latched)
        self.has_ros1_type: bool = ros1_name(message_type.name) is not None
        self.may_have_subscribers = True
        self._node = node

    @property
    def published(self) -> int:
        """Number of messages that were sent; the bridge does not confirm them."""
        return self.queue.sent

    @property
    def dropped(self) -> int:
        """Number of messages that were not sent: there was no bridge, or newer ones came."""
        return self.queue.dropped

    @property
    def has_subscribers(self) -> bool:
        """True if the bridge is connected and the topic may have subscribers, or if it is latched.

        For a topic with long messages, rosapi is asked for subscribers every two seconds, if it
        answers, as it does with most bridges.
        """
        if not self.has_ros1_type or self.queue.latched:
            return self.has_ros1_type
        return self._node.connected and self.may_have_subscribers

    def publish(self, message: object = None, /, **fields: Any) -> None:
        """Publish a message; never wait.

        Args:
            message: message of the type, or a mapping of its fields.
            **fields: the fields, if ``message`` is not given.

        Raises:
            RosMessageError: the value does not fit the type.
            RosError: the publisher is closed.
        """
        if message is not None and fields:
            raise RosMessageError("expected a message or its fields, got both")
        operation: dict[str, Any] = {"op": "publish", "topic": self.name}
        if self.queue.latched:
            operation["latch"] = True  # without it, the bridge would make another publisher
        operation["msg"] = to_json(self.type, fields if message is None else message)
        if not self._node.has(self):
            raise RosError(f"{self.name}: this publisher is closed")
        if self.has_ros1_type:
            self.queue.put(encode_operation(operation), connected=self._node.connected)
            self._node.wake()

    def publish_encoded(self, data: bytes) -> None:
        """Publish a message in CDR; never wait.

        Raises:
            RosMessageError, RosError: as of :meth:`publish`.
        """
        self.publish(self.type.decode(data))

    def close(self) -> None:
        """Close the publisher, and drop waiting messages. Idempotent."""
        self._node.forget(self)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    def advertise_operation(self) -> dict[str, Any]:
        """Return the operation that advertises the topic to a bridge."""
        operation = {"op": "advertise", "topic": self.name, "type": ros1_name(self.type.name)}
        return {**operation, "latch": self.queue.latched}
