"""Every interleaving of camera, client, sensor and operator: whose result does a trigger return?

A plain model of a camera does what ``docs/promises.md`` assumes of it (B, C, D, I), and uses all
freedom that this leaves: what it says is on its way while our words come the other way, one by one,
so that the network may cut a write anywhere; results and Waiting for Trigger come in any order; a
sensor triggers and an operator stops and starts between any two words. The client is the library's
own :class:`~smartcam._client.results.Results` (:mod:`tests.client.proofs.interleaved_client`), with
what stands around it in ``Triggers``. At any moment a call's time is over, or its task is
cancelled, and is woken a while later.

All states that can be reached are visited, breadth first, each once. Of each result that a call
returns it is known which word began its run:

* ``own``: this call's Trigger; the only thing that is right;
* ``fresh``: something else, after the call's words had been written;
* ``older``: something else, before that.

With each step it is seen, too, that every container that came has one fate, or waits for it.

``python -m tests.client.proofs.interleavings`` visits each variant as deep as stands in it, most of
them to the end, and prints what was found. ``--table`` prints the table of
``results/promises.md``.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from smartcam import Status
from tests.client.inside import Results
from tests.client.proofs.interleaved_client import (
    Client,
    Container,
    Family,
    freeze,
    share,
    thaw,
    time_stands_still,
)

WAITING, RUNNING, OVERTRIGGERED = (
    Status.WAITING_FOR_TRIGGER,
    Status.RUNNING,
    Status.OVERTRIGGERED,
)
SENSOR = 0
"""The owner of a run that a sensor began; triggers of ours count from 1."""

GIVEN_NUMBER = 41
"""Sequence number that the user sets by hand."""

QUERIES: dict[Family, int] = {"status": 2, "answer": 1, "round trip": 1, "nothing": 0}
"""Queries that go out with a trigger."""

Move = tuple[Any, ...]
Kind = Literal["own", "fresh", "older"]
KINDS: tuple[Kind, ...] = ("own", "fresh", "older")


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """A variant: the camera, the line, and the events that may happen.

    Attributes:
        name: for people.
        family: what shows that a trigger was taken: ``status`` (``handbook``, ``thesis`` and
            ``b16`` over TCP), ``answer`` (``bid`` over TCP), ``round trip``
            (``shows_triggers=no``), ``nothing`` (UDP).
        number: whose sequence number a trigger has: ``own``, ``given`` by the user, or none.
        bits: of the number.
        collides: runs of a sensor carry our next number, too.
        triggers, sensors, stops: how often we, a sensor, an operator may act.
        results: how many results a run may send.
        wanted: how many a call wants.
        preset: Overtriggered is set from the beginning.
        depth: moves from the beginning.
        shows: the status tells of each trigger that is taken (B).
        in_order: a run says everything before the next one shows (D).
        answers_early: Queries are answered before what came in front of them is done (against D).
        stop_voids: no result comes from an inspection that was stopped (C).
        sends_late: in ``bid`` the status says that it waits before all is said (against I).
        refuses: a trigger that comes during an inspection may be answered by a code that says so.
        reorders: the network lets datagrams overtake each other and loses them.
        exact: tell ``fresh`` from ``older``, for which every order has to be visited, also those
            that differ in nothing that camera or client could see.
    """

    name: str
    family: Family = "status"
    number: Literal["own", "given"] | None = None
    bits: int = 32
    collides: bool = True
    triggers: int = 2
    sensors: int = 2
    stops: int = 0
    results: tuple[int, ...] = (1,)
    wanted: int = 1
    preset: bool = False
    depth: int = 12
    shows: bool = True
    in_order: bool = True
    answers_early: bool = False
    stop_voids: bool = True
    sends_late: bool = False
    refuses: bool = False
    reorders: bool = False
    exact: bool = False


@dataclass(slots=True)
class World:
    """A camera, a client, and what is on its way between them."""

    variant: Variant
    client: Client
    # the camera
    running: bool = True
    inspecting: bool = False
    overtriggered: bool = False
    left: tuple[Container | None, ...] = ()  # what it has still to say; None: that it waits again
    next_number: int = 0
    reported: Status = RUNNING | WAITING
    unshown: bool = False  # an inspection that has begun is shown behind the next answer only
    # on their way
    words: deque[Move] = field(default_factory=deque[Move])
    said: deque[Move] = field(default_factory=deque[Move])
    # the client
    phase: str = "idle"
    asked: deque[str] = field(default_factory=deque[str])  # Queries without an answer
    # how often each has acted
    written: int = 0
    calls: int = 0
    sensors: int = 0
    stops: int = 0
    # kind of the result that the last call returned, None where it has none
    returned: Kind | None = None
    surplus: int = 0  # how many results it returned that were not asked for

    # ------------------------------------------------------------------ what may happen next

    def moves(self) -> Iterator[Move]:
        """Return all that may happen next."""
        variant, pending = self.variant, self.client.pending
        if self.phase == "ended":
            yield ("wake",)
        elif self.phase == "idle":
            if self.calls < variant.triggers:
                yield ("call",)
                if variant.number == "given":
                    yield ("call", GIVEN_NUMBER)
        elif pending is None:
            yield ("give up",)
        else:
            yield ("time out",)
            yield ("cancel",)
        if self.said and not variant.exact:
            # What the camera does commutes with what the client does, since queues lie between
            # them. So it is enough to have the camera go on when the client has heard all.
            yield ("hear", 0)
            return
        if self.words:
            if self.words[0][0] == "trigger":
                for left in self.runs():
                    yield ("take", left)
                if variant.refuses and self.inspecting:
                    yield ("refuse",)
            else:
                yield ("take", ())
        if self.said:
            yield ("hear", 0)
            if variant.reorders:
                for place in range(1, len(self.said)):
                    yield ("hear", place)
                if self.said[0][0] not in {"answer", "trigger answer"}:
                    yield ("lose",)
        if self.left:
            yield ("say",)
        if self.overtriggered and variant.family != "answer":
            yield ("calm",)
        if self.unshown:
            yield ("show",)
        if self.sensors < variant.sensors and self.running:
            for left in self.runs():
                yield ("sensor", left)
        if self.stops < variant.stops:
            yield ("stop",) if self.running else ("start",)

    def runs(self) -> Iterator[tuple[int, int]]:
        """Return what a run may send: how many results, how many of them behind Waiting."""
        for results in self.variant.results:
            # where the status is asked for, it says that it waits when all is said (I)
            says_all_first = self.variant.family == "answer" and not self.variant.sends_late
            most = 0 if says_all_first else results
            for behind in range(most + 1):
                yield results, behind

    def do(self, move: Move) -> None:
        """Have one of them happen."""
        match move:
            case ("call", *given):
                self.calls += 1
                self.returned = None
                self.phase = "prepare"
                if given:
                    self.words.append(("number", given[0]))
                    self.client.correlation.set_next_number(given[0])
            case ("give up",):
                self.phase = "idle"
            case ("time out",):
                self.client.time_out()
            case ("cancel",):
                self.client.cancel()
            case ("wake",):
                self.client.wake()
                self.phase = "idle"
            case ("take", left):
                self.take(self.words.popleft(), left)
            case ("refuse",):
                self.words.popleft()
                self.said.append(("refusal",))
            case ("hear", place):
                item = self.said[place]
                del self.said[place]
                self.hear(item)
            case ("lose",):
                self.said.popleft()
                if not any(one[0] == "status" for one in self.said):
                    self.said.append(("status", self.status))  # a later one shows it
            case ("say",):
                self.say()
            case ("calm",):
                self.overtriggered = False
                self.report()
            case ("show",):
                self.unshown = False
                self.report()
            case ("sensor", left):
                self.sensors += 1
                self.begin(SENSOR, left)
            case ("stop",):
                self.stops += 1
                self.stop()
            case _:
                self.running = True
                self.report()
        self.look()
        self.go_on()

    # ------------------------------------------------------------------ the camera

    @property
    def status(self) -> Status:
        """As it says it."""
        status = Status(0)
        if self.running or self.variant.family == "answer":
            status = RUNNING
            if not self.inspecting or not self.variant.shows:
                status |= WAITING
        return status | OVERTRIGGERED if self.overtriggered else status

    def report(self) -> None:
        """Say the status where it has changed, and where that is done without a question."""
        if self.variant.family == "answer" or self.unshown:
            return
        if self.status != self.reported:
            self.reported = self.status
            self.said.append(("status", self.status))

    def begin(self, whose: int, run: tuple[int, int]) -> None:
        """Take a trigger, or drop it."""
        if not self.running:
            return
        if self.inspecting:
            self.overtriggered = True
            self.unshown = False
            self.report()
            return
        while self.left and self.variant.in_order:
            self.say()
        late = self.left
        results, behind = run
        container = Container(whose, self.written, self.next_number)
        self.next_number = (self.next_number + 1) % (1 << self.variant.bits)
        self.left = (*late, *[container] * (results - behind), None, *[container] * behind)
        self.inspecting = True
        self.unshown = self.variant.answers_early and whose != SENSOR
        self.report()

    def say(self) -> None:
        """Say the next of what is left of a run."""
        what, *left = self.left
        self.left = tuple(left)
        self.unshown = self.unshown and what is not None
        self.report()
        if what is None:
            self.inspecting = False
            self.report()
        else:
            self.said.append(("result", what))

    def stop(self) -> None:
        """Leave run mode. An inspection under way is void, one that is over says the rest."""
        if self.inspecting and self.variant.stop_voids:
            self.left = ()
        self.inspecting = self.unshown = self.running = False
        if None in self.left:  # the inspection goes on unseen
            self.left = tuple(one for one in self.left if one is not None)
        elif self.variant.stop_voids:
            while self.left:
                self.say()
        self.report()

    def take(self, word: Move, run: tuple[int, int]) -> None:
        """Do what the client says."""
        match word:
            case ("query",):
                self.said.append(("answer",))
            case ("get status",):
                self.said.append(("status", self.status))
            case ("number", number):
                self.next_number = number
            case ("trigger", whose):
                if self.variant.family == "answer":
                    self.said.append(("trigger answer",))
                self.begin(whose, run)
            case ("reset",):
                self.overtriggered = False
                self.said.append(("status", self.status))
            case ("stop",):
                self.stop()
            case _:
                self.running = True
                self.report()

    # ------------------------------------------------------------------ the client

    def hear(self, item: Move) -> None:
        """Take what the camera has said."""
        client = self.client
        match item:
            case ("answer",):
                if self.asked.popleft() == "query":
                    client.answer()
            case ("trigger answer",):
                client.trigger_answer()
            case ("refusal",):
                client.refusal()
            case ("status", status):
                client.hear(status)
            case _:
                client.result(item[1])

    def look(self) -> None:
        """See whether the call has ended, and whose the results are that it returns."""
        pending = self.client.pending
        if self.phase != "sent" or pending is None or not pending.outcome.done():
            return
        self.phase = "ended"
        returned = self.client.returned
        if returned is None:
            return
        self.surplus = len(returned) - self.variant.wanted
        self.returned = "own"
        for one in returned:
            if one.whose != self.written:
                kind: Kind = "older" if one.written < self.written else "fresh"
                self.returned = max(kind, self.returned, key=KINDS.index)

    def go_on(self) -> None:
        """Have the client do what it does without waiting, as ``Triggers`` does it."""
        at, status = self.client.correlation, self.client.status
        if self.asked and self.phase not in {"idle", "sent", "ended"}:
            return  # one of ours is open
        match self.phase:
            case "prepare" if self.variant.family == "answer":
                self.ask("refreshed", ("get status",))
            case "refreshed" | "prepare":
                if self.variant.family == "answer":
                    at.note_query_answered()
                if at.status_may_be_old:
                    self.ask("heard")
                elif at.owed and self.variant.number != "own":
                    self.settle()
                else:
                    self.phase = "ready"
            case "heard":
                at.note_query_answered()
                self.phase = "prepare"
            case "settling" if WAITING in status:
                self.ask("settled")
            case "stopping" if RUNNING not in status:
                self.ask("stopped")
            case "stopped":
                self.words.append(("start",))
                self.phase = "starting"
            case "settled":
                at.forget_owed()
                self.phase = "ready"
            case "starting" if WAITING in status:
                at.forget_owed()
                self.phase = "ready"
            case "ready" if WAITING in status and OVERTRIGGERED not in status:
                self.send()
                return  # all else comes from the camera
            case "ready" if OVERTRIGGERED in status and self.variant.family == "answer":
                self.words.append(("reset",))
                self.ask("refreshed", ("get status",))
            case _:
                return
        self.go_on()

    def ask(self, phase: str, *before: Move) -> None:
        """Send a Query behind other words, and go on in a phase when it is answered."""
        self.words += [*before, ("query",)]
        self.asked.append("ours")
        self.phase = phase

    def settle(self) -> None:
        """Make the result of an earlier trigger impossible, or await it."""
        if self.variant.family == "answer":
            self.phase = "settling"
        else:
            self.words.append(("stop",))
            self.phase = "stopping"

    def send(self) -> None:
        """Write a trigger and what goes out with it."""
        variant, client = self.variant, self.client
        number = client.take_number()
        client.send(number, variant.wanted)
        self.written += 1
        self.phase = "sent"
        queries = QUERIES[variant.family]
        self.asked += ["query"] * queries
        if queries:
            self.words.append(("query",))
        if variant.family == "answer":
            self.words.append(("get status",))
        if number is not None:
            self.words.append(("number", number))
        self.words.append(("trigger", self.written))
        if variant.family == "answer":
            self.words.append(("get status",))
        elif variant.family == "status":
            self.words.append(("query",))

    # ------------------------------------------------------------------ states

    def key(self) -> object:
        """Return what tells this state from others."""
        camera = (self.running, self.inspecting, self.overtriggered, self.left, self.next_number)
        return (
            *(self.client.key(), camera, self.reported, self.unshown),
            *(tuple(self.words), tuple(self.said), tuple(self.asked), self.phase),
            *(self.written, self.calls, self.sensors, self.stops),
        )


@dataclass(slots=True)
class Visited:
    """The findings of a variant.

    Attributes:
        states: that were visited.
        steps: moves that were tried.
        depth: moves of the longest way to a new state.
        whole: there is no state beyond that depth.
        returned: results that calls returned, by kind.
        ways: the shortest way to each kind of result.
        unbalanced: the shortest way to a step behind which a container has no fate, or two, or a
            call another number of results than it wanted; empty where there is none.
        seconds: that it took.
    """

    states: int = 1
    steps: int = 0
    depth: int = 0
    whole: bool = False
    returned: dict[Kind, int] = field(default_factory=dict[Kind, int])
    ways: dict[Kind, list[Move]] = field(default_factory=dict[Kind, list[Move]])
    unbalanced: list[Move] = field(default_factory=list[Move])
    seconds: float = 0.0

    @property
    def worst(self) -> Kind:
        """The worst kind of result that a call returned."""
        return max(self.returned, key=KINDS.index, default="own")


def beginning(variant: Variant, kind: type[Results] = Results) -> World:
    """Return a camera that waits for a trigger, and a client in a new session."""
    client = Client(
        variant.family, bits=variant.bits, numbered=variant.number is not None, kind=kind
    )
    world = World(share(variant), client)
    if variant.preset:
        world.overtriggered = True
        world.reported |= OVERTRIGGERED
    if variant.number == "own" and variant.collides:
        ours = thaw(freeze(client)).take_number() or 0
        world.next_number = (ours - 1) % (1 << variant.bits)
    elif variant.number == "given":
        world.next_number = GIVEN_NUMBER - 1
    client.hear(world.status)
    return world


def visit(variant: Variant, kind: type[Results] = Results) -> Visited:
    """Visit every state of a variant that its bounds allow, breadth first.

    Args:
        variant: it.
        kind: of results that the client has; another one to see that its fault is found.
    """
    with time_stands_still():
        return _visit(variant, kind)


def _visit(variant: Variant, kind: type[Results]) -> Visited:
    begun, found = time.perf_counter(), Visited()
    first = beginning(variant, kind)
    seen = {first.key()}
    way: list[tuple[int, Move]] = [(-1, ())]  # of each state: the one before it, and the move
    level: list[tuple[int, bytes]] = [(0, freeze(first))]
    while level and found.depth < variant.depth:
        found.depth += 1
        following: list[tuple[int, bytes]] = []
        for place, frozen in level:
            world: World = thaw(frozen)
            moves = list(world.moves())
            found.steps += len(moves)
            for number, move in enumerate(moves):
                world = thaw(frozen) if number else world
                before, accounted = world.phase, world.client.accounted
                heard = move[0] == "hear" and world.said[move[1]][0] == "result"
                world.do(move)
                odd = world.surplus or world.client.accounted - accounted != heard
                if odd and not found.unbalanced:
                    found.unbalanced = [*_way_to(way, place), move]
                key = world.key()
                if key in seen:
                    continue
                seen.add(key)
                way.append((place, move))
                if world.phase == "ended" and before == "sent" and world.returned is not None:
                    whose = world.returned
                    found.returned[whose] = found.returned.get(whose, 0) + 1
                    if whose not in found.ways:
                        found.ways[whose] = _way_to(way, len(way) - 1)
                following.append((len(way) - 1, freeze(world)))
        level = following
    found.whole = not level
    found.states = len(seen)
    found.seconds = time.perf_counter() - begun
    return found


def _way_to(way: list[tuple[int, Move]], place: int) -> list[Move]:
    moves: list[Move] = []
    while place > 0:
        place, move = way[place]
        moves.append(move)
    return moves[::-1]


# ---------------------------------------------------------------------- the table

ALL_WIDTHS = (8, 16, 32)
UP_TO_THREE = {"results": (0, 1, 2, 3)}
SENSOR_TOO: dict[str, Any] = {"sensors": 2, "results": (0, 1, 2)}
TWO_WANTED: dict[str, Any] = {"sensors": 1, "results": (1, 2, 3), "wanted": 2}
BID: dict[str, Any] = {"family": "answer", "refuses": True}
UDP: dict[str, Any] = {"family": "nothing", "reorders": True, "exact": True, "collides": False}
EXACT: dict[str, Any] = {"exact": True, "triggers": 1, "sensors": 1}


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A row of the table: what is assumed, and what a result may be with each kind of number.

    Attributes:
        where: dialects and transport.
        what: who triggers, or what is not as assumed.
        cases: what the variants of a cell have in common with each other cell's, one or several.
        depth: moves of the short form, which finds the same.
        long: moves of the long form.
        numbers: kinds of numbers that there are.
        widths: bits of numbers of our own.
    """

    where: str
    what: str
    cases: tuple[dict[str, Any], ...]
    depth: int = 24
    long: int = 60
    numbers: tuple[Literal["own", "given"] | None, ...] = (None, "own", "given")
    widths: tuple[int, ...] = (32,)

    def variants(self, number: Literal["own", "given"] | None) -> Iterator[Variant]:
        """Return the variants of a cell."""
        widths = self.widths if number == "own" else (32,)
        for case in self.cases:
            for bits in widths:
                name = f"{self.where}; {self.what}; {number or 'no'} number"
                yield Variant(name=name, number=number, bits=bits, depth=self.long, **case)


FRAMED, BID_TCP, ANY_UDP = "`handbook`, `thesis`, `b16` over TCP", "`bid` over TCP", "UDP"
ROWS = (
    Row(
        where=FRAMED,
        what="all triggers are ours",
        widths=ALL_WIDTHS,
        cases=({"sensors": 0, **UP_TO_THREE}, {**TWO_WANTED, "sensors": 0}),
    ),
    Row(
        where=FRAMED,
        what="a sensor triggers, too",
        widths=ALL_WIDTHS,
        cases=(SENSOR_TOO, TWO_WANTED),
        depth=14,
    ),
    Row(
        where=FRAMED,
        what="and an operator stops and starts",
        widths=ALL_WIDTHS,
        cases=({"sensors": 1, "stops": 2, "results": (0, 1)},),
        depth=14,
    ),
    Row(
        where=FRAMED,
        what="a sensor triggers, and Overtriggered is set from before",
        widths=ALL_WIDTHS,
        cases=({**SENSOR_TOO, "preset": True},),
        depth=14,
    ),
    Row(
        where=BID_TCP,
        what="all triggers are ours",
        cases=({**BID, "sensors": 0, **UP_TO_THREE},),
        depth=30,
        numbers=(None,),
    ),
    Row(
        where=BID_TCP,
        what="a sensor triggers, too",
        cases=({**BID, "results": (1, 2)}, {**BID, "results": (1, 2), "preset": True}),
        depth=20,
        numbers=(None,),
    ),
    Row(
        where=BID_TCP,
        what="a sensor triggers, too, and a run may send fewer results than the call wants",
        cases=({**BID, "results": (0, 1), "triggers": 1},),
        depth=24,
        numbers=(None,),
    ),
    Row(where=ANY_UDP, what="all triggers are ours", cases=({**UDP, "sensors": 0},)),
    Row(where=ANY_UDP, what="a sensor triggers, too", cases=(UDP,), depth=6, long=9),
    Row(
        where=FRAMED,
        what="B is wrong: the status does not tell of triggers; a sensor triggers, too",
        cases=({**EXACT, "shows": False},),
        depth=9,
        long=14,
    ),
    Row(
        where=FRAMED,
        what="the same with `shows_triggers=no` in the URL",
        cases=({**EXACT, "shows": False, "family": "round trip"},),
        depth=9,
        long=14,
    ),
    Row(
        where=FRAMED,
        what="C is wrong: a result comes from an inspection that was stopped",
        cases=({"sensors": 0, "results": (0, 1, 2), "stop_voids": False},),
        depth=20,
    ),
    Row(
        where=FRAMED,
        what="D is wrong: a Query is answered before a trigger in front of it shows; a sensor "
        "triggers, too",
        cases=({**EXACT, "answers_early": True},),
        depth=12,
        long=14,
    ),
    Row(
        where=FRAMED,
        what="D is wrong: a run's results come behind the beginning of the next one; a sensor "
        "triggers, too",
        cases=({**EXACT, "in_order": False},),
        depth=13,
        long=14,
    ),
    Row(
        where=BID_TCP,
        what="I is wrong: the camera waits before all is said; a sensor triggers, too",
        cases=({**EXACT, **BID, "sends_late": True},),
        depth=16,
        long=18,
        numbers=(None,),
    ),
)

WORDS: dict[Kind | None, str] = {
    "own": "its own",
    "fresh": "its own, or somebody else's of after the call's sending",
    "older": "its own, or somebody else's, an older one included",
    None: "none: the call ends with an error",
}


def worst(variants: Iterator[Variant], depth: int | None = None) -> Iterator[Visited]:
    """Visit each variant, to another depth if one is given."""
    for variant in variants:
        yield visit(variant if depth is None else replace(variant, depth=depth))


def cell(found: Iterator[Visited]) -> str:
    """Return what a table says of what was found in a cell's variants."""
    kinds = [kind for one in found for kind in one.returned]
    return WORDS[max(kinds, key=KINDS.index, default=None)]


def table(*, short: bool) -> str:
    """Return the table as Markdown."""
    lines = [
        "| | | without a number | with `@sequence` | with a number that the user sets |",
        "| --- | --- | --- | --- | --- |",
    ]
    for row in ROWS:
        cells = [
            cell(worst(row.variants(number), row.depth if short else None))
            if number in row.numbers
            else "-"
            for number in (None, "own", "given")
        ]
        lines.append(f"| {' | '.join((row.where, row.what, *cells))} |")
    return "\n".join(lines)


def _shown(way: list[Move]) -> str:
    return ", ".join(" ".join(map(str, move)) for move in way)


def lines(*, short: bool, ways: bool, only: str = "") -> Iterator[str]:
    """Visit every variant with ``only`` in its name; return a line of figures for each."""
    head = ("states", "steps", "moves", "all", *KINDS, "seconds", "variant")
    form = "{:>9} {:>9} {:>5} {:>5} {:>6} {:>6} {:>6} {:>8}  {}"
    yield form.format(*head)
    for row in ROWS:
        if only not in f"{row.where}; {row.what}":
            continue
        for number in row.numbers:
            for variant in row.variants(number):
                found = visit(replace(variant, depth=row.depth) if short else variant)
                yield form.format(
                    *(found.states, found.steps, found.depth, "yes" if found.whole else "no"),
                    *(found.returned.get(kind, 0) for kind in KINDS),
                    f"{found.seconds:.1f}",
                    f"{variant.name}{f' of {variant.bits} bits' if number else ''}",
                )
                for kind, way in found.ways.items() if ways else ():
                    yield f"    {kind}: {_shown(way)}"
                if found.unbalanced:
                    yield f"    not balanced: {_shown(found.unbalanced)}"


def main() -> int:
    """Visit every variant and tell what was found."""
    parser = argparse.ArgumentParser(description="Visit every interleaving of each variant.")
    parser.add_argument("--table", action="store_true", help="print the table of results only")
    parser.add_argument("--short", action="store_true", help="to the depths of the short form")
    parser.add_argument("--only", default="", help="those whose names have this in them")
    parser.add_argument("--ways", action="store_true", help="the shortest way to each kind, too")
    options = parser.parse_args()
    if options.table:
        sys.stdout.write(table(short=options.short) + "\n")
        return 0
    for line in lines(short=options.short, ways=options.ways, only=options.only):
        sys.stdout.write(line + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
