"""The streams that a server offers, and its counts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from smartcam.frames._streaming.rtsp.packing import UnitCutter

if TYPE_CHECKING:
    from smartcam.frames._streaming.shared_stream import SharedH264


@dataclass(frozen=True, slots=True)
class RtspStatistics:
    """Counts of one stream since its server was started.

    Attributes:
        viewers: number of present viewers.
        encoded: frames encoded, each once for all viewers; a source with two names has one count.
        keys: key frames among the frames encoded.
        failed: frames that could not be encoded.
        sent: frames sent to all viewers together.
        skipped: frames that a viewer was too slow for, all viewers together.
        stalled: viewers that were cut off since they took nothing.
        silent: viewers that were cut off since nothing was heard of them.
    """

    viewers: int
    encoded: int
    keys: int
    failed: int
    sent: int
    skipped: int
    stalled: int
    silent: int


@dataclass(slots=True, eq=False)
class RtspStream:
    """One name of a server's."""

    name: str
    shared: SharedH264
    rate: float
    cutter: UnitCutter = field(default_factory=UnitCutter)
    viewers: int = 0
    sent: int = 0
    skipped: int = 0
    stalled: int = 0
    silent: int = 0

    def statistics(self) -> RtspStatistics:
        """Return the counts of the stream."""
        counts = self.shared.counts
        return RtspStatistics(
            viewers=self.viewers,
            encoded=counts.encoded,
            keys=counts.keys,
            failed=counts.failed,
            sent=self.sent,
            skipped=self.skipped,
            stalled=self.stalled,
            silent=self.silent,
        )
