"""The client's machine and the emulated camera's commands, with nothing but bytes between them.

Requests, bytes in pieces, time and an operator come in any order. Each request is answered once and
in order, and what an answer says was true while the request was under way.
"""

from __future__ import annotations

import collections
import itertools

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from smartcam.exceptions import LocalProtocolError
from smartcam.protocols import State
from smartcam.protocols import messages as m
from smartcam.protocols._inside import ONLINE, Event
from tests.emulator.parts import insight, pass_time
from tests.protocols.inside import Command, Reply, command_reader
from tests.protocols.insight_lines import LOGIN, Talk, with_cells

REQUESTS: list[m.Message] = [
    m.GetStatus(),
    m.Query(),
    m.Trigger(),
    m.Start(),
    m.Stop(),
    m.SwitchApplication(application=7),
    m.SwitchApplication(application=12),
    m.SwitchApplication(application=99),
    m.LoadFile(name=b"spare.job"),
    m.ReadImage(),
    Command(line="GVA001"),
]
ANSWERS: dict[type[m.Message], type[m.Message]] = {
    m.GetStatus: m.StatusReport,
    m.Query: m.QueryAnswer,
    m.Trigger: m.TriggerAnswer,
    m.Start: m.StartAnswer,
    m.Stop: m.StopAnswer,
    m.SwitchApplication: m.SwitchAnswer,
    m.LoadFile: m.SwitchAnswer,
    m.ReadImage: m.Image,
    Command: Reply,
}

MAX_ROUNDS = 50
"""Bound of what it takes to answer everything: nine requests of up to four lines."""


class Wires(RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        runs = itertools.count(1)
        job = {"cells": {"A1": lambda _: next(runs)}, "load_time": 0.3}
        jobs = [{**job, "file": file} for file in ("7bolts.job", "12nuts.job", "spare.job")]
        self.device, self.commands = insight(jobs)
        self.heard = command_reader()
        self.busy = self.going = False
        self.to_camera, self.to_client = bytearray(), bytearray(LOGIN)
        self.talk = Talk(with_cells("A1"))
        self.talk.machine.send(m.Connect())
        self.open: collections.deque[m.Message] = collections.deque([m.Connect()])
        self.modes = {self.device.online}  # since the oldest open request was said
        self.last = 0  # run of the last result
        self.carry_to_client(len(LOGIN))
        self.to_camera.clear()  # the login is not the camera's business here

    # ------------------------------------------------------------------ the camera

    def answer(self, data: bytes, *, more: bool = False) -> None:
        self.to_client += data
        if not more:
            self.busy = False
            self.go_on()

    def go_on(self) -> None:
        if self.going:
            return
        self.going = True
        while not self.busy and (line := self.heard.next_line()) is not None:
            self.busy = True
            self.commands.execute(line, self.answer)
        self.going = False
        self.modes.add(self.device.online)

    # ------------------------------------------------------------------ rules

    @rule(request=st.sampled_from(REQUESTS))
    def say(self, request: m.Message) -> None:
        if any(type(one) is type(request) for one in self.open):
            if isinstance(request, m.GetStatus):
                self.talk.machine.send(request)
            else:
                with pytest.raises(LocalProtocolError):
                    self.talk.machine.send(request)
        else:
            self.open.append(request)
            self.talk.machine.send(request)
        self.to_camera += self.talk.written()

    @rule(count=st.integers(1, 12))
    def carry_to_camera(self, count: int) -> None:
        self.heard.feed(bytes(self.to_camera[:count]))
        del self.to_camera[:count]
        self.go_on()

    @rule(count=st.integers(1, 4000))
    def carry_to_client(self, count: int) -> None:
        data = bytes(self.to_client[:count])
        del self.to_client[:count]
        self.to_camera += self.talk.hear(data)
        self.check(self.talk.told())

    @rule(seconds=st.sampled_from([0.01, 0.05, 0.3]))
    def pass_time(self, seconds: float) -> None:
        pass_time(self.device, seconds)
        self.modes.add(self.device.online)

    @rule(online=st.booleans())
    def operate(self, online: bool) -> None:
        self.device.set_online(online)
        self.modes.add(self.device.online)

    @rule()
    def trigger_by_the_input(self) -> None:
        self.device.trigger()

    @precondition(lambda self: not self.device._loading)
    @rule(job=st.sampled_from([7, 12, "spare.job"]))
    def load_by_hand(self, job: int | str) -> None:
        self.device.load(job)

    @rule()
    def carry_all(self) -> None:
        for _ in range(MAX_ROUNDS):
            self.carry_to_camera(1000)
            self.carry_to_client(10_000)
            self.pass_time(0.3)
            if not self.open:
                return
        pytest.fail(f"not answered in {MAX_ROUNDS} rounds: {self.open}")

    # ------------------------------------------------------------------ what must hold

    def check(self, events: list[Event]) -> None:
        for event in events:
            assert isinstance(event, m.Message)
            request = self.open[0]
            if isinstance(event, m.ResultContainer):
                assert isinstance(request, m.Trigger)
                self.check_result(event)
                self.open.popleft()
                continue
            if isinstance(event, m.StatusReport):
                assert (event.status == ONLINE) in self.modes
                if isinstance(request, m.Trigger):
                    continue  # why it took none; that follows
            assert isinstance(event, ANSWERS.get(type(request), m.ConnectAnswer))
            if event != m.TriggerAnswer(code=1):  # its cells are still to come
                self.open.popleft()
            self.check_answer(request, event)
        if not self.open:
            self.modes = {self.device.online}

    def check_answer(self, request: m.Message, answer: m.Message) -> None:
        if isinstance(answer, (m.QueryAnswer, m.SwitchAnswer)):
            assert answer.application in {7, 12, m.UNNAMED_APPLICATION}
        if isinstance(answer, m.SwitchAnswer) and request == m.SwitchApplication(application=99):
            assert answer.code == -2
        if isinstance(answer, m.StartAnswer):
            assert answer.code in {1, -2, -5}
        if isinstance(answer, m.Image):
            assert (answer.code, answer.data[:2]) == (1, b"BM")

    def check_result(self, container: m.ResultContainer) -> None:
        assert container.cells is not None
        ((cell, text),) = container.cells
        if text is not None:  # a job that was loaded in between has none yet
            assert cell == "A001"
            assert self.last <= float(text) <= self.device.runs
            self.last = int(float(text))

    @invariant()
    def session_goes_on(self) -> None:
        assert self.talk.machine.state is State.CONNECTED
        assert len(self.open) <= len(ANSWERS)

    def teardown(self) -> None:
        self.carry_all()
        assert self.talk.machine.buffered == 0


TestWires = Wires.TestCase
