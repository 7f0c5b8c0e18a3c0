"""Publish results, states and events in JSON for programs that do not use smartcam."""

from __future__ import annotations

import asyncio
import collections
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Literal

from smartcam._client._inside import Interpretation
from smartcam._json import object_json
from smartcam.exceptions import SmartCamError
from smartcam.fleet._program.program_name import in_words
from smartcam.fleet._program.reading import result_fields, split_group
from smartcam.models import Connected, Disconnected, Reconnected, Status, StatusChanged, jsonable

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from smartcam.fleet._agent.gate import Change
    from smartcam.fleet._agent.shared_camera import SharedCamera
    from smartcam.fleet._bus.bus import Bus, Handle, Publisher
    from smartcam.fleet._bus.keys import Keys
    from smartcam.fleet._bus.wire import ResultGroup
    from smartcam.models import CameraEvent

MAX_QUEUED_BYTES = 1 << 24
"""Largest number of bytes of containers that wait for a topic with a delay; the oldest containers
beyond it are dropped."""

Kind = Literal["results", "status", "events"]


def as_json(fields: Mapping[str, object]) -> bytes:
    """Return fields as JSON in UTF-8."""
    return object_json(fields).encode()


class Topics:
    """The topics of one agent's cameras.

    A message is published only while somebody subscribes to it. For each kind of messages, one
    publisher for all cameras finds out whether there is any subscriber. A publisher of a single
    camera is created only then. So a thousand cameras without subscribers need no publishers.

    Args:
        agent: the agent's name.
        epoch: number of the agent's start.
        keys: keys of the fleet.
        bus: bus on which messages are sent.
    """

    def __init__(self, agent: str, epoch: int, keys: Keys, bus: Bus) -> None:
        self.identity: dict[str, str] = {"agent": agent, "epoch": str(epoch)}
        self.keys: Keys = keys
        self.bus: Bus = bus
        self._kind_publishers: dict[Kind, Publisher] = {}
        self._camera_publishers: dict[tuple[Kind, str], Publisher] = {}

    def open(self) -> None:
        """Start to check for subscribers."""
        kinds: tuple[Kind, ...] = ("results", "status", "events")
        for kind in kinds:
            self._kind_publishers[kind] = self.bus.publisher(self.keys.topic(kind, "**"))

    def close(self) -> None:
        """Close all publishers."""
        handles: list[Handle] = [*self._kind_publishers.values(), *self._camera_publishers.values()]
        self._kind_publishers.clear()
        self._camera_publishers.clear()
        for handle in handles:
            handle.close()

    def publisher_of(self, kind: Kind, camera: str) -> Publisher | None:
        """Return the publisher of one kind of a camera's messages; None without a subscriber."""
        kind_publisher = self._kind_publishers.get(kind)
        if kind_publisher is None or not kind_publisher.has_subscribers:
            return None
        publisher = self._camera_publishers.get((kind, camera))
        if publisher is None:
            publisher = self._camera_publishers[kind, camera] = self.bus.publisher(
                self.keys.topic(kind, camera)
            )
        return publisher if publisher.has_subscribers else None

    def close_camera(self, camera: str) -> None:
        """Close the publishers of a camera that is no longer shared."""
        for key in [key for key in self._camera_publishers if key[1] == camera]:
            self._camera_publishers.pop(key).close()


@dataclass(eq=False)
class Publication:
    """Publishes the results of one camera under the topic that a service call named, with a delay.

    Args:
        publisher: publisher of the results.
        min_delay: least seconds between two results.
        queue_size: largest number of waiting results; the oldest results beyond it are dropped.
    """

    publisher: Publisher
    min_delay: float
    queue_size: int
    _queue: collections.deque[ResultGroup] = field(default_factory=collections.deque["ResultGroup"])
    _bytes: int = 0
    _timer: asyncio.TimerHandle | None = None

    def offer(self, groups: Iterable[ResultGroup], topics: CameraTopics) -> None:
        """Queue results, and send them as the delay allows; each group has one container."""
        if not self.publisher.has_subscribers:
            return
        for group in groups:
            self._queue.append(group)
            self._bytes += group.size
            self._send_queued(topics)
            while len(self._queue) > self.queue_size or self._bytes > MAX_QUEUED_BYTES:
                self._bytes -= self._queue.popleft().size

    def _send_queued(self, topics: CameraTopics) -> None:
        while self._queue and self._timer is None:
            group = self._queue.popleft()
            self._bytes -= group.size
            self.publisher.put(as_json(topics.result(group)))
            if self.min_delay:
                loop = asyncio.get_running_loop()
                self._timer = loop.call_later(self.min_delay, self._on_delay_over, topics)

    def _on_delay_over(self, topics: CameraTopics) -> None:
        self._timer = None
        self._send_queued(topics)

    def close(self) -> None:
        """Stop sending, and drop the results that wait."""
        self._queue.clear()
        if self._timer is not None:
            self._timer.cancel()
        self.publisher.close()


class CameraTopics:
    """The topics in JSON of one camera.

    Args:
        camera: the camera.
        topics: topics of the camera's agent.

    Attributes:
        interpret_as: interpreter or layout of the camera's containers, for values in JSON.
        interpretation: interpretation of the containers; None if their contents are not known.
        trouble: reason why there is no session; empty if there is one.
        stopped: whether SmartcameraStop, a service of the thesis with which smartcam began, has
            closed the camera for those services.
        next_status, next_event: numbers of the next status and of the next event.
        status_out: publisher of the status under the topic that a service call named.
        results_out: publication of the results under the topic that a service call named.
    """

    def __init__(self, camera: SharedCamera, topics: Topics) -> None:
        self._camera, self._topics = camera, topics
        self.trouble: str = ""
        self.stopped: bool = False
        self.status_out: Publisher | None = None
        self.results_out: Publication | None = None
        self.next_status: int = 1
        self.next_event: int = 1
        self._last_status: Status | None = None
        self.set_interpretation(camera.settings.interpret_as)

    def set_interpretation(self, spec: Any) -> None:
        """Interpret the camera's containers by ``spec`` from now on; None: not at all.

        Raises:
            ConfigurationError: ``spec`` is not valid.
        """
        self.interpretation: Interpretation | None = (
            None if spec is None else self.make_interpretation(spec)
        )
        self.interpret_as: Any = spec

    def make_interpretation(self, spec: Any) -> Interpretation:
        """Return an interpretation of the camera's containers by ``spec``.

        Raises:
            ConfigurationError: ``spec`` is not valid.
        """
        settings = self._camera.settings
        return Interpretation(spec, lenient=settings.lenient, y_down=settings.y_down)

    def publish_status(self, topic: str) -> str:
        """Publish the status under a topic of the thesis' services; return its key.

        This replaces the previous topic; an empty name only ends it.
        """
        if self.status_out is not None:
            self.status_out.close()
            self.status_out = None
        key = self._topics.keys.thesis_topic(topic) if topic else ""
        if key:
            self.status_out = self._topics.bus.publisher(key)
        return key

    def publish_results(self, topic: str, min_delay: float, queue_size: int) -> str:
        """Publish results under a topic of the thesis' services; return its key.

        This replaces the previous topic; an empty name only ends it.
        """
        if self.results_out is not None:
            self.results_out.close()
            self.results_out = None
        key = self._topics.keys.thesis_topic(topic) if topic else ""
        if key:
            publisher = self._topics.bus.publisher(key)
            self.results_out = Publication(publisher, min_delay, queue_size)
        return key

    def end_publishing(self) -> None:
        """End all publishing under topics that service calls named."""
        self.publish_status("")
        self.publish_results("", 0.0, 0)

    def close(self) -> None:
        """End all publishing of a camera that is no longer shared."""
        self.end_publishing()
        self._topics.close_camera(self._camera.name)

    # ------------------------------------------------------------------ fields for JSON

    def result(self, group: ResultGroup) -> dict[str, Any]:
        """Return the fields of a result; ``group`` has one container."""
        fields = result_fields(group, self.interpretation, self._camera.name)
        return {**self._topics.identity, **fields}

    def state(self) -> dict[str, Any]:
        """Return the fields of the camera's current state."""
        camera = self._camera
        state = camera.state_fields()
        bits: int | None = state["status"]
        return {
            "camera": camera.name,
            **self._topics.identity,
            "connected": state["connected"],
            "failure": str(camera.failure or self.trouble),
            "status": bits,
            "status_names": [] if bits is None else Status(bits).names,
            "application": state["application"],
            "reserved_by": None if camera.gate.holder is None else in_words(camera.gate.holder),
        }

    def listing(self) -> dict[str, Any]:
        """Return all known fields of the camera."""
        camera = self._camera
        dialect = capabilities = None
        try:
            features = camera.client.capabilities
        except SmartCamError:
            pass  # there was no session yet
        else:
            dialect, capabilities = features.dialect, features.names
        return {
            **self.state(),
            "url": camera.client.url,
            "protocol": camera.settings.address.protocol,
            "dialect": dialect,
            "protocol_version": camera.client.protocol_version,
            "capabilities": capabilities,
            "interpret_as": jsonable(self.interpret_as),
            "y_down": camera.settings.y_down,
            "lenient": camera.settings.lenient,
            "frames": camera.frames.url,
            "next_result": camera.results.next_number,
        }

    # ------------------------------------------------------------------ from the camera

    def on_group(self, group: ResultGroup) -> None:
        """Publish received containers."""
        out = self._topics.publisher_of("results", self._camera.name)
        if out is not None:
            for single in split_group(group):
                out.put(as_json(self.result(single)))
        if self.results_out is not None:
            self.results_out.offer(split_group(group), self)

    def on_state(self) -> None:
        """Number the camera's state, and publish it if there is a subscriber."""
        number, self.next_status = self.next_status, self.next_status + 1
        out = self._topics.publisher_of("status", self._camera.name)
        if out is None and self.status_out is None:
            return
        publishers = [out, self.status_out]
        subscribed = [out for out in publishers if out is not None and out.has_subscribers]
        if subscribed:
            at = datetime.now(UTC).isoformat()
            data = as_json({**self.state(), "number": number, "at": at})
            for publisher in subscribed:
                publisher.put(data)

    def on_status(self, status: Status) -> None:
        """Handle a status of the camera; publish its change as an event."""
        previous, self._last_status = self._last_status, status
        if status != previous:
            number, self.next_event = self.next_event, self.next_event + 1
            if self._topics.publisher_of("events", self._camera.name) is not None:
                at, name = datetime.now(UTC), self._camera.name
                changed = StatusChanged(camera=name, at=at, status=status, previous=previous)
                self._publish_event(changed, number)

    def on_event(self, event: CameraEvent) -> None:
        """Publish an event of the camera."""
        number, self.next_event = self.next_event, self.next_event + 1
        if isinstance(event, Disconnected):
            self.trouble = event.reason
        elif isinstance(event, (Connected, Reconnected)):
            self.trouble = ""
        self._publish_event(event, number)

    def on_reservation(self, change: Change, program: str) -> None:
        """Publish that a program has reserved the camera, or no longer has."""
        number, self.next_event = self.next_event, self.next_event + 1
        fields = {"camera": self._camera.name, "at": jsonable(datetime.now(UTC))}
        fields["program"] = in_words(program)
        self._put_event(change, fields, number)

    def _publish_event(self, event: CameraEvent, number: int) -> None:
        if self._topics.publisher_of("events", self._camera.name) is not None:
            self._put_event(type(event).__name__, jsonable(event), number)

    def _put_event(self, kind: str, fields: dict[str, Any], number: int) -> None:
        out = self._topics.publisher_of("events", self._camera.name)
        if out is not None:
            out.put(as_json({**self._topics.identity, "number": number, "event": kind, **fields}))
