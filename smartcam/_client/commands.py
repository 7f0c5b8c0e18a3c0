"""Command the camera: start, stop, load another application.

Every ``deadline`` is loop time. The command lock decides whose command runs, one at a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from smartcam._client.handshake import code_text
from smartcam._client.status import runs_not_busy
from smartcam.exceptions import CommandRejectedError, ConfigurationError
from smartcam.models import Status
from smartcam.protocols import Verdict
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam._client.camera_state import CameraState
    from smartcam._client.connection import Connection
    from smartcam._client.link import Link
    from smartcam._client.requests import Requests
    from smartcam._client.status import StatusRequests


_QUERY = m.Query()


@dataclass(eq=False)
class Commands:
    """Changes the application and the run state of the camera.

    Attributes:
        unconfirmed: True if a Start or Stop was sent, and the status has not confirmed it.
    """

    _connection: Connection
    _requests: Requests
    _status: StatusRequests
    _state: CameraState

    def __post_init__(self) -> None:
        self.unconfirmed: bool = False
        # number of loads by others when discard_inspection() stopped the camera; None once it was
        # started again
        self._loads_when_halted: int | None = None

    def begin_session(self, link: Link) -> None:
        """Begin a session: no answer is pending, and its status was received."""
        self._connection.begin_session(link)
        self._requests.begin_session()
        self._status.begin_session()
        self.unconfirmed = False

    def end_session(self) -> None:
        """End the session: nothing is requested any more."""
        self._status.end_session()

    @property
    def is_in_run_mode(self) -> bool:
        """True if the application runs, or :meth:`discard_inspection` has stopped it shortly."""
        return self.is_halted() or Status.RUNNING in self._status.last

    def is_halted(self) -> bool:
        """Return True if :meth:`discard_inspection` was interrupted, and nothing restarted it."""
        return self._loads_when_halted == self._state.loads_by_others

    # ------------------------------------------------------------------ run state

    async def start(self, deadline: float) -> None:
        """Enter run mode and wait until the camera reports it."""
        self._connection.require(m.Start)
        self._state.want_running(True)
        await self._enter_run_mode(deadline)

    async def stop(self, deadline: float) -> None:
        """Leave run mode and wait until the camera reports it."""
        self._connection.require(m.Stop)
        self._state.want_running(False)
        await self._leave_run_mode(deadline)

    async def discard_inspection(self, deadline: float) -> None:
        """Stop, receive everything that the camera has sent, and start again.

        Cancellation: the camera may stay stopped (:meth:`is_halted`).
        """
        self._loads_when_halted = self._state.loads_by_others
        await self._confirm_stop(deadline)
        await self._requests.round_trip(deadline)
        await self._enter_run_mode(deadline)

    async def _enter_run_mode(self, deadline: float) -> None:
        await self._command_and_wait(
            m.Start(), runs_not_busy, deadline, "Running and not BUSY after Start"
        )
        self._loads_when_halted = None

    async def _leave_run_mode(self, deadline: float) -> None:
        self._loads_when_halted = None
        await self._confirm_stop(deadline)

    async def _confirm_stop(self, deadline: float) -> None:
        await self._command_and_wait(m.Stop(), _is_not_running, deadline, "not Running after Stop")

    async def _command_and_wait(
        self, command: m.Request, predicate: Callable[[Status], bool], deadline: float, awaited: str
    ) -> None:
        self.unconfirmed = True  # and it stays True if the wait is interrupted
        await self._requests.command(command, deadline)
        await self._status.refresh(deadline)
        await self._status.until(predicate, deadline, awaited)
        self.unconfirmed = False

    async def confirm_run_state(self, deadline: float) -> None:
        """Get the status that follows an interrupted start or stop.

        The camera sends it before the answer to a later Query, or it must be requested.
        """
        if self._connection.features.polled:
            await self._status.refresh(deadline)
        else:
            await self._requests.round_trip(deadline)
        self.unconfirmed = False

    # ------------------------------------------------------------------ application

    async def query_application(self, deadline: float) -> int:
        """Return the active application.

        During a switch a Query reports the old id, so a pending answer to a switch is awaited
        first. A camera that is too busy is asked again.

        Raises:
            ResponseTimeoutError: no answer, or the camera was busy all the time.
        """
        requests = self._requests
        if requests.is_pending(m.SwitchAnswer):
            await requests.await_pending(m.SwitchAnswer, _QUERY, deadline)
        while True:
            answer = await requests.ask(_QUERY, m.QueryAnswer, deadline)
            if requests.is_done(m.Query, answer):
                return answer.application
            if not requests.is_busy(answer):
                requests.check(m.Query, answer)
                return answer.application
            await self._status.pause(deadline, "the busy camera to name its application")

    async def query_loaded(self, deadline: float) -> int:
        """Wait until no application is being loaded, and return the active one."""
        await self._status.refresh(deadline)  # the run state is needed next
        await self._status.until(_is_not_loading, deadline, "the application to be loaded")
        return await self.query_application(deadline)

    async def ensure_running(self, application: int, deadline: float) -> None:
        """Make sure that an application is running and ready, with the fewest commands."""
        self.check_id(application)
        if await self.query_loaded(deadline) != application:
            await self.switch(application, deadline, start=True)
            return
        self._state.want_application(application)
        if Status.RUNNING not in self._status.last:
            await self.start(deadline)
        self._state.want_running(True)
        await self._status.until(runs_not_busy, deadline, "Running and not BUSY")

    async def switch(self, application: int | str, deadline: float, *, start: bool) -> None:
        """Stop if needed, switch, wait until not BUSY, start if wanted.

        Args:
            application: id of the application, or the name of its file.
            deadline: loop time.
            start: enter run mode afterwards, if the camera has one.

        Raises:
            UnsupportedError: the dialect loads no applications, or none by name.
            CommandRejectedError: the camera refused; the old application runs again if it ran.
        """
        request = self.make_load_request(application)
        dialect = self._connection.dialect
        can_stop = dialect.has(m.Stop)
        was_running = self.is_in_run_mode and can_stop
        # 0 is forbidden, since several applications may have it (SC manual p. 34, published), so
        # the camera need not be stopped
        is_forbidden = application == 0 and 0 not in dialect.application_ids
        active: int | None
        if can_stop and is_forbidden:
            code, active = 1, await self.query_application(deadline)
        else:
            if was_running:
                await self._leave_run_mode(deadline)
            code, active = await self._load(request, application, deadline)
        is_done = dialect.code(code).verdict is Verdict.DONE
        if not is_done or (isinstance(application, int) and active != application):
            if was_running and Status.RUNNING not in self._status.last:
                await self._enter_run_mode(deadline)
            refusal = (
                f"the camera refused to switch to application {application}: "
                f"{code_text(dialect, code, type(request))}"
            )
            if is_forbidden:
                refusal = "no application may have the id 0"
            elif is_done:
                refusal = f"the camera says it switched, but not to application {application}"
            raise CommandRejectedError(
                f"{self._connection.name}: {refusal}; application {active} is active",
                message_id=dialect.message_id(request),
                code=code,
                active_application=active,
            )
        await self._status.refresh(deadline)
        await self._status.until(_is_not_busy, deadline, "not BUSY")
        if start and can_stop:
            await self.start(deadline)

    async def _load(
        self, request: m.Request, application: int | str, deadline: float
    ) -> tuple[int, int | None]:
        """Load an application; return the answer's code, and the application active then."""
        requests = self._requests
        answer = await requests.ask(request, m.SwitchAnswer, deadline)
        while requests.is_busy(answer):
            await self._status.pause(deadline, f"the busy camera to load {application}")
            answer = await requests.ask(request, m.SwitchAnswer, deadline)
        is_known = answer.application in self._connection.dialect.application_ids
        return answer.code, answer.application if is_known else self._state.active

    def make_load_request(self, application: int | str) -> m.Request:
        """Return the request that loads an application; send nothing.

        Raises:
            ConfigurationError: the dialect can have no such application.
            UnsupportedError: the camera loads no applications, or none by name.
        """
        name = self._connection.name
        if isinstance(application, str):
            self._connection.require(m.LoadFile)
            if not application.isprintable():
                raise ConfigurationError(
                    f"{name}: expected a file's name of printable characters, got {application!r}"
                )
            return m.LoadFile(name=application.encode())
        self._connection.require(m.SwitchApplication)
        self.check_id(application)
        return m.SwitchApplication(application=application)

    def check_id(self, application: int) -> None:
        """Check that an id is one of the dialect's; 0 is not checked, since the camera refuses it.

        Raises:
            ConfigurationError: the dialect has no such id.
        """
        ids = self._connection.dialect.application_ids
        if application != 0 and application not in ids:
            raise ConfigurationError(
                f"{self._connection.name}: application id {application} is not {ids.start} to "
                f"{ids.stop - 1}"
            )


def _is_not_loading(status: Status) -> bool:
    return not status.loading


def _is_not_running(status: Status) -> bool:
    return Status.RUNNING not in status


def _is_not_busy(status: Status) -> bool:
    return Status.BUSY not in status
