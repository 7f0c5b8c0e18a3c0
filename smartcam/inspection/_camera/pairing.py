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
    from smartcam.inspection._camera.frame_inspector import InspectedPicture
    from smartcam.models import CameraEvent, Result

MAX_PICTURES_KEPT: Final = 8
"""Number of latest results whose pictures are kept."""

MAX_PENDING: Final = 64
"""Largest number of sent containers whose results have not arrived yet."""


class _SentContainer(NamedTuple):
    """A container that the device has sent, with its picture."""

    data: bytes
    picture: InspectedPicture


class PictureFinder(Observer):
    """Find the picture of each result that a client gets from a device in this process.

    All containers of a session arrive, in order. So device and client both count them, and a result
    belongs to the picture with the same count. If the result's bytes differ from the container with
    this count, the result gets no picture.

    Args:
        session: function that returns the number of the device's session (0: no session), and the
            device's last report, one for each run.
        received: function that returns the number of containers that the client has received.
        on_found: function that is called with each result and its picture, before other observers
            get the result.
        max_kept: number of latest results whose pictures are kept for :meth:`find_picture`.
    """

    def __init__(
        self,
        session: Callable[[], tuple[int, LastReport | None]],
        received: Callable[[], int],
        on_found: Callable[[Result, InspectedPicture], None],
        *,
        max_kept: int = MAX_PICTURES_KEPT,
    ) -> None:
        self._get_session, self._count_received, self._on_found = session, received, on_found
        self._max_kept = max_kept
        self._session_number = 0  # 0: no session
        self._sent_count = 0  # number of containers sent in the session
        self._report: LastReport | None = None
        # number of containers that the client received before the session
        self._received_before = 0
        self._pending: dict[int, _SentContainer] = {}  # containers by their count in the session
        self._pictures: collections.OrderedDict[tuple[int, datetime], InspectedPicture] = (
            collections.OrderedDict()
        )

    def record_picture(self, picture: InspectedPicture) -> None:
        """Record the picture of the container that the device has just sent."""
        session_number, report = self._get_session()
        if session_number != self._session_number:
            self._session_number, self._sent_count = session_number, 0
            self._pending.clear()
        is_new, self._report = report is not self._report, report
        if session_number and is_new and report is not None:
            self._sent_count += 1
            self._pending[self._sent_count] = _SentContainer(report.result.data, picture)
            self._pending.pop(self._sent_count - MAX_PENDING, None)

    def on_state(self, event: CameraEvent) -> None:
        """Restart the count with each session."""
        if isinstance(event, (Connected, Reconnected)):
            self._received_before = self._count_received()
        elif isinstance(event, Disconnected):
            self._pending.clear()

    def on_result(self, result: Result) -> None:
        """Find the picture of a result."""
        count = result.number - self._received_before
        sent = self._pending.pop(count, None)
        for unmatched in [key for key in self._pending if key < count]:
            del self._pending[unmatched]  # containers that could not be interpreted
        if sent is None or sent.data != result.raw:
            return
        if sent.picture.application != result.application:
            return
        self._pictures[result.number, result.received_at] = sent.picture
        if len(self._pictures) > self._max_kept:
            self._pictures.popitem(last=False)
        self._on_found(result, sent.picture)

    def find_picture(self, result: Result) -> InspectedPicture | None:
        """Return the picture of a recent result; None if it is no longer kept."""
        return self._pictures.get((result.number, result.received_at))
