"""Send a source's pictures as H.264 over RTP, to one receiver or a group."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import socket
import time
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from smartcam._arguments import check_integer, check_kind, check_number, check_text
from smartcam.exceptions import (
    FrameSourceError,
    LocalProtocolError,
    MessageError,
)
from smartcam.frames._codecs.h264 import H264Encoder
from smartcam.frames._codecs.threads import Codecs, StreamRunner
from smartcam.frames._source import FrameSource
from smartcam.frames._streaming.rtp import packets as wire
from smartcam.frames._streaming.rtp.feedback import PacketHistory, ReceiverReports
from smartcam.frames._streaming.rtp.h264 import H264Packetizer, parameter_sets
from smartcam.frames._streaming.rtp.parameters import CLOCK_RATE, description
from smartcam.frames._streaming.rtp.reception import ntp_time
from smartcam.frames._streaming.rtp.sockets import SocketPair, host_and_port, resolve

if TYPE_CHECKING:
    from typing import Self

    from smartcam.frames._frame import Frame
    from smartcam.frames._streaming.rtp.feedback import RtpReceiver
    from smartcam.frames._streaming.rtp.sockets import Endpoint


_log = logging.getLogger("smartcam.frames")

REPORT_INTERVAL: Final = 2.0
"""Seconds between two sender reports."""

MIN_KEY_FRAME_INTERVAL: Final = 0.2
"""Least time between two requested key frames, seconds, since they are large."""

SPS_START: Final = b"\0\0\1\x67"
"""Start code and header of a sequence parameter set, as x264 writes them."""

FULL_SOCKET_TIMEOUT: Final = 1.0
"""Longest wait until a full socket accepts data again, seconds; then the next frame is sent."""


@dataclass(frozen=True, slots=True)
class RtpSenderStatistics:
    """Counts of a sender since it began.

    Attributes:
        frames: completely sent frames.
        packets: packets sent for the first time.
        bytes: bytes of these packets, with the headers of RTP.
        cut: frames that were sent only in part, since the socket was full.
        resent: packets sent again on request.
        extra_key_frames: key frames for receivers that joined or lost packets, and after cuts.
        receivers: last reports of the receivers.
    """

    frames: int
    packets: int
    bytes: int
    cut: int
    resent: int
    extra_key_frames: int
    receivers: tuple[RtpReceiver, ...]


class _RtpOutlet(NamedTuple):
    """The sender's sockets, and the stream's destination."""

    pair: SocketPair
    to: Endpoint


class RtpSender:
    """Send a source's pictures as H.264 over RTP (RFC 6184), inside of ``async with``.

    ::

        async with smartcam.frames.RtpSender(source, "192.168.0.20:5004", crf=20) as sender:
            await sender.wait()

    The newest frame is encoded and sent at once; frames that come meanwhile are skipped. RTCP goes
    to the next port. Requested packets (generic NACK, RFC 4585) are sent again; a receiver that
    joins or requests a picture (PLI) gets a key frame.

    Args:
        source: open source of frames.
        to: ``HOST:PORT`` of the receiver, or of a multicast group.
        fps: frames per second, for the bit rate; None: the source's, or 30.
        crf: quality, 0 (best) to 51.
        bitrate: bits per second to aim at, instead of a quality.
        keyint: number of frames within which every part of the picture is refreshed.
        payload_type: payload type, 96 to 127.
        ttl: time to live of multicast.

    Raises:
        ConfigurationError: a number is out of range, or ``to`` is no address.
        MissingExtraError: the extra ``video`` is not installed.
    """

    def __init__(
        self,
        source: FrameSource,
        to: str,
        *,
        fps: float | None = None,
        crf: float = 23.0,
        bitrate: int | None = None,
        keyint: int = 30,
        payload_type: int = 96,
        ttl: int = 1,
    ) -> None:
        payload_type = check_integer(payload_type, "payload_type", 96, 127, "RTP")
        if fps is not None:
            fps = check_number(fps, "fps", 0.01, 1000.0, "RTP")
        self._source = check_kind(source, FrameSource, "source", "a source of frames", "RTP")
        self._to = host_and_port(check_text(to, "to", "RTP", most=300))
        self._ttl = check_integer(ttl, "ttl", 0, 255, "RTP")
        self._fps, self._options = fps, {"crf": crf, "bitrate": bitrate, "keyint": keyint}
        self._codecs = Codecs(threads=1)
        self._encoder = self._new_encoder(fps or 30.0)
        self._packetizer = H264Packetizer(payload_type)
        self._first_timestamp = secrets.randbits(
            32
        )  # RTP timestamp at time 0 of the monotonic clock
        self._ticks = 0
        self._cname = f"{secrets.token_hex(6)}@{socket.gethostname()}"
        self._history = PacketHistory()
        self._reports = ReceiverReports(self._packetizer.ssrc)
        self._parameter_sets: tuple[bytes, bytes] | None = None
        self._frames = self._packets = self._bytes = self._cut = self._resent = self._key_frames = 0
        self._payload_bytes = 0
        self._key_frame_wanted = False  # whether the next frame must be a key frame
        self._key_frame_at = float("-inf")
        self._endpoint: Endpoint | None = None
        self._link: _RtpOutlet | None = None
        self._tasks: list[asyncio.Task[None]] = []
        self._entered = False

    def _new_encoder(self, fps: float) -> H264Encoder:
        return H264Encoder(StreamRunner(self._codecs), fps=fps, **self._options)  # type: ignore[arg-type]

    @property
    def sdp(self) -> str:
        """Description of the stream as a file for ``ffplay``, VLC and others.

        After the first frame it has the parameter sets, which are also in the stream.

        Raises:
            LocalProtocolError: the sender was not entered.
        """
        if self._endpoint is None:
            raise LocalProtocolError("RtpSender: not open: use `async with`")
        return description(
            self._endpoint.host,
            self._endpoint.port,
            self._packetizer.payload_type,
            session=self._packetizer.ssrc,
            ttl=self._ttl if self._endpoint.is_multicast else None,
            sets=self._parameter_sets,
            name=self._source.name,
        )

    def statistics(self) -> RtpSenderStatistics:
        """Return the counts of the sender since it began."""
        return RtpSenderStatistics(
            self._frames,
            self._packets,
            self._bytes,
            self._cut,
            self._resent,
            self._key_frames,
            self._reports.receivers(),
        )

    async def __aenter__(self) -> Self:
        """Start sending.

        Raises:
            FrameSourceError: there is no such host, or no port is free.
            LocalProtocolError: the sender was entered before, or the source is not open.

        Cancellation: the sender stays closed.
        """
        if self._entered:
            raise LocalProtocolError("RtpSender: entered before; make a new one")
        rates = self._source.format.rates
        self._entered = True
        if self._fps is None and rates:
            self._encoder = self._new_encoder(min(max(rates[0], 0.01), 1000.0))
        host, port = self._to
        label = f"RTP to {host}:{port}"
        self._endpoint = to = await resolve(host, port, label)
        try:
            self._link = link = _RtpOutlet(SocketPair.open_sending(to, self._ttl), to)
        except OSError as exc:
            raise FrameSourceError(f"{label}: {exc}", source=self._source.name) from exc
        try:
            await self._codecs.__aenter__()
            link.pair.start_reading(None, partial(self._on_rtcp, link))
            self._tasks = [
                asyncio.create_task(work, name=f"{protocol} to {to}")
                for work, protocol in (
                    (self._send(link), "RTP"),
                    (self._report_regularly(link), "RTCP"),
                )
            ]
        except BaseException:
            self._link = None
            link.pair.close()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Say goodbye and stop sending. Idempotent.

        Cancellation: the sender ends nevertheless; a picture that is being encoded is dropped.
        """
        link, self._link = self._link, None
        if link is None:
            return
        for task in self._tasks:
            task.cancel()
        try:
            await asyncio.wait(self._tasks)
            for task in self._tasks:
                if not task.cancelled():
                    task.exception()  # the error was reported, and is in the log
        finally:
            link.pair.close()
            await self._codecs.close()

    async def wait(self) -> None:
        """Wait until the source ends or the sender is closed.

        Raises:
            FrameSourceError: the source ended with this error, or its frames cannot be encoded.
            LocalProtocolError: the sender was not entered.

        Cancellation: safe; the sender goes on.
        """
        if not self._tasks:
            raise LocalProtocolError("RtpSender: not open: use `async with`")
        sending = self._tasks[0]
        await asyncio.wait([sending])
        if not sending.cancelled() and (error := sending.exception()) is not None:
            raise error

    # sending

    async def _send(self, link: _RtpOutlet) -> None:
        try:
            async with self._source.reader(timeout=None) as reader:
                async for frame in reader:
                    if (
                        self._key_frame_wanted
                        and time.monotonic() - self._key_frame_at >= MIN_KEY_FRAME_INTERVAL
                    ):
                        self._request_key_frame()
                    encoded = await self._encoder.encode(frame)
                    if not self._send_frame(link, encoded):
                        self._cut += 1
                        self._key_frame_wanted = True
                        await link.pair.wait_writable(FULL_SOCKET_TIMEOUT)
        except FrameSourceError as error:
            _log.warning("! RTP to %s: %s", link.to, error)
            raise
        except Exception:
            _log.exception("! RTP to %s", link.to)
            raise
        finally:
            self._send_report(link, wire.Goodbye((self._packetizer.ssrc,)))

    def _request_key_frame(self) -> None:
        self._key_frame_wanted, self._key_frame_at = False, time.monotonic()
        self._key_frames += 1
        self._encoder.request_key_frame()

    def _send_frame(self, link: _RtpOutlet, encoded: Frame) -> bool:
        """Send a frame's packets; return False if the socket did not accept all of them."""
        data = bytes(encoded.data)
        if SPS_START in data:
            self._parameter_sets = parameter_sets(data) or self._parameter_sets
        self._ticks = max(self._ticks + 1, int(encoded.captured * CLOCK_RATE))
        sequence = self._packetizer.sequence
        to = link.to[1:]
        for packet in self._packetizer.packets(data, self._first_timestamp + self._ticks):
            try:
                link.pair.rtp.sendto(packet, to)
            except OSError:  # the socket is full, or there is no route now
                return False
            self._history.store(sequence, packet)
            sequence = sequence + 1 & 0xFFFF
            self._packets += 1
            self._bytes += len(packet)
            self._payload_bytes += len(packet) - 12
        self._frames += 1
        return True

    async def _report_regularly(self, link: _RtpOutlet) -> None:
        while True:
            self._send_report(link)
            await asyncio.sleep(REPORT_INTERVAL)

    def _send_report(self, link: _RtpOutlet, *more: wire.Report) -> None:
        now = int(time.monotonic() * CLOCK_RATE) + self._first_timestamp & 0xFFFF_FFFF
        report = wire.SenderReport(
            self._packetizer.ssrc, ntp_time(time.time()), now, self._packets, self._payload_bytes
        )
        name = wire.SourceDescription(self._packetizer.ssrc, self._cname)
        link.pair.send_rtcp(wire.compound(report, name, *more), link.to.rtcp_address)

    # receivers' reports

    def _on_rtcp(self, link: _RtpOutlet, data: bytes, sender: tuple[Any, ...]) -> None:
        if not link.to.is_multicast and sender[0] != link.to.host:
            return
        with contextlib.suppress(MessageError):  # other hosts may send invalid data
            for report in wire.parse_rtcp(data):
                self._on_report(link, report, f"{sender[0]}:{sender[1]}")

    def _on_report(self, link: _RtpOutlet, report: wire.Report, address: str) -> None:
        ssrc = self._packetizer.ssrc
        if isinstance(report, wire.PacketsMissing) and report.media == ssrc:
            self._resend(link, report.sequences)
        elif isinstance(report, wire.PictureLost) and report.media == ssrc:
            self._key_frame_wanted = True
        elif isinstance(report, wire.Goodbye):
            for receiver in report.ssrcs:
                self._reports.remove(receiver)
        elif isinstance(report, wire.ReceiverReport) and self._reports.record(report, address):
            self._key_frame_wanted = True
            self._send_report(link)  # the receiver needs the sender's clock

    def _resend(self, link: _RtpOutlet, sequences: tuple[int, ...]) -> None:
        for sequence in sequences:
            packet = self._history.packet_to_resend(sequence)
            if packet is None:
                continue
            try:
                link.pair.rtp.sendto(packet, link.to[1:])
            except OSError:
                return
            self._resent += 1
