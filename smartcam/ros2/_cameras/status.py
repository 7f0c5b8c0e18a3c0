"""Publish a camera's status, latched, and its diagnostics."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from smartcam._user_code import ENDS_PROGRAM
from smartcam.exceptions import SmartCamError
from smartcam.models import Connected, Disconnected, Reconnected, Statistics
from smartcam.ros2._cameras.health import (
    DIAGNOSTICS,
    MAX_ERROR_CHARACTERS,
    OK,
    STATUS_TYPE,
    WARN,
    Health,
    KnownState,
    diagnostic_fields,
    hardware_id,
    header_fields,
    health,
    status_fields,
)
from smartcam.ros2._cameras.reading import address_of
from smartcam.ros2._node.qos import DEFAULT, LATCHED

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from smartcam.camera import Camera
    from smartcam.ros2._cameras.options import CameraNodeOptions

logger: logging.Logger = logging.getLogger("smartcam.ros2")

MAX_WAITING_EVENTS = 64
"""Largest number of waiting events; only the camera's state after all of them is published."""

WARNING_COUNTERS: Mapping[str, str] = {
    "dropped": "results were dropped: a subscriber is too slow",
    "uninterpretable": "results do not fit their layout",
    "wrong_application": "results came from another application than expected",
    "overtriggers": "triggers were dropped: they come too fast",
    "late": "results came after the wait for them had ended",
}
"""Warning for each counter that has risen since the last diagnostics."""

COUNTERS = tuple(
    field.name for field in dataclasses.fields(Statistics) if field.type in {"int", int}
)
TIMES = ("round_trip", "processing")


class CameraStatus:
    """Publishes a camera's status when it changes, and its diagnostics periodically.

    Args:
        camera: camera of the status.
        node: node of ROS 2 or 1.
        options: settings of the camera's node.
        state: function that returns the state of the life cycle.

    Attributes:
        period: seconds between two diagnostics.
    """

    def __init__(
        self, camera: Camera[Any], node: Any, options: CameraNodeOptions, state: Callable[[], str]
    ) -> None:
        self._camera, self._node, self._options, self._state = camera, node, options, state
        self.period: float = options.diagnostics_period
        self._frame_id = options.frame_id or camera.name
        self._min_interval = 1.0 / options.status_rate
        self._published: dict[str, Any] | None = None
        self._next_status_at = -math.inf  # loop time of the next status
        self._connected_at: datetime | None = None
        self._last_counts: dict[str, int] = {}  # counters at the last diagnostics
        self._period_changed = asyncio.Event()
        self._listeners: list[Callable[[], None]] = []
        self._events: Any = None
        self._tasks: list[asyncio.Task[None]] = []
        self._publishers: list[Any] = []

    def start(self) -> None:
        """Publish the camera's status and diagnostics, now and from now on."""
        self._status = self._node.publisher("~/status", STATUS_TYPE, qos=LATCHED)
        self._publishers.append(self._status)
        self._diagnostics = self._node.publisher("/diagnostics", DIAGNOSTICS, qos=DEFAULT)
        self._publishers.append(self._diagnostics)
        self._events = self._camera.events(max_queue=MAX_WAITING_EVENTS)
        if self._camera.connected:
            self._connected_at = datetime.now(UTC)
        self._call_and_log_errors(self._publish_if_new)
        loop = asyncio.get_running_loop()
        self._tasks = [
            loop.create_task(self._publish_changes()),
            loop.create_task(self._publish_diagnostics()),
        ]

    async def close(self) -> None:
        """Stop publishing. Idempotent."""
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.cancel()
        if self._events is not None:
            self._events.close()
        publishers, self._publishers = self._publishers, []
        for publisher in publishers:
            publisher.close()
        if tasks:
            await asyncio.wait(tasks)

    def listen(self, on_change: Callable[[], None]) -> Callable[[], None]:
        """Call ``on_change`` after each change of the status; return a function that ends it."""
        self._listeners.append(on_change)
        return lambda: self._listeners.remove(on_change) if on_change in self._listeners else None

    def set_period(self, seconds: float) -> None:
        """Publish diagnostics in this period from now on."""
        self.period = seconds
        self._period_changed.set()

    def _call_and_log_errors(self, publish: Callable[[], None]) -> None:
        """Call a function that publishes; log its errors."""
        try:
            publish()
        except SmartCamError as exc:
            logger.warning("%s ! its status was not published: %s", self._node.full_name, exc)
        except ENDS_PROGRAM:
            raise
        except BaseException:
            logger.exception("%s ! its status was not published", self._node.full_name)

    def _header(self) -> dict[str, Any]:
        return header_fields(datetime.now(UTC), self._frame_id)

    # ------------------------------------------------------------------ the status

    async def _publish_changes(self) -> None:
        """Publish the status after each change; if changes come too fast, only the last status."""
        loop = asyncio.get_running_loop()
        with contextlib.suppress(SmartCamError):  # the camera has failed, and the status says why
            async for event in self._events:
                self._note_event(event)
                await asyncio.sleep(self._next_status_at - loop.time())
                self._call_and_log_errors(self._publish_if_new)
        await asyncio.sleep(self._next_status_at - loop.time())
        self._call_and_log_errors(self._publish_if_new)

    def _note_event(self, event: object) -> None:
        if isinstance(event, (Connected, Reconnected)):
            self._connected_at = event.at
        elif isinstance(event, Disconnected):
            self._connected_at = None

    def _publish_if_new(self) -> None:
        fields = status_fields(KnownState.of(self._camera))
        if fields == self._published:
            return
        self._next_status_at = asyncio.get_running_loop().time() + self._min_interval
        self._status.publish({"header": self._header(), **fields})
        self._published = fields
        for on_change in tuple(self._listeners):
            self._call_and_log_errors(on_change)

    # ------------------------------------------------------------------ diagnostics

    async def _publish_diagnostics(self) -> None:
        """Publish diagnostics periodically; periods that have passed already are left out."""
        loop = asyncio.get_running_loop()
        next_at = loop.time()
        while True:
            if getattr(self._diagnostics, "has_subscribers", True):
                self._call_and_log_errors(self._publish_diagnosis)
            if loop.time() >= self._next_status_at:
                # without a session, the reason for that changes without an event
                self._call_and_log_errors(self._publish_if_new)
            delay = max(0.0, loop.time() - next_at)
            next_at += self.period * (1 + delay // self.period)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout_at(next_at):
                    await self._period_changed.wait()
                self._period_changed.clear()
                next_at = loop.time()

    def _publish_diagnosis(self) -> None:
        self._diagnostics.publish({"header": self._header(), "status": [self.diagnosis()]})

    def diagnosis(self) -> dict[str, Any]:
        """Return the fields of ``diagnostic_msgs/msg/DiagnosticStatus``."""
        statistics = self._camera.statistics()
        counts = {name: int(getattr(statistics, name)) for name in COUNTERS}
        streams = [stream for stream in statistics.subscribers if stream.name == "results"]
        counts["dropped"] = sum(stream.dropped for stream in streams)
        state = KnownState.of(self._camera)
        camera_health = health(state, session_alive=self._is_session_alive(statistics))
        last_counts, self._last_counts = self._last_counts, counts
        risen = [
            name for name in WARNING_COUNTERS if counts[name] > last_counts.get(name, counts[name])
        ]
        if camera_health.level == OK and risen:
            camera_health = Health(WARN, WARNING_COUNTERS[risen[0]])
        values = [*self._values(state, camera_health, statistics), *counts.items()]
        return diagnostic_fields(
            self._node.full_name,
            self._hardware_id(),
            camera_health.level,
            camera_health.text,
            values,
        )

    def _hardware_id(self) -> str:
        options = self._options
        address = options.settings.address if options.settings is not None else None
        return options.hardware_id or hardware_id(address or address_of(self._camera))

    def _is_session_alive(self, statistics: Statistics) -> bool:
        """Return True if the agent is alive; without an agent: if a connection was tried."""
        if self._options.is_agent_alive is not None:
            return self._options.is_agent_alive()
        return bool(statistics.sessions or statistics.last_error)

    def _values(
        self, state: KnownState, camera_health: Health, statistics: Statistics
    ) -> Iterator[tuple[str, Any]]:
        yield "life_cycle", self._state()
        yield "connected_since", self._connected_at.isoformat() if self._connected_at else ""
        yield "status", " ".join(state.bits.names)
        yield "errors", " ".join(camera_health.errors)
        yield "application", "" if state.application is None else state.application
        yield "last_error", (statistics.last_error or "")[:MAX_ERROR_CHARACTERS]
        for name in TIMES:
            times = getattr(statistics, name)
            yield f"{name}_mean", f"{times.total / times.count:.6f}" if times.count else ""
