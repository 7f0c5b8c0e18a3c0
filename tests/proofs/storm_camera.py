"""A camera written by hand that is late, by chance and on purpose; it knows the truth.

It shares nothing with the library: framing by ``struct``, sockets by asyncio. Each run remembers
which Trigger message began it, counted from 1 as they came in, and says so in its container. So
whoever has counted the triggers he sent knows whose each container is.
"""

from __future__ import annotations

import asyncio
import struct
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, cast

from line_camera import (
    BUSY,
    CONNECT,
    ID_READY,
    ID_TRIGGER_ERROR,
    ID_WAITING,
    INPUT,
    LOAD_TIME,
    NOK_BUSY,
    NOK_INSPECTION,
    OK,
    OK_INSPECTION_ID,
    OVERTRIGGERED,
    OVERTRIGGERED_TIME,
    QUERY,
    RESET,
    RESULT,
    RUNNING,
    STATUS,
    SWITCH,
    TRIGGER,
    WAITING,
    WIRES,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from random import Random
    from typing import Self

INPUT_CONTAINER = 0x004

CONTAINER = struct.Struct("<5i")
FIELDS = "number: int32{mark}, trigger: int32, run: int32, token: int32, part: int32"
EXTERNAL = 0
"""In place of a trigger's count: a run that the digital input began."""

QUEUE_DEPTH = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Habits:
    """How a camera is late. Shares are 0 to 1, times seconds.

    Attributes:
        delays: of a run, shortest and longest, as multiples of :attr:`StormCamera.pace`.
        waiting_first: share of the runs whose Waiting for Trigger rises before their results.
        apart: share of the runs with a pause between results and status.
        longest_pause: the longest of these.
        second: share of the runs that send a second container.
        second_apart: and pause before it.
        external: mean time between two triggers of the digital input, as a multiple of the pace
            too; 0 for none.
        held: share of the datagrams with a result that the network holds back; others pass them.
        longest_hold: how long at most.
        reads_input: the application has a "receive data" tool.
        latency: of the link, each way.
    """

    delays: tuple[float, float] = (0.1, 1.3)
    waiting_first: float = 0.5
    apart: float = 0.3
    longest_pause: float = 0.003
    second: float = 0.0
    second_apart: bool = False
    external: float = 0.0
    held: float = 0.0
    longest_hold: float = 0.01
    reads_input: bool = False
    latency: float = 0.0


class Sent(NamedTuple):
    """A container that was sent: of which trigger, and its place among those of its run, from 0."""

    trigger: int
    part: int


@dataclass(slots=True)
class _Run:
    index: int
    trigger: int
    number: int
    token: int
    steps: list[tuple[float, Callable[[], None]]] = field(default_factory=list)
    timer: asyncio.TimerHandle | None = None


class StormCamera:
    """One camera on a free port of the loopback; an asynchronous context manager.

    Args:
        dialect: ``handbook``, ``thesis``, ``b16`` or ``bid``.
        transport: ``tcp`` or ``udp``.
        habits: how it is late.
        chance: decides when, and how much.

    Attributes:
        pace: seconds that a run takes, more or less.
        triggers: Trigger messages that came.
        sent: the containers that were sent, in order.
        overtriggers: times Overtriggered rose.
        voided: runs that a Stop has ended.
    """

    def __init__(self, *, dialect: str, transport: str, habits: Habits, chance: Random) -> None:
        self.dialect = dialect
        self.transport = transport
        self.habits = habits
        self.pace = 0.01
        self.triggers = 0
        self.sent: list[Sent] = []
        self.overtriggers = 0
        self.voided = 0
        self._chance = chance
        self._wire = WIRES[dialect]
        self._coded = dialect == "bid"  # it runs always, tells codes, and its status if asked
        self._active = 1
        self._conditions = 0
        self._running = self._waiting = True
        self._number = self._runs = 0
        self._inputs: deque[int] = deque()
        self._last_input = 0
        self._under_way: list[_Run] = []
        self._held = 0
        self._session = False
        self._reported: int | None = None
        self._out: list[bytes] = []
        self._buffer = b""
        self._peer: tuple[str, int] | None = None
        self._port = 0
        self._server: asyncio.Server | None = None
        self._link: asyncio.BaseTransport | None = None
        self._coming: deque[tuple[bytes, tuple[str, int] | None]] = deque()
        self._going: deque[list[bytes]] = deque()
        self._timers: set[asyncio.TimerHandle] = set()
        self._overtrigger_ends: asyncio.TimerHandle | None = None
        self._external: asyncio.TimerHandle | None = None
        self._quiet = asyncio.Event()
        self._closed = asyncio.Event()

    # ------------------------------------------------------------------ life

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        if self.transport == "tcp":
            self._server = await self._loop.create_server(lambda: _Stream(self), "127.0.0.1", 0)
            self._port = self._server.sockets[0].getsockname()[1]
        else:
            endpoint, _ = await self._loop.create_datagram_endpoint(
                lambda: _Datagrams(self), local_addr=("127.0.0.1", 0)
            )
            self._port = endpoint.get_extra_info("sockname")[1]
        self._plan_external()
        return self

    async def __aexit__(self, *_: object) -> None:
        self.calm()
        for run in self._under_way:
            _cancel(run.timer)
        for timer in self._timers:
            timer.cancel()
        if self._server is not None:
            self._server.close()
        if self._link is not None:
            cast("asyncio.WriteTransport", self._link).abort()
            await self._closed.wait()

    @property
    def url(self) -> str:
        """Its address, the dialect pinned."""
        scheme = {"tcp": "bvs", "udp": "bvs+udp"}[self.transport]
        return f"{scheme}://127.0.0.1:{self._port}?dialect={self.dialect}"

    def calm(self) -> None:
        """Have no more runs that nobody asked for."""
        _cancel(self._external)
        self._external = None

    async def quiet(self) -> None:
        """Wait until no run is under way and the network holds nothing."""
        while self._under_way or self._held:
            self._quiet.clear()
            await self._quiet.wait()

    # ------------------------------------------------------------------ runs

    def _trigger(self, trigger: int) -> None:
        if not self._running:
            return
        if not self._waiting:
            self._overtrigger()
            return
        self._runs += 1
        run = _Run(self._runs, trigger, self._number, self._take_input())
        self._number = (self._number + 1) & 0x7FFFFFFF
        self._waiting = False
        self._under_way.append(run)
        self._report()
        run.steps = self._plan(run)
        self._go_on(run)

    def _plan(self, run: _Run) -> list[tuple[float, Callable[[], None]]]:
        """Return what the run does, each with the time before it."""
        habits, chance = self.habits, self._chance

        def pause(share: float) -> float:
            return chance.uniform(0, habits.longest_pause) if chance.random() < share else 0.0

        results = [(0.0, lambda: self._send_result(run, 0))]
        if chance.random() < habits.second:
            before = pause(1.0) if habits.second_apart else 0.0
            results.append((before, lambda: self._send_result(run, 1)))
        waiting = [(0.0, self._wait_again)]
        first, then = (results, waiting)
        if chance.random() < habits.waiting_first:
            first, then = then, first
        then[0] = (pause(habits.apart), then[0][1])
        first[0] = (self.pace * chance.uniform(*habits.delays), first[0][1])
        return [*first, *then]

    def _go_on(self, run: _Run) -> None:
        """Do what is due now, together; then set a timer for the rest."""
        while run.steps:
            before, step = run.steps[0]
            if before:
                run.steps[0] = (0.0, step)
                run.timer = self._loop.call_later(before, self._wake, run)
                return
            run.steps.pop(0)
            step()
        self._under_way.remove(run)
        self._look_quiet()

    def _wake(self, run: _Run) -> None:
        self._go_on(run)
        self._flush()

    def _wait_again(self) -> None:
        self._waiting = True
        self._report()

    def _send_result(self, run: _Run, part: int) -> None:
        if not self._session:
            return
        self.sent.append(Sent(run.trigger, part))
        data = CONTAINER.pack(run.number, run.trigger, run.index, run.token, part)
        frame = self._wire.frame(RESULT, self._wire.words(self._active) + data)
        if self._chance.random() < self.habits.held:
            self._flush()
            self._held += 1
            self._later(self._chance.uniform(0, self.habits.longest_hold), self._release, frame)
        else:
            self._out.append(frame)

    def _release(self, frame: bytes) -> None:
        self._held -= 1
        self._out.append(frame)
        self._look_quiet()

    def _overtrigger(self) -> None:
        if not self._conditions & OVERTRIGGERED:
            self.overtriggers += 1
        self._set(OVERTRIGGERED, True)
        if self._coded:
            return  # until it is reset
        _cancel(self._overtrigger_ends)
        self._overtrigger_ends = self._later(OVERTRIGGERED_TIME, self._set, OVERTRIGGERED, False)

    def _plan_external(self) -> None:
        if self.habits.external:
            delay = self._chance.expovariate(1 / (self.habits.external * self.pace))
            self._external = self._loop.call_later(delay, self._digital_input)

    def _digital_input(self) -> None:
        self._plan_external()
        self._trigger(EXTERNAL)
        self._flush()

    # ------------------------------------------------------------------ input data

    def _give_input(self, payload: bytes) -> None:
        if not self.habits.reads_input or len(payload) != 4:
            return
        if self._coded:
            self._last_input = struct.unpack("<i", payload)[0]
            self._say(INPUT, OK)
            return
        self._inputs.append(struct.unpack("<i", payload)[0])
        if len(self._inputs) > QUEUE_DEPTH:
            self._inputs.popleft()
            self._set(INPUT_CONTAINER, True)

    def _take_input(self) -> int:
        if not self.habits.reads_input:
            return 0
        self._set(INPUT_CONTAINER, not self._inputs and not self._coded)
        if self._inputs:
            self._last_input = self._inputs.popleft()
        return self._last_input

    # ------------------------------------------------------------------ what comes

    def arrive(self, data: bytes, peer: tuple[str, int] | None = None) -> None:
        """Take bytes of a stream, or a datagram, as soon as the link has brought them."""
        if self.habits.latency:
            self._coming.append((data, peer))
            self._later(self.habits.latency, lambda: self._take(*self._coming.popleft()))
        else:
            self._take(data, peer)

    def _take(self, data: bytes, peer: tuple[str, int] | None) -> None:
        self._peer = peer
        self._buffer += data
        while frame := self._wire.read(self._buffer):
            message_id, payload = frame
            self._buffer = self._buffer[self._wire.size + len(payload) :]
            if message_id == CONNECT:
                self._connect()
            elif self._session:
                self._obey(message_id, payload)
            self._flush()

    def _connect(self) -> None:
        self._session, self._reported = True, None
        self._say(CONNECT, *([OK] if self._coded else []), 1)
        self._report()

    def _obey(self, message_id: int, payload: bytes) -> None:
        match message_id:
            case 0x02:
                self._session = False
            case 0x12 if self._coded:
                self._tell_status()
            case 0x16 if self._coded:
                self._say(RESET, OK)
                self._set(OVERTRIGGERED, False)
                self._tell_status()
            case 0x30 if self._coded:
                busy = self._conditions & BUSY
                self._say(QUERY, *((NOK_BUSY, 0) if busy else (OK_INSPECTION_ID, self._active)))
            case 0x30:
                self._say(QUERY, self._active)
            case 0x31:
                self._switch(int.from_bytes(payload, "little"))
            case 0x34:
                self._give_input(payload)
            case 0x35 if not self._coded:
                (self._number,) = struct.unpack("<I", payload)
            case 0x40:
                self.triggers += 1
                if self._coded:
                    self._say(TRIGGER, NOK_BUSY if self._conditions & BUSY else OK)
                self._trigger(self.triggers)
            case 0x41 if not self._coded:
                self._run(True)
            case 0x42 if not self._coded:
                self._run(False)
            case _:
                raise AssertionError(f"message {message_id:#04x} was not expected")

    def _tell_status(self) -> None:
        word = ID_READY if not self._conditions & BUSY else 0
        word |= ID_WAITING if self._running and self._waiting else 0
        word |= ID_TRIGGER_ERROR if self._conditions & OVERTRIGGERED else 0
        self._say(STATUS, word)

    def _run(self, running: bool) -> None:
        """Start or stop; a stop voids the inspection under way."""
        if self._running == running or self._conditions & BUSY:
            return
        self._running = self._waiting = running
        if not running:
            self._void()
        self._report()

    def _void(self) -> None:
        self.voided += len(self._under_way)
        for run in self._under_way:
            _cancel(run.timer)
        self._under_way.clear()
        self._look_quiet()

    def _switch(self, application: int) -> None:
        if self._coded and self._conditions & BUSY:
            self._say(SWITCH, NOK_BUSY, self._active)
            return
        if (self._running and not self._coded) or application not in {1, 2}:
            self._say(SWITCH, NOK_INSPECTION if self._coded else 1, self._active)
            return
        if self._coded:
            self._running = False
            self._void()
        self._set(BUSY, True)
        self._later(LOAD_TIME, self._loaded, application)

    def _loaded(self, application: int) -> None:
        self._active = application
        self._inputs.clear()
        if self._coded:
            self._running = self._waiting = True
        self._set(BUSY | INPUT_CONTAINER, False)
        self._say(SWITCH, 0, application)

    # ------------------------------------------------------------------ what goes

    def _set(self, condition: int, on: bool) -> None:
        self._conditions = self._conditions | condition if on else self._conditions & ~condition
        self._report()

    def _report(self) -> None:
        """Send the status if it has changed."""
        status = self._conditions
        status |= RUNNING if self._running else 0
        status |= WAITING if self._running and self._waiting else 0
        if self._session and status != self._reported and not self._coded:
            self._reported = status
            self._say(STATUS, status, *([0] if self._wire.word == "I" else []))

    def _say(self, message_id: int, *words: int) -> None:
        self._out.append(self._wire.frame(message_id, self._wire.words(*words)))

    def _flush(self) -> None:
        frames, self._out = self._out, []
        if frames and self.habits.latency:
            self._going.append(frames)
            self._later(self.habits.latency, lambda: self._write(self._going.popleft()))
        elif frames:
            self._write(frames)

    def _write(self, frames: list[bytes]) -> None:
        if self._link is None or self._link.is_closing():
            return
        if self.transport == "tcp":
            cast("asyncio.WriteTransport", self._link).write(b"".join(frames))
            return
        for frame in frames:
            cast("asyncio.DatagramTransport", self._link).sendto(frame, self._peer)

    def _later(
        self, seconds: float, action: Callable[..., None], *arguments: object
    ) -> asyncio.TimerHandle:
        def act() -> None:
            self._timers.discard(timer)
            action(*arguments)
            self._flush()

        timer = self._loop.call_later(seconds, act)
        self._timers.add(timer)
        return timer

    def _look_quiet(self) -> None:
        if not self._under_way and not self._held:
            self._quiet.set()

    # ------------------------------------------------------------------ the socket

    def opened(self, transport: asyncio.BaseTransport) -> None:
        """A connection, or the datagram socket, is open; only one is served."""
        self._link, self._buffer = transport, b""

    def lost(self) -> None:
        """It is gone."""
        self._closed.set()


def _cancel(timer: asyncio.TimerHandle | None) -> None:
    if timer is not None:
        timer.cancel()


class _Stream(asyncio.Protocol):
    def __init__(self, camera: StormCamera) -> None:
        self._camera = camera

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._camera.opened(transport)

    def data_received(self, data: bytes) -> None:
        self._camera.arrive(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._camera.lost()


class _Datagrams(asyncio.DatagramProtocol):
    def __init__(self, camera: StormCamera) -> None:
        self._camera = camera

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._camera.opened(transport)

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        self._camera.arrive(data, addr)

    def connection_lost(self, exc: Exception | None) -> None:
        self._camera.lost()
