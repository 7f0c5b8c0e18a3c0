"""Parsers of what cameras and clients say: frames, lines, requests and packets."""

from __future__ import annotations

import functools
import random
import socket
import struct
import time
from urllib.parse import urlsplit

from smartcam.emulator._inside import HeardLine, LineCodec
from smartcam.emulator._line_camera import MAX_INPUT_BYTES
from smartcam.emulator._ticketed_camera import MAX_REQUEST_BYTES
from smartcam.exceptions import SmartCamError
from smartcam.frames._gige import gvcp as _gvcp
from smartcam.frames._gige import setup as _setup
from smartcam.frames._gige.assembler import Assembler
from smartcam.frames._gige.event_channel import decode_events
from smartcam.frames._gige.messages import cut_chunks
from smartcam.frames._streaming.rtp.assembling import MAX_ACCESS_UNIT_BYTES
from smartcam.frames._streaming.rtp.depacketizer import Depacketizer
from smartcam.frames._streaming.rtp.h264 import units
from smartcam.frames._streaming.rtp.h265 import H265Units
from smartcam.frames._streaming.rtp.h265 import size_in as size_in_h265
from smartcam.frames._streaming.rtp.jpeg import JpegUnits
from smartcam.frames._streaming.rtp.packets import RtpPacket, parse_rtcp
from smartcam.frames._streaming.rtp.parameters import picture_size
from smartcam.frames._streaming.rtsp.addresses import target_of, wish_of
from smartcam.frames._streaming.rtsp.authentication import _parts as digest_parts
from smartcam.frames._streaming.rtsp.messages import ROOM, RequestParser, RtspError, RtspRequest
from smartcam.frames._streaming.rtsp_client import answers as _answers
from smartcam.frames._streaming.rtsp_client.authorization import challenge_of
from smartcam.frames._streaming.rtsp_client.description import described, url_of
from smartcam.frames._streaming.rtsp_client.ways import options_of
from smartcam.frames._video import multipart as _multipart
from smartcam.frames._video import redirects as _redirects
from smartcam.gateway._lines import MAX_LINE_BYTES, NotWritableError, RequestReader
from smartcam.makes import PCIC
from smartcam.makes._ifm.chunks import ImageChunk, read_chunks
from smartcam.makes._ifm.layouts import check_layout
from smartcam.models import Status
from smartcam.protocols import (
    FramedDialect,
    LineDialect,
    LineMachine,
    LineRow,
    Machine,
    Role,
    Transport,
)
from smartcam.protocols import messages as m
from smartcam.protocols._bvs import B16, BID, THESIS
from smartcam.protocols._inside import DEFAULT_MAX_LENGTH, HANDBOOK
from smartcam.protocols._insight.answers import MAX_IMAGE_BYTES
from smartcam.protocols._insight.dialect import NATIVE
from smartcam.protocols._insight.machine import InSightMachine
from smartcam.protocols._insight.words import MAX_LINE_BYTES as MAX_INSIGHT_LINE_BYTES
from tests.budgets.parser import Make, Parser, drain, fill, fill_text, grown, streamed

UDP_BYTES = 65_507
"""Bytes of the largest datagram."""

# ---------------------------------------------------------------------- frames of the BVS


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
                room = machine.room()
                part = piece[at : at + len(room)]
                room[: len(part)] = part
                machine.filled(len(part), number * 0.1)
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
            magic + b"\xff" * 4,
            dialect.encode(m.ResultContainer(application=1, data=b"x" * 5000)),
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


# ---------------------------------------------------------------------- lines


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


_ROWS = (
    LineRow(m.Connect, "HELLO", m.ConnectAnswer, lambda _: m.ConnectAnswer(version=1)),
    LineRow(m.Query, "ASK", m.QueryAnswer, lambda said: m.QueryAnswer(application=int(said))),
    LineRow(
        m.SetClock,
        "C {year} {month} {day} {hour} END",
        m.SetClockAnswer,
        lambda _: m.SetClockAnswer(),
    ),
    LineRow(None, "", m.StatusReport, lambda said: {"S": m.StatusReport(status=Status(0))}[said]),
)
_LINES = LineDialect(name="lines", about="", source="", rows=_ROWS)


def _line_machine(pieces: list[bytes]) -> None:
    machine = LineMachine(_LINES, Role.CLIENT, Transport.TCP, max_length=0)
    machine.send(m.Connect())
    machine.receive_data(b"HELLO\n")
    for piece in pieces:
        machine.receive_data(piece)
        drain(machine.events())


def _ifm_machine(pieces: list[bytes]) -> None:
    dialect = PCIC.dialects["v3"]
    assert isinstance(dialect, LineDialect)
    machine = LineMachine(dialect, Role.CLIENT, Transport.TCP, max_length=DEFAULT_MAX_LENGTH)
    for piece in pieces:
        machine.receive_data(piece)
        drain(machine.events())


def _chunks(length: int) -> Make:
    """Return a maker of an answer with images of so many bytes each."""

    def make(size: int) -> bytes:
        one = ImageChunk(251, length, 1, 1, 0.0, bytes(length)).encoded
        data = one * max(1, size // len(one))
        return b"%09d" % len(data) + data

    return make


def _ifm_layout(element: str) -> Make:
    """Return a maker of a layout of equal elements."""

    def make(size: int) -> str:
        elements = element * max(1, size // len(element))
        return '{"layouter":"flexible","elements":[' + elements[:-1] + "]}"

    return make


def _line_codec() -> LineCodec:
    import re

    return LineCodec(
        "lines", _ROWS, line_end=b"\n", ends=re.compile(rb"\n"), max_line=4096, encoding="utf-8"
    )


def _line_server(pieces: list[bytes]) -> None:
    from smartcam.emulator._line_codec import LineServer

    codec = _line_codec()
    server = LineServer(codec, Transport.TCP, lambda *_: None)
    for piece in pieces:
        server.receive_data(piece)
        for heard in server.events():
            assert isinstance(heard, HeardLine)
            codec.decode(m.Sender.CLIENT, codec.to_frame(heard))


_TEXT_LINES: dict[str, Make] = {
    "short lines": fill(b"S\n"),
    "empty lines": fill(b"\n"),
    "a line without an end": fill(b"x"),
    "a line that nearly fits": lambda size: b"C" + b" 1" * (min(size, 4000) // 2) + b"\n",
    "half line ends": fill(b"\r"),
}

# ---------------------------------------------------------------------- RTSP


def _rtsp(pieces: list[bytes]) -> None:
    parser = RequestParser()
    for piece in pieces:
        parser.feed(piece)
        while (request := parser.next()) is not None:
            if isinstance(request, RtspRequest):
                try:
                    target_of(request.url)
                    wish_of(request.headers.get("transport", ""), "10.0.0.1")
                    digest_parts(request.headers.get("authorization", ""))
                except RtspError:
                    pass


class _Pieces(socket.socket):
    """A socket on which the pieces of an answer come, one at a time, and then the end."""

    def __init__(self, pieces: list[bytes]) -> None:
        super().__init__()
        self.pieces = iter(pieces)

    def recv(self, bufsize: int, flags: int = 0) -> bytes:
        return next(self.pieces, b"")


def _redirect(pieces: list[bytes]) -> None:
    asked = urlsplit("rtsp://user:word@10.0.0.1/live")
    with _Pieces(
        [one[at : at + 4096] for one in pieces for at in range(0, len(one), 4096)]
    ) as link:
        answer = _redirects._read(link, "10.0.0.1", time.monotonic() + 1e6, web=False)
    shown = answer.headers.get("www-authenticate", ())
    _redirects._authorization(asked, asked._replace(netloc="10.0.0.1"), "DESCRIBE", shown)
    for location in answer.headers.get("location", ()):
        _redirects.followed(asked.geturl(), location, answer.peer, "camera")


_ANSWER = b"RTSP/1.0 401 No\r\n"
_REDIRECT: dict[str, Make] = {
    "one header again and again": fill(b"a:b\r\n", _ANSWER, b"\r\n"),
    "a line without an end": fill(b"A"),
    "carriage returns": fill(b"\r", _ANSWER),
    "carriage returns in a head": fill(b"a:b\r\r\r\n", _ANSWER, b"\r\n"),
    "a body": lambda size: _ANSWER + b"Content-Length: %d\r\n\r\n" % size + bytes(size),
    "a digest of many": fill(
        b'a="b", ', _ANSWER + b'WWW-Authenticate: Digest realm="a", nonce="b", ', b"\r\n\r\n"
    ),
    "a quotation without an end": fill(
        b"\\", _ANSWER + b'WWW-Authenticate: Digest realm="a", nonce="', b"\r\n\r\n"
    ),
    "challenges": fill(b"WWW-Authenticate: Odd\r\n", _ANSWER, b"\r\n"),
    "a location of slashes": fill(b"/", _ANSWER + b"Location: ", b"\r\n\r\n"),
    "a location of dots": fill(b"../", _ANSWER + b"Location: ", b"\r\n\r\n"),
    "a location of users": fill(b"//a@", _ANSWER + b"Location: ", b"\r\n\r\n"),
    "locations": fill(b"Location: /a\r\n", _ANSWER, b"\r\n"),
}


def _robots(form: str, pieces: list[bytes]) -> None:
    reader = RequestReader(form)
    for piece in pieces:
        reader.feed(piece)


_ROBOTS: dict[str, Make] = {
    "requests": fill(b"12 TRIGGER 7\r\n"),
    "empty lines": fill(b"\r\n"),
    "a line without an end": fill(b"A"),
    "XML": fill(b"<Robot><Id>1</Id><Request>NEXT</Request></Robot>"),
    "XML without an end": fill(b"<Robot>"),
    "zeros": fill(b"\0"),
}

_RTSP: dict[str, Make] = {
    "requests": fill(b"OPTIONS rtsp://h/a RTSP/1.0\r\nCSeq: 1\r\n\r\n"),
    "one header again and again": fill(b"a:b\r\n", b"OPTIONS * RTSP/1.0\r\n"),
    "empty lines": fill(b"\r\n"),
    "a line without an end": fill(b"A"),
    "packets of a channel": fill(b"$\0\0\x01x"),
    "one packet of a channel": lambda size: (
        b"$\0" + min(size, 0xFFFF).to_bytes(2, "big") + bytes(size)
    ),
    "bodies": fill(b"SET_PARAMETER * RTSP/1.0\r\nCSeq: 1\r\nContent-Length: 4\r\n\r\nbody"),
    "a transport of many": fill(
        b"x" * 1 + b"," + b";" * 9, b"SETUP rtsp://h/a RTSP/1.0\r\nTransport: ", b"\r\n\r\n"
    ),
    "a digest of many": fill(
        b'a="b", ', b"OPTIONS * RTSP/1.0\r\nAuthorization: Digest ", b"\r\n\r\n"
    ),
}


def _rtsp_answers(pieces: list[bytes]) -> None:
    parser = _answers.AnswerParser()
    for piece in pieces:
        parser.feed(piece)
        while (came := parser.next()) is not None:
            if isinstance(came, _answers.ServerAnswer):
                options_of(came.header("transport"))
                challenge_of(came.headers.get("www-authenticate", ()))
                found = described(came.body)
                url_of(found.control, came.header("content-base"))
                drain(one.sets for one in found.tracks)


_OK = b"RTSP/1.0 200 OK\r\nCSeq: 1\r\n"


def _with_body(body: Make) -> Make:
    def make(size: int) -> bytes:
        made: bytes = body(size)
        return _OK + b"Content-Length: %d\r\n\r\n" % len(made) + made

    return make


_RTSP_ANSWERS: dict[str, Make] = {
    "answers": fill(_OK + b"\r\n"),
    "a header again and again": fill(b"a:b\r\n", _OK, b"\r\n"),
    "a line that goes on": fill(b" b\r\n", _OK + b"a:b\r\n", b"\r\n"),
    "carriage returns": fill(b"\r", _OK),
    "a line without an end": fill(b"A", _OK),
    "strays": fill(b"\xde"),
    "strays that look like packets": fill(b"$", b"\xde" * 20),
    "strays that look like answers": fill(b"RTSP/1.0 \n\n"),
    "packets of a channel": fill(b"$\0\0\x01x"),
    "one packet of a channel": lambda size: (
        b"$\0" + min(size, 0xFFFF).to_bytes(2, "big") + bytes(size)
    ),
    "a digest of many": fill(b'a="b", ', _OK + b"WWW-Authenticate: Digest ", b"\r\n\r\n"),
    "a quotation without an end": fill(
        b"\\", _OK + b'WWW-Authenticate: Digest realm="a', b"\r\n\r\n"
    ),
    "a transport of many": fill(b";", _OK + b"Transport: RTP/AVP", b"\r\n\r\n"),
    "a description of streams": _with_body(fill(b"m=video 0 RTP/AVP 96\r\n")),
    "a description of types": _with_body(
        fill(b"a=rtpmap:97 H264/90000\r\n", b"m=video 0 RTP/AVP 96 97\r\n")
    ),
    "a stream of many types": _with_body(fill(b" 96", b"m=video 0 RTP/AVP", b"\r\n")),
    "many parameters": _with_body(
        fill(b"a=b;", b"m=video 0 RTP/AVP 96\na=rtpmap:96 H264/90000\na=fmtp:96 ")
    ),
    "many sets": _with_body(
        fill(
            b"Zw==,",
            b"m=video 0 RTP/AVP 96\na=rtpmap:96 H264/90000\na=fmtp:96 sprop-parameter-sets=",
        )
    ),
}

# ---------------------------------------------------------------------- web cameras


def _web_pictures(pieces: list[bytes]) -> None:
    cutter = _multipart.PictureCutter()
    for piece in pieces:
        drain(cutter.feed(piece))


_SEGMENT = b"\xff\xe0\0\x04ab"
_SCANNED = b"\xff\xd8\xff\xda\0\x04ab"
_WEB_PICTURES: dict[str, Make] = {
    "small pictures": fill(b"\xff\xd8\xff\xd9"),
    "beginnings": fill(b"\xff\xd8"),
    "beginnings of segments": fill(b"\xff\xd8\xff\xe0\0"),
    "segments": fill(_SEGMENT, b"\xff\xd8"),
    "fill bytes": fill(b"\xff", b"\xff\xd8"),
    "markers alone": fill(b"\xff\xd0", b"\xff\xd8"),
    "a scan": fill(b"a", _SCANNED),
    "a scan of stuffed bytes": fill(b"\xff\0", _SCANNED),
    "a scan of fill bytes": fill(b"\xff", _SCANNED),
    "scans": fill(b"\xff\xda\0\x04ab", b"\xff\xd8"),
    "lengths": fill(b"Content-Length: 9\r\n"),
    "lengths before each": fill(b"Content-Length: 3\r\n\xff\xd8\xff"),
    "nothing": fill(b"a"),
}

# ---------------------------------------------------------------------- RTP


def _rtp(datagrams: list[bytes]) -> None:
    taker = Depacketizer()
    for number, datagram in enumerate(datagrams):
        for unit in taker.take(RtpPacket.parse(datagram), number * 1e-3):
            drain(units(unit.data) if unit.data else ())
        if not number % 50:  # as a timer does
            taker.missing()
            taker.waits_since()
    taker.give_up(1e9)


def _packet(sequence: int, payload: bytes, *, marker: bool = False, at: int = 1) -> bytes:
    return RtpPacket(marker, 96, sequence & 0xFFFF, at, 7, payload).pack()


def _shuffled(size: int) -> list[bytes]:
    count, mix = max(1, size // 16), random.Random(1)  # noqa: S311
    order = sorted(range(count), key=lambda one: one + mix.randrange(40))
    return [_packet(one, b"\x67abc", marker=True, at=one) for one in order]


_RTP: dict[str, Make] = {
    "a unit of many parts": grown(
        lambda count: [
            _packet(
                at,
                bytes((0x7C, 0x85 if not at else 0x45 if at == count - 1 else 0x05)) + b"p",
                marker=at == count - 1,
            )
            for at in range(count)
        ],
        15,
    ),
    "parts without an end": grown(
        lambda count: [
            _packet(at, b"\x7c\x85p" if not at else b"\x7c\x05p") for at in range(count)
        ],
        15,
    ),
    "every second packet": grown(
        lambda count: [_packet(2 * at, b"\x67a", marker=True, at=at) for at in range(count)], 14
    ),
    "the packets backwards": grown(
        lambda count: [_packet(count - at, b"\x67a", marker=True, at=at) for at in range(count)], 14
    ),
    "packets in any order": _shuffled,
    "packets far ahead": grown(
        lambda count: [_packet(2999 * at, b"\x67a", at=at) for at in range(count)], 14
    ),
    "another stream each time": grown(
        lambda count: [RtpPacket(True, 96, 0, 1, at, b"\x67a").pack() for at in range(count)], 14
    ),
    "many units in a packet": lambda size: [
        _packet(0, b"\x78" + b"\0\1\x67" * (size // 3), marker=True)
    ],
}


def _h265(datagrams: list[bytes]) -> None:
    taker = Depacketizer(64, H265Units(), wary=True)
    for number, datagram in enumerate(datagrams):
        for unit in taker.take(RtpPacket.parse(datagram), number * 1e-3):
            size_in_h265(unit.data)
    taker.give_up(1e9)


_SPS_265 = b"\x42\x01" + b"\x55" * 40
_H265: dict[str, Make] = {
    "a unit of many parts": grown(
        lambda count: [
            _packet(
                at,
                bytes((0x62, 1, 0xA6 if not at else 0x66 if at == count - 1 else 0x26)) + b"pp",
                marker=at == count - 1,
            )
            for at in range(count)
        ],
        17,
    ),
    "many units in a packet": lambda size: [
        _packet(0, b"\x60\x01" + b"\0\2\x40\x01" * (size // 4), marker=True)
    ],
    "parameters in each packet": grown(
        lambda count: [_packet(at, _SPS_265, at=at) for at in range(count)], 54
    ),
    "slices that begin": grown(
        lambda count: [
            _packet(at, b"\x26\x01\x80\0\0\1", marker=True, at=at) for at in range(count)
        ],
        18,
    ),
}


def _jpegs(datagrams: list[bytes]) -> None:
    taker = Depacketizer(64, JpegUnits(), wary=True)
    for number, datagram in enumerate(datagrams):
        drain(taker.take(RtpPacket.parse(datagram), number * 1e-3))
    taker.give_up(1e9)


_JPEGS: dict[str, Make] = {
    "pieces": grown(
        lambda count: [
            _packet(at, b"\0" + at.to_bytes(3, "big") + b"\1\x50\2\2p", marker=at == count - 1)
            for at in range(count)
        ],
        21,
    ),
    "pictures": grown(
        lambda count: [
            _packet(at, b"\0\0\0\0\1\x50\2\2p", marker=True, at=at) for at in range(count)
        ],
        21,
    ),
    "tables in each": grown(
        lambda count: [
            _packet(at, b"\0\0\0\0\1\xff\2\2\0\0\0\x80" + bytes(128) + b"p", marker=True, at=at)
            for at in range(count)
        ],
        153,
    ),
}


def _rtcp(kind: int, count: int, unit: bytes) -> Make:
    def make(size: int) -> bytes:
        body = unit * (max(size, len(unit)) // len(unit))
        body = body[: len(body) // 4 * 4][: 4 * 0xFFFF]
        return struct.pack("!BBH", 0x80 | count, kind, len(body) // 4) + body

    return make


_RTCP: dict[str, Make] = {
    "many packets": fill(struct.pack("!BBHI", 0x80, 201, 1, 1)),
    "names": _rtcp(202, 31, b"\0\0\0\1\1\2ab\0\0\0\0"),
    "items of a name": _rtcp(202, 1, b"\1\2ab"),
    "missing packets": _rtcp(205, 1, b"\0\1\xff\xff"),
    "packets of an unknown kind": fill(struct.pack("!BBH", 0x80, 210, 0)),
}

# ---------------------------------------------------------------------- GigE Vision


def _gvsp(datagrams: list[bytes]) -> None:
    assembler = Assembler(1 << 19, 576 - 28)
    for number, datagram in enumerate(datagrams):
        now = number * 1e-4
        assembler.feed(memoryview(datagram), len(datagram), now, now)
        assembler.pictures()
        assembler.take_lost()
        deadline = assembler.next_deadline()
        if deadline is not None and deadline <= now:
            assembler.handle_timeout(now)


def _gvsp_packet(kind: int, block: int, packet: int, data: bytes = b"") -> bytes:
    return struct.pack(">HHI", 0, block % 65535 + 1, kind << 24 | packet) + data


_FULL = bytes(540)
_GVSP: dict[str, Make] = {
    "packets in order": grown(
        lambda count: [_gvsp_packet(3, 0, at + 1, _FULL) for at in range(count)], 548
    ),
    "every second packet": grown(
        lambda count: [_gvsp_packet(3, 0, 2 * at + 1, _FULL) for at in range(count)], 548
    ),
    "the packets backwards": grown(
        lambda count: [_gvsp_packet(3, 0, count - at, _FULL) for at in range(count)], 548
    ),
    "a block for each packet": grown(
        lambda count: [_gvsp_packet(3, at, 2, _FULL) for at in range(count)], 548
    ),
    "trailers": grown(lambda count: [_gvsp_packet(2, at, 9, bytes(8)) for at in range(count)], 16),
}


def _gvcp_answer(datagram: bytes) -> None:
    answer = _gvcp.decode_ack(datagram)
    _gvcp.text(answer.payload)
    _gvcp.DeviceInfo.decode(answer.payload)


def _event(items: bytes, *, command: int = 0xC0, flags: int = 1) -> bytes:
    return struct.pack(">BBHHH", 0x42, flags, command, min(len(items), 0xFFFF), 1) + items


_EVENT_ITEM = struct.pack(">HHHHQ", 0, 0x9001, 0, 1, 2)
_EVENTS: dict[str, Make] = {
    "events": lambda size: _event(_EVENT_ITEM * (size // len(_EVENT_ITEM))),
    "one event with data": lambda size: _event(_EVENT_ITEM + bytes(size), command=0xC2),
    "long events": lambda size: _event(
        struct.pack(">HHHHQQ", 24, 0x9001, 0, 0, 1, 2) * (size // 24), flags=0x11
    ),
}


def _chunk_data(payload: bytes) -> None:
    cut_chunks(memoryview(payload))


_CHUNK_DATA: dict[str, Make] = {
    "one chunk": lambda size: bytes(size) + struct.pack(">II", 1, size),
    "empty chunks": lambda size: b"".join(struct.pack(">II", at, 0) for at in range(size // 8)),
    "zeros": fill(b"\0"),
}


def _ack(unit: bytes) -> Make:
    def make(size: int) -> bytes:
        body = unit * (size // len(unit))
        return struct.pack(">HHHH", 0, 3, min(len(body), 0xFFFF), 1) + body

    return make


# ---------------------------------------------------------------------- the table

WIRE: tuple[Parser, ...] = (
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
        "protocols._insight.answers.MAX_IMAGE, in hex",
    ),
    Parser(
        "In-Sight: lines",
        functools.partial(_insight_answers, m.GetStatus),
        streamed(_TEXT_LINES),
        MAX_INSIGHT_LINE_BYTES,
        "protocols._insight.words.MAX_LINE",
        size=1000,
    ),
    Parser(
        "ifm: frames of a device",
        _ifm_machine,
        streamed(
            {
                "results": fill(b"0000L000000010\r\n0000abcd\r\n"),
                "a long result": lambda size: b"0000L%09d\r\n0000" % (size + 6) + bytes(size),
                "notices": fill(b"0001L000000016\r\n0001000000000:\r\n"),
                "no frames": fill(b"9"),
            }
        ),
        DEFAULT_MAX_LENGTH,
        "protocols._framed.framing.DEFAULT_MAX_LENGTH",
        size=1000,
    ),
    Parser(
        "ifm: images",
        read_chunks,
        {
            "empty chunks": _chunks(0),
            "small chunks": _chunks(16),
            "one chunk": lambda size: _chunks(size)(size),
        },
        DEFAULT_MAX_LENGTH,
        "protocols._framed.framing.DEFAULT_MAX_LENGTH",
    ),
    Parser(
        "ifm: layouts of a client",
        check_layout,
        {
            "elements": _ifm_layout('{"type":"uint8","id":"n"},'),
            "records": _ifm_layout('{"type":"records","id":"r","elements":[]},'),
            "open brackets": fill_text("["),
            "a long text": _ifm_layout('{"type":"string","id":"s","value":"aaaaaaaaaaaaaaaa"},'),
        },
        MAX_REQUEST_BYTES,
        "emulator._ticketed_camera.MAX_REQUEST",
        refuses=(ValueError, RecursionError),
    ),
    Parser(
        "lines of a camera",
        _line_machine,
        streamed(_TEXT_LINES),
        1 << 15,
        "protocols._lines.READ_SIZE",
        size=1000,
    ),
    Parser(
        "lines of a client",
        _line_server,
        streamed(_TEXT_LINES),
        MAX_INPUT_BYTES,
        "emulator._line_camera.MAX_INPUT_BYTES",
        size=1000,
    ),
    Parser(
        "RTSP: requests",
        _rtsp,
        streamed(_RTSP),
        ROOM,
        "frames._streaming.rtsp.messages.ROOM",
        size=1000,
        refuses=(RtspError,),
    ),
    Parser(
        "robots: requests as text",
        functools.partial(_robots, "text"),
        streamed(_ROBOTS),
        MAX_LINE_BYTES,
        "gateway._lines.MAX_LINE_BYTES",
        size=1000,
        refuses=(NotWritableError,),
    ),
    Parser(
        "robots: requests as XML",
        functools.partial(_robots, "xml"),
        streamed(_ROBOTS),
        MAX_LINE_BYTES,
        "gateway._lines.MAX_LINE_BYTES",
        size=1000,
        refuses=(NotWritableError,),
    ),
    Parser(
        "RTP and H.264",
        _rtp,
        _RTP,
        MAX_ACCESS_UNIT_BYTES,
        "frames._streaming.rtp.assembling.MAX_ACCESS_UNIT_BYTES",
        short=4096,
    ),
    Parser(
        "RTP and H.265",
        _h265,
        _H265,
        MAX_ACCESS_UNIT_BYTES,
        "frames._streaming.rtp.assembling.MAX_ACCESS_UNIT_BYTES",
        short=4096,
    ),
    Parser(
        "RTP and JPEG",
        _jpegs,
        _JPEGS,
        MAX_ACCESS_UNIT_BYTES,
        "frames._streaming.rtp.assembling.MAX_ACCESS_UNIT_BYTES",
        short=4096,
    ),
    Parser(
        "RTSP: answers",
        _rtsp_answers,
        streamed(_RTSP_ANSWERS),
        _answers.MAX_HEAD_BYTES,
        "frames._streaming.rtsp_client.answers.MAX_HEAD_BYTES",
        size=1000,
    ),
    Parser(
        "web cameras: pictures",
        _web_pictures,
        streamed(_WEB_PICTURES),
        _multipart.MAX_PICTURE_BYTES,
        "frames._video.multipart.MAX_PICTURE_BYTES",
        size=1000,
    ),
    Parser(
        "redirects of a server",
        _redirect,
        streamed(_REDIRECT),
        _redirects.MAX_HEAD_BYTES,
        "frames._video.redirects.LARGEST_HEAD",
        size=1000,
        refuses=(SmartCamError, ValueError),
    ),
    Parser("RTCP", parse_rtcp, _RTCP, UDP_BYTES, "UDP: a datagram"),
    Parser(
        "H.264: units",
        lambda data: drain(units(data)),
        {
            "small units": fill(b"\0\0\1\x67a"),
            "start codes": fill(b"\0\0\1"),
            "zeros": fill(b"\0", b"\0\0\1\x67a"),
            "one unit": fill(b"a", b"\0\0\1\x65"),
        },
        MAX_ACCESS_UNIT_BYTES,
        "frames._streaming.rtp.assembling.MAX_ACCESS_UNIT_BYTES",
    ),
    Parser(
        "H.264: parameters",
        picture_size,
        {"zeros": fill(b"\0"), "ones": fill(b"\xff"), "a high profile": fill(b"\x55", b"\x67\x64")},
        255,
        "a slice of 255 bytes in frames._streaming.rtp.parameters",
        size=60,
    ),
    Parser(
        "GigE: packets of a stream",
        _gvsp,
        _GVSP,
        _setup.MAX_FRAME_BYTES,
        "frames._gige.setup.LARGEST_FRAME",
        size=1 << 15,
    ),
    Parser("GigE: events", decode_events, _EVENTS, UDP_BYTES, "UDP: a datagram"),
    Parser(
        "GigE: chunk data",
        _chunk_data,
        _CHUNK_DATA,
        _setup.MAX_FRAME_BYTES,
        "frames._gige.setup.LARGEST_FRAME",
    ),
    Parser(
        "GigE: answers",
        _gvcp_answer,
        {"text": _ack(b"a"), "zeros": _ack(b"\0"), "bytes that are no text": _ack(b"\xff")},
        UDP_BYTES,
        "UDP: a datagram",
    ),
)
