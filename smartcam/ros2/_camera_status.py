"""What a camera's node says of the camera: its status, latched, and diagnostics."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
import math
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.exceptions import SmartCamError
from smartcam.models import Connected, Disconnected, Reconnected, Statistics, Status
from smartcam.ros2._qos import DEFAULT, LATCHED

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from smartcam.camera import Camera
    from smartcam.ros2._camera_node import CameraNodeOptions

logger: logging.Logger = logging.getLogger("smartcam.ros2")

STATUS_TYPE = "smartcam_msgs/msg/CameraStatus"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

MOST_EVENTS = 64
"""Events that wait; what counts is the state after them."""

LONGEST_TEXT = 1000
"""Characters of an error's text."""

OK, WARN, ERROR, STALE = range(4)
"""Levels, as ``diagnostic_msgs/msg/DiagnosticStatus`` has them."""

TROUBLES: Mapping[Status, tuple[int, str]] = {
    Status.SYSTEM_ERROR: (ERROR, "System Error: the camera needs a reboot at least"),
    Status.OVERHEAT: (WARN, "Overheat: the camera is too hot, inspections may get worse"),
    Status.INPUT_CONTAINER: (WARN, "Input Container: input data and inspections are out of step"),
    Status.OVERTRIGGERED: (WARN, "Overtriggered: a trigger was dropped"),
}
"""Bits of the status that are errors, the worst first: how bad, and in words."""

RISING: Mapping[str, str] = {
    "dropped": "results were dropped: who reads them is too slow",
    "uninterpretable": "results do not fit their layout",
    "wrong_application": "results came from another application than expected",
    "overtriggers": "triggers were dropped: they come too fast",
    "late": "results came after their triggers had given up",
}
"""Counters that are a warning where they have risen since the last diagnostics."""

COUNTERS = tuple(one.name for one in dataclasses.fields(Statistics) if one.type in {"int", int})
MEANS = ("round_trip", "processing")


class Health(NamedTuple):
    """How a camera is: a level of diagnostics, why, and which error bits are set."""

    level: int
    text: str
    errors: tuple[str, ...] = ()


def health(camera: Camera[Any], *, heard: bool = True) -> Health:
    """Return how a camera is.

    Args:
        camera: it.
        heard: there is a sign of who has the session with it.
    """
    if not camera.connected:
        why = trouble(camera)
        if not heard:
            return Health(STALE, why or "nothing has been heard of it")
        return Health(ERROR, why or "not connected")
    status = status_of(camera)
    found = [bit for bit in TROUBLES if bit in status]
    if found:
        errors = tuple(bit.name or "" for bit in found)
        return Health(TROUBLES[found[0]][0], TROUBLES[found[0]][1], errors)
    if status.loading:
        return Health(OK, "an application is being loaded")
    if Status.RUNNING not in status:
        return Health(WARN, "stopped: the camera is not in run mode")
    return Health(OK, "busy" if Status.BUSY in status else "ready")


def status_of(camera: Camera[Any]) -> Status:
    """Return the status of the present session; no bit where there is none, or none was told."""
    try:
        return camera.status if camera.connected else Status(0)
    except SmartCamError:
        return Status(0)


def trouble(camera: Camera[Any]) -> str:
    """Return why there is no session; empty where nobody knows."""
    try:
        camera._require_session()  # noqa: SLF001 - it is what knows the reason, of every kind
    except SmartCamError as exc:
        return str(exc)[:LONGEST_TEXT]
    return ""


def status_fields(camera: Camera[Any]) -> dict[str, Any]:
    """Return the fields of ``smartcam_msgs/msg/CameraStatus`` but for its header."""
    connected, status, how = camera.connected, status_of(camera), health(camera)
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
        self._due = -math.inf  # loop time of the next status
        self._since: datetime | None = None
        self._before: dict[str, int] = {}  # counters, when the last diagnostics were said
        self._woken = asyncio.Event()
        self._heard: list[Callable[[], None]] = []
        self._events: Any = None
        self._tasks: list[asyncio.Task[None]] = []
        self._ends: list[Any] = []

    def start(self) -> None:
        """Say how the camera is, and go on doing so."""
        self._status = self._node.publisher("~/status", STATUS_TYPE, qos=LATCHED)
        self._ends.append(self._status)
        self._diagnostics = self._node.publisher("/diagnostics", DIAGNOSTICS, qos=DEFAULT)
        self._ends.append(self._diagnostics)
        self._events = self._camera.events(max_queue=MOST_EVENTS)
        if self._camera.connected:
            self._since = datetime.now(UTC)
        self._guarded(self._say_if_new)
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

    def listen(self, heard: Callable[[], None]) -> Callable[[], None]:
        """Have ``heard`` called when a status is said that differs; return what ends that."""
        self._heard.append(heard)
        return lambda: self._heard.remove(heard) if heard in self._heard else None

    def set_period(self, seconds: float) -> None:
        """Say diagnostics in this period from now on."""
        self.period = seconds
        self._woken.set()

    def _guarded(self, say: Callable[[], None]) -> None:
        """Say something; that it cannot be said now does not end what says it."""
        try:
            say()
        except SmartCamError as exc:
            logger.warning("%s ! it was not said: %s", self._node.full_name, exc)
        except Exception:
            logger.exception("%s ! it was not said", self._node.full_name)

    def _header(self) -> dict[str, Any]:
        seconds, rest = divmod(time.time_ns(), 10**9)
        return {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": self._frame_id}

    # ------------------------------------------------------------------ the status

    async def _follow(self) -> None:
        """Say each change; of those that come too fast what they have left."""
        loop = asyncio.get_running_loop()
        with contextlib.suppress(SmartCamError):  # it ended for good, and the status says why
            async for event in self._events:
                self._note(event)
                await asyncio.sleep(self._due - loop.time())
                self._guarded(self._say_if_new)
        await asyncio.sleep(self._due - loop.time())
        self._guarded(self._say_if_new)

    def _note(self, event: object) -> None:
        if isinstance(event, (Connected, Reconnected)):
            self._since = event.at
        elif isinstance(event, Disconnected):
            self._since = None

    def _say_if_new(self) -> None:
        fields = status_fields(self._camera)
        if fields == self._said:
            return
        self._due = asyncio.get_running_loop().time() + self._least
        self._status.publish({"header": self._header(), **fields})
        self._said = fields
        for heard in tuple(self._heard):
            self._guarded(heard)

    # ------------------------------------------------------------------ diagnostics

    async def _repeat(self) -> None:
        """Say diagnostics in their period; what was missed is left out."""
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            if getattr(self._diagnostics, "heard", True):
                self._guarded(self._diagnose)
            if loop.time() >= self._due:
                self._guarded(self._say_if_new)  # why it is away changes without an event
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
        streams = [one for one in counted.subscribers if one.name == "results"]
        counts["dropped"] = sum(one.dropped for one in streams)
        how = health(self._camera, heard=self._is_heard(counted))
        before, self._before = self._before, counts
        rose = [name for name in RISING if counts[name] > before.get(name, counts[name])]
        if how.level == OK and rose:
            how = Health(WARN, RISING[rose[0]])
        values = [*self._values(how, counted), *counts.items()]
        return {
            "level": how.level,
            "name": f"{self._node.full_name.lstrip('/')}: camera",
            "message": how.text,
            "hardware_id": self._options.hardware_id or self._address(),
            "values": [{"key": key.replace("_", " "), "value": str(one)} for key, one in values],
        }

    def _address(self) -> str:
        address = (self._options.settings or self._camera.settings).address
        path = f"/{address.path}" if address.path else ""
        return f"{address.host}:{address.port}{path}"

    def _is_heard(self, counted: Statistics) -> bool:
        """Return whether there is, or was, any sign of who has the session with the camera."""
        if self._options.heard is not None:
            return self._options.heard()
        return bool(counted.sessions or counted.last_error)

    def _values(self, how: Health, counted: Statistics) -> Iterator[tuple[str, Any]]:
        application = self._camera.active_application if self._camera.connected else None
        yield "life_cycle", self._state()
        yield "connected_since", self._since.isoformat() if self._since else ""
        yield "status", " ".join(status_of(self._camera).names)
        yield "errors", " ".join(how.errors)
        yield "application", "" if application is None else application
        yield "last_error", (counted.last_error or "")[:LONGEST_TEXT]
        for name in MEANS:
            times = getattr(counted, name)
            yield f"{name}_mean", f"{times.total / times.count:.6f}" if times.count else ""
