"""A viewer's session: deliver frames, and detect a lost client."""

from __future__ import annotations

import asyncio
import secrets
import time
from typing import TYPE_CHECKING, Final

from smartcam.exceptions import FrameSourceError, MessageError
from smartcam.frames._streaming.rtp.packets import (
    Goodbye,
    PictureLost,
    ReceiverReport,
    SenderReport,
    SourceDescription,
    compound,
    parse_rtcp,
)
from smartcam.frames._streaming.rtp.reception import ntp_time
from smartcam.frames._streaming.rtsp.packing import PacketHeaders

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.frames._frame import Frame
    from smartcam.frames._streaming.rtsp.delivery import PacketDelivery
    from smartcam.frames._streaming.rtsp.streams import RtspStream


SESSION_TIMEOUT: Final = 60
"""Seconds within which a client must send a request or report; announced to the client."""

REPORT_INTERVAL: Final = 5.0
"""Seconds between two sender reports."""

CHECK_INTERVAL: Final = 1.0
"""Seconds between two checks of the client."""

CLOCK_RATE: Final = 90_000
"""Ticks of RTP timestamps per second."""


class RtspSession:
    """A session from SETUP to TEARDOWN.

    Playing begins at a key frame. A frame that would have to wait is skipped; then a key frame is
    requested, and all frames before it are skipped.

    Args:
        stream: stream to deliver.
        on_end: function that is called once when the session ends by itself, with the session and
            the reason; "": the client accepts no data.
    """

    def __init__(self, stream: RtspStream, on_end: Callable[[RtspSession, str], None]) -> None:
        self.id: str = secrets.token_hex(12)
        self.stream = stream
        self.is_playing = False
        self.delivery: PacketDelivery | None = None
        self._on_end = on_end
        self._loop = asyncio.get_running_loop()
        self._headers = PacketHeaders()
        self._timestamp_offset = secrets.randbits(32)
        self._last_ticks = -1  # timestamp of the last frame, without the offset
        self._awaits_key_frame, self._is_skipping = True, False
        self._reported_at = -REPORT_INTERVAL
        self._client_heard_at = self._loop.time()
        self._timer: asyncio.TimerHandle | None = None

    @property
    def ssrc(self) -> int:
        """SSRC of the session's packets."""
        return self._headers.ssrc

    def start(self, delivery: PacketDelivery) -> None:
        """Set how packets reach the client; the delivery is closed with the session."""
        self.delivery = delivery
        self._timer = self._loop.call_later(CHECK_INTERVAL, self._check_client)

    def play(self) -> str:
        """Start sending frames; return the first packet's numbers for the header RTP-Info."""
        if not self.is_playing:
            self.is_playing, self._awaits_key_frame, self._is_skipping = True, True, False
            self.stream.shared_h264.add_viewer(self)
        now = self._timestamp(self._ticks(time.monotonic()))
        return f"seq={self._headers.sequence};rtptime={now}"

    def pause(self) -> None:
        """Stop sending frames until :meth:`play`."""
        self.is_playing = False
        self.stream.shared_h264.remove_viewer(self)

    def close(self, reason: str = "") -> None:
        """Release everything. Idempotent.

        Args:
            reason: reason that is sent to the client; "": no message.
        """
        self.pause()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        delivery, self.delivery = self.delivery, None
        if delivery is not None:
            if reason:
                delivery.send_rtcp(compound(*self._sender_report(), Goodbye((self.ssrc,), reason)))
            delivery.close()

    def keep_alive(self) -> None:
        """Restart the time within which the client must send something."""
        self._client_heard_at = self._loop.time()

    def take_rtcp(self, data: bytes) -> None:
        """Process a report of the client; invalid bytes are ignored."""
        try:
            reports = parse_rtcp(data)
        except MessageError:
            return
        if any(isinstance(report, ReceiverReport | SenderReport) for report in reports):
            self.keep_alive()
        if any(isinstance(report, PictureLost) and report.media == self.ssrc for report in reports):
            self.stream.shared_h264.request_key_frame()

    # called by the stream

    def on_frame(self, unit: Frame, is_key_frame: bool) -> None:
        """Send an encoded frame, or skip it."""
        now, delivery = self._loop.time(), self.delivery
        if delivery is None:
            return
        can_send = delivery.can_send(now)
        if self._awaits_key_frame and not is_key_frame:
            self.stream.skipped += self._is_skipping
            if can_send:
                self.stream.shared_h264.request_key_frame()
            return
        ticks = max(self._ticks(unit.captured), self._last_ticks + 1)
        if not (can_send and self._send(delivery, unit, ticks, is_key_frame, now)):
            self.stream.skipped += 1
            self._awaits_key_frame = self._is_skipping = True
            return
        self._last_ticks, self._awaits_key_frame, self._is_skipping = ticks, False, False
        self.stream.sent += 1

    def on_stream_end(self, error: FrameSourceError) -> None:
        """End the session, since the source has ended."""
        self.is_playing = False
        self._end(str(error))

    def _send(
        self, delivery: PacketDelivery, unit: Frame, ticks: int, is_key_frame: bool, now: float
    ) -> bool:
        payloads = self.stream.packetizer.payloads(unit)
        packets = self._headers.packets_of(payloads, self._timestamp(ticks))
        if now - self._reported_at >= REPORT_INTERVAL:
            self._send_report(now)
        return delivery.send(packets, is_key_frame, now)

    def _ticks(self, moment: float) -> int:
        return round(moment * CLOCK_RATE)

    def _timestamp(self, ticks: int) -> int:
        return ticks + self._timestamp_offset & 0xFFFFFFFF

    def _sender_report(self) -> tuple[SenderReport, SourceDescription]:
        ntp = ntp_time(time.time())
        stamp = self._timestamp(self._ticks(time.monotonic()))
        headers = self._headers
        report = SenderReport(self.ssrc, ntp, stamp, headers.packets, headers.octets)
        return report, SourceDescription(self.ssrc, "smartcam")

    def _send_report(self, now: float) -> None:
        self._reported_at = now
        if self.delivery is not None:
            self.delivery.send_rtcp(compound(*self._sender_report()))

    def _check_client(self) -> None:
        """End the session if the client is lost."""
        if self.delivery is None:
            return
        now = self._loop.time()
        self._timer = self._loop.call_later(CHECK_INTERVAL, self._check_client)
        is_alive = self.delivery.is_alive(now) if self.is_playing else None
        if is_alive:
            self.keep_alive()
        if is_alive is False:
            self.stream.stalled += 1
            self._end("")
        elif now - self._client_heard_at >= SESSION_TIMEOUT:
            self.stream.silent += 1
            self._end(f"no request or report came for {SESSION_TIMEOUT} s")
        elif self.is_playing and now - self._reported_at >= REPORT_INTERVAL:
            self._send_report(now)

    def _end(self, reason: str) -> None:
        self.close(reason)
        self._on_end(self, reason)
