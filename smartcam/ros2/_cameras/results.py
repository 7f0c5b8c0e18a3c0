"""Publish the results of a camera on topics of its node, each once and in order.

``~/results`` has all results, ``~/localizations`` (``PoseArray``) and ``~/detections``
(``Detection3DArray``) have results with localizations in metres.
"""

from __future__ import annotations

import asyncio
import collections
import logging
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from smartcam._thesis import DEFAULT_QUEUED_RESULTS, MAX_DELAY, MAX_QUEUED_RESULTS
from smartcam._user_code import ENDS_PROGRAM
from smartcam.exceptions import ConfigurationError, InterpretationError, SmartCamError
from smartcam.ros2._cameras.messages import DETECTIONS, POSES, RESULT, ResultMessages
from smartcam.ros2._cameras.reading import localizations_in_metres
from smartcam.ros2._node.qos import DRIVER, QoS

if TYPE_CHECKING:
    from smartcam.camera import Camera
    from smartcam.models import Result
    from smartcam.streams import Subscription

logger: logging.Logger = logging.getLogger("smartcam.ros2")

TOPICS: Final = {"results": RESULT, "localizations": POSES, "detections": DETECTIONS}
"""Names, private to the node, and types."""

MAX_QUEUED_BYTES: Final = 1 << 24
"""Largest number of bytes of containers whose results wait for a topic with a delay."""

MAX_WAITING_RESULTS: Final = 4096
"""Largest number of results that wait to be published; beyond it the oldest is dropped."""


class CameraResults:
    """Publishes all results of a camera, whichever program triggered them.

    A header's stamp is the time of the result's arrival, by the clock of the machine that has the
    session (for a camera of a fleet: its agent's); no protocol of these cameras has the time of the
    picture. Results that arrived together have the same stamp. The ``frame_id`` is the camera's, or
    with a calibration the robot's.

    A result that cannot be interpreted has a message on ``~/results`` only, with its ``error``.
    Localizations in pixels are on ``~/results`` only, as JSON: the other topics have metres.

    Args:
        camera: camera of the results.
        node: node that publishes them, of ROS 2 or ROS 1.
        frame_id: name of the camera's frame; by default the camera's name.
        robot_frame: name of the robot's frame; empty: the name in the calibration.

    Attributes:
        active: whether results are published; otherwise they are discarded as they come.
        taken: number of results that came, including results that could not be interpreted.
        failed: number of results that could not be interpreted.
        refused: number of messages that could not be made from a result.
    """

    def __init__(
        self, camera: Camera[Any], node: Any, *, frame_id: str | None = None, robot_frame: str = ""
    ) -> None:
        self.active: bool = True
        self.taken: int = 0
        self.failed: int = 0
        self.refused: int = 0
        self._camera, self._node = camera, node
        calibration = camera.settings.calibration
        self._messages = ResultMessages(
            node.types, camera.name, frame_id or camera.name, calibration, robot_frame
        )
        self._publishers: dict[str, Any] = {}
        self._delayed: _DelayedTopic | None = None
        self._stream: Subscription[Result] | None = None
        self._task: asyncio.Task[None] | None = None

    @property
    def messages(self) -> ResultMessages:
        """Maker of messages from this camera's results."""
        return self._messages

    @property
    def dropped(self) -> int:
        """Number of results dropped since they came too fast to publish, or for ``min_delay``."""
        dropped_by_stream = 0 if self._stream is None else self._stream.statistics().dropped
        return dropped_by_stream + (0 if self._delayed is None else self._delayed.dropped)

    @property
    def has_subscribers(self) -> bool:
        """True if one of the topics has a subscriber."""
        delayed = () if self._delayed is None else (self._delayed,)
        return any(
            _has_subscribers(publisher) for publisher in (*self._publishers.values(), *delayed)
        )

    def start(self) -> None:
        """Declare the topics, and publish results from now on. Idempotent.

        Raises:
            RosError: the node is not open.
        """
        if self._task is not None:
            return
        try:
            for name, type_name in TOPICS.items():
                self._declare(name, type_name)
        except BaseException:
            self._withdraw()
            raise
        self._stream = self._camera.results(max_queue=MAX_WAITING_RESULTS)
        self._task = asyncio.get_running_loop().create_task(
            self._run(self._stream), name=f"{self._camera.name}: results to ROS"
        )

    def _declare(self, name: str, type_name: str) -> None:
        try:
            self._publishers[name] = self._node.publisher(f"~/{name}", type_name, qos=DRIVER)
        except ConfigurationError as exc:
            if type_name != DETECTIONS:
                raise
            # vision_msgs may not be installed: go on without this topic
            logger.info("%s: without %s: %s", self._node.full_name, name, exc)

    async def close(self) -> None:
        """Stop publishing, and withdraw the topics. Idempotent."""
        task, self._task = self._task, None
        stream, self._stream = self._stream, None
        try:
            if task is not None:
                task.cancel()
                await asyncio.wait((task,))
        finally:
            if stream is not None:
                stream.close()
            self._withdraw()

    def _withdraw(self) -> None:
        self.publish_on("")
        for publisher in self._publishers.values():
            publisher.close()
        self._publishers.clear()

    def publish_on(
        self, topic: str, min_delay: float = 0.0, queue_size: int = DEFAULT_QUEUED_RESULTS
    ) -> None:
        """Publish all results on a further topic, which replaces the last one given here.

        Args:
            topic: name of the topic, whose messages are as on ``~/results``; empty for none.
            min_delay: least seconds between two messages, for which results wait.
            queue_size: largest number of waiting results; beyond it the oldest is dropped, counted.

        Raises:
            ConfigurationError: the topic has no valid name, or a number is out of range.
        """
        if not 0 <= min_delay <= MAX_DELAY:
            raise ConfigurationError(
                f"{self._camera.name}: min_delay {min_delay}: expected 0 to {MAX_DELAY:g} seconds"
            )
        if not 1 <= queue_size <= MAX_QUEUED_RESULTS:
            raise ConfigurationError(
                f"{self._camera.name}: queue_size {queue_size}: expected 1 to {MAX_QUEUED_RESULTS}"
            )
        old_topic, self._delayed = self._delayed, None
        if old_topic is not None and old_topic.topic == topic:
            self._delayed = old_topic.with_limits(min_delay, queue_size)
            return
        try:
            if topic:
                publisher = self._make_publisher(topic, queue_size)
                self._delayed = _DelayedTopic(topic, publisher, min_delay, queue_size)
        except BaseException:
            self._delayed = old_topic
            raise
        if old_topic is not None:
            old_topic.close()

    def _make_publisher(self, topic: str, depth: int) -> Any:
        publisher = self._node.publisher(topic, RESULT, qos=QoS(depth=depth))
        general = self._publishers.get("results")
        if general is not None and _topic_name(publisher) == _topic_name(general):
            publisher.close()
            raise ConfigurationError(
                f"{self._camera.name}: {_topic_name(general)} has its results already: expected "
                "another topic, or none"
            )
        return publisher

    # ------------------------------------------------------------------ incoming results

    async def _run(self, stream: Subscription[Result]) -> None:
        while True:
            try:
                result = await anext(stream)
            except StopAsyncIteration:
                return
            except InterpretationError as exc:
                self._handle_failure(exc)
            except SmartCamError as exc:
                logger.warning("%s: no results any more: %s", self._camera.name, exc)
                return
            else:
                self._handle_result(result)
            await asyncio.sleep(0)  # let other tasks run

    def _handle_result(self, result: Result) -> None:
        if not self.active:
            return
        self.taken += 1
        parts, make = localizations_in_metres(self._camera, result), self._messages
        if parts is not None:
            self._publish_to("localizations", lambda: make.poses(result, parts))
            self._publish_to("detections", lambda: make.detections(result, parts))
        self._publish_result(
            _LazyMessage(result.number, lambda: make.result(result, parts), len(result.raw))
        )

    def _handle_failure(self, error: InterpretationError) -> None:
        if not self.active:
            return
        self.taken += 1
        self.failed += 1
        level = logging.DEBUG if self.failed > 1 else logging.WARNING
        logger.log(level, "%s ! a result could not be interpreted: %s", self._camera.name, error)
        message = self._messages.failed(error, datetime.now(UTC))
        self._publish_result(_LazyMessage(0, lambda: message, 0))

    def _publish_result(self, message: _LazyMessage) -> None:
        self._publish_to("results", message.make)
        if self._delayed is not None:
            self._delayed.offer(message, self._publish_message)

    def _publish_to(self, name: str, make: Any) -> None:
        publisher = self._publishers.get(name)
        if publisher is not None:
            self._publish_message(publisher, make)

    def _publish_message(self, publisher: Any, make: Any) -> None:
        if not _has_subscribers(publisher):
            return
        try:
            publisher.publish(make())
        except SmartCamError as exc:
            self.refused += 1
            level = logging.DEBUG if self.refused > 1 else logging.WARNING
            logger.log(level, "%s ! a result was not published: %s", self._node.full_name, exc)
        except ENDS_PROGRAM:
            raise
        except BaseException:
            self.refused += 1
            logger.exception("%s ! a result was not published", self._node.full_name)


def _has_subscribers(publisher: Any) -> bool:
    """Return False if it is known that a topic has no subscriber, otherwise True."""
    return bool(getattr(publisher, "has_subscribers", True))


def _topic_name(publisher: Any) -> str:
    return str(getattr(publisher, "name", "") or publisher.topic)


class _LazyMessage(NamedTuple):
    """A message that ``make`` builds when it is published."""

    number: int
    make: Any
    size: int


class _DelayedTopic:
    """A topic with a least delay between two messages, and a queue of waiting messages.

    Attributes:
        dropped: number of results dropped for want of room, or at the end.
    """

    def __init__(self, topic: str, publisher: Any, min_delay: float, queue_size: int) -> None:
        self.topic = topic
        self.dropped: int = 0
        self._publisher, self._min_delay, self._queue_size = publisher, min_delay, queue_size
        self._queue: collections.deque[_LazyMessage] = collections.deque()
        self._bytes = 0
        self._timer: asyncio.TimerHandle | None = None

    @property
    def has_subscribers(self) -> bool:
        """True if the topic has a subscriber."""
        return _has_subscribers(self._publisher)

    def offer(self, message: _LazyMessage, publish: Any) -> None:
        """Publish a message with ``publish`` as soon as the delay allows."""
        if not self.has_subscribers:
            return
        self._queue.append(message)
        self._bytes += message.size
        self._publish_waiting(publish)
        while len(self._queue) > self._queue_size or self._bytes > MAX_QUEUED_BYTES:
            self._bytes -= self._queue.popleft().size
            self.dropped += 1

    def _publish_waiting(self, publish: Any) -> None:
        while self._queue and self._timer is None:
            message = self._queue.popleft()
            self._bytes -= message.size
            publish(self._publisher, message.make)
            if self._min_delay:
                loop = asyncio.get_running_loop()
                self._timer = loop.call_later(self._min_delay, self._on_timer, publish)

    def _on_timer(self, publish: Any) -> None:
        self._timer = None
        self._publish_waiting(publish)

    def with_limits(self, min_delay: float, queue_size: int) -> _DelayedTopic:
        """Return a topic of the same publisher with other limits; drop waiting results."""
        self._drop_waiting()
        delayed = _DelayedTopic(self.topic, self._publisher, min_delay, queue_size)
        delayed.dropped = self.dropped
        return delayed

    def _drop_waiting(self) -> None:
        self.dropped += len(self._queue)
        self._queue.clear()
        if self._timer is not None:
            self._timer.cancel()

    def close(self) -> None:
        """Stop publishing, and drop waiting messages."""
        self._drop_waiting()
        self._publisher.close()
