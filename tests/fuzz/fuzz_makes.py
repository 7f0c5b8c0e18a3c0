"""Target ``makes``: what a device of another make says, in any pieces, to a machine with questions.

Input: dialect, how many questions are open, sizes of pieces, then the stream. A twin gets the same
stream at once: it has to tell the same. No more containers are a trigger's than triggers went out,
and what waits has a bound.
"""

from __future__ import annotations

import contextlib

from smartcam.exceptions import FrameError
from smartcam.makes import EmulatedIfm, EmulatedIv3, EmulatedSr
from smartcam.protocols import LineDialect, LineMachine, LinkFailed, Role, State, Transport
from smartcam.protocols import messages as m
from tests.fuzz.fuzz_input import Choices
from tests.makes.cameras import parse_pictures

PARAMETERS: tuple[dict[str, str], ...] = ({}, {"trigger": "async"})
DIALECTS = (
    *(
        one.with_parameters(two)
        for one in EmulatedIfm.protocol.dialects.values()
        for two in PARAMETERS
    ),
    *EmulatedIv3.protocol.dialects.values(),
    *EmulatedSr.protocol.dialects.values(),
)
QUESTIONS: tuple[m.Request, ...] = (
    m.Trigger(),
    m.Query(),
    m.GetStatus(),
    m.SwitchApplication(application=7),
    m.ReadImage(),
    m.EndTrigger(),
)
GREETINGS = (
    b"1000L000000020\r\n1000IFM ELECTRONIC\r\n1001L000000007\r\n1001*\r\n",
    b"L000000016\r\nIFM ELECTRONIC\r\nL000000003\r\n*\r\n",
    b"1000IFM ELECTRONIC\r\n1001*\r\n",
    b"IFM ELECTRONIC\r\n*\r\n",
    b"RT,00000,NG\r",
    b"OK,ERRSTAT,NONE\r",
)
MAX_LENGTH = 4096


def check(data: bytes) -> None:
    """Feed a stream to a machine, in pieces and at once, and compare what is told."""
    choices = Choices(data)
    dialect = choices.pick(DIALECTS)
    asked = [choices.pick(QUESTIONS) for _ in range(choices.byte() % 4)]
    sizes = choices.take(choices.byte() % 8)
    greeting = choices.pick((*GREETINGS, b""))
    stream = choices.rest()
    assert isinstance(dialect, LineDialect)
    whole = _told(dialect, greeting, asked, [stream])
    torn = _told(dialect, greeting, asked, _pieces(stream, sizes))
    assert whole == torn, f"{whole} at once, {torn} in pieces {sizes!r}"
    with contextlib.suppress(FrameError):
        parse_pictures(stream)


def _pieces(stream: bytes, sizes: bytes) -> list[bytes]:
    pieces: list[bytes] = []
    for size in sizes:
        pieces.append(stream[: size % 16 + 1])
        stream = stream[size % 16 + 1 :]
    return [*pieces, stream]


def _told(
    dialect: LineDialect, greeting: bytes, asked: list[m.Request], pieces: list[bytes]
) -> list[str]:
    """Return what a machine tells of pieces, with its questions open if a session was made."""
    machine = LineMachine(dialect, Role.CLIENT, Transport.TCP, max_length=MAX_LENGTH)
    machine.send(m.Connect())
    machine.receive_data(greeting)
    told = [repr(event) for event in machine.events()]
    triggers = owned = 0
    for request in dict.fromkeys(asked):
        if machine.state is State.CONNECTED and dialect.has(type(request)):
            machine.send(request)
            triggers += isinstance(request, m.Trigger)
    for piece in pieces:
        machine.receive_data(piece)
        for event in machine.events():
            told.append(
                type(event.error).__name__ if isinstance(event, LinkFailed) else repr(event)
            )
            owned += isinstance(event, m.ResultContainer) and event.requested is True
        assert len(machine.unfinished_bytes) <= 2 * MAX_LENGTH + dialect.max_line
    assert owned <= triggers, "a container is a trigger's that nobody has sent"
    return told
