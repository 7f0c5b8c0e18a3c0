"""The UDP half of the link proxy: a socket for clients, and one to the target for each client."""

from __future__ import annotations

import asyncio
import functools
import socket
from collections import Counter
from random import Random
from typing import TYPE_CHECKING, Any, ClassVar

from smartcam._accepting import Places
from smartcam.emulator._inside import DelayLine, RealClock, Transmission
from smartcam.exceptions import ConfigurationError
from smartcam.testing.proxy._relay import ClientTraffic, Relay
from smartcam.testing.proxy._rules import (
    DIRECTIONS,
    DatagramRule,
    DelayDatagrams,
    Direction,
    DropDatagrams,
    DuplicateDatagrams,
    Reorder,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.testing.proxy._log import LinkLog
    from smartcam.testing.proxy._rules import Rule

MAX_SIZE_BYTES = 1 << 16
"""Largest number of bytes read of a datagram: UDP allows no longer one."""

MAX_CLIENTS = 64
"""Largest number of client addresses. For another one, the proxy forgets the client that has waited
longest for an answer of the target."""

ANSWERED_GRACE = 60.0
"""Seconds after an answer of the target in which its client is not forgotten for another."""

MAX_WAITING_DATAGRAMS = 1024
"""Largest number of datagrams that rules hold back; more are lost and counted as ``full``."""


class _Peer(ClientTraffic):
    """One client's address and its own socket to the target."""

    def __init__(self, relay: DatagramRelay, number: int, address: Any) -> None:
        super().__init__(relay, number)
        self.address = address
        self._relay = relay
        self._answered_at = -ANSWERED_GRACE
        self._sock = socket.socket(relay.family, socket.SOCK_DGRAM)
        try:
            self._sock.setblocking(False)
            self._sock.connect(relay.target)
        except OSError:
            self._sock.close()
            raise
        self._loop.add_reader(self._sock, self._receive)
        self._datagrams: Counter[Direction] = Counter()
        self._delay_lines = {
            direction: self._make_delay_line(direction) for direction in DIRECTIONS
        }
        self._rules: dict[Direction, list[tuple[DatagramRule, Random]]] = {
            direction: [] for direction in DIRECTIONS
        }
        self.add_rules(relay.rules)

    def add_rules(self, rules: Sequence[Rule]) -> None:
        """Add rules after the present ones; their numbers count from the next datagram."""
        for direction in DIRECTIONS:
            for rule in rules:
                if isinstance(rule, DatagramRule) and rule.concerns(self.number, direction):
                    seed = f"{rule.seed}:{self.number}:{direction}"
                    rng = Random(seed)  # noqa: S311 - no secret
                    self._rules[direction].append(
                        (rule.moved_later(self._datagrams[direction]), rng)
                    )

    def pass_datagram(self, direction: Direction, data: bytes) -> None:
        """Apply the rules to a datagram, and send what they leave of it."""
        self._datagrams[direction] += 1
        number = self._datagrams[direction]
        if direction in self._relay.stalled:
            self.note("stall", direction, number)
            return
        transmission = Transmission([data])
        for rule, rng in self._rules[direction]:
            if not rule.picks(number, rng):
                continue
            self.note(rule.name, direction, number)
            if isinstance(rule, DropDatagrams):
                return
            if isinstance(rule, DuplicateDatagrams):
                transmission.parts += [data] * rule.copies
                transmission.pauses += [0.0] * rule.copies
            elif isinstance(rule, DelayDatagrams):
                transmission.delay += rule.seconds + rng.random() * rule.jitter
            elif isinstance(rule, Reorder):
                transmission.gather, transmission.after_gathered = (
                    (rule.overtaken_by, rule.seconds),
                    True,
                )
        if (transmission.delay or transmission.after_gathered) and sum(
            map(len, self._delay_lines.values())
        ) >= MAX_WAITING_DATAGRAMS:
            self.note("full", direction)
            return
        line = self._delay_lines[direction]
        line.put([transmission], 0 if transmission.after_gathered else 1)
        line.run()

    @property
    def keeps_place(self) -> bool:
        """True if the target has answered the client recently."""
        return self._loop.time() - self._answered_at < ANSWERED_GRACE

    def close_for(self, reason: str) -> None:
        """Log that the client was turned away, and forget it."""
        self.note("turned away")
        self.reset()

    def cut(self) -> None:
        """Forget the client; datagrams have no orderly end."""
        self.reset()

    def reset(self) -> None:
        """Forget the client, so that the target sees a new one at its next datagram.

        Datagrams on their way are lost.
        """
        del self._relay.clients[self.address]
        self._relay.places.leave(self)
        for line in self._delay_lines.values():
            line.close()
        self._loop.remove_reader(self._sock)
        self._sock.close()

    # ------------------------------------------------------------------ inside

    def _make_delay_line(self, direction: Direction) -> DelayLine[Transmission]:
        return DelayLine(
            RealClock(),
            keeps_order=False,
            wake=lambda: self._delay_lines[direction].run(),
            carry=functools.partial(self._send, direction),
            end=lambda _: None,
            on_dropped=lambda _: None,
        )

    def _receive(self) -> None:
        try:
            data = self._sock.recv(MAX_SIZE_BYTES)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:  # the system reports that nothing listens there
            self.note("no target", "up")
            return
        self._answered_at = self._loop.time()
        self._relay.places.restart_idle_time(self, self._answered_at)
        self.pass_datagram("down", data)

    def _send(self, direction: Direction, batch: list[tuple[Transmission, bytes]]) -> None:
        for _, data in batch:
            try:
                if direction == "up":
                    self._sock.send(data)
                else:
                    self._relay.send_to_client(data, self.address)
            except (BlockingIOError, InterruptedError):
                self.note("full", direction)
            except OSError:
                self.note("no target" if direction == "up" else "refused", direction)
            else:
                self.log.passed.add(direction)


class DatagramRelay(Relay[_Peer]):
    """Takes datagrams on a port and passes them on; each client address has a socket of its own."""

    kind: ClassVar[socket.SocketKind] = socket.SOCK_DGRAM
    rule_kind: ClassVar[type[Rule]] = DatagramRule

    def __init__(self, rules: Sequence[Rule], log: LinkLog) -> None:
        super().__init__(rules, log)
        self.places: Places[_Peer] = Places(MAX_CLIENTS, session_name="an answer")

    def stall(self, direction: Direction | None, connection: int | None) -> None:
        """Drop everything; UDP cannot stall a single client."""
        if connection is not None:
            raise ConfigurationError("on UDP a stall is for every client")
        super().stall(direction, connection)

    def send_to_client(self, data: bytes, address: Any) -> None:
        """Send a datagram.

        Raises:
            OSError: the port is shut, or the system does not take it.
        """
        if self._socket is None or self._refusing:
            raise ConnectionRefusedError("the port is shut")
        self._socket.sendto(data, address)

    # ------------------------------------------------------------------ inside

    def _refuse_clients(self) -> None:
        if self._socket is not None:
            # connected to itself, the socket gets no datagrams of others
            self._socket.connect(self._address)

    def _accept_clients(self) -> None:
        self._close_socket()
        self._bind(self._address)
        self._listen()

    def _start_accepting(self, sock: socket.socket) -> None:
        asyncio.get_running_loop().add_reader(sock, self._receive, sock)

    def _stop_accepting(self, sock: socket.socket) -> None:
        asyncio.get_running_loop().remove_reader(sock)

    def _receive(self, sock: socket.socket) -> None:
        try:
            data, address = sock.recvfrom(MAX_SIZE_BYTES)
        except OSError:  # no datagram, or an error that a client's closed socket caused
            return
        peer = self.clients.get(address) or self._add_peer(address)
        if peer is not None:
            peer.pass_datagram("up", data)

    def _add_peer(self, address: Any) -> _Peer | None:
        """Return the client for a new address; None if there is no room for it."""
        self._last_number += 1
        try:
            peer = _Peer(self, self._last_number, address)
        except OSError:  # no file descriptor is left
            self.log.note("not accepted", self._last_number)
            return None
        self.clients[address] = peer
        refusal = self.places.enter(peer, str(address[0]), asyncio.get_running_loop().time())
        if refusal:
            peer.close_for(refusal)
            return None
        self.log.note("connect", self._last_number)
        return peer
