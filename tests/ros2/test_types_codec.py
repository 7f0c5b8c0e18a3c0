"""Bytes of messages, compared with rosbags, in both byte orders."""

from __future__ import annotations

import random
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from smartcam.exceptions import RosMessageError
from smartcam.ros2 import RosTypes
from smartcam.ros2._inside import MessageType
from tests.ros2.inside import MESSAGES
from tests.ros2.typekit import add_test_msgs, drawn

TYPES = RosTypes("jazzy")
TYPES_OF_TESTS = RosTypes("jazzy")
TEST_MSGS = add_test_msgs(TYPES_OF_TESTS)
STRING = TYPES.message("std_msgs/msg/String")
IMAGE = TYPES.message("sensor_msgs/msg/Image")
SCAN = TYPES.message("sensor_msgs/msg/LaserScan")
PARAMETER = TYPES.message("rcl_interfaces/msg/ParameterValue")
DETECTIONS = TYPES.message("vision_msgs/msg/Detection3DArray")


def has_empty(kind: MessageType) -> bool:
    """Return whether a message without fields is within; rosbags gives those a field."""
    return not kind.fields or any(has_empty(one) for one in kind.nested.values())


USED = ("diagnostic_msgs", "lifecycle_msgs", "rcl_interfaces", "tf2_msgs", "vision_msgs")


@pytest.mark.parametrize(
    ("distribution", "packages", "least"),
    [
        pytest.param("jazzy", USED, 30, id="what we send"),
        *(
            pytest.param(one, ("",), 150, id=one, marks=pytest.mark.long)
            for one in ("humble", "jazzy", "kilted", "lyrical")
        ),
    ],
)
def test_bytes_are_those_of_rosbags(
    distribution: str, packages: tuple[str, ...], least: int
) -> None:
    store = get_typestore(Stores(f"ros2_{distribution}"))
    types = RosTypes(distribution)
    for name, text in MESSAGES.items():
        store.register(get_types_from_msg(text, name))
    draw = random.Random(24)  # noqa: S311
    names = [name for name in sorted(store.fielddefs) if name.startswith(packages)]
    kinds = [kind for kind in map(types.message, names) if not has_empty(kind)]
    assert len(kinds) > least
    for kind in kinds:
        message = drawn(kind, draw, 2)
        data = kind.encode(message)
        assert data == store.serialize_cdr(message, kind.name, little_endian=True), kind
        assert kind.decode(data) == message
        theirs = store.deserialize_cdr(data, kind.name)
        assert kind.encode(theirs) == data
        big = store.serialize_cdr(message, kind.name, little_endian=False)
        assert kind.decode(big) == message, kind


@pytest.mark.parametrize("name", TEST_MSGS)
def test_every_shape_comes_back(name: str) -> None:
    kind = TYPES_OF_TESTS.message(name)
    draw = random.Random(24)  # noqa: S311
    for _ in range(20):
        message = drawn(kind, draw)
        data = kind.encode(message)
        assert kind.decode(data) == message
        assert kind.encode(kind.decode(data)) == data


def test_bytes_by_hand() -> None:
    """Encapsulation, length with the end, and alignment from behind the encapsulation."""
    assert STRING.encode({"data": "µ"}).hex() == "0001000003000000c2b500"
    types = RosTypes()
    fields = ("byte a", "float64 b", "bool c", "string d", "int16[] e", "float64[] f", "int8 g")
    types.add("pkg/msg/Mixed", "\n".join(fields))
    kind = types.message("pkg/msg/Mixed")
    data = kind.encode({"a": 255, "b": 1.0, "c": True, "d": "hi", "e": [-2], "g": -1})
    assert data == bytes.fromhex(
        "00010000 ff000000 00000000 00000000 0000f03f 01000000 03000000 68690000 01000000 "
        "feff0000 00000000 ff"
    )
    assert TYPES.message("std_msgs/msg/Empty").encode({}).hex() == "0001000000"


def test_zero_values_and_defaults() -> None:
    assert repr(TYPES.message("geometry_msgs/msg/Pose").new()) == (
        "Pose(position=Point(x=0.0, y=0.0, z=0.0), "
        "orientation=Quaternion(x=0.0, y=0.0, z=0.0, w=1.0))"
    )
    camera = TYPES.message("sensor_msgs/msg/CameraInfo").new()
    assert camera.header.frame_id == ""
    assert camera.k.tolist() == [0.0] * 9
    assert camera.d.dtype == np.float64
    assert camera.d.size == 0
    assert TYPES.message("sensor_msgs/msg/NavSatStatus").new().status == -2
    assert RosTypes("humble").message("sensor_msgs/msg/NavSatStatus").new().status == 0
    asks = TYPES.service("type_description_interfaces/srv/GetTypeDescription").request
    assert asks.new().include_type_sources is True


def test_zero_values_are_not_shared() -> None:
    one, other = DETECTIONS.new(), DETECTIONS.new()
    one.header.frame_id = "a"
    one.detections.append(1)
    assert other == DETECTIONS.new()
    kind = TYPES.message("geometry_msgs/msg/PoseWithCovariance")
    kind.new().covariance[0] = 1.0
    assert kind.new().covariance[0] == 0.0


def test_messages_within_may_be_mappings() -> None:
    found = [{"results": [{"hypothesis": {"class_id": "bolt", "score": 0.5}}]}]
    message = DETECTIONS.new(header={"frame_id": "cam"}, detections=found)
    assert message.header.frame_id == "cam"
    assert message.detections[0].results[0].hypothesis.class_id == "bolt"
    assert message.detections[0].bbox.center.orientation.w == 1.0
    assert DETECTIONS.encode(message) == DETECTIONS.encode(
        {"header": {"frame_id": "cam"}, "detections": found}
    )


BAD_FIELDS: dict[str, tuple[MessageType, dict[str, Any], str]] = {
    "unknown": (
        STRING,
        {"date": "x"},
        "date: std_msgs/msg/String has no such field, expected data",
    ),
    "number for text": (STRING, {"data": 1}, "data: expected string, got 1"),
    "NUL": (STRING, {"data": "a\0b"}, "data: expected string, got 'a\\x00b'"),
    "surrogate": (STRING, {"data": "\ud800"}, "data: expected string"),
    "bytes for text": (STRING, {"data": b"x"}, "data: expected string, got b'x'"),
    "too large": (IMAGE, {"width": 1 << 32}, "width: expected uint32, got 4294967296"),
    "negative": (IMAGE, {"width": -1}, "width: expected uint32, got -1"),
    "no integer": (IMAGE, {"width": 1.0}, "width: expected uint32, got 1.0"),
    "within": (IMAGE, {"header": {"stamp": {"sec": 1 << 31}}}, "header.stamp.sec: expected int32"),
    "unknown within": (
        IMAGE,
        {"header": {"stamp": {"s": 1}}},
        "header.stamp.s: builtin_interfaces/",
    ),
    "other message": (IMAGE, {"header": STRING.new()}, "header: expected std_msgs/Header, got S"),
    "text for bytes": (IMAGE, {"data": "x"}, "data: expected uint8[], got 'x'"),
    "byte too large": (IMAGE, {"data": [256]}, "data: expected uint8[], got [256]"),
    "array of others": (IMAGE, {"data": np.array([-1])}, "data: expected uint8[], got [-1]"),
    "two dimensions": (IMAGE, {"data": np.zeros((2, 2), np.uint8)}, "data: expected uint8[]"),
    "floats for bytes": (IMAGE, {"data": np.zeros(2)}, "data: expected uint8[]"),
    "bytes for floats": (SCAN, {"ranges": b"1234"}, "ranges: expected float32[], got b'1234'"),
    "float32 too large": (SCAN, {"range_max": 1e39}, "range_max: expected float32, got 1e+39"),
    "float32s too large": (SCAN, {"ranges": np.array([1e39])}, "ranges: expected float32[]"),
    "text for number": (SCAN, {"range_max": "1"}, "range_max: expected float32, got '1'"),
    "none": (SCAN, {"range_max": None}, "range_max: expected float32, got None"),
    "no flag": (PARAMETER, {"bool_value": 2}, "bool_value: expected bool, got 2"),
    "no flags": (PARAMETER, {"bool_array_value": [True, 2]}, "bool_array_value: expected bool[]"),
    "text for list": (PARAMETER, {"string_array_value": "ab"}, "expected string[], got 'ab'"),
    "text in list": (
        PARAMETER,
        {"string_array_value": ["a", 1]},
        "string_array_value[1]: expected",
    ),
    "no list": (DETECTIONS, {"detections": {}}, "detections: expected vision_msgs/Detection3D[]"),
    "in list": (
        DETECTIONS,
        {"detections": [{"results": [{"hypothesis": {"score": "1"}}]}]},
        "detections[0].results[0].hypothesis.score: expected float64, got '1'",
    ),
    "too short": (
        DETECTIONS,
        {"detections": [{"results": [{"pose": {"covariance": [0.0] * 35}}]}]},
        "pose.covariance: expected float64[36], got",
    ),
    "beyond the bound": (
        TYPES.message("rcl_interfaces/msg/ParameterDescriptor"),
        {"integer_range": [{}, {}]},
        "integer_range: expected rcl_interfaces/IntegerRange[<=1]",
    ),
    "text too long": (
        TYPES_OF_TESTS.message("test_msgs/msg/Strings"),
        {"bounded_string_value": "ä" * 12},
        "bounded_string_value: expected string<=22",
    ),
}


@pytest.mark.parametrize("case", BAD_FIELDS)
def test_fields_that_do_not_fit(case: str) -> None:
    kind, fields, says = BAD_FIELDS[case]
    with pytest.raises(RosMessageError) as caught:
        kind.new(**fields)
    assert str(caught.value).startswith(f"{kind.name}: ")
    assert says in str(caught.value)


@pytest.mark.parametrize(
    "case",
    [one for one in BAD_FIELDS if one not in ("unknown", "unknown within", "in list", "too short")],
)
def test_fields_that_were_set_and_do_not_fit(case: str) -> None:
    """A message is made whole, and then a field of it is set."""
    kind, fields, says = BAD_FIELDS[case]
    message = kind.new()
    inner, at = message, kind
    for name, value in fields.items():
        while isinstance(value, dict) and value:
            at = at.nested[next(one.type for one in at.fields if one.name == name)]
            inner = getattr(inner, name)
            ((name, value),) = value.items()
        setattr(inner, name, value)
    with pytest.raises(RosMessageError) as caught:
        kind.encode(message)
    assert str(caught.value).startswith(f"{kind.name}: ")
    assert says in str(caught.value) or case in ("other message", "beyond the bound", "no list")


def test_another_message_is_refused() -> None:
    with pytest.raises(
        RosMessageError, match=r"String: expected a message of this type, got sensor"
    ):
        STRING.encode(IMAGE.new())
    with pytest.raises(RosMessageError, match="String: expected a message of this type, got str"):
        STRING.encode("x")
    message = IMAGE.new()
    message.header = TYPES.message("std_msgs/msg/Bool").new()
    with pytest.raises(RosMessageError, match=r"header: expected std_msgs/Header, got Bool"):
        IMAGE.encode(message)
    del message.header
    with pytest.raises(RosMessageError, match=r"header: expected std_msgs/Header, got none"):
        IMAGE.encode(message)


def test_numbers_may_be_of_many_kinds() -> None:
    data = bytes(range(10))
    ways: list[Any] = [data, bytearray(data), memoryview(data), list(data), tuple(data)]
    ways += [np.frombuffer(data, np.uint8), np.arange(10), np.arange(20, dtype=np.uint8)[::2] // 2]
    assert len({IMAGE.encode(IMAGE.new(data=way)) for way in ways}) == 1
    floats: list[Any] = [[0, 1.5], np.array([0, 1.5]), np.array([0, 1.5], ">f4")]
    assert len({SCAN.encode(SCAN.new(ranges=way)) for way in floats}) == 1
    assert STRING.decode(bytearray(STRING.encode({"data": "x"}))).data == "x"
    assert STRING.decode(memoryview(STRING.encode({"data": "x"}))).data == "x"


def test_a_picture_is_not_copied_when_it_is_read() -> None:
    data = IMAGE.encode(IMAGE.new(width=4, data=b"abcd"))
    read = IMAGE.decode(data).data
    assert bytes(read) == b"abcd"
    assert np.shares_memory(read, np.frombuffer(data, np.uint8))
    assert not read.flags.writeable


# ------------------------------------------------------------------------------------ bad bytes


def image(count: int, data: bytes = b"") -> bytes:
    """Return a picture whose bytes are said to be so many."""
    whole = IMAGE.encode(IMAGE.new(data=b""))
    return whole[:-4] + struct.pack("<I", count) + data


BAD_BYTES: dict[str, tuple[MessageType, bytes, str]] = {
    "nothing": (STRING, b"", "0 bytes: none"),
    "too little": (STRING, b"\0\1\0", "3 bytes: 00 01 00"),
    "parameter list": (STRING, b"\0\3\0\0", "expected CDR with its encapsulation"),
    "CDR 2": (STRING, b"\0\7\0\0\1\0\0\0\0", "expected CDR with its encapsulation"),
    "no length": (STRING, b"\0\1\0\0", "4 bytes are no such message"),
    "beyond": (
        STRING,
        b"\0\1\0\0\xff\xff\xff\xffx\0",
        "a string of 4294967295 bytes at 8, where 2",
    ),
    "no end": (STRING, b"\0\1\0\0\2\0\0\0ab", "not with one NUL, at its end"),
    "NUL within": (STRING, b"\0\1\0\0\3\0\0\0\0a\0", "not with one NUL"),
    "no UTF-8": (STRING, b"\0\1\0\0\2\0\0\0\xff\0", "utf-8"),
    "rubbish": (STRING, b"\0\1\0\0\2\0\0\0a\0rub", "expected 10 bytes, got 13: 3 follow"),
    "rubbish to four": (STRING, b"\0\1\0\0\2\0\0\0a\0ru", "expected 10 bytes, got 12: 2 follow"),
    "a message too much": (STRING, b"\0\1\0\0\2\0\0\0a\0\0\0\0\0\0\0", "6 follow"),
    "huge": (IMAGE, image(4_000_000_000), "4000000000 numbers of uint8 at "),
    "huge list": (
        DETECTIONS,
        DETECTIONS.encode(DETECTIONS.new())[:-4] + b"\0\0\0\xf0",
        "4026531840 items where 0 bytes are left",
    ),
    "one too few": (IMAGE, image(3, b"ab"), "3 numbers of uint8"),
    "flag": (TYPES.message("std_msgs/msg/Bool"), b"\0\1\0\0\2", "no such message"),
    "beyond the bound": (
        TYPES.message("rcl_interfaces/msg/ParameterDescriptor"),
        TYPES.message("rcl_interfaces/msg/ParameterDescriptor").encode({})[:-4] + b"\2\0\0\0" * 9,
        "expected up to 1 items, got 2",
    ),
}


@pytest.mark.parametrize("case", BAD_BYTES)
def test_bytes_that_are_no_such_message(case: str) -> None:
    kind, data, says = BAD_BYTES[case]
    with pytest.raises(RosMessageError) as caught:
        kind.decode(data)
    assert str(caught.value).startswith(f"{kind.name}: ")
    assert says in str(caught.value)


def test_what_is_no_bytes_is_refused() -> None:
    with pytest.raises(RosMessageError, match="expected bytes, got str"):
        STRING.decode("x")  # type: ignore[arg-type]


def test_padding_to_four_bytes_is_taken() -> None:
    """Recordings of other middlewares have it."""
    assert STRING.decode(b"\0\1\0\0\2\0\0\0a\0\0\0").data == "a"
    assert STRING.decode(b"\0\1\0\0\0\0\0\0").data == ""


FUZZED = (
    *("sensor_msgs/msg/CameraInfo", "vision_msgs/msg/Detection3DArray"),
    *("rcl_interfaces/msg/ParameterEvent", "diagnostic_msgs/msg/DiagnosticArray"),
    *("tf2_msgs/msg/TFMessage", "sensor_msgs/msg/PointCloud2", "smartcam_msgs/msg/Result"),
)


def is_message_or_refused(kind: MessageType, data: bytes) -> None:
    """Read bytes; only one error may come of it, and what is read can be written and read again."""
    try:
        message = kind.decode(data)
    except RosMessageError:
        return
    again = kind.encode(message)
    assert kind.encode(kind.decode(again)) == again


@given(
    name=st.sampled_from(FUZZED),
    seed=st.integers(0, 1000),
    changes=st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), max_size=4),
    cut=st.integers(0, 40) | st.none(),
)
def test_changed_bytes_are_a_message_or_an_error(
    name: str, seed: int, changes: list[tuple[int, int]], cut: int | None
) -> None:
    kind = TYPES.message(name)
    data = bytearray(kind.encode(drawn(kind, random.Random(seed), 2)))  # noqa: S311
    for place, value in changes:
        data[place % len(data)] = value
    changed = bytes(data if cut is None else data[: max(0, len(data) - cut)])
    is_message_or_refused(kind, changed)


@given(name=st.sampled_from(FUZZED), data=st.binary(max_size=200), order=st.booleans())
def test_any_bytes_are_a_message_or_an_error(name: str, data: bytes, order: bool) -> None:
    kind = TYPES.message(name)
    is_message_or_refused(kind, (b"\0\1\0\0" if order else b"\0\0\0\0") + data)
