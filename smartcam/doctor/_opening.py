"""Opening a port and hearing what comes by itself; nothing is ever sent."""

from __future__ import annotations

import asyncio
import errno
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from smartcam.doctor._networks import HostAddress

MAX_SAID_BYTES = 512
"""Largest number of bytes that are read of what comes by itself."""

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
"""Outcomes of an opening by its error; others are failures of this machine."""

SCARCE = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})
"""Errors of a machine that has no socket left."""


class Opened(NamedTuple):
    """The outcome of opening a port.

    Attributes:
        outcome: outcome of the opening.
        seconds: time until the connection was open.
        said: bytes that came by themselves.
        ended: whether the other end closed the connection by itself.
        why: reason of a failure.
    """

    outcome: Outcome
    seconds: float = 0.0
    said: bytes = b""
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
    """Open a port, hear what comes by itself until that is ``enough``, and close it.

    Args:
        sock: socket of the address' family; it is closed in the end.
        address: address of the host.
        port: number of the port.
        timeout: seconds until it is open, and as many again to hear.
        enough: function that is called with all bytes that came; True ends the hearing.

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
        said, ended = b"", False
        try:
            async with asyncio.timeout(timeout):
                while len(said) < MAX_SAID_BYTES and not enough(said):
                    data = await loop.sock_recv(sock, MAX_SAID_BYTES - len(said))
                    if not data:
                        ended = True
                        break
                    said += data
        except TimeoutError:
            pass
        except OSError:
            ended = True  # it has reset the connection
        return Opened("open", seconds, said, ended)


def is_own(sock: socket.socket) -> bool:
    """Return True if a socket is connected with itself.

    The system may choose for our end the very port that is to be opened, if that is a free port of
    this machine: then the socket meets itself.
    """
    return bool(sock.getsockname() == sock.getpeername())
