"""A camera at the end of a line, written by hand: it does what the promises assume, to the letter.

What ``docs/promises.md`` assumes of a camera (A to J) it does, and it uses every freedom that these
leave: results and Waiting for Trigger in any order and apart, as long as all that a run has to say
is said before the next one shows; runs that a sensor began; results and statuses that are on the
line while a trigger comes the other way. It shares nothing with the library.

It knows the truth. Each run remembers which Trigger message began it, counted from 1 in each
session, or that a sensor did, and when; each container says which run it is of.

A script drives it by steps (``line.hold()``, ``let_out()``, ``sensor()``), chance by pauses and
delays: the camera is the same.
"""

from __future__ import annotations

import asyncio
import struct
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, NamedTuple, TypeVar

from tests.client.camera_by_hand import (
    BID_READY,
    BID_TRIGGER_ERROR,
    BID_WAITING,
    BUSY,
    CONNECT,
    DISCONNECT,
    INPUT,
    INPUT_CONTAINER,
    INSPECTION_ERROR,
    NOT_READY,
    NUMBER,
    OK,
    OK_ID,
    OVERTRIGGERED,
    QUERY,
    RESET,
    RESULT,
    RUNNING,
    STATUS,
    SWITCH,
    TRIGGER,
    WAITING,
    Frame,
    Peer,
    PortByHand,
)

CONTAINER = struct.Struct("<I5i")
REST = "session: int32, trigger: int32, run: int32, part: int32, token: int32"
LAYOUTS = {
    "": f"number: uint32, {REST}",
    "int32": f"number: int32 @sequence, {REST}",
    "int16": f"number: int16 @sequence, above: uint16, {REST}",
    "int8": f"number: int8 @sequence, above: uint8, more: uint16, {REST}",
    "uint8": f"number: uint8 @sequence, above: uint8, more: uint16, {REST}",
}
"""Layouts of the container by the type of the number that the client is to look at."""

SENSOR = 0
"""In place of a trigger's count: a run that a sensor began."""

AGAIN = -1
"""In place of a result's part: the run says that the camera waits for a trigger again."""

APPLICATIONS = (1, 2)
OVERTRIGGERED_TIME = 0.002
LOAD_TIME = 0.001
QUEUE_DEPTH = 8
"""Of the input data that waits for an inspection."""

Step = tuple[float | None, int]
"""A pause in seconds (None: until it is told to go on), and the word of a run behind it."""

ItemT = TypeVar("ItemT")


class Line(Generic[ItemT]):
    """One direction of the link: brings what is put in, in order, after its delay."""

    def __init__(self, deliver: Callable[[ItemT], None], delay: Callable[[], float]) -> None:
        self._deliver = deliver  # takes what has come
        self._delay = delay  # seconds that the next one takes
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
        """True if nothing is on its way."""
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
    """One inspection."""

    index: int  # which, from 1
    session: int  # in which it was triggered, counted from 1 by the Connects that came
    trigger: int  # which Trigger message of that session began it, :data:`SENSOR` for none
    application: int  # that made it
    number: int  # its sequence number
    began: float  # when, as the loop says
    token: int = 0  # the input data that it has read, 0 for none
    steps: deque[Step] = field(default_factory=deque)  # what it has still to say
    timer: asyncio.TimerHandle | None = None


class Sent(NamedTuple):
    """A container that was sent: in which session, of which run, and which of the run's, from 0."""

    session: int
    run: Run
    part: int


def at_once(_: Run) -> Sequence[Step]:
    """Return the steps of a run that sends one result and takes no time."""
    return ((0.0, 0), (0.0, AGAIN))


def _no_delay() -> float:
    return 0.0


def _nothing_more(_: int, __: int | None) -> None:
    """Do nothing more around a trigger; the default."""


def _never() -> bool:
    return False


def _always_once(_: int) -> Sequence[float]:
    return (0.0,)


class LineCamera(PortByHand):
    """One camera on a free port of the loopback; an asynchronous context manager."""

    def __init__(
        self,
        *,
        dialect: str = "handbook",  # ``handbook``, ``thesis``, ``b16`` or ``bid``
        transport: str = "tcp",  # ``tcp`` or ``udp``
        # seconds that what is put on the line takes, each time anew
        delay: Callable[[], float] = _no_delay,
        # a run says all that it has to say before the next one shows, as D assumes
        in_order: bool = True,
        reads_input: bool = False,  # the application has a "receive data" tool
    ) -> None:
        super().__init__(dialect, transport)
        self.plan: Callable[[Run], Sequence[Step]] = at_once  # says what a run's steps are
        # called with a Trigger's count and the number that came with it, before anything of the
        # write that brings it is taken: what the camera says here is on the line already when the
        # trigger goes out
        self.before: Callable[[int, int | None], None] = _nothing_more
        # likewise, behind what came in front of number, input and Trigger in that write: the camera
        # takes one message after the other, and a sensor may come between
        self.between: Callable[[int, int | None], None] = _nothing_more
        # likewise, with a Trigger's count and which message of that write is taken next, from 0
        self.at_word: Callable[[int, int], None] = _nothing_more
        # whether the messages of a write come one by one, each with a delay of its own
        self.splits: Callable[[], bool] = _never
        self.says_singly = False  # each message that it says is put on the line alone
        # of a datagram, by message id: after how many seconds each copy of it arrives; empty, it is
        # lost. What comes is asked as the negative id, and is lost or not.
        self.network: Callable[[int], Sequence[float]] = _always_once
        # the line to the camera, of the frames of one write each
        self.towards: Line[tuple[Peer, list[Frame] | None]] = Line(self._take, delay)
        # the line from it, of what it says at one moment
        self.back: Line[tuple[Peer, list[Frame]]] = Line(self._write, delay)
        # sessions: Connects that it took
        # triggers: those that it took, of all sessions
        # writes, arrived: writes, and Trigger messages, that came to the camera's socket
        self.writes = self.arrived = self.triggers = self.sessions = 0
        self.runs: dict[int, Run] = {}  # all inspections, by index
        self.sent: list[Sent] = []  # containers that were sent, in order
        self.overtriggers = 0  # times Overtriggered rose
        self._in_order = in_order
        self._reads_input = reads_input
        self._inputs: deque[int] = deque()
        self._last_input = 0
        self._held = 0  # datagrams
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
        self._timers: set[asyncio.TimerHandle] = set()
        self._overtriggered_until: asyncio.TimerHandle | None = None

    # ------------------------------------------------------------------ life

    async def __aexit__(self, *_: object) -> None:
        self.towards.close()
        self.back.close()
        for run in self._under_way:
            _cancel(run.timer)
        for timer in self._timers:
            timer.cancel()
        await super().__aexit__()

    @property
    def idle(self) -> bool:
        """True if no run is under way and nothing is on the line, or held back by the network."""
        still = self.towards.empty and self.back.empty and not self._held
        return still and not self._under_way

    @property
    def takes_trigger(self) -> bool:
        """True if a trigger would begin a run."""
        return self._running and self._waiting and not self._conditions & BUSY

    @property
    def is_running(self) -> bool:
        """True if an application is in run mode."""
        return self._running

    @property
    def next_number(self) -> int:
        """The number of the next run."""
        return self._number

    def sent_since(self, session: int) -> int:
        """Return how many containers were sent in a session and those behind it."""
        return sum(one.session >= session for one in self.sent)

    def drop_link(self) -> None:
        """Reset the connection of the session; what is on the line is lost."""
        if self._peer is not None and self.transport == "tcp":
            peer, self._peer = self._peer, None
            peer.gone = True
            peer.abort()

    # ------------------------------------------------------------------ what others do to it

    def sensor(self) -> None:
        """A sensor triggers."""
        self._trigger(SENSOR, self.plan)
        self._flush()

    def sensor_runs(self, count: int, *, shown: int = 1_200) -> None:
        """A sensor triggers ``count`` times, each time when the last run is over.

        The last ``shown`` of these are said; the others are counted on only.
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
        for earlier in (
            tuple(self._under_way) if self._in_order else ()
        ):  # D: it has said everything before this one shows
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
            self._take_input(),
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
        self.sent.append(Sent(self.sessions, run, part))
        data = CONTAINER.pack(run.number, run.session, run.trigger, run.index, part, run.token)
        self._put(RESULT, self.wire.words(run.application) + data)

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
        self._inputs.clear()
        if self._coded:
            self._running = self._waiting = True
        self._set(BUSY | INPUT_CONTAINER, False)
        if answer:
            self._say(SWITCH, 0, application)

    # ------------------------------------------------------------------ what comes

    def arrive(self, peer: Peer, data: bytes) -> None:
        """Take bytes of a stream, or a datagram, as they come to the socket."""
        frames = peer.take(self.wire, data)
        if frames:
            self.writes += 1
            self.arrived += sum(message_id == TRIGGER for message_id, _ in frames)
            parts = [[frame] for frame in frames] if self.splits() else [frames]
            for part in parts:
                self.towards.put((peer, part))

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
        in_front = triggers
        for word, (message_id, payload) in enumerate(frames):
            if triggers:
                self.at_word(around[0], word)
            if in_front and message_id in {NUMBER, INPUT, TRIGGER}:
                in_front = False
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
                self._say(QUERY, *((NOT_READY, 0) if busy else (OK_ID, self._active)))
            case 0x30:
                self._say(QUERY, self._active)
            case 0x31:
                self._switch(int.from_bytes(payload, "little"))
            case 0x34:
                self._give_input(payload)
            case 0x35 if not self._coded:
                (self._number,) = struct.unpack("<I", payload)
            case 0x40:
                self._count_trigger()
                if self._coded:
                    self._say(TRIGGER, NOT_READY if self._conditions & BUSY else OK)
                self._trigger(self._in_session, self.plan)
            case 0x41 if not self._coded:
                self._run(True)
            case 0x42 if not self._coded:
                self._run(False)
            case _:
                raise AssertionError(f"message {message_id:#04x} was not expected")

    def _give_input(self, payload: bytes) -> None:
        if self._coded:
            self._say(INPUT, OK)
        if not self._reads_input:
            return
        self._inputs.append(int.from_bytes(payload, "little"))
        if len(self._inputs) > (1 if self._coded else QUEUE_DEPTH):
            self._inputs.popleft()
            self._set(INPUT_CONTAINER, not self._coded)

    def _take_input(self) -> int:
        if not self._reads_input:
            return 0
        self._set(INPUT_CONTAINER, not self._inputs and not self._coded)
        if self._inputs:
            self._last_input = self._inputs.popleft()
        return self._last_input

    def _tell_status(self) -> None:
        word = BID_READY if not self._conditions & BUSY else 0
        word |= BID_WAITING if self._running and self._waiting else 0
        word |= BID_TRIGGER_ERROR if self._conditions & OVERTRIGGERED else 0
        self._say(STATUS, word)

    def _switch(self, application: int) -> None:
        if self._coded and self._conditions & BUSY:
            self._say(SWITCH, NOT_READY, self._active)
            return
        if (self._running and not self._coded) or application not in APPLICATIONS:
            self._say(SWITCH, INSPECTION_ERROR if self._coded else 1, self._active)
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
            self._say(STATUS, status, *([0] if self.wire.word == "I" else []))

    def _say(self, message_id: int, *words: int) -> None:
        self._put(message_id, self.wire.words(*words))

    def _put(self, message_id: int, payload: bytes) -> None:
        self._out.append((message_id, payload))
        if self.says_singly:
            self._flush()

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
            peer.write(b"".join(self.wire.frame(*frame) for frame in frames))
            return
        for frame in frames:
            for seconds in self.network(frame[0]):
                if seconds:
                    self._held += 1
                    self._later(seconds, self._release, peer, frame)
                else:
                    peer.send_datagram(self.wire.frame(*frame))

    def _release(self, peer: Peer, frame: Frame) -> None:
        self._held -= 1
        peer.send_datagram(self.wire.frame(*frame))

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

    def lost(self, peer: Peer) -> None:
        """Note that a connection is gone; what it has sent before still comes."""
        super().lost(peer)
        if self._server is None or self._server.is_serving():
            self.towards.put((peer, None))


def _number_in(frames: list[Frame]) -> int | None:
    numbers = [struct.unpack("<I", payload)[0] for one, payload in frames if one == NUMBER]
    return numbers[-1] if numbers else None


def _cancel(timer: asyncio.TimerHandle | None) -> None:
    if timer is not None:
        timer.cancel()
