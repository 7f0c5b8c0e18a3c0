"""Count a stream's losses, and measure its jitter and the sender's clock."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from smartcam.frames._streaming.rtp.packets import ReportBlock
from smartcam.frames._streaming.rtp.parameters import CLOCK_RATE

if TYPE_CHECKING:
    from smartcam.frames._streaming.rtp.packets import RtpPacket, SenderReport

SECONDS_FROM_1900_TO_1970: Final = 2_208_988_800
"""Offset from NTP's epoch, 1900, to 1970, seconds."""


def ntp_time(utc: float) -> int:
    """Convert seconds since 1970 to an NTP time of 64 bits."""
    return int((utc + SECONDS_FROM_1900_TO_1970) * (1 << 32)) & 0xFFFF_FFFF_FFFF_FFFF


def middle_bits(ntp: int) -> int:
    """Return the middle 32 bits of an NTP time, which reports use."""
    return ntp >> 16 & 0xFFFF_FFFF


class Reception:
    """The counts of one stream (RFC 3550, appendices A.1, A.3 and A.8)."""

    def __init__(self, ssrc: int) -> None:
        self.ssrc = ssrc
        self.packets = 0
        self._first_sequence: int | None = None
        self._highest_sequence = 0  # highest sequence number with wraps counted
        self._transit: int | None = None
        self._jitter = 0.0
        self._last_counts = (0, 0)  # numbers of expected and received packets at the last report
        self._sender_report: tuple[SenderReport, float] | None = None

    @property
    def jitter(self) -> float:
        """Jitter of the arrival, seconds."""
        return self._jitter / CLOCK_RATE

    def count_packet(self, packet: RtpPacket, now: float) -> None:
        """Count a packet that arrived at a moment, in seconds."""
        self.packets += 1
        if self._first_sequence is None:
            self._first_sequence = self._highest_sequence = packet.sequence
        advance = (packet.sequence - self._highest_sequence + 0x8000 & 0xFFFF) - 0x8000
        if advance < 0 or (advance == 0 and self.packets > 1):
            return  # a late or repeated packet has no useful delay
        self._highest_sequence += advance
        transit = int(now * CLOCK_RATE) - packet.timestamp
        if self._transit is not None:
            difference = (transit - self._transit + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000
            self._jitter += (abs(difference) - self._jitter) / 16
        self._transit = transit

    def set_sender_report(self, report: SenderReport, now: float) -> None:
        """Set the last sender report, which came at a moment."""
        self._sender_report = (report, now)

    def make_report_block(self, now: float) -> ReportBlock:
        """Return a report block for the time since the last report."""
        expected = (
            0 if self._first_sequence is None else self._highest_sequence - self._first_sequence + 1
        )
        expected_before, received_before = self._last_counts
        expected_since, received_since = expected - expected_before, self.packets - received_before
        self._last_counts = (expected, self.packets)
        lost_since = expected_since - received_since
        fraction = 0
        if lost_since > 0 < expected_since:
            fraction = min(255, 256 * lost_since // expected_since)
        last_report, delay = 0, 0
        if self._sender_report is not None:
            report, received_at = self._sender_report
            last_report = middle_bits(report.ntp)
            delay = int(max(0.0, now - received_at) * 65536) & 0xFFFF_FFFF
        return ReportBlock(
            self.ssrc,
            fraction,
            expected - self.packets,
            self._highest_sequence & 0xFFFF_FFFF,
            int(self._jitter),
            last_report,
            delay,
        )

    def utc(self, timestamp: int) -> float | None:
        """Return a packet's time on the sender's wall clock, seconds since 1970.

        None: the sender has not reported its clock yet.
        """
        if self._sender_report is None:
            return None
        report = self._sender_report[0]
        ticks = (timestamp - report.timestamp + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000
        return report.ntp / (1 << 32) - SECONDS_FROM_1900_TO_1970 + ticks / CLOCK_RATE
