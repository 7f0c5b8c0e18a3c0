"""Machines in the states that tests need, one message of each kind, and a dialect of 16 bits."""

from __future__ import annotations

from typing import Any

from smartcam.models import Status
from smartcam.protocols import messages as m
from smartcam.protocols.base import Dialect, MessageRow, Role, Transport
from smartcam.protocols.bvs import BVS, HANDBOOK, MESSAGES
from smartcam.protocols.framing import HeaderLayout
from smartcam.protocols.machine import TRANSITIONS, Event, Machine, ResultBurst, State

SIXTEEN = Dialect(
    name="sixteen",
    header=HeaderLayout(code="H", order="id, length"),
    word="H",
    table=tuple(MessageRow(*row) for row in MESSAGES),
    about="16 bit, no magic number, the message id first",
    source="made for the tests",
)
"""No dialect of a camera: the framing that a dialect without a magic number has."""

DIALECTS = (*BVS.dialects.values(), SIXTEEN)
"""Every dialect of ours, and the one made for the tests."""

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
    m.UnknownMessage(message_id=0x77, payload=b"what"),
)
"""One of each kind."""


def machine(
    role: Role,
    state: State = State.IDLE,
    *,
    dialect: Dialect = HANDBOOK,
    transport: Transport = Transport.TCP,
    **options: Any,
) -> Machine:
    """Return a machine that has been put into ``state``."""
    made = Machine(dialect, role, transport, **options)
    made.state = state
    return made


def client(
    dialect: Dialect = HANDBOOK, transport: Transport = Transport.TCP, **options: Any
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
    dialect: Dialect = HANDBOOK, transport: Transport = Transport.TCP, **options: Any
) -> Machine:
    """Return a camera in a session."""
    made = Machine(dialect, Role.CAMERA, transport, **options)
    made.receive_data(dialect.encode(m.Connect()))
    made.send(m.ConnectAnswer(version=1))
    made.data_to_send()
    assert made.events() == [m.Connect()]
    assert made.state is State.CONNECTED
    return made


def request_for(message: m.Message) -> m.Message | None:
    """Return an example of the request that ``message`` answers, None if it is no answer."""
    return next(
        (one for one in EXAMPLES if isinstance(one, m.Request) and one.answer is type(message)),
        None,
    )


def receiver_of(
    message: m.Message, dialect: Dialect = HANDBOOK, transport: Transport = Transport.TCP
) -> Machine:
    """Return a machine on the other side of ``message``, in a state where it may come."""
    sender = m.Sender.CLIENT if isinstance(message, m.Request) else m.Sender.CAMERA
    role = Role.CAMERA if sender is m.Sender.CLIENT else Role.CLIENT
    states = {State.CONNECTED, State.IDLE, State.CONNECTING}
    legal = [state for state in states if (state, sender, type(message)) in TRANSITIONS]
    if role is Role.CAMERA:
        return machine(role, legal[0], dialect=dialect, transport=transport)
    request = request_for(message)
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
            assert len(event.data) > 1
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
