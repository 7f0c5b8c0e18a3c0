"""Define the client with which an agent shares a camera; it does not interpret results.

Each program interprets containers by itself. So at the agent a result's ``value`` is a
:class:`RawValue`; the container's bytes are in the result's ``raw``. If a program's layout has a
field ``@sequence``, the agent reads this field.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._client._inside import (
    CameraState,
    Interpretation,
    Interpreted,
    Listeners,
    new_tuple,
)
from smartcam.client import SmartCamera
from smartcam.exceptions import ResponseTimeoutError, SmartCamError, TriggerTimeoutError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from smartcam._client._inside import TriggerRequest
    from smartcam.models import CameraEvent, Result, Status
    from smartcam.observers import Observer
    from smartcam.protocols.messages import ResultContainer
    from smartcam.settings import CameraSettings


class Owner(NamedTuple):
    """The owner of a trigger: the numbers of the program and of its call; 0 without an owner."""

    program: int
    call: int


NO_OWNER = Owner(0, 0)


class RawValue(NamedTuple):
    """The value of a result at an agent: its trigger's owner, and the container's cells as JSON."""

    owner: Owner
    cells: bytes


class AgentInterpretation(Interpretation):
    """An interpretation that reads nothing from a container but ``@sequence``, if a layout has it.

    Args:
        owner: owner of the trigger of the results.
        layouts: a layout with ``@sequence``, or such layouts by application; None for none.
        by_application: whether the program has an interpretation for each application.
    """

    def __init__(
        self, owner: Owner = NO_OWNER, layouts: Any = None, *, by_application: bool = False
    ) -> None:
        super().__init__(layouts, lenient=True, y_down=False)
        self._raw_value = RawValue(owner, b"")
        self.by_application = by_application

    def for_owner(self, owner: Owner) -> AgentInterpretation:
        """Return a copy for another owner's trigger; this is faster than a new object."""
        other = AgentInterpretation.__new__(AgentInterpretation)
        other.__dict__ = {**self.__dict__, "_raw_value": new_tuple(RawValue, (owner, b""))}
        return other

    def __call__(
        self, container: ResultContainer, endian: int, *, camera: str, number: int, at: datetime
    ) -> Interpreted:
        if container.cells is None and container.fault is None:
            return self._raw_value, None, 0
        text = json.dumps({"cells": container.cells, "fault": container.fault}).encode()
        return self._raw_value._replace(cells=text), None, 0

    def burst(
        self,
        application: int,
        payloads: list[bytes],
        endian: int,
        *,
        camera: str,
        number: int,
        at: datetime,
    ) -> tuple[Sequence[Any], int]:
        return [self._raw_value] * len(payloads), 0


class AgentCallbacks(NamedTuple):
    """The agent's callbacks for one of its cameras."""

    on_results: Callable[[Sequence[Result[RawValue]], bool, bool], None]  # results, current, late
    on_status: Callable[[Status], None]
    on_event: Callable[[CameraEvent], None]
    on_end: Callable[[], None]
    on_taken_by_other: Callable[[], None]


class AgentListeners(Listeners):
    """The listeners of an agent's client; events and results also go to the agent's callbacks."""

    wants_all_changes = True
    callbacks: AgentCallbacks | None = None

    @property
    def results_only_streamed(self) -> bool:  # results need not be offered one by one
        return True

    @property
    def wants_results(self) -> bool:
        return True

    @property
    def wants_statuses(self) -> bool:
        return True

    @property
    def needs_polling(self) -> bool:
        return True

    def publish(self, event: CameraEvent) -> None:
        super().publish(event)
        if self.callbacks is not None:
            self.callbacks.on_event(event)

    def end(self, error: SmartCamError | None) -> None:
        super().end(error)
        if self.callbacks is not None:
            self.callbacks.on_end()

    def offer_status(self, status: Status, now: float) -> None:
        Listeners.offer_status(self, status, now)  # faster than super()
        if self.callbacks is not None:
            self.callbacks.on_status(status)

    def offer_burst(self, results: Sequence[Result], now: float, size: int) -> None:
        super().offer_burst(results, now, size)
        if self.callbacks is not None:
            self.callbacks.on_results(results, True, False)

    def offer_result(self, result: Result, now: float, *, current: bool, late: bool) -> None:
        Listeners.offer_result(self, result, now, current=current, late=late)
        if self.callbacks is not None:
            self.callbacks.on_results((result,), current, late)


class AgentClient(SmartCamera[RawValue]):
    """A camera that its agent shares.

    Args:
        settings: validated options; ``interpret_as`` in them is not used here, but by programs.
        callbacks: the agent's callbacks for the session.
        observers: observers of the session; a result's value is a :class:`RawValue`.
    """

    def __init__(
        self,
        settings: CameraSettings,
        callbacks: AgentCallbacks,
        observers: Iterable[Observer] = (),
    ) -> None:
        super().__init__(settings, observers=observers)
        self._listeners.callbacks = callbacks
        self._supervisor.on_taken = callbacks.on_taken_by_other

    _listeners: AgentListeners

    def _make_listeners(self) -> Listeners:
        return AgentListeners(self.settings.name, self._observers)

    def _make_state(self) -> CameraState:
        settings = self.settings
        return CameraState(settings.name, settings.application, self._listeners, shared=True)

    def _interpretation(self, spec: object, *, of_camera: bool = False) -> Interpretation:
        return AgentInterpretation()

    @property
    def is_taken(self) -> bool:
        """True if another client has the camera."""
        return self._supervisor.taken

    def try_take_back(self) -> None:
        """Try now to take the camera back if another client has it."""
        self._supervisor.take_back()

    @property
    def endian(self) -> int:
        """The byte order in the camera's last status."""
        return self._state.endian

    async def trigger_for(
        self, request: TriggerRequest, application: int | None, timeout: float
    ) -> list[Result[RawValue]]:
        """Trigger for a program, like :meth:`trigger`.

        Args:
            request: options of the trigger.
            application: application that must run for the trigger; None for any.
            timeout: seconds of the timeout.

        The camera may still have queued the input data of an earlier trigger that had no result. If
        so, and this trigger has input data, the application is loaded again first, which empties
        the camera's queue.
        """
        if not self._has_observers and request.input_data is None:
            return await self._trigger(application, request, timeout)
        called_at = datetime.now(UTC)
        try:
            return await self._trigger_without_old_input(application, request, timeout)
        except SmartCamError as error:
            self._observers.error(self.name, error, called_at)
            raise

    async def _trigger_without_old_input(
        self, application: int | None, request: TriggerRequest, timeout: float
    ) -> list[Result[RawValue]]:
        if request.input_data is not None and self._results.input_in_doubt:
            started_at = self._deadline(0.0)  # a deadline in 0 s is the present time
            try:
                await self._lock.load_again(lambda: self._results.input_in_doubt, timeout)
            except ResponseTimeoutError as exc:
                text = f"{exc}; no trigger was sent"
                raise TriggerTimeoutError(text, waited=exc.waited) from exc
            timeout = max(0.0, timeout - (self._deadline(0.0) - started_at))
        return await self._trigger(application, request, timeout)

    async def ensure_application(self, application: int, timeout: float) -> None:
        """Make sure that an application is loaded and runs, like ``application=`` of connect()."""
        async with self._lock.hold(timeout) as deadline:
            await self._commands.ensure_running(application, deadline)

    async def enter_application(self, application: int, timeout: float) -> Any:
        """Switch temporarily; return the argument for :meth:`leave_application`."""
        async with self._lock.hold(timeout) as deadline:
            return await self._lock.enter_application(application, deadline)

    def leave_application(self, before: Any) -> None:
        """Switch back in the background."""
        self._lock.go_back(before)

    async def leave_application_and_wait(self, before: Any) -> None:
        """Switch back, and wait until this is done."""
        await self._lock.go_back_and_wait(before)

    async def refresh_status(self, timeout: float) -> bool:
        """Make sure that the known status is current; return whether the camera had to be asked."""
        deadline = self._deadline(timeout)
        self._require_session()
        await self._status.refresh(deadline)
        return self._connection.features.polled
