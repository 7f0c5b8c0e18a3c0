"""What a camera's node says of the camera: its status, latched, and diagnostics."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.exceptions import RosError, SmartCamError
from smartcam.models import Connected, Disconnected, Reconnected, Statistics, Status
from smartcam.ros2._qos import DEFAULT, LATCHED

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from smartcam.camera import Camera
    from smartcam.ros2._camera_node import CameraNodeOptions

logger: logging.Logger = logging.getLogger("smartcam.ros2")

STATUS_TYPE = "smartcam_msgs/msg/CameraStatus"
DIAGNOSTICS = "/diagnostics"

MOST_EVENTS = 64
"""Events that wait; what counts is the state after them."""

LONGEST_TEXT = 1000
"""Characters of an error's text."""

OK, WARN, ERROR, STALE = range(4)
"""``diagnostic_msgs/msg/DiagnosticStatus``"""

TROUBLES = {
    Status.SYSTEM_ERROR: (ERROR, "System Error: the camera needs a reboot at least"),
    Status.OVERHEAT: (WARN, "Overheat: the camera is too hot, inspections may get worse"),
    Status.INPUT_CONTAINER: (WARN, "Input Container: input data and inspections are out of step"),
    Status.OVERTRIGGERED: (WARN, "Overtriggered: a trigger was dropped"),
}
"""Bits of the status that are errors: how bad, and in words."""

COUNTERS = tuple(one.name for one in dataclasses.fields(Statistics) if one.type in {"int", int})


class Health(NamedTuple):
    """How a camera is: a level of diagnostics, why, and which error bits are set."""

    level: int
    text: str
    errors: tuple[str, ...] = ()


def health(camera: Camera[Any], *, heard: bool) -> Health:
    """Return how a camera is.

    Args:
        camera: it.
        heard: there is a sign of who has the session with it.
    """
    if not camera.connected:
        why = trouble(camera)
        if not heard:
            return Health(STALE, why or "nothing has been heard of it yet")
        return Health(ERROR, why or "not connected")
    status = camera.status
    found = [(bit.name or "", *TROUBLES[bit]) for bit in TROUBLES if bit in status]
    errors = tuple(name for name, _, _ in found)
    if found:
        return Health(max(level for _, level, _ in found), found[0][2], errors)
    if Status.BUSY in status and Status.RUNNING not in status:
        return Health(OK, "an application is being loaded")
    if Status.RUNNING not in status:
        return Health(WARN, "stopped: the camera is not in run mode")
    return Health(OK, "busy" if Status.BUSY in status else "ready")


def trouble(camera: Camera[Any]) -> str:
    """Return why there is no session; empty where nobody knows."""
    try:
        camera._require_session()  # noqa: SLF001 - it is what knows the reason, of either kind
    except SmartCamError as exc:
        return str(exc)[:LONGEST_TEXT]
    return ""


def status_fields(camera: Camera[Any]) -> dict[str, Any]:
    """Return the fields of ``smartcam_msgs/msg/CameraStatus`` but for its header."""
    connected = camera.connected
    status = camera.status if connected else Status(0)
    how = health(camera, heard=True)
    bad = Status.BUSY in status or Status.SYSTEM_ERROR in status
    return {
        "camera_name": camera.name,
        "connected": connected,
        "ready": connected and Status.RUNNING in status and not bad,
        "busy": Status.BUSY in status,
        "running": Status.RUNNING in status,
        "application_id": (camera.active_application or 0) if connected else 0,
        "status": status.value,
        "status_names": status.names,
        "error": how.text if how.errors or not connected else "",
    }


class CameraStatus:
    """Publishes a camera's status when it changes, and its diagnostics again and again.

    Args:
        camera: it.
        node: of ROS 2 or 1.
        options: of the camera's node.
        state: the state of the life cycle.

    Attributes:
        period: seconds between two diagnostics.
    """

    def __init__(
        self,
        camera: Camera[Any],
        node: Any,
        options: CameraNodeOptions,
        state: Callable[[], str],
    ) -> None:
        self._camera, self._node, self._options, self._state = camera, node, options, state
        self.period: float = options.diagnostics_period
        self._frame_id = options.frame_id or camera.name
        self._least = 1.0 / options.status_rate
        self._said: dict[str, Any] | None = None
        self._said_at = -1e9  # loop time
        self._since: datetime | None = None
        self._dropped = 0
        self._events: Any = None
        self._tasks: list[asyncio.Task[None]] = []
        self._ends: list[Any] = []

    def start(self) -> None:
        """Say how the camera is, and go on doing so."""
        self._status = self._node.publisher("~/status", STATUS_TYPE, qos=LATCHED)
        self._ends.append(self._status)
        kind = "diagnostic_msgs/msg/DiagnosticArray"
        self._diagnostics = self._node.publisher(DIAGNOSTICS, kind, qos=DEFAULT)
        self._ends.append(self._diagnostics)
        self._events = self._camera.events(max_queue=MOST_EVENTS)
        if self._camera.connected:
            self._since = datetime.now(UTC)
        self._say_if_new()
        loop = asyncio.get_running_loop()
        self._tasks = [loop.create_task(self._follow()), loop.create_task(self._repeat())]

    async def close(self) -> None:
        """Say nothing more. Idempotent."""
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

    # ------------------------------------------------------------------ the status

    async def _follow(self) -> None:
        """Say each change, those that come fast only as they have left it."""
        loop = asyncio.get_running_loop()
        try:
            async for event in self._events:
                self._note(event)
                await asyncio.sleep(self._said_at + self._least - loop.time())
                self._say_if_new()
        except SmartCamError:
            pass  # it will not be connected again, and the status says why
        await asyncio.sleep(self._said_at + self._least - loop.time())
        self._say_if_new()

    def _note(self, event: object) -> None:
        if isinstance(event, (Connected, Reconnected)):
            self._since = event.at
        elif isinstance(event, Disconnected):
            self._since = None

    def _say_if_new(self) -> None:
        fields = status_fields(self._camera)
        if fields == self._said:
            return
        self._said, self._said_at = fields, asyncio.get_running_loop().time()
        try:
            self._status.publish({"header": self._header(), **fields})
        except RosError as exc:
            logger.warning("%s ! its status was not said: %s", self._node.full_name, exc)

    def _header(self) -> dict[str, Any]:
        seconds, rest = divmod(time.time_ns(), 10**9)
        return {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": self._frame_id}

    # ------------------------------------------------------------------ diagnostics

    async def _repeat(self) -> None:
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            self._diagnose()
            if loop.time() >= self._said_at + self._least:
                self._say_if_new()  # why it is not there changes without an event
            due = max(due + self.period, loop.time())
            await asyncio.sleep(due - loop.time())

    def _diagnose(self) -> None:
        if not getattr(self._diagnostics, "heard", True):
            return
        try:
            self._diagnostics.publish({"header": self._header(), "status": [self.diagnosis()]})
        except RosError as exc:
            logger.warning("%s ! its diagnostics were not said: %s", self._node.full_name, exc)

    def diagnosis(self) -> dict[str, Any]:
        """Return the fields of ``diagnostic_msgs/msg/DiagnosticStatus``."""
        how = health(self._camera, heard=self._heard())
        address = (self._options.settings or self._camera.settings).address
        return {
            "level": how.level,
            "name": f"{self._node.full_name.lstrip('/')}: camera",
            "message": how.text,
            "hardware_id": self._options.hardware_id or f"{address.host}:{address.port}",
            "values": [{"key": key, "value": value} for key, value in self._values(how)],
        }

    def _heard(self) -> bool:
        if self._options.heard is not None:
            return self._options.heard()
        counted = self._camera.statistics()
        return bool(counted.sessions or counted.last_error)

    def _values(self, how: Health) -> Iterator[tuple[str, str]]:
        camera = self._camera
        connected = camera.connected
        application = camera.active_application if connected else None
        counted = camera.statistics()
        yield "life cycle", self._state()
        yield "connected since", self._since.isoformat() if self._since else ""
        yield "status", " ".join(camera.status.names) if connected else ""
        yield "errors", " ".join(how.errors)
        yield "application", "" if application is None else str(application)
        for name in COUNTERS:
            yield name.replace("_", " "), str(getattr(counted, name))
        yield "dropped", str(sum(one.dropped for one in counted.subscribers))
        yield "last error", counted.last_error or ""
        for name in ("round_trip", "processing"):
            times = getattr(counted, name)
            mean = f"{times.total / times.count:.6f}" if times.count else ""
            yield f"{name.replace('_', ' ')} mean", mean
