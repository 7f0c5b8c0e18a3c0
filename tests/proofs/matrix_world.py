"""The world of a cell of the fault matrix: a camera that keeps books, a link, and a client.

The camera knows when each of its runs began. So a result belongs to its own trigger if its run
began after ``trigger()`` was called and, where the layout has a number, carries the number that the
client sent with that trigger.
"""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import itertools
import sys
import weakref
from collections import Counter
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from datetime import datetime, timedelta
from typing import Any, Literal, NamedTuple

import smartcam
from smartcam.backoff import Backoff
from smartcam.camera import Camera
from smartcam.models import Result
from smartcam.protocols import BVS, FramedDialect
from smartcam.protocols._inside import ResultCode
from smartcam.testing.proxy import LinkProxy
from tests.client.clientkit import imbalances, loop_reports
from tests.proofs.books import BookKeeper, ClientEar, layout_of

HOME, AWAY, READING = 1, 2, 3
"""Applications: the usual one, another one, and one that reads input data."""

STRAY = -7
"""In place of a run: of a container that none has made."""

SETTLING = 1.5
"""Seconds until nothing is left of a closed client; a proxy's cut connection lingers for 1 s."""


class World(NamedTuple):
    """The dialect, the transport, and whether containers have a number."""

    dialect: str
    transport: Literal["tcp", "udp"]
    numbered: bool

    def __str__(self) -> str:
        return f"{self.transport}-{self.dialect}-{'number' if self.numbered else 'plain'}"

    @property
    def spoken(self) -> FramedDialect:
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
        """True if a frame shows where it begins."""
        return bool(self.spoken.header.magic)

    @property
    def is_asked(self) -> bool:
        """True if the status comes when it is asked for, and not by itself."""
        return not self.spoken.unasked_status

    @property
    def layout(self) -> str:
        """The layout with which containers are read."""
        return layout_of(self.numbered)


class Bounds(NamedTuple):
    """A client's timeouts, seconds."""

    request: float
    switch: float
    connect: float  # three attempts share it
    close: float
    liveness: float
    trigger: float


PATIENT = Bounds(request=3, switch=4, connect=6, close=0.5, liveness=6, trigger=4)
"""Bounds where no timeout is meant to fire."""

SHORT = Bounds(request=0.15, switch=0.4, connect=1.0, close=0.1, liveness=0.3, trigger=0.4)
"""Bounds where timeouts are meant to fire."""


# ---------------------------------------------------------------------- tasks


_TASKS: contextvars.ContextVar[weakref.WeakSet[asyncio.Task[Any]] | None] = contextvars.ContextVar(
    "tasks of this cell", default=None
)


@contextlib.contextmanager
def caring_for_tasks() -> Iterator[list[str]]:
    """Have the loop note whose each task is; gives what the loop itself had to report."""
    loop = asyncio.get_running_loop()

    def make(
        loop: asyncio.AbstractEventLoop, coro: Coroutine[Any, Any, Any], **options: Any
    ) -> asyncio.Task[Any]:
        task = asyncio.Task(coro, loop=loop, **options)
        mine = _TASKS.get()
        if mine is not None:
            mine.add(task)
        return task

    factory = loop.get_task_factory()
    loop.set_task_factory(make)  # type: ignore[arg-type] # a protocol nobody can name
    try:
        with loop_reports() as reports:
            yield reports
    finally:
        loop.set_task_factory(factory)


# ---------------------------------------------------------------------- the bench


class BenchBase:
    """A client of a camera, and what was found to be wrong."""

    def __init__(self, world: World, bounds: Bounds, url: str, application: int) -> None:
        self.world = world
        self.bounds = bounds
        self.home = application
        self.wrong: list[str] = []  # what must not be, in words
        # garbled: frames are broken so that other bytes stand in their bodies, and the protocol has
        # no checksum
        # strays: a container of no run may be taken for a result: nothing tells it from one
        # happened: the fault did, where nothing else tells
        self.strays = self.garbled = self.happened = False
        self.taken_in = 0  # how often such a value was told
        self._url = url
        self.ear = ClientEar()
        self.camera: Camera = self._connect()

    def _connect(self) -> Camera:
        bounds = self.bounds
        self.ear = ClientEar()
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
        """Have a new client instead of one that is over."""
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
        self.wrong += imbalances(got)
        heard = self.ear.received
        self.demand(got.received == heard, f"{heard} containers heard, {got.received} in account")

    @contextlib.contextmanager
    def _one_trigger(self) -> Iterator[None]:
        """A call sends one trigger at most, and one more for each that the camera refused."""
        ear, before, header = self.ear, len(self.ear.frames), self.world.header
        try:
            yield
        finally:
            frames = [*ear.frames][before:]
            said = sum(one.message == "Trigger" for one in frames)
            answers = [one.hex[2 * header :] for one in frames if one.message == "TriggerAnswer"]
            refused = answers.count(ResultCode.BUSY.to_bytes(2, "little").hex())
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
        if self.garbled and all(result.raw != one.data for one in self.box.sent):
            self.taken_in += 1
            return result
        if value.run == STRAY and self.strays:
            self.taken_in += 1
            return result
        run = self.box.runs.get(value.run)
        self.demand(run is not None, f"a result of no run: {value}")
        if run is not None:
            late = begun - run.began
            if late > 0 and self.strays:
                self.taken_in += 1  # its own trigger has got the stray one
                return result
            self.demand(late <= 0, f"a stale result: run {value.run} began {late:.3f} s before")
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
        """Compare what came with what was sent, where each container may come ``copies`` times.

        The session that is open has lost nothing.
        """
        sent = Counter(one.run.index for one in self.box.sent)
        for run, count in (self.ear.got + self.ear.now).items():
            if run != STRAY and not self.garbled:
                text = f"container {run} came {count} times, sent {sent[run]} times"
                self.demand(count <= copies * sent[run], text)
        if self.world.transport == "tcp":
            sessions = self.box.sessions
            whole = [one for one in self.box.sent if one.whole and one.peer in sessions]
            missing = Counter(one.run.index for one in whole) - self.ear.now
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


def _program(number: int) -> dict[str, Any]:
    reads = "token: int32" if number == READING else None
    return {"processing_time": 0.01, "load_time": 0.01, "input": reads}


@contextlib.asynccontextmanager
async def bench(world: World, bounds: Bounds, application: int) -> AsyncIterator[Bench]:
    """Have a bench; what its client leaves behind is found to be wrong."""
    async with tracked_tasks() as left:
        box = BookKeeper(
            {number: _program(number) for number in (HOME, AWAY, READING)},
            marked=world.numbered,
            dialect=world.dialect,
            transport=world.transport,
            quirks={
                "reboot_time": 0.05,
                "overtriggered_time": 0.02,
                # the order is not known, so each dialect has one of the two
                "waiting_before_result": world.dialect == "thesis",
            },
            active=application,
            host=own_host(),
        )
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
