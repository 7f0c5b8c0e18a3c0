"""Count a client's containers, events and times, over all its sessions."""

from __future__ import annotations

import bisect
import dataclasses
import operator
from typing import TYPE_CHECKING

from smartcam.models import HISTOGRAM_BOUNDS, Histogram, Statistics
from smartcam.protocols._inside import Counters

if TYPE_CHECKING:
    from collections.abc import Iterable

    from smartcam.models import SubscriberStatistics


FATES = ("triggered", "streamed", "late", "wrong_application", "uninterpretable", "unclaimed")
_WIRE = tuple(field.name for field in dataclasses.fields(Counters))
_read = operator.attrgetter(*_WIRE)


class Times:
    """Collects times for a ``Histogram``."""

    __slots__ = ("_counts", "_longest", "_shortest", "_total")

    def __init__(self) -> None:
        self._counts = [0] * (len(HISTOGRAM_BOUNDS) + 1)
        self._total = 0.0
        self._shortest = float("inf")
        self._longest = float("-inf")

    def add(self, seconds: float) -> None:
        """Count a time."""
        self._counts[bisect.bisect_left(HISTOGRAM_BOUNDS, seconds)] += 1
        self._total += seconds
        if seconds < self._shortest:
            self._shortest = seconds
        if seconds > self._longest:
            self._longest = seconds

    def histogram(self) -> Histogram:
        """Return a snapshot of the counts."""
        any_times = self._longest >= self._shortest
        return Histogram(
            HISTOGRAM_BOUNDS,
            tuple(self._counts),
            self._total,
            self._shortest if any_times else None,
            self._longest if any_times else None,
        )


class ClientCounters:
    """The counters of one client.

    Attributes:
        fates: numbers of result containers by fate; their sum is ``received``.
        received: containers received.
        empty_slots: all-zero records that interpreters skipped.
        extra_results: containers for a trigger that had its results already.
        inspections_by_others: inspections that something else has triggered.
        overtriggers: times the Overtriggered bit rose.
        notices: notices that the camera sent.
        sessions: sessions made.
        last_error: text of the last error of a link.
        round_trip: times from a request to its answer, seconds.
        processing: times from a trigger to its last result, seconds.
    """

    def __init__(self) -> None:
        self.fates: dict[str, int] = dict.fromkeys(FATES, 0)
        self.received: int = 0
        self.empty_slots: int = 0
        self.extra_results: int = 0
        self.inspections_by_others: int = 0
        self.overtriggers: int = 0
        self.notices: int = 0
        self.sessions: int = 0
        self.last_error: str | None = None
        self.round_trip: Times = Times()
        self.processing: Times = Times()
        self._wire = Counters()  # counts of the links that have ended
        self._open_wire: Counters | None = None

    def count(self, fate: str, containers: int = 1) -> None:
        """Count containers under their fate and in ``received``."""
        self.fates[fate] += containers
        self.received += containers

    def add_empty_slots(self, empty_slots: int) -> None:
        """Count all-zero records that an interpreter skipped."""
        self.empty_slots += empty_slots

    def note_extra(self, containers: int) -> None:
        """Count containers for a trigger that had its results already."""
        self.extra_results += containers

    def note_foreign_inspection(self) -> None:
        """Count an inspection that something else has triggered."""
        self.inspections_by_others += 1

    def note_overtrigger(self) -> None:
        """Count a rise of the Overtriggered bit."""
        self.overtriggers += 1

    def note_notice(self) -> None:
        """Count a notice that the camera sent."""
        self.notices += 1

    def note_loss(self, error: Exception) -> None:
        """Keep the text of a link's last error."""
        self.last_error = str(error)

    def begin_session(self, wire: Counters) -> None:
        """Count a session, and the traffic of its link from now on."""
        self.end_session()
        self.sessions += 1
        self._open_wire = wire

    def end_session(self) -> None:
        """Add the counters of a link that has ended."""
        if self._open_wire is not None:
            # copied, since the link may still change its object
            is_first = self.sessions == 1
            self._wire = Counters(*_read(self._open_wire)) if is_first else self._wire_total()
            self._open_wire = None

    def statistics(self, subscribers: Iterable[SubscriberStatistics]) -> Statistics:
        """Return everything counted so far."""
        wire = dict(zip(_WIRE, _read(self._wire_total()), strict=True))
        wire["ignored_datagrams"] = wire.pop("ignored_frames")
        return Statistics(
            received=self.received,
            **self.fates,
            **wire,
            empty_slots=self.empty_slots,
            extra_results=self.extra_results,
            inspections_by_others=self.inspections_by_others,
            overtriggers=self.overtriggers,
            notices=self.notices,
            sessions=self.sessions,
            reconnects=max(0, self.sessions - 1),
            last_error=self.last_error,
            round_trip=self.round_trip.histogram(),
            processing=self.processing.histogram(),
            subscribers=list(subscribers),
        )

    def _wire_total(self) -> Counters:
        if self._open_wire is None:
            return self._wire
        return Counters(*map(operator.add, _read(self._wire), _read(self._open_wire)))
