"""Parsers of the room for :mod:`tests.budgets`, with the hardest inputs."""

from __future__ import annotations

import importlib
import math
import struct
from datetime import UTC, datetime

from smartcam.frames import Frame, Moment, find_format
from smartcam.recording import load_recording
from tests.budgets.parser import Make, Parser, fill, from_file
from tests.recording.inside import form as _form
from tests.recording.inside import picture_message
from tests.recording.inside import records as _records


def _record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def _text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def _mcap(inner: Make) -> Make:
    def make(size: int) -> bytes:
        facts = _text("format") + _text(_form.FORMAT)
        begin = _record(12, _text("smartcam") + struct.pack("<I", len(facts)) + facts)
        name = _text(_form.KINDS["results"].schema)
        begin += _record(3, b"\1\0" + name + _text("jsonschema") + _text(""))
        begin += _record(4, b"\1\0\1\0" + _text("/x") + _text("json") + _text(""))
        begin += _record(3, b"\7\0" + _text("foxglove.RawImage") + _text("protobuf") + _text(""))
        begin += _record(4, b"\7\0\7\0" + _text("/y") + _text("protobuf") + _text(""))
        end = _record(15, bytes(4)) + _record(2, bytes(20))
        middle: bytes = inner(size)
        return _records.MAGIC + begin + middle + end + _records.MAGIC

    return make


def _packed(inner: Make, how: str) -> Make:
    def make(size: int) -> bytes:
        modules = {"zstd": "zstandard", "lz4": "lz4.frame"}
        data = inner(size)
        packed = importlib.import_module(modules[how]).compress(data) if how else data
        head = struct.pack("<QQQI", 0, 0, len(data), 0) + _text(how)
        return _record(6, head + struct.pack("<Q", len(packed)) + packed)

    return make


_RESULT = (
    b'{"camera":"left","application":5,"number":1,"received_at":"2026-01-02T03:04:05+00:00",'
    b'"raw":""}'
)

_ONE = _record(5, struct.pack("<HIQQ", 1, 0, 0, 0) + _RESULT)


def _large(size: int) -> bytes:
    value = b'"value":[' + b"1," * (size // 2) + b"1],"
    return _record(5, struct.pack("<HIQQ", 1, 0, 0, 0) + b"{" + value + _RESULT[1:])


def _facts(size: int) -> bytes:
    facts = b"".join(_text(f"{n}") + _text("") for n in range(size // 12))
    return _record(12, _text("x") + struct.pack("<I", len(facts)) + facts)


def _picture(side: int) -> bytes:
    frame = Frame(
        data=bytes(side * side),
        format=find_format("Mono8"),
        width=side,
        height=side,
        stride=side,
        captured=1.0,
        utc=1.0,
        moment=Moment.ARRIVAL,
        sequence=1,
        source="left",
    )
    picture = _form.RecordedPicture("left", datetime.fromtimestamp(1, UTC), frame)
    return _record(5, struct.pack("<HIQQ", 7, 0, 0, 0) + picture_message(picture))


_MCAP: dict[str, Make] = {
    "pictures": _mcap(fill(_picture(8))),
    "a large picture": _mcap(lambda size: _picture(max(8, math.isqrt(size)))),
    "a picture of many fields": _mcap(
        lambda size: _record(5, struct.pack("<HIQQ", 7, 0, 0, 0) + b"\x48\x01" * (size // 2))
    ),
    "messages": _mcap(fill(_ONE)),
    "messages of an unknown channel": _mcap(fill(_record(5, b"\x09\0" + bytes(20)))),
    "a message of many values": _mcap(_large),
    "empty records": _mcap(fill(_record(0x77, b""))),
    "facts": _mcap(_facts),
    "schemas": _mcap(fill(_record(3, b"\2\0" + _text("a") + _text("") + _text("")))),
    "a long schema": _mcap(lambda size: _record(3, b"\2\0" + _text("a" * size))),
    "cameras": _mcap(
        lambda size: b"".join(
            _record(
                12,
                _text("smartcam:camera")
                + struct.pack("<I", 14 + len(str(n)))
                + _text("camera")
                + _text(str(n)),
            )
            for n in range(size // 50)
        )
    ),
    "a record of more than is there": _mcap(
        lambda size: struct.pack("<BQ", 5, 1 << 27) + bytes(size)
    ),
    "chunks of one message": _mcap(
        lambda size: b"".join([_packed(lambda _: _ONE, "zstd")(0)] * max(1, size // 150))
    ),
    **{
        f"a chunk of {what}, {how or 'not packed'}": _mcap(_packed(inner, how))
        for how in ("zstd", "lz4", "")
        for what, inner in {
            "messages": fill(_ONE),
            "zeros": lambda size: _record(0x77, bytes(100 * size)),
        }.items()
    },
}

PARSERS: tuple[Parser, ...] = (
    Parser(
        "recordings",
        from_file(load_recording, "a.mcap"),
        _MCAP,
        1 << 62,
        "none: read piece by piece",
        needs=("zstandard", "lz4"),
    ),
)
