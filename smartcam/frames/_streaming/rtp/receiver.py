"""Receive the packets of one stream, assemble encoded frames, and send receiver reports."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import socket
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol

from smartcam.exceptions import MessageError
from smartcam.frames._streaming.rtp import packets as wire
from smartcam.frames._streaming.rtp.depacketizer import Depacketizer
from smartcam.frames._streaming.rtp.reception import Reception

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.frames._streaming.rtp.assembling import AccessUnit, UnitKind
    from smartcam.frames._streaming.rtp.packets import RtpPacket


MAX_WAITING_PACKETS: Final = 1024
"""Largest number of packets that wait for missing packets."""

CHECK_INTERVAL: Final = 0.005
"""Seconds between two checks for missing packets."""

RESEND_INTERVAL: Final = 0.02
"""Seconds after which a packet is requested again."""

MAX_PACKET_INTERVAL: Final = 0.008
"""Longest pause within a frame, seconds, before its next packet counts as missing: a loss at a
frame's end would otherwise be noticed only with the next frame."""

MAX_PACKETS_REQUESTED: Final = 256
"""Largest number of packets requested at a time; beyond it a key frame is requested."""

REORDER_GRACE: Final = 0.02
"""Seconds to wait for a late packet if the sender does not repeat packets."""

MAX_UNANSWERED_REQUESTS: Final = 4
"""Number of unanswered requests after which the sender counts as unable to repeat packets."""

MARKER_GRACE: Final = 0.05
"""Seconds for which the rest of a frame may follow an untrusted marker."""

REPORT_INTERVAL: Final = 1.0
"""Seconds between two receiver reports."""

KEY_FRAME_REQUEST_INTERVAL: Final = 0.2
"""Seconds between two requests for a key frame."""

NEW_STREAM_DELAY: Final = 1.0
"""Seconds after which another stream is accepted: after silence if it comes from the same host, and
from any host after packets without a decodable picture."""

NEW_HOST_DELAY: Final = 5.0
"""Seconds of silence after which a stream from another host is accepted."""


@dataclass(frozen=True, slots=True)
class RtpStatistics:
    """Counts of a receiver of RTP since it last began to stream.

    Attributes:
        packets: number of received packets, duplicates included.
        lost: packets that never arrived.
        repaired: packets received after a request.
        duplicates: packets that arrived twice or too late.
        damaged: incomplete encoded frames.
        overflows: number of times that frames were dropped because decoding was too slow.
        strange: datagrams from other senders or without RTP.
        jitter: jitter of the arrival, seconds.
    """

    packets: int = 0
    lost: int = 0
    repaired: int = 0
    duplicates: int = 0
    damaged: int = 0
    overflows: int = 0
    strange: int = 0
    jitter: float = 0.0


class PacketChannels(Protocol):
    """Two channels of a stream, such as sockets: one for packets, one for reports."""

    def read(
        self,
        rtp: Callable[[bytes, tuple[Any, ...]], None] | None,
        rtcp: Callable[[bytes, tuple[Any, ...]], None],
        read: Callable[[], None],
        /,
    ) -> None:
        """Call ``rtp`` and ``rtcp`` for each packet and report, and ``read`` after each batch."""
        ...

    def report(self, data: bytes, to: tuple[Any, ...], /) -> None:
        """Send a report, or drop it if it cannot be sent now."""
        ...

    def close(self) -> None:
        """Stop calling the functions."""
        ...


class StreamReceiver:
    """Receiver of a stream from a pair of channels, which :meth:`close` closes.

    Args:
        pair: unused channels.
        payload_type: payload type of the stream's packets.
        repair: seconds to wait for a missing packet after a request.
        done: function that is called with complete encoded frames.
        gone: function that is called with the reason when the sender ends the stream.
        only: addresses of accepted hosts; empty: any host.
        kind: kind of the payloads; None: H.264.
        agreed: whether the stream was negotiated: then a new stream of the same host replaces it at
            once, and missing packets are not requested.
        proofs: number of earlier frames of the sender with a right marker.

    Attributes:
        last_packet_at: time of the stream's last packet, on the loop's clock.
    """

    def __init__(
        self,
        pair: PacketChannels,
        payload_type: int,
        repair: float,
        done: Callable[[list[AccessUnit]], None],
        gone: Callable[[str], None],
        only: tuple[str, ...] = (),
        kind: UnitKind | None = None,
        *,
        agreed: bool = False,
        proofs: int = 0,
    ) -> None:
        self._pair, self._payload_type, self._repair = pair, payload_type, repair
        self._done, self._on_goodbye, self._only = done, gone, only
        self._agreed = agreed
        self._loop = asyncio.get_running_loop()
        self._depacketizer = Depacketizer(MAX_WAITING_PACKETS, kind, wary=True)
        self._depacketizer.proofs = proofs
        self._reception: Reception | None = None
        self._early: tuple[wire.SenderReport, float] | None = None  # before the first packet
        self._sender: tuple[Any, ...] = ()
        self._reports_to: tuple[Any, ...] = ()
        self._ssrc = secrets.randbits(32)
        self._cname = f"{secrets.token_hex(6)}@{socket.gethostname()}"
        self._requested_at: dict[int, float] = {}
        self._vain = 0
        self._repaired = self._strange = self._packets = 0
        self._made: list[AccessUnit] = []
        self._tick: asyncio.TimerHandle | None = None
        self._next_report: asyncio.TimerHandle | None = None
        self._picture_asked = float("-inf")
        self._began = self._shown_at = float("-inf")
        self.last_packet_at = self._loop.time()
        pair.read(self._packet, self._report_came, self._read)

    def close(self) -> None:
        """Send the RTCP message BYE and stop receiving. Idempotent."""
        for timer in (self._tick, self._next_report):
            if timer is not None:
                timer.cancel()
        if self._reception is not None:
            self._send_report(wire.Goodbye((self._ssrc,)))
            self._reception = None
        self._pair.close()

    def statistics(self, overflows: int) -> RtpStatistics:
        """Return the counts of packets received."""
        taken = self._depacketizer
        return RtpStatistics(
            self._packets,
            taken.lost,
            self._repaired,
            taken.duplicates,
            taken.damaged,
            overflows,
            self._strange,
            0.0 if self._reception is None else self._reception.jitter,
        )

    @property
    def proofs(self) -> int:
        """Number of the sender's frames with a right marker."""
        return self._depacketizer.proofs

    def utc(self, timestamp: int) -> float | None:
        """Return a time on the sender's wall clock; None if the sender has not reported it yet."""
        return None if self._reception is None else self._reception.utc(timestamp)

    def want_picture(self) -> None:
        """Request a key frame, unless one was requested recently."""
        now = self._loop.time()
        if self._reception is not None and now - self._picture_asked >= KEY_FRAME_REQUEST_INTERVAL:
            self._picture_asked = now
            self._send_report(wire.PictureLost(self._ssrc, self._reception.ssrc))

    def shown(self) -> None:
        """Note that a picture of the stream was decoded."""
        self._shown_at = self._loop.time()

    # received data

    def _packet(self, data: bytes, sender: tuple[Any, ...]) -> None:
        try:
            packet = wire.RtpPacket.parse(data)
        except MessageError:
            self._strange += 1
            return
        ours = self._stream_of(packet, sender)
        if ours is None:
            self._strange += 1
            return
        self.last_packet_at = now = self._loop.time()
        self._packets += 1
        ours.packet(packet, now)
        if self._requested_at.pop(packet.sequence, None) is not None:
            self._repaired += 1
            self._vain = 0
        self._made += self._depacketizer.take(packet, now)

    def _stream_of(self, packet: RtpPacket, sender: tuple[Any, ...]) -> Reception | None:
        """Return the stream of a packet; the first stream is used until it is silent."""
        if packet.payload_type != self._payload_type or not self._may_speak(sender):
            return None
        now = self._loop.time()
        if (ours := self._reception) is not None:
            same = self._agreed or sender == self._sender
            if packet.ssrc == ours.ssrc and same:
                return ours
            if self._holds_against(sender, now):
                return None
        self._reception = ours = Reception(packet.ssrc)
        if self._early is not None and self._early[0].ssrc == ours.ssrc:
            ours.sender(*self._early)
        self._began, self._shown_at = now, float("-inf")
        self._sender = sender
        if self._reports_to[:1] != sender[:1]:
            self._reports_to = (sender[0], sender[1] + 1, *sender[2:])
        self._requested_at.clear()
        self._vain = 0
        self._report()
        self.want_picture()
        return ours

    def _holds_against(self, sender: tuple[Any, ...], now: float) -> bool:
        """Return True if the stream is kept although another sender sends packets.

        A stream without a decoded picture may be replaced, since any host can send packets.
        """
        if self._agreed:
            return (
                now - self._began < NEW_STREAM_DELAY
                and now - self.last_packet_at < KEY_FRAME_REQUEST_INTERVAL
            )
        if now - self._shown_at >= NEW_HOST_DELAY:
            return now - self._began < NEW_STREAM_DELAY
        return now - self.last_packet_at < (
            NEW_STREAM_DELAY if sender[0] == self._sender[0] else NEW_HOST_DELAY
        )

    def _may_speak(self, sender: tuple[Any, ...]) -> bool:
        return not self._only or str(sender[0]).partition("%")[0] in self._only

    def _read(self) -> None:
        """Pass on complete frames, and check again later if packets are missing."""
        made, self._made = self._made, []
        taken = self._depacketizer
        waits = taken.waits_since() is not None or taken.marked_at is not None
        if self._tick is None and (waits or self._tail_due()):
            self._tick = self._loop.call_later(CHECK_INTERVAL, self._look)
        if made:
            self._done(made)

    def _look(self) -> None:
        self._tick = None
        now = self._loop.time()
        missing = self._depacketizer.missing()
        lost = self._depacketizer.lost
        self._made += self._depacketizer.give_up(now - self._patience())
        self._made += self._depacketizer.end_marked(now - MARKER_GRACE)
        if self._depacketizer.lost > lost:
            self._vain += 1
            self._requested_at.clear()
            self.want_picture()
        elif self._repair and len(missing) <= MAX_PACKETS_REQUESTED:
            tail = self._depacketizer.tail()
            if (
                tail is not None
                and self._tail_due()
                and now - self.last_packet_at >= MAX_PACKET_INTERVAL
            ):
                missing = [tail]
            self._ask(missing, now)
        self._read()

    def _patience(self) -> float:
        if self._agreed:
            return REORDER_GRACE
        repeats = self._vain < MAX_UNANSWERED_REQUESTS
        return self._repair if repeats else min(self._repair, REORDER_GRACE)

    def _tail_due(self) -> bool:
        """Return True if the rest of a frame is missing and the sender repairs such losses."""
        if not self._repaired or self._loop.time() - self.last_packet_at > self._repair:
            return False
        return self._depacketizer.tail() is not None

    def _ask(self, missing: list[int], now: float) -> None:
        requested = self._requested_at
        due = [
            number
            for number in missing
            if now - requested.get(number, float("-inf")) >= RESEND_INTERVAL
        ]
        if due and self._reception is not None:
            self._requested_at = {
                number: requested.get(number, now) for number in missing
            } | dict.fromkeys(due, now)
            self._send_report(wire.PacketsMissing(self._ssrc, self._reception.ssrc, tuple(due)))

    def _report_came(self, data: bytes, sender: tuple[Any, ...]) -> None:
        if not self._may_speak(sender):
            self._strange += 1
            return
        with contextlib.suppress(MessageError):  # other hosts may send invalid data
            for report in wire.parse_rtcp(data):
                self._take(report, sender)

    def _take(self, report: wire.Report, sender: tuple[Any, ...]) -> None:
        ours = self._reception
        if isinstance(report, wire.SenderReport) and ours is None:
            self._reports_to = sender
            self._early = (report, self._loop.time()) if report.ntp >> 32 else None
        if ours is None or sender[0] != self._sender[0]:
            return
        if isinstance(report, wire.SenderReport) and report.ssrc == ours.ssrc:
            self._reports_to = sender
            if report.ntp >> 32:  # a sender without a clock sends 0
                ours.sender(report, self._loop.time())
        elif isinstance(report, wire.Goodbye) and ours.ssrc in report.ssrcs:
            self._on_goodbye(report.reason)

    def _report(self) -> None:
        self._send_report()
        if self._next_report is not None:
            self._next_report.cancel()
        self._next_report = self._loop.call_later(REPORT_INTERVAL, self._report)

    def _send_report(self, *more: wire.Report) -> None:
        """Send a compound report: reception, name, and further requests."""
        if self._reception is None:
            return
        full = not more or not isinstance(more[0], wire.PacketsMissing | wire.PictureLost)
        blocks = (self._reception.block(self._loop.time()),) if full else ()
        report = wire.ReceiverReport(self._ssrc, blocks)
        name = wire.SourceDescription(self._ssrc, self._cname)
        self._pair.report(wire.compound(report, name, *more), self._reports_to)
