"""A BVS ID written by hand from the manual's tables; what it does stands in its ``script``."""

from __future__ import annotations

import contextlib
import struct
from typing import TYPE_CHECKING, Any

from camera_by_hand import (
    CONNECT,
    DISCONNECT,
    GET_CLOCK,
    INPUT,
    QUERY,
    RESULT,
    SET_CLOCK,
    STATUS,
    SWITCH,
    TRIGGER,
    HandmadeCamera,
)
from clientkit import nothing_unheard

import smartcam

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from smartcam.client import SmartCamera

RESET_ERRORS = 0x16

# result codes
OK, OK_ID, OK_DATE, ERROR, INVALID, NOT_READY, INSPECTION_ERROR = 0, 2, 6, 0x10, 0x13, 0x16, 0x1A

# its status word
BID_WAITING, BID_SIMULATION, BID_READY, BID_TRIGGER_ERROR = 0x0001, 0x0008, 0x0020, 0x0100
BID_IDLE = BID_READY | BID_WAITING

HEADER = struct.Struct("<HH")


def words(*values: int) -> bytes:
    """Return UINT16s, little endian."""
    return struct.pack(f"<{len(values)}H", *values)


class HandmadeBid(HandmadeCamera):
    """One BVS ID on a free port of the loopback, as :class:`HandmadeCamera`."""

    def __init__(self, *, status: int = BID_IDLE, **options: Any) -> None:
        super().__init__(status=status, **options)
        self.dialect = "bid"
        self.script = {
            CONNECT: lambda _: self.coded(CONNECT, OK, 1),
            DISCONNECT: lambda _: self.coded(DISCONNECT, OK),
            STATUS: lambda _: self.status_frame(self.status),
            RESET_ERRORS: self._reset_errors,
            QUERY: lambda _: self.coded(QUERY, OK_ID, self.active),
            SWITCH: self._load,
            GET_CLOCK: lambda _: self.coded(GET_CLOCK, OK_DATE, 2016, 6, 25, 10, 11, 12),
            SET_CLOCK: lambda _: self.coded(SET_CLOCK, OK),
            INPUT: lambda _: self.coded(INPUT, OK),
            TRIGGER: lambda _: self.coded(TRIGGER, OK) + self.result_frame(),
        }

    def frame(self, message_id: int, payload: bytes = b"") -> bytes:
        return HEADER.pack(message_id, len(payload)) + payload

    def coded(self, message_id: int, code: int, *values: int) -> bytes:
        """Return an answer's bytes: its result code and what follows it."""
        return self.frame(message_id, words(code, *values))

    def status_frame(self, status: int, endian: int | None = None) -> bytes:
        self.status = status
        return self.frame(STATUS, words(status))

    def result_frame(self, data: bytes | None = None, application: int | None = None) -> bytes:
        number = self.active if application is None else application
        return self.frame(RESULT, words(number) + (self.container if data is None else data))

    def switched_frame(self, application: int, code: int = 0) -> bytes:
        return self.coded(SWITCH, code, application)

    def split(self, data: bytes) -> list[bytes]:
        frames: list[bytes] = []
        while data:
            size = HEADER.size + HEADER.unpack_from(data)[1]
            frames.append(data[:size])
            data = data[size:]
        return frames

    def take(self, data: bytes) -> None:
        self._buffer += data
        while len(self._buffer) >= HEADER.size:
            message_id, length = HEADER.unpack_from(self._buffer)
            size = HEADER.size + length
            if len(self._buffer) < size:
                return
            payload, self._buffer = self._buffer[HEADER.size : size], self._buffer[size:]
            self.hear(message_id, payload)

    def commands(self, mark: int = 0) -> list[int]:
        """Return the ids of what came behind the first ``mark``, without the polling of status."""
        return [one for one in self.ids[mark:] if one not in {STATUS, QUERY}]

    def _reset_errors(self, _: bytes) -> bytes:
        return self.coded(RESET_ERRORS, OK) + self.status_frame(self.status & ~BID_TRIGGER_ERROR)

    def _load(self, payload: bytes) -> bytes:
        (wanted,) = struct.unpack("<H", payload)
        if wanted not in self.applications:
            return self.coded(SWITCH, INSPECTION_ERROR, self.active)
        self.active = wanted
        return self.coded(SWITCH, OK, wanted)


@contextlib.asynccontextmanager
async def bid_by_hand(
    *, box: dict[str, Any] | None = None, **options: Any
) -> AsyncIterator[tuple[HandmadeBid, SmartCamera]]:
    """A handmade BVS ID and a client in a session with it, which does not reconnect by default."""
    options.setdefault("reconnect", None)
    async with (
        nothing_unheard(),
        HandmadeBid(**(box or {})) as made,
        smartcam.connect(made.url, **options) as camera,
    ):
        yield made, camera
