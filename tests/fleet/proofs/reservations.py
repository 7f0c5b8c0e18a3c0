"""Every interleaving of two programs, agents that come and go, and messages: is a block kept?

A plain model of a fleet with one camera. Programs reserve it, command it inside and outside of a
block, and give up at any moment. What they say is on its way for any time, overtakes, arrives
twice, or never, which is a message that stays on its way. Agents die and are started again, take
the camera over while the other one lives, and take a living program for gone. What decides is the
library's own: :class:`~smartcam.fleet._agent.gate.Gate`, the agent's
:class:`~smartcam.fleet._agent.agent.CallNumbers`, and the program's
:class:`~smartcam.fleet._program.caller.Caller` with its leases.

The camera does what it is told by the agent whose session is the newest. Wrong is

* ``between``: a block ends without an error, and another program's command was done in it;
* ``behind``: a command of a block is done after another program's command in this block;
* ``twice``: a call is done twice.

``python -m tests.fleet.proofs.reservations`` visits each variant and prints what was found.
"""

from __future__ import annotations

import argparse
import pickle
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

from smartcam.exceptions import ReservationLostError
from tests.fleet.inside import Caller, CallNumbers, CameraAgent, Gate, GateRequest, Lease

Move = tuple[Any, ...]
Wrong = Literal["between", "behind", "twice"]
ONE, OTHER = "one", "other"


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """Events that may happen, and their number.

    Attributes:
        name: for people.
        blocks, commands, plain: blocks of each program, commands in a block, and commands outside.
        starts: agents that are started, the first one included.
        standby: an agent takes the camera over while the other one may live; else it has the same
            name, and starts when that one is dead.
        deaths, forgotten, cuts, doubles, again: how often an agent dies, takes a program for gone,
            a program takes a living agent for gone, a message arrives twice, an agent takes the
            camera back.
        depth: moves from the beginning.
        fenced: an agent refuses commands whose reservation it does not know.
        confirmed: a block ends with the agent's word that the reservation stands.
        asks: an agent that may have lost the camera unseen asks it before it says so.
        only_with_a_session: an agent that has lost the camera reserves nothing.
        once: an agent does a call once.
    """

    name: str
    blocks: dict[str, int] = field(default_factory=lambda: {ONE: 1, OTHER: 0})
    commands: int = 1
    plain: dict[str, int] = field(default_factory=lambda: {ONE: 0, OTHER: 1})
    starts: int = 1
    standby: bool = False
    deaths: int = 0
    forgotten: int = 0
    cuts: int = 0
    doubles: int = 0
    again: int = 0
    depth: int = 40
    fenced: bool = True
    confirmed: bool = True
    asks: bool = True
    only_with_a_session: bool = True
    once: bool = True


@dataclass(slots=True)
class Task:
    """A call under way at an agent."""

    reservation: int | None
    line: GateRequest


@dataclass(slots=True)
class Agent:
    """A start of an agent; it knows programs that have said hello."""

    epoch: int
    gate: Gate = field(default_factory=Gate)
    guests: dict[str, CallNumbers] = field(default_factory=dict[str, CallNumbers])
    gone: dict[str, int] = field(default_factory=dict[str, int])
    tasks: dict[tuple[str, int], Task] = field(default_factory=dict[tuple[str, int], Task])
    has: bool = True  # as far as it knows, the camera


@dataclass(slots=True)
class Program:
    """A program with one task; ``waits`` is the call that it waits for."""

    name: str
    blocks: int
    plain: int
    met: int | None = None
    calls: int = 0
    phase: str = "idle"
    waits: int = 0
    commands: int = 0
    leases: dict[int, Lease] = field(default_factory=dict[int, Lease])
    intruded: bool = False  # another program's command was done in its block


_CALLER = Caller("cam", "cam", None, None, lambda _: None, lambda _: None)  # type: ignore[arg-type]


def caller(program: Program) -> Caller:
    """Return the library's side of a program."""
    _CALLER.leases = program.leases
    _CALLER.agent = None if program.met is None else CameraAgent("agent", program.met, {})
    return _CALLER


@dataclass(slots=True)
class World:
    """Programs, agents, a camera, and what is on its way between them."""

    variant: Variant
    programs: dict[str, Program]
    agents: dict[int, Agent] = field(default_factory=lambda: {1: Agent(1)})
    camera: int = 1  # the epoch of the agent that it serves
    starts: int = 1
    deaths: int = 0
    forgotten: int = 0
    cuts: int = 0
    doubles: int = 0
    again: int = 0
    away: set[Move] = field(default_factory=set[Move])
    done: set[tuple[str, int]] = field(default_factory=set[tuple[str, int]])
    kept: int = 0  # blocks that ended without an error
    told: int = 0  # and with one
    wrong: set[Wrong] = field(default_factory=set[Wrong])

    # ------------------------------------------------------------------ what may happen next

    def moves(self) -> Iterator[Move]:
        """Return all that may happen next."""
        variant = self.variant
        for name, one in self.programs.items():
            yield from self._moves_of(name, one)
        for said in self.away:
            yield ("hear", said)
            if said[0] == "call" and self.doubles < variant.doubles:
                yield ("hear twice", said)
        for epoch, agent in self.agents.items():
            for key, task in agent.tasks.items():
                yield ("do" if task.line.granted else "refuse", epoch, key)
            if self.forgotten < variant.forgotten:
                for name in agent.guests:
                    yield ("forget", epoch, name)
            if agent.has and self.camera != epoch:
                yield ("notice", epoch)
            if not agent.has and self.again < variant.again:
                yield ("take", epoch)
            if self.deaths < variant.deaths:
                yield ("die", epoch)
        if self.starts < variant.starts and (variant.standby or not self.agents):
            yield ("start",)

    def _moves_of(self, name: str, one: Program) -> Iterator[Move]:
        if one.waits:
            yield ("give up", name)
        elif one.phase == "body":
            yield ("end", name)
        if one.met is None:
            for epoch in self.agents:
                yield ("meet", name, epoch)
            return
        if one.met not in self.agents or self.cuts < self.variant.cuts:
            yield ("lose", name)
        if one.waits:
            return
        if one.phase == "idle":
            if one.blocks:
                yield ("reserve", name)
            if one.plain:
                yield ("plain", name)
        elif one.commands < self.variant.commands:
            yield ("command", name)

    def do(self, move: Move) -> None:
        """Have one of them happen."""
        what, *rest = move
        getattr(self, f"_{what.replace(' ', '_')}")(*rest)

    # ------------------------------------------------------------------ programs

    def _say(self, one: Program, do: str, about: int | None = None) -> int:
        """Call the agent that was met; return the number."""
        one.calls += 1
        self.away.add(("call", one.met, one.name, one.calls, do, about))
        return one.calls

    def _expect(self, one: Program, call: int, phase: str) -> None:
        self.away -= {said for said in self.away if said[0] == "reply" and said[2] == one.name}
        one.waits, one.phase = call, phase

    def _reserve(self, name: str) -> None:
        one = self.programs[name]
        one.blocks -= 1
        self._expect(one, self._say(one, "reserve"), "reserving")

    def _plain(self, name: str) -> None:
        one = self.programs[name]
        one.plain -= 1
        self._expect(one, self._say(one, "command"), "outside")

    def _command(self, name: str) -> None:
        one = self.programs[name]
        one.commands += 1
        try:
            fence = caller(one)._reservation_of("trigger")
        except ReservationLostError:
            return
        self._expect(one, self._say(one, "command", fence), "commanding")

    def _end(self, name: str) -> None:
        one = self.programs[name]
        (reservation,) = one.leases
        if not self.variant.confirmed:
            self._leave(one, kept=not one.leases[reservation].lost)
        elif one.met is None or not self._stands(one):
            self._leave(one, kept=False)
        else:
            self._expect(one, self._say(one, "reserved", reservation), "ending")

    def _stands(self, one: Program) -> bool:
        (reservation,) = one.leases
        try:
            caller(one).require_lease(reservation)
        except ReservationLostError:
            return False
        return True

    def _leave(self, one: Program, *, kept: bool) -> None:
        """End a block."""
        ((reservation, _),) = one.leases.items()
        one.leases.clear()
        if one.met is not None:
            self._say(one, "release", reservation)
        self._expect(one, 0, "idle")
        self.kept += kept
        self.told += not kept
        if kept and one.intruded:
            self.wrong.add("between")
        one.intruded = False

    def _give_up(self, name: str) -> None:
        one = self.programs[name]
        call, phase = one.waits, one.phase
        if phase == "ending":
            self._leave(one, kept=False)
            return
        if one.met is not None:
            self._say(one, "cancel", call)
        self._expect(one, 0, "body" if phase == "commanding" else "idle")

    def _meet(self, name: str, epoch: int) -> None:
        """Say hello, and have the answer."""
        one, agent = self.programs[name], self.agents[epoch]
        one.met = epoch
        one.calls += 1
        if name not in agent.guests:
            agent.guests[name] = CallNumbers(agent.gone.get(name, 0))

    def _lose(self, name: str) -> None:
        """See that the agent is gone: what was under way ends."""
        one = self.programs[name]
        self.cuts += one.met in self.agents
        one.met = None
        if one.waits:
            self._hear_reply(one, "gone")

    def _hear_reply(self, one: Program, answer: str, epoch: int = 0) -> None:
        call, phase = one.waits, one.phase
        if answer == "stranger":
            one.met = None
        if phase == "ending":
            self._leave(one, kept=answer == "yes" and self._stands(one))
            return
        if phase == "reserving" and answer == "yes":
            one.leases[call], one.commands = Lease(epoch), 0
        elif phase == "commanding" and answer in {"stranger", "lost"}:
            next(iter(one.leases.values())).lost = answer
        self._expect(one, 0, "body" if one.leases else "idle")

    # ------------------------------------------------------------------ the network

    def _hear_twice(self, said: Move) -> None:
        self.doubles += 1
        self._hear(said)
        self.away.add(said)

    def _hear(self, said: Move) -> None:
        self.away.discard(said)
        if said[0] == "reply":
            _, epoch, name, call, answer = said
            one = self.programs[name]
            if one.waits == call:
                self._hear_reply(one, answer, epoch)
            return
        _, epoch, name, call, do, about = said
        if self.variant.standby:
            agent = self.agents.get(epoch)
        else:  # each start has the same name
            agent = next(iter(self.agents.values()), None)
        if agent is not None:
            self._hear_call(agent, epoch, name, call, do, about)

    # ------------------------------------------------------------------ agents

    def _hear_call(
        self, agent: Agent, epoch: int, name: str, call: int, do: str, about: int | None
    ) -> None:
        guest = agent.guests.get(name)
        if do == "cancel":
            if guest is not None and about is not None:
                guest.add_if_new(about)
                task = agent.tasks.pop((name, about), None)
                if task is not None:
                    agent.gate.withdraw_request(task.line)
                agent.gate.release((name, about))
        elif guest is None or epoch != agent.epoch:
            self._reply(agent, name, call, "stranger")
        elif not guest.add_if_new(call) and self.variant.once:
            return
        elif do == "reserved":
            sure = agent.epoch == self.camera or not self.variant.asks
            stands = agent.gate.holds((name, about)) and agent.has and sure
            self._reply(agent, name, call, "yes" if stands else "no")
        elif do == "release":
            agent.gate.release((name, about))
        elif about is not None and self.variant.fenced and not agent.gate.holds((name, about)):
            self._reply(agent, name, call, "lost")
        else:
            key = (name, call) if do == "reserve" else None
            agent.tasks[name, call] = Task(about, agent.gate.add_request(name, key))
        self._settle(agent)

    def _settle(self, agent: Agent) -> None:
        """Tell who has reserved the camera by now."""
        for (name, call), task in [*agent.tasks.items()]:
            if task.line.granted and task.line.reservation is not None:
                del agent.tasks[name, call]
                if agent.has or not self.variant.only_with_a_session:
                    self._reply(agent, name, call, "yes")
                else:
                    agent.gate.release((name, call))
                    self._reply(agent, name, call, "no")
                    self._settle(agent)
                    return

    def _reply(self, agent: Agent, name: str, call: int, answer: str) -> None:
        if self.programs[name].waits == call:
            self.away.add(("reply", agent.epoch, name, call, answer))

    def _do(self, epoch: int, key: tuple[str, int]) -> None:
        """Have the camera do a command, if it still serves this agent."""
        agent = self.agents[epoch]
        task = agent.tasks.pop(key)
        name, call = key
        if self.camera == epoch:
            if key in self.done:
                self.wrong.add("twice")
            self.done.add(key)
            own = self.programs[name]
            if own.intruded and task.reservation in own.leases:
                self.wrong.add("behind")
            for other in self.programs.values():
                if other is not own and other.phase in {"body", "commanding"}:
                    other.intruded = True
        agent.gate.leave(name)
        self._reply(agent, name, call, "yes" if self.camera == epoch else "no")
        self._settle(agent)

    def _refuse(self, epoch: int, key: tuple[str, int]) -> None:
        """Have somebody wait no longer."""
        agent = self.agents[epoch]
        agent.gate.withdraw_request(agent.tasks.pop(key).line)
        self._reply(agent, *key, "no")
        self._settle(agent)

    def _forget(self, epoch: int, name: str) -> None:
        """Take a program for gone."""
        agent = self.agents[epoch]
        self.forgotten += 1
        agent.gone[name] = agent.guests.pop(name).last_call
        for key in [key for key in agent.tasks if key[0] == name]:
            agent.gate.withdraw_request(agent.tasks.pop(key).line)
        agent.gate.lose_program(name)
        self._settle(agent)

    def _notice(self, epoch: int) -> None:
        """See that the session with the camera is over: commands under way end with it."""
        agent = self.agents[epoch]
        agent.has = False
        for key in [key for key, task in agent.tasks.items() if task.line.granted]:
            self._refuse(epoch, key)
        if agent.gate.holder is not None:
            agent.gate.lose_program(agent.gate.holder)
        self._settle(agent)

    def _take(self, epoch: int) -> None:
        self.again += 1
        self.agents[epoch].has, self.camera = True, epoch

    def _die(self, epoch: int) -> None:
        self.deaths += 1
        del self.agents[epoch]
        if self.camera == epoch:
            self.camera = 0

    def _start(self) -> None:
        self.starts += 1
        self.agents[self.starts], self.camera = Agent(self.starts), self.starts

    # ------------------------------------------------------------------ states

    def key(self) -> object:
        """Return what tells this state from others."""
        programs = tuple(
            (
                *(one.blocks, one.plain, one.met, one.calls, one.phase, one.waits, one.commands),
                *(tuple((n, a.epoch, a.lost) for n, a in one.leases.items()), one.intruded),
            )
            for one in self.programs.values()
        )
        agents = tuple(
            (
                *(epoch, agent.has, agent.gate.holder, frozenset(agent.gate._reservations)),
                tuple((line.program, line.reservation) for line in agent.gate._queue),
                tuple(
                    (n, g.floor, frozenset(g._known_calls)) for n, g in sorted(agent.guests.items())
                ),
                tuple(sorted(agent.gone.items())),
                frozenset((k, t.reservation, t.line.granted) for k, t in agent.tasks.items()),
            )
            for epoch, agent in self.agents.items()
        )
        counts = (self.camera, self.starts, self.deaths, self.forgotten, self.cuts)
        more = (self.doubles, self.again)
        return programs, agents, counts, more, frozenset(self.away), frozenset(self.done)


@dataclass(slots=True)
class Visited:
    """The findings of a variant.

    Attributes:
        states, steps: that were visited, and moves that were tried.
        depth: moves of the longest way to a new state.
        whole: there is no state beyond that depth.
        kept, told: ends of blocks without an error, and with one.
        ways: the shortest way to each thing that is wrong.
        seconds: that it took.
    """

    states: int = 1
    steps: int = 0
    depth: int = 0
    whole: bool = False
    kept: int = 0
    told: int = 0
    ways: dict[Wrong, list[Move]] = field(default_factory=dict[Wrong, list[Move]])
    seconds: float = 0.0


def beginning(variant: Variant) -> World:
    """Return a fleet whose programs have met the agent."""
    names = (ONE, OTHER)
    programs = {name: Program(name, variant.blocks[name], variant.plain[name]) for name in names}
    world = World(variant, programs)
    for name in names:
        world.do(("meet", name, 1))
    return world


def visit(variant: Variant) -> Visited:
    """Visit every state of a variant, breadth first; what is wrong is followed no further."""
    begun, found = time.perf_counter(), Visited()
    first = beginning(variant)
    seen = {first.key()}
    way: list[tuple[int, Move]] = [(-1, ())]
    level = [(0, pickle.dumps(first, 5))]
    while level and found.depth < variant.depth:
        found.depth += 1
        following: list[tuple[int, bytes]] = []
        for place, frozen in level:
            moves = list(pickle.loads(frozen).moves())  # noqa: S301 - made above
            found.steps += len(moves)
            for move in moves:
                world: World = pickle.loads(frozen)  # noqa: S301 - made above
                kept, told = world.kept, world.told
                world.do(move)
                found.kept += world.kept - kept
                found.told += world.told - told
                if world.wrong:
                    for wrong in world.wrong:
                        found.ways.setdefault(wrong, [*_way_to(way, place), move])
                    continue
                key = world.key()
                if key in seen:
                    continue
                seen.add(key)
                way.append((place, move))
                following.append((len(way) - 1, pickle.dumps(world, 5)))
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


BOTH: dict[str, Any] = {"blocks": {ONE: 1, OTHER: 1}, "plain": {ONE: 0, OTHER: 0}}
TAKES_OVER: dict[str, Any] = {"starts": 2, "standby": True}
VARIANTS = (
    Variant(name="one agent"),
    Variant(name="messages come twice", doubles=1),
    Variant(name="a program is taken for gone", forgotten=1),
    Variant(name="and takes the agent for gone", forgotten=1, cuts=1, depth=18),
    Variant(name="two commands each", commands=2, plain={ONE: 0, OTHER: 2}, depth=22),
    Variant(name="both reserve, one is taken for gone", **BOTH, forgotten=1, depth=20),
    Variant(name="the agent is started again", starts=2, deaths=1),
    Variant(name="another agent takes over", **TAKES_OVER, cuts=1, depth=18),
    Variant(name="and the first one takes it back", **TAKES_OVER, cuts=1, again=1, depth=15),
    Variant(name="and agents die", **TAKES_OVER, cuts=1, deaths=1, depth=14),
    Variant(name="both reserve, another agent takes over", **BOTH, **TAKES_OVER, cuts=1, depth=14),
)
"""Variants visited in the long form, all of each or up to a depth."""


def main() -> int:
    """Visit every variant and tell what was found."""
    argparse.ArgumentParser(description="Visit every interleaving of reservations.").parse_args()
    form = "{:>9} {:>9} {:>5} {:>5} {:>7} {:>7} {:>8}  {}\n"
    head = ("states", "steps", "moves", "all", "kept", "told", "seconds", "variant")
    sys.stdout.write(form.format(*head))
    for variant in VARIANTS:
        found = visit(variant)
        sys.stdout.write(
            form.format(
                *(found.states, found.steps, found.depth, "yes" if found.whole else "no"),
                *(found.kept, found.told, f"{found.seconds:.1f}", variant.name),
            )
        )
        for wrong, way in found.ways.items():
            sys.stdout.write(f"    {wrong}: {way}\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
