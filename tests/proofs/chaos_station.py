"""One camera of the soak: the emulator that tells the truth, its link, and the client at work."""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
from collections import Counter
from collections.abc import Awaitable, Callable, Coroutine
from datetime import datetime
from random import Random
from typing import Any, Literal, TypeVar

import smartcam
from smartcam import exceptions
from smartcam.backoff import Backoff
from smartcam.camera import Camera
from smartcam.models import Result, Statistics
from smartcam.streams import Subscription
from smartcam.testing.proxy import LinkProxy
from tests.client.clientkit import imbalances
from tests.proofs.books import (
    LINK_LOST,
    NOBODY,
    RECORD,
    TRIGGER_OUTCOMES,
    BookKeeper,
    ClientEar,
    LagProbe,
    Ledger,
)
from tests.proofs.chaos_faults import heal

T = TypeVar("T")

TRIGGERED, OTHER, READING, FREE = 1, 2, 3, 4
"""Applications: two that are triggered, one that reads input data too, one that runs free."""

PORTS = (20_000, 30_000)

TIMES = {"connect": 3.0, "switch": 1.5, "request": 0.5, "close": 0.3, "liveness": 1.0}
"""The client's timeouts, seconds."""

ALLOWANCE = 0.1
"""Seconds that a wait may take longer than its timeout beside the loop's own lag."""

KEPT_RUNS = 512
"""Runs that a camera's books keep: few, so that the books are full before memory is judged."""

RECENT, RECENT_WIDTH = 40, 120
"""Frames that are shown beside a violation, and characters of each."""

LINKS = (*LINK_LOST, exceptions.ConnectFailedError)
EXPECTED = (*TRIGGER_OUTCOMES, *LINKS, exceptions.ResponseTimeoutError)
"""Errors that any call may end with here."""


class Watch:
    """The watch to which all stations report."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()  # how often things happened
        self.violations: list[str] = []  # what must not be, in words; the first hundred
        self.worst = 0.0  # the longest that a wait took beyond its timeout and the lag, seconds
        self.lag = LagProbe()  # says how late the loop is

    def complain(self, text: str) -> None:
        """Note a violation."""
        self.counts["violations"] += 1
        if len(self.violations) < 100:
            self.violations.append(text)


class Station:
    """One camera, its link and its client, at work until told to stop."""

    def __init__(self, number: int, watch: Watch, chance: Random) -> None:
        self.transport: Literal["tcp", "udp"] = "udp" if number % 4 == 3 else "tcp"
        self.numbered = number % 4 != 1
        self.name = f"camera {number}"
        # who sets a run's number himself must be the only one that triggers
        self.sets_number = number % 4 in {1, 2}
        self.watch = watch
        times = {TRIGGERED: 0.02, OTHER: 0.01, READING: 0.015, FREE: 0.002}
        self._emulator = BookKeeper(
            {
                number: {
                    "processing_time": seconds,
                    "load_time": 0.03,
                    "rate": 30 if number == FREE else None,
                    "input": "token: int32" if number == READING else None,
                }
                for number, seconds in times.items()
            },
            marked=self.numbered,
            kept_runs=KEPT_RUNS,
            port=free_port(self.transport),
            transport=self.transport,
            dialect="thesis" if number % 4 == 1 else "handbook",
            quirks={
                "waiting_before_result": number % 3 == 0,
                "busy_while_processing": number % 5 == 0,
                "overtriggered_time": 0.01,
                "switch_answer": "before_status" if number % 2 else "after_status",
            },
        )
        self.proxy = LinkProxy("127.0.0.1", 0)
        self.ledger = Ledger(
            self.name, self.emulator, watch.complain, ordered=self.transport == "tcp"
        )
        self._chance = chance
        self._tag = 0
        self._timers: set[asyncio.TimerHandle] = set()
        self._beside: set[asyncio.Task[Any]] = set()
        self._stopping = False
        self._starved = 0
        self._heard = False
        self._named = number % 3 == 1
        self._group = contextlib.AsyncExitStack()
        self._ear = ClientEar()

    @property
    def emulator(self) -> BookKeeper:
        """The camera."""
        return self._emulator

    # ------------------------------------------------------------------ life

    async def open(self) -> None:
        """Open the camera's port and the link's."""
        await self._group.enter_async_context(self.emulator)
        self.proxy = LinkProxy("127.0.0.1", self.emulator.port, transport=self.transport)
        await self._group.enter_async_context(self.proxy)

    def forget(self) -> None:
        """Empty the logs that only grow up to their bounds."""
        self.proxy.log.clear()
        self.emulator.fired.clear()
        self.ledger.read_log()

    async def close(self) -> None:
        """Close both, and end what goes on beside."""
        for timer in self._timers:
            timer.cancel()
        for task in self._beside:
            task.cancel()
        if self._beside:
            await asyncio.wait(self._beside)
        await self._group.aclose()

    def stop(self) -> None:
        """Have the client stop its work after what it does now."""
        self._stopping = True

    def later(self, seconds: float, action: Callable[[], None]) -> None:
        """Do something then, unless the soak is over."""

        def act() -> None:
            self._timers.discard(timer)
            action()

        timer = asyncio.get_running_loop().call_later(seconds, act)
        self._timers.add(timer)

    def spawn(self, what: str, job: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Run a coroutine function beside."""
        task = asyncio.create_task(job(), name=f"{self.name} {what}")
        self._beside.add(task)
        task.add_done_callback(self._beside.discard)

    def external_trigger(self) -> None:
        """Trigger by the digital input, where the client's numbers tell whose a run is."""
        if not self.sets_number and not self._stopping:
            self.emulator.trigger()

    # ------------------------------------------------------------------ the client

    async def work(self) -> None:
        """Have one client after the other, until told to stop; then hear what there is to hear."""
        while not self._stopping:
            await self._one_client()
        for _ in range(5):
            if not self._heard:
                heal(self)  # a port that is shut would use up every client in a millisecond
                await self._up()
                await self._one_client()
        if not self._heard:
            self._complain("not heard to the end")

    async def _up(self) -> None:
        """Wait until the camera is on the network, two seconds at most."""
        for _ in range(200):
            if not self.emulator.device.rebooting:
                return
            await asyncio.sleep(0.01)

    async def _one_client(self) -> None:
        ear = self._ear = ClientEar(keep=RECENT)
        ear.at_container = self.ledger.on_received
        client = smartcam.connect(
            self.proxy.url(self.emulator.url),
            observers=[ear],
            name=self.name,
            application=TRIGGERED if self._named else None,
            interpret_as=self._interpretation(),
            reconnect=Backoff(initial=0.02, maximum=0.2),
            restore=self._named,
            connect_timeout=TIMES["connect"],
            switch_timeout=TIMES["switch"],
            request_timeout=TIMES["request"],
            close_timeout=TIMES["close"],
            liveness_timeout=TIMES["liveness"],
        )
        self.watch.counts["clients"] += 1
        opening = TIMES["connect"] + 2 * TIMES["switch"] + TIMES["close"]
        error = await self._bounded("open", client.open(), opening)
        if error is None:
            until = self._chance.randrange(20, 400)
            async with client.results(max_queue=32) as stream:
                if self._chance.random() < 0.3:
                    stream.close()  # nobody listens
                reader = asyncio.create_task(self._read(stream), name=f"{self.name} reader")
                for _ in range(until):
                    if self._stopping or not await self._act(client):
                        break
                if self._stopping:
                    await self._finish(client)
                ear.closing = True
                closing = 2 * TIMES["switch"] + TIMES["close"]
                await self._bounded("close", client.close(), closing)
                await asyncio.wait({reader}, timeout=5)
                if not reader.done():
                    self.watch.complain(f"{self.name}: a stream did not end")
                    reader.cancel()
        self._audit(client.statistics(), ear)

    def _interpretation(self) -> Any:
        layout = self.emulator.layout
        return dict.fromkeys((TRIGGERED, OTHER, READING, FREE), layout) if self._named else layout

    async def _read(self, stream: Subscription[Result]) -> None:
        """Read along: runs rise, where no datagram can overtake another."""
        last = 0
        with contextlib.suppress(*LINKS):
            while True:
                try:
                    result = await anext(stream)
                except StopAsyncIteration:
                    return
                except exceptions.InterpretationError as error:
                    self._complain(str(error))
                    continue
                run = result.value.run
                self.watch.counts["streamed"] += 1
                if self.transport == "tcp" and run < last:
                    self.watch.complain(f"{self.name}: result {run} came behind {last}")
                last = run

    async def _finish(self, client: Camera) -> None:
        """Have everything mended, and hear all that was sent."""
        heal(self)
        for _ in range(20):
            try:
                await client.wait_connected(TIMES["connect"])
                await client.stop()
                await client.query_application()
            except exceptions.ConnectionTakenError:
                return  # the next one will
            except exceptions.SmartCamError:
                continue
            self._heard = True
            return

    def _audit(self, got: Statistics, ear: ClientEar) -> None:
        self.watch.counts["reconnects"] += got.reconnects
        self._balance(got)
        if not ear.received <= got.received <= ear.received + ear.after:
            heard = f"{ear.received} containers heard (and {ear.after} while closing)"
            self.watch.complain(f"{self.name}: {heard}, {got.received} in the account")

    def _balance(self, got: Statistics) -> None:
        for text in imbalances(got):
            self.watch.complain(f"{self.name}: {text}")
        if got.uninterpretable:
            self.watch.complain(f"{self.name}: {got.uninterpretable} results do not fit")

    # ------------------------------------------------------------------ what it does

    async def _act(self, client: Camera) -> bool:
        """Do one thing by chance; False where the client is of no more use."""
        actions = (self._trigger, self._cancelled, self._elsewhere, self._visit, self._switch)
        others = (self._input, self._clock, self._flow, self._next, self._stop_start, self._ask)
        weights = (16, 3, 1, 1, 1, 3, 2, 1, 1, 0.5, 2)
        action = self._chance.choices((*actions, *others), weights)[0]
        error = await action(client)
        self._balance(client.statistics())
        if error is None:
            return True
        return await self._recover(client, error)

    async def _recover(self, client: Camera, error: BaseException) -> bool:
        match error:
            case exceptions.ConnectionTakenError() | exceptions.ConnectionClosedError():
                self.watch.counts["taken"] += 1
                return False
            case exceptions.ConnectionLostError():
                waited = await self._bounded("wait_connected", client.wait_connected(4), 4)
                return not isinstance(waited, exceptions.ConnectionTakenError)
            case exceptions.NotRunningError():
                await self._bounded("start", client.start(timeout=0.5), 0.5)
            case exceptions.InputContainerError() | exceptions.WrongApplicationError():
                switch = client.switch_application(TRIGGERED, timeout=1.0)
                await self._bounded("switch_application", switch, 1.0)
            case exceptions.TriggerTimeoutError() if "did not wait for a trigger" in str(error):
                # it runs free, or over UDP its last status was lost: only a new one tells
                self._starved += 1
                if self._starved >= 3:
                    self.watch.counts["starved"] += 1
                    self._starved = 0
                    await self._bounded("stop", client.stop(timeout=0.5), 0.5)
                    await self._bounded("start", client.start(timeout=0.5), 0.5)
            case _:
                pass
        return True

    async def _bounded(
        self, what: str, waiting: Awaitable[object], bound: float
    ) -> BaseException | None:
        """Await something; return its error. It must end in time, and by an error of ours."""
        begun = asyncio.get_running_loop().time()
        task = asyncio.ensure_future(waiting)
        await asyncio.wait({task}, timeout=bound + 10)
        over = asyncio.get_running_loop().time() - begun - bound
        if not task.done():
            self._complain(f"{what} hangs: {task}")
            task.cancel()
            await asyncio.wait({task}, timeout=5)
            return exceptions.ConnectionClosedError("hangs")
        if over > 0:
            over -= sum(self.watch.lag.since(begun + bound))
            self.watch.worst = max(self.watch.worst, over)
            if over > ALLOWANCE:
                text = f"{what} took {over:.2f} s beyond {bound:.2f} s and the lag: {task}"
                self._complain(text)
        if task.cancelled():
            self.watch.counts[f"{what}: cancelled"] += 1
            return None
        error = task.exception()
        name = "done" if error is None else type(error).__name__
        self.watch.counts[f"{what}: {name}"] += 1
        if error is not None and not isinstance(error, EXPECTED):
            self._complain(f"{what} ended with {error!r}")
        return error

    def _complain(self, text: str) -> None:
        """Note a violation, with the frames before it."""
        recent = [
            f"{one.at:%S.%f} {one.direction} {one.message} {one.fields}"[:RECENT_WIDTH]
            for one in self._ear.frames
        ]
        self.watch.complain("\n    ".join([f"{self.name}: {text}", *recent]))

    async def _number(self, client: Camera) -> BaseException | None:
        """Set the number of the next run, by which its trigger is known; else the client does."""
        if not self.sets_number:
            return None
        self._tag = (self._tag + 1000) % (1 << 31)
        number = client.set_sequence_number(self._tag)
        return await self._bounded("set_sequence_number", number, TIMES["request"])

    async def _triggered(
        self,
        client: Camera,
        what: str,
        bound: float,
        cancel_after: float | None = None,
        **options: Any,
    ) -> BaseException | None:
        """Trigger; the result must be of this trigger."""
        error = await self._number(client)
        if error is not None:
            return error
        task = asyncio.create_task(client.trigger(**options))
        timer = None
        if cancel_after is not None:
            timer = asyncio.get_running_loop().call_later(cancel_after, task.cancel)
        error = await self._bounded(what, task, bound)
        if timer is not None:
            timer.cancel()
        if isinstance(error, exceptions.ResponseTimeoutError):
            self._complain(f"{what} ended with {error!r}, which is no outcome of a trigger")
        if not task.done() or task.cancelled() or error is not None:
            return error
        self._starved = 0
        self._compare(task.result(), what, options)
        return None

    def _compare(self, result: Result, what: str, options: dict[str, Any]) -> None:
        value, complain = result.value, self._complain
        tag, told = self._ear.triggered_as, self.emulator.runs[value.run].told
        if told == NOBODY and value.number == tag and not self.sets_number:
            # the camera had the number and dropped the trigger, in silence because Overtriggered
            # was set already or the trigger was lost, and then the digital input began the run:
            # nothing on the wire tells
            self.watch.counts["number taken by the digital input"] += 1
        elif told != tag or tag == NOBODY:
            self.watch.counts["wrong"] += 1
            complain(f"{what} {tag} has a result of {told}: {value}")
        said = (value.number, value.run, value.token, value.application)
        if RECORD.unpack(result.raw) != said or value.application != result.application:
            complain(f"{what}: the result is not its bytes: {result}")
        if options.get("application", value.application) != value.application:
            complain(f"{what}: application {value.application}: {options}")
        if "input" in options and value.application == READING:
            token = int.from_bytes(options["input"], "little")
            if value.token != token:
                self.watch.counts["wrong"] += 1
                complain(f"{what}: inspected input {value.token}, not {token}")

    async def _trigger(self, client: Camera) -> BaseException | None:
        timeout = self._chance.choice([0.03, 0.1, 0.3])
        return await self._triggered(client, "trigger", timeout, timeout=timeout)

    async def _cancelled(self, client: Camera) -> BaseException | None:
        when = self._chance.uniform(0, 0.03)
        return await self._triggered(
            client, "trigger to cancel", 0.3, cancel_after=when, timeout=0.3
        )

    async def _elsewhere(self, client: Camera) -> BaseException | None:
        # there, the result, and back, which may have to wait for another one that goes back
        bound = 3 * TIMES["switch"] + 0.3
        return await self._triggered(
            client, "trigger elsewhere", bound, application=OTHER, timeout=0.3
        )

    async def _visit(self, client: Camera) -> BaseException | None:
        async def visit() -> None:
            async with client.application(OTHER):
                error = await self._triggered(client, "trigger there", 0.3, timeout=0.3)
                if error is not None:
                    raise error

        return await self._bounded("application", visit(), 4 * TIMES["switch"])

    async def _switch(self, client: Camera) -> BaseException | None:
        application = self._chance.choice([TRIGGERED, OTHER, READING])
        switch = client.switch_application(application, timeout=1.0)
        return await self._bounded("switch_application", switch, 1.0)

    async def _input(self, client: Camera) -> BaseException | None:
        if client.active_application != READING:
            switch = client.switch_application(READING, timeout=1.0)
            error = await self._bounded("switch_application", switch, 1.0)
            if error is not None:
                return error
        token = self._chance.randrange(1, 1 << 31).to_bytes(4, "little")
        return await self._triggered(client, "trigger input", 0.3, input=token, timeout=0.3)

    async def _clock(self, client: Camera) -> BaseException | None:
        setting = client.set_clock(datetime(2020, 5, 17, 8, 0, 0))  # noqa: DTZ001
        error = await self._bounded("set_clock", setting, TIMES["request"])
        if error is not None:
            return error
        return await self._bounded("get_clock", client.get_clock(), TIMES["request"])

    async def _flow(self, client: Camera) -> BaseException | None:
        """Let the application that runs free run for a moment, then have the usual one."""
        switch = client.switch_application(FREE, timeout=1.0)
        error = await self._bounded("switch_application", switch, 1.0)
        if error is None:
            error = await self._bounded("start", client.start(timeout=0.5), 0.5)
        for _ in range(5):
            if error is None:
                error = await self._bounded("next_result", _next_result(client, 0.2), 0.2)
        back = client.switch_application(TRIGGERED, timeout=1.0)
        return await self._bounded("switch_application", back, 1.0) or error

    async def _next(self, client: Camera) -> BaseException | None:
        """Wait for the result of a run that somebody else triggers."""
        task = asyncio.create_task(_next_result(client, 0.1))
        await asyncio.sleep(0)  # it has subscribed
        self.external_trigger()
        return await self._bounded("next_result", task, 0.1)

    async def _stop_start(self, client: Camera) -> BaseException | None:
        error = await self._bounded("stop", client.stop(timeout=0.5), 0.5)
        return error or await self._bounded("start", client.start(timeout=0.5), 0.5)

    async def _ask(self, client: Camera) -> BaseException | None:
        waiting = client.wait_ready(timeout=0.2)
        error = await self._bounded("wait_ready", waiting, 0.2)
        asking = client.query_application()
        return await self._bounded("query_application", asking, TIMES["request"]) or error


def free_port(transport: str) -> int:
    """Return a port that the system gives to nobody by itself, free at this moment.

    A camera that reboots closes its port; one from the system's own range could be another's then.
    """
    kind = {"tcp": socket.SOCK_STREAM, "udp": socket.SOCK_DGRAM}[transport]
    while True:
        port = random.randrange(*PORTS)  # noqa: S311
        with contextlib.suppress(OSError), socket.socket(socket.AF_INET, kind) as sock:
            sock.bind(("127.0.0.1", port))
            return port


async def _next_result(client: Camera, timeout: float) -> Result:
    """Return the next result; it subscribes at once, which a lost link forbids."""
    return await client.next_result(timeout=timeout)
