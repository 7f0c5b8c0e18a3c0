"""Publishers of topics through a rosbridge."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam.exceptions import RosError, RosMessageError
from smartcam.ros1._json_messages import encoded, ros1_name, to_json
from smartcam.ros1._outbox import Lane

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
        lane: messages that wait to be sent.
        exists: whether ROS 1 has the type.
        subscribed: whether the topic has subscribers; True if that is not known.
    """

    def __init__(self, node: RosbridgeNode, name: str, kind: MessageType, qos: QoS) -> None:
        self.name: str = name
        self.type: MessageType = kind
        self.lane: Lane = Lane(qos.kept, latched=qos.latched)
        self.exists: bool = ros1_name(kind.name) is not None
        self.subscribed = True  # also if it is not known
        self._node = node

    @property
    def published(self) -> int:
        """Number of messages that were sent; the bridge does not confirm them."""
        return self.lane.sent

    @property
    def dropped(self) -> int:
        """Number of messages that were not sent: there was no bridge, or newer ones came."""
        return self.lane.dropped

    @property
    def has_subscribers(self) -> bool:
        """True if the bridge is connected and the topic may have subscribers.

        For a topic with long messages, rosapi is asked for subscribers every two seconds, if it
        answers, as it does with most bridges.
        """
        if not self.exists or self.lane.latched:
            return self.exists
        return self._node.connected and self.subscribed

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
        if self.lane.latched:
            operation["latch"] = True  # otherwise the bridge takes this for another publisher
        operation["msg"] = to_json(self.type, fields if message is None else message)
        if not self._node.has(self):
            raise RosError(f"{self.name}: this publisher is closed")
        if self.exists:
            self.lane.put(encoded(operation), connected=self._node.connected)
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

    def advertisement(self) -> dict[str, Any]:
        """Return the operation that advertises the topic to a bridge."""
        operation = {"op": "advertise", "topic": self.name, "type": ros1_name(self.type.name)}
        return {**operation, "latch": self.lane.latched}
