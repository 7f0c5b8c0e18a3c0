"""Encode and decode the messages between agents and programs that use smartcam.

A message is a JSON object followed by byte strings: calls, replies, descriptions. Results are sent
in groups: consecutive results of one application of a camera. The messages of each trigger are
binary, since JSON would cost more than all the rest: the call (:class:`TriggerCall`), the reply
(:class:`TriggerReply`), and statuses. Everything is little endian. ``docs/bus.md`` has the layouts.
"""

from __future__ import annotations

import json
import math
import struct
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from smartcam._client._inside import new_tuple
from smartcam.exceptions import RemoteProtocolError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence


def reply_grace(timeout: float) -> float:
    """Return the seconds for which a program awaits a reply beyond a call's timeout.

    So the agent gives up before the program does, and the agent's reply arrives in time. The agent
    allows up to half of this time for the call's way to it, without shortening the call's timeout.
    """
    return min(0.25, 0.02 + 0.1 * timeout)


class BusMessage(NamedTuple):
    """A JSON object, and the byte strings after it."""

    fields: dict[str, Any]
    blobs: list[bytes]


_LENGTH = struct.Struct("<I")
_as_json = json.JSONEncoder(separators=(",", ":"), allow_nan=False).encode


def encode_state(fields: dict[str, Any]) -> bytes:
    """Return the fields of an event as bytes: one of a message's byte strings."""
    return _as_json(fields).encode()


_STATUS = struct.Struct("<4sQQIq")
_STATUS_MAGIC = b"scs1"
_NONE = -(1 << 63)  # stands for None


def encode_status(number: int, status: int, endian: int, application: int | None) -> bytes:
    """Return a status as bytes, like :func:`encode_state`; ``number``: number of the event.

    Raises:
        struct.error: a value does not fit.
    """
    return _STATUS.pack(
        _STATUS_MAGIC, number, status, endian, _NONE if application is None else application
    )


def decode_state(data: bytes) -> dict[str, Any]:
    """Return the fields of an event.

    Raises:
        ValueError: the bytes are no event.
    """
    if data[:4] == _STATUS_MAGIC and len(data) == _STATUS.size:
        _, number, status, endian, application = _STATUS.unpack(data)
        return {
            "kind": "Status",
            "connected": True,
            "number": number,
            "status": status,
            "endian": endian,
            "application": None if application == _NONE else application,
        }
    state: Any = json.loads(str(data, "utf-8"))
    if not isinstance(state, dict) or not isinstance(cast("Any", state).get("number"), int):
        raise ValueError(f"no state: {data[:40]!r}")  # noqa: TRY004 - as json's own
    return cast("dict[str, Any]", state)


def encode(fields: dict[str, Any], blobs: Sequence[bytes] = ()) -> bytes:
    """Return a message as bytes."""
    if blobs:
        fields = {**fields, "blobs": [len(blob) for blob in blobs]}
    head = _as_json(fields).encode()
    return b"".join((_LENGTH.pack(len(head)), head, *blobs))


def decode(payload: bytes, label: str) -> BusMessage:
    """Return the message in ``payload``.

    Raises:
        RemoteProtocolError: the payload is not a message; the text names ``label``.
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
        raise RemoteProtocolError(f"{label} is broken: {exc}") from exc
    return BusMessage(known, blobs)


# ---------------------------------------------------------------------- results

CURRENT, LATE = 1, 2
"""Flags of a group. CURRENT: the results are not known to belong to an older trigger. LATE: the
results belong to a trigger that had timed out before they came."""

_GROUP = struct.Struct("<QIqIBxxxIIddddI")
_GROUPS_HEAD = struct.Struct("<4sQQI")
_GROUPS_MAGIC = b"scr1"
_NO_NUMBER = math.nan
_MAX_TIMESTAMP = 253_402_300_800.0  # the year 10,000; datetime ends before it


class ResultGroup(NamedTuple):
    """Consecutive result containers of one application of a camera, which came together.

    Attributes:
        number: the agent's number of the first container; the other containers have the next
            numbers.
        application: application of the containers; below 0 if the camera does not report it.
        endian: the byte order in the camera's last status.
        flags: the flags ``CURRENT`` and ``LATE``, which hold for all containers.
        owner: number, at the agent, of the program that triggered; 0 if no program did.
        call: number of the trigger among the calls of that program; 0 if no program triggered.
        clock: time of the arrival by the agent's monotonic clock, seconds.
        at: time of the arrival, seconds since 1970, UTC.
        triggered_at: time at which the trigger was sent, seconds since 1970; NaN without a trigger.
        latency: seconds from the trigger to the containers; NaN without a trigger.
        payloads: bytes of each container.
        cells: JSON with the values in cells of the only payload, and their error; empty without
            cells.
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
        """The number that follows the group's last number."""
        return self.number + len(self.payloads)

    @property
    def size(self) -> int:
        """Number of bytes of the containers."""
        return sum(map(len, self.payloads)) + len(self.cells)

    @property
    def received_at(self) -> datetime:
        """Time of the arrival of the results."""
        return datetime.fromtimestamp(self.at, UTC)

    @property
    def trigger_time(self) -> datetime | None:
        """Time at which the results' trigger was sent."""
        at = self.triggered_at
        return None if math.isnan(at) else datetime.fromtimestamp(at, UTC)

    def since(self, number: int) -> ResultGroup:
        """Return the part of the group with ``number`` and later numbers."""
        if number <= self.number:
            return self
        return self._replace(number=number, payloads=self.payloads[number - self.number :])

    def encode(self) -> bytes:
        """Return the group as bytes."""
        payloads = self.payloads
        count = len(payloads)
        head = _GROUP.pack(
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


def encode_groups(epoch: int, next_number: int, groups: Sequence[bytes]) -> bytes:
    """Return groups as one message; ``next_number`` is the agent's next number."""
    return b"".join((_GROUPS_HEAD.pack(_GROUPS_MAGIC, epoch, next_number, len(groups)), *groups))


class ResultsMessage(NamedTuple):
    """The agent's epoch, its next number, and groups in order."""

    epoch: int
    next_number: int
    groups: list[ResultGroup]


def decode_groups(payload: bytes, label: str) -> ResultsMessage:
    """Return the groups in ``payload``.

    Raises:
        RemoteProtocolError: the payload is broken; ``label`` names it.
    """
    try:
        magic, epoch, next_number, count = _GROUPS_HEAD.unpack_from(payload)
        if magic != _GROUPS_MAGIC:
            raise ValueError(f"it begins with {magic!r}, not {_GROUPS_MAGIC!r}")
        groups: list[ResultGroup] = []
        position = _GROUPS_HEAD.size
        for _ in range(count):
            group, position = _decode_group(payload, position)
            groups.append(group)
        if position != len(payload):
            raise ValueError(f"{len(payload) - position} bytes are left over")
    except (ValueError, struct.error, OverflowError) as exc:
        raise RemoteProtocolError(f"{label} is broken: {exc}") from exc
    results: ResultsMessage = new_tuple(ResultsMessage, (epoch, next_number, groups))
    return results


def decode_local_group(data: bytes) -> ResultGroup:
    """Return a group that :meth:`ResultGroup.encode` has encoded in this process."""
    return _decode_group(data, 0)[0]


def _decode_group(payload: bytes, position: int) -> tuple[ResultGroup, int]:
    number, count, application, endian, flags, owner, call, clock, at, trigger, latency, cells = (
        _GROUP.unpack_from(payload, position)
    )
    position += _GROUP.size
    has_valid_times = 0 <= at < _MAX_TIMESTAMP and (
        0 <= trigger < _MAX_TIMESTAMP or math.isnan(trigger)
    )
    if not 1 <= count <= (len(payload) - position) // 4 or not has_valid_times:
        raise ValueError(f"a group of {count} containers at {at} does not fit")
    lengths = struct.unpack_from(f"<{count}I", payload, position)
    position += 4 * count
    if sum(lengths) + cells > len(payload) - position:
        raise ValueError(f"{sum(lengths) + cells} bytes of containers do not fit")
    payloads: list[bytes] = []
    for length in lengths:
        payloads.append(payload[position : position + length])
        position += length
    end, head = position + cells, (number, application, endian, flags, owner, call, clock, at)
    group: ResultGroup = new_tuple(
        ResultGroup, (*head, trigger, latency, payloads, payload[position:end])
    )
    return group, end


# ---------------------------------------------------------------------- triggers

_TRIGGER = struct.Struct("<4sQQddqqIBB")
_TRIGGER_MAGIC = b"sct1"
_WAIT, _BY_APPLICATION, _INPUT, _RESERVED = 1, 2, 4, 8
_RESERVATION = struct.Struct("<Q")
_REPLY = struct.Struct("<4sQQdQI")
_REPLY_MAGIC = b"sco1"


class TriggerCall(NamedTuple):
    """A call for a trigger.

    Attributes:
        call: number of the call.
        epoch: number of the start of the called agent.
        deadline: time of the agent's clock at which the call ends, seconds.
        timeout: the user's timeout, seconds.
        application: application that must run for the trigger; None for any.
        expected: application whose results are expected; None for any.
        results: number of results of the trigger.
        wait: whether to wait until the camera takes the trigger.
        by_application: whether each application has its own interpretation.
        data: input of the trigger; None for none.
        layouts: layouts with a field for the sequence number of a result; None for none.
        reservation: number of the call that reserved the camera; None outside of a reservation.
    """

    call: int
    epoch: int
    deadline: float
    timeout: float
    application: int | None
    expected: int | None
    results: int
    wait: bool
    by_application: bool
    data: bytes | None
    layouts: Any = None
    reservation: int | None = None


def encode_trigger(program: str, call: TriggerCall) -> bytes:
    """Return a call of ``program`` as bytes; a call with layouts becomes a JSON message."""
    number, epoch, deadline, timeout, application, expected, results, wait, by_application, data = (
        call[:10]
    )
    layouts, reservation = call.layouts, call.reservation
    flags = wait * _WAIT | by_application * _BY_APPLICATION | (data is not None) * _INPUT
    if reservation is not None:
        flags |= _RESERVED
    name = program.encode()
    if layouts is None:
        try:
            reservation_bytes = b"" if reservation is None else _RESERVATION.pack(reservation)
            head = _TRIGGER.pack(
                _TRIGGER_MAGIC,
                number,
                epoch,
                deadline,
                timeout,
                _NONE if application is None else application,
                _NONE if expected is None else expected,
                results,
                flags,
                len(name),
            )
        except struct.error:
            pass  # the agent reports wrong numbers
        else:
            return b"".join((head, name, reservation_bytes, data or b""))
    fields: dict[str, Any] = {
        "program": program,
        "call": number,
        "do": "trigger",
        "epoch": epoch,
        "deadline": deadline,
        "timeout": timeout,
        "arguments": {
            "application": application,
            "expected": expected,
            "results": results,
            "wait": wait,
            "by_application": by_application,
            "layouts": layouts,
        },
    }
    if reservation is not None:
        fields["reservation"] = reservation
    return encode(fields, () if data is None else (data,))


def decode_trigger(payload: bytes, label: str) -> tuple[str, TriggerCall] | None:
    """Return the program and its call in ``payload``; None if it is a JSON message.

    Raises:
        RemoteProtocolError: the payload is broken; ``label`` names it.
    """
    if payload[:4] != _TRIGGER_MAGIC:
        return None
    try:
        (_, number, epoch, deadline, timeout, application, expected, results, flags, size) = (
            _TRIGGER.unpack_from(payload)
        )
        end = _TRIGGER.size + size
        program, reservation = str(payload[_TRIGGER.size : end], "utf-8"), None
        if flags & _RESERVED:
            (reservation,) = _RESERVATION.unpack_from(payload, end)
            end += _RESERVATION.size
        if len(payload) < end or (len(payload) > end and not flags & _INPUT):
            raise ValueError(f"{len(payload)} bytes came, {end} were expected")
    except (ValueError, struct.error) as exc:
        raise RemoteProtocolError(f"{label} is broken: {exc}") from exc
    call: TriggerCall = new_tuple(
        TriggerCall,
        (
            number,
            epoch,
            deadline,
            timeout,
            None if application == _NONE else application,
            None if expected == _NONE else expected,
            results,
            flags & _WAIT != 0,
            flags & _BY_APPLICATION != 0,
            payload[end:] if flags & _INPUT else None,
            None,
            reservation,
        ),
    )
    return program, call


class TriggerReply(NamedTuple):
    """The reply to a successful trigger.

    Attributes:
        call: the number of the call.
        epoch: number of the agent's start.
        clock: time of the agent's clock, seconds.
        next_state: number of the agent's next event.
        new_states: events that the agent has not published yet.
        results: results of the trigger, and the agent's next number.
    """

    call: int
    epoch: int
    clock: float
    next_state: int
    new_states: list[bytes]
    results: ResultsMessage


def encode_trigger_reply(
    call: int, epoch: int, clock: float, states: int, new_states: Sequence[bytes], groups: bytes
) -> bytes:
    """Return a reply as bytes; ``groups`` is in the form of :func:`encode_groups`."""
    count = len(new_states)
    head = _REPLY.pack(_REPLY_MAGIC, call, epoch, clock, states, count)
    lengths = struct.pack(f"<{count}I", *map(len, new_states))
    return b"".join((head, lengths, *new_states, groups))


def decode_trigger_reply(payload: bytes, label: str) -> TriggerReply | None:
    """Return the reply to a trigger in ``payload``; None if it is a JSON message.

    Raises:
        RemoteProtocolError: the payload is broken; ``label`` names it.
    """
    if payload[:4] != _REPLY_MAGIC:
        return None
    try:
        _, call, epoch, clock, states, count = _REPLY.unpack_from(payload)
        position = _REPLY.size
        lengths = struct.unpack_from(f"<{count}I", payload, position)
        position += 4 * count
        new_states: list[bytes] = []
        for length in lengths:
            new_states.append(payload[position : position + length])
            position += length
        if position > len(payload):
            raise ValueError(f"{position} bytes were announced, {len(payload)} came")
    except (ValueError, struct.error) as exc:
        raise RemoteProtocolError(f"{label} is broken: {exc}") from exc
    results = decode_groups(payload[position:], label)
    fields = (call, epoch, clock, states, new_states, results)
    reply: TriggerReply = new_tuple(TriggerReply, fields)
    return reply


def timestamp(at: datetime | None) -> float:
    """Return a time as seconds since 1970; NaN for None."""
    return _NO_NUMBER if at is None else at.timestamp()


def encode_each(groups: Iterable[ResultGroup]) -> list[bytes]:
    """Return the bytes of each group."""
    return [group.encode() for group in groups]
