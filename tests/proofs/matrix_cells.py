"""The cells of the fault matrix: which fault, at which place of which command, and what may follow.

Places are found by a clean run of the same command: it says the same every time.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from matrix_ops import OPS, Op, scout
from matrix_world import PATIENT, SHORT, Bounds, World

from smartcam import exceptions as e
from smartcam.models import Status
from smartcam.protocols import messages as m
from smartcam.testing.proxy import rules

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from matrix_world import Bench, Heard

__all__ = ["Cell", "Fault", "Place", "datagram_cells", "link_cells", "places"]

Errors = tuple[type[e.SmartCamError], ...]

NONE: Errors = ()
LOST: Errors = (e.ConnectionLostError,)
SILENT: Errors = (*LOST, e.ResponseTimeoutError, e.TriggerTimeoutError)

AT_ONCE = 0.5
"""Seconds within which a call fails where the link was ended: its own timeouts are far longer."""


@dataclass(frozen=True)
class Fault:
    """What is done to a bench, and what may come of it.

    Attributes:
        arm: does it, before the command under test.
        fired: whether it happened.
        allowed: errors that the command and the first triggers behind it may end with.
        bounds: the client's timeouts.
        at_once: errors come within this many seconds; None: within the command's own bound.
        repairs: errors that the user is told to mend, and mends.
        heal: ends what would last for ever.
        lasts: seconds after which what it holds back has come; it may harm the client once more.
        copies: how often a container may come for each time it was sent.
        strays: a container of no run may be taken for the result of a trigger without a number,
            and the trigger's own for the next one's.
        garbled: other bytes stand in a frame's body, which nothing on the wire tells.
        blind: over TCP a status is withheld or swallowed, against what the camera's manual says:
            what the client believes of the camera is wrong until a new session tells.
        known: why it fails as things are; a cell that passes nevertheless is a failure.

    ``arm``, ``fired`` and ``heal`` take the kind of bench that their cells have.
    """

    arm: Callable[[Any], None]
    fired: Callable[[Any], bool]
    allowed: Errors
    bounds: Bounds = SHORT
    at_once: float | None = None
    repairs: Errors = NONE
    heal: Callable[[Any], None] | None = None
    lasts: float = 0.0
    copies: int = 1
    strays: bool = False
    garbled: bool = False
    blind: bool = False
    known: str = ""


class Cell(NamedTuple):
    """One cell; its name says all of it."""

    family: str
    world: World
    op: str
    label: str
    fault: Fault

    @property
    def name(self) -> str:
        """Its name."""
        return f"{self.family}/{self.world}/{self.op}/{self.label}".replace(" ", "_")


class Place(NamedTuple):
    """A frame of a command.

    Attributes:
        number: of its kind, from 1.
        at: offset of its first byte in what its side says in the command.
        nth: of all frames of its side, from 1.
        status: what the camera said last before it.
        following: bytes of the next frame of its side, 1 where there is none.
        owed: answers that the camera owes then, its own among them.
    """

    frame: Heard
    number: int
    at: int
    nth: int
    status: Status
    following: int
    owed: frozenset[str]

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
            reset = rules.Reset(direction=one.way, at=at)
            yield Cell("tcp reset", world, name, label, by_rule(op, reset, LOST, **end))
            stall = rules.Stall(direction=one.way, at=at, both=position in outer)
            yield Cell("tcp stall", world, name, label, by_rule(op, stall, SILENT))
            if position in inner:
                split = rules.Split(direction=one.way, at=at, pause=0.01)
                yield Cell(
                    "tcp split", world, name, label, by_rule(op, split, NONE, bounds=PATIENT)
                )


def _frame_cells(world: World, name: str, found: Sequence[Place]) -> Iterator[Cell]:
    """Give each frame together with the next one, and each twice."""
    op = OPS[name]
    for one in found:
        both = rules.Coalesce(
            direction=one.way, at=one.at, size=one.size + one.following, seconds=0.02
        )
        yield Cell("tcp coalesce", world, name, one.name, by_rule(op, both, NONE, bounds=PATIENT))
        twice = rules.Duplicate(direction=one.way, at=one.at, count=one.size)
        allowed = TWICE.get(one.frame.message, NONE)
        fault = by_rule(op, twice, allowed, bounds=PATIENT, copies=2)
        yield Cell("tcp twice", world, name, one.name, fault)


TWICE: Mapping[str, Errors] = {"Trigger": (e.OvertriggeredError,)}
"""What a command may end with if the camera hears a request of it twice."""

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
            "lost": rules.Lose(**picked),
            "twice": rules.Repeat(**picked),
            "3 times": rules.Repeat(**picked, copies=2),
            "soon": rules.Late(**picked, seconds=0.02),
            "late": rules.Late(**picked, seconds=0.25),
            "behind the next": rules.Reorder(**picked, seconds=0.05),
            "behind two": rules.Reorder(**picked, behind=2, seconds=0.05),
        }
        for label, rule in changes.items():
            more: dict[str, Any] = {"allowed": SILENT}
            lasts = rule.seconds if isinstance(rule, (rules.Late, rules.Reorder)) else 0.0
            if isinstance(rule, rules.Repeat):
                more = {"allowed": TWICE.get(one.frame.message, NONE), "bounds": PATIENT}
                more["copies"] = 1 + rule.copies
            elif one.frame.message == "StatusReport":  # an old one may be heard last
                more = {"allowed": (*SILENT, e.NotRunningError)}
            elif one.frame.message == "SetInput":
                more["allowed"] = (*SILENT, e.InputContainerError)
            fault = by_rule(op, rule, lasts=lasts, **more)
            yield Cell("udp link", world, name, f"{one.name}: {label}", fault)
