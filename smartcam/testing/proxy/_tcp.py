"""The TCP half of the link proxy: a listening socket, and a pair of sockets for each connection.

It works on bare sockets, not on transports: one write is one ``send()``, a connection ends with
exactly the FIN or RST of the rule, and a socket is closed at once. Everything runs in callbacks of
the loop, without tasks. A connection owns at most one timer, and so does each of its pipes.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import socket
import struct
from typing import TYPE_CHECKING, ClassVar

from smartcam._accepting import BACKLOG, Acceptor, Places
from smartcam.testing.proxy._directions import CHUNK, Pipe, end_sending
from smartcam.testing.proxy._relay import ClientTraffic, Relay
from smartcam.testing.proxy._rules import DIRECTIONS, Direction, StreamRule

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.testing.proxy._log import LinkLog
    from smartcam.testing.proxy._rules import Rule

_log = logging.getLogger("smartcam.testing")

MAX_CONNECTIONS = 64
"""Largest number of open connections. To accept one more, the proxy closes the connection that has
waited longest for the target's first answer."""

CONNECT_TIMEOUT = 5.0
"""Seconds that the target has to accept a connection."""

LINGER_TIME = 1.0
"""Seconds for which a cut connection is read after its FIN: closing it with unread bytes would send
RST."""

CONNECTING_ERRNOS = {0, errno.EINPROGRESS, errno.EWOULDBLOCK}
"""Results of ``connect_ex`` for a connection that may succeed."""

HARD_END = struct.pack("ii", 1, 0)
"""Value of SO_LINGER, 0 seconds, with which closing a socket sends RST."""


class ProxiedConnection(ClientTraffic):
    """A client's socket, a socket to the target, and a pipe in each direction."""

    def __init__(self, relay: StreamRelay, number: int, client: socket.socket) -> None:
        super().__init__(relay, number)
        self.stalled: set[Direction] = set(relay.stalled)
        self._relay = relay
        self._client = client
        self._target = socket.socket(relay.family, socket.SOCK_STREAM)
        self._target.setblocking(False)
        self._pipes: dict[Direction, Pipe] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._lingering: set[socket.socket] = set()
        self._carried: set[Direction] = set()
        self._connecting = True
        for sock in (self._client, self._target):
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def connect(self) -> None:
        """Connect to the target."""
        if self._target.connect_ex(self._relay.target) not in CONNECTING_ERRNOS:
            self._on_refused()
            return
        self._loop.add_writer(self._target, self._on_connected)
        self._timer = self._loop.call_later(CONNECT_TIMEOUT, self._on_refused)

    # ------------------------------------------------------------------ its end

    @property
    def keeps_place(self) -> bool:
        """True once bytes have passed in both directions: it is not closed for a new connection."""
        return len(self._carried) == len(DIRECTIONS)

    def close_for(self, reason: str) -> None:
        """Log that the connection was turned away, and reset it."""
        self.note("turned away")
        self.reset()

    def note_carried(self, direction: Direction) -> None:
        """Note that bytes passed in a direction."""
        self._carried.add(direction)

    def report_lost(self, direction: Direction, at: int) -> None:
        """Log that a socket is broken, and reset both sides."""
        self.note("lost", direction, at)
        self.reset()

    def close_if_finished(self) -> None:
        """Close when both sides have ended."""
        if all(pipe.eof_passed for pipe in self._pipes.values()):
            self._close()

    def cut(self) -> None:
        """Send FIN to both sides; bytes that still come are dropped for ``LINGER_TIME``."""
        self._stop()
        self._connecting = False
        self._lingering = {self._client, self._target}
        for sock in tuple(self._lingering):
            end_sending(sock)
            self._loop.add_reader(sock, self._drop_input, sock)
        self._timer = self._loop.call_later(LINGER_TIME, self._close)

    def reset(self) -> None:
        """Send RST to both sides."""
        for sock in (self._client, self._target):
            with contextlib.suppress(OSError):
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, HARD_END)
        self._close()

    def add_rules(self, rules: Sequence[Rule]) -> None:
        """Apply rules to the bytes from now on."""
        for direction, pipe in tuple(self._pipes.items()):
            chosen = [rule for rule in rules if rule.concerns(self.number, direction)]
            if chosen:
                pipe.add_rules(chosen)

    def stall(self, direction: Direction | None) -> None:
        """Pass nothing any more; None is both directions."""
        self.stalled |= set(DIRECTIONS if direction is None else [direction])
        self._run_pipes()

    def resume(self) -> None:
        """Pass everything again, beginning with waiting bytes."""
        self.stalled.clear()
        self._run_pipes()

    # ------------------------------------------------------------------ inside

    def _on_connected(self) -> None:
        if self._target.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            self._on_refused()
            return
        self._stop()
        self._connecting = False
        ends = {"up": (self._client, self._target), "down": (self._target, self._client)}
        for direction in DIRECTIONS:
            rules = [r for r in self._relay.rules if r.concerns(self.number, direction)]
            self._pipes[direction] = Pipe(self, direction, *ends[direction], rules)
        self.note("connect")
        for pipe in tuple(self._pipes.values()):
            pipe.start()

    def _on_refused(self) -> None:
        self.note("no target")
        self.reset()

    def _run_pipes(self) -> None:
        for pipe in tuple(self._pipes.values()):
            pipe.run()

    def _drop_input(self, sock: socket.socket) -> None:
        try:
            has_ended = not sock.recv(CHUNK)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            has_ended = True
        if has_ended:
            self._loop.remove_reader(sock)
            self._lingering.discard(sock)
            if not self._lingering:
                self._close()

    def _stop(self) -> None:
        """Stop all transfers and timers; the sockets stay open."""
        for pipe in self._pipes.values():
            pipe.close()
        self._pipes.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._connecting:
            self._loop.remove_writer(self._target)
        for sock in self._lingering:
            self._loop.remove_reader(sock)
        self._lingering.clear()

    def _close(self) -> None:
        if self._client.fileno() < 0:
            return
        self._stop()
        self._client.close()
        self._target.close()
        self._relay.forget(self)


class _RawAcceptor(Acceptor[ProxiedConnection]):
    """Passes accepted sockets on unchanged."""

    def __init__(self, relay: StreamRelay, places: Places[ProxiedConnection]) -> None:
        super().__init__(asyncio.Protocol, places, _log, name="smartcam.proxy")
        self._relay = relay

    def adopt(self, connection: socket.socket) -> None:
        """Open a socket to the target for an accepted connection."""
        self._relay.add_client(connection)


class StreamRelay(Relay[ProxiedConnection]):
    """Listens on a port and pairs each connection with one to the target."""

    kind: ClassVar[socket.SocketKind] = socket.SOCK_STREAM
    rule_kind: ClassVar[type[Rule]] = StreamRule

    def __init__(self, rules: Sequence[Rule], log: LinkLog) -> None:
        super().__init__(rules, log)
        places: Places[ProxiedConnection] = Places(
            MAX_CONNECTIONS, session_name="a client that was answered"
        )
        self._acceptor = _RawAcceptor(self, places)

    def stall(self, direction: Direction | None, connection: int | None) -> None:
        """Pass nothing any more."""
        super().stall(direction, connection)
        for member in self.select_clients(connection):
            member.stall(direction)

    def resume(self) -> None:
        """Pass everything again."""
        super().resume()
        for member in self.select_clients(None):
            member.resume()

    def add_client(self, client: socket.socket) -> None:
        """Open a socket to the target for a client's socket."""
        self._last_number += 1
        try:
            address = client.getpeername()
            connection = ProxiedConnection(self, self._last_number, client)
        except OSError:  # the client is gone, or no file descriptor is left
            self.log.note("not accepted", self._last_number)
            client.close()
            return
        self.clients[self._last_number] = connection
        refusal = self._acceptor.enter(connection, address)
        if refusal:
            connection.close_for(refusal)
        else:
            connection.connect()

    def forget(self, connection: ProxiedConnection) -> None:
        """Forget a closed connection."""
        self._acceptor.leave(connection)
        del self.clients[connection.number]

    def _start_accepting(self, sock: socket.socket) -> None:
        sock.listen(BACKLOG)
        self._acceptor.open(sock)

    def _stop_accepting(self, sock: socket.socket) -> None:
        self._acceptor.close()
