"""What a cell of the fault matrix happens in: a camera that keeps books, a link, and a client.

A container tells which run made it, and the camera knows when each run began. So a result belongs
to its own trigger if its run began after ``trigger()`` was called and, where the layout has a
number, carries the number that the client sent with that trigger.
"""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import itertools
import sys
import weakref
from collections import Counter
from datetime import timedelta
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import smartcam
from smartcam.backoff import Backoff
from smartcam.emulator import Application, EmulatedCamera
from smartcam.models import Connected, Disconnected, Reconnected
from smartcam.observers import Observer
from smartcam.protocols import messages as m
from smartcam.protocols.bvs import BVS, ResultCode
from smartcam.testing import LinkProxy

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
    from datetime import datetime

    from smartcam._client.link import TraceEntry
    from smartcam.client import SmartCamera
    from smartcam.emulator import LogEntry, Run
    from smartcam.models import CameraEvent, Result
    from smartcam.protocols.framed.dialect import FramedDialect

__all__ = [
    "AWAY",
    "HOME",
    "PATIENT",
    "READING",
    "SHORT",
    "STRAY",
    "Bench",
    "BenchBase",
    "BookKeeper",
    "Bounds",
    "Ear",
    "Heard",
    "Probe",
    "World",
    "bench",
    "caring_for_tasks",
    "come_true",
    "own_host",
    "tracked_tasks",
]

HOME, AWAY, READING = 1, 2, 3
"""Applications: the usual one, another one, and one that reads input data."""

STRAY = -7
"""Serial of a container that no run has made."""

LAYOUT = "number: int32{mark}, serial: int32, token: int32, application: int32"

SETTLING = 1.5
"""Seconds until nothing is left of a closed client; a proxy's cut connection lingers for 1 s."""


class World(NamedTuple):
    """What is spoken, over what, and whether containers have a number."""

    dialect: str
    transport: Literal["tcp", "udp"]
    numbered: bool

    def __str__(self) -> str:
        return f"{self.transport}-{self.dialect}-{'number' if self.numbered else 'plain'}"

    @property
    def spoken(self) -> FramedDialect:
        """The dialect."""
        return BVS.dialects[self.dialect]

    @property
    def header(self) -> int:
        """Bytes of a frame's header."""
        return self.spoken.header.size

    @property
    def word(self) -> int:
        """Bytes of a message's ordinary integers."""
        return {"I": 4, "H": 2}[self.spoken.word]

    @property
    def has_magic(self) -> bool:
        """Whether a frame shows where it begins."""
        return bool(self.spoken.header.magic)

    @property
    def is_asked(self) -> bool:
        """Whether the status comes when it is asked for, and not by itself."""
        return not self.spoken.status_by_itself

    @property
    def layout(self) -> str:
        """How containers are read."""
        return LAYOUT.format(mark=" @sequence" if self.numbered else "")


class Bounds(NamedTuple):
    """A client's timeouts, seconds.

    Attributes:
        connect: three attempts share it.
    """

    request: float
    switch: float
    connect: float
    close: float
    liveness: float
    trigger: float


PATIENT = Bounds(request=3, switch=4, connect=6, close=0.5, liveness=6, trigger=4)
"""Where no timeout is meant to fire."""

SHORT = Bounds(request=0.15, switch=0.4, connect=1.0, close=0.1, liveness=0.3, trigger=0.4)
"""Where timeouts are meant to fire."""


# ---------------------------------------------------------------------- time and tasks


class Probe:
    """Measures how late the loop is."""

    STEP = 0.005

    def __init__(self) -> None:
        self.worst = 0.0
        self._lags: list[tuple[float, float]] = []
        self._loop = asyncio.get_running_loop()
        self._due = self._loop.time() + self.STEP
        self._timer = self._loop.call_at(self._due, self._tick)

    def lag_since(self, begun: float) -> float:
        """Return the longest time since then that the loop was late, or is now, seconds."""
        longest = max(0.0, self._loop.time() - self._due)
        for at, lag in reversed(self._lags):
            if at < begun:
                break
            longest = max(longest, lag)
        return longest

    def stop(self) -> None:
        """Measure no more."""
        self._timer.cancel()

    def _tick(self) -> None:
        now = self._loop.time()
        lag = now - self._due
        self.worst = max(self.worst, lag)
        self._lags.append((now, lag))
        if len(self._lags) > 20_000:
            del self._lags[:10_000]
        self._due = now + self.STEP
        self._timer = self._loop.call_at(self._due, self._tick)


_TASKS: contextvars.ContextVar[weakref.WeakSet[asyncio.Task[Any]] | None] = contextvars.ContextVar(
    "tasks of this cell", default=None
)


@contextlib.contextmanager
def caring_for_tasks() -> Iterator[list[str]]:
    """Have the loop note whose each task is; gives what the loop itself had to report."""
    loop = asyncio.get_running_loop()
    reports: list[str] = []

    def make(
        loop: asyncio.AbstractEventLoop, coro: Coroutine[Any, Any, Any], **options: Any
    ) -> asyncio.Task[Any]:
        task = asyncio.Task(coro, loop=loop, **options)
        mine = _TASKS.get()
        if mine is not None:
            mine.add(task)
        return task

    handler, factory = loop.get_exception_handler(), loop.get_task_factory()
    loop.set_exception_handler(lambda _, context: reports.append(str(context)))
    loop.set_task_factory(make)  # type: ignore[arg-type] # a protocol nobody can name
    try:
        yield reports
    finally:
        loop.set_exception_handler(handler)
        loop.set_task_factory(factory)


# ---------------------------------------------------------------------- who knows the truth


class BookKeeper(EmulatedCamera):
    """An emulated camera that knows when each of its runs began.

    Attributes:
        began: by the run's serial, seconds of the device's time.
    """

    def __init__(self, world: World, **options: Any) -> None:
        self.began: dict[int, float] = {}
        super().__init__(
            [self._application(number, world) for number in (HOME, AWAY, READING)],
            builtins=False,
            running=True,
            dialect=world.dialect,
            transport=world.transport,
            quirks={
                "reboot_time": 0.05,
                "overtriggered_time": 0.02,
                # the order is not known, so each dialect has one of the two
                "waiting_before_result": world.dialect == "thesis",
            },
            **options,
        )

    def _application(self, number: int, world: World) -> Application:
        return Application(
            id=number,
            layout=world.layout,
            generator=self._values,
            parameters={"application": number},
            processing_time=0.01,
            load_time=0.01,
            input="token: int32" if number == READING else None,
        )

    def _values(self, run: Run) -> dict[str, int]:
        serial = len(self.began) + 1
        self.began[serial] = run.time
        return {
            "number": run.number & 0x7FFFFFFF,
            "serial": serial,
            "token": 0 if run.input is None else run.input["token"],
            "application": run.parameters["application"],
        }

    @property
    def time(self) -> float:
        """The device's time now, seconds."""
        with self.step():
            pass
        return self.device.time

    def has_sent(self, data: bytes) -> bool:
        """Whether a container had exactly these bytes."""
        return any(data == sent for _, sent in self._containers())

    def sent(self) -> Counter[int]:
        """Return how often each container was said to a client, by serial."""
        return Counter(serial_of(data) for _, data in self._containers())

    def sent_whole(self, peers: list[str]) -> Counter[int]:
        """Return how often each container went out over some links as it is, by serial."""
        return Counter(
            serial_of(data)
            for entry, data in self._containers()
            if entry.peer in peers and entry.wire is None
        )

    def _containers(self) -> Iterator[tuple[LogEntry, bytes]]:
        for entry in self.log:
            if isinstance(entry.message, m.ResultContainer) and entry.direction == "out":
                yield entry, entry.message.data


def serial_of(data: bytes) -> int:
    """Return the serial that a container tells."""
    return int.from_bytes(data[4:8], "little", signed=True)


class Heard(NamedTuple):
    """A frame as the client saw it: ``>`` out, ``<`` in."""

    direction: str
    message: str
    wire: bytes


class Ear(Observer):
    """Hears what one client says and what it is told.

    Args:
        world: what is spoken.

    Attributes:
        frames: every whole frame.
        number: the sequence number that was set last.
        got: containers of sessions, by serial; of the session that is open, ``now``.
        hook: called with each frame.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self.frames: list[Heard] = []
        self.number: int | None = None
        self.got: Counter[int] = Counter()
        self.now: Counter[int] = Counter()
        self.closing = False
        self.hook: Callable[[Heard], None] | None = None
        self._adopted = False

    @property
    def received(self) -> int:
        """Containers that came over links with a session."""
        return self.got.total() + (self.now.total() if self._adopted else 0)

    def on_frame(self, entry: TraceEntry) -> None:
        if entry.direction == "!":
            self._take_back(entry.hex)
            return
        heard = Heard(entry.direction, entry.message, bytes.fromhex(entry.hex))
        self.frames.append(heard)
        if heard.direction == ">" and heard.message == "Connect" and not self._adopted:
            self.now = Counter()  # an attempt; in a session it asks for the status
        elif heard.message == "SetSequenceNumber":
            self.number = entry.fields["number"]
        elif heard.message == "ResultContainer" and not self.closing and entry.fields is not None:
            self.now[serial_of(bytes.fromhex(entry.fields["data"]))] += 1
        if self.hook is not None:
            self.hook(heard)

    def _take_back(self, payload: str) -> None:
        """A frame was refused: a container where there is no session is none."""
        last = self.frames[-1] if self.frames else None
        container = last is not None and last.message == "ResultContainer"
        header, word = self._world.header, self._world.word
        if last is not None and container and last.wire[header:].hex() == payload:
            self.now[serial_of(last.wire[header + word :])] -= 1

    def on_state(self, event: CameraEvent) -> None:
        if isinstance(event, (Connected, Reconnected)):
            self._adopted = True
        elif isinstance(event, Disconnected):
            self.got += self.now
            self.now, self._adopted = Counter(), False


# ---------------------------------------------------------------------- the bench


class BenchBase:
    """A client of a camera, and what was found to be wrong.

    Attributes:
        wrong: what must not be, in words.
        happened: the fault did, where nothing else tells.
        strays: a container of no run may be taken for a result: nothing tells it from one.
        garbled: frames are broken so that other bytes stand in their bodies, and the protocol has
            no checksum.
        taken_in: how often such a value was told.
    """

    def __init__(self, world: World, bounds: Bounds, url: str, application: int) -> None:
        self.world = world
        self.bounds = bounds
        self.home = application
        self.wrong: list[str] = []
        self.strays = self.garbled = self.happened = False
        self.taken_in = 0
        self._url = url
        self.ear = Ear(world)
        self.camera: SmartCamera = self._connect()

    def _connect(self) -> SmartCamera:
        bounds = self.bounds
        self.ear = Ear(self.world)
        return smartcam.connect(
            self._url,
            observers=[self.ear],
            application=self.home,
            interpret_as=self.world.layout,
            reconnect=Backoff(initial=0.005, maximum=0.05, jitter=0),
            restore=True,
            connect_timeout=bounds.connect,
            request_timeout=bounds.request,
            switch_timeout=bounds.switch,
            close_timeout=bounds.close,
            liveness_timeout=bounds.liveness,
        )

    async def renew(self) -> None:
        """Have a new client instead of one that is over.

        Raises:
            SmartCamError: it cannot be opened.
        """
        await self.close()
        self.camera = self._connect()
        await self.camera.open()

    async def close(self) -> None:
        """Close the client and look at its accounts."""
        self.ear.closing = True
        await self.camera.close()
        self.audit()

    async def mend(self) -> None:
        """Have the camera back, where it was taken away."""

    def stop_camera(self) -> None:
        """Stop the application, as an operator does."""
        raise NotImplementedError

    def audit(self) -> None:
        """Look at the client's accounts."""
        got = self.camera.statistics()
        fates = (got.triggered, got.streamed, got.late, got.wrong_application)
        total = sum(fates) + got.uninterpretable + got.unclaimed
        self.demand(got.received == total, f"the fates do not add up: {got}")
        heard = self.ear.received
        self.demand(got.received == heard, f"{heard} containers heard, {got.received} in account")

    @contextlib.contextmanager
    def _one_trigger(self) -> Iterator[None]:
        """A call sends one trigger at most, and one more for each that the camera refused."""
        ear, before, header = self.ear, len(self.ear.frames), self.world.header
        try:
            yield
        finally:
            frames = ear.frames[before:]
            said = sum(one.message == "Trigger" for one in frames)
            answers = [one.wire[header:] for one in frames if one.message == "TriggerAnswer"]
            refused = answers.count(ResultCode.BUSY.to_bytes(2, "little"))
            text = f"one call sent {said} triggers, {refused} were refused"
            self.demand(said <= 1 + refused, text)

    def demand(self, true: object, text: str) -> None:
        """Note what is wrong unless something is true."""
        if not true:
            self.wrong.append(text)

    def demand_value(self, true: object, text: str) -> None:
        """Note a wrong value, unless bytes of other frames stand in it."""
        if not true and self.garbled:
            self.taken_in += 1
        else:
            self.demand(true, text)

    async def trigger(self, application: int | None = None, **options: Any) -> Result:
        """Trigger; the result must be this trigger's own."""
        raise NotImplementedError

    async def ask_application(self) -> int:
        """Query; the answer must be the camera's."""
        raise NotImplementedError

    async def ask_clock(self) -> None:
        """Ask for the clock; the answer must be the camera's."""
        raise NotImplementedError

    def really_active(self) -> int:
        """Return which application is active, by whoever knows best."""
        raise NotImplementedError


class Bench(BenchBase):
    """A client, a link, and a camera that knows the truth."""

    def __init__(
        self, world: World, bounds: Bounds, box: BookKeeper, proxy: LinkProxy, application: int
    ) -> None:
        self.box = box
        self.proxy = proxy
        super().__init__(world, bounds, proxy.url(box.url), application)

    async def trigger(self, application: int | None = None, **options: Any) -> Result:
        """Trigger; the result must be this trigger's own."""
        begun, active = self.box.time, self.really_active()
        with self._one_trigger():
            result: Result = await self.camera.trigger(
                application, timeout=self.bounds.trigger, **options
            )
        value = result.value
        if self.garbled and not self.box.has_sent(result.raw):
            self.taken_in += 1
            return result
        if value.serial == STRAY and self.strays:
            self.taken_in += 1
            return result
        began = self.box.began.get(value.serial)
        self.demand(began is not None, f"a result of no run: {value}")
        if began is not None:
            late = begun - began
            if late > 0 and self.strays:
                self.taken_in += 1  # its own trigger has got the stray one
                return result
            self.demand(late <= 0, f"a stale result: run {value.serial} began {late:.3f} s before")
        if self.world.numbered:
            ours = self.ear.number
            self.demand(result.sequence == ours, f"number {result.sequence}, {ours} was set")
        wanted = {active, self.really_active()} if application is None else {application}
        told = {value.application, result.application}
        right = len(told) == 1 and told <= wanted
        self.demand(right, f"a result of {told}, application {wanted} was triggered")
        token = int.from_bytes(options.get("input") or bytes(4), "little")
        if "input" in options:
            self.demand_value(value.token == token, f"inspected input {value.token}, not {token}")
        return result

    async def ask_application(self) -> int:
        """Query; the answer must be the camera's."""
        active = self.really_active()
        answer = await self.camera.query_application()
        really = {active, self.really_active()}
        self.demand_value(answer in really, f"application {answer} is told, {really} is active")
        return answer

    async def ask_clock(self) -> None:
        """Ask for the clock; the answer must be the camera's."""
        before, begun = self._clock(), asyncio.get_running_loop().time()
        answer = await self.camera.get_clock()
        now = self._clock()
        took = timedelta(seconds=asyncio.get_running_loop().time() - begun)
        second = timedelta(seconds=1)  # the answer tells whole ones
        # where it is set meanwhile, both times are right
        right = before - second <= answer <= before + took or now - took - second <= answer <= now
        self.demand_value(right, f"clock {answer}, {now} is right")

    def _clock(self) -> datetime:
        with self.box.step():
            return self.box.device.clock_time.replace(tzinfo=None)

    def stop_camera(self) -> None:
        """Stop the application, as an operator does."""
        self.box.device.stop()

    def really_active(self) -> int:
        """Return which application is active."""
        return self.box.device.active_application

    def audit_containers(self, copies: int) -> None:
        """Compare what came with what was sent; the session that is open has lost nothing.

        Args:
            copies: how often each container may come for each time that it was sent.
        """
        sent = self.box.sent()
        for serial, count in (self.ear.got + self.ear.now).items():
            if serial != STRAY and not self.garbled:
                text = f"container {serial} came {count} times, sent {sent[serial]} times"
                self.demand(count <= copies * sent[serial], text)
        if self.world.transport == "tcp":
            sessions = self.box.sessions
            missing = self.box.sent_whole(sessions) - self.ear.now
            self.demand(len(sessions) == 1, f"sessions in the end: {sessions}")
            # behind a broken frame without a magic number whole ones are read as its body
            swallowed = self.garbled and not self.world.has_magic
            text = f"lost without a loss of the link: {missing}"
            self.demand(swallowed or not missing, text)


@contextlib.asynccontextmanager
async def tracked_tasks() -> AsyncIterator[list[str]]:
    """Note the tasks that the body makes; gives the names of those that do not end."""
    tasks: weakref.WeakSet[asyncio.Task[Any]] = weakref.WeakSet()
    token = _TASKS.set(tasks)
    me = asyncio.current_task()
    left: list[str] = []
    try:
        yield left
        await come_true(lambda: all(task is me or task.done() for task in tasks))
        left += [task.get_name() for task in tasks if task is not me and not task.done()]
    finally:
        _TASKS.reset(token)


_NUMBERS = itertools.count(1)


def own_host() -> str:
    """Return a loopback address of its own, where the system has more than one.

    A camera that restarts shuts its port for a moment; on a shared address another cell's camera
    might get it.
    """
    number = next(_NUMBERS)
    own = f"127.{1 + number // 62_500 % 250}.{number // 250 % 250}.{1 + number % 250}"
    return own if sys.platform == "linux" else "127.0.0.1"


@contextlib.asynccontextmanager
async def bench(world: World, bounds: Bounds, application: int) -> AsyncIterator[Bench]:
    """Have a bench; what its client leaves behind is found to be wrong."""
    async with tracked_tasks() as left:
        box = BookKeeper(world, active=application, host=own_host())
        async with box, LinkProxy(box.host, box.port, transport=world.transport) as proxy:
            made = Bench(world, bounds, box, proxy, application)
            try:
                yield made
            finally:
                await made.close()
            if world.transport == "tcp":
                proxy.resume()
                await come_true(lambda: not proxy.open_connections)
                made.demand(not proxy.open_connections, "a socket was left open")
    made.demand(not left, f"tasks were left: {left}")


async def come_true(condition: Callable[[], bool]) -> None:
    """Let the loop run until something is true, :data:`SETTLING` at most."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(SETTLING):
            for _ in range(20):
                if condition():
                    return
                await asyncio.sleep(0)
            while not condition():  # noqa: ASYNC110 - whatever the condition is
                await asyncio.sleep(0.005)
