"""The TCP half of the link proxy: a listening socket, and a pair of sockets for each connection.

It works on bare sockets, not on transports: one write is one ``send()``, an end is exactly the FIN
or RST of the rule, and a socket is closed at once. Everything runs in callbacks of the loop
and there is no task; a connection owns at most one timer, and so does each of its pipes.
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
from smartcam.testing.proxy._relay import Proxied, Relay
from smartcam.testing.proxy._rules import DIRECTIONS, Direction, StreamRule

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.testing.proxy._log import LinkLog
    from smartcam.testing.proxy._rules import Rule

_log = logging.getLogger("smartcam.testing")

MAX_CONNECTIONS = 64
"""Largest number of connections open at once; the connection without an answer for longest makes
room."""

CONNECT_TIMEOUT = 5.0
"""Seconds that the target has to accept a connection."""

LINGER = 1.0
"""Seconds that a cut connection is still read after its FIN, so that it does not end in a RST."""

CALLING = {0, errno.EINPROGRESS, errno.EWOULDBLOCK}
"""Results of ``connect_ex`` for a connection that may succeed."""

HARD_END = struct.pack("ii", 1, 0)
"""SO_LINGER of no time, with which closing sends RST."""


class ProxiedConnection(Proxied):
    """A client's socket, a socket to the target, and a pipe each way."""

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
        if self._target.connect_ex(self._relay.target) not in CALLING:
            self._refused()
            return
        self._loop.add_writer(self._target, self._connected)
        self._timer = self._loop.call_later(CONNECT_TIMEOUT, self._refused)

    # ------------------------------------------------------------------ its end

    @property
    def settled(self) -> bool:
        """True once bytes have passed in both directions."""
        return len(self._carried) == len(DIRECTIONS)

    def turn_away(self, why: str) -> None:
        """End the connection to make room, or since client and target were silent for too long."""
        self.note("turned away")
        self.reset()

    def carried(self, direction: Direction) -> None:
        """Note that bytes went in a direction."""
        self._carried.add(direction)

    def lost(self, direction: Direction, at: int) -> None:
        """Tell the other side that a socket is broken."""
        self.note("lost", direction, at)
        self.reset()

    def end_if_finished(self) -> None:
        """Close when both sides have ended."""
        if all(pipe.finished for pipe in self._pipes.values()):
            self._close()

    def cut(self) -> None:
        """End in order: FIN to both; later bytes are read and dropped for a while."""
        self._stop()
        self._connecting = False
        self._lingering = {self._client, self._target}
        for sock in tuple(self._lingering):
            end_sending(sock)
            self._loop.add_reader(sock, self._drop, sock)
        self._timer = self._loop.call_later(LINGER, self._close)

    def reset(self) -> None:
        """End hard: RST to both."""
        for sock in (self._client, self._target):
            with contextlib.suppress(OSError):
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, HARD_END)
        self._close()

    def add(self, rules: Sequence[Rule]) -> None:
        """Apply rules from here on."""
        for direction, pipe in tuple(self._pipes.items()):
            chosen = [rule for rule in rules if rule.concerns(self.number, direction)]
            if chosen:
                pipe.add(chosen)

    def stall(self, direction: Direction | None) -> None:
        """Pass nothing any more; None is both directions."""
        self.stalled |= set(DIRECTIONS if direction is None else [direction])
        self._refresh()

    def resume(self) -> None:
        """Pass everything again, beginning with waiting bytes."""
        self.stalled.clear()
        self._refresh()

    # ------------------------------------------------------------------ inside

    def _connected(self) -> None:
        if self._target.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            self._refused()
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

    def _refused(self) -> None:
        self.note("no target")
        self.reset()

    def _refresh(self) -> None:
        for pipe in tuple(self._pipes.values()):
            pipe.run()

    def _drop(self, sock: socket.socket) -> None:
        try:
            gone = not sock.recv(CHUNK)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            gone = True
        if gone:
            self._loop.remove_reader(sock)
            self._lingering.discard(sock)
            if not self._lingering:
                self._close()

    def _stop(self) -> None:
        """Stop all transfers and timers; the sockets stay."""
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
        """Pair the connection with a socket to the target."""
        self._relay.take(connection)


class StreamRelay(Relay[ProxiedConnection]):
    """Listens on a port and pairs each connection with one to the target."""

    kind: ClassVar[socket.SocketKind] = socket.SOCK_STREAM
    rule_kind: ClassVar[type[Rule]] = StreamRule

    def __init__(self, rules: Sequence[Rule], log: LinkLog) -> None:
        super().__init__(rules, log)
        places: Places[ProxiedConnection] = Places(
            MAX_CONNECTIONS, own="a client that was answered"
        )
        self._acceptor = _RawAcceptor(self, places)

    def stall(self, direction: Direction | None, connection: int | None) -> None:
        """Pass nothing any more."""
        super().stall(direction, connection)
        for member in self.chosen(connection):
            member.stall(direction)

    def resume(self) -> None:
        """Pass everything again."""
        super().resume()
        for member in self.chosen(None):
            member.resume()

    def take(self, client: socket.socket) -> None:
        """Pair a client's socket with one to the target."""
        self._number += 1
        try:
            address = client.getpeername()
            connection = ProxiedConnection(self, self._number, client)
        except OSError:  # the client is gone, or no file descriptor is left
            self.log.note("not accepted", self._number)
            client.close()
            return
        self.members[self._number] = connection
        refusal = self._acceptor.enter(connection, address)
        if refusal:
            connection.turn_away(refusal)
        else:
            connection.connect()

    def forget(self, connection: ProxiedConnection) -> None:
        """Forget a closed connection."""
        self._acceptor.leave(connection)
        del self.members[connection.number]

    def _watch(self, sock: socket.socket) -> None:
        sock.listen(BACKLOG)
        self._acceptor.open(sock)

    def _unwatch(self, sock: socket.socket) -> None:
        self._acceptor.close()
