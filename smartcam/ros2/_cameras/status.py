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
from smartcam.ros2._cameras.reading import place_of
from smartcam.ros2._node.qos import DEFAULT, LATCHED

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from smartcam.camera import Camera
    from smartcam.ros2._cameras.options import CameraNodeOptions

logger: logging.Logger = logging.getLogger("smartcam.ros2")

MAX_WAITING_EVENTS = 64
"""Largest number of events that wait; only the state after them is published."""

RISING: Mapping[str, str] = {
    "dropped": "results were dropped: a subscriber is too slow",
    "uninterpretable": "results do not fit their layout",
    "wrong_application": "results came from another application than expected",
    "overtriggers": "triggers were dropped: they come too fast",
    "late": "results came after their triggers had given up",
}
"""Counters that are a warning if they have risen since the last diagnostics."""

COUNTERS = tuple(
    field.name for field in dataclasses.fields(Statistics) if field.type in {"int", int}
)
MEANS = ("round_trip", "processing")


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
        self._least = 1.0 / options.status_rate
        self._published: dict[str, Any] | None = None
        self._due = -math.inf  # loop time of the next status
        self._since: datetime | None = None
        self._before: dict[str, int] = {}  # counters at the last diagnostics
        self._woken = asyncio.Event()
        self._listeners: list[Callable[[], None]] = []
        self._events: Any = None
        self._tasks: list[asyncio.Task[None]] = []
        self._ends: list[Any] = []

    def start(self) -> None:
        """Publish the camera's status and diagnostics, now and from now on."""
        self._status = self._node.publisher("~/status", STATUS_TYPE, qos=LATCHED)
        self._ends.append(self._status)
        self._diagnostics = self._node.publisher("/diagnostics", DIAGNOSTICS, qos=DEFAULT)
        self._ends.append(self._diagnostics)
        self._events = self._camera.events(max_queue=MAX_WAITING_EVENTS)
        if self._camera.connected:
            self._since = datetime.now(UTC)
        self._guarded(self._publish_if_new)
        loop = asyncio.get_running_loop()
        self._tasks = [loop.create_task(self._follow()), loop.create_task(self._repeat())]

    async def close(self) -> None:
        """Stop publishing. Idempotent."""
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.cancel()
        if self._events is not None:
            self._events.close()
        ends, self._ends = self._ends, []
        for end in ends:
            end.close()
        if tasks:
            await asyncio.wait(tasks)

    def listen(self, on_change: Callable[[], None]) -> Callable[[], None]:
        """Call ``on_change`` at each change of the status; return a function that ends that."""
        self._listeners.append(on_change)
        return lambda: self._listeners.remove(on_change) if on_change in self._listeners else None

    def set_period(self, seconds: float) -> None:
        """Publish diagnostics in this period from now on."""
        self.period = seconds
        self._woken.set()

    def _guarded(self, publish: Callable[[], None]) -> None:
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

    async def _follow(self) -> None:
        """Publish each change; of changes that come too fast only the last state."""
        loop = asyncio.get_running_loop()
        with contextlib.suppress(SmartCamError):  # the camera has failed, and the status says why
            async for event in self._events:
                self._note(event)
                await asyncio.sleep(self._due - loop.time())
                self._guarded(self._publish_if_new)
        await asyncio.sleep(self._due - loop.time())
        self._guarded(self._publish_if_new)

    def _note(self, event: object) -> None:
        if isinstance(event, (Connected, Reconnected)):
            self._since = event.at
        elif isinstance(event, Disconnected):
            self._since = None

    def _publish_if_new(self) -> None:
        fields = status_fields(KnownState.of(self._camera))
        if fields == self._published:
            return
        self._due = asyncio.get_running_loop().time() + self._least
        self._status.publish({"header": self._header(), **fields})
        self._published = fields
        for on_change in tuple(self._listeners):
            self._guarded(on_change)

    # ------------------------------------------------------------------ diagnostics

    async def _repeat(self) -> None:
        """Publish diagnostics periodically; missed ones are left out."""
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            if getattr(self._diagnostics, "has_subscribers", True):
                self._guarded(self._diagnose)
            if loop.time() >= self._due:
                self._guarded(self._publish_if_new)  # the reason of a loss changes without an event
            missed = max(0.0, loop.time() - due)
            due += self.period * (1 + missed // self.period)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout_at(due):
                    await self._woken.wait()
                self._woken.clear()
                due = loop.time()

    def _diagnose(self) -> None:
        self._diagnostics.publish({"header": self._header(), "status": [self.diagnosis()]})

    def diagnosis(self) -> dict[str, Any]:
        """Return the fields of ``diagnostic_msgs/msg/DiagnosticStatus``."""
        counted = self._camera.statistics()
        counts = {name: int(getattr(counted, name)) for name in COUNTERS}
        streams = [stream for stream in counted.subscribers if stream.name == "results"]
        counts["dropped"] = sum(stream.dropped for stream in streams)
        known = KnownState.of(self._camera)
        how = health(known, session_alive=self._is_session_alive(counted))
        before, self._before = self._before, counts
        rose = [name for name in RISING if counts[name] > before.get(name, counts[name])]
        if how.level == OK and rose:
            how = Health(WARN, RISING[rose[0]])
        values = [*self._values(known, how, counted), *counts.items()]
        return diagnostic_fields(
            self._node.full_name, self._hardware_id(), how.level, how.text, values
        )

    def _hardware_id(self) -> str:
        options = self._options
        address = options.settings.address if options.settings is not None else None
        return options.hardware_id or hardware_id(address or place_of(self._camera))

    def _is_session_alive(self, counted: Statistics) -> bool:
        """Return True if the program that has the session is alive, or was."""
        if self._options.is_agent_alive is not None:
            return self._options.is_agent_alive()
        return bool(counted.sessions or counted.last_error)

    def _values(
        self, known: KnownState, how: Health, counted: Statistics
    ) -> Iterator[tuple[str, Any]]:
        yield "life_cycle", self._state()
        yield "connected_since", self._since.isoformat() if self._since else ""
        yield "status", " ".join(known.bits.names)
        yield "errors", " ".join(how.errors)
        yield "application", "" if known.application is None else known.application
        yield "last_error", (counted.last_error or "")[:MAX_ERROR_CHARACTERS]
        for name in MEANS:
            times = getattr(counted, name)
            yield f"{name}_mean", f"{times.total / times.count:.6f}" if times.count else ""
