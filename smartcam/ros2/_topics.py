"""The ends of topics: who publishes, and who hears.

As ``rmw_publisher_data.cpp`` and ``rmw_subscription_data.cpp`` of rmw_zenoh: what is latched is
kept by an advanced publisher, and asked for by an advanced subscriber.
"""

from __future__ import annotations

import collections
import logging
import threading
import time
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._zenoh import ZenohDeclared, direct, quietly
from smartcam.exceptions import RosError, RosMessageError
from smartcam.ros2._attachment import Attachment
from smartcam.streams import Subscription

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Self

    from smartcam.models import SubscriberStatistics
    from smartcam.ros2._context import RosContext
    from smartcam.ros2._tokens import Entity
    from smartcam.ros2._types import MessageType

logger: logging.Logger = logging.getLogger("smartcam.ros2")

LONG = 1 << 16
"""Bytes beyond which a message is said by a thread, which waits until the engine has taken it."""

MOST_WAITING = 1 << 26
"""Bytes of a topic's messages that wait to be said, or to be read."""

HEARTBEAT = 0.5
"""Seconds between two signs of how far a latched topic is (``rmw_publisher_data.cpp``)."""


def said(message: object, fields: dict[str, Any]) -> object:
    """Return what is to be said: a message, or the fields of one."""
    if message is not None and fields:
        raise RosMessageError("expected a message or its fields, got both")
    return fields if message is None else message


class RosEnd:
    """An end of a topic or a service, with its token, until it is closed.

    Args:
        context: what its node shares.
        entity: it in the graph.
        on_close: is told that it is closed.
    """

    def __init__(
        self, context: RosContext, entity: Entity, on_close: Callable[[RosEnd], None]
    ) -> None:
        self._context, self.entity, self._on_close = context, entity, on_close
        self._declared: list[ZenohDeclared] = []
        self._closed = False

    @property
    def name(self) -> str:
        """The absolute name of the topic or service."""
        return self.entity.name

    def _declare(self, how: Callable[[Any], Any]) -> ZenohDeclared:
        declared = ZenohDeclared(self._context.zenoh).of(how)
        self._declared.append(declared)
        return declared

    def _appear(self) -> None:
        """Be seen in the graph, when all else is there."""
        token = self.entity.token
        self._declare(lambda session: session.liveliness().declare_token(token))
        self._context.add(self.entity)

    def close(self) -> None:
        """Be gone. Idempotent."""
        if self._closed:
            return
        self._closed = True
        self._context.remove(self.entity)
        self._withdraw()
        self._on_close(self)

    def _withdraw(self) -> None:
        for declared in reversed(self._declared):  # the token first
            declared.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()


class RosPublisher(RosEnd):
    """Publishes on a topic; made by :meth:`Node.publisher`.

    Attributes:
        type: of the messages.
        published: messages that were handed to the engine.
        dropped: messages for which there was no room, the oldest of those that waited.
    """

    def __init__(
        self,
        context: RosContext,
        entity: Entity,
        kind: MessageType,
        on_close: Callable[[RosEnd], None],
    ) -> None:
        super().__init__(context, entity, on_close)
        self.type: MessageType = kind
        self.published: int = 0
        self.dropped: int = 0
        self._number = 0
        self._lock = threading.Lock()
        self._waiting: collections.deque[tuple[bytes, bytes]] = collections.deque()
        self._bytes = 0
        self._publisher: Any = None
        self._patient: Any = None  # waits for room
        self._hasty: Any = None  # leaves out whom one is under way to
        self._using = 0  # threads that are in the engine; it forbids to undeclare meanwhile
        self._declare(self._make)
        self._appear()

    def _make(self, session: Any) -> Any:
        zenoh, qos = self._context.zenoh.engine, self.entity.qos
        congestion = zenoh.CongestionControl
        how: dict[str, Any] = {
            "congestion_control": congestion.BLOCK
            if qos.depth is None and qos.reliable
            # of what is latched a long message has to come whole, which DROP does not do
            else congestion.BLOCK_FIRST
            if qos.latched
            else congestion.DROP,
            "reliability": zenoh.Reliability.RELIABLE
            if qos.reliable
            else zenoh.Reliability.BEST_EFFORT,
            "express": True,
        }
        if qos.latched:
            import zenoh.ext as more

            misses = more.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT)
            self._publisher = more.declare_advanced_publisher(
                session,
                self.entity.key,
                cache=more.CacheConfig(max_samples=qos.kept),
                sample_miss_detection=misses if qos.reliable else None,
                publisher_detection=True,
                **how,
            )
        else:
            self._publisher = session.declare_publisher(self.entity.key, **how)
        return self._publisher

    @property
    def heard(self) -> bool:
        """Whether anybody hears it, as far as is known; a latched one counts as heard."""
        if self._closed:
            return False
        return self.entity.qos.latched or bool(self._publisher.matching_status.matching)

    def publish(self, message: object = None, /, **fields: Any) -> None:
        """Publish a message; never waits.

        Args:
            message: one of the type's own, or a mapping of its fields.
            **fields: the fields, where no message is given.

        Raises:
            RosMessageError: it is no message of the type.
            RosError: the publisher is closed.
        """
        self.publish_encoded(self.type.encode(said(message, fields)))

    def publish_encoded(self, data: bytes) -> None:
        """Publish bytes that are a message of the type already; never waits.

        Raises:
            RosError: the publisher is closed.
        """
        attachment = self._attachment()
        if len(data) <= LONG and not self._context.waits(self):
            quietly(self._publisher.put, data, attachment=attachment)
            self.published += 1
            return
        with self._lock:
            self._waiting.append((data, attachment))
            self._bytes += len(data)
            while len(self._waiting) > self.entity.qos.kept or self._bytes > MOST_WAITING:
                if len(self._waiting) == 1:
                    break
                self._bytes -= len(self._waiting.popleft()[0])
                self.dropped += 1
        self._context.say_later(self, self._say_next)

    def publish_newest(self, message: object = None, /, **fields: Any) -> None:
        """Publish a message, except to whom one is under way already; for any thread.

        For pictures: nobody who is slow has them queue up, holds up the others, or is sent one
        that is old. It blocks for as long as the engine takes to copy the message.

        Raises:
            RosMessageError: it is no message of the type.
            RosError: the publisher is closed.
        """
        data = self.type.encode(said(message, fields))
        self._put(self._hastily if len(data) > LONG else None, data, self._attachment())

    def _attachment(self) -> bytes:
        with self._lock:
            if self._closed:
                raise RosError(f"{self.name}: this publisher is closed")
            self._number += 1
            return Attachment(self._number, time.time_ns(), self.entity.gid).encode()

    def _say_next(self) -> None:
        """Say the oldest that waits; in the thread for it."""
        with self._lock:
            if not self._waiting or self._closed:
                return
            data, attachment = self._waiting.popleft()
            self._bytes -= len(data)
        # what is latched has to be kept, by the one that does so
        self._put(None if self.entity.qos.latched else self._patiently, data, attachment)

    def _put(self, make: Callable[[], Any] | None, data: bytes, attachment: bytes) -> None:
        """Hand a message to the engine; in a thread, which may wait there."""
        with self._lock:
            if self._closed:
                return
            self._using += 1
        try:
            publisher = self._publisher if make is None else make()
            publisher.put(data, attachment=attachment)
            self.published += 1
        except self._context.zenoh.engine.ZError as exc:
            logger.debug("%s: the engine: %s", self.name, exc)
        finally:
            with self._lock:
                self._using -= 1
                last = self._closed and not self._using
            if last:
                self._undeclare()

    def _patiently(self) -> Any:
        """Return what publishes long messages: it waits for room, behind all else."""
        if self._patient is None:
            self._patient = self._long(self._context.zenoh.engine.CongestionControl.BLOCK)
        return self._patient

    def _hastily(self) -> Any:
        """Return what publishes long messages to whom none is under way."""
        if self._hasty is None:
            self._hasty = self._long(self._context.zenoh.engine.CongestionControl.BLOCK_FIRST)
        return self._hasty

    def _long(self, congestion_control: Any) -> Any:
        return self._context.zenoh.session.declare_publisher(
            self.entity.key,
            congestion_control=congestion_control,
            priority=self._context.zenoh.engine.Priority.DATA_LOW,
        )

    def _withdraw(self) -> None:
        """What waits to be said is not said any more."""
        self._declared.pop().close()  # the token
        with self._lock:
            self.dropped += len(self._waiting)
            self._waiting.clear()
            self._bytes = 0
            busy = self._using
        if busy:  # the thread undeclares the others, which their session must not touch either
            for one in self._declared:
                self._context.zenoh.forget(one)
        else:
            self._undeclare()

    def _undeclare(self) -> None:
        with self._lock:
            declared, self._declared = self._declared, []
            more, self._patient, self._hasty = (self._patient, self._hasty), None, None
        for one in declared:
            one.close()
        for publisher in more:
            if publisher is not None:
                quietly(publisher.undeclare)


class _Heard(NamedTuple):
    data: bytes
    attachment: Attachment


class RosSubscription(RosEnd):
    """Hears a topic; made by :meth:`Node.subscribe`, and read by ``async for``.

    Messages wait in a queue with the depth of its quality of service; the oldest makes room. One
    that cannot be read is left out, counted and told in the log.

    Attributes:
        type: of the messages.
        attachment: number, time and publisher of the message that was read last.
        rejected: what came and was no message.
    """

    def __init__(
        self,
        context: RosContext,
        entity: Entity,
        kind: MessageType,
        on_close: Callable[[RosEnd], None],
    ) -> None:
        super().__init__(context, entity, on_close)
        self.type: MessageType = kind
        self.attachment: Attachment | None = None
        self.rejected: int = 0
        self._queue = Subscription[_Heard](
            entity.name,
            max_queue=entity.qos.kept,
            overflow="drop_oldest",
            max_queue_bytes=MOST_WAITING,
        )
        self._declare(self._make)
        self._appear()

    def _make(self, session: Any) -> Any:
        context = self._context.zenoh

        def on_sample(sample: Any) -> None:
            data = sample.payload.to_bytes()
            if context.full(len(data)):
                return
            extra = None if sample.attachment is None else sample.attachment.to_bytes()
            context.in_loop(self._take, len(data), data, extra)

        qos = self.entity.qos
        if not qos.latched:
            return session.declare_subscriber(self.entity.key, direct(on_sample))
        import zenoh.ext as more

        recovery = more.RecoveryConfig(periodic_queries=None, heartbeat=True)
        return more.declare_advanced_subscriber(
            session,
            self.entity.key,
            direct(on_sample),
            history=more.HistoryConfig(detect_late_publishers=True, max_samples=qos.kept),
            recovery=recovery if qos.reliable else None,
            subscriber_detection=True,
        )

    def _take(self, data: bytes, extra: bytes | None) -> None:
        if self._closed:
            return
        try:
            attachment = Attachment.decode(extra)
        except RosMessageError as exc:
            self._reject(exc)
            return
        self._queue.offer(_Heard(data, attachment), 0.0, len(data))

    def _reject(self, why: RosMessageError) -> None:
        self.rejected += 1
        level = logging.DEBUG if self.rejected > 1 else logging.WARNING
        logger.log(level, "%s ! %s; such messages are left out", self.name, why)

    def statistics(self) -> SubscriberStatistics:
        """Return the queue's account."""
        return self._queue.statistics()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Any:
        while True:
            heard = await anext(self._queue)
            try:
                message = self.type.decode(heard.data)
            except RosMessageError as exc:
                self._reject(exc)
                continue
            self.attachment = heard.attachment
            return message

    def close(self) -> None:
        """Hear no more; iterating ends. Idempotent."""
        super().close()
        self._queue.close()
