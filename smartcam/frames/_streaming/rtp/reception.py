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


def middle(ntp: int) -> int:
    """Return the middle 32 bits of an NTP time, which reports use."""
    return ntp >> 16 & 0xFFFF_FFFF


class Reception:
    """The counts of one stream (RFC 3550, appendices A.1, A.3 and A.8)."""

    def __init__(self, ssrc: int) -> None:
        self.ssrc = ssrc
        self.packets = 0
        self._first: int | None = None
        self._highest = 0  # highest sequence number with wraps counted
        self._transit: int | None = None
        self._jitter = 0.0
        self._before = (0, 0)  # expected and received packets at the last report
        self._sender_report: tuple[SenderReport, float] | None = None

    @property
    def jitter(self) -> float:
        """Jitter of the arrival, seconds."""
        return self._jitter / CLOCK_RATE

    def packet(self, packet: RtpPacket, now: float) -> None:
        """Count a packet that arrived at a moment, in seconds."""
        self.packets += 1
        if self._first is None:
            self._first = self._highest = packet.sequence
        ahead = (packet.sequence - self._highest + 0x8000 & 0xFFFF) - 0x8000
        if ahead < 0 or (ahead == 0 and self.packets > 1):
            return  # a late or repeated packet has no useful delay
        self._highest += ahead
        transit = int(now * CLOCK_RATE) - packet.timestamp
        if self._transit is not None:
            difference = (transit - self._transit + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000
            self._jitter += (abs(difference) - self._jitter) / 16
        self._transit = transit

    def sender(self, report: SenderReport, now: float) -> None:
        """Record a sender report that came at a moment."""
        self._sender_report = (report, now)

    def block(self, now: float) -> ReportBlock:
        """Return a report block for the time since the last report."""
        expected = 0 if self._first is None else self._highest - self._first + 1
        expected_now, received_now = expected - self._before[0], self.packets - self._before[1]
        self._before = (expected, self.packets)
        lost_now = expected_now - received_now
        fraction = min(255, 256 * lost_now // expected_now) if lost_now > 0 < expected_now else 0
        last, delay = 0, 0
        if self._sender_report is not None:
            report, at = self._sender_report
            last, delay = middle(report.ntp), int(max(0.0, now - at) * 65536) & 0xFFFF_FFFF
        return ReportBlock(
            self.ssrc,
            fraction,
            expected - self.packets,
            self._highest & 0xFFFF_FFFF,
            int(self._jitter),
            last,
            delay,
        )

    def utc(self, timestamp: int) -> float | None:
        """Return a packet's time on the sender's wall clock, seconds since 1970.

        None: the sender has not reported its clock yet.
        """
        if self._sender_report is None:
            return None
        report = self._sender_report[0]
        since = (timestamp - report.timestamp + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000
        return report.ntp / (1 << 32) - SECONDS_FROM_1900_TO_1970 + since / CLOCK_RATE
