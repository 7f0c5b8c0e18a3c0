"""Results that wait for their application, with a camera whose application changes at any time."""

from __future__ import annotations

import re
from collections import deque

from hypothesis import given
from hypothesis import strategies as st

from smartcam.exceptions import FrameError
from smartcam.protocols import (
    LineDialect,
    LineMachine,
    LineRow,
    LinkEnded,
    LinkFailed,
    Role,
    Transport,
)
from smartcam.protocols import messages as m


def read(text: str) -> m.ResultContainer:
    return m.ResultContainer(data=text.encode())


DIALECT = LineDialect(
    name="ids",
    about="lines with an id",
    source="this test",
    rows=(
        LineRow(m.Connect, "{ticket}>TYPE", m.ConnectAnswer, lambda _: m.ConnectAnswer(version=1)),
        LineRow(
            m.Query,
            "{ticket}>JOB",
            m.QueryAnswer,
            lambda text: m.QueryAnswer(application=int(text)),
        ),
        LineRow(m.Trigger, "{ticket}>READ", m.ResultContainer, read),
        LineRow(None, "results", m.ResultContainer, read, answer_word="0"),
        LineRow(
            None, "remarks", m.Notice, lambda text: m.Notice("debug", 0, text), answer_word="00"
        ),
    ),
    split=lambda line: (line.partition(">")[0], line.partition(">")[2]),
    tickets=range(1, 10_000),
    pipelined=True,
    names_application=False,
)

MIXED = "the application changed while the result was made: it may be of any of 1, 2"


class Station:
    """A camera that switches slowly, and a client's machine in front of it."""

    def __init__(self) -> None:
        self.machine = LineMachine(DIALECT, Role.CLIENT, Transport.TCP, max_length=4096)
        self.machine.send(m.Connect())
        self.machine.receive_data(b"1>Model\n")
        assert self.machine.events() == [m.ConnectAnswer(version=1)]
        self.machine.data_to_send()
        self.active = 1
        self.questions: deque[bytes] = deque()
        self.trigger = b""
        self.made: dict[bytes, int] = {}  # the application that each result was made under
        self.told: list[object] = []
        self.since_switch = 2  # answers that the camera has given since the last switch

    def say(self, ticket: bytes, text: bytes) -> None:
        self.machine.receive_data(ticket + b">" + text + b"\n")
        self.listen()

    def listen(self) -> None:
        """Handle the client's messages, and the machine's events."""
        said = b"".join(self.machine.data_to_send())
        for ticket, what in re.findall(rb"(\d+)>(\w+)\n", said):
            if what == b"JOB":
                self.questions.append(ticket)
            else:
                self.trigger = ticket
        self.told += self.machine.events()

    def result(self, ticket: bytes = b"0") -> None:
        data = b"%d" % len(self.made)
        self.made[data] = self.active
        self.say(ticket, data)

    def step(self, action: str) -> None:
        if action == "result":
            self.result()
        elif action == "remark":
            self.say(b"00", b"hot")
        elif action == "trigger" and not self.trigger:
            self.machine.send(m.Trigger())
            self.listen()
        elif action == "answer trigger" and self.trigger:
            ticket, self.trigger = self.trigger, b""
            self.result(ticket)
        elif action == "answer" and self.questions:
            self.since_switch += 1
            self.say(self.questions.popleft(), b"%d" % self.active)
        elif action == "switch" and self.since_switch >= 2 and not self.questions:
            # which takes longer than a question and its answer
            self.active, self.since_switch = 3 - self.active, 0


ACTIONS = ("result", "remark", "trigger", "answer trigger", "answer", "answer", "switch")


@given(st.lists(st.sampled_from(ACTIONS), max_size=60))
def test_each_result_is_reported_once_in_order_of_its_application(actions: list[str]) -> None:
    station = Station()
    for action in actions:
        station.step(action)
    while station.questions:
        station.step("answer")
    results = [one for one in station.told if isinstance(one, m.ResultContainer)]
    assert [one.data for one in results] == list(station.made)
    for one in results:
        assert one.fault is not None or one.application == station.made[one.data]
    assert len(station.told) == len(results) + actions.count("remark")


@given(st.lists(st.sampled_from([one for one in ACTIONS if one != "switch"]), max_size=40))
def test_result_of_a_camera_that_never_switches_has_no_fault(actions: list[str]) -> None:
    station = Station()
    for action in [*actions, *["answer"] * 60]:
        station.step(action)
    results = [one for one in station.told if isinstance(one, m.ResultContainer)]
    assert len(results) == len(station.made)
    assert all((one.application, one.fault) == (1, None) for one in results)


def test_switch_around_a_result_is_its_fault() -> None:
    station = Station()
    for action in ("trigger", "answer", "answer trigger"):
        station.step(action)
    assert station.told == []
    station.active = 2
    station.step("answer")
    assert station.told == [m.ResultContainer(application=2, data=b"0", fault=MIXED)]


def test_result_is_held_as_long_as_the_question_in_front_of_its_trigger_is_open() -> None:
    station = Station()
    for action in ("trigger", "answer trigger", "remark"):
        station.step(action)
    (front,) = station.questions
    station.step("answer")
    (behind,) = station.questions
    assert (station.told, front != behind) == ([], True)
    station.step("answer")
    assert station.told == [
        m.ResultContainer(application=1, data=b"0"),
        m.Notice("debug", 0, "hot"),
    ]


def test_end_of_the_link_tells_what_waits_with_a_fault() -> None:
    station = Station()
    station.step("result")
    station.step("remark")
    station.machine.receive_eof()
    station.listen()
    why = "the link ended before the camera said of which application the result is"
    assert station.told == [
        m.ResultContainer(data=b"0", fault=why),
        m.Notice("debug", 0, "hot"),
        LinkEnded(pending=0),
    ]


def test_flood_without_an_answer_ends_the_link() -> None:
    station = Station()
    count = 0
    while not station.told:
        station.step("result")
        count += 1
        assert count < 10_000
    last = station.told[-1]
    assert isinstance(last, LinkFailed)
    assert isinstance(last.error, FrameError)
    assert "no answer to the question" in str(last.error)
    assert len(station.told) == count + 1, "each container that came is told, with a fault"
