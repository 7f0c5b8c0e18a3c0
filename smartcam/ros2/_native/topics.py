"""Publish and subscribe to topics through rclpy."""

from __future__ import annotations

import asyncio
import logging
import math
import threading
from typing import TYPE_CHECKING, Any

from smartcam.exceptions import RosError
from smartcam.ros2._native.installed import rclpy
from smartcam.ros2._node.topic_reader import TopicReader
from smartcam.ros2._node.topics import MAX_WAITING_BYTES, message_or_fields

if TYPE_CHECKING:
    from smartcam.ros2._native.node import NativeNode
    from smartcam.ros2._node.qos import QoS
    from smartcam.ros2._types.types import MessageType

logger: logging.Logger = logging.getLogger("smartcam.ros2")


def rclpy_profile(qos: QoS) -> Any:
    """Return a quality of service in rclpy's form."""
    qos_module = rclpy("qos")
    reliable, durable = qos_module.ReliabilityPolicy, qos_module.DurabilityPolicy
    options: dict[str, Any] = {}
    if math.isfinite(qos.lifespan):
        options["lifespan"] = rclpy("duration").Duration(seconds=qos.lifespan)
    keeps_last = qos.depth is not None
    return qos_module.QoSProfile(
        history=qos_module.HistoryPolicy.KEEP_LAST
        if keeps_last
        else qos_module.HistoryPolicy.KEEP_ALL,
        depth=qos.kept,
        reliability=reliable.RELIABLE if qos.reliable else reliable.BEST_EFFORT,
        durability=durable.TRANSIENT_LOCAL if qos.latched else durable.VOLATILE,
        **options,
    )


class NativePublisher:
    """Publishes on a topic through rclpy; created by :meth:`NativeNode.publisher`.

    Messages are encoded here and passed to rclpy as bytes, so that a picture never becomes a list
    of numbers. A thread of the node passes them on, since a middleware may wait for room. If
    ``rclpy_type`` is None, since it is not built, nothing is published.

    Attributes:
        name: absolute name of the topic.
        type: type of the messages.
        qos: quality of service.
        published: number of messages that were passed to the middleware.
        dropped: number of messages that were dropped for lack of room, the oldest first.
    """

    def __init__(
        self, node: NativeNode, name: str, message_type: MessageType, qos: QoS, rclpy_type: Any
    ) -> None:
        self.name: str = name
        self.type: MessageType = message_type
        self.qos: QoS = qos
        self.published: int = 0
        self.dropped: int = 0
        self._node, self._closed = node, False
        self._ros_object: Any = None
        if rclpy_type is not None:
            self._ros_object = node.call_rclpy(
                lambda rclpy_node: rclpy_node.create_publisher(rclpy_type, name, rclpy_profile(qos))
            )

    @property
    def has_subscribers(self) -> bool:
        """True if the topic has a known subscriber, and always if it is latched."""
        if self._closed or self._ros_object is None:
            return False
        if self.qos.latched:
            return True
        try:
            return bool(self._ros_object.get_subscription_count())
        except Exception:  # noqa: BLE001 - the context has ended, so there is no subscriber
            return False

    def publish(self, message: object = None, /, **fields: Any) -> None:
        """Publish a message; never waits.

        Raises:
            RosMessageError: the message is not of the type.
            RosError: the publisher is closed, or rclpy has ended.
        """
        self.publish_encoded(self.type.encode(message_or_fields(message, fields)))

    def publish_encoded(self, data: bytes) -> None:
        """Publish an encoded message of the type; never waits.

        Raises:
            RosError: the publisher is closed, or rclpy has ended.
        """
        self._check_open()
        if self._ros_object is not None:
            self._node.outbox.add_job(lambda: self._pass_to_rclpy(data), len(data), self._drop)

    async def publish_newest(self, message: object = None, /, **fields: Any) -> None:
        """Publish a message, and return once the middleware has it; a thread encodes it.

        Raises:
            RosMessageError: the message is not of the type.
            RosError: the publisher is closed, or rclpy has ended.

        Cancellation: the message may be published nevertheless.
        """
        self._check_open()
        if self._ros_object is None:
            return
        message = message_or_fields(message, fields)
        passed_event = asyncio.Event()
        errors: list[Exception] = []

        def publish() -> None:
            try:
                self._pass_to_rclpy(self.type.encode(message))
            except Exception as exc:  # noqa: BLE001 - passed to the waiting task
                errors.append(exc)
            self._node.call_in_loop(passed_event.set)

        self._node.outbox.add_job(publish)
        await passed_event.wait()
        if errors:
            raise errors[0]

    def _pass_to_rclpy(self, data: bytes) -> None:
        """Pass a message to rclpy, in the node's thread."""
        if self._node.has_sim_time:
            data = self._node.stamps.to_ros_time(self.type, data)
        try:
            self._ros_object.publish(data)
        except Exception as exc:
            raise RosError(f"{self.name}: {type(exc).__name__}: {exc!s:.300}") from exc
        self.published += 1

    def _drop(self) -> None:
        self.dropped += 1

    def _check_open(self) -> None:
        self._node.check_open()
        if self._closed:
            raise RosError(f"{self.name}: this publisher is closed")

    def close(self) -> None:
        """Stop publishing, after the waiting messages. Idempotent."""
        if self._closed:
            return
        self._closed = True
        if self._ros_object is not None:
            self._node.outbox.add_job(lambda: self._node.destroy("publisher", self._ros_object))
        self._node.forget(self)


class NativeSubscription(TopicReader[bytes]):
    """Subscription to a topic through rclpy, made by :meth:`NativeNode.subscribe`.

    Attributes:
        name: absolute name of the topic.
    """

    def __init__(
        self, node: NativeNode, name: str, message_type: MessageType, qos: QoS, rclpy_type: Any
    ) -> None:
        super().__init__(name, message_type, qos.kept, MAX_WAITING_BYTES)
        self.name: str = name
        self._node, self._closed = node, False
        self._max_on_way, self._messages_on_way, self._lock = qos.kept, 0, threading.Lock()
        self._ros_object = node.call_rclpy(
            lambda rclpy_node: rclpy_node.create_subscription(
                rclpy_type,
                name,
                self._on_message,
                rclpy_profile(qos),
                raw=True,
                callback_group=node.concurrent_group,
            )
        )

    def _on_message(self, data: bytes) -> None:
        """Pass a message from rclpy's thread to the event loop; drop it if too many wait there."""
        with self._lock:
            if self._messages_on_way >= self._max_on_way:
                return
            self._messages_on_way += 1
        self._node.call_in_loop(self._offer_message, data)

    def _offer_message(self, data: bytes) -> None:
        with self._lock:
            self._messages_on_way -= 1
        if not self._closed:
            self._queue.offer(data, 0.0, len(data))

    def _decode_item(self, item: bytes) -> Any:
        return self.type.decode(item, whole=False)

    def close(self) -> None:
        """Stop receiving; iteration ends. Idempotent."""
        if self._closed:
            return
        self._closed = True
        self._queue.close()
        self._node.outbox.add_job(lambda: self._node.destroy("subscription", self._ros_object))
        self._node.forget(self)
