"""The fault matrix: what is under test, the faults, and the places at which each happens.

A command has a bound and errors that it may end with. Places are found by a clean run of the same
command: it says the same every time.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any, Literal, NamedTuple

from smartcam import exceptions as e
from smartcam.models import Status
from smartcam.protocols import messages as m
from smartcam.testing import proxy as rules
from tests.proofs.books import LINK_LOST, TRIGGER_OUTCOMES
from tests.proofs.matrix_world import (
    AWAY,
    HOME,
    PATIENT,
    READING,
    SHORT,
    Bench,
    BenchBase,
    Bounds,
    World,
    bench,
    come_true,
)

TOKEN = (4711).to_bytes(4, "little")

Errors = tuple[type[e.SmartCamError], ...]

REQUEST: Errors = (e.ResponseTimeoutError, *LINK_LOST)
CLOCK: Errors = (e.InterpretationError, *REQUEST)
SWITCH: Errors = (e.CommandRejectedError, *REQUEST)
HALFWAY: Errors = (e.NotRunningError, e.WrongApplicationError)
REFUSED: Errors = (e.CommandRejectedError, e.UnsupportedError)
"""Errors that any answer may lead to in a dialect with result codes."""


class Heard(NamedTuple):
    """A frame as the client saw it: ``>`` out, ``<`` in."""

    direction: str
    message: str
    wire: bytes


@dataclass(frozen=True)
class Op:
    """A command."""

    run: Callable[[BenchBase], Awaitable[object]]  # it; what it gives is looked at on the way
    bound: Callable[[Bounds], float]  # seconds that it may take, of the client's bounds
    ends: Errors  # errors that it may ever end with
    before: Callable[[BenchBase], Awaitable[object]] | None = None  # what brings the camera there
    opened: bool = True  # whether the client is open at first
    home: int = HOME  # the application it begins in
    # whether results matter to it, so that it is done with and without numbers
    triggers: bool = False
    stops: bool = False  # the camera may be stopped afterwards because it was told so
    closes: bool = False  # the client is closed afterwards
    mends: Errors = ()  # errors that a user mends who was told that this command failed
    needs: tuple[type[m.Message], ...] = ()  # messages that a dialect must have for it


async def _switch(bench: BenchBase) -> None:
    await bench.camera.switch_application(AWAY)
    really = bench.really_active()
    bench.demand_value(really == AWAY, f"switched to {AWAY}, {really} is active")


async def _set_clock(bench: BenchBase) -> None:
    await bench.camera.set_clock(datetime(2024, 5, 6, 7, 8, 9))  # noqa: DTZ001 - it has no zone
    await bench.ask_clock()


async def _start(bench: BenchBase) -> None:
    await bench.camera.start(timeout=bench.bounds.switch)


async def _stop(bench: BenchBase) -> None:
    await bench.camera.stop(timeout=bench.bounds.switch)


async def _stopped(bench: BenchBase) -> None:
    bench.stop_camera()


async def _failing(bench: BenchBase) -> None:
    """Have a trigger dropped, which its camera shows until it is told not to."""
    assert isinstance(bench, Bench)
    device = bench.box.device
    assert [device.trigger(), device.trigger()] == [True, False]
    await come_true(lambda: not device.processing)


async def _reset_errors(bench: BenchBase) -> None:
    assert isinstance(bench, Bench)
    told = await bench.camera.reset_errors()
    for status in (told, bench.box.device.status):
        bench.demand_value(Status.OVERTRIGGERED not in status, f"not reset: {status}")


async def _ask_status(bench: BenchBase) -> None:
    assert isinstance(bench, Bench)
    bits, device = bench.world.spoken.status_bits, bench.box.device
    right = [device.status]
    told = await bench.camera.query_status()
    right.append(device.status)
    words = [bits.read(bits.write(status)) for status in right]
    bench.demand_value(told in words, f"status {told}, {words} is right")


async def _visit(bench: BenchBase) -> None:
    async with bench.camera.application(AWAY):
        await bench.trigger()


OPS: dict[str, Op] = {
    "open": Op(
        lambda b: b.camera.open(),
        lambda t: t.connect + 2 * t.switch + t.close,
        (e.ConnectFailedError, *SWITCH),
        opened=False,
    ),
    "open stopped": Op(
        lambda b: b.camera.open(),
        lambda t: t.connect + 2 * t.switch + t.close,
        (e.ConnectFailedError, *SWITCH),
        before=_stopped,
        opened=False,
        needs=(m.Start,),
    ),
    "trigger": Op(lambda b: b.trigger(), lambda t: t.trigger, TRIGGER_OUTCOMES, triggers=True),
    "input": Op(
        lambda b: b.trigger(input=TOKEN),
        lambda t: t.trigger,
        TRIGGER_OUTCOMES,
        home=READING,
        triggers=True,
    ),
    "elsewhere": Op(
        lambda b: b.trigger(AWAY),
        lambda t: 2 * t.switch + t.trigger,
        TRIGGER_OUTCOMES,
        triggers=True,
        mends=HALFWAY,
    ),
    "visit": Op(
        _visit,
        lambda t: 2 * t.switch + t.trigger,
        (*TRIGGER_OUTCOMES, e.ResponseTimeoutError),
        triggers=True,
        mends=HALFWAY,
    ),
    "switch": Op(_switch, lambda t: t.switch, SWITCH, mends=HALFWAY),
    "query": Op(lambda b: b.ask_application(), lambda t: t.request, REQUEST),
    "clock": Op(lambda b: b.ask_clock(), lambda t: t.request, CLOCK),
    "set clock": Op(_set_clock, lambda t: 2 * t.request, CLOCK),
    "start": Op(_start, lambda t: t.switch, REQUEST, before=_stop, mends=HALFWAY, needs=(m.Start,)),
    "stop": Op(_stop, lambda t: t.switch, REQUEST, stops=True, needs=(m.Stop,)),
    "reboot": Op(
        lambda b: b.camera.reboot(), lambda t: t.request + t.close, REQUEST, needs=(m.Reboot,)
    ),
    "status": Op(_ask_status, lambda t: t.request, REQUEST, needs=(m.GetStatus,)),
    "reset errors": Op(
        _reset_errors, lambda t: t.request, REQUEST, before=_failing, needs=(m.ResetErrors,)
    ),
    "set input": Op(
        lambda b: b.camera.set_input(TOKEN),
        lambda t: t.request,
        REQUEST,
        home=READING,
        needs=(m.SetInputAnswer,),
    ),
    "close": Op(lambda b: b.close(), lambda t: t.switch + t.close, (), closes=True),
}


def ops_of(world: World) -> dict[str, Op]:
    """Return the commands that a dialect has."""
    spoken = world.spoken
    return {name: op for name, op in OPS.items() if all(spoken.has(one) for one in op.needs)}


def ends_of(name: str, world: World) -> Errors:
    """Return the errors that a command may ever end with in a dialect."""
    ends = OPS[name].ends
    return (*ends, *REFUSED) if ends and world.spoken.capabilities.result_codes else ends


async def scout(world: World, name: str) -> list[Heard]:
    """Return the frames of an undisturbed command, in the order in which the client sees them."""
    op = OPS[name]
    async with bench(world, PATIENT, op.home) as one:
        begin = await prepare(one, op)
        async with asyncio.timeout(10):
            await op.run(one)
        asked = len(one.ear.frames)
        asks = not op.closes and name != "reboot"
        if asks:
            await one.camera.query_application()  # so that what came last was heard
        heard = [Heard(f.direction, f.message, bytes.fromhex(f.hex)) for f in one.ear.frames]
        if asks:
            assert (heard[asked].message, heard[-1].message) == ("Query", "QueryAnswer")
            del heard[asked], heard[-1]
        assert one.wrong == [], one.wrong
        frames = heard[begin:]
    return [one for one in frames if name != "reboot" or one.message == "Reboot"]


async def prepare(one: BenchBase, op: Op) -> int:
    """Bring client and camera to where the command begins; return how many frames went by."""
    if op.opened:
        await one.camera.open()
    if op.before is not None:
        await op.before(one)
    if op.opened:
        await one.camera.query_application()  # nothing is under way in either direction
    return len(one.ear.frames)


NONE: Errors = ()
LOST: Errors = (e.ConnectionLostError,)
SILENT: Errors = (*LOST, e.ResponseTimeoutError, e.TriggerTimeoutError)

AT_ONCE = 0.5
"""Seconds within which a call fails where the link was ended: its own timeouts are far longer."""


@dataclass(frozen=True)
class Fault:
    """A deed done to a bench, and its possible outcomes.

    ``arm``, ``fired`` and ``heal`` take the kind of bench that their cells have.
    """

    arm: Callable[[Any], None]  # does it, before the command under test
    fired: Callable[[Any], bool]  # whether it happened
    allowed: Errors  # errors that the command and the first triggers behind it may end with
    bounds: Bounds = SHORT  # the client's timeouts
    # errors come within this many seconds; None: within the command's own bound
    at_once: float | None = None
    repairs: Errors = NONE  # errors that the user is told to mend, and mends
    heal: Callable[[Any], None] | None = None  # ends what would last for ever
    # seconds after which what it holds back has come; it may harm the client once more
    lasts: float = 0.0
    copies: int = 1  # how often a container may come for each time it was sent
    # a container of no run may be taken for the result of a trigger without a number, and the
    # trigger's own for the next one's
    strays: bool = False
    garbled: bool = False  # other bytes stand in a frame's body, which nothing on the wire tells
    # over TCP a status is withheld or swallowed, against what the camera's manual says: what the
    # client believes of the camera is wrong until a new session tells
    blind: bool = False
    known: str = ""  # why it fails as things are; a cell that passes nevertheless is a failure


class Cell(NamedTuple):
    """One cell; its name says all of it."""

    family: str
    world: World
    op: str
    label: str
    fault: Fault

    @property
    def name(self) -> str:
        return f"{self.family}/{self.world}/{self.op}/{self.label}".replace(" ", "_")


class Place(NamedTuple):
    """A frame of a command."""

    frame: Heard
    number: int  # of its kind, from 1
    at: int  # offset of its first byte in what its side says in the command
    nth: int  # of all frames of its side, from 1
    status: Status  # what the camera said last before it
    following: int  # bytes of the next frame of its side, 1 where there is none
    owed: frozenset[str]  # answers that the camera owes then, its own among them

    @property
    def name(self) -> str:
        """Direction, message and number."""
        return f"{self.frame.direction}{self.frame.message}{self.number}"

    @property
    def way(self) -> Literal["up", "down"]:
        """Its direction as link proxies call it."""
        return "up" if self.frame.direction == ">" else "down"

    @property
    def size(self) -> int:
        """Bytes on the wire."""
        return len(self.frame.wire)


async def places(world: World, op: str) -> list[Place]:
    """Return the frames of a command."""
    frames = await scout(world, op)
    spoken, header = world.spoken, world.header
    answers = {
        row.type.__name__: row.type.answer.__name__
        for row in spoken.table
        if issubclass(row.type, m.Request) and row.type.answer and spoken.has(row.type.answer)
    }
    owed: set[str] = set()
    kinds: Counter[str] = Counter()
    sizes: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    status = Status(0) if op in {"open", "open stopped", "start"} else _READY
    found: list[Place] = []
    for index, frame in enumerate(frames):
        way = frame.direction
        key = way + frame.message
        kinds[key] += 1
        counts[way] += 1
        if frame.message in answers:
            owed.add(answers[frame.message])
        rest = [len(one.wire) for one in frames[index + 1 :] if one.direction == way]
        following = rest[0] if rest else 1
        place = Place(
            frame, kinds[key], sizes[way], counts[way], status, following, frozenset(owed)
        )
        found.append(place)
        sizes[way] += len(frame.wire)
        owed.discard(frame.message)
        if frame.message == "StatusReport":
            word = int.from_bytes(frame.wire[header : header + world.word], "little")
            status = spoken.status_bits.read(word)
    return found


_READY = Status.RUNNING | Status.WAITING_FOR_TRIGGER


# ---------------------------------------------------------------------- the link


def by_rule(op: Op, rule: rules.Rule, allowed: Errors, **more: Any) -> Fault:
    """Return what a rule of the link proxy does to the link that is open."""

    def arm(bench: Bench) -> None:
        if op.opened:
            bench.proxy.from_now(rule)
        else:
            bench.proxy.rules.append(replace(rule, connection=1))

    def fired(bench: Bench) -> bool:
        return bench.proxy.counts[rule.name] > 0

    return Fault(arm, fired, allowed, **more)


def _byte_cells(
    world: World, name: str, found: Sequence[Place], *, all_bytes: bool
) -> Iterator[Cell]:
    """Give every byte position of every frame: before the first to behind the last."""
    op = OPS[name]
    for one in found:
        inner = range(1, one.size) if all_bytes else (world.header // 3, one.size - 1)
        outer = {0, one.size} if one.at == 0 else {one.size}
        for position in sorted({*inner, *outer}):
            at, label = one.at + position, f"{one.name}@{position}"
            end = {"bounds": PATIENT, "at_once": AT_ONCE}
            cut = rules.Cut(direction=one.way, at=at)
            yield Cell("tcp cut", world, name, label, by_rule(op, cut, LOST, **end))
            reset = rules.ResetConnection(direction=one.way, at=at)
            yield Cell("tcp reset", world, name, label, by_rule(op, reset, LOST, **end))
            stall = rules.Stall(direction=one.way, at=at, both=position in outer)
            yield Cell("tcp stall", world, name, label, by_rule(op, stall, SILENT))
            if position in inner:
                split = rules.SplitBytes(direction=one.way, at=at, pause=0.01)
                yield Cell(
                    "tcp split", world, name, label, by_rule(op, split, NONE, bounds=PATIENT)
                )


def _frame_cells(world: World, name: str, found: Sequence[Place]) -> Iterator[Cell]:
    """Give each frame together with the next one, and each twice."""
    op = OPS[name]
    for one in found:
        both = rules.CoalesceBytes(
            direction=one.way, at=one.at, size=one.size + one.following, seconds=0.02
        )
        yield Cell("tcp coalesce", world, name, one.name, by_rule(op, both, NONE, bounds=PATIENT))
        twice = rules.DuplicateBytes(direction=one.way, at=one.at, count=one.size)
        allowed = TWICE.get(one.frame.message, NONE)
        fault = by_rule(op, twice, allowed, bounds=PATIENT, copies=2)
        yield Cell("tcp twice", world, name, one.name, fault)


TWICE: Mapping[str, Errors] = {"Trigger": (e.OvertriggeredError,)}
"""Errors that a command may end with if the camera hears a request of it twice."""

LONG_OPS = frozenset({"elsewhere", "visit", "open stopped"})
"""Commands whose messages are those of others: not every byte of them is tried."""


def link_cells(world: World, name: str, found: Sequence[Place]) -> Iterator[Cell]:
    """Give the cells of a TCP link."""
    yield from _byte_cells(world, name, found, all_bytes=name not in LONG_OPS)
    yield from _frame_cells(world, name, found)


def datagram_cells(world: World, name: str, found: Sequence[Place]) -> Iterator[Cell]:
    """Give the cells of a UDP link."""
    op = OPS[name]
    for one in found:
        picked: dict[str, Any] = {"direction": one.way, "number": one.nth}
        changes: dict[str, rules.Rule] = {
            "lost": rules.DropDatagrams(**picked),
            "twice": rules.DuplicateDatagrams(**picked),
            "3 times": rules.DuplicateDatagrams(**picked, copies=2),
            "soon": rules.DelayDatagrams(**picked, seconds=0.02),
            "late": rules.DelayDatagrams(**picked, seconds=0.25),
            "behind the next": rules.Reorder(**picked, seconds=0.05),
            "behind two": rules.Reorder(**picked, overtaken_by=2, seconds=0.05),
        }
        for label, rule in changes.items():
            more: dict[str, Any] = {"allowed": SILENT}
            lasts = rule.seconds if isinstance(rule, (rules.DelayDatagrams, rules.Reorder)) else 0.0
            if isinstance(rule, rules.DuplicateDatagrams):
                more = {"allowed": TWICE.get(one.frame.message, NONE), "bounds": PATIENT}
                more["copies"] = 1 + rule.copies
            elif one.frame.message == "StatusReport":  # an old one may be heard last
                more = {"allowed": (*SILENT, e.NotRunningError)}
            elif one.frame.message == "SetInput":
                more["allowed"] = (*SILENT, e.InputContainerError)
            fault = by_rule(op, rule, lasts=lasts, **more)
            yield Cell("udp link", world, name, f"{one.name}: {label}", fault)
