"""A camera as plain as it can be written: what it does, and what it must say.

Made from the protocol's description (docs/protocol.md), not from the code: of the package it uses
the words and no behaviour. Time is whole numbers, of milliseconds where nobody says otherwise.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import fields
from datetime import UTC, datetime, timedelta
from typing import ClassVar, Literal, NamedTuple

from smartcam.models import Status
from smartcam.protocols import messages as m


class Program(NamedTuple):
    """An application; ``period`` makes it free-running."""

    loading: int
    processing: int
    period: int | None = None
    result: Literal["number", "input", "cycle"] | None = "number"


PROGRAMS = {
    1: Program(loading=100, processing=40),
    2: Program(loading=60, processing=30, result="input"),
    3: Program(loading=100, processing=10, period=50),
    4: Program(loading=0, processing=25, result=None),
    5: Program(loading=150, processing=0, result="cycle"),
}
CYCLE = (10, -20, 30)
DEPTH = 2
LOST = datetime(1970, 1, 1, tzinfo=UTC)
LATEST = datetime.max.replace(tzinfo=UTC)


class Options(NamedTuple):
    """The open questions of the documents that are varied here."""

    switch_while_running: Literal["refuse", "ignore", "allow"] = "refuse"
    switch_answer: Literal["after_status", "before_status"] = "after_status"
    waiting_before_result: bool = False
    busy_while_processing: bool = False
    disconnect_answer: Literal["code", "silent"] = "code"
    bad_message: Literal["code", "ignore"] = "code"
    push_status: bool = False


class Run(NamedTuple):
    """An inspection under way."""

    number: int
    turn: int
    value: int


class Load(NamedTuple):
    """A switch under way."""

    target: int
    answer: bool
    running: bool


class CameraModel:
    """The camera: what it is doing, and what it must say.

    What falls on one instant happens in the order of ``ORDER``, as the emulator documents it.
    """

    ORDER = ("inspected", "calm", "loaded", "booted", "next run")
    programs: ClassVar[Mapping[int, Program]] = PROGRAMS
    calm_after = 100
    reboot_time = 300

    def __init__(self, options: Options, *, is_bid: bool, coded: bool) -> None:
        self.options = options  # the open questions
        self.is_bid = is_bid  # it is a BVS ID: it always runs, and every request is answered
        self.coded = coded  # answers have result codes
        self.now = 0
        self.due: dict[str, int] = {}
        self.mode: Literal["stopped", "running", "switching", "rebooting"] = "stopped"
        self.active = next(iter(self.programs))
        self.session = False
        self.endian = 0
        self.number = self.turn = 0
        self.run: Run | None = None
        self.load: Load | None = None
        self.overheat = self.error = self.over = self.out_of_step = False
        self.inputs: deque[int] = deque()
        self.last_input = 0
        self.clock_set: tuple[datetime, int] = (LOST, 0)
        self._said: list[m.Message] = []
        self._told: tuple[Status, int] | None = None
        if is_bid:
            self.start()

    # ------------------------------------------------------------------ what shows

    @property
    def program(self) -> Program:
        return self.programs[self.active]

    @property
    def status(self) -> Status:
        running = self.mode == "running"
        waits = running and self.run is None and self.program.period is None and not self.error
        busy = self.options.busy_while_processing and self.run is not None
        not_ready = self.is_bid and (not running or self.error)
        bits = {
            0x001: self.overheat,
            0x002: self.error,
            0x004: self.out_of_step and not self.is_bid,
            0x010: self.mode == "switching" or busy or not_ready,
            0x080: running,
            0x100: self.over,
            0x200: waits,
        }
        return Status(sum(bit for bit, is_set in bits.items() if is_set))

    @property
    def clock(self) -> datetime:
        time, at = self.clock_set
        try:
            return time + timedelta(milliseconds=self.now - at)
        except OverflowError:
            return LATEST

    def take(self) -> list[m.Message]:
        """Return its messages since the last call."""
        said, self._said = self._said, []
        return said

    def _say(self, message: m.Message) -> None:
        if self.session:
            self._said.append(message)

    def _report(self) -> None:
        """Send a status after every change; a BVS ID does so only on request."""
        if (self.status, self.endian) != self._told and (
            not self.is_bid or self.options.push_status
        ):
            self._tell_status()

    def _tell_status(self) -> None:
        self._told = (self.status, self.endian)
        self._say(m.StatusReport(status=self.status, endian=self.endian))

    # ------------------------------------------------------------------ the client

    def hear(self, message: m.Message) -> None:
        """Handle a message of the session's client."""
        if self.mode == "rebooting":
            return
        if isinstance(message, m.Connect):
            self.session, self._told = True, None
            self._forget_asker()
            self._say(m.ConnectAnswer(version=1))
            if self.is_bid:
                self._told = (self.status, self.endian)
            else:
                self._report()
        elif isinstance(message, m.Disconnect):
            if self.is_bid and self.options.disconnect_answer == "code":
                self._say(m.DisconnectAnswer(code=0))
            self.end_session()
        elif self.session:
            self._obey(message)

    def end_session(self) -> None:
        """The client is gone."""
        self.session = False
        self._forget_asker()

    def _acknowledge(self, answer: type[m.Acknowledgement], *, done: bool) -> None:
        if self.is_bid:
            self._say(answer(code=0x00 if done else 0x10))

    def _complain(self, message_id: int, code: int) -> None:
        if self.is_bid and self.options.bad_message == "code":
            self._say(m.UnknownMessage(message_id=message_id, payload=bytes((code, 0))))

    def _obey(self, message: m.Message) -> None:
        match message:
            case m.Query() if self.is_bid and self.mode == "switching":
                self._say(m.QueryAnswer(code=0x16, application=0))
            case m.Query():
                self._say(m.QueryAnswer(code=2 * self.coded, application=self.active))
            case m.SwitchApplication(application=application):
                self._switch(application)
            case m.GetClock():
                parts = self.clock.timetuple()[:6]
                names = [field.name for field in fields(m.SetClock)]
                named = dict(zip(names, parts, strict=True))
                self._say(m.ClockAnswer(code=6 * self.coded, **named))
            case m.SetClock():
                done = self._set_clock([getattr(message, field.name) for field in fields(message)])
                self._acknowledge(m.SetClockAnswer, done=done)
            case m.SetInput(data=data):
                done = self._take_input(data)
                self._acknowledge(m.SetInputAnswer, done=done)
            case m.SetSequenceNumber(number=number):
                self.number = number
            case m.Trigger():
                if self.is_bid:
                    self._say(m.TriggerAnswer(code=0x16 if self.status & 0x010 else 0x00))
                self.trigger()
            case m.Start():
                self.start()
            case m.Stop():
                self.stop()
            case m.Reboot():
                self.reboot()
            case m.GetStatus():
                self._tell_status()
            case m.ResetErrors():
                self.over = self.out_of_step = False
                self._acknowledge(m.ResetErrorsAnswer, done=True)
                self._tell_status()
            case m.UnknownMessage(message_id=message_id):
                self._complain(message_id, 0x13)
            case m.MalformedMessage(message_id=message_id):
                self._complain(message_id, 0x10)
            case _:
                pass

    def _switch(self, target: int) -> None:
        if self.is_bid and self.status & 0x010:
            self._say(m.SwitchAnswer(code=0x16, application=self.active))
            return
        must_stop = self.mode == "running" and not self.is_bid
        how = self.options.switch_while_running if must_stop else "allow"
        if self.mode == "switching":
            return
        if target not in self.programs or how == "refuse":
            code = 0x1A if self.coded else 1
            self._say(m.SwitchAnswer(code=code, application=self.active))
        elif how == "allow":
            self._begin_load(Load(target, answer=True, running=False))

    def _set_clock(self, parts: list[int]) -> bool:
        year, month, day, hour, minute, second = parts
        try:
            time = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
        except (ValueError, OverflowError):
            return False
        self.clock_set = (time, self.now)
        return True

    def _take_input(self, data: bytes) -> bool:
        if self.program.result != "input" or self.mode == "switching" or len(data) != 4:
            return False
        if len(self.inputs) == (1 if self.is_bid else DEPTH):
            self.inputs.popleft()
            self.out_of_step = True
        self.inputs.append(int.from_bytes(data, self._byte_order, signed=True))
        self._report()
        return True

    @property
    def _byte_order(self) -> Literal["little", "big"]:
        return "big" if self.endian == 1 else "little"

    # ------------------------------------------------------------------ the operator, too

    def start(self) -> None:
        if self.mode != "stopped":
            return
        self.mode = "running"
        if self.program.period is not None:
            self.due["next run"] = self.now
        self._report()
        self._happen()

    def stop(self) -> None:
        if self.mode == "running":
            self.mode = "stopped"
            self._void()
            self.due.pop("next run", None)
            self._report()

    def trigger(self) -> bool:
        takes = self.mode == "running" and self.program.period is None and not self.error
        if not takes:
            return False
        if self.run is not None:
            self.over = True
            if not self.is_bid:
                self.due["calm"] = self.now + self.calm_after
            self._report()
            return False
        self._begin_run()
        self._happen()
        return True

    def switch_application(self, target: int, *, running: bool) -> bool:
        if self.mode in {"switching", "rebooting"}:
            return False
        self._begin_load(Load(target, answer=False, running=running))
        return True

    def reboot(self) -> None:
        if self.mode != "rebooting":
            self.mode, self.session, self.run = "rebooting", False, None
            self.due = {"booted": self.now + self.reboot_time}

    def set_condition(self, what: Status, on: bool) -> None:
        if what == 0x001:
            self.overheat = on
        else:
            self.error = on
        if self.error:
            self._void()
        self._report()

    def set_endian(self, endian: int) -> None:
        self.endian = endian
        self._report()

    # ------------------------------------------------------------------ time

    def pass_time(self, ticks: int) -> None:
        end = self.now + ticks
        while self.due and min(self.due.values()) <= end:
            self.now = min(self.due.values())
            self._happen()
        self.now = end

    @property
    def next_event_in(self) -> int | None:
        return min(self.due.values()) - self.now if self.due else None

    def _happen(self) -> None:
        acts: dict[str, Callable[[], None]] = {
            "inspected": self._inspected,
            "calm": self._calm,
            "loaded": self._loaded,
            "booted": self._booted,
            "next run": self._free_run,
        }
        while ready := [name for name in self.ORDER if self.due.get(name) == self.now]:
            del self.due[ready[0]]
            acts[ready[0]]()

    def _calm(self) -> None:
        self.over = False
        self._report()

    def _begin_load(self, load: Load) -> None:
        self._void()
        self.due.pop("next run", None)
        self.mode, self.load = "switching", load
        self.due["loaded"] = self.now + self.programs[load.target].loading
        self._report()
        self._happen()

    def _forget_asker(self) -> None:
        """The answer to a switch is for the session that asked."""
        if self.load is not None:
            self.load = self.load._replace(answer=False)

    def _loaded(self) -> None:
        load, self.load = self.load, None
        assert load is not None
        self.active, self.turn, self.mode = load.target, 0, "stopped"
        self._forget_inputs()
        answer = m.SwitchAnswer(code=0, application=load.target)
        early = self.options.switch_answer == "before_status"
        if load.answer and early:
            self._say(answer)
        self._report()
        if load.answer and not early:
            self._say(answer)
        if load.running or self.is_bid:
            self.start()

    def _booted(self) -> None:
        self.mode = "stopped"
        self.error = self.over = False
        self.number = self.turn = 0
        self._forget_inputs()
        self.clock_set = (LOST, self.now)
        if self.is_bid:
            self.start()

    def _forget_inputs(self) -> None:
        self.inputs.clear()
        self.last_input, self.out_of_step = 0, False

    # ------------------------------------------------------------------ inspections

    def _free_run(self) -> None:
        assert self.program.period is not None
        self.due["next run"] = self.now + self.program.period
        if not self.error:
            self._begin_run()

    def _begin_run(self) -> None:
        if self.program.result == "input":
            self.out_of_step = not self.inputs
            self.last_input = self.inputs.popleft() if self.inputs else self.last_input
        self.run = Run(self.number, self.turn, self.last_input)
        self.number, self.turn = (self.number + 1) % (1 << 32), self.turn + 1
        self.due["inspected"] = self.now + self.program.processing
        self._report()

    def _inspected(self) -> None:
        run, self.run = self.run, None
        assert run is not None
        if self.options.waiting_before_result:
            self._report()
        values = {"number": run.number, "input": run.value, "cycle": CYCLE[run.turn % len(CYCLE)]}
        if self.program.result is not None:
            word = values[self.program.result] % (1 << 32)
            data = word.to_bytes(4, self._byte_order)
            self._say(m.ResultContainer(application=self.active, data=data))
        self._report()

    def _void(self) -> None:
        """No result comes from the inspection under way."""
        self.run = None
        self.due.pop("inspected", None)
