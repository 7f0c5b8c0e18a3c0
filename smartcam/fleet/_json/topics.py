"""Publish topics in JSON for programs without smartcam, while they have subscribers."""

from __future__ import annotations

import asyncio
import collections
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Literal

from smartcam._client._inside import Interpretation
from smartcam._json import object_text
from smartcam.exceptions import SmartCamError
from smartcam.fleet._program.program_name import in_words
from smartcam.fleet._program.reading import result_fields, singles
from smartcam.models import Connected, Disconnected, Reconnected, Status, StatusChanged, jsonable

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from smartcam.fleet._agent.gate import Change
    from smartcam.fleet._agent.host import Host
    from smartcam.fleet._bus.bus import Bus, Handle, Publisher
    from smartcam.fleet._bus.keys import Keys
    from smartcam.fleet._bus.wire import ResultRun
    from smartcam.models import CameraEvent

MAX_QUEUED_BYTES = 1 << 24
"""Largest number of bytes of containers that wait for a topic with a delay; beyond it the oldest
are dropped."""

Kind = Literal["results", "status", "events"]


def as_json(fields: Mapping[str, object]) -> bytes:
    """Return fields as a payload."""
    return object_text(fields).encode()


class Topics:
    """The topics of one agent's cameras.

    One check shows whether any camera's topics have a subscriber; only then a camera's own
    publisher is created. So a thousand cameras cost nothing without subscribers.

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
        self._any: dict[Kind, Publisher] = {}
        self._made: dict[tuple[Kind, str], Publisher] = {}

    def open(self) -> None:
        """Start to check for subscribers."""
        kinds: tuple[Kind, ...] = ("results", "status", "events")
        for kind in kinds:
            self._any[kind] = self.bus.publisher(self.keys.topic(kind, "**"))

    def close(self) -> None:
        """Close all publishers."""
        handles: list[Handle] = [*self._any.values(), *self._made.values()]
        self._any.clear()
        self._made.clear()
        for handle in handles:
            handle.close()

    def subscribed(self, kind: Kind, camera: str) -> Publisher | None:
        """Return the publisher of one kind of a camera's messages; None without a subscriber."""
        everyone = self._any.get(kind)
        if everyone is None or not everyone.has_subscribers:
            return None
        made = self._made.get((kind, camera))
        if made is None:
            made = self._made[kind, camera] = self.bus.publisher(self.keys.topic(kind, camera))
        return made if made.has_subscribers else None

    def forget(self, camera: str) -> None:
        """Close the publishers of a camera that is no longer shared."""
        for key in [key for key in self._made if key[1] == camera]:
            self._made.pop(key).close()


@dataclass(eq=False)
class Publication:
    """Results of one camera under the topic of a request, with a delay.

    Args:
        publisher: publisher of the results.
        min_delay: least seconds between two results.
        queue_size: largest number of waiting results; beyond it the oldest is dropped.
    """

    publisher: Publisher
    min_delay: float
    queue_size: int
    _queue: collections.deque[ResultRun] = field(default_factory=collections.deque["ResultRun"])
    _bytes: int = 0
    _timer: asyncio.TimerHandle | None = None

    def offer(self, runs: Iterable[ResultRun], topics: CameraTopics) -> None:
        """Queue results, each as its own run."""
        if not self.publisher.has_subscribers:
            return
        for run in runs:
            self._queue.append(run)
            self._bytes += run.size
            self._go_on(topics)
            while len(self._queue) > self.queue_size or self._bytes > MAX_QUEUED_BYTES:
                self._bytes -= self._queue.popleft().size

    def _go_on(self, topics: CameraTopics) -> None:
        while self._queue and self._timer is None:
            run = self._queue.popleft()
            self._bytes -= run.size
            self.publisher.put(as_json(topics.result(run)))
            if self.min_delay:
                loop = asyncio.get_running_loop()
                self._timer = loop.call_later(self.min_delay, self._next, topics)

    def _next(self, topics: CameraTopics) -> None:
        self._timer = None
        self._go_on(topics)

    def close(self) -> None:
        """Stop sending, and drop the results that wait."""
        self._queue.clear()
        if self._timer is not None:
            self._timer.cancel()
        self.publisher.close()


class CameraTopics:
    """The topics in JSON of one camera.

    Args:
        host: the camera.
        topics: topics of the camera's agent.

    Attributes:
        interpret_as: contents of the camera's containers, for values in JSON.
        interpretation: interpretation of the containers; None if their contents are not known.
        trouble: reason why there is no session; empty if there is one.
        stopped: whether the thesis' SmartcameraStop has closed the camera for its services.
        statuses, events: numbers of the next status and of the next event.
        status_out: publisher of the status under the topic of a request.
        results_out: publication of the results under the topic of a request.
    """

    def __init__(self, host: Host, topics: Topics) -> None:
        self._host, self._topics = host, topics
        self.trouble: str = ""
        self.stopped: bool = False
        self.status_out: Publisher | None = None
        self.results_out: Publication | None = None
        self.statuses: int = 1
        self.events: int = 1
        self._before: Status | None = None
        self.interpret(host.settings.interpret_as)

    def interpret(self, spec: Any) -> None:
        """Interpret the camera's containers in another way from now on.

        Raises:
            ConfigurationError: ``spec`` is not valid.
        """
        self.interpretation: Interpretation | None = None if spec is None else self.reading(spec)
        self.interpret_as: Any = spec

    def reading(self, spec: Any) -> Interpretation:
        """Return the interpretation of its containers by ``spec``.

        Raises:
            ConfigurationError: ``spec`` is not valid.
        """
        settings = self._host.settings
        return Interpretation(spec, lenient=settings.lenient, y_down=settings.y_down)

    def publish_status(self, topic: str) -> str:
        """Publish the status under a topic of the thesis' interface; return its key.

        It replaces the previous one; an empty name ends it.
        """
        if self.status_out is not None:
            self.status_out.close()
            self.status_out = None
        key = self._topics.keys.thesis_topic(topic) if topic else ""
        if key:
            self.status_out = self._topics.bus.publisher(key)
        return key

    def publish_results(self, topic: str, min_delay: float, queue_size: int) -> str:
        """Publish results under a topic of the thesis' interface; return its key.

        It replaces the previous one; an empty name ends it.
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
        """End all publishing under topics of requests."""
        self.publish_status("")
        self.publish_results("", 0.0, 0)

    def close(self) -> None:
        """End all publishing of a camera that is no longer shared."""
        self.end_publishing()
        self._topics.forget(self._host.name)

    # ------------------------------------------------------------------ as JSON

    def result(self, run: ResultRun) -> dict[str, Any]:
        """Return a result; ``run`` has one container."""
        fields = result_fields(run, self.interpretation, self._host.name)
        return {**self._topics.identity, **fields}

    def state(self) -> dict[str, Any]:
        """Return the fields of the camera's current state."""
        host = self._host
        state = host.state()
        word: int | None = state["status"]
        return {
            "camera": host.name,
            **self._topics.identity,
            "connected": state["connected"],
            "failure": str(host.failure or self.trouble),
            "status": word,
            "status_names": [] if word is None else Status(word).names,
            "application": state["application"],
            "reserved_by": None if host.gate.holder is None else in_words(host.gate.holder),
        }

    def listing(self) -> dict[str, Any]:
        """Return all known fields of the camera."""
        host = self._host
        dialect = capabilities = None
        try:
            can = host.camera.capabilities
        except SmartCamError:
            pass  # there was no session yet
        else:
            dialect, capabilities = can.dialect, can.names
        return {
            **self.state(),
            "url": host.camera.url,
            "protocol": host.settings.address.protocol,
            "dialect": dialect,
            "protocol_version": host.camera.protocol_version,
            "capabilities": capabilities,
            "interpret_as": jsonable(self.interpret_as),
            "y_down": host.settings.y_down,
            "lenient": host.settings.lenient,
            "frames": host.frames.url,
            "next_result": host.results.following,
        }

    # ------------------------------------------------------------------ from the camera

    def on_run(self, run: ResultRun) -> None:
        """Publish received containers."""
        out = self._topics.subscribed("results", self._host.name)
        if out is not None:
            for single in singles(run):
                out.put(as_json(self.result(single)))
        if self.results_out is not None:
            self.results_out.offer(singles(run), self)

    def on_state(self) -> None:
        """Number the camera's state, and publish it if there is a subscriber."""
        number, self.statuses = self.statuses, self.statuses + 1
        out = self._topics.subscribed("status", self._host.name)
        if out is None and self.status_out is None:
            return
        outs = [out, self.status_out]
        subscribed = [each for each in outs if each is not None and each.has_subscribers]
        if subscribed:
            at = datetime.now(UTC).isoformat()
            data = as_json({**self.state(), "number": number, "at": at})
            for publisher in subscribed:
                publisher.put(data)

    def on_status(self, status: Status) -> None:
        """Handle a status of the camera; publish its change as an event."""
        before, self._before = self._before, status
        if status != before:
            number, self.events = self.events, self.events + 1
            if self._topics.subscribed("events", self._host.name) is not None:
                at, name = datetime.now(UTC), self._host.name
                changed = StatusChanged(camera=name, at=at, status=status, previous=before)
                self._publish_event(changed, number)

    def on_event(self, event: CameraEvent) -> None:
        """Publish an event of the camera."""
        number, self.events = self.events, self.events + 1
        if isinstance(event, Disconnected):
            self.trouble = event.reason
        elif isinstance(event, (Connected, Reconnected)):
            self.trouble = ""
        self._publish_event(event, number)

    def on_reservation(self, change: Change, program: str) -> None:
        """Publish that a program has reserved the camera, or no longer has."""
        number, self.events = self.events, self.events + 1
        fields = {"camera": self._host.name, "at": jsonable(datetime.now(UTC))}
        fields["by"] = in_words(program)
        self._put_event(change, fields, number)

    def _publish_event(self, event: CameraEvent, number: int) -> None:
        if self._topics.subscribed("events", self._host.name) is not None:
            self._put_event(type(event).__name__, jsonable(event), number)

    def _put_event(self, kind: str, fields: dict[str, Any], number: int) -> None:
        out = self._topics.subscribed("events", self._host.name)
        if out is not None:
            out.put(as_json({**self._topics.identity, "number": number, "event": kind, **fields}))
