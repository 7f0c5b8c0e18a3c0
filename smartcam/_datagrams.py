"""Read datagrams with asyncio, for the client's links and the emulator."""

from __future__ import annotations

import os
from asyncio.trsock import TransportSocket
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import asyncio
    import socket

MAX_DATAGRAM_BYTES = 1 << 16
"""Largest number of bytes of one read: UDP's length field, 16 bits, cannot say
more."""


def read_no_more_than_needed(transport: asyncio.BaseTransport) -> None:
    """Make an endpoint allocate room for one datagram per read, instead of asyncio's 256 KiB.

    The C library takes 256 KiB from the system and returns them at each read, until it adapts; in a
    young process that costs more than the rest of the read. The attribute is asyncio's own, of both
    its loops, and not documented: a transport without it, such as uvloop's, is left as it is.
    """
    size = getattr(transport, "max_size", None)
    if isinstance(size, int) and size > MAX_DATAGRAM_BYTES:
        transport.max_size = MAX_DATAGRAM_BYTES  # type: ignore[attr-defined]


def second_socket(transport: asyncio.BaseTransport) -> socket.socket | None:
    """Return a socket to read datagrams that have come already; the caller closes it.

    asyncio reads one datagram in a turn of its loop. The result is None if the loop reads several
    by itself (uvloop), or if reading beside it is not safe (Windows' proactor).
    """
    known = transport.get_extra_info("socket")
    if os.name != "posix" or not isinstance(known, TransportSocket):
        return None
    return known.dup()
