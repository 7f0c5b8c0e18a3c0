"""Publish a camera's status on the topic that the service SmartcameraSetup names."""

from __future__ import annotations

import asyncio
import logging
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

from smartcam._ros_names import resolve
from smartcam.exceptions import SmartCamError
from smartcam.ros2._cameras.health import STATUS_TYPE, KnownState, status_fields
from smartcam.ros2._node.qos import LATCHED

if TYPE_CHECKING:
    from smartcam.camera import Camera
    from smartcam.ros2._cameras.messages import ResultMessages

logger: logging.Logger = logging.getLogger("smartcam.ros2")

MIN_INTERVAL: Final = 0.05
"""Seconds between two messages."""

MAX_WAITING_EVENTS: Final = 64
"""Largest number of waiting events; only the camera's state after all of them is published."""


class CameraStatusTopic:
    """Publishes a camera's status, latched, when it changes, on at most one topic.

    Args:
        camera: camera of the status.
        node: node that publishes the topic.
        messages: maker of the headers.
    """

    def __init__(self, camera: Camera[Any], node: Any, messages: ResultMessages) -> None:
        self._camera, self._node, self._messages = camera, node, messages
        self._topic = ""
        self._publisher: Any = None
        self._task: asyncio.Task[None] | None = None
        self._cancelled_tasks: set[asyncio.Task[None]] = set()

    def resolve(self, topic: str) -> str:
        """Return a topic's full name; empty for none, and for ``~/status``.

        Raises:
            ConfigurationError: the topic is not valid.
        """
        if not topic:
            return ""
        name = resolve(topic, self._node.namespace, self._node.name, "topic")
        return "" if name == f"{self._node.full_name}/status" else name

    def publish_on(self, topic: str) -> None:
        """Publish on a topic instead of the previous one; empty for none.

        Raises:
            ConfigurationError: the topic is not valid.
        """
        name = self.resolve(topic)
        if name == self._topic:
            return
        self._stop()
        if name:
            self._publisher = self._node.publisher(name, STATUS_TYPE, qos=LATCHED)
            self._topic = name
            self._task = asyncio.get_running_loop().create_task(
                self._publish_changes(self._publisher),
                name=f"{self._camera.name}: status to {name}",
            )

    def _stop(self) -> None:
        task, self._task = self._task, None
        publisher, self._publisher, self._topic = self._publisher, None, ""
        if task is not None:
            task.cancel()
            self._cancelled_tasks.add(task)
            task.add_done_callback(self._cancelled_tasks.discard)
        if publisher is not None:
            publisher.close()

    async def close(self) -> None:
        """Stop publishing. Idempotent."""
        self._stop()
        if self._cancelled_tasks:
            await asyncio.wait(tuple(self._cancelled_tasks))

    async def _publish_changes(self, publisher: Any) -> None:
        published: dict[str, Any] | None = None
        async with self._camera.events(max_queue=MAX_WAITING_EVENTS) as events:
            while True:
                fields = status_fields(KnownState.of(self._camera))
                if fields != published:
                    published = fields
                    self._publish(publisher, fields)
                    await asyncio.sleep(MIN_INTERVAL)
                try:
                    await anext(events)
                except (SmartCamError, StopAsyncIteration):
                    break  # nothing more will come, and the status says why
        if status_fields(KnownState.of(self._camera)) != published:
            self._publish(publisher, status_fields(KnownState.of(self._camera)))

    def _publish(self, publisher: Any, fields: dict[str, Any]) -> None:
        header = self._messages.header(datetime.now(UTC), self._messages.frame_id)
        try:
            publisher.publish(publisher.type.new(header=header, **fields))
        except SmartCamError as exc:
            logger.warning("%s ! its status was not published: %s", self._node.full_name, exc)
