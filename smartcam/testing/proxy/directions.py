"""One direction of a TCP connection through the proxy: bytes in, steps, bytes out.

A byte's way: ``Pipe._receive`` -> ``Editor.feed`` -> the queue of steps -> ``Pipe.run`` -> the
other socket. A pipe that cannot write, or holds enough, reads no more.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections import deque
from random import Random
from typing import TYPE_CHECKING, TypeVar

from smartcam.testing.proxy.byte_edits import Act, Editor, Gap, Hold, Note, Send, Step
from smartcam.testing.proxy.rules import Delay, Direction, Rate, Reset, Stall, StreamRule

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.testing.proxy.rules import Rule
    from smartcam.testing.proxy.tcp import Connection

__all__ = ["CHUNK", "MAX_HELD", "Pipe", "end_sending"]

T = TypeVar("T", bound=StreamRule)

CHUNK = 1 << 16
"""Bytes read at once."""

MAX_HELD = 1 << 18
"""Bytes that wait in one direction before the proxy reads no more: one chunk behind the limit and
what rules insert come on top. It leaves room for what a rule may hold back."""

TICK = 0.01
"""Seconds between two writes where the rate is limited."""


class Pipe:
    """One direction: from one socket of a connection to the other."""

    def __init__(
        self,
        connection: Connection,
        direction: Direction,
        source: socket.socket,
        target: socket.socket,
        rules: Sequence[Rule],
    ) -> None:
        self.source = source
        self.target = target
        self.finished: bool = False  # the sender's end has come and was passed on
        self._connection = connection
        self._direction: Direction = direction
        self._editor = Editor(rules)
        self._delay: Delay | None = None
        self._rate: Rate | None = None
        self._chance: Random | None = None
        self._set_pace(rules)
        self._loop = asyncio.get_running_loop()
        self._queue: deque[tuple[float, Step]] = deque()  # when it is due, and what
        self._held = 0  # bytes in the queue
        self._others = 0  # steps in the queue that end a hold
        self._due = 0.0  # of what came last
        self._free_at = 0.0  # nothing is done before
        self._turns = 0  # of the loop, before the next step
        self._hold_until: float | None = None
        self._timer: asyncio.Handle | None = None
        self._reading = self._writing = self._eof = self._closed = False

    def start(self) -> None:
        """Begin to read; what stands at offset 0 is done first."""
        self._take(self._editor.feed(b""))
        self.run()

    def add(self, rules: Sequence[Rule]) -> None:
        """Put rules behind the others; their places count from here."""
        self._set_pace(rules)
        self._editor.add([rule.ahead(self._editor.position) for rule in rules])
        self._take(self._editor.feed(b""))
        self.refresh()

    def refresh(self) -> None:
        """Look again whether the connection is stalled."""
        if self._stopped:
            self._stop_waiting()
            self._set_reading(False)
        else:
            self.run()

    def run(self) -> None:
        """Do what can be done now."""
        self._stop_waiting()
        while self._queue and not self._waits:
            due, step = self._queue[0]
            due = max(due, self._free_at)
            if due > self._loop.time():
                self._timer = self._loop.call_at(due, self.run)
            elif self._turns:
                self._timer = self._loop.call_soon(self._next_turn)
            elif isinstance(step, Send):
                self._send(step)
            elif isinstance(step, Hold):
                self._hold(step)
            else:
                self._pop()
                self._do(step)
        self._set_reading(not (self._eof or self._stopped or self._held >= MAX_HELD))

    def close(self) -> None:
        """Let go of both sockets; nothing is written any more."""
        self._closed = True
        self._stop_waiting()
        self._set_reading(False)
        self._queue.clear()

    # ------------------------------------------------------------------ in

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
            self._take([Act(None)])
        if not self._waits or self._hold_until is not None:
            self.run()
        elif self._eof or self._held >= MAX_HELD:
            self._set_reading(False)

    def _set_pace(self, rules: Sequence[Rule]) -> None:
        self._rate = _last(rules, Rate) or self._rate
        delay = _last(rules, Delay)
        if delay is not None:
            self._delay = delay
            seed = f"{delay.seed}:{self._connection.number}:{self._direction}"
            self._chance = Random(seed)  # noqa: S311 - jitter, not a secret

    def _take(self, steps: list[Step]) -> None:
        if self._delay is not None and self._chance is not None and steps:
            jitter = self._chance.random() * self._delay.jitter
            self._due = self._loop.time() + self._delay.seconds + jitter
        for step in steps:
            self._queue.append((self._due, step))
            self._count(step, 1)

    def _count(self, step: Step, sign: int) -> None:
        if isinstance(step, Send):
            self._held += sign * len(step.data)
        elif not isinstance(step, Note):
            self._others += sign

    def _pop(self) -> None:
        self._count(self._queue.popleft()[1], -1)

    # ------------------------------------------------------------------ out

    def _send(self, step: Send) -> None:
        data = memoryview(step.data)
        size = len(data)
        if step.drip is not None:
            size = 1
        elif self._rate is not None:
            size = min(size, max(1, int(self._rate.bytes_per_second * TICK)))
        written = self._write(data[:size])
        if not written:
            return
        due = self._queue[0][0]
        self._pop()
        if written < len(data):
            rest = step._replace(data=data[written:])
            self._queue.appendleft((due, rest))
            self._count(rest, 1)
        if self._rate is not None:
            self._gap(written / self._rate.bytes_per_second)
        if step.drip is not None:
            self._gap(step.drip)

    def _write(self, data: memoryview) -> int:
        """Write once; at 0 the socket is full and :meth:`run` is called when it is not."""
        try:
            written = self.target.send(data)
        except (BlockingIOError, InterruptedError):
            self._writing = True
            self._loop.add_writer(self.target, self.run)
            return 0
        except OSError:
            self._connection.lost(self._direction, self._editor.position)
            return 0
        self._connection.journal.count_passed(self._direction, written)
        return written

    def _hold(self, step: Hold) -> None:
        """Make one write of what lies behind the step, if it is enough."""
        now = self._loop.time()
        if self._hold_until is None:
            self._hold_until = now + step.seconds
        if self._held < step.size and self._others == 1 and now < self._hold_until:
            self._timer = self._loop.call_at(self._hold_until, self.run)
            return
        self._hold_until = None
        self._pop()
        gathered: list[bytes | memoryview] = []
        due = 0.0
        while self._queue:
            this_due, following = self._queue[0]
            if isinstance(following, Send) and following.drip is None:
                gathered.append(following.data)
                due = this_due
            elif isinstance(following, Note):
                self._do(following)
            else:
                break
            self._pop()
        if gathered:
            whole = Send(b"".join(gathered))
            self._queue.appendleft((due, whole))
            self._count(whole, 1)

    def _do(self, step: Gap | Note | Act) -> None:
        if isinstance(step, Gap):
            self._gap(step.seconds)
        elif isinstance(step, Note):
            self._connection.note(step.what, self._direction, step.at)
        elif isinstance(step.rule, Stall):
            self._connection.stall(None if step.rule.both else self._direction)
        elif isinstance(step.rule, Reset):
            self._connection.reset()
        elif step.rule is not None:
            self._connection.cut()
        else:
            self._end()

    def _end(self) -> None:
        """Pass the sender's end on."""
        self._connection.note("eof", self._direction, self._editor.position)
        self.finished = True
        end_sending(self.target)
        self._connection.end_if_finished()

    # ------------------------------------------------------------------ waiting

    @property
    def _stopped(self) -> bool:
        return self._closed or self._direction in self._connection.stalled

    @property
    def _waits(self) -> bool:
        return self._timer is not None or self._writing or self._stopped

    def _gap(self, seconds: float) -> None:
        if seconds > 0:
            self._free_at = max(self._free_at, self._loop.time() + seconds)
        else:
            # the first turn hands what was written to a receiver on this loop, but behind us
            self._turns = 2

    def _next_turn(self) -> None:
        self._turns -= 1
        self.run()

    def _stop_waiting(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._writing:
            self._writing = False
            self._loop.remove_writer(self.target)

    def _set_reading(self, wanted: bool) -> None:
        if wanted and not self._reading:
            self._loop.add_reader(self.source, self._receive)
        elif self._reading and not wanted:
            self._loop.remove_reader(self.source)
        self._reading = wanted


def _last(rules: Sequence[Rule], kind: type[T]) -> T | None:
    """Return the last rule of a kind."""
    found = [rule for rule in rules if isinstance(rule, kind)]
    return found[-1] if found else None


def end_sending(sock: socket.socket) -> None:
    """Send FIN, where the peer is still there."""
    with contextlib.suppress(OSError):  # the peer is gone already
        sock.shutdown(socket.SHUT_WR)
