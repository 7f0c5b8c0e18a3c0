"""Parsers of the room for :mod:`tests.budgets`, with the hardest inputs."""

from __future__ import annotations

import asyncio
import contextlib
import io
import random
import socket
import struct
import time
import zipfile
from urllib.parse import urlsplit

from smartcam.exceptions import SmartCamError
from smartcam.frames._inside import GenicamFeatures, jpeg_header, random_access_point, read_bitmap
from tests.budgets.inputs import UDP_BYTES
from tests.budgets.parser import Make, Parser, drain, fill, fill_text, grown, streamed
from tests.frames.inside import (
    MAX_ACCESS_UNIT_BYTES,
    MAX_MESSAGE_BYTES,
    Assembler,
    Depacketizer,
    H265PayloadFormat,
    JpegPayloadFormat,
    RequestParser,
    RtpPacket,
    RtspError,
    RtspRequest,
    challenge_of,
    cut_chunks,
    decode_events,
    decode_jpeg,
    parse_description,
    parse_rtcp,
    picture_size,
    requested_transport,
    target_of,
    transport_options,
    units,
    url_of,
)
from tests.frames.inside import MAX_PIXEL_BYTES as MAX_BITMAP
from tests.frames.inside import _digest_parameters as digest_parameters
from tests.frames.inside import answers as _answers
from tests.frames.inside import description as _description
from tests.frames.inside import expressions as _expressions
from tests.frames.inside import gvcp as _gvcp
from tests.frames.inside import multipart as _multipart
from tests.frames.inside import redirects as _redirects
from tests.frames.inside import setup as _setup
from tests.frames.inside import size_in as size_in_h265


def _rtsp(pieces: list[bytes]) -> None:
    parser = RequestParser()
    for piece in pieces:
        parser.feed(piece)
        while (request := parser.next()) is not None:
            if isinstance(request, RtspRequest):
                try:
                    target_of(request.url)
                    requested_transport(request.headers.get("transport", ""), "10.0.0.1")
                    digest_parameters(request.headers.get("authorization", ""))
                except RtspError:
                    pass


class _Pieces(socket.socket):
    """A socket that gives the pieces of an answer one at a time, and then the end."""

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
        answer = _redirects._read_answer(link, "10.0.0.1", time.monotonic() + 1e6, is_http=False)
    shown = answer.headers.get("www-authenticate", ())
    _redirects._authorization(asked, asked._replace(netloc="10.0.0.1"), "DESCRIBE", shown)
    for location in answer.headers.get("location", ()):
        _redirects.checked_redirect(asked.geturl(), location, answer.peer, "camera")


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
                transport_options(came.header("transport"))
                challenge_of(came.headers.get("www-authenticate", ()))
                found = parse_description(came.body)
                url_of(found.control, came.header("content-base"))
                drain(one.parameter_sets for one in found.tracks)


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


def _rtp(datagrams: list[bytes]) -> None:
    taker = Depacketizer()
    for number, datagram in enumerate(datagrams):
        for unit in taker.add_packet(RtpPacket.parse(datagram), number * 1e-3):
            drain(units(unit.data) if unit.data else ())
        if not number % 50:  # as a timer does
            taker.missing_sequences()
            taker.waiting_since()
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
    taker = Depacketizer(64, H265PayloadFormat(), verify_markers=True)
    for number, datagram in enumerate(datagrams):
        for unit in taker.add_packet(RtpPacket.parse(datagram), number * 1e-3):
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
    taker = Depacketizer(64, JpegPayloadFormat(), verify_markers=True)
    for number, datagram in enumerate(datagrams):
        drain(taker.add_packet(RtpPacket.parse(datagram), number * 1e-3))
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


def _described(inner: Make) -> Make:
    head, tail = "<RegisterDescription>", "</RegisterDescription>"
    return lambda size: f"{head}{inner(size)}{tail}".encode()


_DESCRIPTIONS: dict[str, Make] = {
    kind: _described(make)
    for kind, make in {
        "text in pieces": fill_text("1" * 36 + "<x/>", '<Integer Name="a">', "</Integer>"),
        "text in pieces by comments": fill_text("1<!---->", '<Integer Name="a">', "</Integer>"),
        "text in pieces by instructions": fill_text("1<?a?>", '<Integer Name="a">', "</Integer>"),
        "text in pieces by sections": fill_text(
            "<![CDATA[1]]>", '<Integer Name="a">', "</Integer>"
        ),
        "text in pieces by entities": fill_text("&#49;", '<Integer Name="a">', "</Integer>"),
        "a long text": fill_text("1 ", '<Integer Name="a">', "</Integer>"),
        "elements": fill_text('<Integer Name="n{}"/>'),
        "one name again and again": fill_text('<Integer Name="n"/>'),
        "attributes": fill_text('a{}="" ', "<Integer ", "/>"),
        "a long attribute": fill_text("a", '<Integer Name="', '"/>'),
        "a long comment": fill_text("a", "<!--", "-->"),
        "nested elements": fill_text("<Group>"),
        "namespaces": fill_text('<a:Integer xmlns:a="{}"/>'),
        "entries of a structure": lambda size: (
            "<StructReg>"
            + "<Sign/>" * (size // 14)
            + "".join(f'<StructEntry Name="e{n}"/>' for n in range(size // 50))
            + "</StructReg>"
        ),
    }.items()
}


def _zipped(make: Make) -> Make:
    def made(size: int) -> bytes:
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("a.xml", make(size))
        return packed.getvalue()

    return made


def _many_files(size: int) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for number in range(max(1, size // 110)):
            archive.writestr(f"{number}", b"")
    return packed.getvalue()


def _bomb(method: int) -> Make:
    def make(size: int) -> bytes:
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", method) as archive:
            archive.writestr("a.xml", bytes(size * 100))
        return packed.getvalue()

    return make


_FORMULAS: dict[str, Make] = {
    "a sum": fill_text("+1", "1"),
    "brackets": lambda size: "(" * min(size // 2, 4000) + "1" + ")" * min(size // 2, 4000),
    "signs": fill_text("-", tail="1"),
    "powers": fill_text("**9", "9"),
    "shifts": fill_text("<<63", "1"),
    "digits": fill_text("9"),
    "hex digits": fill_text("F", "0x"),
    "an exponent": fill_text("9", "1e"),
    "a name": fill_text("a"),
    "spaces": fill_text(" ", tail="1"),
    "choices": fill_text("1?1:", tail="1"),
    "arguments": fill_text("1,", "SIN(", "1)"),
    "products": fill_text("*99999999", "1"),
}


class _Memory:
    async def read(self, address: int, length: int) -> bytes:
        return bytes(length)

    async def write(self, address: int, data: bytes) -> None:
        pass


def _features(text: bytes) -> None:
    nodes = _description.parse(text)
    features = GenicamFeatures(nodes, _Memory(), "camera")

    async def ask() -> None:
        for name in ("A", "Zzz"):
            with contextlib.suppress(SmartCamError):
                await features.get(name)
        with contextlib.suppress(SmartCamError):
            await features.set("A", 3)

    asyncio.run(ask())


_FEATURES: dict[str, Make] = {
    kind: _described(make)
    for kind, make in {
        "variables": fill_text(
            '<pVariable Name="V{}">B</pVariable>',
            '<Integer Name="B"><Value>1</Value></Integer><SwissKnife Name="A">',
            "<Formula>1</Formula></SwissKnife>",
        ),
        "expressions asked for again and again": lambda size: "".join(
            (
                '<SwissKnife Name="A">',
                *(f'<pVariable Name="V{n}">B</pVariable>' for n in range(size // 80)),
                '<Formula>1</Formula></SwissKnife><SwissKnife Name="B">',
                *(f'<Expression Name="E{n}">1+1+1</Expression>' for n in range(size // 80)),
                "<Formula>1</Formula></SwissKnife>",
            )
        ),
        "nodes that lead to two others": lambda size: "".join(
            f'<SwissKnife Name="{"A" if not n else f"N{n}"}"><pVariable Name="X">N{n + 1}'
            f'</pVariable><pVariable Name="Y">N{n + 1}</pVariable><Formula>X+Y</Formula>'
            "</SwissKnife>"
            for n in range(size // 130)
        ),
        "a circle": fill_text('<Integer Name="A"><pValue>A</pValue></Integer>'),
        "addresses": fill_text(
            "<Address>1</Address>",
            '<Port Name="P"/><IntReg Name="A"><pPort>P</pPort><Length>4</Length>',
            "</IntReg>",
        ),
        "entries": fill_text(
            '<EnumEntry Name="e{}"><Value>{}</Value></EnumEntry>',
            '<Enumeration Name="A"><Value>0</Value>',
            "</Enumeration>",
        ),
        "features": fill_text(
            '<Integer Name="Zz{}"/><Category Name="C{}"><pFeature>Zz{}</pFeature></Category>'
        ),
        "indexed values": fill_text(
            '<pValueIndexed Index="{}">B</pValueIndexed>',
            '<Integer Name="B"><Value>1</Value></Integer><Integer Name="A"><pIndex>B</pIndex>',
            "</Integer>",
        ),
    }.items()
}


def _bmp(bits: int) -> Make:
    def make(size: int) -> bytes:
        side = max(4, int((8 * size / bits) ** 0.5) // 4 * 4)
        pixels = bytes(side * bits // 8 * side)
        info = struct.pack("<IiiHHIIiiII", 40, side, side, 1, bits, 0, 0, 0, 0, 0, 0)
        place = 14 + 40 + 1024 * (bits == 8)
        return struct.pack("<2sIHHI", b"BM", 0, 0, 0, place) + info + bytes(place - 54) + pixels

    return make


def _jpeg(inner: bytes) -> Make:
    return fill(inner, b"\xff\xd8", b"\xff\xd9")


def _read_jpeg(data: bytes) -> None:
    width, height, _ = jpeg_header(data, "JPEG")
    decode_jpeg(data, "RGB", (width, height), "JPEG")


PARSERS: tuple[Parser, ...] = (
    Parser(
        "RTSP: requests",
        _rtsp,
        streamed(_RTSP),
        MAX_MESSAGE_BYTES,
        "frames._streaming.rtsp.messages.MAX_MESSAGE_BYTES",
        size=1000,
        refuses=(RtspError,),
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
        "frames._video.redirects.MAX_HEAD_BYTES",
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
        "frames._gige.setup.MAX_FRAME_BYTES",
        size=1 << 15,
    ),
    Parser("GigE: events", decode_events, _EVENTS, UDP_BYTES, "UDP: a datagram"),
    Parser(
        "GigE: chunk data",
        _chunk_data,
        _CHUNK_DATA,
        _setup.MAX_FRAME_BYTES,
        "frames._gige.setup.MAX_FRAME_BYTES",
    ),
    Parser(
        "GigE: answers",
        _gvcp_answer,
        {"text": _ack(b"a"), "zeros": _ack(b"\0"), "bytes that are no text": _ack(b"\xff")},
        UDP_BYTES,
        "UDP: a datagram",
    ),
    Parser(
        "GenICam: descriptions",
        _description.parse,
        _DESCRIPTIONS,
        _description.MAX_PLAIN_BYTES,
        "frames._gige.description.MAX_PLAIN_BYTES",
        refused_from={"entries of a structure": 20_000},
    ),
    Parser(
        "GenICam: archives",
        lambda data: _description.parse(_description.unpack(data)),
        {
            "text in pieces": _zipped(_DESCRIPTIONS["text in pieces"]),
            "many files": _many_files,
            "zeros": _bomb(zipfile.ZIP_DEFLATED),
            "zeros, by bzip2": _bomb(zipfile.ZIP_BZIP2),
            "zeros, by LZMA": _bomb(zipfile.ZIP_LZMA),
        },
        _description.MAX_PACKED_BYTES,
        "frames._gige.description.MAX_PACKED_BYTES",
    ),
    Parser(
        "GenICam: formulas",
        lambda text: _expressions.evaluate(text, {}, integers=True),
        _FORMULAS,
        _expressions.MAX_FORMULA_CHARACTERS,
        "frames._gige.expressions.MAX_FORMULA_CHARACTERS",
        size=1500,
    ),
    Parser(
        "GenICam: values",
        _features,
        _FEATURES,
        _description.MAX_PLAIN_BYTES,
        "frames._gige.description.MAX_PLAIN_BYTES",
        refused_from={"expressions asked for again and again": 30_000},
    ),
    Parser(
        "bitmaps",
        read_bitmap,
        {"grey": _bmp(8), "colours": _bmp(24), "zeros": fill(b"\0", b"BM")},
        MAX_BITMAP,
        "frames._codecs.bitmap.MAX_PIXEL_BYTES",
    ),
    Parser(
        "JPEG",
        _read_jpeg,
        {
            "markers": _jpeg(b"\xff\xe0\0\2"),
            "fill bytes": _jpeg(b"\xff"),
            "zeros": _jpeg(b"\0"),
            "tables": _jpeg(b"\xff\xdb\0\x43\0" + b"\1" * 64),
            "restarts": _jpeg(b"\xff\xd0"),
        },
        1 << 28,
        "the frame that it comes in",
        needs=("simplejpeg",),
    ),
    Parser(
        "H.264: entry points",
        random_access_point,
        {
            "small units": fill(b"\0\0\1\x09"),
            "start codes": fill(b"\0\0\1"),
            "messages": fill(b"\1\0", b"\0\0\1\6"),
            "lengths without an end": fill(b"\xff", b"\0\0\1\6"),
            "units of messages": fill(b"\0\0\1\6\1\1a"),
        },
        1 << 28,
        "the frame that it comes in",
    ),
)
