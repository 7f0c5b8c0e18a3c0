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
from smartcam.ros2._node.topics import MAX_WAITING_BYTES, message_of

if TYPE_CHECKING:
    from smartcam.ros2._native.node import NativeNode
    from smartcam.ros2._node.qos import QoS
    from smartcam.ros2._types.types import MessageType

logger: logging.Logger = logging.getLogger("smartcam.ros2")


def profile_of(qos: QoS) -> Any:
    """Return a quality of service in rclpy's form."""
    kinds = rclpy("qos")
    reliable, durable = kinds.ReliabilityPolicy, kinds.DurabilityPolicy
    more: dict[str, Any] = {}
    if math.isfinite(qos.lifespan):
        more["lifespan"] = rclpy("duration").Duration(seconds=qos.lifespan)
    keeps_last = qos.depth is not None
    return kinds.QoSProfile(
        history=kinds.HistoryPolicy.KEEP_LAST if keeps_last else kinds.HistoryPolicy.KEEP_ALL,
        depth=qos.kept,
        reliability=reliable.RELIABLE if qos.reliable else reliable.BEST_EFFORT,
        durability=durable.TRANSIENT_LOCAL if qos.latched else durable.VOLATILE,
        **more,
    )


class NativePublisher:
    """Publishes on a topic through rclpy; created by :meth:`NativeNode.publisher`.

    Messages are encoded here and passed to rclpy as bytes, so that a picture never becomes a list
    of numbers; a thread of the node does that, since a middleware may wait for room.

    Attributes:
        name: absolute name of the topic.
        type: type of the messages.
        qos: quality of service.
        published: number of messages that were passed to the middleware.
        dropped: number of messages that were dropped for lack of room, the oldest first.
    """

    def __init__(self, node: NativeNode, name: str, kind: MessageType, qos: QoS, cls: Any) -> None:
        self.name: str = name
        self.type: MessageType = kind
        self.qos: QoS = qos
        self.published: int = 0
        self.dropped: int = 0
        self._node, self._closed = node, False
        self._raw: Any = None
        if cls is not None:
            self._raw = node.made(lambda ros: ros.create_publisher(cls, name, profile_of(qos)))

    @property
    def has_subscribers(self) -> bool:
        """True if the topic has a known subscriber, and always if it is latched."""
        if self._closed or self._raw is None:
            return False
        if self.qos.latched:
            return True
        try:
            return bool(self._raw.get_subscription_count())
        except Exception:  # noqa: BLE001 - the context has ended, so there is no subscriber
            return False

    def publish(self, message: object = None, /, **fields: Any) -> None:
        """Publish a message; never waits.

        Raises:
            RosMessageError: the message is not of the type.
            RosError: the publisher is closed, or rclpy has ended.
        """
        self.publish_encoded(self.type.encode(message_of(message, fields)))

    def publish_encoded(self, data: bytes) -> None:
        """Publish an encoded message of the type; never waits.

        Raises:
            RosError: the publisher is closed, or rclpy has ended.
        """
        self._check_open()
        if self._raw is not None:
            self._node.outbox.put(lambda: self._pass_on(data), len(data), self._drop)

    async def publish_newest(self, message: object = None, /, **fields: Any) -> None:
        """Publish a message, and return once the middleware has it; a thread encodes it.

        Raises:
            RosMessageError: the message is not of the type.
            RosError: the publisher is closed, or rclpy has ended.

        Cancellation: the message is published or not.
        """
        self._check_open()
        if self._raw is None:
            return
        message = message_of(message, fields)
        done = asyncio.Event()
        failed: list[Exception] = []

        def publish() -> None:
            try:
                self._pass_on(self.type.encode(message))
            except Exception as exc:  # noqa: BLE001 - passed to the waiting task
                failed.append(exc)
            self._node.in_loop(done.set)

        self._node.outbox.put(publish)
        await done.wait()
        if failed:
            raise failed[0]

    def _pass_on(self, data: bytes) -> None:
        """Pass a message to rclpy, in the node's thread."""
        if self._node.has_sim_time:
            data = self._node.stamps.moved(self.type, data)
        try:
            self._raw.publish(data)
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
        if self._raw is not None:
            self._node.outbox.put(lambda: self._node.unmade("publisher", self._raw))
        self._node.forget(self)


class NativeSubscription(TopicReader[bytes]):
    """Subscription to a topic through rclpy, made by :meth:`NativeNode.subscribe`.

    Attributes:
        name: absolute name of the topic.
    """

    def __init__(self, node: NativeNode, name: str, kind: MessageType, qos: QoS, cls: Any) -> None:
        super().__init__(name, kind, qos.kept, MAX_WAITING_BYTES)
        self.name: str = name
        self._node, self._closed = node, False
        self._most, self._crossing, self._lock = qos.kept, 0, threading.Lock()
        self._raw = node.made(
            lambda ros: ros.create_subscription(
                cls,
                name,
                self._on_message,
                profile_of(qos),
                raw=True,
                callback_group=node.side_by_side,
            )
        )

    def _on_message(self, data: bytes) -> None:
        """Receive a message in a thread of rclpy; if the loop is late, drop it."""
        with self._lock:
            if self._crossing >= self._most:
                return
            self._crossing += 1
        self._node.in_loop(self._take, data)

    def _take(self, data: bytes) -> None:
        with self._lock:
            self._crossing -= 1
        if not self._closed:
            self._queue.offer(data, 0.0, len(data))

    def _read(self, item: bytes) -> Any:
        return self.type.decode(item, whole=False)

    def close(self) -> None:
        """Stop receiving; iteration ends. Idempotent."""
        if self._closed:
            return
        self._closed = True
        self._queue.close()
        self._node.outbox.put(lambda: self._node.unmade("subscription", self._raw))
        self._node.forget(self)
