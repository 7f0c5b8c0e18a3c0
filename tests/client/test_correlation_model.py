"""A trigger is never given a result but its own: against a plain model of a camera."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, Literal, NamedTuple

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from smartcam import Status
from tests.client.correlation_line import READY, WORKING, Line

MAX_NUMBER = 2_147_483_647
MAX_OWED = 1 << 10


STOPPED = Status(0)
SENSOR = 0
"""Owner of a container that somebody else's trigger gave; triggers of ours count from 1."""

MAX_MOVES = 1000
"""After which nothing will be as it is awaited."""

Kind = Literal["plain", "number", "perhaps"]
"""Layout of a trigger: without a number, with one, with one that may be missing."""


class Word(NamedTuple):
    """A message of the client."""

    what: Literal["query", "status", "number", "trigger", "reset", "stop", "start"]
    whose: int = 0  # the trigger that it was written with
    number: int = 0


@dataclass
class Container:
    """One on its way: whose it is, and the number in it."""

    whose: int  # the trigger that began its run
    number: int | None
    # the trigger of which the camera had taken a word last when somebody else began this run
    behind: int | None


Said = Status | Container | Literal["answer", "taken", "refused"]
"""A message on its way to the client; an answer to a Query, or to a trigger."""


@dataclass
class ModelCamera:
    """Does one word after the other, one inspection at a time, and says what it does in order.

    Until the next inspection begins everything of the one before is said, its results and that the
    camera waits again in any order, and answers may stand in between.
    """

    shows: bool = True  # Waiting for Trigger drops at a trigger
    late: bool = False  # but behind the next answer only, at a trigger of ours
    polled: bool = False  # it says its status only when it is asked for it, and answers a trigger
    latches: bool = False  # Overtriggered stays for a while, or until it is reset
    refuses: bool = False  # it answers a trigger that it drops by another code
    bits: int = 64  # of a container's number, which has a sign
    heard: deque[Word] = field(default_factory=deque[Word])  # words on their way to it
    said: deque[Said] = field(default_factory=deque[Said])  # what is on its way from it
    # what it still has to say of the last inspection
    left: list[Status | Container] = field(default_factory=list["Status | Container"])
    next_number: int = 0
    running: bool = True
    overtriggered: bool = False
    untold: bool = False  # that an inspection has begun
    behind: int | None = None  # the trigger of which a word was taken last

    @property
    def works(self) -> bool:
        return READY in self.left

    @property
    def status(self) -> Status:
        """As it says it."""
        status = STOPPED
        if self.running:
            status = WORKING if self.works and self.shows else READY
        return status | Status.OVERTRIGGERED if self.overtriggered else status

    def tell_status(self) -> None:
        """Say it where that is done without a question."""
        if not self.polled:
            self.said.append(self.status)

    def begin(self, whose: int, left: list[Status | None], *, numbers: bool = True) -> None:
        """Take a trigger, or drop it; a container stands in ``left`` as None."""
        if not self.running:
            return
        if self.works:
            self.drop()
            return
        while self.left:
            self.say()
        half = 1 << (self.bits - 1)
        number = (self.next_number + half) % (2 * half) - half
        self.next_number += 1
        behind = self.behind if whose == SENSOR else None
        container = Container(whose, number if numbers else None, behind)
        self.left = [container if one is None else one for one in left]
        self.untold = True
        if whose == SENSOR or not self.late:
            self.tell_beginning()

    def tell_beginning(self) -> None:
        if self.untold:
            self.untold = False
            self.tell_status()

    def drop(self) -> None:
        """Overtriggered rises where it is not set."""
        self.tell_beginning()
        if not self.overtriggered:
            self.overtriggered = True
            self.tell_status()
        if not self.latches:
            self.calm()

    def calm(self) -> None:
        """Overtriggered falls."""
        if self.overtriggered:
            self.overtriggered = False
            self.tell_status()

    def say(self) -> None:
        """Say the next of what is left."""
        if not self.left:
            return
        self.tell_beginning()
        what = self.left.pop(0)
        if isinstance(what, Container):
            self.said.append(what)
        else:
            self.tell_status()

    def stop(self) -> None:
        """Leave run mode; the inspection under way is void."""
        while self.left and not self.works:
            self.say()
        self.left.clear()
        self.running = False
        self.tell_status()

    def start(self) -> None:
        self.running = True
        self.tell_status()


class CameraAndClient(RuleBasedStateMachine):
    """Triggers of ours and of somebody else, losses and give-ups, in any order.

    What must hold: a trigger is never given a container but its own, and is given that one unless
    it has ended before.
    """

    kinds: ClassVar[tuple[Kind, ...]] = ("plain",)
    moves: ClassVar[tuple[str, ...]] = ("deliver", "take", "say", "calm", "sensor")
    ordered = True
    shows = True
    late = False
    highest = MAX_NUMBER
    bits = 64
    results: ClassVar[tuple[int, ...]] = (1,)  # of a run

    def __init__(self) -> None:
        super().__init__()
        self.camera = ModelCamera(shows=self.shows, late=self.late, bits=self.bits)
        self.line = Line(gets_every_status=self.ordered)
        self.sent = 0
        self.lefts: dict[int, list[Status | None]] = {}  # of each trigger under way
        self.taken: set[int] = set()  # triggers that the camera took
        self.asked = False  # a Query that was written with no trigger is not answered
        self.number: int | None = None  # of the last trigger
        self.given_up: set[int] = set()

    @property
    def sensors(self) -> bool:
        """Somebody else triggers, too."""
        return "sensor" in self.moves

    @property
    def gives(self) -> bool:
        """A trigger gets its result from such a camera."""
        return self.shows or self.line.is_by_round_trip

    @initialize(data=st.data())
    def connect(self, data: st.DataObject) -> None:
        """The camera may be at work for the client before; perhaps we trigger at once."""
        self.camera.latches = data.draw(st.booleans(), "latches")
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
        """Return the messages that a run will say, in their order."""
        results = data.draw(st.sampled_from(self.results), "results")
        place = 0 if self.camera.polled else data.draw(st.integers(0, results), "place of Waiting")
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

    @property
    def owes(self) -> bool:
        """True if an answer to a Query is open."""
        return self.asked or self.line.open_queries > 0

    def say_to_camera(self, *words: Word) -> None:
        self.camera.heard += words

    @precondition(lambda self: self.idle and self.line.status is not None)
    @rule(data=st.data())
    def trigger(self, data: st.DataObject) -> None:
        at = self.line.at
        self.wake()
        kind = data.draw(st.sampled_from(self.kinds), "kind")
        if at.status_may_be_old:
            self.round_trip(data)
            at.note_query_answered()
        if at.owed_fate is not None and kind != "number":
            self.settle(data)
        self.go_on(data, lambda: not self.owes)
        if self.line.status != READY:
            return
        number = None if kind == "plain" else at.take_number(self.highest)
        self.write(data, number)

    def write(self, data: st.DataObject, number: int | None = None) -> None:
        """Write a trigger with all that goes with it."""
        self.sent += 1
        self.number = number
        self.lefts[self.sent] = self.draw_left(data)
        self.line.send(number, data.draw(st.integers(1, min(self.results)), "wanted"))
        queries = self.line.open_queries
        if queries:
            self.say_to_camera(Word("query", self.sent))
        if number is not None:
            self.say_to_camera(Word("number", self.sent, number))
        self.say_to_camera(Word("trigger", self.sent))
        if queries > 1:
            self.say_to_camera(Word("query", self.sent))

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
        self.go_on(data, lambda: not self.owes)
        self.asked = True
        self.say_to_camera(Word("query"))
        self.go_on(data, lambda: not self.owes)

    def settle(self, data: st.DataObject) -> None:
        """Settle a debt: wait a moment for the late result, then Stop, a Query, Start."""
        at = self.line.at
        if data.draw(st.booleans(), "grace"):
            self.go_on(data, lambda: self.line.status == READY, give_up=True)
        if at.owed_fate is None:
            return
        self.say_to_camera(Word("stop"))
        self.go_on(data, lambda: Status.RUNNING not in (self.line.status or STOPPED))
        self.round_trip(data)
        self.say_to_camera(Word("start"))
        self.go_on(data, lambda: self.line.status == READY, give_up=True)
        if self.line.status == READY:  # nobody has stopped it meanwhile
            at.forget_owed()

    def go_on(
        self, data: st.DataObject, until: Callable[[], bool], *, give_up: bool = False
    ) -> None:
        """Let things happen until something is so, or until it is clear that it will not be."""
        for _ in range(12):
            if until():
                return
            self.move(data.draw(st.sampled_from(self.moves), "next"), data)
        for _ in range(MAX_MOVES):
            if until() or (give_up and self.camera_is_silent):
                return
            for what in ("deliver", "take", "say", "calm"):
                self.move(what, data)
        raise AssertionError("it does not go on")

    @property
    def camera_is_silent(self) -> bool:
        """Nothing comes of it any more by itself."""
        camera = self.camera
        return not (camera.said or camera.heard or camera.left or camera.overtriggered)

    @precondition(lambda self: not self.idle)
    @rule(fate=st.sampled_from(["none", "none", "late", "cancelled"]), woken=st.booleans())
    def give_up(self, fate: Literal["none", "late", "cancelled"], *, woken: bool) -> None:
        if fate == "none":
            return
        self.note_given_up()
        if fate == "late":
            self.line.fail("late")
        self.line.cancel()
        if woken:
            self.wake()

    def note_given_up(self) -> None:
        """Its results are late from now on, unless it has all that it wants already."""
        pending = self.line.pending
        assert pending is not None
        if pending.received < pending.wanted:
            self.given_up.add(self.sent)

    @precondition(lambda self: self.ordered)
    @rule(really=st.integers(0, 4))
    def lose_the_link(self, really: int) -> None:
        """Lose all that is on its way, in both directions."""
        if really:
            return
        if not self.idle:
            self.note_given_up()
        else:
            self.wake()  # the next session takes longer than that
        camera = self.camera
        camera.heard.clear()
        camera.said.clear()
        camera.behind, self.asked = None, False
        self.line.reconnect()
        camera.said.append(camera.status)

    # -- what happens at the camera and on the way

    @rule(data=st.data())
    def things_happen(self, data: st.DataObject) -> None:
        moves = st.lists(st.sampled_from(self.moves), min_size=4, max_size=12)
        for what in data.draw(moves, "moves"):
            self.move(what, data)

    @rule(data=st.data(), ends=st.booleans())
    def all_goes_on(self, data: st.DataObject, *, ends: bool) -> None:
        """Deliver what is on its way; perhaps an inspection ends meanwhile."""
        camera = self.camera
        while camera.heard or camera.said or (ends and camera.left):
            for what in ("take", "say", "deliver") if ends else ("take", "deliver"):
                self.move(what, data)
        if ends and self.ordered and self.gives and not self.idle:
            assert self.sent not in self.taken, "its result came, and it still waits"

    def move(self, what: str, data: st.DataObject) -> None:
        camera = self.camera
        match what:
            case "deliver" if camera.said:
                self.hear(camera.said.popleft())
            case "take" if camera.heard:
                self.take(camera.heard.popleft(), data)
            case "say":
                camera.say()
            case "calm" if not camera.polled:
                camera.calm()
            case "sensor":
                camera.begin(SENSOR, self.draw_left(data), numbers=self.draw_numbers(data))
            case "operator":
                camera.stop() if camera.running else camera.start()
            case _:
                pass

    def take(self, word: Word, data: st.DataObject) -> None:
        """The camera does what the client has said."""
        camera = self.camera
        camera.behind = word.whose or camera.behind
        match word.what:
            case "query":
                camera.said.append("answer")
                camera.tell_beginning()
            case "status":
                camera.said.append(camera.status)
            case "number":
                camera.next_number = word.number
            case "trigger":
                self.take_trigger(word.whose, data)
            case "reset":
                camera.overtriggered = False
            case "stop":
                camera.stop()
            case _:
                camera.start()

    def take_trigger(self, whose: int, data: st.DataObject) -> None:
        camera = self.camera
        takes = camera.running and not camera.works
        if takes:
            self.taken.add(whose)
        if camera.polled and not takes and camera.refuses:
            camera.said.append("refused")
            return
        if camera.polled:
            camera.said.append("taken")
        camera.begin(whose, self.lefts.pop(whose), numbers=self.draw_numbers(data))

    def hear(self, what: Said) -> None:
        """Something comes to the client."""
        line = self.line
        own = isinstance(what, Container) and what.whose == self.sent and not self.idle
        match what:
            case Container():
                line.result(what.number if line.numbered else None, what)
            case "answer" if line.open_queries:
                line.answer()
            case "answer":
                self.asked = False
            case "taken" | "refused":
                self.hear_of_trigger(what)
            case _:
                line.hear(what)
        for container, verdict in line.judged:
            assert isinstance(container, Container)
            self.look_at(container, verdict.fate, own=own)
        line.judged.clear()
        for container in line.returned:
            assert isinstance(container, Container)
            began = container.whose if self.ordered else container.behind or container.whose
            assert began == self.sent, "a trigger got what is not its own"
            assert self.gives, "a trigger got what nothing shows to be its own"
        line.returned = []

    def hear_of_trigger(self, what: Literal["taken", "refused"]) -> None:
        raise NotImplementedError

    # -- what must hold

    def look_at(self, container: Container, fate: str, *, own: bool) -> None:
        """Allow a stranger's container until it is known better, and demand the trigger's own."""
        if own and self.gives:
            assert self.line.pending is not None
            readable = self.number is None or container.number in {None, self.number}
            full = self.line.pending.received == self.line.pending.wanted
            assert fate == "triggered" or full or not readable, "the trigger's own was not given it"
        elif container.whose in self.given_up and self.kinds == ("number",) and not self.sensors:
            assert fate not in {"nobody", "triggered"}, "a late container was not known"

    @invariant()
    def bounded(self) -> None:
        assert len(self.line.at.owed) <= MAX_OWED


class CameraAndClientAlone(CameraAndClient):
    """TCP, no numbers, all triggers ours, more results than wanted: each gets its own."""

    moves = ("deliver", "take", "say", "calm")
    results: ClassVar[tuple[int, ...]] = (1, 2, 3)


class CameraAndClientWithSensor(CameraAndClient):
    """TCP, no numbers: anybody at any time."""


class CameraAndClientWithOperator(CameraAndClient):
    """The same, and somebody stops and starts the application at the camera."""

    moves = (*CameraAndClient.moves, "operator")


class CameraAndClientWithExtras(CameraAndClient):
    """TCP, no numbers, anybody at any time, two or three results of which some are wanted."""

    results = (2, 3)


class CameraAndClientThatShowsLate(CameraAndClientAlone):
    """The camera answers the Query behind the trigger before it shows the inspection."""

    late = True


class CameraAndClientThatShowsNothing(CameraAndClient):
    """TCP, no numbers: a camera on which Waiting for Trigger never drops gives no results."""

    shows = False


class CameraAndClientThatKnowsThatNothingShows(CameraAndClientAlone):
    """TCP, no numbers, all triggers ours: the client is told that the status does not show them."""

    shows = False
    results = (1,)

    def __init__(self) -> None:
        super().__init__()
        self.line = Line(gets_every_status=False, by_round_trip=True)


class CameraAndClientByNumber(CameraAndClient):
    """TCP, numbers: anybody at any time, and more results than wanted."""

    kinds = ("number",)
    results: ClassVar[tuple[int, ...]] = (1, 2, 3)


class CameraAndClientByNumberAlone(CameraAndClientByNumber):
    """The same, all triggers ours: what is late is known for late."""

    moves = CameraAndClientAlone.moves


class CameraAndClientByOnesOwnNumber(CameraAndClient):
    """The user sets numbers, which may be those of somebody else's runs, and some again."""

    kinds: ClassVar[tuple[Kind, ...]] = ("number",)
    results = (1, 2)

    @rule(number=st.integers(0, 5) | st.none())
    def set_number(self, number: int | None) -> None:
        """None: the one that the camera would give to its next run."""
        number = self.camera.next_number if number is None else number
        self.line.at.set_next_number(number)
        self.say_to_camera(Word("number", 0, number))


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
        self.camera.next_number = (self.line.at._last_own_number - step) % (
            self.highest + 1
        ) - short


class CameraAndClientOfAllKinds(CameraAndClientByOnesOwnNumber):
    """Triggers with and without a number, and with one that may be missing in a container."""

    kinds = ("plain", "number")


class CameraAndClientByNumberThatMayBeMissing(CameraAndClientByOnesOwnNumber):
    """A number in a group, which may be empty."""

    kinds = ("plain", "perhaps")


class CameraAndClientByNumberOverUdp(CameraAndClient):
    """UDP, numbers: what the camera says is overtaken and lost, what it is told is lost.

    A run that somebody else has begun behind the number may pass for the trigger's own, where the
    trigger is lost, or the status that says that it was dropped.
    """

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


class CameraAndClientThatAnswers(CameraAndClient):
    """``bid`` over TCP: a trigger is answered, the status is asked for, anybody at any time."""

    moves = (*CameraAndClient.moves, "poll", "push", "reset")
    results = (1, 2)

    def __init__(self) -> None:
        super().__init__()
        self.camera.polled = self.camera.latches = True
        self.line = Line(gets_every_status=False, polled=True)
        self.unanswered = False  # a trigger

    @initialize(data=st.data())
    def connect(self, data: st.DataObject) -> None:
        super().connect(data)
        self.camera.latches = True
        self.camera.refuses = data.draw(st.booleans(), "refuses")

    def move(self, what: str, data: st.DataObject) -> None:
        if what == "poll" and self.line.status is not None:
            self.say_to_camera(Word("status"))
        elif what == "reset" and self.line.status is not None:  # another task's
            self.say_to_camera(Word("reset"))
        elif what == "push":
            self.camera.said.append(self.camera.status)
        super().move(what, data)

    @precondition(lambda self: self.idle and self.line.status is not None)
    @rule(data=st.data())
    def trigger(self, data: st.DataObject) -> None:
        at = self.line.at
        self.wake()
        self.refresh(data)
        at.note_query_answered()
        if at.owed_fate is not None:
            self.go_on(data, lambda: self.asks_until_ready())
            self.round_trip(data)
            at.forget_owed()
        if self.line.status == READY | Status.OVERTRIGGERED:
            self.say_to_camera(Word("reset"))
            self.refresh(data)
        self.go_on(data, lambda: not self.owes)
        if self.line.status != READY:
            return
        self.go_on(data, lambda: not self.unanswered)
        self.write(data)

    def asks_until_ready(self) -> bool:
        status = self.line.status or STOPPED
        if Status.WAITING_FOR_TRIGGER in status:
            return True
        if Word("status") not in self.camera.heard:
            self.say_to_camera(Word("status"))
        return False

    def refresh(self, data: st.DataObject) -> None:
        self.say_to_camera(Word("status"))
        self.round_trip(data)

    def write(self, data: st.DataObject, number: int | None = None) -> None:
        self.sent += 1
        self.lefts[self.sent] = self.draw_left(data)
        self.line.send(number, data.draw(st.integers(1, min(self.results)), "wanted"))
        words = Word("query"), Word("status"), Word("trigger", self.sent), Word("status")
        self.say_to_camera(*words)
        self.unanswered = True

    def lose_the_link(self, really: int) -> None:
        super().lose_the_link(really)
        self.unanswered = self.unanswered and really > 0

    def hear_of_trigger(self, what: Literal["taken", "refused"]) -> None:
        self.unanswered = False
        line = self.line
        if what == "taken":
            line.trigger_answer()
        elif not self.idle:
            assert line.pending is not None
            line.pending.ended = True


MACHINES: list[type[CameraAndClient]] = [
    CameraAndClientAlone,
    CameraAndClientWithSensor,
    CameraAndClientWithOperator,
    CameraAndClientWithExtras,
    CameraAndClientThatShowsLate,
    CameraAndClientThatShowsNothing,
    CameraAndClientThatKnowsThatNothingShows,
    CameraAndClientByNumber,
    CameraAndClientByNumberAlone,
    CameraAndClientByOnesOwnNumber,
    CameraAndClientByNarrowNumber,
    CameraAndClientOfAllKinds,
    CameraAndClientByNumberThatMayBeMissing,
    CameraAndClientByNumberOverUdp,
    CameraAndClientThatAnswers,
]
for _machine in MACHINES:
    _machine.TestCase.settings = settings(
        max_examples=max(1, settings().max_examples // 2), stateful_step_count=100
    )
    globals()[_machine.__name__.replace("CameraAndClient", "Test")] = _machine.TestCase
