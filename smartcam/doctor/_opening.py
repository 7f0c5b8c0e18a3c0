"""Open a port and read the bytes that come unasked; never send anything."""

from __future__ import annotations

import asyncio
import errno
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from smartcam.doctor._networks import HostAddress

MAX_SAID_BYTES = 512
"""Largest number of bytes that are read from a port."""

Outcome = Literal["open", "refused", "no answer", "unreachable", "failed"]

_OUTCOMES: dict[int, Outcome] = {
    errno.ECONNREFUSED: "refused",
    errno.ECONNRESET: "refused",
    errno.ETIMEDOUT: "no answer",
    errno.EHOSTUNREACH: "unreachable",
    errno.ENETUNREACH: "unreachable",
    errno.EHOSTDOWN: "unreachable",
    errno.ENETDOWN: "unreachable",
}
"""Outcomes of an opening by its error; other errors are failures of this machine."""

SCARCE = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})
"""Errors of a machine that has no socket left."""


class Opened(NamedTuple):
    """The outcome of opening a port.

    Attributes:
        outcome: outcome of the opening.
        seconds: time until the connection was open.
        received: bytes that came unasked.
        ended: whether the other end closed the connection.
        why: reason of a failure.
    """

    outcome: Outcome
    seconds: float = 0.0
    received: bytes = b""
    ended: bool = False
    why: str = ""


async def open_port(
    sock: socket.socket,
    address: HostAddress,
    port: int,
    *,
    timeout: float,
    enough: Callable[[bytes], bool],
) -> Opened:
    """Open a port, read the bytes that come unasked until they are ``enough``, and close it.

    Args:
        sock: socket of the address' family; it is closed in the end.
        address: address of the host.
        port: number of the port.
        timeout: seconds until it is open, and as many again to read.
        enough: function that is called with all bytes that came; True ends reading.

    Cancellation: the connection is closed.
    """
    loop = asyncio.get_running_loop()
    begun = loop.time()
    with sock:
        sock.setblocking(False)
        try:
            async with asyncio.timeout(timeout):
                await loop.sock_connect(sock, address.sockaddr(port)[1])
            if is_own(sock):
                return Opened("refused")
        except TimeoutError:
            return Opened("no answer")
        except OSError as exc:
            outcome = _OUTCOMES.get(exc.errno or 0, "failed")
            return Opened(outcome, why=(exc.strerror or str(exc)) if outcome == "failed" else "")
        seconds = loop.time() - begun
        received, ended = b"", False
        try:
            async with asyncio.timeout(timeout):
                while len(received) < MAX_SAID_BYTES and not enough(received):
                    data = await loop.sock_recv(sock, MAX_SAID_BYTES - len(received))
                    if not data:
                        ended = True
                        break
                    received += data
        except TimeoutError:
            pass
        except OSError:
            ended = True  # the other end has reset the connection
        return Opened("open", seconds, received, ended)


def is_own(sock: socket.socket) -> bool:
    """Return True if a socket is connected to itself.

    The system may choose for our end the very port that is to be opened, if that is a free port of
    this machine: then the socket connects to itself.
    """
    return bool(sock.getsockname() == sock.getpeername())
