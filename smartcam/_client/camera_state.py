"""Keep the camera's known state and its wanted state, over all sessions of a client."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from smartcam.models import ApplicationChanged, Status
from smartcam.protocols.messages import UNNAMED_APPLICATION, SwitchAnswer

if TYPE_CHECKING:
    from collections.abc import Container
    from datetime import datetime

    from smartcam._client.listeners import Listeners
    from smartcam.protocols.messages import StatusReport

# as plain integers: an IntFlag's operations cost more than all else that is done with a status
_BUSY = int(Status.BUSY)
_RUNNING_OR_BUSY = int(Status.RUNNING | Status.BUSY)


class Wanted(NamedTuple):
    """The application and run state that the program has set.

    Attributes:
        application: the application that was named; None if none was.
        running: the run state that was requested; None if none was.
    """

    application: int | None
    running: bool | None


class CameraState:
    """The camera's state; it is changed by its methods only.

    Args:
        name: the camera's name.
        application: id of the application that results are expected from, None for any.
        listeners: listeners to which a change of the application is reported.
        shared: True if other programs use the camera, too, and may expect other applications.

    Attributes:
        status: last status, also after the link is lost; None before the first.
        bits: last status as a plain integer, 0 before the first.
        endian: byte order in the last status.
        active: id of the application that was active by the camera's last message about it.
        wanted: application and run state that the program has set.
        expected: id of the application that all results must come from; None for any.
        application_in_doubt: True after another client or a person loaded an application.
        loads_by_others: number of times that another client or a person loaded one.
        statuses_received: number of statuses received.
        status_asked_at: loop time at which the camera was last asked for its status.
    """

    def __init__(
        self, name: str, application: int | None, listeners: Listeners, *, shared: bool = False
    ) -> None:
        self.status: Status | None = None
        self.bits: int = 0
        self.endian: int = 0
        self.active: int | None = None
        self.shared: bool = shared
        self.set_wanted(Wanted(application, None))
        self.application_in_doubt: bool = False
        self.loads_by_others: int = 0
        self.statuses_received: int = 0
        self.status_asked_at: float = 0.0
        self._statuses_due = 0
        self._name = name
        self._listeners = listeners
        self._last_status: int | None = None  # the last status of this session
        self._loaded_by_us = False

    def begin_session(self) -> None:
        """Forget facts that only the previous session has reported."""
        self._last_status, self.application_in_doubt = None, False
        self._statuses_due = self.statuses_received

    def note_status(self, report: StatusReport, awaited: Container[object]) -> int | None:
        """Handle a status.

        Args:
            report: report of the status.
            awaited: types of the pending answers; ``SwitchAnswer`` among them shows that this
                client has asked for the switch.

        Returns:
            The status before, None if this session had none.
        """
        status = report.status
        # int(status) costs three times as much, with each status that comes
        bits, old_bits = status._value_, self._last_status
        self.statuses_received += 1
        self.status, self.endian = status, report.endian
        self.bits = self._last_status = bits
        if bits & _RUNNING_OR_BUSY == _BUSY:  # the camera loads an application
            self._loaded_by_us = False
        elif (
            old_bits is not None
            and old_bits & _RUNNING_OR_BUSY == _BUSY
            and not (self._loaded_by_us or SwitchAnswer in awaited)
        ):
            self.application_in_doubt = True
            self.loads_by_others += 1
        return old_bits

    def is_unchanged(self, application: int, bits: int, endian: int) -> bool:
        """Return True if the known status and application of this session equal the arguments."""
        same = self.bits == bits and self._last_status == bits and self.endian == endian
        return same and self.active == application

    def note_usual_statuses(self, report: StatusReport) -> None:
        """Handle the two statuses around a result; the second one equals the last known status."""
        self.statuses_received += 2
        self.status = report.status

    @property
    def loading(self) -> bool:
        """True while an application is being loaded, like :attr:`Status.loading`."""
        return self.bits & _RUNNING_OR_BUSY == _BUSY

    @property
    def status_is_pending(self) -> bool:
        """True if a request for the status is not answered yet."""
        return self.statuses_received < self._statuses_due

    @property
    def statuses_due(self) -> int:
        """Number of statuses that will have been received when all requests are answered."""
        return max(self._statuses_due, self.statuses_received)

    def note_status_request(self, now: float, count: int = 1) -> None:
        """Record ``count`` requests for the status, whose answers are pending."""
        self.status_asked_at = now
        self._statuses_due = self.statuses_due + count

    def note_statuses_lost(self) -> None:
        """Record that the pending statuses will not come."""
        self._statuses_due = self.statuses_received

    @property
    def active_text(self) -> str:
        """The active application in texts; an In-Sight camera's job may have no id."""
        unnamed = self.active is None or self.active == UNNAMED_APPLICATION
        return "the active application" if unnamed else f"application {self.active}"

    def set_active(self, application: int, at: datetime) -> None:
        """Record which application is active."""
        previous, self.active = self.active, application
        if previous != application and self._listeners.wants_changes:
            self._listeners.publish(
                ApplicationChanged(
                    camera=self._name, at=at, application=application, previous=previous
                )
            )

    def note_switch(self, application: int) -> None:
        """Record that the camera has loaded an application as this client asked."""
        self.want_application(application)
        self._loaded_by_us = True

    def clear_application_doubt(self) -> None:
        """End the doubt: the camera was asked which application is active."""
        self.application_in_doubt = False

    def set_wanted(self, wanted: Wanted) -> None:
        """Record the application and run state that the program has set."""
        self.wanted: Wanted = wanted
        self.expected: int | None = None if self.shared else wanted.application

    def want_application(self, application: int) -> None:
        """Record the application that results are expected from."""
        self.set_wanted(self.wanted._replace(application=application))

    def want_running(self, running: bool) -> None:
        """Record the requested run state."""
        self.set_wanted(self.wanted._replace(running=running))
