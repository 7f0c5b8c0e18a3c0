"""The UDP half of the link proxy: a socket for clients, and one to the target for each client."""

from __future__ import annotations

import functools
import socket
from collections import Counter
from random import Random
from typing import TYPE_CHECKING, Any, ClassVar

from smartcam.emulator._clock import RealClock
from smartcam.emulator.faults._delay_line import DelayLine, Transmission
from smartcam.exceptions import ConfigurationError
from smartcam.testing.proxy._relay import Proxied, Relay
from smartcam.testing.proxy._rules import (
    DIRECTIONS,
    DatagramRule,
    Direction,
    Late,
    Lose,
    Reorder,
    Repeat,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.testing.proxy._rules import Rule

MAX_SIZE = 1 << 16
"""Bytes read of a datagram; none is longer."""

MAX_CLIENTS = 64
"""Client addresses that are known; beyond it the one known longest is forgotten."""

MAX_WAITING = 1024
"""Datagrams that rules hold back; more are lost and counted as ``full``."""


class _Peer(Proxied):
    """One client's address and the socket to the target that is its own."""

    def __init__(self, relay: DatagramRelay, number: int, address: Any) -> None:
        super().__init__(relay, number)
        self.address = address
        self._relay = relay
        self._sock = socket.socket(relay.family, socket.SOCK_DGRAM)
        self._sock.setblocking(False)
        self._sock.connect(relay.target)
        self._loop.add_reader(self._sock, self._receive)
        self._seen: Counter[Direction] = Counter()
        self._lines = {way: self._line(way) for way in DIRECTIONS}
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
            self.note("stall", direction, number)
            return
        sent = Transmission([data])
        for rule, chance in self._rules[direction]:
            if not rule.picks(number, chance):
                continue
            self.note(rule.name, direction, number)
            if isinstance(rule, Lose):
                return
            if isinstance(rule, Repeat):
                sent.parts += [data] * rule.copies
                sent.pauses += [0.0] * rule.copies
            elif isinstance(rule, Late):
                sent.delay += rule.seconds + chance.random() * rule.jitter
            elif isinstance(rule, Reorder):
                sent.gather, sent.behind = (rule.behind, rule.seconds), True
        if (sent.delay or sent.behind) and sum(map(len, self._lines.values())) >= MAX_WAITING:
            self.note("full", direction)
            return
        line = self._lines[direction]
        line.put([sent], 0 if sent.behind else 1)
        line.run()

    def cut(self) -> None:
        """Forget the client; datagrams know no orderly end."""
        self.reset()

    def reset(self) -> None:
        """Forget the client, so that the target sees a new one when it speaks again.

        What is on its way is lost.
        """
        del self._relay.members[self.address]
        for line in self._lines.values():
            line.close()
        self._loop.remove_reader(self._sock)
        self._sock.close()

    # ------------------------------------------------------------------ inside

    def _line(self, way: Direction) -> DelayLine[Transmission]:
        return DelayLine(
            RealClock(),
            ordered=False,
            wake=lambda: self._lines[way].run(),
            carry=functools.partial(self._send, way),
            end=lambda _: None,
            lost=lambda _: None,
        )

    def _receive(self) -> None:
        try:
            data = self._sock.recv(MAX_SIZE)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:  # the system says that nothing listens there
            self.note("no target", "up")
            return
        self.take("down", data)

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

    def stall(self, direction: Direction | None, connection: int | None) -> None:
        """Lose everything; of one client alone is not possible."""
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

    def _turn_away(self) -> None:
        if self._socket is not None:
            # it takes datagrams of that peer alone, which is itself: the system refuses others
            self._socket.connect(self._address)

    def _take_again(self) -> None:
        self._shut()
        self._bind(self._address)
        self._listen()

    def _receive(self, sock: socket.socket) -> None:
        try:
            data, address = sock.recvfrom(MAX_SIZE)
        except OSError:  # nothing there, or a client's socket is shut, which is not for us to know
            return
        self._peer(address).take("up", data)

    def _peer(self, address: Any) -> _Peer:
        if address not in self.members:
            if len(self.members) >= MAX_CLIENTS:
                self.reset(next(iter(self.members.values())).number)
            self._number += 1
            self.members[address] = _Peer(self, self._number, address)
            self.log.note("connect", self._number)
        return self.members[address]
