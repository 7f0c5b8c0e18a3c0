"""Accept connections on a port, by one policy for every server of the package.

Emulators, pages, the RTSP server and the link proxy use it. :class:`Places` decides which
connections may stay; it uses no socket and no clock. :class:`Acceptor` accepts them, and keeps the
deadlines.

- If all places are taken, a new connection replaces the connection that has been without a session
  for longest. If each has a session, the new connection is refused. The server defines what a
  session is; a request that needs no session, such as OPTIONS, does not make one.
- A connection that has no session in time is closed, even if it has sent data.
- One address gets at most three quarters of the places; the programs of this machine share one
  address, so loopback may have all.
- Some file descriptors of the process are reserved for others. If only those are left, the
  connection without a session for longest, of any server on this event loop, is closed.

Connections are not accepted by ``asyncio.Server``. If it is closed before an accepted connection
has a transport, the socket stays open until the garbage collector finds it, and the client waits
forever. If no file descriptor is free, ``asyncio.Server`` also logs, every second, a traceback for
each connection that its backlog may hold.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import math
import socket
import sys
import threading
import weakref
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Generic, Protocol, TypeVar

if TYPE_CHECKING:
    import logging
    from collections.abc import Callable, Iterator

if sys.platform != "win32":
    import resource

ACCEPT_PAUSE = 1.0
"""Seconds until the next attempt if the system has no socket left, and no connection can be
closed."""

BACKLOG: Final = 128
"""Number of connections that the system may queue before they are accepted."""

HANDSHAKE_TIMEOUT: Final = 60.0
"""Seconds that a connection may stay without a session, unless a server sets another time."""

RESOLVE_TIMEOUT: Final = 10.0
"""Seconds that the look-up of a host's address may take."""

RESERVED_DESCRIPTORS: Final = 32
"""File descriptors that a server's connections leave to the rest of the process, and to cameras."""

DESCRIPTORS_LEFT_BY_EMULATORS: Final = 8
"""File descriptors that the connections of an emulated camera leave to the rest of the process."""


def is_loopback(host: str) -> bool:
    """Return True if a host's name or address reaches this machine only from itself."""
    if host.lower() == "localhost":
        return True
    try:
        address = ipaddress.ip_address(host.strip("[]").partition("%")[0])
    except ValueError:
        return False
    mapped = getattr(address, "ipv4_mapped", None)
    return bool((mapped or address).is_loopback)


def share_of(max_places: int) -> int:
    """Return the number of all places that one address may take; loopback may take all."""
    return max(1, max_places - max_places // 4)


class Occupant(Protocol):
    """The part of a connection that the policy uses."""

    @property
    def keeps_place(self) -> bool:
        """True if it has a session or is being served, so that it is never closed for another."""
        ...

    def close_for(self, reason: str) -> None:
        """Close the connection at once, since it has lost its place. Harmless when called twice."""
        ...


@dataclass(slots=True)
class _TakenPlace:
    peer: str  # address of the peer, without a port
    idle_since: float  # time at which the connection was made, was last served, or lost its session
    timeout: float  # seconds within which the connection must have a session
    missing: str  # what the connection lacks, for the log: "no session"
    deadline: float


G = TypeVar("G", bound=Occupant)


class Places(Generic[G]):
    """The policy of one port: which connections may stay.

    Moments are seconds of any clock that does not go back.

    Args:
        max_places: largest number of connections at a time.
        timeout: seconds that a new connection may stay without a session.
        missing: what such a connection lacks, for the log: "no session".
        session_name: name of a session, for the log: "a session".

    Attributes:
        max_places: largest number of connections at a time; may be changed.
        crowded_out: number of connections that were closed, or refused, because too many were open.
    """

    def __init__(
        self,
        max_places: int,
        *,
        timeout: float = HANDSHAKE_TIMEOUT,
        missing: str = "no session",
        session_name: str = "a session",
    ) -> None:
        self.max_places = max_places
        self.crowded_out = 0
        self._timeout, self._missing, self._session_name = (
            timeout,
            missing,
            session_name,
        )
        self._places: dict[G, _TakenPlace] = {}  # the first has been idle for longest

    def __len__(self) -> int:
        return len(self._places)

    def __iter__(self) -> Iterator[G]:
        return iter(list(self._places))

    def __contains__(self, occupant: object) -> bool:
        return occupant in self._places

    def enter(self, occupant: G, peer: str, now: float) -> str:
        """Give a new connection a place; another connection may be closed for it.

        Returns:
            The reason why the connection is refused; "" if it has a place now.
        """
        rivals, reason = list(self._places), f"{self.max_places} others are open"
        if len(rivals) < self.max_places:
            rivals = []
            if not is_loopback(peer):
                of_peer = [other for other, place in self._places.items() if place.peer == peer]
                if len(of_peer) >= share_of(self.max_places):
                    rivals, reason = of_peer, f"{len(of_peer)} others of {peer} are open"
        if rivals:
            self.crowded_out += 1
            evicted = next((other for other in rivals if not other.keeps_place), None)
            if evicted is None:
                return f"{reason}, and each has {self._session_name}"
            self._evict(evicted, f"{reason}, it was without {self._session_name} for longest")
        self._places[occupant] = _TakenPlace(
            peer, now, self._timeout, self._missing, now + self._timeout
        )
        return ""

    def leave(self, occupant: G) -> None:
        """Forget a connection that has ended; harmless when called twice."""
        self._places.pop(occupant, None)

    def restart_idle_time(self, occupant: G, now: float) -> None:
        """Note that a connection was served or its session ended: it is idle only since now.

        Connections that have been idle for longer are closed for new ones before it.
        """
        place = self._places.pop(occupant, None)
        if place is not None:
            place.idle_since = now
            self._places[occupant] = place

    def set_time_limit(self, occupant: G, timeout: float | None, missing: str, now: float) -> None:
        """Set a new time limit within which a connection must have a session; None: no limit.

        Args:
            occupant: the connection.
            timeout: seconds from ``now`` on.
            missing: what a connection that is too late lacks, for the log: "no request".
            now: the present time.
        """
        place = self._places.get(occupant)
        if place is not None:
            place.timeout, place.missing = math.inf if timeout is None else timeout, missing
            place.deadline = now + place.timeout

    def find_longest_idle(self) -> tuple[float, G] | None:
        """Find the connection that has been without a session for longest.

        Returns:
            The time since which it has had none, and the connection; None if each has a session.
        """
        for occupant, place in self._places.items():
            if not occupant.keeps_place:
                return place.idle_since, occupant
        return None

    def make_room(self, reason: str) -> None:
        """Close the connection that has been without a session for longest, if there is one."""
        longest_idle = self.find_longest_idle()
        if longest_idle is not None:
            self.crowded_out += 1
            self._evict(longest_idle[1], reason)

    def end_overdue(self, now: float) -> None:
        """Close connections without a session at their deadline; others get a new deadline."""
        for occupant, place in list(self._places.items()):
            if place.deadline > now or occupant not in self._places:
                continue
            if occupant.keeps_place:
                place.deadline = now + place.timeout
            else:
                self._evict(occupant, f"{place.missing} within {place.timeout:g} s")

    def next_deadline(self) -> float:
        """Return the time at which :meth:`end_overdue` has work next; infinity if it has none."""
        return min((place.deadline for place in self._places.values()), default=math.inf)

    def _evict(self, occupant: G, reason: str) -> None:
        self._places.pop(occupant, None)
        occupant.close_for(reason)


class _ThreadState(threading.local):
    """The acceptors of the event loops that run in a thread."""

    def __init__(self) -> None:
        self.acceptors: weakref.WeakSet[Acceptor[Any]] = weakref.WeakSet()


_thread_state = _ThreadState()


class Acceptor(Generic[G]):
    """Accepts connections on a listening socket; gives each a protocol, which takes a place.

    The protocol calls :meth:`enter` when its connection is made, and :meth:`leave` when
    it is lost.

    Args:
        make: function that returns a new protocol. It may also be called after :meth:`close`, for a
            connection that was accepted earlier.
        places: places of the connections that may stay.
        log: logger of failures.
        name: name of the tasks.
        reserve: file descriptors of the process that are left to others.
    """

    def __init__(
        self,
        make: Callable[[], asyncio.BaseProtocol],
        places: Places[G],
        log: logging.Logger,
        name: str,
        *,
        reserve: int = RESERVED_DESCRIPTORS,
    ) -> None:
        self.places = places
        self._make = make
        self._log = log
        self._name = name
        self._reserve = reserve
        self._socket: socket.socket | None = None
        self._accept_handle: asyncio.Task[None] | asyncio.TimerHandle | None = None
        self._adopt_tasks: set[asyncio.Task[Any]] = set()
        self._moving_count = 0  # connections that :meth:`_move` will get
        self._has_warned = False  # the last connection could not be accepted, and the log says so
        self._timer: asyncio.TimerHandle | None = None  # timer of the next deadline
        self.loop: asyncio.AbstractEventLoop | None = None  # event loop while the socket listens

    # ------------------------------------------------------------------ the port

    def open(self, sock: socket.socket) -> None:
        """Start accepting on a listening, non-blocking socket."""
        self._socket = sock
        self.loop = asyncio.get_running_loop()
        _thread_state.acceptors.add(self)
        self._listen(sock)

    def close(self) -> None:
        """Stop accepting at once; connections and the socket stay open."""
        sock, self._socket = self._socket, None
        self.loop = None
        _thread_state.acceptors.discard(self)
        if sock is not None:
            with contextlib.suppress(NotImplementedError):
                asyncio.get_running_loop().remove_reader(sock)
        if self._accept_handle is not None:
            self._accept_handle.cancel()
            self._accept_handle = None

    async def wait_closed(self) -> None:
        """Wait until every accepted connection has its protocol, or is closed."""
        if self._moving_count:  # the loop calls _move in its next turn
            await asyncio.sleep(0)
        if self._adopt_tasks:
            await asyncio.wait(self._adopt_tasks)

    # ------------------------------------------------------------------ its connections

    def enter(self, occupant: G, address: Any) -> str:
        """Give a new connection a place; return the reason if it is refused, "" if it has a place.

        Args:
            occupant: the connection.
            address: address of its peer, in a socket's form.
        """
        now = asyncio.get_running_loop().time()
        reason = self.places.enter(occupant, str(address[0]) if address else "", now)
        self._set_timer()
        return reason

    def leave(self, occupant: G) -> None:
        """Forget a connection that has ended; harmless when called twice."""
        self.places.leave(occupant)
        if not self.places and self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def restart_idle_time(self, occupant: G) -> None:
        """Note that a connection is idle only since now; see :meth:`Places.restart_idle_time`."""
        self.places.restart_idle_time(occupant, asyncio.get_running_loop().time())

    def set_time_limit(self, occupant: G, timeout: float | None, missing: str) -> None:
        """Set a new time limit within which a connection must have a session; None: no limit.

        Args:
            occupant: the connection.
            timeout: seconds from now on.
            missing: what a connection that is too late lacks, for the log: "no request".
        """
        self.places.set_time_limit(occupant, timeout, missing, asyncio.get_running_loop().time())
        self._set_timer()

    def _set_timer(self) -> None:
        due = self.places.next_deadline()
        if self._timer is not None:
            if self._timer.when() <= due:
                return
            self._timer.cancel()
            self._timer = None
        if due < math.inf:
            self._timer = asyncio.get_running_loop().call_at(due, self._end_overdue)

    def _end_overdue(self) -> None:
        self._timer = None
        self.places.end_overdue(asyncio.get_running_loop().time())
        self._set_timer()

    # ------------------------------------------------------------------ accepting

    def adopt(self, connection: socket.socket) -> None:
        """Start a task that gives an accepted connection its protocol."""
        loop = asyncio.get_running_loop()
        task = loop.create_task(
            loop.connect_accepted_socket(self._make, connection), name=f"{self._name}.adopt"
        )
        self._adopt_tasks.add(task)
        task.add_done_callback(partial(self._on_adopted, connection))

    def _listen(self, sock: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        try:
            loop.add_reader(sock, self._accept, sock)
        except NotImplementedError:  # Windows' proactor
            self._accept_handle = loop.create_task(
                self._accept_for_ever(sock), name=f"{self._name}.accept"
            )

    def _accept(self, sock: socket.socket) -> None:
        try:
            connection, _ = sock.accept()
        except (BlockingIOError, InterruptedError, ConnectionAbortedError):
            return  # no connection: the client has closed it already
        except OSError as exc:  # no file descriptor is left; without a pause, a busy loop
            self._warn_once(f"a connection cannot be accepted: {exc}")
            loop = asyncio.get_running_loop()
            loop.remove_reader(sock)
            pause = 0.0 if _make_room() else ACCEPT_PAUSE
            self._accept_handle = loop.call_later(pause, self._listen, sock)
            return
        self._admit(connection)

    async def _accept_for_ever(self, sock: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, _ = await loop.sock_accept(sock)
            except OSError as exc:
                self._warn_once(f"a connection cannot be accepted: {exc}")
                await asyncio.sleep(0.0 if _make_room() else ACCEPT_PAUSE)
            else:
                self._admit(connection)

    def _warn_once(self, text: str) -> None:
        """Log that a connection cannot be accepted; only the first time until one is accepted."""
        if not self._has_warned:
            self._log.warning("! %s", text)
        self._has_warned = True

    def _admit(self, connection: socket.socket) -> None:
        """Adopt a connection; close it if too few descriptors of the process are left."""
        if not _uses_reserved_descriptor(connection, self._reserve):
            self._prepare_and_adopt(connection)
        elif _make_room():
            self._moving_count += 1
            asyncio.get_running_loop().call_soon(self._move, connection)
        else:
            self._warn_once("a connection was refused: too few file descriptors are left")
            connection.close()

    def _move(self, connection: socket.socket) -> None:
        """Move a connection from its reserved descriptor to the one that has become free.

        Otherwise this connection would keep the reserved descriptor, and the next connection would
        get the free one.
        """
        self._moving_count -= 1
        try:
            moved = connection.dup()
        except OSError:
            moved = connection
        else:
            connection.close()
        self._prepare_and_adopt(moved)

    def _prepare_and_adopt(self, connection: socket.socket) -> None:
        """Set a connection's options, and adopt it."""
        self._has_warned = False
        connection.setblocking(False)
        with contextlib.suppress(OSError):  # the connection has ended already
            # asyncio sets TCP_NODELAY only if the listening socket names the protocol TCP
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.adopt(connection)

    def _on_adopted(self, connection: socket.socket, task: asyncio.Task[Any]) -> None:
        self._adopt_tasks.discard(task)
        if task.cancelled() or task.exception() is not None:
            self._log.warning("! an accepted connection was lost: %s", task)
            connection.close()


def _uses_reserved_descriptor(connection: socket.socket, reserve: int) -> bool:
    """Return True if a new connection has one of the last ``reserve`` descriptors of the process.

    The system gives the lowest free descriptor, so all below are in use.
    """
    if sys.platform == "win32":
        return False
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    reserved = min(reserve, limit // 4)
    return limit != resource.RLIM_INFINITY and connection.fileno() >= limit - reserved


def _make_room() -> bool:
    """Close the connection that has been without a session for longest on this event loop.

    Returns:
        False if each has a session.
    """
    loop = asyncio.get_running_loop()
    of_loop = [acceptor.places for acceptor in _thread_state.acceptors if acceptor.loop is loop]
    idle = [(longest[0], places) for places in of_loop if (longest := places.find_longest_idle())]
    if not idle:
        return False
    _, places = min(idle, key=lambda pair: pair[0])
    places.make_room("the process has too few file descriptors left")
    return True


async def listening_socket(host: str, port: int, *, local: bool = False) -> socket.socket:
    """Return a socket that listens and does not block.

    Args:
        host: name or address of this machine; "": all of them.
        port: 0 for a free one.
        local: True if only an address of loopback is allowed.

    Raises:
        OSError, ValueError, OverflowError: the address is not available, or is not ``local``.
    """
    loop = asyncio.get_running_loop()
    async with asyncio.timeout(RESOLVE_TIMEOUT):
        addresses = await loop.getaddrinfo(host or "0.0.0.0", port, type=socket.SOCK_STREAM)  # noqa: S104
    family, _, _, _, address = addresses[0]
    if local and not is_loopback(str(address[0])):
        raise ValueError(f"expected an address of this machine only, got {host}: {address[0]}")
    listener = socket.create_server((address[0], port), family=family, backlog=BACKLOG)
    listener.setblocking(False)
    return listener
