"""Read the messages of a topic, which wait in a bounded queue."""

from __future__ import annotations

import logging
import sys
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

from smartcam.exceptions import RosMessageError
from smartcam.streams import Subscription

if TYPE_CHECKING:
    from typing import Self

    from smartcam.models import SubscriberStatistics
    from smartcam.ros2._types.types import MessageType

Item = TypeVar("Item")


class TopicReader(ABC, Generic[Item]):
    """Subscription to a topic, read by ``async for``.

    Messages wait in a queue, which drops the oldest if it is full. A message that cannot be decoded
    is left out and counted; the first such message is logged.

    Args:
        topic: absolute name of the topic.
        message_type: type of the messages.
        depth: largest number of waiting messages.
        max_bytes: largest number of bytes of all waiting messages.

    Attributes:
        type: type of the messages.
        rejected: number of messages that could not be decoded.
    """

    _logger: ClassVar[logging.Logger] = logging.getLogger("smartcam.ros2")

    def __init__(
        self, topic: str, message_type: MessageType, depth: int, max_bytes: int = sys.maxsize
    ) -> None:
        self.type: MessageType = message_type
        self.rejected: int = 0
        self._topic = topic
        self._queue = Subscription[Item](
            topic, max_queue=depth, overflow="drop_oldest", max_queue_bytes=max_bytes
        )

    @abstractmethod
    def _decode_item(self, item: Item) -> Any:
        """Return the message of an item of the queue.

        Raises:
            RosMessageError: the item is not a message of the type.
        """

    def statistics(self) -> SubscriberStatistics:
        """Return the queue's counters."""
        return self._queue.statistics()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Any:
        while True:
            item = await anext(self._queue)
            try:
                return self._decode_item(item)
            except RosMessageError as exc:
                self._reject(exc)

    def _reject(self, error: RosMessageError) -> None:
        self.rejected += 1
        level = logging.DEBUG if self.rejected > 1 else logging.WARNING
        self._logger.log(level, "%s ! %s; such messages are left out", self._topic, error)
