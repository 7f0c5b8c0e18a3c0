"""Base of the link proxy for TCP and UDP: a port and its clients."""

from __future__ import annotations

import asyncio
import socket
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

from smartcam.testing.proxy._rules import DIRECTIONS, Direction

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.testing.proxy._log import LinkLog
    from smartcam.testing.proxy._rules import Rule


class ClientTraffic(ABC):
    """The traffic of one client with the target."""

    def __init__(self, relay: Relay[Any], number: int) -> None:
        self.number = number  # number of the connection, from 1
        self.log: LinkLog = relay.log
        self._loop = asyncio.get_running_loop()

    def note(self, what: str, direction: str = "", at: int | None = None) -> None:
        """Log an event."""
        self.log.note(what, self.number, direction, at)

    @abstractmethod
    def add_rules(self, rules: Sequence[Rule]) -> None:
        """Apply rules to the traffic from now on."""

    @abstractmethod
    def cut(self) -> None:
        """End the traffic after the bytes that have passed, on TCP with FIN."""

    @abstractmethod
    def reset(self) -> None:
        """End the traffic at once, on TCP with RST."""


C = TypeVar("C", bound=ClientTraffic)


class Relay(ABC, Generic[C]):
    """Listens on a port and pairs each client with a socket to the target."""

    kind: ClassVar[socket.SocketKind]
    rule_kind: ClassVar[type[Rule]]

    def __init__(self, rules: Sequence[Rule], log: LinkLog) -> None:
        self.rules = rules  # read when a connection is made
        self.log = log
        # address family of the target, set by open()
        self.family: socket.AddressFamily = socket.AF_INET
        self.target: Any = None  # address of the target, set by open()
        # directions in which nothing passes, also for new connections
        self.stalled: set[Direction] = set()
        self.clients: dict[Any, C] = {}  # connected clients
        self._socket: socket.socket | None = None
        self._address: Any = None
        self._refusing = False
        self._last_number = 0

    def open(self, host: str, family: socket.AddressFamily, target: Any) -> int:
        """Listen on a free port of ``host``; return the port."""
        self.family, self.target = family, target
        self._bind((host, 0))
        self._listen()
        return int(self._address[1])

    def select_clients(self, connection: int | None) -> list[C]:
        """Return the open connection of this number in a list; for None return all."""
        return [member for member in self.clients.values() if connection in {None, member.number}]

    def add_rules(self, rules: Sequence[Rule]) -> None:
        """Apply rules to the open connections from now on."""
        for member in self.select_clients(None):
            member.add_rules(rules)

    def cut(self, connection: int | None) -> None:
        """End one connection, or all, after the bytes that have passed."""
        for member in self.select_clients(connection):
            member.cut()

    def reset(self, connection: int | None) -> None:
        """End one connection, or all, at once."""
        for member in self.select_clients(connection):
            member.reset()

    def stall(self, direction: Direction | None, connection: int | None) -> None:
        """Pass nothing any more; a subclass stalls a single connection."""
        if connection is None:
            self.stalled |= set(DIRECTIONS if direction is None else [direction])

    def resume(self) -> None:
        """Pass everything again."""
        self.stalled.clear()

    def refuse(self, refused: bool) -> None:
        """Refuse new clients, or accept them again; the port stays reserved."""
        if refused == self._refusing:
            return
        self._refusing = refused
        if refused:
            self._close_socket()
            self._bind(self._address)
            self._refuse_clients()
        else:
            self._accept_clients()

    def close(self) -> None:
        """Close the port and end all connections, at once."""
        self._close_socket()
        self.reset(None)

    def _bind(self, address: Any) -> None:
        sock = socket.socket(socket.AF_INET, self.kind)
        try:
            sock.setblocking(False)
            if self.kind is socket.SOCK_STREAM:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind(address)
        except OSError:
            sock.close()
            raise
        self._socket, self._address = sock, sock.getsockname()

    def _listen(self) -> None:
        if self._socket is not None:
            self._start_accepting(self._socket)

    def _close_socket(self) -> None:
        sock, self._socket = self._socket, None
        if sock is not None:
            self._stop_accepting(sock)
            sock.close()

    @abstractmethod
    def _start_accepting(self, sock: socket.socket) -> None:
        """Start accepting traffic on the port."""

    @abstractmethod
    def _stop_accepting(self, sock: socket.socket) -> None:
        """Stop accepting traffic on the port."""

    def _refuse_clients(self) -> None:
        """Make the system refuse traffic to the port."""

    def _accept_clients(self) -> None:
        """Accept traffic to the port again."""
        self._listen()
