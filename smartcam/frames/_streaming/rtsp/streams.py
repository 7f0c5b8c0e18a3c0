"""The streams of a server, with their counts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from smartcam.frames._streaming.rtsp.packing import FramePacketizer

if TYPE_CHECKING:
    from smartcam.frames._streaming.shared_stream import SharedH264


@dataclass(frozen=True, slots=True)
class RtspStatistics:
    """Counts of one stream since its server was started.

    Attributes:
        viewers: number of present viewers.
        encoded: encoded frames, once for all viewers; a source with two names has one count.
        keys: key frames among the encoded frames.
        failed: frames that failed to encode.
        sent: frames sent, summed over all viewers.
        skipped: frames skipped for slow viewers, summed over all viewers.
        stalled: viewers disconnected because they accepted no data.
        silent: viewers disconnected because they sent no request or report.
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
    """A named stream of a server."""

    name: str
    shared_h264: SharedH264
    rate: float
    packetizer: FramePacketizer = field(default_factory=FramePacketizer)
    viewer_count: int = 0
    sent: int = 0
    skipped: int = 0
    stalled: int = 0
    silent: int = 0

    def statistics(self) -> RtspStatistics:
        """Return the counts of the stream."""
        counts = self.shared_h264.counts
        return RtspStatistics(
            viewers=self.viewer_count,
            encoded=counts.encoded,
            keys=counts.key_frames,
            failed=counts.failed,
            sent=self.sent,
            skipped=self.skipped,
            stalled=self.stalled,
            silent=self.silent,
        )
