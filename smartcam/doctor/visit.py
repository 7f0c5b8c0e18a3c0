"""One examination: what was asked for, the camera, and what was seen of it so far."""

from __future__ import annotations

import asyncio
from collections import deque
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from smartcam.client import SmartCamera, connect
from smartcam.doctor.findings import Exit, Finding, Severity
from smartcam.exceptions import InterpretationError
from smartcam.models import CameraEvent, Result, Status, StatusChanged
from smartcam.observers import Observer

if TYPE_CHECKING:
    from collections.abc import Callable
    from datetime import datetime

    from smartcam.connection import TraceEntry
    from smartcam.exceptions import SmartCamError
    from smartcam.interpreters.base import Interpreter
    from smartcam.settings import Address

__all__ = ["Plan", "Visit", "Witness"]

MAX_KEPT = 1000
"""Statuses and arrival times kept: at 300 results a second those of the default 3 seconds."""

MAX_CONTAINERS = 100
"""Result containers kept, to be compared with the layout."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What was asked for.

    Attributes:
        application: id that is expected to be active, None for any.
        interpreter: how results are to be read, None where nothing was said.
        y_down: the camera's y axis points down.
        trigger: triggers may be sent, and ``application`` may be loaded for them.
        timeout: seconds for each step, None for the defaults.
        seconds: how long the camera is watched.
        count: triggers.
    """

    application: int | None = None
    interpreter: Interpreter | None = None
    y_down: bool = False
    trigger: bool = False
    timeout: float | None = None
    seconds: float = 3.0
    count: int = 10

    def step(self, default: float) -> float:
        """Return the bound of a step, seconds."""
        return default if self.timeout is None else self.timeout


class Witness(Observer):
    """Sees what the camera sends and keeps the last of it.

    Args:
        trace: called with every frame.

    Attributes:
        statuses: those that differ from the one before.
        arrivals: loop times of results.
        containers: the last results, as raw bytes.
        endian: the last status's endian field.
        unreadable: the first result that could not even be taken as bytes: an endian field that
            is neither little nor big.
    """

    def __init__(self, trace: Callable[[TraceEntry], None] | None) -> None:
        self.statuses: deque[Status] = deque(maxlen=MAX_KEPT)
        self.arrivals: deque[float] = deque(maxlen=MAX_KEPT)
        self.containers: deque[Result] = deque(maxlen=MAX_CONTAINERS)
        self.endian = 0
        self.unreadable: InterpretationError | None = None
        self._trace = trace

    def on_frame(self, entry: TraceEntry) -> None:
        """Hand it on; note the byte order."""
        fields = entry.fields or {}
        self.endian = int(fields.get("endian", self.endian))
        if self._trace is not None:
            self._trace(entry)

    def on_state(self, event: CameraEvent) -> None:
        """Keep a status."""
        if isinstance(event, StatusChanged):
            self.statuses.append(event.status)

    def on_result(self, result: Result) -> None:
        """Keep a result."""
        self.arrivals.append(asyncio.get_running_loop().time())
        self.containers.append(result)

    def on_error(self, camera: str, error: SmartCamError, triggered_at: datetime | None) -> None:
        """Keep the first result that could not even be taken as bytes."""
        if isinstance(error, InterpretationError):
            self.arrivals.append(asyncio.get_running_loop().time())
            self.unreadable = self.unreadable or error


@dataclass(slots=True)
class Visit:
    """An examination under way.

    Attributes:
        plan: what was asked for.
        address: where the camera is; what was found out is pinned.
        trace: called with every frame.
        witness: sees what it sends.
        stack: what is undone at the end.
        borrowed: an application that is loaded for the triggers, and goes back.
        camera: the client, None before the session.
        connected_at: loop time of the session.
        wants_trigger: whether triggers are still wanted.
        may_trigger: whether the camera waits for them.
        pending: findings that were not handed out yet.
    """

    plan: Plan
    address: Address
    trace: Callable[[TraceEntry], None] | None
    witness: Witness
    stack: AsyncExitStack = field(default_factory=AsyncExitStack)
    borrowed: AsyncExitStack = field(default_factory=AsyncExitStack)
    camera: SmartCamera | None = None
    connected_at: float = 0.0
    wants_trigger: bool = False
    may_trigger: bool = False
    pending: list[Finding] = field(default_factory=list[Finding])

    def say(
        self,
        check: str,
        severity: Severity,
        text: str,
        cure: str = "",
        *,
        exit_code: Exit = Exit.DONE,
        **details: Any,
    ) -> None:
        """Report a finding; arguments as :class:`~smartcam.doctor.Finding` has them."""
        self.pending.append(
            Finding(
                check=check,
                severity=severity,
                text=text,
                cure=cure,
                details=details,
                exit_code=exit_code,
            )
        )

    def take(self) -> list[Finding]:
        """Return the findings since the last call."""
        taken, self.pending = self.pending, []
        return taken

    @property
    def patient(self) -> SmartCamera:
        """The camera in a session.

        Raises:
            LookupError: there is none; checks that use it come behind the one that connects.
        """
        if self.camera is None:
            raise LookupError("there is no session")
        return self.camera

    @property
    def host_and_port(self) -> str:
        """Where the camera is, for texts."""
        host = f"[{self.address.host}]" if ":" in self.address.host else self.address.host
        return f"{host}:{self.address.port}"

    def make_camera(self) -> SmartCamera:
        """Return a client that takes the camera once and never takes it back."""
        plan = self.plan
        camera = connect(
            self.address.url,
            observers=[self.witness],
            reconnect=None,
            connect_timeout=plan.step(10.0),
            request_timeout=plan.step(5.0),
            switch_timeout=plan.step(10.0),
        )
        self.stack.push_async_callback(camera.close)
        return camera
