"""A camera at the end of a line, written by hand: it does what the promises assume, to the letter.

What ``docs/promises.md`` assumes of a camera (A to J) it does, and it uses every freedom that these
leave: results and Waiting for Trigger in any order and apart, as long as all that a run has to say
is said before the next one shows; runs that a sensor began; results and statuses that are on the
line while a trigger comes the other way. It shares nothing with the library: framing by ``struct``,
sockets by asyncio.

It knows the truth. Each run remembers which Trigger message began it, counted from 1 in each
session, or that a sensor did, and when; each container says which run it is of.

A script drives it by steps (``line.hold()``, ``let_out()``, ``sensor()``), chance by pauses and
delays: the camera is the same.
"""

from __future__ import annotations

import asyncio
import struct
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar, cast

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import Self

CONNECT, DISCONNECT, STATUS, RESET, RESULT = 0x01, 0x02, 0x12, 0x16, 0x20
QUERY, SWITCH, INPUT, NUMBER = 0x30, 0x31, 0x34, 0x35
TRIGGER, START, STOP = 0x40, 0x41, 0x42

BUSY, RUNNING, OVERTRIGGERED, WAITING = 0x010, 0x080, 0x100, 0x200

ID_WAITING, ID_READY, ID_TRIGGER_ERROR = 0x001, 0x020, 0x100
OK, OK_INSPECTION_ID, NOK_BUSY, NOK_INSPECTION = 0x00, 0x02, 0x16, 0x1A
"""Status bits and result codes of ``bid``."""

CONTAINER = struct.Struct("<I4i")
REST = "session: int32, trigger: int32, run: int32, part: int32"
LAYOUTS = {
    "": f"number: uint32, {REST}",
    "int32": f"number: int32 @sequence, {REST}",
    "int16": f"number: int16 @sequence, above: uint16, {REST}",
    "int8": f"number: int8 @sequence, above: uint8, more: uint16, {REST}",
}
"""What the client is told of the container, by the type of the number that it is to look at."""

SENSOR = 0
"""In place of a trigger's count: a run that a sensor began."""

AGAIN = -1
"""In place of a result's part: the run says that the camera waits for a trigger again."""

APPLICATIONS = (1, 2)
OVERTRIGGERED_TIME = 0.002
LOAD_TIME = 0.001

Frame = tuple[int, bytes]
Step = tuple[float | None, int]
"""What a run says, and the pause before it: seconds, or None for "until it is told to go on"."""

ItemT = TypeVar("ItemT")


class Wire(NamedTuple):
    """What frames look like: struct code of the integers, magic, what the length counts too."""

    word: str
    magic: bytes = b""
    beyond: int = 0

    @property
    def size(self) -> int:
        """Bytes of a header."""
        return len(self.magic) + 2 * struct.calcsize(self.word)

    def words(self, *values: int) -> bytes:
        """Return integers as they are on the wire."""
        return struct.pack(f"<{len(values)}{self.word}", *values)

    def frame(self, message_id: int, payload: bytes) -> bytes:
        """Return a frame."""
        length = len(payload) + self.beyond
        numbers = (length, message_id) if self.magic else (message_id, length)
        return self.magic + self.words(*numbers) + payload

    def read(self, data: bytes) -> Frame | None:
        """Return the first frame's id and payload, None while it is not whole."""
        if len(data) < self.size:
            return None
        assert data.startswith(self.magic), f"no frame begins with {data[:12].hex()}"
        first, second = struct.unpack_from(f"<2{self.word}", data, len(self.magic))
        message_id, length = (second, first - self.beyond) if self.magic else (first, second)
        end = self.size + length
        return (message_id, data[self.size : end]) if len(data) >= end else None


WIRES = {
    "handbook": Wire("I", bytes.fromhex("50535642")),
    "thesis": Wire("I", bytes.fromhex("42565350"), 4),
    "b16": Wire("H"),
    "bid": Wire("H"),
}


class Line(Generic[ItemT]):
    """One direction of the link: brings what is put in, in order, after its delay.

    Args:
        deliver: takes what has come.
        delay: seconds that the next one takes.
    """

    def __init__(self, deliver: Callable[[ItemT], None], delay: Callable[[], float]) -> None:
        self._deliver = deliver
        self._delay = delay
        self._on_the_way: deque[tuple[float, ItemT]] = deque()
        self._held = False
        self._timer: asyncio.TimerHandle | None = None
        self._last = 0.0

    def put(self, item: ItemT) -> None:
        """Send something on its way."""
        now = asyncio.get_running_loop().time()
        self._last = max(self._last, now + self._delay())
        self._on_the_way.append((self._last, item))
        self._go()

    def hold(self) -> None:
        """Have everything from now on stay on its way."""
        self._held = True

    def release(self) -> None:
        """Have it arrive."""
        self._held = False
        self._go()

    def pass_on(self) -> None:
        """Have the first thing that is held arrive, and no more."""
        self._deliver(self._on_the_way.popleft()[1])

    @property
    def empty(self) -> bool:
        """Whether nothing is on its way."""
        return not self._on_the_way

    def close(self) -> None:
        """Forget what is on its way."""
        _cancel(self._timer)
        self._on_the_way.clear()

    def _go(self) -> None:
        loop = asyncio.get_running_loop()
        while self._on_the_way and not self._held:
            due, item = self._on_the_way[0]
            if due > loop.time():
                if self._timer is None:
                    self._timer = loop.call_at(due, self._wake)
                return
            self._on_the_way.popleft()
            self._deliver(item)

    def _wake(self) -> None:
        self._timer = None
        self._go()


@dataclass(slots=True, eq=False)
class Run:
    """One inspection.

    Attributes:
        index: which, from 1.
        session: in which it was triggered, counted from 1 by the Connects that came.
        trigger: which Trigger message of that session began it, :data:`SENSOR` for none.
        application: that made it.
        number: its sequence number.
        began: when, as the loop says.
        steps: what it has still to say.
    """

    index: int
    session: int
    trigger: int
    application: int
    number: int
    began: float
    steps: deque[Step] = field(default_factory=deque)
    timer: asyncio.TimerHandle | None = None


@dataclass(slots=True, eq=False)
class Peer:
    """A connection, or the other end of the datagrams."""

    transport: asyncio.BaseTransport
    address: tuple[str, int] | None = None
    buffer: bytes = b""
    gone: bool = False


def at_once(_: Run) -> Sequence[Step]:
    """Return the steps of a run that sends one result and takes no time."""
    return ((0.0, 0), (0.0, AGAIN))


def _no_delay() -> float:
    return 0.0


def _nothing_more(_: int, __: int | None) -> None:
    """What happens around a trigger where nobody says otherwise."""


def _always_once(_: int) -> Sequence[float]:
    return (0.0,)


class LineCamera:
    """One camera on a free port of the loopback; an asynchronous context manager.

    Args:
        dialect: ``handbook``, ``thesis``, ``b16`` or ``bid``.
        transport: ``tcp`` or ``udp``.
        delay: seconds that what is put on the line takes, each time anew.

    Attributes:
        plan: says what a run's steps are.
        before: called with a Trigger's count and the number that came with it, before anything of
            the write that brings it is taken: what the camera says here is on the line already
            when the trigger goes out.
        between: likewise, behind what came in front of number, input and Trigger in that write: the
            camera takes one message after the other, and a sensor may come between.
        network: of a datagram, by message id: after how many seconds each copy of it arrives;
            empty, it is lost. What comes is asked as the negative id, and is lost or not.
        towards: the line to the camera, of the frames of one write each.
        back: the line from it, of what it says at one moment.
        writes, arrived: writes, and Trigger messages, that came to the camera's socket.
        triggers: those that it took, of all sessions.
        sessions: Connects that it took.
        runs: all inspections, by index.
        sent: containers that were sent, by session.
        overtriggers: times Overtriggered rose.
    """

    def __init__(
        self,
        *,
        dialect: str = "handbook",
        transport: str = "tcp",
        delay: Callable[[], float] = _no_delay,
    ) -> None:
        self.dialect = dialect
        self.transport = transport
        self.plan: Callable[[Run], Sequence[Step]] = at_once
        self.before: Callable[[int, int | None], None] = _nothing_more
        self.between: Callable[[int, int | None], None] = _nothing_more
        self.network: Callable[[int], Sequence[float]] = _always_once
        self.towards: Line[tuple[Peer, list[Frame] | None]] = Line(self._take, delay)
        self.back: Line[tuple[Peer, list[Frame]]] = Line(self._write, delay)
        self.writes = self.arrived = self.triggers = self.sessions = 0
        self.runs: dict[int, Run] = {}
        self.sent: Counter[int] = Counter()
        self.overtriggers = 0
        self._wire = WIRES[dialect]
        self._coded = dialect == "bid"  # it runs always, tells codes, and its status if asked
        self._in_session = 0  # triggers that came in the present one
        self._active = 1
        self._conditions = 0
        self._running = self._waiting = True
        self._number = 0
        self._under_way: list[Run] = []
        self._reported: int | None = None
        self._out: list[Frame] = []
        self._peer: Peer | None = None  # who has the session
        self._connections: set[Peer] = set()
        self._port = 0
        self._server: asyncio.Server | None = None
        self._timers: set[asyncio.TimerHandle] = set()
        self._overtriggered_until: asyncio.TimerHandle | None = None
        self._closed = asyncio.Event()

    # ------------------------------------------------------------------ life

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        if self.transport == "tcp":
            self._server = await loop.create_server(lambda: _Stream(self), "127.0.0.1", 0)
            self._port = self._server.sockets[0].getsockname()[1]
        else:
            endpoint, _ = await loop.create_datagram_endpoint(
                lambda: _Datagrams(self), local_addr=("127.0.0.1", 0)
            )
            self._port = endpoint.get_extra_info("sockname")[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self.towards.close()
        self.back.close()
        for run in self._under_way:
            _cancel(run.timer)
        for timer in self._timers:
            timer.cancel()
        if self._server is not None:
            self._server.close()
        while self._connections:
            self._closed.clear()
            for peer in self._connections:
                cast("asyncio.WriteTransport", peer.transport).abort()
            await self._closed.wait()

    @property
    def url(self) -> str:
        """Its address, the dialect pinned."""
        scheme = {"tcp": "bvs", "udp": "bvs+udp"}[self.transport]
        return f"{scheme}://127.0.0.1:{self._port}?dialect={self.dialect}"

    @property
    def idle(self) -> bool:
        """Whether no run is under way and nothing is on the line."""
        return not self._under_way and self.towards.empty and self.back.empty

    @property
    def takes_trigger(self) -> bool:
        """Whether a trigger would begin a run."""
        return self._running and self._waiting and not self._conditions & BUSY

    @property
    def is_running(self) -> bool:
        """Whether an application is in run mode."""
        return self._running

    @property
    def next_number(self) -> int:
        """The number of the next run."""
        return self._number

    def drop_link(self) -> None:
        """Reset the connection of the session; what is on the line is lost."""
        if self._peer is not None and self.transport == "tcp":
            peer, self._peer = self._peer, None
            peer.gone = True
            cast("asyncio.WriteTransport", peer.transport).abort()

    # ------------------------------------------------------------------ what others do to it

    def sensor(self) -> None:
        """A sensor triggers."""
        self._trigger(SENSOR, self.plan)
        self._flush()

    def sensor_runs(self, count: int, *, shown: int = 1_200) -> None:
        """A sensor triggers again and again, each time when the last run is over.

        Args:
            count: how often.
            shown: the last ones, which are said; the others are counted on only.
        """

        def without_pauses(run: Run) -> Sequence[Step]:
            return [(0.0, what) for _, what in self.plan(run)]

        self._number = (self._number + max(0, count - shown)) & 0xFFFFFFFF
        for _ in range(min(count, shown)):
            self._trigger(SENSOR, without_pauses)
        self._flush()

    def let_out(self) -> None:
        """Have each run that waits to be told go on, up to where it waits again."""
        for run in tuple(self._under_way):
            if run.steps and run.steps[0][0] is None:
                run.steps[0] = (0.0, run.steps[0][1])
                self._go_on(run)
        self._flush()

    def stop(self) -> None:
        """An operator stops the application, if it runs."""
        self._run(False)
        self._flush()

    def start(self) -> None:
        """An operator starts it."""
        self._run(True)
        self._flush()

    def load(self, application: int) -> None:
        """An operator loads an application, if none runs."""
        if not self._running and not self._conditions & BUSY:
            self._set(BUSY, True)
            self._later(LOAD_TIME, self._loaded, application, False)
            self._flush()

    # ------------------------------------------------------------------ runs

    def _trigger(self, trigger: int, plan: Callable[[Run], Sequence[Step]]) -> None:
        if not self._running:
            return
        if not self.takes_trigger:
            self._overtrigger()
            return
        for earlier in tuple(self._under_way):  # D: it has said everything before this one shows
            earlier.steps = deque((0.0, what) for _, what in earlier.steps)
            _cancel(earlier.timer)
            self._go_on(earlier)
        index = len(self.runs) + 1
        run = Run(
            index,
            self.sessions,
            trigger,
            self._active,
            self._number,
            asyncio.get_running_loop().time(),
        )
        self.runs[index] = run
        self._number = (self._number + 1) & 0xFFFFFFFF
        self._waiting = False
        self._under_way.append(run)
        self._report()
        run.steps.extend(plan(run))
        self._go_on(run)

    def _go_on(self, run: Run) -> None:
        """Say what is due now, together; then wait."""
        while run.steps:
            pause, what = run.steps[0]
            if pause is None:
                return
            if pause:
                run.steps[0] = (0.0, what)
                run.timer = asyncio.get_running_loop().call_later(pause, self._wake, run)
                return
            run.steps.popleft()
            if what == AGAIN:
                self._waiting = True
                self._report()
            else:
                self._send_result(run, what)
        self._under_way.remove(run)

    def _wake(self, run: Run) -> None:
        self._go_on(run)
        self._flush()

    def _send_result(self, run: Run, part: int) -> None:
        if self._peer is None:
            return
        self.sent[self.sessions] += 1
        data = CONTAINER.pack(run.number, run.session, run.trigger, run.index, part)
        self._out.append((RESULT, self._wire.words(run.application) + data))

    def _overtrigger(self) -> None:
        if not self._conditions & OVERTRIGGERED:
            self.overtriggers += 1
        self._set(OVERTRIGGERED, True)
        if self._coded:
            return  # until it is reset
        _cancel(self._overtriggered_until)
        self._overtriggered_until = self._later(OVERTRIGGERED_TIME, self._set, OVERTRIGGERED, False)

    def _run(self, running: bool) -> None:
        """Start or stop; a stop voids the inspection under way."""
        if self._running == running or self._conditions & BUSY:
            return
        if not running:
            self._void()
        self._running = self._waiting = running
        self._report()

    def _void(self) -> None:
        """Forget the inspection under way; one that is over says the rest."""
        for run in tuple(self._under_way):
            _cancel(run.timer)
            if any(what == AGAIN for _, what in run.steps):
                run.steps.clear()
            run.steps = deque((0.0, what) for _, what in run.steps)
            self._go_on(run)

    def _loaded(self, application: int, answer: bool) -> None:
        self._active = application
        if self._coded:
            self._running = self._waiting = True
        self._set(BUSY, False)
        if answer:
            self._say(SWITCH, 0, application)

    # ------------------------------------------------------------------ what comes

    def arrive(self, peer: Peer, data: bytes) -> None:
        """Take bytes of a stream, or a datagram, as they come to the socket."""
        peer.buffer += data
        frames: list[Frame] = []
        while (frame := self._wire.read(peer.buffer)) is not None:
            frames.append(frame)
            peer.buffer = peer.buffer[self._wire.size + len(frame[1]) :]
        if frames:
            self.writes += 1
            self.arrived += sum(message_id == TRIGGER for message_id, _ in frames)
            self.towards.put((peer, frames))

    def _take(self, item: tuple[Peer, list[Frame] | None]) -> None:
        peer, frames = item
        if frames is None:
            if self._peer is peer:
                self._peer = None
            return
        around = (self.triggers + 1, _number_in(frames))
        triggers = any(message_id == TRIGGER for message_id, _ in frames) and self._peer is peer
        if triggers:
            self.before(*around)
        for message_id, payload in frames:
            if triggers and message_id in {NUMBER, INPUT, TRIGGER}:
                triggers = False
                self.between(*around)
            if message_id == CONNECT:
                self._connect(peer)
            elif self._peer is peer and (self.transport == "tcp" or self.network(-message_id)):
                self._obey(message_id, payload)
            elif self._peer is peer and message_id == TRIGGER:
                self._count_trigger()  # it is lost
        self._flush()

    def _connect(self, peer: Peer) -> None:
        if self._peer is not None and self._peer is not peer:
            self._peer.gone = True
            self._peer.transport.close()
        self.sessions += 1
        self._in_session = 0
        self._peer = None if peer.gone else peer
        self._reported = None
        self._say(CONNECT, *([OK] if self._coded else []), 1)
        self._report()

    def _count_trigger(self) -> None:
        self.triggers += 1
        self._in_session += 1

    def _obey(self, message_id: int, payload: bytes) -> None:
        match message_id:
            case 0x02:
                if self._coded:
                    self._say(DISCONNECT, OK)
                    self._flush()
                self._peer = None
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
            case 0x34 if self._coded:
                self._say(INPUT, OK)
            case 0x34:
                pass
            case 0x35 if not self._coded:
                (self._number,) = struct.unpack("<I", payload)
            case 0x40:
                self._count_trigger()
                if self._coded:
                    self._say(TRIGGER, NOK_BUSY if self._conditions & BUSY else OK)
                self._trigger(self._in_session, self.plan)
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

    def _switch(self, application: int) -> None:
        if self._coded and self._conditions & BUSY:
            self._say(SWITCH, NOK_BUSY, self._active)
            return
        if (self._running and not self._coded) or application not in APPLICATIONS:
            self._say(SWITCH, NOK_INSPECTION if self._coded else 1, self._active)
            return
        if self._coded:
            self._void()
            self._running = False
        self._set(BUSY, True)
        self._later(LOAD_TIME, self._loaded, application, True)

    # ------------------------------------------------------------------ what goes

    def _set(self, condition: int, on: bool) -> None:
        self._conditions = self._conditions | condition if on else self._conditions & ~condition
        self._report()

    def _report(self) -> None:
        """Say the status if it has changed."""
        status = self._conditions
        status |= RUNNING if self._running else 0
        status |= WAITING if self._running and self._waiting else 0
        if self._peer is not None and status != self._reported and not self._coded:
            self._reported = status
            self._say(STATUS, status, *([0] if self._wire.word == "I" else []))

    def _say(self, message_id: int, *words: int) -> None:
        self._out.append((message_id, self._wire.words(*words)))

    def flush(self) -> None:
        """Put on the line what was said until now; what comes then is another thing on it."""
        self._flush()

    def _flush(self) -> None:
        frames, self._out = self._out, []
        if frames and self._peer is not None:
            self.back.put((self._peer, frames))

    def _write(self, item: tuple[Peer, list[Frame]]) -> None:
        peer, frames = item
        if peer.gone or peer.transport.is_closing():
            return
        if self.transport == "tcp":
            data = b"".join(self._wire.frame(*frame) for frame in frames)
            cast("asyncio.WriteTransport", peer.transport).write(data)
            return
        for frame in frames:
            for seconds in self.network(frame[0]):
                if seconds:
                    self._later(seconds, self._send_datagram, peer, frame)
                else:
                    self._send_datagram(peer, frame)

    def _send_datagram(self, peer: Peer, frame: Frame) -> None:
        transport = cast("asyncio.DatagramTransport", peer.transport)
        transport.sendto(self._wire.frame(*frame), peer.address)

    def _later(
        self, seconds: float, action: Callable[..., None], *arguments: Any
    ) -> asyncio.TimerHandle:
        def act() -> None:
            self._timers.discard(timer)
            action(*arguments)
            self._flush()

        timer = asyncio.get_running_loop().call_later(seconds, act)
        self._timers.add(timer)
        return timer

    # ------------------------------------------------------------------ the socket

    def opened(self, peer: Peer) -> None:
        """Note a connection, or the datagram socket."""
        self._connections.add(peer)

    def lost(self, peer: Peer) -> None:
        """Note that one is gone; what it has sent before still comes."""
        self._connections.discard(peer)
        peer.gone = True
        if self._server is None or self._server.is_serving():
            self.towards.put((peer, None))
        self._closed.set()


def _number_in(frames: list[Frame]) -> int | None:
    numbers = [struct.unpack("<I", payload)[0] for one, payload in frames if one == NUMBER]
    return numbers[-1] if numbers else None


def _cancel(timer: asyncio.TimerHandle | None) -> None:
    if timer is not None:
        timer.cancel()


class _Stream(asyncio.Protocol):
    def __init__(self, camera: LineCamera) -> None:
        self._camera = camera

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._peer = Peer(transport)
        self._camera.opened(self._peer)

    def data_received(self, data: bytes) -> None:
        self._camera.arrive(self._peer, data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._camera.lost(self._peer)


class _Datagrams(asyncio.DatagramProtocol):
    def __init__(self, camera: LineCamera) -> None:
        self._camera = camera

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._peer = Peer(transport)
        self._camera.opened(self._peer)

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        self._peer.address = addr
        self._camera.arrive(self._peer, data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._camera.lost(self._peer)
