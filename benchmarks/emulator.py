"""Emulator: triggers that a process with emulated cameras answers in a second of CPU time.

Here the subject serves, so it has a process of its own, which tells its CPU time; the client is a
blocking socket for each camera, with prepared bytes, that triggers when the last answer is whole.
The yardstick is served in the same way: a bare protocol on asyncio that writes prepared bytes. The
answers of both sides are the same to the last byte, and each is compared.
"""

from __future__ import annotations

import contextlib
import socket
import time
from functools import partial
from itertools import cycle, islice
from typing import TYPE_CHECKING, NamedTuple

from benchmarks.cores import placed
from benchmarks.instructions import counted, difference
from benchmarks.malloc import UNSETTLED
from benchmarks.measure import Comparison, Cost, Goal, Plan, Series, instructions_of, take_turns
from benchmarks.peers import peer, wire
from benchmarks.peers.canned import HELLO, RUN, SPARE_FILES
from benchmarks.peers.control import Control, allow_files

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

__all__ = ["run"]

TRIGGERS = 2000
"""In a round of each side; fewer where each takes its time."""

COUNTED = 100
"""Where instructions are counted; twice as many as there are cameras."""

CAMERAS = 100, 1000

IDLE = 0.5
"""Seconds of each look at cameras that do nothing."""

EMULATOR, CANNED, SETTLED = "emulator", "canned, asyncio", "emulator, settled"

ONE, MANY = Goal("at most", 60, "us"), Goal("at most", 70, "us")
"""Of a trigger at one camera and at many, in a process whose allocator has not settled."""


class Case(NamedTuple):
    """One way to answer a trigger.

    Attributes:
        title: what it is.
        processing_time: seconds.
        source: where the values come from: ``constant`` or ``generator``.
        triggers: in a round of each side.
        note: what the reader needs to know.
        most: of a trigger's CPU time, where there is a goal; then more is looked at.
    """

    title: str
    processing_time: float
    source: str
    triggers: int
    note: str
    most: Goal | None = None


CASES = (
    Case(
        "processing time 0",
        0.0,
        "constant",
        TRIGGERS,
        "the result comes in the step of its trigger: one write",
        ONE,
    ),
    Case(
        "processing time 1 ms",
        0.001,
        "constant",
        TRIGGERS // 5,
        "the result comes by a timer, on both sides: two writes",
    ),
    Case(
        "values of a generator",
        0.0,
        "generator",
        TRIGGERS,
        "a layout's values are turned into bytes at each trigger",
    ),
)


def run(plan: Plan) -> Iterable[Comparison]:
    """Measure one camera, and many in one process; who triggers has the same core."""
    with placed(apart=False):
        yield from _cases(plan)


def _cases(plan: Plan) -> Iterable[Comparison]:
    for case in CASES:
        with (
            _serving(EMULATOR, 1, case.processing_time, case.source) as subject,
            _serving(CANNED, 1, case.processing_time) as yardstick,
        ):
            series = _triggers(plan, subject, yardstick, case.triggers)
        title = f"one camera, triggers, 5 localizations, {case.title}"
        counts = _count(plan, 1, COUNTED) if case.most else {}
        yield _compared(title, series, counts, case.note)
        if case.most is not None:
            yield _unsettled(plan, 1, title, case.most)
    for cameras in CAMERAS[:1] if plan.quick else CAMERAS:
        yield from _many(plan, cameras)


def _compared(
    title: str, series: dict[str, Series], counts: dict[str, float], note: str
) -> Comparison:
    counted = instructions_of(counts, EMULATOR, CANNED)
    sides = series[EMULATOR], series[CANNED]
    return Comparison("emulator", title, *sides, "speed", None, note, counted)


def _unsettled(plan: Plan, cameras: int, title: str, most: Goal) -> Comparison:
    """Measure emulators in a process that maps and unmaps each large block."""
    under = ("env", *(f"{name}={value}" for name, value in UNSETTLED.items()))
    with (
        _serving(EMULATOR, cameras, under=under) as subject,
        _serving(EMULATOR, cameras) as yardstick,
    ):
        count = plan.operations(TRIGGERS, least=20)
        sides = {
            EMULATOR: lambda: subject.trigger(count),
            SETTLED: lambda: yardstick.trigger(count),
        }
        series = take_turns(plan, sides)
    return Comparison(
        "emulator",
        f"{title}, allocator not settled",
        series[EMULATOR],
        series[SETTLED],
        "alone",
        most,
        "CPU time; the process maps and unmaps each block of 128 KiB or more",
    )


def _many(plan: Plan, full: int) -> Iterable[Comparison]:
    wanted = plan.operations(full, least=10)
    # its process has a port and a connection for each camera, this one a client of each side
    count = min(wanted, (allow_files(2 * wanted + SPARE_FILES) - SPARE_FILES) // 2)
    fewer = f"the system allows {count} of {wanted} cameras" if count < wanted else ""
    with _serving(EMULATOR, count) as subject, _serving(CANNED, count) as yardstick:
        sides = {EMULATOR: subject, CANNED: yardstick}
        memory = {
            name: Series(name, "KiB", [side.memory() for _ in range(plan.rounds)])
            for name, side in sides.items()
        }
        series = _triggers(plan, subject, yardstick, TRIGGERS)
        seconds = IDLE * plan.scale
        idle = take_turns(
            plan,
            {EMULATOR: lambda: subject.idle(seconds), CANNED: lambda: yardstick.idle(seconds)},
            unit="% of a core",
        )
    case = f"{count} cameras in one process"
    most = MANY if full == CAMERAS[0] else None
    counts = _count(plan, count, 2 * count) if most else {}
    yield _compared(f"{case}, triggers in turn", series, counts, fewer)
    if most is not None:
        yield _unsettled(plan, count, f"{case}, triggers in turn", most)
    yield Comparison(
        "emulator",
        f"{case}, memory of one with its client",
        memory[EMULATOR],
        memory[CANNED],
        how="more",
        note="before the first trigger; the yardstick has one port for all",
    )
    yield Comparison(
        "emulator",
        f"{case}, idle",
        idle[EMULATOR],
        idle[CANNED],
        how="more",
        note="what asking for the figure costs is in both",
    )


class Side:
    """A process that serves cameras, and a client of each.

    Args:
        control: of that process.
        links: connected, in a session.
    """

    def __init__(self, control: Control, links: list[socket.socket]) -> None:
        self._control = control
        self._links = links
        self._turns = cycle(links)

    def trigger(self, count: int) -> Cost:
        """Trigger the cameras in turn; return the process' CPU time for each, in microseconds."""
        begin = self._control.usage().cpu
        for link in islice(self._turns, count):
            link.sendall(TRIGGER)
            assert _receive(link, len(RUN)) == RUN
        return (self._control.usage().cpu - begin) / count * 1e6

    def memory(self) -> Cost:
        """Return how much memory a camera takes, KiB."""
        usage = self._control.usage()
        return (usage.resident - usage.before) / len(self._links)

    def idle(self, seconds: float) -> Cost:
        """Let it do nothing for a time; return its CPU time, percent of a core."""
        begin, since = self._control.usage().cpu, time.monotonic()
        time.sleep(seconds)
        return (self._control.usage().cpu - begin) / (time.monotonic() - since) * 100


def _count(plan: Plan, cameras: int, triggers: int) -> dict[str, float]:
    """Return the instructions of a trigger of each side; nothing where none are to be counted."""
    if not plan.instructions:
        return {}

    def total(name: str, count: int) -> int:
        with counted() as (prefix, read):
            with _serving(name, cameras, under=prefix) as side:
                side.trigger(count)
            return read()

    return {name: difference(partial(total, name), triggers) for name in (EMULATOR, CANNED)}


def _triggers(plan: Plan, subject: Side, yardstick: Side, full: int) -> dict[str, Series]:
    count = plan.operations(full, least=20)
    return take_turns(
        plan,
        {EMULATOR: lambda: subject.trigger(count), CANNED: lambda: yardstick.trigger(count)},
    )


@contextlib.contextmanager
def _serving(
    name: str,
    cameras: int,
    processing_time: float = 0.0,
    source: str = "constant",
    under: Sequence[str] = (),
) -> Iterator[Side]:
    """Start a process and connect to every camera in it."""
    module, *more = {EMULATOR: ("emulated", source), CANNED: ("canned",)}[name]
    with (
        peer(module, str(cameras), str(processing_time), *more, under=under) as port,
        contextlib.ExitStack() as stack,
    ):
        control = Control(port)
        ports = control.usage().ports
        assert len(ports) == cameras
        links = [stack.enter_context(_session(port)) for port in ports]
        yield Side(control, links)


def _session(port: int) -> socket.socket:
    link = socket.create_connection(("127.0.0.1", port))
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    link.sendall(wire.frame(wire.CONNECT))
    assert _receive(link, len(HELLO)) == HELLO
    return link


def _receive(link: socket.socket, size: int) -> bytes:
    data = link.recv(size)
    while len(data) < size:
        more = link.recv(size - len(data))
        assert more, "the camera closed the connection"
        data += more
    return data


TRIGGER = wire.frame(wire.TRIGGER)
