"""The client of one camera, which talks to the camera itself.

``open()`` starts the :class:`~smartcam._client.supervisor.Supervisor`, which makes sessions and
passes every chunk that they receive to the :class:`~smartcam._client.dispatch.Dispatch`. The
commands are here; each sends a few messages and waits with a deadline.
"""

from __future__ import annotations

import contextlib
from dataclasses import replace
from datetime import datetime
from typing import TYPE_CHECKING

from smartcam._client.camera_state import CameraState
from smartcam._client.command_lock import CommandLock
from smartcam._client.commands import Commands
from smartcam._client.connection import Connection
from smartcam._client.dispatch import Dispatch
from smartcam._client.keepalive import KeepAlive
from smartcam._client.polling import Polling
from smartcam._client.requests import Requests
from smartcam._client.results import Results
from smartcam._client.status import StatusRequests, runs_not_busy
from smartcam._client.supervisor import Supervisor
from smartcam._client.triggering import TriggerRequest, Triggers
from smartcam._client.waits import Waits
from smartcam.camera import Camera
from smartcam.exceptions import (
    ConnectionClosedError,
    InterpretationError,
    LocalProtocolError,
    ResponseTimeoutError,
    SmartCamError,
    TriggerTimeoutError,
)
from smartcam.models import Capabilities, Result, Status, ValueT
from smartcam.protocols import Transport
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Coroutine, Iterable
    from typing import Any, Self

    from smartcam.observers import Observer
    from smartcam.settings import Address, CameraSettings


__all__ = ["SmartCamera"]


class SmartCamera(Camera[ValueT]):
    """A camera that is connected directly: this client has the only session with it.

    Once another client has taken the camera, this client has ended: every method that needs a
    session raises :exc:`~smartcam.ConnectionTakenError`. Make a new client then.
    """

    def __init__(self, settings: CameraSettings, *, observers: Iterable[Observer] = ()) -> None:
        super().__init__(settings, observers=observers)
        counters, listeners = self._counters, self._listeners
        self._state = state = self._make_state()
        self._waits = waits = Waits(counters)
        self._connection = connection = Connection(settings.name, waits)
        answer_timeout, switch_timeout = settings.request_timeout, settings.switch_timeout
        self._requests = requests = Requests(
            connection, waits, state, answer_timeout, switch_timeout
        )
        polling = Polling(connection, requests, state, waits, listeners, answer_timeout)
        self._status = status = StatusRequests(connection, requests, polling, state, waits)
        self._commands = commands = Commands(connection, requests, status, state)
        self._results = results = Results(settings.name, self._default, state, listeners, counters)
        self._dispatch = Dispatch(
            settings.name, state, waits, results, listeners, requests, counters
        )
        self._triggers = Triggers(
            connection, requests, status, commands, results, state, waits, polling
        )
        self._lock = CommandLock(connection, commands, status, state, waits, switch_timeout)
        keepalive = KeepAlive(requests, waits, state, settings.liveness_timeout, switch_timeout)
        self._supervisor = Supervisor(
            settings,
            connection,
            commands,
            self._lock,
            self._dispatch,
            waits,
            listeners,
            counters,
            keepalive,
            self._observers,
        )

    def _make_state(self) -> CameraState:
        return CameraState(self.settings.name, self.settings.application, self._listeners)

    def _use_address(self, address: Address) -> None:
        """Use another address than the settings' one; only before the client is opened."""
        self.settings: CameraSettings = replace(self.settings, address=address)
        self._supervisor.use_settings(self.settings)

    def _set_interpreter(self, spec: object) -> None:
        super()._set_interpreter(spec)
        self._results.interpretation = self._default

    def _require_session(self) -> None:
        self._connection.require_link()

    def _deadline(self, timeout: float) -> float:
        return self._connection.deadline(timeout)

    def _on_listener_added(self, subscribers: object) -> None:
        self._status.start_polling()

    def _release_unreferenced(self) -> bool:
        supervisor: Supervisor | None = getattr(self, "_supervisor", None)
        return supervisor is not None and supervisor.abandon()

    def _end_of_streams(self) -> tuple[SmartCamError | None] | None:
        end = self._waits.end_reason
        if end is None or not self._supervisor.has_ended:
            return None  # between two sessions, streams wait for the next one
        return (None if isinstance(end, ConnectionClosedError) else end,)

    async def open(self) -> Self:
        if self._supervisor.started or self._waits.end_reason is not None:
            raise LocalProtocolError(f"{self.name}: opened or closed before; make a new one")
        try:
            await self._supervisor.open()
            if self.settings.application is not None:
                async with self._lock.hold(self.settings.switch_timeout) as deadline:
                    await self._commands.ensure_running(self.settings.application, deadline)
        except BaseException:
            await self.close()
            raise
        return self

    async def close(self) -> None:
        await self._supervisor.close()

    async def _wait_connected(self, timeout: float) -> None:
        await self._supervisor.wait_connected(self._connection.deadline(timeout), timeout)

    @property
    def url(self) -> str:
        return self._supervisor.address.url

    @property
    def connected(self) -> bool:
        return self._supervisor.connected

    @property
    def status(self) -> Status:
        if self._state.status is None:
            raise self._supervisor.closed_error()
        return self._state.status

    @property
    def active_application(self) -> int | None:
        return self._state.active

    @property
    def protocol_version(self) -> int | None:
        session = self._supervisor.session
        return session.version if session is not None else None

    @property
    def capabilities(self) -> Capabilities:
        session = self._supervisor.session
        if session is None:
            raise self._supervisor.closed_error()
        return session.dialect.capabilities

    async def _wait_status(self, predicate: Callable[[Status], bool], timeout: float) -> Status:
        deadline = self._connection.deadline(timeout)
        self._connection.require_link()
        await self._status.refresh(deadline)
        return await self._status.until(predicate, deadline, "the status wanted", asks_again=False)

    async def _wait_ready(self, timeout: float) -> Status:
        deadline = self._connection.deadline(timeout)
        self._connection.require_link()
        await self._status.refresh(deadline)
        predicate = runs_not_busy if self._state.wanted.running else _is_not_busy
        return await self._status.until(predicate, deadline, "the camera to be ready")

    async def _trigger(
        self, application: int | None, request: TriggerRequest, timeout: float
    ) -> list[Result]:
        lock, triggers = self._lock, self._triggers
        try:
            if application is not None:
                async with lock.hold_in(application, timeout) as deadline:
                    return await triggers.trigger(request, deadline, timeout)
            deadline = self._connection.unchecked_deadline(timeout)
            await lock.wait_for_turn(deadline, timeout)  # same effect as hold(), without an object
            try:
                return await triggers.trigger(request, deadline, timeout)
            finally:
                lock.release_turn()
        except ResponseTimeoutError as exc:
            raise TriggerTimeoutError(f"{exc}; no trigger was sent", waited=exc.waited) from exc

    async def _switch_application(self, application: int | str, timeout: float) -> None:
        async with self._lock.hold(timeout) as deadline:
            self._commands.make_load_request(application)  # raises if it cannot be loaded
            await self._status.refresh(deadline)
            await self._commands.switch(application, deadline, start=self._commands.is_in_run_mode)

    @contextlib.asynccontextmanager
    async def _in_application(self, application: int) -> AsyncGenerator[Self]:
        async with self._lock.hold(self.settings.switch_timeout) as deadline:
            state_before = await self._lock.enter_application(application, deadline)
        try:
            yield self
        except BaseException:
            self._lock.go_back(state_before)
            raise
        await self._lock.go_back_and_wait(state_before)

    async def _start(self, timeout: float) -> None:
        async with self._lock.hold(timeout) as deadline:
            await self._commands.start(deadline)

    async def _stop(self, timeout: float) -> None:
        async with self._lock.hold(timeout) as deadline:
            await self._commands.stop(deadline)

    def _query_application(self, timeout: float) -> Coroutine[Any, Any, int]:
        return self._commands.query_application(self._connection.unchecked_deadline(timeout))

    async def _query_status(self, timeout: float) -> Status:
        self._connection.require(m.GetStatus)
        await self._status.refresh(self._connection.deadline(timeout))
        return self._status.last

    async def _reset_errors(self, timeout: float) -> Status:
        deadline = self._connection.deadline(timeout)
        await self._requests.command(m.ResetErrors(), deadline)
        await self._status.refresh(deadline)
        return self._status.last

    async def _read_image(self, timeout: float) -> bytes:
        self._connection.require(m.ReadImage)
        image = await self._requests.ask(m.ReadImage(), m.Image, self._connection.deadline(timeout))
        self._requests.check(m.ReadImage, image)
        return image.data

    async def _get_clock(self, timeout: float) -> datetime:
        clock = await self._requests.ask(
            m.GetClock(), m.ClockAnswer, self._connection.deadline(timeout)
        )
        self._requests.check(m.GetClock, clock)
        fields = (clock.year, clock.month, clock.day, clock.hour, clock.minute, clock.second)
        try:
            return datetime(*fields)  # noqa: DTZ001 - the camera's clock has no zone
        except (ValueError, OverflowError) as exc:
            raise InterpretationError(
                f"{self.name}: the camera's clock is no date: {fields}",
                field="clock",
                expected="a date and time",
                got=fields,
            ) from exc

    async def _set_clock(self, when: datetime) -> None:
        await self._send(
            m.SetClock(
                year=when.year,
                month=when.month,
                day=when.day,
                hour=when.hour,
                minute=when.minute,
                second=when.second,
            )
        )

    async def _set_input(self, data: bytes) -> None:
        await self._send(m.SetInput(data=data))

    async def _set_sequence_number(self, number: int) -> None:
        await self._send(m.SetSequenceNumber(number=number))
        self._triggers.set_next_number(number)

    async def reboot(self) -> None:
        link = self._connection.require_link()
        self._connection.require(m.Reboot)
        self._supervisor.expect_restart(link)
        await self._send(m.Reboot())
        if link.machine.transport is Transport.TCP:
            await link.wait_closed(self.settings.close_timeout)
        # over UDP nothing shows that the session has ended; over TCP it may be shown too late
        link.abort(ConnectionResetError("the camera restarts"))
        self._dispatch.fail(link.lost_error())

    async def _request(
        self, message_id: int | str, payload: bytes, answered: bool | None, timeout: float
    ) -> bytes | None:
        dialect = self._connection.dialect
        raw = dialect.raw_request(message_id, payload)
        deadline = self._connection.deadline(timeout)
        if raw.expects_answer if answered is None else answered:
            return dialect.body(await self._requests.exchange(raw.message, raw.answer, deadline))
        if raw.expects_answer and raw.known:
            # the camera still answers, and its answer must not be taken for the next request's
            await self._requests.post(raw.message, raw.answer, deadline)
        else:
            await self._requests.send_unanswered(raw.message, deadline, answered=False)
        return None

    async def _send(self, message: m.Request) -> None:
        await self._requests.command(
            message, self._connection.deadline(self.settings.request_timeout)
        )


def _is_not_busy(status: Status) -> bool:
    return Status.BUSY not in status
