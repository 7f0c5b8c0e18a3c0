"""The tests' event loop: real sockets, and a time that only moves where the loop would wait.

A timeout of an hour takes no time, and none is missed on a slow machine. Two things take real time:
work in the loop's threads, while which time is real, and the way through the system's loopback,
which a datagram of our own goes before the time moves.

What waits for another process, or for a thread that is not the loop's, needs real time: the mark
``real_time`` gives a test the ordinary loop.
"""

from __future__ import annotations

import asyncio
import selectors
import socket
import time
from collections.abc import Callable
from concurrent.futures import Executor
from typing import NoReturn, TypeVar, TypeVarTuple

Arguments = TypeVarTuple("Arguments")
Value = TypeVar("Value")

TURN = 20e-6
"""Seconds that a turn of the loop takes: what is asked again and again has an end."""

LOST = 60.0
"""Real seconds for a datagram on the loopback; then something is wrong with the system."""


class _Selector(selectors.DefaultSelector):
    """Waits for sockets and threads in real time, and for timers not at all."""

    def __init__(self, turn: float) -> None:
        super().__init__()
        self.now = 0.0
        self.threads = 0
        self._turn = turn
        self._courier = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._courier.bind(("127.0.0.1", 0))
        self._courier.connect(self._courier.getsockname())

    def close(self) -> None:
        self._courier.close()
        super().close()

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        self.now += self._turn
        ready = super().select(0)
        if ready or (timeout is not None and timeout <= 0):
            return ready
        if self.threads:
            begun = time.monotonic()
            ready = super().select(timeout)
            self.now += time.monotonic() - begun
            return ready
        self._let_arrive()
        ready = super().select(0)
        if not ready and timeout is None:
            raise RuntimeError("the loop waits for nothing that could ever happen")
        if not ready and timeout is not None:
            self.now += timeout
        return ready

    def _let_arrive(self) -> None:
        """Return when what was written to the loopback has arrived: in order, at nearly all times
        at once, and later where the system is too busy."""
        self._courier.settimeout(LOST)
        self._courier.send(b"?")
        self._courier.recv(1)


class TimedLoop(asyncio.SelectorEventLoop):
    """An event loop whose time begins at 0 and moves where it would wait.

    Args:
        turn: seconds that each turn takes besides.
    """

    def __init__(self, turn: float = TURN) -> None:
        self._timed = _Selector(turn)
        super().__init__(self._timed)

    def time(self) -> float:
        """Return the loop's time, seconds since it was made."""
        return self._timed.now

    def spend(self, seconds: float) -> None:
        """Let a callback take that long."""
        self._timed.now += seconds

    def run_in_executor(
        self, executor: Executor | None, func: Callable[[*Arguments], Value], *args: *Arguments
    ) -> asyncio.Future[Value]:
        """Have a thread do something; the time is real until it is done."""
        done = super().run_in_executor(executor, func, *args)
        self._timed.threads += 1
        done.add_done_callback(self._thread_ended)
        return done

    def _thread_ended(self, _: object) -> None:
        self._timed.threads -= 1

    async def shutdown_default_executor(self, timeout: float | None = None) -> None:
        """Wait for the threads, for which a thread is made."""
        self._timed.threads += 1
        try:
            await super().shutdown_default_executor(*([] if timeout is None else [timeout]))
        finally:
            self._timed.threads -= 1

    async def _make_subprocess_transport(self, *_: object, **__: object) -> NoReturn:
        raise RuntimeError('a process takes real time: mark the test "real_time"')


def spend(seconds: float) -> None:
    """Hold up the loop that runs for that long."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, TimedLoop)
    loop.spend(seconds)
