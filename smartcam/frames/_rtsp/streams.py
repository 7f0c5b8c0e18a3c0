"""What a server offers, and what was counted."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from smartcam.frames._rtsp.packing import UnitCutter

if TYPE_CHECKING:
    from smartcam.frames._shared_stream import SharedH264


@dataclass(frozen=True, slots=True)
class RtspStatistics:
    """What one stream of a server did since that was started.

    Attributes:
        viewers: who look at it now.
        encoded: frames, each once for all; a source with two names has one count.
        keys: key frames among them.
        failed: frames that could not be encoded.
        sent: frames, to all viewers together.
        skipped: frames that a viewer was too slow for, all viewers together.
        stalled: viewers that were cut off since they took nothing.
        silent: viewers that were ended since nothing was heard of them.
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
        """Return what was counted."""
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
