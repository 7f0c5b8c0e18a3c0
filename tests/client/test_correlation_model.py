"""A container is never given to a trigger but its own: against a plain model of a camera."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, Literal, NamedTuple

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from smartcam import Status
from smartcam._client.correlation import MAX_OWED, Debt
from smartcam._client.interpretation import MAX_NUMBER
from tests.client.correlation_line import READY, WORKING, Line

STOPPED = Status(0)
SENSOR = 0
"""Whose container it is that somebody else's trigger gave; triggers of ours count from 1."""

MOVES = ["deliver", "take", "say", "sensor"]
Kind = Literal["plain", "number", "perhaps"]
"""Layout of a trigger: without a number, with one, with one that may be missing."""


class Word(NamedTuple):
    """What the client says: to the camera it travels as it is."""

    what: Literal["query", "number", "trigger", "stop", "start"]
    write: int = 0  # the trigger that it was written with
    number: int = 0


@dataclass
class Container:
    """One on its way: whose it is, and the number in it."""

    whose: int  # the trigger that began its run
    number: int | None  # in it
    # the trigger of which the camera had taken the first word and not yet the last when this run
    # began, by somebody else's trigger
    between: int | None


@dataclass
class ModelCamera:
    """Does one word after the other, one inspection at a time, and says what it does in order.

    Until the next inspection begins everything of the one before is said, its results and that the
    camera waits again in any order, and answers may stand in between.
    """

    shows: bool = True  # Waiting for Trigger drops at a trigger
    bits: int = 64  # of a container's number, which has a sign
    heard: deque[Word] = field(default_factory=deque[Word])  # words on their way to it
    # what is on its way from it
    said: deque[Status | Container | Literal["answer"]] = field(
        default_factory=deque["Status | Container | Literal['answer']"]
    )
    # what it still has to say of the last inspection
    left: list[Status | Container] = field(default_factory=list["Status | Container"])
    next_number: int = 0
    between: int | None = None
    running: bool = True

    @property
    def works(self) -> bool:
        return READY in self.left

    @property
    def status(self) -> Status:
        if not self.running:
            return STOPPED
        return WORKING if self.works and self.shows else READY

    def begin(self, whose: int, left: list[Status | None], *, numbers: bool = True) -> None:
        """Take a trigger, or drop it; a container stands in ``left`` as None."""
        if not self.running:
            return
        if self.works:
            if self.shows:
                self.said += [WORKING | Status.OVERTRIGGERED, WORKING]
            return
        self.said += self.left
        if self.shows:
            self.said.append(WORKING)
        half = 1 << (self.bits - 1)
        number = (self.next_number + half) % (2 * half) - half
        self.next_number += 1
        between = self.between if whose == SENSOR else None
        container = Container(whose, number if numbers else None, between)
        self.left = [container if one is None else one for one in left]

    def say(self) -> None:
        """Say the next of what is left."""
        if self.left:
            what = self.left.pop(0)
            if self.shows or isinstance(what, Container):
                self.said.append(what)

    def stop(self) -> None:
        """Leave run mode; the inspection under way is void."""
        if not self.works:
            self.said += self.left
        self.left.clear()
        self.running = False
        self.said.append(STOPPED)


class CameraAndClient(RuleBasedStateMachine):
    """Triggers of ours and of somebody else, losses and give-ups, in any order.

    What must hold: a container is never given to a trigger but its own. Only a run that somebody
    else has begun between the words that one trigger is written with may pass for its own.
    """

    kinds: ClassVar[tuple[Kind, ...]] = ("plain",)
    sensors = True  # somebody else triggers, too
    ordered = True
    shows = True
    highest = MAX_NUMBER
    bits = 64
    results: ClassVar[tuple[int, ...]] = (1,)  # of a run

    def __init__(self) -> None:
        super().__init__()
        self.camera = ModelCamera(shows=self.shows, bits=self.bits)
        self.line = Line(ordered=self.ordered)
        self.sent = 0
        self.lefts: dict[int, list[Status | None]] = {}  # of each trigger under way
        self.asked = False  # a Query is not answered
        self.number: int | None = None  # of the last trigger
        self.given_up: set[int] = set()

    @initialize(data=st.data())
    def connect(self, data: st.DataObject) -> None:
        """The camera may be at work for the client before; perhaps we trigger at once."""
        if self.sensors and data.draw(st.booleans(), "at work"):
            self.camera.begin(SENSOR, self.draw_left(data), numbers=self.draw_numbers(data))
            for _ in range(data.draw(st.integers(0, 3), "said")):
                self.camera.say()
        self.camera.said.clear()
        self.camera.said.append(self.camera.status)
        if data.draw(st.booleans(), "trigger at once"):
            self.move("deliver", data)
            self.trigger(data)

    def draw_left(self, data: st.DataObject) -> list[Status | None]:
        """What a run will say, in which order."""
        results = data.draw(st.sampled_from(self.results), "results")
        place = data.draw(st.integers(0, results), "place of Waiting")
        left: list[Status | None] = [None] * results
        left.insert(results - place, READY)
        return left

    def draw_numbers(self, data: st.DataObject) -> bool:
        return "perhaps" not in self.kinds or data.draw(st.booleans(), "has a number")

    # -- what the client does

    @property
    def idle(self) -> bool:
        pending = self.line.pending
        return pending is None or pending.ended or self.line.cancelled

    @precondition(lambda self: self.idle and self.line.status is not None)
    @rule(data=st.data())
    def trigger(self, data: st.DataObject) -> None:
        at = self.line.at
        self.wake()
        kind = data.draw(st.sampled_from(self.kinds), "kind")
        if at.doubted:
            self.round_trip(data)
            at.heard()
        if at.debt is not None and kind != "number":
            self.settle(data)
        if self.asked:
            self.go_on(data, lambda: not self.asked)
        if self.line.status != READY:
            return
        number, certain = None, False
        if kind != "plain":
            number, certain = at.take_number(self.highest)
        fenced = self.ordered and not (certain and kind == "number")
        self.sent += 1
        self.number = number
        self.asked = fenced
        wanted = data.draw(st.integers(1, min(self.results)), "wanted")
        self.line.send(number, wanted, fenced=fenced, certain=certain)
        self.lefts[self.sent] = self.draw_left(data)
        if fenced:
            self.camera.heard.append(Word("query", self.sent))
        if number is not None:
            self.camera.heard.append(Word("number", self.sent, number))
        self.camera.heard.append(Word("trigger", self.sent))

    @precondition(lambda self: self.sensors and self.idle and self.line.status == READY)
    @rule(said=st.integers(0, 2), data=st.data())
    def trigger_behind_a_sensor(self, said: int, data: st.DataObject) -> None:
        """Somebody else has triggered right before us, which is not heard yet."""
        while self.camera.heard:
            self.move("take", data)
        self.move("sensor", data)
        for _ in range(said):
            self.move("say", data)
        self.trigger(data)

    def wake(self) -> None:
        """The caller of the last trigger goes on."""
        self.line.leave()

    def round_trip(self, data: st.DataObject) -> None:
        """Send a Query as soon as none is open, and have it answered."""
        self.go_on(data, lambda: not self.asked)
        self.query()
        self.go_on(data, lambda: not self.asked)

    def query(self) -> None:
        self.asked = True
        self.camera.heard.append(Word("query"))

    def settle(self, data: st.DataObject) -> None:
        """What settles a debt: a moment for what is late, then Stop, a Query, Start."""
        at = self.line.at
        if data.draw(st.booleans(), "grace"):
            self.go_on(data, lambda: self.line.status == READY)
        if at.debt is None:
            return
        self.camera.heard.append(Word("stop"))
        self.go_on(data, lambda: self.line.status == STOPPED)
        self.round_trip(data)
        self.camera.heard.append(Word("start"))
        self.go_on(data, lambda: self.line.status == READY)
        at.settled()

    def go_on(self, data: st.DataObject, until: Callable[[], bool]) -> None:
        """Let things happen until something is so."""
        for _ in range(12):
            if until():
                return
            self.move(data.draw(st.sampled_from(MOVES), "next"), data)
        while not until():
            for what in MOVES[:3]:
                self.move(what, data)

    @precondition(lambda self: not self.idle)
    @rule(fate=st.sampled_from(["none", "none", "late", "cancelled"]), woken=st.booleans())
    def give_up(self, fate: Literal["none", "late", "cancelled"], *, woken: bool) -> None:
        pending = self.line.pending
        assert pending is not None
        if fate == "none":
            return
        if fate == "late":
            self.line.at.give_up(pending)
            pending.ended = True
        self.line.cancel()
        self.given_up.add(self.sent)
        if woken:
            self.wake()

    def fail(self, debt: Debt) -> None:
        pending = self.line.pending
        assert pending is not None
        self.line.at.give_up(pending, debt)
        pending.ended = True
        self.given_up.add(self.sent)

    @precondition(lambda self: self.ordered)
    @rule(really=st.integers(0, 4))
    def lose_the_link(self, really: int) -> None:
        """What is on its way is lost, in both directions."""
        if really:
            return
        if not self.idle:
            self.given_up.add(self.sent)
        else:
            self.wake()  # the next session takes longer than that
        camera = self.camera
        camera.heard.clear()
        camera.said.clear()
        camera.between, self.asked = None, False
        self.line.reconnect()
        camera.said.append(camera.status)

    # -- what happens at the camera and on the way

    @rule(moves=st.lists(st.sampled_from(MOVES), min_size=4, max_size=12), data=st.data())
    def things_happen(self, moves: list[str], data: st.DataObject) -> None:
        for what in moves:
            self.move(what, data)

    @rule(data=st.data(), ends=st.booleans())
    def all_goes_on(self, data: st.DataObject, *, ends: bool) -> None:
        """What is on its way comes; perhaps an inspection ends meanwhile."""
        camera = self.camera
        while camera.heard or camera.said or (ends and camera.left):
            for what in ("take", "say", "deliver") if ends else ("take", "deliver"):
                self.move(what, data)

    def move(self, what: str, data: st.DataObject) -> None:
        camera = self.camera
        if what == "deliver" and camera.said:
            self.hear(camera.said.popleft())
        elif what == "take" and camera.heard:
            self.take(camera.heard.popleft(), data)
        elif what == "say":
            camera.say()
        elif what == "sensor" and self.sensors:
            camera.begin(SENSOR, self.draw_left(data), numbers=self.draw_numbers(data))

    def take(self, word: Word, data: st.DataObject) -> None:
        """The camera does what the client has said."""
        camera = self.camera
        camera.between = word.write or None
        match word.what:
            case "query":
                camera.said.append("answer")
            case "number":
                camera.next_number = word.number
            case "trigger":
                camera.between = None
                numbers = self.draw_numbers(data)
                camera.begin(word.write, self.lefts.pop(word.write), numbers=numbers)
            case "stop":
                camera.stop()
            case _:
                camera.running = True
                camera.said.append(READY)

    def hear(self, what: Status | Container | Literal["answer"]) -> None:
        """Something comes to the client."""
        line = self.line
        if isinstance(what, Container):
            reads = line.numbered
            line.result(what.number if reads else None, what)
        elif what == "answer":
            self.asked = False
            line.answer()
        else:
            risen = what & ~(line.status or STOPPED)
            if not self.idle and Status.OVERTRIGGERED in risen:
                self.fail("streamed")
            line.hear(what)
        if line.wants_query and not self.asked:
            self.query()
        line.wants_query = False
        for container, verdict in line.judged:
            assert isinstance(container, Container)
            self.look_at(container, verdict.fate)
        line.judged.clear()

    # -- what must hold

    def look_at(self, container: Container, fate: str) -> None:
        if fate == "triggered":
            began = container.between if container.whose == SENSOR else container.whose
            assert began == self.sent, "a run that began before the trigger was sent"
        elif container.whose == self.sent and not self.idle:
            numbered = self.number is not None and container.number is not None
            if numbered or not self.sensors:
                mine = not numbered or container.number == self.number
                assert not mine, "the trigger's own container was not given to it"
        elif container.whose in self.given_up and self.kinds == ("number",) and not self.sensors:
            assert fate != "nobody", "a late container was not known"

    @invariant()
    def bounded(self) -> None:
        assert len(self.line.at.owed) <= MAX_OWED


class CameraAndClientAlone(CameraAndClient):
    """TCP, no numbers, all triggers ours, more results than wanted: each gets its own."""

    sensors = False
    results = (1, 2, 3)


class CameraAndClientWithSensor(CameraAndClient):
    """TCP, no numbers: anybody at any time."""


class CameraAndClientWithExtras(CameraAndClient):
    """TCP, no numbers, anybody at any time, two or three results of which some are wanted."""

    results = (2, 3)


class CameraAndClientThatShowsNothing(CameraAndClient):
    """TCP, no numbers, all triggers ours: a camera on which Waiting for Trigger never drops."""

    sensors = False
    shows = False


class CameraAndClientByNumber(CameraAndClient):
    """TCP, numbers: anybody at any time, and more results than wanted; no fence is needed."""

    kinds = ("number",)
    results = (1, 2, 3)


class CameraAndClientByNumberAlone(CameraAndClientByNumber):
    """The same, all triggers ours: what is late is known for late."""

    sensors = False


class CameraAndClientByOnesOwnNumber(CameraAndClient):
    """The user sets numbers, which may be those of somebody else's runs, and some again."""

    kinds: ClassVar[tuple[Kind, ...]] = ("number",)
    results = (1, 2)

    @rule(number=st.integers(0, 5) | st.none())
    def set_number(self, number: int | None) -> None:
        """None: the one that the camera would give to its next run."""
        number = self.camera.next_number if number is None else number
        self.line.at.give_number(number)
        self.camera.heard.append(Word("number", 0, number))


class CameraAndClientByNarrowNumber(CameraAndClient):
    """An int8: others' runs count up to the next of ours."""

    kinds = ("number",)
    highest = 127
    bits = 8
    results = (1, 2)

    @precondition(lambda self: not self.camera.works)
    @rule(short=st.integers(0, 3))
    def sensor_triggers_often(self, short: int) -> None:
        """So often that the next run, or one of those behind it, has the number of our next."""
        step = (self.highest + 1) // 64
        self.camera.next_number = (self.line.at._turn - step) % (self.highest + 1) - short


class CameraAndClientOfAllKinds(CameraAndClientByOnesOwnNumber):
    """Triggers with and without a number, and with one that may be missing in a container."""

    kinds = ("plain", "number")


class CameraAndClientByNumberThatMayBeMissing(CameraAndClientByOnesOwnNumber):
    """A number in a group, which may be empty."""

    kinds = ("plain", "perhaps")


class CameraAndClientByNumberOverUdp(CameraAndClient):
    """UDP, numbers: what the camera says is overtaken and lost, what it is told is lost."""

    kinds = ("number",)
    ordered = False
    results = (1, 2)

    @precondition(lambda self: self.camera.said)
    @rule(data=st.data())
    def overtake(self, data: st.DataObject) -> None:
        said = self.camera.said
        said.rotate(-data.draw(st.integers(0, len(said) - 1)))

    @precondition(lambda self: self.camera.said or self.camera.heard)
    @rule(said=st.booleans())
    def lose_a_datagram(self, *, said: bool) -> None:
        """A lost status would leave the client waiting for ever; a later one shows it."""
        camera = self.camera
        if said and camera.said and camera.said[0] != "answer":
            camera.said.popleft()
            camera.said.append(camera.status)
        elif not said and camera.heard and camera.heard[0].what != "query":
            camera.heard.popleft()


MACHINES: list[type[CameraAndClient]] = [
    CameraAndClientAlone,
    CameraAndClientWithSensor,
    CameraAndClientWithExtras,
    CameraAndClientThatShowsNothing,
    CameraAndClientByNumber,
    CameraAndClientByNumberAlone,
    CameraAndClientByOnesOwnNumber,
    CameraAndClientByNarrowNumber,
    CameraAndClientOfAllKinds,
    CameraAndClientByNumberThatMayBeMissing,
    CameraAndClientByNumberOverUdp,
]
for _machine in MACHINES:
    _machine.TestCase.settings = settings(stateful_step_count=100)
    globals()[_machine.__name__.replace("CameraAndClient", "Test")] = _machine.TestCase
