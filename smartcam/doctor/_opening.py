"""Open a port and read the bytes that it sends unasked; send nothing."""

from __future__ import annotations

import asyncio
import errno
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from smartcam.doctor._networks import HostAddress

MAX_UNASKED_BYTES = 512
"""Largest number of bytes that are read from a port."""

Outcome = Literal["open", "refused", "no answer", "unreachable", "failed"]

_OUTCOMES_BY_ERROR: dict[int, Outcome] = {
    errno.ECONNREFUSED: "refused",
    errno.ECONNRESET: "refused",
    errno.ETIMEDOUT: "no answer",
    errno.EHOSTUNREACH: "unreachable",
    errno.ENETUNREACH: "unreachable",
    errno.EHOSTDOWN: "unreachable",
    errno.ENETDOWN: "unreachable",
}
"""Outcome of opening a port, by error number; other errors are failures of this machine."""

NO_SOCKET_ERRORS = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})
"""Error numbers that mean that this machine has no socket left."""


class OpenedPort(NamedTuple):
    """The outcome of opening a port.

    Attributes:
        outcome: outcome of the opening.
        seconds: time until the connection was open.
        received: bytes that came unasked.
        is_closed: whether the other end has closed the connection.
        failure: reason of a failure of this machine.
    """

    outcome: Outcome
    seconds: float = 0.0
    received: bytes = b""
    is_closed: bool = False
    failure: str = ""


async def open_port(
    sock: socket.socket,
    address: HostAddress,
    port: int,
    *,
    timeout: float,
    is_enough: Callable[[bytes], bool],
) -> OpenedPort:
    """Open a port, read the bytes that it sends unasked until ``is_enough``, and close it.

    Args:
        sock: socket of the address's family; it is closed in the end.
        address: address of the host.
        port: number of the port.
        timeout: seconds to open the port, and again as many seconds to read.
        is_enough: function that is called with all bytes that came; True ends reading.

    Cancellation: the connection is closed.
    """
    loop = asyncio.get_running_loop()
    start = loop.time()
    with sock:
        sock.setblocking(False)
        try:
            async with asyncio.timeout(timeout):
                await loop.sock_connect(sock, address.sockaddr(port)[1])
            if is_connected_to_itself(sock):
                return OpenedPort("refused")
        except TimeoutError:
            return OpenedPort("no answer")
        except OSError as exc:
            outcome = _OUTCOMES_BY_ERROR.get(exc.errno or 0, "failed")
            return OpenedPort(
                outcome, failure=(exc.strerror or str(exc)) if outcome == "failed" else ""
            )
        seconds = loop.time() - start
        received, is_closed = b"", False
        try:
            async with asyncio.timeout(timeout):
                while len(received) < MAX_UNASKED_BYTES and not is_enough(received):
                    data = await loop.sock_recv(sock, MAX_UNASKED_BYTES - len(received))
                    if not data:
                        is_closed = True
                        break
                    received += data
        except TimeoutError:
            pass
        except OSError:
            is_closed = True  # the other end has reset the connection
        return OpenedPort("open", seconds, received, is_closed)


def is_connected_to_itself(sock: socket.socket) -> bool:
    """Return True if a socket is connected to itself.

    If the port to open is a free port of this machine, the system may choose the same port for the
    near end; the socket then connects to itself.
    """
    return bool(sock.getsockname() == sock.getpeername())
