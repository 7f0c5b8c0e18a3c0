"""The TCP half of the link proxy: a listening socket, and a pair of sockets for each connection.

It works on bare sockets, not on transports: one write is one ``send()``, an end is exactly the FIN
or RST asked for, and nothing is closed later than at once. Everything runs in callbacks of the loop
and there is no task; a connection owns at most one timer, and so does each of its pipes.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
import struct
from typing import TYPE_CHECKING, Any

from smartcam.testing.proxy.directions import CHUNK, Pipe, end_sending
from smartcam.testing.proxy.log import Entry
from smartcam.testing.proxy.rules import DIRECTIONS, Direction, StreamRule

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from smartcam.testing.proxy.log import Journal
    from smartcam.testing.proxy.rules import Rule

__all__ = ["Connection", "StreamRelay"]

MAX_CONNECTIONS = 64
"""Connections open at once; more are reset. A camera has one client."""

CONNECT_TIMEOUT = 5.0
"""Seconds that the target has to take a connection."""

LINGER = 1.0
"""Seconds that a cut connection is still read after its FIN, so that it does not end in a RST."""

CALLING = {0, errno.EINPROGRESS, errno.EWOULDBLOCK}
"""What ``connect_ex`` says of a call that may succeed."""

HARD_END = struct.pack("ii", 1, 0)
"""SO_LINGER of no time: closing sends RST."""


class Connection:
    """A client's socket, a socket to the target, and a pipe each way."""

    def __init__(self, relay: StreamRelay, number: int, client: socket.socket) -> None:
        self.number = number
        self.journal: Journal = relay.journal
        self.stalled: set[Direction] = set(relay.stalled)
        self._relay = relay
        self._loop = asyncio.get_running_loop()
        self._client = client
        self._target = socket.socket(relay.family, socket.SOCK_STREAM)
        self._target.setblocking(False)
        self._pipes: dict[Direction, Pipe] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._lingering: set[socket.socket] = set()
        self._connecting = True
        for sock in (self._client, self._target):
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def connect(self) -> None:
        """Call the target."""
        if self._target.connect_ex(self._relay.target) not in CALLING:
            self._refused()
            return
        self._loop.add_writer(self._target, self._connected)
        self._timer = self._loop.call_later(CONNECT_TIMEOUT, self._refused)

    def note(self, what: str, direction: str = "", at: int | None = None) -> None:
        """Log something."""
        self.journal.note(Entry(what, self.number, direction, at))

    # ------------------------------------------------------------------ what happens to it

    def lost(self, direction: Direction, at: int) -> None:
        """A socket is broken; the other side is told so."""
        self.note("lost", direction, at)
        self.reset()

    def end_if_finished(self) -> None:
        """Close when both sides have ended."""
        if all(pipe.finished for pipe in self._pipes.values()):
            self._close()

    def cut(self) -> None:
        """End in order: FIN to both; what still comes is read and dropped for a while."""
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
        """Let rules hold from here on."""
        for direction, pipe in tuple(self._pipes.items()):
            chosen = [rule for rule in rules if rule.concerns(self.number, direction)]
            if chosen:
                pipe.add(chosen)

    def stall(self, direction: Direction | None) -> None:
        """Pass nothing any more; None is both directions."""
        self.stalled |= set(DIRECTIONS if direction is None else [direction])
        self._refresh()

    def resume(self) -> None:
        """Pass everything again, beginning with what waits."""
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
            pipe.refresh()

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
        """Stop everything that moves; the sockets stay."""
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
        self._relay.gone(self)


class StreamRelay:
    """Listens on a port and pairs each connection with one to the target.

    Args:
        rules: looked at when a connection is made.
        journal: what happens goes there.

    Attributes:
        rules, journal: as given.
        family, target: address of the target, set by :meth:`open`.
        stalled: directions in which connections to come are stalled from the beginning.
    """

    kind: socket.SocketKind = socket.SOCK_STREAM
    rule_kind: type[Rule] = StreamRule

    def __init__(self, rules: Sequence[Rule], journal: Journal) -> None:
        self.rules = rules
        self.journal = journal
        self.family: socket.AddressFamily = socket.AF_INET
        self.target: Any = None
        self.stalled: set[Direction] = set()
        self._listener: socket.socket | None = None
        self._address: Any = None
        self._listening = False
        self._connections: dict[int, Connection] = {}
        self._number = 0

    def open(self, host: str, family: socket.AddressFamily, target: Any) -> int:
        """Listen on a free port of ``host``; return it."""
        self.family, self.target = family, target
        self._bind((host, 0))
        self._listen()
        return int(self._address[1])

    @property
    def open_connections(self) -> int:
        """How many connections are open."""
        return len(self._connections)

    def refuse(self, refused: bool) -> None:
        """Close the port for what comes, or open it again; it stays ours all the time."""
        if refused == (not self._listening):
            return
        if refused:
            self._shut()
            self._bind(self._address)  # bound and not listening: the system refuses
        else:
            self._listen()

    def each(self, connection: int | None, do: Callable[[Connection], None]) -> None:
        """Do something to one connection, or to all."""
        chosen = [connection] if connection is not None else list(self._connections)
        for number in chosen:
            if number in self._connections:
                do(self._connections[number])

    def add(self, rules: Sequence[Rule]) -> None:
        """Let rules hold from here on."""
        self.each(None, lambda one: one.add(rules))

    def cut(self, connection: int | None) -> None:
        """End in order."""
        self.each(connection, Connection.cut)

    def reset(self, connection: int | None) -> None:
        """End hard."""
        self.each(connection, Connection.reset)

    def stall(self, direction: Direction | None, connection: int | None) -> None:
        """Pass nothing any more."""
        if connection is None:
            self.stalled |= set(DIRECTIONS if direction is None else [direction])
        self.each(connection, lambda one: one.stall(direction))

    def resume(self) -> None:
        """Pass everything again."""
        self.stalled.clear()
        self.each(None, Connection.resume)

    def close(self) -> None:
        """Shut the port and reset what is open, at once."""
        self._shut()
        self.reset(None)

    def gone(self, connection: Connection) -> None:
        """A connection is over."""
        del self._connections[connection.number]

    # ------------------------------------------------------------------ inside

    def _bind(self, address: Any) -> None:
        sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            sock.setblocking(False)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind(address)
        except OSError:
            sock.close()
            raise
        self._listener, self._address = sock, sock.getsockname()

    def _listen(self) -> None:
        if self._listener is not None:
            self._listener.listen()
            asyncio.get_running_loop().add_reader(self._listener, self._accept, self._listener)
            self._listening = True

    def _shut(self) -> None:
        sock, self._listener = self._listener, None
        if sock is not None:
            asyncio.get_running_loop().remove_reader(sock)
            sock.close()
        self._listening = False

    def _accept(self, listener: socket.socket) -> None:
        try:
            client, _ = listener.accept()
        except (BlockingIOError, InterruptedError, ConnectionAbortedError):
            return  # the client has changed its mind
        except OSError:  # no file descriptor is left
            self.journal.note(Entry("not accepted"))
            self.refuse(True)
            return
        client.setblocking(False)
        self._number += 1
        if len(self._connections) >= MAX_CONNECTIONS:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, HARD_END)
            client.close()
            self.journal.note(Entry("too many", self._number))
            return
        connection = self._connections[self._number] = Connection(self, self._number, client)
        connection.connect()
