"""One direction of a TCP connection through the proxy: bytes in, edits, bytes out.

A byte's way: ``Pipe._receive`` -> ``Editor.feed`` -> ``DelayLine`` -> ``Pipe._carry`` -> the other
socket. A pipe stops reading while it cannot write, or while enough bytes wait in it.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from random import Random
from typing import TYPE_CHECKING

from smartcam.emulator._inside import DelayLine, Ending, RealClock
from smartcam.testing.proxy._byte_edits import Edit, Editor
from smartcam.testing.proxy._rules import MAX_RULE_BYTES, DelayBytes, Direction, Rate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.testing.proxy._rules import Rule
    from smartcam.testing.proxy._tcp import ProxiedConnection

CHUNK = 1 << 16
"""Size of one read in bytes."""

MAX_QUEUED_BYTES = 1 << 18
"""Number of waiting bytes in one direction at which the proxy stops reading. One more chunk and
inserted bytes may be added. The number exceeds the bytes that a rule may hold back."""

WRITE_INTERVAL = 0.01
"""Seconds between two writes if the rate is limited."""

TURNS_BETWEEN_WRITES = 2
"""Turns of the event loop between two writes that have to arrive separately. A receiver on the same
loop reads the first write in the first turn, after the callback that wrote."""


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
        self.eof_passed: bool = False  # whether the sender's end was passed on
        self._connection = connection
        self._direction: Direction = direction
        self._editor = Editor(rules)
        self._delay_line = DelayLine[Edit](
            RealClock(),
            keeps_order=True,
            turns=TURNS_BETWEEN_WRITES,
            wake=self.run,
            carry=self._carry,
            end=self._end,
            on_dropped=lambda _: None,
        )
        self._delay_rule: tuple[DelayBytes, Random] | None = None
        self._rate_rule: Rate | None = None
        self._set_timing_rules(rules)
        self._loop = asyncio.get_running_loop()
        self._unsent = bytearray()  # bytes after the delay line that wait for socket or rate
        self._next_write_at = 0.0  # time before which nothing is written
        self._timer: asyncio.TimerHandle | None = None
        self._reading = self._writing = self._eof = self._closed = False

    def start(self) -> None:
        """Start reading; rules at offset 0 act first."""
        self._queue_edits(self._editor.feed(b""))
        self.run()

    def add_rules(self, rules: Sequence[Rule]) -> None:
        """Add rules after the present ones; their offsets count from the current position."""
        self._set_timing_rules(rules)
        self._editor.add_rules([rule.moved_later(self._editor.position) for rule in rules])
        self._queue_edits(self._editor.feed(b""))
        self.run()

    def run(self) -> None:
        """Write and read as far as possible now."""
        self._cancel_write_waits()
        if self._stopped or not self._write_out():
            self._delay_line.stop()
        else:
            self._delay_line.go_on()
        self._update_reading()

    def close(self) -> None:
        """Release both sockets; nothing is written any more."""
        self._closed = True
        self._delay_line.close()
        self.run()

    # ------------------------------------------------------------------ in

    @property
    def held_bytes(self) -> int:
        """The number of bytes that wait."""
        return self._delay_line.size + len(self._unsent)

    def _receive(self) -> None:
        try:
            data = self.source.recv(CHUNK)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            self._connection.report_lost(self._direction, self._editor.position)
            return
        if data:
            self._queue_edits(self._editor.feed(data))
        else:
            self._eof = True
            self._queue_edits([Edit([], end=Ending("eof", "eof"))])
        self._delay_line.run()
        self._update_reading()

    def _set_timing_rules(self, rules: Sequence[Rule]) -> None:
        """Keep the last rate rule and the last delay rule."""
        for rule in rules:
            if isinstance(rule, Rate):
                self._rate_rule = rule
            elif isinstance(rule, DelayBytes):
                seed = f"{rule.seed}:{self._connection.number}:{self._direction}"
                self._delay_rule = rule, Random(seed)  # noqa: S311 - jitter, not a secret

    def _queue_edits(self, edits: list[Edit]) -> None:
        delay = 0.0
        if self._delay_rule is not None and edits:
            rule, rng = self._delay_rule
            delay = rule.seconds + rng.random() * rule.jitter
        for edit in edits:
            edit.delay = delay
            has_no_action = edit.end is None and edit.gather is None and not edit.pauses
            self._delay_line.put([edit], edit.size if has_no_action else MAX_RULE_BYTES)

    def _update_reading(self) -> None:
        should_read = not (self._eof or self._stopped or self.held_bytes >= MAX_QUEUED_BYTES)
        if should_read and not self._reading:
            self._loop.add_reader(self.source, self._receive)
        elif self._reading and not should_read:
            self._loop.remove_reader(self.source)
        self._reading = should_read

    # ------------------------------------------------------------------ out

    def _carry(self, batch: list[tuple[Edit, bytes]]) -> None:
        for edit, data in batch:
            while edit.effects:
                self._connection.note(edit.effects.pop(0), self._direction, edit.at)
            self._unsent += data
        if not self._write_out():
            self._delay_line.stop()

    def _write_out(self) -> bool:
        """Write waiting bytes and return True if none is left, else schedule :meth:`run`."""
        while self._next_write_at <= self._loop.time():
            if not self._unsent:
                return True
            size = len(self._unsent)
            if self._rate_rule is not None:
                size = min(size, max(1, int(self._rate_rule.bytes_per_second * WRITE_INTERVAL)))
            written = self._write(self._unsent[:size])
            if not written:
                return False
            del self._unsent[:written]
            if self._rate_rule is not None:
                self._next_write_at = self._loop.time() + written / self._rate_rule.bytes_per_second
        self._timer = self._loop.call_at(self._next_write_at, self.run)
        return False

    def _write(self, data: bytearray) -> int:
        """Write once and return the number of written bytes.

        0: the socket is full, and :meth:`run` is called once it is writable; or the connection is
        lost.
        """
        try:
            written = self.target.send(data)
        except (BlockingIOError, InterruptedError):
            self._writing = True
            self._loop.add_writer(self.target, self.run)
            return 0
        except OSError:
            self._connection.report_lost(self._direction, self._editor.position)
            return 0
        self._connection.note_carried(self._direction)
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
        else:  # the sender has sent FIN
            self._connection.note("eof", self._direction, self._editor.position)
            self.eof_passed = True
            end_sending(self.target)
            self._connection.close_if_finished()

    @property
    def _stopped(self) -> bool:
        return self._closed or self._direction in self._connection.stalled

    def _cancel_write_waits(self) -> None:
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
