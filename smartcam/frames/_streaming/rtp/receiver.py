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

    from smartcam.frames._streaming.rtp.assembling import AccessUnit, PayloadFormat
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
"""Seconds after which another stream replaces the current one: a stream from the same host if the
current one is silent, a stream from any host if the current one has no decodable picture."""

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

    def start_reading(
        self,
        on_rtp: Callable[[bytes, tuple[Any, ...]], None] | None,
        on_rtcp: Callable[[bytes, tuple[Any, ...]], None],
        on_batch_read: Callable[[], None],
        /,
    ) -> None:
        """Call a function for each packet, for each report, and after each batch of datagrams."""
        ...

    def send_rtcp(self, data: bytes, address: tuple[Any, ...], /) -> None:
        """Send a report, or drop it if it cannot be sent now."""
        ...

    def close(self) -> None:
        """Stop calling the functions."""
        ...


class StreamReceiver:
    """Receiver of a stream from a pair of channels, which :meth:`close` closes.

    Args:
        pair: channels that nobody reads yet.
        payload_type: payload type of the stream's packets.
        repair_timeout: seconds to wait for a missing packet after a request.
        on_units: function that is called with complete encoded frames.
        on_goodbye: function that is called with the reason when the sender ends the stream.
        only_hosts: addresses of accepted hosts; empty: any host.
        payload_format: format of the payloads; None: H.264.
        is_negotiated: whether RTSP negotiated the stream: then a new stream of the same host
            replaces it at once, and the wait for missing packets is short.
        correct_markers: number of earlier frames of the sender with a correct marker.

    Attributes:
        last_packet_at: time of the stream's last packet, on the loop's clock.
    """

    def __init__(
        self,
        pair: PacketChannels,
        payload_type: int,
        repair_timeout: float,
        on_units: Callable[[list[AccessUnit]], None],
        on_goodbye: Callable[[str], None],
        only_hosts: tuple[str, ...] = (),
        payload_format: PayloadFormat | None = None,
        *,
        is_negotiated: bool = False,
        correct_markers: int = 0,
    ) -> None:
        self._pair, self._payload_type, self._repair_timeout = pair, payload_type, repair_timeout
        self._on_units, self._on_goodbye, self._only_hosts = on_units, on_goodbye, only_hosts
        self._is_negotiated = is_negotiated
        self._loop = asyncio.get_running_loop()
        self._depacketizer = Depacketizer(MAX_WAITING_PACKETS, payload_format, verify_markers=True)
        self._depacketizer.correct_markers = correct_markers
        self._reception: Reception | None = None
        # report that came before the first packet, and its time
        self._early_report: tuple[wire.SenderReport, float] | None = None
        self._sender_address: tuple[Any, ...] = ()
        self._report_address: tuple[Any, ...] = ()
        self._ssrc = secrets.randbits(32)
        self._cname = f"{secrets.token_hex(6)}@{socket.gethostname()}"
        self._requested_at: dict[int, float] = {}
        self._unanswered_requests = 0
        self._repaired = self._strange = self._packets = 0
        self._completed: list[AccessUnit] = []
        self._check_timer: asyncio.TimerHandle | None = None
        self._report_timer: asyncio.TimerHandle | None = None
        self._key_frame_requested_at = float("-inf")
        self._started_at = self._decoded_at = float("-inf")
        self.last_packet_at = self._loop.time()
        pair.start_reading(self._on_packet, self._on_rtcp, self._on_batch_read)

    def close(self) -> None:
        """Send the RTCP message BYE and stop receiving. Idempotent."""
        for timer in (self._check_timer, self._report_timer):
            if timer is not None:
                timer.cancel()
        if self._reception is not None:
            self._send_report(wire.Goodbye((self._ssrc,)))
            self._reception = None
        self._pair.close()

    def statistics(self, overflows: int) -> RtpStatistics:
        """Return the counts of packets received."""
        depacketizer = self._depacketizer
        return RtpStatistics(
            self._packets,
            depacketizer.lost,
            self._repaired,
            depacketizer.duplicates,
            depacketizer.damaged,
            overflows,
            self._strange,
            0.0 if self._reception is None else self._reception.jitter,
        )

    @property
    def correct_markers(self) -> int:
        """Number of the sender's frames with a correct marker."""
        return self._depacketizer.correct_markers

    def utc(self, timestamp: int) -> float | None:
        """Return a time on the sender's wall clock; None if the sender has not reported it yet."""
        return None if self._reception is None else self._reception.utc(timestamp)

    def request_key_frame(self) -> None:
        """Request a key frame, unless one was requested recently."""
        now = self._loop.time()
        since_request = now - self._key_frame_requested_at
        if self._reception is not None and since_request >= KEY_FRAME_REQUEST_INTERVAL:
            self._key_frame_requested_at = now
            self._send_report(wire.PictureLost(self._ssrc, self._reception.ssrc))

    def note_decoded(self) -> None:
        """Record that a picture of the stream was decoded."""
        self._decoded_at = self._loop.time()

    # received data

    def _on_packet(self, data: bytes, sender: tuple[Any, ...]) -> None:
        try:
            packet = wire.RtpPacket.parse(data)
        except MessageError:
            self._strange += 1
            return
        reception = self._reception_of(packet, sender)
        if reception is None:
            self._strange += 1
            return
        self.last_packet_at = now = self._loop.time()
        self._packets += 1
        reception.count_packet(packet, now)
        if self._requested_at.pop(packet.sequence, None) is not None:
            self._repaired += 1
            self._unanswered_requests = 0
        self._completed += self._depacketizer.add_packet(packet, now)

    def _reception_of(self, packet: RtpPacket, sender: tuple[Any, ...]) -> Reception | None:
        """Return the reception that counts a packet; None: the packet is not accepted.

        The first stream is received until it is silent.
        """
        if packet.payload_type != self._payload_type or not self._is_accepted(sender):
            return None
        now = self._loop.time()
        if (reception := self._reception) is not None:
            is_same_sender = self._is_negotiated or sender == self._sender_address
            if packet.ssrc == reception.ssrc and is_same_sender:
                return reception
            if self._keeps_current_stream(sender, now):
                return None
        self._reception = reception = Reception(packet.ssrc)
        if self._early_report is not None and self._early_report[0].ssrc == reception.ssrc:
            reception.set_sender_report(*self._early_report)
        self._started_at, self._decoded_at = now, float("-inf")
        self._sender_address = sender
        if self._report_address[:1] != sender[:1]:
            self._report_address = (sender[0], sender[1] + 1, *sender[2:])
        self._requested_at.clear()
        self._unanswered_requests = 0
        self._report_regularly()
        self.request_key_frame()
        return reception

    def _keeps_current_stream(self, sender: tuple[Any, ...], now: float) -> bool:
        """Return True if the stream is kept although another sender sends packets.

        A stream without a decoded picture may be replaced, since any host can send packets.
        """
        if self._is_negotiated:
            return (
                now - self._started_at < NEW_STREAM_DELAY
                and now - self.last_packet_at < KEY_FRAME_REQUEST_INTERVAL
            )
        if now - self._decoded_at >= NEW_HOST_DELAY:
            return now - self._started_at < NEW_STREAM_DELAY
        return now - self.last_packet_at < (
            NEW_STREAM_DELAY if sender[0] == self._sender_address[0] else NEW_HOST_DELAY
        )

    def _is_accepted(self, sender: tuple[Any, ...]) -> bool:
        return not self._only_hosts or str(sender[0]).partition("%")[0] in self._only_hosts

    def _on_batch_read(self) -> None:
        """Pass on complete frames, and check again later if packets are missing."""
        completed, self._completed = self._completed, []
        depacketizer = self._depacketizer
        must_check = depacketizer.waiting_since() is not None or depacketizer.marked_at is not None
        if self._check_timer is None and (must_check or self._awaits_frame_end()):
            self._check_timer = self._loop.call_later(CHECK_INTERVAL, self._check_missing)
        if completed:
            self._on_units(completed)

    def _check_missing(self) -> None:
        self._check_timer = None
        now = self._loop.time()
        missing = self._depacketizer.missing_sequences()
        lost = self._depacketizer.lost
        self._completed += self._depacketizer.give_up(now - self._missing_timeout())
        self._completed += self._depacketizer.end_marked(now - MARKER_GRACE)
        if self._depacketizer.lost > lost:
            self._unanswered_requests += 1
            self._requested_at.clear()
            self.request_key_frame()
        elif self._repair_timeout and len(missing) <= MAX_PACKETS_REQUESTED:
            next_sequence = self._depacketizer.next_of_open_frame()
            if (
                next_sequence is not None
                and self._awaits_frame_end()
                and now - self.last_packet_at >= MAX_PACKET_INTERVAL
            ):
                missing = [next_sequence]
            self._request_packets(missing, now)
        self._on_batch_read()

    def _missing_timeout(self) -> float:
        if self._is_negotiated:
            return REORDER_GRACE
        repeats = self._unanswered_requests < MAX_UNANSWERED_REQUESTS
        return self._repair_timeout if repeats else min(self._repair_timeout, REORDER_GRACE)

    def _awaits_frame_end(self) -> bool:
        """Return True if the rest of a frame is missing and the sender repairs such losses."""
        if not self._repaired or self._loop.time() - self.last_packet_at > self._repair_timeout:
            return False
        return self._depacketizer.next_of_open_frame() is not None

    def _request_packets(self, missing: list[int], now: float) -> None:
        requested = self._requested_at
        due = [
            sequence
            for sequence in missing
            if now - requested.get(sequence, float("-inf")) >= RESEND_INTERVAL
        ]
        if due and self._reception is not None:
            self._requested_at = {
                sequence: requested.get(sequence, now) for sequence in missing
            } | dict.fromkeys(due, now)
            self._send_report(wire.PacketsMissing(self._ssrc, self._reception.ssrc, tuple(due)))

    def _on_rtcp(self, data: bytes, sender: tuple[Any, ...]) -> None:
        if not self._is_accepted(sender):
            self._strange += 1
            return
        with contextlib.suppress(MessageError):  # other hosts may send invalid data
            for report in wire.parse_rtcp(data):
                self._on_report(report, sender)

    def _on_report(self, report: wire.Report, sender: tuple[Any, ...]) -> None:
        reception = self._reception
        if isinstance(report, wire.SenderReport) and reception is None:
            self._report_address = sender
            self._early_report = (report, self._loop.time()) if report.ntp >> 32 else None
        if reception is None or sender[0] != self._sender_address[0]:
            return
        if isinstance(report, wire.SenderReport) and report.ssrc == reception.ssrc:
            self._report_address = sender
            if report.ntp >> 32:  # a sender without a clock sends 0
                reception.set_sender_report(report, self._loop.time())
        elif isinstance(report, wire.Goodbye) and reception.ssrc in report.ssrcs:
            self._on_goodbye(report.reason)

    def _report_regularly(self) -> None:
        self._send_report()
        if self._report_timer is not None:
            self._report_timer.cancel()
        self._report_timer = self._loop.call_later(REPORT_INTERVAL, self._report_regularly)

    def _send_report(self, *more: wire.Report) -> None:
        """Send a compound report: reception, name, and further messages.

        The report block is left out if the first further message is a request.
        """
        if self._reception is None:
            return
        is_request = bool(more) and isinstance(more[0], wire.PacketsMissing | wire.PictureLost)
        blocks = () if is_request else (self._reception.make_report_block(self._loop.time()),)
        report = wire.ReceiverReport(self._ssrc, blocks)
        name = wire.SourceDescription(self._ssrc, self._cname)
        self._pair.send_rtcp(wire.compound(report, name, *more), self._report_address)
