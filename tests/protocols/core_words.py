"""What is said and what is broken in the histories of ``test_stateful_cores``."""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

from camera_model import PROGRAMS
from core_model import WIRES, Wire, framed, masked, packed
from hypothesis import strategies as st
from machines import EXAMPLES

from smartcam.protocols import messages as m

__all__ = [
    "IDS",
    "INSPECTIONS",
    "LIMIT",
    "MISFITS",
    "NOISE",
    "ORDERS",
    "PAYLOADS",
    "SESSIONS",
    "SETTINGS",
    "SURPRISES",
    "TIMES",
    "WORK",
    "noise",
]

LIMIT = 64
"""Bytes of payload that both machines take."""

TIMES = st.one_of(
    st.sampled_from([1, 10, 25, 30, 39, 40, 41, 50, 100, 150, 300]), st.integers(0, 120)
)
"""Milliseconds."""

# ---------------------------------------------------------------------- what is said

ORDERS: st.SearchStrategy[m.Message] = st.sampled_from(
    [
        *(m.Start(), m.Trigger(), m.Query(), m.Start(), m.Trigger(), m.GetClock(), m.Stop()),
        *(m.GetStatus(), m.ResetErrors()),  # of one dialect; elsewhere they must be refused
    ]
)
SESSIONS: st.SearchStrategy[m.Message] = st.sampled_from([m.Connect(), m.Connect(), m.Disconnect()])
_CLOCKS = st.builds(
    m.SetClock,
    year=st.sampled_from([0, 1970, 2016, 2023, 9999, 10000, 0xFFFFFFFF]),
    month=st.sampled_from([0, 2, 12, 13]),
    day=st.sampled_from([0, 1, 28, 30, 31]),
    hour=st.sampled_from([0, 23, 24]),
    minute=st.sampled_from([0, 59, 60]),
    second=st.sampled_from([0, 59, 60]),
)
SETTINGS: st.SearchStrategy[m.Message] = st.one_of(
    st.builds(
        m.SwitchApplication, application=st.sampled_from([*PROGRAMS, *PROGRAMS, 0, 6, 1 << 31])
    ),
    st.builds(
        m.SetSequenceNumber,
        number=st.sampled_from([0, 7, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF])
        | st.integers(0, 0xFFFFFFFF),
    ),
    st.builds(m.SetInput, data=st.binary(min_size=4, max_size=4) | st.binary(max_size=6)),
    _CLOCKS,
)
_INPUTS: st.SearchStrategy[m.Message] = st.builds(
    m.SetInput, data=st.binary(min_size=4, max_size=4)
)
INSPECTIONS: st.SearchStrategy[list[m.Message]] = st.one_of(
    st.sampled_from([[m.Trigger()], [m.Start(), m.Trigger()], [m.Trigger(), m.Trigger()]]),
    st.tuples(_INPUTS, st.just(m.Trigger())).map(list),
    st.lists(_INPUTS, max_size=3),
)
WORK: st.SearchStrategy[list[m.Message]] = st.one_of(
    st.lists(ORDERS | SETTINGS, min_size=1, max_size=4),
    st.sampled_from(
        [
            [m.Stop(), m.SwitchApplication(application=one), *then]
            for one in PROGRAMS
            for then in ([], [m.Start()])
        ]
    ),
    st.sampled_from(
        [
            [m.SetSequenceNumber(number=0xFFFFFFFF), m.Start(), m.Trigger()],
            [m.SetClock(year=2024, month=2, day=29, hour=23, minute=59, second=59), m.GetClock()],
        ]
    ),
)
MISFITS: tuple[m.Message, ...] = (
    m.SwitchApplication(application=-1),
    m.SwitchApplication(application=1 << 32),
    m.SetSequenceNumber(number=1 << 32),
    m.UnknownMessage(message_id=1 << 32, payload=b""),
    m.UnknownMessage(message_id=-1, payload=b""),
)

# ---------------------------------------------------------------------- what is broken

IDS = sorted({body.message_id for wire in WIRES.values() for body in wire.bodies.values()})
_SIZES = st.sampled_from([0, 1, 3, 4, 5, 8, 9, 24, 25, LIMIT, LIMIT + 1])
PAYLOADS = _SIZES.flatmap(lambda size: st.binary(min_size=size, max_size=size))


class Extra(NamedTuple):
    """A whole frame of any message, perhaps with something behind its body."""

    message: m.Message
    more: bytes


class Bomb(NamedTuple):
    """A header with any length field, the limit broken or not."""

    length: int
    message_id: int


class Magic(NamedTuple):
    """Some bytes and the beginning of a magic number."""

    before: bytes
    size: int


_UNKNOWN: st.SearchStrategy[m.Message] = st.builds(
    m.UnknownMessage,
    message_id=st.sampled_from([0x00, 0x21, 0x77, 0xFFFFFFFF]),
    payload=st.binary(max_size=6),
)
_REPORTS: st.SearchStrategy[m.Message] = st.sampled_from(
    [one for one in EXAMPLES if getattr(one, "sender", None) is m.Sender.CAMERA]
)
SURPRISES = st.builds(
    Extra, message=_UNKNOWN | _REPORTS, more=st.sampled_from([b"", b"", b"\0", b"more"])
)
NOISE: st.SearchStrategy[Any] = st.one_of(
    SURPRISES,
    st.builds(Extra, message=st.sampled_from(EXAMPLES), more=st.binary(max_size=2)),
    st.tuples(st.sampled_from([*IDS, 0x00, 0x77, 0xFFFFFFFF]), PAYLOADS),
    st.binary(min_size=1, max_size=20),
    st.builds(
        Bomb,
        length=st.sampled_from([0, 1, 3, LIMIT, LIMIT + 5, 1 << 20, 0xFFFFFFFF]),
        message_id=st.sampled_from(IDS),
    ),
    st.builds(Magic, before=st.binary(max_size=4), size=st.integers(0, 4)),
)


def noise(wire: Wire, what: Any) -> bytes:
    """Return the bytes of some noise."""
    match what:
        case bytes():
            return what
        case Extra(message=message, more=more):
            message_id, payload = framed(wire, message)
            return packed(wire, (masked(wire, message_id), payload + more))
        case Bomb(length=length, message_id=message_id):
            numbers = (masked(wire, length), message_id)
            numbers = numbers if wire.magic else numbers[::-1]
            return wire.magic + struct.pack(f"<2{wire.word}", *numbers)
        case Magic(before=before, size=size):
            return before + wire.magic[:size]
        case _:
            message_id, payload = what
            return packed(wire, (masked(wire, message_id), payload))
