"""Machines in the states that tests need, every dialect, and one message of each kind."""

from __future__ import annotations

import dataclasses
from typing import Any

from smartcam.models import Status
from smartcam.protocols import BVS, FramedDialect, Machine, Role, State, Transport
from smartcam.protocols import messages as m
from smartcam.protocols._inside import HANDBOOK, Event, ResultBurst

THESIS, B16, BID = (BVS.dialects[name] for name in ("thesis", "b16", "bid"))

MESSAGES = HANDBOOK.table
"""Every message of the dialects with a magic number."""

CODES = BID.codes
"""The result codes that the documents have."""

TRANSITIONS = Machine.transitions

CODE, NO_ID, BIG_ENDIAN_NUMBER = (
    B16.with_quirks([name]) for name in ("code", "no_id", "big_endian_number")
)

DIALECTS: tuple[FramedDialect, ...] = (HANDBOOK, THESIS, B16, BID, CODE, NO_ID, BIG_ENDIAN_NUMBER)
"""Every dialect of ours, and each with each of its quirks."""

BY_LABEL = {one.label: one for one in DIALECTS}
assert {*BVS.dialects.values()} <= {*DIALECTS}

CLOCK = {"year": 2016, "month": 6, "day": 25, "hour": 10, "minute": 11, "second": 12}

EXAMPLES: tuple[m.Message, ...] = (
    m.Connect(),
    m.ConnectAnswer(version=1),
    m.Disconnect(),
    m.StatusReport(status=Status.RUNNING | Status.WAITING_FOR_TRIGGER),
    m.ResultContainer(application=21, data=b"Hello World"),
    m.Query(),
    m.QueryAnswer(application=21),
    m.SwitchApplication(application=5),
    m.SwitchAnswer(code=0, application=5),
    m.GetClock(),
    m.ClockAnswer(**CLOCK),
    m.SetClock(**CLOCK),
    m.SetInput(data=b"input"),
    m.SetSequenceNumber(number=7),
    m.Trigger(),
    m.Start(),
    m.Stop(),
    m.Reboot(),
    m.DisconnectAnswer(),
    m.GetStatus(),
    m.ResetErrors(),
    m.ResetErrorsAnswer(),
    m.SetClockAnswer(code=0x10),
    m.SetInputAnswer(),
    m.TriggerAnswer(code=0x16),
    m.UnknownMessage(message_id=0x77, payload=b"what"),
)
"""One of each kind; no dialect has them all."""


def carried(dialect: FramedDialect, message: m.Message) -> m.Message:
    """Return a message as it comes out of a dialect: what it leaves out has its default."""
    names = dialect.fields(type(message))
    defaults = {one.name: one.default for one in dataclasses.fields(message)}
    left_out = {
        name: defaults[name] for name, _ in m.wire_fields(type(message)) if name not in names
    }
    return dataclasses.replace(message, **left_out)


def examples(dialect: FramedDialect) -> list[m.Message]:
    """Return one message of each kind that a dialect has, and one of an id that it has not."""
    return [
        *(carried(dialect, one) for one in EXAMPLES[:-1] if dialect.has(type(one))),
        EXAMPLES[-1],
    ]


EVERYTHING = [(dialect, message) for dialect in DIALECTS for message in examples(dialect)]
"""Every message of every dialect."""


def label(value: object) -> str:
    """Return what a test's parameter is called."""
    return value.label if isinstance(value, FramedDialect) else type(value).__name__


def machine(
    role: Role,
    state: State = State.IDLE,
    *,
    dialect: FramedDialect = HANDBOOK,
    transport: Transport = Transport.TCP,
    **options: Any,
) -> Machine:
    """Return a machine that has been put into ``state``."""
    made = Machine(dialect, role, transport, **options)
    made.state = state
    return made


def client(
    dialect: FramedDialect = HANDBOOK, transport: Transport = Transport.TCP, **options: Any
) -> Machine:
    """Return a client in a session that it made by its own words."""
    made = Machine(dialect, Role.CLIENT, transport, **options)
    made.send(m.Connect())
    made.receive_data(dialect.encode(m.ConnectAnswer(version=1)))
    made.data_to_send()
    assert made.events() == [m.ConnectAnswer(version=1)]
    assert made.state is State.CONNECTED
    return made


def camera(
    dialect: FramedDialect = HANDBOOK, transport: Transport = Transport.TCP, **options: Any
) -> Machine:
    """Return a camera in a session."""
    made = Machine(dialect, Role.CAMERA, transport, **options)
    made.receive_data(dialect.encode(m.Connect()))
    made.send(m.ConnectAnswer(version=1))
    made.data_to_send()
    assert made.events() == [m.Connect()]
    assert made.state is State.CONNECTED
    return made


def request_for(message: m.Message, dialect: FramedDialect = HANDBOOK) -> m.Message | None:
    """Return an example of the request that ``message`` answers, None if it is no answer."""
    requests = (one for one in examples(dialect) if isinstance(one, m.Request))
    return next((one for one in requests if one.answer is type(message)), None)


def receiver_of(
    message: m.Message, dialect: FramedDialect = HANDBOOK, transport: Transport = Transport.TCP
) -> Machine:
    """Return a machine on the other side of ``message``, in a state where it may come."""
    sender = m.Sender.CLIENT if isinstance(message, m.Request) else m.Sender.CAMERA
    role = Role.CAMERA if sender is m.Sender.CLIENT else Role.CLIENT
    states = {State.CONNECTED, State.IDLE, State.CONNECTING}
    legal = [state for state in states if (state, sender, type(message)) in TRANSITIONS]
    if role is Role.CAMERA:
        return machine(role, legal[0], dialect=dialect, transport=transport)
    request = request_for(message, dialect)
    if isinstance(request, m.Connect):
        made = machine(role, dialect=dialect, transport=transport)
    else:
        made = client(dialect, transport)
    if request is not None:
        made.send(request)
    return made


def one_by_one(events: list[Event]) -> list[Event]:
    """Return events with the containers of each burst in its place."""
    spread: list[Event] = []
    for event in events:
        if isinstance(event, ResultBurst):
            assert event.data
            spread += event
        else:
            spread.append(event)
    return spread


def feed(made: Machine, *chunks: bytes) -> list[Event]:
    """Give bytes to a machine and return all events."""
    events: list[Event] = []
    for chunk in chunks:
        made.receive_data(chunk)
        events += one_by_one(made.events())
    return events
