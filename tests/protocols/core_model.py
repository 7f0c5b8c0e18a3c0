"""The two ends of a camera's wire, as plain as they can be written.

Made from the protocol's description (docs/protocol.md), not from the code: of the package it uses
the words (messages, errors) and no behaviour. Bytes that came are kept and read again from the
first one each time, so how they were cut cannot matter.
"""

from __future__ import annotations

import struct
from typing import Any, Literal, NamedTuple

from hypothesis import strategies as st

from smartcam.exceptions import FrameError, MessageError
from smartcam.models import Status
from smartcam.protocols import LinkEnded
from smartcam.protocols import messages as m
from tests.machines import EXAMPLES
from tests.protocols.camera_model import PROGRAMS

# ---------------------------------------------------------------------- the wire


class Body(NamedTuple):
    """A message's id and body: a letter for each field, and the fields' names.

    ``W`` is an integer as wide as the wire's, ``I`` one of four bytes, ``*`` every byte to the end.
    """

    message_id: int
    form: str = ""
    names: str = ""


_TIME = "year month day hour minute second"
_WIDE: dict[type[m.Message], Body] = {
    m.Connect: Body(0x01),
    m.ConnectAnswer: Body(0x01, "W", "version"),
    m.Disconnect: Body(0x02),
    m.StatusReport: Body(0x12, "WW", "status endian"),
    m.ResultContainer: Body(0x20, "W*", "application data"),
    m.Query: Body(0x30),
    m.QueryAnswer: Body(0x30, "W", "application"),
    m.SwitchApplication: Body(0x31, "W", "application"),
    m.SwitchAnswer: Body(0x31, "WW", "code application"),
    m.GetClock: Body(0x32),
    m.ClockAnswer: Body(0x32, "WWWWWW", _TIME),
    m.SetClock: Body(0x33, "WWWWWW", _TIME),
    m.SetInput: Body(0x34, "*", "data"),
    m.SetSequenceNumber: Body(0x35, "I", "number"),
    m.Trigger: Body(0x40),
    m.Start: Body(0x41),
    m.Stop: Body(0x42),
    m.Reboot: Body(0x43),
}
_NARROW = {**_WIDE, m.StatusReport: Body(0x12, "W", "status")}
_CODED = {
    **_NARROW,
    m.ConnectAnswer: Body(0x01, "WW", "code version"),
    m.QueryAnswer: Body(0x30, "WW", "code application"),
    m.ClockAnswer: Body(0x32, "WWWWWWW", f"code {_TIME}"),
}
_BID_ALONE: dict[type[m.Message], Body] = {
    m.DisconnectAnswer: Body(0x02, "W", "code"),
    m.GetStatus: Body(0x12),
    m.ResetErrors: Body(0x16),
    m.ResetErrorsAnswer: Body(0x16, "W", "code"),
    m.SetClockAnswer: Body(0x33, "W", "code"),
    m.SetInputAnswer: Body(0x34, "W", "code"),
    m.TriggerAnswer: Body(0x40, "W", "code"),
}
_BID = {
    **{kind: body for kind, body in _CODED.items() if body.message_id not in range(0x41, 0x44)},
    **_BID_ALONE,
}
del _BID[m.SetSequenceNumber]
_SC_SILENT = frozenset({0x02, 0x33, 0x34, 0x35, 0x40, 0x41, 0x42, 0x43})


class Wire(NamedTuple):
    """The form of frames, and their content."""

    magic: bytes  # the magic number's bytes
    counted: int  # how many bytes beside the body the length field counts
    word: Literal["I", "H"]  # ``struct`` letter of the header's and the bodies' integers
    bodies: dict[type[m.Message], Body]  # the messages
    silent: frozenset[int]  # ids of the requests that nobody waits for an answer to
    is_bid: bool = False  # the status word is that of BVS ID

    @property
    def header(self) -> int:
        """Bytes of a header."""
        return len(self.magic) + 2 * struct.calcsize(f"<{self.word}")

    @property
    def answered(self) -> set[int]:
        """Ids of the requests that are answered by a message of their own."""
        reports = {
            body.message_id for kind, body in self.bodies.items() if kind.sender is m.Sender.CAMERA
        }
        return reports - {0x02, 0x12, 0x20}

    def layout(self, kind: type[m.Message]) -> tuple[struct.Struct, list[str], bool]:
        """Return what reads a body's integers, the fields' names, and whether data follow."""
        _, form, names = self.bodies.get(kind) or {**_WIDE, **_BID_ALONE}[kind]
        code = "<" + form.rstrip("*").replace("W", self.word)
        return struct.Struct(code), names.split(), form.endswith("*")


WIRES = {
    "handbook": Wire(bytes.fromhex("50535642"), 0, "I", _WIDE, _SC_SILENT),
    "thesis": Wire(bytes.fromhex("42565350"), 4, "I", _WIDE, _SC_SILENT),
    "b16": Wire(b"", 0, "H", _NARROW, _SC_SILENT),
    "b16 with quirk code": Wire(b"", 0, "H", _CODED, _SC_SILENT),
    "bid": Wire(b"", 0, "H", _BID, frozenset({0x02}), is_bid=True),
}


class Frame(NamedTuple):
    message_id: int
    payload: bytes


def packed(wire: Wire, frame: Frame | tuple[int, bytes]) -> bytes:
    """Return a frame's bytes."""
    message_id, payload = frame
    numbers = (len(payload) + wire.counted, message_id)
    return (
        wire.magic
        + struct.pack(f"<2{wire.word}", *(numbers if wire.magic else numbers[::-1]))
        + payload
    )


def masked(wire: Wire, number: int) -> int:
    """Return a number that fits the header."""
    return number % (1 << 8 * struct.calcsize(f"<{wire.word}"))


def framed(wire: Wire, message: m.Message) -> Frame:
    """Return a message as a frame; one that the wire lacks as it is elsewhere."""
    if isinstance(message, (m.UnknownMessage, m.MalformedMessage)):
        return Frame(message.message_id, message.payload)
    kind = type(message)
    layout, names, has_data = wire.layout(kind)
    values = [getattr(message, name) for name in names]
    if isinstance(message, m.StatusReport) and wire.is_bid:
        values[0] = _bid_word(message.status)
    tail = values.pop() if has_data else b""
    message_id = (wire.bodies.get(kind) or {**_WIDE, **_BID_ALONE}[kind]).message_id
    return Frame(message_id, layout.pack(*values) + tail)


def _bid_word(status: Status) -> int:
    """Return the word on the wire: Waiting, Ready, Trigger Error, and what has no name here."""
    word = int(status) >> 32 & ~0x121
    word |= 0x001 if status & 0x200 else 0
    word |= 0x020 if not status & 0x010 else 0
    return word | (0x100 if status & 0x100 else 0)


def _bid_status(word: int) -> Status:
    status = 0x080 | (word & ~0x121) << 32
    status |= 0x200 if word & 0x001 else 0
    status |= 0x010 if not word & 0x020 else 0
    return Status(status | (0x100 if word & 0x100 else 0))


def known(wire: Wire, sender: m.Sender, message_id: int) -> type[m.Message] | None:
    """Return the meaning of an id from that sender."""
    of_id = [one for one, body in wire.bodies.items() if body.message_id == message_id]
    return next((one for one in of_id if one.sender is sender), None)


def _filled(wire: Wire, sender: m.Sender, frame: Frame) -> Frame:
    """Return a frame as it is taken: zeros stand behind a refusing code that comes alone.

    Not in answer to Connect, where two bytes are the version of another dialect.
    """
    message_type = known(wire, sender, frame.message_id)
    if message_type is None or len(frame.payload) != 2 or wire.bodies is _WIDE:
        return frame
    coded = "code" in wire.layout(m.ConnectAnswer)[1] and message_type is not m.ConnectAnswer
    layout, names, _ = wire.layout(message_type)
    if not coded or names[:1] != ["code"] or frame.payload in {b"\0\0", b"\2\0", b"\6\0"}:
        return frame
    return Frame(frame.message_id, frame.payload.ljust(layout.size, b"\0"))


def surplus(wire: Wire, sender: m.Sender, frame: Frame) -> int:
    """Return the number of bytes that a body is too long; negative: too short."""
    message_type = known(wire, sender, frame.message_id)
    if message_type is None:
        return 0
    frame = _filled(wire, sender, frame)
    layout, _, has_data = wire.layout(message_type)
    more = len(frame.payload) - layout.size
    return min(more, 0) if has_data else more


def meaning(wire: Wire, sender: m.Sender, frame: Frame) -> m.Message:
    """Return the message of a frame whose body is long enough."""
    message_type = known(wire, sender, frame.message_id)
    if message_type is None:
        return m.UnknownMessage(message_id=frame.message_id, payload=frame.payload)
    frame = _filled(wire, sender, frame)
    layout, names, has_data = wire.layout(message_type)
    values: list[Any] = list(layout.unpack_from(frame.payload))
    if has_data:
        values.append(frame.payload[layout.size :])
    named = dict(zip(names, values, strict=True))
    if message_type is m.StatusReport:
        named["status"] = (_bid_status if wire.is_bid else Status)(named["status"])
    return message_type(**named)


class Reading(NamedTuple):
    """The state of a stream so far."""

    frames: list[Frame]  # the whole frames
    # how many of them stand before the first broken place; None: nothing is broken
    intact: int | None
    breaks: int  # places where no frame begins
    skipped: int  # bytes from there to where one may begin
    rest: int  # bytes of an unfinished frame


def read_stream(wire: Wire, stream: bytes, limit: int) -> Reading:
    """Read a stream from its first byte; behind a broken place look for the next magic number.

    Without a magic number everything behind a broken place is skipped.
    """
    found: list[Frame] = []
    intact = None
    breaks = skipped = at = 0
    while True:
        size = _size_at(wire, stream, at)
        if size is None:
            break
        if not 0 <= size <= limit:
            intact = len(found) if intact is None else intact
            places = range(at + 1, len(stream))
            begins = (p for p in places if wire.magic and _may_begin(wire, stream, p))
            following = next(begins, len(stream))
            breaks, skipped, at = breaks + 1, skipped + following - at, following
            continue
        end = at + wire.header + size
        if end > len(stream):
            break
        message_id, _ = _numbers_at(wire, stream, at)
        found.append(Frame(message_id, stream[at + wire.header : end]))
        at = end
    return Reading(found, intact, breaks, skipped, len(stream) - at)


def read_datagram(wire: Wire, data: bytes, limit: int) -> Frame | None:
    """Return the frame that a datagram is, None if it is not exactly one."""
    reading = read_stream(wire, data, limit)
    alone = len(reading.frames) == 1 and not reading.breaks and not reading.rest
    return reading.frames[0] if alone else None


def _may_begin(wire: Wire, stream: bytes, at: int) -> bool:
    return wire.magic.startswith(stream[at : at + len(wire.magic)])


def _numbers_at(wire: Wire, stream: bytes, at: int) -> tuple[int, int]:
    """Return id and length field of a header."""
    numbers = struct.unpack_from(f"<2{wire.word}", stream, at + len(wire.magic))
    return (numbers[1], numbers[0]) if wire.magic else (numbers[0], numbers[1])


def _size_at(wire: Wire, stream: bytes, at: int) -> int | None:
    """Return a header's length; -1 for a wrong magic number, None for too few bytes."""
    if not _may_begin(wire, stream, at):
        return -1
    if len(stream) < at + wire.header:
        return None
    return _numbers_at(wire, stream, at)[1] - wire.counted


# ---------------------------------------------------------------------- the ends of a link

Phase = Literal["idle", "connecting", "connected", "disconnected", "closed", "failed"]
ENDED = ("closed", "failed")


class _End:
    """State of both ends: bytes that came, and the counts that must follow."""

    hears: m.Sender

    def __init__(self, wire: Wire, *, datagrams: bool, limit: int) -> None:
        self.wire = wire
        self.datagrams = datagrams  # one frame each, not a stream
        self.limit = limit  # most bytes of a body
        self.phase: Phase = "idle"
        self.stream = b""
        self.frames_received = 0
        self.frames_sent = 0
        self.bytes_received = 0
        self.bytes_sent = 0
        self.bad_frames = 0  # whole frames and datagrams that are ignored
        self.noise = (0, 0)  # broken places, and bytes skipped: each place counts at least once
        self.rest = 0

    def hear_end(self) -> list[object]:
        """The other side says no more."""
        if self.phase in ENDED:
            return []
        ended = LinkEnded(pending=self.rest)
        self.phase, self.rest = "closed", 0
        return [ended]

    def _cut(self, data: bytes) -> tuple[list[Frame], int | None]:
        """Return the frames that ``data`` completes, and behind how many of them it is broken."""
        self.bytes_received += len(data)
        if self.datagrams:
            frame = read_datagram(self.wire, data, self.limit)
            self.bad_frames += frame is None
            return [] if frame is None else [frame], None
        self.stream += data
        reading = read_stream(self.wire, self.stream, self.limit)
        if not self.wire.magic:  # what is skipped is what was there
            self.stream = self.stream[len(self.stream) - reading.rest :]
            self.noise, self.rest = (self.noise[0] + reading.breaks,) * 2, reading.rest
            return reading.frames, reading.intact
        self.noise, self.rest = (reading.breaks, reading.skipped), reading.rest
        intact = None if reading.intact is None else reading.intact - self.frames_received
        return reading.frames[self.frames_received :], intact

    def fits(self, message: m.Message) -> bool:
        """Return True if the wire has such a message, and room for its values."""
        raw = isinstance(message, (m.UnknownMessage, m.MalformedMessage))
        try:
            packed(self.wire, framed(self.wire, message))
        except struct.error:
            return False
        return raw or type(message) in self.wire.bodies

    def _count_sent(self, message: m.Message) -> bytes:
        data = packed(self.wire, framed(self.wire, message))
        self.frames_sent += 1
        self.bytes_sent += len(data)
        return data


class ClientEnd(_End):
    """The client's end."""

    hears = m.Sender.CAMERA

    def __init__(self, wire: Wire, *, datagrams: bool, limit: int) -> None:
        super().__init__(wire, datagrams=datagrams, limit=limit)
        self.owed: set[int] = set()  # ids of the answers that are owed to it
        # long: bodies that were longer than documented
        # unasked: answers that came and nobody had asked for
        # unknown: messages with an unknown id that came
        self.unknown = self.unasked = self.long = 0

    def may_say(self, message: m.Message, answered: bool | None = None) -> bool:
        """Return True if the session allows the message and no answer of its id is owed."""
        if self.phase in ENDED or not self.fits(message):
            return False
        in_session = self.phase in {"connecting", "connected"}
        anywhere = isinstance(message, (m.Connect, m.Disconnect))
        message_id = framed(self.wire, message).message_id
        return (anywhere or in_session) and not (
            self._is_answered(message_id, answered) and message_id in self.owed
        )

    def say(self, message: m.Message, answered: bool | None = None) -> bytes:
        """Send an allowed message; return its bytes."""
        message_id = framed(self.wire, message).message_id
        if self._is_answered(message_id, answered):
            self.owed.add(message_id)
        if isinstance(message, m.Connect) and self.phase != "connected":
            self.phase = "connecting"
        if isinstance(message, m.Disconnect) and self.phase != "idle":
            self.phase = "disconnected"
        return self._count_sent(message)

    def hear(self, data: bytes) -> list[object]:
        """Receive bytes; return the messages for the user, and the error that ends the link."""
        if self.phase in ENDED:
            return []
        frames, intact = self._cut(data)
        heard: list[object] = []
        for frame in frames[:intact]:
            self.frames_received += 1
            if self._may_come(frame):
                heard += self._take(frame)
            elif self.datagrams:
                self.bad_frames += 1
            else:
                return [*heard, self._fail(MessageError)]
        return heard if intact is None else [*heard, self._fail(FrameError)]

    def _is_answered(self, message_id: int, answered: bool | None) -> bool:
        return message_id not in self.wire.silent if answered is None else answered

    def _may_come(self, frame: Frame) -> bool:
        if surplus(self.wire, self.hears, frame) < 0:
            return False
        kind = known(self.wire, self.hears, frame.message_id)
        if kind is m.DisconnectAnswer:
            return True
        if self.phase == "connecting":
            return kind is m.ConnectAnswer
        return self.phase in {"connected", "disconnected"}

    def _take(self, frame: Frame) -> list[object]:
        self.long += surplus(self.wire, self.hears, frame) > 0
        message = meaning(self.wire, self.hears, frame)
        if self.phase == "connecting" and isinstance(message, m.ConnectAnswer):
            self.phase = "connected"
        was_owed = frame.message_id in self.owed
        self.owed.discard(frame.message_id)
        unknown = isinstance(message, m.UnknownMessage)
        by_itself = isinstance(message, (m.StatusReport, m.ResultContainer, m.DisconnectAnswer))
        self.unknown += unknown
        if was_owed or unknown or by_itself:
            return [message]
        self.unasked += 1
        return []

    def _fail(self, kind: type[Exception]) -> object:
        self.phase, self.rest = "failed", 0
        return kind


class CameraEnd(_End):
    """The camera's end: what is broken or out of place is ignored."""

    hears = m.Sender.CLIENT

    def __init__(self, wire: Wire, *, datagrams: bool, limit: int, tells: bool) -> None:
        super().__init__(wire, datagrams=datagrams, limit=limit)
        self.tells = tells  # bodies of a wrong length are told

    def hear(self, data: bytes) -> list[m.Message]:
        """Receive bytes; return the messages that count."""
        if self.phase in ENDED:
            return []
        frames, _ = self._cut(data)
        heard: list[m.Message] = []
        for frame in frames:
            self.frames_received += 1
            message = self._take(frame)
            if message is None:
                self.bad_frames += 1
            else:
                heard.append(message)
        return heard

    def say(self, message: m.Message) -> bytes:
        """Send a message; return its bytes."""
        if isinstance(message, m.ConnectAnswer) and self.phase == "connecting":
            self.phase = "connected"
        return self._count_sent(message)

    def may_say(self, message: m.Message) -> bool:
        """Return True if there is a session for the message."""
        if not self.fits(message):
            return False
        if isinstance(message, m.DisconnectAnswer):
            return self.phase not in ENDED
        if self.phase == "connecting":
            return isinstance(message, m.ConnectAnswer)
        return self.phase in {"connected", "disconnected"}

    def _take(self, frame: Frame) -> m.Message | None:
        if surplus(self.wire, self.hears, frame):
            if not self.tells or self.phase in {"idle", "disconnected"}:
                return None
            return m.MalformedMessage(message_id=frame.message_id, payload=frame.payload)
        message = meaning(self.wire, self.hears, frame)
        match message:
            case m.Connect() if self.phase != "connected":
                self.phase = "connecting"
            case m.Connect():
                pass
            case m.Disconnect() if self.phase != "idle":
                self.phase = "disconnected"
            case m.Disconnect():
                pass
            case _ if self.phase in {"idle", "disconnected"}:
                return None
        return message


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
    """A whole frame of any message, perhaps with bytes after its body."""

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
