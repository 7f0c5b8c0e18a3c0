"""Types of a distribution: known ones, added ones, and sharing."""

from __future__ import annotations

import subprocess
import sys
import threading
from typing import Any

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from smartcam.exceptions import ConfigurationError, RosMessageError
from smartcam.ros2 import RosTypes
from tests.ros2.inside import MESSAGES, SERVICES, parse_message, parse_service

DISTRIBUTIONS = ("humble", "jazzy", "kilted", "lyrical", "rolling")


def test_a_message_has_names_and_hash() -> None:
    kind = RosTypes("jazzy").message("std_msgs/msg/String")
    assert kind.name == "std_msgs/msg/String"
    assert kind.dds == "std_msgs::msg::dds_::String_"
    assert kind.hash.startswith("RIHS01_df668c740482bbd4")
    assert repr(kind) == "<MessageType std_msgs/msg/String>"
    assert repr(kind.new(data="hi")) == "String(data='hi')"


def test_a_service_has_three_messages() -> None:
    kind = RosTypes("jazzy").service("std_srvs/srv/SetBool")
    assert kind.dds == "std_srvs::srv::dds_::SetBool_"
    assert kind.request.name == "std_srvs/srv/SetBool_Request"
    assert kind.request.dds == "std_srvs::srv::dds_::SetBool_Request_"
    assert kind.request.encode({"data": True}) == b"\0\1\0\0\1"
    answer = kind.response.new(success=True, message="on")
    assert kind.response.decode(kind.response.encode(answer)) == answer
    event = kind.event.new(request=[{"data": True}])
    assert kind.event.decode(kind.event.encode(event)) == event
    assert repr(kind) == "<ServiceType std_srvs/srv/SetBool>"
    empty = RosTypes("jazzy").service("std_srvs/srv/Trigger").request
    assert repr(empty.decode(empty.encode(empty.new()))) == "Trigger_Request()"


def test_a_definition_as_recordings_have_it() -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    types = RosTypes("jazzy")
    for name in store.fielddefs:
        text = types.message(name).text
        theirs = get_types_from_msg(store.generate_msgdef(name, ros_version=2)[0], name)
        ours = get_types_from_msg(text, name)
        assert list(ours) == [name, *sorted(set(ours) - {name})]
        assert {one: _plain(said) for one, said in ours.items()} == {
            one: _plain(said) for one, said in theirs.items()
        }
    assert RosTypes().message("std_msgs/msg/Header").text == (
        f"builtin_interfaces/Time stamp\nstring frame_id\n{'=' * 80}\n"
        "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    )


def _plain(said: Any) -> str:
    """Return what a definition says; ``char`` is another word for ``uint8``."""
    return str(said).replace("'char'", "'uint8'")


def test_a_description_is_what_the_service_says() -> None:
    types = RosTypes("jazzy")
    kind = types.service("type_description_interfaces/srv/GetTypeDescription").response
    for described in (
        types.message("sensor_msgs/msg/CameraInfo").description,
        types.service("std_srvs/srv/Trigger").description,
    ):
        answer = kind.decode(kind.encode(kind.new(type_description=described)))
        said = answer.type_description
        assert said.type_description.type_name == described["type_description"]["type_name"]
        within = [one.type_name for one in said.referenced_type_descriptions]
        assert within == sorted(within)
        assert within


def test_constants_are_attributes() -> None:
    kind = RosTypes().message("diagnostic_msgs/msg/DiagnosticStatus")
    assert kind.constants == {"OK": 0, "WARN": 1, "ERROR": 2, "STALE": 3}
    assert kind.new().WARN == kind.cls.WARN == 1  # type: ignore[attr-defined]


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_all_that_is_named_is_there(distribution: str) -> None:
    types = RosTypes(distribution)
    names = types.names()
    assert names == sorted(names)
    assert len(names) > 190
    for name in names:
        if "/msg/" in name:
            assert types.message(name).name == name
        else:
            kind = types.service(name)
            assert kind.request.new() is not None
            assert kind.response.new() is not None


def test_what_differs_between_distributions() -> None:
    names = {one: set(RosTypes(one).names()) for one in DISTRIBUTIONS}
    assert names["rolling"] == names["lyrical"]
    assert names["lyrical"] - names["jazzy"] >= {"nav_msgs/msg/Goals", "rosgraph_msgs/msg/Graph"}
    assert "geometry_msgs/msg/Pose2D" in names["jazzy"] - names["lyrical"]
    assert "type_description_interfaces/srv/GetTypeDescription" in names["jazzy"] - names["humble"]
    event = "lifecycle_msgs/msg/TransitionEvent"
    first = {one: RosTypes(one).message(event).fields[0].name for one in DISTRIBUTIONS}
    assert first["jazzy"] == first["kilted"] == first["humble"] == "timestamp"
    assert first["lyrical"] == first["rolling"] == "stamp"


def test_what_is_not_there() -> None:
    types = RosTypes("humble")
    with pytest.raises(ConfigurationError, match=r"expected humble, jazzy, .* got 'foxi'"):
        RosTypes("foxi")
    with pytest.raises(ConfigurationError, match="did you mean 'std_msgs/msg/String'"):
        types.message("std_msgs/msg/Strng")
    with pytest.raises(ConfigurationError, match="no such type in humble"):
        types.service("type_description_interfaces/srv/GetTypeDescription")
    with pytest.raises(ConfigurationError, match="no such type in humble"):
        _ = types.service("std_srvs/srv/Trigger").event
    for name in (
        "std_msgs/String",
        "std_srvs/srv/Trigger",
        "",
        "Std/msg/A",
        "a/msg/b",
        "a/b/msg/C",
    ):
        with pytest.raises(ConfigurationError, match="expected a name such as std_msgs/msg/String"):
            types.message(name)
    with pytest.raises(ConfigurationError, match="expected a name such as std_srvs/srv/Trigger"):
        types.service("std_msgs/msg/String")


# ---------------------------------------------------------------------------------------- adding


def test_types_are_added() -> None:
    types = RosTypes()
    types.add("my_msgs/srv/Ask", "uint8 A=1\nPart[] parts\n---\ngeometry_msgs/Point at\n")
    types.add("my_msgs/msg/Part", "string name 'bolt' # usual\nint32[2] place [3, 4]\n")
    part = types.message("my_msgs/msg/Part")
    assert repr(part.new()) == "Part(name='bolt', place=[3, 4])"
    kind = types.service("my_msgs/srv/Ask")
    assert kind.request.constants == {"A": 1}
    asked = kind.request.new(parts=[part.new(name="nut"), {}])
    assert kind.request.decode(kind.request.encode(asked)).parts[0].name == "nut"
    assert kind.response.nested["geometry_msgs/msg/Point"] is RosTypes().message(
        "geometry_msgs/msg/Point"
    )
    assert {"my_msgs/msg/Part", "my_msgs/srv/Ask"} <= set(types.names())
    with pytest.raises(ConfigurationError, match="no such type"):
        RosTypes().message("my_msgs/msg/Part")


def test_the_same_may_be_added_again() -> None:
    types = RosTypes()
    before = types.message("std_msgs/msg/String")
    types.add("std_msgs/msg/String", "# the same\nstring data\n")
    types.add("std_srvs/srv/Trigger", "---\nbool success\nstring message")
    assert types.message("std_msgs/msg/String") is before
    for name, text in (
        ("std_msgs/msg/String", "string other"),
        ("std_srvs/srv/Trigger", "---\nbool success"),
    ):
        with pytest.raises(ConfigurationError, match="jazzy has it with other fields"):
            types.add(name, text)


BAD_TEXTS = {
    "uint8": "expected a type and a name",
    "float16 x": "float16 is no type",
    "wstring x": "wstring is not supported",
    "int32[0] x": "an array of 0 elements",
    "int32[<=] x": "expected a number after <=",
    "int32<=3 x": "only the type string may",
    "int8 x 200": "200 is no int8",
    "int8[2] x [1]": "expected 2 values, got 1",
    "string<=2 x 'abc'": "'abc' is no string",
    "int8 x 1 2": "'int8 x 1 2'",
    "int8[] X=1": "a constant has one value of a basic type",
    "Part x 3": "a message has no default",
    "int8 x\nint8 x": "line 2: 'int8 x': there are two x",
}


@pytest.mark.parametrize("text", BAD_TEXTS)
def test_a_text_that_is_no_message(text: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        RosTypes().add("my_msgs/msg/Bad", text)
    assert str(caught.value).startswith("my_msgs/msg/Bad, line ")
    assert BAD_TEXTS[text] in str(caught.value)


def test_a_text_that_is_no_service() -> None:
    with pytest.raises(ConfigurationError, match="expected one line ---"):
        RosTypes().add("my_msgs/srv/Bad", "int8 a")


def test_a_message_is_not_within_itself() -> None:
    types = RosTypes()
    types.add("my_msgs/msg/A", "B b")
    types.add("my_msgs/msg/B", "A[] a")
    with pytest.raises(ConfigurationError, match=r"A > my_msgs/msg/B > my_msgs/msg/A"):
        types.message("my_msgs/msg/A")
    types.add("my_msgs/msg/C", "Unknown b")
    with pytest.raises(ConfigurationError, match="my_msgs/msg/Unknown: no such type"):
        types.message("my_msgs/msg/C")


def test_texts_are_read_as_rosbags_reads_them() -> None:
    store = get_typestore(Stores.ROS2_LYRICAL)
    types = RosTypes("lyrical")
    texts = {name: types.message(name).text for name in store.fielddefs} | MESSAGES
    for name, text in texts.items():
        head = text.partition("=" * 80)[0]
        theirs = get_types_from_msg(head, name)[name][1]
        ours = parse_message(name, head).fields
        assert [one for one, _ in theirs] == [field.name for field in ours]
        there = types.definition(name).fields
        assert ours == tuple(field._replace(default=None) for field in there)
    for name, text in SERVICES.items():
        for part, definition in zip(text.split("---"), parse_service(name, text), strict=True):
            theirs = get_types_from_msg(part + "\n", "a/msg/B")["a/msg/B"][1]
            assert [one for one, _ in theirs] == [field.name for field in definition.fields]


# --------------------------------------------------------------------------------------- sharing


def test_a_distribution_is_shared_and_not_disturbed() -> None:
    name = "geometry_msgs/msg/Pose"
    kind = RosTypes("jazzy").message(name)
    assert RosTypes("jazzy").message(name) is kind
    assert RosTypes("kilted").message(name) is not kind
    store = get_typestore(Stores.ROS2_JAZZY)
    store.fielddefs.clear()
    store.register(get_types_from_msg("int8 x", name))
    assert RosTypes("jazzy").message("geometry_msgs/msg/PoseArray").nested[name] is kind
    assert RosTypes("jazzy").message("geometry_msgs/msg/PoseStamped").encode({})


def test_threads_get_the_same_type() -> None:
    types = RosTypes()
    types.add("my_msgs/msg/Many", "sensor_msgs/CameraInfo[] infos")
    start = threading.Barrier(4)
    got: list[Any] = []

    def ask() -> None:
        start.wait(10)
        got.append(types.message("my_msgs/msg/Many"))

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for one in threads:
        one.start()
    for one in threads:
        one.join(10)
    assert len(got) == 4
    assert len(set(got)) == 1


def test_only_what_is_asked_for_is_loaded() -> None:
    lines = (
        "import sys; import smartcam.ros2._types.types as t; "
        "assert 'rosbags' not in sys.modules; types = t.RosTypes('humble'); "
        "kind = types.message('std_msgs/msg/String'); kind.decode(kind.encode({'data': 'x'})); "
        "assert 'rosbags.typesys.stores.ros2_lyrical' not in sys.modules; "
        "print(len(types._shared._messages))"
    )
    done = subprocess.run(  # noqa: S603 - our own interpreter
        [sys.executable, "-c", lines], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout == "1\n"


def test_messages_are_compared_by_type_and_values() -> None:
    types = RosTypes()
    one, other = types.message("std_msgs/msg/Int8"), types.message("std_msgs/msg/Int16")
    assert one.new() == one.new(data=0)
    assert one.new() != other.new()
    assert one.new() != 0
    image = types.message("sensor_msgs/msg/Image")
    assert image.new(data=b"ab") == image.decode(image.encode(image.new(data=b"ab")))
    assert image.new(data=b"ab") != image.new(data=b"ac")
    assert "data=<bytes of 99>" in repr(image.new(data=bytes(99)))
    with pytest.raises(AttributeError):
        one.new().dta = 1
    with pytest.raises(RosMessageError, match="did you mean 'data'"):
        one.new(dta=1)


@pytest.mark.parametrize("distribution", ["humble", "jazzy", "lyrical"])
def test_a_source_gives_the_type_again(distribution: str) -> None:
    types = RosTypes(distribution)
    for name in types.names():
        encoding, text = types.source(name)
        assert encoding == name.split("/")[1]
        if encoding == "srv":
            service = types.service(name)
            both = [types.definition(one.name) for one in (service.request, service.response)]
            assert [*parse_service(name, text)] == both
            assert types.source(service.request.name) == ("implicit", "")
        else:
            assert parse_message(name, text) == types.definition(name)
    types.add("my_msgs/msg/Mine", "float64 x 0.5  # where\n")
    assert types.source("my_msgs/msg/Mine") == ("msg", "float64 x 0.5  # where\n")
