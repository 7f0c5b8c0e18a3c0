"""What the camera is known to be, and what was asked of it; over all sessions of a client."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from smartcam.models import ApplicationChanged, Status
from smartcam.protocols.messages import SwitchAnswer

if TYPE_CHECKING:
    from collections.abc import Container
    from datetime import datetime

    from smartcam._client.listeners import Listeners
    from smartcam.protocols.messages import StatusReport

# as plain integers: what an IntFlag does in Python costs more than all else that a status needs
_BUSY = int(Status.BUSY)
_RUNNING_OR_BUSY = int(Status.RUNNING | Status.BUSY)


class Wanted(NamedTuple):
    """What was asked of the camera.

    Attributes:
        application: the application that was named, None where none was.
        running: the run state that was asked for, None where none was.
    """

    application: int | None
    running: bool | None


class CameraState:
    """The camera's state; it is changed by its methods only.

    Args:
        name: the camera's name.
        application: the one that results are expected from, None for any.
        listeners: who is told of another application.
        shared: others use the camera, too, each of whom may expect another one.

    Attributes:
        status: the last one, None before the first; after a loss the one of before.
        bits: the same as a plain integer, 0 before the first.
        endian: what the last status said of the byte order.
        active: the application that is active as far as is known.
        wanted: what was asked of the camera.
        expected: the application that results are to be of, whoever gets them; None for any.
        active_in_doubt: somebody else loaded an application.
        loads_by_others: how often somebody else did.
        statuses_heard: how many statuses have come.
    """

    def __init__(
        self, name: str, application: int | None, listeners: Listeners, *, shared: bool = False
    ) -> None:
        self.status: Status | None = None
        self.bits: int = 0
        self.endian: int = 0
        self.active: int | None = None
        self.shared: bool = shared
        self.want(Wanted(application, None))
        self.active_in_doubt: bool = False
        self.loads_by_others: int = 0
        self.statuses_heard: int = 0
        self._name = name
        self._listeners = listeners
        self._told: int | None = None  # the last status of this session
        self._loaded_by_us = False

    def begin_session(self) -> None:
        """Forget what only the session before has told."""
        self._told, self.active_in_doubt = None, False

    def report(self, report: StatusReport, awaited: Container[object]) -> int | None:
        """Take a status.

        Args:
            report: it.
            awaited: the kinds of answers that are awaited, one to a switch of ours among them.

        Returns:
            The one before, None where there was none in this session.
        """
        status = report.status
        # int(status) costs three times as much, with each status that comes
        bits, was = status._value_, self._told
        self.statuses_heard += 1
        self.status, self.endian = status, report.endian
        self.bits = self._told = bits
        if bits & _RUNNING_OR_BUSY == _BUSY:  # it loads an application
            self._loaded_by_us = False
        elif (
            was is not None
            and was & _RUNNING_OR_BUSY == _BUSY
            and not (self._loaded_by_us or SwitchAnswer in awaited)
        ):
            self.active_in_doubt = True
            self.loads_by_others += 1
        return was

    def set_active(self, application: int, at: datetime) -> None:
        """Note which application is active."""
        previous, self.active = self.active, application
        if previous != application:
            self._listeners.publish(
                ApplicationChanged(
                    camera=self._name, at=at, application=application, previous=previous
                )
            )

    def switched(self, application: int) -> None:
        """Note that the camera has done a switch of ours."""
        self.want_application(application)
        self._loaded_by_us = True

    def asked(self) -> None:
        """Note that the camera was asked which application is active."""
        self.active_in_doubt = False

    def want(self, wanted: Wanted) -> None:
        """Note what the camera is to be."""
        self.wanted: Wanted = wanted
        self.expected: int | None = None if self.shared else wanted.application

    def want_application(self, application: int) -> None:
        """Note from which application results are expected."""
        self.want(self.wanted._replace(application=application))

    def want_running(self, running: bool) -> None:
        """Note which run state was asked for."""
        self.want(self.wanted._replace(running=running))
