"""Represent a camera as a vision system of OPC UA, with states, jobs and results."""

from __future__ import annotations

import asyncio
import collections
import contextlib
import json
import logging
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Protocol

from smartcam._user_code import ENDS_PROGRAM, text_of
from smartcam.exceptions import SmartCamError, UnsupportedError
from smartcam.outlets._opcua.jobs import (
    ABORTED,
    COMPLETED,
    FAILED,
    BusyError,
    UnknownRecipeError,
    VisionJob,
    VisionResult,
)
from smartcam.outlets._opcua.machine import VisionStates, WrongStateError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping
    from pathlib import Path

    from smartcam.outlets._entry import OutletEntry
    from smartcam.outlets._opcua.nodeset import Transition
    from smartcam.outlets._opcua.settings import OpcUaSettings

logger: logging.Logger = logging.getLogger("smartcam.outlets")

MAX_REMEMBERED_JOBS = 1000
"""Largest number of ended jobs that are remembered for late results from the spool."""

MAX_UNDECIDED_ENTRIES = 1000
"""Largest number of entries that wait until it is known whether they belong to the running job."""

RESULT_WAIT = 5.0
"""Seconds to wait after a trigger for its result from the spool."""

COMMAND_GRACE = 30.0
"""Seconds that a command may take beyond its own timeout, since it passes another thread."""

PREPARE_WAIT = 0.3
"""Seconds that PrepareRecipe waits for the camera; after that, it returns "not completed"."""

CONTINUOUS_RESULT_WAIT = 5.0
"""Seconds after the end of continuous execution in which its last results may still arrive."""

LATE_RESULT_WAIT = 60.0
"""Seconds after the abort of a job in which the job's result may still arrive."""


class VisionView(Protocol):
    """Shows a vision system to clients, by nodes and events; each call returns at once."""

    def show_transition(self, transition: Transition, job: VisionJob | None, reason: str) -> None:
        """Show a transition, and raise its events."""

    def show_acquisition(self, job: VisionJob) -> None:
        """Raise the event that a job's picture is taken, after which the part may move."""

    def show_result(self, result: VisionResult) -> None:
        """Show a result, and raise its event."""

    def show_message(self, text: str, kind: str, job: VisionJob | None) -> None:
        """Raise an event with a text."""

    def show_trouble(self, reason: str) -> None:
        """Show the reason why the camera cannot be used; "" if it can be used."""


class VisionSystem:
    """The states, jobs and results of one camera.

    Args:
        name: name of the camera.
        settings: settings of the server.
        command: function that carries out a command, by the camera's name, a verb and its fields.
        view: view that shows the system to clients.
        picture: function that returns the file of a result's picture.
        make_job_id: function that returns an id for a job.
        get_names: function that returns the names of the camera's own applications, with numbers.
        simulated: True for an emulated camera, False for a real one, None if this is not known.
    """

    def __init__(
        self,
        name: str,
        settings: OpcUaSettings,
        command: Callable[[str, str, Mapping[str, Any]], Awaitable[dict[str, Any]]],
        view: VisionView,
        *,
        picture: Callable[[Mapping[str, Any]], Path | None],
        make_job_id: Callable[[], str],
        get_names: Callable[[], Mapping[str, int]] = dict,
        simulated: bool | None = None,
    ) -> None:
        self.name, self.settings, self.view = name, settings, view
        self.states = VisionStates()
        self.application: int | None = None
        self.job: VisionJob | None = None
        self._command, self._picture, self._make_job_id = command, picture, make_job_id
        self._get_names = get_names
        self._simulated = simulated
        # whether the camera is connected; None: unknown
        self._connected: bool | None = None
        # whether clients prepare recipes; if they do, no recipe becomes ready by itself
        self._clients_prepare = False
        self._client_application: int | None = None  # the application that a client has prepared
        self._ready_application: int | None = None
        self._is_preparing = False
        # whether this server has stopped the camera, which must then be started before a trigger
        self._was_stopped = False
        self._late_until = -1.0  # loop time until which a result may belong to an aborted job
        self._jobs_by_trigger: collections.OrderedDict[datetime, VisionJob] = (
            collections.OrderedDict()
        )
        self._last_continuous: VisionJob | None = None
        self._undecided_entries: collections.deque[OutletEntry] = collections.deque()
        self._tasks: set[asyncio.Task[None]] = set()

    async def close(self) -> None:
        """End the running job and its tasks."""
        self._end_job(ABORTED, "the server ends")
        for task in self._tasks:
            task.cancel()
        if self._tasks:
            await asyncio.wait(self._tasks)

    # ------------------------------------------------------------------ the camera's state

    def camera_changed(self, state: Mapping[str, Any]) -> None:
        """Update the states after the camera's connection or active application has changed."""
        connected, was_connected = bool(state.get("connected")), self._connected
        self._connected, self.application = connected, state.get("application")
        if connected:
            if not was_connected:
                self._late_until = -1.0
                self.view.show_trouble("")
            self._update_states()
        elif was_connected is not False:
            reason = str(state.get("reason") or "the camera is not connected")
            self._end_job(FAILED, reason, may_come_late=False)
            self.view.show_trouble(reason)
            if self.states.vision in ("Preoperational", "Operational"):
                self._move("Error", reason=reason)

    def _update_states(self) -> None:
        """Move to the states that correspond to the camera's state."""
        states = self.states
        if not self._connected:
            if self._connected is False and states.vision == "Preoperational":
                self._move("Error", reason="the camera is not connected")
            return
        if states.vision == "Error":
            self._move("Operational" if self.settings.automatic else "Preoperational")
        if (
            states.vision == "Preoperational"
            and self.settings.automatic
            and not self._clients_prepare
        ):
            self._move("Operational")
        if self._is_preparing:
            return
        if states.job_state == "Ready" and self._ready_application != self.application:
            self._move("Initialized", reason="the camera has another application")
        is_wanted = not self._clients_prepare or self.application == self._client_application
        may_become_ready = self.settings.automatic and self.application and is_wanted
        if states.job_state == "Initialized" and may_become_ready:
            self._become_ready("")

    def _become_ready(self, cause: str) -> None:
        self._ready_application = self.application
        self._move("Ready", cause)

    def _move(
        self, target: str, cause: str = "", *, job: VisionJob | None = None, reason: str = ""
    ) -> None:
        self.view.show_transition(self.states.move(target, cause), job, reason)

    # ------------------------------------------------------------------ methods

    @property
    def prepared_application(self) -> int | None:
        """The application that is ready for jobs; None if none is."""
        is_ready = self.states.job_state not in ("", "Initialized")
        return self._ready_application if is_ready else None

    def change_state(self, method: str, target: str, reason: str = "") -> None:
        """Carry out a method that only changes the state of the vision system.

        Args:
            method: ``Halt``, ``Reset`` or ``SelectModeAutomatic``.
            target: name of the state.
            reason: text that the client gave.

        Raises:
            WrongStateError: the method is not allowed in this state.
        """
        self._check_allowed(method)
        self._clients_prepare, self._client_application = True, None
        self._end_job(ABORTED, f"{method} {reason}".rstrip())
        self._move(target, method, reason=reason)
        self._update_states()

    def _check_allowed(self, method: str) -> None:
        if not self.states.allows(method):
            raise WrongStateError(f"{method} is not allowed in {self.states.text}")

    @property
    def recipes(self) -> Mapping[str, int]:
        """Applications by name; names in the settings have priority over the camera's own."""
        named = self.settings.recipes
        others = {name: number for name, number in self._get_names().items() if name not in named}
        return {**named, **others}

    def application_of(self, external: str, internal: str = "") -> int:
        """Return the application of a recipe.

        Args:
            external: one of :attr:`recipes`, or the number as a text.
            internal: number as a text; "" if only the name is given.

        Raises:
            UnknownRecipeError: there is no such recipe, or the two ids name different recipes.
        """
        applications: set[int] = set()
        recipes = self.recipes
        for text, names in ((external, recipes), (internal, dict[str, int]())):
            if text in names:
                applications.add(names[text])
            elif text.isascii() and text.isdecimal() and int(text[:11]) <= 0xFFFFFFFF:
                applications.add(int(text))
            elif text:
                known = ", ".join(recipes) or "no names"
                raise UnknownRecipeError(f"there is no recipe {text!r:.80}; known: {known}")
        if len(applications) != 1:
            raise UnknownRecipeError(f"expected one recipe, got {external!r:.80}, {internal!r:.80}")
        return applications.pop()

    def recipe_name(self, application: int | None) -> str:
        """Return the first name of an application, else its number."""
        names = (name for name, number in self.recipes.items() if number == application)
        return next(names, "" if application is None else str(application))

    async def prepare(self, application: int) -> bool:
        """Begin to prepare an application; return True if it is ready after :data:`PREPARE_WAIT`.

        A camera may take seconds, but the client's other requests wait until this method returns.

        Raises:
            WrongStateError: the method is not allowed in this state, or the state changed
                meanwhile.
            BusyError: another recipe is being prepared.
            SmartCamError: the camera failed or refused.
        """
        if self._is_preparing:
            raise BusyError("another recipe is being prepared")
        if self.states.job_state not in ("Initialized", "Ready"):
            raise WrongStateError(f"PrepareRecipe is not allowed in {self.states.text}")
        self._clients_prepare, self._client_application, self._is_preparing = True, None, True
        prepared: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._spawn(lambda: self._prepare(application, prepared))
        try:
            async with asyncio.timeout(PREPARE_WAIT):
                await asyncio.shield(prepared)
        except TimeoutError:
            if not prepared.done():
                prepared.add_done_callback(
                    lambda done: self._report_late_failure(application, done)
                )
                return False
            prepared.result()
        return True

    def _report_late_failure(self, application: int, done: asyncio.Future[None]) -> None:
        """Report a preparation that failed after the method had returned."""
        error = None if done.cancelled() else done.exception()
        if error is not None:
            text = f"recipe {application} is not prepared: {str(error) or type(error).__name__}"
            self.view.show_message(text, type(error).__name__, None)

    async def _prepare(self, application: int, prepared: asyncio.Future[None]) -> None:
        """Prepare an application, and set the outcome."""
        try:
            if self.states.job_state == "Ready":
                self._move("Initialized", reason="another recipe is prepared")
            if application != self.application:
                timeout = self.settings.switch_timeout
                await self._carry_out("switch", application=application, timeout=timeout)
            await self._start_camera()
            self.application = application
            if self.states.job_state != "Initialized":
                raise WrongStateError(f"the state became {self.states.text} meanwhile")
            self._client_application = application
            self._become_ready("PrepareRecipe")
        except (SmartCamError, TimeoutError) as exc:
            prepared.set_exception(exc)
            prepared.exception()  # perhaps no caller waits any more: mark the error as retrieved
        else:
            prepared.set_result(None)
        finally:
            self._is_preparing = False
            if not prepared.done():
                prepared.cancel()

    def unprepare(self) -> None:
        """Remove the prepared recipe.

        Raises:
            WrongStateError: the method is not allowed in this state.
        """
        self._check_allowed("UnprepareRecipe")
        self._clients_prepare, self._client_application = True, None
        self._move("Initialized", "UnprepareRecipe")

    def start_job(self, ids: tuple[Any, Any, Any], recipe: str, *, single: bool) -> VisionJob:
        """Start a job, and return it at once.

        Args:
            ids: ids of measurement, part and product.
            recipe: name or number of the recipe; "" for the ready one.
            single: True for one trigger, False for continuous execution.

        Raises:
            WrongStateError: no recipe is ready, or a job is running.
            UnknownRecipeError: another recipe is ready.
        """
        method = "StartSingleJob" if single else "StartContinuous"
        self._check_allowed(method)
        if recipe and self.application_of(recipe) != self.prepared_application:
            raise UnknownRecipeError(f"{recipe!r:.80} is not ready: prepare it first")
        self.job = job = VisionJob(self._make_job_id(), single, *ids, self.prepared_application)
        self._move("SingleExecution" if single else "ContinuousExecution", method, job=job)
        job.task = self._spawn(
            lambda: self._run_single(job) if single else self._start_continuous(job)
        )
        return job

    def end_job(self, method: str, reason: str = "") -> None:
        """End the running job.

        Args:
            method: ``Stop`` or ``Abort``.
            reason: text that the client gave.

        Raises:
            WrongStateError: no job is running.
        """
        self._check_allowed(method)
        job = self._end_job(ABORTED, f"{method} {reason}".rstrip())
        self._move("Ready", method, job=job, reason=reason)
        self._update_states()

    # ------------------------------------------------------------------ jobs

    def _spawn(self, work: Callable[[], Awaitable[None]]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(self._report_errors(work))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def _report_errors(self, work: Callable[[], Awaitable[None]]) -> None:
        try:
            await work()
        except asyncio.CancelledError:
            raise
        except ENDS_PROGRAM:
            raise
        except BaseException as exc:
            logger.exception("outlet: camera %s", self.name)
            self._job_failed(self.job, text_of(exc))

    async def _carry_out(self, verb: str, **arguments: Any) -> dict[str, Any]:
        limit = float(arguments.get("timeout", self.settings.switch_timeout)) + COMMAND_GRACE
        async with asyncio.timeout(limit):
            return await self._command(self.name, verb, arguments)

    async def _start_camera(self) -> None:
        """Start the camera; do nothing if the camera always runs, and has no such command."""
        with contextlib.suppress(UnsupportedError):
            await self._carry_out("start", timeout=self.settings.switch_timeout)
        self._was_stopped = False

    async def _run_single(self, job: VisionJob) -> None:
        try:
            if self._was_stopped:
                await self._start_camera()
            outcome = await self._carry_out("trigger", timeout=self.settings.trigger_timeout)
        except (SmartCamError, TimeoutError) as exc:
            self._job_failed(job, str(exc) or type(exc).__name__, type(exc).__name__)
            return
        if self.job is not job:
            return
        self.view.show_acquisition(job)
        at = outcome["result"].get("triggered_at")
        job.triggered_at = datetime.fromisoformat(at) if isinstance(at, str) else at
        if job.triggered_at is not None:
            self._jobs_by_trigger[job.triggered_at] = job
            while len(self._jobs_by_trigger) > MAX_REMEMBERED_JOBS:
                self._jobs_by_trigger.popitem(last=False)
        self._publish_undecided()
        try:
            async with asyncio.timeout(RESULT_WAIT):
                await job.result_published.wait()
        except TimeoutError:
            text = f"the result of job {job.id} is not there yet: it comes later, under its id"
            self.view.show_message(text, "ResultDelayed", job)
        if self.job is job:
            self.job = None
            self._move("Ready", job=job)
            self._update_states()

    async def _start_continuous(self, job: VisionJob) -> None:
        try:
            await self._start_camera()
        except (SmartCamError, TimeoutError) as exc:
            self._job_failed(job, str(exc) or type(exc).__name__, type(exc).__name__)

    def _job_failed(self, job: VisionJob | None, reason: str, kind: str = "Error") -> None:
        if job is None or self.job is not job:
            return
        self._end_job(FAILED, reason, kind=kind)
        if self.states.job_state in ("SingleExecution", "ContinuousExecution"):
            self._move("Ready", job=job, reason=reason)
        self._update_states()

    def _end_job(
        self, state: int, reason: str, *, kind: str = "Aborted", may_come_late: bool = True
    ) -> VisionJob | None:
        """End the running job, if there is one, and publish its end."""
        job, self.job = self.job, None
        if job is None:
            return None
        loop = asyncio.get_running_loop()
        job.ended_at = loop.time()
        if job.task is not None and job.task is not asyncio.current_task():
            job.task.cancel()
        if job.is_single and job.triggered_at is None and may_come_late:
            self._late_until = loop.time() + LATE_RESULT_WAIT
        if job.triggered_at is not None:
            self._jobs_by_trigger.pop(
                job.triggered_at, None
            )  # the end of the job counts as its only result
        if not job.is_single:
            self._last_continuous = job
            self._was_stopped = True
            self._spawn(self._stop_camera)
        if not job.result_published.is_set() and (job.is_single or state == FAILED):
            job.result_published.set()
            at = datetime.now(UTC)
            fields = {"error": reason, "kind": kind}
            result_id = f"{self.name}/job/{job.id}"
            ended = VisionResult(
                *(result_id, self.name, state, job.application, job, at, fields, reason, None),
                self._simulated,
            )
            self.view.show_result(ended)
        self._publish_undecided()
        return job

    async def _stop_camera(self) -> None:
        try:
            await self._carry_out("stop", timeout=self.settings.switch_timeout)
        except (SmartCamError, TimeoutError) as exc:
            self.view.show_message(f"the camera did not stop: {exc}", type(exc).__name__, None)

    # ------------------------------------------------------------------ results

    def accept_entry(self, entry: OutletEntry) -> None:
        """Publish an entry, or keep it until it is known whether it belongs to the running job."""
        job = self.job
        if self._undecided_entries or (
            job is not None and job.is_single and job.triggered_at is None
        ):
            fields = json.loads(entry.body) if entry.body else {}
            may_belong = self._undecided_entries or fields.get("triggered_at") is not None
            if may_belong and len(self._undecided_entries) < MAX_UNDECIDED_ENTRIES:
                self._undecided_entries.append(entry)
                return
        self._publish(entry)

    def _publish_undecided(self) -> None:
        while self._undecided_entries:
            self._publish(self._undecided_entries.popleft())

    def _publish(self, entry: OutletEntry) -> None:
        fields: dict[str, Any] = json.loads(entry.body) if entry.body else {}
        if entry.kind == "gap":
            lost = fields.get("lost", "some")
            self.view.show_message(
                f"{lost} results are lost: {fields.get('error', '')}", "Gap", None
            )
            return
        error = str(fields.get("error") or "")
        if fields.get("application") is None:
            self.view.show_message(error, str(fields.get("kind") or "Error"), None)
            return
        at = _parse_time(fields.get("received_at")) or datetime.fromtimestamp(entry.at, UTC)
        job = self._job_of(fields, at)
        application = fields["application"]
        if job is not None and application != job.application:
            error = error or f"it is of application {application}, not {job.application}"
        if job is not None and not job.is_single:
            self.view.show_acquisition(job)
        state = FAILED if error else COMPLETED
        picture = self._picture({**fields, "camera": entry.camera})
        result = VisionResult(
            *(entry.id, self.name, state, application, job, at, fields, error, picture),
            self._simulated,
        )
        self.view.show_result(result)
        if job is not None:
            job.result_published.set()

    def _job_of(self, fields: Mapping[str, Any], at: datetime) -> VisionJob | None:
        """Return the job that a result belongs to; None if none does, or it is uncertain."""
        trigger = _parse_time(fields.get("triggered_at"))
        if trigger is not None:
            job_of_trigger = self._jobs_by_trigger.pop(trigger, None)
            if job_of_trigger is not None:
                return job_of_trigger
        clock = asyncio.get_running_loop().time()
        job = self.job or self._last_continuous
        if (
            job is None
            or job.is_single
            or at < job.started_at
            or (trigger and trigger < job.started_at)
        ):
            return None
        if clock < self._late_until:
            self._late_until = -1.0  # the result may belong to an aborted job
            return None
        if job.ended_at is not None and clock > job.ended_at + CONTINUOUS_RESULT_WAIT:
            return None
        return job


def _parse_time(text: Any) -> datetime | None:
    return datetime.fromisoformat(text) if isinstance(text, str) else None
