"""Store the reports of a sender's receivers, and recent packets that may be sent again."""

from __future__ import annotations

import collections
import time
from dataclasses import dataclass
from typing import Final, NamedTuple

from smartcam.frames._streaming.rtp.packets import ReceiverReport, ReportBlock
from smartcam.frames._streaming.rtp.parameters import CLOCK_RATE
from smartcam.frames._streaming.rtp.reception import middle_bits, ntp_time

RECEIVER_TIMEOUT: Final = 10.0
"""Seconds without a report after which a receiver is forgotten."""

MAX_RECEIVERS: Final = 64

MAX_KEPT_PACKETS: Final = 1024
"""Largest number of packets that are kept for requests to send them again."""

MAX_RESEND_AGE: Final = 0.2
"""Largest age, seconds, of a packet that is sent again: an older packet would come too late for its
picture."""

MAX_RESENDS: Final = 5
"""Largest number of repetitions of one packet."""


@dataclass(frozen=True, slots=True)
class RtpReceiver:
    """The last report of a receiver.

    Attributes:
        address: address of the receiver's reports, ``HOST:PORT``.
        loss: share of packets lost since the receiver's previous report, 0 to 1.
        lost: packets lost since the beginning, minus repaired ones.
        jitter: jitter of the arrival, seconds.
        round_trip: round-trip time, seconds; None: unknown.
        age: seconds since the last report.
    """

    address: str
    loss: float
    lost: int
    jitter: float
    round_trip: float | None
    age: float


class _ReportingReceiver(NamedTuple):
    address: str
    block: ReportBlock
    round_trip: float | None
    reported_at: float


class ReceiverReports:
    """The last reports of a stream's receivers.

    Args:
        ssrc: SSRC of the stream.
    """

    def __init__(self, ssrc: int) -> None:
        self._ssrc, self._empty_block = ssrc, ReportBlock(ssrc, 0, 0, 0, 0)
        self._receivers: dict[int, _ReportingReceiver] = {}

    def record(self, report: ReceiverReport, address: str) -> bool:
        """Record a report; return True if it is the first of its receiver."""
        now = time.monotonic()
        self._forget_silent_receivers(now)
        is_new = report.ssrc not in self._receivers
        if is_new and len(self._receivers) >= MAX_RECEIVERS:
            return False
        receiver = self._receivers.get(
            report.ssrc, _ReportingReceiver(address, self._empty_block, None, now)
        )
        block = next((block for block in report.blocks if block.ssrc == self._ssrc), None)
        if block is not None:  # feedback packets have no report block
            receiver = _ReportingReceiver(address, block, _round_trip(block), now)
        self._receivers[report.ssrc] = receiver._replace(reported_at=now)
        return is_new

    def remove(self, ssrc: int) -> None:
        """Forget a receiver that said goodbye."""
        self._receivers.pop(ssrc, None)

    def receivers(self) -> tuple[RtpReceiver, ...]:
        """Return the reporting receivers."""
        now = time.monotonic()
        self._forget_silent_receivers(now)
        return tuple(
            RtpReceiver(
                receiver.address,
                receiver.block.fraction / 256,
                receiver.block.lost,
                receiver.block.jitter / CLOCK_RATE,
                receiver.round_trip,
                now - receiver.reported_at,
            )
            for receiver in self._receivers.values()
        )

    def _forget_silent_receivers(self, now: float) -> None:
        self._receivers = {
            ssrc: receiver
            for ssrc, receiver in self._receivers.items()
            if now - receiver.reported_at < RECEIVER_TIMEOUT
        }


def _round_trip(block: ReportBlock) -> float | None:
    """Return RFC 3550's round-trip time, seconds; None if the block names no sender report."""
    if not block.last_report:
        return None
    ticks = middle_bits(ntp_time(time.time())) - block.last_report - block.delay & 0xFFFF_FFFF
    return ticks / 65536 if ticks < 1 << 31 else 0.0  # negative after a clock was set


class _SentPacket:
    __slots__ = ("data", "resends", "sent_at")

    def __init__(self, data: bytes) -> None:
        self.data, self.resends, self.sent_at = data, 0, time.monotonic()


class PacketHistory:
    """Recent packets, for requests to send them again."""

    def __init__(self) -> None:
        self._sent: collections.OrderedDict[int, _SentPacket] = collections.OrderedDict()

    def store(self, sequence: int, data: bytes) -> None:
        """Store a packet."""
        self._sent[sequence] = _SentPacket(data)
        if len(self._sent) > MAX_KEPT_PACKETS:
            self._sent.popitem(last=False)

    def packet_to_resend(self, sequence: int) -> bytes | None:
        """Return a packet to send again; None if it is too old or was sent too often."""
        packet = self._sent.get(sequence)
        if (
            packet is None
            or packet.resends >= MAX_RESENDS
            or time.monotonic() - packet.sent_at > MAX_RESEND_AGE
        ):
            return None
        packet.resends += 1
        return packet.data
