"""Find the picture of each result of a software camera."""

from __future__ import annotations

import collections
from typing import TYPE_CHECKING, Final, NamedTuple

from smartcam.models import Connected, Disconnected, Reconnected
from smartcam.observers import Observer

if TYPE_CHECKING:
    from collections.abc import Callable
    from datetime import datetime

    from smartcam.emulator._inside import LastReport
    from smartcam.inspection._camera.frame_inspector import Judged
    from smartcam.models import CameraEvent, Result

MAX_PICTURES_KEPT: Final = 8
"""Number of last results whose pictures are kept, which bounds the memory."""

MAX_PENDING: Final = 64
"""Largest number of sent containers whose results have not arrived yet."""


class _SentContainer(NamedTuple):
    """A container that the device has sent, with its picture."""

    data: bytes
    judged: Judged


class JudgedResults(Observer):
    """Find the picture of each result that a client gets from a device in this process.

    Device and client count the containers of their session, which arrive in order and complete. A
    result gets no picture if its bytes differ from the container's.

    Args:
        session: function that returns the number of the device's session (0: no session) and the
            last report of a run.
        received: function that returns the number of containers that the client has received.
        on_found: function that is called with each result and its picture, before other observers
            get the result.
        max_kept: number of last results whose pictures are kept for :meth:`judged_of`.
    """

    def __init__(
        self,
        session: Callable[[], tuple[int, LastReport | None]],
        received: Callable[[], int],
        on_found: Callable[[Result, Judged], None],
        *,
        max_kept: int = MAX_PICTURES_KEPT,
    ) -> None:
        self._session, self._received, self._on_found = session, received, on_found
        self._max_kept = max_kept
        self._number = 0  # number of the session
        self._sent = 0  # number of containers sent in the session
        self._report: LastReport | None = None
        self._before = 0  # number of containers that the client received before the session
        self._pending: dict[int, _SentContainer] = {}  # containers by their count in the session
        self._judged: collections.OrderedDict[tuple[int, datetime], Judged] = (
            collections.OrderedDict()
        )

    def take(self, judged: Judged) -> None:
        """Record the picture of the container that the device has just sent."""
        number, report = self._session()
        if number != self._number:
            self._number, self._sent = number, 0
            self._pending.clear()
        new, self._report = report is not self._report, report
        if number and new and report is not None:
            self._sent += 1
            self._pending[self._sent] = _SentContainer(report.result.data, judged)
            self._pending.pop(self._sent - MAX_PENDING, None)

    def on_state(self, event: CameraEvent) -> None:
        """Restart the count with each session."""
        if isinstance(event, (Connected, Reconnected)):
            self._before = self._received()
        elif isinstance(event, Disconnected):
            self._pending.clear()

    def on_result(self, result: Result) -> None:
        """Find the picture of a result."""
        count = result.number - self._before
        sent = self._pending.pop(count, None)
        for older in [key for key in self._pending if key < count]:
            del self._pending[older]  # their results were not awaited
        if sent is None or (sent.data, sent.judged.application) != (result.raw, result.application):
            return
        self._judged[result.number, result.received_at] = sent.judged
        if len(self._judged) > self._max_kept:
            self._judged.popitem(last=False)
        self._on_found(result, sent.judged)

    def judged_of(self, result: Result) -> Judged | None:
        """Return the picture of a recent result; None if it is no longer kept."""
        return self._judged.get((result.number, result.received_at))
