"""One direction of a TCP connection through the proxy: bytes in, edits, bytes out.

A byte's way: ``Pipe._receive`` -> ``Editor.feed`` -> ``DelayLine`` -> ``Pipe._carry`` -> the other
socket. A pipe that cannot write, or holds enough, reads no more.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from random import Random
from typing import TYPE_CHECKING

from smartcam.emulator._inside import DelayLine, Ending, RealClock
from smartcam.testing.proxy._byte_edits import Edit, Editor
from smartcam.testing.proxy._rules import MAX_HOLD_BYTES, DelayBytes, Direction, Rate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.testing.proxy._rules import Rule
    from smartcam.testing.proxy._tcp import ProxiedConnection

CHUNK = 1 << 16
"""Size of one read in bytes."""

MAX_HELD_BYTES = 1 << 18
"""Largest number of bytes that wait in one direction before the proxy stops reading; one more chunk
and inserted bytes may be added. It leaves room for the bytes that a rule may hold back."""

WRITE_INTERVAL = 0.01
"""Seconds between two writes if the rate is limited."""

TURNS_BETWEEN_WRITES = 2
"""Turns of the event loop between two writes that have to arrive separately: in the first, a
receiver on this loop gets the written bytes, but after this callback."""


class Pipe:
    """One direction: from one socket of a connection to the other."""

    def __init__(
        self,
        connection: ProxiedConnection,
        direction: Direction,
        source: socket.socket,
        target: socket.socket,
        rules: Sequence[Rule],
    ) -> None:
        self.source = source
        self.target = target
        self.finished: bool = False  # whether the sender's end was passed on
        self._connection = connection
        self._direction: Direction = direction
        self._editor = Editor(rules)
        self._line = DelayLine[Edit](
            RealClock(),
            ordered=True,
            turns=TURNS_BETWEEN_WRITES,
            wake=self.run,
            carry=self._carry,
            end=self._end,
            lost=lambda _: None,
        )
        self._delay: tuple[DelayBytes, Random] | None = None
        self._rate: Rate | None = None
        self._set_pace(rules)
        self._loop = asyncio.get_running_loop()
        self._unsent = bytearray()  # bytes after the delay line that wait for socket or rate
        self._free_at = 0.0  # time before which nothing is written
        self._timer: asyncio.TimerHandle | None = None
        self._reading = self._writing = self._eof = self._closed = False

    def start(self) -> None:
        """Begin to read; rules at offset 0 act first."""
        self._take(self._editor.feed(b""))
        self.run()

    def add(self, rules: Sequence[Rule]) -> None:
        """Add rules after the others; their places count from here."""
        self._set_pace(rules)
        self._editor.add([rule.ahead(self._editor.position) for rule in rules])
        self._take(self._editor.feed(b""))
        self.run()

    def run(self) -> None:
        """Do all actions that are possible now."""
        self._stop_waiting()
        if self._stopped or not self._write_out():
            self._line.stop()
        else:
            self._line.go_on()
        self._read_on()

    def close(self) -> None:
        """Release both sockets; nothing is written any more."""
        self._closed = True
        self._line.close()
        self.run()

    # ------------------------------------------------------------------ in

    @property
    def held(self) -> int:
        """The number of bytes that wait."""
        return self._line.size + len(self._unsent)

    def _receive(self) -> None:
        try:
            data = self.source.recv(CHUNK)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            self._connection.lost(self._direction, self._editor.position)
            return
        if data:
            self._take(self._editor.feed(data))
        else:
            self._eof = True
            self._take([Edit([], end=Ending("eof", "eof"))])
        self._line.run()
        self._read_on()

    def _set_pace(self, rules: Sequence[Rule]) -> None:
        """Apply the last rule of each kind."""
        for rule in rules:
            if isinstance(rule, Rate):
                self._rate = rule
            elif isinstance(rule, DelayBytes):
                seed = f"{rule.seed}:{self._connection.number}:{self._direction}"
                self._delay = rule, Random(seed)  # noqa: S311 - jitter, not a secret

    def _take(self, edits: list[Edit]) -> None:
        delay = 0.0
        if self._delay is not None and edits:
            rule, chance = self._delay
            delay = rule.seconds + chance.random() * rule.jitter
        for edit in edits:
            edit.delay = delay
            plain = edit.end is None and edit.gather is None and not edit.pauses
            self._line.put([edit], edit.size if plain else MAX_HOLD_BYTES)

    def _read_on(self) -> None:
        wanted = not (self._eof or self._stopped or self.held >= MAX_HELD_BYTES)
        if wanted and not self._reading:
            self._loop.add_reader(self.source, self._receive)
        elif self._reading and not wanted:
            self._loop.remove_reader(self.source)
        self._reading = wanted

    # ------------------------------------------------------------------ out

    def _carry(self, batch: list[tuple[Edit, bytes]]) -> None:
        for edit, data in batch:
            while edit.faults:
                self._connection.note(edit.faults.pop(0), self._direction, edit.at)
            self._unsent += data
        if not self._write_out():
            self._line.stop()

    def _write_out(self) -> bool:
        """Write waiting bytes; return whether all is written, else :meth:`run` will be called."""
        while self._free_at <= self._loop.time():
            if not self._unsent:
                return True
            size = len(self._unsent)
            if self._rate is not None:
                size = min(size, max(1, int(self._rate.bytes_per_second * WRITE_INTERVAL)))
            written = self._write(self._unsent[:size])
            if not written:
                return False
            del self._unsent[:written]
            if self._rate is not None:
                self._free_at = self._loop.time() + written / self._rate.bytes_per_second
        self._timer = self._loop.call_at(self._free_at, self.run)
        return False

    def _write(self, data: bytearray) -> int:
        """Write once; at 0 the socket is full, and :meth:`run` is called when it is writable."""
        try:
            written = self.target.send(data)
        except (BlockingIOError, InterruptedError):
            self._writing = True
            self._loop.add_writer(self.target, self.run)
            return 0
        except OSError:
            self._connection.lost(self._direction, self._editor.position)
            return 0
        self._connection.carried(self._direction)
        self._connection.log.passed.add(self._direction, written)
        return written

    def _end(self, ending: Ending) -> None:
        if ending.how == "stall":
            self._connection.stall(self._direction)
        elif ending.how == "half_open":
            self._connection.stall(None)
        elif ending.how == "reset":
            self._connection.reset()
        elif ending.how == "close":
            self._connection.cut()
        else:  # end of the sender
            self._connection.note("eof", self._direction, self._editor.position)
            self.finished = True
            end_sending(self.target)
            self._connection.end_if_finished()

    @property
    def _stopped(self) -> bool:
        return self._closed or self._direction in self._connection.stalled

    def _stop_waiting(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._writing:
            self._writing = False
            self._loop.remove_writer(self.target)


def end_sending(sock: socket.socket) -> None:
    """Send FIN, if the peer is still there."""
    with contextlib.suppress(OSError):  # the peer is gone already
        sock.shutdown(socket.SHUT_WR)
