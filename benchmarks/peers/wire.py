"""Frames of the dialect ``handbook``, as the maker's manual has them."""

from __future__ import annotations

import struct

__all__ = [
    "CONNECT",
    "CONNECT_ANSWER",
    "DISCONNECT",
    "HEADER",
    "QUERY",
    "RECORD",
    "STATUS",
    "TRIGGER",
    "frame",
    "localization",
    "query_answer",
    "result",
    "status",
]

HEADER = struct.Struct("<4sII")  # magic, length of what follows the id, id
MAGIC = bytes.fromhex("50535642")
CONNECT, DISCONNECT, STATUS, RESULT, QUERY, TRIGGER = 0x01, 0x02, 0x12, 0x20, 0x30, 0x40
RUNNING, WAITING = 0x80, 0x200
APPLICATION = 21
RECORD = struct.Struct("<50sfifff")  # feature id, quality, photo index, x, y, theta


def frame(message_id: int, body: bytes = b"") -> bytes:
    """Return a whole frame."""
    return HEADER.pack(MAGIC, len(body), message_id) + body


def status(*, waiting: bool) -> bytes:
    """Return the status of a camera that runs a triggered application."""
    return frame(STATUS, struct.pack("<II", RUNNING | (WAITING if waiting else 0), 0))


def query_answer() -> bytes:
    """Return the answer to a Query."""
    return frame(QUERY, struct.pack("<I", APPLICATION))


def localization(number: int) -> bytes:
    """Return one record of the default layout of ``localizations``: 70 bytes."""
    return RECORD.pack(b"part %d" % number, 0.97, 0, 0.1 + 0.01 * number, 0.2, 0.5)


def result(data: bytes) -> bytes:
    """Return a result container."""
    return frame(RESULT, struct.pack("<I", APPLICATION) + data)


CONNECT_ANSWER = frame(CONNECT, struct.pack("<I", 1))
