"""Results of a software camera with the pictures that they were made of."""

from __future__ import annotations

import collections
from typing import TYPE_CHECKING, Final, NamedTuple

from smartcam.models import Connected, Disconnected, Reconnected
from smartcam.observers import Observer

if TYPE_CHECKING:
    from collections.abc import Callable
    from datetime import datetime

    from smartcam.emulator._inside import LastReport
    from smartcam.inspection._camera.eyes import Judged
    from smartcam.models import CameraEvent, Result

MAX_KEPT: Final = 8
"""Last results whose pictures are kept; more would fill the memory with pictures."""

MAX_UNDER_WAY: Final = 64
"""Containers that the device has sent and whose results are still to come."""


class _SentContainer(NamedTuple):
    """A container that the device has sent, and the picture that is behind it."""

    data: bytes
    judged: Judged


class JudgedResults(Observer):
    """Finds the picture of each result that a client in this process gets from its device.

    The device and its client count the containers of their session, which come in order and none
    of which is lost. A result whose bytes are not those of the container has no picture.

    Args:
        session: function that returns the number of the device's session, 0 where it has none, and
            its last report of a run.
        received: function that returns how many containers the client has got so far.
        found: function that is called with each result whose picture is known, before others see
            the result.
        kept: number of last results whose pictures are kept for :meth:`judged_of`.
    """

    def __init__(
        self,
        session: Callable[[], tuple[int, LastReport | None]],
        received: Callable[[], int],
        found: Callable[[Result, Judged], None],
        *,
        kept: int = MAX_KEPT,
    ) -> None:
        self._session, self._received, self._found = session, received, found
        self._max_kept = kept
        self._number = 0  # of the session
        self._sent = 0  # containers in it
        self._report: LastReport | None = None
        self._before = 0  # containers that the client had got before it
        self._under_way: dict[int, _SentContainer] = {}  # containers by their count in the session
        self._kept: collections.OrderedDict[tuple[int, datetime], Judged] = (
            collections.OrderedDict()
        )

    def take(self, judged: Judged) -> None:
        """Note the picture of the container that the device has just sent."""
        number, report = self._session()
        if number != self._number:
            self._number, self._sent = number, 0
            self._under_way.clear()
        new, self._report = report is not self._report, report
        if number and new and report is not None:
            self._sent += 1
            self._under_way[self._sent] = _SentContainer(report.result.data, judged)
            self._under_way.pop(self._sent - MAX_UNDER_WAY, None)

    def on_state(self, event: CameraEvent) -> None:
        """Begin to count anew with each session, of this client or of a new one."""
        if isinstance(event, (Connected, Reconnected)):
            self._before = self._received()
        elif isinstance(event, Disconnected):
            self._under_way.clear()

    def on_result(self, result: Result) -> None:
        """Find the picture of a result."""
        count = result.number - self._before
        sent = self._under_way.pop(count, None)
        for older in [one for one in self._under_way if one < count]:
            del self._under_way[older]  # nobody waited for them
        if sent is None or (sent.data, sent.judged.application) != (result.raw, result.application):
            return
        self._kept[result.number, result.received_at] = sent.judged
        if len(self._kept) > self._max_kept:
            self._kept.popitem(last=False)
        self._found(result, sent.judged)

    def judged_of(self, result: Result) -> Judged | None:
        """Return the picture of one of the last results; None if it is not known any more."""
        return self._kept.get((result.number, result.received_at))
