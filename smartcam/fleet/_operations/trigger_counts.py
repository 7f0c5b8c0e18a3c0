"""Name the outcomes of triggers at an agent, and sum the counters of its cameras."""

from __future__ import annotations

import asyncio
import itertools
from typing import TYPE_CHECKING, Final

from smartcam.exceptions import (
    CameraBusyError,
    CameraFaultError,
    CommandRejectedError,
    ConfigurationError,
    InputContainerError,
    InterpretationError,
    LinkError,
    LocalProtocolError,
    NotRunningError,
    OvertriggeredError,
    UnsupportedError,
)
from smartcam.models import HISTOGRAM_BOUNDS, Histogram

if TYPE_CHECKING:
    from collections.abc import Iterable

    from smartcam.models import Statistics

RESULT: Final = "result"

_FAILURE_WORDS: Final[tuple[tuple[type[BaseException], str], ...]] = (
    (asyncio.CancelledError, "cancelled"),
    (TimeoutError, "timeout"),
    (NotRunningError, "not_running"),
    (CameraBusyError, "busy"),
    (OvertriggeredError, "overtriggered"),
    (InputContainerError, "input"),
    (InterpretationError, "uninterpretable"),
    (CommandRejectedError, "rejected"),  # by the camera
    (CameraFaultError, "fault"),
    (LinkError, "no_session"),
    (LocalProtocolError, "refused"),  # by the agent, like the next two
    (ConfigurationError, "refused"),
    (UnsupportedError, "refused"),
)
"""Words for the failures of triggers, by the error's class; the first match decides."""

OUTCOMES: Final = (RESULT, *dict.fromkeys(word for _, word in _FAILURE_WORDS), "other")
"""All words for the outcomes of triggers."""


def outcome_of(error: BaseException) -> str:
    """Return the word for the outcome of a trigger that failed with this error."""
    return next((word for kind, word in _FAILURE_WORDS if isinstance(error, kind)), "other")


SUMS: Final = (
    *("bytes_received", "bytes_sent", "frames_received", "frames_sent", "overtriggers"),
    *("empty_slots", "extra_results", "inspections_by_others", "ignored_datagrams"),
    *("unknown_ids", "unexpected_messages", "long_bodies"),
)
"""Counters of :class:`Statistics` that are reported as sums over all cameras."""


class Totals:
    """Sums of counters over an agent's cameras.

    The sums keep the counts of removed cameras, so that they never decrease.

    Args:
        start: sums to begin with; None: zero.

    Attributes:
        counts: sums of the counters in :data:`SUMS`.
    """

    def __init__(self, start: Totals | None = None) -> None:
        self.counts: dict[str, int] = dict.fromkeys(SUMS, 0) if start is None else {**start.counts}
        empty = Histogram(HISTOGRAM_BOUNDS, (0,) * (len(HISTOGRAM_BOUNDS) + 1))
        self.processing: Histogram = empty if start is None else start.processing
        self.round_trip: Histogram = empty if start is None else start.round_trip

    def add(self, statistics: Iterable[Statistics]) -> None:
        """Add the counters of some cameras."""
        cameras = [*statistics]
        for name in SUMS:
            self.counts[name] += sum(getattr(camera, name) for camera in cameras)
        self.processing = _sum_histograms(
            [self.processing, *(camera.processing for camera in cameras)]
        )
        self.round_trip = _sum_histograms(
            [self.round_trip, *(camera.round_trip for camera in cameras)]
        )


def _sum_histograms(histograms: list[Histogram]) -> Histogram:
    counts = tuple(map(sum, zip(*(histogram.counts for histogram in histograms), strict=True)))
    return Histogram(HISTOGRAM_BOUNDS, counts, sum(histogram.total for histogram in histograms))


def cumulative_bins(histogram: Histogram) -> list[tuple[str, float]]:
    """Return (bound, count) for each bin; as in Prometheus, a bin counts all values up to it."""
    bounds = [*map(str, histogram.bounds), "+Inf"]
    return list(zip(bounds, map(float, itertools.accumulate(histogram.counts)), strict=True))
