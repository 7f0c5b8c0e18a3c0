"""The recorder's JSON is that of the standard library, character for character."""

from __future__ import annotations

import enum
import json
import math
import struct
import sys
import types
from collections import namedtuple
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone
from fractions import Fraction
from random import Random
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from smartcam._json import MIN_HEX_CHARACTERS as LONG
from smartcam._json import json_of, object_json, plain
from smartcam.interpreters import Context, resolve
from smartcam.layout import Layout
from smartcam.models import (
    Header,
    Localization,
    Pose,
    PoseSigma,
    Position,
    Quaternion,
    Result,
    Status,
    jsonable,
)
from smartcam.observers import RawFrame, TraceEntry
from smartcam.protocols import BVS, Frame
from smartcam.protocols._inside import INSIGHT
from smartcam.protocols.messages import Sender
from smartcam.recording._mcap.json import MAX_CACHED_FRAME_TEXTS, FrameTexts, data_of, frame_text
from tests.recording.inside import KINDS, message_fields, message_of, nanoseconds
from tests.recording.recordingkit import at

if TYPE_CHECKING:
    from tests.recording.inside import Item

Pair = namedtuple("Pair", "left right")  # noqa: PYI024 - as somebody's plug-in has it


def plainly(item: Item) -> bytes:
    """Return an item's message as the slow way makes it."""
    fields = {name: field for name, field in jsonable(item).items() if field is not None}
    return json.dumps(fields, separators=(",", ":")).encode()


def result(value: Any, **fields: Any) -> Result[Any]:
    made: Result[Any] = Result("left", 5, None, 1, None, at(0), None, b"\x00\xff", value)
    return made._replace(**fields)


FLOATS = st.floats() | st.sampled_from([0.0, -0.0, 1e300, math.nan, math.inf])
LEAVES = (
    st.none()
    | st.booleans()
    | st.integers()
    | FLOATS
    | st.text()
    | st.binary()
    | st.datetimes(timezones=st.just(UTC))
)
VALUES = st.recursive(
    LEAVES,
    lambda some: (
        st.lists(some)
        | st.tuples(some, some)
        | st.builds(Pair, some, some)
        | st.dictionaries(st.text() | st.integers() | st.booleans(), some)
    ),
    max_leaves=8,
)
HEADERS = st.builds(Header, st.integers(), st.just(at(1)), st.text() | st.none())
LOCALIZATIONS = st.builds(
    Localization,
    st.text(),
    FLOATS,
    st.integers(),
    st.builds(
        Pose,
        HEADERS,
        st.builds(Position, FLOATS, FLOATS, FLOATS),
        st.builds(Quaternion, FLOATS, FLOATS, FLOATS, FLOATS),
    ),
)
PART: Any = Localization("a", 1.0, 0, Pose(Header(1, at(1), "x"), Position(1, 2, 3), Quaternion()))


@given(st.dictionaries(st.text(), VALUES | st.lists(LOCALIZATIONS) | LOCALIZATIONS))
@example({"value": [PART], "at": at(1), "raw": b"\x00\xff", "nan": [math.nan], "-": -0.0})
def test_text_is_that_of_the_standard_library(fields: dict[str, Any]) -> None:
    text = json.dumps(jsonable(fields), separators=(",", ":"))
    assert object_json(fields) == json_of(fields) == text
    assert object_json(plain(fields)) == text


COLUMNS = st.sampled_from(["<i2", ">i4", "u1", "<u8", "<f2", "<f4", ">f8", "?", "S3", "U2"])
SHAPES = st.sampled_from([(), (0,), (1,), (3,), (2, 2)])


@given(
    st.dictionaries(st.text(min_size=1, max_size=4), COLUMNS, min_size=1, max_size=4),
    SHAPES,
    st.binary(min_size=400, max_size=400),
)
@example({"100%": "<f4", '"': "S3"}, (1,), bytes(400))
@example({"x": "<f4", "y": "<f8"}, (3,), b"\xff" * 400)  # NaN
@example({"x": "<f8"}, (3,), bytes.fromhex("000000000000f07f") * 50)  # infinity
def test_text_of_a_table_is_that_of_the_standard_library(
    columns: dict[str, str], shape: tuple[int, ...], data: bytes
) -> None:
    if {"?", "U2"} & {*columns.values()}:
        data = bytes(len(data))  # not every byte is one of these
    dtype = np.dtype([*columns.items()])
    count = int(np.prod(shape))
    table = np.frombuffer(data, dtype=dtype, count=count).reshape(shape)
    assert json_of(table) == json.dumps(jsonable(table), separators=(",", ":"))


@pytest.mark.parametrize(
    "value", [[{"x": (1, 2)}], [[1.5], None], {"of": [b"\xff"]}, Fraction(1, 2)]
)
def test_text_is_made_while_another_thread_imports_numpy(
    value: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = json_of(value)
    monkeypatch.setitem(sys.modules, "numpy", types.ModuleType("numpy"))  # as it is at first
    assert json_of(value) == json.dumps(jsonable(value), separators=(",", ":")) == text


@given(VALUES | st.lists(LOCALIZATIONS) | st.lists(VALUES | LOCALIZATIONS))
@example([PART])  # integers where there are floats otherwise
@example([PART._replace(quality=np.float32(0.5))])
@example([PART._replace(quality=True)])
@example([PART._replace(pose=PART.pose.with_sigma(PoseSigma(0.1, math.nan, 0.2, z=0.3)))])
@example([PART._replace(pose=None)])
@example([PART._replace(photo_index="first")])
def test_result_is_written_as_the_slow_way_writes_it(value: Any) -> None:
    assert message_of("results", result(value)) == plainly(result(value))


@given(
    st.tuples(st.text(), st.integers(), st.none() | st.integers(), st.integers()),
    st.none() | st.datetimes(timezones=st.just(UTC)),
    st.none() | FLOATS,
    st.binary(),
)
def test_result_fields_are_written_as_the_slow_way_writes_them(
    first: tuple[Any, ...], triggered_at: datetime | None, latency: float | None, raw: bytes
) -> None:
    received_at = at(0).astimezone(timezone(timedelta(hours=2)))
    one: Result[Any] = Result._make((*first, triggered_at, received_at, latency, raw, None))
    assert message_of("results", one) == plainly(one)


@given(st.binary(), st.none() | st.integers(1, 9))
def test_bytes_of_a_result_are_written_once_or_not_at_all(raw: bytes, raw_from: int | None) -> None:
    came = json.loads(message_of("results", result(raw, raw=raw), raw_from))
    assert came.pop("value_from") == "raw"
    assert ("raw" in came) == (raw_from is None)
    assert came.pop("raw_from", None) == raw_from
    assert {**came, "raw": raw.hex(), "value": raw.hex()} == json.loads(
        plainly(result(raw, raw=raw))
    )


def test_value_of_a_result_is_from_nothing_but_its_bytes() -> None:
    fields = {**message_fields(message_of("results", result(None))), "value_from": "frame"}
    with pytest.raises(ValueError, match="value_from: 'frame' came, expected raw"):
        KINDS["results"].from_json(fields)


TABLE = np.array(
    [(1, 0.5, b"a1", True), (2, 1.5, b"\xff\xfe", False)],
    dtype=[("n", "<i4"), ("x", "<f4"), ("code", "S4"), ("ok", "?")],
)


class Colour(enum.Enum):
    RED = "red"


@dataclass
class Found:
    colour: Colour
    at: float


@pytest.mark.parametrize(
    "value",
    [
        TABLE,
        TABLE[:0],
        TABLE.reshape(1, 2),
        np.array([(math.nan,)], dtype=[("x", "<f8")]),
        np.array([((1, 2),)], dtype=[("p", [("x", "<i2"), ("y", "<i2")])]),
        np.array([([1, 2],)], dtype=[("p", "<i2", 2)]),
        np.array([("äöü",)], dtype=[("t", "U3")]),
        np.array([[1.0, math.inf]]),
        np.float64(0.1),
        {"a": np.int16(3), 4: [np.bool_(True)]},
        [Found(Colour.RED, 0.5), Pair(1, [Pair(2, b"\x01")])],
        Status.RUNNING | Status.WAITING_FOR_TRIGGER,
        [Status.RUNNING],
        Layout("passed: bool, x: real32 mm, code: string[4]").parse(
            b"\xff" + struct.pack("<f4s", 12.5, b"A1")
        ),
        resolve("localizations").read(  # type: ignore[attr-defined]
            struct.pack("<50sfifff", b"part", 0.97, 0, 0.1, 0.2, 0.5) * 3, Context(camera="left")
        ),
        object(),
        {1, 2},
        memoryview(b"\x01\x02"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_result_value_of_any_kind_is_written_as_the_slow_way_writes_it(value: Any) -> None:
    assert message_of("results", result(value)) == plainly(result(value))


LONG_HEX = bytes(range(256)).hex() * (LONG // 256)


@given(
    st.none() | st.integers(),
    st.text(),
    st.none() | st.dictionaries(st.text(), VALUES),
    st.text() | st.binary().map(bytes.hex) | st.text(min_size=LONG + 1, max_size=LONG + 20),
)
@example(32, "ResultContainer", {"application": 5, "data": LONG_HEX}, "00" + LONG_HEX)
@example(32, "ResultContainer", {"data": LONG_HEX + '"'}, "00" + LONG_HEX + '"')
@example(32, "ResultContainer", {"data": LONG_HEX + "é"}, "00" + LONG_HEX + "é")
@example(32, "ResultContainer", {"data": LONG_HEX + "\n"}, "00")
def test_frame_is_written_as_the_slow_way_writes_it(
    message_id: int | None, message: str, fields: dict[str, Any] | None, data: str
) -> None:
    entry = TraceEntry(at(0), "left", "<", message_id, message, fields, data)
    written = message_of("frames", entry)
    if b'"data_from":' not in written:
        assert written == plainly(entry)
        return
    came = json.loads(written)
    came["fields"]["data"] = data[2 * came.pop("data_from") :]
    assert came == json.loads(plainly(entry))


@given(st.binary(max_size=40), st.binary(max_size=40), st.none() | st.integers())
def test_data_of_a_frame_is_written_once_and_read_again(
    head: bytes, data: bytes, application: int | None
) -> None:
    fields: dict[str, Any] = {"application": application, "data": data.hex()}
    entry = TraceEntry(at(0), "left", "<", 32, "ResultContainer", fields, (head + data).hex())
    written = message_of("frames", entry)
    assert (b'"data":' in written) == (not data)
    assert KINDS["frames"].from_json(message_fields(written)) == entry


@pytest.mark.parametrize("data_from", [-1, 2, 3, 1 << 40])
def test_data_of_a_frame_begins_within_it(data_from: int) -> None:
    entry = TraceEntry(at(0), "left", "<", 32, "ResultContainer", None, "aabb")
    fields = {**message_fields(message_of("frames", entry)), "data_from": data_from}
    with pytest.raises(ValueError, match=r"data_from: .* expected an offset below 2"):
        KINDS["frames"].from_json(fields)


@given(st.datetimes(timezones=st.just(UTC)) | st.just(at(0).astimezone(timezone(timedelta(1 / 3)))))
def test_nanoseconds_are_exact_and_never_negative(when: datetime) -> None:
    since = when - datetime(1970, 1, 1, tzinfo=UTC)
    assert nanoseconds(when) == max(0, since // timedelta(microseconds=1) * 1000)


DIALECTS = [*BVS.dialects.values(), *INSIGHT.dialects.values()]


@given(
    frames=st.lists(
        st.tuples(
            st.sampled_from(DIALECTS),
            st.sampled_from(Sender),
            # ids with data and without, and one that nobody has
            st.sampled_from([0x20, 0x21, 0x40, 0x41, 0x81, 0xFE]) | st.integers(0, 255),
            # fronts that come again, with other data behind them
            st.sampled_from([b"", bytes(2), bytes(4), b"\x05\0\0\0", bytes(6)]),
            st.binary(max_size=12),
        ),
        max_size=30,
    )
)
def test_texts_of_frames_that_are_alike_are_those_of_each(
    frames: list[tuple[Any, Sender, int, bytes, bytes]],
) -> None:
    texts = FrameTexts()
    for second, (dialect, sender, message_id, front, data) in enumerate(frames * 2):
        raw = RawFrame(at(second), "left", dialect, sender, Frame(message_id, front + data))
        entry = raw.entry()
        assert texts.text(raw) == (frame_text(entry), data_of(entry))


def test_texts_of_frames_of_a_delivery_are_those_of_each() -> None:
    texts, handbook, b16 = FrameTexts(), BVS.dialects["handbook"], BVS.dialects["b16"]
    once, again = at(0), at(0)
    kinds = [
        (when, camera, dialect, sender, message_id, front)
        for when in (once, again, at(1))
        for camera in ("left", "right")
        for dialect in (handbook, b16)
        for sender in Sender
        for message_id in (0x20, 0x12)
        for front in (bytes(4), b"\1\0\0\0")
    ]
    random = Random(3)  # noqa: S311
    for _ in range(400):
        when, camera, dialect, sender, message_id, front = random.choice(kinds)
        for _ in range(random.randrange(4)):
            data = random.randbytes(random.choice([0, 4, 4, 4, 9]))
            raw = RawFrame(when, camera, dialect, sender, Frame(message_id, front + data))
            entry = raw.entry()
            assert texts.text(raw) == (frame_text(entry), data_of(entry))


def test_kinds_of_frames_whose_texts_are_kept_are_bounded() -> None:
    texts, dialect = FrameTexts(), BVS.dialects["handbook"]
    (result,) = (
        number
        for number in range(256)
        if dialect.data_begins(Sender.CAMERA, number) is not None
        and RawFrame(at(0), "left", dialect, Sender.CAMERA, Frame(number, bytes(8))).entry().message
        == "ResultContainer"
    )
    for length in range(1000):
        raw = RawFrame(at(length), "left", dialect, Sender.CAMERA, Frame(result, bytes(8 + length)))
        entry = raw.entry()
        assert texts.text(raw) == (frame_text(entry), data_of(entry))
        assert 0 < len(texts._cached_texts) <= MAX_CACHED_FRAME_TEXTS
