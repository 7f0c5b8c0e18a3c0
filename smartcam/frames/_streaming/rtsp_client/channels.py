"""Receive a stream's packets interleaved with the answers of a connection."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from smartcam.frames._streaming.rtp.packets import is_rtcp

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.frames._streaming.rtsp_client.link import RtspLink


def transport_options(transport: str) -> dict[str, str]:
    """Return the options of the first transport in a header ``Transport``.

    The keys are names in lower case; the protocol is under ``""``.
    """
    protocol, *rest = transport.partition(",")[0].split(";")
    parts = (option.strip().partition("=") for option in rest)
    options = {name.lower(): value.strip().strip('"') for name, _, value in parts}
    return {"": protocol.strip().upper()} | options


def parse_pair(text: str, maximum: int) -> tuple[int, int] | None:
    """Parse a pair of channels or ports; a missing second number is the first plus one."""
    match = re.fullmatch(r"([0-9]{1,5})(?:-([0-9]{1,5}))?", text)
    if match is None:
        return None
    first = int(match[1])
    second = int(match[2]) if match[2] else first + 1
    return (first, second) if max(first, second) <= maximum and first != second else None


class InterleavedChannels:
    """Two channels of a connection.

    Some servers use other channels than they announce. So until a packet comes on the announced
    channel, a packet of the stream's payload type on another channel selects that channel.

    Args:
        link: the connection.
        channels: channel of packets, and channel of reports.
        payload_type: payload type of the stream's packets.
    """

    def __init__(self, link: RtspLink, channels: tuple[int, int], payload_type: int) -> None:
        self._link, self._channels, self._payload_type = link, channels, payload_type
        self._is_confirmed = False
        self._on_rtp: Callable[[bytes, tuple[Any, ...]], None] | None = None
        self._on_rtcp: Callable[[bytes, tuple[Any, ...]], None] | None = None
        self._peer = link.peer

    def start_reading(
        self,
        on_rtp: Callable[[bytes, tuple[Any, ...]], None] | None,
        on_rtcp: Callable[[bytes, tuple[Any, ...]], None],
        on_batch_read: Callable[[], None],
    ) -> None:
        """Call the functions for each packet, for each report, and after each batch."""
        self._on_rtp, self._on_rtcp = on_rtp, on_rtcp
        self._link.on_packet, self._link.on_batch_read = self._on_packet, on_batch_read

    def _on_packet(self, channel: int, data: bytes) -> None:
        is_report = is_rtcp(data)
        if not self._is_confirmed and channel not in self._channels and not is_report:
            if len(data) < 2 or data[1] & 0x7F != self._payload_type:
                return
            self._channels = (channel, channel ^ 1)
        if channel not in self._channels:
            return
        self._is_confirmed |= not is_report and channel == self._channels[0]
        callback = self._on_rtcp if is_report else self._on_rtp
        if callback is not None:
            callback(data, self._peer)

    def send_rtcp(self, data: bytes, _: tuple[Any, ...]) -> None:
        """Send a report; drop it if too much unsent data waits, since reports are repeated."""
        head = bytes((0x24, self._channels[1])) + len(data).to_bytes(2, "big")
        self._link.write(head + data)

    def close(self) -> None:
        """Stop calling the functions."""
        self._on_rtp = self._on_rtcp = None
