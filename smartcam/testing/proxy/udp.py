"""The UDP half of the link proxy: a socket for clients, and one to the target for each client."""

from __future__ import annotations

import asyncio
import socket
from collections import Counter, deque
from random import Random
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.exceptions import ConfigurationError
from smartcam.testing.proxy.log import Entry
from smartcam.testing.proxy.rules import (
    DIRECTIONS,
    DatagramRule,
    Direction,
    Late,
    Lose,
    Reorder,
    Repeat,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from smartcam.testing.proxy.log import Journal
    from smartcam.testing.proxy.rules import Rule

__all__ = ["DatagramRelay"]

MAX_SIZE = 1 << 16
"""Bytes read of a datagram; none is longer."""

MAX_CLIENTS = 64
"""Client addresses that are known; beyond it the one known longest is forgotten."""

MAX_WAITING = 1024
"""Datagrams that rules hold back; more are lost and counted as ``full``."""


class _Parcel(NamedTuple):
    """A datagram on its way."""

    data: bytes
    copies: int
    delay: float


class _Held:
    """A datagram that others overtake."""

    timer: asyncio.TimerHandle

    def __init__(self, parcel: _Parcel, behind: int) -> None:
        self.parcel = parcel
        self.behind = behind


class _Peer:
    """One client's address and the socket to the target that is its own."""

    def __init__(self, relay: DatagramRelay, number: int, address: Any) -> None:
        self.number = number
        self.address = address
        self._relay = relay
        self._loop = asyncio.get_running_loop()
        self._sock = socket.socket(relay.family, socket.SOCK_DGRAM)
        self._sock.setblocking(False)
        self._sock.connect(relay.target)
        self._loop.add_reader(self._sock, self._receive)
        self._seen: Counter[Direction] = Counter()
        self._held: dict[Direction, deque[_Held]] = {way: deque() for way in DIRECTIONS}
        self._timers: set[asyncio.TimerHandle] = set()
        self._rules: dict[Direction, list[tuple[DatagramRule, Random]]] = {
            way: [] for way in DIRECTIONS
        }
        self.add(relay.rules)

    def add(self, rules: Sequence[Rule]) -> None:
        """Put rules behind the others; their numbers count from here."""
        for way in DIRECTIONS:
            for rule in rules:
                if isinstance(rule, DatagramRule) and rule.concerns(self.number, way):
                    seed = f"{rule.seed}:{self.number}:{way}"
                    chance = Random(seed)  # noqa: S311 - no secret
                    self._rules[way].append((rule.ahead(self._seen[way]), chance))

    def take(self, direction: Direction, data: bytes) -> None:
        """Do to a datagram what the rules say."""
        self._seen[direction] += 1
        number = self._seen[direction]
        if direction in self._relay.stalled:
            self._note("stall", direction, number)
            return
        parcel = _Parcel(data, 1, 0.0)
        swap: Reorder | None = None
        for rule, chance in self._rules[direction]:
            if not rule.picks(number, chance):
                continue
            self._note(rule.name, direction, number)
            if isinstance(rule, Lose):
                return
            if isinstance(rule, Repeat):
                parcel = parcel._replace(copies=parcel.copies + rule.copies)
            elif isinstance(rule, Late):
                delay = rule.seconds + chance.random() * rule.jitter
                parcel = parcel._replace(delay=parcel.delay + delay)
            elif isinstance(rule, Reorder):
                swap = rule
        if swap is not None:
            self._hold(direction, parcel, swap)
        else:
            self._send(direction, parcel)
            self._overtake(direction)

    def close(self) -> None:
        """Forget the client; what is on its way is lost."""
        for timer in self._timers:
            timer.cancel()
        self._timers.clear()
        self._loop.remove_reader(self._sock)
        self._sock.close()

    # ------------------------------------------------------------------ inside

    def _receive(self) -> None:
        try:
            data = self._sock.recv(MAX_SIZE)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:  # the system says that nothing listens there
            self._note("no target", "up")
            return
        self.take("down", data)

    def _hold(self, direction: Direction, parcel: _Parcel, rule: Reorder) -> None:
        if self._is_full(direction):
            return
        held = _Held(parcel, rule.behind)
        held.timer = self._later(rule.seconds, lambda: self._release(direction, held))
        self._held[direction].append(held)

    def _overtake(self, direction: Direction) -> None:
        for held in tuple(self._held[direction]):
            held.behind -= 1
            if held.behind <= 0:
                self._release(direction, held)

    def _release(self, direction: Direction, held: _Held) -> None:
        held.timer.cancel()
        self._timers.discard(held.timer)
        self._held[direction].remove(held)
        self._send(direction, held.parcel)

    def _send(self, direction: Direction, parcel: _Parcel) -> None:
        if parcel.delay > 0:
            if not self._is_full(direction):
                self._later(parcel.delay, lambda: self._send_now(direction, parcel))
        else:
            self._send_now(direction, parcel)

    def _send_now(self, direction: Direction, parcel: _Parcel) -> None:
        for _ in range(parcel.copies):
            try:
                if direction == "up":
                    self._sock.send(parcel.data)
                else:
                    self._relay.send_to_client(parcel.data, self.address)
            except (BlockingIOError, InterruptedError):
                self._note("full", direction)
            except OSError:
                self._note("no target" if direction == "up" else "refused", direction)
            else:
                self._relay.journal.count_passed(direction, 1)

    def _is_full(self, direction: Direction) -> bool:
        if len(self._timers) < MAX_WAITING:
            return False
        self._note("full", direction)
        return True

    def _later(self, seconds: float, do: Callable[[], None]) -> asyncio.TimerHandle:
        def act() -> None:
            self._timers.discard(timer)
            do()

        timer = self._loop.call_later(seconds, act)
        self._timers.add(timer)
        return timer

    def _note(self, what: str, direction: str, at: int | None = None) -> None:
        self._relay.journal.note(Entry(what, self.number, direction, at))


class DatagramRelay:
    """Takes datagrams on a port and passes them on; each client address has a socket of its own.

    Args:
        rules: looked at when a client is heard for the first time.
        journal: what happens goes there.

    Attributes:
        rules, journal: as given.
        family, target: address of the target, set by :meth:`open`.
        stalled: directions in which everything is lost.
    """

    kind: socket.SocketKind = socket.SOCK_DGRAM
    rule_kind: type[Rule] = DatagramRule

    def __init__(self, rules: Sequence[Rule], journal: Journal) -> None:
        self.rules = rules
        self.journal = journal
        self.family: socket.AddressFamily = socket.AF_INET
        self.target: Any = None
        self.stalled: set[Direction] = set()
        self._socket: socket.socket | None = None
        self._address: Any = None
        self._refusing = False
        self._peers: dict[Any, _Peer] = {}
        self._number = 0

    def open(self, host: str, family: socket.AddressFamily, target: Any) -> int:
        """Take datagrams on a free port of ``host``; return it."""
        self.family, self.target = family, target
        self._bind((host, 0))
        self._listen()
        return int(self._address[1])

    @property
    def open_connections(self) -> int:
        """How many clients are known."""
        return len(self._peers)

    def refuse(self, refused: bool) -> None:
        """Close the port, or open it again; it stays ours all the time."""
        if refused == self._refusing:
            return
        self._shut()
        self._bind(self._address)
        self._refusing = refused
        if not refused:
            self._listen()
        elif self._socket is not None:
            # it takes datagrams of that peer alone, which is itself: the system refuses others
            self._socket.connect(self._address)

    def add(self, rules: Sequence[Rule]) -> None:
        """Let rules hold from here on."""
        for peer in self._peers.values():
            peer.add(rules)

    def reset(self, connection: int | None) -> None:
        """Forget a client, or all: the target sees a new one when they speak again."""
        for address, peer in list(self._peers.items()):
            if connection in {None, peer.number}:
                del self._peers[address]
                peer.close()

    def cut(self, connection: int | None) -> None:
        """Forget a client, or all; datagrams know no orderly end."""
        self.reset(connection)

    def stall(self, direction: Direction | None, connection: int | None) -> None:
        """Lose everything; of one client alone is not possible."""
        if connection is not None:
            raise ConfigurationError("on UDP a stall is for every client")
        self.stalled |= set(DIRECTIONS if direction is None else [direction])

    def resume(self) -> None:
        """Pass datagrams again; those that came meanwhile are lost."""
        self.stalled.clear()

    def close(self) -> None:
        """Shut the port and forget everybody, at once."""
        self._shut()
        self.reset(None)

    def send_to_client(self, data: bytes, address: Any) -> None:
        """Send a datagram.

        Raises:
            OSError: the port is shut, or the system does not take it.
        """
        if self._socket is None or self._refusing:
            raise ConnectionRefusedError("the port is shut")
        self._socket.sendto(data, address)

    # ------------------------------------------------------------------ inside

    def _bind(self, address: Any) -> None:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            sock.setblocking(False)
            sock.bind(address)
        except OSError:
            sock.close()
            raise
        self._socket, self._address = sock, sock.getsockname()

    def _listen(self) -> None:
        if self._socket is not None:
            asyncio.get_running_loop().add_reader(self._socket, self._receive, self._socket)

    def _shut(self) -> None:
        sock, self._socket = self._socket, None
        if sock is not None:
            asyncio.get_running_loop().remove_reader(sock)
            sock.close()

    def _receive(self, sock: socket.socket) -> None:
        try:
            data, address = sock.recvfrom(MAX_SIZE)
        except OSError:  # nothing there, or a client's socket is shut, which is not for us to know
            return
        self._peer(address).take("up", data)

    def _peer(self, address: Any) -> _Peer:
        if address not in self._peers:
            if len(self._peers) >= MAX_CLIENTS:
                self.reset(next(iter(self._peers.values())).number)
            self._number += 1
            self._peers[address] = _Peer(self, self._number, address)
            self.journal.note(Entry("connect", self._number))
        return self._peers[address]
