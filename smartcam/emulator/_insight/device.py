"""Model an In-Sight camera: its jobs, its mode and its runs, without sockets and commands.

Its clock is moved by :meth:`InSightDevice.advance_to`. Questions that the public documents leave
open are decided in ``docs/insight.md``.
"""

from __future__ import annotations

import heapq
import itertools
import logging
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from smartcam.emulator._clock import nanoseconds
from smartcam.emulator._insight.image import check_image, grey_pattern
from smartcam.emulator._insight.job import (
    CellValue,
    Control,
    InspectedJob,
    Job,
    cell_text,
    make_job,
)
from smartcam.emulator._inspected import InspectionOrder
from smartcam.exceptions import ConfigurationError
from smartcam.protocols._inside import TRIGGER_EVENT, StatusCode

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from contextlib import AbstractContextManager

    import numpy as np
    from numpy.typing import NDArray

    from smartcam.emulator._generators import Values
    from smartcam.emulator._inspected import Inspector

    OnCode: TypeAlias = Callable[[StatusCode], None]

_log = logging.getLogger("smartcam.emulator")

_MAX_NUMBER = 0xFFFFFFFF  # largest number of a run, as for other cameras


class _PendingEvent:
    """An acquisition with its evaluation, or a soft event."""

    def __init__(self, on_code: OnCode | None) -> None:
        self.is_finished: bool = False
        self._on_code = on_code

    def report(self, code: StatusCode) -> None:
        """Report the outcome of the event; every call after the first does nothing."""
        on_code, self._on_code = self._on_code, None
        if on_code is not None:
            on_code(code)

    def end(self, code: StatusCode) -> None:
        """Finish the event, also after a failure."""
        self.is_finished = True
        self.report(code)


class InSightDevice:
    """Models a camera with jobs and an image.

    Methods for clients' commands return the status code of the answer, or pass it to a callback.

    Its arguments are those of :class:`~smartcam.emulator.EmulatedInSight`.

    Raises:
        ConfigurationError: an argument is wrong.
    """

    def __init__(
        self,
        jobs: Iterable[Job | Mapping[str, Any]] = (),
        *,
        active: str | int | None = None,
        online: bool = False,
        image: Any = None,
    ) -> None:
        # jobs by file name
        self.jobs: Mapping[str, Job] = _by_file([make_job(job) for job in jobs])
        # active job; None for one that was never saved
        self.job: Job | None = next(iter(self.jobs.values()), None)
        # context around an operator's actions; the emulator sets one that sends messages at its end
        self.action_context: Callable[[], AbstractContextManager[object]] = nullcontext
        # function that returns the image of the last run, if an inspector takes the pictures
        self.get_last_image: Callable[[], Any] | None = None
        self.runs: int = 0  # number of acquisitions with a result since the device was created
        self._image: NDArray[np.uint8] = grey_pattern() if image is None else check_image(image)
        self._now = 0
        self._scheduled_calls: list[tuple[int, int, Callable[[], None]]] = []
        self._numbers = itertools.count()
        self._wanted_online = online  # whether clients have switched it online
        self._allowed_online = True  # False while the operator or an input holds it offline
        self._loading = False
        self._has_no_pictures = False  # whether the source of its pictures is lost
        self._inspector: Inspector | None = None  # inspector of the running run
        self._running_event: _PendingEvent | None = None
        self._runs_since_load = 0  # number of acquisitions since the job was loaded
        self._cells: dict[str, str] = {}
        # counts loads and changes of the mode, each of which ends the free runs before it
        self._generation = 0
        if active is not None:
            self.job = self.find(active)
        self._reset_job()

    # ------------------------------------------------------------------ properties

    @property
    def online(self) -> bool:
        """True if clients want the camera online and nothing holds it offline (published)."""
        return self._wanted_online and self._allowed_online

    @property
    def mode(self) -> Literal["running", "stopped", "switching"]:
        """Mode in the terms of other cameras: online, offline, or loading a job."""
        if self._loading:
            return "switching"
        return "running" if self.online else "stopped"

    @property
    def busy(self) -> bool:
        """True while a run or the loading of a job is under way."""
        return self._loading or self._running_event is not None

    @property
    def cells(self) -> Mapping[str, str]:
        """Contents of the cells, by ``A012`` or by lower-case name; none while a job is loaded."""
        return {} if self._loading else dict(self._cells)

    @property
    def image(self) -> NDArray[np.uint8]:
        """Image that the camera sees; one that is not 8 bit grey raises ConfigurationError."""
        return self._image

    @image.setter
    def image(self, image: Any) -> None:
        self._image = check_image(image)

    def find(self, job: str | int) -> Job:
        """Return a job by its file name, with the extension or without, or by its id.

        Raises:
            ConfigurationError: there is no such job.
        """
        for job_on_camera in self.jobs.values():
            if job_on_camera.id == job if isinstance(job, int) else job_on_camera.is_called(job):
                return job_on_camera
        known = ", ".join(self.jobs) or "none"
        raise ConfigurationError(f"job {job!r} is not on the camera; there are: {known}")

    # ------------------------------------------------------------------ time

    @property
    def now(self) -> int:
        """Time of the device, nanoseconds since its creation."""
        return self._now

    @property
    def next_event_at(self) -> int | None:
        """Time of the next scheduled event, nanoseconds; None if there is none."""
        return self._scheduled_calls[0][0] if self._scheduled_calls else None

    def advance_to(self, now: int) -> None:
        """Advance the device's time, nanoseconds, and run the due events in order of time.

        A time before the present one changes nothing.
        """
        while self._scheduled_calls and self._scheduled_calls[0][0] <= now:
            time, _, action = heapq.heappop(self._scheduled_calls)
            self._now = max(self._now, time)
            action()
        self._now = max(self._now, now)

    def after(self, seconds: float, action: Callable[[], None]) -> None:
        """Run an action after some seconds; at once for 0."""
        if seconds <= 0:
            action()
            return
        time = self._now + max(1, nanoseconds(seconds))
        heapq.heappush(self._scheduled_calls, (time, next(self._numbers), action))

    # ------------------------------------------------------------------ the operator

    def set_online(self, online: bool) -> None:
        """Go online, or hold the camera offline, as by hand or an input: then ``SO1`` fails."""
        with self.action_context():
            self._set_online_state(wanted=self._wanted_online or online, allowed=online)

    def start(self) -> None:
        """Go online by hand."""
        self.set_online(True)

    def stop(self) -> None:
        """Hold the camera offline, as by hand."""
        self.set_online(False)

    def trigger(self) -> bool:
        """Trigger by the input; return False if the camera does not accept that, as for ``SE8``."""
        with self.action_context():
            return self._begin_run(TRIGGER_EVENT, None, after_image=False)

    def load(self, job: str | int) -> None:
        """Load a job by hand, at once and in either mode; a running run ends without a result.

        Raises:
            ConfigurationError: there is no such job, or another one is being loaded.
        """
        next_job = self.find(job)
        if self._loading:
            raise ConfigurationError(f"job {job!r}: another one is being loaded")
        with self.action_context():
            self._abort_run()
            self.job = next_job
            self._reset_job()

    def set_blind(self, blind: bool) -> None:
        """Note that no pictures come, or that they come again.

        Without pictures the running run fails, and so does every trigger.
        """
        with self.action_context():
            self._has_no_pictures = blind
            if blind:
                self._abort_run()

    def switch_application(self, application: int, *, running: bool = False) -> bool:
        """Load the job with an id by hand, then go online or offline.

        Return False, and do nothing, while another job is loaded.


        Raises:
            ConfigurationError: there is no such job.
        """
        if self._loading:
            return False
        with self.action_context():
            self.load(application)
            self.set_online(running)
        return True

    # ------------------------------------------------------------------ requests

    def request_online(self, online: bool) -> StatusCode:
        """Go online or offline for a client (``SO``)."""
        if self._loading:
            return StatusCode.FAILED
        self._set_online_state(wanted=online, allowed=self._allowed_online)
        return StatusCode.STILL_OFFLINE if online and not self.online else StatusCode.DONE

    def request_job(self, job: str | int, on_code: OnCode) -> None:
        """Load a job for a client (``LF``, ``SJ``); ``on_code`` gets the code when that is done."""
        try:
            next_job = self.find(job)
        except ConfigurationError:
            on_code(StatusCode.FAILED)
            return
        if self.online or self._loading:
            on_code(StatusCode.FAILED)
            return
        self._loading = True

        def on_loaded() -> None:
            self._loading = False
            self.job = next_job
            self._reset_job()
            on_code(StatusCode.DONE)

        self.after(next_job.load_time, on_loaded)

    def request_event(self, event: int, on_code: OnCode, *, after_image: bool) -> None:
        """Cause an event, 0 to 8, for a client; ``on_code`` gets the code.

        It gets the code after the image was taken (``SE``), or after the cells were computed
        (``SW``).
        """
        if not self._begin_run(event, on_code, after_image=after_image):
            on_code(StatusCode.FAILED)

    def request_value(self, key: str, kind: str, value: CellValue) -> StatusCode:
        """Set a control of some kind for a client (``SI``, ``SF``, ``SS``)."""
        source = None if self.job is None else self.job.sources.get(key)
        if not isinstance(source, Control) or source.kind != kind or self._loading:
            return StatusCode.FAILED
        if not source.admits(value):
            return StatusCode.FAILED
        self._cells[key] = cell_text(value)
        return StatusCode.DONE

    # ------------------------------------------------------------------ internals

    def _reset_job(self) -> None:
        self._runs_since_load = 0
        self._cells = {} if self.job is None else self.job.loaded_cells()
        self._generation += 1
        self._run_freely()

    def _set_online_state(self, *, wanted: bool, allowed: bool) -> None:
        was_online = self.online
        self._wanted_online, self._allowed_online = wanted, allowed
        if self.online == was_online:
            return
        self._generation += 1
        if self.online:
            self._run_freely()
        else:
            self._abort_run()

    def _begin_run(self, event: int, on_code: OnCode | None, *, after_image: bool) -> bool:
        job = _UNSAVED if self.job is None else self.job
        acquires = event == TRIGGER_EVENT
        if (
            not self.online
            or self.busy
            or (acquires and (self._has_no_pictures or not job.triggered))
        ):
            return False
        run = self._running_event = _PendingEvent(on_code)
        if acquires and isinstance(job, InspectedJob):
            self._inspect(job, run, after_image=after_image)
            return True

        def on_image() -> None:
            if run.is_finished:
                return
            if after_image:
                run.report(StatusCode.DONE)
            self.after(job.processing_time, on_done)

        def on_done() -> None:
            if run.is_finished:
                return
            self._running_event = None
            if acquires:
                self._finish_acquisition(job)
            run.end(StatusCode.DONE)

        self.after(job.acquisition_time if acquires else 0.0, on_image)
        return True

    def _inspect(self, job: InspectedJob, run: _PendingEvent, *, after_image: bool) -> None:
        """Start the inspection of a picture for a run."""

        def on_image() -> None:
            with self.action_context():
                if after_image and not run.is_finished:
                    run.report(StatusCode.DONE)

        def on_done(values: Values | None) -> None:
            with self.action_context():
                if run.is_finished:
                    return
                self._running_event = self._inspector = None
                self._count_run()
                job.fill_cells(self._cells, values)
                run.end(StatusCode.DONE)

        self._inspector = job.inspector
        number = self.runs & _MAX_NUMBER
        job.inspector.begin(InspectionOrder(job.application, number, b""), on_image, on_done)

    def _finish_acquisition(self, job: Job) -> None:
        self._count_run()
        job.update_cells(self._cells, self._runs_since_load)

    def _count_run(self) -> None:
        self.runs += 1
        self._runs_since_load += 1

    def _abort_run(self) -> None:
        inspector, self._inspector = self._inspector, None
        if inspector is not None:
            inspector.cancel()
        run, self._running_event = self._running_event, None
        if run is not None:
            run.end(StatusCode.FAILED)

    def _run_freely(self) -> None:
        job = self.job
        if job is None or job.rate is None or not self.online:
            return
        generation, period = self._generation, 1 / job.rate

        def run_once() -> None:
            if generation != self._generation:
                return
            if not isinstance(job, InspectedJob):
                self._finish_acquisition(job)
            elif not (
                self.busy or self._has_no_pictures
            ):  # skip the run if the last one still runs
                run = self._running_event = _PendingEvent(None)
                self._inspect(job, run, after_image=False)
            self.after(period, run_once)

        self.after(period, run_once)


_UNSAVED = Job(file="unsaved")


def _by_file(jobs: list[Job]) -> dict[str, Job]:
    by_file: dict[str, Job] = {}
    by_id: dict[int, Job] = {}
    for job in jobs:
        if by_file.setdefault(job.file, job) is not job:
            raise ConfigurationError(f"job {job.file}: there are two of that name")
        if job.id is not None and by_id.setdefault(job.id, job) is not job:
            raise ConfigurationError(
                f"jobs {by_id[job.id].file} and {job.file} have the same id, {job.id}"
            )
    return by_file
