"""Parsers of what programs, pages and recorders say: the fleet's bus, ROS, HTTP, recordings."""

from __future__ import annotations

import contextlib
import functools
import importlib
import json
import math
import struct
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from smartcam._zenoh import MAX_WAITING_BYTES
from smartcam.exceptions import ConfigurationError, SmartCamError
from smartcam.fleet._agent.bundle import decode_bundle
from smartcam.fleet._agent.summary import MAX_PATTERN_BYTES
from smartcam.fleet._agent.summary import _read as read_summary
from smartcam.fleet._bus import wire as _wire
from smartcam.fleet._bus.address import CERTIFICATE_FILES
from smartcam.fleet._frames.wire import decode_part
from smartcam.fleet._inside import meets, read_identity
from smartcam.fleet._json.plain import MAX_REQUEST_BYTES, request_fields
from smartcam.fleet._security.certificates import MAX_BYTES
from smartcam.frames import Frame, Moment, find_format
from smartcam.outlets._mqtt import MAX_COMMAND_BYTES, _command_fields
from smartcam.recording import load_recording
from smartcam.recording._mcap import form as _form
from smartcam.recording._mcap import records as _records
from smartcam.recording._pictures.messages import picture_message
from smartcam.ros1._json_messages import from_json
from smartcam.ros1._link import MAX_MESSAGE_BYTES as LARGEST_OPERATION
from smartcam.ros2 import RosTypes
from smartcam.ros2._node.tokens import Entity
from smartcam.web._connections import MAX_HEAD_BYTES, Visitor, Visitors
from smartcam.web._errors import RefusedError
from smartcam.web._routes import MAX_BODY_BYTES, CallBody, _parsed, _validate
from tests.budgets.parser import Make, Parser, fill, fill_text, from_file, grown, streamed
from tests.budgets.texts import _JSON

# ---------------------------------------------------------------------- the fleet's bus


def _message(payload: bytes) -> None:
    """Read what may come as a call, its answer, a state, or frames."""
    if _wire.decode_order(payload, "a call") is None:
        _wire.decode(payload, "a call")
    if _wire.decode_outcome(payload, "an answer") is None:
        _, blobs = _wire.decode(payload, "an answer")
        for blob in blobs:
            with contextlib.suppress(ValueError):
                _wire.decode_state(blob)
    decode_part(payload[:28])


def _headed(inner: Make) -> Make:
    def make(size: int) -> bytes:
        head: bytes = inner(size).encode()
        return struct.pack("<I", len(head)) + head

    return make


def _blobs(unit: int) -> Make:
    def make(size: int) -> bytes:
        count = max(1, size // (unit + 3))
        return _wire.encode({"a": 1}, [bytes(unit)] * count)

    return make


def _told(size: int) -> bytes:
    return _wire.encode_outcome(1, 1, 0.0, 1, [b"{}"] * (size // 6), _wire.encode_runs(1, 1, []))


_MESSAGES: dict[str, Make] = {
    **{f"JSON: {kind}": _headed(make) for kind, make in _JSON.items()},
    "byte strings of none": _blobs(0),
    "byte strings": _blobs(9),
    "what happened": _told,
    "a length of more": fill(b"\xff"),
}


def _run(count: int, length: int) -> bytes:
    return _wire.ResultRun(1, 1, 0, 0, 0, 0, 0.0, 1.0, 1.0, 1.0, [bytes(length)] * count).encode()


_RUNS: dict[str, Make] = {
    "runs": grown(lambda count: _wire.encode_runs(1, 1, [_run(1, 1)] * count), 85),
    "a run of many": grown(lambda count: _wire.encode_runs(1, 1, [_run(count, 1)]), 5),
    "a run of one": lambda size: _wire.encode_runs(1, 1, [_run(1, size)]),
    "runs that are not there": lambda size: (
        struct.pack("<4sQQI", b"scr1", 1, 1, 1 << 31) + bytes(size)
    ),
    "containers that are not there": lambda size: (
        struct.pack("<4sQQI", b"scr1", 1, 1, 1)
        + _run(1, 1)[:8]
        + struct.pack("<I", size // 4)
        + _run(1, 1)[12:-5]
        + bytes(size)
    ),
}

_BUNDLES: dict[str, Make] = {
    "cameras": grown(
        lambda count: struct.pack("<4sQQQI", b"scb1", 1, 1, 1, count) + b"\1\0\0\0\0\0a" * count, 7
    ),
    "cameras without names": grown(
        lambda count: struct.pack("<4sQQQI", b"scb1", 1, 1, 1, count) + bytes(6 * count), 6
    ),
    "cameras that are not there": lambda size: (
        struct.pack("<4sQQQI", b"scb1", 1, 1, 1, 1 << 31) + bytes(size)
    ),
}

_SUMMARIES: dict[str, Make] = {
    **{kind: _JSON[kind] for kind in ("a list", "nested lists", "keys", "a long text")},
    "cameras": lambda size: json.dumps(
        {"agent": "a", "cameras": [["c", 1, 0, None, None, None, 1, 1]] * (size // 36)}
    ),
}

_PATTERNS: dict[str, Make] = {
    "any number of chunks": fill_text("**/", tail="z"),
    "any number of chunks, and one": fill_text("**/a/", tail="z"),
    "chunks": fill_text("a/", tail="z"),
    "any": fill_text("*/", tail="z"),
    "parts of a chunk": fill_text("$*a", tail="z"),
    "parts of chunks": fill_text("a$*/", tail="z"),
}


def _meets(pattern: str) -> None:
    meets.cache_clear()
    for name in ("line1/cell2/cam3", "a" * 100, "a/a/a/a"):
        meets(pattern, name)


# ---------------------------------------------------------------------- ROS


@functools.cache
def _types() -> RosTypes:
    types = RosTypes("jazzy")
    types.add("a_b/msg/Part", "")
    types.add("a_b/msg/Parts", "Part[] parts\nstring[] texts\nuint8[] data\nfloat64[] numbers\n")
    return types


def _parts(parts: int = 0, texts: bytes = b"", count: int = 0) -> bytes:
    body = struct.pack("<I", parts) + bytes(parts)
    body += bytes(-len(body) % 4) + struct.pack("<I", count) + texts
    body += bytes(-len(body) % 4) + struct.pack("<I", 0) + struct.pack("<I", 0)
    return b"\0\1\0\0" + body


_CDR: dict[str, Make] = {
    "messages of nothing": lambda size: _parts(size),
    "texts of nothing": grown(lambda count: _parts(0, bytes(4 * count), count), 4),
    "texts": grown(lambda count: _parts(0, b"\4\0\0\0abc\0" * count, count), 8),
    "messages that are not there": lambda size: b"\0\1\0\0" + b"\xff" * size,
    "zeros": fill(b"\0", b"\0\1\0\0"),
}

_OPERATIONS: dict[str, Make] = {
    "messages": fill_text("{},".replace("{}", "{ }"), '{"parts":[', "{ }]}"),
    "texts": fill_text('"a",', '{"texts":[', '"a"]}'),
    "base64": fill_text("AAAA", '{"data":"', '"}'),
    "no base64": fill_text("A", '{"data":"', '!"}'),
    "numbers": fill_text("1,", '{"numbers":[', "1]}"),
    "unknown fields": fill_text('"k{}":1,', "{", '"z":1}'),
    "nested lists": _JSON["nested lists"],
    "an array of fields": fill_text("[],", "[", "[]]"),
}

_TOKENS: dict[str, Make] = {
    "parts": fill_text("a/", "@ros2_lv/"),
    "percent signs": fill_text("%", "@ros2_lv/0/z/0/0/NN/%/", "/a"),
    "digits": fill_text("9", "@ros2_lv/", "/z/0/0/NN/%/%/a"),
    "colons": fill_text(":", "@ros2_lv/0/z/0/0/MP/%/%/a/%b/c/d/"),
    "a long type": fill_text("a", "@ros2_lv/0/z/0/0/MP/%/%/a/%b/", "/d/::,5:,:,:,,"),
}


def _token(text: str) -> None:
    _types().message(Entity.parse(text).ros_type)


# ---------------------------------------------------------------------- pages


class _Item(CallBody):
    name: str
    number: int = 0


class _Body(CallBody):
    items: list[_Item]


def _body(data: bytes | str) -> None:
    _validate(_Body, _parsed("application/json", data.encode() if isinstance(data, str) else data))


_BODIES: dict[str, Make] = {
    **_JSON,
    "items": fill_text('{"name":"a"},', '{"items":[', '{"name":"b"}]}'),
    "wrong items": fill_text('{"name":1,"x":2},', '{"items":[', "{}]}"),
}


class _Transport:
    """A transport, as far as a connection asks it."""

    def get_extra_info(self, name: str) -> Any:
        return None

    def is_closing(self) -> bool:
        return False

    def abort(self) -> None:
        pass


def _heads(pieces: list[bytes]) -> None:
    import asyncio

    async def come() -> None:
        visitor = Visitor(Visitors(asyncio.Protocol))
        visitor.connection_made(_Transport())  # type: ignore[arg-type]
        for piece in pieces:
            visitor.data_received(piece)
        visitor.connection_lost(None)

    asyncio.run(come())


_HEADS: dict[str, Make] = {
    "headers": fill(b"a: b\r\n", b"GET / HTTP/1.1\r\n", b"\r\n"),
    "half ends": fill(b"\r\n\r"),
    "a long line": fill(b"a"),
}

# ---------------------------------------------------------------------- recordings


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


def _identity(data: bytes | str) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        for name in CERTIFICATE_FILES:
            (Path(folder) / name).write_bytes(data.encode() if isinstance(data, str) else data)
        read_identity(Path(folder))


BUS: tuple[Parser, ...] = (
    Parser("fleet: messages", _message, _MESSAGES, MAX_WAITING_BYTES, "_zenoh.MAX_WAITING_BYTES"),
    Parser(
        "fleet: results",
        lambda data: _wire.decode_runs(data, "results"),
        _RUNS,
        MAX_WAITING_BYTES,
        "_zenoh.MAX_WAITING_BYTES",
    ),
    Parser(
        "fleet: bundles",
        lambda data: decode_bundle(data, "a bundle"),
        _BUNDLES,
        MAX_WAITING_BYTES,
        "_zenoh.MAX_WAITING_BYTES",
    ),
    Parser(
        "fleet: summaries",
        lambda text: list(read_summary(text)),
        _SUMMARIES,
        MAX_WAITING_BYTES,
        "_zenoh.MAX_WAITING_BYTES",
        refuses=(ValueError, TypeError, KeyError, RecursionError),
    ),
    Parser(
        "fleet: patterns of cameras",
        _meets,
        _PATTERNS,
        MAX_PATTERN_BYTES,
        "fleet._agent.summary.MAX_PATTERN_BYTES",
        size=1000,
    ),
    Parser(
        "fleet: requests in JSON",
        lambda text: request_fields(text.encode()),
        _JSON,
        MAX_REQUEST_BYTES,
        "fleet._json.plain.MAX_REQUEST_BYTES",
    ),
    Parser(
        "MQTT: commands",
        lambda text: _command_fields(text.encode()),
        _JSON,
        MAX_COMMAND_BYTES,
        "outlets._mqtt.MAX_COMMAND_BYTES",
    ),
    Parser(
        "certificates",
        _identity,
        {
            "certificates": fill(b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n"),
            "beginnings": fill(b"-----BEGIN CERTIFICATE-----\n"),
            "one without an end": fill(b"A", b"-----BEGIN CERTIFICATE-----\n"),
            "hyphens": fill(b"-"),
        },
        MAX_BYTES,
        "fleet._security.certificates.MAX_BYTES",
        needs=("cryptography",),
    ),
    Parser(
        "ROS: messages",
        lambda data: _types().message("a_b/msg/Parts").decode(data),
        _CDR,
        1 << 30,
        "Zenoh: a message",
        needs=("rosbags",),
    ),
    Parser(
        "ROS: tokens",
        _token,
        _TOKENS,
        1 << 16,
        "Zenoh: a key",
        size=1000,
        refuses=(ValueError, ConfigurationError),
        needs=("rosbags",),
    ),
    Parser(
        "rosbridge: operations",
        lambda text: from_json(_types().message("a_b/msg/Parts"), json.loads(text)),
        _OPERATIONS,
        LARGEST_OPERATION,
        "ros1._link.MAX_MESSAGE_BYTES",
        refuses=(ValueError, RecursionError, SmartCamError),
        needs=("rosbags",),
    ),
    Parser(
        "pages: bodies of calls",
        _body,
        _BODIES,
        MAX_BODY_BYTES,
        "web._routes.MAX_BODY",
        refuses=(RefusedError,),
        needs=("aiohttp",),
    ),
    Parser(
        "pages: heads of requests",
        _heads,
        streamed(_HEADS),
        MAX_HEAD_BYTES,
        "web._connections.MAX_HEAD",
        needs=("aiohttp",),
    ),
    Parser(
        "recordings",
        from_file(load_recording, "a.mcap"),
        _MCAP,
        1 << 62,
        "none: read piece by piece",
        needs=("zstandard", "lz4"),
    ),
)
