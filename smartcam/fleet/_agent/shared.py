"""The client of a shared camera at its agent, whose results are the containers themselves.

Each program interprets containers by itself, so here the value of a result is the container, with
the owner of its trigger. A layout is used only for its ``@sequence``.
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
    """The owner of a trigger: the program's number at its agent, and the call's. 0 for no owner."""

    program: int
    call: int


NOBODY = Owner(0, 0)


class Carried(NamedTuple):
    """The value of a result at an agent: its owner, and the texts that made up the container."""

    owner: Owner
    cells: bytes


class Carrier(Interpretation):
    """Reads only the sequence number of a container, if ``layouts`` have one.

    Args:
        owner: owner of the trigger of the results.
        layouts: a layout with ``@sequence``, or such layouts by application; None for none.
        by_application: whether the program has an interpretation for each application.
    """

    def __init__(
        self, owner: Owner = NOBODY, layouts: Any = None, *, by_application: bool = False
    ) -> None:
        super().__init__(layouts, lenient=True, y_down=False)
        self._carried = Carried(owner, b"")
        self.by_application = by_application

    def of(self, owner: Owner) -> Carrier:
        """Return a copy for another owner's trigger, which is cheaper than a new object."""
        other = Carrier.__new__(Carrier)
        other.__dict__ = {**self.__dict__, "_carried": new_tuple(Carried, (owner, b""))}
        return other

    def __call__(
        self, container: ResultContainer, endian: int, *, camera: str, number: int, at: datetime
    ) -> Interpreted:
        if container.cells is None and container.fault is None:
            return self._carried, None, 0
        text = json.dumps({"cells": container.cells, "fault": container.fault}).encode()
        return self._carried._replace(cells=text), None, 0

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
        return [self._carried] * len(payloads), 0


class Tap(NamedTuple):
    """The agent's callbacks for one of its cameras."""

    results: Callable[[Sequence[Result[Carried]], bool, bool], None]
    status: Callable[[Status], None]
    event: Callable[[CameraEvent], None]
    end: Callable[[], None]
    taken: Callable[[], None]


class TappedListeners(Listeners):
    """Passes everything to the agent, too."""

    wants_all_changes = True
    tap: Tap | None = None

    @property
    def only_streams_results(self) -> bool:
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
        if self.tap is not None:
            self.tap.event(event)

    def end(self, error: SmartCamError | None) -> None:
        super().end(error)
        if self.tap is not None:
            self.tap.end()

    def offer_status(self, status: Status, now: float) -> None:
        Listeners.offer_status(self, status, now)  # super() would take longer than this
        if self.tap is not None:
            self.tap.status(status)

    def offer_burst(self, results: Sequence[Result], now: float, size: int) -> None:
        super().offer_burst(results, now, size)
        if self.tap is not None:
            self.tap.results(results, True, False)

    def offer_result(self, result: Result, now: float, *, current: bool, late: bool) -> None:
        Listeners.offer_result(self, result, now, current=current, late=late)
        if self.tap is not None:
            self.tap.results((result,), current, late)


class SharedCamera(SmartCamera[Carried]):
    """A camera that its agent shares.

    Args:
        settings: validated options; their interpretation is for the programs.
        tap: the agent's callbacks for the session.
        observers: observers of the session; a result's value is a :class:`Carried`.
    """

    def __init__(
        self, settings: CameraSettings, tap: Tap, observers: Iterable[Observer] = ()
    ) -> None:
        super().__init__(settings, observers=observers)
        self._listeners.tap = tap
        self._supervisor.on_taken = tap.taken

    _listeners: TappedListeners

    def _make_listeners(self) -> Listeners:
        return TappedListeners(self.settings.name, self._observers)

    def _make_state(self) -> CameraState:
        settings = self.settings
        return CameraState(settings.name, settings.application, self._listeners, shared=True)

    def _interpretation(self, spec: object, *, of_camera: bool = False) -> Interpretation:
        return Carrier()

    @property
    def taken(self) -> bool:
        """True if another client has the camera."""
        return self._supervisor.taken

    def take_again(self) -> None:
        """Try again now if another client has the camera."""
        self._supervisor.take_back()

    @property
    def endian(self) -> int:
        """The byte order in the camera's last status."""
        return self._state.endian

    async def trigger_for(
        self, request: TriggerRequest, application: int | None, timeout: float
    ) -> list[Result[Carried]]:
        """Trigger for a program, like :meth:`trigger`.

        Args:
            request: options of the trigger.
            application: application that must run for the trigger; None for any.
            timeout: seconds of the timeout.

        If the camera may still have input data queued, from a trigger without a result, the
        application is loaded again first, which empties the queue.
        """
        if not self._has_observers and request.input_data is None:
            return await self._trigger(application, request, timeout)
        called_at = datetime.now(UTC)
        try:
            return await self._trigger_in_order(application, request, timeout)
        except SmartCamError as error:
            self._observers.error(self.name, error, called_at)
            raise

    async def _trigger_in_order(
        self, application: int | None, request: TriggerRequest, timeout: float
    ) -> list[Result[Carried]]:
        if request.input_data is not None and self._results.input_in_doubt:
            begun = self._deadline(0.0)
            try:
                await self._lock.load_again(lambda: self._results.input_in_doubt, timeout)
            except ResponseTimeoutError as exc:
                text = f"{exc}; no trigger was sent"
                raise TriggerTimeoutError(text, waited=exc.waited) from exc
            timeout = max(0.0, timeout - (self._deadline(0.0) - begun))
        return await self._trigger(application, request, timeout)

    async def ensure(self, application: int, timeout: float) -> None:
        """Load and run an application, like ``application=`` at the start."""
        async with self._lock.hold(timeout) as deadline:
            await self._commands.ensure_running(application, deadline)

    async def enter(self, application: int, timeout: float) -> Any:
        """Switch like the start of :meth:`application`; return the argument for :meth:`leave`."""
        async with self._lock.hold(timeout) as deadline:
            return await self._lock.enter_application(application, deadline)

    def leave(self, before: Any) -> None:
        """Switch back in the background."""
        self._lock.go_back(before)

    async def leave_and_wait(self, before: Any) -> None:
        """Switch back, and wait for the end."""
        await self._lock.go_back_and_wait(before)

    async def refresh(self, timeout: float) -> bool:
        """Make sure that the last status is current; return whether the camera was asked."""
        deadline = self._deadline(timeout)
        self._require_session()
        await self._status.refresh(deadline)
        return self._connection.features.polled
