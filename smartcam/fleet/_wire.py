"""What smartcam's own ends of a fleet say to each other, as bytes.

A message is a JSON object with byte strings behind it: calls, replies, what the camera is. Results
go as runs: containers of one camera that came together, with consecutive numbers. Everything is
little endian. ``docs/bus.md`` has the layouts.
"""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from smartcam.exceptions import RemoteProtocolError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence


def grace(timeout: float) -> float:
    """Return the seconds for which a reply is awaited beyond a call's own.

    So the agent gives up first. Half of it may go by until the call is there; then the call has
    all its time.
    """
    return min(0.25, 0.02 + 0.1 * timeout)


class Message(NamedTuple):
    """A JSON object, and the byte strings that came behind it."""

    fields: dict[str, Any]
    blobs: list[bytes]


_LENGTH = struct.Struct("<I")
_as_json = json.JSONEncoder(separators=(",", ":"), allow_nan=False).encode


def encode_state(fields: dict[str, Any]) -> bytes:
    """Return what happened as bytes: one of a message's byte strings."""
    return _as_json(fields).encode()


def encode(fields: dict[str, Any], blobs: Sequence[bytes] = ()) -> bytes:
    """Return a message as bytes."""
    if blobs:
        fields = {**fields, "blobs": [len(one) for one in blobs]}
    head = _as_json(fields).encode()
    return b"".join((_LENGTH.pack(len(head)), head, *blobs))


def decode(payload: bytes, what: str) -> Message:
    """Return the message in ``payload``.

    Raises:
        RemoteProtocolError: it is none; ``what`` is said to be broken.
    """
    try:
        (size,) = _LENGTH.unpack_from(payload)
        end = _LENGTH.size + size
        if end > len(payload):
            raise ValueError(f"{size} bytes of JSON were announced, {len(payload)} came in all")
        fields: Any = json.loads(str(payload[_LENGTH.size : end], "utf-8"))
        if not isinstance(fields, dict):
            raise TypeError(f"a JSON object was expected, not {type(fields).__name__}")
        known = cast("dict[str, Any]", fields)
        blobs: list[bytes] = []
        for length in known.pop("blobs", ()):
            if not isinstance(length, int) or not 0 <= length <= len(payload) - end:
                raise ValueError(f"a byte string of {length!r} bytes does not fit")
            blobs.append(payload[end : end + length])
            end += length
        if end != len(payload):
            raise ValueError(f"{len(payload) - end} bytes are left over")
    except (ValueError, TypeError, struct.error, RecursionError) as exc:
        raise RemoteProtocolError(f"{what} is broken: {exc}") from exc
    return Message(known, blobs)


# ---------------------------------------------------------------------- results

CURRENT, LATE = 1, 2
"""Flags of a run: not known to be an older trigger's; known to be one's that was given up."""

_RUN = struct.Struct("<QIqBBxxIIddddI")
_BATCH = struct.Struct("<4sQQI")
_MAGIC = b"scr1"
_NO_NUMBER = math.nan
_NEVER = 253_402_300_800.0  # the year 10,000, which no datetime has


@dataclass(frozen=True, slots=True)
class Run:
    """Containers of one application that came together.

    Attributes:
        number: the agent's number of the first; the others follow.
        application: whose they are; below 0 where the camera does not say.
        endian: the byte order that the camera's last status told.
        flags: what is known of all of them.
        owner: the program whose trigger they are the outcome of, as the agent numbers it; else 0.
        call: that program's number of the trigger; else 0.
        clock: the agent's monotonic clock when they came, seconds.
        at: when they came, seconds since 1970, UTC.
        triggered_at: when their trigger was sent, the same way; NaN without one.
        latency: seconds from there to here; NaN without one.
        payloads: their bytes.
        cells: JSON with the values that the one payload was put together from, and what speaks
            against them; empty without.
    """

    number: int
    application: int
    endian: int
    flags: int
    owner: int
    call: int
    clock: float
    at: float
    triggered_at: float
    latency: float
    payloads: list[bytes]
    cells: bytes = b""

    @property
    def next(self) -> int:
        """The number behind it."""
        return self.number + len(self.payloads)

    @property
    def size(self) -> int:
        """Bytes of the containers."""
        return sum(map(len, self.payloads)) + len(self.cells)

    @property
    def received_at(self) -> datetime:
        """When they came."""
        return datetime.fromtimestamp(self.at, UTC)

    @property
    def trigger_time(self) -> datetime | None:
        """When their trigger was sent."""
        at = self.triggered_at
        return None if math.isnan(at) else datetime.fromtimestamp(at, UTC)

    def since(self, number: int) -> Run:
        """Return what of it has ``number`` or a later one."""
        if number <= self.number:
            return self
        return replace(self, number=number, payloads=self.payloads[number - self.number :])

    def encode(self) -> bytes:
        """Return it as bytes."""
        payloads = self.payloads
        count = len(payloads)
        head = _RUN.pack(
            self.number,
            count,
            self.application,
            self.endian,
            self.flags,
            self.owner,
            self.call,
            self.clock,
            self.at,
            self.triggered_at,
            self.latency,
            len(self.cells),
        )
        lengths = struct.pack(f"<{count}I", *map(len, payloads))
        return b"".join((head, lengths, *payloads, self.cells))


def encode_runs(epoch: int, following: int, runs: Sequence[bytes]) -> bytes:
    """Return runs as one message; ``following`` is the number that the agent gives next."""
    return b"".join((_BATCH.pack(_MAGIC, epoch, following, len(runs)), *runs))


class Batch(NamedTuple):
    """Runs, in order; the agent's epoch, and the number that it gives next."""

    epoch: int
    following: int
    runs: list[Run]


def decode_runs(payload: bytes, what: str) -> Batch:
    """Return the runs in ``payload``.

    Raises:
        RemoteProtocolError: it is broken.
    """
    try:
        magic, epoch, following, count = _BATCH.unpack_from(payload)
        if magic != _MAGIC:
            raise ValueError(f"it begins with {magic!r}, not {_MAGIC!r}")
        runs: list[Run] = []
        place = _BATCH.size
        for _ in range(count):
            run, place = _decode_run(payload, place)
            runs.append(run)
        if place != len(payload):
            raise ValueError(f"{len(payload) - place} bytes are left over")
    except (ValueError, struct.error, OverflowError) as exc:
        raise RemoteProtocolError(f"{what} is broken: {exc}") from exc
    return Batch(epoch, following, runs)


def _decode_run(payload: bytes, place: int) -> tuple[Run, int]:
    number, count, application, endian, flags, owner, call, clock, at, trigger, latency, cells = (
        _RUN.unpack_from(payload, place)
    )
    place += _RUN.size
    known = 0 <= at < _NEVER and (0 <= trigger < _NEVER or math.isnan(trigger))
    if not 1 <= count <= (len(payload) - place) // 4 or not known:
        raise ValueError(f"a run of {count} containers at {at} does not fit")
    lengths = struct.unpack_from(f"<{count}I", payload, place)
    place += 4 * count
    if sum(lengths) + cells > len(payload) - place:
        raise ValueError(f"{sum(lengths) + cells} bytes of containers do not fit")
    payloads: list[bytes] = []
    for length in lengths:
        payloads.append(payload[place : place + length])
        place += length
    end = place + cells
    run = Run(
        number,
        application,
        endian,
        flags,
        owner,
        call,
        clock,
        at,
        trigger,
        latency,
        payloads,
        payload[place:end],
    )
    return run, end


def timestamp(at: datetime | None) -> float:
    """Return a time as seconds since 1970; NaN for None."""
    return _NO_NUMBER if at is None else at.timestamp()


def joined(runs: Iterable[Run]) -> list[bytes]:
    """Return runs as bytes."""
    return [run.encode() for run in runs]
