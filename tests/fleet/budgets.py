"""Parsers of the room for :mod:`tests.budgets`, with the hardest inputs."""

from __future__ import annotations

import contextlib
import json
import struct
from pathlib import Path

from smartcam._zenoh import MAX_WAITING_BYTES
from smartcam.fleet._inside import patterns_overlap, read_identity
from tests.budgets.inputs import JSON
from tests.budgets.parser import Make, Parser, fill, fill_text, grown
from tests.fleet.inside import CERTIFICATE_FILES, decode_bundle, decode_part, request_fields
from tests.fleet.inside import _read_cameras as read_summary
from tests.fleet.inside import wire as _wire


def _message(payload: bytes) -> None:
    """Read what may come as a call, its answer, a state, or frames."""
    if _wire.decode_trigger(payload, "a call") is None:
        _wire.decode(payload, "a call")
    if _wire.decode_trigger_reply(payload, "an answer") is None:
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
    return _wire.encode_trigger_reply(
        1, 1, 0.0, 1, [b"{}"] * (size // 6), _wire.encode_groups(1, 1, [])
    )


_MESSAGES: dict[str, Make] = {
    **{f"JSON: {kind}": _headed(make) for kind, make in JSON.items()},
    "byte strings of none": _blobs(0),
    "byte strings": _blobs(9),
    "what happened": _told,
    "a length of more": fill(b"\xff"),
}


def _run(count: int, length: int) -> bytes:
    return _wire.ResultGroup(1, 1, 0, 0, 0, 0, 0.0, 1.0, 1.0, 1.0, [bytes(length)] * count).encode()


_RUNS: dict[str, Make] = {
    "runs": grown(lambda count: _wire.encode_groups(1, 1, [_run(1, 1)] * count), 85),
    "a run of many": grown(lambda count: _wire.encode_groups(1, 1, [_run(count, 1)]), 5),
    "a run of one": lambda size: _wire.encode_groups(1, 1, [_run(1, size)]),
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
    **{kind: JSON[kind] for kind in ("a list", "nested lists", "keys", "a long text")},
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
    patterns_overlap.cache_clear()
    for name in ("line1/cell2/cam3", "a" * 100, "a/a/a/a"):
        patterns_overlap(pattern, name)


def _identity(data: bytes | str) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        for name in CERTIFICATE_FILES:
            (Path(folder) / name).write_bytes(data.encode() if isinstance(data, str) else data)
        read_identity(Path(folder))


PARSERS: tuple[Parser, ...] = (
    Parser("fleet: messages", _message, _MESSAGES, MAX_WAITING_BYTES, "_zenoh.MAX_WAITING_BYTES"),
    Parser(
        "fleet: results",
        lambda data: _wire.decode_groups(data, "results"),
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
        4 << 10,
        "fleet._agent.summary.MAX_PATTERN_BYTES",
        size=1000,
    ),
    Parser(
        "fleet: requests in JSON",
        lambda text: request_fields(text.encode()),
        JSON,
        256 << 10,
        "fleet._json.json_services.MAX_REQUEST_BYTES",
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
        1 << 20,
        "fleet._security.certificates.MAX_BYTES",
        needs=("cryptography",),
    ),
)
