"""The state of one examination of a camera, which its checks share: options, camera, findings."""

from __future__ import annotations

import asyncio
from collections import deque
from contextlib import AsyncExitStack
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

from smartcam.client import SmartCamera
from smartcam.connecting import connect
from smartcam.doctor._findings import Exit, Finding, Severity
from smartcam.exceptions import InterpretationError
from smartcam.interpreters import Interpreter, Reader, run
from smartcam.layout import Layout
from smartcam.models import CameraEvent, Result, Status, StatusChanged
from smartcam.observers import Observer
from smartcam.settings import CameraSettings, is_fleet, parse_address

if TYPE_CHECKING:
    from collections.abc import Callable
    from datetime import datetime

    from smartcam.camera import Camera
    from smartcam.exceptions import SmartCamError
    from smartcam.fleet._inside import Bus
    from smartcam.models import ByteOrder
    from smartcam.observers import TraceEntry
    from smartcam.settings import Address, CameraOptions

T = TypeVar("T")

MAX_OBSERVED = 1000
"""Largest number of statuses and arrival times kept: 300 results per second for 3 seconds."""

MAX_CONTAINERS = 32
"""Number of result containers kept for the comparison with the layout: 2 MB of the largest."""


def application_text(application: int | None) -> str:
    """Return the application's name in texts; some cameras have applications without ids."""
    return (
        "the application"
        if application is None or application < 0
        else f"application {application}"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class DoctorOptions:
    """The options of an examination.

    Attributes:
        application: id that is expected to be active, None for any.
        interpreter: interpretation of the results; None if none was given.
        y_down: whether the camera's y axis points down.
        trigger: whether triggers may be sent, and ``application`` loaded for them.
        timeout: seconds for each step, None for the defaults.
        seconds: time for which the camera is watched.
        count: number of triggers.
    """

    application: int | None = None
    interpreter: Interpreter | None = None
    y_down: bool = False
    trigger: bool = False
    timeout: float | None = None
    seconds: float = 3.0
    count: int = 10

    def step_timeout(self, default: float) -> float:
        """Return the timeout of a step, in seconds."""
        return default if self.timeout is None else self.timeout


class CameraRecorder(Observer):
    """An observer of the camera's messages that keeps the last statuses, times and results.

    Attributes:
        statuses: the last statuses, each different from the status before.
        result_count: number of results since ``forget_arrivals``.
        arrival_times: loop times at which the last results arrived, in seconds.
        last_results: the last results; their values are of :class:`Reading` if an interpreter was
            given.
        read_error: reason why the first result could not be given to an interpreter: an endian
            field that is neither little nor big, or cells that do not fit the layout.
    """

    def __init__(self) -> None:
        self.statuses: deque[Status] = deque(maxlen=MAX_OBSERVED)
        self.arrival_times: deque[float] = deque(maxlen=MAX_OBSERVED)
        self.last_results: deque[Result] = deque(maxlen=MAX_CONTAINERS)
        self.result_count: int = 0
        self.read_error: InterpretationError | None = None

    def on_state(self, event: CameraEvent) -> None:
        """Keep a status."""
        if isinstance(event, StatusChanged):
            self.statuses.append(event.status)

    def on_result(self, result: Result) -> None:
        """Keep a result."""
        self._count_arrival()
        self.last_results.append(result)

    def on_error(self, camera: str, error: SmartCamError, triggered_at: datetime | None) -> None:
        """Keep the reason why a result could not be given to an interpreter."""
        if isinstance(error, InterpretationError):
            self._count_arrival()
            self.read_error = self.read_error or error

    def forget_arrivals(self) -> None:
        """Count results from 0 again."""
        self.result_count = 0
        self.arrival_times.clear()

    def _count_arrival(self) -> None:
        self.result_count += 1
        self.arrival_times.append(asyncio.get_running_loop().time())


class Diagnosis(NamedTuple, Generic[T]):
    """One of several possible causes; the first that fits is reported."""

    fits: Callable[[T], bool]  # function that decides from observations whether it fits
    text: str  # text of the finding, with fields to fill in
    cure: str  # text of the cure, also with fields
    exit_code: Exit = Exit.NO_SESSION  # exit code of the finding


@dataclass(eq=False)
class FrameObserver(Observer):
    """Gives every frame to a function."""

    _trace: Callable[[TraceEntry], None]

    def on_frame(self, entry: TraceEntry) -> None:
        """Pass the frame on."""
        self._trace(entry)


class Reading(NamedTuple):
    """A result container's bytes, and the error of an interpreter."""

    data: bytes
    byte_order: ByteOrder  # byte order of their numbers
    error: InterpretationError | None  # reason why they do not fit, None if they do


class ReadingInterpreter(Interpreter):
    """Runs another interpreter and always returns a :class:`Reading`, even after an error.

    A sequence number in the layout is read as an ordinary field: a client would otherwise set the
    camera's next number.

    Args:
        inner: the other interpreter.
    """

    def __init__(self, inner: Interpreter) -> None:
        layout = inner.layout
        if layout is not None and layout.sequence_field is not None:
            layout = Layout(layout.text.replace("@sequence", ""), lenient=layout.lenient)
        super().__init__(layout)
        self.inner: Interpreter = inner

    def interpret(self, reader: Reader) -> Reading:
        """Return the bytes, and the error if they do not fit."""
        order = reader.context.byte_order
        try:
            run(self.inner, Reader(reader.data, reader.context, self.inner.layout))
        except InterpretationError as exc:
            return Reading(reader.data, order, exc)
        return Reading(reader.data, order, None)


@dataclass(slots=True)
class Examination:
    """A running examination."""

    options: DoctorOptions  # options from the user
    address: Address  # address of the camera; with the dialect once it is known
    trace: Callable[[TraceEntry], None] | None  # called with every frame
    recorder: CameraRecorder  # observer of the camera's messages
    # closes the session and the bus at the end
    cleanup: AsyncExitStack = field(default_factory=AsyncExitStack)
    # loads again the application that was active before the triggers
    application_cleanup: AsyncExitStack = field(default_factory=AsyncExitStack)
    bus: Bus | None = None  # bus of a fleet; None before it answered
    camera: Camera | None = None  # the client, None before the session
    connected_at: float = 0.0  # loop time at which the session began
    wants_trigger: bool = False  # whether triggers are still wanted
    may_trigger: bool = False  # whether the camera waits for triggers, by the check of its state
    check: str = ""  # name of the check that runs
    # findings that were not handed out yet
    pending_findings: list[Finding] = field(default_factory=list[Finding])

    def report(
        self,
        severity: Severity,
        text: str,
        cure: str = "",
        *,
        exit_code: Exit = Exit.DONE,
        check: str = "",
        **details: Any,
    ) -> None:
        """Report a finding of the present check; arguments as ``Finding``."""
        self.pending_findings.append(
            Finding(
                check=check or self.check,
                severity=severity,
                text=text,
                cure=cure,
                details=details,
                exit_code=exit_code,
            )
        )

    def fail(
        self, text: str, cure: str = "", *, exit_code: Exit = Exit.NO_SESSION, **details: Any
    ) -> None:
        """Report an error."""
        self.report("error", text, cure, exit_code=exit_code, **details)

    def take_findings(self) -> list[Finding]:
        """Return the findings since the last call."""
        taken, self.pending_findings = self.pending_findings, []
        return taken

    @property
    def connected_camera(self) -> Camera:
        """The camera in a session.

        LookupError: there is no session; checks that use the camera run after the connecting one.
        """
        if self.camera is None:
            raise LookupError("there is no session")
        return self.camera

    @property
    def host_and_port(self) -> str:
        """Address of the camera, for texts."""
        host = f"[{self.address.host}]" if ":" in self.address.host else self.address.host
        return f"{host}:{self.address.port}"

    def use_url(self, url: str) -> None:
        """Use protocol, transport and dialect of a URL; a login, which no URL shows, stays."""
        address = parse_address(url)
        if address.protocol != self.address.protocol:
            self.address = address
        self.address = self.address._replace(
            scheme=address.scheme, dialect=address.dialect, quirks=address.quirks
        )

    def make_camera(self) -> Camera:
        """Return a client that connects once and never takes the camera back from another client.

        Raises ConfigurationError: a timeout is not valid.
        """
        exam_options = self.options
        options: CameraOptions = {
            "reconnect": None,
            "connect_timeout": exam_options.step_timeout(10.0),
            "request_timeout": exam_options.step_timeout(5.0),
            "switch_timeout": exam_options.step_timeout(10.0),
        }
        if exam_options.y_down or not self.in_fleet:  # an agent may know y_down
            options["y_down"] = exam_options.y_down
        if exam_options.interpreter is not None:
            options["interpret_as"] = ReadingInterpreter(exam_options.interpreter)
        frame_observers = [FrameObserver(self.trace)] if self.trace is not None else []
        observers = [self.recorder, *frame_observers]
        camera: Camera
        if self.in_fleet:
            camera = connect(self.address.url, observers=observers, **options)
        else:
            settings = CameraSettings.make(self.address.url, None, options)
            settings = replace(settings, address=self.address)
            camera = SmartCamera(settings, observers=observers)
        self.cleanup.push_async_callback(camera.close)
        return camera

    @property
    def in_fleet(self) -> bool:
        """True if an agent has the session with the camera."""
        return is_fleet(self.address.url)
