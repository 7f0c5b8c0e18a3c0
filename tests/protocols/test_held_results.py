"""Results that wait for their application, with a camera whose application changes at any time."""

from __future__ import annotations

from collections import deque

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.exceptions import FrameError
from smartcam.protocols import messages as m
from smartcam.protocols._held_results import MAX_HELD, HeldResults


def result(data: bytes, application: int = -1, fault: str | None = None) -> m.ResultContainer:
    return m.ResultContainer(application=application, data=data, fault=fault)


class Station:
    """A camera that switches slowly, and a client's results in front of it."""

    def __init__(self) -> None:
        self.held = HeldResults()
        self.active = 1
        self.questions: deque[int] = deque()
        self.made: dict[bytes, int] = {}  # the application that each result was made under
        self.told: list[m.Message] = []
        self.since_switch = 2  # answers that the camera has given since the last switch
        self.triggers = 0

    def result(self, *, answers_trigger: bool = False) -> None:
        data = b"%d" % len(self.made)
        self.made[data] = self.active
        if self.held.add((result(data),), answers_trigger=answers_trigger):
            self.questions.append(self.held.ask())

    def step(self, action: str) -> None:
        if action == "result":
            self.result()
        elif action == "remark":
            self.held.add((m.Notice("debug", len(self.made), ""),), answers_trigger=False)
        elif action == "trigger" and not self.triggers:
            self.questions.append(self.held.ask(trigger=True))
            self.triggers = 1
        elif action == "answer trigger" and self.triggers:
            self.triggers = 0
            self.result(answers_trigger=True)
        elif action == "answer" and self.questions:
            self.since_switch += 1
            if self.held.name(self.active, self.questions.popleft()):
                self.questions.append(self.held.ask())
        elif action == "switch" and self.since_switch >= 2 and not self.questions:
            # which takes longer than a question and its answer
            self.active, self.since_switch = 3 - self.active, 0
        self.told += self.held.take()  # type: ignore[arg-type]


ACTIONS = ("result", "remark", "trigger", "answer trigger", "answer", "answer", "switch")


@given(st.lists(st.sampled_from(ACTIONS), max_size=60))
def test_each_result_is_told_once_in_order_and_of_its_own_application(actions: list[str]) -> None:
    station = Station()
    for action in actions:
        station.step(action)
    while station.questions:
        station.step("answer")
    results = [one for one in station.told if isinstance(one, m.ResultContainer)]
    assert [one.data for one in results] == list(station.made)
    for one in results:
        assert one.fault is not None or one.application == station.made[one.data]
    remarks = sum(action == "remark" for action in actions)
    assert len(station.told) == len(results) + remarks


@given(st.lists(st.sampled_from([one for one in ACTIONS if one != "switch"]), max_size=40))
def test_result_of_a_camera_that_never_switches_has_no_fault(actions: list[str]) -> None:
    station = Station()
    for action in [*actions, *["answer"] * 60]:
        station.step(action)
    results = [one for one in station.told if isinstance(one, m.ResultContainer)]
    assert len(results) == len(station.made)
    assert all((one.application, one.fault) == (1, None) for one in results)


def test_switch_around_a_result_is_its_fault() -> None:
    held = HeldResults()
    held.name(1)
    held.add((result(b"a"),), answers_trigger=False)
    held.name(2, held.ask())
    why = "the application changed while the result was made: it may be of any of 1, 2"
    assert held.take() == [result(b"a", 2, why)]


def test_result_is_held_as_long_as_the_question_in_front_of_its_trigger_is_open() -> None:
    held = HeldResults()
    front = held.ask(trigger=True)
    assert not held.add((result(b"a"),), answers_trigger=True)
    assert held.name(1, front)
    assert held.take() == []
    held.name(1, held.ask())
    assert held.take() == [result(b"a", 1)]


def test_end_of_the_link_tells_what_waits_with_a_fault() -> None:
    held = HeldResults()
    held.add((result(b"a"),), answers_trigger=False)
    held.ask()
    held.add((m.Notice("debug", 1, ""),), answers_trigger=False)
    held.end()
    why = "the link ended before the camera said of which application the result is"
    assert held.take() == [result(b"a", -1, why), m.Notice("debug", 1, "")]


def test_flood_without_an_answer_ends_the_link() -> None:
    held = HeldResults()
    for _ in range(MAX_HELD):
        held.add((result(b""),), answers_trigger=False)
    with pytest.raises(FrameError, match="no answer to the question"):
        held.add((m.Notice("debug", 1, ""),), answers_trigger=False)
