"""Target ``camera``: the emulated camera behind its wire, whatever a client writes and when.

Input: dialect, quirks, application, then steps until the bytes end: bytes as they are, a whole
frame, time, or something that an operator does. What the camera says is heard by the client's role.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from smartcam.emulator import Application, Quirks
from smartcam.exceptions import FrameError, MessageError
from smartcam.models import Status
from smartcam.protocols import FramedDialect, Machine, Role, State, Transport
from smartcam.protocols import messages as m
from smartcam.protocols._inside import HANDBOOK, POLICIES, Policy, ResultCode
from tests.emulator.builtins import BUILTIN_APPLICATIONS
from tests.emulator.parts import made_device
from tests.fuzz.fuzz_input import Choices
from tests.machines import B16, BID, CODES, THESIS

DIALECTS = (HANDBOOK, THESIS, B16, BID, B16.with_quirks(["code"]))
QUIRKS = (
    Quirks(),
    Quirks(switch_while_running="allow", waiting_before_result=True, reboot_time=0.5),
    Quirks(switch_while_running="ignore", busy_while_processing=True, input_queue_depth=1),
    Quirks(switch_answer="before_status", bad_frame="close", overtriggered_time=0, reboot_time=0),
    Quirks(push_status=True, disconnect_answer="silent", bad_message="ignore"),
)
POLICIES_ON_A_BAD_FRAME = {
    "skip": POLICIES[Role.CAMERA, Transport.TCP],
    "close": Policy(fatal=(FrameError,), exact_length=True),
}
ECHO = Application(
    id=4,
    layout="n: int16 @sequence, s: string[2], b: bool",
    input="s: string[2], b: bool",
    generator="input",
    load_time=0,
    processing_time=0,
)
APPLICATIONS = {application.id: application for application in (*BUILTIN_APPLICATIONS, ECHO)}
TIMES = (0.0, 0.001, 0.05, 0.3, 0.5, 2.0)
ENDIANS = (0, 1, 7)
LIMIT = 256
DROPS = Policy(fatal=(), exact_length=False)
BY_ITSELF = (m.StatusReport, m.ResultContainer, m.DisconnectAnswer, m.UnknownMessage)
"""Messages that a client hears without having asked."""


class Camera:
    """A device, its machine, and a client that listens."""

    def __init__(
        self, dialect: FramedDialect, quirks: Quirks, active: int, *, running: bool
    ) -> None:
        self.device = made_device(
            APPLICATIONS.values(), dialect, quirks, active=active, running=running
        )
        policy = dataclasses.replace(
            POLICIES_ON_A_BAD_FRAME[quirks.bad_frame],
            reports_malformed=self.device.behaviour.answers_bad_messages,
        )
        self.dialect = dialect
        self.machine = Machine(dialect, Role.CAMERA, Transport.TCP, max_length=LIMIT, policy=policy)
        # a code alone, where an answer has more, is dropped and counted
        self.client = Machine(dialect, Role.CLIENT, Transport.TCP, policy=DROPS)
        self.client.state = State.CONNECTED
        self.status: m.StatusReport | None = None

    def take(self, data: bytes) -> None:
        """Bytes of the client come."""
        self.machine.receive_data(data)
        for event in self.machine.events():
            if isinstance(event, m.Message):
                self.device.handle(event)
                self.deliver()

    def deliver(self) -> None:
        """Let the client hear what the camera says, and look at it."""
        device = self.device
        output = device.take_output()
        said = [one for one in output if not isinstance(one, m.DisconnectAnswer)]
        assert device.connected or not said, "it speaks without a session"
        if self.machine.state is State.FAILED:
            return  # the link ended behind what it answers
        for message in output:
            self.machine.send(message)
            self.look_at(message)
        for data in self.machine.data_to_send():
            self.client.receive_data(data)
        assert self.client.error is None, self.client.error
        assert self.client.buffered == 0
        heard = self.client.events()
        carried = [self.on_the_wire(message) for message in output]
        assert heard == [message for message in carried if isinstance(message, BY_ITSELF)]
        if device.connected and device.behaviour.reports_changes:
            assert self.status is not None or not device.behaviour.status_with_session
            if self.status is not None:
                assert (self.status.status, self.status.endian) == (device.status, device.endian)
        if device.connected:
            assert bool(device.status & Status.RUNNING) == device.running
            assert device.status & Status.BUSY or device.mode.value != "switching"
        due = device.next_event_in()
        assert due is None or due >= 0

    def on_the_wire(self, message: m.Message) -> m.Message | None:
        """Return what a client takes a message for, None where its body is too short for that."""
        try:
            return self.dialect.decode(m.Sender.CAMERA, self.dialect.to_frame(message))
        except MessageError:
            return None

    def look_at(self, message: m.Message) -> None:
        """Each message of a camera makes sense by itself."""
        match message:
            case m.ConnectAnswer():
                self.status = None
            case m.StatusReport():
                asked = not self.device.behaviour.status_with_session
                assert message != self.status or asked, "the same status twice"
                assert not message.status & ~sum(Status), "a bit without a name"
                both = Status.BUSY | Status.WAITING_FOR_TRIGGER
                assert message.status & both != both
                self.status = message
            case m.ResultContainer():
                assert self.device.running, "a stopped camera sends a result"
                assert not self.device.status & Status.SYSTEM_ERROR
                layout = APPLICATIONS[message.application].result_layout
                assert layout is not None
                orders: dict[int, Any] = {1: "big"}
                layout.parse(message.data, orders.get(self.device.endian, "little"))
            case m.ClockAnswer():
                assert 1 <= message.month <= 12
            case m.QueryAnswer(code=ResultCode.BUSY, application=0):
                assert self.device.mode.value == "switching"
            case m.QueryAnswer() | m.SwitchAnswer():
                assert message.application in APPLICATIONS
            case m.Acknowledgement(code=code) if self.dialect.has(type(message)):
                assert code in CODES
            case m.UnknownMessage(payload=payload) if self.device.behaviour.answers_bad_messages:
                assert int.from_bytes(payload, "little") in CODES
            case _:
                raise AssertionError(f"a camera says no {message}")


def check(data: bytes) -> None:
    """Drive a camera through the steps of ``data``."""
    choices = Choices(data)
    camera = Camera(
        choices.pick(DIALECTS),
        choices.pick(QUIRKS),
        choices.pick(tuple(APPLICATIONS)),
        running=bool(choices.byte() & 1),
    )
    dialect = camera.machine.dialect
    camera.take(dialect.encode(m.Connect()))
    while choices:
        choices.pick(STEPS)(camera, choices)
        camera.deliver()
        if camera.machine.state in {State.FAILED, State.CLOSED}:
            return


def _bytes(camera: Camera, choices: Choices) -> None:
    camera.take(choices.take(choices.byte() % 64))


def _frame(camera: Camera, choices: Choices) -> None:
    header = camera.machine.dialect.header
    row = choices.pick(camera.machine.dialect.table)
    body = choices.take(choices.byte() % 32)
    camera.take(header.pack(row.message_id, len(body)) + body)


def _request(camera: Camera, choices: Choices) -> None:
    requests: tuple[m.Message, ...] = (
        m.Start(),
        m.Trigger(),
        m.Stop(),
        m.Connect(),
        m.Disconnect(),
        m.Query(),
        m.GetClock(),
        m.Reboot(),
        m.GetStatus(),
        m.ResetErrors(),
    )
    request = choices.pick(requests)
    if camera.dialect.has(type(request)):
        camera.take(camera.dialect.encode(request))


def _switch(camera: Camera, choices: Choices) -> None:
    application = choices.pick((*APPLICATIONS, 0, 99))
    camera.take(camera.machine.dialect.encode(m.SwitchApplication(application=application)))


def _clock(camera: Camera, choices: Choices) -> None:
    year, month, day, hour, minute, second = (choices.byte() for _ in range(6))
    message = m.SetClock(
        year=1970 + year * 40, month=month, day=day, hour=hour, minute=minute, second=second
    )
    camera.take(camera.machine.dialect.encode(message))


def _input(camera: Camera, choices: Choices) -> None:
    camera.take(camera.machine.dialect.encode(m.SetInput(data=choices.take(3))))


def _time(camera: Camera, choices: Choices) -> None:
    camera.device.tick(choices.pick(TIMES))


def _next(camera: Camera, choices: Choices) -> None:
    due = camera.device.next_event_in()
    if due is not None:
        camera.device.tick(due)


def _operator(camera: Camera, choices: Choices) -> None:
    device = camera.device
    actions: tuple[Callable[[], object], ...] = (
        device.start,
        device.stop,
        device.trigger,
        device.reboot,
        lambda: device.switch_application(choices.pick(tuple(APPLICATIONS)), running=True),
        lambda: device.set_condition(Status.SYSTEM_ERROR, bool(choices.byte() & 1)),
        lambda: device.set_condition(Status.OVERHEAT, bool(choices.byte() & 1)),
        lambda: device.set_endian(choices.pick(ENDIANS)),
    )
    choices.pick(actions)()


STEPS: tuple[Callable[[Camera, Choices], None], ...] = (
    _bytes,
    _frame,
    _request,
    _switch,
    _clock,
    _input,
    _time,
    _next,
    _operator,
)
