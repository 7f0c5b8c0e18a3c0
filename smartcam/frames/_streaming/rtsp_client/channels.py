"""Receive a stream's packets interleaved with the answers of a connection."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from smartcam.frames._streaming.rtp.packets import is_rtcp

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.frames._streaming.rtsp_client.link import RtspLink


def options_of(transport: str) -> dict[str, str]:
    """Return the options of a header's first transport, by names in lower case."""
    protocol, *rest = transport.partition(",")[0].split(";")
    parts = (option.strip().partition("=") for option in rest)
    options = {name.lower(): value.strip().strip('"') for name, _, value in parts}
    return {"": protocol.strip().upper()} | options


def pair_of(text: str, most: int) -> tuple[int, int] | None:
    """Parse a pair of channels or ports; a missing second number is the first plus one."""
    match = re.fullmatch(r"([0-9]{1,5})(?:-([0-9]{1,5}))?", text)
    if match is None:
        return None
    first = int(match[1])
    second = int(match[2]) if match[2] else first + 1
    return (first, second) if max(first, second) <= most and first != second else None


class InterleavedChannels:
    """Two channels of a connection.

    Some servers use other channels than announced: until a packet comes on the announced channels,
    a packet of the stream's payload type shows the right channel.

    Args:
        link: the connection.
        channels: channel of packets, and channel of reports.
        payload_type: payload type of the stream's packets.
    """

    def __init__(self, link: RtspLink, channels: tuple[int, int], payload_type: int) -> None:
        self._link, self._channels, self._type = link, channels, payload_type
        self._sure = False
        self._rtp: Callable[[bytes, tuple[Any, ...]], None] | None = None
        self._rtcp: Callable[[bytes, tuple[Any, ...]], None] | None = None
        self._from = link.peer

    def read(
        self,
        rtp: Callable[[bytes, tuple[Any, ...]], None] | None,
        rtcp: Callable[[bytes, tuple[Any, ...]], None],
        read: Callable[[], None],
    ) -> None:
        """Call ``rtp`` and ``rtcp`` for each packet and report, until :meth:`close`."""
        self._rtp, self._rtcp = rtp, rtcp
        self._link.on_packet, self._link.on_read = self._packet, read

    def _packet(self, channel: int, data: bytes) -> None:
        report = is_rtcp(data)
        if not self._sure and channel not in self._channels and not report:
            if len(data) < 2 or data[1] & 0x7F != self._type:
                return
            self._channels = (channel, channel ^ 1)
        if channel not in self._channels:
            return
        self._sure |= not report and channel == self._channels[0]
        take = self._rtcp if report else self._rtp
        if take is not None:
            take(data, self._from)

    def report(self, data: bytes, _: tuple[Any, ...]) -> None:
        """Send a report; drop it if too much data waits, since reports are repeated."""
        head = bytes((0x24, self._channels[1])) + len(data).to_bytes(2, "big")
        self._link.write(head + data)

    def close(self) -> None:
        """Stop calling the functions."""
        self._rtp = self._rtcp = None
