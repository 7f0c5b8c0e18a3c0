"""Parsers of the room for :mod:`tests.budgets`, with the hardest inputs."""

from __future__ import annotations

import functools
import struct

from smartcam.models import Status
from smartcam.protocols import FramedDialect, LineDialect, LineMachine, Machine, Role, Transport
from smartcam.protocols import messages as m
from smartcam.protocols._inside import DEFAULT_MAX_LENGTH, HANDBOOK
from tests.budgets.inputs import LINE_ROWS, TEXT_LINES, UDP_BYTES
from tests.budgets.parser import Make, Parser, drain, fill, streamed
from tests.machines import B16, BID, THESIS
from tests.protocols.inside import MAX_IMAGE_BYTES, MAX_LINE_BYTES, NATIVE, InSightMachine


def _session(dialect: FramedDialect, role: Role, transport: Transport, pieces: list[bytes]) -> None:
    machine = Machine(dialect, role, transport)
    if role is Role.CLIENT:
        machine.send(m.Connect())
        machine.receive_data(dialect.encode(m.ConnectAnswer(version=1)))
    else:
        machine.receive_data(dialect.encode(m.Connect()))
        machine.send(m.ConnectAnswer(version=1))
    for number, piece in enumerate(pieces):
        if transport is Transport.UDP:
            machine.receive_data(piece)
        else:
            at = 0
            while at < len(piece):
                room = machine.get_buffer()
                part = piece[at : at + len(room)]
                room[: len(part)] = part
                machine.buffer_updated(len(part), number * 0.1)
                at += len(part)
        drain(machine.events())


def _written(dialect: FramedDialect, role: Role, pieces: list[bytes]) -> None:
    """Hand pieces to a machine as programs do that read for themselves."""
    machine = Machine(dialect, role, Transport.TCP)
    for piece in pieces:
        machine.receive_data(piece)
        drain(machine.events())


def _frames(dialect: FramedDialect) -> dict[str, Make]:
    header = dialect.header
    magic = header.magic or b"\0"
    status = dialect.encode(m.StatusReport(status=Status(0)))
    result = dialect.encode(m.ResultContainer(application=1, data=b"x" * 9))
    return {
        "statuses": fill(status),
        "results of one byte more each": lambda size: b"".join(
            dialect.encode(m.ResultContainer(application=1, data=b"x" * (at % 7)))
            for at in range(max(1, size // 24))
        ),
        "results": fill(result),
        "one result": lambda size: dialect.encode(
            m.ResultContainer(application=1, data=b"x" * min(size, 65_000))
        ),
        "a result of magic numbers": lambda size: dialect.encode(
            m.ResultContainer(application=1, data=magic * (min(size, 65_000) // len(magic)))
        ),
        "magic numbers": fill(magic),
        "a large frame, and magic numbers": fill(
            magic + b"\xff" * 4, dialect.encode(m.ResultContainer(application=1, data=b"x" * 5000))
        ),
        "frames of unknown ids": fill(header.pack(0x77, 0)),
        "one byte": fill(b"\xff"),
    }


def _framed(dialect: FramedDialect) -> list[Parser]:
    rows = []
    for role, who in ((Role.CLIENT, "camera"), (Role.CAMERA, "client")):
        rows.append(
            Parser(
                f"frames of a {who}, {dialect.name}",
                functools.partial(_session, dialect, role, Transport.TCP),
                streamed(_frames(dialect)),
                DEFAULT_MAX_LENGTH,
                "protocols._framed.framing.DEFAULT_MAX_LENGTH",
                size=1 << 14,
            )
        )
    return rows


def _datagrams(kinds: dict[str, Make]) -> dict[str, Make]:
    def cut(make: Make) -> Make:
        return lambda size: [make(2000)] * max(1, size // 2000)

    return {f"datagrams of {kind}": cut(make) for kind, make in kinds.items()}


def _dump(data: bytes) -> None:
    """Read frames as ``smartcam decode`` does."""
    from smartcam.protocols._inside import Framer, view_fields

    frames = bytes.fromhex(data.decode("ascii"))
    framer = Framer(HANDBOOK.header, len(frames))
    framer.feed(frames)
    while (frame := framer.next_frame()) is not None:
        HANDBOOK.decode(m.Sender.CAMERA, frame)
        view_fields(HANDBOOK, m.Sender.CAMERA, HANDBOOK.encode_frame(frame))


def _hex(make: Make) -> Make:
    return lambda size: make(size // 2).hex().encode()


def _insight_answers(kind: type[m.Message], pieces: list[bytes]) -> None:
    machine = InSightMachine(NATIVE, Role.CLIENT, Transport.TCP, max_length=DEFAULT_MAX_LENGTH)
    machine.send(m.Connect())
    machine.receive_data(b"User: Password: User Logged In\r\n")
    machine.send(kind())
    for piece in pieces:
        machine.receive_data(piece)
        drain(machine.events())


def _bitmap_lines(size: int) -> bytes:
    data = b"BM" + struct.pack("<I", size // 2) + bytes(max(0, size // 2 - 6))
    digits = data.hex().upper().encode()
    lines = b"".join(digits[at : at + 80] + b"\r\n" for at in range(0, len(digits), 80))
    return b"1\r\n" + str(len(data)).encode() + b"\r\n" + lines + b"0000\r\n"


def _short_lines(size: int) -> bytes:
    data = b"BM" + struct.pack("<I", size // 4 + 6) + bytes(size // 4)
    return b"1\r\n9\r\n" + b"".join(b"%02X\r\n" % one for one in data)


_LINES = LineDialect(name="lines", about="", source="", rows=LINE_ROWS)


def _line_machine(pieces: list[bytes]) -> None:
    machine = LineMachine(_LINES, Role.CLIENT, Transport.TCP, max_length=0)
    machine.send(m.Connect())
    machine.receive_data(b"HELLO\n")
    for piece in pieces:
        machine.receive_data(piece)
        drain(machine.events())


PARSERS: tuple[Parser, ...] = (
    *(row for dialect in (HANDBOOK, THESIS, B16, BID) for row in _framed(dialect)),
    Parser(
        "datagrams of a camera",
        functools.partial(_session, HANDBOOK, Role.CLIENT, Transport.UDP),
        _datagrams(_frames(HANDBOOK)),
        UDP_BYTES,
        "UDP: a datagram",
        size=8000,
    ),
    Parser(
        "frames that a program hands over",
        functools.partial(_written, HANDBOOK, Role.CAMERA),
        streamed(_frames(HANDBOOK)),
        DEFAULT_MAX_LENGTH,
        "protocols._framed.framing.DEFAULT_MAX_LENGTH",
        size=1 << 14,
    ),
    Parser(
        "hex dumps of frames",
        _dump,
        {
            kind: _hex(make)
            for kind, make in _frames(HANDBOOK).items()
            if kind in ("statuses", "results", "one result", "one byte", "magic numbers")
        },
        1 << 30,
        "memory: the file is the user's",
        short=300,
    ),
    Parser(
        "In-Sight: images",
        functools.partial(_insight_answers, m.ReadImage),
        streamed(
            {
                "a bitmap": _bitmap_lines,
                "lines of two digits": _short_lines,
                "a line without an end": fill(b"A", b"1\r\n9\r\n"),
                "empty lines": fill(b"\r\n", b"1\r\n9\r\n"),
            }
        ),
        2 * MAX_IMAGE_BYTES,
        "protocols._insight.answers.MAX_IMAGE_BYTES, in hex",
    ),
    Parser(
        "In-Sight: lines",
        functools.partial(_insight_answers, m.GetStatus),
        streamed(TEXT_LINES),
        MAX_LINE_BYTES,
        "protocols._insight.words.MAX_LINE_BYTES",
        size=1000,
    ),
    Parser(
        "lines of a camera",
        _line_machine,
        streamed(TEXT_LINES),
        1 << 15,
        "protocols._lines.MAX_READ_BYTES",
        size=1000,
    ),
)
