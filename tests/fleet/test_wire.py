"""Encoding and decoding messages of a fleet, and broken ones."""

from __future__ import annotations

import math
import struct
from datetime import UTC, datetime
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from smartcam.exceptions import RemoteProtocolError
from tests.fleet.inside import (
    ResultGroup,
    TriggerCall,
    decode,
    decode_groups,
    decode_state,
    decode_trigger,
    decode_trigger_reply,
    encode,
    encode_groups,
    encode_state,
    encode_status,
    encode_trigger,
    encode_trigger_reply,
    timestamp,
)

NUMBERS = st.integers(0, 2**32 - 1)
CLOCKS = st.floats(-1e9, 1e9)
TIMES = st.datetimes(datetime(1970, 1, 2), datetime(2200, 1, 1)).map(  # noqa: DTZ001
    lambda at: at.replace(tzinfo=UTC)
)
JSON: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=6,
)  # fmt: skip
FIELDS = st.dictionaries(st.text(max_size=6).filter(lambda key: key != "blobs"), JSON, max_size=5)


@st.composite
def runs(draw: st.DrawFn) -> ResultGroup:
    """A run as an agent may say it."""
    own = draw(st.none() | TIMES)
    return ResultGroup(
        number=draw(st.integers(0, 2**40)),
        application=draw(NUMBERS),
        endian=draw(NUMBERS),
        flags=draw(st.integers(0, 255)),
        owner=draw(NUMBERS),
        call=draw(NUMBERS),
        clock=draw(CLOCKS),
        at=draw(TIMES).timestamp(),
        triggered_at=timestamp(own),
        latency=math.nan if own is None else draw(st.floats(0, 100)),
        payloads=draw(st.lists(st.binary(max_size=20), min_size=1, max_size=4)),
        cells=draw(st.binary(max_size=9)),
    )


def same(one: ResultGroup, other: ResultGroup) -> bool:
    """Return True if two runs are equal; NaN is NaN here."""
    return repr(one) == repr(other)


@given(fields=FIELDS, blobs=st.lists(st.binary(max_size=30), max_size=4))
def test_message_is_what_was_said(fields: dict[str, Any], blobs: list[bytes]) -> None:
    message = decode(encode(fields, blobs), "it")
    assert (message.fields, message.blobs) == (fields, blobs)


@given(some=st.lists(runs(), max_size=4), epoch=st.integers(0, 2**63), following=NUMBERS)
def test_runs_are_what_was_said(some: list[ResultGroup], epoch: int, following: int) -> None:
    batch = decode_groups(encode_groups(epoch, following, [one.encode() for one in some]), "it")
    assert (batch.epoch, batch.next_number) == (epoch, following)
    assert len(batch.groups) == len(some)
    for got, wanted in zip(batch.groups, some, strict=True):
        assert same(got, wanted)
        assert got.next == wanted.number + len(wanted.payloads)
        assert got.received_at.timestamp() == pytest.approx(wanted.at)
        assert (got.trigger_time is None) == math.isnan(wanted.triggered_at)


@given(run=runs(), number=st.integers(-3, 9))
def test_rest_of_a_run(run: ResultGroup, number: int) -> None:
    rest = run.since(run.number + number)
    assert rest.payloads == run.payloads[max(0, number) :]
    assert rest.number == run.number + max(0, number)
    assert number > len(run.payloads) or rest.next == run.next


ORDERS = st.builds(
    TriggerCall,
    call=st.integers(0, 2**64 - 1),
    epoch=st.integers(0, 2**64 - 1),
    deadline=CLOCKS,
    timeout=CLOCKS,
    application=st.none() | st.integers(-(2**63) + 1, 2**63 - 1),
    expected=st.none() | NUMBERS,
    results=NUMBERS,
    wait=st.booleans(),
    by_application=st.booleans(),
    data=st.none() | st.binary(max_size=9),
    layouts=st.none(),
    reservation=st.none() | st.integers(0, 2**64 - 1),
)


@given(order=ORDERS, program=st.text(max_size=60))
def test_order_is_what_was_said(order: TriggerCall, program: str) -> None:
    assert decode_trigger(encode_trigger(program, order), "it") == (program, order)


@pytest.mark.parametrize(
    ("field", "value"), [("application", 2**63), ("results", -1), ("layouts", "@sequence: uint32")]
)
def test_order_that_does_not_fit_is_a_message(field: str, value: Any) -> None:
    order = TriggerCall(1, 2, 3.0, 4.0, None, 5, 6, wait=True, by_application=False, data=b"7")
    payload = encode_trigger("it", order._replace(**{field: value}))
    assert decode_trigger(payload, "it") is None
    fields, blobs = decode(payload, "it")
    assert blobs == [b"7"]
    assert fields.pop("arguments") == {
        "application": None,
        "expected": 5,
        "results": 6,
        "wait": True,
        "by_application": False,
        "layouts": None,
        field: value,
    }
    assert fields == {
        "program": "it",
        "call": 1,
        "do": "trigger",
        "epoch": 2,
        "deadline": 3.0,
        "timeout": 4.0,
    }


@given(told=st.lists(st.binary(max_size=9), max_size=4), some=st.lists(runs(), max_size=3))
def test_outcome_is_what_was_said(told: list[bytes], some: list[ResultGroup]) -> None:
    batch = encode_groups(9, 8, [one.encode() for one in some])
    outcome = decode_trigger_reply(encode_trigger_reply(1, 2, 3.5, 4, told, batch), "it")
    assert outcome is not None
    assert outcome[:5] == (1, 2, 3.5, 4, told)
    assert repr(outcome.results) == repr(decode_groups(batch, "it"))


@given(number=NUMBERS, status=NUMBERS, endian=NUMBERS, application=st.none() | NUMBERS)
def test_status_is_what_was_said(
    number: int, status: int, endian: int, application: int | None
) -> None:
    fields = {
        "kind": "Status",
        "connected": True,
        "number": number,
        "status": status,
        "endian": endian,
        "application": application,
    }
    assert decode_state(encode_status(number, status, endian, application)) == fields
    assert decode_state(encode_state(fields)) == fields


@pytest.mark.parametrize("data", [b"", b"scs1", b"[]", b'{"number": "1"}', b"\xff"])
def test_what_is_no_state_is_told(data: bytes) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - json's own texts
        decode_state(data)


MESSAGE = encode({"call": 7, "do": "trigger", "arguments": {"a": [1, None]}}, [b"1234", b"", b"5"])
RUN = ResultGroup(5, 1, 0, 1, 2, 3, 1.5, 1.7e9, 1.7e9, 0.1, [b"abc", b"", b"de"], b"{}").encode()
BATCH = encode_groups(9, 8, [RUN, RUN])
ORDER = encode_trigger("it", TriggerCall(1, 2, 3.0, 4.0, None, 5, 6, True, False, None))
OUTCOME = encode_trigger_reply(1, 2, 3.0, 4, [b"abc", b"d"], BATCH)


@pytest.mark.parametrize("length", range(len(MESSAGE)))
def test_no_part_of_a_message_is_one(length: int) -> None:
    with pytest.raises(RemoteProtocolError, match=r"^a call is broken: "):
        decode(MESSAGE[:length], "a call")


@pytest.mark.sampled(every=5)
@pytest.mark.parametrize("length", range(len(BATCH)))
def test_no_part_of_runs_is_one(length: int) -> None:
    with pytest.raises(RemoteProtocolError, match=r"^a reply is broken: "):
        decode_groups(BATCH[:length], "a reply")


def test_nothing_may_stand_behind() -> None:
    for read, payload in (
        (decode, MESSAGE),
        (decode_groups, BATCH),
        (decode_trigger_reply, OUTCOME),
    ):
        with pytest.raises(RemoteProtocolError, match="1 bytes are left over"):
            read(payload + b"\0", "it")
    with pytest.raises(RemoteProtocolError, match=r"^it is broken: "):
        decode_trigger(ORDER + b"\0", "it")


@pytest.mark.sampled(every=5)
@pytest.mark.parametrize("length", range(4, len(OUTCOME)))
def test_no_part_of_a_trigger_is_one(length: int) -> None:
    with pytest.raises(RemoteProtocolError, match=r"^a reply is broken: "):
        decode_trigger_reply(OUTCOME[:length], "a reply")
    if length < len(ORDER):
        with pytest.raises(RemoteProtocolError, match=r"^a call is broken: "):
            decode_trigger(ORDER[:length], "a call")


def with_head(text: str, behind: bytes = b"") -> bytes:
    """Return a message by its JSON."""
    return struct.pack("<I", len(text)) + text.encode() + behind


@given(payload=st.binary(max_size=200) | st.binary(max_size=60).map(lambda b: with_head("{}", b)))
@example(with_head("[]"))
@example(with_head("7"))
@example(with_head("[" * 100_000))
@example(with_head("9" * 10_000))
@example(with_head('{"blobs": 7}'))
@example(with_head('{"blobs": null}'))
@example(with_head('{"blobs": [1e9]}', b"1"))
@example(with_head('{"blobs": [-1, 2]}', b"1"))
@example(with_head('{"blobs": ["1"]}', b"1"))
@example(with_head('{"blobs": [true]}', b"1"))
@example(with_head('{"blobs": [NaN]}', b"1"))
@example(struct.pack("<I", 2) + b"\xff\xfe")
def test_bytes_of_any_kind_are_a_message_or_broken(payload: bytes) -> None:
    try:
        message = decode(payload, "it")
    except RemoteProtocolError:
        return
    assert isinstance(message.fields, dict)
    assert sum(map(len, message.blobs)) < len(payload)
    assert decode(encode(message.fields, message.blobs), "it") == message


@given(data=st.data())
def test_changed_bytes_are_runs_that_can_be_read_or_broken(data: st.DataObject) -> None:
    changed = bytearray(BATCH)
    for _ in range(data.draw(st.integers(1, 4))):
        changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
    check_runs(bytes(changed))


@given(payload=st.binary(max_size=120), count=st.integers(0, 2**32 - 1))
def test_bytes_of_any_kind_are_runs_or_broken(payload: bytes, count: int) -> None:
    check_runs(payload)
    check_runs(struct.pack("<4sQQI", b"scr1", 1, 1, count) + payload)


def times(**more: float) -> bytes:
    """Return a batch of one run with such times."""
    fields: dict[str, Any] = {"clock": 0.0, "at": 1.7e9, "triggered_at": math.nan, "latency": 0.0}
    fields |= more
    run = ResultGroup(1, 1, 0, 0, 0, 0, payloads=[b"1"], **fields)
    return encode_groups(1, 2, [run.encode()])


@pytest.mark.parametrize("at", [math.inf, -math.inf, math.nan, 1e300, -1e300, 1e12])
def test_time_that_is_none_is_broken(at: float) -> None:
    with pytest.raises(RemoteProtocolError):
        decode_groups(times(at=at), "it")
    if not math.isnan(at):
        with pytest.raises(RemoteProtocolError):
            decode_groups(times(triggered_at=at), "it")


def check_runs(payload: bytes) -> None:
    """Have runs read, and everything of them that is used."""
    try:
        batch = decode_groups(payload, "it")
    except RemoteProtocolError:
        return
    for run in batch.groups:
        assert run.payloads
        assert run.size <= len(payload)
        assert isinstance(run.received_at, datetime)
        assert run.trigger_time is None or isinstance(run.trigger_time, datetime)
