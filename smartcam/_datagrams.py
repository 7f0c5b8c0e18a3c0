"""Read datagrams with asyncio, for the client's links and the emulator."""

from __future__ import annotations

import os
from asyncio.trsock import TransportSocket
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import asyncio
    import socket

MAX_DATAGRAM_BYTES = 1 << 16
"""Largest number of bytes of one read: UDP's length field has 16 bits and cannot hold
more."""


def limit_read_size(transport: asyncio.BaseTransport) -> None:
    """Make an endpoint allocate memory for one datagram per read, instead of asyncio's 256 KiB.

    At each read the C library would take 256 KiB from the system and return them, until it adapts;
    in a new process that costs more than the rest of the read. The attribute ``max_size`` of
    asyncio's transports is not documented; a transport without it, such as uvloop's, is unchanged.
    """
    size = getattr(transport, "max_size", None)
    if isinstance(size, int) and size > MAX_DATAGRAM_BYTES:
        transport.max_size = MAX_DATAGRAM_BYTES  # type: ignore[attr-defined]


def second_socket(transport: asyncio.BaseTransport) -> socket.socket | None:
    """Return a second socket of a transport, to read datagrams that have already arrived.

    asyncio's own loop reads only one datagram in each turn. The caller closes the socket. The
    result is None if the loop reads several datagrams by itself (uvloop), or if two may not read
    at once (Windows' proactor).
    """
    first = transport.get_extra_info("socket")
    if os.name != "posix" or not isinstance(first, TransportSocket):
        return None
    return first.dup()
