"""The two ends of a camera's wire, as plain as they can be written.

Made from the protocol's description (docs/protocol.md), not from the code: of the package it uses
the words (messages, errors) and no behaviour. Bytes that came are kept and read again from the
first one each time, so how they were cut cannot matter.
"""

from __future__ import annotations

import struct
from dataclasses import fields
from typing import Any, Literal, NamedTuple

from smartcam.exceptions import FrameError, MessageError
from smartcam.protocols import messages as m
from smartcam.protocols.machine import LinkEnded

__all__ = [
    "ANSWERED",
    "BODIES",
    "ENDED",
    "HEADER",
    "WIRES",
    "CameraEnd",
    "ClientEnd",
    "Wire",
    "framed",
    "packed",
]

# ---------------------------------------------------------------------- the wire


class Wire(NamedTuple):
    """A header: the magic number's bytes, and how many others the length field counts."""

    magic: bytes
    counted: int


WIRES = {
    "handbook": Wire(bytes.fromhex("50535642"), 0),
    "thesis": Wire(bytes.fromhex("42565350"), 4),
}
HEADER = 12

BODIES: dict[type[m.Message], tuple[int, str]] = {
    m.Connect: (0x01, ""),
    m.ConnectAnswer: (0x01, "I"),
    m.Disconnect: (0x02, ""),
    m.StatusReport: (0x12, "II"),
    m.ResultContainer: (0x20, "I*"),
    m.Query: (0x30, ""),
    m.QueryAnswer: (0x30, "I"),
    m.SwitchApplication: (0x31, "I"),
    m.SwitchAnswer: (0x31, "II"),
    m.GetClock: (0x32, ""),
    m.ClockAnswer: (0x32, "6I"),
    m.SetClock: (0x33, "6I"),
    m.SetInput: (0x34, "*"),
    m.SetSequenceNumber: (0x35, "I"),
    m.Trigger: (0x40, ""),
    m.Start: (0x41, ""),
    m.Stop: (0x42, ""),
    m.Reboot: (0x43, ""),
}
"""Id and body of each message; ``*`` stands for every byte to the end."""

ANSWERED = {0x01, 0x30, 0x31, 0x32}
SILENT = {0x02, 0x33, 0x34, 0x35, 0x40, 0x41, 0x42, 0x43}


class Frame(NamedTuple):
    message_id: int
    payload: bytes


def packed(wire: Wire, frame: Frame | tuple[int, bytes]) -> bytes:
    """Return a frame's bytes."""
    message_id, payload = frame
    return wire.magic + struct.pack("<II", len(payload) + wire.counted, message_id) + payload


def framed(message: m.Message) -> Frame:
    """Return a message as a frame."""
    if isinstance(message, m.UnknownMessage):
        return Frame(message.message_id, message.payload)
    message_id, form = BODIES[type(message)]
    values = [getattr(message, field.name) for field in fields(message)]
    tail = values.pop() if form.endswith("*") else b""
    return Frame(message_id, struct.pack("<" + form.rstrip("*"), *values) + tail)


def known(sender: m.Sender, message_id: int) -> type[m.Message] | None:
    """Return what an id means from that sender."""
    of_id = [one for one, (number, _) in BODIES.items() if number == message_id]
    return next((one for one in of_id if one.sender is sender), None)


def surplus(sender: m.Sender, frame: Frame) -> int:
    """Return how many bytes a body is too long; negative: too short."""
    message_type = known(sender, frame.message_id)
    if message_type is None:
        return 0
    form = BODIES[message_type][1]
    more = len(frame.payload) - struct.calcsize("<" + form.rstrip("*"))
    return min(more, 0) if form.endswith("*") else more


def meaning(sender: m.Sender, frame: Frame) -> m.Message:
    """Return the message of a frame whose body is long enough."""
    message_type = known(sender, frame.message_id)
    if message_type is None:
        return m.UnknownMessage(message_id=frame.message_id, payload=frame.payload)
    form = BODIES[message_type][1]
    layout = struct.Struct("<" + form.rstrip("*"))
    values: list[Any] = list(layout.unpack_from(frame.payload))
    if form.endswith("*"):
        values.append(frame.payload[layout.size :])
    named = dict(zip([field.name for field in fields(message_type)], values, strict=True))
    return message_type(**named)


class Reading(NamedTuple):
    """What a stream says so far.

    Attributes:
        frames: the whole frames.
        intact: how many of them stand before the first broken place; None: nothing is broken.
        breaks: places where no frame begins.
        skipped: bytes from there to where one may begin.
        rest: bytes of an unfinished frame.
    """

    frames: list[Frame]
    intact: int | None
    breaks: int
    skipped: int
    rest: int


def read_stream(wire: Wire, stream: bytes, limit: int) -> Reading:
    """Read a stream from its first byte; behind a broken place look for the next magic number."""
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
            following = next((p for p in places if _may_begin(wire, stream, p)), len(stream))
            breaks, skipped, at = breaks + 1, skipped + following - at, following
            continue
        end = at + HEADER + size
        if end > len(stream):
            break
        message_id = int.from_bytes(stream[at + 8 : at + 12], "little")
        found.append(Frame(message_id, stream[at + HEADER : end]))
        at = end
    return Reading(found, intact, breaks, skipped, len(stream) - at)


def read_datagram(wire: Wire, data: bytes, limit: int) -> Frame | None:
    """Return the frame that a datagram is, None if it is not exactly one."""
    reading = read_stream(wire, data, limit)
    alone = len(reading.frames) == 1 and not reading.breaks and not reading.rest
    return reading.frames[0] if alone else None


def _may_begin(wire: Wire, stream: bytes, at: int) -> bool:
    return wire.magic.startswith(stream[at : at + 4])


def _size_at(wire: Wire, stream: bytes, at: int) -> int | None:
    """Return what a header announces; -1 for a wrong magic number, None for too few bytes."""
    if not _may_begin(wire, stream, at):
        return -1
    if len(stream) < at + HEADER:
        return None
    return int.from_bytes(stream[at + 4 : at + 8], "little") - wire.counted


# ---------------------------------------------------------------------- the ends of a link

Phase = Literal["idle", "connecting", "connected", "disconnected", "closed", "failed"]
ENDED = ("closed", "failed")


class _End:
    """What both ends have: bytes that came, and what must have been counted."""

    hears: m.Sender

    def __init__(self, wire: Wire, *, datagrams: bool, limit: int) -> None:
        self.wire = wire
        self.datagrams = datagrams
        self.limit = limit
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
        self.noise, self.rest = (reading.breaks, reading.skipped), reading.rest
        intact = None if reading.intact is None else reading.intact - self.frames_received
        return reading.frames[self.frames_received :], intact

    def _count_sent(self, message: m.Message) -> bytes:
        data = packed(self.wire, framed(message))
        self.frames_sent += 1
        self.bytes_sent += len(data)
        return data


class ClientEnd(_End):
    """The client's end.

    Attributes:
        owed: ids of the answers that are owed to it.
        unknown: messages with an unknown id that came.
        unasked: answers that came and nobody had asked for.
        long: bodies that were longer than documented.
    """

    hears = m.Sender.CAMERA

    def __init__(self, wire: Wire, *, datagrams: bool, limit: int) -> None:
        super().__init__(wire, datagrams=datagrams, limit=limit)
        self.owed: set[int] = set()
        self.unknown = self.unasked = self.long = 0

    def may_say(self, message: m.Message, answered: bool | None = None) -> bool:
        """Whether the session allows it and no answer of its id is owed."""
        if self.phase in ENDED:
            return False
        in_session = self.phase in {"connecting", "connected"}
        anywhere = isinstance(message, (m.Connect, m.Disconnect))
        return (anywhere or in_session) and not (
            self._is_answered(framed(message).message_id, answered)
            and framed(message).message_id in self.owed
        )

    def say(self, message: m.Message, answered: bool | None = None) -> bytes:
        """Say what may be said; return its bytes."""
        message_id = framed(message).message_id
        if self._is_answered(message_id, answered):
            self.owed.add(message_id)
        if isinstance(message, m.Connect) and self.phase != "connected":
            self.phase = "connecting"
        if isinstance(message, m.Disconnect) and self.phase != "idle":
            self.phase = "disconnected"
        return self._count_sent(message)

    def hear(self, data: bytes) -> list[object]:
        """Take bytes; return the messages that the user hears, and the error that ends the link."""
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

    @staticmethod
    def _is_answered(message_id: int, answered: bool | None) -> bool:
        return message_id not in SILENT if answered is None else answered

    def _may_come(self, frame: Frame) -> bool:
        if surplus(self.hears, frame) < 0:
            return False
        if self.phase == "connecting":
            return known(self.hears, frame.message_id) is m.ConnectAnswer
        return self.phase in {"connected", "disconnected"}

    def _take(self, frame: Frame) -> list[object]:
        self.long += surplus(self.hears, frame) > 0
        message = meaning(self.hears, frame)
        if self.phase == "connecting":
            self.phase = "connected"
        was_owed = frame.message_id in self.owed
        self.owed.discard(frame.message_id)
        unknown = isinstance(message, m.UnknownMessage)
        by_itself = isinstance(message, (m.StatusReport, m.ResultContainer))
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

    def hear(self, data: bytes) -> list[m.Message]:
        """Take bytes; return the messages that count."""
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
        """Say something; return its bytes."""
        if isinstance(message, m.ConnectAnswer) and self.phase == "connecting":
            self.phase = "connected"
        return self._count_sent(message)

    def may_say(self, message: m.Message) -> bool:
        """Whether there is a session for it."""
        if self.phase == "connecting":
            return isinstance(message, m.ConnectAnswer)
        return self.phase in {"connected", "disconnected"}

    def _take(self, frame: Frame) -> m.Message | None:
        if surplus(self.hears, frame):
            return None
        message = meaning(self.hears, frame)
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
