"""Datagrams on asyncio, for whoever has an endpoint: the client's links and the emulator."""

from __future__ import annotations

import os
from asyncio.trsock import TransportSocket
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import asyncio
    import socket

LARGEST_DATAGRAM = 1 << 16
"""Largest number of bytes that one read makes room for: UDP's length field, 16 bits, cannot say
more."""


def read_no_more_than_needed(transport: asyncio.BaseTransport) -> None:
    """Have an endpoint make room for one datagram at each read, not for asyncio's 256 KiB.

    The C library takes 256 KiB from the system and gives them back at each read, until it has
    learned better; in a young process that costs more than the rest of the read. The attribute is
    asyncio's
    own, of both its loops, and not documented: a transport without it, such as uvloop's, is left as
    it is.
    """
    size = getattr(transport, "max_size", None)
    if isinstance(size, int) and size > LARGEST_DATAGRAM:
        transport.max_size = LARGEST_DATAGRAM  # type: ignore[attr-defined]


def second_socket(transport: asyncio.BaseTransport) -> socket.socket | None:
    """Return a socket by which to read the datagrams that have come already; its maker closes it.

    asyncio reads one datagram in a turn of its loop. None where the loop reads several by itself
    (uvloop), and where reading aside is not safe (Windows' proactor).
    """
    known = transport.get_extra_info("socket")
    if os.name != "posix" or not isinstance(known, TransportSocket):
        return None
    return known.dup()
