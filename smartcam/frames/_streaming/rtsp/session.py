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
from smartcam.frames._streaming.rtsp.packing import PacketNumbers

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

CLOCK: Final = 90_000


class RtspSession:
    """A session from SETUP to TEARDOWN.

    Playing begins at a key frame. A frame that would have to wait is skipped; then a key frame is
    requested, and all frames before it are skipped.

    Args:
        stream: stream to deliver.
        ended: function that is called once when the session ends by itself, with the session and
            the reason; "": the client takes nothing.
    """

    def __init__(self, stream: RtspStream, ended: Callable[[RtspSession, str], None]) -> None:
        self.id: str = secrets.token_hex(12)
        self.stream = stream
        self.playing = False
        self.delivery: PacketDelivery | None = None
        self._ended = ended
        self._loop = asyncio.get_running_loop()
        self._numbering = PacketNumbers()
        self._offset = secrets.randbits(32)
        self._last = -1  # last timestamp without the offset
        self._wants_key, self._skips = True, False
        self._reported_at = -REPORT_INTERVAL
        self._heard_at = self._loop.time()
        self._timer: asyncio.TimerHandle | None = None

    @property
    def ssrc(self) -> int:
        """SSRC of the session's packets."""
        return self._numbering.ssrc

    def start(self, delivery: PacketDelivery) -> None:
        """Set the delivery to the client, which is closed with the session."""
        self.delivery = delivery
        self._timer = self._loop.call_later(CHECK_INTERVAL, self._check)

    def play(self) -> str:
        """Start sending frames; return the RTP-Info of the first packet."""
        if not self.playing:
            self.playing, self._wants_key, self._skips = True, True, False
            self.stream.shared.join(self)
        now = self._timestamp(self._ticks(time.monotonic()))
        return f"seq={self._numbering.sequence};rtptime={now}"

    def pause(self) -> None:
        """Stop sending frames until :meth:`play`."""
        self.playing = False
        self.stream.shared.leave(self)

    def close(self, why: str = "") -> None:
        """Release everything. Idempotent.

        Args:
            why: reason that is sent to the client; "": no message.
        """
        self.pause()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        delivery, self.delivery = self.delivery, None
        if delivery is not None:
            if why:
                delivery.report(compound(*self._report(), Goodbye((self.ssrc,), why)))
            delivery.close()

    def keep_alive(self) -> None:
        """Note that the client is alive."""
        self._heard_at = self._loop.time()

    def take_rtcp(self, data: bytes) -> None:
        """Process a report of the client; invalid bytes are ignored."""
        try:
            reports = parse_rtcp(data)
        except MessageError:
            return
        if any(isinstance(report, ReceiverReport | SenderReport) for report in reports):
            self.keep_alive()
        if any(isinstance(report, PictureLost) and report.media == self.ssrc for report in reports):
            self.stream.shared.key_frame()

    # called by the stream

    def take(self, unit: Frame, key: bool) -> None:
        """Send an encoded frame, or skip it."""
        now, delivery = self._loop.time(), self.delivery
        if delivery is None:
            return
        ready = delivery.ready(now)
        if self._wants_key and not key:
            self.stream.skipped += self._skips
            if ready:
                self.stream.shared.key_frame()
            return
        ticks = max(self._ticks(unit.captured), self._last + 1)
        if not (ready and self._send(delivery, unit, ticks, key, now)):
            self.stream.skipped += 1
            self._wants_key = self._skips = True
            return
        self._last, self._wants_key, self._skips = ticks, False, False
        self.stream.sent += 1

    def ended(self, error: FrameSourceError) -> None:
        """End the session, since the source has ended."""
        self.playing = False
        self._end(str(error))

    def _send(
        self, delivery: PacketDelivery, unit: Frame, ticks: int, key: bool, now: float
    ) -> bool:
        pieces = self.stream.cutter.pieces(unit)
        packets = self._numbering.numbered(pieces, self._timestamp(ticks))
        if now - self._reported_at >= REPORT_INTERVAL:
            self._send_report(now)
        return delivery.send(packets, key, now)

    def _ticks(self, moment: float) -> int:
        return round(moment * CLOCK)

    def _timestamp(self, ticks: int) -> int:
        return ticks + self._offset & 0xFFFFFFFF

    def _report(self) -> tuple[SenderReport, SourceDescription]:
        ntp = ntp_time(time.time())
        stamp = self._timestamp(self._ticks(time.monotonic()))
        made = self._numbering
        report = SenderReport(self.ssrc, ntp, stamp, made.packets, made.octets)
        return report, SourceDescription(self.ssrc, "smartcam")

    def _send_report(self, now: float) -> None:
        self._reported_at = now
        if self.delivery is not None:
            self.delivery.report(compound(*self._report()))

    def _check(self) -> None:
        """End the session if the client is lost."""
        if self.delivery is None:
            return
        now = self._loop.time()
        self._timer = self._loop.call_later(CHECK_INTERVAL, self._check)
        alive = self.delivery.alive(now) if self.playing else None
        if alive:
            self.keep_alive()
        if alive is False:
            self.stream.stalled += 1
            self._end("")
        elif now - self._heard_at >= SESSION_TIMEOUT:
            self.stream.silent += 1
            self._end(f"no request or report came for {SESSION_TIMEOUT} s")
        elif self.playing and now - self._reported_at >= REPORT_INTERVAL:
            self._send_report(now)

    def _end(self, why: str) -> None:
        self.close(why)
        self._ended(self, why)
