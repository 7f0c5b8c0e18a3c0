"""Messages in a rosbridge's JSON."""

from __future__ import annotations

import base64
import json
import math
from typing import Any

import numpy as np
import pytest

from smartcam.exceptions import RosMessageError
from smartcam.ros2 import RosTypes
from tests.ros1.inside import RawBytes, encode_operation, from_json, ros1_name, to_json

TYPES = RosTypes()
HEADER = {"seq": 0, "stamp": {"secs": 3, "nsecs": 4}, "frame_id": "cam3"}
OURS = {"stamp": {"sec": 3, "nanosec": 4}, "frame_id": "cam3"}
POSE = {
    "position": {"x": 1.0, "y": 0.0, "z": 0.0},
    "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
}

EXAMPLES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "std_msgs/msg/String": ({"data": "grün"}, {"data": "grün"}),
    "std_msgs/msg/Header": (OURS, HEADER),
    "std_msgs/msg/Empty": ({}, {}),
    "std_msgs/msg/Bool": ({"data": True}, {"data": True}),
    "std_msgs/msg/UInt64": ({"data": 2**64 - 1}, {"data": 2**64 - 1}),
    "std_msgs/msg/Byte": ({"data": 255}, {"data": -1}),
    "std_msgs/msg/ByteMultiArray": (
        {"data": [0, 127, 128]},
        {"layout": {"dim": [], "data_offset": 0}, "data": [0, 127, -128]},
    ),
    "std_msgs/msg/Float64MultiArray": (
        {"data": np.array([0.5, -2.0])},
        {"layout": {"dim": [], "data_offset": 0}, "data": [0.5, -2.0]},
    ),
    "geometry_msgs/msg/PoseArray": (
        {"header": OURS, "poses": [{"position": {"x": 1.0}}]},
        {"header": HEADER, "poses": [POSE]},
    ),
    "sensor_msgs/msg/RegionOfInterest": (
        {"width": np.uint32(5), "do_rectify": True},
        {"x_offset": 0, "y_offset": 0, "height": 0, "width": 5, "do_rectify": True},
    ),
    "diagnostic_msgs/msg/DiagnosticStatus": (
        {"level": 2, "name": "a", "values": [{"key": "k", "value": "v"}]},
        {
            "level": 2,
            "name": "a",
            "message": "",
            "hardware_id": "",
            "values": [{"key": "k", "value": "v"}],
        },
    ),
}


def said(kind: str, fields: dict[str, Any]) -> Any:
    """Return a message as another program reads it."""
    form = TYPES.message(kind)
    parts = encode_operation(to_json(form, form.new(**fields)))
    return json.loads(
        "".join(
            base64.b64encode(one.data).decode() if isinstance(one, RawBytes) else one
            for one in parts
        )
    )


@pytest.mark.parametrize("kind", EXAMPLES)
def test_a_message_there_and_back(kind: str) -> None:
    fields, expected = EXAMPLES[kind]
    assert said(kind, fields) == expected
    form = TYPES.message(kind)
    assert from_json(form, expected) == form.new(**fields)


@pytest.mark.parametrize("data", [b"\x00\xfe\xff", bytearray(b"abcd"), np.arange(7, dtype="u1")])
def test_bytes_are_base64(data: Any) -> None:
    fields = {"header": OURS, "height": 1, "width": len(data), "encoding": "mono8", "data": data}
    found = said("sensor_msgs/msg/Image", fields)
    assert base64.b64decode(found["data"]) == bytes(data)
    form = TYPES.message("sensor_msgs/msg/Image")
    assert from_json(form, found) == form.new(**fields)
    assert from_json(form, {"data": [*bytes(data)]}) == form.new(data=bytes(data))


def test_bytes_are_those_of_the_moment() -> None:
    form, data = TYPES.message("sensor_msgs/msg/Image"), bytearray(b"before")
    parts = encode_operation(to_json(form, form.new(data=data)))
    data[:] = b"after!"
    (raw,) = [one for one in parts if isinstance(one, RawBytes)]
    assert bytes(raw.data) == b"before"
    assert len(raw) == len(base64.b64encode(raw.data))


def test_fields_with_another_name_in_ros1() -> None:
    found = said("sensor_msgs/msg/CameraInfo", {"k": np.arange(9.0), "d": [0.1]})
    assert (found["K"], found["D"]) == ([*map(float, range(9))], [0.1])
    assert not {"k", "d", "r", "p"} & {*found}
    form = TYPES.message("sensor_msgs/msg/CameraInfo")
    assert from_json(form, found).k.tolist() == found["K"]
    with pytest.raises(RosMessageError, match=r"k: no such field, expected .*D, K, R, P"):
        from_json(form, {"k": found["K"]})


def test_names_of_types() -> None:
    assert ros1_name("std_srvs/srv/Trigger") == "std_srvs/Trigger"
    assert ros1_name("smartcam_msgs/msg/Localization") == "smartcam_msgs/Localization"
    assert ros1_name("rcl_interfaces/msg/Log") is None
    assert ros1_name("vision_msgs/msg/Detection3DArray") is None


@pytest.mark.parametrize(
    ("kind", "json_form", "text"),
    [
        ("std_msgs/msg/String", {"dato": "a"}, "dato: no such field, expected data"),
        ("std_msgs/msg/String", {"data": 5}, "data: expected string, got 5"),
        ("std_msgs/msg/String", {"data": None}, "data: expected string"),
        ("std_msgs/msg/String", "a", "expected an object, got 'a'"),
        ("std_msgs/msg/String", ["a", "b"], "expected up to 1 values, got 2"),
        ("std_msgs/msg/Empty", {"a": 1}, "a: no such field, expected none"),
        ("std_msgs/msg/Bool", {"data": 2}, "data: expected bool, got 2"),
        ("std_msgs/msg/Bool", {"data": "true"}, "data: expected bool"),
        ("std_msgs/msg/UInt8", {"data": 256}, "data: expected uint8, got 256"),
        ("std_msgs/msg/UInt8", {"data": 1.0}, "data: expected uint8, got 1.0"),
        ("std_msgs/msg/UInt8", {"data": True}, "data: expected uint8, got True"),
        ("std_msgs/msg/Byte", {"data": -129}, "data: expected byte, got -129"),
        ("std_msgs/msg/Float64", {"data": None}, "data: expected float64, got None"),
        ("std_msgs/msg/Float64", {"data": "1"}, "data: expected float64, got '1'"),
        ("std_msgs/msg/Header", {"stamp": {"sec": 1}}, "stamp.sec: no such field, expected secs"),
        ("std_msgs/msg/Header", {"stamp": {"secs": 2**31}}, "sec: expected int32"),
        ("std_msgs/msg/Header", {"stamp": 5}, "stamp.: expected an object, got 5"),
        ("sensor_msgs/msg/Image", {"data": "no base64"}, "data: expected base64"),
        ("sensor_msgs/msg/Image", {"data": [256]}, "data: expected uint8"),
        ("sensor_msgs/msg/Image", {"data": 7}, r"data: expected uint8\[\], got 7"),
        ("geometry_msgs/msg/PoseArray", {"poses": {}}, "poses: expected .*Pose"),
        ("geometry_msgs/msg/PoseArray", {"poses": [1]}, r"poses\[0\].: expected an object"),
        (
            "geometry_msgs/msg/PoseArray",
            {"poses": [{}, {"position": {"q": 1}}]},
            r"poses\[1\].position.q: no such field, expected x, y, z",
        ),
        ("geometry_msgs/msg/PoseWithCovariance", {"covariance": [0.0]}, r"covariance: .*\[36\]"),
        ("std_msgs/msg/Float64MultiArray", {"data": ["1"]}, r"data: expected float64\[\]"),
        ("std_msgs/msg/Float64MultiArray", {"data": [None]}, r"data: expected float64\[\]"),
    ],
)
def test_what_is_no_message(kind: str, json_form: Any, text: str) -> None:
    with pytest.raises(RosMessageError, match=text):
        from_json(TYPES.message(kind), json_form)


def test_an_array_is_the_first_fields() -> None:
    form = TYPES.message("geometry_msgs/msg/Vector3")
    assert from_json(form, [1, 2.5]) == form.new(x=1.0, y=2.5)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_numbers_that_json_has_not(value: float) -> None:
    form = TYPES.message("std_msgs/msg/Float64")
    with pytest.raises(RosMessageError, match="/t: expected finite numbers"):
        encode_operation(
            {"op": "publish", "topic": "/t", "msg": to_json(form, form.new(data=value))}
        )


def test_what_is_of_another_type() -> None:
    form = TYPES.message("std_msgs/msg/String")
    with pytest.raises(
        RosMessageError, match="std_msgs/msg/String: expected a message of this type, got int"
    ):
        to_json(form, 5)
    message = form.new()
    message.data = 5
    with pytest.raises(RosMessageError, match="data: expected string"):
        to_json(form, message)
    early = TYPES.message("std_msgs/msg/Header").new(stamp={"sec": -1})
    with pytest.raises(RosMessageError, match="no time before 1970"):
        to_json(TYPES.message("std_msgs/msg/Header"), early)
