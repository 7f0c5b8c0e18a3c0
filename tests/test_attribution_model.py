"""A container is never given to a trigger but its own: against a plain model of a camera."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from attribution_line import READY, WORKING, Line, shown
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from smartcam import Status
from smartcam.attribution import (
    MAX_OWED,
    Debt,
)
from smartcam.interpretation import MAX_NUMBER

ONE_RESULT = [["result", "ready"], ["ready", "result"]]
TWO_RESULTS = [
    ["result", "result", "ready"],
    ["ready", "result", "result"],
    ["result", "ready", "result"],
]
SENSOR = 0
"""Whose container it is that somebody else's trigger gave; triggers of ours count from 1."""


@dataclass
class Container:
    """One on its way: whose it is, and the number in it."""

    whose: int
    number: int | None


@dataclass
class ModelCamera:
    """Does one inspection at a time and says so, in order."""

    said: deque[Status | Container] = field(default_factory=deque[Status | Container])
    working_for: int | None = None
    next_number: int = 0

    def begin(self, whose: int) -> bool:
        """Take a trigger, or drop it."""
        if self.working_for is not None:
            self.said.append(WORKING | Status.OVERTRIGGERED)
            self.said.append(WORKING)
            return False
        self.working_for = whose
        self.said.append(WORKING)
        return True

    def end(self, arrangement: list[str], *, numbers: bool) -> None:
        assert self.working_for is not None
        number, self.next_number = self.next_number, self.next_number + 1
        container = Container(self.working_for, number if numbers else None)
        self.working_for = None
        for what in arrangement:
            self.said.append(container if what == "result" else READY)


class CameraAndClient(RuleBasedStateMachine):
    """Triggers of ours and of somebody else, losses and give-ups, in any order.

    What must hold: a container is never given to a trigger but its own.
    """

    numbered = False
    crossing = False  # somebody else may trigger while ours is on its way
    ordered = True
    highest = MAX_NUMBER
    arrangements = ONE_RESULT
    link_is_lost = True

    def __init__(self) -> None:
        super().__init__()
        self.camera = ModelCamera()
        self.line = shown() if not self.link_is_lost else Line(ordered=self.ordered)
        self.sent = 0
        self.given_up: set[int] = set()
        self.hear(READY)

    # -- what the client does

    def hear(self, status: Status) -> None:
        pending = self.line.pending
        risen = status & ~(self.line.status or Status(0))
        if pending is not None and Status.OVERTRIGGERED in risen:
            self.give_up("streamed")
        self.line.hear(status)

    def give_up(self, debt: Debt) -> None:
        self.given_up.add(self.sent)
        self.line.give_up(debt)

    @property
    def idle(self) -> bool:
        return self.line.pending is None

    @property
    def quiet(self) -> bool:
        """Nothing is on its way and nobody works: what the client knows is what is."""
        return not self.camera.said and self.camera.working_for is None

    @property
    def may_trigger(self) -> bool:
        """The camera waits for all the client knows; without crossing it knows what is."""
        news = self.camera.working_for is not None or WORKING in self.camera.said
        return self.idle and self.line.status == READY and (self.crossing or not news)

    @precondition(lambda self: self.may_trigger)
    @rule()
    def trigger(self) -> None:
        at = self.line.at
        if not self.numbered:
            if at.debt is not None:
                self.stop_and_start()
            while at.unsettled and self.ordered:
                at.unsettled = False
                self.deliver_all()
        if not self.may_trigger:
            return
        number = at.take_number(self.highest) if self.numbered else None
        self.sent += 1
        self.line.trigger(number)
        if number is not None:
            self.camera.next_number = number
        self.camera.begin(self.sent)

    def stop_and_start(self) -> None:
        """What settles a debt: Stop voids the inspection, the fence hears the rest, Start."""
        self.camera.working_for = None
        self.camera.said.append(Status(0))
        self.deliver_all()
        self.camera.said.append(READY)
        self.deliver_all()
        self.line.at.settled()

    @precondition(lambda self: not self.idle)
    @rule(really=st.booleans())
    def time_out(self, *, really: bool) -> None:
        if really:
            self.give_up("late")

    @rule(really=st.integers(0, 4))
    def lose_the_link(self, really: int) -> None:
        if really or not self.link_is_lost:
            return
        if not self.idle:
            self.given_up.add(self.sent)
        self.camera.said.clear()
        self.line.reconnect()
        self.line.hear(WORKING if self.camera.working_for is not None else READY)

    # -- what the camera does

    @precondition(lambda self: self.crossing or (self.idle and self.quiet))
    @rule()
    def sensor(self) -> None:
        self.camera.begin(SENSOR)

    @precondition(lambda self: self.camera.working_for is not None)
    @rule(data=st.data())
    def inspection_ends(self, data: st.DataObject) -> None:
        self.camera.end(data.draw(st.sampled_from(self.arrangements)), numbers=self.numbered)

    # -- what comes

    @precondition(lambda self: self.camera.said)
    @rule(data=st.data())
    def deliver(self, data: st.DataObject) -> None:
        said = self.camera.said
        if not self.ordered:
            said.rotate(-data.draw(st.integers(0, len(said) - 1)))
        self.take(said.popleft())

    def deliver_all(self) -> None:
        while self.camera.said:
            self.take(self.camera.said.popleft())

    def take(self, what: Status | Container) -> None:
        if isinstance(what, Status):
            self.hear(what)
            return
        fate = self.line.result(what.number).fate
        if fate == "triggered":
            assert not self.idle
            assert what.whose == self.sent, "somebody else's container"
            self.line.leave()
        elif what.whose != SENSOR and what.whose == self.sent and not self.idle:
            assert not self.numbered, "the trigger's own container was not given to it"
        elif self.numbered and what.whose in self.given_up:
            assert fate != "nobody", "a late container was not known"
            self.given_up.discard(what.whose)  # more of the same trigger are streamed

    @invariant()
    def bounded(self) -> None:
        assert len(self.line.at._owed) <= MAX_OWED


class CameraAndClientByOrder(CameraAndClient):
    """TCP, no numbers: others do not trigger while a trigger of ours is on its way."""


class CameraAndClientWithExtras(CameraAndClient):
    """TCP, no numbers, two results for a trigger of which one is wanted.

    The camera was seen to drop Waiting for Trigger in this session: that is what keeps them apart.
    """

    arrangements = ONE_RESULT + TWO_RESULTS
    link_is_lost = False


class CameraAndClientByNumber(CameraAndClient):
    """TCP, numbers: anybody at any time, and more results than wanted."""

    numbered = True
    arrangements = ONE_RESULT + TWO_RESULTS
    crossing = True


class CameraAndClientByNumberOverUdp(CameraAndClient):
    """UDP, numbers: messages overtake each other and are lost."""

    numbered = True
    ordered = False

    @precondition(lambda self: self.camera.said)
    @rule(data=st.data())
    def lose_a_datagram(self, data: st.DataObject) -> None:
        self.camera.said.rotate(-data.draw(st.integers(0, len(self.camera.said) - 1)))
        self.camera.said.popleft()

    @precondition(lambda self: self.quiet)
    @rule()
    def tell_the_status(self) -> None:
        """A lost status would leave the client waiting for ever; the next change shows it."""
        self.camera.said.append(READY)


class CameraAndClientByNarrowNumber(CameraAndClientByNumber):
    """An int8: others' runs, which count on from ours, stay below its step."""

    highest = 127

    @precondition(lambda self: self.idle and self.quiet)
    @rule()
    def sensor(self) -> None:
        if self.camera.next_number % 2:
            self.camera.begin(SENSOR)


TestByOrder = CameraAndClientByOrder.TestCase
TestWithExtras = CameraAndClientWithExtras.TestCase
TestByNumber = CameraAndClientByNumber.TestCase
TestByNumberOverUdp = CameraAndClientByNumberOverUdp.TestCase
TestByNarrowNumber = CameraAndClientByNarrowNumber.TestCase

for case in (TestByOrder, TestWithExtras, TestByNumber, TestByNumberOverUdp, TestByNarrowNumber):
    case.settings = settings(stateful_step_count=100)
