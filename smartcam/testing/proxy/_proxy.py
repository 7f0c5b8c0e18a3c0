"""A proxy between a client and a camera that changes their bytes by rules.

It knows no messages. Both sides are real sockets, so both see the effects of a bad network:
segments, resets, silence, a full send buffer.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Literal
from urllib.parse import urlsplit, urlunsplit

from smartcam.exceptions import ConfigurationError
from smartcam.testing.proxy._log import Entry, LinkLog
from smartcam.testing.proxy._rules import DIRECTIONS, Direction, Rule, check_rules
from smartcam.testing.proxy._tcp import StreamRelay
from smartcam.testing.proxy._udp import DatagramRelay

if TYPE_CHECKING:
    from collections import Counter, deque
    from collections.abc import Iterable
    from types import TracebackType
    from typing import Self

HOST = "127.0.0.1"
"""Address on which proxies listen: tests stay on the loopback."""

RELAYS: dict[str, type[StreamRelay | DatagramRelay]] = {"tcp": StreamRelay, "udp": DatagramRelay}


class LinkProxy:
    """A proxy between clients and a camera; an asynchronous context manager.

    It needs an event loop that watches sockets (``add_reader``): every loop of asyncio except the
    proactor of Windows. The methods may be called at any time while it is open; they act at once.

    Args:
        target_host: name or address of the camera.
        target_port: port of the camera.
        transport: ``tcp`` or ``udp``.
        rules: rules to apply, see :mod:`smartcam.testing.proxy._rules`. They are read when a
            connection is made.

    Raises:
        ConfigurationError: an argument cannot work.

    Attributes:
        rules: the list of rules; changes apply to new connections.
        host: address that the proxy listens on.
        port: port that the proxy listens on, 0 until it is open.
        log: the events, the oldest first; bounded.
        counts: number of all events, by the name of the entry.
        passed: output of the proxy, by direction: bytes on TCP, datagrams on UDP.
    """

    def __init__(
        self,
        target_host: str,
        target_port: int,
        *,
        transport: Literal["tcp", "udp"] = "tcp",
        rules: Iterable[Rule] = (),
    ) -> None:
        if transport not in RELAYS:
            raise ConfigurationError(f"transport is 'tcp' or 'udp', not {transport!r}")
        self.rules: list[Rule] = list(rules)
        self.host: str = HOST
        self.port: int = 0
        self._transport = transport
        self._log = LinkLog()
        self.log: deque[Entry] = self._log.log
        self.counts: Counter[str] = self._log.counts
        self.passed: Counter[str] = self._log.passed
        self._relay: StreamRelay | DatagramRelay = RELAYS[transport](self.rules, self._log)
        check_rules(self.rules, self._relay.rule_kind, transport)
        self._target = (target_host, target_port)

    async def __aenter__(self) -> Self:
        """Listen.

        Raises:
            OSError: the target's name does not resolve, or no port is free.
        """
        loop = asyncio.get_running_loop()
        addresses = await loop.getaddrinfo(*self._target, type=self._relay.kind)
        family, _, _, _, address = addresses[0]
        self.port = self._relay.open(HOST, family, address)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        """Close the port and reset every open connection, at once."""
        self._relay.close()

    def url(self, of: str) -> str:
        """Return a camera's URL with the proxy's address in place of its own."""
        return urlunsplit(urlsplit(of)._replace(netloc=f"{self.host}:{self.port}"))

    # ------------------------------------------------------------------ events

    @property
    def open_connections(self) -> int:
        """Number of open connections; on UDP, of known client addresses."""
        return len(self._relay.clients)

    async def wait_for(self, what: str, count: int = 1, *, timeout: float = 5.0) -> None:
        """Wait until an entry is in the log ``count`` times, counted from the beginning.

        Raises:
            TimeoutError: the entry is missing after ``timeout`` seconds.

        Cancellation: safe.
        """
        await self._log.counts.wait(what, count, timeout)

    async def wait_passed(self, direction: Direction, amount: int, *, timeout: float = 5.0) -> None:
        """Wait until the proxy sent ``amount`` bytes, or datagrams, in a direction.

        Raises:
            TimeoutError: fewer were sent within ``timeout`` seconds.

        Cancellation: safe.
        """
        await self._log.passed.wait(direction, amount, timeout)

    # ------------------------------------------------------------------ actions

    def from_now(self, *rules: Rule) -> None:
        """Apply rules to the open connections, after their present rules.

        Offsets and numbers count from now: ``Cut(at=0)`` cuts at once, ``Split(at=12)`` splits
        after the next 12 bytes. New connections are not affected.

        Raises:
            ConfigurationError: a rule is for the other transport.
        """
        check_rules(rules, self._relay.rule_kind, self._transport)
        self._relay.add_rules(rules)

    def cut(self, connection: int | None = None) -> None:
        """End a connection, or all, in order: FIN to both sides. On UDP: forget the client."""
        self._note("cut", connection)
        self._relay.cut(connection)

    def reset(self, connection: int | None = None) -> None:
        """End a connection, or all, hard: RST to both sides. On UDP: forget the client."""
        self._note("reset", connection)
        self._relay.reset(connection)

    def stall(self, direction: Direction | None = None, *, connection: int | None = None) -> None:
        """Pass nothing any more and keep everything open.

        Bytes stay in the system's buffers until :meth:`resume`; datagrams are lost.

        Args:
            direction: the direction to stall; None is both.
            connection: number of the connection; None is all, including new ones. On UDP only None.

        Raises:
            ConfigurationError: there is no such direction, or one connection on UDP.
        """
        if direction not in {None, *DIRECTIONS}:
            raise ConfigurationError(f"direction is 'up', 'down' or None, not {direction!r}")
        self._relay.stall(direction, connection)
        self._note("stall", connection, direction or "")

    def resume(self) -> None:
        """Pass everything again, on every connection; also after a rule has stalled it."""
        self._note("resume", None)
        self._relay.resume()

    def refuse(self, refused: bool = True) -> None:
        """Close the port for new connections, or open it again; open connections stay.

        A client gets the system's own "connection refused".
        """
        self._relay.refuse(refused)

    def kill(self) -> None:
        """Reset every connection and refuse new ones, like a camera whose program dies."""
        self.refuse()
        self.reset()

    def _note(self, what: str, connection: int | None, direction: str = "") -> None:
        self._log.note(what, connection or 0, direction)
