"""Publishers and subscriptions of topics.

As in ``rmw_publisher_data.cpp`` and ``rmw_subscription_data.cpp`` of rmw_zenoh: an advanced
publisher keeps latched messages, and an advanced subscriber asks for them.
"""

from __future__ import annotations

import asyncio
import collections
import concurrent.futures
import logging
import threading
import time
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._zenoh import ZenohDeclared, direct, quietly
from smartcam.exceptions import RosError, RosMessageError
from smartcam.ros2._node.attachment import Attachment
from smartcam.ros2._node.tokens import SUBSCRIPTION
from smartcam.ros2._node.topic_reader import TopicReader

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Self

    from smartcam.ros2._node.context import NewestLane, RosContext
    from smartcam.ros2._node.tokens import Entity
    from smartcam.ros2._types.types import MessageType

logger: logging.Logger = logging.getLogger("smartcam.ros2")

MAX_DIRECT_BYTES = 1 << 16
"""Largest message in bytes that the event loop sends; a thread sends larger ones, and may wait."""

MAX_WAITING_BYTES = 1 << 26
"""Largest number of bytes of a topic's messages that wait to be sent, or to be read."""


def message_or_fields(message: object, fields: dict[str, Any]) -> object:
    """Return the message to send, or its fields if no message is given."""
    if message is not None and fields:
        raise RosMessageError("expected a message or its fields, got both")
    return fields if message is None else message


MAX_SHORT_MESSAGES = 10_000
"""Largest number of waiting short messages of a topic; of long messages, ``depth`` may wait."""

HEARTBEAT_INTERVAL = 0.5
"""Seconds between two heartbeats of a latched topic (``rmw_publisher_data.cpp``)."""


class RosEndpoint:
    """An endpoint of a topic or a service, with its token.

    Args:
        context: context that the node shares with others.
        entity: entry of this endpoint in the graph.
        on_close: function called with this endpoint once it is closed.
    """

    def __init__(
        self, context: RosContext, entity: Entity, on_close: Callable[[RosEndpoint], None]
    ) -> None:
        self.entity: Entity = entity
        self._context, self._on_close = context, on_close
        self._declared: list[ZenohDeclared] = []
        self._closed = False

    @property
    def name(self) -> str:
        """The absolute name of the topic or service."""
        return self.entity.name

    def _declare(
        self, declare: Callable[[Any], Any], *, by_dropping: bool = False
    ) -> ZenohDeclared:
        """Declare at Zenoh, until this endpoint is closed; arguments as of ZenohDeclared."""
        declared = ZenohDeclared(self._context.zenoh, by_dropping=by_dropping).declare(declare)
        self._declared.append(declared)
        return declared

    def _declare_token(self) -> None:
        """Declare the token, which makes the endpoint visible in the graph."""
        token = self.entity.token
        self._declare(lambda session: session.liveliness().declare_token(token))
        self._context.add_endpoint(self.entity)

    def close(self) -> None:
        """Undeclare the endpoint. Idempotent."""
        if self._closed:
            return
        self._closed = True
        self._context.remove_endpoint(self.entity)
        for declared in reversed(self._declared):  # the token first
            declared.close()
        self._on_close(self)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()


class RosPublisher(RosEndpoint):
    """Publishes on a topic; created by :meth:`Node.publisher`.

    Attributes:
        type: type of the messages.
        published: number of messages passed to Zenoh.
        dropped: number of messages dropped for want of room, the oldest first.
    """

    def __init__(
        self,
        context: RosContext,
        entity: Entity,
        message_type: MessageType,
        on_close: Callable[[RosEndpoint], None],
    ) -> None:
        super().__init__(context, entity, on_close)
        self.type: MessageType = message_type
        self.published: int = 0
        self.dropped: int = 0
        self._number = 0
        self._lock = threading.Lock()
        self._waiting: collections.deque[tuple[bytes, bytes]] = collections.deque()
        self._bytes = 0
        self._publisher: Any = None
        qos = entity.qos  # sending what must not be dropped may block; the event loop must not
        self._may_send_directly = not qos.latched and not (qos.reliable and qos.depth is None)
        # publishers that wait for room, by thread name
        self._blocking_publishers: dict[str, Any] = {}
        # publisher that skips links with a message in transmission
        self._newest_publisher: Any = None
        self._lane: NewestLane | None = None
        self._thread_name = "latched" if qos.latched else "short"
        self._declared_publisher = ZenohDeclared(context.zenoh, by_dropping=qos.latched).declare(
            self._declare_publisher
        )
        self._declare_token()

    def _declare_publisher(self, session: Any) -> Any:
        zenoh, qos = self._context.zenoh.zenoh, self.entity.qos
        drop = zenoh.CongestionControl.DROP
        block = zenoh.CongestionControl.BLOCK
        is_blocking = qos.latched or (qos.depth is None and qos.reliable)
        declare: dict[str, Any] = {
            "congestion_control": block if is_blocking else drop,
            "reliability": zenoh.Reliability.RELIABLE
            if qos.reliable
            else zenoh.Reliability.BEST_EFFORT,
            "express": True,
        }
        if qos.latched:
            import zenoh.ext as zenoh_ext

            miss_detection = zenoh_ext.MissDetectionConfig(
                heartbeat=None, sporadic_heartbeat=HEARTBEAT_INTERVAL
            )
            self._publisher = zenoh_ext.declare_advanced_publisher(
                session,
                self.entity.key,
                cache=zenoh_ext.CacheConfig(max_samples=qos.kept),
                sample_miss_detection=miss_detection if qos.reliable else None,
                publisher_detection=True,
                **declare,
            )
        else:
            self._publisher = session.declare_publisher(self.entity.key, **declare)
        return self._publisher

    @property
    def has_subscribers(self) -> bool:
        """True if the topic has a known subscriber, and always if it is latched."""
        if self._closed:
            return False
        return self.entity.qos.latched or bool(self._publisher.matching_status.matching)

    def watch(self, call: Callable[[], None]) -> Callable[[], None]:
        """Call ``call`` when a subscriber comes or goes; return a function that ends this.

        ``has_subscribers`` may change a moment later.
        """
        return self._context.watch_endpoints(
            self.name, SUBSCRIPTION, lambda _entity, _present: call()
        )

    def publish(self, message: object = None, /, **fields: Any) -> None:
        """Publish a message; never waits.

        Args:
            message: a message of the type, or a mapping of its fields.
            **fields: the fields, if no message is given.

        Raises:
            RosMessageError: the value is not a message of the type.
            RosError: the publisher is closed.
        """
        self.publish_encoded(self.type.encode(message_or_fields(message, fields)))

    def publish_encoded(self, data: bytes) -> None:
        """Publish an encoded message of the type; never waits.

        Raises:
            RosError: the publisher is closed.
        """
        self._check_open()
        attachment = self._attachment()
        has_waiting = self._context.has_waiting(self)
        if len(data) > MAX_DIRECT_BYTES and self._thread_name == "short" and not has_waiting:
            self._thread_name = "long"  # also for later messages: a short one would overtake it
        if (
            self._may_send_directly
            and self._thread_name == "short"
            and not has_waiting
            and self._context.allow_direct_send()
        ):
            quietly(self._publisher.put, data, attachment=attachment)
            self.published += 1
            return
        max_waiting = MAX_SHORT_MESSAGES if self._thread_name == "short" else self.entity.qos.kept
        with self._lock:
            self._waiting.append((data, attachment))
            self._bytes += len(data)
            while len(self._waiting) > max_waiting or self._bytes > MAX_WAITING_BYTES:
                if len(self._waiting) == 1:
                    break
                self._bytes -= len(self._waiting.popleft()[0])
                self.dropped += 1
        self._context.send_in_thread(self, self._send_oldest, self._thread_name)

    async def publish_newest(self, message: object = None, /, **fields: Any) -> None:
        """Publish a message; a long one is left out on links that are still sending another.

        It is meant for pictures, which thus never queue up, or get old, for a slow subscriber, and
        never delay other subscribers. A thread encodes the message; the call returns when Zenoh
        has copied it.

        Raises:
            RosMessageError: the value is not a message of the type.
            RosError: the publisher is closed.

        Cancellation: the message may be published nevertheless.
        """
        self._check_open()
        message = message_or_fields(message, fields)
        if self._lane is None:
            self._lane = self._context.next_lane()
            self._thread_name = self._lane.thread_name
        sent: concurrent.futures.Future[None] = concurrent.futures.Future()

        def publish() -> None:
            if not sent.set_running_or_notify_cancel():
                return
            try:
                self._send_newest(self.type.encode(message))
            except BaseException as exc:  # noqa: BLE001 - passed to the waiting task
                sent.set_exception(exc)
            else:
                sent.set_result(None)

        self._context.send_in_thread(self, publish, self._thread_name)
        await asyncio.wrap_future(sent)

    def _send_newest(self, data: bytes) -> None:
        """Send a message; called in a sending thread of the context.

        Long messages have a publisher of their own. On a link that is still sending a message of
        the same priority, Zenoh skips the new one; hence the short pause between messages.
        """
        lane, publisher = self._lane, self._publisher
        if self._closed or lane is None:
            return
        attachment = self._attachment()
        if len(data) > MAX_DIRECT_BYTES:
            if self._newest_publisher is None:
                zenoh = self._context.zenoh.zenoh
                self._newest_publisher = self._context.zenoh.session.declare_publisher(
                    self.entity.key,
                    congestion_control=zenoh.CongestionControl.BLOCK_FIRST,
                    priority=getattr(zenoh.Priority, lane.priority),
                )
            publisher = self._newest_publisher
            lane.wait_for_link(len(data))
        quietly(publisher.put, data, attachment=attachment)
        self.published += 1

    def _check_open(self) -> None:
        if self._closed:
            raise RosError(f"{self.name}: this publisher is closed")

    def _attachment(self) -> bytes:
        self._number += 1
        return Attachment(self._number, time.time_ns(), self.entity.gid).encode()

    def _send_oldest(self) -> None:
        """Send the oldest waiting message; called in a sending thread of the context."""
        with self._lock:
            if not self._waiting or self._closed:
                return
            data, attachment = self._waiting.popleft()
            self._bytes -= len(data)
        self._blocking_publisher().put(data, attachment=attachment)
        self.published += 1

    def _blocking_publisher(self) -> Any:
        """Return the publisher that waits for room; for long messages it has a lower priority."""
        zenoh, thread_name = self._context.zenoh.zenoh, self._thread_name
        if self.entity.qos.latched:
            return self._publisher  # a latched topic's publisher has to keep the messages
        if thread_name not in self._blocking_publishers:
            self._blocking_publishers[thread_name] = self._context.zenoh.session.declare_publisher(
                self.entity.key,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA if thread_name == "short" else zenoh.Priority.DATA_LOW,
            )
        return self._blocking_publishers[thread_name]

    def close(self) -> None:
        """Undeclare the topic, and drop waiting messages. Idempotent."""
        if self._closed:
            return
        super().close()
        with self._lock:
            self.dropped += len(self._waiting)
            self._waiting.clear()
            self._bytes = 0
        if self._context.has_waiting(self):  # the thread undeclares it after a running send
            self._context.send_in_thread(self, self._undeclare, self._thread_name)
        else:
            self._undeclare()

    def _undeclare(self) -> None:
        for publisher in (*self._blocking_publishers.values(), self._newest_publisher):
            if publisher is not None:
                quietly(publisher.undeclare)
        self._blocking_publishers, self._newest_publisher = {}, None
        self._publisher = None
        self._declared_publisher.close()


class _ReceivedMessage(NamedTuple):
    data: bytes
    attachment: Attachment


class RosSubscription(RosEndpoint, TopicReader[_ReceivedMessage]):
    """Subscription to a topic, created by :meth:`Node.subscribe` and read by ``async for``.

    Attributes:
        attachment: number, time and publisher of the last message that was read.
    """

    def __init__(
        self,
        context: RosContext,
        entity: Entity,
        message_type: MessageType,
        on_close: Callable[[RosEndpoint], None],
    ) -> None:
        RosEndpoint.__init__(self, context, entity, on_close)
        TopicReader.__init__(self, entity.name, message_type, entity.qos.kept, MAX_WAITING_BYTES)
        self.attachment: Attachment | None = None
        self._declare(self._declare_subscriber, by_dropping=entity.qos.latched)
        self._declare_token()

    def _declare_subscriber(self, session: Any) -> Any:
        zenoh_session = self._context.zenoh

        def on_sample(sample: Any) -> None:
            data = sample.payload.to_bytes()
            if zenoh_session.full(len(data)):
                return
            attachment_bytes = None if sample.attachment is None else sample.attachment.to_bytes()
            zenoh_session.call_in_loop(self._on_message, len(data), data, attachment_bytes)

        qos = self.entity.qos
        if not qos.latched:
            return session.declare_subscriber(self.entity.key, direct(on_sample))
        import zenoh.ext as zenoh_ext

        recovery = zenoh_ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
        return zenoh_ext.declare_advanced_subscriber(
            session,
            self.entity.key,
            direct(on_sample),
            history=zenoh_ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.kept),
            recovery=recovery if qos.reliable else None,
            subscriber_detection=True,
        )

    def _on_message(self, data: bytes, attachment_bytes: bytes | None) -> None:
        if self._closed:
            return
        try:
            attachment = Attachment.decode(attachment_bytes)
        except RosMessageError as exc:
            self._reject(exc)
            return
        self._queue.offer(_ReceivedMessage(data, attachment), 0.0, len(data))

    def _decode_item(self, item: _ReceivedMessage) -> Any:
        message = self.type.decode(item.data)
        self.attachment = item.attachment
        return message

    def close(self) -> None:
        """Stop receiving; iteration ends. Idempotent."""
        super().close()
        self._queue.close()
