"""Every coroutine of a camera, cancelled after 0, 1, 2 ... loop steps: what is left behind?

Long form: ``python -m tests.proofs.cancel_sweep`` (every step of every call, on every wire).

Each cancellation has a camera and a client of its own, over the loopback. Time is the loop's: each
of its steps takes a millisecond, so inspections, loads and graces are steps too and a sweep goes
the same way each time. Afterwards the same client must do all that it could do before.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import inspect
import itertools
import logging
import sys
import time
from collections import Counter
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Literal, NamedTuple

import smartcam
from smartcam import Backoff, Camera, LinkError, ResponseTimeoutError, Status
from smartcam.emulator import EmulatedCamera, Run
from smartcam.protocols import messages as m
from smartcam.streams import Subscription
from tests.client.clientkit import balance
from tests.insides import inside
from tests.timed_loop import TimedLoop

STEP = 0.001
"""Seconds that a step of the loop takes."""

MAX_STEPS = 1500
"""Bound of a sweep: the longest call takes about a third of it."""

BOUND = 5.0
"""Seconds, all of them steps: until a cancelled call is over, and for each check afterwards."""

NUMBERED = "n: int32 @sequence, part: int32"
PLAIN = "n: int32, part: int32"

HOME, AWAY, PAIRS = 7, 3, 5
"""The application that is active at first, another one, and one that sends two containers a run."""


class Wire(NamedTuple):
    """The protocol and the options of client and camera."""

    transport: Literal["tcp", "udp"] = "tcp"  # of the camera
    dialect: str = "handbook"  # of the camera
    numbered: bool = False  # the client's layout has an ``@sequence`` field
    quirks: tuple[tuple[str, Any], ...] = ()  # of the camera

    def __str__(self) -> str:
        """Return what is special about it."""
        words = [self.transport, self.dialect, "numbered" if self.numbered else "plain"]
        return " ".join([*words, *(f"{name}={value}" for name, value in self.quirks)])


WIRES = (
    Wire(),
    Wire(numbered=True),
    Wire("udp"),
    Wire("udp", numbered=True),
    Wire(dialect="thesis"),
    Wire(quirks=(("switch_answer", "before_status"), ("waiting_before_result", True))),
    Wire(quirks=(("busy_while_processing", True),)),
    Wire(dialect="b16"),
    Wire("udp", "b16", numbered=True),
    Wire(dialect="bid"),
    Wire("udp", "bid"),
    Wire(dialect="bid", quirks=(("push_status", True), ("disconnect_answer", "silent"))),
)

SMART = frozenset({"handbook", "thesis", "b16"})
"""Dialects of the camera that can be started, stopped and restarted; ``bid`` is not one."""

ID = frozenset({"bid"})
"""Dialects whose status and errors are asked for."""


class Bench(NamedTuple):
    """One camera and one client."""

    box: EmulatedCamera
    camera: Camera
    wire: Wire

    @property
    def layout(self) -> str:
        """The layout with which the client reads results."""
        return NUMBERED if self.wire.numbered else PLAIN


@dataclass(frozen=True)
class Call:
    """A call to be cancelled."""

    # the call; what it starts beside itself, it ends itself
    make: Callable[[Bench], Coroutine[Any, Any, object]]
    covers: tuple[str, ...]  # names of the methods that it is about
    before: Callable[[Bench], Coroutine[Any, Any, object]] | None = None  # what happens before it
    homes: frozenset[int] = frozenset({HOME})  # applications that may be active afterwards
    loses: bool = False  # the link may be lost by it
    stops: bool = False  # the camera may be stopped afterwards
    raises: tuple[type[BaseException], ...] = ()  # what it ends with if nobody cancels it
    # what stays owed for good if it is cancelled: an answer that never comes
    owes: frozenset[int] = frozenset()
    # somebody else switches the camera meanwhile, which the client is to see first
    meddled: bool = False
    running: bool = True  # whether the camera runs at first
    opened: bool = True  # whether the client is open at first
    options: dict[str, Any] = field(default_factory=dict[str, Any])  # of the client
    pinned: bool = True  # whether the client is told the dialect
    dialects: frozenset[str] = SMART | ID  # that have it


# ---------------------------------------------------------------------- calls


async def in_application(bench: Bench) -> None:
    async with bench.camera.application(AWAY):
        await asyncio.sleep(2 * STEP)
        result = await bench.camera.trigger()
        assert result.application == AWAY


async def in_application_that_fails(bench: Bench) -> None:
    with contextlib.suppress(ZeroDivisionError):
        async with bench.camera.application(AWAY):
            raise ZeroDivisionError


async def pair(bench: Bench) -> None:
    first, second = await bench.camera.trigger(PAIRS, results_per_trigger=2)
    assert (first.value[0], second.value[0]) == (second.value[0], bench.box.device.next_number - 1)


async def beside_another(bench: Bench) -> None:
    """A trigger in line behind another one, whose result must not suffer."""
    other = asyncio.create_task(bench.camera.trigger())
    try:
        await bench.camera.trigger()
    finally:
        await asyncio.wait({other})
    await asyncio.sleep(0)
    assert other.result().application == HOME


async def at_once(bench: Bench) -> None:
    async with asyncio.TaskGroup() as group:
        for _ in range(3):
            group.create_task(bench.camera.trigger())


async def give_up(bench: Bench) -> None:
    with contextlib.suppress(smartcam.TriggerTimeoutError):
        await bench.camera.trigger(timeout=2 * STEP)


async def lose_interest(bench: Bench) -> None:
    """Cancel a trigger whose inspection is under way; its result comes later."""
    task = asyncio.create_task(bench.camera.trigger())
    while not bench.box.device.processing:  # noqa: ASYNC110 - a state of the camera
        await asyncio.sleep(0)
    task.cancel()
    await asyncio.wait({task})


async def sensed(bench: Bench) -> None:
    """A sensor triggers, somebody waits for it."""
    waiting = bench.camera.next_result()
    bench.box.device.trigger()
    result = await waiting
    assert result.value[0] == bench.box.device.next_number - 1


async def next_of(stream: Subscription[Any]) -> object:
    async with stream:
        return await anext(stream)


async def streams(bench: Bench) -> None:
    camera = bench.camera
    subscribed: list[Subscription[Any]] = [camera.results(), camera.statuses()]
    if camera.capabilities.unasked_status:  # else a change may fall between two questions
        subscribed.append(camera.events())
    async with asyncio.TaskGroup() as group:
        for stream in subscribed:
            group.create_task(next_of(stream))
        bench.box.device.trigger()


async def lost(bench: Bench) -> None:
    cut(bench.box)
    while bench.camera.connected:
        with contextlib.suppress(LinkError, ResponseTimeoutError):
            await bench.camera.get_clock(timeout=0.1)


async def status_of_a_run(bench: Bench) -> None:
    bench.box.device.trigger()
    if bench.camera.capabilities.unasked_status:
        await bench.camera.wait_status(lambda status: Status.WAITING_FOR_TRIGGER not in status)
    await bench.camera.wait_status(lambda status: Status.WAITING_FOR_TRIGGER in status)


async def ready_after_a_switch(bench: Bench) -> None:
    bench.box.device.switch_application(AWAY, running=True)
    if bench.camera.capabilities.unasked_status:
        await bench.camera.wait_status(lambda status: Status.BUSY in status)
    await bench.camera.wait_ready()


async def dropped(bench: Bench) -> None:
    """Have a trigger dropped, which the camera shows until it is told not to."""
    device = bench.box.device
    assert [device.trigger(), device.trigger()] == [True, False]
    while device.processing:  # noqa: ASYNC110 - a state of the camera
        await asyncio.sleep(0)


async def reset(bench: Bench) -> None:
    assert Status.OVERTRIGGERED not in await bench.camera.reset_errors()
    assert Status.OVERTRIGGERED not in bench.box.device.status


def cut(box: EmulatedCamera) -> None:
    """End every link of the camera, as a pulled plug does."""
    with box.step():
        for link in box._listener.all_links:
            link.close("cut")


MAPPING = {HOME: NUMBERED, AWAY: PLAIN, PAIRS: "raw"}
BOTH = frozenset({HOME, AWAY})
TRIGGER = ("trigger",)


def asked(method: str, *args: Any, **more: Any) -> Call:
    """Return the call of one of the camera's methods."""
    return Call(lambda b: getattr(b.camera, method)(*args), (method,), **more)


CALLS: dict[str, Call] = {
    "trigger": asked("trigger"),
    "trigger with input": Call(lambda b: b.camera.trigger(input=bytes(4)), TRIGGER),
    "trigger here": asked("trigger", HOME),
    "trigger elsewhere": asked("trigger", AWAY),
    "trigger elsewhere with input": Call(lambda b: b.camera.trigger(AWAY, input=bytes(4)), TRIGGER),
    "trigger nowhere": asked("trigger", 99, raises=(smartcam.CommandRejectedError,)),
    "trigger read otherwise": Call(lambda b: b.camera.trigger(interpret_as=NUMBERED), TRIGGER),
    "trigger read by application": Call(lambda b: b.camera.trigger(interpret_as=MAPPING), TRIGGER),
    "trigger read wrongly": Call(
        lambda b: b.camera.trigger(interpret_as="x: bool"),
        TRIGGER,
        raises=(smartcam.InterpretationError,),
    ),
    "trigger for two": Call(pair, TRIGGER),
    "trigger from standstill": asked("trigger", HOME, running=False, dialects=SMART),
    "trigger elsewhere from standstill": asked("trigger", AWAY, running=False, dialects=SMART),
    "trigger after one dropped": asked("trigger", before=dropped),
    "trigger beside another": Call(beside_another, TRIGGER),
    "triggers at once": Call(at_once, TRIGGER),
    "trigger after one given up": asked("trigger", before=give_up),
    "trigger elsewhere after one given up": asked("trigger", AWAY, before=give_up),
    "trigger after one cancelled": asked("trigger", before=lose_interest),
    "trigger elsewhere after one cancelled": asked("trigger", AWAY, before=lose_interest),
    "trigger that gives up": Call(give_up, TRIGGER),
    "switch_application": asked("switch_application", AWAY, homes=BOTH, stops=True),
    "switch_application nowhere": asked(
        "switch_application", 99, raises=(smartcam.CommandRejectedError,), stops=True
    ),
    "application": Call(in_application, ("application",)),
    "application that fails": Call(in_application_that_fails, ("application",)),
    "application from standstill": Call(
        in_application, ("application",), running=False, dialects=SMART
    ),
    "start": asked("start", running=False, dialects=SMART),
    "stop": asked("stop", stops=True, dialects=SMART),
    "query_application": asked("query_application"),
    "query_status": asked("query_status", dialects=ID),
    "reset_errors": Call(reset, ("reset_errors",), before=dropped, dialects=ID),
    "read_image": asked("read_image", raises=(smartcam.UnsupportedError,)),
    "newest_frame": asked("newest_frame", raises=(smartcam.UnsupportedError,)),
    "take_back": asked("take_back", raises=(smartcam.UnsupportedError,)),
    "frame_after": asked("frame_after", raises=(smartcam.UnsupportedError,)),
    "get_clock": asked("get_clock"),
    "set_clock": Call(
        lambda b: b.camera.set_clock(datetime(2024, 1, 1)),  # noqa: DTZ001 - it has no zone
        ("set_clock",),
    ),
    "set_input": asked("set_input", bytes(4)),
    "set_sequence_number": asked("set_sequence_number", 1000, dialects=SMART),
    "wait_status": Call(status_of_a_run, ("wait_status",)),
    "wait_ready": Call(ready_after_a_switch, ("wait_ready",), homes=BOTH, meddled=True),
    "wait_connected": asked("wait_connected", before=lost, loses=True),
    "next_result": Call(sensed, ("next_result",)),
    "streams": Call(streams, ("__anext__", "__aenter__", "__aexit__")),
    "request": asked("request", 0x32),
    "request without an answer": Call(
        lambda b: b.camera.request(0x32, answered=False), ("request",)
    ),
    "request that nobody answers": Call(
        lambda b: b.camera.request(0x77, timeout=30 * STEP),
        ("request",),
        loses=True,
        raises=(ResponseTimeoutError,),
        owes=frozenset({0x77}),
        dialects=SMART,
    ),
    "request that nobody knows": Call(
        lambda b: b.camera.request(0x77, timeout=30 * STEP), ("request",), dialects=ID
    ),
    "reboot": asked("reboot", loses=True, stops=True, dialects=SMART),
    "open": asked("open", opened=False),
    "open for an application": Call(
        lambda b: b.camera.open(),
        ("__aenter__", "__await__"),
        opened=False,
        homes=BOTH,
        stops=True,
        options={"application": AWAY},
    ),
    "open from standstill": asked(
        "open", opened=False, running=False, options={"application": HOME}, dialects=SMART
    ),
    "open without a dialect": asked("open", opened=False, pinned=False),
    "close": Call(lambda b: b.camera.close(), ("close", "__aexit__")),
    "close behind a way back": asked(
        "close", before=lambda b: abandoned(b), stops=True, homes=BOTH
    ),
}


async def abandoned(bench: Bench) -> None:
    """Leave a temporary application to the supervisor."""
    task = asyncio.create_task(in_application(bench))
    while bench.box.device.active_application != AWAY:  # noqa: ASYNC110 - a state of the camera
        await asyncio.sleep(0)
    task.cancel()
    await asyncio.wait({task})


def calls_over(wire: Wire) -> list[str]:
    """Return the names of the calls that there are in the dialect of a wire."""
    return [name for name, call in CALLS.items() if wire.dialect in call.dialects]


def missing_calls() -> set[str]:
    """Return the coroutines of client and subscription that no call is about."""
    found = {*_coroutines(Camera), *_coroutines(Subscription)}
    return found - {name for call in CALLS.values() for name in call.covers}


def _coroutines(kind: type) -> Iterator[str]:
    """Give the names of what is to be awaited, or entered by ``async with``."""
    waits = ("Coroutine", "Awaitable", "AsyncGenerator", "AsyncContextManager", "Generator")
    for name, member in vars(kind).items():
        if not callable(member) or (name.startswith("_") and not name.endswith("__")):
            continue
        inner = inspect.unwrap(member)
        is_async = inspect.iscoroutinefunction(inner) or inspect.isasyncgenfunction(inner)
        gives = str(getattr(inner, "__annotations__", {}).get("return", ""))
        if is_async or gives.startswith(waits):
            yield name


# ---------------------------------------------------------------------- one cancellation


class Sweep(NamedTuple):
    """The outcome of cancelling one call at every step: number of steps, and the calls' ends."""

    steps: int
    ends: Counter[str]


def run_sweep(name: str, wire: Wire, every: int = 1) -> Sweep:
    """Cancel a call after 0, ``every``, 2 * ``every`` ... steps until it is over before that.

    Each is done twice: a trigger is the first thing afterwards, or a look at the camera's state.
    The notes of an AssertionError say where something was left behind.
    """
    ends: Counter[str] = Counter()
    for steps, checks in itertools.product(
        range(0, MAX_STEPS, every), (RESULTS_FIRST, STATE_FIRST)
    ):
        try:
            with asyncio.Runner(loop_factory=lambda: TimedLoop(turn=STEP)) as runner:
                end = runner.run(_cancelled_after(steps, CALLS[name], wire, checks))
        except BaseException as exc:
            first = checks[0].__name__
            exc.add_note(f"{name} over {wire}, cancelled after {steps} steps, then {first}")
            raise
        ends[end] += 1
        if end == "over" and checks is STATE_FIRST:
            return Sweep(steps, ends)
    raise AssertionError(f"{name} over {wire} is not over after {MAX_STEPS} steps")


async def _cancelled_after(steps: int, call: Call, wire: Wire, checks: Checks) -> str:
    tasks = asyncio.all_tasks()
    async with _box(wire, running=call.running) as box:
        url = box.url if call.pinned else box.url.partition("?")[0]
        bench = Bench(box, _client(url, wire, call.options), wire)
        if call.opened:
            await bench.camera.open()
        if call.before is not None:
            await call.before(bench)
        end = await _end_of(call, call.make(bench), steps)
        if "close" in call.covers or not call.opened:
            if steps and (call.opened or end == "cancelled"):  # else it was not even begun
                await _check_closed(bench.camera)
            await bench.camera.close()
            await _check_nothing_left(bench)
            async with _client(box.url, wire, {}) as other:
                await _check_client(Bench(box, other, wire), call, checks)
        else:
            await _check_client(bench, call, checks)
            await bench.camera.close()
        await _check_nothing_left(bench)
    assert asyncio.all_tasks() == tasks
    return end


async def _end_of(call: Call, coroutine: Coroutine[Any, Any, object], steps: int) -> str:
    """Cancel after so many steps and tell how it ended."""
    task = asyncio.create_task(coroutine)
    for _ in range(steps):
        await asyncio.sleep(0)
        if task.done():
            break
    over = task.done()
    task.cancel()
    _, late = await asyncio.wait({task}, timeout=BOUND)
    assert not late, f"it goes on for {BOUND} s after it was cancelled"
    if task.cancelled():
        return "cancelled"
    error = task.exception()
    if error is not None and not isinstance(error, call.raises):
        raise error
    assert error is not None or not call.raises
    return "over" if over else "went on"


def _box(wire: Wire, *, running: bool) -> EmulatedCamera:
    speaker: list[EmulatedCamera] = []

    def values(run: Run) -> dict[str, int]:
        return {"n": run.number, "part": (run.input or {}).get("part", 0)}

    def twice(run: Run) -> dict[str, int]:
        if speaker:  # not where the application tries its values
            # another part: a datagram like one that is there already counts as come twice
            data = run.number.to_bytes(4, "little") + b"\1\0\0\0"
            device = speaker[0].device
            device._send(m.ResultContainer(application=device.active_application, data=data))
        return values(run)

    program = {
        "layout": PLAIN,
        "input": "part: int32",
        "load_time": 5 * STEP,
        "processing_time": 4 * STEP,
    }
    applications = [
        {"id": HOME, **program, "generator": values},
        {"id": AWAY, **program, "generator": values},
        {"id": PAIRS, **program, "generator": twice},
    ]
    box = EmulatedCamera(
        applications,
        transport=wire.transport,
        dialect=wire.dialect,
        running=running,
        builtins=False,
        quirks={"reboot_time": 10 * STEP, "overtriggered_time": 5 * STEP, **dict(wire.quirks)},
    )
    speaker.append(box)
    return box


def _client(url: str, wire: Wire, options: dict[str, Any]) -> Camera:
    return smartcam.connect(
        url,
        interpret_as=NUMBERED if wire.numbered else PLAIN,
        reconnect=Backoff(initial=5 * STEP, maximum=20 * STEP, jitter=0),
        request_timeout=0.4,
        switch_timeout=1.0,
        **options,
    )


# ---------------------------------------------------------------------- what is left behind


async def _check_client(bench: Bench, call: Call, checks: Checks) -> None:
    """Assert that the client works as before and that both sides agree."""
    async with asyncio.timeout(BOUND):
        for _ in range(3):
            try:
                for check in STATE_FIRST if call.meddled else checks:
                    await check(bench, call)
            except LinkError:
                assert call.loses
                await bench.camera.wait_connected()
            else:
                break
        else:
            raise AssertionError("the link is lost again and again")
    _check_waiters(bench.camera)
    balance(bench.camera.statistics())


async def _check_state(bench: Bench, call: Call) -> None:
    """Assert that client and camera agree about application and run state."""
    camera, device = bench.camera, bench.box.device
    while device.processing or device.mode.value in {"switching", "rebooting"}:  # noqa: ASYNC110
        await asyncio.sleep(0)
    await camera.wait_connected()
    async with inside(camera)._lock.hold(BOUND):  # behind every way back
        active = await inside(camera)._commands.query_application(
            inside(camera)._connection.deadline(BOUND)
        )
    assert active == camera.active_application == device.active_application
    assert active in call.homes
    assert inside(camera)._state.wanted.application in {None, active}
    if not camera.capabilities.unasked_status:
        await camera.query_status()
    bits = bench.box.wire_dialect.status_bits
    assert camera.status == bits.read(bits.write(device.status))
    while not inside(camera)._waits.pending_answers.keys() <= call.owes:  # noqa: ASYNC110 - the client's own question
        await asyncio.sleep(0)


async def _check_run_state(bench: Bench, call: Call) -> None:
    """Assert that the camera runs, or not, as before, unless the call was to change that."""
    if call.opened and not call.stops and "start" not in call.covers:
        assert bench.box.device.running == call.running


async def _check_results(bench: Bench, call: Call) -> None:
    """Assert that triggers give their own results, at once where the camera runs."""
    camera, device = bench.camera, bench.box.device
    await camera.wait_connected()
    try:
        result = await camera.trigger(interpret_as=bench.layout)
        assert result.value[0] == device.next_number - 1, "it is an older result"
    except smartcam.NotRunningError:
        assert call.stops or not call.running
        await camera.start()
    except smartcam.OvertriggeredError:
        # the status in which Waiting drops may still be on its way when the next one is sent
        assert bench.wire.numbered
    for _ in range(2):
        result = await camera.trigger(interpret_as=bench.layout)
        assert result.value[0] == device.next_number - 1, "it is an older result"
        assert result.application == device.active_application


Checks = tuple["Callable[[Bench, Call], Coroutine[Any, Any, None]]", ...]

RESULTS_FIRST: Checks = (_check_results, _check_state)
STATE_FIRST: Checks = (_check_state, _check_run_state, _check_results, _check_state)


@contextlib.contextmanager
def _expected(kind: type[BaseException]) -> Iterator[None]:
    try:
        yield
    except kind:
        return
    raise AssertionError(f"no {kind.__name__} came")


def _check_waiters(camera: Camera) -> None:
    """Assert that nobody is left who waits, and no turn is held."""
    lock, listeners = inside(camera)._lock, camera._listeners
    assert inside(camera)._results.correlation.pending is None
    assert not inside(camera)._waits.status_waiters
    assert not [future for future in listeners._next_results if not future.done()]
    assert not lock._running_jobs
    assert not lock._lock.locked()
    names = [task.get_name() for task in asyncio.all_tasks()]
    ours = [name for name in names if name.startswith("smartcam[")]
    assert sorted(ours) == [
        f"smartcam[{camera.name}].receive",
        f"smartcam[{camera.settings.address.host}].supervisor",
    ]


async def _check_closed(camera: Camera) -> None:
    """Assert that a client whose opening or closing was cancelled is closed."""
    assert not camera.connected
    with _expected(smartcam.ConnectionClosedError):
        await camera.get_clock()


async def _check_nothing_left(bench: Bench) -> None:
    """Assert that no link is left on either side, and no task of the client."""
    box, camera = bench.box, bench.camera
    if box.transport == "tcp":  # over UDP a camera keeps a session that was dropped
        async with asyncio.timeout(BOUND):
            while box.has_session or box.links:  # noqa: ASYNC110 - a state of the camera
                await asyncio.sleep(0)
    assert not [t for t in asyncio.all_tasks() if t.get_name().startswith("smartcam[")]
    session = inside(camera)._supervisor.session
    assert session is None or session.link._transport.is_closing()
    balance(camera.statistics())


# ---------------------------------------------------------------------- long form


def main(arguments: list[str] | None = None) -> int:
    """Sweep everything and print what it was; 1 if something was left behind."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--every", type=int, default=1, help="steps between two cancellations")
    parser.add_argument("--only", default="", help="calls whose names contain this")
    parser.add_argument("--wire", default="", help="wires whose descriptions contain this")
    options = parser.parse_args(arguments)
    logging.disable()  # lost links and refusals are what is wanted here
    began, failed = time.monotonic(), 0
    total: Counter[str] = Counter()
    for wire in WIRES:
        for name in calls_over(wire):
            if options.only not in name or options.wire not in str(wire):
                continue
            try:
                sweep = run_sweep(name, wire, options.every)
            except Exception as exc:  # noqa: BLE001 - reported, and the sweep goes on
                failed += 1
                print(f"FAILED {' '.join(getattr(exc, '__notes__', []))}: {exc!r}")  # noqa: T201
                continue
            total += sweep.ends
            print(f"{wire}: {name}: {sweep.steps} steps: {dict(sweep.ends)}")  # noqa: T201
    seconds = time.monotonic() - began
    cancelled = total["cancelled"] + total["went on"]
    print(f"{cancelled} cancellations, {failed} failed, {seconds:.0f} s: {dict(total)}")  # noqa: T201
    if missing := missing_calls():
        print(f"FAILED no sweep of {sorted(missing)}")  # noqa: T201
    return 1 if failed or missing else 0


if __name__ == "__main__":
    sys.exit(main())
