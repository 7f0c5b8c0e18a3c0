"""A camera as OPC UA's vision system: its states change by methods, results and the camera."""

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

MAX_PENDING = 1000
"""Largest number of results that wait until it is known whether they belong to the running job."""

RESULT_WAIT = 5.0
"""Seconds to wait after a trigger for its result from the spool."""

COMMAND_GRACE = 30.0
"""Additional seconds, beyond a command's own timeout, for its way to the camera."""

PREPARE_WAIT = 0.3
"""Seconds that PrepareRecipe waits before it returns that it is not completed yet."""

CONTINUOUS_GRACE = 5.0
"""Seconds after continuous execution in which its last results may arrive from the spool."""

LATE_RESULT_SECONDS = 60.0
"""Seconds in which a result of an aborted job may still arrive."""


class Face(Protocol):
    """The nodes and events that clients see of a vision system; each call returns at once."""

    def moved(self, transition: Transition, job: VisionJob | None, why: str) -> None:
        """Show a transition, and raise its events."""

    def acquired(self, job: VisionJob) -> None:
        """Raise the event for a taken picture, after which the part may move."""

    def result(self, result: VisionResult) -> None:
        """Show a result, and raise its event."""

    def message(self, text: str, kind: str, job: VisionJob | None) -> None:
        """Raise an event with a text."""

    def trouble(self, why: str) -> None:
        """Show the reason why the camera is unusable; "" if it can be used."""


class VisionSystem:
    """The states, jobs and results of one camera.

    Args:
        name: name of the camera.
        settings: settings of the server.
        command: function that carries out a command, by the camera's name, a verb and its fields.
        face: nodes and events that clients see.
        picture: function that returns the file of a result's picture.
        new_job: function that returns an id for a job.
        names: function that returns the names of the camera's own applications, with their numbers.
        simulated: True for an emulated camera, False for a real one, None if that is not known.
    """

    def __init__(
        self,
        name: str,
        settings: OpcUaSettings,
        command: Callable[[str, str, Mapping[str, Any]], Awaitable[dict[str, Any]]],
        face: Face,
        *,
        picture: Callable[[Mapping[str, Any]], Path | None],
        new_job: Callable[[], str],
        names: Callable[[], Mapping[str, int]] = dict,
        simulated: bool | None = None,
    ) -> None:
        self.name, self.settings, self.face = name, settings, face
        self.states = VisionStates()
        self.application: int | None = None
        self.job: VisionJob | None = None
        self._command, self._picture, self._new_job = command, picture, new_job
        self._names = names
        self._simulated = simulated
        # whether the camera is connected; None: unknown
        self._connected: bool | None = None
        # whether clients prepare recipes: then none becomes ready by itself
        self._by_client = False
        self._wanted: int | None = None  # the application that a client has prepared
        self._ready_application: int | None = None
        self._preparing = False
        # whether this server stopped the camera: start it before the next trigger
        self._stopped = False
        self._late_until = -1.0  # loop time until which a result may belong to an aborted job
        self._by_trigger: collections.OrderedDict[datetime, VisionJob] = collections.OrderedDict()
        self._last_continuous: VisionJob | None = None
        self._pending: collections.deque[OutletEntry] = collections.deque()
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
        """Update the states after a change of the camera's connection or active application."""
        connected, before = bool(state.get("connected")), self._connected
        self._connected, self.application = connected, state.get("application")
        if connected:
            if not before:
                self._late_until = -1.0
                self.face.trouble("")
            self._follow()
        elif before is not False:
            why = str(state.get("reason") or "the camera is not connected")
            self._end_job(FAILED, why, owed=False)
            self.face.trouble(why)
            if self.states.vision in ("Preoperational", "Operational"):
                self._move("Error", why=why)

    def _follow(self) -> None:
        """Make the transitions that the camera's state causes."""
        states = self.states
        if not self._connected:
            if self._connected is False and states.vision == "Preoperational":
                self._move("Error", why="the camera is not connected")
            return
        if states.vision == "Error":
            self._move("Operational" if self.settings.automatic else "Preoperational")
        if states.vision == "Preoperational" and self.settings.automatic and not self._by_client:
            self._move("Operational")
        if self._preparing:
            return
        if states.automatic == "Ready" and self._ready_application != self.application:
            self._move("Initialized", why="the camera has another application")
        wanted = not self._by_client or self.application == self._wanted
        ready = self.settings.automatic and self.application and wanted
        if states.automatic == "Initialized" and ready:
            self._become_ready("")

    def _become_ready(self, cause: str) -> None:
        self._ready_application = self.application
        self._move("Ready", cause)

    def _move(
        self, target: str, cause: str = "", *, job: VisionJob | None = None, why: str = ""
    ) -> None:
        self.face.moved(self.states.move(target, cause), job, why)

    # ------------------------------------------------------------------ methods

    @property
    def prepared(self) -> int | None:
        """The application that is ready for jobs; None without."""
        ready = self.states.automatic not in ("", "Initialized")
        return self._ready_application if ready else None

    def change(self, method: str, target: str, why: str = "") -> None:
        """Carry out a method that only changes the state of the vision system.

        Args:
            method: ``Halt``, ``Reset`` or ``SelectModeAutomatic``.
            target: name of the state.
            why: text that the client gave.

        Raises:
            WrongStateError: the method is not allowed in this state.
        """
        self._check(method)
        self._by_client, self._wanted = True, None
        self._end_job(ABORTED, f"{method} {why}".rstrip())
        self._move(target, method, why=why)
        self._follow()

    def _check(self, method: str) -> None:
        if not self.states.allows(method):
            raise WrongStateError(f"{method} is not allowed in {self.states.both}")

    @property
    def recipes(self) -> Mapping[str, int]:
        """Applications by name; names in the settings have priority over the camera's own."""
        named = self.settings.recipes
        others = {name: number for name, number in self._names().items() if name not in named}
        return {**named, **others}

    def application_of(self, external: str, internal: str = "") -> int:
        """Return the application of a recipe.

        Args:
            external: one of :attr:`recipes`, or the number as a text.
            internal: number as a text; "" if only the name is given.

        Raises:
            UnknownRecipeError: there is no such recipe, or the two ids name different ones.
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
        """Begin to prepare an application; return True if it is ready after a moment.

        A camera may take seconds, and the client's other requests wait for the return.

        Raises:
            WrongStateError: the method is not allowed in this state, or the state changed
                meanwhile.
            BusyError: another recipe is being prepared.
            SmartCamError: the camera failed or refused.
        """
        if self._preparing:
            raise BusyError("another recipe is being prepared")
        if self.states.automatic not in ("Initialized", "Ready"):
            raise WrongStateError(f"PrepareRecipe is not allowed in {self.states.both}")
        self._by_client, self._wanted, self._preparing = True, None, True
        prepared: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._spawn(lambda: self._prepare(application, prepared))
        try:
            async with asyncio.timeout(PREPARE_WAIT):
                await asyncio.shield(prepared)
        except TimeoutError:
            if not prepared.done():
                prepared.add_done_callback(lambda done: self._prepared_later(application, done))
                return False
            prepared.result()
        return True

    def _prepared_later(self, application: int, done: asyncio.Future[None]) -> None:
        """Report the failure of a preparation after the method's return."""
        error = None if done.cancelled() else done.exception()
        if error is not None:
            text = f"recipe {application} is not prepared: {str(error) or type(error).__name__}"
            self.face.message(text, type(error).__name__, None)

    async def _prepare(self, application: int, prepared: asyncio.Future[None]) -> None:
        """Prepare an application, and set the outcome."""
        try:
            if self.states.automatic == "Ready":
                self._move("Initialized", why="another recipe is prepared")
            if application != self.application:
                timeout = self.settings.switch_timeout
                await self._do("switch", application=application, timeout=timeout)
            await self._start()
            self.application = application
            if self.states.automatic != "Initialized":
                raise WrongStateError(f"the state became {self.states.both} meanwhile")
            self._wanted = application
            self._become_ready("PrepareRecipe")
        except (SmartCamError, TimeoutError) as exc:
            prepared.set_exception(exc)
            prepared.exception()  # mark the error as retrieved, if the caller no longer waits
        else:
            prepared.set_result(None)
        finally:
            self._preparing = False
            if not prepared.done():
                prepared.cancel()

    def unprepare(self) -> None:
        """Remove the prepared recipe.

        Raises:
            WrongStateError: the method is not allowed in this state.
        """
        self._check("UnprepareRecipe")
        self._by_client, self._wanted = True, None
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
        self._check(method)
        if recipe and self.application_of(recipe) != self.prepared:
            raise UnknownRecipeError(f"{recipe!r:.80} is not ready: prepare it first")
        self.job = job = VisionJob(self._new_job(), single, *ids, self.prepared)
        self._move("SingleExecution" if single else "ContinuousExecution", method, job=job)
        job.task = self._spawn(lambda: self._single(job) if single else self._continuous(job))
        return job

    def end_job(self, method: str, why: str = "") -> None:
        """End the running job.

        Args:
            method: ``Stop`` or ``Abort``.
            why: text that the client gave.

        Raises:
            WrongStateError: no job is running.
        """
        self._check(method)
        job = self._end_job(ABORTED, f"{method} {why}".rstrip())
        self._move("Ready", method, job=job, why=why)
        self._follow()

    # ------------------------------------------------------------------ jobs

    def _spawn(self, work: Callable[[], Awaitable[None]]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(self._guarded(work))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def _guarded(self, work: Callable[[], Awaitable[None]]) -> None:
        try:
            await work()
        except asyncio.CancelledError:
            raise
        except ENDS_PROGRAM:
            raise
        except BaseException as exc:
            logger.exception("outlet: camera %s", self.name)
            self._job_failed(self.job, text_of(exc))

    async def _do(self, verb: str, **given: Any) -> dict[str, Any]:
        limit = float(given.get("timeout", self.settings.switch_timeout)) + COMMAND_GRACE
        async with asyncio.timeout(limit):
            return await self._command(self.name, verb, given)

    async def _start(self) -> None:
        """Start the camera, unless it always runs."""
        with contextlib.suppress(UnsupportedError):
            await self._do("start", timeout=self.settings.switch_timeout)
        self._stopped = False

    async def _single(self, job: VisionJob) -> None:
        try:
            if self._stopped:
                await self._start()
            done = await self._do("trigger", timeout=self.settings.trigger_timeout)
        except (SmartCamError, TimeoutError) as exc:
            self._job_failed(job, str(exc) or type(exc).__name__, type(exc).__name__)
            return
        if self.job is not job:
            return
        self.face.acquired(job)
        at = done["result"].get("triggered_at")
        job.trigger = datetime.fromisoformat(at) if isinstance(at, str) else at
        if job.trigger is not None:
            self._by_trigger[job.trigger] = job
            while len(self._by_trigger) > MAX_REMEMBERED_JOBS:
                self._by_trigger.popitem(last=False)
        self._take_pending()
        try:
            async with asyncio.timeout(RESULT_WAIT):
                await job.seen.wait()
        except TimeoutError:
            text = f"the result of job {job.id} is not there yet: it comes later, under its id"
            self.face.message(text, "ResultDelayed", job)
        if self.job is job:
            self.job = None
            self._move("Ready", job=job)
            self._follow()

    async def _continuous(self, job: VisionJob) -> None:
        try:
            await self._start()
        except (SmartCamError, TimeoutError) as exc:
            self._job_failed(job, str(exc) or type(exc).__name__, type(exc).__name__)

    def _job_failed(self, job: VisionJob | None, why: str, kind: str = "Error") -> None:
        if job is None or self.job is not job:
            return
        self._end_job(FAILED, why, kind=kind)
        if self.states.automatic in ("SingleExecution", "ContinuousExecution"):
            self._move("Ready", job=job, why=why)
        self._follow()

    def _end_job(
        self, state: int, why: str, *, kind: str = "Aborted", owed: bool = True
    ) -> VisionJob | None:
        """End the running job, if there is one, and publish its end."""
        job, self.job = self.job, None
        if job is None:
            return None
        loop = asyncio.get_running_loop()
        job.ended_clock = loop.time()
        if job.task is not None and job.task is not asyncio.current_task():
            job.task.cancel()
        if job.single and job.trigger is None and owed:
            self._late_until = loop.time() + LATE_RESULT_SECONDS
        if job.trigger is not None:
            self._by_trigger.pop(job.trigger, None)  # the end of the job counts as its only result
        if not job.single:
            self._last_continuous = job
            self._stopped = True
            self._spawn(self._stop_camera)
        if not job.seen.is_set() and (job.single or state == FAILED):
            job.seen.set()
            at = datetime.now(UTC)
            fields = {"error": why, "kind": kind}
            made = f"{self.name}/job/{job.id}"
            ended = VisionResult(
                *(made, self.name, state, job.application, job, at, fields, why, None),
                self._simulated,
            )
            self.face.result(ended)
        self._take_pending()
        return job

    async def _stop_camera(self) -> None:
        try:
            await self._do("stop", timeout=self.settings.switch_timeout)
        except (SmartCamError, TimeoutError) as exc:
            self.face.message(f"the camera did not stop: {exc}", type(exc).__name__, None)

    # ------------------------------------------------------------------ results

    def take(self, entry: OutletEntry) -> None:
        """Publish an entry, or keep it until it is known whether it belongs to the running job."""
        job = self.job
        if self._pending or (job is not None and job.single and job.trigger is None):
            fields = json.loads(entry.body) if entry.body else {}
            maybe = self._pending or fields.get("triggered_at") is not None
            if maybe and len(self._pending) < MAX_PENDING:
                self._pending.append(entry)
                return
        self._publish(entry)

    def _take_pending(self) -> None:
        while self._pending:
            self._publish(self._pending.popleft())

    def _publish(self, entry: OutletEntry) -> None:
        fields: dict[str, Any] = json.loads(entry.body) if entry.body else {}
        if entry.kind == "gap":
            lost = fields.get("lost", "some")
            self.face.message(f"{lost} results are lost: {fields.get('error', '')}", "Gap", None)
            return
        error = str(fields.get("error") or "")
        if fields.get("application") is None:
            self.face.message(error, str(fields.get("kind") or "Error"), None)
            return
        at = _time(fields.get("received_at")) or datetime.fromtimestamp(entry.at, UTC)
        job = self._job_of(fields, at)
        application = fields["application"]
        if job is not None and application != job.application:
            error = error or f"it is of application {application}, not {job.application}"
        if job is not None and not job.single:
            self.face.acquired(job)
        state = FAILED if error else COMPLETED
        picture = self._picture({**fields, "camera": entry.camera})
        made = VisionResult(
            *(entry.id, self.name, state, application, job, at, fields, error, picture),
            self._simulated,
        )
        self.face.result(made)
        if job is not None:
            job.seen.set()

    def _job_of(self, fields: Mapping[str, Any], at: datetime) -> VisionJob | None:
        """Return the job of a result; None if it is uncertain."""
        trigger = _time(fields.get("triggered_at"))
        if trigger is not None:
            job_of_trigger = self._by_trigger.pop(trigger, None)
            if job_of_trigger is not None:
                return job_of_trigger
        clock = asyncio.get_running_loop().time()
        job = self.job or self._last_continuous
        if job is None or job.single or at < job.started or (trigger and trigger < job.started):
            return None
        if clock < self._late_until:
            self._late_until = -1.0  # the result may be one of a job that was given up
            return None
        if job.ended_clock is not None and clock > job.ended_clock + CONTINUOUS_GRACE:
            return None
        return job


def _time(text: Any) -> datetime | None:
    return datetime.fromisoformat(text) if isinstance(text, str) else None
